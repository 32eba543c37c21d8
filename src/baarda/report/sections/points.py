"""Object points: how precise they are, which are the weakest, and the coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import stats

from baarda.network import AXES
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import MOST_ROWS, almost_infinite, first, point_sigmas, scaling, spatial
from baarda.report.sections._numbers import decimals_for, finer, fixed, plural
from baarda.report.sections.base import Block, Column, DataTable, Paragraph, SectionMaker, say

_WORST = 20


def _summary(sigmas: np.ndarray, rays: np.ndarray, unit: str, factor: float) -> DataTable:
    measures: dict[str, Callable[[np.ndarray], float]] = {
        "least": np.min,
        "median": np.median,
        "root mean square": lambda x: np.sqrt(np.mean(x**2)),
        "largest": np.max,
    }
    parts: list[tuple[str, np.ndarray]] = [(f"s{axis}", sigmas[:, k]) for k, axis in enumerate(AXES)] + [("spatial", spatial(sigmas))]
    rows = []
    decimals = decimals_for(sigmas[sigmas > 0.0] * factor, 3)
    for name, values in parts:
        free = values[values > 0.0]
        if len(free):
            rows.append((name, str(len(free)), *(fixed(float(f(free)) * factor, decimals) for f in measures.values())))
    note = say(
        "Rays per point: {low:g} to {high:g}, median {median:g}.",
        low=float(rays.min()),
        high=float(rays.max()),
        median=float(np.median(rays)),
    )
    columns = (
        Column("of", "", "standard deviation of a coordinate; spatial = sqrt(sX² + sY² + sZ²)", "left"),
        Column("points", "", "number of points with a free coordinate"),
        *(Column(name, unit) for name in measures),
    )
    return DataTable("Precision of the object points", columns, tuple(rows), note)


def _expanded(analysis: Analysis, table: Any, sigmas: np.ndarray, unit: str, factor: float) -> DataTable:
    """Return the expanded uncertainties: coverage factor k, median and largest, for coordinates, position in the plane, and in space."""
    r, posterior = analysis.adjustment.redundancy, analysis.options.sigma == "aposteriori"
    law = f"t({r})" if posterior else "N(0, 1)"
    one = float((stats.t(r) if posterior else stats.norm()).ppf(0.975))
    regions: list[tuple[str, float, str, np.ndarray]] = [(axis, one, law, one * sigmas[:, k]) for k, axis in enumerate(AXES)]
    for k, name, key in ((2, "horizontal", "ellipse_a"), (3, "in space", "ellipsoid_a")):
        size = float(np.sqrt(k * stats.f(k, r).ppf(0.95)) if posterior else np.sqrt(stats.chi2(k).ppf(0.95)))
        law = f"sqrt({k} F({k}, {r}))" if posterior else f"sqrt(chi2({k}))"
        regions.append((name, size, law, np.asarray(table[key], dtype=float)))
    decimals = decimals_for(sigmas[sigmas > 0.0] * factor, 3)
    rows = []
    for name, size, law, values in regions:
        free = values[values > 0.0]
        if len(free):
            numbers = [fixed(float(f(free)) * factor, decimals) for f in (np.median, np.max)]
            rows.append((name, fixed(size, 3), law, *numbers))
    columns = (
        Column("of", "", "a coordinate; horizontal and in space: the longest semi-axis of ellipse and ellipsoid", "left"),
        Column("k", "", "coverage factor: expanded uncertainty U = k s"),
        Column("law", "", "whose 95 % quantile k is", "left"),
        Column("median U", unit),
        Column("largest U", unit),
    )
    note = say(
        "Coverage 95 %, {scaling}. They hold what the a-priori sigmas and the model hold: an error that all observations share, such as a "
        "wrong scale, is not in them.",
        scaling=scaling(analysis),
    )
    return DataTable("Expanded uncertainties of the object points", columns, tuple(rows), note)


def _table(
    analysis: Analysis, table: Any, sigmas: np.ndarray, rows: np.ndarray, caption: str, note: str = "", folded: bool = False
) -> DataTable:
    unit, factor = finer(analysis.adjustment.network.unit, sigmas[sigmas > 0.0])
    free = sigmas[sigmas > 0.0]
    place = decimals_for(free, 2)
    spread = decimals_for(free * factor, 2)
    whole = spatial(sigmas)
    major = table["ellipse_a"] * factor
    minor = table["ellipse_b"] * factor

    def deviation(value: float) -> str:
        return fixed(value * factor, spread) if value > 0.0 else "fixed"

    out = []
    for i in rows.tolist():
        cells = [str(table["point"][i]), str(table["role"][i])]
        cells += [fixed(float(table[axis][i]), place) for axis in AXES]
        cells += [deviation(float(sigmas[i, k])) for k in range(3)]
        out.append(
            (*cells, deviation(float(whole[i])), fixed(float(major[i]), spread), fixed(float(minor[i]), spread), str(table["rays"][i]))
        )
    columns = (
        Column("point", "", "", "left"),
        Column("role", "", "tie; control: takes part with its coordinates; check: judges only", "left"),
        *(Column(axis, analysis.adjustment.network.unit, "adjusted coordinate") for axis in AXES),
        *(Column(f"s{axis}", unit, say("standard deviation, {scaling}", scaling=scaling(analysis))) for axis in AXES),
        Column("spatial", unit, "sqrt(sX² + sY² + sZ²)"),
        Column("ellipse a", unit, "semi-axes of the horizontal 95 % confidence ellipse"),
        Column("ellipse b", unit, "semi-axes of the horizontal 95 % confidence ellipse"),
        Column("rays", "", "images that see the point"),
    )
    return DataTable(caption, columns, tuple(out), note, folded)


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged:
        return None
    table, sigmas = point_sigmas(analysis)
    whole = spatial(sigmas)
    infinite = almost_infinite(analysis)
    if not (whole > 0.0).any():
        return None
    free = np.flatnonzero((whole > 0.0) & ~infinite)
    finite = sigmas[~infinite]
    unit, factor = finer(analysis.adjustment.network.unit, finite[finite > 0.0])
    blocks: list[Block] = []
    if infinite.any():
        count = plural(int(infinite.sum()), "point cannot be", "points cannot be")
        blocks.append(Paragraph(say("{count} told from infinity; only the list of all points holds them.", count=count)))
    if len(free):
        blocks.append(_summary(finite, np.asarray(table["rays"], dtype=float)[~infinite], unit, factor))
        axes = {name: table[name][~infinite] for name in ("ellipse_a", "ellipsoid_a")}
        blocks.append(_expanded(analysis, axes, finite, unit, factor))
    worst = free[np.argsort(-whole[free], kind="stable")][:_WORST]
    if len(free) > _WORST:
        blocks.append(_table(analysis, table, sigmas, worst, say("The {count} weakest points", count=len(worst))))
    rows = np.arange(min(len(table), MOST_ROWS))
    note = first(len(table), MOST_ROWS, "tables/points.csv") or "Correlations and the 95 % ellipsoids are in tables/points.csv."
    blocks.append(_table(analysis, table, sigmas, rows, "All points", note, folded=True))
    return blocks


POINTS = SectionMaker(70, "points", "Object points", _build)
