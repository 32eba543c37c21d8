"""Every failure of `baarda` that a user can cause or meet: one message, one exit code."""

from __future__ import annotations

from collections.abc import Sequence


class BaardaError(Exception):
    """Base of all errors that the command line prints as one message; `exit_code` is its exit status."""

    exit_code = 2


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
