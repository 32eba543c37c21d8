"""The block solver: object points are eliminated one by one, the rest is factored as one reduced system.

For each point the whitened partials G_p (rows x 3) are factored orthogonally, G_p = Q1 R1, so that nearly parallel rays lose no
digits; with Y = Q1' G_r the reduced matrix is S = G_r' G_r - Y'Y. Points are treated in batches of equal numbers of row blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from baarda.adjustment.dense import factorise
from baarda.adjustment.linearize import Linearization
from baarda.errors import Singular

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

BATCH = 4_000_000  # doubles in the largest temporary of a batch


@dataclass(frozen=True)
class Batch:
    """Points with the same number k of row blocks, of m rows and w reduced columns each.

    Attributes
    ----------
    blocks : (P, k) int array
        Row blocks of each point.
    columns : (P, 3) int array
        Unknowns of each point.
    reduced : (P, k w) int array
        Reduced columns; the last index is a dummy.
    gr : (P, k, m, w), q1 : (P, k, m, 3), r1 : (P, 3, 3), y : (P, 3, k w) arrays
    """

    blocks: Ints
    columns: Ints
    reduced: Ints
    gr: Floats
    q1: Floats
    r1: Floats
    y: Floats


@dataclass(frozen=True)
class BlockSolver:
    """Factored normal equations with eliminated points; see `baarda.adjustment.kernels.Solver` for the contract."""

    lin: Linearization
    kept: Ints
    place: Ints
    batches: tuple[Batch, ...]
    rest: tuple[tuple[Ints, Ints, Floats], ...]
    ident: tuple[Ints, Ints]
    factor: Floats
    scale: Floats
    rcond: float

    @staticmethod
    def of(lin: Linearization, held: Ints, damping: float = 0.0) -> BlockSolver:
        """Eliminate the points and factor the reduced system; held unknowns stay out.

        Raises
        ------
        Singular
            If a point or a combination of unknowns is not determined.
        """
        u = lin.unknowns.count
        eliminated = eliminated_points(lin, held)
        point_columns = lin.unknowns["point"].columns.reshape(-1, 3)
        inner = np.zeros(u + 1, dtype=bool)
        inner[point_columns[eliminated].ravel()] = True
        inner[held], inner[u] = True, True
        kept = np.flatnonzero(~inner[:u])
        place = np.full(u + 1, len(kept))  # the last one also serves column -1
        place[kept] = np.arange(len(kept))

        size = len(kept)
        s = np.zeros((size + 1) * (size + 1))
        node, first, reduced, gr, gp, rest = _row_blocks(lin, eliminated, place)
        for at, _, jacobian in rest:
            _scatter(s, size, at, np.einsum("nmi,nmj->nij", jacobian, jacobian))
        _scatter(s, size, reduced, np.einsum("nmi,nmj->nij", gr, gr))
        batches = []
        order = np.argsort(node, kind="stable")
        nodes, starts, counts = np.unique(node[order], return_index=True, return_counts=True)
        w = gr.shape[2]
        for k in np.unique(counts):
            members = np.flatnonzero(counts == k)
            step = max(1, BATCH // int(max(k * w, 3) ** 2))
            for a in range(0, len(members), step):
                some = members[a : a + step]
                blocks = order[starts[some][:, None] + np.arange(k)]
                batch = _eliminate(blocks, point_columns[nodes[some]], reduced, gr, gp, damping, lin)
                _scatter(s, size, batch.reduced, -(batch.y.transpose(0, 2, 1) @ batch.y))
                batches.append(batch)
        scale = lin.scale[kept]
        matrix = s.reshape(size + 1, size + 1)[:size, :size] / np.outer(scale, scale)
        matrix = 0.5 * (matrix + matrix.T) + damping * np.eye(size)
        factor, rcond = factorise(matrix, [kept], lin)
        return BlockSolver(lin, kept, place, tuple(batches), rest, first, factor, scale, rcond)

    def solve(self, rhs: Floats) -> Floats:
        """Return N^-1 rhs for (u,) or (u, k) right-hand sides; held unknowns stay zero."""
        columns = rhs.reshape(len(rhs), -1)
        out = np.zeros_like(columns)
        halves = [np.linalg.solve(b.r1.transpose(0, 2, 1), columns[b.columns]) for b in self.batches]
        z = np.concatenate([h.reshape(-1, columns.shape[1]) for h in halves]) if halves else np.zeros((0, columns.shape[1]))
        reduced = columns[self.kept] - self.coupling.T @ z
        x = np.zeros_like(reduced)
        if len(self.kept):
            x = linalg.cho_solve((self.factor, True), reduced / self.scale[:, None]) / self.scale[:, None]
        out[self.kept] = x
        z -= self.coupling @ x
        a = 0
        for batch in self.batches:
            n = len(batch.columns)
            out[batch.columns] = np.linalg.solve(batch.r1, z[a : a + 3 * n].reshape(n, 3, -1))
            a += 3 * n
        return out.reshape(rhs.shape)

    @cached_property
    def coupling(self) -> Any:
        """Y of all points, (3 points, reduced unknowns), sparse by rows."""
        size = len(self.kept)
        values, columns, counts = [np.zeros(0)], [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
        for b in self.batches:
            values.append(b.y.ravel())
            columns.append(np.broadcast_to(b.reduced[:, None, :], b.y.shape).ravel())
            counts.append(np.full(3 * len(b.y), b.y.shape[2]))
        starts = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        matrix = sparse.csr_array((np.concatenate(values), np.concatenate(columns), starts), shape=(len(starts) - 1, size + 1))
        return matrix[:, :size]  # without the dummy column

    @cached_property
    def _inverse(self) -> Floats:
        n = len(self.kept)
        out = np.zeros((n + 1, n + 1))
        if n:
            half = np.tril(linalg.lapack.dtrtri(self.factor, lower=1)[0])
            out[:n, :n] = (half.T @ half) / np.outer(self.scale, self.scale)
        return out

    def hat(self) -> list[Floats]:
        """Return for each chunk the (N, m, m) diagonal blocks of A N^-1 A'."""
        z = self._inverse
        out = [np.zeros((len(c.first), c.misclosure.shape[1], c.misclosure.shape[1])) for c in self.lin.chunks]
        for at, where, jacobian in self.rest:
            h = jacobian @ z[at[:, :, None], at[:, None, :]] @ jacobian.transpose(0, 2, 1)
            _store(out, where, h)
        chunk, row = self.ident
        for b in self.batches:
            p, k, m, w = b.gr.shape
            local = z[b.reduced[:, :, None], b.reduced[:, None, :]]  # (P, kw, kw)
            yz = b.y @ local
            core = np.eye(3) + yz @ b.y.transpose(0, 2, 1)
            own = np.arange(k)
            diagonal = local.reshape(p, k, w, k, w)[:, own, :, own, :].transpose(1, 0, 2, 3)  # (P, k, w, w)
            mixed = b.q1 @ yz.reshape(p, 3, k, w).transpose(0, 2, 1, 3) @ b.gr.transpose(0, 1, 3, 2)
            h = b.q1 @ core[:, None] @ b.q1.transpose(0, 1, 3, 2) - mixed - mixed.transpose(0, 1, 3, 2)
            h += b.gr @ diagonal @ b.gr.transpose(0, 1, 3, 2)
            blocks = b.blocks.ravel()
            _store(out, np.stack([chunk[blocks], row[blocks]], axis=1), h.reshape(p * k, m, m))
        return out

    def blocks(self, columns: Ints) -> Floats:
        """Return the (N, w, w) blocks of N^-1 for (N, w) columns: nodes of the reduced system, or whole points."""
        z = self._inverse
        at = self.place[columns]
        out = np.asarray(z[at[:, :, None], at[:, None, :]])
        if columns.shape[1] == 3 and len(columns):
            position = np.full(self.lin.unknowns.count + 1, -1)
            position[columns[:, 0]] = np.arange(len(columns))
            position[-1] = -1
            for b in self.batches:
                where = position[b.columns[:, 0]]
                some = np.flatnonzero(where >= 0)
                if not len(some):
                    continue
                local = z[b.reduced[some][:, :, None], b.reduced[some][:, None, :]]
                core = np.eye(3) + b.y[some] @ local @ b.y[some].transpose(0, 2, 1)
                inverse = np.linalg.inv(b.r1[some])
                out[where[some]] = inverse @ core @ inverse.transpose(0, 2, 1)
        return out


def eliminated_points(lin: Linearization, held: Ints) -> NDArray[np.bool_]:
    """Return which points can be eliminated: three free coordinates, none held, and no observation to another point."""
    columns = lin.unknowns["point"].columns.reshape(-1, 3)
    out: NDArray[np.bool_] = np.asarray((columns >= 0).all(axis=1) & ~np.isin(columns, held).any(axis=1))
    for c in lin.chunks:
        ends = [p for p in c.parts if p.kind == "point"]
        if len(ends) > 1:
            for p in ends:
                out[p.nodes] = False
    seen = np.zeros(len(out), dtype=bool)
    for c in lin.chunks:
        for p in c.parts:
            if p.kind == "point":
                seen[p.nodes] = True
    return np.asarray(out & seen)


def _row_blocks(
    lin: Linearization, eliminated: NDArray[np.bool_], place: Ints
) -> tuple[Ints, tuple[Ints, Ints], Ints, Floats, Floats, tuple[tuple[Ints, Ints, Floats], ...]]:
    """Sort the row blocks: those of eliminated points, padded to common m and w, and the rest."""
    pieces, rest = [], []
    for i, c in enumerate(lin.chunks):
        n = len(c.first)
        at = np.concatenate([place[p.columns] for p in c.parts], axis=1)
        jacobian = np.concatenate([p.jacobian for p in c.parts], axis=2)
        point = next((p for p in c.parts if p.kind == "point"), None)
        touched = eliminated[point.nodes] if point is not None else np.zeros(n, dtype=bool)
        ident = np.stack([np.full(n, i), np.arange(n)], axis=1)
        if (~touched).any():
            rest.append((at[~touched], ident[~touched], jacobian[~touched]))
        if point is not None and touched.any():
            used = (at[touched] < len(place) - 1) & (at[touched] != place[-1])
            columns = np.flatnonzero(used.any(axis=0))  # leaves out the point's own and fixed columns
            pieces.append(
                (point.nodes[touched], ident[touched], at[touched][:, columns], jacobian[touched][:, :, columns], point.jacobian[touched])
            )
    m = max((p[3].shape[1] for p in pieces), default=1)
    w = max((p[3].shape[2] for p in pieces), default=0)
    total = sum(len(p[0]) for p in pieces)
    node, ident = np.empty(total, dtype=np.intp), np.empty((total, 2), dtype=np.intp)
    reduced, gr, gp = np.full((total, w), place[-1]), np.zeros((total, m, w)), np.zeros((total, m, 3))
    a = 0
    for nodes, idents, at, jr, jp in pieces:
        b = a + len(nodes)
        node[a:b], ident[a:b], reduced[a:b, : at.shape[1]] = nodes, idents, at
        gr[a:b, : jr.shape[1], : jr.shape[2]], gp[a:b, : jp.shape[1]] = jr, jp
        a = b
    return node, (ident[:, 0], ident[:, 1]), reduced, gr, gp, tuple(rest)


def _eliminate(blocks: Ints, columns: Ints, reduced: Ints, gr: Floats, gp: Floats, damping: float, lin: Linearization) -> Batch:
    p, k = blocks.shape
    m, w = gr.shape[1:]
    own = gp[blocks].reshape(p, k * m, 3)
    if damping:
        extra = np.sqrt(damping) * lin.scale[columns][:, :, None] * np.eye(3)
        q1, r1, bad = _orthogonal(np.concatenate([own, extra], axis=1))
        q1 = q1[:, : k * m]
    else:
        q1, r1, bad = _orthogonal(own)
    if bad.any():
        names = [lin.unknowns.names[c] for c in columns[bad].ravel()]
        count = int(bad.sum())
        raise Singular(f"the rays do not determine {count} object point(s): {', '.join(names[:12])}", names)
    q1 = np.ascontiguousarray(q1.reshape(p, k, m, 3))
    rows = gr[blocks]
    y = np.einsum("pkma,pkmw->pakw", q1, rows).reshape(p, 3, k * w)
    return Batch(blocks, columns, reduced[blocks].reshape(p, k * w), rows, q1, r1, np.ascontiguousarray(y))


def _orthogonal(a: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Factor (P, R, 3) arrays as Q R by modified Gram-Schmidt, done twice; also flag rank-deficient ones."""
    q, r = a.copy(), np.broadcast_to(np.eye(3), (len(a), 3, 3)).copy()
    norms = np.linalg.norm(a, axis=1)
    bad = np.zeros(len(a), dtype=bool)
    for sweep in range(2):
        step = np.zeros((len(a), 3, 3))
        for j in range(3):
            for i in range(j):
                step[:, i, j] = np.einsum("pr,pr->p", q[:, :, i], q[:, :, j])
                q[:, :, j] -= step[:, i, j, None] * q[:, :, i]
            length = np.linalg.norm(q[:, :, j], axis=1)
            bad |= ~(length > 1e-12 * (norms[:, j] if sweep == 0 else 1.0))
            step[:, j, j] = np.where(bad, 1.0, length)
            q[:, :, j] /= step[:, j, j, None]
        r = step @ r
    return q, r, bad


def _scatter(s: Floats, size: int, at: Ints, values: Floats) -> None:
    """Add (N, w, w) blocks into the flat square matrix of `size` + 1."""
    flat = at[:, :, None] * (size + 1) + at[:, None, :]
    np.add.at(s, flat.ravel(), np.ascontiguousarray(values).ravel())


def _store(out: list[Floats], ident: Ints, values: Floats) -> None:
    for i in np.unique(ident[:, 0]):
        rows = ident[:, 0] == i
        m = out[i].shape[1]
        out[i][ident[rows, 1]] = values[rows, :m, :m]
