"""Moments of residuals: mean, skewness and kurtosis against those of normal errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses._laws import check_redundancy, check_variance, number
from baarda.hypotheses._simulation import controlled, null_note, shares, simulate, skipped_note
from baarda.hypotheses.base import Evidence, Floats, Law, SimulatedLaw, TestResult
from baarda.hypotheses.levels import Options, check_level
from baarda.hypotheses.outliers import TauLaw

__all__ = [
    "KurtosisLaw",
    "SkewnessLaw",
    "kurtosis_of_residuals",
    "mean_of_residuals",
    "moment_tests",
    "not_applicable",
    "skewness_of_residuals",
    "sum_of_residuals",
]

ORDER = 20
_VANISHING = 1e-10  # of 1'Qvv1 relative to 1'Q1: residuals that sum to zero whatever the errors
_PROBES = 8


@dataclass(frozen=True)
class SkewnessLaw:
    """Law of the sample skewness sqrt(b1) of n independent normals: D'Agostino's transformation to a normal.

    Attributes
    ----------
    n : int
        Number of values, at least 8.

    Notes
    -----
    R. B. D'Agostino, Biometrika 57 (1970) 679-681.

    Examples
    --------
    >>> float(SkewnessLaw(50).ppf(0.975))
    0.648
    """

    n: int

    def _constants(self) -> tuple[float, float, float]:
        n = float(self.n)
        scale = np.sqrt((n + 1.0) * (n + 3.0) / (6.0 * (n - 2.0)))
        b2 = 3.0 * (n * n + 27.0 * n - 70.0) * (n + 1.0) * (n + 3.0) / ((n - 2.0) * (n + 5.0) * (n + 7.0) * (n + 9.0))
        w2 = np.sqrt(2.0 * (b2 - 1.0)) - 1.0
        return float(scale), float(1.0 / np.sqrt(0.5 * np.log(w2))), float(np.sqrt(2.0 / (w2 - 1.0)))

    def _z(self, x: Any) -> Any:
        scale, delta, a = self._constants()
        return delta * np.arcsinh(np.asarray(x, dtype=float) * scale / a)

    def cdf(self, x: Any) -> Any:
        """Return P(T <= x)."""
        return stats.norm.cdf(self._z(x))

    def sf(self, x: Any) -> Any:
        """Return P(T >= x)."""
        return stats.norm.sf(self._z(x))

    def ppf(self, q: Any) -> Any:
        """Return the quantile."""
        scale, delta, a = self._constants()
        return np.sinh(stats.norm.ppf(q) / delta) * a / scale


@dataclass(frozen=True)
class KurtosisLaw:
    """Law of the sample kurtosis b2 (3 for the normal) of n independent normals: Anscombe & Glynn's transformation to a normal.

    Attributes
    ----------
    n : int
        Number of values, at least 20.

    Notes
    -----
    F. J. Anscombe, W. J. Glynn, Biometrika 70 (1983) 227-234.

    Examples
    --------
    >>> float(KurtosisLaw(100).ppf(0.975))
    4.045
    """

    n: int

    def _constants(self) -> tuple[float, float, float]:
        n = float(self.n)
        mean = 3.0 * (n - 1.0) / (n + 1.0)
        variance = 24.0 * n * (n - 2.0) * (n - 3.0) / ((n + 1.0) ** 2 * (n + 3.0) * (n + 5.0))
        beta = 6.0 * (n * n - 5.0 * n + 2.0) / ((n + 7.0) * (n + 9.0)) * np.sqrt(6.0 * (n + 3.0) * (n + 5.0) / (n * (n - 2.0) * (n - 3.0)))
        a = 6.0 + 8.0 / beta * (2.0 / beta + np.sqrt(1.0 + 4.0 / beta**2))
        return mean, float(np.sqrt(variance)), float(a)

    def _z(self, x: Any) -> Any:
        mean, sd, a = self._constants()
        ratio = (1.0 - 2.0 / a) / (1.0 + (np.asarray(x, dtype=float) - mean) / sd * np.sqrt(2.0 / (a - 4.0)))
        return (1.0 - 2.0 / (9.0 * a) - np.cbrt(ratio)) / np.sqrt(2.0 / (9.0 * a))

    def cdf(self, x: Any) -> Any:
        """Return P(T <= x)."""
        return stats.norm.cdf(self._z(x))

    def sf(self, x: Any) -> Any:
        """Return P(T >= x)."""
        return stats.norm.sf(self._z(x))

    def ppf(self, q: Any) -> Any:
        """Return the quantile."""
        mean, sd, a = self._constants()
        root = 1.0 - 2.0 / (9.0 * a) - stats.norm.ppf(q) * np.sqrt(2.0 / (9.0 * a))
        return mean + sd * ((1.0 - 2.0 / a) / root**3 - 1.0) / np.sqrt(2.0 / (a - 4.0))


def _moments(x: Floats) -> Floats:
    """Return (t of the mean, skewness, kurtosis) of the columns of (n, B): (B, 3)."""
    n = len(x)
    mean = x.mean(axis=0)
    d = x - mean
    square = d * d
    m2 = square.mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):  # a column without spread has no such moments: refused by the caller
        t = mean * np.sqrt((n - 1.0) / m2)
        skewness = np.einsum("ij,ij->j", square, d) / n / m2**1.5
        kurtosis = np.einsum("ij,ij->j", square, square) / n / (m2 * m2)
    return np.stack([t, skewness, kurtosis], axis=-1)


def _checked(residuals: ArrayLike, least: int) -> Floats:
    x = np.asarray(residuals, dtype=float)
    if x.ndim != 1 or len(x) < least:
        raise UsageError(f"at least {least} residuals are needed, not {x.shape}")
    if not np.isfinite(x).all():
        raise UsageError("the residuals must be finite")
    if np.ptp(x) == 0.0:
        raise UsageError("all residuals are equal")
    return x


_NAMES = ("mean_of_residuals", "skewness_of_residuals", "kurtosis_of_residuals")
_NULLS = (
    "The residuals have expectation zero: no systematic part is left.",
    "The errors are distributed symmetrically.",
    "The errors have the kurtosis of the normal law.",
)
_LEAST = (2, 8, 20)


def _law(index: int, n: int) -> tuple[Law, str]:
    laws: tuple[Callable[[], tuple[Law, str]], ...] = (
        lambda: (stats.t(n - 1), f"t({n - 1})"),
        lambda: (SkewnessLaw(n), f"D'Agostino, n = {n}"),
        lambda: (KurtosisLaw(n), f"Anscombe-Glynn, n = {n}"),
    )
    return laws[index]()


def _test(index: int, x: Floats, alpha: float, simulated: Floats | None, note: str) -> TestResult:
    _, skewness, kurtosis = _moments(x[:, None])[0]
    moments = (float(x.mean()), float(x.std(ddof=1)), float(skewness), float(kurtosis))
    return _of_moments(index, len(x), moments, alpha, simulated, note)


def _of_moments(
    index: int, n: int, moments: tuple[float, float, float, float], alpha: float, simulated: Floats | None, note: str
) -> TestResult:
    law, spoken = _law(index, n) if simulated is None else (SimulatedLaw(np.sort(simulated)), f"simulated, {len(simulated)} replicas")
    mean, deviation, skewness, kurtosis = moments
    details = {"n": n, "mean": mean, "standard_deviation": deviation, "skewness": skewness, "kurtosis": kurtosis}
    df = (float(n - 1),) if index == 0 and simulated is None else ()
    statistic = float((mean * np.sqrt(n) / deviation, skewness, kurtosis)[index])
    return TestResult(_NAMES[index], _NULLS[index], statistic, law, spoken, alpha, "two-sided", df, note=note, details=details)


def moment_tests(n: int, moments: tuple[float, float, float, float], alpha: float = 0.05, note: str = "") -> list[TestResult]:
    """Return the tests of mean, skewness and kurtosis of n independent values of which only the moments are at hand.

    Parameters
    ----------
    n : int
        Number of values, at least 20.
    moments : tuple of float
        Mean, standard deviation (n - 1), skewness, kurtosis (3 for the normal law).
    alpha : float
        Level.
    note : str
        Added to each.

    Returns
    -------
    list of TestResult

    Raises
    ------
    UsageError
        If n is too small.

    Examples
    --------
    >>> [t.p_value for t in moment_tests(1000, (0.0, 1.0, 0.1, 3.2))]
    [1.0, 0.195, 0.192]
    """
    check_level(alpha)
    if n < _LEAST[2]:
        raise UsageError(f"{n} values: at least {_LEAST[2]} are needed")
    return [_of_moments(i, n, moments, alpha, None, note) for i in range(3)]


def mean_of_residuals(residuals: ArrayLike, alpha: float = 0.05, simulated: ArrayLike | None = None, note: str = "") -> TestResult:
    """Test whether residuals have expectation zero: two-sided.

    Parameters
    ----------
    residuals : (n,) array
        Residuals of equal variance, n at least 2; those of an adjustment divided by s0 sqrt(qvv).
    alpha : float
        Level.
    simulated : (B,) array, optional
        The statistic of simulated data sets, the null law for the correlated residuals of an adjustment.
    note : str
        Added to the result.

    Returns
    -------
    TestResult
        M sqrt(n) / S under t(n - 1), exact for independent normal values, or under the simulated law.

    Raises
    ------
    UsageError
        If there are too few residuals, or they are all equal or not finite.

    Notes
    -----
    Maarek & Konecny, section 2.

    Examples
    --------
    >>> mean_of_residuals([0.3, -0.1, 0.4, 0.2, -0.2]).statistic
    1.037
    """
    check_level(alpha)
    return _test(0, _checked(residuals, 2), alpha, None if simulated is None else np.asarray(simulated, dtype=float), note)


def skewness_of_residuals(residuals: ArrayLike, alpha: float = 0.05, simulated: ArrayLike | None = None, note: str = "") -> TestResult:
    """Test whether errors are distributed symmetrically: third moment, two-sided.

    Parameters
    ----------
    residuals, alpha, simulated, note
        As in `mean_of_residuals`; n at least 8 without simulated law.

    Returns
    -------
    TestResult
        Skewness m3 / m2^(3/2) under D'Agostino's law for independent normal values, or under the simulated law.

    Raises
    ------
    UsageError
        As `mean_of_residuals`.

    Notes
    -----
    Maarek & Konecny, section 2; the law is sharper than N(0, 6/n) for small n.

    Examples
    --------
    >>> skewness_of_residuals([0.3, -0.1, 0.4, 0.2, -0.2, 0.1, 0.0, 2.0]).p_value
    0.0022
    """
    check_level(alpha)
    least = _LEAST[1] if simulated is None else 3
    return _test(1, _checked(residuals, least), alpha, None if simulated is None else np.asarray(simulated, dtype=float), note)


def kurtosis_of_residuals(residuals: ArrayLike, alpha: float = 0.05, simulated: ArrayLike | None = None, note: str = "") -> TestResult:
    """Test whether errors have the kurtosis of the normal law: fourth moment, two-sided.

    Parameters
    ----------
    residuals, alpha, simulated, note
        As in `mean_of_residuals`; n at least 20 without simulated law.

    Returns
    -------
    TestResult
        Kurtosis m4 / m2^2 (3 for the normal) under Anscombe & Glynn's law for independent normal values, or under the simulated law.

    Raises
    ------
    UsageError
        As `mean_of_residuals`.

    Notes
    -----
    Residuals of an adjustment are mixtures of errors and more normal than these: only a simulated law gives the true size.

    Examples
    --------
    >>> import numpy as np
    >>> kurtosis_of_residuals(np.linspace(-1.0, 1.0, 50)).statistic
    1.799
    """
    check_level(alpha)
    least = _LEAST[2] if simulated is None else 4
    return _test(2, _checked(residuals, least), alpha, None if simulated is None else np.asarray(simulated, dtype=float), note)


@dataclass(frozen=True)
class _Undecided:
    """The law of a statistic that cannot decide: every value is as likely as any other, p = 1."""

    def cdf(self, x: Any) -> Any:
        """Return 1."""
        return np.ones_like(np.asarray(x, dtype=float))[()]

    def sf(self, x: Any) -> Any:
        """Return 1."""
        return np.ones_like(np.asarray(x, dtype=float))[()]

    def ppf(self, q: Any) -> Any:
        """Return 0."""
        return np.zeros_like(np.asarray(q, dtype=float))[()]


def not_applicable(name: str, null: str, why: str, alpha: float = 0.05) -> TestResult:
    """Return the outcome of a test that says nothing about these data: p = 1, and the reason in words.

    Parameters
    ----------
    name, null : str
        Of the test.
    why : str
        The reason, a sentence without its first words "Not applicable:".
    alpha : float
        Level.

    Returns
    -------
    TestResult
        `details["applicable"]` is False: reports show the words and no numbers.

    Examples
    --------
    >>> t = not_applicable("mean_of_residuals", "The residuals have expectation zero.", "1'Qvv1 is zero.")
    >>> t.p_value, t.rejected, t.note
    (1.0, False, "Not applicable: 1'Qvv1 is zero.")
    """
    details = {"applicable": False}
    return TestResult(name, null, 0.0, _Undecided(), "not applicable", alpha, "two-sided", note=f"Not applicable: {why}", details=details)


def sum_of_residuals(
    total: float, cofactor: float, variance_factor: float, redundancy: float, alpha: float = 0.05, scale: float = 1.0, note: str = ""
) -> TestResult:
    """Test whether the residuals of an adjustment have expectation zero, by their sum 1'v and its cofactor 1'Qvv1: two-sided.

    Parameters
    ----------
    total : float
        1'v, the sum of the residuals, or of v / sigma where weights differ.
    cofactor : float
        1'Qvv1 of the same residuals.
    variance_factor : float
        A-posteriori variance factor s0^2 of the adjustment.
    redundancy : float
        r.
    alpha : float
        Level.
    scale : float
        1'Q1, what the cofactor of the sum would be if the residuals were the errors themselves: below 1e-10 of it the cofactor is zero.
    note : str
        Added to the result.

    Returns
    -------
    TestResult
        1'v / (s0 sqrt(1'Qvv1)) under Pope's tau law with r degrees of freedom, exact for normal errors. Not applicable where 1'Qvv1 is
        zero: then the residuals sum to zero whatever the errors, as with an unknown that is common to all observations.

    Raises
    ------
    UsageError
        If a number is not finite, or variance factor or redundancy are not positive.

    Notes
    -----
    Maarek & Konecny, section 2, with the variance of the mean of adjusted residuals in place of S^2 / n.

    Examples
    --------
    >>> t = sum_of_residuals(2.4, 3.1, 1.2, 25)
    >>> t.statistic, t.critical[1], t.law_name
    (1.244, 1.941, 'tau(25)')
    >>> sum_of_residuals(1e-13, 1e-15, 1.2, 25).details["applicable"]
    False
    """
    check_level(alpha)
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    if not (np.isfinite(total) and np.isfinite(cofactor)):
        raise UsageError("the sum of the residuals and its cofactor must be finite")
    if cofactor <= _VANISHING * scale:
        why = "1'Qvv1 is zero: the residuals sum to zero whatever the errors, so their mean tells nothing."
        return not_applicable(_NAMES[0], _NULLS[0], why, alpha)
    statistic = float(total / np.sqrt(variance_factor * cofactor))
    details = {"sum": float(total), "cofactor": float(cofactor)}
    name = f"tau({number(redundancy)})"
    return TestResult(_NAMES[0], _NULLS[0], statistic, TauLaw(redundancy), name, alpha, "two-sided", note=note, details=details)


def _cofactor_of_sum(evidence: Evidence) -> float | None:
    """Return 1'Qvv1 of v / sigma (variance factor 1); None where the map from errors to residuals is not symmetric.

    Qvv P Qvv = Qvv: for uncorrelated observations the map from whitened errors to v / sigma is -Qvv itself.
    """
    if evidence.residuals_of is None:
        return None
    n = len(evidence.residuals)
    probes = np.random.default_rng(0).standard_normal((n, _PROBES))
    images = np.asarray(evidence.residuals_of(np.column_stack([np.ones(n), probes])), dtype=float)
    products = probes.T @ images[:, 1:]
    if not np.allclose(products, products.T, rtol=0.0, atol=1e-8 * float(np.abs(products).max())):
        return None
    return float(-images[:, 0].sum())


def _spread(evidence: Evidence, seen: NDArray[np.bool_]) -> Floats:
    return np.asarray(evidence.sigmas[seen] * np.sqrt(shares(evidence)[seen]))


def _values(evidence: Evidence, seen: NDArray[np.bool_]) -> Floats | None:
    """Return the residuals that are studied, each divided by its own standard deviation; None where they tell nothing."""
    if evidence.vpv <= 0.0 or seen.sum() < 4:
        return None
    x = evidence.residuals[seen] / _spread(evidence, seen) * (evidence.sigma0_apriori / evidence.sigma0)
    return None if np.ptp(x) == 0.0 else x


def simulated_statistic(evidence: Evidence, options: Options) -> Callable[[Floats], Floats] | None:
    """Return the statistic that is simulated: three moments, the sum of the residuals, and that of their squares."""
    seen = controlled(evidence)
    if _values(evidence, seen) is None:
        return None
    factor = (evidence.sigmas[seen] / _spread(evidence, seen))[:, None]
    return lambda v: np.column_stack([_moments(v[seen] * factor), v.sum(axis=0), (v * v).sum(axis=0)])


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests of mean, skewness, kurtosis, and of the last two together (Jarque-Bera), on standardised residuals."""
    from baarda.hypotheses.normality import jarque_bera

    seen = controlled(evidence)
    x, statistic = _values(evidence, seen), simulated_statistic(evidence, options)
    if x is None or statistic is None:
        return []
    null = simulate(evidence, "moments", statistic, options)
    note = null_note(evidence, options, 0 if null is None else len(null)) + skipped_note(int((~seen).sum()))
    level = options.global_level(1)
    if null is None:
        made = [_test(i, x, level, None, note) for i in range(3) if len(x) >= _LEAST[i]]
        own = f"Null law by {options.replicas} simulated samples of independent normal values, seed {options.seed}: approximate."
        return [*made, jarque_bera(x, level, replicas=options.replicas, seed=options.seed, note=own)]
    moments = [_test(i, x, level, null[:, i], note) for i in range(3)]
    moments[0] = _mean_by_sum(evidence, moments[0], null[:, 3], null[:, 4])
    if np.ptp(null[:, 1]) <= 1e-9:
        why = "the residuals are so bound to each other that their skewness is the same whatever the errors."
        moments[1] = not_applicable(_NAMES[1], _NULLS[1], why, level)
    return [*moments, jarque_bera(x, level, simulated=_jarque_bera_of(len(x), null[:, 1], null[:, 2]), note=note)]


def _jarque_bera_of(n: int, skewness: Any, kurtosis: Any) -> Any:
    return n / 6.0 * (skewness**2 + (kurtosis - 3.0) ** 2 / 4.0)


def _mean_by_sum(evidence: Evidence, plain: TestResult, sums: Floats, squares: Floats) -> TestResult:
    """Judge the mean by 1'v and 1'Qvv1 of v / sigma: exactly where observations are uncorrelated, by simulation where they are not."""
    n, r = len(evidence.residuals), float(evidence.redundancy)
    total = float((evidence.residuals / evidence.sigmas).sum())
    factor = evidence.variance_factor / evidence.sigma0_apriori**2
    cofactor = _cofactor_of_sum(evidence)
    exact = cofactor is not None
    value = float(np.mean(sums**2)) if cofactor is None else cofactor
    note = f"1'v / (s0 sqrt(1'Qvv1)) of the residuals divided by their sigmas, 1'Qvv1 = {value:.4g} for 1'1 = {n}"
    t = sum_of_residuals(total, value, factor, r, plain.alpha, float(n), f"{note}: exact for normal errors.")
    details = {**plain.details, **t.details}
    if exact or not t.details.get("applicable", True):
        return replace(t, details=details)
    # with correlated observations s0 of a replica is not at hand from v / sigma: its root mean square stands for it, in data and replicas
    size = float(np.sqrt(np.mean((evidence.residuals / evidence.sigmas) ** 2)))
    law = SimulatedLaw(np.sort(sums / np.sqrt(squares / n * value)))
    said = f"{note} (by simulation), s0 by the root mean square. {plain.note}"
    statistic = total / size / np.sqrt(value)
    return replace(t, statistic=statistic, law=law, law_name=plain.law_name, note=said, details=details)
