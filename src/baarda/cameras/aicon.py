"""The camera of AICON and of Luhmann's textbook: balanced radial distortion, decentring, affinity and shear, added to the ideal point.

With x, y on the ideal image, r^2 = x^2 + y^2 and R0 the second zero of the radial distortion (Luhmann et al., Close-Range Photogrammetry,
3.3; Dold 1997): q = A1 (r^2 - R0^2) + A2 (r^4 - R0^4) + A3 (r^6 - R0^6),
dx = x q + B1 (r^2 + 2 x^2) + 2 B2 x y + C1 x + C2 y,  dy = y q + B2 (r^2 + 2 y^2) + 2 B1 x y. All terms act on the same ideal point; R0 is
a constant of the camera, its `grid`.
"""

from __future__ import annotations

import numpy as np

from baarda.cameras.base import CameraModel, Floats, Parameter, Step, additive
from baarda.cameras.pinhole import INTERIOR, distance, flip, from_centre


def _balanced(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the increment with R0 = 1 and its partials."""
    x, y = xy[:, 0], xy[:, 1]
    a1, a2, a3, b1, b2, c1, c2 = (p[:, j] for j in range(7))
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    radial = a1 * (r2 - 1.0) + a2 * (r2 * r2 - 1.0) + a3 * (r2 * r2 * r2 - 1.0)
    slope = 2.0 * (a1 + r2 * (2.0 * a2 + r2 * 3.0 * a3))  # d(radial)/dx = x * slope
    increment = np.stack(
        [x * radial + b1 * (r2 + 2.0 * xx) + b2 * xy2 + c1 * x + c2 * y, y * radial + b2 * (r2 + 2.0 * yy) + b1 * xy2], axis=-1
    )
    d_xy = np.empty((len(x), 2, 2))
    d_xy[:, 0, 0] = radial + xx * slope + 6.0 * b1 * x + 2.0 * b2 * y + c1
    d_xy[:, 1, 1] = radial + yy * slope + 6.0 * b2 * y + 2.0 * b1 * x
    both = x * y * slope + 2.0 * (b1 * y + b2 * x)
    d_xy[:, 0, 1], d_xy[:, 1, 0] = both + c2, both
    d_p = np.zeros((len(x), 2, 7))
    for j, power in enumerate((r2, r2 * r2, r2 * r2 * r2)):
        d_p[:, 0, j], d_p[:, 1, j] = x * (power - 1.0), y * (power - 1.0)
    d_p[:, 0, 3], d_p[:, 1, 3] = r2 + 2.0 * xx, xy2
    d_p[:, 0, 4], d_p[:, 1, 4] = xy2, r2 + 2.0 * yy
    d_p[:, 0, 5], d_p[:, 0, 6] = x, y
    return increment, d_xy, d_p


_SETS = (
    Parameter("A1", -2),
    Parameter("A2", -4),
    Parameter("A3", -6),
    Parameter("B1", -1),
    Parameter("B2", -1),
    Parameter("C1"),
    Parameter("C2"),
)
lens = Step("balanced lens", _SETS, additive(_balanced), additional=True, on_grid=True)

_EXAMPLE = {
    "principal_distance": 900.0,
    "principal_point_x": 505.0,
    "principal_point_y": 396.0,
    "A1": -1.2e-7,
    "A2": 9e-14,
    "A3": -4e-20,
    "B1": 3e-7,
    "B2": -5e-7,
    "C1": 4e-4,
    "C2": -2e-4,
}

aicon = CameraModel(
    name="aicon",
    description="AICON, distort direction: A1-A3 balanced at R0 (the half-width of the grid), B1, B2 decentring, C1, C2 affinity and shear",
    order=(*INTERIOR, *(p.name for p in _SETS)),
    ideal=(distance, lens, flip, from_centre),
    examples=(_EXAMPLE, {**_EXAMPLE, "A1": 2e-7, "A2": 0.0, "A3": 0.0}),
)
