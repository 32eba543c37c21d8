"""All observations at one state, whitened: computed once, handed down to solvers, datum and statistics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from baarda.adjustment.linear_system import PIECE, Chunk, Linearization, Part, small, split
from baarda.adjustment.workers import for_each, scratch
from baarda.errors import InputError, UsageError
from baarda.network import Network, State, UnknownGroup, Unknowns
from baarda.observations import Kind, Rows
from baarda.observations.image_points import CHUNK, Evaluation, Piece

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Small = NDArray[np.int32]


EVALUATED_FROM = 100_000  # rows of a group whose partials are evaluated wherever they are needed, not stored
MANY_OPTICS = 16  # more than these are stored
FEW_BESIDE = 10_000  # scalar rows of other kinds with points: their partials are copied where those of image points are evaluated


@dataclass(frozen=True)
class Arrangement:
    """Observation groups in the order of the source, and the same sorted so that neighbouring rows share object points.

    Attributes
    ----------
    groups, sorted : tuples of observation groups
    orders : tuple of int32 or int arrays
        The rows of each sorted group in the source's group.
    ranked : bool
        Whether there was a rank to sort by.
    """

    groups: tuple[Kind, ...]
    sorted: tuple[Kind, ...]
    orders: tuple[Ints | Small, ...]
    ranked: bool = False

    @staticmethod
    def of(groups: Sequence[Kind], point_rank: Ints | None = None, network: Network | None = None) -> Arrangement:
        """Sort the groups that allow it by the rank of their points; without ranks all stay as they are.

        Given a network, image points of a few different optics are sorted by these first, so that the partials of each can be evaluated
        stretch by stretch.
        """
        chosen, orders = [], []
        group: Any
        for group in groups:
            order: Any = np.arange(len(group))
            if point_rank is not None and hasattr(group, "pieces"):
                order = _sorted(point_rank[group.points], len(point_rank))
                stretches = [] if network is None else group.by_optics(network)
                if 1 < len(stretches) <= MANY_OPTICS:
                    kind = np.empty(len(group), dtype=np.intp)
                    for i, (_, rows) in enumerate(stretches):
                        kind[rows] = i
                    order = order[np.argsort(kind[order], kind="stable")]
                group = _in_order(group, order)
            chosen.append(group)
            orders.append(order)
        return Arrangement(tuple(groups), tuple(chosen), tuple(orders), point_rank is not None)

    @cached_property
    def offsets(self) -> Ints:
        """First scalar row of each group, and n."""
        return offsets_of(self.groups)

    @cached_property
    def first(self) -> tuple[Ints | Small, ...]:
        """First scalar row of each row of the sorted groups."""
        ends = enumerate(self.orders)
        return tuple(small(self.offsets[g] + order * len(self.groups[g].components), self.offsets[-1]) for g, order in ends)


def _in_order(group: Any, order: Ints | Small) -> Any:
    """Return image points in another order, the numbers of their images and points in 32 bits."""
    numbers = {key: small(getattr(group, key), np.iinfo(np.int32).max) for key in ("images", "points")}
    return replace(group, **numbers).selected(order)


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
    kept = unknowns.kept
    misclosure = np.empty(int(arranged.offsets[-1]))
    fillings: list[_Filling | Chunk] = []
    large = evaluated_groups(arranged.sorted, network, unknowns) if arranged.ranked else set()
    group: Any
    for g, group in enumerate(arranged.sorted):
        first = arranged.first[g]
        if g in large:  # a chunk for each optics, however its partials are had
            for optics, rows in group.by_optics(network):
                chunk = _evaluated(group, optics, rows, first, misclosure, network, state, unknowns, kept, workers)
                pieces = [Piece(optics, rows[a : a + CHUNK]) for a in range(0, len(rows), CHUNK)]
                fillings.append(chunk or _planned(group, pieces, first, network, state, unknowns, kept))
        elif hasattr(group, "pieces"):
            by_width: dict[int, list[Any]] = {}
            for piece in group.pieces(network):
                by_width.setdefault(piece.width, []).append(piece)
            fillings += [_planned(group, pieces, first, network, state, unknowns, kept) for pieces in by_width.values()]
        else:
            for found in group.linearize(network, state):
                fillings.append(_Filling.of(found, [], first[found.index], unknowns, kept, group.name))
    values = np.empty(sum(f.size for f in fillings if isinstance(f, _Filling)))
    start = 0
    chunks = []
    for f in fillings:
        if isinstance(f, _Filling):
            f.fill(values, start, misclosure, workers)
            start += f.size
        chunks.append(f.chunk() if isinstance(f, _Filling) else f)
    return Linearization(unknowns, tuple(chunks), misclosure, values, workers)


def _sorted(keys: Ints, count: int) -> Ints | Small:
    """Return the stable order of keys below a number: counted, which is faster than sorted."""
    n = len(keys)
    ones = np.ones(n, dtype=np.int8)
    return np.asarray(sparse.csr_array((ones, (keys, np.arange(n))), shape=(count, n)).indices)


def evaluated_groups(groups: Sequence[Kind], network: Network, unknowns: Unknowns) -> set[int]:
    """Return the numbers of the groups whose partials, if they are sorted by points, are not stored but evaluated wherever they are needed.

    Parameters
    ----------
    groups : sequence of Kind
    network : Network
    unknowns : Unknowns
    """
    if len(unknowns.kept.get(("point", 3), ())) < 3:  # a coordinate that is fixed everywhere has no partials
        return set()
    every: list[Any] = list(groups)
    others = [g for g in every if not hasattr(g, "pieces") and getattr(g, "kind", "point") == "point"]
    if sum(len(g) * len(g.components) for g in others) > FEW_BESIDE:
        return set()
    return {i for i, g in enumerate(every) if hasattr(g, "pieces") and len(g) >= EVALUATED_FROM and _can_be_evaluated(g, network)}


def _can_be_evaluated(group: Any, network: Network) -> bool:
    stretches = group.by_optics(network)
    uncorrelated = not np.any(group.correlations if group.correlations.strides[0] else group.correlations[:1])
    return uncorrelated and len(stretches) <= MANY_OPTICS and all(group.can_be_evaluated(optics) for optics, _ in stretches)


def _evaluated(
    group: Any, optics: Any, rows: Ints, first: Any, misclosure: Floats, network: Network, state: State, unknowns: Unknowns, kept: Any,
    workers: int | None,
) -> Chunk | None:  # fmt: skip
    """Return a chunk whose partials are evaluated wherever they are needed, and store its misclosures (n,) in their rows.

    None where a distortion is not inverted by the loop.
    """
    some, evaluation = slice(int(rows[0]), int(rows[-1]) + 1), group.evaluation(optics, network, state)
    count = some.stop - some.start
    if evaluation is None or count != len(rows):
        return None
    width = {"camera": len(optics.model.order), "image": 6, "point": 3}
    positions = [kept.get(key, np.zeros(0, dtype=np.intp)) for key in width.items()]
    rays = Rays(evaluation, some.start, count, tuple(positions))
    pieces = [slice(a, min(a + PIECE, count)) for a in range(0, count, PIECE)]
    if not all(for_each(pieces, partial(rays.misclosures, first[some], misclosure), workers)):
        return None
    cameras = np.unique(network.images.cameras)
    camera = cameras[0] if len(cameras) == 1 else network.images.cameras[group.images[some]]
    nodes = (np.broadcast_to(np.asarray(camera, dtype=np.int32), (count,)), group.images[some], group.points[some])
    parts = tuple(
        Part(unknowns[kind], own, at, np.zeros((0, 2, len(at))), -1) for kind, own, at in zip(width, nodes, positions, strict=True)
    )
    factor = np.broadcast_to(_diagonal(np.asarray(group.sigmas[some])), (count, 2, 2))
    return Chunk(first[some], parts, factor, None, rays)


@dataclass(frozen=True)
class Rays:
    """Evaluates the whitened misclosures and partials of some of the `count` rows of image points from `begin`."""

    evaluation: Evaluation
    begin: int
    count: int
    positions: tuple[Ints, ...]

    def misclosures(self, first: Ints, out: Floats, rows: slice) -> bool:
        """Store the misclosures of rows at their places `first` in out (n,); return whether all distortions could be inverted."""
        values = np.empty((rows.stop - rows.start, 2))
        done = self.evaluation(slice(self.begin + rows.start, self.begin + rows.stop), self.positions, values)
        _put(out, first[rows], values)
        return done

    def __call__(self, rows: Any, values: Floats) -> None:
        """Write the partials of rows, a slice or indices, part after part."""
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(self.count)
            n, at = stop - start, slice(self.begin + start, self.begin + stop)
        else:
            n, at = len(rows), self.begin + rows
        if not self.evaluation(at, self.positions, scratch("misclosures", 2 * n).reshape(n, 2), split(values, n, 2, self.positions)):
            raise UsageError(f"{self.evaluation.group.name}: a distortion cannot be inverted")


def _put(out: Floats, first: Ints | Small, values: Floats) -> None:
    """Store the (N, m) values of row blocks in their scalar rows."""
    for r, own in enumerate(values.T):
        out[first + r] = own


def _planned(group: Any, pieces: list[Any], first: Any, network: Network, state: State, unknowns: Unknowns, kept: Any) -> _Filling:
    """Linearise the first of some pieces, and plan a chunk of them all."""
    evaluate, fill = (partial(f, network, state) for f in (group.linearize_piece, group.fill))
    try:
        rows = evaluate(pieces[0])
    except Exception as error:
        error.add_note(f"{group.name}: {group.images_of(network, pieces[0])}")
        raise
    later = [_Later(len(p.rows), group.images_of(network, p), partial(evaluate, p), partial(fill, p)) for p in pieces[1:]]
    return _Filling.of(rows, later, np.concatenate([first[p.rows] for p in pieces]), unknowns, kept, group.name)


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
    """A chunk of row blocks of m rows that is filled piece by piece."""

    name: str
    first: Any
    m: int
    rows: list[Rows]
    later: list[_Later]
    groups: list[tuple[UnknownGroup, Ints]]
    parts: list[Part]
    factors: dict[int, Floats]
    controlled: dict[int, Floats]

    @staticmethod
    def of(rows: Rows, later: list[Any], first: Any, unknowns: Unknowns, kept: Any, name: str) -> _Filling:
        """Plan a chunk from its first piece, and what computes the others."""
        nothing = np.zeros(0, dtype=np.intp)
        groups = [(unknowns[b.kind], kept.get((b.kind, b.jacobian.shape[2]), nothing)) for b in rows.blocks]
        return _Filling(name, first, rows.misclosure.shape[1], [rows], later, groups, [], {}, {})

    @property
    def size(self) -> int:
        """How many partials there are."""
        return int(len(self.first) * self.m * sum(len(at) for _, at in self.groups))

    def fill(self, values: Floats, start: int, misclosure: Floats, workers: int | None) -> None:
        """Compute and store everything: the partials in `values` from `start`, the misclosures (n,) in their rows."""
        n, m = len(self.first), self.m
        for group, at in self.groups:
            size = n * m * len(at)
            self.parts.append(Part(group, np.empty(n, dtype=np.int32), at, values[start : start + size].reshape(n, m, len(at)), start))
            start += size
        rows = self.rows.pop()
        self._put(0, rows, misclosure)
        starts = np.cumsum([len(rows.index), *(piece.count for piece in self.later)])
        for_each(range(len(self.later)), lambda i: self._add(int(starts[i]), self.later[i], misclosure), workers)

    def _add(self, start: int, piece: _Later, misclosure: Floats) -> None:
        """Let a piece write its rows where they belong, or store what it computes."""
        try:
            self._take(start, piece, misclosure)
        except Exception as error:
            error.add_note(f"{self.name}: {piece.name}")
            raise

    def _take(self, start: int, piece: _Later, misclosure: Floats) -> None:
        some = slice(start, start + piece.count)
        parts = [(p.positions, p.nodes[some], p.jacobian[some]) for p in self.parts]
        values = np.empty((piece.count, self.m))
        sigma = piece.fill(values, parts)
        if sigma is None:
            self._put(start, piece.compute(), misclosure)
        else:
            _put(misclosure, self.first[some], values)
            self.factors[start] = _diagonal(sigma)

    def _put(self, start: int, rows: Rows, misclosure: Floats) -> None:
        """Whiten and store the row blocks of a piece."""
        some = slice(start, start + len(rows.index))
        factor, whiten = _factor(rows.cofactor, self.name)
        _put(misclosure, self.first[some], _apply(whiten, rows.misclosure[:, :, None])[:, :, 0])
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
        n, m = len(self.first), self.m
        starts = [*sorted(self.factors), n]
        factors = [self.factors[k] for k in starts[:-1]]
        if all(len(f) == 1 and np.array_equal(f, factors[0]) for f in factors):
            factor = np.broadcast_to(factors[0], (n, m, m))
        else:
            factor = np.concatenate([np.broadcast_to(f, (b - a, m, m)) for f, a, b in zip(factors, starts[:-1], starts[1:], strict=True)])
        controlled = np.concatenate([self.controlled[k] for k in starts[:-1]]) if self.controlled else None
        return Chunk(self.first, tuple(self.parts), factor, controlled)


def whitened_misclosures(network: Network, state: State, groups: Sequence[Kind] | Arrangement, workers: int | None = None) -> Floats:
    """Return the whitened misclosures (n,) without partials; not finite where an observation cannot be computed."""
    arranged = groups if isinstance(groups, Arrangement) else Arrangement.of(groups)
    out = np.empty(int(arranged.offsets[-1]))
    for group, first in zip(arranged.sorted, arranged.first, strict=True):
        if hasattr(group, "pieces"):

            def work(piece: Any, group: Any = group, first: Any = first) -> None:
                try:
                    white = _white(group.misclosures_of_piece(network, state, piece), group, piece.rows)
                except Exception as error:
                    error.add_note(f"{group.name}: {group.images_of(network, piece)}")
                    raise
                _put(out, first[piece.rows], white)

            for_each(group.pieces(network), work, workers)
        else:
            _put(out, first, _white(group.misclosures(network, state), group, slice(None)))
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
    same = len(sigma) > 0 and (sigma.strides[0] == 0 or bool(np.all(sigma == sigma[0])))
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
