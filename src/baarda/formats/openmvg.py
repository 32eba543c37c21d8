"""OpenMVG scenes, ``sfm_data.json``: views, intrinsics, extrinsics, structure and control points in cereal's JSON.

OpenMVG's camera looks along +z with y down: camera vector = R (X - centre), so M = diag(1, -1, -1) R. One focal length, and distortion of
the normalised coordinates: none, ``disto_k1``, ``disto_k3`` (k1 k2 k3) or ``disto_t2`` (k1 k2 k3 t1 t2 = k1 k2 k3 p1 p2 of OpenCV).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.formats import checks
from baarda.formats.base import Format
from baarda.formats.gcp_marks import Marks, with_marks
from baarda.formats.json_tree import Json, read_json
from baarda.network import TIE, Images, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]

_AXES = np.diag([1.0, -1.0, -1.0])  # OpenMVG's camera axes in ours
_UNDEFINED = 2**32 - 1  # of an intrinsic or a pose that is not there
_DISTORTIONS = {"disto_k1": ("k1",), "disto_k3": ("k1", "k2", "k3"), "disto_t2": ("k1", "k2", "k3", "p1", "p2")}
_INTERIOR = ("principal_distance", "principal_point_x", "principal_point_y")


def recognises(path: Path) -> bool:
    """Tell a scene by its version key."""
    file = path / "sfm_data.json" if path.is_dir() else path
    if not file.is_file():
        return False
    with file.open("rb") as f:
        head = f.read(4096)
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{") and re.search(rb'"sfm_data_version"\s*:', head) is not None


def read(path: Path) -> Network:
    """Read a scene.

    Parameters
    ----------
    path : Path
        The file, or a folder with ``sfm_data.json``.

    Returns
    -------
    Network
        Images by their file names, points by their keys; a free network in model units.

    Raises
    ------
    InputError
        With file and line if it cannot be used.
    """
    root = read_json(path / "sfm_data.json" if path.is_dir() else path)
    root.need("sfm_data_version").word()
    cameras = {key: _camera(key, v) for key, v in _map(root, "intrinsics")}
    poses = dict(_map(root, "extrinsics"))
    index = {key: i for i, key in enumerate(cameras)}
    labels: dict[str, int] = {}
    image_of: dict[int, int] = {}
    owner, rotation, centre, places = [], [], [], []
    left = priors = 0
    for key, view in _map(root, "views"):
        data = view.need("ptr_wrapper").need("data")
        priors += data.get("center") is not None
        intrinsic, pose = (data.need(k).whole(0, _UNDEFINED) for k in ("id_intrinsic", "id_pose"))
        if intrinsic == _UNDEFINED or pose not in poses:
            left += 1
            continue
        if intrinsic not in index:
            raise data.need("id_intrinsic").error(f"intrinsic {intrinsic} is not among the intrinsics")
        name = data.need("filename")
        if name.label() in labels:
            raise name.error(f"image {name.value!r} appears twice")
        labels[name.label()] = image_of[key] = len(labels)
        owner.append(index[intrinsic])
        p = poses[pose]
        rotation.append(p.need("rotation").numbers(3, 3))
        checks.rotation_matrices(rotation[-1][None], _complaint(p.need("rotation")))
        centre.append(p.need("center").numbers(3))
        places.append(view)
    if not labels:
        raise root.need("views").error("no view has an intrinsic and a pose")
    names: list[str] = []
    xyz: list[Floats] = []
    image: list[int] = []
    point: list[int] = []
    xy: list[Floats] = []
    unused = 0
    for key, landmark in _map(root, "structure"):
        names.append(str(key))
        xyz.append(landmark.need("X").numbers(3))
        unused += _marks(landmark, image_of, len(names) - 1, image, point, xy)
    if not image:
        raise root.error("no point of the structure is seen in a view")
    images = np.array(image, dtype=np.intp)
    checks.images_with_points(images, list(labels), np.ones(len(labels), dtype=bool), lambda i, m: places[i].error(m))
    notes = [
        "image sigma 1 px, because OpenMVG has none",
        "principal distance, principal point and distortion of every intrinsic are free, as OpenMVG estimates them unless told otherwise",
    ]
    if left:
        notes.append(f"{left} view(s) without pose or intrinsic left out")
    if unused:
        notes.append(f"{unused} observation(s) in views without pose left out")
    if priors:
        notes.append("position priors of views are not used: give them with their sigmas by --camera-positions")
    network = Network(
        tuple(cameras.values()),
        Images.make(list(labels), owner, np.array(centre), _AXES @ np.array(rotation)),
        Points.make(names, np.array(xyz)),
        (ImagePoints.make(images, np.array(point, dtype=np.intp), np.array(xy)),),
        unit=checks.MODEL_UNITS,
    )
    return replace(_with_control(network, root, image_of, notes), assumptions=tuple(notes))


def _complaint(at: Json) -> checks.Complaint:
    return lambda _row, message: at.error(message)


def _map(root: Json, name: str) -> list[tuple[int, Json]]:
    """Return the keys and values of a map in cereal's way, a list of objects with key and value; none where it is absent."""
    at = root.get(name)
    out: dict[int, Json] = {}
    for entry in () if at is None else at.items():
        key = entry.need("key").whole(0, 2**63)
        if key in out:
            raise entry.error(f"key {key} appears twice")
        out[key] = entry.need("value")
    return list(out.items())


def _camera(key: int, value: Json) -> Camera:
    data = value.need("ptr_wrapper").need("data")
    base = data.get("value0") or data  # the base class, a level deeper in some versions
    kinds = [k for k in _DISTORTIONS if data.get(k) is not None]
    if data.get("fisheye") is not None or base.get("focal_length") is None or len(kinds) > 1:
        named = value.get("polymorphic_name")
        what = "this intrinsic" if named is None else f"intrinsic {named.word()!r}"
        raise value.error(f"{what} is not supported; supported are pinhole, pinhole_radial_k1, pinhole_radial_k3, pinhole_brown_t2")
    names = _DISTORTIONS[kinds[0]] if kinds else ()
    coefficients = data.need(kinds[0]).numbers(len(names)) if kinds else np.zeros(0)
    focal = base.need("focal_length")
    if not focal.number() > 0.0:
        raise focal.error("the focal length must be positive")
    centre = base.need("principal_point").numbers(2)
    size = tuple(float(base.need(k).whole(1, 10**6)) for k in ("width", "height"))
    values = dict(zip((*_INTERIOR, *names), (focal.number(), *centre.tolist(), *coefficients.tolist()), strict=True))
    return camera_models.create(str(key), camera_models.model("libmv"), values, free=(*_INTERIOR, *names), image_size=(size[0], size[1]))


def _marks(landmark: Json, image_of: dict[int, int], p: int, image: list[int], point: list[int], xy: list[Floats]) -> int:
    """Append the observations of a landmark; return how many lie in views that are not used."""
    seen: set[int] = set()
    unused = 0
    for key, observation in _map(landmark, "observations"):
        if key not in image_of:
            unused += 1
            continue
        if key in seen:
            raise observation.error(f"the point is measured twice in view {key}")
        seen.add(key)
        image.append(image_of[key])
        point.append(p)
        xy.append(observation.need("x").numbers(2))
    return unused


def _with_control(network: Network, root: Json, image_of: dict[int, int], notes: list[str]) -> Network:
    """Return the network with the marks of control points; their coordinates have no sigmas and are left to a control table."""
    labels: list[str] = []
    image: list[int] = []
    point: list[int] = []
    xy: list[Floats] = []
    for key, landmark in _map(root, "control_points"):
        _marks(landmark, image_of, len(labels), image, point, xy)
        labels.append(str(key))
    if not image:
        return network
    notes.append(f"{len(labels)} control point(s) are tie points: OpenMVG has no sigmas for their coordinates; give them by --control")
    marks = Marks(
        root.file,
        tuple(labels),
        np.full((len(labels), 3), np.nan),
        np.array(point, dtype=np.intp),
        np.array(image, dtype=np.intp),
        np.array(xy),
    )
    return with_marks(network, marks, np.ones(3), notes, move=False, roles=np.full(len(labels), TIE))


openmvg = Format("openmvg", "OpenMVG scene, sfm_data.json", recognises, read)
