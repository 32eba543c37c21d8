"""Residual vectors over the image, per camera: what a better camera model could still explain."""

from __future__ import annotations

import numpy as np
from scipy import stats

from baarda.procedures.testing import Analysis
from baarda.report import plots
from baarda.report.sections._facts import sensor_residuals
from baarda.report.sections._numbers import significant
from baarda.report.sections.base import Block, Figure, Paragraph, SectionMaker, say
from baarda.report.translation import tr

_MOST_CAMERAS = 8
_MOST_VECTORS = 2000
_LEVEL = 0.01


def _figure(analysis: Analysis, index: int) -> Figure | None:
    camera = analysis.adjustment.network.cameras[index]
    xy, v = sensor_residuals(analysis, index)
    if not len(xy):
        return None
    if camera.image_size is None:
        low, high = xy.min(axis=0), xy.max(axis=0)
        frame = (float(low[0]), float(high[0]) + 1e-9, float(low[1]), float(high[1]) + 1e-9)
    else:
        # Source coordinates may count from zero or from minus half the format: the frame follows the points where they leave it.
        frame = (
            min(0.0, float(xy[:, 0].min())), max(camera.image_size[0], float(xy[:, 0].max())),
            min(0.0, float(xy[:, 1].min())), max(camera.image_size[1], float(xy[:, 1].max())),
        )  # fmt: skip
    count = len(xy)
    title = say("Residual vectors of camera {label}", label=camera.label)
    name = f"residual-vectors-{index + 1}"
    if count > _MOST_VECTORS:
        corner, size = np.array([frame[0], frame[2]]), (frame[1] - frame[0], frame[3] - frame[2])
        columns = int(np.clip(np.sqrt(count / 16.0 * max(size) / min(size)), 6, 24))
        at, mean, number = plots.residual_grid(xy - corner, v, size, columns)
        # n |mean|^2 / s^2 is chi-square with two degrees of freedom where nothing systematic is left.
        # Residuals under a law of errors are not judged.
        judged = analysis.adjustment.law is None
        beyond = judged & (number * (mean**2 / (v**2).mean(axis=0)).sum(axis=1) > stats.chi2.isf(_LEVEL, 2))
        svg, arrow = plots.vectors(at + corner, mean, beyond, frame, camera.y_down, name, tr("bold: differs from zero"))
        largest = np.hypot(mean[:, 0], mean[:, 1])
        most = int(np.argmax(np.where(number >= 5, largest, -1.0)))
        caption = say(
            "Mean residual vector (adjusted - observed) of each cell of a grid over the image: {count} image points of all images in "
            "{cells} cells. Under a law of errors they are not tested. The largest mean of five points or more is {most} px. Neighbouring "
            "arrows that agree show a systematic error."
            if not judged
            else "Mean residual vector (adjusted - observed) of each cell of a grid over the image: {count} image points of all images in "
            "{cells} cells. In {beyond} cells (bold) the mean differs from zero at level {level}; chance alone would show {expected}. "
            "The largest mean of five points or more is {most} px. Neighbouring arrows that agree show a systematic error.",
            count=count,
            cells=len(at),
            beyond=int(beyond.sum()),
            level=_LEVEL,
            expected=significant(_LEVEL * len(at), 2),
            most=significant(float(largest[most]), 2),
        )
    else:
        svg, arrow = plots.vectors(xy, v, np.zeros(count, dtype=bool), frame, camera.y_down, name)
        caption = say(
            "Residual vector (adjusted - observed) of each of {count} image points of all images; the longest is {most} px. "
            "Neighbouring arrows that agree show a systematic error.",
            count=count,
            most=significant(float(np.hypot(v[:, 0], v[:, 1]).max()), 2),
        )
    caption += " " + say("The scale arrow is {arrow:g} px long.", arrow=arrow)
    return Figure(name, title, caption, say("Arrows over the image area. {caption}", caption=caption), svg)


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged:
        return None
    cameras = analysis.adjustment.network.cameras
    figures = [f for f in (_figure(analysis, i) for i in range(min(len(cameras), _MOST_CAMERAS))) if f is not None]
    if not figures:
        return None
    more = say("The first {most} of {count} cameras.", most=_MOST_CAMERAS, count=len(cameras)) if len(cameras) > _MOST_CAMERAS else ""
    return [*([Paragraph(more)] if more else []), *figures]


RESIDUAL_VECTORS = SectionMaker(120, "residual-vectors", "Residual vectors", _build)
