"""How much memory an adjustment will take, told before it begins, and a refusal where it cannot fit."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np

from baarda.adjustment.linearize import evaluated_groups
from baarda.adjustment.structure import Structure
from baarda.errors import NotEnoughMemory
from baarda.executors import memory_limit
from baarda.network import Network, Unknowns
from baarda.observations import Kind

DOUBLE = 8
TOLD_FROM = 0.5e9  # bytes
MANY = 2_000_000  # observations from which it is worth the time to hand memory back


def available() -> float:
    """Return the bytes that this process may still take of the machine, its control group or worker; infinite where nothing is told."""
    found = [np.inf]
    limit_of_worker = memory_limit()
    if np.isfinite(limit_of_worker):
        found.append(limit_of_worker - _resident())
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                found.append(1024.0 * float(line.split()[1]))
    except (OSError, ValueError):
        if hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
            found.append(float(os.sysconf("SC_AVPHYS_PAGES")) * float(os.sysconf("SC_PAGE_SIZE")))
    try:
        group = Path("/sys/fs/cgroup")
        limit, used = (group / name for name in ("memory.max", "memory.current"))
        found.append(float(limit.read_text(encoding="ascii")) - float(used.read_text(encoding="ascii")))
    except (OSError, ValueError):  # "max", or no control group
        pass
    return min(found)


def _resident() -> float:
    """Return the bytes this process has, 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return float(pages) * float(os.sysconf("SC_PAGE_SIZE"))


@cache
def _trim() -> Callable[[int], int] | None:
    try:
        return cast(Callable[[int], int], ctypes.CDLL(None).malloc_trim)
    except (AttributeError, OSError, TypeError):  # another C library
        return None


def release(count: int) -> None:
    """Hand back to the system what was freed but the C library keeps, where it can be asked for that, after work on many observations."""
    trim = _trim()
    if trim is not None and count >= MANY:
        trim(0)


def of_rows(unknowns: Unknowns, groups: Sequence[Kind], network: Network) -> float:
    """Return the bytes of partials that are stored, misclosures, nodes and results of all observations.

    Parameters
    ----------
    unknowns : Unknowns
    groups : sequence of Kind
    network : Network
    """
    camera = unknowns["camera"]
    widths = np.diff(camera.offsets)
    free = [(camera.columns[a:b] >= 0).sum() for a, b in zip(camera.offsets[:-1], camera.offsets[1:], strict=True)]
    width = 9 + (int(max(free)) if len(widths) else 0)
    scalars = [len(g) * len(g.components) for g in groups]
    evaluated = evaluated_groups(groups, network, unknowns)
    stored = sum(n for g, n in enumerate(scalars) if g not in evaluated)
    return float(DOUBLE * (sum(scalars) * 10 + stored * width) + DOUBLE * unknowns.count * 12)


def of_dense(unknowns: Unknowns) -> float:
    """Return the bytes of the dense solver: normal matrix, factor and inverse."""
    return 4.0 * DOUBLE * unknowns.count**2


def of_fronts(structure: Structure) -> float:
    """Return the bytes of the factor, and of the largest fronts that are held at a time."""
    sizes = np.array([len(f.columns) for f in structure.fronts], dtype=float)
    pivots = np.array([f.pivots for f in structure.fronts], dtype=float)
    if not len(sizes):
        return 0.0
    waiting = np.sort((sizes - pivots) ** 2)[::-1]
    depth = int(np.ceil(np.log2(len(sizes) + 1))) + 2
    return float(DOUBLE * ((sizes * pivots).sum() + 3.0 * sizes.max() ** 2 + 2.0 * waiting[:depth].sum()))


def check(needed: float, what: str, tell: Callable[[str], None] | None) -> None:
    """Tell the estimate where it is large; refuse where it exceeds what there is.

    Raises
    ------
    NotEnoughMemory

    Examples
    --------
    >>> check(1e18, "the factor", None)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    baarda.errors.NotEnoughMemory: the factor would take about 1000000000.0 GB of memory; ... GB are available
    """
    there = available()
    if needed > there:
        raise NotEnoughMemory(f"{what} would take about {needed / 1e9:.1f} GB of memory; {there / 1e9:.1f} GB are available")
    if tell is not None and needed >= TOLD_FROM:
        tell(f"{what}: about {needed / 1e9:.1f} GB of memory")
