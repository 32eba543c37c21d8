"""The figures of a planned network and the sentences that tell them, with what replicas prove."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.network import AXES
from baarda.observations import Direct, ImagePoints, component_unit
from baarda.procedures.planning import Planned
from baarda.procedures.proof import Proof
from baarda.report.sections._numbers import column, finer, fixed, names, plural, significant
from baarda.report.sections.base import Sentence, say, told
from baarda.report.translation import tr

_WEAK = 0.1


def prediction(planned: Planned) -> dict[str, Any]:
    """Return the figures of precision and reliability of a prediction.

    Parameters
    ----------
    planned : Planned

    Returns
    -------
    dict
        Point sigmas (object units), image sigmas, redundancy numbers, minimal detectable biases of image points (pixels and multiples of
        their sigma), external reliability, correlations.
    """
    a = planned.adjustment
    points = a.point_table("apriori")
    sigmas = np.stack([points[f"s{axis}"] for axis in AXES], axis=1)
    free = np.asarray((sigmas > 0.0).any(axis=1))
    spatial = np.sqrt((sigmas**2).sum(axis=1))
    images = a.image_table("apriori")
    share, r = a.controlled_share, a.redundancy_numbers
    table = planned.observations
    image_rows = np.concatenate([np.full(len(g) * len(g.components), isinstance(g, ImagePoints)) for g in a.groups])
    seen = image_rows & planned.controlled
    bias = table["mdb"]
    out: dict[str, Any] = {
        "points": {
            "count": int(free.sum()),
            "median": {axis: median(sigmas[sigmas[:, k] > 0.0, k]) for k, axis in enumerate(AXES)},
            "largest": {axis: largest(sigmas[sigmas[:, k] > 0.0, k]) for k, axis in enumerate(AXES)},
            "weakest": [str(points["point"][i]) for i in np.argsort(-spatial, kind="stable")[:5] if free[i]],
        },
        "images": {f"median_s{name}": median(images[f"s{name}"]) for name in ("X0", "Y0", "Z0", "omega_rad", "phi_rad", "kappa_rad")},
        "redundancy": {
            "mean": float(r.mean()),
            "median": median(r),
            "least": float(share.min()),
            "weak": int(((share < _WEAK) & planned.controlled).sum()),
            "uncontrolled": int((~planned.controlled).sum()),
        },
        "mdb_image_points": {
            "median_px": median(bias[seen]),
            "largest_px": largest(bias[seen]),
            "median_in_sigma": median((bias / a.sigmas)[seen]),
        },
        "mdb_other": {
            unit: {"count": len(at), "median": median(bias[at]), "largest": largest(bias[at])}
            for unit, at in _other_rows(planned, image_rows).items()
        },
        "external_reliability": {"median": median(table["external"][planned.controlled]), "largest": largest(table["external"])},
        "correlations": [{"a": x, "b": y, "value": v} for x, y, v in a.camera_correlations()],
    }
    return out


def _other_rows(planned: Planned, image_rows: NDArray[np.bool_]) -> dict[str, list[int]]:
    """Return the controlled observations that are no image points, by their unit; directly observed unknowns are left out."""
    out: dict[str, list[int]] = {}
    a = planned.adjustment
    for g, group in enumerate(a.groups):
        if isinstance(group, Direct):
            continue
        for row in range(int(a.offsets[g]), int(a.offsets[g + 1])):
            if planned.controlled[row] and not image_rows[row]:
                unit = component_unit(group, (row - int(a.offsets[g])) % len(group.components))
                out.setdefault(unit, []).append(row)
    return out


def median(x: Any) -> float | None:
    """Return the median of the finite values, None where there are none."""
    x = np.asarray(x, dtype=float)
    x = x[np.isfinite(x)]
    return float(np.median(x)) if len(x) else None


def largest(x: Any) -> float | None:
    """Return the largest finite value, None where there is none."""
    x = np.asarray(x, dtype=float)
    x = x[np.isfinite(x)]
    return float(x.max()) if len(x) else None


def sentences(planned: Planned, proof: Proof | None) -> list[Sentence]:
    """Return the verdict."""
    a, figures, o = planned.adjustment, prediction(planned), planned.options
    out = [
        Sentence(
            "Network",
            say(
                "{n} observations, {u} unknowns, redundancy {r}; true geometry: {reason}. {datum}",
                n=a.count,
                u=a.numbering.count,
                r=a.redundancy,
                reason=_reason(planned),
                datum=told(a.datum.text),
            ),
            "info",
        )
    ]
    p = figures["points"]
    if p["count"]:
        unit, factor = finer(a.network.unit, [v for v in p["median"].values() if v is not None])
        wanted = [v for d in (p["median"], p["largest"]) for v in d.values()]
        known = iter(column([v * factor for v in wanted if v is not None], 2))
        shown = [tr("fixed") if v is None else next(known) for v in wanted]
        out.append(
            Sentence(
                "Precision",
                say(
                    "Predicted standard deviations of {count} points, median X {x}, Y {y}, Z {z} {unit}; largest {lx}, {ly}, {lz} {unit}; "
                    "weakest: {weak}.",
                    count=p["count"],
                    x=shown[0],
                    y=shown[1],
                    z=shown[2],
                    lx=shown[3],
                    ly=shown[4],
                    lz=shown[5],
                    unit=unit,
                    weak=names(p["weakest"]),
                ),
                "info",
                "points",
            )
        )
    r, m = figures["redundancy"], figures["mdb_image_points"]
    if m["median_px"] is not None:
        text = say(
            "Redundancy numbers average {mean}; a bias of {px} px ({times} sigma; median) in an image coordinate is found with power "
            "{power} at level {level}, the largest such bias is {most} px.",
            mean=fixed(r["mean"], 3),
            px=significant(m["median_px"]),
            times=significant(m["median_in_sigma"]),
            power=f"{o.power:g}",
            level=f"{o.alpha_outlier:g}",
            most=significant(m["largest_px"]),
        )
        out.append(Sentence("Reliability", text, "warn" if r["uncontrolled"] else "info", "reliability"))
    elif figures["mdb_other"]:
        text = say(
            "Redundancy numbers average {mean}; found with power {power} at level {level} are biases from {biases} on.",
            mean=fixed(r["mean"], 3),
            power=f"{o.power:g}",
            level=f"{o.alpha_outlier:g}",
            biases=names(
                [
                    say(
                        "{median} {unit} (median; largest {most} {unit})",
                        median=significant(v["median"]),
                        most=significant(v["largest"]),
                        unit=u,
                    )
                    for u, v in figures["mdb_other"].items()
                ],
                4,
            ),
        )
        out.append(Sentence("Reliability", text, "warn" if r["uncontrolled"] else "info", "reliability"))
    if r["uncontrolled"]:
        rows = plural(r["uncontrolled"], "observation is", "observations are")
        text = say("{rows} not controlled by any other: errors in them stay hidden.", rows=rows)
        out.append(Sentence("Uncontrolled", text, "warn", "reliability"))
    high = figures["correlations"]
    if high:
        c = high[0]
        text = say(
            "{n} with |correlation| of at least 0.95, first {a} with {b} ({v}).", n=plural(len(high), "pair"), **c, v=fixed(c["value"], 4)
        )
        out.append(Sentence("Correlations", text, "warn", "cameras"))
    return out + (_proof_sentences(proof) if proof is not None else [])


def _reason(planned: Planned) -> str:
    """Return why this geometry is taken for true, in the current language."""
    head, _, value = planned.reason.rpartition(" ")
    template = "the adjusted geometry, standard deviation of unit weight {value}"
    return say(template, value=value) if template.startswith(f"{head} {{") else tr(planned.reason)


def _proof_sentences(p: Proof) -> list[Sentence]:
    out = []
    asked, count = p.replicas.asked, p.replicas.count
    if count < asked:
        text = say("{lost} of {asked} replicas have no result: {first}", lost=asked - count, asked=asked, first=p.replicas.batch.failed[0])
        out.append(Sentence("Replicas", text, "warn", "proof"))
    s = p.sigmas
    wrong = [x.name for x in s if not x.holds]
    low, high = min(s, key=lambda x: x.ratio), max(s, key=lambda x: x.ratio)
    text = say(
        "{count} replicas: sampled / predicted standard deviations lie between {low} ({a}) and {high} ({b}); {decision}.",
        count=count,
        low=fixed(low.ratio, 3),
        a=tr(low.name),
        high=fixed(high.ratio, 3),
        b=tr(high.name),
        decision=say("beyond chance for {names}", names=names([tr(w) for w in wrong])) if wrong else tr("chance explains the differences"),
    )
    out.append(Sentence("Sigmas", text, "bad" if wrong else "good", "proof"))
    if any(getattr(g, "residual_plane", "image") == "corrected" for g in p.replicas.planned.adjustment.groups):
        text = (
            "The errors drawn are those of measured image coordinates; this network takes its residuals in the corrected plane, where the "
            "distortion stretches them. --residual-plane image avoids it."
        )
        out.append(Sentence("Residual plane", tr(text), "warn", "proof"))
    sure = 1e-4
    if p.worst[2] < sure:
        text = say("The errors of {name} scatter {ratio} times as predicted: beyond chance.", name=p.worst[0], ratio=fixed(p.worst[1], 3))
        out.append(Sentence("Single sigmas", text, "bad", "proof"))
    if p.bias[2] < sure:
        text = say(
            "The mean error of {name} is {mean} of its standard deviation: beyond chance, the network is noticeably not linear.",
            name=p.bias[0],
            mean=fixed(p.bias[1], 3),
        )
        out.append(Sentence("Mean errors", text, "warn", "proof"))
    text = say(
        "v'Pv averages {mean}, expected is r = {r} (95 % of such means lie within {half} of it).",
        mean=fixed(p.objective.rate, 1),
        r=fixed(p.objective.expected, 0),
        half=fixed(1.96 * float(np.sqrt(2.0 * p.objective.expected / count)), 1),
    )
    out.append(Sentence("Global test", text, "good" if p.objective.holds else "bad", "proof"))
    known = [x for x in p.sizes if x.told]
    wrong = [
        say("{test} ({rate} % instead of {level} %)", test=x.name, rate=f"{100 * x.rate:.3g}", level=f"{100 * x.expected:.3g}")
        for x in known
        if not x.holds
    ]
    words = say("not so: {names}", names=names(wrong)) if wrong else tr("none deviates beyond chance")
    text = say(
        "{count} of {all} tests of true hypotheses reject as often as their level says; {words}.",
        count=len(known) - len(wrong),
        all=len(known),
        words=words,
    )
    if known:
        out.append(Sentence("Sizes of tests", text, "bad" if wrong else "good", "proof"))
    few = [x.name for x in p.sizes if not x.told]
    if few:
        text = say("Too few replicas to tell the size of {names}.", names=names(few, 4))
        out.append(Sentence("Replicas", text, "info", "proof"))
    if p.power is not None:
        text = say(
            "Biases of the minimal detectable size are found by w in {rate} % of the replicas ({low} to {high} %), promised are {power} %; "
            "in {right} % the observation at fault has the largest |w|.",
            rate=fixed(100 * p.power.rate, 1),
            low=fixed(100 * p.power.low, 1),
            high=fixed(100 * p.power.high, 1),
            power=fixed(100 * p.power.expected, 1),
            right=fixed(100 * p.identified, 1),
        )
        out.append(Sentence("Power", text, "good" if p.power.holds else "bad", "proof"))
    return out
