"""Plain columns of residuals that are too long for memory: recognised here, read as streams."""

from __future__ import annotations

from pathlib import Path

from baarda.errors import InputError, MissingExtra
from baarda.formats.npy_array import map_array
from baarda.formats.residual_table import GROUPS, HEADER_ERRORS, REDUNDANCY, RESIDUAL, SIGMA
from baarda.formats.value_stream import ValueStream, open_values

LONG = 5_000_000  # values from which on a plain column is read as a stream


def open_long(
    path: str | Path,
    column: str | None = None,
    group: str | None = None,
    sigma: str | None = None,
    redundancy: str | None = None,
    *,
    least: int = LONG,
) -> tuple[ValueStream, str] | None:
    """Open a table that is too long for memory, if it is one and nothing but a plain column of residuals is asked for.

    Parameters
    ----------
    path, column, group, sigma, redundancy
        As in `read`.
    least : int
        Number of values from which on a table is long.

    Returns
    -------
    stream : ValueStream
    column : str
        The name of its column.
        None (instead of both) for a table that `read` takes: a CSV, a short one, one with groups, sigmas or redundancy numbers, or one that
        is damaged, of which `read` says what is wrong.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> file = Path(tempfile.mkdtemp()) / "v.npy"
    >>> np.save(file, np.arange(5.0))
    >>> open_long(file) is None, open_long(file, least=5)[0].total
    (True, 5)
    """
    file = Path(path)
    try:
        with file.open("rb") as f:
            head = f.read(6)
        if group is not None or sigma is not None or redundancy is not None or not (head == b"\x93NUMPY" or head.startswith(b"PAR1")):
            return None
        if head.startswith(b"PAR1"):
            names = tuple(_parquet_names(file))
        else:
            data = map_array(file)
            if data.ndim != 1:
                return None
            names = tuple(data.dtype.names or ())
            if not names and column not in (None, "1"):
                return None
            column = column if names else None
        others = {*GROUPS, SIGMA, REDUNDANCY} - {column}
        if others & set(names):
            return None
        if column is None and RESIDUAL in names:
            column = RESIDUAL
        stream = open_values(file, column)
    except (InputError, *HEADER_ERRORS):
        return None
    return (stream, stream.column or "1") if stream.total >= least else None


def _parquet_names(file: Path) -> list[str]:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise MissingExtra("tables", "reading Parquet") from None
    try:
        return list(parquet.read_schema(file).names)
    except ArrowException as error:
        raise ValueError(str(error)) from None
