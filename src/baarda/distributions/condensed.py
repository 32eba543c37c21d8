"""Millions or billions of values condensed into mergeable bins, with hardly any loss for a likelihood."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.distributions.base import Floats
from baarda.distributions.kernels import BIN_BITS, KEYS, LOW_BITS, OFFSET_BITS, kernels
from baarda.distributions.workers import worker_count
from baarda.errors import UsageError

PER_OCTAVE = 1 << BIN_BITS
_SIDE = KEYS // 2  # keys from here on are negative differences
_NOT_FINITE = 0x7FF << BIN_BITS
_PIECE = 1 << 18
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Condensed:
    """Count, mean and spread of values in 64 bins an octave on either side of a centre, held as whole numbers.

    `a + b` merges two data sets with the same centre. Whatever the order or grouping of merges, the result is the same to the last bit,
    because the place of a value in its bin is an integer (the mantissa bits below the bin's number) and integers are summed. Two points at
    mean +- standard deviation stand for the values of a bin: every polynomial up to the third degree in a bin is summed (nearly) exactly,
    which leaves an error of the order 1e-11 of a unit of log-likelihood for each value.

    Attributes
    ----------
    centre : float
        The value that was subtracted; bins are narrow near it.
    keys : (k,) array of int
        Bin numbers, ascending: sign, exponent and six mantissa bits of the difference.
    counts : (k,) array of int
        Number of values in each bin.
    high, low, squares : (k,) arrays of int
        Sums of the upper 16 bits of the place in the bin, of its lower 30 bits, and of the square of the upper 16 bits.
    """

    centre: float
    keys: Ints
    counts: Ints
    high: Ints
    low: Ints
    squares: Ints

    def __add__(self, other: Condensed) -> Condensed:
        """Merge with another data set condensed about the same centre."""
        if self.centre != other.centre:
            raise UsageError(f"cannot merge values condensed about {self.centre:g} and about {other.centre:g}")
        keys = np.union1d(self.keys, other.keys)
        table = np.zeros((keys.size, 4), dtype=np.int64)
        for part in (self, other):
            table[np.searchsorted(keys, part.keys)] += part._columns()
        return Condensed._of(self.centre, keys, table)

    @classmethod
    def _of(cls, centre: float, keys: Ints, table: Ints) -> Condensed:
        if np.any(table < 0):
            raise UsageError("too many values in one bin (about 2^31) for whole numbers of 64 bits")
        columns = [np.ascontiguousarray(column) for column in table.T]
        for column in (keys, *columns):
            column.setflags(write=False)
        return cls(centre, keys, *columns)

    def _columns(self) -> Ints:
        return np.stack([self.counts, self.high, self.low, self.squares], axis=1)

    @property
    def n(self) -> int:
        """The number of values."""
        return int(np.sum(self.counts))

    @property
    def sums(self) -> Floats:
        """Sum of (value - centre) in each bin."""
        size, _ = self._bins()
        return np.where(self.keys >= _SIDE, -1.0, 1.0) * size * self.counts

    @property
    def mean(self) -> float:
        """The mean of the values, exact but for rounding."""
        return float(self.centre + np.sum(self.sums) / np.sum(self.counts))

    def _bins(self) -> tuple[Floats, Floats]:
        """Mean and variance of |value - centre| in each bin."""
        n = self.counts.astype(float)
        high = self.high / n
        place = np.ldexp(high, LOW_BITS) + self.low / n
        exponent = (self.keys >> BIN_BITS) & 0x7FF
        start = ((exponent > 0).astype(np.int64) << 52) + ((self.keys & (PER_OCTAVE - 1)) << OFFSET_BITS)
        unit = np.maximum(exponent, 1) - 1075
        variance = np.where(self.counts == 1, 0.0, np.maximum(self.squares / n - high * high, 0.0))  # rounding can make it negative
        return np.ldexp(start + place, unit), np.ldexp(np.ldexp(variance, 2 * LOW_BITS), 2 * unit)

    def ranges(self) -> tuple[Floats, Floats, Ints]:
        """Return the lower and upper limits of the bins, ascending, as differences from `centre`, and the number of values in each.

        Values on the limit away from the centre belong to the next bin.

        Examples
        --------
        >>> lower, upper, counts = condense([-2.0, 1.0, 1.001, 3.0]).ranges()
        >>> lower.tolist(), upper.tolist(), counts.tolist()
        ([-2.03125, 1.0, 3.0], [-2.0, 1.015625, 3.03125], [1, 2, 1])
        """
        exponent = (self.keys >> BIN_BITS) & 0x7FF
        start = ((exponent > 0).astype(np.int64) << 52) + ((self.keys & (PER_OCTAVE - 1)) << OFFSET_BITS)
        unit = np.maximum(exponent, 1) - 1075
        near, far = np.ldexp(start.astype(float), unit), np.ldexp((start + (1 << OFFSET_BITS)).astype(float), unit)
        negative = self.keys >= _SIDE
        lower, upper = np.where(negative, -far, near), np.where(negative, -near, far)
        order = np.argsort(lower, kind="stable")
        return lower[order], upper[order], self.counts[order]

    def repeated(self) -> int:
        """Return the number of values in bins all of whose values are equal (to 16 bits of their place), two at least."""
        _, variance = self._bins()
        return int(np.sum(self.counts[(variance == 0.0) & (self.counts > 1)]))

    def points(self, *, folded: bool = False, per_octave: int = PER_OCTAVE) -> tuple[Floats, Floats]:
        """Return points (differences from `centre`) and weights that stand for the values.

        Parameters
        ----------
        folded : bool
            Whether to put both sides together, for a law that is symmetric about `centre`.
        per_octave : int
            Number of bins in an octave, a power of 2 up to 64; fewer are faster and coarser.

        Returns
        -------
        (m,) arrays
            Two points for each bin, mean - standard deviation and mean + standard deviation, and half its count for either.
        """
        mean, variance = self._bins()
        sign = np.where((self.keys >= _SIDE) & (not folded), -1.0, 1.0)
        weights = self.counts.astype(float)
        if folded or per_octave < PER_OCTAVE:
            keys = (self.keys & (_SIDE - 1) if folded else self.keys) >> (BIN_BITS - (per_octave.bit_length() - 1))
            groups, place = np.unique(keys, return_inverse=True)
            total = np.bincount(place, weights=weights)
            first = np.bincount(place, weights=weights * mean) / total
            variance = np.bincount(place, weights=weights * (variance + (mean - first[place]) ** 2)) / total
            side = np.zeros(groups.size)
            side[place] = sign
            mean, weights, sign = first, total, side
        spread = np.sqrt(variance)
        half = 0.5 * weights
        return np.concatenate([sign * (mean - spread), sign * (mean + spread)]), np.concatenate([half, half])


def condense(values: ArrayLike, centre: float = 0.0, *, workers: int | None = None) -> Condensed:
    """Condense values into bins of 1/64 octave of their distance from a centre.

    Parameters
    ----------
    values : (n,) array
        Finite values.
    centre : float
        Where the law is expected to be centred.
    workers : int, optional
        Number of threads; by default one per core. It does not change the result.

    Returns
    -------
    Condensed

    Raises
    ------
    UsageError
        If a value is not finite, or there are none.

    Examples
    --------
    >>> x = np.linspace(-3.0, 3.0, 100001)
    >>> points, weights = condense(x).points()
    >>> bool(points.size < 4000), float(np.sum(weights * points**2) / np.sum(x**2))
    (True, 1.0000000)
    """
    return condense_stream([np.asarray(values)], centre, workers=workers)


def condense_stream(
    chunks: Iterable[ArrayLike],
    centre: float | None = 0.0,
    *,
    progress: Callable[[int], None] | None = None,
    workers: int | None = None,
) -> Condensed:
    """Condense values that come in chunks, in constant memory.

    Parameters
    ----------
    chunks : iterable of (n,) arrays
        Finite values, for instance `baarda.formats.value_stream.open_values(file)`.
    centre : float or None
        Where the law is expected to be centred; None: the mean of the first chunk.
    progress : callable, optional
        Called after each chunk with the number of values read so far.
    workers : int, optional
        Number of threads; by default one per core. It does not change the result.

    Returns
    -------
    Condensed
        The same as from one array with all values.

    Raises
    ------
    UsageError
        If a value is not finite, or there are none.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> parts = [rng.standard_normal(1000) for _ in range(5)]
    >>> stream = condense_stream(iter(parts), progress=lambda n: print(n, end=" "))
    1000 2000 3000 4000 5000
    >>> bool(np.all(stream.counts == condense(np.concatenate(parts)).counts))
    True
    """
    threads = worker_count(workers)
    done = 0
    with _Tables(threads) as tables:
        for chunk in chunks:
            x = np.asarray(chunk).ravel()
            if centre is None and x.size:
                centre = float(np.mean(x, dtype=float))
                if not np.isfinite(centre):
                    raise UsageError("values must be finite, and so must their mean")
            tables.add(x, 0.0 if centre is None else float(centre), done)
            done += x.size
            if progress is not None:
                progress(done)
        total = tables.total()
    if not done:
        raise UsageError("no values given")
    keys = np.flatnonzero(total[:, 0])
    return Condensed._of(float(centre or 0.0), keys.astype(np.int64), total[keys])


class _Tables:
    """One table of bins for each thread."""

    def __init__(self, threads: int) -> None:
        self._tables = [np.zeros((KEYS, 4), dtype=np.int64) for _ in range(threads)]
        self._free = deque(self._tables)
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> _Tables:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def add(self, x: np.ndarray, centre: float, before: int) -> None:
        """Count a chunk; it may be overwritten afterwards."""
        loops = kernels(before + x.size)

        def count(start: int) -> None:
            piece = x[start : start + _PIECE]
            table = self._free.pop()
            try:
                loops.bin_values(np.require(piece, np.float64, ["C", "A"]), centre, table)
                bad = sum(int(np.sum(table[side + _NOT_FINITE : side + _NOT_FINITE + PER_OCTAVE, 0])) for side in (0, _SIDE))
            finally:
                self._free.append(table)
            if bad:
                first = before + start + 1
                raise UsageError(f"values must be finite; {bad} of those from number {first} to {first + piece.size - 1} are not")

        starts = range(0, x.size, _PIECE)
        if len(starts) < 2 or len(self._tables) < 2:
            for start in starts:
                count(start)
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(len(self._tables))
        for _ in self._pool.map(count, starts):
            pass

    def total(self) -> Ints:
        """Return the sum of the tables."""
        total = self._tables[0]
        for table in self._tables[1:]:
            rows = np.flatnonzero(table[:, 0])
            total[rows] += table[rows]
        return total
