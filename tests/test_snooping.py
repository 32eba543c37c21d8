"""Data snooping: seeded errors, restoration, masking, what must not be removed, whole images; and the closed form on linear models."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import baarda
from baarda.errors import UsageError
from baarda.formats import read
from baarda.formats.project import write as write_project
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import tau
from baarda.observations import ImageCoordinates
from baarda.procedures.external_reliability import external_effects
from baarda.procedures.linear_snooping import snoop_rows
from baarda.procedures.removal import keys_of, predict, without
from baarda.procedures.snooping import snoop
from baarda.procedures.strategy import Plan, carry_out
from baarda.procedures.suspicion import judge
from baarda.procedures.testing import analyse
from baarda.report.result_folder import observation_table, result_json
from networks import ring, with_distances
from reference.test_small_networks import chessboard


def disturbed(network, errors):
    """Add errors to image coordinates: row, component, size."""
    group = network.observations[0]
    xy = np.array(group.xy)
    for row, component, size in errors:
        xy[row, component] += size
    return replace(network, observations=(replace(group, xy=xy), *network.observations[1:]))


# ---- observations left out --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_a_single_coordinate_is_the_point_with_the_other_one_weightless(correlation: float) -> None:
    network = ring(noise=0.3, seed=2, correlation=correlation)
    a = baarda.adjust(without(network, [(0, 3, 0), (0, 40, 1)])[0])
    group = network.observations[0]
    sigmas, correlations = np.array(group.sigmas), np.array(group.correlations)
    sigmas[3, 0] = sigmas[40, 1] = 1e6
    correlations[[3, 40]] = 0.0
    weightless = replace(network, observations=(replace(group, sigmas=sigmas, correlations=correlations),))
    b = baarda.adjust(weightless)
    assert a.count == b.count - 2
    assert a.redundancy == b.redundancy - 2
    assert a.objective == pytest.approx(b.objective, rel=1e-8)
    np.testing.assert_allclose(a.network.points.coordinates, b.network.points.coordinates, atol=1e-7)
    assert a.redundancy_numbers.sum() == pytest.approx(a.redundancy, rel=1e-9)
    assert a.evidence.images.min() >= 0  # single coordinates belong to their images


def test_keys_follow_the_observations() -> None:
    network = with_distances(ring(control=4, seed=3, correlation=0.2), [(5, 6), (8, 9)])
    gone = [(0, 7, 0), (0, 9, 0), (0, 9, 1), (1, 0, 0), (-3, 2, 1)]
    changed, keys = without(network, gone)
    a = baarda.adjust(changed)
    names = {tuple(k) for k in keys_of(a, keys).tolist()}
    full = baarda.adjust(network)
    everything = {tuple(k) for k in keys_of(full, without(network, [])[1]).tolist()}
    assert len(everything) == full.count
    assert len(names) == a.count
    assert everything - names == set(gone)


def test_a_prediction_is_the_residual_that_the_observation_would_have() -> None:
    """Linear: t of an observation left out is the externally studentised residual with it."""
    network = with_distances(ring(control=4, seed=3, noise=0.02, control_sigma=0.001), [(5, 6), (8, 9)])
    full = baarda.adjust(network)
    e = full.evidence
    t = tau(e.pv, e.pqvvp, e.variance_factor)
    keys = keys_of(full, without(network, [])[1])
    for row in (0, 17, full.count - 1, full.count - 13):
        key = tuple(keys[row].tolist())
        a = baarda.adjust(without(replace(full.network, assumptions=()), [key])[0])
        p = predict(a, network, [key])
        found = p.residuals[0] / np.sqrt(p.cofactors[0, 0] * a.variance_factor)
        r = full.redundancy
        assert found == pytest.approx(t[row] * np.sqrt((r - 1) / (r - t[row] ** 2)), rel=0.02, abs=1e-3)


def test_single_coordinates_in_a_project(tmp_path) -> None:
    network = ring(noise=0.3, seed=2)
    a = baarda.adjust(without(network, [(0, 3, 0), (0, 40, 1), (0, 41, 0), (0, 41, 1)])[0])
    write_project(a.network, tmp_path / "p")
    back = read(tmp_path / "p")
    b = baarda.adjust(back)
    assert isinstance(back.observations[1], ImageCoordinates)
    assert back.observations[1].axes.tolist() == [1, 0]
    assert (b.count, b.redundancy) == (a.count, a.redundancy)
    assert b.objective == pytest.approx(a.objective, rel=1e-9)


# ---- snooping of networks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", ["aposteriori", "apriori"])
def test_seeded_errors_are_found_and_estimated(sigma) -> None:
    network = disturbed(ring(images=8, points=30, noise=0.3, seed=5), [(10, 0, 6.0), (100, 1, -4.0)])
    found, a = snoop(network, Options(sigma=sigma, alpha_outlier=1e-4))
    rejected = [s for s in found.steps if s.action == "rejected"]
    assert found.count == 2
    assert [(s.image, s.point, s.component) for s in rejected] == [("I0", "P10", "x"), ("I3", "P10", "y")]
    assert rejected[0].estimated_error == pytest.approx(6.0, abs=1.5)
    assert rejected[1].estimated_error == pytest.approx(-4.0, abs=1.5)
    assert rejected[0].unit == "px"
    assert rejected[0].statistic_name == ("tau" if sigma == "aposteriori" else "w")
    assert 0.0 < abs(rejected[0].correlation) < 1.0
    assert rejected[0].separable_bias > 0.0
    assert found.removed["estimated_error"] == pytest.approx([6.0, -4.0], abs=1.5)
    assert a.count == 2 * 240 - 2
    assert found.stopped == "No observation is suspected any more."


def test_nothing_to_reject() -> None:
    found, a = snoop(ring(images=8, points=30, noise=0.3, seed=5), Options(alpha_outlier=1e-6))
    assert found.steps == ()
    assert found.removed is None
    assert found.count == 0
    assert not any("rejected" in text for text in a.assumptions)


def test_a_whole_image_point() -> None:
    network = disturbed(ring(images=8, points=30, noise=0.3, seed=5), [(10, 0, 3.0), (10, 1, 3.0)])
    found, a = snoop(network, Options(alpha_outlier=1e-4), unit="point")
    (step,) = found.steps
    assert (step.image, step.point, step.component) == ("I0", "P10", "")
    assert len(found.removed) == 2
    assert a.count == 2 * 239
    assert found.law == f"F(2, {a.redundancy - 2})"
    judged = judge(baarda.adjust(network), "point", Options())
    assert {len(rows) for rows in judged.rows} == {2}


def test_errors_that_mask_each_other() -> None:
    """Most of the rays of a point are wrong alike: from least squares good ones are suspected; the robust start clears them."""
    base = ring(images=10, points=25, noise=0.2, seed=8, control=8, control_sigma=0.002)
    rows = np.flatnonzero(base.observations[0].points == 20)[:4]
    network = disturbed(base, [(r, 0, 5.0 + i) for i, r in enumerate(rows)] + [(r, 1, -6.0) for r in rows])
    found, a = snoop(network, Options(alpha_outlier=1e-4), robust="cauchy")
    gone = {(i, p) for i, p in zip(found.removed["image"], found.removed["point"], strict=True)}
    assert gone == {(f"I{k}", "P20") for k in range(4)}
    assert found.start == "cauchy"
    assert a.law is None
    assert a.sigma0 < 1.2


def test_points_of_two_rays_are_kept() -> None:
    network = ring(images=6, points=24, noise=0.3, seed=5)
    group = network.observations[0]
    keep = ~((group.points == 3) & (group.images > 1))
    network = replace(network, observations=(group.selected(keep),))
    row = int(np.flatnonzero(network.observations[0].points == 3)[0])
    network = disturbed(network, [(row, 0, 30.0), (row, 1, 30.0)])
    found, a = snoop(network, Options(alpha_outlier=1e-3))
    kept = [s for s in found.steps if s.action == "kept"]
    assert kept
    assert all("P3" in s.point for s in kept)
    assert all("enough whole image points" in s.note or "cannot be told from" in s.note for s in kept)
    assert "could not be removed" in found.stopped
    assert not a.aside.any()


def test_a_wrong_control_coordinate() -> None:
    network = ring(control=6, noise=0.3, seed=5, control_sigma=0.01)
    given = np.array(network.points.given)
    given[2, 1] += 0.2
    network = replace(network, points=replace(network.points, given=given))
    found, a = snoop(network, Options(alpha_outlier=1e-3))
    first = found.steps[0]
    assert (first.group, first.point, first.component) == ("control points", "P2", "Y")
    assert first.estimated_error == pytest.approx(0.2, abs=0.06)
    assert a.network.points.states[2].tolist() == [1, 2, 1]


def test_the_datum_is_never_loosened() -> None:
    network = ring(control=3, noise=0.3, seed=5, control_sigma=1e-5)
    given = np.array(network.points.given)
    given[0] += [0.5, -0.4, 0.3]
    network = replace(network, points=replace(network.points, given=given))
    found, a = snoop(network, Options(alpha_outlier=1e-3), datum="auto")
    assert a.datum.defect.count == 0
    assert any("datum" in s.note or "cannot be told" in s.note for s in found.steps if s.action == "kept") or found.count < 4


def test_correlated_control_goes_as_a_whole() -> None:
    network = ring(control=6, noise=0.3, seed=5, control_sigma=0.01)
    points = network.points
    given, correlations = np.array(points.given), np.zeros((len(points.labels), 3))
    correlations[:6] = 0.3
    given[4] += [0.2, -0.2, 0.2]
    network = replace(network, points=replace(points, given=given, correlations=correlations))
    found, a = snoop(network, Options(alpha_outlier=1e-3))
    assert (found.steps[0].group, found.steps[0].point) == ("control points, correlated", "P4")
    assert len(found.removed) >= 3
    assert a.network.points.roles[4] == 0


def test_levels_of_the_family() -> None:
    network = disturbed(ring(images=8, points=30, noise=0.3, seed=5), [(10, 0, 1.6)])
    one = judge(baarda.adjust(network), "coordinate", Options())
    family = judge(baarda.adjust(network), "coordinate", Options(levels="bonferroni"))
    assert one.level[0] == 0.001
    assert family.level[0] == pytest.approx(0.05 / 480)
    coupled = judge(baarda.adjust(ring(control=6, correlation=0.1)), "point", Options(levels="baarda"))
    assert len(set(coupled.level)) == 2  # pairs and single control coordinates


def test_many_rejections_are_no_gross_errors() -> None:
    rng = np.random.default_rng(0)
    network = ring(images=8, points=30, noise=0.3, seed=5)
    errors = [(int(r), int(c), float(s)) for r, c, s in zip(range(0, 240, 3), rng.integers(0, 2, 80), rng.normal(0, 20, 80), strict=True)]
    found, _ = snoop(disturbed(network, errors), Options(), most=0.02)
    assert "no single gross errors" in found.stopped


def test_wrong_arguments() -> None:
    with pytest.raises(UsageError, match="coordinate, a point or an image"):
        snoop(ring(), unit="pixel")
    with pytest.raises(UsageError, match="did not converge"):
        snoop(ring(), iterations=1)
    with pytest.raises(UsageError, match="does not resist"):
        snoop(ring(), robust="lineo")
    with pytest.raises(UsageError, match="robust start"):
        snoop(ring(), unit="image", robust="huber")
    with pytest.raises(UsageError, match="--snoop-unit"):
        Plan(snoop="pixel")
    with pytest.raises(UsageError, match="--strategy"):
        Plan(strategy="wu")
    with pytest.raises(UsageError, match="by least squares"):
        carry_out(ring(), Plan(select=True), robust="huber")


# ---- images -------------------------------------------------------------------------------------------------------------------------


def test_chessboard_rejects_left02_first(data) -> None:
    found, a = snoop(chessboard(data("opencv_chessboard_left")), Options(seed=1), unit="image")
    first = found.steps[0]
    assert first.image == "left02.jpg"
    assert first.action == "rejected"
    assert first.redundancy == 1215
    assert first.sigma0 == pytest.approx(0.1709747471, rel=1e-7)
    assert "F(102, 1215)" in first.note
    assert found.images[0] == "left02.jpg"
    assert len(a.network.images.labels) == 13 - len(found.images)
    assert len(a.start.images.labels) == len(a.network.images.labels)
    assert a.network.images.labels == tuple(n for n in chessboard(data("opencv_chessboard_left")).images.labels if n not in found.images)


def test_chessboard_coordinates_start_in_left02(data) -> None:
    found, _ = snoop(chessboard(data("opencv_chessboard_left")), Options())
    first = found.steps[0]
    assert (first.image, first.point, first.component) == ("left02.jpg", "45", "y")
    assert first.statistic == pytest.approx(-14.31, abs=0.005)
    assert found.steps[1].image == "left02.jpg"


def test_equal_images_stay() -> None:
    found, a = snoop(ring(images=8, points=30, noise=0.3, seed=11), Options(alpha=0.001), unit="image")
    assert found.images == ()
    assert a.status == "converged"


# ---- tables and report ----------------------------------------------------------------------------------------------------------------


def test_the_table_keeps_what_was_removed(tmp_path) -> None:
    network = disturbed(ring(images=8, points=30, noise=0.3, seed=5), [(10, 0, 6.0)])
    a, strategy = carry_out(network, Plan(snoop="coordinate", select=True), Options(alpha_outlier=1e-4))
    analysis = replace(analyse(a), strategy=strategy)
    table = observation_table(analysis)
    assert len(table) == 480
    assert table["status"].tolist().count("rejected") == 1
    last = list(table.rows())[-1]
    assert (last["image"], last["point"], last["component"], last["status"]) == ("I0", "P10", "x", "rejected")
    assert last["residual"] == pytest.approx(-6.0, abs=1.5)
    document = json.loads(json.dumps(result_json(analysis), allow_nan=False))
    assert document["snooping"]["steps"][0]["action"] == "rejected"
    assert document["snooping"]["removed"][0]["image"] == "I0"
    assert document["selection"][0]["step"] == 0
    assert document["counts"]["image_observations"] == 479
    from baarda.report import write_report

    write_report(analysis, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Decisions of the snooping" in text
    assert "Models tried" in text
    with (tmp_path / "out" / "tables" / "observations.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert [r["status"] for r in rows].count("rejected") == 1
    assert rows[0]["effect_on"]
    assert "nan" not in text.lower().split("<table")[1]


def test_effects_of_undetected_biases() -> None:
    for network in (ring(control=5, noise=0.3, correlation=0.3), with_distances(ring(control=4), [(5, 6), (8, 9)])):
        a = baarda.adjust(network)
        biases = np.linspace(0.5, 1.5, a.count)
        found = external_effects(a, biases)
        q = a.cofactors.of(np.arange(a.numbering.count))
        white = np.zeros((a.count, a.count))
        for c in a.lin.chunks:
            for k, rows in enumerate(c.rows):
                white[np.ix_(rows, rows)] = np.linalg.inv(c.factor[k])
        effect = (q @ a.lin.design.toarray().T @ white) * biases
        at = [a.numbering.column(name) for name in found.names]
        np.testing.assert_allclose(found.values, effect[at, np.arange(a.count)], rtol=1e-7, atol=1e-12)
        ratio = np.abs(effect) / np.sqrt(np.diagonal(q))[:, None]
        np.testing.assert_allclose(found.ratios, ratio[at, np.arange(a.count)], rtol=1e-7)
        # nothing else of the own image and point feels more
        own = {name: i for i, name in enumerate(a.numbering.names)}
        o = a.observations
        for i in range(0, 100, 7):
            mine = [own[n] for n in own if n.startswith((f"image {o['image'][i]}:", f"point {o['point'][i]}:", "camera"))]
            assert found.ratios[i] == pytest.approx(ratio[mine, i].max(), rel=1e-7)
    analysis = analyse(a)
    external, e = analysis.observations["external"], analysis.observations
    ratios = external_effects(a, e["mdb"]).ratios
    seen = np.isfinite(ratios) & np.isfinite(external)
    assert (ratios[seen] <= external[seen] * (1 + 1e-9)).all()


# ---- linear models --------------------------------------------------------------------------------------------------------------------


@given(st.integers(0, 300), st.booleans(), st.sampled_from(["aposteriori", "apriori"]))
def test_closed_form_is_a_new_adjustment(seed: int, correlated: bool, sigma: str) -> None:
    rng = np.random.default_rng(seed)
    n, u = 20, 4
    a = rng.standard_normal((n, u))
    c = np.diag(rng.uniform(0.5, 2.0, n))
    if correlated:
        root = np.eye(n) + 0.2 * rng.standard_normal((n, n)) / 4
        c = root @ c @ root.T
    l_ = np.linalg.cholesky(c) @ rng.standard_normal(n)
    for i in rng.choice(n, 3, replace=False):
        l_[i] += rng.choice([-1, 1]) * rng.uniform(5, 30)
    found = snoop_rows(a, l_, c, Options(sigma=sigma, alpha_outlier=0.01))
    shifted = np.column_stack([a, np.eye(n)[:, list(found.removed)]])
    p = np.linalg.inv(c)
    x = np.linalg.solve(shifted.T @ p @ shifted, shifted.T @ p @ l_)
    v = shifted @ x - l_
    assert found.vpv == pytest.approx(float(v @ p @ v), rel=1e-7, abs=1e-9)
    assert found.redundancy == n - u - len(found.removed)
    np.testing.assert_allclose(found.shifts, x[u:], rtol=1e-6, atol=1e-8)
    for step in found.steps:
        assert (step.p_value <= 0.01) == (step.action == "rejected")


def test_uncontrolled_rows_are_never_removed() -> None:
    a = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    found = snoop_rows(a, [1.0, 1.1, 0.9, 9.0, 100.0], options=Options(alpha_outlier=0.05))
    assert 4 not in found.removed


def test_limits_under_a_law_of_errors() -> None:
    """Student errors with 5 degrees of freedom: the limits are wider, fewer good observations are suspected, and a gross error still is."""
    network = disturbed(ring(images=8, points=30, noise=0.3, seed=5), [(10, 0, 6.0)])
    from baarda.distributions import law

    found, _ = snoop(network, Options(alpha_outlier=0.01), law=law("student")(nu=5.0))
    normal, _ = snoop(network, Options(alpha_outlier=0.01))
    first = found.steps[0]
    assert (first.image, first.point, first.component) == ("I0", "P10", "x")
    assert first.limit > 2.6
    assert np.isnan(first.p_value)
    assert found.count < normal.count
    assert "student" in found.law
    assert found.as_dict()["law"] == found.law
    with pytest.raises(UsageError, match="single coordinates"):
        snoop(network, unit="point", law="modulated_normal")
