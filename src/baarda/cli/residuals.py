"""`baarda residuals`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from baarda.cli.base import Alpha, Json, Out, Quiet, Seed, Strict, Tables, app, guarded


@app.command()
@guarded
def residuals(
    table: Annotated[Path, typer.Argument(metavar="TABLE", help="CSV, NPY or Parquet table of residuals.")],
    out: Out = None,
    column: Annotated[
        str | None, typer.Option("--column", help="Column of the residuals.", show_default="residual, else the only one of numbers")
    ] = None,
    group: Annotated[str | None, typer.Option("--group", help="Column of the groups.", show_default="image, else group, if there")] = None,
    alpha: Alpha = 0.05,
    seed: Seed = 0,
    tables: Tables = "csv",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Study a plain table of residuals: moments, homogeneity, laws of errors (default folder: baarda-residuals)."""
    from baarda.procedures.law_study import StudyOptions
    from baarda.report.residual_report import run

    started = time.perf_counter()
    target = None if as_json and out is None else out or Path("baarda-residuals")
    if not quiet:
        typer.echo("studying ...", err=True)
    outcome = run(table, target, column, group, StudyOptions(alpha=alpha, seed=seed), tables=tables)
    if as_json:
        typer.echo(json.dumps(outcome.document, indent=1, allow_nan=False, ensure_ascii=False))
    elif not quiet:
        for sentence in outcome.verdict:
            typer.echo(sentence)
        typer.echo(f"{time.perf_counter() - started:.1f} s", err=True)
    if target is not None and not quiet:
        typer.echo(f"report: {target / 'report.html'}", err=True)
    if strict and any(outcome.study.gates.values()):
        failed = ", ".join(name for name, rejected in outcome.study.gates.items() if rejected)
        typer.echo(f"baarda: rejected: {failed}", err=True)
        raise typer.Exit(1)
