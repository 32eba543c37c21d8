"""Fitting, comparison, condensing and the SciPy forms."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
from scipy import optimize, stats

import baarda.distributions as D
from baarda.distributions.condensed import condense
from baarda.distributions.fitting import fit, profile_interval
from baarda.distributions.modulated import ModulatedNormal
from baarda.distributions.replicas import refit_columns
from baarda.errors import UsageError


def sample(a: float = 0.5, n: int = 630, seed: int = 0, loc: float = 0.0, scale: float = 1.0) -> np.ndarray:
    return ModulatedNormal(a, loc=loc, scale=scale).rvs(n, np.random.default_rng(seed))


SUBSETS = [
    {},
    {"loc": 0.1},
    {"scale": 3.0},
    {"loc": 0.1, "scale": 3.0},
    {"shapes": {"a": 0.7}},
    {"shapes": {"a": 0.7}, "loc": 0.1},
    {"shapes": {"a": 0.7}, "scale": 3.0},
    {"shapes": {"a": 0.7}, "scale": 3.0, "loc": 0.1},
]


@pytest.mark.parametrize("given", SUBSETS, ids=str)
def test_any_subset_is_fitted_as_well_as_by_brute_force(given: dict) -> None:
    x = sample(0.9, 500, 3, loc=0.1, scale=3.0)
    found = fit(x, **given)
    names = found.estimated
    assert set(names) == {"a", "loc", "scale"} - set(given) - set(given.get("shapes", {}))
    assert found.log_likelihood == pytest.approx(np.sum(found.distribution.logpdf(x)), abs=1e-9)
    if not names:
        return

    def cost(theta: np.ndarray) -> float:
        p = dict(zip(names, theta)) | {k: v for k, v in given.items() if k != "shapes"} | given.get("shapes", {})
        if p["a"] <= -0.24 or p["scale"] <= 0:
            return 1e9
        return -float(np.sum(ModulatedNormal(**p).logpdf(x)))

    start = [{"a": 1.0, "loc": 0.0, "scale": 2.8}[n] for n in names]
    other = optimize.minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9, "maxiter": 4000})
    assert found.log_likelihood >= -other.fun - 1e-7
    for name, value in zip(names, other.x):
        assert found.parameters[name] == pytest.approx(value, abs=2e-4 * (1 + abs(value))), name


def test_standard_errors_are_those_of_the_curvature() -> None:
    x = sample(1.0, 2000, 4, scale=2.0)
    found = fit(x, loc=0.0)
    a, s = found.parameters["a"], found.parameters["scale"]
    h = np.array([1e-3, 1e-4])

    def f(i: float, j: float) -> float:
        return float(np.sum(ModulatedNormal(a + i * h[0], scale=s + j * h[1]).logpdf(x)))

    hessian = np.array(
        [
            [(f(1, 0) - 2 * f(0, 0) + f(-1, 0)) / h[0] ** 2, (f(1, 1) - f(1, -1) - f(-1, 1) + f(-1, -1)) / (4 * h[0] * h[1])],
            [0.0, (f(0, 1) - 2 * f(0, 0) + f(0, -1)) / h[1] ** 2],
        ]
    )
    hessian[1, 0] = hessian[0, 1]
    errors = np.sqrt(np.diag(np.linalg.inv(-hessian)))
    assert found.standard_errors["a"] == pytest.approx(errors[0], rel=1e-3)
    assert found.standard_errors["scale"] == pytest.approx(errors[1], rel=1e-3)


@pytest.mark.parametrize("seed", range(12))
def test_the_maximum_over_a_is_global(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = [10, 30, 120, 700][seed % 4]
    a = [-0.3, 0.0, 0.5, 3.0, np.inf][seed % 5]
    x = ModulatedNormal(a).rvs(n, rng)
    found = fit(x, loc=0.0)
    for trial in (-0.8, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 10.0, 50.0, np.inf):
        held = fit(x, loc=0.0, shapes={"a": trial})
        assert held.log_likelihood <= found.log_likelihood + 1e-7, (trial, found)


def test_the_normal_limit_is_reached_and_said() -> None:
    x = np.linspace(-1.0, 1.0, 50)  # lighter tails than the normal
    found = fit(x, loc=0.0)
    assert found.parameters["a"] == np.inf
    assert found.at_bounds == ("a",)
    assert found.standard_errors["a"] is None
    assert "bound" in found.notes[0]
    normal = fit(x, "normal", loc=0.0)
    assert found.log_likelihood == pytest.approx(normal.log_likelihood, abs=1e-12)
    assert found.parameters["scale"] == pytest.approx(normal.parameters["scale"], rel=1e-9)
    assert found.as_dict()["parameters"]["a"] is None


def test_infinite_a_is_the_best_for_more_than_half_of_normal_samples() -> None:
    rng = np.random.default_rng(8)
    share = np.mean([np.isinf(fit(rng.standard_normal(60), loc=0.0).parameters["a"]) for _ in range(40)])
    assert 0.35 < share < 0.85


def test_a_free_mean_keeps_a_above_a_quarter() -> None:
    x = sample(-0.6, 400, 5)
    assert fit(x).parameters["a"] == pytest.approx(-0.25)
    assert fit(x).at_bounds == ("a",)
    assert fit(x, loc=0.0).parameters["a"] < -0.4
    # a value exactly at the given mean would make the likelihood infinite for a <= -1/2
    assert fit(np.append(x, 0.0), loc=0.0).parameters["a"] == pytest.approx(-0.25)


def test_a_near_zero() -> None:
    for seed in range(3):
        found = fit(sample(0.0, 3000, seed))
        assert abs(found.parameters["a"]) < 4 * found.standard_errors["a"]


def test_moments() -> None:
    x = sample(0.5, 20_000, 6, loc=5.0, scale=0.2)
    found = fit(x, rule="moments")
    k = stats.kurtosis(x, fisher=False)
    assert found.parameters["a"] == pytest.approx(np.sqrt(k / (k - 3)) - 2, rel=1e-6)
    assert found.parameters["loc"] == pytest.approx(np.mean(x), rel=1e-12)
    assert found.parameters["scale"] == pytest.approx(np.std(x), rel=1e-7)
    assert fit(np.linspace(-1, 1, 99), rule="moments").parameters["a"] == np.inf
    assert fit(x, "laplace", rule="moments").parameters["scale"] == pytest.approx(np.std(x) / np.sqrt(2), rel=1e-7)
    assert fit(sample(0.5, 500), "student", rule="moments").distribution.std() == pytest.approx(np.std(sample(0.5, 500)))
    with pytest.raises(UsageError):
        fit(x, "contaminated_normal", rule="moments")
    with pytest.raises(UsageError):
        fit(x, "cauchy", rule="moments")


def test_grouped_likelihood_agrees_with_the_raw_one_for_fine_classes() -> None:
    x = sample(0.8, 4000, 7, scale=2.0)
    raw = fit(x)
    grouped = fit(x, rule="grouped_likelihood", edges=np.linspace(-9, 9, 181))
    for name in ("a", "loc", "scale"):
        assert abs(grouped.parameters[name] - raw.parameters[name]) < 0.3 * raw.standard_errors[name]


def test_condensed_values_lose_nothing() -> None:
    x = sample(0.5, 200_000, 11, loc=0.3, scale=2.0)
    points, weights = condense(x, float(np.mean(x))).points()
    assert points.size < 5000
    law = ModulatedNormal(0.45, loc=0.3, scale=2.01)
    condensed = weights @ law.logpdf(points + np.mean(x))
    assert condensed == pytest.approx(np.sum(law.logpdf(x)), abs=2e-3)
    few = x[:30_000]
    found = fit(few)
    import baarda.distributions.sample as module

    keep = module.CONDENSE_FROM
    try:
        module.CONDENSE_FROM = 10**9
        full = fit(few)
    finally:
        module.CONDENSE_FROM = keep
    for name in ("a", "loc", "scale"):
        assert abs(found.parameters[name] - full.parameters[name]) < 1e-3 * full.standard_errors[name], name


def test_condensed_data_merge() -> None:
    x = sample(0.5, 30_000, 12)
    whole, parts = condense(x), condense(x[:7]) + condense(x[7:20_000]) + condense(x[20_000:])
    assert np.array_equal(whole.keys, parts.keys)
    assert np.array_equal(whole.counts, parts.counts)
    assert whole.sums == pytest.approx(parts.sums, rel=1e-12)
    assert parts.n == x.size
    assert parts.mean == pytest.approx(np.mean(x), abs=1e-15)
    with pytest.raises(UsageError):
        condense(x) + condense(x, 1.0)
    with pytest.raises(UsageError):
        condense([1.0, np.inf])
    assert fit(parts, loc=0.0).parameters == pytest.approx(fit(x, loc=0.0).parameters, rel=1e-9)
    zeros = condense([0.0, -0.0, 1.0])
    assert zeros.n == 3
    assert np.sum(zeros.points()[1]) == 3


def test_profile_interval() -> None:
    x = sample(0.5, 3000, 13)
    found = fit(x, loc=0.0)
    low, high = profile_interval(x, loc=0.0)
    assert low < found.parameters["a"] < high
    for end in (low, high):
        held = fit(x, loc=0.0, shapes={"a": end})
        assert 2 * (found.log_likelihood - held.log_likelihood) == pytest.approx(stats.chi2.ppf(0.95, 1), rel=1e-4)
    normal = np.random.default_rng(14).standard_normal(300)
    assert profile_interval(normal, loc=0.0)[1] == np.inf
    with pytest.raises(UsageError):
        profile_interval(x, loc=0.0, shapes={"a": 0.5})


def test_many_data_sets_at_once_agree_with_one_by_one() -> None:
    x = sample(0.5, 12 * 300, 15).reshape(300, 12)
    for name, given in (("modulated_normal", {"loc": 0.0}), ("normal", {}), ("laplace", {}), ("radico", {}), ("student", {"loc": 0.0})):
        member = D.law(name)
        start = member(**({"a": 0.5} if name == "modulated_normal" else {}))
        values, log_likelihood = refit_columns(member, x, start, given)
        for j in range(12):
            one = fit(x[:, j], member, **given)
            assert 0 <= one.log_likelihood - log_likelihood[j] + 1e-9 < 5e-3, (name, j)
            for p in one.estimated:
                if one.standard_errors[p] and np.isfinite(values[p][j]) and p != "a":
                    assert abs(values[p][j] - one.parameters[p]) < 0.1 * one.standard_errors[p], (name, j, p)


def test_comparison_of_laws() -> None:
    x = sample(0.5, 5000, 16)
    results = D.compare_laws(x, loc=0.0, scale=1.0)
    assert [f.law for f in results] == ["normal", "radico", "lineo", "modulated_normal"]
    normal, radico, lineo, wide = results
    assert normal.estimated == ()
    assert wide.estimated == ("a",)
    assert radico.df == len(radico.histogram.counts) - 1
    assert wide.df == len(wide.histogram.counts) - 2
    assert normal.rejected
    assert not radico.rejected
    assert radico.p_value == pytest.approx(stats.chi2.sf(radico.statistic, radico.df))
    assert radico.critical == pytest.approx(stats.chi2.ppf(0.95, radico.df))
    assert radico.statistic == pytest.approx(stats.chisquare(radico.histogram.counts, radico.histogram.expected).statistic)
    assert np.sum(radico.histogram.counts) == x.size
    assert radico.histogram.expected == pytest.approx(x.size / radico.histogram.counts.size)
    assert wide.log_likelihood >= max(radico.log_likelihood, lineo.log_likelihood)
    assert radico.aic == pytest.approx(-2 * radico.log_likelihood)
    assert wide.bic == pytest.approx(np.log(5000) - 2 * wide.log_likelihood)
    assert set(radico.as_dict()) == {
        "law", "rule", "parameters", "statistic", "df", "critical", "p_value", "rejected", "log_likelihood", "aic", "bic",
    }  # fmt: skip
    fitted = D.compare_laws(x, ("normal", "laplace", "student"), classes=[-2, -1, 0, 1, 2], alpha=0.01)
    assert [f.df for f in fitted] == [1, 1, 0]
    assert fitted[2].p_value is None
    assert fitted[0].alpha == 0.01
    assert np.array_equal(fitted[0].histogram.edges, [-2, -1, 0, 1, 2])


def test_the_comparison_is_deterministic_and_ordered_input_does_not_matter() -> None:
    x = sample(0.5, 25_000, 17)
    a, b = D.compare_laws(x), D.compare_laws(x[::-1])
    for f, g in zip(a, b):
        assert f.statistic == pytest.approx(g.statistic, rel=1e-9)
        assert np.array_equal(f.histogram.counts, g.histogram.counts)
        assert f.log_likelihood == pytest.approx(g.log_likelihood, abs=1e-7)


BAD = [
    ([], {}, "no values"),
    ([1.0, 2.0, np.nan, 3.0], {}, "not finite"),
    ([1.0, np.inf, 2.0, 3.0], {}, "number 2"),
    ([1.0, 2.0, 3.0], {}, "do not suffice"),
    ([5.0] * 30, {}, "equal"),
    ([1.0, 2.0, 4.0, 9.0], {"law": "nosuch"}, "modulated_normal"),
    ([1.0, 2.0, 4.0, 9.0], {"scale": -1.0}, "scale"),
    ([1.0, 2.0, 4.0, 9.0], {"shapes": {"b": 1.0}}, "no parameter"),
    ([1.0, 2.0, 4.0, 9.0], {"rule": "minimum_chi2"}, "limits"),
    ([1.0, 2.0, 4.0, 9.0], {"rule": "nosuch"}, "no rule"),
]


@pytest.mark.parametrize(("values", "options", "words"), BAD)
def test_bad_input_is_named(values: list, options: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        fit(values, **options)


# ---- SciPy --------------------------------------------------------------------------------


def test_scipy_forms_of_the_modulated_laws() -> None:
    frozen = D.modulated_normal(a=0.5, loc=0, scale=1)
    assert frozen.cdf([0.5, 1.0]) == pytest.approx([0.710315, 0.853194], abs=5e-7)
    assert frozen.std() == 1.0
    assert [float(v) for v in frozen.stats("mvsk")] == pytest.approx([0, 1, 0, 4 / 7])
    assert D.radico(scale=2.0).std() == pytest.approx(2.0)
    assert D.radico.cdf(1.0, loc=0.0, scale=2.0) == D.modulated_normal.cdf(0.5, 0.5)
    assert D.lineo.pdf(0.0) == pytest.approx(1.0887 / np.sqrt(2 * np.pi), abs=1e-4)
    assert D.modulated_normal.cdf(1.0, np.inf) == pytest.approx(stats.norm.cdf(1.0), rel=1e-14)
    assert np.isnan(D.modulated_normal.pdf(1.0, -1.0))
    assert D.modulated_normal.pdf([0, 1, 2], [0.5, 1, np.inf]).shape == (3,)
    assert D.modulated_normal.entropy(0.5) == ModulatedNormal(0.5).entropy()
    assert D.modulated_normal.moment(4, 0.5) == pytest.approx(25 / 7)
    assert D.modulated_normal.expect(lambda x: x**2, args=(0.5,)) == pytest.approx(1.0)


def test_scipy_random_numbers_are_seeded() -> None:
    a = D.radico.rvs(size=5, random_state=1)
    assert np.array_equal(a, D.radico.rvs(size=5, random_state=1))
    g = D.modulated_normal.rvs(0.5, size=(2, 3), random_state=np.random.default_rng(1))
    assert np.array_equal(g, ModulatedNormal(0.5).rvs((2, 3), np.random.default_rng(1)))
    assert np.ndim(D.radico.rvs(random_state=3)) == 0


def test_scipy_fit_and_its_keywords() -> None:
    x = sample(0.5, 600, 18, loc=1.0, scale=2.0)
    own = fit(x).parameters
    assert D.modulated_normal.fit(x) == pytest.approx((own["a"], own["loc"], own["scale"]))
    assert D.modulated_normal.fit(x, floc=1.0)[1] == 1.0
    for key in ("fa", "f0", "fix_a"):
        assert D.modulated_normal.fit(x, **{key: 0.5})[0] == 0.5
    assert len(D.radico.fit(x)) == 2
    assert D.modulated_normal.fit(x, method="MM")[2] == pytest.approx(np.std(x))
    with pytest.raises(UsageError):
        D.modulated_normal.fit(x, nosuch=3)
    with pytest.raises(UsageError):
        D.modulated_normal.fit(x, method="MPS")


def test_scipy_procedures_accept_them() -> None:
    x = sample(0.5, 150, 19)
    assert stats.kstest(x, D.modulated_normal(a=0.5).cdf).pvalue > 0.001
    assert stats.kstest(x, D.modulated_normal.cdf, args=(0.5, 0, 1)).pvalue > 0.001
    result = stats.goodness_of_fit(D.radico, x, statistic="ad", n_mc_samples=19, rng=np.random.default_rng(0))
    assert 0 < result.pvalue <= 1
    result = stats.goodness_of_fit(
        D.modulated_normal, x, known_params={"loc": 0.0}, statistic="ks", n_mc_samples=9, rng=np.random.default_rng(0)
    )
    assert result.fit_result.params.loc == 0.0
    found = stats.fit(D.modulated_normal, x, {"a": (-0.2, 20), "loc": (-2, 2), "scale": (0.3, 4)})
    assert found.success
    assert -found.nllf() <= fit(x).log_likelihood + 1e-6
    assert stats.make_distribution(D.modulated_normal)(a=0.5).cdf(1.0) == pytest.approx(0.853194, abs=5e-7)


def test_scipy_forms_can_be_copied() -> None:
    again = pickle.loads(pickle.dumps(D.modulated_normal))
    assert again.cdf(1.0, 0.5) == D.modulated_normal.cdf(1.0, 0.5)
    assert copy.deepcopy(D.radico).cdf(1.0) == D.radico.cdf(1.0)
    assert D.as_scipy("student").cdf(1.0, 5.0) == pytest.approx(stats.t.cdf(1.0, 5.0))


def test_imports_are_light() -> None:
    code = "import sys, baarda; baarda.distributions.compare_laws; print('scipy.stats' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "False"


@pytest.mark.parametrize("nu", [0.5, 5.0, 99.0, 101.0, 1e4, 1e7])
def test_student_keeps_its_slope_near_the_normal(nu: float) -> None:
    mp = pytest.importorskip("mpmath", reason="the oracle mpmath is not installed (extra 'oracle')")

    z = np.array([0.1, 1.0, 2.5, 6.0])
    with mp.workdps(50):
        for value, got in zip(z, D.law("student").distribution._gradient(z, nu)[0]):
            x, q = mp.mpf(nu) / 2, mp.mpf(float(value)) ** 2
            slope = (mp.psi(0, x + mp.mpf(1) / 2) - mp.psi(0, x) - 1 / (2 * x) - mp.log1p(q / nu) + (nu + 1) * q / (nu * (nu + q))) / 2
            assert got == pytest.approx(float(slope), rel=1e-8)
