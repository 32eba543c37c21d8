"""Selection of additional parameters: every model that was tried, and what decided."""

from __future__ import annotations

from baarda.procedures.criteria import SECOND_SPOKEN, SPOKEN
from baarda.procedures.selection import SelectionStep
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import bare
from baarda.report.sections._numbers import fixed, names, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, SectionMaker, Tone, say

_TONES: dict[str, Tone] = {"start": "", "deleted": "good", "kept": "warn", "returned": "info"}


def _row(step: SelectionStep, analysis: Analysis) -> tuple[str | Cell, ...]:
    c = step.criteria
    pair = ""
    if step.pair is not None:
        f = step.pair["f_statistic"]
        pair = say("{name}: r = {rho}", name=bare(step.pair["partner"], analysis), rho=fixed(step.pair["correlation"], 3))
        pair += "" if f is None else say(", T = {f}, p = {p}", f=fixed(f, 2), p=probability(step.pair["p_value"]))
    return (
        str(step.step),
        Cell("full model" if step.action == "start" else step.action, _TONES[step.action]),
        "" if step.parameter is None else bare(step.parameter, analysis),
        "" if step.f_statistic is None else fixed(step.f_statistic, 3),
        "" if step.p_value is None else probability(step.p_value),
        "" if step.predicted_increase is None else significant(step.predicted_increase, 4),
        "" if step.increase is None else significant(step.increase, 4),
        str(step.unknowns),
        *(significant(c[k], 6) if c[k] is not None else "" for k in ("variance_factor", "criterion_b")),
        *(fixed(c[k], 2) if c[k] is not None else "" for k in ("aic", "aicc", "bic")),
        significant(c["check_rms"], 4) if c["check_rms"] is not None else "",
        ", ".join(SPOKEN[k] for k in step.fell),
        pair,
        step.note,
    )


def _build(analysis: Analysis) -> list[Block] | None:
    s = None if analysis.strategy is None else analysis.strategy.selection
    if s is None:
        return None
    o = s.options
    intro = say(
        "Additional parameters were deleted one by one, the least significant first, and everything was adjusted again. F (level {alpha}) "
        "proposes a deletion; it stands while at least one of {deciding} falls. Criterion 9b is {second}.",
        alpha=f"{o.alpha:.3g}",
        deciding=", ".join(SPOKEN[k] for k in o.deciding) or "no criterion",
        second=SECOND_SPOKEN[o.second],
    )
    gone = [bare(name, analysis) for name in s.deleted]
    out = (
        say("Deleted and held at zero: {names}. {stopped}", names=names(gone, 12), stopped=s.stopped)
        if gone
        else say("No parameter was deleted. {stopped}", stopped=s.stopped)
    )
    blocks: list[Block] = [Paragraph(intro), Paragraph(out, "good" if gone or s.fit.names else "info")]
    if any(step.criteria["check_rms"] is not None for step in s.steps):
        blocks.append(
            Paragraph(
                "The check-point error is told; it decides only where that was asked for: check points that chose the model could no "
                "longer judge it."
            )
        )
    columns = (
        Column("step"),
        Column("decision", "", "kept: the deletion was tried and refused", "left"),
        Column("parameter", "", "", "left"),
        Column("F", "", "of the parameter in the model in which it is estimated, F(1, r)"),
        Column("p"),
        Column("x²/q", "", "by which v'Pv must rise in a linear model"),
        Column("rise", "", "by which v'Pv rose"),
        Column("u", "", "unknowns"),
        Column("s0²", "", "criterion 9a"),
        Column("9b", "", SECOND_SPOKEN[o.second]),
        Column("AIC", "", "n ln(v'Pv) + 2u, criterion 9c"),
        Column("AICc", "", "AIC with the correction for few observations"),
        Column("BIC", "", "n ln(v'Pv) + u ln n"),
        Column("check", analysis.adjustment.network.unit, "root mean square of the check coordinates"),
        Column("fell", "", "criteria that fell against the model before", "left"),
        Column("pair", "", "the most correlated partner, judged together: F(2, r)", "left"),
        Column("note", "", "", "left"),
    )
    caption = say("Models tried: {count}", count=plural(len(s.steps), "model"))
    return [*blocks, DataTable(caption, columns, tuple(_row(step, analysis) for step in s.steps))]


SELECTION = SectionMaker(55, "selection", "Selection of parameters", _build)
