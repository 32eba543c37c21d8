"""The values that a law is fitted to, checked, and condensed when they are many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from baarda.distributions.base import Distribution, Floats, Law
from baarda.distributions.condensed import PER_OCTAVE, Condensed, condense
from baarda.errors import UsageError

CONDENSE_FROM = 20_000
_COARSE = 8


def check_values(values: ArrayLike) -> Floats:
    """Return values as a flat array, or raise `UsageError` naming the first that is not finite."""
    x = np.asarray(values, dtype=float).ravel()
    if x.size == 0:
        raise UsageError("no values given")
    if not np.isfinite(np.sum(x)):  # one pass without a mask; a sum may also overflow, so look again
        bad = np.flatnonzero(~np.isfinite(x))
        if bad.size:
            raise UsageError(f"{bad.size} of {x.size} values are not finite; the first is number {bad[0] + 1} ({x[bad[0]]})")
    return x


def given_values(member: Law, loc: float | None, scale: float | None, shapes: Mapping[str, float] | None) -> dict[str, float]:
    """Return the parameters that are not estimated, by name; raise `UsageError` for unknown names."""
    given = {k: float(v) for k, v in (shapes or {}).items()}
    if loc is not None:
        given["loc"] = float(loc)
    if scale is not None:
        given["scale"] = float(scale)
    member(**given)  # checks names and bounds
    return given


@dataclass(frozen=True)
class Sample:
    """Points (differences from `centre`) with weights that stand for n values."""

    points: Floats
    weights: Floats | None
    centre: float
    n: int
    has_centre: bool
    source: Condensed | None = None

    @classmethod
    def of(cls, values: Floats, centre: float) -> Sample:
        """Take values as they are, or condensed when they are many."""
        if values.size >= CONDENSE_FROM:
            return cls.of_condensed(condense(values, centre))
        points = values - centre
        return cls(points, None, centre, values.size, bool(np.any(points == 0.0)))

    @classmethod
    def of_condensed(cls, condensed: Condensed) -> Sample:
        """Take condensed values."""
        points, weights = condensed.points()
        return cls(points, weights, condensed.centre, condensed.n, bool(np.any(points == 0.0)), condensed)

    def reduced(self, *, folded: bool, coarse: bool) -> Sample:
        """Return the same values on fewer points: both sides together, and perhaps 8 bins an octave; itself where they are few."""
        if self.source is None or not (folded or coarse):
            return self
        points, weights = self.source.points(folded=folded, per_octave=_COARSE if coarse else PER_OCTAVE)
        return replace(self, points=points, weights=weights)

    def sum(self, terms: Floats) -> float:
        """Weighted sum of a term per point."""
        return float(np.sum(terms) if self.weights is None else np.dot(self.weights, terms))

    def log_likelihood(self, distribution: Distribution) -> float:
        """Log-likelihood of the values under a law."""
        z = (self.points - (distribution.loc - self.centre)) / distribution.scale
        return self.sum(distribution._logpdf(z, *distribution.shape_values)) - self.n * float(np.log(distribution.scale))

    def moments(self, loc: float | None) -> tuple[float, float, float]:
        """Mean, standard deviation about it (or about the given loc), and kurtosis."""
        mean = self.sum(self.points) / self.n if loc is None else loc - self.centre
        d2 = (self.points - mean) ** 2
        variance = self.sum(d2) / self.n
        return self.centre + mean, float(np.sqrt(variance)), self.sum(d2 * d2) / self.n / variance**2
