"""Fitting a law to class counts: minimum chi-square (the paper's M_P, S_P) and grouped likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from baarda.distributions import law as find_law
from baarda.distributions.base import Distribution, Floats, Law
from baarda.distributions.histogram import Ends, Histogram, check_edges, probabilities
from baarda.distributions.moments import shape_from_kurtosis
from baarda.distributions.result import Fit
from baarda.distributions.sample import given_values
from baarda.errors import UsageError


def fit_classes(
    counts: ArrayLike,
    edges: ArrayLike,
    law: str | Law = "modulated_normal",
    *,
    rule: Literal["minimum_chi2", "grouped_likelihood", "maximum_likelihood", "moments"] = "minimum_chi2",
    loc: float | None = None,
    scale: float | None = None,
    shapes: Mapping[str, float] | None = None,
    ends: Ends = "open",
    total: float | None = None,
    estimated: int | None = None,
    alpha: float = 0.05,
) -> Fit:
    """Fit a law to counts in classes, or judge one whose values are all given.

    Parameters
    ----------
    counts : (k,) array
        Observed counts.
    edges : (k+1,) array
        Class limits, ascending.
    law : str or Law
        The law.
    rule : str
        ``minimum_chi2``: minimises sum (F - T)^2 / T; ``grouped_likelihood`` (or ``maximum_likelihood``): maximises sum F log(T/n);
        ``moments``: of the class mids.
    loc, scale, shapes
        Given values; what is not given is estimated.
    ends : {"open", "closed"}
        Whether the outer classes reach to infinity; closed ones compare with the probability inside the outer limits only.
    total : float, optional
        The number of values that probabilities are multiplied with; default the sum of the counts.
    estimated : int, optional
        Number of parameters to subtract from the degrees of freedom where given values were themselves estimated from the same data;
        default the number estimated here.
    alpha : float
        Level of the chi-square test.

    Returns
    -------
    Fit
        With a histogram, degrees of freedom k - 1 - estimated, and a log-likelihood of the counts (without the multinomial constant)
        for the rule ``grouped_likelihood``.

    Raises
    ------
    UsageError
        If counts are negative, too few, or do not fit the limits; if a class with counts has probability zero.

    Notes
    -----
    Maarek & Konecny, method 2. The minimum of chi-square has k - 1 - p degrees of freedom (Fisher); values fitted to the ungrouped
    data make the true law lie between k - 1 - p and k - 1 (Chernoff & Lehmann 1954).

    Examples
    --------
    >>> found = fit_classes([10, 40, 40, 10], [-2, -1, 0, 1, 2], "normal", loc=0.0)
    >>> round(found.parameters["scale"], 3), round(found.statistic, 6)
    (0.780, 0.000000)
    """
    member = find_law(law) if isinstance(law, str) else law
    f, b = check_counts(counts, edges)
    given = given_values(member, loc, scale, shapes)
    free = tuple(name for name in member.parameter_names if name not in given)
    n = float(np.sum(f)) if total is None else float(total)
    if n <= 0.0:
        raise UsageError("all class counts are zero")
    if f.size - 1 < len(free):
        raise UsageError(f"{f.size} classes do not suffice to fit {len(free)} parameters ({', '.join(free)})")
    if rule == "maximum_likelihood":
        rule = "grouped_likelihood"
    start = _start(member, f, b, given)
    bounds: tuple[str, ...] = ()
    if rule == "moments" or not free:
        distribution = member.with_values(start)
    elif rule in ("minimum_chi2", "grouped_likelihood"):
        distribution, bounds = _search(member, f, b, given, free, start, rule, ends, n)
    else:
        raise UsageError(f"no rule named {rule!r} for classes")
    histogram = histogram_of(f, b, distribution, ends, n)
    p = len(free) if estimated is None else estimated
    log_likelihood = None
    if rule == "grouped_likelihood":
        log_likelihood = float(np.sum(special.xlogy(f, histogram.expected / n)))
    notes = tuple(f"{name} = {distribution.parameters[name]:g} is the bound of its range" for name in bounds)
    return Fit(
        member.name,
        distribution,
        rule if free else "given",
        free,
        round(float(np.sum(f))),
        log_likelihood,
        dict.fromkeys(free),
        histogram,
        f.size - 1 - p,
        alpha,
        bounds,
        notes,
    )


def histogram_of(
    counts: ArrayLike, edges: ArrayLike, distribution: Distribution, ends: Ends = "open", total: float | None = None
) -> Histogram:
    """Return the histogram with the counts that a law expects.

    Raises
    ------
    UsageError
        If a class is so improbable that its expected count underflows.

    Examples
    --------
    >>> histogram_of([5, 5], [-1.0, 0.0, 1.0], find_law("normal")()).expected
    array([5., 5.])
    """
    f, b = check_counts(counts, edges)
    n = float(np.sum(f)) if total is None else float(total)
    expected = n * probabilities(distribution, b, ends)
    if not np.all(expected > 0.0):
        j = int(np.argmin(expected))
        raise UsageError(
            f"the class from {b[j]:g} to {b[j + 1]:g} has probability zero under {distribution.family} {distribution.parameters}"
        )
    return Histogram(b, f, expected, ends, n)


def check_counts(counts: ArrayLike, edges: ArrayLike) -> tuple[Floats, Floats]:
    """Return counts and limits as arrays, or raise `UsageError`."""
    b = check_edges(edges)
    f = np.asarray(counts, dtype=float).ravel()
    if f.size != b.size - 1:
        raise UsageError(f"{f.size} counts do not fit {b.size} class limits ({b.size - 1} classes)")
    if not np.all(np.isfinite(f)) or np.any(f < 0.0):
        raise UsageError(
            f"class counts must be finite and not negative; class {int(np.argmin(np.where(np.isfinite(f), f, -np.inf))) + 1} is not"
        )
    return f, b


def _start(member: Law, f: Floats, b: Floats, given: Mapping[str, float]) -> dict[str, float]:
    """Moments of the class mids; an infinite outer class counts as wide as its neighbour."""
    limits = b.copy()
    if np.isinf(limits[0]):
        limits[0] = limits[1] - (limits[2] - limits[1] if b.size > 3 else 1.0)
    if np.isinf(limits[-1]):
        limits[-1] = limits[-2] + (limits[-2] - limits[-3] if b.size > 3 else 1.0)
    mids = 0.5 * (limits[1:] + limits[:-1])
    n = float(np.sum(f))
    mean = given.get("loc", float(np.sum(f * mids) / n))
    d2 = (mids - mean) ** 2
    variance = float(np.sum(f * d2) / n)
    if "scale" not in given and variance <= 0.0:
        raise UsageError("all counts are in one class: no scale can be fitted")
    values: dict[str, float] = dict(member.fixed) | {"loc": mean} | dict(given)
    unknown = [s for s in member.free_shapes if s.name not in given]
    for shape in unknown:
        values[shape.name] = shape.start
    if len(unknown) == 1 and variance > 0.0:
        value, at_bound = shape_from_kurtosis(member, unknown[0], float(np.sum(f * d2 * d2) / n / variance**2) - 3.0)
        values[unknown[0].name] = unknown[0].start if at_bound else value
    if "scale" not in given:
        unit = member.with_values(values | {"scale": 1.0}).std()
        values["scale"] = float(np.sqrt(variance)) / (unit if np.isfinite(unit) and unit > 0.0 else 1.0)
    return values


def _search(
    member: Law,
    f: Floats,
    b: Floats,
    given: Mapping[str, float],
    free: tuple[str, ...],
    start: Mapping[str, float],
    rule: str,
    ends: Ends,
    n: float,
) -> tuple[Distribution, tuple[str, ...]]:
    """Minimise the criterion over the free parameters as a sum of squares, from the start values and a few other shapes."""
    shapes = {s.name: s for s in member.free_shapes}
    unit, centre = start["scale"], start["loc"]

    def values(theta: Floats, names: tuple[str, ...], held: Mapping[str, float]) -> dict[str, float]:
        out: dict[str, float] = dict(member.fixed) | dict(given) | dict(held)
        for name, t in zip(names, theta, strict=True):
            if name == "loc":
                out[name] = centre + unit * float(t)
            elif name == "scale":
                out[name] = unit * float(np.exp(t))
            else:
                out[name] = float(shapes[name].from_unit(float(t)))
        return out

    def residuals(theta: Floats, names: tuple[str, ...], held: Mapping[str, float]) -> Floats:
        expected = n * probabilities(member.with_values(values(theta, names, held)), b, ends)
        expected = np.maximum(expected, 1e-280)  # keeps the search finite; a class that stays there is refused in the end
        if rule == "minimum_chi2":
            return (f - expected) / np.sqrt(expected)
        # signed roots of the deviance: half their sum of squares is -sum F log T + sum T, up to a constant
        deviance = 2.0 * (special.xlogy(f, f / expected) - (f - expected))
        return np.sign(f - expected) * np.sqrt(np.maximum(deviance, 0.0))

    def solve(theta: Floats, names: tuple[str, ...], held: Mapping[str, float]) -> tuple[float, dict[str, float], Floats]:
        if not names:
            r = residuals(theta, names, held)
            return float(r @ r), values(theta, names, held), theta
        box = [(-np.inf, np.inf) if name == "loc" else (-20.0, 20.0) if name == "scale" else shapes[name].limits() for name in names]
        low, high = np.array(box).T
        result = optimize.least_squares(
            residuals, np.clip(theta, low, high), bounds=(low, high), args=(names, held), jac="3-point", xtol=1e-12, ftol=1e-14, gtol=1e-12
        )
        return 2.0 * float(result.cost), values(result.x, names, held), np.asarray(result.x)

    seeds = [dict(start)]
    for name in free:
        if name in shapes:
            seeds += [dict(start) | {name: v} for v in shapes[name].usual_values()[1::2]]
    thetas = [np.array([0.0 if name in ("loc", "scale") else float(shapes[name].to_unit(seed[name])) for name in free]) for seed in seeds]
    best, found, theta = min((solve(t, free, {}) for t in thetas), key=lambda r: r[0])
    bounds: tuple[str, ...] = ()
    for i, name in enumerate(free):
        if name not in shapes:
            continue
        if shapes[name].upper_closed and theta[i] < 0.01:
            names = tuple(other for other in free if other != name)
            at_limit = solve(np.delete(theta, i), names, {name: shapes[name].upper})
            if at_limit[0] <= best + 1e-9:
                found, bounds = at_limit[1], (*bounds, name)
        elif min(abs(theta[i] - t) for t in shapes[name].limits()) < 2e-6:
            bounds = (*bounds, name)
    return member.with_values(found), bounds
