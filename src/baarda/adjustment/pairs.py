"""Any block of the inverse of the normal matrix, not only the selected ones: of control points with each other, say.

With the points eliminated, N^-1 = [Z, -Z W V^-1; ..., V^-1 + V^-1 W'Z W V^-1] from Z, the inverse of the reduced matrix: each column of an
object point acts on the nodes as the column -W V^-1, and only the reduced system, which is small, is solved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

if TYPE_CHECKING:
    from baarda.adjustment.block import BlockSolver

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

AT_ONCE = 16_000_000  # doubles in the right-hand sides that are solved together


def pairs(solver: BlockSolver, a: Ints, b: Ints) -> Floats:
    """Return the (len(a), len(b)) block of N^-1 for any columns; zero where a column is -1 or held.

    Parameters
    ----------
    solver : BlockSolver
    a, b : int arrays
        Unknowns.
    """
    structure, inverse = solver.structure, solver.inverse
    count = len(structure.order)
    place, point, axis = (np.full(len(inverse), -1) for _ in range(3))
    place[structure.order] = np.arange(count)
    point[structure.point_columns] = np.arange(len(structure.points))[:, None]
    axis[structure.point_columns] = np.arange(3)
    place[-1] = point[-1] = -1  # fixed parameters
    used = np.unique(point[np.concatenate([a, b])])
    used = used[used >= 0]
    onto, own = _eliminated(solver, used, place)

    def chosen(columns: Ints) -> tuple[Any, Any]:
        """Return what columns are on the nodes, (count, k), and among the coordinates of the points used."""
        at = np.where(place[columns] >= 0, place[columns], count + 3 * np.searchsorted(used, point[columns]) + axis[columns])
        there = np.flatnonzero((place[columns] >= 0) | (point[columns] >= 0))
        shape = (count + 3 * len(used), len(columns))
        which = sparse.csr_array((inverse[columns[there]], (at[there], there)), shape=shape)
        return which[:count] + onto @ which[count:], which[count:]

    (left, own_a), (right, own_b) = chosen(a), chosen(b)
    out = np.asarray((own_a.T @ own @ own_b).toarray())
    step, wanted = max(1, AT_ONCE // max(count, 1)), np.unique(left.nonzero()[0])
    for k in range(0, len(b), step):
        out[:, k : k + step] += left.T @ solver.solve_reduced(right[:, k : k + step].toarray(), wanted)
    return out


def _eliminated(solver: BlockSolver, points: Ints, place: Ints) -> tuple[Any, Any]:
    """Return -W V^-1 (count, 3 k) and V^-1 (3 k, 3 k) of some inner points, scaled and sparse."""
    structure, inverse = solver.structure, solver.inverse
    root = np.linalg.inv(solver.triangles[points])
    own = root @ root.transpose(0, 2, 1)
    first, last = structure.first_block[points], structure.first_block[points + 1]
    owners = np.repeat(np.arange(len(points)), last - first)
    blocks = np.arange(len(owners)) + np.repeat(first - np.cumsum(last - first) + (last - first), last - first)
    rows, columns, values = [], [], []
    for k in np.unique(structure.block_chunk[blocks]):
        some = structure.block_chunk[blocks] == k
        chunk, at, owner = solver.lin.chunks[k], structure.block_row[blocks[some]].astype(np.intp), owners[some]
        partials = [j * inverse[p.columns_of(at)][:, None, :] for p, j in zip(chunk.parts, chunk.partials(at), strict=True)]
        of_point = structure.point_part[k]
        share = partials[of_point] @ own[owner]  # (n, m, 3)
        for j, part in enumerate(chunk.parts):
            if j != of_point:
                product = -partials[j].transpose(0, 2, 1) @ share
                to = np.broadcast_to(place[part.columns_of(at)][:, :, None], product.shape)
                there = to >= 0
                rows.append(to[there])
                columns.append(np.broadcast_to(3 * owner[:, None, None] + np.arange(3), product.shape)[there])
                values.append(product[there])
    shape = (len(structure.order), 3 * len(points))
    nothing = np.zeros(0, dtype=np.intp)
    entries = (np.concatenate([np.zeros(0), *values]), (np.concatenate([nothing, *rows]), np.concatenate([nothing, *columns])))
    to = 3 * np.arange(len(points))[:, None, None] + np.arange(3)
    across, down = np.broadcast_to(to, own.shape), np.broadcast_to(to.transpose(0, 2, 1), own.shape)
    diagonal = sparse.csr_array((own.ravel(), (down.ravel(), across.ravel())), shape=(shape[1], shape[1]))
    return sparse.coo_array(entries, shape=shape).tocsr(), diagonal
