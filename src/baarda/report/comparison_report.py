"""A comparison of two adjustments told: result folder, JSON, and the verdict in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.formats.folder import Mark
from baarda.hypotheses.base import TestResult
from baarda.network import AXES, Table
from baarda.observations import ImagePoints
from baarda.procedures.comparison import Comparison, Epoch
from baarda.report import page
from baarda.report.contents import Contents, plain, software, write
from baarda.report.sections._numbers import decimals_for, finer, fixed, names, p_stated, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, Section, Sentence, Tone, Verdict, say, told, translated
from baarda.report.translation import language, tr

Floats = NDArray[np.float64]

SCHEMA = "baarda.comparison/1"
MARK = Mark("result.json", "baarda.comparison/", ("report.html", "result.json", "run.json", "tables", "figures"))
_MOST = 200


def sentences(c: Comparison) -> list[Sentence]:
    """Return the verdict."""
    out = [Sentence("Datum", _datum(c), "info", "epochs")]
    if c.dependent:
        size = _length(c.differences)
        i = int(np.argmax(size))
        unit, factor = finer(c.first.network.unit, size)
        shares = np.divide(np.abs(c.differences), c.sigmas, out=np.full(c.differences.shape, np.nan), where=c.sigmas > 0.0)
        text = say(
            "Both adjust the same {what}, so their differences are no random sample and nothing is tested: root mean square "
            "{rms} {unit}, largest {largest} {unit} (point {label}), at most {share} standard deviations of the first.",
            what=tr("image points" if any(isinstance(g, ImagePoints) for g in c.first.observations) else "observations"),
            rms=significant(float(np.sqrt((size**2).mean())) * factor),
            unit=unit,
            largest=significant(float(size[i]) * factor),
            label=c.labels[i],
            share=significant(float(np.nanmax(shares))),
        )
        out.append(Sentence("Differences", text, "info", "points"))
        return out + _noted(c)
    if c.variance_ratio is not None:
        t = c.variance_ratio
        low, high = t.critical if isinstance(t.critical, tuple) else (0.0, t.critical)
        text = say(
            "Variance factors {a} and {b}: ratio {ratio}, limits {low} and {high}, p {p}: the epochs are {word} precise.",
            a=significant(c.first.variance_factor),
            b=significant(c.second.variance_factor),
            ratio=significant(float(t.statistic)),
            low=significant(low),
            high=significant(high),
            p=p_stated(t.p_value),
            word=tr("not equally" if t.rejected else "equally"),
        )
        out.append(Sentence("Precision", text, "warn" if t.rejected else "good", "tests"))
    if c.congruence is not None:
        t = c.congruence
        text = say(
            "Congruence of {count} points: T = {statistic}, limit {critical} ({law}), p {p}: {word}.",
            count=len(c.labels),
            statistic=significant(float(t.statistic)),
            critical=significant(float(t.critical)) if not isinstance(t.critical, tuple) else "",
            law=t.law_name,
            p=p_stated(t.p_value),
            word=tr("points have moved, or a model is wrong" if t.rejected else "no movement is proven"),
        )
        out.append(Sentence("Congruence", text, "bad" if t.rejected else "good", "tests"))
    found = c.localisation
    if found is not None:
        at = [c.labels.index(p) for p in found.moved]
        unit, factor = finer(c.first.network.unit, _length(c.differences[at]) if at else [])
        far = [f"{p} ({significant(float(_length(c.differences[[i]])[0]) * factor)} {unit})" for p, i in zip(found.moved, at, strict=True)]
        text = say(
            "{count} moved: {names}; {stable} held stable {word}.",
            count=plural(len(found.moved), "point"),
            names=names(far, 10),
            stable=plural(len(found.stable), "point"),
            word=tr("are congruent" if found.decided else "are still not congruent"),
        )
        out.append(Sentence("Moved points", text, "bad", "points"))
    return out + _noted(c)


def _noted(c: Comparison) -> list[Sentence]:
    return [Sentence("Note", told(text), "warn") for text in c.notes]


def _datum(c: Comparison) -> str:
    if not c.freedoms:
        return say("{count} common points are compared in the datum that both have.", count=len(c.labels))
    return say(
        "{count} common points are compared after an S-transformation to one datum: {freedoms} are taken out.",
        count=len(c.labels),
        freedoms=", ".join(tr(f) for f in c.freedoms),
    )


def verdict(c: Comparison) -> list[str]:
    """Return the outcome in plain sentences.

    Parameters
    ----------
    c : Comparison

    Returns
    -------
    list of str

    Examples
    --------
    >>> from baarda.procedures.comparison import compare, epoch
    >>> from baarda.procedures.synthetic import ring
    >>> one = epoch(ring(5, points=12).network)
    >>> verdict(compare(one, one))[1][:31]
    'Both adjust the same image poin'
    """
    return [page.printable(s.text) for s in sentences(c)]


def _length(differences: Floats) -> Floats:
    """Return the lengths of differences over the coordinates that are compared."""
    return np.asarray(np.sqrt(np.nansum(differences**2, axis=1)))


def _rms(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if len(known) else None


# ---- sections ----
def sections(c: Comparison) -> list[Section]:
    """Return the sections of the report."""
    made = [Section("verdict", "Verdict", (Verdict(tuple(sentences(c))),)), Section("epochs", "The two adjustments", tuple(_epochs(c)))]
    if c.congruence is not None:
        made.append(Section("tests", "Tests", tuple(_tests(c))))
    made.append(Section("points", "Differences of the points", (_points(c),)))
    return [translated(s) for s in made]


def _epochs(c: Comparison) -> list[Block]:
    rows = []
    for word, e in (("first", c.first), ("second", c.second)):
        a = e.adjustment
        rows.append(
            (
                word,
                e.network.path or e.network.name or tr("in memory"),
                "as it is" if e.as_it_is else "adjusted",
                str(a.count),
                str(a.numbering.count),
                fixed(e.redundancy, 0),
                fixed(float(np.sqrt(e.variance_factor)), 4),
                a.datum.text,
            )
        )
    columns = (
        Column("", "", "", "left"),
        Column("source", "", "", "left"),
        Column("values", "", "adjusted here, or those of the source", "left"),
        Column("n", "", "observations"),
        Column("u", "", "unknowns"),
        Column("r", "", "redundancy"),
        Column("s0", "", "standard deviation of unit weight"),
        Column("datum", "", "", "left"),
    )
    out: list[Block] = [DataTable("Adjustments", columns, tuple(rows))]
    t = c.transformation
    if t is not None:
        angle = float(np.degrees(np.arccos(np.clip((np.trace(t.rotation) - 1.0) / 2.0, -1.0, 1.0))))
        shift = float(np.linalg.norm(t.translation))
        text = say(
            "The second was brought near the first by a similarity transformation: scale {scale}, rotation {angle} degrees, "
            "shift {shift} {unit}.",
            scale=f"{t.scale:.9g}",
            angle=significant(angle),
            shift=significant(shift),
            unit=c.first.network.unit,
        )
        out.append(Paragraph(text))
    return out


def _row(words: str, t: TestResult) -> tuple[str | Cell, ...]:
    critical = "..".join(significant(float(x)) for x in np.atleast_1d(np.asarray(t.critical)))
    decision = Cell("rejected", "bad") if t.rejected else Cell("not rejected", "good")
    return words, significant(float(t.statistic)), t.law_name, critical, probability(float(t.p_value)), decision


def _tests(c: Comparison) -> list[Block]:
    rows = [_row("equal variance factors", c.variance_ratio)] if c.variance_ratio is not None else []
    if c.congruence is not None:
        rows.append(_row("congruence of all points", c.congruence))
    if c.localisation is not None:
        for moved, t in zip(c.localisation.moved, c.localisation.steps[1:], strict=False):
            rows.append(_row(say("congruence without {point}", point=moved), t))
    columns = (
        Column("hypothesis", "", "", "left"),
        Column("T", "", "test statistic"),
        Column("law", "", "under the null hypothesis", "left"),
        Column("limit", "", "critical value"),
        Column("p", "", "probability of a T as large"),
        Column("decision", "", "", "left"),
    )
    note = c.congruence.note if c.congruence is not None else ""
    return [DataTable("Tests", columns, tuple(rows), note)]


def _points(c: Comparison) -> DataTable:
    unit, factor = finer(c.first.network.unit, c.sigmas)
    decimals = decimals_for(c.sigmas * factor, 2)
    test = c.points
    size = _length(c.differences)
    order = np.argsort(-(size if test is None else np.asarray(test.statistic)), kind="stable")[:_MOST]
    moved = set() if c.localisation is None else set(c.localisation.moved)
    rows: list[tuple[str | Cell, ...]] = []
    for i in order:
        label = c.labels[i]
        numbers = [fixed(float(v) * factor, decimals) for v in (*c.differences[i], *c.sigmas[i], size[i])]
        row: tuple[str | Cell, ...] = (label, *numbers)
        if test is not None:
            j = test.labels.index(label)
            state = Cell("moved", "bad") if label in moved else Cell("stable", "good")
            row += (significant(float(np.asarray(test.statistic)[j])), probability(float(np.asarray(test.p_value)[j])), state)
        rows.append(row)
    columns = (
        Column("point", "", "", "left"),
        *(Column(f"d{a}", unit, "second - first, tied to the stable points") for a in AXES),
        *(Column(f"s(d{a})", unit, "standard deviation of this difference") for a in AXES),
        Column("length", unit, "of the difference"),
    )
    if test is not None:
        columns += (
            Column("T", "", "test of the point against all others, none of them released"),
            Column("p", "", "probability of a T as large"),
            Column("found", "", "by releasing one point after the other until the rest is congruent", "left"),
        )
    note = "" if len(c.labels) <= _MOST else say("The first {most} of {count} points; all: tables/points.", most=_MOST, count=len(c.labels))
    return DataTable("Differences", columns, tuple(rows), note)


# ---- JSON, tables, folder ----
def result_json(c: Comparison) -> dict[str, Any]:
    """Return the content of `result.json`; its schema is "baarda.comparison/1".

    Parameters
    ----------
    c : Comparison

    Returns
    -------
    dict
        JSON-compatible; numbers that do not exist are None.
    """
    tests = [t for t in (c.variance_ratio, c.congruence) if t is not None]
    document = {
        "schema": SCHEMA,
        "first": _epoch(c.first),
        "second": _epoch(c.second),
        "counts": {"points": len(c.labels)},
        "freedoms": list(c.freedoms),
        "transformation": None
        if c.transformation is None
        else {"scale": c.transformation.scale, "rotation": c.transformation.rotation, "translation": c.transformation.translation},
        "dependent": c.dependent,
        "variance_factor": c.variance_factor,
        "redundancy": c.redundancy,
        "tests": [_test(t) for t in tests],
        "localisation": None
        if c.localisation is None
        else {"moved": list(c.localisation.moved), "stable": list(c.localisation.stable), "decided": c.localisation.decided},
        "rms": {axis.lower(): _rms(c.differences[:, k]) for k, axis in enumerate(AXES)},
        "rejected": c.rejected,
        "notes": list(c.notes),
        "verdict": verdict(c),
        "software": software(),
    }
    return dict(plain(document))


def _epoch(e: Epoch) -> dict[str, Any]:
    n = e.network
    return {
        "path": n.path,
        "format": n.format,
        "sha256": n.sha256,
        "as_it_is": e.as_it_is,
        "observations": e.adjustment.count,
        "unknowns": e.adjustment.numbering.count,
        "redundancy": e.redundancy,
        "variance_factor": e.variance_factor,
        "datum": {"name": e.adjustment.datum.name, "text": e.adjustment.datum.text},
    }


def _test(t: TestResult) -> dict[str, Any]:
    out = {"name": t.name, "null": t.null, "statistic": t.statistic, "df": list(t.df), "law": t.law_name, "alpha": t.alpha}
    return {**out, "critical": t.critical, "p_value": t.p_value, "rejected": t.rejected, **({"note": t.note} if t.note else {})}


def tables(c: Comparison) -> dict[str, Table]:
    """Return the tables of the result folder by name."""
    columns: dict[str, Any] = {"point": np.array(c.labels, dtype=object)}
    for name, values in (("", c.coordinates), ("d", c.differences), ("sd", c.sigmas)):
        columns |= {f"{name}{axis}": values[:, k] for k, axis in enumerate(AXES)}
    if c.points is not None:
        columns |= {"statistic": np.asarray(c.points.statistic), "p_value": np.asarray(c.points.p_value)}
        moved = set() if c.localisation is None else set(c.localisation.moved)
        columns["moved"] = np.array(["true" if p in moved else "false" for p in c.labels], dtype=object)
    return {"points": Table(columns)}


def write_folder(
    c: Comparison, out: str | Path, table_format: str = "csv", facts: Mapping[str, Any] | None = None, spoken: str = "en"
) -> Path:
    """Write the result folder.

    Parameters
    ----------
    c : Comparison
    out : str or Path
        There whole or not at all; an earlier result folder of a comparison there is replaced.
    table_format : {"csv", "parquet"}
    facts : mapping, optional
        For `run.json`.
    spoken : str
        Language of the report; JSON and tables are English.

    Returns
    -------
    Path

    Raises
    ------
    MissingExtra
        If Parquet is asked for without the extra 'tables'.
    OutputError
        If it cannot be written; nothing is left behind.
    """
    document, content = result_json(c), tables(c)
    with language(spoken):
        made = sections(c)
        contents = Contents(document, html(c, made), page.figures(made), content, facts or {})
    return write(contents, out, MARK, table_format)


def html(c: Comparison, made: list[Section]) -> str:
    """Return the report as one page.

    Parameters
    ----------
    c : Comparison
    made : list of Section
        See `sections`.

    Returns
    -------
    str
    """
    tones: list[Tone] = [s.tone for s in sentences(c)]
    whole = ("bad", "Points have moved") if "bad" in tones else ("warn", "Needs attention") if "warn" in tones else ("good", "No movement")
    if c.dependent:
        whole = ("info", "Described, not tested")
    head = [("points", str(len(c.labels))), ("s0 first", f"{c.first.variance_factor**0.5:.4g}")]
    head.append(("s0 second", f"{c.second.variance_factor**0.5:.4g}"))
    name = say("{a} and {b}", **{k: e.network.path or e.network.name or tr("in memory") for k, e in (("a", c.first), ("b", c.second))})
    return page.render("Comparison report", name, "compared", (whole[0], tr(whole[1])), head, made)
