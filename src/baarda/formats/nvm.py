"""VisualSFM's N-view match files, ``NVM_V3``: cameras, points and measurements of the first model.

After the line ``NVM_V3`` (with ``FixedK fx cx fy cy r`` where the calibration was given) the number of cameras, then per camera: file, f,
quaternion w x y z, projection centre, r, 0; the number of points, then per point: X Y Z, colour, number of measurements, and image,
feature, x, y of each. VisualSFM's camera looks along +z with y down: M = diag(1, -1, -1) R. Measurements count pixels from the principal
point, y down; r corrects them: (1 + r |m|^2 / f^2) m = f X / Z, so K1 = r / f^2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, Line, split_lines
from baarda.network import Images, Network, Points
from baarda.observations import ImagePoints

_AXES = np.diag([1.0, -1.0, -1.0])  # VisualSFM's camera axes in ours
_CAMERA = re.compile(r'\s*(?:"(?P<quoted>[^"]*)"|(?P<plain>\S+))\s+(?P<rest>.*)')
_LARGEST = 1e9  # of f and r
_SMALLEST = 1e-6  # of a principal distance in pixels: its square must not vanish


def recognises(path: Path) -> bool:
    """Tell an NVM file by its first word."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        return re.match(rb"NVM_V3(\s|$)", f.read(16)) is not None


def read(path: Path) -> Network:
    """Read the first model of an NVM file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Network
        Images by their file names, points by their numbers from 0; a free network in model units.

    Raises
    ------
    InputError
        With file and line if it cannot be used.
    """
    texts = split_lines(path)
    lines = [Line(path, i, tuple(t.split())) for i, t in enumerate(texts, start=1)]
    head = lines[0].fields
    if head[:1] != ("NVM_V3",):
        raise InputError("the first word must be NVM_V3", path, 1)
    if len(head) > 1 and (head[1] != "FixedK" or len(head) != 7):
        raise lines[0].error("after NVM_V3 there may only be: FixedK fx cx fy cy r")
    fixed = None
    if len(head) == 7:
        fixed = [lines[0].number_at(i, "FixedK") for i in range(2, 7)]
        if fixed[0] != fixed[2]:
            raise lines[0].error("FixedK with fx and fy that differ is not supported")
    filled = iter(line for line in lines[1:] if line.fields)
    count = _count(filled, path, "cameras", len(lines))
    labels: dict[str, Line] = {}
    table = []
    for i in range(count):
        line = _next(filled, path, f"camera {i}")
        found = _CAMERA.fullmatch(texts[line.number - 1])
        if found is None:
            raise line.error("a camera needs a file name and ten numbers")
        name = found["quoted"] or found["plain"] or ""
        rest = Line(path, line.number, (name, *found["rest"].split()))
        if rest.text_at(0, "file name") in labels:
            raise line.error(f"image {name!r} appears twice (first in line {labels[name].number})")
        values = [rest.number_at(k, "a number of the camera") for k in range(1, 10)]
        if not _SMALLEST < values[0] < _LARGEST or not abs(values[8]) < _LARGEST or max(map(abs, values)) > 1e12:
            raise line.error("the principal distance must be positive, and no number beyond all cameras")
        norm = float(np.linalg.norm(values[1:5]))
        if not abs(norm - 1.0) < 1e-3:
            raise line.error(f"the quaternion of image {name!r} has length {norm:.6g}, not 1")
        labels[name] = line
        table.append(values)
    total = _count(filled, path, "points", len(lines))
    xyz, image, point, xy, places = [], [], [], [], []
    for p in range(total):
        line = _next(filled, path, f"point {p}")
        xyz.append([line.number_at(k, "a coordinate") for k in range(3)])
        views = line.integer_at(6, "the number of measurements")
        if views < 0 or len(line.fields) != 7 + 4 * views:
            raise line.error(f"{views} measurements are announced, the line has {len(line.fields)} fields: truncated?")
        for k in range(7, 7 + 4 * views, 4):
            i = line.integer_at(k, "image")
            if not 0 <= i < count:
                raise line.error(f"image {i} is not among the {count} cameras")
            image.append(i)
            point.append(p)
            xy.append((line.number_at(k + 2, "x"), line.number_at(k + 3, "y")))
            places.append(line)
    if not image:
        raise InputError("no point has measurements", path)
    if np.abs(np.array(xyz)).max() > 1e12 or np.abs(np.array(xy)).max() > 1e9:
        raise InputError("a coordinate is beyond 1e12 (points) or 1e9 (measurements)", path)
    names = list(labels)
    images = np.array(image)
    checks.images_with_points(images, names, np.ones(count, dtype=bool), lambda i, m: labels[names[i]].error(m))
    values_ = np.array(table)
    notes = ["image sigma 1 px, because an NVM file has none"]
    another = next(filled, None)
    if another is not None and another.fields != ("0",):
        notes.append("further models of the file are not read")
    repeated = len(image) - len({*zip(image, point, strict=True)})
    if repeated:
        notes.append(f"{repeated} image point(s) measure a point that their image measures already; all are kept")
    notes.append(
        "the calibration was fixed in VisualSFM, so it is here"
        if fixed
        else "principal distance and K1 of every image are free, as VisualSFM estimates them; K1 = r / f^2"
    )
    model = camera_models.model("dbat1")
    rotation = _rotations(values_[:, 1:5])
    return Network(
        tuple(
            camera_models.create(
                name,
                model,
                {"principal_distance": f, "K1": r / f**2},
                free=() if fixed else ("principal_distance", "K1"),
            )
            for name, f, r in zip(names, values_[:, 0].tolist(), values_[:, 8].tolist(), strict=True)
        ),
        Images.make(names, np.arange(count), values_[:, 5:8], _AXES @ rotation),
        Points.make([str(i) for i in range(total)], np.array(xyz)),
        (ImagePoints.make(images, np.array(point), np.array(xy)),),
        unit=checks.MODEL_UNITS,
        assumptions=tuple(notes),
    )


def _rotations(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R of quaternions w x y z (Diebel 2006, eq. 125)."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def _next(lines: Iterator[Line], path: Path, what: str) -> Line:
    line = next(lines, None)
    if line is None:
        raise InputError(f"the file ends before {what}: truncated?", path, len(split_lines(path)))
    return line


def _count(lines: Iterator[Line], path: Path, what: str, most: int) -> int:
    line = _next(lines, path, f"the number of {what}")
    count = line.integer_at(0, f"the number of {what}")
    if len(line.fields) != 1 or not 0 < count <= most:
        raise line.error(f"the number of {what} must stand alone, be positive, and not exceed the lines of the file")
    return count


nvm = Format("nvm", "VisualSFM N-view match file, NVM_V3", recognises, read)
