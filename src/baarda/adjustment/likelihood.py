"""Newton's iteration to the most likely unknowns and scale under a law of errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from baarda.adjustment.datum import Datum
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.linearize import Arrangement, linearize, whitened_misclosures
from baarda.adjustment.result import Iteration
from baarda.adjustment.solver import Solver
from baarda.distributions.base import Distribution
from baarda.errors import UsageError
from baarda.network import Network, State
from baarda.observations import viewpoints_of

if TYPE_CHECKING:
    from baarda.adjustment.solve import Settings

Floats = NDArray[np.float64]
Factor = Callable[..., Solver]

LEAST_CURVATURE = 0.1  # of the weight psi(u)/u: keeps the normal equations of a redescending law positive definite
CG_STEPS = 20
HALVINGS = 6
FAR = 0.5  # largest change of a residual, in units of the scale, along a direction of negative curvature
STALLED = 1e-6  # relative step
REACH = (1e-7, 0.3)  # of the differences that give curvatures, in units of the scale


def scale_of(residuals: Floats, law: Distribution, redundancy: float, near: float | None = None) -> float:
    """Return the scale s with sum u psi(u) = r, u = v/s: the most likely one, corrected for the unknowns.

    Parameters
    ----------
    residuals : (n,) array
        Whitened residuals, not all zero.
    law : Distribution
        Standard law.
    redundancy : float
        r.
    near : float, optional
        Where to begin.

    Returns
    -------
    float

    Raises
    ------
    UsageError
        If the law has no such scale: too many residuals vanish for its tails.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> scale_of(np.array([3.0, -4.0, 0.0]), law("normal")(), 1)
    5.0
    """

    def excess(t: float) -> float:
        u = residuals * np.exp(-t)
        return float(-(u @ law.score(u))) - redundancy

    t = float(np.log(near if near is not None else np.sqrt(residuals @ residuals / redundancy)))
    width = 0.02 if near is not None else 0.5
    low, high = t - width, t + width
    least = low - 100.0
    while not excess(low) > 0.0:
        low, width = low - width, 2.0 * width
        if low < least:
            raise UsageError("too many residuals vanish: the law of errors has no scale")
    while excess(high) > 0.0:
        high, width = high + width, 2.0 * width
    return float(np.exp(optimize.brentq(excess, low, high, xtol=1e-14, rtol=1e-14)))


def iterate(
    network: Network,
    state: State,
    lin: Linearization,
    groups: Arrangement,
    datum: Datum,
    factor: Factor,
    settings: Settings,
    law: Distribution,
    redundancy: int,
) -> tuple[State, Linearization, list[Iteration], bool, float]:
    """Newton's method on the likelihood with the scale eliminated, a line search along its step, and
    Levenberg's damping where that does not help.

    The curvature of an observation is the slope of psi over the distance that its residual moved in the last step, so that it stays
    finite where psi'(0) is infinite (modulated normal, a <= 1/2) and becomes psi' at the end. The normal equations that are factored have
    a tenth of the weight psi(u)/u in place of negative curvatures of redescending laws; conjugate gradients make Newton's step of it.
    """
    r = float(redundancy)

    def minus_log_likelihood(v: Floats, s: float) -> float:
        return float(-np.sum(law.logpdf(v / s)) + r * np.log(s))

    scale = scale_of(lin.misclosure, law, r)
    objective = minus_log_likelihood(lin.misclosure, scale)
    history = [Iteration(0, objective, None, 0.0, True)]
    damping, growth, last = 0.0, 2.0, np.inf
    reach = np.full(lin.count, REACH[1])
    viewpoints = viewpoints_of(groups.groups, state)
    for count in range(1, settings.iterations + 1):
        u = lin.misclosure / scale
        slope = (law.score(u - reach) - law.score(u + reach)) / (2.0 * reach)
        size = np.maximum(np.abs(u), reach)
        curvature = np.maximum(slope, LEAST_CURVATURE * -law.score(size) / size)
        solver = factor(lin.weighted(np.sqrt(curvature)), datum, damping)
        psi = -law.score(u)
        rhs = lin.transposed(psi * scale)
        step = solver.solve(rhs)
        if damping == 0.0:
            step = _newton_step(lin, solver, slope, u, psi, rhs, step, scale)
        if datum.transfer is not None:
            step = datum.at(lin, state).transform(step)
        change = lin.times(step)
        relative = float(np.sqrt(change @ (curvature * change) / r) / scale)
        slope_along = float(step @ rhs) / scale**2
        length, accepted = 1.0, False
        for _ in range(1 if damping > 0.0 else HALVINGS):  # Armijo's rule along Newton's step; the damped step is taken or not
            trial = state.moved(lin.unknowns, length * step, viewpoints)
            v = whitened_misclosures(network, trial, groups, lin.workers)
            value, trial_scale = np.inf, scale
            if np.isfinite(v).all():
                trial_scale = scale_of(v, law, r, scale)
                value = minus_log_likelihood(v, trial_scale)
            at_rounding = length * relative < 1e-5 and abs(value - objective) <= 1e-11 * max(abs(objective), lin.count)
            gain = (objective - value) / (0.5 * slope_along * length) if slope_along > 0.0 else 0.0
            accepted = bool(gain > 1e-4 or at_rounding)
            if accepted:
                break
            length *= 0.5
        relative *= length if accepted else 1.0
        history.append(Iteration(count, value if accepted else objective, relative, damping, accepted))
        if settings.progress is not None:
            settings.progress(history[-1])
        if not accepted:
            damping, growth, last = max(damping * growth, 1e-4), 2.0 * growth, np.inf
            continue
        state, objective, scale = trial, value, trial_scale
        reach = np.clip(np.abs(length * change) / scale, *REACH)
        lin = linearize(network, state, lin.unknowns, groups, lin.workers)
        whole = damping == 0.0 and length == 1.0
        # steps that no longer shrink are rounding: an infinite psi'(0) enlarges it
        if whole and (relative <= settings.tolerance or (relative <= STALLED and relative >= 0.5 * last)):
            return state, lin, history, True, scale
        damping *= max(0.2, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        if damping < 1e-6 or relative < 1e-4:
            damping = 0.0
        growth, last = 2.0, relative
    return state, lin, history, False, scale


def _newton_step(
    lin: Linearization, solver: Solver, slope: Floats, u: Floats, psi: Floats, rhs: Floats, first: Floats, scale: float
) -> Floats:
    """Solve Newton's equations, the scale eliminated, by conjugate gradients with the factored normal equations as preconditioner.

    The matrix is A' diag(psi') A - d d'/q, d = A'(u psi' + psi), q = sum(u psi + u^2 psi'); along a direction where it is
    not positive the step goes far, for the line search to shorten. Steihaug (1983), forcing term of Dembo, Eisenstat & Steihaug (1982).
    """
    turn = lin.transposed(u * slope + psi)
    share = float(u @ psi + (u * u) @ slope)
    rest, z = rhs, first
    direction, square = z, float(z @ rhs)
    accuracy = min(0.01, np.sqrt(square / (lin.count * max(float(np.mean(psi**2)), 1e-30)))) ** 2 * square
    step = np.zeros_like(first)
    for k in range(CG_STEPS):
        image = lin.transposed(slope * lin.times(direction))
        if share > 0.0:
            image = image - turn * (float(turn @ direction) / share)
        bend = float(direction @ image)
        if not bend > 1e-3 * square:
            if k == 0:
                return first
            return step + FAR * scale / float(np.abs(lin.times(direction)).max()) * direction
        length = square / bend
        step = step + length * direction
        rest = rest - length * image
        z = solver.solve(rest)
        last, square = square, float(z @ rest)
        if not square > accuracy:
            break
        direction = z + (square / last) * direction
    return step
