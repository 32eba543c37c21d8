"""Helmert blocking on a real Dask scheduler with worker processes over TCP on loopback: same numbers, lost workers, memory limits."""

import json
import os
import signal
import threading
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from baarda.cli import app
from baarda.errors import NotEnoughMemory
from baarda.executors import ClusterLost, TaskFailed
from baarda.procedures.helmert import finish, gathered_tables, solve_blocked
from baarda.procedures.partition_folder import write_partition
from baarda.procedures.task_engines import open_engine
from cluster_tasks import full_disk_once
from test_cluster import Cluster, with_dask
from test_helmert import aerial

pytestmark = with_dask


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return write_partition(aerial(16), 4, tmp_path_factory.mktemp("parts") / "p")


@pytest.fixture(scope="module")
def here(source):
    """What this process computes, part after part."""
    with open_engine() as e:
        return gathered_tables(solve_blocked(source, e), e)


def same(a, b):
    for kind in a:
        for name in a[kind].columns:
            assert np.array_equal(a[kind][name], b[kind][name], equal_nan=a[kind][name].dtype.kind == "f"), (kind, name)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    made = Cluster(tmp_path_factory.mktemp("cluster"), 1)
    yield made
    made.close()


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_any_number_of_workers(workers, cluster, source, here):
    """The sums are added in the order of the parts: byte for byte what one process computes."""
    complete(cluster, workers)
    with open_engine(cluster.address) as e:
        blocked = solve_blocked(source, e)
        same(here, gathered_tables(blocked, e))
        assert e.count == workers


def complete(cluster, workers=3):
    """Begin workers until there are so many."""
    alive = sum(p.poll() is None for p in cluster.workers)
    cluster.more(workers - alive)
    cluster.wait(workers)


def test_the_command_line(cluster, source, tmp_path):
    complete(cluster)
    plain, there = tmp_path / "plain", tmp_path / "there"
    run = CliRunner().invoke(app, ["adjust", str(source.path), "--out", str(plain), "--quiet"])
    assert run.exit_code == 0, run.output
    run = CliRunner().invoke(
        app, ["adjust", str(source.path), "--out", str(there), "--cluster", cluster.address, "--strict", "--alpha-outlier", "1e-9"]
    )
    assert run.exit_code == 0 and "workers: Dask at tcp://127.0.0.1" in run.stderr
    run = CliRunner().invoke(app, ["adjust", str(source.path), "--out", str(there), "--cluster", cluster.address, "--quiet"])
    assert run.exit_code == 0

    def contents(folder):
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file() and p.name != "run.json"}

    assert contents(plain) == contents(there)
    facts = json.loads((there / "run.json").read_text())
    assert facts["bytes_received"] > 0 and "3 workers" in facts["workers"]


@pytest.mark.parametrize("when", [0.1, 0.5, 0.95])
def test_a_lost_worker_costs_its_tasks(when, cluster, source, here):
    """Kill a worker in each phase of the run: what it held is computed again by the others."""
    complete(cluster)
    seen, victim = [], cluster.workers[-1]
    with open_engine(cluster.address) as e:
        total = 6 * 4 * 8
        true = e.submit

        def submit(part, function, *arguments):
            seen.append(function.__name__)
            if len(seen) == int(when * total):
                os.kill(victim.pid, signal.SIGKILL)
            return true(part, function, *arguments)

        e.submit = submit
        blocked = solve_blocked(source, e)
        same(here, gathered_tables(blocked, e))
    assert victim.wait(10) == -signal.SIGKILL


def test_a_worker_lost_while_the_tables_are_written(cluster, source, tmp_path):
    complete(cluster)
    out = [tmp_path / name for name in ("plain", "there")]
    with open_engine() as e:
        from baarda.report.helmert_report import write_blocked

        blocked = solve_blocked(source, e)
        write_blocked(lambda place, write: finish(blocked, e, None, place, write), out[0], "p")
    with open_engine(cluster.address) as e:
        joined = solve_blocked(source, e)

        def kill_in_the_middle(place, write):
            killer = threading.Timer(0.3, lambda: os.kill(cluster.workers[-1].pid, signal.SIGKILL))
            killer.start()
            try:
                return finish(joined, e, None, place, write)
            finally:
                killer.join()

        write_blocked(kill_in_the_middle, out[1], "p")
    files = [{p.relative_to(o): p.read_bytes() for p in o.rglob("*") if p.is_file()} for o in out]
    assert files[0] == files[1]


def test_a_full_disk_on_one_worker_leaves_nothing_and_the_next_run_is_whole(cluster, source, tmp_path):
    from baarda.report.helmert_report import write_blocked

    complete(cluster)
    out = [tmp_path / name for name in ("plain", "there")]
    with open_engine() as e:
        blocked = solve_blocked(source, e)
        write_blocked(lambda place, write: finish(blocked, e, None, place, write), out[0], "p")
    with open_engine(cluster.address) as e:
        joined = solve_blocked(source, e)
        with pytest.raises((OSError, TaskFailed), match="No space left"):
            write_blocked(lambda place, _: finish(joined, e, None, place, full_disk_once), out[1], "p")
        assert not out[1].exists()
        assert not [p for p in tmp_path.iterdir() if p != out[0]]  # nothing half-written beside it
        write_blocked(lambda place, write: finish(joined, e, None, place, write), out[1], "p")
    files = [{p.relative_to(o): p.read_bytes() for p in o.rglob("*") if p.is_file()} for o in out]
    assert files[0] == files[1]


def test_a_corrupt_part_is_told(cluster, tmp_path):
    source = write_partition(aerial(12), 2, tmp_path / "p")
    table = next(source.place(0).glob("image_points*"))
    table.write_bytes(table.read_bytes()[:200] + b"\x00\xff" * 50)
    with open_engine(cluster.address) as e, pytest.raises(TaskFailed, match="split again"):
        solve_blocked(source, e)


def test_a_changed_part_is_told(cluster, tmp_path):
    source = write_partition(aerial(12), 2, tmp_path / "p")
    (source.place(1) / "points.csv").write_text("point,X\n")
    with open_engine(cluster.address) as e, pytest.raises(TaskFailed, match="split again") as found:
        solve_blocked(source, e)
    assert found.value.exit_code == 2


def test_the_limit_of_the_cluster_is_kept(tmp_path, monkeypatch):
    """A part that needs more than its worker may take is refused with the figure."""
    for name in ("PAUSE", "SPILL", "TARGET", "TERMINATE"):  # the interpreter alone takes more than this limit
        monkeypatch.setenv(f"DASK_DISTRIBUTED__WORKER__MEMORY__{name}", "False")
    source = write_partition(aerial(12), 1, tmp_path / "p")
    made = Cluster(tmp_path / "cluster", 1, memory="0.2MB")
    try:
        with (
            open_engine(made.address) as e,
            pytest.raises(TaskFailed, match=r"part 0 would take .* GB of memory; the worker may take 0\.0002 GB") as found,
        ):
            solve_blocked(source, e)
        assert found.value.exit_code == NotEnoughMemory.exit_code
    finally:
        made.close()


def test_a_lost_scheduler_is_told_and_leaves_nothing(cluster, source, tmp_path):
    def kill():
        time.sleep(0.3)
        cluster.scheduler.kill()

    from baarda.report.helmert_report import write_blocked

    threading.Thread(target=kill).start()
    with pytest.raises(ClusterLost, match="Dask scheduler"), open_engine(cluster.address) as e:
        while True:  # until it is gone
            blocked = solve_blocked(source, e)
            write_blocked(lambda place, write, b=blocked: finish(b, e, None, place, write), tmp_path / "out", "p")
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".out")]
