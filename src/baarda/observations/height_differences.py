"""Height differences: levelling."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from baarda.network import Network, State
from baarda.observations.base import Block, Floats, Ints, Rows


@dataclass(frozen=True)
class HeightDifferences:
    """Observed differences of Z.

    Attributes
    ----------
    starts, ends : (n,) int arrays
        Indices of the two object points.
    values, sigmas : (n,) arrays
        Z of the end minus Z of the start, and standard deviation, object units.
    """

    starts: Ints
    ends: Ints
    values: Floats
    sigmas: Floats
    unit: str = "m"
    name: str = "height differences"

    components = ("height difference",)

    def __len__(self) -> int:
        return len(self.starts)

    def selected(self, keep: Any) -> HeightDifferences:
        """Return some of the height differences (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("starts", "ends", "values", "sigmas")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return the points at both ends."""
        return self.starts, self.ends

    def observed(self) -> Floats:
        """Return the height differences, (n, 1)."""
        return self.values[:, None]

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 1)."""
        return self.sigmas[:, None]

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the start as code and the end in the component."""
        return {"point": self.starts, "component": np.array([f"height difference to {network.points.labels[j]}" for j in self.ends])}

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 1)."""
        return np.asarray(self.values - state.points[self.ends, 2] + state.points[self.starts, 2])[:, None]

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        up = np.broadcast_to([[0.0, 0.0, 1.0]], (len(self), 1, 3))
        blocks = (Block("point", self.starts, -up), Block("point", self.ends, up))
        return [Rows(np.arange(len(self)), self.misclosures(network, state), blocks, (self.sigmas**2)[:, None, None])]
