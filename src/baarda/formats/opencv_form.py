"""Cameras of other programs in OpenCV's terms, exactly: for writers whose formats know OpenCV's polynomial only."""

from __future__ import annotations

import numpy as np

from baarda.cameras import Camera

ORDER = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_KNOWN = ("pinhole", "opencv", "pix4d", "metashape", "PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def plain_pixels(camera: Camera) -> bool:
    """Tell whether the plane of a camera is that of its pixels, from the upper left corner, y down."""
    sizes, origin = np.asarray(camera.pixel_size), np.asarray(camera.origin)
    return bool(camera.unit == "px" and camera.y_down and (sizes == 1.0).all() and (origin == 0.0).all())


def as_opencv(camera: Camera) -> dict[str, float] | None:
    """Return fx, fy, cx, cy and k1, k2, p1, p2, k3 to k6 of a camera in plain pixels; None where OpenCV's polynomial cannot hold it.

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    dict or None
        By the names of `ORDER`; OpenCV's axes (y down).

    Examples
    --------
    >>> from baarda.cameras import create, model
    >>> camera = create("1", model("pix4d"), {"principal_distance": 900.0, "R1": -0.1, "T1": 0.001})
    >>> found = as_opencv(camera)
    >>> found["fx"], found["k1"], found["p1"]
    (900.0, -0.1, 0.001)
    """
    name = camera.model.name
    if name not in _KNOWN or not plain_pixels(camera):
        return None
    v = dict(zip(camera.model.order, np.asarray(camera.values, dtype=float).tolist(), strict=True))
    f = v.get("principal_distance", 0.0)
    out = {"fx": v.get("principal_distance_x", f), "fy": v.get("principal_distance_y", f)}
    out.update({f"c{a}": v[f"principal_point_{a}"] for a in "xy"})
    if name == "pix4d":
        lens = {"k1": "R1", "k2": "R2", "k3": "R3", "p1": "T1", "p2": "T2"}
    elif name == "metashape":
        if v["K4"] != 0.0 or v["B2"] != 0.0:  # neither r^8 nor skew is in OpenCV's polynomial
            return None
        out["fx"] += v["B1"]
        lens = {"k1": "K1", "k2": "K2", "k3": "K3", "p1": "P2", "p2": "P1"}
    else:
        lens = {n: n for n in ORDER[4:]}
        if name == "SIMPLE_RADIAL":
            lens = {"k1": "k1"}
    return {**out, **{n: v.get(lens.get(n, ""), 0.0) for n in ORDER[4:]}}
