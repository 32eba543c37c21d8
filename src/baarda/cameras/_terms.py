"""Corrections that are linear in their parameters: sums of terms, each a pair of polynomials in x and y."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np

from baarda.cameras.base import CameraModel, Floats, Parameter, Step, StepFunction, additive
from baarda.cameras.pinhole import INTERIOR, distance, flip, to_centre

#: coefficient and the exponents of x and y
Monomials = tuple[tuple[float, int, int], ...]
_PIXELS = 500.0  # grid half-width of the 1000 x 800 image for which examples are stated


@dataclass(frozen=True)
class Term:
    """What one parameter adds to x and y: sums of coefficient * x^i * y^j, with lengths in units of the grid half-width.

    Attributes
    ----------
    name : str
        Name of the parameter.
    x, y : tuple of (coefficient, i, j)
        The correction of x and of y per unit of the parameter; empty = none.
    """

    name: str
    x: Monomials = ()
    y: Monomials = ()

    @property
    def degree(self) -> int:
        """The highest total degree; the parameter has the unit of the plane to the power 1 - degree."""
        return max(i + j for _, i, j in (*self.x, *self.y))


@dataclass(frozen=True)
class PolynomialStep(Step):
    """A step of polynomial terms, which it remembers."""

    terms: tuple[Term, ...] = ()


def product(name: str, x: Sequence[float], y: Sequence[float], axis: str) -> Term:
    """Return the term p(x) q(y) of one axis from the coefficients of p and q, lowest power first."""
    monomials = tuple((float(a * b), i, j) for i, a in enumerate(x) for j, b in enumerate(y) if a * b)
    return Term(name, **{axis: monomials})


def polynomial_step(name: str, terms: Sequence[Term]) -> PolynomialStep:
    """Return the step that adds the terms, each times its parameter."""
    powers = sorted({(i, j) for t in terms for _, i, j in (*t.x, *t.y)})
    place = {p: m for m, p in enumerate(powers)}
    coefficients = np.zeros((2, len(powers), len(terms)))
    for k, term in enumerate(terms):
        for axis, monomials in enumerate((term.x, term.y)):
            for c, i, j in monomials:
                coefficients[axis, place[i, j], k] += c
    parameters = tuple(Parameter(t.name, 1 - t.degree) for t in terms)
    function = additive(_sums(np.array(powers), coefficients))
    return PolynomialStep(name, parameters, function, additional=True, on_grid=True, terms=tuple(terms))


def _sums(powers: Floats, coefficients: Floats) -> StepFunction:
    i, j = powers.T
    highest = int(powers.max())

    def function(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        n = len(xy)
        raised = np.ones((n, 2, highest + 1))
        for e in range(highest):
            raised[:, :, e + 1] = raised[:, :, e] * xy
        lowered = np.concatenate([np.zeros((n, 2, 1)), raised[:, :, :-1] * np.arange(1, highest + 1)], axis=2)  # d x^e / dx
        values = raised[:, 0, i] * raised[:, 1, j]
        slopes = np.stack([lowered[:, 0, i] * raised[:, 1, j], raised[:, 0, i] * lowered[:, 1, j]], axis=-1)
        weights = np.einsum("amk,nk->nam", coefficients, p)  # (n or 1, 2, monomials)
        increment = np.einsum("nm,nam->na", values, np.broadcast_to(weights, (n, *weights.shape[1:])))
        d_xy = np.einsum("nmb,nam->nab", slopes, np.broadcast_to(weights, (n, *weights.shape[1:])))
        d_p = np.stack([values @ coefficients[0], values @ coefficients[1]], axis=1)
        return increment, d_xy, d_p

    return function


def correction_model(name: str, description: str, step: Step, displacement: float = 0.6) -> CameraModel:
    """Return a model with the interior orientation and one step that corrects the measured, centred point.

    Parameters
    ----------
    name, description : str
    step : Step
    displacement : float
        Size of each parameter of the example as a displacement at the edge of the grid, pixels.
    """
    example = {"principal_distance": 900.0, "principal_point_x": 505.0, "principal_point_y": 396.0}
    for p, size in zip(step.parameters, cycle((1.0, -0.7, 0.4, -1.1, 0.8)), strict=False):
        example[p.name] = displacement * size * _PIXELS ** (p.power - 1)
    return CameraModel(
        name=name,
        description=description,
        order=(*INTERIOR, *(p.name for p in step.parameters)),
        measured=(to_centre, flip, step),
        ideal=(distance,),
        examples=(example,),
    )
