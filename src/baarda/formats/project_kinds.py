"""Tables of a project for observation kinds whose rows are points, nodes of declared unknowns, a value and a sigma; and those unknowns.

Who adds such a kind adds one line to `KIND_TABLES`; who declares unknowns adds their class to `DECLARED`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FREE, OBSERVED, STATES
from baarda.errors import InputError, UsageError
from baarda.formats.base import label_problem
from baarda.formats.checks import correlations, sigma_range
from baarda.formats.csv_table import CsvTable, numbers_text, quoted
from baarda.formats.vector_tables import VECTOR_TABLES, VectorTable
from baarda.network import AXES, Declared, Images, Network, Points
from baarda.observations import (
    Angles,
    CameraPositions,
    Directions,
    EllipsoidHeights,
    HeightDifferences,
    LeverArms,
    Models,
    Stations,
    Strips,
    Tracks,
)

Floats = NDArray[np.float64]
Columns = dict[str, list[str]]


@dataclass(frozen=True)
class KindTable:
    """How the rows of a kind are written.

    Attributes
    ----------
    kind : str
        Name of the table, and of the kind in `project.toml`.
    group : type
        Class of the observation group.
    points : mapping
        Column to attribute, of indices of object points; they differ within a row.
    nodes : mapping
        Column to attribute and unknown group, of nodes of declared unknowns.
    in_units : bool
        Whether values are in object units; else they are in radians.
    """

    kind: str
    group: type[Any]
    points: Mapping[str, str]
    nodes: Mapping[str, tuple[str, str]]
    in_units: bool

    @property
    def name(self) -> str:
        """Name of a group of which none is given."""
        return self.kind.replace("_", " ")

    @property
    def columns(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Required and optional columns."""
        return (*self.nodes, *self.points, "value"), ("group", "sigma")

    def write(self, group: Any, network: Network) -> Columns:
        """Return the columns of a group."""
        labels = [quoted(t) for t in network.points.labels]
        out = {"group": [quoted(group.name)] * len(group)}
        for column, (attribute, kind) in self.nodes.items():
            nodes = next(d for d in network.declared if d.kind == kind).labels
            out[column] = [quoted(nodes[i]) for i in getattr(group, attribute).tolist()]
        for column, attribute in self.points.items():
            out[column] = [labels[i] for i in getattr(group, attribute).tolist()]
        return {**out, "value": numbers_text(group.values), "sigma": numbers_text(group.sigmas)}

    def read(self, table: CsvTable | None, usual: Floats, images: Images, points: Points, unit: str, declared: tuple[Declared, ...]) -> Any:
        """Return all rows of a table as one group, checked; an empty one without a table.

        Raises
        ------
        InputError
            With file and line.
        """
        more = {"unit": unit} if self.in_units else {}
        names = (*(a for a, _ in self.nodes.values()), *self.points.values())
        if table is None:
            nothing = np.zeros(0, dtype=np.intp)
            return self.group(**dict.fromkeys(names, nothing), values=np.zeros(0), sigmas=np.zeros(0), **more)
        codes = {}
        for column, (attribute, kind) in self.nodes.items():
            nodes = next((d.labels for d in declared if d.kind == kind), ())
            codes[attribute] = table.codes(column, {t: i for i, t in enumerate(nodes)}, kind)
        index = {t: i for i, t in enumerate(points.labels)}
        ends = [table.codes(column, index, "point") for column in self.points]
        sorted_ends = np.sort(np.stack(ends, axis=1), axis=1)
        _refuse(table, (np.diff(sorted_ends, axis=1) == 0).any(axis=1), f"the points of {self.name} must be different")
        values, sigma = table.numbers("value", None), table.sigmas("sigma")
        sigma = np.where(np.isnan(sigma), usual, sigma)
        _refuse(table, ~(sigma > 0.0), "sigma must be there and positive")
        sigma_range(sigma, "sigma", table.error)
        return self.group(**codes, **dict(zip(self.points.values(), ends, strict=True)), values=values, sigmas=sigma, **more)


_PAIRS = ((0, 1), (0, 2), (1, 2))
_CORRELATIONS = tuple(f"correlation_{AXES[i]}{AXES[j]}" for i, j in _PAIRS)


@dataclass(frozen=True)
class PositionTable:
    """How camera positions are written: image, nodes of lever arm and strip, time, coordinates, standard deviations, correlations."""

    kind: str = "camera_positions"
    name: str = "camera positions"
    group: type[Any] = CameraPositions

    @property
    def columns(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Required and optional columns."""
        return ("image", "lever_arm", "strip", "time", *AXES), ("group", *(f"sigma_{a}" for a in AXES), *_CORRELATIONS)

    def write(self, group: CameraPositions, network: Network) -> Columns:
        """Return the columns of a group."""
        arms, lines = (next(d for d in network.declared if d.kind == kind).labels for kind in ("lever_arm", "strip"))
        sigma = group.sigma()
        correlation = [group.covariances[:, i, j] / (sigma[:, i] * sigma[:, j]) for i, j in _PAIRS]
        return {
            "group": [quoted(group.name)] * len(group),
            "image": [quoted(network.images.labels[i]) for i in group.images.tolist()],
            "lever_arm": [quoted(arms[i]) for i in group.arms.tolist()],
            "strip": [quoted(lines[i]) for i in group.lines.tolist()],
            "time": numbers_text(group.times),
            **{a: numbers_text(group.values[:, k]) for k, a in enumerate(AXES)},
            **{f"sigma_{a}": numbers_text(sigma[:, k]) for k, a in enumerate(AXES)},
            **{name: numbers_text(r) for name, r in zip(_CORRELATIONS, correlation, strict=True)},
        }

    def read(
        self, table: CsvTable | None, usual: Floats, images: Images, points: Points, unit: str, declared: tuple[Declared, ...]
    ) -> CameraPositions:
        """Return all rows of a table as one group, checked; an empty one without a table."""
        if table is None:
            nothing = np.zeros(0, dtype=np.intp)
            return CameraPositions(nothing, nothing, nothing, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)), unit)
        nodes = {d.kind: {t: i for i, t in enumerate(d.labels)} for d in declared}
        image = table.codes("image", {t: i for i, t in enumerate(images.labels)}, "image")
        arm, line = (table.codes(kind, nodes.get(kind, {}), kind.replace("_", " ")) for kind in ("lever_arm", "strip"))
        values = np.stack([table.numbers(a, None) for a in AXES], axis=1)
        sigma = np.stack([table.sigmas(f"sigma_{a}") for a in AXES], axis=1)
        sigma = np.where(np.isnan(sigma), usual[:, None], sigma)
        _refuse(table, np.asarray((~(sigma > 0.0)).any(axis=1)), "the sigmas of a camera position must be there and positive")
        sigma_range(sigma, "the sigma of a camera position", table.error)
        r = np.stack([table.numbers(name, 0.0) for name in _CORRELATIONS], axis=1)
        correlations(r, table.error)
        c = np.broadcast_to(np.eye(3), (len(image), 3, 3)).copy()
        for k, (i, j) in enumerate(_PAIRS):
            c[:, i, j] = c[:, j, i] = r[:, k]
        c = c * sigma[:, :, None] * sigma[:, None, :]
        return CameraPositions(image, arm, line, table.numbers("time", None), values, c, unit)


KIND_TABLES: dict[str, KindTable | PositionTable | VectorTable] = {
    t.kind: t
    for t in (
        PositionTable(),
        KindTable("directions", Directions, {"from": "starts", "to": "ends"}, {"station": ("sets", "station")}, in_units=False),
        KindTable("angles", Angles, {"from": "starts", "back": "backs", "fore": "fores"}, {}, in_units=False),
        KindTable("height_differences", HeightDifferences, {"from": "starts", "to": "ends"}, {}, in_units=True),
        KindTable("ellipsoid_heights", EllipsoidHeights, {"point": "points"}, {}, in_units=True),
        *VECTOR_TABLES,
    )
}
DECLARED: dict[str, type[Declared]] = {"station": Stations, "lever_arm": LeverArms, "strip": Strips, "track": Tracks, "model": Models}
DECLARED_COLUMNS = (("kind", "node", "parameter"), ("value", "unit", "state", "given", "sigma"))


def kind_table_of(group: Any) -> KindTable | PositionTable | VectorTable:
    """Return the table of an observation group.

    Raises
    ------
    UsageError
        If there is none for its kind.
    """
    found = next((t for t in KIND_TABLES.values() if type(group) is t.group), None)
    if found is None:
        raise UsageError(f"observations of the kind {type(group).__name__} cannot be written to a project")
    return found


def declared_columns(declared: tuple[Declared, ...]) -> Columns:
    """Return the columns of the table of declared unknowns.

    Raises
    ------
    UsageError
        If a label cannot be written, or a kind could not be read back.
    """
    out: Columns = {name: [] for name in ("kind", "node", "parameter", "value", "unit", "state", "given", "sigma")}
    for d in declared:
        if d.kind not in DECLARED:
            raise UsageError(f"unknowns of the kind {d.kind!r} cannot be written to a project")
        if len(set(d.labels)) < len(d.labels):
            raise UsageError(f"two unknowns of the kind {d.kind!r} have the same label")
        for node, label in enumerate(d.labels):
            problem = label_problem(label, d.kind)
            if problem or not label:
                raise UsageError(f"{problem or f'a {d.kind} has an empty label'}: it cannot be written")
            for k, name in enumerate(d.parameters[node if len(d.parameters) > 1 else 0]):
                row = (quoted(d.kind), quoted(label), quoted(name), quoted(d.unit_of(node, k)), STATES[d.states[d.offsets[node] + k]])
                for column, text in zip(("kind", "node", "parameter", "unit", "state"), row, strict=True):
                    out[column].append(text)
        for name, numbers in (("value", d.values), ("given", d.given), ("sigma", d.sigmas)):
            out[name] += numbers_text(numbers)
    return out


def read_declared(table: CsvTable) -> tuple[Declared, ...]:
    """Return the declared unknowns of a table; rows of one node follow each other.

    Raises
    ------
    InputError
        With file and line.
    """
    kinds, nodes, names = (table.texts(c) for c in ("kind", "node", "parameter"))
    units, said = table.texts("unit", ""), table.choices("state", STATES)
    values, given, sigmas = table.numbers("value"), table.numbers("given"), table.sigmas("sigma")
    for row, text in enumerate(kinds):
        if text not in DECLARED:
            raise table.error(row, f"unknowns of the kind {text!r} are not known; known are {', '.join(DECLARED)}")
    states = np.where(said < 0, np.where(np.isnan(sigmas), FREE, OBSERVED), said)
    given = np.where((states == OBSERVED) & np.isnan(given), values, given)
    needed = np.array([not DECLARED[text].starts_itself for text in kinds], dtype=bool)
    _refuse(table, np.isnan(values) & needed, "value is missing")
    _refuse(table, (states == OBSERVED) & ~((sigmas > 0.0) & np.isfinite(given)), "an observed unknown needs a given value and a sigma")
    out = []
    for kind in dict.fromkeys(kinds):
        rows = [r for r, text in enumerate(kinds) if text == kind]
        groups: dict[str, list[int]] = {}
        last = None
        for r in rows:
            if nodes[r] in groups and nodes[r] != last:
                raise table.error(r, f"the rows of {kind} {nodes[r]!r} do not follow each other")
            last = nodes[r]
            if names[r] in [names[i] for i in groups.setdefault(nodes[r], [])]:
                raise table.error(r, f"{names[r]} of {kind} {nodes[r]!r} appears twice")
            groups[nodes[r]].append(r)
        parameters = tuple(tuple(names[i] for i in g) for g in groups.values())
        unit = tuple(tuple(units[i] for i in g) for g in groups.values())
        if len(set(parameters)) == 1 and len(set(unit)) == 1:
            parameters, unit = parameters[:1], unit[:1]
        try:
            known = (values[rows], states[rows].astype(np.int8), given[rows], sigmas[rows])
            out.append(DECLARED[kind](kind, tuple(groups), parameters, unit, *known))
        except UsageError as error:
            raise InputError(str(error), table.file) from None
    return tuple(out)


def _refuse(table: CsvTable, bad: NDArray[np.bool_], message: str) -> None:
    rows = np.flatnonzero(bad)
    if len(rows):
        raise table.error(int(rows[0]), message)
