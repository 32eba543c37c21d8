"""Adjust a network in parts, write the folder and print the verdict: what `adjust` does with a partitioned project."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import typer

from baarda.cli.progress import Iterations, stage
from baarda.errors import UsageError


def adjust_parts_and_report(
    source: Path,
    settings: dict[str, Any],
    levels: dict[str, Any],
    out: Path | None,
    tables: str,
    as_json: bool,
    quiet: bool,
    strict: bool,
    started: float,
    cluster: str | None,
    spoken: str,
    others: dict[str, Any],
) -> None:
    """Adjust the parts, test, write the folder, print verdict or JSON, leave with the exit code."""
    from baarda.adjustment.solve import Settings
    from baarda.formats.folder import check_target
    from baarda.hypotheses.levels import Options
    from baarda.procedures.helmert import finish, solve_blocked
    from baarda.procedures.partition_folder import is_partition, read_partition
    from baarda.procedures.task_engines import open_engine
    from baarda.report.contents import check_tables
    from baarda.report.helmert_report import check_options, gates, result_json, verdict, write_blocked
    from baarda.report.result_folder import MARK
    from baarda.report.translation import check_language, language

    if not is_partition(source):
        raise UsageError(f"--cluster adjusts a block in parts: first baarda split {source} --parts K --out DIR, then adjust DIR")
    given = [name for name, value in others.items() if value]
    if given:
        raise UsageError(
            f"{', '.join(given)} do(es) not go with a block in parts: it is adjusted and tested by least squares as it was split"
        )
    check_language(spoken)
    check_tables(tables)
    options = Options(**levels)
    check_options(options)
    if out is not None:
        check_target(out, MARK)

    folder = read_partition(source)
    jobs = settings.pop("jobs", None)
    tell = None if quiet else lambda text: typer.echo(text, err=True)
    progress, begins = None if quiet else Iterations(started, Settings.tolerance), stage(quiet)
    with open_engine(cluster, jobs, tell=tell) as engine:
        threads = jobs if cluster is None else 1
        blocked = solve_blocked(folder, engine, progress=progress, tell=tell, **{**settings, "jobs": threads})
        if blocked.converged and not quiet:
            typer.echo(f"adjusted: s0 {blocked.variance_factor**0.5:.4g}, redundancy {blocked.redundancy}", err=True)

        def facts() -> dict[str, Any]:
            moved = {"tasks": engine.tasks, "bytes_sent": engine.sent, "bytes_received": engine.received}
            return {"seconds": round(time.perf_counter() - started, 3), "workers": engine.name, **moved}

        def finished(place: str | None = None, write: Any = None) -> Any:
            tables_too = "" if place is None else ", and their tables"
            begins(f"redundancy numbers, precision and tests of {len(blocked.joint.facts)} parts{tables_too}")
            made = finish(blocked, engine, options, place, write)
            if place is not None:
                begins("figures and report")
            return made

        done = finished() if out is None else write_blocked(finished, out, str(source), tables, facts, spoken)
    if as_json:
        typer.echo(json.dumps(result_json(done, str(source)), indent=1, allow_nan=False, ensure_ascii=False))
        sys.stdout.flush()
    elif not quiet:
        with language(spoken):
            for sentence in verdict(done):
                typer.echo(sentence)
    if out is not None and not quiet:
        typer.echo(f"report: {out / 'report.html'}", err=True)
    if not blocked.converged:
        typer.echo(f"baarda: not converged after {len(blocked.history) - 1} iterations, nothing was tested", err=True)
        raise typer.Exit(3)
    failed = [name for name, rejected in gates(done).items() if rejected]
    if strict and failed:
        typer.echo(f"baarda: rejected: {', '.join(failed)}", err=True)
        raise typer.Exit(1)
