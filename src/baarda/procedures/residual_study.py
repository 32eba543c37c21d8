"""The study of a column of residuals after Maarek & Konecny: moments, homogeneity of groups, scale rules, laws of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.distributions.base import Floats
from baarda.distributions.class_fitting import fit_classes
from baarda.distributions.fitting import Fit
from baarda.distributions.histogram import count
from baarda.errors import UsageError
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.moments import kurtosis_of_residuals, mean_of_residuals, skewness_of_residuals
from baarda.hypotheses.normality import jarque_bera
from baarda.hypotheses.variance_factor import global_variance_factor
from baarda.procedures.group_study import UNCONTROLLED, Groups, coded, study_groups
from baarda.procedures.law_bootstrap import ResidualsOf
from baarda.procedures.law_study import LawsStudied, StudyOptions, class_limits, study_laws

LEAST = 3
_LEAST_JARQUE_BERA = 8
_SIMULATED = 4e7  # values for the null law of Jarque and Bera; beyond it is asymptotic
_ROUNDING = 1e-9  # of redundancy numbers that another program printed

Kind = Literal["raw", "weighted", "standardised"]


@dataclass(frozen=True)
class ScaleRule:
    """A normal law whose standard deviation was found by one of the four rules, with its chi-square on classes.

    Attributes
    ----------
    name : {"sample", "redundancy", "standardised", "minimum_chi2"}
    symbol : str
        S_M, S_o, Q_v, S_P: the paper's names.
    mean, deviation : float
    fit : Fit or None
        With histogram and degrees of freedom; None where no classes could be formed.
    described : bool
        Whether the rule is for description only: S_o divides raw residuals by the redundancy, so that even truly normal errors are
        rejected in about half of all cases. Such a rule has no p-value.
    """

    name: str
    symbol: str
    mean: float
    deviation: float
    fit: Fit | None
    described: bool = False

    @property
    def p_value(self) -> float | None:
        """Exceedance probability of the chi-square; None where the rule is descriptive."""
        return None if self.fit is None or self.described else self.fit.p_value

    @property
    def rejected(self) -> bool | None:
        """Decision of the chi-square test; None where the rule is descriptive."""
        return None if self.fit is None or self.described else self.fit.rejected


@dataclass(frozen=True)
class ResidualStudy:
    """Everything that a column of residuals tells.

    Attributes
    ----------
    options : StudyOptions
    values : (n,) array
        The values studied; read-only.
    kind : {"raw", "weighted", "standardised"}
        Residuals as given; divided by their a-priori sigmas; divided by their own standard deviations s0 sigma sqrt(r).
    base : (n,) array
        Raw or weighted residuals of the same rows.
    set_aside : int
        Rows whose redundancy number is below 1e-10: no other observation controls them.
    mean, deviation, skewness, kurtosis : float
        Of `values`.
    redundancy : float or None
        Sum of the redundancy numbers.
    sigma0 : float or None
        A-posteriori standard deviation of unit weight.
    tests : tuple of TestResult
        Global test (with sigmas and redundancy numbers), mean, skewness, kurtosis, Jarque-Bera.
    groups : Groups or None
    scale_rules : tuple of ScaleRule
    laws : LawsStudied
    a_of_errors : float or None
        Approximate a of the errors behind modulated residuals; description only.
    left_out : tuple of (str, str)
        What could not be done, and why.
    count : int
        Number of values where `values` are but representatives of a long column; 0 where they are all there is.
    """

    options: StudyOptions
    values: Floats
    kind: Kind
    base: Floats
    set_aside: int
    mean: float
    deviation: float
    skewness: float
    kurtosis: float
    redundancy: float | None
    sigma0: float | None
    tests: tuple[TestResult, ...]
    groups: Groups | None
    scale_rules: tuple[ScaleRule, ...]
    laws: LawsStudied
    a_of_errors: float | None
    left_out: tuple[tuple[str, str], ...]
    count: int = 0

    @property
    def n(self) -> int:
        """The number of values studied."""
        return self.count or len(self.values)

    def test(self, name: str) -> TestResult | None:
        """Return the test of this name."""
        return next((t for t in self.tests if t.name == name), None)

    @property
    def gates(self) -> dict[str, bool]:
        """What ``--strict`` asks: True where a test rejects."""
        out = {t.name: bool(t.rejected) for t in self.tests if t.name in ("global_variance_factor", "mean_of_residuals")}
        homogeneity = None if self.groups is None else self.groups.test("bartlett")
        if homogeneity is not None:
            out["bartlett"] = bool(homogeneity.rejected)
        normal = next((s for s in self.laws.laws if s.fit.law == "normal"), None)
        decision = None if normal is None else self.laws.rejected(normal)
        return out if decision is None else {**out, "goodness_of_fit": decision}


def study(
    values: ArrayLike,
    groups: Sequence[object] | NDArray[Any] | None = None,
    sigmas: ArrayLike | None = None,
    redundancy: ArrayLike | None = None,
    options: StudyOptions | None = None,
    *,
    group_names: Sequence[str] = (),
    residuals_of: ResidualsOf | None = None,
) -> ResidualStudy:
    """Study a column of residuals.

    Parameters
    ----------
    values : (n,) array
        Residuals, n at least 3, in one unit (in the units of their sigmas where these are given).
    groups : (n,) sequence, optional
        Group of each residual: labels, or codes into `group_names`.
    sigmas : (n,) array, optional
        A-priori standard deviations of the observations, positive.
    redundancy : (n,) array, optional
        Redundancy numbers r_i, 0 to 1; observations are taken as uncorrelated.
    options : StudyOptions, optional
    group_names : sequence of str
        Names of the groups, when `groups` are codes.
    residuals_of : callable, optional
        Maps errors of unit variance, (n, B), to residuals standardised as the values studied are; see `study_laws`.

    Returns
    -------
    ResidualStudy

    Raises
    ------
    UsageError
        If columns are too short, of different lengths, not finite or constant, sigmas not positive, redundancy numbers outside [0, 1],
        or classes do not cover the values.

    Notes
    -----
    Maarek & Konecny, Modulated normal distribution. Of their scale rules S_o (v'v over the redundancy, on raw residuals) is described
    only: raw residuals have variance r_i sigma^2, and the rule rejects truly normal errors in about half of all cases.

    Examples
    --------
    >>> rng = np.random.default_rng(2)
    >>> found = study(7.0 * rng.standard_normal(200), options=StudyOptions(laws=("normal", "lineo"), replicas=199))
    >>> found.kind, found.gates
    ('raw', {'mean_of_residuals': False, 'goodness_of_fit': False})
    """
    o = StudyOptions() if options is None else options
    v = _column(values, "residuals")
    n = len(v)
    if n < LEAST:
        raise UsageError(f"{n} residuals given: at least {LEAST} are needed")
    if v.min() == v.max():
        raise UsageError(f"all {n} residuals are equal ({v[0]:g}): nothing can be tested")
    given = None if sigmas is None else _sigmas(sigmas, n)
    r = None if redundancy is None else _redundancy(redundancy, n)
    codes, names = (None, ()) if groups is None else coded(groups, group_names, n)
    kept = np.ones(n, dtype=bool) if r is None else r >= UNCONTROLLED
    if o.loc and (given is not None or r is not None):
        raise UsageError(f"loc = {o.loc:g} has no meaning for weighted residuals: only 0 has")
    with np.errstate(over="ignore", under="ignore"):
        base = v[kept] if given is None else v[kept] / given[kept]
    if not np.isfinite(base).all():
        raise UsageError("a residual divided by its sigma is too large a number")
    if len(base) < LEAST:
        raise UsageError(f"{len(base)} residuals are controlled by other observations (redundancy number above 1e-10): 3 are needed")
    own = None if r is None else r[kept]
    total, sigma0, x = _standardised(base, own)
    _spread(x)
    kind: Kind = "standardised" if own is not None else "raw" if given is None else "weighted"
    tests, left_out = _tests(x, base, total if given is not None else None, o)
    grouped = None
    if codes is not None:
        grouped, why = study_groups(codes[kept], names, base, x, own, o)
        left_out += why
    rules, why = scale_rules(base, x if own is not None else None, total, o)
    left_out += why
    # Class limits are given in the unit of the residuals; standardised ones have their own.
    for_laws = replace(o, classes="equal_width", ends="open") if own is not None and not isinstance(o.classes, str) else o
    laws = study_laws(x, for_laws, residuals_of)
    x.flags.writeable = base.flags.writeable = False
    d = (x - x.mean()) / x.std()
    return ResidualStudy(
        o,
        x,
        kind,
        base,
        n - len(base),
        float(x.mean()),
        float(x.std(ddof=1)),
        float(np.mean(d**3)),
        float(np.mean(d**4)),
        total,
        sigma0,
        tests,
        grouped,
        rules,
        laws,
        _a_of_errors(laws, own),
        (*left_out, *laws.left_out),
    )


def _column(values: ArrayLike, what: str) -> Floats:
    try:
        x = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"the {what} are not numbers") from None
    if x.ndim != 1:
        raise UsageError(f"the {what} must be one column, not an array of shape {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x))
    if len(bad):
        raise UsageError(f"{len(bad)} of {len(x)} {what} are not finite; the first is number {bad[0] + 1} ({x[bad[0]]})")
    return x


def _same_length(x: Floats, n: int, what: str) -> Floats:
    if len(x) != n:
        raise UsageError(f"{len(x)} {what} for {n} residuals")
    return x


def _sigmas(sigmas: ArrayLike, n: int) -> Floats:
    x = _same_length(_column(sigmas, "sigmas"), n, "sigmas")
    bad = np.flatnonzero(x <= 0.0)
    if len(bad):
        raise UsageError(f"sigmas must be positive; number {bad[0] + 1} is {x[bad[0]]:g}")
    return x


def _redundancy(redundancy: ArrayLike, n: int) -> Floats:
    x = _same_length(_column(redundancy, "redundancy numbers"), n, "redundancy numbers")
    bad = np.flatnonzero((x < -_ROUNDING) | (x > 1.0 + _ROUNDING))
    if len(bad):
        raise UsageError(f"redundancy numbers lie between 0 and 1; number {bad[0] + 1} is {x[bad[0]]:g}")
    return x


def _standardised(base: Floats, r: Floats | None) -> tuple[float | None, float | None, Floats]:
    """Return the redundancy, s0, and the residuals divided by their own standard deviations; the residuals as they are without r."""
    if r is None:
        return None, None, base.copy()
    total = float(r.sum())
    with np.errstate(over="ignore", under="ignore"):
        sigma0 = float(np.sqrt(base @ base / total))
    if not 0.0 < sigma0 < np.inf:
        raise UsageError("the residuals are too small or too large for squares to be formed: choose another unit")
    return total, sigma0, base / (sigma0 * np.sqrt(r))


def _spread(x: Floats) -> None:
    if x.min() == x.max():
        raise UsageError("all residuals divided by their standard deviations are equal: nothing can be tested")
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        fourth = float(np.mean((x - x.mean()) ** 4))
    if not 0.0 < fourth < np.inf:
        raise UsageError("the residuals are too small or too large for their moments to be formed: choose another unit")


def _tests(x: Floats, base: Floats, total: float | None, o: StudyOptions) -> tuple[tuple[TestResult, ...], list[tuple[str, str]]]:
    """Global test and moments; `total` is given where sigmas are."""
    note = "Law for independent values of equal variance: approximate for residuals of an adjustment."
    out: list[TestResult] = []
    left_out: list[tuple[str, str]] = []
    if total is not None and len(base):
        whole = global_variance_factor(float(base @ base), total, alpha=o.alpha)
        said = "r is the sum of the redundancy numbers of the table, which must hold all observations of the adjustment."
        out.append(replace(whole, note=said))
    centred = x if o.loc is None else x - o.loc
    for test, least, what in (
        (mean_of_residuals, 2, "mean"),
        (skewness_of_residuals, 8, "skewness"),
        (kurtosis_of_residuals, 20, "kurtosis"),
    ):
        if len(x) >= least:
            out.append(test(centred, o.alpha, note=note))
        else:
            left_out.append((f"test of the {what}", f"it needs at least {least} values"))
    if len(x) >= _LEAST_JARQUE_BERA:
        how = f"Null law by {o.replicas} simulated samples of independent normal values, seed {o.seed}."
        out.append(jarque_bera(centred, o.alpha, replicas=o.replicas, seed=o.seed, note=how if len(x) * o.replicas <= _SIMULATED else note))
    return tuple(out), left_out


def scale_rules(
    base: Floats, standardised: Floats | None, total: float | None, o: StudyOptions
) -> tuple[tuple[ScaleRule, ...], list[tuple[str, str]]]:
    """Judge the normal law with the paper's four scales, on the same classes (Q_v on classes of its own values).

    Parameters
    ----------
    base : (n,) array
        Raw or weighted residuals.
    standardised : (n,) array or None
        The same divided by their own standard deviations: for Q_v.
    total : float or None
        Sum of their redundancy numbers: for S_o.
    o : StudyOptions

    Returns
    -------
    rules : tuple of ScaleRule
    left_out : list of (str, str)
        What could not be done, and why.

    Notes
    -----
    Maarek & Konecny, table 4.

    Examples
    --------
    >>> rules, _ = scale_rules(np.random.default_rng(1).standard_normal(100), None, 80.0, StudyOptions(loc=0.0))
    >>> [(r.symbol, r.rejected) for r in rules]
    [('S_M', False), ('S_o', None), ('S_P', False)]
    """
    n = len(base)
    mean = float(base.mean()) if o.loc is None else o.loc
    squares = float(np.sum((base - mean) ** 2))
    used = 1 if o.loc is None else 0
    left_out: list[tuple[str, str]] = []
    edges = _limits(base, o, left_out)
    rules = []
    for name, symbol, r in (("sample", "S_M", float(n)), ("redundancy", "S_o", total or 0.0)):
        if r > used:
            deviation = float(np.sqrt(squares / (r - used)))
            judged = _judged(base, edges, mean, deviation, used + 1, o, left_out)
            rules.append(ScaleRule(name, symbol, mean, deviation, judged, described=name == "redundancy"))
    if standardised is not None:
        own = o if isinstance(o.classes, str) else replace(o, classes="equal_width", ends="open")
        limits = _limits(standardised, own, left_out)
        rules.append(ScaleRule("standardised", "Q_v", 0.0, 1.0, _judged(standardised, limits, 0.0, 1.0, 1, own, left_out)))
    if edges is not None and len(edges) - 2 > used:  # classes - 1 - estimated parameters must leave something to minimise
        counts = count(base, edges, o.ends)
        least = fit_classes(counts, edges, "normal", rule="minimum_chi2", loc=o.loc, ends=o.ends, alpha=o.alpha)
        rules.append(ScaleRule("minimum_chi2", "S_P", least.parameters["loc"], least.parameters["scale"], least))
    elif edges is not None:
        left_out.append(("minimum chi-square", f"{len(edges) - 1} classes are too few"))
    return tuple(rules), left_out


def _limits(x: Floats, o: StudyOptions, left_out: list[tuple[str, str]]) -> Floats | None:
    try:
        return class_limits(x, o)
    except UsageError as error:
        if not isinstance(o.classes, str):
            raise
        reason = ("scale rules on classes", str(error))
        if reason not in left_out:
            left_out.append(reason)
        return None


def _judged(
    x: Floats, edges: Floats | None, mean: float, deviation: float, estimated: int, o: StudyOptions, left_out: list[tuple[str, str]]
) -> Fit | None:
    if edges is None:
        return None
    counts = count(x, edges, o.ends)
    try:
        return fit_classes(counts, edges, "normal", loc=mean, scale=deviation, ends=o.ends, estimated=estimated, alpha=o.alpha)
    except UsageError as error:
        left_out.append(("chi-square of a scale rule", str(error)))
        return None


def _a_of_errors(laws: LawsStudied, r: Floats | None) -> float | None:
    """The a of the errors from the a of the residuals: excess kurtosis of v_i = that of e times sum_j R_ij^4 / R_ii^2, about r_i^2."""
    if r is None or laws.modulated is None:
        return None
    a = laws.modulated.parameters["a"]
    excess = (0.0 if np.isinf(a) else 3.0 / ((a + 1.0) * (a + 3.0))) / float(np.mean(r**2))
    return float("inf") if excess == 0.0 else float(np.sqrt((3.0 + excess) / excess) - 2.0)
