"""All tests: null hypothesis, statistic, law, limit, p-value, decision."""

from __future__ import annotations

import numpy as np

from baarda.hypotheses.base import TestResult
from baarda.procedures.testing import Analysis
from baarda.report.sections._numbers import fixed, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Items, Paragraph, SectionMaker, Tone, say
from baarda.report.translation import tr


def _limits(test: TestResult) -> str:
    critical = test.critical
    if isinstance(critical, tuple):
        return f"{_short(critical[0])}..{_short(critical[1])}"
    return _short(critical)


def _tone(test: TestResult, rejected: bool, grave: Tone) -> Tone:
    """A parameter that is not zero is what one hopes for; every other rejection is a contradiction."""
    if "additional_parameter" in test.name:
        return "good" if rejected else "warn"
    return grave if rejected else "good"


def _short(value: float) -> str:
    return fixed(value, 1) if abs(value) >= 100.0 else fixed(value, 3) if abs(value) >= 1.0 else significant(value, 3)


def _row(test: TestResult, mark: str) -> tuple[str | Cell, ...]:
    """One row: a single test, or the extreme member of a family with the count beyond the limit."""
    head, level = f"{test.name.replace('_', ' ')}\n{test.null}{mark}", f"{test.alpha:.3g}"
    if not test.details.get("applicable", True):
        return (head, Cell("not applicable", "info"), "", "", "", level, "", "")
    if not np.ndim(test.statistic):
        decision = Cell("rejected" if test.rejected else "not rejected", _tone(test, bool(test.rejected), "bad"))
        label = test.labels[0] if len(test.labels) == 1 else ""
        numbers = (_short(float(test.statistic)), _limits(test), probability(float(test.p_value)))
        return (head, decision, *numbers, level, test.law_name, label)
    p, statistic = np.asarray(test.p_value, dtype=float), np.asarray(test.statistic)
    tested, beyond = int(np.isfinite(p).sum()), int(np.sum(test.rejected))
    if not tested:
        return (head, Cell("not testable", "info"), "", "", "", level, test.law_name, "")
    i = int(np.lexsort((-np.abs(np.nan_to_num(statistic)), np.where(np.isfinite(p), p, np.inf)))[0])
    decision = Cell(say("{beyond} of {tested} rejected", beyond=beyond, tested=tested), _tone(test, bool(beyond), "warn"))
    label = test.labels[i] if test.labels else say("number {i}", i=i + 1)
    return (head, decision, _short(float(statistic[i])), _limits(test), probability(float(p[i])), level, test.law_name, label)


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.tests and not analysis.not_applicable:
        return None
    notes: dict[str, int] = {}
    rows = []
    for test in analysis.tests:
        mark = ""
        if test.note:
            mark = f" [{notes.setdefault(test.note, len(notes) + 1)}]"
        rows.append(_row(test, mark))
    for name, reason in analysis.not_applicable.items():
        mark = f" [{notes.setdefault(tr(reason), len(notes) + 1)}]"
        rows.append((f"{name.replace('_', ' ')}{mark}", Cell("not applicable", "info"), *[""] * 6))
    columns = (
        Column(
            "test",
            "",
            "name (with underscores in result.json) and null hypothesis: what is assumed until the data contradict; [n] = note below",
            "left",
        ),
        Column("decision", "", "", "left"),
        Column("statistic", "", "the number that is judged"),
        Column("limit", "", "critical value, or the two of a two-sided test"),
        Column("p", "", "probability of a statistic at least as extreme if the null hypothesis is true"),
        Column("level", "", "probability of a wrong rejection by one single test"),
        Column("law", "", "law of the statistic if the null hypothesis is true", "left"),
        Column("extreme member", "", "of a family of equal tests; statistic and p are its own", "left"),
    )
    families = sum(1 for t in analysis.tests if np.ndim(t.statistic))
    intro = say(
        "{count} were made, {families} of them for whole families of observations, images, parameters or points. A test that rejects "
        "says that data and hypothesis do not fit; one that does not reject proves nothing. Additional parameters are welcome to "
        "differ from zero.",
        count=plural(len(analysis.tests), "test"),
        families=families,
    )
    if analysis.not_applicable:
        left_out = " {count} not applicable under the law of errors of this adjustment: the notes say why."
        intro += say(left_out, count=plural(len(analysis.not_applicable), "test is", "tests are"))
    blocks: list[Block] = [Paragraph(intro), DataTable("All tests", columns, tuple(rows))]
    if notes:
        blocks.append(Items("Notes to the tests:", tuple(f"[{i}] {text}" for text, i in notes.items())))
    return blocks


TESTS = SectionMaker(100, "tests", "All tests", _build)
