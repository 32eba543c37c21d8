"""The compiled loops over object points against their NumPy twins and dense algebra, for row blocks of any height and width."""

from types import SimpleNamespace

import numpy as np
import pytest

from baarda.adjustment import kernels
from baarda.adjustment import point_loop_twins as twins
from baarda.adjustment.row_blocks import Blocks, sizes

pytest.importorskip("numba")

POINTS, RAYS, FRONT = 7, 4, 40
WIDTHS = (6, 4, 3)  # of the nodes of a block's parts; two nodes of each in a cluster


def blocks(m: int, sparse: bool) -> tuple[Blocks, np.ndarray, np.ndarray]:
    """Return two clusters of points with blocks of m rows, the buffers' sizes, and the dense design matrix of the nodes, scaled."""
    rng = np.random.default_rng(m)
    count, total = POINTS * RAYS, 2 * sum(WIDTHS)
    first_point = np.array([0, 3, POINTS])
    values, table, at = [rng.normal(size=count * m * 3)], [m, 1 + len(WIDTHS), 0, 0, 0, 0, 3, 0], count * m * 3
    starts, begin = [np.full(count, -1)], 0
    for w in WIDTHS:
        values.append(rng.normal(size=count * m * w))
        table += [at, w, 1]
        starts.append(begin + w * rng.integers(2, size=count))
        at, begin = at + count * m * w, begin + 2 * w
    starts[-1][::3] = -1  # not there
    inverse = rng.uniform(0.5, 2.0, 2 * total)
    inverse[3] = inverse[total + 7] = 0.0  # held
    rows = np.concatenate([np.sort(rng.choice(FRONT, total, replace=False)) for _ in range(2)])
    b = Blocks(
        values=np.concatenate(values), table=np.array([table], dtype=np.intp), starts=np.stack(starts, axis=1).ravel().astype(np.int32),
        first_block=np.arange(POINTS + 1) * RAYS, chunk=np.zeros(count, dtype=np.int32), row=np.arange(count, dtype=np.int32),
        first_point=first_point, first_column=np.array([0, total, 2 * total]), cluster_rows=rows.astype(np.int32),
        cluster_columns=rows.astype(np.intp), sparse=np.array([sparse, sparse]), inverse=inverse,
        point_inverse=rng.uniform(0.5, 2.0, (POINTS, 3)), prior=np.full((POINTS, 3), 0.1), hat=np.array([[0, m * m]]),
        scalar=np.arange(count) * m,
    )  # fmt: skip
    structure = SimpleNamespace(
        first_point=first_point, first_column=b.first_column, sparse=b.sparse, first_block=b.first_block, most_rows=RAYS
    )
    design = np.zeros((count * m, FRONT))
    for i in range(count):
        cluster = int(i // RAYS >= first_point[1])
        for j, w in enumerate(WIDTHS):
            s = int(starts[j + 1][i])
            if s >= 0:
                own = values[j + 1].reshape(count, m, w)[i] * inverse[cluster * total + s : cluster * total + s + w]
                design[i * m : (i + 1) * m, rows[cluster * total + s : cluster * total + s + w]] += own
    return b, sizes(structure, b), design


CASES = [(m, sparse) for m in (1, 2, 3, 5) for sparse in (False, True)]


@pytest.mark.parametrize(("m", "sparse"), CASES)
def test_reduced_matrix_and_right_hand_sides(m, sparse):
    b, size, design = blocks(m, sparse)
    y = np.random.default_rng(9).normal(size=len(design))
    fronts, factors, sides = [], [], np.zeros(FRONT)
    for loop in (kernels.compiled().accumulate, twins.accumulate):
        front, r, bad, rhs = np.zeros((FRONT, FRONT)), np.zeros((POINTS, 3, 3)), np.ones(POINTS, dtype=bool), np.zeros(FRONT)
        loop(np.arange(2), front, y, rhs, b, r, bad, size)
        assert not bad.any()
        fronts.append(front)
        factors.append(r)
        sides += rhs  # the twin leaves them to others
    np.testing.assert_allclose(fronts[0], fronts[1], atol=1e-12 * np.abs(fronts[1]).max())
    np.testing.assert_allclose(factors[0], factors[1], atol=1e-13)
    g = np.concatenate(
        [b.values[: 3 * len(design)].reshape(POINTS, -1, 3) * b.point_inverse[:, None, :], b.prior[:, :, None] * np.eye(3)], axis=1
    )
    left = np.concatenate([y.reshape(POINTS, -1), np.zeros((POINTS, 3))], axis=1)
    left -= np.einsum("pij,pj->pi", g @ np.linalg.pinv(g), left)
    expected = design.T @ left[:, :-3].ravel()
    np.testing.assert_allclose(sides, expected, atol=1e-12 * np.abs(expected).max())
    again = np.zeros(FRONT)
    kernels.compiled().forward(np.arange(2), y, b, factors[0], again)
    np.testing.assert_allclose(again, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize(("m", "sparse"), CASES)
def test_statistics(m, sparse, whole):
    b, size, _ = blocks(m, sparse)
    each = m * m if whole else m
    b = b._replace(hat=np.array([[0, each]]))
    place = np.random.default_rng(9).permutation(POINTS)
    root = np.random.default_rng(8).normal(size=(FRONT, FRONT))
    found = []
    for loop in (kernels.compiled().statistics, twins.statistics):
        hat, points = np.zeros(POINTS * RAYS * each), np.zeros((POINTS, 3, 3))
        loop(np.arange(2), root @ root.T, b, hat, points, place, size)
        found.append((hat, points))
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-11 * np.abs(theirs).max())


def test_solution():
    b, size, design = blocks(3, False)
    y, solution = np.random.default_rng(7).normal(size=len(design)), np.random.default_rng(6).normal(size=FRONT + 1)
    r, bad = np.zeros((POINTS, 3, 3)), np.zeros(POINTS, dtype=bool)
    kernels.compiled().accumulate(np.arange(2), np.zeros((FRONT, FRONT)), y, np.zeros(FRONT), b, r, bad, size)
    points, change = np.zeros((POINTS, 3)), np.zeros(len(y))
    kernels.compiled().backward(np.arange(2), solution, y, b, r, points, change)
    own = (design @ solution[:-1]).reshape(POINTS, -1)
    g = b.values[: 3 * len(y)].reshape(POINTS, -1, 3)
    normal = np.einsum("pni,pnj->pij", g, g) + np.eye(3) * (b.prior / b.point_inverse)[:, :, None] ** 2
    expected = np.linalg.solve(normal, np.einsum("pni,pn->pi", g, y.reshape(POINTS, -1) - own)[:, :, None])[:, :, 0]
    np.testing.assert_allclose(points, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(change, (own + np.einsum("pni,pi->pn", g, expected)).ravel(), atol=1e-12 * np.abs(change).max())
