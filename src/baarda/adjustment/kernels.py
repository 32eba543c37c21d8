"""The loops over object points: compiled for large blocks, and their NumPy twins for small ones or without numba.

The loops know no camera. `accumulate` eliminates the points of clusters and adds their part to a front of the reduced system;
`statistics` goes the way back, from the inverse of a front to the cofactors of the points and the diagonal of A N^-1 A'.

For each point the whitened partials G (rows x 3, columns scaled) are factored orthogonally, G = Q R, so that nearly parallel rays lose
no digits; with Y = Q' H of the other partials H the reduced matrix is H'H - Y'Y. numba is imported on first use and only here.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.structure import Structure

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Small = NDArray[np.int32]

COMPILE_FROM = 60_000  # row blocks from which the loops are compiled
SMALLEST = 1e-12  # a column of G that others explain to this share is not determined


class Blocks(NamedTuple):
    """The row blocks of the inner points as plain arrays.

    Attributes
    ----------
    values : array
        The partials of all chunks.
    table : (chunks, 4 + 3 parts) int array
        For each chunk the rows m of a block, the number of parts, where the partials of the point and the places of the blocks begin, and
        for each part where its partials begin, its width, and whether it is a node.
    starts : int32 array
        Where the columns of each part of each block begin in its cluster.
    first_block, chunk, row, first_point, first_column, cluster_rows, sparse
        Of the structure.
    inverse : array
        Inverse column scales of the columns of all clusters; 0 = held.
    point_inverse : (P, 3) array
    prior : (P, 3) array
        A further row for each coordinate of a point: damping, or 1 where the coordinate is held.
    hat : array
        Where the diagonal blocks of A N^-1 A' of each chunk begin.
    """

    values: Floats
    table: Ints
    starts: Small
    first_block: Ints
    chunk: Small
    row: Small
    first_point: Ints
    first_column: Ints
    cluster_rows: Small
    sparse: NDArray[np.bool_]
    inverse: Floats
    point_inverse: Floats
    prior: Floats
    hat: Ints


def blocks_of(lin: Linearization, structure: Structure, inverse: Floats, damping: float) -> Blocks:
    """Gather the arrays of a linear system for the loops.

    Parameters
    ----------
    lin : Linearization
    structure : Structure
    inverse : (u + 1,) array
        Inverse column scales; 0 for held unknowns, and last for fixed parameters.
    damping : float
        Added to the diagonal of the scaled normal matrix.
    """
    parts = max((len(c.parts) for c in lin.chunks), default=0)
    table = np.zeros((len(lin.chunks), 4 + 3 * parts), dtype=np.intp)
    at, hats, starts = 0, [0], []
    for k, (c, own, places) in enumerate(zip(lin.chunks, structure.point_part, structure.starts, strict=True)):
        m = c.misclosure.shape[1]
        table[k, :4] = m, len(c.parts), c.parts[own].start if own >= 0 else -1, at
        for j, p in enumerate(c.parts):
            table[k, 4 + 3 * j : 7 + 3 * j] = p.start, len(p.positions), j != own
        at += places.size
        starts.append(places.ravel())
        hats.append(hats[-1] + len(c.first) * m * m)
    point_inverse = inverse[structure.point_columns]
    prior = np.where(point_inverse > 0.0, np.sqrt(damping), 1.0)
    columns = structure.order[structure.cluster_columns]
    return Blocks(
        lin.values, table, np.concatenate([np.zeros(0, dtype=np.int32), *starts]), structure.first_block, structure.block_chunk,
        structure.block_row, structure.first_point, structure.first_column, structure.cluster_rows, structure.sparse, inverse[columns],
        point_inverse, prior, np.array(hats, dtype=np.intp),
    )  # fmt: skip


def _factor_point(p: int, b: Blocks, q: Floats, r: Floats) -> int:
    """Fill q with the orthogonal factor of a point's rows and r (3, 3) with the triangular one; return the rows, negative if singular."""
    n = 0
    for i in range(b.first_block[p], b.first_block[p + 1]):
        t = b.table[b.chunk[i]]
        base = t[2] + b.row[i] * t[0] * 3
        for _ in range(t[0]):
            for a in range(3):
                q[n, a] = b.values[base + a] * b.point_inverse[p, a]
            base += 3
            n += 1
    for a in range(3):
        if b.prior[p, a] > 0.0:
            for c in range(3):
                q[n, c] = 0.0
            q[n, a] = b.prior[p, a]
            n += 1
    singular = False
    for sweep in range(2):  # modified Gram-Schmidt, twice; the second factor stands behind the rows until R = S R
        s = r if sweep == 0 else q[n : n + 3]
        s[:, :] = 0.0
        for j in range(3):
            before = 0.0
            for k in range(n):
                before += q[k, j] * q[k, j]
            for i in range(j):
                dot = 0.0
                for k in range(n):
                    dot += q[k, i] * q[k, j]
                for k in range(n):
                    q[k, j] -= dot * q[k, i]
                s[i, j] = dot
            length = 0.0
            for k in range(n):
                length += q[k, j] * q[k, j]
            length = np.sqrt(length)
            if not length > SMALLEST * np.sqrt(before):
                singular = True
                length = 1.0
            for k in range(n):
                q[k, j] /= length
            s[j, j] = length
    for j in range(3):
        for i in range(j + 1):
            total = 0.0
            for k in range(i, j + 1):
                total += q[n + i, k] * r[k, j]
            r[i, j] = total
    return -n if singular else n


def _accumulate(clusters: Ints, front: Floats, b: Blocks, r: Floats, bad: NDArray[np.bool_], size: Ints) -> None:
    """Add H'H - Y'Y of clusters to the lower triangle of a front; store the triangular factors (P, 3, 3) of their points."""
    q = np.empty((size[0], 3))
    buffer = np.empty(size[1])
    square = np.empty(size[2])
    stack = np.empty(size[3], np.int64)
    line = np.empty((size[4], size[5], size[6]))
    for c in clusters:
        first, last = b.first_point[c], b.first_point[c + 1]
        offset = b.first_column[c]
        width = b.first_column[c + 1] - offset
        if width == 0:
            for p in range(first, last):
                bad[p] = _factor_point(p, b, q, r[p]) < 0
            continue
        sparse = b.sparse[c]
        inverse = b.inverse[offset : offset + width]
        rows = b.cluster_rows[offset : offset + width]
        height = 3 if sparse else 3 * (last - first)
        y = buffer[: height * width].reshape((height, width))
        y[:] = 0.0
        own = square[: width * width].reshape((width, width))
        own[:] = 0.0
        for p in range(first, last):
            bad[p] = _factor_point(p, b, q, r[p]) < 0
            k = 0 if sparse else 3 * (p - first)
            n = 0
            touched = 0
            for i in range(b.first_block[p], b.first_block[p + 1]):
                t = b.table[b.chunk[i]]
                m, parts = t[0], t[1]
                place = t[3] + b.row[i] * parts
                for j in range(parts):
                    s = b.starts[place + j]
                    if t[6 + 3 * j] == 0 or s < 0:
                        continue
                    w = t[5 + 3 * j]
                    base = t[4 + 3 * j] + b.row[i] * m * w
                    if sparse:
                        known = False
                        for x in range(0, touched, 2):
                            known = known or stack[x] == s
                        if not known:
                            stack[touched], stack[touched + 1] = s, w
                            touched += 2
                    for e in range(m):
                        for x in range(w):
                            line[j, e, x] = b.values[base + e * w + x] * inverse[s + x]
                        for a in range(3):
                            for x in range(w):
                                y[k + a, s + x] += q[n + e, a] * line[j, e, x]
                for j in range(parts):
                    s, w = b.starts[place + j], t[5 + 3 * j]
                    if t[6 + 3 * j] == 0 or s < 0:
                        continue
                    for j2 in range(parts):
                        s2, w2 = b.starts[place + j2], t[5 + 3 * j2]
                        if t[6 + 3 * j2] == 0 or s2 < 0 or s2 > s:
                            continue
                        for x in range(w):
                            for e in range(m):
                                for x2 in range(w2):
                                    own[s + x, s2 + x2] += line[j, e, x] * line[j2, e, x2]
                n += m
            if sparse:
                for g in range(0, touched, 2):
                    for g2 in range(0, touched, 2):
                        if stack[g2] <= stack[g]:
                            for x in range(stack[g], stack[g] + stack[g + 1]):
                                for x2 in range(stack[g2], stack[g2] + stack[g2 + 1]):
                                    own[x, x2] -= y[0, x] * y[0, x2] + y[1, x] * y[1, x2] + y[2, x] * y[2, x2]
                for g in range(0, touched, 2):
                    y[:, stack[g] : stack[g] + stack[g + 1]] = 0.0
        if not sparse:
            own -= np.dot(y.T, y)
        for x in range(width):
            for x2 in range(x + 1):
                front[rows[x], rows[x2]] += own[x, x2]


def _statistics(clusters: Ints, z: Floats, b: Blocks, hat: Floats, points: Floats, size: Ints) -> None:
    """Store the diagonal blocks of A N^-1 A' and the cofactors (P, 3, 3) of points, from the inverse z of the front of their clusters."""
    q = np.empty((size[0], 3))
    r = np.empty((3, 3))
    inner = np.empty((3, 3))
    core = np.empty((3, 3))
    buffer = np.empty(size[1])
    product = np.empty(size[1])
    square = np.empty(size[2])
    stack = np.empty(size[3], np.int64)
    mixed = np.empty((3, size[0]))
    line = np.empty((size[4], size[5], size[6]))
    for c in clusters:
        first, last = b.first_point[c], b.first_point[c + 1]
        offset = b.first_column[c]
        width = b.first_column[c + 1] - offset
        sparse = b.sparse[c]
        inverse = b.inverse[offset : offset + width]
        rows = b.cluster_rows[offset : offset + width]
        local = square[: width * width].reshape((width, width))
        for x in range(width):
            for x2 in range(width):
                local[x, x2] = z[rows[x], rows[x2]]
        height = 3 if sparse else 3 * (last - first)
        y = buffer[: height * width].reshape((height, width))
        t_all = product[: height * width].reshape((height, width))
        y[:] = 0.0
        for step in range(2):
            if step == 1 and not sparse and width > 0:
                np.dot(y, local, t_all)
            if step == 0 and sparse:
                continue
            for p in range(first, last):
                _factor_point(p, b, q, r)
                k = 0 if sparse else 3 * (p - first)
                touched = 0
                if step == 0 or sparse:
                    n = 0
                    for i in range(b.first_block[p], b.first_block[p + 1]):
                        t = b.table[b.chunk[i]]
                        m, parts = t[0], t[1]
                        place = t[3] + b.row[i] * parts
                        for j in range(parts):
                            s = b.starts[place + j]
                            if t[6 + 3 * j] == 0 or s < 0:
                                continue
                            w = t[5 + 3 * j]
                            base = t[4 + 3 * j] + b.row[i] * m * w
                            if sparse:
                                known = False
                                for x in range(0, touched, 2):
                                    known = known or stack[x] == s
                                if not known:
                                    stack[touched], stack[touched + 1] = s, w
                                    touched += 2
                            for e in range(m):
                                for x in range(w):
                                    h = b.values[base + e * w + x] * inverse[s + x]
                                    for a in range(3):
                                        y[k + a, s + x] += q[n + e, a] * h
                        n += m
                if step == 0:
                    continue
                if sparse:
                    for g in range(0, touched, 2):
                        for x in range(stack[g], stack[g] + stack[g + 1]):
                            for a in range(3):
                                t_all[a, x] = 0.0
                            for g2 in range(0, touched, 2):
                                for x2 in range(stack[g2], stack[g2] + stack[g2 + 1]):
                                    for a in range(3):
                                        t_all[a, x] += y[a, x2] * local[x2, x]
                for a in range(3):
                    for a2 in range(3):
                        total = 1.0 if a == a2 else 0.0
                        if sparse:
                            for g in range(0, touched, 2):
                                for x in range(stack[g], stack[g] + stack[g + 1]):
                                    total += t_all[a, x] * y[a2, x]
                        else:
                            for x in range(width):
                                total += t_all[k + a, x] * y[k + a2, x]
                        core[a, a2] = total
                # inner = R^-1
                for a in range(3):
                    for a2 in range(3):
                        inner[a, a2] = 0.0
                for a2 in range(3):
                    inner[a2, a2] = 1.0 / r[a2, a2]
                    for a in range(a2 - 1, -1, -1):
                        total = 0.0
                        for x in range(a + 1, a2 + 1):
                            total += r[a, x] * inner[x, a2]
                        inner[a, a2] = -total / r[a, a]
                for a in range(3):
                    for a2 in range(3):
                        total = 0.0
                        for x in range(3):
                            for x2 in range(3):
                                total += inner[a, x] * core[x, x2] * inner[a2, x2]
                        points[p, a, a2] = total * b.point_inverse[p, a] * b.point_inverse[p, a2]
                n = 0
                for i in range(b.first_block[p], b.first_block[p + 1]):
                    t = b.table[b.chunk[i]]
                    m, parts = t[0], t[1]
                    place = t[3] + b.row[i] * parts
                    out = b.hat[b.chunk[i]] + b.row[i] * m * m
                    for a in range(3):
                        for e in range(m):
                            mixed[a, e] = 0.0
                    for e in range(m * m):
                        hat[out + e] = 0.0
                    for j in range(parts):
                        s = b.starts[place + j]
                        if t[6 + 3 * j] == 0 or s < 0:
                            continue
                        w = t[5 + 3 * j]
                        base = t[4 + 3 * j] + b.row[i] * m * w
                        for e in range(m):
                            for x in range(w):
                                line[j, e, x] = b.values[base + e * w + x] * inverse[s + x]
                            for a in range(3):
                                total = 0.0
                                for x in range(w):
                                    total += t_all[k + a, s + x] * line[j, e, x]
                                mixed[a, e] += total
                    for j in range(parts):
                        s, w = b.starts[place + j], t[5 + 3 * j]
                        if t[6 + 3 * j] == 0 or s < 0:
                            continue
                        for x in range(w):
                            for e2 in range(m):
                                total = 0.0
                                for j2 in range(parts):
                                    s2 = b.starts[place + j2]
                                    if t[6 + 3 * j2] == 0 or s2 < 0:
                                        continue
                                    for x2 in range(t[5 + 3 * j2]):
                                        total += local[s + x, s2 + x2] * line[j2, e2, x2]
                                for e in range(m):
                                    hat[out + e * m + e2] += line[j, e, x] * total
                    for e in range(m):
                        for e2 in range(m):
                            total = 0.0
                            for a in range(3):
                                total -= q[n + e, a] * mixed[a, e2] + q[n + e2, a] * mixed[a, e]
                                for a2 in range(3):
                                    total += q[n + e, a] * core[a, a2] * q[n + e2, a2]
                            hat[out + e * m + e2] += total
                    n += m
                if sparse:
                    for g in range(0, touched, 2):
                        y[:, stack[g] : stack[g] + stack[g + 1]] = 0.0


def _extend(front: Floats, update: Floats, at: Ints) -> None:
    """Add the lower triangle of a child's update to its parent."""
    n = len(at)
    for i in range(n):
        for j in range(i + 1):
            front[at[i], at[j]] += update[i, j]


def _gather(z: Floats, at: Ints, out: Floats) -> None:
    """Copy the rows and columns `at` of a symmetric matrix."""
    n = len(at)
    for i in range(n):
        for j in range(n):
            out[i, j] = z[at[i], at[j]]


# ---- NumPy twins --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Group:
    """The row blocks of one chunk in a cluster: numbers in the chunk, points (from the first), Q rows (N, m, 3), H (N, m, w) of the nodes
    with the place of each column in the cluster.
    """

    kind: int
    rows: Ints
    points: Ints
    q: Floats
    h: Floats
    at: Ints


def _cluster(c: int, b: Blocks) -> tuple[Floats, NDArray[np.bool_], list[_Group], Floats]:
    """Return the triangular factors, the singular points, the row blocks, and Y (3 P, width) of a cluster."""
    first, last = int(b.first_point[c]), int(b.first_point[c + 1])
    count, width = last - first, int(b.first_column[c + 1] - b.first_column[c])
    inverse = np.append(b.inverse[b.first_column[c] : b.first_column[c + 1]], 0.0)
    span = slice(b.first_block[first], b.first_block[last])
    kind, row = b.chunk[span], b.row[span]
    owner = np.repeat(np.arange(count), np.diff(b.first_block[first : last + 1]))
    before = np.concatenate([[0], np.cumsum(b.table[kind, 0])])
    begin = before[:-1] - before[b.first_block[first:last] - b.first_block[first]][owner]  # first row within the point
    most = int((begin + b.table[kind, 0]).max(initial=0))
    g = np.zeros((count, most + 3, 3))
    g[:, most:] = b.prior[first:last, :, None] * np.eye(3)
    found: list[tuple[int, Ints, Ints, Ints, Floats, Ints]] = []
    for k in np.unique(kind).tolist():
        some = np.flatnonzero(kind == k)
        m, parts, base, place = b.table[k, :4]
        rows = row[some].astype(np.intp)
        at = begin[some][:, None] + np.arange(m)
        own = b.values[base + rows[:, None] * (3 * m) + np.arange(3 * m)].reshape(-1, m, 3)
        g[owner[some][:, None], at] = own * b.point_inverse[first:last][owner[some]][:, None, :]
        h, columns = [np.zeros((len(some), m, 0))], [np.zeros((len(some), 0), dtype=np.intp)]
        for j in range(parts):
            start, w, node = b.table[k, 4 + 3 * j : 7 + 3 * j]
            if node and w:
                s = b.starts[place + rows * parts + j].astype(np.intp)
                columns.append(np.where(s[:, None] >= 0, s[:, None] + np.arange(w), width))
                h.append(b.values[start + rows[:, None] * (m * w) + np.arange(m * w)].reshape(-1, m, w) * inverse[columns[-1]][:, None, :])
        found.append((k, rows, owner[some], at, np.concatenate(h, axis=2), np.concatenate(columns, axis=1)))
    q, r, bad = orthogonal(g)
    y = np.zeros((3 * count, width + 1))
    groups = []
    for k, rows, points, at, partials, places in found:
        qs = q[points[:, None], at]
        np.add.at(y, (3 * points[:, None, None] + np.arange(3)[:, None], places[:, None, :]), np.einsum("nma,nmw->naw", qs, partials))
        groups.append(_Group(k, rows, points, qs, partials, places))
    return r, bad, groups, y[:, :width]


def orthogonal(a: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Factor (P, n, 3) arrays as Q R by modified Gram-Schmidt, done twice; also flag rank-deficient ones.

    Examples
    --------
    >>> q, r, bad = orthogonal(np.eye(3)[None] * 2.0)
    >>> r[0].tolist(), bad.tolist()
    ([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]], [False])
    """
    q, r = a.copy(), np.broadcast_to(np.eye(3), (len(a), 3, 3)).copy()
    bad = np.zeros(len(a), dtype=bool)
    for _ in range(2):
        step = np.zeros((len(a), 3, 3))
        for j in range(3):
            before = np.linalg.norm(q[:, :, j], axis=1)
            for i in range(j):
                step[:, i, j] = np.einsum("pr,pr->p", q[:, :, i], q[:, :, j])
                q[:, :, j] -= step[:, i, j, None] * q[:, :, i]
            length = np.linalg.norm(q[:, :, j], axis=1)
            bad |= ~(length > SMALLEST * before)
            step[:, j, j] = np.where(length > SMALLEST * before, length, 1.0)
            q[:, :, j] /= step[:, j, j, None]
        r = step @ r
    return q, r, bad


def _accumulate_twin(clusters: Ints, front: Floats, b: Blocks, r: Floats, bad: NDArray[np.bool_], size: Ints) -> None:
    for c in clusters:
        some = slice(b.first_point[c], b.first_point[c + 1])
        r[some], bad[some], groups, y = _cluster(c, b)
        width = y.shape[1]
        own = np.zeros((width + 1, width + 1))
        for g in groups:
            np.add.at(own, (g.at[:, :, None], g.at[:, None, :]), np.einsum("nmi,nmj->nij", g.h, g.h))
        rows = b.cluster_rows[b.first_column[c] : b.first_column[c + 1]]
        front[np.ix_(rows, rows)] += np.tril(own[:width, :width] - y.T @ y)


def _statistics_twin(clusters: Ints, z: Floats, b: Blocks, hat: Floats, points: Floats, size: Ints) -> None:
    for c in clusters:
        some = slice(b.first_point[c], b.first_point[c + 1])
        r, _, groups, y = _cluster(c, b)
        width = y.shape[1]
        rows = b.cluster_rows[b.first_column[c] : b.first_column[c + 1]]
        local = np.zeros((width + 1, width + 1))
        local[:width, :width] = z[np.ix_(rows, rows)]
        t = np.zeros((len(y), width + 1))
        t[:, :width] = y @ local[:width, :width]
        cube = t.reshape(len(t) // 3, 3, width + 1)
        core = np.eye(3) + cube[:, :, :width] @ y.reshape(len(y) // 3, 3, width).transpose(0, 2, 1)
        inner = np.linalg.solve(r, np.broadcast_to(np.eye(3), r.shape))
        scale = b.point_inverse[some]
        points[some] = inner @ core @ inner.transpose(0, 2, 1) * scale[:, :, None] * scale[:, None, :]
        for g in groups:
            m = g.h.shape[1]
            picked = cube[g.points[:, None, None], np.arange(3)[:, None], g.at[:, None, :]]  # (N, 3, w)
            mixed = g.q @ picked @ g.h.transpose(0, 2, 1)
            h = g.q @ core[g.points] @ g.q.transpose(0, 2, 1) - mixed - mixed.transpose(0, 2, 1)
            h += g.h @ local[g.at[:, :, None], g.at[:, None, :]] @ g.h.transpose(0, 2, 1)
            hat[b.hat[g.kind] + g.rows[:, None] * (m * m) + np.arange(m * m)] = h.reshape(len(h), -1)


def _extend_twin(front: Floats, update: Floats, at: Ints) -> None:
    front[np.ix_(at, at)] += np.tril(update)


def _gather_twin(z: Floats, at: Ints, out: Floats) -> None:
    out[...] = z[np.ix_(at, at)]


@dataclass(frozen=True)
class Kernels:
    """The loops, compiled or not."""

    accumulate: Any
    statistics: Any
    extend: Any
    gather: Any
    compiled: bool


@cache
def compiled() -> Kernels | None:
    """Return the compiled loops, None where numba is not installed."""
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        return None

    original = getattr(_factor_point, "py_func", _factor_point)

    def build(cached: bool) -> Kernels:
        global _factor_point
        jit = numba.njit(nogil=True, cache=cached, error_model="numpy")
        _factor_point = jit(original)
        scope: dict[str, Any] = {}
        for function in (_accumulate, _statistics, _extend, _gather):
            scope[function.__name__] = jit(function)
        return Kernels(scope["_accumulate"], scope["_statistics"], scope["_extend"], scope["_gather"], compiled=True)

    try:
        return build(cached=True)
    except RuntimeError:  # no place to write the cache
        return build(cached=False)


def cached() -> bool:
    """Return whether compiled loops lie in numba's cache, or need not be compiled."""
    loops = compiled()
    path = loops and getattr(loops.accumulate.stats, "cache_path", None)
    return not path or any(Path(path).glob("kernels._accumulate-*.nbi"))


TWINS = Kernels(_accumulate_twin, _statistics_twin, _extend_twin, _gather_twin, compiled=False)


def kernels(blocks: int) -> Kernels:
    """Return the loops for a number of row blocks: NumPy for few, so that nothing waits for the compiler, or without numba."""
    return TWINS if blocks < COMPILE_FROM else compiled() or TWINS
