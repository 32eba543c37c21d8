"""A planimetry-height adjustment told: both halves with all their statistics in one result folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baarda.formats.folder import Mark
from baarda.hypotheses.levels import Options
from baarda.network import AXES, Table
from baarda.procedures.planimetry_height import PlanimetryHeight
from baarda.procedures.testing import Analysis, analyse
from baarda.report import page
from baarda.report.contents import Contents, plain, software, write
from baarda.report.result_folder import observation_table
from baarda.report.result_folder import result_json as half_json
from baarda.report.sections._facts import first
from baarda.report.sections._numbers import decimals_for, fixed, significant
from baarda.report.sections.base import Block, Column, DataTable, Paragraph, Section, Sentence, Tone, Verdict, say, translated
from baarda.report.sections.verdict import sentences as half_sentences
from baarda.report.translation import language, tr

SCHEMA = "baarda.planimetry_height/1"
PARTS = ("report.html", "plan.html", "height.html", "result.json", "run.json", "tables", "figures", "project")
MARK = Mark("result.json", "baarda.planimetry_height/", PARTS)
_MOST = 300


@dataclass(frozen=True)
class Told:
    """Both halves with their tests."""

    found: PlanimetryHeight
    plan: Analysis
    height: Analysis

    @property
    def gates(self) -> dict[str, bool]:
        """What ``--strict`` asks, of both halves."""
        both = (("plan", self.plan), ("height", self.height))
        return {f"{name}: {gate}": rejected for name, half in both for gate, rejected in half.gates.items()}


def told(found: PlanimetryHeight, options: Options) -> Told:
    """Test both halves.

    Parameters
    ----------
    found : PlanimetryHeight
    options : Options

    Returns
    -------
    Told
    """
    return Told(found, analyse(found.plan, options), analyse(found.height, options))


def sentences(t: Told) -> list[Sentence]:
    """Return the verdict.

    Parameters
    ----------
    t : Told

    Returns
    -------
    list of Sentence
    """
    f = t.found
    text = say(
        "Plan and height were adjusted by turns; after {rounds} rounds the largest change is {change} {unit}. Redundancy {r} ({plan} in "
        "plan, {height} in height), common s0 {s0}.",
        rounds=len(f.changes),
        change=significant(f.changes[-1], 2),
        unit=f.network.unit,
        r=f.redundancy,
        plan=f.plan.redundancy,
        height=f.height.redundancy,
        s0=fixed(f.sigma0, 4),
    )
    out = [Sentence("Rounds", text, "good" if f.converged else "bad", "rounds")]
    for name, half in (("Plan", t.plan), ("Height", t.height)):
        out += [Sentence(f"{tr(name)}: {tr(s.subject)}", s.text, s.tone) for s in half_sentences(half) if s.subject != "Precision"]
    return out


def verdict(t: Told) -> list[str]:
    """Return the outcome in plain sentences.

    Parameters
    ----------
    t : Told

    Returns
    -------
    list of str
    """
    return [page.printable(f"{tr(s.subject)}: {s.text}") for s in sentences(t)]


def point_table(t: Told) -> Table:
    """Return the coordinates of all points with the standard deviations of the halves that determine them.

    Parameters
    ----------
    t : Told

    Returns
    -------
    Table
        Plan of ground points from the plan half; their heights, and perspective centres, from the height half. NaN where a coordinate is
        fixed or not determined.
    """
    net = t.found.network
    sigma = np.full((len(net.points.labels), 3), np.nan)
    index = {label: i for i, label in enumerate(net.points.labels)}
    used = np.zeros(len(index), dtype=bool)
    for half in (t.plan, t.height):
        table = half.adjustment.point_table(half.options.sigma)
        for row, label in enumerate(table["point"]):
            i = index[label]
            used[i] = True
            for k, axis in enumerate(AXES):
                if table[f"s{axis}"][row] > 0.0:
                    sigma[i, k] = table[f"s{axis}"][row]
    rows = np.flatnonzero(used)
    columns: dict[str, Any] = {"point": np.array(net.points.labels, dtype=object)[rows]}
    columns["role"] = np.array(["tie", "control", "check"], dtype=object)[net.points.roles[rows]]
    columns |= {axis: net.points.coordinates[rows, k] for k, axis in enumerate(AXES)}
    return Table(columns | {f"s{axis}": sigma[rows, k] for k, axis in enumerate(AXES)})


def sections(t: Told) -> list[Section]:
    """Return the sections of the summary; `plan.html` and `height.html` are the reports of the halves.

    Parameters
    ----------
    t : Told

    Returns
    -------
    list of Section
    """
    f = t.found
    rounds = DataTable(
        "Largest change of a coordinate",
        (Column("round"), Column("change", f.network.unit, "largest change of X, Y or Z of any point")),
        tuple((str(k + 1), f"{c:.2e}") for k, c in enumerate(f.changes)),
    )
    table = point_table(t)
    sigma = np.stack([table[f"s{a}"] for a in AXES])
    places = decimals_for(sigma[np.isfinite(sigma)], 2)
    rows = tuple(
        (str(table["point"][i]), str(table["role"][i]), *(fixed(float(table[c][i]), places) for c in (*AXES, "sX", "sY", "sZ")))
        for i in range(min(len(table), _MOST))
    )
    unit = f.network.unit
    columns = (
        Column("point", "", "", "left"),
        Column("role", "", "", "left"),
        *(Column(a, unit) for a in AXES),
        *(Column(f"s{a}", unit, "standard deviation; a dash: fixed") for a in AXES),
    )
    note = first(len(table), _MOST, "tables/points")
    reports: list[Block] = [
        Paragraph("The full reports of the two adjustments lie beside this page: plan.html and height.html."),
        rounds,
    ]
    made = [
        Section("verdict", "Verdict", (Verdict(tuple(sentences(t))),)),
        Section("rounds", "Rounds", tuple(reports)),
        Section("points", "Points", (DataTable("Adjusted points", columns, rows, note),)),
    ]
    return [translated(s) for s in made]


def result_json(t: Told) -> dict[str, Any]:
    """Return the content of `result.json`; its schema is "baarda.planimetry_height/1".

    Parameters
    ----------
    t : Told

    Returns
    -------
    dict
        `plan` and `height` have the schema "baarda.result/1".
    """
    f = t.found
    models = next(d for d in f.network.declared if d.kind == "model")
    document = {
        "schema": SCHEMA,
        "source": {"path": f.network.path, "format": f.network.format, "sha256": f.network.sha256},
        "status": "converged" if f.converged else "not_converged",
        "rounds": list(f.changes),
        "redundancy": f.redundancy,
        "sigma0": f.sigma0,
        "models": [
            {"model": label, **dict(zip(models.parameters_of(i), models.values.reshape(-1, 7)[i], strict=True))}
            for i, label in enumerate(models.labels)
        ],
        "plan": half_json(t.plan),
        "height": half_json(t.height),
        "verdict": verdict(t),
        "software": software(),
    }
    return dict(plain(document))


def write_folder(t: Told, out: str | Path, table_format: str = "csv", facts: Mapping[str, Any] | None = None, spoken: str = "en") -> Path:
    """Write the result folder.

    Parameters
    ----------
    t : Told
    out : str or Path
        There whole or not at all; an earlier result folder of the same kind there is replaced.
    table_format : {"csv", "parquet"}
    facts : mapping, optional
        For `run.json`.
    spoken : str
        Language of the reports; JSON and tables are English.

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
    document = result_json(t)
    tables: dict[str, Table] = {"points": point_table(t)}
    figures: dict[str, str] = {}
    files: dict[str, bytes] = {}
    for name, half in (("plan", t.plan), ("height", t.height)):
        tables |= {f"observations_{name}": observation_table(half), f"unknowns_{name}": half.adjustment.unknown_table(half.options.sigma)}
    with language(spoken):
        for name, half in (("plan", t.plan), ("height", t.height)):
            made = page.sections(half)
            files[f"{name}.html"] = page.html(half, made).encode("utf-8", "backslashreplace")
            figures |= {f"{name}-{key}": svg for key, svg in page.figures(made).items()}
        contents = Contents(document, html(t), figures, tables, facts or {}, files, t.found.network)
    return write(contents, out, MARK, table_format)


def html(t: Told) -> str:
    """Return the summary as one page.

    Parameters
    ----------
    t : Told

    Returns
    -------
    str
    """
    tones: list[Tone] = [s.tone for s in sentences(t)]
    overall = ("bad", "A test failed") if "bad" in tones else ("warn", "Needs attention") if "warn" in tones else ("good", "No test failed")
    f = t.found
    head = [("redundancy", str(f.redundancy)), ("s0 plan", f"{f.plan.sigma0:.4g}"), ("s0 height", f"{f.height.sigma0:.4g}")]
    name = f.network.path or f.network.name or tr("in memory")
    return page.render("Planimetry-height report", name, "adjusted", (overall[0], tr(overall[1])), head, sections(t))
