"""Corrections of measured image coordinates for systematic effects: lens, film, atmosphere, curvature of the Earth.

Each function is pure: image coordinates (n, 2) about the principal point in, corrected ones out, in the unit of the coordinates. Radial and
decentring distortion follow the correction convention of Brown: corrected = measured + correction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import Singular, UsageError

Floats = NDArray[np.float64]
EARTH_RADIUS = 6_371_000.0  # m, mean


def _plane(xy: ArrayLike) -> Floats:
    out = np.asarray(xy, dtype=float)
    if out.ndim != 2 or out.shape[1] != 2:
        raise UsageError(f"image coordinates must be of shape (n, 2), not {out.shape}")
    return out


def correct_radial(xy: ArrayLike, k: ArrayLike) -> Floats:
    """Correct radial distortion.

    Parameters
    ----------
    xy : (n, 2) array_like
        Measured, about the principal point of symmetry.
    k : (m,) array_like
        K1, K2, ...: units of length to the powers -2, -4, ...

    Returns
    -------
    (n, 2) array
        xy (1 + K1 r^2 + K2 r^4 + ...).

    Raises
    ------
    UsageError
        If xy is no (n, 2) array.

    Notes
    -----
    Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971) 855-866.

    Examples
    --------
    >>> correct_radial([[30.0, 40.0]], [1e-6])
    array([[30.075, 40.1  ]])
    """
    p = _plane(xy)
    square = np.sum(p * p, axis=1)
    factor = np.polynomial.polynomial.polyval(square, np.concatenate([[1.0], np.atleast_1d(np.asarray(k, dtype=float))]))
    return np.asarray(p * factor[:, None])


def correct_decentring(xy: ArrayLike, p1: float, p2: float, p3: float = 0.0) -> Floats:
    """Correct decentring distortion.

    Parameters
    ----------
    xy : (n, 2) array_like
    p1, p2 : float
        Inverse length.
    p3 : float
        Inverse square length.

    Returns
    -------
    (n, 2) array
        x + (1 + P3 r^2) [P1 (r^2 + 2 x^2) + 2 P2 x y], y + (1 + P3 r^2) [2 P1 x y + P2 (r^2 + 2 y^2)].

    Raises
    ------
    UsageError
        If xy is no (n, 2) array.

    Notes
    -----
    Conrady (1919); Brown (1971).

    Examples
    --------
    >>> correct_decentring([[30.0, 40.0]], 1e-6, 0.0)
    array([[30.0043, 40.0024]])
    """
    p = _plane(xy)
    x, y = p[:, 0], p[:, 1]
    square = x * x + y * y
    more = 1.0 + p3 * square
    dx = p1 * (square + 2.0 * x * x) + 2.0 * p2 * x * y
    dy = 2.0 * p1 * x * y + p2 * (square + 2.0 * y * y)
    return np.stack([x + more * dx, y + more * dy], axis=1)


class Film(NamedTuple):
    """An affine film deformation found from fiducial marks: matrix (2, 2), translation (2,), residuals (n, 2), sigma0 of one coordinate."""

    matrix: Floats
    translation: Floats
    residuals: Floats
    sigma0: float

    def correct(self, xy: ArrayLike) -> Floats:
        """Return measured coordinates (n, 2) in the calibrated system.

        Examples
        --------
        >>> Film(2.0 * np.eye(2), np.ones(2), np.zeros((4, 2)), 0.0).correct([[1.0, 2.0]])
        array([[3., 5.]])
        """
        return np.asarray(_plane(xy) @ self.matrix.T + self.translation)


def film_deformation(measured: ArrayLike, calibrated: ArrayLike) -> Film:
    """Find the affine deformation of a film from its fiducial marks by least squares.

    Parameters
    ----------
    measured, calibrated : (n, 2) array_like
        The same n >= 4 marks in the measuring system, and as calibrated.

    Returns
    -------
    Film
        Six parameters: two shifts, two scales, rotation, and shear.

    Raises
    ------
    UsageError
        If the arrays do not match, or there are fewer than four marks.
    Singular
        If the marks lie on one line.

    Notes
    -----
    Kraus, Photogrammetry (2007), section 3.2.1; Wolf & Dewitt, Elements of Photogrammetry (2000), section 4-10.

    Examples
    --------
    >>> marks = np.array([[106.0, 106], [-106, -106], [-106, 106], [106, -106]])
    >>> film_deformation(1.001 * marks + 3.0, marks).correct([[3.0, 3.0]]).round(9) + 0.0
    array([[0., 0.]])
    """
    a, b = _plane(measured), _plane(calibrated)
    if a.shape != b.shape or len(a) < 4:
        raise UsageError(f"an affine film deformation needs at least 4 fiducial marks in both systems, not {len(a)} and {len(b)}")
    centre = a.mean(axis=0)
    d = a - centre
    s = np.linalg.svd(d, compute_uv=False)
    if s[1] <= 1e-6 * s[0]:
        raise Singular("the fiducial marks lie on one line: the film deformation is not determined")
    design = np.column_stack([d, np.ones(len(d))])
    solved = np.linalg.lstsq(design, b, rcond=None)[0]
    v = design @ solved - b
    matrix = solved[:2].T
    sigma0 = float(np.sqrt(np.sum(v * v) / (2 * len(a) - 6)))
    return Film(np.asarray(matrix), np.asarray(solved[2] - matrix @ centre), np.asarray(v), sigma0)


def refraction_constant(flying_height: float, ground_height: float = 0.0) -> float:
    """Return the constant K of atmospheric refraction in the standard atmosphere.

    Parameters
    ----------
    flying_height, ground_height : float
        Above sea level, m; between -1 and 20 km.

    Returns
    -------
    float
        Angle in radians by which a ray at 45 degrees off the nadir seems to come from farther outside.

    Raises
    ------
    UsageError
        If the camera is not above the ground, or a height is beyond the atmosphere's two layers.

    Notes
    -----
    K = 1 / (H - h) times the integral of n(z) - n(H) from h to H: Snell's law to first order. The refractive index is 1 + 2.26e-4 m^3/kg
    times the density of the ICAO standard atmosphere (Doc 7488): temperature 288.15 K - 6.5 K/km up to 11 km, constant above. Wolf &
    Dewitt, Elements of Photogrammetry (2000), section 4-13.

    Examples
    --------
    >>> round(1e6 * refraction_constant(6000.0), 1)
    58.9
    """
    if not flying_height > ground_height:
        raise UsageError(f"the flying height {flying_height} is not above the ground, {ground_height}")
    if not (ground_height >= -1000.0 and flying_height <= 20_000.0):
        raise UsageError(f"heights of {ground_height} and {flying_height} m are not within -1 and 20 km")
    total = _density_integral(flying_height) - _density_integral(ground_height)
    return float(2.26e-4 * (total / (flying_height - ground_height) - _density(flying_height)))


_POWER, _LAPSE, _SURFACE, _PAUSE = 4.2559, 6.5e-3, 288.15, 11_000.0
_SCALE_HEIGHT = 6341.6  # m, of the isothermal layer


def _density(z: float) -> float:
    """Return the density of the standard atmosphere, kg/m^3."""
    low = 1.225 * (1.0 - _LAPSE * min(z, _PAUSE) / _SURFACE) ** _POWER
    return float(low * np.exp(-max(z - _PAUSE, 0.0) / _SCALE_HEIGHT))


def _density_integral(z: float) -> float:
    """Return the integral of the density from sea level to z, kg/m^2."""
    low = 1.225 * _SURFACE / (_LAPSE * (_POWER + 1.0)) * (1.0 - (1.0 - _LAPSE * min(z, _PAUSE) / _SURFACE) ** (_POWER + 1.0))
    return float(low - _density(_PAUSE) * _SCALE_HEIGHT * np.expm1(-max(z - _PAUSE, 0.0) / _SCALE_HEIGHT))


def correct_refraction(xy: ArrayLike, principal_distance: float, flying_height: float, ground_height: float = 0.0) -> Floats:
    """Correct atmospheric refraction of a vertical image, which displaces points outwards.

    Parameters
    ----------
    xy : (n, 2) array_like
    principal_distance : float
        In the unit of xy.
    flying_height, ground_height : float
        Above sea level, m.

    Returns
    -------
    (n, 2) array
        r - K r (1 + r^2 / c^2).

    Raises
    ------
    UsageError
        If xy is no (n, 2) array, or the heights make no sense.

    Notes
    -----
    See `refraction_constant`.

    Examples
    --------
    >>> correct_refraction([[100.0, 0.0]], 150.0, 6000.0).round(5)
    array([[99.9915,  0.    ]])
    """
    p = _plane(xy)
    k = refraction_constant(flying_height, ground_height)
    return np.asarray(p * (1.0 - k * (1.0 + np.sum(p * p, axis=1) / principal_distance**2))[:, None])


def correct_earth_curvature(xy: ArrayLike, principal_distance: float, height_above_ground: float, radius: float = EARTH_RADIUS) -> Floats:
    """Correct the curvature of the Earth in a vertical image, which displaces points inwards where object coordinates are map coordinates.

    Parameters
    ----------
    xy : (n, 2) array_like
    principal_distance : float
        In the unit of xy.
    height_above_ground : float
        m.
    radius : float
        Of the Earth, m.

    Returns
    -------
    (n, 2) array
        r + H r^3 / (2 R c^2).

    Raises
    ------
    UsageError
        If xy is no (n, 2) array.

    Notes
    -----
    Manual of Photogrammetry, 4th ed. (1980), p. 488. For object coordinates in a tangential or geocentric system no such correction is due.

    Examples
    --------
    >>> correct_earth_curvature([[100.0, 0.0]], 150.0, 6000.0).round(5)
    array([[100.02093, 0. ]])
    """
    p = _plane(xy)
    factor = 1.0 + height_above_ground / (2.0 * radius * principal_distance**2) * np.sum(p * p, axis=1)
    return np.asarray(p * factor[:, None])
