"""BINGO: image coordinates ``image.dat``, start values ``itera.dat``, cameras and control points ``geoin.dat``.

``image.dat``: a line with the photo and, where it is there, the camera; a line per point (point, x, y in millimetres), -99. ``itera.dat``:
``ORIA`` photo, X0, Y0, Z0, phi, omega, kappa in gon, camera; ``CORD`` point, X, Y, Z. ``geoin.dat``: ``CAPA`` camera, its kind, principal
distance, x0, y0 in millimetres; ``CONT`` and ``CHCK`` point, X, Y, Z. Lines that begin with * or C and a blank are comments, other records
do not count. M = R3(kappa) R1(omega) R2(phi), as BINGO and BLUH turn; where omega comes first, the image points show it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.errors import InputError
from baarda.formats.base import Format, Line
from baarda.formats.photo_blocks import LARGEST, PIXEL, Known, Photo, block, head_of, lines_of, photos
from baarda.geometry import rotation as rot
from baarda.network import Network

Floats = NDArray[np.float64]

NAMES = ("image.dat", "itera.dat", "geoin.dat")
_READINGS = ("angles are phi, omega, kappa (phi first)", "angles are omega, phi, kappa (omega first)")


def _files(path: Path) -> list[Path] | None:
    folder = path if path.is_dir() else path.parent
    if not folder.is_dir() or (path.is_file() and path.name.lower() not in NAMES):
        return None
    found = {p.name.lower(): p for p in folder.iterdir() if p.is_file()}
    return [found[n] for n in NAMES] if all(n in found for n in NAMES) else None


def recognises(path: Path) -> bool:
    """Tell a project by its three files and orientations (ORIA) or a camera (CAPA) in two of them."""
    files = _files(path)
    if files is None:
        return False
    return any(f[0] in ("ORIA", "CORD") for f in head_of(files[1])) and any(f[0] == "CAPA" for f in head_of(files[2]))


def read(path: Path) -> Network:
    """Read a BINGO project.

    Parameters
    ----------
    path : Path
        The folder with ``image.dat``, ``itera.dat`` and ``geoin.dat``, or one of them.

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
    if files is None:
        raise InputError(f"not a BINGO project: it needs {', '.join(NAMES)}", path)
    notes: list[str] = []
    measured = photos(files[0])
    cameras, known = _geometry(files[2], notes)
    poses, starts = _orientations(files[1])
    have = {p.head.fields[0]: p for p in measured}
    without = [label for label in poses if label not in have]
    if without:
        notes.append(f"{len(without)} orientation(s) of photos without image points are left out: {', '.join(without[:10])}")
    order = [label for label in poses if label in have]
    if not order:
        raise InputError("no photo of the image points has an exterior orientation", files[0])
    index = {c.label: i for i, c in enumerate(cameras)}
    owner = {label: _owner(have[label].head, poses[label][1], index) for label in order}
    values = np.array([poses[label][0] for label in order])
    phi, omega, kappa = np.radians(0.9 * values[:, 3:]).T
    zero = np.zeros_like(phi)
    notes.append("the cameras of geoin.dat are fixed; --camera frees their parameters")
    return block(
        owner,
        cameras,
        values[:, :3],
        (
            rot.from_angles(zero, zero, kappa) @ rot.from_angles(omega, zero, zero) @ rot.from_angles(zero, phi, zero),
            rot.from_angles(phi, omega, kappa),
        ),
        measured,
        _factor,
        known,
        starts,
        _READINGS,
        notes,
    )


def _factor(_photo: Photo) -> float:
    return 1000.0  # millimetres to micrometres


def _owner(head: Line, named: str | None, cameras: dict[str, int]) -> int:
    """Return the camera of a photo: as its first line says, else as its orientation says, else the only one."""
    for label in (head.fields[1] if len(head.fields) > 1 else None, named):
        if label in cameras:
            return cameras[label]
    if len(cameras) == 1:
        return 0
    raise head.error(f"the camera of photo {head.fields[0]!r} is not among those of {NAMES[2]}: {', '.join(list(cameras)[:10])}")


def _records(file: Path) -> list[Line]:
    return [line for line in lines_of(file, ("*",)) if line.fields[0] != "C"]


def _geometry(file: Path, notes: list[str]) -> tuple[tuple[Camera, ...], dict[str, Known]]:
    cameras: dict[str, Camera] = {}
    known: dict[str, Known] = {}
    arms = 0
    for line in _records(file):
        kind = line.fields[0]
        if kind == "CAPA":
            label = line.text_at(1, "camera")
            first = 3 if len(line.fields) > 5 else 2  # the kind of the camera may be left out
            c, x0, y0 = (line.number_at(first + k, w) for k, w in enumerate(("principal distance", "x0", "y0")))
            if label in cameras:
                raise line.error(f"camera {label!r} appears twice")
            if not 0.1 < c < 1e4 or max(abs(x0), abs(y0)) > 1e3:
                raise line.error("the principal distance must be positive, and the principal point near the centre, in millimetres")
            cameras[label] = camera_models.create(
                label,
                camera_models.model("brown"),
                {"principal_distance": c, "principal_point_x": x0, "principal_point_y": y0},
                unit="mm",
                pixel_size=PIXEL,
                y_down=False,
            )
        elif kind in ("CONT", "CHCK"):
            label = line.text_at(1, "point")
            if label in known:
                raise line.error(f"point {label!r} appears twice (first in line {known[label].line.number})")
            known[label] = Known(_xyz(line), kind == "CHCK", line)
        elif kind == "ECCA":
            arms += 1
    if not cameras:
        raise InputError("the file has no camera (CAPA)", file)
    if arms:
        notes.append("antenna eccentricities (ECCA) are not used: give measured positions by --camera-positions and --lever-arm")
    return tuple(cameras.values()), known


def _xyz(line: Line) -> Floats:
    xyz = np.array([line.number_at(i, "coordinate") for i in (2, 3, 4)])
    if np.abs(xyz).max() > LARGEST:
        raise line.error(f"a coordinate is beyond {LARGEST:g}")
    return xyz


def _orientations(file: Path) -> tuple[dict[str, tuple[list[float], str | None]], dict[str, Floats]]:
    """Return six values and the camera of each photo, and the start values of points."""
    poses: dict[str, tuple[list[float], str | None]] = {}
    starts: dict[str, Floats] = {}
    for line in _records(file):
        if line.fields[0] == "ORIA":
            label = line.text_at(1, "photo")
            values = [line.number_at(i, "exterior orientation") for i in range(2, 8)]
            if label in poses:
                raise line.error(f"photo {label!r} appears twice")
            if max(map(abs, values[:3])) > LARGEST or max(map(abs, values[3:])) > 1000.0:
                raise line.error(f"a coordinate is beyond {LARGEST:g}, or an angle is not in gon")
            poses[label] = values, line.fields[8] if len(line.fields) > 8 else None
        elif line.fields[0] == "CORD":
            starts[line.text_at(1, "point")] = _xyz(line)
    if not poses:
        raise InputError("the file has no orientations (ORIA)", file)
    return poses, starts


bingo = Format("bingo", "BINGO project (image.dat, itera.dat, geoin.dat)", recognises, read)
