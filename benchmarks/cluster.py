"""Many blocks and a lake of residuals on a Dask cluster beside the plain run: time, bytes moved, memory, identity of the results.

    python benchmarks/cluster.py [--blocks 24] [--rows 20000000] [--files 20] [--groups 2000] [--workers 1,2,3] [--rounds 3] [--folder DIR]

A scheduler and its workers run as processes of their own, over TCP on loopback. Every round runs the plain run and the cluster with one
worker, one after the other, so that both meet the same disturbances; ratios are medians of ratios within a round. The time to begin the
cluster and to import the package on the workers is told apart: it is spent once. Nothing here is run by pytest.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pickle
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import distributed
import numpy as np
import pyarrow as pa
from pyarrow import parquet

from baarda.executors import Workers, open_workers
from baarda.formats.project import write as write_project
from baarda.formats.residual_lake import open_lake
from baarda.procedures.batch import BatchOptions, block_jobs, run_batch, sources
from baarda.procedures.block_comparison import compare_blocks
from baarda.procedures.lake_study import pass_over
from baarda.procedures.lake_sums import PartJob, bound, condense_file, peak_memory
from baarda.procedures.synthetic import synthetic
from baarda.report.batch_report import BlockWriter, begin, result_json


@contextmanager
def cluster(folder: Path, count: int) -> Iterator[str]:
    """Run a scheduler and workers as processes; yield the address."""
    folder.mkdir(parents=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    file, local = folder / "scheduler.json", ["--host", "127.0.0.1", "--no-dashboard"]
    log = (folder / "log").open("w")

    def begin_one(module: str, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", module, *arguments], env=environment, stdout=log, stderr=log)

    running = [begin_one("distributed.cli.dask_scheduler", *local, "--port", "0", "--scheduler-file", str(file))]
    worker = [*local, "--nthreads", "1", "--memory-limit", "0", "--no-nanny", "--local-directory", str(folder)]
    running += [begin_one("distributed.cli.dask_worker", *worker, "--scheduler-file", str(file)) for _ in range(count)]
    try:
        while not file.exists():
            time.sleep(0.05)
        address = str(json.loads(file.read_text())["address"])
        with contextlib.closing(distributed.Client(address, set_as_default=False)) as client:
            client.wait_for_workers(count, timeout=120)
        yield address
    finally:
        for process in running:
            process.kill()
            process.wait()
        log.close()


def timed(function, *arguments):
    begun = time.perf_counter()
    out = function(*arguments)
    return time.perf_counter() - begun, out


# ---- many blocks ---------------------------------------------------------------------------------------------------------------------


def batch_of(blocks: Path, out: Path, workers: Workers):
    shutil.rmtree(out, ignore_errors=True)
    begin(out)
    jobs = block_jobs(sources([f"{blocks}/b*"]), out, BatchOptions(settings={"jobs": 1}))
    return run_batch(jobs, BlockWriter(), workers), jobs


def warm(workers: Workers, blocks: Path, out: Path) -> float:
    """Let every worker import what it needs, and tell how long that takes."""
    jobs = block_jobs([str(blocks / "b000")], out / "warm", BatchOptions(settings={"jobs": 1}))
    begin(out / "warm")
    return timed(lambda: [run_batch(jobs, BlockWriter(), workers) for _ in range(1)])[0]


def measure_batch(folder: Path, count: int, workers: list[int], rounds: int) -> None:
    blocks = folder / "blocks"
    for k in range(count):
        write_project(synthetic("aerial", 3, points=12, seed=k).network, blocks / f"b{k:03d}")
    plain, ratios, documents = Workers(), [], set()
    warm(plain, blocks, folder / "w0")
    with cluster(folder / "c1", 1) as address, open_workers(address) as one:
        print(f"first block on a new worker: {warm(one, blocks, folder / 'w1'):.1f} s")
        took, _ = timed(lambda: sum(o.result() for o in one.run(abs, range(500))))
        print(f"a task that does nothing: {took / 500 * 1e3:.1f} ms")
        for r in range(rounds):
            alone, (rows, _) = timed(batch_of, blocks, folder / "o0", plain)
            there, (same, jobs) = timed(batch_of, blocks, folder / "o1", one)
            documents |= {json.dumps(result_json(compare_blocks(x))) for x in (rows, same)}
            ratios.append(there / alone)
            print(f"round {r + 1}: {count} blocks plain {alone:.2f} s, cluster of one {there:.2f} s, ratio {there / alone:.3f}")
    print(f"batch: {alone / count:.3f} s a block, cluster of one against plain: median ratio {statistics.median(ratios):.3f}")
    moved = [len(pickle.dumps(j)) for j in jobs], [len(pickle.dumps(x)) for x in same]
    print(f"bytes moved a block: {np.mean(moved[0]):.0f} to the worker, {np.mean(moved[1]):.0f} back")
    for w in workers:
        if w > 1:
            with cluster(folder / f"c{w}", w) as address, open_workers(address) as many:
                warm(many, blocks, folder / f"w{w}")
                took, (rows, _) = timed(batch_of, blocks, folder / f"o{w}", many)
                documents.add(json.dumps(result_json(compare_blocks(rows))))
                print(f"{w} workers: {took:.2f} s")
    print(f"summaries with the hashes of all result folders: {len(documents)} different")


# ---- a lake --------------------------------------------------------------------------------------------------------------------------


def make_lake(folder: Path, rows: int, files: int, groups: int) -> Path:
    each = rows // files
    for k in range(files):
        rng = np.random.default_rng(k)
        image = np.sort(rng.integers(0, groups, each)).astype(np.int32)
        x = 0.4 * rng.standard_normal(each, dtype=np.float32)
        place = folder / "lake" / f"block={k // 10}"
        place.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table({"image": image, "residual": x}), place / f"{k:05d}.parquet", row_group_size=1 << 20)
    return folder / "lake"


def measure_lake(folder: Path, rows: int, files: int, groups: int, workers: list[int], rounds: int) -> None:
    lake = open_lake(make_lake(folder, rows, files, groups))
    total, ratios, found = files * (rows // files), [], set()
    part = condense_file(PartJob(lake, 0, 0.0))
    print(f"{total:.3g} residuals in {files} files, {sum(lake.sizes) / 1e9:.2f} GB, {groups} groups")
    returned = len(pickle.dumps(part))
    bins, g = len(part.sums.groups.keys), part.sums.groups
    model = len(g.index) * (64 + bins * g.counts.itemsize)
    print(f"bytes back a file: {returned / 1e3:.0f} kB; model {model / 1e3:.0f} kB")
    with cluster(folder / "l1", 1) as address, open_workers(address) as one:
        pass_over(lake, None, one)
        for r in range(rounds):
            alone, a = timed(pass_over, lake, None, Workers())
            there, b = timed(pass_over, lake, None, one)
            found |= {
                pickle.dumps((x.sha256, x.sums.squares, x.sums.groups.sums.tobytes(), x.sums.condensed.squares.tobytes())) for x in (a, b)
            }
            ratios.append(there / alone)
            print(f"round {r + 1}: plain {alone:.2f} s, cluster of one {there:.2f} s, ratio {there / alone:.3f}")
    print(f"lake: {1e9 * alone / total:.1f} ns a residual, cluster of one against plain: median ratio {statistics.median(ratios):.3f}")
    most, here = bound(groups, bins) / 1e6, peak_memory() / 1e6
    print(f"largest memory of a worker {b.peak / 1e6:.0f} MB, bound {most:.0f} MB; of this process {here:.0f} MB")
    for w in workers:
        if w > 1:
            with cluster(folder / f"l{w}", w) as address, open_workers(address) as many:
                pass_over(lake, None, many)
                took, x = timed(pass_over, lake, None, many)
                found.add(pickle.dumps((x.sha256, x.sums.squares, x.sums.groups.sums.tobytes(), x.sums.condensed.squares.tobytes())))
                print(f"{w} workers: {took:.2f} s, largest memory of a worker {x.peak / 1e6:.0f} MB")
    print(f"sums of all passes: {len(found)} different")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=24, help="small blocks of the batch; 0 leaves it out")
    parser.add_argument("--rows", type=float, default=2e7, help="residuals of the lake; 0 leaves it out")
    parser.add_argument("--files", type=int, default=20)
    parser.add_argument("--groups", type=int, default=2000)
    parser.add_argument("--workers", default="1,2,3")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="where the data go; a temporary folder by default")
    o = parser.parse_args()
    workers = [int(w) for w in o.workers.split(",")]
    with tempfile.TemporaryDirectory(dir=o.folder) as name:
        if o.blocks:
            measure_batch(Path(name), o.blocks, workers, o.rounds)
        if o.rows:
            measure_lake(Path(name), int(o.rows), o.files, o.groups, workers, o.rounds)


if __name__ == "__main__":
    main()
