"""Project tables of observation kinds whose rows are vectors: a node of declared unknowns, an object point, values and sigmas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.formats.checks import sigma_range
from baarda.formats.csv_table import CsvTable, numbers_text, quoted
from baarda.network import Declared, Images, Network, Points
from baarda.observations.model_components import ModelHeights, ModelPlan
from baarda.observations.model_coordinates import ModelCoordinates
from baarda.observations.range_doppler import RangeDoppler

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class VectorTable:
    """How the rows of such a kind are written.

    Attributes
    ----------
    kind : str
        Name of the table, and of the kind in `project.toml`.
    group : type
        Class of the observation group.
    node : str
        Column of the node, and kind of the declared unknowns.
    components : tuple of str
        Columns of the values; `sigma_` before each is that of its standard deviation.
    make : callable
        From nodes, points, values (n, k), sigmas (n, k) and the unit of the object space to the group.
    parts : callable
        From a group to its nodes, points and values.
    """

    kind: str
    group: type[Any]
    node: str
    components: tuple[str, ...]
    make: Callable[[Ints, Ints, Floats, Floats, str], Any]
    parts: Callable[[Any], tuple[Ints, Ints, Floats]]

    @property
    def name(self) -> str:
        """Name of a group of which none is given."""
        return self.kind.replace("_", " ")

    @property
    def columns(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Required and optional columns."""
        return (self.node, "point", *self.components), ("group", *(f"sigma_{c}" for c in self.components))

    def write(self, group: Any, network: Network) -> dict[str, list[str]]:
        """Return the columns of a group."""
        nodes, points, values = self.parts(group)
        labels = next(d for d in network.declared if d.kind == self.node).labels
        sigma = group.sigma()
        return {
            "group": [quoted(group.name)] * len(group),
            self.node: [quoted(labels[i]) for i in nodes.tolist()],
            "point": [quoted(network.points.labels[i]) for i in points.tolist()],
            **{c: numbers_text(values[:, k]) for k, c in enumerate(self.components)},
            **{f"sigma_{c}": numbers_text(sigma[:, k]) for k, c in enumerate(self.components)},
        }

    def read(self, table: CsvTable | None, usual: Floats, images: Images, points: Points, unit: str, declared: tuple[Declared, ...]) -> Any:
        """Return all rows of a table as one group, checked; an empty one without a table.

        Raises
        ------
        InputError
            With file and line.
        """
        k = len(self.components)
        if table is None:
            nothing = np.zeros(0, dtype=np.intp)
            return self.make(nothing, nothing, np.zeros((0, k)), np.zeros((0, k)), unit)
        labels = next((d.labels for d in declared if d.kind == self.node), ())
        node = table.codes(self.node, {t: i for i, t in enumerate(labels)}, self.node)
        point = table.codes("point", {t: i for i, t in enumerate(points.labels)}, "point")
        values = np.stack([table.numbers(c, None) for c in self.components], axis=1)
        sigma = np.stack([table.sigmas(f"sigma_{c}") for c in self.components], axis=1)
        sigma = np.where(np.isnan(sigma), usual[:, None], sigma)
        bad = np.flatnonzero((~(sigma > 0.0)).any(axis=1))
        if len(bad):
            raise table.error(int(bad[0]), f"the sigmas of {self.name} must be there and positive")
        sigma_range(sigma, "sigma", table.error)
        first: dict[tuple[int, int], int] = {}
        for row, key in enumerate(zip(node.tolist(), point.tolist(), strict=True)):
            if key in first:
                there = table.line(first[key])
                raise table.error(row, f"point {points.labels[key[1]]} of {self.node} {labels[key[0]]} appears already in line {there}")
            first[key] = row
        return self.make(node, point, values, sigma, unit)


VECTOR_TABLES = (
    VectorTable(
        "range_doppler",
        RangeDoppler,
        "track",
        ("t", "r"),
        lambda node, point, values, sigma, unit: RangeDoppler(node, point, values, sigma),
        lambda group: (group.tracks, group.points, group.tr),
    ),
    VectorTable(
        "model_coordinates",
        ModelCoordinates,
        "model",
        ("x", "y", "z"),
        lambda node, point, values, sigma, unit: ModelCoordinates(node, point, values, sigma),
        lambda group: (group.models, group.points, group.xyz),
    ),
    VectorTable(
        "model_plan",
        ModelPlan,
        "model",
        ("x", "y"),
        lambda node, point, values, sigma, unit: ModelPlan(node, point, values, sigma),
        lambda group: (group.models, group.points, group.values),
    ),
    VectorTable(
        "model_heights",
        ModelHeights,
        "model",
        ("z",),
        lambda node, point, values, sigma, unit: ModelHeights(node, point, values, sigma),
        lambda group: (group.models, group.points, group.values),
    ),
)
