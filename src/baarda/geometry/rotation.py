"""Rotation matrices M (camera from object), their angles and their increments.

M = R3(kappa) R2(phi) R1(omega) turns the axes of the object into those of the camera. Unknowns of an adjustment are three increments
theta about the camera axes, M_new = exp([theta]x) M; omega, phi and kappa are derived for people to read.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def skew(v: Floats) -> Floats:
    """Return the matrices [v]x with [v]x a = v x a, (..., 3) to (..., 3, 3).

    Examples
    --------
    >>> skew(np.array([0.0, 0.0, 1.0])) @ np.array([1.0, 0.0, 0.0])
    array([0., 1., 0.])
    """
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp(theta: Floats) -> Floats:
    """Return the rotation matrices exp([theta]x) of rotation vectors (Rodrigues), (..., 3) in radians to (..., 3, 3).

    Examples
    --------
    >>> np.round(exp(np.array([0.0, 0.0, np.pi / 2])) @ np.array([1.0, 0.0, 0.0]), 12)
    array([0., 1., 0.])
    """
    theta = np.asarray(theta, dtype=float)
    angle = np.linalg.norm(theta, axis=-1)[..., None, None]
    k = skew(theta)
    # np.sinc keeps both coefficients exact at zero: sin(t)/t and (1 - cos t)/t^2 = (sin(t/2)/(t/2))^2 / 2
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (k @ k))


def log(m: Floats) -> Floats:
    """Return the rotation vectors of rotation matrices, (..., 3, 3) to (..., 3) in radians.

    Examples
    --------
    >>> np.round(log(exp(np.array([0.1, -0.2, 0.3]))), 12)
    array([ 0.1, -0.2,  0.3])
    """
    from scipy.spatial.transform import Rotation

    flat = np.asarray(m, dtype=float).reshape(-1, 3, 3)
    return np.asarray(Rotation.from_matrix(flat).as_rotvec()).reshape(*np.shape(m)[:-2], 3)


def from_angles(omega: Floats | float, phi: Floats | float, kappa: Floats | float) -> Floats:
    """Return M = R3(kappa) R2(phi) R1(omega), camera from object.

    Parameters
    ----------
    omega, phi, kappa : (...) arrays
        Angles in radians.

    Returns
    -------
    (..., 3, 3) array

    Notes
    -----
    Kraus, Photogrammetry (2007), appendix 2.1: M is the transpose of R_omega R_phi R_kappa.

    Examples
    --------
    >>> np.allclose(from_angles(0.1, 0.2, 0.3) @ from_angles(0.1, 0.2, 0.3).T, np.eye(3))
    True
    """
    angles = [np.asarray(a, dtype=float) for a in (omega, phi, kappa)]
    so, co, sp, cp, sk, ck = (f(a) for a in angles for f in (np.sin, np.cos))
    rows = [
        [cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck],
        [-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk],
        [sp, -so * cp, co * cp],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def to_angles(m: Floats) -> Floats:
    """Return omega, phi, kappa of rotation matrices, (..., 3, 3) to (..., 3) in radians; |phi| <= pi/2.

    At |phi| = pi/2 omega and kappa are not separable: omega is then set to zero.

    Examples
    --------
    >>> np.round(to_angles(from_angles(0.1, -0.2, 3.0)), 12)
    array([ 0.1, -0.2,  3. ])
    """
    m = np.asarray(m, dtype=float)
    cos_phi = np.hypot(m[..., 0, 0], m[..., 1, 0])
    phi = np.arctan2(m[..., 2, 0], cos_phi)
    singular = cos_phi < 1e-12
    omega = np.where(singular, 0.0, np.arctan2(-m[..., 2, 1], m[..., 2, 2]))
    kappa = np.where(singular, np.arctan2(m[..., 0, 1], m[..., 1, 1]), np.arctan2(-m[..., 1, 0], m[..., 0, 0]))
    return np.stack([omega, phi, kappa], axis=-1)


def angle_partials(m: Floats) -> Floats:
    """Return the partials of (omega, phi, kappa) with respect to increments theta about the camera axes.

    Parameters
    ----------
    m : (..., 3, 3) array
        Rotation matrices; M_new = exp([theta]x) M.

    Returns
    -------
    (..., 3, 3) array
        NaN where |phi| = pi/2, where the angles have no partials.

    Notes
    -----
    Turning the axes by d-omega, d-phi, d-kappa turns vectors by the opposite of
    theta = -(R3 R2 e1 d-omega + R3 e2 d-phi + e3 d-kappa); the matrix is the inverse of that relation.

    Examples
    --------
    >>> angle_partials(np.eye(3)) + np.eye(3)
    array([[0., 0., 0.], [0., 0., 0.], [0., 0., 0.]])
    """
    angles = to_angles(m)
    sp, cp = np.sin(angles[..., 1]), np.cos(angles[..., 1])
    sk, ck = np.sin(angles[..., 2]), np.cos(angles[..., 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        inv = np.where(cp < 1e-12, np.nan, 1.0 / cp)
        zero, one = np.zeros_like(cp) + 0.0 * inv, np.ones_like(cp)
        rows = [[-ck * inv, sk * inv, zero], [-sk, -ck, zero], [ck * sp * inv, -sk * sp * inv, -one]]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2) + 0.0
