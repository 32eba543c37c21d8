"""The perspective camera of Pix4D and of the Open Photogrammetry Format: one focal length, three radial and two tangential coefficients.

With x, y normalised, y down, r^2 = x^2 + y^2 (Pix4D, "How are the internal and external camera parameters defined?"):
x' = x (1 + R1 r^2 + R2 r^4 + R3 r^6) + 2 T1 x y + T2 (r^2 + 2 x^2), y' = y (...) + 2 T2 x y + T1 (r^2 + 2 y^2); u = cx + f x',
v = cy + f y'. It is OpenCV's polynomial with k1, k2, k3, p1, p2 and a single focal length.
"""

from __future__ import annotations

from baarda.cameras.base import CameraModel, Floats, Parameter, Step
from baarda.cameras.opencv import distortion
from baarda.cameras.pinhole import INTERIOR, distance, flip, from_centre

_LENS = ("R1", "R2", "R3", "T1", "T2")
_polynomial = distortion("k1", "k2", "k3", "p1", "p2").function


def _lens(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    return _polynomial(xy, p)


pix4d = CameraModel(
    name="pix4d",
    description="Pix4D and OPF, perspective camera: f, principal point, R1-R3, T1, T2 on normalised coordinates, y down",
    order=(*INTERIOR, *_LENS),
    ideal=(flip, Step("pix4d lens", tuple(Parameter(n) for n in _LENS), _lens, additional=True), distance, from_centre),
    examples=(
        {
            "principal_distance": 900.0,
            "principal_point_x": 505.0,
            "principal_point_y": 396.0,
            "R1": -0.1,
            "R2": 0.05,
            "R3": -0.02,
            "T1": 1.5e-3,
            "T2": -4e-4,
        },
    ),
)
