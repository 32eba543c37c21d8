"""Cross-validation: the errors of withheld control points against the precision predicted for them."""

from __future__ import annotations

from baarda.procedures.testing import Analysis
from baarda.report.sections._numbers import decimals_for, finer, fixed, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, SectionMaker, say

_MOST = 200


def _build(analysis: Analysis) -> list[Block] | None:
    c = None if analysis.strategy is None else analysis.strategy.cross_validation
    if c is None:
        return None
    unit, factor = finer(analysis.adjustment.network.unit, [e.rms for e in c.errors] or [1.0])
    points = len({row.point for row in c.rows})
    intro = say(
        "The control points were withheld in {folds} turns: everything was adjusted without those of a turn, and their coordinates were "
        "predicted. {points} points were predicted; {rejected} of {count} coordinates differ by more than their predicted sigma allows "
        "(level {alpha}). {note}",
        folds=len(c.folds),
        points=points,
        rejected=c.rejected,
        count=len(c.rows),
        alpha=f"{c.alpha:.3g}",
        note=c.note,
    )
    columns = (
        Column("error", "", "axis, horizontal plane, or space", "left"),
        Column("points"),
        Column("RMS", unit, "root mean square of predicted - given"),
        Column("from", unit, say("confidence interval of the RMS, {level} %", level=fixed(100.0 * c.confidence, 0))),
        Column("to", unit),
        Column("predicted", unit, "root mean square of the predicted standard deviations, survey included"),
        Column("ratio", "", "mean square over predicted variance: 1 where the prediction is right"),
        Column("p", "", "probability of a ratio as far from 1 if the prediction is right"),
    )
    rows: tuple[tuple[str | Cell, ...], ...] = tuple(
        (
            e.name,
            str(e.count),
            *(significant(v * factor, 3) for v in (e.rms, e.low, e.high, e.predicted)),
            fixed(e.ratio, 2),
            Cell(probability(e.p_value), "bad" if e.p_value <= c.alpha else "good"),
        )
        for e in c.errors
    )
    decimals = decimals_for([r.difference * factor for r in c.rows], 3)
    each: tuple[tuple[str | Cell, ...], ...] = tuple(
        (
            str(r.fold),
            r.point,
            r.axis,
            fixed(r.difference * factor, decimals),
            fixed(r.sigma * factor, decimals),
            fixed(r.ratio, 2),
            Cell(probability(r.p_value), "warn" if r.p_value <= c.alpha else ""),
        )
        for r in c.rows[:_MOST]
    )
    single = (
        Column("turn"),
        Column("point", "", "", "left"),
        Column("axis", "", "", "left"),
        Column("d", unit, "predicted - given"),
        Column("s(d)", unit, "its standard deviation"),
        Column("d / s", "", ""),
        Column("p", "", "probability of a |d / s| as large"),
    )
    blocks: list[Block] = [
        Paragraph(intro),
        DataTable("Errors of withheld control points", columns, rows),
        DataTable(
            "Withheld coordinates",
            single,
            each,
            "" if len(c.rows) <= _MOST else say("The first {most}; all are in result.json.", most=_MOST),
            True,
        ),
    ]
    failed = [f for f in c.folds if f.problem]
    blocks += [Paragraph(say("Without {points}: {problem}", points=", ".join(f.points), problem=f.problem), "warn") for f in failed]
    return blocks


CROSS_VALIDATION = SectionMaker(92, "cross-validation", "Cross-validation", _build)
