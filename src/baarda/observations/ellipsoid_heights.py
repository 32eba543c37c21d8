"""Heights above the ellipsoid of points in geocentric coordinates: what a point that one radar track sees needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from baarda.geometry.ellipsoid_height import ellipsoid_height
from baarda.network import Network, State
from baarda.observations.base import Block, Floats, Ints, Rows


@dataclass(frozen=True)
class EllipsoidHeights:
    """Observed heights above the ellipsoid of WGS 84.

    Attributes
    ----------
    points : (n,) int array
        Index of the object point; its coordinates are geocentric, in metres.
    values, sigmas : (n,) arrays
        Height and standard deviation, m.

    Examples
    --------
    >>> len(EllipsoidHeights(np.array([0]), np.array([120.0]), np.array([0.5])))
    1
    """

    points: Ints
    values: Floats
    sigmas: Floats
    unit: str = "m"
    name: str = "ellipsoid heights"

    components = ("height",)

    def __len__(self) -> int:
        return len(self.points)

    def selected(self, keep: Any) -> EllipsoidHeights:
        """Return some of the heights (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("points", "values", "sigmas")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return the object point of each row."""
        return (self.points,)

    def observed(self) -> Floats:
        """Return the heights, (n, 1)."""
        return self.values[:, None]

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 1)."""
        return self.sigmas[:, None]

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the point codes."""
        return {"point": self.points}

    def with_values(self, values: Floats) -> EllipsoidHeights:
        """Return the group with other heights, (n, 1)."""
        return replace(self, values=values[:, 0])

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 1)."""
        return (self.values - ellipsoid_height(state.points[self.points] - network.offset)[0])[:, None]

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        computed, normal = ellipsoid_height(state.points[self.points] - network.offset)
        blocks = (Block("point", self.points, normal[:, None, :]),)
        return [Rows(np.arange(len(self)), (self.values - computed)[:, None], blocks, (self.sigmas**2)[:, None])]
