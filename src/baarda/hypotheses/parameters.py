"""General linear hypothesis, and the tests of additional parameters: all, single, pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from baarda.errors import Singular, UsageError
from baarda.hypotheses._estimates import Judged, joined, judged, not_applicable
from baarda.hypotheses._laws import check_redundancy, check_variance, f_law, f_name, number
from baarda.hypotheses._quadratic import quadratic_form, ranked_form, variances, vector_and_matrix
from baarda.hypotheses.base import Evidence, Floats, Law, TestResult
from baarda.hypotheses.levels import Options, Policy, check_level, family_result

__all__ = ["bivariate_parameters", "general_linear", "single_parameter"]

ORDER = 50


def general_linear(
    values: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    hypothesis: Any = None,
    alpha: float = 0.05,
    *,
    names: Sequence[str] = (),
    name: str = "general_linear",
    null: str = "",
) -> TestResult:
    """Test the general linear hypothesis H0: B x = w.

    Parameters
    ----------
    values : (u,) array
        Estimates x.
    cofactors : (u, u) array
        Their cofactor matrix Qxx.
    variance_factor : float
        s0^2 of the adjustment, or sigma0^2 if `redundancy` is infinite.
    redundancy : float
        r; infinite where the variance factor is known.
    hypothesis : None, (b, u) array, (u,) array, or pair (B, w)
        None: x = 0. A matrix: B x = 0. A vector: x = these values. A pair: B x = w.
    alpha : float
        Level.
    names : sequence of str
        Names of the values, for messages.
    name, null : str
        Name and null hypothesis of the result.

    Returns
    -------
    TestResult
        T = (Bx - w)' (B Qxx B')^-1 (Bx - w) / (b s0^2) under F(b, r).

    Raises
    ------
    Singular
        If the rows of B, or the values, depend on each other.
    RedundancyNotPositive
        If r is not positive.
    UsageError
        If shapes do not fit or a variance is not positive.

    Notes
    -----
    Grün, Photogrammetria 34 (1978) eq. 31. The form is ||L^-1 (Bx - w)||^2 with the Cholesky factor L of B Qxx B'.

    Examples
    --------
    >>> t = general_linear([1.0, 2.0], [[1.0, 0.5], [0.5, 2.0]], 0.25, 10)
    >>> t.statistic, t.p_value
    (4.571, 0.0389)
    """
    x, q = vector_and_matrix(values, cofactors)
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    check_level(alpha)
    d, m = _apply(hypothesis, x, q)
    labels = tuple(names) if len(d) == len(x) else tuple(f"condition {i + 1}" for i in range(len(d)))
    b = len(d)
    return TestResult(
        name,
        null or ("The estimates satisfy B x = w." if hypothesis is not None else "The expectation of all estimates is zero."),
        quadratic_form(d, m, labels) / (b * variance_factor),
        f_law(b, redundancy),
        f_name(b, redundancy),
        alpha,
        "right",
        (float(b), float(redundancy)) if np.isfinite(redundancy) else (float(b),),
    )


def _apply(hypothesis: Any, x: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Return Bx - w and B Q B'."""
    if hypothesis is None:
        return x, q
    if isinstance(hypothesis, tuple):
        if len(hypothesis) != 2:
            raise UsageError("a hypothesis is a pair (B, w)")
        matrix = np.atleast_2d(np.asarray(hypothesis[0], dtype=float))
        w = np.atleast_1d(np.asarray(hypothesis[1], dtype=float))
    else:
        given = np.asarray(hypothesis, dtype=float)
        matrix, w = (given, np.zeros(len(given))) if given.ndim == 2 else (np.eye(len(x)), np.atleast_1d(given))
    if matrix.shape[1] != len(x) or w.shape != (len(matrix),):
        raise UsageError(f"the hypothesis B x = w has shapes {matrix.shape} and {w.shape} for {len(x)} values")
    return matrix @ x - w, matrix @ q @ matrix.T


def single_parameter(
    values: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    expected: ArrayLike = 0.0,
    alpha: float = 0.05,
    levels: Policy = "none",
    names: Sequence[str] = (),
    name: str = "single_parameter",
) -> TestResult:
    """Test each parameter on its own: two-sided t.

    Parameters
    ----------
    values : (k,) array
        Estimates.
    cofactors : (k,) or (k, k) array
        Their cofactors: the diagonal, or the matrix.
    variance_factor : float
        s0^2, or sigma0^2 if `redundancy` is infinite.
    redundancy : float
        r.
    expected : float or (k,) array
        Values under the null hypothesis.
    alpha : float
        Level of a single test, or of the family if `levels` says so.
    levels : str
        See `Options.levels`; Šidák's is Grün's eq. 41.
    names : sequence of str
        Names of the parameters.
    name : str
        Name of the result.

    Returns
    -------
    TestResult
        A family: (x_i - x_i0) / (s0 sqrt(q_ii)) under t(r).

    Raises
    ------
    UsageError
        If a cofactor is not positive: a fixed parameter cannot be tested.
    RedundancyNotPositive
        If r is not positive.

    Notes
    -----
    Grün (1978) eq. 40; its square is F of eq. 8 in Wu et al. (2000). Correlated parameters mislead it: see `bivariate_parameters`.

    Examples
    --------
    >>> single_parameter([1.0, 0.1], [0.04, 0.04], 1.0, 20).p_value
    array([6.87e-05, 6.23e-01])
    """
    x = np.atleast_1d(np.asarray(values, dtype=float))
    q = np.asarray(cofactors, dtype=float)
    q = variances(q if q.ndim == 2 else np.diag(np.atleast_1d(q)), names)
    if q.shape != x.shape:
        raise UsageError(f"{len(q)} cofactors for {len(x)} values")
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    statistic = (x - np.asarray(expected, dtype=float)) / np.sqrt(variance_factor * q)
    law, spoken = _t_law(redundancy)
    df = (float(redundancy),) if np.isfinite(redundancy) else ()
    labels = tuple(names) or tuple(f"parameter {i + 1}" for i in range(len(x)))
    null = "The parameter equals its expected value (zero unless stated)."
    return family_result(name, null, statistic, law, spoken, alpha, levels, labels=labels, tail="two-sided", df=df)


def _t_law(redundancy: float) -> tuple[Law, str]:
    return (stats.norm(), "N(0, 1)") if np.isinf(redundancy) else (stats.t(redundancy), f"t({number(redundancy)})")


def bivariate_parameters(
    values: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    limit: float = 0.95,
    alpha: float = 0.05,
    levels: Policy = "none",
    names: Sequence[str] = (),
    name: str = "bivariate_parameters",
) -> TestResult:
    """Test pairs of highly correlated parameters together.

    Parameters
    ----------
    values, cofactors, variance_factor, redundancy, alpha, levels, names, name
        As in `general_linear` and `single_parameter`; at least two values.
    limit : float
        Pairs whose |correlation| reaches it are tested; if none does, the most correlated pair is.

    Returns
    -------
    TestResult
        A family: T = (q_ll x_k^2 - 2 q_kl x_k x_l + q_kk x_l^2) / (2 s0^2 (q_kk q_ll - q_kl^2)) under F(2, r). `details` has the
        correlations, and the pairs that are perfectly correlated and cannot be tested.

    Raises
    ------
    UsageError
        If there are fewer than two parameters, or a cofactor is not positive.
    Singular
        If all selected pairs are perfectly correlated.

    Notes
    -----
    Grün (1978) eq. 43.

    Examples
    --------
    >>> t = bivariate_parameters([1.0, -0.9], [[1.0, -0.99], [-0.99, 1.0]], 0.5, 30)
    >>> t.statistic, t.labels
    (array([1.41]), ('parameter 1, parameter 2',))
    """
    x, q = vector_and_matrix(values, cofactors)
    if len(x) < 2:
        raise UsageError("a bivariate test needs two parameters")
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    s = np.sqrt(variances(q, names))
    z, c = x / s, q / s[:, None] / s[None, :]
    k, m = np.triu_indices(len(x), 1)
    size = np.abs(c[k, m])
    chosen = size >= limit
    note = ""
    if not chosen.any():
        chosen = np.arange(len(size)) == int(np.argmax(size))
        note = f"No pair reaches the correlation {limit:g}; the most correlated one is tested."
    words = tuple(names) or tuple(f"parameter {i + 1}" for i in range(len(x)))
    alike = chosen & (1.0 - size < 1e-12)
    perfect = [f"{words[i]}, {words[j]}" for i, j in zip(k[alike], m[alike], strict=True)]
    k, m = k[chosen & ~alike], m[chosen & ~alike]
    if len(k) == 0:
        raise Singular("the parameters are perfectly correlated and cannot be told apart: " + "; ".join(perfect), tuple(words))
    rho = c[k, m]
    # With whitened sum and difference nothing cancels at high correlation.
    form = ((z[k] + z[m]) ** 2 / (1.0 + rho) + (z[k] - z[m]) ** 2 / (1.0 - rho)) / 2.0
    if perfect:
        note = f"{note} Perfectly correlated, not testable: {'; '.join(perfect)}.".strip()
    return family_result(
        name,
        "Both parameters of the pair are zero.",
        form / (2.0 * variance_factor),
        f_law(2, redundancy),
        f_name(2, redundancy),
        alpha,
        levels,
        labels=[f"{words[i]}, {words[j]}" for i, j in zip(k, m, strict=True)],
        df=(2.0, float(redundancy)) if np.isfinite(redundancy) else (2.0,),
        note=note,
        details={"correlations": [float(v) for v in rho], "limit": float(limit), "perfectly_correlated": perfect},
    )


def _all_parameters(j: Judged, options: Options) -> TestResult:
    """Return the joint test; where parameters depend on each other, of the combinations that are determined."""
    name, null, e = "all_additional_parameters", "All additional parameters are zero.", j.estimates
    level, r = options.global_level(len(e.values)), j.redundancy
    try:
        found = general_linear(e.values, e.cofactors, j.variance_factor, r, None, level, names=e.names, name=name, null=null)
        return replace(found, note=j.note)
    except Singular as error:
        form, rank = ranked_form(*vector_and_matrix(e.values, e.cofactors), np.sqrt(np.diagonal(e.cofactors)))
        df = (float(rank), r) if np.isfinite(r) else (float(rank),)
        note = joined(f"Tested are the {rank} of {len(e.values)} combinations that are determined: {error}.", j.note)
        level = options.global_level(rank)
        return TestResult(name, null, form / (rank * j.variance_factor), f_law(rank, r), f_name(rank, r), level, df=df, note=note)


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests of the additional parameters: all, single, pairs."""
    j = judged(evidence, options)
    if j is None:
        return []
    e, r, policy = j.estimates, j.redundancy, options.levels
    alpha = options.global_level(1)
    name, null = "additional_parameter", "The parameter equals its expected value (zero unless stated)."
    if not len(e.values):
        return [not_applicable(name, null, "the cofactors of all additional parameters are zero", alpha, r, j.left_out)]
    single = single_parameter(e.values, e.cofactors, j.variance_factor, r, 0.0, alpha, policy, e.names, name)
    results = [_all_parameters(j, options), replace(single, note=joined(single.note, j.note))]
    return results if len(e.values) < 2 else [*results, _pairs(j, options)]


def _pairs(j: Judged, options: Options) -> TestResult:
    e, alpha = j.estimates, options.global_level(2)
    given = (e.values, e.cofactors, j.variance_factor, j.redundancy)
    name = "bivariate_additional_parameters"
    try:
        return bivariate_parameters(*given, options.correlation_limit, alpha, options.levels, e.names, name)
    except Singular as error:
        pairs = str(error).partition(": ")[2].split("; ")
        return not_applicable(name, "Both parameters of the pair are zero.", str(error), alpha, j.redundancy, pairs, 2, options.levels)
