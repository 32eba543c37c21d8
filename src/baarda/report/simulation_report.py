"""A planned network told: predicted precision and reliability, and what replicas prove; result folder, JSON, and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baarda.discover import members
from baarda.formats.folder import Mark
from baarda.network import Table
from baarda.observations import component_unit
from baarda.procedures.planning import Planned
from baarda.procedures.proof import LIMIT, Proof, RateProof, SigmaProof
from baarda.procedures.testing import Analysis
from baarda.report import page
from baarda.report.contents import Contents, plain, software, write
from baarda.report.sections._numbers import fixed, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Paragraph, Section, SectionMaker, Tone, Verdict, say, translated
from baarda.report.simulation_verdict import largest, median, prediction, sentences
from baarda.report.translation import language, tr

SCHEMA = "baarda.simulation/1"
MARK = Mark("result.json", "baarda.simulation/", ("report.html", "result.json", "run.json", "tables", "figures", "project"))
_SHARED = ("network-plan", "cameras", "points")  # sections of an adjustment that hold for a prediction, too


def verdict(planned: Planned, proof: Proof | None = None) -> list[str]:
    """Return the outcome in plain sentences.

    Parameters
    ----------
    planned : Planned
    proof : Proof, optional

    Returns
    -------
    list of str

    Examples
    --------
    >>> from baarda.procedures.planning import plan
    >>> from baarda.procedures.synthetic import ring
    >>> verdict(plan(ring(5, points=12).network))[0][:34]
    '138 observations, 69 unknowns, red'
    """
    return [page.printable(s.text) for s in sentences(planned, proof)]


# ---- sections ----
def sections(planned: Planned, proof: Proof | None) -> list[Section]:
    """Return the sections of the report."""
    analysis = Analysis(planned.adjustment, _apriori(planned), ())
    made = [Section("verdict", "Verdict", (Verdict(tuple(sentences(planned, proof))),))]
    if proof is not None:
        made.append(Section("proof", "Predicted and sampled", tuple(_proof_blocks(proof))))
    made.append(Section("reliability", "Reliability of the observations", tuple(_reliability(planned))))
    makers = [m for m in members("baarda.report.sections", SectionMaker) if isinstance(m, SectionMaker) and m.id in _SHARED]
    shared = (m.make(analysis) for m in sorted(makers, key=lambda m: m.order))
    return [*(translated(s) for s in made), *(s for s in shared if s is not None)]


def _apriori(planned: Planned) -> Any:
    from dataclasses import replace

    return replace(planned.options, sigma="apriori")


def _reliability(planned: Planned) -> list[Block]:
    a, table = planned.adjustment, planned.observations
    rows = []
    for g, group in enumerate(a.groups):
        at = slice(int(a.offsets[g]), int(a.offsets[g + 1]))
        r, bias, external = a.redundancy_numbers[at], table["mdb"][at], table["external"][at]
        free = int((~planned.controlled[at]).sum())
        ratio = bias / a.sigmas[at]
        units = dict.fromkeys(component_unit(group, c) for c in range(len(group.components)))
        rows.append(
            (
                group.name,
                str(len(r)),
                ", ".join(units),
                fixed(float(r.mean()), 3),
                fixed(float(r.min()), 3),
                str(free),
                significant(median(bias)),
                significant(largest(bias)),
                significant(median(ratio)),
                significant(median(external)),
                significant(largest(external)),
            )
        )
    columns = (
        Column("group", "", "", "left"),
        Column("n", "", "number of observations"),
        Column("unit", "", "of the MDB", "left"),
        Column("mean r", "", "mean redundancy number: share of an error that shows in the residuals"),
        Column("least r", "", "least redundancy number"),
        Column("uncontrolled", "", "observations that no other controls"),
        Column("median MDB", "", "minimal detectable bias, unit of the observation"),
        Column("largest MDB", "", "of the controlled observations"),
        Column("MDB / sigma", "", "median, in multiples of the standard deviation of the observation"),
        Column("median external", "", "largest effect of an undetected bias on any function of the unknowns, in its standard deviations"),
        Column("largest external", "", "likewise, the largest"),
    )
    weakest = np.argsort(np.where(planned.controlled, a.controlled_share, -1.0), kind="stable")[:20]
    worst = [
        (
            str(table["group"][i]),
            str(table["image"][i]),
            str(table["point"][i]),
            str(table["component"][i]),
            fixed(float(a.redundancy_numbers[i]), 4),
            significant(float(table["mdb"][i])),
            significant(float(table["external"][i])),
        )
        for i in weakest
    ]
    heads = ("group", "image", "point", "component")
    listed = DataTable(
        "The least controlled observations",
        (*(Column(h, "", "", "left") for h in heads), Column("r"), Column("MDB"), Column("external")),
        tuple(worst),
        "All observations: tables/observations.csv.",
        folded=True,
    )
    return [DataTable("Reliability by group", columns, tuple(rows)), listed]


def _proof_blocks(p: Proof) -> list[Block]:
    text = say(
        "Each replica adds normal errors of the stated standard deviations to observations computed from the true geometry, is adjusted "
        "and tested. Seed {seed}; differences beyond {limit:g} standard errors count as proof of the contrary.",
        seed=p.replicas.seed,
        limit=LIMIT,
    )
    return [Paragraph(text), _sigma_table(p), _rate_table("Sizes of the tests: true hypotheses rejected", p.sizes), *_power_table(p)]


def _decision(holds: bool, told: bool = True) -> Cell:
    if not told:
        return Cell("too few replicas", "info")
    return Cell("as predicted", "good") if holds else Cell("beyond chance", "bad")


def _sigma_table(p: Proof) -> DataTable:
    rows: list[tuple[str | Cell, ...]] = []
    for s in (*p.sigmas, p.residuals):
        rows.append((tr(s.name), str(s.count), significant(s.predicted), fixed(s.ratio, 3), f"{fixed(s.low, 3)}..{fixed(s.high, 3)}"))
        rows[-1] += (fixed(s.z, 1), _decision(s.holds))
    columns = (
        Column("of", "", "", "left"),
        Column("unknowns", "", "number of unknowns in the group"),
        Column(
            "predicted sigma",
            "",
            "median of the predicted standard deviations, a priori, in the unit of the object space; angles in radians",
        ),
        Column(
            "sampled / predicted", "", "root mean square of the errors of all replicas, each divided by its predicted standard deviation"
        ),
        Column("95 % interval", "", "of the true ratio, chi-square"),
        Column("z", "", "deviation from 1 in standard errors"),
        Column("decision", "", "", "left"),
    )
    note = say(
        "Most deviating single unknown: {name}, ratio {ratio}, probability among {u} unknowns {p}. Largest mean error: {other}, {mean} of "
        "its standard deviation, probability {q}.",
        name=p.worst[0],
        ratio=fixed(p.worst[1], 3),
        p=probability(p.worst[2]),
        u=len(p.replicas.sigmas),
        other=p.bias[0],
        mean=fixed(p.bias[1], 3),
        q=probability(p.bias[2]),
    )
    return DataTable("Standard deviations: sampled and predicted", columns, tuple(rows), note)


def _rate_table(caption: str, proofs: tuple[RateProof, ...], note: str = "") -> DataTable:
    rows: list[tuple[str | Cell, ...]] = []
    for r in proofs:
        interval = f"{fixed(100 * r.low, 2)}..{fixed(100 * r.high, 2)}"
        members = str(round(r.members)) if float(r.members).is_integer() else significant(r.members)
        rows.append((r.name.replace("_", " "), members, fixed(100 * r.expected, 2), fixed(100 * r.rate, 2), interval, fixed(r.z, 1)))
        rows[-1] += (_decision(r.holds, r.told),)
    columns = (
        Column("test", "", "", "left"),
        Column("members", "", "statistics per replica"),
        Column("expected", "%", "level, or power"),
        Column("rejected", "%", "rate over all replicas and members"),
        Column("95 % interval", "%", "of the true rate"),
        Column("z", "", "deviation in standard errors"),
        Column("decision", "", "", "left"),
    )
    return DataTable(caption, columns, tuple(rows), note)


def _power_table(p: Proof) -> list[Block]:
    if p.power is None:
        return [Paragraph("No observation is controlled by others: nothing has a detectable bias.", "warn")]
    note = say(
        "In each replica one observation, drawn at random, gets its own minimal detectable bias. In {right} % it has the largest |w|.",
        right=fixed(100 * p.identified, 1),
    )
    return [_rate_table("Power", (p.power,), note)]


# ---- JSON, tables, folder ----
def result_json(planned: Planned, proof: Proof | None = None) -> dict[str, Any]:
    """Return the content of `result.json`; its schema is "baarda.simulation/1".

    Parameters
    ----------
    planned : Planned
    proof : Proof, optional

    Returns
    -------
    dict
        JSON-compatible; numbers that do not exist are None.
    """
    a, o = planned.adjustment, planned.options
    document = {
        "schema": SCHEMA,
        "source": {"path": a.network.path, "format": a.network.format, "sha256": a.network.sha256},
        "truth": {"source": planned.source, "reason": planned.reason},
        "options": {"alpha": o.alpha, "alpha_outlier": o.alpha_outlier, "power": o.power},
        "assumptions": list(a.assumptions),
        "counts": {
            "images": len(a.network.images.labels),
            "object_points": int((~a.aside).sum()),
            "observations": a.count,
            "unknowns": a.numbering.count,
            "datum_defect": a.datum.defect.count,
            "redundancy": a.redundancy,
        },
        "datum": {"name": a.datum.name, "text": a.datum.text},
        "prediction": prediction(planned),
        "unknowns": [row for row in a.unknown_table("apriori").rows() if row["group"] == "camera"],
        "proof": None if proof is None else _proof_json(proof),
        "verdict": verdict(planned, proof),
        "software": software(),
    }
    return dict(plain(document))


def _proof_json(p: Proof) -> dict[str, Any]:
    return {
        "replicas": p.replicas.asked,
        "with_result": p.replicas.count,
        "failed": list(p.replicas.batch.failed[:20]),
        "seed": p.replicas.seed,
        "holds": p.holds,
        "sigmas": [_sigma_json(s) for s in (*p.sigmas, p.residuals)],
        "most_deviating": {"name": p.worst[0], "ratio": p.worst[1], "p_value": p.worst[2]},
        "largest_mean_error": {"name": p.bias[0], "in_sigma": p.bias[1], "p_value": p.bias[2]},
        "objective": _rate_json(p.objective),
        "sizes": [_rate_json(r) for r in p.sizes],
        "power": None if p.power is None else {**_rate_json(p.power), "identified": p.identified},
    }


def _sigma_json(s: SigmaProof) -> dict[str, Any]:
    return {**vars(s), "interval": [s.low, s.high], "holds": s.holds}


def _rate_json(r: RateProof) -> dict[str, Any]:
    return {**vars(r), "interval": [r.low, r.high], "holds": r.holds if r.told else None}


def tables(planned: Planned, proof: Proof | None = None) -> dict[str, Table]:
    """Return the tables of the result folder by name."""
    a = planned.adjustment
    images = a.image_table("apriori")
    out = {
        "observations": planned.observations,
        "points": a.point_table("apriori"),
        "images": Table({k: v for k, v in images.columns.items() if k != "rms"}, images.units),
        "unknowns": a.unknown_table("apriori"),
    }
    if proof is not None:
        b, k = proof.replicas.batch, proof.replicas.count
        sampled = np.sqrt(b.squares / k)
        named = {"name": np.array(a.numbering.names, dtype=object), "predicted": proof.replicas.sigmas}
        out["sampled"] = Table({**named, "ratio": sampled, "mean_error": b.sums / k})
        rates = (*proof.sizes, *((proof.power,) if proof.power else ()))
        out["sizes"] = Table(
            {
                "test": np.array([r.name for r in rates], dtype=object),
                **{f: np.array([getattr(r, f) for r in rates], dtype=float) for f in ("members", "expected", "rate", "low", "high", "z")},
            }
        )
    return out


def write_folder(
    planned: Planned,
    proof: Proof | None,
    out: str | Path,
    table_format: str = "csv",
    facts: Mapping[str, Any] | None = None,
    spoken: str = "en",
) -> Path:
    """Write the result folder.

    Parameters
    ----------
    planned : Planned
    proof : Proof or None
    out : str or Path
        There whole or not at all; an earlier result folder of a simulation there is replaced.
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
    document, content = result_json(planned, proof), tables(planned, proof)
    with language(spoken):
        made = sections(planned, proof)
        contents = Contents(
            document, html(planned, proof, made), page.figures(made), content, facts or {}, network=planned.adjustment.network
        )
    return write(contents, out, MARK, table_format)


def html(planned: Planned, proof: Proof | None, made: list[Section]) -> str:
    """Return the report as one page.

    Parameters
    ----------
    planned : Planned
    proof : Proof or None
    made : list of Section
        See `sections`.

    Returns
    -------
    str
    """
    a = planned.adjustment
    tones: list[Tone] = [s.tone for s in sentences(planned, proof)]
    bad, warn = tones.count("bad"), tones.count("warn")
    whole = ("bad", "Predictions do not hold") if bad else ("warn", "The network needs attention") if warn else ("good", "Nothing objects")
    told = [("images", str(len(a.network.images.labels))), ("observations n", str(a.count)), ("unknowns u", str(a.numbering.count))]
    told += [("redundancy r", str(a.redundancy)), ("replicas", str(proof.replicas.count) if proof else tr("none"))]
    name = a.network.name or a.network.path or tr("network in memory")
    return page.render("Simulation report", name, "predicted" if proof is None else "proven", (whole[0], tr(whole[1])), told, made)
