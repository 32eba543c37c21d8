"""Residual law: which law of errors the standardised residuals follow, and what it means for the tests of single observations."""

from __future__ import annotations

import numpy as np

from baarda.procedures.adjustment_laws import AdjustmentLaws
from baarda.procedures.error_law import CriticalValues, Limit
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import result_of
from baarda.report.sections._laws import classes_table, decision, figures, laws_table, ratios_table, scale_table, table_of_tests
from baarda.report.sections._numbers import fixed, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Items, Paragraph, SectionMaker, say
from baarda.report.translation import tr


def _moments(analysis: Analysis) -> list[Block]:
    rows: list[tuple[str | Cell, ...]] = []
    note = ""
    for name, key, normal in (
        ("mean_of_residuals", "mean", "0"),
        ("skewness_of_residuals", "skewness", "0"),
        ("kurtosis_of_residuals", "kurtosis", "3"),
    ):
        test = result_of(analysis, name)
        if test is None:
            continue
        value = test.details.get(key)
        shown = "" if value is None else fixed(value, 4)
        if not test.details.get("applicable", True):
            rows.append((key, shown, normal, "", Cell("not applicable", "info")))
            note = test.note
        else:
            rows.append((key, shown, normal, probability(float(test.p_value)), decision(bool(test.rejected), "warn")))
    both = result_of(analysis, "jarque_bera")
    if both is not None:
        shown = fixed(float(both.statistic), 2)
        rows.append(("Jarque-Bera", shown, "0", probability(float(both.p_value)), decision(bool(both.rejected), "warn")))
    if not rows:
        return []
    columns = (
        Column("moment", "", "of the standardised residuals; Jarque-Bera joins skewness and kurtosis", "left"),
        Column("found", "", "of the sample"),
        Column("normal law", "", "value under the normal law"),
        Column("p", "", "see All tests"),
        Column("decision", "", "", "left"),
    )
    return [DataTable("Moments of the standardised residuals", columns, tuple(rows), note)]


def _limit(limit: Limit) -> tuple[str, str]:
    return f"{fixed(limit.value, 2)} ± {fixed(limit.error, 2)}", fixed(limit.normal, 2)


def _critical(found: CriticalValues) -> list[Block]:
    a = found.law.parameters["a"]
    if np.isinf(a):
        text = (
            "By the kurtosis of the residuals, traced back through Qvv, the errors are as normal as can be (a = ∞): critical values of w "
            "and tau and the minimal detectable biases are those of the normal law."
        )
        return [Paragraph(text)]
    rows: list[tuple[str | Cell, ...]] = []
    for k, c in enumerate(found.classes):
        own = found.members == k
        ratio = float(np.nanmedian(found.mdb[own] / found.mdb_normal[own]))
        span = f"{fixed(c.lowest, 3)}..{fixed(c.highest, 3)}"
        levels = (significant(c.level_w, 2), significant(c.level_tau, 2))
        rows.append((span, str(c.count), *_limit(c.w), *_limit(c.tau), *levels, *_limit(c.delta0), fixed(ratio, 2)))
    n = int((found.members >= 0).sum())
    rows.append(
        (
            say("largest of all, level {alpha}", alpha=f"{found.family_alpha:.3g}"),
            str(n),
            *_limit(found.family_w),
            *_limit(found.family_tau),
            *[""] * 5,
        )
    )
    columns = (
        Column(
            "redundancy",
            "",
            "class of redundancy numbers: the less an observation is controlled, the more errors its residual mixes",
            "left",
        ),
        Column("n", "", "observations"),
        Column("w", "", "critical value of |w| under the law of the errors, with its simulation error"),
        Column("w, normal", "", "the same for normal errors"),
        Column("tau", "", "critical value of |tau| under the law of the errors"),
        Column("tau, normal", "", "the same for normal errors"),
        Column("level of w", "", "how often the normal critical value really rejects a good observation by w"),
        Column("level of tau", "", "the same by tau"),
        Column("shift", "", "of w, that is found with the power below"),
        Column("shift, normal", "", "the same for normal errors"),
        Column("MDB / normal", "", "minimal detectable bias relative to that of normal errors"),
    )
    note = say(
        "Law of the errors: modulated normal with a = {a}, from the kurtosis of the residuals through Qvv. A residual mixes errors, and a "
        "mixture of modulated normal errors is not modulated normal: {replicas} adjustments of such errors were simulated. Level {alpha} "
        "for one observation, power {power}. The decisions of this report are those for normal errors.",
        a=significant(a, 2),
        replicas=found.replicas,
        alpha=f"{found.alpha:g}",
        power=fixed(found.power, 2),
    )
    return [DataTable("Critical values under the law of the errors", columns, tuple(rows), note)]


def _two_values(likelihood: float, kurtosis: float) -> Paragraph:
    """Say why the a by maximum likelihood and that by the kurtosis relation differ."""
    return Paragraph(
        say(
            "Two values of a stand in this section, and they answer two questions. a = {likelihood} is the law of the residuals, "
            "by maximum likelihood: all residuals speak, most of them near the middle. a = {kurtosis} is the law of the errors "
            "behind them, from their kurtosis through Qvv: the fourth moment listens to the tails, and the mixing of errors by the "
            "adjustment, which makes residuals more normal than errors, is undone. They would agree if the errors were modulated "
            "normal and the redundancy high; the farther they part, the less a modulated normal law describes middle and tails at "
            "once (gross errors left, or groups of different precision).",
            likelihood=significant(likelihood, 2),
            kurtosis=significant(kurtosis, 2),
        )
    )


def _intro(analysis: Analysis, study: AdjustmentLaws) -> str:
    return say(
        "Each residual of {what} ({n}) was divided by its own standard deviation (tau), which makes residuals of good and weak "
        "geometry comparable. A modulated normal law with a = 1/2 is the radico, with a = 1 the lineo, with a = infinity the normal; a "
        "small a means a mixture of precisions: a sharp peak and long tails.",
        what=tr(study.what),
        n=len(study.values),
    )


def _build(analysis: Analysis) -> list[Block] | None:
    study = analysis.study
    if study is None or not study.laws.laws:
        return None
    laws = study.laws
    blocks: list[Block] = [
        Paragraph(_intro(analysis, study)),
        *figures(laws, study.values, 0.0, 1.0, "standardised residual tau (own standard deviations)"),
        laws_table(laws, study.options.alpha),
    ]
    if laws.ratio is not None:
        blocks += table_of_tests("Normal against modulated normal", (laws.ratio,))
    if laws.modulated is not None and laws.interval is not None:
        text = say(
            "Among the modulated normal laws a = {a} fits the residuals best, with {level} % interval {low} to {high}{normal}.",
            a=significant(laws.modulated.parameters["a"], 3),
            level=f"{100 * study.options.interval:g}",
            low=significant(laws.interval[0], 3),
            high=significant(laws.interval[1], 3),
            normal=tr(", the normal law itself") if np.isinf(laws.interval[1]) else "",
        )
        blocks.append(Paragraph(text))
    if study.critical is not None:
        blocks += _critical(study.critical)
        if laws.modulated is not None:
            blocks.append(_two_values(float(laws.modulated.parameters["a"]), float(study.critical.law.parameters["a"])))
    blocks += _moments(analysis)
    if study.scale_rules:
        blocks.append(scale_table(study.scale_rules))
    classes = classes_table(laws)
    if classes is not None:
        blocks.append(classes)
    blocks += ratios_table(laws)
    if study.left_out:
        blocks.append(Items("Not done:", tuple(f"{what}: {why}." for what, why in study.left_out)))
    return blocks


LAW = SectionMaker(110, "law", "Residual law", _build)
