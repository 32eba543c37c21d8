"""Tasks handed to a few threads; what comes out does not depend on how many there are."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from baarda.distributions.workers import worker_count

KEPT = 4_000_000  # doubles up to which a thread keeps an array

S = TypeVar("S")
T = TypeVar("T")


def for_each(items: Sequence[S], function: Callable[[S], T], workers: int | None = None) -> list[T]:
    """Apply a function to items by a few threads, this one included, and return the results in order.

    Parameters
    ----------
    items : sequence
        Begun one after the other.
    function : callable
        It should release the interpreter lock, and not use `for_each` itself.
    workers : int, optional
        Number of threads; one for each core.

    Raises
    ------
    BaseException
        What the function raised for the first item that failed; those after it may not have been begun.

    Examples
    --------
    >>> for_each([1, 2, 3], lambda x: x * x, workers=2)
    [1, 4, 9]
    """
    threads = min(worker_count(workers), len(items))
    if threads <= 1:
        return [function(item) for item in items]
    results: dict[int, T] = {}
    failures: dict[int, BaseException] = {}
    tickets = itertools.count()  # a number is drawn in less time than a task is handed over

    def work() -> None:
        while not failures and (i := next(tickets)) < len(items):
            try:
                results[i] = function(items[i])
            except BaseException as error:  # handed to the caller
                failures[i] = error

    _together(work, lambda error: failures.setdefault(-1, error), threads)
    if failures:
        raise failures[min(failures)]
    return [results[i] for i in range(len(items))]


def _together(work: Callable[[], None], stop: Callable[[BaseException], object], threads: int) -> None:
    """Do the same work in several threads, this one included; it ends by itself, or soon after an interruption was handed to `stop`."""
    others: list[Future[None]] = []
    try:
        others += [_pool(threads - 1).submit(work) for _ in range(threads - 1)]
        work()
        _wait(others)
    except BaseException as error:  # an interruption outside a task
        stop(error)
        _wait(others)


def _wait(others: list[Future[None]]) -> None:
    for other in others:
        if not other.cancel():  # what has not begun is not needed any more
            other.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """One pool for all calls: to begin threads costs more than many a task."""
    return ThreadPoolExecutor(threads)


_own = threading.local()


def scratch(name: str, size: int) -> NDArray[np.float64]:
    """Return an array of no certain content that this thread used before under the same name: new memory costs more than to fill it.

    Parameters
    ----------
    name : str
    size : int

    Examples
    --------
    >>> len(scratch("example", 5)), scratch("example", 3).base is scratch("example", 4).base
    (5, True)
    """
    if size > KEPT:
        return np.empty(size)
    kept: dict[str, NDArray[np.float64]] = _own.__dict__.setdefault("arrays", {})
    found = kept.get(name)
    if found is None or len(found) < size:
        found = kept[name] = np.empty(size)
    return found[:size]


def run_tree(before: Sequence[int], after: Sequence[Sequence[int]], function: Callable[[int], Any], workers: int | None = None) -> None:
    """Run the tasks 0 ... n - 1 of a forest, each as soon as those before it are done.

    Parameters
    ----------
    before : sequence of int
        How many tasks must be done before each task.
    after : sequence of sequences of int
        The tasks that wait for each task.
    function : callable
        Is given the number of the task; what it computes must not depend on the order of tasks that do not wait for each other.
    workers : int, optional

    Examples
    --------
    >>> done = []
    >>> run_tree([0, 1, 1], [[1], [2], []], done.append, workers=1)
    >>> done
    [0, 1, 2]
    """
    waiting = list(before)
    ready = [i for i, count in enumerate(waiting) if count == 0]
    heapq.heapify(ready)
    left = len(waiting)
    threads = min(worker_count(workers), max(left, 1))
    condition = threading.Condition()
    failure: list[BaseException] = []

    def work() -> None:
        nonlocal left
        while True:
            with condition:
                while not ready and left and not failure:
                    condition.wait()
                if failure or not left:
                    return
                task = heapq.heappop(ready)
            try:
                function(task)
            except BaseException as error:  # handed to the caller
                stop(error)
                return
            with condition:
                left -= 1
                for other in after[task]:
                    waiting[other] -= 1
                    if waiting[other] == 0:
                        heapq.heappush(ready, other)
                condition.notify_all()

    def stop(error: BaseException) -> None:
        with condition:
            failure.append(error)
            condition.notify_all()

    _together(work, stop, threads)
    if failure:
        raise failure[0]
