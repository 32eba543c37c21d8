"""The generalised normal law (exponential power): Laplace at p = 1, normal at p = 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special

from baarda.distributions.base import Distribution, Floats, Law, Shape


@dataclass(frozen=True)
class GeneralisedNormal(Distribution):
    """The generalised normal law: f proportional to exp(-|z|^p).

    Attributes
    ----------
    p : float
        Power > 0: 1 is Laplace, 2 the normal (with standard deviation scale/sqrt(2)), infinity the uniform law.

    Examples
    --------
    >>> GeneralisedNormal(2.0, scale=2.0**0.5).sf(1.959964)
    0.025000
    """

    p: float = 2.0

    family: ClassVar[str] = "generalised_normal"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("p", 0.0, np.inf, 2.0, search=(0.2, 60.0)),)

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        p = np.asarray(shapes[0], dtype=float)
        with np.errstate(over="ignore"):
            return np.log(0.5) - special.gammaln(1.0 + 1.0 / p) - np.abs(z) ** p

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        p = np.asarray(shapes[0], dtype=float)
        z = np.asarray(z, dtype=float)
        with np.errstate(over="ignore"):
            power = np.abs(z) ** p
        tail = 0.5 * special.gammaincc(1.0 / p, power)
        return np.where(z > 0.0, tail, 1.0 - tail)

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        p = np.asarray(shapes[0], dtype=float)
        q = np.asarray(q, dtype=float)
        tail = np.minimum(q, 1.0 - q)
        # near the median the area next to the centre, 1 - 2q, is the small number
        z = np.where(tail < 0.25, special.gammainccinv(1.0 / p, 2.0 * tail), special.gammaincinv(1.0 / p, np.abs(1.0 - 2.0 * q))) ** (
            1.0 / p
        )
        return np.where(q < 0.5, z, -z)

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        p = np.asarray(shapes[0], dtype=float)
        z = np.asarray(z, dtype=float)
        size = np.where(z == 0.0, 1.0, np.abs(z))  # for p < 1 the power is infinite at the centre, where the score is set to 0
        with np.errstate(over="ignore"):
            return -p * np.sign(z) * size ** (p - 1.0)

    @classmethod
    def _gradient(cls, z: Floats, *shapes: Any) -> tuple[Floats, ...]:
        p = np.asarray(shapes[0], dtype=float)
        with np.errstate(over="ignore"):
            return (special.psi(1.0 + 1.0 / p) / p**2 - special.xlogy(np.abs(z) ** p, np.abs(z)),)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        p = np.asarray(shapes[0], dtype=float)
        z = rng.standard_gamma(1.0 / p, size) ** (1.0 / p)
        return np.where(rng.random(size) < 0.5, -z, z)

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[Any, Any, Any, Any]:
        p = np.asarray(shapes[0], dtype=float)
        g1, g3, g5 = (special.gammaln(k / p) for k in (1.0, 3.0, 5.0))
        return 0.0, np.exp(g3 - g1), 0.0, np.exp(g5 + g1 - 2.0 * g3) - 3.0

    @classmethod
    def _smoothness(cls, *shapes: Any) -> int:
        p = float(shapes[0])
        return 2 if p >= 2.0 else 1 if p > 1.0 else 0

    @classmethod
    def _entropy(cls, *shapes: Any) -> float:
        p = float(shapes[0])
        return float(1.0 / p + np.log(2.0) + special.gammaln(1.0 + 1.0 / p))


generalised_normal = Law("generalised_normal", GeneralisedNormal, "generalised normal, exp(-|z|^p): 1 Laplace, 2 normal")
