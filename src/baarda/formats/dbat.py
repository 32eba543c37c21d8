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
from baarda.formats.base import Format, Line, number, read_lines, read_text, unique, whole_number
from baarda.formats.checks import sigma_range
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
_OPERATIONS = ("check_ray_count", "spatial_resection", "forward_intersection", "bundle_adjustment")
_SETTINGS = ("set_initial_values", "set_bundle_estimate_params")


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
    min_rays = _operations(operations, path)
    described = _find(source, "cameras", path)
    count = len(described.findall("camera"))
    if count > 1:
        raise InputError(f"<cameras> has {count} cameras; only one is supported, because images do not say which one they belong to", path)
    camera, notes = _camera(_find(described, "camera", path), operations, path)
    images, image_index = _images(source, base, path)
    control = _coordinates(source.find("ctrl_pts"), base, path)
    check = _coordinates(source.find("check_pts"), base, path)
    observed, labels = _image_points(source, base, path, image_index, [*control, *check])
    points = _points(labels, control, check)
    seen = np.bincount(observed.images, minlength=len(images.labels))
    for label, line in zip(images.labels, image_index.values(), strict=True):
        if not seen[image_index_of(images, label)]:
            raise line.error(f"image {label!r} has no image points")
    settings: dict[str, Any] = {"datum": "control", "min_rays": min_rays}
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
        out = [number(t) for t in (text or "").split(",") if t.strip()]
    except ValueError:
        raise InputError(f"<{what}> is not a list of numbers: {text!r}", path) from None
    if (count is not None and len(out) != count) or not np.isfinite(out).all():
        raise InputError(f"<{what}> needs {count} finite number(s), not {text!r}", path)
    return out


def _whole(text: str, what: str, path: Path, allowed: range) -> int:
    try:
        value = whole_number(text.strip())
    except ValueError:
        raise InputError(f"{what} is not a whole number: {text!r}", path) from None
    if value not in allowed:
        raise InputError(f"{what} must be {_listed(allowed)}, not {value}", path)
    return value


def _listed(allowed: range) -> str:
    return ", ".join(map(str, allowed)) if len(allowed) < 10 else f"between {allowed[0]} and {allowed[-1]}"


def _operations(operations: ElementTree.Element | None, path: Path) -> int:
    """Check that all operations are known; return the least number of rays that the script asks for."""
    min_rays = 0
    seen: set[str] = set()
    for op in [] if operations is None else operations:
        if op.tag == "c":
            continue
        if op.tag != "operation":
            raise InputError(f"element <{op.tag}> of <operations> is not known", path)
        children = [child.tag for child in op if child.tag != "c"]
        text = (op.text or "").strip()
        if text not in (*_OPERATIONS, *([""] if children else [])):
            raise InputError(f"operation {text!r} is not known; known are {', '.join((*_OPERATIONS, *_SETTINGS))}", path)
        for tag in children:
            if tag not in _SETTINGS:
                raise InputError(f"operation <{tag}> is not known; known are {', '.join((*_OPERATIONS, *_SETTINGS))}", path)
            if tag in seen:
                raise InputError(f"operation <{tag}> appears twice", path)
            seen.add(tag)
        if text == "check_ray_count":
            min_rays = _whole(op.get("min_rays", "2"), "min_rays", path, range(1001))
    initial = None if operations is None else operations.find("./operation/set_initial_values")
    for child in [] if initial is None else initial:
        if child.tag not in ("c", "io", "eo", "op"):
            raise InputError(f"<set_initial_values>: element <{child.tag}> is not known", path)
        if child.tag != "c":
            _initial(child, path)
    return min_rays


def _initial(element: ElementTree.Element, path: Path) -> str:
    """Return where initial values come from: default or loaded."""
    others = [child.tag for child in element if child.tag not in ("c", "all")]
    word = (element.text or "").strip() or (element.findtext("all") or "").strip()
    if others or word not in ("default", "loaded"):
        wrong = f"<{others[0]}>" if others else repr(word)
        raise InputError(f"<set_initial_values><{element.tag}>: {wrong} is not known; known are default, loaded for all values", path)
    return word


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
    coefficients = _whole(text("nK") or "3", "<nK>", path, range(4))
    decentring = _whole(text("nP") or "2", "<nP>", path, range(0, 3, 2))
    if (text("unit") or "mm") != "mm":
        raise InputError(f"the <unit> of a camera must be mm, not {text('unit')!r}", path)
    for tag, most in (("K", 3), ("P", 2)):
        if len(_numbers(text(tag), tag, path)) > most:
            raise InputError(f"<{tag}> has more than {most} values: {text(tag)!r}", path)
    skew = _numbers(text("skew") or "0", "skew", path, 1)[0]

    io = None if operations is None else operations.find(".//set_initial_values/io")
    how = "loaded" if io is None else _initial(io, path)
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
        if skew and "B2" in model.order:
            values["B2"] = skew
    else:
        notes.append(
            "interior orientation starts from its defaults: nominal focal length, principal point at the sensor's centre, no distortion"
        )
    wanted = _interior_flags(operations, path)
    unused = {f"K{k}" for k in range(coefficients + 1, 4)} | ({"P1", "P2"} if decentring < 2 else set())
    free = [n for n in model.order if n in wanted and n not in unused]
    label = text("id") or "1"
    constants: dict[str, Any] = {"unit": "mm", "pixel_size": pixel, "image_size": (size[0], size[1])}
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


def _files(element: ElementTree.Element | None, base: Path, path: Path) -> list[tuple[ElementTree.Element, Path]]:
    if element is None:
        return []
    return [(f, _inside(base / (f.text or "").strip().replace("\\", "/"), path)) for f in element.findall("file")]


def _inside(file: Path, path: Path) -> Path:
    """Return the place of a table; a script from a stranger names none outside the folder that it lies in."""
    try:
        inside = file.resolve().is_relative_to(path.resolve().parent)
    except (OSError, ValueError):  # a name that no file can have
        inside = False
    if not inside:
        raise InputError(f"table {str(file)!r} lies outside the folder of the script", path)
    return file


def _columns(element: ElementTree.Element, path: Path, known: set[str], required: tuple[str, ...]) -> list[str]:
    """Return the names of the columns that a `format` lists; only `ignored` may stand there more than once."""
    columns = [c.strip() for c in element.get("format", "").split(",")]
    bad = [c for c in columns if c not in known]
    if bad:
        raise InputError(f"column {bad[0]!r} in format={element.get('format')!r} is not known; known are {', '.join(sorted(known))}", path)
    twice = [c for c in columns if c != "ignored" and columns.count(c) > 1]
    if twice:
        raise InputError(f"column {twice[0]!r} appears twice in format={element.get('format')!r}", path)
    missing = [c for c in required if c not in columns]
    if missing:
        raise InputError(f"column {missing[0]!r} is missing in format={element.get('format')!r}", path)
    return columns


def _images(source: ElementTree.Element, base: Path, path: Path) -> tuple[Images, dict[str, Line]]:
    labels, lines = [], []
    for element, file in _files(_find(source, "images", path), base, path):
        columns = _columns(element, path, {"id", "path", "label", "ignored"}, ("id", "path"))
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
    for node, file in _files(element, base, path):
        columns = _columns(node, path, names, ("id", "x", "y", "z"))
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
            sigma_range(sigmas, "a standard deviation", line.complain)
            out.append(_Given(line, line.text_at(at["id"], "point id"), xyz, sigmas))
    unique([g.label for g in out], [g.line for g in out], "point")
    for node in [] if element is None else element.findall("filter"):
        ids = {t.strip() for t in (node.get("id") or "").split(",")}
        missing = ids - {g.label for g in out}
        if missing:
            raise InputError(f"the filter names points that the table does not have: {', '.join(sorted(missing))}", path)
        if (node.text or "").strip() not in ("keep", "remove"):
            raise InputError(f"a filter must say keep or remove, not {node.text!r}", path)
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
    for element, file in _files(_find(source, "image_pts", path), base, path):
        columns = _columns(element, path, {"id", "im", "x", "y", "sx", "sy", "sxy", "ignored"}, ("id", "im", "x", "y"))
        default = _numbers(element.get("sxy"), "sxy", path, 1)[0] if element.get("sxy") else None
        at = {c: i for i, c in enumerate(columns)}
        if default is None and "sxy" not in at and not {"sx", "sy"} <= at.keys():
            raise InputError(f"column 'sxy' (or 'sx' and 'sy') is missing in format={element.get('format')!r}", path)
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
            sigma_range(sigma, "a standard deviation", line.complain)
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
