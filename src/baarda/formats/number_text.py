"""Text that is one long row of numbers, plain or packed by bzip2 or gzip: parsed at once, with the line of each number for messages."""

from __future__ import annotations

import bz2
import gzip
import io
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError
from baarda.formats.base import LARGEST, number, read_bytes

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

_BZIP2, _GZIP = b"BZh", b"\x1f\x8b"
LARGEST_RATIO = 20  # unpacked bytes per packed byte; numbers as text pack by 2 to 6
LARGEST_NUMBER = 1e15  # squares and sums of larger ones would overflow
SMALL = 1 << 20  # bytes that may be packed more densely
_PEEK = 1 << 21  # packed bytes that give the first text: more than one block of bzip2


def unpacked(path: Path) -> bytes:
    """Return the content of a file, unpacked if bzip2 or gzip packed it (judged by content).

    Raises
    ------
    InputError
        If it cannot be read, is damaged, empty, or larger than a reader accepts, also after unpacking (20 fold at most).
    """
    data = read_bytes(path)
    try:
        if data.startswith(_BZIP2):
            with bz2.open(io.BytesIO(data)) as packed:
                data = _up_to(cast(BinaryIO, packed), min(LARGEST, max(SMALL, LARGEST_RATIO * len(data))), path)
        elif data.startswith(_GZIP):
            with gzip.open(io.BytesIO(data)) as packed:
                data = _up_to(cast(BinaryIO, packed), min(LARGEST, max(SMALL, LARGEST_RATIO * len(data))), path)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"the packed file is damaged: {error}", path) from None
    if not data.strip():
        raise InputError("the file is empty", path)
    return data


def _up_to(packed: BinaryIO, limit: int, path: Path) -> bytes:
    """Read a packed text piece by piece: one large read would ask for the limit at once."""
    pieces, total = [], 0
    while piece := packed.read(_PEEK):
        pieces.append(piece)
        total += len(piece)
        if total > limit:
            raise InputError(f"the unpacked text has more than {limit} bytes", path)
    return b"".join(pieces)


def beginning(path: Path, size: int = 4096) -> bytes:
    """Return the first bytes of a file, unpacked; empty where it is packed and damaged."""
    with path.open("rb") as f:
        data = f.read(size)
        if data.startswith((_BZIP2, _GZIP)):
            data += f.read(_PEEK)
    try:
        if data.startswith(_BZIP2):
            return bz2.BZ2Decompressor().decompress(data, size)
        if data.startswith(_GZIP):
            return zlib.decompressobj(31).decompress(data, size)
    except (OSError, EOFError, zlib.error):
        return b""
    return data


@dataclass(frozen=True)
class NumberText:
    """The numbers of a text.

    Attributes
    ----------
    file : Path
    text : bytes
    values : (n,) array
    skipped : int
        Lines left out before the first number.
    """

    file: Path
    text: bytes
    values: Floats
    skipped: int = 0

    @staticmethod
    def of(file: Path, text: bytes, skipped: int = 0) -> NumberText:
        r"""Parse numbers parted by white space.

        Raises
        ------
        InputError
            With the line of the first word that is not a number, not finite, or beyond 1e15.

        Examples
        --------
        >>> found = NumberText.of(Path("a.txt"), b"1 2.5\n-3e1 4\n")
        >>> found.values.tolist(), found.line(2)
        ([1.0, 2.5, -30.0, 4.0], 2)
        """
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            try:
                values = np.fromstring(text, sep=" ")
                good = bool((np.abs(values) <= LARGEST_NUMBER).all())
            except (DeprecationWarning, ValueError):
                good = False
        if not good:
            _complain(file, text, skipped)
        return NumberText(file, text, values, skipped)

    def line(self, index: int) -> int:
        """Return the line, from 1, of a number; the last line for one beyond the end."""
        left = index
        lines = self.text.split(b"\n")
        for i, line in enumerate(lines, start=1):
            left -= len(line.split())
            if left < 0:
                return i + self.skipped
        return len(lines) - (not lines[-1].strip()) + self.skipped

    def error(self, message: str, index: int) -> InputError:
        """Return an error that names file and line of a number."""
        return InputError(message, self.file, self.line(index))

    def need(self, count: int, what: str) -> None:
        """Refuse a text with fewer numbers than needed."""
        if len(self.values) < count:
            raise self.error(f"the text ends after {len(self.values)} numbers; {what} needs {count}: truncated?", len(self.values))

    def whole(self, indices: Integers, low: int, high: int, what: str) -> Integers:
        """Return numbers that must be whole and lie in [low, high].

        Raises
        ------
        InputError
            With the line of the first that is not.
        """
        values = self.values[indices]
        bad = np.flatnonzero((values != np.floor(values)) | (values < low) | (values > high))
        if len(bad):
            at = int(indices[bad[0]])
            raise self.error(f"{what} must be a whole number from {low} to {high}, not {self.values[at]:.17g}", at)
        return values.astype(np.intp)


def _complain(file: Path, text: bytes, skipped: int) -> None:
    for i, line in enumerate(text.split(b"\n"), start=1):
        for word in line.split():
            try:
                value = abs(number(word.decode("ascii", "replace")))
            except ValueError:
                raise InputError(f"not a number: {word[:40].decode('ascii', 'replace')!r}", file, i + skipped) from None
            if not value <= LARGEST_NUMBER:
                why = f"beyond {LARGEST_NUMBER:g}" if np.isfinite(value) else "not finite"
                raise InputError(f"{why}: {word[:40].decode('ascii', 'replace')!r}", file, i + skipped)
    raise InputError("the text cannot be parsed as numbers", file)
