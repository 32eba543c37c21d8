"""Ebner's 12 additional parameters, orthogonal on the 3 x 3 grid at -b, 0, b.

With k = x^2 - 2b^2/3 and l = y^2 - 2b^2/3 (H. Ebner, Self calibrating block adjustment, Congress of the ISP, Helsinki 1976):
dx = E1 x + E2 y - E3 (2x^2 - 4b^2/3) + E4 x y + E5 l + E7 x l + E9 k y + E11 k l,
dy = -E1 y + E2 x + E3 x y - E4 (2y^2 - 4b^2/3) + E6 k + E8 k y + E10 x l + E12 k l.
The terms are orthogonal to each other and to the six that mimic the exterior orientation of a vertical image of flat ground:
(1; 0), (0; 1), (x; y), (y; -x), (x^2; x y), (x y; y^2).
"""

from __future__ import annotations

from baarda.cameras._terms import Term, correction_model, polynomial_step

_C = 2.0 / 3.0  # b = 1
_K = ((1.0, 2, 0), (-_C, 0, 0))
_L = ((1.0, 0, 2), (-_C, 0, 0))
_KL = ((1.0, 2, 2), (-_C, 2, 0), (-_C, 0, 2), (_C * _C, 0, 0))
_TERMS = (
    Term("E1", x=((1.0, 1, 0),), y=((-1.0, 0, 1),)),
    Term("E2", x=((1.0, 0, 1),), y=((1.0, 1, 0),)),
    Term("E3", x=((-2.0, 2, 0), (2.0 * _C, 0, 0)), y=((1.0, 1, 1),)),
    Term("E4", x=((1.0, 1, 1),), y=((-2.0, 0, 2), (2.0 * _C, 0, 0))),
    Term("E5", x=_L),
    Term("E6", y=_K),
    Term("E7", x=((1.0, 1, 2), (-_C, 1, 0))),
    Term("E8", y=((1.0, 2, 1), (-_C, 0, 1))),
    Term("E9", x=((1.0, 2, 1), (-_C, 0, 1))),
    Term("E10", y=((1.0, 1, 2), (-_C, 1, 0))),
    Term("E11", x=_KL),
    Term("E12", y=_KL),
)

ebner12 = correction_model(
    "ebner12", "Ebner's 12 parameters, orthogonal on a 3 x 3 grid, correct direction", polynomial_step("ebner12", _TERMS)
)
