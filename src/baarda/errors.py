"""Every failure of `baarda` that a user can cause or meet: one message, one exit code."""

from __future__ import annotations

import re
from collections.abc import Sequence

LONGEST = 2000  # characters of a message: a stranger's file may hold a word of any length
_HIDDEN = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff]")


def shown(text: str) -> str:
    r"""Return a text that is safe to print: control characters as escapes, the middle of a very long one left out.

    Examples
    --------
    >>> shown("no point 'a\x1b[31m'")
    "no point 'a\\x1b[31m'"
    >>> len(shown("9" * 5000)) < 2100
    True
    """
    text = _HIDDEN.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
    if len(text) <= LONGEST:
        return text
    half = LONGEST // 2
    return f"{text[:half]} ... ({len(text) - 2 * half} characters left out) ... {text[-half:]}"


class BaardaError(Exception):
    """Base of all errors that the command line prints as one message; `exit_code` is its exit status."""

    exit_code = 2

    def __init__(self, message: str = "") -> None:
        super().__init__(shown(str(message)))


class UsageError(BaardaError):
    """An option or argument that makes no sense."""


class InputError(BaardaError):
    """A file that cannot be used, with its name and, where one exists, the line (counted from 1)."""

    def __init__(self, message: str, file: object = None, line: int | None = None) -> None:
        self.file = None if file is None else str(file)
        self.line = line
        place = "" if file is None else f"{file}: " if line is None else f"{file}, line {line}: "
        super().__init__(place + message)


class MissingExtra(BaardaError):
    """An optional dependency that is not installed."""

    def __init__(self, extra: str, what: str) -> None:
        super().__init__(f"{what} needs the '{extra}' extra: pip install \"baarda[{extra}]\"")


class RedundancyNotPositive(BaardaError):
    """Fewer independent observations than unknowns, or just as many: nothing can be tested."""

    exit_code = 3


class DatumDefect(BaardaError):
    """The observations do not define position, rotation or scale of the object space."""

    exit_code = 3


class Singular(BaardaError):
    """Unknowns that the observations do not determine; `names` lists them."""

    exit_code = 3

    def __init__(self, message: str, names: Sequence[str] = ()) -> None:
        self.names = tuple(names)
        super().__init__(message)


class NotEnoughMemory(BaardaError):
    """The estimate of the memory needed exceeds what the machine has."""

    exit_code = 4


class OutputError(BaardaError):
    """The result could not be written; nothing was left behind."""

    exit_code = 4
