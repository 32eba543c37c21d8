"""Blocks that the report of an adjustment and that of a table of residuals share: figures and tables of laws of errors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from baarda.distributions.base import Floats
from baarda.hypotheses.base import TestResult
from baarda.procedures.law_bootstrap import CHI_SQUARE
from baarda.procedures.law_study import LawsStudied, LawStudy
from baarda.procedures.residual_study import ScaleRule
from baarda.report import plots
from baarda.report.sections._numbers import MISSING, fixed, names, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, Tone, say
from baarda.report.sections.verdict import law_name
from baarda.report.translation import tr

_DRAWN = ("normal", "radico", "lineo", "modulated_normal")
_LETTERS = {"anderson_darling": "A²", "chi_square": "chi-square"}


def short(value: float) -> str:
    """Return a number with three digits after the point at most."""
    return fixed(value, 1) if abs(value) >= 100.0 else fixed(value, 3) if abs(value) >= 1.0 else significant(value, 3)


def decision(rejected: bool, grave: Tone = "bad") -> Cell:
    """Return the cell of a decision."""
    return Cell("rejected", grave) if rejected else Cell("not rejected", "good")


def table_of_tests(caption: str, tests: tuple[TestResult, ...]) -> list[Block]:
    """Return single tests as a table with their notes; nothing without any."""
    rows: list[tuple[str | Cell, ...]] = []
    for t in tests:
        if np.ndim(t.statistic):
            continue
        head = f"{t.name.replace('_', ' ')}\n{t.null}"
        if not t.details.get("applicable", True):
            rows.append((head, Cell("not applicable", "info"), "", "", "", ""))
            continue
        limits = "..".join(short(c) for c in t.critical) if isinstance(t.critical, tuple) else short(t.critical)
        rows.append((head, decision(bool(t.rejected)), short(float(t.statistic)), limits, probability(t.p_value), t.law_name))
    if not rows:
        return []
    columns = (
        Column("test", "", "name and null hypothesis: what is assumed until the data contradict", "left"),
        Column("decision", "", "", "left"),
        Column("statistic", "", "the number that is judged"),
        Column("limit", "", "critical value, or the two of a two-sided test"),
        Column("p", "", "probability of a statistic at least as extreme if the null hypothesis is true"),
        Column("law", "", "law of the statistic if the null hypothesis is true", "left"),
    )
    notes = list(dict.fromkeys(t.note for t in tests if t.note))
    return [DataTable(caption, columns, tuple(rows), " ".join(notes))]


def figures(laws: LawsStudied, values: Floats, mean: float, deviation: float, label: str) -> list[Block]:
    """Return histogram and Q-Q plot of values in units of `deviation` from `mean`, with the densities of the laws."""
    z = (values - mean) / deviation
    by_name = {s.fit.law: s.fit for s in laws.laws}
    if laws.best is not None:
        by_name.setdefault(laws.best.fit.law, laws.best.fit)
    drawn = [n for n in _DRAWN if n in by_name]
    if laws.best is not None and laws.best.fit.law not in drawn:
        drawn.append(laws.best.fit.law)

    def density(name: str) -> Callable[[Floats], Floats]:
        law = by_name[name].distribution
        return lambda x: np.asarray(deviation * law.pdf(mean + deviation * x))

    curves = [(law_name(n, by_name[n].parameters.get("a")), density(n)) for n in drawn]
    beyond = int((np.abs(z) > 5.0).sum())
    caption = "Values in classes, and the density of each fitted law."
    if beyond:
        caption += say(" {count} beyond ±5, counted in the outer classes.", count=plural(beyond, "value lies", "values lie"))
    alt = say(
        "Histogram of {n} values in standard deviations with the curves of {laws}.", n=len(values), laws=names(drawn, 9).replace("_", " ")
    )
    made: list[Block] = [Figure("residual-law", "Histogram with the fitted laws", caption, alt, plots.histogram(z, curves, label))]
    other = None
    best = laws.best
    if best is not None and best.fit.law != "normal":
        law = best.fit.distribution
        name = law_name(best.fit.law, best.fit.parameters.get("a"))
        other = (name, lambda q: np.asarray((law.ppf(q) - mean) / deviation))
    alt = say(
        "Normal Q-Q plot of {n} values, from {low} to {high} standard deviations.",
        n=len(values),
        low=fixed(z.min(), 2),
        high=fixed(z.max(), 2),
    )
    caption = (
        "Sorted values against the quantiles of the normal law. Marks on the dashed line are normal; an S that leaves it upwards on the "
        "right and downwards on the left has heavy tails."
    )
    made.append(Figure("quantiles", "Q-Q plot", caption, alt, plots.quantiles(z, other, label)))
    return made


def laws_table(laws: LawsStudied, alpha: float) -> DataTable:
    """Return the laws side by side: estimates, decision, p-values of all tests, likelihood."""
    rows: list[tuple[str | Cell, ...]] = []
    for s in laws.laws:
        f = s.fit
        values = ", ".join(f"{k} = {significant(v, 3)}" for k, v in f.parameters.items() if k in f.estimated) or tr("none")
        rejected = laws.rejected(s)
        rows.append(
            (
                f.law.replace("_", " ") + (tr(" (smallest AIC)") if s is laws.best else ""),
                values,
                Cell("") if rejected is None else decision(rejected),
                *(_p(s, name) for name in ("anderson_darling", "cramer_von_mises", "kolmogorov")),
                *((_p(s, "anderson_darling", independent=True),) if laws.adjusted else ()),
                fixed(f.statistic, 1),
                MISSING if f.df is None else str(f.df),
                fixed(f.critical, 1),
                probability(f.p_value),
                *((_p(s, CHI_SQUARE, independent=True),) if laws.adjusted else ()),
                _p(s, CHI_SQUARE),
                fixed(f.log_likelihood, 1),
                fixed(f.aic, 1),
                fixed(f.bic, 1),
            )
        )
    judge = _LETTERS[laws.judged_by(laws.laws[0])]
    through = tr(" for adjusted residuals: null law by simulated adjustments" if laws.adjusted else " by simulated samples")
    columns = (
        Column("law", "", "", "left"),
        Column("estimated", "", "values found by maximum likelihood", "left"),
        Column("decision", "", say("by {judge}, at level {alpha}", judge=judge, alpha=f"{alpha:.3g}"), "left"),
        Column("p of A²", "", say("Anderson-Darling, weighted for the tails,{through}", through=through)),
        Column("p of W²", "", f"Cramér-von Mises,{through}"),
        Column("p of D", "", f"Kolmogorov,{through}"),
        *((Column("p of A², independent", "", "the same Anderson-Darling as if the residuals were independent"),) if laws.adjusted else ()),
        Column("chi-square", "", "sum of (found - expected)² / expected over the common classes"),
        Column("df", "", "degrees of freedom: classes - 1 - estimated values"),
        Column("limit", "", "critical value of chi-square"),
        Column("p, asymptotic", "", "probability of a chi-square as large for independent values, by the chi-square law"),
        *((Column("p, independent", "", "the same by simulated samples of independent values"),) if laws.adjusted else ()),
        Column("p, adjusted" if laws.adjusted else "p, simulated", "", say("the same{through}", through=through)),
        Column("log L", "", "logarithm of the likelihood: larger is better"),
        Column("AIC", "", "Akaike's criterion, 2 k - 2 log L: smaller is better"),
        Column("BIC", "", "Schwarz's criterion, k log n - 2 log L: smaller is better"),
    )
    notes = ["A law that is not rejected is not proven."]
    if laws.adjusted:
        notes.append(
            "Residuals of one adjustment are correlated, and each mixes many errors, which makes them more normal than the errors: the "
            "p-values for adjusted residuals take errors of the fitted law, map them through the design matrix, standardise and fit anew; "
            "they are exact for normal errors and approximate where the law is another or a shape is fitted. Those for independent values "
            "show what the naive test would say."
        )
    notes += list(dict.fromkeys(t.note for s in laws.laws for t in s.tests[:1]))[:1]
    return DataTable("Laws compared", columns, tuple(rows), " ".join(notes))


def _p(law: LawStudy, name: str, *, independent: bool = False) -> str:
    test = law.test(name, independent=independent)
    return probability(None if test is None else float(test.p_value))


def classes_table(laws: LawsStudied) -> DataTable | None:
    """Return counts and expected counts in each class; None where there are no classes."""
    fits = [s.fit for s in laws.laws if s.fit.histogram is not None]
    first = fits[0].histogram if fits else None
    if first is None:
        return None
    rows = []
    for j in range(len(first.counts)):
        expected = [fixed(float(f.histogram.expected[j]), 2) for f in fits if f.histogram is not None]
        limits = (significant(float(first.edges[j]), 4), significant(float(first.edges[j + 1]), 4))
        rows.append((*limits, str(int(first.counts[j])), *expected))
    columns = (
        Column("from", "", "lower limit, part of the class"),
        Column("to"),
        Column("found"),
        *(Column(f.law.replace("_", " "), "", "expected under the fitted law") for f in fits),
    )
    return DataTable("Classes", columns, tuple(rows), f"{first.ends.capitalize()} end classes.", folded=True)


def ratios_table(laws: LawsStudied) -> list[Block]:
    """Return Maarek & Konecny's Fisher ratios, marked descriptive; nothing with fewer than two laws."""
    ratios = laws.chi_square_ratios
    if len(ratios) < 2:
        return []
    rows = tuple((name.replace("_", " "), fixed(value, 3)) for name, value in ratios.items())
    columns = (Column("law", "", "", "left"), Column("ratio", "", "chi-square per degree of freedom over the smallest one"))
    note = "Descriptive only: the chi-squares of one sample are dependent, and their ratio does not follow Fisher's law."
    return [DataTable("Fisher ratios of the laws that chi-square does not reject", columns, rows, note, folded=True)]


def scale_table(rules: tuple[ScaleRule, ...]) -> DataTable:
    """Return the normal law with the standard deviation by each of the paper's rules."""
    columns = (
        Column("rule", "", "", "left"),
        Column("mean"),
        Column("standard deviation"),
        Column("chi-square", "", "of the normal law with this mean and standard deviation"),
        Column("df", "", "degrees of freedom: classes - 1 - estimated values"),
        Column("limit", "", "critical value"),
        Column("p", "", "probability of a chi-square as large if the law holds"),
        Column("decision", "", "", "left"),
    )
    rows = tuple(_scale_row(r) for r in rules)
    note = (
        "S_M: v'v over n - 1. S_o: v'v over the redundancy; on raw residuals it rejects truly normal errors in about half of all cases, "
        "and is described only. Q_v: each residual divided by its own standard deviation. S_P: mean and standard deviation with the "
        "smallest chi-square."
    )
    return DataTable("The normal law with the standard deviation by each rule", columns, rows, note)


def _scale_row(r: ScaleRule) -> tuple[str | Cell, ...]:
    f = r.fit
    described = Cell("described only", "info")
    outcome = described if r.described else Cell("") if r.rejected is None else decision(r.rejected)
    limit = MISSING if f is None or r.described else fixed(f.critical, 2)
    chi, df = (MISSING, MISSING) if f is None else (fixed(f.statistic, 2), str(f.df))
    return r.symbol, significant(r.mean, 3), significant(r.deviation, 4), chi, df, limit, probability(r.p_value), outcome
