"""Deformation: whether the points of two epochs are congruent, and which have moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from baarda.errors import Singular, UsageError
from baarda.hypotheses._laws import check_redundancy, check_variance, f_law, f_name, member_laws, same
from baarda.hypotheses._quadratic import point_rows, vector_and_matrix
from baarda.hypotheses.base import Evidence, Floats, Law, TestResult
from baarda.hypotheses.levels import Options, Policy, check_level, family_result

__all__ = ["Localisation", "deformation", "deformation_point", "moved_points", "pooled_variance_factor"]

ORDER = 90
# Eigenvalues of the scaled cofactor matrix below it belong to the datum that both epochs share.
_DATUM = 1e-9


def pooled_variance_factor(first: float, df_first: float, second: float, df_second: float) -> tuple[float, float]:
    """Return the variance factor of two independent epochs together, and its degrees of freedom.

    Parameters
    ----------
    first, second : float
        Variance factors of the epochs.
    df_first, df_second : float
        Their redundancies.

    Returns
    -------
    tuple of float
        ((Omega_1 + Omega_2) / (r_1 + r_2), r_1 + r_2).

    Raises
    ------
    RedundancyNotPositive
        If there is no redundancy at all.

    Notes
    -----
    Grün (1978) p. 399; test the equality first: `variance_ratio`.

    Examples
    --------
    >>> pooled_variance_factor(1.0, 30, 2.0, 10)
    (1.25, 40)
    """
    check_redundancy(df_first + df_second)
    return (first * df_first + second * df_second) / (df_first + df_second), df_first + df_second


def _weights(d: Floats, q: Floats, defect: int | None) -> tuple[Floats, int, float]:
    """Return the pseudo-inverse of Q (scaled), its rank, and the share of d that lies outside of Q's range."""
    diagonal = np.diagonal(q)
    # One scale for all keeps the null space of the datum what it is.
    scale = float(np.sqrt(diagonal.max(initial=0.0)))
    if scale == 0.0:
        raise UsageError("all cofactors are zero: nothing is known about the differences")
    value, vectors = linalg.eigh(q / scale**2)
    known = value > _DATUM * value[-1]
    if defect is not None:
        if not 0 <= defect < len(d):
            raise UsageError(f"a datum defect of {defect} makes no sense for {len(d)} coordinates")
        known = np.arange(len(d)) >= defect
        if (value[known] <= 0.0).any():
            raise Singular(f"the cofactors have a larger defect than {defect}")
    part = vectors[:, known]
    outside = d - part @ (part.T @ d)
    norm = float(np.linalg.norm(d))
    weights = (part / value[known]) @ part.T / scale**2
    return np.asarray(weights), int(known.sum()), float(np.linalg.norm(outside)) / norm if norm else 0.0


def _prepared(
    differences: ArrayLike, cofactors: ArrayLike, variance_factor: float, redundancy: float, defect: int | None
) -> tuple[Floats, Floats, int, float]:
    d, q = vector_and_matrix(differences, cofactors)
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    weights, rank, outside = _weights(d, q, defect)
    return d, weights, rank, outside


def deformation(
    differences: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    alpha: float = 0.05,
    defect: int | None = None,
) -> TestResult:
    """Test whether the points of two epochs are congruent.

    Parameters
    ----------
    differences : (k,) array
        Coordinates of the second minus those of the first epoch, both in one datum.
    cofactors : (k, k) array
        Cofactors of the differences; Q_I + Q_II for independent epochs. Singular where both epochs have the same inner datum.
    variance_factor : float
        s0^2 of the joint adjustment, or pooled; sigma0^2 if `redundancy` is infinite.
    redundancy : float
        r of the joint adjustment, r_I + r_II of independent ones.
    alpha : float
        Level.
    defect : int, optional
        Datum defect of the cofactors; absent: counted from their eigenvalues.

    Returns
    -------
    TestResult
        d' Q^+ d / (h s0^2) under F(h, r), h = rank of Q.

    Raises
    ------
    Singular
        If the defect is larger than stated.
    RedundancyNotPositive, UsageError
        If r, the variance factor or the shapes make no sense.

    Notes
    -----
    Grün, Photogrammetria 34 (1978) eq. 54-55; H. Pelzer, Zur Analyse geodätischer Deformationsmessungen, DGK C 164 (1971).

    Examples
    --------
    >>> t = deformation([0.01, -0.02, 0.01], [[2, -1, -1], [-1, 2, -1], [-1, -1, 2]], 1e-4, 25)
    >>> t.df, t.statistic
    ((2.0, 25.0), 1.0)
    """
    check_level(alpha)
    d, weights, h, outside = _prepared(differences, cofactors, variance_factor, redundancy, defect)
    note = f"{len(d) - h} datum directions are not tested." if h < len(d) else ""
    if outside > 1e-6:
        note += f" A share of {outside:.2g} of the differences lies in these directions: the epochs do not have the same datum."
    return TestResult(
        "deformation",
        "The points of the two epochs are congruent: nothing has moved.",
        float(d @ weights @ d) / (h * variance_factor),
        f_law(h, redundancy),
        f_name(h, redundancy),
        alpha,
        df=(float(h), float(redundancy)) if np.isfinite(redundancy) else (float(h),),
        note=note.strip(),
        details={"coordinates": len(d), "rank": h},
    )


def deformation_point(
    differences: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    groups: Sequence[str],
    alpha: float = 0.05,
    levels: Policy = "none",
    defect: int | None = None,
) -> TestResult:
    """Test of each point whether it has moved against all others.

    Parameters
    ----------
    differences, cofactors, variance_factor, redundancy, defect
        As in `deformation`.
    groups : sequence of str
        The point of each coordinate.
    alpha, levels
        See `Options`.

    Returns
    -------
    TestResult
        A family: the part of d' Q^+ d that vanishes when the point may move, by its p_i coordinates and s0^2, under F(p_i, r). It does not
        depend on the datum.

    Raises
    ------
    Singular, RedundancyNotPositive, UsageError
        As `deformation`; also if the number of groups is not that of the differences.

    Notes
    -----
    Pelzer (1971): decomposition of the quadratic form.

    Examples
    --------
    >>> t = deformation_point([0.01, -0.20, 0.01], [[2, -1, -1], [-1, 2, -1], [-1, -1, 2]], 1e-3, 25, ["A", "B", "C"])
    >>> t.details["extreme"]["label"]
    'B'
    """
    d, weights, _, _ = _prepared(differences, cofactors, variance_factor, redundancy, defect)
    rows = point_rows(groups, len(d))
    return _contributions(d, weights, rows, variance_factor, redundancy, alpha, levels)


def _contributions(
    d: Floats, weights: Floats, rows: dict[str, list[int]], variance_factor: float, redundancy: float, alpha: float, levels: Policy
) -> TestResult:
    pull = weights @ d
    size = np.array([len(at) for at in rows.values()], dtype=float)
    form = np.empty(len(rows))
    for j, (point, at) in enumerate(rows.items()):
        block = weights[np.ix_(at, at)]
        try:
            form[j] = pull[at] @ linalg.solve(block, pull[at], assume_a="pos")
        except linalg.LinAlgError:
            raise Singular(f"point {point} cannot be tested: the other points do not control it", (point,)) from None
    statistic = form / (size * variance_factor)
    law: Law = f_law(size[0], redundancy) if same(size) else member_laws(f_law(size, redundancy), statistic, two_sided=False)
    spoken = f_name(size[0], redundancy) if same(size) else "F of the number of coordinates and the redundancy"
    null = "The point has not moved against the others."
    df = (float(size[0]), float(redundancy)) if same(size) and np.isfinite(redundancy) else ()
    return family_result("deformation_point", null, statistic, law, spoken, alpha, levels, labels=list(rows), df=df)


@dataclass(frozen=True)
class Localisation:
    """Which points have moved.

    Attributes
    ----------
    moved : tuple of str
        Points found to have moved, in the order found.
    stable : tuple of str
        Points that are congruent.
    steps : tuple of TestResult
        The congruence test of the points still held stable, before each step and after the last.
    decided : bool
        Whether the last of these tests accepts; False if too few points were left to go on.
    """

    moved: tuple[str, ...]
    stable: tuple[str, ...]
    steps: tuple[TestResult, ...]
    decided: bool


def moved_points(
    differences: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    groups: Sequence[str],
    alpha: float = 0.05,
    defect: int | None = None,
) -> Localisation:
    """Find the points that moved: the point with the largest contribution is released until the others are congruent.

    Parameters
    ----------
    differences, cofactors, variance_factor, redundancy, groups, alpha, defect
        As in `deformation_point`.

    Returns
    -------
    Localisation

    Raises
    ------
    Singular, RedundancyNotPositive, UsageError
        As `deformation_point`.

    Notes
    -----
    Pelzer (1971): the weights of the points that stay are the Schur complement of all weights.

    Examples
    --------
    >>> moved_points([0.01, -0.30, 0.02, 0.0], 2.0 * np.eye(4) - 0.5, 1e-3, 25, list("ABCD")).moved
    ('B',)
    """
    check_level(alpha)
    d, weights, h, _ = _prepared(differences, cofactors, variance_factor, redundancy, defect)
    rows = point_rows(groups, len(d))
    moved: list[str] = []
    steps: list[TestResult] = []
    while True:
        null = f"The {len(rows)} points held stable are congruent."
        df = (float(h), float(redundancy)) if np.isfinite(redundancy) else (float(h),)
        form = float(d @ weights @ d) / (h * variance_factor)
        steps.append(TestResult("deformation", null, form, f_law(h, redundancy), f_name(h, redundancy), alpha, df=df))
        if not steps[-1].rejected:
            return Localisation(tuple(moved), tuple(rows), tuple(steps), True)
        family = _contributions(d, weights, rows, variance_factor, redundancy, alpha, "none")
        # The smallest p-value; among several that are zero in floating point, the largest contribution per coordinate.
        p, size = np.asarray(family.p_value), np.asarray(family.statistic)
        worst = family.labels[int(np.lexsort((-size, p))[0])]
        if h - len(rows[worst]) < 1:
            return Localisation(tuple(moved), tuple(rows), tuple(steps), False)
        moved.append(worst)
        h -= len(rows[worst])
        d, weights, rows = _released(d, weights, rows, worst)


def _released(d: Floats, weights: Floats, rows: dict[str, list[int]], point: str) -> tuple[Floats, Floats, dict[str, list[int]]]:
    """Return the problem of the points that stay when one may move freely: the Schur complement of its weights."""
    out = rows[point]
    kept = [i for i in range(len(d)) if i not in set(out)]
    block = weights[np.ix_(kept, out)]
    reduced = weights[np.ix_(kept, kept)] - block @ linalg.solve(weights[np.ix_(out, out)], block.T, assume_a="pos")
    place = {old: new for new, old in enumerate(kept)}
    return d[kept], np.asarray((reduced + reduced.T) / 2.0), {g: [place[i] for i in at] for g, at in rows.items() if g != point}


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return no test: one adjustment is one epoch; the comparison of two calls `deformation`."""
    return []
