"""GNU Gama local networks (`<gama-local>`, .gkf): directions, angles, azimuths, horizontal distances, height differences.

Gama counts x and y along the axes that ``axes-xy`` names, angles in gon, their standard deviations in 0.1 mgon (cc), those of lengths in
mm. Left-handed axes (ne, sw, es, wn) become X = y, Y = x, so that bearings count clockwise from +Y; the numbers stay as they are.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE
from baarda.errors import InputError
from baarda.formats.base import Format, label_problem, number, read_text
from baarda.formats.checks import sigma_range
from baarda.formats.gama_start import Sights, complete
from baarda.network import CONTROL, TIE, Images, Network, Points
from baarda.observations import Angles, Directions, Distances, HeightDifferences, stations

Floats = NDArray[np.float64]

GON = np.pi / 200.0
CC, MM = 1e-4 * GON, 1e-3
_LEFT, _RIGHT = ("ne", "sw", "es", "wn"), ("en", "nw", "se", "ws")
_AZIMUTHS = {"n": 0.0, "e": 100.0, "s": 200.0, "w": 300.0}
_DEEPEST = 20
_IGNORED = ("description", "parameters")
AZIMUTHS = "azimuths"


@dataclass
class _Element:
    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list[_Element] = field(default_factory=list)

    def error(self, message: str) -> InputError:
        return InputError(f"<{self.tag}>: {message}", self.file, self.line)

    def text(self, name: str) -> str:
        value = self.attributes.get(name, "").strip()
        if not value:
            raise self.error(f"attribute {name} is missing")
        problem = label_problem(value, name)
        if problem:
            raise self.error(problem)
        return value

    def value(self, name: str, default: float | None = None) -> float:
        if default is not None and name not in self.attributes:
            return default
        text = self.text(name)
        try:
            found = number(text)
        except ValueError:
            hint = " (degrees are not supported, gon are)" if re.fullmatch(r"[+-]?\d+-\d+-[\d.]+", text) else ""
            raise self.error(f"{name} is not a number: {text!r}{hint}") from None
        if not abs(found) < 1e12:
            raise self.error(f"{name} is not finite or too large: {text!r}")
        return found


def recognises(path: Path) -> bool:
    """Tell a Gama network by its root element."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        return re.search(rb"<gama-local[\s>]", f.read(4000)) is not None


def read(path: Path) -> Network:
    """Read a Gama network.

    Parameters
    ----------
    path : Path
        The XML file.

    Returns
    -------
    Network
        No images; heights of plane points, and plane coordinates of levelled points, are fixed at 0.

    Raises
    ------
    InputError
        With file and line, also for elements that are not supported: they would change the adjustment.
    """
    network = _child(_parse(path), "network")
    axes, turn = network.attributes.get("axes-xy", "ne"), network.attributes.get("angles", "left-handed")
    if axes not in _LEFT + _RIGHT or turn not in ("left-handed", "right-handed"):
        raise network.error(f"axes-xy={axes!r} angles={turn!r} is not known")
    apriori = next((c.value("sigma-apr", 10.0) for c in network.children if c.tag == "parameters"), 10.0)
    if not apriori > 0.0:
        raise network.error("sigma-apr must be positive")
    for child in network.children:
        if child.tag not in (*_IGNORED, "points-observations"):
            raise child.error("the element is not supported")
    return _Reader(_child(network, "points-observations"), axes, turn, apriori).network()


class _Reader:
    """Points and observations while they are collected."""

    def __init__(self, body: _Element, axes: str, turn: str, apriori: float) -> None:
        self.body, self.apriori, self.swapped = body, apriori, axes in _LEFT
        self.clockwise = 1.0 if turn == "left-handed" else -1.0
        self.north = -_AZIMUTHS[axes[0] if self.swapped else axes[1]] * GON  # bearing of north from +Y
        self.notes = [f"axes {axes} of Gama: X = {'y, Y = x' if self.swapped else 'x, Y = y'}"]
        self.points: dict[str, _Element] = {}
        for element in body.children:
            if element.tag == "point":
                label = element.text("id")
                if label in self.points:
                    raise element.error(f"point {label!r} appears twice (first in line {self.points[label].line})")
                self.points[label] = element
        self.index = {label: i for i, label in enumerate(self.points)}
        self.sets: list[str] = []  # stations of the sets of directions
        self.rows: dict[str, list[tuple[Any, ...]]] = {k: [] for k in ("direction", "azimuth", "distance", "angle", "dh")}
        self.lines: dict[str, list[_Element]] = {k: [] for k in self.rows}

    def network(self) -> Network:
        for element in self.body.children:
            if element.tag == "obs":
                self._cluster(element, element.attributes.get("from"))
            elif element.tag == "height-differences":
                self._cluster(element, None)
            elif element.tag != "point":
                raise element.error("the element is not supported")
        points, plane = self._points()
        xy, orientations = complete(points.coordinates[:, :2], plane, self._sights(), len(self.sets))
        self._all_found(xy, plane, orientations)
        z = self._heights(points)
        groups = list(self._groups())
        if not groups:
            raise self.body.error("the network has no observations")
        fixed = np.append(np.full(len(self.sets), FREE), FIXED)
        labels = [*_numbered(self.sets), AZIMUTHS]
        values = np.append(orientations, self.north)
        keep = slice(None) if self.rows["azimuth"] else slice(0, len(self.sets))
        declared = (stations(labels[keep], values[keep], fixed[keep]),) if len(values[keep]) else ()
        given = np.where(points.roles[:, None] == CONTROL, np.column_stack([xy, z]), np.nan)
        table = Points(points.labels, np.column_stack([xy, z]), points.roles, points.states, given, points.sigmas, points.correlations)
        return Network(
            (),
            Images.make([]),
            table,
            tuple(groups),
            settings={"min_rays": 0},
            assumptions=tuple(self.notes),
            declared=declared,
        )

    def _points(self) -> tuple[Points, NDArray[np.bool_]]:
        """Return the points as given, and which of them have plane coordinates."""
        n = len(self.points)
        start, states, plane = np.full((n, 3), np.nan), np.full((n, 3), FIXED, dtype=np.int8), np.zeros(n, dtype=bool)
        constrained = 0
        for i, element in enumerate(self.points.values()):
            adjusted, fixed = (element.attributes.get(k, "").strip() for k in ("adj", "fix"))
            both = (adjusted + fixed).lower()
            if any(c not in "xyz" for c in both) or len(set(both)) < len(both) or ("x" in both) != ("y" in both):
                raise element.error(f"adj={adjusted!r} fix={fixed!r} must name x and y together, and z, each once")
            if ("x" in adjusted.lower()) != ("y" in adjusted.lower()):
                raise element.error("x and y must be adjusted or fixed together")
            constrained += any(c.isupper() for c in adjusted)
            plane[i] = "x" in both
            place = dict(zip("xyz", ((1, 0, 2) if self.swapped else (0, 1, 2)), strict=True))
            for axis, k in place.items():
                if axis in element.attributes:
                    start[i, k] = element.value(axis)
                if axis in adjusted.lower():
                    states[i, k] = FREE
                if axis in fixed and axis not in element.attributes:
                    raise element.error(f"{axis} is fixed, but not given")
            start[i, :2] = start[i, :2] if plane[i] else 0.0
            start[i, 2] = start[i, 2] if "z" in both else 0.0
        if constrained:
            self.notes.append(f"{constrained} point(s) carry Gama's mark of constrained coordinates; inner constraints are over all points")
        roles = np.where([bool(e.attributes.get("fix", "").strip()) for e in self.points.values()], CONTROL, TIE)
        return Points.make(list(self.points), start, roles, states), plane

    def _cluster(self, cluster: _Element, station: str | None) -> None:
        """Read an <obs> or <height-differences> element."""
        mine = -1
        for e in cluster.children:
            if e.tag not in self.rows:
                raise e.error("the element is not supported")
            start = self._point(e, e.attributes.get("from", station), "from")
            ends: tuple[int, ...]
            if e.tag == "angle":
                ends = (self._point(e, e.attributes.get("bs"), "bs"), self._point(e, e.attributes.get("fs"), "fs"))
            else:
                ends = (self._point(e, e.attributes.get("to"), "to"),)
            if len({start, *ends}) < 1 + len(ends):
                raise e.error("station and targets must be different points")
            value = e.value("val")
            if e.tag == "direction":
                if mine < 0:
                    mine = len(self.sets)
                    self.sets.append(cluster.text("from"))
                row: tuple[Any, ...] = (mine, start, *ends, self.clockwise * value * GON)
            elif e.tag == "azimuth":
                row = (-1, start, *ends, value * GON)  # the set is numbered when all are known
            else:
                row = (start, *ends, self.clockwise * value * GON if e.tag == "angle" else value)
            if e.tag == "distance" and not value > 0.0:
                raise e.error("a distance must be positive")
            sigma = self._sigma(e, value)
            sigma_range([sigma], "stdev", lambda _row, message, e=e: e.error(message))  # type: ignore[misc]
            if not sigma > 0.0:
                raise e.error("the standard deviation must be positive")
            self.rows[e.tag].append((*row, sigma))
            self.lines[e.tag].append(e)

    def _point(self, element: _Element, label: str | None, name: str) -> int:
        if label is None or label.strip() not in self.index:
            raise element.error(f"attribute {name} is missing" if label is None else f"unknown point {label.strip()!r}")
        return self.index[label.strip()]

    def _sigma(self, e: _Element, value: float) -> float:
        """Return the standard deviation in radians or metres."""
        if e.tag == "dh":
            if "stdev" not in e.attributes and "dist" not in e.attributes:
                raise e.error("neither stdev nor dist (km) is given")
            return MM * (e.value("stdev") if "stdev" in e.attributes else self.apriori * float(np.sqrt(max(e.value("dist"), 0.0))))
        if "stdev" in e.attributes:
            return e.value("stdev") * (MM if e.tag == "distance" else CC)
        usual = self.body.attributes.get(f"{e.tag}-stdev")
        if usual is None:
            raise e.error(f"no stdev here, and no {e.tag}-stdev of <points-observations>")
        try:
            parts = [number(t) for t in usual.split()]
        except ValueError:
            parts = []
        if e.tag != "distance" and len(parts) == 1:
            return parts[0] * CC
        if e.tag == "distance" and 1 <= len(parts) <= 3:
            a, b, c = (*parts, *(0.0, 0.0, 1.0)[len(parts) :])
            return MM * (a + b * float((value / 1000.0) ** c))
        raise self.body.error(f"{e.tag}-stdev is not understood: {usual!r}")

    def _sights(self) -> Sights:
        directions = [(s, i, j, v) for s, i, j, v, _ in self.rows["direction"]]
        azimuths = [(i, j, v + self.north) for _, i, j, v, _ in self.rows["azimuth"]]
        distances = [(i, j, v) for i, j, v, _ in self.rows["distance"]]
        angles = [(i, j, k, v) for i, j, k, v, _ in self.rows["angle"]]
        return Sights(directions, azimuths, distances, angles)

    def _all_found(self, xy: Floats, plane: NDArray[np.bool_], orientations: Floats) -> None:
        elements = list(self.points.values())
        lost = np.flatnonzero(~np.isfinite(xy).all(axis=1))
        if len(lost):
            names = ", ".join(e.text("id") for e in (elements[i] for i in lost[:12]))
            raise elements[lost[0]].error(f"no start values found for the x and y of {len(lost)} point(s) ({names}); give x and y")
        for kind, rows in self.rows.items():
            for row, e in zip(rows, self.lines[kind], strict=True):
                ends = [i for i in row[:-2] if kind != "dh"][kind in ("direction", "azimuth") :]
                wrong = next((i for i in ends if not plane[i]), None)
                if wrong is not None:
                    raise e.error(f"point {elements[wrong].text('id')!r} has no x and y (neither fix nor adj)")
                if kind == "distance" and any(elements[i].attributes.get(k, "").lower().count("z") for i in ends for k in ("adj", "fix")):
                    raise e.error("horizontal distances between points with heights are not supported")
        unknown = np.flatnonzero(~np.isfinite(orientations))
        if len(unknown):
            raise self.body.error(f"no start value found for the orientation of station {self.sets[unknown[0]]!r}")

    def _heights(self, points: Points) -> Floats:
        """Carry heights along the levelling lines."""
        z = np.array(points.coordinates[:, 2])
        lines = [(i, j, v) for i, j, v, _ in self.rows["dh"]]
        changed = True
        while changed and np.isnan(z).any():
            changed = False
            for i, j, v in lines:
                if np.isnan(z[i]) != np.isnan(z[j]):
                    z[i], z[j] = (z[j] - v, z[j]) if np.isnan(z[i]) else (z[i], z[i] + v)
                    changed = True
        lost = np.flatnonzero(np.isnan(z))
        if len(lost):
            raise list(self.points.values())[lost[0]].error("no start value found for z; give it, or level the point")
        return z

    def _groups(self) -> Iterator[Any]:
        def columns(kind: str) -> list[Any]:
            return [np.array(c) for c in zip(*self.rows[kind], strict=True)]

        if self.rows["direction"]:
            yield Directions(*columns("direction"))
        if self.rows["azimuth"]:
            _, starts, ends, values, sigmas = columns("azimuth")
            yield Directions(np.full(len(starts), len(self.sets)), starts, ends, values, sigmas, name=AZIMUTHS)
        if self.rows["angle"]:
            yield Angles(*columns("angle"))
        if self.rows["distance"]:
            yield Distances(*columns("distance"))
        if self.rows["dh"]:
            yield HeightDifferences(*columns("dh"))


def _numbered(labels: list[str]) -> list[str]:
    """Return labels that differ: the second set of station A is ``A (2)``."""
    out, count = [], dict.fromkeys(labels, 0)
    for label in labels:
        count[label] += 1
        out.append(label if count[label] == 1 else f"{label} ({count[label]})")
    return out


def _child(parent: _Element, tag: str) -> _Element:
    found = [c for c in parent.children if c.tag == tag]
    if len(found) != 1:
        raise parent.error(f"there must be one element <{tag}>, there are {len(found)}")
    return found[0]


def _parse(path: Path) -> _Element:
    """Return the root element with the line of every element; declarations of entities are refused."""
    text = read_text(path)
    root = _Element("", {}, path, 1)
    stack = [root]
    parser = expat.ParserCreate()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > _DEEPEST:
            raise InputError(f"elements are nested more than {_DEEPEST} deep", path, parser.CurrentLineNumber)
        element = _Element(tag, attributes, path, parser.CurrentLineNumber)
        stack[-1].children.append(element)
        stack.append(element)

    def declaration(*_: Any) -> None:
        raise InputError("a document type or entity declaration is not accepted", path, parser.CurrentLineNumber)

    handlers: dict[str, Callable[..., Any]] = {
        "StartElementHandler": begin,
        "EndElementHandler": lambda tag: stack.pop(),
        "StartDoctypeDeclHandler": declaration,
        "EntityDeclHandler": declaration,
    }
    for name, handler in handlers.items():
        setattr(parser, name, handler)
    try:
        parser.Parse(text.encode("utf-8"), True)
    except expat.ExpatError as error:
        raise InputError(f"not well-formed XML: {expat.errors.messages[error.code]}", path, error.lineno) from None
    return _child(root, "gama-local")


gama = Format("gama", "GNU Gama local network (.gkf)", recognises, read)
