"""One large block by Helmert blocking on a Dask cluster beside the same block in one piece: numbers, time, bytes moved, memory.

    python benchmarks/helmert.py [--images 200,500] [--points 20] [--parts 6] [--workers 1,2,3] [--limit 2GB] [--folder DIR]

Both read project folders, adjust, compute cofactors, redundancy numbers, w, tau and minimal detectable biases, and write tables and the
adjusted project as CSV. The plain run is a process of its own, so that its memory is its own; a scheduler and its workers run as processes,
over TCP on loopback. With `--limit` the plain run and each worker may take no more: the plain run is then expected to refuse. Nothing here
is run by pytest.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import distributed
import numpy as np

from baarda.adjustment import adjust, memory
from baarda.errors import NotEnoughMemory
from baarda.executors import TaskFailed
from baarda.formats.project import read, write
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import TauLaw, external_reliability, mdb
from baarda.network import Table
from baarda.procedures.helmert import finish, solve_blocked
from baarda.procedures.lake_sums import peak_memory
from baarda.procedures.partition_folder import read_partition, write_partition
from baarda.procedures.synthetic import synthetic
from baarda.procedures.task_engines import open_engine
from baarda.procedures.testing import Analysis
from baarda.report.helmert_report import PartTables


@contextmanager
def cluster(folder: Path, count: int, limit: str) -> Iterator[str]:
    """Run a scheduler and workers as processes; yield the address."""
    folder.mkdir(parents=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    file, local = folder / "scheduler.json", ["--host", "127.0.0.1", "--no-dashboard"]
    log = (folder / "log").open("w")

    def begin(module: str, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", module, *arguments], env=environment, stdout=log, stderr=log)

    running = [begin("distributed.cli.dask_scheduler", *local, "--port", "0", "--scheduler-file", str(file))]
    worker = [*local, "--nthreads", "1", "--memory-limit", limit, "--no-nanny", "--local-directory", str(folder)]
    running += [begin("distributed.cli.dask_worker", *worker, "--scheduler-file", str(file)) for _ in range(count)]
    try:
        while not file.exists():
            time.sleep(0.05)
        address = str(json.loads(file.read_text())["address"])
        with contextlib.closing(distributed.Client(address, set_as_default=False)) as client:
            client.wait_for_workers(count, timeout=120)
            client.run(_loaded)
        yield address
    finally:
        for process in running:
            process.kill()
            process.wait()
        log.close()


def _loaded() -> None:
    import baarda.procedures.helmert  # noqa: F401


def plain(project: Path, out: Path, limit: float) -> dict[str, float]:
    """Adjust in one piece, and write what the parts write."""
    if np.isfinite(limit):
        true = memory.available
        memory.available = lambda: min(true(), limit)
    begun = time.perf_counter()
    a = adjust(read(project), solver="block", jobs=1)
    adjusted = time.perf_counter()
    tested = Analysis(a, Options(), ())
    share = a.controlled_share
    columns = {
        "w": tested.w,
        "tau": tested.tau,
        "mdb": mdb(share / a.pqvvp, share),
        "external": external_reliability(np.minimum(share, 1.0)),
        "p_value": 2.0 * TauLaw(a.redundancy).sf(np.abs(tested.tau)),
    }
    save = PartTables("csv")
    save(Table({**a.observations.columns, **columns}), out / "tables" / "observations" / "part-000")
    for kind, table in (("points", a.points), ("images", a.images), ("unknowns", a.unknowns)):
        save(table, out / "tables" / kind / "part-000")
    write(a.network, out / "project")
    ended = time.perf_counter()
    numbers = {"objective": a.objective, "redundancy": a.redundancy, "iterations": len(a.history) - 1, "observations": a.count}
    return {"seconds": ended - begun, "adjusted": adjusted - begun, "peak": peak_memory(), "unknowns": a.numbering.count, **numbers}


def unknowns_of(folder: Path) -> dict[str, tuple[float, float]]:
    """Return value and sigma of every unknown by name, of all parts."""
    out = {}
    for file in sorted((folder / "tables" / "unknowns").glob("*.csv")):
        with file.open(encoding="utf-8", newline="") as f:
            out |= {row["name"]: (float(row["value"]), float(row["sigma"])) for row in csv.DictReader(f)}
    return out


def compared(a: Path, b: Path) -> str:
    """Return the largest differences of two results."""
    x, y = unknowns_of(a), unknowns_of(b)
    if x.keys() != y.keys():
        return "DIFFERENT UNKNOWNS"
    p, q = (np.array([t[k] for k in x]) for t in (x, y))
    apart, sigmas = np.abs(p - q)[:, 0], np.abs((p - q)[:, 1] / p[:, 1]).max()
    relative = (apart / np.maximum(np.abs(p[:, 0]), p[:, 1])).max()  # values around zero have the size of their sigma
    return f"unknowns {(apart / p[:, 1]).max():.1e} sigma, {relative:.1e} relative; sigmas {sigmas:.1e} relative"


def bytes_of(limit: str) -> float:
    """Return a limit such as 2GB in bytes; infinite for 0."""
    from dask.utils import parse_bytes

    return float(parse_bytes(limit)) or np.inf


def measure(images: int, o: argparse.Namespace, folder: Path) -> None:
    project, parts = folder / "project", folder / "parts"
    network = synthetic("aerial", images, points=o.points * images, per_image_cameras=o.per_image, seed=1).network
    write(network, project)
    begun = time.perf_counter()
    source = write_partition(network, o.parts, parts)
    print(f"{images} images: split into {o.parts} parts in {time.perf_counter() - begun:.1f} s, {len(source.border)} shared nodes")
    del network
    command = [sys.executable, __file__, "--alone", str(project), str(folder / "plain"), "--limit", o.limit]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    alone = json.loads(told.splitlines()[-1])
    if "refused" in alone:
        print(f"  in one piece: {alone['refused']}")
    else:
        print(
            f"  in one piece: {alone['observations']} observations, {alone['unknowns']} unknowns, {alone['iterations']} iterations, "
            f"{alone['adjusted']:.1f} s adjusted, {alone['seconds']:.1f} s in all, peak {alone['peak'] / 1e6:.0f} MB"
        )
    for workers in (int(w) for w in o.workers.split(",")):
        out = folder / f"out{workers}"
        with cluster(folder / f"c{workers}", workers, o.limit) as address, open_engine(address) as engine:
            begun = time.perf_counter()
            try:
                blocked = solve_blocked(read_partition(parts), engine, jobs=1, tell=lambda text: print(f"    {text}"))
                adjusted = time.perf_counter() - begun
                done = finish(blocked, engine, None, str(out), PartTables("csv"))
            except (NotEnoughMemory, TaskFailed) as error:
                print(f"  {workers} workers: {error}")
                continue
            took = time.perf_counter() - begun
            peaks = engine._client.run(peak_memory).values()
            needed = max(f.needed for f in blocked.joint.facts)
            b = max(len(f.border_columns) for f in blocked.joint.facts)
            held = np.bincount([k % workers for k in range(o.parts)], [1.5 * f.needed for f in blocked.joint.facts]).max()
            model = sum(len(f.border_columns) ** 2 for f in blocked.joint.facts) * 8.0
        ratio = "" if "refused" in alone else f", ratio {took / alone['seconds']:.3f}"
        print(
            f"  {workers} workers: {adjusted:.1f} s adjusted, {took:.1f} s in all{ratio}, border {blocked.joint.border} (part: {b}), "
            f"{len(blocked.history) - 1} iterations, sent {engine.sent / 1e6:.2f} MB, received {engine.received / 1e6:.2f} MB "
            f"(sum of b^2: {model / 1e6:.2f} MB a factorisation), largest peak {max(peaks) / 1e6:.0f} MB "
            f"(bound {400 + held / 1e6:.0f} MB, a part {needed / 1e6:.0f} MB)"
        )
        print(f"    sum of redundancy numbers / r - 1: {done.redundancy_sum / blocked.redundancy - 1:.1e}")
        if "refused" not in alone:
            print(f"    {compared(folder / 'plain', out)}; v'Pv {blocked.objective / alone['objective'] - 1:.1e}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", default="200")
    parser.add_argument("--points", type=int, default=20, help="object points per image")
    parser.add_argument("--parts", type=int, default=6)
    parser.add_argument("--workers", default="1,2,3")
    parser.add_argument("--limit", default="0", help="memory of the plain run and of each worker, such as 2GB; 0 = no limit")
    parser.add_argument("--per-image", action="store_true", help="a camera for each image")
    parser.add_argument("--folder", type=Path, help="where the data go; a temporary folder by default")
    parser.add_argument("--alone", nargs=2, type=Path, help=argparse.SUPPRESS)
    o = parser.parse_args()
    if o.alone:
        try:
            print(json.dumps(plain(*o.alone, bytes_of(o.limit))))
        except NotEnoughMemory as error:
            print(json.dumps({"refused": str(error)}))
        return
    for images in (int(n) for n in o.images.split(",")):
        with tempfile.TemporaryDirectory(dir=o.folder) as name:
            measure(images, o, Path(name))


if __name__ == "__main__":
    main()
