"""Check points: adjusted against given coordinates, all together and point by point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from baarda.hypotheses._laws import check_redundancy, check_variance, f_law, f_name, member_laws, same
from baarda.hypotheses._quadratic import factor, point_rows, quadratic_form, vector_and_matrix
from baarda.hypotheses.base import Evidence, Floats, Law, TestResult
from baarda.hypotheses.levels import Options, Policy, check_level, family_result

__all__ = ["check_point", "check_points"]

ORDER = 70
_KNOWN = "The reference has its own covariance; variance factor taken as known: chi-square law."
_APPROXIMATE = (
    "The reference has its own covariance C: d'(s0^2 Q + C)^-1 d / p follows F only approximately; its second degree of freedom is "
    "r p / sum g_i^2, with g_i the share of s0^2 Q in direction i (F(p, r) for an exact reference, chi2(p)/p where C prevails)."
)


def _joint(d: Floats, q: Floats, variance_factor: float, r: float, reference: Floats | None, names: Sequence[str]) -> tuple[float, float]:
    """Return T = d' (s0^2 Q + C)^-1 d / p, and the second degree of freedom of its law."""
    if reference is None:
        return quadratic_form(d, q, names) / (len(d) * variance_factor), r
    ours = variance_factor * q
    total = ours + reference
    s, lower = factor(total, names)
    z = linalg.solve_triangular(lower, d / s, lower=True)
    half = linalg.solve_triangular(lower, ours / s[:, None] / s[None, :], lower=True)
    share = linalg.solve_triangular(lower, half.T, lower=True)  # its eigenvalues are the shares g_i
    return float(z @ z) / len(d), r * len(d) / float((share * share).sum())


def check_points(
    differences: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    reference_covariance: ArrayLike | None = None,
    alpha: float = 0.05,
    names: Sequence[str] = (),
) -> TestResult:
    """Test all check points together: the adjusted coordinates agree with the reference.

    Parameters
    ----------
    differences : (p,) array
        Adjusted - given coordinates.
    cofactors : (p, p) array
        Cofactors Q_SS of the adjusted coordinates.
    variance_factor : float
        s0^2, or sigma0^2 if `redundancy` is infinite.
    redundancy : float
        r.
    reference_covariance : (p, p) array, optional
        Covariance C_S of the reference (a covariance: no variance factor applies); absent: exact.
    alpha : float
        Level.
    names : sequence of str
        Names of the coordinates, for messages.

    Returns
    -------
    TestResult
        d' (s0^2 Q + C_S)^-1 d / p under F(p, r): exact for an exact reference. With C_S the law is approximate and the note says so;
        chi-square(p) / p, exact, if the variance factor is known.

    Raises
    ------
    Singular
        If the coordinates depend on each other.
    RedundancyNotPositive, UsageError
        If r, the variance factor or the shapes make no sense.

    Notes
    -----
    Grün, Photogrammetria 34 (1978) eq. 47-48. The approximation matches the mean of the statistic to first order in 1/r.

    Examples
    --------
    >>> t = check_points([0.02, -0.03, 0.05], [[0.4, 0, 0], [0, 0.4, 0], [0, 0, 0.9]], 0.001, 50)
    >>> t.statistic, t.p_value
    (2.009, 0.1246)
    """
    d, q = vector_and_matrix(differences, cofactors)
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    check_level(alpha)
    c = None if reference_covariance is None else vector_and_matrix(d, reference_covariance, "reference_covariance")[1]
    statistic, second = _joint(d, q, variance_factor, redundancy, c, names)
    b = float(len(d))
    return TestResult(
        "check_points",
        "The adjusted coordinates of the check points agree with the reference.",
        statistic,
        f_law(b, second),
        f_name(b, second),
        alpha,
        df=(b, second) if np.isfinite(second) else (b,),
        note="" if c is None else _APPROXIMATE if np.isfinite(redundancy) else _KNOWN,
        details={"coordinates": len(d), "rms": float(np.sqrt((d * d).mean()))},
    )


def check_point(
    differences: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    groups: Sequence[str],
    reference_covariance: ArrayLike | None = None,
    alpha: float = 0.05,
    levels: Policy = "none",
) -> TestResult:
    """Test each check point: its one to three coordinates together.

    Parameters
    ----------
    differences, cofactors, variance_factor, redundancy, reference_covariance
        As in `check_points`.
    groups : sequence of str
        The point of each coordinate.
    alpha, levels
        See `Options`.

    Returns
    -------
    TestResult
        A family, one test per point in order of first appearance: F(p_i, r), p_i = number of its coordinates. Where the laws differ from
        point to point, the critical value is that of the extreme point.

    Raises
    ------
    Singular, RedundancyNotPositive, UsageError
        As `check_points`; also if the number of groups is not that of the differences.

    Notes
    -----
    Grün (1978) p. 398: after rejection, groups or single coordinates.

    Examples
    --------
    >>> import numpy as np
    >>> t = check_point([0.02, -0.03, 0.05, 0.30], np.diag([0.4, 0.4, 0.9, 0.9]), 0.001, 50, ["7", "7", "7", "8"])
    >>> t.labels, t.rejected
    (('7', '8'), array([False,  True]))
    """
    d, q = vector_and_matrix(differences, cofactors)
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    c = None if reference_covariance is None else vector_and_matrix(d, reference_covariance, "reference_covariance")[1]
    rows = point_rows(groups, len(d))
    statistic, first, second = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    for j, (point, at) in enumerate(rows.items()):
        block = np.ix_(at, at)
        names = [f"point {point}, coordinate {i + 1}" for i in range(len(at))]
        statistic[j], second[j] = _joint(d[at], q[block], variance_factor, redundancy, None if c is None else c[block], names)
        first[j] = len(at)
    law: Law = f_law(first[0], second[0])
    spoken = f_name(first[0], second[0])
    if not (same(first) and same(second)):
        law = member_laws(f_law(first, second), statistic, two_sided=False)
        spoken = "F of the number of coordinates and the redundancy" if np.isfinite(redundancy) else "chi2 / number of coordinates"
    note = "" if c is None else _APPROXIMATE if np.isfinite(redundancy) else _KNOWN
    details = {"coordinates": first.astype(int).tolist(), "df": second.tolist() if np.isfinite(redundancy) else []}
    null = "The adjusted coordinates of the check point agree with the reference."
    return family_result("check_point", null, statistic, law, spoken, alpha, levels, labels=list(rows), note=note, details=details)


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests of all check points and of each."""
    e = evidence.check
    if e is None or len(e.values) == 0 or evidence.vpv <= 0.0:
        return []
    aposteriori = options.sigma == "aposteriori"
    factor0 = evidence.variance_factor if aposteriori else evidence.sigma0_apriori**2
    r = float(evidence.redundancy) if aposteriori else np.inf
    groups = e.groups or e.names
    count = len(set(groups))
    joint = check_points(e.values, e.cofactors, factor0, r, e.reference_covariance, options.global_level(len(e.values)), e.names)
    if count < 3:
        few = f"Only {count} check point{'s' if count > 1 else ''}: little evidence about the whole block. "
        joint = replace(joint, note=(few + joint.note).strip())
    level = options.global_level(max(groups.count(g) for g in set(groups)))
    return [joint, check_point(e.values, e.cofactors, factor0, r, groups, e.reference_covariance, level, options.levels)]
