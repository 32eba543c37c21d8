"""Laplace's first law of errors, the two-sided exponential."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from baarda.distributions.base import Distribution, Floats, Law


@dataclass(frozen=True)
class Laplace(Distribution):
    """Laplace's law: f = exp(-|x - loc| / scale) / (2 scale); its maximum-likelihood adjustment is that by least absolute deviations.

    Notes
    -----
    `scale` is the mean absolute deviation; the standard deviation is sqrt(2) times larger.

    Examples
    --------
    >>> Laplace(scale=3.0).std() / 3.0
    1.414214
    """

    family: ClassVar[str] = "laplace"

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        return -np.abs(z) - np.log(2.0)

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        z = np.asarray(z, dtype=float)
        tail = 0.5 * np.exp(-np.abs(z))
        return np.where(z > 0.0, tail, 1.0 - tail)

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        q = np.asarray(q, dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            # log1p keeps the digits near the median, where 2q is near 1
            upper = -np.where(q < 0.25, np.log(2.0 * q), np.log1p(2.0 * (q - 0.5)))
            p = 1.0 - q
            lower = np.where(p < 0.25, np.log(2.0 * p), np.log1p(2.0 * (p - 0.5)))
        return np.where(q < 0.5, upper, lower)

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        return -np.sign(z)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        return rng.laplace(size=size)

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[float, float, float, float]:
        return 0.0, 2.0, 0.0, 3.0

    @classmethod
    def _smoothness(cls, *shapes: Any) -> int:
        return 0

    @classmethod
    def _closed_form(cls, points: Floats, weights: Floats, loc: float | None) -> tuple[float, float]:
        if loc is None:
            order = np.argsort(points)
            total = np.cumsum(weights[order])
            half = 0.5 * total[-1]
            i = int(np.searchsorted(total, half * (1.0 - 1e-15)))
            # exactly half of the weight at or below: any value up to the next point is a median; take the middle
            even = abs(total[i] - half) <= 1e-12 * half and i + 1 < points.size
            loc = float(0.5 * (points[order[i]] + points[order[i + 1]]) if even else points[order[i]])
        return loc, float(np.dot(weights, np.abs(points - loc)) / np.sum(weights))

    @classmethod
    def _closed_columns(cls, x: Floats, loc: float | None) -> tuple[Floats, Floats]:
        centre = np.median(x, axis=0) if loc is None else np.full(x.shape[1], loc)
        return centre, np.mean(np.abs(x - centre), axis=0)

    @classmethod
    def _entropy(cls, *shapes: Any) -> float:
        return 1.0 + float(np.log(2.0))


laplace = Law("laplace", Laplace, "Laplace (two-sided exponential); scale = mean absolute deviation")
