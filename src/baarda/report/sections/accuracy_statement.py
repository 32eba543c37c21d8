"""Accuracy statement: the check points and test lengths in the words of the standards that clients ask for, with their conditions."""

from __future__ import annotations

import numpy as np

from baarda.procedures.testing import Analysis
from baarda.report import drawings
from baarda.report.accuracy import ENOUGH_ASPRS, ENOUGH_NSSDA, Accuracy, Lengths, from_analysis, lengths_of
from baarda.report.sections._facts import MOST_ROWS, first
from baarda.report.sections._numbers import MISSING, decimals_for, finer, fixed, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, Paragraph, SectionMaker, Tone, say
from baarda.report.translation import tr

_NOTABLE = 0.25  # of the RMSE: a mean error beyond asks to be looked into (ASPRS Edition 2)
_CONDITIONS = {
    "points": "fewer than 20 check points",
    "equal_axes": "RMSE in X and Y too different",
    "unbiased": "mean differs from zero",
    "normal": "differences not normal",
}


def _statement(a: Accuracy, told: str, factor: float) -> list[Block]:
    decimals = decimals_for(np.array([a.rmse_h_fit, a.rmse_v_fit]) * factor, 3)
    fields = {
        "h": fixed(a.rmse_h * factor, decimals),
        "v": fixed(a.rmse_v * factor, decimals),
        "nh": a.horizontal_points,
        "nv": a.vertical_points,
        "unit": told,
        "enough": ENOUGH_ASPRS,
    }
    if min(a.horizontal_points, a.vertical_points) >= ENOUGH_ASPRS:
        text, tone = (
            "Tested by the ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2: positional accuracy found to be "
            "RMSE_H = {h} {unit} from {nh} and RMSE_V = {v} {unit} from {nv} check points.",
            "info",
        )
    else:
        text, tone = (
            "The ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2, call for at least {enough} check points; this "
            "test was made with only {nh} horizontal and {nv} vertical ones: RMSE_H = {h} {unit}, RMSE_V = {v} {unit}. It "
            "is no statement of "
            "an accuracy class.",
            "warn",
        )
    chosen: Tone = "warn" if tone == "warn" else "info"
    blocks: list[Block] = [Paragraph(say(text, **fields), chosen)]
    if not a.survey_stated:
        blocks.append(
            Paragraph(tr("The survey states no precision of the check points: its error is counted as zero in these figures."), "warn")
        )
    elif any(s > 0.5 * f for s, f in zip(a.survey, (a.rmse_h_fit, a.rmse_v_fit), strict=True)):
        text = (
            "The survey of the check points ({h} {unit} horizontal, {v} {unit} vertical) is not twice as accurate as what it tests, as the "
            "standards ask."
        )
        blocks.append(
            Paragraph(say(text, h=fixed(a.survey[0] * factor, decimals), v=fixed(a.survey[1] * factor, decimals), unit=told), "warn")
        )
    biased = [k for k in range(3) if a.points[k] > 1 and abs(a.mean[k]) > _NOTABLE * a.rmse[k]]
    if biased:
        text = (
            "The mean difference exceeds 25 % of the RMSE: {which}. ASPRS asks to look into mean errors above 25 % of the "
            "RMSE of the class; "
            "without a class the RMSE found stands for it."
        )
        which = ", ".join(f"{'XYZ'[k]} {fixed(a.mean[k] * factor, decimals)} {told} (p = {fixed(a.mean_p[k], 3)})" for k in biased)
        blocks.append(Paragraph(say(text, which=which), "warn"))
    return blocks


def _held(conditions: dict[str, bool | None]) -> Cell:
    failed = [tr(_CONDITIONS[name]) for name, held in conditions.items() if held is False]
    if failed:
        return Cell(say("not held: {what}", what="; ".join(failed)), "warn")
    return Cell(tr("held"), "good") if None not in conditions.values() else Cell(tr("cannot be judged"), "warn")


def _figures(a: Accuracy, told: str, factor: float) -> DataTable:
    decimals = decimals_for(np.array([a.rmse_h_fit, a.rmse_v_fit]) * factor, 3)
    across, up = _held(a.conditions((0, 1))), _held(a.conditions((2,)))
    h, v = str(a.horizontal_points), str(a.vertical_points)
    enough = [Cell(tr("held"), "good") if n >= ENOUGH_ASPRS else Cell(tr("not held: fewer than 30 check points"), "warn")
              for n in (a.horizontal_points, a.vertical_points)]  # fmt: skip
    worse = enough[int(np.argmin((a.horizontal_points, a.vertical_points)))]
    told_survey = "sqrt(fit² + survey²)"
    rows = [
        ("RMSE_H, fit", a.rmse_h_fit, h, "sqrt(RMSE_X² + RMSE_Y²)", Cell("")),
        ("RMSE_H, survey", a.survey[0], h, "rms of sqrt(sX² + sY²)", Cell("")),
        ("RMSE_H", a.rmse_h, h, told_survey, enough[0]),
        ("RMSE_V, fit", a.rmse_v_fit, v, "RMSE_Z", Cell("")),
        ("RMSE_V, survey", a.survey[1], v, "rms of sZ", Cell("")),
        ("RMSE_V", a.rmse_v, v, told_survey, enough[1]),
        ("RMSE_3D", a.rmse_3d, "", "sqrt(RMSE_H² + RMSE_V²)", worse),
        ("NSSDA horizontal, 95 %", a.radius_95, h, "2.4477 (RMSE_X + RMSE_Y) / 2", across),
        ("NSSDA vertical, 95 %", a.vertical_95, v, "1.9600 RMSE_Z", up),
        ("CE90", a.radius_90, h, "2.1460 (RMSE_X + RMSE_Y) / 2", across),
        ("LE90", a.vertical_90, v, "1.6449 RMSE_Z", up),
    ]
    shown = tuple((name, fixed(x * factor, decimals), n, how, cell) for name, x, n, how, cell in rows)
    columns = (
        Column("figure", "", "H horizontal, V vertical; fit: against the check points; survey: their own error", "left"),
        Column("value", told),
        Column("points", "", "number of check points"),
        Column("definition", "", "", "left"),
        Column("conditions", "", "under which the figure means what its name says", "left"),
    )
    note = say(
        "RMSE_H, RMSE_V, RMSE_3D: ASPRS Positional Accuracy Standards, Edition 2 (2023). NSSDA: FGDC-STD-007.3-1998; "
        "its radii and CE90, LE90 "
        "leave the survey's error out and hold for at least {enough} points, unbiased normal differences, and a ratio of the lesser to the "
        "larger RMSE in X and Y of 0.6 at least (here {ratio}; below, no radius is given). Bias and normality are tested at level 0.05.",
        enough=ENOUGH_NSSDA,
        ratio=significant(a.ratio, 2),
    )
    return DataTable("Accuracy in the terms of the standards", columns, shown, note)


def _vectors(analysis: Analysis, unit: str) -> list[Block]:
    points = analysis.adjustment.network.points
    at = np.flatnonzero(analysis.adjustment.judges & np.isfinite(points.given).any(axis=1))
    d = (points.coordinates - points.given)[at]
    if not len(at) or not np.isfinite(d).any():
        return []
    told, factor = finer(unit, d)
    svg, arrow = drawings.check_vectors(points.coordinates, points.coordinates[at], d * factor, [points.labels[i] for i in at], unit, told)
    length = np.sqrt(np.nansum(d**2, axis=1)) * factor
    most = int(np.argmax(length))
    caption = say(
        "Differences adjusted - given of {count} check points over the plan of all points: horizontal as arrows, vertical as bars (up: "
        "adjusted too high). The largest is {most} {unit} at point {name}. The scale arrow is {arrow:g} {unit} long.",
        count=len(at),
        most=significant(float(length[most]), 3),
        unit=told,
        name=points.labels[at[most]],
        arrow=arrow,
    )
    return [
        Figure(
            "check-vectors",
            "Check points: differences from the survey",
            caption,
            say("Arrows over a plan. {caption}", caption=caption),
            svg,
        )
    ]


def _lengths(lengths: Lengths, unit: str) -> list[Block]:
    told, factor = finer(unit, lengths.deviations)
    decimals = decimals_for(lengths.deviations * factor, 3)
    place = decimals_for(lengths.sigmas, 2) if np.isfinite(lengths.sigmas).any() else 4
    rows = [
        (p, q, fixed(x, place), fixed(d * factor, decimals), fixed(s * factor, decimals), significant(d / s, 3) if s > 0 else MISSING)
        for p, q, x, d, s in zip(lengths.starts, lengths.ends, lengths.given, lengths.deviations, lengths.sigmas, strict=True)
    ]
    columns = (
        Column("from", "", "", "left"),
        Column("to", "", "", "left"),
        Column("length", unit, "calibrated length"),
        Column("deviation", told, "measured - calibrated length; measured without this length itself"),
        Column("s", told, "predicted standard deviation of the deviation, measurement and calibration"),
        Column("deviation / s", "", "beyond 2 for one length in twenty"),
    )
    held = lengths.conditions()
    seen = int(np.isfinite(lengths.deviations).sum())
    note = say(
        "Length deviation by VDI/VDE 2634 part 1, of each length left out of its own measurement; {missing} of {count} are controlled by "
        "nothing else.",
        missing=len(rows) - seen,
        count=len(rows),
    )
    if lengths.largest is not None:
        note += " " + say(
            "The largest is {most} {unit}.", most=fixed(abs(lengths.deviations[lengths.largest]) * factor, decimals), unit=told
        )
    if not all(held.values()):
        note += " " + say(
            "It is no acceptance test: the guideline asks for seven lines of at least five lengths each (35; here {seen}), "
            "the longest at least "
            "two thirds of the space diagonal ({share} of {span} {unit}), none of them used for the scale.",
            seen=seen,
            share=significant(float(np.max(lengths.given) / lengths.span), 2),
            span=significant(lengths.span, 3),
            unit=unit,
        )
    note += " " + first(len(rows), MOST_ROWS, "result.json")
    blocks: list[Block] = [DataTable("Length deviations", columns, tuple(rows[:MOST_ROWS]), note.strip())]
    if seen >= 3:
        svg = drawings.length_deviations(lengths.given, lengths.deviations * factor, lengths.sigmas * factor, unit, told)
        caption = say(
            "Length deviation of {count} lengths over their length, with the interval of twice the predicted standard deviation.",
            count=seen,
        )
        blocks.append(
            Figure("length-deviations", "Length deviations over length", caption, say("Marks with bars. {caption}", caption=caption), svg)
        )
    return blocks


def _build(analysis: Analysis) -> list[Block] | None:
    a, lengths = from_analysis(analysis), lengths_of(analysis)
    unit = analysis.adjustment.network.unit
    blocks: list[Block] = []
    if a is not None:
        told, factor = finer(unit, [a.rmse_h_fit, a.rmse_v_fit])
        blocks += [*_statement(a, told, factor), _figures(a, told, factor), *_vectors(analysis, unit)]
    elif lengths is not None:
        blocks.append(Paragraph(tr("No check points: ASPRS and NSSDA figures cannot be stated.")))
    if lengths is not None:
        blocks += _lengths(lengths, unit)
    return blocks or None


ACCURACY_STATEMENT = SectionMaker(95, "accuracy-statement", "Accuracy statement", _build)
