"""The stages of a strategy, with what was tested and decided in each."""

from __future__ import annotations

from baarda.procedures.testing import Analysis
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, SectionMaker
from baarda.report.translation import tr


def _build(analysis: Analysis) -> list[Block] | None:
    stages = () if analysis.strategy is None else analysis.strategy.stages
    if not stages:
        return None
    columns = (
        Column("stage", "", "in this order", "left"),
        Column("found", "", "statistic, limit, probability", "left"),
        Column("decision", "", "", "left"),
    )
    words = {None: "", True: "rejected: ", False: "not rejected: "}
    tones = {None: Cell(""), True: Cell("", "warn"), False: Cell("", "good")}
    rows = tuple((s.name, Cell(tr(words[s.rejected]) + s.finding, tones[s.rejected].tone), s.decision) for s in stages)
    intro = "Grün's order of an analysis: gross errors first, then the model, then the control, then the check points."
    return [Paragraph(intro), DataTable("Stages and decisions", columns, rows)]


STRATEGY = SectionMaker(25, "strategy", "Strategy", _build)
