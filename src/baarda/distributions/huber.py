"""Huber's least favourable law: normal in the middle, exponential in the tails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special

from baarda.distributions.base import Distribution, Floats, Law, Shape

_ROOT_2PI = float(np.sqrt(2.0 * np.pi))


@dataclass(frozen=True)
class Huber(Distribution):
    """Huber's least favourable law: f ~ exp(-z^2/2) for |z| <= k, exp(-k|z| + k^2/2) beyond.

    Among all mixtures of a normal law with a given share of anything symmetric it carries the least information on the location; its
    score is bounded by k, so that the maximum-likelihood adjustment is Huber's.

    Attributes
    ----------
    k : float
        Where the tails begin, > 0; 1.345 is 95 % efficient for normal errors.

    Notes
    -----
    `scale` is the standard deviation of the normal middle, not that of the law. P. J. Huber, Ann. Math. Statist. 35 (1964) 73-101.

    Examples
    --------
    >>> Huber(1.345).score([0.5, -4.0])
    array([-0.5 ,  1.345])
    """

    k: float = 1.345

    family: ClassVar[str] = "huber"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("k", 0.0, np.inf, 1.345, search=(0.05, 8.0)),)

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        k = np.asarray(shapes[0], dtype=float)
        beyond = np.abs(z) - np.minimum(np.abs(z), k)
        return -0.5 * np.minimum(np.abs(z), k) ** 2 - k * beyond - np.log(_area(k))

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        k = np.asarray(shapes[0], dtype=float)
        z = np.asarray(z, dtype=float)
        inner = np.minimum(np.abs(z), k)
        middle = _ROOT_2PI * (special.ndtr(-inner) - special.ndtr(-k)) + np.exp(-0.5 * k * k) / k
        tail = np.where(np.abs(z) > k, np.exp(0.5 * k * k - k * np.maximum(np.abs(z), k)) / k, middle) / _area(k)
        return np.where(z > 0.0, tail, 1.0 - tail)

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        k = np.asarray(shapes[0], dtype=float)
        q = np.asarray(q, dtype=float)
        small = np.minimum(q, 1.0 - q)
        at_k = np.exp(-0.5 * k * k) / k
        with np.errstate(divide="ignore", invalid="ignore"):
            outer = 0.5 * k - np.log(small * k * _area(k)) / k
            inner = -special.ndtri((small * _area(k) - at_k) / _ROOT_2PI + special.ndtr(-k))
        z = np.where(small * _area(k) < at_k, outer, inner)
        return np.where(q < 0.5, z, -z)

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        k = np.asarray(shapes[0], dtype=float)
        return -np.clip(z, -k, k)

    @classmethod
    def _gradient(cls, z: Floats, *shapes: Any) -> tuple[Floats, ...]:
        k = np.asarray(shapes[0], dtype=float)
        return (2.0 * np.exp(-0.5 * k * k) / (k * k * _area(k)) - (np.abs(z) - np.minimum(np.abs(z), k)),)

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[Any, Any, Any, Any]:
        k = np.asarray(shapes[0], dtype=float)
        middle, at_k = _ROOT_2PI * special.erf(k / np.sqrt(2.0)), np.exp(-0.5 * k * k)
        second = (middle + 2.0 * at_k * (2.0 / k + 2.0 / k**3)) / _area(k)
        fourth = (3.0 * middle + 2.0 * at_k * (k + 12.0 / k + 24.0 / k**3 + 24.0 / k**5)) / _area(k)
        return 0.0, second, 0.0, fourth / second**2 - 3.0

    @classmethod
    def _smoothness(cls, *shapes: Any) -> int:
        return 1


def _area(k: Floats) -> Floats:
    """Integral of exp(-rho)."""
    return np.asarray(_ROOT_2PI * special.erf(k / np.sqrt(2.0)) + 2.0 * np.exp(-0.5 * k * k) / k)


huber = Law("huber", Huber, "Huber's least favourable law: normal middle, exponential tails beyond k")
