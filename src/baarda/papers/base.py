"""The contract of papers: what reproducing one gives, printed value beside ours, and the reason where they differ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from baarda.errors import UsageError

Value = float | str


@dataclass(frozen=True)
class Reason:
    """Why a printed value and ours differ: a short code for tables, and the sentence behind it."""

    code: str
    text: str


@dataclass(frozen=True)
class Row:
    """One value of a paper beside ours.

    Attributes
    ----------
    labels : tuple of str
        What it is: one entry per label column of the comparison.
    printed : float, str or None
        The paper's value; None where the paper prints none. A decision is a word.
    ours : float or str
        Our value.
    decimals : int
        Decimals that the paper prints; within half a unit of the last one the values agree.
    reason : Reason or None
        Why they differ.
    remark : str
        What a reader must know of this row beyond the reason.

    Raises
    ------
    UsageError
        If the values differ and no reason is given, or agree and one is given.

    Examples
    --------
    >>> Row(("critical value",), 16.92, 16.91898).agrees
    True
    """

    labels: tuple[str, ...]
    printed: Value | None
    ours: Value
    decimals: int = 2
    reason: Reason | None = None
    remark: str = ""

    def __post_init__(self) -> None:
        for name in ("printed", "ours"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                object.__setattr__(self, name, float(value))  # NumPy numbers are no JSON
        if self.agrees == (self.reason is not None):
            what = "agree and carry a reason" if self.agrees else "differ without a reason"
            raise UsageError(f"{' / '.join(self.labels)}: printed {self.printed} and ours {self.ours} {what}")

    @property
    def difference(self) -> float | None:
        """Ours minus printed; None where one of them is no number."""
        if isinstance(self.printed, str) or isinstance(self.ours, str) or self.printed is None:
            return None
        return self.ours - self.printed

    @property
    def agrees(self) -> bool:
        """Whether ours, rounded as the paper rounds, is the printed value; True where nothing is printed."""
        return _agree(self.printed, self.ours, self.decimals)


def _agree(printed: Value | None, ours: Value, decimals: int) -> bool:
    if printed is None or isinstance(printed, str) or isinstance(ours, str):
        return printed is None or printed == ours
    return abs(ours - printed) <= 0.5 * 10.0**-decimals * (1.0 + 1e-9)


def row(
    labels: tuple[str, ...], printed: Value | None, ours: Value, decimals: int = 2, reason: Reason | None = None, remark: str = ""
) -> Row:
    """Return a row; the reason is kept only where the values differ.

    Examples
    --------
    >>> old = Reason("old tables", "Read from tables of the time.")
    >>> row(("lineo",), 12.01, 14.041, reason=old).reason == old, row(("lineo",), 14.04, 14.041, reason=old).reason
    (True, None)
    """
    return Row(labels, printed, ours, decimals, None if _agree(printed, ours, decimals) else reason, remark)


@dataclass(frozen=True)
class Comparison:
    """One table of a paper beside ours.

    Attributes
    ----------
    table : str
        Anchor and file name: lower-case letters, digits, hyphens.
    title : str
    columns : tuple of str
        Names of the label columns.
    rows : tuple of Row
    note : str
        With which inputs and choices ours was computed.
    heads : tuple of str
        What the two value columns are called.
    """

    table: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    heads: tuple[str, str] = ("printed", "ours")

    def __post_init__(self) -> None:
        for r in self.rows:
            if len(r.labels) != len(self.columns):
                raise UsageError(f"{self.table}: row {r.labels} does not fit the columns {self.columns}")

    def value(self, *labels: str) -> Value:
        """Return our value of a row by its labels.

        Raises
        ------
        UsageError
            If there is not exactly one such row.
        """
        return self.row(*labels).ours

    def row(self, *labels: str) -> Row:
        """Return the row with these labels.

        Raises
        ------
        UsageError
            If there is not exactly one such row.
        """
        found = [r for r in self.rows if r.labels == labels]
        if len(found) != 1:
            raise UsageError(f"{self.table} has {len(found)} rows {labels}")
        return found[0]

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The reasons that occur, in order of appearance."""
        return tuple(dict.fromkeys(r.reason for r in self.rows if r.reason is not None))


@dataclass(frozen=True)
class Figure:
    """A figure: file name without extension, title, caption, a text alternative, and an ``<svg>`` element."""

    name: str
    title: str
    caption: str
    alt: str
    svg: str


@dataclass(frozen=True)
class Reproduction:
    """What running a paper gives.

    Attributes
    ----------
    comparisons : tuple of Comparison
    figures : tuple of Figure
    sentences : tuple of str
        The outcome in plain sentences.
    name, title, reference : str
        Those of the paper.
    """

    comparisons: tuple[Comparison, ...]
    figures: tuple[Figure, ...]
    sentences: tuple[str, ...]
    name: str = ""
    title: str = ""
    reference: str = ""

    def comparison(self, table: str) -> Comparison:
        """Return a comparison by the name of its table.

        Raises
        ------
        UsageError
            If there is none.
        """
        for c in self.comparisons:
            if c.table == table:
                return c
        raise UsageError(f"no table {table!r}; there are {', '.join(c.table for c in self.comparisons)}")


@dataclass(frozen=True)
class Paper:
    """A member: a paper and the function that recomputes it.

    Attributes
    ----------
    name : str
        What ``baarda reproduce`` is told.
    title : str
    reference : str
        Authors, journal, year.
    run : callable
        Recomputes everything; the same result at every call.
    """

    name: str
    title: str
    reference: str
    run: Callable[[], Reproduction]
