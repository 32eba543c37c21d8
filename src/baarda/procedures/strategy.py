"""Procedures around an adjustment, in the order of an analysis: gross errors out, parameters selected, points withheld."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from baarda.adjustment import Adjustment, adjust
from baarda.errors import UsageError
from baarda.hypotheses import run
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.levels import Options
from baarda.network import Network
from baarda.procedures.camera_selection import apply_settings, select_parameters, selection_options
from baarda.procedures.criteria import SECOND_SPOKEN, Second
from baarda.procedures.selection import Selection
from baarda.procedures.snooping import Snooping, Unit, snoop

if TYPE_CHECKING:
    from baarda.procedures.cross_validation import CrossValidation

Told = Callable[[str], None]
NAMES = ("gruen",)


@dataclass(frozen=True)
class Plan:
    """What to do around the adjustment.

    Attributes
    ----------
    snoop : {"coordinate", "point", "image"} or None
        Unit of data snooping.
    law : str or None
        Law of errors under which the critical values of snooping are found.
    select : bool
        Drop insignificant additional parameters.
    second : {"variance", "s", "j", "trace"}
        Reading of criterion 9b.
    folds : int or None
        Cross-validation of the control points.
    strategy : {"gruen"} or None
        Grün's order, with a table of stages; implies snooping and selection.
    """

    snoop: Unit | None = None
    law: str | None = None
    select: bool = False
    second: Second = "variance"
    folds: int | None = None
    strategy: str | None = None

    def __post_init__(self) -> None:
        if self.snoop not in (None, "coordinate", "point", "image"):
            raise UsageError(f"--snoop-unit is coordinate, point or image, not {self.snoop!r}")
        if self.second not in SECOND_SPOKEN:
            raise UsageError(f"--criterion is one of {', '.join(SECOND_SPOKEN)}, not {self.second!r}")
        if self.strategy not in (None, *NAMES):
            raise UsageError(f"--strategy is {' or '.join(NAMES)}, not {self.strategy!r}")
        if self.folds is not None and self.folds < 2:
            raise UsageError(f"--cross-validate needs at least 2 folds, not {self.folds}")

    @property
    def empty(self) -> bool:
        """Whether nothing is to be done but to adjust."""
        return self.snoop is None and not self.select and self.folds is None and self.strategy is None


@dataclass(frozen=True)
class Stage:
    """A stage of Grün's order: what was tested, how it came out, and what was decided."""

    name: str
    finding: str
    decision: str
    rejected: bool | None = None


@dataclass(frozen=True)
class Strategy:
    """What the procedures around an adjustment found.

    Attributes
    ----------
    plan : Plan
    snooping : Snooping or None
    selection : Selection or None
    cross_validation : CrossValidation or None
    stages : tuple of Stage
        With a strategy only.
    """

    plan: Plan
    snooping: Snooping | None = None
    selection: Selection | None = None
    cross_validation: CrossValidation | None = None
    stages: tuple[Stage, ...] = ()


def carry_out(
    network: Network, plan: Plan, options: Options | None = None, tell: Told | None = None, **settings: Any
) -> tuple[Adjustment, Strategy]:
    """Adjust a network with the procedures of a plan.

    Parameters
    ----------
    network : Network
    plan : Plan
    options : Options, optional
    tell : callable, optional
        Is told of each decision.
    **settings
        Fields of `Settings`. With snooping, `robust` only starts the search: the adjustment is by least squares.

    Returns
    -------
    adjustment : Adjustment
        After all decisions.
    strategy : Strategy

    Raises
    ------
    UsageError
        If an adjustment does not converge, or options exclude each other.
    """
    o = Options() if options is None else options
    unit: Unit | None = plan.snoop
    if plan.strategy is not None and unit is None:
        unit = "coordinate"
    select = plan.select or plan.strategy is not None
    told = "the procedures around the adjustment judge by least squares"
    if settings.get("robust") is not None and unit is None:
        raise UsageError(f"{told}: --robust goes with --snoop only, whose search it starts")
    prepared, rest = apply_settings(network, settings)
    before = adjust(prepared, **{k: v for k, v in rest.items() if k not in ("robust", "robust_shapes")}) if plan.strategy else None
    a: Adjustment | None = None
    snooping, selection, validation = None, None, None
    if unit is not None:
        snooping, a = snoop(prepared, o, unit, tell, law=plan.law, **rest)
        prepared = _again(a, prepared)
    rest = {k: v for k, v in rest.items() if k not in ("robust", "robust_shapes")}
    snooped = a
    if select:
        first = a
        selection, a = select_parameters(prepared, selection_options(o, second=plan.second), tell, **rest)
        if first is not None:
            a = replace(a, start=replace(first.start, cameras=a.start.cameras), assumptions=_joined(first, a))
        prepared = _again(a, prepared)
    if plan.folds is not None:
        from baarda.procedures.cross_validation import cross_validate

        validation = cross_validate(prepared, plan.folds, o, tell, **rest)
    if a is None:
        a = adjust(prepared, **rest)
    found = Strategy(plan, snooping, selection, validation)
    if plan.strategy is not None and before is not None:
        found = replace(found, stages=gruen_stages(before, snooped, found, a, o))
    return a, found


def _again(a: Adjustment, before: Network) -> Network:
    """Return the adjusted network, ready to be adjusted again: values as start values, the source's assumptions."""
    return replace(a.network, assumptions=before.assumptions)


def _joined(first: Adjustment, last: Adjustment) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*first.assumptions, *last.assumptions)))


# ---- Grün's order ---------------------------------------------------------------------------------------------------------------------


def gruen_stages(before: Adjustment, snooped: Adjustment | None, found: Strategy, after: Adjustment, options: Options) -> tuple[Stage, ...]:
    """Return the stages of Grün's order with their decisions.

    Parameters
    ----------
    before, snooped, after : Adjustment
        Of all observations; after snooping; after the selection of parameters.
    found : Strategy
    options : Options

    Returns
    -------
    tuple of Stage
        Blunders out, global test, all additional parameters, single ones and pairs and orthogonalised ones, deletion, control, check.

    Notes
    -----
    A. Grün, Photogrammetria 34 (1978) 381-400; the single decisions are those of `snoop` and `select_parameters`.
    """
    start, middle, end = (run(a.evidence, options) for a in (before, snooped if snooped is not None else before, after))
    stages = [_single_test("global test of the full data", start, "global_variance_factor", "go on: look for gross errors first")]
    s = found.snooping
    if s is not None:
        out = f"{len(s.images)} image(s)" if s.unit == "image" else f"{s.count} observation(s)"
        kept = sum(step.action == "kept" for step in s.steps)
        stages.append(Stage("blunders", f"{len(s.steps)} decision(s); {s.stopped}", f"removed: {out}; kept although suspected: {kept}"))
    stages += [
        _single_test("global test", middle, "global_variance_factor", "judge parameters by the estimated variance factor"),
        _single_test("all additional parameters", middle, "all_additional_parameters", "test them one by one"),
        _family("single additional parameters", middle, "additional_parameter", "candidates for deletion: the others"),
        _family("correlated pairs", middle, "bivariate_additional_parameters", "of a rejected pair one stays"),
        _family("orthogonalised parameters", middle, "orthogonalised_additional_parameters", "told; not deleted by themselves"),
    ]
    chosen = found.selection
    if chosen is not None:
        stages.append(Stage("deletion", chosen.stopped, f"deleted: {', '.join(chosen.deleted) or 'none'}"))
    stages += [
        _single_test("global test of the final model", end, "global_variance_factor", "see the verdict"),
        _single_test("control points", end, "control_points", "doubt control points before the block"),
        _single_test("check points", end, "check_points", "trust the predicted precision only if it is not rejected"),
    ]
    return tuple(stages)


def _single_test(name: str, tests: list[TestResult], test: str, decision: str) -> Stage:
    found = [t for t in tests if t.name == test]
    if not found:
        return Stage(name, "not applicable: there is nothing to test", "none")
    t = found[0]
    return Stage(name, f"{t.law_name}: {_number(t)}, p = {float(t.p_value):.3g}", decision, bool(t.rejected))


def _number(t: TestResult) -> str:
    limit = t.critical
    spoken = f"{limit[0]:.4g}..{limit[1]:.4g}" if isinstance(limit, tuple) else f"{limit:.4g}"
    return f"T = {float(t.statistic):.4g}, limit {spoken}"


def _family(name: str, tests: list[TestResult], test: str, decision: str) -> Stage:
    found = [t for t in tests if t.name == test]
    if not found:
        return Stage(name, "not applicable: there is nothing to test", "none")
    t = found[0]
    rejected = np.atleast_1d(np.asarray(t.rejected))
    words = [label for label, r in zip(t.labels, rejected, strict=True) if r]
    told = ", ".join(words[:8]) + (f" and {len(words) - 8} more" if len(words) > 8 else "")
    return Stage(name, f"{t.law_name}: {len(words)} of {len(rejected)} rejected{': ' + told if words else ''}", decision, bool(words))
