"""Horizontal angles between two targets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from baarda.geometry.bearing import bearing, half_turn
from baarda.network import Network, State
from baarda.observations.base import Block, Floats, Ints, Rows


@dataclass(frozen=True)
class Angles:
    """Observed horizontal angles, clockwise from the backsight to the foresight.

    Attributes
    ----------
    starts, backs, fores : (n,) int arrays
        Indices of the station and of both targets.
    values, sigmas : (n,) arrays
        Angle and standard deviation, radians.
    """

    starts: Ints
    backs: Ints
    fores: Ints
    values: Floats
    sigmas: Floats
    name: str = "angles"

    components = ("angle",)
    unit = "rad"

    def __len__(self) -> int:
        return len(self.starts)

    def selected(self, keep: Any) -> Angles:
        """Return some of the angles (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("starts", "backs", "fores", "values", "sigmas")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return station, backsight and foresight."""
        return self.starts, self.backs, self.fores

    def observed(self) -> Floats:
        """Return the angles, (n, 1)."""
        return self.values[:, None]

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 1)."""
        return self.sigmas[:, None]

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the station as code and both targets in the component."""
        names = network.points.labels
        return {
            "point": self.starts,
            "component": np.array([f"angle {names[i]} to {names[j]}" for i, j in zip(self.backs, self.fores, strict=True)]),
        }

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 1), within half a turn."""
        back, fore = (bearing(state.points[self.starts], state.points[ends])[0] for ends in (self.backs, self.fores))
        return half_turn(self.values - fore + back)[:, None]

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        back, fore = (bearing(state.points[self.starts], state.points[ends])[1][:, None, :] for ends in (self.backs, self.fores))
        blocks = (Block("point", self.starts, back - fore), Block("point", self.backs, -back), Block("point", self.fores, fore))
        return [Rows(np.arange(len(self)), self.misclosures(network, state), blocks, (self.sigmas**2)[:, None, None])]
