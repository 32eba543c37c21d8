"""The normal law."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special

from baarda.distributions._double_double import half_square
from baarda.distributions.base import Distribution, Floats, Law

_LOG_ROOT_2PI = 0.5 * float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Normal(Distribution):
    """The normal law; `scale` is the standard deviation.

    Examples
    --------
    >>> Normal(loc=1.0, scale=2.0).sf(1.0 + 2.0 * 1.959963984540054)
    0.025000
    """

    family: ClassVar[str] = "normal"
    scale_is_sd: ClassVar[bool] = True

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        return -0.5 * z * z - _LOG_ROOT_2PI

    @classmethod
    def _pdf(cls, z: Floats, *shapes: Any) -> Any:
        c, rest = half_square(z, 0.5, 0.0)
        return np.exp(-c) * (1.0 - rest) / np.sqrt(2.0 * np.pi)

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        z = np.asarray(z, dtype=float)
        c, rest = half_square(z, 0.5, 0.0)
        tail = 0.5 * special.erfcx(np.abs(z) / np.sqrt(2.0)) * np.exp(-c) * (1.0 - rest)
        return np.where(z > 0.0, tail, 1.0 - tail)

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        return -special.ndtri(q)

    @classmethod
    def _ppf(cls, q: Floats, *shapes: Any) -> Any:
        return special.ndtri(q)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        return rng.standard_normal(size)

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        return -z

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[float, float, float, float]:
        return 0.0, 1.0, 0.0, 0.0

    @classmethod
    def _closed_form(cls, points: Floats, weights: Floats, loc: float | None) -> tuple[float, float]:
        total = np.sum(weights)
        if loc is None:
            loc = float(np.dot(weights, points) / total)
        return loc, float(np.sqrt(np.dot(weights, (points - loc) ** 2) / total))

    @classmethod
    def _closed_columns(cls, x: Floats, loc: float | None) -> tuple[Floats, Floats]:
        centre = np.mean(x, axis=0) if loc is None else np.full(x.shape[1], loc)
        return centre, np.sqrt(np.mean((x - centre) ** 2, axis=0))

    @classmethod
    def _entropy(cls, *shapes: Any) -> float:
        return 0.5 + _LOG_ROOT_2PI


normal = Law("normal", Normal, "normal (Gauss); scale = standard deviation")
