"""Cameras of structure-from-motion problems with one principal distance: Snavely's (Bundler, BAL) and libmv's.

Snavely (Bundler user's manual): P = R X + t, p = -P_xy / P_z, then f (1 + k1 |p|^2 + k2 |p|^4) p, from the image centre, y up; axes and
normalised coordinates are ours. libmv: x = P_xy / P_z with y down, then f times OpenCV's polynomial distortion plus the principal point.
"""

from __future__ import annotations

from baarda.cameras.base import CameraModel
from baarda.cameras.opencv import EXAMPLE, distortion
from baarda.cameras.pinhole import INTERIOR, distance, flip, from_centre

_POLYNOMIAL = ("k1", "k2", "k3", "p1", "p2")

snavely = CameraModel(
    name="snavely",
    description="Bundler and BAL: f k1 k2, origin in the image centre, y up",
    order=("principal_distance", "k1", "k2"),
    ideal=(distortion("k1", "k2"), distance),
    examples=(
        {"principal_distance": 900.0, "k1": -0.2, "k2": 0.05},
        {"principal_distance": 1430.0, "k1": -7.6e-8, "k2": 3.2e-13},
    ),
)
libmv = CameraModel(
    name="libmv",
    description="libmv: f cx cy k1 k2 k3 p1 p2 (OpenCV's polynomial distortion with one principal distance)",
    order=(*INTERIOR, *_POLYNOMIAL),
    ideal=(flip, distortion(*_POLYNOMIAL), distance, from_centre),
    examples=(
        {
            "principal_distance": 900.0,
            "principal_point_x": 505.0,
            "principal_point_y": 396.0,
            **{name: EXAMPLE[name] for name in _POLYNOMIAL},
        },
    ),
)
