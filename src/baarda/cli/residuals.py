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

from baarda.cli.base import Alpha, Cluster, Json, Language, Out, Quiet, Seed, Strict, Tables, app, guarded
from baarda.cli.progress import left
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
    table: Annotated[
        str, typer.Argument(metavar="TABLE|LAKE", help="CSV, NPY or Parquet table of residuals; folder or address of partitioned Parquet.")
    ],
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
    cluster: Cluster = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", help="LAKE: processes; the results do not depend on it.", min=1, show_default="all cores")
    ] = None,
    tables: Tables = "csv",
    language: Language = "en",
    as_json: Json = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Study a plain table of residuals: moments, homogeneity, laws of errors (default folder: baarda-residuals)."""
    from baarda.formats.residual_lake import is_lake
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
    if is_lake(table):
        columns = (column, group, sigma, redundancy)
        outcome = study_lake(table, target, columns, options, {"tables": tables, "spoken": language}, (cluster, jobs), quiet, started)
    elif cluster is not None:
        raise UsageError("--cluster is for a folder or an address of partitioned Parquet: one table is studied on this machine")
    else:
        with reading(quiet) as progress:
            known = {"sigma": sigma, "redundancy": redundancy}
            outcome = run(table, target, column, group, options, **known, tables=tables, spoken=language, progress=progress)  # type: ignore[arg-type]
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


def study_lake(
    address: str,
    target: Path | None,
    columns: tuple[str | None, ...],
    options: Any,
    written: dict[str, str],
    who: tuple[str | None, int | None],
    quiet: bool,
    started: float,
) -> Any:
    """Study partitioned Parquet on as many workers as there are."""
    from baarda.executors import open_workers
    from baarda.report.lake_report import run_lake

    tell = None if quiet else lambda text: typer.echo(text, err=True)
    last, before = [started], [-1]  # before: files that an earlier run had read

    def progress(done: int, total: int, rows: int) -> None:
        now = time.perf_counter()
        if before[0] < 0:
            before[0] = done - 1
        if done == total or now - last[0] > 2.0:
            last[0] = now
            rest = left(now - begun, done - before[0], total - done)
            typer.echo(f"{done:>{len(str(total))}} of {total} files, {rows:.4g} rows, {now - started:.0f} s{rest}", err=True)
        if done == total:
            typer.echo("laws of errors, fitted and simulated; figures and tables ...", err=True)

    column, group, sigma, redundancy = columns
    cluster, jobs = who
    with open_workers(cluster, jobs, tell=tell) as workers:
        begun = time.perf_counter()
        return run_lake(
            address,
            target,
            column,
            group,
            options,
            sigma=sigma,
            redundancy=redundancy,
            **written,
            facts={"workers": workers.name},
            workers=workers,
            progress=None if quiet else progress,
            tell=tell,
        )
