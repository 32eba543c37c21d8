"""Nested dissection and the pattern of the block solver: every node once, separators separate, fronts hold what they must."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.csgraph import connected_components

from baarda.adjustment.dissection import _vertex_cover, dissect
from baarda.adjustment.point_order import rank_of_points


def graph_of(n, edges):
    a, b = np.array(edges, dtype=int).reshape(-1, 2).T
    at = np.concatenate([a, b, np.arange(n)]), np.concatenate([b, a, np.arange(n)])
    return csr_array(coo_array((np.ones(len(at[0])), at), shape=(n, n)))


def grid(rows, columns, reach=1):
    """Nodes of a grid, joined to all within a square; their places."""
    y, x = np.divmod(np.arange(rows * columns), columns)
    a, b = np.nonzero((np.abs(x[:, None] - x) <= reach) & (np.abs(y[:, None] - y) <= reach))
    return graph_of(rows * columns, np.column_stack([a, b])), np.column_stack([x, y]).astype(float)


def fill(graph, parts):
    """Return for each part the number of nodes of its front (its own and later ones that elimination joins to it), symbolically."""
    n = graph.shape[0]
    later = [set(graph[i].nonzero()[0 if graph[i].ndim == 1 else 1].tolist()) for i in range(n)]
    where = np.empty(n, dtype=int)
    for f, part in enumerate(parts):
        where[part] = f
    sizes, boundary_of = [], {}
    for f, part in enumerate(parts):
        reached = set().union(*(later[i] for i in part), *boundary_of.pop(f, []))
        front = {j for j in reached if where[j] >= f} | set(part.tolist())
        boundary = {j for j in front if where[j] > f}
        if boundary:
            boundary_of.setdefault(min(where[j] for j in boundary), []).append(boundary)
        sizes.append(len(front))
    return sizes


edges_of = st.integers(2, 60).flatmap(
    lambda n: st.tuples(st.just(n), st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=150))
)


@given(edges_of, st.integers(1, 12), st.booleans())
def test_every_node_once(case, leaf, placed):
    n, edges = case
    places = np.random.default_rng(n).random((n, 3)) if placed else None
    parts = dissect(graph_of(n, edges), places, leaf)
    assert all(len(p) for p in parts)
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(n))
    again = dissect(graph_of(n, edges), places, leaf)
    assert [p.tolist() for p in again] == [p.tolist() for p in parts]


@given(edges_of, st.booleans())
def test_a_vertex_cover_touches_every_edge_and_is_smallest(case, odd):
    n, edges = case
    graph = graph_of(n, edges)
    side = np.arange(n) % 2 == 1 if odd else np.arange(n) >= n // 2
    cover = _vertex_cover(graph, side)
    crossing = {(min(a, b), max(a, b)) for a, b in edges if side[a] != side[b]}
    assert all(cover[a] or cover[b] for a, b in crossing)
    # König: as many nodes as a matching has edges; a greedy matching is at least half a maximum one, at most the cover
    met, matched = set(), 0
    for a, b in sorted(crossing):
        if a not in met and b not in met:
            met |= {a, b}
            matched += 1
    assert matched <= cover.sum() <= 2 * matched


def test_separators_separate():
    """Whatever is eliminated before a separator on one side has no edge to the other side."""
    graph, places = grid(24, 24, 2)
    parts = dissect(graph, places)
    assert len(parts) > 15
    last = parts[-1]
    rest = np.setdiff1d(np.arange(graph.shape[0]), last)
    count, labels = connected_components(graph[rest][:, rest], directed=False)
    assert count >= 2
    assert np.bincount(labels).max() <= 0.65 * graph.shape[0]


@pytest.mark.parametrize("placed", [True, False])
def test_fronts_of_a_grid_stay_small(placed):
    """Of a k x k grid whose nodes join within a square of two the largest front has a few k nodes, not k^2."""
    for k in (16, 24, 32):
        graph, places = grid(k, k, 2)
        sizes = fill(graph, dissect(graph, places if placed else None))
        assert max(sizes) <= (9 if placed else 12) * k
    banded = fill(graph, [np.array([i]) for i in range(k * k)])
    assert sum(s**3 for s in sizes) < 20 * sum(s**2 for s in banded)


def test_coordinates_do_not_mislead_where_they_do_not_tell():
    """Places at random: nothing may be lost or repeated, though fronts grow."""
    graph, _ = grid(20, 20)
    parts = dissect(graph, np.random.default_rng(0).random((400, 3)))
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(400))


@pytest.mark.parametrize("leaf", [1, 4, 16])
def test_a_long_path(leaf):
    path = eye_array(500) + eye_array(500, k=1) + eye_array(500, k=-1)
    sizes = fill(csr_array(path), dissect(path, None, leaf))
    assert max(sizes) <= leaf + 6


def test_special_graphs():
    assert dissect(csr_array((0, 0))) == []
    assert [p.tolist() for p in dissect(csr_array((1, 1)))] == [[0]]
    complete = csr_array(np.ones((40, 40)))
    assert len(dissect(complete)) == 1
    star = graph_of(50, [(0, i) for i in range(1, 50)])
    parts = dissect(star, None, 4)
    assert parts[-1].tolist() == [0] or max(fill(star, parts)) <= 6
    apart = dissect(eye_array(100, format="csr"), None, 10)
    assert max(len(p) for p in apart) <= 10
    np.testing.assert_array_equal(np.sort(np.concatenate(apart)), np.arange(100))
    two = graph_of(60, [(i, j) for k in (0, 30) for i in range(k, k + 30) for j in range(k, k + 30)])
    assert sorted(len(p) for p in dissect(two)) == [30, 30]


def test_places_may_be_equal_or_unknown():
    graph, places = grid(12, 12)
    for some in (np.zeros((144, 3)), np.full((144, 3), np.nan), np.column_stack([places, np.full(144, np.nan)]), places * 0 + 1e6):
        parts = dissect(graph, some)
        np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(144))


@given(st.integers(0, 200), st.integers(0, 5))
def test_ranks_are_a_permutation(n, unknown):
    x = np.random.default_rng(n).normal(size=(n, 3)) * [1e6, 1e3, 1.0]
    x[: min(unknown, n)] = np.nan
    rank = rank_of_points(x)
    np.testing.assert_array_equal(np.sort(rank), np.arange(n))
    assert (rank[: min(unknown, n)] >= n - min(unknown, n)).all()  # unknown ones come last


def test_neighbours_in_rank_are_neighbours_in_space():
    """Along the curve the next point is near: on average within a few mean distances, whatever outliers there are."""
    rng = np.random.default_rng(0)
    x = rng.random((4000, 3)) * [1000.0, 1000.0, 20.0]
    x[:20] *= 1e4
    order = np.argsort(rank_of_points(x))
    inside = order[~np.isin(order, np.arange(20))]
    step = np.linalg.norm(np.diff(x[inside], axis=0), axis=1)
    mean_distance = np.sqrt(1e6 / 4000)
    assert np.median(step) < 2 * mean_distance
    assert step.mean() < 4 * mean_distance


def test_points_at_one_place():
    rank = rank_of_points(np.ones((5, 3)))
    np.testing.assert_array_equal(rank, np.arange(5))
