"""Long columns of numbers read in pieces, in constant memory: NPY files by memory maps, Parquet files by row groups.

Parquet needs the extra `tables` (pyarrow), which is imported when such a file is opened.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baarda.errors import InputError, MissingExtra, UsageError

_NPY_PIECE = 1 << 22
_PARQUET_PIECE = 1 << 18  # decoded and counted while still in the processor's cache
_PARQUET_MAGIC = b"PAR1"


@dataclass(frozen=True)
class ValueStream:
    """The numbers of one column of a file, read again each time they are iterated over.

    Attributes
    ----------
    file : Path
    total : int
        Number of values.
    column : str or None
        Name of the column; None for a plain array.
    piece : int
        Largest number of values in a piece.
    """

    file: Path
    total: int
    column: str | None
    piece: int

    def __len__(self) -> int:
        return self.total

    def __iter__(self) -> Iterator[np.ndarray]:
        raise NotImplementedError


def open_values(path: str | Path, column: str | None = None, *, piece: int | None = None) -> ValueStream:
    """Open a long column of numbers.

    Parameters
    ----------
    path : str or Path
        NPY file (an array of any shape, read in the order in which it is stored, or a structured array) or Parquet file.
    column : str, optional
        Name of the column of a structured array or a Parquet file; not needed where there is only one column of numbers.
    piece : int, optional
        Largest number of values to hold at a time.

    Returns
    -------
    ValueStream
        Iterable of (n,) arrays; `total` says how many values there are.

    Raises
    ------
    InputError
        If the file is neither, is damaged, lacks the column, or the column does not hold real numbers.
    MissingExtra
        If a Parquet file is given and pyarrow is not installed.
    UsageError
        If `piece` is not positive.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "v.npy"
    >>> np.save(file, np.arange(5.0))
    >>> stream = open_values(file, piece=2)
    >>> stream.total, [part.tolist() for part in stream]
    (5, [[0.0, 1.0], [2.0, 3.0], [4.0]])
    """
    file = Path(path)
    if piece is not None and piece < 1:
        raise UsageError(f"piece = {piece} is not a positive number")
    try:
        with file.open("rb") as f:
            magic = f.read(6)
    except OSError as error:
        raise InputError(error.strerror or "cannot be read", file) from None
    if magic == b"\x93NUMPY":
        return _open_npy(file, column, piece or _NPY_PIECE)
    if magic[:4] == _PARQUET_MAGIC:
        return _open_parquet(file, column, piece or _PARQUET_PIECE)
    raise InputError("neither an NPY nor a Parquet file", file)


# ---- NPY ------------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Npy(ValueStream):
    dtype: np.dtype[Any]
    offset: int

    def __iter__(self) -> Iterator[np.ndarray]:
        for start in range(0, self.total, self.piece):
            # one map a piece, so that pages already read do not stay with the process
            window = np.memmap(
                self.file,
                self.dtype,
                "r",
                offset=self.offset + start * self.dtype.itemsize,
                shape=(min(self.piece, self.total - start),),
            )
            yield window if self.column is None else window[self.column]


def _open_npy(file: Path, column: str | None, piece: int) -> _Npy:
    try:
        with file.open("rb") as f:
            version = np.lib.format.read_magic(f)
            read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read_header(f)
            offset = f.tell()
    except ValueError as error:
        raise InputError(f"damaged NPY header: {error}", file) from None
    if any(type(n) is not int or n < 0 for n in shape):
        raise InputError(f"damaged NPY header: {shape} is not the shape of an array", file)
    total = int(np.prod(shape, dtype=np.int64))
    if file.stat().st_size < offset + total * dtype.itemsize:
        raise InputError(f"the file ends before its {total} values", file)
    kind = dtype
    if dtype.names:
        column = _choose(column, [name for name in dtype.names if _is_real(dtype[name])], list(dtype.names), file)
        kind = dtype[column]
    elif column is not None:
        raise InputError(f"a plain array has no column {column!r}", file)
    if not _is_real(kind):
        raise InputError(f"values of type {kind} are not real numbers", file)
    return _Npy(file, total, column, piece, dtype, offset)


def _is_real(dtype: np.dtype[Any]) -> bool:
    return dtype.kind in "fiu"


def _choose(column: str | None, numeric: list[str], names: list[str], file: Path) -> str:
    if column is None:
        if len(numeric) == 1:
            return numeric[0]
        raise InputError(f"choose a column; columns of numbers are {', '.join(numeric) or 'none'}", file)
    if column not in names:
        raise InputError(f"there is no column {column!r}; there are {', '.join(names)}", file)
    if column not in numeric:
        raise InputError(f"column {column!r} does not hold real numbers", file)
    return column


# ---- Parquet --------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ParquetStream(ValueStream):
    """A column of a Parquet file."""

    def __iter__(self) -> Iterator[np.ndarray]:
        source = _parquet(self.file)
        try:
            batches = source.iter_batches(batch_size=self.piece, columns=[self.column], use_threads=False)
            done = 0
            with ThreadPoolExecutor(1) as ahead:  # decodes the next piece while the caller works on this one
                waiting = ahead.submit(next, batches, None)
                while (batch := waiting.result()) is not None:
                    waiting = ahead.submit(next, batches, None)
                    values = batch.column(0)
                    if values.null_count:
                        row = done + int(np.flatnonzero(values.is_null().to_numpy(zero_copy_only=False))[0]) + 1
                        raise InputError(f"column {self.column!r} has no value in row {row}", self.file)
                    done += len(values)
                    yield values.to_numpy(zero_copy_only=False)
        except OSError as error:
            raise InputError(f"damaged Parquet file: {error}", self.file) from None
        finally:
            source.close()


def _parquet(file: Path) -> Any:
    try:
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise MissingExtra("tables", "reading Parquet files") from None
    arrow: Any = importlib.import_module("pyarrow")
    try:
        # a buffer keeps large row groups out of memory: they are decoded page by page
        return parquet.ParquetFile(file, buffer_size=1 << 22, pre_buffer=False)
    except (arrow.ArrowInvalid, OSError) as error:
        raise InputError(f"damaged Parquet file: {error}", file) from None


def _open_parquet(file: Path, column: str | None, piece: int) -> ParquetStream:
    source = _parquet(file)
    types: Any = importlib.import_module("pyarrow").types
    try:
        schema = source.schema_arrow
        numeric = [field.name for field in schema if types.is_floating(field.type) or types.is_integer(field.type)]
        chosen = _choose(column, numeric, list(schema.names), file)
        return ParquetStream(file, int(source.metadata.num_rows), chosen, piece)
    finally:
        source.close()
