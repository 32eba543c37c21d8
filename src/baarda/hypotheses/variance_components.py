"""Variance components: whether the stated variances of groups of observations are right, each and against each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, stats

from baarda.errors import UsageError
from baarda.hypotheses._laws import member_laws, same
from baarda.hypotheses.base import Evidence, Law, TestResult
from baarda.hypotheses.levels import Options, Policy, check_level, family_result

__all__ = ["equal_variance_components", "variance_component"]

ORDER = 15
_FEWEST = 1e-6


def _checked(forms: ArrayLike, traces: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    q, t = np.asarray(forms, dtype=float), np.asarray(traces, dtype=float)
    if q.ndim != 1 or t.shape != (len(q), len(q)) or not len(q):
        raise UsageError(f"{q.shape} quadratic forms need a square matrix of traces, not {t.shape}")
    if not (np.isfinite(q).all() and np.isfinite(t).all() and (q >= 0.0).all()):
        raise UsageError("quadratic forms must be finite and not negative, traces finite")
    return q, t


def variance_component(
    forms: ArrayLike, traces: ArrayLike, labels: Sequence[str], alpha: float = 0.05, levels: Policy = "none"
) -> TestResult:
    """Test for each group of observations whether its stated variances are right.

    Parameters
    ----------
    forms : (g,) array
        v_i' P_i v_i of the groups, with the stated variances.
    traces : (g, g) array
        tr(R_ij R_ji), with R = Qvv P in blocks of the groups; rows sum to the redundancies r_i.
    labels : sequence of str
        Names of the groups.
    alpha, levels
        See `Options`.

    Returns
    -------
    TestResult
        A family: v_i'P_i v_i / r_i under chi-square(f_i) / f_i, f_i = r_i^2 / T_ii, two-sided; exact where the groups do not share
        redundancy, else with the right mean and variance. NaN where a group has no redundancy.

    Raises
    ------
    UsageError
        If the shapes make no sense.

    Notes
    -----
    W. Förstner, Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten, AVN 86 (1979) 446-453; mean and variance of quadratic
    forms of normal residuals, matched as by Satterthwaite (1946).

    Examples
    --------
    >>> t = variance_component([30.0, 90.0], [[28.0, 2.0], [2.0, 38.0]], ["points", "distances"])
    >>> t.rejected
    array([False,  True])
    """
    q, t = _checked(forms, traces)
    r = t.sum(axis=1)
    if len(labels) != len(q):
        raise UsageError(f"{len(labels)} labels for {len(q)} groups")
    seen = r > _FEWEST
    safe = np.where(seen, r, 1.0)
    f = np.where(seen, safe**2 / np.where(seen, np.diag(t), 1.0), 1.0)
    statistic = np.where(seen, q / safe, np.nan)
    law: Law = stats.chi2(f, scale=1.0 / f)
    if same(f):
        law = stats.chi2(float(f[0]), scale=1.0 / float(f[0]))
    else:
        law = member_laws(law, statistic, two_sided=True)
    null = "The stated variances of the group are right."
    details = {"redundancies": r.tolist(), "df": f.tolist()}
    spoken = "chi2(f)/f, f = r_i^2 / tr(R_ii R_ii)"
    return family_result(
        "variance_component", null, statistic, law, spoken, alpha, levels, labels=labels, tail="two-sided", details=details
    )


def equal_variance_components(forms: ArrayLike, traces: ArrayLike, labels: Sequence[str], alpha: float = 0.05) -> TestResult:
    """Test whether one variance factor holds for all groups.

    Parameters
    ----------
    forms, traces, labels, alpha
        As in `variance_component`.

    Returns
    -------
    TestResult
        d' (C V C')^-1 d under chi-square(g - 1), d = C log(s^2) the differences of the logarithms of the group variances
        s_i^2 = v_i'P_i v_i / r_i, V their covariance 2 T_ij / (r_i r_j) when one factor holds. For large redundancies.

    Raises
    ------
    UsageError
        If fewer than two groups have redundancy.

    Notes
    -----
    The logarithm is nearly normal from small redundancies on, as in Bartlett's test (1937); K.-R. Koch, Parameter Estimation and Hypothesis
    Testing in Linear Models (1999) 3.6.

    Examples
    --------
    >>> equal_variance_components([30.0, 90.0], [[28.0, 2.0], [2.0, 38.0]], ["points", "distances"]).rejected
    True
    """
    check_level(alpha)
    q, t = _checked(forms, traces)
    r = t.sum(axis=1)
    used = np.flatnonzero((r > _FEWEST) & (q > 0.0))
    if len(used) < 2:
        raise UsageError("at least two groups of observations must have redundancy")
    r, q, t = r[used], q[used], t[np.ix_(used, used)]
    # E(log chi2(f)/f) = digamma(f/2) - log(f/2), var = trigamma(f/2): the exact moments where they differ from those of large f.
    from scipy import special

    f = r**2 / np.diag(t)
    x = np.log(q / r) - (special.digamma(f / 2.0) - np.log(f / 2.0))
    v = 2.0 * t / np.outer(r, r)
    growth = np.sqrt(special.polygamma(1, f / 2.0) / np.diag(v))
    v = v * np.outer(growth, growth)
    c = np.eye(len(r))[1:] - np.eye(len(r))[:1]
    d = c @ x
    statistic = float(d @ linalg.solve(c @ v @ c.T, d, assume_a="pos"))
    df = len(r) - 1
    return TestResult(
        "equal_variance_components",
        "One variance factor holds for all groups of observations.",
        statistic,
        stats.chi2(df),
        f"chi2({df})",
        alpha,
        df=(float(df),),
        note="Law for large redundancies.",
        details={"groups": [labels[int(i)] for i in used]},
    )


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return no test: the traces between groups come from `baarda.procedures.variance_components`."""
    return []
