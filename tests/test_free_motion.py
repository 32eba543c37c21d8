"""Free networks end in their datum, whatever the steps were: by the same way back alone, in both solvers and in parts."""

from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.adjustment.datum import Datum
from baarda.adjustment.free_motion import brought_back, carried
from baarda.adjustment.linearize import whitened_misclosures
from baarda.adjustment.solve import LEFT
from baarda.cameras import FIXED, OBSERVED
from baarda.formats.camera_positions import with_camera_positions
from baarda.network import Points, State
from baarda.procedures.independent_models import block_of_models
from baarda.procedures.synthetic import synthetic
from baarda.procedures.testing import analyse
from baarda.report.result_folder import result_json
from baarda.report.sections.problems import problems
from baarda.report.sections.verdict import sentences
from networks import ring, with_distances
from test_camera_positions import table
from test_independent_models import measured_models


def shifting_strips(folder):
    free = baarda.adjust(ring(images=8, points=30)).network
    return with_camera_positions(free, table(folder / "p.csv", free, arm=np.zeros(3)), model="shift")


def models():
    return block_of_models(measured_models(2e-5)[1], Points.make(()), 2e-5)


FREE = {
    "seven freedoms": lambda _: ring(),
    "brown in pixels": lambda _: synthetic("aerial", 12, points=150, control=0, model="brown").network,
    "without scale": lambda _: with_distances(ring(), [(0, 1), (2, 3)]),
    "one known point": lambda _: ring(control=1, fixed_control=True),
    "strips with shifts": shifting_strips,
    "models": lambda _: models(),
}


@pytest.fixture(scope="module", params=list(FREE))
def solved(request, tmp_path_factory):
    return baarda.adjust(FREE[request.param](tmp_path_factory.mktemp("free")))


def partly_known(count, axes, state, off, seed=5):
    """A ring of which coordinates of some points are fixed or observed, the latter with start values that are wrong by `off`."""
    p = ring(seed=3).points
    states, given, sigmas, roles = (np.array(getattr(p, name)) for name in ("states", "given", "sigmas", "roles"))
    coordinates, rng = np.array(p.coordinates), np.random.default_rng(seed)
    for axis in axes:
        roles[:count], states[:count, axis] = 1, state
        given[:count, axis] = coordinates[:count, axis] + (off * rng.standard_normal(count) if state == OBSERVED else 0.0)
        if state == OBSERVED:
            sigmas[:count, axis] = 0.01
    if state == FIXED:
        coordinates += off * rng.standard_normal(coordinates.shape) * (states != FIXED)
    return replace(ring(seed=3), points=replace(p, states=states, given=given, sigmas=sigmas, roles=roles, coordinates=coordinates))


PIVOTS = {
    "one observed point": lambda: partly_known(1, (0, 1, 2), OBSERVED, 0.3),
    "two observed points": lambda: partly_known(2, (0, 1, 2), OBSERVED, 0.3),
    "plan of two points observed": lambda: partly_known(2, (0, 1), OBSERVED, 0.3),
    "one height fixed": lambda: partly_known(1, (2,), FIXED, 0.5),
    "three heights fixed": lambda: partly_known(3, (2,), FIXED, 0.3),
    "plan of one point fixed": lambda: partly_known(1, (0, 1), FIXED, 0.5),
}


@pytest.mark.parametrize("datum", ["inner", "minimal"])
@pytest.mark.parametrize("name", list(PIVOTS))
def test_axes_that_move_with_points_lead_nowhere_else(name, datum):
    """What is free at the start is not what is free at the result: neither the steps nor the end may rely on it."""
    network, least = PIVOTS[name](), baarda.adjust(ring(seed=3)).objective
    for solver in ("dense", "block"):
        found = baarda.adjust(network, solver=solver, datum=datum)
        assert found.status == "converged" and 0 < found.datum.defect.count < 7 and not found.datum.defect.steady
        assert found.objective == pytest.approx(least, rel=1e-7)
        assert found.history[-1].objective == pytest.approx(found.objective, rel=1e-9)
        assert LEFT in found.datum.text or missed(found) < 1e-4
        np.testing.assert_allclose(found.redundancy_numbers.sum(), found.redundancy, rtol=1e-9)


def test_what_is_left_is_told():
    network = partly_known(1, (0, 1, 2), OBSERVED, 1.0)
    found = baarda.adjust(network)
    assert any(h.accepted and h.damping > 0.0 for h in found.history)
    assert found.datum.text.endswith(LEFT) and missed(found) > 1e-6
    assert LEFT not in baarda.adjust(ring()).datum.text


def state_of(a):
    return State.of(a.network).shifted(a.shift)


def values_of(a, state):
    return whitened_misclosures(a.network.shifted(a.shift), state, a.groups)


def test_free_transformations_change_no_observation(solved):
    a, state = solved, state_of(solved)
    before, d = values_of(a, state), a.datum.defect.count
    rng = np.random.default_rng(2)
    for size in (1e-3, 0.2, 1.0):
        motion = a.datum.defect.motions @ rng.standard_normal(d)
        motion *= size / max(np.linalg.norm(motion[3:6]), abs(motion[6]), 0.01 * np.linalg.norm(motion[:3]))
        there = carried(state, a.numbering, motion)
        assert np.abs(there.departure(a.numbering, state)).max() > 1e-4 * size
        np.testing.assert_allclose(values_of(a, there), before, atol=1e-6)
        along = a.datum.defect.at(a.numbering, there).basis @ np.full(d, 1e-5)  # a small step along the directions of that state
        np.testing.assert_allclose(values_of(a, there.moved(a.numbering, along)), before, atol=1e-6)


def test_known_values_stay_exactly(solved):
    a, state = solved, state_of(solved)
    there = carried(state, a.numbering, a.datum.defect.motions @ np.full(a.datum.defect.count, 0.01))
    known = a.numbering["point"].columns.reshape(-1, 3) < 0
    assert np.array_equal(there.points[known], state.points[known], equal_nan=True)


@pytest.mark.parametrize("minimal", [False, True])
def test_a_network_carried_away_is_brought_back(solved, minimal):
    a, state, datum = solved, state_of(solved), solved.datum
    if not datum.defect.steady:
        pytest.skip("axes that hang on points")
    if minimal:
        datum = replace(datum, conditions=None)
    start = state.moved(a.numbering, 1e-3 * np.random.default_rng(1).standard_normal(a.numbering.count))
    for scale in (1e-3, 0.1):
        motion = datum.defect.motions @ np.full(datum.defect.count, 1.0)
        motion *= scale / max(np.linalg.norm(motion[3:6]), abs(motion[6]), 0.01 * np.linalg.norm(motion[:3]))
        there = brought_back(carried(state, a.numbering, motion), start, a.numbering, datum)
        np.testing.assert_allclose(values_of(a, there), values_of(a, state), atol=1e-6)
        left = there.departure(a.numbering, start)
        size = np.abs(left).max()
        assert np.abs(left[datum.held] if minimal else datum.conditions.T @ left).max() <= 1e-9 * max(1.0, size)
        assert brought_back(there, start, a.numbering, datum) is not None


def test_what_cannot_be_brought_back():
    a = baarda.adjust(ring())
    state = state_of(a)
    b = np.zeros_like(a.datum.defect.basis)  # conditions over nothing
    assert brought_back(state, state, a.numbering, replace(a.datum, conditions=b)) is None
    moving = replace(a.datum, defect=replace(a.datum.defect, steady=False))
    assert brought_back(state, state, a.numbering, moving) is state
    there = carried(state, a.numbering, np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0]))
    assert brought_back(there, state, a.numbering, moving) is None


def test_long_ways_are_gone_in_pieces():
    a = baarda.adjust(ring())
    state = state_of(a)
    for turn in (1.0, 2.5):
        there = carried(state, a.numbering, np.array([0.1, 0.0, 0.0, 0.0, 0.6 * turn, 0.8 * turn, 0.5]))
        found = brought_back(there, state, a.numbering, a.datum)
        np.testing.assert_allclose(found.points, state.points, atol=1e-9)


# ---- adjustments ----------------------------------------------------------------------------------------------------------------------


def missed(a):
    """By how much the conditions of the datum, those at the start, are missed."""
    start, state = State.of(a.start).shifted(a.shift), state_of(a)
    left = state.departure(a.numbering, start)
    if a.datum.conditions is None:
        return np.abs(left[a.datum.held]).max()
    points = a.numbering["point"].columns.reshape(-1, 3)
    on = np.zeros(a.numbering.count)
    on[points[points >= 0]] = 1.0
    return np.abs((a.datum.defect.at(a.numbering, start).basis * on[:, None]).T @ left).max()


def test_lenses_in_pixels_do_not_disturb_the_datum():
    """Columns of K1 and K2 hold 1e18: what the free transformations do to them must be exactly nothing."""
    network = synthetic("aerial", 12, points=150, seed=2, control=0, model="brown").network
    dense, block = (baarda.adjust(network, solver=s) for s in ("dense", "block"))
    camera = dense.numbering["camera"].columns
    assert not dense.datum.defect.basis[camera[camera >= 0]].any()
    assert len(dense.history) == len(block.history) <= 9
    assert all(h.accepted and h.damping == 0.0 for h in dense.history)
    assert missed(dense) < 1e-12 and missed(block) < 1e-12
    np.testing.assert_allclose(block.network.points.coordinates, dense.network.points.coordinates, atol=1e-6)
    np.testing.assert_allclose(block.points["sX"], dense.points["sX"], rtol=1e-8)
    np.testing.assert_allclose(block.points["sZ"], dense.points["sZ"], rtol=1e-8)


@pytest.mark.parametrize("solver", ["dense", "block"])
@pytest.mark.parametrize("datum", ["inner", "minimal"])
@pytest.mark.parametrize("seed", [1, 2])
def test_damped_steps_do_not_move_the_datum(solver, datum, seed):
    network = synthetic("aerial", 12, points=150, seed=seed, control=0, perturbation=20.0).network
    found = baarda.adjust(network, solver=solver, datum=datum)
    assert found.status == "converged" and any(h.accepted and h.damping > 0.0 for h in found.history)
    assert missed(found) < 1e-9
    if datum == "inner":
        good = synthetic("aerial", 12, points=150, seed=seed, control=0).network
        easy = baarda.adjust(good)
        assert found.objective == pytest.approx(easy.objective, rel=1e-9)
        np.testing.assert_allclose(found.redundancy_numbers, easy.redundancy_numbers, atol=1e-7)


def test_a_likelihood_keeps_the_datum():
    found = baarda.adjust(synthetic("aerial", 9, points=120, control=0, model="brown").network, robust="huber")
    assert found.status == "converged" and missed(found) < 1e-10


def test_a_datum_without_freedoms_is_left_alone():
    a = baarda.adjust(ring(control=4))
    assert isinstance(a.datum, Datum) and a.datum.defect.motions.shape == (7, 0)


# ---- what the report says of it -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("datum", ["inner", "minimal"])
def test_check_points_judge_nothing_in_a_free_network(datum):
    """Else a block without errors fails by where it happens to lie."""
    network = synthetic("aerial", 9, points=150, control=0, checks=10, seed=2).network
    analysis = analyse(baarda.adjust(network, datum=datum))
    assert not analysis.adjustment.judges.any() and analysis.adjustment.evidence.check is None
    assert not {"check_points", "check_point", "check_axis"} & {r.name for r in analysis.tests}
    assert "Check points judge nothing in a free network." in {p[1] for p in problems(analysis)}
    assert result_json(analysis)["rms"]["check"] == {}
    controlled = analyse(baarda.adjust(synthetic("aerial", 9, points=150, checks=10, seed=2).network))
    assert controlled.adjustment.judges.sum() == 10 and "check_points" in {r.name for r in controlled.tests}


def test_the_first_sentence_adds_up():
    a = baarda.adjust(ring())
    assert f"{a.count} observations and 7 conditions of the datum determine {a.numbering.count} unknowns" in sentences(analyse(a))[0].text
    assert a.count + 7 - a.numbering.count == a.redundancy


def test_constraints_that_add_nothing_are_told():
    told = baarda.adjust(ring(control=4), datum="inner").assumptions
    assert any("inner constraints was asked for" in text for text in told)
    assert not any("was asked for" in text for text in baarda.adjust(ring(control=4)).assumptions)
