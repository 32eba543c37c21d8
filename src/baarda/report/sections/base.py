"""The contract of report sections: what a section is made of, and the maker that a member file defines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from baarda.procedures.testing import Analysis

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


Block = Paragraph | Items | Verdict | DataTable | Figure


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
        return Section(self.id, self.title, tuple(blocks)) if blocks else None


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
    return template.format(**fields)
