"""Spatial intersection: object points from rays of oriented images, for many points at once."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import UsageError

Array = NDArray[np.float64]
Codes = NDArray[np.intp]


class PointStatus(IntEnum):
    """Outcome of the intersection of one point."""

    OK = 0
    TOO_FEW_RAYS = 1
    ALMOST_PARALLEL = 2
    BEHIND_CAMERA = 3


@dataclass(frozen=True)
class Intersection:
    """Intersected points.

    Attributes
    ----------
    points : ndarray (np, 3)
        Object coordinates; NaN where there are too few rays or these are almost parallel; the point closest to the rays, without further
        refinement, where it lies behind a camera.
    status : ndarray (np,) of int
        One `PointStatus` per point.
    rays : ndarray (np,) of int
        Number of rays.
    angles : ndarray (np,)
        Largest angle between two rays seen as straight lines (0 to pi/2, radians); exact for two rays, found by two sweeps for more, which
        gives at least half of it; NaN without rays.
    rms : ndarray (np,)
        Root mean square of the image residuals of the point's rays, normalised image coordinates; NaN unless the status is OK.
    """

    points: Array
    status: NDArray[np.int8]
    rays: Codes
    angles: Array
    rms: Array


def intersect(
    xy: ArrayLike,
    rotations: ArrayLike,
    positions: ArrayLike,
    point: ArrayLike,
    n_points: int | None = None,
    *,
    sigmas: ArrayLike | None = None,
    min_angle: float = 1e-3,
    min_rays: int = 2,
    iterations: int = 3,
) -> Intersection:
    """Object points from the rays of oriented images, all points at once.

    First the point closest to its rays (linear, each ray weighted by the inverse square of its length), then Gauss-Newton steps on
    the image residuals; a step that does not decrease a point's sum of squares is not taken. Coordinates are reduced to the mean of
    each point's projection centres.

    Parameters
    ----------
    xy : array_like (N, 2)
        Normalised image coordinates of the rays, x = -U/W, y = -V/W.
    rotations : array_like (N, 3, 3)
        Camera-from-object rotation of each ray's image (or anything that broadcasts, such as one rotation for all).
    positions : array_like (N, 3)
        Projection centre of each ray's image.
    point : array_like (N,) of int
        Which point a ray belongs to, 0 to n_points - 1, in any order.
    n_points : int, optional
        Number of points; by default the largest code plus one.
    sigmas : array_like (N,) or (N, 2), optional
        Standard deviations of `xy`.
    min_angle : float
        Points whose rays differ less (radians) are not intersected.
    min_rays : int
        Points of fewer rays are not intersected; at least 2.
    iterations : int
        Gauss-Newton steps.

    Returns
    -------
    Intersection
        Coordinates, status, number of rays, angle and fit of every point.

    Raises
    ------
    UsageError
        Arrays that do not match or are not finite, point codes out of range, min_rays below 2.

    References
    ----------
    .. [1] Förstner, Wrobel: Photogrammetric Computer Vision, Springer 2016, sections 10.5.3 and 13.4.

    Examples
    --------
    >>> down = np.eye(3)
    >>> found = intersect([[0.1, 0.2], [-0.1, 0.2]], down, [[0, 0, 10], [2, 0, 10]], [0, 0])
    >>> [float(v) for v in found.points[0].round(9)], PointStatus(found.status[0]).name
    ([1.0, 2.0, 0.0], 'OK')
    """
    image, M, X0, code, count, weight = _checked(xy, rotations, positions, point, n_points, sigmas)
    if min_rays < 2:
        raise UsageError(f"min_rays must be at least 2, not {min_rays}")
    rays = np.bincount(code, minlength=count)
    few = rays < min_rays
    origin = _sums(X0, code, count) / np.maximum(rays, 1)[:, None]
    base = X0 - origin[code]
    directions = np.einsum("nji,nj->ni", M, np.column_stack([image, -np.ones(len(image))]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angles = _largest_angles(directions, code, count)
    with np.errstate(invalid="ignore"):
        parallel = ~few & ~(angles >= min_angle)
    solvable = ~few & ~parallel
    status = np.select([few, parallel], [PointStatus.TOO_FEW_RAYS, PointStatus.ALMOST_PARALLEL], PointStatus.OK).astype(np.int8)

    X = np.full((count, 3), np.nan)
    use = solvable[code]
    image, M, base, code, weight, directions = image[use], M[use], base[use], code[use], weight[use], directions[use]
    X[solvable] = _closest(directions, base, np.ones(len(code)), code, count)[solvable]
    lengths = np.sum((X[code] - base) ** 2, axis=1)
    positive = lengths > 0
    per_length = np.where(positive, 1.0 / np.where(positive, lengths, 1.0), 1.0) * np.sum(weight**2, axis=1)
    X[solvable] = _closest(directions, base, per_length, code, count)[solvable]

    cost = _costs(image, M, base, weight, X, code, count)
    behind = solvable & ~np.isfinite(cost)
    status[behind] = PointStatus.BEHIND_CAMERA
    moving = solvable & ~behind
    for _ in range(iterations):
        step = _newton_step(image, M, base, weight, X, code, count, moving)
        new = np.where(moving[:, None], X + step, X)
        new_cost = _costs(image, M, base, weight, new, code, count)
        better = moving & (new_cost <= cost)
        X[better], cost[better] = new[better], new_cost[better]
        moving = better
        if not moving.any():
            break
    ok = status == PointStatus.OK
    rms = np.full(count, np.nan)
    weights = np.bincount(code, np.sum(weight**2, axis=1), count)
    rms[ok] = np.sqrt(cost[ok] / weights[ok])
    return Intersection(X + origin, status, rays, angles, rms)


def _checked(
    xy: ArrayLike, rotations: ArrayLike, positions: ArrayLike, point: ArrayLike, n_points: int | None, sigmas: ArrayLike | None
) -> tuple[Array, Array, Array, Codes, int, Array]:
    image, code = np.asarray(xy, dtype=np.float64), np.asarray(point)
    n = len(image) if image.ndim else 0
    if image.shape != (n, 2) or code.shape != (n,):
        raise UsageError(f"image coordinates (n, 2) and point codes (n,) are needed, not {image.shape} and {code.shape}")
    if n and not np.issubdtype(code.dtype, np.integer):
        raise UsageError("point codes must be integers")
    try:
        M = np.broadcast_to(np.asarray(rotations, dtype=np.float64), (n, 3, 3))
        X0 = np.broadcast_to(np.asarray(positions, dtype=np.float64), (n, 3))
    except ValueError:
        raise UsageError(f"rotations (n, 3, 3) and positions (n, 3) are needed for {n} rays") from None
    count = (int(code.max()) + 1 if n else 0) if n_points is None else n_points
    if n and (int(code.min()) < 0 or int(code.max()) >= count):
        raise UsageError(f"point codes must be from 0 to {count - 1}, they are from {code.min()} to {code.max()}")
    weight = np.ones((n, 2))
    if sigmas is not None:
        given = np.asarray(sigmas, dtype=np.float64)
        if given.shape not in ((n,), (n, 2)) or not np.all(given > 0) or not np.all(np.isfinite(given)):
            raise UsageError("sigmas must be positive and of shape (n,) or (n, 2)")
        weight = np.broadcast_to(1.0 / (given[:, None] if given.ndim == 1 else given), (n, 2))
    if not (np.all(np.isfinite(image)) and np.all(np.isfinite(M)) and np.all(np.isfinite(X0))):
        raise UsageError("coordinates and rotations must be finite numbers")
    return image, M, X0, code.astype(np.intp), count, weight


def _sums(values: Array, code: Codes, count: int) -> Array:
    """Sums of rows that carry the same code: (count, ...)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    sums = np.stack([np.bincount(code, column, count) for column in flat.T], axis=1)
    return np.asarray(sums, dtype=np.float64).reshape(count, *values.shape[1:])


def _largest_angles(directions: Array, code: Codes, count: int) -> Array:
    """Largest angle of two rays per point: from the first ray to the farthest, from that to its farthest."""
    angle = np.full(count, np.nan)
    if len(code) == 0:
        return angle
    order = np.argsort(code, kind="stable")
    d, c = directions[order], code[order]
    start = np.flatnonzero(np.r_[True, c[1:] != c[:-1]])
    group = np.cumsum(np.r_[0, (c[1:] != c[:-1]).astype(np.intp)])
    reference = d[start]
    for _ in range(2):
        sine = np.linalg.norm(np.cross(d, reference[group]), axis=1)
        largest = np.maximum.reduceat(sine, start)
        hit = np.flatnonzero(sine == largest[group])
        reference = d[hit[np.searchsorted(group[hit], np.arange(len(start)))]]
    angle[c[start]] = np.arcsin(np.minimum(largest, 1.0))
    return angle


def _closest(directions: Array, base: Array, weight: Array, code: Codes, count: int) -> Array:
    """Points of the smallest weighted sum of squared distances from their rays."""
    project = (np.eye(3) - directions[:, :, None] * directions[:, None, :]) * weight[:, None, None]
    return _solved(_sums(project, code, count), _sums(np.einsum("nij,nj->ni", project, base), code, count))


def _solved(N: Array, h: Array) -> Array:
    """Solutions of symmetric 3x3 systems, zero where the system is singular (their points are set aside by the caller)."""
    trace = np.einsum("kii->k", N)
    scaled = N / np.where(trace > 0, trace, 1.0)[:, None, None]
    regular = (trace > 0) & (np.linalg.det(scaled) > 0)
    scaled[~regular] = np.eye(3)
    x = np.linalg.solve(scaled, (h / np.where(trace > 0, trace, 1.0)[:, None])[:, :, None])[:, :, 0]
    return np.asarray(np.where(regular[:, None], x, 0.0))


def _costs(image: Array, M: Array, base: Array, weight: Array, X: Array, code: Codes, count: int) -> Array:
    """Weighted sum of squares per point; infinite where a ray sees it from behind."""
    P = np.einsum("nij,nj->ni", M, X[code] - base)
    front = P[:, 2] < 0
    W = np.where(front, P[:, 2], -1.0)
    v = (-P[:, :2] / W[:, None] - image) * weight
    return np.asarray(np.bincount(code, np.where(front, np.sum(v**2, axis=1), np.inf), count), dtype=np.float64)


def _newton_step(image: Array, M: Array, base: Array, weight: Array, X: Array, code: Codes, count: int, moving: NDArray[np.bool_]) -> Array:
    """Gauss-Newton step of every moving point."""
    k = moving[code]
    M, weight, code = M[k], weight[k], code[k]
    P = np.einsum("nij,nj->ni", M, X[code] - base[k])
    x = -P[:, :2] / P[:, 2:]
    g = (weight / -P[:, 2:])[:, :, None]
    J = g * (M[:, :2] + x[:, :, None] * M[:, 2:])
    v = (x - image[k]) * weight
    return _solved(_sums(np.swapaxes(J, 1, 2) @ J, code, count), -_sums(np.einsum("nij,ni->nj", J, v), code, count))
