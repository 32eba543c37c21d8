"""`baarda convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from baarda.cli.base import Control, Crs, FormatName, GeoidHeight, MarksFile, app, guarded


@app.command()
@guarded
def convert(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of any known format.")],
    to: Annotated[str, typer.Option("--to", help="Format to write.")],
    out: Annotated[Path, typer.Option("--out", help="File or folder to write; must not exist.")],
    format: FormatName = None,
    control: Control = None,
    marks: MarksFile = None,
    crs: Crs = None,
    geoid: GeoidHeight = None,
) -> None:
    """Read one format, write another."""
    from baarda.errors import OutputError
    from baarda.formats import read, write

    network = read(source, format=format, control=control, marks=marks, crs=crs, geoid=geoid)
    if out.exists():
        raise OutputError(f"{out} exists")
    write(network, out, to)
