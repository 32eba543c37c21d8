"""BAL, "Bundle Adjustment in the Large" (Agarwal et al., ECCV 2010): one text, plain or packed by bzip2 or gzip.

``cameras points observations``; then per observation ``camera point x y``; then nine numbers per camera (rotation vector, t, f, k1, k2)
and three per point. Every camera is one image. Snavely's camera: see `baarda.cameras.snavely`.
"""

from __future__ import annotations

import bz2
import gzip
import re
from pathlib import Path

import numpy as np

from baarda.formats.base import Format
from baarda.formats.number_text import NumberText, beginning, unpacked
from baarda.formats.snavely_model import SnavelyModel
from baarda.formats.whole_file import write_file
from baarda.geometry import rotation as rot
from baarda.network import Network

_FLOAT = rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_BEGINS = re.compile(
    rb"\s*(\d{1,9})[ \t]+(\d{1,9})[ \t]+(\d{1,10})[ \t]*\r?\n\s*(\d{1,9})\s+(\d{1,9})\s+" + _FLOAT + rb"\s+" + _FLOAT + rb"\s"
)
_MOST = 10**10  # of a count in the header; the text must hold that many numbers


def recognises(path: Path) -> bool:
    """Tell a BAL problem by its first two lines: three counts, then camera and point within them and two numbers."""
    if not path.is_file():
        return False
    found = _BEGINS.match(beginning(path))
    if found is None:
        return False
    cameras, points, observations, camera, point = (int(found[i]) for i in range(1, 6))
    return camera < cameras and point < points and observations > 0


def read(path: Path) -> Network:
    """Read a BAL problem.

    Parameters
    ----------
    path : Path
        ``.txt``, ``.bz2`` or ``.gz``, judged by content.

    Returns
    -------
    Network
        Images, cameras and points are labelled by their numbers, from 0; a free network in model units.

    Raises
    ------
    InputError
        With file and line if the text cannot be used.
    """
    text = NumberText.of(path, unpacked(path))
    text.need(3, "a BAL problem")
    cameras, points, observations = text.whole(np.arange(3), 1, _MOST, "a count of the header").tolist()
    first = 3 + 4 * observations
    total = first + 9 * cameras + 3 * points
    text.need(total, f"a problem of {cameras} cameras, {points} points and {observations} observations")
    if len(text.values) > total:
        raise text.error(f"the text goes on after the {total} numbers that the header announces", total)
    rows = 3 + 4 * np.arange(observations)
    image = text.whole(rows, 0, cameras - 1, "the number of a camera")
    point = text.whole(rows + 1, 0, points - 1, "the number of a point")
    table = text.values[first : first + 9 * cameras].reshape(-1, 9)
    model = SnavelyModel(
        table[:, 6:],
        rot.exp(table[:, :3]),
        table[:, 3:6],
        text.values[first + 9 * cameras :].reshape(-1, 3),
        image,
        point,
        text.values[3:first].reshape(-1, 4)[:, 2:],
        [str(i) for i in range(cameras)],
        [str(i) for i in range(points)],
    )
    return model.network("BAL problem", lambda i, message: text.error(message, first + 9 * i))


def write(network: Network, path: Path) -> None:
    """Write a BAL problem; numbers read back exactly.

    Parameters
    ----------
    network : Network
        See `baarda.formats.snavely_model.SnavelyModel.of`.
    path : Path
        A new file; packed where its name ends in ``.bz2`` or ``.gz``.

    Raises
    ------
    UsageError
        If the network holds what a BAL problem cannot.
    OutputError
        If the file exists or cannot be written.
    """
    m = SnavelyModel.of(network, "BAL problem")
    order = np.lexsort((m.images_of, m.points_of))
    lines = [f"{len(m.labels)} {len(m.points)} {len(m.xy)}"]
    for i, p, (x, y) in zip(m.images_of[order].tolist(), m.points_of[order].tolist(), m.xy[order].tolist(), strict=True):
        lines.append(f"{i} {p} {x!r} {y!r}")
    cameras = np.concatenate([rot.log(m.rotation), m.translation, m.parameters], axis=1)
    lines += [repr(v) for v in cameras.ravel().tolist() + m.points.ravel().tolist()]
    content = ("\n".join(lines) + "\n").encode("ascii")
    if path.suffix == ".bz2":
        content = bz2.compress(content)
    elif path.suffix == ".gz":
        content = gzip.compress(content, mtime=0)
    write_file(path, content)


bal = Format("bal", "BAL problem (Bundle Adjustment in the Large): .txt, .bz2, .gz", recognises, read, write)
