"""The loops over object points in NumPy: for small networks, where numba is not installed, and as the oracle of the compiled ones.

For each point the whitened partials G (rows x 3, columns scaled) are factored orthogonally, G = Q R, so that nearly parallel rays lose
no digits; with Y = Q' H of the other partials H the reduced matrix is H'H - Y'Y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.point_loops import SMALLEST
from baarda.adjustment.row_blocks import HEAD, Blocks, put_hat

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


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
            start, w, node = b.table[k, HEAD + 3 * j : HEAD + 3 + 3 * j]
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


def accumulate(clusters: Ints, front: Floats, y: Floats, rhs: Floats, b: Blocks, r: Floats, bad: NDArray[np.bool_], size: Ints) -> None:
    """As `point_loops._accumulate`, without right-hand sides."""
    for c in clusters:
        some = slice(b.first_point[c], b.first_point[c + 1])
        r[some], bad[some], groups, lines = _cluster(c, b)
        width = lines.shape[1]
        own = np.zeros((width + 1, width + 1))
        for g in groups:
            np.add.at(own, (g.at[:, :, None], g.at[:, None, :]), np.einsum("nmi,nmj->nij", g.h, g.h))
        rows = b.cluster_rows[b.first_column[c] : b.first_column[c + 1]]
        front[np.ix_(rows, rows)] += np.tril(own[:width, :width] - lines.T @ lines)


def statistics(clusters: Ints, z: Floats, b: Blocks, hat: Floats, points: Floats, place: Ints, size: Ints) -> None:
    """As `point_loops._statistics`."""
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
        points[place[some]] = inner @ core @ inner.transpose(0, 2, 1) * scale[:, :, None] * scale[:, None, :]
        for g in groups:
            picked = cube[g.points[:, None, None], np.arange(3)[:, None], g.at[:, None, :]]  # (N, 3, w)
            mixed = g.q @ picked @ g.h.transpose(0, 2, 1)
            h = g.q @ core[g.points] @ g.q.transpose(0, 2, 1) - mixed - mixed.transpose(0, 2, 1)
            h += g.h @ local[g.at[:, :, None], g.at[:, None, :]] @ g.h.transpose(0, 2, 1)
            put_hat(hat, b.hat[g.kind], g.rows, h)


def extend(front: Floats, update: Floats, at: Ints) -> None:
    """As `point_loops._extend`."""
    front[np.ix_(at, at)] += np.tril(update)


def gather(z: Floats, at: Ints, out: Floats) -> None:
    """As `point_loops._gather`."""
    out[...] = z[np.ix_(at, at)]
