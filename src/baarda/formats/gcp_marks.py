"""Ground control points with their own image marks: joining them with the network that another file gave."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FREE, OBSERVED, Optics
from baarda.errors import InputError, UsageError
from baarda.geometry.intersection import PointStatus, intersect
from baarda.geometry.similarity import similarity
from baarda.network import CHECK, CONTROL, TIE, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

GROUP = "control marks"
PREFIX = "GCP "  # of a control point whose label another point bears


@dataclass(frozen=True)
class Marks:
    """Control points of a file and where they were seen.

    Attributes
    ----------
    file : Path
    labels : tuple of str
    given : (n, 3) array
        Surveyed coordinates in the network's system, NaN = not known.
    points, images : (k,) int arrays
        Control point and image of each mark.
    xy : (k, 2) array
        Source pixels of the network.
    """

    file: Path
    labels: tuple[str, ...]
    given: Floats
    points: Ints
    images: Ints
    xy: Floats


def with_marks(
    network: Network,
    marks: Marks,
    sigma: Floats,
    notes: list[str],
    move: bool = True,
    roles: Any = None,
    sigma_marks: float | None = None,
) -> Network:
    """Return the network with the control points of a file, their marks and coordinates.

    Parameters
    ----------
    network : Network
    marks : Marks
    sigma : (3,) or (n, 3) array
        Standard deviations of the surveyed X, Y, Z.
    notes : list of str
        Takes what was decided.
    move : bool
        Whether to carry the start values of the network over to three or more control points by a similarity transformation, and, with
        fewer than three, to make them check points.
    roles : (n,) array, optional
        Of the points; by default all with surveyed coordinates are control points.
    sigma_marks : float, optional
        Of the marks, pixels; by default as that of the other image points.

    Returns
    -------
    Network
        A control point whose label another point bears is called ``GCP label``; without surveyed coordinates it is a tie point. Tie and
        check points start where their rays meet, else where they were surveyed.

    Raises
    ------
    InputError
        If a control point appears twice.
    """
    measured = np.bincount(marks.points, minlength=len(marks.labels)) > 0
    if not measured.all():
        lost = [marks.labels[i] for i in np.flatnonzero(~measured)]
        notes.append(f"{len(lost)} control point(s) of {marks.file.name} without a mark in an oriented image are left out: {some(lost)}")
    if not measured.any():
        return network
    use = np.flatnonzero(measured)
    position = np.full(len(marks.labels), -1)
    position[use] = np.arange(len(use))
    taken = set(network.points.labels)
    labels = [f"{PREFIX}{marks.labels[i]}" if marks.labels[i] in taken else marks.labels[i] for i in use]
    twice = next((name for name in labels if name in taken), None)
    if twice is not None or len(set(labels)) < len(labels):
        raise InputError(f"control point {twice or next(n for n in labels if labels.count(n) > 1)!r} is there twice", marks.file)
    if any(name != marks.labels[i] for name, i in zip(labels, use, strict=True)):
        notes.append(f"control points of {marks.file.name} are called 'GCP ...' where another point has their label")
    given = marks.given[use]
    known = np.isfinite(given)
    start = intersected(network, position[marks.points], marks.images, marks.xy, len(use))
    role = np.where(known.any(axis=1), CONTROL, TIE) if roles is None else np.asarray(roles)[use]
    if move and known.any():
        whole = known.all(axis=1)
        if whole.sum() < 3:
            role = np.where(role == CONTROL, CHECK, role)
            notes.append(
                f"{marks.file.name} has {int(whole.sum())} measured control point(s) with X, Y, Z; the datum needs three: "
                "they are check points, and the block stays in the system of its source"
            )
        else:
            network, start = _onto_control(network, start, given, marks.file.name, notes)
    enters = known & (role == CONTROL)[:, None]
    fresh = Points.make(
        labels,
        np.where(enters | np.isnan(start), given, start),
        role,
        np.where(enters, OBSERVED, FREE),
        given,
        np.where(known, np.broadcast_to(sigma, marks.given.shape)[use], np.nan),
    )
    shift = len(network.points.labels)
    usual = sigma_marks or next((float(np.median(g.sigmas)) for g in network.observations if isinstance(g, ImagePoints)), 1.0)
    names = {g.name for g in network.observations}
    name = GROUP if GROUP not in names else f"{GROUP} of {marks.file.name}"
    rows = ImagePoints.make(marks.images, position[marks.points] + shift, marks.xy, usual, name=name)
    return replace(network, points=joined(network.points, fresh), observations=(*network.observations, rows))


def _onto_control(network: Network, start: Floats, given: Floats, file: str, notes: list[str]) -> tuple[Network, Floats]:
    """Carry the start values of a network over to its control points, of which `start` are the intersections."""
    use = np.flatnonzero(np.isfinite(given).all(axis=1) & np.isfinite(start).all(axis=1))
    try:
        to_control = similarity(start[use], given[use])
    except UsageError:  # too few, or on a line: the adjustment goes from where it stands
        return network, start
    images = network.images
    moved = to_control.apply(start)
    misfit = float(np.sqrt(np.mean(np.sum((moved[use] - given[use]) ** 2, axis=1))))
    before = float(np.sqrt(np.mean(np.sum((start[use] - given[use]) ** 2, axis=1))))
    notes.append(
        f"start values were carried over to {len(use)} control points of {file} (scale {to_control.scale:.6g}, rms distance "
        f"{misfit:.3g} instead of {before:.3g})"
    )
    images = replace(images, position=to_control.apply(images.position), rotation=images.rotation @ to_control.rotation.T)
    points = replace(network.points, coordinates=to_control.apply(network.points.coordinates))
    return replace(network, images=images, points=points), moved


def put_on_control(network: Network, path: Path, notes: list[str]) -> Network:
    """Carry a network in model units over to its control points, three at least.

    Raises
    ------
    InputError
        If they are too few or lie on a line.
    """
    from baarda.formats.control import carried_over

    points = network.points
    if not (points.roles == CONTROL).any():
        return network
    owned = np.concatenate([g.points for g in network.observations if isinstance(g, ImagePoints)])
    images, xy = (np.concatenate([getattr(g, a) for g in network.observations if isinstance(g, ImagePoints)]) for a in ("images", "xy"))
    control = np.flatnonzero(points.roles == CONTROL)
    at = np.full(len(points.labels), -1)
    at[control] = np.arange(len(control))
    rows = np.flatnonzero(at[owned] >= 0)
    start = np.array(points.coordinates)
    start[control] = intersected(network, at[owned[rows]], images[rows], xy[rows], len(control))
    network, points = carried_over(network, replace(points, coordinates=start), path, notes)
    known = np.isfinite(points.given) & (points.roles == CONTROL)[:, None]
    return replace(network, points=replace(points, coordinates=np.where(known, points.given, points.coordinates)))


def joined(a: Points, b: Points) -> Points:
    """Return the points of two tables, one after the other."""
    columns = ("coordinates", "roles", "states", "given", "sigmas", "correlations")
    return Points((*a.labels, *b.labels), *(np.concatenate([getattr(a, c), getattr(b, c)]) for c in columns))


def intersected(network: Network, points: Ints, images: Ints, xy: Floats, count: int) -> Floats:
    """Return the intersections of the rays of some points, NaN where there is none; (count, 3)."""
    out = np.full((count, 3), np.nan)
    owner = network.images.cameras[images]
    normalised, valid = np.empty_like(xy), np.zeros(len(xy), dtype=bool)
    for i in np.unique(owner):
        rows, camera = owner == i, network.cameras[i]
        normalised[rows], valid[rows] = Optics.of(camera).correct(xy[rows], camera.values[None])
    oriented = np.isfinite(network.images.position).all(axis=1) & np.isfinite(network.images.rotation).all(axis=(1, 2))
    use = np.flatnonzero(valid & np.asarray(oriented)[images])
    if len(use):
        at = images[use]
        found = intersect(normalised[use], network.images.rotation[at], network.images.position[at], points[use], count, min_angle=1e-4)
        good = found.status == PointStatus.OK
        out[good] = found.points[good]
    return out


def some(labels: list[str]) -> str:
    """Return the first labels of a list for a message."""
    return ", ".join(labels[:10]) + (", ..." if len(labels) > 10 else "")
