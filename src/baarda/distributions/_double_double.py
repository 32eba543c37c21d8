"""k z^2 with twice the digits, because exp(-k z^2) turns a rounding of the exponent into a relative error of its size."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SPLITTER = 134217729.0  # 2^27 + 1 (Dekker 1971)
_LARGEST = 1e100  # beyond it exp(-k z^2) is zero and the splitting would overflow


def _product(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return x*y and its rounding error (Dekker's product)."""
    p = x * y
    t = _SPLITTER * x
    xh = t - (t - x)
    t = _SPLITTER * y
    yh = t - (t - y)
    xl, yl = x - xh, y - yh
    return p, ((xh * yh - p) + xh * yl + xl * yh) + xl * yl


def half_square(z: Any, k: Any, k_low: Any) -> tuple[Floats, Floats]:
    """Return c = (k + k_low) z^2 as an unevaluated sum of two doubles.

    Parameters
    ----------
    z : array
        Standardised deviation.
    k, k_low : float or array
        The factor and what its rounding left.

    Returns
    -------
    tuple of two arrays
        c and its correction, so that exp(-c)(1 - correction) has full relative accuracy.

    Examples
    --------
    >>> c, rest = half_square(1.0 + 2.0**-30, 0.5, 0.0)
    >>> float(c), float(rest) == 2.0**-61
    (0.500000000931, True)
    """
    z = np.minimum(np.abs(np.asarray(z, dtype=float)), _LARGEST)
    square, rest = _product(z, z)
    c, low = _product(square, np.asarray(k, dtype=float))
    low = low + (k * rest + k_low * square)
    return c, low


def variance_ratio(a: Any) -> tuple[Floats, Floats]:
    """Return k = (a + 1) / (2 (a + 2)) as a sum of two doubles: c = k z^2 for the standardised modulated normal law."""
    a = np.asarray(a, dtype=float)
    top, top_rest = _sum(a, 1.0)
    bottom, bottom_rest = _sum(a, 2.0)
    k = top / (2.0 * bottom)
    p, p_rest = _product(k, 2.0 * bottom)
    rest = ((top - p) - p_rest + top_rest - 2.0 * k * bottom_rest) / (2.0 * bottom)
    return k, rest


def _sum(x: Floats, y: float) -> tuple[Floats, Floats]:
    """Return x + y and its rounding error (Knuth's sum)."""
    s = x + y
    t = s - x
    return s, (x - (s - t)) + (y - t)
