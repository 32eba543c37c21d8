"""Data snooping: what was removed, in which order, what was restored, and what could not be told apart."""

from __future__ import annotations

import numpy as np

from baarda.procedures.snooping_steps import Snooping, SnoopStep
from baarda.procedures.testing import Analysis
from baarda.report.sections._numbers import fixed, names, plural, powers, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, SectionMaker, Tone, say
from baarda.report.translation import tr

_MOST = 200
_TONES: dict[str, Tone] = {"rejected": "bad", "restored": "good", "kept": "warn"}


def _intro(s: Snooping) -> str:
    what = tr({"coordinate": "observation", "point": "image point", "image": "image"}[s.unit])
    start = (
        "from the least-squares adjustment" if s.start == "least squares" else say("from an adjustment under the {law} law", law=s.start)
    )
    return say(
        "Data snooping: starting {start}, the worst {what} beyond its limit ({law}, level {alpha}) was removed and everything was adjusted "
        "again, until none was left; what agreed with the prediction from the others was restored.",
        start=start,
        what=what,
        law=s.law or "its law",
        alpha=f"{s.alpha:.3g}"
        if s.levels in ("none", "baarda")
        else say("{alpha} for the family, {levels}", alpha=f"{s.alpha:.3g}", levels=s.levels),
    )


def _outcome(s: Snooping) -> Paragraph:
    rejected = len(s.images) if s.unit == "image" else s.count
    if not rejected:
        return Paragraph(say("Nothing was removed. {stopped}", stopped=s.stopped), "warn" if s.steps else "good")
    out = names(s.images, 10) if s.unit == "image" else plural(rejected, "observation")
    text = say(
        "Removed: {out} in {steps}. {stopped} Tests and precision on this page are those without them; a level that holds for one test of "
        "good data does not hold for data that were chosen by it.",
        out=out,
        steps=plural(len(s.steps), "decision"),
        stopped=s.stopped,
    )
    return Paragraph(text, "warn")


def _row(step: SnoopStep) -> tuple[str | Cell, ...]:
    told = "" if step.correlation is None or not step.partner else f"{step.partner} ({fixed(step.correlation, 2)})"
    bias = step.separable_bias
    return (
        str(step.step),
        Cell(step.action, _TONES[step.action]),
        step.image or step.group,
        step.point,
        step.component,
        step.statistic_name,
        fixed(step.statistic, 2) + ("" if step.limit is None else say(" (limit {limit})", limit=fixed(step.limit, 2))),
        "" if step.studentised is None else fixed(step.studentised, 2),
        probability(step.p_value) if np.isfinite(step.p_value) else "",
        "" if step.estimated_error is None else f"{significant(step.estimated_error, 3)} {powers(step.unit)}".strip(),
        told,
        "" if step.wrong_choice is None else probability(step.wrong_choice),
        "" if bias is None else significant(bias, 2) if np.isfinite(bias) else "none",
        significant(step.sigma0, 4),
        str(step.redundancy),
        step.note,
    )


def _build(analysis: Analysis) -> list[Block] | None:
    s = None if analysis.strategy is None else analysis.strategy.snooping
    if s is None:
        return None
    blocks: list[Block] = [Paragraph(_intro(s)), _outcome(s)]
    if not s.steps:
        return blocks
    columns = (
        Column("step"),
        Column("decision", "", "kept: suspected, but it could not be removed; the reason is in the last column", "left"),
        Column("image", "", "image of the observation, or its group", "left"),
        Column("point", "", "", "left"),
        Column("of", "", "coordinate or parameter", "left"),
        Column("test", "", "tau by s0, w by sigma0, t of a removed observation against the others' prediction", "left"),
        Column("value", "", "of the statistic before the decision"),
        Column("t", "", "externally studentised: by the s0 without the observation"),
        Column("p", "", "probability of a statistic as large without gross error"),
        Column("error", "", "estimated gross error, observed - true"),
        Column("nearest", "", "the observation whose statistic is correlated most (correlation): the rival culprit", "left"),
        Column("wrong", "", "probability that the rival has the larger statistic, for an error of the estimated size"),
        Column("separable", "", "least error for which the wrong one of the two is blamed no more often than 1 - power; none: never"),
        Column("s0", "", "standard deviation of unit weight after the decision"),
        Column("r", "", "redundancy after the decision"),
        Column("note", "", "", "left"),
    )
    note = say("The first {most} of {count}; all are in result.json.", most=_MOST, count=len(s.steps)) if len(s.steps) > _MOST else ""
    table = DataTable("Decisions of the snooping", columns, tuple(_row(step) for step in s.steps[:_MOST]), note, len(s.steps) > 30)
    kept = [step for step in s.steps if step.action == "kept"]
    if kept:
        told = names([" ".join(t for t in (k.image, k.point, k.component) if t) for k in kept], 6)
        blocks.append(Paragraph(say("Suspected, but kept: {told}. The table says why.", told=told), "warn"))
    return [*blocks, table]


SNOOPING = SectionMaker(82, "snooping", "Data snooping", _build)
