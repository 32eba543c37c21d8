"""`baarda reproduce`."""

from __future__ import annotations

from typing import Annotated

import typer

from baarda.cli.base import Out, Quiet, app, guarded


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
