"""Whether a block hangs together: images and object points that observations join."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from baarda.cameras import FREE
from baarda.network import Network
from baarda.observations import ImagePoints, Kind

MOST = 3  # parts that are described


def separate_parts(network: Network, groups: Sequence[Kind]) -> str:
    """Describe the parts into which a block falls; empty if it hangs together.

    Points whose coordinates are all known join nothing: each part that ends at them stands by itself.

    Parameters
    ----------
    network : Network
    groups : sequence of Kind
        The observations that take part.
    """
    images, points = len(network.images.labels), len(network.points.labels)
    free = (network.points.states == FREE).any(axis=1)
    edges, seen = [np.zeros((2, 0), dtype=np.intp)], np.zeros(images, dtype=bool)
    group: Any
    for group in groups:
        if isinstance(group, ImagePoints):
            some = free[group.points]
            edges.append(np.stack([group.images[some], images + group.points[some]]))
            seen[group.images] = True
        elif hasattr(group, "points_of"):
            ends = group.points_of()
            edges += [np.stack([images + ends[0], images + end]) for end in ends[1:]]
    a, b = np.concatenate(edges, axis=1)
    graph = sparse.coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(images + points, images + points))
    _, part = connected_components(graph, directed=False)
    numbers, count = np.unique(part[:images][seen], return_counts=True)
    if len(numbers) < 2:
        return ""
    told = []
    for number in numbers[np.argsort(-count, kind="stable")][:MOST]:
        own = np.flatnonzero((part[:images] == number) & seen)
        names = ", ".join(network.images.labels[i] for i in own[:3]) + (", ..." if len(own) > 3 else "")
        told.append(f"{len(own)} image(s) ({names}) with {int((part[images:] == number).sum())} point(s)")
    more = f"; {len(numbers) - MOST} more" if len(numbers) > MOST else ""
    return f"the block falls into {len(numbers)} parts that no point joins: {'; '.join(told)}{more}"
