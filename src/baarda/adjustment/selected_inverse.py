"""The selected inverse (Takahashi, Fagan & Chin 1973): from the factor of the fronts, root first, every block of the inverse whose nodes
share a point, and with it the cofactors of the points and the diagonal blocks of A N^-1 A'.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import lapack
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.row_blocks import hats_of, put_hat, scaled_rows, with_partials
from baarda.adjustment.structure import Front, Run, Structure
from baarda.adjustment.workers import run_tree
from baarda.errors import UsageError

if TYPE_CHECKING:
    from baarda.adjustment.block import BlockSolver

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


class Statistics(NamedTuple):
    """What the selected inverse gives.

    Attributes
    ----------
    hats : list of (N, m, m) or (N, m) arrays, or None
        The diagonal blocks of A N^-1 A' of each chunk, or their diagonals; None where they were handed over.
    whole : bool
        Whether all of them are blocks.
    points : (points, 3, 3) array
        Cofactors of all points; zero where a coordinate is fixed or held.
    nodes : NodeBlocks
    """

    hats: list[Floats] | None
    whole: bool
    points: Floats
    nodes: NodeBlocks


def selected_inverse(solver: BlockSolver, whole: bool) -> Statistics:
    """Compute the statistics of a solver.

    Parameters
    ----------
    solver : BlockSolver
    whole : bool
        Store all of the diagonal blocks of A N^-1 A'; else only their diagonals for chunks of uncorrelated rows.
    """
    structure, lin = solver.structure, solver.lin
    places, size = hats_of(lin, whole)
    hat, blocks = np.zeros(size), solver.blocks_._replace(hat=places)
    nodes = NodeBlocks(structure, solver.inverse)
    columns = lin.unknowns["point"].columns.reshape(-1, 3)
    points = np.zeros((len(columns), 3, 3))
    inverses: dict[int, Floats] = {}
    left, lock = [len(f.children) for f in structure.fronts], threading.Lock()
    rest: dict[int, list[tuple[int, Ints, Ints]]] = {}
    for entry in structure.rest:
        for f in np.unique(entry.front):
            rest.setdefault(int(f), []).append((entry.chunk, entry.rows[entry.front == f], entry.at[entry.front == f]))

    def invert(f: int) -> None:
        front, panel = structure.fronts[f], solver.panels[f]
        n, p = len(front.columns), front.pivots
        if not p and solver.border_inverse is not None:
            finish(f, solver.border_inverse, n)
            return
        z = np.empty((n, n))
        corner = panel[:p].copy()
        if p < n:
            outer = z[p:, p:]
            solver.loops.gather(inverses[front.parent], front.into_parent, outer)
            g = panel[p:].copy()
            lapack.solve_right(corner, g)
            lapack.multiply(outer, g, z[p:, :p], -1.0)
            z[:p, p:] = z[p:, :p].T
        lapack.invert_from_cholesky(corner)
        z[:p, :p] = np.tril(corner) + np.tril(corner, -1).T
        if p < n:
            lapack.multiply_transposed(g, z[p:, :p], z[:p, :p], -1.0, 1.0)
            z[:p, :p] = 0.5 * (z[:p, :p] + z[:p, :p].T)
        finish(f, z, p)

    def use(run: Run, z: Floats) -> None:
        arrays = with_partials(blocks, lin, run.spans)
        solver.loops.statistics(run.clusters, z, arrays, hat, points, structure.points, solver.size)

    def finish(f: int, z: Floats, p: int) -> None:
        """Use the inverse of a front, its first p columns its own."""
        front = structure.fronts[f]
        for run in structure.runs_of_fronts[f]:
            use(run, z)
        for chunk, rows, at in rest.get(f, ()):
            _rest_hat(lin, solver.inverse, places, z, chunk, rows, at, hat)
        nodes.keep(f, z, p)
        if front.children:
            inverses[f] = z
        if front.parent >= 0:
            with lock:
                left[front.parent] -= 1
                if left[front.parent] == 0:
                    del inverses[front.parent]

    fronts = structure.fronts
    before = [int(f.parent >= 0) for f in reversed(fronts)]  # from the root to the leaves
    run_tree(before, _children_backwards(fronts), lambda i: invert(len(fronts) - 1 - i), lin.workers)
    for run in structure.runs_of_fronts[-1]:
        use(run, np.zeros((0, 0)))
    for f, entries in rest.items():
        if f < 0:
            for chunk, rows, at in entries:
                _rest_hat(lin, solver.inverse, places, np.zeros((0, 0)), chunk, rows, at, hat)
    hats = []
    for (begin, each), c in zip(places, lin.chunks, strict=True):
        shape = (-1, c.m, c.m) if whole or not c.plain else (-1, c.m)
        hats.append(hat[begin : begin + each * len(c.first)].reshape(shape))
    others = np.ones(len(points), dtype=bool)
    others[structure.points] = False
    points[others] = nodes(columns[others])
    points.flags.writeable = False
    return Statistics(hats, whole, points, nodes)


def _rest_hat(lin: Linearization, inverse: Floats, places: Ints, z: Floats, chunk: int, rows: Ints, at: Ints, hat: Floats) -> None:
    """Store the diagonal blocks of rows without inner point."""
    c = lin.chunks[chunk]
    h = scaled_rows(c, rows, inverse)
    padded = np.zeros((len(z) + 1, len(z) + 1))
    padded[:-1, :-1] = z
    values = h @ padded[at[:, :, None], at[:, None, :]] @ h.transpose(0, 2, 1)
    put_hat(hat, places[chunk], rows, values)


class NodeBlocks:
    """Blocks of the inverse, each of one node of the reduced system."""

    def __init__(self, structure: Structure, inverse: Floats) -> None:
        self.fronts, self.inverse = structure.fronts, inverse
        self.place = np.full(len(inverse), -1, dtype=np.int32)
        self.place[structure.order] = np.arange(len(structure.order))
        self.place[-1] = -1
        self.begins = np.array([f.begin for f in structure.fronts], dtype=np.intp)
        self.first = np.repeat(structure.node_first[:-1], np.diff(structure.node_first))  # of each column that of its node
        self.own: dict[int, Floats] = {}

    def keep(self, f: int, z: Floats, p: int) -> None:
        """Keep what is needed of the inverse of a front, its first p columns its own: of each row the columns of its node."""
        begin = self.fronts[f].begin
        own = self.first[begin : begin + p] - begin
        width = int((np.arange(len(own)) - own).max(initial=-1)) + 1
        columns = np.minimum(own[:, None] + np.arange(width), len(own) - 1)
        self.own[f] = z[np.arange(len(own))[:, None], columns]

    def __call__(self, columns: Ints) -> Floats:
        """Return (N, w, w) blocks; zero where a column is -1 or held."""
        at = self.place[columns]
        last = at.max(axis=1, initial=-1)
        out = np.zeros((*columns.shape, columns.shape[1]))
        front = np.searchsorted(self.begins, last, side="right") - 1
        for f in np.unique(front[last >= 0]):
            rows = np.flatnonzero((front == f) & (last >= 0))
            first, there = self.first[last[rows]][:, None], at[rows] >= 0
            if (self.first[at[rows]] != first)[there].any():
                raise UsageError("a block of the inverse must be that of one node")
            local = np.where(there, at[rows] - first, 0)
            weight = np.where(there, self.inverse[columns[rows]], 0.0)
            line = (first - self.fronts[f].begin)[:, :, None] + local[:, :, None]
            out[rows] = self.own[f][line, local[:, None, :]] * weight[:, :, None] * weight[:, None, :]
        return out


def _children_backwards(fronts: tuple[Front, ...]) -> list[list[int]]:
    return [[len(fronts) - 1 - c for c in f.children] for f in reversed(fronts)]
