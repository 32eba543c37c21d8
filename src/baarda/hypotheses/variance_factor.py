"""Global test of the variance factor, and the comparison of two of them."""

from __future__ import annotations

import numpy as np
from scipy import stats

from baarda.hypotheses._laws import check_redundancy, check_variance, number
from baarda.hypotheses.base import Evidence, TestResult
from baarda.hypotheses.levels import Options, check_level

__all__ = ["global_variance_factor", "variance_ratio"]

ORDER = 10


def global_variance_factor(vpv: float, redundancy: float, sigma0: float = 1.0, alpha: float = 0.05) -> TestResult:
    """Test whether the variance factor agrees with the a-priori one: two-sided chi-square.

    Parameters
    ----------
    vpv : float
        v'Pv, in the unit of sigma0 squared.
    redundancy : float
        r.
    sigma0 : float
        A-priori standard deviation of unit weight.
    alpha : float
        Level.

    Returns
    -------
    TestResult
        Statistic v'Pv / sigma0^2 under chi-square(r); `details` has the variance factor and the confidence limits of sigma0.

    Raises
    ------
    RedundancyNotPositive
        If r is not positive.
    UsageError
        If sigma0 is not positive or v'Pv negative.

    Notes
    -----
    Wu, Liu, Lin, ISPRS Archives 33 B1 (2000) 349; Grün (1978) p. 385.

    Examples
    --------
    >>> t = global_variance_factor(60.0, 43)
    >>> t.critical, t.rejected
    ((26.79, 62.99), False)
    """
    check_redundancy(redundancy)
    check_variance(sigma0, "sigma0")
    check_level(alpha)
    check_variance(vpv if vpv != 0.0 else 1.0, "v'Pv")
    law = stats.chi2(redundancy)
    limits = np.sqrt(vpv / law.ppf([1.0 - alpha / 2.0, alpha / 2.0]))
    return TestResult(
        "global_variance_factor",
        "The variance factor equals the a-priori one: the functional model and the weights are right.",
        float(vpv / sigma0**2),
        law,
        f"chi2({number(redundancy)})",
        alpha,
        "two-sided",
        (float(redundancy),),
        details={
            "variance_factor": float(vpv / redundancy),
            "sigma0_apriori": float(sigma0),
            "ratio": float(vpv / redundancy / sigma0**2),
            "sigma0_interval": [float(limits[0]), float(limits[1])],
        },
    )


def variance_ratio(first: float, df_first: float, second: float, df_second: float, alpha: float = 0.05) -> TestResult:
    """Test whether two independent variance factors are equal: two-sided F.

    Parameters
    ----------
    first, second : float
        Variance factors of two adjustments, same unit.
    df_first, df_second : float
        Their redundancies.
    alpha : float
        Level.

    Returns
    -------
    TestResult
        Statistic first / second under F(df_first, df_second).

    Raises
    ------
    RedundancyNotPositive
        If a redundancy is not positive.
    UsageError
        If a variance factor is not positive.

    Notes
    -----
    Precondition of pooling two epochs: Grün (1978) p. 399.

    Examples
    --------
    >>> variance_ratio(1.3, 40, 1.0, 50).p_value
    0.377
    """
    for df in (df_first, df_second):
        check_redundancy(df)
    check_variance(first, "the first variance factor")
    check_variance(second, "the second variance factor")
    check_level(alpha)
    return TestResult(
        "variance_ratio",
        "The variance factors of the two adjustments are equal.",
        float(first / second),
        stats.f(df_first, df_second),
        f"F({number(df_first)}, {number(df_second)})",
        alpha,
        "two-sided",
        (float(df_first), float(df_second)),
    )


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the global test of an adjustment."""
    level = options.global_level(evidence.redundancy)
    return [global_variance_factor(evidence.vpv, evidence.redundancy, evidence.sigma0_apriori, level)]
