"""Tasks of a few threads: results in order, failures, interruptions."""

import threading
import time

import pytest

from baarda.adjustment import workers
from baarda.adjustment.workers import for_each, run_tree


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order(threads):
    assert for_each(range(100), lambda i: i * i, threads) == [i * i for i in range(100)]
    assert for_each([], lambda i: i, threads) == []


def test_two_threads_work_at_the_same_time():
    meeting = threading.Barrier(2, timeout=20)
    assert len(for_each([0, 1], lambda i: meeting.wait(), 2)) == 2
    run_tree([0, 0], [[], []], lambda i: meeting.wait(), 2)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_first_failure_is_raised_and_the_rest_is_left(threads):
    begun = []

    def work(i):
        begun.append(i)
        if i in (5, 6):
            raise ValueError(str(i))

    with pytest.raises(ValueError, match="5"):
        for_each(range(1000), work, threads)
    assert len(begun) < 20


def test_a_failure_ends_a_tree():
    def work(i):
        if i == 1:
            raise ValueError("one")

    with pytest.raises(ValueError, match="one"):
        run_tree([0, 1, 1], [[1], [2], []], work, 2)


@pytest.mark.parametrize("inside", [True, False])
def test_an_interruption_ends_all_threads(inside, monkeypatch):
    done, other = [], threading.Event()

    def work(i):
        done.append(i)
        if threading.current_thread() is threading.main_thread():
            assert other.wait(20)
            if inside:
                raise KeyboardInterrupt
        else:
            other.set()

    if not inside:  # the main thread waits for the others when it is interrupted
        waited, wait = [], workers._wait

        def interrupted(others):
            waited.append(others)
            if len(waited) == 1:
                raise KeyboardInterrupt
            wait(others)

        monkeypatch.setattr(workers, "_wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        for_each(range(10**6) if inside else range(1000), work, 2)
    count = len(done)
    assert not inside or count < 10**6
    assert for_each(range(3), str, 2) == ["0", "1", "2"]
    assert len(done) == count, "no task goes on after the call"


def test_trees_wait_for_what_comes_before():
    done = []
    run_tree([0, 0, 2, 1], [[2], [2], [3], []], done.append, 3)
    assert sorted(done[:2]) == [0, 1]
    assert done[2:] == [2, 3]


def test_of_two_failures_the_first_item_s_is_raised():
    both = threading.Barrier(2)

    def fail(x):
        both.wait(timeout=60)
        if x == 0:
            time.sleep(0.2)  # it fails later
        raise ValueError(x)

    with pytest.raises(ValueError, match=r"^0$"):
        for_each([0, 1], fail, workers=2)
