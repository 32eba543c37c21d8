"""The application, the options that mean the same everywhere, and the exit codes."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from baarda import __version__
from baarda.cli import unforeseen
from baarda.errors import BaardaError

app = typer.Typer(
    name="baarda",
    help="Adjust photogrammetric observations by rigorous least squares and test everything that comes out.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
)

Out = Annotated[Path | None, typer.Option("--out", help="Result folder to write; there whole or not at all.", show_default=False)]
Control = Annotated[Path | None, typer.Option("--control", help="Table of control and check points.", show_default=False)]
MarksFile = Annotated[
    Path | None,
    typer.Option("--marks", help="Table of image marks (image, point, x, y, sigma) of control and check points.", show_default=False),
]
Crs = Annotated[
    str | None,
    typer.Option(
        "--crs",
        help="Coordinate system of the tables of --control and --camera-positions: EPSG:25832, EPSG:25832+7837, WKT (extra geo).",
        show_default=False,
    ),
]
GeoidHeight = Annotated[
    str | None, typer.Option("--geoid", help="Geoid height in metres, or the file of a grid, for heights of --crs.", show_default=False)
]
CameraPositionsFile = Annotated[
    Path | None,
    typer.Option(
        "--camera-positions",
        help="Table of measured camera positions (GNSS) with their sigmas; 'source': those of an OpenSfM, Metashape or OPF source.",
        show_default=False,
    ),
]
LeverArm = Annotated[
    str, typer.Option("--lever-arm", help="From projection centre to antenna, camera axes: x,y,z (known), free, or free:x,y,z.")
]
PositionModel = Annotated[str, typer.Option("--position-model", help="Estimated for each strip of positions: none, shift or drift.")]
AuditFlag = Annotated[bool, typer.Option("--audit", help="Evaluate the source's own solution as it stands, beside the rigorous one.")]
Covariance = Annotated[
    Path | None, typer.Option("--covariance", help="Folder to write the covariances of the unknowns to.", show_default=False)
]
PointsFile = Annotated[
    Path | None, typer.Option("--points", help="File (.csv, .geojson) to write the adjusted points and sigmas to.", show_default=False)
]
FormatName = Annotated[
    str | None, typer.Option("--format", help="Format of the source; by default recognised by content.", show_default=False)
]
CameraList = Annotated[
    str,
    typer.Option(
        "--camera",
        help="Camera parameters to estimate: source, none, all, a list such as principal_distance,K1, "
        "or a preset: ebner12, fixed-brown+gruen44 (baarda cameras lists the models).",
    ),
]
ImageSigma = Annotated[
    float | None, typer.Option("--image-sigma", help="A-priori sigma of all image coordinates, pixels.", show_default=False)
]
DatumName = Annotated[str | None, typer.Option("--datum", help="auto, control, inner or minimal.", show_default="source, else auto")]
Solver = Annotated[str, typer.Option("--solver", help="auto, dense or block.")]
Robust = Annotated[
    str | None,
    typer.Option("--robust", help="Adjust by maximum likelihood under this law of errors (see: baarda laws).", show_default=False),
]
Snoop = Annotated[
    bool, typer.Option("--snoop", help="Remove gross errors one by one and adjust again (with --robust: after a robust start).")
]
SnoopUnit = Annotated[str, typer.Option("--snoop-unit", help="What --snoop removes at once: coordinate, point (of an image) or image.")]
SnoopLaw = Annotated[
    str | None,
    typer.Option("--snoop-law", help="Law of errors for the limits of --snoop, fitted to the residuals.", show_default="normal"),
]
Select = Annotated[bool, typer.Option("--select", help="Drop insignificant additional parameters one by one and adjust again.")]
Components = Annotated[
    bool, typer.Option("--variance-components", help="Estimate the variances of groups of observations first, and adjust with them.")
]
ComponentsBy = Annotated[
    str, typer.Option("--components-by", help="One variance component per group of observations (group) or also per camera (camera).")
]
CriterionB = Annotated[
    str,
    typer.Option("--criterion", help="Criterion 9b of --select: variance (of s0^2), s, j, or trace (of the point covariances)."),
]
CrossValidate = Annotated[
    int | None, typer.Option("--cross-validate", metavar="K", help="Withhold the control points in K turns.", show_default=False)
]
StrategyName = Annotated[
    str | None,
    typer.Option(
        "--strategy", help="gruen: snooping, tests of all, single and paired parameters, deletion, control, check.", show_default=False
    ),
]
Plane = Annotated[str | None, typer.Option("--residual-plane", help="image or corrected.", show_default="source")]
MinRays = Annotated[int | None, typer.Option("--min-rays", help="Set points with fewer rays aside.", show_default="source, else 2")]
Alpha = Annotated[float, typer.Option("--alpha", help="Level of global and parameter tests.")]
AlphaOutlier = Annotated[float, typer.Option("--alpha-outlier", help="Level of the test of one observation.")]
Power = Annotated[float, typer.Option("--power", help="Power behind minimal detectable biases.")]
SigmaName = Annotated[str, typer.Option("--sigma", help="Which variance factor judges and scales: aposteriori (tau) or apriori (w).")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of simulated null laws.")]
Jobs = Annotated[int | None, typer.Option("--jobs", help="Threads; the results do not depend on it.", min=1, show_default="all cores")]
Cluster = Annotated[
    str | None,
    typer.Option("--cluster", metavar="ADDRESS|local", help="Work on a Dask cluster (extra cluster).", show_default=False),
]
Tables = Annotated[str, typer.Option("--tables", help="Format of the tables: csv or parquet.")]
Language = Annotated[str, typer.Option("--language", help="Language of the report and the verdict: en or de.")]
Pdf = Annotated[bool, typer.Option("--pdf", help="Write report.pdf, too (extra pdf).")]
Json = Annotated[bool, typer.Option("--json", help="Print result.json to stdout; the folder is written only with --out.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress and no verdict.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 when the global, outlier, check point or control point test rejects.")]


def one_blas_thread(function: Callable[..., None]) -> Callable[..., None]:
    """Wrap a function so that BLAS uses one thread: more of them would sum in another order."""

    @functools.wraps(function)
    def wrapped(*args: Any, **options: Any) -> None:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(limits=1, user_api="blas"):
            function(*args, **options)

    return wrapped


def guarded(function: Callable[..., None]) -> Callable[..., None]:
    """Turn every failure into one message and the exit code of the contract: 1 is left to a gate that failed."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            function(*args, **kwargs)
        except BaardaError as error:
            typer.echo(f"baarda: {error}", err=True)
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            typer.echo("baarda: interrupted, nothing was written", err=True)
            raise typer.Exit(130) from None
        except MemoryError:
            typer.echo("baarda: out of memory, nothing was written", err=True)
            raise typer.Exit(4) from None
        except BrokenPipeError:
            sys.stderr.close()
            raise typer.Exit(4) from None
        except OSError as error:
            place = f" {error.filename}" if error.filename else ""
            typer.echo(f"baarda: cannot read or write{place}: {error.strerror or error}", err=True)
            raise typer.Exit(4) from None
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except Exception as error:
            typer.echo(f"baarda: {unforeseen(error)}", err=True)
            raise typer.Exit(2) from None

    return run


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False) -> None:
    """Adjust photogrammetric observations by rigorous least squares and test everything that comes out."""
    if version:
        typer.echo(f"baarda {__version__}")
        raise typer.Exit(0)
