"""Bundler (Snavely 2006): a file ``bundle.out`` and, where it exists, the list of image names ``list.txt`` beside or one folder above it.

After the line ``# Bundle file v0.3``: numbers of cameras and points; per camera f, k1, k2, R (three lines), t; per point X Y Z, colour, and
its views: their number, then camera, key, x, y each. A camera with f = 0 was not oriented. Snavely's camera: see `baarda.cameras.snavely`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from baarda.errors import InputError, UsageError
from baarda.formats.base import Format, label_problem, split_lines
from baarda.formats.folder import write_folder
from baarda.formats.number_text import NumberText, unpacked
from baarda.formats.snavely_model import SnavelyModel
from baarda.network import Network

_MAGIC = b"# Bundle file v0."
_FILE, _LIST = "bundle.out", "list.txt"
_PLACES = (_FILE, f"bundle/{_FILE}")  # within a folder
_MOST = 10**9


def _file_of(path: Path) -> Path:
    if path.is_dir():
        return next((path / p for p in _PLACES if (path / p).is_file()), path / _FILE)
    return path


def recognises(path: Path) -> bool:
    """Tell a Bundler file, or a folder with ``bundle.out``, by its first line."""
    file = _file_of(path)
    if not file.is_file():
        return False
    with file.open("rb") as f:
        return f.read(len(_MAGIC)) == _MAGIC


def read(path: Path) -> Network:
    """Read a Bundler file.

    Parameters
    ----------
    path : Path
        The file, or a folder with ``bundle.out`` (or ``bundle/bundle.out``).

    Returns
    -------
    Network
        Images are labelled by the list, else by their numbers from 0, points by their numbers from 0; a free network in model units.

    Raises
    ------
    InputError
        With file and line if a text cannot be used.
    """
    file = _file_of(path)
    data = unpacked(file)
    head, _, rest = data.partition(b"\n")
    found = re.match(rb"# Bundle file v0\.(\d+)\s*$", head)
    if found is None:
        raise InputError("the first line must be '# Bundle file v0.3'", file, 1)
    if found[1] != b"3":
        raise InputError(f"version 0.{found[1].decode()} of Bundler files is not supported; version 0.3 is", file, 1)
    text = NumberText.of(file, rest, skipped=1)
    text.need(2, "a Bundler file")
    cameras, points = text.whole(np.arange(2), 1, _MOST, "a count").tolist()
    first = 2 + 15 * cameras
    text.need(first + 7 * points, f"a file of {cameras} cameras and {points} points")
    table = text.values[2:first].reshape(-1, 15)
    begin, views = _views(text, first, points)
    rows = np.concatenate([np.arange(b + 7, b + 7 + 4 * n, 4) for b, n in zip(begin.tolist(), views.tolist(), strict=True)])
    rows = rows.astype(np.intp)
    image = text.whole(rows, 0, cameras - 1, "the number of a camera")

    oriented = np.flatnonzero(table[:, 0] != 0.0)
    position = np.full(cameras, -1)
    position[oriented] = np.arange(len(oriented))
    lost = np.flatnonzero(position[image] < 0)
    if len(lost):
        at = int(rows[lost[0]])
        raise text.error(f"camera {image[lost[0]]} measures this point but has principal distance 0 (not oriented)", at)
    if not len(oriented):
        raise text.error("no camera is oriented (all principal distances are 0)", 2)
    labels, notes = _labels(file, cameras)
    if len(oriented) < cameras:
        notes.append(f"{cameras - len(oriented)} of {cameras} camera(s) without orientation (principal distance 0) left out")
    use = table[oriented]
    model = SnavelyModel(
        use[:, :3],
        use[:, 3:12].reshape(-1, 3, 3),
        use[:, 12:],
        text.values[begin[:, None] + np.arange(3)],
        position[image],
        np.repeat(np.arange(points), views),
        text.values[rows[:, None] + np.array([2, 3])],
        [labels[i] for i in oriented],
        [str(i) for i in range(points)],
    )
    return model.network("Bundler file", lambda i, message: text.error(message, 2 + 15 * int(oriented[i])), notes)


def _views(text: NumberText, at: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where each point begins and its number of views."""
    begin, views = np.empty(points, dtype=np.intp), np.empty(points, dtype=np.intp)
    total = len(text.values)
    for p in range(points):
        text.need(at + 7, f"point {p}")
        count = text.values[at + 6]
        if not (count >= 0 and count == int(count)):
            raise text.error(f"the number of views of point {p} must be a whole number, not {count:.17g}", at + 6)
        begin[p], views[p] = at, int(count) if count <= total else total
        at += 7 + 4 * int(views[p])
        if at > total:
            raise text.error(f"point {p} announces {count:.17g} views, the text ends before them: truncated?", int(begin[p]) + 6)
    if at != total:
        raise text.error(f"the text goes on after the {points} points that the header announces", at)
    return begin, views


def _labels(file: Path, cameras: int) -> tuple[list[str], list[str]]:
    """Return the image names and a note where there is no list."""
    places = [folder / _LIST for folder in (file.parent, file.parent.parent)]
    found = next((p for p in places if p.is_file()), None)
    if found is None:
        return [str(i) for i in range(cameras)], [f"no {_LIST} with image names: images are named by their numbers, from 0"]
    names: dict[str, int] = {}
    for i, line in enumerate(split_lines(found), start=1):
        if not line.strip():
            continue
        name = re.sub(r"(\s+\d+\s+[\d.eE+-]+)?\s*$", "", line.strip())  # a flag and the focal length of the image's header
        problem = label_problem(name, "image name")
        if problem or name in names:
            raise InputError(problem or f"image {name!r} appears twice (first in line {names[name]})", found, i)
        names[name] = i
    if len(names) != cameras:
        raise InputError(f"the list names {len(names)} images, {file.name} holds {cameras} cameras", found)
    return list(names), []


def write(network: Network, path: Path) -> None:
    """Write a folder with ``bundle.out`` and ``list.txt``; numbers read back exactly.

    Parameters
    ----------
    network : Network
        See `baarda.formats.snavely_model.SnavelyModel.of`.
    path : Path
        The folder; it must not exist yet, or be empty.

    Raises
    ------
    UsageError
        If the network holds what a Bundler file cannot.
    OutputError
        If the folder cannot be written; nothing is left behind.
    """
    m = SnavelyModel.of(network, "Bundler file")
    for label in m.labels:
        if not label or len(label.split()) != 1 or label != label.strip():
            raise UsageError(f"image {label!r}: a list of images cannot hold this name (white space)")
    lines = ["# Bundle file v0.3", f"{len(m.labels)} {len(m.points)}"]
    for p, r, t in zip(m.parameters.tolist(), m.rotation.tolist(), m.translation.tolist(), strict=True):
        lines += [" ".join(repr(v) for v in row) for row in (p, *r, t)]
    order = np.lexsort((m.images_of, m.points_of))
    begin = np.searchsorted(m.points_of[order], np.arange(len(m.points) + 1))
    key = np.zeros(len(m.labels), dtype=int)  # the running number of an image point within its image
    for i, xyz in enumerate(m.points.tolist()):
        lines += [" ".join(repr(v) for v in xyz), "0 0 0"]
        views = []
        for row in order[begin[i] : begin[i + 1]].tolist():
            image = int(m.images_of[row])
            x, y = m.xy[row].tolist()
            views.append(f"{image} {key[image]} {x!r} {y!r}")
            key[image] += 1
        lines.append(" ".join([str(len(views)), *views]))
    write_folder(path, {_FILE: "\n".join(lines) + "\n", _LIST: "\n".join(m.labels) + "\n"})


bundler = Format("bundler", "Bundler file bundle.out with list.txt (Snavely)", recognises, read, write)
