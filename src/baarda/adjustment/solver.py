"""The contract that both solvers keep."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


class Solver(Protocol):
    """Factored normal equations N = A'A of a whitened linear system, some unknowns held fixed."""

    @property
    def rcond(self) -> float:
        """Reciprocal condition number of the scaled (reduced) normal matrix."""

    def at(self, lin: Any) -> Solver:
        """Return this factor for the system at a state nearby, as an approximate one; None only lets the old system go."""

    def solve(self, rhs: Floats) -> Floats:
        """Return N^-1 rhs for (u,) or (u, k) right-hand sides."""

    def least_squares(self, y: Floats) -> tuple[Floats, Floats]:
        """Return x = N^-1 A'y for an (n,) vector in the place of the whitened observations, and A x."""

    def hat(self, whole: bool = True) -> list[Floats]:
        """Return for each chunk the (N, m, m) diagonal blocks of A N^-1 A'; without `whole` only their diagonals (N, m) if it is plain."""

    def blocks(self, columns: Ints) -> Floats:
        """Return the (N, w, w) blocks of N^-1 for (N, w) columns; -1 = fixed, zero."""

    def pairs(self, a: Ints, b: Ints) -> Floats:
        """Return the (len(a), len(b)) block of N^-1 for any columns; -1 = fixed, zero."""
