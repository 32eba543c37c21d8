"""Normality by skewness and kurtosis together: the test of Jarque and Bera."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses.base import Floats, Law, SimulatedLaw, TestResult
from baarda.hypotheses.levels import check_level
from baarda.hypotheses.moments import _checked, _jarque_bera_of, _moments

__all__ = ["jarque_bera", "jarque_bera_of_moments"]

_NUMBERS = 4e7  # simulated values
_CHUNK = 4_000_000
_LEAST = 4


def jarque_bera(
    residuals: ArrayLike,
    alpha: float = 0.05,
    *,
    simulated: ArrayLike | None = None,
    residuals_of: Callable[[Floats], Floats] | None = None,
    replicas: int = 999,
    seed: int = 0,
    note: str = "",
) -> TestResult:
    """Test whether errors are normal by the skewness and kurtosis of the residuals together.

    Parameters
    ----------
    residuals : (n,) array
        Residuals of equal variance, n at least 4; those of an adjustment divided by s0 sqrt(qvv).
    alpha : float
        Level.
    simulated : (B,) array, optional
        The statistic of simulated data sets, where it is known already.
    residuals_of : callable, optional
        Maps normal errors of unit variance, (n, B), to residuals standardised as `residuals` are, (n, B). Without it the residuals count
        as independent.
    replicas : int
        Simulated data sets, default 999; 0 takes the asymptotic law, and so do more than 4e7 simulated values.
    seed : int
        Replica k uses child k of the seed.
    note : str
        Added to the result.

    Returns
    -------
    TestResult
        n / 6 (skewness^2 + (kurtosis - 3)^2 / 4) under its simulated law, or under chi-square(2), which it reaches slowly: at n = 100 the
        asymptotic test of level 1 % rejects 2.1 % of normal samples, that of level 10 % only 6.6 %.

    Raises
    ------
    UsageError
        If there are too few residuals, they are all equal or not finite, or `residuals_of` changes the shape.

    Notes
    -----
    C. M. Jarque, A. K. Bera, Economics Letters 6 (1980) 255-259. The statistic depends on neither mean nor scale, so that its null law for
    normal errors is known exactly but for the number of replicas, for residuals of an adjustment too.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(3).laplace(size=200)
    >>> t = jarque_bera(x)
    >>> t.statistic, t.p_value, t.rejected
    (567.7, 0.001, True)
    >>> jarque_bera(x, replicas=0).law_name
    'chi2(2), asymptotic'
    """
    x = _checked(residuals, _LEAST)
    if replicas < 0:
        raise UsageError(f"the number of replicas must not be negative, not {replicas}")
    n = len(x)
    _, skewness, kurtosis = _moments(x[:, None])[0]
    if simulated is None and n * replicas <= _NUMBERS and replicas:
        simulated = _simulated(n, replicas, seed, residuals_of)
        note = note or _note(residuals_of, replicas, seed)
    null = None if simulated is None else np.asarray(simulated, dtype=float)
    return jarque_bera_of_moments(n, float(skewness), float(kurtosis), alpha, simulated=null, note=note)


def jarque_bera_of_moments(
    n: int, skewness: float, kurtosis: float, alpha: float = 0.05, *, simulated: Floats | None = None, note: str = ""
) -> TestResult:
    """Return the test of Jarque and Bera of n values of which only skewness and kurtosis are at hand.

    Parameters
    ----------
    n : int
        Number of values.
    skewness, kurtosis : float
        Of the values; 0 and 3 for the normal law.
    alpha : float
        Level.
    simulated : (B,) array, optional
        The statistic of simulated data sets; without it the law is asymptotic.
    note : str
        Added to the result.

    Returns
    -------
    TestResult

    Examples
    --------
    >>> jarque_bera_of_moments(10_000, 0.05, 3.1).statistic
    8.333
    """
    check_level(alpha)
    law: Law
    if simulated is None:
        law, spoken = stats.chi2(2), "chi2(2), asymptotic"
    else:
        law, spoken = SimulatedLaw(np.sort(simulated)), f"simulated, {len(simulated)} replicas"
    return TestResult(
        "jarque_bera",
        "The errors are normal, by their third and fourth moment.",
        float(_jarque_bera_of(n, skewness, kurtosis)),
        law,
        spoken,
        alpha,
        df=() if simulated is not None else (2.0,),
        note=note,
        details={"n": n, "skewness": skewness, "kurtosis": kurtosis},
    )


def _simulated(n: int, replicas: int, seed: int, residuals_of: Callable[[Floats], Floats] | None) -> Floats:
    children = np.random.SeedSequence(seed).spawn(replicas)
    width = max(1, _CHUNK // n)
    parts = []
    for start in range(0, replicas, width):
        z = np.stack([np.random.default_rng(child).standard_normal(n) for child in children[start : start + width]], axis=1)
        v = z if residuals_of is None else np.asarray(residuals_of(z), dtype=float)
        if v.shape != z.shape:
            raise UsageError(f"residuals_of maps {z.shape} to {v.shape}; it must keep the shape")
        m = _moments(v)
        parts.append(_jarque_bera_of(n, m[:, 1], m[:, 2]))
    return np.concatenate(parts)


def _note(residuals_of: Callable[[Floats], Floats] | None, replicas: int, seed: int) -> str:
    how = "samples of independent normal values" if residuals_of is None else "adjustments of normal errors"
    return f"Null law by {replicas} simulated {how}, seed {seed}."
