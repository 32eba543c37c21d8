"""Goodness of fit of a law of errors: chi-square on classes, Kolmogorov, Cramér-von Mises, Anderson-Darling, normal against modulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import special, stats

from baarda.distributions import law as find_law
from baarda.distributions.base import Distribution, Law
from baarda.distributions.class_fitting import check_counts, histogram_of
from baarda.distributions.fitting import fit
from baarda.distributions.histogram import (
    Ends,
    check_edges,
    count,
    equal_probability_edges,
    equal_width_edges,
    merge_small,
    usual_number_of_classes,
)
from baarda.distributions.replicas import both_areas, profile_columns, refit_columns
from baarda.distributions.result import Fit
from baarda.distributions.sample import check_values
from baarda.errors import UsageError
from baarda.hypotheses._simulation import controlled, shares, simulate, skipped_note
from baarda.hypotheses.base import Evidence, Floats, SimulatedLaw, TestResult
from baarda.hypotheses.levels import Options, check_level

__all__ = [
    "anderson_darling",
    "chi_square",
    "chi_square_on_classes",
    "cramer_von_mises",
    "empirical_statistics",
    "kolmogorov",
    "normal_against_modulated",
]

ORDER = 25
_CHUNK = 4_000_000  # simulated values held at a time
_STATISTICS = ("kolmogorov", "cramer_von_mises", "anderson_darling")
_TWO_MAXIMA = 400  # values up to which the likelihood of a may have a maximum near either end
ResidualsOf = Callable[[Floats], Floats]


def chi_square_on_classes(
    counts: ArrayLike,
    edges: ArrayLike,
    distribution: Distribution,
    *,
    estimated: int = 0,
    ends: Ends = "open",
    total: float | None = None,
    merge: float | None = None,
    alpha: float = 0.05,
) -> TestResult:
    """Test the hypothesis that class counts come from a law.

    Parameters
    ----------
    counts : (k,) array
        Observed counts.
    edges : (k+1,) array
        Class limits, ascending.
    distribution : Distribution
        The law with its values.
    estimated : int
        Number of its parameters that were estimated from these data.
    ends : {"open", "closed"}
        Whether the outer classes reach to infinity.
    total : float, optional
        Number of values, default the sum of the counts.
    merge : float, optional
        Merge classes, from the least expected one on, until each expects at least so many values.
    alpha : float
        Level.

    Returns
    -------
    TestResult
        Chi-square with k - 1 - `estimated` degrees of freedom; `details` has limits, counts, expected counts and contributions.

    Raises
    ------
    UsageError
        If classes and counts do not fit, a count is negative, or no degree of freedom is left.

    Notes
    -----
    K. Pearson 1900. If parameters were estimated from the single values, the law lies between k - 1 - p and k - 1 degrees of freedom
    (Chernoff & Lehmann 1954).

    Examples
    --------
    >>> from baarda.distributions import law
    >>> result = chi_square_on_classes([30, 70, 80, 20], [-2, -1, 0, 1, 2], law("normal")(), alpha=0.05)
    >>> round(result.statistic, 3), result.df
    (6.491, (3.0,))
    """
    check_level(alpha)
    f, b = check_counts(counts, edges)
    histogram = histogram_of(f, b, distribution, ends, total)
    b, f, t = (histogram.edges, histogram.counts, histogram.expected) if merge is None else merge_small(b, f, histogram.expected, merge)
    df = f.size - 1 - estimated
    if df < 1:
        raise UsageError(f"{f.size} classes and {estimated} estimated parameters leave no degree of freedom")
    terms = (f - t) ** 2 / t
    details = {
        "edges": [float(v) if np.isfinite(v) else None for v in b],
        "counts": f.tolist(),
        "expected": t.tolist(),
        "terms": terms.tolist(),
        "ends": ends,
    }
    merged = "" if f.size == histogram.counts.size else f"; {histogram.counts.size} classes merged to {f.size}"
    return TestResult(
        "chi_square_on_classes",
        f"The values follow the law {_spoken(distribution)}.",
        float(np.sum(terms)),
        stats.chi2(df),
        f"chi2({df})",
        alpha,
        df=(float(df),),
        note=f"{f.size} classes, {ends} ends, {estimated} estimated parameters{merged}. Asymptotic law for independent values.",
        details=details,
    )


def chi_square(
    values: ArrayLike,
    law: str | Law = "normal",
    *,
    classes: Literal["equal_probability", "equal_width"] | ArrayLike = "equal_probability",
    number: int | None = None,
    loc: float | None = None,
    scale: float | None = None,
    shapes: Mapping[str, float] | None = None,
    ends: Ends = "open",
    merge: float | None = 5.0,
    alpha: float = 0.05,
) -> TestResult:
    """Test by chi-square on classes that values follow a law, fitted by maximum likelihood where parameters are not given.

    Parameters
    ----------
    values : (n,) array
        Values.
    law : str or Law
        The law.
    classes : str or (k+1,) array
        Equally probable classes, classes of equal width over the range of the values, or class limits.
    number : int, optional
        Number of classes of the first two; default about 2 n^(2/5).
    loc, scale, shapes
        Given parameter values; what is not given is fitted and subtracted from the degrees of freedom.
    ends, merge, alpha
        As in `chi_square_on_classes`.

    Returns
    -------
    TestResult

    Raises
    ------
    UsageError
        If the values cannot be classed or fitted.

    Examples
    --------
    >>> x = np.random.default_rng(2).laplace(size=500)
    >>> bool(chi_square(x, "normal").rejected), bool(chi_square(x, "laplace").rejected)
    (True, False)
    """
    x = check_values(values)
    found = fit(x, law, loc=loc, scale=scale, shapes=shapes)
    k = usual_number_of_classes(x.size, len(found.estimated)) if number is None else number
    if isinstance(classes, str):
        if classes == "equal_probability":
            b = equal_probability_edges(found.distribution, k)
        elif classes == "equal_width":
            b = equal_width_edges(x, k)
        else:
            raise UsageError(f"classes are 'equal_probability', 'equal_width' or limits, not {classes!r}")
    else:
        b = check_edges(classes)
    return chi_square_on_classes(
        count(x, b, ends), b, found.distribution, estimated=len(found.estimated), ends=ends, merge=merge, alpha=alpha
    )


def empirical_statistics(lower: Floats, upper: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the statistics of the empirical distribution function.

    Parameters
    ----------
    lower, upper : (n,) or (n, B) arrays
        F(x) and 1 - F(x) of the sorted values, columns for data sets.

    Returns
    -------
    tuple of three arrays or floats
        Kolmogorov's D, Cramér-von Mises W^2, Anderson-Darling A^2.

    Notes
    -----
    M. A. Stephens, J. Am. Stat. Ass. 69 (1974) 730-737.

    Examples
    --------
    >>> u = (np.arange(1, 5) - 0.5) / 4
    >>> [round(float(t), 4) for t in empirical_statistics(u, 1 - u)]
    [0.125, 0.0208, 0.1533]
    """
    n = lower.shape[0]
    i = np.arange(1, n + 1, dtype=float).reshape((n,) + (1,) * (lower.ndim - 1))
    d = np.maximum(np.max(i / n - lower, axis=0), np.max(lower - (i - 1.0) / n, axis=0))
    w = np.sum((lower - (2.0 * i - 1.0) / (2.0 * n)) ** 2, axis=0) + 1.0 / (12.0 * n)
    tiny = np.finfo(float).tiny  # an area that underflows counts as the smallest number: the statistic is huge, not infinite
    a = -n - np.sum((2.0 * i - 1.0) * (np.log(np.maximum(lower, tiny)) + np.log(np.maximum(upper[::-1], tiny))), axis=0) / n
    return d, w, a


def kolmogorov(values: ArrayLike, law: str | Law = "normal", **options: Any) -> TestResult:
    """Test by the largest distance of distribution functions that values follow a law; parameters and options of `anderson_darling`.

    Examples
    --------
    >>> x = np.random.default_rng(2).standard_normal(80)
    >>> bool(kolmogorov(x, replicas=199).rejected)
    False
    """
    return _test("kolmogorov", values, law, **options)


def cramer_von_mises(values: ArrayLike, law: str | Law = "normal", **options: Any) -> TestResult:
    """Test by the mean squared distance of distribution functions that values follow a law; options of `anderson_darling`.

    Examples
    --------
    >>> x = np.random.default_rng(2).standard_normal(80)
    >>> bool(cramer_von_mises(x, replicas=199).rejected)
    False
    """
    return _test("cramer_von_mises", values, law, **options)


def anderson_darling(values: ArrayLike, law: str | Law = "normal", **options: Any) -> TestResult:
    """Test by the squared distance of distribution functions, weighted for the tails, that values follow a law.

    Parameters
    ----------
    values : (n,) array
        Values; for an adjustment, residuals divided by their own standard deviations.
    law : str or Law
        The law; parameters that are not given are fitted by maximum likelihood, in the data and in each replica.
    loc, scale : float, optional
        Given values.
    shapes : mapping, optional
        Given shape values.
    replicas : int
        Number B of simulated data sets, default 999.
    seed : int
        Seed; replica k uses its child k.
    residuals_of : callable, optional
        Maps errors of unit variance, (n, B), to residuals standardised as `values` are, (n, B). Without it the values count as
        independent.
    errors : Distribution, optional
        Law of the errors that are simulated with `residuals_of`; default the law fitted to the values.
    alpha : float
        Level.

    Returns
    -------
    TestResult
        With the simulated law of the statistic: p = (1 + number of T* >= T) / (B + 1).

    Raises
    ------
    UsageError
        If the values cannot be fitted, or `residuals_of` changes the shape.

    Notes
    -----
    Parametric bootstrap (Stute, Gonzáles Manteiga & Presedo Quindimil 1993). For residuals of an adjustment and the normal law with given
    shape the p-value is exact; with a fitted shape it is approximate, since the residuals are more normal than the errors.

    Examples
    --------
    >>> x = np.random.default_rng(2).laplace(size=200)
    >>> result = anderson_darling(x, "normal", replicas=199)
    >>> result.p_value, bool(result.rejected)
    (0.005, True)
    """
    return _test("anderson_darling", values, law, **options)


def _test(
    name: str,
    values: ArrayLike,
    law: str | Law,
    *,
    loc: float | None = None,
    scale: float | None = None,
    shapes: Mapping[str, float] | None = None,
    replicas: int = 999,
    seed: int = 0,
    residuals_of: ResidualsOf | None = None,
    errors: Distribution | None = None,
    alpha: float = 0.05,
) -> TestResult:
    check_level(alpha)
    member = find_law(law) if isinstance(law, str) else law
    x = check_values(values)
    found = fit(x, member, loc=loc, scale=scale, shapes=shapes)
    which = _STATISTICS.index(name)
    given = {k: v for k, v in found.parameters.items() if k not in found.estimated and k in member.parameter_names}

    def of_columns(columns: Floats) -> Floats:
        columns = np.sort(columns, axis=0)
        parameters, _ = refit_columns(member, columns, found.distribution, given)
        cls = member.distribution
        z = (columns - parameters["loc"]) / parameters["scale"]
        own = tuple(parameters[s.name] for s in cls.shapes)
        return empirical_statistics(*both_areas(cls, z, own))[which]

    statistic, null = _simulated(x, found.distribution, errors, residuals_of, replicas, seed, of_columns)
    return TestResult(
        name,
        f"The values follow the law {member.name}{_estimated(found)}.",
        statistic,
        SimulatedLaw(null),
        f"simulated, B = {replicas}",
        alpha,
        note=_note(residuals_of, found, seed),
        details={"parameters": {k: v if np.isfinite(v) else None for k, v in found.parameters.items()}, "estimated": list(found.estimated)},
    )


def normal_against_modulated(
    values: ArrayLike,
    *,
    loc: float | None = None,
    scale: float | None = None,
    replicas: int = 999,
    seed: int = 0,
    residuals_of: ResidualsOf | None = None,
    alpha: float = 0.05,
) -> TestResult:
    """Test the normal law against the modulated normal laws by the likelihood ratio.

    Parameters
    ----------
    values, loc, scale, replicas, seed, residuals_of, alpha
        As in `anderson_darling`.

    Returns
    -------
    TestResult
        Statistic 2 (log L modulated - log L normal), zero where a = inf fits best, with its law simulated under the normal.

    Raises
    ------
    UsageError
        If the values cannot be fitted.

    Notes
    -----
    The normal is the bound a = inf of the family, and the best a is infinite in more than half of all normal samples: the statistic is
    not chi-square, hence the simulation. Values and simulated values are searched in the same way, so that the level holds; with a free
    mean the search may stop some tenths short of the maximum of `fit`.

    Examples
    --------
    >>> x = np.random.default_rng(5).standard_normal(100)
    >>> bool(normal_against_modulated(x, replicas=99).rejected)
    False
    """
    check_level(alpha)
    x = check_values(values)
    normal, wide = find_law("normal"), find_law("modulated_normal")
    found = fit(x, normal, loc=loc, scale=scale)
    best = fit(x, wide, loc=loc, scale=scale).parameters["a"]
    given = {k: v for k, v in (("loc", loc), ("scale", scale)) if v is not None}
    # the search starts between the normal and lineo, so that both ends are near
    begin = wide(a=4.0, loc=found.parameters["loc"], scale=found.parameters["scale"])

    def of_columns(columns: Floats) -> Floats:
        _, narrow = refit_columns(normal, columns, found.distribution, given)
        _, broad = refit_columns(wide, columns, begin, given)
        if len(x) <= _TWO_MAXIMA:
            broad = np.maximum(broad, profile_columns(wide, columns, begin, given, narrow))
        return np.maximum(0.0, 2.0 * (broad - narrow))  # the normal is the bound a = inf of the family: never below it

    statistic, null = _simulated(x, found.distribution, None, residuals_of, replicas, seed, of_columns)
    return TestResult(
        "normal_against_modulated",
        "The values are normal (a = infinity), not modulated normal with a finite a.",
        statistic,
        SimulatedLaw(null),
        f"simulated, B = {replicas}",
        alpha,
        note=_note(residuals_of, found, seed),
        details={"a": best if np.isfinite(best) else None, "zero_share": float(np.mean(null <= 1e-9))},
    )


def _simulated(
    values: Floats,
    fitted: Distribution,
    errors: Distribution | None,
    residuals_of: ResidualsOf | None,
    replicas: int,
    seed: int,
    statistic: Callable[[Floats], Floats],
) -> tuple[float, Floats]:
    """The statistic of the values and, sorted, that of B simulated data sets, all found by the same search."""
    law = fitted if errors is None else errors
    unit = float(law._moments(*law.shape_values)[1]) ** 0.5
    if residuals_of is not None and not np.isfinite(unit):
        raise UsageError(f"errors of law {law.family} have no variance: they cannot be mapped to residuals")
    parts: list[Floats] = []
    for z in _draws(law, values.size, replicas, seed):
        if residuals_of is None:
            columns = fitted.loc + fitted.scale * z
        else:
            columns = np.asarray(residuals_of(z / unit), dtype=float)
            if columns.shape != z.shape:
                raise UsageError(f"residuals_of maps {z.shape} to {columns.shape}; it must keep the shape")
        parts.append(statistic(columns if parts else np.column_stack([values, columns])))
    found = np.concatenate(parts)
    return float(found[0]), np.sort(found[1:])


def _draws(law: Distribution, n: int, replicas: int, seed: int) -> Iterator[Floats]:
    """Standard errors in chunks of columns; replica k uses child k of the seed."""
    if replicas < 1:
        raise UsageError(f"the number of replicas must be positive, not {replicas}")
    children = np.random.SeedSequence(seed).spawn(replicas)
    width = max(1, _CHUNK // n)
    for start in range(0, replicas, width):
        chunk = children[start : start + width]
        z = np.empty((n, len(chunk)))
        for k, child in enumerate(chunk):
            z[:, k] = law._rvs(np.random.default_rng(child), n, *law.shape_values)
        yield z


def _spoken(distribution: Distribution) -> str:
    values = ", ".join(f"{name} = {value:.6g}" for name, value in distribution.parameters.items())
    return f"{distribution.family} ({values})"


def _estimated(found: Fit) -> str:
    return f" (fitted: {', '.join(found.estimated)})" if found.estimated else ""


def _note(residuals_of: ResidualsOf | None, found: Fit, seed: int) -> str:
    if residuals_of is None:
        return f"Parametric bootstrap for independent values, seed {seed}: not valid for residuals of an adjustment."
    kind = "approximate, since a shape is fitted" if set(found.estimated) - {"loc", "scale"} else "exact for this null hypothesis"
    return f"Parametric bootstrap through the design matrix, seed {seed}: {kind}."


def simulated_statistic(evidence: Evidence, options: Options) -> Callable[[Floats], Floats] | None:
    """Return the statistic that is simulated: Anderson-Darling's, on residuals divided by their own standard deviations."""
    seen = controlled(evidence)
    if seen.sum() < 8 or evidence.vpv <= 0.0:
        return None
    own = np.sqrt(shares(evidence)[seen])[:, None]
    return lambda v: _normal_statistic(v[seen] / own)


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the Anderson-Darling test of normal errors on residuals standardised by their own sigma."""
    seen, statistic = controlled(evidence), simulated_statistic(evidence, options)
    if statistic is None or np.ptp((x := evidence.residuals / evidence.sigmas)[seen] / np.sqrt(shares(evidence)[seen])) == 0.0:
        return []
    null = simulate(evidence, "goodness_of_fit", statistic, options)
    if null is None:
        return []
    replicas = len(null)
    fewer = f" (fewer than {options.replicas}: {seen.size} observations)" if replicas < options.replicas else ""
    return [
        TestResult(
            "goodness_of_fit",
            "The errors of the observations are normal.",
            float(statistic(x[:, None])[0]),
            SimulatedLaw(np.sort(null)),
            f"simulated, B = {replicas}",
            options.global_level(1),
            note=f"Anderson-Darling on {int(seen.sum())} residuals, each divided by its own standard deviation; null law by {replicas} "
            f"simulated adjustments of normal errors{fewer}, seed {options.seed}." + skipped_note(int((~seen).sum())),
            details={"method": "anderson_darling"},
        )
    ]


def _normal_statistic(columns: Floats) -> Floats:
    """Anderson-Darling's statistic of each column for the normal law with mean zero and the column's own scale."""
    z = np.sort(columns, axis=0) / np.sqrt(np.mean(columns**2, axis=0))
    tail = special.ndtr(-np.abs(z))  # four times as fast as the law itself, which keeps its last digits far out in the tails
    rest = 1.0 - tail
    above = z > 0.0
    return empirical_statistics(np.where(above, rest, tail), np.where(above, tail, rest))[2]
