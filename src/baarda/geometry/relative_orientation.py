"""Relative orientation of two images from corresponding points, without start values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement, permutations
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import Singular, UsageError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_BATCH = 100  # samples drawn at a time
_MOST = 1000  # samples drawn at most
_SCORED = 400  # points that judge the start values of a large pair
_GROSS = 3.5  # residuals beyond this many sigmas count as grossly wrong (probability 5e-4)
_ROUNDING = 1e-10  # normalised image coordinates closer than this agree but for rounding
_SAME = 1e-4  # orientations closer than this (radians) are one minimum

# monomials of degree 3 in (x, y, z, 1) in the order of Stewenius: the ten leading ones, then the basis of the quotient ring
_LEADING = ["000", "001", "011", "111", "002", "012", "112", "022", "122", "222"]
_ORDER = [*_LEADING, "003", "013", "113", "023", "123", "223", "033", "133", "233", "333"]


@dataclass(frozen=True)
class RelativeOrientation:
    """Orientation of the second image in the system of the first (rotation I, projection centre 0, base length 1).

    Attributes
    ----------
    rotation : ndarray (3, 3)
        Rotation M2 of the second image, camera-from-model: its camera coordinates are M2 (X - base).
    base : ndarray (3,)
        Projection centre of the second image, of length one.
    points : ndarray (n, 3)
        Model points; NaN where the rays do not meet in front of both cameras.
    inliers : ndarray (n,) of bool
        Points that were used; False for those held to be grossly wrong.
    rms : float
        Root mean square of the residuals of the points used: first-order (Sampson) distances, normalised image coordinates.
    residuals : ndarray (n,)
        Signed Sampson distance of every pair from the coplanarity condition.
    alternatives : tuple of RelativeOrientation
        Other local minima over the same points with all of them in front, by increasing rms: a plane allows a second orientation.
    """

    rotation: Array
    base: Array
    points: Array
    inliers: Mask
    rms: float
    residuals: Array
    alternatives: tuple[RelativeOrientation, ...] = ()


def relative_orientation(xy1: ArrayLike, xy2: ArrayLike, *, robust: bool | None = None, seed: int = 0) -> RelativeOrientation:
    """Relative orientation of two calibrated images from five or more corresponding points, also of points in a plane.

    Five-point solutions of sampled minimal sets are judged by all points (least median of squares where `robust`) and by the points
    lying in front of both cameras; the best are refined by least squares of the coplanarity condition in its first-order (Sampson) form.

    Parameters
    ----------
    xy1, xy2 : array_like (n, 2)
        Normalised image coordinates x = -U/W, y = -V/W of the same points in both images, free of distortion.
    robust : bool, optional
        Leave gross errors out; by default for 20 pairs or more.
    seed : int
        Seed of the sampled minimal sets.

    Returns
    -------
    RelativeOrientation
        Rotation and base of the second image, model points, pairs used, fit, and the alternatives that fit the same pairs.

    Raises
    ------
    UsageError
        Fewer than five pairs, or arrays that do not match or are not finite.
    Singular
        No parallax (the base is too short against the precision), or no orientation with the points in front of both cameras.

    References
    ----------
    .. [1] Nister: An efficient solution to the five-point relative pose problem. IEEE PAMI 26, 2004.
    .. [2] Stewenius, Engels, Nister: Recent developments on direct relative orientation. ISPRS Journal 60, 2006.
    .. [3] Hartley, Zisserman: Multiple View Geometry, 2nd ed. 2004, sections 9.6 and 11.4 (four-fold ambiguity, Sampson distance).

    Examples
    --------
    >>> X = np.array([[0, 0, -4], [1, 0, -5], [0, 1, -4], [1, 1, -6], [-1, 1, -5], [-1, -1, -4.0], [2, -1, -7]])
    >>> xy1, P2 = -X[:, :2] / X[:, 2:], X - [1, 0, 0]
    >>> pair = relative_orientation(xy1, -P2[:, :2] / P2[:, 2:])
    >>> bool(np.allclose(pair.base, [1, 0, 0]) and np.allclose(pair.rotation, np.eye(3)) and np.allclose(pair.points, X))
    True
    """
    first, second = np.asarray(xy1, dtype=np.float64), np.asarray(xy2, dtype=np.float64)
    if first.ndim != 2 or first.shape[1] != 2 or first.shape != second.shape:
        raise UsageError(f"both images need coordinates of shape (n, 2), not {first.shape} and {second.shape}")
    n = len(first)
    if n < 5:
        raise UsageError(f"a relative orientation needs at least 5 corresponding points, there are {n}")
    if not (np.all(np.isfinite(first)) and np.all(np.isfinite(second))):
        raise UsageError("image coordinates must be finite numbers")
    use_robust = n >= 20 if robust is None else robust
    if use_robust and n < 7:
        raise UsageError(f"a robust relative orientation needs at least 7 corresponding points, there are {n}")
    r1, r2 = (np.column_stack([image, -np.ones(n)]) for image in (first, second))
    rng = np.random.default_rng(seed)
    some = np.arange(n) if n <= _SCORED else np.sort(rng.permutation(n)[:_SCORED])
    M, B = _start(r1, r2, some, use_robust, rng)
    if len(M) == 0:
        raise Singular("the corresponding points determine no relative orientation")
    inliers = _agreeing(r1, r2, some, M, B) if use_robust else np.ones(n, dtype=np.bool_)
    for chosen in (
        some[inliers[some]],
        np.flatnonzero(inliers),
    ):  # the minima over some points first: most start values lead to the same few
        M, B = _descend(r1[chosen], r2[chosen], M, B, np.ones((len(M), len(chosen)), dtype=np.bool_))
        kept = _distinct(M, B, np.arange(len(M)), 10, _SAME)
        M, B = M[kept], B[kept]
    s = _sampson(r1, r2, _essential(M, B))
    cost = np.sum(s[:, inliers] ** 2, axis=1)
    sigma = np.sqrt(cost / max(int(inliers.sum()) - 5, 1))
    _require_parallax(r1[inliers], r2[inliers], float(sigma.min()))
    behind = np.array([_behind(r1[inliers], r2[inliers], M[k], B[k], sigma[k]).sum() for k in range(len(M))])
    kept = [k for k in _distinct(M, B, np.lexsort((cost, behind)), 10, _SAME) if behind[k] == 0 or behind[k] <= 0.02 * inliers.sum()]
    if not kept:
        raise Singular(
            "no relative orientation places all corresponding points in front of both cameras: wrong correspondences or too little parallax"
        )
    kept.sort(key=lambda k: float(cost[k]))
    found = [
        RelativeOrientation(M[k], B[k], _points(r1, r2, M[k], B[k]), inliers, float(np.sqrt(np.mean(s[k, inliers] ** 2))), s[k])
        for k in kept
    ]
    return replace(found[0], alternatives=tuple(found[1:]))


def _start(r1: Array, r2: Array, some: NDArray[np.intp], robust: bool, rng: np.random.Generator) -> tuple[Array, Array]:
    """A few distinct orientations, refined over the points that agree with each of them."""
    n = len(r1)
    essentials, scores = np.empty((0, 3, 3)), np.empty(0)
    drawn, wanted = 0, _BATCH
    while drawn < wanted:
        if comb(n, 5) <= _BATCH:
            samples, wanted = np.array(list(combinations(range(n), 5)), dtype=np.intp), 0
        else:
            samples = np.argsort(rng.random((_BATCH, min(n, 4 * _SCORED))), axis=1)[:, :5]
            samples = samples if n <= 4 * _SCORED else rng.integers(0, n, (_BATCH, 5))
        drawn += len(samples)
        E = _five_point(r1[samples], r2[samples])
        squares = _sampson(r1[some], r2[some], E) ** 2
        score = _median(squares) if robust else squares.sum(axis=1)
        essentials, scores = np.concatenate([essentials, E]), np.concatenate([scores, score])
        if robust and wanted and len(scores):
            squares = _sampson(r1[some], r2[some], essentials[[np.argmin(scores)]]) ** 2
            share = float(np.mean(squares <= _limit(_variance(_median(squares), len(some)))))
            # so many samples that one free of gross errors is missed once in a million pairs; ten such samples wanted against noise
            wanted = int(min(_MOST, max(_BATCH, 10 * np.log(1e-6) / np.log(max(1 - share**5, 1e-12)) / 6)))
    if len(scores) == 0:
        return np.empty((0, 3, 3)), np.empty((0, 3))
    order = np.argsort(scores, kind="stable")[:60]
    M, B = _decomposed(r1[some], r2[some], essentials[order], np.sqrt(np.maximum(scores[order], 0.0)), robust)
    near = np.arange(len(M))
    kept = list(dict.fromkeys([*near[:3].tolist(), *_distinct(M, B, near, 10, 0.03)]))
    M, B = M[kept], B[kept]
    for _ in range(2 if robust else 0):
        squares = _sampson(r1[some], r2[some], _essential(M, B)) ** 2
        M, B = _descend(r1[some], r2[some], M, B, squares <= _limit(_variance(_median(squares), len(some)))[:, None], steps=10)
    return M, B


def _agreeing(r1: Array, r2: Array, some: NDArray[np.intp], M: Array, B: Array) -> Mask:
    """Points that agree with the best orientation, after refining it over them until they stay the same."""
    squares = _sampson(r1[some], r2[some], _essential(M, B)) ** 2
    variance = _variance(_median(squares).min(keepdims=True), len(some))
    limit = _limit(variance)
    hidden = np.array([_behind(r1[some], r2[some], m, b, np.sqrt(variance[0])) for m, b in zip(M, B)])
    best = int(np.argmin(np.where(hidden, limit, np.minimum(squares, limit)).sum(axis=1)))
    M, B = M[[best]], B[[best]]
    inliers = np.zeros(len(r1), dtype=np.bool_)
    for _ in range(10):
        squares = _sampson(r1, r2, _essential(M, B)) ** 2
        if inliers.any():
            redundancy = max(int(inliers.sum()) - 5, 1)
            # the factor follows the quantiles of Student's distribution, within a few per cent
            variance = squares[0, inliers].sum(keepdims=True) / redundancy * (1 + 4 / redundancy) ** 2
        agree = (squares[0] <= _limit(variance)[0]) & ~_behind(r1, r2, M[0], B[0], np.sqrt(variance[0]))
        if np.array_equal(agree, inliers) or agree.sum() < max(6, len(r1) // 3):
            break
        inliers = agree
        M, B = _descend(r1, r2, M, B, inliers[None])
    if not inliers.any():
        raise Singular("no relative orientation agrees with enough of the corresponding points")
    return inliers


def _five_point(r1: Array, r2: Array) -> Array:
    """Real essential matrices (k, 3, 3), r2' E r1 = 0, of samples of five rays (m, 5, 3)."""
    m = len(r1)
    equations = (r2[:, :, :, None] * r1[:, :, None, :]).reshape(m, 5, 9)
    basis = np.linalg.svd(equations)[2][:, 5:].reshape(m, 4, 3, 3)
    # E = x N0 + y N1 + z N2 + N3: det E = 0 and 2 E E'E - tr(E E') E = 0 as ten cubic equations
    gram = np.einsum("maij,mbkj->mabik", basis, basis)
    trace = np.einsum("mabii->mab", gram)
    cubic = 2 * np.einsum("mabik,mckj->mijabc", gram, basis) - np.einsum("mab,mcij->mijabc", trace, basis)
    determinant = np.einsum("mai,mbci->mabc", basis[:, :, 0], np.cross(basis[:, :, None, 1], basis[:, None, :, 2]))
    terms = np.concatenate([cubic.reshape(m, 9, 64), determinant.reshape(m, 1, 64)], axis=1) @ _COLLECT
    regular = np.abs(np.linalg.slogdet(terms[:, :, :10])[0]) > 0
    basis, terms = basis[regular], terms[regular]
    reduced = np.linalg.solve(terms[:, :, :10], terms[:, :, 10:])
    # multiplication by x in the quotient ring with basis x^2 xy y^2 xz yz z^2 x y z 1
    action = np.zeros((len(basis), 10, 10))
    action[:, :6] = -reduced[:, [0, 1, 2, 4, 5, 7]]
    action[:, [6, 7, 8, 9], [0, 1, 3, 6]] = 1.0
    action = action[np.all(np.isfinite(action), axis=(1, 2))]
    vectors = np.swapaxes(np.linalg.eig(action)[1], 1, 2)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        xyz = vectors[..., 6:9] / vectors[..., 9:]
        real = np.all(np.isfinite(xyz), axis=2) & (np.abs(xyz.imag).max(axis=2) <= 1e-3 * (1 + np.abs(xyz.real).max(axis=2)))
    coefficients = np.concatenate([np.where(real[..., None], xyz.real, 0.0), np.ones((*real.shape, 1))], axis=2)
    E = np.einsum("mka,maij->mkij", coefficients, basis)[real]
    return np.asarray(E / np.linalg.norm(E, axis=(1, 2), keepdims=True))


def _collector() -> Array:
    """Matrix (64, 20) that sums the ordered products w_a w_b w_c of the same monomial."""
    S = np.zeros((4, 4, 4, 20))
    for a, b, c in combinations_with_replacement(range(4), 3):
        for place in set(permutations((a, b, c))):
            S[(*place, _ORDER.index(f"{a}{b}{c}"))] = 1.0
    return S.reshape(64, 20)


_COLLECT = _collector()


def _decomposed(r1: Array, r2: Array, E: Array, size: Array, robust: bool) -> tuple[Array, Array]:
    """Rotation and base of every essential matrix: of the four, those that have the most points in front of both cameras."""
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.linalg.det(U)[:, None, None], Vt * np.linalg.det(Vt)[:, None, None]
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    M, B = np.empty_like(E), np.empty((len(E), 3))
    for k in range(len(E)):
        options = [(U[k] @ W @ Vt[k], sign * Vt[k, 2]) for W in (quarter, quarter.T) for sign in (1.0, -1.0)]
        noise = float(size[k]) if robust else float(size[k] / np.sqrt(len(r1)))
        M[k], B[k] = options[int(np.argmin([_behind(r1, r2, m, b, noise).sum() for m, b in options]))]
    return M, B


def _essential(M: Array, B: Array) -> Array:
    """E = M [B]x for stacks of rotations and bases: r2' E r1 is the volume of base and rays."""
    K = np.zeros((len(B), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -B[:, 2], B[:, 1], -B[:, 0]
    return np.asarray(M @ (K - np.swapaxes(K, 1, 2)))


def _sampson(r1: Array, r2: Array, E: Array) -> Array:
    """First-order distances (k, n) of all pairs from the coplanarity condition of every E."""
    a, b = np.einsum("kij,nj->kni", E, r1), np.einsum("kji,nj->kni", E, r2)
    norm = np.sqrt(a[..., 0] ** 2 + a[..., 1] ** 2 + b[..., 0] ** 2 + b[..., 1] ** 2)
    volume = np.einsum("kni,ni->kn", a, r2)
    return np.asarray(volume / np.where(norm > 0, norm, np.inf))


def _descend(r1: Array, r2: Array, M: Array, B: Array, use: Mask, steps: int = 50) -> tuple[Array, Array]:
    """Damped Gauss-Newton on the Sampson distances of several orientations, each over its own points in use."""
    M, B = M.copy(), B.copy()
    damping = np.full(len(M), 1e-4)
    cost = np.sum(np.where(use, _sampson(r1, r2, _essential(M, B)) ** 2, 0.0), axis=1)
    active = use.sum(axis=1) >= 5
    for _ in range(steps):
        k = np.flatnonzero(active)
        if len(k) == 0:
            break
        across = np.stack(_perpendicular(B[k]), axis=1)
        N, h = _normal_equations(r1, r2, M[k], B[k], across, use[k])
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("kii->ki", N), np.finfo(np.float64).tiny))
        scaled = N * scale[:, :, None] * scale[:, None, :] + np.eye(5) * damping[k, None, None]
        step = scale * np.linalg.solve(scaled, (h * scale)[:, :, None])[:, :, 0]
        Mn, Bn = _turn(step[:, :3]) @ M[k], B[k] + np.einsum("ki,kij->kj", step[:, 3:], across)
        Bn /= np.linalg.norm(Bn, axis=1, keepdims=True)
        new = np.sum(np.where(use[k], _sampson(r1, r2, _essential(Mn, Bn)) ** 2, 0.0), axis=1)
        better = new <= cost[k]
        done = (np.abs(step).max(axis=1) < 1e-13) | (better & (cost[k] - new <= 1e-15 * cost[k]) & (damping[k] < 1e-6))
        done |= ~better & (damping[k] > 1e8)
        M[k[better]], B[k[better]], cost[k[better]] = Mn[better], Bn[better], new[better]
        damping[k] = np.where(better, np.maximum(damping[k] / 10, 1e-14), damping[k] * 10)
        active[k] = ~done
    return M, B


def _normal_equations(r1: Array, r2: Array, M: Array, B: Array, across: Array, use: Mask) -> tuple[Array, Array]:
    """J'J and -J's for rotation increments about the second camera's axes and two shifts across the base."""
    E = _essential(M, B)
    turned = [_essential(np.broadcast_to(np.eye(3), M.shape), np.broadcast_to(axis, B.shape)) @ E for axis in np.eye(3)]
    shifted = [_essential(M, across[:, i]) for i in (0, 1)]
    a, b = np.einsum("kij,nj->kni", E, r1)[..., :2], np.einsum("kji,nj->kni", E, r2)[..., :2]
    square = np.sum(a**2, axis=2) + np.sum(b**2, axis=2)
    square = np.where(square > 0, square, np.inf)
    s = np.einsum("kni,kij,nj->kn", r2[None].repeat(len(M), 0), E, r1, optimize=True) / np.sqrt(square)
    columns = []
    for D in (*turned, *shifted):
        da, db = np.einsum("kij,nj->kni", D, r1), np.einsum("kji,nj->kni", D, r2)[..., :2]
        slope = np.sum(a * da[..., :2], axis=2) + np.sum(b * db, axis=2)
        columns.append(np.einsum("kni,ni->kn", da, r2) / np.sqrt(square) - s * slope / square)
    J = np.where(use[:, :, None], np.stack(columns, axis=2), 0.0)
    return np.swapaxes(J, 1, 2) @ J, -np.einsum("kni,kn->ki", J, s)


def _perpendicular(B: Array) -> tuple[Array, Array]:
    """Two unit vectors across each base."""
    axis = np.eye(3)[np.argmin(np.abs(B), axis=1)]
    first = np.cross(B, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(B, first)


def _turn(vectors: Array) -> Array:
    """Rotation matrices of rotation vectors (k, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    K = _essential(np.broadcast_to(np.eye(3), (len(vectors), 3, 3)), vectors)
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * half**2 * (K @ K))


def _ranges(r1: Array, r2: Array, M: Array, B: Array) -> tuple[Array, Array, Array]:
    """Multiples of both rays at which they are closest, times |d1 x d2|^2, which is the third value."""
    d2 = r2 @ M
    across = np.cross(r1, d2)
    return np.sum(np.cross(B, d2) * across, axis=1), np.sum(np.cross(B, r1) * across, axis=1), np.sum(across**2, axis=1)


def _behind(r1: Array, r2: Array, M: Array, B: Array, noise: float) -> Mask:
    """Points whose rays meet behind a camera, unless their parallax is within the noise (far points)."""
    first, second, square = _ranges(r1, r2, M, B)
    lengths = np.sum(r1**2, axis=1) * np.sum(r2**2, axis=1)
    seen = square > (_GROSS * max(float(noise), _ROUNDING)) ** 2 * lengths
    return np.asarray(seen & ((first <= 0) | (second <= 0)))


def _points(r1: Array, r2: Array, M: Array, B: Array) -> Array:
    """Midpoints of the closest points of both rays, NaN unless in front of both cameras."""
    first, second, square = _ranges(r1, r2, M, B)
    meets = (first > 0) & (second > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = (r1 * (first / square)[:, None] + B + (r2 @ M) * (second / square)[:, None]) / 2
    return np.where(meets[:, None], middle, np.nan)


def _require_parallax(r1: Array, r2: Array, sigma: float) -> None:
    """Refuse pairs of rays that a rotation alone explains as well as a base does."""
    u1, u2 = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in (r1, r2))
    U, _, Vt = np.linalg.svd(u2.T @ u1)
    R = (U * [1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    difference = float(np.sqrt(np.sum((u2 - u1 @ R.T) ** 2) / (2 * len(u1))))
    if difference <= max(2 * sigma, _ROUNDING):
        raise Singular(
            f"no parallax: a rotation alone fits the corresponding points to {difference:.2g} (normalised), the base is too short"
        )


def _distinct(M: Array, B: Array, order: NDArray[np.intp], limit: int, same: float) -> list[int]:
    """Indices of the first orientations in `order` that differ from all earlier ones."""
    kept: list[int] = []
    for k in order:
        if not any(max(np.abs(M[k] - M[j]).max(), np.abs(B[k] - B[j]).max()) < same for j in kept):
            kept.append(int(k))
        if len(kept) == limit:
            break
    return kept


def _median(squares: Array) -> Array:
    """Median of each row, the upper one of two."""
    half = squares.shape[1] // 2
    return np.asarray(np.partition(squares, half, axis=1)[:, half])


def _variance(median: Array, n: int) -> Array:
    """Variance from the median square of a normal residual, with Rousseeuw's correction for few points."""
    return np.asarray(median * (1.4826 * (1 + 5 / (n - 5))) ** 2)


def _limit(variance: Array) -> Array:
    """Largest square of a residual that still agrees, never below rounding."""
    return np.asarray(_GROSS**2 * np.maximum(variance, _ROUNDING**2))
