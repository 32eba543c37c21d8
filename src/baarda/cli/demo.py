"""`baarda demo`."""

from __future__ import annotations

import time
from pathlib import Path

from baarda.cli.base import (
    Alpha,
    AlphaOutlier,
    Jobs,
    Json,
    Language,
    Out,
    Pdf,
    Power,
    Quiet,
    Seed,
    Select,
    SigmaName,
    Snoop,
    Solver,
    Strict,
    Tables,
    app,
    guarded,
)
from baarda.cli.run import adjust_and_report


@app.command()
@guarded
def demo(
    out: Out = None,
    solver: Solver = "auto",
    snoop: Snoop = False,
    select: Select = False,
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    power: Power = 0.80,
    sigma: SigmaName = "aposteriori",
    seed: Seed = 0,
    jobs: Jobs = None,
    tables: Tables = "csv",
    spoken: Language = "en",
    pdf: Pdf = False,
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Adjust the bundled camera calibration (21 images, 4148 observations), test it, report it."""
    from dataclasses import replace
    from importlib.resources import as_file, files

    from baarda.formats import read

    started = time.perf_counter()
    with as_file(files("baarda") / "data" / "camcal") as folder:
        network = replace(read(folder / "camcaldemo.xml"), path="demo")
    levels = {"alpha": alpha, "alpha_outlier": alpha_outlier, "power": power, "sigma": sigma, "seed": seed}
    target = None if as_json and out is None else out or Path("demo-out")
    plan = {"snoop": "coordinate" if snoop else None, "select": select}
    adjust_and_report(
        network, {"solver": solver, "jobs": jobs}, levels, target, tables, as_json, quiet, strict, started, plan, spoken=spoken, pdf=pdf
    )
