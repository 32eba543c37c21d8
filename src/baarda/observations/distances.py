"""Distances between object points: scale bars and taped lengths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from baarda.network import Network, State
from baarda.observations.base import Block, Floats, Ints, Rows


@dataclass(frozen=True)
class Distances:
    """Observed distances.

    Attributes
    ----------
    starts, ends : (n,) int arrays
        Indices of the two object points.
    values, sigmas : (n,) arrays
        Length and standard deviation, object units.
    """

    starts: Ints
    ends: Ints
    values: Floats
    sigmas: Floats
    unit: str = "m"
    name: str = "distances"

    components = ("distance",)

    def __len__(self) -> int:
        return len(self.starts)

    def selected(self, keep: Any) -> Distances:
        """Return some of the distances (index or mask)."""
        return replace(self, starts=self.starts[keep], ends=self.ends[keep], values=self.values[keep], sigmas=self.sigmas[keep])

    def points_of(self) -> tuple[Ints, ...]:
        """Return the points at both ends."""
        return self.starts, self.ends

    def observed(self) -> Floats:
        """Return the lengths, (n, 1)."""
        return self.values[:, None]

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 1)."""
        return self.sigmas[:, None]

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the start point as code and the end point in the component."""
        ends = np.array([f"distance to {network.points.labels[j]}" for j in self.ends])
        return {"point": self.starts, "component": ends}

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 1)."""
        return np.asarray(self.values - np.linalg.norm(state.points[self.ends] - state.points[self.starts], axis=1))[:, None]

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        d = state.points[self.ends] - state.points[self.starts]
        length = np.linalg.norm(d, axis=1)
        unit = (d / length[:, None])[:, None, :]
        blocks = (Block("point", self.starts, -unit), Block("point", self.ends, unit))
        return [Rows(np.arange(len(self)), (self.values - length)[:, None], blocks, (self.sigmas**2)[:, None, None])]
