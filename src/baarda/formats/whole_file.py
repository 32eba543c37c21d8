"""Write a file whole or not at all: beside its place first, then renamed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from baarda.errors import OutputError


def write_file(path: Path, content: bytes) -> None:
    """Write a new file.

    Parameters
    ----------
    path : Path
        It must not exist; missing folders above it are made.
    content : bytes

    Raises
    ------
    OutputError
        If it exists or cannot be written; nothing is left behind.

    Examples
    --------
    >>> target = Path(tempfile.mkdtemp()) / "new" / "a.txt"
    >>> write_file(target, b"text")
    >>> target.read_bytes(), len(list(target.parent.iterdir()))
    (b'text', 1)
    """
    if path.exists():
        raise OutputError(f"{path} exists")
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as f:
            f.write(content)
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)  # temporary files are private
        temporary.rename(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
