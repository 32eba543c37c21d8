"""Network plan: where cameras and points are, and how precise the points are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from baarda.procedures.testing import Analysis
from baarda.report import plots
from baarda.report.scene import MOST_POINTS
from baarda.report.sections._facts import almost_infinite, point_sigmas, scaling, spatial
from baarda.report.sections._numbers import finer, plural, significant
from baarda.report.sections.base import Block, Figure, SectionMaker, say


def _sample(tie: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the points that are drawn: all of the survey, and the others while there is room, else an even sample of them."""
    others = np.flatnonzero(tie)
    room = max(MOST_POINTS - int((~tie).sum()), MOST_POINTS // 5)
    if len(others) > room:
        others = others[np.linspace(0, len(others) - 1, room).astype(np.intp)]
    return np.sort(np.concatenate([np.flatnonzero(~tie), others])).astype(np.intp)


def _build(analysis: Analysis) -> list[Block] | None:
    images = analysis.adjustment.network.images
    if not analysis.converged or not images.labels:
        return None
    table, sigmas = point_sigmas(analysis)
    whole = spatial(sigmas)
    unit = analysis.adjustment.network.unit
    told, factor = finer(unit, whole[(whole > 0.0) & ~almost_infinite(analysis)])
    points = np.stack([table[axis] for axis in ("X", "Y", "Z")], axis=1)
    infinite = almost_infinite(analysis)
    finite = np.flatnonzero(~infinite)
    drawn = finite[_sample((table["role"] == "tie")[finite])]
    # A camera looks along its -z axis: the third row of M, reversed.
    directions = -images.rotation[:, 2, :]
    svg = plots.plan(
        points[drawn], (whole * factor)[drawn], table["role"][drawn].tolist(), images.position, directions, images.labels, unit, told
    )
    free = whole[(whole > 0.0) & ~infinite] * factor
    sizes = (
        say(" from {low} to {high} {unit}", low=significant(free.min(), 2), high=significant(free.max(), 2), unit=told) if len(free) else ""
    )
    caption = say(
        "Object points, coloured by their spatial standard deviation ({scaling}){sizes}, and images (squares) with their viewing "
        "directions; plan above, elevation below.",
        scaling=scaling(analysis),
        sizes=sizes,
    )
    low, high = plots.core_of(points[drawn], images.position)
    out = int((~((points[drawn] >= low) & (points[drawn] <= high)).all(axis=1)).sum())
    if out:
        caption += " " + say("{count} outside of the figure, far from the others.", count=plural(out, "point lies", "points lie"))
    if infinite.any():
        count = plural(int(infinite.sum()), "point cannot be", "points cannot be")
        caption += " " + say("{count} told from infinity.", count=count)
    if len(drawn) < len(finite):
        caption += " " + say("Only {shown} points are drawn: those of the survey and an even sample of the others.", shown=len(drawn))
    alt = say(
        "Plan and elevation of {points} object points and {images} images. {caption}",
        points=len(table),
        images=len(images.labels),
        caption=caption,
    )
    return [Figure("network-plan", "Network plan", caption, alt, svg)]


PLAN = SectionMaker(130, "network-plan", "Network plan", _build)
