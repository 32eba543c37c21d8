"""What the block solver knows before any number: nodes, clusters of points, fronts, and where each row block stands in them.

An object point that no observation joins to another point is eliminated first (an *inner* point). All other unknowns are nodes of the
reduced system: cameras, images, points joined to points, stations, of any width. Inner points that see nearly the same nodes form a
*cluster*, whose part of the reduced system is one dense matrix. Nested dissection of the nodes gives the *fronts* of a multifrontal
factorisation (Duff & Reid 1983); a cluster belongs to the front where its first node is eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

from baarda.adjustment.cluster_loops import RowNodes
from baarda.adjustment.clusters import clusters_of, starts_in_clusters
from baarda.adjustment.dissection import dissect
from baarda.adjustment.linear_system import Chunk, Linearization

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Small = NDArray[np.int32]
Bools = NDArray[np.bool_]

RUN = 8192  # row blocks of one task


@dataclass(frozen=True)
class Front:
    """A dense part of the factor.

    Attributes
    ----------
    begin, pivots : int
        First eliminated column and their number, in the order of elimination.
    columns : (n,) int array
        All columns in the order of elimination: pivots, then the boundary.
    parent : int
        The front that takes the boundary, -1 = none.
    into_parent : (n - pivots,) int array
        Where the boundary stands in the parent.
    children : tuple of int
    clusters : int array
        Its clusters.
    """

    begin: int
    pivots: int
    columns: Ints
    parent: int
    into_parent: Ints
    children: tuple[int, ...]
    clusters: Ints


class Run(NamedTuple):
    """Neighbouring clusters of a front (-1 = none), and the span of their row blocks in each chunk, (chunks, 2)."""

    front: int
    clusters: Ints
    spans: Ints


@dataclass(frozen=True)
class Rest:
    """Row blocks of a chunk without inner point: their rows in the chunk, front, and columns (N, w) in the front, -1 = none."""

    chunk: int
    rows: Ints
    front: Ints
    at: Ints


@dataclass(frozen=True)
class Structure:
    """The pattern of a linear system.

    Attributes
    ----------
    order : (U,) int array
        Unknowns of the reduced system in the order of elimination; -1 = a parameter that is fixed.
    node_first : (nodes + 1,) int array
        Where the columns of each node begin in that order.
    points : (P,) int array
        Inner points in the order of clusters.
    point_columns : (P, 3) int array
        Their unknowns, -1 = fixed.
    first_block : (P + 1,) int array
    block_chunk, block_row : (B,) int32 arrays
        Row blocks sorted by inner point.
    starts : int32 array
        Chunk by chunk for each row block and part where its columns begin in its cluster, -1 = not there.
    point_part : tuple of int
        For each chunk which part is the inner point, -1 = none.
    first_point, first_column : (C + 1,) int arrays
        Points and columns of each cluster.
    cluster_columns : int array
        Of each column of a cluster its place in the order of elimination.
    cluster_rows : int32 array
        Of each column of a cluster its row in the front.
    sparse : (C,) bool array
        Clusters whose points touch few of their columns each.
    fronts : tuple of Front
        Children before parents.
    rest : tuple of Rest
    border : int
        Columns of the last front if that is not eliminated but left for a larger network, else 0.
    """

    order: Ints
    node_first: Ints
    points: Ints
    point_columns: Ints
    first_block: Ints
    block_chunk: Small
    block_row: Small
    starts: Small
    point_part: tuple[int, ...]
    first_point: Ints
    first_column: Ints
    cluster_columns: Ints
    cluster_rows: Small
    sparse: Bools
    fronts: tuple[Front, ...]
    rest: tuple[Rest, ...]
    border: int = 0

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """Neighbouring clusters of each front, some thousand row blocks each; clusters without a node belong to the front -1."""
        ends = self.first_block[self.first_point]
        out = []
        for f, clusters in [*((f, front.clusters) for f, front in enumerate(self.fronts)), (-1, self.orphans)]:
            if not len(clusters):
                continue
            share = np.cumsum(np.diff(ends)[clusters]) // RUN
            cuts = np.flatnonzero((np.diff(clusters) != 1) | (np.diff(share) != 0)) + 1
            for some in np.split(clusters, cuts):
                span = slice(ends[some[0]], ends[some[-1] + 1])
                out.append(Run(f, some, self._spans(self.block_chunk[span], self.block_row[span])))
        return tuple(out)

    @cached_property
    def runs_of_fronts(self) -> list[list[Run]]:
        """The runs of each front, and last those of the clusters without a node."""
        out: list[list[Run]] = [[] for _ in range(len(self.fronts) + 1)]
        for run in self.runs:
            out[run.front].append(run)
        return out

    def _spans(self, chunk: Small, row: Small) -> Ints:
        """Return the first and the last row block, that one not included, of each chunk."""
        out = np.zeros((len(self.point_part), 2), dtype=np.intp)
        for k in range(len(out)):
            rows = row if len(out) == 1 else row[chunk == k]
            if len(rows):
                out[k] = rows.min(), rows.max() + 1
        return out

    @property
    def orphans(self) -> Ints:
        """The clusters that touch no node."""
        return np.flatnonzero(np.diff(self.first_column) == 0)

    @property
    def most_rows(self) -> int:
        """An upper bound of the row blocks of one point."""
        return int(np.diff(self.first_block).max(initial=0))


def analyse(lin: Linearization, rank: Ints, coordinates: Floats, border: Ints | None = None) -> Structure:
    """Analyse the pattern of a linear system.

    Parameters
    ----------
    lin : Linearization
        Its chunks and nodes count, not its values.
    rank : (points,) int array
        Points of neighbouring rank should be seen by the same images.
    coordinates : (points, 3) array
        Approximate, by which images are placed for the dissection.
    border : int array, optional
        Unknowns that other parts of a larger network share: their nodes are not eliminated.

    Returns
    -------
    Structure
    """
    inner = inner_points(lin)
    nodes = _Nodes.of(lin, inner)
    points = np.flatnonzero(inner)
    points = points[np.argsort(rank[points], kind="stable")]
    place = np.full(len(inner), -1, dtype=np.int32)
    place[points] = np.arange(len(points))

    part = tuple(_point_part(c, inner) for c in lin.chunks)
    owner = [
        place[c.parts[j].nodes] if j >= 0 else np.full(len(c.first), -1, dtype=np.int32) for j, c in zip(part, lin.chunks, strict=True)
    ]
    blocks = nodes.of_blocks(lin.chunks, *_blocks_by_point(owner, len(points)))
    first_point, member, ends, sparse = clusters_of(blocks, nodes.width)
    cluster = np.repeat(np.arange(len(sparse)), np.diff(ends))
    rest = [(i, np.flatnonzero(o < 0)) for i, o in enumerate(owner) if (o < 0).any()]
    alone = [m for i, rows in rest for m in _distinct(blocks.of_chunk(i)[rows])]  # nodes of blocks without an inner point
    clique = np.concatenate([cluster, np.repeat(len(sparse) + np.arange(len(alone)), [len(m) for m in alone]).astype(np.intp)])
    joined = _joined([member, *alone])  # all nodes that something joins, and what joins them
    kept = nodes.holding(border)
    centres = _centres(coordinates[points], first_point)
    parts = _dissected(_graph(clique, joined, nodes.count), nodes.places(member, cluster, centres), kept)

    elimination = np.concatenate([np.zeros(0, dtype=np.intp), *parts])
    position = np.empty(nodes.count, dtype=np.intp)
    position[elimination] = np.arange(nodes.count)
    front_of = np.empty(nodes.count, dtype=np.intp)
    front_of[elimination] = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    begin = np.empty(nodes.count, dtype=np.intp)
    begin[elimination] = np.cumsum(nodes.width[elimination]) - nodes.width[elimination]

    member = member[np.argsort(cluster * nodes.count + position[member])]
    home = np.full(len(sparse), -1)
    home[cluster[::-1]] = front_of[member[::-1]]  # of the node that is eliminated first
    width = nodes.width[member]
    column = np.concatenate([[0], np.cumsum(width)])  # first column of each member, over all clusters
    front_nodes = _nodes_of_fronts(parts, clique, joined, position)
    fronts = _fronts(parts, front_nodes, home, nodes, begin, front_of)
    if kept.any():
        fronts = (*fronts[:-1], replace(fronts[-1], pivots=0))
    rows_in = _RowsInFronts(front_nodes, nodes)
    in_cluster = column[:-1] - column[ends[cluster]]
    return Structure(
        order=nodes.unknowns[_ranges(nodes.offset[elimination], nodes.width[elimination])],
        node_first=np.concatenate([[0], np.cumsum(nodes.width[elimination])]).astype(np.intp),
        points=points,
        point_columns=lin.unknowns["point"].columns.reshape(-1, 3)[points],
        first_block=blocks.first,
        block_chunk=blocks.chunk,
        block_row=blocks.row,
        starts=starts_in_clusters(blocks, first_point, member, ends, in_cluster, nodes.width, lin.workers),
        point_part=part,
        first_point=first_point,
        first_column=column[ends].astype(np.intp),
        cluster_columns=_ranges(begin[member], width),
        cluster_rows=_ranges(rows_in(home[cluster], member), width).astype(np.int32),
        sparse=sparse,
        fronts=fronts,
        rest=tuple(_rest(i, rows, blocks.of_chunk(i)[rows], lin.chunks[i], position, front_of, rows_in) for i, rows in rest),
        border=int(nodes.width[kept].sum()),
    )


def _dissected(graph: Any, places: Floats | None, kept: Bools) -> list[Ints]:
    """Dissect the nodes but those to keep, which come last."""
    if not kept.any():
        return dissect(graph, places)
    free = np.flatnonzero(~kept)
    parts = dissect(graph[free][:, free], None if places is None else places[free]) if len(free) else []
    return [*(free[p] for p in parts), np.flatnonzero(kept)]


def inner_points(lin: Linearization) -> Bools:
    """Return which points can be eliminated one by one: observed with three columns, and joined to no other point."""
    columns = lin.unknowns["point"].columns.reshape(-1, 3)
    seen, joined = np.zeros(len(columns), dtype=bool), np.zeros(len(columns), dtype=bool)
    for c in lin.chunks:
        ends = [p for p in c.parts if p.kind == "point"]
        for p in ends:
            (joined if len(ends) > 1 or len(p.positions) < 3 else seen)[p.nodes] = True
    return np.asarray(seen & ~joined & (columns >= 0).any(axis=1))


@dataclass(frozen=True)
class _Nodes:
    """The nodes of the reduced system: their number by kind (-1 = none), widths, and unknowns one after the other."""

    number: dict[str, Ints]
    width: Ints
    offset: Ints
    unknowns: Ints

    @staticmethod
    def of(lin: Linearization, inner: Bools) -> _Nodes:
        number: dict[str, Ints] = {}
        widths, columns, count = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)], 0
        kept = lin.unknowns.kept
        for group in lin.unknowns.groups:
            sizes = np.diff(group.offsets)
            free = np.add.reduceat(np.append(group.columns >= 0, False), group.offsets[:-1]) if len(sizes) else np.zeros(0)
            wanted = (free > 0) & (sizes > 0)
            if group.kind == "point":
                wanted &= ~inner
            number[group.kind] = np.where(wanted, count + np.cumsum(wanted) - 1, -1)
            some = np.flatnonzero(wanted)
            count += len(some)
            width = np.array([len(kept[group.kind, n]) for n in sizes[some].tolist()], dtype=np.intp)
            own = np.empty(width.sum(), dtype=np.intp)
            for n in np.unique(sizes[some]).tolist():
                nodes, at = np.flatnonzero(sizes[some] == n), kept[group.kind, n]
                begin = (np.cumsum(width) - width)[nodes]
                own[begin[:, None] + np.arange(len(at))] = group.columns[group.offsets[some[nodes]][:, None] + at]
            widths.append(width)
            columns.append(own)
        width = np.concatenate(widths)
        return _Nodes(number, width, np.concatenate([[0], np.cumsum(width)]).astype(np.intp), np.concatenate(columns))

    @property
    def count(self) -> int:
        return len(self.width)

    def holding(self, columns: Ints | None) -> Bools:
        """Return which nodes hold any of some unknowns."""
        at = np.isin(self.unknowns, [] if columns is None else columns)
        out = np.zeros(self.count, dtype=bool)
        out[np.repeat(np.arange(self.count), self.width)[at]] = True
        return out

    def of_blocks(self, chunks: tuple[Chunk, ...], first: Ints, chunk: Small, row: Small) -> RowNodes:
        """Return the node numbers of the row blocks of all chunks, those of inner points sorted."""
        parts = np.array([len(c.parts) for c in chunks], dtype=np.intp)
        place = np.cumsum([0, *(len(c.first) * len(c.parts) for c in chunks)], dtype=np.intp)
        out = RowNodes(first, chunk, row, np.full(place[-1], -1, dtype=np.int32), place, parts)
        for i, c in enumerate(chunks):
            for own, p in zip(out.of_chunk(i).T, c.parts, strict=True):
                if len(p.positions) and (self.number[p.kind] >= 0).any():
                    own[:] = self.number[p.kind][p.nodes]
        return out

    def places(self, member: Ints, cluster: Ints, centres: Floats) -> Floats | None:
        """Return for each node the mean of the centres of its clusters; None where there are none."""
        if not len(centres) or not np.isfinite(centres).all():
            return None
        count = np.bincount(member, minlength=self.count)
        total = np.stack([np.bincount(member, centres[cluster, k], self.count) for k in range(3)], axis=1)
        place = total / np.maximum(count, 1)[:, None]
        place[count == 0] = centres.mean(axis=0)
        return place


def _joined(arrays: list[Ints]) -> Ints:
    return np.concatenate([np.zeros(0, dtype=np.intp), *arrays])


def _ranges(starts: Ints, lengths: Ints) -> Ints:
    """Return starts[0], starts[0] + 1, ... of all ranges one after the other."""
    ends = np.cumsum(lengths)
    total = int(ends[-1]) if len(ends) else 0
    return np.asarray(np.arange(total) + np.repeat(starts - (ends - lengths), lengths))


def _point_part(c: Chunk, inner: Bools) -> int:
    """Return which part of a chunk holds inner points, -1 = none."""
    ends = [j for j, p in enumerate(c.parts) if p.kind == "point"]
    return ends[0] if len(ends) == 1 and inner[c.parts[ends[0]].nodes].any() else -1


def _blocks_by_point(owner: list[Small], points: int) -> tuple[Ints, Small, Small]:
    """Sort the row blocks by their inner point: first block of each point, chunk and row of each block."""
    blocks = [np.flatnonzero(o >= 0).astype(np.int32) for o in owner]
    owners = np.concatenate([o[b] for o, b in zip(owner, blocks, strict=True)])
    chunk = np.repeat(np.arange(len(blocks), dtype=np.int32), [len(b) for b in blocks])
    row = np.concatenate(blocks)
    if np.any(np.diff(owners) < 0):
        order = np.argsort(owners, kind="stable")
        owners, chunk, row = owners[order], chunk[order], row[order]
    return np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=points))]).astype(np.intp), chunk, row


def _distinct(sets: Small) -> list[Ints]:
    """Return the different sets of nodes in the rows of an array; -1 = none."""
    rows = np.unique(np.sort(sets, axis=1), axis=0)
    return [np.unique(m[m >= 0]) for m in rows if (m >= 0).any()]


def _centres(coordinates: Floats, first_point: Ints) -> Floats:
    """Return the mean of the points of each cluster."""
    if len(first_point) < 2:
        return np.zeros((0, 3))
    return np.asarray(np.add.reduceat(coordinates, first_point[:-1], axis=0) / np.diff(first_point)[:, None])


def _graph(clique: Ints, node: Ints, count: int) -> Any:
    """Return the graph whose edges join all nodes of each clique."""
    shape = (int(clique.max(initial=-1)) + 1, count)
    incidence = coo_array((np.ones(len(node), dtype=np.int32), (clique, node)), shape=shape).tocsr()
    return (incidence.T @ incidence).tocsr()


def _nodes_of_fronts(parts: list[Ints], clique: Ints, node: Ints, position: Ints) -> list[Ints]:
    """Return the nodes of each front in the order of elimination: those eliminated in it, then its boundary.

    A clique belongs to the front where its first node is eliminated, and so does the boundary of a front.
    """
    count = len(position)
    first = np.full(int(clique.max(initial=-1)) + 1, count)
    np.minimum.at(first, clique, position[node])
    front = np.repeat(np.arange(len(parts)), [len(p) for p in parts])  # of each position
    of_cliques = np.unique(front[first[clique]] * count + position[node])
    ends = np.searchsorted(of_cliques, np.arange(len(parts) + 1) * count)
    order = np.concatenate([np.zeros(0, dtype=np.intp), *parts])
    found: list[list[Ints]] = [[of_cliques[a:b] - f * count] for f, (a, b) in enumerate(pairwise(ends))]
    out, begin = [], 0
    for f, own in enumerate(parts):
        at = np.unique(np.concatenate([np.arange(begin, begin + len(own)), *found[f]]))
        begin += len(own)
        boundary = at[len(own) :]
        if len(boundary):
            found[front[boundary[0]]].append(boundary)
        out.append(order[at])
    return out


class _RowsInFronts:
    """Where the columns of a node begin in a front."""

    def __init__(self, front_nodes: list[Ints], nodes: _Nodes) -> None:
        self.count = nodes.count
        width = [nodes.width[n] for n in front_nodes]
        keys = _joined([f * self.count + n for f, n in enumerate(front_nodes)])
        begin = _joined([np.cumsum(w) - w for w in width])
        order = np.argsort(keys)
        self.keys, self.begin = keys[order], begin[order]

    def __call__(self, front: Any, nodes: Ints) -> Ints:
        return np.asarray(self.begin[np.searchsorted(self.keys, front * self.count + nodes)]) if len(nodes) else nodes


def _fronts(parts: list[Ints], front_nodes: list[Ints], home: Ints, nodes: _Nodes, begin: Ints, front_of: Ints) -> tuple[Front, ...]:
    rows_in = _RowsInFronts(front_nodes, nodes)
    order = np.argsort(home, kind="stable")
    first = np.searchsorted(home[order], np.arange(len(parts) + 1))
    boundary = [n[len(p) :] for n, p in zip(front_nodes, parts, strict=True)]
    parent = [int(front_of[b[0]]) if len(b) else -1 for b in boundary]
    children: list[list[int]] = [[] for _ in parts]
    for f, q in enumerate(parent):
        if q >= 0:
            children[q].append(f)
    out = []
    for f, own in enumerate(parts):
        width = nodes.width[boundary[f]]
        out.append(
            Front(
                begin=int(begin[own[0]]),
                pivots=int(nodes.width[own].sum()),
                columns=_ranges(begin[front_nodes[f]], nodes.width[front_nodes[f]]),
                parent=parent[f],
                into_parent=_ranges(rows_in(parent[f], boundary[f]), width) if parent[f] >= 0 else np.zeros(0, dtype=np.intp),
                children=tuple(children[f]),
                clusters=order[first[f] : first[f + 1]],
            )
        )
    return tuple(out)


def _rest(i: int, rows: Ints, sets: Small, c: Chunk, position: Ints, front_of: Ints, rows_in: _RowsInFronts) -> Rest:
    late = np.append(position, len(position))[sets]
    earliest = np.argmin(late, axis=1)
    first = sets[np.arange(len(sets)), earliest]
    front = np.append(front_of, -1)[first]
    at = []
    for j, p in enumerate(c.parts):
        width = len(p.positions)
        columns = np.full((len(rows), width), -1)
        there = np.flatnonzero(sets[:, j] >= 0)
        columns[there] = rows_in(front[there], sets[there, j])[:, None] + np.arange(width)
        at.append(columns)
    return Rest(i, rows, front, np.concatenate(at, axis=1))
