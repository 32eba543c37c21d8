"""Tests of single observations: w, tau, what they can detect and what stays undetected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats

from baarda.errors import UsageError
from baarda.hypotheses._laws import check_redundancy, check_variance, number
from baarda.hypotheses.base import Evidence, Floats, Law, TestResult
from baarda.hypotheses.levels import Options, Policy, check_level, family_result, noncentrality

__all__ = [
    "TauLaw",
    "critical_tau",
    "data_snooping",
    "delta0",
    "estimated_error",
    "external_reliability",
    "externally_studentised",
    "mdb",
    "standardised",
    "tau",
]

ORDER = 40

# Below this redundancy number no other observation controls an observation: w, tau and mdb are NaN.
UNCONTROLLED = 1e-10


@dataclass(frozen=True)
class TauLaw:
    """Pope's tau law with r degrees of freedom: tau^2 / r ~ Beta(1/2, (r - 1)/2), symmetric, bounded by sqrt(r).

    Attributes
    ----------
    redundancy : float
        r; with r = 1, tau is +1 or -1 always and no observation can be judged (p = 1).

    Notes
    -----
    A. J. Pope, The statistics of residuals and the detection of outliers, NOAA TR NOS 65 NGS 1 (1976).

    Examples
    --------
    >>> float(TauLaw(39).ppf(0.9995))
    3.127
    """

    redundancy: float

    def sf(self, x: Any) -> Any:
        """Return P(tau >= x)."""
        x = np.asarray(x, dtype=float)
        r = float(self.redundancy)
        if r == 1.0:
            p = np.where(x <= -1.0, 1.0, np.where(x <= 1.0, 0.5, 0.0))
            return np.where(np.isnan(x), np.nan, p)[()]
        inside = x * x < r
        # Share of r that tau leaves; exact near the bound, where a cumulated probability of tau^2 / r would lose its digits.
        rest = np.where(inside, (r - x * x) / r, 0.0)
        upper = 0.5 * special.betainc((r - 1.0) / 2.0, 0.5, rest)
        return np.where(np.isnan(x), np.nan, np.where(x >= 0.0, upper, 1.0 - upper))[()]

    def cdf(self, x: Any) -> Any:
        """Return P(tau <= x)."""
        return self.sf(-np.asarray(x, dtype=float))

    def ppf(self, q: Any) -> Any:
        """Return the quantile: sqrt(r) t / sqrt(r - 1 + t^2), t = t(q; r - 1)."""
        q = np.asarray(q, dtype=float)
        if self.redundancy == 1.0:
            return np.where(q <= 0.5, -1.0, 1.0)[()]
        t = special.stdtrit(self.redundancy - 1.0, q)
        return (np.sqrt(self.redundancy) * t / np.sqrt(self.redundancy - 1.0 + t * t))[()]


def standardised(
    numerator: ArrayLike,
    cofactors: ArrayLike,
    sigma0: float = 1.0,
    redundancy_numbers: ArrayLike | None = None,
) -> Floats:
    """Return w: residuals divided by their own standard deviation, with the sign of v.

    Parameters
    ----------
    numerator : (n,) array
        Residuals v, or P v where observations are correlated.
    cofactors : (n,) array
        Diagonal of Qvv, or of P Qvv P.
    sigma0 : float
        Standard deviation of unit weight: a priori for w, a posteriori for tau.
    redundancy_numbers : (n,) array, optional
        Observations below 1e-10 are uncontrolled; without it, those with a cofactor that is not positive.

    Returns
    -------
    (n,) array
        w = v / (sigma0 sqrt(qvv)); NaN where the observation is uncontrolled.

    Raises
    ------
    UsageError
        If the shapes differ or sigma0 is not positive.

    Notes
    -----
    Baarda (1968); w = c'Pv / (sigma0 sqrt(c'P Qvv P c)) with the sign of v.

    Examples
    --------
    >>> import numpy as np
    >>> standardised(np.array([-2.0, 0.0]), np.array([0.25, 0.0]), 1.0)
    array([-4., nan])
    """
    check_variance(sigma0, "sigma0")
    v, q = np.asarray(numerator, dtype=float), np.asarray(cofactors, dtype=float)
    if v.shape != q.shape:
        raise UsageError(f"{v.shape} residuals for {q.shape} cofactors")
    seen = q > 0.0
    if redundancy_numbers is not None:
        seen &= np.asarray(redundancy_numbers, dtype=float) >= UNCONTROLLED
    if seen.all():
        w = np.asarray(np.sqrt(q))
        w *= sigma0
        np.divide(v, w, out=w)
        return w
    w = np.full(v.shape, np.nan)
    np.divide(v, sigma0 * np.sqrt(np.where(seen, q, 1.0)), out=w, where=seen)
    return w


def tau(
    numerator: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy_numbers: ArrayLike | None = None,
) -> Floats:
    """Return tau: residuals divided by their own standard deviation a posteriori.

    Parameters
    ----------
    numerator, cofactors, redundancy_numbers
        As in `standardised`.
    variance_factor : float
        s0^2 = v'Pv / r of the same adjustment.

    Returns
    -------
    (n,) array
        tau = v / (s0 sqrt(qvv)), distributed as `TauLaw(r)`; NaN where uncontrolled.

    Raises
    ------
    UsageError
        If the variance factor is not positive.

    Notes
    -----
    Pope (1976).

    Examples
    --------
    >>> import numpy as np
    >>> tau(np.array([3.0]), np.array([0.5]), 4.0)
    array([2.12])
    """
    check_variance(variance_factor, "the variance factor")
    return standardised(numerator, cofactors, float(np.sqrt(variance_factor)), redundancy_numbers)


def critical_tau(redundancy: float, alpha: float = 0.001) -> float:
    """Return Pope's critical value of |tau|.

    Parameters
    ----------
    redundancy : float
        r.
    alpha : float
        Level of the two-sided test of one observation.

    Returns
    -------
    float

    Raises
    ------
    RedundancyNotPositive
        If r is not positive.

    Notes
    -----
    Pope (1976): sqrt(r) t / sqrt(r - 1 + t^2), t = t(1 - alpha/2; r - 1).

    Examples
    --------
    >>> critical_tau(39)
    3.127
    """
    check_redundancy(redundancy)
    check_level(alpha)
    return -float(TauLaw(redundancy).ppf(alpha / 2.0))


def externally_studentised(values: ArrayLike, redundancy: float) -> Floats:
    """Return the residuals studentised by the variance factor of an adjustment without the observation: t(r - 1) from tau.

    Parameters
    ----------
    values : (n,) array
        tau.
    redundancy : float
        r, at least 2.

    Returns
    -------
    (n,) array
        tau sqrt((r - 1) / (r - tau^2)); infinite where one observation alone carries v'Pv.

    Raises
    ------
    UsageError
        If r is below 2 or a |tau| exceeds sqrt(r).

    Notes
    -----
    Cook, Weisberg, Residuals and Influence in Regression (1982).

    Examples
    --------
    >>> externally_studentised([2.0], 10)
    array([2.449])
    """
    if redundancy < 2:
        raise UsageError(f"without one observation the redundancy {redundancy:g} leaves none")
    t = np.asarray(values, dtype=float)
    rest = redundancy - t * t
    if (rest < -1e-9 * redundancy).any():
        raise UsageError(f"a |tau| exceeds its bound sqrt({redundancy:g})")
    out: Floats = np.copysign(np.full(t.shape, np.inf), t)
    inside = ~(rest <= 0.0)
    np.divide(t * np.sqrt(redundancy - 1.0), np.sqrt(np.where(inside, rest, 1.0)), out=out, where=inside)
    return out


def delta0(alpha: float = 0.001, power: float = 0.80) -> float:
    """Return delta0: the shift of w that the two-sided test of level `alpha` detects with probability `power`.

    Parameters
    ----------
    alpha, power : float
        Fractions.

    Returns
    -------
    float
        Square root of the noncentrality lambda0.

    Raises
    ------
    UsageError
        If the power does not exceed the level.

    Notes
    -----
    Baarda (1968); Grün (1978) eq. 21.

    Examples
    --------
    >>> delta0(0.001, 0.80)
    4.132
    """
    return float(np.sqrt(noncentrality(alpha, power)))


def mdb(
    cofactors: ArrayLike,
    redundancy_numbers: ArrayLike,
    sigma0: float = 1.0,
    alpha: float = 0.001,
    power: float = 0.80,
) -> Floats:
    """Return the minimal detectable bias of each observation.

    Parameters
    ----------
    cofactors : (n,) array
        Cofactors q of the observations (sigma_i^2 / sigma0^2); for correlated observations give r_i / (P Qvv P)_ii.
    redundancy_numbers : (n,) array
        r_i.
    sigma0 : float
        A-priori standard deviation of unit weight.
    alpha, power : float
        Level of the test of one observation, and its power against the bias.

    Returns
    -------
    (n,) array
        sigma0 delta0 sqrt(q / r_i), in the unit of the observation; NaN where r_i < 1e-10 (no bias can be detected).

    Raises
    ------
    UsageError
        If sigma0 is not positive or a level makes no sense.

    Notes
    -----
    Baarda (1968); Grün (1978) eq. 21.

    Examples
    --------
    >>> mdb([1.0, 1.0], [0.5335, 0.0], sigma0=5.0)
    array([28.29, nan])
    """
    check_variance(sigma0, "sigma0")
    q, r = np.broadcast_arrays(np.asarray(cofactors, dtype=float), np.asarray(redundancy_numbers, dtype=float))
    seen = r >= UNCONTROLLED
    bias = np.full(r.shape, np.nan)
    np.divide(q, r, out=bias, where=seen)
    np.sqrt(bias, out=bias)
    bias *= sigma0 * delta0(alpha, power)
    return bias


def estimated_error(residuals: ArrayLike, redundancy_numbers: ArrayLike) -> Floats:
    """Return the estimated error of each observation, as if it were the only one: observed minus true.

    Parameters
    ----------
    residuals : (n,) array
        v = adjusted - observed, in the unit of the observation.
    redundancy_numbers : (n,) array
        r_i of uncorrelated observations.

    Returns
    -------
    (n,) array
        -v / r_i; NaN where r_i < 1e-10.

    Notes
    -----
    Grün (1978) eq. 17; Gama prints the opposite sign.

    Examples
    --------
    >>> estimated_error([-4.0], [0.5])
    array([8.])
    """
    v, r = np.broadcast_arrays(np.asarray(residuals, dtype=float), np.asarray(redundancy_numbers, dtype=float))
    error = np.full(r.shape, np.nan)
    np.divide(-v, r, out=error, where=r >= UNCONTROLLED)
    return error


def external_reliability(redundancy_numbers: ArrayLike, alpha: float = 0.001, power: float = 0.80) -> Floats:
    """Return the largest effect of an undetected minimal bias on any function of the unknowns, in units of its sigma.

    Parameters
    ----------
    redundancy_numbers : (n,) array
        r_i of uncorrelated observations.
    alpha, power : float
        As for `mdb`.

    Returns
    -------
    (n,) array
        delta0 sqrt((1 - r_i) / r_i); NaN where r_i < 1e-10.

    Raises
    ------
    UsageError
        If a redundancy number exceeds 1: it is not that of an uncorrelated observation.

    Notes
    -----
    Baarda (1968); lambda_bar = lambda0 (1 - r_i) / r_i.

    Examples
    --------
    >>> external_reliability([0.5, 1.0])
    array([4.132, 0.   ])
    """
    r = np.asarray(redundancy_numbers, dtype=float)
    over = r > 1.0
    if (r > 1.0 + 1e-9).any():
        raise UsageError("a redundancy number exceeds 1: the observations are correlated")
    part = np.full(r.shape, np.nan)
    # A redundancy number of 1 plus rounding leaves no effect.
    np.divide(np.where(over, 0.0, 1.0 - r), r, out=part, where=r >= UNCONTROLLED)
    return np.asarray(delta0(alpha, power) * np.sqrt(part))


def data_snooping(
    values: ArrayLike,
    redundancy: float | None = None,
    alpha: float = 0.001,
    levels: Policy = "none",
    labels: Sequence[str] = (),
    law: Law | None = None,
    note: str = "",
) -> TestResult:
    """Test each observation: no gross error.

    Parameters
    ----------
    values : (n,) array
        w where sigma0 is known, tau where it is estimated; NaN where the observation is uncontrolled.
    redundancy : float, optional
        r if the values are tau; absent if they are w.
    alpha : float
        Level of a single test, or of the family if `levels` says so.
    levels : str
        See `Options.levels`.
    labels : sequence of str
        One per observation.
    law : Law, optional
        Another law of a single statistic under the null hypothesis, for instance a fitted modulated normal.
    note : str
        Added to the result.

    Returns
    -------
    TestResult
        A family: N(0, 1) for w, Pope's tau(r) for tau.

    Raises
    ------
    RedundancyNotPositive
        If r is not positive.

    Notes
    -----
    Baarda (1968); Pope (1976).

    Examples
    --------
    >>> data_snooping([0.2, -4.0, float("nan")]).rejected
    array([False,  True, False])
    """
    statistic = np.atleast_1d(np.asarray(values, dtype=float))
    check_level(alpha)
    if redundancy is not None:
        check_redundancy(redundancy)
    spoken = "given law" if law is not None else "N(0, 1)" if redundancy is None else f"tau({number(redundancy)})"
    chosen = law or (stats.norm() if redundancy is None else TauLaw(redundancy))
    unseen = int(np.isnan(statistic).sum())
    if unseen:
        note = f"{note} {unseen} uncontrolled observations (redundancy number below 1e-10) cannot be tested.".strip()
    df = () if redundancy is None else (float(redundancy),)
    null = "The observation has no gross error."
    details = {"uncontrolled": unseen}
    return family_result(
        "data_snooping", null, statistic, chosen, spoken, alpha, levels, labels=labels, tail="two-sided", df=df, note=note, details=details
    )


def _labels(evidence: Evidence) -> tuple[str, ...]:
    """Return one label per observation: group, image, point, component, as far as they are known."""
    n = len(evidence.residuals)
    columns: list[list[str]] = []
    for word, codes, names in (
        ("image ", evidence.images, evidence.image_names),
        ("point ", evidence.points, evidence.point_names),
        ("", evidence.components, evidence.component_names),
    ):
        if codes is not None and names:
            table = np.array([f"{word}{name}" for name in names] + [""], dtype=object)
            columns.append(table[codes].tolist())
    if evidence.groups is not None and evidence.group_names:
        # The kind of the observation is said where no image tells it.
        table = np.array([*evidence.group_names, ""], dtype=object)
        said = np.where((evidence.images if evidence.images is not None else np.full(n, -1)) < 0, table[evidence.groups], "")
        columns.insert(0, said.tolist())
    if evidence.points is None or not evidence.point_names:
        # Without the point, the other words do not tell observations apart.
        columns.append([f"observation {i + 1}" for i in range(n)])
    return tuple(" ".join(filter(None, parts)) or f"observation {i + 1}" for i, parts in enumerate(zip(*columns, strict=True)))


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests of all observations: tau a posteriori, w a priori."""
    numerator, cofactors = (
        (evidence.pv, evidence.pqvvp) if evidence.pv is not None and evidence.pqvvp is not None else (evidence.residuals, evidence.qvv)
    )
    if cofactors is None or evidence.vpv <= 0.0:
        return []
    share = cofactors * (evidence.sigmas / evidence.sigma0_apriori) ** 2
    if numerator is evidence.residuals:
        share = cofactors / (evidence.sigmas / evidence.sigma0_apriori) ** 2
    aposteriori = options.sigma == "aposteriori"
    sigma0 = evidence.sigma0 if aposteriori else evidence.sigma0_apriori
    values: NDArray[np.float64] = standardised(numerator, cofactors, sigma0, share)
    r = float(evidence.redundancy) if aposteriori else None
    single = options.levels in ("none", "baarda")
    note = "The residuals share one redundancy of 1: tau is +1 or -1 always." if r == 1.0 else ""
    alpha = options.alpha_outlier if single else options.alpha
    return [data_snooping(values, r, alpha, options.levels, _labels(evidence), note=note)]
