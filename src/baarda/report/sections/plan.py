"""Network plan: where cameras and points are, and how precise the points are."""

from __future__ import annotations

import numpy as np

from baarda.procedures.testing import Analysis
from baarda.report import plots
from baarda.report.sections._facts import point_sigmas, scaling, spatial
from baarda.report.sections._numbers import finer, significant
from baarda.report.sections.base import Block, Figure, SectionMaker, say


def _build(analysis: Analysis) -> list[Block] | None:
    images = analysis.adjustment.network.images
    if not analysis.converged or not images.labels:
        return None
    table, sigmas = point_sigmas(analysis)
    whole = spatial(sigmas)
    unit = analysis.adjustment.network.unit
    told, factor = finer(unit, whole[whole > 0.0])
    points = np.stack([table[axis] for axis in ("X", "Y", "Z")], axis=1)
    # A camera looks along its -z axis: the third row of M, reversed.
    directions = -images.rotation[:, 2, :]
    svg = plots.plan(points, whole * factor, table["role"].tolist(), images.position, directions, images.labels, unit, told)
    free = whole[whole > 0.0] * factor
    sizes = (
        say(" from {low} to {high} {unit}", low=significant(free.min(), 2), high=significant(free.max(), 2), unit=told) if len(free) else ""
    )
    caption = say(
        "Object points, coloured by their spatial standard deviation ({scaling}){sizes}, and images (squares) with their viewing "
        "directions; plan above, elevation below.",
        scaling=scaling(analysis),
        sizes=sizes,
    )
    alt = say(
        "Plan and elevation of {points} object points and {images} images. {caption}",
        points=len(table),
        images=len(images.labels),
        caption=caption,
    )
    return [Figure("network-plan", "Network plan", caption, alt, svg)]


PLAN = SectionMaker(130, "network-plan", "Network plan", _build)
