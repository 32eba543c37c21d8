"""Romanowski's modulated normal laws: a normal law whose variance is spread over (0, sigma^2] with density proportional to t^a."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special

from baarda.distributions._double_double import half_square, variance_ratio
from baarda.distributions._exponential_integral import order_derivative, scaled_difference, scaled_expint
from baarda.distributions.base import Distribution, Floats, Law, Shape
from baarda.distributions.normal import Normal

_ROOT_PI = float(np.sqrt(np.pi))
_NORMAL_FROM = 1e12  # from here on the law differs from the normal by less than 1e-24 relative variance of the modulation


@dataclass(frozen=True)
class ModulatedNormal(Distribution):
    """The modulated normal law: X = loc + sigma sqrt(T) Z, Z normal, T in (0, 1] with density (a + 1) t^a.

    `scale` is the standard deviation S of X; sigma = S sqrt((a+2)/(a+1)). With c = (x-loc)^2 / (2 sigma^2) the density is
    (a+1)/(sigma sqrt(2 pi)) E_(a+3/2)(c). a = 1/2 is radico, 1 lineo, 0 equi, 2 quadri; a = inf is exactly the normal.

    Attributes
    ----------
    a : float
        Non-normality, > -1; the smaller, the more peaked and the heavier the tails (kurtosis 3 + 3/((a+1)(a+3))).

    Notes
    -----
    Romanowski, Bull. Geod. 73 (1964) 195-216; Maarek & Konecny. The density is infinite at `loc` for a <= -1/2.

    Examples
    --------
    >>> law = ModulatedNormal(0.5)
    >>> law.cdf([0.5, 1.0, 2.0]).round(6)
    array([0.710315, 0.853194, 0.973666])
    """

    a: float = 1.0

    family: ClassVar[str] = "modulated_normal"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("a", -1.0, np.inf, 1.0, upper_closed=True, flat_limit=True),)
    scale_is_sd: ClassVar[bool] = True
    by_shape: ClassVar[bool] = True

    @classmethod
    def _pdf(cls, z: Floats, *shapes: Any) -> Any:
        return _with_normal_limit(_pdf, Normal._pdf, z, shapes[0])

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        return _with_normal_limit(_logpdf, Normal._logpdf, z, shapes[0])

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        return _with_normal_limit(_sf, Normal._sf, z, shapes[0])

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        return _with_normal_limit(_isf, Normal._isf, q, shapes[0])

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        return _with_normal_limit(_score, Normal._score, z, shapes[0])

    @classmethod
    def _gradient(cls, z: Floats, *shapes: Any) -> tuple[Floats, ...]:
        return (_with_normal_limit(_gradient, lambda x: np.zeros_like(x), z, shapes[0]),)

    @classmethod
    def _log_and_score(cls, z: Floats, *shapes: Any) -> tuple[Floats, Floats]:
        a = np.asarray(shapes[0], dtype=float)
        if np.any(a >= _NORMAL_FROM):
            return super()._log_and_score(z, a)
        return _log_and_score(np.asarray(z, dtype=float), a)[:2]

    @classmethod
    def _likelihood(cls, z: Floats, *shapes: Any) -> tuple[Floats, Floats, tuple[Floats, ...]]:
        a = np.asarray(shapes[0], dtype=float)
        if np.any(a >= _NORMAL_FROM):
            return super()._likelihood(z, a)
        return _likelihood(np.asarray(z, dtype=float), a)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        a = np.asarray(shapes[0], dtype=float)
        z = rng.standard_normal(size)
        u = rng.random(size)  # drawn also for the normal limit, so that streams stay aligned
        finite = np.isfinite(a)
        b = np.where(finite, a, 1.0)
        return z * np.where(finite, u ** (0.5 / (b + 1.0)) * np.sqrt((b + 2.0) / (b + 1.0)), 1.0)

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[Any, Any, Any, Any]:
        a = np.asarray(shapes[0], dtype=float)
        return 0.0, 1.0, 0.0, 3.0 / ((a + 1.0) * (a + 3.0))

    @classmethod
    def _smoothness(cls, *shapes: Any) -> int:
        a = float(shapes[0])
        return 2 if a > 0.5 else 1 if a > 0.0 else 0

    @classmethod
    def _entropy(cls, *shapes: Any) -> float:
        a = float(shapes[0])
        return Normal._entropy() if a >= _NORMAL_FROM else _entropy(a)

    def mean_deviation(self) -> float:
        """Return the mean absolute deviation E|x - loc|."""
        ratio = 1.0 if np.isinf(self.a) else (self.a + 1.0) / (self.a + 1.5) * np.sqrt((self.a + 2.0) / (self.a + 1.0))
        return float(self.scale * np.sqrt(2.0 / np.pi) * ratio)


def _with_normal_limit(finite: Any, limit: Any, z: Any, a: Any) -> Any:
    """Apply `finite(z, a)`, and `limit(z)` where a is so large that the law is the normal in double precision."""
    z, a = np.asarray(z, dtype=float), np.asarray(a, dtype=float)
    at_limit = a >= _NORMAL_FROM
    if not at_limit.any():
        return finite(z, a)
    if at_limit.all():
        return limit(np.broadcast_to(z, np.broadcast_shapes(z.shape, a.shape)))
    return np.where(at_limit, limit(z), finite(z, np.where(at_limit, 1.0, a)))


def _argument(z: Floats, a: Floats) -> tuple[Floats, Floats, Floats]:
    """Return c = z^2 (a+1) / (2 (a+2)) in two doubles, and log c, which survives where z^2 underflows."""
    k, k_low = variance_ratio(a)
    c, low = half_square(z, k, k_low)
    with np.errstate(divide="ignore"):
        log_c = 2.0 * np.log(np.abs(z)) + np.log(k)
    c = np.where(np.isinf(z), np.inf, c)
    return c, low, log_c


def _factor(a: Floats) -> Floats:
    """(a+1) / (sigma sqrt(2 pi)) for unit standard deviation."""
    return np.asarray((a + 1.0) * np.sqrt((a + 1.0) / (a + 2.0)) / np.sqrt(2.0 * np.pi))


def _pdf(z: Floats, a: Floats) -> Floats:
    c, low, log_c = _argument(z, a)
    return _factor(a) * scaled_expint(a + 1.5, c, log_c) * np.exp(-c) * (1.0 - low)


def _logpdf(z: Floats, a: Floats) -> Floats:
    c, _, log_c = _argument(z, a)
    with np.errstate(divide="ignore"):
        return np.log(_factor(a)) + np.log(scaled_expint(a + 1.5, c, log_c)) - c


def _upper(z: Floats, a: Floats) -> Floats:
    """Tail area beyond z >= 0: sqrt(c)/(2 sqrt(pi)) [E_1/2(c) - E_(a+3/2)(c)]."""
    c, low, log_c = _argument(z, a)
    origin = z == 0.0
    with np.errstate(invalid="ignore"):
        area = np.exp(0.5 * log_c) / (2.0 * _ROOT_PI) * scaled_difference(a, c, np.where(origin, 0.0, log_c)) * np.exp(-c) * (1.0 - low)
    return np.where(origin, 0.5, np.where(np.isinf(z), 0.0, area))


def _sf(z: Floats, a: Floats) -> Floats:
    tail = _upper(np.abs(z), a)
    return np.where(z > 0.0, tail, 1.0 - tail)


def _central(z: Floats, a: Floats) -> Floats:
    """Area between 0 and z > 0, for c < 1: a sum of positive terms, so that small z keep their relative accuracy."""
    c, _, log_c = _argument(z, a)
    root = np.exp(0.5 * log_c)
    return 0.5 * special.erf(root) + root * scaled_expint(a + 1.5, c, log_c) * np.exp(-c) / (2.0 * _ROOT_PI)


def _score(z: Floats, a: Floats) -> Floats:
    c, _, log_c = _argument(z, a)
    return _score_of(z, a, scaled_expint(a + 1.5, c, log_c), scaled_expint(a + 0.5, c, log_c))


def _score_of(z: Floats, a: Floats, e: Floats, e_below: Floats) -> Floats:
    """Score from E_(a+3/2) and E_(a+1/2)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(z == 0.0, 0.0, -z * (a + 1.0) / (a + 2.0) * (e_below / e))


def _gradient(z: Floats, a: Floats) -> Floats:
    c, _, log_c = _argument(z, a)
    e = scaled_expint(a + 1.5, c, log_c)
    return _gradient_of(z, a, e, _score_of(z, a, e, scaled_expint(a + 0.5, c, log_c)), order_derivative(a + 1.5, c, log_c))


def _gradient_of(z: Floats, a: Floats, e: Floats, score: Floats, slope: Floats) -> Floats:
    """Derivative of log f by a at constant standard deviation."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        along = np.where(z == 0.0, -1.0 / (a + 0.5), slope / e)
    return (1.0 + 0.5 * (1.0 + z * score) / (a + 2.0)) / (a + 1.0) + along


def _log_and_score(z: Floats, a: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return log f, the score, and what they were made of: E_(a+3/2), c and log c."""
    c, _, log_c = _argument(z, a)
    e = scaled_expint(a + 1.5, c, log_c)
    score = _score_of(z, a, e, scaled_expint(a + 0.5, c, log_c))
    with np.errstate(divide="ignore"):
        log_f = np.log(_factor(a)) + np.log(e) - c
    return log_f, score, e, c, log_c


def _likelihood(z: Floats, a: Floats) -> tuple[Floats, Floats, tuple[Floats, ...]]:
    log_f, score, e, c, log_c = _log_and_score(z, a)
    return log_f, score, (_gradient_of(z, a, e, score, order_derivative(a + 1.5, c, log_c)),)


def _isf(q: Floats, a: Floats) -> Floats:
    q = np.asarray(q, dtype=float)
    q = np.broadcast_to(q, np.broadcast_shapes(q.shape, a.shape))
    shapes = a if a.ndim == 0 else np.broadcast_to(a, q.shape)
    out = np.full(q.shape, np.nan)
    out[q == 0.0], out[q == 1.0], out[q == 0.5] = np.inf, -np.inf, 0.0
    for part, solve in (((q > 0.0) & (q < 0.25), _outer), ((q >= 0.25) & (q < 0.5), _inner)):
        if part.any():
            out[part] = solve(q[part], _pick(shapes, part))
    for part, solve in (((q < 1.0) & (q > 0.75), _outer), ((q <= 0.75) & (q > 0.5), _inner)):
        if part.any():
            out[part] = -solve(1.0 - q[part], _pick(shapes, part))
    return out


def _pick(a: Floats, part: Any) -> Floats:
    """The shapes of a part of the values; a scalar stays one, so that its coefficients are computed once."""
    return a if a.ndim == 0 else a[part]


def _outer(p: Floats, a: Floats) -> Floats:
    """Solve sf(z) = p < 1/4 by Newton on log sf within a bracket: the widest component, sigma Z, bounds z from above."""
    low = np.zeros_like(p)
    high = -special.ndtri(p) * np.sqrt((a + 2.0) / (a + 1.0))
    z = np.minimum(-special.ndtri(p), high)
    last = np.full(p.shape, np.inf)
    active = np.arange(p.size)
    for _ in range(200):
        x, shape, target = z[active], _pick(a, active), p[active]
        area = _upper(x, shape)
        above = area > target
        low[active] = np.where(above, x, low[active])
        high[active] = np.where(above, high[active], x)
        new = x + area / _pdf(x, shape) * np.log1p((area - target) / target)
        inside = (new >= low[active]) & (new <= high[active])
        new = np.where(inside, new, 0.5 * (low[active] + high[active]))
        z[active] = new
        step = np.abs(new - x)
        # done at the rounding of x, or when steps no longer shrink because only rounding is left
        done = (step <= 4e-16 * x) | ((step < 1e-12 * x) & (step >= last[active]))
        last[active] = step
        active = active[~done]
        if not active.size:
            break
    return z


def _inner(p: Floats, a: Floats) -> Floats:
    """Solve central(z) = 1/2 - p <= 1/4 by Newton in log-log coordinates, where the area is concave: no overshoot past the first step."""
    u = np.log(-special.ndtri(p) * np.sqrt((a + 2.0) / (a + 1.0)))
    target = np.log(0.5 - p)
    last = np.full(p.shape, np.inf)
    active = np.arange(p.size)
    for _ in range(200):
        x, shape = np.exp(u[active]), _pick(a, active)
        area = _central(x, shape)
        step = (np.log(area) - target[active]) * area / (x * _pdf(x, shape))
        u[active] -= step
        step = np.abs(step)
        done = (step <= 4e-16) | ((step < 1e-12) & (step >= last[active]))
        last[active] = step
        active = active[~done]
        if not active.size:
            break
    return np.exp(u)


def _entropy(a: float) -> float:
    """-Int f log f: tanh-sinh on (0, 1) in the power of z that makes the density regular, double-exponential beyond."""
    h = 1.0 / 16.0
    s = 0.5 * np.pi * np.sinh(np.arange(-56, 57) * h)
    w = 1.0 / (1.0 + np.exp(-2.0 * s))
    weight = np.pi * np.cosh(np.arange(-56, 57) * h) / (1.0 + np.exp(2.0 * s)) * h  # dw / w
    power = max(1.0, 0.5 / (a + 1.0))
    log_z = power * np.log(w)
    # far inside, log f is a straight line in log z; z itself would underflow
    straight = -200.0
    log_f = _logpdf(np.exp(np.maximum(log_z, straight)), np.asarray(a))
    log_f += np.where(log_z < straight, (2.0 * a + 1.0) * (log_z - straight), 0.0)
    inner = float(np.sum(weight * power * np.exp(log_z + log_f) * log_f))
    sigma = np.sqrt((a + 2.0) / (a + 1.0))
    t = np.arange(-47, 52) * 0.08
    v = np.exp(t - np.exp(-t))
    log_f = _logpdf(1.0 + sigma * v, np.asarray(a))
    outer = float(np.sum(0.08 * sigma * v * (1.0 + np.exp(-t)) * np.exp(log_f) * log_f))
    return -2.0 * (inner + outer)


modulated_normal = Law("modulated_normal", ModulatedNormal, "modulated normal (Romanowski), shape a > -1; scale = standard deviation")
equi = Law("equi", ModulatedNormal, "equi-normal: modulated normal with a = 0", (("a", 0.0),))
radico = Law("radico", ModulatedNormal, "radico-normal: modulated normal with a = 1/2", (("a", 0.5),))
lineo = Law("lineo", ModulatedNormal, "lineo-normal: modulated normal with a = 1", (("a", 1.0),))
quadri = Law("quadri", ModulatedNormal, "quadri-normal: modulated normal with a = 2", (("a", 2.0),))
