"""Back to the datum: steps may carry a network along the transformations that its observations leave free; one of these brings it back."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from baarda.adjustment.datum import Datum, mean_distance
from baarda.geometry import rotation as rot
from baarda.network import State, Unknowns
from baarda.network.declared import Declared

Floats = NDArray[np.float64]
S = TypeVar("S")

LONGEST = 0.3  # radians, or share of scale, that are gone back at a time
SHORT = 0.005  # radians, or share of scale, that a step of Runge and Kutta may take
ROUNDS = 100
NONE = 1e-13  # of a motion, shifts in units of the network's size
SMALL = 1e-6  # below which Newton's steps that do not shrink are rounding, and elsewhere what is left counts as none


def brought_back(state: State, start: State, unknowns: Unknowns, datum: Datum) -> State | None:
    """Return the state, moved by a transformation that changes no observation, at which the conditions of a datum hold.

    Parameters
    ----------
    state, start : State
        The conditions B'(x - x0) = 0 are about the increments of the unknowns that lead from `start` to the state; a minimal datum's are
        that the unknowns held are those of the start.
    unknowns : Unknowns
    datum : Datum
        With the transformations that are free at the state.

    Returns
    -------
    State or None
        The same object where the conditions hold; None where no such transformation is found, or where what is free may
        change on the way.
    """
    b = datum.conditions
    if b is None:
        b = np.zeros(datum.defect.basis.shape)
        b[datum.held, np.arange(len(datum.held))] = 1.0

    def drift(there: State) -> Floats:
        return np.asarray(b.T @ np.column_stack([there.departure(unknowns, start), datum.defect.at(unknowns, there).basis]))

    def carry(there: State, motion: Floats) -> State:
        return carried(there, unknowns, motion)

    return back(state, datum.defect.motions, datum.defect.steady, mean_distance(start), drift, carry)


def back(there: S, motions: Floats, steady: bool, size: float, drift: Callable[[S], Floats], carry: Callable[[S, Floats], S]) -> S | None:
    """Find by Newton's method the free transformation after which conditions hold; see `brought_back`.

    Parameters
    ----------
    there : object
        A state, or whatever stands for one.
    motions : (7, d) array
        The free transformations, see `baarda.adjustment.datum.Defect`.
    steady : bool
        Whether they are free at every state.
    size : float
        Of the network, object units.
    drift : callable
        Returns by how much the conditions are missed, and how the free transformations change that, (d, 1 + d).
    carry : callable
        Moves the state along shifts, rotations and a scaling, (7,).
    """
    last = np.inf
    for _ in range(ROUNDS):
        missed = drift(there)
        if not np.isfinite(missed).all() or np.linalg.matrix_rank(missed[:, 1:]) < len(missed):
            return None
        motion = -motions @ np.linalg.solve(missed[:, 1:], missed[:, 0])
        left = float(np.linalg.norm(motion[:3])) / size + _angle(motion)
        if left <= NONE or 0.5 * last <= left <= SMALL:
            return there
        if not steady:
            return there if left <= SMALL else None
        last = left
        there = carry(there, min(1.0, LONGEST / max(_angle(motion), NONE)) * motion)
    return None


def carried(state: State, unknowns: Unknowns, motion: Floats) -> State:
    """Move all unknowns by the similarity transformation exp(motion); known values, which it must leave in place, stay exactly.

    Parameters
    ----------
    state : State
    unknowns : Unknowns
    motion : (7,) array
        Shifts, rotations about X, Y, Z in radians, and the logarithm of the scale, all going on at the same time.
    """
    generator = np.zeros((4, 4))
    generator[:3, :3] = rot.skew(motion[3:6]) + motion[6] * np.eye(3)
    generator[:3, 3] = motion[:3]
    whole = linalg.expm(generator)

    def there(x: Floats, free: NDArray[np.bool_]) -> Floats:
        return np.where(free, x @ whole[:3, :3].T + whole[:3, 3], x)

    image = unknowns["image"].columns.reshape(-1, 6) >= 0
    turn = np.where(image[:, 3:], -state.rotation @ motion[3:6], 0.0)
    return State(
        state.cameras,
        there(state.position, image[:, :3]),
        rot.exp(turn) @ state.rotation if len(turn) else state.rotation,
        there(state.points, unknowns["point"].columns.reshape(-1, 3) >= 0),
        tuple(_followed(d, unknowns[d.kind].columns >= 0, motion) for d in state.declared),
    )


def _angle(motion: Floats) -> float:
    return max(float(np.linalg.norm(motion[3:6])), float(abs(motion[6])))


def _followed(group: Declared, free: NDArray[np.bool_], motion: Floats) -> Declared:
    """Let a group that an observation kind declares follow (Runge and Kutta's fourth order)."""
    steps = max(1, int(np.ceil(_angle(motion) / SHORT)))

    def rate(d: Declared) -> Floats:
        return np.where(free, d.similarity(1.0) @ motion / steps, 0.0)

    for _ in range(steps):
        first = rate(group)
        second = rate(group.moved(0.5 * first))
        third = rate(group.moved(0.5 * second))
        fourth = rate(group.moved(third))
        group = group.moved((first + 2.0 * (second + third) + fourth) / 6.0)
    return group
