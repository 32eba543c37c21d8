"""Start values for radar: tracks from control points alone, points by intersection; what is on the wrong side is refused, never guessed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FREE
from baarda.errors import Singular, UsageError
from baarda.geometry import range_doppler as radar
from baarda.geometry.ellipsoid_height import ellipsoid_height
from baarda.network import CONTROL, Network, State
from baarda.observations.base import Floats
from baarda.observations.ellipsoid_heights import EllipsoidHeights

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
    globe = _Globe.of(network)
    network = _tracks(group, network, globe)
    tracks = _group(network)
    _refuse_line(tracks, network)
    s, known = _times(group, network), np.asarray(np.isfinite(network.points.coordinates).all(axis=1))
    sides = np.array([_value(tracks, i, "side") for i in range(len(tracks.labels))])
    for i, label in enumerate(tracks.labels):
        rows = np.flatnonzero((group.tracks == i) & known[group.points] & (network.points.roles[group.points] == CONTROL))
        a = _antenna(tracks, i, s[rows])
        seen = _sides(a.position, a.velocity, network.points.coordinates[group.points[rows]], _up(a.position, globe))
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
        coordinates[point] = _intersected(others, network, tracks, sides, point, level, globe)
    return replace(network, points=replace(network.points, coordinates=coordinates))


def _group(network: Network) -> Tracks:
    group = State.of(network)["track"]
    return group  # type: ignore[return-value]


def _refuse_line(tracks: Tracks, network: Network) -> None:
    """Refuse flights of which nothing is known where all control points lie on one line: block and flights can turn about it."""
    points = network.points
    use = (points.roles == CONTROL) & np.isfinite(points.coordinates).all(axis=1) & (points.states != FREE).all(axis=1)
    places = [tracks.named(i, f"{axis}{k}") for i in range(len(tracks.labels)) for axis in "XYZ" for k in (0, 1)]
    if use.sum() < 2 or (tracks.states[places] != FREE).any():
        return
    x = points.coordinates[use] - points.coordinates[use].mean(axis=0)
    size = np.linalg.svd(x, compute_uv=False)
    if size[1] <= 1e-6 * size[0]:
        names = [f"track {label}" for label in tracks.labels]
        raise Singular(f"{', '.join(names)}: all {int(use.sum())} control points lie on one line, about which the flight can turn", names)


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


@dataclass(frozen=True)
class _Globe:
    """That coordinates are geocentric, told by given heights above the ellipsoid: where the centre is, and the height of each point."""

    centre: Floats
    heights: dict[int, float]

    @staticmethod
    def of(network: Network) -> _Globe | None:
        groups = [g for g in network.observations if isinstance(g, EllipsoidHeights)]
        if not groups:
            return None
        heights = {int(p): float(h) for g in groups for p, h in zip(g.points, g.values, strict=True)}
        return _Globe(np.asarray(network.offset, dtype=float), heights)


def _up(position: Floats, globe: _Globe | None) -> Floats:
    """Return the upward directions at antennas: Z, or away from the centre of the Earth."""
    if globe is None:
        return np.broadcast_to([0.0, 0.0, 1.0], position.shape)
    d = position - globe.centre
    return np.asarray(d / np.linalg.norm(d, axis=1)[:, None])


def _sides(position: Floats, velocity: Floats, points: Floats, up: Floats) -> NDArray[np.intp]:
    """Return 1 for points to the left of the flight, -1 for those to the right."""
    left = np.sum(np.cross(up, velocity) * (points - position), axis=1)
    return np.asarray(np.where(left > 0.0, 1, -1), dtype=np.intp)


def _flight(points: Floats, s: Floats, r: Floats, delay: float, globe: _Globe | None) -> radar.Flight:
    """Find a straight flight from control points, in the horizontal system of their middle where coordinates are geocentric."""
    if globe is None or len(points) < 1:
        return radar.flight_from_control(points, s, r, delay)
    middle = points.mean(axis=0)
    up = ellipsoid_height(middle - globe.centre)[1][0]
    east = np.array([-up[1], up[0], 0.0]) if np.hypot(up[0], up[1]) > 1e-9 else np.array([0.0, 1.0, 0.0])
    east = east / np.linalg.norm(east)
    local = np.stack([east, np.cross(up, east), up])
    found = radar.flight_from_control((points - middle) @ local.T, s, r, delay)
    return found._replace(position=middle + found.position @ local, velocity=found.velocity @ local)


def _tracks(group: RangeDoppler, network: Network, globe: _Globe | None) -> Network:
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
            flight = _flight(coordinates[group.points[rows]], s, group.tr[rows, 1], _value(tracks, i, "delay"), globe)
        except (UsageError, Singular) as error:
            raise type(error)(f"track {label}: {error}") from None
        start = dict.fromkeys(names, 0.0) | {"pixel_spacing": flight.spacing}
        for k, axis in enumerate("XYZ"):
            start[f"{axis}0"], start[f"{axis}1"] = float(flight.position[k]), float(flight.velocity[k])
        values[at] = np.where(absent, [start[name] for name in names], values[at])
    changed = replace(tracks, values=values)
    return replace(network, declared=tuple(changed if d.kind == tracks.kind else d for d in network.declared))


def _intersected(
    groups: list[RangeDoppler], network: Network, tracks: Tracks, sides: Floats, point: int, level: float, globe: _Globe | None
) -> Floats:
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
    up = _up(position, globe)
    if globe is None:
        given = float(own[2])
        height = given if np.isfinite(given) else level
        starts = radar.intersect_height(position, velocity, squint, distance, np.full(len(node), height))
    else:
        given = globe.heights.get(point, np.nan)
        height = given if np.isfinite(given) else float(np.mean(list(globe.heights.values())))
        starts = radar.intersect_ellipsoid(position - globe.centre, velocity, squint, distance, np.full(len(node), height)) + globe.centre
    if len(node) == 1:
        if not np.isfinite(given):
            raise Singular(f"point {label} is seen by one track only and has no given height", [f"point {label}"])
        if not np.isfinite(starts[0]).all():
            raise Singular(f"point {label}: its range does not reach the height {given:g}", [f"point {label}"])
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
                where = _sides(position, velocity, x, up)
                allowed = (sides[node] == 0) | (where == sides[node])
                if allowed.all() and _fits(x, position, velocity, squint, distance):
                    found.append(x)
    distinct = [x for k, x in enumerate(found) if all(np.linalg.norm(x - y) > 1e-3 * distance.min() for y in found[:k])]
    # above the antennas lies a mirror image, too
    below = [x for x in distinct if (np.sum(up * (x - position), axis=1) < 0.0).all()] or distinct
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
