"""Many blocks, each adjusted and tested by itself: one result folder each, a row each, and what the rows say together."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from baarda import __version__
from baarda.adjustment import adjust
from baarda.errors import BaardaError, NotEnoughMemory, OutputError, UsageError
from baarda.executors import Failure, Workers, memory_limit
from baarda.formats import digest, nameable, read
from baarda.hypotheses.levels import Options
from baarda.network import Network
from baarda.procedures.strategy import Plan, carry_out
from baarda.procedures.testing import Analysis, analyse

__all__ = ["BatchOptions", "BlockJob", "Row", "adjust_block", "block_jobs", "run_batch", "sources"]

SCHEMA = "baarda.block/1"
BLOCKS, RECORDS = "blocks", "records"
_LONGEST_NAME = 120
_ALONE = threading.Lock()  # threads of one worker would change each other's number of BLAS threads
Row = dict[str, Any]
Writer = Callable[[Analysis, Path, dict[str, Any]], object]

#: The columns of a row, in order; what does not apply is None.
COLUMNS = (
    "block",
    "source",
    "status",
    "message",
    "exit_code",
    "format",
    "images",
    "object_points",
    "observations",
    "unknowns",
    "redundancy",
    "iterations",
    "sigma0",
    "global_statistic",
    "global_p_value",
    "global_rejected",
    "worst_observation",
    "worst_statistic",
    "worst_p_value",
    "worst_limit",
    "suspected",
    "removed",
    "data_snooping_rejected",
    "control_points_rejected",
    "check_points_rejected",
    "assumptions",
    "input_sha256",
    "result_sha256",
)


@dataclass(frozen=True)
class BatchOptions:
    """What holds for all blocks.

    Attributes
    ----------
    settings : dict
        Fields of `baarda.adjustment.solve.Settings`.
    levels : dict
        Fields of `baarda.hypotheses.levels.Options`.
    plan : dict
        Fields of `baarda.procedures.strategy.Plan`.
    format, control : str or None
        As in `baarda.read`.
    written : dict
        What the writer of the result folders is told: format of tables, language.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    levels: dict[str, Any] = field(default_factory=dict)
    plan: dict[str, Any] = field(default_factory=dict)
    format: str | None = None
    control: str | None = None
    written: dict[str, Any] = field(default_factory=dict)

    def sha256(self) -> str:
        """Return a hash of all that changes results: options and version, not the number of threads."""
        content = {**vars(self), "settings": {k: v for k, v in self.settings.items() if k != "jobs"}, "version": __version__}
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


@dataclass(frozen=True)
class BlockJob:
    """One block: its name, its source as typed and as it is found from anywhere, the folder of the batch, the options."""

    name: str
    source: str
    place: str
    out: str
    options: BatchOptions

    @property
    def folder(self) -> Path:
        """The result folder of the block."""
        return Path(self.out) / BLOCKS / self.name

    @property
    def record(self) -> Path:
        """The file that says of what input, with which options, the result folder was made."""
        return Path(self.out) / RECORDS / f"{self.name}.json"


def sources(patterns: Sequence[str]) -> list[str]:
    """Return the sources that patterns name, each once, sorted within a pattern.

    Parameters
    ----------
    patterns : sequence of str
        Files, folders, or shell patterns (``**`` is any number of folders).

    Returns
    -------
    list of str
        As typed.

    Raises
    ------
    UsageError
        If a pattern matches nothing, or a name is not UTF-8.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("b2", "b1"):
    ...         (Path(folder) / name).mkdir()
    ...     [Path(s).name for s in sources([f"{folder}/b*", f"{folder}/b1"])]
    ['b1', 'b2']
    """
    found: dict[str, str] = {}
    for pattern in patterns:
        matched = [pattern] if Path(pattern).exists() else sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 (a pattern may be absolute)
        if not matched:
            raise UsageError(f"nothing matches {pattern!r}")
        for source in matched:
            nameable(source)
            found.setdefault(os.path.realpath(source), source)
    return list(found.values())


def block_name(source: str) -> str:
    """Return the name of a block: its path in one word; where that loses something, with the beginning of a hash.

    Parameters
    ----------
    source : str

    Returns
    -------
    str
        Depends on nothing but the path, so that another run with more blocks finds the same folders.

    Examples
    --------
    >>> block_name("/data/east/sparse/0"), block_name("a b")
    ('data__east__sparse__0', 'a-b-c8687a08')
    """
    parts = [p for p in Path(os.path.normpath(source)).parts if p not in ("/", os.sep)]
    plain = "__".join(parts)
    name = re.sub(r"[^\w.-]", "-", plain).lstrip(".")[-_LONGEST_NAME:]
    lossless = name == plain and not any("__" in p or p == ".." for p in parts)
    return name if lossless else f"{name}-{hashlib.sha256(source.encode('utf-8', 'surrogateescape')).hexdigest()[:8]}"


def block_jobs(found: Sequence[str], out: str | Path, options: BatchOptions) -> list[BlockJob]:
    """Return the jobs of sources.

    Parameters
    ----------
    found : sequence of str
        See `sources`.
    out : str or Path
        Folder of the batch; workers of a cluster must see it, and the sources, under the same path.
    options : BatchOptions

    Returns
    -------
    list of BlockJob

    Raises
    ------
    UsageError
        If a source lies in the folder of the batch.
    """
    target = os.path.realpath(out)
    for source in found:
        if os.path.commonpath([target, os.path.realpath(source)]) == target:
            raise UsageError(f"{source} lies in the folder of the batch ({out}): choose another place")
    control = None if options.control is None else str(Path(options.control).absolute())
    options = replace(options, control=control)
    return [BlockJob(block_name(s), s, str(Path(s).absolute()), target, options) for s in found]


# ---- one block, wherever it is worked on ---------------------------------------------------------------------------------------------


def adjust_block(job: BlockJob, write: Writer) -> Row:
    """Adjust and test a block and write its result folder, or find that this is done.

    Parameters
    ----------
    job : BlockJob
    write : callable
        ``(analysis, folder, facts) -> None``, which workers can import; the facts differ from run to run.

    Returns
    -------
    dict
        See `COLUMNS`; a failure is a row with its message.
    """
    with _ALONE, threadpool_limits(limits=1, user_api="blas"):  # more threads sum in another order
        known = finished(job)
        if known is not None:
            return {**known, "kept": True}
        try:
            return _made(job, write)
        except (OutputError, OSError) as error:
            raise _outside(error, job) from None
        except BaardaError as error:
            return failed_row(job, str(error), error.exit_code)
        except MemoryError:
            return failed_row(job, "out of memory", 4)
        except Exception as error:  # one block must not end the run: what nobody foresaw is told, too
            return failed_row(job, f"unforeseen {type(error).__name__}: {error}", 2)


def _outside(error: BaseException, job: BlockJob) -> OutputError:
    """What the block cannot help (a full disk): another worker may try again."""
    if isinstance(error, OSError):
        return OutputError(f"cannot read or write {error.filename or job.source}: {error.strerror or error}")
    return OutputError(str(error))


def _made(job: BlockJob, write: Writer) -> Row:
    o, started = job.options, time.perf_counter()
    job.record.unlink(missing_ok=True)  # of another input or other options
    with _files_read() as opened:
        network = read(Path(job.place), o.format, o.control)
    network = replace(network, path=job.source)
    inputs = _inputs(job, network, opened)
    _check_memory(network)
    levels, plan = Options(**o.levels), Plan(**o.plan)
    strategy = None
    if plan.empty:
        adjustment = adjust(network, **o.settings)
    else:
        adjustment, strategy = carry_out(network, plan, levels, None, **o.settings)
    analysis = replace(analyse(adjustment, levels), strategy=strategy)
    write(analysis, job.folder, {"seconds": round(time.perf_counter() - started, 3)})
    row = _row(job, analysis, folder_sha256(job.folder))
    content = {"schema": SCHEMA, "options": o.sha256(), "inputs": inputs, "row": row}
    _write_whole(job.record, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return row


def finished(job: BlockJob) -> Row | None:
    """Return the row of a block that is done: same input, same options, and the result folder as it was written; else None."""
    try:
        known = json.loads(job.record.read_text(encoding="utf-8"))
        if known["schema"] != SCHEMA or known["options"] != job.options.sha256():
            return None
        row: Row = known["row"]
        if row["result_sha256"] != folder_sha256(job.folder):
            return None
        same = all(digest(Path(place)) == sha256 for place, sha256 in known["inputs"].items())
        return row if same and job.place in known["inputs"] else None
    except (OSError, BaardaError, ValueError, KeyError, TypeError):  # nothing there, or not what was written: done again
        return None


def _inputs(job: BlockJob, network: Network, opened: set[str]) -> dict[str, str]:
    """Return the hashes of the source and of the files beside it that were read, by path."""
    place = os.path.realpath(job.place)
    beside = {p for p in opened if Path(p).is_file() and p != place and not p.startswith(place + os.sep)}
    out = {job.place: network.sha256 or digest(Path(job.place))}
    return out | {p: digest(Path(p)) for p in sorted(beside)}


_READING = threading.local()
_NOT_DATA = tuple(
    {os.path.realpath(p) + os.sep for p in (sys.prefix, sys.base_prefix, Path(__file__).parent.parent, "/proc", "/sys", "/dev")}
)


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    heard: set[str] | None = getattr(_READING, "files", None)
    if heard is not None and event == "open" and isinstance(arguments[0], (str, bytes, os.PathLike)):
        name = os.path.realpath(os.fsdecode(arguments[0]))
        if not name.startswith(_NOT_DATA):
            heard.add(name)


@contextmanager
def _files_read() -> Iterator[set[str]]:
    """Yield the set of files that are opened meanwhile: a script may name others, whose change must be noticed."""
    if not hasattr(sys, "_baarda_hears"):
        sys.addaudithook(_hear)  # cannot be taken away, but costs nothing while nobody listens
        sys._baarda_hears = True  # type: ignore[attr-defined]
    files: set[str] = set()
    _READING.files = files
    try:
        yield files
    finally:
        _READING.files = None


def _check_memory(network: Network) -> None:
    """Refuse a block that cannot fit into the worker of a cluster; on one machine the adjustment itself looks."""
    limit = memory_limit()
    rows = sum(len(g) * len(g.components) for g in network.observations)
    unknowns = 6 * len(network.images.labels) + 3 * len(network.points.labels) + sum(len(c.values) for c in network.cameras)
    needed = 8.0 * rows * (21 + max((len(c.values) for c in network.cameras), default=0)) + 96.0 * unknowns
    if unknowns <= 1500:
        needed += 32.0 * unknowns**2
    if needed > limit:
        raise NotEnoughMemory(f"the block needs at least {needed / 1e9:.2f} GB of memory; the worker may take {limit / 1e9:.2f} GB")


def _row(job: BlockJob, analysis: Analysis, sha256: str) -> Row:
    a = analysis.adjustment
    row = dict.fromkeys(COLUMNS) | {
        "block": job.name,
        "source": job.source,
        "status": a.status,
        "exit_code": 0 if analysis.converged else 3,
        "format": a.network.format,
        "images": len(a.network.images.labels),
        "object_points": int((~a.aside).sum()),
        "observations": a.count,
        "unknowns": a.numbering.count,
        "redundancy": a.redundancy,
        "iterations": len(a.history) - 1,
        "assumptions": len(a.assumptions),
        "input_sha256": a.network.sha256,
        "result_sha256": sha256,
    }
    if not analysis.converged:
        return row | {"message": f"not converged after {len(a.history) - 1} iterations, nothing was tested; {a.contradictions()}"}
    row["sigma0"] = float(a.sigma0)
    whole = analysis.tests_named("global_variance_factor")
    if whole:
        row |= {
            "global_statistic": float(whole[0].statistic),
            "global_p_value": float(whole[0].p_value),
            "global_rejected": bool(whole[0].rejected),
        }
    single = analysis.tests_named("data_snooping")
    if single and single[0].details.get("extreme") is not None:
        extreme, critical = single[0].details["extreme"], single[0].critical
        row |= {
            "worst_observation": str(extreme["label"]),
            "worst_statistic": float(extreme["statistic"]),
            "worst_p_value": float(extreme["p_value"]),
            "worst_limit": float(critical[1] if isinstance(critical, tuple) else critical),
            "suspected": len(analysis.suspected),
        }
    s = analysis.strategy
    if s is not None and s.snooping is not None:
        row["removed"] = 0 if s.snooping.removed is None else len(s.snooping.removed)
    gates = {f"{name}_rejected": bool(rejected) for name, rejected in analysis.gates.items() if name != "global_variance_factor"}
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in (row | gates).items()}


def failed_row(job: BlockJob, message: str, exit_code: int) -> Row:
    """Return the row of a block that failed."""
    told = message.replace(job.place, job.source)  # as typed: the same from any worker
    return dict.fromkeys(COLUMNS) | {
        "block": job.name,
        "source": job.source,
        "status": "failed",
        "message": told,
        "exit_code": exit_code,
    }


def folder_sha256(folder: Path) -> str:
    """Return a hash over sorted names, sizes and contents of a result folder without `run.json`, which holds timings."""
    total = hashlib.sha256()
    for file in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = file.relative_to(folder).as_posix()
        if name != "run.json":
            data = file.read_bytes()
            total.update(len(name).to_bytes(8, "little") + name.encode() + len(data).to_bytes(8, "little") + data)
    return total.hexdigest()


def _write_whole(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}-{os.getpid()}-{threading.get_ident()}")
    try:
        beside.write_text(text, encoding="utf-8", newline="\n")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


# ---- all blocks ----------------------------------------------------------------------------------------------------------------------


def run_batch(
    jobs: Sequence[BlockJob], write: Writer, workers: Workers | None = None, progress: Callable[[int, int, Row], None] | None = None
) -> list[Row]:
    """Adjust and test all blocks.

    Parameters
    ----------
    jobs : sequence of BlockJob
    write : callable
        See `adjust_block`.
    workers : Workers, optional
        See `baarda.executors.open_workers`; this process by default.
    progress : callable, optional
        Called with the number of blocks that are done, of all, and the row of the last.

    Returns
    -------
    list of dict
        The rows in the order of the jobs, whoever worked on them.

    Raises
    ------
    ClusterLost
        If nobody is left who could work; finished folders are kept.
    OutputError
        If the folder of the batch cannot be written.
    """
    rows: list[Row | None] = [None] * len(jobs)
    clean(jobs)
    try:
        engine = Workers() if workers is None else workers
        for done, outcome in enumerate(engine.run(partial(adjust_block, write=write), jobs, again=("OutputError", "WorkerDied")), start=1):
            job, failure = jobs[outcome.index], outcome.failure
            row = outcome.value if failure is None else _lost(job, failure)
            rows[outcome.index] = row
            if progress is not None and row is not None:
                progress(done, len(jobs), row)
    finally:
        clean(jobs)
    return [{k: row[k] for k in COLUMNS} for row in rows if row is not None]


def _lost(job: BlockJob, failure: Failure) -> Row:
    return failed_row(job, failure.message, failure.exit_code)


def clean(jobs: Sequence[BlockJob]) -> None:
    """Remove what a killed worker left half-written: temporary folders and files beside those of these blocks."""
    names = {job.name for job in jobs}
    for out in {job.out for job in jobs}:
        for folder in (Path(out) / BLOCKS, Path(out) / RECORDS):
            if not folder.is_dir():
                continue
            for left in folder.glob(".*-*"):
                own = left.name[1:].rpartition("-")[0].removesuffix("-old")
                own = own.rpartition("-")[0].removesuffix(".json") if folder.name == RECORDS else own
                if own in names:
                    shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
