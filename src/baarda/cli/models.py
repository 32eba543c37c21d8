"""`baarda models`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from baarda.cli.base import (
    Alpha,
    AlphaOutlier,
    Control,
    FormatName,
    Json,
    Language,
    Out,
    Power,
    Quiet,
    Seed,
    SigmaName,
    Solver,
    Strict,
    Tables,
    app,
    guarded,
)
from baarda.errors import UsageError


@app.command()
@guarded
def models(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Project with model coordinates, perspective centres included.")],
    out: Out = None,
    form: Annotated[str, typer.Option("--form", help="spatial (seven unknowns a model) or planimetry-height (4 and 3).")] = "spatial",
    format: FormatName = None,
    control: Control = None,
    solver: Solver = "auto",
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    power: Power = 0.80,
    sigma: SigmaName = "aposteriori",
    seed: Seed = 0,
    tables: Tables = "csv",
    language: Language = "en",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Adjust a block of independent models, in space at once or in plan and height by turns (default folder: baarda-models)."""
    from baarda.cli.run import adjust_and_report
    from baarda.formats import read
    from baarda.formats.folder import check_target
    from baarda.hypotheses.levels import Options
    from baarda.procedures.planimetry_height import adjust_planimetry_height
    from baarda.report import translation
    from baarda.report.contents import check_tables
    from baarda.report.planimetry_height_report import MARK, result_json, told, verdict, write_folder

    started = time.perf_counter()
    if form not in ("spatial", "planimetry-height"):
        raise UsageError(f"--form is spatial or planimetry-height, not {form!r}")
    check_tables(tables)
    translation.check_language(language)
    levels = {"alpha": alpha, "alpha_outlier": alpha_outlier, "power": power, "sigma": sigma, "seed": seed}
    target = None if as_json and out is None else out or Path("baarda-models")
    network = read(source, format=format, control=control)
    if form == "spatial":
        adjust_and_report(network, {"solver": solver}, levels, target, tables, as_json, quiet, strict, started, spoken=language)
        return
    if target is not None:
        check_target(target, MARK)
    tell = None if quiet else lambda text: typer.echo(text, err=True)
    found = adjust_planimetry_height(network, tell=tell, solver=solver)
    made = told(found, Options(**levels))  # type: ignore[arg-type]
    if target is not None:
        write_folder(made, target, tables, {"seconds": round(time.perf_counter() - started, 3)}, language)
    if as_json:
        typer.echo(json.dumps(result_json(made), indent=1, allow_nan=False, ensure_ascii=False))
    elif not quiet:
        with translation.language(language):
            for sentence in verdict(made):
                typer.echo(sentence)
    if target is not None and not quiet:
        typer.echo(f"report: {target / 'report.html'}", err=True)
    if not found.converged:
        typer.echo(f"baarda: plan and height do not stand still after {len(found.changes)} rounds", err=True)
        raise typer.Exit(3)
    if strict and any(made.gates.values()):
        failed = ", ".join(name for name, rejected in made.gates.items() if rejected)
        typer.echo(f"baarda: rejected: {failed}", err=True)
        raise typer.Exit(1)
