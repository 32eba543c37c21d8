"""The log-likelihood of millions of values and its gradient, from tables of the law that are built in milliseconds."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from baarda.distributions.base import Distribution, Floats
from baarda.distributions.kernels import COEFFICIENTS, HIGHEST, INTERVALS, INTERVALS_PER_OCTAVE, LOWEST, kernels
from baarda.distributions.workers import run_pieces

TABULATE_FROM = 20_000  # for fewer values a table costs more than it saves
_PIECE = 1 << 16  # fixed, so that partial sums do not depend on the number of threads
_TOLERANCE = 1e-14
_GRADIENT_TOLERANCE = 1e-12


def log_likelihood(values: ArrayLike, distribution: Distribution, *, workers: int | None = None) -> float:
    """Return the sum of the log-densities of many values.

    Parameters
    ----------
    values : (n,) array
        Values, in the unit of the distribution's scale.
    distribution : Distribution
        The law with its parameters.
    workers : int, optional
        Number of threads; by default one per core. It does not change a bit of the result.

    Returns
    -------
    float
        Relative error about 1e-14 of the sum of the magnitudes; NaN if a value is NaN.

    Raises
    ------
    UsageError
        If `workers` is not positive.

    Notes
    -----
    From 20 000 values on, log f is read from a table: in each 1/64 octave of |x - loc| / scale a polynomial of degree 5 through values of
    the exact function. What lies outside the table, and laws that it cannot hold (not symmetric, or not smooth enough), are evaluated
    exactly.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> x = np.random.default_rng(1).standard_normal(30_000)
    >>> radico = law("radico")()
    >>> float(log_likelihood(x, radico) / np.sum(radico.logpdf(x)))
    1.0000000000000
    """
    x = np.asarray(values).ravel()
    cls: Any = type(distribution)
    shapes = distribution.shape_values
    table = _table(cls, shapes, gradient=False) if x.size >= TABULATE_FROM else None
    loops = kernels(x.size)
    loc, inverse = float(distribution.loc), 1.0 / float(distribution.scale)

    def piece(start: int, stop: int) -> tuple[float, float]:
        part = _floats(x[start:stop])
        if table is None:
            return float(np.sum(distribution._logpdf((part - loc) * inverse, *shapes))), 0.0
        total, outside = loops.log_sum(part, loc, inverse, table[0])
        if not outside:
            return total, 0.0
        return total, float(np.sum(distribution._logpdf(_outside((part - loc) * inverse), *shapes)))

    parts = run_pieces(x.size, _PIECE, piece, workers)
    return _add(p for pair in parts for p in pair) - x.size * math.log(distribution.scale)


def log_likelihood_gradient(values: ArrayLike, distribution: Distribution, *, workers: int | None = None) -> tuple[float, dict[str, float]]:
    """Return the sum of the log-densities of many values and its derivatives with respect to the parameters of the law.

    Parameters
    ----------
    values, distribution, workers
        As in `log_likelihood`.

    Returns
    -------
    float, dict
        The sum, and its derivative by the name of each shape, `loc` and `scale`. A location at which a value lies exactly counts no slope
        for that value.

    Raises
    ------
    UsageError
        If `workers` is not positive.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> log_likelihood_gradient([1.0, -3.0], law("normal")(scale=2.0))[1]
    {'loc': -0.500, 'scale': 0.250}
    """
    x = np.asarray(values).ravel()
    cls: Any = type(distribution)
    shapes = distribution.shape_values
    tables = _table(cls, shapes, gradient=True) if x.size >= TABULATE_FROM else None
    loops = kernels(x.size)
    loc, scale = float(distribution.loc), float(distribution.scale)
    inverse = 1.0 / scale

    def piece(start: int, stop: int) -> Floats:
        part = _floats(x[start:stop])
        if tables is None:
            return _exact_sums(cls, (part - loc) * inverse, shapes)[None]
        out = np.zeros(3 + len(shapes))
        if not loops.gradient_sums(part, loc, inverse, tables, out):
            return out[None]
        return np.stack([out, _exact_sums(cls, _outside((part - loc) * inverse), shapes)])

    rows = np.concatenate(run_pieces(x.size, _PIECE, piece, workers) or [np.zeros((1, 3 + len(shapes)))])
    total, score, along, *slopes = (_add(column) for column in rows.T)
    gradient = {shape.name: slope for shape, slope in zip(distribution.shapes, slopes, strict=True)}
    return total - x.size * math.log(scale), gradient | {"loc": -score / scale, "scale": -(x.size + along) / scale}


def _floats(part: np.ndarray) -> Floats:
    return np.require(part, np.float64, ["C", "A"])


def _add(parts: object) -> float:
    """Exactly rounded sum; infinities and NaN as in ordinary addition."""
    numbers = [float(p) for p in parts]  # type: ignore[attr-defined]
    return math.fsum(numbers) if all(map(math.isfinite, numbers)) else sum(numbers)


def _outside(z: Floats) -> Floats:
    size = np.abs(z)
    return z[~((size >= 2.0**LOWEST) & (size < 2.0**HIGHEST))]


def _exact_sums(cls: type[Distribution], z: Floats, shapes: tuple[float, ...]) -> Floats:
    """Sums of log f, of the score, of z times the score and of the derivatives by the shapes."""
    log_f, score, slopes = cls._likelihood(z, *shapes)
    return np.array([np.sum(log_f), np.sum(score), np.sum(z * score), *(np.sum(s) for s in slopes)])


@lru_cache(maxsize=8)
def _table(cls: Any, shapes: tuple[float, ...], *, gradient: bool) -> Floats | None:
    """Return (functions, intervals + 1, coefficients) of log f, the score and the slopes, or None where a polynomial is too rough."""
    if not cls.symmetric:
        return None
    # Chebyshev points of each interval; v in (-1/2, 1/2) is the place in it
    v = 0.5 * np.cos(np.pi * (np.arange(COEFFICIENTS) + 0.5) / COEFFICIENTS)
    k = np.arange(INTERVALS)[:, None]
    z = np.ldexp(1.0 + (k % INTERVALS_PER_OCTAVE + 0.5 + v) / INTERVALS_PER_OCTAVE, k // INTERVALS_PER_OCTAVE + LOWEST)
    if gradient:
        log_f, score, slopes = cls._likelihood(z.ravel(), *shapes)
        functions = [log_f, score, *slopes]
    else:
        functions = [cls._logpdf(z.ravel(), *shapes)]
    solve = np.linalg.inv(np.vander(v, increasing=True)).T
    tables = np.zeros((len(functions), INTERVALS + 1, COEFFICIENTS))
    for i, function in enumerate(functions):
        f = np.broadcast_to(function, z.size).reshape(z.shape)
        near = f[:, COEFFICIENTS // 2]
        c = (f - near[:, None]) @ solve  # differences, so that rounding stays small
        # size of the first term left out, a Chebyshev polynomial, by the fall of the last two
        before, last = np.abs(c[:, -2:].T) * 0.5 ** (2 * np.arange(COEFFICIENTS - 2, COEFFICIENTS) - 1)[:, None]
        left_out = last * np.minimum(1.0, last / np.maximum(before, 1e-300))
        if not np.all(left_out <= (_TOLERANCE if i == 0 else _GRADIENT_TOLERANCE) * np.maximum(1.0, np.abs(near))):
            return None
        c[:, 0] += near
        tables[i, :-1] = c
    tables.setflags(write=False)
    return tables
