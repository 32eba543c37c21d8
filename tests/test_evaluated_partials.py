"""Partials that are evaluated wherever they are needed, several optics, sigmas row by row, and what decides about steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.adjustment import cluster_loops, datum, kernels, linearize, memory, pairs, vector_loops
from baarda.adjustment.block import BlockSolver
from baarda.adjustment.iteration import Control
from baarda.adjustment.parameter_hypotheses import collinearity
from baarda.adjustment.solve import Settings, active_groups
from baarda.geometry import rotation as rot
from baarda.network import State
from baarda.observations import kernels as image_kernels
from baarda.procedures.helmert import gathered_tables, solve_blocked
from baarda.procedures.partition_folder import write_partition
from baarda.procedures.task_engines import open_engine
from networks import BROWN, ring
from test_block_solver import NETWORKS, made, observed_orientation, system
from test_helmert import aerial


@pytest.fixture
def evaluated(monkeypatch):
    if kernels.compiled() is None:
        pytest.skip("numba is not installed")
    for module in (cluster_loops, kernels, vector_loops, image_kernels):
        monkeypatch.setattr(module, "COMPILE_FROM", 0)
    monkeypatch.setattr(linearize, "EVALUATED_FROM", 0)


def two_optics(n):
    """Give every other image a camera whose image coordinates begin elsewhere."""
    c = n.cameras[0]
    other = replace(c, label="2", origin=np.asarray(c.origin) + 1.0)
    return replace(n, cameras=(c, other), images=replace(n.images, cameras=np.arange(len(n.images.labels)) % 2))


def test_pairs_in_steps(monkeypatch):
    s = system(NETWORKS["aerial"]())
    solver = BlockSolver.of(s.lin, s.pattern, s.held)
    a = np.arange(s.lin.unknowns.count)
    whole = solver.pairs(a, a)
    monkeypatch.setattr(pairs, "AT_ONCE", 7 * solver.count)
    np.testing.assert_allclose(solver.pairs(a, a), whole, rtol=1e-12, atol=1e-12 * abs(whole).max())


def test_shares_of_evaluated_chunks(evaluated, monkeypatch):
    s = system(NETWORKS["aerial"]())
    y = np.arange(s.lin.count) + 1.0
    whole = s.lin.design.T @ y
    monkeypatch.setattr("baarda.adjustment.linear_system.PIECE", 97)
    np.testing.assert_allclose(s.lin.transposed(y), whole, rtol=1e-9, atol=1e-9 * abs(whole).max())


def test_sigma_of_each_row_where_partials_are_evaluated(evaluated):
    n = ring(images=6, points=40, control=5)
    g = n.observations[0]
    n = replace(n, observations=(replace(g, sigmas=g.sigmas * (1 + 0.1 * np.arange(len(g)))[:, None]),))
    r = baarda.adjust(n, solver="block")
    v = r.residuals[: 2 * len(g)].reshape(-1, 2)
    assert not r.lin.stored
    np.testing.assert_allclose(v, -g.misclosures(r.network, State.of(r.network)), atol=1e-7)


@pytest.mark.parametrize("change", [{"origin": np.array([1.0, 2.0])}, {"pixel_size": np.array([2.0, 2.0])}, {"y_down": False}])
def test_each_constant_makes_other_optics(change):
    n = two_optics(ring())
    c = n.cameras[0]
    n = replace(n, cameras=(c, replace(c, label="2", **change)))
    found = n.observations[0].by_optics(n)
    assert len(found) == 2
    assert all((n.images.cameras[n.observations[0].images[rows]] == k).all() for k, (_, rows) in enumerate(found))


def test_near_scale_does_not_reach_the_vif():
    r = baarda.adjust(observed_orientation(made("ring", images=8, points=40)), solver="block")
    e = r.camera_estimates
    cols = [r.numbering.column(k) for k in e.names]
    exact = r.lin.column_sums(np.ones(r.count))[cols]
    np.testing.assert_allclose(collinearity(r).inflation, np.diag(e.cofactors) * exact, rtol=1e-9)


def test_weighted_forgets_the_near_scale():
    lin = system(NETWORKS["aerial"]()).lin
    lin = replace(lin, near=7.0 * lin.scale)
    w = lin.weighted(1.0 + np.arange(lin.count) % 3)
    np.testing.assert_allclose(w.scale, np.sqrt(w.column_sums(np.ones(w.count))), rtol=1e-12)


def test_distortion_inverted_by_numpy_alone_between_two_optics(evaluated):
    n = two_optics(ring(images=6, points=40, control=5, seed=1, values=BROWN | {"K1": 1e-5}, free=("principal_distance", "K1")))
    turn = rot.exp(0.1 * np.random.default_rng(3).standard_normal((6, 3)))
    n = replace(n, images=replace(n.images, rotation=turn @ n.images.rotation))
    assert baarda.adjust(n, solver="block").status == "converged"


def test_a_worse_step_is_refused():
    c = Control(100.0, 50, Settings())
    assert not c.takes(101.0, 10.0, 0.1)
    assert (c.objective, c.damping > 0.0) == (100.0, True)
    assert not c.takes(np.inf, 10.0, 0.1)
    assert c.takes(95.0, 10.0, 0.1)
    assert c.objective == 95.0


def test_a_refused_step_that_was_linearised_at_once_is_undone(monkeypatch):
    n = ring(images=6, points=40, control=5)
    plain = baarda.adjust(n, solver="block")
    takes, refused = Control.takes, []

    def once(self, value, predicted, relative):
        if self.near(relative) and not refused:
            refused.append(relative)
            return takes(self, np.inf, predicted, relative)
        return takes(self, value, predicted, relative)

    monkeypatch.setattr(Control, "takes", once)
    r = baarda.adjust(n, solver="block")
    assert refused
    assert r.status == "converged"
    np.testing.assert_allclose(r.objective, plain.objective, rtol=1e-9)
    assert len(r.history) <= len(plain.history) + 4


def test_rows_in_any_order(evaluated):
    n = two_optics(ring(images=6, points=40, control=5))
    g = n.observations[0]
    (o, _), _ = g.by_optics(n)
    ev = g.evaluation(o, n, State.of(n))
    at = [np.arange(5), np.arange(6), np.arange(3)]
    for order in ([0, 2, 1, 3], [3, 1, 2, 0], [0, 1, 1, 3]):
        a, b = np.empty((4, 2)), np.empty((4, 2))
        assert ev(np.array(order), at, a)
        for k, r in enumerate(order):
            assert ev(slice(r, r + 1), at, b[k : k + 1])
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", list(NETWORKS))
def test_defect_of_a_sample_is_that_of_the_whole(name, monkeypatch):
    n = NETWORKS[name]()
    one = baarda.adjust(n, solver="block")
    monkeypatch.setattr(datum, "SAMPLE", 10)
    two = baarda.adjust(n, solver="block")
    assert one.datum.defect.free == two.datum.defect.free
    assert one.datum.defect.count == two.datum.defect.count


def test_memory_counts_what_is_stored(evaluated, monkeypatch):
    n = ring(images=6, points=40, control=5)
    g, every = n.observations[0], np.ones(40, dtype=bool)
    some = np.arange(len(g)) % 2 > 0
    correlated = replace(g.selected(some), name="correlated", correlations=np.full(int(some.sum()), 0.3))
    s = system(replace(n, observations=(g.selected(~some), correlated)))
    assert [c.evaluate is None for c in s.lin.chunks][:2] == [False, True]  # a second group of image points is no hindrance
    whole = memory.of_rows(s.lin.unknowns, active_groups(n, every), n)
    monkeypatch.setattr(linearize, "FEW_BESIDE", -1)
    assert system(n).lin.stored
    stored = memory.of_rows(s.lin.unknowns, active_groups(n, every), n)
    assert stored - whole >= sum(p.jacobian.nbytes for p in system(n).lin.chunks[0].parts)


def test_camera_parameters_of_a_batch_are_not_kept_from_another(evaluated):
    """A batch of one camera, one of both, and one of the first again."""
    n = two_optics(ring(images=6, points=400, control=5))
    first, second = n.cameras[0], replace(n.cameras[0], label="2", values=1.01 * np.asarray(n.cameras[0].values))
    n = replace(n, cameras=(first, second))
    g = n.observations[0]
    camera = n.images.cameras[g.images]
    own, other = np.flatnonzero(camera == 0), np.flatnonzero(camera == 1)
    order = np.concatenate([own[:128], own[128:192], other[:64], own[192:320]])
    ((o, _),) = g.by_optics(n)
    out, one = np.empty((len(order), 2)), np.empty((1, 2))
    ev, at = g.evaluation(o, n, State.of(n)), [np.arange(5), np.arange(6), np.arange(3)]
    assert ev(order, at, out)
    for k in range(0, len(order), 7):
        assert ev(order[k : k + 1], at, one)
        np.testing.assert_array_equal(out[k], one[0])


def test_slow_convergence_is_followed_to_its_end():
    """Residuals of many pixels bend the problem: steps shrink by less than a half, which is no rounding."""
    n = ring(images=6, points=40, control=5, noise=60.0, seed=1)
    r = baarda.adjust(n, solver="block")
    assert r.status == "converged"
    _, change = r.solver.least_squares(r.lin.misclosure)
    assert np.linalg.norm(change) <= 2e-10 * np.linalg.norm(r.lin.misclosure)


def test_parts_of_a_network_with_two_optics(evaluated, tmp_path):
    n = two_optics(aerial(16))
    whole = baarda.adjust(n, solver="block")
    assert [c.evaluate is not None for c in whole.lin.chunks][:2] == [True, True]
    with open_engine() as engine:
        found = gathered_tables(solve_blocked(write_partition(n, 3, tmp_path / "p"), engine), engine)["unknowns"]
    place = {name: k for k, name in enumerate(found["name"])}
    order = [place[name] for name in whole.unknowns["name"]]
    sigma = whole.unknowns["sigma"]
    assert np.abs((found["value"][order] - whole.unknowns["value"]) / sigma).max() < 1e-9
    np.testing.assert_allclose(found["sigma"][order], sigma, rtol=1e-9)
