"""All observations at one state, whitened: computed once, handed down to solvers, datum and statistics."""

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
from baarda.errors import InputError, UsageError
from baarda.network import Network, State, UnknownGroup, Unknowns
from baarda.observations import Kind, Rows

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

PIECE = 16384  # row blocks handled by one task
FEW = 100_000  # observations up to which many vectors at once are multiplied by the sparse matrix


@dataclass(frozen=True)
class Part:
    """The columns of one unknown group in a chunk: nodes (N,), the positions (w,) kept of each node, whitened partials (N, m, w).

    Positions are kept where any node of this kind and width has an unknown; where a node has none, its column is -1. The partials are
    a view of the values of the linearization, from `start`.
    """

    group: UnknownGroup
    nodes: Ints
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
        return np.asarray(self.table[self.nodes[rows]])

    @cached_property
    def table(self) -> Ints:
        """The (nodes, w) columns of all nodes of the group; of no meaning for nodes of another width."""
        last = max(len(self.group.columns) - 1, 0)
        return np.asarray(self.group.columns[np.minimum(self.group.offsets[:-1, None] + self.positions, last)])


@dataclass(frozen=True)
class Chunk:
    """Whitened row blocks: first scalar row (N,), misclosures (N, m), parts, and the factors L (N, m, m) of the cofactors Q = L L'.

    Of a combined model with fewer conditions than observations, `controlled` (N, m, m) projects onto what the conditions control.
    """

    first: Ints
    misclosure: Floats
    parts: tuple[Part, ...]
    factor: Floats
    controlled: Floats | None = None

    @property
    def rows(self) -> Ints:
        """The (N, m) scalar rows."""
        return np.asarray(self.first[:, None] + np.arange(self.misclosure.shape[1]))

    @property
    def correlated(self) -> bool:
        """Whether rows of a block are correlated."""
        factor = self.factor[:1] if self.factor.strides[0] == 0 else self.factor
        return factor.shape[1] > 1 and bool(np.any(np.tril(factor, -1)))

    def pieces(self) -> list[slice]:
        """Return slices of row blocks that one task handles."""
        return [slice(a, a + PIECE) for a in range(0, len(self.first), PIECE)]


@dataclass(frozen=True)
class Arrangement:
    """Observation groups in the order of the source, and the same sorted so that neighbouring rows share object points.

    Attributes
    ----------
    groups, sorted : tuples of observation groups
    orders : tuple of int arrays
        The rows of each sorted group in the source's group.
    """

    groups: tuple[Kind, ...]
    sorted: tuple[Kind, ...]
    orders: tuple[Ints, ...]

    @staticmethod
    def of(groups: Sequence[Kind], point_rank: Ints | None = None) -> Arrangement:
        """Sort the groups that allow it by the rank of their points; without ranks all stay as they are."""
        chosen, orders = [], []
        group: Any
        for group in groups:
            order = np.arange(len(group))
            if point_rank is not None and hasattr(group, "pieces"):
                order = np.argsort(point_rank[group.points], kind="stable")
                group = group.selected(order)
            chosen.append(group)
            orders.append(order)
        return Arrangement(tuple(groups), tuple(chosen), tuple(orders))

    @cached_property
    def offsets(self) -> Ints:
        """First scalar row of each group, and n."""
        return offsets_of(self.groups)


@dataclass(frozen=True)
class Linearization:
    """The whitened linear system l + v = A x at one state.

    Attributes
    ----------
    unknowns : Unknowns
    chunks : tuple of Chunk
    count : int
        Number n of scalar observations.
    values : array
        The partials of all chunks and parts, one after the other.
    workers : int or None
        Number of threads; None = one for each core. Nothing depends on it but the time.
    """

    unknowns: Unknowns
    chunks: tuple[Chunk, ...]
    count: int
    values: Floats
    workers: int | None = None

    @cached_property
    def uncontrolled(self) -> int:
        """How many combinations of observations no condition controls: they have no redundancy."""
        return round(sum(c.misclosure.size - float(np.einsum("nii->", c.controlled)) for c in self.chunks if c.controlled is not None))

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
            parts = []
            for p in c.parts:
                view = values[p.start : p.start + p.jacobian.size].reshape(p.jacobian.shape)
                np.multiply(p.jacobian, w[:, :, None], out=view)
                parts.append(replace(p, jacobian=view))
            chunks.append(replace(c, misclosure=c.misclosure * w, parts=tuple(parts)))
        return replace(self, chunks=tuple(chunks), values=values)

    @cached_property
    def misclosure(self) -> Floats:
        """The whitened misclosures, (n,)."""
        out = np.empty(self.count)
        for c in self.chunks:
            out[c.rows] = c.misclosure
        return out

    @cached_property
    def design(self) -> Any:
        """The whitened design matrix, (n, u), sparse by rows: for small systems and as an oracle; `times` and `transposed` need no copy."""
        rows, columns, values = [], [], []
        for c in self.chunks:
            for part in c.parts:
                shape = part.jacobian.shape
                column = np.broadcast_to(part.columns[:, None, :], shape)
                used = column >= 0
                rows.append(np.broadcast_to(c.rows[:, :, None], shape)[used])
                columns.append(column[used])
                values.append(part.jacobian[used])
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
            for part in c.parts:
                if kinds is None or part.kind in kinds:
                    multiply(part.jacobian[some], part.nodes[some], part.table, padded, c.first[some], out)

        self._each(product)
        return out

    def row_sums(self, weights: Floats) -> Floats:
        """Return sum_j A_ij^2 weights_j of each row i, (n,)."""
        padded = np.append(weights, 0.0)
        out = np.zeros(self.count)

        def sums(c: Chunk, some: slice) -> None:
            m = c.misclosure.shape[1]
            total = sum(np.einsum("nmw,nmw,nw->nm", p.jacobian[some], p.jacobian[some], padded[p.columns_of(some)]) for p in c.parts)
            out[c.first[some][:, None] + np.arange(m)] = total

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
        """Add up what the row blocks contribute to their columns, part by part."""
        loops = vector_loops(self.count)
        parts = [(c, p) for c in self.chunks for p in c.parts if kinds is None or p.kind in kinds]
        y = np.ascontiguousarray(y)

        def contribute(i: int) -> Floats:
            c, part = parts[i]
            own = np.zeros((self.unknowns.count + 1, *y.shape[1:]))
            if y.ndim == 1:
                loops.gathered(part.jacobian, part.nodes, part.table, y, c.first, squared, own)
            else:
                loops.gathered_many(part.jacobian, part.nodes, part.table, y, c.first, own)
            return own

        out = np.zeros((self.unknowns.count + 1, *y.shape[1:]))
        for own in for_each(range(len(parts)), contribute, self.workers):
            out += own
        return out[:-1]

    def _each(self, function: Callable[[Chunk, slice], None]) -> None:
        for c in self.chunks:
            for _ in for_each(c.pieces(), partial(function, c), self.workers):
                pass

    @cached_property
    def scale(self) -> Floats:
        """The Euclidean norms of the columns of the design matrix, (u,); 1 where a column is zero."""
        norms = np.sqrt(self.column_sums(np.ones(self.count)))
        return np.where(norms > 0.0, norms, 1.0)


def offsets_of(groups: Sequence[Kind]) -> Ints:
    """Return the first scalar row of each group, and the total at the end."""
    return np.concatenate([[0], np.cumsum([len(g) * len(g.components) for g in groups])]).astype(np.intp)


def linearize(
    network: Network, state: State, unknowns: Unknowns, groups: Sequence[Kind] | Arrangement, workers: int | None = None
) -> Linearization:
    """Linearise and whiten all observation groups.

    Parameters
    ----------
    network : Network
        Constants of the cameras and labels.
    state : State
        Where to linearise.
    unknowns : Unknowns
    groups : sequence of Kind, or Arrangement
    workers : int, optional
        Number of threads.

    Raises
    ------
    InputError
        If a cofactor matrix is not positive definite.
    """
    arranged = groups if isinstance(groups, Arrangement) else Arrangement.of(groups)
    kept = kept_positions(unknowns)
    fillings: list[_Filling] = []
    group: Any
    for g, group in enumerate(arranged.sorted):
        first = arranged.offsets[g] + arranged.orders[g] * len(group.components)
        if hasattr(group, "pieces"):
            by_width: dict[int, list[Any]] = {}
            for piece in group.pieces(network):
                by_width.setdefault(piece.width, []).append(piece)
            for pieces in by_width.values():
                rows = group.linearize_piece(network, state, pieces[0])
                evaluate, fill = (partial(f, network, state) for f in (group.linearize_piece, group.fill))
                later = [_Later(len(p.rows), group.images_of(network, p), partial(evaluate, p), partial(fill, p)) for p in pieces[1:]]
                where = np.concatenate([first[p.rows] for p in pieces])
                fillings.append(_Filling.of(rows, later, where, unknowns, kept, group.name))
        else:
            for rows in group.linearize(network, state):
                fillings.append(_Filling.of(rows, [], first[rows.index], unknowns, kept, group.name))
    values = np.empty(sum(f.size for f in fillings))
    start = 0
    for f in fillings:
        f.fill(values, start, workers)
        start += f.size
    return Linearization(unknowns, tuple(f.chunk() for f in fillings), int(arranged.offsets[-1]), values, workers)


def kept_positions(unknowns: Unknowns) -> dict[tuple[str, int], Ints]:
    """Return for each kind and width of nodes the positions where any node has an unknown."""
    out: dict[tuple[str, int], Ints] = {}
    for group in unknowns.groups:
        widths = np.diff(group.offsets)
        for width in np.unique(widths):
            columns = group.columns[group.offsets[:-1][widths == width][:, None] + np.arange(width)]
            out[group.kind, int(width)] = np.flatnonzero((columns >= 0).any(axis=0))
    return out


@dataclass(frozen=True)
class _Later:
    """A piece: its number of row blocks, its images in words, what computes it, and what may write it straight into a chunk.

    The latter returns the sigmas, or None where it cannot.
    """

    count: int
    name: str
    compute: Callable[[], Rows]
    fill: Callable[..., Floats | None]


@dataclass
class _Filling:
    """A chunk that is filled piece by piece."""

    name: str
    first: Ints
    rows: list[Rows]
    later: list[_Later]
    groups: list[tuple[UnknownGroup, Ints]]
    misclosure: Floats
    parts: list[Part]
    factors: dict[int, Floats]
    controlled: dict[int, Floats]

    @staticmethod
    def of(rows: Rows, later: list[Any], first: Ints, unknowns: Unknowns, kept: Any, name: str) -> _Filling:
        """Plan a chunk from its first piece, and what computes the others."""
        nothing = np.zeros(0, dtype=np.intp)
        groups = [(unknowns[b.kind], kept.get((b.kind, b.jacobian.shape[2]), nothing)) for b in rows.blocks]
        return _Filling(name, first, [rows], later, groups, np.empty((len(first), rows.misclosure.shape[1])), [], {}, {})

    @property
    def size(self) -> int:
        """How many partials there are."""
        return int(self.misclosure.size * sum(len(at) for _, at in self.groups))

    def fill(self, values: Floats, start: int, workers: int | None) -> None:
        """Compute and store everything, the partials in `values` from `start`."""
        n, m = self.misclosure.shape
        for group, at in self.groups:
            size = n * m * len(at)
            self.parts.append(Part(group, np.empty(n, dtype=np.intp), at, values[start : start + size].reshape(n, m, len(at)), start))
            start += size
        rows = self.rows.pop()
        self._put(0, rows)
        starts = np.cumsum([len(rows.index), *(piece.count for piece in self.later)])
        for _ in for_each(range(len(self.later)), lambda i: self._add(int(starts[i]), self.later[i]), workers):
            pass

    def _add(self, start: int, piece: _Later) -> None:
        """Let a piece write its rows where they belong, or store what it computes."""
        try:
            self._take(start, piece)
        except Exception as error:
            error.add_note(f"{self.name}: {piece.name}")
            raise

    def _take(self, start: int, piece: _Later) -> None:
        some = slice(start, start + piece.count)
        parts = [(p.positions, p.nodes[some], p.jacobian[some]) for p in self.parts]
        sigma = piece.fill(self.misclosure[some], parts)
        if sigma is None:
            self._put(start, piece.compute())
        else:
            self.factors[start] = _diagonal(sigma)

    def _put(self, start: int, rows: Rows) -> None:
        """Whiten and store the row blocks of a piece."""
        some = slice(start, start + len(rows.index))
        factor, whiten = _factor(rows.cofactor, self.name)
        self.misclosure[some] = _apply(whiten, rows.misclosure[:, :, None])[:, :, 0]
        for b, part in zip(rows.blocks, self.parts, strict=True):
            part.nodes[some] = b.nodes
            at = part.positions
            part.jacobian[some] = _apply(whiten, b.jacobian if len(at) == b.jacobian.shape[2] else b.jacobian[:, :, at])
        self.factors[start] = factor
        if rows.condition is not None:
            basis = np.linalg.qr((rows.condition @ factor).transpose(0, 2, 1))[0]
            self.controlled[start] = basis @ basis.transpose(0, 2, 1)

    def chunk(self) -> Chunk:
        """Return the chunk; factors that are all equal are stored once."""
        n, m = self.misclosure.shape
        starts = [*sorted(self.factors), n]
        factors = [self.factors[k] for k in starts[:-1]]
        if all(len(f) == 1 and np.array_equal(f, factors[0]) for f in factors):
            factor = np.broadcast_to(factors[0], (n, m, m))
        else:
            factor = np.concatenate([np.broadcast_to(f, (b - a, m, m)) for f, a, b in zip(factors, starts[:-1], starts[1:], strict=True)])
        controlled = np.concatenate([self.controlled[k] for k in starts[:-1]]) if self.controlled else None
        return Chunk(self.first, self.misclosure, tuple(self.parts), factor, controlled)


def whitened_misclosures(network: Network, state: State, groups: Sequence[Kind] | Arrangement, workers: int | None = None) -> Floats:
    """Return the whitened misclosures (n,) without partials; not finite where an observation cannot be computed."""
    arranged = groups if isinstance(groups, Arrangement) else Arrangement.of(groups)
    out = np.empty(int(arranged.offsets[-1]))
    for g, group in enumerate(arranged.sorted):
        m = len(group.components)
        first = arranged.offsets[g] + arranged.orders[g] * m
        if hasattr(group, "pieces"):

            def work(piece: Any, group: Any = group, first: Ints = first, m: int = m) -> None:
                misclosure = group.misclosures_of_piece(network, state, piece)
                out[first[piece.rows][:, None] + np.arange(m)] = _white(misclosure, group, piece.rows)

            for _ in for_each(group.pieces(network), work, workers):
                pass
        else:
            out[first[:, None] + np.arange(m)] = _white(group.misclosures(network, state), group, slice(None))
    return out


def _white(misclosure: Floats, group: Any, rows: Any) -> Floats:
    correlation = getattr(group, "correlations", None)
    if hasattr(group, "covariances"):
        return np.asarray(np.linalg.solve(np.linalg.cholesky(group.covariances[rows]), misclosure[:, :, None])[:, :, 0], dtype=float)
    sigma = group.sigma()[rows]
    if correlation is not None and np.any(correlation[rows]):
        x = misclosure[:, 0] / sigma[:, 0]
        y = (misclosure[:, 1] / sigma[:, 1] - correlation[rows] * x) / np.sqrt(1.0 - correlation[rows] ** 2)
        return np.stack([x, y], axis=1)
    return np.asarray(misclosure / sigma)


def _factor(cofactor: Floats, name: str) -> tuple[Floats, Floats]:
    """Return L with Q = L L' and its inverse; the inverse of diagonal ones as (N, m)."""
    m = cofactor.shape[1]
    if cofactor.ndim == 2 or m == 1 or not np.any(cofactor[:, ~np.eye(m, dtype=bool)]):
        sigma = np.sqrt(cofactor if cofactor.ndim == 2 else np.einsum("nii->ni", cofactor))
        if not np.all(sigma > 0.0):
            raise InputError(f"{name}: a cofactor matrix is not positive definite (a sigma of zero)")
        return _diagonal(sigma), 1.0 / sigma
    try:
        factor = np.asarray(np.linalg.cholesky(cofactor), dtype=float)
    except np.linalg.LinAlgError:
        raise InputError(f"{name}: a cofactor matrix is not positive definite (correlation beyond 1, or a sigma of zero)") from None
    return factor, np.asarray(np.linalg.inv(factor), dtype=float)


def _diagonal(sigma: Floats) -> Floats:
    """Return the factors (N, m, m) of uncorrelated rows; (1, m, m) where all are equal."""
    same = len(sigma) > 0 and bool(np.all(sigma == sigma[0]))
    factor = np.zeros((1 if same else len(sigma), sigma.shape[1], sigma.shape[1]))
    np.einsum("nii->ni", factor)[...] = sigma[: len(factor)]
    return factor


def _apply(whiten: Floats, array: Floats) -> Floats:
    return whiten[:, :, None] * array if whiten.ndim == 2 else whiten @ array


def check_finite(lin: Linearization, groups: Sequence[Kind], network: Network) -> None:
    """Refuse misclosures that are not finite, naming the first observation at fault."""
    bad = np.flatnonzero(~np.isfinite(lin.misclosure))
    if not len(bad):
        return
    offsets = offsets_of(groups)
    g = int(np.searchsorted(offsets, bad[0], side="right")) - 1
    row = int(bad[0] - offsets[g]) // len(groups[g].components)
    labels = groups[g].labels(network)
    place = ", ".join(
        f"{kind} {names[int(labels[kind][row])]}"
        for kind, names in (("image", network.images.labels), ("point", network.points.labels))
        if kind in labels
    )
    raise UsageError(f"{groups[g].name}: the observation of {place} cannot be computed from the start values")
