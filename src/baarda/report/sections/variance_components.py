"""Variance components: stated and estimated standard deviations of groups of observations."""

from __future__ import annotations

import numpy as np

from baarda.procedures.testing import Analysis
from baarda.procedures.variance_components import VarianceComponents
from baarda.report.sections._numbers import fixed, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, SectionMaker, say

_OUTCOMES = {"estimated": Cell("estimated", "good")}


def _table(found: VarianceComponents) -> DataTable:
    single = next(t for t in found.tests if t.name == "variance_component")
    p = dict(zip(single.labels, np.asarray(single.p_value).tolist(), strict=True))
    rejected = dict(zip(single.labels, np.asarray(single.rejected).tolist(), strict=True))
    rows: list[tuple[str | Cell, ...]] = []
    for c in found.components:
        root = float(np.sqrt(c.factor))
        spread = "" if c.deviation is None else fixed(c.deviation / (2.0 * root), 3)
        told = (c.name, str(c.count), fixed(c.redundancy, 1), significant(c.before), significant(c.after), fixed(root, 3), spread)
        verdict = Cell("rejected", "warn") if rejected[c.name] else Cell("not rejected", "good")
        rows.append((*told, probability(p[c.name]), verdict, _OUTCOMES.get(c.outcome, Cell(c.outcome, "warn"))))
    columns = (
        Column("group", "", "", "left"),
        Column("n", "", "observations"),
        Column("r", "", "redundancy, with the estimated variances"),
        Column("stated", "", "median standard deviation as stated, unit of the observations"),
        Column("estimated", "", "median standard deviation of this adjustment"),
        Column("factor", "", "estimated by stated"),
        Column("s(factor)", "", "standard deviation of this factor"),
        Column("p", "", "probability of a deviation as large if the stated variances were right"),
        Column("stated is right", "", "", "left"),
        Column("outcome", "", "", "left"),
    )
    return DataTable(
        "Standard deviations of groups of observations", columns, tuple(rows), say("Law of the test: {law}.", law=single.law_name)
    )


def _build(analysis: Analysis) -> list[Block] | None:
    found = analysis.components
    if found is None:
        return None
    end = "they settled" if found.converged else "they did not settle"
    intro = say(
        "The variance of each group was estimated from its own residuals and redundancy, {steps}, until all fit together: {end}. "
        "The tests on this page use them; s0 is then near 1 and says nothing more.",
        steps=plural(found.iterations, "iteration"),
        end=end,
    )
    blocks: list[Block] = [Paragraph(intro, "" if found.converged else "warn"), _table(found)]
    for t in found.tests:
        if t.name == "equal_variance_components":
            text = say(
                "One factor for all groups: T = {statistic}, {law}, p = {p}: {word}.",
                statistic=significant(float(t.statistic)),
                law=t.law_name,
                p=probability(float(t.p_value)),
                word="rejected, the stated variances do not fit each other" if t.rejected else "not rejected",
            )
            blocks.append(Paragraph(text, "warn" if t.rejected else "good"))
    blocks += [Paragraph(text, "warn") for text in found.notes]
    if not found.exact:
        blocks.append(Paragraph("Redundancy shared between groups was found with random probes of a fixed seed."))
    return blocks


VARIANCE_COMPONENTS = SectionMaker(35, "variance-components", "Variance components", _build)
