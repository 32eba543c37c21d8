"""Moment estimates: mean, standard deviation and, for one free shape, the kurtosis."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import optimize

from baarda.distributions.base import Law, Shape
from baarda.distributions.sample import Sample
from baarda.errors import UsageError


def moment_estimates(member: Law, sample: Sample, given: Mapping[str, float]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Mean, standard deviation and, for one free shape, the kurtosis."""
    mean, sd, kurtosis = sample.moments(given.get("loc"))
    found: dict[str, float] = dict(member.fixed) | {"loc": mean} | dict(given)
    bounds: tuple[str, ...] = ()
    unknown = [s for s in member.free_shapes if s.name not in given]
    if len(unknown) > 1:
        raise UsageError(f"law {member.name}: moments determine one shape, not {len(unknown)}")
    if unknown:
        shape = unknown[0]
        value, at_bound = shape_from_kurtosis(member, shape, kurtosis - 3.0)
        found[shape.name] = value
        bounds = (shape.name,) if at_bound else ()
    if "scale" not in given:
        unit = member.with_values(found | {"scale": 1.0}).std()
        if not np.isfinite(unit):
            raise UsageError(f"law {member.name} has no variance at these values: moments do not determine its scale")
        found["scale"] = sd / unit
    return found, bounds


def shape_from_kurtosis(member: Law, shape: Shape, excess: float) -> tuple[float, bool]:
    """Invert the excess kurtosis for the shape; (bound, True) where no value gives it."""

    def difference(t: float) -> float:
        value = float(member.distribution._moments(shape.from_unit(t))[3])
        # arctan: the excess is infinite for heavy tails
        return float(np.arctan(value) - np.arctan(excess)) if np.isfinite(value) else float(np.pi / 2.0 - np.arctan(excess))

    grid = np.linspace(1e-9, 1.0 - 1e-9, 401)
    with np.errstate(all="ignore"):
        at = np.array([difference(t) for t in grid])
    change = np.flatnonzero(np.sign(at[1:]) != np.sign(at[:-1]))
    if not change.size:
        best = float(grid[int(np.argmin(np.abs(at)))])
        return (shape.upper if shape.upper_closed and best < 0.5 else float(shape.from_unit(best))), True
    j = int(change[0])
    return float(shape.from_unit(optimize.brentq(difference, grid[j], grid[j + 1], xtol=1e-15))), False
