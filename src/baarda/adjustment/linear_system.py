"""The whitened linear system l + v = A x at one state, in chunks of row blocks, and its products with vectors."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from baarda.adjustment.vector_loops import vector_loops
from baarda.adjustment.workers import for_each
from baarda.errors import UsageError
from baarda.network import UnknownGroup, Unknowns

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Small = NDArray[np.int32]

PIECE = 4096  # row blocks handled by one task
SHARES = 4  # tasks that need memory of their own
FEW = 100_000  # observations up to which many vectors at once are multiplied by the sparse matrix


@dataclass(frozen=True)
class Part:
    """The columns of one unknown group in a chunk: nodes (N,), the positions (w,) kept of each node, whitened partials (N, m, w).

    Positions are kept where any node of this kind and width has an unknown; where a node has none, its column is -1. The partials are
    a view of the values of the linearization, from `start`; none and -1 where the chunk evaluates them.
    """

    group: UnknownGroup
    nodes: Small
    positions: Ints
    jacobian: Floats
    start: int

    @property
    def kind(self) -> str:
        """The unknown group."""
        return self.group.kind

    @property
    def columns(self) -> Ints:
        """The (N, w) columns."""
        return self.columns_of(slice(None))

    def columns_of(self, rows: Any) -> Ints:
        """Return the (n, w) columns of some row blocks."""
        return np.asarray(self.group.columns[self.group.offsets[self.nodes[rows]][:, None] + self.positions])

    def nodes_of(self, rows: slice) -> Small:
        """Return the nodes of some row blocks one after the other in memory, as the loops are compiled for."""
        return np.ascontiguousarray(self.nodes[rows])

    @cached_property
    def table(self) -> Ints:
        """The (nodes, w) columns of all nodes of the group; of no meaning for nodes of another width."""
        width = len(self.positions)
        if width and len(self.group.columns) == width * len(self.group.labels) and (np.diff(self.group.offsets) == width).all():
            return self.group.columns.reshape(-1, width)  # all are kept of all: no copy
        last = max(len(self.group.columns) - 1, 0)
        return np.asarray(self.group.columns[np.minimum(self.group.offsets[:-1, None] + self.positions, last)])


@dataclass(frozen=True)
class Chunk:
    """Whitened row blocks of m rows: first scalar row (N,), parts, and the factors L (N, m, m) of the cofactors Q = L L'.

    Of a combined model with fewer conditions than observations, `controlled` (N, m, m) projects onto what the conditions control. The
    partials of large groups, which would take more memory than all the rest, are not stored: `evaluate` writes those of some row blocks
    (a slice or indices) into an array, part after part.
    """

    first: Ints | Small
    parts: tuple[Part, ...]
    factor: Floats
    controlled: Floats | None = None
    evaluate: Callable[[Any, Floats], None] | None = None

    @property
    def m(self) -> int:
        """The number of rows of a block."""
        return int(self.factor.shape[1])

    @property
    def rows(self) -> Ints:
        """The (N, m) scalar rows."""
        return self.rows_of(slice(None))

    def rows_of(self, blocks: Any) -> Ints:
        """Return the (n, m) scalar rows of some row blocks."""
        return np.asarray(self.first[blocks][:, None] + np.arange(self.m))

    @property
    def per_block(self) -> int:
        """The number of partials of a row block."""
        return self.m * sum(len(p.positions) for p in self.parts)

    def partials(self, rows: Any = slice(None)) -> list[Floats]:
        """Return the whitened partials (n, m, w) of each part at some row blocks, a slice or indices."""
        if self.evaluate is None:
            return [p.jacobian[rows] for p in self.parts]
        n = len(range(*rows.indices(len(self.first)))) if isinstance(rows, slice) else len(rows)
        values = np.empty(n * self.per_block)
        self.evaluate(rows, values)
        return split(values, n, self.m, [p.positions for p in self.parts])

    @property
    def correlated(self) -> bool:
        """Whether rows of a block are correlated."""
        factor = self.factor[:1] if self.factor.strides[0] == 0 else self.factor
        return any(bool(factor[:, i, j].any()) for i in range(self.m) for j in range(i))

    @property
    def plain(self) -> bool:
        """Whether rows are uncorrelated and controlled in full, so that of their statistics only diagonals count."""
        return self.controlled is None and not self.correlated

    def pieces(self) -> list[slice]:
        """Return slices of row blocks that one task handles."""
        return _pieces(0, len(self.first))

    def shares(self) -> list[slice]:
        """Return a few slices of row blocks for tasks that need memory of their own."""
        n = len(self.first)
        count = SHARES if n > PIECE else 1
        return [slice(n * k // count, n * (k + 1) // count) for k in range(count)]


def _pieces(begin: int, end: int) -> list[slice]:
    return [slice(a, min(a + PIECE, end)) for a in range(begin, end, PIECE)]


def _weighted(evaluate: Callable[[Any, Floats], None], positions: Sequence[Ints], w: Floats, rows: Any, values: Floats) -> None:
    """Evaluate row blocks and multiply their rows by w (N, m)."""
    evaluate(rows, values)
    own = w[rows]
    for jacobian in split(values, len(own), own.shape[1], positions):
        jacobian *= own[:, :, None]


def split(values: Floats, count: int, rows: int, positions: Sequence[Ints]) -> list[Floats]:
    """Return the views (count, rows, w) of the partials of each part, which lie one after the other."""
    out, at = [], 0
    for p in positions:
        end = at + count * rows * len(p)
        out.append(values[at:end].reshape(count, rows, len(p)))
        at = end
    return out


def small(numbers: Ints, bound: int) -> Ints | Small:
    """Return whole numbers below a bound in 32 bits where they fit."""
    return numbers.astype(np.int32) if bound <= np.iinfo(np.int32).max else numbers


@dataclass(frozen=True)
class Linearization:
    """The whitened linear system l + v = A x at one state.

    Attributes
    ----------
    unknowns : Unknowns
    chunks : tuple of Chunk
    misclosure : (n,) array
        The whitened misclosures of all scalar observations.
    values : array
        The stored partials of all chunks and parts, one after the other.
    workers : int or None
        Number of threads; None = one for each core. Nothing depends on it but the time.
    near : (u,) array or None
        The scale of a system nearby, which does for this one.
    """

    unknowns: Unknowns
    chunks: tuple[Chunk, ...]
    misclosure: Floats
    values: Floats
    workers: int | None = None
    near: Floats | None = None

    @property
    def count(self) -> int:
        """The number n of scalar observations."""
        return len(self.misclosure)

    @property
    def stored(self) -> bool:
        """Whether all partials are stored."""
        return all(c.evaluate is None for c in self.chunks)

    @cached_property
    def uncontrolled(self) -> int:
        """How many combinations of observations no condition controls: they have no redundancy."""
        return round(sum(len(c.first) * c.m - float(np.einsum("nii->", c.controlled)) for c in self.chunks if c.controlled is not None))

    def weighted(self, roots: Floats) -> Linearization:
        """Return the system with its rows multiplied by the roots of their weights, (n,).

        Raises
        ------
        UsageError
            If a combined model with fewer conditions than observations is in it.
        """
        if self.uncontrolled:
            raise UsageError("a combined model with fewer conditions than observations cannot be adjusted under a law of errors")
        values = np.empty_like(self.values)
        chunks = []
        for c in self.chunks:
            w = roots[c.rows]
            if c.evaluate is not None:
                chunks.append(replace(c, evaluate=partial(_weighted, c.evaluate, [p.positions for p in c.parts], w)))
                continue
            parts = []
            for p in c.parts:
                view = values[p.start : p.start + p.jacobian.size].reshape(p.jacobian.shape)
                np.multiply(p.jacobian, w[:, :, None], out=view)
                parts.append(replace(p, jacobian=view))
            chunks.append(replace(c, parts=tuple(parts)))
        return replace(self, chunks=tuple(chunks), misclosure=self.misclosure * roots, values=values, near=None)

    def sample(self, most: int) -> Linearization:
        """Return a part of the rows: at most some `most` row blocks of each chunk, those that end at a fixed parameter first.

        What is determined by these rows is determined by all.
        """
        chunks, values, chosen, at, count = [], [np.zeros(0)], [np.zeros(0)], 0, 0
        for c in self.chunks:
            rows = np.arange(len(c.first))
            if len(rows) > most:
                held = np.zeros(len(rows), dtype=bool)
                for p in c.parts:
                    if p.kind == "point":
                        held |= np.any(p.table < 0, axis=1)[p.nodes]
                ends = np.flatnonzero(held)
                rows = np.unique(np.concatenate([ends[:: len(ends) // most + 1], rows[:: len(rows) // most + 1]]))
            parts = []
            for p, jacobian in zip(c.parts, c.partials(rows), strict=True):
                values.append(np.ascontiguousarray(jacobian))
                parts.append(replace(p, nodes=p.nodes[rows], jacobian=values[-1], start=at))
                at += values[-1].size
            controlled = None if c.controlled is None else c.controlled[rows]
            first = small(count + c.m * np.arange(len(rows)), self.count)
            chunks.append(Chunk(first, tuple(parts), c.factor[rows], controlled))
            chosen.append(self.misclosure[c.rows_of(rows)].ravel())
            count += c.m * len(rows)
        joined = np.concatenate([v.ravel() for v in values])
        return Linearization(self.unknowns, tuple(chunks), np.concatenate(chosen), joined, self.workers)

    @cached_property
    def design(self) -> Any:
        """The whitened design matrix, (n, u), sparse by rows: for small systems and as an oracle; `times` and `transposed` need no copy."""
        rows, columns, values = [], [], []
        for c in self.chunks:
            for part, jacobian in zip(c.parts, c.partials(), strict=True):
                shape = jacobian.shape
                column = np.broadcast_to(part.columns[:, None, :], shape)
                used = column >= 0
                rows.append(np.broadcast_to(c.rows[:, :, None], shape)[used])
                columns.append(column[used])
                values.append(jacobian[used])
        if not rows:
            return sparse.csr_array((self.count, self.unknowns.count))
        coordinates = (np.concatenate(rows), np.concatenate(columns))
        return sparse.coo_array((np.concatenate(values), coordinates), shape=(self.count, self.unknowns.count)).tocsr()

    def times(self, x: Floats, kinds: Container[str] | None = None) -> Floats:
        """Return A x for (u,) or (u, k) vectors; with `kinds` only of the parts of these unknown groups."""
        if x.ndim == 2 and self.count <= FEW and kinds is None:
            return np.asarray(self.design @ x)
        if x.ndim == 2 and x.shape[1] == 1:
            return self.times(x[:, 0], kinds)[:, None]
        padded = np.concatenate([x, np.zeros((1, *x.shape[1:]))])
        out = np.zeros((self.count, *x.shape[1:]))
        loops = vector_loops(self.count)
        multiply = loops.times if x.ndim == 1 else loops.times_many

        def product(c: Chunk, some: slice) -> None:
            for part, jacobian in zip(c.parts, c.partials(some), strict=True):
                if kinds is None or part.kind in kinds:
                    multiply(jacobian, part.nodes_of(some), part.table, padded, c.first[some], out)

        self._each(product)
        return out

    def row_sums(self, weights: Floats) -> Floats:
        """Return sum_j A_ij^2 weights_j of each row i, (n,)."""
        padded = np.append(weights, 0.0)
        out = np.zeros(self.count)

        def sums(c: Chunk, some: slice) -> None:
            pairs = zip(c.parts, c.partials(some), strict=True)
            total = sum(np.einsum("nmw,nmw,nw->nm", jacobian, jacobian, padded[p.columns_of(some)]) for p, jacobian in pairs)
            out[c.rows_of(some)] = total

        self._each(sums)
        return out

    def transposed(self, y: Floats, kinds: Container[str] | None = None) -> Floats:
        """Return A' y for (n,) or (n, k) vectors; with `kinds` only the rows of these unknown groups, the others zero."""
        if y.ndim == 2 and self.count <= FEW and kinds is None:
            return np.asarray(self.design.T @ y)
        if y.ndim == 2 and y.shape[1] == 1:
            return self.transposed(y[:, 0], kinds)[:, None]
        return self._gathered(y, kinds, squared=False)

    def column_sums(self, weights: Floats) -> Floats:
        """Return sum_i weights_i A_ij^2 of each column j, (u,)."""
        return self._gathered(weights, None, squared=True)

    def _gathered(self, y: Floats, kinds: Container[str] | None, squared: bool) -> Floats:
        """Add up what the row blocks contribute to their columns."""
        loops = vector_loops(self.count)
        y = np.ascontiguousarray(y)

        def contribute(c: Chunk, share: slice) -> Floats:
            own = np.zeros((self.unknowns.count + 1, *y.shape[1:]))
            for some in [share] if c.evaluate is None else _pieces(share.start, share.stop):
                for part, jacobian in zip(c.parts, c.partials(some), strict=True):
                    if kinds is not None and part.kind not in kinds:
                        continue
                    if y.ndim == 1:
                        loops.gathered(jacobian, part.nodes_of(some), part.table, y, c.first[some], squared, own)
                    else:
                        loops.gathered_many(jacobian, part.nodes_of(some), part.table, y, c.first[some], own)
            return own

        out = np.zeros((self.unknowns.count + 1, *y.shape[1:]))
        for c in self.chunks:
            for own in for_each(c.shares(), partial(contribute, c), self.workers):
                out += own
        return out[:-1]

    def _each(self, function: Callable[[Chunk, slice], None]) -> None:
        for c in self.chunks:
            for_each(c.pieces(), partial(function, c), self.workers)

    @cached_property
    def norms(self) -> Floats:
        """The Euclidean norms of the columns of the design matrix, (u,); 1 where a column is zero."""
        norms = np.sqrt(self.column_sums(np.ones(self.count)))
        return np.where(norms > 0.0, norms, 1.0)

    @property
    def scale(self) -> Floats:
        """The norms of the columns, (u,), or those of a system nearby."""
        return self.norms if self.near is None else self.near
