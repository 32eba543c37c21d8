"""The contract of report sections: what a section is made of, and the maker that a member file defines."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from baarda.procedures.testing import Analysis
from baarda.report.translation import current, tr

Tone = Literal["", "good", "warn", "bad", "info"]

#: The words that go with the colours: a reader who does not see colour loses nothing.
WORDS: dict[str, str] = {"good": "passed", "warn": "attention", "bad": "failed", "info": "stated"}


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of plain text."""

    text: str
    tone: Tone = ""


@dataclass(frozen=True)
class Items:
    """A list of short texts under an introduction."""

    intro: str
    entries: tuple[str, ...]


@dataclass(frozen=True)
class Sentence:
    """A sentence of the verdict.

    Attributes
    ----------
    subject : str
        What it is about, two or three words.
    text : str
        The sentence: number, limit, meaning.
    tone : {"good", "warn", "bad", "info"}
        Colour; `WORDS` has the word that goes with it.
    link : str
        Section with the details.
    """

    subject: str
    text: str
    tone: Tone = "info"
    link: str = ""


@dataclass(frozen=True)
class Verdict:
    """The sentences that come first."""

    sentences: tuple[Sentence, ...]


@dataclass(frozen=True)
class Column:
    """A column of a table: its name, unit and meaning, and whether it holds numbers (right) or words (left)."""

    name: str
    unit: str = ""
    meaning: str = ""
    align: Literal["right", "left"] = "right"


@dataclass(frozen=True)
class Cell:
    """A table cell with a colour; its text says the same in words."""

    text: str
    tone: Tone = ""


@dataclass(frozen=True)
class DataTable:
    """A table.

    Attributes
    ----------
    caption : str
    columns : tuple of Column
    rows : tuple of tuples of str or Cell
        Numbers are already rounded; an empty string is "does not apply". A first cell may have a second line: what the row is about.
    note : str
        What the reader must know, below the table.
    folded : bool
        Whether a page may show it on demand only.
    """

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str | Cell, ...], ...]
    note: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Figure:
    """A figure: file name without extension, title, caption, a text alternative, and the SVG."""

    name: str
    title: str
    caption: str
    alt: str
    svg: str


@dataclass(frozen=True)
class Interactive:
    """A view in space that a page with scripts lets the reader turn; a figure before it shows the same without.

    Attributes
    ----------
    name, title, caption, alt : str
        As those of a figure.
    data : str
        The scene, see `baarda.report.scene.Scene.to_json`.
    """

    name: str
    title: str
    caption: str
    alt: str
    data: str


Block = Paragraph | Items | Verdict | DataTable | Figure | Interactive


@dataclass(frozen=True)
class Section:
    """A section with an anchor, a title and blocks."""

    id: str
    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class SectionMaker:
    """A member: where its section stands, what it is called, and the function that lays it out.

    Attributes
    ----------
    order : int
        Sections are sorted by it.
    id : str
        Anchor: lower-case letters and hyphens.
    title : str
    build : callable
        ``analysis -> blocks``; nothing (None or empty) where the section does not apply.
    """

    order: int
    id: str
    title: str
    build: Callable[[Analysis], Sequence[Block] | None]

    def make(self, analysis: Analysis) -> Section | None:
        """Return the section of an analysis, None where it does not apply."""
        blocks = self.build(analysis)
        return translated(Section(self.id, self.title, tuple(blocks))) if blocks else None


def say(template: str, **fields: Any) -> str:
    """Fill the named fields of a sentence; translations replace the template before it is filled.

    Parameters
    ----------
    template : str
        A sentence with ``{name}`` fields, in English.
    **fields
        Values, already rounded.

    Returns
    -------
    str

    Examples
    --------
    >>> say("{count} of {total} observations", count=3, total=40)
    '3 of 40 observations'
    """
    return tr(template).format(**fields)


_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)")
#: Columns whose cells are names from the source: never translated.
_NAMES = {"point", "image", "camera", "from", "to", "observation", "parameter", "unknown", "a", "b"}


def translated(section: Section) -> Section:
    """Return a section with its fixed texts in the current language: titles, captions, columns, words in cells.

    Sentences with fields were translated when they were filled, see `say`; names from the source stay as they are.

    Parameters
    ----------
    section : Section

    Returns
    -------
    Section

    Examples
    --------
    >>> translated(Section("verdict", "Verdict", ())).title
    'Verdict'
    """
    if current() == "en":
        return section
    return replace(section, title=tr(section.title), blocks=tuple(_translated(b) for b in section.blocks))


def told(text: str) -> str:
    """Translate a text that was composed elsewhere.

    A fixed text, or one that is fixed but for its numbers (the catalogue has ``{0}``, ``{1}``, ... in their place), else what it is joined
    from, the longest parts first; a name in the first of two lines stays.

    Parameters
    ----------
    text : str

    Returns
    -------
    str

    Examples
    --------
    >>> from baarda.report.translation import language
    >>> with language("de"):
    ...     told("Null law by 999 simulated adjustments of normal errors, seed 0.")
    'Nullverteilung aus 999 simulierten Ausgleichungen normaler Fehler, Startwert 0.'
    """
    known = _numbered(text)
    if known != text or not any(mark in text for mark in (". ", ": ", "\n", " [", "] ")):
        return known
    head, line, rest = text.partition("\n")
    if line:
        return f"{head}\n{told(rest)}"
    head, mark, rest = text.partition("] ")
    if mark and head.startswith("[") and head[1:].isdigit():
        return f"{head}{mark}{told(rest)}"
    rest, _, mark = text.rpartition(" [")
    if rest and mark.rstrip("]").isdigit():
        return f"{told(rest)} [{mark}"
    parts, out, at = re.split(r"(?<=[.:]) ", text), [], 0
    while at < len(parts):
        tried = ((end, " ".join(parts[at:end])) for end in range(len(parts), at, -1))
        end, said = next(((e, _part(s)) for e, s in tried if _part(s) != s), (at + 1, parts[at]))
        out.append(said)
        at = end
    return " ".join(out)


def _part(text: str) -> str:
    """Translate one of several sentences: its text as it stands, or as it is joined to an earlier one by a blank."""
    known = _numbered(text)
    return known if known != text else _numbered(f" {text}")[1:]


def _numbered(text: str) -> str:
    known = tr(text)
    if known != text or "{" in text:
        return known
    found: list[str] = []

    def place(match: re.Match[str]) -> str:
        found.append(match[0])
        return f"{{{len(found) - 1}}}"

    key = _NUMBER.sub(place, text)
    known = tr(key)
    return known.format(*found) if found and known != key else text


def _translated(block: Block) -> Block:
    if isinstance(block, Paragraph):
        return replace(block, text=told(block.text))
    if isinstance(block, Items):
        return replace(block, intro=tr(block.intro), entries=tuple(told(e) for e in block.entries))
    if isinstance(block, Verdict):
        return Verdict(tuple(replace(s, subject=tr(s.subject), text=tr(s.text)) for s in block.sentences))
    if isinstance(block, (Figure, Interactive)):
        return replace(block, title=tr(block.title), caption=told(block.caption), alt=told(block.alt))
    said = [c.name not in _NAMES for c in block.columns]
    rows = tuple(tuple(_word(cell) if word else cell for cell, word in zip(row, said, strict=True)) for row in block.rows)
    columns = tuple(replace(c, name=tr(c.name), unit=tr(c.unit), meaning=tr(c.meaning)) for c in block.columns)
    return replace(block, caption=tr(block.caption), note=told(block.note), columns=columns, rows=rows)


def _word(cell: str | Cell) -> str | Cell:
    return replace(cell, text=told(cell.text)) if isinstance(cell, Cell) else told(cell)
