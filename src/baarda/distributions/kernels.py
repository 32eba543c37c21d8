"""Compiled loops over millions of values and their NumPy twins: sums of tabulated functions, and counting into logarithmic bins.

The loops know no law. A table holds, for each 1/64 octave of |z|, the six coefficients of a polynomial in the place inside the
interval; exponent and leading mantissa bits of |z| are the number of the interval, so that nothing is searched. Twin and loop do the
same operations in the same order and agree to the last bit. numba is imported on first use and only here.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from baarda.distributions.base import Floats

Bits = NDArray[np.uint64]
Ints = NDArray[np.int64]

COMPILE_FROM = 4_000_000  # fewer values are done in NumPy before numba is imported

# tables: intervals of |z| from 2^LOWEST to 2^HIGHEST, and one more row of zeros for what lies outside
LOWEST, HIGHEST = -26, 7
INTERVALS_PER_OCTAVE = 64
INTERVALS = (HIGHEST - LOWEST) * INTERVALS_PER_OCTAVE
COEFFICIENTS = 6
_BLOCK = 1024

_TABLE_SHIFT = np.uint64(52 - 6)
_TABLE_FIRST = np.uint64((1023 + LOWEST) * INTERVALS_PER_OCTAVE)
_TABLE_END = np.uint64(INTERVALS)
_TABLE_REST = np.uint64((1 << 46) - 1)
_TABLE_UP = np.uint64(6)
_ONE = np.uint64(1023 << 52)
_WIDTH = np.uint64(COEFFICIENTS)
_1, _2, _3, _4, _5 = (np.uint64(i) for i in range(1, 6))

# bins: sign, 11 exponent bits and 6 mantissa bits are the key; the other 46 bits are the place in the bin
BIN_BITS = 6
KEYS = 1 << (12 + BIN_BITS)
OFFSET_BITS = 52 - BIN_BITS
LOW_BITS = 30
_BIN_SHIFT = np.uint64(OFFSET_BITS)
_BIN_REST = np.uint64((1 << OFFSET_BITS) - 1)
_LOW_SHIFT = np.uint64(LOW_BITS)
_LOW_REST = np.uint64((1 << LOW_BITS) - 1)
_TWIN_CHUNK = 1 << 18


def _log_sum(x: Floats, loc: float, inverse: float, table: Floats) -> tuple[float, int]:
    flat = table.reshape(-1)
    total = 0.0
    outside = 0
    for start in range(0, x.size, _BLOCK):
        block = x[start : start + _BLOCK]
        part = 0.0
        for i in range(block.size):
            bits = np.float64(abs((block[i] - loc) * inverse)).view(np.uint64)
            k = (bits >> _TABLE_SHIFT) - _TABLE_FIRST
            if k >= _TABLE_END:
                outside += 1
                continue
            v = np.uint64(((bits & _TABLE_REST) << _TABLE_UP) | _ONE).view(np.float64) - 1.5
            k = k * _WIDTH
            w = v * v
            part += (flat[k] + flat[k + _1] * v) + w * ((flat[k + _2] + flat[k + _3] * v) + w * (flat[k + _4] + flat[k + _5] * v))
        total += part
    return total, outside


def _gradient_sums(x: Floats, loc: float, inverse: float, tables: Floats, out: Floats) -> int:
    places = np.empty(_BLOCK, np.uint64)
    inner = np.empty(_BLOCK)
    standard = np.empty(_BLOCK)
    outside = 0
    out[:] = 0.0
    for start in range(0, x.size, _BLOCK):
        n = min(_BLOCK, x.size - start)
        for i in range(n):
            z = (x[start + i] - loc) * inverse
            bits = np.float64(abs(z)).view(np.uint64)
            k = (bits >> _TABLE_SHIFT) - _TABLE_FIRST
            standard[i] = z
            if k >= _TABLE_END:
                outside += 1
                k = _TABLE_END
                standard[i] = 0.0
            places[i] = k * _WIDTH
            inner[i] = np.uint64(((bits & _TABLE_REST) << _TABLE_UP) | _ONE).view(np.float64) - 1.5
        for j in range(tables.shape[0]):
            flat = tables[j].reshape(-1)
            part = 0.0
            along = 0.0
            for i in range(n):
                k = places[i]
                v = inner[i]
                w = v * v
                p = (flat[k] + flat[k + _1] * v) + w * ((flat[k + _2] + flat[k + _3] * v) + w * (flat[k + _4] + flat[k + _5] * v))
                if j == 1:  # the score, an odd function: tabulated for z > 0
                    along += abs(standard[i]) * p
                    p *= np.copysign(1.0, standard[i])
                part += p
            if j == 1:
                out[1] += part
                out[2] += along
            else:
                out[j if j == 0 else j + 1] += part
    return outside


def _bin_values(x: Floats, centre: float, table: Ints) -> None:
    for i in range(x.size):
        bits = np.float64((x[i] - centre) + 0.0).view(np.uint64)  # + 0.0 turns -0.0 into 0.0
        key = bits >> _BIN_SHIFT
        offset = bits & _BIN_REST
        high = np.int64(offset >> _LOW_SHIFT)
        table[key, 0] += 1
        table[key, 1] += high
        table[key, 2] += np.int64(offset & _LOW_REST)
        table[key, 3] += high * high


class Kernels(NamedTuple):
    """The three loops, compiled or as NumPy twins.

    Attributes
    ----------
    log_sum : callable
        (x, loc, 1/scale, table) -> sum of the tabulated function, number of values outside the table (they count as 0).
    gradient_sums : callable
        (x, loc, 1/scale, tables, out) -> number outside; `out` gets the sums of log f, of the score, of z times the score, and of the
        other tables.
    bin_values : callable
        (x, centre, table) -> None; adds count and place of each value to its row of `table`.
    compiled : bool
        Whether numba runs them.
    """

    log_sum: Callable[[Floats, float, float, Floats], tuple[float, int]]
    gradient_sums: Callable[[Floats, float, float, Floats, Floats], int]
    bin_values: Callable[[Floats, float, Ints], None]
    compiled: bool


def kernels(n: int) -> Kernels:
    """Return the loops for `n` values: compiled for many values or when numba is loaded already, else, or without numba, NumPy.

    Examples
    --------
    >>> table = np.zeros((INTERVALS + 1, COEFFICIENTS))
    >>> table[:-1, 0] = 1.0
    >>> kernels(3).log_sum(np.array([0.1, -2.0, 1e9]), 0.0, 1.0, table)
    (2.0, 1)
    """
    if n < COMPILE_FROM and sys.modules.get("numba") is None:
        return TWINS
    return compiled() or TWINS


@cache
def compiled() -> Kernels | None:
    """Return the loops compiled by numba (from its cache where there is one), None without numba."""
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        return None
    t = numba.types
    row, rows = t.Array(t.float64, 1, "C", readonly=True), t.Array(t.float64, 2, "C", readonly=True)
    cube = t.Array(t.float64, 3, "C", readonly=True)
    signatures = (
        (_log_sum, t.Tuple((t.float64, t.int64))(row, t.float64, t.float64, rows)),
        (_gradient_sums, t.int64(row, t.float64, t.float64, cube, t.float64[::1])),
        (_bin_values, t.void(row, t.float64, t.int64[:, ::1])),
    )

    def build(cached: bool) -> list[Any]:
        return [numba.njit(signature, nogil=True, cache=cached)(function) for function, signature in signatures]

    try:
        loops = build(cached=True)
    except RuntimeError:  # no place to write the cache
        loops = build(cached=False)
    return Kernels(loops[0], loops[1], loops[2], compiled=True)


# ---- NumPy twins --------------------------------------------------------------------------------------------------------------------


def _places(z: Floats) -> tuple[NDArray[np.intp], Floats, int]:
    bits = np.abs(z).view(np.uint64)
    k = (bits >> _TABLE_SHIFT) - _TABLE_FIRST
    out = k >= _TABLE_END
    k[out] = _TABLE_END
    return k.astype(np.intp), (((bits & _TABLE_REST) << _TABLE_UP) | _ONE).view(np.float64) - 1.5, int(np.count_nonzero(out))


def _polynomial(table: Floats, k: NDArray[np.intp], v: Floats) -> Floats:
    c = table[k].T
    w = v * v
    return np.asarray((c[0] + c[1] * v) + w * ((c[2] + c[3] * v) + w * (c[4] + c[5] * v)))


def _block_sum(values: Floats) -> float:
    """Sum in the order of the loops: one by one in each block, then over the blocks."""
    if not values.size:
        return 0.0
    padded = np.zeros(-(-values.size // _BLOCK) * _BLOCK)
    padded[: values.size] = values
    parts = np.add.accumulate(padded.reshape(-1, _BLOCK), axis=1)[:, -1]
    return float(np.add.accumulate(parts)[-1])


def _log_sum_twin(x: Floats, loc: float, inverse: float, table: Floats) -> tuple[float, int]:
    k, v, outside = _places((x - loc) * inverse)
    return _block_sum(_polynomial(table, k, v)), outside


def _gradient_sums_twin(x: Floats, loc: float, inverse: float, tables: Floats, out: Floats) -> int:
    z = (x - loc) * inverse
    k, v, outside = _places(z)
    z[k == INTERVALS] = 0.0
    for j, table in enumerate(tables):
        p = _polynomial(table, k, v)
        if j == 1:
            out[2] = _block_sum(np.abs(z) * p)
            p = p * np.copysign(1.0, z)
        out[j if j < 2 else j + 1] = _block_sum(p)
    return outside


def _bin_values_twin(x: Floats, centre: float, table: Ints) -> None:
    for start in range(0, x.size, _TWIN_CHUNK):  # sums of a chunk stay below 2^53: exact in the doubles of bincount
        bits = ((x[start : start + _TWIN_CHUNK] - centre) + 0.0).view(np.uint64)
        keys = (bits >> _BIN_SHIFT).astype(np.int64)
        offset = bits & _BIN_REST
        high, low = (offset >> _LOW_SHIFT).astype(float), (offset & _LOW_REST).astype(float)
        negative = keys >= KEYS // 2  # each side is one narrow range of keys
        for side in (~negative, negative):
            if not side.any():
                continue
            k, h = keys[side], high[side]
            first = int(k.min())
            k -= first
            columns = [np.bincount(k), np.bincount(k, weights=h), np.bincount(k, weights=low[side]), np.bincount(k, weights=h * h)]
            table[first : first + columns[0].size] += np.stack(columns, axis=1).astype(np.int64)


TWINS = Kernels(_log_sum_twin, _gradient_sums_twin, _bin_values_twin, compiled=False)
