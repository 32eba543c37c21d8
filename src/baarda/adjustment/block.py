"""The block solver: object points are eliminated one by one, the rest by a multifrontal Cholesky factorisation.

The same fronts, taken the other way, give the *selected inverse* (Takahashi, Fagan & Chin 1973): every block of the inverse whose nodes
share a point, which is all that the cofactors of points and the redundancy numbers need. No array of the size u x u anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, onenormest

from baarda.adjustment import lapack
from baarda.adjustment.dense import refuse_null_space
from baarda.adjustment.kernels import Kernels, kernels
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.memory import release
from baarda.adjustment.pairs import pairs
from baarda.adjustment.row_blocks import Blocks, blocks_of, scaled_rows, sizes, table_of, with_partials
from baarda.adjustment.selected_inverse import Statistics, selected_inverse
from baarda.adjustment.structure import Front, Run, Structure
from baarda.adjustment.workers import for_each, run_tree
from baarda.errors import Singular, UsageError

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

SEARCHED = 4000  # columns up to which a null space is sought in the whole reduced matrix
SMALLEST_PIVOT = 1e-15  # of a column scaled to length 1: what other unknowns leave of its square


@dataclass(frozen=True)
class BlockSolver:
    """Factored normal equations with eliminated points; see `baarda.adjustment.solver.Solver` for the contract."""

    lin: Linearization
    structure: Structure
    inverse: Floats
    blocks_: Blocks
    loops: Kernels
    triangles: Floats
    panels: tuple[Floats, ...]
    size: Ints
    rhs: Floats | None = None
    border_matrix: Floats | None = None
    border_inverse: Floats | None = None

    @staticmethod
    def of(lin: Linearization, structure: Structure, held: Ints, damping: float = 0.0) -> BlockSolver:
        """Eliminate the points and factor the reduced system; held unknowns stay out.

        Parameters
        ----------
        lin : Linearization
        structure : Structure
            Of this system, from `baarda.adjustment.structure.analyse`.
        held : (k,) int array
            Unknowns that stay where they are.
        damping : float
            Added to the diagonal of the normal matrix whose columns have length 1.

        Raises
        ------
        Singular
            If a point or a combination of unknowns is not determined.
        """
        inverse = np.append(1.0 / lin.scale, 0.0)
        inverse[held] = 0.0
        arrays = blocks_of(lin, structure, inverse, damping)
        loops = kernels(len(structure.block_row))
        size = sizes(structure, arrays)
        triangles = np.zeros((len(structure.points), 3, 3))
        bad = np.zeros(len(structure.points), dtype=bool)
        panels: list[Floats | None] = [None] * len(structure.fronts)
        updates: dict[int, Floats] = {}
        rest = _rest_by_front(lin, structure, inverse)
        diagonal = np.where(inverse[structure.order] > 0.0, damping, 1.0)
        weak: list[tuple[int, Floats, bool]] = []
        y, shares = lin.misclosure, [np.zeros(len(f.columns)) for f in structure.fronts]

        def factor(f: int) -> None:
            front = structure.fronts[f]
            n, p = len(front.columns), front.pivots
            matrix = np.zeros((n, n))
            for run in structure.runs_of_fronts[f]:
                loops.accumulate(run.clusters, matrix, y, shares[f], with_partials(arrays, lin, run.spans), triangles, bad, size)
            for at, jacobian in rest.get(f, ()):
                _add_rows(matrix, at, jacobian)
            for child in front.children:
                loops.extend(matrix, updates.pop(child), structure.fronts[child].into_parent)
            matrix[np.arange(p), np.arange(p)] += diagonal[front.begin : front.begin + p]
            if not p:  # the border of a part of a larger network
                updates[f], panels[f] = matrix, matrix[:, :0]
                return
            before = matrix[:p, :p].copy()
            info = lapack.cholesky(matrix[:p, :p])
            if info or np.diagonal(matrix)[:p].min(initial=1.0) ** 2 < SMALLEST_PIVOT:
                weak.append((f, before, info != 0))
                if info:
                    raise Singular("not positive definite", [])
            if p < n:
                lapack.solve_right_transposed(matrix[:p, :p], matrix[p:, :p])
                update = matrix[p:, p:]
                lapack.subtract_square(matrix[p:, :p], update)
                updates[f] = update.copy()
            panels[f] = np.ascontiguousarray(matrix[:, :p])

        for run in structure.runs_of_fronts[-1]:
            loops.accumulate(
                run.clusters, np.zeros((0, 0)), y, np.zeros(0), with_partials(arrays, lin, run.spans), triangles, bad, size
            )  # fmt: skip
        with suppress(Singular):  # the reason is found below
            run_tree([len(f.children) for f in structure.fronts], [_after(f) for f in structure.fronts], factor, lin.workers)
        if bad.any():
            _refuse_points(lin, structure.point_columns[bad])
        if weak:
            _refuse_nodes(lin, structure, inverse, arrays, loops, size, diagonal, *min(weak, key=lambda w: (not w[2], w[0])))
        border = None
        if structure.border:
            border = updates[len(structure.fronts) - 1]
            border = np.tril(border) + np.tril(border, -1).T
        done = tuple(p for p in panels if p is not None)
        release(lin.count)  # what the fronts took
        rhs = _added(structure, range(len(shares)), shares) if loops.compiled else None
        return BlockSolver(lin, structure, inverse, arrays, loops, triangles, done, size, rhs, border)

    def at(self, lin: Linearization | None) -> BlockSolver:
        """Return this factor for the system at a state nearby, as an approximate one; None only lets the old system go."""
        if lin is None:  # no view of the old values may stay
            arrays = self.blocks_._replace(values=np.zeros(0))
        else:
            arrays = self.blocks_._replace(values=lin.values, table=table_of(lin, self.structure))
        return replace(self, lin=cast(Linearization, lin), blocks_=arrays, rhs=None)

    @property
    def count(self) -> int:
        """The number of columns of the reduced system."""
        return len(self.structure.order)

    # ---- solving ----
    def solve(self, rhs: Floats) -> Floats:
        """Return N^-1 rhs for (u,) or (u, k) right-hand sides; held unknowns stay zero."""
        k = rhs.size // max(len(rhs), 1)
        columns = np.concatenate([rhs.reshape(len(rhs), -1), np.zeros((1, k))]) * self.inverse[:, None]
        own, order = self.structure.point_columns, self.structure.order
        x, reduced = np.zeros_like(columns), columns[order]
        z = self._points(columns[own])
        if z.any():
            x[own] = z * self.inverse[own][:, :, None]
            x[-1] = 0.0
            reduced -= self._scaled_transposed(self.lin.times(x[:-1], {"point"}), self._reduced_kinds)[order]
            x[:] = 0.0
        y = self.solve_reduced(reduced)
        x[order] = y * self.inverse[order][:, None]
        x[-1] = 0.0
        coupled = self._scaled_transposed(self.lin.times(x[:-1], self._reduced_kinds), {"point"})
        x[own] = (z - self._points(coupled[own])) * self.inverse[own][:, :, None]
        return np.asarray(x[:-1].reshape(rhs.shape))

    def least_squares(self, y: Floats) -> tuple[Floats, Floats]:
        """Return x = N^-1 A'y for an (n,) vector in the place of the whitened observations, and A x."""
        if not self.loops.compiled and not self.structure.border:
            x = self.solve(self.lin.transposed(y))
            return x, self.lin.times(x)
        return self._backward(y, self._up(self._down(self._forward(y))))

    def _forward(self, y: Floats) -> Floats:
        """Return the scaled right-hand sides (U, 1) of the reduced system for A'y."""
        s = self.structure
        if not self.loops.compiled:
            scaled = np.append(self.lin.transposed(y), 0.0) * self.inverse
            z = self._points(scaled[s.point_columns][:, :, None])
            x = np.zeros((len(scaled), 1))
            x[s.point_columns] = z * self.inverse[s.point_columns][:, :, None]
            x[-1] = 0.0
            return scaled[s.order, None] - self._scaled_transposed(self.lin.times(x[:-1], {"point"}), self._reduced_kinds)[s.order]

        if self.rhs is not None and y is self.lin.misclosure:
            reduced = self.rhs.copy()
        else:

            def forward(run: Run) -> Floats:
                share = np.zeros(len(s.fronts[run.front].columns))
                self.loops.forward(run.clusters, y, with_partials(self.blocks_, self.lin, run.spans), self.triangles, share)
                return share

            runs = [run for run in s.runs if run.front >= 0]
            reduced = _added(s, [run.front for run in runs], for_each(runs, forward, self.lin.workers))
        for c, e, columns in self._rest:
            own = np.einsum("nmw,nm->nw", scaled_rows(c, e.rows, self.inverse), y[c.rows_of(e.rows)])
            np.add.at(reduced, columns, own)
        return reduced[:-1, None]

    def _backward(self, y: Floats, reduced: Floats) -> tuple[Floats, Floats]:
        """Return x and A x, from A'y and the scaled solution (U, 1) of the reduced system."""
        s = self.structure
        x = np.zeros(len(self.inverse))
        x[s.order] = reduced[:, 0] * self.inverse[s.order]
        x[-1] = 0.0
        if not self.loops.compiled:
            left = self.lin.transposed(y - self.lin.times(x[:-1], self._reduced_kinds), {"point"})
            scaled = (np.append(left, 0.0) * self.inverse)[s.point_columns]
            x[s.point_columns] = self._points(scaled[:, :, None])[:, :, 0] * self.inverse[s.point_columns]
            x[-1] = 0.0
            return x[:-1], self.lin.times(x[:-1])
        solution = np.append(reduced[:, 0], 0.0)
        points, change = np.zeros((len(s.points), 3)), np.zeros(len(y))

        def backward(run: Run) -> None:
            self.loops.backward(run.clusters, solution, y, with_partials(self.blocks_, self.lin, run.spans), self.triangles, points, change)

        for_each(s.runs, backward, self.lin.workers)
        for c, e, columns in self._rest:
            change[c.rows_of(e.rows)] = np.einsum("nmw,nw->nm", scaled_rows(c, e.rows, self.inverse), solution[columns])
        x[s.point_columns] = points
        return x[:-1], change

    @property
    def _rest(self) -> list[tuple[Any, Any, Ints]]:
        """Row blocks without inner point: their chunk, the entry, and their columns in the order of elimination, the last one = fixed."""
        fixed = len(self.structure.order)
        return [
            (self.lin.chunks[e.chunk], e, np.where(e.at >= 0, self._columns_of_fronts[e.front[:, None], e.at], fixed))
            for e in self.structure.rest
        ]

    # ---- a part of a larger network ----
    @cached_property
    def border(self) -> tuple[Ints, Floats]:
        """The unknowns (b,) that are left for the larger network, and the normal equations (b, b) reduced to them."""
        own, used = self._border
        scale = self.inverse[own[used]]
        matrix = np.zeros((0, 0)) if self.border_matrix is None else self.border_matrix[np.ix_(used, used)]
        return own[used], matrix / np.outer(scale, scale)

    @property
    def _border(self) -> tuple[Ints, Ints]:
        """The unknowns of the last front, and which of them are neither fixed nor held."""
        own = self.structure.order[len(self.structure.order) - self.structure.border :]
        return own, np.flatnonzero(self.inverse[own] > 0.0)

    def reduced(self, y: Floats) -> Floats:
        """Return A'y reduced to the border, (b,)."""
        own, used = self._border
        return np.asarray(self._down(self._forward(y))[len(self.structure.order) - len(own) :, 0][used] / self.inverse[own[used]])

    def expanded(self, y: Floats, x: Floats) -> tuple[Floats, Floats]:
        """Return all unknowns and A x, given those (b,) of the border."""
        own, used = self._border
        down = self._down(self._forward(y))
        last = np.zeros(len(own))
        last[used] = x / self.inverse[own[used]]
        down[len(down) - len(own) :, 0] = last
        return self._backward(y, self._up(down))

    def given(self, inverse: Floats) -> BlockSolver:
        """Return this solver with the cofactors (b, b) of its border in the larger network, for statistics."""
        own, used = self._border
        z = np.zeros((len(own), len(own)))
        scale = self.inverse[own[used]]
        z[np.ix_(used, used)] = inverse / np.outer(scale, scale)
        return replace(self, border_inverse=z)

    @cached_property
    def _columns_of_fronts(self) -> Ints:
        """The columns of all fronts, (fronts, widest), in the order of elimination."""
        fronts = self.structure.fronts
        out = np.full((len(fronts), max((len(f.columns) for f in fronts), default=1)), -1)
        for row, front in zip(out, fronts, strict=True):
            row[: len(front.columns)] = front.columns
        return out

    @cached_property
    def _reduced_kinds(self) -> set[str]:
        """The unknown groups of the reduced system."""
        kinds = {g.kind for g in self.lin.unknowns.groups}
        retained = np.isin(self.structure.order, self.lin.unknowns["point"].columns[self.lin.unknowns["point"].columns >= 0]).any()
        return kinds if retained else kinds - {"point"}

    def _scaled_transposed(self, y: Floats, kinds: set[str]) -> Floats:
        return np.append(self.lin.transposed(y, kinds), np.zeros((1, y.shape[1])), axis=0) * self.inverse[:, None]

    def _points(self, rhs: Floats) -> Floats:
        """Return (R'R)^-1 rhs for the (P, 3, k) scaled right-hand sides of the inner points."""
        r, z = self.triangles, rhs.copy()
        for i in range(3):
            for j in range(i):
                z[:, i] -= r[:, j, i, None] * z[:, j]
            z[:, i] /= r[:, i, i, None]
        for i in (2, 1, 0):
            for j in range(i + 1, 3):
                z[:, i] -= r[:, i, j, None] * z[:, j]
            z[:, i] /= r[:, i, i, None]
        return z

    def solve_reduced(self, rhs: Floats, wanted: Ints | None = None) -> Floats:
        """Return S^-1 rhs for (U, k) right-hand sides of the scaled reduced system in the order of elimination.

        With `wanted` only these rows of the result need be right, and rows of zeros are made use of.
        """
        x = np.ascontiguousarray(rhs)
        down = up = None
        if wanted is not None:
            down, up = self._to_the_root(np.flatnonzero(x.any(axis=1))), self._to_the_root(wanted)
        x = self._down(x, down)
        if self.border_inverse is not None:
            last = x[len(x) - len(self.border_inverse) :]
            last[:] = self.border_inverse @ last
        return self._up(x, up)

    def _to_the_root(self, rows: Ints) -> Ints:
        """Return the fronts where some rows are eliminated, and all above them, sorted."""
        fronts = self.structure.fronts
        found = np.zeros(len(fronts), dtype=bool)
        begins = np.array([f.begin for f in fronts], dtype=np.intp)
        found[np.searchsorted(begins, rows, side="right") - 1] = True
        for f, front in enumerate(fronts):  # children come before their parents
            if found[f] and front.parent >= 0:
                found[front.parent] = True
        return np.flatnonzero(found)

    def _down(self, x: Floats, some: Ints | None = None) -> Floats:
        """Eliminate front by front, in place; what is left for a border stands in its rows."""
        for f in range(len(self.panels)) if some is None else some:
            front, panel = self.structure.fronts[f], self.panels[f]
            p = front.pivots
            if p:
                own = x[front.begin : front.begin + p]
                lapack.solve_left(panel[:p], own)
                x[front.columns[p:]] -= panel[p:] @ own
        return x

    def _up(self, x: Floats, some: Ints | None = None) -> Floats:
        """Substitute backwards, in place."""
        for f in reversed(range(len(self.panels)) if some is None else some):
            front, panel = self.structure.fronts[f], self.panels[f]
            p = front.pivots
            if p:
                own = x[front.begin : front.begin + p]
                own -= panel[p:].T @ x[front.columns[p:]]
                lapack.solve_left_transposed(panel[:p], own)
        return x

    @cached_property
    def rcond(self) -> float:
        """Reciprocal condition number of the scaled reduced normal matrix, estimated in the 1-norm (Higham & Tisseur 2000)."""
        n = self.count
        if not n:
            return 1.0
        if self.structure.border:
            raise UsageError("a part of a larger network has no condition number of its own")

        def product(x: Floats) -> Floats:
            y = x.reshape(n, -1).copy()
            for front, panel in zip(self.structure.fronts, self.panels, strict=True):  # y = L' x
                p = front.pivots
                own = np.tril(panel[:p]).T @ y[front.begin : front.begin + p]
                y[front.begin : front.begin + p] = own + panel[p:].T @ y[front.columns[p:]]
            for front, panel in zip(reversed(self.structure.fronts), reversed(self.panels), strict=True):  # L y
                p = front.pivots
                own = y[front.begin : front.begin + p].copy()
                y[front.columns[p:]] += panel[p:] @ own
                y[front.begin : front.begin + p] = np.tril(panel[:p]) @ own
            return y

        def solved(x: Floats) -> Floats:
            return self.solve_reduced(x.reshape(n, -1).copy())

        norms = [onenormest(LinearOperator((n, n), matvec=f, rmatvec=f, matmat=f, rmatmat=f, dtype=float)) for f in (product, solved)]
        return float(1.0 / (norms[0] * norms[1]))

    # ---- statistics ----
    def hat(self, whole: bool = True) -> list[Floats]:
        """Return for each chunk the (N, m, m) diagonal blocks of A N^-1 A'.

        Without `whole` only their diagonals (N, m) for plain chunks; these are handed over, so that they need not be kept twice.
        """
        last = self._last
        if not last or last[0].hats is None or (whole and not last[0].whole):
            last[:] = [self._selected(whole)]
        hats = last[0].hats or []
        if not whole and last[0].whole:
            return [np.einsum("nii->ni", h) if c.plain else h for c, h in zip(self.lin.chunks, hats, strict=True)]
        if not whole:
            last[0] = last[0]._replace(hats=None)
        return hats

    def blocks(self, columns: Ints) -> Floats:
        """Return the (N, w, w) blocks of N^-1 for (N, w) columns: each of one node of the reduced system, or of one point."""
        if not self._last:
            self._last.append(self._selected(whole=False))
        points, nodes = self._last[0].points, self._last[0].nodes
        every = self.lin.unknowns["point"].columns.reshape(-1, 3)
        if np.array_equal(columns, every):
            return points
        own = self.structure.point_columns
        point, axis = np.full(len(self.inverse), -1, dtype=np.int32), np.zeros(len(self.inverse), dtype=np.int8)
        point[own] = self.structure.points[:, None]
        axis[own] = np.arange(3)
        point[-1] = -1
        where = point[columns].max(axis=1, initial=-1)
        out = np.zeros((*columns.shape, columns.shape[1]))
        inner = np.flatnonzero(where >= 0)
        if np.array_equal(columns[inner], every[where[inner]]):  # whole points: zero where a coordinate is fixed
            out[inner] = points[where[inner]]
        else:
            at, free = axis[columns[inner]], columns[inner] >= 0
            found = points[where[inner][:, None, None], at[:, :, None], at[:, None, :]]
            out[inner] = np.where(free[:, :, None] & free[:, None, :], found, 0.0)
        outer = np.flatnonzero(where < 0)
        out[outer] = nodes(columns[outer])
        return out

    def pairs(self, a: Ints, b: Ints) -> Floats:
        """Return the (len(a), len(b)) block of N^-1 for any columns; zero where a column is -1 or held."""
        return pairs(self, a, b)

    @cached_property
    def _last(self) -> list[Statistics]:
        """The statistics, once computed."""
        return []

    def _selected(self, whole: bool) -> Statistics:
        if self.structure.border and self.border_inverse is None:
            raise UsageError("a part of a larger network needs the cofactors of its border")
        return selected_inverse(self, whole)


def _added(structure: Structure, fronts: Sequence[int], shares: list[Floats]) -> Floats:
    """Add up what clusters leave for the columns of their fronts, (U + 1,); the last is for parameters that are fixed."""
    out = np.zeros(len(structure.order) + 1)
    for f, share in zip(fronts, shares, strict=True):
        out[structure.fronts[f].columns] += share
    return out


def _after(front: Front) -> list[int]:
    return [front.parent] if front.parent >= 0 else []


def _rest_by_front(lin: Linearization, structure: Structure, inverse: Floats) -> dict[int, list[tuple[Ints, Floats]]]:
    out: dict[int, list[tuple[Ints, Floats]]] = {}
    for entry in structure.rest:
        h = scaled_rows(lin.chunks[entry.chunk], entry.rows, inverse)
        order = np.argsort(entry.front, kind="stable")
        fronts, first = np.unique(entry.front[order], return_index=True)
        for f, some in zip(fronts, np.split(order, first[1:]), strict=True):
            out.setdefault(int(f), []).append((entry.at[some], h[some]))
    return out


def _add_rows(matrix: Floats, at: Ints, jacobian: Floats) -> None:
    """Add J'J of row blocks to the lower triangle of a front; column -1 is fixed."""
    values = np.einsum("nmi,nmj->nij", jacobian, jacobian)
    i, j = np.broadcast_to(at[:, :, None], values.shape), np.broadcast_to(at[:, None, :], values.shape)
    used = (i >= j) & (j >= 0)
    np.add.at(matrix, (i[used], j[used]), values[used])


def _refuse_points(lin: Linearization, columns: Ints) -> None:
    names = [lin.unknowns.name(int(c)) for c in columns[:4].ravel() if c >= 0]
    raise Singular(f"the rays do not determine {len(columns)} object point(s): {', '.join(names[:12])}", names)


def _refuse_nodes(
    lin: Linearization, structure: Structure, inverse: Floats, arrays: Blocks, loops: Kernels, size: Ints, diagonal: Floats,
    weakest: int, pivots: Floats, failed: bool,
) -> None:  # fmt: skip
    """Name the unknowns of a null space: of the whole reduced matrix where it is small enough, else of the front that shows it."""
    n = len(structure.order)
    if n > SEARCHED or structure.border:
        front = structure.fronts[weakest]
        columns = structure.order[front.begin : front.begin + front.pivots]
        refuse_null_space(np.tril(pivots) + np.tril(pivots, -1).T, columns, lin, failed)
        return
    matrix = np.zeros((n, n))
    scratch, flags = np.zeros((len(structure.points), 3, 3)), np.zeros(len(structure.points), dtype=bool)
    rest = _rest_by_front(lin, structure, inverse)
    for f, front in enumerate(structure.fronts):
        part = np.zeros((len(front.columns), len(front.columns)))
        for run in structure.runs_of_fronts[f]:
            loops.accumulate(
                run.clusters, part, lin.misclosure, np.zeros(len(part)), with_partials(arrays, lin, run.spans), scratch, flags, size
            )
        for at, jacobian in rest.get(f, ()):
            _add_rows(part, at, jacobian)
        matrix[np.ix_(front.columns, front.columns)] += part
    matrix[np.arange(n), np.arange(n)] += diagonal
    refuse_null_space(np.tril(matrix) + np.tril(matrix, -1).T, structure.order, lin, failed)
