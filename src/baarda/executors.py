"""Who does the work: this process, a few processes, any `concurrent.futures.Executor`, or a Dask cluster; the results are the same.

The engine behind an executor schedules, moves, retries and shows; here tasks are only handed over in a fixed order, a bounded number of
them ahead, and what went wrong is told in words. Dask needs the extra `cluster`, which is imported when it is asked for.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, Generic, TypeVar

from baarda import __version__
from baarda.distributions.workers import worker_count
from baarda.errors import BaardaError, MissingExtra, UsageError

__all__ = ["ClusterLost", "Failure", "Outcome", "TaskFailed", "Workers", "end_with_parent", "memory_limit", "open_workers"]

S = TypeVar("S")
T = TypeVar("T")

_PATIENCE = 10.0  # seconds to reach a scheduler
_LOOK = 0.5  # seconds between two looks whether the cluster is still there
_COUNT_AGAIN = 5.0  # seconds between two counts of the workers
_FEWEST_AHEAD = 16  # tasks handed over even where no worker is there yet: a cluster that grows by demand must see some
_FAREWELL = 5.0  # seconds for processes that were told to end
_DEATHS = 2  # of a process that worked on one task alone
Told = Callable[[str], None]


class ClusterLost(BaardaError):
    """The scheduler, or the executor, went away: what is finished stays, and the same command goes on from there."""

    exit_code = 4


class TaskFailed(BaardaError):
    """A task failed where it ran; the exit status is that of its own error."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.message)
        self.exit_code = failure.exit_code


@dataclass(frozen=True)
class Failure:
    """What a task says instead of a result.

    Attributes
    ----------
    message : str
        As the command line would print it.
    exit_code : int
        The exit status that the error has on the command line.
    kind : str
        Name of the error's class.
    worker : str
        Address of the Dask worker on which it happened; empty elsewhere.
    """

    message: str
    exit_code: int
    kind: str
    worker: str = ""


@dataclass(frozen=True)
class Outcome(Generic[T]):
    """How the task with a number ended: with a value or a failure.

    Attributes
    ----------
    index : int
    value : object
        What the function returned; None where it failed.
    failure : Failure or None
    """

    index: int
    value: T | None
    failure: Failure | None = None

    def result(self) -> T:
        """Return the value.

        Raises
        ------
        TaskFailed
            If there is none.
        """
        if self.failure is not None:
            raise TaskFailed(self.failure)
        return self.value  # type: ignore[return-value]


class Workers:
    """The contract of all who work; itself the one worker that this process is.

    Attributes
    ----------
    count : int
        Number of tasks that can run at a time; of a cluster: now.
    name : str
        Who works, in words.
    link : str or None
        Address of the Dask dashboard.
    memory : float
        Bytes that each task may take; infinite where nobody limits it.
    client : object
        The Dask client; None without a cluster.
    """

    count: int = 1
    name: str = "this process"
    link: str | None = None
    memory: float = float("inf")
    client: Any = None

    def run(
        self, function: Callable[[S], T], items: Sequence[S], ahead: int | None = None, again: Sequence[str] = ()
    ) -> Iterator[Outcome[T]]:
        """Apply a function to items and yield how each ended, as they end.

        Parameters
        ----------
        function : callable
            A function of a module, which workers can import.
        items : sequence
        ahead : int, optional
            No task is begun so many places or more after the first one that has not been yielded; no limit by default.
        again : sequence of str
            Kinds of failures that may be the worker's own, such as a full disk: the task is tried once more, by another worker if there
            is one, when no other task is at work.

        Yields
        ------
        Outcome
            In no particular order; each item once.

        Raises
        ------
        ClusterLost
            If there is nobody left who could work.
        """
        for i, item in enumerate(items):
            yield _outcome(i, _task(function, item, __version__))


def _outcome(index: int, value: Any) -> Outcome[Any]:
    return Outcome(index, None, value) if isinstance(value, Failure) else Outcome(index, value)


def _task(function: Callable[[S], T], item: S, version: str) -> T | Failure:
    """Run where the worker is: foreseen errors become values, so that none depends on how an engine carries exceptions."""
    if version != __version__:
        return Failure(f"the worker has baarda {__version__}, the command baarda {version}: install the same version", 2, "UsageError")
    try:
        return function(item)
    except BaardaError as error:
        return Failure(str(error), error.exit_code, type(error).__name__, _address())
    except MemoryError:
        return Failure("out of memory", 4, "NotEnoughMemory", _address())
    except OSError as error:
        place = f" {error.filename}" if error.filename else ""
        return Failure(f"cannot read or write{place}: {error.strerror or error}", 4, "OutputError", _address())


def _worker() -> Any:
    """Return the Dask worker around the running task; None elsewhere."""
    if "distributed.worker" not in sys.modules:
        return None
    try:
        return importlib.import_module("distributed.worker").get_worker()
    except ValueError:  # not within a task
        return None


def _address() -> str:
    worker = _worker()
    return "" if worker is None else str(worker.address)


def memory_limit() -> float:
    """Return the bytes that the Dask worker around the running task may take, shared among its threads; infinite elsewhere.

    Returns
    -------
    float

    Examples
    --------
    >>> memory_limit()
    inf
    """
    worker = _worker()
    limit = None if worker is None else worker.memory_manager.memory_limit
    return float(limit) / max(1, worker.state.nthreads) if limit else float("inf")


@contextmanager
def open_workers(cluster: Any = None, jobs: int | None = None, *, tell: Told | None = None) -> Iterator[Workers]:
    """Yield those who work: the one door to processes, executors and clusters.

    Parameters
    ----------
    cluster : None, str, Executor or dask.distributed.Client
        Address of a Dask scheduler such as ``tcp://host:8786``; ``local`` for a cluster of processes on this machine; any
        `concurrent.futures.Executor` or Dask client, which is not closed; None for processes without Dask.
    jobs : int, optional
        Number of processes without a cluster, and of workers with ``local``; one for each core by default. 1 without a cluster is this
        process.
    tell : callable, optional
        Is told who works and where the dashboard is.

    Yields
    ------
    Workers

    Raises
    ------
    MissingExtra
        If a cluster is asked for without the extra 'cluster'.
    ClusterLost
        If the scheduler cannot be reached.
    UsageError
        If `cluster` is none of these.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> with ThreadPoolExecutor(2) as pool, open_workers(pool) as workers:
    ...     sorted(o.result() for o in workers.run(abs, [-3, 1, -2]))
    [1, 2, 3]
    """
    if cluster is None:
        count = worker_count(jobs)
        yield Workers() if count == 1 else _Processes(count)
    elif isinstance(cluster, Executor):
        yield _Given(cluster)
    elif isinstance(cluster, str):
        with _dask(cluster, jobs) as client:
            workers = _Dask(client, tell)
            if tell is not None:
                tell(f"workers: {workers.name}")
                if workers.link is not None:
                    tell(f"dashboard: {workers.link}{_without_bokeh(cluster)}")
            yield workers
    elif hasattr(cluster, "scheduler_info") and hasattr(cluster, "submit"):
        yield _Dask(cluster)
    else:
        raise UsageError(f"a cluster is an address, 'local', an executor or a Dask client, not {type(cluster).__name__}")


def _without_bokeh(cluster: str) -> str:
    from importlib.util import find_spec

    return " (pip install bokeh to see it)" if cluster == "local" and find_spec("bokeh") is None else ""


# ---- one loop for everything that has futures -----------------------------------------------------------------------------------------


class _Futures(Workers):
    """Tasks handed to something with `submit`; a future calls back when it is done."""

    def run(
        self, function: Callable[[S], T], items: Sequence[S], ahead: int | None = None, again: Sequence[str] = ()
    ) -> Iterator[Outcome[T]]:
        done: queue.SimpleQueue[int] = queue.SimpleQueue()
        futures: dict[int, Any] = {}
        repeated, yielded = set[int](), bytearray(len(items))
        repeats = deque[tuple[int, str]]()
        first = following = 0

        def submit(i: int, avoid: str = "") -> None:
            futures[i] = self._submit(function, items[i], avoid)
            futures[i].add_done_callback(lambda _: done.put(i))

        try:
            while first < len(items):
                most = self._window()
                while following < len(items) and len(futures) < most and (ahead is None or following - first < ahead):
                    submit(following)
                    following += 1
                if repeats and not futures:  # alone: an idle worker, perhaps the one that failed, steals what waits for a busy one
                    submit(*repeats.popleft())
                try:
                    i = done.get(timeout=_LOOK)
                except queue.Empty:
                    self._look()
                    continue
                outcome = self._ended(i, futures.pop(i))
                if outcome.failure is not None and outcome.failure.kind in again and i not in repeated:
                    repeated.add(i)
                    repeats.append((i, outcome.failure.worker))
                    continue
                yield outcome
                yielded[i] = 1
                while first < len(items) and yielded[first]:
                    first += 1
        finally:
            for left in futures.values():
                with contextlib.suppress(Exception):  # a lost cluster cannot cancel
                    left.cancel()

    def _window(self) -> int:
        return max(_FEWEST_AHEAD, 3 * self.count)

    def _submit(self, function: Callable[[Any], Any], item: Any, avoid: str) -> Any:
        raise NotImplementedError

    def _look(self) -> None:
        """Raise ClusterLost if nobody is left."""

    def _ended(self, index: int, future: Any) -> Outcome[Any]:
        return _outcome(index, future.result())


class _Given(_Futures):
    """An executor of the caller."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.count = int(getattr(executor, "_max_workers", 1) or 1)
        self.name = f"{type(executor).__name__} with {self.count} workers"

    def _submit(self, function: Callable[[Any], Any], item: Any, avoid: str) -> Any:
        try:
            return self._executor.submit(_task, function, item, __version__)
        except (BrokenExecutor, RuntimeError) as error:
            raise ClusterLost(f"the executor takes no more tasks: {error}") from None

    def _ended(self, index: int, future: Any) -> Outcome[Any]:
        try:
            return super()._ended(index, future)
        except (BrokenExecutor, CancelledError) as error:
            raise ClusterLost(f"the executor broke: {error}") from None


# ---- processes of our own -------------------------------------------------------------------------------------------------------------


class _Processes(Workers):
    """Processes that are begun again when one dies: its tasks are repeated one by one to find the one that kills."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.name = f"{count} processes"

    def run(
        self, function: Callable[[S], T], items: Sequence[S], ahead: int | None = None, again: Sequence[str] = ()
    ) -> Iterator[Outcome[T]]:
        waiting, alone = deque(range(len(items))), deque[int]()
        deaths: dict[int, int] = {}
        while waiting or alone:
            if alone:  # these were at work when a process died
                try:
                    yield from self._round(function, items, alone, 1, None)
                except _Died as died:
                    (i,) = died.tasks  # one at a time
                    deaths[i] = deaths.get(i, 0) + 1
                    if deaths[i] < _DEATHS:
                        alone.append(i)
                    else:
                        yield Outcome(i, None, Failure("the process that worked on it died (killed, or out of memory)", 4, "WorkerDied"))
                continue
            try:
                yield from self._round(function, items, waiting, self.count, ahead)
            except _Died as died:
                alone.extend(died.tasks)

    def _round(
        self, function: Callable[[S], T], items: Sequence[S], waiting: deque[int], count: int, ahead: int | None
    ) -> Iterator[Outcome[T]]:
        """Work through the waiting tasks until they are done or a process dies."""
        before = set(multiprocessing.active_children())
        pool = ProcessPoolExecutor(min(count, len(waiting)), multiprocessing.get_context("spawn"), _deaf)
        done: queue.SimpleQueue[int] = queue.SimpleQueue()
        futures: dict[int, Any] = {}
        whole, ahead_of_all = False, 2 * count if count > 1 else 1
        try:
            while waiting or futures:
                first = min(futures, default=waiting[0] if waiting else 0)
                while waiting and len(futures) < ahead_of_all and (ahead is None or waiting[0] - first < ahead):
                    i = waiting[0]
                    try:
                        futures[i] = pool.submit(_task, function, items[i], __version__)
                    except BrokenExecutor:
                        raise _Died(tuple(futures) or (waiting.popleft(),)) from None
                    waiting.popleft()
                    futures[i].add_done_callback(lambda _, i=i: done.put(i))
                i = done.get()
                try:
                    value = futures[i].result()
                except BrokenExecutor:
                    raise _Died(tuple(futures)) from None
                del futures[i]
                yield _outcome(i, value)
            whole = True
        finally:
            if not whole:
                begun = set(multiprocessing.active_children()) - before
                for child in begun:
                    child.terminate()
                for child in begun:  # so that none writes any more when what they left is removed
                    child.join(_FAREWELL)
            pool.shutdown(wait=whole, cancel_futures=True)


class _Died(Exception):
    """A process died; `tasks` were handed out and have not ended."""

    def __init__(self, tasks: tuple[int, ...]) -> None:
        self.tasks = tasks


def _deaf() -> None:
    """Leave Ctrl-C to the process that waits for the results, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def end_with_parent() -> None:
    """Let this process end as soon as the one that began it has: a killed command cannot tell its workers.

    For the beginning of every worker process; elsewhere nothing happens.

    Examples
    --------
    >>> end_with_parent()
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent.sentinel,), daemon=True).start()


def _end_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)  # nobody is left to be told


# ---- Dask -----------------------------------------------------------------------------------------------------------------------------


@contextmanager
def _dask(address: str, jobs: int | None) -> Iterator[Any]:
    """Yield a client of the scheduler at an address, or of a new cluster of processes on this machine."""
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise MissingExtra("cluster", "--cluster") from None
    for name in ("distributed", "distributed.client", "distributed.core", "distributed.nanny", "distributed.scheduler"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what happens is told by us, in one line
    local = client = None
    try:
        if address == "local":
            count = worker_count(jobs)
            local = distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                host="127.0.0.1",
                protocol="tcp://",
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
        try:
            client = distributed.Client(address if local is None else local, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ClusterLost(f"no Dask scheduler answers at {address}: {reason}") from None
        yield client
    finally:
        for opened in (client, local):
            if opened is not None:
                with contextlib.suppress(Exception):  # the cluster may be gone
                    opened.close(timeout=5)


class _Dask(_Futures):
    """A Dask cluster through its client."""

    def __init__(self, client: Any, tell: Told | None = None) -> None:
        self.client = client
        self._tell = tell
        self.link = client.dashboard_link or None
        self._counted, self._told = -1e9, -1
        self._mark = f"baarda-{os.getpid()}-{time.time_ns():x}"
        self._number = 0
        workers = self._workers()
        self.memory = min((w["memory_limit"] / max(1, w["nthreads"]) for w in workers.values() if w["memory_limit"]), default=float("inf"))
        limit = "" if self.memory == float("inf") else f", {self.memory / 1e9:.1f} GB of memory each"
        self.name = f"Dask at {client.scheduler.address}, {self.count} workers{limit}"

    def _workers(self) -> dict[str, Any]:
        self._counted = time.monotonic()
        try:
            workers: dict[str, Any] = self.client.scheduler_info(n_workers=-1)["workers"]
        except TypeError:  # versions that always list all
            workers = self.client.scheduler_info()["workers"]
        self.count = sum(w["nthreads"] for w in workers.values())
        return workers

    def _window(self) -> int:
        self._look()
        return super()._window()

    def _submit(self, function: Callable[[Any], Any], item: Any, avoid: str) -> Any:
        self._look()
        self._number += 1
        others = [w for w in self._workers() if w != avoid] if avoid else []
        where = {"workers": others, "allow_other_workers": True} if others else {}
        return self.client.submit(_task, function, item, __version__, key=f"{self._mark}-{self._number}", pure=False, **where)

    def _look(self) -> None:
        if self.client.status != "running":
            raise ClusterLost(f"the connection to the Dask scheduler was lost ({self.client.status})")
        if time.monotonic() - self._counted > _COUNT_AGAIN:
            before = self.count
            self._workers()
            if self._tell is not None and (self.count == 0 or before == 0) and self.count != self._told:
                self._told = self.count
                self._tell(f"workers: {self.count} now" if self.count else "no worker is there: waiting for some (Ctrl-C ends)")

    def _ended(self, index: int, future: Any) -> Outcome[Any]:
        from distributed.scheduler import KilledWorker

        try:
            return super()._ended(index, future)
        except KilledWorker:
            died = "each worker that took it died (killed, or out of memory)"
            return Outcome(index, None, Failure(died, 4, "WorkerDied"))
        except (CancelledError, OSError, TimeoutError) as error:
            raise ClusterLost(f"the connection to the Dask scheduler was lost ({type(error).__name__})") from None
        finally:
            future.release()
