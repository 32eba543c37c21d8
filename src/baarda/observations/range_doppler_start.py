"""Start values for radar: tracks from control points alone, points by intersection; what is on the wrong side is refused, never guessed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baarda.errors import Singular, UsageError
from baarda.geometry import range_doppler as radar
from baarda.network import CONTROL, Network, State
from baarda.observations.base import Floats

if TYPE_CHECKING:
    from baarda.observations.range_doppler import RangeDoppler, Tracks

SIDES = {1: "left", -1: "right"}


def with_start(group: RangeDoppler, network: Network, aside: NDArray[np.bool_]) -> Network:
    """Return the network with start values of tracks and of points that radar alone determines.

    Parameters
    ----------
    group : RangeDoppler
        One of the observation groups.
    network : Network
    aside : (points,) bool array
        Points that do not take part.

    Returns
    -------
    Network

    Raises
    ------
    UsageError
        If a point lies on the side to which the antenna does not look, or control is too little for a track.
    Singular
        If a point or a track is not determined, or two points have the same ranges and nothing says which was seen.
    """
    network = _tracks(group, network)
    tracks = _group(network)
    s, known = _times(group, network), np.asarray(np.isfinite(network.points.coordinates).all(axis=1))
    sides = np.array([_value(tracks, i, "side") for i in range(len(tracks.labels))])
    for i, label in enumerate(tracks.labels):
        rows = np.flatnonzero((group.tracks == i) & known[group.points] & (network.points.roles[group.points] == CONTROL))
        seen = _side_of(tracks, i, s[rows], network.points.coordinates[group.points[rows]])
        if sides[i]:
            wrong = np.flatnonzero(seen != sides[i])
            if len(wrong):
                name = network.points.labels[group.points[rows[wrong[0]]]]
                there, here = SIDES[int(seen[wrong[0]])], SIDES[int(sides[i])]
                raise UsageError(f"control point {name} lies {there} of track {label}, which looks {here}")
        elif len(seen) and np.ptp(seen) == 0:
            sides[i] = seen[0]  # control shows it
    missing = np.unique(group.points[~known[group.points] & ~aside[group.points]])
    if not len(missing):
        return network
    coordinates = np.array(network.points.coordinates)
    heights = network.points.coordinates[known, 2]
    level = float(heights.mean()) if len(heights) else 0.0
    others = [g for g in network.observations if type(g) is type(group)]
    for point in missing.tolist():
        coordinates[point] = _intersected(others, network, tracks, sides, point, level)
    return replace(network, points=replace(network.points, coordinates=coordinates))


def _group(network: Network) -> Tracks:
    group = State.of(network)["track"]
    return group  # type: ignore[return-value]


def _value(tracks: Tracks, node: int, name: str) -> float:
    return float(tracks.values[tracks.named(node, name)])


def _times(group: RangeDoppler, network: Network) -> Floats:
    tracks = _group(network)
    origin = np.array([_value(tracks, i, "time_origin") for i in range(len(tracks.labels))])
    return np.asarray(group.tr[:, 0] - origin[group.tracks])


def _antenna(tracks: Tracks, node: int, s: Floats) -> radar.Antenna:
    layout = tracks.layouts[node if len(tracks.parameters) > 1 else 0]
    c = tracks.arrays(np.full(len(s), node), layout)[0]
    return radar.antenna(c, s)


def _side_of(tracks: Tracks, node: int, s: Floats, points: Floats) -> NDArray[np.intp]:
    """Return 1 for points to the left of the flight, -1 for those to the right."""
    a = _antenna(tracks, node, s)
    d = points - a.position
    return np.asarray(np.where(a.velocity[:, 0] * d[:, 1] - a.velocity[:, 1] * d[:, 0] > 0.0, 1, -1), dtype=np.intp)


def _tracks(group: RangeDoppler, network: Network) -> Network:
    """Fill in tracks of which values are missing, from the control points that they see."""
    tracks = _group(network)
    values = np.array(tracks.values)
    for i, label in enumerate(tracks.labels):
        at = slice(int(tracks.offsets[i]), int(tracks.offsets[i + 1]))
        absent = np.isnan(values[at])
        if not absent.any() or not (group.tracks == i).any():
            continue
        names = np.array(tracks.parameters_of(i), dtype=object)
        for needed in ("delay", "time_origin", "side"):
            if np.isnan(_value(tracks, i, needed)):
                raise UsageError(f"track {label}: {needed} must have a value")
        coordinates = network.points.coordinates
        rows = np.flatnonzero(
            (group.tracks == i) & (network.points.roles[group.points] == CONTROL) & np.isfinite(coordinates[group.points]).all(axis=1)
        )
        s = group.tr[rows, 0] - _value(tracks, i, "time_origin")
        try:
            flight = radar.flight_from_control(coordinates[group.points[rows]], s, group.tr[rows, 1], _value(tracks, i, "delay"))
        except (UsageError, Singular) as error:
            raise type(error)(f"track {label}: {error}") from None
        start = dict.fromkeys(names, 0.0) | {"pixel_spacing": flight.spacing}
        for k, axis in enumerate("XYZ"):
            start[f"{axis}0"], start[f"{axis}1"] = float(flight.position[k]), float(flight.velocity[k])
        values[at] = np.where(absent, [start[name] for name in names], values[at])
    changed = replace(tracks, values=values)
    return replace(network, declared=tuple(changed if d.kind == tracks.kind else d for d in network.declared))


def _intersected(groups: list[RangeDoppler], network: Network, tracks: Tracks, sides: Floats, point: int, level: float) -> Floats:
    """Return the coordinates of a point from its ranges."""
    node = np.concatenate([g.tracks[g.points == point] for g in groups])
    tr = np.concatenate([g.tr[g.points == point] for g in groups])
    label, own = network.points.labels[point], network.points.coordinates[point]
    position, velocity = np.empty((len(node), 3)), np.empty((len(node), 3))
    distance, squint = np.empty(len(node)), np.empty(len(node))
    for k, i in enumerate(node.tolist()):
        s = tr[k : k + 1, 0] - _value(tracks, i, "time_origin")
        layout = tracks.layouts[i if len(tracks.parameters) > 1 else 0]
        c, q, spacing, delay = tracks.arrays(np.array([i]), layout)
        a = radar.antenna(c, s)
        position[k], velocity[k] = a.position[0], a.velocity[0]
        distance[k] = spacing[0] * tr[k, 1] + delay[0]
        squint[k] = radar.powers(s, q.shape[1] - 1)[0] @ q[0]
    height = own[2] if np.isfinite(own[2]) else level
    starts = radar.intersect_height(position, velocity, squint, distance, np.full(len(node), height))
    if len(node) == 1:
        if not np.isfinite(own[2]):
            raise Singular(f"point {label} is seen by one track only and has no given height", [f"point {label}"])
        if not np.isfinite(starts[0]).all():
            raise Singular(f"point {label}: its range does not reach the height {own[2]:g}", [f"point {label}"])
        if not sides[node[0]]:
            raise _two(label, starts[0, 0], starts[0, 1])
        return np.asarray(starts[0, 0 if sides[node[0]] > 0 else 1])
    found: list[Floats] = []
    for k in range(len(node)):
        for j in (0, 1):
            if sides[node[k]] and (j == 0) != (sides[node[k]] > 0):
                continue
            if np.isfinite(starts[k, j]).all():
                try:
                    x = radar.intersect_ranges(position, velocity, squint, distance, starts[k, j])
                except Singular:
                    continue
                d = x - position
                where = np.where(velocity[:, 0] * d[:, 1] - velocity[:, 1] * d[:, 0] > 0.0, 1, -1)
                allowed = (sides[node] == 0) | (where == sides[node])
                if allowed.all() and _fits(x, position, velocity, squint, distance):
                    found.append(x)
    distinct = [x for k, x in enumerate(found) if all(np.linalg.norm(x - y) > 1e-3 * distance.min() for y in found[:k])]
    # above the antennas lies a mirror image, too
    below = [x for x in distinct if (x[2] < position[:, 2]).all()] or distinct
    if not below:
        raise Singular(f"point {label}: its {len(node)} ranges do not meet", [f"point {label}"])
    if len(below) > 1:
        raise _two(label, below[0], below[1])
    return below[0]


def _fits(x: Floats, position: Floats, velocity: Floats, squint: Floats, distance: Floats) -> bool:
    """Return whether ranges and directions are met as far as measured ones are."""
    d = x - position
    length = np.linalg.norm(d, axis=1)
    along = np.sum(velocity * d, axis=1) / np.linalg.norm(velocity, axis=1) - length * np.sin(squint)
    return bool((np.abs(length - distance) < 0.02 * distance).all() and (np.abs(along) < 0.02 * distance).all())


def _two(label: str, first: Floats, second: Floats) -> Singular:
    told = " and ".join("(" + ", ".join(f"{v:.1f}" for v in x) + ")" for x in (first, second))
    return Singular(
        f"point {label}: {told} have the same ranges; say on which side the antenna looks (side of the track)", [f"point {label}"]
    )
