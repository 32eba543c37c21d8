"""`baarda simulate`."""

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
    Seed,
    Solver,
    Strict,
    Tables,
    app,
    guarded,
)

KINDS = ("aerial", "ring", "long-tracks", "dense")


@app.command()
@guarded
def simulate(
    project: Annotated[
        str, typer.Argument(metavar="PROJECT|KIND", help="A planned network of any format, or aerial, ring, long-tracks, dense, radar.")
    ],
    out: Out = None,
    replicas: Annotated[int, typer.Option("--replicas", help="Prove the predictions by so many replicas.", min=0)] = 0,
    jobs: Annotated[int, typer.Option("--jobs", help="Processes that share the replicas.", min=1)] = 1,
    truth: Annotated[str, typer.Option("--truth", help="Geometry taken for true: auto, adjusted or start.")] = "auto",
    images: Annotated[int, typer.Option("--images", help="KIND: number of images.")] = 20,
    points: Annotated[int | None, typer.Option("--points", help="KIND: number of object points.", show_default="usual")] = None,
    checks: Annotated[int, typer.Option("--checks", help="KIND: number of check points.")] = 0,
    control_points: Annotated[
        int | None, typer.Option("--control-points", help="KIND: number of control points.", show_default="usual")
    ] = None,
    noise: Annotated[float, typer.Option("--noise", help="KIND: standard deviation of image coordinates, pixels.")] = 0.5,
    perturbation: Annotated[float, typer.Option("--perturbation", help="KIND: size of the errors of the start values; 0 = none.")] = 1.0,
    model: Annotated[str, typer.Option("--model", help="KIND: camera model.")] = "RADIAL",
    per_image_cameras: Annotated[bool, typer.Option("--per-image-cameras", help="KIND: a camera for every image.")] = False,
    format: FormatName = None,
    control: Control = None,
    camera: CameraList = "source",
    image_sigma: ImageSigma = None,
    datum: DatumName = None,
    solver: Solver = "auto",
    residual_plane: Plane = None,
    min_rays: MinRays = None,
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    power: Power = 0.80,
    seed: Seed = 0,
    tables: Tables = "csv",
    language: Language = "en",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Predict precision and reliability of a planned network, prove them by replicas; or make a block with known truth."""
    if project == "radar":
        make_radar(out, quiet, 35 if points is None else points, noise, seed)
        return
    if project.replace("_", "-") in KINDS:
        options = {"points": points, "checks": checks, "control": control_points, "noise": noise, "perturbation": perturbation}
        make(project, images, out, quiet, {**options, "model": model, "per_image_cameras": per_image_cameras, "seed": seed})
        return
    from baarda.cli.adjust import camera_list
    from baarda.formats import read
    from baarda.formats.folder import check_target
    from baarda.hypotheses.levels import Options
    from baarda.procedures.planning import plan
    from baarda.procedures.proof import prove
    from baarda.procedures.simulation import simulate as run_replicas
    from baarda.report import translation
    from baarda.report.contents import check_tables
    from baarda.report.simulation_report import MARK, result_json, verdict, write_folder

    started = time.perf_counter()
    check_tables(tables)
    translation.check_language(language)
    target = None if as_json and out is None else out or Path("baarda-simulation")
    if target is not None:
        check_target(target, MARK)
    network = read(Path(project), format=format, control=control)
    settings = {
        "camera": camera_list(camera, network),
        "image_sigma": image_sigma,
        "datum": datum,
        "solver": solver,
        "residual_plane": residual_plane,
        "min_rays": min_rays,
    }
    planned = plan(network, Options(alpha=alpha, alpha_outlier=alpha_outlier, power=power, seed=seed), truth, **settings)  # type: ignore[arg-type]
    proof = None
    if replicas:

        def progress(done: int) -> None:
            spent = time.perf_counter() - begun
            left = f"  about {spent / done * (replicas - done):.0f} s left" if done < replicas else ""
            typer.echo(f"replica {done:>5} of {replicas}{left}", err=True)

        begun = time.perf_counter()
        proof = prove(run_replicas(planned, replicas, seed, jobs, None if quiet else progress, **settings))
    if target is not None:
        write_folder(planned, proof, target, tables, {"seconds": round(time.perf_counter() - started, 3), "jobs": jobs}, language)
    if as_json:
        typer.echo(json.dumps(result_json(planned, proof), indent=1, allow_nan=False, ensure_ascii=False))
    elif not quiet:
        with translation.language(language):
            for sentence in verdict(planned, proof):
                typer.echo(sentence)
    if target is not None and not quiet:
        typer.echo(f"report: {target / 'report.html'}", err=True)
    if strict and proof is not None and not proof.holds:
        typer.echo("baarda: the replicas contradict the predictions", err=True)
        raise typer.Exit(1)


def make(kind: str, images: int, out: Path | None, quiet: bool, options: dict[str, object]) -> None:
    """Write a synthetic block as a project; its true coordinates stay with whoever repeats it with the same seed."""
    from baarda.errors import UsageError
    from baarda.formats.folder import check_target
    from baarda.formats.project import write
    from baarda.procedures.synthetic import synthetic

    if out is None:
        raise UsageError(f"simulate {kind} makes a project: say where (--out DIR)")
    check_target(out)
    block = synthetic(kind, images, **options)
    write(block.network, out)
    if not quiet:
        rows = sum(len(g) for g in block.network.observations)
        typer.echo(f"{out}: {images} images, {len(block.network.points.labels)} object points, {rows} image points and distances")


def make_radar(out: Path | None, quiet: bool, points: int, noise: float, seed: int) -> None:
    """Write the radar image of Yangmei (Wu 2000) as a project, noise in r in pixels, and as much on the ground in t."""
    from baarda.errors import UsageError
    from baarda.formats.folder import check_target
    from baarda.formats.project import write
    from baarda.procedures.radar_simulation import PIXEL, SPEED, simulate_radar

    if out is None:
        raise UsageError("simulate radar makes a project: say where (--out DIR)")
    if points < 1 or not noise > 0.0:
        raise UsageError(f"a radar image needs points and noise, not {points} and {noise}")
    check_target(out)
    made = simulate_radar(seed, (noise * PIXEL / SPEED, noise), points)
    write(made.network, out)
    if not quiet:
        typer.echo(f"{out}: one radar image, {points} control points, {2 * points} observations")
