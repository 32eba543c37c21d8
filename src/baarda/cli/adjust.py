"""`baarda adjust`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from baarda.cli.base import (
    Alpha,
    AlphaOutlier,
    AuditFlag,
    CameraList,
    CameraPositionsFile,
    Cluster,
    Components,
    ComponentsBy,
    Control,
    Covariance,
    CriterionB,
    CrossValidate,
    Crs,
    DatumName,
    FormatName,
    GeoidHeight,
    ImageSigma,
    Jobs,
    Json,
    Language,
    LeverArm,
    MarksFile,
    MinRays,
    Out,
    Pdf,
    Plane,
    PointsFile,
    PositionModel,
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
    StrategyName,
    Strict,
    Tables,
    app,
    guarded,
)
from baarda.cli.run import adjust_and_report
from baarda.errors import UsageError


@app.command()
@guarded
def adjust(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of any known format.")],
    out: Out = None,
    format: FormatName = None,
    control: Control = None,
    marks: MarksFile = None,
    crs: Crs = None,
    geoid: GeoidHeight = None,
    camera_positions: CameraPositionsFile = None,
    lever_arm: LeverArm = "0,0,0",
    position_model: PositionModel = "none",
    camera: CameraList = "source",
    image_sigma: ImageSigma = None,
    datum: DatumName = None,
    solver: Solver = "auto",
    residual_plane: Plane = None,
    robust: Robust = None,
    min_rays: MinRays = None,
    audit: AuditFlag = False,
    snoop: Snoop = False,
    snoop_unit: SnoopUnit = "coordinate",
    snoop_law: SnoopLaw = None,
    select: Select = False,
    criterion: CriterionB = "variance",
    cross_validate: CrossValidate = None,
    strategy: StrategyName = None,
    variance_components: Components = False,
    components_by: ComponentsBy = "group",
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    power: Power = 0.80,
    sigma: SigmaName = "aposteriori",
    seed: Seed = 0,
    jobs: Jobs = None,
    cluster: Cluster = None,
    tables: Tables = "csv",
    spoken: Language = "en",
    pdf: Pdf = False,
    covariance: Covariance = None,
    points: PointsFile = None,
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Read a block, adjust it, test it, and write the result folder (default: baarda-out)."""
    from baarda.formats import read

    started = time.perf_counter()
    if cluster is not None or (source.name == "partition.json" or (source / "partition.json").is_file()):
        from baarda.cli.run_parts import adjust_parts_and_report

        adjust_parts_and_report(
            source,
            {"datum": datum, "image_sigma": image_sigma, "residual_plane": residual_plane, "min_rays": min_rays, "jobs": jobs},
            {"alpha": alpha, "alpha_outlier": alpha_outlier, "power": power, "sigma": sigma, "seed": seed},
            None if as_json and out is None else out or Path("baarda-out"),
            tables,
            as_json,
            quiet,
            strict,
            started,
            cluster,
            spoken,
            {
                "--format": format,
                "--control": control,
                "--marks": marks,
                "--crs": crs,
                "--geoid": geoid,
                "--camera-positions": camera_positions,
                "--lever-arm": lever_arm != "0,0,0",
                "--position-model": position_model != "none",
                "--camera": camera != "source",
                "--solver": solver == "dense",
                "--robust": robust,
                "--audit": audit,
                "--snoop": snoop or snoop_law or snoop_unit != "coordinate",
                "--select": select,
                "--criterion": criterion != "variance",
                "--cross-validate": cross_validate,
                "--strategy": strategy,
                "--variance-components": variance_components,
                "--components-by": components_by != "group",
                "--pdf": pdf,
                "--covariance": covariance,
                "--points": points,
            },
        )
        return
    system = None
    if crs is not None:
        from baarda.formats.coordinate_system import CoordinateSystem

        if control is None and camera_positions is None:
            raise UsageError("--crs names the coordinate system of --control or --camera-positions")
        system = CoordinateSystem.of(crs, geoid)
    elif geoid is not None:
        raise UsageError("--geoid belongs to --crs")
    tied = {} if control is None else {"crs": crs, "geoid": geoid}
    network = read(source, format=format, control=control, marks=marks, **tied)
    if camera_positions is not None:
        from baarda.formats.camera_positions import with_camera_positions

        network = with_camera_positions(network, camera_positions, lever_arm, position_model, system)
    elif lever_arm != "0,0,0" or position_model != "none":
        raise UsageError("--lever-arm and --position-model belong to --camera-positions")
    settings = {
        "camera": camera_list(camera, network),
        "image_sigma": image_sigma,
        "datum": datum,
        "solver": solver,
        "residual_plane": residual_plane,
        "robust": robust,
        "min_rays": min_rays,
        "jobs": jobs,
    }
    levels = {"alpha": alpha, "alpha_outlier": alpha_outlier, "power": power, "sigma": sigma, "seed": seed}
    target = None if as_json and out is None else out or Path("baarda-out")
    plan = {
        "snoop": snoop_unit if snoop or snoop_unit != "coordinate" or snoop_law is not None else None,
        "law": snoop_law,
        "select": select,
        "second": criterion,
        "folds": cross_validate,
        "strategy": strategy,
    }
    components = components_by if variance_components or components_by != "group" else None
    files = {"covariance": covariance, "points": points}
    adjust_and_report(
        network,
        settings,
        levels,
        target,
        tables,
        as_json,
        quiet,
        strict,
        started,
        plan,
        components,
        audit=audit,
        spoken=spoken,
        pdf=pdf,
        **files,
    )


def camera_list(text: str, network: Any) -> str | tuple[str, ...] | None:
    """Read --camera: None leaves what the source says, its settings included."""
    return None if text == "source" else () if text == "none" else text
