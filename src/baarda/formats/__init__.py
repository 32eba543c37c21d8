"""Reading and writing blocks: one file per format, recognised by content."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from baarda.discover import members
from baarda.errors import InputError, UsageError
from baarda.formats.base import FIRST_PIXEL, Format, regular_size, unreadable
from baarda.formats.folder import HEADS, is_result
from baarda.network import Network

__all__ = ["Format", "formats", "read", "recognise", "write"]

_LOOKED_AT = 50  # files of a folder that no format knows


def formats() -> dict[str, Format]:
    """Return all file formats by name."""
    return {f.name: f for f in members("baarda.formats", Format) if isinstance(f, Format)}


def recognise(path: Path) -> Format:
    """Return the format of a file or folder, judged by content.

    Raises
    ------
    InputError
        If the path does not exist, cannot be read, or no format or several know it.
    """
    try:
        _exists(path)
        if path.is_file() and path.stat().st_size == 0:
            raise InputError("the file is empty", path)
        found = [f for f in formats().values() if f.recognises(path)]
    except OSError as error:
        raise unreadable(error, path) from None
    if not found:
        held = _files_inside(path)
        inside = f"; of the files in it, give one: {', '.join(held)}" if held else ""
        raise InputError(f"no known format recognises it{inside}; known are {', '.join(formats())} (choose with --format)", path)
    if len(found) > 1:
        raise InputError(f"several formats recognise it ({', '.join(f.name for f in found)}); choose with --format", path)
    return found[0]


def _files_inside(path: Path) -> list[str]:
    """Return the first files of a folder that a format recognises, with its name."""
    if not path.is_dir():
        return []
    out = []
    for file in sorted(p for p in path.iterdir() if p.is_file() and not p.is_symlink())[:_LOOKED_AT]:
        with suppress(OSError):  # what cannot be read is no hint
            out += [f"{file.name} ({f.name})" for f in formats().values() if file.stat().st_size and f.recognises(file)][:1]
    return out[:3]


def _exists(path: Path) -> None:
    """Refuse what is neither a folder nor a regular file: opening a pipe or a device might never end."""
    if not path.exists():
        raise InputError("no such file or folder", path)
    if not path.is_dir():
        regular_size(path)


def read(
    path: str | Path,
    format: str | None = None,
    control: str | Path | None = None,
    crs: str | None = None,
    geoid: str | float | None = None,
    marks: str | Path | None = None,
) -> Network:
    """Read a network.

    Parameters
    ----------
    path : str or Path
        File or folder of any known format.
    format : str, optional
        Name of the format; by default it is recognised by content.
    control : str or Path, optional
        A table of control and check points that replaces what the source says of them, see `baarda.formats.control`, or a list of
        control points with their image marks, see `baarda.formats.odm_gcp`.
    crs : str, optional
        The coordinate system of that table (extra ``geo``): an EPSG code such as ``EPSG:25832``, WKT or a proj string. The block then
        stands in a local frame (east, north, up), see `baarda.formats.coordinate_system`.
    geoid : str or float, optional
        Geoid height in metres, or the file of a grid, where heights of that system are above a vertical datum.
    marks : str or Path, optional
        A table of image marks of control and check points, see `baarda.formats.marks_table`.

    Returns
    -------
    Network

    Raises
    ------
    InputError
        If a file cannot be used; the message names file and line.
    """
    where = Path(path)
    nameable(path)
    if (geoid is not None and crs is None) or (crs is not None and control is None):
        raise UsageError("a geoid belongs to a coordinate system (crs), and that to a table of control points")
    if format is None:
        chosen = recognise(where)
    elif format in formats():
        chosen = formats()[format]
    else:
        raise UsageError(f"unknown format {format!r}; known are {', '.join(formats())}")
    try:
        _exists(where)
        network = chosen.read(where)
    except OSError as error:
        raise unreadable(error, where) from None
    settings = network.settings if chosen.first_pixel is None else {**network.settings, FIRST_PIXEL: chosen.first_pixel}
    network = replace(network, path=str(path), format=chosen.name, sha256=digest(where), settings=settings)
    if marks is not None:
        from baarda.formats.marks_table import with_marks_table

        network = with_marks_table(network, marks)
    if control is not None:
        from baarda.formats.control import with_control
        from baarda.formats.odm_gcp import is_gcp_list, with_gcp_list

        listed = is_gcp_list(Path(control))
        if listed and crs is not None:
            raise UsageError(f"{control} names its coordinate system in its first line: --crs belongs to tables")
        if listed:
            return with_gcp_list(network, Path(control))
        if crs is None:
            return with_control(network, Path(control))
        from baarda.formats.coordinate_system import CoordinateSystem

        return with_control(network, Path(control), CoordinateSystem.of(crs, geoid))
    return network


def nameable(path: str | Path) -> None:
    """Refuse a name that is no text: results, tables and reports could not say where they come from.

    Raises
    ------
    UsageError
        If the name of a file or folder is not UTF-8.

    Examples
    --------
    >>> nameable("blocks/East 1")
    """
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError:
        raise UsageError(f"{path}: the name is not UTF-8, so that no result could tell it: rename the file or folder") from None


def digest(path: Path) -> str:
    """Return the sha256 of a file, or over the sorted relative names, sizes and contents of a folder.

    Result folders of ours within the folder do not count: they come from the source and would change its hash from run to run.

    Raises
    ------
    InputError
        If the path is neither a folder nor a regular file, or something cannot be read.
    """
    try:
        _exists(path)
        return _digest(path)
    except OSError as error:
        raise unreadable(error, path) from None


def _digest(path: Path) -> str:
    total = hashlib.sha256()
    if path.is_file():
        with path.open("rb") as f:
            return hashlib.file_digest(f, "sha256").hexdigest()
    files = [p for p in path.rglob("*") if p.is_file()]
    results = {p.parent for p in files if p.name in HEADS and p.parent != path and is_result(p.parent)}
    for file in sorted(files):
        if results and not results.isdisjoint(file.parents):
            continue
        name = file.relative_to(path).as_posix().encode("utf-8", "surrogateescape")
        total.update(len(name).to_bytes(8, "little") + name + file.stat().st_size.to_bytes(8, "little"))
        with file.open("rb") as f:
            while piece := f.read(1 << 20):
                total.update(piece)
    return total.hexdigest()


def write(network: Network, path: str | Path, format: str) -> None:
    """Write a network in a format that can be written.

    Raises
    ------
    UsageError
        If the format is unknown or cannot be written.
    """
    chosen = formats().get(format)
    if chosen is None or chosen.write is None:
        able = ", ".join(f.name for f in formats().values() if f.write is not None)
        raise UsageError(f"format {format!r} cannot be written; these can: {able}")
    chosen.write(network, Path(path))
