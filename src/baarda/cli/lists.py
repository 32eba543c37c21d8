"""`baarda warmup`, and the verbs that list the members."""

from __future__ import annotations

from typing import Any

import typer

from baarda.cli.base import app, guarded


@app.command()
@guarded
def warmup() -> None:
    """Compile the kernels once, so that later runs find them cached."""
    from baarda.adjustment.warmup import warm_up
    from baarda.distributions.kernels import compiled
    from baarda.procedures.synthetic import ring

    done = compiled() is not None and warm_up(ring(6, points=30).network)
    typer.echo("kernels are compiled" if done else "numba is not installed: the slower NumPy twins are used")


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
