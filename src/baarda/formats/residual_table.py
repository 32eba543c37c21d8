"""Tables of residuals: one numeric column, perhaps with groups, sigmas and redundancy numbers, from CSV, NPY or Parquet.

The format is recognised by content. Files come from strangers: a CSV is read row by row and only the columns in use are kept, an NPY is
mapped and never unpickled, and every complaint names file and line (for NPY and Parquet the number of the value).
"""

from __future__ import annotations

import csv
import math
import tokenize
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError, MissingExtra
from baarda.formats.base import LARGEST, regular_size
from baarda.formats.npy_array import map_array

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

RESIDUAL, SIGMA, REDUNDANCY = "residual", "sigma", "redundancy"
GROUPS = ("image", "group")  # the table of observations that `adjust` writes has both, and its group is the kind of observation
LEAST = 3
_LONGEST_LINE = 1 << 20
_MOST_GROUPS = 1_000_000
_ROUNDING = 1e-9


@dataclass(frozen=True)
class ResidualTable:
    """A column of residuals with what the table says of them.

    Attributes
    ----------
    path : str
        As given.
    format : {"csv", "npy", "parquet"}
    column : str
        Name of the column of residuals; columns without names are numbered from 1.
    values : (n,) array
        Finite, not all equal, n at least 3.
    group : str or None
        Name of the column of groups.
    groups : (n,) integer array or None
        Codes into `group_names`.
    group_names : tuple of str
        In the order of their first appearance.
    sigma, redundancy : str or None
        Names of the columns.
    sigmas : (n,) array or None
        Positive.
    redundancy_numbers : (n,) array or None
        Between 0 and 1.
    assumptions : tuple of str
        What was taken for granted.
    """

    path: str
    format: Literal["csv", "npy", "parquet"]
    column: str
    values: Floats
    group: str | None = None
    groups: Ints | None = None
    group_names: tuple[str, ...] = ()
    sigma: str | None = None
    sigmas: Floats | None = None
    redundancy: str | None = None
    redundancy_numbers: Floats | None = None
    assumptions: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Choice:
    """The columns that are used: their names, as found in the table."""

    column: str
    group: str | None
    sigma: str | None
    redundancy: str | None

    @property
    def numeric(self) -> tuple[str, ...]:
        """The numeric columns in use."""
        return tuple(dict.fromkeys(n for n in (self.column, self.sigma, self.redundancy) if n is not None))


@dataclass(frozen=True)
class _Raw:
    """What a format yields: numbers by column (NaN = missing), groups, the place of a row in words or as a line."""

    numbers: dict[str, Floats]
    groups: Ints | None
    names: tuple[str, ...]
    error: Callable[[int, str], InputError]


def read(
    path: str | Path,
    column: str | None = None,
    group: str | None = None,
    sigma: str | None = None,
    redundancy: str | None = None,
) -> ResidualTable:
    r"""Read a table of residuals.

    Parameters
    ----------
    path : str or Path
        CSV (comma, semicolon or tab; UTF-8), NPY (1-D, 2-D or structured) or Parquet.
    column : str, optional
        The residuals; default ``residual``, or the only numeric column.
    group : str, optional
        The groups; default ``image``, else ``group``, where present.
    sigma, redundancy : str, optional
        Sigmas and redundancy numbers; default the columns of these names where present.

    Returns
    -------
    ResidualTable

    Raises
    ------
    InputError
        If the file cannot be read as a table, a column is missing or holds what is no finite number, all residuals are equal, fewer than
        three, a sigma is not positive, or a redundancy number is outside [0, 1].
    MissingExtra
        If the table is Parquet and the extra 'tables' is not installed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "v.csv"
    ...     _ = file.write_text("image,residual\na,0.3\na,-0.1\nb,-0.2\n")
    ...     table = read(file)
    >>> table.column, table.values.tolist(), table.group, table.group_names
    ('residual', [0.3, -0.1, -0.2], 'image', ('a', 'b'))
    """
    file = Path(path)
    wanted = (column, group, sigma, redundancy)
    reader, name = _recognised(file)
    assumptions: list[str] = []
    choice, raw = reader(file, wanted, assumptions)
    _check(raw, choice, file)
    return ResidualTable(
        str(path),
        name,
        choice.column,
        raw.numbers[choice.column],
        choice.group,
        raw.groups,
        raw.names,
        choice.sigma,
        None if choice.sigma is None else raw.numbers[choice.sigma],
        choice.redundancy,
        None if choice.redundancy is None else raw.numbers[choice.redundancy],
        tuple(assumptions),
    )


_Wanted = tuple[str | None, str | None, str | None, str | None]
_Reader = Callable[[Path, _Wanted, list[str]], tuple[_Choice, _Raw]]


def _recognised(file: Path) -> tuple[_Reader, Literal["csv", "npy", "parquet"]]:
    try:
        if file.is_dir():
            raise InputError("is a folder, not a table", file)
        size = regular_size(file)
        with file.open("rb") as f:
            head = f.read(8)
    except FileNotFoundError:
        raise InputError("no such file", file) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file) from None
    except ValueError:
        raise InputError("no such file", file) from None
    if size > LARGEST:
        raise InputError(f"the file has {size} bytes; the limit is {LARGEST}", file)
    if size == 0:
        raise InputError("the file is empty", file)
    if head.startswith(b"\x93NUMPY"):
        return _read_npy, "npy"
    if head.startswith(b"PAR1"):
        return _read_parquet, "parquet"
    if head.startswith(b"PK\x03\x04"):
        raise InputError("is a ZIP archive (NPZ, XLSX): save one array as NPY or the table as CSV", file)
    return _read_csv, "csv"


def _choose(names: Sequence[str], numeric: Sequence[str], wanted: _Wanted, complain: Callable[[str], InputError]) -> _Choice:
    """Choose the columns; `numeric` are those that look like numbers."""

    def one(name: str | None, defaults: Sequence[str]) -> str | None:
        if name is not None:
            if name not in names:
                raise complain(f"column {name!r} is missing; there are: {_list(names)}")
            return name
        return next((d for d in defaults if d in names), None)

    column, group, sigma, redundancy = wanted
    chosen = one(column, (RESIDUAL,))
    others = tuple(
        one(w, [d for d in defaults if d != chosen]) for w, defaults in ((group, GROUPS), (sigma, (SIGMA,)), (redundancy, (REDUNDANCY,)))
    )
    if chosen is None:
        free = [n for n in numeric if n not in others]
        if not free:
            raise complain(f"there is no column of numbers; the columns are: {_list(names)}")
        if len(free) > 1:
            raise complain(f"there is no column {RESIDUAL!r} and several of numbers: choose one of {_list(free)} with --column")
        chosen = free[0]
    return _Choice(chosen, *others)


def _list(names: Sequence[str]) -> str:
    return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")


def _check(raw: _Raw, choice: _Choice, file: Path) -> None:
    for name in choice.numeric:
        x = raw.numbers[name]
        bad = np.flatnonzero(~np.isfinite(x))
        if len(bad):
            i = int(bad[0])
            more = f" ({len(bad)} such values)" if len(bad) > 1 else ""
            raise raw.error(i, f"{name} is not a finite number: {x[i]}{more}")
    v = raw.numbers[choice.column]
    if len(v) < LEAST:
        raise InputError(f"column {choice.column!r} has {len(v)} value{'' if len(v) == 1 else 's'}; at least {LEAST} are needed", file)
    if v.min() == v.max():
        raise InputError(f"all {len(v)} values of column {choice.column!r} are equal ({v[0]:g}): nothing can be tested", file)
    if choice.sigma is not None:
        _refuse(raw, choice.sigma, raw.numbers[choice.sigma] <= 0.0, "must be positive")
    if choice.redundancy is not None:
        r = raw.numbers[choice.redundancy]
        _refuse(raw, choice.redundancy, (r < -_ROUNDING) | (r > 1.0 + _ROUNDING), "must lie between 0 and 1")


def _refuse(raw: _Raw, name: str, wrong: NDArray[np.bool_], why: str) -> None:
    bad = np.flatnonzero(wrong)
    if len(bad):
        raise raw.error(int(bad[0]), f"{name} {why}: {raw.numbers[name][bad[0]]:g}")


# ---- CSV ----------------------------------------------------------------------------------------------------------------------------


def _lines(file: Path) -> Iterator[str]:
    """Yield the lines of a file as text."""
    number = 0
    with file.open("rb") as f:
        while data := f.readline(_LONGEST_LINE + 1):
            number += 1
            if len(data) > _LONGEST_LINE:
                raise InputError(f"the line is longer than {_LONGEST_LINE} bytes", file, number)
            try:
                yield data.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError:
                raise InputError("the file is not UTF-8 text", file, number) from None


def _number(text: str) -> float | None:
    """Return a number (NaN and infinities too), None for what is none; float() would also take 1_000."""
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def _separator(line: str) -> str:
    """Return the separator that stands most often in a line."""
    return max(",;\t", key=line.count)


def _read_csv(file: Path, wanted: _Wanted, assumptions: list[str]) -> tuple[_Choice, _Raw]:
    source = _lines(file)
    skipped, first = 0, ""
    for first in source:  # comments and blank lines before the header
        if first.strip() and not first.lstrip().startswith("#"):
            break
        skipped += 1
    else:
        raise InputError("the table has no rows", file)

    def whole() -> Iterator[str]:
        yield first
        yield from source

    separator = _separator(first)
    reader = csv.reader(whole(), strict=True, skipinitialspace=True, delimiter=separator)
    good = skipped
    try:
        header = [name.strip() for name in next(reader)]
        rows: list[tuple[int, list[str]]] = []
        if all(_number(t) is not None for t in header):
            assumptions.append("The table has no header row: its columns are numbered from 1.")
            rows.append((skipped + 1, header))
            header = [str(i + 1) for i in range(len(header))]
        good = skipped + reader.line_num
        if len(set(header)) < len(header):
            double = next(n for i, n in enumerate(header) if n in header[:i])
            raise InputError(f"column {double!r} appears twice", file, skipped + 1)
        if not rows:
            row = next((r for r in reader if r), None)
            if row is None:
                raise InputError("the table has a header but no rows", file, good)
            rows.append((good + 1, row))
            _same_width(row, header, file, good + 1)
            good = skipped + reader.line_num
        numeric = [n for n, t in zip(header, rows[0][1], strict=True) if _number(t.strip()) is not None]
        choice = _choose(header, numeric, wanted, lambda message: InputError(message, file, skipped + 1))
        return choice, _collect(file, reader, header, choice, rows, skipped, separator)
    except csv.Error as error:
        raise InputError(f"not a CSV table: {error} (a row that begins here or later)", file, good + 1) from None


def _same_width(row: list[str], header: list[str], file: Path, line: int) -> None:
    if len(row) != len(header):
        raise InputError(f"the row has {len(row)} field{'' if len(row) == 1 else 's'}, the header {len(header)}", file, line)


def _collect(
    file: Path, reader: Any, header: list[str], choice: _Choice, rows: list[tuple[int, list[str]]], skipped: int, separator: str
) -> _Raw:
    """Read the rows, keeping only the numbers and codes in use and the lines where rows begin."""
    width = len(header)
    columns = [(header.index(name), name, array("d")) for name in choice.numeric]
    at = None if choice.group is None else header.index(choice.group)
    codes, index, begins = array("q"), dict[str, int](), array("q")

    def take(row: list[str], begin: int) -> None:
        if len(row) != width:
            _same_width(row, header, file, begin)
        for i, name, values in columns:
            text = row[i]
            try:
                value = float(text)
            except ValueError:
                raise _no_number(name, text, file, begin, separator) from None
            if "_" in text:
                raise _no_number(name, text, file, begin, separator)
            values.append(value)
        if at is not None:
            codes.append(index.setdefault(row[at].strip(), len(index)))
        begins.append(begin)

    for line, row in rows:
        take(row, line)
    begin = skipped + reader.line_num + 1
    for row in reader:
        if row:
            take(row, begin)
        begin = skipped + reader.line_num + 1
    if len(index) > _MOST_GROUPS:
        raise InputError(f"column {choice.group!r} has {len(index)} groups; the limit is {_MOST_GROUPS}", file)
    return _Raw(
        {name: np.array(values, dtype=float) for _, name, values in columns},
        None if at is None else np.array(codes, dtype=np.intp),
        tuple(index),
        lambda row, message: InputError(message, file, begins[row]),
    )


def _no_number(name: str, text: str, file: Path, line: int, separator: str) -> InputError:
    if not text.strip():
        return InputError(f"{name} is missing", file, line)
    comma = separator != "," and _number(text.strip().replace(",", ".", 1)) is not None
    hint = "; write decimals with a point" if comma else ""
    return InputError(f"{name} is not a number: {text.strip()[:80]!r}{hint}", file, line)


# ---- NPY ----------------------------------------------------------------------------------------------------------------------------


# What NumPy raises on headers that were written by nobody or by chance.
HEADER_ERRORS = (
    ValueError,
    OSError,
    EOFError,
    TypeError,
    KeyError,
    AttributeError,
    IndexError,
    OverflowError,
    SyntaxError,
    RecursionError,
    MemoryError,
    tokenize.TokenError,
)


def _read_npy(file: Path, wanted: _Wanted, assumptions: list[str]) -> tuple[_Choice, _Raw]:
    try:
        data = map_array(file)
    except HEADER_ERRORS as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        if "pickle" in reason or "object" in reason.lower():
            reason = "an array of Python objects is refused: save numbers"
        raise InputError(f"not a readable NPY array: {reason}", file) from None
    if data.dtype.names is not None:
        if data.ndim != 1:
            raise InputError(f"a structured array must have one dimension, not {data.ndim}", file)
        columns = {name: data[name] for name in data.dtype.names}
        wrong = [name for name, c in columns.items() if c.ndim != 1]
        columns = {name: c for name, c in columns.items() if c.ndim == 1}
        if wrong:
            assumptions.append(f"Fields that are arrays themselves were left out: {_list(wrong)}.")
    elif data.ndim in (1, 2):
        assumptions.append("The array has no names: its columns are numbered from 1.")
        whole = data[:, None] if data.ndim == 1 else data
        if whole.shape[1] > 10_000:
            raise InputError(f"the array has {whole.shape[1]} columns; the limit is 10000 (is it transposed?)", file)
        columns = {str(i + 1): whole[:, i] for i in range(whole.shape[1])}
    else:
        raise InputError(f"the array has {data.ndim} dimensions; one or two are needed", file)
    numeric = [n for n, c in columns.items() if c.dtype.kind in "fiu"]
    return _from_columns(file, columns, numeric, wanted)


def _from_columns(file: Path, columns: dict[str, Any], numeric: Sequence[str], wanted: _Wanted) -> tuple[_Choice, _Raw]:
    """Take numbers and groups from arrays by name."""
    choice = _choose(tuple(columns), numeric, wanted, lambda message: InputError(message, file))
    for name in choice.numeric:
        if name not in numeric:
            raise InputError(f"column {name!r} holds {columns[name].dtype}, not real numbers", file)
    with np.errstate(invalid="ignore"):  # signalling NaNs are told by name later
        numbers = {name: np.array(columns[name], dtype=float) for name in choice.numeric}
    groups, names = None, tuple[str, ...]()
    if choice.group is not None:
        found = columns[choice.group]
        if found.dtype.kind not in "fiubUSO":
            raise InputError(f"column {choice.group!r} holds {found.dtype}, which cannot name groups", file)
        groups, names = _coded(np.asarray(found))
        if len(names) > _MOST_GROUPS:
            raise InputError(f"column {choice.group!r} has {len(names)} groups; the limit is {_MOST_GROUPS}", file)
    return choice, _Raw(numbers, groups, names, lambda row, message: InputError(f"value {row + 1}: {message}", file))


def _coded(column: np.ndarray[Any, Any]) -> tuple[Ints, tuple[str, ...]]:
    """Return codes and names of the groups in the order of their first appearance."""
    if column.dtype.kind == "O":  # text of a Parquet column
        index: dict[str, int] = {}
        codes = np.array([index.setdefault("" if t is None else str(t), len(index)) for t in column.tolist()], dtype=np.intp)
        return codes, tuple(index)
    labels, first, inverse = np.unique(column, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(order), dtype=np.intp)
    rank[order] = np.arange(len(order))
    return rank[inverse.ravel()], tuple(_label(labels[i]) for i in order)


def _label(value: Any) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    number = value.item() if isinstance(value, np.generic) else value
    return str(int(number)) if isinstance(number, float) and math.isfinite(number) and number == int(number) else str(number)


# ---- Parquet ------------------------------------------------------------------------------------------------------------------------


def _read_parquet(file: Path, wanted: _Wanted, assumptions: list[str]) -> tuple[_Choice, _Raw]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise MissingExtra("tables", "reading Parquet") from None
    try:
        source = parquet.ParquetFile(file)
        schema = source.schema_arrow
        numeric = [f.name for f in schema if pyarrow.types.is_integer(f.type) or pyarrow.types.is_floating(f.type)]
        choice = _choose(schema.names, numeric, wanted, lambda message: InputError(message, file))
        used = list(dict.fromkeys([*choice.numeric, *([] if choice.group is None else [choice.group])]))
        table = source.read(columns=used)
        columns: dict[str, Any] = {}
        for name in used:
            column = table.column(name)
            if name in choice.numeric:
                if name not in numeric:
                    raise InputError(f"column {name!r} holds {column.type}, not real numbers", file)
                if column.null_count:
                    row = column.is_null().to_pylist().index(True)
                    raise InputError(f"value {row + 1}: {name} is missing", file)
                columns[name] = column.to_numpy()
            else:
                columns[name] = np.array(column.to_pylist(), dtype=object)
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise InputError(f"not a readable Parquet table: {str(error).splitlines()[0] if str(error) else error}", file) from None
    named = (choice.column, choice.group, choice.sigma, choice.redundancy)
    return _from_columns(file, columns, numeric, named)
