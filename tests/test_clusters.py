"""Clusters of object points: the compiled loops against their NumPy twins, and what a cluster is."""

import numpy as np
import pytest

from baarda.adjustment import cluster_loops, clusters
from baarda.adjustment.cluster_loops import RowNodes
from baarda.adjustment.clusters import clusters_of, starts_in_clusters


def row_blocks(points, nodes, seed, chunks=2):
    """Return random row blocks in chunks of two and three parts; neighbouring points see neighbouring nodes, some see none."""
    rng = np.random.default_rng(seed)
    count = rng.integers(0, 6, points)
    point = np.repeat(np.arange(points), count)
    chunk = rng.integers(0, chunks, len(point)).astype(np.int32)
    row, tables = np.zeros(len(point), dtype=np.int32), []
    for k in range(chunks):
        own = np.flatnonzero(chunk == k)
        row[own] = rng.permutation(len(own))
        table = np.full((len(own), 2 + k), -1, dtype=np.int32)
        near = point[own] * nodes // max(points, 1) + rng.integers(-2, 3, len(own))
        table[row[own], 0] = np.where(rng.random(len(own)) < 0.1, -1, np.clip(near, 0, nodes - 1))
        tables.append(table)
    parts = np.array([t.shape[1] for t in tables], dtype=np.intp)
    place = np.cumsum([0, *(t.size for t in tables)], dtype=np.intp)
    flat = np.concatenate([t.ravel() for t in tables])
    return RowNodes(np.concatenate([[0], np.cumsum(count)]).astype(np.intp), chunk, row, flat, place, parts)


def found(blocks, width, compiled, monkeypatch):
    monkeypatch.setattr(cluster_loops, "COMPILE_FROM", 0 if compiled else 10**9)
    first, members, ends, sparse = clusters_of(blocks, width)
    column = np.concatenate([[0], np.cumsum(width[members])])
    own = column[:-1] - np.repeat(column[ends[:-1]], np.diff(ends))
    return first, members, ends, sparse, starts_in_clusters(blocks, first, members, ends, own, width, 2)


@pytest.mark.parametrize(("most", "largest"), [(40, 700_000), (1024, 700_000), (1024, 5_000)])
@pytest.mark.parametrize("points", [0, 1, 16, 17, 3000])
def test_loops_and_twins_find_the_same(points, most, largest, monkeypatch):
    if cluster_loops.compiled() is None:
        pytest.skip("numba is not installed")
    monkeypatch.setattr(clusters, "MOST", most)
    monkeypatch.setattr(clusters, "LARGEST", largest)
    monkeypatch.setattr(clusters, "SPARSE", 1.2)
    monkeypatch.setattr(clusters, "SHARE", 7)
    blocks, width = row_blocks(points, 50, points), np.random.default_rng(1).integers(1, 9, 50)
    for a, b in zip(*(found(blocks, width, compiled, monkeypatch) for compiled in (False, True)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_cluster_holds_every_node_that_its_points_touch(compiled, monkeypatch):
    blocks, width = row_blocks(2000, 40, 5), np.full(40, 6)
    first, members, ends, sparse, starts = found(blocks, width, compiled, monkeypatch)
    assert first[0] == 0
    assert first[-1] == 2000
    assert np.all(np.diff(first) > 0)
    assert len(sparse) == len(first) - 1 > 3
    for c, (a, b) in enumerate(zip(blocks.first[first[:-1]], blocks.first[first[1:]], strict=True)):
        touched, begins = set(), set()
        for i in range(a, b):
            k = blocks.chunk[i]
            touched |= set(blocks.of_chunk(k)[blocks.row[i]].tolist())
            at = blocks.place[k] + blocks.row[i] * blocks.parts[k] + np.arange(blocks.parts[k])
            begins |= set(zip(blocks.nodes[at].tolist(), starts[at].tolist(), strict=True))
        own = members[ends[c] : ends[c + 1]].tolist()
        assert own == sorted(touched - {-1})
        assert begins - {(-1, -1)} == {(node, 6 * j) for j, node in enumerate(own)}


@pytest.mark.parametrize("compiled", [False, True])
def test_clusters_are_limited_in_size(compiled, monkeypatch):
    """Points times columns, unless the smallest cluster exceeds the limit already; without it clusters are larger."""
    blocks, width = row_blocks(3000, 20, 6), np.full(20, 6)
    largest = []
    for limit in (5_000, 700_000):
        monkeypatch.setattr(clusters, "LARGEST", limit)
        first, members, ends, _, _ = found(blocks, width, compiled, monkeypatch)
        columns = np.add.reduceat(width[members], ends[:-1])
        largest.append(int((columns * np.diff(first)).max()))
    assert largest[0] <= 5_000 < largest[1]


@pytest.mark.parametrize("compiled", [False, True])
def test_wide_clusters_of_points_that_touch_little_are_sparse(compiled, monkeypatch):
    blocks, width = row_blocks(2000, 200, 7), np.full(200, 6)
    monkeypatch.setattr(clusters, "OVERHEAD", 10**6)  # few, wide ones
    assert found(blocks, width, compiled, monkeypatch)[3].any()
    monkeypatch.setattr(clusters, "SPARSE", 1e9)
    assert not found(blocks, width, compiled, monkeypatch)[3].any()
