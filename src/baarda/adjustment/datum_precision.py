"""How well the known values tie the network down: position, orientation and scale of the whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.datum import mean_distance, similarity_directions
from baarda.adjustment.linear_system import Linearization
from baarda.network import State

Floats = NDArray[np.float64]

SMALLEST = 1e-18  # of the largest eigenvalue
TURN = 0.05  # radians: standard deviation of the orientation from which it is weak
STRETCH = 0.05  # likewise of the scale


@dataclass(frozen=True)
class DatumPrecision:
    """A-priori standard deviations of the network as a rigid whole; with its inner geometry uncertain they are larger.

    Attributes
    ----------
    rotation : float
        About the axis about which it is largest, radians.
    axis : (3,) array
        That axis.
    scale : float
        A share.
    """

    rotation: float
    axis: Floats
    scale: float

    @property
    def turns(self) -> bool:
        """Whether the orientation of the network is weak."""
        return self.rotation > TURN

    @property
    def stretches(self) -> bool:
        """Whether the scale of the network is weak."""
        return self.scale > STRETCH


def datum_precision(lin: Linearization, state: State) -> DatumPrecision | None:
    """Return how well observations and known values determine rotation and scale of a network without datum defect.

    With G the seven similarity directions of the unknowns the cofactors of a rigid motion are (G'NG)^-1.

    Parameters
    ----------
    lin : Linearization
    state : State
        Coordinates near the origin.

    Returns
    -------
    DatumPrecision or None
        None where rotations and scale move no unknown.
    """
    size = mean_distance(state)
    change = lin.times(similarity_directions(lin.unknowns, state, size=size))
    if not change[:, 3:].any():
        return None
    values, vectors = np.linalg.eigh(change.T @ change)
    moving = values > SMALLEST * values[-1]  # other combinations of the seven move no unknown
    root = vectors[:, moving] / np.sqrt(values[moving])
    axes, sizes, _ = np.linalg.svd(root[3:6] / size)
    axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
    return DatumPrecision(float(sizes[0]), axis, float(np.linalg.norm(root[6])) / size)
