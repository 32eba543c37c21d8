"""Nested dissection: an order of elimination that keeps the fronts of a sparse system small (George 1973)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_bipartite_matching

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

LEAF = 16  # nodes that are not worth dissecting further


def dissect(graph: Any, coordinates: Floats | None = None, leaf: int = LEAF) -> list[Ints]:
    """Split the nodes of a graph into parts, separators after the two sides that they separate.

    Parameters
    ----------
    graph : (n, n) sparse matrix
        Symmetric; an entry joins two nodes.
    coordinates : (n, d) array, optional
        Places of the nodes, by which they are halved; NaN = unknown. Without them halves grow along the graph.
    leaf : int
        Parts of this size are not split further.

    Returns
    -------
    list of int arrays
        The parts in the order of elimination; together they hold every node once.

    Notes
    -----
    Nodes joined to more than half of the others come last. Each half is cut off by the smallest vertex cover of the edges between the
    halves (König's theorem on a maximum matching). A part whose separator would be nearly as large as its smaller side is left whole:
    its fronts are dense anyway.

    Examples
    --------
    >>> from scipy.sparse import eye_array
    >>> path = eye_array(9, k=1) + eye_array(9, k=-1)
    >>> [part.tolist() for part in dissect(path, np.arange(9.0)[:, None], leaf=5)]
    [[0, 1, 2], [4, 5, 6, 7, 8], [3]]
    """
    graph = csr_array(graph)
    n = graph.shape[0]
    places = np.full((n, 0), np.nan) if coordinates is None else np.asarray(coordinates, dtype=float)
    if n and not np.isfinite(places).all():
        places = np.zeros((n, 0))
    hub = np.diff(graph.indptr) > max(leaf, n // 2)  # joined to most others, as a camera of all images is: eliminated last
    if n and hub.all():
        return [np.arange(n)]
    return [part for part in (*_parts(graph, places, np.flatnonzero(~hub), leaf), np.flatnonzero(hub)) if len(part)]


def _parts(graph: Any, places: Floats, nodes: Ints, leaf: int) -> Iterator[Ints]:
    stack: list[tuple[Ints, bool]] = [(nodes, True)]
    out: list[Ints] = []  # filled backwards: separators first
    while stack:
        nodes, divisible = stack.pop()
        if not divisible or len(nodes) <= leaf:
            out.append(nodes)
            continue
        local = graph[nodes][:, nodes]
        count, labels = connected_components(local, directed=False)
        if count > 1:
            sizes = np.bincount(labels)
            first = np.isin(labels, np.argsort(-sizes, kind="stable")[::2])
            stack.append((nodes[first], True))
            stack.append((nodes[~first], True))
            continue
        found = _separate(local, places[nodes])
        if found is None:
            out.append(nodes)
            continue
        left, right, middle = found
        out.append(nodes[middle])
        stack.append((nodes[left], True))
        stack.append((nodes[right], True))
    yield from reversed(out)


def _separate(graph: Any, places: Floats) -> tuple[Ints, Ints, Ints] | None:
    """Return the two sides and the separator of the best halving, None where none is worth while."""
    n = graph.shape[0]
    best = None
    for key in _halvings(graph, places):
        order = np.argsort(key, kind="stable")
        side = np.zeros(n, dtype=bool)
        side[order[n // 2 :]] = True
        middle = _vertex_cover(graph, side)
        left = np.flatnonzero(~side & ~middle)
        right = np.flatnonzero(side & ~middle)
        smaller = min(len(left), len(right))
        if smaller and (best is None or middle.sum() / smaller < best[0]):
            best = (middle.sum() / smaller, left, right, np.flatnonzero(middle))
    if best is None or best[0] > 0.9:
        return None
    return best[1], best[2], best[3]


def _halvings(graph: Any, places: Floats) -> Iterator[Floats]:
    """Yield keys by which to halve: coordinates along the principal axes, or else the distance from a remote node."""
    if places.shape[1]:
        centred = places - places.mean(axis=0)
        sizes, axes = np.linalg.eigh(centred.T @ centred)
        for k in np.flatnonzero(sizes > 0.05 * max(sizes[-1], 1e-300))[::-1]:
            yield centred @ axes[:, k]
    else:
        start = 0
        for _ in range(2):  # from a node as far away as possible
            start = int(breadth_first_order(graph, start, directed=False, return_predecessors=False)[-1])
        order = breadth_first_order(graph, start, directed=False, return_predecessors=False)
        key = np.empty(graph.shape[0])
        key[order] = np.arange(len(order))
        yield key


def _vertex_cover(graph: Any, side: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the smallest set of nodes that touches every edge between the two sides."""
    left, right = np.flatnonzero(~side), np.flatnonzero(side)
    cut = csr_matrix(graph[left][:, right])
    match = maximum_bipartite_matching(cut, perm_type="column")  # of each left node its right node, -1 = none
    partner = np.full(len(right), -1)
    partner[match[match >= 0]] = np.flatnonzero(match >= 0)
    reached_left = (match < 0) & (np.diff(cut.indptr) > 0)
    reached_right = np.zeros(len(right), dtype=bool)
    frontier, neighbours = reached_left, cut.T.astype(float)  # products of doubles are the quick ones
    while frontier.any():
        new = (neighbours @ frontier.astype(float) > 0.0) & ~reached_right
        reached_right |= new
        frontier = np.zeros(len(left), dtype=bool)
        frontier[partner[new & (partner >= 0)]] = True
        frontier &= ~reached_left
        reached_left |= frontier
    cover = np.zeros(graph.shape[0], dtype=bool)
    cover[left[~reached_left & (np.diff(cut.indptr) > 0)]] = True
    cover[right[reached_right]] = True
    return cover
