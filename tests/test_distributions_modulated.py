"""The modulated normal laws against mpmath, against their closed forms, and across the seams between methods."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, special

from baarda.distributions import _exponential_integral as ei
from baarda.distributions.modulated import ModulatedNormal
from baarda.distributions.normal import Normal
from baarda.errors import UsageError

try:
    import mpmath as mp
except ImportError:  # the oracle of accuracy; without it these tests skip
    mp = None
else:
    mp.mp.dps = 60
needs_mpmath = pytest.mark.skipif(mp is None, reason="the oracle mpmath is not installed (extra 'oracle')")

SHAPES = [-0.89, -0.75, -0.6, -0.5, -0.49999, -0.25, 0.0, 1e-9, 0.1, 0.5, 0.75, 1.0, 1.0001, 1.5, 2.0, 3.5, 7.3, 12.5, 24.5, 25.0]
Z = np.concatenate([[1e-12, 1e-3], np.linspace(0.05, 6.0, 12), [8.0, 13.7, 21.3, 30.1, 35.0]])


def exact(z: float, a: float) -> tuple[mp.mpf, mp.mpf]:
    """Density and upper tail area of the standardised law, 60 digits."""
    z, a = mp.mpf(float(z)), mp.mpf(float(a))
    sigma = mp.sqrt((a + 2) / (a + 1))
    c = (z / sigma) ** 2 / 2
    f = (a + 1) / (sigma * mp.sqrt(2 * mp.pi)) * mp.expint(a + mp.mpf(3) / 2, c)
    return f, mp.erfc(mp.sqrt(c)) / 2 - z * f / (2 * (a + 1))


@pytest.mark.parametrize("a", SHAPES)
@needs_mpmath
def test_relative_accuracy_against_mpmath(a: float) -> None:
    law = ModulatedNormal(a)
    f, tail, log_f, area, back = law.pdf(Z), law.sf(Z), law.logpdf(Z), law.cdf(Z), law.cdf(-Z)
    for i, z in enumerate(Z):
        f0, s0 = exact(z, a)
        assert abs(f[i] / f0 - 1) <= 1e-13, (z, "pdf")
        assert abs(tail[i] / s0 - 1) <= 1e-13, (z, "sf")
        assert abs(area[i] / (1 - s0) - 1) <= 1e-13, (z, "cdf")
        assert back[i] == tail[i]
        assert abs(log_f[i] - mp.log(f0)) <= 1e-13 * max(1, abs(mp.log(f0))), (z, "logpdf")


@pytest.mark.parametrize("a", [-0.999, -0.95, 60.0, 1e3 + 0.5])
@needs_mpmath
def test_relative_accuracy_outside_the_usual_shapes(a: float) -> None:
    law = ModulatedNormal(a)
    z = np.array([1e-3, 0.4, 1.7, 3.0, 6.0])
    for i, value in enumerate(z):
        f0, s0 = exact(value, a)
        assert abs(law.pdf(z)[i] / f0 - 1) <= 1e-12
        assert abs(law.sf(z)[i] / s0 - 1) <= 1e-12


@pytest.mark.parametrize("a", SHAPES)
def test_quantiles_invert_to_the_rounding_of_x(a: float) -> None:
    law = ModulatedNormal(a)
    p = law.sf(Z)
    # what a rounding of p can move
    move = np.spacing(p) * 40 / law.pdf(Z)
    assert np.all(np.abs(law.isf(p) - Z) <= 8 * np.spacing(Z) + move)
    assert np.array_equal(law.ppf(p), -law.isf(p))
    assert law.ppf(0.5) == 0.0
    assert law.ppf(0.0) == -np.inf
    assert law.ppf(1.0) == np.inf
    assert np.isnan(law.ppf(1.5))


def entropy(a: float) -> mp.mpf:
    with mp.workdps(25):
        a = mp.mpf(a)
        sigma = mp.sqrt((a + 2) / (a + 1))
        factor = (a + 1) / (sigma * mp.sqrt(2 * mp.pi))
        power = max(mp.mpf(1), 1 / (2 * (a + 1)))

        def g(z: mp.mpf) -> mp.mpf:
            f = factor * mp.expint(a + mp.mpf(3) / 2, (z / sigma) ** 2 / 2)
            return f * mp.log(f)

        inner = mp.quad(lambda w: g(w**power) * power * w ** (power - 1) if w > 0 else mp.mpf(0), [0, 1e-6, 0.01, 0.1, 0.5, 1])
        return -2 * (inner + mp.quad(g, [1, 2, 4, 8, 20, 40 * sigma]))


@pytest.mark.parametrize("a", [-0.89, -0.5, 0.0, 0.5, 2.0, 25.0])
@needs_mpmath
def test_entropy_against_mpmath(a: float) -> None:
    reference = entropy(a)
    assert abs(ModulatedNormal(a).entropy() - reference) <= 1e-13 * max(1, abs(reference))


def test_entropy_of_the_limit_is_that_of_the_normal() -> None:
    assert ModulatedNormal(np.inf, scale=3.0).entropy() == Normal(scale=3.0).entropy()
    assert ModulatedNormal(1e8).entropy() == pytest.approx(Normal().entropy(), abs=1e-14)


def test_closed_forms() -> None:
    z = np.linspace(0.0, 5.0, 51)
    for a in (0.0, 0.5, 1.0):
        sigma = np.sqrt((a + 2) / (a + 1))
        c = z * z / (2 * sigma**2)
        root, normalisation = np.sqrt(c), sigma * np.sqrt(2 * np.pi)
        if a == 0.0:
            f = 2 / normalisation * (np.exp(-c) - np.sqrt(np.pi * c) * special.erfc(root))
        elif a == 0.5:
            f = 1.5 / normalisation * special.expn(2, c)
        else:
            f = 4 / (3 * normalisation) * (np.exp(-c) * (1 - 2 * c) + 2 * np.sqrt(np.pi) * c * root * special.erfc(root))
        assert ModulatedNormal(a).pdf(z) == pytest.approx(f, rel=1e-11, abs=1e-15)


def test_it_is_the_mixture_it_claims_to_be() -> None:
    a, z = -0.3, 1.3
    sigma = np.sqrt((a + 2) / (a + 1))
    f, _ = integrate.quad(
        lambda t: (a + 1) * t**a * np.exp(-z * z / (2 * sigma**2 * t)) / np.sqrt(2 * np.pi * t) / sigma, 0, 1, epsabs=1e-13
    )
    assert ModulatedNormal(a).pdf(z) == pytest.approx(f, rel=1e-9)


@given(st.floats(-0.9, 30.0), st.floats(0.999, 1.001))
@settings(max_examples=200, deadline=None)
def test_no_jump_between_series_and_continued_fraction(a: float, c: float) -> None:
    z = np.sqrt(c * 2 * (a + 2) / (a + 1))
    below, above = np.nextafter(z, 0), np.nextafter(z, 99)
    law = ModulatedNormal(a)
    for function in (law.pdf, law.sf, law.logpdf, law.score):
        assert function(below) == pytest.approx(function(above), rel=2e-14)


@given(st.floats(-0.95, 25.0), st.floats(0.0, 30.0), st.floats(-12.0, -7.0))
@settings(max_examples=100, deadline=None)
def test_no_jump_in_the_shape(a: float, z: float, log_step: float) -> None:
    # orders near integers and half-integers included through rounding to quarters
    for base in (a, max(round(2 * a) / 2, -0.5)):
        near = base + 10.0**log_step
        f, g = ModulatedNormal(base), ModulatedNormal(near)
        slope = 60.0 * (1 + z * z) / (1 + base) ** 2
        assert abs(f.logpdf(z + 0.01) - g.logpdf(z + 0.01)) <= slope * (near - base) + 1e-12 * (1 + z * z)
        assert f.sf(z + 0.01) == pytest.approx(g.sf(z + 0.01), rel=slope * (near - base) + 1e-12 * (1 + z * z))


def test_the_normal_is_the_limit() -> None:
    z = np.linspace(-6, 6, 41)
    limit, near, normal = ModulatedNormal(np.inf), ModulatedNormal(1e7), Normal()
    for name in ("pdf", "logpdf", "cdf", "sf", "score"):
        assert np.array_equal(getattr(limit, name)(z), getattr(normal, name)(z)), name
        assert getattr(near, name)(z) == pytest.approx(getattr(normal, name)(z), rel=1e-10, abs=1e-12), name
    a = np.array([0.5, np.inf])
    assert ModulatedNormal._pdf(np.array([1.0, 1.0]), a) == pytest.approx([ModulatedNormal(0.5).pdf(1.0), normal.pdf(1.0)], rel=1e-15)


def test_shapes_broadcast() -> None:
    z, a = np.linspace(-3, 3, 7)[:, None], np.array([-0.4, 0.5, 1.0, 4.0, 80.0])
    for name in ("_pdf", "_logpdf", "_sf", "_cdf", "_score"):
        table = getattr(ModulatedNormal, name)(z, a)
        assert table.shape == (7, 5)
        for j, value in enumerate(a):
            assert table[:, j] == pytest.approx(getattr(ModulatedNormal, name)(z[:, 0], value), rel=1e-14), name
    q = np.array([0.01, 0.3, 0.5, 0.9])[:, None]
    assert ModulatedNormal._isf(q, a)[:, 1] == pytest.approx(ModulatedNormal(0.5).isf(q[:, 0]), rel=1e-14)
    assert ModulatedNormal._gradient(z, a)[0][:, 3] == pytest.approx(ModulatedNormal._gradient(z[:, 0], 4.0)[0], rel=1e-10, abs=1e-14)


@pytest.mark.parametrize("a", [-0.7, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0, 1.5, 3.0, 3.2, 20.0, 80.0])
def test_derivatives(a: float) -> None:
    z = np.array([0.01, 0.3, 0.9, 1.8, 2.6, 4.0, 7.0])
    h = 1e-5
    log_f, score, (slope,) = ModulatedNormal._likelihood(z, a)
    assert log_f == pytest.approx(ModulatedNormal._logpdf(z, a), rel=1e-15)
    numeric = (ModulatedNormal._logpdf(z * (1 + h), a) - ModulatedNormal._logpdf(z * (1 - h), a)) / (2 * h * z)
    assert score == pytest.approx(numeric, rel=1e-7, abs=1e-8)
    assert score == pytest.approx(-ModulatedNormal._score(-z, a), rel=1e-15)
    step = 1e-4 * (1 + a)
    numeric = (ModulatedNormal._logpdf(z, a + step) - ModulatedNormal._logpdf(z, a - step)) / (2 * step)
    assert slope == pytest.approx(numeric, rel=1e-5, abs=1e-10)
    assert ModulatedNormal._gradient(z, a)[0] == pytest.approx(slope, rel=1e-12)


def test_the_weight_is_unbounded_influence() -> None:
    """The weight of an adjustment tends to 1/sigma^2 > 0: efficient, not outlier-resistant."""
    law = ModulatedNormal(0.5)
    assert -law.score(1e4) / 1e4 == pytest.approx(1.5 / 2.5, rel=1e-6)


@pytest.mark.parametrize("a", [-0.8, 0.0, 0.5, 3.0, np.inf])
def test_sampler(a: float) -> None:
    x = ModulatedNormal(a, loc=2.0, scale=3.0).rvs(200_000, np.random.default_rng(5))
    z = (x - 2.0) / 3.0
    kurtosis = 3.0 + 3.0 / ((a + 1) * (a + 3)) if np.isfinite(a) else 3.0
    assert abs(np.mean(z)) * np.sqrt(z.size) < 4
    assert abs(np.mean(z**2) - 1) / np.sqrt((kurtosis - 1) / z.size) < 4
    assert abs(np.mean(np.abs(z)) - ModulatedNormal(a).mean_deviation()) * np.sqrt(z.size) < 4


@needs_mpmath
def test_tiny_deviations_and_infinities() -> None:
    for a in (-0.8, -0.5, 0.3, 2.0):
        law = ModulatedNormal(a)
        assert law.pdf(0.0) == (np.inf if a <= -0.5 else pytest.approx(float(exact(0, a)[0]) if a > -0.5 else 0))
        assert law.sf(0.0) == 0.5
        assert law.sf(np.inf) == 0.0
        assert law.cdf(-np.inf) == 0.0
        assert law.pdf(np.inf) == 0.0
        assert law.logpdf(np.inf) == -np.inf
        assert np.isfinite(law.logpdf(1e-200))
    # the density grows like |z|^(2a+1) below a = -1/2, also where z^2 underflows
    law = ModulatedNormal(-0.8)
    assert law.logpdf(1e-250) - law.logpdf(1e-240) == pytest.approx(0.6 * 10 * np.log(10), rel=1e-9)
    assert ModulatedNormal(0.5).sf(200.0) == 0.0
    assert ModulatedNormal(0.5).logpdf(1e8) == pytest.approx(-0.3e16, rel=1e-12)


def test_bad_parameters() -> None:
    for keywords in ({"a": -1.0}, {"a": np.nan}, {"scale": 0.0}, {"scale": np.inf}, {"loc": np.nan}):
        with pytest.raises(UsageError):
            ModulatedNormal(**keywords)


@needs_mpmath
def test_exponential_integral_against_mpmath() -> None:
    """Orders at, beside and between integers; the check that once found an approximated zeta constant in the 11th digit."""
    c = np.concatenate([10.0 ** np.linspace(-9, -0.001, 10), [1.0, 1.3, 1.999, 2.5, 4.0, 7.9, 12.0, 16.0, 31.0, 64.0, 300.0, 612.0]])
    for order in (-0.4, 0.0, 0.3, 0.5, 0.6, 1.0, 1.5, 1.75, 2.0, 2.0001, 2.5, 2.5 + 1e-9, 3.3, 6.499999, 10.0, 21.5, 26.5):
        value = ei.scaled_expint(order, c)
        for i, x in enumerate(c):
            reference = mp.exp(mp.mpf(x)) * mp.expint(mp.mpf(order), mp.mpf(x))
            assert abs(value[i] / reference - 1) < 2e-14, (order, x)


@needs_mpmath
def test_order_derivative_against_quadrature() -> None:
    for order in (0.5, 0.75, 1.0, 1.5, 2.0, 2.49, 2.5, 6.5, 20.0):
        for c in (1e-3, 0.3, 0.999, 1.0, 1.3, 8.0, 100.0):
            s, x = mp.mpf(order), mp.mpf(c)
            with mp.workdps(20):
                points = (
                    [0, 0.1 / (c + order), 1 / (c + order), 5 / (c + order), 1, 3, 8, 14]
                    if c < 1
                    else [0, 0.1 / (c + order), 1 / (c + order), 1, 4]
                )
                reference = -mp.quad(lambda u, s=s, x=x: u * mp.exp(-(s - 1) * u - x * mp.expm1(u)), sorted(set(points)))
            assert float(ei.order_derivative(order, np.array(c))) == pytest.approx(float(reference), rel=1e-11), (order, c)
