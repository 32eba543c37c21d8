"""Helmert blocking: one large network adjusted in parts, each by its own worker, joined by the border that they share.

Each part linearises, eliminates its object points and its interior, and returns the normal equations reduced to its border; they are
added in the order of the parts and solved once; the border's solution goes down again. Iterations, damping, convergence, datum and
cofactors are those of an adjustment in one piece.

F. R. Helmert, Die mathematischen und physikalischen Theorieen der höheren Geodäsie, part 1 (1880); H. Wolf, Z. Vermess. 103 (1978) 101.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import memory
from baarda.adjustment.result import Iteration
from baarda.errors import NotEnoughMemory, UsageError
from baarda.hypotheses.levels import Options
from baarda.network import Table
from baarda.procedures import helmert_part as tasks
from baarda.procedures import helmert_statistics as stat
from baarda.procedures.helmert_border import Handles, Joint, Parts
from baarda.procedures.helmert_iteration import Blocked, Run
from baarda.procedures.helmert_stand import Source
from baarda.procedures.partition_folder import PartitionFolder
from baarda.procedures.task_engines import Engine

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

DENSE = 32.0  # bytes for a pair of border unknowns: matrix, factor, inverse, and what is scaled
GENEROUS = 1000.0  # bytes of an observation in a part, more than usual: to decide before anything is read

__all__ = ["Blocked", "Finished", "Joint", "finish", "gathered_tables", "solve_blocked"]


def _sources(folder: PartitionFolder, options: dict[str, Any], frugal: bool) -> list[Source]:
    out = []
    for k, p in enumerate(folder.parts):
        border = tuple(folder.border[i] for i in p.border)
        out.append(Source(str(folder.place(k).absolute()), p.sha256, k, border, p.border, p.owned, options, folder.centroid, frugal))
    return out


def solve_blocked(
    folder: PartitionFolder,
    engine: Engine,
    frugal: bool | None = None,
    progress: Callable[[Iteration], None] | None = None,
    tell: Callable[[str], None] | None = None,
    **options: Any,
) -> Blocked:
    """Adjust a network in parts.

    Parameters
    ----------
    folder : PartitionFolder
    engine : Engine
        See `baarda.procedures.task_engines.open_engine`.
    frugal : bool, optional
        Whether parts compute their partials and factors again for each task instead of keeping them; by default where they would not fit.
    progress : callable, optional
        Is told every iteration.
    tell : callable, optional
        Is told what takes memory.
    **options
        Fields of `baarda.adjustment.solve.Settings`: datum, iterations, tolerance, image_sigma, residual_plane, min_rays, jobs.

    Returns
    -------
    Blocked

    Raises
    ------
    UsageError
        If an option makes no sense for a network in parts.
    RedundancyNotPositive, DatumDefect, Singular
        As `baarda.adjust`.
    NotEnoughMemory
        If a part, or the border, needs more memory than there is.
    """
    for name in ("robust", "camera"):
        if options.get(name):
            where = "; give --camera to split" if name == "camera" else ""
            raise UsageError(f"a network in parts is adjusted by least squares with the cameras as they were split{where}")
    options = {k: v for k, v in options.items() if k not in ("solver", "progress", "tell", "robust", "camera")}
    first = _many(engine, folder) if frugal is None else frugal
    sources = _sources(folder, options, first)
    stands = [engine.submit(k, tasks.begin, s) for k, s in enumerate(sources)]
    facts = tuple(engine.gather([engine.submit(k, tasks.facts, s) for k, s in enumerate(stands)]))
    joint = _joined(folder, facts)
    _check_top(joint, tell)
    parts = Parts(engine, joint)
    if frugal is None:
        frugal = _short(engine, joint)
    if frugal and tell is not None:
        tell("parts do not fit into memory side by side: partials and factors are computed again for each task")
    if frugal != first:
        stands = parts.each(tasks.settled, stands, frugal)
    run = Run(parts, joint.settings, progress)
    return run.solve(stands)


def _joined(folder: PartitionFolder, facts: tuple[tasks.Facts, ...]) -> Joint:
    """Number the border unknowns of all parts."""
    codes = np.concatenate([np.zeros((0, 2), dtype=np.intp), *(f.codes for f in facts)])
    _, first, inverse = np.unique(codes, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    cuts = np.cumsum([0, *(len(f.codes) for f in facts)])
    names = [name for f in facts for name in f.names]
    squares, places = sum(f.squares for f in facts), sum(f.places for f in facts)
    size = float(np.sqrt(squares / places)) if places else 0.0
    at = tuple(inverse[a:b].astype(np.intp) for a, b in pairwise(cuts))
    return Joint(folder, facts, at, tuple(names[i] for i in first), size or 1.0, facts[0].settings)


def _check_top(joint: Joint, tell: Callable[[str], None] | None) -> None:
    needed, there = DENSE * joint.border**2, memory.available()
    if needed > there:
        raise NotEnoughMemory(
            f"the border of {joint.border} unknowns needs about {needed / 1e9:.1f} GB of memory where the parts are joined; "
            f"{there / 1e9:.1f} GB are available: split into fewer parts"
        )
    if tell is not None:
        largest = max(f.needed for f in joint.facts)
        tell(
            f"{len(joint.facts)} parts, a border of {joint.border} of {joint.unknowns} unknowns: up to {largest / 1e9:.3g} GB per part, "
            f"{needed / 1e9:.3g} GB for the border"
        )


def _many(engine: Engine, folder: PartitionFolder) -> bool:
    """Return whether, by the numbers of observations, the parts of a worker may not fit side by side into what it may take."""
    needed = [GENEROUS * p.observations for p in folder.parts]
    per_worker = np.bincount(np.arange(len(needed)) % (1 if engine.shared else engine.count), weights=needed)
    return bool(per_worker.max() > 0.5 * engine.memory)


def _short(engine: Engine, joint: Joint) -> bool:
    """Return whether the parts of a worker do not fit side by side into what it may take."""
    needed = [1.5 * f.needed for f in joint.facts]  # beside it the next linearisation
    if engine.shared:
        return sum(needed) > engine.memory
    per_worker = np.bincount(np.arange(len(needed)) % engine.count, weights=needed)
    return bool(per_worker.max() > 0.6 * engine.memory)  # beyond, Dask begins to move results to the disk


def finish(
    blocked: Blocked,
    engine: Engine,
    levels: Options | None = None,
    out: str | None = None,
    write: Any = None,
) -> Finished:
    """Make the statistics of a network in parts: each part its own, which it writes itself.

    Parameters
    ----------
    blocked : Blocked
    engine : Engine
        The same that solved it.
    levels : Options, optional
    out : str, optional
        Folder of the result, which all workers can reach.
    write : callable, optional
        Writes a table to a path without extension; a function or object that workers can import.

    Returns
    -------
    Finished
    """
    options = Options() if levels is None else levels
    made, images = _statistics(blocked, engine)
    parts = Parts(engine, blocked.joint)
    names = [p.folder for p in blocked.joint.source.parts]
    return Finished(blocked, tuple(parts.all(stat.finished, made, options, images, out, names, write)), options)


def gathered_tables(blocked: Blocked, engine: Engine, levels: Options | None = None) -> dict[str, Table]:
    """Return the tables of all parts one after the other: for networks small enough to fetch, and as a check.

    Parameters
    ----------
    blocked : Blocked
    engine : Engine
    levels : Options, optional

    Returns
    -------
    dict of Table
        observations, points, images, unknowns.
    """
    made, images = _statistics(blocked, engine)
    found = Parts(engine, blocked.joint).all(stat.all_tables, made, Options() if levels is None else levels, images)
    return {
        kind: Table({name: np.concatenate([f[kind][name] for f in found]) for name in found[0][kind].columns}, found[0][kind].units)
        for kind in found[0]
    }


def _statistics(blocked: Blocked, engine: Engine) -> tuple[Handles, list[stat.ImageSums]]:
    """Send the cofactors of the border down; return the statistics of the parts, and the sums of the images that each owns."""
    joint, datum = blocked.joint, blocked.datum
    parts, d = Parts(engine, joint), blocked.datum.count
    whole = stat.Whole(blocked.objective, blocked.redundancy, joint.unknowns, blocked.converged, d, datum.name, datum.text)
    k: Any = None
    c = np.zeros((d, d))
    if datum.tie is not None:
        begun = parts.each(tasks.constraint_solved, blocked.stands, datum.tie)
        x = blocked.top.solve(joint.sum(parts.all(tasks.rhs_of, begun), (d,)))
        k = parts.each(tasks.constraint_expanded, blocked.stands, begun, [x[at] for at in joint.at])
        c = parts.total(tasks.condition_products, blocked.stands, k, datum.tie)
        c = 0.5 * (c + c.T)
    q = blocked.top.inverse()
    made = parts.each(stat.statistics, blocked.stands, [q[np.ix_(at, at)] for at in joint.at], whole, datum.tie, datum.inverse, k, c)
    del q
    sums = parts.all(stat.image_sums, made)
    count, squares = np.zeros(len(joint.source.border), dtype=np.intp), np.zeros(len(joint.source.border))
    for s in sums:
        count[s.codes] += s.points
        squares[s.codes] += s.squares
    images = []
    for p, s in zip(joint.source.parts, sums, strict=True):
        own = s.codes[np.isin(s.codes, p.owned)]
        images.append(stat.ImageSums(own, count[own], squares[own]))
    return made, images


@dataclass(frozen=True)
class Finished:
    """What a network in parts tells when its tables are written.

    Attributes
    ----------
    blocked : Blocked
    parts : tuple of PartSummary
    options : Options
    """

    blocked: Blocked
    parts: tuple[stat.PartSummary, ...]
    options: Options

    @property
    def redundancy_sum(self) -> float:
        """The sum of all redundancy numbers; it equals r."""
        return sum(p.redundancy for p in self.parts)
