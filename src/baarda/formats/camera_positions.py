"""A table of measured camera positions for a network of any source."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FREE
from baarda.errors import InputError, UsageError
from baarda.formats import checks
from baarda.formats.base import MeasuredPositions, number
from baarda.formats.control import MOVED
from baarda.formats.coordinate_system import FRAME, SYSTEM, CoordinateSystem, checked, system_of
from baarda.formats.csv_table import CsvTable, read_csv
from baarda.formats.gcp_marks import some
from baarda.formats.project_writer import CORRELATIONS
from baarda.geometry.similarity import similarity
from baarda.geometry.tangent_frame import TangentFrame
from baarda.network import AXES, CONTROL, Network
from baarda.observations.camera_positions import CameraPositions, lever_arms, strips

Floats = NDArray[np.float64]

MODELS = ("none", "shift", "drift")
SOURCE = "source"  # in place of a table


def with_camera_positions(
    network: Network, path: str | Path, lever_arm: str = "0,0,0", model: str = "none", system: CoordinateSystem | None = None
) -> Network:
    """Return the network with observed camera positions.

    Parameters
    ----------
    network : Network
    path : str or Path
        A CSV table with the columns image, X, Y, Z, sigma_X, sigma_Y, sigma_Z and, optional, correlation_XY, correlation_XZ,
        correlation_YZ, strip, time (seconds): the position of the antenna in the system of the network's control; or ``source``: the
        positions that the network's own source holds (OpenSfM, Metashape, OPF).
    lever_arm : str
        From the projection centre to the antenna in camera axes (x right, y up, z backwards): ``x,y,z`` known; ``free``, or
        ``free:x,y,z`` with a start value, estimated, one for each camera.
    model : {"none", "shift", "drift"}
        Whether a shift, or a shift and a drift, is estimated for each strip.
    system : CoordinateSystem, optional
        That of the table; the positions are led to the frame of the control points, of the network's source, or in their own middle.

    Returns
    -------
    Network
        Without control points its start values are carried over to the positions by a similarity transformation.

    Raises
    ------
    InputError
        With file and line, if the table cannot be used or no image of it is in the network.
    UsageError
        If an option makes no sense.
    """
    free, arm = _arm(lever_arm)
    if model not in MODELS:
        raise UsageError(f"the model of camera positions is one of {', '.join(MODELS)}, not {model!r}")
    if any(isinstance(g, CameraPositions) for g in network.observations):
        raise UsageError("the network has camera positions already")
    found = _of_source(network) if str(path) == SOURCE else _of_table(Path(path))
    if system is not None and str(path) != SOURCE:
        network, found = _led(network, found, system)
    index = {label: i for i, label in enumerate(network.images.labels)}
    rows = np.array([i for i, label in enumerate(found.images) if label in index], dtype=np.intp)
    notes: list[str] = list(found.notes)
    if not len(rows):
        raise found.complain(0, f"no image of the table is in the network, whose images are called {some(list(network.images.labels))}")
    if len(rows) < len(found.images):
        absent = [label for label in found.images if label not in index]
        notes.append(f"{len(absent)} camera position(s) of {found.file.name} belong to no image and are left out: {some(absent)}")
    if model == "drift" and found.times is None:
        raise InputError("a drift needs the column time", found.file, 1)
    images = np.array([index[found.images[i]] for i in rows], dtype=np.intp)
    strip_names = list(dict.fromkeys(found.strips[i] for i in rows))
    line = np.array([strip_names.index(found.strips[i]) for i in rows], dtype=np.intp)
    times = np.zeros(len(rows)) if found.times is None else found.times[rows]
    middle = np.bincount(line, times) / np.bincount(line)
    times = times - middle[line]
    if model == "drift":
        still = np.flatnonzero(np.bincount(line, np.abs(times)) == 0.0)
        if len(still):
            first = int(rows[np.flatnonzero(line == still[0])[0]])
            raise found.complain(first, f"strip {strip_names[still[0]]!r} has no two times: no drift")
    group = CameraPositions(
        images, network.images.cameras[images], line, times, found.xyz[rows], found.covariances[rows], unit=network.unit
    )
    cameras = [c.label for c in network.cameras]
    known = (network.points.roles == CONTROL).any() or (network.images.states != FREE).any()
    if not known:
        network = _carried_over(network, group, found.file, notes)
    elif network.unit == checks.MODEL_UNITS:
        raise InputError("positions cannot be joined with known values that are in model units", found.file)
    unit = network.unit
    group = replace(group, unit=unit)
    declared = (
        lever_arms(cameras, np.tile(arm, (len(cameras), 1)), free, unit),
        strips(strip_names, model != "none", model == "drift", unit),
    )
    what = {"none": "no shift", "shift": "a shift", "drift": "a shift and a drift"}[model]
    notes.append(
        f"camera positions: {what} per strip ({len(strip_names)}), lever arm "
        + ("estimated" if free else f"known: {', '.join(f'{v:g}' for v in arm)}")
    )
    return replace(
        network,
        observations=(*network.observations, group),
        declared=(*network.declared, *declared),
        assumptions=(*network.assumptions, *notes),
    )


def _led(network: Network, found: MeasuredPositions, system: CoordinateSystem) -> tuple[Network, MeasuredPositions]:
    """Return the positions in a local frame with their covariances, and the network with that frame among its settings."""
    mine = system_of(network.settings)
    if mine is not None and mine[0].name == system.name:
        system = mine[0]  # with the geoid heights that came with the control points
    lla = system.geographic(found.xyz)
    checked(lla, found.xyz, system, found.complain)
    known = network.settings.get(FRAME)
    if known is not None and network.unit != checks.MODEL_UNITS:
        frame = TangentFrame(*(float(v) for v in known)) if mine is None else mine[1]
        if abs(frame.a - system.ellipsoid[0]) > 0.01:
            raise UsageError(f"the network stands on another ellipsoid than {system.name:.60}: give both in systems of one datum")
    else:
        frame = system.frame(found.xyz)
    local = frame.local(lla)
    j = system.partials(local, frame)
    turned = replace(found, xyz=local, covariances=j @ found.covariances @ j.transpose(0, 2, 1), notes=(*found.notes, system.text()))
    settings = network.settings if SYSTEM in network.settings else {**network.settings, **system.settings(frame)}
    return replace(network, settings=settings), turned


def _of_source(network: Network) -> MeasuredPositions:
    """Return the measured positions that the source of a network holds."""
    from baarda.formats import formats

    if network.settings.get(MOVED):
        raise UsageError("the block was carried over to its control points, and the positions of its source were not: give them as a table")
    known = formats()
    if network.format not in known or not network.path:
        raise UsageError("the network was not read from a file: give its measured camera positions as a table")
    positions = known[network.format].positions
    if positions is None:
        able = ", ".join(f.name for f in known.values() if f.positions is not None)
        raise UsageError(
            f"a source of format {network.format} holds no measured camera positions that are read; those of {able} are: give a table"
        )
    return positions(Path(network.path))


def _of_table(path: Path) -> MeasuredPositions:
    """Return the positions of a CSV table."""
    table = read_csv(path, ("image", *AXES, *(f"sigma_{a}" for a in AXES)), (*CORRELATIONS, "strip", "time"))
    labels = table.labels("image", "image")
    xyz = np.stack([table.numbers(a, None) for a in AXES], axis=1)
    times = table.numbers("time", 0.0) if "time" in table.columns else None
    return MeasuredPositions(path, tuple(labels), xyz, _covariances(table), tuple(table.texts("strip", "all")), times, table.error)


def _arm(text: str) -> tuple[bool, Floats]:
    head, _, rest = text.partition(":")
    free = head.strip() == "free"
    values = rest if free else text
    if free and not rest.strip():
        return True, np.zeros(3)
    try:
        out = np.array([number(v.strip()) for v in values.split(",")])
    except ValueError:
        out = np.zeros(0)
    if out.shape != (3,) or not (np.abs(out) < 1e6).all():
        raise UsageError(f"the lever arm is x,y,z in camera axes, free, or free:x,y,z, not {text!r}")
    return free, out


def _covariances(table: CsvTable) -> Floats:
    s = np.stack([table.sigmas(f"sigma_{a}", None) for a in AXES], axis=1)
    bad = np.flatnonzero((s <= 0.0).any(axis=1))
    if len(bad):
        raise table.error(int(bad[0]), "the sigmas of a camera position must be positive")
    checks.sigma_range(s, "the sigma of a camera position", table.error)
    r = np.stack([table.numbers(n, 0.0) for n in CORRELATIONS], axis=1)
    checks.correlations(r, table.error)
    c = np.broadcast_to(np.eye(3), (len(s), 3, 3)).copy()
    for j, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        c[:, a, b] = c[:, b, a] = r[:, j]
    return np.asarray(c * s[:, :, None] * s[:, None, :])


def _carried_over(network: Network, group: CameraPositions, path: Path, notes: list[str]) -> Network:
    """Carry start values over to the system of the positions, the lever arms left aside."""
    position = network.images.position[group.images]
    target = group.values + network.offset
    use = np.flatnonzero(np.isfinite(position).all(axis=1))
    try:
        to = similarity(position[use], target[use])
    except UsageError as error:
        raise InputError(f"the start values cannot be carried over to the camera positions: {error}", path) from None
    misfit = float(np.sqrt(np.mean(np.sum((to.apply(position[use]) - target[use]) ** 2, axis=1))))
    notes.append(f"start values were carried over to {len(use)} camera positions (scale {to.scale:.6g}, rms distance {misfit:.3g})")
    images = network.images
    images = replace(images, position=to.apply(images.position), rotation=images.rotation @ to.rotation.T)
    points = replace(network.points, coordinates=to.apply(network.points.coordinates))
    return replace(network, images=images, points=points, unit="m" if network.unit == checks.MODEL_UNITS else network.unit)
