"""The loops over object points as they are compiled; `baarda.adjustment.kernels` chooses between them and their NumPy twins.

No array is sliced inside a loop over row blocks, and small functions become part of those that call them: every view and every argument
of a true call counts a reference, and threads would wait for each other's counts. Unsigned places spare the test for negative indices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.row_blocks import HEAD

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Small = NDArray[np.int32]

SMALLEST = 1e-12  # a column of G that others explain to this share is not determined
SLAB = 96  # rows of Y that stay in the cache while they are squared
AGAIN = 0.1  # a column of which less than this share is left is orthogonalised once more


def _sweep(q: Floats, first: int, end: int, b0: float, b1: float, b2: float) -> tuple[float, float, float, float, float, float, bool]:
    """Make three columns of q with these squared lengths orthonormal, rows `first` ... `end` - 1, by modified Gram-Schmidt.

    Returns R, row by row, and whether no column is explained by those before it; the length of one that is counts as 1.
    """
    regular = b0 > 0.0
    s00 = np.sqrt(b0) if regular else 1.0
    f = 1.0 / s00
    s01 = s02 = 0.0
    for k in range(first, end):
        x = q[k, 0] * f
        q[k, 0] = x
        s01 += x * q[k, 1]
        s02 += x * q[k, 2]
    left = 0.0
    for k in range(first, end):
        y = q[k, 1] - s01 * q[k, 0]
        q[k, 1] = y
        q[k, 2] -= s02 * q[k, 0]
        left += y * y
    s11 = np.sqrt(left)
    if not s11 > SMALLEST * np.sqrt(b1):
        regular, s11 = False, 1.0
    f = 1.0 / s11
    s12 = 0.0
    for k in range(first, end):
        y = q[k, 1] * f
        q[k, 1] = y
        s12 += y * q[k, 2]
    left = 0.0
    for k in range(first, end):
        z = q[k, 2] - s12 * q[k, 1]
        q[k, 2] = z
        left += z * z
    s22 = np.sqrt(left)
    if not s22 > SMALLEST * np.sqrt(b2):
        regular, s22 = False, 1.0
    f = 1.0 / s22
    for k in range(first, end):
        q[k, 2] *= f
    return s00, s01, s02, s11, s12, s22, regular


def _factor_point(
    p: int, values: Floats, table: Ints, first_block: Ints, chunk: Small, row: Small, point_inverse: Floats, prior: Floats, q: Floats,
    first: int, r: Floats, place: int,
) -> int:  # fmt: skip
    """Fill q from row `first` with the orthogonal factor of a point's rows, and r[place] with the triangular one.

    Returns the number of rows, negative if the point is not determined. A second sweep follows where a column loses much in the first.
    """
    i0, i1, i2 = point_inverse[p, 0], point_inverse[p, 1], point_inverse[p, 2]
    n = first
    b0 = b1 = b2 = 0.0
    for i in range(first_block[p], first_block[p + 1]):
        k = chunk[i]
        base = table[k, 2] + row[i] * table[k, 0] * 3
        for _ in range(table[k, 0]):
            x, y, z = values[base] * i0, values[base + 1] * i1, values[base + 2] * i2
            q[n, 0], q[n, 1], q[n, 2] = x, y, z
            b0 += x * x
            b1 += y * y
            b2 += z * z
            base += 3
            n += 1
    for a in range(3):
        own = prior[p, a]
        if own > 0.0:
            q[n, 0] = q[n, 1] = q[n, 2] = 0.0
            q[n, a] = own
            b0 += own * own if a == 0 else 0.0
            b1 += own * own if a == 1 else 0.0
            b2 += own * own if a == 2 else 0.0
            n += 1
    r00, r01, r02, r11, r12, r22, regular = _sweep(q, first, n, b0, b1, b2)
    if not (r11 > AGAIN * np.sqrt(b1) and r22 > AGAIN * np.sqrt(b2)):
        s00, s01, s02, s11, s12, s22, again = _sweep(q, first, n, 1.0, 1.0, 1.0)
        regular = regular and again
        r02 = s00 * r02 + s01 * r12 + s02 * r22  # R = S R
        r01 = s00 * r01 + s01 * r11
        r12 = s11 * r12 + s12 * r22
        r00, r11, r22 = s00 * r00, s11 * r11, s22 * r22
    r[place, 0, 0], r[place, 0, 1], r[place, 0, 2] = r00, r01, r02
    r[place, 1, 1], r[place, 1, 2], r[place, 2, 2] = r11, r12, r22
    return n - first if regular else first - n


def _touch(stack: Ints, touched: int, begins: Ints, count: int) -> int:
    """Note the parts that a point touches, each once; return their number."""
    for g in range(0, count, 3):
        known = False
        for x in range(touched):
            known = known or stack[x, 0] == begins[g]
        if not known:
            stack[touched, 0], stack[touched, 1] = begins[g], begins[g + 1]
            touched += 1
    return touched


def _parts(table: Ints, starts: Small, k: int, row: int, parts: Ints) -> int:
    """Fill `parts` with the nodes of a block of chunk k: where each begins in the cluster, its width, and where its partials begin.

    Returned is how many numbers that are.
    """
    count, first = 0, table[k, 3] + row * table[k, 1]
    for j in range(table[k, 1]):
        s = starts[first + j]
        if table[k, HEAD + 2 + 3 * j] != 0 and s >= 0:
            w = table[k, HEAD + 1 + 3 * j]
            parts[count], parts[count + 1], parts[count + 2] = s, w, table[k, HEAD + 3 * j] + row * table[k, 0] * w
            count += 3
    return count


def _add_y(
    values: Floats, upper: int, lower: int, w: int, q: Floats, n: int, n2: int, factor: float, y: Floats, to: int, stride: int
) -> None:
    """Add Q'H of two rows of a node to three rows of Y."""
    a0, a1, a2 = q[n, 0], q[n, 1], q[n, 2]
    b0, b1, b2 = q[n2, 0] * factor, q[n2, 1] * factor, q[n2, 2] * factor
    h, h2, t0 = np.uint64(upper), np.uint64(lower), np.uint64(to)
    t1 = t0 + np.uint64(stride)
    t2 = t1 + np.uint64(stride)
    if w == 6:
        for x in range(np.uint64(6)):
            u, v = values[h + x], values[h2 + x]
            y[t0 + x] += a0 * u + b0 * v
            y[t1 + x] += a1 * u + b1 * v
            y[t2 + x] += a2 * u + b2 * v
    else:
        for x in range(np.uint64(w)):
            u, v = values[h + x], values[h2 + x]
            y[t0 + x] += a0 * u + b0 * v
            y[t1 + x] += a1 * u + b1 * v
            y[t2 + x] += a2 * u + b2 * v


def _six(values: Floats, h: Any) -> tuple[float, float, float, float, float, float]:
    one = np.uint64(1)
    h1 = h + one
    h2 = h1 + one
    h3 = h2 + one
    h4 = h3 + one
    return values[h], values[h1], values[h2], values[h3], values[h4], values[h4 + one]


def _add_square(values: Floats, upper: int, lower: int, w: int, factor: float, own: Floats, to: int, stride: int) -> None:
    """Add H'H of two rows of a node to the lower triangle of its place in a cluster."""
    h, h2, t = np.uint64(upper), np.uint64(lower), np.uint64(to)
    if w == 6:  # an exterior orientation: held in registers
        u, v = _six(values, h), _six(values, h2)
        for x in range(6):
            f, g = u[x], v[x] * factor
            for x2 in range(x + 1):
                own[t + np.uint64(x2)] += f * u[x2] + g * v[x2]
            t += np.uint64(stride)
    else:
        for x in range(np.uint64(w)):
            f, g = values[h + x], values[h2 + x] * factor
            for x2 in range(x + np.uint64(1)):
                own[t + x2] += f * values[h + x2] + g * values[h2 + x2]
            t += np.uint64(stride)


def _add_product(
    values: Floats, upper: int, lower: int, w: int, upper2: int, lower2: int, w2: int, factor: float, own: Floats, to: int, stride: int
) -> None:
    """Add H'H of two rows of two nodes."""
    h, h2, o, o2, t = np.uint64(upper), np.uint64(lower), np.uint64(upper2), np.uint64(lower2), np.uint64(to)
    for x in range(np.uint64(w)):
        f, g = values[h + x], values[h2 + x] * factor
        for x2 in range(np.uint64(w2)):
            own[t + x2] += f * values[o + x2] + g * values[o2 + x2]
        t += np.uint64(stride)


def _subtract_square(y: Floats, height: int, width: int, stride: int, out: Floats) -> None:
    """Subtract Y'Y from the lower triangle of `out`, rows of both at a distance `stride`.

    Six rows of Y, whose number is a multiple of that, meet four columns at a time; the distance is a multiple of eight, and columns
    beyond the width are zero.
    """
    s, one = np.uint64(stride), np.uint64(1)
    for first in range(0, height, SLAB):
        for a in range(np.uint64(0), np.uint64(width), np.uint64(4)):
            b, c, d = a + one, a + one + one, a + one + one + one
            ta = a * s
            tb = ta + s
            tc = tb + s
            td = tc + s
            end = (a // np.uint64(8) + one) * np.uint64(8)
            for k in range(first, min(first + SLAB, height), 6):
                k0 = np.uint64(k) * s
                k1 = k0 + s
                k2 = k1 + s
                k3 = k2 + s
                k4 = k3 + s
                k5 = k4 + s
                a0, a1, a2, a3, a4, a5 = y[k0 + a], y[k1 + a], y[k2 + a], y[k3 + a], y[k4 + a], y[k5 + a]
                b0, b1, b2, b3, b4, b5 = y[k0 + b], y[k1 + b], y[k2 + b], y[k3 + b], y[k4 + b], y[k5 + b]
                c0, c1, c2, c3, c4, c5 = y[k0 + c], y[k1 + c], y[k2 + c], y[k3 + c], y[k4 + c], y[k5 + c]
                d0, d1, d2, d3, d4, d5 = y[k0 + d], y[k1 + d], y[k2 + d], y[k3 + d], y[k4 + d], y[k5 + d]
                for x in range(end):
                    y0, y1, y2, y3, y4, y5 = y[k0 + x], y[k1 + x], y[k2 + x], y[k3 + x], y[k4 + x], y[k5 + x]
                    out[ta + x] -= a0 * y0 + a1 * y1 + a2 * y2 + a3 * y3 + a4 * y4 + a5 * y5
                    out[tb + x] -= b0 * y0 + b1 * y1 + b2 * y2 + b3 * y3 + b4 * y4 + b5 * y5
                    out[tc + x] -= c0 * y0 + c1 * y1 + c2 * y2 + c3 * y3 + c4 * y4 + c5 * y5
                    out[td + x] -= d0 * y0 + d1 * y1 + d2 * y2 + d3 * y3 + d4 * y4 + d5 * y5


def _accumulate(clusters: Ints, front: Floats, y: Floats, rhs: Floats, b: Any, r: Floats, bad: NDArray[np.bool_], size: Ints) -> None:
    """Add H'H - Y'Y of clusters to the lower triangle of a front, and what A'y leaves to `rhs`; store the triangular factors (P, 3, 3).

    Columns are scaled when a cluster is done.
    """
    table, first_block, chunk, first_point, first_column = b.table, b.first_block, b.chunk, b.first_point, b.first_column
    cluster_rows, is_sparse, inverse = b.cluster_rows, b.sparse, b.inverse
    values, starts, row, point_inverse, prior, scalar = b.values, b.starts, b.row, b.point_inverse, b.prior, b.scalar
    q, left = np.empty((size[0], 3)), np.empty(size[0] + 1)
    buffer, square, right = np.empty(size[1]), np.empty(size[2]), np.empty(size[2])
    stack, parts = np.empty((size[3], 2), np.int64), np.empty(3 * size[4], np.int64)
    for c in clusters:
        offset = first_column[c]
        width = first_column[c + 1] - offset
        sparse = is_sparse[c]
        points = first_point[c + 1] - first_point[c]
        height = 3 if sparse else (points + 1) // 2 * 6
        stride = (width + 7) // 8 * 8
        step = np.uint64(stride)
        lines = buffer[: height * stride]
        lines[:] = 0.0
        own = square[: stride * stride]
        own[:] = 0.0
        right[:width] = 0.0
        for p in range(first_point[c], first_point[c + 1]):
            bad[p] = _factor_point(p, values, table, first_block, chunk, row, point_inverse, prior, q, 0, r, p) < 0
            if width == 0:
                continue
            t0 = t1 = t2 = 0.0
            n = 0
            for i in range(first_block[p], first_block[p + 1]):
                k = chunk[i]
                at = scalar[table[k, 4] + row[i]]
                for e in range(table[k, 0]):
                    left[n] = y[at + e]
                    t0 += q[n, 0] * y[at + e]
                    t1 += q[n, 1] * y[at + e]
                    t2 += q[n, 2] * y[at + e]
                    n += 1
            y0 = 0 if sparse else 3 * (p - first_point[c]) * stride
            n = touched = 0
            for i in range(first_block[p], first_block[p + 1]):
                k = chunk[i]
                m = table[k, 0]
                count = _parts(table, starts, k, row[i], parts)
                if sparse:
                    touched = _touch(stack, touched, parts, count)
                for e in range(0, m, 2):
                    d0 = left[n] - (q[n, 0] * t0 + q[n, 1] * t1 + q[n, 2] * t2)
                    n2, factor, d1 = n, 0.0, 0.0
                    if e + 1 < m:
                        n2, factor = n + 1, 1.0
                        d1 = left[n2] - (q[n2, 0] * t0 + q[n2, 1] * t1 + q[n2, 2] * t2)
                    for g in range(0, count, 3):
                        s, w = parts[g], parts[g + 1]
                        upper = parts[g + 2] + e * w
                        lower = upper + (n2 - n) * w
                        for x in range(np.uint64(w)):
                            right[np.uint64(s) + x] += values[np.uint64(upper) + x] * d0 + values[np.uint64(lower) + x] * d1
                        _add_y(values, upper, lower, w, q, n, n2, factor, lines, y0 + s, stride)
                        _add_square(values, upper, lower, w, factor, own, s * stride + s, stride)
                        for g2 in range(0, count, 3):
                            s2, w2 = parts[g2], parts[g2 + 1]
                            if s2 < s:
                                upper2 = parts[g2 + 2] + e * w2
                                lower2 = upper2 + (n2 - n) * w2
                                _add_product(values, upper, lower, w, upper2, lower2, w2, factor, own, s * stride + s2, stride)
                    n = n2 + 1
            if sparse:
                for g in range(touched):
                    for g2 in range(touched):
                        if stack[g2, 0] <= stack[g, 0]:
                            to = np.uint64(stack[g, 0] * stride + stack[g2, 0])
                            s2 = np.uint64(stack[g2, 0])
                            for x in range(np.uint64(stack[g, 0]), np.uint64(stack[g, 0] + stack[g, 1])):
                                u0, u1, u2 = lines[x], lines[x + step], lines[x + step + step]
                                for x2 in range(np.uint64(stack[g2, 1])):
                                    own[to + x2] -= u0 * lines[s2 + x2] + u1 * lines[s2 + step + x2] + u2 * lines[s2 + step + step + x2]
                                to += step
                for g in range(touched):
                    for a in range(3):
                        for x in range(a * stride + stack[g, 0], a * stride + stack[g, 0] + stack[g, 1]):
                            lines[x] = 0.0
        if width == 0:
            continue
        if not sparse:
            _subtract_square(lines, height, width, stride, own)
        for x in range(width):
            fx, f = np.uint64(cluster_rows[offset + x]), inverse[offset + x]
            rhs[fx] += right[x] * f
            at, begin = np.uint64(x * stride), np.uint64(offset)
            for x2 in range(np.uint64(x + 1)):
                front[fx, np.uint64(cluster_rows[begin + x2])] += own[at + x2] * (f * inverse[begin + x2])


def _product(a: Floats, i: int, b: Floats, j: int, count: int) -> float:
    """Return the product of two stretches of arrays."""
    at, to = np.uint64(i), np.uint64(j)
    if count == 6:
        u, v = _six(a, at), _six(b, to)
        return (u[0] * v[0] + u[1] * v[1]) + (u[2] * v[2] + u[3] * v[3]) + (u[4] * v[4] + u[5] * v[5])
    total = 0.0
    for x in range(np.uint64(count)):
        total += a[at + x] * b[to + x]
    return total


def _multiply(y: Floats, height: int, stride: int, z: Floats, out: Floats) -> None:
    """Store the product of Y and a square matrix, rows of all at a distance `stride`, a multiple of eight.

    Three rows of Y, whose number is a multiple of that, meet eight rows of the matrix at a time.
    """
    s = np.uint64(stride)
    out[: height * stride] = 0.0
    for row in range(0, height, 3):
        ta = np.uint64(row) * s
        tb = ta + s
        tc = tb + s
        for k in range(np.uint64(0), s, np.uint64(8)):
            a, b, c = ta + k, tb + k, tc + k
            a0, a1, a2, a3, a4, a5 = _six(y, a)
            b0, b1, b2, b3, b4, b5 = _six(y, b)
            c0, c1, c2, c3, c4, c5 = _six(y, c)
            a6, b6, c6 = y[a + np.uint64(6)], y[b + np.uint64(6)], y[c + np.uint64(6)]
            a7, b7, c7 = y[a + np.uint64(7)], y[b + np.uint64(7)], y[c + np.uint64(7)]
            k0 = k * s
            k1 = k0 + s
            k2 = k1 + s
            k3 = k2 + s
            k4 = k3 + s
            k5 = k4 + s
            k6 = k5 + s
            k7 = k6 + s
            for x in range(s):
                z0, z1, z2, z3, z4, z5, z6, z7 = z[k0 + x], z[k1 + x], z[k2 + x], z[k3 + x], z[k4 + x], z[k5 + x], z[k6 + x], z[k7 + x]
                out[ta + x] += a0 * z0 + a1 * z1 + a2 * z2 + a3 * z3 + a4 * z4 + a5 * z5 + a6 * z6 + a7 * z7
                out[tb + x] += b0 * z0 + b1 * z1 + b2 * z2 + b3 * z3 + b4 * z4 + b5 * z5 + b6 * z6 + b7 * z7
                out[tc + x] += c0 * z0 + c1 * z1 + c2 * z2 + c3 * z3 + c4 * z4 + c5 * z5 + c6 * z6 + c7 * z7


def _form_of_six(values: Floats, upper: int, lower: int, z: Floats, at: int, stride: int) -> tuple[float, float, float]:
    """Do as `_form` for an exterior orientation, which is held in registers."""
    to, uu, uv, vv = np.uint64(at), 0.0, 0.0, 0.0
    u, v = _six(values, np.uint64(upper)), _six(values, np.uint64(lower))
    for x in range(6):
        diagonal = 0.5 * z[to + np.uint64(x)]
        su, sv = diagonal * u[x], diagonal * v[x]
        for x2 in range(x):
            su += z[to + np.uint64(x2)] * u[x2]
            sv += z[to + np.uint64(x2)] * v[x2]
        uu += u[x] * su
        uv += u[x] * sv + v[x] * su
        vv += v[x] * sv
        to += np.uint64(stride)
    return uu, uv, vv


def _form(values: Floats, upper: int, lower: int, w: int, z: Floats, at: int, stride: int) -> tuple[float, float, float]:
    """Return u'Zu / 2, u'Zv and v'Zv / 2 of two rows of a node, from the lower triangle of Z."""
    h, h2, to = np.uint64(upper), np.uint64(lower), np.uint64(at)
    uu = uv = vv = 0.0
    for x in range(np.uint64(w)):
        f, f2, diagonal = values[h + x], values[h2 + x], 0.5 * z[to + x]
        su, sv = diagonal * f, diagonal * f2
        for x2 in range(x):
            su += z[to + x2] * values[h + x2]
            sv += z[to + x2] * values[h2 + x2]
        uu += f * su
        uv += f * sv + f2 * su
        vv += f2 * sv
        to += np.uint64(stride)
    return uu, uv, vv


def _form_of_two(
    values: Floats, upper: int, lower: int, w: int, upper2: int, lower2: int, w2: int, z: Floats, at: int, stride: int
) -> tuple[float, float, float]:
    """Return what two nodes add to the same forms."""
    h, h2, o, o2, to = np.uint64(upper), np.uint64(lower), np.uint64(upper2), np.uint64(lower2), np.uint64(at)
    uu = uv = vv = 0.0
    for x in range(np.uint64(w)):
        f, f2, su, sv = values[h + x], values[h2 + x], 0.0, 0.0
        for x2 in range(np.uint64(w2)):
            su += z[to + x2] * values[o + x2]
            sv += z[to + x2] * values[o2 + x2]
        uu += f * su
        uv += f * sv + f2 * su
        vv += f2 * sv
        to += np.uint64(stride)
    return uu, uv, vv


def _between(values: Floats, parts: Ints, count: int, e: int, e2: int, z: Floats, stride: int) -> float:
    """Return the element (e, e2) of H Z H' of a block."""
    total = 0.0
    for g in range(0, count, 3):
        for x in range(parts[g + 1]):
            f = values[parts[g + 2] + e * parts[g + 1] + x]
            for g2 in range(0, count, 3):
                w = parts[g2 + 1]
                total += f * _product(values, parts[g2 + 2] + e2 * w, z, (parts[g] + x) * stride + parts[g2], w)
    return total


def _statistics(clusters: Ints, z: Floats, b: Any, hat: Floats, points: Floats, place: Ints, size: Ints) -> None:
    """Store the diagonal blocks of A N^-1 A', or only their diagonals, and in their places the cofactors of the points of clusters.

    They come from the inverse z of the front of the clusters.
    """
    table, first_block, chunk, row, first_point, first_column = b.table, b.first_block, b.chunk, b.row, b.first_point, b.first_column
    values, starts, prior = b.values, b.starts, b.prior
    cluster_rows, is_sparse, inverse, point_inverse, hats = b.cluster_rows, b.sparse, b.inverse, b.point_inverse, b.hat
    q_all, mixed = np.empty((size[6], 3)), np.empty((table[:, 0].max(), 3))
    inner, core, half = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    buffer, product, square = np.empty(size[1]), np.empty(size[1]), np.empty(size[2])
    triangles, rows = np.empty((size[7], 3, 3)), np.empty(size[7], np.int64)
    stack, parts = np.empty((size[3], 2), np.int64), np.empty(3 * size[4], np.int64)
    for c in clusters:
        offset = first_column[c]
        width = first_column[c + 1] - offset
        sparse = is_sparse[c]
        count_of_points = first_point[c + 1] - first_point[c]
        height = 3 if sparse else 3 * count_of_points
        stride = (width + 7) // 8 * 8
        step = np.uint64(stride)
        local = square[: stride * stride]  # with scaled columns
        for x in range(width):
            fx, f = np.uint64(cluster_rows[offset + x]), inverse[offset + x]
            to, begin = np.uint64(x * stride), np.uint64(offset)
            for x2 in range(np.uint64(width)):
                local[to + x2] = z[fx, np.uint64(cluster_rows[begin + x2])] * (f * inverse[begin + x2])
            local[x * stride + width : (x + 1) * stride] = 0.0
        local[width * stride :] = 0.0
        y = buffer[: height * stride]
        y[:] = 0.0
        t_all = product[: height * stride]
        begin_q = 0
        for sweep in range(2):
            if sweep == 0 and sparse:
                continue
            if sweep == 1 and not sparse:
                _multiply(y, height, stride, local, t_all)
                begin_q = 0
            for p in range(first_point[c], first_point[c + 1]):
                y0 = 0 if sparse else 3 * (p - first_point[c]) * stride
                at_r = 0 if sparse else p - first_point[c]
                touched = 0
                if sparse:
                    begin_q = 0
                if sweep == 0 or sparse:
                    n = _factor_point(p, values, table, first_block, chunk, row, point_inverse, prior, q_all, begin_q, triangles, at_r)
                    rows[at_r] = abs(n)
                    n = begin_q
                    for i in range(first_block[p], first_block[p + 1]):
                        k = chunk[i]
                        m = table[k, 0]
                        count = _parts(table, starts, k, row[i], parts)
                        if sparse:
                            touched = _touch(stack, touched, parts, count)
                        for e in range(0, m, 2):
                            d = 1 if e + 1 < m else 0
                            for g in range(0, count, 3):
                                w = parts[g + 1]
                                upper = parts[g + 2] + e * w
                                _add_y(values, upper, upper + d * w, w, q_all, n, n + d, float(d), y, y0 + parts[g], stride)
                            n += 1 + d
                    if sweep == 0:
                        begin_q += rows[at_r]
                        continue
                if sparse:
                    for g in range(touched):
                        for x in range(stack[g, 0], stack[g, 0] + stack[g, 1]):
                            t_all[x] = t_all[stride + x] = t_all[2 * stride + x] = 0.0
                    for g2 in range(touched):
                        for x2 in range(np.uint64(stack[g2, 0]), np.uint64(stack[g2, 0] + stack[g2, 1])):
                            u0, u1, u2 = y[x2], y[x2 + step], y[x2 + step + step]
                            for g in range(touched):
                                for x in range(np.uint64(stack[g, 0]), np.uint64(stack[g, 0] + stack[g, 1])):
                                    value = local[x2 * step + x]
                                    t_all[x] += u0 * value
                                    t_all[step + x] += u1 * value
                                    t_all[step + step + x] += u2 * value
                for a in range(3):
                    for a2 in range(a + 1):
                        total = 1.0 if a == a2 else 0.0
                        o, o2 = np.uint64(y0 + a * stride), np.uint64(y0 + a2 * stride)
                        if sparse:
                            for g in range(touched):
                                for x in range(np.uint64(stack[g, 0]), np.uint64(stack[g, 0] + stack[g, 1])):
                                    total += t_all[o + x] * y[o2 + x]
                        else:
                            s0 = s1 = s2 = s3 = 0.0
                            for x in range(np.uint64(0), step, np.uint64(4)):
                                s0 += t_all[o + x] * y[o2 + x]
                                s1 += t_all[o + x + np.uint64(1)] * y[o2 + x + np.uint64(1)]
                                s2 += t_all[o + x + np.uint64(2)] * y[o2 + x + np.uint64(2)]
                                s3 += t_all[o + x + np.uint64(3)] * y[o2 + x + np.uint64(3)]
                            total += (s0 + s1) + (s2 + s3)
                        core[a, a2] = core[a2, a] = total
                # inner = R^-1
                for a in range(3):
                    for a2 in range(3):
                        inner[a, a2] = 0.0
                for a2 in range(3):
                    inner[a2, a2] = 1.0 / triangles[at_r, a2, a2]
                    for a in range(a2 - 1, -1, -1):
                        total = 0.0
                        for x in range(a + 1, a2 + 1):
                            total += triangles[at_r, a, x] * inner[x, a2]
                        inner[a, a2] = -total / triangles[at_r, a, a]
                for a in range(3):
                    for a2 in range(3):
                        half[a, a2] = inner[a, 0] * core[0, a2] + inner[a, 1] * core[1, a2] + inner[a, 2] * core[2, a2]
                for a in range(3):
                    for a2 in range(3):
                        total = half[a, 0] * inner[a2, 0] + half[a, 1] * inner[a2, 1] + half[a, 2] * inner[a2, 2]
                        points[place[p], a, a2] = total * point_inverse[p, a] * point_inverse[p, a2]
                n = begin_q
                for i in range(first_block[p], first_block[p + 1]):
                    k = chunk[i]
                    m = table[k, 0]
                    whole = hats[k, 1] == m * m
                    out = hats[k, 0] + row[i] * hats[k, 1]
                    count = _parts(table, starts, k, row[i], parts)
                    for e in range(m):
                        for a in range(3):  # half of core Q' less T H'
                            total = 0.5 * (core[a, 0] * q_all[n + e, 0] + core[a, 1] * q_all[n + e, 1] + core[a, 2] * q_all[n + e, 2])
                            for g in range(0, count, 3):
                                w = parts[g + 1]
                                total -= _product(values, parts[g + 2] + e * w, t_all, y0 + a * stride + parts[g], w)
                            mixed[e, a] = total
                    for e in range(0, m, 2):
                        d = e + 1 if e + 1 < m else e
                        uu = uv = vv = 0.0
                        for g in range(0, count, 3):
                            s, w = parts[g], parts[g + 1]
                            upper, lower = parts[g + 2] + e * w, parts[g + 2] + d * w
                            if w == 6:
                                fuu, fuv, fvv = _form_of_six(values, upper, lower, local, s * stride + s, stride)
                            else:
                                fuu, fuv, fvv = _form(values, upper, lower, w, local, s * stride + s, stride)
                            uu, uv, vv = uu + fuu, uv + fuv, vv + fvv
                            for g2 in range(0, count, 3):
                                s2, w2 = parts[g2], parts[g2 + 1]
                                if s2 < s:
                                    upper2, lower2 = parts[g2 + 2] + e * w2, parts[g2 + 2] + d * w2
                                    fuu, fuv, fvv = _form_of_two(
                                        values, upper, lower, w, upper2, lower2, w2, local, s * stride + s2, stride
                                    )
                                    uu, uv, vv = uu + fuu, uv + fuv, vv + fvv
                        if not whole:
                            hat[out + e], hat[out + d] = 2.0 * uu, 2.0 * vv
                            continue
                        hat[out + e * m + e] = 2.0 * uu
                        hat[out + d * m + e], hat[out + d * m + d] = uv, 2.0 * vv
                        for e2 in range(e):
                            hat[out + e * m + e2] = _between(values, parts, count, e, e2, local, stride)
                            hat[out + d * m + e2] = _between(values, parts, count, d, e2, local, stride)
                    for e in range(m):
                        for e2 in range(0 if whole else e, e + 1):
                            at, mirror = (e * m + e2, e2 * m + e) if whole else (e, e)
                            total = hat[out + at]
                            for a in range(3):
                                total += q_all[n + e, a] * mixed[e2, a] + mixed[e, a] * q_all[n + e2, a]
                            hat[out + at] = hat[out + mirror] = total
                    n += m
                if sparse:
                    for g in range(touched):
                        for a in range(3):
                            for x in range(a * stride + stack[g, 0], a * stride + stack[g, 0] + stack[g, 1]):
                                y[x] = 0.0
                else:
                    begin_q += rows[at_r]


def _widest(clusters: Ints, first_column: Ints) -> int:
    width = 0
    for c in clusters:
        width = max(width, first_column[c + 1] - first_column[c])
    return width


def _forward(clusters: Ints, y: Floats, b: Any, r: Floats, out: Floats) -> None:
    """Add to `out`, the rows of a front, what A'y leaves for it when the points of clusters are eliminated."""
    values, table, starts, first_block, chunk, row = b.values, b.table, b.starts, b.first_block, b.chunk, b.row
    first_point, first_column, cluster_rows = b.first_point, b.first_column, b.cluster_rows
    inverse, point_inverse, scalar = b.inverse, b.point_inverse, b.scalar
    right = np.empty(_widest(clusters, first_column))
    for c in clusters:
        offset = first_column[c]
        width = first_column[c + 1] - offset
        right[:width] = 0.0
        for p in range(first_point[c], first_point[c + 1]):
            t0 = t1 = t2 = 0.0
            for i in range(first_block[p], first_block[p + 1]):
                k = chunk[i]
                m = table[k, 0]
                base = table[k, 2] + row[i] * m * 3
                at = scalar[table[k, 4] + row[i]]
                for e in range(m):
                    t0 += values[base] * y[at + e]
                    t1 += values[base + 1] * y[at + e]
                    t2 += values[base + 2] * y[at + e]
                    base += 3
            t0, t1, t2 = _solved(r, p, t0 * point_inverse[p, 0], t1 * point_inverse[p, 1], t2 * point_inverse[p, 2])
            t0, t1, t2 = t0 * point_inverse[p, 0], t1 * point_inverse[p, 1], t2 * point_inverse[p, 2]
            for i in range(first_block[p], first_block[p + 1]):
                k = chunk[i]
                m, parts = table[k, 0], table[k, 1]
                base = table[k, 2] + row[i] * m * 3
                at = scalar[table[k, 4] + row[i]]
                for e in range(m):
                    left = y[at + e] - (values[base] * t0 + values[base + 1] * t1 + values[base + 2] * t2)
                    base += 3
                    for j in range(parts):
                        s = starts[table[k, 3] + row[i] * parts + j]
                        if table[k, HEAD + 2 + 3 * j] == 0 or s < 0:
                            continue
                        w = table[k, HEAD + 1 + 3 * j]
                        h, to = np.uint64(table[k, HEAD + 3 * j] + (row[i] * m + e) * w), np.uint64(s)
                        for x in range(np.uint64(w)):
                            right[to + x] += values[h + x] * left
        for x in range(width):
            out[cluster_rows[offset + x]] += right[x] * inverse[offset + x]


def _backward(clusters: Ints, solution: Floats, y: Floats, b: Any, r: Floats, points: Floats, change: Floats) -> None:
    """From the scaled solution of the reduced system store the (P, 3) unknowns of the points of clusters, and their rows of A x."""
    values, table, starts, first_block, chunk, row = b.values, b.table, b.starts, b.first_block, b.chunk, b.row
    first_point, first_column, columns = b.first_point, b.first_column, b.cluster_columns
    inverse, point_inverse, scalar = b.inverse, b.point_inverse, b.scalar
    local = np.empty(_widest(clusters, first_column))
    for c in clusters:
        offset = first_column[c]
        for x in range(first_column[c + 1] - offset):
            local[x] = solution[columns[offset + x]] * inverse[offset + x]
        for p in range(first_point[c], first_point[c + 1]):
            t0 = t1 = t2 = 0.0
            for i in range(first_block[p], first_block[p + 1]):
                k = chunk[i]
                m, parts = table[k, 0], table[k, 1]
                base = table[k, 2] + row[i] * m * 3
                at = scalar[table[k, 4] + row[i]]
                for e in range(m):
                    total = 0.0
                    for j in range(parts):
                        s = starts[table[k, 3] + row[i] * parts + j]
                        if table[k, HEAD + 2 + 3 * j] == 0 or s < 0:
                            continue
                        w = table[k, HEAD + 1 + 3 * j]
                        total += _product(values, table[k, HEAD + 3 * j] + (row[i] * m + e) * w, local, s, w)
                    change[at + e] = total
                    left = y[at + e] - total
                    t0 += values[base] * left
                    t1 += values[base + 1] * left
                    t2 += values[base + 2] * left
                    base += 3
            t0, t1, t2 = _solved(r, p, t0 * point_inverse[p, 0], t1 * point_inverse[p, 1], t2 * point_inverse[p, 2])
            t0, t1, t2 = t0 * point_inverse[p, 0], t1 * point_inverse[p, 1], t2 * point_inverse[p, 2]
            points[p, 0], points[p, 1], points[p, 2] = t0, t1, t2
            for i in range(first_block[p], first_block[p + 1]):
                k = chunk[i]
                m = table[k, 0]
                base = table[k, 2] + row[i] * m * 3
                at = scalar[table[k, 4] + row[i]]
                for e in range(m):
                    change[at + e] += values[base] * t0 + values[base + 1] * t1 + values[base + 2] * t2
                    base += 3


def _solved(r: Floats, p: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return (R'R)^-1 (x, y, z) of a point."""
    i0, i1, i2 = 1.0 / r[p, 0, 0], 1.0 / r[p, 1, 1], 1.0 / r[p, 2, 2]
    x *= i0
    y = (y - r[p, 0, 1] * x) * i1
    z = (z - r[p, 0, 2] * x - r[p, 1, 2] * y) * i2 * i2
    y = (y - r[p, 1, 2] * z) * i1
    x = (x - r[p, 0, 1] * y - r[p, 0, 2] * z) * i0
    return x, y, z


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


INNER = (
    _sweep, _factor_point, _touch, _solved, _parts, _add_y, _six, _add_square, _add_product, _subtract_square, _product, _multiply,
    _form_of_six, _form, _form_of_two, _between, _widest,
)  # fmt: skip
OUTER = (_accumulate, _statistics, _forward, _backward, _extend, _gather)
