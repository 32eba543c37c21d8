"""OpenCV's distortion of ideal normalised coordinates: polynomial and rational radial terms with decentring.

With x, y normalised, y down, r^2 = x^2 + y^2 (OpenCV, module calib3d):
x' = x R + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y,
R = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6).
"""

from __future__ import annotations

import numpy as np

from baarda.cameras.base import CameraModel, Floats, Parameter, Step, StepFunction
from baarda.cameras.pinhole import distances, flip, from_centre


def _distortion(names: tuple[str, ...]) -> StepFunction:
    """Return the map for the coefficients of these names; the others are zero."""
    at = {name: j for j, name in enumerate(names)}

    def function(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        x, y = xy[:, 0], xy[:, 1]
        xx, yy, xy2 = x * x, y * y, 2.0 * x * y
        r2 = xx + yy
        zero = np.zeros(1)
        k1, k2, k3, k4, k5, k6, p1, p2 = (p[:, at[n]] if n in at else zero for n in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"))
        upper = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        lower = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        ratio = upper / lower
        d_upper = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
        d_lower = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6)
        slope = 2.0 * (d_upper - ratio * d_lower) / lower  # d(ratio)/dx = x * slope
        out = np.stack([x * ratio + p1 * xy2 + p2 * (r2 + 2.0 * xx), y * ratio + p1 * (r2 + 2.0 * yy) + p2 * xy2], axis=-1)
        d_xy = np.empty((len(x), 2, 2))
        d_xy[:, 0, 0] = ratio + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
        d_xy[:, 1, 1] = ratio + yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
        d_xy[:, 0, 1] = d_xy[:, 1, 0] = x * y * slope + 2.0 * (p1 * x + p2 * y)
        d_p = np.empty((len(x), 2, len(names)))
        for name, j in at.items():
            if name[0] == "k":
                order = int(name[1:])
                common = r2**order / lower if order <= 3 else -ratio * r2 ** (order - 3) / lower
                d_p[:, 0, j], d_p[:, 1, j] = x * common, y * common
            elif name == "p1":
                d_p[:, 0, j], d_p[:, 1, j] = xy2, r2 + 2.0 * yy
            else:
                d_p[:, 0, j], d_p[:, 1, j] = r2 + 2.0 * xx, xy2
        return out, d_xy, d_p

    return function


def distortion(*names: str) -> Step:
    """Return a step with the coefficients of these names (k1 to k6, p1, p2), in this order."""
    return Step("opencv " + " ".join(names), tuple(Parameter(n) for n in names), _distortion(names), additional=True)


#: fx fy cx cy in our names
CENTRAL = ("principal_distance_x", "principal_distance_y", "principal_point_x", "principal_point_y")
EXAMPLE = {
    "principal_distance_x": 900.0,
    "principal_distance_y": 905.0,
    "principal_point_x": 505.0,
    "principal_point_y": 396.0,
    "k1": -0.26,
    "k2": 0.08,
    "p1": 1.8e-3,
    "p2": -3e-4,
    "k3": -0.01,
    "k4": 0.02,
    "k5": -0.03,
    "k6": 0.01,
}


def central(name: str, description: str, *coefficients: str) -> CameraModel:
    """Return a model fx fy cx cy followed by distortion coefficients in this order."""
    order = (*CENTRAL, *coefficients)
    steps = (distortion(*coefficients),) if coefficients else ()
    return CameraModel(
        name, description, order, ideal=(flip, *steps, distances, from_centre), examples=({k: v for k, v in EXAMPLE.items() if k in order},)
    )


opencv = central("opencv", "OpenCV with five coefficients in its order: fx fy cx cy k1 k2 p1 p2 k3", "k1", "k2", "p1", "p2", "k3")
