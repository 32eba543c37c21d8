"""How well the camera parameters can be told apart: variance inflation, condition indices, orthogonalised parameters."""

from __future__ import annotations

import numpy as np

from baarda.adjustment.parameter_hypotheses import Collinearity
from baarda.hypotheses.base import TestResult
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import MOST_ROWS, bare, first, result_of
from baarda.report.sections._numbers import fixed, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Items, Paragraph, SectionMaker, say

_LARGE = 30.0  # condition index of a strong dependence (Belsley, Kuh, Welsch 1980)
_HIGH = 0.95


def _inflation(analysis: Analysis, c: Collinearity) -> DataTable:
    rows = []
    for k, name in enumerate(c.names[:MOST_ROWS]):
        partner, rho = c.partners[k]
        mutual = "" if c.mutual is None else significant(float(c.mutual[k]), 3)
        tone = Cell(fixed(rho, 3), "warn") if abs(rho) >= _HIGH else Cell(fixed(rho, 3))
        rows.append((bare(name, analysis), significant(float(c.inflation[k]), 3), mutual, bare(partner, analysis), tone))
    columns = (
        Column("parameter", "", "", "left"),
        Column("variance inflation", "", "variance divided by what it would be if no other unknown were correlated with it"),
        Column("by other camera parameters", "", "the factor that fixing all other camera parameters would take off the variance"),
        Column("most correlated with", "", "among camera parameters and orientations of images", "left"),
        Column("correlation", "", "from 0.95 on the two can hardly be told apart"),
    )
    return DataTable("Variance inflation and correlation", columns, tuple(rows), first(len(c.names), MOST_ROWS, "result.json"))


def _dependences(analysis: Analysis, c: Collinearity) -> list[Block]:
    if c.conditions is None:
        return [Paragraph(say("Not applicable: condition indices. {why}.", why=c.dependent[:1].upper() + c.dependent[1:]), "warn")]
    largest = float(c.conditions.indices[-1])
    found = c.conditions.involved(c.names, _LARGE)
    text = say(
        "The largest condition index of the camera parameters, all other unknowns eliminated and units removed, is {largest}; above 30 "
        "there is a strong dependence.",
        largest=significant(largest, 3),
    )
    blocks: list[Block] = [Paragraph(text, "warn" if found else "good")]
    if found:
        told = [
            say("index {eta}: {names}", eta=significant(eta, 3), names=", ".join(bare(n, analysis) for n in who) or "no single parameters")
            for eta, who in found[:10]
        ]
        blocks.append(Items("Parameters with more than half of their variance in such a direction:", tuple(told)))
    return blocks


def _orthogonalised(analysis: Analysis, t: TestResult, caption: str) -> DataTable:
    statistic, p, rejected = np.asarray(t.statistic), np.asarray(t.p_value), np.asarray(t.rejected)
    rows = []
    for k, label in enumerate(t.labels[:MOST_ROWS]):
        known = bool(np.isfinite(statistic[k]))
        decision = (
            Cell("significant", "good") if rejected[k] else Cell("not significant", "warn") if known else Cell("not testable", "info")
        )
        value = significant(float(statistic[k]), 3) if known else ""
        rows.append((label, value, probability(float(p[k])) if known else "", decision))
    columns = (
        Column("combination", "", "", "left"),
        Column("t", "", "value / sigma of the combination"),
        Column("p", "", "probability of a |t| as large if it were zero"),
        Column("decision", "", "", "left"),
    )
    return DataTable(caption, columns, tuple(rows), t.note, folded=True)


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged:
        return None
    c = analysis.collinearity
    if c is None:
        return None
    blocks: list[Block] = [_inflation(analysis, c), *_dependences(analysis, c)]
    for name, caption in (
        ("orthogonalised_additional_parameters", "Uncorrelated combinations of the additional parameters (eigenvectors)"),
        ("successive_additional_parameters", "Additional parameters cleaned of the earlier ones (triangular)"),
    ):
        test = result_of(analysis, name)
        if test is not None:
            blocks.append(_orthogonalised(analysis, test, caption))
    return blocks


COLLINEARITY = SectionMaker(52, "collinearity", "Separability of the camera parameters", _build)
