"""A network in parts for Helmert blocking: each object point with all its observations in one part, the border in several.

The images are ordered by nested dissection; the points follow their images, and the order is cut where few images lie on both sides.
What stands in several parts (images on the cuts, shared cameras, lever arms, strips) is the *border*: F. R. Helmert, Die mathematischen
und physikalischen Theorieen der höheren Geodäsie, part 1 (1880).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from baarda.adjustment.dissection import dissect
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import UsageError
from baarda.network import Images, Network, Points
from baarda.observations import ImageCoordinates

__all__ = ["Partition", "part_network", "partition"]

Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

SLACK = 0.12  # of a part's share of the rows, by which a cut may move to where it crosses fewer images
UNEQUAL = 1.4  # times the mean: the largest part that sweeps may make
SWEEPS = 3  # how often points between shared images look for a better part

#: The fields of observation groups that hold the numbers of nodes, and whose.
_FIELDS = {
    "images": "image",
    "points": "point",
    "starts": "point",
    "ends": "point",
    "backs": "point",
    "fores": "point",
    "sets": "station",
    "models": "model",
    "tracks": "track",
    "arms": "lever_arm",
    "lines": "strip",
}


@dataclass(frozen=True)
class Partition:
    """Which part holds what.

    Attributes
    ----------
    count : int
        Number of parts K.
    points : (points,) int array
        The part of each object point.
    rows : tuple of int arrays
        For each observation group the part of each row.
    members : mapping of str to (K, nodes) bool array
        For cameras, images and every declared kind which part holds which node.
    """

    count: int
    points: Ints
    rows: tuple[Ints, ...]
    members: Mapping[str, Bools]

    @cached_property
    def owner(self) -> dict[str, Ints]:
        """For each kind the first part that holds each node."""
        return {kind: np.argmax(held, axis=0) for kind, held in self.members.items()}

    def shared(self, kind: str) -> Bools:
        """Return which nodes of a kind stand in several parts."""
        return np.asarray(self.members[kind].sum(axis=0) > 1)


def partition(network: Network, parts: int) -> Partition:
    """Split a network into parts of about equal numbers of observations with a small border.

    Parameters
    ----------
    network : Network
    parts : int
        Their number K.

    Returns
    -------
    Partition
        The same for the same network.

    Raises
    ------
    UsageError
        If there are fewer parts than one, or more than the images allow.

    Notes
    -----
    Nested dissection: A. George, SIAM J. Numer. Anal. 10 (1973) 345. Points that observations join to each other (distances, directions)
    stay together.

    Examples
    --------
    >>> from baarda.procedures.synthetic import synthetic
    >>> network = synthetic("aerial", 30).network
    >>> p = partition(network, 3)
    >>> bool(np.ptp(np.bincount(p.rows[0])) < 0.3 * len(p.rows[0])), int(p.shared("image").sum()) < 30
    (True, True)
    """
    if parts < 1:
        raise UsageError(f"the number of parts must be positive, not {parts}")
    unit = _units(network)
    carriers = _Carriers(network, unit)
    part_of_unit = _cut(carriers, parts) if parts > 1 else np.zeros(carriers.units, dtype=np.intp)
    filled = np.bincount(part_of_unit, weights=carriers.weight, minlength=parts)
    if (filled == 0).any():
        raise UsageError(f"the network is too small for {parts} parts: choose fewer")
    points = part_of_unit[unit]
    held = {"image": np.zeros((parts, len(network.images.labels)), dtype=bool)}
    held |= {d.kind: np.zeros((parts, len(d.labels)), dtype=bool) for d in network.declared}
    rows: list[Ints] = [np.zeros(0, dtype=np.intp)] * len(network.observations)
    with_points = [bool(g.points_of()) for g in network.observations]
    for wanted in (True, False):  # what has no point goes where its nodes are already
        for g, group in enumerate(network.observations):
            if with_points[g] != wanted:
                continue
            nodes = nodes_of_rows(group, network)
            if wanted:
                rows[g] = points[group.points_of()[0]]
            else:
                kind, first = next(iter(nodes.items()))
                rows[g] = np.argmax(held[kind], axis=0)[first]
            for kind, numbers in nodes.items():
                held[kind][rows[g], numbers] = True
    for lost in held.values():
        lost[0, ~lost.any(axis=0)] = True  # what nobody observed is carried along
    cameras = np.zeros((parts, len(network.cameras)), dtype=bool)
    for k in range(parts):
        cameras[k, network.images.cameras[held["image"][k]]] = True
    cameras[0, ~cameras.any(axis=0)] = True
    return Partition(parts, points, tuple(rows), {"camera": cameras, **held})


def nodes_of_rows(group: Any, network: Network) -> dict[str, Ints]:
    """Return the image and the declared nodes of each row of an observation group, by kind."""
    out = {"image": np.asarray(group.images)} if hasattr(group, "images") else {}
    return out | (group.nodes_of() if hasattr(group, "nodes_of") else {})


def _units(network: Network) -> Ints:
    """Return a number for each point, the same for points that observations join."""
    count = len(network.points.labels)
    pairs = [(a, b) for group in network.observations for a, b in zip(group.points_of()[:-1], group.points_of()[1:], strict=True)]
    if not pairs:
        return np.arange(count)
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph.tocsr(), directed=False)[1], dtype=np.intp)


class _Carriers:
    """Which images (or declared nodes, where there are none) see which units of points."""

    def __init__(self, network: Network, unit: Ints) -> None:
        self.units = int(unit.max(initial=-1)) + 1
        numbers: dict[str, int] = {"image": 0}
        self.nodes = len(network.images.labels)
        seen: list[tuple[Ints, Ints]] = []
        self.weight = np.zeros(self.units)
        for group in network.observations:
            ends = group.points_of()
            if not ends:
                continue
            self.weight += np.bincount(unit[ends[0]], minlength=self.units) * len(group.components)
            nodes = nodes_of_rows(group, network)
            if "image" in nodes:
                nodes = {"image": nodes["image"]}
            for kind, number in nodes.items():
                if kind not in numbers:
                    numbers[kind] = self.nodes
                    self.nodes += len(next(d.labels for d in network.declared if d.kind == kind))
                seen.append((unit[ends[0]], numbers[kind] + number))
        at = [np.concatenate([np.zeros(0, dtype=np.intp), *side]) for side in zip(*seen, strict=True)] if seen else [unit[:0], unit[:0]]
        entries = coo_array((np.ones(len(at[0])), (at[0], at[1])), shape=(self.units, self.nodes))
        self.rays = entries.tocsr()  # equal entries are added
        place = np.full((self.units, 3), 0.0)
        known = np.isfinite(network.points.coordinates).all(axis=1)
        size = np.bincount(unit[known], minlength=self.units)
        for k in range(3):
            place[:, k] = np.bincount(unit[known], network.points.coordinates[known, k], self.units)
        with np.errstate(invalid="ignore", divide="ignore"):
            self.place = place / size[:, None]


def _cut(carriers: _Carriers, parts: int) -> Ints:
    """Return the part of each unit: units in the order of elimination of their first image, cut where few images are crossed."""
    rays, units = carriers.rays, carriers.units
    pattern = rays.copy()
    pattern.data[:] = 1.0
    graph = (pattern.T @ pattern).tocsr()
    known = np.flatnonzero(np.isfinite(carriers.place).all(axis=1))
    weight = np.asarray(pattern[known].sum(axis=0)).ravel()
    with np.errstate(invalid="ignore", divide="ignore"):
        places = (pattern[known].T @ carriers.place[known]) / weight[:, None]
    order = np.concatenate([np.zeros(0, dtype=np.intp), *dissect(graph, places if np.isfinite(places).all() else None)])
    position = np.empty(carriers.nodes, dtype=np.intp)
    position[order] = np.arange(len(order))
    first = np.full(units, carriers.nodes, dtype=np.intp)
    row = np.repeat(np.arange(units), np.diff(rays.indptr))
    np.minimum.at(first, row, position[rays.indices])
    later = np.bincount(row, position[rays.indices], units) / np.maximum(np.bincount(row, minlength=units), 1)
    in_order = np.lexsort((later, first))
    begin = np.concatenate([[0.0], np.cumsum(carriers.weight[in_order])])  # work before each unit
    bounds = np.searchsorted(first[in_order], np.arange(carriers.nodes + 1))  # the first unit of each node
    low, high = np.full(carriers.nodes, carriers.nodes), np.full(carriers.nodes, -1)
    np.minimum.at(low, rays.indices, first[row])
    np.maximum.at(high, rays.indices, first[row])
    crossing = np.zeros(carriers.nodes + 2)  # nodes whose points lie on both sides of a cut before node t
    there = high >= 0
    np.add.at(crossing, low[there] + 1, 1.0)
    np.add.at(crossing, high[there] + 1, -1.0)
    crossing = np.cumsum(crossing)[:-1]
    cuts, total = [0], begin[-1]
    for k in range(1, parts):
        target, slack = total * k / parts, SLACK * total / parts
        inside = np.flatnonzero((np.abs(begin[bounds] - target) <= slack) & (bounds > cuts[-1]))
        if len(inside):
            best = inside[np.lexsort((np.abs(begin[bounds[inside]] - target), crossing[inside]))[0]]
            cuts.append(int(bounds[best]))
        else:  # between units of the same image: all see nearly everything
            cuts.append(min(max(int(np.argmin(np.abs(begin - target))), cuts[-1] + 1), units))
    part = np.empty(units, dtype=np.intp)
    part[in_order] = np.searchsorted(np.array(cuts), np.arange(units), side="right") - 1
    return _gathered(carriers, row, part, parts)


def _gathered(carriers: _Carriers, row: Ints, part: Ints, parts: int) -> Ints:
    """Move units all of whose images are shared to where most observations of these images are; ties go to the first part."""
    rays = carriers.rays
    nodes, fair = rays.shape[1], carriers.weight.sum() / parts
    for _ in range(SWEEPS):
        count = coo_array((rays.data, (part[row], rays.indices)), shape=(parts, nodes)).toarray()
        shared = (count > 0).sum(axis=0) > 1
        free = np.ones(rays.shape[0], dtype=bool)
        free[row[~shared[rays.indices]]] = False
        free[np.diff(rays.indptr) == 0] = False
        candidates = np.flatnonzero(free)
        if not len(candidates):
            break
        weight = rays[candidates] @ count.T  # (candidates, parts)
        better = np.argmax(weight, axis=1)
        moved = weight[np.arange(len(candidates)), better] > weight[np.arange(len(candidates)), part[candidates]]
        if not moved.any():
            break
        new = part.copy()
        new[candidates[moved]] = better[moved]
        sizes = np.bincount(new, carriers.weight, parts)
        if sizes.min() <= 0.0 or sizes.max() > max(UNEQUAL * fair, np.bincount(part, carriers.weight, parts).max()):
            break
        part = new
    return np.asarray(part, dtype=np.intp)


def part_network(network: Network, split: Partition, number: int) -> Network:
    """Return one part of a network; what is observed directly of a shared node stays with the first part that holds it.

    Parameters
    ----------
    network : Network
    split : Partition
        Of this network.
    number : int
        Which part, from 0.

    Raises
    ------
    UsageError
        If an observation kind holds node numbers that are not known here.
    """
    kept = {kind: np.flatnonzero(held[number]) for kind, held in split.members.items()}
    kept["point"] = np.flatnonzero(split.points == number)
    sizes = {"point": len(network.points.labels), **{kind: held.shape[1] for kind, held in split.members.items()}}
    index = {kind: np.full(size, -1, dtype=np.intp) for kind, size in sizes.items()}
    for kind, nodes in kept.items():
        index[kind][nodes] = np.arange(len(nodes))
    foreign = {kind: split.owner[kind][nodes] != number for kind, nodes in kept.items() if kind != "point"}
    cameras = []
    for i, released in zip(kept["camera"], foreign["camera"], strict=True):
        c = network.cameras[i]
        if released and (c.states == OBSERVED).any():
            states = np.where(c.states == OBSERVED, FREE, c.states).astype(np.int8)
            c = replace(c, states=states, sigmas=np.where(c.states == OBSERVED, np.nan, c.sigmas))
        cameras.append(c)
    declared = []
    for d in network.declared:
        nodes = kept[d.kind]
        flat = np.concatenate([np.zeros(0, dtype=np.intp), *(np.arange(d.offsets[n], d.offsets[n + 1]) for n in nodes)])
        away = np.repeat(foreign[d.kind], d.widths[nodes]) & (d.states[flat] == OBSERVED)
        several = len(d.parameters) > 1
        declared.append(
            replace(
                d,
                labels=tuple(d.labels[n] for n in nodes),
                parameters=tuple(d.parameters[n] for n in nodes) if several else d.parameters,
                units=tuple(d.units[n] for n in nodes) if several else d.units,
                values=d.values[flat],
                states=np.where(away, FREE, d.states[flat]).astype(np.int8),
                given=np.where(away, np.nan, d.given[flat]),
                sigmas=np.where(away, np.nan, d.sigmas[flat]),
            )
        )
    groups = []
    for group, rows in zip(network.observations, split.rows, strict=True):
        mine = np.flatnonzero(rows == number)
        if len(mine):
            groups.append(_renumbered(group.selected(mine), index))
    return replace(
        network,
        cameras=tuple(cameras),
        images=_images(network.images, kept["image"], index["camera"], foreign["image"]),
        points=_points(network.points, kept["point"]),
        observations=tuple(groups),
        declared=tuple(d for d in declared if d.labels),
    )


def _images(images: Images, kept: Ints, camera: Ints, foreign: Bools) -> Images:
    away = foreign[:, None] & (images.states[kept] == OBSERVED)
    return Images(
        tuple(images.labels[i] for i in kept),
        camera[images.cameras[kept]],
        images.position[kept],
        images.rotation[kept],
        np.where(away, FREE, images.states[kept]).astype(np.int8),
        np.where(away, np.nan, images.given[kept]),
        np.where(away, np.nan, images.sigmas[kept]),
    )


def _points(points: Points, kept: Ints) -> Points:
    return Points(
        tuple(points.labels[i] for i in kept),
        points.coordinates[kept],
        points.roles[kept],
        points.states[kept],
        points.given[kept],
        points.sigmas[kept],
        points.correlations[kept],
    )


def _renumbered(group: Any, index: Mapping[str, Ints]) -> Any:
    """Return a group whose nodes have the numbers of the part."""
    if isinstance(group, ImageCoordinates):
        return replace(group, whole=_renumbered(group.whole, index))
    changed = {f.name: index[_FIELDS[f.name]][getattr(group, f.name)] for f in fields(group) if _FIELDS.get(f.name) in index}
    out = replace(group, **changed)
    told = [*group.points_of(), *(group.nodes_of().values() if hasattr(group, "nodes_of") else ())]
    found = [*out.points_of(), *(out.nodes_of().values() if hasattr(out, "nodes_of") else ())]
    kinds = ["point"] * len(group.points_of()) + list(group.nodes_of() if hasattr(group, "nodes_of") else ())
    if any(not np.array_equal(index[k][a], b) for k, a, b in zip(kinds, told, found, strict=True)):
        raise UsageError(f"observations of the kind {type(group).__name__} cannot be split into parts")
    return out


def border_nodes(network: Network, split: Partition) -> list[tuple[str, int]]:
    """Return kind and number of the nodes that stand in several parts and have unknowns, in the order of the unknowns."""
    out = [("camera", int(i)) for i in np.flatnonzero(split.shared("camera")) if (network.cameras[i].states != FIXED).any()]
    free = (network.images.states != FIXED).any(axis=1)
    out += [("image", int(i)) for i in np.flatnonzero(split.shared("image") & free)]
    for d in network.declared:
        used = np.add.reduceat(np.append(d.states != FIXED, False), d.offsets[:-1]) > 0 if len(d.labels) else np.zeros(0, dtype=bool)
        out += [(d.kind, int(i)) for i in np.flatnonzero(split.shared(d.kind) & used)]
    return out
