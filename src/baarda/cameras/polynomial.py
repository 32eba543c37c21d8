"""Complete polynomials of degree 2 to 5 in the image coordinates, without what mimics the exterior orientation of a vertical image.

x11 stands for x^1 y^1 in dx, y20 for x^2 y^0 in dy. Of the terms up to degree 2 the six of the exterior orientation over flat ground,
(1; 0), (0; 1), (x; y), (y; -x), (x^2; x y), (x y; y^2), are left out and their complement remains: affinity (x; -y), shear (y; x),
bend_x (x^2; -x y), bend_y (x y; -y^2), x02 = (y^2; 0), y20 = (0; x^2). From degree 3 on all monomials are there. They are correlated:
the tests of pairs, and orthogonalisation, are for them.
"""

from __future__ import annotations

from baarda.cameras._terms import Term, correction_model, polynomial_step
from baarda.cameras.base import CameraModel

_LOW = (
    Term("affinity", x=((1.0, 1, 0),), y=((-1.0, 0, 1),)),
    Term("shear", x=((1.0, 0, 1),), y=((1.0, 1, 0),)),
    Term("bend_x", x=((1.0, 2, 0),), y=((-1.0, 1, 1),)),
    Term("bend_y", x=((1.0, 1, 1),), y=((-1.0, 0, 2),)),
    Term("x02", x=((1.0, 0, 2),)),
    Term("y20", y=((1.0, 2, 0),)),
)


def _model(degree: int) -> CameraModel:
    terms = list(_LOW)
    for d in range(3, degree + 1):
        for i in range(d, -1, -1):
            terms += [Term(f"x{i}{d - i}", x=((1.0, i, d - i),)), Term(f"y{i}{d - i}", y=((1.0, i, d - i),))]
    name = f"polynomial{degree}"
    description = f"polynomial of degree {degree}, {len(terms)} parameters, without terms of the orientation, correct direction"
    return correction_model(name, description, polynomial_step(name, terms))


polynomial2 = _model(2)
polynomial3 = _model(3)
polynomial4 = _model(4)
polynomial5 = _model(5)
