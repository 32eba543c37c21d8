"""The sections of the report of a column of residuals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from baarda.distributions.base import Floats
from baarda.formats.residual_table import ResidualTable
from baarda.hypotheses.base import TestResult
from baarda.procedures.group_study import Groups
from baarda.procedures.law_study import LawsStudied
from baarda.procedures.residual_study import ResidualStudy, ScaleRule
from baarda.report import plots
from baarda.report.residual_verdict import KINDS, sentences
from baarda.report.sections._numbers import MISSING, fixed, names, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, Items, Paragraph, Section, Tone, Verdict, say
from baarda.report.sections.verdict import law_name

MOST_ROWS = 200
_DRAWN = ("normal", "radico", "lineo", "modulated_normal")
_LETTERS = {"anderson_darling": "A²", "chi_square": "chi-square"}


def sections(table: ResidualTable, study: ResidualStudy) -> list[Section]:
    """Return the sections of the report.

    Parameters
    ----------
    table : ResidualTable
    study : ResidualStudy

    Returns
    -------
    list of Section
    """
    parts: list[tuple[str, str, list[Block]]] = [
        ("verdict", "Verdict", [Verdict(tuple(sentences(table, study)))]),
        ("sample", "Sample", _sample_blocks(table, study)),
        ("tests", "Moments and variance factor", _tests_blocks(study)),
        ("groups", "Homogeneity of the groups", _groups_blocks(study)),
        ("laws", "Laws of errors", _laws_blocks(study)),
        ("scales", "Scale rules", _scale_blocks(study)),
        ("left-out", "What was not done", _left_out(study)),
    ]
    return [Section(anchor, title, tuple(blocks)) for anchor, title, blocks in parts if blocks]


def _sample_blocks(table: ResidualTable, study: ResidualStudy) -> list[Block]:
    used = [("residuals", table.column), ("groups", table.group), ("sigmas", table.sigma), ("redundancy numbers", table.redundancy)]
    rows: list[tuple[str | Cell, ...]] = [(what, name or MISSING) for what, name in used]
    numbers = [("values", str(study.n)), ("mean", significant(study.mean, 5)), ("standard deviation", significant(study.deviation, 5))]
    numbers += [("skewness", fixed(study.skewness, 4)), ("kurtosis", fixed(study.kurtosis, 4))]
    numbers += [("smallest, largest", f"{significant(float(study.values.min()), 5)}, {significant(float(study.values.max()), 5)}")]
    if study.redundancy is not None:
        numbers += [("redundancy (sum of r)", fixed(study.redundancy, 2)), ("s0", significant(study.sigma0, 5))]
    blocks: list[Block] = [
        Paragraph(
            say(
                "Studied are {kind}. All p-values hold for independent values. Residuals of one adjustment are weakly correlated and more "
                "normal than the errors behind them: where a test does not reject, the errors may still deviate.",
                kind=KINDS[study.kind],
            )
        ),
        DataTable(
            "The values studied",
            (Column("number", "", "", "left"), Column("value")),
            tuple((name, value) for name, value in numbers),
        ),
        DataTable("Columns used", (Column("what", "", "", "left"), Column("column", "", "", "left")), tuple(rows), folded=True),
    ]
    if table.assumptions:
        blocks.append(Items("Assumptions:", table.assumptions))
    if study.laws.rounded:
        said = "More than half of the values repeat: they were rounded. Laws are judged by chi-square on classes with limits between them."
        blocks.append(Paragraph(said, "warn"))
    return blocks


def _short(value: float) -> str:
    return fixed(value, 1) if abs(value) >= 100.0 else fixed(value, 3) if abs(value) >= 1.0 else significant(value, 3)


def _decision(rejected: bool, grave: Tone = "bad") -> Cell:
    return Cell("rejected", grave) if rejected else Cell("not rejected", "good")


def _test_table(caption: str, tests: tuple[TestResult, ...]) -> list[Block]:
    rows: list[tuple[str | Cell, ...]] = []
    for t in tests:
        if np.ndim(t.statistic):
            continue
        limits = "..".join(_short(c) for c in t.critical) if isinstance(t.critical, tuple) else _short(t.critical)
        head = f"{t.name.replace('_', ' ')}\n{t.null}"
        rows.append((head, _decision(bool(t.rejected)), _short(float(t.statistic)), limits, probability(t.p_value), t.law_name))
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


def _tests_blocks(study: ResidualStudy) -> list[Block]:
    return _test_table("Tests of the moments", study.tests)


def _groups_blocks(study: ResidualStudy) -> list[Block]:
    groups = study.groups
    if groups is None:
        return []
    blocks = _test_table("Tests of equal variances", groups.tests)
    each = groups.test("variance_per_group")
    order = groups.tested
    if each is not None:
        p, rejected = np.asarray(each.p_value), np.asarray(each.rejected)
        if len(order) <= MOST_ROWS:
            blocks.insert(0, _group_figure(groups, order, rejected, float(each.details["reference"])))
        chosen = np.argsort(p, kind="stable")[:MOST_ROWS]
        rows = [
            (
                groups.names[order[i]] or "(no name)",
                str(int(groups.counts[order[i]])),
                significant(float(groups.means[order[i]]), 3),
                significant(float(np.sqrt(groups.variances[order[i]])), 4),
                fixed(float(groups.df[order[i]]), 2),
                _short(float(np.asarray(each.statistic)[i])),
                probability(float(p[i])),
                _decision(bool(rejected[i]), "warn"),
            )
            for i in chosen
        ]
        about = "redundancy numbers" if groups.by_redundancy else "values minus one"
        columns = (
            Column("group", "", "the most deviating first", "left"),
            Column("n", "", "number of values"),
            Column("mean", "", "of the residuals" if study.kind == "raw" else "of the residuals divided by their sigmas"),
            Column("S", "", "standard deviation"),
            Column("r", "", f"degrees of freedom: {about}"),
            Column("r S² / S² pooled", "", "the statistic that is judged"),
            Column("p", "", "two-sided, under the beta law of a part of the pooled variance"),
            Column("decision", "", "", "left"),
        )
        shortened = "" if len(order) <= MOST_ROWS else f"The first {MOST_ROWS} of {len(order)} rows; all are in tables/groups."
        blocks.append(DataTable("Groups", columns, tuple(rows), shortened, folded=len(rows) > 30))
    return blocks


def _group_figure(groups: Groups, order: np.ndarray, rejected: np.ndarray, pooled: float) -> Figure:
    ratio = np.sqrt(groups.variances[order] / pooled)
    labels = [groups.names[i] for i in order]

    def draw(figure: object) -> None:
        axes = figure.add_subplot()  # type: ignore[attr-defined]
        x = np.arange(1, len(ratio) + 1)
        for chosen, marker, colour, word in (
            (~rejected, "o", plots.BLUE, "agrees with the pooled one"),
            (rejected, "D", plots.ORANGE, "rejected"),
        ):
            if chosen.any():
                axes.plot(x[chosen], ratio[chosen], marker, color=colour, markersize=5, label=word)
        axes.axhline(1.0, color=plots.INK, linewidth=0.9, linestyle=(0, (5, 2)))
        axes.set_xlim(0.25, len(ratio) + 0.75)
        if len(labels) <= 40:
            short = [t if len(t) <= 14 else f"{t[:12]}.." for t in labels]
            upright = sum(len(t) + 1 for t in short) > 90
            axes.set_xticks(x, short, **({"rotation": 60, "ha": "right", "rotation_mode": "anchor"} if upright else {}))
        axes.set_xlabel("group" if len(labels) <= 40 else "group, in the order of the table")
        axes.set_ylabel("S / S pooled")
        axes.margins(y=0.15)
        axes.grid(True, axis="y")
        figure.legend(loc="outside upper left", ncols=2)  # type: ignore[attr-defined]

    title = "Standard deviation of each group"
    caption = "Relative to the pooled one; the dashed line is equality."
    alt = say(
        "Standard deviations of {k} groups relative to the pooled one, from {low} to {high}; {beyond} are rejected.",
        k=len(ratio),
        low=fixed(float(ratio.min()), 2),
        high=fixed(float(ratio.max()), 2),
        beyond=int(rejected.sum()),
    )
    return Figure("groups", title, caption, alt, plots.drawn("groups", (7.2, 2.8), draw))


def _laws_blocks(study: ResidualStudy) -> list[Block]:
    laws = study.laws
    if not laws.laws:
        return []
    blocks: list[Block] = [*_figures(study), _laws_table(study)]
    if laws.ratio is not None:
        blocks += _test_table("Normal against modulated normal", (laws.ratio,))
    classes = _classes_table(laws)
    if classes is not None:
        blocks.append(classes)
    ratios = laws.chi_square_ratios
    if len(ratios) > 1:
        rows = tuple((name.replace("_", " "), fixed(value, 3)) for name, value in ratios.items())
        columns = (Column("law", "", "", "left"), Column("ratio", "", "chi-square per degree of freedom over the smallest one"))
        note = "Descriptive only: the chi-squares of one sample are dependent, and their ratio does not follow Fisher's law."
        blocks.append(DataTable("Fisher ratios of the laws that chi-square does not reject", columns, rows, note, folded=True))
    return blocks


def _figures(study: ResidualStudy) -> list[Block]:
    laws, mean, deviation = study.laws, study.mean, study.deviation
    z = (study.values - mean) / deviation
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
    label = "(value - mean) / standard deviation"
    caption = "Values in classes, and the density of each fitted law."
    if beyond:
        caption += say(" {count} beyond ±5, counted in the outer classes.", count=plural(beyond, "value lies", "values lie"))
    alt = say(
        "Histogram of {n} values in standard deviations with the curves of {laws}.", n=study.n, laws=names(drawn, 9).replace("_", " ")
    )
    figures: list[Block] = [Figure("residual-law", "Histogram with the fitted laws", caption, alt, plots.histogram(z, curves, label))]
    other = None
    best = laws.best
    if best is not None and best.fit.law != "normal":
        law = best.fit.distribution
        name = law_name(best.fit.law, best.fit.parameters.get("a"))
        other = (name, lambda q: np.asarray((law.ppf(q) - mean) / deviation))
    alt = say(
        "Normal Q-Q plot of {n} values, from {low} to {high} standard deviations.", n=study.n, low=fixed(z.min(), 2), high=fixed(z.max(), 2)
    )
    caption = (
        "Sorted values against the quantiles of the normal law. Marks on the dashed line are normal; an S that leaves it upwards on the "
        "right and downwards on the left has heavy tails."
    )
    figures.append(Figure("quantiles", "Q-Q plot", caption, alt, plots.quantiles(z, other, label)))
    return figures


def _laws_table(study: ResidualStudy) -> DataTable:
    laws = study.laws
    rows: list[tuple[str | Cell, ...]] = []
    for s in laws.laws:
        f = s.fit
        values = ", ".join(f"{k} = {significant(v, 3)}" for k, v in f.parameters.items() if k in f.estimated) or "none"
        rejected = laws.rejected(s)
        decision = Cell("") if rejected is None else _decision(rejected)
        ps = [
            probability(None if t is None else float(t.p_value))
            for t in map(s.test, ("anderson_darling", "cramer_von_mises", "kolmogorov"))
        ]
        rows.append(
            (
                f.law.replace("_", " ") + (" (smallest AIC)" if s is laws.best else ""),
                values,
                decision,
                *ps,
                fixed(f.statistic, 1),
                MISSING if f.df is None else str(f.df),
                fixed(f.critical, 1),
                probability(f.p_value),
                fixed(f.log_likelihood, 1),
                fixed(f.aic, 1),
                fixed(f.bic, 1),
            )
        )
    judge = _LETTERS[laws.judged_by(laws.laws[0])]
    columns = (
        Column("law", "", "", "left"),
        Column("estimated", "", "values found by maximum likelihood", "left"),
        Column("decision", "", f"by {judge}, at level {study.options.alpha:.3g}", "left"),
        Column("p of A²", "", "Anderson-Darling, weighted for the tails"),
        Column("p of W²", "", "Cramér-von Mises"),
        Column("p of D", "", "Kolmogorov"),
        Column("chi-square", "", "sum of (found - expected)² / expected over the common classes"),
        Column("df", "", "degrees of freedom: classes - 1 - estimated values"),
        Column("limit", "", "critical value of chi-square"),
        Column("p", "", "probability of a chi-square as large if the law holds"),
        Column("log L", "", "logarithm of the likelihood: larger is better"),
        Column("AIC", "", "Akaike's criterion, 2 k - 2 log L: smaller is better"),
        Column("BIC", "", "Schwarz's criterion, k log n - 2 log L: smaller is better"),
    )
    note = "A law that is not rejected is not proven. " + next((t.note for s in laws.laws for t in s.tests), "")
    return DataTable("Laws compared", columns, tuple(rows), note.strip())


def _classes_table(laws: LawsStudied) -> DataTable | None:
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


def _scale_blocks(study: ResidualStudy) -> list[Block]:
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
    rows = tuple(_scale_row(r) for r in study.scale_rules)
    note = (
        "S_M: v'v over n - 1. S_o: v'v over the redundancy; on raw residuals it rejects truly normal errors in about half of all cases, "
        "and is described only. Q_v: each residual divided by its own standard deviation. S_P: mean and standard deviation with the "
        "smallest chi-square."
    )
    return [DataTable("The normal law with the standard deviation by each rule", columns, rows, note)]


def _scale_row(r: ScaleRule) -> tuple[str | Cell, ...]:
    f = r.fit
    described = Cell("described only", "info")
    decision = described if r.described else Cell("") if r.rejected is None else _decision(r.rejected)
    limit = MISSING if f is None or r.described else fixed(f.critical, 2)
    chi, df = (MISSING, MISSING) if f is None else (fixed(f.statistic, 2), str(f.df))
    return r.symbol, significant(r.mean, 3), significant(r.deviation, 4), chi, df, limit, probability(r.p_value), decision


def _left_out(study: ResidualStudy) -> list[Block]:
    if not study.left_out:
        return []
    return [Items("These parts do not apply to the table:", tuple(f"{what}: {why}." for what, why in study.left_out))]
