"""The loops over row blocks that find clusters of points: compiled for large blocks, see `baarda.adjustment.clusters` for their twins."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from baarda.compiling import compile_loops

Ints = NDArray[np.intp]
Small = NDArray[np.int32]
Bools = NDArray[np.bool_]

COMPILE_FROM = 60_000  # row blocks from which the loops are compiled


class RowNodes(NamedTuple):
    """Which nodes the row blocks of the inner points touch.

    Attributes
    ----------
    first : (P + 1,) int array
        First row block of each point.
    chunk, row : (B,) int32 arrays
        Of each row block.
    nodes : int32 array
        Chunk by chunk for each row of a chunk and part its node, -1 = none.
    place : (chunks + 1,) int array
        Where each chunk begins in `nodes`.
    parts : (chunks,) int array
    """

    first: Ints
    chunk: Small
    row: Small
    nodes: Small
    place: Ints
    parts: Ints

    def of_chunk(self, i: int) -> Small:
        """Return the (N, parts) nodes of the row blocks of a chunk."""
        return self.nodes[self.place[i] : self.place[i + 1]].reshape(-1, self.parts[i])


def _gather(
    cuts: Ints, b: Any, width: Ints, most: int, largest: int, overhead: int, sparse_from: float
) -> tuple[Ints, Ints, Ints, Bools]:  # fmt: skip
    """Join neighbouring groups of points, from cuts[k] to cuts[k + 1], to clusters.

    Returns the first group of each cluster, its nodes, where these begin, and whether its points touch few of its columns each.
    """
    first, chunk, row, nodes, place, parts = b.first, b.chunk, b.row, b.nodes, b.place, b.parts
    groups = len(cuts) - 1
    mark = np.full(len(width), -1, np.int64)
    own, ends = np.empty(64 * max(groups, 1), np.int32), np.zeros(groups + 1, np.int64)  # nodes of the groups
    widths, effort = np.zeros(groups, np.int64), np.zeros(groups)
    n = 0
    for k in range(groups):
        for i in range(first[cuts[k]], first[cuts[k + 1]]):
            at = place[chunk[i]] + row[i] * parts[chunk[i]]
            for j in range(parts[chunk[i]]):
                node = nodes[at + j]
                if node < 0:
                    continue
                if i < first[cuts[k] + 1]:
                    effort[k] += width[node]
                if mark[node] != k:
                    mark[node] = k
                    widths[k] += width[node]
                    if n == len(own):
                        longer = np.empty(2 * n, np.int32)
                        longer[:n] = own
                        own = longer
                    own[n] = node
                    n += 1
        ends[k + 1] = n
    mark[:] = -1
    begin, members, member_ends = np.zeros(groups + 1, np.int64), np.empty(n, np.int64), np.zeros(groups + 1, np.int64)
    sparse = np.zeros(groups, np.bool_)
    k = count = total = 0
    while k < groups:
        size, squares, end = 0, 0.0, k
        while end < groups:
            more = 0
            for i in range(ends[end], ends[end + 1]):
                if mark[own[i]] != count:
                    more += width[own[i]]
            points, added = cuts[end] - cuts[k], cuts[end + 1] - cuts[end]
            if end > k:
                apart = size**2 * (points + overhead) + widths[end] ** 2 * (added + overhead)
                joined = size + more
                if points + added > most or joined**2 * (points + added + overhead) > apart or joined * (points + added) > largest:
                    break
            for i in range(ends[end], ends[end + 1]):
                if mark[own[i]] != count:
                    mark[own[i]] = count
                    members[total] = own[i]
                    total += 1
            size += more
            squares += effort[end] ** 2
            end += 1
        members[member_ends[count] : total] = np.sort(members[member_ends[count] : total])
        sparse[count] = size > sparse_from * np.sqrt(squares / (end - k))
        count += 1
        begin[count], member_ends[count] = end, total
        k = end
    return begin[: count + 1], members[:total], member_ends[: count + 1], sparse[:count]


def _starts(clusters: Ints, first_point: Ints, b: Any, members: Ints, ends: Ints, begin: Ints, width: Ints, out: Small) -> None:
    """Store for the row blocks of clusters where the columns of each part begin in the cluster, -1 = not there.

    `begin` is that of each member, which are those of cluster c from ends[c] on.
    """
    first, chunk, row, nodes, place, parts = b.first, b.chunk, b.row, b.nodes, b.place, b.parts
    table = np.full(len(width), -1, np.int32)
    for c in clusters:
        for m in range(ends[c], ends[c + 1]):
            table[members[m]] = begin[m]
        for i in range(first[first_point[c]], first[first_point[c + 1]]):
            at = place[chunk[i]] + row[i] * parts[chunk[i]]
            for j in range(parts[chunk[i]]):
                if nodes[at + j] >= 0:
                    out[at + j] = table[nodes[at + j]]


class ClusterLoops(NamedTuple):
    """The compiled loops."""

    gather: Callable[..., tuple[Ints, Ints, Ints, Bools]]
    starts: Callable[..., None]


@cache
def compiled() -> ClusterLoops | None:
    """Return the compiled loops, None without numba."""
    loops = compile_loops((_gather, _starts))
    return None if loops is None else ClusterLoops(*loops)


def cluster_loops(blocks: int) -> ClusterLoops | None:
    """Return the compiled loops for many row blocks; None for few, so that nothing waits for the compiler, or without numba."""
    return compiled() if blocks >= COMPILE_FROM else None
