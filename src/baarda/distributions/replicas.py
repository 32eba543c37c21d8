"""Fitting a law to many simulated data sets at once: the inner loop of a parametric bootstrap."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from baarda.distributions.base import Distribution, Floats, Law
from baarda.distributions.likelihood import FREE_CENTRE_LOWER
from baarda.errors import UsageError

_ROUNDS = 40
_LOWEST = 1e-6  # coordinate of a shape whose limit is reached: a = 998, where the likelihood still has a slope


def refit_columns(member: Law, x: Floats, start: Distribution, given: Mapping[str, float]) -> tuple[dict[str, Floats], Floats]:
    """Fit a law to each column of an array by maximum likelihood.

    Parameters
    ----------
    member : Law
        The law.
    x : (n, B) array
        One data set per column.
    start : Distribution
        Where the search starts: the law that the data sets were drawn from.
    given : mapping
        Parameters that are not estimated.

    Returns
    -------
    parameters : dict of (B,) arrays
        All parameters by name.
    log_likelihood : (B,) array

    Notes
    -----
    Fisher scoring with the information matrix at the start, halved steps where the likelihood falls, and projection on the bounds;
    it stops at a hundredth of a standard error. Shapes that are expensive to vary are taken from a grid of 0.1 standard errors.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> x = np.array([[1.0, 2.0], [3.0, 6.0]])
    >>> refit_columns(law("normal"), x, law("normal")(), {})[0]["loc"]
    array([2., 4.])
    """
    if x.ndim != 2:
        raise UsageError(f"an array (n, B) is needed, not one of shape {x.shape}")
    free = tuple(name for name in member.parameter_names if name not in given)
    replicas = x.shape[1]
    values = {name: np.full(replicas, value) for name, value in (dict(member.fixed) | start.parameters | dict(given)).items()}
    cls = member.distribution
    if set(free) <= {"loc", "scale"}:
        closed = cls._closed_columns(x, given.get("loc"))
        if closed is not None:
            values |= {name: v for name, v in zip(("loc", "scale"), closed, strict=True) if name in free}
            return values, _log_likelihood(member, x, values)
    if not free:
        return values, _log_likelihood(member, x, values)
    return _scoring(member, x, values, free)


def profile_columns(member: Law, x: Floats, start: Distribution, given: Mapping[str, float], limit: Floats, steps: int = 8) -> Floats:
    """Return the largest log-likelihood of each column over a grid of the law's one free shape.

    Parameters
    ----------
    member : Law
        A law with one free shape, whose limit (coordinate 0) is another law.
    x : (n, B) array
    start, given
        As in `refit_columns`.
    limit : (B,) array
        Log-likelihood of the law that is the limit.
    steps : int
        Values of the shape beside the limit.

    Returns
    -------
    (B,) array

    Notes
    -----
    Few values often have two maxima, one at either bound of the shape, of which a search from one start finds one; both bounds are on the
    grid. A free centre is searched from the median of the column: the laws at the far bound are peaked there.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> x = np.random.default_rng(1).standard_t(3, (50, 2))
    >>> _, normal = refit_columns(law("normal"), x, law("normal")(), {})
    >>> wide = law("modulated_normal")
    >>> bool(np.all(profile_columns(wide, x, wide(a=4.0), {}, normal) >= normal))
    True
    """
    (shape,) = member.free_shapes
    if "loc" not in given:
        x, start = x - np.median(x, axis=0), member(**{**start.parameters, "loc": 0.0})
    high = shape.limits()[1]
    if shape.name == "a" and "loc" not in given:
        high = float(shape.to_unit(FREE_CENTRE_LOWER))
    grid = np.linspace(0.0, high, steps + 1)[1:]
    rows = [np.asarray(limit)]
    for value in shape.from_unit(grid).tolist():
        held = {**given, shape.name: value}
        rows.append(refit_columns(member, x, member(**{**start.parameters, shape.name: value}), held)[1])
    return np.asarray(np.max(rows, axis=0))


def columnwise(function: Callable[..., Any], cls: type[Distribution], z: Floats, shapes: tuple[Floats, ...]) -> Any:
    """Evaluate a function of (z, *shapes) on columns with a shape each, sharing the work of columns with equal shapes."""
    if not shapes:
        return function(z)
    if not cls.by_shape:
        return function(z, *shapes)
    table, place = np.unique(np.stack(shapes), axis=1, return_inverse=True)
    if table.shape[1] == 1:
        return function(z, *table[:, 0])
    out: Any = None
    for k in range(table.shape[1]):
        columns = np.flatnonzero(place == k)
        part = function(z[:, columns], *table[:, k])
        if out is None:
            out = _empty_like(part, z.shape)
        _put(out, columns, part)
    return out


def both_areas(cls: type[Distribution], z: Floats, shapes: tuple[Floats, ...]) -> tuple[Floats, Floats]:
    """Return F(z) and 1 - F(z) of columns; for a symmetric law one tail area gives both."""
    if not cls.symmetric:
        return columnwise(cls._cdf, cls, z, shapes), columnwise(cls._sf, cls, z, shapes)
    tail = np.asarray(columnwise(cls._sf, cls, np.abs(z), shapes))
    rest = 1.0 - tail
    above = z > 0.0
    return np.where(above, rest, tail), np.where(above, tail, rest)


def _empty_like(part: Any, shape: tuple[int, ...]) -> Any:
    return tuple(_empty_like(p, shape) for p in part) if isinstance(part, tuple) else np.empty(shape)


def _put(out: Any, columns: Any, part: Any) -> None:
    if isinstance(part, tuple):
        for o, p in zip(out, part, strict=True):
            _put(o, columns, p)
    else:
        out[:, columns] = part


def _log_likelihood(member: Law, x: Floats, values: Mapping[str, Floats]) -> Floats:
    cls = member.distribution
    z = (x - values["loc"]) / values["scale"]
    log_f = columnwise(cls._logpdf, cls, z, tuple(values[s.name] for s in cls.shapes))
    return np.asarray(np.sum(log_f, axis=0) - x.shape[0] * np.log(values["scale"]))


def _scoring(member: Law, x: Floats, values: dict[str, Floats], free: tuple[str, ...]) -> tuple[dict[str, Floats], Floats]:
    n, replicas = x.shape
    shapes = {s.name: s for s in member.free_shapes}
    unit, centre = values["scale"][0], values["loc"][0]
    theta = np.zeros((len(free), replicas))
    box = np.full((len(free), 2), (-np.inf, np.inf))
    for i, name in enumerate(free):
        if name in shapes:
            low, high = shapes[name].limits()
            if name == "a" and "loc" in free:
                high = float(shapes[name].to_unit(FREE_CENTRE_LOWER))
            box[i] = max(low, _LOWEST), high
            theta[i] = np.clip(shapes[name].to_unit(values[name]), *box[i])

    def expand(t: Floats) -> dict[str, Floats]:
        out = {name: np.full(t.shape[1], v[0]) for name, v in values.items()}
        for i, name in enumerate(free):
            out[name] = centre + unit * t[i] if name == "loc" else unit * np.exp(t[i]) if name == "scale" else shapes[name].from_unit(t[i])
        return out

    def evaluate(t: Floats, columns: Any) -> tuple[Floats, Floats, Floats]:
        """Mean log-likelihood, its gradient, and the mean outer product of the scores over all columns."""
        v = expand(t)
        cls = member.distribution
        z = (x[:, columns] - v["loc"]) / v["scale"]
        own = tuple(v[s.name] for s in cls.shapes)
        if shapes.keys().isdisjoint(free):
            log_f, score = columnwise(cls._log_and_score, cls, z, own)
            by_name = {}
        else:
            log_f, score, slopes = columnwise(cls._likelihood, cls, z, own)
            by_name = dict(zip((s.name for s in cls.shapes), slopes, strict=True))
        terms = []
        for i, name in enumerate(free):
            if name == "loc":
                terms.append(-score * (unit / v["scale"]))
            elif name == "scale":
                terms.append(-1.0 - z * score)
            else:
                terms.append(by_name[name] * shapes[name].slope(t[i]))
        gradient = np.array([np.mean(term, axis=0) for term in terms])
        information = np.array([[np.mean(p * q) for q in terms] for p in terms])
        return np.mean(log_f, axis=0) - np.log(v["scale"]), gradient, information

    value, gradient, information = evaluate(theta, slice(None))
    errors = np.sqrt(np.diag(np.linalg.inv(information)) / n)
    grid = {i: 0.1 * errors[i] for i, name in enumerate(free) if name in shapes and member.distribution.by_shape}
    active = np.arange(replicas)
    shrink = np.ones(replicas)
    for _ in range(_ROUNDS):
        step = _bounded_step(information, gradient[:, active], theta[:, active], box) * shrink[active]
        trial = theta[:, active] + step
        for i, h in grid.items():
            trial[i] = np.clip(np.rint(trial[i] / h) * h, *box[i])
        moved = np.max(np.abs(trial - theta[:, active]) / errors[:, None], axis=0)
        going = moved > 0.01
        active, trial = active[going], trial[:, going]
        if not active.size:
            break
        new_value, new_gradient, _ = evaluate(trial, active)
        better = new_value >= value[active]
        accepted = active[better]
        theta[:, accepted] = trial[:, better]
        value[accepted], gradient[:, accepted] = new_value[better], new_gradient[:, better]
        shrink[accepted] = np.minimum(1.0, 2.0 * shrink[accepted])
        shrink[active[~better]] *= 0.4
    return expand(theta), value * n


def _bounded_step(information: Floats, gradient: Floats, theta: Floats, box: Floats) -> Floats:
    """Scoring step; a coordinate that would leave its bounds stops there, and the others are solved again."""
    step = np.clip(np.linalg.solve(information, gradient), -0.5, 0.5)
    for i in range(len(theta)):
        if not np.isfinite(box[i]).any():
            continue
        clipped = np.clip(theta[i] + step[i], *box[i]) - theta[i]
        out = clipped != step[i]
        if not out.any():
            continue
        step[i] = clipped
        others = np.arange(len(theta)) != i
        if others.any():
            right = gradient[others][:, out] - information[others][:, [i]] * clipped[out]
            again = np.clip(np.linalg.solve(information[others][:, others], right), -0.5, 0.5)
            step[np.ix_(np.flatnonzero(others), np.flatnonzero(out))] = again
    for i in range(len(theta)):
        if np.isfinite(box[i]).any():
            step[i] = np.clip(theta[i] + step[i], *box[i]) - theta[i]
    return np.asarray(step)
