"""A part of a network as its worker holds it, and the part at a state: linearised and factored when that is first asked for.

Both travel as recipes: a worker that gets one computes again what it needs, so a lost worker, a spilled object or another process costs
time, never a result.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import memory
from baarda.adjustment.block import BlockSolver
from baarda.adjustment.initial import complete
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.linearize import Arrangement, linearize
from baarda.adjustment.point_order import rank_for
from baarda.adjustment.solve import Settings, active_groups, prepare
from baarda.adjustment.structure import Structure, analyse
from baarda.errors import InputError, NotEnoughMemory
from baarda.executors import memory_limit
from baarda.formats.project import read as read_project
from baarda.network import Network, State, Unknowns, unknowns_of
from baarda.observations import Kind, viewpoints_of
from baarda.procedures.partition_folder import mismatch

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

TABLES = 200.0  # bytes of an observation in the tables
PAUSE = 0.8  # of its limit, beyond which a Dask worker takes no more tasks


@dataclass(frozen=True)
class Source:
    """Where a part comes from.

    Attributes
    ----------
    place : str
        Its project folder.
    sha256 : str
        Of its files.
    number : int
    border : tuple of (str, str)
        Kind and label of its border nodes.
    codes : tuple of int
        Their places in the border of the whole network.
    owned : tuple of int
        Those of `codes` that the part owns.
    options : mapping
        Fields of `Settings`.
    centroid : tuple of float
    frugal : bool
        Whether partials and factors are let go after each task and computed again by the next.
    """

    place: str
    sha256: str
    number: int
    border: tuple[tuple[str, str], ...]
    codes: tuple[int, ...]
    owned: tuple[int, ...]
    options: Mapping[str, Any]
    centroid: tuple[float, float, float]
    frugal: bool = False


def resident() -> float:
    """Return the bytes of memory that this process holds; 0 where the system does not tell.

    Examples
    --------
    >>> 0.0 <= resident() < 1e12
    True
    """
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError):
        return 0.0
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


def trim() -> None:
    """Give freed memory back to the system, where the C library can: a cluster counts what a process holds, not what it uses."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


class Part:
    """One part of a network, loaded by its worker."""

    def __init__(self, source: Source) -> None:
        self.source = source
        place = Path(source.place)
        if mismatch(place, source.sha256):
            raise InputError("the files of this part are not those that were written with the index: split again", place)
        network = read_project(place)
        self.settings = Settings.of(network, source.options)
        prepared, self.aside, self.notes = prepare(network, self.settings)
        prepared, _ = complete(prepared, self.aside)
        self.shift = -np.array(source.centroid)
        self.network: Network = prepared.shifted(self.shift)
        self.assumptions = network.assumptions
        self.groups: list[Kind] = active_groups(self.network, ~self.aside)
        with_images = np.isin(np.arange(len(self.network.cameras)), self.network.images.cameras)
        self.unknowns: Unknowns = unknowns_of(self.network, ~self.aside, with_images)
        self.start = State.of(self.network)
        self.far = viewpoints_of(self.groups, self.start).far(self.start.points)
        self.rank = rank_for(self.groups, self.start.points)
        self.arranged = Arrangement.of(self.groups, self.rank, self.network)
        self._structure: Structure | None = None
        columns, codes, owned = [], [], []
        for (kind, label), code in zip(source.border, source.codes, strict=True):
            group = self.unknowns[kind]
            node = self._labels(kind)[label]
            at = np.arange(group.offsets[node], group.offsets[node + 1])
            free = np.flatnonzero(group.columns[at] >= 0)
            columns += group.columns[at[free]].tolist()
            codes += [(code, int(k)) for k in free]
            owned += [code in set(source.owned)] * len(free)
        self.border = np.array(columns, dtype=np.intp)
        self.codes = np.array(codes, dtype=np.intp).reshape(-1, 2)
        self.border_owned = np.array(owned, dtype=bool)
        self.owned = np.ones(self.unknowns.count, dtype=bool)
        self.owned[self.border[~self.border_owned]] = False
        self._check_rows()

    def __reduce__(self) -> Any:
        return Part, (self.source,)

    def __sizeof__(self) -> int:
        return int(memory.of_rows(self.unknowns, self.groups, self.network))

    def _labels(self, kind: str) -> dict[str, int]:
        found = self._index.get(kind)
        if found is None:
            found = {label: i for i, label in enumerate(self.unknowns[kind].labels)}
            self._index[kind] = found
        return found

    @cached_property
    def _index(self) -> dict[str, dict[str, int]]:
        return {}

    def number_of(self, kind: str, label: str) -> int:
        """Return the number of the node of a kind with a label."""
        return self._labels(kind)[label]

    def _check_rows(self) -> None:
        self._refuse(memory.of_rows(self.unknowns, self.groups, self.network), "the observations")

    def _refuse(self, needed: float, what: str) -> None:
        limit, held, there = memory_limit(), resident(), memory.available()
        if np.isfinite(limit) and held + needed > PAUSE * limit:
            raise NotEnoughMemory(
                f"{what} of part {self.source.number} would take about {needed / 1e9:.3g} GB of memory; the worker may take "
                f"{limit / 1e9:.3g} GB and holds {held / 1e9:.3g} GB already: split into more parts, take more workers, or give them more"
            )
        if needed > there:
            raise NotEnoughMemory(
                f"{what} of part {self.source.number} would take about {needed / 1e9:.3g} GB of memory; {there / 1e9:.3g} GB are "
                "available: split into more parts"
            )

    def structure_of(self, lin: Linearization) -> Structure:
        """Return the pattern of the part's system, with its border last."""
        if self._structure is None:
            self._structure = analyse(lin, self.rank, self.start.points, border=self.border)
            self._refuse(self.needed - memory.of_rows(self.unknowns, self.groups, self.network), "the factor and the tables")
        return self._structure

    @property
    def needed(self) -> float:
        """Bytes of the part's observations, factor and tables."""
        fronts = 0.0 if self._structure is None else memory.of_fronts(self._structure) + 8.0 * 2 * len(self.border) ** 2
        rows = sum(len(g) * len(g.components) for g in self.groups)
        return memory.of_rows(self.unknowns, self.groups, self.network) + fronts + TABLES * rows


class Stand:
    """A part at a state: linearised and factored when that is first asked for.

    The factor may be that of another state nearby (`base`), as an approximate one.
    """

    def __init__(
        self, part: Part | Source, state: State, held: Ints | None = None, damping: float = 0.0, base: State | None = None
    ) -> None:
        self.source = part if isinstance(part, Source) else part.source
        self._part = None if isinstance(part, Source) else part
        self.state, self.damping = state, damping
        self.held = np.zeros(0, dtype=np.intp) if held is None else held
        self.base = state if base is None else base
        self._lin: Linearization | None = None
        self._solver: BlockSolver | None = None

    def __reduce__(self) -> Any:
        return Stand, (self.source, self.state, self.held, self.damping, None if self.base is self.state else self.base)

    def __sizeof__(self) -> int:
        return int(self.part.needed) if self._lin is not None else 1000

    @property
    def part(self) -> Part:
        """The part, read again where it was let go."""
        if self._part is None:
            self._part = Part(self.source)
        return self._part

    @property
    def lin(self) -> Linearization:
        """The whitened system at the state."""
        if self._lin is None:
            self._lin = self._linearized(self.state)
        return self._lin

    def _linearized(self, state: State) -> Linearization:
        part = self.part
        return linearize(part.network, state, part.unknowns, part.arranged, part.settings.jobs)

    @property
    def solver(self) -> BlockSolver:
        """Its factor down to the border."""
        if self._solver is None:
            lin = self.lin if self.base is self.state else self._linearized(self.base)
            structure = self.part.structure_of(lin)
            own = np.setdiff1d(self.held, self.part.border)
            solver = BlockSolver.of(lin, structure, own, self.damping)
            self._solver = solver if self.base is self.state else solver.at(self.lin)
        return self._solver

    def with_factor(self, held: Ints, damping: float, old: Stand | None) -> Stand:
        """Return the same state with another factor, or with the old one of a state nearby."""
        if old is None:
            out = Stand(self.part, self.state, held, damping)
            out._lin = self._lin
            return out
        out = Stand(self.part, self.state, held, damping, old.base)
        out._lin = self._lin
        if old._solver is not None:
            out._solver = old._solver.at(self.lin)
            old._solver = None
        return out

    def release(self) -> None:
        """Let go what can be computed again."""
        self._lin = self._solver = None

    def rest(self) -> None:
        """After a task: let go where memory is short."""
        if self.source.frugal:
            self.release()
            self._part = None
            trim()
