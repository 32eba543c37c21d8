"""What the parts of a network share: their border, numbered, and its normal equations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from baarda.adjustment.block import SMALLEST_PIVOT
from baarda.adjustment.solve import Settings
from baarda.errors import Singular
from baarda.procedures import helmert_part as tasks
from baarda.procedures.partition_folder import PartitionFolder
from baarda.procedures.task_engines import Engine

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Handles = list[Any]


@dataclass(frozen=True)
class Joint:
    """What the parts have in common.

    Attributes
    ----------
    source : PartitionFolder
    facts : tuple of Facts
    at : tuple of int arrays
        For each part the places of its border unknowns in the border of the network.
    names : tuple of str
        Of the border unknowns.
    size : float
        Root mean square distance of points and images from the origin.
    settings : Settings
    """

    source: PartitionFolder
    facts: tuple[tasks.Facts, ...]
    at: tuple[Ints, ...]
    names: tuple[str, ...]
    size: float
    settings: Settings

    @property
    def count(self) -> int:
        """The number n of observations."""
        return sum(f.observations for f in self.facts)

    @property
    def unknowns(self) -> int:
        """The number u of unknowns."""
        return sum(f.owned_unknowns for f in self.facts)

    @property
    def border(self) -> int:
        """The number b of unknowns of the border."""
        return len(self.names)

    def redundancy(self, defect: int) -> int:
        """Return r = n - u + d, less what no condition controls."""
        return self.count - sum(f.uncontrolled for f in self.facts) - self.unknowns + defect

    def sum(self, values: Sequence[Floats], shape: tuple[int, ...] = ()) -> Floats:
        """Add what the parts say of their border unknowns, in the order of the parts."""
        out = np.zeros((self.border, *shape))
        for at, v in zip(self.at, values, strict=True):
            out[at] += v
        return out


class Top:
    """The normal equations of the border, factored."""

    def __init__(self, matrix: Floats, squares: Floats, held: Ints, damping: float, names: Sequence[str]) -> None:
        self.size = len(squares)
        self.scale = np.where(squares > 0.0, np.sqrt(squares), 1.0)
        self.kept = np.setdiff1d(np.arange(self.size), held)
        s = self.scale[self.kept]
        normal = matrix[np.ix_(self.kept, self.kept)] / np.outer(s, s)
        normal[np.arange(len(s)), np.arange(len(s))] += damping
        self.factor, info = linalg.lapack.dpotrf(normal, lower=1, clean=1) if len(s) else (normal, 0)
        if info or (np.diagonal(self.factor) ** 2 < SMALLEST_PIVOT).any():
            values, vectors = linalg.eigh(normal)
            share = vectors[:, 0] ** 2
            hit = [names[self.kept[i]] for i in np.argsort(-share, kind="stable")[:12] if share[i] > 0.02 * share.max()]
            limit = len(s) * np.finfo(float).eps * values[-1]
            if info or values[0] <= limit:
                raise Singular(f"the observations do not determine combinations of unknowns of the border; involved: {', '.join(hit)}", hit)

    def solve(self, rhs: Floats) -> Floats:
        """Return the border's unknowns for (b,) or (b, k) right-hand sides; held ones stay zero."""
        out = np.zeros_like(rhs)
        if len(self.kept):
            s = self.scale[self.kept].reshape(-1, *([1] * (rhs.ndim - 1)))
            out[self.kept] = linalg.cho_solve((self.factor, True), rhs[self.kept] / s) / s
        return out

    def inverse(self) -> Floats:
        """Return the cofactors (b, b) of the border; zero for held unknowns."""
        out = np.zeros((self.size, self.size))
        if len(self.kept):
            half, _ = linalg.lapack.dpotri(self.factor, lower=1)
            s = self.scale[self.kept]
            out[np.ix_(self.kept, self.kept)] = (np.tril(half) + np.tril(half, -1).T) / np.outer(s, s)
        return out


class Parts:
    """The parts of a network behind an engine."""

    def __init__(self, engine: Engine, joint: Joint) -> None:
        self.engine, self.joint = engine, joint

    def each(self, function: Callable[..., Any], *arguments: Any) -> Handles:
        """Hand over a task for each part; lists are one argument per part, everything else is the same for all."""
        count = len(self.joint.at)
        return [self.engine.submit(k, function, *(a[k] if isinstance(a, list) else a for a in arguments)) for k in range(count)]

    def all(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Return what a task says for each part."""
        return self.engine.gather(self.each(function, *arguments))

    def total(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the sum over the parts, in their order."""
        return sum(self.all(function, *arguments))
