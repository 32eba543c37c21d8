"""What the files of a COLMAP model hold, text or binary alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NO_POINT = -1  # of an image point that was not triangulated; 2^64 - 1 in binary files

#: COLMAP's numbers and names of camera models (src/colmap/sensor/models.h); which of them are supported, `baarda.cameras` says
CAMERA_MODELS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    14: "SIMPLE_FISHEYE",
    15: "FISHEYE",
    16: "EUCM",
    17: "EQUIRECTANGULAR",
}


@dataclass(frozen=True)
class Place:
    """Where a record stands: line of a text file or byte offset of a binary one."""

    file: Path
    line: int | None = None
    offset: int | None = None

    def error(self, message: str) -> InputError:
        """Return an error that names the place."""
        return InputError(message if self.offset is None else f"byte {self.offset}: {message}", self.file, self.line)

    def __str__(self) -> str:
        return f"in line {self.line}" if self.offset is None else f"at byte {self.offset}"


@dataclass(frozen=True)
class ModelCamera:
    """A camera: id, name of the model, width and height in pixels, parameters in COLMAP's order."""

    id: int
    model: str
    width: int
    height: int
    parameters: Floats
    place: Place


@dataclass(frozen=True)
class ModelImage:
    """An image: id, quaternion w x y z and translation (camera from world), camera id, name, image points, ids of their object points."""

    id: int
    quaternion: Floats
    translation: Floats
    camera: int
    name: str
    xy: Floats
    point_ids: Integers
    place: Place


@dataclass(frozen=True)
class ModelPoints:
    """The object points: ids, coordinates (n, 3), lengths of the tracks, and where each stands (lines, or byte offsets if `binary`)."""

    file: Path
    ids: Integers
    xyz: Floats
    tracks: Integers
    places: Integers
    binary: bool = False

    def place(self, i: int) -> Place:
        """Return where point i stands."""
        where = int(self.places[i])
        return Place(self.file, offset=where) if self.binary else Place(self.file, line=where)
