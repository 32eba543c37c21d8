"""The interior orientation: principal distance, principal point, axis sign; and the camera without distortion."""

from __future__ import annotations

import numpy as np

from baarda.cameras.base import CameraModel, Floats, Parameter, Step

Partials = tuple[Floats, Floats, Floats]


def _scale(xy: Floats, p: Floats) -> Partials:
    d_xy = np.zeros((len(xy), 2, 2))
    d_xy[:, 0, 0] = d_xy[:, 1, 1] = p[:, 0]
    return xy * p, d_xy, xy[:, :, None].copy()


def _scale_xy(xy: Floats, p: Floats) -> Partials:
    d_xy, d_p = np.zeros((len(xy), 2, 2)), np.zeros((len(xy), 2, 2))
    d_xy[:, 0, 0], d_xy[:, 1, 1] = p[:, 0], p[:, 1]
    d_p[:, 0, 0], d_p[:, 1, 1] = xy[:, 0], xy[:, 1]
    return xy * p, d_xy, d_p


def _eyes(n: int, value: float) -> Floats:
    return np.broadcast_to(value * np.eye(2), (n, 2, 2))


def _to_centre(xy: Floats, p: Floats) -> Partials:
    return xy - p, _eyes(len(xy), 1.0), _eyes(len(xy), -1.0)


def _from_centre(xy: Floats, p: Floats) -> Partials:
    return xy + p, _eyes(len(xy), 1.0), _eyes(len(xy), 1.0)


def _flip(xy: Floats, p: Floats) -> Partials:
    sign = np.array([1.0, -1.0])
    return xy * sign, np.broadcast_to(np.diag(sign), (len(xy), 2, 2)), np.zeros((len(xy), 2, 0))


_POINT = (Parameter("principal_point_x", 1), Parameter("principal_point_y", 1))

#: x = c * x_normalised
distance = Step("distance", (Parameter("principal_distance", 1, 1.0),), _scale)
#: separate principal distances along x and y (computer vision)
distances = Step("distances", (Parameter("principal_distance_x", 1, 1.0), Parameter("principal_distance_y", 1, 1.0)), _scale_xy)
#: subtracts the principal point (measured chain)
to_centre = Step("to_centre", _POINT, _to_centre)
#: adds the principal point (ideal chain)
from_centre = Step("from_centre", _POINT, _from_centre)
#: rows counted downwards become y upwards, or back; left out by cameras whose rows count upwards
flip = Step("flip", (), _flip)

INTERIOR = ("principal_distance", "principal_point_x", "principal_point_y")

pinhole = CameraModel(
    name="pinhole",
    description="central projection without distortion: c, x0, y0",
    order=INTERIOR,
    measured=(to_centre, flip),
    ideal=(distance,),
    examples=({"principal_distance": 900.0, "principal_point_x": 505.0, "principal_point_y": 396.0},),
)
