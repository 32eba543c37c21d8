"""The accuracy statement against figures recomputed without the project, and against the standards' own numbers."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import baarda
from baarda.errors import UsageError
from baarda.formats import dbat
from baarda.hypotheses.levels import Options
from baarda.network import CHECK, Points
from baarda.observations import Distances
from baarda.procedures.testing import analyse
from baarda.report import page
from baarda.report.accuracy import Lengths, accuracy_json, accuracy_of, length_deviations, lengths_of
from baarda.report.drawings import check_vectors
from baarda.report.result_folder import result_json
from baarda.report.sections.base import Figure
from networks import ring, with_distances


@pytest.fixture(scope="module")
def aerial(data):
    return analyse(baarda.adjust(dbat.read(data("dbat_sxb") / "sxb.xml")))


def section(analysis, name="accuracy-statement"):
    return next((s for s in page.sections(analysis) if s.id == name), None)


def test_figures_of_the_aerial_block_recomputed(aerial):
    """From coordinates, given values and sigmas of the network alone."""
    points = aerial.adjustment.network.points
    at = points.roles == CHECK
    d = points.coordinates[at] - points.given[at]
    s = points.sigmas[at]
    n = len(d)
    fit_h = math.sqrt(sum(x * x + y * y for x, y, _ in d.tolist()) / n)
    fit_v = math.sqrt(sum(z * z for _, _, z in d.tolist()) / n)
    own_h = math.sqrt(sum(x * x + y * y for x, y, _ in s.tolist()) / n)
    own_v = math.sqrt(sum(z * z for _, _, z in s.tolist()) / n)
    found = result_json(aerial)["accuracy"]
    assert found["asprs"]["points"] == {"horizontal": n, "vertical": n}
    assert found["asprs"]["enough_points"] == {"horizontal": False, "vertical": False}
    assert found["asprs"]["survey"]["stated"] is True
    np.testing.assert_allclose(
        [
            found["asprs"]["fit"]["rmse_h"],
            found["asprs"]["fit"]["rmse_v"],
            found["asprs"]["survey"]["rmse_h"],
            found["asprs"]["survey"]["rmse_v"],
        ],
        [fit_h, fit_v, own_h, own_v],
        rtol=1e-12,
    )
    whole = math.hypot(fit_h, own_h), math.hypot(fit_v, own_v)
    np.testing.assert_allclose([found["asprs"]["rmse_h"], found["asprs"]["rmse_v"]], whole, rtol=1e-12)
    assert found["asprs"]["rmse_3d"] == pytest.approx(math.hypot(*whole), rel=1e-12)
    x, y = (math.sqrt(float(np.mean(d[:, k] ** 2))) for k in (0, 1))
    assert found["nssda"]["ratio"] == pytest.approx(min(x, y) / max(x, y))
    assert found["nssda"]["horizontal_95"] == pytest.approx(2.4477 * (x + y) / 2)
    assert found["nssda"]["le90"] == pytest.approx(1.6449 * fit_v)
    assert found["vdi_vde_2634"] is None
    json.dumps(found, allow_nan=False)


def test_asprs_example_of_fit_and_survey():
    """Edition 2: a fit of 5 cm with a survey of 2 cm is 5.39 cm, horizontally and vertically."""
    a = accuracy_of([[0.03, 0.04, 0.05], [-0.03, -0.04, -0.05]], [[0.02, 0.0, 0.02]] * 2)
    assert (a.rmse_h_fit, a.rmse_v_fit) == pytest.approx((0.05, 0.05))
    assert (round(a.rmse_h, 4), round(a.rmse_v, 4)) == (0.0539, 0.0539)


def test_nssda_constants_are_those_of_the_circular_normal_law():
    d = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    a = accuracy_of(d)
    rmse_r = math.sqrt(2.0)
    assert a.radius_95 == pytest.approx(1.7308 * rmse_r, abs=5e-5 * rmse_r)
    assert a.radius_90 == pytest.approx(1.5175 * rmse_r, abs=1e-4)
    assert a.radius_95 == pytest.approx(math.sqrt(-2.0 * math.log(0.05)), abs=5e-5)
    assert a.radius_90 == pytest.approx(math.sqrt(-2.0 * math.log(0.10)), abs=5e-5)
    assert (a.vertical_95, a.vertical_90) == pytest.approx((1.9600, 1.6449))


def test_no_radius_where_the_axes_differ_too_much():
    a = accuracy_of([[1.0, 0.5, 0.0], [-1.0, -0.5, 0.1]] * 15)
    assert a.ratio == pytest.approx(0.5) and math.isnan(a.radius_95) and math.isnan(a.radius_90)
    assert a.conditions((0, 1))["equal_axes"] is False


def test_conditions_hold_for_good_points_and_fail_one_by_one():
    rng = np.random.default_rng(3)
    good = rng.normal(size=(40, 3))
    assert accuracy_of(good).conditions((0, 1)) == {"points": True, "equal_axes": True, "unbiased": True, "normal": True}
    assert accuracy_of(good[:19]).conditions((2,))["points"] is False
    assert accuracy_of(good + np.array([0.0, 0.0, 1.0])).conditions((2,))["unbiased"] is False
    assert accuracy_of(rng.standard_t(1.0, size=(40, 3))).conditions((2,))["normal"] is False
    few = accuracy_of(good[:1])
    assert few.conditions((2,)) == {"points": False, "unbiased": None, "normal": None}


def test_points_without_height_or_plan_count_where_they_can():
    nan = np.nan
    a = accuracy_of([[1.0, 1.0, nan], [-1.0, 1.0, nan], [nan, nan, 3.0], [2.0, nan, nan]])
    assert (a.horizontal_points, a.vertical_points) == (2, 1)
    assert a.points.tolist() == [3, 2, 1]
    assert a.rmse_h_fit == pytest.approx(math.sqrt(2.0)) and a.rmse_v_fit == 3.0
    assert not a.survey_stated and a.rmse_v == 3.0


@given(st.lists(st.tuples(*[st.floats(-10, 10)] * 3), min_size=1, max_size=20), st.floats(0.0, 3.0))
def test_survey_error_only_adds_and_scale_carries_through(rows, sigma):
    d = np.array(rows)
    a, b = accuracy_of(d), accuracy_of(d, np.full(d.shape, sigma))
    assert b.rmse_h >= a.rmse_h - 1e-12 and b.rmse_v >= a.rmse_v - 1e-12
    assert a.rmse_3d == pytest.approx(math.sqrt(float(np.mean((d**2).sum(axis=1)))), abs=1e-12)
    assert accuracy_of(1000.0 * d).rmse_h == pytest.approx(1000.0 * a.rmse_h, abs=1e-9)


def test_wrong_shapes_are_refused():
    with pytest.raises(UsageError, match=r"\(n, 3\)"):
        accuracy_of([1.0, 2.0])
    with pytest.raises(UsageError, match="standard deviations"):
        accuracy_of(np.zeros((2, 3)), np.zeros((1, 3)))
    with pytest.raises(UsageError, match="equally many"):
        length_deviations([1.0], [0.5, 0.5], [1.0])


def test_length_deviation_is_that_of_the_adjustment_without_the_length():
    """v / r of a small deviation, against the block adjusted without the distance."""
    pairs = [(0, 5), (2, 9), (1, 12)]
    network = with_distances(ring(control=5, noise=0.2), pairs)
    whole = analyse(baarda.adjust(network))
    lengths = lengths_of(whole)
    assert [(lengths.starts[i], lengths.ends[i]) for i in range(3)] == [(f"P{i}", f"P{j}") for i, j in pairs]
    for k, (i, j) in enumerate(pairs):
        kept = [n for n in range(3) if n != k]
        groups = tuple(g.selected(kept) if isinstance(g, Distances) else g for g in network.observations)
        without = baarda.adjust(replace(network, observations=groups)).network.points.coordinates
        direct = np.linalg.norm(without[j] - without[i]) - lengths.given[k]
        assert lengths.deviations[k] == pytest.approx(direct, rel=2e-3, abs=2e-6)
    scale = whole.adjustment.scale("aposteriori")
    assert (lengths.sigmas >= scale * 0.001).all()  # never better than the calibration


def test_a_length_that_alone_gives_the_scale_is_no_test_length():
    analysis = analyse(baarda.adjust(with_distances(ring(), [(0, 1)])))
    found = accuracy_json(analysis)
    assert found["asprs"] is None and found["vdi_vde_2634"]["largest"] is None
    assert found["vdi_vde_2634"]["lengths"][0]["deviation"] is None or np.isnan(found["vdi_vde_2634"]["lengths"][0]["deviation"])
    assert result_json(analysis)["accuracy"]["vdi_vde_2634"]["lengths"][0]["sigma"] is None
    words = page.text([section(analysis)])
    assert "No check points: ASPRS and NSSDA figures cannot be stated." in words
    assert "1 of 1 are controlled by nothing else" in " ".join(words.split())


def test_conditions_of_the_guideline_on_lengths():
    many = Lengths(("a",) * 35, ("b",) * 35, np.linspace(0.1, 0.7, 35), np.zeros(35), np.ones(35), 1.0)
    assert many.conditions() == {"lengths": True, "longest": True}
    short = Lengths(("a",) * 34, ("b",) * 34, np.linspace(0.1, 0.6, 34), np.zeros(34), np.ones(34), 1.0)
    assert short.conditions() == {"lengths": False, "longest": False}


def test_statement_says_that_points_are_few(aerial):
    words = " ".join(page.text([section(aerial)]).split())
    assert "call for at least 30 check points; this test was made with only 2 horizontal and 2 vertical ones" in words
    assert "It is no statement of an accuracy class." in words
    assert "not held: fewer than 20 check points" in words


def test_statement_with_enough_points():
    analysis = analyse(baarda.adjust(ring(points=60, control=10, checks=40, noise=0.2)), Options(sigma="apriori"))
    words = " ".join(page.text([section(analysis)]).split())
    assert "positional accuracy found to be RMSE_H = " in words and "from 40 and RMSE_V" in words and "from 40 check points" in words
    assert "only" not in words.split("Accuracy in the terms")[0]


def test_no_statement_without_check_points_and_lengths():
    assert section(analyse(baarda.adjust(ring(control=5)))) is None
    assert result_json(analyse(baarda.adjust(ring(control=5))))["accuracy"] is None


def test_points_without_coordinates_are_not_drawn():
    """A tie point without rays was set aside, and has no coordinates: the plan of the check points must not look at it."""
    network = ring(images=4, points=12, control=4, checks=2, noise=0.2)
    points = network.points
    lone = Points.make((*points.labels, "ZZ"), np.concatenate([points.coordinates, np.full((1, 3), np.nan)]))
    more = {
        name: np.concatenate([getattr(points, name), getattr(lone, name)[-1:]])
        for name in ("roles", "states", "given", "sigmas", "correlations")
    }
    analysis = analyse(baarda.adjust(replace(network, points=replace(lone, **more))), Options(replicas=49))
    assert np.isnan(analysis.adjustment.network.points.coordinates[-1]).all()
    figures = [b.svg for s in page.sections(analysis) for b in s.blocks if isinstance(b, Figure)]
    assert any("check-vectors" in svg for svg in figures)
    assert not any(">nan" in svg.lower() for svg in figures)


def test_vectors_of_points_of_which_some_have_no_coordinates():
    points = np.array([[0.0, 0.0, 0.0], [10.0, 5.0, 1.0], [np.nan, np.nan, np.nan]])
    d = np.array([[0.1, 0.2, -0.1]])
    with_it, without = (check_vectors(p, points[:1], d, ["1"], "m", "m") for p in (points, points[:2]))
    assert with_it == without
