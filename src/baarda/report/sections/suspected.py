"""Suspected observations: the outlier test of each single observation, the worst first."""

from __future__ import annotations

from collections import Counter

import numpy as np

from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import bare, clusters, judge, result_of, unit_of
from baarda.report.sections._numbers import fixed, plural, powers, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, SectionMaker, say

_MOST = 50


def _meanings(analysis: Analysis) -> list[tuple[str, str, str]]:
    """Say of each suspected observation how many more are suspected at its point and in its image, and what that points at."""
    table = analysis.observations
    points, images, components = table["point"], table["image"], table["component"]
    rows = analysis.suspected
    at_point, in_image = Counter(points[rows].tolist()), Counter(images[rows].tolist())
    pairs = Counter((images[i], points[i]) for i in rows.tolist() if images[i])
    gathered = {(c.kind, c.label) for c in clusters(analysis)}
    out = []
    for i in rows[:_MOST].tolist():
        others = at_point[points[i]] - 1 if points[i] else 0
        near = in_image[images[i]] - 1 if images[i] else 0
        if ("point", points[i]) in gathered:
            meaning = "point in doubt"
        elif pairs[(images[i], points[i])] > 1:
            meaning = "x and y: wrong target?"
        elif ("image", images[i]) in gathered:
            meaning = "image in doubt"
        elif not images[i]:
            meaning = say("the given {of}", of=components[i])
        else:
            meaning = "this measurement"
        out.append((str(others) if points[i] else "", str(near) if images[i] else "", meaning))
    return out


def _build(analysis: Analysis) -> list[Block] | None:
    test = result_of(analysis, "data_snooping")
    if test is None:
        return None
    name, values, limit = judge(analysis)
    tested = int(np.isfinite(values).sum())
    o = analysis.options
    count = len(analysis.suspected)
    intro = say(
        "Each of {tested} observations was tested for a gross error: |{name}| against {limit} ({law}, level {alpha} for each single test). "
        "{found} beyond the limit; if there were no errors, chance would put about {expected} there.",
        tested=tested,
        name=name,
        limit=fixed(limit, 3),
        law=test.law_name,
        alpha=f"{test.alpha:.3g}",
        found=plural(count, "observation lies", "observations lie"),
        expected=significant(tested * test.alpha, 2),
    )
    blocks: list[Block] = [Paragraph(intro)]
    if not count:
        return [*blocks, Paragraph("No observation is suspected.", "good")]
    blocks.append(
        Paragraph(
            "One gross error shows in several residuals. Judge the first, remove or repeat it, adjust again; the estimated error of "
            "each row holds only if it is the only error."
        )
    )
    table = analysis.observations
    rows: list[tuple[str | Cell, ...]] = []
    for i, meaning in zip(analysis.suspected[:_MOST].tolist(), _meanings(analysis), strict=True):
        number = {k: float(table[k][i]) for k in ("residual", "redundancy", "w", "tau", "estimated_error", "mdb", "external", "p_value")}
        rows.append(
            (
                str(table["image"][i]) or str(table["group"][i]),
                str(table["point"][i]),
                str(table["component"][i]),
                powers(unit_of(analysis, i)) or "1",
                significant(number["residual"], 3),
                fixed(number["redundancy"], 3),
                fixed(number["w"], 2),
                fixed(number["tau"], 2),
                significant(number["estimated_error"], 3),
                significant(number["mdb"], 3),
                fixed(number["external"], 2),
                _effect(analysis, i),
                probability(number["p_value"]),
                *meaning,
            )
        )
    columns = (
        Column("image", "", "image of the observation, or its group", "left"),
        Column("point", "", "", "left"),
        Column("of", "", "coordinate or parameter", "left"),
        Column("unit", "", "unit of v, error and MDB", "left"),
        Column("v", "", "residual, adjusted - observed"),
        Column("r", "", "redundancy number: share of an error that shows in the residual"),
        Column(
            "w",
            "",
            say("v by its own a-priori standard deviation, normal law, limit {limit}", limit=fixed(_normal_limit(o.alpha_outlier), 2)),
        ),
        Column("tau", "", "v by its own a-posteriori standard deviation, Pope's tau law"),
        Column("error", "", "estimated gross error, observed - true = -v / r"),
        Column("MDB", "", say("minimal detectable bias with power {power}", power=fixed(o.power, 2))),
        Column("external", "", "effect of an undetected error of that size on the unknowns, in their standard deviations at most"),
        Column(
            "effect",
            "",
            "the largest of these effects on an unknown of its camera, image or points (in large blocks: of its camera), in its unit",
            "left",
        ),
        Column("p", "", say("probability of a |{name}| as large without gross error", name=name)),
        Column("at point", "", "further observations suspected at the same point"),
        Column("in image", "", "further observations suspected in the same image"),
        Column(
            "meaning",
            "",
            "what to look at first: this measurement alone; the point, where more are suspected there than chance gathers; its target "
            "or number, where x and y are suspected",
            "left",
        ),
    )
    note = say("The first {most} of {count}; all are in tables/observations.csv.", most=_MOST, count=count) if count > _MOST else ""
    return [*blocks, DataTable("Suspected observations, the worst first", columns, tuple(rows), note)]


def _effect(analysis: Analysis, row: int) -> str:
    table = analysis.observations
    value, name = float(table["effect"][row]), str(table["effect_on"][row])
    return say("{value} on {name}", value=significant(value, 2), name=bare(name, analysis)) if name else ""


def _normal_limit(alpha: float) -> float:
    from scipy import stats

    return float(stats.norm.isf(alpha / 2.0))


SUSPECTED = SectionMaker(80, "suspected", "Suspected observations", _build)
