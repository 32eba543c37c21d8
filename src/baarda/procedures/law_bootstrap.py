"""Parametric bootstrap of a fitted law: Kolmogorov, Cramér-von Mises, Anderson-Darling, and chi-square on classes, in one simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from baarda.distributions import law as find_law
from baarda.distributions.base import Distribution, Floats, Law
from baarda.distributions.fitting import Fit
from baarda.distributions.histogram import Ends
from baarda.distributions.replicas import both_areas, refit_columns
from baarda.errors import UsageError
from baarda.hypotheses.base import SimulatedLaw, TestResult
from baarda.hypotheses.goodness_of_fit import empirical_statistics

STATISTICS = ("kolmogorov", "cramer_von_mises", "anderson_darling")
CHI_SQUARE = "chi_square_on_classes"
EXACT = 1000  # up to so many values the null laws are simulated with samples of the same size
SIMULATED = 300  # beyond it, with samples of this size: D sqrt(n), W^2 and A^2 hardly depend on n there
IN_A_CLASS = 5  # expected values of the smaller samples, for chi-square
_CHUNK = 4_000_000
ResidualsOf = Callable[[Floats], Floats]


@dataclass(frozen=True)
class ClassRule:
    """How class limits follow each simulated data set.

    Attributes
    ----------
    limits : (k+1,) array
        Class limits: in standard deviations of the data set from its mean (or `loc`) where `relative`, else in the unit of the values.
    relative : bool
        Whether the limits were found from the values, so that they must be found again from each data set. Limits that the user gave stay
        where they are, unless adjustments are simulated, whose unit is not that of the values.
    loc : float or None
        Known expectation.
    ends : {"open", "closed"}
    """

    limits: Floats
    relative: bool
    loc: float | None
    ends: Ends

    def __len__(self) -> int:
        """Return the number of classes."""
        return len(self.limits) - 1

    def chi_square(self, member: Law, ordered: Floats, parameters: dict[str, Floats]) -> Floats:
        """Chi-square of each sorted column under its own law, (B,); values outside of closed classes are not counted."""
        n, replicas = ordered.shape
        inner = self.limits[:, None] if self.ends == "closed" else self.limits[1:-1, None]
        if self.relative:
            mean = ordered.mean(axis=0) if self.loc is None else np.full(replicas, self.loc)
            inner = mean + ordered.std(axis=0) * inner
        inner = np.broadcast_to(inner, (len(inner), replicas))
        cls: Any = member.distribution
        z = (inner - parameters["loc"]) / parameters["scale"]
        shapes = tuple(parameters[s.name] for s in cls.shapes)
        below, above = both_areas(cls, z, shapes)
        cuts = np.stack([np.searchsorted(ordered[:, k], inner[:, k], side="left") for k in range(replicas)], axis=1)
        if self.ends == "open":
            zero, one = np.zeros((1, replicas)), np.ones((1, replicas))
            below, above = np.concatenate([zero, below, one]), np.concatenate([one, above, zero])
            cuts = np.concatenate([zero, cuts, n * one])
        found = np.diff(cuts, axis=0)
        expected = n * np.where(below[1:] < 0.5, np.diff(below, axis=0), -np.diff(above, axis=0))
        with np.errstate(divide="ignore", invalid="ignore"):
            terms = np.where((expected > 0.0) | (found > 0.0), (found - expected) ** 2 / expected, 0.0)
        return np.asarray(terms.sum(axis=0))


def empirical_tests(
    values: ArrayLike,
    found: Fit,
    replicas: int = 999,
    seed: int = 0,
    alpha: float = 0.05,
    residuals_of: ResidualsOf | None = None,
    classes: ClassRule | None = None,
) -> tuple[TestResult, ...]:
    """Test a fitted law by Kolmogorov's, Cramér-von Mises' and Anderson-Darling's statistic with one simulation for all three.

    Parameters
    ----------
    values : (n,) array
        The values that were fitted.
    found : Fit
        The law with its values; what it estimated is estimated again in each replica.
    replicas, seed : int
        Number of simulated data sets; replica k uses child k of the seed.
    alpha : float
        Level.
    residuals_of : callable, optional
        See `baarda.procedures.law_study.study_laws`.
    classes : ClassRule, optional
        With it, chi-square on these classes too; `found` then has its own value.

    Returns
    -------
    tuple of TestResult

    Raises
    ------
    UsageError
        If the errors have no variance or `residuals_of` changes the shape.

    Notes
    -----
    Up to 1000 values the replicas have as many values, beyond it 300: D sqrt(n), W^2 and A^2 differ there from their limits by some tenths
    of a percent (M. A. Stephens, J. Am. Stat. Ass. 69 (1974) 730-737), far less than the error of 999 replicas.

    Examples
    --------
    >>> from baarda.distributions import fit
    >>> x = np.random.default_rng(4).laplace(size=200)
    >>> [t.rejected for t in empirical_tests(x, fit(x, "normal"), replicas=199)]
    [True, True, True]
    """
    x = np.asarray(values, dtype=float)
    n, d = len(x), found.distribution
    if residuals_of is None and n > EXACT:
        ordered = np.sort(x)
        own = [float(t) for t in empirical_statistics(np.asarray(d.cdf(ordered)), np.asarray(d.sf(ordered)))]
        return bootstrap_of_many(own, n, found, replicas, seed, alpha, classes)
    drawn = _drawn(x, n, found, replicas, seed, residuals_of, classes)
    return _results(drawn[:, 0], drawn[:, 1:], found, alpha, _note(n, n, seed, residuals_of, found))


def bootstrap_of_many(
    statistics: Sequence[float],
    n: int,
    found: Fit,
    replicas: int = 999,
    seed: int = 0,
    alpha: float = 0.05,
    classes: ClassRule | None = None,
) -> tuple[TestResult, ...]:
    """Test a law that was fitted to more than 1000 independent values, of which only the statistics are at hand.

    Parameters
    ----------
    statistics : sequence of float
        Kolmogorov's D, Cramér-von Mises' W^2 and Anderson-Darling's A^2 of the values under the fitted law.
    n : int
        Number of values.
    found, replicas, seed, alpha, classes
        As in `empirical_tests`; chi-square is that of `found`.

    Returns
    -------
    tuple of TestResult

    Notes
    -----
    Null laws by samples of 300 values, see `empirical_tests`; with chi-square they hold 5 values a class at least.

    Examples
    --------
    >>> from baarda.distributions import fit
    >>> x = np.random.default_rng(4).standard_normal(2000)
    >>> [t.name for t in bootstrap_of_many([0.01, 0.05, 0.4], 2000, fit(x, "normal"), replicas=99) if not t.rejected]
    ['kolmogorov', 'cramer_von_mises', 'anderson_darling']
    """
    m = SIMULATED if classes is None else max(SIMULATED, IN_A_CLASS * len(classes))
    drawn = _drawn(None, m, found, replicas, seed, None, classes)
    own = np.array([*statistics, found.statistic or 0.0][: len(drawn)])
    null = drawn * np.array([[np.sqrt(m / n)], [1.0], [1.0], [1.0]])[: len(drawn)]
    return _results(own, null, found, alpha, _note(m, n, seed, None, found))


def _drawn(
    x: Floats | None, m: int, found: Fit, replicas: int, seed: int, residuals_of: ResidualsOf | None, classes: ClassRule | None
) -> Floats:
    """The statistics of simulated data sets, (3 or 4, B), after those of the values x where these are given."""
    d, member = found.distribution, find_law(found.law)
    given = {k: v for k, v in found.parameters.items() if k not in found.estimated and k in member.parameter_names}
    unit = float(np.sqrt(d._moments(*d.shape_values)[1]))
    if residuals_of is not None and not np.isfinite(unit):
        raise UsageError(f"errors of law {found.law} have no variance: they cannot be mapped to residuals")
    children = np.random.SeedSequence(seed).spawn(replicas)
    width = max(1, _CHUNK // m)
    parts: list[Floats] = []
    for start in range(0, replicas, width):
        z = np.stack([d._rvs(np.random.default_rng(c), m, *d.shape_values) for c in children[start : start + width]], axis=1)
        columns = d.loc + d.scale * z
        if residuals_of is not None:
            columns = np.asarray(residuals_of(z / unit), dtype=float)
            if columns.shape != z.shape:
                raise UsageError(f"residuals_of maps {z.shape} to {columns.shape}; it must keep the shape")
        # data of the same size take part in the same search, as an exact test demands
        parts.append(_of_columns(member, columns if parts or x is None else np.column_stack([x, columns]), d, given, classes))
    return np.concatenate(parts, axis=1)


def _results(own: Floats, null: Floats, found: Fit, alpha: float, note: str) -> tuple[TestResult, ...]:
    estimated = f" (fitted: {', '.join(found.estimated)})" if found.estimated else ""
    claim = f"The values follow the {found.law.replace('_', ' ')} law{estimated}."
    spoken = f"simulated, B = {null.shape[1]}"
    return tuple(
        TestResult(name, claim, float(own[i]), SimulatedLaw(np.sort(null[i])), spoken, alpha, note=note)
        for i, name in enumerate((*STATISTICS, CHI_SQUARE)[: len(null)])
    )


def _of_columns(member: Law, columns: Floats, start: Distribution, given: dict[str, float], classes: ClassRule | None) -> Floats:
    """The statistics of each column, its parameters fitted anew: (3, B), with classes (4, B)."""
    ordered = np.sort(columns, axis=0)
    parameters, _ = refit_columns(member, ordered, start, given)
    cls: Any = member.distribution
    z = (ordered - parameters["loc"]) / parameters["scale"]
    shapes = tuple(parameters[s.name] for s in cls.shapes)
    found = empirical_statistics(*both_areas(cls, z, shapes))
    return np.array(found if classes is None else (*found, classes.chi_square(member, ordered, parameters)))


def _note(m: int, n: int, seed: int, residuals_of: ResidualsOf | None, found: Fit) -> str:
    if residuals_of is not None:
        kind = "approximate, since a shape is fitted" if set(found.estimated) - {"loc", "scale"} else "exact for the normal law"
        return f"Parametric bootstrap through the design matrix, seed {seed}: {kind}."
    size = "" if m == n else f" with samples of {m} values"
    return f"Parametric bootstrap{size} for independent values, seed {seed}: approximate for residuals of an adjustment."
