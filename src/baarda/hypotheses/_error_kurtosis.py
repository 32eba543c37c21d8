"""The kurtosis of the errors behind residuals: residuals mix the errors and are more normal than they."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from baarda.errors import UsageError
from baarda.hypotheses.base import Floats


def a_of_kurtosis(excess: float) -> float:
    """Return the a of a modulated normal law of given excess kurtosis: sqrt(1 + 3/excess) - 2; infinity where it is not positive.

    Parameters
    ----------
    excess : float
        Kurtosis minus 3.

    Returns
    -------
    float

    Examples
    --------
    >>> a_of_kurtosis(4.0 / 7.0), a_of_kurtosis(-0.1)
    (0.5, inf)
    """
    return float(np.sqrt(1.0 + 3.0 / excess)) - 2.0 if excess > 0.0 else float("inf")


def kurtosis_of_errors(residuals: ArrayLike, redundancy: float, shares: ArrayLike, fourth: float) -> tuple[Floats, Floats]:
    """Estimate sigma^4 of the errors, and sigma^4 times their excess kurtosis, from residuals; both without bias.

    Parameters
    ----------
    residuals : (n,) or (n, B) array
        v = -R e of independent errors e of equal variance; columns for data sets.
    redundancy : float
        r, the trace of R.
    shares : (n,) array
        R_ii.
    fourth : float
        Sum of R_ij^4 over all i and j.

    Returns
    -------
    fourth_power, fourth_cumulant : arrays of shape () or (B,)
        Their ratio estimates the excess kurtosis.

    Raises
    ------
    UsageError
        If the residuals cannot tell the two apart: every residual mixes too many errors.

    Notes
    -----
    With v = -R e and independent errors of excess kurtosis g: E sum v_i^4 = sigma^4 (3 sum R_ii^2 + g sum R_ij^4) and
    E s0^4 = sigma^4 (1 + 2/r + g sum R_ii^2 / r^2): two linear equations.

    Examples
    --------
    >>> e = np.random.default_rng(1).laplace(size=100_000)
    >>> power, cumulant = kurtosis_of_errors(e, len(e), np.ones(len(e)), float(len(e)))
    >>> round(float(cumulant / power))
    3
    """
    v = np.asarray(residuals, dtype=float)
    r, diagonal = float(redundancy), np.asarray(shares, dtype=float)
    squares = float(diagonal @ diagonal)
    v2 = v * v
    left = np.array([[3.0 * squares, fourth], [1.0 + 2.0 / r, squares / r**2]])
    if abs(np.linalg.det(left)) < 1e-9 * abs(left[0, 1] * left[1, 0]):
        raise UsageError("the residuals do not tell the kurtosis of the errors")
    right = np.stack([np.sum(v2 * v2, axis=0), (np.sum(v2, axis=0) / r) ** 2])
    solved = np.linalg.solve(left, right.reshape(2, -1)).reshape(right.shape)
    return solved[0], solved[1]
