"""The laws of errors of an adjustment in `result.json`."""

from __future__ import annotations

from typing import Any

import numpy as np

from baarda.procedures.adjustment_laws import AdjustmentLaws
from baarda.procedures.error_law import Limit
from baarda.procedures.law_study import LawsStudied, LawStudy
from baarda.procedures.residual_study import ScaleRule


def law_json(laws: LawsStudied, s: LawStudy) -> dict[str, Any]:
    """Return the row of `laws`: what the contract states, then the tests by simulation and the decision.

    Parameters
    ----------
    laws : LawsStudied
    s : LawStudy
        One of them.

    Returns
    -------
    dict
    """
    f = s.fit

    def of(tests: tuple[Any, ...]) -> dict[str, Any]:
        return {t.name: {"statistic": t.statistic, "critical": t.critical, "p_value": t.p_value, "rejected": t.rejected} for t in tests}

    more = {"estimated": list(f.estimated), "standard_errors": dict(f.standard_errors), "at_bounds": list(f.at_bounds)}
    tests = {"distribution_tests": of(s.tests)} | ({"independent_tests": of(s.independent)} if laws.adjusted else {})
    return {**f.as_dict(), **more, "notes": list(f.notes), **tests, "judged_by": laws.judged_by(s), "decision": laws.rejected(s)}


def laws_json(study: AdjustmentLaws | None) -> list[dict[str, Any]]:
    """Return `laws` of an adjustment; empty where none were compared."""
    return [] if study is None else [law_json(study.laws, s) for s in study.laws.laws]


def scale_rule_json(r: ScaleRule) -> dict[str, Any]:
    """Return the row of `scale_rules`."""
    f = r.fit
    return {
        "rule": r.name,
        "symbol": r.symbol,
        "mean": r.mean,
        "standard_deviation": r.deviation,
        "statistic": None if f is None else f.statistic,
        "df": None if f is None else f.df,
        "critical": None if f is None or r.described else f.critical,
        "p_value": r.p_value,
        "rejected": r.rejected,
        "descriptive": r.described,
    }


def study_json(study: AdjustmentLaws | None) -> dict[str, Any] | None:
    """Return `law_study`: on what the laws were compared and how, the likelihood ratio, the interval of a, the scale rules."""
    if study is None:
        return None
    laws, ratio = study.laws, study.laws.ratio
    a = None if laws.modulated is None else laws.modulated.parameters["a"]
    return {
        "values": len(study.values),
        "observations": study.what,
        "replicas": study.options.replicas,
        "adjusted": laws.adjusted,
        "rounded": laws.rounded,
        "normal_against_modulated": None
        if ratio is None
        else {"statistic": ratio.statistic, "critical": ratio.critical, "p_value": ratio.p_value, "rejected": ratio.rejected},
        "modulated_normal": None
        if laws.interval is None
        else {"a": a, "interval": {"level": study.options.interval, "lower": laws.interval[0], "upper": laws.interval[1]}},
        "scale_rules": [scale_rule_json(r) for r in study.scale_rules],
        "chi_square_ratios": {"descriptive": True, "values": laws.chi_square_ratios},
        "left_out": [{"what": what, "why": why} for what, why in study.left_out],
    }


def critical_json(study: AdjustmentLaws | None) -> dict[str, Any] | None:
    """Return `critical_values`: of w and tau, and minimal detectable biases, under the law of the errors beside the normal law."""
    found = None if study is None else study.critical
    if found is None:
        return None

    def of(limit: Limit) -> dict[str, float]:
        return {"value": limit.value, "error": limit.error, "normal": limit.normal, "normal_error": limit.normal_error}

    rows = []
    for k, c in enumerate(found.classes):
        own = found.members == k
        levels = {"w": c.level_w, "tau": c.level_tau}
        ratio = float(np.nanmedian(found.mdb[own] / found.mdb_normal[own]))
        rows.append(
            {
                "redundancy": [c.lowest, c.highest],
                "count": c.count,
                "w": of(c.w),
                "tau": of(c.tau),
                "level_of_normal_limit": levels,
                "delta0": of(c.delta0),
                "mdb_ratio": ratio,
            }
        )
    return {
        "law": found.law.family,
        "parameters": dict(found.law.parameters),
        "alpha": found.alpha,
        "family_alpha": found.family_alpha,
        "power": found.power,
        "replicas": found.replicas,
        "classes": rows,
        "largest_w": of(found.family_w),
        "largest_tau": of(found.family_tau),
    }
