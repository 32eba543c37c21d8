"""Products of the design matrix with a vector: compiled loops for large systems, and their NumPy twins."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.compiling import compile_loops

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

COMPILE_FROM = 100_000  # observations from which the loops are compiled


def _times(jacobian: Floats, nodes: Ints, table: Ints, x: Floats, first: Ints, out: Floats) -> None:
    """Add the products of (N, m, w) partials with the columns `table[nodes]` of x to the rows `first`, `first` + 1, ... of out."""
    n, m, w = jacobian.shape
    for i in range(n):
        at = table[nodes[i]]
        for r in range(m):
            total = 0.0
            for j in range(w):
                total += jacobian[i, r, j] * x[at[j]]
            out[first[i] + r] += total


def _gathered(jacobian: Floats, nodes: Ints, table: Ints, y: Floats, first: Ints, squared: bool, out: Floats) -> None:
    """Add the transposed products (of the squares of the partials) with y to the columns `table[nodes]` of out; -1 is the last."""
    n, m, w = jacobian.shape
    for i in range(n):
        at = table[nodes[i]]
        for j in range(w):
            total = 0.0
            for r in range(m):
                value = jacobian[i, r, j]
                total += (value * value if squared else value) * y[first[i] + r]
            out[at[j]] += total


def _times_many(jacobian: Floats, nodes: Ints, table: Ints, x: Floats, first: Ints, out: Floats) -> None:
    """As `_times` for several vectors side by side, x (u + 1, k) and out (n, k)."""
    n, m, w = jacobian.shape
    k = x.shape[1]
    for i in range(n):
        at = table[nodes[i]]
        for r in range(m):
            row = out[first[i] + r]
            for j in range(w):
                value, own = jacobian[i, r, j], x[at[j]]
                for c in range(k):
                    row[c] += value * own[c]


def _gathered_many(jacobian: Floats, nodes: Ints, table: Ints, y: Floats, first: Ints, out: Floats) -> None:
    """As `_gathered` for several vectors side by side."""
    n, m, w = jacobian.shape
    k = y.shape[1]
    for i in range(n):
        at = table[nodes[i]]
        for r in range(m):
            row = y[first[i] + r]
            for j in range(w):
                value, own = jacobian[i, r, j], out[at[j]]
                for c in range(k):
                    own[c] += value * row[c]


def _times_twin(jacobian: Floats, nodes: Ints, table: Ints, x: Floats, first: Ints, out: Floats) -> None:
    out[first[:, None] + np.arange(jacobian.shape[1])] += np.einsum("nmw,nw->nm", jacobian, x[table[nodes]])


def _gathered_twin(jacobian: Floats, nodes: Ints, table: Ints, y: Floats, first: Ints, squared: bool, out: Floats) -> None:
    values = y[first[:, None] + np.arange(jacobian.shape[1])]
    product = np.einsum("nmw,nmw,nm->nw", jacobian, jacobian, values) if squared else np.einsum("nmw,nm->nw", jacobian, values)
    out += np.bincount(table[nodes].ravel() % len(out), product.ravel(), len(out))


@dataclass(frozen=True)
class VectorLoops:
    """The loops, compiled or not."""

    times: Any
    gathered: Any
    times_many: Any
    gathered_many: Any


@cache
def compiled() -> VectorLoops | None:
    """Return the compiled loops, None without numba."""
    loops = compile_loops((_times, _gathered, _times_many, _gathered_many))
    return None if loops is None else VectorLoops(*loops)


def _times_many_twin(jacobian: Floats, nodes: Ints, table: Ints, x: Floats, first: Ints, out: Floats) -> None:
    out[first[:, None] + np.arange(jacobian.shape[1])] += np.einsum("nmw,nwk->nmk", jacobian, x[table[nodes]])


def _gathered_many_twin(jacobian: Floats, nodes: Ints, table: Ints, y: Floats, first: Ints, out: Floats) -> None:
    for own, column in zip(out.T, y.T, strict=True):
        _gathered_twin(jacobian, nodes, table, column, first, False, own)


TWINS = VectorLoops(_times_twin, _gathered_twin, _times_many_twin, _gathered_many_twin)


def vector_loops(count: int) -> VectorLoops:
    """Return the loops for a number of observations."""
    return TWINS if count < COMPILE_FROM else compiled() or TWINS
