"""Images: exterior orientation with sigmas, and whether all images are equally precise."""

from __future__ import annotations

import numpy as np

from baarda.network import EXTERIOR
from baarda.procedures.testing import Analysis
from baarda.report import plots
from baarda.report.sections._facts import MOST_ROWS, first, result_of, scaling
from baarda.report.sections._numbers import MISSING, column, decimals_for, finer, fixed
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, SectionMaker, say, told

_MOST_BARS = 120


def _orientation(analysis: Analysis) -> DataTable:
    a = analysis.adjustment
    table = a.image_table(analysis.options.sigma)
    several = len(a.network.cameras) > 1
    rows: list[list[str]] = [[str(label)] for label in table["image"][:MOST_ROWS]]
    columns = [Column("image", "", "", "left")]
    if several:
        columns.append(Column("camera", "", "", "left"))
        for row, label in zip(rows, table["camera"], strict=False):
            row.append(str(label))
    with np.errstate(invalid="ignore"):
        positions = np.stack([table[f"s{n}"] for n in EXTERIOR[:3]], axis=1)
    unit, factor = finer(a.network.unit, positions)
    for k, name in enumerate(EXTERIOR):
        angle = k >= 3
        value = table[f"{name}_rad"] if angle else table[name]
        sigma = table[f"s{name}_rad"] if angle else table[f"s{name}"]
        value, sigma = (np.degrees(value), np.degrees(sigma)) if angle else (value, sigma)
        decimals = min(decimals_for(sigma[sigma > 0.0], 2), 6) if (sigma > 0.0).any() else 4
        shown = [fixed(v, decimals) for v in value.tolist()]
        spread = column(np.where(sigma > 0.0, sigma, np.nan) * (1.0 if angle else factor), 2)
        for row, v, s in zip(rows, shown, spread, strict=False):
            row += [v, s]
        meaning = say("rotation about the {axis} axis", axis="XYZ"[k - 3]) if angle else "projection centre"
        columns += [
            Column(name, "°" if angle else a.network.unit, meaning),
            Column(f"s {name}", "°" if angle else unit, say("standard deviation, {scaling}", scaling=scaling(analysis))),
        ]
    note = first(len(table), MOST_ROWS, "tables/images.csv")
    if any(MISSING in row for row in rows):
        note = f"{note} {say('{mark}: fixed, or not defined at the singularity of the angles.', mark=MISSING)}".strip()
    return DataTable("Exterior orientation", tuple(columns), tuple(tuple(row) for row in rows), note)


def _precision(analysis: Analysis) -> list[Block]:
    a = analysis.adjustment
    table = a.image_table("apriori")
    test = result_of(analysis, "variance_per_image")
    index = {} if test is None else {n: i for i, n in enumerate(test.labels)}
    s0, beyond = np.full(len(table), np.nan), np.zeros(len(table), dtype=bool)
    decisions = [Cell("")] * len(table)
    if test is not None:
        s2, reject = np.asarray(test.details["variances"]), np.asarray(test.rejected)
        reference = float(test.details["reference"])
        for row, label in enumerate(table["image"]):
            if label in index:
                i = index[label]
                s0[row], beyond[row] = np.sqrt(s2[i] / reference), reject[i]
                decisions[row] = (
                    Cell("agrees", "good")
                    if not reject[i]
                    else Cell("less precise", "warn")
                    if s2[i] > reference
                    else Cell("more precise", "info")
                )
    counts = np.zeros(len(table), dtype=int)
    images = analysis.evidence.images
    if images is not None and len(analysis.suspected):
        at = images[analysis.suspected]
        counts += np.bincount(at[at >= 0], minlength=len(table))
    rms = column(table["rms"], 3)
    rows = [
        (str(table["image"][i]), str(table["points"][i]), rms[i], fixed(s0[i], 2), decisions[i], str(counts[i]))
        for i in range(min(len(table), MOST_ROWS))
    ]
    columns = (
        Column("image", "", "", "left"),
        Column("points", "", "number of image points"),
        Column("rms v", "px", "root mean square of the residuals in x and y"),
        Column("relative s0", "", "standard deviation of unit weight of the image in that of all images; 1 = as precise as the others"),
        Column("variance test", "", "is the variance of the image that of all images?", "left"),
        Column("suspected", "", "number of observations suspected of a gross error"),
    )
    note = "" if test is None else say("Two-sided at level {alpha}, law: {law}.", alpha=f"{test.alpha:.3g}", law=told(test.law_name))
    more = first(len(table), MOST_ROWS, "tables/images.csv")
    blocks: list[Block] = []
    if test is not None and 2 <= len(table) <= _MOST_BARS:
        caption = say(
            "Standard deviation of unit weight of each image in that of all; {count} of {total} differ from the others at level {alpha}.",
            count=int(beyond.sum()),
            total=len(index),
            alpha=f"{test.alpha:.3g}",
        )
        svg = plots.bars(
            np.nan_to_num(s0), beyond.tolist(), table["image"].tolist(), "s0 of the image / of all", "differs", "image-precision"
        )
        blocks.append(Figure("image-precision", "Precision of the images", caption, say("Bar chart. {caption}", caption=caption), svg))
    return [*blocks, DataTable("Residuals of the images", columns, tuple(rows), f"{note} {more}".strip())]


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged or not analysis.adjustment.network.images.labels:
        return None
    return [_orientation(analysis), *_precision(analysis)]


IMAGES = SectionMaker(60, "images", "Images", _build)
