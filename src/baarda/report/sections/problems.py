"""Problems and suggestions: what a careful reader would point at, and what to do about it; then every assumption made."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from baarda.adjustment.far_points import RESOLVED
from baarda.network import CHECK
from baarda.observations import ImagePoints
from baarda.procedures.testing import Analysis
from baarda.report.sections._facts import (
    almost_infinite,
    bare,
    clusters,
    image_rows,
    insignificant,
    label_of,
    point_sigmas,
    result_of,
    shares,
    spatial,
)
from baarda.report.sections._numbers import finer, fixed, names, plural, probability, significant
from baarda.report.sections.base import Block, Cell, Column, DataTable, Items, Paragraph, SectionMaker, Tone, say
from baarda.report.sections.verdict import within_chance
from baarda.report.translation import tr

Problem = tuple[Tone, str, str, str]  # tone, problem, evidence, suggestion

_WEAK = 0.1  # redundancy number below which an observation is hardly controlled
_FAR = 5.0  # times the median standard deviation


def _convergence(analysis: Analysis) -> Iterator[Problem]:
    if not analysis.converged:
        yield (
            "bad",
            "The adjustment did not converge.",
            say(
                "{steps}; last relative step {step}",
                steps=plural(len(analysis.adjustment.history) - 1, "iteration"),
                step=_last_step(analysis),
            ),
            "Look at the history below, then at start values, wrong point numbers and gross errors; allow more iterations only if v'Pv "
            "still falls.",
        )


def _last_step(analysis: Analysis) -> str:
    return significant(analysis.adjustment.history[-1].relative_step, 2)


def _global(analysis: Analysis) -> Iterator[Problem]:
    test = result_of(analysis, "global_variance_factor")
    if test is None or not test.rejected:
        return
    s0 = analysis.adjustment.sigma0
    sizes = sorted({float(v) for g in analysis.adjustment.groups if isinstance(g, ImagePoints) for v in np.unique(g.sigmas)[:3]})
    image = (
        say(" (image coordinates: {new} instead of {old} px)", new=significant(sizes[0] * s0, 3), old=f"{sizes[0]:g}")
        if len(sizes) == 1
        else ""
    )
    evidence = say("s0 = {s0}, expected 1", s0=fixed(s0, 3))
    if s0 > 1.0:
        advice = say(
            "In this order: gross errors (Suspected observations), a model deficit (Residual vectors, Residual law), wrong weights "
            "between groups; only then enlarge the a-priori sigmas by {s0}{image}.",
            s0=fixed(s0, 2),
            image=image,
        )
    else:
        advice = say("The a-priori sigmas are too large: multiply them by {s0}{image}.", s0=fixed(s0, 2), image=image)
    yield "bad", "The global test is rejected.", evidence, advice


def _groups(analysis: Analysis) -> Iterator[Problem]:
    if analysis.adjustment.law is not None:  # s0 of a group is a number of least squares
        return
    whole = [s for s in shares(analysis) if not s.component and s.redundancy >= 5.0]
    ranked = sorted(whole, key=lambda s: s.sigma0)
    if len(ranked) >= 2 and ranked[-1].sigma0 > 1.5 * ranked[0].sigma0:
        yield (
            "warn",
            "The weights between the observation groups do not match.",
            "; ".join(f"{s.group}: s0 = {fixed(s.sigma0, 2)}" for s in ranked),
            "Multiply the a-priori sigmas of each group by its s0 and adjust again, after gross errors are gone.",
        )


def _gross(analysis: Analysis) -> Iterator[Problem]:
    count = len(analysis.suspected)
    if count and not within_chance(analysis):
        yield (
            "bad",
            say("{count} suspected of gross errors.", count=plural(count, "observation is", "observations are")),
            say("the worst: {label}", label=label_of(analysis, int(analysis.suspected[0]))),
            "Check the measurement of the worst one; remove or repeat it, adjust again, and only then judge the next: one error shows "
            "in many residuals.",
        )


def _snooped(analysis: Analysis) -> Iterator[Problem]:
    s = None if analysis.strategy is None else analysis.strategy.snooping
    if s is None:
        return
    out = len(s.images) if s.unit == "image" else s.count
    if out:
        what = plural(out, "image was", "images were") if s.unit == "image" else plural(out, "observation was", "observations were")
        evidence = say("see Data snooping; {stopped}", stopped=s.stopped)
        advice = "They are judged by statistics alone: look at the measurements before you believe that they are wrong."
        yield "info", say("{what} removed by data snooping.", what=what), evidence, advice
    kept = [" ".join(t for t in (k.image, k.point, k.component) if t) for k in s.steps if k.action == "kept"]
    if kept:
        advice = "They cannot be removed without losing a point, an image or the datum, or cannot be told apart: measure more rays there."
        yield (
            "warn",
            say("{count} suspected, but kept.", count=plural(len(kept), "observation is", "observations are")),
            names(kept, 6),
            advice,
        )


def _gathered(analysis: Analysis) -> Iterator[Problem]:
    found = clusters(analysis)
    points, images = ([c for c in found if c.kind == kind] for kind in ("point", "image"))
    if points:
        shown = [
            say("{found} of {total} at point {name}", found=c.suspected, total=c.tested, name=c.label)
            + (f" ({tr(c.known)})" if c.known else "")
            for c in points
        ]
        advice = "Not single measurements but the points are in doubt: check target, identification and point number."
        if any(c.known == "fixed control" for c in points):
            advice += " Fixed control cannot yield: check its coordinates, or give them a sigma so that they are tested, too."
        yield "bad", "Suspected observations gather at few points.", names(shown, 5), advice
    if images:
        shown = [say("{found} of {total} in image {name}", found=c.suspected, total=c.tested, name=c.label) for c in images]
        advice = "The images themselves are in doubt: movement, blur, a swapped point number that bends the orientation."
        yield "warn", "Suspected observations gather in few images.", names(shown, 5), advice


def _systematic(analysis: Analysis) -> Iterator[Problem]:
    for name, words in (
        ("mean_of_residuals", "The mean of the residuals is not zero."),
        ("skewness_of_residuals", "The residuals are skew."),
    ):
        test = result_of(analysis, name)
        if test is not None and test.rejected:
            advice = "A systematic part is left: look at the residual vectors and at the groups; a parameter of the model may be missing."
            yield "warn", words, say("p = {p}", p=significant(float(test.p_value), 2)), advice


def _images(analysis: Analysis) -> Iterator[Problem]:
    test = result_of(analysis, "variance_per_image")
    together = result_of(analysis, "bartlett_images")
    if test is None or together is None or not together.rejected:
        return
    s2, reference = np.asarray(test.details["variances"]), float(test.details["reference"])
    worse = np.flatnonzero(np.asarray(test.rejected) & (s2 > reference))
    if len(worse):
        order = worse[np.argsort(-s2[worse], kind="stable")]
        advice = "Look for blur, bad targets or wrong numbers in these images; where they are sound, give them their own sigma."
        yield (
            "warn",
            "The images are not equally precise.",
            say("less precise: {names}", names=names([test.labels[i] for i in order], 8)),
            advice,
        )


def _correlated(analysis: Analysis) -> Iterator[Problem]:
    found = analysis.adjustment.camera_correlations()
    if found:
        shown = [say("{a} and {b} ({r})", a=bare(a, analysis), b=bare(b, analysis), r=fixed(r, 3)) for a, b, r in found]
        yield (
            "warn",
            "Unknowns are hardly separable: correlations of 0.95 and more.",
            names(shown, 6),
            "Usual within K1, K2, K3 and harmless there as long as they are used together. Otherwise: rotate the camera, add depth or "
            "convergent images, or drop one of the pair.",
        )


def _superfluous(analysis: Analysis) -> Iterator[Problem]:
    weak, _ = insignificant(analysis)
    if weak:
        advice = "Leave them out one at a time, the least significant first; correlated ones may be significant together (All tests)."
        yield "warn", "Additional parameters do not differ from zero.", names(weak, 8), advice


def _uncontrolled(analysis: Analysis) -> Iterator[Problem]:
    if analysis.adjustment.law is not None:  # redundancy numbers do not describe these residuals
        return
    r = analysis.adjustment.redundancy_numbers
    lost = np.flatnonzero(np.isnan(analysis.w))
    if len(lost):
        advice = "Nothing controls them: an error goes into the unknowns in full. Add images, or measure the points again in others."
        evidence = names([label_of(analysis, int(i)) for i in lost[:6]], 6) + (" ..." if len(lost) > 6 else "")
        yield "warn", say("{count} uncontrolled.", count=plural(len(lost), "observation is", "observations are")), evidence, advice
    image = image_rows(analysis)
    hardly = np.flatnonzero((r < _WEAK) & np.isfinite(analysis.w) & image)
    if len(hardly):
        hardly = hardly[np.argsort(r[hardly], kind="stable")]
        advice = "Large errors can hide in them (see MDB). Add rays to these points."
        evidence = say(
            "redundancy number below {limit}: {names}", limit=_WEAK, names=names([label_of(analysis, int(i)) for i in hardly[:60]], 4)
        )
        problem = say("{count} hardly controlled.", count=plural(len(hardly), "image coordinate is", "image coordinates are"))
        yield "warn", problem, evidence, advice


def _weak_datum(analysis: Analysis) -> Iterator[Problem]:
    found = analysis.adjustment.datum_precision
    if found is None:
        return
    if found.turns:
        yield (
            "warn",
            "The orientation of the whole network is weak.",
            say(
                "rotation about the axis ({axis}): standard deviation {size}° a priori, the network taken as rigid",
                axis=", ".join(fixed(float(x), 2) for x in found.axis),
                size=significant(float(np.degrees(found.rotation)), 2),
            ),
            "What is known of places (control points, positions of cameras) is rough, or lies almost on a line along this axis: measure "
            "points beside it, or leave the positions out and adjust a free network.",
        )
    if found.stretches:
        yield (
            "warn",
            "The scale of the whole network is weak.",
            say("standard deviation {size} % a priori, the network taken as rigid", size=significant(100.0 * found.scale, 2)),
            "What is known of places is rough, or lies close together: measure points farther apart, or a distance.",
        )


def _almost_infinite(analysis: Analysis) -> Iterator[Problem]:
    a = analysis.adjustment
    found = a.far
    if not len(found.points):
        return
    shown = []
    for i, least in zip(found.points, found.least, strict=True):
        label = a.network.points.labels[i]
        if np.isfinite(least):
            label = say("{p} (beyond {d} {unit})", p=label, d=f"{float(f'{least:.2g}'):.12g}", unit=a.network.unit)
        shown.append(label)
    problem = say("{count} told from infinity.", count=plural(len(shown), "point cannot be", "points cannot be"))
    evidence = say("inverse distance within {times:g} of its standard deviations from zero: {names}", times=RESOLVED, names=names(shown, 6))
    advice = (
        "Their rays are almost parallel. Like stars they help to orient the images, but their coordinates and sigmas say nothing: leave "
        "them out of products."
    )
    check = [a.network.points.labels[i] for i in found.points if a.network.points.roles[i] == CHECK]
    if check:
        yield (
            "warn",
            "Check points are almost at infinity.",
            names(check, 6),
            "Their coordinates say nothing: tests and accuracy figures of check points leave them out.",
        )
    yield "warn", problem, evidence, advice


def _behind(analysis: Analysis) -> Iterator[Problem]:
    a = analysis.adjustment
    far = set(a.point_table(analysis.options.sigma)["point"][almost_infinite(analysis)].tolist())
    found = [(image, point) for image, point in a.behind if point not in far]
    if found:
        yield (
            "bad",
            say("{count} behind its camera.", count=plural(len(found), "ray has its point", "rays have their points")),
            names([say("point {p} in image {i}", p=p, i=i) for i, p in found], 6),
            "The start values were wrong or the point numbers are: check these images first.",
        )


def _weak_points(analysis: Analysis) -> Iterator[Problem]:
    table, sigmas = point_sigmas(analysis)
    whole = spatial(sigmas)
    free = (whole > 0.0) & ~almost_infinite(analysis)
    if free.sum() < 5:
        return
    median = float(np.median(whole[free]))
    weak = np.flatnonzero(free & (whole > _FAR * median))
    if len(weak):
        weak = weak[np.argsort(-whole[weak], kind="stable")]
        unit, factor = finer(analysis.adjustment.network.unit, whole[free])
        shown = [f"{table['point'][i]} ({significant(whole[i] * factor, 2)} {unit})" for i in weak]
        problem = say("{count} far weaker than the others.", count=plural(len(weak), "point is", "points are"))
        evidence = say(
            "more than {times:g} times the median spatial sigma of {median} {unit}: {names}",
            times=_FAR,
            median=significant(median * factor, 2),
            unit=unit,
            names=names(shown, 6),
        )
        yield "warn", problem, evidence, "Add rays with a good angle of intersection, or leave these points out of products."


def _few_rays(analysis: Analysis) -> Iterator[Problem]:
    table = analysis.adjustment.point_table("apriori")
    two = np.flatnonzero((table["rays"] == 2) & (table["role"] != "control"))
    if len(two):
        share = len(two) / len(table)
        problem = say("{count} seen from two images only.", count=plural(len(two), "point is", "points are"))
        evidence = say(
            "{share} % of the points: {names}", share=fixed(100.0 * share, 0), names=names([str(table["point"][i]) for i in two], 8)
        )
        advice = (
            "Two rays control only the parallax between them: an error along the epipolar line stays hidden. Three rays or more are better."
        )
        yield ("warn" if share > 0.2 else "info"), problem, evidence, advice


def _aside(analysis: Analysis) -> Iterator[Problem]:
    a = analysis.adjustment
    if a.aside.any():
        labels = [a.network.points.labels[i] for i in np.flatnonzero(a.aside)]
        problem = say("{count} set aside.", count=plural(len(labels), "point was", "points were"))
        yield "info", problem, names(labels, 10), "They have too few rays, or no observation at all; nothing is said about them."


def _unrelated(analysis: Analysis) -> Iterator[Problem]:
    a = analysis.adjustment
    check = np.flatnonzero((a.network.points.roles == CHECK) & ~a.aside)
    if len(check) and a.datum.defect.count:
        yield (
            "warn",
            "Check points judge nothing in a free network.",
            say("{count}; datum defect {d}", count=plural(len(check), "check point"), d=a.datum.defect.count),
            "What the observations leave free of position, rotation and scale is that of the start values, not that of the survey: add "
            "control points, or let some of the check points be control.",
        )


def _survey(analysis: Analysis) -> Iterator[Problem]:
    count = int(analysis.adjustment.judges.sum())
    check, control = result_of(analysis, "check_points"), result_of(analysis, "control_points")
    if control is not None and control.rejected:
        each = result_of(analysis, "control_point")
        bad = [] if each is None else [n for n, r in zip(each.labels, np.asarray(each.rejected), strict=True) if r]
        advice = "Check coordinates, point identification and datum of the worst point; or the survey is less precise than its sigmas say."
        yield "bad", "The control points contradict their sigmas.", say("rejected: {names}", names=names(bad, 8) or "none singly"), advice
    if check is not None and check.rejected:
        advice = "The predicted precision is too good: check these points first; else look for systematic errors that the control hides."
        yield "bad", "The check points deviate more than predicted.", say("{count}", count=plural(count, "check point")), advice
    if 0 < count < 30:
        evidence = say("{count}; the ASPRS standards (2nd edition) ask for 30", count=plural(count, "check point"))
        yield "info", "The check points are few.", evidence, "An accuracy statement from them must say so; see the interval of the RMSE."


def _law(analysis: Analysis) -> Iterator[Problem]:
    normal = next((f for f in analysis.laws if f.law == "normal"), None)
    kurtosis, simulated = result_of(analysis, "kurtosis_of_residuals"), result_of(analysis, "goodness_of_fit")
    rejected = simulated.rejected if simulated is not None else normal is not None and normal.rejected
    if not rejected:
        return
    k = None if kurtosis is None else float(kurtosis.details["kurtosis"])
    if simulated is not None:
        value, p = fixed(float(simulated.statistic), 2), probability(float(simulated.p_value))
        evidence = say("Anderson-Darling {value}, p = {p}", value=value, p=p)
    else:
        evidence = say("chi-square {chi}", chi=fixed(0.0 if normal is None else normal.statistic, 1))
    evidence += "" if k is None else say("; kurtosis {k} (normal law: 3)", k=fixed(k, 2))
    advice = (
        "Heavier tails than the normal law: gross errors, or observations of different precision mixed under one sigma. Remove errors, "
        "group the observations."
        if k is None or k > 3.0
        else "Lighter tails than the normal law: rounded or filtered measurements, or an automatic rejection before the adjustment."
    )
    yield "warn", "The residuals are not those of normal errors.", evidence, advice + " Levels of the tests are approximate."


_CHECKS: tuple[Callable[[Analysis], Iterator[Problem]], ...] = (
    _global, _gross, _snooped, _gathered, _unrelated, _survey, _behind, _almost_infinite, _weak_datum, _groups, _systematic, _images,
    _law, _correlated, _superfluous, _uncontrolled, _weak_points, _few_rays, _aside,
)  # fmt: skip


def problems(analysis: Analysis) -> list[Problem]:
    """Return what is wrong or doubtful, the gravest first: tone, problem, evidence, suggestion."""
    checks = _CHECKS if analysis.converged else (_convergence, _weak_datum, _aside)
    found = [p for check in checks for p in check(analysis)]
    return sorted(found, key=lambda p: ("bad", "warn", "info").index(p[0]))


_LABELS = {"bad": "problem", "warn": "attention", "info": "note"}


def _build(analysis: Analysis) -> list[Block]:
    blocks: list[Block] = []
    found = problems(analysis)
    if found:
        columns = (
            Column("weight", "", "problem: a test is rejected or values are wrong; attention: look at it; note: good to know", "left"),
            Column("what", "", "", "left"),
            Column("evidence", "", "", "left"),
            Column("suggestion", "", "", "left"),
        )
        rows = tuple((Cell(_LABELS[tone], tone), what, evidence, advice) for tone, what, evidence, advice in found)
        blocks.append(DataTable("Problems and suggestions, the gravest first", columns, rows))
    else:
        blocks.append(Paragraph("No problem was found.", "good"))
    if analysis.adjustment.assumptions:
        blocks.append(Items("Assumptions made, because the source does not say or values were missing:", analysis.adjustment.assumptions))
    return blocks


PROBLEMS = SectionMaker(20, "problems", "Problems and suggestions", _build)
