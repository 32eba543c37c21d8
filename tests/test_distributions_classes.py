"""Classes: counting, expected counts, merging, fits on classes, and the tests of `hypotheses.goodness_of_fit`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from baarda.distributions import equal_probability_edges, equal_width_edges, fit, fit_classes, law
from baarda.distributions.histogram import count, merge_small, probabilities, usual_number_of_classes
from baarda.errors import UsageError
from baarda.hypotheses.base import Evidence
from baarda.hypotheses.goodness_of_fit import (
    anderson_darling,
    chi_square,
    chi_square_on_classes,
    cramer_von_mises,
    empirical_statistics,
    from_evidence,
    kolmogorov,
    normal_against_modulated,
)
from baarda.hypotheses.levels import Options


def test_counting() -> None:
    x = np.random.default_rng(0).standard_normal(1000)
    b = np.array([-2.0, -1.0, 0.0, 0.3, 2.5])
    open_ends = count(x, b)
    assert np.array_equal(open_ends, np.histogram(x, np.concatenate([[-np.inf], b[1:-1], [np.inf]]))[0])
    assert np.array_equal(open_ends, count(np.sort(x), b, is_sorted=True))
    with pytest.raises(UsageError, match="do not cover"):
        count(x, b, "closed")
    inside = x[(x >= -2.0) & (x <= 2.5)]
    assert np.array_equal(count(inside, b, "closed"), np.histogram(inside, b)[0])
    with pytest.raises(UsageError, match="ascend"):
        count(x, [0.0, 0.0, 1.0])
    with pytest.raises(UsageError, match="at least three"):
        count(x, [0.0, 1.0])


def test_probabilities_keep_their_digits_in_both_tails() -> None:
    normal = law("normal")()
    p = probabilities(normal, [-np.inf, -9.0, -8.0, 0.0, 8.0, 9.0, np.inf])
    assert p[0] == pytest.approx(stats.norm.sf(9.0), rel=1e-12)
    assert p == pytest.approx(p[::-1], rel=1e-12)
    assert np.sum(p) == pytest.approx(1.0, abs=1e-15)
    assert np.sum(probabilities(normal, [-1.0, 0.0, 1.0], "closed")) == pytest.approx(0.6826894921370859)


def test_edges() -> None:
    b = equal_probability_edges(law("radico")(loc=2.0, scale=3.0), 7)
    assert probabilities(law("radico")(loc=2.0, scale=3.0), b) == pytest.approx(1 / 7)
    assert equal_width_edges([3.0, 1.0, 2.0], 4) == pytest.approx([1, 1.5, 2, 2.5, 3])
    with pytest.raises(UsageError, match="equal"):
        equal_width_edges([1.0, 1.0], 3)
    with pytest.raises(UsageError, match="at least two"):
        equal_width_edges([1.0, 2.0], 1)
    with pytest.raises(UsageError, match="at least two"):
        equal_probability_edges(law("normal")(), 1)
    assert usual_number_of_classes(10) == 2
    assert usual_number_of_classes(630) == 26
    assert usual_number_of_classes(10**7) == 100


def test_merging_leaves_no_small_class() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        t = rng.gamma(1.0, 6.0, size=12)
        f = rng.poisson(t).astype(float)
        b, g, u = merge_small(np.arange(13.0), f, t)
        assert np.sum(g) == np.sum(f)
        assert np.sum(u) == pytest.approx(np.sum(t))
        assert u.min() >= 5.0
        assert b.size == g.size + 1
        assert (b[0], b[-1]) == (0.0, 12.0)
    with pytest.raises(UsageError):
        merge_small([0, 1, 2], [1, 1], [1.0, 1.0])


@pytest.mark.parametrize("name", ["normal", "laplace", "modulated_normal", "student"])
@pytest.mark.parametrize("rule", ["minimum_chi2", "grouped_likelihood"])
def test_exact_counts_give_back_the_law(name: str, rule: str) -> None:
    truth = law(name)(**({"a": 0.4} if name == "modulated_normal" else {}), loc=0.3, scale=1.7)
    b = np.linspace(-5.0, 5.0, 15)
    for ends in ("open", "closed"):
        f = 1e5 * probabilities(truth, b, ends)
        found = fit_classes(f, b, name, rule=rule, ends=ends, total=1e5)
        assert found.histogram.chi_square < 1e-6
        for key, value in truth.parameters.items():
            assert found.parameters[key] == pytest.approx(value, abs=2e-3), (key, ends)
        assert found.df == 14 - 1 - len(found.estimated)


def test_fits_on_classes_of_light_tails_end_at_the_normal() -> None:
    b = np.linspace(-2, 2, 9)
    f = np.round(400 * np.diff(stats.uniform(-2, 4).cdf(b)))
    for rule in ("minimum_chi2", "grouped_likelihood"):
        found = fit_classes(f, b, rule=rule, loc=0.0)
        assert found.parameters["a"] == np.inf
        assert found.at_bounds == ("a",)
        assert found.statistic == pytest.approx(fit_classes(f, b, "normal", rule=rule, loc=0.0).statistic, rel=1e-6)


BAD = [
    ([1, -1, 3], [0, 1, 2, 3], {}, "not negative"),
    ([1, 2], [0, 1, 2, 3], {}, "do not fit"),
    ([0, 0, 0], [0, 1, 2, 3], {}, "zero"),
    ([1, 2, np.nan], [0, 1, 2, 3], {}, "finite"),
    ([5, 6], [0, 1, 2], {}, "do not suffice"),
    ([0, 9, 0, 0], [0, 1, 2, 3, 4], {"loc": 1.5}, "one class"),
    ([5, 6, 7], [0, 1, 2, 3], {"loc": 900.0, "scale": 1.0, "shapes": {"a": 1.0}}, "probability zero"),
]


@pytest.mark.parametrize(("counts", "edges", "options", "words"), BAD)
def test_bad_classes_are_named(counts: list, edges: list, options: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        fit_classes(counts, edges, **options)


# ---- tests of hypotheses --------------------------------------------------------------------------------


def test_chi_square_on_classes() -> None:
    normal = law("normal")()
    f = np.array([30.0, 70.0, 80.0, 20.0])
    result = chi_square_on_classes(f, [-2, -1, 0, 1, 2], normal, estimated=1)
    t = 200 * np.diff([0, stats.norm.cdf(-1), 0.5, stats.norm.cdf(1), 1])
    assert result.statistic == pytest.approx(np.sum((f - t) ** 2 / t))
    assert result.df == (2.0,)
    assert result.p_value == pytest.approx(stats.chi2.sf(result.statistic, 2))
    assert "4 classes, open ends, 1 estimated" in result.note
    merged = chi_square_on_classes([1, 30, 70, 80, 19], [-3, -2, -1, 0, 1, 2], normal, merge=5.0)
    assert len(merged.details["counts"]) == 4
    assert "merged" in merged.note
    with pytest.raises(UsageError, match="no degree"):
        chi_square_on_classes([5, 5], [-1, 0, 1], normal, estimated=1)


def test_chi_square_of_values() -> None:
    x = law("radico")().rvs(4000, np.random.default_rng(3))
    assert chi_square(x, "normal", loc=0.0).rejected
    for classes in ("equal_probability", "equal_width", np.linspace(-4, 4, 20)):
        result = chi_square(x, "radico", classes=classes)
        assert not result.rejected
        assert result.df[0] == len(result.details["counts"]) - 3
        assert min(result.details["expected"]) >= 5.0
    assert chi_square(x, "radico", number=10, loc=0.0, scale=1.0).df == (9.0,)
    with pytest.raises(UsageError):
        chi_square(x, classes="nosuch")


def test_statistics_agree_with_scipy() -> None:
    x = np.sort(np.random.default_rng(4).standard_normal(57))
    d, w, a = empirical_statistics(stats.norm.cdf(x), stats.norm.sf(x))
    assert d == pytest.approx(stats.kstest(x, "norm").statistic, rel=1e-12)
    assert w == pytest.approx(stats.cramervonmises(x, "norm").statistic, rel=1e-12)
    z = (x - x.mean()) / x.std(ddof=1)
    fitted = empirical_statistics(stats.norm.cdf(z), stats.norm.sf(z))[2]
    assert fitted == pytest.approx(stats.anderson(x, method="interpolate").statistic, rel=1e-10)
    columns = empirical_statistics(stats.norm.cdf(np.stack([x, x + 1], 1)), stats.norm.sf(np.stack([x, x + 1], 1)))
    assert [c[0] for c in columns] == pytest.approx([d, w, a])


def test_bootstrap_critical_values_are_the_known_ones() -> None:
    """Stephens' points for the normal law with mean and standard deviation estimated (5 %): A2 = 0.752, W2 = 0.126, both adjusted."""
    x = np.random.default_rng(5).standard_normal(100)
    n = x.size
    a = anderson_darling(x, replicas=4999, seed=1)
    w = cramer_von_mises(x, replicas=4999, seed=1)
    d = kolmogorov(x, replicas=4999, seed=1)
    assert a.critical * (1 + 0.75 / n + 2.25 / n**2) == pytest.approx(0.752, rel=0.04)
    assert w.critical * (1 + 0.5 / n) == pytest.approx(0.126, rel=0.04)
    assert d.critical * (np.sqrt(n) - 0.01 + 0.85 / np.sqrt(n)) == pytest.approx(0.895, rel=0.03)


def test_bootstrap_is_seeded_and_counts_exactly() -> None:
    x = law("radico")().rvs(60, np.random.default_rng(6))
    first, again, other = (anderson_darling(x, "radico", replicas=99, seed=s) for s in (3, 3, 4))
    assert np.array_equal(first.law.values, again.law.values)
    assert not np.array_equal(first.law.values, other.law.values)
    assert first.p_value == (1 + np.sum(first.law.values >= first.statistic)) / 100


def test_bootstrap_tests_reject_what_they_should() -> None:
    rng = np.random.default_rng(7)
    x = law("laplace")().rvs(300, rng)
    for test in (kolmogorov, cramer_von_mises, anderson_darling):
        assert test(x, "normal", replicas=199).rejected
        assert not test(x, "laplace", replicas=199).rejected
    assert anderson_darling(3.0 * x, "laplace", loc=0.0, scale=1.0, replicas=199).rejected


def projector(n: int, u: int, seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((n, u)))
    return np.eye(n) - q @ q.T


def test_bootstrap_through_the_design_matrix() -> None:
    r = projector(60, 25, 8)
    root = np.sqrt(np.diag(r))[:, None]
    seen = []

    def residuals_of(e: np.ndarray) -> np.ndarray:
        seen.append(e)
        return r @ e / root

    e = np.random.default_rng(9).standard_normal((60, 1))
    x = residuals_of(e)[:, 0]
    seen.clear()
    result = anderson_darling(x, loc=0.0, replicas=199, residuals_of=residuals_of)
    assert seen[0].shape == (60, 199)
    assert np.std(seen[0]) == pytest.approx(1.0, abs=0.02)
    assert "exact" in result.note
    assert "approximate" in anderson_darling(x, "modulated_normal", loc=0.0, replicas=19, residuals_of=residuals_of).note
    naive = anderson_darling(x, loc=0.0, replicas=199)
    assert "not valid for residuals" in naive.note
    assert not np.array_equal(naive.law.values, result.law.values)
    with pytest.raises(UsageError, match="keep the shape"):
        anderson_darling(x, replicas=9, residuals_of=lambda e: e[:5])
    with pytest.raises(UsageError, match="no variance"):
        anderson_darling(x, "cauchy", replicas=9, residuals_of=residuals_of)


def test_normal_against_modulated() -> None:
    rng = np.random.default_rng(10)
    x = law("radico")().rvs(630, rng)
    result = normal_against_modulated(x, loc=0.0, replicas=199)
    assert result.rejected
    direct = 2 * (fit(x, loc=0.0).log_likelihood - fit(x, "normal", loc=0.0).log_likelihood)
    assert result.statistic == pytest.approx(direct, abs=5e-3)
    assert 0.4 < result.details["zero_share"] < 0.7
    calm = normal_against_modulated(np.linspace(-1, 1, 40), loc=0.0, replicas=99)
    assert calm.statistic == pytest.approx(0.0, abs=1e-3)
    assert calm.details["a"] is None


def test_from_evidence() -> None:
    n, u = 80, 10
    r = projector(n, u, 11)
    sigma = np.linspace(0.5, 2.0, n)
    e = np.random.default_rng(12).standard_normal(n)
    v = sigma * (r @ e)
    known = {"sigmas": sigma, "redundancy": n - u, "redundancy_numbers": np.diag(r), "residuals_of": lambda z: r @ z}
    (result,) = from_evidence(Evidence(residuals=v, vpv=float(np.sum((v / sigma) ** 2)), **known), Options(replicas=199))
    assert result.name == "goodness_of_fit"
    assert not result.rejected
    scaled = from_evidence(Evidence(residuals=7 * v, vpv=49 * float(np.sum((v / sigma) ** 2)), **known), Options(replicas=199))[0]
    assert scaled.statistic == pytest.approx(result.statistic)
    w = r @ (np.where(np.arange(n) % 8 == 0, 12.0, 1.0) * e)
    assert from_evidence(Evidence(residuals=sigma * w, vpv=float(w @ w), **known), Options(replicas=199))[0].rejected
    plain = Evidence(residuals=v, sigmas=sigma, vpv=1.0, redundancy=n - u)
    assert from_evidence(plain, Options()) == []
