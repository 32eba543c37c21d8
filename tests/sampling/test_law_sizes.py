"""Measured sizes of the tests of a residual study over 4000 samples: raw samples, and residuals of a small adjustment.

Exact and simulated null laws must keep their level (|z| <= 4); of asymptotic ones the measured size is stated and must stay as it is. One
bootstrap draw per replica suffices, see `test_distribution_sizes`.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats

from baarda.distributions import fit, law
from baarda.distributions.replicas import refit_columns
from baarda.hypotheses.homogeneity import bartlett, variance_per_image
from baarda.hypotheses.moments import KurtosisLaw, SkewnessLaw, _moments
from baarda.hypotheses.normality import _jarque_bera_of
from baarda.procedures.group_study import study_groups
from baarda.procedures.law_bootstrap import CHI_SQUARE, STATISTICS, ClassRule, _of_columns, empirical_tests
from baarda.procedures.law_study import StudyOptions

pytestmark = pytest.mark.sampling
REPLICAS = 4000
LEVELS = (0.10, 0.05, 0.01)
NORMAL = law("normal")


def z_of(rejected: np.ndarray, level: float, draws: int = 1) -> float:
    """Deviation of a measured size in standard errors; with two draws the critical value is random too."""
    return float((np.mean(rejected) - level) / np.sqrt(draws * level * (1.0 - level) / len(rejected)))


def exact(p: np.ndarray, what: str) -> None:
    for level in LEVELS:
        assert abs(z_of(p <= level, level)) <= 4.0, (what, level, np.mean(p <= level))


def simulated(drawn: np.ndarray, null: np.ndarray, what: str, *, two_sided: bool = False) -> None:
    for level in LEVELS:
        side = level / 2.0 if two_sided else level
        beyond = drawn >= np.quantile(null, 1.0 - side, method="higher")
        if two_sided:
            beyond |= drawn <= np.quantile(null, side, method="lower")
        assert abs(z_of(beyond, level, 2)) <= 4.0, (what, level, np.mean(beyond))


def sizes(p: np.ndarray) -> list[float]:
    return [float(np.mean(p <= level)) for level in LEVELS]


def both(law_: object, x: np.ndarray) -> np.ndarray:
    return np.minimum(1.0, 2.0 * np.minimum(law_.sf(x), law_.cdf(x)))  # type: ignore[attr-defined]


class Adjustment:
    """A small adjustment: 40 observations in 4 groups, 18 unknowns."""

    def __init__(self, n: int = 40, u: int = 18) -> None:
        q, _ = np.linalg.qr(np.random.default_rng(50).standard_normal((n, u)))
        self.n, self.redundancy = n, n - u
        self.projector = np.eye(n) - q @ q.T
        self.root = np.sqrt(np.diag(self.projector))[:, None]
        self.groups = np.arange(n) % 4

    def __call__(self, errors: np.ndarray) -> np.ndarray:
        """Residuals divided by s0 sqrt(q) of each data set."""
        v = -(self.projector @ errors)
        return v / self.root / np.sqrt(np.sum(v * v, axis=0) / self.redundancy)


ADJUSTMENT = Adjustment()


# ---- moments --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [20, 50, 200])
def test_moments_of_raw_samples(n: int) -> None:
    """t is exact; D'Agostino's and Anscombe and Glynn's laws are so good that 4000 samples of 50 values show no difference."""
    rng = np.random.default_rng(101)
    m, again = _moments(rng.standard_normal((n, REPLICAS))), _moments(3.0 + 7.0 * rng.standard_normal((n, REPLICAS)))
    exact(2.0 * stats.t(n - 1).sf(np.abs(m[:, 0])), "mean")
    exact(both(SkewnessLaw(n), m[:, 1]), "skewness")
    kurtosis = both(KurtosisLaw(n), m[:, 2])
    if n >= 50:
        exact(kurtosis, "kurtosis")
    else:
        assert sizes(kurtosis) == pytest.approx([0.10, 0.05, 0.01], abs=0.025)
    jb, jb_again = _jarque_bera_of(n, m[:, 1], m[:, 2]), _jarque_bera_of(n, again[:, 1], again[:, 2])
    simulated(jb, jb_again, "Jarque-Bera")


def test_asymptotic_jarque_bera_misses_its_level() -> None:
    m = _moments(np.random.default_rng(102).standard_normal((100, 20_000)))
    measured = sizes(stats.chi2(2).sf(_jarque_bera_of(100, m[:, 1], m[:, 2])))
    assert measured == pytest.approx([0.066, 0.043, 0.021], abs=0.006)  # 0.10, 0.05 and 0.01 are claimed


def test_moments_of_adjusted_residuals() -> None:
    rng, a = np.random.default_rng(103), ADJUSTMENT
    m, null = _moments(a(rng.standard_normal((a.n, REPLICAS)))), _moments(a(5.0 * rng.standard_normal((a.n, REPLICAS))))
    simulated(m[:, 1], null[:, 1], "skewness", two_sided=True)
    simulated(m[:, 2], null[:, 2], "kurtosis", two_sided=True)
    jb, null_jb = (_jarque_bera_of(a.n, x[:, 1], x[:, 2]) for x in (m, null))
    simulated(jb, null_jb, "Jarque-Bera")


@pytest.mark.parametrize("a", [0.0, 0.5])
def test_residuals_hide_the_kurtosis_of_the_errors(a: float) -> None:
    """Power lost by mixing: raw errors of the law are found several times as often as residuals of an adjustment of such errors."""
    rng, through = np.random.default_rng(104), ADJUSTMENT
    e = law("modulated_normal")(a=a).rvs(through.n * REPLICAS, rng).reshape(through.n, REPLICAS)
    z = rng.standard_normal((through.n, REPLICAS))
    raw = np.mean(_moments(e)[:, 2] >= np.quantile(_moments(z)[:, 2], 0.95))
    seen = np.mean(_moments(through(e))[:, 2] >= np.quantile(_moments(through(z))[:, 2], 0.95))
    assert raw > 1.5 * seen > 0.0


# ---- homogeneity ----------------------------------------------------------------------------------------------------------------------


def test_homogeneity_of_separate_sets() -> None:
    """Each set against the pooled one is exact; Bartlett's corrected chi-square keeps its level, the paper's form rejects too often."""
    rng, df = np.random.default_rng(105), np.array([5.0, 8.0, 12.0, 12.0, 30.0])
    s2 = rng.chisquare(df, (REPLICAS, len(df))) / df
    corrected = np.array([bartlett(x, df).p_value for x in s2])
    paper = np.array([bartlett(x, df, corrected=False).p_value for x in s2])
    each = np.array([variance_per_image(x, df).p_value for x in s2])
    exact(corrected, "Bartlett")
    for k in range(len(df)):
        exact(each[:, k], f"set {k}")
    assert np.all(paper <= corrected)
    assert sizes(paper) == pytest.approx([0.117, 0.060, 0.013], abs=0.015)


def test_power_of_one_set_against_the_pooled_variance() -> None:
    """A set of 1.5 times the standard deviation: r_i s_i^2 / S^2 is rho F(r_i, R - r_i) over the rest, so its power is known exactly."""
    rng, df, rho = np.random.default_rng(114), np.array([12.0, 12.0, 12.0, 30.0]), 1.5**2
    s2 = rng.chisquare(df, (REPLICAS, 4)) / df * np.array([rho, 1.0, 1.0, 1.0])
    hit = np.array([variance_per_image(x, df).rejected[0] for x in s2])
    total, r = df.sum(), df[0]
    law = stats.beta(r / 2.0, (total - r) / 2.0)
    low, high = (q / (1.0 - q) * (total - r) / r / rho for q in law.ppf([0.025, 0.975]))  # limits of s_1^2 over the rest's
    expected = float(stats.f(r, total - r).sf(high) + stats.f(r, total - r).cdf(low))
    assert 0.3 < expected < 0.9
    assert abs((hit.mean() - expected) / np.sqrt(expected * (1.0 - expected) / REPLICAS)) <= 4.0


def test_power_of_bartlett_for_two_sets() -> None:
    """With two sets theta is a function of their variance ratio: the region of rejection in F gives the power exactly."""
    rng, df, rho = np.random.default_rng(115), np.array([14.0, 22.0]), 2.2
    s2 = rng.chisquare(df, (REPLICAS, 2)) / df * np.array([rho, 1.0])
    hit = np.array([bool(bartlett(x, df).rejected) for x in s2])

    def beyond(log_ratio: float) -> float:
        t = bartlett(np.array([np.exp(log_ratio), 1.0]), df)
        return float(t.statistic) - float(t.critical)

    low, high = np.exp(optimize.brentq(beyond, -8.0, 0.0)), np.exp(optimize.brentq(beyond, 0.0, 8.0))
    law = stats.f(*df)
    assert float(law.cdf(low) + law.sf(high)) == pytest.approx(0.05, abs=2e-3)  # size of the corrected form
    expected = float(law.cdf(low / rho) + law.sf(high / rho))
    assert 0.2 < expected < 0.8
    assert abs((hit.mean() - expected) / np.sqrt(expected * (1.0 - expected) / REPLICAS)) <= 4.0


def test_power_of_groups_within_one_adjustment_follows_the_variance() -> None:
    """Bartlett through R against one group of larger errors: the power grows from the level to certainty."""
    rng, a = np.random.default_rng(116), ADJUSTMENT
    df = np.bincount(a.groups, np.diag(a.projector))
    member = (a.groups == np.arange(4)[:, None]).astype(float)

    def theta(e: np.ndarray) -> np.ndarray:
        s2 = member @ (a.projector @ e) ** 2 / df[:, None]
        return np.asarray(df @ np.log((df @ s2) / df.sum() / s2))

    limit = np.quantile(theta(rng.standard_normal((a.n, REPLICAS))), 0.95)
    powers = []
    for factor in (1.0, 2.0, 4.0, 8.0):
        e = rng.standard_normal((a.n, REPLICAS)) * np.where(a.groups == 0, factor, 1.0)[:, None]
        powers.append(float(np.mean(theta(e) > limit)))
    assert abs(powers[0] - 0.05) <= 4.0 * np.sqrt(2 * 0.05 * 0.95 / REPLICAS)
    assert powers == sorted(powers)
    assert powers[1] > 0.10
    assert powers[3] > 0.8


@pytest.mark.parametrize("a", [-0.3, 0.5])
def test_power_of_kurtosis_and_skewness_against_another_implementation(a: float) -> None:
    """Against modulated normal values, and squares of normal ones: as often rejected as by SciPy's tests, on samples of its own."""
    rng, n = np.random.default_rng(117), 150
    member = law("modulated_normal")(a=a)
    draws = [member.rvs(n * REPLICAS, rng).reshape(n, REPLICAS) for _ in range(2)]
    ours = both(KurtosisLaw(n), _moments(draws[0])[:, 2]) <= 0.05
    theirs = stats.kurtosistest(draws[1], axis=0).pvalue <= 0.05
    assert 0.1 < ours.mean() < 0.999
    assert abs(ours.mean() - theirs.mean()) <= 4.0 * np.sqrt(2 * theirs.mean() * (1 - theirs.mean()) / REPLICAS)
    skew = [x + 0.08 * rng.standard_normal(x.shape) ** 2 * np.abs(x).mean() for x in (rng.standard_normal((n, REPLICAS)) for _ in range(2))]
    skew = [x + 0.05 * x**2 for x in skew]
    ours = both(SkewnessLaw(n), _moments(skew[0])[:, 1]) <= 0.05
    theirs = stats.skewtest(skew[1], axis=0).pvalue <= 0.05
    assert ours.mean() > 0.1
    assert abs(ours.mean() - theirs.mean()) <= 4.0 * np.sqrt(2 * theirs.mean() * (1 - theirs.mean()) / REPLICAS)


def test_brown_forsythe_is_approximate() -> None:
    rng, codes = np.random.default_rng(106), np.repeat(np.arange(4), 20)
    p = []
    for _ in range(REPLICAS):
        x = rng.standard_normal(80)
        made, _ = study_groups(codes, ("a", "b", "c", "d"), x, x, None, StudyOptions())
        p.append(made.test("brown_forsythe").p_value)  # type: ignore[union-attr]
    assert sizes(np.array(p)) == pytest.approx([0.075, 0.035, 0.006], abs=0.013)  # cautious, as its authors found for medians


def test_groups_within_one_adjustment() -> None:
    """The sums of squares of groups of one adjustment are not chi-square: their law through R keeps the level, chi-square does not."""
    rng, a = np.random.default_rng(107), ADJUSTMENT
    df = np.bincount(a.groups, np.diag(a.projector))
    member = (a.groups == np.arange(4)[:, None]).astype(float)

    def theta(e: np.ndarray) -> np.ndarray:
        s2 = member @ (a.projector @ e) ** 2 / df[:, None]
        return np.asarray(df @ np.log((df @ s2) / df.sum() / s2))

    drawn, null = theta(rng.standard_normal((a.n, REPLICAS))), theta(2.0 * rng.standard_normal((a.n, REPLICAS)))
    simulated(drawn, null, "Bartlett through R")
    naive = np.mean(stats.chi2(3).sf(drawn) <= 0.05)
    assert abs(z_of(stats.chi2(3).sf(drawn) <= 0.05, 0.05)) > 4.0, naive


# ---- laws: chi-square on classes beside the statistics of the distribution function ----------------------------------------------------


def rule(n: int, loc: float | None) -> ClassRule:
    k = max(4, n // 6)
    return ClassRule(np.concatenate([[-np.inf], stats.norm.ppf(np.arange(1, k) / k), [np.inf]]), True, loc, "open")


@pytest.mark.parametrize(("name", "loc", "n"), [("normal", None, 60), ("radico", 0.0, 60), ("laplace", None, 50), ("student", 0.0, 120)])
def test_chi_square_on_classes_by_bootstrap(name: str, loc: float | None, n: int) -> None:
    """The bootstrap follows limits and estimates; the asymptotic law rejects too often, for estimates come from single values."""
    member, rng = law(name), np.random.default_rng(108)
    truth = member(**({"nu": 5.0} if name == "student" else {}))
    given = {} if loc is None else {"loc": loc}
    cls = member.distribution
    x = cls._rvs(rng, (n, REPLICAS), *truth.shape_values)
    p, _ = refit_columns(member, x, truth, given)
    again = p["loc"] + p["scale"] * cls._rvs(rng, (n, REPLICAS), *(p[s.name] for s in cls.shapes))
    drawn, null = (_of_columns(member, y, truth, given, rule(n, loc)) for y in (x, again))
    for t, b, what in zip(drawn, null, (*STATISTICS, CHI_SQUARE), strict=True):
        if what == CHI_SQUARE:
            t, b = t + 1e-9 * rng.random(REPLICAS), b + 1e-9 * rng.random(REPLICAS)  # few values are possible: ties are drawn
        simulated(t, b, f"{name}, {what}")


def test_asymptotic_chi_square_on_classes() -> None:
    """Measured sizes of the asymptotic test with classes - 1 - 2 degrees of freedom: between Chernoff and Lehmann's bounds."""
    x = np.random.default_rng(109).standard_normal((200, REPLICAS))
    limits = rule(60, None)
    p, _ = refit_columns(NORMAL, x, NORMAL(), {})
    t = limits.chi_square(NORMAL, np.sort(x, axis=0), p)
    k = len(limits)
    for level in LEVELS:
        most = stats.chi2.sf(stats.chi2.isf(level, k - 3), k - 1)
        error = 4.0 * np.sqrt(level * (1.0 - level) / REPLICAS)
        assert level - error <= np.mean(stats.chi2(k - 3).sf(t) <= level) <= most + error


def test_laws_of_adjusted_residuals() -> None:
    """Through R all four tests of the normal law keep their level; for independent values they do not."""
    rng, a = np.random.default_rng(110), ADJUSTMENT
    given = {"loc": 0.0}
    e = [rng.standard_normal((a.n, REPLICAS)) for _ in range(2)]
    drawn, null = (_of_columns(NORMAL, a(x), NORMAL(), given, rule(a.n, 0.0)) for x in e)
    naive = _of_columns(NORMAL, rng.standard_normal((a.n, REPLICAS)), NORMAL(), given, rule(a.n, 0.0))
    wrong = []
    for t, b, i, what in zip(drawn, null, naive, (*STATISTICS, CHI_SQUARE), strict=True):
        if what == CHI_SQUARE:
            t, b = t + 1e-9 * rng.random(REPLICAS), b + 1e-9 * rng.random(REPLICAS)
        simulated(t, b, what)
        wrong.append(float(np.mean(t >= np.quantile(i, 0.95))))
    assert max(abs(w - 0.05) for w in wrong) > 0.015, wrong  # 5 % is claimed


def test_a_fitted_shape_through_an_adjustment_is_approximate() -> None:
    """Errors of the law that was fitted to the residuals are more normal than the true ones: the measured size is stated, not promised."""
    rng, a, member = np.random.default_rng(111), Adjustment(120, 30), law("modulated_normal")
    truth = member(a=0.5)
    given = {"loc": 0.0}
    count = 2000
    x = a(truth.rvs(a.n * count, rng).reshape(a.n, count))
    p, _ = refit_columns(member, x, truth, given)
    again = a(member.distribution._rvs(rng, (a.n, count), p["a"]))
    drawn, null = (_of_columns(member, y, truth, given, None) for y in (x, again))
    sizes_ = [float(np.mean(t >= np.quantile(b, 0.95))) for t, b in zip(drawn, null, strict=True)]
    assert sizes_ == pytest.approx([0.05] * 3, abs=0.03)


def test_p_values_of_the_study_are_uniform() -> None:
    """The whole path of `empirical_tests`, 99 replicas each: p <= k / 100 in k of 100 samples."""
    rng, count = np.random.default_rng(112), 4000
    p = np.empty((count, 3))
    for k in range(count):
        x = rng.standard_normal(25)
        p[k] = [t.p_value for t in empirical_tests(x, fit(x, "normal"), 99, seed=k)]
    for i, name in enumerate(STATISTICS):
        exact(p[:, i] - 1e-12, name)


# ---- the scale rules of the paper -------------------------------------------------------------------------------------------------------


def test_s_o_rejects_normal_errors_about_half_the_time() -> None:
    """Raw residuals of 19 adjustments (10 of 18 observations, 9 of 50, 6 unknowns each) of truly normal errors, classes of the paper."""
    rng = np.random.default_rng(113)
    v = []
    for n in [18] * 10 + [50] * 9:
        q, _ = np.linalg.qr(rng.standard_normal((n, 6)))
        e = 7.9 * rng.standard_normal((n, 1000))
        v.append(e - q @ (q.T @ e))
    x = np.sort(np.concatenate(v), axis=0)
    edges = np.concatenate([[-np.inf], np.arange(-20.0, 21.0, 4.0), [np.inf]])
    classes = ClassRule(edges, False, None, "open")
    mean = x.mean(axis=0)
    squares = np.sum((x - mean) ** 2, axis=0)
    rejected = {}
    for symbol, r in (("S_o", 516.0), ("S_M", 630.0)):
        parameters = {"loc": mean, "scale": np.sqrt(squares / (r - 1.0))}
        rejected[symbol] = float(np.mean(stats.chi2(len(classes) - 3).sf(classes.chi_square(NORMAL, x, parameters)) <= 0.05))
    assert 0.45 < rejected["S_o"] < 0.70, rejected
    assert rejected["S_M"] < 0.09, rejected
