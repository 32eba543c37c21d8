"""External reliability on the unknowns: what an undetected bias does to the camera, the image and the points of its observation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from baarda.adjustment import Adjustment

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

WIDTH = 192  # right-hand sides at once
MOST = 1e7  # numbers solved for in all; beyond, object points and images are left out
MOST_FELT = 2e9  # effects on all observations computed in all; beyond, cameras are left out too


@dataclass(frozen=True)
class Effects:
    """The largest effect of a bias in each observation.

    Attributes
    ----------
    values : (n,) array
        Effect on the unknown `names`, in its unit, with the sign for a positive bias; NaN where there is no bias.
    names : (n,) object array
        The unknown whose effect is the largest part of its own a-priori standard deviation; empty where there is none.
    ratios : (n,) array
        That part, absolute: at most the external reliability of the observation.
    complete : bool
        False where only effects on cameras were computed, for the number of unknowns.
    """

    values: Floats
    names: NDArray[np.object_]
    ratios: Floats
    complete: bool


def external_effects(a: Adjustment, biases: Floats) -> Effects:
    """Return the largest effect of a bias in each observation on an unknown of its own camera, image or points.

    Parameters
    ----------
    a : Adjustment
    biases : (n,) array
        Of the observations, in their units, for instance minimal detectable biases; NaN = none.

    Returns
    -------
    Effects

    Notes
    -----
    Baarda (1968): Qxx A'P e_i b_i by one solve per unknown, without arrays of n x n or n x u. Unknowns of other points and images, which
    usually feel less, are not searched.
    """
    n = a.count
    values, ratios, column = np.full(n, np.nan), np.full(n, -1.0), np.full(n, -1, dtype=np.intp)
    complete = 1.0 * a.numbering.count**2 <= MOST
    cameras = int((a.numbering["camera"].columns >= 0).sum())
    if not complete and 1.0 * cameras * n > MOST_FELT:
        return Effects(values, np.full(n, "", dtype=object), values.copy(), complete)
    for c in a.lin.chunks:
        weighted = np.linalg.inv(c.factor).transpose(0, 2, 1)
        for part in c.parts:
            if part.kind != "camera" and not complete:
                continue
            columns = part.columns
            for some in _batches(part.nodes, columns):
                at, inverse = np.unique(columns[some], return_inverse=True)
                inverse = inverse.reshape(columns[some].shape)
                free = at[at >= 0]
                unit = np.zeros((a.numbering.count, len(free)))
                unit[free, np.arange(len(free))] = 1.0
                with threadpool_limits(limits=1, user_api="blas"):
                    q = a.cofactors.solve(unit)
                    rows = c.rows[some].ravel()
                    felt = np.asarray(a.lin.design[rows] @ q if complete else a.lin.times(q)[rows])
                sigma = np.sqrt(q[free, np.arange(len(free))])
                m, w = c.rows.shape[1], columns.shape[1]
                place = inverse - (len(at) - len(free))  # -1 for a fixed parameter
                felt = felt.reshape(len(some), m, -1)[np.arange(len(some))[:, None, None], np.arange(m)[None, :, None], place[:, None, :]]
                effect = (weighted[some] @ felt) * biases[c.rows[some]][:, :, None]  # (N, m, w)
                with np.errstate(invalid="ignore", divide="ignore"):
                    ratio = np.abs(effect) / sigma[place][:, None, :]
                ratio[np.broadcast_to((place < 0)[:, None, :], ratio.shape) | ~np.isfinite(ratio)] = -1.0
                if not w:
                    continue
                best = np.argmax(ratio, axis=2)
                rows = c.rows[some]
                largest = np.take_along_axis(ratio, best[:, :, None], axis=2)[:, :, 0]
                better = largest > ratios[rows]
                ratios[rows[better]] = largest[better]
                values[rows[better]] = np.take_along_axis(effect, best[:, :, None], axis=2)[:, :, 0][better]
                chosen = np.take_along_axis(np.broadcast_to(columns[some][:, None, :], ratio.shape), best[:, :, None], axis=2)[:, :, 0]
                column[rows[better]] = chosen[better]
    table = np.array([*a.numbering.names, ""], dtype=object)
    return Effects(values, table[column], np.where(ratios < 0.0, np.nan, ratios), complete)


def _batches(nodes: NDArray[Any], columns: Ints) -> list[Ints]:
    """Return the row blocks of some nodes at a time, about `WIDTH` unknowns together; none where nothing is unknown."""
    free = np.flatnonzero((columns >= 0).any(axis=1))
    if not len(free):
        return []
    _, code = np.unique(nodes[free], return_inverse=True)
    step = max(1, WIDTH // columns.shape[1])
    order = free[np.argsort(code, kind="stable")]
    groups = np.sort(code) // step
    return np.split(order, np.flatnonzero(np.diff(groups)) + 1)
