"""The sections of the report of a column of residuals."""

from __future__ import annotations

import numpy as np

from baarda.formats.residual_table import ResidualTable
from baarda.procedures.group_study import Groups
from baarda.procedures.residual_study import ResidualStudy
from baarda.report import plots
from baarda.report.residual_verdict import KINDS, sentences
from baarda.report.sections._laws import classes_table, decision, figures, laws_table, ratios_table, scale_table, short, table_of_tests
from baarda.report.sections._numbers import MISSING, fixed, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, Items, Paragraph, Section, Verdict, say, translated
from baarda.report.translation import tr

MOST_ROWS = 200


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
        ("scales", "Scale rules", [scale_table(study.scale_rules)]),
        ("left-out", "What was not done", _left_out(study)),
    ]
    return [translated(Section(anchor, title, tuple(blocks))) for anchor, title, blocks in parts if blocks]


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
                kind=tr(KINDS[study.kind]),
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


def _tests_blocks(study: ResidualStudy) -> list[Block]:
    return table_of_tests("Tests of the moments", study.tests)


def _groups_blocks(study: ResidualStudy) -> list[Block]:
    groups = study.groups
    if groups is None:
        return []
    blocks = table_of_tests("Tests of equal variances", groups.tests)
    each = groups.test("variance_per_group")
    order = groups.tested
    if each is not None:
        p, rejected = np.asarray(each.p_value), np.asarray(each.rejected)
        if len(order) <= MOST_ROWS:
            blocks.insert(0, _group_figure(groups, order, rejected, float(each.details["reference"])))
        chosen = np.argsort(p, kind="stable")[:MOST_ROWS]
        rows = [
            (
                groups.names[order[i]] or tr("(no name)"),
                str(int(groups.counts[order[i]])),
                significant(float(groups.means[order[i]]), 3),
                significant(float(np.sqrt(groups.variances[order[i]])), 4),
                fixed(float(groups.df[order[i]]), 2),
                short(float(np.asarray(each.statistic)[i])),
                probability(float(p[i])),
                decision(bool(rejected[i]), "warn"),
            )
            for i in chosen
        ]
        about = "degrees of freedom: redundancy numbers" if groups.by_redundancy else "degrees of freedom: values minus one"
        columns = (
            Column("group", "", "the most deviating first", "left"),
            Column("n", "", "number of values"),
            Column("mean", "", "of the residuals" if study.kind == "raw" else "of the residuals divided by their sigmas"),
            Column("S", "", "standard deviation"),
            Column("r", "", about),
            Column("r S² / S² pooled", "", "the statistic that is judged"),
            Column("p", "", "two-sided, under the beta law of a part of the pooled variance"),
            Column("decision", "", "", "left"),
        )
        told = {"most": MOST_ROWS, "count": len(order), "file": "tables/groups"}
        shortened = "" if len(order) <= MOST_ROWS else say("The first {most} of {count} rows; all are in {file}.", **told)
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
                axes.plot(x[chosen], ratio[chosen], marker, color=colour, markersize=5, label=tr(word))
        axes.axhline(1.0, color=plots.INK, linewidth=0.9, linestyle=(0, (5, 2)))
        axes.set_xlim(0.25, len(ratio) + 0.75)
        if len(labels) <= 40:
            short = [t if len(t) <= 14 else f"{t[:12]}.." for t in labels]
            upright = sum(len(t) + 1 for t in short) > 90
            axes.set_xticks(x, short, **({"rotation": 60, "ha": "right", "rotation_mode": "anchor"} if upright else {}))
        axes.set_xlabel(tr("group" if len(labels) <= 40 else "group, in the order of the table"))
        axes.set_ylabel(tr("S / S pooled"))
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
    label = "(value - mean) / standard deviation"
    blocks = [*figures(laws, study.values, study.mean, study.deviation, label), laws_table(laws, study.options.alpha)]
    if laws.ratio is not None:
        blocks += table_of_tests("Normal against modulated normal", (laws.ratio,))
    classes = classes_table(laws)
    if classes is not None:
        blocks.append(classes)
    return [*blocks, *ratios_table(laws)]


def _left_out(study: ResidualStudy) -> list[Block]:
    if not study.left_out:
        return []
    return [Items("These parts do not apply to the table:", tuple(f"{tr(what)}: {tr(why)}." for what, why in study.left_out))]
