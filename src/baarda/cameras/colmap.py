"""COLMAP's camera models: OpenCV's distortion with COLMAP's parameter lists. Pixel centres lie at .5."""

from __future__ import annotations

from baarda.cameras.base import CameraModel
from baarda.cameras.opencv import EXAMPLE, central, distortion
from baarda.cameras.pinhole import INTERIOR, distance, flip, from_centre


def _simple(name: str, description: str, *coefficients: str) -> CameraModel:
    """Return a model with one principal distance: f cx cy and distortion coefficients."""
    steps = (distortion(*coefficients),) if coefficients else ()
    example = {"principal_distance": 900.0, "principal_point_x": 505.0, "principal_point_y": 396.0}
    example.update({c: EXAMPLE[c] for c in coefficients})
    return CameraModel(name, description, (*INTERIOR, *coefficients), ideal=(flip, *steps, distance, from_centre), examples=(example,))


simple_pinhole = _simple("SIMPLE_PINHOLE", "COLMAP: f cx cy")
pinhole_xy = central("PINHOLE", "COLMAP: fx fy cx cy")
simple_radial = _simple("SIMPLE_RADIAL", "COLMAP: f cx cy k1", "k1")
radial = _simple("RADIAL", "COLMAP: f cx cy k1 k2", "k1", "k2")
opencv4 = central("OPENCV", "COLMAP: fx fy cx cy k1 k2 p1 p2", "k1", "k2", "p1", "p2")
full_opencv = central("FULL_OPENCV", "COLMAP: fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
