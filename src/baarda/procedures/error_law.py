"""Critical values of w and tau and the minimal detectable bias under any law of errors, by simulation, beside those of the normal law.

A residual is a combination of errors, v = -R e, and a combination of, say, modulated normal errors is not modulated normal: it is more
normal, the more errors it mixes. So the laws of w and tau differ from observation to observation and are simulated through R.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats
from threadpoolctl import threadpool_limits

from baarda.adjustment import Adjustment
from baarda.adjustment.robust import excess_kurtosis_of_errors, with_fitted_shapes
from baarda.distributions.base import Distribution, Floats
from baarda.errors import UsageError
from baarda.hypotheses._laws import check_redundancy
from baarda.hypotheses.levels import check_level
from baarda.hypotheses.outliers import UNCONTROLLED, critical_tau, delta0

Ints = NDArray[np.intp]
StatisticsOf = Callable[[Floats], tuple[Floats, Floats]]

CLASSES = 5
LEAST_BEYOND = 50  # expected simulated values beyond the critical value of a class
KEPT = 2e7  # simulated w that are kept
_CHUNK = 4e6  # numbers simulated at once; it depends on nothing but n, so that sums do not change


@dataclass(frozen=True)
class Limit:
    """A simulated number beside that of normal errors.

    Attributes
    ----------
    value, error : float
        Under the law of errors, with its Monte Carlo standard error.
    normal, normal_error : float
        Under the normal law; error 0 where it is exact.
    """

    value: float
    error: float
    normal: float
    normal_error: float = 0.0


@dataclass(frozen=True)
class RedundancyClass:
    """Observations of similar redundancy, pooled.

    Attributes
    ----------
    lowest, highest : float
        Redundancy numbers (controlled shares) in the class.
    count : int
        Observations.
    w, tau : Limit
        Critical values of |w| and |tau| of a single observation.
    level_w, level_tau : float
        Level that the normal critical values really have.
    delta0 : Limit
        The shift of w that is detected with the stated power.
    """

    lowest: float
    highest: float
    count: int
    w: Limit
    tau: Limit
    level_w: float
    level_tau: float
    delta0: Limit


@dataclass(frozen=True)
class CriticalValues:
    """Critical values and minimal detectable biases under a law of errors.

    Attributes
    ----------
    law : Distribution
        Law of the errors; only its shape matters here, for the errors have the a-priori variances.
    alpha, family_alpha, power : float
        Level of the test of one observation, level of the test of the largest, power that the bias promises.
    replicas, seed : int
    classes : tuple of RedundancyClass
        By rising redundancy.
    family_w, family_tau : Limit
        Critical values of the largest |w| and |tau|; both columns simulated.
    members : (n,) int array
        Class of each observation; -1 where uncontrolled.
    mdb, mdb_normal : (n,) array
        Minimal detectable bias of each observation by w, in its unit, under the law with the law's critical value, and for normal errors;
        NaN where uncontrolled.
    """

    law: Distribution
    alpha: float
    family_alpha: float
    power: float
    replicas: int
    seed: int
    classes: tuple[RedundancyClass, ...]
    family_w: Limit
    family_tau: Limit
    members: Ints
    mdb: Floats
    mdb_normal: Floats


def critical_values(
    adjustment: Adjustment,
    law: str | Distribution,
    alpha: float = 0.001,
    replicas: int = 2000,
    seed: int = 0,
    *,
    family_alpha: float = 0.05,
    power: float = 0.80,
    shapes: Mapping[str, float] | None = None,
) -> CriticalValues:
    """Return critical values of w and tau, and the minimal detectable bias, of an adjustment under a law of errors.

    Parameters
    ----------
    adjustment : Adjustment
        By least squares.
    law : str or Distribution
        Name of a law (shapes that are not given: a of the modulated normal and nu of Student's law from the kurtosis of the errors, others
        their usual value), or a law with its values. Its variance must exist.
    alpha : float
        Level of the two-sided test of one observation.
    replicas : int
        Simulated adjustments, at least 200; replica k uses child k of the seed.
    seed : int
    family_alpha : float
        Level of the test of the largest |w| or |tau|.
    power : float
        That the minimal detectable bias promises.
    shapes : mapping, optional
        Shapes of a named law.

    Returns
    -------
    CriticalValues

    Raises
    ------
    UsageError
        If the adjustment is not by least squares, the law has no variance, or the replicas are too few for the level.

    Notes
    -----
    w = c'Pv / (sigma0 sqrt(c'P Qvv P c)), tau with s0 of each replica; whitened errors are independent and follow the law.
    """
    if adjustment.law is not None:
        raise UsageError("w and tau belong to least squares; this adjustment was made under a law of errors")
    if isinstance(law, str):
        law = with_fitted_shapes(law, shapes, lambda: excess_kurtosis_of_errors(adjustment.lin, adjustment.solver, adjustment.redundancy))[
            0
        ]
    elif shapes:
        raise UsageError("shapes are given by the law itself")
    pqvvp = adjustment.pqvvp
    with threadpool_limits(limits=1, user_api="blas"):
        return simulate_critical_values(
            statistics_of(adjustment),
            adjustment.controlled_share,
            1.0 / np.where(pqvvp > 0.0, pqvvp, np.nan),
            adjustment.redundancy,
            law,
            alpha,
            replicas,
            seed,
            family_alpha=family_alpha,
            power=power,
        )


def statistics_of(adjustment: Adjustment) -> StatisticsOf:
    """Return the map from whitened errors (n, k) to w (n, k) and v'Pv (k,)."""
    pqvvp = adjustment.pqvvp
    # Uncontrolled observations have no w; rounding may leave their cofactor a little below zero.
    root = np.sqrt(np.where(adjustment.controlled_share >= UNCONTROLLED, pqvvp, np.nan))[:, None]
    correlated = [c for c in adjustment.lin.chunks if c.factor.shape[1] > 1 and np.any(np.tril(c.factor, -1))]

    def statistics(errors: Floats) -> tuple[Floats, Floats]:
        white = adjustment.residuals_of(errors)
        pv = white / adjustment.sigmas[:, None]
        for c in correlated:
            inverse = np.linalg.inv(c.factor)
            white[c.rows] = np.einsum("nij,njk->nik", inverse, white[c.rows] * adjustment.sigmas[c.rows][:, :, None])
            pv[c.rows] = np.einsum("nji,njk->nik", inverse, white[c.rows])
        with np.errstate(divide="ignore", invalid="ignore"):
            return pv / root, np.einsum("nk,nk->k", white, white)

    return statistics


def critical_values_of_projector(
    projector: ArrayLike,
    law: Distribution,
    alpha: float = 0.001,
    replicas: int = 2000,
    seed: int = 0,
    *,
    family_alpha: float = 0.05,
    power: float = 0.80,
) -> CriticalValues:
    """Return the same for plain numbers: uncorrelated observations of unit variance with residuals v = -R e.

    Parameters
    ----------
    projector : (n, n) array
        R = I - A (A'A)^-1 A' of the whitened design matrix.
    law, alpha, replicas, seed, family_alpha, power
        As in `critical_values`.

    Returns
    -------
    CriticalValues
        `mdb` in units of the standard deviations of the observations.

    Raises
    ------
    UsageError
        If the projector is not square, or as in `critical_values`.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> found = critical_values_of_projector(np.eye(30) - 1.0 / 30.0, law("radico")(), 0.01, 400, family_alpha=0.05)
    >>> found.classes[0].w.value > found.classes[0].w.normal
    True
    """
    r = np.asarray(projector, dtype=float)
    if r.ndim != 2 or r.shape[0] != r.shape[1]:
        raise UsageError(f"a projector is square, not {r.shape}")
    shares = np.diag(r)
    root = np.sqrt(np.where(shares > 0.0, shares, np.nan))[:, None]

    def statistics(errors: Floats) -> tuple[Floats, Floats]:
        v = -(r @ errors)
        return v / root, np.einsum("nk,nk->k", v, v)

    with np.errstate(divide="ignore"), threadpool_limits(limits=1, user_api="blas"):
        cofactors = 1.0 / shares
        redundancy = float(np.trace(r))
        return simulate_critical_values(
            statistics, shares, cofactors, redundancy, law, alpha, replicas, seed, family_alpha=family_alpha, power=power
        )


def simulate_critical_values(
    statistics: StatisticsOf,
    shares: Floats,
    cofactors: Floats,
    redundancy: float,
    law: Distribution,
    alpha: float = 0.001,
    replicas: int = 2000,
    seed: int = 0,
    *,
    family_alpha: float = 0.05,
    power: float = 0.80,
) -> CriticalValues:
    """Return critical values for any map from errors to w and v'Pv.

    Parameters
    ----------
    statistics : callable
        Maps independent errors of unit variance, (n, k), to w, (n, k), and v'Pv, (k,).
    shares : (n,) array
        Redundancy numbers, or what stands for them where observations are correlated.
    cofactors : (n,) array
        Squared size of a bias that shifts w by one: 1 / (P Qvv P)_ii.
    redundancy : float
        r.
    law, alpha, replicas, seed, family_alpha, power
        As in `critical_values`.

    Returns
    -------
    CriticalValues

    Raises
    ------
    UsageError
        As in `critical_values`.
    """
    for name, level in (("alpha", alpha), ("family_alpha", family_alpha), ("power", power)):
        check_level(level, name)
    check_redundancy(redundancy)
    deviation = law.std()
    if not np.isfinite(deviation):
        raise UsageError(f"the law {law.family} has no variance: w and tau have none either")
    if replicas < 200:
        raise UsageError(f"{replicas} replicas are too few; 200 are the least")
    shares = np.asarray(shares, dtype=float)
    members, kept = _classes(shares, alpha, replicas)
    centred = law.loc if law.symmetric else law.mean()

    def draw(rng: np.random.Generator) -> Floats:
        return (law.rvs(len(shares), rng) - centred) / deviation

    w, s0, largest = _simulate(statistics, shares, redundancy, draw, kept, replicas, seed)
    _, s0_normal, largest_normal = _simulate(
        statistics, shares, redundancy, lambda rng: rng.standard_normal(len(shares)), kept[:0], replicas, seed
    )
    exact_w, exact_tau, exact_delta = -float(stats.norm.ppf(alpha / 2.0)), critical_tau(redundancy, alpha), delta0(alpha, power)
    classes = []
    found = np.full(len(shares), np.nan)
    for k in range(int(members.max()) + 1):
        rows = members == k
        values = w[members[kept] == k]
        limit = _upper_quantile(np.abs(values), alpha)
        scaled = np.abs(values) / s0
        shift = _shift(values, limit[0], power)
        found[rows] = shift[0]
        classes.append(
            RedundancyClass(
                float(shares[rows].min()),
                float(shares[rows].max()),
                int(rows.sum()),
                Limit(*limit, exact_w),
                Limit(*_upper_quantile(scaled, alpha), exact_tau),
                float(np.mean(np.abs(values) > exact_w)),
                float(np.mean(scaled > exact_tau)),
                Limit(shift[0], float(np.hypot(shift[1], limit[1])), exact_delta),
            )
        )
    size = np.sqrt(np.where(members >= 0, cofactors, np.nan))
    return CriticalValues(
        law=law,
        alpha=alpha,
        family_alpha=family_alpha,
        power=power,
        replicas=replicas,
        seed=seed,
        classes=tuple(classes),
        family_w=Limit(*_upper_quantile(largest[None], family_alpha), *_upper_quantile(largest_normal[None], family_alpha)),
        family_tau=Limit(
            *_upper_quantile((largest / s0)[None], family_alpha), *_upper_quantile((largest_normal / s0_normal)[None], family_alpha)
        ),
        members=members,
        mdb=found * size,
        mdb_normal=exact_delta * size,
    )


def _classes(shares: Floats, alpha: float, replicas: int) -> tuple[Ints, Ints]:
    """Return the class of each observation, and the observations whose simulated w are kept, evenly spread over the redundancy."""
    seen = np.flatnonzero(shares >= UNCONTROLLED)
    if not len(seen):
        raise UsageError("no observation is controlled by others")
    order = seen[np.argsort(shares[seen], kind="stable")]
    room = max(int(KEPT // replicas), CLASSES)
    kept = order if len(order) <= room else order[np.linspace(0, len(order) - 1, room).round().astype(int)]
    beyond = alpha * len(kept) * replicas
    if beyond < LEAST_BEYOND:
        need = int(np.ceil(LEAST_BEYOND / (alpha * len(kept))))
        raise UsageError(f"{replicas} replicas are too few for a level of {alpha:g} with {len(kept)} observations; {need} are needed")
    number = int(min(CLASSES, beyond // LEAST_BEYOND))
    ordered = shares[order]
    edges = np.unique(ordered[(np.arange(1, number) * len(order)) // number])
    codes = np.searchsorted(edges, ordered * (1.0 + 1e-9), side="right")  # equal numbers up to rounding stay together
    members = np.full(len(shares), -1)
    members[order] = np.unique(codes, return_inverse=True)[1]
    return members, kept


def _simulate(
    statistics: StatisticsOf,
    shares: Floats,
    redundancy: float,
    draw: Callable[[np.random.Generator], Floats],
    kept: Ints,
    replicas: int,
    seed: int,
) -> tuple[Floats, Floats, Floats]:
    """Return w of the kept observations (k, B), s0 (B,) and the largest |w| of all controlled ones (B,)."""
    seen = shares >= UNCONTROLLED
    children = np.random.SeedSequence(seed).spawn(replicas)
    width = max(1, int(_CHUNK // len(shares)))
    w, s0, largest = np.empty((len(kept), replicas)), np.empty(replicas), np.empty(replicas)
    for start in range(0, replicas, width):
        chunk = children[start : start + width]
        errors = np.stack([draw(np.random.default_rng(child)) for child in chunk], axis=1)
        values, vpv = statistics(errors)
        at = slice(start, start + len(chunk))
        w[:, at], s0[at] = values[kept], np.sqrt(vpv / redundancy)
        largest[at] = np.abs(values[seen]).max(axis=0)
    return w, s0, largest


def _upper_quantile(values: Floats, alpha: float) -> tuple[float, float]:
    """Return the value that a share alpha exceeds, and its standard error: replicas are independent, the values of one replica are not."""
    q = float(np.quantile(values, 1.0 - alpha))
    error = float(np.std(np.mean(values > q, axis=0), ddof=1) / np.sqrt(values.shape[1]))
    low, high = np.quantile(values, np.clip([1.0 - alpha - error, 1.0 - alpha + error], 0.0, 1.0))
    return q, 0.5 * float(high - low)


def _shift(w: Floats, limit: float, power: float) -> tuple[float, float]:
    """Return the shift of w at which a share `power` of |w + shift| exceeds the limit, and its standard error for a given limit."""

    def missing(shift: float) -> float:
        return float(np.mean(np.abs(w + shift) > limit)) - power

    high = limit + 10.0
    shift = float(optimize.brentq(missing, 0.0, high, xtol=1e-10))
    error = float(np.std(np.mean(np.abs(w + shift) > limit, axis=0), ddof=1) / np.sqrt(w.shape[1]))
    low, high = np.quantile(w, np.clip([1.0 - power - error, 1.0 - power + error], 0.0, 1.0))
    return shift, 0.5 * float(high - low)
