"""From where each object point is seen, and how a point moves along its rays, to infinity and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

FAR = 100.0  # times the base of its rays: beyond, a point's image coordinates are linear in the inverse of its distance
DOUBTFUL = 30.0  # times the base
FARTHEST = 1e9  # times the base: as near as a point comes to infinity on its way
START = 1e4  # times the base: beyond, the distance hardly counts in 16 digits of a normal equation
SMALL = 0.1  # part of its distance by which a near point moves straight


@dataclass(frozen=True)
class Viewpoints:
    """From where points are seen.

    Attributes
    ----------
    centres : (points, 3) array
        Mean place of the images that see a point, object units; NaN where none does.
    base : (points,) array
        Their root mean square distance from it; NaN for points that are not to move as far ones.
    """

    centres: Floats
    base: Floats

    @staticmethod
    def of(images: Ints, points: Ints, position: Floats, count: int) -> Viewpoints:
        """Gather the viewpoints of `count` points from the images and points of (n,) rays and the positions (images, 3).

        Examples
        --------
        >>> Viewpoints.of(np.array([0, 1]), np.array([0, 0]), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), 1).base
        array([1.])
        """
        rays = np.bincount(points, minlength=count)
        origin = np.nan_to_num(position[:1]).sum(axis=0)  # squares of small numbers round less
        near = position - origin
        table = np.concatenate([near, (near**2).sum(axis=1)[:, None]], axis=1)
        with np.errstate(invalid="ignore"):
            x, y, z, square = (np.bincount(points, column[images], count) / rays for column in table.T)
            centres = np.stack([x, y, z], axis=1)
            return Viewpoints(centres + origin, np.sqrt(np.maximum(square - (centres**2).sum(axis=1), 0.0)))

    def far(self, points: Floats) -> Bools:
        """Return which points (n, 3) are so far that only their directions and inverse distances have nearly normal errors."""
        return self._beyond(points, FAR)

    def doubtful(self, points: Floats) -> Bools:
        """Return which points (n, 3) may prove to be far, if an adjustment stalls."""
        return self._beyond(points, DOUBTFUL)

    def beyond_start(self, points: Floats) -> Bools:
        """Return which points (n, 3) are too far for a start: see `nearer`."""
        return self._beyond(points, START)

    def _beyond(self, points: Floats, limit: float) -> Bools:
        with np.errstate(invalid="ignore"):
            return np.asarray((np.linalg.norm(points - self.centres, axis=1) > limit * self.base) & (self.base > 0.0))

    def nearer(self, points: Floats, which: Bools) -> Floats:
        """Return points (n, 3), some of them brought along their mean ray to 10 000 times the base.

        Examples
        --------
        >>> seen = Viewpoints(np.zeros((1, 3)), np.array([2.0]))
        >>> seen.nearer(np.array([[0.0, 0.0, 1e9]]), np.array([True]))
        array([[    0.,     0., 20000.]])
        """
        out = np.array(points)
        ray = points[which] - self.centres[which]
        out[which] = self.centres[which] + ray * (START * self.base[which] / np.linalg.norm(ray, axis=1))[:, None]
        return out

    def moved(self, points: Floats, steps: Floats) -> Floats:
        """Return where points (n, 3) come by their steps, the part along the ray taken in inverse distance.

        Image coordinates are nearly linear in the inverse of the distance, so that points almost at infinity do not creep (Civera, Davison
        & Montiel 2008). With s the step along the ray over the distance, the distance is divided by 1 - s; beyond s = 1/2 a near point
        goes on in proportion. A far one turns by its step and may pass infinity, to come back from behind: its direction stays, and what
        its rays say is only that their bundle opens. Steps of near points with |s| below 0.1 are left as they are, so that sums of small
        steps keep the conditions of a datum. To first order nothing changes.

        Examples
        --------
        >>> seen = Viewpoints(np.zeros((3, 3)), np.array([1.0, 0.01, 0.01]))
        >>> seen.moved(np.full((3, 3), [10.0, 0.0, 0.0]), np.array([[2.0, 1.0, 0.0], [2.0, 1.0, 0.0], [20.0, 0.0, 0.0]]))
        array([[ 12.5 ,   1.  ,   0.  ],
               [ 12.5 ,   1.25,   0.  ],
               [-10.  ,   0.  ,   0.  ]])
        """
        out, ray = points + steps, points - self.centres
        square, along = np.einsum("ni,ni->n", ray, ray), np.einsum("ni,ni->n", steps, ray)
        reach = (FAR * self.base) ** 2
        some = np.flatnonzero((np.abs(along) > SMALL * square) | ((square > reach) & (reach > 0.0)))  # false for NaN
        if not len(some):
            return out
        ray, steps, s = ray[some], steps[some], along[some] / square[some]
        before = self.base[some] / np.sqrt(square[some])  # the inverse distance in inverse bases, and that after the step
        after = before * (1.0 - s)
        far = (before > 0.0) & (before < 1.0 / FAR) & (after > -1.0 / FAR)
        near = np.where(far | (np.abs(s) <= SMALL), 0.0, s)
        longer = np.where(near < 0.5, near / (1.0 - np.minimum(near, 0.5)), 4.0 * near - 1.0)
        out[some] += (longer - near)[:, None] * ray
        at, ray, least = some[far], ray[far], 1.0 / FARTHEST
        longer = before[far] / np.where(np.abs(after[far]) < least, np.copysign(least, after[far]), after[far]) - 1.0
        across = steps[far] - s[far, None] * ray
        out[at] = points[at] + longer[:, None] * ray + (1.0 + longer)[:, None] * across
        return out
