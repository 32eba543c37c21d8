"""Executors and a real Dask scheduler with worker processes over TCP on loopback: same results, faults, refusals."""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from baarda.cli import app
from baarda.errors import MissingExtra, OutputError, UsageError
from baarda.executors import ClusterLost, TaskFailed, Workers, memory_limit, open_workers
from baarda.formats.residual_lake import open_lake
from baarda.procedures import batch
from baarda.procedures.batch import run_batch
from baarda.procedures.block_comparison import compare_blocks
from baarda.procedures.lake_study import pass_over
from baarda.report.batch_report import begin, write_summary
from baarda.report.lake_report import run_lake
from cluster_tasks import (
    MARKS,
    PHASES,
    dies_on_seven,
    dying_block,
    dying_condense,
    full_disk,
    light,
    limit_of,
    process_id,
    refuses_odd,
    with_limit,
)
from test_batch import contents_of, jobs_of, make_blocks
from test_lake import QUICK, folder_bytes, make_lake

try:
    import distributed
except ImportError:
    distributed = None
with_dask = pytest.mark.skipif(distributed is None, reason="needs the extra 'cluster'")
HERE = Path(__file__).parent


class Cluster:
    """A scheduler and worker processes, begun and killed by hand."""

    def __init__(self, folder, workers=3, memory="0", nanny=False):
        folder.mkdir(parents=True, exist_ok=True)
        self.marks = folder / "marks"
        self.marks.mkdir()
        python = os.pathsep.join([str(HERE), str(HERE.parent / "src")])
        self._environment = {**os.environ, "PYTHONPATH": python, MARKS: str(self.marks), "OMP_NUM_THREADS": "1"}
        self._folder, self._log = folder, (folder / "log").open("w")
        file = folder / "scheduler.json"
        local = ["--host", "127.0.0.1", "--no-dashboard"]
        self.scheduler = self._start("distributed.cli.dask_scheduler", *local, "--port", "0", "--scheduler-file", str(file))
        self._worker = [*local, "--nthreads", "1", "--scheduler-file", str(file), "--memory-limit", memory, "--death-timeout", "30"]
        self._worker += ["--local-directory", str(folder), "--nanny" if nanny else "--no-nanny"]
        self.workers = []
        self.more(workers)
        deadline = time.monotonic() + 60
        while not (file.exists() and file.read_text().rstrip().endswith("}")):  # begun, and written to its end
            assert time.monotonic() < deadline, (folder / "log").read_text()
            time.sleep(0.05)
        self.address = json.loads(file.read_text())["address"]
        self.wait(workers)

    def _start(self, module, *arguments):
        return subprocess.Popen(
            [sys.executable, "-m", module, *arguments], env=self._environment, stdout=self._log, stderr=self._log, cwd=self._folder
        )

    def more(self, count):
        """Begin more workers."""
        self.workers += [self._start("distributed.cli.dask_worker", *self._worker) for _ in range(count)]

    def wait(self, count):
        """Wait until so many workers are there."""
        if not count:
            return
        with contextlib.closing(distributed.Client(self.address, set_as_default=False)) as client:
            client.wait_for_workers(count, timeout=60)

    def close(self):
        """Kill what is left."""
        for process in (*self.workers, self.scheduler):
            process.kill()
        for process in (*self.workers, self.scheduler):
            process.wait()
        self._log.close()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    return make_blocks(tmp_path_factory.mktemp("blocks"), 8)


@pytest.fixture(scope="module")
def plain(blocks, tmp_path_factory):
    """What one process without any executor writes."""
    return finish(blocks, tmp_path_factory.mktemp("plain") / "out")


def finish(blocks, out, workers=None, write=light, progress=None):
    begin(out)
    write_summary(compare_blocks(run_batch(jobs_of(blocks, out), write, workers, progress)), out)
    return contents_of(out)


# ---- executors without Dask ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 3])
def test_processes_and_this_process(count):
    with open_workers(None, count) as workers:
        assert workers.count == count and memory_limit() == float("inf")
        done = {o.index: o.result() for o in workers.run(abs, list(range(-20, 0)))}
    assert done == {i: 20 - i for i in range(20)}


def test_any_executor():
    with ThreadPoolExecutor(2) as pool, open_workers(pool) as workers:
        out = {o.index: o for o in workers.run(refuses_odd, [2, 3, 4], ahead=2)}
    assert (out[0].result(), out[2].result()) == (2, 4)
    with pytest.raises(TaskFailed, match=r"numbers.txt, line 3: odd") as found:
        out[1].result()
    assert found.value.exit_code == 2 and out[1].failure.kind == "InputError"


@pytest.mark.parametrize("ahead", [None, 2])
def test_what_failed_on_a_worker_is_repeated_alone(ahead):
    """Beside other tasks it would wait for the worker that is well, and the idle one that failed could steal it."""
    lock, running, failed, beside = threading.Lock(), set(), set(), {}

    def work(i):
        with lock:
            running.add(i)
        time.sleep(0.01)
        with lock:
            running.discard(i)
            if i in (0, 3) and i not in failed:
                failed.add(i)
                raise OutputError("full")
            if i in failed:
                beside[i] = set(running)
        return i

    with ThreadPoolExecutor(2) as pool, open_workers(pool) as workers:
        done = [o.result() for o in workers.run(work, list(range(8)), ahead, again=("OutputError",))]
    assert sorted(done) == list(range(8)) and beside == {0: set(), 3: set()}


def test_window_is_kept():
    begun = []

    def note(i):
        begun.append(i)
        time.sleep(0.02 * (i == 0))
        return i

    with ThreadPoolExecutor(3) as pool, open_workers(pool) as workers:
        most = 0
        first, seen = 0, set()
        for o in workers.run(note, list(range(30)), ahead=4):
            most = max(most, max(begun) - first)
            seen.add(o.index)
            while first in seen:
                first += 1
    assert most < 4 + 1 and len(seen) == 30


def test_a_process_that_dies_costs_its_task_only():
    with open_workers(None, 2) as workers:
        out = {o.index: o for o in workers.run(dies_on_seven, list(range(12)))}
    assert {i: o.value for i, o in out.items() if i != 7} == {i: i * i for i in range(12) if i != 7}
    assert out[7].failure.exit_code == 4 and "died" in out[7].failure.message


def test_an_executor_that_breaks_is_told():
    with ProcessPoolExecutor(1) as pool, open_workers(pool) as workers, pytest.raises(ClusterLost, match=r"broke|no more tasks"):
        list(workers.run(dies_on_seven, [7, 8, 9]))


def test_what_is_no_cluster():
    with pytest.raises(UsageError, match="an address, 'local', an executor or a Dask client"), open_workers(3):
        pass


def test_one_clear_line_without_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"--cluster needs the 'cluster' extra"), open_workers("local"):
        pass
    make_blocks(tmp_path / "in", 1)
    run = CliRunner().invoke(app, ["batch", str(tmp_path / "in" / "b0"), "--out", str(tmp_path / "out"), "--cluster", "local"])
    assert run.exit_code == 2 and run.stderr.strip().splitlines()[-1].startswith("baarda: --cluster needs the 'cluster' extra")


# ---- a real scheduler ----------------------------------------------------------------------------------------------------------------


@with_dask
def test_who_works_and_where_to_look(cluster):
    told = []
    with open_workers(cluster.address, tell=told.append) as workers:
        ids = {o.result() for o in workers.run(process_id, list(range(30)))}
        assert workers.count == 3 and workers.client is not None
    assert ids <= {p.pid for p in cluster.workers} and len(ids) > 1
    assert told[0] == f"workers: Dask at {cluster.address}, 3 workers"


@with_dask
def test_a_run_waits_for_workers_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("baarda.executors._COUNT_AGAIN", 0.3)
    made, told = Cluster(tmp_path / "cluster", 0), []

    def tell(text):
        told.append(text)
        if text.startswith("no worker is there"):
            made.more(1)

    try:
        with open_workers(made.address, tell=tell) as workers:
            assert [o.result() for o in workers.run(abs, [-5])] == [5]
    finally:
        made.close()
    assert any(t.startswith("no worker is there: waiting") for t in told)


@with_dask
def test_a_given_client_and_its_executor(cluster):
    with contextlib.closing(distributed.Client(cluster.address, set_as_default=False)) as client:
        for given in (client, client.get_executor()):
            with open_workers(given) as workers:
                assert sorted(o.result() for o in workers.run(abs, [-1, -2])) == [1, 2]
        assert client.status == "running"


@with_dask
def test_batch_is_the_same_on_the_cluster(cluster, blocks, plain, tmp_path):
    with open_workers(cluster.address) as workers:
        assert finish(blocks, tmp_path / "out", workers) == plain


@with_dask
def test_errors_keep_their_words(cluster):
    with open_workers(cluster.address) as workers:
        out = {o.index: o for o in workers.run(refuses_odd, [4, 5])}
    assert out[0].result() == 4 and out[1].failure.message == "numbers.txt, line 5: odd" and out[1].failure.exit_code == 2


@with_dask
def test_another_version_on_the_worker_is_refused(cluster, monkeypatch):
    monkeypatch.setattr("baarda.executors.__version__", "9.9")
    with open_workers(cluster.address) as workers:
        (out,) = workers.run(abs, [1])
    assert "install the same version" in out.failure.message


@with_dask
def test_full_disk_on_one_worker_costs_nothing(cluster, blocks, plain, tmp_path):
    with open_workers(cluster.address) as workers:
        assert finish(blocks, tmp_path / "out", workers, full_disk) == plain
    assert (cluster.marks / "full.worker").read_text() in {str(p.pid) for p in cluster.workers}


def test_full_disk_everywhere_leaves_rows_and_nothing_half_written(blocks, plain, tmp_path, monkeypatch):
    def full(path, text):
        raise OSError(28, "No space left on device", str(path))

    out = tmp_path / "out"
    begin(out)
    with monkeypatch.context() as patched:
        patched.setattr("baarda.report.contents._text", full)
        rows = run_batch(jobs_of(blocks, out), light)
    assert all(r["exit_code"] == 4 and "No space left on device" in r["message"] for r in rows)
    assert not any((out / "blocks").iterdir()) and not any((out / "records").iterdir())
    assert finish(blocks, out) == plain


@with_dask
@pytest.mark.sampling
def test_a_worker_killed_in_every_phase(blocks, plain, tmp_path, monkeypatch):
    cluster = Cluster(tmp_path / "cluster", len(PHASES) + 1)
    try:
        monkeypatch.setattr(batch, "adjust_block", dying_block)
        with open_workers(cluster.address) as workers:
            mine = finish(blocks, tmp_path / "out", workers)
        died = {p.name for p in cluster.marks.iterdir()}
        assert died == set(PHASES)
        assert sum(p.poll() is not None for p in cluster.workers) == len(PHASES)
    finally:
        cluster.close()
    assert mine == plain
    assert not list((tmp_path / "out").rglob(".*"))


@with_dask
def test_the_scheduler_killed_and_the_run_continued(blocks, plain, tmp_path):
    cluster = Cluster(tmp_path / "cluster", 2)
    out, kept = tmp_path / "out", []

    def kill(done, total, row):
        if done == 3:
            cluster.scheduler.kill()

    begin(out)
    try:
        with pytest.raises(ClusterLost, match="connection to the Dask scheduler was lost"), open_workers(cluster.address) as workers:
            run_batch(jobs_of(blocks, out), light, workers, kill)
    finally:
        cluster.close()
    assert not list((out / "blocks").glob(".*"))
    rows = run_batch(jobs_of(blocks, out), light, Workers(), lambda done, total, row: kept.append(bool(row.get("kept"))))
    assert sum(kept) >= 3
    write_summary(compare_blocks(rows), out)
    assert contents_of(out) == plain


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    pytest.importorskip("pyarrow")
    return make_lake(tmp_path_factory.mktemp("lake"))


@with_dask
def test_lake_is_the_same_on_the_cluster(lake, tmp_path):
    run_lake(lake, tmp_path / "plain", options=QUICK)
    fresh = Cluster(tmp_path / "workers", 2)  # the peak is that of a worker's whole life
    try:
        with open_workers(fresh.address) as workers:
            run_lake(lake, tmp_path / "cluster", options=QUICK, workers=workers)
    finally:
        fresh.close()
    assert folder_bytes(tmp_path / "cluster") == folder_bytes(tmp_path / "plain")
    facts = json.loads((tmp_path / "cluster" / "run.json").read_text())
    assert facts["peak_memory_of_a_worker"] <= facts["bound"]


@with_dask
def test_a_cluster_for_the_time_of_a_command():
    told = []
    with open_workers("local", 1, tell=told.append) as workers:
        assert [o.result() for o in workers.run(abs, [-5])] == [5] and workers.count == 1
    assert told[0].startswith("workers: Dask at tcp://127.0.0.1:") and told[1].startswith("dashboard: http://127.0.0.1:")


@with_dask
def test_a_worker_killed_while_it_condenses(cluster, lake, monkeypatch):
    plain = pass_over(open_lake(lake))
    cluster.more(1)
    cluster.wait(4)
    monkeypatch.setattr("baarda.procedures.lake_study.condense_file", dying_condense)
    with open_workers(cluster.address) as workers:
        mine = pass_over(open_lake(lake), None, workers)
    assert sum(p.poll() is not None for p in cluster.workers) == 1 and (cluster.marks / "condensing").exists()
    assert mine.sha256 == plain.sha256 and mine.sums.rows == plain.sums.rows
    assert np.array_equal(mine.sums.condensed.squares, plain.sums.condensed.squares)
    assert np.array_equal(mine.sums.groups.counts.sum(axis=1), plain.sums.groups.counts.sum(axis=1))


@with_dask
def test_the_scheduler_killed_while_a_lake_is_read(lake, tmp_path):
    cluster = Cluster(tmp_path / "cluster", 1)
    saved = tmp_path / "saved.npz"

    def kill(done, total, rows):
        if done == 2:
            cluster.scheduler.kill()
            cluster.scheduler.wait()

    try:
        with pytest.raises(ClusterLost), open_workers(cluster.address) as workers:
            pass_over(open_lake(lake), None, workers, saved=saved, progress=kill)
    finally:
        cluster.close()
    found, plain = pass_over(open_lake(lake), saved=saved), pass_over(open_lake(lake))
    assert found.continued >= 2 and found.sha256 == plain.sha256
    assert np.array_equal(found.sums.groups.sums[: len(found.sums.groups.index)], plain.sums.groups.sums[: len(plain.sums.groups.index)])


@with_dask
def test_nobody_at_the_address(monkeypatch):
    monkeypatch.setattr("baarda.executors._PATIENCE", 0.5)
    with pytest.raises(ClusterLost, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"), open_workers("tcp://127.0.0.1:9"):
        pass


@with_dask
def test_memory_of_a_worker_is_known_and_kept(tmp_path, blocks):
    cluster = Cluster(tmp_path / "cluster", 1, memory="400MB", nanny=True)
    try:
        with open_workers(cluster.address) as workers:
            assert workers.memory == 400e6
            (out,) = workers.run(limit_of, [0])
            assert out.result() == 400e6
            jobs = jobs_of(blocks, tmp_path / "out")[:1]
            begin(tmp_path / "out")
            (refused,) = workers.run(partial(with_limit, write=light), jobs)
            assert "needs at least" in refused.result()["message"] and "the worker may take 0.00 GB" in refused.result()["message"]
            assert refused.result()["exit_code"] == 4
    finally:
        cluster.close()
