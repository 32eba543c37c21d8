"""Moments of residuals: mean, skewness and kurtosis against those of normal errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses._simulation import controlled, null_note, shares, simulate, skipped_note
from baarda.hypotheses.base import Evidence, Floats, Law, SimulatedLaw, TestResult
from baarda.hypotheses.levels import Options, check_level

__all__ = ["KurtosisLaw", "SkewnessLaw", "kurtosis_of_residuals", "mean_of_residuals", "skewness_of_residuals"]

ORDER = 20


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
    n = len(x)
    law, spoken = _law(index, n) if simulated is None else (SimulatedLaw(np.sort(simulated)), f"simulated, {len(simulated)} replicas")
    t, skewness, kurtosis = _moments(x[:, None])[0]
    details = {"n": n, "mean": float(x.mean()), "standard_deviation": float(x.std(ddof=1))}
    details |= {"skewness": float(skewness), "kurtosis": float(kurtosis)}
    df = (float(n - 1),) if index == 0 and simulated is None else ()
    statistic = float((t, skewness, kurtosis)[index])
    return TestResult(_NAMES[index], _NULLS[index], statistic, law, spoken, alpha, "two-sided", df, note=note, details=details)


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


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests of mean, skewness and kurtosis on residuals standardised by their own sigma."""
    seen = controlled(evidence)
    if evidence.vpv <= 0.0 or seen.sum() < 4:
        return []
    spread = evidence.sigmas[seen] * np.sqrt(shares(evidence)[seen])
    factor = (evidence.sigmas[seen] / spread)[:, None]
    x = evidence.residuals[seen] / spread * (evidence.sigma0_apriori / evidence.sigma0)
    if np.ptp(x) == 0.0:
        return []
    simulated = simulate(evidence, lambda v: _moments(v[seen] * factor), options)
    note = null_note(evidence, options, 0 if simulated is None else len(simulated)) + skipped_note(int((~seen).sum()))
    level = options.global_level(1)
    nulls = (None, None, None) if simulated is None else simulated.T
    return [_test(i, x, level, nulls[i], note) for i in range(3) if simulated is not None or len(x) >= _LEAST[i]]
