"""The row blocks of the points that are eliminated, as plain arrays for the loops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.linear_system import Chunk, Linearization, split
from baarda.adjustment.structure import Structure
from baarda.adjustment.workers import scratch

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Small = NDArray[np.int32]

HEAD = 5  # entries of a chunk's row in the table before those of its parts


class Blocks(NamedTuple):
    """The row blocks of the inner points as plain arrays.

    Attributes
    ----------
    values : array
        The stored partials that the loops need, and those evaluated for some points: see `with_partials`.
    table : (chunks, 5 + 3 parts) int array
        For each chunk the rows m of a block, the number of parts, where the partials of the point, the places of the blocks and their
        scalar rows begin, and for each part where its partials begin, its width, and whether it is a node.
    starts : int32 array
        Where the columns of each part of each block begin in its cluster, -1 = not there.
    first_block, chunk, row, first_point, first_column, cluster_rows, cluster_columns, sparse
        Of the structure.
    inverse : array
        Inverse column scales of the columns of all clusters; 0 = held.
    point_inverse : (P, 3) array
    prior : (P, 3) array
        A further row for each coordinate of a point: damping, or 1 where the coordinate is held.
    hat : (chunks, 2) int array
        Where the diagonal blocks of A N^-1 A' of each chunk begin, and the numbers stored of each: see `hats_of`.
    scalar : int32 or int array
        First scalar row of each row block, chunk after chunk.
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
    cluster_columns: Ints
    sparse: NDArray[np.bool_]
    inverse: Floats
    point_inverse: Floats
    prior: Floats
    hat: Ints
    scalar: Ints | Small


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
    point_inverse = inverse[structure.point_columns]
    prior = np.where(point_inverse > 0.0, np.sqrt(damping), 1.0)
    columns = structure.order[structure.cluster_columns]
    scalar = lin.chunks[0].first if len(lin.chunks) == 1 else np.concatenate([np.zeros(0, dtype=np.int32), *(c.first for c in lin.chunks)])
    return Blocks(
        lin.values, table_of(lin, structure),
        structure.starts, structure.first_block, structure.block_chunk, structure.block_row, structure.first_point,
        structure.first_column, structure.cluster_rows, structure.cluster_columns, structure.sparse, inverse[columns], point_inverse, prior,
        np.zeros((0, 2), dtype=np.intp), np.ascontiguousarray(scalar),
    )  # fmt: skip


def hats_of(lin: Linearization, whole: bool) -> tuple[Ints, int]:
    """Return where the diagonal blocks of A N^-1 A' of each chunk begin, the numbers stored of each, (chunks, 2), and the size of all.

    Parameters
    ----------
    lin : Linearization
    whole : bool
        Store the m x m numbers of all blocks; else only the m of their diagonals where the chunk is plain.
    """
    each = np.array([c.m if c.plain and not whole else c.m**2 for c in lin.chunks], dtype=np.intp)
    ends = np.cumsum([0, *(n * len(c.first) for n, c in zip(each, lin.chunks, strict=True))], dtype=np.intp)
    return np.stack([ends[:-1], each], axis=1), int(ends[-1])


def put_hat(hat: Floats, place: Ints, rows: Ints, values: Floats) -> None:
    """Store the diagonal blocks (N, m, m) of A N^-1 A' of some row blocks of a chunk, or only their diagonals, as `place` of it says."""
    begin, each = place
    own = values.reshape(len(values), -1) if each == values[:1].size else np.einsum("nii->ni", values)
    hat[begin + rows[:, None] * each + np.arange(each)] = own


def table_of(lin: Linearization, structure: Structure) -> Ints:
    """Return the table of `Blocks`; -1 for the places of partials that are not stored."""
    parts = max((len(c.parts) for c in lin.chunks), default=0)
    table = np.zeros((len(lin.chunks), HEAD + 3 * parts), dtype=np.intp)
    place, rows = 0, 0
    for k, (c, own) in enumerate(zip(lin.chunks, structure.point_part, strict=True)):
        table[k, :HEAD] = c.m, len(c.parts), c.parts[own].start if own >= 0 else -1, place, rows
        for j, p in enumerate(c.parts):
            table[k, HEAD + 3 * j : HEAD + 3 + 3 * j] = p.start, len(p.positions), j != own
        place += len(c.first) * len(c.parts)
        rows += len(c.first)
    return table


def with_partials(blocks: Blocks, lin: Linearization, spans: Ints) -> Blocks:
    """Return the arrays with the partials of some row blocks, evaluated where they are not stored, until this thread asks again.

    Parameters
    ----------
    blocks : Blocks
    lin : Linearization
    spans : (chunks, 2) int array
        The first and the last row block, that one not included, of each chunk.
    """
    if lin.stored:
        return blocks
    table, at = blocks.table.copy(), 0
    counts = spans[:, 1] - spans[:, 0]
    values = scratch("partials", sum(int(n) * c.per_block for n, c in zip(counts, lin.chunks, strict=True)))
    for k, (c, n) in enumerate(zip(lin.chunks, counts, strict=True)):
        if not n:
            continue
        begin, m = int(spans[k, 0]), c.m
        some, own = slice(begin, begin + int(n)), values[at : at + int(n) * c.per_block]
        if c.evaluate is not None:
            c.evaluate(some, own)
        else:
            for view, p in zip(split(own, int(n), m, [p.positions for p in c.parts]), c.parts, strict=True):
                view[...] = p.jacobian[some]
        for j, p in enumerate(c.parts):
            start = at - begin * m * len(p.positions)
            table[k, HEAD + 3 * j] = start
            if not table[k, HEAD + 2 + 3 * j]:
                table[k, 2] = start
            at += int(n) * m * len(p.positions)
    return blocks._replace(values=values, table=table)


def sizes(structure: Structure, blocks: Blocks) -> Ints:
    """Return the sizes of the loops' buffers.

    They are: rows of a point, Y, the square of a cluster, touched parts of a point, parts of a block, columns of a block, rows of a
    cluster, points of a cluster.
    """
    count = np.diff(structure.first_point)
    width = (np.diff(structure.first_column) + 7) // 8 * 8  # rows begin at a distance that the loops can divide
    height = np.where(structure.sparse, 3, (count + 1) // 2 * 6)
    table = blocks.table
    rows, parts = (int(a.max(initial=1)) for a in (table[:, 0], table[:, 1]))
    columns = int(table[:, HEAD + 1 :: 3].sum(axis=1).max(initial=1))
    most = structure.most_rows * rows + 6
    per_point = np.concatenate([[0], np.cumsum(np.diff(structure.first_block) * rows + 6)])
    in_cluster = np.where(structure.sparse, most, np.diff(per_point[structure.first_point]))
    return np.array(
        [
            most, int((width * height).max(initial=1)), int((width**2).max(initial=1)), structure.most_rows * parts + 1, parts, columns,
            int(in_cluster.max(initial=1)), int(count.max(initial=1)),
        ],
        dtype=np.intp,
    )  # fmt: skip


def scaled_rows(c: Chunk, rows: Ints, inverse: Floats) -> Floats:
    """Return the partials (N, m, w) of some row blocks of a chunk with scaled columns."""
    return np.concatenate([j * inverse[p.columns_of(rows)][:, None, :] for p, j in zip(c.parts, c.partials(rows), strict=True)], axis=2)
