"""What the text files of PATB and BINGO hold alike: image points photo by photo, each photo ended by -99, in axes of the photo with y up.

The image coordinates are refined ones, reduced to the principal point; here they are micrometres, so that a "pixel" of such a network is a
micrometre. Neither program writes standard deviations beside the coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE, Camera
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Line, number, split_lines
from baarda.formats.gcp_marks import intersected
from baarda.network import CHECK, CONTROL, TIE, Images, Network, Points, State
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

END = "-99"
SIGMA = 5.0  # micrometres, usual for measured photographs
LARGEST = 1e9
PIXEL = np.array([1e-3, 1e-3])  # millimetres per "pixel"


@dataclass(frozen=True)
class Photo:
    """A photo: its first line, and the lines of its points."""

    head: Line
    points: tuple[Line, ...]


def lines_of(file: Path, comments: Sequence[str] = ("#", "*")) -> list[Line]:
    """Return the lines of a file that hold something, comments left out.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    return [
        Line(file, i, tuple(t.split()))
        for i, t in enumerate(split_lines(file), start=1)
        if t.strip() and not t.strip().startswith(tuple(comments))
    ]


def head_of(file: Path, size: int = 8192) -> list[list[str]]:
    """Return the fields of the first lines of a file, for telling formats apart; empty where it is not text or cannot be read."""
    try:
        with file.open("rb") as f:
            data = f.read(size)
    except OSError:  # a file that does not concern us
        return []
    if b"\0" in data:
        return []
    lines = data.decode("utf-8-sig", errors="replace").splitlines()
    if len(data) == size and lines:
        lines.pop()  # it may be cut
    return [t.split() for t in lines if t.strip() and not t.strip().startswith(("#", "*"))]


def all_numbers(fields: Sequence[str]) -> bool:
    """Tell whether all fields are finite numbers."""
    try:
        return all(np.isfinite(number(t)) for t in fields)
    except ValueError:
        return False


def photos(file: Path, whole: bool = False) -> list[Photo]:
    """Return the photos of a file of image points.

    Parameters
    ----------
    file : Path
    whole : bool
        Whether the first line of a photo is its name, which may hold blanks.

    Raises
    ------
    InputError
        With file and line, if a photo has no end or appears twice.
    """
    out: dict[str, Photo] = {}
    head: Line | None = None
    points: list[Line] = []
    for line in lines_of(file):
        if line.fields[0] == END:
            if head is not None:
                label = " ".join(head.fields) if whole else head.text_at(0, "photo")
                if label in out:
                    raise head.error(f"photo {label!r} appears twice (first in line {out[label].head.number})")
                out[label] = Photo(head, tuple(points))
            head, points = None, []
        elif head is None:
            head = line
        else:
            points.append(line)
    if head is not None:
        raise head.error(f"photo {head.fields[0]!r} has no end ({END}): truncated?")
    if not out:
        raise InputError("the file has no photos", file)
    return list(out.values())


@dataclass(frozen=True)
class Known:
    """What is known of an object point beforehand: coordinates (NaN = not known), whether it only checks, and where it stands."""

    xyz: Floats
    check: bool
    line: Line


def block(
    images: dict[str, int],
    cameras: tuple[Camera, ...],
    position: Floats,
    candidates: Sequence[Floats],
    measured: Sequence[Photo],
    micrometres: Callable[[Photo], float],
    known: dict[str, Known],
    starts: dict[str, Floats],
    what: Sequence[str],
    notes: list[str],
) -> Network:
    """Return the network of a block.

    Parameters
    ----------
    images : dict
        Camera of each oriented photo by its label.
    cameras : tuple of Camera
    position : (n, 3) array
    candidates : sequence of (n, 3, 3) arrays
        Possible readings of the rotations as M; the one under which the rays of the points meet best is taken.
    measured : sequence of Photo
    micrometres : callable
        Photo to the factor of its image coordinates.
    known : dict
        Control and check points by label.
    starts : dict
        Start values of points by label.
    what : sequence of str
        Name of each candidate for the notes.
    notes : list of str
        Takes what was decided.

    Raises
    ------
    InputError
        With file and line, if an image point cannot be used.
    """
    image_of = {label: i for i, label in enumerate(images)}
    point_of: dict[str, int] = {}
    rows, at, lost = [], [], []
    for photo in measured:
        label = photo.head.fields[0]
        if label not in image_of:
            lost.append(label)
            continue
        factor = micrometres(photo)
        for line in photo.points:
            name = line.text_at(0, "point")
            xy = [factor * line.number_at(i, "image coordinate") for i in (1, 2)]
            if max(map(abs, xy)) > LARGEST:
                raise line.error(f"an image coordinate is beyond {LARGEST:g} um")
            rows.append((image_of[label], point_of.setdefault(name, len(point_of)), *xy))
            at.append(line)
    if lost:
        notes.append(f"{len(lost)} photo(s) without exterior orientation are left out: {', '.join(lost[:10])}")
    if not rows:
        raise InputError("no image point belongs to an oriented photo", measured[0].head.file)
    table = np.array(rows)
    i, p = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    labels = list(point_of)
    checks.measured_once(i, p, labels, lambda row, m: at[row].error(m), lambda row: at[row].number)
    heads = {photo.head.fields[0]: photo.head for photo in measured}
    order = list(images)
    checks.images_with_points(
        i, order, np.ones(len(order), dtype=bool), lambda k, m: heads[order[k]].error(m) if order[k] in heads else InputError(m, at[0].file)
    )
    group = ImagePoints.make(i, p, table[:, 2:], SIGMA)
    points = _points(labels, known, starts, notes)
    networks = []
    for rotation in candidates:
        frame = Images.make(order, np.array(list(images.values())), position, rotation)
        network = Network(cameras, frame, points, (group,))
        networks.append(_started(network, group))
    scores = [_misfit(n, group) for n in networks]
    best = int(np.argmin(scores))
    if len(candidates) > 1:
        notes.append(
            f"{what[best]}: image points then lie {scores[best]:.3g} um (median) from their rays, otherwise {max(scores):.3g} um"
            if scores[best] < 0.5 * max(scores)
            else f"{what[0]}: the image points do not tell"
        )
        best = best if scores[best] < 0.5 * max(scores) else 0
    notes.append(f"image points have the standard deviation {SIGMA:g} um, because the files have none; 'px' stands for micrometres here")
    return replace(networks[best], assumptions=tuple(notes))


def _points(labels: list[str], known: dict[str, Known], starts: dict[str, Floats], notes: list[str]) -> Points:
    n = len(labels)
    index = {label: k for k, label in enumerate(labels)}
    xyz, given = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    roles = np.full(n, TIE, dtype=np.int8)
    states = np.full((n, 3), FREE, dtype=np.int8)
    for label, start in starts.items():
        if label in index:
            xyz[index[label]] = start
    absent = [label for label in known if label not in index]
    for label, k in known.items():
        if label not in index:
            continue
        at = index[label]
        given[at] = k.xyz
        roles[at] = CHECK if k.check else CONTROL
        if not k.check:
            states[at] = np.where(np.isfinite(k.xyz), FIXED, FREE)
            xyz[at] = np.where(np.isfinite(k.xyz), k.xyz, xyz[at])
    if absent:
        notes.append(f"{len(absent)} known point(s) are not measured and left out: {', '.join(absent[:10])}")
    if (roles == CONTROL).any():
        notes.append("control points are held fixed, because the files have no standard deviations; --control gives them")
    sigmas = np.where((roles == CHECK)[:, None] & np.isfinite(given), 0.0, np.nan)
    return Points.make(labels, xyz, roles, states, given, sigmas)


def _started(network: Network, group: ImagePoints) -> Network:
    """Return the network with the intersections of rays where coordinates are missing."""
    xyz = np.array(network.points.coordinates)
    missing = ~np.isfinite(xyz)
    if not missing.any():
        return network
    found = intersected(network, group.points, group.images, group.xy, len(xyz))
    return replace(network, points=replace(network.points, coordinates=np.where(missing, found, xyz)))


def _misfit(network: Network, group: ImagePoints) -> float:
    """Return the median distance of image points from the projections of their points, large where rays do not meet."""
    good = np.asarray(np.isfinite(network.points.coordinates).all(axis=1))[group.points]
    if good.sum() < 0.5 * len(group):
        return 1e30
    part = group.selected(np.flatnonzero(good))
    with np.errstate(all="ignore"):
        found = part.misclosures(network, State.of(network))
    apart = np.hypot(found[:, 0], found[:, 1])
    return float(np.median(np.where(np.isfinite(apart), apart, 1e30)))
