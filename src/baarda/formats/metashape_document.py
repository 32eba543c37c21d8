"""Where the parts of a Metashape project lie: XML exports, ``.psz`` archives, and ``.psx`` with its folder of archives.

Names of parts that a document gives are looked up in the same archive, or must be plain paths below the project's own folder.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from baarda.errors import InputError
from baarda.formats.base import read_bytes
from baarda.formats.xml_tree import Element, parse_xml
from baarda.formats.zip_parts import Parts

_DOC = "doc.xml"
_PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*(/[A-Za-z0-9_][A-Za-z0-9_.-]*)*")


@dataclass(frozen=True)
class Chunk:
    """A chunk of a project: its XML, that of its first frame, and what reads the parts beside the tie points.

    Attributes
    ----------
    file : Path
        For messages.
    chunk, frame : Element
    cloud : Element or None
        ``<point_cloud>`` with the names of the tie points.
    part : callable
        Name of a part beside the tie points to its content and its name for messages.
    others : int
        Further chunks that are not read.
    """

    file: Path
    chunk: Element
    frame: Element | None
    cloud: Element | None
    part: Callable[[str], tuple[bytes, Path]]
    others: int


def looks_like(path: Path) -> bool:
    """Tell a Metashape file: an XML document with a chunk or a project, or an archive whose doc.xml is one."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        head = f.read(4096)
    if head.startswith(b"PK\x03\x04"):
        try:
            with Parts(path) as parts:
                return _DOC in parts and b"<chunk" in parts.read(_DOC)[:65536]
        except InputError:
            return False
    return (
        re.search(rb"<document\s[^>]*version=", head) is not None
        and re.search(rb"<chunks?[\s>]|path=\"[^\"]*project\.zip\"", head) is not None
    )


@contextmanager
def opened(path: Path) -> Iterator[Chunk]:
    """Yield the chunk of a file: the active one of a project, the largest of an archive, the only one of an export.

    Raises
    ------
    InputError
        If a part is missing or cannot be used.
    """
    with ExitStack() as stack:
        with path.open("rb") as f:
            packed = f.read(4) == b"PK\x03\x04"
        if packed:
            archive = stack.enter_context(Parts(path))
            root = parse_xml(archive.read(_DOC), archive.file(_DOC))
            yield _of_document(root, path, lambda name: (archive.read(name), archive.file(name)))
            return
        root = parse_xml(read_bytes(path), path)
        if root.tag != "document":
            raise root.error("the root element must be <document>")
        if "path" in root.attributes:
            yield _of_project(root, path, stack)
            return

        def nothing(name: str) -> tuple[bytes, Path]:
            raise InputError(f"an exported XML has no part {name!r}", path)

        yield _of_document(root, path, nothing)


def _of_document(root: Element, path: Path, part: Callable[[str], tuple[bytes, Path]]) -> Chunk:
    if root.tag != "document":
        raise root.error("the root element must be <document>")
    chunks = root.all("chunk") or root.all("chunks", "chunk")
    if not chunks:
        raise root.error("the document has no <chunk>")
    chunk = max(chunks, key=lambda c: len(c.all("cameras", "camera")) + len(c.all("cameras", "group", "camera")))
    frame = chunk.first("frames", "frame")
    cloud = None if frame is None else frame.first("point_cloud")
    return Chunk(path, chunk, frame, cloud, part, len(chunks) - 1)


def _of_project(root: Element, path: Path, stack: ExitStack) -> Chunk:
    """Return the active chunk of a ``.psx`` project; all its parts lie in the folder ``NAME.files`` beside it."""
    folder = path.with_name(path.stem + ".files")
    if not folder.is_dir():
        raise InputError(f"the project's folder {folder.name!r} is not beside it", path)

    def archive(*names: str) -> Parts:
        place = folder.joinpath(*names)
        if not place.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"part {'/'.join(names)!r} lies outside the project's folder", path)
        return stack.enter_context(Parts(place))

    def document(parts: Parts) -> Element:
        return parse_xml(parts.read(_DOC), parts.file(_DOC))

    project = document(archive("project.zip"))
    chunks = project.need("chunks")
    entries = chunks.all("chunk")
    if not entries:
        raise chunks.error("the project has no chunks")
    active = chunks.attributes.get("active_id")
    entry = next((c for c in entries if c.attributes.get("id") == active), entries[0])
    where = _plain(entry)
    chunk = document(archive(where))
    frames = chunk.all("frames", "frame")
    if not frames:
        return Chunk(path, chunk, None, None, lambda name: _no_cloud(path), len(entries) - 1)
    inner = (Path(where).parent / _plain(frames[0])).as_posix()
    frame = document(archive(inner))
    entry_of_cloud = frame.first("point_cloud")
    if entry_of_cloud is None:
        return Chunk(path, chunk, frame, None, lambda name: _no_cloud(path), len(entries) - 1)
    cloud = archive((Path(inner).parent / _plain(entry_of_cloud)).as_posix())
    return Chunk(path, chunk, frame, document(cloud), lambda name: (cloud.read(name), cloud.file(name)), len(entries) - 1)


def _no_cloud(path: Path) -> tuple[bytes, Path]:
    raise InputError("the project has no tie points", path)


def _plain(element: Element) -> str:
    """Return the path of a part below the project's folder."""
    text = element.word("path")
    if not _PLAIN.fullmatch(text) or ".." in text:
        raise element.error(f"path {text!r:.80} is not a plain path below the project's folder")
    return text
