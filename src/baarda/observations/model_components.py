"""Plan coordinates, or heights alone, of points in levelled independent models: the two halves of the planimetry-height adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from baarda.geometry import rotation as rot
from baarda.network import Network, State
from baarda.observations.base import Block, Floats, Ints, Rows
from baarda.observations.model_coordinates import KIND


@dataclass(frozen=True)
class _Components:
    """Some of the three components of x = scale R (X - X0).

    Attributes
    ----------
    models : (n,) int array
        Node of the unknown group ``model``.
    points : (n,) int array
        Index of the object point.
    values, sigmas : (n, k) arrays
        Measured components and their standard deviations, model units.
    name : str
    unit : str
    """

    models: Ints
    points: Ints
    values: Floats
    sigmas: Floats
    name: str = ""
    unit: str = "m"

    components: ClassVar[tuple[str, ...]] = ()
    axes: ClassVar[tuple[int, ...]] = ()

    def __len__(self) -> int:
        return len(self.points)

    def selected(self, keep: Any) -> Self:
        """Return some of the observations (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("models", "points", "values", "sigmas")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return the object point of each row."""
        return (self.points,)

    def nodes_of(self) -> dict[str, Ints]:
        """Return the model of each row."""
        return {KIND: self.models}

    def observed(self) -> Floats:
        """Return the measured components, (n, k)."""
        return self.values

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, k)."""
        return self.sigmas

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the point codes."""
        return {"point": self.points}

    def with_values(self, values: Floats) -> Self:
        """Return the group with other observed values, (n, k)."""
        return replace(self, values=values)

    def _computed(self, state: State) -> tuple[Floats, Floats, Floats]:
        v = state[KIND].of(self.models, 7)
        r = rot.exp(v[:, 3:6])
        return np.asarray(v[:, 6, None] * np.einsum("nij,nj->ni", r, state.points[self.points] - v[:, :3])), r, v[:, 6]

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, k)."""
        return np.asarray(self.values - self._computed(state)[0][:, self.axes])

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        computed, r, scale = self._computed(state)
        to_point = scale[:, None, None] * r
        to_model = np.concatenate([-to_point, -rot.skew(computed), (computed / scale[:, None])[:, :, None]], axis=2)
        blocks = (Block("point", self.points, to_point[:, self.axes]), Block(KIND, self.models, to_model[:, self.axes]))
        return [Rows(np.arange(len(self)), self.values - computed[:, self.axes], blocks, self.sigmas**2)]


@dataclass(frozen=True)
class ModelPlan(_Components):
    """Plan coordinates x, y of points in levelled models; see `baarda.procedures.planimetry_height`.

    Examples
    --------
    >>> len(ModelPlan(np.array([0]), np.array([0]), np.zeros((1, 2)), np.ones((1, 2))))
    1
    """

    name: str = "model plan"
    components: ClassVar[tuple[str, ...]] = ("x", "y")
    axes: ClassVar[tuple[int, ...]] = (0, 1)


@dataclass(frozen=True)
class ModelHeights(_Components):
    """Heights z of points in levelled models; see `baarda.procedures.planimetry_height`.

    Examples
    --------
    >>> ModelHeights(np.array([0]), np.array([0]), np.zeros((1, 1)), np.ones((1, 1))).components
    ('z',)
    """

    name: str = "model heights"
    components: ClassVar[tuple[str, ...]] = ("z",)
    axes: ClassVar[tuple[int, ...]] = (2,)
