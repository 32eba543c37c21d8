"""Maps over the image, per camera: how well its observations control each other, and which errors they would hide."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.observations import ImagePoints
from baarda.procedures.testing import Analysis
from baarda.report import drawings
from baarda.report.sections._numbers import fixed, significant
from baarda.report.sections.base import Block, Figure, Paragraph, SectionMaker, say
from baarda.report.translation import tr

Floats = NDArray[np.float64]

_MOST_CAMERAS = 4
_COLUMNS = 20


def _values(analysis: Analysis, camera: int) -> tuple[Floats, Floats, Floats]:
    """Return position, mean redundancy number and larger minimal detectable bias of the image points of a camera."""
    a = analysis.adjustment
    xy, r, mdb = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0)]
    numbers, smallest = a.redundancy_numbers, analysis.observations["mdb"]
    for g, group in enumerate(a.groups):
        if isinstance(group, ImagePoints):
            chosen = a.network.images.cameras[group.images] == camera
            rows = slice(a.offsets[g], a.offsets[g + 1])
            xy.append(group.xy[chosen])
            r.append(numbers[rows].reshape(-1, 2)[chosen].mean(axis=1))
            mdb.append(smallest[rows].reshape(-1, 2)[chosen].max(axis=1))
    return np.concatenate(xy), np.concatenate(r), np.concatenate(mdb)


def frame_of(camera: Any, xy: Floats) -> tuple[float, float, float, float]:
    """Return left, right, lower and upper limit of the image coordinates of a camera, its points included."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    if camera.image_size is not None:
        low, high = np.minimum(low, 0.0), np.maximum(high, camera.image_size)
    return float(low[0]), float(high[0]) + 1e-9, float(low[1]), float(high[1]) + 1e-9


def cell_means(xy: Floats, values: Floats, frame: tuple[float, float, float, float], columns: int = _COLUMNS) -> tuple[Floats, Floats]:
    """Return the mean of values in the cells of a grid over a frame, NaN where there is none, and the counts.

    Parameters
    ----------
    xy : (n, 2) array
    values : (n,) array
        NaN values do not count.
    frame : tuple of float
        Left, right, lower and upper limit.
    columns : int
        Cells along the longer side.

    Returns
    -------
    means, counts : (rows, columns) arrays

    Examples
    --------
    >>> cell_means(np.array([[1.0, 1.0], [2.0, 1.0]]), np.array([0.5, 0.7]), (0.0, 10.0, 0.0, 10.0), 2)[0]
    array([[0.6, nan], [nan, nan]])
    """
    size = np.array([frame[1] - frame[0], frame[3] - frame[2]])
    shape = np.maximum(1, np.ceil(columns * size / size.max() - 1e-9).astype(int))
    seen = np.isfinite(values)
    at = np.minimum(((xy[seen] - [frame[0], frame[2]]) / size * shape).astype(int), shape - 1)
    code = at[:, 1] * shape[0] + at[:, 0]
    counts = np.bincount(code, minlength=shape.prod()).astype(float)
    sums = np.bincount(code, weights=values[seen], minlength=shape.prod())
    means = np.divide(sums, counts, out=np.full(len(counts), np.nan), where=counts > 0)
    return means.reshape(shape[1], shape[0]), counts.reshape(shape[1], shape[0])


def _figure(analysis: Analysis, index: int) -> Figure | None:
    camera = analysis.adjustment.network.cameras[index]
    xy, r, mdb = _values(analysis, index)
    if len(xy) < 50:
        return None
    frame = frame_of(camera, xy)
    columns = int(np.clip(np.sqrt(len(xy) / 4.0), 4, _COLUMNS))
    shares, _ = cell_means(xy, r, frame, columns)
    maps = [(tr("mean redundancy number"), shares, "viridis")]
    sizes = None
    if np.isfinite(mdb).any():
        sizes, _ = cell_means(xy, mdb, frame, columns)
        maps.append((tr("mean MDB (px)"), sizes, "magma_r"))
    name = f"reliability-map-{index + 1}"
    svg = drawings.cell_maps(maps, frame, camera.y_down, name)
    caption = say(
        "Reliability over the image of camera {label}: mean redundancy number of the {count} image points in each "
        "cell, from {low} to {high}.",
        label=camera.label,
        count=len(xy),
        low=fixed(float(np.nanmin(shares)), 2),
        high=fixed(float(np.nanmax(shares)), 2),
    )
    if sizes is not None:
        caption += " " + say(
            "Beside it the mean minimal detectable bias (the larger of x and y), from {low} to {high} px: a gross error below it stays "
            "hidden more often than the power allows.",
            low=significant(float(np.nanmin(sizes)), 2),
            high=significant(float(np.nanmax(sizes)), 2),
        )
    caption += " " + tr("Empty cells hold no image points.")
    title = say("Redundancy and minimal detectable bias, camera {label}", label=camera.label)
    return Figure(name, title, caption, say("Coloured cells over the image area. {caption}", caption=caption), svg)


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged:
        return None
    cameras = analysis.adjustment.network.cameras
    figures = [f for f in (_figure(analysis, i) for i in range(min(len(cameras), _MOST_CAMERAS))) if f is not None]
    if not figures:
        return None
    more = say("The first {most} of {count} cameras.", most=_MOST_CAMERAS, count=len(cameras)) if len(cameras) > _MOST_CAMERAS else ""
    return [*([Paragraph(more)] if more else []), *figures]


MAPS = SectionMaker(125, "reliability-maps", "Reliability maps", _build)
