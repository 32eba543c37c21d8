"""An exam that every member of `baarda.hypotheses` sits: nobody needs to write it for a new file."""

from __future__ import annotations

import json
from types import ModuleType

import numpy as np
import pytest

from baarda.discover import modules
from baarda.hypotheses import base, run
from baarda.hypotheses._linear_model import linear_model
from baarda.hypotheses.base import Evidence, TestResult
from baarda.hypotheses.levels import Options

MEMBERS = [m for m in modules("baarda.hypotheses") if hasattr(m, "from_evidence")]
POLICIES = ("none", "sidak", "bonferroni", "holm", "fdr", "baarda")
REQUIRED = {
    "global_variance_factor",
    "mean_of_residuals",
    "skewness_of_residuals",
    "kurtosis_of_residuals",
    "bartlett_images",
    "variance_per_image",
    "all_additional_parameters",
    "additional_parameter",
    "bivariate_additional_parameters",
    "orthogonalised_additional_parameters",
    "data_snooping",
    "control_points",
    "check_points",
    "check_point",
}


def evidence(unit: float = 1.0, sigma0: float = 1.0, correlated: bool = False, reference: bool = False) -> Evidence:
    """Return the evidence of a small network with images, additional parameters, weighted control and check points."""
    rng = np.random.default_rng(20)
    n, sets, d = 96, 6, 6
    images = np.where(np.arange(n) < n - d, np.arange(n) % sets, -1)
    points = rng.standard_normal((n, 5))
    points[n - d :] = np.eye(d, 5)
    orientation = (images[:, None] == np.arange(sets)) * rng.standard_normal((n, 1))
    additional = rng.standard_normal((n, 3)) * (images >= 0)[:, None]
    a = np.column_stack([points, orientation, additional])
    c = np.diag(rng.uniform(0.5, 2.0, n))
    if correlated:
        root = np.kron(np.eye(n // 2), np.array([[1.0, 0.0], [0.6, 1.0]]))
        c = root @ c @ root.T
    l_ = np.linalg.cholesky(c) @ rng.standard_normal(n)
    f = rng.standard_normal((4, a.shape[1]))
    c_s = np.diag([0.1, 0.2, 0.1, 0.3]) * unit**2 if reference else None
    where = {"images": images, "additional": [11, 12, 13], "control": range(n - d, n)}
    return linear_model(a, l_ * unit, c * unit**2, sigma0, check=(f, 0.05 * rng.standard_normal(4) * unit), check_covariance=c_s, **where)


VARIANTS = {
    "plain": evidence(),
    "correlated": evidence(correlated=True),
    "reference": evidence(reference=True),
    "residuals only": Evidence(residuals=evidence().residuals, sigmas=evidence().sigmas, vpv=evidence().vpv, redundancy=82),
    "no simulation": Evidence(**{**vars(evidence()), "residuals_of": None}),
}


@pytest.fixture(params=MEMBERS, ids=lambda m: m.__name__.rpartition(".")[2])
def member(request: pytest.FixtureRequest) -> ModuleType:
    return request.param  # type: ignore[no-any-return]


def results(member: ModuleType, e: Evidence, **options: object) -> list[TestResult]:
    return member.from_evidence(e, Options(**{"replicas": 199, **options}))  # type: ignore[arg-type, no-any-return]


def test_a_member_says_what_it_is(member: ModuleType) -> None:
    first = (member.__doc__ or "").splitlines()[0]
    assert first.endswith(".")
    for name in getattr(member, "__all__", ()):
        assert getattr(member, name).__doc__, name


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("sigma", ["aposteriori", "apriori"])
def test_results_are_whole(member: ModuleType, variant: str, sigma: str) -> None:
    for t in results(member, VARIANTS[variant], sigma=sigma):
        assert isinstance(t, TestResult)
        assert t.name.isidentifier()
        assert t.name == t.name.lower()
        assert t.null[0].isupper()
        assert t.null.endswith(".")
        assert t.law_name
        p, statistic = np.asarray(t.p_value), np.asarray(t.statistic)
        assert p.shape == statistic.shape
        assert ((p >= 0.0) & (p <= 1.0) | np.isnan(statistic)).all()
        assert (np.isnan(p) == np.isnan(statistic)).all()
        assert 0.0 < t.alpha < 1.0
        assert np.asarray(t.rejected).shape == statistic.shape
        if statistic.ndim:
            assert len(t.labels) == len(statistic)
            assert len(set(t.labels)) == len(t.labels)
        else:
            assert t.labels == ()
        json.dumps(dict(t.details), allow_nan=False)
        assert all(np.isfinite(t.df))


@pytest.mark.parametrize("variant", VARIANTS)
def test_critical_values_agree_with_p_values(member: ModuleType, variant: str) -> None:
    for t in results(member, VARIANTS[variant]):
        limits = np.atleast_1d(t.critical)
        assert np.isfinite(limits).all()
        assert len(limits) == (2 if t.tail == "two-sided" else 1)
        statistic, p = np.atleast_1d(t.statistic), np.atleast_1d(t.p_value)
        # Where the laws of a family differ, the limit is that of the extreme member; it judges that one.
        at = [int(np.nanargmin(p))]
        if t.tail == "two-sided":
            beyond = (statistic[at] < limits[0]) | (statistic[at] > limits[1])
        else:
            beyond = statistic[at] > limits[0] if t.tail == "right" else statistic[at] < limits[0]
        near = np.isclose(p[at], t.alpha, rtol=0.02) | (np.abs(p[at] - t.alpha) <= 2.0 / 200)  # a simulated law has steps
        assert (beyond == np.atleast_1d(t.rejected)[at])[~near].all(), t.name


def test_laws_are_laws(member: ModuleType) -> None:
    for t in results(member, VARIANTS["plain"]):
        statistic = np.asarray(t.statistic, dtype=float)
        below, above = np.asarray(t.law.cdf(statistic)), np.asarray(t.law.sf(statistic))
        # Continuous laws sum to 1, simulated ones count the value itself on both sides.
        assert (below + above >= 1.0 - 1e-9).all(), t.name
        assert (below + above <= 1.0 + 2.0 / 200 + 1e-9).all(), t.name
        q = np.array([0.01, 0.3, 0.5, 0.9, 0.99])
        quantiles = np.array([float(t.law.ppf(v)) for v in q])
        assert (np.diff(quantiles) >= 0.0).all(), t.name


@pytest.mark.parametrize(("unit", "sigma0"), [(1000.0, 1.0), (1e-6, 1.0), (1.0, 3.0)])
@pytest.mark.parametrize("sigma", ["aposteriori", "apriori"])
def test_units_do_not_matter(member: ModuleType, unit: float, sigma0: float, sigma: str) -> None:
    for correlated in (False, True):
        one = results(member, evidence(correlated=correlated), sigma=sigma)
        two = results(member, evidence(unit, sigma0, correlated), sigma=sigma)
        assert [t.name for t in one] == [t.name for t in two]
        for a, b in zip(one, two, strict=True):
            np.testing.assert_allclose(a.p_value, b.p_value, rtol=1e-6, atol=1e-12, err_msg=a.name)


def test_the_same_seed_gives_the_same_result(member: ModuleType) -> None:
    for a, b in zip(results(member, VARIANTS["plain"]), results(member, VARIANTS["plain"]), strict=True):
        np.testing.assert_array_equal(a.p_value, b.p_value)


@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_of_levels(member: ModuleType, policy: str) -> None:
    plain = {t.name: t for t in results(member, VARIANTS["plain"])}
    for t in results(member, VARIANTS["plain"], levels=policy):
        np.testing.assert_array_equal(t.p_value, plain[t.name].p_value)
        too_few = "simulated" in t.law_name and t.alpha * 200 < 2  # 199 replicas cannot show the corrected level: no finite limit
        assert np.isfinite(np.atleast_1d(t.critical)).all() or too_few


def test_a_perfect_fit_is_not_an_error(member: ModuleType) -> None:
    e = linear_model(np.ones((9, 1)), np.ones(9), images=np.arange(9) % 3, additional=[0], control=[0, 1])
    assert isinstance(results(member, e), list)


def test_all_tests_of_the_contract_run_in_a_stable_order() -> None:
    names = [t.name for t in run(VARIANTS["plain"], Options(replicas=199))]
    assert set(names) >= REQUIRED
    assert names[0] == "global_variance_factor"
    assert names == [t.name for t in run(VARIANTS["plain"], Options(replicas=199))]
    assert len(names) == len(set(names))


def test_one_result_is_frozen() -> None:
    t = base.TestResult("a", "b.", 1.0, base.SimulatedLaw(np.array([1.0])), "c", 0.05)
    with pytest.raises(AttributeError):
        t.alpha = 0.1  # type: ignore[misc]


@pytest.mark.parametrize("alpha", [0.2, 0.05, 0.01, 1e-3, 1e-4, 1e-9])
@pytest.mark.parametrize("tail", ["right", "left", "two-sided"])
def test_decisions_agree_with_limits_of_simulated_laws(alpha, tail):
    """A statistic is rejected exactly where it lies beyond the limit; where replicas are too few the limit is infinite."""
    from baarda.hypotheses.base import SimulatedLaw, TestResult

    values = np.sort(np.random.default_rng(4).standard_normal(999))
    for x in np.concatenate([np.linspace(-5, 5, 201), values[::37]]):
        t = TestResult("example", "nothing", float(x), SimulatedLaw(values), "simulated", alpha, tail)
        low, high = t.critical if tail == "two-sided" else (t.critical, np.inf) if tail == "left" else (-np.inf, t.critical)
        assert t.rejected == bool(x < low or x > high)


def test_the_level_raises_the_number_of_replicas():
    """At level 0.001 a rejected null stays rejected: 999 replicas would not show it."""
    import baarda
    from networks import ring

    result = baarda.adjust(ring(control=5))
    for t in baarda.test(result, alpha=0.001):
        if t.law_name.startswith("simulated"):
            assert np.all(np.isfinite(np.asarray(t.critical, dtype=float)))
