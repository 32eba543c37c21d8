"""Residuals in partitioned Parquet: a local folder, or an address that fsspec knows; each file is read in pieces, in constant memory.

Parquet needs the extra `tables`, addresses such as ``s3://bucket/lake`` the extra `cluster` and fsspec's package for that store.
"""

from __future__ import annotations

import hashlib
import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError, MissingExtra
from baarda.formats.residual_table import _choose, _label

__all__ = ["Lake", "Piece", "footer_sha256", "is_lake", "open_lake", "read_pieces"]

Floats = NDArray[np.float64]
PIECE = 1 << 19  # rows that are held at a time
_MAGIC = b"PAR1"
_ROUNDING = 1e-9
_LARGEST_FOOTER = 1 << 30


@dataclass(frozen=True)
class Lake:
    """Files of residuals with the same columns.

    Attributes
    ----------
    address : str
        As typed.
    root : str
        Where it is found from anywhere: an absolute path, or the address.
    files : tuple of str
        Names below the root, sorted; those that begin with a point or an underscore are none.
    sizes : tuple of int
        Bytes of each.
    column : str
        The residuals.
    group, sigma, redundancy : str or None
        The other columns; the group may also be a folder's ``name=value``.
    """

    address: str
    root: str
    files: tuple[str, ...]
    sizes: tuple[int, ...]
    column: str
    group: str | None = None
    sigma: str | None = None
    redundancy: str | None = None

    @property
    def remote(self) -> bool:
        """Whether fsspec reads it."""
        return "://" in self.root

    def named(self, index: int) -> str:
        """Return a file as messages call it."""
        return f"{self.address.rstrip('/')}/{self.files[index]}"


@dataclass(frozen=True)
class Piece:
    """Consecutive rows of a file.

    Attributes
    ----------
    residuals : (n,) array
    sigmas, redundancy : (n,) array or None
    codes : (n,) integer array or None
        Into `names`.
    names : tuple of str
        Groups of this piece.
    """

    residuals: Floats
    sigmas: Floats | None
    redundancy: Floats | None
    codes: NDArray[np.intp] | None
    names: tuple[str, ...]


def is_lake(path: str | Path) -> bool:
    """Return whether a path is a folder, or an address that only fsspec can read.

    Examples
    --------
    >>> is_lake("s3://bucket/lake"), is_lake("residuals.csv")
    (True, False)
    """
    return "://" in str(path) or Path(path).is_dir()


def open_lake(
    address: str | Path, column: str | None = None, group: str | None = None, sigma: str | None = None, redundancy: str | None = None
) -> Lake:
    """List the files of a lake and choose the columns by the first.

    Parameters
    ----------
    address : str or Path
        Folder, or fsspec address; all files below it that end in ``.parquet`` or ``.parq`` belong to it.
    column, group, sigma, redundancy : str, optional
        Columns; defaults as in `baarda.formats.residual_table.read`.

    Returns
    -------
    Lake

    Raises
    ------
    InputError
        If there is no such file, or the first lacks a column.
    MissingExtra
        If pyarrow, or for an address fsspec, is not installed.

    Examples
    --------
    >>> import tempfile, pyarrow
    >>> from pyarrow import parquet
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("a", "b"):
    ...         parquet.write_table(pyarrow.table({"residual": [0.5, -0.5], "image": ["1", "2"]}), f"{folder}/{name}.parquet")
    ...     lake = open_lake(folder)
    >>> lake.files, lake.column, lake.group
    (('a.parquet', 'b.parquet'), 'residual', 'image')
    """
    shown = str(address)
    root = shown if "://" in shown else str(Path(address).absolute())
    found = sorted(_remote_files(root) if "://" in root else _local_files(Path(root)))
    found = [(n, s) for n, s in found if n.endswith((".parquet", ".parq")) and not any(p[0] in "._" for p in n.split("/"))]
    if not found:
        raise InputError("no Parquet file lies below it", shown)
    files, sizes = zip(*found, strict=True)
    bare = Lake(shown, root, files, sizes, "")
    with _opened(bare, 0) as source:
        schema = source.schema_arrow
        names = [*schema.names, *(k for k in _partition(files[0]) if k not in schema.names)]
        numeric = [f.name for f in schema if _is_number(f.type)]
        choice = _choose(names, numeric, (column, group, sigma, redundancy), lambda message: InputError(message, bare.named(0)))
    return Lake(shown, root, files, sizes, choice.column, choice.group, choice.sigma, choice.redundancy)


def _local_files(root: Path) -> list[tuple[str, int]]:
    try:
        return [(p.relative_to(root).as_posix(), p.stat().st_size) for p in root.rglob("*") if p.is_file()]
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", root) from None


def _remote_files(root: str) -> list[tuple[str, int]]:
    system, base = _system(root)
    try:
        found = system.find(base, detail=True)
    except OSError as error:
        raise InputError(f"cannot be read: {error}", root) from None
    return [(name[len(base) :].lstrip("/"), int(entry["size"])) for name, entry in found.items()]


def _system(root: str) -> tuple[Any, str]:
    try:
        core: Any = importlib.import_module("fsspec.core")
    except ImportError:
        raise MissingExtra("cluster", f"reading {root}") from None
    try:
        system, base = core.url_to_fs(root)
    except (ValueError, ImportError) as error:
        raise InputError(f"no such kind of store, or its package is missing: {error}", root) from None
    return system, base


@contextmanager
def _bytes(lake: Lake, index: int) -> Iterator[IO[bytes]]:
    name = lake.named(index)
    try:
        if lake.remote:
            system, base = _system(lake.root)
            opened = system.open(f"{base.rstrip('/')}/{lake.files[index]}", "rb")
        else:
            opened = (Path(lake.root) / lake.files[index]).open("rb")
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", name) from None
    with opened as file:
        yield file


@contextmanager
def _opened(lake: Lake, index: int) -> Iterator[Any]:
    """Yield a file as Parquet; all that is wrong with it becomes an InputError that names it."""
    try:
        arrow: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise MissingExtra("tables", "reading Parquet files") from None
    with _bytes(lake, index) as file:
        try:
            # a buffer keeps large row groups out of memory: they are decoded page by page
            with parquet.ParquetFile(file, buffer_size=1 << 22, pre_buffer=False, page_checksum_verification=True) as source:
                yield source
        except (arrow.ArrowException, OSError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"damaged Parquet file: {reason}", lake.named(index)) from None


def footer_sha256(lake: Lake, index: int) -> str:
    """Return a hash of the size and the footer of a file: schema, row groups, and extremes of all columns.

    Parameters
    ----------
    lake : Lake
    index : int
        Number of the file.

    Returns
    -------
    str

    Raises
    ------
    InputError
        If the file is not Parquet.
    """
    with _bytes(lake, index) as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - 8))
        tail = file.read(8)
        length = int.from_bytes(tail[:4], "little")
        if size < 12 or tail[4:] != _MAGIC or not 0 < length <= min(size - 12, _LARGEST_FOOTER):
            raise InputError("damaged Parquet file: it has no footer (was it written to its end?)", lake.named(index))
        file.seek(size - 8 - length)
        return hashlib.sha256(size.to_bytes(8, "little") + file.read(length)).hexdigest()


def _partition(name: str) -> dict[str, str]:
    """Return the ``key=value`` folders of a name."""
    return {k: unquote(v) for k, s, v in (part.partition("=") for part in name.split("/")[:-1]) if s}


def _is_number(kind: Any) -> bool:
    types: Any = importlib.import_module("pyarrow.types")
    return bool(types.is_floating(kind) or types.is_integer(kind))


def read_pieces(lake: Lake, index: int, piece: int = PIECE) -> Iterator[Piece]:
    """Read a file of a lake in pieces.

    Parameters
    ----------
    lake : Lake
    index : int
        Number of the file.
    piece : int
        Largest number of rows to hold at a time.

    Yields
    ------
    Piece

    Raises
    ------
    InputError
        If the file is damaged, lacks a column, or holds what is no finite number, a sigma that is not positive, or a redundancy number
        outside [0, 1]; the message names file and row.
    """
    name, folders = lake.named(index), _partition(lake.files[index])
    with _opened(lake, index) as source:
        schema = source.schema_arrow
        group = lake.group if lake.group is None or lake.group in schema.names else None
        label = folders.get(lake.group) if lake.group is not None and group is None else None
        if lake.group is not None and group is None and label is None:
            raise InputError(f"column {lake.group!r} is missing", name)
        numeric = [n for n in dict.fromkeys((lake.column, lake.sigma, lake.redundancy)) if n is not None]
        for wanted in numeric:
            if wanted not in schema.names:
                raise InputError(f"column {wanted!r} is missing", name)
            if not _is_number(schema.field(wanted).type):
                raise InputError(f"column {wanted!r} holds {schema.field(wanted).type}, not real numbers", name)
        columns = [*numeric, *([group] if group is not None and group not in numeric else [])]
        done = 0
        for batch in source.iter_batches(batch_size=piece, columns=columns, use_threads=False):
            numbers = {n: _numbers(batch.column(columns.index(n)), n, name, done) for n in numeric}
            codes: NDArray[np.intp] | None = None if label is None else np.zeros(batch.num_rows, dtype=np.intp)
            names: tuple[str, ...] = () if label is None else (label,)
            if group is not None:
                codes, names = _coded(batch.column(columns.index(group)))
            sigmas = None if lake.sigma is None else numbers[lake.sigma]
            redundancy = None if lake.redundancy is None else numbers[lake.redundancy]
            if sigmas is not None:
                _refuse(sigmas, sigmas <= 0.0, lake.sigma, "must be positive", name, done)
            if redundancy is not None:
                wrong = (redundancy < -_ROUNDING) | (redundancy > 1.0 + _ROUNDING)
                _refuse(redundancy, wrong, lake.redundancy, "must lie between 0 and 1", name, done)
            yield Piece(numbers[lake.column], sigmas, redundancy, codes, names)
            done += batch.num_rows


def _numbers(column: Any, what: str, file: str, before: int) -> Floats:
    if column.null_count:
        row = before + int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0]) + 1
        raise InputError(f"row {row}: {what} is missing", file)
    x = np.asarray(column.to_numpy(zero_copy_only=False), dtype=float)
    if not math.isfinite(float(x.sum())):  # quick; a sum may also overflow
        _refuse(x, ~np.isfinite(x), what, "is not a finite number", file, before)
    return x


def _refuse(x: Floats, wrong: NDArray[np.bool_], what: str | None, why: str, file: str, before: int) -> None:
    bad = np.flatnonzero(wrong)
    if len(bad):
        raise InputError(f"row {before + bad[0] + 1}: {what} {why}: {x[bad[0]]:g}", file)


def _coded(column: Any) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Return codes and names; what is missing is a group of its own."""
    arrow: Any = importlib.import_module("pyarrow")
    coded = column if isinstance(column, arrow.DictionaryArray) else column.dictionary_encode(null_encoding="encode")
    codes = coded.indices
    names = ["" if v is None else _label(v) for v in coded.dictionary.to_pylist()]
    if codes.null_count:
        codes, names = codes.fill_null(len(names)), [*names, ""]
    return np.asarray(codes.to_numpy(zero_copy_only=False), dtype=np.intp), tuple(names)
