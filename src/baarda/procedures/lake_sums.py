"""Mergeable sums of residuals: each file of a lake condensed in constant memory, and the files' sums put together in their order.

What comes out depends on the files alone, not on who condensed which or when: within a file the rows are taken in order, and files are
merged in order.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import memory
from baarda.distributions.base import Floats
from baarda.distributions.condensed import Condensed, condense_stream
from baarda.errors import NotEnoughMemory
from baarda.executors import memory_limit
from baarda.formats.residual_lake import PIECE, Lake, footer_sha256, read_pieces
from baarda.procedures.group_study import UNCONTROLLED

__all__ = ["FilePart", "GroupSums", "LakeSums", "PartJob", "bound", "condense_file"]

Ints = NDArray[np.int64]

SUMS = ("n", "d", "d2", "d3", "d4", "r", "e", "e2")  # d: residuals over their sigmas, e: the values studied, both from the centre
PER_OCTAVE_BITS = 2  # bins of a quarter octave for each group
_SHIFT = np.uint64(52 - PER_OCTAVE_BITS)
_KEYS = 1 << (12 + PER_OCTAVE_BITS)
_BASE = 600e6  # bytes: the interpreter with its libraries, one piece of rows, the bins of all values
_NAME = 120  # bytes of a group's name and its place in the index
_USUAL_BINS = 120


def bound(groups: int, bins: int = _USUAL_BINS) -> float:
    """Return the bytes that a worker takes at most while it condenses a file with so many groups.

    Parameters
    ----------
    groups : int
    bins : int
        Bins of a quarter octave that are in use; 120 are 15 octaves on either side.

    Returns
    -------
    float

    Examples
    --------
    >>> bound(0) / 1e6, bound(100_000) / 1e9
    (600.0, 0.919)
    """
    arrays = 8.0 * (len(SUMS) + bins) * groups
    return _BASE + _NAME * groups + 3.0 * arrays


@dataclass
class GroupSums:
    """Sums and a histogram for each group, in the order in which the groups were met.

    Attributes
    ----------
    index : dict of str to int
        Place of each group.
    sums : (k, 8) array
        See `SUMS`.
    keys : (b,) integer array
        Bins in use: sign, exponent and two mantissa bits of the distance from the centre.
    counts : (k, b) integer array
    """

    index: dict[str, int] = field(default_factory=dict)
    sums: Floats = field(default_factory=lambda: np.zeros((0, len(SUMS))))
    keys: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    counts: Ints = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))

    @property
    def names(self) -> tuple[str, ...]:
        """The groups."""
        return tuple(self.index)

    def places(self, names: tuple[str, ...]) -> NDArray[np.intp]:
        """Return the places of groups; new ones come last."""
        at = np.array([self.index.setdefault(n, len(self.index)) for n in names], dtype=np.intp)
        more = len(self.index) - len(self.sums)
        if more:
            grown = max(more, len(self.sums) // 2)  # seldom, and by much
            self.sums = np.concatenate([self.sums, np.zeros((grown, len(SUMS)))])
            self.counts = np.concatenate([self.counts, np.zeros((grown, self.counts.shape[1]), dtype=np.int64)])
        return at

    def columns(self, keys: Ints) -> NDArray[np.intp]:
        """Return the columns of bins; new ones come last."""
        new = np.setdiff1d(keys, self.keys)
        if len(new):
            self.keys = np.concatenate([self.keys, new])
            self.counts = np.concatenate([self.counts, np.zeros((len(self.counts), len(new)), dtype=np.int64)], axis=1)
        order = np.argsort(self.keys, kind="stable")
        return order[np.searchsorted(self.keys, keys, sorter=order)]

    def add(self, codes: NDArray[np.intp], names: tuple[str, ...], d: Floats, e: Floats, r: Floats | None) -> None:
        """Add rows."""
        at, k = self.places(names), len(names)
        part = np.empty((k, len(SUMS)))
        square = d * d
        part[:, 0] = np.bincount(codes, minlength=k)
        for column, weights in ((1, d), (2, square), (3, square * d), (4, square * square), (5, r), (6, e), (7, e * e)):
            part[:, column] = 0.0 if weights is None else np.bincount(codes, weights, k)
        np.add.at(self.sums, at, part)  # two names may be one group: 1 and "1"
        key = (e + 0.0).view(np.uint64) >> _SHIFT
        used = np.flatnonzero(np.bincount(key.astype(np.intp), minlength=_KEYS))
        table = np.zeros(_KEYS, dtype=np.intp)
        table[used] = self.columns(used)
        np.add.at(self.counts.reshape(-1), at[codes] * self.counts.shape[1] + table[key.astype(np.intp)], 1)

    def merge(self, other: GroupSums) -> None:
        """Add the sums of another part, which come after."""
        k = len(other.index)
        at, columns = self.places(other.names), self.columns(other.keys)
        self.sums[at] += other.sums[:k]
        self.counts[np.ix_(at, columns)] += other.counts[:k]

    def trimmed(self) -> GroupSums:
        """Return the same in as little memory as it takes to be sent."""
        k = len(self.index)
        counts = self.counts[:k]
        most = int(counts.max(initial=0))
        kind = next(t for t in (np.uint8, np.uint16, np.uint32, np.int64) if most <= np.iinfo(t).max)
        return GroupSums(self.index, self.sums[:k], self.keys, counts.astype(kind))


@dataclass
class LakeSums:
    """All that a study needs of a part of a lake.

    Attributes
    ----------
    condensed : Condensed or None
        The values studied; None without any.
    low, high : float
        Smallest and largest value.
    rows, set_aside : int
        Rows read, and those of them that no other observation controls.
    squares, redundancy, redundancy_squares : float
        Sums of (v / sigma)^2, r and r^2.
    groups : GroupSums
    """

    condensed: Condensed | None = None
    low: float = np.inf
    high: float = -np.inf
    rows: int = 0
    set_aside: int = 0
    squares: float = 0.0
    redundancy: float = 0.0
    redundancy_squares: float = 0.0
    groups: GroupSums = field(default_factory=GroupSums)

    def merge(self, other: LakeSums) -> None:
        """Add the part that comes after."""
        if other.condensed is not None:
            self.condensed = other.condensed if self.condensed is None else self.condensed + other.condensed
        self.low, self.high = min(self.low, other.low), max(self.high, other.high)
        self.rows += other.rows
        self.set_aside += other.set_aside
        self.squares += other.squares
        self.redundancy += other.redundancy
        self.redundancy_squares += other.redundancy_squares
        self.groups.merge(other.groups)


@dataclass(frozen=True)
class PartJob:
    """A file to condense about a centre."""

    lake: Lake
    index: int
    centre: float


@dataclass(frozen=True)
class FilePart:
    """What a worker returns of a file: its sums, the hash of its footer, and the largest memory of the process so far, bytes."""

    sums: LakeSums
    footer: str
    peak: float


def condense_file(job: PartJob) -> FilePart:
    """Condense a file of a lake.

    Parameters
    ----------
    job : PartJob

    Returns
    -------
    FilePart

    Raises
    ------
    InputError
        If the file cannot be used; the message names file and row.
    NotEnoughMemory
        If its groups do not fit into the worker; the message has the figures.
    """
    limit = min(memory_limit(), memory.available() + peak_memory())
    footer = footer_sha256(job.lake, job.index)
    sums = LakeSums()
    pieces = _values(job, sums, lambda: _check(sums.groups, limit, job))
    first = next(pieces, None)
    if first is not None:

        def all_pieces() -> Iterator[Floats]:
            yield first
            yield from pieces

        sums.condensed = condense_stream(all_pieces(), job.centre, workers=1)
    sums.groups = sums.groups.trimmed()
    return FilePart(sums, footer, peak_memory())


def _values(job: PartJob, sums: LakeSums, check: Callable[[], None]) -> Iterator[Floats]:
    """Yield the values studied, and add up all else."""
    for piece in read_pieces(job.lake, job.index, PIECE):
        sums.rows += len(piece.residuals)
        base, r, codes = piece.residuals, piece.redundancy, piece.codes
        if piece.sigmas is not None:
            base = base / piece.sigmas
        if r is not None:
            kept = r >= UNCONTROLLED
            if not kept.all():
                sums.set_aside += int((~kept).sum())
                base, r, codes = base[kept], r[kept], None if codes is None else codes[kept]
            sums.redundancy += float(r.sum())
            sums.redundancy_squares += float(np.square(r).sum())
        x = base if r is None else base / np.sqrt(r)
        sums.squares += float(np.square(base).sum())  # not by BLAS, whose threads sum in another order
        if codes is not None:
            e = x - job.centre
            sums.groups.add(codes, piece.names, e if r is None else base - job.centre, e, r)
            check()
        if len(x):
            sums.low, sums.high = min(sums.low, float(x.min())), max(sums.high, float(x.max()))
            yield x


def _check(groups: GroupSums, limit: float, job: PartJob) -> None:
    needed = bound(len(groups.index), len(groups.keys))
    if needed > limit:
        raise NotEnoughMemory(
            f"{job.lake.named(job.index)}: {len(groups.index)} groups in {len(groups.keys)} bins need {needed / 1e9:.2f} GB of memory; "
            f"the worker may take {limit / 1e9:.2f} GB"
        )


def peak_memory() -> float:
    """Return the largest memory of this process so far, bytes; 0 where the system does not tell."""
    try:  # not that of getrusage, which begins with what the process that started this one held
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return 1024.0 * float(line.split()[1])
    except (OSError, ValueError, IndexError):  # not Linux
        pass
    try:
        resource = importlib.import_module("resource")
    except ImportError:  # Windows
        return 0.0
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1.0 if sys.platform == "darwin" else 1024.0)
