"""Levels: what a whole family of tests may reject by chance, and Baarda's coupling of tests of different dimension."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats

from baarda.errors import UsageError
from baarda.hypotheses.base import Law, Tail, TestResult

__all__ = ["Options", "applied_level", "baarda_level", "family_result", "noncentrality", "power_of_test", "single_level"]

Policy = Literal["none", "sidak", "bonferroni", "holm", "fdr", "baarda"]
_POLICIES: tuple[str, ...] = get_args(Policy)
_SPOKEN = {"sidak": "Šidák", "bonferroni": "Bonferroni", "holm": "Holm", "fdr": "false discovery rate (Benjamini-Hochberg)"}


@dataclass(frozen=True)
class Options:
    """Levels and choices that all tests share.

    Attributes
    ----------
    alpha : float
        Level of global tests, tests of parameters, images and points.
    alpha_outlier : float
        Level of the test of one observation.
    power : float
        Power 1 - beta that minimal detectable biases promise.
    sigma : {"aposteriori", "apriori"}
        Which variance factor judges: the estimated s0^2 (t, F, tau) or the given sigma0^2 (normal, chi-square).
    levels : {"none", "sidak", "bonferroni", "holm", "fdr", "baarda"}
        Policy for families of tests: "none" applies the level to each single test; "sidak", "bonferroni" and "holm" keep `alpha` for
        the whole family, "fdr" keeps the expected share of false rejections; "baarda" derives the level of every dimension from
        `alpha_outlier` and `power` (B-method).
    seed : int
        Seed of simulated null laws.
    replicas : int
        Number of simulated data sets per null law.
    correlation_limit : float
        Pairs of parameters correlated beyond it are tested together.

    Raises
    ------
    UsageError
        If a value makes no sense.

    Examples
    --------
    >>> Options(levels="sidak").alpha
    0.05
    """

    alpha: float = 0.05
    alpha_outlier: float = 0.001
    power: float = 0.80
    sigma: Literal["aposteriori", "apriori"] = "aposteriori"
    levels: Policy = "none"
    seed: int = 0
    replicas: int = 999
    correlation_limit: float = 0.95

    def __post_init__(self) -> None:
        for name in ("alpha", "alpha_outlier", "power"):
            check_level(getattr(self, name), name)
            if getattr(self, name) < 1e-12:
                raise UsageError(f"{name} must be at least 1e-12, not {getattr(self, name)!r}")
        if self.power <= self.alpha_outlier:
            raise UsageError(f"the power ({self.power}) must exceed the level alpha_outlier ({self.alpha_outlier})")
        if self.sigma not in ("aposteriori", "apriori"):
            raise UsageError(f"sigma is 'aposteriori' or 'apriori', not {self.sigma!r}")
        _check_policy(self.levels)
        if self.seed < 0:
            raise UsageError(f"the seed must not be negative, not {self.seed}")
        if self.replicas < 1:
            raise UsageError(f"the number of replicas must be positive, not {self.replicas}")
        if not 0.0 <= self.correlation_limit < 1.0:
            raise UsageError(f"correlation_limit must lie in [0, 1), not {self.correlation_limit}")

    def global_level(self, df: float) -> float:
        """Return the level of a single test of dimension `df`: `alpha`, or under "baarda" the coupled one."""
        return baarda_level(df, self.alpha_outlier, self.power) if self.levels == "baarda" else self.alpha


def check_level(value: float, name: str = "alpha") -> None:
    """Raise UsageError unless a level or power is a fraction strictly between 0 and 1."""
    if not 0.0 < value < 1.0:
        raise UsageError(f"{name} is a fraction between 0 and 1, not {value!r}")


def _check_policy(policy: str) -> None:
    if policy not in _POLICIES:
        raise UsageError(f"unknown policy of levels {policy!r}; known are {', '.join(_POLICIES)}")


def single_level(alpha: float, count: int, policy: Policy = "sidak") -> float:
    """Return the level of each of `count` tests so that the family keeps `alpha`.

    Parameters
    ----------
    alpha : float
        Level of the family.
    count : int
        Number of tests.
    policy : {"none", "sidak", "bonferroni"}
        Šidák is exact for independent tests and a bound for two-sided normal and t tests; Bonferroni is a bound always.

    Returns
    -------
    float

    Raises
    ------
    UsageError
        If the policy needs the p-values (Holm, FDR) or the count is not positive.

    Notes
    -----
    Grün (1978) eq. 41: alpha = 1 - (1 - alpha_i)^p.

    Examples
    --------
    >>> single_level(0.05, 12)
    0.004265
    """
    check_level(alpha)
    if count < 1:
        raise UsageError(f"a family has at least one test, not {count}")
    if policy == "none":
        return alpha
    if policy == "sidak":
        return float(-np.expm1(np.log1p(-alpha) / count))
    if policy == "bonferroni":
        return alpha / count
    raise UsageError(f"the policy {policy!r} has no level that is known before the tests; use applied_level")


def applied_level(p_values: ArrayLike, alpha: float, policy: Policy = "none") -> float:
    """Return the level to which each p-value of a family is to be compared so that `p <= level` is the policy's decision.

    Parameters
    ----------
    p_values : (k,) array
        The p-values of the family; NaN (not testable) does not count.
    alpha : float
        Level of the family (of each test for "none" and "baarda").
    policy : str
        See `Options.levels`. Holm's and Benjamini-Hochberg's stepwise decisions depend on the p-values, but each equals the comparison
        with one number, which is returned.

    Returns
    -------
    float

    Notes
    -----
    S. Holm, Scand. J. Statist. 6 (1979) 65-70; Y. Benjamini, Y. Hochberg, J. R. Statist. Soc. B 57 (1995) 289-300.

    Examples
    --------
    >>> applied_level([0.001, 0.014, 0.02, 0.3], 0.05, "holm")
    0.05
    >>> applied_level([0.001, 0.014, 0.03, 0.3], 0.05, "holm")
    0.025
    """
    check_level(alpha)
    _check_policy(policy)
    p = np.sort(np.asarray(p_values, dtype=float).ravel())
    p = p[~np.isnan(p)]
    m = len(p)
    if m == 0 or policy in ("none", "baarda"):
        return alpha
    if policy in ("sidak", "bonferroni"):
        return single_level(alpha, m, policy)
    if policy == "holm":
        kept = np.flatnonzero(p > alpha / (m - np.arange(m)))
        rejected = int(kept[0]) if len(kept) else m
        # The next p-value exceeds alpha / (m - rejected): the comparison with that number rejects just the first ones.
        return alpha / max(m - rejected, 1)
    passed = np.flatnonzero(p <= alpha * np.arange(1, m + 1) / m)
    rejected = int(passed[-1]) + 1 if len(passed) else 0
    return float(alpha * max(rejected, 1) / m)


def noncentrality(alpha: float, power: float, df: float = 1.0) -> float:
    """Return lambda0: the noncentrality at which a chi-square test of level `alpha` reaches `power`.

    Parameters
    ----------
    alpha, power : float
        Level and power, fractions.
    df : float
        Degrees of freedom; 1 is the two-sided normal test.

    Returns
    -------
    float
        lambda0 = delta0^2, without unit.

    Raises
    ------
    UsageError
        If the power does not exceed the level.

    Notes
    -----
    Baarda, A testing procedure for use in geodetic networks (1968).

    Examples
    --------
    >>> noncentrality(0.001, 0.80)
    17.075
    """
    check_level(alpha)
    check_level(power, "power")
    if power <= alpha:
        raise UsageError(f"the power ({power}) must exceed the level ({alpha})")
    if df == 1.0:  # two-sided normal test: exact, and accurate for small levels where the noncentral chi-square series is not
        k = float(stats.norm.isf(alpha / 2.0))
        return float(_root(lambda d: stats.norm.sf(k - d) + stats.norm.cdf(-k - d) - power)) ** 2
    c = float(stats.chi2.isf(alpha, df))
    return float(_root(lambda d: stats.ncx2.sf(c, df, d * d) - power)) ** 2


def _root(excess: Any) -> float:
    """Return the positive delta at which an increasing function vanishes."""
    upper = 1.0
    while excess(upper) < 0.0:
        upper *= 2.0
    return float(optimize.brentq(excess, 1e-9, upper, xtol=1e-13, rtol=1e-14))


def baarda_level(df: float, alpha0: float = 0.001, power: float = 0.80) -> float:
    """Return the level of a test of `df` dimensions that detects the same bias with the same power as the test of one observation.

    Parameters
    ----------
    df : float
        Degrees of freedom of the test.
    alpha0, power : float
        Level and power of the one-dimensional test.

    Returns
    -------
    float

    Notes
    -----
    Baarda's B-method: lambda0(alpha, power, df) = lambda0(alpha0, power, 1), chi-square tests (sigma0 known).

    Examples
    --------
    >>> baarda_level(39)
    0.213
    """
    shared = noncentrality(alpha0, power)
    if df == 1:
        return alpha0
    return float(stats.chi2.sf(stats.ncx2.isf(power, df, shared), df))


def power_of_test(noncentral: ArrayLike, alpha: float, df: float, redundancy: float = np.inf) -> Any:
    """Return the power of a chi-square test (sigma0 known) or F test against a noncentrality.

    Parameters
    ----------
    noncentral : float or array
        Noncentrality lambda of the quadratic form, without unit.
    alpha : float
        Level of the test.
    df : float
        Dimension b of the hypothesis.
    redundancy : float
        r of the F(b, r) test; infinite for the chi-square test.

    Returns
    -------
    float or array

    Raises
    ------
    UsageError
        If a noncentrality is negative or the level makes no sense.

    Notes
    -----
    Baarda (1968); Grün (1978) eq. 31 under the alternative.

    Examples
    --------
    >>> power_of_test(17.075, 0.001, 1)
    0.800
    """
    check_level(alpha)
    lam = np.asarray(noncentral, dtype=float)
    if (lam < 0.0).any():
        raise UsageError("a noncentrality is not negative")
    shifted = np.where(lam > 0.0, lam, 1.0)  # SciPy's noncentral F has a wrong tail at exactly 0, where the power is the level
    if np.isinf(redundancy):
        power = stats.ncx2.sf(stats.chi2.isf(alpha, df), df, shifted)
    else:
        power = stats.ncf.sf(stats.f.isf(alpha, df, redundancy), df, redundancy, shifted)
    return np.where(lam > 0.0, power, alpha) if lam.ndim else float(power if lam > 0.0 else alpha)


def family_result(
    name: str,
    null: str,
    statistic: NDArray[np.float64],
    law: Law,
    law_name: str,
    alpha: float,
    policy: Policy = "none",
    *,
    labels: Sequence[str] = (),
    tail: Tail = "right",
    df: tuple[float, ...] = (),
    note: str = "",
    details: Mapping[str, Any] | None = None,
) -> TestResult:
    """Return the result of a family of tests with the level that the policy applies and the extreme member in `details`.

    Parameters
    ----------
    name, null, statistic, law, law_name, labels, tail, df, note, details
        As in `TestResult`; a NaN in `statistic` is a member that cannot be tested.
    alpha : float
        Level of the family, or of each test for the policies "none" and "baarda".
    policy : str
        See `Options.levels`.

    Returns
    -------
    TestResult
        `details` gains policy, family_alpha, tested, rejected, and the label and p-value of the extreme member.

    Raises
    ------
    UsageError
        If there is not one label per member.

    Examples
    --------
    >>> import numpy as np
    >>> t = family_result("example", "no bias", np.array([0.3, 4.0]), stats.norm(), "N(0, 1)", 0.05, "sidak", tail="two-sided")
    >>> t.alpha, t.details["rejected"]
    (0.02532, 1)
    """
    if labels and len(labels) != len(statistic):
        raise UsageError(f"{name}: {len(labels)} labels for {len(statistic)} tests")
    trial = TestResult(name, null, statistic, law, law_name, alpha, tail, df, tuple(labels))
    p = np.asarray(trial.p_value, dtype=float)
    level = applied_level(p, alpha, policy)
    counts: dict[str, Any] = {
        "policy": policy,
        "family_alpha": alpha,
        "tested": int(np.isfinite(p).sum()),
        "rejected": int((p <= level * (1.0 + 1e-12)).sum()),
    }
    if counts["tested"]:
        extreme = int(np.nanargmin(p))
        counts["extreme"] = {
            "index": extreme,
            "label": labels[extreme] if labels else "",
            "statistic": float(statistic[extreme]),
            "p_value": float(p[extreme]),
        }
    if policy in _SPOKEN:
        said = f"Level by {_SPOKEN[policy]} for {counts['tested']} tests, family level {alpha:g}."
        note = f"{note} {said}".strip()
    return TestResult(name, null, statistic, law, law_name, level, tail, df, tuple(labels), note, {**counts, **(details or {})})
