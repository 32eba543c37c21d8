"""The selected inverse (Takahashi, Fagan & Chin 1973): from the factor of the fronts, root first, every block of the inverse whose nodes
share a point, and with it the cofactors of the points and the diagonal blocks of A N^-1 A'.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import lapack
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.row_blocks import scaled_rows, with_partials
from baarda.adjustment.structure import Front, Structure
from baarda.adjustment.workers import run_tree

if TYPE_CHECKING:
    from baarda.adjustment.block import BlockSolver

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def selected_inverse(solver: BlockSolver) -> tuple[list[Floats], Floats, NodeBlocks]:
    """Return the diagonal blocks of A N^-1 A' of each chunk, the (P, 3, 3) cofactors of the inner points, and those of the nodes.

    Parameters
    ----------
    solver : BlockSolver
    """
    structure, lin, blocks = solver.structure, solver.lin, solver.blocks_
    hat = np.zeros(int(blocks.hat[-1]))
    points = np.zeros((len(structure.points), 3, 3))
    own: list[Floats | None] = [None] * len(structure.fronts)
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

    def finish(f: int, z: Floats, p: int) -> None:
        """Use the inverse of a front, its first p columns its own."""
        front = structure.fronts[f]
        for run in structure.runs_of_fronts[f]:
            solver.loops.statistics(run.clusters, z, with_partials(blocks, lin, run.spans), hat, points, solver.size)
        for chunk, rows, at in rest.get(f, ()):
            _rest_hat(lin, solver.inverse, blocks.hat, z, chunk, rows, at, hat)
        own[f] = z[:p, :p].copy()
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
        solver.loops.statistics(run.clusters, np.zeros((0, 0)), with_partials(blocks, lin, run.spans), hat, points, solver.size)
    for f, entries in rest.items():
        if f < 0:
            for chunk, rows, at in entries:
                _rest_hat(lin, solver.inverse, blocks.hat, np.zeros((0, 0)), chunk, rows, at, hat)
    out = []
    for k, c in enumerate(lin.chunks):
        out.append(hat[blocks.hat[k] : blocks.hat[k + 1]].reshape(-1, c.m, c.m))
    return out, points, NodeBlocks(structure, [z for z in own if z is not None], solver.inverse)


def _rest_hat(lin: Linearization, inverse: Floats, begins: Ints, z: Floats, chunk: int, rows: Ints, at: Ints, hat: Floats) -> None:
    """Store the diagonal blocks of rows without inner point."""
    c = lin.chunks[chunk]
    h = scaled_rows(c, rows, inverse)
    padded = np.zeros((len(z) + 1, len(z) + 1))
    padded[:-1, :-1] = z
    m = c.m
    values = h @ padded[at[:, :, None], at[:, None, :]] @ h.transpose(0, 2, 1)
    hat[begins[chunk] + rows[:, None] * (m * m) + np.arange(m * m)] = values.reshape(len(rows), -1)


class NodeBlocks:
    """Blocks of the inverse whose columns are eliminated in one front."""

    def __init__(self, structure: Structure, own: list[Floats], inverse: Floats) -> None:
        self.own, self.fronts, self.inverse = own, structure.fronts, inverse
        self.place = np.full(len(inverse), -1)
        self.place[structure.order] = np.arange(len(structure.order))
        self.place[-1] = -1
        begins = np.array([f.begin for f in structure.fronts], dtype=np.intp)
        self.begins = begins

    def __call__(self, columns: Ints) -> Floats:
        """Return (N, w, w) blocks; zero where a column is -1 or held."""
        at = self.place[columns]
        out = np.zeros((*columns.shape, columns.shape[1]))
        front = np.searchsorted(self.begins, at.max(axis=1), side="right") - 1
        for f in np.unique(front[at.max(axis=1) >= 0]):
            rows = np.flatnonzero((front == f) & (at.max(axis=1) >= 0))
            local = np.where(at[rows] >= 0, at[rows] - self.fronts[f].begin, 0)
            weight = np.where(at[rows] >= 0, self.inverse[columns[rows]], 0.0)
            out[rows] = self.own[f][local[:, :, None], local[:, None, :]] * weight[:, :, None] * weight[:, None, :]
        return out


def _children_backwards(fronts: tuple[Front, ...]) -> list[list[int]]:
    return [[len(fronts) - 1 - c for c in f.children] for f in reversed(fronts)]
