"""Radar image coordinates: range and Doppler equations of points seen from moving antennas, adjusted by the combined model."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE
from baarda.errors import UsageError
from baarda.geometry import range_doppler as radar
from baarda.geometry.rotation import skew
from baarda.network import Declared, Network, State
from baarda.observations import combined
from baarda.observations.base import Floats, Ints, Rows

KIND = "track"
#: Constants of a track: never unknowns.
CONSTANTS = ("time_origin", "side")
_NAME = re.compile(r"(squint|[XYZ])(\d+)")


@dataclass(frozen=True)
class Layout:
    """Where the parameters of a track stand in its node; -1 in `coefficients` = a power that this axis does not have."""

    squint: Ints
    coefficients: Ints
    spacing: int
    delay: int
    origin: int
    side: int
    width: int

    @staticmethod
    def of(names: Sequence[str]) -> Layout:
        """Find the parameters by their names.

        Raises
        ------
        UsageError
            If one is missing, or a power between others.
        """
        found: dict[str, dict[int, int]] = {"squint": {}, "X": {}, "Y": {}, "Z": {}}
        others = {}
        for i, name in enumerate(names):
            match = _NAME.fullmatch(name)
            if match:
                found[match[1]][int(match[2])] = i
            else:
                others[name] = i
        for name in ("pixel_spacing", "delay", *CONSTANTS):
            if name not in others:
                raise UsageError(f"a track needs the parameter {name!r}")
        for name in others:
            if name not in ("pixel_spacing", "delay", *CONSTANTS):
                raise UsageError(
                    f"a track has no parameter {name!r}; it has squint0, ..., X0, X1, ..., Y0, ..., Z0, ..., pixel_spacing, delay"
                )
        for axis, powers in found.items():
            if sorted(powers) != list(range(len(powers))) or not powers:
                raise UsageError(
                    f"a track needs {axis}0, {axis}1, ... without a gap, not {', '.join(f'{axis}{k}' for k in powers) or 'none'}"
                )
        order = max(len(found[a]) for a in "XYZ")
        at = np.full((3, order), -1)
        for j, axis in enumerate("XYZ"):
            at[j, : len(found[axis])] = [found[axis][k] for k in range(len(found[axis]))]
        squint = np.array([found["squint"][k] for k in range(len(found["squint"]))])
        return Layout(squint, at, others["pixel_spacing"], others["delay"], others["time_origin"], others["side"], len(names))


@dataclass(frozen=True)
class Tracks(Declared):
    """Antenna tracks of radar images: polynomials X(s), Y(s), Z(s) and squint(s) in the time s = t - time_origin, spacing and delay.

    `side` is where the antenna looks: 1 left, -1 right, 0 not known. A value that is NaN is found from control points.
    """

    starts_itself: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for node, label in enumerate(self.labels):
            layout = self.layouts[node if len(self.parameters) > 1 else 0]
            at = int(self.offsets[node])
            if (self.states[[at + layout.origin, at + layout.side]] != FIXED).any():
                raise UsageError(f"{self.kind} {label}: time_origin and side are constants; they must be fixed")
            if self.values[at + layout.side] not in (-1.0, 0.0, 1.0):
                raise UsageError(f"{self.kind} {label}: side is 1 (left), -1 (right) or 0 (not known), not {self.values[at + layout.side]}")
            if self.values[at + layout.spacing] == 0.0:
                raise UsageError(f"{self.kind} {label}: pixel_spacing is zero")

    @cached_property
    def layouts(self) -> tuple[Layout, ...]:
        """One layout per node, or a single one for all."""
        return tuple(Layout.of(names) for names in self.parameters)

    @cached_property
    def code(self) -> Ints:
        """For each node the first node that has the same layout."""
        if len(self.parameters) == 1:
            return np.zeros(len(self.labels), dtype=np.intp)
        return np.array([self.parameters.index(names) for names in self.parameters], dtype=np.intp)

    def removable(self) -> NDArray[np.bool_]:
        """Return the coefficients of second and higher order, and those of the squint angle beyond its constant, (total,)."""
        names = [m for node in range(len(self.labels)) for m in map(_NAME.fullmatch, self.parameters_of(node))]
        return np.array([m is not None and int(m[2]) > (0 if m[1] == "squint" else 1) for m in names], dtype=bool)

    def shifted(self, shift: Floats) -> Tracks:
        """Return the tracks after `shift` (3,) was added to all object coordinates."""
        add = np.zeros(len(self.values))
        for node in range(len(self.labels)):
            layout = self.layouts[node if len(self.parameters) > 1 else 0]
            add[self.offsets[node] + layout.coefficients[:, 0]] = shift
        return replace(self, values=self.values + add, given=self.given + add)

    def similarity(self, size: float) -> Floats:
        """Return how tracks follow a transformation of the object space: coefficients as vectors, spacing and delay as lengths."""
        out = super().similarity(size)
        for node in range(len(self.labels)):
            layout = self.layouts[node if len(self.parameters) > 1 else 0]
            at = int(self.offsets[node])
            c = np.where(layout.coefficients >= 0, self.values[at + np.maximum(layout.coefficients, 0)], 0.0)
            out[at + layout.coefficients[:, 0], :3] = np.eye(3)
            for k in range(c.shape[1]):
                there = layout.coefficients[:, k] >= 0
                moved = np.concatenate([-skew(c[:, k]) / size, c[:, k, None] / size], axis=1)
                out[at + layout.coefficients[there, k], 3:] = moved[there]
            for k in (layout.spacing, layout.delay):
                out[at + k, 6] = self.values[at + k] / size
        return out

    def arrays(self, node: Ints, layout: Layout) -> tuple[Floats, Floats, Floats, Floats]:
        """Return coefficients (n, 3, p + 1), squint (n, q + 1), spacing and delay (n,) of nodes of one layout."""
        v = self.of(node, layout.width)
        c = np.where(layout.coefficients >= 0, v[:, np.maximum(layout.coefficients, 0)], 0.0)
        return c, v[:, layout.squint], v[:, layout.spacing], v[:, layout.delay]


def tracks(
    labels: Sequence[str],
    coefficients: Any,
    squint: Any,
    spacing: Any,
    delay: Any = 0.0,
    origin: Any = 0.0,
    side: Any = 0,
    fixed: Sequence[str] = ("delay",),
    unit: str = "m",
    time_unit: str = "s",
) -> Tracks:
    """Return the unknown group of antenna tracks that all have the same orders.

    Parameters
    ----------
    labels : sequence of str
    coefficients : (n, 3, p + 1) array_like
        Polynomials of X, Y, Z in t - origin, lowest power first; NaN = find a start from control points.
    squint : (n, q + 1) array_like
        Squint angle, radians.
    spacing, delay, origin, side : (n,) array_like or number
        Slant range of a pixel and of r = 0; time origin; 1 = looks left, -1 = right, 0 = not known.
    fixed : sequence of str
        Parameters that are not estimated.
    unit, time_unit : str

    Returns
    -------
    Tracks

    Raises
    ------
    UsageError
        If a parameter to be fixed does not exist, or a value makes no sense.

    Notes
    -----
    Wu, Liu & Lin (2000), eqs. 3 and 4; the delay is not among their unknowns.

    Examples
    --------
    >>> t = tracks(["1"], [[[0.0, 0.0], [0.0, 120.0], [7000.0, 0.0]]], [[0.0]], 4.0, 8000.0, side=-1)
    >>> t.parameters[0]
    ('squint0', 'pixel_spacing', 'delay', 'X0', 'X1', 'Y0', 'Y1', 'Z0', 'Z1', 'time_origin', 'side')
    """
    n = len(labels)
    c, q = np.asarray(coefficients, dtype=float), np.asarray(squint, dtype=float)
    if c.ndim != 3 or c.shape[:2] != (n, 3) or q.ndim != 2 or len(q) != n:
        raise UsageError(f"{n} track(s) need coefficients (n, 3, p + 1) and squint (n, q + 1), not {c.shape} and {q.shape}")
    order, turns = c.shape[2] - 1, q.shape[1] - 1

    def per_time(text: str, k: int) -> str:
        return text if k == 0 else f"{text}/{time_unit}{'' if k == 1 else f'^{k}'}"

    names = [f"squint{k}" for k in range(turns + 1)] + ["pixel_spacing", "delay"]
    names += [f"{a}{k}" for a in "XYZ" for k in range(order + 1)] + list(CONSTANTS)
    units = [per_time("rad", k) for k in range(turns + 1)] + [f"{unit}/px", unit]
    units += [per_time(unit, k) for _ in "XYZ" for k in range(order + 1)] + [time_unit, ""]
    columns = [np.broadcast_to(np.asarray(a, dtype=float), (n,))[:, None] for a in (spacing, delay, origin, side)]
    values = np.concatenate([q, columns[0], columns[1], c.reshape(n, -1), columns[2], columns[3]], axis=1)
    for name in fixed:
        if name not in names:
            raise UsageError(f"a track of this order has no parameter {name!r}; it has {', '.join(names)}")
    states = np.broadcast_to([FIXED if name in (*fixed, *CONSTANTS) else FREE for name in names], values.shape)
    return Tracks.make(KIND, labels, names, units, values, states)


@dataclass(frozen=True)
class RangeDoppler:
    """Measured radar image coordinates.

    Attributes
    ----------
    tracks : (n,) int array
        Node of the unknown group ``track``.
    points : (n,) int array
        Index of the object point.
    tr : (n, 2) array
        Coordinate t along the track, a time, and r across it, pixels.
    sigmas : (n, 2) array
        A-priori standard deviations.
    name : str
    unit : str
        Units of t and r.

    Notes
    -----
    Wu, Liu & Lin, ISPRS XXXIII B1 (2000) 348-351, eqs. 1 to 6: residuals and redundancy numbers are those of t and r.
    """

    tracks: Ints
    points: Ints
    tr: Floats
    sigmas: Floats
    name: str = "range doppler"
    unit: str = "s, px"

    components = ("t", "r")

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of t, and of r."""
        return tuple(self.unit.split(", "))

    def __len__(self) -> int:
        return len(self.points)

    def selected(self, keep: Any) -> RangeDoppler:
        """Return some of the observations (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("tracks", "points", "tr", "sigmas")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return the object point of each row."""
        return (self.points,)

    def nodes_of(self) -> dict[str, Ints]:
        """Return the track of each row."""
        return {KIND: self.tracks}

    def observed(self) -> Floats:
        """Return t and r, (n, 2)."""
        return self.tr

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 2)."""
        return self.sigmas

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the point codes."""
        return {"point": self.points}

    def with_values(self, values: Floats) -> RangeDoppler:
        """Return the group with other observed values, (n, 2)."""
        return replace(self, tr=values)

    def with_start(self, network: Network, aside: NDArray[np.bool_]) -> Network:
        """Return the network with start values of tracks and points that have none; see `range_doppler_start.with_start`."""
        from baarda.observations.range_doppler_start import with_start

        return with_start(self, network, aside)

    def _parts(self, state: State) -> list[tuple[Ints, Tracks, Layout]]:
        """Return the rows of each layout."""
        group = state[KIND]
        if not isinstance(group, Tracks):
            raise UsageError(f"the unknowns {KIND!r} are no antenna tracks")
        code = group.code[self.tracks]
        return [(np.flatnonzero(code == k), group, group.layouts[k]) for k in np.unique(code)]

    def _conditions(self, state: State, rows: Ints, group: Tracks, layout: Layout) -> Callable[[Floats], tuple[Floats, Floats]]:
        node = self.tracks[rows]
        arrays = (state.points[self.points[rows]], *group.arrays(node, layout))
        origin = group.of(node, layout.width)[:, layout.origin]

        def conditions(tr: Floats) -> tuple[Floats, Floats]:
            s, r = tr[:, 0] - origin, tr[:, 1]
            return radar.conditions(*arrays, s, r), radar.partials(*arrays, s, r).observed

        return conditions

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 2)."""
        out = np.empty((len(self), 2))
        for rows, group, layout in self._parts(state):
            out[rows] = -combined.demanded(self._conditions(state, rows, group, layout), self.tr[rows], self.sigmas[rows] ** 2)[0]
        return out

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return the rows, those of different layouts in different chunks."""
        out = []
        for rows, group, layout in self._parts(state):
            cofactor = self.sigmas[rows] ** 2
            v, b = combined.demanded(self._conditions(state, rows, group, layout), self.tr[rows], cofactor)
            node, point = self.tracks[rows], self.points[rows]
            s = self.tr[rows, 0] + v[:, 0] - group.of(node, layout.width)[:, layout.origin]
            p = radar.partials(state.points[point], *group.arrays(node, layout), s, self.tr[rows, 1] + v[:, 1])
            to_track = np.zeros((len(rows), 2, layout.width))
            to_track[:, :, layout.squint], to_track[:, :, layout.spacing], to_track[:, :, layout.delay] = p.squint, p.spacing, p.delay
            there = layout.coefficients >= 0
            to_track[:, :, layout.coefficients[there]] = p.coefficients[:, :, there]
            out.append(combined.rows(rows, v, b, cofactor, [("point", point, p.points), (KIND, node, to_track)]))
        return out
