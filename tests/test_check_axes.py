"""Check points by axis, intervals of root mean squares, and what the report says of control and check points."""

import json

import numpy as np
import pytest
from scipy import stats

import baarda
from baarda.errors import UsageError
from baarda.hypotheses.check_axes import check_axis, rms_interval
from baarda.hypotheses.check_points import check_points
from baarda.hypotheses.levels import Options
from baarda.procedures.synthetic import ring
from baarda.procedures.testing import analyse
from baarda.report import page
from baarda.report.result_folder import result_json


def points(rng, n=4, skip=()):
    """Return differences, cofactors, axes and points of n check points without some coordinates."""
    keep = [(i, a) for i in range(n) for a in "XYZ" if (i, a) not in skip]
    root = rng.standard_normal((len(keep), len(keep) + 3))
    return 0.01 * rng.standard_normal(len(keep)), root @ root.T, [a for _, a in keep], [str(i) for i, _ in keep]


def test_members_are_the_joint_tests_of_their_coordinates():
    d, q, axes, groups = points(np.random.default_rng(0), skip=((3, "X"), (2, "Z")))
    c = 1e-5 * np.eye(len(d))
    for reference, r in ((None, 40.0), (c, 40.0), (c, np.inf)):
        t = check_axis(d, q, 1e-4, r, axes, groups, reference)
        assert t.labels == ("X", "Y", "Z", "horizontal", "3D")
        assert t.details["points"] == [3, 4, 3, 3, 2]
        for k, rows in ((0, [i for i, a in enumerate(axes) if a == "X"]), (4, [0, 1, 2, 3, 4, 5])):
            block = np.ix_(rows, rows)
            own = None if reference is None else reference[block]
            one = check_points(d[rows], q[block], 1e-4, r, own)
            assert np.isclose(t.statistic[k], one.statistic)
            assert np.isclose(t.p_value[k], one.p_value)


def test_axes_that_nobody_measured_are_left_out():
    d, q, axes, groups = points(np.random.default_rng(1), 2, skip=((0, "Z"), (1, "Z")))
    t = check_axis(d, q, 1e-4, 40.0, axes, groups)
    assert t.labels == ("X", "Y", "horizontal")
    assert t.details["mean"][2] is None
    with pytest.raises(UsageError):
        check_axis(d, q, 1e-4, 40.0, axes[:-1], groups)


def test_interval_is_that_of_chi_square_for_independent_equal_differences():
    d = np.array([0.3, -0.2, 0.1, 0.4, -0.6])
    rms, low, high = rms_interval(d, 7.0 * np.eye(5), 5, 0.9)
    assert np.isclose(rms, np.sqrt((d**2).mean()))
    assert np.allclose([low, high], np.sqrt(d @ d / stats.chi2(5).ppf([0.95, 0.05])))
    with pytest.raises(UsageError):
        rms_interval(d, np.eye(5), 0)


def test_correlated_differences_tell_less():
    d, c = np.array([0.3, 0.2, 0.4, 0.3]), np.full((4, 4), 0.9) + 0.1 * np.eye(4)
    wide, narrow = rms_interval(d, c, 4), rms_interval(d, np.eye(4), 4)
    assert wide[2] - wide[1] > 3 * (narrow[2] - narrow[1])


@pytest.fixture(scope="module")
def analysis():
    return analyse(baarda.adjust(ring(6, points=30, checks=5, seed=1).network), Options())


def test_report_and_json_tell_accuracy_and_control(analysis):
    text = page.text(page.sections(analysis))
    assert "Accuracy from check points" in text
    assert "horizontal" in text
    assert "Control: prior and posterior" in text
    document = result_json(analysis)
    found = document["rms"]["check_intervals"]
    assert set(found) == {"x", "y", "vertical", "horizontal", "3d"}
    for name in ("x", "vertical", "horizontal", "3d"):
        assert np.isclose(found[name]["rms"], document["rms"]["check"][name])
        assert found[name]["interval"][0] < found[name]["rms"] < found[name]["interval"][1]
    json.dumps(document, allow_nan=False)


@pytest.mark.parametrize("checks", [1, 2])
def test_few_check_points_are_said(checks):
    few = analyse(baarda.adjust(ring(6, points=30, checks=checks, seed=1).network), Options())
    text = " ".join(page.text(page.sections(few)).split())
    assert f"{checks} check point{'s' if checks > 1 else ''}: no statement about the whole block" in text
    assert f"Only {checks} check point" in text
