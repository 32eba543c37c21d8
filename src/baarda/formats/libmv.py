"""libmv bundle problems: one binary file, little or big endian, as ceres-solver carries them (data/libmv-ba-problems).

``v`` (little endian) or ``V`` (big), ``P`` (markers in pixels) or ``N`` (normalised); float32 focal, ppx, ppy, k1, k2, k3, p1, p2; number
of cameras, each image number, R (column by column), t; number of points, each track number, X Y Z; number of markers, each image, track,
x, y.
libmv's camera looks along +z with y down and maps the world by R X + t: M = diag(1, -1, -1) R, projection centre -R't.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from baarda import cameras as camera_models
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, read_bytes
from baarda.network import Images, Network, Points
from baarda.observations import ImagePoints

_PARAMETERS = ("principal_distance", "principal_point_x", "principal_point_y", "k1", "k2", "k3", "p1", "p2")
_ORDERS = {b"v": "<", b"V": ">"}
_SPACES = {b"P": "px", b"N": ""}
_HEAD = 2 + 4 * len(_PARAMETERS)
_AXES = np.diag([1.0, -1.0, -1.0])  # libmv's camera axes in ours


def recognises(path: Path) -> bool:
    """Tell a libmv problem by its two letters, a positive focal length and a number of cameras that the file can hold."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        head = f.read(_HEAD + 4)
    if len(head) < _HEAD + 4 or head[:1] not in _ORDERS or head[1:2] not in _SPACES:
        return False
    order = _ORDERS[head[:1]]
    (focal,) = struct.unpack(order + "f", head[2:6])
    (cameras,) = struct.unpack(order + "i", head[_HEAD:])
    return bool(0.0 < focal < 1e9 and 0 < cameras <= path.stat().st_size // 52)


def read(path: Path) -> Network:
    """Read a libmv problem.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Network
        Images and points are labelled by their numbers; one camera with fixed parameters; a free network in model units.

    Raises
    ------
    InputError
        With the byte at which the file cannot be used.
    """
    data = read_bytes(path)
    if len(data) < _HEAD or data[:1] not in _ORDERS or data[1:2] not in _SPACES:
        raise InputError("not a libmv problem: it must begin with v or V, then P or N, then eight numbers", path)
    order = _ORDERS[data[:1]]
    given = np.frombuffer(data, order + "f4", len(_PARAMETERS), 2)
    if not (np.isfinite(given).all() and given[0] > 0.0):
        raise InputError(f"byte 2: the camera parameters must be finite and the focal length positive: {given.tolist()}", path)
    values = given.astype(float)
    i4, f4 = order + "i4", order + "f4"
    cameras, at = _table(data, _HEAD, [("id", i4), ("R", f4, (9,)), ("t", f4, (3,))], "cameras", order, path)
    begin = at
    points, at = _table(data, begin, [("id", i4), ("X", f4, (3,))], "points", order, path)
    start = at
    markers, at = _table(data, start, [("image", i4), ("track", i4), ("xy", f4, (2,))], "markers", order, path)
    if at != len(data):
        raise InputError(f"byte {at}: the file goes on after the markers", path)

    image = _index(markers["image"], cameras["id"], "camera", start, path)
    point = _index(markers["track"], points["id"], "point", start, path)
    rotation = _rotations(cameras["R"].astype(float).reshape(-1, 3, 3).transpose(0, 2, 1), path)
    labels = [str(i) for i in cameras["id"].tolist()]

    def error(i: int, message: str) -> InputError:
        return InputError(f"byte {_HEAD + 4 + cameras.dtype.itemsize * i}: {message}", path)

    checks.images_with_points(image, labels, np.ones(len(labels), dtype=bool), error)
    unit = _SPACES[data[1:2]]
    camera = camera_models.create("libmv", camera_models.model("libmv"), dict(zip(_PARAMETERS, values.tolist(), strict=True)))
    notes = [
        "image sigma 1 px, because a libmv problem has none"
        if unit
        else "image sigma 1 in the normalised unit of the markers, because a libmv problem has none",
        "a libmv problem does not say which camera parameters were estimated: all are fixed",
    ]
    return Network(
        (camera,),
        Images.make(labels, None, -np.einsum("nji,nj->ni", rotation, cameras["t"].astype(float)), _AXES @ rotation),
        Points.make([str(i) for i in points["id"].tolist()], points["X"].astype(float)),
        (ImagePoints.make(image, point, markers["xy"].astype(float)),),
        unit=checks.MODEL_UNITS,
        assumptions=tuple(notes),
    )


def _table(data: bytes, at: int, fields: list[Any], what: str, order: str, path: Path) -> tuple[Any, int]:
    """Return the records that follow their number at byte `at`, and the byte after them."""
    dtype = np.dtype(fields)
    if at + 4 > len(data):
        raise InputError(f"byte {at}: the number of {what} is missing: truncated?", path)
    (count,) = struct.unpack_from(order + "i", data, at)
    end = at + 4 + count * dtype.itemsize
    if count < 1:
        raise InputError(f"byte {at}: the number of {what} must be positive, not {count}", path)
    if end > len(data):
        raise InputError(f"byte {at}: {count} {what} are announced, the file ends before them: truncated?", path)
    records = np.frombuffer(data, dtype, count, at + 4)
    for name in dtype.names or ():
        bad = np.flatnonzero(~np.isfinite(records[name].reshape(count, -1)).all(axis=1))
        if len(bad):
            raise InputError(f"byte {at + 4 + int(bad[0]) * dtype.itemsize}: {what}: a number is not finite", path)
    if "id" in (dtype.names or ()):
        again = np.setdiff1d(np.arange(count), np.unique(records["id"], return_index=True)[1])
        if len(again):
            first = int(again[0])
            raise InputError(f"byte {at + 4 + first * dtype.itemsize}: {what}: number {records['id'][first]} appears twice", path)
    return records, end


def _index(wanted: Any, known: Any, what: str, at: int, path: Path) -> Any:
    """Return where each marker's number stands among the known ones."""
    order = np.argsort(known, kind="stable")
    found = order[np.minimum(np.searchsorted(known, wanted, sorter=order), len(known) - 1)]
    bad = np.flatnonzero(known[found] != wanted)
    if len(bad):
        raise InputError(f"byte {at + 4 + 16 * int(bad[0])}: a marker names {what} {wanted[bad[0]]}, which is not in the file", path)
    return found.astype(np.intp)


def _rotations(matrices: Any, path: Path) -> Any:
    """Return the rotations next to matrices in single precision."""

    def error(i: int, message: str) -> InputError:
        return InputError(f"byte {_HEAD + 4 + 52 * i}: {message}", path)

    checks.rotation_matrices(matrices, error)
    u, _, v = np.linalg.svd(matrices)
    return u @ v


libmv = Format("libmv", "libmv bundle problem (binary, as ceres-solver carries them)", recognises, read)
