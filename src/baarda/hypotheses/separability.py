"""Separability: which of two observations is wrong, and how large an error must be to tell."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, stats

from baarda.errors import UsageError

__all__ = ["separable_delta", "wrong_choice"]


def wrong_choice(correlation: ArrayLike, delta: ArrayLike) -> Any:
    """Return the probability that, of two observations, the good one has the larger |w|.

    Parameters
    ----------
    correlation : float or array
        Correlation of the two test statistics, in [-1, 1].
    delta : float or array
        Shift of the biased observation's w.

    Returns
    -------
    float or array

    Raises
    ------
    UsageError
        If a correlation lies outside of [-1, 1].

    Notes
    -----
    |w_j| > |w_i| where w_i - w_j and w_i + w_j, which are independent normals, differ in sign; W. Förstner, Reliability and discernability
    of extended Gauss-Markov models, DGK A 98 (1983).

    Examples
    --------
    >>> wrong_choice(0.9, 4.132)
    0.1777
    """
    rho, d = np.asarray(correlation, dtype=float), np.asarray(delta, dtype=float)
    if (np.abs(rho) > 1.0 + 1e-9).any():
        raise UsageError("a correlation lies in [-1, 1]")
    a, b = d * np.sqrt(np.maximum(1.0 - rho, 0.0) / 2.0), d * np.sqrt(np.maximum(1.0 + rho, 0.0) / 2.0)
    p = stats.norm.cdf(-a) * stats.norm.cdf(b) + stats.norm.cdf(a) * stats.norm.cdf(-b)
    return p if np.ndim(p) else float(p)


def separable_delta(correlation: float, probability: float = 0.20) -> float:
    """Return the shift of w from which on the wrong one of two observations is blamed at most with the given probability.

    Parameters
    ----------
    correlation : float
        Correlation of the two test statistics.
    probability : float
        Accepted probability of the wrong choice, below 1/2.

    Returns
    -------
    float
        In units of w: times sigma0 sqrt(q / r_i) it is the minimal separable bias; infinite where |correlation| = 1.

    Raises
    ------
    UsageError
        If the probability does not lie between 0 and 1/2.

    Notes
    -----
    Inverse of `wrong_choice`; Förstner (1983).

    Examples
    --------
    >>> separable_delta(0.9, 0.20)
    3.765
    """
    if not 0.0 < probability < 0.5:
        raise UsageError(f"the probability of a wrong choice lies between 0 and 1/2, not {probability!r}")
    if 1.0 - abs(correlation) < 1e-12:
        return float("inf")
    upper = 1.0
    while wrong_choice(correlation, upper) > probability:
        upper *= 2.0
    return float(optimize.brentq(lambda d: wrong_choice(correlation, d) - probability, 0.0, upper, xtol=1e-12))
