"""JSON from strangers: bounded, strict, with the line of every value that cannot be used.

Texts are parsed at once by the standard library; only when a value is wrong, the text is walked again to find its line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError
from baarda.formats.base import label_problem, read_text

Floats = NDArray[np.float64]

LARGEST = 1e12  # of a number in a model: squares must not overflow
_BLANKS = re.compile(r"[ \t\n\r]*")
_DECODER = json.JSONDecoder()


class _Refused(ValueError):
    pass


def _constant(text: str) -> Any:
    raise _Refused(f"{text} is not a JSON number")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) < len(pairs):
        keys = [k for k, _ in pairs]
        raise _Refused(f"key {next(k for k in keys if keys.count(k) > 1)!r} appears twice in one object")
    return out


@dataclass(frozen=True)
class Json:
    """A value of a JSON text and the way that leads to it.

    Attributes
    ----------
    value : object
    file : Path
    text : str
        The whole text.
    way : tuple of str and int
        Keys and positions from the root.
    """

    value: Any
    file: Path
    text: str
    way: tuple[str | int, ...] = ()

    def error(self, message: str) -> InputError:
        """Return an error that names file, line and key."""
        where = ".".join(str(w) for w in self.way)
        return InputError(f"{where}: {message}" if where else message, self.file, line_of(self.text, self.way))

    def at(self, key: str | int) -> Json:
        """Return an entry that is known to be there."""
        return Json(self.value[key], self.file, self.text, (*self.way, key))

    def get(self, key: str) -> Json | None:
        """Return an entry of an object, None where it is absent or null."""
        self.object()
        return self.at(key) if self.value.get(key) is not None else None

    def need(self, key: str) -> Json:
        """Return an entry of an object, or fail with its name."""
        found = self.get(key)
        if found is None:
            raise self.error(f"{key!r} is missing")
        return found

    def object(self) -> dict[str, Any]:
        """Return an object."""
        if not isinstance(self.value, dict):
            raise self.error(f"must be an object, not {_kind(self.value)}")
        return self.value

    def array(self) -> list[Any]:
        """Return an array."""
        if not isinstance(self.value, list):
            raise self.error(f"must be an array, not {_kind(self.value)}")
        return self.value

    def entries(self) -> Iterator[tuple[str, Json]]:
        """Iterate over keys and values of an object."""
        for key in self.object():
            yield key, self.at(key)

    def items(self) -> Iterator[Json]:
        """Iterate over the values of an array."""
        for i in range(len(self.array())):
            yield self.at(i)

    def word(self) -> str:
        """Return a text without control characters, or fail."""
        if not isinstance(self.value, str):
            raise self.error(f"must be a text, not {_kind(self.value)}")
        problem = label_problem(self.value, "the text")
        if problem:
            raise self.error(problem)
        return self.value

    def label(self) -> str:
        """Return a label: a text that is not empty, or a whole number."""
        if isinstance(self.value, int) and not isinstance(self.value, bool):
            return str(self.value)
        text = self.word()
        if not text.strip():
            raise self.error("the label is empty")
        return text

    def number(self) -> float:
        """Return a finite number, or fail."""
        v = self.value
        if isinstance(v, bool) or not isinstance(v, (int, float)):
            raise self.error(f"must be a number, not {_kind(v)}")
        if not abs(v) <= LARGEST:
            raise self.error(f"{v!r:.40} is beyond {LARGEST:g}")
        return float(v)

    def whole(self, low: int, high: int) -> int:
        """Return a whole number in [low, high], or fail."""
        v = self.value
        if isinstance(v, bool) or not isinstance(v, int) or not low <= v <= high:
            raise self.error(f"must be a whole number from {low} to {high}, not {v!r:.40}")
        return v

    def numbers(self, *shape: int) -> Floats:
        """Return an array of finite numbers of this shape, or fail; a nested or a flat array."""
        size = math.prod(shape)
        try:
            out = np.array(self.value, dtype=float) if isinstance(self.value, list) else np.zeros(0)
            plain = out.shape in (shape, (size,)) and not _odd(self.value)
        except (ValueError, TypeError, OverflowError):
            plain = False
        if not plain:
            raise self.error(f"must be {' x '.join(map(str, shape))} numbers")
        if not (np.abs(out) <= LARGEST).all():
            raise self.error(f"a number is not finite or beyond {LARGEST:g}")
        return out.reshape(shape)


def _odd(value: Any) -> bool:
    """Return whether an array holds what NumPy would take for a number and JSON does not."""
    return any(_odd(v) if isinstance(v, list) else isinstance(v, (bool, str)) or v is None for v in value)


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "an array", str: "a text", bool: "true or false", type(None): "null"}
    return names.get(type(value), "a number")


def read_json(path: Path) -> Json:
    """Read a JSON file.

    Raises
    ------
    InputError
        With file and line if it is not JSON: NaN, infinities, doubled keys and endless nesting are refused, too.
    """
    return parse_json(read_text(path), path)


def parse_json(text: str, path: Path) -> Json:
    """Return the root of a JSON text; see `read_json`.

    Examples
    --------
    >>> root = parse_json('{"a": [1, 2]}', Path("x.json"))
    >>> root.need("a").numbers(2).tolist()
    [1.0, 2.0]
    """
    try:
        return Json(json.loads(text, parse_constant=_constant, object_pairs_hook=_object), path, text)
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error.msg}", path, error.lineno) from None
    except RecursionError:
        raise InputError("not JSON that can be used: it is nested too deeply", path) from None
    except _Refused as error:
        raise InputError(f"not JSON that can be used: {error}", path, _line_of_word(text, str(error))) from None
    except ValueError:  # of int(): more digits than Python converts
        raise InputError("not JSON that can be used: a whole number has too many digits", path) from None


def _line_of_word(text: str, message: str) -> int | None:
    """Return the line of a constant, or of the second of two equal keys where there are no more."""
    if message.startswith("key"):
        key = json.dumps(message.removeprefix("key ").removesuffix(" appears twice in one object").strip("'\""), ensure_ascii=False)
        found = [m.start() for m in re.finditer(re.escape(key) + r"\s*:", text)]
        return text.count("\n", 0, found[1]) + 1 if len(found) == 2 else None
    at = re.search(r"(?<![\w\"])" + re.escape(message.split(" ")[0]), text)
    return text.count("\n", 0, at.start()) + 1 if at else None


def line_of(text: str, way: tuple[str | int, ...]) -> int:
    r"""Return the line of a value of a JSON text, or that of the innermost part of the way that exists.

    Examples
    --------
    >>> line_of('{"a": 1,\n "b": [3,\n  4]}', ("b", 1))
    3
    """
    at = _skip(text, 0)
    for part in way:
        found = _entry(text, at, part)
        if found is None:
            break
        at = found
    return text.count("\n", 0, at) + 1


def _skip(text: str, at: int) -> int:
    found = _BLANKS.match(text, at)
    return found.end() if found else at


def _entry(text: str, at: int, part: str | int) -> int | None:
    """Return where an entry of the object or array at `at` begins; the text is known to be valid JSON."""
    is_object = text[at] == "{"
    if text[at] not in "{[" or isinstance(part, str) != is_object:
        return None
    at, count = _skip(text, at + 1), 0
    while text[at] not in "}]":
        key: str | int = count
        if is_object:
            key, at = _DECODER.raw_decode(text, at)
            at = _skip(text, _skip(text, at) + 1)  # the colon
        if key == part:
            return at
        at = _skip(text, _DECODER.raw_decode(text, at)[1])
        at = _skip(text, at + 1) if text[at] == "," else at
        count += 1
    return None
