"""Log-likelihood, condensing, fitting and streaming of the modulated normal law beside SciPy and fitter, in one run.

    python benchmarks/distributions.py [--rounds 7] [--values 1e7] [--stream 1e8] [--folder DIR] [--out FILE]

Every round runs each task once, one after the other, so that all of them meet the same disturbances; the table shows the least and the
median time, and ratios of times of the same round. Nothing here is run by pytest.
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import math
import os
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import stats

import baarda.distributions as D
from baarda.distributions import kernels, tabulated
from baarda.distributions.condensed import condense, condense_stream
from baarda.distributions.fitting import fit
from baarda.distributions.tabulated import log_likelihood, log_likelihood_gradient
from baarda.formats.value_stream import open_values

TRUTH = D.law("modulated_normal")(a=0.5, scale=2.0)
LAWS = ("normal", "student", "laplace")
SCIPY_LAWS = ("norm", "t", "laplace")


class Table:
    """Rows of a Markdown table, printed as they come."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, line: str = "") -> None:
        print(line, flush=True)
        self.lines.append(line)

    def times(self, tasks: dict[str, Callable[[], object]], rounds: int, n: float, base: str | None = None) -> None:
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
        for task in tasks.values():
            task()  # compiles, fills caches
        for _ in range(rounds):
            for name, task in tasks.items():
                processor, start = time.process_time(), time.perf_counter()
                task()
                taken[name].append((time.perf_counter() - start, time.process_time() - processor))
        self.say(f"| task | least s | median s | processor s | ns per value |{f' `{base}` takes |' if base else ''}")
        self.say(f"|---|---|---|---|---|{'---|' if base else ''}")
        for name, both in taken.items():
            wall = [w for w, _ in both]
            row = f"| {name} | {min(wall):.4f} | {np.median(wall):.4f} | {min(c for _, c in both):.4f} | {min(wall) / n * 1e9:.2f} |"
            if base:
                ratio = np.median([b / w for (b, _), w in zip(taken[base], wall, strict=True)])
                row += f" {ratio:.1f} x |"
            self.say(row)
        self.say()


def fresh(function: Callable[[], object]) -> Callable[[], object]:
    """Without the tables of an earlier call: building them is part of the work."""

    def run() -> object:
        tabulated._table.cache_clear()
        return function()

    return run


def likelihoods(table: Table, x: np.ndarray, rounds: int) -> None:
    law = D.law("modulated_normal")(a=0.45, scale=1.9)
    table.say(f"## Log-likelihood, n = {x.size:.0e}")
    table.say()
    base = "scipy.stats.norm.logpdf, summed"
    tasks: dict[str, Callable[[], object]] = {base: lambda: np.sum(stats.norm.logpdf(x, 0.0, 1.9))}
    for workers in (1, 2):
        tasks[f"log_likelihood, {workers} thread(s)"] = fresh(lambda w=workers: log_likelihood(x, law, workers=w))
        tasks[f"log_likelihood_gradient, {workers} thread(s)"] = fresh(lambda w=workers: log_likelihood_gradient(x, law, workers=w))
    table.times(tasks, rounds, x.size, base)
    exact = math.fsum(math.fsum(law.logpdf(part)) for part in np.array_split(x, 100))
    table.say(f"Relative difference from the exactly evaluated sum: {abs(log_likelihood(x, law) / exact - 1.0):.1e}.")
    table.say()


def fits(table: Table, x: np.ndarray, rounds: int) -> None:
    table.say(f"## Condensing and fitting scale and a, n = {x.size:.0e}")
    table.say()
    c = condense(x)
    table.times(
        {
            "condense, 1 thread": lambda: condense(x, workers=1),
            "condense, 2 threads": lambda: condense(x, workers=2),
            "fit from the condensed values": lambda: fit(c, loc=0.0),
            "fit from the raw values": lambda: fit(x, loc=0.0),
            "the same with polish=True": fresh(lambda: fit(x, loc=0.0, polish=True)),
        },
        rounds,
        x.size,
    )
    rough, polished = fit(c, loc=0.0), fit(x, loc=0.0, polish=True)
    full = newton(x, polished.parameters)
    for name, found in (("condensed", rough), ("polished", polished)):
        worst = max(abs(found.parameters[p] - full[p]) / rough.standard_errors[p] for p in ("a", "scale"))
        table.say(f"- {name} fit against the maximum over all values: {worst:.1e} standard errors")
    table.say()


def newton(x: np.ndarray, start: dict[str, float]) -> dict[str, float]:
    """The maximum over all values: Newton's method until steps vanish."""

    def slopes(p: np.ndarray) -> np.ndarray:
        g = log_likelihood_gradient(x, D.law("modulated_normal")(a=p[0], scale=p[1]))[1]
        return np.array([g["a"], g["scale"]])

    p, h = np.array([start["a"], start["scale"]]), 1e-4
    hessian = np.stack([(slopes(p + h * e) - slopes(p - h * e)) / (2.0 * h) for e in np.eye(2)])
    for _ in range(3):
        p = p - np.linalg.solve(0.5 * (hessian + hessian.T), slopes(p))
    return {"a": float(p[0]), "scale": float(p[1])}


def rivals(table: Table, rounds: int) -> None:
    n = 100_000
    x = TRUTH.rvs(n, np.random.default_rng(2))
    table.say(f"## Other programs, n = {n:.0e}")
    table.say()
    base = "scipy.stats.t.fit"
    table.times(
        {
            base: lambda: stats.t.fit(x),
            "fit(x, 'student')": lambda: fit(x, "student"),
            "fit(x, 'modulated_normal')": lambda: fit(x),
        },
        min(rounds, 3),
        n,
        base,
    )
    if importlib.util.find_spec("fitter") is None:
        table.say("fitter is not installed: not compared.")
        table.say()
        return
    from fitter import Fitter

    logging.disable(logging.WARNING)
    base = "fitter (norm, t, laplace)"

    def run() -> None:
        with warnings.catch_warnings(), open(os.devnull, "w") as nowhere:  # noqa: PTH123
            warnings.simplefilter("ignore")
            from contextlib import redirect_stderr

            with redirect_stderr(nowhere):
                Fitter(x, distributions=list(SCIPY_LAWS), timeout=300).fit()

    table.times({base: run, "compare_laws(x, (normal, student, laplace))": lambda: D.compare_laws(x, LAWS)}, min(rounds, 3), n, base)


def streams(table: Table, n: int, folder: Path, rounds: int) -> None:
    part = 1_000_000
    n = n // part * part
    table.say(f"## Streaming, n = {n:.0e}")
    table.say()
    with tempfile.TemporaryDirectory(dir=folder) as name:
        npy, parquet = Path(name) / "values.npy", Path(name) / "values.parquet"
        rng = np.random.default_rng(3)
        store = np.lib.format.open_memmap(npy, "w+", np.float64, (n,))
        block = TRUTH.rvs(min(n, 100 * part), rng)  # longer files repeat it, each time turned by another million
        for start in range(0, n, block.size):
            store[start : start + block.size] = np.roll(block, start)[: n - start]
        store.flush()
        del store, block
        report(table, npy, n, rounds)
        if importlib.util.find_spec("pyarrow") is None:
            table.say("pyarrow is not installed: Parquet not measured.")
            return
        import pyarrow as pa
        from pyarrow import parquet as pq

        values = np.load(npy, mmap_mode="r")
        with pq.ParquetWriter(parquet, pa.schema([("v", pa.float64())]), use_dictionary=False) as writer:
            for start in range(0, n, part):
                writer.write_table(pa.table({"v": np.asarray(values[start : start + part])}))
        del values
        npy.unlink()
        report(table, parquet, n, rounds)


def report(table: Table, file: Path, n: int, rounds: int) -> None:
    def read() -> None:
        with file.open("rb", buffering=0) as f:
            buffer = bytearray(1 << 22)
            while f.readinto(buffer):
                pass

    def decode() -> None:
        for _ in open_values(file):
            pass

    peak = [0.0]
    before = resident()

    def look(_: int) -> None:
        peak[0] = max(peak[0], resident())

    tasks = {"read the bytes": read, "condense_stream, 2 threads": lambda: condense_stream(open_values(file), progress=look, workers=2)}
    if file.suffix == ".parquet":
        tasks["decode alone (pyarrow, 1 thread)"] = decode
    size = file.stat().st_size / 2**30
    table.say(f"{file.suffix[1:]}, {size:.2f} GiB, in the page cache as far as memory allows:")
    table.say()
    table.times(tasks, min(rounds, 3), n)
    found = fit(condense_stream(open_values(file)), loc=0.0)
    table.say(f"Memory of the process before {before:.0f} MiB, largest during the passes {peak[0]:.0f} MiB. Fit: {found.parameters}.")
    table.say()


def resident() -> float:
    """Resident memory in MiB, where the system tells."""
    try:
        text = Path("/proc/self/status").read_text()
    except OSError:
        return math.nan
    return int(next(line for line in text.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--values", type=float, default=1e7)
    parser.add_argument("--stream", type=float, default=1e8, help="values to stream from a file; 0: none")
    parser.add_argument("--folder", type=Path, default=None, help="where the files to stream are written for a moment")
    parser.add_argument("--out", type=Path, default=None, help="also write the tables here")
    options = parser.parse_args()
    table = Table()
    start = time.perf_counter()
    loops = kernels.compiled()
    took = time.perf_counter() - start
    table.say(f"{os.cpu_count()} cores; " + (f"loops compiled or loaded in {took:.1f} s" if loops else "numba is missing: NumPy twins"))
    load = f"; load before the run {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    table.say(f"numpy {np.__version__}{load}")
    table.say()
    x = TRUTH.rvs(int(options.values), np.random.default_rng(1))
    likelihoods(table, x, options.rounds)
    fits(table, x, options.rounds)
    del x
    rivals(table, options.rounds)
    if options.stream:
        streams(table, int(options.stream), options.folder or Path(tempfile.gettempdir()), options.rounds)
    if options.out:
        options.out.write_text("\n".join(table.lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
