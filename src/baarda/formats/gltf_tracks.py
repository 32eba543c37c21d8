"""Tracks of an OPF project: points with image points in a glTF 2.0 file and its binary buffers (extension OPF_mesh_primitive_matches)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError
from baarda.formats.base import LARGEST, regular_size, unreadable
from baarda.formats.json_tree import Json, read_json

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # from y up to z up
_MATCHES = "OPF_mesh_primitive_matches"
_OFFSET_BITS = 40


@dataclass(frozen=True)
class Tracks:
    """Points and their image points.

    Attributes
    ----------
    file : Path
    xyz : (n, 3) array
        Processing system, z up.
    cameras : tuple of str
        Ids of cameras.
    point, camera : (k,) int arrays
        Point and camera of each image point.
    xy : (k, 2) array
        Pixels.
    """

    file: Path
    xyz: Floats
    cameras: tuple[str, ...]
    point: Ints
    camera: Ints
    xy: Floats


class _Gltf:
    """A glTF file whose buffers are files beside it."""

    def __init__(self, file: Path, allowed: list[Path]) -> None:
        self.root, self.folder, self.allowed = read_json(file), file.parent, allowed

    def entry(self, name: str, index: int, at: Json) -> Json:
        """Return an element of a list of the root."""
        found = self.root.need(name)
        if not 0 <= index < len(found.array()):
            raise at.error(f"there is no {index} in {name}")
        return found.at(index)

    def array(self, index: Json, kinds: tuple[str, ...], width: int, what: str) -> NDArray[Any]:
        """Return the values of an accessor, (count,) or (count, width)."""
        a = self.entry("accessors", index.whole(0, 10**9), index)
        kind, code = a.need("type").word(), a.need("componentType").whole(0, 10**6)
        if _WIDTHS.get(kind) != width or _TYPES.get(code) not in kinds:
            raise a.error(f"{what} must be {width} value(s) of type {' or '.join(kinds)}, not {kind!r:.20} of {code}")
        count = a.need("count").whole(0, 10**12)
        view = self.entry("bufferViews", a.need("bufferView").whole(0, 10**9), a)
        start = sum(0 if v is None else v.whole(0, LARGEST) for v in (view.get("byteOffset"), a.get("byteOffset")))
        if view.get("byteStride") is not None:
            raise view.error("interleaved buffers (byteStride) are not part of OPF")
        buffer = self.entry("buffers", view.need("buffer").whole(0, 10**9), view)
        file = self.file(buffer.need("uri"))
        dtype = np.dtype(_TYPES[code])
        need = start + count * width * dtype.itemsize
        size = regular_size(file)
        if need > size:
            raise InputError(f"{what}: {need} bytes are announced, the file has {size}: truncated?", file)
        try:
            values = np.fromfile(file, dtype, count * width, offset=start)
        except OSError as error:
            raise unreadable(error, file) from None
        with np.errstate(invalid="ignore"):  # a NaN that signals
            values = values.astype(float) if values.dtype.kind == "f" else values
        return values if width == 1 else values.reshape(count, width)

    def file(self, uri: Json) -> Path:
        """Return a buffer's file: one that the project lists, or one in the folder of the glTF file."""
        text = unquote(uri.word())
        parts = PurePosixPath(text.replace("\\", "/"))
        found = self.folder / parts
        if ":" in text or parts.is_absolute() or not parts.name or "\0" in text:
            raise uri.error(f"{text!r:.80} must be the path of a file of the project")
        if found.resolve() not in self.allowed and (".." in parts.parts or not found.resolve().is_relative_to(self.folder.resolve())):
            raise uri.error(f"{text!r:.80} leads out of the folder of the project")
        return found


def read_tracks(file: Path, allowed: list[Path] | None = None) -> Tracks:
    """Read the points and matches of an OPF point cloud.

    Parameters
    ----------
    file : Path
        The ``.gltf`` file.
    allowed : list of Path, optional
        Buffers that the project lists; others must lie beside the file.

    Returns
    -------
    Tracks
        Points without matches are left out of `point`; `xy` is empty where the file holds no image points.

    Raises
    ------
    InputError
        With file and line, if something cannot be used.
    """
    gltf = _Gltf(file, allowed or [])
    xyz: list[Floats] = []
    cameras: dict[str, int] = {}
    point, camera, xy = [], [], []
    begin = 0
    for node in gltf.root.need("nodes").items():
        mesh = gltf.entry("meshes", node.need("mesh").whole(0, 10**9), node)
        primitives = mesh.need("primitives")
        if len(primitives.array()) != 1:
            raise primitives.error("a mesh of an OPF point cloud has one primitive")
        primitive = primitives.at(0)
        local = gltf.array(primitive.need("attributes").need("POSITION"), ("<f4",), 3, "positions")
        placed = _placed(local, node.get("matrix")) @ _UP.T
        if not (np.abs(placed) <= 1e12).all():
            raise primitive.error("a position is not finite")
        xyz.append(placed)
        extensions = primitive.get("extensions")
        matches = None if extensions is None else extensions.get(_MATCHES)
        if matches is not None and matches.get("imagePoints") is not None:
            ids = [cameras.setdefault(c.label(), len(cameras)) for c in matches.need("cameraUids").items()]
            p, c, v = _matches(gltf, matches, len(local), np.array(ids, dtype=np.intp))
            point.append(p + begin)
            camera.append(c)
            xy.append(v)
        begin += len(local)
    none = np.zeros(0, dtype=np.intp)
    return Tracks(
        file,
        np.concatenate(xyz) if xyz else np.zeros((0, 3)),
        tuple(cameras),
        np.concatenate(point) if point else none,
        np.concatenate(camera) if camera else none,
        np.concatenate(xy) if xy else np.zeros((0, 2)),
    )


def _placed(local: Floats, matrix: Json | None) -> Floats:
    """Apply the transform of a node, column by column as glTF writes it."""
    if matrix is None:
        return local
    m = matrix.numbers(16).reshape(4, 4).T
    if not np.allclose(m[3], [0.0, 0.0, 0.0, 1.0]):
        raise matrix.error("the last row of the transform must be 0, 0, 0, 1")
    return np.asarray(local @ m[:3, :3].T + m[:3, 3])


def _matches(gltf: _Gltf, matches: Json, count: int, ids: Ints) -> tuple[Ints, Ints, Floats]:
    """Return point, camera and pixels of each match of one primitive."""
    camera = gltf.array(matches.need("cameraIds"), ("<u4",), 1, "camera ids").astype(np.int64)
    packed = gltf.array(matches.need("pointIndexRanges"), ("<u4",), 2, "index ranges").astype(np.uint64)
    pixels = gltf.array(matches.need("imagePoints").need("pixelCoordinates"), ("<f4",), 2, "pixel coordinates")
    if len(packed) != count or len(pixels) != len(camera):
        raise matches.error(
            f"{count} points have {len(packed)} index ranges, and {len(camera)} matches {len(pixels)} image points: the counts must agree"
        )
    if len(camera) and not (camera.max() < len(ids)):
        raise matches.error(f"a match names camera {int(camera.max())} of {len(ids)}")
    if not (np.abs(pixels) <= 1e9).all():
        raise matches.error("a pixel coordinate is not finite")
    whole = packed[:, 0] | (packed[:, 1] << np.uint64(32))
    start = (whole & np.uint64((1 << _OFFSET_BITS) - 1)).astype(np.int64)
    length = (whole >> np.uint64(_OFFSET_BITS)).astype(np.int64)
    total = int(length.sum())
    if len(start) and (int((start + length).max()) > len(camera) or total > len(camera)):
        raise matches.error(f"an index range ends beyond the {len(camera)} matches, or ranges overlap")
    owner = np.repeat(np.arange(count), length)
    row = np.repeat(start - np.concatenate([[0], np.cumsum(length)[:-1]]), length) + np.arange(total)
    return owner.astype(np.intp), ids[camera[row]].astype(np.intp), pixels[row]
