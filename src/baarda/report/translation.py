"""The language of a report: templates are translated before their fields are filled; JSON and tables stay English."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import resources

from baarda.errors import InputError, UsageError

__all__ = ["LANGUAGES", "catalogue", "check_language", "current", "language", "parse_catalogue", "tr"]

LANGUAGES = ("en", "de")
_CURRENT: ContextVar[str] = ContextVar("baarda_language", default="en")
_STRING = re.compile(r'"((?:[^"\\]|\\.)*)"')
_ESCAPES = {"n": "\n", "t": "\t", '"': '"', "\\": "\\"}


def check_language(code: str) -> str:
    """Return a language that the report speaks.

    Parameters
    ----------
    code : str

    Returns
    -------
    str

    Raises
    ------
    UsageError
        If it is not one of `LANGUAGES`.

    Examples
    --------
    >>> check_language("de")
    'de'
    """
    if code not in LANGUAGES:
        raise UsageError(f"--language is {' or '.join(LANGUAGES)}, not {code!r}")
    return code


def current() -> str:
    """Return the language in which text is made at present."""
    return _CURRENT.get()


@contextmanager
def language(code: str) -> Iterator[None]:
    """Make all text of the report in this language inside of a ``with`` block.

    Parameters
    ----------
    code : str

    Raises
    ------
    UsageError
        If it is not one of `LANGUAGES`.

    Examples
    --------
    >>> with language("de"):
    ...     print(tr("Verdict"))
    Urteil
    """
    token = _CURRENT.set(check_language(code))
    try:
        yield
    finally:
        _CURRENT.reset(token)


def tr(text: str) -> str:
    """Return a fixed text or a template in the current language; the English one where the catalogue has none.

    Parameters
    ----------
    text : str
        The English text, with ``{name}`` fields still open.

    Returns
    -------
    str

    Examples
    --------
    >>> tr("Verdict")
    'Verdict'
    """
    code = _CURRENT.get()
    return text if code == "en" else catalogue(code).get(text, text)


@cache
def catalogue(code: str) -> dict[str, str]:
    """Return the texts of a language by their English text.

    Parameters
    ----------
    code : str

    Returns
    -------
    dict of str
    """
    folder = resources.files("baarda.report") / "texts"
    return parse_catalogue((folder / f"{code}.po").read_text(encoding="utf-8"), f"{code}.po")


def parse_catalogue(text: str, file: str = "") -> dict[str, str]:
    r"""Return the entries of a gettext catalogue: ``msgid`` and ``msgstr``, strings over several lines, no contexts, no plurals.

    Parameters
    ----------
    text : str
    file : str
        Named in messages.

    Returns
    -------
    dict of str
        Entries without translation are left out.

    Raises
    ------
    InputError
        If a line is none of a catalogue, or an entry comes twice.

    Notes
    -----
    GNU gettext manual, "The Format of PO Files".

    Examples
    --------
    >>> parse_catalogue('msgid "one "\n"word"\nmsgstr "ein Wort"\n')
    {'one word': 'ein Wort'}
    """
    entries: list[list[str]] = []
    part = -1
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.strip()
        if not words or words.startswith("#"):
            continue
        key, _, rest = words.partition(" ") if not words.startswith('"') else ("", "", words)
        found = _STRING.fullmatch(rest.strip())
        if found is None or key not in ("", "msgid", "msgstr") or (key != "msgid" and part < 0):
            raise InputError("is no msgid, msgstr, string or comment", file or None, number)
        if key == "msgid":
            entries.append(["", ""])
        part = {"msgid": 0, "msgstr": 1, "": part}[key]
        entries[-1][part] += re.sub(r"\\(.)", lambda m: _ESCAPES.get(m[1], m[1]), found[1])
    out: dict[str, str] = {}
    for source, target in entries:
        if source in out:
            raise InputError(f"translates {source!r} twice", file or None)
        if source and target:
            out[source] = target
    return out
