"""`baarda residuals`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from baarda.cli.base import Alpha, Json, Out, Quiet, Seed, Strict, Tables, app, guarded
from baarda.errors import UsageError

if TYPE_CHECKING:
    from rich.progress import TaskID


@contextmanager
def reading(quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Show on a terminal how far a long column has been read; a line for each tenth of it elsewhere."""
    if quiet:
        yield None
        return
    if not sys.stderr.isatty():
        tenths = [0]

        def tell(done: int, total: int) -> None:
            if 10 * done // total > tenths[0]:
                tenths[0] = 10 * done // total
                typer.echo(f"read {done:.3g} of {total:.3g} values", err=True)

        yield tell
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("reading"), BarColumn(), MofNCompleteColumn(), TextColumn("values"), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks: list[TaskID] = []

        def show(done: int, total: int) -> None:
            if not tasks:
                tasks.append(bar.add_task("reading", total=total))
            bar.update(tasks[0], completed=done)

        yield show


def class_limits(text: str) -> tuple[float, ...]:
    """Return the class limits in a list of numbers.

    Raises
    ------
    UsageError
        If they are no numbers.

    Examples
    --------
    >>> class_limits("-1, 0, 2.5")
    (-1.0, 0.0, 2.5)
    """
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--classes is equal_probability, equal_width or a list of numbers, not {text!r}") from None


@app.command()
@guarded
def residuals(
    table: Annotated[Path, typer.Argument(metavar="TABLE", help="CSV, NPY or Parquet table of residuals.")],
    out: Out = None,
    column: Annotated[
        str | None, typer.Option("--column", help="Column of the residuals.", show_default="residual, else the only one of numbers")
    ] = None,
    group: Annotated[str | None, typer.Option("--group", help="Column of the groups.", show_default="image, else group, if there")] = None,
    sigma: Annotated[str | None, typer.Option("--sigma-column", help="Column of a-priori sigmas.", show_default="sigma, if there")] = None,
    redundancy: Annotated[
        str | None, typer.Option("--redundancy-column", help="Column of redundancy numbers.", show_default="redundancy, if there")
    ] = None,
    classes: Annotated[
        str, typer.Option("--classes", help="equal_probability, equal_width, or class limits such as -20,-10,0,10,20.")
    ] = "equal_probability",
    ends: Annotated[str, typer.Option("--ends", help="End classes: open, or closed (these must cover all values).")] = "open",
    mean: Annotated[float | None, typer.Option("--mean", help="Known expectation, usually 0.", show_default="estimated")] = None,
    replicas: Annotated[int, typer.Option("--replicas", help="Simulated samples of each null law.")] = 999,
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
    limits: Any = classes if classes in ("equal_probability", "equal_width") else class_limits(classes)
    options = StudyOptions(
        alpha=alpha, seed=seed, classes=limits, ends=cast(Any, ends), merge=5.0 if ends == "open" else None, loc=mean, replicas=replicas
    )
    target = None if as_json and out is None else out or Path("baarda-residuals")
    if not quiet:
        typer.echo("studying ...", err=True)
    with reading(quiet) as progress:
        outcome = run(table, target, column, group, options, sigma=sigma, redundancy=redundancy, tables=tables, progress=progress)
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
