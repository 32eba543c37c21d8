"""What replicas prove: ratios of sampled to predicted sigmas, sizes of tests, power at the minimal detectable bias, with their chances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.hypotheses.outliers import delta0
from baarda.procedures.simulation import Replicas

Floats = NDArray[np.float64]

LIMIT = 4.0  # standard errors beyond which chance is no explanation
FEWEST = 5.0  # rejections to be expected before a rate tells anything


@dataclass(frozen=True)
class SigmaProof:
    """Sampled against predicted standard deviations of some unknowns.

    Attributes
    ----------
    name : str
    count : int
        Number of unknowns.
    predicted : float
        Median of their predicted standard deviations.
    ratio : float
        Root mean square of errors divided by predicted sigmas.
    low, high : float
        95 % interval of the true ratio, from chi-square; its degrees of freedom are estimated where unknowns are correlated.
    z : float
        Deviation from 1 in standard errors.
    """

    name: str
    count: int
    predicted: float
    ratio: float
    low: float
    high: float
    z: float

    @property
    def holds(self) -> bool:
        """Whether chance explains the deviation."""
        return abs(self.z) <= LIMIT


@dataclass(frozen=True)
class RateProof:
    """The rate of rejections against what it should be.

    Attributes
    ----------
    name : str
    members : float
        Mean number of members of the family, 1 for a single test.
    expected, rate : float
    low, high : float
        95 % interval of the true rate.
    z : float
        Deviation in standard errors; NaN where fewer than 5 rejections are to be expected.
    """

    name: str
    members: float
    expected: float
    rate: float
    low: float
    high: float
    z: float

    @property
    def told(self) -> bool:
        """Whether the replicas suffice to tell."""
        return bool(np.isfinite(self.z))

    @property
    def holds(self) -> bool:
        """Whether chance explains the deviation, or nothing can be told."""
        return not self.told or abs(self.z) <= LIMIT


@dataclass(frozen=True)
class Proof:
    """All that replicas prove.

    Attributes
    ----------
    replicas : Replicas
    sigmas : tuple of SigmaProof
        One per group of unknowns.
    residuals : SigmaProof
        Residuals against their own sigmas.
    objective : RateProof
        Mean of v'Pv against r.
    sizes : tuple of RateProof
        One per test.
    power : RateProof or None
        Of w at the minimal detectable bias.
    identified : float
        Share of these biases whose observation has the largest |w|.
    worst : (str, float, float)
        The unknown with the most deviating ratio, this ratio, and its probability among so many.
    bias : (str, float, float)
        The unknown with the largest mean error, in its sigmas, and its probability among so many.
    """

    replicas: Replicas
    sigmas: tuple[SigmaProof, ...]
    residuals: SigmaProof
    objective: RateProof
    sizes: tuple[RateProof, ...]
    power: RateProof | None
    identified: float
    worst: tuple[str, float, float]
    bias: tuple[str, float, float]

    @property
    def holds(self) -> bool:
        """Whether nothing contradicts the predictions."""
        rates = (*self.sizes, self.objective, *((self.power,) if self.power else ()))
        single = float(2.0 * stats.norm.sf(LIMIT))
        return all(p.holds for p in (*self.sigmas, self.residuals, *rates)) and self.worst[2] >= single and self.bias[2] >= single


def sigma_proof(name: str, means: Floats, count: int, predicted: float) -> SigmaProof:
    """Judge the mean squares of standardised errors of one group over independent replicas.

    Parameters
    ----------
    name : str
    means : (k,) array
        Mean square of the standardised errors of each replica.
    count : int
        Number of errors behind each mean.
    predicted : float
        Their predicted sigma.

    Returns
    -------
    SigmaProof

    Notes
    -----
    With k independent replicas k f m / 1 is chi-square(k f), f = 1 for a single unknown; for several, f is found from the scatter of the
    means (variance 2 / f; Satterthwaite 1946) and lies between 1 and their number.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> sigma_proof("x", rng.standard_normal(500) ** 2, 1, 0.1).holds
    True
    """
    k, mean = len(means), float(means.mean())
    freedom = 1.0
    if count > 1:
        scatter = float(means.var(ddof=1)) / max(mean, np.finfo(float).tiny) ** 2
        freedom = float(np.clip(2.0 / scatter if scatter > 0.0 else count, 1.0, count))
    df = k * freedom
    law = stats.chi2(df)
    low, high = np.sqrt(mean * df / law.ppf([0.975, 0.025]))
    p = min(float(law.cdf(df * mean)), float(law.sf(df * mean)))
    z = float(np.sign(mean - 1.0) * stats.norm.isf(max(p, 1e-300)))
    return SigmaProof(name, count, predicted, float(np.sqrt(mean)), float(low), float(high), z)


def rate_proof(name: str, rejected: Floats, tested: Floats, expected: float) -> RateProof:
    """Judge a rate of rejections over independent replicas.

    Parameters
    ----------
    name : str
    rejected, tested : (k,) arrays
        Numbers of each replica.
    expected : float
        Level or power.

    Returns
    -------
    RateProof
        Binomial for a single test. The members of a family depend on each other: their standard error comes from the scatter between
        replicas, never below that of independent members.

    Examples
    --------
    >>> rate_proof("t", np.array([0.0, 1.0] * 50), np.ones(100), 0.5).holds
    True
    """
    used = tested > 0
    r, m = rejected[used], tested[used]
    k = len(r)
    if not k:
        return RateProof(name, 0.0, expected, np.nan, np.nan, np.nan, np.nan)
    total, members = float(m.sum()), float(m.mean())
    rate = float(r.sum()) / total
    binomial = expected * (1.0 - expected) / total
    scatter = float(((r - rate * m) ** 2).sum()) / total**2 * k / max(k - 1, 1) if members > 1 else 0.0
    z = (rate - expected) / np.sqrt(max(binomial, scatter)) if min(expected, 1.0 - expected) * total >= FEWEST else np.nan
    hits = float(r.sum())
    if members > 1.0 and hits == 0.0:
        low, high = 0.0, float(-np.expm1(np.log(0.025) / k))  # as if the members of a replica were one
    elif members <= 1.0:
        low = float(stats.beta.ppf(0.025, hits, total - hits + 1)) if hits > 0 else 0.0
        high = float(stats.beta.ppf(0.975, hits + 1, total - hits)) if hits < total else 1.0
    else:
        half = 1.959964 * float(np.sqrt(max(scatter, rate * (1.0 - rate) / total)))
        low, high = max(0.0, rate - half), min(1.0, rate + half)
    return RateProof(name, members, expected, rate, low, high, float(z))


def prove(replicas: Replicas) -> Proof:
    """Compare replicas with what was predicted.

    Parameters
    ----------
    replicas : Replicas

    Returns
    -------
    Proof

    Examples
    --------
    >>> from baarda.procedures.planning import plan
    >>> from baarda.procedures.simulation import simulate
    >>> from baarda.procedures.synthetic import ring
    >>> prove(simulate(plan(ring(4, points=10).network), 8, seed=1)).holds
    True
    """
    b, a = replicas.batch, replicas.planned.adjustment
    k, o = replicas.count, replicas.planned.options
    kinds = _kinds(replicas)
    sigmas = tuple(
        sigma_proof(name, b.groups[:, i], int(replicas.group_counts[i]), float(np.median(replicas.sigmas[kinds == i])))
        for i, name in enumerate(replicas.group_names)
    )
    seen = np.isfinite(b.residuals)
    # Residuals are pooled: v'Pv tells their scatter, this ratio each one's share of it.
    means = b.vpv / a.redundancy
    ratio = float(np.mean(b.residuals[seen]) / k)
    residuals = sigma_proof("residuals", means * ratio / float(means.mean()), a.redundancy, float(np.median(np.sqrt(a.qvv[seen]))))
    r = float(a.redundancy)
    low, high = (float(np.mean(b.vpv) + s * 1.959964 * np.sqrt(2.0 * r / k)) for s in (-1.0, 1.0))
    objective = RateProof("v'Pv", 1.0, r, float(np.mean(b.vpv)), low, high, float((np.mean(b.vpv) - r) / np.sqrt(2.0 * r / k)))
    sizes = tuple(
        rate_proof(name, b.rejected[:, i], b.tested[:, i], level) for i, (name, level) in enumerate(zip(b.names, b.levels, strict=True))
    )
    used = np.isfinite(b.biased[:, 0])
    power, identified = None, float("nan")
    if used.any():
        d, limit = delta0(o.alpha_outlier, o.power), float(stats.norm.isf(o.alpha_outlier / 2.0))
        expected = float(stats.norm.sf(limit - d) + stats.norm.cdf(-limit - d))
        power = rate_proof("w at the minimal detectable bias", b.biased[used, 1], np.ones(int(used.sum())), expected)
        identified = float(b.biased[used, 2].mean())
    return Proof(replicas, sigmas, residuals, objective, sizes, power, identified, *_extremes(replicas))


def _kinds(replicas: Replicas) -> Floats:
    from baarda.procedures.simulation import groups_of

    return np.asarray(groups_of(replicas.planned.adjustment)[0])


def _extremes(replicas: Replicas) -> tuple[tuple[str, float, float], tuple[str, float, float]]:
    """Return the most deviating ratio and the largest mean error of single unknowns, with Bonferroni's probability."""
    b, k, numbering = replicas.batch, replicas.count, replicas.planned.adjustment.numbering
    u = len(b.sums)
    law = stats.chi2(k)
    p = 2.0 * np.minimum(law.cdf(b.squares), law.sf(b.squares))
    i = int(np.argmin(p))
    mean = b.sums / k
    j = int(np.argmax(np.abs(mean)))
    chance = 2.0 * float(stats.norm.sf(abs(mean[j]) * np.sqrt(k)))
    worst = (numbering.name(i), float(np.sqrt(b.squares[i] / k)), min(1.0, u * float(p[i])))
    return worst, (numbering.name(j), float(mean[j]), min(1.0, u * chance))
