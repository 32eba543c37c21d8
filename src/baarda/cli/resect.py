"""`baarda resect`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from baarda.cli.base import (
    Alpha,
    AlphaOutlier,
    CameraList,
    Control,
    FormatName,
    ImageSigma,
    Json,
    Language,
    Out,
    Plane,
    Quiet,
    Seed,
    SigmaName,
    Strict,
    Tables,
    app,
    guarded,
)


@app.command()
@guarded
def resect(
    sources: Annotated[list[Path], typer.Argument(metavar="SOURCE...", help="Files or folders of any format; each image is a set.")],
    out: Out = None,
    format: FormatName = None,
    control: Control = None,
    camera: CameraList = "none",
    image_sigma: ImageSigma = None,
    residual_plane: Plane = None,
    replicas: Annotated[int, typer.Option("--replicas", help="Simulated adjustments of each null law of the residual study.")] = 999,
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    sigma: SigmaName = "aposteriori",
    seed: Seed = 0,
    tables: Tables = "csv",
    language: Language = "en",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Resect many images independently from control points and study them together (default folder: baarda-resections)."""
    from baarda.cli.adjust import camera_list
    from baarda.formats import read
    from baarda.formats.folder import check_target
    from baarda.hypotheses.levels import Options
    from baarda.procedures.law_study import StudyOptions
    from baarda.procedures.resection_sets import resect_sets, sets_of
    from baarda.report import translation
    from baarda.report.contents import check_tables
    from baarda.report.resection_report import MARK, result_json, verdict, write_folder

    started = time.perf_counter()
    check_tables(tables)
    translation.check_language(language)
    target = None if as_json and out is None else out or Path("baarda-resections")
    if target is not None:
        check_target(target, MARK)
    options = Options(alpha=alpha, alpha_outlier=alpha_outlier, sigma=sigma, seed=seed)  # type: ignore[arg-type]
    networks = [read(path, format=format, control=control) for path in sources]
    settings = {"camera": camera_list(camera, networks[0]), "image_sigma": image_sigma, "residual_plane": residual_plane}
    tell = None if quiet else lambda text: typer.echo(text, err=True)
    study_options = StudyOptions(alpha=alpha, seed=seed, replicas=replicas)
    made = resect_sets(sets_of(networks), options, study_options, tell, **settings)
    if target is not None:
        write_folder(made, networks, target, tables, {"seconds": round(time.perf_counter() - started, 3)}, language)
    if as_json:
        typer.echo(json.dumps(result_json(made, networks), indent=1, allow_nan=False, ensure_ascii=False))
    elif not quiet:
        with translation.language(language):
            for sentence in verdict(made, networks):
                typer.echo(sentence)
    if target is not None and not quiet:
        typer.echo(f"report: {target / 'report.html'}", err=True)
    if strict and any(made.gates.values()):
        failed = ", ".join(name for name, rejected in made.gates.items() if rejected)
        typer.echo(f"baarda: rejected: {failed}", err=True)
        raise typer.Exit(1)
