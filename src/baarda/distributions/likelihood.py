"""Maximum likelihood: the search over location, scale and shapes, with exact gradient, bounds and cusps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from threadpoolctl import ThreadpoolController

from baarda.distributions.base import Floats, Law, Shape
from baarda.distributions.result import Fit
from baarda.distributions.sample import Sample
from baarda.distributions.tabulated import log_likelihood, log_likelihood_gradient

_SMALL = 200
_LARGE = 5000
FREE_CENTRE_LOWER = -0.25  # below, the location information of the modulated normal is infinite (a <= -1/2: the likelihood unbounded)
# Coordinates of the search: loc in units of the start scale, log(scale), and for each shape its coordinate `Shape.to_unit` in (0, 1). The
# modulated normal's limit a = inf is the coordinate 0; the likelihood has a slope there, which tells on which side the maximum is.

_AT_LIMIT = 1e-8  # the coordinate at which the slope at the limit is taken


@dataclass(frozen=True)
class Problem:
    """Minus the mean log-likelihood as a function of search coordinates."""

    member: Law
    sample: Sample
    given: Mapping[str, float]
    free: tuple[str, ...]
    unit: float
    lower_a: float

    def shapes(self) -> dict[str, Shape]:
        """Return the shapes that are not fixed by the law, by name."""
        return {s.name: s for s in self.member.free_shapes}

    def values(self, theta: Floats) -> dict[str, float]:
        """Return all parameters at search coordinates."""
        shapes = self.shapes()
        out = dict(self.member.fixed) | dict(self.given)
        for name, t in zip(self.free, theta, strict=True):
            if name == "loc":
                out[name] = self.sample.centre + self.unit * float(t)
            elif name == "scale":
                out[name] = self.unit * float(np.exp(t))
            else:
                out[name] = float(shapes[name].from_unit(float(t)))
        return out

    def coordinates(self, values: Mapping[str, float]) -> Floats:
        """Return the search coordinates of parameters."""
        shapes = self.shapes()
        out = []
        for name in self.free:
            if name == "loc":
                out.append((values[name] - self.sample.centre) / self.unit)
            elif name == "scale":
                out.append(float(np.log(values[name] / self.unit)))
            else:
                out.append(float(shapes[name].to_unit(values[name])))
        return np.array(out)

    def bounds(self) -> list[tuple[float, float]]:
        """Return the bounds of the search coordinates."""
        out = []
        shapes = self.shapes()
        for name in self.free:
            if name == "loc":
                out.append((-np.inf, np.inf))
            elif name == "scale":
                out.append((-30.0, 30.0))
            else:
                low, high = shapes[name].limits()
                out.append((low, shapes[name].to_unit(self.lower_a) if name == "a" and self.lower_a > -1.0 else high))
        return out

    def terms(self, theta: Floats) -> tuple[Floats, list[Floats]]:
        """Log density of each point and its derivatives with respect to the coordinates."""
        v = self.values(theta)
        cls = self.member.distribution
        shape_values = tuple(v[s.name] for s in cls.shapes)
        scale = v["scale"]
        z = (self.sample.points - (v["loc"] - self.sample.centre)) / scale
        score = np.zeros_like(z)
        gradient: dict[str, Floats] = {}
        if any(s.name in self.free for s in cls.shapes):
            log_f, score, slopes = cls._likelihood(z, *shape_values)
            if any(np.isinf(value) for value in shape_values):
                near = [v[s.name] if np.isfinite(v[s.name]) else s.from_unit(_AT_LIMIT) for s in cls.shapes]
                slopes = cls._gradient(z, *near)
            gradient = dict(zip((s.name for s in cls.shapes), slopes, strict=True))
        else:
            log_f = cls._logpdf(z, *shape_values)
            if self.free:
                score = cls._score(z, *shape_values)
        log_f = log_f - np.log(scale)
        shapes = self.shapes()
        out = []
        for name, t in zip(self.free, theta, strict=True):
            if name == "loc":
                out.append(-score * (self.unit / scale))
            elif name == "scale":
                out.append(-1.0 - z * score)
            else:
                out.append(gradient[name] * shapes[name].slope(max(float(t), _AT_LIMIT)))
        return log_f, out

    def cost(self, theta: Floats) -> tuple[float, Floats]:
        """Return minus the mean log-likelihood and its gradient."""
        log_f, slopes = self.terms(theta)
        n = self.sample.n
        return -self.sample.sum(log_f) / n, np.array([-self.sample.sum(s) / n for s in slopes])

    def hessian(self, theta: Floats) -> Floats:
        """Second derivatives of the cost by central differences of its exact gradient."""
        k = len(theta)
        out = np.empty((k, k))
        low = np.array([b[0] for b in self.bounds()])
        high = np.array([b[1] for b in self.bounds()])
        for i in range(k):
            step = 1e-5 * max(1.0, abs(theta[i])) if self.free[i] in ("loc", "scale") else 1e-4 * max(theta[i], 1e-3)
            up, down = theta.copy(), theta.copy()
            up[i], down[i] = min(theta[i] + step, high[i]), max(theta[i] - step, low[i])
            out[i] = (self.cost(up)[1] - self.cost(down)[1]) / (up[i] - down[i])
        return 0.5 * (out + out.T)

    def minimise(self, start: Floats, *, polish: bool = True) -> tuple[Floats, float]:
        """Quasi-Newton within the bounds, then (to polish) Newton steps on the coordinates that are inside."""
        box = self.bounds()
        start = np.clip(start, [b[0] for b in box], [b[1] for b in box])
        result = optimize.minimize(
            self.cost, start, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": 200, "ftol": 1e-11, "gtol": 1e-6}
        )
        theta, best = np.asarray(result.x, dtype=float), float(result.fun)
        inside = np.array([b[0] < t < b[1] for b, t in zip(box, theta, strict=True)])
        for _ in range(4 if polish else 0):
            if not inside.any():
                break
            slope = self.cost(theta)[1][inside]
            curvature = self.hessian(theta)[np.ix_(inside, inside)]
            if not np.all(np.isfinite(curvature)) or np.min(np.linalg.eigvalsh(curvature)) <= 0.0:
                break
            step = -np.linalg.solve(curvature, slope)
            trial = theta.copy()
            trial[inside] += step
            if any(not b[0] <= t <= b[1] for b, t in zip(box, trial, strict=True)):
                break
            value = self.cost(trial)[0]
            if not value <= best + 1e-15 * abs(best):
                break
            theta, best = trial, min(best, value)
            if np.max(np.abs(step)) < 1e-8:  # the next one would be below 1e-15
                break
        return theta, best


def problem_of(member: Law, sample: Sample, given: Mapping[str, float], free: tuple[str, ...], lower_a: float | None) -> Problem:
    """Return the search for a sample; the bound of a is -1/4 where the centre is free or an observation lies on it."""
    _, sd, _ = sample.moments(given.get("loc"))
    if lower_a is None:
        lower_a = FREE_CENTRE_LOWER if "loc" in free or sample.has_centre else -1.0
    return Problem(member, sample, given, free, sd if sd > 0.0 else 1.0, lower_a)


def maximise(
    member: Law,
    sample: Sample,
    given: Mapping[str, float],
    free: tuple[str, ...],
    lower_a: float | None = None,
    values: Floats | None = None,
) -> Fit:
    """Return the maximum-likelihood fit to a sample, with some parameters given.

    With the `values` that a condensed sample stands for, one Newton step on all of them follows.
    """
    with _blas().limit(limits=1, user_api="blas"):  # the matrices are tiny: more threads only wait for one another
        return _maximise(member, sample, given, free, lower_a, values)


@cache
def _blas() -> Any:
    return ThreadpoolController()


def _maximise(
    member: Law, sample: Sample, given: Mapping[str, float], free: tuple[str, ...], lower_a: float | None, values: Floats | None
) -> Fit:
    folded = member.distribution.symmetric and given.get("loc") == sample.centre
    sample = sample.reduced(folded=folded, coarse=False)
    problem = problem_of(member, sample, given, free, lower_a)
    rough = replace(problem, sample=sample.reduced(folded=folded, coarse=True))
    notes: list[str] = []
    if not free:
        distribution = member.with_values(problem.values(np.zeros(0)))
        total = sample.log_likelihood(distribution) if values is None else log_likelihood(values, distribution)
        return Fit(member.name, distribution, "maximum_likelihood", (), sample.n, total)
    closed = _closed_form(problem) if set(free) <= {"loc", "scale"} else None
    information = None
    if closed is not None:
        theta, best = closed
    elif rough.sample is sample:
        theta, best = _best_of_starts(problem)
    else:
        theta, best, information = _by_levels(problem, rough)
    if closed is None and "loc" in free:
        theta, best = _try_points(problem, theta, best)
    shapes = problem.shapes()
    at_bounds = []
    for i, name in enumerate(free):
        if name not in shapes:
            continue
        shape = shapes[name]
        if shape.upper_closed and np.isinf(shape.upper) and theta[i] < 0.01:
            # the limit law itself: take it unless the finite value is really better
            limit = theta.copy()
            limit[i] = 0.0
            rest = replace(problem, given=dict(problem.given) | {name: np.inf}, free=tuple(f for f in free if f != name))
            found, value = rest.minimise(np.delete(limit, i)) if rest.free else (np.zeros(0), rest.cost(np.zeros(0))[0])
            if value <= best + 1e-12:
                theta, best, information = np.insert(found, i, 0.0), value, None
        low, high = problem.bounds()[i]
        if theta[i] == low or theta[i] == high:
            at_bounds.append(name)
            value = float(shape.from_unit(theta[i]))
            notes.append(
                f"{name} = {value:g} is the bound of its range" + (": the normal law fits best" if name == "a" and np.isinf(value) else "")
            )
    if information is None:
        information = _information(rough, theta)
    total = -best * sample.n
    if values is not None:
        theta, total = _polish(problem, information, theta, tuple(at_bounds), values)
    return Fit(
        member.name,
        member.with_values(problem.values(theta)),
        "maximum_likelihood",
        free,
        sample.n,
        total,
        _standard_errors(problem, information, theta, tuple(at_bounds)),
        at_bounds=tuple(at_bounds),
        notes=tuple(notes),
    )


def _closed_form(problem: Problem) -> tuple[Floats, float] | None:
    sample, given = problem.sample, problem.given
    weights = np.ones(sample.points.size) if sample.weights is None else sample.weights
    loc = given["loc"] - sample.centre if "loc" in given else None
    found = problem.member.distribution._closed_form(sample.points, weights, loc)
    if found is None:
        return None
    theta = problem.coordinates({"loc": sample.centre + found[0], "scale": found[1]} | dict(given))
    return theta, problem.cost(theta)[0]


def _best_of_starts(problem: Problem, *, polish: bool = True) -> tuple[Floats, float]:
    """Start from moments at a few shapes, search from the best two."""
    sample, given = problem.sample, problem.given
    mean, sd, _ = sample.moments(given.get("loc"))
    lists: list[dict[str, float]] = [{}]
    for shape in problem.member.free_shapes:
        if shape.name in problem.free:
            low, high = problem.bounds()[problem.free.index(shape.name)]
            grid = [v for v in shape.usual_values() if low < shape.to_unit(v) < high] or [float(shape.from_unit(0.5 * (low + high)))]
            lists = [d | {shape.name: v} for d in lists for v in grid]
    starts = []
    for choice in lists:
        values: dict[str, float] = dict(problem.member.fixed) | {"loc": mean} | choice | dict(given)
        if "scale" not in values:
            unit = problem.member.with_values(values | {"scale": 1.0}).std()
            values["scale"] = sd / unit if np.isfinite(unit) and unit > 0.0 else sd
        theta = problem.coordinates(values)
        starts.append((-problem.sample.log_likelihood(problem.member.with_values(problem.values(theta))) / sample.n, tuple(theta)))
    starts.sort()
    # in small samples the likelihood may have a second maximum in the shape
    results = [problem.minimise(np.array(theta), polish=polish) for _, theta in starts[: 2 if sample.n < _LARGE else 1]]
    return min(results, key=lambda r: r[1])


def _by_levels(problem: Problem, rough: Problem) -> tuple[Floats, float, Floats | None]:
    """Search on wide bins, then a few Newton steps on the narrow ones with the curvature of the wide ones, which is returned too."""
    theta, _ = _best_of_starts(rough, polish=False)
    if "loc" in problem.free and _smoothness(problem, theta) == 0:
        return *problem.minimise(theta), None
    inside = _inside(problem, theta)
    information = _information(rough, theta)
    curvature = information[np.ix_(inside, inside)]
    if not _positive(curvature):
        return *problem.minimise(theta), None
    best, slope = problem.cost(theta)
    for _ in range(8):
        step = -np.linalg.solve(curvature, slope[inside])
        trial = theta.copy()
        trial[inside] += step
        if not np.array_equal(inside, _inside(problem, trial)):
            return *problem.minimise(theta), None
        value, new = problem.cost(trial)
        if not value <= best + 1e-14 * abs(best):
            break
        theta, best, slope = trial, min(value, best), new
        if step @ curvature @ step * problem.sample.n < 1e-8:  # 1e-4 of a standard error; the next one is far smaller
            break
    return theta, best, information


def _polish(problem: Problem, information: Floats, theta: Floats, at_bounds: tuple[str, ...], values: Floats) -> tuple[Floats, float]:
    """Take one Newton step on the likelihood of all values; return where it leads and the log-likelihood there."""
    now = problem.values(theta)
    total, gradient = log_likelihood_gradient(values, problem.member.with_values(now))
    inside = _inside(problem, theta) & np.array([name not in at_bounds for name in problem.free])
    curvature = values.size * information[np.ix_(inside, inside)]
    if not _positive(curvature):
        return theta, total
    slope = np.array([gradient[problem.free[i]] * _rate(problem, problem.free[i], theta[i]) for i in np.flatnonzero(inside)])
    trial = theta.copy()
    trial[inside] += np.linalg.solve(curvature, slope)
    if not np.array_equal(inside, _inside(problem, trial) & inside):
        return theta, total
    return trial, total + 0.5 * float(slope @ (trial - theta)[inside])


def _inside(problem: Problem, theta: Floats) -> NDArray[np.bool_]:
    """Which coordinates are not on a bound of their range, or beyond."""
    return np.array([low < t < high for (low, high), t in zip(problem.bounds(), theta, strict=True)])


def _positive(matrix: Floats) -> bool:
    return bool(np.all(np.isfinite(matrix)) and matrix.size and np.min(np.linalg.eigvalsh(matrix)) > 0.0)


def _information(problem: Problem, theta: Floats) -> Floats:
    """Second derivatives of the cost; where log f is not smooth enough for a free centre, mean products of the slopes."""
    if "loc" not in problem.free or _smoothness(problem, theta) == 2:
        return problem.hessian(theta)
    slopes = problem.terms(theta)[1]
    return np.array([[problem.sample.sum(a * b) for b in slopes] for a in slopes]) / problem.sample.n


def _rate(problem: Problem, name: str, coordinate: float) -> float:
    """Derivative of a parameter by its coordinate."""
    if name == "loc":
        return problem.unit
    if name == "scale":
        return problem.unit * float(np.exp(coordinate))
    return float(problem.shapes()[name].slope(coordinate))


def _smoothness(problem: Problem, theta: Floats) -> int:
    v = problem.values(theta)
    return problem.member.distribution._smoothness(*(v[s.name] for s in problem.member.distribution.shapes))


def _try_points(problem: Problem, theta: Floats, best: float) -> tuple[Floats, float]:
    """Where the likelihood may have a cusp at every observation (a <= 0, Laplace): try the observations near the centre as the location.

    In small samples such a maximum may lie far from the smooth one, so the roughest shape is tried too.
    """
    i = problem.free.index("loc")
    bases = [theta] if _smoothness(problem, theta) == 0 else []
    if problem.sample.n <= _SMALL and "a" in problem.free:
        roughest = theta.copy()
        roughest[problem.free.index("a")] = problem.bounds()[problem.free.index("a")][1]
        if _smoothness(problem, roughest) == 0:
            bases.append(roughest)
    points = problem.sample.points / problem.unit
    reach = min(points.size, max(10, int(2.0 * np.sqrt(points.size))), 100)
    near = points[np.argpartition(np.abs(points - theta[i]), reach - 1)[:reach]]
    for base in bases:
        trials = np.repeat(base[None], reach, axis=0)
        trials[:, i] = near
        costs = [problem.cost(trial)[0] for trial in trials]
        start = trials[int(np.argmin(costs))]
        held = replace(
            problem, given=dict(problem.given) | {"loc": problem.values(start)["loc"]}, free=tuple(f for f in problem.free if f != "loc")
        )
        rest, value = held.minimise(np.delete(start, i)) if held.free else (np.zeros(0), min(costs))
        if value < best:
            theta, best = np.insert(rest, i, start[i]), value
    return theta, best


def _standard_errors(problem: Problem, information: Floats, theta: Floats, at_bounds: tuple[str, ...]) -> dict[str, float | None]:
    inside = [i for i, name in enumerate(problem.free) if name not in at_bounds]
    errors: dict[str, float | None] = dict.fromkeys(problem.free)
    if not inside:
        return errors
    kept = problem.sample.n * information[np.ix_(inside, inside)]
    if not _positive(kept):
        return errors
    covariance = np.linalg.inv(kept)
    for k, i in enumerate(inside):
        name = problem.free[i]
        errors[name] = float(np.sqrt(covariance[k, k]) * abs(_rate(problem, name, float(theta[i]))))
    return errors
