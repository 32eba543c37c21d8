"""Pieces of an array handed to a few threads; what comes out does not depend on how many there are."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from baarda.errors import UsageError

T = TypeVar("T")


def worker_count(workers: int | None) -> int:
    """Return the number of threads: the given one, or one for each core this process may use.

    Raises
    ------
    UsageError
        If it is not positive.

    Examples
    --------
    >>> worker_count(3)
    3
    """
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if workers < 1:
        raise UsageError(f"workers = {workers} is not a positive number")
    return workers


def run_pieces(total: int, piece: int, function: Callable[[int, int], T], workers: int | None = None) -> list[T]:
    """Apply a function to [start, stop) pieces of a fixed size and return the results in order.

    Parameters
    ----------
    total, piece : int
        Number of values in all and in one piece.
    function : callable
        (start, stop) -> result; it should release the interpreter lock.
    workers : int, optional
        Number of threads, this one included.

    Returns
    -------
    list
        The same for any number of workers.

    Examples
    --------
    >>> run_pieces(5, 2, lambda start, stop: stop - start, workers=2)
    [2, 2, 1]
    """
    starts = range(0, total, piece)
    threads = min(worker_count(workers), len(starts))
    if threads <= 1:
        return [function(start, min(start + piece, total)) for start in starts]
    results: dict[int, T] = {}
    tickets = itertools.count()

    def work() -> None:
        while (i := next(tickets)) < len(starts):
            results[i] = function(starts[i], min(starts[i] + piece, total))

    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(work) for _ in range(threads - 1)]
        work()
        for other in others:
            other.result()
    return [results[i] for i in range(len(starts))]
