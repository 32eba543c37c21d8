"""XML from strangers: bounded, without document types and entities, with the line of every element."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError
from baarda.formats.base import label_problem, number, whole_number

Floats = NDArray[np.float64]

DEEPEST = 40
LARGEST = 1e15  # of a number: a geocentric coordinate times 1e8


@dataclass
class Element:
    """An element: its name, attributes, text, children, and where it stands."""

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list[Element] = field(default_factory=list)
    pieces: list[str] = field(default_factory=list)

    def error(self, message: str) -> InputError:
        """Return an error that names file, line and element."""
        return InputError(f"<{self.tag}>: {message}", self.file, self.line)

    @property
    def text(self) -> str:
        """The text of the element itself, without white space at its ends."""
        return "".join(self.pieces).strip()

    def all(self, *way: str) -> list[Element]:
        """Return the elements at the end of a way of names."""
        found = [self]
        for tag in way:
            found = [c for f in found for c in f.children if c.tag == tag]
        return found

    def first(self, *way: str) -> Element | None:
        """Return the first element at the end of a way of names, None where there is none."""
        found = self.all(*way)
        return found[0] if found else None

    def need(self, *way: str) -> Element:
        """Return the first element at the end of a way of names, or fail."""
        found = self.first(*way)
        if found is None:
            raise self.error(f"<{'/'.join(way)}> is missing")
        return found

    def word(self, name: str, default: str | None = None) -> str:
        """Return an attribute that is not empty and holds no control characters."""
        value = self.attributes.get(name, "").strip()
        if not value:
            if default is not None:
                return default
            raise self.error(f"attribute {name} is missing")
        problem = label_problem(value, name)
        if problem:
            raise self.error(problem)
        return value

    def value(self, name: str, default: float | None = None) -> float:
        """Return an attribute as a finite number."""
        if default is not None and not self.attributes.get(name, "").strip():
            return default
        return self._number(self.word(name), name)

    def whole(self, name: str) -> int:
        """Return an attribute as a whole number."""
        text = self.word(name)
        try:
            return whole_number(text)
        except ValueError:
            raise self.error(f"{name} is not a whole number: {text!r:.60}") from None

    def flag(self, name: str, default: bool) -> bool:
        """Return an attribute that is true or false, 1 or 0."""
        text = self.attributes.get(name, "").strip().lower()
        if text in ("", "true", "1", "false", "0"):
            return default if not text else text in ("true", "1")
        raise self.error(f"{name} must be true or false, not {text!r:.60}")

    def numbers(self, count: int) -> Floats:
        """Return the text as so many finite numbers."""
        fields = self.text.split()
        if len(fields) != count:
            raise self.error(f"{len(fields)} numbers where {count} are expected")
        return np.array([self._number(f, "the text") for f in fields])

    def _number(self, text: str, what: str) -> float:
        try:
            value = number(text)
        except ValueError:
            raise self.error(f"{what} is not a number: {text!r:.60}") from None
        if not abs(value) <= LARGEST:
            raise self.error(f"{what} is not finite or too large: {text!r:.60}")
        return value


def parse_xml(data: bytes, file: Path) -> Element:
    """Return the root element of an XML text.

    Parameters
    ----------
    data : bytes
    file : Path
        For messages.

    Raises
    ------
    InputError
        With file and line if it is not well-formed, nested more than 40 deep, or declares a document type or an entity.

    Examples
    --------
    >>> root = parse_xml(b'<a><b x="1">2 3</b></a>', Path("x.xml"))
    >>> root.need("b").value("x"), root.need("b").numbers(2).tolist()
    (1.0, [2.0, 3.0])
    """
    top = Element("", {}, file, 1)
    stack = [top]
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def begin(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > DEEPEST:
            raise InputError(f"elements are nested more than {DEEPEST} deep", file, parser.CurrentLineNumber)
        element = Element(tag, attributes, file, parser.CurrentLineNumber)
        stack[-1].children.append(element)
        stack.append(element)

    def declaration(*_: Any) -> None:
        raise InputError("a document type or entity declaration is not accepted", file, parser.CurrentLineNumber)

    handlers: dict[str, Callable[..., Any]] = {
        "StartElementHandler": begin,
        "EndElementHandler": lambda tag: stack.pop(),
        "CharacterDataHandler": lambda text: stack[-1].pieces.append(text),
        "StartDoctypeDeclHandler": declaration,
        "EntityDeclHandler": declaration,
    }
    for name, handler in handlers.items():
        setattr(parser, name, handler)
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise InputError(f"not well-formed XML: {expat.errors.messages[error.code]}", file, error.lineno) from None
    except (LookupError, ValueError) as error:  # an encoding that Python does not know
        raise InputError(f"not an XML text that can be read: {error}", file) from None
    return top.children[0]
