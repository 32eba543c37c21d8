"""Single image coordinates: image points of which one coordinate was removed; the other one stays an observation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from baarda.network import Network, State
from baarda.observations.base import Block, Floats, Ints, Rows
from baarda.observations.image_points import ImagePoints


@dataclass(frozen=True)
class ImageCoordinates:
    """One coordinate of each of some image points.

    Attributes
    ----------
    whole : ImagePoints
        The image points.
    axes : (n,) int array
        Which coordinate is observed: 0 = x, 1 = y.

    Notes
    -----
    Equations, residuals and variances are those of the image points; where x and y were correlated, the coordinate that stays keeps its
    own variance. A point needs whole image points: single coordinates do not count as rays.
    """

    whole: ImagePoints
    axes: Ints

    components = ("coordinate",)
    unit = "px"

    @property
    def name(self) -> str:
        """Name of the group: that of its image points, single coordinates."""
        return f"{self.whole.name}, single coordinates"

    @property
    def images(self) -> Ints:
        """Index of the image of each coordinate."""
        return self.whole.images

    def __len__(self) -> int:
        return len(self.whole)

    def selected(self, keep: Any) -> ImageCoordinates:
        """Return some of the coordinates (index or mask)."""
        return replace(self, whole=self.whole.selected(keep), axes=self.axes[keep])

    def points_of(self) -> tuple[Ints, ...]:
        """Return the object point of each row."""
        return (self.whole.points,)

    def observed(self) -> Floats:
        """Return the measured coordinates, (n, 1)."""
        return self._own(self.whole.xy)

    def sigma(self) -> Floats:
        """Return the a-priori standard deviations, (n, 1)."""
        return self._own(self.whole.sigmas)

    def labels(self, network: Network) -> dict[str, Any]:
        """Return image and point codes, and x or y."""
        return {**self.whole.labels(network), "component": np.array(["x", "y"], dtype=object)[self.axes]}

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 1)."""
        return self._own(self.whole.misclosures(network, state))

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return the rows of the observed coordinates."""
        out = []
        for rows in self.whole.linearize(network, state):
            at, axis = np.arange(len(rows.index)), self.axes[rows.index]
            blocks = tuple(Block(b.kind, b.nodes, b.jacobian[at, axis][:, None, :]) for b in rows.blocks)
            variance = rows.cofactor[at, axis] if rows.cofactor.ndim == 2 else rows.cofactor[at, axis, axis]
            out.append(Rows(rows.index, rows.misclosure[at, axis][:, None], blocks, variance[:, None, None]))
        return out

    def _own(self, values: Floats) -> Floats:
        return np.asarray(values[np.arange(len(self)), self.axes][:, None])
