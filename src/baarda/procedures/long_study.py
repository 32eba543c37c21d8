"""The study of a column of residuals too long for memory: one pass condenses it into bins, and everything else is found from these."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from baarda.distributions.base import Distribution, Floats
from baarda.distributions.class_fitting import fit_classes, histogram_of
from baarda.distributions.condensed import Condensed, condense_stream
from baarda.distributions.fitting import Fit, fit, profile_interval
from baarda.errors import UsageError
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.moments import moment_tests
from baarda.hypotheses.normality import jarque_bera_of_moments
from baarda.procedures.law_bootstrap import bootstrap_of_many
from baarda.procedures.law_study import LawsStudied, LawStudy, StudyOptions, class_rule_of, merged, ratio_of_many, wanted_limits
from baarda.procedures.residual_study import ResidualStudy, ScaleRule

REPRESENTATIVES = 100_000
_LEAST = 10_000
_NOTE = "Law for independent values of equal variance: approximate for residuals of an adjustment."


def study_long(
    chunks: Iterable[NDArray[np.generic]], options: StudyOptions | None = None, *, progress: Callable[[int], None] | None = None
) -> ResidualStudy:
    """Study a long column of residuals in one pass and constant memory.

    Parameters
    ----------
    chunks : iterable of (n,) arrays
        Finite residuals in one unit, 10 000 at least in all, for instance `baarda.formats.value_stream.open_values(file)`.
    options : StudyOptions, optional
        Classes must be automatic.
    progress : callable, optional
        Called after each chunk with the number of values read so far.

    Returns
    -------
    ResidualStudy
        `values` are 100 000 representatives, the ends among them, and `count` is the number of values.

    Raises
    ------
    UsageError
        If a value is not finite, there are too few, all are equal, or class limits are given.

    Notes
    -----
    Values are condensed into bins of 1/64 octave of their distance from the mean of the first chunk (`Condensed`). Likelihoods and moments
    are those of all values but for some 1e-11; class limits lie between bins, so that counts are exact; the statistics of the distribution
    function are taken at the limits of the bins, which makes Kolmogorov's up to a percent too small.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> found = study_long([rng.standard_normal(20_000) for _ in range(5)], StudyOptions(laws=("normal",), replicas=99))
    >>> found.n, found.gates["goodness_of_fit"]
    (100000, False)
    """
    o = StudyOptions() if options is None else options
    if not isinstance(o.classes, str):
        raise UsageError("a long column is studied on automatic classes")
    ends = [np.inf, -np.inf]

    def watched() -> Iterator[NDArray[np.generic]]:
        for chunk in chunks:
            if chunk.size:
                ends[0], ends[1] = min(ends[0], float(chunk.min())), max(ends[1], float(chunk.max()))
            yield chunk

    c = condense_stream(watched(), o.loc, progress=progress)
    if ends[0] == ends[1]:
        raise UsageError(f"all {c.n} residuals are equal ({ends[0]:g}): nothing can be tested")
    if c.n < _LEAST:
        raise UsageError(f"{c.n} residuals are few enough to be studied as they are")
    n, moments = c.n, _moments(c)
    about = (moments[0] - (o.loc or 0.0), *moments[1:])
    tests = [*moment_tests(n, about, o.alpha, _NOTE), jarque_bera_of_moments(n, moments[2], moments[3], o.alpha, note=_NOTE)]
    laws, rules = _laws(c, moments[:2], o)
    left_out = [("values one by one", "the column was read as a stream: groups, sigmas and redundancy numbers need it in memory")]
    values = _representatives(c, ends[0], ends[1])
    return ResidualStudy(
        o, values, "raw", values, 0, *moments, None, None, tuple(tests), None, rules, laws, None, (*left_out, *laws.left_out), n
    )


def _moments(c: Condensed) -> tuple[float, float, float, float]:
    """Mean, standard deviation, skewness and kurtosis."""
    n, mean = c.n, c.mean
    points, weights = c.points()
    d = points - (mean - c.centre)
    m2, m3, m4 = (float(np.sum(weights * d**k)) / n for k in (2, 3, 4))
    if not (m2 > 0.0 and np.isfinite(m4) and m4 > 0.0):
        raise UsageError("the residuals are too small or too large for their moments to be formed: choose another unit")
    return mean, float(np.sqrt(m2 * n / (n - 1.0))), m3 / m2**1.5, m4 / m2**2


def _laws(c: Condensed, moments: tuple[float, float], o: StudyOptions) -> tuple[LawsStudied, tuple[ScaleRule, ...]]:
    n, mean = c.n, moments[0] if o.loc is None else o.loc
    deviation = moments[1]
    left_out: list[tuple[str, str]] = []
    edges = _edges(c, mean, deviation, o)
    counts = None if edges is None else _counts(c, edges)
    if edges is None:
        left_out.append(("chi-square on classes", "the values repeat too much to be divided into classes"))
    studied = []
    for name in o.laws:
        try:
            found = replace(fit(c, name, loc=o.loc), alpha=o.alpha)
            classes = None
            if edges is not None and counts is not None:
                histogram = histogram_of(counts, edges, found.distribution, "open")
                found = replace(found, histogram=histogram, df=len(counts) - 1 - len(found.estimated))
                classes = class_rule_of(edges, mean, deviation, o)
            tests = bootstrap_of_many(binned_statistics(c, found.distribution), n, found, o.replicas, o.seed, o.alpha, classes)
        except UsageError as error:
            left_out.append((f"law {name.replace('_', ' ')}", str(error)))
            continue
        studied.append(LawStudy(found, tests, tests))
    made = LawsStudied(tuple(studied), 2 * c.repeated() > n, left_out=tuple(left_out))
    if "modulated_normal" in o.laws:
        made = _modulated(c, made, o)
    return made, _rules(n, counts, edges, mean, deviation, o)


def _modulated(c: Condensed, made: LawsStudied, o: StudyOptions) -> LawsStudied:
    known = {s.fit.law: s.fit for s in made.laws}
    try:
        normal, wide = (known.get(name) or fit(c, name, loc=o.loc) for name in ("normal", "modulated_normal"))
        interval = profile_interval(c, "modulated_normal", "a", level=o.interval, loc=o.loc)
        ratio: TestResult = ratio_of_many(normal, wide, o)
    except UsageError as error:
        return replace(made, left_out=(*made.left_out, ("normal against modulated", str(error))))
    return replace(made, ratio=ratio, modulated=wide, interval=interval)


def _rules(
    n: int, counts: NDArray[np.int64] | None, edges: Floats | None, mean: float, deviation: float, o: StudyOptions
) -> tuple[ScaleRule, ...]:
    if counts is None or edges is None:
        return ()
    used = 1 if o.loc is None else 0
    judged: Fit | None = fit_classes(counts, edges, "normal", loc=mean, scale=deviation, estimated=used + 1, alpha=o.alpha)
    rules = [ScaleRule("sample", "S_M", mean, deviation, judged)]
    if len(edges) - 2 > used:
        least = fit_classes(counts, edges, "normal", rule="minimum_chi2", loc=o.loc, alpha=o.alpha)
        rules.append(ScaleRule("minimum_chi2", "S_P", least.parameters["loc"], least.parameters["scale"], least))
    return tuple(rules)


def _edges(c: Condensed, mean: float, deviation: float, o: StudyOptions) -> Floats | None:
    """Class limits between bins, nearest to the wanted ones; None where fewer than two classes are left."""
    lower, upper, _ = c.ranges()
    between = np.unique(np.concatenate([lower, upper])) + c.centre
    wanted = wanted_limits(c.n, mean, deviation, o)
    at = np.clip(np.searchsorted(between, wanted), 1, len(between) - 1)
    nearest = np.where(wanted - between[at - 1] < between[at] - wanted, between[at - 1], between[at])
    edges = np.concatenate([[-np.inf], np.unique(nearest), [np.inf]])
    try:
        return merged(edges, _counts(c, edges), mean, deviation, o)
    except UsageError:
        return None


def _counts(c: Condensed, edges: Floats) -> NDArray[np.int64]:
    lower, upper, counts = c.ranges()
    place = np.searchsorted(edges[1:-1] - c.centre, 0.5 * (lower + upper))
    return np.bincount(place, counts, len(edges) - 1).astype(np.int64)


def binned_statistics(c: Condensed, distribution: Distribution) -> tuple[float, float, float]:
    """Return Kolmogorov's D, Cramér-von Mises' W^2 and Anderson-Darling's A^2 of condensed values.

    Parameters
    ----------
    c : Condensed
    distribution : Distribution
        The law with its values.

    Returns
    -------
    tuple of float
        As if the values of a bin were spread evenly in probability: a little too small, by less than the share of the largest bin.

    Notes
    -----
    Between the limits of the bins the difference d of the distribution functions is taken as linear in u = F(x), and the integrals of d^2
    and d^2 / (u (1 - u)) are those of the straight line.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> from baarda.distributions.condensed import condense
    >>> from baarda.hypotheses.goodness_of_fit import empirical_statistics
    >>> x, normal = np.sort(np.random.default_rng(3).standard_normal(50_000)), law("normal")()
    >>> np.round(np.array(binned_statistics(condense(x), normal)) / empirical_statistics(normal.cdf(x), normal.sf(x)), 1)
    array([1., 1., 1.])
    """
    lower, upper, counts = c.ranges()
    n = float(counts.sum())
    after = np.cumsum(counts) / n
    x = np.stack([lower, upper], axis=1).ravel() + c.centre
    step = np.stack([np.concatenate([[0.0], after[:-1]]), after], axis=1).ravel()
    u, v = np.asarray(distribution.cdf(x)), np.asarray(distribution.sf(x))
    d = np.where(u < 0.5, step - u, (v - 1.0) + step)
    u, v, d = (np.concatenate([[first], inside, [last]]) for first, inside, last in ((0.0, u, 1.0), (1.0, v, 0.0), (0.0, d, 0.0)))
    width = np.where(u[1:] < 0.5, np.diff(u), -np.diff(v))
    some = width > 0.0
    u0, u1, v0, v1, d0, d1, width = u[:-1][some], u[1:][some], v[:-1][some], v[1:][some], d[:-1][some], d[1:][some], width[some]
    squares = float(np.sum(width * (d0 * d0 + d0 * d1 + d1 * d1)) / 3.0)
    at_zero, at_one, slope = (d0 * u1 - d1 * u0) / width, (d1 * v0 - d0 * v1) / width, (d1 - d0) / width
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.where(at_zero == 0.0, 0.0, at_zero**2 * np.log(u1 / u0))
        last = np.where(at_one == 0.0, 0.0, at_one**2 * np.log(v0 / v1))
    first, last = np.where(u0 == 0.0, 0.0, first), np.where(v1 == 0.0, 0.0, last)  # there the line starts, or ends, at zero
    weighted = float(np.sum(first + last - slope**2 * width))
    return float(np.abs(d).max()), n * squares, n * max(weighted, 0.0)


def _representatives(c: Condensed, low: float, high: float) -> Floats:
    """Values at equal steps of the distribution function, which rises evenly within each bin; the ends as they are."""
    lower, upper, counts = c.ranges()
    after = np.cumsum(counts)
    q = (np.arange(REPRESENTATIVES) + 0.5) / REPRESENTATIVES * after[-1]
    k = np.minimum(np.searchsorted(after, q), len(after) - 1)
    share = (q - (after[k] - counts[k])) / counts[k]
    out = np.clip(c.centre + lower[k] + share * (upper[k] - lower[k]), low, high)
    out[0], out[-1] = low, high
    out.flags.writeable = False
    return np.asarray(out)
