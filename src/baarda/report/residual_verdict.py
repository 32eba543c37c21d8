"""The verdict on a column of residuals: plain sentences with number, limit and meaning."""

from __future__ import annotations

import numpy as np

from baarda.formats.residual_table import ResidualTable
from baarda.hypotheses.base import TestResult
from baarda.procedures.law_study import LawsStudied, LawStudy
from baarda.procedures.residual_study import ResidualStudy
from baarda.report.sections._numbers import fixed, names, p_stated, plural, significant
from baarda.report.sections.base import Sentence, Tone, say
from baarda.report.sections.verdict import law_name
from baarda.report.translation import tr

KINDS = {
    "raw": "the residuals as they stand in the table",
    "weighted": "residuals divided by their a-priori sigmas",
    "standardised": "residuals divided by their own standard deviations s0 sigma sqrt(r)",
}
_FREE_CENTRE = -0.25  # lower bound of a with a free mean


def sentences(table: ResidualTable, study: ResidualStudy) -> list[Sentence]:
    """Return the sentences of the verdict, the most general first.

    Parameters
    ----------
    table : ResidualTable
    study : ResidualStudy

    Returns
    -------
    list of Sentence
    """
    made = [_sample(table, study), _variance_factor(study), _moments_sentence(study), _homogeneity(study)]
    made += [_normal(study), _modulated(study), _rivals(study), _scales(study)]
    return [s for s in made if s is not None]


def _sample(table: ResidualTable, study: ResidualStudy) -> Sentence:
    text = say(
        "{count} of column {column} were studied ({kind}){aside}: mean {mean}, standard deviation {deviation}, skewness {skewness}, "
        "kurtosis {kurtosis} (normal: 0 and 3).",
        count=plural(study.n, "value"),
        column=table.column,
        kind=tr(KINDS[study.kind]),
        aside=say(", {count} that no other observation controls were set aside", count=study.set_aside) if study.set_aside else "",
        mean=significant(study.mean, 3),
        deviation=significant(study.deviation, 4),
        skewness=fixed(study.skewness, 3),
        kurtosis=fixed(study.kurtosis, 3),
    )
    return Sentence("Sample", text, "info", "sample")


def _variance_factor(study: ResidualStudy) -> Sentence | None:
    test = study.test("global_variance_factor")
    if test is None or study.redundancy is None or not isinstance(test.critical, tuple):
        return None
    low, high = (c / study.redundancy for c in test.critical)
    ratio = float(test.statistic) / study.redundancy
    fields = {"value": fixed(ratio, 3), "low": fixed(low, 3), "high": fixed(high, 3), "times": significant(np.sqrt(ratio), 3)}
    text = say(
        "The variance factor {value} lies outside of {low}..{high}: the residuals are {times} times as large as the sigmas promise."
        if test.rejected
        else "The variance factor {value} lies within {low}..{high}: the residuals are as large as the sigmas promise.",
        **fields,
    )
    return Sentence("Variance factor", text, "bad" if test.rejected else "good", "tests")


def _moments_sentence(study: ResidualStudy) -> Sentence | None:
    made = {
        "mean": study.test("mean_of_residuals"),
        "skewness": study.test("skewness_of_residuals"),
        "kurtosis": study.test("kurtosis_of_residuals"),
    }
    known = {name: t for name, t in made.items() if t is not None}
    if not known:
        return None
    wrong = [name for name, t in known.items() if t.rejected]
    ps = ", ".join(f"{tr(name)} p {p_stated(t.p_value)}" for name, t in known.items())
    if not wrong:
        text, tone = say("No moment contradicts normal residuals with expectation zero ({ps}).", ps=ps), "good"
    else:
        parts = []
        if "mean" in wrong:
            parts.append(tr("the mean differs from zero: a systematic part is left"))
        if "skewness" in wrong:
            parts.append(tr("the residuals are skew"))
        if "kurtosis" in wrong:
            longer = "the tails are longer than those of the normal law"
            parts.append(tr(longer if study.kurtosis > 3.0 else "the tails are shorter than those of the normal law"))
        text, tone = say("By the moments {parts} ({ps}).", parts="; ".join(parts), ps=ps), "bad" if "mean" in wrong else "warn"
    return Sentence("Moments", text, "good" if tone == "good" else "bad" if tone == "bad" else "warn", "tests")


def _homogeneity(study: ResidualStudy) -> Sentence | None:
    groups = study.groups
    if groups is None:
        return None
    common, each = groups.test("bartlett"), groups.test("variance_per_group")
    if common is None or each is None:
        said = tr("The variances of the groups could not be compared; see what was left out.")
        return Sentence("Groups", said, "info", "groups")
    robust = groups.test("brown_forsythe")
    fields = {
        "k": len(groups.tested),
        "t": fixed(float(common.statistic), 2),
        "limit": fixed(upper(common), 2),
        "p": p_stated(common.p_value),
    }
    beyond = int(np.sum(each.rejected))
    text = say(
        "The variances of {k} groups are {verb} (Bartlett {t}, limit {limit}, p {p}); {beyond} of them differ from the pooled variance "
        "singly, where chance alone gives about {chance}.",
        verb=tr("not equal" if common.rejected else "not shown to differ"),
        beyond=beyond,
        chance=significant(each.alpha * len(groups.tested), 2),
        **fields,
    )
    if robust is not None and bool(robust.rejected) != bool(common.rejected):
        text += say(
            " Brown and Forsythe's test, which does not lean on the normal law, {verb} (p {p}).",
            verb=tr("does reject" if robust.rejected else "does not reject"),
            p=p_stated(robust.p_value),
        )
    return Sentence("Homogeneity", text, "bad" if common.rejected else "good", "groups")


def upper(test: TestResult) -> float:
    """Return the (upper) critical value of a test."""
    return test.critical[1] if isinstance(test.critical, tuple) else test.critical


def _how(laws: LawsStudied, law: LawStudy) -> str:
    """Return the deciding test with its numbers."""
    if laws.judged_by(law) == "anderson_darling":
        test = law.test("anderson_darling")
        if test is not None:
            fields = {"value": significant(float(test.statistic), 3), "limit": significant(upper(test), 3), "p": p_stated(test.p_value)}
            return say("A² {value}, limit {limit}, p {p}", **fields)
    f = law.fit
    fields = {"value": fixed(f.statistic, 1), "limit": fixed(f.critical, 1), "p": p_stated(f.p_value)}
    return say("chi-square {value}, limit {limit}, p {p}", **fields)


def _normal(study: ResidualStudy) -> Sentence | None:
    law = next((s for s in study.laws.laws if s.fit.law == "normal"), None)
    decision = None if law is None else study.laws.rejected(law)
    if law is None or decision is None:
        return None
    text = "The normal law is rejected ({how})." if decision else "The normal law is not contradicted ({how})."
    return Sentence("Normal law", say(text, how=_how(study.laws, law)), "warn" if decision else "good", "laws")


def _modulated(study: ResidualStudy) -> Sentence | None:
    laws = study.laws
    if laws.modulated is None or laws.interval is None:
        return None
    a, (low, high) = laws.modulated.parameters["a"], laws.interval
    bounds = []
    if np.isinf(high):
        bounds.append(tr("it reaches a = ∞, the normal law itself"))
    if study.options.loc is None and low <= _FREE_CENTRE * (1.0 - 1e-9):
        bounds.append(tr("its lower end is the bound of a where the mean is free"))
    text = say(
        "Among the modulated normal laws a = {a} fits best, with {level} % interval {low} to {high}{bounds}.",
        a=significant(a, 3),
        level=f"{100 * study.options.interval:g}",
        low=significant(low, 3),
        high=significant(high, 3),
        bounds=f" ({'; '.join(bounds)})" if bounds else "",
    )
    tone: Tone = "info"
    if laws.ratio is not None:
        tone = "warn" if laws.ratio.rejected else "good"
        text += say(
            " The likelihood ratio {verb} the normal in favour of a finite a (2 ln L {t}, limit {limit}, p {p}).",
            verb=tr("rejects" if laws.ratio.rejected else "does not reject"),
            t=fixed(float(laws.ratio.statistic), 2),
            limit=fixed(upper(laws.ratio), 2),
            p=p_stated(laws.ratio.p_value),
        )
    if study.a_of_errors is not None and np.isfinite(study.a_of_errors) and tone == "warn":
        text += say(
            " By the kurtosis relation the errors behind the residuals are less normal: a about {a}. The two differ because the likelihood "
            "weighs all residuals and the kurtosis the tails, and because residuals mix errors.",
            a=significant(study.a_of_errors, 2),
        )
    return Sentence("Modulated normal", text, tone, "laws")


def _rivals(study: ResidualStudy) -> Sentence | None:
    laws = study.laws
    judged = [(s, laws.rejected(s)) for s in laws.laws]
    kept = [s.fit.law.replace("_", " ") for s, rejected in judged if rejected is False]
    out = [s.fit.law.replace("_", " ") for s, rejected in judged if rejected]
    if not kept and not out:
        return None
    best = laws.best
    text = say("Of {count} tested, {kept} not rejected", count=plural(len(kept) + len(out), "law"), kept=_are(kept))
    text += say(" and {out} rejected", out=_are(out)) if out else ""
    if best is not None and laws.rejected(best) is not None:
        text += say(
            "; the smallest AIC has the {name}{judged}.",
            name=law_name(best.fit.law, best.fit.parameters.get("a")),
            judged=tr(", though it is rejected") if laws.rejected(best) else "",
        )
    else:
        text += "."
    if len(kept) > 1:
        text += tr(" The values do not tell the laws that are kept apart.")
    return Sentence("Laws compared", text, "info" if kept else "warn", "laws")


def _are(laws: list[str]) -> str:
    if not laws:
        return tr("none is")
    return say("{law} is", law=laws[0]) if len(laws) == 1 else say("{laws} are", laws=names(laws, 9))


def _scales(study: ResidualStudy) -> Sentence | None:
    rule = next((r for r in study.scale_rules if r.described), None)
    sample = next((r for r in study.scale_rules if r.name == "sample"), None)
    if rule is None or sample is None:
        return None
    text = say(
        "S_o = {s_o} (divided by the redundancy) is {times} times S_M = {s_m} (divided by n - 1): raw residuals are smaller than the "
        "errors behind them. S_o describes the errors; it is no scale to test residuals with.",
        s_o=significant(rule.deviation, 4),
        s_m=significant(sample.deviation, 4),
        times=significant(rule.deviation / sample.deviation, 3),
    )
    return Sentence("Scale", text, "info", "scales")
