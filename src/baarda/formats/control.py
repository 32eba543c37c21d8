"""A table of control and check points for a network of any source."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE
from baarda.errors import InputError, UsageError
from baarda.formats import checks
from baarda.formats.csv_table import read_csv
from baarda.formats.project import points_of
from baarda.formats.project_writer import CORRELATIONS
from baarda.geometry.similarity import Similarity, similarity
from baarda.network import AXES, CONTROL, TIE, Network, Points

Floats = NDArray[np.float64]


def with_control(network: Network, path: Path) -> Network:
    """Return the network with the control and check points of a table in place of its own.

    Parameters
    ----------
    network : Network
    path : Path
        A CSV table with the columns point, X, Y, Z and, optional, role (control or check; default control), sigma_X, sigma_Y, sigma_Z,
        state_X, state_Y, state_Z, correlation_XY, correlation_XZ, correlation_YZ; in the unit of the network, metres where it has none.

    Returns
    -------
    Network
        All other points are tie points. A network in model units is carried over to the system of the control points by a similarity
        transformation of its start values; this needs three control points with start values.

    Raises
    ------
    InputError
        With file and line, if the table cannot be used or no point of it is in the network.

    Notes
    -----
    An empty coordinate is not known (control in height or position only); a sigma of zero, or no column of sigmas, holds a coordinate
    fixed; points that the network does not have are left out, and the network's assumptions say so.
    """
    states = tuple(f"{kind}_{axis}" for kind in ("state", "sigma") for axis in AXES)
    table = read_csv(path, ("point", *AXES), ("role", *states, *CORRELATIONS))
    notes: list[str] = []
    given = points_of(table, notes, default_role=CONTROL)
    ties = np.flatnonzero(given.roles == TIE)
    if len(ties):
        raise table.error(int(ties[0]), "the role of a point in a table of control must be control or check")
    index = {label: i for i, label in enumerate(network.points.labels)}
    rows = np.array([i for i, label in enumerate(given.labels) if label in index], dtype=np.intp)
    if not len(rows):
        raise table.error(0, f"no point of the table is in the network, whose points are called {_some(network.points.labels)}")
    if len(rows) < len(given.labels):
        absent = [label for label in given.labels if label not in index]
        notes.append(f"{len(absent)} point(s) of {path.name} are not measured and left out: {_some(absent)}")
    at = np.array([index[given.labels[i]] for i in rows], dtype=np.intp)
    row_of = dict(zip(at.tolist(), rows.tolist(), strict=True))

    def error(point: int, message: str) -> InputError:
        return table.error(row_of.get(point, 0), message)

    points = _replaced(network.points, given, rows, at, network.offset)
    if network.unit == checks.MODEL_UNITS:
        network, points = carried_over(network, points, path, notes)
    else:
        checks.control_unit(points, network.unit, error, network.images.position)
    known = np.isfinite(points.given) & (points.roles == CONTROL)[:, None]
    start = known & ((points.states == FIXED) | np.isnan(points.coordinates))
    points = replace(points, coordinates=np.where(start, points.given, points.coordinates))
    return replace(network, points=points, assumptions=(*network.assumptions, *notes))


def _some(labels: list[str] | tuple[str, ...]) -> str:
    return ", ".join(labels[:10]) + (", ..." if len(labels) > 10 else "")


def _replaced(points: Points, given: Points, rows: NDArray[np.intp], at: NDArray[np.intp], offset: Floats) -> Points:
    """Return the points with the roles, states, given values and sigmas of the table; all others are free tie points."""
    fresh = Points.make(points.labels, points.coordinates)

    def merged(name: str) -> NDArray[Any]:
        column = np.array(getattr(fresh, name))
        column[at] = getattr(given, name)[rows]
        return column

    merged_given = merged("given")
    merged_given[at] += offset
    return replace(
        fresh,
        roles=merged("roles"),
        states=merged("states"),
        given=merged_given,
        sigmas=merged("sigmas"),
        correlations=merged("correlations"),
    )


def carried_over(network: Network, points: Points, path: Path, notes: list[str]) -> tuple[Network, Points]:
    """Carry start values in model units over to the system of the control points."""
    if (network.images.states != FREE).any() or any(hasattr(g, "starts") for g in network.observations):
        raise InputError("control cannot be joined with distances or known orientations that are in model units", path)
    use = np.flatnonzero((points.roles == CONTROL) & np.isfinite(points.given).all(axis=1) & np.isfinite(points.coordinates).all(axis=1))
    try:
        to_control: Similarity = similarity(points.coordinates[use], points.given[use])
    except UsageError as error:
        raise InputError(
            f"the model has no datum, and its start values cannot be carried over to the control points: {error}", path
        ) from None
    coordinates = to_control.apply(points.coordinates)
    misfit = float(np.sqrt(np.mean(np.sum((coordinates[use] - points.given[use]) ** 2, axis=1))))
    images = network.images
    # a camera vector is M (X - X0); with X' = s R X + t it is M R' (X' - X0') / s
    images = replace(images, position=to_control.apply(images.position), rotation=images.rotation @ to_control.rotation.T)
    notes.append(
        f"start values were carried over from model units to the system of {len(use)} control points (scale {to_control.scale:.6g}, "
        f"rms distance {misfit:.3g}); its unit is taken as m"
    )
    return replace(network, images=images, unit="m"), replace(points, coordinates=coordinates)
