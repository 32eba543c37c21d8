"""Sets of additional parameters that a user declares as sums of monomials."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from baarda.cameras._terms import Monomials, PolynomialStep, Term, correction_model, polynomial_step
from baarda.cameras.base import CameraModel
from baarda.cameras.pinhole import INTERIOR
from baarda.errors import UsageError

__all__ = ["HIGHEST", "MOST", "NAME", "Term", "own_set", "terms_of"]

NAME = r"[A-Za-z][A-Za-z0-9_-]*"
HIGHEST, MOST = 12, 200  # degree in x or y; number of terms


def own_set(name: str, terms: Sequence[Term], description: str = "") -> CameraModel:
    """Return a camera model with the interior orientation and a set of polynomial terms of one's own, correct direction.

    Parameters
    ----------
    name : str
        Letters, digits, - and _; not that of another model.
    terms : sequence of Term
        One per parameter. Lengths are in units of the grid half-width b: ``(1.0, 2, 0)`` with ``(-0.5, 0, 0)`` stands for
        x^2 - b^2/2, and the parameter has the plane unit to the power 1 - degree.
    description : str

    Returns
    -------
    CameraModel

    Raises
    ------
    UsageError
        If a name is not plain or appears twice, or a term is empty, too high or not finite.

    Examples
    --------
    >>> bow = own_set("bow", [Term("q1", x=((1.0, 0, 2), (-0.5, 0, 0))), Term("q2", y=((1.0, 2, 0), (-0.5, 0, 0)))])
    >>> bow.order[-2:], bow.parameters[-1].power
    (('q1', 'q2'), -1)
    """
    from baarda.cameras import models

    if not re.fullmatch(NAME, name) or name.startswith("fixed-") or name in ("source", "none", "all"):
        raise UsageError(f"the name {name!r} of a set must be a letter followed by letters, digits, - and _, and no word of --camera")
    if name in models():
        raise UsageError(f"the name {name!r} of a set is that of a camera model of the package")
    if not 1 <= len(terms) <= MOST:
        raise UsageError(f"set {name}: {len(terms)} terms; a set has 1 to {MOST}")
    names = [t.name for t in terms]
    for term in terms:
        _check(name, term)
        if names.count(term.name) > 1 or term.name in INTERIOR:
            raise UsageError(f"set {name}: the parameter name {term.name!r} is taken")
    return correction_model(name, description or f"own set {name}, correct direction", polynomial_step(name, terms))


def _check(name: str, term: Term) -> None:
    if not re.fullmatch(NAME, term.name):
        raise UsageError(f"set {name}: the parameter name {term.name!r} must be a letter followed by letters, digits, - and _")
    monomials: Monomials = (*term.x, *term.y)
    if not monomials or not any(c for c, _, _ in monomials):
        raise UsageError(f"set {name}: the term {term.name} corrects nothing")
    for c, i, j in monomials:
        if not math.isfinite(c) or not 0 <= i <= HIGHEST or not 0 <= j <= HIGHEST:
            raise UsageError(f"set {name}, term {term.name}: coefficients are finite, exponents whole numbers from 0 to {HIGHEST}")


def terms_of(model: CameraModel) -> dict[str, tuple[Term, ...]]:
    """Return the terms of the own sets in a model, by name of the set.

    Examples
    --------
    >>> from baarda.cameras import model
    >>> terms_of(model("brown+ebner12"))
    {}
    """
    from baarda.cameras import models

    known = models()
    return {s.name: s.terms for s in model.steps if isinstance(s, PolynomialStep) and s.name not in known}
