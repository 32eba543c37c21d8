"""COLMAP's binary files: little endian, no magic number; every count is checked against the bytes that are left."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.errors import InputError
from baarda.formats.base import read_bytes
from baarda.formats.colmap_model import CAMERA_MODELS, NO_POINT, ModelCamera, ModelImage, ModelPoints, Place

_POINT2D = np.dtype([("xy", "<f8", 2), ("id", "<u8")])


class _Cursor:
    """The bytes of a file and how far they are read."""

    def __init__(self, path: Path) -> None:
        self.data = read_bytes(path)
        if not self.data:
            raise InputError("the file is empty", path)
        self.path, self.at = path, 0

    @property
    def place(self) -> Place:
        return Place(self.path, offset=self.at)

    def _need(self, size: int, what: str) -> int:
        at = self.at
        if size > len(self.data) - at:
            raise self.place.error(f"{what}: {size} bytes needed, {len(self.data) - at} left: truncated?")
        self.at = at + size
        return at

    def take(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        return layout.unpack_from(self.data, self._need(layout.size, what))

    def array(self, dtype: Any, count: int, what: str) -> NDArray[Any]:
        dtype = np.dtype(dtype)
        return np.frombuffer(self.data, dtype, count, self._need(dtype.itemsize * count, what))

    def count(self, smallest: int, what: str) -> int:
        """Return a number of records, each of `smallest` bytes at least, that the file can hold."""
        place = self.place
        (n,) = self.take(_U64, f"number of {what}")
        if n * smallest > len(self.data) - self.at:
            raise place.error(f"{n} {what} announced, {len(self.data) - self.at} bytes left: truncated or damaged")
        return int(n)

    def text(self, what: str) -> str:
        place, end = self.place, self.data.find(b"\0", self.at)
        if end < 0:
            raise place.error(f"{what} does not end: truncated?")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise place.error(f"{what} is not UTF-8 text: {raw[:40]!r}") from None

    def finite(self, values: Any, place: Place, what: str) -> NDArray[np.float64]:
        out = np.array(values, dtype=float)
        if not np.isfinite(out).all():
            raise place.error(f"{what}: not finite")
        return out

    def end(self) -> None:
        if self.at < len(self.data):
            raise self.place.error(f"{len(self.data) - self.at} bytes follow the last record")


_U64 = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_RIG = struct.Struct("<II")
_SENSOR = struct.Struct("<iI")


def read_cameras_binary(path: Path) -> list[ModelCamera]:
    """Read ``cameras.bin``."""
    cursor = _Cursor(path)
    known = camera_models.models()
    out = []
    for _ in range(cursor.count(_CAMERA.size + 24, "cameras")):
        place = cursor.place
        camera, model, width, height = cursor.take(_CAMERA, "camera")
        name = CAMERA_MODELS.get(model, f"number {model}")
        if name not in known:  # how many parameters follow is then not known either
            supported = ", ".join(m for m in CAMERA_MODELS.values() if m in known)
            raise place.error(f"camera {camera}: model {name} is not supported; supported are {supported}")
        values = cursor.array("<f8", len(known[name].order), f"parameters of camera {camera}")
        out.append(ModelCamera(camera, name, width, height, cursor.finite(values, place, f"parameters of camera {camera}"), place))
    cursor.end()
    return out


def read_images_binary(path: Path) -> list[ModelImage]:
    """Read ``images.bin``."""
    cursor = _Cursor(path)
    out = []
    for _ in range(cursor.count(_IMAGE.size + 9, "images")):
        place = cursor.place
        image, *pose, camera = cursor.take(_IMAGE, "image")
        name = cursor.text(f"name of image {image}")
        if not name:
            raise place.error(f"image {image} has no name")
        rows = cursor.array(_POINT2D, cursor.count(_POINT2D.itemsize, f"points of image {name!r}"), f"points of image {name!r}")
        xy = cursor.finite(rows["xy"], place, f"points of image {name!r}")
        ids = rows["id"].astype(np.int64)  # 2^64 - 1 becomes -1
        if (ids < NO_POINT).any():
            raise place.error(f"image {name!r}: impossible point id {rows['id'][int(np.argmax(ids < NO_POINT))]}")
        values = cursor.finite(pose, place, f"orientation of image {name!r}")
        out.append(ModelImage(image, values[:4], values[4:], camera, name, xy, ids, place))
    cursor.end()
    return out


def read_points_binary(path: Path) -> ModelPoints:
    """Read ``points3D.bin``."""
    cursor = _Cursor(path)
    n = cursor.count(_POINT.size, "points")
    ids, xyz = np.empty(n, dtype=np.uint64), np.empty((n, 3))
    tracks, places = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for i in range(n):
        places[i] = cursor.at
        record = cursor.take(_POINT, "point")
        ids[i], xyz[i], tracks[i] = record[0], record[1:4], min(record[8], len(cursor.data))
        cursor._need(8 * record[8], f"track of point {record[0]}")
    cursor.end()
    out = ModelPoints(path, ids.astype(np.int64), xyz, tracks, places, binary=True)
    bad = np.flatnonzero(~np.isfinite(xyz).all(axis=1) | (out.ids < 0))
    if len(bad):
        raise out.place(int(bad[0])).error(f"point {ids[bad[0]]}: its id is impossible or its coordinates are not finite")
    return out


def read_rigs_binary(path: Path) -> list[int]:
    """Read ``rigs.bin``; return the number of sensors of each rig."""
    cursor = _Cursor(path)
    out = []
    for _ in range(cursor.count(_RIG.size, "rigs")):
        _rig, sensors = cursor.take(_RIG, "rig")
        if sensors:
            cursor.take(_SENSOR, "reference sensor")
        for _ in range(sensors - 1):
            cursor.take(_SENSOR, "sensor")
            (has_pose,) = cursor.array("u1", 1, "sensor")
            cursor.array("<f8", 7 if has_pose else 0, "sensor")
        out.append(sensors)
    cursor.end()
    return out
