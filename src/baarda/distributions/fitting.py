"""Fitting a law to values by maximum likelihood or by moments: `fit` and its result `Fit`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from baarda.distributions import law as find_law
from baarda.distributions.base import Distribution, Floats, Law, Shape
from baarda.distributions.condensed import Condensed, condense
from baarda.distributions.histogram import Histogram
from baarda.errors import UsageError

Rule = Literal["maximum_likelihood", "moments", "minimum_chi2", "grouped_likelihood"]
CONDENSE_FROM = 20_000
_SMALL = 200
_LARGE = 5000
FREE_CENTRE_LOWER = -0.25  # below, the location information of the modulated normal is infinite (a <= -1/2: the likelihood unbounded)


@dataclass(frozen=True)
class Fit:
    """A law fitted to data.

    Attributes
    ----------
    law : str
        Name of the law.
    distribution : Distribution
        The law with its values.
    rule : str
        How they were found.
    estimated : tuple of str
        Names of the parameters that were estimated; the others were given.
    n : int
        Number of values.
    log_likelihood : float or None
        Of the values (of the class counts for `grouped_likelihood`); None where only classes are known and another rule was used.
    standard_errors : mapping
        Standard error of each estimated parameter; None where it is on a bound or the rule gives none.
    histogram : Histogram or None
        Classes with observed and expected counts, when a chi-square was asked for.
    df : int or None
        Degrees of freedom of the chi-square: classes - 1 - estimated parameters.
    alpha : float
        Level of the chi-square test.
    at_bounds : tuple of str
        Parameters whose estimate is a bound of their range (a = inf: the normal law fits best).
    notes : tuple of str
        What the reader must know.
    """

    law: str
    distribution: Distribution
    rule: str
    estimated: tuple[str, ...]
    n: int
    log_likelihood: float | None = None
    standard_errors: Mapping[str, float | None] = field(default_factory=dict)
    histogram: Histogram | None = None
    df: int | None = None
    alpha: float = 0.05
    at_bounds: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """All parameters of the law by name."""
        return self.distribution.parameters

    @property
    def aic(self) -> float | None:
        """Akaike's criterion 2k - 2 log L."""
        return None if self.log_likelihood is None else 2.0 * len(self.estimated) - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float | None:
        """Schwarz's criterion k log n - 2 log L."""
        return None if self.log_likelihood is None else len(self.estimated) * float(np.log(self.n)) - 2.0 * self.log_likelihood

    @property
    def statistic(self) -> float | None:
        """The chi-square on classes."""
        return None if self.histogram is None else self.histogram.chi_square

    @property
    def p_value(self) -> float | None:
        """Exceedance probability of the chi-square with `df` degrees of freedom; None without any."""
        if self.histogram is None or not self.df or self.df < 1:
            return None
        return float(special.chdtrc(self.df, self.histogram.chi_square))

    @property
    def critical(self) -> float | None:
        """The limit of the chi-square at level `alpha`."""
        return None if self.df is None or self.df < 1 else float(special.chdtri(self.df, self.alpha))

    @property
    def rejected(self) -> bool | None:
        """Whether the chi-square test rejects the law at level `alpha`."""
        return None if self.p_value is None else bool(self.p_value < self.alpha)

    def as_dict(self) -> dict[str, Any]:
        """Return the row of `laws` in `result.json`; infinite parameters as None."""
        return {
            "law": self.law,
            "rule": self.rule,
            "parameters": {k: v if np.isfinite(v) else None for k, v in self.parameters.items()},
            "statistic": self.statistic,
            "df": self.df,
            "critical": self.critical,
            "p_value": self.p_value,
            "rejected": self.rejected,
            "log_likelihood": self.log_likelihood,
            "aic": self.aic,
            "bic": self.bic,
        }


def fit(
    values: ArrayLike | Condensed,
    law: str | Law = "modulated_normal",
    *,
    rule: Rule = "maximum_likelihood",
    loc: float | None = None,
    scale: float | None = None,
    shapes: Mapping[str, float] | None = None,
    lower_a: float | None = None,
    edges: ArrayLike | None = None,
    ends: Literal["open", "closed"] = "open",
    alpha: float = 0.05,
) -> Fit:
    """Fit a law to values.

    Parameters
    ----------
    values : (n,) array or Condensed
        Residuals, or residuals divided by their standard deviations.
    law : str or Law
        The law, for instance ``"normal"``, ``"radico"``, ``"modulated_normal"``.
    rule : str
        ``maximum_likelihood``, ``moments`` (mean, standard deviation, kurtosis), or on the classes of `edges`: ``minimum_chi2``,
        ``grouped_likelihood``.
    loc, scale : float, optional
        Given values; estimated when None.
    shapes : mapping, optional
        Given values of shape parameters.
    lower_a : float, optional
        Lower bound of the modulated normal's a; -1/4 with a free mean (see Notes), else -1.
    edges : (k+1,) array, optional
        Class limits of the two rules on classes.
    ends : {"open", "closed"}
        End classes of these rules.
    alpha : float
        Level of their chi-square.

    Returns
    -------
    Fit

    Raises
    ------
    UsageError
        If values are missing, not finite, too few for the parameters, or all equal.

    Notes
    -----
    From 20 000 values on, the likelihood is summed over `Condensed` bins. The modulated normal's likelihood with a free mean is unbounded
    for a <= -1/2 and its location information infinite for a <= -1/4, hence the bound. Standard errors come from the observed information
    where log f is smooth, else from the outer products of the scores.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> result = fit(5.0 * rng.standard_normal(2000) * np.sqrt(rng.random(2000)), "modulated_normal", loc=0.0)
    >>> result.estimated
    ('a', 'scale')
    >>> bool(abs(result.parameters["scale"] - 5.0 / np.sqrt(2.0)) < 0.2)
    True
    """
    member = find_law(law) if isinstance(law, str) else law
    if isinstance(values, Condensed):
        return _fit_sample(member, Sample.of_condensed(values), rule, loc, scale, shapes, lower_a)
    x = check_values(values)
    if rule in ("minimum_chi2", "grouped_likelihood"):
        from baarda.distributions.class_fitting import fit_classes
        from baarda.distributions.histogram import check_edges, count

        if edges is None:
            raise UsageError(f"rule {rule} needs class limits (edges)")
        b = check_edges(edges)
        counts = count(x, b, ends)
        return fit_classes(counts, b, member, rule=rule, loc=loc, scale=scale, shapes=shapes, ends=ends, alpha=alpha)
    return _fit_sample(member, Sample.of(x, float(np.mean(x)) if loc is None else float(loc)), rule, loc, scale, shapes, lower_a)


def _fit_sample(
    member: Law,
    sample: Sample,
    rule: Rule,
    loc: float | None,
    scale: float | None,
    shapes: Mapping[str, float] | None,
    lower_a: float | None,
) -> Fit:
    given = given_values(member, loc, scale, shapes)
    free = tuple(name for name in member.parameter_names if name not in given)
    if sample.n <= len(free):
        raise UsageError(f"{sample.n} values do not suffice to fit {len(free)} parameters ({', '.join(free)})")
    if free and not np.ptp(sample.points) > 0.0:
        raise UsageError("all values are equal: no law can be fitted")
    if rule == "moments":
        found, bounds = _moment_estimates(member, sample, given)
        distribution = member.with_values(found)
        return Fit(
            member.name, distribution, rule, free, sample.n, sample.log_likelihood(distribution), dict.fromkeys(free), at_bounds=bounds
        )
    if rule != "maximum_likelihood":
        raise UsageError(f"no rule named {rule!r} for these values")
    return maximise(member, sample, given, free, lower_a)


def check_values(values: ArrayLike) -> Floats:
    """Return values as a flat array, or raise `UsageError` naming the first that is not finite."""
    x = np.asarray(values, dtype=float).ravel()
    if x.size == 0:
        raise UsageError("no values given")
    if not np.isfinite(np.sum(x)):  # one pass without a mask; a sum may also overflow, so look again
        bad = np.flatnonzero(~np.isfinite(x))
        if bad.size:
            raise UsageError(f"{bad.size} of {x.size} values are not finite; the first is number {bad[0] + 1} ({x[bad[0]]})")
    return x


def given_values(member: Law, loc: float | None, scale: float | None, shapes: Mapping[str, float] | None) -> dict[str, float]:
    """Return the parameters that are not estimated, by name; raise `UsageError` for unknown names."""
    given = {k: float(v) for k, v in (shapes or {}).items()}
    if loc is not None:
        given["loc"] = float(loc)
    if scale is not None:
        given["scale"] = float(scale)
    member(**given)  # checks names and bounds
    return given


@dataclass(frozen=True)
class Sample:
    """Points (differences from `centre`) with weights that stand for n values."""

    points: Floats
    weights: Floats | None
    centre: float
    n: int
    has_centre: bool

    @classmethod
    def of(cls, values: Floats, centre: float) -> Sample:
        """Take values as they are, or condensed when they are many."""
        if values.size >= CONDENSE_FROM:
            return cls.of_condensed(condense(values, centre))
        points = values - centre
        return cls(points, None, centre, values.size, bool(np.any(points == 0.0)))

    @classmethod
    def of_condensed(cls, condensed: Condensed) -> Sample:
        """Take condensed values."""
        points, weights = condensed.points()
        return cls(points, weights, condensed.centre, condensed.n, bool(np.any(points == 0.0)))

    def sum(self, terms: Floats) -> float:
        """Weighted sum of a term per point."""
        return float(np.sum(terms) if self.weights is None else np.dot(self.weights, terms))

    def log_likelihood(self, distribution: Distribution) -> float:
        """Log-likelihood of the values under a law."""
        z = (self.points - (distribution.loc - self.centre)) / distribution.scale
        return self.sum(distribution._logpdf(z, *distribution.shape_values)) - self.n * float(np.log(distribution.scale))

    def moments(self, loc: float | None) -> tuple[float, float, float]:
        """Mean, standard deviation about it (or about the given loc), and kurtosis."""
        mean = self.sum(self.points) / self.n if loc is None else loc - self.centre
        d2 = (self.points - mean) ** 2
        variance = self.sum(d2) / self.n
        return self.centre + mean, float(np.sqrt(variance)), self.sum(d2 * d2) / self.n / variance**2


def _moment_estimates(member: Law, sample: Sample, given: Mapping[str, float]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Mean, standard deviation and, for one free shape, the kurtosis."""
    mean, sd, kurtosis = sample.moments(given.get("loc"))
    found: dict[str, float] = dict(member.fixed) | {"loc": mean} | dict(given)
    bounds: tuple[str, ...] = ()
    unknown = [s for s in member.free_shapes if s.name not in given]
    if len(unknown) > 1:
        raise UsageError(f"law {member.name}: moments determine one shape, not {len(unknown)}")
    if unknown:
        shape = unknown[0]
        value, at_bound = _shape_from_kurtosis(member, shape, kurtosis - 3.0)
        found[shape.name] = value
        bounds = (shape.name,) if at_bound else ()
    if "scale" not in given:
        unit = member.with_values(found | {"scale": 1.0}).std()
        if not np.isfinite(unit):
            raise UsageError(f"law {member.name} has no variance at these values: moments do not determine its scale")
        found["scale"] = sd / unit
    return found, bounds


def _shape_from_kurtosis(member: Law, shape: Shape, excess: float) -> tuple[float, bool]:
    """Invert the excess kurtosis for the shape; (bound, True) where no value gives it."""

    def difference(t: float) -> float:
        value = float(member.distribution._moments(shape.from_unit(t))[3])
        # arctan: the excess is infinite for heavy tails
        return float(np.arctan(value) - np.arctan(excess)) if np.isfinite(value) else float(np.pi / 2.0 - np.arctan(excess))

    grid = np.linspace(1e-9, 1.0 - 1e-9, 401)
    with np.errstate(all="ignore"):
        at = np.array([difference(t) for t in grid])
    change = np.flatnonzero(np.sign(at[1:]) != np.sign(at[:-1]))
    if not change.size:
        best = float(grid[int(np.argmin(np.abs(at)))])
        return (shape.upper if shape.upper_closed and best < 0.5 else float(shape.from_unit(best))), True
    j = int(change[0])
    return float(shape.from_unit(optimize.brentq(difference, grid[j], grid[j + 1], xtol=1e-15))), False


# ---- maximum likelihood ---------------------------------------------------------------------------------------------------------------
# Coordinates of the search: loc in units of the start scale, log(scale), and for each shape its coordinate `Shape.to_unit` in (0, 1). The
# modulated normal's limit a = inf is the coordinate 0; the likelihood has a slope there, which tells on which side the maximum is.

_AT_LIMIT = 1e-8  # the coordinate at which the slope at the limit is taken


@dataclass(frozen=True)
class _Problem:
    """Minus the mean log-likelihood as a function of search coordinates."""

    member: Law
    sample: Sample
    given: Mapping[str, float]
    free: tuple[str, ...]
    unit: float
    lower_a: float

    def shapes(self) -> dict[str, Shape]:
        return {s.name: s for s in self.member.free_shapes}

    def values(self, theta: Floats) -> dict[str, float]:
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


def _problem(member: Law, sample: Sample, given: Mapping[str, float], free: tuple[str, ...], lower_a: float | None) -> _Problem:
    _, sd, _ = sample.moments(given.get("loc"))
    if lower_a is None:
        lower_a = FREE_CENTRE_LOWER if "loc" in free or sample.has_centre else -1.0
    return _Problem(member, sample, given, free, sd if sd > 0.0 else 1.0, lower_a)


def maximise(member: Law, sample: Sample, given: Mapping[str, float], free: tuple[str, ...], lower_a: float | None = None) -> Fit:
    """Return the maximum-likelihood fit to a sample, with some parameters given."""
    problem = _problem(member, sample, given, free, lower_a)
    notes: list[str] = []
    if not free:
        distribution = member.with_values(problem.values(np.zeros(0)))
        return Fit(member.name, distribution, "maximum_likelihood", (), sample.n, sample.log_likelihood(distribution))
    closed = _closed_form(problem) if set(free) <= {"loc", "scale"} else None
    theta, best = closed or _best_of_starts(problem)
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
                theta, best = np.insert(found, i, 0.0), value
        low, high = problem.bounds()[i]
        if theta[i] == low or theta[i] == high:
            at_bounds.append(name)
            value = float(shape.from_unit(theta[i]))
            notes.append(
                f"{name} = {value:g} is the bound of its range" + (": the normal law fits best" if name == "a" and np.isinf(value) else "")
            )
    return Fit(
        member.name,
        member.with_values(problem.values(theta)),
        "maximum_likelihood",
        free,
        sample.n,
        -best * sample.n,
        _standard_errors(problem, theta, tuple(at_bounds)),
        at_bounds=tuple(at_bounds),
        notes=tuple(notes),
    )


def _closed_form(problem: _Problem) -> tuple[Floats, float] | None:
    sample, given = problem.sample, problem.given
    weights = np.ones(sample.points.size) if sample.weights is None else sample.weights
    loc = given["loc"] - sample.centre if "loc" in given else None
    found = problem.member.distribution._closed_form(sample.points, weights, loc)
    if found is None:
        return None
    theta = problem.coordinates({"loc": sample.centre + found[0], "scale": found[1]} | dict(given))
    return theta, problem.cost(theta)[0]


def _best_of_starts(problem: _Problem) -> tuple[Floats, float]:
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
        starts.append((problem.cost(theta)[0], tuple(theta)))
    starts.sort()
    # in small samples the likelihood may have a second maximum in the shape
    results = [problem.minimise(np.array(theta)) for _, theta in starts[: 2 if sample.n < _LARGE else 1]]
    return min(results, key=lambda r: r[1])


def _smoothness(problem: _Problem, theta: Floats) -> int:
    v = problem.values(theta)
    return problem.member.distribution._smoothness(*(v[s.name] for s in problem.member.distribution.shapes))


def _try_points(problem: _Problem, theta: Floats, best: float) -> tuple[Floats, float]:
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


def _standard_errors(problem: _Problem, theta: Floats, at_bounds: tuple[str, ...]) -> dict[str, float | None]:
    inside = [i for i, name in enumerate(problem.free) if name not in at_bounds]
    errors: dict[str, float | None] = dict.fromkeys(problem.free)
    if not inside:
        return errors
    n = problem.sample.n
    if "loc" in problem.free and _smoothness(problem, theta) < 2:
        slopes = problem.terms(theta)[1]
        information = np.array([[problem.sample.sum(slopes[i] * slopes[j]) for j in inside] for i in inside])
    else:
        information = n * problem.hessian(theta)[np.ix_(inside, inside)]
    if not np.all(np.isfinite(information)) or np.min(np.linalg.eigvalsh(information)) <= 0.0:
        return errors
    covariance = np.linalg.inv(information)
    shapes = problem.shapes()
    for k, i in enumerate(inside):
        name = problem.free[i]
        rate = (
            problem.unit
            if name == "loc"
            else problem.values(theta)["scale"]
            if name == "scale"
            else abs(float(shapes[name].slope(theta[i])))
        )
        errors[name] = float(np.sqrt(covariance[k, k]) * rate)
    return errors


def profile_interval(
    values: ArrayLike,
    law: str | Law = "modulated_normal",
    name: str = "a",
    *,
    level: float = 0.95,
    loc: float | None = None,
    scale: float | None = None,
    shapes: Mapping[str, float] | None = None,
    lower_a: float | None = None,
) -> tuple[float, float]:
    """Return the profile-likelihood interval of a shape parameter.

    Parameters
    ----------
    values, law, loc, scale, shapes, lower_a
        As in `fit`.
    name : str
        The shape.
    level : float
        Confidence level.

    Returns
    -------
    tuple of float
        Lower and upper end; an end may be a bound of the parameter (a = inf: the normal law is not excluded).

    Notes
    -----
    The set where twice the loss of log-likelihood stays below the chi-square quantile with one degree of freedom; at a bound the
    interval covers at least its level.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> profile_interval(rng.standard_normal(200), loc=0.0)[1]
    inf
    """
    member = find_law(law) if isinstance(law, str) else law
    x = check_values(values)
    given = given_values(member, loc, scale, shapes)
    found = fit(x, member, loc=loc, scale=scale, shapes=shapes, lower_a=lower_a)
    if name not in found.estimated or name not in {s.name for s in member.free_shapes}:
        raise UsageError(f"{name} is not an estimated shape of {member.name}")
    sample = Sample.of(x, given.get("loc", float(np.mean(x))))
    full = _problem(member, sample, given, found.estimated, lower_a)
    shape = full.shapes()[name]
    i = full.free.index(name)
    low, high = full.bounds()[i]
    centre = full.coordinates(found.parameters)
    drop = 0.5 * float(special.chdtri(1, 1.0 - level)) / sample.n
    best = full.cost(centre)[0]

    def excess(u: float) -> float:
        rest = replace(full, given=dict(given) | {name: float(shape.from_unit(u))}, free=tuple(f for f in full.free if f != name))
        value = rest.minimise(np.delete(centre, i), polish=False)[1] if rest.free else rest.cost(np.zeros(0))[0]
        return value - best - drop

    ends = [_crossing(excess, float(centre[i]), bound) for bound in (low, high)]
    return tuple(sorted(float(shape.from_unit(u)) for u in ends))  # type: ignore[return-value]


def _crossing(function: Callable[[float], float], inside: float, bound: float) -> float:
    """Where the function turns positive between the estimate and a bound; the bound itself if it never does."""
    if inside == bound or function(bound) <= 0.0:
        return bound
    return float(optimize.brentq(function, inside, bound, xtol=1e-9))
