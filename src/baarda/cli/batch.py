"""`baarda batch`."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from baarda.cli.base import (
    Alpha,
    AlphaOutlier,
    CameraList,
    Cluster,
    Control,
    CriterionB,
    DatumName,
    FormatName,
    ImageSigma,
    Json,
    Language,
    MinRays,
    Out,
    Plane,
    Power,
    Quiet,
    Robust,
    Seed,
    Select,
    SigmaName,
    Snoop,
    SnoopLaw,
    SnoopUnit,
    Solver,
    Strict,
    Tables,
    app,
    guarded,
)
from baarda.cli.progress import left, shortened


@app.command()
@guarded
def batch(
    patterns: Annotated[
        list[str], typer.Argument(metavar="PATTERN...", help="Files, folders, or quoted patterns such as 'blocks/*/sparse/0'.")
    ],
    out: Out = None,
    cluster: Cluster = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", help="Processes; the results do not depend on it.", min=1, show_default="all cores")
    ] = None,
    format: FormatName = None,
    control: Control = None,
    camera: CameraList = "source",
    image_sigma: ImageSigma = None,
    datum: DatumName = None,
    solver: Solver = "auto",
    residual_plane: Plane = None,
    robust: Robust = None,
    min_rays: MinRays = None,
    snoop: Snoop = False,
    snoop_unit: SnoopUnit = "coordinate",
    snoop_law: SnoopLaw = None,
    select: Select = False,
    criterion: CriterionB = "variance",
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    power: Power = 0.80,
    sigma: SigmaName = "aposteriori",
    seed: Seed = 0,
    tables: Tables = "csv",
    spoken: Language = "en",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Adjust and test many blocks: a result folder each, a table and a report on all (default folder: baarda-batch); resumes."""
    from baarda.cli.adjust import camera_list
    from baarda.executors import ClusterLost, open_workers
    from baarda.hypotheses.levels import Options
    from baarda.procedures.batch import BatchOptions, block_jobs, run_batch, sources
    from baarda.procedures.block_comparison import compare_blocks
    from baarda.procedures.strategy import Plan
    from baarda.report.batch_report import BlockWriter, begin, result_json, verdict, write_summary
    from baarda.report.translation import check_language, language

    started = time.perf_counter()
    settings: dict[str, Any] = {
        "camera": camera_list(camera, None),
        "image_sigma": image_sigma,
        "datum": datum,
        "solver": solver,
        "residual_plane": residual_plane,
        "robust": robust,
        "min_rays": min_rays,
        "jobs": _threads(cluster, jobs),
    }
    levels: dict[str, Any] = {"alpha": alpha, "alpha_outlier": alpha_outlier, "power": power, "sigma": sigma, "seed": seed}
    plan: dict[str, Any] = {
        "snoop": snoop_unit if snoop or snoop_unit != "coordinate" or snoop_law is not None else None,
        "law": snoop_law,
        "select": select,
        "second": criterion,
    }
    Options(**levels), Plan(**plan)  # what makes no sense is refused before any work
    writer = BlockWriter(tables, check_language(spoken))
    target = out or Path("baarda-batch")
    options = BatchOptions(settings, levels, plan, format, None if control is None else str(control), vars(writer))
    work = block_jobs(sources(patterns), target, options)
    begin(target)
    tell = None if quiet else lambda text: typer.echo(text, err=True)
    counted = {"done": 0, "kept": 0}

    def progress(done: int, total: int, row: dict[str, Any]) -> None:
        counted["done"] = done
        kept = bool(row.get("kept"))
        counted["kept"] += kept
        if not quiet:
            what = "kept" if kept else row["status"].replace("_", " ")
            told = f": {shortened(row['message'])}" if row["message"] else "" if row["sigma0"] is None else f", s0 {row['sigma0']:.4g}"
            worked = done - counted["kept"]  # blocks of an earlier run took no time
            # only once each worker may have done one: before, the others' work is not counted
            rest = left(time.perf_counter() - begun, worked, total - done) if worked >= workers.count else ""
            typer.echo(f"{done:>{len(str(total))}} of {total}  {row['source']}  {what}{told}{rest}", err=True)

    try:
        with open_workers(cluster, jobs, tell=tell) as workers:
            name, begun = workers.name, time.perf_counter()
            rows = run_batch(work, writer, workers, progress)
    except (KeyboardInterrupt, ClusterLost) as stopped:
        reason = "interrupted" if isinstance(stopped, KeyboardInterrupt) else str(stopped)
        typer.echo(f"baarda: {reason}; finished blocks are kept in {target}: the same command goes on from there", err=True)
        raise typer.Exit(130 if isinstance(stopped, KeyboardInterrupt) else stopped.exit_code) from None
    study = compare_blocks(rows, alpha)
    facts = {"seconds": round(time.perf_counter() - started, 3), "workers": name, "kept": counted["kept"]}
    write_summary(study, target, tables, facts, spoken)
    if as_json:
        typer.echo(json.dumps(result_json(study), indent=1, allow_nan=False, ensure_ascii=False))
        sys.stdout.flush()
    elif not quiet:
        with language(spoken):
            for sentence in verdict(study):
                typer.echo(sentence)
    if not quiet:
        typer.echo(f"report: {target / 'report.html'}", err=True)
    if study.exit_code:
        lost = [r for r in study.rows if r["exit_code"]]
        typer.echo(
            f"baarda: {len(lost)} of {len(study.rows)} blocks have no tested result; "
            f"the first: {lost[0]['source']}: {shortened(lost[0]['message'])}",
            err=True,
        )
        raise typer.Exit(study.exit_code)
    if strict and any(study.gates.values()):
        typer.echo(f"baarda: rejected: {', '.join(n for n, rejected in study.gates.items() if rejected)}", err=True)
        raise typer.Exit(1)


def _threads(cluster: str | None, jobs: int | None) -> int:
    """Return the number of threads of each block: the cores are shared among the processes."""
    from baarda.distributions.workers import worker_count

    return max(1, worker_count(None) // worker_count(jobs)) if cluster is None else 1
