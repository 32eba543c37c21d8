"""`baarda compare`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from baarda.cli.base import (
    Alpha,
    CameraList,
    Control,
    ImageSigma,
    Json,
    Language,
    MinRays,
    Out,
    Quiet,
    SigmaName,
    Solver,
    Strict,
    Tables,
    app,
    guarded,
)


@app.command()
@guarded
def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="First epoch: a source of any format, or a result folder.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Second epoch, likewise.")],
    out: Out = None,
    frame: Annotated[
        str, typer.Option("--frame", help="given: compare coordinates as they are; common: take shifts, rotations and scale out; auto.")
    ] = "auto",
    points: Annotated[
        str | None, typer.Option("--points", help="Points to compare, separated by commas.", show_default="all that are common")
    ] = None,
    as_it_is: Annotated[bool, typer.Option("--as-it-is", help="Take the coordinates of B as they are, without adjusting them.")] = False,
    control: Control = None,
    camera: CameraList = "source",
    image_sigma: ImageSigma = None,
    solver: Solver = "auto",
    min_rays: MinRays = None,
    alpha: Alpha = 0.05,
    sigma: SigmaName = "aposteriori",
    tables: Tables = "csv",
    language: Language = "en",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Compare two adjustments of the same points: variance ratio, congruence, and which points have moved."""
    from baarda.cli.adjust import camera_list
    from baarda.formats.folder import check_target
    from baarda.hypotheses.levels import Options
    from baarda.procedures.comparison import compare as compare_epochs
    from baarda.procedures.comparison import epoch
    from baarda.report import translation
    from baarda.report.comparison_report import MARK, result_json, verdict, write_folder
    from baarda.report.contents import check_tables

    started = time.perf_counter()
    check_tables(tables)
    translation.check_language(language)
    target = None if as_json and out is None else out or Path("baarda-comparison")
    if target is not None:
        check_target(target, MARK)
    options = Options(alpha=alpha, sigma=sigma)  # type: ignore[arg-type]
    epochs = []
    for number, path in enumerate((first, second)):
        network = opened(path, control)
        settings = {"camera": camera_list(camera, network), "image_sigma": image_sigma, "solver": solver, "min_rays": min_rays}
        if not quiet:
            typer.echo(f"adjusting {path} ...", err=True)
        epochs.append(epoch(network, as_it_is and number == 1, **settings))
    chosen = None if points is None else [p.strip() for p in points.split(",") if p.strip()]
    made = compare_epochs(epochs[0], epochs[1], options, frame, chosen)  # type: ignore[arg-type]
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
    if strict and made.rejected:
        typer.echo("baarda: rejected: deformation", err=True)
        raise typer.Exit(1)


def opened(path: Path, control: Path | None) -> Any:
    """Read a source; of a result folder the adjusted network in it."""
    from dataclasses import replace

    from baarda.formats import read
    from baarda.report.result_folder import MARK

    if path.is_dir() and (path / "project").is_dir() and MARK.on(path):
        return replace(read(path / "project", control=control), path=str(path))
    return read(path, control=control)
