"""What a result folder holds, and how it is written: whole or not at all, for every verb alike."""

from __future__ import annotations

import json
import math
import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import baarda
from baarda.errors import MissingExtra, UsageError
from baarda.formats.folder import Mark, whole_folder
from baarda.formats.project import write as write_project
from baarda.network import Network, Table

__all__ = ["Contents", "check_tables", "json_text", "plain", "software", "table_csv", "write"]

TABLE_FORMATS = ("csv", "parquet")
_SPECIAL = re.compile('[,"\r\n]')


@dataclass(frozen=True)
class Contents:
    """What a result folder holds.

    Attributes
    ----------
    document : mapping
        The result as JSON, see `plain`; its file is that of the mark.
    report : str
        The page `report.html`.
    figures : mapping of str to str
        SVG documents by file name without extension, for `figures/`.
    tables : mapping of str to Table
        By file name without extension, for `tables/`.
    facts : mapping
        What differs from run to run (timings), for `run.json`.
    files : mapping of str to bytes
        Any other file by name.
    network : Network, optional
        Written to `project/` in our own format.
    """

    document: Mapping[str, Any]
    report: str
    figures: Mapping[str, str] = field(default_factory=dict)
    tables: Mapping[str, Table] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    network: Network | None = None


def write(contents: Contents, out: str | Path, mark: Mark, table_format: str = "csv") -> Path:
    r"""Write a result folder.

    Parameters
    ----------
    contents : Contents
    out : str or Path
        The folder; there whole or not at all. An earlier folder there that bears the mark is replaced.
    mark : Mark
        Names the JSON file, and by it an earlier folder of the same kind is known.
    table_format : {"csv", "parquet"}

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    UsageError
        If the format of the tables is another one.
    MissingExtra
        If Parquet is asked for without the extra 'tables'.
    OutputError
        If it cannot be written; nothing is left behind.

    Examples
    --------
    >>> import tempfile
    >>> mark = Mark("result.json", "baarda.example/", ("result.json", "report.html", "run.json", "tables", "figures"))
    >>> made = Contents({"schema": "baarda.example/1"}, "<p>Done.", tables={"a": Table({"x": np.array([1.5, np.nan])})})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     out = write(made, Path(folder) / "out", mark)
    ...     sorted(p.name for p in out.iterdir()), (out / "tables" / "a.csv").read_text()
    (['figures', 'report.html', 'result.json', 'run.json', 'tables'], 'x\n1.5\n""\n')
    """
    check_tables(table_format)
    target = Path(out)
    with whole_folder(target, mark) as folder:
        for name in ("tables", "figures"):
            (folder / name).mkdir()
        _text(folder / mark.file, json_text(contents.document))
        _text(folder / "report.html", contents.report)
        _text(folder / "run.json", json_text(contents.facts))
        for name, svg in contents.figures.items():
            _text(folder / "figures" / f"{name}.svg", svg)
        for name, table in contents.tables.items():
            if table_format == "parquet":
                _parquet(table, folder / "tables" / f"{name}.parquet")
            else:
                _text(folder / "tables" / f"{name}.csv", table_csv(table))
        for name, content in contents.files.items():
            (folder / name).write_bytes(content)
        if contents.network is not None:
            write_project(contents.network, folder / "project")
    return target


def check_tables(table_format: str) -> None:
    """Refuse, before any work, a format in which tables cannot be written.

    Parameters
    ----------
    table_format : {"csv", "parquet"}

    Raises
    ------
    UsageError
        If it is another one.
    MissingExtra
        If it needs the extra 'tables', which is not installed.

    Examples
    --------
    >>> check_tables("csv")
    """
    if table_format not in TABLE_FORMATS:
        raise UsageError(f"--tables is csv or parquet, not {table_format!r}")
    if table_format == "parquet":
        _writer()


def plain(value: Any) -> Any:
    """Return a JSON-compatible value: NumPy numbers as Python ones, NaN and infinity as None.

    Parameters
    ----------
    value : object
        Numbers, texts, arrays, and lists, tuples and mappings of them.

    Returns
    -------
    object

    Examples
    --------
    >>> plain({"a": np.array([1.0, np.nan]), "n": np.int64(3)})
    {'a': [1.0, None], 'n': 3}
    """
    if isinstance(value, np.ndarray):
        return [plain(v) for v in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def json_text(document: Mapping[str, Any]) -> str:
    r"""Return a document as JSON text without NaN.

    Parameters
    ----------
    document : mapping

    Returns
    -------
    str
        Ends with a line feed.

    Examples
    --------
    >>> json_text({"a": float("inf")})
    '{\n "a": null\n}\n'
    """
    return json.dumps(plain(document), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def software() -> dict[str, str]:
    """Return name and versions of what computed a result.

    Returns
    -------
    dict of str

    Examples
    --------
    >>> list(software())
    ['name', 'version', 'python', 'numpy', 'scipy']
    """
    import scipy

    return {
        "name": "baarda",
        "version": baarda.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": str(scipy.__version__),
    }


def table_csv(table: Table) -> str:
    r"""Return a table as CSV; numbers read back exactly, not-a-number is empty.

    Parameters
    ----------
    table : Table

    Returns
    -------
    str

    Examples
    --------
    >>> table_csv(Table({"point": np.array(["a,b", "c"]), "X": np.array([0.1, np.nan])}))
    'point,X\n"a,b",0.1\nc,\n'
    """
    columns = [_cells(c) for c in table.columns.values()]
    head = ",".join(_quoted([str(name) for name in table.columns]))
    # A row that is one empty field would be an empty line, which readers skip.
    rows = [cell or '""' for cell in columns[0]] if len(columns) == 1 else map(",".join, zip(*columns, strict=True))
    return "\n".join([head, *rows]) + "\n"


def _cells(column: np.ndarray[Any, Any]) -> list[str]:
    """Return the fields of a column; no loop of Python runs over numbers, of which there are millions."""
    if column.dtype.kind == "f":
        finite = np.isfinite(column)
        cells = list(map(repr, column.tolist()))
        for i in np.flatnonzero(~finite).tolist():
            cells[i] = ""
        return cells
    return _quoted(list(map(str, column.tolist())))


def _quoted(cells: list[str]) -> list[str]:
    """Return texts as fields of a CSV file, RFC 4180."""
    if not _SPECIAL.search("\0".join(cells)):
        return cells
    return ['"' + cell.replace('"', '""') + '"' if _SPECIAL.search(cell) else cell for cell in cells]


def _text(path: Path, text: str) -> None:
    # A label may hold half of a surrogate pair, which no encoding takes.
    path.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


def _writer() -> Any:
    try:
        from pyarrow import parquet  # type: ignore[import-untyped, import-not-found, unused-ignore]
    except ImportError:
        raise MissingExtra("tables", "--tables parquet") from None
    return parquet


def _parquet(table: Table, path: Path) -> None:
    _writer().write_table(table.to_arrow(), path)
