"""The generalised exponential integral of real order, E_s(c) = Int_1^inf t^-s exp(-ct) dt, and its kin that the modulated laws need.

Everything is scaled by exp(c), so that nothing underflows and the caller may supply exp(-c) with c in double-double. Below c = 1 the
power series is used with its pole at integer order removed analytically for every order (no special case near integers, hence no
jump); from 1 on, a continued fraction evaluated backwards, or a double-exponential quadrature of a positive integrand. All functions
broadcast; an order that is a scalar stays one, so that its coefficients are computed once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

Floats = NDArray[np.float64]

SERIES_BELOW = 1.0
_TERMS = 24  # 1/24! = 2e-24
_NEGLIGIBLE_ORDER = 64  # c**64 / 64! is below 1e-89 for c < 1: the term with the pole no longer counts
# zeta(k) - 1, k = 2..40: coefficients of log Gamma(2 - d)
_ZETA_MINUS_1: Floats = special.zetac(np.arange(2, 41))
_GAMMA_SERIES: Floats = np.concatenate([[np.euler_gamma - 1.0], _ZETA_MINUS_1 / np.arange(2, 41)])
_GAMMA_SLOPE: Floats = _ZETA_MINUS_1 * np.arange(1, 40) / np.arange(2, 41)
_INVERSE_FACTORIAL = tuple(1.0 / math.factorial(k) for k in range(_TERMS))
_PSI_5_2: Floats = special.polygamma(np.arange(0, 22), 2.5) / special.factorial(np.arange(1, 23))


def scaled_expint(order: Floats | float, c: Floats, log_c: Floats | None = None) -> Floats:
    """Return exp(c) E_order(c).

    Parameters
    ----------
    order : float or array
        Real order s > -1/2.
    c : array
        Argument, >= 0; broadcast against `order`.
    log_c : array, optional
        Logarithm of `c` for arguments so small that `c` underflows.

    Returns
    -------
    array
        Relative error about 2e-15; infinite at c = 0 for s <= 1, and 0 at c = inf.

    Notes
    -----
    Series and continued fraction: NIST DLMF 8.19.10, 8.19.11 and 8.19.17.

    Examples
    --------
    >>> from scipy.special import expn
    >>> float(scaled_expint(2.0, np.array(0.5)) / (np.exp(0.5) * expn(2, 0.5)))
    1.0000000000
    """
    return _branch(_series, _continued_fraction, order, c, log_c)


def order_derivative(order: Floats | float, c: Floats, log_c: Floats | None = None) -> Floats:
    """Return exp(c) times the derivative of E_s(c) with respect to the order s, a negative number.

    Parameters
    ----------
    order : float or array
        Real order s >= 1/2.
    c, log_c : array
        As in `scaled_expint`.

    Returns
    -------
    array
        -exp(c) Int_1^inf log(t) t^-s exp(-ct) dt, relative error about 1e-12.

    Examples
    --------
    >>> h = 1e-4
    >>> c = np.array(2.0)
    >>> numeric = (scaled_expint(1.5 + h, c) - scaled_expint(1.5 - h, c)) / (2 * h)
    >>> float(order_derivative(1.5, c) / numeric)
    1.000000
    """
    return _branch(_series_derivative, _quadrature_derivative, order, c, log_c)


def scaled_difference(a: Floats | float, c: Floats, log_c: Floats | None = None) -> Floats:
    """Return exp(c) [E_1/2(c) - E_(a+3/2)(c)], without cancellation.

    Parameters
    ----------
    a : float or array
        Shape of the modulated normal law, > -1.
    c, log_c : array
        As in `scaled_expint`.

    Returns
    -------
    array
        Positive; the upper tail area of the law is sqrt(c)/(2 sqrt(pi)) exp(-c) times this.

    Notes
    -----
    The difference of the two integrals is small against each of them when c is large or a near -1. There the one integral
    Int_0^inf [1 - (1+w)^-(a+1)] (1+w)^-1/2 exp(-cw) dw of a positive function, or the series of the difference, is used instead.
    """
    return _branch(_difference_below, _difference_above, a, c, log_c)


def _branch(below: Callable[..., Floats], above: Callable[..., Floats], order: Any, c: Any, log_c: Any) -> Floats:
    """Evaluate `below` where c < 1, `above` elsewhere, and bring the pieces together."""
    s = np.asarray(order, dtype=float)
    c = np.asarray(c, dtype=float)
    log_c = np.asarray(log_c, dtype=float) if log_c is not None else None
    shape = np.broadcast_shapes(s.shape, c.shape)
    if s.ndim and s.size == 1:
        s = s.reshape(())
    c = np.broadcast_to(c, shape)
    out = np.empty(shape)
    small = c < SERIES_BELOW
    for mask, function in ((small, below), (~small, above)):
        if not mask.any():
            continue
        part = c[mask]
        orders = s if s.ndim == 0 else np.broadcast_to(s, shape)[mask]
        if function is below:
            if log_c is None:
                with np.errstate(divide="ignore"):
                    logs = np.log(part)
            else:
                logs = np.broadcast_to(log_c, shape)[mask]
            out[mask] = below(orders, part, logs)
        else:
            out[mask] = above(orders, part)
    return out


# ---- below 1: power series ---------------------------------------------------------------------------------------------------------


def _pole_terms(s: Floats, *, slope: bool = False) -> tuple[Floats, Floats, Floats]:
    """Return m = nearest integer to the order, d = s - m, and h0 (or its slope) with phi(d) = d (log c + h0(d)) (see `_series`)."""
    m = np.minimum(np.maximum(np.rint(s), 1.0), float(_NEGLIGIBLE_ORDER))
    d = np.where(m < _NEGLIGIBLE_ORDER, s - m, 0.0)
    if slope:
        h = np.polynomial.polynomial.polyval(d, _GAMMA_SLOPE) - _log1p_ratio_derivative(-d)
        ratio, power = _log1p_ratio_derivative, 2
    else:
        h = np.polynomial.polynomial.polyval(d, _GAMMA_SERIES) + _log1p_ratio(-d)
        ratio, power = _log1p_ratio, 1
    top = int(np.max(m, initial=1.0))
    if s.ndim == 0:
        j = np.arange(1.0, top)
        return m, d, h - np.sum(ratio(d / j) / j**power)
    for i in range(1, top):
        h = h - np.where(i < m, ratio(d / i) / float(i**power), 0.0)
    return m, d, h


def _log1p_ratio(z: Floats) -> Floats:
    """Return log(1+z)/z, 1 at z = 0."""
    safe = np.where(z == 0.0, 1.0, z)
    return np.where(z == 0.0, 1.0, np.log1p(safe) / safe)


def _log1p_ratio_derivative(z: Floats) -> Floats:
    """Return the derivative of log(1+z)/z."""
    near = np.abs(z) < 0.1
    safe = np.where(near, 1.0, z)
    far = (safe / (1.0 + safe) - np.log1p(safe)) / safe**2
    k = np.arange(1, 17)
    coefficients = (-1.0) ** k * k / (k + 1)  # log(1+z)/z = sum (-z)^k / (k+1)
    series = np.polynomial.polynomial.polyval(np.where(near, z, 0.0), coefficients)
    return np.where(near, series, far)


def _exprel_derivative(z: Floats) -> Floats:
    """Return the derivative of (exp(z) - 1)/z."""
    near = np.abs(z) < 0.3
    safe = np.where(near, 1.0, z)
    far = ((safe - 1.0) * np.exp(safe) + 1.0) / safe**2
    k = np.arange(0, 14)
    series = np.polynomial.polynomial.polyval(np.where(near, z, 0.0), (k + 1.0) / special.factorial(k + 2))
    return np.where(near, series, far)


def _series(s: Floats, c: Floats, log_c: Floats) -> Floats:
    """exp(c) E_s(c) for c < 1.

    E_s = Gamma(1-s) c^(s-1) - sum_k (-c)^k / (k! (k+1-s)). The gamma function and the term k = m-1, m the integer nearest to s, have
    poles that cancel; together they are -(-c)^(m-1)/(m-1)! expm1(phi)/d, d = s - m,
    phi = d log c + log Gamma(1-d) - sum_(j<m) log(1 + d/j).
    """
    total = -_regular_sum(s, c, 1)
    if s.ndim == 0:
        total += _pole_part(s, c, log_c) if s >= 0.5 else _gamma_part(s, log_c)
    else:
        total += np.where(s >= 0.5, _pole_part(np.maximum(s, 0.5), c, log_c), _gamma_part(np.minimum(s, 0.5), log_c))
    origin = np.isneginf(log_c)
    if np.any(origin):
        with np.errstate(divide="ignore"):
            total = np.where(origin, np.where(s > 1.0, 1.0 / np.maximum(s - 1.0, 0.0), np.inf), total)
    return total * np.exp(c)


def _regular_sum(s: Floats, c: Floats, power: int) -> Floats:
    """sum_k (-c)^k / (k! (k+1-s)^power) without the term whose pole is treated apart, by Horner's rule."""
    m = np.where(s >= 0.5, np.maximum(np.rint(s), 1.0), 0.0)
    total = np.zeros_like(c)
    negative = -c
    for k in range(_TERMS - 1, -1, -1):
        skip = m == k + 1.0
        gap = np.where(skip, np.inf, k + 1.0 - s)
        total *= negative
        total += _INVERSE_FACTORIAL[k] / (gap if power == 1 else gap * gap)
    return total


def _gamma_part(s: Floats, log_c: Floats) -> Floats:
    return special.gamma(1.0 - s) * np.exp((s - 1.0) * log_c)


def _pole_part(s: Floats, c: Floats, log_c: Floats) -> Floats:
    m, d, h0 = _pole_terms(s)
    h = np.where(np.isneginf(log_c), 0.0, log_c) + h0
    factor = np.where(m < _NEGLIGIBLE_ORDER, (-c) ** (m - 1.0) / special.gamma(m), 0.0)
    return -factor * h * special.exprel(d * h)


def _series_derivative(s: Floats, c: Floats, log_c: Floats) -> Floats:
    """exp(c) dE_s(c)/ds for c < 1, s >= 1/2: the series differentiated term by term."""
    total = -_regular_sum(s, c, 2)
    m, d, h0 = _pole_terms(s)
    h1 = _pole_terms(s, slope=True)[2]
    origin = np.isneginf(log_c)
    h = np.where(origin, 0.0, log_c) + h0
    z = d * h
    change = h1 * special.exprel(z) + h * _exprel_derivative(z) * (h + d * h1)
    factor = np.where(m < _NEGLIGIBLE_ORDER, (-c) ** (m - 1.0) / special.gamma(m), 0.0)
    total -= factor * change
    if np.any(origin):
        with np.errstate(divide="ignore"):
            total = np.where(origin, np.where(s > 1.0, -1.0 / np.maximum(s - 1.0, 0.0) ** 2, -np.inf), total)
    return total * np.exp(c)


def _difference_below(a: Floats, c: Floats, log_c: Floats) -> Floats:
    """exp(c) [E_1/2 - E_(a+3/2)] for c < 1: plain subtraction unless a is near -1."""
    near = a < -0.75
    if np.all(near):
        return _difference_series(a, c, log_c)
    plain = np.sqrt(np.pi) * np.exp(-0.5 * log_c) * special.erfcx(np.exp(0.5 * log_c)) - _series(np.maximum(a, -0.75) + 1.5, c, log_c)
    if not np.any(near):
        return np.asarray(plain)
    return np.where(near, _difference_series(np.minimum(a, -0.75), c, log_c), plain)


def _difference_series(a: Floats, c: Floats, log_c: Floats) -> Floats:
    """The two series subtracted term by term, for e = a + 1 <= 1/4: every term carries the factor e."""
    e = a + 1.0
    total = np.zeros_like(c)
    p = np.ones_like(c)
    for k in range(_TERMS):
        total += p / ((k + 0.5) * (k + 0.5 - e))
        p = p * (-c / (k + 1.0))
    # log Gamma(1/2 - e) - log Gamma(1/2), by Taylor at 5/2 and the recurrence
    powers = (-e)[..., None] ** np.arange(1, len(_PSI_5_2) + 1)
    change = np.sum(_PSI_5_2 * powers, axis=-1) - np.log1p(-2.0 * e) - np.log1p(-2.0 * e / 3.0)
    return np.asarray((e * total - np.sqrt(np.pi) * np.exp(-0.5 * log_c) * np.expm1(e * log_c + change)) * np.exp(c))


# ---- from 1 on: continued fraction and quadrature -----------------------------------------------------------------------------------

_DEPTHS = ((2.0, 92), (4.0, 50), (8.0, 30), (16.0, 20), (32.0, 14), (64.0, 11), (np.inf, 9))
_FEW_DEPTHS = ((4.0, 92), (np.inf, 30))  # for short arrays, where the number of operations counts and not their length


def _continued_fraction(s: Floats, c: Floats) -> Floats:
    """exp(c) E_s(c), c >= 1, by the even part of the Stieltjes fraction, backwards from a depth that suffices in each octave of c."""
    out = np.full_like(c, np.nan)
    low = SERIES_BELOW
    for high, depth in _DEPTHS if c.size > 4000 else _FEW_DEPTHS:
        inside = (c >= low) & (c < high) if high < np.inf else c >= low
        low = high
        if not inside.any():
            continue
        x = c[inside]
        order = s if s.ndim == 0 else s[inside]
        step = float(s) if s.ndim == 0 else order
        b = x + (order + 2.0 * depth)
        tail = np.zeros_like(x)
        for k in range(depth, 0, -1):
            np.subtract(b, tail, out=tail)
            np.divide(k * (step + (k - 1.0)), tail, out=tail)
            b -= 2.0
        with np.errstate(invalid="ignore"):
            out[inside] = np.where(np.isinf(x), 0.0, 1.0 / (x + order - tail))
    return out


@cache
def _nodes(largest: float) -> tuple[tuple[float, float], ...]:
    """Nodes v <= `largest` and weights of Int_0^inf g(v) dv, v = exp(t - exp(-t)): the trapezoidal rule is exponentially accurate there."""
    step = 0.11
    t = np.arange(-30, 60) * step
    v = np.exp(t - np.exp(-t))
    weights = v * (1.0 + np.exp(-t)) * step
    keep = (v > 1e-12) & (v < largest)
    return tuple((float(x), float(w)) for x, w in zip(v[keep], weights[keep], strict=True))


def _quadrature_derivative(s: Floats, c: Floats) -> Floats:
    """exp(c) dE_s/ds for c >= 1, with the variable scaled by c + s, the rate at which the integrand falls."""
    rate = c + s
    total = np.zeros_like(c)
    share = c / rate
    for v, weight in _nodes(250.0):
        u = np.log1p(v / rate)
        total += weight * u * np.exp(-s * u - share * v)
    return -total / rate


def _difference_above(a: Floats, c: Floats) -> Floats:
    """exp(c) [E_1/2 - E_(a+3/2)] for c >= 1: subtraction where it loses at most a factor three, else the positive integral."""
    e = a + 1.0
    subtract = np.broadcast_to(e >= c, c.shape)
    out = np.empty_like(c)
    if subtract.any():
        x = c[subtract]
        order = (a if a.ndim == 0 else a[subtract]) + 1.5
        root = np.sqrt(x)
        out[subtract] = np.sqrt(np.pi) / root * special.erfcx(root) - _continued_fraction(order, x)
    rest = ~subtract
    if rest.any():
        x = c[rest]
        power = e if e.ndim == 0 else e[rest]
        total = np.zeros_like(x)
        for v, weight in _nodes(50.0):
            w = v / x
            total -= weight * math.exp(-v) * np.expm1(-power * np.log1p(w)) / np.sqrt(1.0 + w)
        out[rest] = total / x
    return out
