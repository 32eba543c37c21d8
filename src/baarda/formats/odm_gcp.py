"""Ground control lists of OpenDroneMap and OpenSfM, ``gcp_list.txt``: coordinates and image marks in one table.

The first line names the system of the coordinates: ``WGS84`` (longitude, latitude, height), ``WGS84 UTM 32N``, ``EPSG:32632``, a proj
string, or ``LOCAL``: metres of the network's own system, which only this reader knows. Every further line is a mark:
x y z, pixel x, pixel y, image, and in OpenDroneMap's lists the name of the point. Pixels count from the centre of the first one.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Line, first_pixel, split_lines
from baarda.formats.gcp_marks import Marks, put_on_control, some, with_marks
from baarda.formats.geographic import latitude_longitude
from baarda.geometry.tangent_frame import TangentFrame
from baarda.network import Network

Floats = NDArray[np.float64]

#: standard deviations that OpenSfM gives to control points, metres in plan and height
SIGMAS = np.array([0.01, 0.01, 0.1])
LOCAL = "LOCAL"
_SYSTEM = re.compile(r"(WGS84|LOCAL|WGS84\s+UTM\s+\d{1,2}\s*[NS]|EPSG:\d{4,6}|\+proj=[\x20-\x7e]+)", re.IGNORECASE)


@dataclass(frozen=True)
class GcpList:
    """The content of a list.

    Attributes
    ----------
    file : Path
    system : str
    labels : tuple of str
    coordinates : (n, 3) array
        As they stand in the list, NaN = height not known.
    first : tuple of Line
        First line of each point.
    points : (k,) int array
    images : tuple of str
    xy : (k, 2) array
    lines : tuple of Line
        Of the marks.
    """

    file: Path
    system: str
    labels: tuple[str, ...]
    coordinates: Floats
    first: tuple[Line, ...]
    points: NDArray[np.intp]
    images: tuple[str, ...]
    xy: Floats
    lines: tuple[Line, ...]

    def marks(self, network: Network, frame: TangentFrame | None, notes: list[str]) -> Marks:
        """Return the control points in the system of a network, with the marks that lie in its images.

        Raises
        ------
        InputError
            With file and line, if the images count pixels in another way or nothing fits.
        MissingExtra
            If the coordinates are in a projection and pyproj is not there.
        """
        index = image_finder(network)
        found = np.array([index(name) for name in self.images], dtype=np.intp)
        if (found < 0).all():
            raise self.lines[0].error(
                f"no image of the list is in the network, whose images are called {some(list(network.images.labels))}"
            )
        if (found < 0).any():
            lost = sorted({self.images[i] for i in np.flatnonzero(found < 0)})
            notes.append(f"marks of {self.file.name} in {len(lost)} image(s) that are not in the network are left out: {some(lost)}")
        keep = np.flatnonzero(found >= 0)
        for i in np.unique(network.images.cameras[found[keep]]):
            camera = network.cameras[i]
            if not camera.y_down or (np.asarray(camera.origin) != 0.0).any():
                raise self.lines[0].error(
                    f"camera {camera.label} does not count pixels from the upper left corner: the marks cannot be used"
                )
        xy = self.xy[keep]
        if first_pixel(network):
            xy = xy + 0.5
            notes.append(f"0.5 px was added to the marks of {self.file.name}: the network counts pixels from the corner of the first one")
        points = self.points[keep]
        checks.measured_once(
            found[keep], points, self.labels, lambda row, m: self.lines[keep[row]].error(m), lambda r: self.lines[keep[r]].number
        )
        return Marks(self.file, self.labels, self._given(frame, notes), points, found[keep], xy)

    def _given(self, frame: TangentFrame | None, notes: list[str]) -> Floats:
        """Return the coordinates in the system of the network: as they stand, or in the tangent frame."""
        if self.system.upper() == LOCAL:
            return self.coordinates
        try:
            lla = latitude_longitude(self.coordinates, self.system, self.file)
        except InputError as error:
            raise InputError(str(error).removeprefix(f"{self.file}: "), self.file, 1) from None
        if frame is None:
            middle = np.nanmean(lla, axis=0)
            frame = TangentFrame(float(middle[0]), float(middle[1]), 0.0)
            notes.append(
                f"coordinates of {self.file.name} were carried over to the frame (east, north, up) that touches the ellipsoid at latitude "
                f"{frame.latitude!r}, longitude {frame.longitude!r}, height 0"
            )
        out = frame.local(np.where(np.isnan(lla), frame.height, lla))
        out[np.isnan(lla[:, 2]), 2] = np.nan
        return np.asarray(out)


def is_gcp_list(path: Path) -> bool:
    """Tell a list by its first line and six fields in the second."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        lines = f.read(8192).decode("utf-8-sig", errors="replace").splitlines()
    rest = [line for line in lines[1:] if line.strip()]
    return bool(rest) and _SYSTEM.fullmatch(lines[0].strip()) is not None and len(rest[0].split()) >= 6


def read_gcp_list(path: Path) -> GcpList:
    """Read a list of marks.

    Raises
    ------
    InputError
        With file and line, if it cannot be used.
    """
    texts = split_lines(path)
    if not texts or _SYSTEM.fullmatch(texts[0].strip()) is None:
        raise InputError("the first line must name the system: WGS84, WGS84 UTM 32N, EPSG:32632, +proj=... or LOCAL", path, 1)
    lines = [Line(path, i, tuple(t.split())) for i, t in enumerate(texts[1:], start=2) if t.strip() and not t.strip().startswith("#")]
    if not lines:
        raise InputError("the list has no marks", path, 1)
    index: dict[str, int] = {}
    coordinates: list[list[float]] = []
    first: list[Line] = []
    points, xy = [], []
    for line in lines:
        values = [line.number_at(0, "x"), line.number_at(1, "y"), _height(line)]
        pixel = [line.number_at(3, "pixel x"), line.number_at(4, "pixel y")]
        if max(map(abs, (*values[:2], *pixel))) > 1e9 or abs(values[2]) > 1e9:
            raise line.error("a coordinate is beyond 1e9")
        line.text_at(5, "image")
        label = line.text_at(6, "point") if len(line.fields) > 6 else ""
        key = label or " ".join(line.fields[:3])  # OpenSfM: one point where the coordinates are the same
        if key not in index:
            index[key] = len(index)
            coordinates.append(values)
            first.append(line)
        elif not np.array_equal(coordinates[index[key]], values, equal_nan=True):
            raise line.error(f"point {key!r} has other coordinates than in line {first[index[key]].number}")
        points.append(index[key])
        xy.append(pixel)
    named = [bool(len(line.fields) > 6) for line in first]
    labels = tuple(key if name else f"gcp {i + 1}" for i, (key, name) in enumerate(zip(index, named, strict=True)))
    images = tuple(line.fields[5] for line in lines)
    return GcpList(
        path,
        " ".join(texts[0].split()),
        labels,
        np.array(coordinates),
        tuple(first),
        np.array(points, dtype=np.intp),
        images,
        np.array(xy),
        tuple(lines),
    )


def _height(line: Line) -> float:
    if line.text_at(2, "z").lower() == "nan":  # documented: height not known
        return float("nan")
    return line.number_at(2, "z")


def image_finder(network: Network) -> Callable[[str], int]:
    """Return the function from a name in the list to an image, -1 for none: by label, else by the file name where only one fits."""
    exact = {label: i for i, label in enumerate(network.images.labels)}
    loose: dict[str, int] = {}
    for i, label in enumerate(network.images.labels):
        key = PurePosixPath(label.replace("\\", "/")).name.lower()
        loose[key] = -1 if key in loose else i

    def index(name: str) -> int:
        return exact.get(name, loose.get(PurePosixPath(name.replace("\\", "/")).name.lower(), -1))

    return index


def with_gcp_list(network: Network, path: Path) -> Network:
    """Return the network with the control points of a list and their marks; see `baarda.formats.gcp_marks.with_marks`.

    Parameters
    ----------
    network : Network
        A network in model units is carried over to the system of the list by a similarity transformation, which needs three points with
        two rays.
    path : Path

    Returns
    -------
    Network

    Raises
    ------
    InputError
        With file and line, if the list cannot be used.
    MissingExtra
        If its coordinates are in a projection and pyproj is not there.
    """
    found = read_gcp_list(path)
    notes = [f"control points of {path.name} have the standard deviations 0.01 m in plan and 0.1 m in height, as OpenSfM takes them"]
    reference = network.settings.get("reference_lla")
    frame = None if reference is None else TangentFrame(*(float(v) for v in reference))
    marks = found.marks(network, frame, notes)
    marks = replace(marks, given=marks.given + network.offset)
    if network.unit != checks.MODEL_UNITS:
        network = with_marks(network, marks, SIGMAS, notes)
        row = {label: i for i, label in enumerate(found.labels)}

        def error(point: int, message: str) -> InputError:
            label = network.points.labels[point].removeprefix("GCP ")
            return found.first[row.get(label, 0)].error(message)

        checks.control_unit(network.points, network.unit, error, network.images.position)
        return replace(network, assumptions=(*network.assumptions, *notes))
    network = put_on_control(with_marks(network, marks, SIGMAS, notes, move=False), path, notes)
    return replace(network, assumptions=(*network.assumptions, *notes))
