"""An order of the object points in which neighbours are seen by the same images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

BASE = 16  # points of the smallest cluster
SAMPLE = 10_000  # points from which the extent of the object is taken
CELLS = 500  # small clusters from which orders are compared


def rank_of_points(coordinates: Floats) -> Ints:
    """Return the rank of each point along a space-filling curve (Morton 1966), points without coordinates last.

    Parameters
    ----------
    coordinates : (n, 3) array
        Approximate coordinates; NaN = unknown.

    Returns
    -------
    (n,) int array

    Examples
    --------
    >>> rank_of_points(np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 0.0], [1.0, 0.0, 0.0]]))
    array([0, 2, 1])
    """
    known = np.isfinite(coordinates).all(axis=1)
    key = np.full(len(coordinates), np.iinfo(np.int64).max)
    if known.any():
        x = coordinates[known]
        low, high = np.quantile(x[:: len(x) // SAMPLE + 1], (0.01, 0.99), axis=0)
        size = np.maximum(high - low, 1e-300)
        # one scale for all axes, so that cells are cubes and the relief of flat objects does not count
        cells = np.floor(np.clip((x - low) / size.max(), 0.0, 1.0) * (2**20 - 1)).astype(np.int64)
        key[known] = sum(_spread(cells[:, k]) << k for k in range(3))
    rank = np.empty(len(key), dtype=np.intp)
    rank[np.argsort(key, kind="stable")] = np.arange(len(key))
    return rank


def rank_for(groups: Sequence[Any], coordinates: Floats) -> Ints:
    """Return the rank of points by place or by the images that see them, whichever puts points of the same images together.

    Parameters
    ----------
    groups : sequence of observation groups
    coordinates : (n, 3) array
        Approximate coordinates; NaN = unknown.
    """
    seen = [g for g in groups if hasattr(g, "images") and hasattr(g, "points")]
    by_place = rank_of_points(coordinates)
    if not seen or not len(coordinates):
        return by_place
    images, points = np.concatenate([g.images for g in seen]), np.concatenate([g.points for g in seen])
    first, last = np.full(len(coordinates), np.iinfo(np.intp).max), np.full(len(coordinates), -1)
    np.minimum.at(first, points, images)
    np.maximum.at(last, points, images)
    by_image = np.empty(len(coordinates), dtype=np.intp)
    by_image[np.lexsort((last, first))] = np.arange(len(coordinates))
    return min((by_place, by_image), key=lambda rank: _spread_of_images(rank, images, points))


def _spread_of_images(rank: Ints, images: Ints, points: Ints) -> float:
    """Return how many images see the points of a small cluster, as a mean of squares over some of the clusters."""
    step = max(1, (len(rank) // BASE) // CELLS)
    cluster = rank // BASE
    chosen = np.where(cluster % step == 0, cluster // step, -1)[points]
    some = np.flatnonzero(chosen >= 0)
    pairs = np.unique(chosen[some] * (int(images.max(initial=0)) + 1) + images[some])
    return float(np.mean(np.unique(pairs // (int(images.max(initial=0)) + 1), return_counts=True)[1] ** 2.0))


def _spread(x: NDArray[np.int64]) -> NDArray[np.int64]:
    """Put two zero bits between the bits of 20-bit numbers."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << shift)) & mask
    return x
