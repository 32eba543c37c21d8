"""Global test, homogeneity and moments: printed tables, SciPy's tests, simulated nulls."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from baarda.errors import RedundancyNotPositive, UsageError
from baarda.hypotheses import _linear_model, _simulation, goodness_of_fit, homogeneity, moments, run, variance_factor
from baarda.hypotheses.base import Evidence, SimulatedLaw
from baarda.hypotheses.levels import Options

linear_model = _linear_model.linear_model
NINE = np.array([8, 7, 10, 9, 10, 9, 11, 8, 7, 9]) ** 2.0
TWENTY_FIVE = np.array([9, 8, 9, 7, 8, 8, 7, 8, 9]) ** 2.0


def test_global_test_of_wu() -> None:
    t = variance_factor.global_variance_factor(43.0, 43)
    np.testing.assert_allclose(t.critical, [26.79, 62.99], atol=0.005)
    assert not t.rejected
    assert variance_factor.global_variance_factor(63.1, 43).rejected
    assert variance_factor.global_variance_factor(26.7, 43).rejected
    assert variance_factor.global_variance_factor(4 * 63.1, 43, 2.0).statistic == pytest.approx(63.1)


def test_global_test_of_gama() -> None:
    """Network gama-local: chi-square interval of m0/m0' .773 .. 1.227, ratio .964 passed."""
    t = variance_factor.global_variance_factor(3.4356008e3, 37, 10.0)
    np.testing.assert_allclose(np.sqrt(np.array(t.critical) / 37), [0.773, 1.227], atol=6e-4)
    assert np.sqrt(t.details["ratio"]) == pytest.approx(0.964, abs=5e-4)
    assert not t.rejected


def test_sigma0_interval_covers_where_the_test_accepts() -> None:
    t = variance_factor.global_variance_factor(60.0, 43)
    low, high = t.details["sigma0_interval"]
    for sigma0 in (low, high):
        assert variance_factor.global_variance_factor(60.0, 43, sigma0).p_value == pytest.approx(0.05, rel=1e-9)


def test_variance_ratio_is_symmetric() -> None:
    assert variance_factor.variance_ratio(2.0, 10, 1.0, 20).p_value == pytest.approx(
        variance_factor.variance_ratio(1.0, 20, 2.0, 10).p_value
    )


@pytest.mark.parametrize(
    ("variances", "df", "theta", "corrected", "critical", "pooled"),
    [(NINE, 12, 4.843, 4.700, 16.92, 79.0), (TWENTY_FIVE, 44, 6.587, 6.532, 15.507, 66.33)],
)
def test_bartlett_of_maarek_and_konecny(
    variances: np.ndarray, df: int, theta: float, corrected: float, critical: float, pooled: float
) -> None:
    t = homogeneity.bartlett(variances, df)
    assert t.details["theta"] == pytest.approx(theta, abs=5e-4)
    assert t.statistic == pytest.approx(corrected, abs=5e-4)
    assert t.critical == pytest.approx(critical, abs=5e-3)
    assert t.details["pooled_variance"] == pytest.approx(pooled, abs=5e-3)
    assert not t.rejected
    assert homogeneity.bartlett(variances, df, corrected=False).statistic == pytest.approx(theta, abs=5e-4)


@given(st.integers(0, 10_000))
def test_bartlett_of_raw_samples_is_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples = [rng.standard_normal(n) * (1 + rng.random()) for n in (5, 9, 14, 30)]
    ours = homogeneity.bartlett([s.var(ddof=1) for s in samples], [len(s) - 1 for s in samples])
    theirs = stats.bartlett(*samples)
    assert ours.statistic == pytest.approx(theirs.statistic, rel=1e-9)
    assert ours.p_value == pytest.approx(theirs.pvalue, rel=1e-9)


def test_bounds_of_single_sets() -> None:
    for variances, df, bounds in ((NINE, 12, (4.40, 23.34)), (TWENTY_FIVE, 44, (27.57, 64.20))):
        pooled = float(variances.mean())
        known = homogeneity.variance_per_image(variances, df, reference=pooled)
        np.testing.assert_allclose(known.critical, bounds, atol=5e-3)
        assert not known.rejected.any()
        own = homogeneity.variance_per_image(variances, df)
        np.testing.assert_allclose(own.statistic, known.statistic)
        # A set is a part of its pool: the exact limits are narrower.
        assert own.critical[0] > known.critical[0]
        assert own.critical[1] < known.critical[1]
        assert not own.rejected.any()


def test_set_against_its_pool_is_an_f_test_against_the_rest() -> None:
    s2, df = np.array([1.0, 3.0, 1.5, 0.7]), np.array([6.0, 9.0, 12.0, 30.0])
    t = homogeneity.variance_per_image(s2, df, labels="abcd")
    for i in range(4):
        rest = np.delete(s2 * df, i).sum() / np.delete(df, i).sum()
        f = stats.f(df[i], df.sum() - df[i])
        assert t.p_value[i] == pytest.approx(2 * min(f.sf(s2[i] / rest), f.cdf(s2[i] / rest)), rel=1e-9)
    extreme = t.details["extreme"]["index"]
    assert t.labels[extreme] == t.details["extreme"]["label"] == "b"
    assert (t.statistic[extreme] > t.critical[1] or t.statistic[extreme] < t.critical[0]) == t.rejected[extreme]


@given(st.integers(0, 10_000), st.integers(20, 200))
def test_moments_are_scipys(seed: int, n: int) -> None:
    x = np.random.default_rng(seed).standard_normal(n) * 3 + 0.2
    assert moments.mean_of_residuals(x).p_value == pytest.approx(stats.ttest_1samp(x, 0.0).pvalue, rel=1e-9)
    skew, kurt = moments.skewness_of_residuals(x), moments.kurtosis_of_residuals(x)
    assert skew.statistic == pytest.approx(stats.skew(x), rel=1e-9, abs=1e-12)
    assert kurt.statistic == pytest.approx(stats.kurtosis(x, fisher=False), rel=1e-9)
    assert skew.p_value == pytest.approx(stats.skewtest(x).pvalue, rel=1e-7)
    assert kurt.p_value == pytest.approx(stats.kurtosistest(x).pvalue, rel=1e-7)


@pytest.mark.parametrize("law", [moments.SkewnessLaw(8), moments.SkewnessLaw(400), moments.KurtosisLaw(20), moments.KurtosisLaw(4000)])
def test_moment_laws_invert(law: moments.SkewnessLaw | moments.KurtosisLaw) -> None:
    q = np.array([0.001, 0.025, 0.5, 0.975, 0.999])
    np.testing.assert_allclose(law.cdf(law.ppf(q)), q, rtol=1e-9)
    np.testing.assert_allclose(law.sf(law.ppf(q)), 1 - q, rtol=1e-6)


def network(seed: int, sets: int = 5, correlated: bool = False) -> Evidence:
    rng = np.random.default_rng(seed)
    n = sets * 12
    images = np.repeat(np.arange(sets), 12)
    a = np.column_stack([(images[:, None] == np.arange(sets)) * rng.standard_normal((n, 1)), rng.standard_normal((n, 6))])
    c = np.diag(rng.uniform(0.5, 2.0, n))
    if correlated:
        root = np.kron(np.eye(n // 2), np.array([[1.0, 0.0], [0.6, 1.0]]))
        c = root @ c @ root.T
    return linear_model(a, np.linalg.cholesky(c) @ rng.standard_normal(n), c, images=images)


def test_image_variances_sum_to_vpv() -> None:
    e = network(1)
    first, second = homogeneity.from_evidence(e, Options(replicas=199))
    df, s2 = np.array(second.details["df"]), np.array(second.details["variances"])
    assert (df * s2).sum() == pytest.approx(e.vpv, rel=1e-10)
    assert df.sum() == pytest.approx(e.redundancy, rel=1e-10)
    assert first.statistic == pytest.approx(homogeneity.bartlett(s2, df).statistic, rel=1e-10)
    assert isinstance(first.law, SimulatedLaw)
    assert "199 simulated" in first.note


def test_correlated_observations_keep_the_simulated_law_fitting() -> None:
    _, second = homogeneity.from_evidence(network(2, correlated=True), Options(replicas=199))
    assert "correlated" in second.note
    means = second.law.laws.values.mean(axis=0) / np.array(second.details["df"])  # type: ignore[attr-defined]
    np.testing.assert_allclose(means, 1.0, atol=0.15)


def test_asymptotic_law_is_said() -> None:
    e = network(3)
    bare = Evidence(**{**vars(e), "residuals_of": None})
    *of_moments, jarque_bera = moments.from_evidence(bare, Options())
    assert "independent normal values" in jarque_bera.note
    for t in [*homogeneity.from_evidence(bare, Options()), *of_moments]:
        assert "Asymptotic" in t.note
        assert not isinstance(t.law, SimulatedLaw)


def test_too_many_observations_to_simulate() -> None:
    e = network(3)
    many = Evidence(residuals=np.zeros(300_000), sigmas=np.ones(300_000), vpv=1.0, redundancy=5, residuals_of=e.residuals_of)
    assert _simulation.affordable(many, Options()) == 0
    some = Evidence(residuals=np.zeros(100_000), sigmas=np.ones(100_000), vpv=1.0, redundancy=5, residuals_of=e.residuals_of)
    assert _simulation.affordable(some, Options()) == 400
    assert "fewer than 999" in _simulation.null_note(some, Options(), 400)


def test_simulated_law_does_not_depend_on_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    e = network(4)
    whole = _simulation.simulate(e, "largest", lambda v: v.max(axis=0), Options(replicas=50))
    monkeypatch.setattr(_simulation, "_CHUNK", 7 * len(e.residuals))
    parts = _simulation.simulate(e, "largest", lambda v: v.max(axis=0), Options(replicas=50))
    assert whole is not None
    assert parts is not None
    np.testing.assert_allclose(whole, parts, rtol=1e-12)


def test_all_tests_share_one_pass_of_simulated_data_sets() -> None:
    """Each replica goes through the adjustment once, and every test finds the law that it finds alone."""
    e, o = network(4), Options(replicas=99)
    columns: list[int] = []

    def counted(errors: np.ndarray) -> np.ndarray:
        columns.append(errors.shape[1])
        assert e.residuals_of is not None
        return e.residuals_of(errors)

    together = run(Evidence(**{**vars(e), "residuals_of": counted}), o)
    assert columns.count(99) == 1
    laws = {t.name: t.law.values for t in together if isinstance(t.law, SimulatedLaw)}
    alone = [*moments.from_evidence(e, o), *homogeneity.from_evidence(e, o), *goodness_of_fit.from_evidence(e, o)]
    found = {t.name: t.law.values for t in alone if isinstance(t.law, SimulatedLaw)}
    assert found.keys() == laws.keys() >= {"skewness_of_residuals", "kurtosis_of_residuals", "bartlett_images", "goodness_of_fit"}
    for name, values in found.items():
        np.testing.assert_allclose(laws[name], values, rtol=1e-12)


def test_kurtosis_of_residuals_is_nearer_to_normal_than_that_of_errors() -> None:
    # The simulated law is that of residuals of normal errors: its centre is below the one of independent values.
    (_, _, kurtosis, _) = moments.from_evidence(network(5, sets=2), Options(replicas=499))
    assert "499 simulated" in kurtosis.note
    assert 0.0 < kurtosis.p_value <= 1.0


def test_uncontrolled_observations_are_left_out_and_counted() -> None:
    rng = np.random.default_rng(0)
    a = np.ones((30, 2))
    a[:-1, 1] = 0.0
    e = linear_model(a, rng.standard_normal(30), images=np.arange(30) % 3)
    mean, *others = moments.from_evidence(e, Options(replicas=99))
    assert mean.details["applicable"] is False  # the residuals of the common mean sum to zero
    for t in others:
        assert t.details["n"] == 29
        assert "1 uncontrolled" in t.note


def test_an_image_without_redundancy_is_left_out() -> None:
    rng = np.random.default_rng(0)
    a = np.ones((31, 2))
    a[:-1, 1] = 0.0
    e = linear_model(a, rng.standard_normal(31), images=[*(np.arange(30) % 3), 3])
    first, second = homogeneity.from_evidence(e, Options(replicas=99))
    assert first.details["sets"] == 3
    assert second.labels == ("0", "1", "2")
    assert "1 images without redundancy" in first.note


def test_too_few_replicas_for_the_level_of_a_single_image() -> None:
    t = homogeneity.from_evidence(network(6, sets=8), Options(replicas=99, levels="bonferroni"))[1]
    assert "cannot reach the level" in t.note


@pytest.mark.parametrize(
    "call",
    [
        lambda: homogeneity.bartlett([1.0], 5),
        lambda: homogeneity.bartlett([1.0, 0.0], 5),
        lambda: homogeneity.bartlett([1.0, 2.0], [5]),
        lambda: homogeneity.variance_per_image([1.0, 2.0], [5, 0]),
        lambda: homogeneity.variance_per_image([1.0, 2.0], 5, reference=0.0),
        lambda: moments.mean_of_residuals([1.0]),
        lambda: moments.mean_of_residuals([1.0, 1.0]),
        lambda: moments.skewness_of_residuals([1.0, 2.0, 4.0]),
        lambda: moments.kurtosis_of_residuals(np.arange(10.0)),
        lambda: moments.mean_of_residuals([1.0, np.nan]),
        lambda: variance_factor.global_variance_factor(1.0, 5, 0.0),
        lambda: variance_factor.global_variance_factor(-1.0, 5),
        lambda: variance_factor.variance_ratio(1.0, 5, 0.0, 5),
    ],
)
def test_wrong_arguments(call: object) -> None:
    with pytest.raises(UsageError):
        call()  # type: ignore[operator]


def test_no_redundancy() -> None:
    with pytest.raises(RedundancyNotPositive):
        variance_factor.global_variance_factor(1.0, 0)


@pytest.mark.parametrize("loc", [None, 0.0])
def test_the_likelihood_ratio_is_that_of_the_fits(loc):
    """Few values often have two maxima of a, one at either bound: the simulated search must find the better one as `fit` does."""
    from baarda.distributions import fit
    from baarda.hypotheses.goodness_of_fit import normal_against_modulated

    rng = np.random.default_rng(3)
    short = []
    for n in (10, 25, 50, 100) * 4:
        x = rng.standard_t(4, n)
        best = 2.0 * (fit(x, "modulated_normal", loc=loc).log_likelihood - fit(x, "normal", loc=loc).log_likelihood)
        short.append(best - normal_against_modulated(x, loc=loc, replicas=1).statistic)
    assert max(short) < (0.5 if loc is None else 0.1)
    assert min(short) > -1e-6
    assert np.median(short) < 0.05
