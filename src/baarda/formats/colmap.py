"""COLMAP models, text and binary: a folder with cameras, images and points3D, since COLMAP 3.12 also rigs and frames.

COLMAP's camera looks along +z with y down and maps the world by R X + t; ours looks along -z with y up: M = diag(1, -1, -1) R and the
projection centre is -R't. Pixel coordinates stay as they are: COLMAP counts from the corner of the image, so that the first pixel's centre
lies at (0.5, 0.5), and its principal point is meant in the same way.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, label_problem, number, read_text
from baarda.formats.colmap_binary import read_cameras_binary, read_images_binary, read_points_binary, read_rigs_binary
from baarda.formats.colmap_model import CAMERA_MODELS, NO_POINT, ModelCamera, ModelImage, ModelPoints, Place
from baarda.formats.colmap_writer import write
from baarda.network import Images, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]

PARTS = ("cameras", "images", "points3D")
LARGEST_PARAMETER = 1e12  # of a camera; no lens has more, and its square must not overflow
AXES = np.diag([1.0, -1.0, -1.0])  # COLMAP's camera axes in ours


def recognises(path: Path) -> bool:
    """Tell a COLMAP model by its files; the first line of a text model is a comment or begins with a number."""
    if not path.is_dir():
        return False
    if all((path / f"{part}.bin").is_file() for part in PARTS[:2]):
        return True
    if not all((path / f"{part}.txt").is_file() for part in PARTS[:2]):
        return False
    with (path / "cameras.txt").open("rb") as f:
        first = f.read(200).lstrip()
    return not first or first.startswith(b"#") or re.match(rb"\d+\s", first) is not None


def read(path: Path) -> Network:
    """Read a COLMAP model.

    Parameters
    ----------
    path : Path
        The folder.

    Returns
    -------
    Network
        Cameras are labelled by id, images by name, points by id, each sorted by id; a free network in model units.

    Raises
    ------
    InputError
        With file and line, or byte offset, if a file cannot be used.
    """
    notes: list[str] = []
    kinds = [kind for kind in ("bin", "txt") if all((path / f"{part}.{kind}").is_file() for part in PARTS)]
    if not kinds:
        have = [p for kind in ("bin", "txt") for p in PARTS if (path / f"{p}.{kind}").is_file()]
        missing = ", ".join(p for p in PARTS if p not in have)
        raise InputError(f"not a COLMAP model: {missing} is missing (needed: cameras, images, points3D, all .bin or all .txt)", path)
    if len(kinds) == 2:
        notes.append("the folder holds a binary and a text model: the binary one is used, as COLMAP does")
    kind = kinds[0]
    cameras_file, images_file, points_file = (path / f"{part}.{kind}" for part in PARTS)
    if kind == "bin":
        cameras, images = read_cameras_binary(cameras_file), read_images_binary(images_file)
        points = read_points_binary(points_file)
    else:
        cameras, images, points = _read_cameras(cameras_file), _read_images(images_file), _read_points(points_file)
    if not images:
        raise InputError("the model has no images", images_file)
    rigs = path / f"rigs.{kind}"
    if rigs.is_file():
        several = sum(n > 1 for n in (read_rigs_binary(rigs) if kind == "bin" else _read_rigs(rigs)))
        if several:
            # the images carry the orientation in the world, composed of frame and rig
            notes.append(f"{several} rig(s) of several cameras: their fixed geometry is not used, every image has its own orientation")
    unfinished = [] if kind == "bin" else [f for f in (images_file, points_file) if not _ends(f)]
    return _network(cameras, images, points, notes, unfinished)


# ------------------------------------------------------------------------------------------------------------------- text


def _lines(path: Path, what: str) -> tuple[list[str], int | None]:
    """Return the lines of a text file (for line i + 1) and the count that its header announces."""
    lines = read_text(path).split("\n")
    announced = None
    for line in lines:
        if not line.startswith("#"):
            break
        found = re.match(rf"#\s*Number of {what}:\s*(\d{{1,15}})(?!\d)", line)
        announced = int(found[1]) if found else announced
    return lines, announced


def _ends(path: Path) -> bool:
    """Return whether the last line of a file is complete."""
    with path.open("rb") as f:
        f.seek(-1, 2)
        return f.read() == b"\n"


def _records(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    for i, line in enumerate(lines):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield i + 1, stripped


def _numbers(fields: Sequence[str], place: Place, what: str) -> Floats:
    try:
        values = np.array([number(f) for f in fields])
    except ValueError:
        bad = next(f for f in fields if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", f, re.I | re.A))
        raise place.error(f"{what}: not a number: {bad!r}") from None
    if not np.isfinite(values).all():
        raise place.error(f"{what}: not finite: {fields[int(np.flatnonzero(~np.isfinite(values))[0])]!r}")
    return values


def _integer(text: str, place: Place, what: str) -> int:
    if not re.fullmatch(r"\d{1,18}", text, re.ASCII):
        raise place.error(f"{what} is not a whole number: {text!r}")
    return int(text)


def _complete(found: int, announced: int | None, path: Path, lines: Sequence[str], what: str) -> None:
    if announced is not None and found != announced:
        message = f"the header announces {announced} {what}, the file holds {found}: truncated? (correct the header if the file was edited)"
        raise InputError(message, path, _last(lines))


def _last(lines: Sequence[str]) -> int:
    """Return the number of the last line."""
    return len(lines) - (not lines[-1])


def _read_cameras(path: Path) -> list[ModelCamera]:
    lines, announced = _lines(path, "cameras")
    out = []
    for at, line in _records(lines):
        place, fields = Place(path, line=at), line.split()
        if len(fields) < 5:
            raise place.error(f"a camera needs id, model, width, height and parameters; the line has {len(fields)} fields")
        out.append(
            ModelCamera(
                _integer(fields[0], place, "camera id"),
                fields[1],
                _integer(fields[2], place, "width"),
                _integer(fields[3], place, "height"),
                _numbers(fields[4:], place, "parameters"),
                place,
            )
        )
    _complete(len(out), announced, path, lines, "cameras")
    return out


def _read_images(path: Path) -> list[ModelImage]:
    lines, announced = _lines(path, "images")
    out = []
    i, last = 0, _last(lines)
    while i < last:
        line = lines[i].strip()
        i += 1
        if not line or line.startswith("#"):
            continue
        place, fields = Place(path, line=i), line.split(maxsplit=9)
        if len(fields) < 10:
            raise place.error(f"an image needs id, 4 + 3 numbers, camera id and name; the line has {len(fields)} fields")
        if i >= last:
            raise place.error(f"the line with the points of image {fields[9]!r} is missing: truncated?")
        pose = _numbers(fields[1:8], place, "orientation")
        image = _integer(fields[0], place, "image id")
        xy, ids = _points2d(lines[i].split(), Place(path, line=i + 1))  # the second line may be empty
        out.append(ModelImage(image, pose[:4], pose[4:], _integer(fields[8], place, "camera id"), fields[9], xy, ids, place))
        i += 1
    _complete(len(out), announced, path, lines, "images")
    return out


def _points2d(fields: list[str], place: Place) -> tuple[Floats, NDArray[np.int64]]:
    if len(fields) % 3:
        raise place.error(f"image points are x, y, point id; the line has {len(fields)} fields, not a multiple of 3: truncated?")
    x, y = _numbers(fields[0::3], place, "x of an image point"), _numbers(fields[1::3], place, "y of an image point")
    try:
        if "_" in (all_ids := "".join(fields[2::3])) or not all_ids.isascii():  # int() takes 1_000
            raise ValueError
        ids = np.array([NO_POINT if t == "18446744073709551615" else int(t) for t in fields[2::3]], dtype=np.int64)
    except (ValueError, OverflowError):
        bad = next(t for t in fields[2::3] if not re.fullmatch(r"-1|\d{1,18}|18446744073709551615", t, re.ASCII))
        raise place.error(f"not the id of a point: {bad!r}") from None
    return np.stack([x, y], axis=1), ids


def _read_points(path: Path) -> ModelPoints:
    lines, announced = _lines(path, "points")
    ids, fields_of_xyz, tracks, numbers = [], [], [], []
    for at, line in _records(lines):
        fields = line.split()
        if len(fields) < 8 or len(fields) % 2:
            place = Place(path, line=at)
            raise place.error(f"a point needs id, X Y Z, three colours, error and pairs of its track; the line has {len(fields)} fields")
        ids.append(_integer(fields[0], Place(path, line=at), "point id"))
        fields_of_xyz.append(fields[1:4])
        tracks.append((len(fields) - 8) // 2)
        numbers.append(at)
    _complete(len(ids), announced, path, lines, "points")
    try:
        xyz = np.array([[number(t) for t in f] for f in fields_of_xyz]).reshape(-1, 3)
        good = bool(np.isfinite(xyz).all())
    except ValueError:
        good = False
    if not good:
        for at, f in zip(numbers, fields_of_xyz, strict=True):
            _numbers(f, Place(path, line=at), "coordinates")
    return ModelPoints(path, np.array(ids, dtype=np.int64), xyz, np.array(tracks, dtype=np.int64), np.array(numbers, dtype=np.int64))


def _read_rigs(path: Path) -> list[int]:
    out = []
    for at, line in _records(_lines(path, "rigs")[0]):
        fields = line.split()
        if len(fields) < 2:
            raise InputError("a rig needs id and number of sensors", path, at)
        out.append(_integer(fields[1], Place(path, line=at), "number of sensors"))
    return out


# ---------------------------------------------------------------------------------------------------------------- network


def _network(
    cameras: list[ModelCamera], images: list[ModelImage], points: ModelPoints, notes: list[str], unfinished: Sequence[Path] = ()
) -> Network:
    cameras, images = sorted(cameras, key=lambda c: c.id), sorted(images, key=lambda i: i.id)
    _different(cameras, "camera")
    _different(images, "image")
    order = np.argsort(points.ids, kind="stable")
    ids = points.ids[order]
    twice = np.flatnonzero(np.diff(ids) == 0)
    if len(twice):
        first, second = points.place(int(order[twice[0]])), points.place(int(order[twice[0] + 1]))
        raise second.error(f"point {ids[twice[0]]} appears twice (first {first})")
    names: dict[str, ModelImage] = {}
    for image in images:
        problem = label_problem(image.name, "image name")
        if problem:
            raise image.place.error(problem)
        if image.name in names:
            raise image.place.error(f"image {image.name!r} appears twice (first {names[image.name].place})")
        names[image.name] = image
    camera_index = {c.id: i for i, c in enumerate(cameras)}
    at, xy, image_of, owner = [], [], [], []
    dropped = 0
    for i, image in enumerate(images):
        if image.camera not in camera_index:
            raise image.place.error(f"image {image.name!r}: unknown camera {image.camera}")
        owner.append(camera_index[image.camera])
        kept = image.point_ids != NO_POINT
        wanted = image.point_ids[kept]
        found = np.searchsorted(ids, wanted)
        wrong = np.flatnonzero(ids[np.minimum(found, len(ids) - 1)] != wanted) if len(ids) else np.arange(len(wanted))
        if len(wrong):
            raise image.place.error(f"image {image.name!r} measures point {wanted[wrong[0]]}, which {points.file.name} does not hold")
        if not len(wanted):
            raise image.place.error(f"image {image.name!r} has no image points with an object point")
        dropped += int((~kept).sum())
        at.append(found)
        xy.append(image.xy[kept])
        image_of.append(np.full(len(found), i))
    observed = ImagePoints.make(np.concatenate(image_of), np.concatenate(at), np.concatenate(xy))
    differ = int((np.bincount(observed.points, minlength=len(ids)) != points.tracks[order]).sum())
    if differ and unfinished:
        file = unfinished[0]
        last = file.read_bytes().count(b"\n") + 1
        raise InputError("the line has no end, and the tracks of points3D and the image points disagree: truncated?", file, last)
    _say(notes, observed, dropped, differ)
    rotation = np.stack([_rotation(i) for i in images])
    position = -np.einsum("nji,nj->ni", rotation, np.stack([i.translation for i in images]))
    return Network(
        tuple(_camera(c) for c in cameras),
        Images.make([i.name for i in images], owner, position, AXES @ rotation),
        Points.make([str(i) for i in ids.tolist()], points.xyz[order]),
        (observed,),
        unit=checks.MODEL_UNITS,
        assumptions=tuple(notes),
    )


def _different(records: Sequence[ModelCamera | ModelImage], what: str) -> None:
    for a, b in pairwise(records):
        if a.id == b.id:
            raise b.place.error(f"{what} {b.id} appears twice (first {a.place})")


def _say(notes: list[str], observed: ImagePoints, dropped: int, differ: int) -> None:
    """Note what the source does not say and what was left out."""
    notes.append("image sigma 1 px, because a COLMAP model has none")
    notes.append(
        "a COLMAP model does not say which camera parameters were estimated: principal points are fixed, principal distances and "
        "distortion are free (COLMAP's own default)"
    )
    if dropped:
        notes.append(f"{dropped} image point(s) without object point left out")
    repeated = len(observed) - len(np.unique(observed.images * (int(observed.points.max()) + 1) + observed.points))
    if repeated:
        notes.append(f"{repeated} image point(s) measure a point that their image measures already; COLMAP permits that, all are kept")
    if differ:
        notes.append(f"the tracks of {differ} object point(s) disagree with the images' lists of points; the images' lists are used")


def _rotation(image: ModelImage) -> Floats:
    """Return R of a quaternion w x y z (Diebel 2006, eq. 125), which may be rounded but not wrong."""
    q = image.quaternion
    norm = math.hypot(*q.tolist())
    if not abs(norm - 1.0) < 1e-3:
        raise image.place.error(f"the quaternion of image {image.name!r} has length {norm:.6g}, not 1")
    w, x, y, z = (q / norm).tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _camera(camera: ModelCamera) -> Camera:
    known = camera_models.models()
    supported = [name for name in CAMERA_MODELS.values() if name in known]
    if camera.model not in supported:
        raise camera.place.error(f"camera {camera.id}: model {camera.model} is not supported; supported are {', '.join(supported)}")
    order = known[camera.model].order
    if len(camera.parameters) != len(order):
        raise camera.place.error(
            f"camera {camera.id}: model {camera.model} has {len(order)} parameters, found are {len(camera.parameters)}"
        )
    values = dict(zip(order, camera.parameters.tolist(), strict=True))
    for name, value in values.items():
        if not abs(value) <= LARGEST_PARAMETER:
            raise camera.place.error(f"camera {camera.id}: {name} = {value!r} is not finite or beyond {LARGEST_PARAMETER:g}")
        if name.startswith("principal_distance") and not value > 0.0:
            raise camera.place.error(f"camera {camera.id}: the principal distance must be positive, not {value!r}")
    if camera.width < 1 or camera.height < 1:
        raise camera.place.error(f"camera {camera.id}: width and height must be positive")
    free = [name for name in order if not name.startswith("principal_point")]
    return camera_models.create(
        str(camera.id), known[camera.model], values, free=free, image_size=(float(camera.width), float(camera.height))
    )


colmap = Format("colmap", "COLMAP model, text or binary, with or without rigs and frames", recognises, read, write, first_pixel=0.5)
