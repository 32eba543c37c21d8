"""Pix4Dmapper's folder of parameters: ``*_calibrated_camera_parameters.txt``, ``*_tp_pix4d.txt`` and, where it is there, ``*_offset.xyz``.

For each image: name, width and height; the camera matrix K; three radial and two tangential coefficients; the projection centre t; R, from
the object to axes x right, y down, z forward: m = K [R | -R t] X. Tie points: a line with the image's name without its ending, a line per
point (number, x, y in pixels, size), -99. Pixels count from the corner of the first one. The coordinates are local; the offset leads to the
coordinate system of the project's output. For the camera see `baarda.cameras.pix4d`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, Line, split_lines
from baarda.formats.gcp_marks import intersected
from baarda.formats.photo_blocks import head_of, photos
from baarda.network import Images, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]

PARAMETERS, TIES, OFFSET = "_calibrated_camera_parameters.txt", "_tp_pix4d.txt", "_offset.xyz"
_FIRST = ["fileName", "imageWidth", "imageHeight"]
_ROWS = (3, 3, 3, 3, 2, 3, 3, 3, 3)  # numbers in the lines below an image's name
_LENS = ("R1", "R2", "R3", "T1", "T2")
LARGEST = 1e9


def _files(path: Path) -> dict[str, Path] | None:
    """Return the files of a folder, or those that share the project's name with one of them."""
    folder = path if path.is_dir() else path.parent
    if not folder.is_dir():
        return None
    out: dict[str, Path] = {}
    for kind in (PARAMETERS, TIES, OFFSET):
        found = [
            p for p in sorted(folder.iterdir()) if p.name.lower().endswith(kind.lstrip("_") if kind is PARAMETERS else kind) and p.is_file()
        ]
        if path.is_file():
            found = [p for p in found if path.name.startswith(p.name[: -len(kind)])]
        if len(found) == 1:
            out[kind] = found[0]
    if path.is_file() and path not in out.values():
        return None
    return out if PARAMETERS in out and TIES in out else None


def recognises(path: Path) -> bool:
    """Tell a folder of parameters by the heading of the camera parameters beside the tie points."""
    files = _files(path)
    return files is not None and head_of(files[PARAMETERS])[:1] == [_FIRST]


def read(path: Path) -> Network:
    """Read the parameters and tie points of a Pix4Dmapper project.

    Parameters
    ----------
    path : Path
        The folder ``1_initial/params``, or one of its files.

    Returns
    -------
    Network
        Images by their file names, tie points by their numbers; start values are the intersections of their rays.

    Raises
    ------
    InputError
        With file and line, if a file cannot be used.
    """
    files = _files(path)
    if files is None:
        raise InputError(f"not a folder of Pix4D's parameters: it needs *{PARAMETERS} and *{TIES}", path)
    notes: list[str] = []
    offset = _offset(files[OFFSET]) if OFFSET in files else None
    labels, heads, sizes, values, position, rotation = _parameters(files[PARAMETERS])
    cameras, owner = _cameras(values, sizes, heads)
    notes.append(f"{len(cameras)} camera(s): images with the same parameters share one; free are f, the principal point and what is not 0")
    if offset is None:
        notes.append("there is no *_offset.xyz: coordinates are local to the project")
        unit = checks.MODEL_UNITS
    else:
        position = position + offset
        unit = "m"
        notes.append("coordinates are those of the project's output system (a projection, in which the block stays as its program has it)")
    images = Images.make(labels, owner, position, np.diag([1.0, -1.0, -1.0]) @ rotation)
    group, names = _ties(files[TIES], labels, notes)
    checks.images_with_points(group.images, labels, np.ones(len(labels), dtype=bool), lambda i, m: heads[i].error(m))
    empty = Network(cameras, images, Points.make(names), (group,), unit=unit)
    xyz = intersected(empty, group.points, group.images, group.xy, len(names))
    lost = ~np.isfinite(xyz).all(axis=1)
    if lost.all():
        raise InputError("the rays of no tie point meet: do the two files belong together?", files[TIES])
    if lost.any():
        notes.append(f"{int(lost.sum())} tie point(s) whose rays do not meet have no start values")
    notes.append("image sigma 1 px, because the files have none; the names of control points are those of tie points: --control tells them")
    return Network(cameras, images, Points.make(names, xyz), (group,), unit=unit, assumptions=tuple(notes))


def _lines(file: Path) -> list[Line]:
    return [Line(file, i, tuple(t.split())) for i, t in enumerate(split_lines(file), start=1) if t.strip()]


def _offset(file: Path) -> Floats:
    lines = _lines(file)
    fields = [f for line in lines for f in line.fields]
    if not lines or len(fields) != 3:
        raise InputError(f"an offset has three numbers, not {len(fields)}", file, 1)
    joined = Line(file, lines[0].number, tuple(fields))
    out = np.array([joined.number_at(i, "offset") for i in range(3)])
    if np.abs(out).max() > LARGEST:
        raise lines[0].error(f"the offset is beyond {LARGEST:g}")
    return out


def _parameters(file: Path) -> tuple[list[str], list[Line], list[tuple[float, float]], list[tuple[float, ...]], Floats, Floats]:
    """Return labels, first lines, sizes, camera parameters, projection centres and rotations of the images."""
    lines = _lines(file)
    if not lines or list(lines[0].fields) != _FIRST:
        raise InputError(f"the first line must be {' '.join(_FIRST)!r}", file, 1)
    k = 1
    while k < min(len(lines), 7) and lines[k].fields[0] in ("camera", "radial", "tangential"):
        k += 1  # the description of the lines below
    labels: dict[str, Line] = {}
    sizes, values, position, rotation = [], [], [], []
    while k < len(lines):
        head = lines[k]
        if len(head.fields) < 3:
            raise head.error("a line with the image's name, width and height is expected")
        label = " ".join(head.fields[:-2])
        size = tuple(float(head.integer_at(len(head.fields) - 2 + j, "image size")) for j in range(2))
        rows = lines[k + 1 : k + 1 + len(_ROWS)]
        if len(rows) < len(_ROWS):
            raise head.error(f"the parameters of image {label!r} are cut off")
        for row, count in zip(rows, _ROWS, strict=True):
            if len(row.fields) != count:
                raise row.error(f"{len(row.fields)} numbers where {count} are expected")
        numbers = [[row.number_at(i, "parameter") for i in range(len(row.fields))] for row in rows]
        if label in labels:
            raise head.error(f"image {label!r} appears twice (first in line {labels[label].number})")
        matrix = np.array(numbers[:3])
        f = matrix[0, 0]
        if not 1.0 < f < LARGEST or not np.array_equal(matrix, [[f, 0, matrix[0, 2]], [0, f, matrix[1, 2]], [0, 0, 1]]):
            raise rows[0].error("the camera matrix must be f 0 cx, 0 f cy, 0 0 1 with a positive f")
        lens = [*numbers[3], *numbers[4]]
        if min(size) < 1.0 or max(size) > 1e6 or max(map(abs, lens)) > 1e3 or max(map(abs, (matrix[0, 2], matrix[1, 2]))) > LARGEST:
            raise head.error("the size, the principal point or a coefficient is beyond all cameras")
        if max(map(abs, numbers[5])) > LARGEST:
            raise rows[5].error(f"a coordinate is beyond {LARGEST:g}")
        r = np.array(numbers[6:])
        checks.rotation_matrices(r[None], rows[6].complain)
        labels[label] = head
        sizes.append((size[0], size[1]))
        values.append((float(f), float(matrix[0, 2]), float(matrix[1, 2]), *lens))
        position.append(numbers[5])
        rotation.append(r)
        k += 1 + len(_ROWS)
    if not labels:
        raise InputError("the file has no images", file)
    return list(labels), list(labels.values()), sizes, values, np.array(position), np.array(rotation)


def _cameras(values: list[tuple[float, ...]], sizes: list[tuple[float, float]], heads: list[Line]) -> tuple[tuple[Camera, ...], list[int]]:
    index: dict[tuple[float, ...], int] = {}
    owner = [index.setdefault((*v, *s), len(index)) for v, s in zip(values, sizes, strict=True)]
    if len(index) > max(20, len(heads) // 2):
        raise heads[0].error(f"{len(index)} images have cameras of their own: a calibration per image is not what Pix4D writes")
    out = []
    names = ("principal_distance", "principal_point_x", "principal_point_y")
    for k, key in enumerate(index):
        v = dict(zip((*names, *_LENS), key[:-2], strict=True))
        free = [*names, *(n for n in _LENS if v[n] != 0.0)]
        out.append(camera_models.create(str(k + 1), camera_models.model("pix4d"), v, free=free, image_size=(key[-2], key[-1])))
    return tuple(out), owner


def _ties(file: Path, labels: list[str], notes: list[str]) -> tuple[ImagePoints, list[str]]:
    exact = {label: i for i, label in enumerate(labels)}
    short: dict[str, int] = {}
    for k, label in enumerate(labels):
        stem = label.rsplit(".", 1)[0]
        short[stem] = -1 if stem in short else k
    point_of: dict[str, int] = {}
    rows, at = [], []
    lost = 0
    for photo in photos(file, whole=True):
        name = " ".join(photo.head.fields)
        image = exact.get(name, short.get(name, -1))
        if image < 0:
            lost += 1
            continue
        for line in photo.points:
            point = line.text_at(0, "point")
            x, y = line.number_at(1, "x"), line.number_at(2, "y")
            if max(abs(x), abs(y)) > LARGEST:
                raise line.error(f"an image coordinate is beyond {LARGEST:g}")
            rows.append((image, point_of.setdefault(point, len(point_of)), x, y))
            at.append(line)
    if lost:
        notes.append(f"{lost} image(s) of {file.name} have no parameters: left out")
    if not rows:
        raise InputError("no image of the tie points is among the camera parameters", file)
    table = np.array(rows)
    i, p = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    names = list(point_of)
    checks.measured_once(i, p, names, lambda row, m: at[row].error(m), lambda row: at[row].number)
    return ImagePoints.make(i, p, table[:, 2:], 1.0), names


pix4d = Format(
    "pix4d", "Pix4Dmapper parameters (calibrated_camera_parameters.txt, tp_pix4d.txt, offset.xyz)", recognises, read, first_pixel=0.5
)
