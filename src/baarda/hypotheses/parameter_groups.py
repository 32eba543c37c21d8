"""Groups of parameters tested together, and the equality of the parameters of several cameras or of two epochs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from baarda.errors import Singular, UsageError
from baarda.hypotheses._estimates import Judged, joined, judged, not_applicable
from baarda.hypotheses._laws import check_redundancy, check_variance, f_law, f_name, member_laws, number, range_name, same
from baarda.hypotheses._quadratic import quadratic_form, ranked_form, variances, vector_and_matrix
from baarda.hypotheses.base import Evidence, Floats, Law, TestResult
from baarda.hypotheses.deformation import pooled_variance_factor
from baarda.hypotheses.levels import Options, Policy, family_result
from baarda.hypotheses.parameters import general_linear
from baarda.hypotheses.variance_factor import variance_ratio

__all__ = ["equal_groups", "equal_parameters", "equal_parameters_of_epochs", "grouped_parameters"]

ORDER = 52
MOST_PAIRS = 10  # cameras of which every pair is tested
MOST_CONDITIONS = 2000

Conditions = tuple[str, Floats]  # label, B


def grouped_parameters(
    values: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    groups: Sequence[str],
    expected: ArrayLike = 0.0,
    alpha: float = 0.05,
    levels: Policy = "none",
    names: Sequence[str] = (),
    name: str = "grouped_parameters",
) -> TestResult:
    """Test groups of parameters: all of a group equal their expected values.

    Parameters
    ----------
    values, cofactors, variance_factor, redundancy, alpha, levels, names, name
        As in `general_linear` and `single_parameter`.
    groups : sequence of str
        The group of each parameter.
    expected : float or (k,) array
        Values under the null hypothesis.

    Returns
    -------
    TestResult
        A family: T = R / (b s0^2) under F(b, r) for each group of b parameters. Where parameters of a group depend on each other, b is the
        number of combinations that are determined; the note says so.

    Raises
    ------
    UsageError
        If shapes do not fit or a cofactor is not positive.
    RedundancyNotPositive
        If r is not positive.

    Notes
    -----
    Grün (1978) eq. 31.

    Examples
    --------
    >>> q = [[1.0, 0.5, 0.0], [0.5, 2.0, 0.0], [0.0, 0.0, 1.0]]
    >>> t = grouped_parameters([1.0, 2.0, 0.1], q, 0.25, 10, ["radial", "radial", "affinity"])
    >>> t.labels, t.statistic
    (('radial', 'affinity'), array([4.57142857, 0.04 ]))
    """
    x, q = vector_and_matrix(values, cofactors)
    variances(q, names)
    if len(groups) != len(x):
        raise UsageError(f"{len(groups)} groups for {len(x)} parameters")
    x = x - np.asarray(expected, dtype=float)
    eye = np.eye(len(x))
    wanted = [(g, eye[[i for i, h in enumerate(groups) if h == g]]) for g in dict.fromkeys(groups)]
    return _family(
        name,
        "The parameters of the group equal their expected values (zero unless stated).",
        wanted,
        x,
        q,
        variance_factor,
        redundancy,
        alpha,
        levels,
    )


def equal_parameters(
    first: ArrayLike,
    cofactors_first: ArrayLike,
    second: ArrayLike,
    cofactors_second: ArrayLike,
    variance_factor: float,
    redundancy: float,
    cross: ArrayLike | None = None,
    alpha: float = 0.05,
    names: Sequence[str] = (),
    name: str = "equal_parameters",
) -> TestResult:
    """Test whether two sets of parameters are equal: of two cameras in one adjustment, or of two epochs.

    Parameters
    ----------
    first, second : (k,) array
        Estimates of the same parameters.
    cofactors_first, cofactors_second : (k, k) array
    variance_factor : float
        s0^2; of two epochs the pooled one: `pooled_variance_factor`.
    redundancy : float
        r, of two epochs their sum; infinite where the variance factor is known.
    cross : (k, k) array, optional
        Cofactors between the first and the second; absent where the two are independent.
    alpha : float
        Level.
    names : sequence of str
        Names of the parameters.
    name : str
        Name of the result.

    Returns
    -------
    TestResult
        T = d' (Q1 + Q2 - Q12 - Q12')^-1 d / (k s0^2) with d = first - second, under F(k, r).

    Raises
    ------
    Singular
        If differences depend on each other.
    UsageError
        If shapes do not fit or a difference has no variance.

    Notes
    -----
    Grün (1978) eq. 29-31 with B = (I, -I).

    Examples
    --------
    >>> t = equal_parameters([1.0, 2.0], [[0.1, 0.0], [0.0, 0.1]], [1.2, 1.5], [[0.1, 0.0], [0.0, 0.1]], 1.0, 50)
    >>> t.statistic, t.df
    (0.725, (2.0, 50.0))
    """
    a, qa = vector_and_matrix(first, cofactors_first)
    b, qb = vector_and_matrix(second, cofactors_second)
    if a.shape != b.shape:
        raise UsageError(f"{len(a)} parameters cannot equal {len(b)}")
    c = np.zeros_like(qa) if cross is None else np.asarray(cross, dtype=float)
    if c.shape != qa.shape:
        raise UsageError(f"the cofactors between the two have shape {c.shape}, not {qa.shape}")
    null = "Both have the same parameters."
    return general_linear(a - b, qa + qb - c - c.T, variance_factor, redundancy, None, alpha, names=names, name=name, null=null)


def equal_parameters_of_epochs(
    first: ArrayLike,
    cofactors_first: ArrayLike,
    factor_first: float,
    redundancy_first: float,
    second: ArrayLike,
    cofactors_second: ArrayLike,
    factor_second: float,
    redundancy_second: float,
    alpha: float = 0.05,
    names: Sequence[str] = (),
    name: str = "equal_epochs",
) -> TestResult:
    """Test whether parameters are equal in two independent adjustments, after the test whether these are equally precise.

    Parameters
    ----------
    first, second : (k,) array
        Estimates of the same parameters.
    cofactors_first, cofactors_second : (k, k) array
    factor_first, factor_second : float
        Variance factors.
    redundancy_first, redundancy_second : float
    alpha : float
        Level of both tests.
    names : sequence of str
        Names of the parameters.
    name : str
        Name of the result.

    Returns
    -------
    TestResult
        Under F(k, r1 + r2) with the pooled variance factor where the variance ratio does not reject; else each epoch by its own factor
        under F(k, the smaller r), which is approximate. The note and ``details["variance_ratio"]`` tell which.

    Raises
    ------
    UsageError, Singular, RedundancyNotPositive
        As `equal_parameters` and `variance_ratio`.

    Notes
    -----
    Grün (1978) p. 399: pooling presumes equal variance factors.

    Examples
    --------
    >>> q = [[0.1, 0.0], [0.0, 0.1]]
    >>> t = equal_parameters_of_epochs([1.0, 2.0], q, 1.0, 30, [1.2, 1.5], q, 1.1, 20)
    >>> t.statistic, t.df
    (0.697, (2.0, 50.0))
    >>> equal_parameters_of_epochs([1.0, 2.0], q, 1.0, 30, [1.2, 1.5], q, 9.0, 20).df
    (2.0, 20.0)
    """
    ratio = variance_ratio(factor_first, redundancy_first, factor_second, redundancy_second, alpha)
    q1, q2 = np.asarray(cofactors_first, dtype=float), np.asarray(cofactors_second, dtype=float)
    if ratio.rejected:
        factor, r = 1.0, float(min(redundancy_first, redundancy_second))
        q1, q2 = factor_first * q1, factor_second * q2
        told = "The variance factors differ: each epoch is judged by its own, with the smaller redundancy; the law is then approximate."
    else:
        factor, r = pooled_variance_factor(factor_first, redundancy_first, factor_second, redundancy_second)
        told = "The variance factors do not differ: both are pooled."
    t = equal_parameters(first, q1, second, q2, factor, r, None, alpha, names, name)
    judged_by = {"statistic": ratio.statistic, "p_value": ratio.p_value, "rejected": bool(ratio.rejected)}
    return replace(t, note=joined(told, t.note), details={**t.details, "variance_ratio": judged_by})


def equal_groups(
    values: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    groups: Sequence[str],
    parameters: Sequence[str],
    by: str = "parameter",
    alpha: float = 0.05,
    levels: Policy = "none",
    name: str = "equal_groups",
) -> TestResult:
    """Test the equality of the parameters of several groups (cameras): together, by parameter, or by pair of groups.

    Parameters
    ----------
    values, cofactors, variance_factor, redundancy, alpha, levels, name
        As in `general_linear` and `single_parameter`.
    groups, parameters : sequence of str
        Group (camera) and parameter name of each value.
    by : {"all", "parameter", "pair"}
        One test of all; one for each parameter over all groups; one for each pair of groups over all parameters.

    Returns
    -------
    TestResult
        A family under F(b, r); with "all" it has one member.

    Raises
    ------
    UsageError
        If no parameter belongs to two groups, or arguments do not fit.

    Notes
    -----
    Grün (1978) eq. 31; Ebner (1976) tests first whether groups of additional parameters differ.

    Examples
    --------
    >>> t = equal_groups([1.0, 1.4, 5.0, 5.1], np.eye(4) * 0.02, 1.0, 40, "ABAB", ["K1", "K1", "K2", "K2"])
    >>> t.labels, t.statistic
    (('K1', 'K2'), array([4.  , 0.25]))
    """
    x, q = vector_and_matrix(values, cofactors)
    if len(groups) != len(x) or len(parameters) != len(x):
        raise UsageError(f"{len(groups)} groups and {len(parameters)} parameters for {len(x)} values")
    wanted = _contrasts(groups, parameters, by)
    if not wanted:
        raise UsageError("no parameter belongs to two groups: nothing to compare")
    nulls = {
        "all": "Every parameter is the same in all groups.",
        "parameter": "The parameter is the same in all groups.",
        "pair": "Both groups have the same parameters.",
    }
    return _family(name, nulls[by], wanted, x, q, variance_factor, redundancy, alpha, levels)


def _contrasts(groups: Sequence[str], parameters: Sequence[str], by: str) -> list[Conditions]:
    """Return the label and the matrix B of each hypothesis: differences to the first group that has the parameter."""
    n = len(groups)
    rows: dict[str, list[int]] = {}
    for i, p in enumerate(parameters):
        rows.setdefault(p, []).append(i)
    eye = np.eye(n)
    if by in ("all", "parameter"):
        each = [(p, eye[at[:1]] - eye[at[1:]]) for p, at in rows.items() if len(at) > 1]
        return each if by == "parameter" or not each else [("all groups", np.concatenate([b for _, b in each]))]
    if by != "pair":
        raise UsageError(f"by is 'all', 'parameter' or 'pair', not {by!r}")
    place = {(groups[i], parameters[i]): i for i in range(n)}
    out = []
    for a, b in combinations(dict.fromkeys(groups), 2):
        shared = [p for p in rows if (a, p) in place and (b, p) in place]
        if shared:
            out.append((f"{a}, {b}", np.stack([eye[place[a, p]] - eye[place[b, p]] for p in shared])))
    return out


def _family(
    name: str,
    null: str,
    wanted: Sequence[Conditions],
    x: Floats,
    q: Floats,
    variance_factor: float,
    redundancy: float,
    alpha: float,
    levels: Policy,
) -> TestResult:
    """Return the family of the hypotheses B x = 0, each over the part that its cofactors determine."""
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    statistic, ranks, partly, nothing = [], [], [], []
    for label, b in wanted:
        d, m = b @ x, b @ q @ b.T
        form, rank = _form(d, m)
        if rank == 0:
            nothing.append(label)
            statistic.append(np.nan)
        else:
            statistic.append(form / (rank * variance_factor))
        if 0 < rank < len(d):
            partly.append(f"{label} ({rank} of {len(d)} combinations are determined)")
        ranks.append(max(rank, 1))
    note = joined(
        f"Tested in part: {'; '.join(partly)}." if partly else "",
        f"Not applicable to {', '.join(nothing)}: the cofactors are zero." if nothing else "",
    )
    values, df = np.array(statistic), np.array(ranks, dtype=float)
    if same(df):
        law: Law = f_law(df[0], redundancy)
        spoken = f_name(df[0], redundancy)
    elif np.isinf(redundancy):
        law, spoken = member_laws(f_law(df, redundancy), values, False), f"{range_name('chi2', df)} / b"
    else:
        law = member_laws(f_law(df, redundancy), values, False)
        spoken = f"F({number(df.min())} .. {number(df.max())}, {number(redundancy)})"
    numbers: tuple[float, ...] = ()
    if same(df):
        numbers = (float(df[0]), float(redundancy)) if np.isfinite(redundancy) else (float(df[0]),)
    labels = [label for label, _ in wanted]
    return family_result(name, null, values, law, spoken, alpha, levels, labels=labels, df=numbers, note=note, details={"ranks": ranks})


def _form(d: Floats, m: Floats) -> tuple[float, int]:
    """Return d' M^-1 d and the rank of M; over what M determines, where it is singular."""
    variance = np.diagonal(m)
    if (variance > 0.0).all():
        with suppress(Singular):
            return quadratic_form(d, m), len(d)
    return ranked_form(d, m) if (variance > 0.0).any() else (0.0, 0)


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return, where there are several cameras, the tests of each camera's additional parameters and of their equality."""
    j = judged(evidence, options)
    if j is None or len(dict.fromkeys(j.estimates.groups)) < 2:
        return []
    e = j.estimates
    names = [n.removeprefix(f"camera {g}: ") for n, g in zip(e.names, e.groups, strict=True)]
    alpha, policy = options.alpha, options.levels
    given = (e.values, e.cofactors, j.variance_factor, j.redundancy)
    cameras = [f"camera {g}" for g in e.groups]
    results = [grouped_parameters(*given, cameras, 0.0, alpha, policy, e.names, "additional_parameters_of_camera")]
    return [*results, *_equality(j, cameras, names, alpha, policy)]


def _equality(j: Judged, cameras: Sequence[str], names: Sequence[str], alpha: float, policy: Policy) -> list[TestResult]:
    e = j.estimates
    conditions = sum(names.count(p) - 1 for p in dict.fromkeys(names))
    if not conditions:
        return []
    name, null = "equal_cameras", "Every parameter is the same in all groups."
    if conditions > MOST_CONDITIONS:
        reason = (
            f"{conditions} conditions of equality exceed the limit of {MOST_CONDITIONS}; test the cameras of interest by equal_parameters"
        )
        return [not_applicable(name, null, reason, alpha, j.redundancy)]
    given = (e.values, e.cofactors, j.variance_factor, j.redundancy, cameras, names)
    results = [
        equal_groups(*given, "all", alpha, policy, name),
        equal_groups(*given, "parameter", alpha, policy, "equal_camera_parameter"),
    ]
    if 2 < len(dict.fromkeys(cameras)) <= MOST_PAIRS:
        results.append(equal_groups(*given, "pair", alpha, policy, "equal_camera_pair"))
    return results
