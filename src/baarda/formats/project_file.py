"""The header of our own project format, `project.toml`: its model, reading with line numbers, writing."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from baarda.cameras import CameraModel
from baarda.cameras.own_sets import Term, own_set, terms_of
from baarda.errors import InputError, UsageError
from baarda.formats.base import label_problem, read_text
from baarda.formats.checks import SIGMAS
from baarda.formats.project_kinds import KIND_TABLES

SCHEMA = "baarda.project/1"
FILE = "project.toml"
LARGEST = 4 * 1024**2  # bytes of a header
KINDS = ("image_points", "distances", *KIND_TABLES)
TABLES = ("cameras", "camera_parameters", "images", "points", *KINDS, "declared", "unknowns")
SETS = "camera_sets"  # key of the settings of a network under which its own sets are kept
DEFAULT_NAMES = {kind: kind.replace("_", " ") for kind in KINDS}

Finite = Annotated[float, Field(allow_inf_nan=False)]
Sigma = Annotated[float, Field(ge=SIGMAS[0], le=SIGMAS[1], allow_inf_nan=False)]
Plane = Literal["image", "corrected"]


class _Strict(BaseModel):
    # strict = no "2" for 2; lists of TOML become tuples
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class SettingsTable(_Strict):
    """Settings of the adjustment found in the project; options win over them."""

    datum: Literal["auto", "control", "inner", "minimal"] | None = None
    solver: Literal["auto", "dense", "block"] | None = None
    min_rays: Annotated[int, Field(ge=0, le=1000)] | None = None
    iterations: Annotated[int, Field(ge=1, le=100_000)] | None = None
    # a coarser one would stop anywhere
    tolerance: Annotated[float, Field(gt=0.0, le=1e-2, allow_inf_nan=False)] | None = None
    camera: tuple[str, ...] | None = None
    image_sigma: Sigma | None = None
    residual_plane: Plane | None = None
    source: dict[str, Any] = Field(default_factory=dict)

    @field_validator("camera", mode="before")
    @classmethod
    def _as_tuple(cls, value: Any) -> Any:
        return tuple(value) if isinstance(value, list) else value


class GroupTable(_Strict):
    """A group of observations: what its rows have in common."""

    name: Annotated[str, Field(min_length=1)]
    kind: Literal[
        "image_points",
        "distances",
        "directions",
        "angles",
        "height_differences",
        "camera_positions",
        "ellipsoid_heights",
        "range_doppler",
        "model_coordinates",
        "model_plan",
        "model_heights",
    ] = "image_points"
    sigma: Sigma | None = None
    residual_plane: Plane | None = None
    repeated: bool = False

    @field_validator("name")
    @classmethod
    def _plain(cls, value: str) -> str:
        problem = label_problem(value, "group")
        if problem:
            raise ValueError(problem)
        return value

    @model_validator(mode="after")
    def _of_its_kind(self) -> GroupTable:
        if self.kind != "image_points" and (self.residual_plane is not None or self.repeated):
            raise ValueError("residual_plane and repeated belong to groups of image points")
        return self


class TermTable(_Strict):
    """A parameter of an own set: what it adds to x and y, as lists of [coefficient, exponent of x, exponent of y]."""

    name: Annotated[str, Field(min_length=1)]
    x: tuple[tuple[Finite, int, int], ...] = ()
    y: tuple[tuple[Finite, int, int], ...] = ()

    @field_validator("x", "y", mode="before")
    @classmethod
    def _as_tuples(cls, value: Any) -> Any:
        return tuple(tuple(v) if isinstance(v, list) else v for v in value) if isinstance(value, list) else value


class CameraSetTable(_Strict):
    """A set of additional parameters of one's own; lengths are in units of the grid half-width."""

    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    terms: tuple[TermTable, ...]

    @field_validator("terms", mode="before")
    @classmethod
    def _as_tuple(cls, value: Any) -> Any:
        return tuple(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _makes_a_model(self) -> CameraSetTable:
        try:
            self.model()
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self

    def model(self) -> CameraModel:
        """Return the camera model of the set."""
        return own_set(self.name, [Term(t.name, t.x, t.y) for t in self.terms], self.description)


class Header(_Strict):
    """The content of `project.toml`."""

    schema_: Annotated[Literal["baarda.project/1"], Field(alias="schema")]
    name: str = ""
    unit: Annotated[str, Field(min_length=1)] = "m"
    offset: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    assumptions: tuple[str, ...] = ()
    settings: SettingsTable = SettingsTable()
    tables: dict[str, str] | None = None
    groups: tuple[GroupTable, ...] = ()
    camera_sets: tuple[CameraSetTable, ...] = ()

    @field_validator("offset", "assumptions", "groups", "camera_sets", mode="before")
    @classmethod
    def _as_tuple(cls, value: Any) -> Any:
        return tuple(value) if isinstance(value, list) else value

    @field_validator("tables")
    @classmethod
    def _plain_names(cls, value: dict[str, str] | None) -> dict[str, str] | None:
        for kind, name in (value or {}).items():
            if kind not in TABLES:
                raise ValueError(f"unknown table {kind!r}; known are {', '.join(TABLES)}")
            # a project comes from strangers: no way out of its folder
            if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*\.csv", name):
                raise ValueError(f"{kind} = {name!r} must be the plain name of a .csv file in the folder of the project")
        return value

    @field_validator("groups", "camera_sets")
    @classmethod
    def _different_names(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        names = [g.name for g in value]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{'group' if isinstance(value[0], GroupTable) else 'set'} {name!r} appears twice")
        return value


def read_header(path: Path) -> Header:
    """Read and check `project.toml`.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Header

    Raises
    ------
    InputError
        With file, line where it is known, and key.
    """
    if path.is_file() and path.stat().st_size > LARGEST:
        raise InputError(f"the file has {path.stat().st_size} bytes; the limit is {LARGEST}", path)
    text = read_text(path)
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        found = re.search(r"\(at line (\d+), column \d+\)", str(error))
        message = re.sub(r" \(at .*\)$", "", str(error))
        line = int(found[1]) if found else len(text.splitlines())
        raise InputError(f"not a TOML file: {message}", path, line) from None
    except ValueError:  # of int(): more digits than Python converts
        at = next((i for i, t in enumerate(text.splitlines(), start=1) if re.search(r"[\d_]{4000}", t)), None)
        raise InputError("not a TOML file: a whole number has too many digits", path, at) from None
    _refuse_large(content, (), text, path)
    try:
        return Header.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        message = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            message = "unknown key"
        elif first["type"] == "missing":
            message = "is missing"
        raise InputError(f"{key}: {message}", path, _line_of(text, first["loc"])) from None


def _refuse_large(value: Any, where: tuple[int | str, ...], text: str, path: Path) -> None:
    """Refuse whole numbers of more than 64 bits, which TOML does not have."""
    if isinstance(value, int) and value.bit_length() > 63:
        raise InputError(f"{'.'.join(map(str, where))}: the whole number does not fit into 64 bits", path, _line_of(text, where))
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        _refuse_large(item, (*where, key), text, path)


def _line_of(text: str, where: tuple[int | str, ...]) -> int | None:
    """Return the line that holds a key: looked for below the header of its table (the i-th of an array of tables)."""
    lines = text.splitlines()
    start = 0
    for i, part in enumerate(where):
        pattern = rf"""\s*\[+\s*["']?{re.escape(str(part))}["']?\s*[\].]"""
        nth = where[i + 1] if i + 1 < len(where) and isinstance(where[i + 1], int) else 0
        found = [k for k, line in enumerate(lines) if re.match(pattern, line)]
        if len(found) > int(nth):
            start = found[int(nth)]
    for part in (p for p in reversed(where) if isinstance(p, str)):
        for k in range(start, len(lines)):
            if re.match(rf"""\s*["']?{re.escape(part)}["']?\s*[=.]""", lines[k]):
                return k + 1
    return start + 1 if start else None


def toml_value(value: Any, what: str) -> str:
    """Return a value as TOML.

    Raises
    ------
    UsageError
        If TOML has no such value.

    Examples
    --------
    >>> print(toml_value(("a", 1, 2.5, True), "what it is"))
    ["a", 1, 2.5, true]
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float) and math.isfinite(value):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list, np.ndarray)):
        return "[" + ", ".join(toml_value(v, what) for v in value) + "]"
    raise UsageError(f"{what} = {value!r} cannot be written to {FILE}")


def header_text(
    name: str,
    unit: str,
    offset: tuple[float, ...],
    assumptions: tuple[str, ...],
    settings: dict[str, Any],
    tables: dict[str, str],
    groups: list[dict[str, Any]],
    sets: Sequence[CameraModel] = (),
) -> str:
    """Return the text of `project.toml`; settings that the format does not know go to `[settings.source]`."""
    known = [k for k in SettingsTable.model_fields if k != "source"]
    own = {k: settings[k] for k in known if settings.get(k) is not None}
    other = {k: settings[k] for k in sorted(settings) if k not in known and settings[k] is not None}
    lines = [f'schema = "{SCHEMA}"', f"name = {toml_value(name, 'name')}", f"unit = {toml_value(unit, 'unit')}"]
    if any(offset):
        lines.append(f"offset = {toml_value(offset, 'offset')}")
    if assumptions:
        lines += ["assumptions = [", *(f"  {toml_value(a, 'assumptions')}," for a in assumptions), "]"]
    for title, content in (("settings", own), ("settings.source", other), ("tables", tables)):
        if content:
            lines += ["", f"[{title}]", *(f"{_key(k)} = {toml_value(v, k)}" for k, v in content.items())]
    for group in groups:
        lines += ["", "[[groups]]", *(f"{k} = {toml_value(v, k)}" for k, v in group.items())]
    for model in sets:
        lines += ["", "[[camera_sets]]", f"name = {toml_value(model.name, 'name')}"]
        lines += [f"description = {toml_value(model.description, 'description')}", "terms = ["]
        for term in terms_of(model)[model.name]:
            axes = [f", {axis} = {toml_value(m, axis)}" for axis, m in (("x", term.x), ("y", term.y)) if m]
            lines.append(f"  {{ name = {toml_value(term.name, 'name')}{''.join(axes)} }},")
        lines.append("]")
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_value(name, "key")


def settings_of(header: Header) -> dict[str, Any]:
    """Return the settings of a project as a network keeps them, those of a foreign source beside our own."""
    own = {k: v for k, v in header.settings.model_dump(exclude={"source"}).items() if v is not None}
    sets = {SETS: tuple(t.model() for t in header.camera_sets)} if header.camera_sets else {}
    return {**own, **{k: _tuples(v) for k, v in header.settings.source.items()}, **sets}


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
