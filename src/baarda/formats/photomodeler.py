"""PhotoModeler's text export: photographs, object points and marks of one project.

Pixels count from the top left corner, y down; angles are kappa, phi, omega in degrees; coefficients act in the correct direction. The
export lists control points after adjustment, not as given: their given coordinates come from a control table, and until then the
coordinates are in a datum of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from baarda import cameras
from baarda.errors import InputError
from baarda.formats.base import Format, Line, split_lines
from baarda.formats.checks import MODEL_UNITS, sigma_range
from baarda.geometry import rotation as rot
from baarda.network import Images, Network, Points
from baarda.observations import ImagePoints

PARAMETERS = ("principal_distance", "principal_point_x", "principal_point_y", "K1", "K2", "K3", "P1", "P2")


def recognises(path: Path) -> bool:
    """Tell an export by the counts of numbers in its second to fifth line."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        lines = f.read(4000).decode("utf-8", errors="replace").splitlines()[1:5]
    try:
        counts = [len([float(t) for t in line.split()]) for line in lines]
    except ValueError:
        return False
    return len(counts) == 4 and counts[0] in (2, 4) and counts[1] == 9 and counts[2:] == [10, 10]


def read(path: Path) -> Network:
    """Read a PhotoModeler text export.

    Raises
    ------
    InputError
        With file and line where the file cannot be used.
    """
    texts = split_lines(path)
    if texts[-1] and not texts[-1].strip():  # the indent of a line that was cut, not a blank line
        texts.pop()
    lines = [Line(path, i, tuple(t.split())) for i, t in enumerate(texts, start=1)]
    if len(lines) < 6:
        raise InputError("the file ends before the first photograph", path, len(lines))
    if len(lines[1].fields) < 4:
        raise lines[1].error("the image size in pixels is missing (fields 3 and 4)")
    size = (lines[1].number_at(2, "image width"), lines[1].number_at(3, "image height"))
    if not all(1e-3 < side < 1e9 for side in size):
        raise lines[1].error(f"the image size in pixels must be positive and that of an image, not {size[0]:g} x {size[1]:g}")
    default = [lines[3].number_at(i, "camera value") for i in range(10)]
    if default[0] <= 0:
        raise lines[3].error(f"the principal distance must be positive, not {default[0]!r}")
    if not all(1e-6 < side < 1e6 for side in default[3:5]):  # mm
        raise lines[3].error(f"the format size must be positive and that of a sensor, not {default[3]!r} x {default[4]!r}")
    cursor = iter(lines[5:])
    labels, names, exterior = _photographs(cursor)
    _section(cursor, 7)  # control points as adjusted: not what was given
    objects = _section(cursor, 7)
    marks = _section(cursor, 6, ends=True)
    if not marks:
        raise InputError("the export has no marked points", path)
    points: dict[str, int] = {}
    xyz = []
    for line in objects:
        label = line.text_at(0, "point id")
        if label in points:
            raise line.error(f"object point {label!r} appears twice")
        points[label] = len(points)
        xyz.append([line.number_at(i, "coordinate") for i in (1, 2, 3)])
    default_sigma = lines[2].number_at(0, "default standard deviation of marks")
    place = {label: i for i, label in enumerate(labels)}
    rows, without, defaulted = [], 0, 0
    first: dict[tuple[str, str], Line] = {}
    for line in marks:
        image, point = line.text_at(0, "photo id"), line.text_at(1, "point id")
        if image not in place:
            raise line.error(f"photo {image!r} is not in the list of photographs")
        if (image, point) in first:
            raise line.error(f"point {point!r} is measured twice in photo {image!r} (first in line {first[image, point].number})")
        first[image, point] = line
        x, y, *sigmas = (line.number_at(i, "mark") for i in (2, 3, 4, 5))
        if min(sigmas) < 0 or (min(sigmas) == 0 and default_sigma <= 0):
            raise line.error("a standard deviation of a mark must be positive")
        sigma_range([s or default_sigma for s in sigmas], "a standard deviation of a mark", line.complain)
        if point not in points:
            without += 1
            continue
        defaulted += min(sigmas) == 0
        rows.append((place[image], points[point], x, y, *(s or default_sigma for s in sigmas)))
    if not rows:
        raise InputError("no marked point belongs to an object point", path)
    table = np.array(rows)
    values = np.array(exterior)
    pixel = default[4] / size[1]  # square pixels of the sensor's height; what the width differs by is affinity
    affinity = default[3] / size[0] / pixel - 1.0
    camera = cameras.create(
        "1",
        cameras.model("brown"),
        dict(zip((*PARAMETERS, "B1"), [default[0], default[1] / (1.0 + affinity), default[2], *default[5:], affinity], strict=True)),
        unit="mm",
        pixel_size=np.array([pixel, pixel]),
        image_size=size,
    )
    rotation = rot.from_angles(*np.radians(values[:, [5, 4, 3]]).T)
    notes = [
        "the export does not say which camera parameters are to be estimated: all are fixed unless --camera names them",
        "control points are listed there as adjusted, not as given: they are tie points unless a control table is given",
        "residuals are formed in the corrected image plane (residual_plane = corrected)",
        "images are labelled by their photo id; files: " + ", ".join(Path(n.replace("\\", "/")).name for n in names[:3]) + ", ...",
    ]
    if without:
        notes.append(f"{without} mark(s) of points that are not among the object points were left out")
    if defaulted:
        notes.append(f"{defaulted} mark(s) without a standard deviation take the default of the export, {default_sigma:g} px")
    return Network(
        (camera,),
        Images.make(labels, position=values[:, :3], rotation=rotation),
        Points.make(list(points), np.array(xyz)),
        (ImagePoints.make(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:4], table[:, 4:6], residual_plane="corrected"),),
        unit=MODEL_UNITS,
        name=" ".join(lines[0].fields),
        settings={"datum": "control", "min_rays": 0},
        assumptions=tuple(notes),
    )


def _photographs(cursor: Iterator[Line]) -> tuple[list[str], list[str], list[list[float]]]:
    """Read blocks of six lines until a blank line."""
    heads: dict[str, Line] = {}
    names: list[str] = []
    exterior: list[list[float]] = []
    for head in cursor:
        if not head.fields:
            return list(heads), names, exterior
        try:
            pose, _sigma, _blank, _camera, _camera_sigma = (next(cursor) for _ in range(5))
        except RuntimeError:
            raise head.error("the block of this photograph is cut off") from None
        label = head.text_at(0, "photo id")
        if label in heads:
            raise head.error(f"photo {label!r} appears twice (first in line {heads[label].number})")
        heads[label] = head
        names.append(" ".join(head.fields[1:]))
        exterior.append([pose.number_at(i, "exterior orientation") for i in range(1, 7)])
    return list(heads), names, exterior


def _section(cursor: Iterator[Line], width: int, ends: bool = False) -> list[Line]:
    """Read the lines up to the next blank one, which must be there if `ends`; each has `width` fields."""
    out = []
    for line in cursor:
        if not line.fields:
            break
        if len(line.fields) != width:
            raise line.error(f"{len(line.fields)} fields where {width} are expected")
        out.append(line)
    else:
        if ends and out:
            raise out[-1].error("the blank line that ends this section is missing: truncated?")
    return out


photomodeler = Format("photomodeler", "PhotoModeler text export", recognises, read)
