"""Laws of errors compared on one column of values: each fitted, judged on classes and by its distribution function, never only ranked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.distributions import law as find_law
from baarda.distributions.base import Floats, Law
from baarda.distributions.comparison import compare_laws
from baarda.distributions.fitting import Fit, fit, profile_interval
from baarda.distributions.histogram import Ends, check_edges, count, merge_small, probabilities, usual_number_of_classes
from baarda.errors import UsageError
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.goodness_of_fit import normal_against_modulated
from baarda.hypotheses.levels import Policy, applied_level, check_level
from baarda.procedures.law_bootstrap import EXACT, SIMULATED, ClassRule, ResidualsOf, empirical_tests

LAWS = ("normal", "radico", "lineo", "modulated_normal", "student", "laplace", "generalised_normal", "logistic", "contaminated_normal")
_FEWEST = 199
LEAST_WITH_SHAPE = 10

Classes = Literal["equal_probability", "equal_width"] | tuple[float, ...]


@dataclass(frozen=True)
class StudyOptions:
    """Levels and choices of a study of residuals.

    Attributes
    ----------
    alpha : float
        Level of each test.
    laws : tuple of str
        Laws to compare; with ``modulated_normal`` among them the normal is also tested against it.
    loc : float, optional
        Expectation of the residuals where it is known (0 for residuals without a systematic part); estimated when None.
    classes : {"equal_probability", "equal_width"} or tuple of float
        Classes of the chi-square tests, common to all laws: equally probable under the normal law, of equal width between three standard
        deviations on either side (steps of half a one), or limits in the unit of the residuals.
    number : int, optional
        Number of classes of the first two.
    ends : {"open", "closed"}
        Whether the outer classes reach to infinity; closed ones must cover all values and need limits.
    merge : float or None
        Merge classes until the normal law expects at least so many values in each; None leaves them.
    levels : str
        Policy for the family of the groups' variances, see `baarda.hypotheses.levels.Options`.
    interval : float
        Confidence level of the interval of a.
    replicas, seed : int
        Of the simulated null laws.
    numbers : float
        Errors that are simulated for each law where each replica goes through an adjustment; fewer replicas are made, or none, beyond.

    Raises
    ------
    UsageError
        If a value makes no sense.

    Examples
    --------
    >>> StudyOptions(laws=("normal", "student")).alpha
    0.05
    """

    alpha: float = 0.05
    laws: tuple[str, ...] = LAWS
    loc: float | None = None
    classes: Classes = "equal_probability"
    number: int | None = None
    ends: Ends = "open"
    merge: float | None = 5.0
    levels: Policy = "none"
    interval: float = 0.95
    replicas: int = 999
    seed: int = 0
    numbers: float = 4e7

    def __post_init__(self) -> None:
        check_level(self.alpha)
        check_level(self.interval, "interval")
        applied_level([0.5], self.alpha, self.levels)  # refuses an unknown policy
        if not self.laws:
            raise UsageError("no laws given to compare")
        for name in self.laws:
            find_law(name)
        if self.loc is not None and not np.isfinite(self.loc):
            raise UsageError(f"loc must be finite, not {self.loc}")
        if isinstance(self.classes, str):
            if self.classes not in ("equal_probability", "equal_width"):
                raise UsageError(f"classes are 'equal_probability', 'equal_width' or limits, not {self.classes!r}")
            if self.ends == "closed":
                raise UsageError("closed end classes need class limits")
        else:
            check_edges(self.classes)
        if self.ends not in get_args(Ends):
            raise UsageError(f"ends are 'open' or 'closed', not {self.ends!r}")
        if self.number is not None and self.number < 2:
            raise UsageError(f"{self.number} classes asked for: at least two are needed")
        if self.merge is not None and not self.merge > 0.0:
            raise UsageError(f"merge must be a positive expected count, not {self.merge}")
        if self.replicas < 1:
            raise UsageError(f"the number of replicas must be positive, not {self.replicas}")


@dataclass(frozen=True)
class LawStudy:
    """A law fitted to the values, with its tests.

    Attributes
    ----------
    fit : Fit
        Maximum likelihood, with the chi-square on the common classes and its asymptotic law.
    tests : tuple of TestResult
        Kolmogorov, Cramér-von Mises, Anderson-Darling and, where there are classes, chi-square, null laws by parametric bootstrap: through
        the design matrix where it is known and affordable, else for independent values; empty where they cannot be made.
    independent : tuple of TestResult
        The same tests with null laws for independent values, to be compared: the same as `tests` where there is no design matrix.
    """

    fit: Fit
    tests: tuple[TestResult, ...]
    independent: tuple[TestResult, ...] = ()

    def test(self, name: str, *, independent: bool = False) -> TestResult | None:
        """Return the test of this name."""
        return next((t for t in (self.independent if independent else self.tests) if t.name == name), None)


@dataclass(frozen=True)
class LawsStudied:
    """All laws on the same values.

    Attributes
    ----------
    laws : tuple of LawStudy
        In the order of the options.
    rounded : bool
        Whether the values repeat so much that tests of the distribution function cannot judge; the chi-square judges instead.
    adjusted : bool
        Whether the null laws of `tests` and of the likelihood ratio went through the design matrix.
    ratio : TestResult or None
        Likelihood ratio of the normal against the modulated normal law.
    modulated : Fit or None
        The modulated normal law fitted.
    interval : tuple of float or None
        Profile-likelihood interval of its a.
    left_out : tuple of (str, str)
        What could not be done, and why.
    """

    laws: tuple[LawStudy, ...]
    rounded: bool
    adjusted: bool = False
    ratio: TestResult | None = None
    modulated: Fit | None = None
    interval: tuple[float, float] | None = None
    left_out: tuple[tuple[str, str], ...] = ()

    def rejected(self, law: LawStudy) -> bool | None:
        """Return the decision on a law: by Anderson-Darling, for rounded values by chi-square; None where neither could be made."""
        test = law.test("anderson_darling")
        if test is None or self.rounded:
            return law.fit.rejected
        return bool(test.rejected)

    def judged_by(self, law: LawStudy) -> str:
        """Return the name of the test that decides."""
        return "chi_square" if self.rounded or law.test("anderson_darling") is None else "anderson_darling"

    @property
    def best(self) -> LawStudy | None:
        """The law with the smallest AIC, which alone decides nothing."""
        known = [law for law in self.laws if law.fit.aic is not None]
        return min(known, key=lambda law: law.fit.aic if law.fit.aic is not None else np.inf) if known else None

    @property
    def chi_square_ratios(self) -> dict[str, float]:
        """Maarek & Konecny's Fisher ratios of chi-square per degree of freedom to the smallest one, of the laws that it does not reject.

        Descriptive only: the chi-squares of one sample are dependent, their ratio does not follow F.
        """
        kept = {s.fit.law: s.fit.statistic / s.fit.df for s in self.laws if s.fit.rejected is False and s.fit.statistic and s.fit.df}
        return {name: value / min(kept.values()) for name, value in kept.items()}


def repeats(ordered: Floats) -> bool:
    """Return whether fewer than half of the sorted values are distinct: they were rounded.

    Examples
    --------
    >>> repeats(np.array([1.0, 1.0, 1.0, 2.0, 2.0])), repeats(np.array([1.0, 2.0, 2.0]))
    (True, False)
    """
    return bool(2 * (1 + np.count_nonzero(np.diff(ordered))) < len(ordered))


def class_limits(values: ArrayLike, options: StudyOptions) -> Floats:
    """Return the limits of the classes that all laws share.

    Parameters
    ----------
    values : (n,) array
        Values.
    options : StudyOptions

    Returns
    -------
    (k+1,) array
        Automatic limits among rounded values lie midway between two of them.

    Raises
    ------
    UsageError
        If closed classes do not cover the values, or fewer than two classes remain after merging.

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal(200)
    >>> class_limits(x, StudyOptions(number=4)).round(2)
    array([ -inf, -0.7 , -0.07,  0.55,   inf])
    """
    x = np.sort(np.asarray(values, dtype=float))
    mean, deviation = _location(x, options), float(np.std(x))
    if not isinstance(options.classes, str):
        edges = check_edges(options.classes)
    else:
        inner = wanted_limits(len(x), mean, deviation, options)
        edges = np.concatenate([[-np.inf], _between(inner, x) if repeats(x) else inner, [np.inf]])
        if len(edges) < 3:
            raise UsageError("the values repeat too much to be divided into classes")
    return merged(edges, count(x, edges, options.ends, is_sorted=True), mean, deviation, options)


def wanted_limits(n: int, mean: float, deviation: float, options: StudyOptions) -> Floats:
    """Return the inner limits of automatic classes of n values."""
    if options.classes == "equal_probability":
        # two more classes than the usual two estimated parameters need: one degree of freedom at least
        k = options.number or usual_number_of_classes(n, 2)
        return np.asarray(find_law("normal")(loc=mean, scale=deviation).ppf(np.arange(1, k) / k))
    if options.number is None:
        return mean + deviation * np.arange(-3.0, 3.1, 0.5)
    return np.linspace(mean - 3.0 * deviation, mean + 3.0 * deviation, options.number + 1)[1:-1]


def merged(edges: Floats, counts: NDArray[np.int64], mean: float, deviation: float, options: StudyOptions) -> Floats:
    """Return class limits after merging classes in which the normal law expects too few values."""
    if options.merge is None:
        return edges
    normal = find_law("normal")(loc=mean, scale=deviation)
    return merge_small(edges, counts, int(counts.sum()) * probabilities(normal, edges, options.ends), options.merge)[0]


def _location(values: Floats, options: StudyOptions) -> float:
    return float(np.mean(values)) if options.loc is None else float(options.loc)


def _between(inner: Floats, ordered: Floats) -> Floats:
    """Move limits midway between the two neighbouring values, so that rounding carries no value across a limit."""
    distinct = np.unique(ordered)
    at = np.searchsorted(distinct, inner)
    at = at[(at > 0) & (at < len(distinct))]
    return np.unique(0.5 * (distinct[at - 1] + distinct[at]))


def study_laws(values: ArrayLike, options: StudyOptions | None = None, residuals_of: ResidualsOf | None = None) -> LawsStudied:
    """Fit and test laws of errors on a column of values.

    Parameters
    ----------
    values : (n,) array
        Finite values, n at least 3, any unit; for an adjustment, residuals divided by their own standard deviations.
    options : StudyOptions, optional
    residuals_of : callable, optional
        Maps errors of unit variance, (n, B), to residuals standardised as `values` are. Without it the values count as independent.

    Returns
    -------
    LawsStudied
        A law that cannot be fitted or tested is in `left_out` with its reason.

    Raises
    ------
    UsageError
        If the classes do not cover the values.

    Notes
    -----
    Chi-square on common classes (Maarek & Konecny, tables 1 to 6), under its asymptotic law and by bootstrap; statistics of the
    distribution function by parametric bootstrap (Stute, Gonzáles Manteiga & Presedo Quindimil 1993); the normal is the bound a = inf of
    the modulated laws, so the null law of the likelihood ratio is simulated.

    Examples
    --------
    >>> x = np.random.default_rng(2).laplace(size=300)
    >>> found = study_laws(x, StudyOptions(laws=("normal", "laplace"), replicas=199))
    >>> [(s.fit.law, found.rejected(s)) for s in found.laws]
    [('normal', True), ('laplace', False)]
    """
    o = StudyOptions() if options is None else options
    x = np.sort(np.asarray(values, dtype=float))
    rounded = repeats(x)
    left_out: list[tuple[str, str]] = []
    try:
        edges: Floats | None = class_limits(x, o)
    except UsageError as error:
        if not isinstance(o.classes, str):
            raise
        edges = None
        left_out.append(("chi-square on classes", str(error)))
    replicas = _affordable(len(x), o, residuals_of)
    through = residuals_of if replicas else None
    if residuals_of is not None and through is None:
        left_out.append(
            ("tests by simulated adjustments", f"{len(x)} values are too many to simulate; null laws are for independent values")
        )
    x_given = np.asarray(values, dtype=float)

    def one(name: str) -> LawStudy | tuple[str, str]:
        member = find_law(name)
        least = LEAST_WITH_SHAPE if member.free_shapes else 3
        if len(x) < least:
            return f"law {name.replace('_', ' ')}", f"it needs at least {least} values"
        try:
            found = _fitted(x, member, edges, o)
            classes = None if edges is None else class_rule(x, edges, o, through is not None)
            drawn = replicas or o.replicas
            plain = empirical_tests(x, found, drawn, o.seed, o.alpha, classes=classes)
            tests = plain if through is None else empirical_tests(x_given, found, drawn, o.seed, o.alpha, through, classes)
        except UsageError as error:
            return f"law {name.replace('_', ' ')}", str(error)
        return LawStudy(found, tests, plain)

    done = [one(name) for name in o.laws]
    studied = [d for d in done if isinstance(d, LawStudy)]
    left_out += [d for d in done if isinstance(d, tuple)]
    made = LawsStudied(tuple(studied), rounded, through is not None, left_out=tuple(left_out))
    if "modulated_normal" not in o.laws:
        return made
    if len(x) < LEAST_WITH_SHAPE:
        return replace(made, left_out=(*made.left_out, ("normal against modulated", f"it needs at least {LEAST_WITH_SHAPE} values")))
    return _modulated(np.asarray(values, dtype=float), made, o, replicas or o.replicas, through)


def class_rule(x: Floats, edges: Floats, o: StudyOptions, adjusted: bool) -> ClassRule:
    """Return how class limits follow each simulated data set."""
    if isinstance(o.classes, str) or adjusted:
        return class_rule_of(edges, _location(x, o), float(np.std(x)), o)
    return ClassRule(edges, False, o.loc, o.ends)


def class_rule_of(edges: Floats, mean: float, deviation: float, o: StudyOptions) -> ClassRule:
    """Return how automatic class limits, found from mean and standard deviation, follow each simulated data set."""
    return ClassRule((edges - mean) / deviation, True, o.loc, o.ends)


def _fitted(x: Floats, member: Law, edges: Floats | None, o: StudyOptions) -> Fit:
    if edges is None:
        return replace(fit(x, member, loc=o.loc), alpha=o.alpha)
    return compare_laws(x, (member,), classes=edges, loc=o.loc, ends=o.ends, alpha=o.alpha)[0]


def _affordable(n: int, o: StudyOptions, residuals_of: ResidualsOf | None) -> int:
    """Return the number of replicas, 0 where so few are possible that no level could be kept."""
    if residuals_of is None:
        return o.replicas
    affordable = int(min(o.replicas, o.numbers // n))
    return affordable if affordable >= min(_FEWEST, o.replicas) else 0


def _modulated(x: Floats, made: LawsStudied, o: StudyOptions, replicas: int, residuals_of: ResidualsOf | None) -> LawsStudied:
    """Add the likelihood ratio of normal and modulated normal, and the interval of a."""
    known = {s.fit.law: s.fit for s in made.laws}
    try:
        normal = known.get("normal") or fit(x, "normal", loc=o.loc)
        wide = known.get("modulated_normal") or fit(x, "modulated_normal", loc=o.loc)
        interval = profile_interval(x, "modulated_normal", "a", level=o.interval, loc=o.loc)
        ratio = None
        if replicas and (len(x) <= EXACT or residuals_of is not None):
            ratio = normal_against_modulated(x, loc=o.loc, replicas=replicas, seed=o.seed, residuals_of=residuals_of, alpha=o.alpha)
        elif replicas:
            ratio = ratio_of_many(normal, wide, o)
    except UsageError as error:
        return replace(made, left_out=(*made.left_out, ("normal against modulated", str(error))))
    return replace(made, ratio=ratio, modulated=wide, interval=interval)


def ratio_of_many(normal: Fit, wide: Fit, o: StudyOptions) -> TestResult:
    """The likelihood ratio of many values under the null law of smaller samples: it depends neither on mean and scale nor, by now, on n."""
    reference = find_law("normal")().ppf((np.arange(SIMULATED) + 0.5) / SIMULATED)
    small = normal_against_modulated(reference, loc=None if o.loc is None else 0.0, replicas=o.replicas, seed=o.seed, alpha=o.alpha)
    statistic = max(0.0, 2.0 * ((wide.log_likelihood or 0.0) - (normal.log_likelihood or 0.0)))
    a = wide.parameters["a"]
    note = f"Null law by {o.replicas} simulated samples of {SIMULATED} independent normal values, seed {o.seed}."
    details = dict(small.details) | {"a": a if np.isfinite(a) else None}
    return replace(small, statistic=statistic, note=note, details=details)
