"""Control and check points against the survey: differences, predicted precision, tests, and accuracy figures with their intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.hypotheses.base import Estimates, TestResult
from baarda.network import AXES
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import MOST_ROWS, first, result_of, scaling
from baarda.report.sections._numbers import MISSING, decimals_for, finer, fixed, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, SectionMaker, Tone, say

Floats = NDArray[np.float64]


def _by_point(e: Estimates, deviations: Floats) -> dict[str, tuple[Floats, Floats]]:
    """Return differences and standard deviations of each point, NaN where an axis has none."""
    out: dict[str, tuple[Floats, Floats]] = {}
    for name, group, value, s in zip(e.names, e.groups, e.values, deviations, strict=True):
        d, sd = out.setdefault(group, (np.full(3, np.nan), np.full(3, np.nan)))
        k = AXES.index(name[-1])
        d[k], sd[k] = value, s
    return out


def _tested(test: TestResult | None, label: str, grave: Tone) -> tuple[str, str, Cell]:
    if test is None or label not in test.labels:
        return "", "", Cell("")
    i = test.labels.index(label)
    statistic, p = float(np.asarray(test.statistic)[i]), float(np.asarray(test.p_value)[i])
    if not np.isfinite(p):
        return MISSING, MISSING, Cell("uncontrolled", "info")
    return fixed(statistic, 2), probability(p), Cell("rejected", grave) if np.asarray(test.rejected)[i] else Cell("agrees", "good")


def _differences(analysis: Analysis, kind: str, e: Estimates, deviations: Floats, words: tuple[str, str], where: str) -> DataTable:
    """Differences of each point with their standard deviations and its test; red only where the joint test of all rejects, too."""
    test, joint = result_of(analysis, f"{kind}_point"), result_of(analysis, f"{kind}_points")
    grave: Tone = "bad" if joint is not None and joint.rejected else "warn"
    caption = "Check points" if kind == "check" else "Weighted control points"
    points = _by_point(e, deviations)
    told, factor = finer(analysis.adjustment.network.unit, e.values)
    decimals = decimals_for(e.values * factor, 3)
    rows: list[tuple[str | Cell, ...]] = []
    for label, (d, s) in list(points.items())[:MOST_ROWS]:
        numbers = [fixed(float(v) * factor, decimals) for v in (*d, *s)]
        rows.append((label, *numbers, *_tested(test, label, grave)))
    columns = (
        Column("point", "", "", "left"),
        *(Column(f"d{axis}", told, words[0]) for axis in AXES),
        *(Column(f"s(d{axis})", told, words[1]) for axis in AXES),
        Column("T", "", "test statistic of the point: its differences in their joint standard deviation, squared, per coordinate"),
        Column("p", "", "probability of a T as large if the point were right"),
        Column("decision", "", "", "left"),
    )
    note = (
        [] if test is None else [say("Law under the null hypothesis: {law}, level {alpha}.", law=test.law_name, alpha=f"{test.alpha:.3g}")]
    )
    note += [test.note] if test is not None and test.note else []
    note.append(first(len(points), MOST_ROWS, where))
    return DataTable(caption, columns, tuple(rows), " ".join(n for n in note if n))


def _accuracy(analysis: Analysis, e: Estimates, predicted: Floats) -> DataTable:
    """RMSE of the check points with its interval, beside what the adjustment predicts."""
    unit = analysis.adjustment.network.unit
    d = np.stack([v for v, _ in _by_point(e, predicted).values()])
    s = np.stack([v for _, v in _by_point(e, predicted).values()])
    told, factor = finer(unit, d)
    decimals = decimals_for(np.abs(d[np.isfinite(d)]) * factor, 3)
    rows: list[tuple[str, ...]] = []
    sets: list[tuple[str, list[int]]] = [(axis, [k]) for k, axis in enumerate(AXES)]
    sets += [("horizontal", [0, 1]), ("3D", [0, 1, 2])]
    for name, axes in sets:
        whole = np.isfinite(d[:, axes]).all(axis=1)
        n = int(whole.sum())
        if not n:
            continue
        values, sigma = d[whole][:, axes], s[whole][:, axes]
        rmse = float(np.sqrt((values**2).sum(axis=1).mean()))
        expected = float(np.sqrt((sigma**2).sum(axis=1).mean()))
        cells = [name, str(n), fixed(float(values.mean()) * factor, decimals) if len(axes) == 1 else "", fixed(rmse * factor, decimals)]
        if len(axes) == 1:
            low, high = np.sqrt(n / stats.chi2.ppf([0.975, 0.025], n))
            cells.append(f"{fixed(rmse * low * factor, decimals)}..{fixed(rmse * high * factor, decimals)}")
        else:
            cells.append("")
        rows.append((*cells, fixed(expected * factor, decimals), significant(rmse / expected, 3) if expected > 0.0 else MISSING))
    columns = (
        Column("of", "", "", "left"),
        Column("points", "", "number of check points"),
        Column("mean", told, "mean difference: a systematic part"),
        Column("RMSE", told, "root mean square of the differences adjusted - given"),
        Column("95 % interval", told, "of the RMSE, from so many points: RMSE sqrt(n / chi-square)"),
        Column("predicted", told, "root mean square of the predicted standard deviations, adjustment and survey"),
        Column("RMSE / predicted", "", "1 = as accurate as predicted"),
    )
    note = "The interval assumes independent normal errors."
    if len(d) < 30:
        note += " " + say("Fewer than 30 check points ({count}): the ASPRS standards (2nd edition) ask to say so.", count=len(d))
    return DataTable("Accuracy from check points", columns, tuple(rows), note)


def _joint(test: TestResult | None, words: str) -> list[Block]:
    if test is None:
        return []
    critical = test.critical[1] if isinstance(test.critical, tuple) else test.critical
    row = (
        words,
        fixed(float(test.statistic), 2),
        test.law_name,
        fixed(critical, 2),
        probability(float(test.p_value)),
        Cell("rejected", "bad") if test.rejected else Cell("not rejected", "good"),
    )
    columns = (
        Column("all together", "", "", "left"),
        Column("T", "", "test statistic per coordinate"),
        Column("law", "", "under the null hypothesis", "left"),
        Column("limit", "", f"critical value at level {test.alpha:.3g}"),
        Column("p", "", "probability of a T as large"),
        Column("decision", "", "", "left"),
    )
    return [DataTable("Joint test", columns, (row,), test.note)]


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged:
        return None
    a = analysis.adjustment
    scale = a.scale(analysis.options.sigma)
    blocks: list[Block] = []
    e: Any = analysis.evidence.check
    if e is not None and len(e.values):
        own = scale**2 * np.diag(e.cofactors)
        predicted = np.sqrt(own + (0.0 if e.reference_covariance is None else np.diag(e.reference_covariance)))
        words = (
            "adjusted - given",
            say("predicted standard deviation of the difference, adjustment ({scaling}) and survey", scaling=scaling(analysis)),
        )
        blocks += _joint(result_of(analysis, "check_points"), "check points agree with the survey")
        blocks.append(_accuracy(analysis, e, predicted))
        blocks.append(_differences(analysis, "check", e, predicted, words, "result.json"))
    e = analysis.evidence.control
    if e is not None and len(e.values):
        words = ("residual v = adjusted - given", say("standard deviation of this residual, {scaling}", scaling=scaling(analysis)))
        deviations = scale * np.sqrt(np.maximum(np.diag(e.cofactors), 0.0))
        blocks += _joint(result_of(analysis, "control_points"), "control coordinates are right")
        blocks.append(_differences(analysis, "control", e, deviations, words, "tables/observations.csv"))
    return blocks or None


CHECK_CONTROL = SectionMaker(90, "check-control", "Control and check points", _build)
