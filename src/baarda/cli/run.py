"""Adjust, test, write the folder and print the verdict: what `demo` and `adjust` share."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer

from baarda.cli.base import one_blas_thread
from baarda.cli.progress import Counted, Iterations, first_answer, stage
from baarda.errors import OutputError, UsageError


@one_blas_thread
def adjust_and_report(
    network: Any,
    settings: dict[str, Any],
    levels: dict[str, Any],
    out: Path | None,
    tables: str,
    as_json: bool,
    quiet: bool,
    strict: bool,
    started: float,
    plan: dict[str, Any] | None = None,
    components: Any = None,
    covariance: Path | None = None,
    points: Path | None = None,
    audit: bool = False,
    spoken: str = "en",
    pdf: bool = False,
) -> None:
    """Adjust a network with the procedures of a plan, test it, write the folder, print verdict or JSON, leave with the exit code."""
    from baarda.adjustment import adjust as adjust_network
    from baarda.adjustment.solve import Settings
    from baarda.formats import covariance_file, geojson
    from baarda.formats.folder import check_target
    from baarda.hypotheses.levels import Options
    from baarda.procedures.strategy import Plan, carry_out
    from baarda.procedures.testing import analyse
    from baarda.report import page
    from baarda.report.pdf import check_pdf
    from baarda.report.result_folder import MARK, result_json, write_folder
    from baarda.report.translation import check_language, language

    if tables not in ("csv", "parquet"):
        raise UsageError(f"--tables is csv or parquet, not {tables!r}")
    check_language(spoken)
    if pdf:
        check_pdf()
        if out is None:
            raise UsageError("--pdf writes into the result folder: give --out")
    options = Options(**levels)
    if out is not None:
        check_target(out, MARK)
    if covariance is not None:
        check_target(covariance, covariance_file.MARK)
    if points is not None and points.exists():
        raise OutputError(f"{points} exists")

    progress = None if quiet else Iterations(started, Settings.tolerance, settings.get("robust") is not None)
    found = None
    if components is not None:
        from baarda.procedures.variance_components import estimate_components

        tell = None if quiet else lambda text: typer.echo(text, err=True)
        found, network = estimate_components(network, components, options, tell=tell, **settings)
        settings = {**settings, "image_sigma": None}
    strategy = audited = None
    chosen = Plan(**(plan or {}))
    if audit:
        from baarda.procedures.audit import audit as audit_network

        if not chosen.empty or components is not None:
            raise UsageError("--audit evaluates a solution as it stands: no procedure that changes the model goes with it")
        audited = audit_network(network, options, **settings, progress=progress)
        result = audited.adjustment
    elif chosen.empty:
        tell = None if quiet else lambda text: typer.echo(text, err=True)
        result = adjust_network(network, **settings, progress=progress, tell=tell)
    else:
        result, strategy = carry_out(network, chosen, options, None if quiet else lambda text: typer.echo(text, err=True), **settings)
    begins, shown = stage(quiet), out is not None or as_json or not quiet
    converged = result.status == "converged"
    if converged and not quiet:
        typer.echo(first_answer(result), err=True)
    if converged and shown:  # what the tests and the tables share, computed here so that each stage is told as it begins
        begins("redundancy numbers and precision")
        _ = result.evidence, result.point_cofactors
    if converged:
        begins("tests and their simulated null laws" if result.law is None else "tests")
    counted = None if quiet else Counted("data sets simulated")
    analysis = replace(analyse(result, options, counted), strategy=strategy, components=found, audit=audited)
    if converged and shown and result.law is None:
        begins("laws of errors, fitted and simulated")
        _ = analysis.study
    if converged and points is not None:
        geojson.write_points(result, points, options.sigma)
    if converged and covariance is not None:
        begins("covariances of the unknowns")
        covariance_file.write_covariance(result, covariance, sigma=options.sigma)
    if out is not None:
        begins("tables, figures and report")
        write_folder(analysis, out, tables, {"seconds": round(time.perf_counter() - started, 3)}, spoken, pdf)
    if as_json:
        typer.echo(json.dumps(result_json(analysis), indent=1, allow_nan=False, ensure_ascii=False))
        sys.stdout.flush()
    elif not quiet:
        with language(spoken):
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
