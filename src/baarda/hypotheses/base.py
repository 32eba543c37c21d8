"""What a test is, and what it may ask for: `TestResult` and `Evidence`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Tail = Literal["right", "left", "two-sided"]


class Law(Protocol):
    """The law of a statistic under the null hypothesis: a frozen SciPy law, or anything with these three methods."""

    def cdf(self, x: Any) -> Any:
        """Return P(T <= x)."""

    def sf(self, x: Any) -> Any:
        """Return P(T > x)."""

    def ppf(self, q: Any) -> Any:
        """Return the quantile of probability q."""


@dataclass(frozen=True)
class SimulatedLaw:
    """The law of a statistic known by simulation under the null hypothesis.

    Attributes
    ----------
    values : (B,) array
        The statistic of each simulated data set, sorted ascending.

    Notes
    -----
    ``sf`` is (1 + number of values >= x) / (B + 1): exact for exchangeable statistics (Barnard; Davison & Hinkley 1997, eq. 4.11).
    """

    values: Floats

    def sf(self, x: Any) -> Any:
        """Return the exceedance probability P(T >= x), never zero."""
        n = len(self.values)
        return (1.0 + (n - np.searchsorted(self.values, x, side="left"))) / (n + 1.0)

    def cdf(self, x: Any) -> Any:
        """Return P(T <= x), never zero."""
        n = len(self.values)
        return (1.0 + np.searchsorted(self.values, x, side="right")) / (n + 1.0)

    def ppf(self, q: Any) -> Any:
        """Return the limit beyond which ``sf`` (q > 1/2) or ``cdf`` does not exceed the level; infinite where the replicas are too few."""
        rank = simulated_rank(q, len(self.values))
        return np.concatenate([[-np.inf], self.values, [np.inf]])[rank + 1]


def simulated_rank(q: Any, n: int) -> Any:
    """Return the rank (from 0) of the limit at quantile q among n sorted simulated values; -1 or n where n is too small for the level.

    A value t is beyond the upper limit exactly where (1 + number of values >= t) / (n + 1) <= 1 - q, and likewise below.
    """
    q = np.asarray(q, dtype=float)
    count = np.floor(np.minimum(q, 1.0 - q) * (n + 1) * (1.0 + 1e-12)).astype(int)  # values that may lie beyond, plus one
    return np.where(q > 0.5, n - count, count - 1)


@dataclass(frozen=True)
class TestResult:
    """The outcome of a test of a hypothesis, or of a whole family of equal tests.

    Attributes
    ----------
    name : str
        Name of the test, as in `result.json`.
    null : str
        The null hypothesis in one sentence.
    statistic : float or (k,) array
        The test statistic; an array for a family.
    law : Law
        Law of the statistic under the null hypothesis.
    law_name : str
        The law in words, for instance ``"F(2, 3725)"``.
    alpha : float
        Level of each single test.
    tail : {"right", "left", "two-sided"}
        Which values reject.
    df : tuple of float
        Degrees of freedom, as far as the law has any.
    labels : tuple of str
        One label per member of a family; empty for a single test.
    note : str
        Conditions, or what the reader must know to judge the test.
    details : mapping
        Further numbers of the test (limits, groups, counts), JSON-compatible.
    """

    __test__ = False  # not a class for pytest to collect

    name: str
    null: str
    statistic: float | Floats
    law: Law
    law_name: str
    alpha: float
    tail: Tail = "right"
    df: tuple[float, ...] = ()
    labels: tuple[str, ...] = ()
    note: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def p_value(self) -> Any:
        """Probability under the null hypothesis of a statistic at least as extreme; same shape as `statistic`."""
        if self.tail == "right":
            p = self.law.sf(self.statistic)
        elif self.tail == "left":
            p = self.law.cdf(self.statistic)
        else:
            p = np.minimum(1.0, 2.0 * np.minimum(self.law.sf(self.statistic), self.law.cdf(self.statistic)))
        return p if np.ndim(p) else float(p)

    @property
    def critical(self) -> float | tuple[float, float]:
        """The limit that rejects: one number, or the lower and upper limit of a two-sided test."""
        if self.tail == "right":
            return float(self.law.ppf(1.0 - self.alpha))
        if self.tail == "left":
            return float(self.law.ppf(self.alpha))
        return float(self.law.ppf(self.alpha / 2.0)), float(self.law.ppf(1.0 - self.alpha / 2.0))

    @cached_property
    def rejected(self) -> Any:
        """Whether the null hypothesis is rejected at level `alpha`; same shape as `statistic`."""
        r = np.asarray(self.p_value) <= self.alpha * (1.0 + 1e-12)  # a p-value equal to the level rejects: exact for simulated laws
        return r if r.ndim else bool(r)


@dataclass(frozen=True)
class Estimates:
    """Estimated numbers with names and cofactors: parameters, check differences, control corrections.

    Attributes
    ----------
    names : tuple of str
        One name per number.
    values : (k,) array
        The estimates (or the differences).
    cofactors : (k, k) array
        Their joint cofactor matrix Q from the adjustment; covariance = variance factor times Q.
    reference_covariance : (k, k) array or None
        Covariance of an independent reference that was subtracted (survey of check points; a priori covariance of control), None
        when exact.
    groups : tuple of str
        One group label per number: the camera of a parameter, the point of a check difference.
    """

    names: tuple[str, ...]
    values: Floats
    cofactors: Floats
    reference_covariance: Floats | None = None
    groups: tuple[str, ...] = ()


@dataclass(frozen=True)
class Evidence:
    """Everything a test may ask for. An adjustment yields all of it, a plain column of residuals a part (None = absent).

    Attributes
    ----------
    residuals : (n,) array
        v = adjusted - observed, in the unit of each observation.
    sigmas : (n,) array
        A-priori standard deviations (for variance factor `sigma0_apriori` squared).
    qvv : (n,) array
        Diagonal of the cofactor matrix of the residuals: variance = variance factor times qvv.
    redundancy_numbers : (n,) array
        Diagonal of Qvv P; sums to `redundancy`.
    pv, pqvvp : (n,) arrays
        P v and the diagonal of P Qvv P (for correlated observations w = (P v)_i / (sigma0 sqrt((P Qvv P)_ii)) ).
    groups, images, points, components : (n,) integer arrays
        Codes into `group_names`, `image_names`, `point_names`, `component_names`; -1 = none.
    vpv : float
        v'Pv.
    redundancy : int
        r, positive.
    unknowns : int
        u.
    sigma0_apriori : float
        A-priori standard deviation of unit weight.
    additional : Estimates or None
        The estimated additional parameters (distortion, affinity, ...), free or observed.
    interior : Estimates or None
        All estimated camera parameters, the additional ones included.
    check : Estimates or None
        Check points: adjusted minus given coordinates, with the survey's own covariance as reference.
    control : Estimates or None
        Weighted control coordinates: residuals v = adjusted - given, with the cofactors Qvv of these residuals.
    residuals_of : callable or None
        Maps standardised errors (n, B), independent with unit variance, to the standardised residuals -Qvv P e scaled by 1/sigma of
        each observation, (n, B), so that every simulated null needs no n x n array.
    simulated : mapping of str to (B, ...) array
        Statistics of simulated data sets by test, where one pass computed them for all tests, see `baarda.hypotheses.run`.
    """

    residuals: Floats
    sigmas: Floats
    vpv: float
    redundancy: int
    unknowns: int = 0
    sigma0_apriori: float = 1.0
    qvv: Floats | None = None
    redundancy_numbers: Floats | None = None
    pv: Floats | None = None
    pqvvp: Floats | None = None
    groups: NDArray[np.intp] | None = None
    images: NDArray[np.intp] | None = None
    points: NDArray[np.intp] | None = None
    components: NDArray[np.intp] | None = None
    group_names: tuple[str, ...] = ()
    image_names: tuple[str, ...] = ()
    point_names: tuple[str, ...] = ()
    component_names: tuple[str, ...] = ()
    additional: Estimates | None = None
    interior: Estimates | None = None
    check: Estimates | None = None
    control: Estimates | None = None
    residuals_of: Callable[[Floats], Floats] | None = None
    simulated: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def variance_factor(self) -> float:
        """The a-posteriori variance factor s0^2 = v'Pv / r."""
        return self.vpv / self.redundancy

    @property
    def sigma0(self) -> float:
        """The a-posteriori standard deviation of unit weight s0."""
        return float(np.sqrt(self.variance_factor))
