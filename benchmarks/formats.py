"""Time to read files, beside programs that read the same ones.

    python benchmarks/formats.py [--colmap FOLDER] [--rounds 5] [--out FILE]

A project of 100 000 image points against `numpy.loadtxt` of its largest table (which names nothing and checks nothing); a COLMAP text model
against pycolmap, from the extra `oracle`. Every round reads each once; times are the least and the median, ratios medians of the rounds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from baarda.formats import project, read
from baarda.procedures.synthetic import synthetic


def compared(ours: Callable[[], Any], theirs: Callable[[], Any], rounds: int) -> tuple[float, float, float]:
    """Return our least time, theirs, and the median of the ratios of a round."""
    times = []
    for _ in range(rounds):
        row = []
        for function in (ours, theirs):
            begin = time.perf_counter()
            function()
            row.append(time.perf_counter() - begin)
        times.append(row)
    return min(t[0] for t in times), min(t[1] for t in times), median(t[1] / t[0] for t in times)


def main() -> None:
    """Measure and print a table."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--colmap")
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--out")
    chosen = options.parse_args()
    rows = ["| file | ours s | other s | other / ours |", "|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        network = synthetic("aerial", 100, points=20_000, seed=1).network
        where = Path(folder) / "p"
        project.write(network, where)

        def table() -> Any:
            return np.loadtxt(where / "image_points.csv", delimiter=",", skiprows=1, dtype=str)

        ours, theirs, ratio = compared(lambda: project.read(where), table, chosen.rounds)
        rows.append(f"| project, {len(network.observations[0])} image points (numpy.loadtxt) | {ours:.3f} | {theirs:.3f} | {ratio:.1f} |")
    if chosen.colmap and find_spec("pycolmap"):
        pycolmap: Any = import_module("pycolmap")
        ours, theirs, ratio = compared(lambda: read(chosen.colmap), lambda: pycolmap.Reconstruction(chosen.colmap), chosen.rounds)
        rows.append(f"| COLMAP text model (pycolmap) | {ours:.3f} | {theirs:.3f} | {ratio:.1f} |")
    print("\n".join(rows))
    if chosen.out:
        Path(chosen.out).write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
