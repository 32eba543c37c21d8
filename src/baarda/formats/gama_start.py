"""Start values of plane networks: orientations from known bearings, polar points and intersections, until nothing more is found."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_LEAST = 0.05  # sine of the angle at which two rays still intersect


@dataclass(frozen=True)
class Sights:
    """What was measured, by indices of points; all angles in radians, clockwise, bearings from +Y.

    Attributes
    ----------
    directions : list of (set, start, end, direction)
    azimuths : list of (start, end, bearing)
    distances : list of (start, end, distance)
    angles : list of (start, back, fore, angle)
    """

    directions: list[tuple[int, int, int, float]]
    azimuths: list[tuple[int, int, float]]
    distances: list[tuple[int, int, float]]
    angles: list[tuple[int, int, int, float]]


def complete(given: Floats, plane: NDArray[np.bool_], sights: Sights, sets: int) -> tuple[Floats, Floats]:
    """Return plane coordinates of all points and orientations of all sets, as far as they can be found.

    Parameters
    ----------
    given : (n, 2) array
        X, Y; NaN = wanted.
    plane : (n,) bool array
        Points that have plane coordinates.
    sights : Sights
    sets : int
        Number of sets of directions.

    Returns
    -------
    xy : (n, 2) array
    orientations : (sets,) array
        Bearings of the circles' zeros, radians; NaN where none was found.

    Examples
    --------
    >>> sights = Sights([(0, 0, 1, 0.0), (0, 0, 2, np.pi / 2)], [], [(0, 2, 5.0)], [])
    >>> xy, o = complete(np.array([[0.0, 0.0], [0.0, 9.0], [np.nan, np.nan]]), np.full(3, True), sights, 1)
    >>> np.round(xy[2], 6) + 0.0, np.round(o, 6)
    (array([5., 0.]), array([0.]))
    """
    xy, orientations = np.array(given), np.full(sets, np.nan)
    length = {pair: d for i, j, d in sights.distances for pair in ((i, j), (j, i))}
    while True:
        known = np.asarray(np.isfinite(xy).all(axis=1))
        before = int(known.sum()) + int(np.isfinite(orientations).sum())
        _orient(xy, known, orientations, sights)
        rays = list(_rays(xy, known, orientations, sights))
        for i, j, t in rays:
            if np.isfinite(xy[i]).all() and not np.isfinite(xy[j]).all() and (i, j) in length and plane[j]:
                xy[j] = xy[i] + length[i, j] * np.array([np.sin(t), np.cos(t)])
        if int(np.isfinite(xy).all(axis=1).sum()) == int(known.sum()):
            _intersect(xy, plane, rays)
        if int(np.isfinite(xy).all(axis=1).sum()) + int(np.isfinite(orientations).sum()) == before:
            return xy, orientations


def _bearing(xy: Floats, i: int, j: int) -> float:
    d = xy[j] - xy[i]
    return float(np.arctan2(d[0], d[1]))


def _orient(xy: Floats, known: NDArray[np.bool_], orientations: Floats, sights: Sights) -> None:
    """Orient sets by bearings to known points, and by lines of known bearing even where their ends are not known."""
    lines = {(i, j): t for i, j, t in _rays(xy, known, orientations, sights)}
    found: dict[int, list[float]] = {}
    for s, i, j, value in sights.directions:
        if known[i] and known[j] and (xy[i] != xy[j]).any():
            found.setdefault(s, []).append(_bearing(xy, i, j) - value)
        elif (i, j) in lines:
            found.setdefault(s, []).append(lines[i, j] - value)
    for s, several in found.items():
        if not np.isfinite(orientations[s]):
            orientations[s] = np.angle(np.exp(1j * np.array(several)).mean())


def _rays(xy: Floats, known: NDArray[np.bool_], orientations: Floats, sights: Sights) -> Iterator[tuple[int, int, float]]:
    """Yield the lines of known bearing, both ways."""
    both = [(i, j, orientations[s] + value) for s, i, j, value in sights.directions if np.isfinite(orientations[s])]
    both += sights.azimuths
    for i, back, fore, value in sights.angles:
        if known[i] and known[back]:
            both.append((i, fore, _bearing(xy, i, back) + value))
        if known[i] and known[fore]:
            both.append((i, back, _bearing(xy, i, fore) - value))
    for i, j, t in both:
        yield i, j, t
        yield j, i, t + np.pi


def _intersect(xy: Floats, plane: NDArray[np.bool_], rays: list[tuple[int, int, float]]) -> None:
    """Intersect the two rays to each wanted point that cross best."""
    wanted: dict[int, list[tuple[int, float]]] = {}
    for i, j, t in rays:
        if np.isfinite(xy[i]).all() and not np.isfinite(xy[j]).all() and plane[j]:
            wanted.setdefault(j, []).append((i, t))
    for j, several in wanted.items():
        pairs = [(abs(np.sin(s - t)), a, s, b, t) for n, (a, s) in enumerate(several) for b, t in several[:n] if a != b]
        if pairs and max(pairs)[0] > _LEAST:
            _, a, s, b, t = max(pairs)
            u, v = np.array([np.sin(s), np.cos(s)]), np.array([np.sin(t), np.cos(t)])
            along = np.linalg.solve(np.stack([u, -v], axis=1), xy[b] - xy[a])
            if (along > 0.0).all():
                xy[j] = xy[a] + along[0] * u
