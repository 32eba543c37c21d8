"""Writing OpenSfM data sets; what OpenSfM has no place for (sigmas, roles, states) is not written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from baarda.cameras import FIXED, Camera
from baarda.errors import UsageError
from baarda.formats.base import first_pixel
from baarda.formats.folder import write_folder
from baarda.formats.opencv_form import as_opencv, plain_pixels
from baarda.geometry import rotation as rot
from baarda.network import Network
from baarda.observations import ImagePoints

_AXES = np.diag([1.0, -1.0, -1.0])
_SINGLE = ("pinhole", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_DOUBLE = ("PINHOLE", "OPENCV", "opencv")
_BROWN = ("k1", "k2", "k3", "p1", "p2")


def write(network: Network, path: Path) -> None:
    """Write a folder with ``reconstruction.json`` and ``tracks.csv``; numbers read back to rounding.

    Parameters
    ----------
    network : Network
        Cameras that OpenSfM's perspective, radial and Brown models contain, with image sizes; all images oriented. Control points become
        tracks like all others; points without coordinates, which OpenSfM's list of points cannot hold, are left out with their marks.
    path : Path
        The folder; it must not exist yet, or be empty.

    Raises
    ------
    UsageError
        If the network holds what OpenSfM cannot express.
    OutputError
        If the folder cannot be written; nothing is left behind.
    """
    images, points = network.images, network.points
    groups = [g for g in network.observations if isinstance(g, ImagePoints)]
    if len(groups) < len(network.observations) or not groups:
        raise UsageError("an OpenSfM data set holds image points only, and there must be some")
    oriented = np.isfinite(images.position).all(axis=1) & np.isfinite(images.rotation).all(axis=(1, 2))
    if not oriented.all():
        raise UsageError(f"image {images.labels[int(np.argmin(oriented))]} has no orientation")
    image, point, xy = (np.concatenate([getattr(g, a) for g in groups]) for a in ("images", "points", "xy"))
    known = np.asarray(np.isfinite(points.coordinates).all(axis=1))[point]
    image, point, xy = image[known], point[known], xy[known]
    used = np.unique(point)
    if not len(used):
        raise UsageError("no measured point has coordinates")
    key = image * len(points.labels) + point
    if len(np.unique(key)) < len(key):
        raise UsageError("a point is measured twice in an image, which OpenSfM's tracks cannot hold")
    for label in (*images.labels, *points.labels, *(c.label for c in network.cameras)):
        if not label.strip() or "\t" in label or "\n" in label or "\r" in label:
            raise UsageError(f"OpenSfM's tracks cannot hold the name {label!r}")
    shift = first_pixel(network) or 0.0
    rotation = _AXES @ images.rotation
    vectors, translation = rot.log(rotation), -np.einsum("nij,nj->ni", rotation, images.position)
    model: dict[str, Any] = {
        "cameras": {c.label: _camera(c, shift) for c in network.cameras},
        "shots": {
            label: {"rotation": r, "translation": t, "camera": network.cameras[c].label}
            for label, r, t, c in zip(images.labels, vectors.tolist(), translation.tolist(), images.cameras.tolist(), strict=True)
        },
        "points": {points.labels[i]: {"color": [0.0, 0.0, 0.0], "coordinates": points.coordinates[i].tolist()} for i in used.tolist()},
    }
    reference = network.settings.get("reference_lla")
    if reference is not None and not np.any(network.offset):
        model["reference_lla"] = dict(zip(("latitude", "longitude", "altitude"), map(float, reference), strict=True))
    size = np.array([c.image_size for c in network.cameras], dtype=float).reshape(-1, 2)[images.cameras[image]]
    normalised = (xy - shift - 0.5 * (size - 1.0)) / size.max(axis=1, keepdims=True)
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    count = np.zeros(len(images.labels), dtype=int)  # running number of a feature within its image
    for i, p, (x, y) in zip(image.tolist(), point.tolist(), normalised.tolist(), strict=True):
        lines.append(f"{images.labels[i]}\t{points.labels[p]}\t{count[i]}\t{x!r}\t{y!r}\t0.001\t0\t0\t0\t-1\t-1")
        count[i] += 1
    text = json.dumps([model], indent=1, allow_nan=False, ensure_ascii=False)
    write_folder(path, {"reconstruction.json": text + "\n", "tracks.csv": "\n".join(lines) + "\n"})


def _camera(camera: Camera, shift: float) -> dict[str, Any]:
    """Return a camera in OpenSfM's terms."""
    name = camera.model.name
    other = None if name in (*_SINGLE, *_DOUBLE) else as_opencv(camera)
    if other is not None and any(other[n] != 0.0 for n in ("k4", "k5", "k6")):
        other = None
    if (name not in (*_SINGLE, *_DOUBLE) and other is None) or not plain_pixels(camera):
        raise UsageError(
            f"camera {camera.label}: OpenSfM has no model {name!r} with these pixels; it holds {', '.join((*_SINGLE, *_DOUBLE))} in pixels "
            "from the upper left corner, y down"
        )
    if camera.image_size is None or not all(float(s).is_integer() for s in camera.image_size):
        raise UsageError(f"camera {camera.label}: OpenSfM needs the image size")
    width, height = (int(s) for s in camera.image_size)
    side = float(max(width, height))
    if other is not None:
        centre = {f"c_{a}": (other[f"c{a}"] - shift - 0.5 * (n - 1.0)) / side for a, n in (("x", width), ("y", height))}
        focal_pair = {f"focal_{a}": other[f"f{a}"] / side for a in "xy"}
        brown = {"projection_type": "brown", "width": width, "height": height, **focal_pair, **centre}
        return {**brown, **{n: other[n] for n in _BROWN}}
    value = dict(zip(camera.model.order, np.asarray(camera.values, dtype=float).tolist(), strict=True))
    state = dict(zip(camera.model.order, np.asarray(camera.states).tolist(), strict=True))
    middle = [(value[f"principal_point_{a}"] - shift - 0.5 * (n - 1.0)) / side for a, n in (("x", width), ("y", height))]
    k = {n: value.get(n, 0.0) for n in _BROWN}
    zero = {n for n in _BROWN if k[n] == 0.0 and state.get(n, FIXED) == FIXED}
    size = {"width": width, "height": height}
    single = name in _SINGLE
    focal = [value["principal_distance"]] * 2 if single else [value["principal_distance_x"], value["principal_distance_y"]]
    if single and middle == [0.0, 0.0]:
        return {"projection_type": "perspective", **size, "focal": focal[0] / side, "k1": k["k1"], "k2": k["k2"]}
    pair = {"focal_x": focal[0] / side, "focal_y": focal[1] / side, "c_x": middle[0], "c_y": middle[1]}
    if {"k2", "k3", "p1", "p2"} <= zero:
        return {"projection_type": "simple_radial", **size, **pair, "k1": k["k1"]}
    if {"k3", "p1", "p2"} <= zero:
        return {"projection_type": "radial", **size, **pair, "k1": k["k1"], "k2": k["k2"]}
    return {"projection_type": "brown", **size, **pair, **k}
