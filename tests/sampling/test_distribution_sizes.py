"""Measured size of the goodness-of-fit tests under their null, for raw samples and for residuals of a small adjustment.

One bootstrap draw per replica suffices: the statistics of the draws, pooled over all replicas, give the critical value
(Giacomini, Politis & White 2013). Both sides are random, hence the factor two in the variance.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from baarda.distributions import fit, law
from baarda.distributions.base import Distribution, Law
from baarda.distributions.replicas import columnwise, refit_columns
from baarda.hypotheses.goodness_of_fit import chi_square, empirical_statistics

pytestmark = pytest.mark.sampling
REPLICAS = 4000
LEVELS = (0.10, 0.05, 0.01)


def columns_of(cls: type[Distribution], shapes: tuple[np.ndarray, ...], n: int, rng: np.random.Generator) -> np.ndarray:
    """Standard values, one column per set of shapes."""
    return cls._rvs(rng, (n, REPLICAS), *shapes)


def statistics(
    member: Law, x: np.ndarray, start: Distribution, given: dict[str, float]
) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, ...]]:
    x = np.sort(x, axis=0)
    p, _ = refit_columns(member, x, start, given)
    cls = member.distribution
    z = (x - p["loc"]) / p["scale"]
    own = tuple(p[s.name] for s in cls.shapes)
    return p, empirical_statistics(columnwise(cls._cdf, cls, z, own), columnwise(cls._sf, cls, z, own))


def check(drawn: np.ndarray, bootstrapped: np.ndarray, what: str) -> None:
    for level in LEVELS:
        limit = np.quantile(bootstrapped, 1 - level, method="higher")
        size = np.mean(drawn >= limit)
        z = (size - level) / np.sqrt(2 * level * (1 - level) / REPLICAS)
        assert abs(z) <= 4, f"{what}: size {size:.4f} at {level}"


CASES = [
    ("normal", {}, 30),
    ("radico", {}, 30),
    ("lineo", {"loc": 0.0}, 60),
    ("laplace", {}, 25),
    ("logistic", {}, 40),
    ("modulated_normal", {"loc": 0.0}, 120),
]


@pytest.mark.parametrize(("name", "given", "n"), CASES)
def test_size_for_independent_values(name: str, given: dict[str, float], n: int) -> None:
    member = law(name)
    truth = member(**({"a": 0.5} if name == "modulated_normal" else {}))
    cls = member.distribution
    rng = np.random.default_rng(77)
    x = columns_of(cls, truth.shape_values, n, rng)
    p, drawn = statistics(member, x, truth, given)
    again = p["loc"] + p["scale"] * columns_of(cls, tuple(p[s.name] for s in cls.shapes), n, rng)
    _, bootstrapped = statistics(member, again, truth, given)
    for t, b, what in zip(drawn, bootstrapped, ("kolmogorov", "cramer_von_mises", "anderson_darling")):
        check(t, b, f"{name}, {what}")


def test_size_for_residuals_and_how_wrong_the_naive_p_value_is() -> None:
    n, u = 40, 26
    rng = np.random.default_rng(5)
    q, _ = np.linalg.qr(rng.standard_normal((n, u)))
    r = np.eye(n) - q @ q.T
    root = np.sqrt(np.diag(r))[:, None]
    normal = law("normal")
    truth = normal()

    def residuals(e: np.ndarray) -> np.ndarray:
        return r @ e / root

    given = {"loc": 0.0}
    _, drawn = statistics(normal, residuals(rng.standard_normal((n, REPLICAS))), truth, given)
    _, through = statistics(normal, residuals(rng.standard_normal((n, REPLICAS))), truth, given)
    _, naive = statistics(normal, rng.standard_normal((n, REPLICAS)), truth, given)
    for t, b in zip(drawn, through):
        check(t, b, "through the design matrix")
    share = np.mean(drawn[2] >= np.quantile(naive[2], 0.95))
    assert share < 0.02 or share > 0.09, f"naive size {share:.4f}"  # 5 % is claimed


def test_size_of_the_likelihood_ratio() -> None:
    normal, wide = law("normal"), law("modulated_normal")
    rng = np.random.default_rng(6)
    given = {"loc": 0.0}

    def ratio(x: np.ndarray) -> np.ndarray:
        _, narrow = refit_columns(normal, x, normal(), given)
        _, broad = refit_columns(wide, x, wide(a=4.0), given)
        return np.maximum(0.0, 2 * (broad - narrow))

    drawn, again = ratio(rng.standard_normal((200, REPLICAS))), ratio(3.0 * rng.standard_normal((200, REPLICAS)) / 3.0)
    check(drawn, again, "normal against modulated")
    assert 0.5 < np.mean(drawn < 1e-3) < 0.65  # a = infinity in more than half of normal samples


def test_measured_size_of_chi_square_with_fitted_parameters() -> None:
    """The law lies between k - 1 - p and k - 1 degrees of freedom: the test rejects a little too often, and never more than stated here."""
    rng = np.random.default_rng(7)
    count = 2000
    given_all = np.array([chi_square(rng.standard_normal(200), "normal", number=10, loc=0.0, scale=1.0).p_value for _ in range(count)])
    fitted = np.array([chi_square(rng.standard_normal(200), "normal", number=10).p_value for _ in range(count)])
    for level in LEVELS:
        error = np.sqrt(level * (1 - level) / count)
        assert abs(np.mean(given_all < level) - level) <= 4 * error + 0.1 * level
        most = stats.chi2.sf(stats.chi2.isf(level, 7), 9)
        assert level - 4 * error <= np.mean(fitted < level) <= most + 4 * error


def test_standard_errors_and_profile_intervals_cover() -> None:
    from baarda.distributions import profile_interval

    truth = law("modulated_normal")(a=1.0, scale=2.0)
    rng = np.random.default_rng(8)
    inside = scales = 0
    count = 150
    for _ in range(count):
        x = truth.rvs(800, rng)
        low, high = profile_interval(x, loc=0.0)
        inside += low <= 1.0 <= high
        found = fit(x, loc=0.0)
        scales += abs(found.parameters["scale"] - 2.0) <= 1.959964 * (found.standard_errors["scale"] or 0.0)
    for hits in (inside, scales):
        assert abs(hits / count - 0.95) <= 4 * np.sqrt(0.95 * 0.05 / count)
