"""Directions of theodolite stations: each set of directions has an unknown orientation. A set of known orientation observes azimuths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from baarda.geometry.bearing import bearing, half_turn
from baarda.network import Declared, Network, State
from baarda.observations.base import Block, Floats, Ints, Rows


@dataclass(frozen=True)
class Stations(Declared):
    """Orientations of sets of directions: the bearing of the circle's zero; fixed where azimuths are observed."""

    def similarity(self, size: float) -> Floats:
        """Return how orientations follow: a rotation of the object space about Z diminishes all bearings."""
        out = super().similarity(size)
        out[:, 5] = -1.0 / size
        return out


def stations(labels: Any, orientations: Any, states: Any = None) -> Stations:
    """Return the unknown group of orientations.

    Parameters
    ----------
    labels : sequence of str
        One per set of directions.
    orientations : (n,) array
        Bearing of the circle's zero, radians.
    states : (n,) int array, optional
        Free unless said otherwise; a fixed one makes azimuths of its directions.

    Examples
    --------
    >>> stations(["A"], [0.5]).kind
    'station'
    """
    return Stations.make("station", labels, ("orientation",), ("rad",), orientations, states)


@dataclass(frozen=True)
class Directions:
    """Observed horizontal directions.

    Attributes
    ----------
    sets : (n,) int array
        Node of the unknown group ``station``: whose orientation.
    starts, ends : (n,) int arrays
        Indices of the station's and the target's object point.
    values, sigmas : (n,) arrays
        Direction, clockwise from the circle's zero, and standard deviation, radians.

    Notes
    -----
    direction = bearing(start, end) - orientation.
    """

    sets: Ints
    starts: Ints
    ends: Ints
    values: Floats
    sigmas: Floats
    name: str = "directions"

    components = ("direction",)
    unit = "rad"

    def __len__(self) -> int:
        return len(self.starts)

    def selected(self, keep: Any) -> Directions:
        """Return some of the directions (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("sets", "starts", "ends", "values", "sigmas")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return station and target."""
        return self.starts, self.ends

    def nodes_of(self) -> dict[str, Ints]:
        """Return the node of each row in the declared unknown group."""
        return {"station": self.sets}

    def observed(self) -> Floats:
        """Return the directions, (n, 1)."""
        return self.values[:, None]

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 1)."""
        return self.sigmas[:, None]

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the station as code and the target in the component."""
        return {"point": self.starts, "component": np.array([f"direction to {network.points.labels[j]}" for j in self.ends])}

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 1), within half a turn."""
        t, _ = bearing(state.points[self.starts], state.points[self.ends])
        return half_turn(self.values + state["station"].of(self.sets, 1)[:, 0] - t)[:, None]

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        _, d = bearing(state.points[self.starts], state.points[self.ends])
        blocks = (
            Block("point", self.starts, -d[:, None, :]),
            Block("point", self.ends, d[:, None, :]),
            Block("station", self.sets, np.full((len(self), 1, 1), -1.0)),
        )
        return [Rows(np.arange(len(self)), self.misclosures(network, state), blocks, (self.sigmas**2)[:, None, None])]
