"""The result folder: report, JSON, tables, figures and the adjusted project; there whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from baarda.adjustment import Adjustment
from baarda.adjustment.parameter_hypotheses import Collinearity
from baarda.formats.folder import Mark
from baarda.hypotheses.base import TestResult
from baarda.network import Table
from baarda.observations import Direct, ImageCoordinates, ImagePoints
from baarda.procedures.testing import Analysis
from baarda.report.accuracy import accuracy_json
from baarda.report.contents import Contents, check_tables, plain, software, write
from baarda.report.laws_json import critical_json, laws_json, study_json

SCHEMA = "baarda.result/1"
MARK = Mark("result.json", "baarda.result/", ("report.html", "report.pdf", "result.json", "run.json", "tables", "figures", "project"))


def result_json(analysis: Analysis) -> dict[str, Any]:
    """Return the content of `result.json` (contract, section 2)."""
    a, o, chosen = analysis.adjustment, analysis.options, analysis.strategy
    net = a.network
    roles = net.points.roles[~a.aside]
    used = o.sigma if analysis.converged else "apriori"
    table = a.unknown_table(o.sigma)
    kinds = {"camera"} | {d.kind for d in net.declared if d.removable().any()}  # a radar track is oriented by its parameters, too
    camera = [row for row in table.rows() if row["group"] in kinds]
    fixed = [
        {
            "name": f"camera {c.label}: {n}",
            "group": "camera",
            "unit": c.unit_of(k),
            "value": v,
            "sigma": None,
            "initial": v,
            "state": "fixed",
        }
        for c in net.cameras
        for k, (n, v) in enumerate(zip(c.model.order, c.values, strict=True))
        if c.states[k] == 0
    ]
    image_rows = [isinstance(g, (ImageCoordinates, ImagePoints)) for g in a.groups]
    document = {
        "schema": SCHEMA,
        "source": {"path": net.path, "format": net.format, "sha256": net.sha256},
        "status": a.status,
        "counts": {
            "images": len(net.images.labels),
            "cameras": len(net.cameras),
            "object_points": len(roles),
            "control_points": int((roles == 1).sum()),
            "check_points": int((roles == 2).sum()),
            "observations": a.count,
            "image_observations": sum(len(g) * len(g.components) for g, used in zip(a.groups, image_rows, strict=True) if used),
            "unknowns": a.numbering.count,
            "datum_defect": a.datum.defect.count,
            "datum_conditions": a.datum.defect.count,
            "redundancy": a.redundancy,
        },
        "objective": {"initial": a.history[0].objective, "final": a.objective},
        "sigma0": {"apriori": 1.0, "aposteriori": a.sigma0, "used": used},
        "iterations": len(a.history) - 1,
        "history": [
            {"iteration": h.count, "objective": h.objective, "relative_step": h.relative_step, "damping": h.damping, "accepted": h.accepted}
            for h in a.history
        ],
        "datum": {"name": a.datum.name, "text": a.datum.text},
        "law_of_errors": None
        if a.law is None
        else {"name": a.law.name, "values": a.law.values, "covariance_factor": a.law.covariance_factor, "resistance": a.law.resistance},
        "assumptions": list(a.assumptions),
        "points_set_aside": [net.points.labels[i] for i in np.flatnonzero(a.aside)],
        "points_almost_infinite": [net.points.labels[i] for i in a.far.points],
        "unknowns": camera + fixed,
        "correlations": [{"a": x, "b": y, "value": r} for x, y, r in a.camera_correlations()] if analysis.converged else [],
        **_collinearity(analysis.collinearity if analysis.converged else None),
        "tests": [_test(t) for t in analysis.tests],
        "not_applicable": [{"name": name, "reason": reason} for name, reason in analysis.not_applicable.items()],
        "laws": laws_json(analysis.study),
        "law_study": study_json(analysis.study),
        "critical_values": critical_json(analysis.study),
        "outliers": _outliers(analysis) if analysis.converged else [],
        "selection": [] if chosen is None or chosen.selection is None else [step.as_dict() for step in chosen.selection.steps],
        "snooping": None if chosen is None or chosen.snooping is None else chosen.snooping.as_dict(),
        "cross_validation": None if chosen is None or chosen.cross_validation is None else chosen.cross_validation.as_dict(),
        "strategy": [] if chosen is None else [vars(stage) for stage in chosen.stages],
        "variance_components": None if analysis.components is None else analysis.components.as_dict(),
        "audit": None if analysis.audit is None else plain(analysis.audit.as_dict()),
        "check_points": _check_points(analysis) if analysis.converged else [],
        "accuracy": accuracy_json(analysis),
        "rms": _rms(a) | {"check_intervals": _intervals(analysis)},
        "software": software(),
    }
    return dict(plain(document))


def observation_table(analysis: Analysis) -> Table:
    """Return the observation table with a column `status`: used, or rejected; what snooping rejected comes last."""
    table = analysis.observations if analysis.converged else analysis.adjustment.observations
    columns = {**table.columns, "status": np.full(len(table), "used", dtype=object)}
    s = analysis.strategy
    out = None if s is None or s.snooping is None else s.snooping.removed
    if out is not None:
        k = len(out)
        rejected = {**out.columns, "status": np.full(k, "rejected", dtype=object)}
        columns = {
            name: np.concatenate([v, rejected.get(name, np.full(k, np.nan) if v.dtype.kind == "f" else np.full(k, "", dtype=object))])
            for name, v in columns.items()
        }
    return Table(columns, table.units)


def _collinearity(c: Collinearity | None) -> dict[str, Any]:
    """Variance inflation of each camera parameter with its most correlated unknown, and the condition indices."""
    if c is None:
        return {"variance_inflation": [], "condition_indices": []}
    mutual = [None] * len(c.names) if c.mutual is None else c.mutual.tolist()
    rows = [
        {"name": n, "inflation": v, "by_camera_parameters": m, "most_correlated": other, "correlation": rho}
        for n, v, m, (other, rho) in zip(c.names, c.inflation.tolist(), mutual, c.partners, strict=True)
    ]
    return {"variance_inflation": rows, "condition_indices": [] if c.conditions is None else c.conditions.indices}


def _test(t: TestResult) -> dict[str, Any]:
    """One test; of a family the extreme member, the number beyond the limit and the number tested."""
    out: dict[str, Any] = {"name": t.name, "null": t.null, "df": list(t.df), "law": t.law_name, "alpha": t.alpha, "critical": t.critical}
    if np.ndim(t.statistic):
        p, statistic = np.asarray(t.p_value), np.asarray(t.statistic)
        tested = np.isfinite(p)
        out |= {"tested": int(tested.sum()), "beyond": int(np.sum(t.rejected)), "rejected": bool(np.any(t.rejected))}
        extreme = t.details.get("extreme")
        if extreme is not None:
            i = int(extreme["index"])
            out |= {"statistic": statistic[i], "p_value": p[i], "labels": [t.labels[i]] if t.labels else []}
        else:
            out |= {"statistic": None, "p_value": None, "labels": []}
    elif not t.details.get("applicable", True):
        out |= {"critical": None, "statistic": None, "p_value": None, "rejected": False, "applicable": False}
    else:
        out |= {"statistic": t.statistic, "p_value": t.p_value, "rejected": t.rejected}
        if t.labels:
            out["labels"] = list(t.labels)
    if t.note:
        out["note"] = t.note
    return out


def _outliers(analysis: Analysis) -> list[dict[str, Any]]:
    o = analysis.observations
    keys = ("group", "image", "point", "component", "residual", "redundancy", "w", "tau", "mdb", "estimated_error", "p_value")
    return [{k: o[k][i] for k in keys} for i in analysis.suspected]


def _check_points(analysis: Analysis) -> list[dict[str, Any]]:
    e = analysis.evidence.check
    if e is None:
        return []
    s = analysis.adjustment.scale("aposteriori") * np.sqrt(np.diag(e.cofactors))
    family = {label: i for t in analysis.tests_named("check_point") for i, label in enumerate(t.labels)}
    tests = analysis.tests_named("check_point")
    rows: dict[str, dict[str, Any]] = {}
    judged = ("statistic", "p_value", "rejected")
    for name, point, d, sd in zip(e.names, e.groups, e.values, s, strict=True):
        row = rows.setdefault(point, {"point": point} | dict.fromkeys((*(f"{k}{x}" for k in "ds" for x in "xyz"), *judged)))
        axis = name[-1].lower()
        row[f"d{axis}"], row[f"s{axis}"] = d, sd
    for point, row in rows.items():
        i = family.get(point, family.get(f"point {point}"))
        if tests and i is not None:
            t = tests[0]
            row |= {
                "statistic": np.asarray(t.statistic)[i],
                "p_value": np.asarray(t.p_value)[i],
                "rejected": bool(np.asarray(t.rejected)[i]),
            }
    return list(rows.values())


def _rms(a: Adjustment) -> dict[str, Any]:
    """Root mean squares: image residuals (px), control residuals and check differences (object units)."""
    v = [a.residuals[a.offsets[g] : a.offsets[g + 1]].reshape(-1, 2) for g, k in enumerate(a.groups) if isinstance(k, ImagePoints)]
    image = np.concatenate(v) if v else np.zeros((0, 2))
    out: dict[str, Any] = {"image_x": _root(image[:, 0]), "image_y": _root(image[:, 1]), "control": {}, "check": {}}
    for g, group in enumerate(a.groups):
        if isinstance(group, Direct) and group.kind == "point":
            values = a.residuals[a.offsets[g] : a.offsets[g + 1]]
            out["control"] = {axis.lower(): _root(values[group.positions == k]) for k, axis in enumerate("XYZ")}
    points = a.network.points
    d = (points.coordinates - points.given)[a.judges]
    if len(d):
        by_axis = [_root(d[np.isfinite(d[:, k]), k]) for k in range(3)]
        both, full = d[np.isfinite(d[:, :2]).all(axis=1)], d[np.isfinite(d).all(axis=1)]
        out["check"] = {
            "x": by_axis[0],
            "y": by_axis[1],
            "z": by_axis[2],
            "vertical": by_axis[2],
            "horizontal": _root(np.linalg.norm(both[:, :2], axis=1)),
            "3d": _root(np.linalg.norm(full, axis=1)),
        }
    return out


def _intervals(analysis: Analysis) -> dict[str, Any]:
    """Return the 95 % intervals of the root mean squares of check points, and what was predicted."""
    found = analysis.tests_named("check_axis")
    if not found:
        return {}
    k, names = found[0].details, {"Z": "vertical", "3D": "3d"}
    rows = zip(found[0].labels, k["points"], k["rms"], k["interval"], k["predicted"], strict=True)
    return {names.get(n, n.lower()): {"points": c, "rms": x, "interval": i, "predicted": m} for n, c, x, i, m in rows}


def _root(values: Any) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def write_folder(
    analysis: Analysis,
    out: str | Path,
    tables: str = "csv",
    run: dict[str, Any] | None = None,
    spoken: str = "en",
    pdf: bool = False,
) -> Path:
    """Write the result folder.

    Parameters
    ----------
    analysis : Analysis
    out : str or Path
        The folder; an earlier result folder there is replaced.
    tables : {"csv", "parquet"}
        Format of the tables.
    run : dict, optional
        What differs from run to run (timings), for `run.json`.
    spoken : str
        Language of the report and its figures; JSON and tables are English.
    pdf : bool
        Whether to write `report.pdf`, too (extra `pdf`).

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    MissingExtra
        If Parquet or PDF is asked for without its extra.
    OutputError
        If it cannot be written; nothing is left behind.
    """
    from baarda.report import page
    from baarda.report.pdf import pdf as typeset
    from baarda.report.translation import language

    check_tables(tables)
    a, o = analysis.adjustment, analysis.options
    content = {
        "observations": observation_table(analysis),
        "points": a.point_table(o.sigma),
        "images": a.image_table(o.sigma),
        "unknowns": a.unknown_table(o.sigma),
    }
    with language(spoken):
        sections = page.sections(analysis)
        html, figures = page.html(analysis, sections), page.figures(sections)
        files = {"report.pdf": typeset(analysis, sections)} if pdf else {}
    return write(Contents(result_json(analysis), html, figures, content, run or {}, files, a.network), out, MARK, tables)
