"""Grün's 44 additional parameters, orthogonal on the 5 x 5 grid at -b, -b/2, 0, b/2, b, and his simple set of 12.

The discrete orthogonal polynomials of the grid are p0 = 1, p1 = x, p2 = x^2 - b^2/2, p3 = x (x^2 - 17b^2/20) and
p4 = x^2 (x^2 - 31b^2/28) + 9b^4/70. The 50 products p_i(x) p_j(y) in dx and in dy span all corrections of the 25 grid points; without the
six that mimic the exterior orientation of a vertical image of flat ground, (1; 0), (0; 1), (x; y), (y; -x), (x^2; x y), (x y; y^2), there
remain 44: G1 .. G6 of the lowest degrees are (x; -y), (y; x), (x y; -10/7 p2(y)), (-10/7 p2(x); x y), (p2(y); 0), (0; p2(x)), then come
p_i(x) p_j(y), i + j > 2, in dx and in dy (A. Grün, Accuracy, reliability and statistics in close-range photogrammetry, ISP Commission V,
Stockholm 1978; the polynomials are derived here by orthogonalisation).

The simple set is dx = a1 y + a2 x y + a3 x y^2 + a4 x^2 y + a5 y^2 + a6 x^2 y^2, dy = b1 y + b2 x y + b3 x y^2 + b4 x^2 y + b5 x^2 +
b6 x^2 y^2.
"""

from __future__ import annotations

from baarda.cameras._terms import Term, correction_model, polynomial_step, product

#: coefficients of the one-dimensional polynomials for b = 1, lowest power first
POLYNOMIALS = (
    (1.0,),
    (0.0, 1.0),
    (-0.5, 0.0, 1.0),
    (0.0, -17.0 / 20.0, 0.0, 1.0),
    (9.0 / 70.0, 0.0, -31.0 / 28.0, 0.0, 1.0),
)
_S = 10.0 / 7.0


def _terms() -> list[Term]:
    low = [
        Term("G1", x=((1.0, 1, 0),), y=((-1.0, 0, 1),)),
        Term("G2", x=((1.0, 0, 1),), y=((1.0, 1, 0),)),
        Term("G3", x=((1.0, 1, 1),), y=((-_S, 0, 2), (_S / 2.0, 0, 0))),
        Term("G4", x=((-_S, 2, 0), (_S / 2.0, 0, 0)), y=((1.0, 1, 1),)),
        Term("G5", x=((1.0, 0, 2), (-0.5, 0, 0))),
        Term("G6", y=((1.0, 2, 0), (-0.5, 0, 0))),
    ]
    pairs = sorted(((i, j) for i in range(5) for j in range(5) if i + j > 2), key=lambda ij: (ij[0] + ij[1], -ij[0]))
    high = [(i, j, axis) for i, j in pairs for axis in "xy"]
    return low + [product(f"G{7 + k}", POLYNOMIALS[i], POLYNOMIALS[j], axis) for k, (i, j, axis) in enumerate(high)]


_SIMPLE = ((0, 1), (1, 1), (1, 2), (2, 1), (0, 2), (2, 2))

gruen44 = correction_model(
    "gruen44", "Grün's 44 parameters, orthogonal on a 5 x 5 grid, correct direction", polynomial_step("gruen44", _terms()), 0.3
)
gruen12 = correction_model(
    "gruen12",
    "Grün's simple set of 12 parameters, correct direction",
    polynomial_step(
        "gruen12",
        [Term(f"a{k}", x=((1.0, i, j),)) for k, (i, j) in enumerate(_SIMPLE, start=1)]
        + [Term(f"b{k}", y=((1.0, *(ij if ij != (0, 2) else (2, 0))),)) for k, ij in enumerate(_SIMPLE, start=1)],
    ),
)
