"""An exam that every law sits, at three scales each: nobody needs to write it for a new file."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import integrate

from baarda.distributions import Distribution, Law, fit, law, laws
from baarda.distributions._scipy_adapter import SciPyLaw
from baarda.errors import UsageError

MEMBERS = list(laws().values())
PLACES = [(0.0, 1.0), (3.0, 0.01), (-100.0, 20.0)]


@pytest.fixture(params=MEMBERS, ids=lambda m: m.name)
def member(request: pytest.FixtureRequest) -> Law:
    return request.param  # type: ignore[no-any-return]


@pytest.fixture(params=PLACES, ids=lambda p: f"{p[0]:g}+-{p[1]:g}")
def distribution(request: pytest.FixtureRequest, member: Law) -> Distribution:
    loc, scale = request.param
    return member(loc=loc, scale=scale)


def spots(d: Distribution) -> np.ndarray:
    return d.ppf(np.array([1e-6, 0.001, 0.02, 0.2, 0.35, 0.49, 0.501, 0.6, 0.75, 0.9, 0.99, 0.9999]))


def test_names_are_those_of_the_files(member: Law) -> None:
    assert law(member.name) is member
    assert member.description
    assert member.distribution.__doc__
    assert [*member.parameter_names][-2:] == ["loc", "scale"]
    with pytest.raises(UsageError):
        member(nonsense=1.0)


def test_area_is_one(distribution: Distribution) -> None:
    lower = distribution.ppf(np.concatenate([10.0 ** np.arange(-11, 0), [0.3, 0.45, 0.5]]))
    cuts = np.concatenate([lower, (2 * distribution.loc - lower)[-2::-1]])
    area = sum(integrate.quad(distribution.pdf, a, b, epsabs=1e-12, epsrel=1e-11)[0] for a, b in pairwise(cuts))
    assert area == pytest.approx(1.0, abs=1e-9)


def test_density_is_the_slope_of_the_cdf(distribution: Distribution) -> None:
    x = spots(distribution)
    h = 1e-5 * distribution.scale
    inside = np.abs(x - distribution.loc) > 3 * h
    slope = (distribution.cdf(x + h) - distribution.cdf(x - h)) / (2 * h)
    tail = (distribution.sf(x - h) - distribution.sf(x + h)) / (2 * h)
    steep = np.where(x < distribution.loc, slope, tail)
    assert steep[inside] == pytest.approx(distribution.pdf(x)[inside], rel=1e-5)
    assert np.log(distribution.pdf(x)) == pytest.approx(distribution.logpdf(x), rel=1e-12, abs=1e-12)


def test_areas_are_complementary_and_monotone(distribution: Distribution) -> None:
    x = np.linspace(*distribution.ppf(np.array([1e-9, 1 - 1e-9])), 501)
    assert distribution.cdf(x) + distribution.sf(x) == pytest.approx(1.0, abs=1e-15)
    assert np.all(np.diff(distribution.cdf(x)) >= 0)
    assert np.all(np.diff(distribution.sf(x)) <= 0)
    assert distribution.cdf(np.array([-np.inf, np.inf])) == pytest.approx([0.0, 1.0])
    assert distribution.sf(np.array([-np.inf, np.inf])) == pytest.approx([1.0, 0.0])


def test_symmetry(distribution: Distribution) -> None:
    if distribution.symmetric:
        d = spots(distribution) - distribution.loc
        left, right = distribution.loc - d, distribution.loc + d
        assert distribution.pdf(left) == pytest.approx(distribution.pdf(right), rel=1e-11)
        assert distribution.cdf(left) == pytest.approx(distribution.sf(right), rel=1e-11)


def test_quantiles_invert(distribution: Distribution) -> None:
    q = np.array([1e-12, 1e-5, 0.01, 0.2, 0.4999, 0.5, 0.7, 0.99])
    assert distribution.cdf(distribution.ppf(q)) == pytest.approx(q, rel=1e-9)
    assert distribution.sf(distribution.isf(q)) == pytest.approx(q, rel=1e-9)
    assert np.isnan(distribution.ppf(-0.1))
    assert np.isnan(distribution.isf(1.1))


def test_nan_stays_nan_and_scalars_scalars(distribution: Distribution) -> None:
    for name in ("pdf", "logpdf", "cdf", "sf", "score"):
        assert np.isnan(getattr(distribution, name)(np.nan)), name
        assert isinstance(getattr(distribution, name)(distribution.loc + 0.3 * distribution.scale), float), name


def test_score_and_gradient_are_derivatives(distribution: Distribution) -> None:
    x = spots(distribution)
    h = 1e-6 * distribution.scale
    # central differences lose digits near a cusp
    away = np.abs(x - distribution.loc) > 0.02 * distribution.scale
    numeric = (distribution.logpdf(x + h) - distribution.logpdf(x - h)) / (2 * h)
    assert (distribution.score(x) * distribution.scale)[away] == pytest.approx((numeric * distribution.scale)[away], rel=1e-4, abs=1e-6)
    cls, shapes = type(distribution), distribution.shape_values
    z = (x - distribution.loc) / distribution.scale
    log_f, score, slopes = cls._likelihood(z, *shapes)
    assert log_f == pytest.approx(cls._logpdf(z, *shapes), rel=1e-13)
    assert score == pytest.approx(cls._score(z, *shapes), rel=1e-12)
    for i, slope in enumerate(slopes):
        step = 1e-5 * (1 + abs(shapes[i]))
        up = cls._logpdf(z, *shapes[:i], shapes[i] + step, *shapes[i + 1 :])
        down = cls._logpdf(z, *shapes[:i], shapes[i] - step, *shapes[i + 1 :])
        assert slope == pytest.approx((up - down) / (2 * step), rel=1e-4, abs=1e-7)


def test_moments_and_entropy_agree_with_the_density(distribution: Distribution) -> None:
    cls, shapes = type(distribution), distribution.shape_values
    q = np.linspace(-36, 36, 6001)
    tail = 1 / (1 + np.exp(np.abs(q)))
    z = np.where(q > 0, cls._isf(tail, *shapes), cls._ppf(tail, *shapes))
    weight = tail * (1 - tail) * (q[1] - q[0])
    mean, variance, skewness, excess = (float(m) for m in cls._moments(*shapes))
    if np.isfinite(variance):
        assert np.sum(weight * z) == pytest.approx(mean, abs=1e-9)
        assert np.sum(weight * z**2) - mean**2 == pytest.approx(variance, rel=1e-4)
        assert distribution.std() == pytest.approx(np.sqrt(variance) * distribution.scale)
        if cls.scale_is_sd:
            assert variance == 1.0
    if np.isfinite(excess) and excess < 5.9:
        assert np.sum(weight * z**4) / variance**2 - 3 == pytest.approx(excess, rel=1e-6, abs=1e-6)
        assert skewness == 0.0 or not cls.symmetric
    entropy = -np.sum(weight * cls._logpdf(z, *shapes)) + np.log(distribution.scale)
    # the check's trapezoidal rule sees a kink at the centre
    assert distribution.entropy() == pytest.approx(entropy, rel=1e-5, abs=1e-5)


def test_sample_follows_its_own_cdf(distribution: Distribution) -> None:
    x = distribution.rvs(40_000, np.random.default_rng(11))
    u = np.sort(distribution.cdf(x))
    largest = np.max(np.abs(u - (np.arange(u.size) + 0.5) / u.size))
    assert largest * np.sqrt(u.size) < 1.95  # Kolmogorov, level 0.1 %
    again = distribution.rvs(40_000, np.random.default_rng(11))
    assert np.array_equal(x, again)
    assert distribution.rvs((3, 4), np.random.default_rng(0)).shape == (3, 4)


def test_fit_recovers_the_parameters(member: Law) -> None:
    for k, (loc, scale) in enumerate(PLACES):
        truth = member(loc=loc, scale=scale)
        x = truth.rvs(4000, np.random.default_rng(100 + k))
        found = fit(x, member)
        assert found.estimated == member.parameter_names
        for name in found.estimated:
            error = found.standard_errors[name]
            assert error is not None
            assert abs(found.parameters[name] - truth.parameters[name]) < 4.5 * error, name
        assert found.log_likelihood == pytest.approx(np.sum(found.distribution.logpdf(x)), rel=1e-12)
        assert found.log_likelihood >= np.sum(truth.logpdf(x))


def test_no_neighbour_is_more_likely(member: Law) -> None:
    x = member(loc=1.0, scale=2.0).rvs(300, np.random.default_rng(9))
    found = fit(x, member)
    best = found.log_likelihood
    assert best is not None
    rng = np.random.default_rng(10)
    for size in (1e-3, 0.03, 0.3):
        for _ in range(20):
            near = {}
            for name in found.estimated:
                value = found.parameters[name]
                near[name] = value + 2.0 * size * rng.standard_normal() if name == "loc" else value * np.exp(size * rng.standard_normal())
            if near.get("a", 1.0) < -0.25 or near.get("share", 0.1) >= 0.49 or near.get("ratio", 3.0) <= 1.06:
                continue
            assert np.sum(member(**near).logpdf(x)) <= best + 1e-7


def test_scipy_form(member: Law) -> None:
    form = SciPyLaw(member)
    shapes = [s.start for s in member.free_shapes]
    own = member(loc=1.0, scale=2.0)
    x = np.array([-3.0, 0.5, 1.1, 4.0])
    for name in ("pdf", "logpdf", "cdf", "sf"):
        assert getattr(form, name)(x, *shapes, loc=1.0, scale=2.0) == pytest.approx(getattr(own, name)(x), rel=1e-14), name
    q = np.array([0.01, 0.3, 0.9])
    assert form.ppf(q, *shapes, 1.0, 2.0) == pytest.approx(own.ppf(q), rel=1e-13)
    assert form.isf(q, *shapes, 1.0, 2.0) == pytest.approx(own.isf(q), rel=1e-13)


def test_it_is_a_frozen_value(distribution: Distribution) -> None:
    with pytest.raises(AttributeError):
        distribution.loc = 5.0  # type: ignore[misc]
    with pytest.raises(UsageError):
        type(distribution)(*distribution.shape_values, scale=-1.0)
    assert hash(distribution) == hash(type(distribution)(*distribution.shape_values, loc=distribution.loc, scale=distribution.scale))
