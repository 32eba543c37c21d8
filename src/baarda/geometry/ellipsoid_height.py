"""Heights above the ellipsoid of geocentric points, and their partials."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import UsageError
from baarda.geometry.tangent_frame import A, F

Floats = NDArray[np.float64]
_E2 = F * (2.0 - F)


def ellipsoid_height(points: ArrayLike) -> tuple[Floats, Floats]:
    """Return heights above the ellipsoid of WGS 84, and the unit normals there, which are the partials of the heights.

    Parameters
    ----------
    points : (n, 3) array_like
        Geocentric coordinates, m.

    Returns
    -------
    heights : (n,) array
        m.
    normals : (n, 3) array
        Outwards.

    Raises
    ------
    UsageError
        If a point lies within 100 km of the centre, where latitude is not defined: coordinates are not geocentric, or not in metres.

    Notes
    -----
    Hofmann-Wellenhof et al., GNSS (2008), section 8.2: iteration of the latitude, which contracts by e^2 per step.

    Examples
    --------
    >>> height, normal = ellipsoid_height([[6378237.0, 0.0, 0.0]])
    >>> height.round(6), normal
    (array([100.]), array([[1., 0., 0.]]))
    """
    x = np.asarray(points, dtype=float).reshape(-1, 3)
    if (np.linalg.norm(x, axis=1) < 1e5).any():
        raise UsageError("ellipsoid heights need geocentric coordinates in metres; a point lies within 100 km of the centre of the Earth")
    p = np.hypot(x[:, 0], x[:, 1])
    latitude = np.arctan2(x[:, 2], p * (1.0 - _E2))
    for _ in range(8):
        n = A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(x[:, 2] + _E2 * n * np.sin(latitude), p)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    longitude = np.arctan2(x[:, 1], x[:, 0])
    height = p * cosine + x[:, 2] * sine - A * np.sqrt(1.0 - _E2 * sine**2)  # exact at the poles, too
    return np.asarray(height), np.stack([cosine * np.cos(longitude), cosine * np.sin(longitude), sine], axis=1)
