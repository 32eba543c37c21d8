"""The contaminated normal law: a share of the observations has a larger standard deviation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from baarda.distributions.base import Distribution, Floats, Law, Shape
from baarda.distributions.normal import Normal


@dataclass(frozen=True)
class ContaminatedNormal(Distribution):
    """The contaminated normal law (Tukey): (1 - share) N(0, scale^2) + share N(0, (ratio scale)^2).

    Attributes
    ----------
    share : float
        Share of the wide component, between 0 and 1/2.
    ratio : float
        Its standard deviation in units of the narrow one's, > 1.

    Notes
    -----
    `scale` is the standard deviation of the narrow component. Under the normal law share and ratio are not both determined.

    Examples
    --------
    >>> ContaminatedNormal(0.1, 3.0).var()
    1.8
    """

    share: float = 0.1
    ratio: float = 3.0

    family: ClassVar[str] = "contaminated_normal"
    shapes: ClassVar[tuple[Shape, ...]] = (
        Shape("share", 0.0, 0.5, 0.1, search=(1e-4, 0.4999)),
        Shape("ratio", 1.0, np.inf, 3.0, search=(1.05, 100.0)),
    )

    @classmethod
    def _parts(cls, z: Floats, share: Any, ratio: Any) -> tuple[Floats, Floats]:
        return np.log1p(-share) + Normal._logpdf(z), np.log(share / ratio) + Normal._logpdf(z / ratio)

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        with np.errstate(invalid="ignore"):  # infinite or missing z
            return np.logaddexp(*cls._parts(z, *shapes))

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        share, ratio = shapes
        return (1.0 - share) * Normal._sf(z) + share * Normal._sf(z / ratio)

    @classmethod
    def _wide(cls, z: Floats, *shapes: Any) -> Any:
        """Probability that a value belongs to the wide component."""
        narrow, wide = cls._parts(z, *shapes)
        with np.errstate(invalid="ignore"):
            return np.exp(wide - np.logaddexp(narrow, wide))

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        w = cls._wide(z, *shapes)
        return -z * (1.0 - w + w / shapes[1] ** 2)

    @classmethod
    def _gradient(cls, z: Floats, *shapes: Any) -> tuple[Floats, ...]:
        share, ratio = shapes
        w = cls._wide(z, *shapes)
        return w / share - (1.0 - w) / (1.0 - share), w * (z * z / ratio**3 - 1.0 / ratio)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        share, ratio = shapes
        z = rng.standard_normal(size)
        return z * np.where(rng.random(size) < share, ratio, 1.0)

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[Any, Any, Any, Any]:
        share, ratio = (np.asarray(s, dtype=float) for s in shapes)
        variance = 1.0 - share + share * ratio**2
        return 0.0, variance, 0.0, 3.0 * (1.0 - share + share * ratio**4) / variance**2 - 3.0


contaminated_normal = Law("contaminated_normal", ContaminatedNormal, "contaminated normal: a share with a ratio times larger scale")
