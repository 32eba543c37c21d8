"""Write a folder whole or not at all: beside its place first, then renamed."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from baarda.errors import OutputError, UsageError


def check_target(target: Path, mark: str | None = None) -> None:
    """Refuse, before any work, a folder that cannot be written or that belongs to somebody else; see `whole_folder`."""
    _temporary(target.absolute(), mark).rmdir()


@contextmanager
def whole_folder(target: Path, mark: str | None = None) -> Iterator[Path]:
    """Yield a temporary folder beside `target` and rename it there on success; on any failure or interruption nothing is left.

    Parameters
    ----------
    target : Path
        The folder; it must not exist, be empty, or hold the file `mark`: then it is replaced.
    mark : str, optional
        Name of a file by which an earlier folder of the same kind is known.

    Raises
    ------
    OutputError
        If the target is something else, or writing fails.
    """
    target = target.absolute()
    temporary = _temporary(target, mark)
    old = target.with_name(f".{target.name}-old-{os.getpid()}")
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o777 & ~mask)  # temporary folders are private
        if target.exists():
            target.rename(old)
        try:
            temporary.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _temporary(target: Path, mark: str | None) -> Path:
    """Make a temporary folder beside the (absolute) target."""
    try:
        free = not target.exists() or (target.is_dir() and (not any(target.iterdir()) or (mark is not None and (target / mark).is_file())))
        if not free:
            kind = "is not an empty folder" if mark is None else f"is not an empty folder or one with an earlier {mark}"
            raise OutputError(f"{target} exists and {kind}: choose another place")
        target.parent.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from None


def write_folder(path: Path, files: Mapping[str, str], mark: str | None = None) -> None:
    """Write text files to a folder.

    Parameters
    ----------
    path : Path
        The folder, see `whole_folder`.
    files : mapping of str to str
        Content by name, sub-folders parted by ``/``.
    mark : str, optional
        See `whole_folder`.

    Raises
    ------
    UsageError
        If a text is not Unicode.
    OutputError
        If the folder cannot be written; nothing is left behind.
    """
    try:
        data = {name: text.encode("utf-8") for name, text in files.items()}
    except UnicodeEncodeError as error:
        raise UsageError(f"text that is not Unicode cannot be written: {error.object[error.start : error.end]!r}") from None
    with whole_folder(path, mark) as folder:
        for name, content in data.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
