"""The contract of file formats, and reading text that comes from strangers: bounded, by line, with the culprit's name."""

from __future__ import annotations

import math
import re
import stat
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError, UsageError
from baarda.network import Network

FIRST_PIXEL = "first_pixel"  # key of the settings of a network, see Format
LARGEST = 4 * 1024**3  # bytes of a text file that a reader accepts
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_CONTROL_BUT_TAB = re.compile(r"[\x00-\x08\x0a-\x1f\x7f]")


def number(text: str) -> float:
    """Return a number in ASCII digits; `float` alone would also take 1_000 and the digits of other scripts.

    Raises
    ------
    ValueError
        If the text is not a number.

    Examples
    --------
    >>> number("1e3"), number(" -.5")
    (1000.0, -0.5)
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def whole_number(text: str) -> int:
    """Return a whole number in at most 18 ASCII digits, with or without a sign.

    Raises
    ------
    ValueError
        If the text is not such a number.
    """
    if not re.fullmatch(r"[+-]?\d{1,18}", text, re.ASCII):
        raise ValueError(f"not a whole number: {text!r}")
    return int(text)


def control_character(text: str) -> str | None:
    r"""Return the first control character (code below 32, or 127) of a label, None when there is none.

    Examples
    --------
    >>> control_character("Tür 12"), control_character("a\tb")
    (None, '\t')
    """
    found = _CONTROL.search(text)
    return found[0] if found else None


def label_problem(label: str, what: str) -> str | None:
    """Return why a label cannot be used, None when it can: it must not hold control characters."""
    found = control_character(label)
    return None if found is None else f"{what} {label!r} holds a control character ({found!r})"


def first_pixel(network: Network) -> float | None:
    """Return the coordinate of the centre of the first pixel in the source pixels of a network, None where its source does not say.

    Raises
    ------
    UsageError
        If a project states something else than 0 or 0.5.
    """
    value = network.settings.get(FIRST_PIXEL)
    if value is None or (value in (0.0, 0.5) and not isinstance(value, bool)):
        return None if value is None else float(value)
    raise UsageError(f"{FIRST_PIXEL} must be 0 or 0.5, not {value!r}")


def regular_size(path: Path) -> int:
    """Return the size of a file in bytes.

    Raises
    ------
    InputError
        If it is missing, cannot be looked at, or is not a regular file (a folder, a pipe, a device).
    """
    try:
        found = path.stat()
    except (FileNotFoundError, ValueError):  # ValueError: a name with a zero byte
        raise InputError("no such file", path) from None
    except OSError as error:
        raise unreadable(error, path) from None
    if not stat.S_ISREG(found.st_mode):
        raise InputError("not a regular file", path)
    return found.st_size


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file.

    Raises
    ------
    InputError
        If it is missing, not a regular file, too large, or cannot be read.
    """
    size = regular_size(path)
    if size > LARGEST:
        raise InputError(f"the file has {size} bytes; the limit is {LARGEST}", path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise unreadable(error, path) from None


def unreadable(error: OSError, path: Path) -> InputError:
    """Return the error of a file or folder that the system does not let us read."""
    name = error.filename if isinstance(error.filename, str) else path
    return InputError(f"cannot be read: {error.strerror or error}", name)


@dataclass(frozen=True)
class MeasuredPositions:
    """Positions of cameras (of their antennas) that a source holds beside its solution.

    Attributes
    ----------
    file : Path
    images : tuple of str
        Label of each image.
    xyz : (n, 3) array
        In the system of the network that the reader returns.
    covariances : (n, 3, 3) array
    strips : tuple of str
    times : (n,) array or None
        Seconds; None = the source has none.
    complain : callable
        Row and message to the error with file and line.
    notes : tuple of str
        Assumptions made.
    """

    file: Path
    images: tuple[str, ...]
    xyz: NDArray[np.float64]
    covariances: NDArray[np.float64]
    strips: tuple[str, ...]
    times: NDArray[np.float64] | None
    complain: Callable[[int, str], InputError]
    notes: tuple[str, ...] = ()


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
    positions : callable or None
        ``path -> MeasuredPositions``: the measured camera positions of a source, for `--camera-positions source`.
    first_pixel : float or None
        Coordinate of the centre of the first pixel, 0.5 or 0, where the format states it; a network keeps it among its settings.
    """

    name: str
    description: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Network]
    write: Callable[[Network, Path], None] | None = None
    positions: Callable[[Path], MeasuredPositions] | None = None
    first_pixel: float | None = None


@dataclass(frozen=True)
class Line:
    """A line of a text file: its number from 1, its fields."""

    file: Path
    number: int
    fields: tuple[str, ...]

    def error(self, message: str) -> InputError:
        """Return an error that names file and line."""
        return InputError(message, self.file, self.number)

    def complain(self, _row: int, message: str) -> InputError:
        """Return an error that names file and line, for checks that also name a row."""
        return self.error(message)

    def number_at(self, i: int, what: str) -> float:
        """Return field i as a finite number, or fail with its name."""
        text = self.text_at(i, what)
        try:
            value = number(text)
        except ValueError:
            raise self.error(f"{what} is not a number: {text!r}") from None
        if not math.isfinite(value):
            raise self.error(f"{what} is not finite: {text!r}")
        return value

    def integer_at(self, i: int, what: str) -> int:
        """Return field i as an integer, or fail with its name."""
        text = self.text_at(i, what)
        try:
            return whole_number(text)
        except ValueError:
            raise self.error(f"{what} is not an integer: {text!r}") from None

    def text_at(self, i: int, what: str) -> str:
        """Return field i, or fail with its name when the line is too short or the field empty."""
        if i >= len(self.fields) or not self.fields[i]:
            raise self.error(f"{what} is missing (the line has {len(self.fields)} fields)")
        problem = label_problem(self.fields[i], what)
        if problem:
            raise self.error(problem)
        return self.fields[i]


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises
    ------
    InputError
        If it is missing, not a regular file, empty, too large, or not UTF-8 text.
    """
    data = read_bytes(path)
    if not data.strip():
        raise InputError("the file is empty", path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError("the file is not UTF-8 text", path, line) from None


def split_lines(path: Path) -> list[str]:
    """Return the lines of a text file as editors count them; a control character in one is an error.

    Raises
    ------
    InputError
        See `read_text`.
    """
    # not splitlines(), which also splits at separators of Unicode that a label may hold
    lines = read_text(path).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not lines[-1]:
        lines.pop()
    for i, line in enumerate(lines, start=1):
        found = _CONTROL_BUT_TAB.search(line)
        if found:
            raise InputError(f"the line holds a control character ({found[0]!r})", path, i)
    return lines


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
    for i, text in enumerate(split_lines(path), start=1):
        stripped = text.strip()
        if stripped and not stripped.startswith(comment):
            fields = stripped.split(separator)
            yield Line(path, i, tuple(f.strip() for f in fields))


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
