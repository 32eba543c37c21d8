"""Bearings: horizontal directions from +Y clockwise, as surveyors count them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def bearing(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Return the bearings of lines and their partials.

    Parameters
    ----------
    start, end : (n, 3) arrays
        X, Y, Z of both ends; Z has no part in it.

    Returns
    -------
    bearing : (n,) array
        atan2(dX, dY), radians; NaN where both ends have the same X and Y.
    d_end : (n, 3) array
        Partials with respect to the end; those with respect to the start are their negatives.

    Notes
    -----
    t = atan2(Xj - Xi, Yj - Yi); dt/dXj = dY / s^2, dt/dYj = -dX / s^2.

    Examples
    --------
    >>> t, d = bearing(np.zeros((1, 3)), np.array([[3.0, 4.0, 9.0]]))
    >>> np.round(t, 6), np.round(d, 6)
    (array([0.643501]), array([[ 0.16, -0.12,  0.  ]]))
    """
    d = np.asarray(end - start, dtype=float)
    square = d[:, 0] ** 2 + d[:, 1] ** 2
    apart = square > 0.0
    square = np.where(apart, square, np.nan)
    partials = np.stack([d[:, 1] / square, -d[:, 0] / square, np.zeros(len(d))], axis=1)
    return np.where(apart, np.arctan2(d[:, 0], d[:, 1]), np.nan), partials


def half_turn(angle: Floats) -> Floats:
    """Return angles brought into [-pi, pi) by whole turns.

    Examples
    --------
    >>> np.round(half_turn(np.array([6.0, -4.0])), 6)
    array([-0.283185,  2.283185])
    """
    return np.asarray(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)
