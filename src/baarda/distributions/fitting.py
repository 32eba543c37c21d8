"""Fitting a law to values: `fit`, and the profile-likelihood interval of a shape."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from baarda.distributions import law as find_law
from baarda.distributions.base import Floats, Law
from baarda.distributions.class_fitting import fit_classes
from baarda.distributions.condensed import Condensed
from baarda.distributions.histogram import check_edges, count
from baarda.distributions.likelihood import maximise, problem_of
from baarda.distributions.moments import moment_estimates
from baarda.distributions.result import Fit as Fit
from baarda.distributions.result import Rule
from baarda.distributions.sample import Sample, check_values, given_values
from baarda.errors import UsageError


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
    polish: bool = False,
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
    polish : bool
        Whether a maximum-likelihood fit to condensed values ends with one Newton step on all values (not on `Condensed`, which has none).

    Returns
    -------
    Fit

    Raises
    ------
    UsageError
        If values are missing, not finite, too few for the parameters, or all equal; if `polish` is asked for without the values or for
        another rule.

    Notes
    -----
    From 20 000 values on, the likelihood is summed over `Condensed` bins, first wide, then narrow ones: the estimates are within about
    1e-5 of a standard error of those from all values, and the polished ones closer still. The modulated normal's likelihood with a free
    mean is unbounded for a <= -1/2 and its location information infinite for a <= -1/4, hence the bound. Standard errors come from the
    observed information where log f is smooth, else from the outer products of the scores.

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
    if polish and (isinstance(values, Condensed) or rule != "maximum_likelihood"):
        raise UsageError("polish is a step of maximum likelihood on all values, not on condensed ones")
    if isinstance(values, Condensed):
        return _fit_sample(member, Sample.of_condensed(values), rule, loc, scale, shapes, lower_a)
    x = check_values(values)
    if rule in ("minimum_chi2", "grouped_likelihood"):
        if edges is None:
            raise UsageError(f"rule {rule} needs class limits (edges)")
        b = check_edges(edges)
        counts = count(x, b, ends)
        return fit_classes(counts, b, member, rule=rule, loc=loc, scale=scale, shapes=shapes, ends=ends, alpha=alpha)
    sample = Sample.of(x, float(np.mean(x)) if loc is None else float(loc))
    return _fit_sample(member, sample, rule, loc, scale, shapes, lower_a, x if polish and sample.source is not None else None)


def _fit_sample(
    member: Law,
    sample: Sample,
    rule: Rule,
    loc: float | None,
    scale: float | None,
    shapes: Mapping[str, float] | None,
    lower_a: float | None,
    values: Floats | None = None,
) -> Fit:
    given = given_values(member, loc, scale, shapes)
    free = tuple(name for name in member.parameter_names if name not in given)
    if sample.n <= len(free):
        raise UsageError(f"{sample.n} values do not suffice to fit {len(free)} parameters ({', '.join(free)})")
    if free and not np.ptp(sample.points) > 0.0:
        raise UsageError("all values are equal: no law can be fitted")
    if rule == "moments":
        found, bounds = moment_estimates(member, sample, given)
        distribution = member.with_values(found)
        return Fit(
            member.name, distribution, rule, free, sample.n, sample.log_likelihood(distribution), dict.fromkeys(free), at_bounds=bounds
        )
    if rule != "maximum_likelihood":
        raise UsageError(f"no rule named {rule!r} for these values")
    return maximise(member, sample, given, free, lower_a, values)


def profile_interval(
    values: ArrayLike | Condensed,
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
    given = given_values(member, loc, scale, shapes)
    if isinstance(values, Condensed):
        x: Floats | Condensed = values
        sample = Sample.of_condensed(values)
    else:
        x = check_values(values)
        sample = Sample.of(x, given.get("loc", float(np.mean(x))))
    found = fit(x, member, loc=loc, scale=scale, shapes=shapes, lower_a=lower_a)
    if name not in found.estimated or name not in {s.name for s in member.free_shapes}:
        raise UsageError(f"{name} is not an estimated shape of {member.name}")
    full = problem_of(member, sample, given, found.estimated, lower_a)
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
