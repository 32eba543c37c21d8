"""Tasks handed to a few threads; what comes out does not depend on how many there are."""

from __future__ import annotations

import heapq
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from baarda.distributions.workers import worker_count

KEPT = 4_000_000  # doubles up to which a thread keeps an array

S = TypeVar("S")
T = TypeVar("T")


def for_each(items: Sequence[S], function: Callable[[S], T], workers: int | None = None) -> Iterator[T]:
    """Apply a function to items by a few threads and yield the results in order, a bounded number of them ahead.

    Parameters
    ----------
    items : sequence
    function : callable
        It should release the interpreter lock, and not use `for_each` itself.
    workers : int, optional
        Number of threads; one for each core.

    Examples
    --------
    >>> list(for_each([1, 2, 3], lambda x: x * x, workers=2))
    [1, 4, 9]
    """
    threads = min(worker_count(workers), len(items))
    if threads <= 1:
        for item in items:
            yield function(item)
        return
    pool = _pool(threads)
    window: deque[Future[T]] = deque()
    try:
        for item in items:
            window.append(pool.submit(function, item))
            if len(window) > 4 * threads:
                yield window.popleft().result()
        while window:
            yield window.popleft().result()
    finally:
        for left in window:
            left.cancel()


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
                with condition:
                    failure.append(error)
                    condition.notify_all()
                return
            with condition:
                left -= 1
                for other in after[task]:
                    waiting[other] -= 1
                    if waiting[other] == 0:
                        heapq.heappush(ready, other)
                condition.notify_all()

    others = [threading.Thread(target=work, daemon=True) for _ in range(threads - 1)]
    for thread in others:
        thread.start()
    try:
        work()
    except BaseException as error:  # an interruption between tasks
        with condition:
            failure.append(error)
            condition.notify_all()
    for thread in others:
        thread.join()
    if failure:
        raise failure[0]
