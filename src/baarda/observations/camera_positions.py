"""Measured camera positions (GNSS): the antenna beside the projection centre, shifts and drifts of strips.

antenna = X0 + M' a + s + d t: M' a the lever arm in object axes, s and d the shift and drift of the strip, t the time since its middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from baarda.cameras import FIXED, FREE
from baarda.geometry.rotation import skew
from baarda.network import Declared, Network, State
from baarda.observations.base import Block, Floats, Ints, Rows

LEVER_ARM, STRIP = "lever_arm", "strip"
_SHIFT, _DRIFT = ("shift_X", "shift_Y", "shift_Z"), ("drift_X", "drift_Y", "drift_Z")


@dataclass(frozen=True)
class LeverArms(Declared):
    """Vectors from the projection centre to the antenna in camera axes (x right, y up, z backwards)."""

    def similarity(self, size: float) -> Floats:
        """Return how lever arms follow: lengths grow with the scale of the object space."""
        out = super().similarity(size)
        out[:, 6] = self.values / size
        return out


@dataclass(frozen=True)
class Strips(Declared):
    """Shifts, and drifts per second, of the positions of strips; fixed ones are known."""

    def similarity(self, size: float) -> Floats:
        """Return how shifts follow: what moves the cameras away from fixed positions lessens the shift by as much."""
        out = super().similarity(size)
        for k in range(3):
            out[k::6, k] = -1.0
        return out


def lever_arms(labels: Sequence[str], values: Any, free: bool, unit: str = "m") -> LeverArms:
    """Return the unknown group of lever arms.

    Parameters
    ----------
    labels : sequence of str
        One per camera.
    values : (n, 3) array
        Camera axes, object units.
    free : bool
        Whether they are estimated.
    unit : str
        Of the object space.

    Examples
    --------
    >>> lever_arms(["1"], [[0.1, 0.0, -0.2]], free=True).kind
    'lever_arm'
    """
    states = np.full((len(labels), 3), FREE if free else FIXED, dtype=np.int8)
    return LeverArms.make(LEVER_ARM, labels, ("x", "y", "z"), (unit,) * 3, values, states)


def strips(labels: Sequence[str], shift: bool = False, drift: bool = False, unit: str = "m") -> Strips:
    """Return the unknown group of shifts and drifts, all zero at the start.

    Examples
    --------
    >>> strips(["1", "2"], shift=True).states.tolist()
    [2, 2, 2, 0, 0, 0, 2, 2, 2, 0, 0, 0]
    """
    states = np.full((len(labels), 6), FIXED, dtype=np.int8)
    states[:, :3], states[:, 3:] = FREE if shift else FIXED, FREE if drift else FIXED
    return Strips.make(STRIP, labels, (*_SHIFT, *_DRIFT), (unit,) * 3 + (f"{unit}/s",) * 3, np.zeros((len(labels), 6)), states)


@dataclass(frozen=True)
class CameraPositions:
    """Observed positions of the antennas of cameras.

    Attributes
    ----------
    images : (n,) int array
    arms, lines : (n,) int arrays
        Nodes of the unknown groups ``lever_arm`` and ``strip``.
    times : (n,) array
        Seconds since the middle of the strip.
    values : (n, 3) array
        X, Y, Z in the source's system: without the network's offset.
    covariances : (n, 3, 3) array
    """

    images: Ints
    arms: Ints
    lines: Ints
    times: Floats
    values: Floats
    covariances: Floats
    unit: str = "m"
    name: str = "camera positions"

    components = ("X0", "Y0", "Z0")

    def __len__(self) -> int:
        return len(self.images)

    def selected(self, keep: Any) -> CameraPositions:
        """Return some of the positions (index or mask)."""
        return replace(self, **{k: getattr(self, k)[keep] for k in ("images", "arms", "lines", "times", "values", "covariances")})

    def points_of(self) -> tuple[Ints, ...]:
        """Return no object points: positions belong to images."""
        return ()

    def nodes_of(self) -> dict[str, Ints]:
        """Return the nodes of each row in the declared unknown groups."""
        return {LEVER_ARM: self.arms, STRIP: self.lines}

    def observed(self) -> Floats:
        """Return the positions, (n, 3)."""
        return self.values

    def sigma(self) -> Floats:
        """Return the standard deviations, (n, 3)."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariances)))

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the image codes."""
        return {"image": self.images}

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 3)."""
        arms, lines = state[LEVER_ARM].of(self.arms, 3), state[STRIP].of(self.lines, 6)
        antenna = state.position[self.images] + np.einsum("nji,nj->ni", state.rotation[self.images], arms)
        computed = antenna + lines[:, :3] + self.times[:, None] * lines[:, 3:]
        return np.asarray(self.values + network.offset - computed)

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all rows in one chunk; a turn theta moves the antenna by M' [a]x theta."""
        n = len(self)
        turned = state.rotation[self.images].transpose(0, 2, 1)
        arms = state[LEVER_ARM].of(self.arms, 3)
        d_image, d_line = np.zeros((n, 3, 6)), np.zeros((n, 3, 6))
        d_image[:, :, :3] = np.eye(3)
        d_image[:, :, 3:] = turned @ skew(arms)
        d_line[:, :, :3] = np.eye(3)
        d_line[:, :, 3:] = self.times[:, None, None] * np.eye(3)
        blocks = (Block("image", self.images, d_image), Block(LEVER_ARM, self.arms, turned), Block(STRIP, self.lines, d_line))
        return [Rows(np.arange(n), self.misclosures(network, state), blocks, self.covariances)]
