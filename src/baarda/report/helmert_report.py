"""A network adjusted in parts told: JSON, page, and the tables and adjusted networks that the parts wrote themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from baarda.errors import UsageError
from baarda.formats.folder import whole_folder
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import TauLaw
from baarda.hypotheses.variance_factor import global_variance_factor
from baarda.network import Table
from baarda.procedures.helmert import Finished
from baarda.procedures.partition_folder import write_index
from baarda.report import page
from baarda.report.contents import check_tables, json_text, plain, software, table_csv
from baarda.report.result_folder import MARK, SCHEMA
from baarda.report.sections._numbers import fixed, names, plural, probability, significant
from baarda.report.sections.base import Column, DataTable, Section, Sentence, Verdict, say, translated
from baarda.report.translation import language, tr

MOST_ROWS = 200
MOST_REJECTED = 1000
AT_ONCE = 20_000  # rows of a table that are text at a time


class PartTables:
    """Writes a table of a part to a path without extension.

    Parameters
    ----------
    tables : {"csv", "parquet"}
    """

    def __init__(self, tables: str = "csv") -> None:
        check_tables(tables)
        self.tables = tables

    def __call__(self, table: Table, path: Path) -> None:
        """Write the table; who repeats it writes the same again."""
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.tables == "csv":
            with path.with_suffix(".csv").open("w", encoding="utf-8", errors="backslashreplace", newline="\n") as f:
                for first in range(0, max(len(table), 1), AT_ONCE):
                    some = Table({name: column[first : first + AT_ONCE] for name, column in table.columns.items()})
                    text = table_csv(some)
                    f.write(text if not first else text.partition("\n")[2])
        else:
            from pyarrow import parquet  # type: ignore[import-untyped, import-not-found, unused-ignore]

            parquet.write_table(table.to_arrow(), path.with_suffix(".parquet"))


def global_test(done: Finished) -> TestResult:
    """Return the test of the variance factor."""
    b = done.blocked
    return global_variance_factor(b.objective, b.redundancy, 1.0, done.options.global_level(b.redundancy))


def _rejected(done: Finished) -> list[dict[str, Any]]:
    """Return the worst of the rejected observations of all parts."""
    judged = "tau" if done.options.sigma == "aposteriori" else "w"
    rows = [row for p in done.parts for row in p.rejected]
    return sorted(rows, key=lambda row: -abs(row[judged]))[:MOST_REJECTED]


def _snooping(done: Finished) -> dict[str, Any]:
    """Return the test of all observations, as a family in `result.json`."""
    from scipy import stats

    o, r = done.options, done.blocked.redundancy
    law: Any = TauLaw(r) if o.sigma == "aposteriori" else stats.norm()
    told = [p.extreme for p in done.parts if p.extreme is not None]
    extreme = max(told, key=lambda e: abs(e[1]), default=None)
    limit = float(law.ppf(1.0 - 0.5 * o.alpha_outlier))
    beyond = sum(p.beyond for p in done.parts)
    return {
        "name": "data_snooping",
        "null": "The observation has no gross error.",
        "df": [float(r)] if o.sigma == "aposteriori" else [],
        "law": f"tau({r})" if o.sigma == "aposteriori" else "N(0, 1)",
        "alpha": o.alpha_outlier,
        "critical": [-limit, limit],
        "tested": sum(p.tested for p in done.parts),
        "uncontrolled": sum(p.uncontrolled for p in done.parts),
        "beyond": beyond,
        "rejected": beyond > 0,
        "statistic": None if extreme is None else extreme[1],
        "p_value": None if extreme is None else extreme[2],
        "labels": [] if extreme is None else [extreme[0]],
    }


def gates(done: Finished) -> dict[str, bool]:
    """Return the gates of ``--strict`` that are tested here: True where the test rejects."""
    if not done.blocked.converged:
        return {}
    return {"global_variance_factor": bool(global_test(done).rejected), "data_snooping": bool(_snooping(done)["rejected"])}


def result_json(done: Finished, source: str) -> dict[str, Any]:
    """Return the content of `result.json`: that of an adjustment in one piece, as far as it is known, and the parts.

    Parameters
    ----------
    done : Finished
    source : str
        The source as typed.

    Returns
    -------
    dict
    """
    b, o = done.blocked, done.options
    j = b.joint
    t = global_test(done)
    points = sum(p.image_points for p in done.parts)
    squares: Any = sum(p.image_squares for p in done.parts)
    rms = [float(np.sqrt(s / points)) for s in squares] if points else [None, None]
    counted = {k: sum(f.counts[k] for f in j.facts) for k in ("object_points", "control_points", "check_points", "image_observations")}
    document = {
        "schema": SCHEMA,
        "source": {"path": source, "format": "partition", "sha256": j.source.sha256},
        "status": "converged" if b.converged else "not_converged",
        "counts": {
            "images": j.source.counts["images"],
            "cameras": j.source.counts["cameras"],
            "object_points": counted["object_points"],
            "control_points": counted["control_points"],
            "check_points": counted["check_points"],
            "observations": j.count,
            "image_observations": counted["image_observations"],
            "unknowns": j.unknowns,
            "datum_defect": b.datum.count,
            "datum_conditions": b.datum.count,
            "redundancy": b.redundancy,
        },
        "objective": {"initial": b.history[0].objective, "final": b.objective},
        "sigma0": {"apriori": 1.0, "aposteriori": float(np.sqrt(b.variance_factor)), "used": o.sigma if b.converged else "apriori"},
        "iterations": len(b.history) - 1,
        "history": [
            {"iteration": h.count, "objective": h.objective, "relative_step": h.relative_step, "damping": h.damping, "accepted": h.accepted}
            for h in b.history
        ],
        "datum": {"name": b.datum.name, "text": b.datum.text},
        "assumptions": list(dict.fromkeys(a for f in j.facts for a in f.assumptions)),
        "points_set_aside": [label for f in j.facts for label in f.aside],
        "parts": {
            "count": len(j.facts),
            "border_unknowns": j.border,
            "border_nodes": len(j.source.border),
            "redundancy_sum": done.redundancy_sum,
            "each": [
                {
                    "part": p.folder,
                    "images": p.images,
                    "points": p.points,
                    "observations": f.observations,
                    "border_unknowns": len(f.border_columns),
                }
                for p, f in zip(j.source.parts, j.facts, strict=True)
            ],
        },
        "unknowns": [row for p in done.parts for row in p.unknowns],
        "tests": [_test(t), _snooping(done)] if b.converged else [],
        "outliers": _rejected(done) if b.converged else [],
        "check_points": [row for p in done.parts for row in p.check_points] if b.converged else [],
        "rms": {"image_x": rms[0], "image_y": rms[1]},
        "software": software(),
    }
    return dict(plain(document))


def _test(t: TestResult) -> dict[str, Any]:
    found = {"statistic": t.statistic, "df": list(t.df), "law": t.law_name, "critical": t.critical, "p_value": t.p_value}
    return {"name": t.name, "null": t.null, **found, "alpha": t.alpha, "rejected": t.rejected}


def sentences(done: Finished) -> list[Sentence]:
    """Return the sentences of the verdict, the most general first.

    Parameters
    ----------
    done : Finished

    Returns
    -------
    list of Sentence
    """
    b, j = done.blocked, done.blocked.joint
    fields = {
        "parts": plural(len(j.facts), "part"),
        "observations": j.count,
        "unknowns": j.unknowns,
        "border": j.border,
        "redundancy": b.redundancy,
    }
    text = say(
        "Adjusted in {parts}: {observations} observations, {unknowns} unknowns, {border} of them shared, redundancy {redundancy}.", **fields
    )
    out = [Sentence("Adjustment", text, "good" if b.converged else "bad", "parts")]
    if not b.converged:
        steps = len(b.history) - 1
        return [*out, Sentence("Not converged", say("Not converged after {steps} iterations: nothing was tested.", steps=steps), "bad")]
    t, s0 = global_test(done), significant(float(np.sqrt(b.variance_factor)), 4)
    if t.rejected:
        said = say("The global test rejects: s0 is {s0} (p {p}).", s0=s0, p=_p(t.p_value))
    else:
        said = say("The global test does not reject: s0 is {s0} (p {p}).", s0=s0, p=_p(t.p_value))
    out.append(Sentence("Variance factor", said, "bad" if t.rejected else "good"))
    s = _snooping(done)
    if s["rejected"]:
        said = say(
            "{beyond} of {tested} observations are suspected of gross errors; the worst is {label} ({value}, limit {limit}).",
            beyond=s["beyond"],
            tested=s["tested"],
            label=s["labels"][0],
            value=fixed(s["statistic"], 2),
            limit=fixed(s["critical"][1], 2),
        )
    else:
        said = say("None of {tested} observations is suspected of a gross error.", tested=s["tested"])
    out.append(Sentence("Gross errors", said, "warn" if s["rejected"] else "good", "suspected"))
    return out


def _p(p: Any) -> str:
    text = probability(float(p))
    return text if text.startswith("<") else f"= {text}"


def verdict(done: Finished) -> list[str]:
    """Return the outcome in plain sentences.

    Parameters
    ----------
    done : Finished

    Returns
    -------
    list of str
    """
    return [page.printable(s.text) for s in sentences(done)]


def sections(done: Finished) -> list[Section]:
    """Return the sections of the report.

    Parameters
    ----------
    done : Finished

    Returns
    -------
    list of Section
    """
    j, rows = done.blocked.joint, _rejected(done)
    parts = tuple(
        (p.folder, str(p.images), str(p.points), str(f.observations), str(len(f.border_columns)), fixed(s.redundancy, 1))
        for p, f, s in zip(j.source.parts, j.facts, done.parts, strict=True)
    )
    columns = (
        Column("part", "", "", "left"),
        Column("images"),
        Column("points"),
        Column("n", "", "number of observations"),
        Column("shared", "", "unknowns that other parts hold, too"),
        Column("r", "", "redundancy"),
    )
    note = say(
        "Tables of all parts: {folders}.", folders=names([f"tables/{kind}" for kind in ("observations", "points", "images", "unknowns")])
    )
    out = [
        Section("verdict", "Verdict", (Verdict(tuple(sentences(done))),)),
        Section("parts", "Parts", (DataTable("Parts", columns, parts[:MOST_ROWS], note, folded=len(parts) > 30),)),
    ]
    if rows:
        judged = "tau" if done.options.sigma == "aposteriori" else "w"
        worst = tuple((r["group"], r["image"], r["point"], r["component"], fixed(r[judged], 2)) for r in rows[:MOST_ROWS])
        heads = (
            Column("group", "", "", "left"),
            Column("image", "", "", "left"),
            Column("point", "", "", "left"),
            Column("component", "", "", "left"),
            Column("statistic", "", "of the worst observation: tau or w"),
        )
        out.append(Section("suspected", "Gross errors", (DataTable("Suspected observations", heads, worst),)))
    return [translated(s) for s in out]


def html(done: Finished, made: list[Section]) -> str:
    """Return the report as one page.

    Parameters
    ----------
    done : Finished
    made : list of Section

    Returns
    -------
    str
    """
    b = done.blocked
    tones = {s.tone for s in sentences(done)}
    whole = (
        ("bad", "A test rejects")
        if "bad" in tones
        else ("warn", "Observations are suspected")
        if "warn" in tones
        else ("good", "No test failed")
    )
    facts = [("parts", str(len(b.joint.facts))), ("n", str(b.joint.count)), ("u", str(b.joint.unknowns)), ("r", str(b.redundancy))]
    status = tr("converged") if b.converged else tr("not converged")
    return page.render("Report on a network in parts", b.joint.source.name, status, (whole[0], tr(whole[1])), facts, made)


def write_blocked(
    finish: Callable[[str, PartTables], Finished],
    out: str | Path,
    source: str,
    tables: str = "csv",
    facts: Callable[[], Mapping[str, Any]] | None = None,
    spoken: str = "en",
) -> Finished:
    """Write the result folder of a network in parts: the parts write their tables and adjusted networks, this the rest.

    Parameters
    ----------
    finish : callable
        Makes the statistics: is given the folder and the writer of tables, see `baarda.procedures.helmert.finish`.
    out : str or Path
        The folder, which all workers can reach; there whole or not at all. An earlier result folder there is replaced.
    source : str
        The source as typed.
    tables : {"csv", "parquet"}
    facts : callable, optional
        What differs from run to run (timings, bytes moved), for `run.json`.
    spoken : str
        Language of the page.

    Returns
    -------
    Finished

    Raises
    ------
    OutputError
        If it cannot be written; nothing is left behind.
    """
    write = PartTables(tables)
    with whole_folder(Path(out), MARK) as folder:
        done = finish(str(folder.absolute()), write)
        old = done.blocked.joint.source
        parts = tuple(replace(p, sha256=s.project_sha256) for p, s in zip(old.parts, done.parts, strict=True))
        write_index(replace(old, path=folder / "project", parts=parts))
        with language(spoken):
            text = html(done, sections(done))
        contents = {MARK.file: json_text(result_json(done, source)), "report.html": text}
        contents["run.json"] = json_text(facts() if facts is not None else {})
        for name, content in contents.items():
            (folder / name).write_text(content, encoding="utf-8", errors="backslashreplace", newline="\n")
    return done


def check_options(options: Options) -> None:
    """Refuse levels for a family of observations, which no part can apply alone.

    Raises
    ------
    UsageError
    """
    if options.levels != "none":
        raise UsageError(f"levels={options.levels}: a part tests its observations one by one")
