"""A table of residuals read, studied, and told: result folder, JSON, and the verdict in sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from baarda.errors import InputError, UsageError
from baarda.formats import digest
from baarda.formats.folder import Mark, check_target
from baarda.formats.long_column import open_long
from baarda.formats.residual_table import ResidualTable, read
from baarda.formats.value_stream import ParquetStream, ValueStream
from baarda.hypotheses.base import TestResult
from baarda.network import Table
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.long_study import study_long
from baarda.procedures.residual_study import ResidualStudy, study
from baarda.report import page
from baarda.report.contents import Contents, check_tables, plain, software, write
from baarda.report.laws_json import law_json, scale_rule_json
from baarda.report.residual_sections import sections
from baarda.report.residual_verdict import sentences
from baarda.report.sections.base import Section
from baarda.report.translation import check_language, language, tr

SCHEMA = "baarda.residuals/1"
MARK = Mark("result.json", "baarda.residuals/", ("report.html", "result.json", "run.json", "tables", "figures"))


class Outcome(NamedTuple):
    """What studying a table gives: the study, the verdict in sentences, and the content of `result.json`."""

    study: ResidualStudy
    verdict: list[str]
    document: dict[str, Any]


def run(
    path: str | Path,
    out: str | Path | None = None,
    column: str | None = None,
    group: str | None = None,
    options: StudyOptions | None = None,
    *,
    sigma: str | None = None,
    redundancy: str | None = None,
    tables: str = "csv",
    facts: Mapping[str, Any] | None = None,
    spoken: str = "en",
    progress: Callable[[int, int], None] | None = None,
) -> Outcome:
    """Read a table of residuals, study it, and write the result folder.

    A plain column of five million values or more in an NPY or Parquet file is read as a stream, in constant memory.

    Parameters
    ----------
    path : str or Path
        CSV, NPY or Parquet.
    out : str or Path, optional
        Result folder; nothing is written without it.
    column, group, sigma, redundancy : str, optional
        Columns; see `baarda.formats.residual_table.read`.
    options : StudyOptions, optional
    tables : {"csv", "parquet"}
        Format of the tables of the folder.
    facts : mapping, optional
        What differs from run to run (timings), for `run.json`.
    spoken : str
        Language of report and verdict; JSON and tables are English.
    progress : callable, optional
        Called with the numbers of values read and in all, while a long column is read.

    Returns
    -------
    Outcome

    Raises
    ------
    InputError
        If the table cannot be used; the message names file and line.
    OutputError
        If the folder cannot be written; nothing is left behind.
    UsageError
        If options make no sense for the table.
    """
    check_tables(tables)
    check_language(spoken)
    if out is not None:
        check_target(Path(out), MARK)
    o = StudyOptions() if options is None else options
    long = open_long(path, column, group, sigma, redundancy) if isinstance(o.classes, str) else None
    if long is not None:
        table, found = _streamed(path, *long, o, progress)
    else:
        table, found = _in_memory(path, (column, group, sigma, redundancy), o)
    document = result_json(table, found)
    if out is not None:
        write_folder(table, found, out, tables, facts, spoken)
    with language(spoken):
        return Outcome(found, verdict(table, found), document)


def _in_memory(path: str | Path, columns: tuple[str | None, ...], o: StudyOptions) -> tuple[ResidualTable, ResidualStudy]:
    table = read(path, *columns)
    return table, study(table.values, table.groups, table.sigmas, table.redundancy_numbers, o, group_names=table.group_names)


def _streamed(
    path: str | Path, stream: ValueStream, column: str, o: StudyOptions, progress: Callable[[int, int], None] | None
) -> tuple[ResidualTable, ResidualStudy]:
    told = None if progress is None else lambda done: progress(done, stream.total)
    try:
        found = study_long(stream, o, progress=told)
    except UsageError as error:
        raise InputError(str(error), Path(path)) from None
    assumptions = [
        f"The column of {stream.total} values was read as a stream and condensed into bins of 1/64 octave of the distance from their mean: "
        "class limits lie between bins, statistics of the distribution function are taken at the limits of the bins.",
        f"Figures show {len(found.values)} representative values.",
    ]
    if stream.column is None:
        assumptions.insert(0, "The array has no names: its columns are numbered from 1.")
    name: Literal["parquet", "npy"] = "parquet" if isinstance(stream, ParquetStream) else "npy"
    return ResidualTable(str(path), name, column, found.values, assumptions=tuple(assumptions)), found


def verdict(table: ResidualTable, found: ResidualStudy) -> list[str]:
    """Return the outcome in plain sentences.

    Parameters
    ----------
    table : ResidualTable
    found : ResidualStudy

    Returns
    -------
    list of str
    """
    return [page.printable(s.text) for s in sentences(table, found)]


# ---- JSON and tables ----------------------------------------------------------------------------------------------------------------


def result_json(table: ResidualTable, found: ResidualStudy, sha256: str | None = None) -> dict[str, Any]:
    """Return the content of `result.json`; its schema is "baarda.residuals/1".

    Parameters
    ----------
    table : ResidualTable
    found : ResidualStudy
    sha256 : str, optional
        Of the source; by default that of the file.

    Returns
    -------
    dict
        JSON-compatible; infinite numbers (a = inf is the normal law) are None.
    """
    o, groups = found.options, found.groups
    every = (*found.tests, *(groups.tests if groups is not None else ()), *((found.laws.ratio,) if found.laws.ratio is not None else ()))
    document = {
        "schema": SCHEMA,
        "source": {
            "path": table.path,
            "format": table.format,
            "sha256": digest(Path(table.path)) if sha256 is None else sha256,
            "columns": {"residual": table.column, "group": table.group, "sigma": table.sigma, "redundancy": table.redundancy},
        },
        "assumptions": list(table.assumptions),
        "options": {
            "alpha": o.alpha,
            "loc": o.loc,
            "classes": o.classes if isinstance(o.classes, str) else list(o.classes),
            "number": o.number,
            "ends": o.ends,
            "merge": o.merge,
            "levels": o.levels,
            "interval": o.interval,
            "replicas": o.replicas,
            "seed": o.seed,
        },
        "counts": {"values": found.n, "set_aside": found.set_aside, "groups": 0 if groups is None else len(groups.names)},
        "sample": {
            "kind": found.kind,
            "mean": found.mean,
            "standard_deviation": found.deviation,
            "skewness": found.skewness,
            "kurtosis": found.kurtosis,
            "minimum": found.values.min(),
            "maximum": found.values.max(),
            "rounded": found.laws.rounded,
            "redundancy": found.redundancy,
            "sigma0": found.sigma0,
        },
        "tests": [_test(t) for t in every],
        "scale_rules": [scale_rule_json(r) for r in found.scale_rules],
        "laws": [law_json(found.laws, s) for s in found.laws.laws],
        "modulated_normal": _modulated(found),
        "chi_square_ratios": {"descriptive": True, "values": found.laws.chi_square_ratios},
        "left_out": [{"what": what, "why": why} for what, why in found.left_out],
        "verdict": verdict(table, found),
        "software": software(),
    }
    return dict(plain(document))


def _test(t: TestResult) -> dict[str, Any]:
    out: dict[str, Any] = {"name": t.name, "null": t.null, "df": list(t.df), "law": t.law_name, "alpha": t.alpha, "critical": t.critical}
    if np.ndim(t.statistic):
        extreme = t.details.get("extreme", {})
        out |= {"tested": t.details.get("tested"), "beyond": t.details.get("rejected"), "rejected": bool(np.any(t.rejected))}
        out |= {"statistic": extreme.get("statistic"), "p_value": extreme.get("p_value"), "labels": [extreme.get("label")]}
    else:
        out |= {"statistic": t.statistic, "p_value": t.p_value, "rejected": t.rejected}
    return {**out, "note": t.note} if t.note else out


def _modulated(found: ResidualStudy) -> dict[str, Any] | None:
    laws = found.laws
    if laws.modulated is None or laws.interval is None:
        return None
    return {
        "a": laws.modulated.parameters["a"],
        "interval": {"level": found.options.interval, "lower": laws.interval[0], "upper": laws.interval[1]},
        "normal_in_interval": bool(np.isinf(laws.interval[1])),
        "a_of_errors": found.a_of_errors,
    }


def result_tables(found: ResidualStudy) -> dict[str, Table]:
    """Return the tables of the result folder by name.

    Parameters
    ----------
    found : ResidualStudy

    Returns
    -------
    dict of Table
    """
    rules = found.scale_rules
    out = {
        "scale_rules": Table(
            {
                "symbol": _texts(r.symbol for r in rules),
                "mean": _floats(r.mean for r in rules),
                "standard_deviation": _floats(r.deviation for r in rules),
                "statistic": _floats(None if r.fit is None else r.fit.statistic for r in rules),
                "df": _floats(None if r.fit is None else r.fit.df for r in rules),
                "p_value": _floats(r.p_value for r in rules),
            }
        )
    }
    laws = found.laws.laws
    if laws:
        names = ("kolmogorov", "cramer_von_mises", "anderson_darling")
        columns = {
            "law": _texts(s.fit.law for s in laws),
            "parameters": _texts(", ".join(f"{k} = {v!r}" for k, v in s.fit.parameters.items()) for s in laws),
            "statistic": _floats(s.fit.statistic for s in laws),
            "df": _floats(s.fit.df for s in laws),
            "p_value": _floats(s.fit.p_value for s in laws),
            **{name: _floats(getattr(s.test(name), "p_value", None) for s in laws) for name in names},
            "log_likelihood": _floats(s.fit.log_likelihood for s in laws),
            "aic": _floats(s.fit.aic for s in laws),
            "bic": _floats(s.fit.bic for s in laws),
        }
        out["laws"] = Table(columns)
    classed = [s.fit for s in laws if s.fit.histogram is not None]
    first = classed[0].histogram if classed else None
    if first is not None:
        expected = {f"expected_{f.law}": f.histogram.expected for f in classed if f.histogram is not None}
        out["classes"] = Table({"lower": first.edges[:-1], "upper": first.edges[1:], "count": first.counts, **expected})
    groups = found.groups
    if groups is not None:
        each, at = groups.test("variance_per_group"), groups.tested
        statistic, p = np.full(len(groups.names), np.nan), np.full(len(groups.names), np.nan)
        if each is not None:
            statistic[at], p[at] = np.asarray(each.statistic), np.asarray(each.p_value)
        columns = {"group": _texts(groups.names), "n": groups.counts, "mean": groups.means, "variance": groups.variances, "df": groups.df}
        out["groups"] = Table({**columns, "statistic": statistic, "p_value": p})
    return out


def _texts(values: Any) -> Any:
    return np.array(list(values), dtype=object)


def _floats(values: Any) -> Any:
    return np.array([np.nan if v is None else v for v in values], dtype=float)


# ---- page and folder ----------------------------------------------------------------------------------------------------------------


def html(table: ResidualTable, found: ResidualStudy, made: list[Section]) -> str:
    """Return the report as one page: no scripts, nothing loaded from anywhere.

    Parameters
    ----------
    table : ResidualTable
    found : ResidualStudy
    made : list of Section

    Returns
    -------
    str
    """
    tones = [s.tone for s in sentences(table, found)]
    bad, warn = tones.count("bad"), tones.count("warn")
    passed = ("warn", "The law needs attention") if warn else ("good", "No test failed")
    tone, words = ("bad", "A test of the model failed") if bad else passed
    facts = [("values", str(found.n)), ("column", table.column), ("groups", "-" if found.groups is None else str(len(found.groups.names)))]
    facts += [("mean", f"{found.mean:.3g}"), ("standard deviation", f"{found.deviation:.4g}")]
    return page.render("Residual report", table.path, "studied", (tone, tr(words)), facts, made)


def write_folder(
    table: ResidualTable,
    found: ResidualStudy,
    out: str | Path,
    tables: str = "csv",
    facts: Mapping[str, Any] | None = None,
    spoken: str = "en",
) -> Path:
    """Write the result folder.

    Parameters
    ----------
    table : ResidualTable
    found : ResidualStudy
    out : str or Path
        There whole or not at all; an earlier result folder there is replaced.
    tables : {"csv", "parquet"}
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
    document, content = result_json(table, found), result_tables(found)
    with language(spoken):
        made = sections(table, found)
        contents = Contents(document, html(table, found, made), page.figures(made), content, facts or {})
    return write(contents, out, MARK, tables)
