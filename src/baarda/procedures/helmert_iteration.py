"""Iterations of a network in parts: those of `baarda.adjustment.iteration`, with sums over the parts in the place of products."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.iteration import BEND, NEAR, REUSE
from baarda.adjustment.result import Iteration
from baarda.adjustment.solve import Settings
from baarda.errors import RedundancyNotPositive, UsageError
from baarda.procedures import helmert_part as tasks
from baarda.procedures.helmert_border import Handles, Joint, Parts, Top
from baarda.procedures.helmert_datum import JointDatum, choose_datum

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Blocked:
    """A network solved in parts: the parts at the solution with their factors, and what the coordinator knows.

    Attributes
    ----------
    joint : Joint
    datum : JointDatum
    stands : list of handles
        The parts at the solution, factored.
    top : Top
    objective : float
        v'Pv.
    redundancy : int
    history : tuple of Iteration
    converged : bool
    """

    joint: Joint
    datum: JointDatum
    stands: Handles
    top: Top
    objective: float
    redundancy: int
    history: tuple[Iteration, ...]
    converged: bool

    @property
    def variance_factor(self) -> float:
        """The a-posteriori variance factor s0^2 = v'Pv / r."""
        return self.objective / self.redundancy


class Run:
    """The iterations."""

    def __init__(self, parts: Parts, settings: Settings, progress: Callable[[Iteration], None] | None) -> None:
        self.parts, self.joint, self.settings, self.progress = parts, parts.joint, settings, progress
        self.stands: Handles = []
        self._top: Top | None = None
        self.first: list[tasks.Reduced] | None = None

    @property
    def top(self) -> Top:
        """The factored border."""
        if self._top is None:
            raise UsageError("the border was not factored")
        return self._top

    def factor(self, datum: JointDatum | None, damping: float, old: Handles | None) -> None:
        """Factor parts and border, or (old) take the factors of the last iteration as approximate ones."""
        count = len(self.joint.at)
        none: Handles = [None] * count
        free = np.zeros(0, dtype=np.intp)
        held: Handles = [free] * count if datum is None else list(datum.held)
        self.stands = self.parts.each(tasks.factored, self.stands, none if old is None else old, held, damping)
        self.first = self.parts.all(tasks.reduced, self.stands, none, old is None)
        if old is not None:
            return
        b = self.joint.border
        matrix, squares = np.zeros((b, b)), np.zeros(b)
        for at, r in zip(self.joint.at, self.first, strict=True):
            if r.matrix is not None and r.column_squares is not None:
                matrix[np.ix_(at, at)] += r.matrix
                squares[at] += r.column_squares
        self._top = Top(matrix, squares, free if datum is None else datum.held_border, damping, self.joint.names)

    def solved(self, datum: JointDatum | None, y: Handles | None = None) -> Handles:
        """Return for each part the step that fits the misclosures, or y in their place, best in the datum asked for."""
        none: Handles = [None] * len(self.joint.at)
        values = none if y is None else y
        if y is None and self.first is not None:
            found, self.first = self.first, None
        else:
            found = self.parts.all(tasks.reduced, self.stands, values, False)
        x = self.top.solve(self.joint.sum([r.rhs for r in found]))
        steps = self.parts.each(tasks.expanded, self.stands, values, [x[at] for at in self.joint.at])
        if datum is None or datum.tie is None:
            return steps
        t = datum.inverse @ self.parts.total(tasks.condition_sums, self.stands, steps, datum.tie)
        return self.parts.each(tasks.transferred, self.stands, steps, datum.tie, t)

    def bent(self, datum: JointDatum | None, steps: Handles) -> Handles:
        """Add the second-order correction to a step, where it is smaller than the step."""
        curved = self.parts.each(tasks.curvature, self.stands, steps, 0.1)
        if not all(self.parts.all(tasks.finite, curved)):
            return steps
        bend = self.solved(datum, curved)
        squares = self.parts.total(tasks.norms, self.stands, steps, bend, [self.top.scale[at] for at in self.joint.at])
        return self.parts.each(tasks.bent, steps, bend) if 0.5 * np.sqrt(squares[1] / squares[0]) <= 0.375 else steps

    def sums(self, steps: Handles, before: Handles | None) -> tasks.StepSums:
        """Return the products of a step over all parts."""
        found = self.parts.all(tasks.step_sums, self.stands, steps, [None] * len(steps) if before is None else before)
        return tasks.StepSums(*(sum(values) for values in zip(*found, strict=True)))

    def full_step(self, stands: Handles, datum: JointDatum, objective: float) -> float:
        """Return the relative step that would be taken without damping."""
        self.stands = stands
        self.factor(datum, 0.0, None)
        cc = self.sums(self.solved(replace(datum, tie=None)), None).cc
        return float(np.sqrt(cc) / max(np.sqrt(objective), 1e-4 * np.sqrt(self.joint.count)))

    def solve(self, stands: Handles) -> Blocked:
        """Iterate to the minimum as `baarda.adjustment.iteration.iterate`, and factor there."""
        joint, settings, parts = self.joint, self.settings, self.parts
        self.stands = stands
        tied = choose_datum(parts, self.stands, settings, True)
        redundancy = joint.redundancy(tied.count)
        if redundancy <= 0:
            raise RedundancyNotPositive(
                f"redundancy {redundancy}: n = {joint.count} observations, u = {joint.unknowns} unknowns, "
                f"datum defect d = {tied.count}; a test needs r = n - u + d > 0"
            )
        objective = sum(f.objective for f in joint.facts)
        floor = joint.count * 1e-8
        history = [Iteration(0, objective, None, 0.0, True)]
        damping, growth, last, curved = 0.0, 2.0, np.inf, False
        stalled, trusted, converged = 0, False, False
        before: Handles | None = None
        old: Handles | None = None
        for count in range(1, settings.iterations + 1):
            datum = None if damping > 0.0 else tied
            self.factor(datum, damping, old if damping == 0.0 and last <= REUSE else None)
            old = None
            steps = self.solved(datum)
            s = self.sums(steps, before)
            predicted, relative, lengthened = 2.0 * s.cl - s.cc, float(np.sqrt(s.cc / max(objective, floor))), 1.0
            plain = before is not None
            if damping == 0.0 and before is not None and relative < 0.01:
                lengthened = _extrapolated(s)
                plain = lengthened == 1.0
                predicted = 2.0 * lengthened * s.cl - lengthened**2 * s.cc
            full = steps
            if lengthened == 1.0 and relative > max(BEND, 0.1 * last if np.isfinite(last) else 0.0):
                steps, plain = self.bent(datum, steps), False
            near = damping == 0.0 and (relative <= NEAR or trusted)
            trials = parts.each(tasks.tried, self.stands, steps, lengthened, near)
            value = float(sum(parts.all(tasks.objective_of, trials)))
            gain = (objective - value) / predicted if predicted > 0.0 else 0.0
            at_rounding = relative < 1e-6 and abs(value - objective) <= 1e-9 * max(objective, floor)
            accepted = bool(gain > 1e-4 or at_rounding)
            trusted = damping == 0.0 and gain > 0.5
            history.append(Iteration(count, value if accepted else objective, relative, damping, accepted))
            if self.progress is not None:
                self.progress(history[-1])
            if not accepted:
                before = None
                curved |= relative < 1e-3
                damping, growth, last = max(damping * growth, 1e-4 if relative > 0.1 else 1e-7), 2.0 * growth, np.inf
                continue
            objective = value
            before = full if damping == 0.0 and lengthened == 1.0 else None
            if damping == 0.0 and relative <= REUSE:
                old = self.stands
            self.stands = parts.each(tasks.stand_of, trials)
            del trials, steps, full
            stalled = stalled + 1 if relative <= 1e-7 and relative >= 0.8 * last else 0
            rate = 10.0 * relative / last if plain else 1.0
            settled = relative * min(rate, 1.0) <= settings.tolerance or stalled == 2 or (relative < 1e-9 and relative >= 0.5 * last)
            if settled and (damping == 0.0 or self.full_step(self.stands, tied, objective) <= 1e-6):
                converged = True
                break
            damping *= max(0.5 if curved else 0.2, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            if damping < 1e-9 or (relative < 1e-4 and not curved):
                damping = 0.0
            growth, last = 2.0, relative
        old = before = None
        datum = choose_datum(parts, self.stands, settings, False) if tied.count else tied
        self.factor(datum, 0.0, None)
        return Blocked(joint, datum, self.stands, self.top, objective, redundancy, tuple(history), converged)


def _extrapolated(s: tasks.StepSums) -> float:
    """Return by how much to lengthen a step that repeats the last one at a constant rate (Aitken's extrapolation), else 1."""
    rate = s.cb / s.bb
    alike = s.cb**2 > 0.8 * s.bb * s.cc
    return 1.0 / (1.0 - rate) if alike and 0.1 < abs(rate) < 0.97 else 1.0
