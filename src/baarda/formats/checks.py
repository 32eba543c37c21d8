"""Checks that readers share: what no adjustment could use is refused while file and line are still known."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError
from baarda.network import TIE, Points
from baarda.observations import Distances

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

#: unit of object coordinates of sources that have neither unit nor datum (structure from motion)
MODEL_UNITS = "model units"
_METRES = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048, "m": 1.0, "km": 1e3}

# row -> error with file and line of that row
Complaint = Callable[[int, str], InputError]


def measured_once(images: Ints, points: Ints, labels: Sequence[str], error: Complaint, line: Callable[[int], int]) -> None:
    """Refuse a point that is measured twice in one image.

    Parameters
    ----------
    images, points : (n,) int arrays
        Image and object point of each row.
    labels : sequence of str
        Labels of the object points.
    error, line : callable
        Row to error and to line number.

    Raises
    ------
    InputError
        That names both lines.
    """
    key = images * (int(points.max(initial=0)) + 1) + points
    order = np.argsort(key, kind="stable")
    again = np.flatnonzero(np.diff(key[order]) == 0)
    if len(again):
        at = again[np.argmin(order[again + 1])]
        first, second = int(order[at]), int(order[at + 1])
        raise error(second, f"point {labels[points[second]]!r} is measured twice in this image (first in line {line(first)})")


#: smallest and largest standard deviation that a reader accepts: squares and weights beyond them lose all digits
SIGMAS = (1e-12, 1e12)


def sigma_range(values: Sequence[float] | Floats, what: str, error: Complaint, smallest: float = SIGMAS[0]) -> None:
    """Refuse standard deviations that no measurement has; 0 (exact) and NaN (missing) are left to the caller.

    Parameters
    ----------
    values : (n,) or (n, k) array
        Standard deviations, not negative.
    what : str
        Name for the message.
    error : callable
        Row to error.
    smallest : float
        Least positive one; coefficients of distortion have far smaller ones than coordinates.

    Raises
    ------
    InputError
        That names the value.

    Examples
    --------
    >>> sigma_range([0.0, 0.5], "sigma_x", lambda row, message: InputError(message))
    """
    rows = np.asarray(values, dtype=float).reshape(len(values), -1)
    bad = np.argwhere((rows != 0.0) & ~np.isnan(rows) & ~((rows >= smallest) & (rows <= SIGMAS[1])))
    if len(bad):
        row, column = bad[0]
        raise error(int(row), f"{what} = {float(rows[row, column])!r} does not lie between {smallest:g} and {SIGMAS[1]:g}")


#: largest number of a camera that a reader accepts: no lens has more, and squares must not overflow
LARGEST_OF_CAMERA = 1e12


def camera_range(values: Sequence[float] | Floats, what: str, error: Complaint) -> None:
    """Refuse numbers that no camera has; NaN (missing) is left to the caller.

    Parameters
    ----------
    values : (n,) or (n, k) array
        Parameters of cameras, origins, sizes.
    what : str
        Name for the message.
    error : callable
        Row to error.

    Raises
    ------
    InputError
        That names the value.

    Examples
    --------
    >>> camera_range([0.0, -35.5, 1e-30], "value", lambda row, message: InputError(message))
    """
    rows = np.asarray(values, dtype=float).reshape(len(values), -1)
    bad = np.argwhere(np.abs(rows) > LARGEST_OF_CAMERA)
    if len(bad):
        row, column = bad[0]
        raise error(int(row), f"{what} = {float(rows[row, column])!r} is beyond {LARGEST_OF_CAMERA:g}")


def images_with_points(images: Ints, labels: Sequence[str], needed: NDArray[np.bool_], error: Complaint) -> None:
    """Refuse images without image points.

    Parameters
    ----------
    images : (n,) int array
        Image of each measured point.
    labels : sequence of str
        Labels of all images.
    needed : (images,) bool array
        Which images have unknowns that image points must determine.
    error : callable
        Image to error.

    Raises
    ------
    InputError
        That names the first such image.
    """
    count = np.bincount(images, minlength=len(labels))
    blind = np.flatnonzero((count == 0) & needed)
    if len(blind):
        raise error(int(blind[0]), f"image {labels[blind[0]]!r} has no image points")


def rotation_matrices(matrices: Floats, error: Complaint) -> None:
    """Refuse matrices that are not proper rotations within 1e-6; NaN = missing is left alone.

    Parameters
    ----------
    matrices : (n, 3, 3) array
    error : callable
        Row to error.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        misfit = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        improper = np.einsum("ni,ni->n", np.cross(matrices[:, 0], matrices[:, 1]), matrices[:, 2]) < 0.0
    bad = np.flatnonzero(~np.isnan(matrices).any(axis=(1, 2)) & (~(misfit <= 1e-6) | improper))
    if len(bad):
        raise error(int(bad[0]), "the matrix is not a rotation (orthonormal with determinant +1)")


def correlations(values: Floats, error: Complaint) -> None:
    """Refuse correlations of three coordinates that no covariance matrix can have.

    Parameters
    ----------
    values : (n, 3) array
        Correlations XY, XZ, YZ.
    error : callable
        Row to error.
    """
    xy, xz, yz = values.T
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = 1.0 + 2.0 * xy * xz * yz - xy**2 - xz**2 - yz**2
    bad = np.flatnonzero((np.abs(values) >= 1.0).any(axis=1) | ~(determinant > 0.0))
    if len(bad):
        raise error(int(bad[0]), "the correlations are not those of a covariance matrix (positive definite)")


def guessed_unit(unit: str, factor: float) -> str:
    """Return the unit whose numbers are `factor` times those in `unit`, empty when none fits within a third.

    Examples
    --------
    >>> guessed_unit("m", 1040.0), guessed_unit("mm", 1e-3), guessed_unit("m", 57.0)
    ('mm', 'm', '')
    """
    if unit not in _METRES:
        return ""
    misfit = {name: abs(math.log(factor * metres / _METRES[unit])) for name, metres in _METRES.items() if name != unit}
    best = min(misfit, key=misfit.__getitem__)
    return best if misfit[best] < math.log(4.0 / 3.0) else ""


def _size(xyz: Floats) -> float:
    """Return the size of a cloud of points that a few gross errors do not change."""
    return float(np.median(_lengths(xyz - np.median(xyz, axis=0)))) if len(xyz) > 1 else 0.0


def _lengths(vectors: Floats) -> Floats:
    return np.asarray(np.hypot(np.hypot(vectors[:, 0], vectors[:, 1]), vectors[:, 2]))  # no overflow on the way


def control_unit(points: Points, unit: str, error: Complaint, position: Floats | None = None) -> None:
    """Refuse control whose size contradicts the start values by a factor that only a wrong unit explains.

    Compared are the control and check points with their own start values (limit 50); where these tell nothing, with the start values of
    the other points (limit 200), where there are none, with the distances of the
    cameras (limit 50).

    Parameters
    ----------
    points : Points
    unit : str
        Unit of the start values.
    error : callable
        Index of a point to error.
    position : (images, 3) array, optional
        Start values of the projection centres.

    Raises
    ------
    InputError
        That suggests the unit.
    """
    known = np.flatnonzero(np.isfinite(points.given).all(axis=1) & (points.roles != TIE))
    if len(known) < 2:
        return
    control = points.given[known]
    both = known[np.isfinite(points.coordinates[known]).all(axis=1)]
    own, start = _size(points.given[both]), _size(points.coordinates[both])
    if own > 0.0 and start > 0.0 and not 1 / 50 < own / start < 50:
        raise error(int(both[0]), _wrong_unit(own, start, "start values of the same points", unit))
    ties = points.coordinates[np.isfinite(points.coordinates).all(axis=1) & (points.roles == TIE)]
    size = _size(control)
    if len(ties) > 2 and size > 0.0 and _size(ties) > 0.0:
        if not 1 / 200 < size / _size(ties) < 200:
            raise error(int(known[0]), _wrong_unit(size, _size(ties), "start values of the other points", unit))
    elif position is not None:
        position = position[np.isfinite(position).all(axis=1)]
        away = _lengths(position - np.median(control, axis=0))
        whose = "start values of the cameras, away from the control,"
        # what spreads far beyond all cameras is judged by a size that gross errors do not change; what looks too small must do so from
        # the camera next to it: the control may stand in one corner of a large block
        if len(away) and np.median(away) > 0.0 and size > 50.0 * np.median(away):
            raise error(int(known[0]), _wrong_unit(size, float(np.median(away)), whose, unit, 1e3))
        # a wrong unit carries the control away from the cameras, too: several cameras that all huddle at the origin of such control
        reach = float(_lengths(position).max(initial=0.0))
        if len(np.unique(position, axis=0)) > 2 and size > 100.0 * reach:
            raise error(int(known[0]), _wrong_unit(size, reach, "start values of the cameras", unit, 1e3))
        half = float(_lengths(control - 0.5 * (control.min(axis=0) + control.max(axis=0))).max())
        if len(away) and half > 0.0 and 50.0 * half < away.min():
            raise error(int(known[0]), _wrong_unit(half, float(away.min()), whose, unit, 1e-3))


def _wrong_unit(size: float, other: float, whose: str, unit: str, factor: float | None = None) -> str:
    """Return the message; the factor between the units follows from the sizes unless it is said."""
    guess = guessed_unit(unit, size / other if factor is None else factor)
    hint = f"; are the control coordinates in {guess} and not in {unit}?" if guess else "; check the unit of the control coordinates"
    return f"the control and check points spread over {size:.4g}, the {whose} over {other:.4g}: not the same unit{hint}"


def distance_unit(group: Distances, points: Points, unit: str, error: Complaint) -> None:
    """Refuse distances of which at least half are 50 times longer, or shorter, than between the start values of their ends.

    Parameters
    ----------
    group : Distances
    points : Points
    unit : str
    error : callable
        Row to error.
    """
    apart = _lengths(points.coordinates[group.ends] - points.coordinates[group.starts])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = group.values / apart
    usable = ratio[np.isfinite(ratio)]
    if len(usable) and not 1 / 50 < np.median(usable) < 50:
        i = int(np.flatnonzero(np.isfinite(ratio) & ((ratio >= 50.0) | (ratio <= 1 / 50)))[0])
        guess = guessed_unit(unit, float(ratio[i]))
        hint = f"; is it in {guess} and not in {unit}?" if guess else "; check its unit"
        raise error(i, f"the distance is {group.values[i]!r}, the start values of its ends are {apart[i]:.6g} apart{hint}")
