"""Steps to the minimum: Gauss-Newton, damped and bent where the problem is curved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.datum import Datum
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.linearize import Arrangement, linearize, whitened_misclosures
from baarda.adjustment.result import Iteration
from baarda.adjustment.solver import Solver
from baarda.errors import Singular
from baarda.network import Network, State, Viewpoints
from baarda.observations import viewpoints_of

if TYPE_CHECKING:
    from baarda.adjustment.solve import Settings

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

REUSE = 1e-4  # relative step below which the factor of the last iteration serves the next ones
SCALED = 0.1  # relative full step from which the columns are scaled anew
NEAR = 1e-3  # relative step below which a full step is not tried before it is taken
PATIENCE = 10  # iterations after which a free network looks for points that have become far
BEND = 1e-7  # relative step above which steps are bent


class Control:
    """What decides about steps: how they are damped, which are taken, and when to stop.

    The damping follows Nielsen's rule (1999).

    Parameters
    ----------
    objective : float
        v'Pv at the start.
    count : int
        Number of observations.
    settings : Settings
    progress : callable, optional
        Is told every iteration.

    Attributes
    ----------
    damping : float
        Of the next step; 0 = a full Gauss-Newton step.
    history : list of Iteration
    """

    def __init__(self, objective: float, count: int, settings: Settings, progress: Callable[[Iteration], None] | None = None) -> None:
        self.objective, self.tolerance, self.progress = objective, settings.tolerance, progress
        self.floor = count * 1e-8  # residuals of 1e-4 sigma count as none
        self.history = [Iteration(0, objective, None, 0.0, True)]
        self.damping = 0.0
        self._growth, self._last, self._curved = 2.0, np.inf, False
        self._stalled, self._trusted, self._gain = 0, False, 0.0

    @property
    def reuses(self) -> bool:
        """Whether the factor of the last iteration serves the next one."""
        return self.damping == 0.0 and self._last <= REUSE

    def relative(self, squares: float) -> float:
        """Return the size of a step whose changes of the observations have this sum of squares, relative to the residuals."""
        return float(np.sqrt(squares / max(self.objective, self.floor)))

    def bends(self, relative: float) -> bool:
        """Return whether a step is to be bent: not one that is tiny or shrinks fast."""
        return relative > max(BEND, 0.1 * self._last if np.isfinite(self._last) else 0.0)

    def near(self, relative: float) -> bool:
        """Return whether a step is as good as sure to be taken."""
        return self.damping == 0.0 and (relative <= NEAR or self._trusted)

    def takes(self, value: float, predicted: float, relative: float) -> bool:
        """Judge a step by the v'Pv that it reaches and was predicted to save; write the history; damp more where it is refused."""
        gain = (self.objective - value) / predicted if predicted > 0.0 else 0.0
        at_rounding = relative < 1e-6 and abs(value - self.objective) <= 1e-9 * max(self.objective, self.floor)
        accepted = bool(gain > 1e-4 or at_rounding)
        self._trusted, self._gain = self.damping == 0.0 and gain > 0.5, gain
        self.history.append(Iteration(len(self.history), value if accepted else self.objective, relative, self.damping, accepted))
        if self.progress is not None:
            self.progress(self.history[-1])
        if accepted:
            self.objective = value
            return True
        self._curved |= relative < 1e-3  # large residuals bend the problem so much that full steps fail even beside the solution
        self.damping = max(self.damping * self._growth, 1e-4 if relative > 0.1 else 1e-7)
        self._growth, self._last = 2.0 * self._growth, np.inf
        return False

    def settled(self, relative: float, plain: bool) -> bool:
        """Return whether nothing is left after an accepted step; `plain`: neither it nor the last one was bent or lengthened."""
        self._stalled = self._stalled + 1 if relative <= 1e-7 and relative >= 0.8 * self._last else 0
        rate = 10.0 * relative / self._last if plain else 1.0
        left = relative * min(rate, 1.0)  # the next step by the rate of the last two, with caution
        rounding = relative < 1e-9 and relative >= 0.9 * self._last  # only that is left
        return left <= self.tolerance or self._stalled == 2 or rounding

    def stiffen(self) -> bool:
        """Damp where a system cannot be solved; return False at the start, and where damping does not help."""
        if len(self.history) == 1 or self.damping > 1.0:
            return False
        self.damping = max(self.damping * self._growth, 1e-4)
        self._growth, self._last = 2.0 * self._growth, np.inf
        return True

    def relax(self, relative: float) -> None:
        """Damp less after an accepted step."""
        self.damping *= max(0.5 if self._curved else 0.2, 1.0 - (2.0 * min(self._gain, 1.0) - 1.0) ** 3)
        if self.damping < 1e-9 or (relative < 1e-4 and not self._curved):
            self.damping = 0.0
        self._growth, self._last = 2.0, relative


def extrapolation(product: float, before: float, now: float) -> float:
    """Return by how much to lengthen a step that repeats the last one at a constant rate (Aitken's extrapolation), else 1.

    Parameters
    ----------
    product, before, now : float
        Of the changes of the observations by both steps: their product, and the sums of squares of the last and of this one.

    Examples
    --------
    >>> extrapolation(0.5, 1.0, 0.25)
    2.0
    >>> extrapolation(0.0, 1.0, 0.25)
    1.0
    """
    rate = product / before
    alike = product**2 > 0.8 * before * now
    return 1.0 / (1.0 - rate) if alike and 0.1 < abs(rate) < 0.97 else 1.0


def iterate(
    network: Network,
    state: State,
    lin: Linearization,
    groups: Arrangement,
    datum: Datum,
    factor: Callable[..., Solver],
    settings: Settings,
    viewpoints: Viewpoints | None = None,
    far: Bools | None = None,
) -> tuple[State, Linearization, list[Iteration], bool]:
    """Gauss-Newton with Levenberg's damping where a full step does not help.

    Steps that shrink at a constant rate, as large residuals make them, are extrapolated; others are bent by the second derivative along
    them, solved with the same factor (geodesic acceleration: Transtrum & Sethna 2012), so that narrow curved valleys of weak
    self-calibrations are followed, not crept along. Damping counts in the largest scale that a column has had (More 1978), so that what
    hardly matters for a while does not run away; a system that cannot be solved on the way is damped.
    """
    control = Control(float(lin.misclosure @ lin.misclosure), lin.count, settings, settings.progress)
    before: Floats | None = None  # the last full step, as a change of the observations
    straight = False  # whether the last step was neither damped nor bent nor lengthened
    viewpoints, largest = viewpoints or viewpoints_of(groups.groups, state), lin.scale
    far = viewpoints.far(state.points) if far is None else far

    def moved(step: Floats) -> State:
        return state.moved(unknowns, step, viewpoints)

    def linearized(there: State, scale: Floats | None) -> Linearization:
        return replace(linearize(network, there, unknowns, groups, workers), near=scale)

    def stiffened() -> Linearization:
        nonlocal largest
        largest = np.maximum(largest, lin.scale)
        return replace(lin, near=largest)

    def misclosures(there: State) -> Floats:
        return whitened_misclosures(network, there, groups, workers)

    tied, unknowns, workers = datum, lin.unknowns, lin.workers
    untied = replace(datum, held=np.zeros(0, dtype=np.intp), conditions=None)  # damping ties the datum down, elsewhere; see `brought_back`
    solver: Solver | None = None
    for _ in range(settings.iterations):
        datum = untied if control.damping > 0.0 else tied
        if solver is not None and control.reuses:
            solver = solver.at(lin)  # the system hardly differs from the one that was factored
        else:
            try:
                solver = factor(stiffened() if control.damping > 0.0 else lin, datum, control.damping)
            except Singular:
                if not control.stiffen():
                    raise
                before, solver, straight = None, None, False
                continue
        if datum.transfer is not None:
            datum = datum.at(lin, state)
        step, change = _step(lin, solver, datum, lin.misclosure)
        squares, bent = float(change @ change), False
        relative, lengthened, plain = control.relative(squares), 1.0, straight
        if control.damping == 0.0 and before is not None and relative < 0.01:
            lengthened = extrapolation(float(change @ before), float(before @ before), squares)
            step, plain = lengthened * step, straight and lengthened == 1.0
        predicted = 2.0 * lengthened * float(change @ lin.misclosure) - lengthened**2 * squares
        if lengthened == 1.0 and control.bends(relative):
            step, plain, bent = _bent(lin, solver, datum, step, change, lambda x: misclosures(moved(x))), False, True
        near, full, trial = control.near(relative), control.damping == 0.0, moved(step)
        before = change if full and lengthened == 1.0 else None
        del change  # its memory is needed, and that of the system
        if near:  # linearised at once
            solver, scale = solver.at(None), lin.scale
            del lin
            lin = linearized(trial, scale)
            value = _squares(lin.misclosure)
        else:
            value = _squares(misclosures(trial))
        if not control.takes(value, predicted, relative):
            before, solver, straight = None, None, False
            if near:
                lin = linearized(state, scale)
            continue
        state = trial
        straight = before is not None and not bent
        solver = solver.at(None) if full and relative <= REUSE else None
        if not near:
            scale = lin.scale
            del lin
            lin = linearized(state, scale if full and relative < SCALED else None)
        if control.settled(relative, plain) and (full or _full_step(lin, tied, factor) <= 1e-6):
            return state, lin, control.history, True
        control.relax(relative)
        if tied.transfer is not None and len(control.history) % PATIENCE == 0 and (viewpoints.doubtful(state.points) & ~far).any():
            break  # the datum hangs on points that prove to be far: see `baarda.adjustment.solve`
    return state, lin, control.history, False


def _squares(values: Floats) -> float:
    """Return the sum of squares, infinite where a number is not finite."""
    with np.errstate(over="ignore"):
        return float(values @ values) if np.isfinite(values).all() else np.inf


def _step(lin: Linearization, solver: Solver, datum: Datum, y: Floats) -> tuple[Floats, Floats]:
    """Return the step x that fits A x to y best, in the datum asked for, and A x."""
    step, change = solver.least_squares(y)
    if datum.transfer is None:
        return step, change
    step = datum.transform(step)
    return step, change if datum.defect.steady else lin.times(step)  # else they may be free at the start only


def _full_step(lin: Linearization, datum: Datum, factor: Callable[..., Solver]) -> float:
    """Return the relative step that would be taken without damping."""
    _, change = factor(lin, datum).least_squares(lin.misclosure)
    return float(np.linalg.norm(change) / max(np.linalg.norm(lin.misclosure), 1e-4 * np.sqrt(lin.count)))


def _bent(
    lin: Linearization, solver: Solver, datum: Datum, step: Floats, change: Floats, misclosures: Callable[[Floats], Floats]
) -> Floats:
    """Add the second-order correction to a step, where it is smaller than the step."""
    h = 0.1
    curvature = misclosures(h * step)  # 2 ((l - l(h)) / h - change) / h, in place
    np.subtract(lin.misclosure, curvature, out=curvature)
    curvature /= h
    curvature -= change
    curvature *= 2.0 / h
    if not np.isfinite(curvature).all():
        return step
    bend = -0.5 * _step(lin, solver, datum, curvature)[0]
    size = np.linalg.norm(lin.scale * bend) / np.linalg.norm(lin.scale * step)
    return step + bend if size <= 0.375 else step
