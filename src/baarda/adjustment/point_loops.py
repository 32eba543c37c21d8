"""The loops over object points as they are compiled; `baarda.adjustment.kernels` chooses between them and their NumPy twins.

No array is sliced inside a loop over row blocks: every view counts a reference, and threads would wait for each other's counts. Unsigned
places spare the test for negative indices.
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
AGAIN = 0.1  # a column of which less than this share is left is orthogonalised once more


def _factor_point(
    p: int, values: Floats, table: Ints, first_block: Ints, chunk: Small, row: Small, point_inverse: Floats, prior: Floats, q: Floats,
    first: int, r: Floats, place: int,
) -> int:  # fmt: skip
    """Fill q from row `first` with the orthogonal factor of a point's rows, and r[place] with the triangular one.

    Returns the number of rows, negative if the point is not determined. Modified Gram-Schmidt, done twice where a column loses much.
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
    singular = False
    r00 = r11 = r22 = 1.0
    r01 = r02 = r12 = 0.0
    for sweep in range(2):
        s00 = np.sqrt(b0)
        if not s00 > 0.0:
            singular = True
            s00 = 1.0
        f = 1.0 / s00
        s01 = s02 = 0.0
        for k in range(first, n):
            x = q[k, 0] * f
            q[k, 0] = x
            s01 += x * q[k, 1]
            s02 += x * q[k, 2]
        left = 0.0
        for k in range(first, n):
            y = q[k, 1] - s01 * q[k, 0]
            q[k, 1] = y
            q[k, 2] -= s02 * q[k, 0]
            left += y * y
        s11 = np.sqrt(left)
        if not s11 > SMALLEST * np.sqrt(b1):
            singular = True
            s11 = 1.0
        f = 1.0 / s11
        s12 = 0.0
        for k in range(first, n):
            y = q[k, 1] * f
            q[k, 1] = y
            s12 += y * q[k, 2]
        left = 0.0
        for k in range(first, n):
            z = q[k, 2] - s12 * q[k, 1]
            q[k, 2] = z
            left += z * z
        s22 = np.sqrt(left)
        if not s22 > SMALLEST * np.sqrt(b2):
            singular = True
            s22 = 1.0
        f = 1.0 / s22
        for k in range(first, n):
            q[k, 2] *= f
        if sweep == 0:
            r00, r01, r02, r11, r12, r22 = s00, s01, s02, s11, s12, s22
            if s11 > AGAIN * np.sqrt(b1) and s22 > AGAIN * np.sqrt(b2):
                break
            b0 = b1 = b2 = 1.0
        else:  # R = S R
            r02 = s00 * r02 + s01 * r12 + s02 * r22
            r01 = s00 * r01 + s01 * r11
            r12 = s11 * r12 + s12 * r22
            r00, r11, r22 = s00 * r00, s11 * r11, s22 * r22
    r[place, 0, 0], r[place, 0, 1], r[place, 0, 2] = r00, r01, r02
    r[place, 1, 1], r[place, 1, 2], r[place, 2, 2] = r11, r12, r22
    return first - n if singular else n - first


def _lines(
    values: Floats, table: Ints, starts: Small, k: int, row: int, e: int, scale: Floats, upper: Floats, lower: Floats, begins: Ints
) -> int:
    """Fill `upper` and `lower` with rows e and e + 1 of a block of chunk k, columns scaled; zeros for a row beyond the block.

    `begins` takes, for each part that is there, where it begins in the cluster, its width, and where it begins in the lines; returned is
    how many numbers that are.
    """
    m, parts = table[k, 0], table[k, 1]
    at, count = 0, 0
    factor = 1.0 if e + 1 < m else 0.0
    for j in range(parts):
        s = starts[table[k, 3] + row * parts + j]
        if table[k, HEAD + 2 + 3 * j] == 0 or s < 0:
            continue
        w = table[k, HEAD + 1 + 3 * j]
        base, o, begin = np.uint64(table[k, HEAD + 3 * j] + (row * m + e) * w), np.uint64(at), np.uint64(s)
        below = base + np.uint64(w if e + 1 < m else 0)
        for x in range(np.uint64(w)):
            f = scale[begin + x]
            upper[o + x] = values[base + x] * f
            lower[o + x] = values[below + x] * (f * factor)
        begins[count] = s
        begins[count + 1] = w
        begins[count + 2] = at
        at += w
        count += 3
    return count


def _lines_and_y(
    values: Floats, table: Ints, starts: Small, k: int, row: int, e: int, scale: Floats, upper: Floats, lower: Floats, begins: Ints,
    y: Floats, y0: int, width: int, q: Floats, n: int,
) -> int:  # fmt: skip
    """Do as `_lines`, and add Q'H of both rows (n and n + 1 of q) to three rows of Y from its element y0."""
    m, parts = table[k, 0], table[k, 1]
    at, count = 0, 0
    two = e + 1 < m
    factor = 1.0 if two else 0.0
    a0, a1, a2 = q[n, 0], q[n, 1], q[n, 2]
    n += 1 if two else 0
    b0, b1, b2 = q[n, 0], q[n, 1], q[n, 2]
    for j in range(parts):
        s = starts[table[k, 3] + row * parts + j]
        if table[k, HEAD + 2 + 3 * j] == 0 or s < 0:
            continue
        w = table[k, HEAD + 1 + 3 * j]
        base, o, begin = np.uint64(table[k, HEAD + 3 * j] + (row * m + e) * w), np.uint64(at), np.uint64(s)
        below = base + np.uint64(w if two else 0)
        t0 = np.uint64(y0 + s)
        t1 = t0 + np.uint64(width)
        t2 = t1 + np.uint64(width)
        for x in range(np.uint64(w)):
            f = scale[begin + x]
            u, v = values[base + x] * f, values[below + x] * (f * factor)
            upper[o + x] = u
            lower[o + x] = v
            y[t0 + x] += a0 * u + b0 * v
            y[t1 + x] += a1 * u + b1 * v
            y[t2 + x] += a2 * u + b2 * v
        begins[count] = s
        begins[count + 1] = w
        begins[count + 2] = at
        at += w
        count += 3
    return count


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


def _accumulate(clusters: Ints, front: Floats, y: Floats, rhs: Floats, b: Any, r: Floats, bad: NDArray[np.bool_], size: Ints) -> None:
    """Add H'H - Y'Y of clusters to the lower triangle of a front, and what A'y leaves to `rhs`; store the triangular factors (P, 3, 3)."""
    table, first_block, chunk, first_point, first_column = b.table, b.first_block, b.chunk, b.first_point, b.first_column
    cluster_rows, is_sparse, inverse = b.cluster_rows, b.sparse, b.inverse
    values, starts, row, point_inverse, prior, scalar = b.values, b.starts, b.row, b.point_inverse, b.prior, b.scalar
    q, left = np.empty((size[0], 3)), np.empty(size[0] + 1)
    buffer, square, scale, right = np.empty(size[1]), np.empty(size[2]), np.empty(size[2]), np.empty(size[2])
    stack, begins = np.empty((size[3], 2), np.int64), np.empty(3 * size[4], np.int64)
    upper, lower = np.empty(size[5]), np.empty(size[5])
    for c in clusters:
        offset = first_column[c]
        width = first_column[c + 1] - offset
        sparse = is_sparse[c]
        height = 3 if sparse else 3 * (first_point[c + 1] - first_point[c])
        stride = np.uint64(width)
        for x in range(width):
            scale[x] = inverse[offset + x]
            right[x] = 0.0
        lines = buffer[: height * width]
        lines[:] = 0.0
        own = square[: width * width]
        own[:] = 0.0
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
            y0 = 0 if sparse else 3 * (p - first_point[c]) * width
            n = touched = 0
            for i in range(first_block[p], first_block[p + 1]):
                k = chunk[i]
                m = table[k, 0]
                for e in range(0, m, 2):
                    count = _lines_and_y(values, table, starts, k, row[i], e, scale, upper, lower, begins, lines, y0, width, q, n)
                    d0 = left[n] - (q[n, 0] * t0 + q[n, 1] * t1 + q[n, 2] * t2)
                    d1 = 0.0
                    if e + 1 < m:
                        d1 = left[n + 1] - (q[n + 1, 0] * t0 + q[n + 1, 1] * t1 + q[n + 1, 2] * t2)
                    n += min(2, m - e)
                    if sparse and e == 0:
                        touched = _touch(stack, touched, begins, count)
                    for g in range(0, count, 3):
                        to, o = np.uint64(begins[g]), np.uint64(begins[g + 2])
                        for x in range(np.uint64(begins[g + 1])):
                            right[to + x] += upper[o + x] * d0 + lower[o + x] * d1
                        for g2 in range(0, count, 3):
                            if begins[g2] > begins[g]:
                                continue
                            to = np.uint64(begins[g] * width + begins[g2])
                            o, o2 = np.uint64(begins[g + 2]), np.uint64(begins[g2 + 2])
                            for x in range(np.uint64(begins[g + 1])):
                                u, v = upper[o + x], lower[o + x]
                                for x2 in range(np.uint64(begins[g2 + 1])):
                                    own[to + x2] += u * upper[o2 + x2] + v * lower[o2 + x2]
                                to += stride
            if sparse:
                for g in range(touched):
                    for g2 in range(touched):
                        if stack[g2, 0] <= stack[g, 0]:
                            to = np.uint64(stack[g, 0] * width + stack[g2, 0])
                            s2 = np.uint64(stack[g2, 0])
                            for x in range(np.uint64(stack[g, 0]), np.uint64(stack[g, 0] + stack[g, 1])):
                                u0, u1, u2 = lines[x], lines[x + stride], lines[x + stride + stride]
                                for x2 in range(np.uint64(stack[g2, 1])):
                                    own[to + x2] -= (
                                        u0 * lines[s2 + x2] + u1 * lines[s2 + stride + x2] + u2 * lines[s2 + stride + stride + x2]
                                    )
                                to += stride
                for g in range(touched):
                    for a in range(3):
                        for x in range(a * width + stack[g, 0], a * width + stack[g, 0] + stack[g, 1]):
                            lines[x] = 0.0
        if width == 0:
            continue
        if not sparse:
            table_of_y = lines.reshape((height, width))
            own -= np.dot(table_of_y.T, table_of_y).reshape(width * width)
        for x in range(width):
            fx = cluster_rows[offset + x]
            rhs[fx] += right[x]
            for x2 in range(x + 1):
                front[fx, cluster_rows[offset + x2]] += own[x * width + x2]


def _statistics(clusters: Ints, z: Floats, b: Any, hat: Floats, points: Floats, place: Ints, size: Ints) -> None:
    """Store the diagonal blocks of A N^-1 A', or only their diagonals, and in their places the cofactors of the points of clusters.

    They come from the inverse z of the front of the clusters.
    """
    table, first_block, chunk, row, first_point, first_column = b.table, b.first_block, b.chunk, b.row, b.first_point, b.first_column
    values, starts, prior = b.values, b.starts, b.prior
    cluster_rows, is_sparse, inverse, point_inverse, hats = b.cluster_rows, b.sparse, b.inverse, b.point_inverse, b.hat
    q_all = np.empty((size[6], 3))
    inner, core = np.empty((3, 3)), np.empty((3, 3))
    buffer, product, square, scale = np.empty(size[1]), np.empty(size[1]), np.empty(size[2]), np.empty(size[2])
    triangles, rows = np.empty((size[7], 3, 3)), np.empty(size[7], np.int64)
    stack, begins = np.empty((size[3], 2), np.int64), np.empty(3 * size[4], np.int64)
    upper, lower, more_upper, more_lower = np.empty(size[5]), np.empty(size[5]), np.empty(size[5]), np.empty(size[5])
    zh0, zh1, mixed = np.empty(size[5]), np.empty(size[5]), np.empty((3, 2))
    for c in clusters:
        offset = first_column[c]
        width = first_column[c + 1] - offset
        sparse = is_sparse[c]
        height = 3 if sparse else 3 * (first_point[c + 1] - first_point[c])
        stride = np.uint64(width)
        local = square[: width * width]
        for x in range(width):
            scale[x] = inverse[offset + x]
            fx = cluster_rows[offset + x]
            for x2 in range(width):
                local[x * width + x2] = z[fx, cluster_rows[offset + x2]]
        y = buffer[: height * width]
        y[:] = 0.0
        t_all = product[: height * width]
        begin_q = 0
        for step in range(2):
            if step == 0 and sparse:
                continue
            if step == 1 and not sparse:
                if width > 0:
                    np.dot(y.reshape((height, width)), local.reshape((width, width)), t_all.reshape((height, width)))
                begin_q = 0
            for p in range(first_point[c], first_point[c + 1]):
                y0 = 0 if sparse else 3 * (p - first_point[c]) * width
                at_r = 0 if sparse else p - first_point[c]
                touched = 0
                if sparse:
                    begin_q = 0
                if step == 0 or sparse:
                    n = _factor_point(p, values, table, first_block, chunk, row, point_inverse, prior, q_all, begin_q, triangles, at_r)
                    rows[at_r] = abs(n)
                    n = begin_q
                    for i in range(first_block[p], first_block[p + 1]):
                        k = chunk[i]
                        m = table[k, 0]
                        for e in range(0, m, 2):
                            count = _lines_and_y(values, table, starts, k, row[i], e, scale, upper, lower, begins, y, y0, width, q_all, n)
                            n += min(2, m - e)
                            if sparse and e == 0:
                                touched = _touch(stack, touched, begins, count)
                    if step == 0:
                        begin_q += rows[at_r]
                        continue
                if sparse:
                    for g in range(touched):
                        for x in range(stack[g, 0], stack[g, 0] + stack[g, 1]):
                            t_all[x] = t_all[width + x] = t_all[2 * width + x] = 0.0
                    for g2 in range(touched):
                        for x2 in range(np.uint64(stack[g2, 0]), np.uint64(stack[g2, 0] + stack[g2, 1])):
                            u0, u1, u2 = y[x2], y[x2 + stride], y[x2 + stride + stride]
                            for g in range(touched):
                                for x in range(np.uint64(stack[g, 0]), np.uint64(stack[g, 0] + stack[g, 1])):
                                    value = local[x2 * stride + x]
                                    t_all[x] += u0 * value
                                    t_all[stride + x] += u1 * value
                                    t_all[stride + stride + x] += u2 * value
                for a in range(3):
                    for a2 in range(a + 1):
                        total = 1.0 if a == a2 else 0.0
                        o, o2 = np.uint64(y0 + a * width), np.uint64(y0 + a2 * width)
                        if sparse:
                            for g in range(touched):
                                for x in range(np.uint64(stack[g, 0]), np.uint64(stack[g, 0] + stack[g, 1])):
                                    total += t_all[o + x] * y[o2 + x]
                        else:
                            s0 = s1 = s2 = s3 = 0.0
                            quarter = stride // np.uint64(4) * np.uint64(4)
                            for x in range(np.uint64(0), quarter, np.uint64(4)):
                                s0 += t_all[o + x] * y[o2 + x]
                                s1 += t_all[o + x + np.uint64(1)] * y[o2 + x + np.uint64(1)]
                                s2 += t_all[o + x + np.uint64(2)] * y[o2 + x + np.uint64(2)]
                                s3 += t_all[o + x + np.uint64(3)] * y[o2 + x + np.uint64(3)]
                            for x in range(quarter, stride):
                                s0 += t_all[o + x] * y[o2 + x]
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
                        total = 0.0
                        for x in range(3):
                            for x2 in range(3):
                                total += inner[a, x] * core[x, x2] * inner[a2, x2]
                        points[place[p], a, a2] = total * point_inverse[p, a] * point_inverse[p, a2]
                n = begin_q
                for i in range(first_block[p], first_block[p + 1]):
                    k = chunk[i]
                    m = table[k, 0]
                    whole = hats[k, 1] == m * m
                    out = hats[k, 0] + row[i] * hats[k, 1]
                    for e2 in range(0, m, 2):  # two columns of the block at once
                        count = _lines(values, table, starts, k, row[i], e2, scale, upper, lower, begins)
                        for x in range(size[5]):
                            zh0[x] = zh1[x] = 0.0
                        for a in range(3):
                            mixed[a, 0] = mixed[a, 1] = 0.0
                        for g2 in range(0, count, 3):
                            o2 = np.uint64(begins[g2 + 2])
                            from_row = np.uint64(begins[g2]) * stride
                            t0 = np.uint64(y0 + begins[g2])
                            for x2 in range(np.uint64(begins[g2 + 1])):
                                u, v = upper[o2 + x2], lower[o2 + x2]
                                for g in range(0, count, 3):
                                    o, s = np.uint64(begins[g + 2]), from_row + np.uint64(begins[g])
                                    for x in range(np.uint64(begins[g + 1])):
                                        value = local[s + x]
                                        zh0[o + x] += u * value
                                        zh1[o + x] += v * value
                                from_row += stride
                                f0, f1, f2 = t_all[t0 + x2], t_all[t0 + x2 + stride], t_all[t0 + x2 + stride + stride]
                                mixed[0, 0] += f0 * u
                                mixed[0, 1] += f0 * v
                                mixed[1, 0] += f1 * u
                                mixed[1, 1] += f1 * v
                                mixed[2, 0] += f2 * u
                                mixed[2, 1] += f2 * v
                        for e in range(0, m, 2):
                            if e != e2:
                                if not whole:
                                    continue
                                count = _lines(values, table, starts, k, row[i], e, scale, more_upper, more_lower, begins)
                            end = begins[count - 1] + begins[count - 2] if count else 0
                            for d in range(min(2, m - e)):
                                for d2 in range(min(2, m - e2)):
                                    if d != d2 and not whole:
                                        continue
                                    if e == e2 and d == 0:
                                        own = upper
                                    elif e == e2:
                                        own = lower
                                    elif d == 0:
                                        own = more_upper
                                    else:
                                        own = more_lower
                                    other = zh0 if d2 == 0 else zh1
                                    total = 0.0
                                    for x in range(end):
                                        total += own[x] * other[x]
                                    for a in range(3):
                                        # Q core Q' - Q T H' of this element; the other mixed term belongs to its mirror image
                                        part = -2.0 * mixed[a, d2]
                                        for a2 in range(3):
                                            part += core[a, a2] * q_all[n + e2 + d2, a2]
                                        total += q_all[n + e + d, a] * part
                                    hat[out + ((e + d) * m + e2 + d2 if whole else e + d)] = total
                    for e in range(m if whole else 0):  # both mixed terms are their mean
                        for e2 in range(e):
                            mean = 0.5 * (hat[out + e * m + e2] + hat[out + e2 * m + e])
                            hat[out + e * m + e2] = hat[out + e2 * m + e] = mean
                    n += m
                if sparse:
                    for g in range(touched):
                        for a in range(3):
                            for x in range(a * width + stack[g, 0], a * width + stack[g, 0] + stack[g, 1]):
                                y[x] = 0.0
                else:
                    begin_q += rows[at_r]


def _forward(clusters: Ints, y: Floats, b: Any, r: Floats, out: Floats) -> None:
    """Add to `out`, the rows of a front, what A'y leaves for it when the points of clusters are eliminated."""
    values, table, starts, first_block, chunk, row = b.values, b.table, b.starts, b.first_block, b.chunk, b.row
    first_point, first_column, cluster_rows = b.first_point, b.first_column, b.cluster_rows
    inverse, point_inverse, scalar = b.inverse, b.point_inverse, b.scalar
    for c in clusters:
        offset = first_column[c]
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
                        h = np.uint64(table[k, HEAD + 3 * j] + (row[i] * m + e) * w)
                        to = np.uint64(offset + s)
                        for x in range(np.uint64(w)):
                            out[cluster_rows[to + x]] += values[h + x] * inverse[to + x] * left


def _backward(clusters: Ints, solution: Floats, y: Floats, b: Any, r: Floats, points: Floats, change: Floats) -> None:
    """From the scaled solution of the reduced system store the (P, 3) unknowns of the points of clusters, and their rows of A x."""
    values, table, starts, first_block, chunk, row = b.values, b.table, b.starts, b.first_block, b.chunk, b.row
    first_point, first_column, columns = b.first_point, b.first_column, b.cluster_columns
    inverse, point_inverse, scalar = b.inverse, b.point_inverse, b.scalar
    for c in clusters:
        offset = first_column[c]
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
                        h = np.uint64(table[k, HEAD + 3 * j] + (row[i] * m + e) * w)
                        to = np.uint64(offset + s)
                        for x in range(np.uint64(w)):
                            total += values[h + x] * (solution[columns[to + x]] * inverse[to + x])
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
    x /= r[p, 0, 0]
    y = (y - r[p, 0, 1] * x) / r[p, 1, 1]
    z = (z - r[p, 0, 2] * x - r[p, 1, 2] * y) / (r[p, 2, 2] * r[p, 2, 2])
    y = (y - r[p, 1, 2] * z) / r[p, 1, 1]
    x = (x - r[p, 0, 1] * y - r[p, 0, 2] * z) / r[p, 0, 0]
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


INNER = (_factor_point, _lines, _lines_and_y, _touch, _solved)
OUTER = (_accumulate, _statistics, _forward, _backward, _extend, _gather)
