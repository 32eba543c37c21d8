"""OpenSfM (and OpenDroneMap) data sets: ``reconstruction.json``, ``tracks.csv``, and where they are there, ground control points.

OpenSfM's camera looks along +z with y down and maps the world by R X + t with R = exp(rotation): M = diag(1, -1, -1) R and the projection
centre is -R't. Image coordinates in its files are divided by the larger image side s, from the image centre:
x = (px - (w - 1) / 2) / s; here they are pixels, with (0, 0) the centre of the first one. A shot of a rig carries its own orientation.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.errors import InputError, MissingExtra
from baarda.formats import checks
from baarda.formats.base import Format, MeasuredPositions, finite_or_nan, label_problem, number, split_lines
from baarda.formats.gcp_marks import Marks, with_marks
from baarda.formats.json_tree import Json, read_json
from baarda.formats.odm_gcp import read_gcp_list
from baarda.formats.opensfm_writer import write
from baarda.geometry import rotation as rot
from baarda.geometry.tangent_frame import TangentFrame
from baarda.network import Images, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]

AXES = np.diag([1.0, -1.0, -1.0])  # OpenSfM's camera axes in ours
REFERENCE = "reference_lla"  # key of the settings of a network: latitude, longitude, height of the origin of its frame
_PLACES = ("", "opensfm")  # an ODM project keeps the data set in a folder of that name
_VERSION = "OPENSFM_TRACKS_VERSION_v"
_WIDTHS = {0: 8, 1: 9, 2: 11}  # columns of tracks.csv by version
_GPS_SIGMA = 15.0  # metres: OpenSfM's gps_dop where an image has none
_PAIR = ("focal_x", "focal_y", "c_x", "c_y")
#: projection type: our model, OpenSfM's keys in the order of its parameters, coefficients that are estimated
_TYPES: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "perspective": ("RADIAL", ("focal", "", "", "k1", "k2"), ("k1", "k2")),
    "simple_radial": ("OPENCV", (*_PAIR, "k1", "", "", ""), ("k1",)),
    "radial": ("OPENCV", (*_PAIR, "k1", "k2", "", ""), ("k1", "k2")),
    "brown": ("opencv", (*_PAIR, "k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "p1", "p2", "k3")),
}


def _files(path: Path) -> tuple[Path, Path] | None:
    """Return the reconstruction and the tracks of a folder, or of a reconstruction file and its folder."""
    if path.is_file():
        tracks = _one(path.parent, "tracks", "csv")
        return (path, tracks) if tracks is not None else None
    for place in _PLACES:
        folder = path / place
        found = _one(folder, "reconstruction", "json"), _one(folder, "tracks", "csv")
        if found[0] is not None and found[1] is not None:
            return found[0], found[1]
    return None


def _one(folder: Path, stem: str, kind: str) -> Path | None:
    """Return the file of this name, else the only one whose name begins so."""
    if (folder / f"{stem}.{kind}").is_file():
        return folder / f"{stem}.{kind}"
    found = sorted(folder.glob(f"{stem}*.{kind}"))
    return found[0] if len(found) == 1 and found[0].is_file() else None


def recognises(path: Path) -> bool:
    """Tell an OpenSfM data set by a list of reconstructions with cameras and shots beside a table of tracks."""
    files = _files(path)
    if files is None:
        return False
    with files[0].open("rb") as f:
        head = f.read(1 << 16).removeprefix(b"\xef\xbb\xbf").lstrip()
    return head.startswith(b"[") and re.search(rb'"(cameras|shots|rig_cameras|projection_type)"', head) is not None


def read(path: Path) -> Network:
    """Read an OpenSfM data set.

    Parameters
    ----------
    path : Path
        Its folder, that of an ODM project, or the reconstruction beside its tracks.

    Returns
    -------
    Network
        In metres, in the frame (east, north, up) that touches the ellipsoid at OpenSfM's reference, in model units without one. Points
        bear the numbers of their tracks, ground control points their own names.

    Raises
    ------
    InputError
        With file and line, if a file cannot be used.
    """
    files = _files(path)
    if files is None:
        raise InputError("not an OpenSfM data set: reconstruction.json or tracks.csv is missing", path)
    notes: list[str] = []
    model = _largest(read_json(files[0]), notes)
    config = _configuration(files[0].parent / "config.yaml")
    free = config.get("optimize_camera_parameters", "yes") not in ("no", "false")
    cameras = {key: _camera(key, c, free) for key, c in model.need("cameras").entries()}
    index = {key: i for i, key in enumerate(cameras)}
    labels, owner, rotation, translation = _shots(model.need("shots"), index)
    points = model.need("points")
    names = [key for key, _ in points.entries()]
    for key in names:
        problem = label_problem(key, "point")
        if problem or not key.strip():
            raise points.at(key).error(problem or "the label is empty")
    xyz = np.array([p.need("coordinates").numbers(3) for _, p in points.entries()]).reshape(-1, 3)
    notes.append("image sigma 1 px: OpenSfM weights by the size of the features; --image-sigma or --variance-components set another")
    notes.append(
        "camera parameters are free, principal points of perspective cameras fixed, as OpenSfM estimates them; its priors are not used"
        if free
        else "camera parameters are fixed (optimize_camera_parameters: no)"
    )
    image, point, normalised = _tracks(files[1], labels, names, notes)
    used = [cameras[key] for key in cameras]
    size = np.array([c.image_size for c in used], dtype=float).reshape(-1, 2)[owner[image]]
    xy = normalised * size.max(axis=1, keepdims=True) + 0.5 * (size - 1.0)
    checks.images_with_points(image, labels, np.ones(len(labels), dtype=bool), lambda i, m: model.need("shots").at(labels[i]).error(m))
    position = -np.einsum("nji,nj->ni", rotation, translation)
    reference = model.get(REFERENCE)
    beside = files[0].parent / "reference_lla.json"  # where older versions keep it
    if reference is None and beside.is_file():
        reference = read_json(beside)
    origin = None if reference is None else tuple(reference.need(k).number() for k in ("latitude", "longitude", "altitude"))
    if any(s.get("gps_position") is not None for _, s in model.need("shots").entries()):
        notes.append("GPS positions of the shots are not used: --camera-positions source uses them, a table gives others")
    network = Network(
        tuple(used),
        Images.make(labels, owner, position, AXES @ rotation),
        Points.make(names, xyz),
        (ImagePoints.make(image, point, xy),),
        unit=checks.MODEL_UNITS if origin is None else "m",
        settings={} if origin is None else {REFERENCE: origin},
        assumptions=tuple(notes),
    )
    return _with_control(network, files[0].parent, origin, config)


def positions(path: Path) -> MeasuredPositions:
    """Return the GPS positions of the shots of the largest reconstruction.

    Notes
    -----
    Their standard deviation is ``gps_dop`` in all three axes, as OpenSfM weights them; strips are not told apart, times are capture times.

    Raises
    ------
    InputError
        With file and line, if there are none or one cannot be used.
    """
    files = _files(path)
    if files is None:
        raise InputError("not an OpenSfM data set: reconstruction.json or tracks.csv is missing", path)
    model = _largest(read_json(files[0]), [])
    labels, xyz, sigmas, times = [], [], [], []
    shots = model.need("shots")
    usual = 0
    for key, shot in shots.entries():
        place = shot.get("gps_position")
        if place is None:
            continue
        dop = shot.get("gps_dop")
        sigma = _GPS_SIGMA if dop is None else dop.number()
        usual += dop is None
        if not 0.0 < sigma < 1e6 or (dop is not None and sigma < checks.SIGMAS[0]):
            raise (dop or shot).error("gps_dop must be a positive number of metres")
        time = shot.get("capture_time")
        labels.append(key)
        xyz.append(place.numbers(3))
        sigmas.append(sigma)
        times.append(float("nan") if time is None else time.number())
    if not labels:
        raise shots.error("no shot has a gps_position")
    notes = ["GPS positions have the standard deviation gps_dop of their shots in X, Y and Z, as OpenSfM takes it"]
    if usual:
        notes.append(f"{usual} shot(s) have no gps_dop: {_GPS_SIGMA:g} m, OpenSfM's usual value")
    at = np.array(times)
    return MeasuredPositions(
        files[0],
        tuple(labels),
        np.array(xyz),
        np.array(sigmas)[:, None, None] ** 2 * np.eye(3),
        ("all",) * len(labels),
        at if np.isfinite(at).all() else None,
        lambda i, m: shots.at(labels[i]).error(m),
        tuple(notes),
    )


def _largest(root: Json, notes: list[str]) -> Json:
    models = list(root.items())
    if not models:
        raise root.error("the list of reconstructions is empty")
    counts = [len(m.need("shots").object()) for m in models]
    if len(models) > 1:
        notes.append(f"{len(models)} reconstructions: the largest, with {max(counts)} of {sum(counts)} shots, is used")
    model = models[counts.index(max(counts))]
    if not max(counts):
        raise model.error("the reconstruction has no shots")
    if (panoramas := model.get("pano_shots")) is not None and panoramas.object():
        notes.append(f"{len(panoramas.object())} panorama shot(s) left out")
    return model


def _camera(key: str, c: Json, free: bool) -> Camera:
    kind_at = c.get("projection_type")
    kind = "perspective" if kind_at is None else kind_at.word()
    problem = label_problem(key, "camera")
    if problem or not key.strip():
        raise c.error(problem or "the label is empty")
    if kind not in _TYPES:
        raise (kind_at or c).error(f"projection type {kind!r} is not supported; supported are {', '.join(_TYPES)}")
    width, height = (c.need(k).whole(1, 10**6) for k in ("width", "height"))
    name, keys, coefficients = _TYPES[kind]
    model = camera_models.model(name)
    side = float(max(width, height))
    values: dict[str, float] = {}
    for parameter, k in zip(model.order, keys, strict=True):
        at = c.get(k) if k else None
        value = 0.0 if at is None else at.number()
        if parameter.startswith("principal_distance"):
            if at is None or not value > 0.0:
                raise (at or c).error(f"{k} must be there and positive")
            value *= side
        elif parameter.startswith("principal_point"):
            value = value * side + 0.5 * ((width if parameter.endswith("x") else height) - 1.0)
        values[parameter] = value
    interior = ("principal_distance",) if kind == "perspective" else ("principal_distance", "principal_point")
    estimated = [p for p in model.order if p in coefficients or p.startswith(interior)]
    return camera_models.create(key, model, values, free=estimated if free else (), image_size=(float(width), float(height)))


def _shots(shots: Json, cameras: dict[str, int]) -> tuple[list[str], NDArray[np.intp], Floats, Floats]:
    labels, owner, vectors, translation = [], [], [], []
    for key, shot in shots.entries():
        problem = label_problem(key, "shot")
        if problem or not key.strip():
            raise shot.error(problem or "the label is empty")
        camera = shot.need("camera")
        if camera.word() not in cameras:
            raise camera.error(f"camera {camera.value!r} is not among the cameras")
        labels.append(key)
        owner.append(cameras[camera.value])
        vectors.append(shot.need("rotation").numbers(3))
        translation.append(shot.need("translation").numbers(3))
    return labels, np.array(owner, dtype=np.intp), rot.exp(np.array(vectors)), np.array(translation)


def _tracks(file: Path, shots: list[str], points: list[str], notes: list[str]) -> tuple[Any, Any, Floats]:
    """Return image, point and normalised coordinates of the tracks that the reconstruction uses."""
    lines = split_lines(file) if file.stat().st_size else []
    version, first = 0, 0
    if lines and lines[0].startswith(_VERSION):
        version, first = -1 if not lines[0].removeprefix(_VERSION).strip().isdigit() else int(lines[0].removeprefix(_VERSION)), 1
    if version not in _WIDTHS:
        raise InputError(f"this version of tracks is not supported; supported are v0 to v{max(_WIDTHS)}", file, 1)
    shot_of, point_of = {s: i for i, s in enumerate(shots)}, {p: i for i, p in enumerate(points)}
    image, point, xy, at = [], [], [], []
    unused = 0
    for i, line in enumerate(lines[first:], start=first + 1):
        fields = line.split("\t")
        if len(fields) != _WIDTHS[version]:
            if not line.strip():
                continue
            raise InputError(f"{len(fields)} fields, parted by tabs, where {_WIDTHS[version]} are expected: truncated?", file, i)
        shot, track = shot_of.get(fields[0]), point_of.get(fields[1])
        if shot is None or track is None:
            unused += 1
            continue
        try:
            x, y = number(fields[3]), number(fields[4])
        except ValueError:
            raise InputError(f"x and y must be numbers, not {fields[3]!r} and {fields[4]!r}", file, i) from None
        if not (abs(x) <= 1e3 and abs(y) <= 1e3):
            raise InputError(f"normalised image coordinates {x!r}, {y!r} lie beyond all images", file, i)
        image.append(shot)
        point.append(track)
        xy.append((x, y))
        at.append(i)
    if not image:
        raise InputError("no track belongs to a point and a shot of the reconstruction", file)
    images, tracks = np.array(image, dtype=np.intp), np.array(point, dtype=np.intp)
    checks.measured_once(images, tracks, points, lambda row, m: InputError(m, file, at[row]), lambda row: at[row])
    if unused:
        notes.append(f"{unused} of {unused + len(image)} track observations belong to no point or shot of the reconstruction: left out")
    return images, tracks, np.array(xy)


# ---- ground control -----------------------------------------------------------------------------------------------------------------


def _configuration(file: Path) -> dict[str, str]:
    """Return the plain ``key: value`` lines of config.yaml, lower case; anything else in it does not matter here."""
    if not file.is_file() or file.stat().st_size == 0:
        return {}
    found = (re.match(r"([a-z_]+):\s*([\w.+-]+)\s*(?:#.*)?$", line) for line in split_lines(file))
    return {m[1]: m[2].lower() for m in found if m}


def _with_control(network: Network, folder: Path, origin: Any, config: dict[str, str]) -> Network:
    """Return the network with the ground control points of the folder, if there are any."""
    sigmas = []
    for key, usual in (("gcp_horizontal_sd", "0.01"), ("gcp_vertical_sd", "0.1")):
        try:
            value = number(config.get(key, usual))
        except ValueError:
            value = float("nan")
        if not 0.0 < value < 1e6:
            raise InputError(f"{key} must be a positive number, not {config[key]!r}", folder / "config.yaml")
        sigmas.append(value)
    sigma = np.array([sigmas[0], sigmas[0], sigmas[1]])
    named = [f"{'given' if k in config else 'usual'} {v:g} m {w}" for k, v, w in zip(
        ("gcp_horizontal_sd", "gcp_vertical_sd"), sigmas, ("in plan", "in height"), strict=True)]  # fmt: skip
    frame = None if origin is None else TangentFrame(*origin)
    notes: list[str] = []
    file = folder / "ground_control_points.json"
    if file.is_file():
        marks = _json_control(read_json(file), network, frame, notes)
        network = with_marks(network, marks, sigma, notes)
    listed = folder / "gcp_list.txt"
    if listed.is_file():
        try:
            found = read_gcp_list(listed)
            network = with_marks(network, found.marks(network, frame, notes), sigma, notes)
        except MissingExtra as error:
            notes.append(f"the control points of {listed.name} are not used: {error}")
    if file.is_file() or listed.is_file():
        notes.append(f"control points have OpenSfM's standard deviations: {', '.join(named)}")
    return replace(network, assumptions=(*network.assumptions, *notes))


def _json_control(root: Json, network: Network, frame: TangentFrame | None, notes: list[str]) -> Marks:
    shot_of = {s: i for i, s in enumerate(network.images.labels)}
    labels: list[str] = []
    lla, rows, xy = [], [], []
    absent = 0
    for p in root.need("points").items():
        label = p.need("id").label()
        if label in labels:
            raise p.error(f"point {label!r} appears twice")
        position = p.get("position")
        values = [np.nan] * 3
        if position is not None:
            height = position.get("altitude")
            values = [position.need("latitude").number(), position.need("longitude").number(), finite_or_nan("")]
            if not (abs(values[0]) <= 90.0 and abs(values[1]) <= 360.0):
                raise position.error("latitude and longitude must be degrees")
            if height is not None:
                values[2] = height.number()
        for o in p.need("observations").items():
            shot = o.need("shot_id").word()
            if shot not in shot_of:
                absent += 1
                continue
            image = shot_of[shot]
            size = network.cameras[network.images.cameras[image]].image_size
            if size is None:
                raise o.error("the image size is not known")
            side = np.array(size)
            rows.append((len(labels), image))
            xy.append(o.need("projection").numbers(2) * side.max() + 0.5 * (side - 1.0))
        labels.append(label)
        lla.append(values)
    if absent:
        notes.append(f"{absent} mark(s) of control points lie in images without orientation: left out")
    table = np.array(lla).reshape(-1, 3)
    given = np.full(table.shape, np.nan)
    known = np.isfinite(table[:, :2]).all(axis=1)
    if known.any() and frame is None:
        notes.append("the reconstruction has no reference_lla: positions of control points are not used")
    elif known.any() and frame is not None:
        whole = np.where(np.isnan(table), frame.height, table)
        given[known] = frame.local(whole[known])
        given[np.isnan(table[:, 2]), 2] = np.nan
    pairs = np.array(rows, dtype=np.intp).reshape(-1, 2)
    return Marks(root.file, tuple(labels), given, pairs[:, 0], pairs[:, 1], np.array(xy).reshape(-1, 2))


opensfm = Format(
    "opensfm",
    "OpenSfM or OpenDroneMap data set (reconstruction.json, tracks.csv, control points)",
    recognises,
    read,
    write,
    positions,
    first_pixel=0.0,
)
