"""Every unknown has a name, a state and a column."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED
from baarda.errors import UsageError
from baarda.geometry import rotation as rot
from baarda.network.declared import Declared
from baarda.network.network import AXES, EXTERIOR, Network
from baarda.network.viewpoints import Viewpoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

PIECE = 65536  # points that are moved at a time


@dataclass(frozen=True)
class UnknownGroup:
    """The parameters of one kind of node (camera, image, point, ...), of any width.

    Attributes
    ----------
    kind : str
    labels : tuple of str
        One label per node.
    parameters : tuple of tuple of str
        Parameter names, one tuple per node, or a single tuple for all.
    offsets : (nodes + 1,) int array
        Where each node's parameters begin in `columns`.
    columns : (total,) int array
        Column of each parameter in the vector of unknowns, -1 = not an unknown.
    """

    kind: str
    labels: tuple[str, ...]
    parameters: tuple[tuple[str, ...], ...]
    offsets: Ints
    columns: Ints

    def of(self, nodes: Ints, width: int) -> Ints:
        """Return the (n, width) columns of nodes that all have this width."""
        return np.asarray(self.columns[self.offsets[nodes][:, None] + np.arange(width)])

    def parameters_of(self, node: int) -> tuple[str, ...]:
        """Return the parameter names of one node."""
        return self.parameters[node if len(self.parameters) > 1 else 0]


@dataclass(frozen=True)
class Unknowns:
    """The vector of unknowns: cameras, images, points, then what observation kinds declare; fixed parameters have no column."""

    groups: tuple[UnknownGroup, ...]

    def __getitem__(self, kind: str) -> UnknownGroup:
        return next(g for g in self.groups if g.kind == kind)

    @cached_property
    def count(self) -> int:
        """The number u of unknowns."""
        return int(sum((g.columns >= 0).sum() for g in self.groups))

    @cached_property
    def kinds(self) -> NDArray[np.intp]:
        """For each unknown the index of its group."""
        out = np.empty(self.count, dtype=np.intp)
        for i, g in enumerate(self.groups):
            out[g.columns[g.columns >= 0]] = i
        return out

    @cached_property
    def kept(self) -> dict[tuple[str, int], Ints]:
        """For each kind and width of nodes the positions where any node has an unknown."""
        out: dict[tuple[str, int], Ints] = {}
        for group in self.groups:
            widths = np.diff(group.offsets)
            for width in np.unique(widths).tolist():
                nodes = group.columns[group.offsets[:-1][widths == width][:, None] + np.arange(width)]
                out[group.kind, width] = np.flatnonzero((nodes >= 0).any(axis=0))
        return out

    def name(self, column: int) -> str:
        """Return the name of one unknown, ``kind label: parameter``."""
        for g in self.groups:
            hit = np.flatnonzero(g.columns == column)
            if len(hit):
                node = int(np.searchsorted(g.offsets, hit[0], side="right")) - 1
                return f"{g.kind} {g.labels[node]}: {g.parameters_of(node)[hit[0] - g.offsets[node]]}"
        raise UsageError(f"no unknown has column {column}")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All names in the order of the columns."""
        out = [""] * self.count
        for g in self.groups:
            for node, label in enumerate(g.labels):
                names = g.parameters_of(node)
                for k, column in enumerate(g.columns[g.offsets[node] : g.offsets[node + 1]]):
                    if column >= 0:
                        out[column] = f"{g.kind} {label}: {names[k]}"
        return tuple(out)

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def column(self, name: str) -> int:
        """Return the column of a named unknown.

        Raises
        ------
        UsageError
            If no unknown has this name.
        """
        if name not in self._index:
            raise UsageError(f"no unknown is named {name!r}; names look like {self.names[0]!r}" if self.names else "there are no unknowns")
        return self._index[name]


def unknowns_of(network: Network, points: NDArray[np.bool_] | None = None, cameras: NDArray[np.bool_] | None = None) -> Unknowns:
    """Number the unknowns of a network.

    Parameters
    ----------
    network : Network
    points : (n,) bool array, optional
        Which points take part; points set aside have no unknowns.
    cameras : (n,) bool array, optional
        Which cameras take part; a camera without images has no unknowns.

    Returns
    -------
    Unknowns

    Raises
    ------
    UsageError
        If two declared groups have the same kind.
    """
    count = 0

    def numbered(active: NDArray[np.bool_]) -> Ints:
        nonlocal count
        columns = np.where(active, count + np.cumsum(active) - 1, -1)
        count += int(active.sum())
        return columns

    widths = [len(c.values) for c in network.cameras]
    camera_states = np.concatenate([c.states for c in network.cameras]) if network.cameras else np.zeros(0, dtype=np.int8)
    if cameras is not None:
        camera_states = np.where(np.repeat(cameras, widths), camera_states, FIXED)
    camera = UnknownGroup(
        "camera",
        tuple(c.label for c in network.cameras),
        tuple(c.model.order for c in network.cameras),
        np.concatenate([[0], np.cumsum(widths)]).astype(np.intp),
        numbered(camera_states != FIXED),
    )
    images = network.images
    image = UnknownGroup(
        "image", images.labels, (EXTERIOR,), np.arange(len(images.labels) + 1) * 6, numbered((images.states != FIXED).ravel())
    )
    table = network.points
    active = table.states != FIXED
    if points is not None:
        active &= points[:, None]
    point = UnknownGroup("point", table.labels, (AXES,), np.arange(len(table.labels) + 1) * 3, numbered(active.ravel()))
    declared = tuple(
        UnknownGroup(
            d.kind, d.labels, d.parameters, d.offsets, numbered((d.states != FIXED) & np.repeat(_observed(network, d, points), d.widths))
        )
        for d in network.declared
    )
    kinds = [d.kind for d in declared]
    if len(set(kinds)) < len(kinds):
        raise UsageError(f"two groups of unknowns are called {next(k for k in kinds if kinds.count(k) > 1)!r}")
    return Unknowns((camera, image, point, *declared))


def _observed(network: Network, group: Declared, points: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return which nodes of a declared group have an observation whose points take part; the others have no unknowns."""
    out = np.zeros(len(group.labels), dtype=bool)
    for observations in network.observations:
        nodes = observations.nodes_of().get(group.kind) if hasattr(observations, "nodes_of") else None
        if nodes is not None:
            keep = np.ones(len(nodes), dtype=bool) if points is None else np.all([points[end] for end in observations.points_of()], axis=0)
            out[nodes[keep]] = True
    return out


@dataclass(frozen=True)
class State:
    """The current values of all parameters, fixed ones included.

    Attributes
    ----------
    cameras : tuple of (k,) arrays
    position : (images, 3) array
    rotation : (images, 3, 3) array
    points : (points, 3) array
    declared : tuple of Declared
        The groups that observation kinds declare, with their current values.
    """

    cameras: tuple[Floats, ...]
    position: Floats
    rotation: Floats
    points: Floats
    declared: tuple[Declared, ...] = ()

    def __getitem__(self, kind: str) -> Declared:
        found = next((d for d in self.declared if d.kind == kind), None)
        if found is None:
            raise UsageError(f"the network has no unknowns of the kind {kind!r}")
        return found

    def camera_table(self, width: int) -> Floats:
        """Return the parameters of all cameras as rows (cameras, width); zero for cameras of another number of parameters."""
        table = self._tables.get(width)
        if table is None:
            table = np.zeros((len(self.cameras), width))
            for i, values in enumerate(self.cameras):
                if len(values) == width:
                    table[i] = values
            self._tables[width] = table
        return table

    @cached_property
    def _tables(self) -> dict[int, Floats]:
        return {}

    @staticmethod
    def of(network: Network) -> State:
        """Return the values of a network's tables."""
        return State(
            tuple(np.array(c.values) for c in network.cameras),
            np.array(network.images.position),
            np.array(network.images.rotation),
            np.array(network.points.coordinates),
            network.declared,
        )

    def moved(self, unknowns: Unknowns, step: Floats, viewpoints: Viewpoints | None = None) -> State:
        """Return the state after a step of the unknowns; rotations turn by increments about the camera axes.

        Parameters
        ----------
        unknowns : Unknowns
        step : (u,) array
        viewpoints : Viewpoints, optional
            From where points are seen, to move those of three unknown coordinates along their rays; None = by coordinates.
        """
        padded = np.append(step, 0.0)  # column -1 takes the zero
        camera = unknowns["camera"]
        flat = padded[camera.columns]
        image = padded[unknowns["image"].columns].reshape(-1, 6)
        own = unknowns["point"].columns.reshape(-1, 3)
        steps = padded[own]
        points = self.points + steps
        if viewpoints is not None:
            whole = np.all(own >= 0, axis=1, keepdims=True)
            points = np.where(whole, viewpoints.moved(self.points, steps), points)
        return State(
            tuple(c + flat[camera.offsets[i] : camera.offsets[i + 1]] for i, c in enumerate(self.cameras)),
            self.position + image[:, :3],
            rot.exp(image[:, 3:]) @ self.rotation if len(image) else self.rotation,
            points,
            tuple(d.moved(padded[unknowns[d.kind].columns]) for d in self.declared),
        )

    def departure(self, unknowns: Unknowns, other: State) -> Floats:
        """Return the increments of the unknowns that lead from another state to this one, (u,); of angles those about the camera axes."""
        turn = rot.log(self.rotation @ other.rotation.transpose(0, 2, 1)) if len(self.rotation) else np.zeros((0, 3))
        parts = {
            "camera": np.concatenate([np.zeros(0), *(a - b for a, b in zip(self.cameras, other.cameras, strict=True))]),
            "image": np.concatenate([self.position - other.position, turn], axis=1).ravel(),
            "point": (self.points - other.points).ravel(),
        }
        parts |= {d.kind: d.departure(other[d.kind]) for d in self.declared}
        out = np.empty(unknowns.count)
        for group in unknowns.groups:
            used = group.columns >= 0
            out[group.columns[used]] = parts[group.kind][used]
        return out

    def shifted(self, shift: Floats) -> State:
        """Return the state with `shift` added to all object coordinates."""
        declared = tuple(d.shifted(shift) for d in self.declared)
        return State(self.cameras, self.position + shift, self.rotation, self.points + shift, declared)

    def write_to(self, network: Network) -> Network:
        """Return the network with these values in its tables."""
        from dataclasses import replace

        return replace(
            network,
            cameras=tuple(c.with_values(v) for c, v in zip(network.cameras, self.cameras, strict=True)),
            images=replace(network.images, position=self.position, rotation=self.rotation),
            points=replace(network.points, coordinates=self.points),
            declared=self.declared,
        )
