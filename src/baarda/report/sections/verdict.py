"""The verdict: the outcome in five to eight plain sentences, each with number, limit and meaning."""

from __future__ import annotations

import numpy as np
from scipy import stats

from baarda.hypotheses.base import TestResult
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import (
    almost_infinite,
    bare,
    clusters,
    image_rows,
    insignificant,
    judge,
    label_of,
    point_sigmas,
    result_of,
    rows_by_unit,
    spatial,
    unit_of,
)
from baarda.report.sections._numbers import column, finer, fixed, names, p_stated, plural, powers, significant
from baarda.report.sections.base import Block, SectionMaker, Sentence, Tone, Verdict, say
from baarda.report.translation import tr


def sentences(analysis: Analysis) -> list[Sentence]:
    """Return the sentences of the verdict, the most general first.

    Parameters
    ----------
    analysis : Analysis

    Returns
    -------
    list of Sentence
        Five to eight; one or two where the adjustment did not converge.
    """
    if not analysis.converged:
        return [s for s in (_not_converged(analysis), _weak_datum(analysis)) if s is not None]
    parts = (
        _adjusted if analysis.audit is None else _audited,
        _likelihood,
        _variance_factor,
        _parameters,
        _suspected,
        _hidden,
        _precision,
        _points,
        _law,
    )
    return [s for s in (part(analysis) for part in parts) if s is not None]


def _not_converged(analysis: Analysis) -> Sentence:
    a = analysis.adjustment
    return Sentence(
        "Convergence",
        say(
            "The adjustment did not converge in {steps} (v'Pv fell from {first} to {last}): the values are not a solution, and nothing "
            "was tested.",
            steps=plural(len(a.history) - 1, "iteration"),
            first=significant(a.history[0].objective, 4),
            last=significant(a.history[-1].objective, 4),
        ),
        "bad",
        "data",
    )


def _weak_datum(analysis: Analysis) -> Sentence | None:
    found = analysis.adjustment.datum_precision
    if found is None or not found.turns:
        return None
    size = significant(float(np.degrees(found.rotation)), 2)
    return Sentence(
        "Datum",
        say(
            "What is known of places hardly determines the orientation of the whole network (a priori standard deviation {size}°): such an "
            "adjustment is far from linear.",
            size=size,
        ),
        "warn",
        "problems",
    )


def _adjusted(analysis: Analysis) -> Sentence:
    a = analysis.adjustment
    d = a.datum.defect.count
    text = say(
        "The adjustment converged in {steps}: {n} observations{datum} determine {u} unknowns with a redundancy of {r}, {share} per "
        "observation on average.",
        steps=plural(len(a.history) - 1, "iteration"),
        n=a.count,
        datum=say(" and {count} of the datum", count=plural(d, "condition")) if d else "",
        u=a.numbering.count,
        r=a.redundancy,
        share=fixed(a.redundancy / a.count, 2),
    )
    return Sentence("Adjustment", text, "good", "data")


def _audited(analysis: Analysis) -> Sentence | None:
    """Say how the source's own solution compares with the minimum, and what its report may hide; instead of the plain sentence."""
    a, audit = analysis.adjustment, analysis.audit
    if audit is None:
        return None
    group, _, rms, _, _ = max(audit.by_group(), key=lambda g: g[2])
    far = max(audit.distance, rms)
    fields = {
        "value": significant(audit.objective, 5),
        "excess": significant(100.0 * audit.excess, 2),
        "least": significant(a.objective, 5),
        "steps": plural(len(a.history) - 1, "iteration"),
        "distance": significant(far, 2),
        "n": a.count,
        "u": a.numbering.count,
        "group": tr(group),
    }
    text = say(
        "The source's solution has v'Pv = {value}, {excess} % above the minimum {least} that {steps} reach ({n} observations, {u} "
        "unknowns); it lies {distance} sigma from there (rms, limit 1): within what the observations can tell."
        if far <= 1.0
        else "The source's solution has v'Pv = {value}, {excess} % above the minimum {least} that {steps} reach ({n} observations, {u} "
        "unknowns); its unknowns of the kind {group} lie {distance} sigma from there (rms, limit 1): it is not the least-squares solution "
        "of these observations.",
        **fields,
    )
    if audit.conditional_share is not None and audit.conditional_share[0] < 0.9:
        text += " " + say(
            "Sigmas of its points with the cameras held fixed would show {share} of the true ones in the median.",
            share=fixed(audit.conditional_share[0], 2),
        )
    return Sentence("Audit", text, "good" if far <= 1.0 else "warn" if far <= 3.0 else "bad", "audit")


def _likelihood(analysis: Analysis) -> Sentence | None:
    """Say which law of errors the adjustment took, and what it resists: under a law most tests do not apply."""
    law = analysis.adjustment.law
    if law is None:
        return None
    return Sentence("Law of errors", f"{law.assumptions[0]} {law.assumptions[2]}", "warn", "data")


def _variance_factor(analysis: Analysis) -> Sentence | None:
    test = result_of(analysis, "global_variance_factor")
    if test is None or not isinstance(test.critical, tuple):
        return None
    a = analysis.adjustment
    ratio = float(test.statistic) / a.redundancy
    low, high = (c / a.redundancy for c in test.critical)
    fields = {"value": fixed(ratio, 3), "low": fixed(low, 3), "high": fixed(high, 3), "times": significant(np.sqrt(ratio), 3)}
    if not test.rejected:
        text = "The variance factor {value} lies within {low}..{high}: the residuals are as large as the a-priori sigmas promise."
    elif ratio > 1.0:
        text = (
            "The variance factor {value} lies outside {low}..{high}: the residuals are {times} times as large as the a-priori sigmas "
            "promise."
        )
    else:
        text = (
            "The variance factor {value} lies outside {low}..{high}: the residuals are only {times} times as large as the a-priori sigmas "
            "promise; the observations are better than assumed."
        )
    return Sentence("Variance factor", say(text, **fields), "bad" if test.rejected else "good", "tests")


#: Of networks with cameras, and of others (antenna tracks): the only one, all, and some are (not) significant.
_ADDITIONAL = {
    True: (
        "The only additional camera parameter, {name}, differs significantly from zero at level {alpha} (|t| = {t}, limit {limit}).",
        "All {count} additional camera parameters differ significantly from zero at level {alpha} (smallest |t| = {t} for {name}, limit "
        "{limit}).",
        "{weak} of {count} additional camera parameters {verb} not differ significantly from zero at level {alpha} (|t| below {limit}): "
        "{names}; the model may do without.",
    ),
    False: (
        "The only additional parameter, {name}, differs significantly from zero at level {alpha} (|t| = {t}, limit {limit}).",
        "All {count} additional parameters differ significantly from zero at level {alpha} (smallest |t| = {t} for {name}, limit {limit}).",
        "{weak} of {count} additional parameters {verb} not differ significantly from zero at level {alpha} (|t| below {limit}): {names}; "
        "the model may do without.",
    ),
}


def _parameters(analysis: Analysis) -> Sentence | None:
    test = result_of(analysis, "additional_parameter")
    if test is None or not isinstance(test.critical, tuple):
        return None
    weak, tested = insignificant(analysis)
    cameras = bool(analysis.adjustment.network.cameras)
    title, place = ("Camera model", "cameras") if cameras else ("Additional parameters", "other-unknowns")
    only, every, some = _ADDITIONAL[cameras]
    fields = {"count": len(tested), "alpha": f"{test.alpha:.3g}", "limit": fixed(test.critical[1], 2)}
    size = np.abs(np.asarray(test.statistic))
    if not weak:
        i = int(np.argmin(size))
        text = say(only if len(tested) == 1 else every, t=significant(size[i], 3), name=bare(tested[i], analysis), **fields)
        return Sentence(title, text, "good", place)
    text = say(some, weak=len(weak), verb="does" if len(weak) == 1 else "do", names=names(weak, 6), **fields)
    return Sentence(title, text, "warn", place)


def _suspected(analysis: Analysis) -> Sentence | None:
    test = result_of(analysis, "data_snooping")
    if test is None:
        return None
    name, values, limit = judge(analysis)
    tested = int(np.isfinite(values).sum())
    found = len(analysis.suspected)
    fields = {"found": found, "tested": tested, "name": name, "limit": fixed(limit, 2)}
    if not found:
        worst = float(np.nanmax(np.abs(values))) if tested else float("nan")
        text = say(
            "No observation is suspected of a gross error: the largest of {tested} |{name}| is {worst}, the limit {limit}.",
            worst=fixed(worst, 2),
            **fields,
        )
        return Sentence("Gross errors", text, "good", "suspected")
    row = int(analysis.suspected[0])
    expected = tested * test.alpha
    text = say(
        "{found} of {tested} observations {verb} suspected of a gross error (|{name}| above {limit}; chance alone would show "
        "{expected}); the worst is {label} with {name} = {value}: estimated error {error} {unit}.",
        verb="is" if found == 1 else "are",
        expected=significant(expected, 2),
        label=label_of(analysis, row),
        value=fixed(float(values[row]), 2),
        error=significant(float(analysis.observations["estimated_error"][row]), 3),
        unit=unit_of(analysis, row),
        **fields,
    )
    gathered = [c for c in clusters(analysis) if c.kind == "point"]
    if gathered:
        share = sum(c.suspected for c in gathered)
        where = names([c.label for c in gathered], 5)
        text += " " + say(
            "{count} of them gather at {points}.",
            count=share,
            points=say("points {names}" if len(gathered) > 1 else "point {names}", names=where),
        )
    return Sentence("Gross errors", text, "warn" if within_chance(analysis) else "bad", "suspected")


def within_chance(analysis: Analysis) -> bool:
    """Return whether number and size of the suspected observations are what chance alone shows (level 0.01, independent tests)."""
    test = result_of(analysis, "data_snooping")
    if test is None:
        return True
    tested = int(np.isfinite(np.asarray(test.statistic)).sum())
    many = len(analysis.suspected) > stats.binom.ppf(0.99, tested, test.alpha)
    smallest = float(np.nanmin(test.p_value)) if tested else 1.0
    return not many and smallest > 0.01 / max(tested, 1)


def _hidden(analysis: Analysis) -> Sentence | None:
    if result_of(analysis, "data_snooping") is None:
        return None
    rows = np.flatnonzero(image_rows(analysis))
    what = tr("image coordinate")
    if not len(rows):
        rows, what = np.arange(analysis.adjustment.count), tr("observation")
    bias = analysis.observations["mdb"]
    lost = int(np.isnan(analysis.w).sum())
    rows = rows[np.isfinite(bias[rows])]
    if not len(rows):
        return Sentence("Reliability", say("No {what} is controlled by others: gross errors cannot be found.", what=what), "bad", "groups")
    parts = rows_by_unit(analysis, rows)
    worst = {unit: int(at[int(np.argmax(bias[at]))]) for unit, at in parts.items()}
    power = fixed(analysis.options.power, 2)
    if len(parts) == 1:
        (unit, at), row = next(iter(parts.items())), next(iter(worst.values()))
        text = say(
            "A gross error in an {what} is found with probability {power} from {median} {unit} on (median, by the a-priori sigmas); the "
            "least controlled one, {label}, may hide up to {most} {unit}.",
            what=what,
            power=power,
            median=significant(float(np.median(bias[at])), 2),
            most=significant(float(bias[row]), 2),
            unit=unit,
            label=label_of(analysis, row),
        )
    else:
        text = say(
            "A gross error is found with probability {power} from {medians} on (medians by unit, by the a-priori sigmas); the least "
            "controlled ones may hide up to {hidden}.",
            power=power,
            medians=names(
                [
                    say(
                        "{median} {unit} ({rows})",
                        median=significant(float(np.median(bias[at])), 2),
                        unit=powers(u),
                        rows=plural(len(at), what),
                    )
                    for u, at in parts.items()
                ],
                5,
            ),
            hidden=names([f"{significant(float(bias[i]), 2)} {powers(u)} ({label_of(analysis, i)})" for u, i in worst.items()], 5),
        )
    if lost:
        text += " " + say(
            "{count} controlled by no other: an error there stays hidden, whatever its size.",
            count=plural(lost, "observation is", "observations are"),
        )
    return Sentence("Reliability", text, "warn" if lost else "info", "groups")


def _precision(analysis: Analysis) -> Sentence | None:
    table, sigmas = point_sigmas(analysis)
    infinite = almost_infinite(analysis)
    free = (sigmas > 0.0).any(axis=1) & ~infinite
    if not free.any():
        return None
    whole = spatial(sigmas)
    sigmas = sigmas[~infinite]
    weakest = int(np.argmax(np.where(free, whole, -1.0)))
    # Coordinates of one axis may all be fixed, as heights of a network in the plane.
    medians = [float(np.median(s[s > 0.0])) if (s > 0.0).any() else float("nan") for s in sigmas.T]
    unit, factor = finer(analysis.adjustment.network.unit, sigmas[sigmas > 0.0])
    known = np.append(medians, whole[weakest]) * factor
    told = iter(column(known[np.isfinite(known)], 2))
    shown = [next(told) if np.isfinite(value) else tr("fixed") for value in known]
    text = say(
        "The object points have standard deviations of {x} / {y} / {z} {unit} in X / Y / Z (medians, {scaling}); the weakest is point "
        "{name} with {most} {unit} in space.",
        x=shown[0],
        y=shown[1],
        z=shown[2],
        unit=unit,
        scaling="a posteriori" if analysis.options.sigma == "aposteriori" else "a priori",
        name=table["point"][weakest],
        most=shown[3],
    )
    if infinite.any():
        text += " " + say("{count} told from infinity.", count=plural(int(infinite.sum()), "point cannot be", "points cannot be"))
    return Sentence("Precision", text, "info", "points")


def _points(analysis: Analysis) -> Sentence | None:
    """Judge by the joint tests; single points count where more of them are rejected than chance rejects."""
    said = [part for part in (_check(analysis), _control(analysis)) if part is not None]
    if not said:
        return None
    tones = [tone for _, tone in said]
    tone: Tone = "bad" if "bad" in tones else "warn" if "warn" in tones else "good"
    return Sentence("Control and check points", " ".join(text for text, _ in said), tone, "check-control")


def _judged(joint: TestResult, each: TestResult) -> tuple[Tone, list[str], bool]:
    """Return the tone, the points rejected singly, the worst first, and whether they are more than chance rejects (level 0.01)."""
    p = np.asarray(each.p_value, dtype=float)
    order = [int(i) for i in np.argsort(p, kind="stable") if np.asarray(each.rejected)[i]]
    many = len(order) > float(stats.binom.ppf(0.99, int(np.isfinite(p).sum()), each.alpha))
    return "bad" if joint.rejected else "warn" if many else "good", [each.labels[i] for i in order], many


def _check(analysis: Analysis) -> tuple[str, Tone] | None:
    e, joint, each = analysis.evidence.check, result_of(analysis, "check_points"), result_of(analysis, "check_point")
    if e is None or joint is None or each is None:
        return None
    tone, wrong, _ = _judged(joint, each)
    count = len(each.labels)
    rms = float(np.sqrt(np.sum(np.square(e.values)) / count))
    unit, factor = finer(analysis.adjustment.network.unit, [rms])
    template = (
        "{points} from the survey by more than the predicted precision allows (T = {t}, limit {limit}; RMSE {rms} {unit}; singly rejected: "
        "{names})."
        if joint.rejected
        else "{points} from the survey by no more than the predicted precision allows (T = {t}, limit {limit}; RMSE {rms} {unit}; singly "
        "rejected: {names})."
    )
    text = say(
        template,
        points=plural(count, "check point differs", "check points differ"),
        t=fixed(float(joint.statistic), 2),
        limit=fixed(_upper(joint.critical), 2),
        rms=significant(rms * factor, 3),
        unit=unit,
        names=names(wrong, 5) or tr("none"),
    )
    return text, tone


def _control(analysis: Analysis) -> tuple[str, Tone] | None:
    joint, each = result_of(analysis, "control_points"), result_of(analysis, "control_point")
    if joint is None or each is None:
        return None
    tone, wrong, many = _judged(joint, each)
    fields = {
        "t": fixed(float(joint.statistic), 2),
        "limit": fixed(_upper(joint.critical), 2),
        "wrong": len(wrong),
        "count": len(each.labels),
    }
    if joint.rejected and wrong:
        template = (
            "The weighted control contradicts its sigmas (T = {t}, limit {limit}): {wrong} of {count} points are rejected singly, the "
            "worst is {worst}."
        )
    elif joint.rejected:
        template = "The weighted control contradicts its sigmas (T = {t}, limit {limit}), though none of {count} points singly."
    else:
        template = "The weighted control agrees with its sigmas (T = {t}, limit {limit}; {wrong} of {count} points rejected singly{more})."
    more = tr(", more than chance rejects") if many else ""
    return say(template, worst=wrong[0] if wrong else "", more=more, **fields), tone


def _upper(critical: float | tuple[float, float]) -> float:
    return critical[1] if isinstance(critical, tuple) else critical


def _law(analysis: Analysis) -> Sentence | None:
    laws = [f for f in analysis.laws if f.aic is not None]
    normal = next((f for f in laws if f.law == "normal"), None)
    if normal is None or normal.statistic is None or normal.critical is None:
        return None
    best = min(laws, key=lambda f: f.aic if f.aic is not None else np.inf)
    simulated = result_of(analysis, "goodness_of_fit")
    rejected = bool(normal.rejected if simulated is None else simulated.rejected)
    if simulated is None:
        test = say(
            "chi-square {chi}, limit {limit}, p {p} for independent values",
            chi=fixed(normal.statistic, 1),
            limit=fixed(normal.critical, 1),
            p=p_stated(normal.p_value),
        )
    else:
        test = say(
            "Anderson-Darling {value}, limit {limit}, p {p} by simulated adjustments",
            value=fixed(float(simulated.statistic), 2),
            limit=fixed(_upper(simulated.critical), 2),
            p=p_stated(float(simulated.p_value)),
        )
    more = ""
    if not rejected:
        text = "The residuals do not contradict normal errors ({test})."
        if best.law != "normal":
            more = " The {best} has the better AIC, but not by enough to reject the normal law."
    elif best.law == "normal":
        text = "The residuals are not those of normal errors ({test}); no other law tried fits them better."
    elif best.rejected:
        text = (
            "The residuals are not those of normal errors ({test}); of the laws tried the {best} fits best by AIC, though its chi-square "
            "rejects it too."
        )
    else:
        text = "The residuals are not those of normal errors ({test}); of the laws tried the {best} fits best by AIC."
    tone: Tone = "warn" if rejected else "good"
    name = law_name(best.law, best.parameters.get("a"))
    return Sentence("Law of residuals", say(text, test=test, best=name) + (say(more, best=name) if more else ""), tone, "law")


def law_name(law: str, a: float | None = None) -> str:
    """Return the name of a law in words.

    Examples
    --------
    >>> law_name("modulated_normal", -0.143), law_name("radico", 0.5)
    ('modulated normal law (a = -0.14)', 'radico law')
    """
    words = tr(law.replace("_", " "))
    if law == "modulated_normal" and a is not None:
        return say("{law} law (a = {a})", law=words, a=significant(a, 2))
    return say("{law} law", law=words)


def _build(analysis: Analysis) -> list[Block]:
    return [Verdict(tuple(sentences(analysis)))]


VERDICT = SectionMaker(10, "verdict", "Verdict", _build)
