"""CSV tables with a header row: columns by name and in any order, every complaint with file and line, numbers that read back exactly.

Quoting is that of RFC 4180, so that a label may hold commas, quotes and line breaks; blanks after a comma do not count.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError, UsageError
from baarda.formats.base import label_problem, number, read_text

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

_NEEDS_QUOTES = re.compile(r'[,"\r\n]|^\s|\s$')


@dataclass(frozen=True)
class CsvTable:
    """The rows of a CSV file as columns of text.

    Attributes
    ----------
    file : Path
    columns : mapping of str to sequence of str
    ends : sequence of int
        Number of the last line of each row, from 1.
    """

    file: Path
    columns: Mapping[str, Sequence[str]]
    ends: Sequence[int]

    def __len__(self) -> int:
        return len(self.ends)

    def line(self, row: int) -> int:
        """Return the number of the line where a row begins."""
        breaks = sum(len(re.findall(r"\r\n|\r|\n", c[row])) for c in self.columns.values())
        return int(self.ends[row]) - breaks

    def error(self, row: int, message: str) -> InputError:
        """Return an error that names file and line of a row."""
        return InputError(message, self.file, self.line(row))

    def texts(self, name: str, default: str | None = None) -> Sequence[str]:
        """Return a column of text; without a default an empty field is an error."""
        if name not in self.columns:
            if default is None:
                raise InputError(f"column {name!r} is missing", self.file, 1)
            return [default] * len(self)
        column = self.columns[name]
        if all(column):
            return column
        if default is None:
            raise self.error(next(i for i, t in enumerate(column) if not t), f"{name} is empty")
        return [t or default for t in column]

    def choices(self, name: str, allowed: Sequence[str]) -> Ints:
        """Return the index of each field among the allowed words, -1 for an empty field or an absent column."""
        words = {"": -1, **{word: i for i, word in enumerate(allowed)}}
        column = self.columns.get(name)
        if column is None:
            return np.full(len(self), -1, dtype=np.intp)
        try:
            return np.array([words[t] for t in column], dtype=np.intp)
        except KeyError:
            row = next(i for i, t in enumerate(column) if t not in words)
            raise self.error(row, f"{name} must be one of {', '.join(allowed)}, not {column[row]!r}") from None

    def numbers(self, name: str, default: float | None = math.nan) -> Floats:
        """Return a column of finite numbers; an empty field or an absent column gives the default, and is an error without one."""
        if name not in self.columns:
            if default is None:
                raise InputError(f"column {name!r} is missing", self.file, 1)
            return np.full(len(self), default)
        column = self.columns[name]
        fill = math.nan if default is None else default
        try:
            values = np.array([float(t) if t else fill for t in column], dtype=float)
        except ValueError:
            row = next(i for i, t in enumerate(column) if t and not _is_number(t))
            raise self.error(row, f"{name} is not a number: {column[row]!r}") from None
        if "_" in (everything := "".join(column)) or not everything.isascii():  # float() takes 1_000 and the digits of other scripts
            row = next(i for i, t in enumerate(column) if t and not _is_number(t))
            raise self.error(row, f"{name} is not a number: {column[row]!r}")
        for row in np.flatnonzero(~np.isfinite(values)).tolist():
            if column[row]:
                raise self.error(row, f"{name} is not finite: {column[row]!r}")
            if default is None:
                raise self.error(row, f"{name} is missing")
        return values

    def sigmas(self, name: str, default: float | None = math.nan) -> Floats:
        """Return a column of standard deviations; negative ones are an error, zero is left to the caller."""
        values = self.numbers(name, default)
        bad = np.flatnonzero(values < 0.0)
        if len(bad):
            raise self.error(int(bad[0]), f"{name} must not be negative: {values[bad[0]]!r}")
        return values

    def codes(self, name: str, index: Mapping[str, int], what: str) -> Ints:
        """Return the index of each label; a label that the index does not hold is an error."""
        column = self.texts(name)
        try:
            return np.array([index[t] for t in column], dtype=np.intp)
        except KeyError:
            row = next(i for i, t in enumerate(column) if t not in index)
            raise self.error(row, f"unknown {what} {column[row]!r}") from None

    def labels(self, name: str, what: str) -> dict[str, int]:
        """Return the row of each label; a label that appears twice is an error that names both lines.

        Control characters in a label are an error, too.
        """
        column = self.texts(name)
        for i, problem in enumerate(label_problem(t, what) for t in column):
            if problem:
                raise self.error(i, problem)
        out = {t: i for i, t in enumerate(column)}
        if len(out) < len(column):
            first: dict[str, int] = {}
            for i, t in enumerate(column):
                if t in first:
                    raise self.error(i, f"{what} {t!r} appears twice (first in line {self.line(first[t])})")
                first[t] = i
        return out


def _is_number(text: str) -> bool:
    try:
        number(text)
    except ValueError:
        return False
    return True


def read_csv(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> CsvTable:
    """Read a CSV table with a header row.

    Parameters
    ----------
    path : Path
    required, optional : sequence of str
        Names of columns that must and that may be there.

    Returns
    -------
    CsvTable

    Raises
    ------
    InputError
        With file and line, if a column is unknown, doubled or missing, a row has too few or too many fields, or there are no rows.
    """
    rows: list[list[str]] = []
    ends: list[int] = []
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True, skipinitialspace=True)
    good = 0
    try:
        for row in reader:
            good = reader.line_num
            if row:
                rows.append(row)
                ends.append(good)
    except csv.Error as error:
        raise InputError(f"not a CSV table: {error} (the row begins here)", path, good + 1) from None
    if not rows:
        raise InputError("the table has no header row", path)
    header = [name.strip() for name in rows[0]]
    known = (*required, *optional)
    for name in header:
        if name not in known:
            raise InputError(f"unknown column {name!r}; known are {', '.join(known)}", path, ends[0])
        if header.count(name) > 1:
            raise InputError(f"column {name!r} appears twice", path, ends[0])
    for name in required:
        if name not in header:
            raise InputError(f"column {name!r} is missing", path, ends[0])
    del rows[0]
    first = ends.pop(0)
    if not rows:
        raise InputError("the table has a header but no rows", path, first)
    for row, end in zip(rows, ends, strict=True):
        if len(row) != len(header):
            raise InputError(f"the row has {len(row)} fields, the header {len(header)}", path, end)
    return CsvTable(path, dict(zip(header, zip(*rows, strict=True), strict=True)), ends)


def numbers_text(values: Floats) -> list[str]:
    """Return numbers as the shortest text that reads back exactly, NaN as empty text.

    Examples
    --------
    >>> numbers_text(np.array([0.1, -0.0, np.nan, 1e22]))
    ['0.1', '-0.0', '', '1e+22']
    """
    if np.isinf(values).any():
        raise UsageError("an infinite number cannot be written")
    return ["" if v != v else repr(v) for v in np.asarray(values, dtype=float).tolist()]


def quoted(text: str) -> str:
    """Return a field, between quotes where it needs them.

    Examples
    --------
    >>> print(quoted("a"), quoted("a, b"), quoted('3" pipe'))
    a "a, b" "3"" pipe"
    """
    return '"' + text.replace('"', '""') + '"' if _NEEDS_QUOTES.search(text) else text


def csv_text(columns: Mapping[str, Sequence[str]]) -> str:
    """Return a CSV table with a header row; the fields are written as they come (see `quoted`)."""
    lines = [",".join(columns), *map(",".join, zip(*columns.values(), strict=True))]
    return "\n".join(lines) + "\n"
