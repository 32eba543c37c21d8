"""`baarda split`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from baarda.cli.base import CameraList, Control, FormatName, Quiet, app, guarded


@app.command()
@guarded
def split(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of any known format.")],
    parts: Annotated[int, typer.Option("--parts", help="Number of parts, each for one worker at a time.")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write: a project per part and their index; there whole or not at all.")],
    format: FormatName = None,
    control: Control = None,
    camera: CameraList = "source",
    quiet: Quiet = False,
) -> None:
    """Split a large block into parts that `adjust` joins again (Helmert blocking), on one machine or a cluster."""
    from baarda.cli.adjust import camera_list
    from baarda.formats import read
    from baarda.procedures.partition_folder import check_parts, write_partition

    check_parts(parts)
    network = read(source, format=format, control=control)
    made = write_partition(network, parts, out, camera_list(camera, network))
    if not quiet:
        for p in made.parts:
            typer.echo(
                f"{p.folder}: {p.images} images, {p.points} points, {p.observations} observations, {len(p.border)} shared nodes", err=True
            )
        typer.echo(f"{len(made.border)} cameras and images stand in several parts; next: baarda adjust {out} [--cluster ADDRESS]", err=True)
