"""Cofactors of the unknowns in the datum asked for: any block, from the selected blocks of a solver or by solves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.datum import Datum
from baarda.adjustment.linear_system import PIECE
from baarda.adjustment.solver import Solver

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Cofactors:
    """Q = S N^-1 S' of a solved system (unit variance factor)."""

    solver: Solver
    datum: Datum
    count: int

    def solve(self, rhs: Floats) -> Floats:
        """Return Q rhs for (u,) or (u, k) right-hand sides."""
        return self.datum.transform(self.solver.solve(self.datum.transform_transposed(rhs)))

    def of(self, a: Ints, b: Ints | None = None) -> Floats:
        """Return the (len(a), len(b)) block of Q for columns a and b; zero where a column is -1 (fixed)."""
        b = a if b is None else b
        if len(b) > len(a):
            return self.of(b, a).T
        out = self.solver.pairs(a, b)
        if self._inner is None:
            return out
        t, k, c = self._inner
        return np.asarray(out - t[a] @ k[b].T - k[a] @ t[b].T + t[a] @ c @ t[b].T)

    @cached_property
    def _inner(self) -> tuple[Floats, Floats, Floats] | None:
        t = self.datum.transfer
        if t is None or self.datum.conditions is None:
            return None
        k = self.solver.solve(self.datum.conditions)
        row = np.zeros((1, t.shape[1]))
        return np.concatenate([t, row]), np.concatenate([k, row]), self.datum.conditions.T @ k

    def blocks(self, columns: Ints) -> Floats:
        """Return the (N, w, w) diagonal blocks of Q for (N, w) columns, as a solver's `blocks`."""
        found = self.solver.blocks(columns)
        if self._inner is None:
            return found
        out = np.empty_like(found)
        for begin in range(0, len(columns), PIECE):
            some = slice(begin, begin + PIECE)
            t, k, c = (self._inner[0][columns[some]], self._inner[1][columns[some]], self._inner[2])
            mixed = t @ k.transpose(0, 2, 1)
            out[some] = found[some] - mixed - mixed.transpose(0, 2, 1) + t @ c @ t.transpose(0, 2, 1)
        return out
