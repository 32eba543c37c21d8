"""Similarity transformation between two sets of points: scale, rotation, translation in closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import UsageError

Array = NDArray[np.float64]


class Similarity(NamedTuple):
    """Seven-parameter transformation: target = scale * rotation @ source + translation."""

    scale: float
    rotation: Array
    translation: Array

    def apply(self, points: ArrayLike) -> Array:
        """Transform points.

        Parameters
        ----------
        points : array_like (..., 3)
            Coordinates in the source system.

        Returns
        -------
        ndarray (..., 3)
            Coordinates in the target system.

        Examples
        --------
        >>> Similarity(2.0, np.eye(3), np.array([1.0, 0.0, 0.0])).apply([1, 2, 3]).tolist()
        [3.0, 4.0, 6.0]
        """
        return np.asarray(self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation)


def similarity(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None, with_scale: bool = True) -> Similarity:
    """Least-squares similarity transformation that maps source points onto target points.

    Minimises the weighted sum of squared distances in the target system; the rotation is always proper (no reflection), also for
    points in a plane.

    Parameters
    ----------
    source, target : array_like (n, 3)
        Coordinates of the same points in both systems, n >= 3.
    weights : array_like (n,), optional
        Non-negative weight of each point; equal weights by default.
    with_scale : bool
        False fixes the scale at 1 (six parameters).

    Returns
    -------
    Similarity
        scale, rotation (3, 3) and translation (3,), also as a tuple; `apply` transforms points.

    Raises
    ------
    UsageError
        Fewer than three points of positive weight, points on one line, arrays that do not match or are not finite.

    References
    ----------
    .. [1] Umeyama: Least-squares estimation of transformation parameters between two point patterns. IEEE PAMI 13, 1991.
    .. [2] Horn, Hilden, Negahdaripour: Closed-form solution of absolute orientation using orthonormal matrices. JOSA A 5, 1988.

    Examples
    --------
    >>> source = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> scale, rotation, translation = similarity(source, [[5, 0, 0], [5, 2, 0], [3, 0, 0], [5, 0, 2]])
    >>> round(scale, 9), (rotation.round(9) + 0.0).tolist(), (translation.round(9) + 0.0).tolist()
    (2.0, [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [5.0, 0.0, 0.0])
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.ndim != 2 or a.shape[1] != 3 or a.shape != b.shape:
        raise UsageError(f"source and target must both be of shape (n, 3), not {a.shape} and {b.shape}")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (len(a),) or not np.all(np.isfinite(w)) or np.any(w < 0):
        raise UsageError("weights must be non-negative numbers, one per point")
    a, b, w = a[w > 0], b[w > 0], w[w > 0]
    if len(a) < 3:
        raise UsageError(f"a similarity transformation needs at least 3 points, there are {len(a)}")
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        raise UsageError("coordinates must be finite numbers")
    share = w / w.sum()
    centre_a, centre_b = share @ a, share @ b
    da, db = np.sqrt(share)[:, None] * (a - centre_a), np.sqrt(share)[:, None] * (b - centre_b)
    for name, points, given in (("source", da, a), ("target", db, b)):
        s = np.linalg.svd(points, compute_uv=False)
        if s[1] <= 1e-9 * s[0] + 16 * np.finfo(np.float64).eps * float(np.abs(given).max()):
            raise UsageError(f"the {name} points lie on one straight line: the rotation about it is not determined")
    U, D, Vt = np.linalg.svd(db.T @ da)
    if D[1] <= 1e-12 * D[0]:
        raise UsageError("source and target points are so different in shape that the rotation is not determined")
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = (U * proper) @ Vt
    scale = float(np.sum(D * proper) / np.sum(da**2)) if with_scale else 1.0
    return Similarity(scale, rotation, centre_b - scale * (rotation @ centre_a))
