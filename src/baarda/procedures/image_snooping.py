"""Snooping of whole images: the image whose variance is too large out, adjust again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment import Adjustment, adjust
from baarda.errors import BaardaError, UsageError
from baarda.hypotheses import homogeneity
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.levels import Options
from baarda.network import Network
from baarda.procedures.removal import without_images
from baarda.procedures.snooping_steps import Snooping, SnoopStep

LEAST = 0.5  # share of the images that stays


def worst_image(a: Adjustment, options: Options) -> tuple[TestResult | None, int, int]:
    """Return the test of the images' variances, the worst image that it rejects as too imprecise (-1: none), and how many there are."""
    tests = homogeneity.from_evidence(a.evidence, options)
    each = next((t for t in tests if t.name == "variance_per_image"), None)
    if each is None:
        return None, -1, 0
    s2 = np.asarray(each.details["variances"])
    large = np.asarray(each.rejected) & (s2 > float(each.details["reference"]))
    if not large.any():
        return each, -1, 0
    return each, int(np.argmax(np.where(large, s2, -1.0))), int(large.sum())


def snoop_images(
    base: Network, options: Options, tell: Callable[[str], None] | None = None, **settings: Any
) -> tuple[Snooping, Adjustment]:
    """Remove images whose variance exceeds the pooled one, the worst first, and adjust again each time.

    Parameters
    ----------
    base : Network
        Prepared.
    options : Options
        Level and policy of the test of the variance of each image.
    tell : callable, optional
    **settings
        Fields of `Settings`.

    Returns
    -------
    snooping : Snooping
        Its steps also tell F = ((Omega - Omega_1) / (r - r_1)) / (Omega_1 / r_1) of all observations of the image together.
    adjustment : Adjustment
        Without the rejected images; object points that lose too many rays are set aside.
    """
    keep = np.ones(len(base.images.labels), dtype=bool)
    a = adjust(base, **settings)
    if a.status != "converged":
        raise UsageError(f"the adjustment did not converge: images cannot be judged; {a.contradictions()}")
    first = a
    steps: list[SnoopStep] = []
    removed: list[str] = []
    stopped, law = "", ""
    while not stopped:
        test, i, count = worst_image(a, options)
        if test is None:
            stopped = "The images cannot be compared: too few, or without redundancy."
            break
        law = test.law_name
        if i < 0:
            stopped = "No image is less precise than the others any more."
            break
        label = test.labels[i]
        trial = keep & (np.array(base.images.labels, dtype=object) != label)
        s2, r = float(test.details["variances"][i]), float(test.details["df"][i])
        found = _without(base, a, trial, settings) if trial.sum() >= max(2.0, LEAST * len(keep)) else "half of the images would be gone"
        values: dict[str, Any] = {
            "statistic": s2 / float(test.details["reference"]),
            "p_value": float(np.asarray(test.p_value)[i]),
            "level": float(test.alpha),
            "redundancy_number": r,
            "suspected": count,
        }
        if isinstance(found, str):
            steps.append(_step(len(steps) + 1, "kept", label, a, values, f"Suspected, but kept: {found}."))
            stopped = f"Image {label} could not be removed: {found}."
            break
        dropped = a.redundancy - found.redundancy
        note = ""
        if dropped > 0:
            f = (a.objective - found.objective) / dropped / found.variance_factor
            p = float(stats.f.sf(f, dropped, found.redundancy))
            note = f"All its observations together: F({dropped}, {found.redundancy}) = {f:.4g}, p = {p:.2g}."
        lost = [n for n, gone in zip(base.points.labels, found.aside & ~a.aside, strict=True) if gone]
        if lost:
            note = f"{note} Points set aside with it: {', '.join(lost[:10])}.".strip()
        keep, a = trial, found
        removed.append(label)
        steps.append(_step(len(steps) + 1, "rejected", label, a, values, note))
        if tell is not None:
            tell(f"rejected image {label}  s^2 / pooled = {values['statistic']:.3g}  s0 = {a.sigma0:.5g}")
    alpha = options.global_level(1)
    outcome = Snooping("image", tuple(steps), None, tuple(removed), alpha, options.levels, law, "least squares", stopped)
    start = without_images(first.start, keep)
    chosen = replace(a, start=replace(a.start, cameras=start.cameras, images=start.images, points=start.points))
    if removed:
        chosen = chosen.with_assumptions(f"Images rejected by snooping: {', '.join(removed)}.")
    return outcome, chosen


def _without(base: Network, a: Adjustment, keep: NDArray[np.bool_], settings: dict[str, Any]) -> Adjustment | str:
    """Adjust without images, from the values found so far; return in words why it cannot be done."""
    net = a.network
    place = {label: i for i, label in enumerate(net.images.labels)}
    at = np.array([place.get(label, 0) for label in base.images.labels])  # removed images: any value
    source = replace(
        base,
        cameras=tuple(c.with_values(v.values) for c, v in zip(base.cameras, net.cameras, strict=True)),
        images=replace(base.images, position=net.images.position[at], rotation=net.images.rotation[at]),
        points=replace(base.points, coordinates=net.points.coordinates),
        declared=net.declared,
    )
    try:
        found = adjust(without_images(source, keep), **settings)
    except BaardaError as error:
        return f"without it the network would not be determined ({error})"
    if found.datum.defect.count != a.datum.defect.count:
        return "without it the datum would not be defined"
    return found if found.status == "converged" else "the adjustment without it does not converge"


def _step(number: int, action: str, label: str, a: Adjustment, values: dict[str, Any], note: str) -> SnoopStep:
    return SnoopStep(
        step=number,
        action=action,
        group="image",
        image=label,
        point="",
        component="",
        statistic_name="s^2 / pooled",
        studentised=None,
        estimated_error=None,
        unit="",
        partner="",
        correlation=None,
        wrong_choice=None,
        separable_bias=None,
        sigma0=a.sigma0,
        redundancy=a.redundancy,
        note=note,
        **values,
    )
