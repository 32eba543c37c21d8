"""Parts of zip archives from strangers: read by name into memory, never unpacked to the disk, with limits."""

from __future__ import annotations

import lzma
import zipfile
import zlib
from pathlib import Path
from types import TracebackType

from baarda.errors import InputError
from baarda.formats.base import regular_size

MOST_PARTS = 200_000
LARGEST_PART = 2 * 1024**3  # bytes, unpacked
LARGEST_RATIO = 200  # unpacked bytes per packed byte of the whole archive
SMALL = 1024**2  # parts below this size may be packed more densely
#: what damaged parts end in
DAMAGE = (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, RuntimeError, EOFError, zlib.error, lzma.LZMAError)


class Parts:
    """The parts of an archive.

    Raises
    ------
    InputError
        If it is no archive, is damaged, or has too many parts.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = regular_size(path)
        try:
            self._zip = zipfile.ZipFile(path)
            self._parts = {i.filename: i for i in self._zip.infolist()}
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
            raise InputError(f"not a zip archive that can be read: {error}", path) from None
        if len(self._parts) > MOST_PARTS:
            raise InputError(f"the archive has {len(self._parts)} parts; the limit is {MOST_PARTS}", path)

    def __enter__(self) -> Parts:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._zip.close()

    def __contains__(self, name: str) -> bool:
        return name in self._parts

    def file(self, name: str) -> Path:
        """Return the name of a part for messages."""
        return self.path / name

    def read(self, name: str) -> bytes:
        """Return the content of a part.

        Raises
        ------
        InputError
            If it is absent, damaged, encrypted, or unpacks to more than the limits.
        """
        if name not in self._parts:
            raise InputError(f"the archive has no part {name!r}", self.path)
        info = self._parts[name]
        limit = min(LARGEST_PART, max(SMALL, LARGEST_RATIO * self.size))
        if info.file_size > limit:
            raise InputError(f"part {name!r} unpacks to {info.file_size} bytes; the limit is {limit}", self.path)
        try:
            with self._zip.open(info) as f:
                data = f.read(limit + 1)
        except DAMAGE as error:
            raise InputError(f"part {name!r} cannot be read: {error}", self.path) from None
        if len(data) > limit:
            raise InputError(f"part {name!r} unpacks to more than {limit} bytes", self.path)
        return data
