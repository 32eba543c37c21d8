"""Geographic coordinates of an ellipsoid, geocentric ones, and the frame (east, north, up) that touches the ellipsoid at a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: semi-major axis in metres and flattening of WGS 84
A, F = 6378137.0, 1.0 / 298.257223563


def geocentric(lla: Floats, a: float = A, f: float = F) -> Floats:
    """Return geocentric X, Y, Z of latitude, longitude (degrees) and ellipsoidal height (metres), (..., 3) to (..., 3).

    Parameters
    ----------
    lla : (..., 3) array
    a, f : float
        Semi-major axis in metres and flattening of the ellipsoid, WGS 84 unless said.

    Notes
    -----
    Hofmann-Wellenhof et al., GNSS (2008), eq. 8.6.

    Examples
    --------
    >>> geocentric(np.array([0.0, 90.0, 10.0])).round(6) + 0.0
    array([      0., 6378147.,       0.])
    """
    lla = np.asarray(lla, dtype=float)
    e2 = f * (2.0 - f)
    lat, lon, h = np.radians(lla[..., 0]), np.radians(lla[..., 1]), lla[..., 2]
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    return np.stack([(n + h) * np.cos(lat) * np.cos(lon), (n + h) * np.cos(lat) * np.sin(lon), (n * (1.0 - e2) + h) * np.sin(lat)], axis=-1)


@dataclass(frozen=True)
class TangentFrame:
    """East, north and up from a point of latitude, longitude (degrees) and ellipsoidal height (metres).

    Attributes
    ----------
    latitude, longitude, height : float
    a, f : float
        Semi-major axis in metres and flattening of the ellipsoid, WGS 84 unless said.

    Examples
    --------
    >>> frame = TangentFrame(52.0, 13.0, 40.0)
    >>> frame.local(np.array([[52.0, 13.0, 41.5]])).round(6) + 0.0
    array([[0. , 0. , 1.5]])
    """

    latitude: float
    longitude: float
    height: float
    a: float = A
    f: float = F

    @property
    def rotation(self) -> Floats:
        """The matrix from geocentric differences to east, north, up."""
        lat, lon = np.radians(self.latitude), np.radians(self.longitude)
        sf, cf, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
        return np.array([[-sl, cl, 0.0], [-sf * cl, -sf * sl, cf], [cf * cl, cf * sl, sf]])

    @property
    def origin(self) -> Floats:
        """Geocentric coordinates of the point."""
        return geocentric(np.array([self.latitude, self.longitude, self.height]), self.a, self.f)

    def local(self, lla: Floats) -> Floats:
        """Return east, north, up of latitude, longitude (degrees) and ellipsoidal height, (n, 3) to (n, 3)."""
        return np.asarray((geocentric(lla, self.a, self.f) - self.origin) @ self.rotation.T)

    def geographic(self, local: Floats) -> Floats:
        """Return latitude, longitude (degrees) and ellipsoidal height of east, north, up, (n, 3) to (n, 3).

        Examples
        --------
        >>> frame = TangentFrame(52.0, 13.0, 40.0)
        >>> frame.geographic(frame.local(np.array([[52.001, 13.002, 55.0]]))).round(12)
        array([[52.001, 13.002, 55.   ]])
        """
        x, y, z = (np.asarray(local, dtype=float) @ self.rotation + self.origin).T
        e2 = self.f * (2.0 - self.f)
        p = np.hypot(x, y)
        latitude = np.arctan2(z, p * (1.0 - e2))
        for _ in range(8):  # contracts by e^2 per step
            n = self.a / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
            latitude = np.arctan2(z + e2 * n * np.sin(latitude), p)
        n = self.a / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
        height = p * np.cos(latitude) + z * np.sin(latitude) - self.a**2 / n  # exact at the poles, too
        return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=1)
