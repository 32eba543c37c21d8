"""Sizes and powers by simulation: every test of `baarda.hypotheses` rejects true hypotheses as often as it says."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
from scipy import stats
from threadpoolctl import threadpool_limits

from baarda.discover import modules
from baarda.hypotheses import (
    _linear_model,
    check_points,
    data_snooping,
    deformation_point,
    global_variance_factor,
    goodness_of_fit,
    homogeneity,
    image_points,
    moments,
    run,
)
from baarda.hypotheses import deformation as deformation_test
from baarda.hypotheses.base import Evidence
from baarda.hypotheses.levels import Options, Policy, power_of_test
from baarda.hypotheses.outliers import delta0
from baarda.hypotheses.parameters import bivariate_parameters, general_linear

pytestmark = pytest.mark.sampling


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with threadpool_limits(limits=1, user_api="blas"):  # the matrices are small: threads would only wait for each other
        yield


LEVELS = (0.10, 0.05, 0.01)
SETS, PER_SET, CONTROL, REPLICAS = 5, 14, 5, 199
# Asymptotic or approximate laws are not in the network below: its evidence can be simulated and its check points are exact.


class Network:
    """A small network with fixed geometry: images, additional parameters, weighted control, check points."""

    def __init__(self, correlated: bool = False) -> None:
        rng = np.random.default_rng(11)
        n = SETS * PER_SET + CONTROL
        self.images = np.where(np.arange(n) < n - CONTROL, np.arange(n) % SETS, -1)
        points = rng.standard_normal((n, 4))
        points[n - CONTROL :] = np.eye(CONTROL, 4)
        orientation = (self.images[:, None] == np.arange(SETS)) * rng.standard_normal((n, 1))
        additional = rng.standard_normal((n, 3)) * (self.images >= 0)[:, None]
        additional[:, 1] += 4.0 * additional[:, 0]  # highly correlated estimates
        self.design = np.column_stack([points, orientation, additional])
        self.covariance = np.diag(rng.uniform(0.5, 2.0, n))
        if correlated:
            root = np.eye(n)
            for i in range(0, n - CONTROL - 1, 2):
                root[i + 1, i] = 0.7
            self.covariance = root @ self.covariance @ root.T
        self.root = np.linalg.cholesky(self.covariance)
        self.check = rng.standard_normal((4, self.design.shape[1]))
        u = self.design.shape[1]
        self.additional = list(range(u - 3, u))
        self.control = list(range(n - CONTROL, n))

    def evidence(self, rng: np.random.Generator, shift: np.ndarray | float = 0.0) -> Evidence:
        """Return the evidence of one data set of normal errors around true unknowns of zero."""
        observed = self.root @ rng.standard_normal(len(self.design)) + shift
        return _linear_model.linear_model(
            self.design,
            observed,
            self.covariance,
            images=self.images,
            additional=self.additional,
            control=self.control,
            check=(self.check, np.zeros(4)),
        )


def z_of_rates(rates: list[float], expected: float) -> float:
    """Return the deviation of a mean of independent rates from its expectation in standard errors."""
    x = np.asarray(rates)
    spread = max(float(x.std(ddof=1)), np.sqrt(expected * (1 - expected) / len(x)) * 1e-3)
    return float((x.mean() - expected) / (spread / np.sqrt(len(x))))


def replicas(network: Network, count: int, seed: int) -> Iterator[tuple[int, Evidence]]:
    for k, child in enumerate(np.random.SeedSequence(seed).spawn(count)):
        yield k, network.evidence(np.random.default_rng(child))


# Null laws by simulation do not depend on the variance factor that judges; the others are cheap enough for both.
SIMULATED = (moments, homogeneity, goodness_of_fit)
CLOSED = tuple(m for m in modules("baarda.hypotheses") if hasattr(m, "from_evidence") and m not in SIMULATED)
CASES = [
    (CLOSED, "aposteriori", False),
    (CLOSED, "aposteriori", True),
    (CLOSED, "apriori", False),
    (CLOSED, "apriori", True),
    ((moments,), "aposteriori", False),
    ((moments,), "aposteriori", True),
    ((homogeneity,), "aposteriori", False),
    ((homogeneity,), "aposteriori", True),
    ((goodness_of_fit,), "aposteriori", False),
    ((goodness_of_fit,), "aposteriori", True),
]


def _label(case: tuple[tuple[ModuleType, ...], str, bool]) -> str:
    members, sigma, correlated = case
    head = members[0].__name__.rpartition(".")[2] if len(members) == 1 else "closed"
    return f"{head}-{sigma}-{'correlated' if correlated else 'diagonal'}"


@pytest.mark.parametrize("case", CASES, ids=_label)
def test_every_test_has_its_level(case: tuple[tuple[ModuleType, ...], str, bool]) -> None:
    """4000 adjustments: every test of every member, a new member's too, rejects true hypotheses at 10, 5 and 1 %."""
    members, sigma, correlated = case
    network = Network(correlated)
    rates: dict[tuple[str, float], list[float]] = {}
    for k, e in replicas(network, 4000, 5):
        options = Options(sigma=sigma, seed=1_000_000 + k, replicas=REPLICAS)  # type: ignore[arg-type]
        for t in (t for m in members for t in m.from_evidence(e, options)):
            p = np.atleast_1d(t.p_value)
            for level in LEVELS:
                # Simulated p-values are multiples of 1/200 (two-sided 2/200): "p <= level" is exact, "p < level" a step below.
                rates.setdefault((t.name, level), []).append(float((p <= level + 1e-12).mean()))
    wrong = {key: (np.mean(x), z) for key, x in rates.items() if abs(z := z_of_rates(x, key[1])) > 4.0}
    assert not wrong
    every = {t.name for t in run(e, Options(sigma=sigma, replicas=REPLICAS))}  # type: ignore[arg-type]
    found = {name for name, _ in rates}
    assert found <= every
    expected = {
        "moments": {"mean_of_residuals", "skewness_of_residuals", "kurtosis_of_residuals", "jarque_bera"},
        "homogeneity": {"bartlett_images", "variance_per_image"},
        "goodness_of_fit": {"goodness_of_fit"},
    }
    head = members[0].__name__.rpartition(".")[2] if len(members) == 1 else ""
    # The closed members give all that the simulated ones do not.
    assert found == (expected[head] if head else every - set().union(*expected.values()))
    assert head or len(found) >= 8


def test_power_of_the_mean() -> None:
    """A systematic part c in all observations (in units of their sigmas) shifts 1'v: noncentral t with delta = c sqrt(1'Qvv1)."""
    network = Network()
    sigmas = np.sqrt(np.diag(network.covariance))
    a = network.design / sigmas[:, None]
    rest = np.eye(len(a)) - a @ np.linalg.pinv(a)
    c = 3.0 / np.sqrt(rest.sum())
    hits = []
    for k, child in enumerate(np.random.SeedSequence(16).spawn(4000)):
        e = network.evidence(np.random.default_rng(child), c * sigmas)
        t = next(t for t in moments.from_evidence(e, Options(seed=k, replicas=19)) if t.name == "mean_of_residuals")
        hits.append(float(t.p_value <= 0.05))
    r = e.redundancy - 1
    limit = stats.t.isf(0.025, r)
    expected = float(stats.nct.sf(limit, r, 3.0) + stats.nct.cdf(-limit, r, 3.0))
    assert 0.5 < expected < 0.95
    assert abs(z_of_rates(hits, expected)) <= 4.0


@pytest.mark.parametrize("policy", ["sidak", "bonferroni", "holm", "fdr"])
def test_families_keep_their_level(policy: Policy) -> None:
    network, any_rejected = Network(), {}
    count = 1000
    for k, e in replicas(network, count, 6):
        for t in run(e, Options(seed=k, replicas=19, levels=policy)):
            if t.labels:
                any_rejected[t.name] = any_rejected.get(t.name, 0) + bool(np.any(t.rejected))
    assert len(any_rejected) >= 6
    bound = 0.05 + 4.0 * np.sqrt(0.05 * 0.95 / count)
    too_many = {name: hits / count for name, hits in any_rejected.items() if hits / count > bound}
    assert not too_many


def test_power_of_the_general_hypothesis_and_of_pairs() -> None:
    """Power of F(3, r), chi2(3) and F(2, r) against the noncentral laws."""
    network = Network()
    shift = network.design[:, network.additional] @ np.array([0.35, -0.1, 0.2])
    hits = {"f": [], "chi2": [], "pair": []}
    for child in np.random.SeedSequence(7).spawn(3000):
        e = network.evidence(np.random.default_rng(child), shift)
        x, q = e.additional.values, e.additional.cofactors  # type: ignore[union-attr]
        hits["f"].append(float(general_linear(x, q, e.variance_factor, e.redundancy).rejected))
        hits["chi2"].append(float(general_linear(x, q, 1.0, np.inf).rejected))
        hits["pair"].append(float(bivariate_parameters(x, q, e.variance_factor, e.redundancy, 0.9).rejected[0]))
    truth = np.array([0.35, -0.1, 0.2])
    lam = truth @ np.linalg.solve(q, truth)
    two = truth[:2] @ np.linalg.solve(q[:2, :2], truth[:2])
    assert abs(z_of_rates(hits["f"], power_of_test(lam, 0.05, 3, e.redundancy))) <= 4.0
    assert abs(z_of_rates(hits["chi2"], power_of_test(lam, 0.05, 3))) <= 4.0
    assert abs(z_of_rates(hits["pair"], power_of_test(two, 0.05, 2, e.redundancy))) <= 4.0


def test_power_of_the_global_test_and_of_check_points() -> None:
    network = Network()
    shift = np.array([0.5, -0.4, 0.8, 0.2])
    hits: dict[str, list[float]] = {"global": [], "check": []}
    for child in np.random.SeedSequence(14).spawn(3000):
        e = network.evidence(np.random.default_rng(child))
        # Errors 1.2 times as large as they should be.
        hits["global"].append(float(global_variance_factor(1.44 * e.vpv, e.redundancy).rejected))
        c = e.check
        assert c is not None
        hits["check"].append(float(check_points(c.values + shift, c.cofactors, e.variance_factor, e.redundancy).rejected))
    law = stats.chi2(e.redundancy)
    assert abs(z_of_rates(hits["global"], law.cdf(law.ppf(0.025) / 1.44) + law.sf(law.ppf(0.975) / 1.44))) <= 4.0
    lam = shift @ np.linalg.solve(c.cofactors, shift)
    assert 0.3 < power_of_test(lam, 0.05, 4, e.redundancy) < 0.95
    assert abs(z_of_rates(hits["check"], power_of_test(lam, 0.05, 4, e.redundancy))) <= 4.0


@pytest.mark.parametrize("row", [0, 17, 72])
def test_the_minimal_detectable_bias_is_detected_with_its_power(row: int) -> None:
    network = Network(correlated=True)
    e = network.evidence(np.random.default_rng(0))
    bias = delta0(0.001, 0.80) / np.sqrt(e.pqvvp[row])  # type: ignore[index]
    shift = bias * np.eye(len(network.design))[row]
    found = []
    for child in np.random.SeedSequence(8).spawn(3000):
        e = network.evidence(np.random.default_rng(child), shift)
        found.append(float(data_snooping(e.pv / np.sqrt(e.pqvvp), alpha=0.001).rejected[row]))  # type: ignore[operator]
    assert abs(z_of_rates(found, 0.80)) <= 4.0


@pytest.mark.parametrize("aposteriori", [False, True])
def test_image_points(aposteriori: bool) -> None:
    network = Network(correlated=True)
    a, p = network.design, np.linalg.inv(network.covariance)
    qvv = network.covariance - a @ np.linalg.solve(a.T @ p @ a, a.T)
    m = p @ qvv @ p
    pairs = [(i, i + 1) for i in range(0, SETS * PER_SET, 2)]
    blocks = np.array([m[np.ix_(at, at)] for at in pairs])
    rates: dict[float, list[float]] = {level: [] for level in LEVELS}
    for _, e in replicas(network, 4000, 9):
        known = (e.sigma0, e.redundancy) if aposteriori else (1.0, None)
        t = image_points(e.pv[np.array(pairs)], blocks, *known)  # type: ignore[index]
        for level in LEVELS:
            rates[level].append(float((t.p_value < level).mean()))
    assert all(abs(z_of_rates(x, level)) <= 4.0 for level, x in rates.items())


@pytest.mark.parametrize("share", [0.02, 0.3, 1.0, 10.0])
@pytest.mark.parametrize("r", [8, 40])
def test_check_points_with_a_reference_of_their_own(share: float, r: int) -> None:
    """The approximate law: its size is within a tenth of the level from r = 40 on, within a quarter at r = 8."""
    rng = np.random.default_rng(10)
    root = rng.standard_normal((6, 8))
    q, c = root @ root.T, share * np.diag(rng.uniform(2.0, 12.0, 6))
    lower = np.linalg.cholesky(q + c)
    count = 20_000
    d = rng.standard_normal((count, 6)) @ lower.T
    s2 = rng.chisquare(r, count) / r
    rejected = np.mean([check_points(d[k], q, s2[k], r, c).p_value < 0.05 for k in range(count)])
    assert abs(rejected - 0.05) < (0.005 if r == 40 else 0.0125) + 4.0 * np.sqrt(0.05 * 0.95 / count)


def test_deformation_and_its_points() -> None:
    rng = np.random.default_rng(12)
    m, r = 6, 25
    base = np.eye(3 * m) - np.kron(np.full((m, m), 1.0 / m), np.eye(3))  # three translations are free
    root = base @ rng.standard_normal((3 * m, 3 * m + 4))
    q = root @ root.T
    groups = [str(i // 3) for i in range(3 * m)]
    joint: dict[float, list[float]] = {level: [] for level in LEVELS}
    single: dict[float, list[float]] = {level: [] for level in LEVELS}
    for _ in range(4000):
        d, s2 = root @ rng.standard_normal(root.shape[1]), rng.chisquare(r) / r
        p, each = deformation_test(d, q, s2, r).p_value, deformation_point(d, q, s2, r, groups).p_value
        for level in LEVELS:
            joint[level].append(float(p < level))
            single[level].append(float((each < level).mean()))
    for level in LEVELS:
        assert abs(z_of_rates(joint[level], level)) <= 4.0
        assert abs(z_of_rates(single[level], level)) <= 4.0


def test_tau_of_independent_values_is_uniform_in_p() -> None:
    rng = np.random.default_rng(13)
    p = []
    for _ in range(4000):
        x = rng.standard_normal(7)
        v = x.mean() - x
        p.append(float(data_snooping(v / np.sqrt(v @ v / 6 * 6 / 7), redundancy=6).p_value[0]))
    assert stats.kstest(p, "uniform").pvalue > 1e-4
