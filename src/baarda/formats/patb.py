"""PATB: image coordinates, exterior orientations, and control points where they are there, told apart by content.

Image points: a line with the photo and the principal distance, a line per point (point, x, y), -99. Orientations: three records per photo,
photo and X0, Y0, Z0; five and four elements of the rotation matrix, row by row. Control: point, X, Y up to -99, then point, Z up to -99
(point, X, Y, Z is read as well). Lengths in images are micrometres; a principal distance below 1000 tells millimetres. A matrix may lead
from the photo to the object or back: the image points show which.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, Line
from baarda.formats.photo_blocks import END, LARGEST, PIXEL, Known, Photo, all_numbers, block, head_of, lines_of, photos
from baarda.network import Network

Floats = NDArray[np.float64]

_READINGS = ("the rotation matrices lead from the object to the photo", "the rotation matrices lead from the photo to the object")
_MOST = 64  # files of a folder that are looked at


def _files(path: Path) -> dict[str, Path]:
    """Return image, orientation and control file of a folder (or of the folder of a file), judged by their first lines."""
    folder = path if path.is_dir() else path.parent
    out: dict[str, list[Path]] = {"image": [], "orientation": [], "control": []}
    found = sorted(p for p in folder.iterdir() if p.is_file()) if folder.is_dir() else []
    for p in found if len(found) <= _MOST else ():
        kind = _kind(head_of(p))
        if kind:
            out[kind].append(p)
    return {k: v[0] for k, v in out.items() if len(v) == 1}


def _kind(head: list[list[str]]) -> str:
    if len(head) < 3 or head[0][0].startswith("-"):
        return ""
    first, second, third = head[:3]
    numbers = [(all_numbers(f[1:]) and len(f) > 1) or f[0] == END for f in head[:3]]
    if len(first) in (4, 5) and len(second) == 5 and len(third) == 4 and all_numbers(first[1:]) and all_numbers(second + third):
        return "orientation"
    if not all(numbers):
        return ""
    if len(first) in (2, 3) and len(second) > len(first) and second[0] != END and all_numbers(second[1:3]):
        return "image"
    ends = any(f[0] == END for f in head)
    return "control" if ends and len(first) in (3, 4, 5) and (second[0] == END or len(second) == len(first)) else ""


def recognises(path: Path) -> bool:
    """Tell a block by one file of image points and one of exterior orientations in a folder."""
    if path.is_file() and not _kind(head_of(path)):
        return False
    return {"image", "orientation"} <= set(_files(path))


def read(path: Path) -> Network:
    """Read a PATB block.

    Parameters
    ----------
    path : Path
        The folder, or one of the files.

    Returns
    -------
    Network
        In metres, photos and points by their names, image coordinates in micrometres.

    Raises
    ------
    InputError
        With file and line, if a file cannot be used.
    """
    files = _files(path)
    for kind, what in (("image", "file of image points"), ("orientation", "file of exterior orientations")):
        if kind not in files:
            raise InputError(f"not a PATB block: there is not exactly one {what}", path)
    notes: list[str] = []
    measured = photos(files["image"])
    poses = _orientations(files["orientation"])
    have = {p.head.fields[0]: p for p in measured}
    without = [label for label in poses if label not in have]
    if without:
        notes.append(f"{len(without)} orientation(s) of photos without image points are left out: {', '.join(without[:10])}")
    order = [label for label in poses if label in have]
    if not order:
        raise InputError("no photo of the image points has an exterior orientation", files["image"])
    distances = [_distance(have[label].head) for label in order]
    different = list(dict.fromkeys(distances))
    cameras = tuple(
        camera_models.create(
            str(k + 1), camera_models.model("brown"), {"principal_distance": 1e-3 * c}, unit="mm", pixel_size=PIXEL, y_down=False
        )
        for k, c in enumerate(different)
    )
    notes.append(
        f"principal distance(s) {', '.join(f'{1e-3 * c:.10g}' for c in different)} mm are fixed; image coordinates are taken as refined "
        "(principal point and distortion removed)"
    )
    matrix = np.array([poses[label][1] for label in order])
    known = _control(files["control"]) if "control" in files else {}
    return block(
        {label: different.index(c) for label, c in zip(order, distances, strict=True)},
        cameras,
        np.array([poses[label][0] for label in order]),
        (matrix, matrix.transpose(0, 2, 1)),
        measured,
        _factor,
        known,
        {},
        _READINGS,
        notes,
    )


def _raw_distance(head: Line) -> float:
    c = head.number_at(1, "principal distance")
    if not 1.0 < c < LARGEST:
        raise head.error(f"the principal distance must be positive, in micrometres or millimetres, not {c!r}")
    return c


def _factor(photo: Photo) -> float:
    return 1.0 if _raw_distance(photo.head) >= 1000.0 else 1000.0


def _distance(head: Line) -> float:
    c = _raw_distance(head)
    return c if c >= 1000.0 else 1000.0 * c


def _orientations(file: Path) -> dict[str, tuple[Floats, Floats]]:
    lines = [line for line in lines_of(file) if line.fields[0] != END]
    out: dict[str, tuple[Floats, Floats]] = {}
    for k in range(0, len(lines), 3):
        records = lines[k : k + 3]
        head = records[0]
        if len(records) < 3 or len(head.fields) not in (4, 5) or len(records[1].fields) != 5 or len(records[2].fields) != 4:
            raise head.error("an orientation has three records with 4 (or 5), 5 and 4 fields: truncated?")
        label = head.text_at(0, "photo")
        if label in out:
            raise head.error(f"photo {label!r} appears twice")
        shift = len(head.fields) - 3
        position = np.array([head.number_at(i + shift, "projection centre") for i in range(3)])
        if np.abs(position).max() > LARGEST:
            raise head.error(f"a coordinate is beyond {LARGEST:g}")
        elements = [r.number_at(i, "element of the rotation matrix") for r in records[1:] for i in range(len(r.fields))]
        matrix = np.array(elements).reshape(3, 3)
        out[label] = position, _orthonormal(matrix, records[1])
    if not out:
        raise InputError("the file has no orientations", file)
    return out


def _orthonormal(matrix: Floats, line: Line) -> Floats:
    """Return the rotation next to a matrix with rounded elements.

    Raises
    ------
    InputError
        If the matrix is further from a rotation than four decimals explain.
    """
    if np.abs(matrix).max() > 1.01:
        raise line.error("the matrix is not a rotation (an element is beyond 1)")
    u, s, v = np.linalg.svd(matrix)
    if np.abs(s - 1.0).max() > 1e-4 or np.linalg.det(matrix) < 0.0:
        raise line.error("the matrix is not a rotation (orthonormal with determinant +1)")
    near = u @ v
    checks.rotation_matrices(near[None], line.complain)
    return np.asarray(near)


def _control(file: Path) -> dict[str, Known]:
    out: dict[str, Known] = {}
    part = 0
    for line in lines_of(file):
        if line.fields[0] == END:
            part += 1
            continue
        label = line.text_at(0, "point")
        vertical = part > 0
        if len(line.fields) < (2 if vertical else 3):
            raise line.error("a control point needs X and Y, one in height Z")
        old = out.get(label)
        xyz = np.full(3, np.nan) if old is None else np.array(old.xyz)
        axes = ((2, 1),) if vertical else ((0, 1), (1, 2), *(((2, 3),) if len(line.fields) > 3 and "." in line.fields[3] else ()))
        for axis, i in axes:
            if np.isfinite(xyz[axis]):
                raise line.error(f"point {label!r} appears twice")
            xyz[axis] = line.number_at(i, "coordinate")
        if np.nanmax(np.abs(xyz)) > LARGEST:
            raise line.error(f"a coordinate is beyond {LARGEST:g}")
        out[label] = Known(xyz, False, line if old is None else old.line)
    return out


patb = Format("patb", "PATB image points, exterior orientations and control points", recognises, read)
