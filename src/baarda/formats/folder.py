"""Write a folder whole or not at all."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path

from baarda.errors import OutputError, UsageError


def write_folder(path: Path, files: Mapping[str, str]) -> None:
    """Write text files to a new folder: beside it first, then renamed.

    Parameters
    ----------
    path : Path
        The folder; it must not exist yet, or be empty.
    files : mapping of str to str
        Content by name.

    Raises
    ------
    UsageError
        If a text is not Unicode.
    OutputError
        If the folder cannot be written; nothing is left behind, not even after an interruption.
    """
    try:
        data = {name: text.encode("utf-8") for name, text in files.items()}
    except UnicodeEncodeError as error:
        raise UsageError(f"text that is not Unicode cannot be written: {error.object[error.start : error.end]!r}") from None
    temporary = path.parent / f".{path.name}.{uuid.uuid4().hex}"
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise OutputError(f"{path} exists already and is not an empty folder")
        temporary.mkdir(parents=True)
        for name, content in data.items():
            (temporary / name).write_bytes(content)
        if path.exists():
            path.rmdir()
        temporary.rename(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
