"""Clusters of object points: neighbours that see nearly the same nodes, whose part of the reduced system is one dense matrix."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.cluster_loops import RowNodes, cluster_loops
from baarda.adjustment.point_order import BASE
from baarda.adjustment.workers import for_each

Ints = NDArray[np.intp]
Small = NDArray[np.int32]
Bools = NDArray[np.bool_]

MOST = 1024  # points of the largest cluster
LARGEST = 700_000  # points times columns of the largest cluster
OVERHEAD = 12  # what a cluster costs whatever its points are, in points
SHARE = 256  # groups of points, or clusters, that are looked at together
SPARSE = 3.5  # clusters wider than this multiple of what a point of theirs touches are treated point by point


def clusters_of(blocks: RowNodes, width: Ints) -> tuple[Ints, Ints, Ints, Bools]:
    """Gather neighbouring points that see nearly the same nodes.

    Parameters
    ----------
    blocks : RowNodes
    width : int array
        Of each node.

    Returns
    -------
    (C + 1,) int array
        First point of each cluster.
    int array
        The nodes of all clusters, cluster by cluster, sorted.
    (C + 1,) int array
        Where those of each cluster begin.
    (C,) bool array
        Whether its points touch few of its columns each.
    """
    count = len(blocks.first) - 1
    cuts = np.append(np.arange(0, count, BASE), count) if count else np.zeros(1, dtype=np.intp)
    loops = cluster_loops(len(blocks.row))
    gather = _gather_twin if loops is None else loops.gather
    first, members, ends, sparse = gather(cuts, blocks, width, MOST, LARGEST, OVERHEAD, SPARSE)
    return cuts[first], members, ends, sparse


def starts_in_clusters(
    blocks: RowNodes, first_point: Ints, members: Ints, ends: Ints, begin: Ints, width: Ints, workers: int | None
) -> Small:
    """Return for the nodes of all row blocks where their columns begin in the cluster of the block, -1 = not there.

    Parameters
    ----------
    blocks : RowNodes
    first_point : (C + 1,) int array
    members, begin : int arrays
        The nodes of all clusters, cluster by cluster, and where their columns begin.
    ends : (C + 1,) int array
        Where the members of each cluster begin.
    width : int array
        Of each node.
    workers : int or None
        Number of threads.
    """
    out = np.full(len(blocks.nodes), -1, dtype=np.int32)
    loops = cluster_loops(len(blocks.row))
    count = len(first_point) - 1
    clusters = [np.arange(a, min(a + SHARE, count)) for a in range(0, count, SHARE)]
    store = partial(
        _starts_twin if loops is None else loops.starts,
        first_point=first_point, b=blocks, members=members, ends=ends, begin=begin, width=width, out=out,
    )  # fmt: skip
    for_each(clusters, store, workers)
    return out


# ---- the loops in NumPy ----
def _gather_twin(
    cuts: Ints, b: RowNodes, width: Ints, most: int, largest: int, overhead: int, sparse_from: float
) -> tuple[Ints, Ints, Ints, Bools]:  # fmt: skip
    seen_by: list[frozenset[int]] = []
    for k in range(0, len(cuts) - 1, SHARE):
        some = cuts[k : k + SHARE + 1]
        mark = np.zeros((len(some) - 1, len(width)), dtype=bool)
        for i, rows, base in _by_chunk(b, b.first[some]):
            for number in b.of_chunk(i)[rows].T:
                mark[base[number >= 0], number[number >= 0]] = True
        base, number = np.nonzero(mark)
        ends, numbers = np.searchsorted(base, np.arange(len(some))).tolist(), number.tolist()
        seen_by += [frozenset(numbers[i:j]) for i, j in pairwise(ends)]
    effort = np.concatenate([[0.0], np.cumsum(_touched(b, cuts[:-1], width).astype(float) ** 2)])
    width_of, ends = width.tolist(), cuts.tolist()
    widths = [sum([width_of[i] for i in s]) for s in seen_by]
    begin, members, sparse = [0], [np.zeros(0, dtype=np.intp)], []
    k = 0
    while k < len(seen_by):
        union, size, end = seen_by[k], widths[k], k + 1
        while end < len(seen_by) and ends[end + 1] - ends[k] <= most:
            joined = size + sum([width_of[i] for i in seen_by[end] - union])
            points, added = ends[end] - ends[k], ends[end + 1] - ends[end]
            apart = size**2 * (points + overhead) + widths[end] ** 2 * (added + overhead)
            if joined**2 * (points + added + overhead) > apart or joined * (points + added) > largest:
                break
            union, size, end = union | seen_by[end], joined, end + 1
        members.append(np.array(sorted(union), dtype=np.intp))
        begin.append(end)
        sparse.append(size > sparse_from * float(np.sqrt((effort[end] - effort[k]) / (end - k))))
        k = end
    lengths = [len(m) for m in members]
    return np.array(begin, dtype=np.intp), np.concatenate(members), np.cumsum(lengths).astype(np.intp), np.array(sparse, dtype=bool)


def _touched(b: RowNodes, points: Ints, width: Ints) -> Ints:
    """Return an upper bound of the columns that some points touch: shared nodes count with every block."""
    padded = np.append(width, 0)
    first, count = b.first[points], b.first[points + 1] - b.first[points]
    blocks = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
    columns = np.zeros(len(blocks), dtype=np.intp)
    for i in range(len(b.parts)):
        at = np.flatnonzero(b.chunk[blocks] == i)
        columns[at] = padded[b.of_chunk(i)[b.row[blocks[at]]]].sum(axis=1)
    total = np.concatenate([[0], np.cumsum(columns)])
    ends = np.cumsum(count)
    return np.asarray(total[ends] - total[ends - count])


def _starts_twin(clusters: Ints, first_point: Ints, b: RowNodes, members: Ints, ends: Ints, begin: Ints, width: Ints, out: Small) -> None:
    table = np.full((len(clusters), len(width) + 1), -1, dtype=np.int32)
    some = slice(ends[clusters[0]], ends[clusters[-1] + 1])
    cluster = np.repeat(np.arange(len(clusters)), np.diff(ends[clusters[0] : clusters[-1] + 2]))
    table[cluster, members[some]] = begin[some]
    for i, rows, base in _by_chunk(b, b.first[first_point[clusters[0] : clusters[-1] + 2]]):
        own = out[b.place[i] : b.place[i + 1]].reshape(-1, b.parts[i])
        own[rows] = table[base[:, None], b.of_chunk(i)[rows]]


def _by_chunk(b: RowNodes, ends: Ints) -> list[tuple[int, Small, Ints]]:
    """Return for each chunk its rows in ranges of row blocks that follow each other, and the range of each."""
    base = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
    chunk, row = b.chunk[ends[0] : ends[-1]], b.row[ends[0] : ends[-1]]
    kinds = np.unique(chunk)
    if len(kinds) == 1:
        return [(int(kinds[0]), row, base)]
    return [(int(i), row[chunk == i], base[chunk == i]) for i in kinds]
