"""Brown's radial and decentring distortion with affinity and shear, in both directions, and the DBAT orders of the same steps.

With x, y reduced to the principal point and r^2 = x^2 + y^2 (Brown 1971; Luhmann et al., Close-Range Photogrammetry, 3.3):
dx = x (K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 x^2) + 2 P2 x y,  dy = y (...) + 2 P1 x y + P2 (r^2 + 2 y^2);
affinity and shear act on x alone: x (1 + B1) + B2 y. The `correct` direction adds them to measured coordinates (photogrammetry), the
`distort` direction to ideal ones (computer vision): the signs of the coefficients differ between the two.
"""

from __future__ import annotations

import numpy as np

from baarda.cameras.base import CameraModel, Floats, Parameter, Step, additive
from baarda.cameras.pinhole import INTERIOR, distance, flip, from_centre, to_centre


def _lens(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    x, y = xy[:, 0], xy[:, 1]
    k1, k2, k3, p1, p2 = (p[:, j] for j in range(5))
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d(radial)/dx = x * slope
    increment = np.stack([x * radial + p1 * (r2 + 2.0 * xx) + p2 * xy2, y * radial + p1 * xy2 + p2 * (r2 + 2.0 * yy)], axis=-1)
    d_xy = np.empty((len(x), 2, 2))
    d_xy[:, 0, 0] = radial + xx * slope + 6.0 * p1 * x + 2.0 * p2 * y
    d_xy[:, 1, 1] = radial + yy * slope + 2.0 * p1 * x + 6.0 * p2 * y
    d_xy[:, 0, 1] = d_xy[:, 1, 0] = x * y * slope + 2.0 * (p1 * y + p2 * x)
    d_p = np.empty((len(x), 2, 5))
    for j, power in enumerate((r2, r2 * r2, r2 * r2 * r2)):
        d_p[:, 0, j], d_p[:, 1, j] = x * power, y * power
    d_p[:, 0, 3], d_p[:, 1, 3] = r2 + 2.0 * xx, xy2
    d_p[:, 0, 4], d_p[:, 1, 4] = xy2, r2 + 2.0 * yy
    return increment, d_xy, d_p


def _affinity(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    x, y = xy[:, 0], xy[:, 1]
    increment = np.zeros_like(xy)
    increment[:, 0] = p[:, 0] * x + p[:, 1] * y
    d_xy, d_p = np.zeros((len(x), 2, 2)), np.zeros((len(x), 2, 2))
    d_xy[:, 0, 0], d_xy[:, 0, 1] = p[:, 0], p[:, 1]
    d_p[:, 0, 0], d_p[:, 0, 1] = x, y
    return increment, d_xy, d_p


#: radial and decentring distortion
lens = Step(
    "lens",
    (Parameter("K1", -2), Parameter("K2", -4), Parameter("K3", -6), Parameter("P1", -1), Parameter("P2", -1)),
    additive(_lens),
    additional=True,
)
#: affinity B1 and shear B2
affinity = Step("affinity", (Parameter("B1"), Parameter("B2")), additive(_affinity), additional=True)

_LENS = ("K1", "K2", "K3", "P1", "P2")
_ALL = (*INTERIOR, *_LENS, "B1", "B2")
_EXAMPLE = {
    "principal_distance": 900.0,
    "principal_point_x": 505.0,
    "principal_point_y": 396.0,
    "K1": 1.2e-7,
    "K2": -9e-14,
    "K3": 4e-20,
    "P1": -3e-7,
    "P2": 5e-7,
}
_AFFINE = {**_EXAMPLE, "B1": 4e-4, "B2": -2e-4}

brown = CameraModel(
    name="brown",
    description="Brown, correct direction: affinity and shear, then K1-K3, P1, P2 on the measured point (DBAT model 3)",
    order=_ALL,
    measured=(to_centre, flip, affinity, lens),
    ideal=(distance,),
    examples=(_AFFINE, {**_EXAMPLE, "K1": -4e-7, "K2": 1e-13, "K3": 0.0}),
)
brown_distort = CameraModel(
    name="brown-distort",
    description="Brown, distort direction: K1-K3, P1, P2, then affinity and shear on the ideal point (DBAT model -1)",
    order=_ALL,
    ideal=(distance, lens, affinity, flip, from_centre),
    examples=(_AFFINE, _EXAMPLE),
)
dbat1 = CameraModel(
    name="dbat1",
    description="Brown without affinity, correct direction (DBAT models 1 and 2)",
    order=(*INTERIOR, *_LENS),
    measured=(to_centre, flip, lens),
    ideal=(distance,),
    examples=(_EXAMPLE,),
)
dbat4 = CameraModel(
    name="dbat4",
    description="Brown, correct direction, affinity after the lens distortion (DBAT model 4)",
    order=_ALL,
    measured=(to_centre, flip, lens, affinity),
    ideal=(distance,),
    examples=(_AFFINE,),
)
dbat5 = CameraModel(
    name="dbat5",
    description="Brown, correct direction, affinity before the principal point is subtracted (DBAT model 5)",
    order=_ALL,
    measured=(affinity, to_centre, flip, lens),
    ideal=(distance,),
    examples=(_AFFINE,),
)
