"""Strategies by simulation: Wu's deletion rates, sizes and bounds of snooping, power at the minimal detectable bias, cross-validation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from baarda.hypotheses.image_points import image_points
from baarda.hypotheses.levels import Options, noncentrality, power_of_test
from baarda.hypotheses.outliers import critical_tau, mdb, standardised, tau
from baarda.procedures.linear_snooping import snoop_rows
from baarda.procedures.selection import select_columns

pytestmark = pytest.mark.sampling


def z_of_rate(hits: int, count: int, rate: float) -> float:
    return (hits / count - rate) / np.sqrt(rate * (1.0 - rate) / count)


def airborne() -> np.ndarray:
    """Fourth-order polynomials of a flight and 17 unknowns for 30 control points of two image coordinates (n = 60, r = 43)."""
    rng = np.random.default_rng(28101993)
    t = np.repeat(rng.uniform(-1.0, 1.0, 30), 2)
    look = rng.uniform(0.6, 1.2, 30)
    a = np.zeros((60, 17))
    for k in range(5):
        p = np.polynomial.legendre.Legendre.basis(k)(t)
        a[0::2, k], a[1::2, k] = np.sin(look) * p[0::2], 0.1 * p[1::2]
        a[0::2, 5 + k], a[1::2, 5 + k] = 0.05 * look * p[0::2], p[1::2]
        a[0::2, 10 + k], a[1::2, 10 + k] = np.cos(look) * p[0::2], 0.2 * look * p[1::2]
    a[0::2, 15] = look + 0.3 * t[0::2] ** 2 * look
    a[1::2, 16] = look**2
    return a


WU = airborne()
NAMES = (*(f"{c}{k}" for c in "abc" for k in range(5)), "range", "squint")


@pytest.mark.parametrize(
    ("deciding", "printed"), [((), 0.950), (("variance_factor",), 0.677), (("criterion_b",), 0.774), (("aic",), 0.766)]
)
def test_a_true_zero_is_deleted_as_often_as_the_theory_says(deciding: tuple[str, ...], printed: float) -> None:
    """One true zero (c4) at r = 43: by F .950, by 9a .677, by 9b .774, by AIC .766."""
    assert np.linalg.matrix_rank(WU) == 17
    assert len(WU) - 17 == 43
    rng = np.random.default_rng(2000)
    x = rng.uniform(0.5, 2.0, 17)
    x[NAMES.index("c4")] = 0.0
    count, hits = 4000, 0
    for _ in range(count):
        found = select_columns(WU, WU @ x + rng.standard_normal(60), ["c4"], names=NAMES, deciding=deciding)
        hits += found.deleted == ("c4",)
    exact = {0.950: 0.95, 0.677: stats.f.cdf(1.0, 1, 43), 0.774: stats.f.cdf(43 * ((44 / 43) ** 1.5 - 1), 1, 43)}
    exact[0.766] = stats.f.cdf(43 * np.expm1(2 / 60), 1, 43)
    assert exact[printed] == pytest.approx(printed, abs=6e-4)
    assert abs(z_of_rate(hits, count, float(exact[printed]))) <= 4.0


def test_the_strategy_finds_the_level_flight() -> None:
    """c3 = c4 = 0: the strategy deletes both in most replicas and hardly ever a coefficient that is there."""
    rng = np.random.default_rng(2001)
    x = np.full(17, 20.0)
    x[[NAMES.index("c3"), NAMES.index("c4")]] = 0.0
    high = [n for n in NAMES if n[-1] in "34" and n not in ("range", "squint")]
    both = wrong = 0
    count = 600
    for _ in range(count):
        found = select_columns(WU, WU @ x + rng.standard_normal(60), high, names=NAMES)
        both += {"c3", "c4"} <= set(found.deleted)
        wrong += bool(set(found.deleted) - {"c3", "c4"})
    assert both / count > 0.5
    assert wrong / count < 0.05


def small(seed: int = 4, n: int = 36, u: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, u))


@pytest.mark.parametrize("sigma", ["aposteriori", "apriori"])
@pytest.mark.parametrize("levels", ["sidak", "bonferroni", "holm"])
def test_snooping_of_good_data_rejects_at_most_at_the_level_of_the_family(sigma: str, levels: str) -> None:
    a, options = small(), Options(sigma=sigma, levels=levels, alpha=0.05)
    rng = np.random.default_rng(77)
    count = 3000
    hits = sum(bool(snoop_rows(a, rng.standard_normal(36), options=options).removed) for _ in range(count))
    assert hits / count <= 0.05 + 4.0 * np.sqrt(0.05 * 0.95 / count)


@pytest.mark.parametrize("sigma", ["aposteriori", "apriori"])
def test_first_tests_have_their_size(sigma: str) -> None:
    """w and tau of every single observation reject at their level: clusters of replicas, |z| <= 4."""
    a = small()
    basis = np.linalg.qr(a)[0]
    q = 1.0 - np.einsum("nu,nu->n", basis, basis)
    rng = np.random.default_rng(78)
    e = rng.standard_normal((36, 20_000))
    v = basis @ (basis.T @ e) - e
    s2 = (v * v).sum(axis=0) / 28
    for level in (0.1, 0.05, 0.01):
        if sigma == "aposteriori":
            hit = np.abs(v) / np.sqrt(s2 * q[:, None]) > critical_tau(28, level)
        else:
            hit = np.abs(v) / np.sqrt(q[:, None]) > stats.norm.isf(level / 2)
        each = hit.mean(axis=0)
        assert abs((each.mean() - level) / (each.std() / np.sqrt(len(each)))) <= 4.0


def test_power_at_the_minimal_detectable_bias() -> None:
    """w finds a bias of the size of the MDB in .80 of the replicas; every observation, |z| <= 4."""
    a = small()
    basis = np.linalg.qr(a)[0]
    q = 1.0 - np.einsum("nu,nu->n", basis, basis)
    sizes = mdb(1.0, q, 1.0, 0.001, 0.80)
    rng = np.random.default_rng(79)
    count = 4000
    for i in range(0, 36, 3):
        l_ = rng.standard_normal((36, count))
        l_[i] += sizes[i]
        v = basis[i] @ (basis.T @ l_) - l_[i]
        w = standardised(v, np.full(count, q[i]))
        hits = int((np.abs(w) > stats.norm.isf(0.0005)).sum())
        assert abs(z_of_rate(hits, count, 0.80)) <= 4.0


def test_power_of_tau_is_that_of_the_noncentral_t() -> None:
    a = small()
    basis = np.linalg.qr(a)[0]
    q = 1.0 - np.einsum("nu,nu->n", basis, basis)
    rng = np.random.default_rng(80)
    count, i, r = 20_000, 5, 28
    shift = 4.0 / np.sqrt(q[i])
    l_ = rng.standard_normal((36, count))
    l_[i] += shift
    v = basis @ (basis.T @ l_) - l_
    values = np.array([tau([x], [q[i]], s)[0] for x, s in zip(v[i], (v * v).sum(axis=0) / r, strict=True)])
    hits = int((np.abs(values) > critical_tau(r, 0.01)).sum())
    t = stats.t.isf(0.005, r - 1)
    power = stats.nct.sf(t, r - 1, 4.0) + stats.nct.cdf(-t, r - 1, 4.0)
    assert abs(z_of_rate(hits, count, float(power))) <= 4.0


@pytest.mark.parametrize("aposteriori", [False, True])
def test_power_of_two_coordinates_together(aposteriori: bool) -> None:
    """Power of the joint test of an image point against the noncentral chi-square and F."""
    a = small(9)
    basis = np.linalg.qr(a)[0]
    rest = np.eye(36) - basis @ basis.T
    m = rest[:2, :2]
    bias = np.array([2.5, -2.0])
    lam = float(bias @ m @ bias)
    rng = np.random.default_rng(81)
    count, alpha, r = 4000, 0.01, 28
    hits = 0
    for _ in range(count):
        e = rng.standard_normal(36)
        e[:2] += bias
        v = -(rest @ e)
        known = (float(np.sqrt(v @ v / r)), float(r)) if aposteriori else (1.0, None)
        hits += bool(image_points(v[None, :2], m[None], *known, alpha=alpha).rejected[0])
    power = power_of_test(lam, alpha, 2, r - 2 if aposteriori else np.inf)
    assert abs(z_of_rate(hits, count, float(power))) <= 4.0
    assert noncentrality(0.001, 0.8, 2) > noncentrality(0.001, 0.8, 1)


def test_a_single_gross_error_is_removed_alone() -> None:
    """An error of twice the MDB is removed in nearly all replicas, and good observations rarely with it."""
    a = small()
    basis = np.linalg.qr(a)[0]
    q = 1.0 - np.einsum("nu,nu->n", basis, basis)
    sizes = mdb(1.0, q)
    rng = np.random.default_rng(82)
    count, right, more = 1000, 0, 0
    for _ in range(count):
        i = int(rng.integers(36))
        l_ = rng.standard_normal(36)
        l_[i] += 2.0 * sizes[i]
        found = snoop_rows(a, l_).removed
        right += i in found
        more += len(set(found) - {i}) > 0
    assert right / count > 0.97
    # at level .001 for each of 35 good observations
    assert more / count <= 0.035 + 4.0 * np.sqrt(0.035 / count)


def test_cross_validation_of_good_control() -> None:
    """Predicted errors of withheld control: the share beyond the 5 % limit, and the mean square by its prediction."""
    from baarda.procedures.cross_validation import cross_validate
    from networks import ring

    beyond, ratios = [], []
    for seed in range(30):
        found = cross_validate(ring(images=5, points=14, control=9, seed=seed, noise=0.3, control_sigma=0.004), 3)
        beyond.append(found.rejected / len(found.rows))
        ratios.append(next(e.ratio for e in found.errors if e.name == "3d"))
    for values, expected in ((beyond, 0.05), (ratios, 1.0)):
        x = np.asarray(values)
        assert abs((x.mean() - expected) / (x.std(ddof=1) / np.sqrt(len(x)))) <= 4.0
