"""The command line: short verbs over the public API. Nothing heavy is imported before a verb runs."""

from __future__ import annotations

import functools
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from baarda import __version__
from baarda.errors import BaardaError, UsageError

app = typer.Typer(
    name="baarda",
    help="Adjust photogrammetric observations by rigorous least squares and test everything that comes out.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
)

Out = Annotated[Path | None, typer.Option("--out", help="Result folder to write; there whole or not at all.", show_default=False)]
Control = Annotated[Path | None, typer.Option("--control", help="Table of control and check points.", show_default=False)]
FormatName = Annotated[
    str | None, typer.Option("--format", help="Format of the source; by default recognised by content.", show_default=False)
]
CameraList = Annotated[
    str, typer.Option("--camera", help="Camera parameters to estimate: 'source', 'none', 'all', or a list such as principal_distance,K1.")
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
Plane = Annotated[str | None, typer.Option("--residual-plane", help="image or corrected.", show_default="source")]
MinRays = Annotated[int | None, typer.Option("--min-rays", help="Set points with fewer rays aside.", show_default="source, else 2")]
Alpha = Annotated[float, typer.Option("--alpha", help="Level of global and parameter tests.")]
AlphaOutlier = Annotated[float, typer.Option("--alpha-outlier", help="Level of the test of one observation.")]
Power = Annotated[float, typer.Option("--power", help="Power behind minimal detectable biases.")]
SigmaName = Annotated[str, typer.Option("--sigma", help="Which variance factor judges and scales: aposteriori (tau) or apriori (w).")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of simulated null laws.")]
Tables = Annotated[str, typer.Option("--tables", help="Format of the tables: csv or parquet.")]
Json = Annotated[bool, typer.Option("--json", help="Print result.json to stdout; the folder is written only with --out.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress and no verdict.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 when the global, outlier, check point or control point test rejects.")]


def guarded(function: Callable[..., None]) -> Callable[..., None]:
    """Turn every foreseen failure into one message and the exit code of the contract."""

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

    return run


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False) -> None:
    """Adjust photogrammetric observations by rigorous least squares and test everything that comes out."""
    if version:
        typer.echo(f"baarda {__version__}")
        raise typer.Exit(0)


@app.command()
@guarded
def demo(
    out: Out = None,
    solver: Solver = "auto",
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    power: Power = 0.80,
    sigma: SigmaName = "aposteriori",
    seed: Seed = 0,
    tables: Tables = "csv",
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
    _adjust_and_report(network, {"solver": solver}, levels, target, tables, as_json, quiet, strict, started)


@app.command()
@guarded
def adjust(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of any known format.")],
    out: Out = None,
    format: FormatName = None,
    control: Control = None,
    camera: CameraList = "source",
    image_sigma: ImageSigma = None,
    datum: DatumName = None,
    solver: Solver = "auto",
    residual_plane: Plane = None,
    robust: Robust = None,
    min_rays: MinRays = None,
    alpha: Alpha = 0.05,
    alpha_outlier: AlphaOutlier = 0.001,
    power: Power = 0.80,
    sigma: SigmaName = "aposteriori",
    seed: Seed = 0,
    tables: Tables = "csv",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Read a block, adjust it, test it, and write the result folder (default: baarda-out)."""
    from baarda.formats import read

    started = time.perf_counter()
    network = read(source, format=format, control=control)
    settings = {
        "camera": _camera_list(camera, network),
        "image_sigma": image_sigma,
        "datum": datum,
        "solver": solver,
        "residual_plane": residual_plane,
        "robust": robust,
        "min_rays": min_rays,
    }
    levels = {"alpha": alpha, "alpha_outlier": alpha_outlier, "power": power, "sigma": sigma, "seed": seed}
    target = None if as_json and out is None else out or Path("baarda-out")
    _adjust_and_report(network, settings, levels, target, tables, as_json, quiet, strict, started)


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


@app.command()
@guarded
def reproduce(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="The paper; all of them when left out.", show_default=False)] = None,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Recompute the tables and figures of the source papers: printed, ours, difference, reason."""
    from baarda.papers import paper, papers, render_text, write

    chosen = list(papers().values()) if name is None else [paper(name)]
    for item in chosen:
        made = item.run()
        if not quiet:
            typer.echo(render_text(made))
        if out is not None:
            target = out if len(chosen) == 1 else out / item.name
            write(made, target)
            if not quiet:
                typer.echo(f"report: {target / 'reproduce.html'}", err=True)


@app.command()
@guarded
def convert(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of any known format.")],
    to: Annotated[str, typer.Option("--to", help="Format to write.")],
    out: Annotated[Path, typer.Option("--out", help="File or folder to write; must not exist.")],
    format: FormatName = None,
    control: Control = None,
) -> None:
    """Read one format, write another."""
    from baarda.errors import OutputError
    from baarda.formats import read, write

    network = read(source, format=format, control=control)
    if out.exists():
        raise OutputError(f"{out} exists")
    write(network, out, to)


@app.command()
@guarded
def warmup() -> None:
    """Compile the kernels once, so that later runs find them cached."""
    from baarda.distributions.kernels import compiled

    typer.echo("kernels are compiled" if compiled() is not None else "numba is not installed: the slower NumPy twins are used")


@app.command()
@guarded
def formats() -> None:
    """List the file formats."""
    from baarda.formats import formats as known

    for f in known().values():
        typer.echo(f"{f.name:<16}{'read, write' if f.write else 'read':<13}{f.description}")


@app.command()
@guarded
def cameras() -> None:
    """List the camera models."""
    from baarda.cameras import models

    for m in models().values():
        typer.echo(f"{m.name:<16}{m.description}")


@app.command()
@guarded
def laws() -> None:
    """List the laws of errors."""
    from baarda.distributions import laws as known

    for name, law in known().items():
        typer.echo(f"{name:<24}{_first_line(law)}")


@app.command()
@guarded
def tests() -> None:
    """List the tests."""
    from baarda.discover import modules

    for module in modules("baarda.hypotheses"):
        if hasattr(module, "from_evidence"):
            typer.echo(f"{module.__name__.rsplit('.', 1)[1]:<24}{_first_line(module)}")


def _first_line(item: Any) -> str:
    text = getattr(item, "description", None) or item.__doc__ or ""
    return str(text).strip().split("\n")[0]


def _camera_list(text: str, network: Any) -> tuple[str, ...] | None:
    """Read --camera: None leaves the source's states."""
    if text == "source":
        return None
    if text == "none":
        return ()
    if text == "all":
        return tuple(dict.fromkeys(name for c in network.cameras for name in c.model.order))
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _adjust_and_report(
    network: Any,
    settings: dict[str, Any],
    levels: dict[str, Any],
    out: Path | None,
    tables: str,
    as_json: bool,
    quiet: bool,
    strict: bool,
    started: float,
) -> None:
    from baarda.adjustment import adjust as adjust_network
    from baarda.formats.folder import check_target
    from baarda.hypotheses.levels import Options
    from baarda.procedures.testing import analyse
    from baarda.report import page
    from baarda.report.result_folder import MARK, result_json, write_folder

    if tables not in ("csv", "parquet"):
        raise UsageError(f"--tables is csv or parquet, not {tables!r}")
    options = Options(**levels)
    if out is not None:
        check_target(out, MARK)

    def progress(step: Any) -> None:
        relative = "" if step.relative_step is None else f"  relative step {step.relative_step:.1e}"
        damping = f"  damping {step.damping:.0e}" if step.damping else ""
        taken = "" if step.accepted else "  rejected"
        typer.echo(f"iteration {step.count:>2}  v'Pv {step.objective:.10g}{relative}{damping}{taken}", err=True)

    result = adjust_network(network, **settings, progress=None if quiet else progress)
    if not quiet:
        typer.echo("testing and writing ...", err=True)
    analysis = analyse(result, options)
    if out is not None:
        write_folder(analysis, out, tables, {"seconds": round(time.perf_counter() - started, 3)})
    if as_json:
        typer.echo(json.dumps(result_json(analysis), indent=1, allow_nan=False, ensure_ascii=False))
        sys.stdout.flush()
    elif not quiet:
        for sentence in page.verdict(analysis):
            typer.echo(sentence)
    if out is not None and not quiet:
        typer.echo(f"report: {out / 'report.html'}", err=True)
    if not analysis.converged:
        steps = len(result.history) - 1
        typer.echo(f"baarda: not converged after {steps} iterations, nothing was tested; {result.contradictions()}", err=True)
        raise typer.Exit(3)
    if strict and any(analysis.gates.values()):
        failed = ", ".join(name for name, rejected in analysis.gates.items() if rejected)
        typer.echo(f"baarda: rejected: {failed}", err=True)
        raise typer.Exit(1)


def main() -> None:
    """Run the command line."""
    app()
