"""Many blocks told: a table with a row each, the comparison of their variance factors, JSON, page, and the verdict in sentences."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from baarda.errors import OutputError
from baarda.formats.folder import Mark, check_target
from baarda.hypotheses.base import TestResult
from baarda.network import Table
from baarda.procedures.batch import BLOCKS, COLUMNS, RECORDS, Row
from baarda.procedures.block_comparison import BatchStudy
from baarda.procedures.testing import Analysis
from baarda.report import page, plots, result_folder
from baarda.report.contents import Contents, check_tables, json_text, plain, software, write
from baarda.report.sections._laws import table_of_tests
from baarda.report.sections._numbers import fixed, names, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, Section, Sentence, Tone, Verdict, say, translated
from baarda.report.translation import language, tr

SCHEMA = "baarda.batch/1"
MARK = Mark("batch.json", "baarda.batch/", ("batch.json", "report.html", "run.json", "tables", "figures", BLOCKS, RECORDS))
MOST_ROWS = 200
_NEW = "summary-new"
_NUMBERS = ("sigma0", "global_statistic", "global_p_value", "worst_statistic", "worst_p_value", "worst_limit")


class BlockWriter:
    """Writes the result folder of a block as `baarda adjust` does.

    Parameters
    ----------
    tables : {"csv", "parquet"}
    spoken : str
        Language of the reports.
    """

    def __init__(self, tables: str = "csv", spoken: str = "en") -> None:
        check_tables(tables)
        self.tables, self.spoken = tables, spoken

    def __call__(self, analysis: Analysis, folder: Path, facts: dict[str, Any]) -> None:
        """Write the folder, whole or not at all."""
        result_folder.write_folder(analysis, folder, self.tables, facts, self.spoken)


def begin(out: str | Path) -> None:
    """Make the folder of a batch, or find that there is one to go on with.

    Parameters
    ----------
    out : str or Path

    Raises
    ------
    OutputError
        If it belongs to somebody else or cannot be written.
    """
    folder = Path(out)
    if folder.is_dir():
        _remove_left(folder)
    check_target(folder, MARK)
    try:
        for name in (BLOCKS, RECORDS):
            (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / MARK.file).write_text(json_text({"schema": SCHEMA, "status": "running"}), encoding="utf-8", newline="\n")
    except OSError as error:
        raise OutputError(f"cannot write {error.filename or folder}: {error.strerror or error}") from None


def _remove_left(folder: Path) -> None:
    """Remove summaries that were being written when a run was killed."""
    for left in (*folder.glob(f".{_NEW}-*"), folder / _NEW):
        shutil.rmtree(left, ignore_errors=True)


def verdict(study: BatchStudy) -> list[str]:
    """Return the outcome in plain sentences.

    Parameters
    ----------
    study : BatchStudy

    Returns
    -------
    list of str
    """
    return [page.printable(s.text) for s in sentences(study)]


def sentences(study: BatchStudy) -> list[Sentence]:
    """Return the sentences of the verdict, the most general first.

    Parameters
    ----------
    study : BatchStudy

    Returns
    -------
    list of Sentence
    """
    made = [_counted(study), *_failures(study), _globals(study), _homogeneity(study), _worst(study), _points(study)]
    return [s for s in made if s is not None]


def _counted(study: BatchStudy) -> Sentence:
    rows = study.having("converged")
    text = say(
        "{done} of {blocks} converged and were tested: {observations} observations, {unknowns} unknowns, redundancy {redundancy} in all.",
        done=len(rows),
        blocks=plural(len(study.rows), "block"),
        **{name: sum(int(r[name]) for r in rows) for name in ("observations", "unknowns", "redundancy")},
    )
    return Sentence("Blocks", text, "good" if len(rows) == len(study.rows) else "bad", "blocks")


def _failures(study: BatchStudy) -> list[Sentence]:
    out = []
    open_, failed = study.having("not_converged"), study.having("failed")
    if open_:
        text = say("Not converged, not tested: {names}.", names=names([r["block"] for r in open_]))
        out.append(Sentence("Not converged", text, "bad", "failures"))
    if failed:
        text = say("Failed, without a result: {names}; the reasons stand in the table.", names=names([r["block"] for r in failed]))
        out.append(Sentence("Failed", text, "bad", "failures"))
    return out


def _globals(study: BatchStudy) -> Sentence | None:
    rows = [r for r in study.rows if r["global_rejected"] is not None]
    if not rows:
        return None
    beyond = sum(bool(r["global_rejected"]) for r in rows)
    text = say(
        "The global test rejects {beyond} of {blocks}, where chance alone gives about {chance}; sigma0 lies between {low} and {high}, "
        "median {middle}.",
        beyond=beyond,
        blocks=plural(len(rows), "block"),
        chance=significant(study.alpha * len(rows), 2),
        low=significant(min(r["sigma0"] for r in rows), 3),
        high=significant(max(r["sigma0"] for r in rows), 3),
        middle=significant(float(np.median([r["sigma0"] for r in rows])), 3),
    )
    return Sentence("Variance factors", text, "bad" if beyond > _chance(len(rows), study.alpha) else "good", "blocks")


def _chance(n: int, alpha: float) -> int:
    """The count that chance exceeds in one of a hundred cases at most."""
    from scipy import stats

    return int(stats.binom.ppf(0.99, n, alpha))


def _homogeneity(study: BatchStudy) -> Sentence | None:
    t = study.bartlett
    if t is None:
        return None
    if not t.rejected:
        text = say("The variance factors of the blocks are not shown to differ (Bartlett p {p}).", p=_p(t.p_value))
        return Sentence("Homogeneity", text, "good", "comparison")
    text = say("The variance factors of the blocks are not equal (Bartlett p {p}).", p=_p(t.p_value))
    if study.outlying:
        text += " " + say(
            "Outlying: {names}; the others have a pooled sigma0 of {pooled}.",
            names=names(study.outlying),
            pooled=significant(study.pooled, 3),
        )
    return Sentence("Homogeneity", text, "warn", "comparison")


def _p(p: Any) -> str:
    text = probability(float(p))
    return text if text.startswith("<") else f"= {text}"


def _worst(study: BatchStudy) -> Sentence | None:
    rows = [r for r in study.rows if r["worst_statistic"] is not None]
    if not rows:
        return None
    row = max(rows, key=lambda r: abs(r["worst_statistic"]) / r["worst_limit"])
    suspected = sum(int(r["suspected"]) for r in rows)
    text = say(
        "{suspected} of {total} observations are suspected of gross errors, in {blocks}; the worst is {label} of {block} "
        "({value}, limit {limit}).",
        suspected=suspected,
        total=sum(int(r["observations"]) for r in rows),
        blocks=plural(sum(r["suspected"] > 0 for r in rows), "block"),
        label=row["worst_observation"],
        block=row["block"],
        value=fixed(row["worst_statistic"], 2),
        limit=fixed(row["worst_limit"], 2),
    )
    return Sentence("Gross errors", text, "warn" if suspected else "good", "blocks")


def _points(study: BatchStudy) -> Sentence | None:
    tested = [r for r in study.rows if r["control_points_rejected"] is not None or r["check_points_rejected"] is not None]
    if not tested:
        return None
    wrong = [r["block"] for r in tested if r["control_points_rejected"] or r["check_points_rejected"]]
    fields = {"blocks": plural(len(tested), "block")}
    if not wrong:
        return Sentence("Points", say("Control and check points agree in all of {blocks} that have any.", **fields), "good", "blocks")
    text = say("Control or check points contradict {wrong} of {blocks}: {names}.", wrong=len(wrong), names=names(wrong), **fields)
    return Sentence("Points", text, "bad", "blocks")


# ---- sections ------------------------------------------------------------------------------------------------------------------------


def sections(study: BatchStudy) -> list[Section]:
    """Return the sections of the report.

    Parameters
    ----------
    study : BatchStudy

    Returns
    -------
    list of Section
    """
    parts: list[tuple[str, str, list[Block]]] = [
        ("verdict", "Verdict", [Verdict(tuple(sentences(study)))]),
        ("failures", "Blocks without a result", _failure_table(study)),
        ("comparison", "Comparison of the variance factors", _comparison(study)),
        ("blocks", "Blocks", _block_table(study)),
    ]
    return [translated(Section(anchor, title, tuple(blocks))) for anchor, title, blocks in parts if blocks]


def _failure_table(study: BatchStudy) -> list[Block]:
    rows = [r for r in study.rows if r["status"] != "converged"]
    columns = (Column("source", "", "", "left"), Column("outcome", "", "", "left"), Column("message", "", "", "left"))
    shown = tuple((r["source"], Cell(str(r["status"]).replace("_", " "), "bad"), r["message"]) for r in rows[:MOST_ROWS])
    return [DataTable("Blocks without a result", columns, shown, _shortened(rows))] if rows else []


def _shortened(rows: Sequence[Row]) -> str:
    if len(rows) <= MOST_ROWS:
        return ""
    return say("The first {most} of {count} rows; all are in tables/blocks.", most=MOST_ROWS, count=len(rows))


def _comparison(study: BatchStudy) -> list[Block]:
    if study.bartlett is None:
        return []
    out: list[Block] = [_figure(study)]
    if study.outlying:
        order, rows = {name: i for i, name in enumerate(study.outlying)}, []
        for r in sorted((r for r in study.rows if r["block"] in order), key=lambda r: order[r["block"]]):
            ratio = r["sigma0"] / study.pooled if study.pooled else None
            rows.append((r["block"], significant(r["sigma0"], 4), str(r["redundancy"]), significant(ratio, 3)))
        columns = (
            Column("block", "", "", "left"),
            Column("s0", "", "a posteriori"),
            Column("r", "", "redundancy"),
            Column("ratio", "", "to the pooled s0 of the blocks that agree"),
        )
        caption = "Outlying blocks, in the order in which they were found"
        out.append(DataTable(caption, columns, tuple(rows[:MOST_ROWS]), _shortened(study.outlying)))  # type: ignore[arg-type]
    return [*out, *table_of_tests("Homogeneity of the variance factors", (study.bartlett,))]


def _figure(study: BatchStudy) -> Figure:
    each: TestResult | None = study.per_block
    out = set(study.outlying)
    rows = [r for r in study.rows if each is not None and r["block"] in set(each.labels)]
    s0, r = np.array([q["sigma0"] for q in rows]), np.array([float(q["redundancy"]) for q in rows])
    beyond = np.array([q["block"] in out for q in rows])

    def draw(figure: Any) -> None:
        from scipy import stats

        axes = figure.add_subplot()
        axes.set_xscale("log")
        axes.set_yscale("log")
        span = np.geomspace(r.min() / 1.2, r.max() * 1.2, 100)
        middle = study.pooled or 1.0
        for share in (0.025, 0.975):
            axes.plot(span, middle * np.sqrt(stats.chi2.ppf(share, span) / span), color=plots.MUTED, linewidth=0.9, linestyle=(0, (5, 2)))
        axes.axhline(middle, color=plots.INK, linewidth=0.9)
        for chosen, marker, colour, word in ((~beyond, "o", plots.BLUE, "agrees with the others"), (beyond, "D", plots.ORANGE, "outlying")):
            if chosen.any():
                axes.plot(
                    r[chosen], s0[chosen], marker, color=colour, markersize=4, label=tr(word), rasterized=len(rows) > plots.MOST_MARKS
                )
        axes.set_xlabel(tr("redundancy of the block"))
        axes.set_ylabel(tr("s0 a posteriori"))
        axes.grid(True)
        figure.legend(loc="outside upper left", ncols=2)

    caption = "The line is the pooled s0 of the blocks that agree; dashed: where 95 % of equal blocks lie, given their redundancy."
    alt = say(
        "Standard deviations of unit weight of {k} blocks, from {low} to {high}; {beyond} are outlying.",
        k=len(rows),
        low=significant(float(s0.min()), 3),
        high=significant(float(s0.max()), 3),
        beyond=int(beyond.sum()),
    )
    return Figure("blocks", "s0 of each block against its redundancy", caption, alt, plots.drawn("blocks", (7.2, 3.2), draw))


def _block_table(study: BatchStudy) -> list[Block]:
    done = study.having("converged")
    if not done:
        return []
    order = {name: i for i, name in enumerate(study.outlying)}
    chosen = sorted(
        done, key=lambda r: (order.get(r["block"], len(order)), r["global_p_value"] if r["global_p_value"] is not None else 2.0)
    )
    rows = [
        (
            r["block"],
            str(r["images"]),
            str(r["observations"]),
            str(r["redundancy"]),
            significant(r["sigma0"], 4),
            _decision(r["global_rejected"], "bad"),
            str(r["suspected"]) if r["suspected"] is not None else "",
            fixed(r["worst_statistic"], 2),
            r["worst_observation"] or "",
            _decision(r["control_points_rejected"], "bad"),
            _decision(r["check_points_rejected"], "bad"),
        )
        for r in chosen[:MOST_ROWS]
    ]
    columns = (
        Column("block", "", "name of its folder in blocks", "left"),
        Column("images"),
        Column("n", "", "number of observations"),
        Column("r", "", "redundancy"),
        Column("s0", "", "a posteriori"),
        Column("global test", "", "", "left"),
        Column("suspected", "", "observations suspected of a gross error"),
        Column("statistic", "", "of the worst observation: tau or w"),
        Column("observation", "", "the worst", "left"),
        Column("control points", "", "", "left"),
        Column("check points", "", "", "left"),
    )
    note = " ".join(t for t in ("The outlying blocks first, then by the p-value of the global test.", _shortened(done)) if t)
    return [DataTable("Blocks", columns, tuple(rows), note, folded=len(rows) > 30)]


def _decision(rejected: bool | None, grave: Tone) -> str | Cell:
    return "" if rejected is None else Cell("rejected", grave) if rejected else Cell("not rejected", "good")


# ---- JSON, tables, folder ------------------------------------------------------------------------------------------------------------


def result_json(study: BatchStudy) -> dict[str, Any]:
    """Return the content of `batch.json`; its schema is "baarda.batch/1".

    Parameters
    ----------
    study : BatchStudy

    Returns
    -------
    dict
    """
    counted = {status: len(study.having(status)) for status in ("converged", "not_converged", "failed")}
    t, each = study.bartlett, study.per_block
    tests = []
    if t is not None:
        tests.append(
            {
                "name": t.name,
                "null": t.null,
                "statistic": t.statistic,
                "df": list(t.df),
                "law": t.law_name,
                "critical": t.critical,
                "p_value": t.p_value,
                "alpha": t.alpha,
                "rejected": t.rejected,
                "note": t.note,
            }
        )
    deviations = {} if each is None else dict(zip(each.labels, np.asarray(each.p_value).tolist(), strict=True))
    document = {
        "schema": SCHEMA,
        "status": "finished",
        "counts": {"blocks": len(study.rows), **counted},
        "alpha": study.alpha,
        "tests": tests,
        "outlying_blocks": list(study.outlying),
        "pooled_sigma0": study.pooled,
        "gates": study.gates,
        "blocks": [{**r, "variance_p_value": deviations.get(str(r["block"]))} for r in study.rows],
        "left_out": [{"what": what, "why": why} for what, why in study.left_out],
        "verdict": verdict(study),
        "software": software(),
    }
    return dict(plain(document))


def summary_table(study: BatchStudy) -> Table:
    """Return the table of the blocks, a row each.

    Parameters
    ----------
    study : BatchStudy

    Returns
    -------
    Table
        Numbers and words as in the rows; what does not apply is empty.
    """
    out: dict[str, Any] = {}
    for name in COLUMNS:
        values = [r[name] for r in study.rows]
        if name in _NUMBERS:
            out[name] = np.array([math.nan if v is None else v for v in values], dtype=float)
        else:
            out[name] = np.array(["" if v is None else str(v).lower() if isinstance(v, bool) else str(v) for v in values], dtype=object)
    outlying = set(study.outlying)
    out["outlying"] = np.array(["true" if r["block"] in outlying else "false" if r["sigma0"] else "" for r in study.rows], dtype=object)
    return Table(out)


def html(study: BatchStudy, made: list[Section]) -> str:
    """Return the report as one page.

    Parameters
    ----------
    study : BatchStudy
    made : list of Section

    Returns
    -------
    str
    """
    tones = [s.tone for s in sentences(study)]
    whole = ("bad", "A block failed, or a test") if "bad" in tones else ("warn", "Some blocks need attention")
    whole = whole if {"bad", "warn"} & set(tones) else ("good", "No test failed")
    done = len(study.having("converged"))
    facts = [("blocks", str(len(study.rows))), ("converged", str(done)), ("outlying", str(len(study.outlying)))]
    facts += [("pooled s0", significant(study.pooled, 4))] if study.pooled else []
    return page.render("Report on many blocks", plural(len(study.rows), "block"), tr("finished"), (whole[0], tr(whole[1])), facts, made)


def write_summary(
    study: BatchStudy, out: str | Path, tables: str = "csv", facts: Mapping[str, Any] | None = None, spoken: str = "en"
) -> Path:
    """Write table, JSON and page of a batch into its folder, beside the folders of the blocks.

    Parameters
    ----------
    study : BatchStudy
    out : str or Path
        See `begin`.
    tables : {"csv", "parquet"}
    facts : mapping, optional
        What differs from run to run (timings, workers), for `run.json`.
    spoken : str
        Language of the page.

    Returns
    -------
    Path

    Raises
    ------
    OutputError
        If it cannot be written; the folders of the blocks are kept.
    """
    folder = Path(out)
    with language(spoken):
        made = sections(study)
        contents = Contents(
            result_json_english(study), html(study, made), page.figures(made), {"blocks": summary_table(study)}, facts or {}
        )
    _remove_left(folder)
    beside = write(contents, folder / _NEW, MARK, tables)
    try:
        # batch.json says "running" until all else is in place
        for name in sorted((p.name for p in beside.iterdir()), key=lambda n: n == MARK.file):
            target = folder / name
            if target.is_dir():
                shutil.rmtree(target)
            (beside / name).replace(target)
    except OSError as error:
        raise OutputError(f"cannot write {error.filename or folder}: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            shutil.rmtree(beside)
    return folder


def result_json_english(study: BatchStudy) -> dict[str, Any]:
    """Return `result_json` in English, whatever the language of the page is."""
    with language("en"):
        return result_json(study)
