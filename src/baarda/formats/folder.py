"""Write a folder whole or not at all: beside its place first, then renamed."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from baarda.errors import OutputError, UsageError

HEADS = ("result.json", "batch.json")  # what results begin with
_PARTS = {*HEADS, "run.json", "report.html", "report.pdf", "tables", "figures", "project", "blocks", "records"}


@dataclass(frozen=True)
class Mark:
    """How an earlier folder of the same kind is known: its JSON file begins with this schema, and nothing else lies beside its parts.

    Attributes
    ----------
    file : str
        Name of the JSON file.
    schema : str
        Beginning of the value of ``schema`` in it.
    parts : tuple of str
        Names of the files and folders that such a folder may hold.
    """

    file: str
    schema: str
    parts: tuple[str, ...]

    def on(self, folder: Path) -> bool:
        """Return whether a folder is one of this kind and holds nothing of anybody else."""
        if any(p.name not in self.parts for p in folder.iterdir()) or not (folder / self.file).is_file():
            return False
        with (folder / self.file).open("rb") as f:
            return f'"schema": "{self.schema}'.encode() in f.read(400)


def is_result(folder: Path) -> bool:
    """Return whether a folder is a result folder, of whatever verb, and holds nothing of anybody else.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    bool
    """
    held = {p.name for p in folder.iterdir()}
    name = "batch.json" if "batch.json" in held else "result.json" if {"run.json", "result.json"} <= held else None
    if name is None or not held <= _PARTS or not (folder / name).is_file():
        return False
    with (folder / name).open("rb") as f:
        return b'"schema": "baarda.' in f.read(400)


def check_target(target: Path, mark: Mark | None = None) -> None:
    """Refuse, before any work, a folder that cannot be written or that belongs to somebody else; see `whole_folder`."""
    target = target.absolute()
    _refuse_foreign(target, mark)
    parent = next(p for p in target.parents if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write {target}: no folder can be made in {parent}")


@contextmanager
def whole_folder(target: Path, mark: Mark | None = None) -> Iterator[Path]:
    """Yield a temporary folder beside `target` and rename it there on success; on any failure or interruption nothing is left.

    Parameters
    ----------
    target : Path
        The folder; it must not exist, be empty, or bear the mark: then it is replaced. A link is followed.
    mark : Mark, optional
        By which an earlier folder of the same kind is known.

    Raises
    ------
    OutputError
        If the target is something else, or writing fails.
    """
    shown = target
    target = target.resolve()
    _refuse_foreign(target, mark)
    old = target.with_name(f".{target.name}-old-{os.getpid()}")
    temporary: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o777 & ~mask)  # temporary folders are private
        if target.exists():
            target.rename(old)
        temporary.rename(target)
    except OSError as error:
        raise OutputError(f"cannot write {shown}: {error.strerror or error}") from None
    finally:
        if old.exists() and not target.exists():
            old.rename(target)  # interrupted between the two renames: the earlier folder comes back
        shutil.rmtree(old, ignore_errors=True)
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def _refuse_foreign(target: Path, mark: Mark | None) -> None:
    try:
        if not target.exists() or (target.is_dir() and (not any(target.iterdir()) or (mark is not None and mark.on(target)))):
            return
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from None
    kind = "is not an empty folder" if mark is None else f"is not an empty folder, nor one that holds only an earlier result ({mark.file})"
    raise OutputError(f"{target} exists and {kind}: choose another place")


def write_folder(path: Path, files: Mapping[str, str], mark: Mark | None = None) -> None:
    """Write text files to a folder.

    Parameters
    ----------
    path : Path
        The folder, see `whole_folder`.
    files : mapping of str to str
        Content by name, sub-folders parted by ``/``.
    mark : Mark, optional
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
