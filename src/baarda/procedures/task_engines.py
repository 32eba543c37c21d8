"""Tasks whose results stay where they were computed and serve later tasks: in this process, by an executor, on a Dask cluster."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController, threadpool_limits

from baarda import __version__
from baarda.adjustment import memory
from baarda.errors import BaardaError
from baarda.executors import ClusterLost, Failure, TaskFailed, open_workers

__all__ = ["Engine", "open_engine"]


class Engine:
    """Runs tasks in this process at once; a handle is the result itself.

    Attributes
    ----------
    count : int
        Number of workers.
    name : str
        Who works, in words.
    memory : float
        Bytes that each worker may take.
    sent, received : int
        Bytes of arrays that were handed to tasks by value, and fetched from them.
    """

    count: int = 1
    name: str = "this process"
    shared = True  # all workers live on the memory of this machine

    def __init__(self) -> None:
        self.sent = self.received = 0
        self.tasks = 0

    @property
    def memory(self) -> float:
        """Bytes that each worker may take."""
        return memory.available()

    def submit(self, part: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Hand over a task of a part and return a handle of its result; arguments may be handles."""
        self.tasks += 1
        self.sent += sum(_bytes(a) for a in arguments)
        return self._submit(part, function, *arguments)

    def _submit(self, part: int, function: Callable[..., Any], *arguments: Any) -> Any:
        return _Local(function(*(a.value if isinstance(a, _Local) else a for a in arguments)))

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """Return the results of some tasks, in order.

        Raises
        ------
        TaskFailed
            If one failed elsewhere.
        ClusterLost
            If nobody is left who could work.
        """
        found = self._gather(handles)
        self.received += sum(_bytes(value) for value in found)
        return found

    def _gather(self, handles: Sequence[Any]) -> list[Any]:
        return [h.value for h in handles]


class _Local:
    """A result in this process."""

    def __init__(self, value: Any) -> None:
        self.value = value


def _bytes(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if isinstance(value, (tuple, list)):
        return sum(_bytes(v) for v in value)
    if isinstance(value, dict):
        return sum(_bytes(v) for v in value.values())
    if isinstance(value, str):
        return len(value)
    return 8 if isinstance(value, (int, float)) else 0


@cache
def _libraries() -> ThreadpoolController:
    """Return what limits the threads of BLAS; to look for its libraries takes longer than many a task."""
    import scipy.linalg  # noqa: F401 - its BLAS must be loaded before it can be found

    return ThreadpoolController()


def _call(version: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Run where the worker is: foreseen errors become values, and so does what depends on them."""
    failed = next((a for a in arguments if isinstance(a, Failure)), None)
    if failed is not None:
        return failed
    if version != __version__:
        return Failure(f"the worker has baarda {__version__}, the command baarda {version}: install the same version", 2, "UsageError")
    try:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*arguments)
    except BaardaError as error:
        return Failure(str(error), error.exit_code, type(error).__name__)
    except MemoryError:
        return Failure("out of memory", 4, "NotEnoughMemory")
    except OSError as error:
        place = f" {error.filename}" if error.filename else ""
        return Failure(f"cannot read or write{place}: {error.strerror or error}", 4, "OutputError")


def _checked(found: list[Any]) -> list[Any]:
    for value in found:
        if isinstance(value, Failure):
            raise TaskFailed(value)
    return found


class _OfExecutor(Engine):
    """An executor of the caller; of processes, what stays elsewhere with a cluster travels as a recipe through this process."""

    def __init__(self, executor: Executor) -> None:
        super().__init__()
        self._executor = executor
        self.count = int(getattr(executor, "_max_workers", 1) or 1)
        self.name = f"{type(executor).__name__} with {self.count} workers"

    def _submit(self, part: int, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            values = [a.result() if isinstance(a, Future) else a for a in arguments]
            return self._executor.submit(_call, __version__, function, *values)
        except (BrokenExecutor, CancelledError, RuntimeError) as error:
            raise ClusterLost(f"the executor takes no more tasks: {error}") from None

    def _gather(self, handles: Sequence[Any]) -> list[Any]:
        try:
            return _checked([h.result() for h in handles])
        except (BrokenExecutor, CancelledError) as error:
            raise ClusterLost(f"the executor broke: {error}") from None


class _OfDask(Engine):
    """A Dask cluster: results stay on the workers as futures, and what a lost worker held is computed again from where it came."""

    shared = False

    def __init__(self, client: Any, limit: float, name: str) -> None:
        super().__init__()
        self._client, self._limit, self.name = client, limit, name
        self._homes = sorted(self._workers())
        self.count = max(1, len(self._homes))

    def _workers(self) -> dict[str, Any]:
        try:
            found: dict[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        except TypeError:  # versions that always list all
            found = self._client.scheduler_info()["workers"]
        return found

    @property
    def memory(self) -> float:
        """The cluster's own limit."""
        return self._limit

    def _submit(self, part: int, function: Callable[..., Any], *arguments: Any) -> Any:
        self._look()
        where: dict[str, Any] = {}
        if self._homes:  # a part stays where its data are; another worker takes over when that one is lost
            where = {"workers": [self._homes[part % len(self._homes)]], "allow_other_workers": True}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sending large graph")  # kept with the scheduler, so that it can be sent again
            return self._client.submit(_call, __version__, function, *arguments, pure=False, **where)

    def _look(self) -> None:
        if self._client.status != "running":
            raise ClusterLost(f"the connection to the Dask scheduler was lost ({self._client.status})")

    def _gather(self, handles: Sequence[Any]) -> list[Any]:
        from distributed.scheduler import KilledWorker

        try:
            return _checked(list(self._client.gather(list(handles))))
        except KilledWorker:
            raise TaskFailed(Failure("each worker that took a part died (killed, or out of memory)", 4, "WorkerDied")) from None
        except (CancelledError, OSError, TimeoutError) as error:
            raise ClusterLost(f"the connection to the Dask scheduler was lost ({type(error).__name__})") from None


@contextmanager
def open_engine(cluster: Any = None, jobs: int | None = None, *, tell: Callable[[str], None] | None = None) -> Iterator[Engine]:
    """Yield those who work on the parts of one network.

    Parameters
    ----------
    cluster : None, str, Executor or dask.distributed.Client
        None is this process, part after part; else as `baarda.executors.open_workers`.
    jobs : int, optional
        Number of workers of a local cluster.
    tell : callable, optional
        Is told who works and where the dashboard is.

    Yields
    ------
    Engine

    Examples
    --------
    >>> with open_engine() as engine:
    ...     a = engine.submit(0, abs, -3)
    ...     engine.gather([engine.submit(0, max, a, 2)])
    [3]
    """
    with threadpool_limits(limits=1, user_api="blas"):  # threads of an executor would end each other's limit
        if cluster is None:
            yield Engine()
        elif isinstance(cluster, Executor):
            yield _OfExecutor(cluster)
        else:
            with open_workers(cluster, jobs, tell=tell) as workers:
                yield _OfDask(workers.client, workers.memory, workers.name)
