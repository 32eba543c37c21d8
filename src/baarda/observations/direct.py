"""Directly observed unknowns: control coordinates, camera positions and attitudes, calibration priors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from baarda.cameras import OBSERVED
from baarda.geometry import rotation as rot
from baarda.network import AXES, CONTROL, EXTERIOR, Network, State
from baarda.network.parameters import _observed as observed_nodes
from baarda.observations.base import Block, Floats, Ints, Rows


@dataclass(frozen=True)
class Direct:
    """Single unknowns that were observed, with a standard deviation each.

    Attributes
    ----------
    name : str
        ``camera parameters``, ``image orientation``, ``control points``, or that of a declared group: ``track parameters``.
    kind : str
        Unknown group: camera, image, point, or a declared one.
    nodes, positions : (n,) int arrays
        Node and position of the parameter within the node.
    values, sigmas : (n,) arrays
        Observed value and standard deviation; angles in radians.
    widths : (n,) int array
        Number of parameters of the node.
    names : tuple of str
        Parameter name of each row.
    unit : str
    """

    name: str
    kind: str
    nodes: Ints
    positions: Ints
    values: Floats
    sigmas: Floats
    widths: Ints
    names: tuple[str, ...]
    unit: str

    components = ("",)

    def __len__(self) -> int:
        return len(self.nodes)

    def observed(self) -> Floats:
        """Return the observed values, (n, 1)."""
        return self.values[:, None]

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 1)."""
        return self.sigmas[:, None]

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the node codes and the parameter names."""
        return {self.kind: self.nodes, "component": np.array(self.names)}

    def _computed(self, state: State) -> Floats:
        if self.kind == "point":
            return np.asarray(state.points[self.nodes, self.positions])
        if self.kind == "image":
            values = np.concatenate([state.position, rot.to_angles(state.rotation)], axis=1)
            return np.asarray(values[self.nodes, self.positions])
        if self.kind != "camera":
            group = state[self.kind]
            return np.asarray(group.values[group.offsets[self.nodes] + self.positions])
        return np.array([state.cameras[n][k] for n, k in zip(self.nodes, self.positions, strict=True)])

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 1); differences of angles lie within half a turn."""
        difference = self.values - self._computed(state)
        angle = (self.kind == "image") & (self.positions >= 3) | (self.kind == "station")
        return np.asarray(np.where(angle, np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi, difference))[:, None]

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return the rows; nodes of different widths come in different chunks."""
        misclosure = self.misclosures(network, state)
        out = []
        for width in np.unique(self.widths):
            rows = np.flatnonzero(self.widths == width)
            jacobian = np.zeros((len(rows), 1, width))
            jacobian[np.arange(len(rows)), 0, self.positions[rows]] = 1.0
            if self.kind == "image":
                angles = np.flatnonzero(self.positions[rows] >= 3)
                partials = rot.angle_partials(state.rotation[self.nodes[rows[angles]]])
                jacobian[angles, 0, 3:] = partials[np.arange(len(angles)), self.positions[rows[angles]] - 3]
            cofactor = (self.sigmas[rows] ** 2)[:, None, None]
            out.append(Rows(rows, misclosure[rows], (Block(self.kind, self.nodes[rows], jacobian),), cofactor))
        return out


@dataclass(frozen=True)
class CorrelatedPoints:
    """Control points whose three observed coordinates are correlated: one block of three rows per point."""

    nodes: Ints
    values: Floats
    covariances: Floats
    unit: str
    name: str = "control points, correlated"

    components = AXES

    def __len__(self) -> int:
        return len(self.nodes)

    def observed(self) -> Floats:
        """Return the observed coordinates, (n, 3)."""
        return self.values

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 3)."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariances)))

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the point codes."""
        return {"point": self.nodes}

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 3)."""
        return np.asarray(self.values - state.points[self.nodes])

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        jacobian = np.broadcast_to(np.eye(3), (len(self), 3, 3))
        return [Rows(np.arange(len(self)), self.misclosures(network, state), (Block("point", self.nodes, jacobian),), self.covariances)]


def direct_observations(network: Network, active: Any) -> list[Direct | CorrelatedPoints]:
    """Return the groups of direct observations that the states of a network ask for.

    Parameters
    ----------
    network : Network
    active : (points,) bool array
        Points that take part.
    """
    out: list[Direct | CorrelatedPoints] = []
    rows = [
        (i, k, c.prior[k], c.sigmas[k], len(c.values), c.model.order[k])
        for i, c in enumerate(network.cameras)
        for k in np.flatnonzero(c.states == OBSERVED)
    ]
    if rows:
        node, at, value, sigma, width = (np.array([r[j] for r in rows]) for j in range(5))
        out.append(Direct("camera parameters", "camera", node, at, value, sigma, width, tuple(r[5] for r in rows), ""))
    images = network.images
    i, k = np.nonzero(images.states == OBSERVED)
    if len(i):
        names = tuple(EXTERIOR[j] for j in k)
        values, sigmas, unit = images.given[i, k], images.sigmas[i, k], f"{network.unit}, rad"
        out.append(Direct("image orientation", "image", i, k, values, sigmas, np.full(len(i), 6), names, unit))
    points = network.points
    observed = (points.states == OBSERVED) & (points.roles == CONTROL)[:, None] & np.asarray(active)[:, None]
    correlated = observed.all(axis=1) & (points.correlations != 0.0).any(axis=1)
    i, k = np.nonzero(observed & ~correlated[:, None])
    if len(i):
        names = tuple(AXES[j] for j in k)
        out.append(
            Direct("control points", "point", i, k, points.given[i, k], points.sigmas[i, k], np.full(len(i), 3), names, network.unit)
        )
    i = np.flatnonzero(correlated)
    if len(i):
        out.append(CorrelatedPoints(i, points.given[i], points.covariance(i), network.unit))
    for group in network.declared:
        used = observed_nodes(network, group, np.asarray(active))
        node = np.repeat(np.arange(len(group.labels)), group.widths)
        i = np.flatnonzero((group.states == OBSERVED) & used[node])
        if len(i):
            at = i - group.offsets[node[i]]
            names = tuple(group.parameters_of(n)[k] for n, k in zip(node[i].tolist(), at.tolist(), strict=True))
            width = group.widths[node[i]]
            out.append(Direct(f"{group.kind} parameters", group.kind, node[i], at, group.given[i], group.sigmas[i], width, names, ""))
    return out
