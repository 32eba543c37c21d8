"""Student's t law, and Cauchy's as the case of one degree of freedom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special

from baarda.distributions.base import Distribution, Floats, Law, Shape
from baarda.distributions.normal import Normal

_NORMAL_FROM = 1e10  # log f differs from the normal's by less than z^4 / (4 nu)


@dataclass(frozen=True)
class Student(Distribution):
    """Student's t law: heavy tails, f ~ |z|^-(nu+1); `nu` = inf is the normal.

    Attributes
    ----------
    nu : float
        Degrees of freedom > 0. The variance is infinite up to 2, the kurtosis up to 4.

    Notes
    -----
    `scale` is not the standard deviation, which is scale sqrt(nu/(nu-2)).

    Examples
    --------
    >>> Student(4.0).sf(2.132)
    0.0500
    """

    nu: float = 5.0

    family: ClassVar[str] = "student"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("nu", 0.0, np.inf, 5.0, upper_closed=True, search=(0.05, np.inf)),)

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        nu, at_limit = _finite(shapes[0])
        log_f = -0.5 * np.log(nu) - special.betaln(0.5, 0.5 * nu) - 0.5 * (nu + 1.0) * np.log1p(z * z / nu)
        return np.where(at_limit, Normal._logpdf(z), log_f)

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        nu, at_limit = _finite(shapes[0])
        return np.where(at_limit, Normal._sf(z), special.stdtr(nu, -np.asarray(z, dtype=float)))

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        nu, at_limit = _finite(shapes[0])
        return np.where(at_limit, -special.ndtri(q), -special.stdtrit(nu, q))

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        nu, at_limit = _finite(shapes[0])
        return np.where(at_limit, -z, -(nu + 1.0) * z / (nu + z * z))

    @classmethod
    def _gradient(cls, z: Floats, *shapes: Any) -> tuple[Floats, ...]:
        nu, at_limit = _finite(shapes[0])
        square = z * z
        x = 0.5 * nu
        # psi(x + 1/2) - psi(x) - 1/(2x): its asymptotic series where the difference would cancel
        far = (0.125 - (1.0 / 64.0 - 1.0 / (128.0 * x * x)) / (x * x)) / (x * x)
        constant = np.where(x > 50.0, far, special.psi(x + 0.5) - special.psi(x) - 0.5 / x)
        slope = 0.5 * (constant - np.log1p(square / nu) + (nu + 1.0) * square / (nu * (nu + square)))
        return (np.where(at_limit, 0.0, slope),)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        nu, at_limit = _finite(shapes[0])
        return rng.standard_normal(size) / np.where(at_limit, 1.0, np.sqrt(rng.chisquare(nu, size) / nu))

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[Any, Any, Any, Any]:
        nu = np.asarray(shapes[0], dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = np.where(nu > 2.0, np.where(np.isinf(nu), 1.0, 1.0 / (1.0 - 2.0 / nu)), np.where(nu > 1.0, np.inf, np.nan))
            excess = np.where(nu > 4.0, 6.0 / (nu - 4.0), np.where(nu > 2.0, np.inf, np.nan))
        return np.where(nu > 1.0, 0.0, np.nan), variance, np.where(nu > 3.0, 0.0, np.nan), excess

    @classmethod
    def _entropy(cls, *shapes: Any) -> float:
        nu = float(shapes[0])
        if nu >= _NORMAL_FROM:
            return Normal._entropy()
        half = 0.5 * (nu + 1.0)
        return float(half * (special.psi(half) - special.psi(0.5 * nu)) + 0.5 * np.log(nu) + special.betaln(0.5, 0.5 * nu))


def _finite(nu: Any) -> tuple[Floats, Any]:
    """Return nu with a harmless value where it is so large that the law is the normal, and where that is."""
    nu = np.asarray(nu, dtype=float)
    at_limit = nu >= _NORMAL_FROM
    return np.where(at_limit, 1.0, nu), at_limit


student = Law("student", Student, "Student t, nu degrees of freedom")
cauchy = Law("cauchy", Student, "Cauchy: Student t with one degree of freedom", (("nu", 1.0),))
