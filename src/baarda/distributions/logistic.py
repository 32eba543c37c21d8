"""The logistic law."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special

from baarda.distributions.base import Distribution, Floats, Law


@dataclass(frozen=True)
class Logistic(Distribution):
    """The logistic law: near the normal in its middle, with exponential tails.

    Notes
    -----
    The standard deviation is pi/sqrt(3) times `scale`.

    Examples
    --------
    >>> Logistic().std()
    1.813799
    """

    family: ClassVar[str] = "logistic"

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        y = np.abs(z)
        return -y - 2.0 * np.log1p(np.exp(-y))

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        return special.expit(-np.asarray(z, dtype=float))

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        return -special.logit(np.asarray(q, dtype=float))

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        return -np.tanh(0.5 * z)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        return rng.logistic(size=size)

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[float, float, float, float]:
        return 0.0, float(np.pi**2 / 3.0), 0.0, 1.2

    @classmethod
    def _entropy(cls, *shapes: Any) -> float:
        return 2.0


logistic = Law("logistic", Logistic, "logistic; scale = standard deviation times sqrt(3)/pi")
