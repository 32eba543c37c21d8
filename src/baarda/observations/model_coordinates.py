"""Coordinates of points in independent models: each model is a similarity transformation of the object space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import Singular, UsageError
from baarda.geometry import rotation as rot
from baarda.geometry.similarity import similarity
from baarda.geometry.strip_polynomial import connect_models
from baarda.network import CONTROL, Declared, Network, State
from baarda.observations.base import Block, Floats, Ints, Rows

KIND = "model"
PARAMETERS = ("X0", "Y0", "Z0", "rotation_x", "rotation_y", "rotation_z", "scale")


@dataclass(frozen=True)
class Models(Declared):
    """Transformations of models: x = scale R (X - X0), R the rotation of the vector (rotation_x, rotation_y, rotation_z).

    Increments of the rotation are about the axes of the model; a state belongs to the increment about its axis. A value that is NaN is
    found from common points.
    """

    starts_itself: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(names != PARAMETERS for names in self.parameters):
            raise UsageError(f"a model has the parameters {', '.join(PARAMETERS)}")
        states = self.states.reshape(-1, 7)
        turned = (states[:, 3:6] == OBSERVED).any(axis=1) | (states[:, 3] != states[:, 4])
        if turned.any():
            label = self.labels[int(np.argmax(turned))]
            raise UsageError(f"model {label}: the rotation is free or fixed as a whole, or both tilts are (rotation_x and rotation_y)")

    @property
    def rotations(self) -> Floats:
        """R of each model, model from object, (m, 3, 3)."""
        return rot.exp(self.values.reshape(-1, 7)[:, 3:6])

    def moved(self, step: Floats) -> Models:
        """Return the transformations after increments, (total,); those of rotations are about the axes of the models."""
        v, d = np.array(self.values.reshape(-1, 7)), step.reshape(-1, 7)
        turned = rot.log(rot.exp(d[:, 3:6]) @ self.rotations)
        v = v + d
        v[:, 3:6] = turned
        return replace(self, values=v.ravel())

    def departure(self, other: Self) -> Floats:
        """Return the increments that lead from another state of the group to this one, (total,)."""
        out = (self.values - other.values).reshape(-1, 7)
        out[:, 3:6] = rot.log(self.rotations @ other.rotations.transpose(0, 2, 1))
        return np.asarray(out.ravel())

    def shifted(self, shift: Floats) -> Models:
        """Return the transformations after `shift` (3,) was added to all object coordinates."""
        add = np.concatenate([shift, np.zeros(4)])
        return replace(self, values=(self.values.reshape(-1, 7) + add).ravel(), given=(self.given.reshape(-1, 7) + add).ravel())

    def similarity(self, size: float) -> Floats:
        """Return how the transformations follow one of the object space, increments of rotations about the axes of the models."""
        v = self.values.reshape(-1, 7)
        out = np.zeros((len(v), 7, 7))
        out[:, :3, :3] = np.eye(3)
        out[:, :3, 3:6], out[:, :3, 6] = -rot.skew(v[:, :3]) / size, v[:, :3] / size
        out[:, 3:6, 3:6] = -self.rotations / size
        out[:, 6, 6] = -v[:, 6] / size
        return out.reshape(-1, 7)


def models(labels: Sequence[str], values: Any = None, states: Any = None, unit: str = "m") -> Models:
    """Return the unknown group of model transformations.

    Parameters
    ----------
    labels : sequence of str
    values : (m, 7) array_like, optional
        X0, Y0, Z0, rotation vector, scale (model units per object unit); without them they are found from common points.
    states : (m, 7) array_like, optional
        Free unless said otherwise.
    unit : str

    Returns
    -------
    Models

    Raises
    ------
    UsageError
        If shapes do not fit.

    Examples
    --------
    >>> models(["1", "2"]).values.shape
    (14,)
    """
    units = (unit,) * 3 + ("rad",) * 3 + ("",)
    filled = np.full((len(labels), 7), np.nan) if values is None else np.asarray(values, dtype=float)
    chosen = np.full((len(labels), 7), FREE) if states is None else states
    return Models.make(KIND, labels, PARAMETERS, units, filled, chosen)


@dataclass(frozen=True)
class ModelCoordinates:
    """Measured model coordinates.

    Attributes
    ----------
    models : (n,) int array
        Node of the unknown group ``model``.
    points : (n,) int array
        Index of the object point; a perspective centre is an object point, too.
    xyz : (n, 3) array
        Model units.
    sigmas : (n, 3) array
    name : str
    unit : str
        Of the model coordinates.

    Notes
    -----
    x = scale R (X - X0): the spatial block adjustment of independent models, Ackermann, Ebner & Klein (1973).
    """

    models: Ints
    points: Ints
    xyz: Floats
    sigmas: Floats
    name: str = "model coordinates"
    unit: str = "m"

    components = ("x", "y", "z")

    def __len__(self) -> int:
        return len(self.points)

    def selected(self, keep: Any) -> ModelCoordinates:
        """Return some of the observations (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("models", "points", "xyz", "sigmas")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return the object point of each row."""
        return (self.points,)

    def nodes_of(self) -> dict[str, Ints]:
        """Return the model of each row."""
        return {KIND: self.models}

    def observed(self) -> Floats:
        """Return the model coordinates, (n, 3)."""
        return self.xyz

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 3)."""
        return self.sigmas

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the point codes."""
        return {"point": self.points}

    def with_values(self, values: Floats) -> ModelCoordinates:
        """Return the group with other observed values, (n, 3)."""
        return replace(self, xyz=values)

    def _computed(self, state: State) -> tuple[Floats, Floats, Floats]:
        v = state[KIND].of(self.models, 7)
        r = rot.exp(v[:, 3:6])
        computed = v[:, 6, None] * np.einsum("nij,nj->ni", r, state.points[self.points] - v[:, :3])
        return np.asarray(computed), r, v[:, 6]

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 3)."""
        return np.asarray(self.xyz - self._computed(state)[0])

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk."""
        computed, r, scale = self._computed(state)
        to_point = scale[:, None, None] * r
        to_model = np.concatenate([-to_point, -rot.skew(computed), (computed / scale[:, None])[:, :, None]], axis=2)
        blocks = (Block("point", self.points, to_point), Block(KIND, self.models, to_model))
        return [Rows(np.arange(len(self)), self.xyz - computed, blocks, self.sigmas**2)]

    def parts(self, network: Network) -> list[dict[str, Floats]]:
        """Return for each model the coordinates of its points by label."""
        labels = network.points.labels
        count = len(next(d for d in network.declared if d.kind == KIND).labels)
        out: list[dict[str, Floats]] = [{} for _ in range(count)]
        for m, p, x in zip(self.models.tolist(), self.points.tolist(), self.xyz, strict=True):
            out[m][labels[p]] = x
        return out

    def with_start(self, network: Network, aside: NDArray[np.bool_]) -> Network:
        """Return the network with start values of models and points that have none.

        Models are connected one to another, and the whole is moved onto the control points; without three of them it stays in the system of
        the first model, a free network.

        Raises
        ------
        Singular
            If a model cannot be connected with the others.
        """
        group = State.of(network)[KIND]
        coordinates = network.points.coordinates
        needed = np.isnan(coordinates[self.points]).any() or np.isnan(group.of(np.unique(self.models), 7)).any()
        if not needed:
            return network
        chosen = np.unique(self.models)
        every = self.parts(network)
        if not len(chosen):
            return network
        strip = connect_models([every[m] for m in chosen], [group.labels[m] for m in chosen])
        index = {label: i for i, label in enumerate(network.points.labels)}
        known = [
            label
            for label in strip.points
            if np.isfinite(coordinates[index[label]]).all() and network.points.roles[index[label]] == CONTROL
        ]
        here = np.array([strip.points[label] for label in known]).reshape(-1, 3)
        scale, turn, shift = 1.0, np.eye(3), np.zeros(3)
        if known:
            try:
                scale, turn, shift = similarity(here, coordinates[[index[label] for label in known]])
            except UsageError as error:
                raise Singular(f"the models cannot be moved onto {len(known)} control point(s): {error}") from None
        start, values = np.array(coordinates), np.array(group.values.reshape(-1, 7))
        for label, x in strip.points.items():
            if not np.isfinite(start[index[label]]).all():
                start[index[label]] = scale * turn @ x + shift
        for k, m in enumerate(chosen.tolist()):
            # object = scale turn (s r model + t) + shift
            size, r = scale * strip.scales[k], turn @ strip.rotations[k]
            origin = scale * turn @ strip.translations[k] + shift
            found = np.concatenate([origin, rot.log(r.T[None])[0], [1.0 / size]])
            values[m] = np.where(np.isnan(values[m]) | (group.states.reshape(-1, 7)[m] != FIXED), found, values[m])
        declared = tuple(replace(d, values=values.ravel()) if d.kind == KIND else d for d in network.declared)
        return replace(network, points=replace(network.points, coordinates=start), declared=declared)
