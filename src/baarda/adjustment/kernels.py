"""The loops over object points: compiled for large blocks, their NumPy twins for small ones or without numba.

The loops know no camera. `accumulate` eliminates the points of clusters and adds their part to a front of the reduced system; `forward`
and `backward` solve with the eliminated points; `statistics` goes the way back, from the inverse of a front to the cofactors of the
points and the diagonal of A N^-1 A'.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from baarda.adjustment import point_loop_twins as twins
from baarda.adjustment import point_loops
from baarda.compiling import compile_loops

COMPILE_FROM = 60_000  # row blocks from which the loops are compiled


@dataclass(frozen=True)
class Kernels:
    """The loops, compiled or not; `forward` and `backward` are there only compiled."""

    accumulate: Any
    statistics: Any
    forward: Any
    backward: Any
    extend: Any
    gather: Any
    compiled: bool


@cache
def compiled() -> Kernels | None:
    """Return the compiled loops, None where numba is not installed."""
    loops = compile_loops(point_loops.OUTER, point_loops.INNER)
    if loops is None:
        return None
    accumulate, statistics, forward, backward, extend, gather = loops
    return Kernels(accumulate, statistics, forward, backward, extend, gather, compiled=True)


def cached() -> bool:
    """Return whether compiled loops lie in numba's cache, or need not be compiled."""
    loops = compiled()
    path = loops and getattr(loops.accumulate.stats, "cache_path", None)
    return not path or any(Path(path).glob("point_loops._accumulate-*.nbi"))


TWINS = Kernels(twins.accumulate, twins.statistics, None, None, twins.extend, twins.gather, compiled=False)


def kernels(blocks: int) -> Kernels:
    """Return the loops for a number of row blocks: NumPy for few, so that nothing waits for the compiler, or without numba."""
    return TWINS if blocks < COMPILE_FROM else compiled() or TWINS
