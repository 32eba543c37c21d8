"""Steps to the minimum: Gauss-Newton, damped and bent where the problem is curved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.datum import Datum
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.linearize import Arrangement, linearize, whitened_misclosures
from baarda.adjustment.result import Iteration
from baarda.adjustment.solver import Solver
from baarda.network import Network, State
from baarda.observations import ImagePoints, Kind

if TYPE_CHECKING:
    from baarda.adjustment.solve import Settings

Floats = NDArray[np.float64]

REUSE = 1e-4  # relative step below which the factor of the last iteration serves the next ones
NEAR = 1e-3  # relative step below which a full step is not tried before it is taken
BEND = 1e-7  # relative step above which steps are bent


def iterate(
    network: Network,
    state: State,
    lin: Linearization,
    groups: Arrangement,
    datum: Datum,
    factor: Callable[..., Solver],
    settings: Settings,
) -> tuple[State, Linearization, list[Iteration], bool]:
    """Gauss-Newton with Levenberg's damping where a full step does not help.

    The damping follows Nielsen's rule (1999). Steps that shrink at a constant rate, as large residuals make them, are extrapolated
    (Aitken); others are bent by the second derivative along them, solved with the same factor (geodesic acceleration: Transtrum &
    Sethna 2012), so that narrow curved valleys of weak self-calibrations are followed, not crept along.
    """
    objective = float(lin.misclosure @ lin.misclosure)
    floor = lin.count * 1e-8  # residuals of 1e-4 sigma count as none
    history = [Iteration(0, objective, None, 0.0, True)]
    damping, growth, last, curved = 0.0, 2.0, np.inf, False
    stalled, trusted = 0, False
    before: Floats | None = None  # the last full step, as a change of the observations

    def moved(step: Floats) -> State:
        return state.moved(unknowns, step, centres_of_rays(groups.groups, state))

    def misclosures(step: Floats) -> tuple[State, Floats, float]:
        trial = moved(step)
        values = whitened_misclosures(network, trial, groups, workers)
        with np.errstate(over="ignore"):
            return trial, values, float(values @ values) if np.isfinite(values).all() else np.inf

    tied, unknowns, workers = datum, lin.unknowns, lin.workers
    untied = replace(datum, held=np.zeros(0, dtype=np.intp), conditions=None)  # damping ties the datum down by itself
    solver: Solver | None = None
    for count in range(1, settings.iterations + 1):
        datum = untied if damping > 0.0 else tied
        if solver is not None and damping == 0.0 and last <= REUSE:
            solver = solver.at(lin)  # the system hardly differs from the one that was factored
        else:
            solver = factor(lin, datum, damping)
        step, change = _step(lin, solver, datum, lin.misclosure)
        predicted = 2.0 * float(change @ lin.misclosure) - float(change @ change)
        relative = float(np.linalg.norm(change) / np.sqrt(max(objective, floor)))
        lengthened, plain = 1.0, before is not None
        if damping == 0.0 and before is not None and relative < 0.01:
            lengthened = _extrapolated(change, before)
            step, plain = lengthened * step, lengthened == 1.0
            predicted = 2.0 * lengthened * float(change @ lin.misclosure) - lengthened**2 * float(change @ change)
        if lengthened == 1.0 and relative > max(BEND, 0.1 * last if np.isfinite(last) else 0.0):  # steps that shrink fast need no bending
            step, plain = _bent(lin, solver, datum, step, change, lambda x: misclosures(x)[1]), False
        near = damping == 0.0 and (relative <= NEAR or trusted)
        if near:  # as good as sure to be taken: linearised at once
            trial, solver = moved(step), solver.at(None)
            del lin  # its memory is needed
            lin = linearize(network, trial, unknowns, groups, workers)
            with np.errstate(over="ignore"):
                value = float(lin.misclosure @ lin.misclosure)
        else:
            trial, _, value = misclosures(step)
        gain = (objective - value) / predicted if predicted > 0.0 else 0.0
        at_rounding = relative < 1e-6 and abs(value - objective) <= 1e-9 * max(objective, floor)
        accepted = bool(gain > 1e-4 or at_rounding)
        trusted = damping == 0.0 and gain > 0.5
        history.append(Iteration(count, value if accepted else objective, relative, damping, accepted))
        if settings.progress is not None:
            settings.progress(history[-1])
        if not accepted:
            before = solver = None
            if near:
                lin = linearize(network, state, unknowns, groups, workers)
            curved |= relative < 1e-3  # large residuals bend the problem so much that full steps fail even beside the solution
            damping, growth, last = max(damping * growth, 1e-4 if relative > 0.1 else 1e-7), 2.0 * growth, np.inf
            continue
        state, objective = trial, value
        before = change if damping == 0.0 and lengthened == 1.0 else None
        solver = solver.at(None) if solver is not None and damping == 0.0 and relative <= REUSE else None
        if not near:
            del lin
            lin = linearize(network, state, unknowns, groups, workers)
        stalled = stalled + 1 if relative <= 1e-7 and relative >= 0.8 * last else 0
        rate = 10.0 * relative / last if plain else 1.0
        left = relative * min(rate, 1.0)  # the next step by the rate of the last two, if they were plain ones, with caution
        settled = left <= settings.tolerance or stalled == 2 or (relative < 1e-9 and relative >= 0.5 * last)  # only rounding is left
        if settled and (damping == 0.0 or _full_step(lin, tied, factor) <= 1e-6):
            return state, lin, history, True
        damping *= max(0.5 if curved else 0.2, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        if damping < 1e-9 or (relative < 1e-4 and not curved):
            damping = 0.0
        growth, last = 2.0, relative
    return state, lin, history, False


def _step(lin: Linearization, solver: Solver, datum: Datum, y: Floats) -> tuple[Floats, Floats]:
    """Return the step x that fits A x to y best, in the datum asked for, and A x."""
    step, change = solver.least_squares(y)
    if datum.transfer is None:
        return step, change
    step = datum.transform(step)
    return step, lin.times(step)  # the free transformations are those of the start values: they change the observations a little


def _extrapolated(change: Floats, before: Floats) -> float:
    """Return by how much to lengthen a step that repeats the last one at a constant rate (Aitken's extrapolation), else 1."""
    product, square = float(change @ before), float(before @ before)
    rate = product / square
    alike = product**2 > 0.8 * square * float(change @ change)
    return 1.0 / (1.0 - rate) if alike and 0.1 < abs(rate) < 0.97 else 1.0


def centres_of_rays(groups: Sequence[Kind], state: State) -> Floats:
    """Return for each point the mean place of the images that see it, NaN where none does."""
    total, count = np.zeros((len(state.points), 3)), np.zeros(len(state.points))
    for group in groups:
        if isinstance(group, ImagePoints):
            count += np.bincount(group.points, minlength=len(count))
            for k in range(3):
                total[:, k] += np.bincount(group.points, state.position[group.images, k], len(count))
    with np.errstate(invalid="ignore"):
        return np.asarray(total / count[:, None])


def _full_step(lin: Linearization, datum: Datum, factor: Callable[..., Solver]) -> float:
    """Return the relative step that would be taken without damping."""
    _, change = factor(lin, datum).least_squares(lin.misclosure)
    return float(np.linalg.norm(change) / max(np.linalg.norm(lin.misclosure), 1e-4 * np.sqrt(lin.count)))


def _bent(
    lin: Linearization, solver: Solver, datum: Datum, step: Floats, change: Floats, misclosures: Callable[[Floats], Floats]
) -> Floats:
    """Add the second-order correction to a step, where it is smaller than the step."""
    h = 0.1
    curvature = 2.0 / h * ((lin.misclosure - misclosures(h * step)) / h - change)
    if not np.isfinite(curvature).all():
        return step
    bend = -0.5 * _step(lin, solver, datum, curvature)[0]
    size = np.linalg.norm(lin.scale * bend) / np.linalg.norm(lin.scale * step)
    return step + bend if size <= 0.375 else step
