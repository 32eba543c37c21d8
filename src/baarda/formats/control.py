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
from baarda.formats.coordinate_system import FRAME as _SOURCE_FRAME
from baarda.formats.coordinate_system import CoordinateSystem, Geoid, checked
from baarda.formats.csv_table import CsvTable, read_csv
from baarda.formats.gcp_marks import PREFIX
from baarda.formats.project import points_of
from baarda.formats.project_writer import CORRELATIONS
from baarda.geometry.similarity import Similarity, similarity
from baarda.geometry.tangent_frame import A, TangentFrame
from baarda.network import AXES, CONTROL, TIE, Network, Points

Floats = NDArray[np.float64]

MOVED = "moved_to_control"  # key of the settings of a network: it no longer stands in the system of its source
_GEOID = "geoid_height"  # column of a table in a coordinate system


def with_control(network: Network, path: Path, system: CoordinateSystem | None = None) -> Network:
    """Return the network with the control and check points of a table in place of its own.

    Parameters
    ----------
    network : Network
    path : Path
        A CSV table with the columns point, X, Y, Z and, optional, role (control or check; default control), sigma_X, sigma_Y, sigma_Z,
        state_X, state_Y, state_Z, correlation_XY, correlation_XZ, correlation_YZ; in the unit of the network, metres where it has none.
    system : CoordinateSystem, optional
        That of the table: easting or longitude, northing or latitude, height; then also geoid_height in metres. The network is led to the
        frame (east, north, up) in the middle of the control points, or to that of its own source.

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
    table = read_csv(path, ("point", *AXES), ("role", *states, *CORRELATIONS, *(() if system is None else (_GEOID,))))
    notes: list[str] = []
    given = points_of(table, notes, default_role=CONTROL)
    own = system is not None and _own_frame(network, system)
    if system is not None:
        network, given = _led(network, given, table, system, own, notes)
    ties = np.flatnonzero(given.roles == TIE)
    if len(ties):
        raise table.error(int(ties[0]), "the role of a point in a table of control must be control or check")
    index = {label: i for i, label in enumerate(network.points.labels)}
    # a marked control point that shares its label with a tie point is called so
    index.update({label.removeprefix(PREFIX): i for label, i in list(index.items()) if label.startswith(PREFIX)})
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
    if network.unit == checks.MODEL_UNITS or (system is not None and not own):
        network, points = carried_over(network, points, path, notes)
        network = replace(network, settings={**network.settings, MOVED: True})
    else:
        checks.control_unit(points, network.unit, error, network.images.position)
    known = np.isfinite(points.given) & (points.roles == CONTROL)[:, None]
    start = known & ((points.states == FIXED) | np.isnan(points.coordinates))
    points = replace(points, coordinates=np.where(start, points.given, points.coordinates))
    return replace(network, points=points, assumptions=(*network.assumptions, *notes))


def _own_frame(network: Network, system: CoordinateSystem) -> bool:
    """Tell whether the coordinates of a network stand in the frame that its own source names, on the ellipsoid of a system."""
    return network.unit == "m" and _SOURCE_FRAME in network.settings and abs(system.ellipsoid[0] - A) < 0.01


def _led(network: Network, given: Points, table: CsvTable, system: CoordinateSystem, own: bool, notes: list[str]) -> tuple[Network, Points]:
    """Return the network with the frame among its settings, and the points of the table in that frame with their covariances."""
    xyz = given.given
    bad = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    if len(bad):
        raise table.error(int(bad[0]), "a point in a coordinate system needs X, Y and Z; give what is not known a large sigma")
    fixed = given.states == FIXED
    mixed = np.flatnonzero((fixed.any(axis=1) & ~fixed.all(axis=1)) | ((given.roles == CONTROL) & (given.states == FREE).any(axis=1)))
    if len(mixed):
        raise table.error(int(mixed[0]), "in a coordinate system the coordinates of a control point are all fixed, or all have a sigma")
    local_heights = table.numbers(_GEOID) if _GEOID in table.columns else np.full(len(table), np.nan)
    known = np.isfinite(local_heights)
    if known.any():
        if system.geoid is not None:
            raise table.error(int(np.argmax(known)), f"geoid heights are given by --geoid and by the column {_GEOID}")
        plain = system.geographic(xyz)
        system = replace(system, geoid=Geoid.through(plain[known, 1], plain[known, 0], local_heights[known]))
    lla = system.geographic(xyz)
    if known.any():  # its own geoid height where a point has one
        lla[known, 2] = xyz[known, 2] * system.units[1] + local_heights[known]
    checked(lla, xyz, system, table.error)
    if own:
        frame = TangentFrame(*(float(v) for v in network.settings[_SOURCE_FRAME]))
    else:
        frame = TangentFrame(float(lla[:, 0].mean()), float(lla[:, 1].mean()), 0.0, *system.ellipsoid)
    local = frame.local(lla)
    known_sigma = np.isfinite(given.sigmas).all(axis=1) & (given.sigmas > 0.0).any(axis=1)
    sigmas, correlations = np.array(given.sigmas), np.array(given.correlations)
    rows = np.flatnonzero(known_sigma)
    if len(rows):
        j = system.partials(local[rows], frame)
        c = j @ given.covariance(rows) @ j.transpose(0, 2, 1)
        s = np.sqrt(np.einsum("nii->ni", c))
        sigmas[rows] = s
        correlations[rows] = np.stack([c[:, a, b] / (s[:, a] * s[:, b]) for a, b in ((0, 1), (0, 2), (1, 2))], axis=1)
    notes.append(
        f"{system.text()}; the block is adjusted in the frame (east, north, up) that touches its ellipsoid at latitude "
        f"{frame.latitude!r}, longitude {frame.longitude!r}, height {frame.height:g}; covariances are turned with it"
    )
    at = np.isfinite(given.coordinates).all(axis=1) & (given.roles == CONTROL)
    points = replace(
        given,
        given=local,
        sigmas=sigmas,
        correlations=correlations,
        coordinates=np.where(at[:, None], local, np.nan),
    )
    return replace(network, settings={**network.settings, **system.settings(frame)}), points


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


def _their_unit(unit: str) -> str:
    return unit if unit == checks.MODEL_UNITS else "their own system"


def carried_over(network: Network, points: Points, path: Path, notes: list[str]) -> tuple[Network, Points]:
    """Carry start values in model units over to the system of the control points."""
    lengths = any(hasattr(g, "starts") for g in network.observations) and network.unit != "m"
    if (network.images.states != FREE).any() or lengths:
        raise InputError(f"control cannot be joined with distances or known orientations that are in {network.unit}", path)
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
        f"start values were carried over from {_their_unit(network.unit)} to the system of {len(use)} control points "
        f"(scale {to_control.scale:.6g}, rms distance {misfit:.3g}); its unit is taken as m"
    )
    return replace(network, images=images, unit="m"), replace(points, coordinates=coordinates)
