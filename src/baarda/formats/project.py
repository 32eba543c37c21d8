"""Our own project format: a folder with `project.toml` and plain CSV tables, described in docs/project-format.md.

Whatever a network holds is written so that it reads back exactly; whatever a table leaves out takes a default or follows from the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import FIXED, FREE, OBSERVED, STATES, Camera, CameraModel
from baarda.errors import InputError, UsageError
from baarda.formats import checks
from baarda.formats.base import Format
from baarda.formats.csv_table import CsvTable, read_csv
from baarda.formats.known_values import columns_of, known_values, with_unknowns
from baarda.formats.project_file import DEFAULT_NAMES, FILE, KINDS, TABLES, GroupTable, Header, read_header, settings_of
from baarda.formats.project_kinds import DECLARED_COLUMNS, KIND_TABLES, read_declared
from baarda.formats.project_writer import CORRELATIONS, MATRIX, write
from baarda.geometry import rotation as rot
from baarda.network import AXES, CHECK, CONTROL, EXTERIOR, ROLES, TIE, Declared, Images, Network, Points
from baarda.observations import Distances, ImageCoordinates, ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

__all__ = ["points_of", "project", "read", "recognises", "write"]

_CAMERA = ("unit", "pixel_size_x", "pixel_size_y", "origin_x", "origin_y", "y_down", "width", "height", "grid_half_width")


def recognises(path: Path) -> bool:
    """Tell a project by the schema named in its header; the path is the folder or the header itself."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file() or (path.is_file() and path.suffix != ".toml"):
        return False
    with file.open("rb") as f:
        return path.is_dir() or b"baarda.project/" in f.read(65536)


def read(path: Path) -> Network:
    """Read a project.

    Parameters
    ----------
    path : Path
        The folder, or `project.toml` in it.

    Returns
    -------
    Network

    Raises
    ------
    InputError
        With file and line, if a table cannot be used.
    """
    file = path / FILE if path.is_dir() else path
    header = read_header(file)
    folder = file.parent
    if header.tables is None:
        tables = {kind: folder / f"{kind}.csv" for kind in TABLES if (folder / f"{kind}.csv").exists()}
    else:
        tables = {kind: folder / name for kind, name in header.tables.items()}
    for kind in ("points", "cameras", "images") if "image_points" in tables or "images" in tables else ("points",):
        if kind not in tables:
            raise InputError(f"table {kind!r} is missing", file)
    if not any(kind in tables for kind in KINDS):
        raise InputError(f"no table of observations; known are {', '.join(KINDS)}", file)
    notes: list[str] = []
    cameras = _read_cameras(tables, header, notes) if "cameras" in tables else ()
    images, image_lines = _read_images(tables["images"], cameras) if "images" in tables else (Images.make(()), None)
    points, point_lines = _read_points(tables["points"], notes)
    checks.control_unit(points, header.unit, point_lines.error, images.position)
    declared = read_declared(read_csv(tables["declared"], *DECLARED_COLUMNS)) if "declared" in tables else ()
    observations = _read_observations(tables, header, images, points, notes, declared)
    network = Network(
        cameras,
        images,
        points,
        observations,
        unit=header.unit,
        name=header.name,
        offset=np.array(header.offset, dtype=float),
        settings=settings_of(header),
        assumptions=(*header.assumptions, *notes),
        declared=declared,
    )
    if "unknowns" in tables:
        network = with_unknowns(network, read_csv(tables["unknowns"], ("name", "sigma"), ("value",)))
    if image_lines is not None:
        seen = [g.images for g in observations if isinstance(g, (ImageCoordinates, ImagePoints))]
        needed = (network.images.states == FREE).any(axis=1)
        checks.images_with_points(np.concatenate([np.zeros(0, dtype=np.intp), *seen]), images.labels, needed, image_lines.error)
    return network


def _read_cameras(tables: Mapping[str, Path], header: Header, notes: list[str]) -> tuple[Camera, ...]:
    table = read_csv(tables["cameras"], ("camera", "model"), _CAMERA)
    index = table.labels("camera", "camera")
    size = np.stack([table.numbers(f"pixel_size_{a}", 1.0) for a in "xy"], axis=1)
    origin = np.stack([table.numbers(f"origin_{a}", 0.0) for a in "xy"], axis=1)
    image = np.stack([table.numbers("width"), table.numbers("height")], axis=1)
    y_down = table.choices("y_down", ("false", "true"))
    units = table.choices("unit", ("px", "mm"))
    own = [t.model() for t in header.camera_sets]
    known: dict[str, CameraModel] = {}
    grid = table.numbers("grid_half_width")
    for values, what in ((size, "the pixel size"), (origin, "the origin"), (image, "width or height"), (grid, "grid_half_width")):
        checks.camera_range(values, what, table.error)
    out = []
    for i, (label, model) in enumerate(zip(index, table.texts("model"), strict=True)):
        if model not in known:
            try:
                known[model] = camera_models.model(model, own)
            except UsageError as error:
                raise table.error(i, str(error)) from None
        if not (size[i] > 0.0).all():
            raise table.error(i, "the pixel size must be positive")
        if np.isnan(image[i]).sum() == 1 or (image[i] <= 0.0).any():
            raise table.error(i, "width and height must both be there and positive, or both be left out")
        if grid[i] <= 0.0:
            raise table.error(i, "grid_half_width must be positive")
        if known[model].on_grid and np.isnan(image[i, 0]) and np.isnan(grid[i]):
            raise table.error(i, f"camera model {model} needs width and height, or grid_half_width")
        out.append(
            camera_models.create(
                label,
                known[model],
                {},
                unit=("px", "mm")[max(units[i], 0)],
                pixel_size=size[i],
                origin=origin[i],
                y_down=bool(y_down[i]),  # -1 = nothing said = true
                image_size=None if np.isnan(image[i, 0]) else (float(image[i, 0]), float(image[i, 1])),
                grid=None if np.isnan(grid[i]) else float(grid[i]),
            )
        )
    if "camera_parameters" not in tables:
        raise table.error(0, f"camera {out[0].label!r} has no parameters: table 'camera_parameters' is missing")
    return _read_parameters(tables["camera_parameters"], table, index, out, notes)


def _read_parameters(file: Path, cameras: CsvTable, index: Mapping[str, int], out: list[Camera], notes: list[str]) -> tuple[Camera, ...]:
    table = read_csv(file, ("camera", "parameter", "value"), ("state", "given", "sigma"))
    owner = table.codes("camera", index, "camera")
    value, given = table.numbers("value", None), table.numbers("given")
    sigma, said = table.sigmas("sigma"), table.choices("state", STATES)
    checks.sigma_range(sigma, "sigma", table.error, smallest=1e-60)
    checks.camera_range(value, "value", table.error)
    checks.camera_range(given, "given", table.error)
    # the same rules as for all unknowns, except that a parameter of which nothing is said is fixed
    state = np.where(said >= 0, said, np.where(sigma > 0.0, OBSERVED, FIXED))
    state = np.where((state == OBSERVED) & (sigma == 0.0), FIXED, state)
    sigma = np.where((state == FIXED) & (sigma == 0.0), np.nan, sigma)
    first: dict[tuple[int, int], int] = {}
    for row, (camera, name) in enumerate(zip(owner.tolist(), table.texts("parameter"), strict=True)):
        order = out[camera].model.order
        if name not in order:
            raise table.error(row, f"camera model {out[camera].model.name} has no parameter {name!r}; it has {', '.join(order)}")
        key = camera, order.index(name)
        if key in first:
            raise table.error(row, f"{name} of this camera appears twice (first in line {table.line(first[key])})")
        if state[row] == OBSERVED and np.isnan(sigma[row]):
            raise table.error(row, f"{name} is observed, but its sigma is missing")
        if name.startswith("principal_distance") and not value[row] > 0.0:
            raise table.error(row, f"{name} must be positive")
        first[key] = row
    done = []
    for i, camera in enumerate(out):
        values, states, sigmas = np.array(camera.values), np.array(camera.states), np.array(camera.sigmas)
        prior = np.full(len(values), np.nan)
        for k, name in enumerate(camera.model.order):
            row = first.get((i, k), -1)
            if row >= 0:
                values[k], prior[k], sigmas[k], states[k] = value[row], given[row], sigma[row], state[row]
            elif name.startswith("principal_distance"):
                raise cameras.error(i, f"camera {camera.label!r} has no {name} in {file.name}")
            elif name.startswith("principal_point"):
                notes.append(f"camera {camera.label}: {name} is not given and taken as {values[k]:g}")
        priors = None if np.isnan(prior).all() else np.where(np.isnan(prior), values, prior)
        done.append(replace(camera, values=values, states=states, sigmas=sigmas, given=priors))
    return tuple(done)


def _read_images(file: Path, cameras: tuple[Camera, ...]) -> tuple[Images, CsvTable]:
    table = read_csv(file, ("image",), ("camera", *EXTERIOR, *MATRIX, *columns_of(EXTERIOR)))
    labels = table.labels("image", "image")
    if "camera" not in table.columns and len(cameras) > 1:
        raise InputError("column 'camera' is missing, and there are several cameras", file, 1)
    index = {c.label: i for i, c in enumerate(cameras)}
    camera = table.codes("camera", index, "camera") if "camera" in table.columns else np.zeros(len(table), dtype=np.intp)
    position = np.stack([table.numbers(name) for name in EXTERIOR[:3]], axis=1)
    angles = np.stack([table.numbers(name) for name in EXTERIOR[3:]], axis=1)
    matrix = np.stack([table.numbers(name) for name in MATRIX], axis=1).reshape(-1, 3, 3)
    for values, what in ((angles, "three angles"), (matrix.reshape(-1, 9), "nine matrix elements")):
        some = np.isfinite(values)
        partly = np.flatnonzero(some.any(axis=1) & ~some.all(axis=1))
        if len(partly):
            raise table.error(int(partly[0]), f"the {what} must be given together")
    checks.rotation_matrices(matrix, table.error)
    from_angles = rot.from_angles(*angles.T)
    apart = np.flatnonzero(np.abs(from_angles - matrix).max(axis=(1, 2)) > 1e-6)
    if len(apart):
        raise table.error(int(apart[0]), "omega, phi, kappa and the matrix r11 to r33 contradict each other (leave one of them out)")
    rotation = np.where(np.isnan(matrix), from_angles, matrix)
    start = np.concatenate([position, np.where(np.isnan(angles), rot.to_angles(rotation), angles)], axis=1)
    known = known_values(table, EXTERIOR, start)
    checks.sigma_range(known.sigmas, "the sigma of an orientation", table.error)
    fixed = known.states[:, 3:] == FIXED
    partly = np.flatnonzero(fixed.any(axis=1) & ~fixed.all(axis=1))
    if len(partly):
        raise table.error(int(partly[0]), "omega, phi and kappa must be fixed together (a single angle can be observed)")
    from_given = fixed.all(axis=1) & np.isnan(rotation).any(axis=(1, 2))
    rotation = np.where(from_given[:, None, None], rot.from_angles(*known.values[:, 3:].T), rotation)
    return Images(tuple(labels), camera, known.values[:, :3], rotation, known.states, known.given, known.sigmas), table


def _read_points(file: Path, notes: list[str]) -> tuple[Points, CsvTable]:
    table = read_csv(file, ("point",), ("role", *AXES, *columns_of(AXES), *CORRELATIONS))
    points = points_of(table, notes)
    return points, table


def points_of(table: CsvTable, notes: list[str], default_role: int = TIE) -> Points:
    """Return the points of a table with the columns point, role, X, Y, Z, state_*, given_*, sigma_* and correlation_*.

    Parameters
    ----------
    table : CsvTable
    notes : list of str
        Takes what was assumed.
    default_role : int
        Role of points of which none is said.

    Raises
    ------
    InputError
        With file and line.
    """
    labels = tuple(table.labels("point", "point"))
    said = table.choices("role", ROLES)
    roles = np.where(said >= 0, said, default_role).astype(np.int8)
    tie, check = roles == TIE, roles == CHECK
    start = np.stack([table.numbers(name) for name in AXES], axis=1)
    for name in AXES:
        state = table.choices(f"state_{name}", STATES)
        loose = tie & ((state == OBSERVED) | (state == -1) & np.isfinite(table.sigmas(f"sigma_{name}")))
        _refuse(table, loose, f"{name} has a sigma, but the role of the point is not control")
    known = known_values(table, AXES, start, known=~tie, judging=check)
    for j, name in enumerate(AXES):
        _refuse(table, check & (known.states[:, j] != FREE), f"{name} of a check point cannot be fixed or observed")
    _refuse(table, ~tie & np.isnan(known.given).all(axis=1), "a control or check point without given coordinates")
    nothing = (roles == CONTROL) & (known.states == FREE).all(axis=1)
    _refuse(table, nothing, "a control point of which no coordinate is fixed or observed")
    correlations = np.stack([table.numbers(name, 0.0) for name in CORRELATIONS], axis=1)
    checks.correlations(correlations, table.error)
    for role in (CONTROL, CHECK):
        count = int((known.without_sigma.any(axis=1) & (roles == role)).sum())
        if count:
            notes.append(f"{count} {ROLES[role]} point(s) without sigma: {'held fixed' if role == CONTROL else 'taken as exact'}")
    checks.sigma_range(known.sigmas, "the sigma of a coordinate", table.error)
    # control starts where it was surveyed unless a start value says otherwise: start values of the rest are found from it
    start = np.where((roles == CONTROL)[:, None] & np.isnan(known.values), known.given, known.values)
    return Points(labels, start, roles, known.states, known.given, known.sigmas, correlations)


def _refuse(table: CsvTable, bad: NDArray[np.bool_], message: str) -> None:
    rows = np.flatnonzero(bad)
    if len(rows):
        raise table.error(int(rows[0]), message)


def _read_observations(
    tables: Mapping[str, Path], header: Header, images: Images, points: Points, notes: list[str], declared: tuple[Declared, ...]
) -> tuple[Any, ...]:
    found: dict[str, Any] = {}
    singles: dict[str, ImageCoordinates] = {}
    for kind, columns in {**_OBSERVATIONS, **{t.kind: t.columns for t in KIND_TABLES.values()}}.items():
        groups = {g.name: g for g in header.groups if g.kind == kind}
        table = read_csv(tables[kind], *columns) if kind in tables else None
        names = [] if table is None else table.texts("group", DEFAULT_NAMES[kind])
        groups = groups or {name: GroupTable(name=name, kind=kind) for name in dict.fromkeys(names)}  # type: ignore[arg-type]
        index = {name: i for i, name in enumerate(groups)}
        wrong = next((row for row, name in enumerate(names) if name not in index), None)
        if table is not None and wrong is not None:
            raise table.error(wrong, f"group {names[wrong]!r} of {kind} is not declared in {FILE}")
        code = np.array([index[name] for name in names], dtype=np.intp)
        usual = np.array([np.nan if g.sigma is None else g.sigma for g in groups.values()])[code]
        if kind in KIND_TABLES:
            everything = KIND_TABLES[kind].read(table, usual, images, points, header.unit, declared)
        else:
            everything = _READERS[kind](table, usual, images, points, header.unit, notes)
        for i, group in enumerate(groups.values()):
            if group.name in found:
                raise InputError(f"two groups of observations are called {group.name!r}", tables[kind])
            rows = np.flatnonzero(code == i)
            found[group.name] = _group(everything.selected(rows), group, table, rows, points, header.unit)
            if table is not None and kind == "image_points":
                singles.update(_single(found, group.name, table.choices("used", ("xy", "x", "y"))[rows]))
    order = dict.fromkeys([*(g.name for g in header.groups), *found])
    return tuple(g for name in order for g in (found[name], singles.get(name)) if g is not None)


def _single(found: dict[str, Any], name: str, used: Ints) -> dict[str, ImageCoordinates]:
    """Take the image points out of a group of which one coordinate was rejected; return the other coordinates."""
    group, one = found[name], used > 0
    if not one.any() or not isinstance(group, ImagePoints):
        return {}
    found[name] = group.selected(~one)
    return {name: ImageCoordinates(group.selected(one), used[one] - 1)}


_OBSERVATIONS = {
    "image_points": (("image", "point", "x", "y"), ("group", "sigma_x", "sigma_y", "correlation", "used")),
    "distances": (("from", "to", "value"), ("group", "sigma")),
}


def _group(found: Any, group: GroupTable, table: CsvTable | None, rows: Ints, points: Points, unit: str) -> Any:
    """Return the rows of one group with what the header says of it, checked."""

    def error(row: int, message: str) -> InputError:
        return InputError(message) if table is None else table.error(int(rows[row]), message)

    if isinstance(found, Distances):
        checks.distance_unit(found, points, unit, error)
        return replace(found, name=group.name)
    if not isinstance(found, ImagePoints):
        return replace(found, name=group.name)
    if not group.repeated:
        checks.measured_once(found.images, found.points, points.labels, error, lambda row: table.line(int(rows[row])) if table else 0)
    return replace(found, name=group.name, residual_plane=group.residual_plane or "image")


def _image_points(table: CsvTable | None, usual: Floats, images: Images, points: Points, unit: str, notes: list[str]) -> ImagePoints:
    if table is None:
        return ImagePoints.make((), (), np.zeros((0, 2)))
    image = table.codes("image", {t: i for i, t in enumerate(images.labels)}, "image")
    point = table.codes("point", {t: i for i, t in enumerate(points.labels)}, "point")
    xy = np.stack([table.numbers("x", None), table.numbers("y", None)], axis=1)
    sigmas = np.stack([table.sigmas("sigma_x"), table.sigmas("sigma_y")], axis=1)
    sigmas = np.where(np.isnan(sigmas), usual[:, None], sigmas)
    assumed = int(np.isnan(sigmas).any(axis=1).sum())
    if assumed:
        notes.append(f"{assumed} image point(s) without sigma: 1 px assumed")
    sigmas = np.where(np.isnan(sigmas), 1.0, sigmas)
    _refuse(table, (sigmas == 0.0).any(axis=1), "the sigma of an image point must be positive")
    checks.sigma_range(sigmas, "the sigma of an image point", table.error)
    correlation = table.numbers("correlation", 0.0)
    _refuse(table, np.abs(correlation) >= 1.0, "the correlation must lie between -1 and 1")
    return ImagePoints.make(image, point, xy, sigmas, correlation)


def _distances(table: CsvTable | None, usual: Floats, images: Images, points: Points, unit: str, notes: list[str]) -> Distances:
    if table is None:
        nothing = np.zeros(0, dtype=np.intp)
        return Distances(nothing, nothing, np.zeros(0), np.zeros(0), unit=unit)
    index = {t: i for i, t in enumerate(points.labels)}
    starts, ends = table.codes("from", index, "point"), table.codes("to", index, "point")
    _refuse(table, starts == ends, "a distance needs two different points")
    values, sigma = table.numbers("value", None), table.sigmas("sigma")
    sigma = np.where(np.isnan(sigma), usual, sigma)
    _refuse(table, ~(values > 0.0), "the distance must be positive")
    _refuse(table, ~(sigma > 0.0), "the sigma of the distance must be there and positive")
    checks.sigma_range(sigma, "the sigma of the distance", table.error)
    return Distances(starts, ends, values, sigma, unit=unit)


_READERS: Mapping[str, Callable[..., ImagePoints | Distances]] = {"image_points": _image_points, "distances": _distances}


project = Format("project", "our own: project.toml and CSV tables in a folder", recognises, read, write)
