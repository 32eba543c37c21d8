"""All observations at one state, whitened: computed once, handed down to solvers, datum and statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from baarda.errors import InputError, UsageError
from baarda.network import Network, State, Unknowns
from baarda.observations import Kind

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Part:
    """The columns of one unknown group in a chunk: nodes (N,), columns (N, w) with -1 = fixed, whitened partials (N, m, w)."""

    kind: str
    nodes: Ints
    columns: Ints
    jacobian: Floats


@dataclass(frozen=True)
class Chunk:
    """Whitened row blocks: first scalar row (N,), misclosures (N, m), parts, and the factors L (N, m, m) of the cofactors Q = L L'."""

    first: Ints
    misclosure: Floats
    parts: tuple[Part, ...]
    factor: Floats

    @property
    def rows(self) -> Ints:
        """The (N, m) scalar rows."""
        return np.asarray(self.first[:, None] + np.arange(self.misclosure.shape[1]))


@dataclass(frozen=True)
class Linearization:
    """The whitened linear system l + v = A x at one state.

    Attributes
    ----------
    unknowns : Unknowns
    chunks : tuple of Chunk
    count : int
        Number n of scalar observations.
    """

    unknowns: Unknowns
    chunks: tuple[Chunk, ...]
    count: int

    @cached_property
    def misclosure(self) -> Floats:
        """The whitened misclosures, (n,)."""
        out = np.empty(self.count)
        for c in self.chunks:
            out[c.rows] = c.misclosure
        return out

    @cached_property
    def design(self) -> Any:
        """The whitened design matrix, (n, u), sparse by rows."""
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

    @cached_property
    def scale(self) -> Floats:
        """The Euclidean norms of the columns of the design matrix, (u,); 1 where a column is zero."""
        a = self.design
        norms = np.sqrt(np.bincount(a.indices, weights=a.data**2, minlength=self.unknowns.count))
        return np.where(norms > 0.0, norms, 1.0)


def offsets_of(groups: Sequence[Kind]) -> Ints:
    """Return the first scalar row of each group, and the total at the end."""
    return np.concatenate([[0], np.cumsum([len(g) * len(g.components) for g in groups])]).astype(np.intp)


def linearize(network: Network, state: State, unknowns: Unknowns, groups: Sequence[Kind]) -> Linearization:
    """Linearise and whiten all observation groups.

    Parameters
    ----------
    network : Network
        Constants of the cameras and labels.
    state : State
        Where to linearise.
    unknowns : Unknowns
    groups : sequence of Kind

    Raises
    ------
    InputError
        If a cofactor matrix is not positive definite.
    """
    offsets = offsets_of(groups)
    chunks = []
    for g, group in enumerate(groups):
        for rows in group.linearize(network, state):
            factor, whiten = _factor(rows.cofactor, group.name)
            parts = []
            for b in rows.blocks:
                columns = unknowns[b.kind].of(b.nodes, b.jacobian.shape[2])
                parts.append(Part(b.kind, b.nodes, columns, np.ascontiguousarray(_apply(whiten, b.jacobian))))
            first = offsets[g] + rows.index * len(group.components)
            chunks.append(Chunk(first, _apply(whiten, rows.misclosure[:, :, None])[:, :, 0], tuple(parts), factor))
    return Linearization(unknowns, tuple(chunks), int(offsets[-1]))


def whitened_misclosures(network: Network, state: State, groups: Sequence[Kind]) -> Floats:
    """Return the whitened misclosures (n,) without partials; not finite where an observation cannot be computed."""
    out = []
    for group in groups:
        misclosure = group.misclosures(network, state)
        sigma = group.sigma()
        correlation = getattr(group, "correlations", None)
        if correlation is not None and np.any(correlation):
            x = misclosure[:, 0] / sigma[:, 0]
            y = (misclosure[:, 1] / sigma[:, 1] - correlation * x) / np.sqrt(1.0 - correlation**2)
            misclosure = np.stack([x, y], axis=1)
        elif hasattr(group, "covariances"):
            misclosure = np.asarray(np.linalg.solve(np.linalg.cholesky(group.covariances), misclosure[:, :, None])[:, :, 0], dtype=float)
        else:
            misclosure = misclosure / sigma
        out.append(misclosure.ravel())
    return np.concatenate(out) if out else np.zeros(0)


def _factor(cofactor: Floats, name: str) -> tuple[Floats, Floats]:
    """Return L with Q = L L' and its inverse."""
    if cofactor.shape[1] == 1:
        sigma = np.sqrt(cofactor)
        return sigma, 1.0 / sigma
    try:
        factor = np.linalg.cholesky(cofactor)
    except np.linalg.LinAlgError:
        raise InputError(f"{name}: a cofactor matrix is not positive definite (correlation beyond 1, or a sigma of zero)") from None
    return np.asarray(factor, dtype=float), np.linalg.inv(factor)


def _apply(matrix: Floats, array: Floats) -> Floats:
    return matrix * array if matrix.shape[1] == 1 else matrix @ array


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
