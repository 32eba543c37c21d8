"""Statistics of each observation group: whether it keeps what its sigmas promise, and whether it is controlled."""

from __future__ import annotations

import numpy as np

from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import shares
from baarda.report.sections._numbers import MISSING, fixed, powers, significant
from baarda.report.sections.base import Block, Column, DataTable, SectionMaker, say


def _most(values: np.ndarray) -> str:
    size = np.abs(values)
    return fixed(float(np.nanmax(size)), 2) if np.isfinite(size).any() else MISSING


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged:
        return None
    table, r = analysis.observations, analysis.adjustment.redundancy_numbers
    rows, total = [], analysis.adjustment
    plain = total.law is None  # s0 of a group is a number of least squares
    for s in shares(analysis):
        low, mean = float(r[s.rows].min()), float(r[s.rows].mean())
        bias = table["mdb"][s.rows]
        known = s.unit != "" and np.isfinite(bias).any()
        rows.append(
            (
                s.group if not s.component else f"    {s.component}",
                str(len(s.rows)),
                fixed(s.redundancy, 2),
                fixed(low, 3),
                fixed(mean, 3),
                powers(s.unit) or MISSING,
                significant(s.rms, 3),
                fixed(s.vpv, 2),
                fixed(s.sigma0, 3) if plain else MISSING,
                _most(analysis.w[s.rows]),
                _most(analysis.tau[s.rows]),
                significant(float(np.nanmedian(bias)), 3) if known else MISSING,
                significant(float(np.nanmax(bias)), 3) if known else MISSING,
            )
        )
    share = (fixed(float(r.sum()), 2), fixed(float(r.min()), 3), fixed(float(r.mean()), 3))
    whole = (fixed(total.objective, 2), fixed(total.sigma0, 3), _most(analysis.w), _most(analysis.tau))
    rows.append(("all", str(total.count), *share, "", "", *whole, "", ""))
    o = analysis.options
    found = say(
        "minimal detectable bias: an error found with probability {power} at level {alpha}",
        power=fixed(o.power, 2),
        alpha=f"{o.alpha_outlier:g}",
    )
    columns = (
        Column("group", "", "observations of one kind, then each component of it", "left"),
        Column("n", "", "number of scalar observations"),
        Column("Σr", "", "sum of the redundancy numbers: the group's share of r"),
        Column("min r", "", "smallest redundancy number r_i: 0 = uncontrolled, 1 = fully controlled"),
        Column("mean r", "", "mean redundancy number"),
        Column("unit", "", "unit of rms and MDB", "left"),
        Column("rms v", "", "root mean square of the residuals v = adjusted - observed"),
        Column("v'Pv", "", "weighted sum of squared residuals"),
        Column("s0", "", "standard deviation of unit weight of the group, sqrt(v'Pv / Σr); 1 = the a-priori sigmas hold"),
        Column("max |w|", "", "largest residual in its own a-priori standard deviations"),
        Column("max |tau|", "", "largest residual in its own a-posteriori standard deviations"),
        Column("median MDB", "", found),
        Column("max MDB", "", "the largest error that may stay hidden in one observation of the group"),
    )
    return [DataTable("Statistics of the observation groups", columns, tuple(rows))]


GROUPS = SectionMaker(40, "groups", "Observation groups", _build)
