"""The contract of file formats, and reading text that comes from strangers: bounded, by line, with the culprit's name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from baarda.errors import InputError
from baarda.network import Network

LARGEST = 4 * 1024**3  # bytes of a text file that a reader accepts


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes
    ----------
    name : str
    description : str
        One line for `baarda formats`.
    recognises : callable
        ``path -> bool``: whether a file or folder looks like this format; by content, cheap, never raises for a readable path.
    read : callable
        ``path -> Network``; `path` and `format` of the network are set by the caller.
    write : callable or None
        ``(network, path) -> None``.
    """

    name: str
    description: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Network]
    write: Callable[[Network, Path], None] | None = None


@dataclass(frozen=True)
class Line:
    """A line of a text file: its number from 1, its fields."""

    file: Path
    number: int
    fields: tuple[str, ...]

    def error(self, message: str) -> InputError:
        """Return an error that names file and line."""
        return InputError(message, self.file, self.number)

    def number_at(self, i: int, what: str) -> float:
        """Return field i as a finite number, or fail with its name."""
        text = self.text_at(i, what)
        try:
            value = float(text)
        except ValueError:
            raise self.error(f"{what} is not a number: {text!r}") from None
        if not math.isfinite(value):
            raise self.error(f"{what} is not finite: {text!r}")
        return value

    def integer_at(self, i: int, what: str) -> int:
        """Return field i as an integer, or fail with its name."""
        text = self.text_at(i, what)
        try:
            return int(text)
        except ValueError:
            raise self.error(f"{what} is not an integer: {text!r}") from None

    def text_at(self, i: int, what: str) -> str:
        """Return field i, or fail with its name when the line is too short or the field empty."""
        if i >= len(self.fields) or not self.fields[i]:
            raise self.error(f"{what} is missing (the line has {len(self.fields)} fields)")
        return self.fields[i]


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises
    ------
    InputError
        If it is missing, empty, too large, or not UTF-8 text.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST:
            raise InputError(f"the file has {size} bytes; the limit is {LARGEST}", path)
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError("no such file", path) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path) from None
    if not data.strip():
        raise InputError("the file is empty", path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError("the file is not UTF-8 text", path, line) from None


def read_lines(path: Path, separator: str | None = ",", comment: str = "#") -> Iterator[Line]:
    """Yield the lines of a text table without comments and blank lines, fields stripped.

    Parameters
    ----------
    path : Path
    separator : str or None
        Between fields; None = any white space.
    comment : str
        Lines that begin with it are left out.

    Raises
    ------
    InputError
        See `read_text`.
    """
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        stripped = text.strip()
        if stripped and not stripped.startswith(comment):
            fields = stripped.split(separator)
            yield Line(path, number, tuple(f.strip() for f in fields))


def unique(labels: Sequence[str], lines: Sequence[Line], what: str) -> dict[str, int]:
    """Return the index of each label; fail with both lines when one appears twice."""
    out: dict[str, int] = {}
    for i, label in enumerate(labels):
        if label in out:
            raise lines[i].error(f"{what} {label!r} appears twice (first in line {lines[out[label]].number})")
        out[label] = i
    return out


def finite_or_nan(text: str) -> float:
    """Return a number, NaN for an empty field."""
    return float(text) if text else float(np.nan)
