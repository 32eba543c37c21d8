"""Points whose rays are so nearly parallel that their distance cannot be told from infinity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED
from baarda.network import State
from baarda.observations import ImagePoints, viewpoints_of

if TYPE_CHECKING:
    from baarda.adjustment.result import Adjustment

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

RESOLVED = 3.0  # standard deviations of its inverse distance that a point must be away from infinity
ONE_SIDED = 1.6448536269514722  # normal fractile of 95 %


@dataclass(frozen=True)
class FarPoints:
    """Points that cannot be told from infinity.

    Attributes
    ----------
    points : (k,) int array
        Their numbers in the network.
    least : (k,) array
        Limit that their distance from the middle of the images that see them exceeds with a probability of 95 %, object units; infinite
        where even that lies beyond infinity.
    """

    points: Ints
    least: Floats


def far_points(a: Adjustment) -> FarPoints:
    """Return the points beyond 100 bases of their rays whose inverse distance is less than 3 of its standard deviations.

    Image coordinates are nearly linear in the inverse distance rho = 1/r, which may come out negative: the rays open, the point stands
    behind its images. Its standard deviation (a posteriori) is sigma_r / r^2, so that the ratio is r / sigma_r.
    """
    network, state = a.network, State.of(a.network)
    own = np.flatnonzero((network.points.states != FIXED).all(axis=1) & ~a.aside)
    seen = viewpoints_of(a.groups, state)
    own = own[seen.base[own] > 0.0]
    ray = state.points[own] - seen.centres[own]
    r = np.linalg.norm(ray, axis=1)
    deviation = a.scale("aposteriori") * np.sqrt(np.einsum("ni,nij,nj->n", ray, a.point_cofactors[own], ray)) / r
    weak = np.flatnonzero(seen.far(state.points)[own] & (r < RESOLVED * deviation))
    own, r, deviation = own[weak], r[weak], deviation[weak]
    front = np.zeros(len(network.points.labels))  # rays with the point in front of the camera, less the others
    for group in a.groups if len(own) else ():
        if isinstance(group, ImagePoints):
            front += np.bincount(group.points, np.where(group.in_front(network, state), 1.0, -1.0), len(front))
    nearest = np.where(front[own] < 0.0, -1.0, 1.0) / r + ONE_SIDED * deviation / r**2
    return FarPoints(own, np.where(nearest > 0.0, 1.0 / np.where(nearest > 0.0, nearest, 1.0), np.inf))
