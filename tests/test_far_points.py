"""Points almost at infinity: they neither stall nor stop an adjustment, wherever they start, and are named where they say nothing."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from typer.testing import CliRunner

import baarda
from baarda.adjustment.far_points import FarPoints
from baarda.adjustment.linearize import whitened_misclosures
from baarda.adjustment.solve import active_groups
from baarda.cameras import FIXED, FREE
from baarda.cli import app
from baarda.formats import project
from baarda.network import CHECK, Network, State, Viewpoints, unknowns_of
from baarda.observations import Distances, viewpoints_of
from baarda.procedures.helmert import solve_blocked
from baarda.procedures.partition_folder import write_partition
from baarda.procedures.synthetic import synthetic
from baarda.procedures.task_engines import open_engine
from baarda.procedures.testing import analyse
from baarda.report.sections import verdict
from baarda.report.sections.base import DataTable
from baarda.report.sections.points import POINTS

COUNT = 4


def far_network(factor: float, images: int = 9, points: int = 120, wrong: float = 0.3, seed: int = 4, **options: Any) -> Any:
    """Return a block with some points moved to a multiple of their distance, badly started, the true network, and the points."""
    made = synthetic("aerial", images, points=points, seed=seed, **options)
    net, truth, rng = made.network, made.truth, np.random.default_rng(seed)
    group = net.observations[0]
    rays = np.bincount(group.points, minlength=len(net.points.labels))
    chosen = rng.choice(np.flatnonzero((rays >= 3) & (net.points.roles == 0)), COUNT, replace=False)
    seen = viewpoints_of(truth.observations, State.of(truth))
    true, start = np.array(truth.points.coordinates), np.array(net.points.coordinates)
    for p in chosen:
        true[p] = seen.centres[p] + factor * (true[p] - seen.centres[p])
        start[p] = seen.centres[p] + factor * np.exp(wrong * rng.standard_normal()) * (start[p] - seen.centres[p])
    truth = replace(truth, points=replace(truth.points, coordinates=true))
    exact = truth.observations[0]
    xy = np.array(group.xy)
    rows = np.isin(group.points, chosen)
    xy[rows] = (exact.xy - exact.misclosures(truth, State.of(truth)))[rows] + 0.5 * rng.standard_normal((rows.sum(), 2))
    points = replace(net.points, coordinates=start)
    return replace(net, points=points, observations=(replace(group, xy=xy), *net.observations[1:])), truth, chosen


def by_inverse_distance(network: Network, chosen: Any) -> tuple[float, Any]:
    """Return the least v'Pv, and the inverse distances of some points over their sigmas, found with directions and inverse distances."""
    groups, state = active_groups(network, np.ones(len(network.points.labels), dtype=bool)), State.of(network)
    unknowns = unknowns_of(network, np.ones(len(network.points.labels), dtype=bool), np.ones(len(network.cameras), dtype=bool))
    columns = unknowns["point"].columns.reshape(-1, 3)[chosen]
    seen = viewpoints_of(groups, state)
    centre = seen.centres[chosen]
    ray = state.points[chosen] - centre
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    across = np.cross(ray, np.eye(3)[np.argmin(np.abs(ray), axis=1)])
    across /= np.linalg.norm(across, axis=1)[:, None]
    third = np.cross(ray, across)

    def residuals(x: Any) -> Any:
        there = state.moved(unknowns, np.where(np.isin(np.arange(len(x)), columns), 0.0, x))
        a, b, rho = x[columns].T * np.array([1e-3, 1e-3, 1e-3])[:, None]
        direction = ray + a[:, None] * across + b[:, None] * third
        points = np.array(there.points)
        points[chosen] = centre + direction / rho[:, None]
        return whitened_misclosures(network, replace(there, points=points), groups)

    x = np.zeros(unknowns.count)
    x[columns[:, 2]] = 1e3 / np.linalg.norm(state.points[chosen] - centre, axis=1)
    found = least_squares(residuals, x, method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    cofactor = np.linalg.inv(found.jac.T @ found.jac)
    return 2.0 * found.cost, found.x[columns[:, 2]] / np.sqrt(np.diag(cofactor)[columns[:, 2]])


@pytest.mark.parametrize("solver", ["dense", "block"])
@pytest.mark.parametrize("factor", [1.0, 30.0, 1e3, 1e5, 1e8, 1e12])
def test_any_distance_is_adjusted_in_a_few_iterations(solver: str, factor: float) -> None:
    network, _, chosen = far_network(factor)
    found = baarda.adjust(network, solver=solver)
    assert found.status == "converged" and len(found.history) <= 11
    assert 0.7 < found.variance_factor < 1.3
    np.testing.assert_allclose(found.redundancy_numbers.sum(), found.redundancy, rtol=1e-6)
    far = found.far
    assert set(far.points) == (set(chosen.tolist()) if factor >= 1e3 else set())
    assert (far.least > 3e4).all()  # flying height 1100 m


def test_the_minimum_is_that_of_directions_and_inverse_distances() -> None:
    """Against MINPACK with inverse distances as unknowns: the same v'Pv, and the same inverse distances in units of their sigmas."""
    network, _, chosen = far_network(2e3, images=4, points=40, wrong=0.1)
    found = baarda.adjust(network, solver="dense")
    network = replace(network, points=replace(network.points, coordinates=found.start.points.coordinates))
    objective, ratio = by_inverse_distance(network, chosen)
    np.testing.assert_allclose(found.objective, objective, rtol=1e-8)
    seen = viewpoints_of(found.groups, State.of(found.network))
    ray = (found.network.points.coordinates - seen.centres)[chosen]
    square = np.einsum("ni,nij,nj->n", ray, found.point_cofactors[chosen], ray)
    np.testing.assert_allclose((ray**2).sum(axis=1) / np.sqrt(square), np.abs(ratio), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("factor", [1e2, 1e4, 1e8])
def test_a_free_network_does_not_hang_on_far_points(factor: float) -> None:
    """Inner constraints leave far points out: the sigmas of the others are hardly those of the network without them."""
    network, _, chosen = far_network(factor, control=0)
    found = [baarda.adjust(network, solver=s) for s in ("dense", "block")]
    assert all(f.status == "converged" and len(f.history) < 14 for f in found)
    assert f"but {COUNT} far one(s)" in found[0].datum.text
    others = np.setdiff1d(np.arange(len(network.points.labels)), chosen)
    sigma = [np.sqrt(np.einsum("nii->n", f.point_cofactors[others])) for f in found]
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=1e-6)
    group = network.observations[0]
    rest = replace(network, observations=(group.selected(~np.isin(group.points, chosen)), *network.observations[1:]))
    alone = baarda.adjust(rest, solver="dense")
    ratio = np.median(sigma[0] / np.sqrt(np.einsum("nii->n", alone.point_cofactors[others])))
    assert 0.9 < ratio < 1.0  # like stars they fix the rotations, and nothing else


@pytest.mark.parametrize("bases", [3.0, 10.0, 60.0])
def test_a_free_network_finds_out_which_points_are_far(bases: float) -> None:
    """Points that start near and prove to be far leave the inner constraints, as if that had been known from the start."""
    network, _, chosen = far_network(1e6, control=0)
    expected = baarda.adjust(network, solver="block")
    seen = viewpoints_of(network.observations, State.of(network))
    start = np.array(network.points.coordinates)
    ray = start[chosen] - seen.centres[chosen]
    start[chosen] = seen.centres[chosen] + ray * (bases * seen.base[chosen] / np.linalg.norm(ray, axis=1))[:, None]
    found = baarda.adjust(replace(network, points=replace(network.points, coordinates=start)), solver="block")
    assert found.status == "converged" and found.datum.text == expected.datum.text
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)
    others = np.setdiff1d(np.arange(len(start)), chosen)
    sigma = [np.sqrt(np.einsum("nii->n", a.point_cofactors[others])) for a in (found, expected)]
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=1e-4)


@pytest.mark.parametrize("seed", [5, 7])
def test_many_far_points_are_no_chance_for_the_dense_solver(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some of many come out a million bases away by chance: Cartesian normal equations would lose them."""
    monkeypatch.setattr(sys.modules[__name__], "COUNT", 100)
    network, _, _ = far_network(1e5, points=160, seed=seed)
    dense, block = (baarda.adjust(network, solver=s) for s in ("dense", "block"))
    assert dense.status == block.status == "converged"
    assert dense.objective == pytest.approx(block.objective, rel=1e-10)
    np.testing.assert_allclose(dense.redundancy_numbers.sum(), dense.redundancy, rtol=1e-5)


def test_points_that_other_observations_tie_keep_to_coordinates() -> None:
    """A far point with distances to others starts where it is given, and does not pass infinity."""
    made = far_network(1e5, wrong=0.0)
    network, truth, chosen = made
    near = np.flatnonzero(network.points.roles == 1)[:3]
    true = truth.points.coordinates
    network = replace(network, points=replace(network.points, coordinates=true))
    ends = [(a, b) for a in chosen for b in near]
    lengths = np.array([np.linalg.norm(true[a] - true[b]) for a, b in ends])
    a, b = (np.array(x) for x in zip(*ends, strict=True))
    tied = Distances(a, b, lengths, np.full(len(a), 100.0))
    found = baarda.adjust(replace(network, observations=(*network.observations, tied)))
    assert found.status == "converged" and not found.behind
    assert 0.7 < found.variance_factor < 1.3
    assert not any("nearer" in text for text in found.assumptions)


def test_a_point_amid_its_images_is_not_far() -> None:
    made = synthetic("ring", 8, points=30, seed=3).network
    middle = made.images.position.mean(axis=0)
    shift = middle - np.array(made.points.coordinates)[0]
    network = replace(made, images=replace(made.images, position=made.images.position - shift))
    seen = viewpoints_of(network.observations, State.of(network))
    assert not seen.far(network.points.coordinates).any()


def test_near_points_move_by_the_inverse_distance_and_beyond_half_of_it_in_proportion() -> None:
    seen = Viewpoints(np.zeros((5, 3)), np.ones(5))
    steps = np.array([0.05, 0.2, 0.49, 0.51, 2.0])
    moved = seen.moved(np.full((5, 3), [10.0, 0.0, 0.0]), 10.0 * steps[:, None] * np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(moved[:, 0], [10.5, 12.5, 10.0 / 0.51, 20.4, 80.0])


def test_parts_agree_with_the_whole(tmp_path: Any) -> None:
    network, _, _ = far_network(1e6, images=16, points=300, control=0)
    whole = baarda.adjust(network, solver="block")
    with open_engine() as engine:
        parts = solve_blocked(write_partition(network, 2, tmp_path / "parts"), engine)
    assert parts.converged and parts.datum.text == whole.datum.text
    assert parts.objective == pytest.approx(whole.objective, rel=1e-10)


@pytest.mark.parametrize("law", ["huber", "student"])
def test_robust_laws_follow(law: str) -> None:
    network, _, chosen = far_network(1e6)
    found = baarda.adjust(network, robust=law)
    assert found.status == "converged"
    assert set(found.far.points) == set(chosen.tolist())


@pytest.mark.parametrize("factor", [1e2, 1e4, 1e9])
def test_start_values_are_found_for_rays_that_open(factor: float) -> None:
    network, _, chosen = far_network(factor)
    unknown = np.array(network.points.coordinates)
    unknown[chosen] = np.nan
    found = baarda.adjust(replace(network, points=replace(network.points, coordinates=unknown)))
    assert found.status == "converged"
    assert found.objective == pytest.approx(baarda.adjust(network).objective, rel=1e-9)


def test_fixed_coordinates_stay_where_they_are() -> None:
    """A point is moved along its ray only if all of its coordinates are unknown."""
    made = synthetic("aerial", 9, points=120, seed=4).network
    states, start = np.array(made.points.states), np.array(made.points.coordinates)
    chosen = np.flatnonzero((states == FREE).all(axis=1))[:5]
    states[chosen, 2] = FIXED
    start[chosen, :2] += 400.0
    found = baarda.adjust(replace(made, points=replace(made.points, states=states, coordinates=start)), iterations=3)
    np.testing.assert_array_equal(found.network.points.coordinates[chosen, 2], start[chosen, 2])


def test_steps_that_are_zero_move_nothing() -> None:
    points = np.random.default_rng(1).normal(0.0, 1e5, (50, 3))
    seen = Viewpoints(np.full((50, 3), 0.1), np.ones(50))
    np.testing.assert_array_equal(seen.moved(points, np.zeros((50, 3))), points)


def test_a_step_of_the_inverse_distance_arrives_exactly() -> None:
    """The linear step of a far point to another direction and inverse distance leads there, through infinity as well."""
    rng = np.random.default_rng(2)
    ray = rng.normal(size=(40, 3))
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    before, after = 10.0 ** rng.uniform(-9, -2.1, 40), rng.choice([-1.0, 1.0], 40) * 10.0 ** rng.uniform(-8, -2.1, 40)
    turn = np.cross(ray, 1e-3 * rng.normal(size=(40, 3)))
    points = ray / before[:, None]
    steps = turn / before[:, None] - points * ((after - before) / before)[:, None]
    moved = Viewpoints(np.zeros((40, 3)), np.ones(40)).moved(points, steps)
    np.testing.assert_allclose(moved, (ray + turn) / after[:, None], rtol=1e-6)


def test_the_report_names_them(tmp_path: Any) -> None:
    network, _, chosen = far_network(1e6)
    project.write(network, tmp_path / "block")
    done = CliRunner().invoke(app, ["adjust", str(tmp_path / "block"), "--out", str(tmp_path / "out"), "--format", "project"])
    assert done.exit_code == 0, done.output
    labels = [network.points.labels[i] for i in np.sort(chosen)]
    document = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert document["points_almost_infinite"] == labels
    assert any("brought nearer along their rays" in text for text in document["assumptions"])
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"{COUNT} points cannot be told from infinity." in page and f"{labels[0]} (beyond " in page
    assert "behind its camera" not in page


def test_a_check_point_at_infinity_judges_nothing(tmp_path: Any) -> None:
    network, truth, chosen = far_network(1e6, checks=3)
    roles, given = np.array(network.points.roles), np.array(network.points.given)
    roles[chosen[0]], given[chosen[0]] = CHECK, truth.points.coordinates[chosen[0]]
    network = replace(network, points=replace(network.points, roles=roles, given=given))
    found = baarda.adjust(network)
    assert found.judges.sum() == 3 and not found.judges[chosen].any()
    check = found.evidence.check
    assert check is not None and len(check.names) == 9
    project.write(network, tmp_path / "block")
    for language, told in (("en", "Check points are almost at infinity."), ("de", "sind fast unendlich fern.")):
        done = CliRunner().invoke(
            app, ["adjust", str(tmp_path / "block"), "--out", str(tmp_path / language), "--format", "project", "--language", language]
        )
        assert done.exit_code == 0, done.output
        page = (tmp_path / language / "report.html").read_text(encoding="utf-8")
        assert told in page and ("brought nearer" in page) == (language == "en")
        rms = json.loads((tmp_path / language / "result.json").read_text(encoding="utf-8"))["rms"]["check"]
        assert rms["x"] < 1.0 and rms["z"] < 2.0


def test_which_points_are_told_and_how_far_they_are_at_least() -> None:
    """By hand: |rho| < 3 sigma of the inverse distance, and the limit 1 / (rho + 1.645 sigma), rho negative behind the images."""
    sides, told, apart = set(), 0, 0
    for seed, factor in enumerate((8e2, 8e2, 1e5, 1e5)):
        network, truth, chosen = far_network(factor, seed=seed)
        found = baarda.adjust(network)
        seen = viewpoints_of(found.groups, State.of(found.network))
        least = dict(zip(found.far.points.tolist(), found.far.least.tolist(), strict=True))
        for p in chosen.tolist():
            ray, true = found.network.points.coordinates[p] - seen.centres[p], truth.points.coordinates[p] - seen.centres[p]
            r = np.linalg.norm(ray)
            unit = np.sign(ray @ true) * ray / r
            rho, sigma = np.sign(ray @ true) / r, found.sigma0 * np.sqrt(unit @ found.point_cofactors[p] @ unit) / r**2
            assert (p in least) == (abs(rho) < 3.0 * sigma)
            if p in least:
                limit = rho + 1.6448536269514722 * sigma
                assert least[p] == pytest.approx(1.0 / limit if limit > 0.0 else np.inf, rel=1e-9)
                sides.add(float(np.sign(rho)))
                told += 1
            else:
                apart += 1
    assert sides == {-1.0, 1.0} and told and apart


def test_only_unknown_points_that_take_part_are_told() -> None:
    network, _, chosen = far_network(1e6)
    states, group = np.array(network.points.states), network.observations[0]
    states[chosen[0], 2] = FIXED
    one_ray = np.flatnonzero(group.points == chosen[1])[1:]  # set aside
    keep = ~np.isin(np.arange(len(group)), one_ray)
    network = replace(network, points=replace(network.points, states=states), observations=(group.selected(keep),))
    found = baarda.adjust(network)
    assert found.aside[chosen[1]]
    assert set(found.far.points) <= set(chosen[2:].tolist())
    start = found.start.points.coordinates
    np.testing.assert_array_equal(start[chosen[:2]], network.points.coordinates[chosen[:2]])  # nor brought nearer


def test_inner_constraints_leave_out_what_is_beyond_a_hundred_bases() -> None:
    network, _, chosen = far_network(1.0, control=0)
    seen = viewpoints_of(network.observations, State.of(network))
    near, far = (seen.centres[chosen[:2]] + np.array([[0.0, 0.0, -f]]) * seen.base[chosen[:2], None] for f in (30.0, 150.0))
    coordinates = np.array(network.points.coordinates)
    coordinates[chosen[:2]] = near
    assert not seen.far(coordinates).any()
    coordinates[chosen[:2]] = far
    assert set(np.flatnonzero(seen.far(coordinates))) == set(chosen[:2].tolist())


def test_a_free_network_follows_a_robust_law() -> None:
    network, _, chosen = far_network(1e5, control=0)
    found = baarda.adjust(network, robust="huber", solver="block")
    assert found.status == "converged"
    assert set(found.far.points) == set(chosen.tolist())


def test_precision_is_that_of_the_other_points() -> None:
    network, _, chosen = far_network(1e6)
    analysis = analyse(baarda.adjust(network))
    names = {network.points.labels[i] for i in chosen}
    sentence = next(s for s in verdict.sentences(analysis) if s.subject == "Precision").text
    assert not any(f"point {name} " in sentence for name in names)
    tables = [b for b in POINTS.build(analysis) or [] if isinstance(b, DataTable)]
    assert all(float(cell) < 50.0 for row in tables[0].rows for cell in row[2:])
    assert all(float(cell) < 50.0 for row in tables[1].rows for cell in row[3:])
    assert not names & {row[0] for row in tables[2].rows}


def test_where_all_points_are_almost_infinite_their_list_is_left() -> None:
    network, _, _ = far_network(1.0)
    analysis = analyse(baarda.adjust(network))
    every = np.arange(len(network.points.labels))
    analysis.adjustment.__dict__["far"] = FarPoints(every, np.full(len(every), 1e6))
    tables = [b for b in POINTS.build(analysis) or [] if isinstance(b, DataTable)]
    assert [t.caption for t in tables] == ["All points"] and len(tables[0].rows) == len(every)
