"""Residual law: which law of errors the standardised residuals follow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from baarda.distributions.fitting import Fit
from baarda.procedures.testing import Analysis
from baarda.report import plots
from baarda.report.sections._facts import image_rows, result_of
from baarda.report.sections._numbers import MISSING, fixed, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, Paragraph, SectionMaker, say
from baarda.report.sections.verdict import law_name

Floats = NDArray[np.float64]


def _values(analysis: Analysis) -> tuple[Floats, str]:
    """Return the residuals to which the laws were fitted: those of image points, or of all observations."""
    values = analysis.tau
    chosen = np.isfinite(values) & image_rows(analysis)
    if int(chosen.sum()) != analysis.laws[0].n:
        return values[np.isfinite(values)], "all observations"
    return values[chosen], "image coordinates"


def _laws(analysis: Analysis, best: Fit) -> DataTable:
    rows = []
    for f in analysis.laws:
        values = ", ".join(f"{k} = {significant(v, 3)}" for k, v in f.parameters.items() if k in f.estimated) or "none"
        decision = Cell("") if f.rejected is None else Cell("rejected", "bad") if f.rejected else Cell("not rejected", "good")
        rows.append(
            (
                f.law.replace("_", " ") + (" (best AIC)" if f is best else ""),
                values,
                fixed(f.statistic, 1),
                MISSING if f.df is None else str(f.df),
                fixed(f.critical, 1),
                probability(f.p_value),
                decision,
                fixed(f.log_likelihood, 1),
                fixed(f.aic, 1),
                fixed(f.bic, 1),
            )
        )
    columns = (
        Column("law", "", "", "left"),
        Column("estimated", "", "values found by maximum likelihood; mean 0 and standard deviation 1 are given", "left"),
        Column("chi-square", "", "sum of (found - expected)² / expected over classes that are equally probable under the law"),
        Column("df", "", "degrees of freedom: classes - 1 - estimated values"),
        Column("limit", "", f"critical value at level {best.alpha:.3g}"),
        Column("p", "", "probability of a chi-square as large if the law holds"),
        Column("decision", "", "", "left"),
        Column("log L", "", "logarithm of the likelihood: larger is better"),
        Column("AIC", "", "Akaike's criterion, 2 k - 2 log L: smaller is better"),
        Column("BIC", "", "Schwarz's criterion, k log n - 2 log L: smaller is better"),
    )
    note = (
        "The p-values assume independent residuals with the standard deviation 1. Residuals of one adjustment are weakly correlated, "
        "and values estimated from the residuals themselves make the test reject a little too often: read a p-value near the level "
        "with care, and compare the laws by AIC."
    )
    return DataTable("Laws compared", columns, tuple(rows), note)


def _moments(analysis: Analysis) -> list[Block]:
    rows: list[tuple[str | Cell, ...]] = []
    for name, key, normal in (
        ("mean_of_residuals", "mean", "0"),
        ("skewness_of_residuals", "skewness", "0"),
        ("kurtosis_of_residuals", "kurtosis", "3"),
    ):
        test = result_of(analysis, name)
        if test is None or not isinstance(test.critical, tuple):
            continue
        decision = Cell("rejected", "warn") if test.rejected else Cell("not rejected", "good")
        value = test.details.get(key)
        rows.append((key, fixed(value, 4), normal, probability(float(test.p_value)), decision))
    if not rows:
        return []
    columns = (
        Column("moment", "", "of the standardised residuals", "left"),
        Column("found", "", "of the sample"),
        Column("normal law", "", "value under the normal law"),
        Column("p", "", "of the two-sided test, see All tests"),
        Column("decision", "", "", "left"),
    )
    return [DataTable("Moments of the standardised residuals", columns, tuple(rows))]


def _build(analysis: Analysis) -> list[Block] | None:
    laws = [f for f in analysis.laws if f.aic is not None]
    if not laws:
        return None
    values, what = _values(analysis)
    best = min(laws, key=lambda f: f.aic if f.aic is not None else np.inf)
    beyond = int((np.abs(values) > 5.0).sum())
    intro = say(
        "Each residual of {what} ({n}) was divided by its own standard deviation (tau), which makes residuals of good and weak "
        "geometry comparable. A modulated normal law with a = 1/2 is the radico, with a = 1 the lineo, with a = infinity the normal; a "
        "small a means a mixture of precisions: a sharp peak and long tails.",
        what=what,
        n=len(values),
    )
    curves = [(f.law.replace("_", " "), f.distribution.pdf) for f in laws]
    caption = say(
        "Residuals of {what} in classes, and the density of each fitted law. {beyond}",
        what=what,
        beyond=say("{count} beyond ±5, counted in the outer classes.", count=plural(beyond, "value lies", "values lie")) if beyond else "",
    ).strip()
    alt = say(
        "Histogram of {n} standardised residuals between -5 and 5 with the curves of {laws}; the {best} fits best by AIC.",
        n=len(values),
        laws=", ".join(name for name, _ in curves),
        best=law_name(best.law, best.parameters.get("a")),
    )
    label = "standardised residual tau (own standard deviations)"
    blocks: list[Block] = [
        Paragraph(intro),
        Figure("residual-law", "Histogram of the standardised residuals", caption, alt, plots.histogram(values, curves, label)),
    ]
    other = None if best.law == "normal" else (law_name(best.law, best.parameters.get("a")), best.distribution.ppf)
    caption = (
        "Sorted residuals against the quantiles of the normal law. Marks on the dashed line are normal; an S that leaves it upwards on "
        "the right and downwards on the left has heavy tails."
    )
    alt = say(
        "Normal Q-Q plot of {n} standardised residuals, from {low} to {high}.",
        n=len(values),
        low=fixed(values.min(), 2),
        high=fixed(values.max(), 2),
    )
    blocks.append(
        Figure(
            "quantiles", "Q-Q plot of the standardised residuals", caption, alt, plots.quantiles(values, other, "standardised residual tau")
        )
    )
    return [*blocks, _laws(analysis, best), *_moments(analysis)]


LAW = SectionMaker(110, "law", "Residual law", _build)
