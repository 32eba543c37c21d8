"""AICON 3D Studio: image points ``.phc``, object points ``.obc``, interior ``.ior`` and exterior orientation ``.eor``, scale bars.

Image coordinates are millimetres from the centre of the sensor, y up; here they are pixels from its lower left corner. Angles are omega,
phi, kappa in radians (rotation order 0), the camera looks along -z. The principal distance is written as a negative number; the model is
`baarda.cameras.aicon`. The numbers of an ``.ior`` stand in five lines per camera: number, internal, c, x0, y0, A1, A2, R0; A3; B1, B2;
C1, C2; width and height in millimetres, width and height in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from baarda import cameras as camera_models
from baarda.cameras import FREE, OBSERVED, Camera
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, Line, number, read_lines
from baarda.geometry import rotation as rot
from baarda.network import CONTROL, TIE, Images, Network, Points
from baarda.observations import Distances, ImagePoints

KINDS = ("phc", "obc", "ior", "eor")
_NO_BALANCE = 1e-6  # mm: stands for R0 = 0, where the radial distortion is not balanced
_INTERIOR = ("principal_distance", "principal_point_x", "principal_point_y")
_ALWAYS = (*_INTERIOR, "A1", "A2")


def _files(path: Path) -> dict[str, Path] | None:
    """Return the files of a project: those of a folder that has one of each kind, or those beside one of them that share its name."""
    if path.is_file():
        if path.suffix[1:].lower() not in (*KINDS, "scale"):
            return None
        found = {p.suffix[1:].lower(): p for p in sorted(path.parent.iterdir()) if p.stem == path.stem and p.is_file()}
    else:
        found = {}
        for p in sorted(path.iterdir()) if path.is_dir() else ():
            kind = p.suffix[1:].lower()
            if kind in (*KINDS, "scale") and p.is_file():
                if kind in found:
                    return None
                found[kind] = p
    return found if all(k in found for k in KINDS) else None


def recognises(path: Path) -> bool:
    """Tell a project by its four files and eleven numbers in the first line of image coordinates."""
    files = _files(path)
    if files is None:
        return False
    with files["phc"].open("rb") as f:
        lines = [t for t in f.read(4000).decode("utf-8", errors="replace").splitlines() if t.strip() and not t.strip().startswith("#")]
    fields = lines[0].split() if lines else []
    try:
        return len(fields) >= 11 and all(np.isfinite(number(t)) for t in fields[2:8])
    except ValueError:
        return False


def read(path: Path) -> Network:
    """Read an AICON project.

    Parameters
    ----------
    path : Path
        A folder with one file of each kind, or one of the files.

    Returns
    -------
    Network
        In millimetres. Images and points bear their numbers; points that AICON holds (parameter NEW = 0) are control points with the
        standard deviations of the ``.obc``, scale bars are distances.

    Raises
    ------
    InputError
        With file and line, if a file cannot be used.
    """
    files = _files(path)
    if files is None:
        raise InputError(f"not an AICON project: it needs one file of each of .{', .'.join(KINDS)}", path)
    notes: list[str] = []
    cameras = _interior(files["ior"])
    images, heads = _exterior(files["eor"], {c.label: i for i, c in enumerate(cameras)}, notes)
    points = _objects(files["obc"], notes)
    group = _marks(files["phc"], images, points, cameras, notes)
    checks.images_with_points(group.images, images.labels, np.ones(len(images.labels), dtype=bool), lambda i, m: heads[i].error(m))
    bars = _scale_bars(files["scale"], points, notes) if "scale" in files else None
    free = [p for c in cameras for p, s in zip(c.model.order, c.states, strict=True) if s == FREE]
    notes.append(
        "the project does not say which camera parameters were estimated: free are "
        + ", ".join(dict.fromkeys(free))
        + "; --camera chooses others"
    )
    notes.append("the unit of the object coordinates is taken as mm, AICON's usual one")
    return Network(
        tuple(cameras),
        images,
        points,
        (group,) if bars is None else (group, bars),
        unit="mm",
        assumptions=tuple(notes),
    )


@dataclass(frozen=True)
class _Record:
    lines: list[Line]

    def value(self, row: int, column: int, what: str) -> float:
        return self.lines[row].number_at(column, what)


def _interior(file: Path) -> list[Camera]:
    lines = list(read_lines(file, None))
    if len(lines) % 5 or not lines:
        raise InputError(f"an interior orientation has five lines per camera; the file has {len(lines)}: truncated?", file, len(lines) or 1)
    out: dict[str, Camera] = {}
    for start in range(0, len(lines), 5):
        record = _Record(lines[start : start + 5])
        head = record.lines[0]
        label = head.text_at(0, "camera number")
        if label in out:
            raise head.error(f"camera {label} appears twice")
        c = -record.value(0, 2, "principal distance")
        r0 = record.value(0, 7, "R0")
        values = dict(zip(
            (*_INTERIOR, "A1", "A2", "A3", "B1", "B2", "C1", "C2"),
            [c, *(record.value(0, k, n) for k, n in ((3, "x0"), (4, "y0"), (5, "A1"), (6, "A2"))), record.value(1, 0, "A3"),
             *(record.value(2, k, f"B{k + 1}") for k in (0, 1)), *(record.value(3, k, f"C{k + 1}") for k in (0, 1))], strict=True,
        ))  # fmt: skip
        size = np.array([record.value(4, k, "sensor size") for k in (0, 1)])
        pixels = np.array([record.lines[4].integer_at(k, "number of pixels") for k in (2, 3)], dtype=float)
        if not 1e-3 < c < 1e6:
            raise head.error(f"the principal distance must be negative, in mm, not {-c!r}")
        if not 0.0 <= r0 < 1e6:
            raise head.error(f"R0 must be a radius in mm, not {r0!r}")
        if not ((size > 1e-3) & (size < 1e6) & (pixels >= 1) & (pixels <= 1e6)).all():
            raise record.lines[4].error("the sensor must have a positive size in mm and in pixels")
        for name, power in zip(("A1", "A2", "A3", "B1", "B2", "C1", "C2"), (2, 4, 6, 1, 1, 0, 0), strict=True):
            if not abs(float(values[name])) * float(max(*size, r0)) ** power < 1e3:
                raise head.error(f"{name} = {values[name]!r} is beyond all lenses")
        free = [n for n, v in values.items() if n in _ALWAYS or v != 0.0]
        out[label] = camera_models.create(
            label,
            camera_models.model("aicon"),
            values,
            free=free,
            unit="mm",
            pixel_size=size / pixels,
            origin=0.5 * pixels,
            y_down=False,
            image_size=(float(pixels[0]), float(pixels[1])),
            grid=r0 if r0 > 0.0 else _NO_BALANCE,
        )
    return list(out.values())


def _exterior(file: Path, cameras: dict[str, int], notes: list[str]) -> tuple[Images, list[Line]]:
    labels: dict[str, Line] = {}
    owner, values = [], []
    left = 0
    for line in read_lines(file, None):
        label = line.text_at(0, "image number")
        camera = line.text_at(1, "camera number")
        numbers = [line.number_at(i, "exterior orientation") for i in range(2, 8)]
        order, active, status = (line.integer_at(i, w) for i, w in ((8, "rotation order"), (9, "status"), (10, "status of orientation")))
        if label in labels:
            raise line.error(f"image {label} appears twice (first in line {labels[label].number})")
        if active == 0 or status == 1:
            left += 1
            continue
        if order != 0:
            raise line.error(f"rotation order {order} is not supported; 0 (omega, phi, kappa) is")
        if camera not in cameras:
            raise line.error(f"camera {camera} is not among the interior orientations")
        if max(map(abs, numbers[:3])) > 1e9 or max(map(abs, numbers[3:])) > 100.0:
            raise line.error("a coordinate is beyond 1e9, or an angle is not in radians")
        labels[label] = line
        owner.append(cameras[camera])
        values.append(numbers)
    if not labels:
        raise InputError("no image is active and oriented", file)
    if left:
        notes.append(f"{left} image(s) that are not active or not oriented are left out")
    table = np.array(values)
    images = Images.make(list(labels), np.array(owner), table[:, :3], rot.from_angles(*table[:, 3:].T))
    return images, list(labels.values())


def _objects(file: Path, notes: list[str]) -> Points:
    labels: dict[str, Line] = {}
    xyz, sigmas, held = [], [], []
    left = datum = 0
    for line in read_lines(file, None):
        label = line.text_at(0, "point number")
        numbers = [line.number_at(i, "object coordinate") for i in (1, 2, 3)]
        whole = len(line.fields) >= 11
        if label in labels:
            raise line.error(f"point {label} appears twice (first in line {labels[label].number})")
        if max(map(abs, numbers)) > 1e9:
            raise line.error("a coordinate is beyond 1e9")
        sigma = [line.number_at(i, "standard deviation") for i in (4, 5, 6)] if whole else [0.0] * 3
        if min(sigma) < 0.0:
            raise line.error("a standard deviation is negative")
        checks.sigma_range(sigma, "the standard deviation of a point", line.complain)
        if whole and line.integer_at(8, "status") == 0:
            left += 1  # its marks may be active: they then belong to no point
        datum += whole and line.integer_at(10, "datum point") != 0
        labels[label] = line
        xyz.append(numbers)
        sigmas.append(sigma)
        held.append(whole and line.integer_at(9, "parameter NEW") == 0)
    if not labels:
        raise InputError("the file has no points", file)
    if left:
        notes.append(f"{left} point(s) that AICON set inactive take part as far as their marks are active")
    if datum:
        notes.append(f"AICON took its datum from {datum} marked point(s); here --datum chooses it")
    coordinates, s, known = np.array(xyz), np.array(sigmas), np.array(held, dtype=bool)
    if not known.any():
        return Points.make(list(labels), coordinates)
    exact = known[:, None] & (s == 0.0)
    states = np.where(known[:, None], np.where(exact, 0, OBSERVED), FREE).astype(np.int8)
    return Points.make(
        list(labels),
        coordinates,
        np.where(known, CONTROL, TIE),
        states,
        np.where(known[:, None], coordinates, np.nan),
        np.where(known[:, None] & ~exact, s, np.nan),
    )


def _marks(file: Path, images: Images, points: Points, cameras: list[Camera], notes: list[str]) -> ImagePoints:
    image_of = {label: i for i, label in enumerate(images.labels)}
    point_of = {label: i for i, label in enumerate(points.labels)}
    rows, at = [], []
    inactive = lost = 0
    for line in read_lines(file, None):
        image, point = line.text_at(0, "image number"), line.text_at(1, "point number")
        x, y, sx, sy = (line.number_at(i, "image coordinate") for i in (2, 3, 4, 5))
        if line.integer_at(9, "status") == 0:
            inactive += 1
            continue
        if image not in image_of or point not in point_of:
            lost += 1
            continue
        if not (sx > 0.0 and sy > 0.0):
            raise line.error("a standard deviation of an image coordinate must be positive")
        checks.sigma_range([sx, sy], "a standard deviation of an image coordinate", line.complain)
        if max(abs(x), abs(y)) > 1e6:
            raise line.error("an image coordinate is beyond 1e6 mm")
        rows.append((image_of[image], point_of[point], x, y, sx, sy))
        at.append(line)
    if not rows:
        raise InputError("no active image point belongs to an image and a point of the project", file)
    table = np.array(rows)
    i, p = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    checks.measured_once(i, p, points.labels, lambda row, m: at[row].error(m), lambda row: at[row].number)
    if inactive:
        notes.append(f"{inactive} image point(s) that AICON set inactive are left out of {inactive + lost + len(rows)}")
    if lost:
        notes.append(f"{lost} image point(s) belong to no image or point of the project and are left out")
    size = np.array([c.pixel_size for c in cameras])[images.cameras[i]]
    origin = np.array([c.origin for c in cameras])[images.cameras[i]]
    return ImagePoints.make(i, p, table[:, 2:4] / size + origin, table[:, 4:6] / size)


def _scale_bars(file: Path, points: Points, notes: list[str]) -> Distances | None:
    point_of = {label: i for i, label in enumerate(points.labels)}
    rows, at = [], []
    left = 0
    for raw in read_lines(file, None):
        quotes = [k for k, f in enumerate(raw.fields) if '"' in f]  # the name may hold blanks
        line = Line(raw.file, raw.number, raw.fields[quotes[-1] + 1 if quotes else 0 :])
        start, end = line.text_at(0, "point number"), line.text_at(1, "point number")
        value, sigma = line.number_at(2, "length"), line.number_at(3, "standard deviation")
        if line.integer_at(4, "status") == 0 or start not in point_of or end not in point_of:
            left += 1
            continue
        if start == end or not 0.0 < value < 1e9:
            raise line.error("a scale bar needs two points and a positive length")
        if not sigma > 0.0:
            raise line.error("the standard deviation of a scale bar must be positive")
        checks.sigma_range([sigma], "the standard deviation of a scale bar", line.complain)
        rows.append((point_of[start], point_of[end], value, sigma))
        at.append(line)
    if left:
        notes.append(f"{left} scale bar(s) that are not active, or whose points are not there, are left out")
    if not rows:
        return None
    table = np.array(rows)
    bars = Distances(table[:, 0].astype(np.intp), table[:, 1].astype(np.intp), table[:, 2], table[:, 3], unit="mm", name="scale bars")
    checks.distance_unit(bars, points, "mm", lambda row, m: at[row].error(m))
    return bars


aicon = Format("aicon", "AICON 3D Studio (.phc, .obc, .ior, .eor, .scale)", recognises, read)
