"""Writing our own project format: the whole folder or nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FREE, STATES, Camera, CameraModel
from baarda.cameras.own_sets import own_set, terms_of
from baarda.errors import UsageError
from baarda.formats.base import label_problem
from baarda.formats.csv_table import csv_text, numbers_text, quoted
from baarda.formats.folder import write_folder
from baarda.formats.project_file import DEFAULT_NAMES, FILE, SETS, header_text
from baarda.formats.project_kinds import declared_columns, kind_table_of
from baarda.geometry import rotation as rot
from baarda.network import AXES, EXTERIOR, ROLES, TIE, Images, Network, Points
from baarda.observations import Distances, ImageCoordinates, ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Columns = dict[str, list[str]]

MATRIX = tuple(f"r{i}{j}" for i in "123" for j in "123")
CORRELATIONS = ("correlation_XY", "correlation_XZ", "correlation_YZ")


def write(network: Network, path: Path) -> None:
    """Write a network as a project folder that reads back exactly.

    Parameters
    ----------
    network : Network
    path : Path
        The folder; it must not exist yet, or be empty.

    Raises
    ------
    UsageError
        If the network holds what the format cannot express.
    OutputError
        If the folder cannot be written; nothing is left behind.
    """
    write_folder(path, project_files(network))


def project_files(network: Network) -> dict[str, str]:
    """Return the files of a project by name.

    Raises
    ------
    UsageError
        See `write`.
    """
    tables: dict[str, Columns] = {}
    if network.cameras:
        tables["cameras"] = _cameras(network.cameras)
        tables["camera_parameters"] = _parameters(network.cameras)
    if network.images.labels:
        tables["images"] = _images(network)
    tables["points"] = _points(network.points)
    if network.declared:
        tables["declared"] = declared_columns(network.declared)
    groups = []
    parts: dict[str, list[Columns]] = {}
    names = [g.name for g in network.observations]
    for group in network.observations:
        if names.count(group.name) > 1:
            raise UsageError(f"two groups of observations are called {group.name!r}")
        if isinstance(group, ImagePoints):
            singles = [g.whole for g in network.observations if isinstance(g, ImageCoordinates) and g.whole.name == group.name]
            keys = np.concatenate([g.images * len(network.points.labels) + g.points for g in (group, *singles)])
            entry: dict[str, Any] = {"name": group.name, "kind": "image_points", "residual_plane": group.residual_plane}
            if len(np.unique(keys)) < len(keys):
                entry["repeated"] = True
            columns = _image_points(group, network)
        elif isinstance(group, ImageCoordinates):
            if group.whole.name in names:  # rows of their group of image points
                parts.setdefault("image_points", []).append(_image_points(group.whole, network, group.axes))
                continue
            entry = {"name": group.whole.name, "kind": "image_points", "residual_plane": group.whole.residual_plane}
            columns = _image_points(group.whole, network, group.axes)
        elif isinstance(group, Distances):
            entry, columns = {"name": group.name, "kind": "distances"}, _distances(group, network)
        else:
            kind_table = kind_table_of(group)
            entry, columns = {"name": group.name, "kind": kind_table.kind}, kind_table.write(group, network)
        groups.append(entry)
        if len(group):
            parts.setdefault(entry["kind"], []).append(columns)
    for kind, several in parts.items():
        joined = {name: [t for part in several for t in part[name]] for name in several[0]}
        # what is the same as the default throughout is left out
        if set(joined["group"]) == {quoted(DEFAULT_NAMES[kind])}:
            del joined["group"]
        if set(joined.get("correlation", ())) == {"0.0"}:
            del joined["correlation"]
        if set(joined.get("used", ())) == {"xy"}:
            del joined["used"]
        tables[kind] = joined
    header = header_text(
        network.name,
        network.unit,
        tuple(np.asarray(network.offset, dtype=float).tolist()),
        network.assumptions,
        {k: v for k, v in network.settings.items() if k != SETS},
        {kind: f"{kind}.csv" for kind in tables},
        groups,
        _own_sets(network),
    )
    return {FILE: header, **{f"{kind}.csv": csv_text(_filled(columns)) for kind, columns in tables.items()}}


def _own_sets(network: Network) -> list[CameraModel]:
    """Return the sets of one's own that the network keeps or its cameras use, by name."""
    found = {m.name: m for m in network.settings.get(SETS, ())}
    for camera in network.cameras:
        for name, terms in terms_of(camera.model).items():
            known = found.setdefault(name, own_set(name, terms))
            if terms_of(known)[name] != terms:
                raise UsageError(f"two different sets of camera parameters are called {name!r}")
    return list(found.values())


def _filled(columns: Columns) -> Columns:
    """Return the columns that hold something; given values and sigmas go together, because one alone has another meaning."""
    kept = {name for name, column in columns.items() if any(column)}
    kept |= {
        f"{kind}_{name.partition('_')[2]}"
        for name in kept
        if name.startswith(("state_", "given_", "sigma_"))
        for kind in ("given", "sigma")
    }
    return {name: column for name, column in columns.items() if name in kept}


def _labels(labels: Sequence[str], what: str) -> list[str]:
    """Return quoted labels; they must tell the rows apart."""
    if len(set(labels)) < len(labels):
        twice = next(t for t in labels if labels.count(t) > 1)
        raise UsageError(f"{what} {twice!r} appears twice")
    if not all(labels):
        raise UsageError(f"a {what} has an empty label")
    for t in labels:
        problem = label_problem(t, what)
        if problem:
            raise UsageError(f"{problem}: it cannot be written")
    return [quoted(t) for t in labels]


def _cameras(cameras: Sequence[Camera]) -> Columns:
    n = range(len(cameras))
    size = np.array([np.broadcast_to(c.pixel_size, 2) for c in cameras], dtype=float)
    origin = np.array([np.broadcast_to(c.origin, 2) for c in cameras], dtype=float)
    image = np.array([(np.nan, np.nan) if c.image_size is None else c.image_size for c in cameras], dtype=float)
    return {
        "camera": _labels([c.label for c in cameras], "camera"),
        "model": [quoted(c.model.name) for c in cameras],
        "unit": [quoted(c.unit) for c in cameras],
        **{f"pixel_size_{a}": numbers_text(size[:, j]) for j, a in enumerate("xy")},
        **{f"origin_{a}": numbers_text(origin[:, j]) for j, a in enumerate("xy")},
        "y_down": ["true" if cameras[i].y_down else "false" for i in n],
        "width": numbers_text(image[:, 0]),
        "height": numbers_text(image[:, 1]),
        "grid_half_width": numbers_text(np.array([np.nan if c.grid is None else c.grid for c in cameras])),
    }


def _parameters(cameras: Sequence[Camera]) -> Columns:
    given = [np.full(len(c.values), np.nan) if c.given is None else c.given for c in cameras]
    return {
        "camera": [quoted(c.label) for c in cameras for _ in c.values],
        "parameter": [quoted(name) for c in cameras for name in c.model.order],
        "value": numbers_text(np.concatenate([c.values for c in cameras])),
        "state": [STATES[s] for c in cameras for s in c.states],
        "given": numbers_text(np.concatenate(given)),
        "sigma": numbers_text(np.concatenate([c.sigmas for c in cameras])),
    }


def _images(network: Network) -> Columns:
    images: Images = network.images
    some = np.isnan(images.rotation).any(axis=(1, 2))
    if (some & ~np.isnan(images.rotation).all(axis=(1, 2))).any():
        raise UsageError("a rotation matrix is known in part only")
    angles = rot.to_angles(images.rotation)
    camera = [quoted(c.label) for c in network.cameras]
    return {
        "image": _labels(images.labels, "image"),
        "camera": [camera[i] for i in images.cameras],
        **{name: numbers_text(images.position[:, j]) for j, name in enumerate(EXTERIOR[:3])},
        **{name: numbers_text(angles[:, j]) for j, name in enumerate(EXTERIOR[3:])},
        **{name: numbers_text(images.rotation[:, j // 3, j % 3]) for j, name in enumerate(MATRIX)},
        **_known(EXTERIOR, images, everywhere=False),
    }


def _points(points: Points) -> Columns:
    columns = {
        "point": _labels(points.labels, "point"),
        **{name: numbers_text(points.coordinates[:, j]) for j, name in enumerate(AXES)},
        "role": [ROLES[r] for r in points.roles],
        **_known(AXES, points, everywhere=bool((points.roles != TIE).any())),
    }
    if np.any((points.correlations != 0.0) | np.signbit(points.correlations)):
        columns.update({name: numbers_text(points.correlations[:, j]) for j, name in enumerate(CORRELATIONS)})
    return columns


def _known(names: Sequence[str], table: Images | Points, everywhere: bool) -> Columns:
    """Return the columns state, given and sigma of the parameters of which anything is known."""
    out: Columns = {}
    for j, name in enumerate(names):
        given, sigma, states = table.given[:, j], table.sigmas[:, j], table.states[:, j]
        if everywhere or (states != FREE).any() or not (np.isnan(given) & np.isnan(sigma)).all():
            out[f"state_{name}"] = [STATES[s] for s in states]
            out[f"given_{name}"] = numbers_text(given)
            out[f"sigma_{name}"] = numbers_text(sigma)
    return out


def _image_points(group: ImagePoints, network: Network, axes: Ints | None = None) -> Columns:
    images, points = ([quoted(t) for t in table.labels] for table in (network.images, network.points))
    return {
        "group": [quoted(group.name)] * len(group),
        "image": [images[i] for i in group.images.tolist()],
        "point": [points[i] for i in group.points.tolist()],
        "x": numbers_text(group.xy[:, 0]),
        "y": numbers_text(group.xy[:, 1]),
        "sigma_x": numbers_text(group.sigmas[:, 0]),
        "sigma_y": numbers_text(group.sigmas[:, 1]),
        "correlation": numbers_text(group.correlations),
        "used": ["xy"] * len(group) if axes is None else ["xy"[i] for i in axes.tolist()],
    }


def _distances(group: Distances, network: Network) -> Columns:
    points = [quoted(t) for t in network.points.labels]
    return {
        "group": [quoted(group.name)] * len(group),
        "from": [points[i] for i in group.starts.tolist()],
        "to": [points[i] for i in group.ends.tolist()],
        "value": numbers_text(group.values),
        "sigma": numbers_text(group.sigmas),
    }


__all__ = ["CORRELATIONS", "MATRIX", "project_files", "write"]
