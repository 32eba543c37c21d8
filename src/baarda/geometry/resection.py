"""Space resection: exterior orientation of one image from control points, without start values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import Singular, UsageError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SPREAD = 12  # points from whose triples start values are formed
_KEPT = 8  # start poses that are refined
_SCORED = 400  # points that judge the start poses of a large image
_GROSS = 4.0  # length of a residual, in sigmas, beyond which a point counts as grossly wrong (probability 3e-4)
_ROUNDING = 1e-10  # normalised image coordinates closer than this agree but for rounding
_SAME = 1e-4  # poses closer than this (radians, shares of the object's distance) are one minimum


@dataclass(frozen=True)
class Resection:
    """Exterior orientation of one image.

    Attributes
    ----------
    rotation : ndarray (3, 3)
        Camera-from-object rotation M.
    position : ndarray (3,)
        Projection centre X0, in the unit of the object coordinates.
    rms : float
        Root mean square of the residuals of the points used, normalised image coordinates (weighted mean where sigmas were given).
    residuals : ndarray (n, 2)
        Computed minus given image coordinates, of all points; NaN for a point behind the camera.
    inliers : ndarray (n,) of bool
        Points that were used; False for those held to be grossly wrong.
    alternatives : tuple of Resection
        Other local minima over the same points, all in front of the camera, by increasing rms: the mirrored pose of a planar
        object, or the other solutions for three points.
    """

    rotation: Array
    position: Array
    rms: float
    residuals: Array
    inliers: Mask
    alternatives: tuple[Resection, ...] = ()


def resect(xy: ArrayLike, XYZ: ArrayLike, sigmas: ArrayLike | None = None, *, robust: bool | None = None, seed: int = 0) -> Resection:
    """Exterior orientation of one image from three or more control points.

    Closed-form poses of many point triples are judged by all points, the best are refined by damped Gauss-Newton steps, and the
    smallest sum of squares with all used points in front of the camera wins. A planar object can have a second minimum [3]_; it is
    sought and returned in `alternatives`. With exactly three points all solutions fit; the one that looks down most steeply comes first.

    Parameters
    ----------
    xy : array_like (n, 2)
        Normalised image coordinates x = -U/W, y = -V/W, free of distortion.
    XYZ : array_like (n, 3)
        Object coordinates, any length unit.
    sigmas : array_like (n,) or (n, 2), optional
        Standard deviations of `xy`. A point within 4 sigma is then never held to be grossly wrong.
    robust : bool, optional
        Search for the pose that most points agree with (least median of squares over sampled triples [4]_) and leave gross errors out;
        by default for eight points or more.
    seed : int
        Seed of the sampled triples.

    Returns
    -------
    Resection
        Pose, fit, points used and alternatives.

    Raises
    ------
    UsageError
        Fewer than three points, or arrays that do not match or are not finite.
    Singular
        Control points (almost) on one line or images of them in one place, or no pose with the points in front of the camera.

    Notes
    -----
    Three points: the pencil of conics of Persson and Nordberg [1]_ (the equations are Grunert's [2]_), with orthonormal bases
    instead of quotients, so that symmetric figures such as a square seen frontally never lead to a division by zero.

    References
    ----------
    .. [1] Persson, Nordberg: Lambda Twist, an accurate fast robust perspective three point (P3P) solver. ECCV 2018.
    .. [2] Haralick, Lee, Ottenberg, Noelle: Review and analysis of solutions of the three point perspective pose estimation problem.
       IJCV 13, 1994.
    .. [3] Schweighofer, Pinz: Robust pose estimation from a planar target. IEEE PAMI 28, 2006.
    .. [4] Rousseeuw: Least median of squares regression. JASA 79, 1984.

    Examples
    --------
    >>> square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    >>> pose = resect([[-0.25, -0.25], [0.25, -0.25], [0.25, 0.25], [-0.25, 0.25]], square)
    >>> [float(v) for v in pose.position.round(6)]
    [0.5, 0.5, 2.0]
    """
    image, weight, reduced, centre, scale = _checked(xy, XYZ, sigmas)
    n = len(image)
    use_robust = n >= 8 if robust is None else robust
    if use_robust and n < 5:
        raise UsageError(f"a robust resection needs at least 5 points, there are {n}")
    if use_robust:
        R, T, inliers = _consensus(image, weight, reduced, sigmas is not None, seed)
    else:
        R, T, inliers = *_minima(image, weight, reduced), np.ones(n, dtype=np.bool_)
    cost = _cost(image, weight, reduced, R, T, inliers)
    R, T, cost = R[np.isfinite(cost)], T[np.isfinite(cost)], cost[np.isfinite(cost)]
    if len(cost) == 0:
        raise Singular("no exterior orientation fits the control points with all of them in front of the camera")
    found = [_result(image, weight, reduced, centre, scale, R[k], T[k], inliers) for k in np.argsort(cost, kind="stable")]
    if n == 3:
        found.sort(key=lambda pose: (pose.rms > _ROUNDING, -pose.rotation[2, 2]))
    return replace(found[0], alternatives=tuple(found[1:4]))


def resect_three(xy: ArrayLike, XYZ: ArrayLike) -> tuple[Resection, ...]:
    """All exterior orientations, up to four, under which three control points appear at the given image coordinates.

    Parameters
    ----------
    xy : array_like (3, 2)
        Normalised image coordinates x = -U/W, y = -V/W.
    XYZ : array_like (3, 3)
        Object coordinates, one point per row, any length unit.

    Returns
    -------
    tuple of Resection
        The solutions with the points in front of the camera, the one that looks down most steeply first.

    Raises
    ------
    UsageError
        Not exactly three points, or numbers that are not finite.
    Singular
        Points on one line, or no position from which the triangle appears under these angles.

    Notes
    -----
    Formulas: see `resect`.

    Examples
    --------
    >>> poses = resect_three([[0, 0.25], [-0.25, -0.25], [0.25, -0.25]], [[0, 1, 0], [-1, -1, 0], [1, -1, 0]])
    >>> bool(min(abs(p.position - [0, 0, 4]).max() for p in poses) < 1e-9)
    True
    """
    if np.shape(xy) != (3, 2):
        raise UsageError(f"three image points of two coordinates are needed, not an array of shape {np.shape(xy)}")
    best = resect(xy, XYZ, robust=False)
    poses = tuple(replace(p, alternatives=()) for p in (best, *best.alternatives) if p.rms <= _ROUNDING)
    if not poses:
        raise Singular("no position sees the three control points under the angles of their image points")
    return poses


def _checked(xy: ArrayLike, XYZ: ArrayLike, sigmas: ArrayLike | None) -> tuple[Array, Array, Array, Array, float]:
    """Image points, weights (1/sigma per coordinate), object points reduced to their centroid and size, centroid, size."""
    image, points = np.asarray(xy, dtype=np.float64), np.asarray(XYZ, dtype=np.float64)
    n = len(image) if image.ndim else 0
    if image.shape != (n, 2) or points.shape != (n, 3):
        raise UsageError(f"image points (n, 2) and object points (n, 3) are needed, not {image.shape} and {points.shape}")
    if n < 3:
        raise UsageError(f"a resection needs at least 3 control points, there are {n}")
    weight = np.ones((n, 2))
    if sigmas is not None:
        given = np.asarray(sigmas, dtype=np.float64)
        if given.shape not in ((n,), (n, 2)) or not np.all(given > 0) or not np.all(np.isfinite(given)):
            raise UsageError("sigmas must be positive and of shape (n,) or (n, 2)")
        weight = np.ascontiguousarray(np.broadcast_to(1.0 / (given[:, None] if given.ndim == 1 else given), (n, 2)))
    if not (np.all(np.isfinite(image)) and np.all(np.isfinite(points))):
        raise UsageError("coordinates must be finite numbers")
    centre = points.mean(axis=0)
    reduced = points - centre
    spread = np.linalg.svd(reduced, compute_uv=False)
    rounding = np.finfo(np.float64).eps * float(np.abs(points).max()) * np.sqrt(n)
    if spread[1] <= 1e-9 * spread[0] + 16 * rounding:
        raise Singular("the control points lie on one straight line: the image can turn about it")
    if float(np.ptp(image, axis=0).max()) <= _ROUNDING:
        raise Singular("the image points of the control points coincide")
    scale = float(spread[0] / np.sqrt(n))
    return image, weight, reduced / scale, centre, scale


def _result(image: Array, weight: Array, points: Array, centre: Array, scale: float, R: Array, T: Array, inliers: Mask) -> Resection:
    """Pose in the units of the object, with its fit."""
    P = points @ R.T + T
    with np.errstate(divide="ignore", invalid="ignore"):
        v = np.where(P[:, 2:] < 0, -P[:, :2] / P[:, 2:] - image, np.nan)
    used, w = v[inliers], weight[inliers] ** 2
    rms = float(np.sqrt(np.sum(w * used**2) / np.sum(w)))
    return Resection(R, centre - scale * (R.T @ T), rms, v, inliers)


def _squares(image: Array, weight: Array, points: Array, R: Array, T: Array) -> Array:
    """Weighted squared residual of every point (columns) under every pose (rows); infinite behind the camera."""
    P = np.einsum("kij,nj->kni", R, points) + T[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        v = (-P[..., :2] / P[..., 2:] - image) * weight
        return np.where(P[..., 2] < 0, np.sum(v**2, axis=-1), np.inf)


def _cost(image: Array, weight: Array, points: Array, R: Array, T: Array, use: Mask) -> Array:
    """Weighted sum of squares of every pose over the points in use (one mask, or one per pose)."""
    return np.asarray(np.where(use, _squares(image, weight, points, R, T), 0.0).sum(axis=1))


def _three_point_poses(rays: Array, points: Array) -> tuple[Array, Array]:
    """Poses P = R X + T from triples: rays (k, 3, 3) of unit length, points (k, 3, 3); up to four poses per triple, in one list.

    Where noise made two solutions complex, their real part is returned: a start value, not a solution.
    """
    pairs = ((0, 1), (0, 2), (1, 2))
    squares = np.stack([np.sum((points[:, i] - points[:, j]) ** 2, axis=1) for i, j in pairs], axis=1)
    forms = np.zeros((len(rays), 3, 3, 3))  # forms[:, p] is |lambda_i b_i - lambda_j b_j|^2 as a quadratic form in lambda
    for p, (i, j) in enumerate(pairs):
        forms[:, p, i, i] = forms[:, p, j, j] = 1.0
        forms[:, p, i, j] = forms[:, p, j, i] = -np.sum(rays[:, i] * rays[:, j], axis=1)
    # two homogeneous conics through the solutions, orthonormal as vectors
    a12, a13, a23 = (squares[:, p, None, None] for p in range(3))
    D1 = _unit(a23 * forms[:, 0] - a12 * forms[:, 2], 2)
    D2 = a23 * forms[:, 1] - a13 * forms[:, 2]
    D2 = _unit(D2 - np.sum(D1 * D2, axis=(1, 2), keepdims=True) * D1, 2)
    D0, D3 = _degenerate_conic(D1, D2)
    s, e = np.linalg.eigh(D0)
    low, high = np.sqrt(np.maximum(-s[:, :1], 0.0)) * e[:, :, 0], np.sqrt(np.maximum(s[:, 2:], 0.0)) * e[:, :, 2]
    found = []
    for sign in (1.0, -1.0):
        normal = _unit(high + sign * low, 1)  # the degenerate conic is this plane and the other one
        basis = np.stack([e[:, :, 1], np.cross(normal, e[:, :, 1])], axis=2)
        m, f = np.linalg.eigh(np.swapaxes(basis, 1, 2) @ D3 @ basis)
        first, second = np.sqrt(np.maximum(-m[:, :1], 0.0)) * f[:, :, 1], np.sqrt(np.maximum(m[:, 1:], 0.0)) * f[:, :, 0]
        found += [np.einsum("kij,kj->ki", basis, first + other * second) for other in (1.0, -1.0)]
    lam = np.stack(found, axis=1)
    lam *= np.where(lam.sum(axis=2, keepdims=True) < 0, -1.0, 1.0)
    P = lam[..., None] * rays[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.sum([np.sum((P[:, :, i] - P[:, :, j]) ** 2, axis=2) for i, j in pairs], axis=0)
        P = P * np.sqrt(squares.sum(axis=1)[:, None] / size)[..., None, None]
        ok = np.all(lam > 0, axis=2) & np.all(np.isfinite(P), axis=(2, 3)) & (size > 0)
    X = np.broadcast_to(points[:, None], P.shape)[ok]
    P = P[ok]
    with np.errstate(divide="ignore", invalid="ignore"):
        R = _triad(P) @ np.swapaxes(_triad(X), 1, 2)
    T = P.mean(axis=1) - np.einsum("kij,kj->ki", R, X.mean(axis=1))
    good = np.all(np.isfinite(R), axis=(1, 2)) & np.all(np.isfinite(T), axis=1)
    return R[good], T[good]


def _degenerate_conic(D1: Array, D2: Array) -> tuple[Array, Array]:
    """The pencil's member of rank two that is best separated from the others, and the member orthogonal to it."""
    # a cubic form has at most three zero directions, so one of four is far from them and can lead
    turns = np.arange(4) * (np.pi / 4)
    lead = np.stack([np.linalg.det(np.cos(a) * D2 - np.sin(a) * D1) for a in turns], axis=1)
    turn = turns[np.argmax(np.abs(lead), axis=1)][:, None, None]
    E1, E2 = np.cos(turn) * D1 + np.sin(turn) * D2, np.cos(turn) * D2 - np.sin(turn) * D1
    c0, c3, plus, minus = (np.linalg.det(D) for D in (E1, E2, E1 + E2, E1 - E2))
    c1, c2 = (plus - minus) / 2 - c3, (plus + minus) / 2 - c0
    c3 = np.where(c3 == 0, np.finfo(np.float64).tiny, c3)
    companion = np.zeros((len(D1), 3, 3))
    companion[:, 1, 0] = companion[:, 2, 1] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        companion[:, :, 2] = np.nan_to_num(np.stack([-c0 / c3, -c1 / c3, -c2 / c3], axis=1), posinf=1e30, neginf=-1e30)
    roots = np.linalg.eigvals(companion)
    g = roots.real
    slope = np.abs(c1[:, None] + g * (2 * c2[:, None] + 3 * g * c3[:, None])) / (1 + g**2)
    slope = np.where(np.abs(roots.imag) <= 1e-7 * (1 + np.abs(g)), slope, -1.0)
    root = np.take_along_axis(g, np.argmax(slope, axis=1)[:, None], axis=1)[:, :, None]
    return _unit(E1 + root * E2, 2), _unit(E2 - root * E1, 2)


def _unit(vectors: Array, axes: int) -> Array:
    """Vectors (or matrices, with axes = 2) of norm one; zeros stay zeros."""
    norm = np.sqrt(np.sum(vectors**2, axis=tuple(range(-axes, 0)), keepdims=True))
    return np.asarray(vectors / np.where(norm > 0, norm, 1.0))


def _triad(triangle: Array) -> Array:
    """Right-handed orthonormal axes (columns) tied to triangles (k, 3, 3)."""
    a, b = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    c = np.cross(a, b)
    c = c / np.linalg.norm(c, axis=1, keepdims=True)
    return np.stack([a, np.cross(c, a), c], axis=2)


def _poses_of(image: Array, points: Array, triples: NDArray[np.intp]) -> tuple[Array, Array]:
    """Start poses from the triples, leaving out those with points on one line or twice the same point."""
    rays = _unit(np.column_stack([image, -np.ones(len(image))]), 1)
    a, b, c = (image[triples[:, k]] for k in range(3))
    apart = np.min([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (a, c), (b, c))], axis=0) > _ROUNDING**2
    triples = triples[apart & (_areas(triples, points) > 1e-12)]
    return _three_point_poses(rays[triples], points[triples])


def _areas(triples: NDArray[np.intp], values: Array) -> Array:
    """Areas of the triangles of image points (2 columns) or object points (3)."""
    corner = np.zeros((len(values), 3))
    corner[:, : values.shape[1]] = values
    a, b, c = (corner[triples[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _large_triples(image: Array, points: Array) -> NDArray[np.intp]:
    """The triples, at most a dozen, that are largest both in the image and in the object, among points spread over the image."""
    chosen = [int(np.argmax(np.sum((image - image.mean(axis=0)) ** 2, axis=1)))]
    distance = np.sum((image - image[chosen[0]]) ** 2, axis=1)
    while len(chosen) < min(_SPREAD, len(image)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.sum((image - image[chosen[-1]]) ** 2, axis=1))
    triples = np.array(list(combinations(sorted(chosen), 3)), dtype=np.intp)
    quality = _areas(triples, points) * _areas(triples, image)
    if float(_areas(triples, points).max()) < 1e-3:  # almost on one line in the object: two of them with the points farthest off it
        line = points[chosen[1]] - points[chosen[0]]
        off = np.linalg.norm(np.cross(points - points[chosen[0]], line), axis=1)
        far = np.argsort(-off, kind="stable")[:_SPREAD]
        extra = np.array([(chosen[0], chosen[1], int(k)) for k in far if int(k) not in chosen[:2]], dtype=np.intp)
        triples = np.vstack([triples, extra])
        quality = _areas(triples, points) * _areas(triples, image)
    return triples[np.argsort(-quality, kind="stable")[:_SPREAD]]


def _mirrored(points: Array, R: Array, T: Array) -> tuple[Array, Array]:
    """The poses that show the best-fitting plane of the points almost alike: reflected along the line of sight to the centroid."""
    normal = np.linalg.svd(points, full_matrices=False)[2][2]
    sight = _unit(T, 1)
    reflect = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
    return reflect @ R @ (np.eye(3) - 2 * np.outer(normal, normal)), T


def _distinct(R: Array, T: Array, order: NDArray[np.intp], limit: int) -> list[int]:
    """Indices of the first poses in `order` that differ from all earlier ones."""
    kept: list[int] = []
    for k in order:
        turn = [np.abs(R[k] - R[j]).max() for j in kept]
        shift = [np.linalg.norm(T[k] - T[j]) / np.linalg.norm(T[j]) for j in kept]
        if not any(t < _SAME and s < _SAME for t, s in zip(turn, shift)):
            kept.append(int(k))
        if len(kept) == limit:
            break
    return kept


def _minima(image: Array, weight: Array, points: Array) -> tuple[Array, Array]:
    """Refined poses of the large triples and their mirror images, over all points."""
    R, T = _poses_of(image, points, _large_triples(image, points))
    everything = np.ones(len(image), dtype=np.bool_)
    cost = _cost(image, weight, points, R, T, everything)
    kept = [k for k in _distinct(R, T, np.argsort(cost, kind="stable"), _KEPT) if np.isfinite(cost[k])]
    R, T = R[kept], T[kept]
    Rm, Tm = _mirrored(points, R, T)
    return _refined(image, weight, points, np.concatenate([R, Rm]), np.concatenate([T, Tm]), everything)


def _refined(image: Array, weight: Array, points: Array, R: Array, T: Array, use: Mask) -> tuple[Array, Array]:
    """Distinct local minima reached from the poses, over the same points in use."""
    R, T = _descend(image[use], weight[use], points[use], R, T, np.ones((len(R), int(use.sum())), dtype=np.bool_))
    cost = _cost(image, weight, points, R, T, use)
    kept = [k for k in _distinct(R, T, np.argsort(cost, kind="stable"), 4) if np.isfinite(cost[k])]
    return R[kept], T[kept]


def _consensus(image: Array, weight: Array, points: Array, sigmas_known: bool, seed: int) -> tuple[Array, Array, Mask]:
    """Minima over the points that agree, found by least median of squares over sampled triples."""
    rng = np.random.default_rng(seed)
    n = len(image)
    # of four random triples the largest in the image: small ones predict badly
    draws = np.argsort(rng.random((1024, min(n, 64))), axis=1)[:, :3] if n <= 64 else rng.integers(0, n, (1024, 3))
    draws = draws.astype(np.intp)
    area = _areas(draws, image).reshape(256, 4)
    triples = draws.reshape(256, 4, 3)[np.arange(256), np.argmax(area, axis=1)]
    R, T = _poses_of(image, points, np.vstack([_large_triples(image, points), triples]))
    if len(R) == 0:
        return R, T, np.ones(n, dtype=np.bool_)
    some = np.arange(n) if n <= _SCORED else np.sort(rng.permutation(n)[:_SCORED])
    scene = image[some], weight[some], points[some]
    median = _median(_squares(*scene, R, T))
    kept = [k for k in _distinct(R, T, np.argsort(median, kind="stable"), _KEPT) if np.isfinite(median[k])]
    Rm, Tm = _mirrored(points, R[kept], T[kept])
    R, T = np.concatenate([R[kept], Rm]), np.concatenate([T[kept], Tm])
    for _ in range(3):  # leave out what disagrees, fit, judge again
        squares = _squares(*scene, R, T)
        near = squares <= _limit(_variance(_median(squares), len(some)), weight, sigmas_known)[:, None]
        R, T = _descend(*scene, R, T, near & np.isfinite(squares), steps=10)
    squares = _squares(*scene, R, T)
    limit = _limit(_variance(_median(squares).min(keepdims=True), len(some)), weight, sigmas_known)
    best = int(np.argmin(np.minimum(squares, limit).sum(axis=1)))
    inliers = np.zeros(n, dtype=np.bool_)
    Rb, Tb = R[[best]], T[[best]]
    for attempt in range(10):
        squares = _squares(image, weight, points, Rb, Tb)
        if attempt == 0:
            variance = _variance(_median(squares), n)
        else:
            variance = np.array([squares[0, inliers].sum() / max(2 * int(inliers.sum()) - 6, 1)])
        agree = squares[0] <= _limit(variance, weight, sigmas_known)[0]
        if np.array_equal(agree, inliers) or agree.sum() < max(4, n // 3):
            break
        inliers = agree
        Rb, Tb = _descend(image, weight, points, Rb, Tb, inliers[None])
    # the other candidates over the same points: a planar object may have its smaller minimum there
    return *_refined(image, weight, points, np.concatenate([Rb, R]), np.concatenate([Tb, T]), inliers), inliers


def _median(squares: Array) -> Array:
    """Median of each row, the upper one of two: at least half of the points are at most this far."""
    half = squares.shape[1] // 2
    return np.asarray(np.partition(squares, half, axis=1)[:, half])


def _variance(median: Array, n: int) -> Array:
    """Variance per coordinate from the median square of a residual's length, with Rousseeuw's correction for few points."""
    return np.asarray(median * (1 + 5 / (n - 3)) ** 2 / (2 * np.log(2)))


def _limit(variance: Array, weight: Array, sigmas_known: bool) -> Array:
    """Largest square of a residual that still agrees; never below rounding, nor below the given sigmas."""
    least = 1.0 if sigmas_known else (_ROUNDING * float(weight.max())) ** 2
    return np.asarray(_GROSS**2 * np.maximum(variance, least))


def _descend(image: Array, weight: Array, points: Array, R: Array, T: Array, use: Mask, steps: int = 50) -> tuple[Array, Array]:
    """Damped Gauss-Newton (Marquardt) on several poses at once, each over its own points in use.

    Unknowns are the rotation about the centroid and the centroid's camera coordinates: for narrow angles far less correlated
    than angles and position. What has not converged soon lies in the flat valley of a plane seen frontally, where residuals hardly
    depend on the tilt to first order: from then on the full second derivatives are used.
    """
    R, T = R.copy(), T.copy()
    damping = np.full(len(R), 1e-4)
    cost = _cost(image, weight, points, R, T, use)
    active = np.isfinite(cost) & (use.sum(axis=1) >= 3)
    for iteration in range(steps):
        k = np.flatnonzero(active)
        if len(k) == 0:
            break
        N, h = _normal_equations(image, weight, points, R[k], T[k], use[k])
        if iteration >= 15:
            N = _curvature(image, weight, points, R[k], T[k], use[k])
        diagonal = np.einsum("kii->ki", N)
        damped = N + np.eye(6) * (damping[k, None] * diagonal + np.finfo(np.float64).tiny)[:, :, None]
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("kii->ki", damped), np.finfo(np.float64).tiny))
        step = scale * np.linalg.solve(damped * scale[:, :, None] * scale[:, None, :], (h * scale)[:, :, None])[:, :, 0]
        Rn, Tn = _turn(step[:, :3]) @ R[k], T[k] + step[:, 3:]
        new = _cost(image, weight, points, Rn, Tn, use[k])
        better = new <= cost[k]
        small = np.abs(step[:, :3]).max(axis=1) + np.linalg.norm(step[:, 3:], axis=1) / np.linalg.norm(T[k], axis=1) < 1e-13
        done = small | (better & (cost[k] - new <= 1e-15 * cost[k]) & (damping[k] < 1e-6)) | (~better & (damping[k] > 1e8))
        R[k[better]], T[k[better]], cost[k[better]] = Rn[better], Tn[better], new[better]
        damping[k] = np.where(better, np.maximum(damping[k] / 10, 1e-14), damping[k] * 10)
        active[k] = ~done
    return R, T


def _normal_equations(image: Array, weight: Array, points: Array, R: Array, T: Array, use: Mask) -> tuple[Array, Array]:
    """J'J and -J'v per pose for rotation increments about the camera axes and T; points not in use have weight zero."""
    Q = np.einsum("kij,nj->kni", R, points)
    P = Q + T[:, None, :]
    W = np.where(use, P[..., 2], -1.0)
    x, y, g = -P[..., 0] / W, -P[..., 1] / W, -1.0 / W
    zero = np.zeros_like(x)
    row_x = np.stack([x * Q[..., 1], Q[..., 2] - x * Q[..., 0], -Q[..., 1], zero + 1, zero, x], axis=-1)
    row_y = np.stack([y * Q[..., 1] - Q[..., 2], -y * Q[..., 0], Q[..., 0], zero, zero + 1, y], axis=-1)
    w = np.where(use[..., None], weight, 0.0)
    J = np.concatenate([row_x * (g * w[..., 0])[..., None], row_y * (g * w[..., 1])[..., None]], axis=1)
    v = np.concatenate([(x - image[:, 0]) * w[..., 0], (y - image[:, 1]) * w[..., 1]], axis=1)
    return np.swapaxes(J, 1, 2) @ J, -np.einsum("kmi,km->ki", J, v)


def _curvature(image: Array, weight: Array, points: Array, R: Array, T: Array, use: Mask) -> Array:
    """Second derivatives of half the sum of squares by central differences, made positive by the absolute eigenvalues."""
    unit = np.concatenate([np.ones((len(R), 3)), np.repeat(np.linalg.norm(T, axis=1)[:, None], 3, axis=1)], axis=1)
    H = np.empty((len(R), 6, 6))
    for i in range(6):
        step = 1e-5 * unit * np.eye(6)[i]
        ends = [_normal_equations(image, weight, points, _turn(d[:, :3]) @ R, T + d[:, 3:], use)[1] for d in (step, -step)]
        H[:, :, i] = (ends[1] - ends[0]) / 2e-5 * unit
    values, vectors = np.linalg.eigh((H + np.swapaxes(H, 1, 2)) / 2)
    positive = (vectors * np.abs(values)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.asarray(positive / (unit[:, :, None] * unit[:, None, :]))


def _turn(vectors: Array) -> Array:
    """Rotation matrices of rotation vectors (k, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    K = np.zeros((len(vectors), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    K = K - np.swapaxes(K, 1, 2)
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * half**2 * (K @ K))
