"""Papers recomputed: one file per paper, printed value beside ours, and the reason where they differ."""

from __future__ import annotations

from functools import cache

from baarda.papers._page import html, render_text, write
from baarda.papers.base import Comparison, Figure, Paper, Reason, Reproduction, Row

__all__ = ["Comparison", "Figure", "Paper", "Reason", "Reproduction", "Row", "html", "paper", "papers", "render_text", "write"]


@cache
def papers() -> dict[str, Paper]:
    """Return all papers by name.

    Examples
    --------
    >>> "maarek-konecny" in papers()
    True
    """
    from baarda.discover import members

    return {m.name: m for m in members(__name__, Paper) if isinstance(m, Paper)}


def paper(name: str) -> Paper:
    """Return a paper by name.

    Raises
    ------
    UsageError
        If there is none of that name; the message lists the names.

    Examples
    --------
    >>> paper("maarek-konecny").title
    'Modulated Normal Distribution'
    """
    from baarda.errors import UsageError

    known = papers()
    if name not in known:
        raise UsageError(f"no paper named {name!r}; there are: {', '.join(known)}")
    return known[name]
