"""Unknowns that belong to no camera, image or point: groups of nodes that an observation kind declares for itself.

An author of a kind makes a group (orientations of stations, polynomials of a track, transformations of models), puts it into
`Network.declared`, and names the group in the blocks of the kind's `linearize`; the kind reads current values from ``state[kind]`` and says
by ``nodes_of() -> {kind: nodes}`` which node each row belongs to, so that nodes without observations stay out. Numbering, steps, datum,
names, sigmas and tables follow. A subclass says what an increment does to the values (`moved`) and how the values follow a similarity
transformation of the object space (`shifted`, `similarity`), where the defaults do not hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import UsageError

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
States = NDArray[np.int8]

RESERVED = ("camera", "image", "point")


@dataclass(frozen=True)
class Declared:
    """A group of nodes of any width with its current values.

    Attributes
    ----------
    kind : str
        Name of the group, first word of the names of its unknowns: ``station A: orientation``.
    labels : tuple of str
        One label per node.
    parameters : tuple of tuple of str
        Parameter names, one tuple per node, or a single tuple for all.
    units : tuple of tuple of str
        Units of the parameters, shaped like `parameters`.
    values : (total,) array
        Start or adjusted values, node by node.
    states : (total,) int8 array
        0 fixed, 1 observed, 2 free.
    given, sigmas : (total,) arrays
        Directly observed values and their standard deviations; NaN elsewhere.
    """

    kind: str
    labels: tuple[str, ...]
    parameters: tuple[tuple[str, ...], ...]
    units: tuple[tuple[str, ...], ...]
    values: Floats
    states: States
    #: Whether a missing value (NaN) is one that the observation kind finds a start for.
    starts_itself: ClassVar[bool] = False

    given: Floats = field(default_factory=lambda: np.zeros(0))
    sigmas: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name, dtype in (("values", float), ("states", np.int8), ("given", float), ("sigmas", float)):
            array = np.asarray(getattr(self, name), dtype=dtype)
            if name in ("given", "sigmas") and not array.size:
                array = np.full(len(self.values), np.nan)
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)
        if self.kind in RESERVED:
            raise UsageError(f"a group of unknowns cannot be called {self.kind!r}")
        if len(self.parameters) not in (1, len(self.labels)) or [len(p) for p in self.parameters] != [len(u) for u in self.units]:
            raise UsageError(f"{self.kind}: parameters and units must be one tuple for all nodes, or one for each, of equal lengths")
        total = int(self.offsets[-1])
        if self.values.shape != (total,) or self.states.shape != (total,):
            raise UsageError(f"{self.kind}: {total} parameters, but values {self.values.shape} and states {self.states.shape}")
        if self.given.shape != (total,) or self.sigmas.shape != (total,):
            raise UsageError(f"{self.kind}: {total} parameters, but given values {self.given.shape} and sigmas {self.sigmas.shape}")
        if not np.isin(self.states, (FIXED, OBSERVED, FREE)).all():
            raise UsageError(f"{self.kind}: a parameter must be fixed, observed or free")
        bad = np.flatnonzero((self.states == OBSERVED) & ~(np.isfinite(self.given) & (self.sigmas > 0.0) & np.isfinite(self.sigmas)))
        if len(bad):
            node = int(np.searchsorted(self.offsets, bad[0], side="right")) - 1
            name = self.parameters_of(node)[int(bad[0] - self.offsets[node])]
            raise UsageError(f"{self.kind} {self.labels[node]}: {name} is observed, but has no given value with a positive sigma")

    @classmethod
    def make(
        cls,
        kind: str,
        labels: Sequence[str],
        parameters: Sequence[str],
        units: Sequence[str],
        values: Any,
        states: Any = None,
        given: Any = None,
        sigmas: Any = None,
    ) -> Self:
        """Make a group whose nodes all have the same parameters, from (nodes, width) values; free unless states say otherwise.

        Examples
        --------
        >>> g = Declared.make("track", ["1", "2"], ["a0", "a1"], ["m", "m/s"], [[1.0, 2.0], [3.0, 4.0]])
        >>> g.offsets.tolist(), g.of(np.array([1]), 2).tolist()
        ([0, 2, 4], [[3.0, 4.0]])
        """
        values = np.asarray(values, dtype=float).reshape(len(labels), len(parameters))
        states = np.full(values.shape, FREE, dtype=np.int8) if states is None else np.asarray(states, dtype=np.int8).reshape(values.shape)
        known = (np.zeros(0) if a is None else np.asarray(a, dtype=float).reshape(values.shape).ravel() for a in (given, sigmas))
        return cls(kind, tuple(labels), (tuple(parameters),), (tuple(units),), values.ravel(), states.ravel(), *known)

    @cached_property
    def widths(self) -> Ints:
        """Number of parameters of each node."""
        of = [len(p) for p in self.parameters]
        return np.array(of if len(of) == len(self.labels) else of * len(self.labels), dtype=np.intp)

    @cached_property
    def offsets(self) -> Ints:
        """Where each node's parameters begin, (nodes + 1,)."""
        return np.concatenate([[0], np.cumsum(self.widths)]).astype(np.intp)

    def of(self, nodes: Ints, width: int) -> Floats:
        """Return the (n, width) values of nodes that all have this width."""
        return np.asarray(self.values[self.offsets[nodes][:, None] + np.arange(width)])

    def unit_of(self, node: int, k: int) -> str:
        """Return the unit of parameter k of a node."""
        return self.units[node if len(self.units) > 1 else 0][k]

    def parameters_of(self, node: int) -> tuple[str, ...]:
        """Return the parameter names of one node."""
        return self.parameters[node if len(self.parameters) > 1 else 0]

    def named(self, node: int, name: str) -> int:
        """Return the position of a named parameter of a node in the values.

        Raises
        ------
        UsageError
            If the node has no such parameter.
        """
        names = self.parameters_of(node)
        if name not in names:
            raise UsageError(f"{self.kind} {self.labels[node]} has no parameter {name!r}; it has {', '.join(names)}")
        return int(self.offsets[node]) + names.index(name)

    def removable(self) -> NDArray[np.bool_]:
        """Return which parameters are zero where they are not needed, (total,): those that a selection may delete; none by default."""
        return np.zeros(len(self.values), dtype=bool)

    def moved(self, step: Floats) -> Self:
        """Return the group after increments of all parameters, (total,); zero for fixed ones."""
        return replace(self, values=self.values + step)

    def departure(self, other: Self) -> Floats:
        """Return the increments that lead from another state of the group to this one, (total,)."""
        return np.asarray(self.values - other.values)

    def shifted(self, shift: Floats) -> Self:
        """Return the group after `shift` (3,) was added to all object coordinates; the default is for values without a place."""
        return self

    def similarity(self, size: float) -> Floats:
        """Return how the parameters change under shifts along, rotations about X, Y, Z, and scaling, (total, 7).

        Rotation and scale are stated per `size`, the mean distance of the network from the origin: a rotation by 1/size, a scale of
        1 + 1/size. The default is for values that no such transformation changes.
        """
        return np.zeros((len(self.values), 7))
