"""DBAT scripts (`<document dbat_script_version=...>`) with the text tables they name.

DBAT counts pixels from the top left corner, y down, and forms residuals in the corrected image plane; a missing or zero sigma of control
means fixed. Elements that change the adjustment and are not known here are refused by name; bookkeeping (meta, plots, output) is ignored.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from baarda import cameras
from baarda.cameras import FIXED, FREE, OBSERVED, Camera
from baarda.errors import InputError
from baarda.formats.base import Format, Line, read_lines, read_text, unique
from baarda.network import CHECK, CONTROL, TIE, Images, Network, Points
from baarda.observations import ImagePoints

MODELS = {"1": "dbat1", "2": "dbat1", "3": "brown", "4": "dbat4", "5": "dbat5", "-1": "brown-distort"}
_INTERIOR = {
    "cc": ("principal_distance",),
    "px": ("principal_point_x",),
    "py": ("principal_point_y",),
    "pp": ("principal_point_x", "principal_point_y"),
    "as": ("B1",),
    "aspect": ("B1",),
    "sk": ("B2",),
    "skew": ("B2",),
    "K": ("K1", "K2", "K3"),
    "P": ("P1", "P2"),
    **{name: (name,) for name in ("K1", "K2", "K3", "P1", "P2")},
}


@dataclass(frozen=True)
class _Given:
    """A row of a control or check point table."""

    line: Line
    label: str
    xyz: list[float]
    sigmas: list[float]


def recognises(path: Path) -> bool:
    """Tell a DBAT script by its root element."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        return b"dbat_script_version" in f.read(2000)


def read(path: Path) -> Network:
    """Read a DBAT script.

    Parameters
    ----------
    path : Path
        The XML file.

    Returns
    -------
    Network

    Raises
    ------
    InputError
        With file and line where the script or a table cannot be used.
    """
    text = read_text(path)
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError("a document type or entity declaration is not accepted", path)
    try:
        root = ElementTree.fromstring(text)  # noqa: S314  (declarations were refused above)
    except ElementTree.ParseError as error:
        raise InputError(f"not well-formed XML: {error.msg}", path, error.position[0]) from None
    source = _find(root, "input", path)
    base = _expand(source.get("base_dir", "$HERE"), path)
    known = {"c", "ctrl_pts", "check_pts", "images", "image_pts", "cameras", "prior_eo"}
    for child in source:
        if child.tag not in known:
            raise InputError(f"element <{child.tag}> of <input> is not known", path)
    operations = root.find("operations")
    camera, notes = _camera(_find(_find(source, "cameras", path), "camera", path), operations, path)
    images, image_index = _images(source, base, path)
    control = _coordinates(source.find("ctrl_pts"), base, path)
    check = _coordinates(source.find("check_pts"), base, path)
    observed, labels = _image_points(source, base, path, image_index, [*control, *check])
    points = _points(labels, control, check)
    seen = np.bincount(observed.images, minlength=len(images.labels))
    for label, line in zip(images.labels, image_index.values(), strict=True):
        if not seen[image_index_of(images, label)]:
            raise line.error(f"image {label!r} has no image points")
    settings: dict[str, Any] = {"datum": "control", "min_rays": 0}
    for op in [] if operations is None else operations.findall("operation"):
        if (op.text or "").strip() == "check_ray_count":
            settings["min_rays"] = int(op.get("min_rays", "2"))
    _exterior_flags(operations, path)
    name = (root.findtext("meta/name") or path.stem).strip()
    unit = (root.findtext("meta/project_unit") or "m").strip()
    notes.append("DBAT forms residuals in the corrected image plane; so do we here (residual_plane = corrected)")
    return Network((camera,), images, points, (observed,), unit=unit, name=name, settings=settings, assumptions=tuple(notes))


def image_index_of(images: Images, label: str) -> int:
    """Return the index of an image label."""
    return images.labels.index(label)


def _find(parent: ElementTree.Element, tag: str, path: Path) -> ElementTree.Element:
    child = parent.find(tag)
    if child is None:
        raise InputError(f"element <{tag}> is missing in <{parent.tag}>", path)
    return child


def _expand(folder: str, path: Path) -> Path:
    folder = folder.replace("$HERE", str(path.resolve().parent))
    if folder.startswith("$"):
        raise InputError(f"folder {folder!r} is not known on this machine", path)
    return Path(folder)


def _numbers(text: str | None, what: str, path: Path, count: int | None = None) -> list[float]:
    try:
        out = [float(t) for t in (text or "").split(",") if t.strip()]
    except ValueError:
        raise InputError(f"<{what}> is not a list of numbers: {text!r}", path) from None
    if (count is not None and len(out) != count) or not np.isfinite(out).all():
        raise InputError(f"<{what}> needs {count} finite number(s), not {text!r}", path)
    return out


def _camera(element: ElementTree.Element, operations: ElementTree.Element | None, path: Path) -> tuple[Camera, list[str]]:
    def text(tag: str) -> str:
        return (element.findtext(tag) or "").strip()

    number = text("model") or "3"
    if number not in MODELS:
        raise InputError(f"lens distortion model {number!r} is not known; known are {', '.join(MODELS)}", path)
    model = cameras.model(MODELS[number])
    size = _numbers(text("image"), "image", path, 2)
    aspect = _numbers(text("aspect") or "1", "aspect", path, 1)[0]
    sensor = text("sensor").split(",")
    if len(sensor) != 2 or sensor[1].strip() == "auto":
        raise InputError(f"<sensor> needs width and height, the width may be auto: {text('sensor')!r}", path)
    height = _numbers(sensor[1], "sensor", path, 1)[0]
    width = height / size[1] * size[0] * aspect if sensor[0].strip() == "auto" else _numbers(sensor[0], "sensor", path, 1)[0]
    if min(*size, height, width) <= 0:
        raise InputError("<image> and <sensor> must be positive", path)
    pixel = np.array([width / size[0], height / size[1]])
    coefficients, decentring = int(text("nK") or 3), int(text("nP") or 2)

    io = None if operations is None else operations.find(".//set_initial_values/io")
    how = "loaded" if io is None else ((io.text or "").strip() or (io.findtext("all") or "").strip())
    values: dict[str, float] = {"principal_distance": 0.0, "principal_point_x": width / 2, "principal_point_y": height / 2}
    focal = text("cc") if how == "loaded" and text("cc") else text("focal") or text("cc")
    values["principal_distance"] = _numbers(focal, "focal", path, 1)[0]
    if values["principal_distance"] <= 0:
        raise InputError("the principal distance must be positive", path)
    notes = []
    if how == "loaded":
        if text("pp"):
            values["principal_point_x"], values["principal_point_y"] = _numbers(text("pp"), "pp", path, 2)
        for tag in ("K", "P"):
            for k, v in enumerate(_numbers(text(tag), tag, path), start=1):
                values[f"{tag}{k}"] = v
        if float(text("skew") or 0) and "B2" in model.order:
            values["B2"] = float(text("skew"))
    else:
        notes.append(
            "interior orientation starts from its defaults: nominal focal length, principal point at the sensor's centre, no distortion"
        )
    wanted = _interior_flags(operations, path)
    unused = {f"K{k}" for k in range(coefficients + 1, 4)} | ({"P1", "P2"} if decentring < 2 else set())
    free = [n for n in model.order if n in wanted and n not in unused]
    label = text("id") or "1"
    constants: dict[str, Any] = {"unit": text("unit") or "mm", "pixel_size": pixel, "image_size": (size[0], size[1])}
    return cameras.create(label, model, {k: v for k, v in values.items() if k in model.order}, free=free, **constants), notes


def _interior_flags(operations: ElementTree.Element | None, path: Path) -> set[str]:
    """Return the interior parameters that the script estimates."""
    io = None if operations is None else operations.find(".//set_bundle_estimate_params/io")
    everything = {n for names in _INTERIOR.values() for n in names}
    if io is None:
        return set()
    if (io.text or "").strip():
        return everything if (io.text or "").strip() == "true" else set()
    out: set[str] = set()
    for child in io:
        value = (child.text or "").strip()
        names = everything if child.tag == "all" else set(_INTERIOR.get(child.tag, ()))
        if child.tag != "c" and (not names or value not in ("true", "false")):
            raise InputError(f"<set_bundle_estimate_params><io>: <{child.tag}>{value}</{child.tag}> is not known", path)
        out = out | names if value == "true" else out - names
    return out


def _exterior_flags(operations: ElementTree.Element | None, path: Path) -> None:
    for tag, allowed in (("eo", ("true",)), ("op", ("default", "true"))):
        element = None if operations is None else operations.find(f".//set_bundle_estimate_params/{tag}")
        if element is None:
            continue
        values = (
            [(element.text or "").strip()] if (element.text or "").strip() else [(e.text or "").strip() for e in element if e.tag != "c"]
        )
        if any(v not in allowed for v in values):
            raise InputError(f"<set_bundle_estimate_params><{tag}> {values} is not supported; supported: {', '.join(allowed)}", path)


def _files(element: ElementTree.Element | None, base: Path) -> list[tuple[ElementTree.Element, Path]]:
    if element is None:
        return []
    return [(f, base / (f.text or "").strip().replace("\\", "/")) for f in element.findall("file")]


def _columns(element: ElementTree.Element, path: Path, known: set[str]) -> list[str]:
    columns = [c.strip() for c in element.get("format", "").split(",")]
    bad = [c for c in columns if c not in known]
    if bad:
        raise InputError(f"column {bad[0]!r} in format={element.get('format')!r} is not known; known are {', '.join(sorted(known))}", path)
    return columns


def _images(source: ElementTree.Element, base: Path, path: Path) -> tuple[Images, dict[str, Line]]:
    labels, lines = [], []
    for element, file in _files(_find(source, "images", path), base):
        columns = _columns(element, path, {"id", "path", "label", "ignored"})
        for line in read_lines(file):
            labels.append(line.text_at(columns.index("id"), "image id"))
            lines.append(line)
    unique(labels, lines, "image")
    if not labels:
        raise InputError("the script names no images", path)
    return Images.make(labels), dict(zip(labels, lines, strict=True))


def _coordinates(element: ElementTree.Element | None, base: Path, path: Path) -> list[_Given]:
    """Read control or check points, filters applied."""
    out = []
    names = {"id", "label", "x", "y", "z", "sx", "sy", "sz", "sxy", "sxyz", "ignored"}
    for node, file in _files(element, base):
        columns = _columns(node, path, names)
        for line in read_lines(file):
            if len(line.fields) != len(columns):
                raise line.error(f"{len(line.fields)} fields where the format {node.get('format')!r} has {len(columns)}")
            at = {c: i for i, c in enumerate(columns)}
            xyz = [line.number_at(at[c], c) for c in "xyz"]
            sigmas = []
            for axis in ("sx", "sy", "sz"):
                choice = next((c for c in (axis, "sxy" if axis != "sz" else axis, "sxyz") if c in at), None)
                sigmas.append(0.0 if choice is None else line.number_at(at[choice], choice))
            if min(sigmas) < 0:
                raise line.error(f"a standard deviation is negative: {min(sigmas)}")
            out.append(_Given(line, line.text_at(at["id"], "point id"), xyz, sigmas))
    unique([g.label for g in out], [g.line for g in out], "point")
    for node in [] if element is None else element.findall("filter"):
        ids = {t.strip() for t in (node.get("id") or "").split(",")}
        missing = ids - {g.label for g in out}
        if missing:
            raise InputError(f"the filter names points that the table does not have: {', '.join(sorted(missing))}", path)
        keep = (node.text or "").strip() == "keep"
        out = [g for g in out if (g.label in ids) == keep]
    return out


def _image_points(
    source: ElementTree.Element, base: Path, path: Path, images: dict[str, Line], given: list[_Given]
) -> tuple[ImagePoints, list[str]]:
    place = {label: i for i, label in enumerate(images)}
    points: dict[str, int] = {}
    rows: list[tuple[int, int, float, float, float, float]] = []
    first: dict[tuple[int, int], Line] = {}
    for element, file in _files(_find(source, "image_pts", path), base):
        columns = _columns(element, path, {"id", "im", "x", "y", "sx", "sy", "sxy", "ignored"})
        default = _numbers(element.get("sxy"), "sxy", path, 1)[0] if element.get("sxy") else None
        at = {c: i for i, c in enumerate(columns)}
        for line in read_lines(file):
            if len(line.fields) != len(columns):
                raise line.error(f"{len(line.fields)} fields where the format {element.get('format')!r} has {len(columns)}")
            image, point = line.text_at(at["im"], "image id"), line.text_at(at["id"], "point id")
            if image not in place:
                raise line.error(f"image {image!r} is not in the list of images")
            key = (place[image], points.setdefault(point, len(points)))
            if key in first:
                raise line.error(f"point {point!r} is measured twice in image {image!r} (first in line {first[key].number})")
            first[key] = line
            sigma = [default if default is not None else line.number_at(at[c if c in at else "sxy"], c) for c in ("sx", "sy")]
            if min(sigma) <= 0:
                raise line.error(f"a standard deviation must be positive, not {min(sigma)}")
            rows.append((*key, line.number_at(at["x"], "x"), line.number_at(at["y"], "y"), sigma[0], sigma[1]))
    if not rows:
        raise InputError("the script names no image points", path)
    for g in given:
        points.setdefault(g.label, len(points))
    table = np.array(rows)
    return (
        ImagePoints.make(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:4], table[:, 4:6], residual_plane="corrected"),
        list(points),
    )


def _points(labels: list[str], control: list[_Given], check: list[_Given]) -> Points:
    n = len(labels)
    index = {label: i for i, label in enumerate(labels)}
    roles = np.full(n, TIE, dtype=np.int8)
    states = np.full((n, 3), FREE, dtype=np.int8)
    coordinates, given, sigmas = (np.full((n, 3), np.nan) for _ in range(3))
    for rows, role in ((control, CONTROL), (check, CHECK)):
        for g in rows:
            i = index[g.label]
            if roles[i] != TIE:
                raise g.line.error(f"point {g.label!r} is both control and check point")
            roles[i], given[i], sigmas[i] = role, g.xyz, g.sigmas
            if role == CONTROL:
                coordinates[i] = g.xyz
                states[i] = np.where(sigmas[i] > 0, OBSERVED, FIXED)
    return Points.make(labels, coordinates, roles, states, given, sigmas)


dbat = Format("dbat", "DBAT script (XML) with its text tables", recognises, read)
