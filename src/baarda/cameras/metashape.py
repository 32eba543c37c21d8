"""The frame camera of Agisoft Metashape (user manual, appendix "Camera models").

With x, y normalised, y down, r^2 = x^2 + y^2: x' = x (1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8) + P1 (r^2 + 2 x^2) + 2 P2 x y,
y' = y (...) + P2 (r^2 + 2 y^2) + 2 P1 x y; u = x0 + f x' + B1 x' + B2 y', v = y0 + f y'. The principal point x0, y0 is the image centre
plus Metashape's cx, cy.
"""

from __future__ import annotations

import numpy as np

from baarda.cameras.base import CameraModel, Floats, Parameter, Step
from baarda.cameras.pinhole import INTERIOR, flip, from_centre

_LENS = ("K1", "K2", "K3", "K4", "P1", "P2")


def _lens(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    x, y = xy[:, 0], xy[:, 1]
    k1, k2, k3, k4, p1, p2 = (p[:, j] for j in range(6))
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4)))  # d(radial)/dx = x * slope
    out = np.stack([x * radial + p1 * (r2 + 2.0 * xx) + p2 * xy2, y * radial + p2 * (r2 + 2.0 * yy) + p1 * xy2], axis=-1)
    d_xy = np.empty((len(x), 2, 2))
    d_xy[:, 0, 0] = radial + xx * slope + 6.0 * p1 * x + 2.0 * p2 * y
    d_xy[:, 1, 1] = radial + yy * slope + 6.0 * p2 * y + 2.0 * p1 * x
    d_xy[:, 0, 1] = d_xy[:, 1, 0] = x * y * slope + 2.0 * (p1 * y + p2 * x)
    d_p = np.empty((len(x), 2, 6))
    power = r2
    for j in range(4):
        d_p[:, 0, j], d_p[:, 1, j] = x * power, y * power
        power = power * r2
    d_p[:, 0, 4], d_p[:, 1, 4] = r2 + 2.0 * xx, xy2
    d_p[:, 0, 5], d_p[:, 1, 5] = xy2, r2 + 2.0 * yy
    return out, d_xy, d_p


def _affine(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    """Principal distance, affinity and skew, all in plane units: (f + B1) x + B2 y, f y."""
    f, b1, b2 = (p[:, j] for j in range(3))
    x, y = xy[:, 0], xy[:, 1]
    out = np.stack([(f + b1) * x + b2 * y, f * y], axis=-1)
    d_xy, d_p = np.zeros((len(x), 2, 2)), np.zeros((len(x), 2, 3))
    d_xy[:, 0, 0], d_xy[:, 0, 1], d_xy[:, 1, 1] = f + b1, b2, f
    d_p[:, 0, 0], d_p[:, 1, 0], d_p[:, 0, 1], d_p[:, 0, 2] = x, y, x, y
    return out, d_xy, d_p


metashape = CameraModel(
    name="metashape",
    description="Agisoft Metashape, frame camera: f, principal point, K1-K4, P1, P2, B1, B2 on normalised coordinates, y down",
    order=(*INTERIOR, *_LENS, "B1", "B2"),
    ideal=(
        flip,
        Step("metashape lens", tuple(Parameter(n) for n in _LENS), _lens, additional=True),
        Step("metashape distance", (Parameter("principal_distance", 1, 1.0), Parameter("B1", 1), Parameter("B2", 1)), _affine),
        from_centre,
    ),
    examples=(
        {
            "principal_distance": 900.0,
            "principal_point_x": 505.0,
            "principal_point_y": 396.0,
            "K1": -0.1,
            "K2": 0.05,
            "K3": -0.02,
            "K4": 0.004,
            "P1": 1.5e-3,
            "P2": -4e-4,
            "B1": 0.7,
            "B2": -0.3,
        },
    ),
)
