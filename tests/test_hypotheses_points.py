"""Check points, control points, deformation: exact laws, constrained adjustments, degenerate cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg, stats

from baarda.errors import Singular, UsageError
from baarda.hypotheses import _linear_model
from baarda.hypotheses.base import Estimates, Evidence
from baarda.hypotheses.check_points import check_point, check_points
from baarda.hypotheses.check_points import from_evidence as of_check
from baarda.hypotheses.control_points import control_point, control_points
from baarda.hypotheses.control_points import from_evidence as of_control
from baarda.hypotheses.deformation import deformation, deformation_point, moved_points, pooled_variance_factor
from baarda.hypotheses.levels import Options

linear_model = _linear_model.linear_model


def spd(seed: int, k: int) -> np.ndarray:
    root = np.random.default_rng(seed).standard_normal((k, k + 2))
    return root @ root.T


@given(st.integers(0, 10_000))
def test_check_points_with_exact_reference(seed: int) -> None:
    q, d = spd(seed, 5), np.random.default_rng(seed).standard_normal(5)
    t = check_points(d, q, 0.3, 17)
    assert t.statistic == pytest.approx(d @ np.linalg.solve(q, d) / 5 / 0.3, rel=1e-7)
    assert t.p_value == pytest.approx(stats.f.sf(t.statistic, 5, 17), rel=1e-12)
    assert t.df == (5.0, 17.0)
    assert t.note == ""


def test_limits_of_the_law_with_a_reference_of_its_own() -> None:
    q, c, d = spd(1, 4), spd(2, 4), np.array([0.4, -1.0, 0.7, 2.0])
    exact = check_points(d, q, 0.3, 17)
    nearly = check_points(d, q, 0.3, 17, 1e-9 * c)
    assert nearly.df == pytest.approx((4.0, 17.0), rel=1e-6)
    assert nearly.p_value == pytest.approx(exact.p_value, rel=1e-6)
    rough = check_points(d, 1e-9 * q, 0.3, 17, c)
    assert rough.p_value == pytest.approx(stats.chi2.sf(d @ np.linalg.solve(c, d), 4), rel=1e-6)
    both = check_points(d, q, 0.3, 17, c)
    assert both.statistic == pytest.approx(d @ np.linalg.solve(0.3 * q + c, d) / 4, rel=1e-9)
    share = linalg.eigh(0.3 * q, 0.3 * q + c, eigvals_only=True)
    assert both.df[1] == pytest.approx(17 * 4 / (share**2).sum(), rel=1e-9)
    assert "approximately" in both.note
    known = check_points(d, q, 0.3, np.inf, c)
    assert known.p_value == pytest.approx(stats.chi2.sf(4 * known.statistic, 4), rel=1e-12)
    assert "chi-square" in known.note


def test_points_of_different_dimension() -> None:
    q = spd(3, 6)
    d = np.array([1.0, 2.0, -1.0, 3.0, 0.5, 4.0])
    t = check_point(d, q, 0.5, 12, ["A", "A", "A", "H", "B", "B"])
    assert t.labels == ("A", "H", "B")
    for i, (at, k) in enumerate((([0, 1, 2], 3), ([3], 1), ([4, 5], 2))):
        form = d[at] @ np.linalg.solve(q[np.ix_(at, at)], d[at])
        assert t.p_value[i] == pytest.approx(stats.f.sf(form / k / 0.5, k, 12), rel=1e-9)
    extreme = t.details["extreme"]["index"]
    assert (t.statistic[extreme] > t.critical) == t.rejected[extreme]


def test_few_check_points_are_said_in_words() -> None:
    e = Evidence(
        residuals=np.zeros(5),
        sigmas=np.ones(5),
        vpv=4.0,
        redundancy=4,
        check=Estimates(("1 X", "1 Y"), np.ones(2), np.eye(2), None, ("1", "1")),
    )
    joint, single = of_check(e, Options())
    assert joint.note.startswith("Only 1 check point:")
    assert single.labels == ("1",)
    assert single.p_value[0] == pytest.approx(joint.p_value)


def test_dependent_check_coordinates() -> None:
    with pytest.raises(Singular, match="Z"):
        check_points([1.0, 1.0], np.ones((2, 2)), 1.0, 5, names=("X", "Z"))


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_control_test_is_that_of_shifts_of_the_given_coordinates(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, u, d = 16, 4, 3
    a, l_ = rng.standard_normal((n, u)), rng.standard_normal(n)
    root = np.eye(n)
    root[:d, :d] += 0.4 * rng.standard_normal((d, d))
    e = linear_model(a, l_, root @ root.T, control=range(d))
    t = of_control(e, Options())[0]
    free = linear_model(np.column_stack([a, np.eye(n)[:, :d]]), l_, root @ root.T)
    r = e.redundancy
    f = (e.vpv - free.vpv) / d / (free.vpv / (r - d))
    assert t.details["F"] == pytest.approx(f, rel=1e-6)
    assert t.p_value == pytest.approx(stats.f.sf(f, d, r - d), rel=1e-6)
    assert (t.details["F"] > t.details["F_critical"]) == t.rejected
    known = of_control(e, Options(sigma="apriori"))[0]
    assert known.p_value == pytest.approx(stats.chi2.sf(e.vpv - free.vpv, d), rel=1e-6)


def test_control_that_defines_the_datum() -> None:
    """Levelling: height differences, four weighted heights; one combination of the heights cannot be tested."""
    differences = np.array([[-1.0, 1, 0, 0], [0, -1, 1, 0], [0, 0, -1, 1], [1, 0, 0, -1], [1, 0, -1, 0]])
    a = np.vstack([np.eye(4), differences])
    rng = np.random.default_rng(5)
    e = linear_model(a, np.concatenate([10.0 + rng.standard_normal(4), rng.standard_normal(5)]), control=range(4))
    joint, single = of_control(e, Options())
    assert joint.details["rank"] == 3
    assert "1 of 4 combinations" in joint.note
    bare = Evidence(
        **{**vars(e), "control": Estimates(e.control.names, e.control.values, e.control.cofactors)}  # type: ignore[union-attr]
    )
    assert of_control(bare, Options())[0].statistic == pytest.approx(joint.statistic, rel=1e-9)
    # One coordinate per point: the square of its tau.
    tau = e.residuals[:4] / np.sqrt(e.qvv[:4]) / e.sigma0  # type: ignore[index]
    np.testing.assert_allclose(single.statistic, tau**2, rtol=1e-9)


def test_uncontrolled_control() -> None:
    # Just one given height: nothing controls it.
    a = np.array([[1.0, 0.0], [-1.0, 1.0], [-1.0, 1.0]])
    e = linear_model(a, [10.0, 1.0, 1.2], control=[0])
    assert of_control(e, Options()) == []
    mixed = control_point([0.0, 1.0], np.diag([1e-20, 0.5]), 1.0, 9, ["A", "B"])
    assert np.isnan(mixed.p_value[0])
    assert "1 uncontrolled" in mixed.note
    with pytest.raises(UsageError, match="controlled"):
        control_points([0.0], [[1e-14]], 1.0, 9, prior=[1.0])


def test_control_alone_is_redundant() -> None:
    t = control_points([1.0, -1.0], np.array([[0.5, -0.5], [-0.5, 0.5]]), 2.0, 1)
    assert t.p_value == 1.0
    assert "nothing can be tested" in t.note


def levelling_epochs(seed: int, shift: float) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return the differences of two free adjustments of a levelling net, their cofactors, the pooled variance factor and redundancy."""
    rng = np.random.default_rng(seed)
    m = 6
    pairs = [(i, j) for i in range(m) for j in range(i)]
    a = np.zeros((len(pairs), m))
    for row, (i, j) in enumerate(pairs):
        a[row, i], a[row, j] = 1.0, -1.0
    q = np.linalg.pinv(a.T @ a)
    heights, omega = [], []
    for truth in (np.zeros(m), shift * (np.arange(m) == 2)):
        l_ = a @ truth + 0.01 * rng.standard_normal(len(pairs))
        heights.append(q @ a.T @ l_)
        omega.append(((a @ heights[-1] - l_) ** 2).sum())
    r = len(pairs) - (m - 1)
    s2, total = pooled_variance_factor(omega[0] / r, r, omega[1] / r, r)
    return heights[1] - heights[0], 2.0 * q, s2, int(total)


def test_deformation_of_a_free_levelling_net() -> None:
    d, q, s2, r = levelling_epochs(1, 0.0)
    t = deformation(d, q, s2, r)
    assert t.df == (5.0, 20.0)
    assert "1 datum directions" in t.note
    # The same as the F test of a common adjustment: differences of heights against the first point need no datum.
    b = np.column_stack([-np.ones(5), np.eye(5)])
    form = (b @ d) @ np.linalg.solve(b @ q @ b.T, b @ d)
    assert t.statistic == pytest.approx(form / 5 / s2, rel=1e-9)
    assert not t.rejected


@given(st.floats(-5.0, 5.0), st.integers(0, 500))
def test_deformation_does_not_depend_on_the_datum(offset: float, seed: int) -> None:
    d, q, s2, r = levelling_epochs(seed, 0.05)
    base = np.eye(6)
    base[:, 0] -= 1.0  # S-transformation to the datum of the first point
    kept = slice(1, None)
    other = deformation((base @ d)[kept], (base @ q @ base.T)[kept, kept], s2, r)
    assert deformation(d, q, s2, r).statistic == pytest.approx(other.statistic, rel=1e-7)
    shifted = deformation(d + offset, q, s2, r)
    assert shifted.statistic == pytest.approx(other.statistic, rel=1e-6)
    assert ("do not have the same datum" in shifted.note) == (abs(offset) > 1e-6 * np.linalg.norm(d + offset) / np.sqrt(6))


def test_the_moved_point_is_found() -> None:
    d, q, s2, r = levelling_epochs(3, 0.06)
    names = list("ABCDEF")
    found = moved_points(d, q, s2, r, names)
    assert found.moved == ("C",)
    assert found.stable == ("A", "B", "D", "E", "F")
    assert found.decided
    assert [t.df[0] for t in found.steps] == [5.0, 4.0]
    each = deformation_point(d, q, s2, r, names)
    assert each.details["extreme"]["label"] == "C"
    # What the release of a point takes away is its contribution.
    taken = found.steps[0].statistic * 5 - found.steps[1].statistic * 4
    assert each.statistic[2] == pytest.approx(taken, rel=1e-9)


def test_contribution_is_that_of_an_adjustment_with_a_free_shift() -> None:
    d, q = np.random.default_rng(2).standard_normal(9), spd(7, 9)
    t = deformation_point(d, q, 1.0, 30, ["A"] * 3 + ["B"] * 3 + ["C"] * 3)
    w = np.linalg.inv(q)
    for j in range(3):
        b = np.eye(9)[:, 3 * j : 3 * j + 3]
        s = np.linalg.solve(b.T @ w @ b, b.T @ w @ d)
        rest = d - b @ s
        assert t.statistic[j] * 3 == pytest.approx(d @ w @ d - rest @ w @ rest, rel=1e-8)


def test_everything_moved_is_not_decided() -> None:
    rng = np.random.default_rng(4)
    found = moved_points(rng.standard_normal(4), 1e-6 * np.eye(4), 1.0, 20, list("ABCD"))
    assert not found.decided
    assert len(found.moved) == 3


@pytest.mark.parametrize(
    "call",
    [
        lambda: check_points([1.0, 2.0], np.eye(3), 1.0, 5),
        lambda: check_points([1.0], [[0.0]], 1.0, 5),
        lambda: check_point([1.0], [[1.0]], 1.0, 5, []),
        lambda: check_points([1.0], [[1.0]], 1.0, 5, [[1.0, 0.0]]),
        lambda: control_points([1.0], [[1.0]], 1.0, 5, prior=[0.0]),
        lambda: deformation([1.0, 1.0], np.zeros((2, 2)), 1.0, 5),
        lambda: deformation([1.0], [[1.0]], 1.0, 5, defect=1),
        lambda: deformation([], np.zeros((0, 0)), 1.0, 5),
    ],
)
def test_wrong_arguments(call: object) -> None:
    with pytest.raises(UsageError):
        call()  # type: ignore[operator]


def test_larger_defect_than_stated() -> None:
    with pytest.raises(Singular):
        deformation([1.0, -1.0, 0.0], np.diag([1.0, 1.0, 0.0]), 1.0, 5, defect=0)
