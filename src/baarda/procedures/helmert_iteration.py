"""Iterations of a network in parts: those of `baarda.adjustment.iteration`, with sums over the parts in the place of products."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.datum import steady
from baarda.adjustment.free_motion import back
from baarda.adjustment.iteration import REUSE, Control, extrapolation
from baarda.adjustment.result import Iteration
from baarda.adjustment.solve import LEFT, RETURNED, Settings
from baarda.errors import RedundancyNotPositive, UsageError
from baarda.procedures import helmert_part as tasks
from baarda.procedures.helmert_border import Handles, Joint, Parts, Top
from baarda.procedures.helmert_datum import JointDatum, at_present, at_result, choose_datum

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


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
        sums = self.parts.total(tasks.condition_sums, self.stands, steps, datum.tie)
        return self.parts.each(tasks.transferred, self.stands, steps, datum.tie, np.linalg.solve(sums[:, 1:], sums[:, 0]))

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

    def brought_back(self, free: tasks.Tie, pins: Sequence[Ints]) -> bool:
        """Bring the parts to where the conditions of the datum hold, see `baarda.adjustment.free_motion`; False if that cannot be done."""

        def drift(stands: Handles) -> Floats:
            return np.asarray(self.parts.total(tasks.drift, stands, free, list(pins)))

        motions = free.basis / np.repeat([1.0, free.size], [3, 4])[:, None]

        def carry(stands: Handles, motion: Floats) -> Handles:
            return self.parts.each(tasks.carried_along, stands, motion)

        there = back(self.stands, motions, steady(free.basis), free.size, drift, carry)
        if there is self.stands or there is None:
            return there is not None
        before, after = (float(self.parts.total(tasks.vpv, stands)) for stands in (self.stands, there))
        if abs(after - before) > RETURNED * max(before, self.joint.count * RETURNED):
            return False
        self.stands = there
        return True

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
        control = Control(sum(f.objective for f in joint.facts), joint.count, settings, self.progress)
        converged = False
        before: Handles | None = None
        straight = False  # whether the last step was neither damped nor bent nor lengthened
        old: Handles | None = None
        for _ in range(settings.iterations):
            datum = None if control.damping > 0.0 else at_present(parts, self.stands, tied)
            self.factor(datum, control.damping, old if control.reuses else None)
            old = None
            steps = self.solved(datum)
            s = self.sums(steps, before)
            relative, lengthened, plain, bent = control.relative(s.cc), 1.0, straight, False
            if control.damping == 0.0 and before is not None and relative < 0.01:
                lengthened = extrapolation(s.cb, s.bb, s.cc)
                plain = straight and lengthened == 1.0
            predicted = 2.0 * lengthened * s.cl - lengthened**2 * s.cc
            unbent, full = steps, control.damping == 0.0
            if lengthened == 1.0 and control.bends(relative):
                steps, plain, bent = self.bent(datum, steps), False, True
            trials = parts.each(tasks.tried, self.stands, steps, lengthened, control.near(relative))
            value = float(sum(parts.all(tasks.objective_of, trials)))
            if not control.takes(value, predicted, relative):
                before, straight = None, False
                continue
            before, straight = unbent if full and lengthened == 1.0 else None, full and lengthened == 1.0 and not bent
            if full and relative <= REUSE:
                old = self.stands
            self.stands = parts.each(tasks.stand_of, trials)
            del trials, steps, unbent
            if control.settled(relative, plain) and (full or self.full_step(self.stands, tied, control.objective) <= 1e-6):
                converged = True
                break
            control.relax(relative)
        old = before = None
        inside = not converged or tied.free is None or self.brought_back(tied.free, tied.pins)
        datum = at_result(parts, self.stands, settings, tied)
        datum = datum if inside else replace(datum, text=datum.text + LEFT)
        self.factor(datum, 0.0, None)
        return Blocked(joint, datum, self.stands, self.top, control.objective, redundancy, tuple(control.history), converged)
