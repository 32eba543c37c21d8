"""Audit: the solution of the source as it stands, and how far it is from the rigorous minimum."""

from __future__ import annotations

import numpy as np

from baarda.procedures.audit import suspected
from baarda.procedures.testing import Analysis
from baarda.report.sections._numbers import fixed, names, plural, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Items, Paragraph, SectionMaker, Tone, say

MOST = 20
_FAR, _AWAY = 1.0, 0.1  # sigmas: farther than the data can tell; visible but harmless


def _tone(size: float) -> Tone:
    return "bad" if size > 3.0 * _FAR else "warn" if size > _FAR else "good"


def _build(analysis: Analysis) -> list[Block] | None:
    a = analysis.audit
    if a is None:
        return None
    if not a.converged:
        text = say(
            "The solution of the source was evaluated as it stands: v'Pv = {value}, image residuals {rms} px rms per coordinate. No "
            "rigorous minimum was found from it, so nothing can be said of its distance.",
            value=significant(a.objective, 5),
            rms=significant(a.image_rms[0], 4),
        )
        return [Paragraph(text, "bad")]
    distance = a.distance
    # a few unknowns far away do not show in the mean over thousands of points: the farthest group judges
    group, _, rms, _, _ = max(a.by_group(), key=lambda g: g[2])
    far = max(distance, rms)
    words = (
        say("It is the minimum within what the observations can tell.")
        if far <= _AWAY
        else say("It lies beside the minimum, within what the observations can tell.")
        if far <= _FAR
        else say(
            "Its unknowns of the kind {group} lie {rms} sigma (rms) from there: it is not the least-squares solution of these observations "
            "with these weights and unknowns.",
            group=group,
            rms=significant(rms, 3),
        )
    )
    intro = say(
        "The solution of the source as it stands, no step taken: v'Pv = {value}, {excess} % above the minimum {least}; image residuals "
        "{rms} px rms per coordinate, {rms_least} px at the minimum. Its distance from there is {distance} sigma per unknown. {words}",
        value=significant(a.objective, 5),
        excess=significant(100.0 * a.excess, 3),
        least=significant(a.adjustment.objective, 5),
        rms=significant(a.image_rms[0], 4),
        rms_least=significant(a.image_rms[1], 4),
        distance=significant(distance, 3),
        words=words,
    )
    return [Paragraph(intro, _tone(far)), _groups(analysis), _largest(analysis), *_hidden(analysis)]


def _groups(analysis: Analysis) -> DataTable:
    assert analysis.audit is not None  # noqa: S101 - the caller looked
    rows = tuple(
        (group, str(count), fixed(rms, 3), Cell(fixed(largest, 2), _tone(largest)), at)
        for group, count, rms, largest, at in analysis.audit.by_group()
    )
    columns = (
        Column("unknowns", "", "", "left"),
        Column("number"),
        Column("rms", "sigma", "root mean square of (rigorous - source) / standard deviation a posteriori"),
        Column("largest", "sigma", "largest of the absolute values"),
        Column("at", "", "", "left"),
    )
    return DataTable("Distance from the rigorous minimum", columns, rows)


def _largest(analysis: Analysis) -> DataTable:
    assert analysis.audit is not None  # noqa: S101 - the caller looked
    t = analysis.audit.differences
    ratio = np.abs(np.nan_to_num(np.asarray(t["ratio"], dtype=float)))
    worst = np.argsort(-ratio, kind="stable")[:MOST]
    rows = tuple(
        (
            str(t["name"][i]),
            str(t["unit"][i]),
            significant(float(t["difference"][i]), 4),
            significant(float(t["sigma"][i]), 3),
            Cell(fixed(float(t["ratio"][i]), 2), _tone(float(ratio[i]))),
        )
        for i in worst.tolist()
    )
    columns = (
        Column("unknown", "", "", "left"),
        Column("unit", "", "", "left"),
        Column("rigorous - source"),
        Column("sigma", "", "standard deviation a posteriori of the rigorous adjustment"),
        Column("ratio", "sigma"),
    )
    note = say("The {count} farthest of {total}; rotations are increments about the camera axes.", count=len(rows), total=len(t))
    return DataTable("Unknowns farthest from the minimum", columns, rows, note, folded=True)


def _hidden(analysis: Analysis) -> list[Block]:
    """What reports of other programs leave out."""
    a = analysis.audit
    assert a is not None  # noqa: S101 - the caller looked
    found = []
    rows = suspected(a)
    total = len(a.residuals)
    found.append(
        say("Data snooping of the solution as it stands rejects {count} of {total} observations.", count=len(rows), total=total)
        if len(rows)
        else say("Data snooping of the solution as it stands rejects none of {total} observations.", total=total)
    )
    if a.behind:
        found.append(say("{rays} behind the camera.", rays=plural(a.behind, "ray leads to a point", "rays lead to points")))
    share = a.conditional_share
    if share is not None:
        found.append(
            say(
                "Standard deviations of points with all cameras held fixed (conditional ones, which programs often print) are {median} "
                "of the true ones in the median, {least} in the worst case.",
                median=fixed(share[0], 2),
                least=fixed(share[1], 2),
            )
        )
    s0 = a.adjustment.sigma0
    found.append(
        say(
            "The variance factor multiplies all standard deviations that were computed with the a-priori sigmas by {s0}.",
            s0=significant(s0, 3),
        )
    )
    aside = int(a.adjustment.aside.sum())
    if aside:
        found.append(
            say("{points} set aside here: too few rays.", points=plural(aside, "point of the source is", "points of the source are"))
        )
    if a.unknown:
        found.append(say("Not in the solution of the source, found here: {names}.", names=names(a.unknown, 8)))
    left = [t for t in a.adjustment.network.assumptions if "left out" in t]
    return [
        Items(say("What a report may hide"), tuple(found)),
        *([Items(say("Left out when the source was read"), tuple(left))] if left else []),
    ]


AUDIT = SectionMaker(22, "audit", "Audit of the source's solution", _build)
