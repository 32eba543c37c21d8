"""Many resections told: result folder, JSON, and the verdict in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baarda.adjustment import Adjustment
from baarda.formats.folder import Mark
from baarda.formats.residual_table import ResidualTable
from baarda.hypotheses.base import TestResult
from baarda.network import EXTERIOR, Network, Table
from baarda.procedures.resection_sets import Resections, pooled_columns
from baarda.report import page
from baarda.report.contents import Contents, plain, software, write
from baarda.report.laws_json import law_json, scale_rule_json
from baarda.report.residual_report import result_tables
from baarda.report.residual_sections import sections as residual_sections
from baarda.report.residual_verdict import sentences as residual_sentences
from baarda.report.sections._facts import first
from baarda.report.sections._numbers import MISSING, fixed, names, plural, probability, significant, with_sigma
from baarda.report.sections.base import Block, Cell, Column, DataTable, Items, Section, Sentence, Tone, Verdict, say, translated
from baarda.report.translation import language, tr

SCHEMA = "baarda.resections/1"
MARK = Mark("result.json", "baarda.resections/", ("report.html", "result.json", "run.json", "tables", "figures"))
_MOST = 400


def _table_of(made: Resections, sources: Sequence[Network]) -> ResidualTable:
    """The pooled residuals as the study of residuals tells them."""
    v, codes, sigmas, shares = pooled_columns(made)
    labels = tuple(label for label, _ in made.adjusted)
    path = ", ".join(n.path or n.name for n in sources)
    return ResidualTable(
        path, "csv", "residual", v, "set", codes, labels, "sigma", sigmas, "redundancy", shares, assumptions=assumptions(sources)
    )


def assumptions(sources: Sequence[Network]) -> tuple[str, ...]:
    """Return what was taken for granted."""
    made = [tr("Control points are held at their given coordinates; their standard deviations play no part in a resection.")]
    made += list(dict.fromkeys(text for n in sources for text in n.assumptions))
    return tuple(made)


def _decimal(x: float) -> str:
    return significant(x, 4)


def sentences(made: Resections, sources: Sequence[Network]) -> list[Sentence]:
    """Return the verdict.

    Parameters
    ----------
    made : Resections
    sources : sequence of Network
        What was read.

    Returns
    -------
    list of Sentence
    """
    good, failed = made.adjusted, made.failed
    n = sum(a.count for _, a in good)
    text = say(
        "{good} of {sets} resected, each by itself: {n} observations, pooled redundancy {r}, pooled s0 {s0}.",
        good=len(good),
        sets=plural(len(made.sets), "set was", "sets were"),
        n=n,
        r=made.redundancy,
        s0=fixed(made.sigma0, 4),
    )
    if failed:
        text += say(" {count} failed: {names}.", count=len(failed), names=names([s.label for s in failed], 8))
    out = [Sentence("Sets", text, "warn" if failed else "good", "sets")]
    test = made.homogeneity
    if test is not None:
        limits = made.against_pooled()
        beyond = [label for (label, _), (x, low, high) in zip(good, limits, strict=True) if not low <= x <= high]
        text = say(
            "The variances of the sets are {verb} (Bartlett {t}, limit {limit}, p {p}); against the pooled variance {beyond} of {k} lie "
            "outside their limits at level {alpha}{which}.",
            verb=tr("not equal: do not pool them unthinkingly") if test.rejected else tr("not shown to differ"),
            t=fixed(float(test.statistic), 2),
            limit=fixed(float(np.max(test.critical)), 2),
            p=_p(test.p_value),
            beyond=len(beyond),
            k=len(good),
            alpha=f"{test.alpha:g}",
            which=f" ({names(beyond, 6)})" if beyond else "",
        )
        out.append(Sentence("Homogeneity", text, "bad" if test.rejected else "good", "sets"))
    worst = _suspected(made)
    tested = sum(int(np.isfinite(tau).sum()) for tau, _ in made.outliers)
    if worst:
        label, place, tau, limit = worst[0]
        text = say(
            "{found} of {tested} observations {verb} suspected of a gross error; the worst is {place} of set {label} with tau = {tau} "
            "(limit {limit}).",
            found=len(worst),
            verb="is" if len(worst) == 1 else "are",
            tested=tested,
            place=place,
            label=label,
            tau=fixed(tau, 2),
            limit=fixed(limit, 2),
        )
        out.append(Sentence("Gross errors", text, "warn", "suspected"))
    else:
        out.append(
            Sentence("Gross errors", say("None of {tested} observations is suspected of a gross error.", tested=tested), "good", "sets")
        )
    if made.study is None:
        out.append(Sentence("Residuals", say("The residuals were not studied together: {why}.", why=made.left_out), "info", "sets"))
    else:
        out += [s for s in residual_sentences(_table_of(made, sources), made.study) if s.subject not in ("Homogeneity", tr("Homogeneity"))]
    return out


def _p(p: float | None) -> str:
    text = probability(p)
    return text if text.startswith("<") else f"= {text}"


def verdict(made: Resections, sources: Sequence[Network]) -> list[str]:
    """Return the outcome in plain sentences.

    Parameters
    ----------
    made : Resections
    sources : sequence of Network

    Returns
    -------
    list of str
    """
    return [page.printable(s.text) for s in sentences(made, sources)]


def _suspected(made: Resections) -> list[tuple[str, str, float, float]]:
    """Return set, place, tau and limit of all suspected observations, the worst first."""
    out = []
    for (label, a), (tau, limit) in zip(made.adjusted, made.outliers, strict=True):
        beyond = np.flatnonzero(np.abs(tau) > limit).tolist()
        if not beyond:
            continue
        table = a.observations
        for row in beyond:
            out.append((label, f"point {table['point'][row]} {table['component'][row]}", float(tau[row]), limit))
    return sorted(out, key=lambda x: -abs(x[2]) / x[3])


# ---- sections ----
def sections(made: Resections, sources: Sequence[Network]) -> list[Section]:
    """Return the sections of the report.

    Parameters
    ----------
    made : Resections
    sources : sequence of Network

    Returns
    -------
    list of Section
    """
    out = [translated(Section("verdict", "Verdict", (Verdict(tuple(sentences(made, sources))),)))]
    blocks: list[Block] = [_sets_table(made)]
    if made.failed:
        blocks.append(Items("Sets that failed:", tuple(f"{s.label}: {s.reason}" for s in made.failed[:_MOST])))
    blocks.append(Items("Assumptions:", assumptions(sources)))
    out.append(translated(Section("sets", "The sets", tuple(blocks))))
    out.append(translated(Section("orientation", "Exterior orientations", (_orientations(made, sources),))))
    worst = _suspected(made)
    if worst:
        rows = tuple((label, place, fixed(tau, 2), fixed(limit, 2)) for label, place, tau, limit in worst[:_MOST])
        columns = (Column("set", "", "", "left"), Column("observation", "", "", "left"), Column("tau"), Column("limit"))
        out.append(translated(Section("suspected", "Suspected observations", (DataTable("Suspected observations", columns, rows),))))
    if made.study is not None:
        pooled = residual_sections(_table_of(made, sources), made.study)
        out += [s for s in pooled if s.id != "verdict"]
    return out


def _sets_table(made: Resections) -> DataTable:
    limits = iter(zip(made.against_pooled(), made.global_tests(), made.outliers, strict=True))
    rows: list[tuple[str | Cell, ...]] = []
    for s in made.sets[:_MOST]:
        a = s.adjustment
        if a is None:
            rows.append((s.label, str(s.points), *("",) * 9, Cell("failed", "bad")))
            continue
        (ratio, low, high), test, (tau, limit) = next(limits)
        inside = low <= ratio <= high
        size = np.abs(tau[np.isfinite(tau)])
        rows.append(
            (
                s.label,
                str(s.points),
                str(a.count),
                str(a.redundancy),
                fixed(a.sigma0, 4),
                significant(float(np.sqrt(np.mean(a.residuals**2))), 3),
                _decimal(float(ratio)),
                f"{_decimal(float(low))}..{_decimal(float(high))}",
                Cell("agrees", "good") if inside else Cell("differs", "warn"),
                probability(test.p_value),
                f"{fixed(float(size.max()), 2)} ({fixed(limit, 2)})" if len(size) else MISSING,
                Cell("suspicious", "warn") if len(size) and size.max() > limit else Cell("adjusted", "good"),
            )
        )
    columns = (
        Column("set", "", "", "left"),
        Column("points", "", "control points measured in the image"),
        Column("n", "", "observations"),
        Column("r", "", "redundancy"),
        Column("s0", "", "standard deviation of unit weight; 1 = as the a-priori sigmas promise"),
        Column("rms v", "px", "root mean square of the residuals"),
        Column("r S² / S² pooled", "", "chi-square under equal variances, approximately"),
        Column("limits", "", say("two-sided, level {alpha}", alpha=f"{made.options.alpha:g}")),
        Column("decision", "", "", "left"),
        Column("p, global", "", "variance factor of the set against the a-priori one"),
        Column("max |tau| (limit)", "", "largest residual in its own standard deviations"),
        Column("status", "", "", "left"),
    )
    note = first(len(made.sets), _MOST, "tables/sets")
    return DataTable("Adjustments of the sets", columns, tuple(rows), note)


def _orientations(made: Resections, sources: Sequence[Network]) -> DataTable:
    unit = sources[0].unit
    rows = []
    for label, a in made.adjusted[:_MOST]:
        values, deviations = _exterior(a, made.options.sigma)
        cells: list[str] = []
        for k in range(6):
            factor = 1.0 if k < 3 else float(np.degrees(1.0))
            sigma = float(deviations[k]) * factor
            cells += with_sigma(float(values[k]) * factor, sigma if np.isfinite(sigma) else None)
        rows.append((label, *cells))
    columns = [Column("set", "", "", "left")]
    for k, name in enumerate(EXTERIOR):
        columns += [Column(name, unit if k < 3 else "°"), Column(f"s {name}", unit if k < 3 else "°", "standard deviation")]
    return DataTable("Exterior orientations", tuple(columns), tuple(rows), first(len(made.adjusted), _MOST, "tables/sets"))


def _exterior(a: Adjustment, sigma: Any) -> tuple[np.ndarray, np.ndarray]:
    table = a.image_table(sigma)
    keys = [name if k < 3 else f"{name}_rad" for k, name in enumerate(EXTERIOR)]
    return np.array([float(table[k][0]) for k in keys]), np.array([float(table[f"s{k}"][0]) for k in keys])


# ---- JSON, tables, folder ----
def result_json(made: Resections, sources: Sequence[Network]) -> dict[str, Any]:
    """Return the content of `result.json`; its schema is "baarda.resections/1".

    Parameters
    ----------
    made : Resections
    sources : sequence of Network

    Returns
    -------
    dict
        JSON-compatible; numbers that do not exist are None.
    """
    found = iter(zip(made.against_pooled(), made.global_tests(), made.outliers, strict=True))
    sets = []
    for s in made.sets:
        a = s.adjustment
        row: dict[str, Any] = {"set": s.label, "status": "failed" if a is None else "adjusted", "points": s.points}
        if a is None:
            sets.append({**row, "reason": s.reason})
            continue
        (ratio, low, high), test, (tau, limit) = next(found)
        values, deviations = _exterior(a, made.options.sigma)
        row |= {"observations": a.count, "redundancy": a.redundancy, "objective": a.objective, "sigma0": a.sigma0}
        row |= {"against_pooled": {"statistic": ratio, "lower": low, "upper": high, "rejected": not low <= ratio <= high}}
        row |= {"global_variance_factor": _test(test), "suspected": int((np.abs(tau) > limit).sum())}
        sets.append(
            {**row, "exterior": [{"name": n, "value": v, "sigma": s} for n, v, s in zip(EXTERIOR, values, deviations, strict=True)]}
        )
    o, study = made.options, made.study
    document = {
        "schema": SCHEMA,
        "sources": [{"path": n.path, "format": n.format, "sha256": n.sha256} for n in sources],
        "assumptions": list(assumptions(sources)),
        "options": {"alpha": o.alpha, "alpha_outlier": o.alpha_outlier, "sigma": o.sigma, "seed": o.seed},
        "counts": {
            "sets": len(made.sets),
            "adjusted": len(made.adjusted),
            "failed": len(made.failed),
            "observations": sum(a.count for _, a in made.adjusted),
            "redundancy": made.redundancy,
        },
        "sigma0": made.sigma0,
        "sets": sets,
        "homogeneity": None if made.homogeneity is None else _test(made.homogeneity),
        "study": None
        if study is None
        else {
            "kind": study.kind,
            "mean": study.mean,
            "standard_deviation": study.deviation,
            "skewness": study.skewness,
            "kurtosis": study.kurtosis,
            "redundancy": study.redundancy,
            "sigma0": study.sigma0,
            "tests": [
                _test(t) for t in (*study.tests, *(study.groups.tests if study.groups is not None else ())) if not np.ndim(t.statistic)
            ],
            "laws": [law_json(study.laws, s) for s in study.laws.laws],
            "scale_rules": [scale_rule_json(r) for r in study.scale_rules],
        },
        "left_out": made.left_out or None,
        "verdict": verdict(made, sources),
        "software": software(),
    }
    return dict(plain(document))


def _test(t: TestResult) -> dict[str, Any]:
    out = {"name": t.name, "null": t.null, "statistic": t.statistic, "df": list(t.df), "law": t.law_name, "alpha": t.alpha}
    return {**out, "critical": t.critical, "p_value": t.p_value, "rejected": t.rejected, **({"note": t.note} if t.note else {})}


def tables(made: Resections) -> dict[str, Table]:
    """Return the tables of the result folder by name; `residuals` is one that the verb `residuals` reads.

    Parameters
    ----------
    made : Resections

    Returns
    -------
    dict of Table
    """
    limits = iter(made.against_pooled())
    names_ = ["X0", "Y0", "Z0", "omega_rad", "phi_rad", "kappa_rad"]
    rows: list[list[Any]] = []
    for s in made.sets:
        a = s.adjustment
        if a is None:
            rows.append([s.label, "failed", s.points, 0, 0, *(np.nan,) * 17, s.reason])
            continue
        values, deviations = _exterior(a, made.options.sigma)
        rows.append([s.label, "adjusted", s.points, a.count, a.redundancy, a.objective, a.sigma0, *next(limits), *values, *deviations, ""])
    heads = ["set", "status", "points", "observations", "redundancy", "vpv", "sigma0", "statistic", "lower", "upper"]
    heads += [*names_, *(f"s{n}" for n in names_), "reason"]
    texts, counts = ("set", "status", "reason"), ("points", "observations", "redundancy")
    kinds = {n: object if n in texts else int if n in counts else float for n in heads}
    columns = {n: np.array([row[k] for row in rows], dtype=kinds[n]) for k, n in enumerate(heads)}
    v, codes, sigmas, shares = pooled_columns(made)
    observed = [a.observations for _, a in made.adjusted]
    residuals = {
        "group": np.array([label for label, _ in made.adjusted], dtype=object)[codes],
        "point": np.concatenate([t["point"] for t in observed]),
        "component": np.concatenate([t["component"] for t in observed]),
        "residual": v,
        "sigma": sigmas,
        "redundancy": shares,
        "tau": np.concatenate([tau for tau, _ in made.outliers]),
    }
    study = {} if made.study is None else result_tables(made.study)
    return {"sets": Table(columns), "residuals": Table(residuals), **study}


def write_folder(
    made: Resections,
    sources: Sequence[Network],
    out: str | Path,
    table_format: str = "csv",
    facts: Mapping[str, Any] | None = None,
    spoken: str = "en",
) -> Path:
    """Write the result folder.

    Parameters
    ----------
    made : Resections
    sources : sequence of Network
    out : str or Path
        There whole or not at all; an earlier result folder of resections there is replaced.
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
    document, content = result_json(made, sources), tables(made)
    with language(spoken):
        told = sections(made, sources)
        contents = Contents(document, html(made, sources, told), page.figures(told), content, facts or {})
    return write(contents, out, MARK, table_format)


def html(made: Resections, sources: Sequence[Network], told: list[Section]) -> str:
    """Return the report as one page.

    Parameters
    ----------
    made : Resections
    sources : sequence of Network
    told : list of Section
        See `sections`.

    Returns
    -------
    str
    """
    tones: list[Tone] = [s.tone for s in sentences(made, sources)]
    bad = "bad" in tones
    overall = ("bad", "A test failed") if bad else ("warn", "Needs attention") if "warn" in tones else ("good", "No test failed")
    head = [("sets", str(len(made.sets))), ("adjusted", str(len(made.adjusted))), ("redundancy", str(made.redundancy))]
    head += [("pooled s0", f"{made.sigma0:.4g}")]
    name = names([n.path or n.name or tr("in memory") for n in sources], 3)
    return page.render("Resection report", name, "resected", (overall[0], tr(overall[1])), head, told)
