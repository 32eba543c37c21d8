"""Unknowns that belong to no camera, image or point: antenna tracks, models, stations, with sigmas and the tests of additional ones."""

from __future__ import annotations

import numpy as np

from baarda.cameras import FIXED, STATES
from baarda.network import Declared
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import MOST_ROWS, first, result_of, scaling
from baarda.report.sections._numbers import fixed, powers, probability, significant, with_sigma
from baarda.report.sections.base import Block, Cell, Column, DataTable, SectionMaker, say
from baarda.report.translation import tr


def _titles(kind: str) -> str:
    known = {"track": "Antenna tracks", "model": "Transformations of the models", "station": "Orientations of the stations"}
    return tr(known.get(kind, kind))


def _table(analysis: Analysis, group: Declared, first_values: np.ndarray) -> DataTable:
    a = analysis.adjustment
    estimated = a.unknown_table(analysis.options.sigma)
    sigma = dict(zip(estimated["name"], estimated["sigma"], strict=True))
    test = result_of(analysis, "additional_parameter")
    tests = {} if test is None else {n: i for i, n in enumerate(test.labels)}
    rows: list[tuple[str | Cell, ...]] = []
    for node, label in enumerate(group.labels):
        for k, parameter in enumerate(group.parameters_of(node)):
            at = int(group.offsets[node]) + k
            name = f"{group.kind} {label}: {parameter}"
            value, deviation = with_sigma(float(group.values[at]), sigma.get(name))
            t, p, decision = "", "", Cell("")
            if test is not None and name in tests:
                j = tests[name]
                t, p = significant(float(np.asarray(test.statistic)[j]), 3), probability(float(np.asarray(test.p_value)[j]))
                decision = Cell("significant", "good") if np.asarray(test.rejected)[j] else Cell("not significant", "warn")
            initial = f"{float(first_values[at]):.6g}"
            state = STATES[group.states[at]] if name in sigma else STATES[FIXED]
            rows.append((label, parameter, powers(group.unit_of(node, k)) or "1", value, deviation, initial, t, p, decision, state))
    limit = ""
    if test is not None and isinstance(test.critical, tuple):
        limit = say(" (limit {limit} at level {alpha})", limit=fixed(test.critical[1], 2), alpha=f"{test.alpha:.3g}")
    tested = any(row[6] for row in rows)
    columns = (
        Column(group.kind, "", "", "left"),
        Column("parameter", "", "", "left"),
        Column("unit", "", "unit of value, sigma and initial; 1 = pure number", "left"),
        Column("value", "", "adjusted value"),
        Column("sigma", "", say("standard deviation, {scaling}", scaling=scaling(analysis))),
        Column("initial", "", "value before the adjustment"),
        Column("t", "", tr("value / sigma: test that an additional parameter is zero") + limit),
        Column("p", "", "probability of a |t| as large if the parameter were zero"),
        Column("decision", "", "", "left"),
        Column("state", "", "free: estimated; observed: estimated with a prior sigma; fixed: held", "left"),
    )
    keep = [i for i in range(len(columns)) if tested or i not in (6, 7, 8)]
    shown = tuple(tuple(row[i] for i in keep) for row in rows[:MOST_ROWS])
    return DataTable(_titles(group.kind), tuple(columns[i] for i in keep), shown, first(len(rows), MOST_ROWS, "tables/unknowns.csv"))


def _build(analysis: Analysis) -> list[Block] | None:
    a = analysis.adjustment
    if not analysis.converged or not a.network.declared:
        return None
    return [_table(analysis, d, s.values) for d, s in zip(a.network.declared, a.start.declared, strict=True)]


OTHER_UNKNOWNS = SectionMaker(57, "other-unknowns", "Tracks, models and stations", _build)
