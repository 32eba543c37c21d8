"""A lake of residuals studied and told: the folder of the residual study, with moments and histograms of the groups."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baarda.errors import InputError, UsageError
from baarda.executors import Workers
from baarda.formats.folder import check_target
from baarda.formats.residual_lake import Lake, open_lake
from baarda.formats.residual_table import ResidualTable
from baarda.network import Table
from baarda.procedures.lake_study import LakeStudy, _bins, group_moments, study_lake
from baarda.procedures.lake_sums import bound
from baarda.procedures.law_study import StudyOptions
from baarda.report import page
from baarda.report.contents import Contents, check_tables, write
from baarda.report.residual_report import MARK, Outcome, html, result_json, result_tables, verdict
from baarda.report.residual_sections import sections
from baarda.report.sections.base import say
from baarda.report.translation import check_language, language, tr

MOST_HISTOGRAM_ROWS = 1_000_000


def run_lake(
    address: str | Path,
    out: str | Path | None = None,
    column: str | None = None,
    group: str | None = None,
    options: StudyOptions | None = None,
    *,
    sigma: str | None = None,
    redundancy: str | None = None,
    tables: str = "csv",
    spoken: str = "en",
    facts: Mapping[str, Any] | None = None,
    workers: Workers | None = None,
    progress: Callable[[int, int, int], None] | None = None,
    tell: Callable[[str], None] | None = None,
) -> Outcome:
    """Study the residuals of a lake in one pass, and write the result folder.

    Parameters
    ----------
    address : str or Path
        Folder or fsspec address of partitioned Parquet.
    out : str or Path, optional
        Result folder; nothing is written without it. An interrupted pass is kept beside it and gone on with.
    column, group, sigma, redundancy : str, optional
        Columns; see `baarda.formats.residual_table.read`.
    options : StudyOptions, optional
    tables : {"csv", "parquet"}
    spoken : str
        Language of the report and the verdict; JSON and tables are English.
    facts : mapping, optional
        What differs from run to run, for `run.json`.
    workers : Workers, optional
        See `baarda.executors.open_workers`.
    progress : callable, optional
        Called with the numbers of files done and in all, and of rows read.
    tell : callable, optional
        Is told what will be read and how much memory it takes.

    Returns
    -------
    Outcome

    Raises
    ------
    InputError, TaskFailed
        If a file cannot be used; the message names file and row.
    NotEnoughMemory
        If a worker may take less than is needed.
    OutputError
        If the folder cannot be written; nothing is left behind.
    """
    check_tables(tables)
    check_language(spoken)
    saved = None
    if out is not None:
        check_target(Path(out), MARK)
        target = Path(out).resolve()
        saved = target.with_name(f"{target.name}.unfinished.npz")
        target.parent.mkdir(parents=True, exist_ok=True)
    lake = open_lake(address, column, group, sigma, redundancy)
    if tell is not None:
        tell(f"{len(lake.files)} files, {sum(lake.sizes) / 1e9:.2f} GB; column {lake.column}, groups {lake.group or 'none'}")
        each = (bound(10_000) - bound(0)) / 10_000
        tell(f"memory of a worker: {bound(0) / 1e6:.0f} MB and about {each / 1e3:.1f} kB for each group, at most")
    try:
        found, passed = study_lake(lake, options, workers, saved=saved, progress=progress)
    except UsageError as error:
        raise InputError(str(error), lake.address) from None
    if tell is not None and passed.continued:
        tell(f"{passed.continued} files had been read by an earlier run")
    document = result_json(lake_table(lake, found), found.study, passed.sha256)
    with language(spoken):
        table = lake_table(lake, found)
        made = sections(table, found.study)
        told = verdict(table, found.study)
        shown = (html(table, found.study, made), page.figures(made)) if out is not None else ("", {})
    if out is not None:
        more = {"peak_memory_of_a_worker": passed.peak, "bound": bound(len(found.groups.index), len(found.groups.keys))}
        content = {**result_tables(found.study), **group_tables(found, lake)}
        contents = Contents(document, *shown, content, {**(facts or {}), **more, "files_continued": passed.continued})
        write(contents, out, MARK, tables)
        if saved is not None:
            saved.unlink(missing_ok=True)
    return Outcome(found.study, told, document)


def lake_table(lake: Lake, found: LakeStudy) -> ResidualTable:
    """Return a lake as the report takes a table: representative values, and what was taken for granted."""
    study = found.study
    assumptions = [
        say(
            "{files} files with {rows} rows were read in one pass and condensed into bins of 1/64 octave of the distance from {centre}: "
            "class limits lie between bins.",
            files=len(lake.files),
            rows=study.n + study.set_aside,
            centre=f"{found.centre:.6g}",
        ),
        say("Figures show {count} representative values.", count=len(study.values)),
        tr("The hash of the source is over sizes and footers of the files in order."),
    ]
    if lake.group is not None:
        assumptions.append(tr("Medians of the groups, and distances from these, are taken from bins of a quarter octave."))
    named = (lake.column, study.values, lake.group)
    return ResidualTable(lake.address, "parquet", *named, sigma=lake.sigma, redundancy=lake.redundancy, assumptions=tuple(assumptions))


def group_tables(found: LakeStudy, lake: Lake) -> dict[str, Table]:
    """Return the tables of the groups: shape and robust scale of each, and their histograms.

    Parameters
    ----------
    found : LakeStudy
    lake : Lake

    Returns
    -------
    dict of Table
        Without groups nothing; no histograms beyond a million rows.
    """
    if lake.group is None:
        return {}
    names = np.array(found.groups.names, dtype=object)
    skewness, kurtosis = group_moments(found)
    columns = {"group": names, "skewness": skewness, "kurtosis": kurtosis, "median": found.medians, "robust_deviation": found.deviations}
    out = {"group_moments": Table(columns)}
    lower, upper, counts = _bins(found.groups)
    rows, places = np.nonzero(counts)
    if len(rows) <= MOST_HISTOGRAM_ROWS:
        limits = {"lower": found.centre + lower[places], "upper": found.centre + upper[places]}
        out["histograms"] = Table({"group": names[rows], **limits, "count": counts[rows, places]})
    return out
