"""Control points that enter as observations: are the given coordinates free of errors, all together and point by point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses._laws import BoundedLaw, check_redundancy, check_variance, f_law, f_name, member_laws, number, same
from baarda.hypotheses._quadratic import point_rows, ranked_form, vector_and_matrix
from baarda.hypotheses.base import Evidence, Floats, Law, TestResult
from baarda.hypotheses.levels import Options, Policy, check_level, family_result

__all__ = ["control_point", "control_points"]

ORDER = 60


def _checked(
    residuals: ArrayLike, cofactors: ArrayLike, variance_factor: float, redundancy: float, prior: ArrayLike | None
) -> tuple[Floats, Floats, Floats | None]:
    """Return the residuals, their cofactors and the a-priori sigmas, or raise."""
    v, q = vector_and_matrix(residuals, cofactors)
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    if prior is None:
        return v, q, None
    s = np.asarray(prior, dtype=float)
    s = np.sqrt(np.diagonal(s)) if s.ndim == 2 else np.sqrt(s)
    if s.shape != v.shape or not (s > 0.0).all():
        raise UsageError("the prior cofactors must be positive, one per control coordinate")
    return v, q, s


def control_points(
    residuals: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    alpha: float = 0.05,
    prior: ArrayLike | None = None,
) -> TestResult:
    """Test all weighted control coordinates together: the given coordinates are right.

    Parameters
    ----------
    residuals : (d,) array
        v = adjusted - given control coordinates.
    cofactors : (d, d) array
        Cofactors Qvv of these residuals; singular if the control defines the datum.
    variance_factor : float
        s0^2 of the same adjustment, or sigma0^2 if `redundancy` is infinite.
    redundancy : float
        r.
    alpha : float
        Level.
    prior : (d,) or (d, d) array, optional
        A-priori cofactors of the given coordinates: directions in which Qvv is less than 1e-8 of them cannot be tested. Absent: judged by
        Qvv itself.

    Returns
    -------
    TestResult
        T = R / (b s0^2), R = v' Qvv^+ v and b = rank of Qvv, under (r / b) Beta(b/2, (r - b)/2), since R is a part of v'Pv.
        `details` has the equivalent (r - b) R / (b (v'Pv - R)) and its F(b, r - b).

    Raises
    ------
    RedundancyNotPositive
        If r is not positive.
    UsageError
        If the shapes make no sense, or no control coordinate is controlled by the others.

    Notes
    -----
    Grün, Photogrammetria 34 (1978) eq. 50-52, who takes F(d, r); but residuals of control that takes part in the
    adjustment are a part of s0^2.

    Examples
    --------
    >>> t = control_points([0.02, -0.05], [[0.5, 0.1], [0.1, 0.4]], 0.002, 40)
    >>> t.statistic, t.p_value
    (2.118, 0.1192)
    """
    check_level(alpha)
    v, q, s = _checked(residuals, cofactors, variance_factor, redundancy, prior)
    form, b = ranked_form(v, q, s)
    if b == 0:
        raise UsageError("no control coordinate is controlled by another observation")
    null = "The given coordinates of the control points are right."
    note = f"{len(v) - b} of {len(v)} combinations of control coordinates define the datum and cannot be tested." if b < len(v) else ""
    statistic = form / (b * variance_factor)
    if np.isinf(redundancy):
        return TestResult("control_points", null, statistic, f_law(b, redundancy), f_name(b, redundancy), alpha, df=(float(b),), note=note)
    rest, freedom = redundancy * variance_factor - form, redundancy - b
    details: dict[str, Any] = {"rank": b, "coordinates": len(v)}
    if freedom > 0 and rest > 0.0:
        f = form / b / (rest / freedom)
        details = {**details, "F": f, "F_df": [float(b), float(freedom)], "F_critical": float(stats.f.isf(alpha, b, freedom))}
    elif freedom <= 0:
        note = f"{note} Only the control is redundant: its scale is s0 itself, so that nothing can be tested.".strip()
    spoken = f"{number(redundancy)}/{b} Beta({number(b / 2)}, {number(max(freedom, 0) / 2)})"
    law = BoundedLaw(float(b), float(redundancy))
    return TestResult("control_points", null, statistic, law, spoken, alpha, df=(float(b), float(redundancy)), note=note, details=details)


def control_point(
    residuals: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    groups: Sequence[str],
    alpha: float = 0.05,
    levels: Policy = "none",
    prior: ArrayLike | None = None,
) -> TestResult:
    """Test each weighted control point: its coordinates together.

    Parameters
    ----------
    residuals, cofactors, variance_factor, redundancy, prior
        As in `control_points`.
    groups : sequence of str
        The point of each coordinate.
    alpha, levels
        See `Options`.

    Returns
    -------
    TestResult
        A family, one test per point in order of first appearance; NaN where a point is uncontrolled. Where the laws differ from point to
        point, the critical value is that of the extreme point.

    Raises
    ------
    RedundancyNotPositive, UsageError
        As `control_points`; also if the number of groups is not that of the residuals.

    Notes
    -----
    Grün (1978) p. 399: with control weights that are not too small the single tests are nearly independent.

    Examples
    --------
    >>> import numpy as np
    >>> control_point([0.01, -0.20], np.diag([0.5, 0.4]), 0.002, 40, ["A", "B"]).rejected
    array([False,  True])
    """
    v, q, s = _checked(residuals, cofactors, variance_factor, redundancy, prior)
    if s is None:
        # Shares are judged against the largest cofactor: a point alone cannot tell that it is uncontrolled.
        s = np.full(len(v), np.sqrt(max(float(np.diagonal(q).max()), np.finfo(float).tiny)))
    rows = point_rows(groups, len(v))
    statistic, rank = np.full(len(rows), np.nan), np.ones(len(rows))
    for j, at in enumerate(rows.values()):
        form, b = ranked_form(v[at], q[np.ix_(at, at)], s[at])
        if b:
            statistic[j], rank[j] = form / (b * variance_factor), b
    law: Law = f_law(rank, redundancy) if np.isinf(redundancy) else BoundedLaw(rank, float(redundancy))
    spoken = "chi2 / rank" if np.isinf(redundancy) else f"{number(redundancy)}/b Beta(b/2, ({number(redundancy)} - b)/2), b = rank"
    if same(rank):
        law = f_law(rank[0], redundancy) if np.isinf(redundancy) else BoundedLaw(float(rank[0]), float(redundancy))
    else:
        law = member_laws(law, statistic, two_sided=False)
    unseen = int(np.isnan(statistic).sum())
    note = f"{unseen} uncontrolled control points cannot be tested." if unseen else ""
    null = "The given coordinates of the control point are right."
    details = {"ranks": rank.astype(int).tolist(), "uncontrolled": unseen}
    return family_result("control_point", null, statistic, law, spoken, alpha, levels, labels=list(rows), note=note, details=details)


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests of all control points and of each; none where no control coordinate is controlled by other observations."""
    e = evidence.control
    if e is None or len(e.values) == 0 or evidence.vpv <= 0.0:
        return []
    aposteriori = options.sigma == "aposteriori"
    factor0 = evidence.variance_factor if aposteriori else evidence.sigma0_apriori**2
    r = float(evidence.redundancy) if aposteriori else np.inf
    prior = None if e.reference_covariance is None else e.reference_covariance / evidence.sigma0_apriori**2
    values, cofactors, s = _checked(e.values, e.cofactors, factor0, r, prior)
    if ranked_form(values, cofactors, s)[1] == 0:
        return []
    groups = e.groups or e.names
    joint = control_points(values, cofactors, factor0, r, options.global_level(len(values)), prior)
    level = options.global_level(max(groups.count(g) for g in set(groups)))
    return [joint, control_point(values, cofactors, factor0, r, groups, level, options.levels, prior)]
