"""Control and check points against the survey: differences, predicted precision, tests, and accuracy figures with their intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.hypotheses.base import Estimates, TestResult
from baarda.network import AXES
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import MOST_ROWS, deviations_of, first, result_of, scaling
from baarda.report.sections._numbers import MISSING, decimals_for, finer, fixed, plural, probability, significant
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


def _accuracy(analysis: Analysis) -> list[Block]:
    """RMSE of the check points by axis with its interval, beside what the adjustment predicts, and the test of each axis."""
    test = result_of(analysis, "check_axis")
    if test is None:
        return []
    unit, k = analysis.adjustment.network.unit, test.details
    told, factor = finer(unit, k["rms"])
    decimals = decimals_for(np.array(k["rms"]) * factor, 3)
    p, rejected = np.asarray(test.p_value), np.asarray(test.rejected)
    rows: list[tuple[str | Cell, ...]] = []
    for i, name in enumerate(test.labels):
        low, high = k["interval"][i]
        ratio = k["rms"][i] / k["predicted"][i] if k["predicted"][i] > 0.0 else float("nan")
        numbers = (
            name,
            str(k["points"][i]),
            "" if k["mean"][i] is None else fixed(k["mean"][i] * factor, decimals),
            fixed(k["rms"][i] * factor, decimals),
            f"{fixed(low * factor, decimals)}..{fixed(high * factor, decimals)}",
            fixed(k["predicted"][i] * factor, decimals),
            significant(ratio, 3) if np.isfinite(ratio) else MISSING,
            fixed(float(np.asarray(test.statistic)[i]), 2),
            probability(float(p[i])),
        )
        rows.append((*numbers, Cell("rejected", "warn") if rejected[i] else Cell("agrees", "good")))
    columns = (
        Column("of", "", "Z is the vertical; horizontal and 3D per point", "left"),
        Column("points", "", "number of check points"),
        Column("mean", told, "mean difference: a systematic part"),
        Column("RMSE", told, "root mean square of the differences adjusted - given, per point"),
        Column("95 % interval", told, "of the RMSE, from so many points with their predicted correlations"),
        Column("predicted", told, "root mean square of the predicted standard deviations, adjustment and survey"),
        Column("RMSE / predicted", "", "1 = as accurate as predicted"),
        Column("T", "", "test statistic of these coordinates together, per coordinate"),
        Column("p", "", "probability of a T as large"),
        Column("decision", "", "", "left"),
    )
    count = max(k["points"])
    note = ""
    if count < 3:
        note = say("{count}: no statement about the whole block can rest on so few.", count=plural(count, "check point"))
    elif count < 30:
        note = say("Fewer than 30 check points ({count}): the ASPRS standards (2nd edition) ask to say so.", count=count)
    return [DataTable("Accuracy from check points", columns, tuple(rows), note)]


def _prior_and_posterior(analysis: Analysis, e: Estimates) -> list[Block]:
    """Control coordinates: what was given, what the adjustment adds, and how much of an error would show."""
    if e.reference_covariance is None:
        return []
    scale = analysis.adjustment.scale(analysis.options.sigma)
    prior, qvv = np.diag(e.reference_covariance), np.diag(e.cofactors)
    posterior = prior - qvv
    by_prior, by_posterior = (_by_point(e, scale * deviations_of(q, prior)) for q in (prior, posterior))
    shares = _by_point(e, qvv / prior)
    unit, factor = finer(analysis.adjustment.network.unit, np.sqrt(prior) * scale)
    decimals = decimals_for(np.sqrt(prior) * scale * factor, 3)
    rows: list[tuple[str | Cell, ...]] = []
    for label in list(by_prior)[:MOST_ROWS]:
        before, after = (table[label][1] * factor for table in (by_prior, by_posterior))
        numbers = [fixed(float(v), decimals) for v in (*before, *after)]
        rows.append((label, *numbers, *(fixed(float(v), 3) for v in shares[label][1])))
    columns = (
        Column("point", "", "", "left"),
        *(
            Column(say("prior s{axis}", axis=axis), unit, say("given standard deviation, {scaling}", scaling=scaling(analysis)))
            for axis in AXES
        ),
        *(Column(say("posterior s{axis}", axis=axis), unit, "of the adjusted coordinate") for axis in AXES),
        *(
            Column(f"r {axis}", "", "redundancy number: share of an error of the given coordinate that shows in its residual")
            for axis in AXES
        ),
    )
    note = first(len(by_prior), MOST_ROWS, "tables/observations.csv")
    return [DataTable("Control: prior and posterior", columns, tuple(rows), note, folded=True)]


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
        Column("limit", "", say("critical value at level {alpha}", alpha=f"{test.alpha:.3g}")),
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
        blocks += _accuracy(analysis)
        blocks.append(_differences(analysis, "check", e, predicted, words, "result.json"))
    e = analysis.evidence.control
    if e is not None and len(e.values):
        words = ("residual v = adjusted - given", say("standard deviation of this residual, {scaling}", scaling=scaling(analysis)))
        variances = np.diag(e.cofactors)
        whole = variances if e.reference_covariance is None else np.diag(e.reference_covariance)
        deviations = scale * deviations_of(variances, whole)
        blocks += _joint(result_of(analysis, "control_points"), "control coordinates are right")
        blocks.append(_differences(analysis, "control", e, deviations, words, "tables/observations.csv"))
        blocks += _prior_and_posterior(analysis, e)
    return blocks or None


CHECK_CONTROL = SectionMaker(90, "check-control", "Control and check points", _build)
