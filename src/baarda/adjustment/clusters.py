"""Clusters of object points: neighbours that see nearly the same nodes, whose part of the reduced system is one dense matrix."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.point_order import BASE

Ints = NDArray[np.intp]
Small = NDArray[np.int32]
Bools = NDArray[np.bool_]

MOST = 1024  # points of the largest cluster
LARGEST = 700_000  # points times columns of the largest cluster
OVERHEAD = 12  # what a cluster costs whatever its points are, in points
SPARSE = 3.5  # clusters wider than this multiple of what a point of theirs touches are treated point by point


def slices(first: Ints, step: int) -> list[tuple[int, int]]:
    """Split a list of ranges into stretches of `step` ranges."""
    count = len(first) - 1
    return [(a, min(a + step, count)) for a in range(0, count, step)]


def clusters_of(first_block: Ints, chunk: Small, row: Small, seen: list[Small], width: Ints) -> tuple[Ints, list[Ints], Bools]:
    """Gather neighbouring points that see nearly the same nodes.

    Parameters
    ----------
    first_block : (P + 1,) int array
    chunk, row : (B,) int32 arrays
        Row blocks sorted by point.
    seen : list of (N, parts) int32 arrays
        For each chunk the nodes of each row block, -1 = none.
    width : int array
        Of each node.

    Returns
    -------
    (C + 1,) int array
        First point of each cluster.
    list of int arrays
        Its nodes.
    (C,) bool array
        Whether its points touch few of its columns each.
    """
    count = len(first_block) - 1
    cuts = np.append(np.arange(0, count, BASE), count) if count else np.zeros(1, dtype=np.intp)
    seen_by: list[frozenset[int]] = []
    for a, b in slices(cuts, 256):
        mark = np.zeros((b - a, len(width)), dtype=bool)
        for i, at, base in stretch(first_block[cuts], a, b, chunk):
            for j in range(seen[i].shape[1]):
                number = seen[i][row[at], j]
                mark[base[number >= 0], number[number >= 0]] = True
        base, number = np.nonzero(mark)
        ends, numbers = np.searchsorted(base, np.arange(b - a + 1)).tolist(), number.tolist()
        seen_by += [frozenset(numbers[i:j]) for i, j in pairwise(ends)]
    effort = np.concatenate([[0.0], np.cumsum(_touched(first_block, cuts[:-1], chunk, row, seen, width).astype(float) ** 2)])
    width_of = width.tolist()
    ends = cuts.tolist()
    widths = [sum([width_of[i] for i in s]) for s in seen_by]
    first, members, sparse = [0], [], []
    k = 0
    while k < len(seen_by):
        union, end = seen_by[k], k + 1
        width = widths[k]
        while end < len(seen_by) and ends[end + 1] - ends[k] <= MOST:
            size = width + sum([width_of[i] for i in seen_by[end] - union])
            points, more = ends[end] - ends[k], ends[end + 1] - ends[end]
            apart = width**2 * (points + OVERHEAD) + widths[end] ** 2 * (more + OVERHEAD)
            if size**2 * (points + more + OVERHEAD) > apart or size * (points + more) > LARGEST:
                break
            union, width, end = union | seen_by[end], size, end + 1
        members.append(np.array(sorted(union), dtype=np.intp))
        first.append(ends[end])
        mean = (effort[end] - effort[k]) / (end - k)
        sparse.append(width > SPARSE * float(np.sqrt(mean)))
        k = end
    return np.array(first, dtype=np.intp), members, np.array(sparse, dtype=bool)


def _touched(first_block: Ints, points: Ints, chunk: Small, row: Small, seen: list[Small], node_width: Ints) -> Ints:
    """Return an upper bound of the columns that some points touch: shared nodes count with every block."""
    width = np.append(node_width, 0)
    first, count = first_block[points], first_block[points + 1] - first_block[points]
    blocks = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
    columns = np.zeros(len(blocks), dtype=np.intp)
    for i, numbers in enumerate(seen):
        at = np.flatnonzero(chunk[blocks] == i)
        columns[at] = width[numbers[row[blocks[at]]]].sum(axis=1)
    total = np.concatenate([[0], np.cumsum(columns)])
    ends = np.cumsum(count)
    return np.asarray(total[ends] - total[ends - count])


def stretch(first: Ints, a: int, b: int, chunk: Small) -> list[tuple[int, Ints, Ints]]:
    """Return for each chunk the blocks of ranges a ... b, and the range (from a) of each."""
    blocks = np.arange(first[a], first[b])
    base = np.repeat(np.arange(b - a), np.diff(first[a : b + 1]))
    own = chunk[first[a] : first[b]]
    kinds = np.unique(own)
    if len(kinds) == 1:
        return [(int(kinds[0]), blocks, base)]
    return [(int(i), blocks[own == i], base[own == i]) for i in kinds]
