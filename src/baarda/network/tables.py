"""Columns of results with names and units, and the doors to data frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from baarda.errors import MissingExtra, UsageError


@dataclass(frozen=True)
class Table:
    """A frozen table: named columns of equal length, with the unit of each where it has one.

    Examples
    --------
    >>> t = Table({"point": np.array(["1", "2"]), "X": np.array([1.0, 2.0])}, {"X": "m"})
    >>> len(t), float(t["X"].sum()), next(iter(t.rows()))
    (2, 3.0, {'point': '1', 'X': 1.0})
    """

    columns: Mapping[str, np.ndarray[Any, Any]]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        lengths = {len(c) for c in self.columns.values()}
        if len(lengths) > 1:
            raise UsageError(f"columns of different lengths: { {k: len(c) for k, c in self.columns.items()} }")

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def __getitem__(self, name: str) -> np.ndarray[Any, Any]:
        return self.columns[name]

    def rows(self) -> Iterator[dict[str, Any]]:
        """Iterate over the rows as dictionaries of plain Python values."""
        names = list(self.columns)
        for values in zip(*(c.tolist() for c in self.columns.values()), strict=True):
            yield dict(zip(names, values, strict=True))

    def to_pandas(self) -> Any:
        """Return a pandas data frame (pandas must be installed)."""
        try:
            import pandas
        except ImportError:
            raise MissingExtra("pandas", "to_pandas()") from None
        return pandas.DataFrame(dict(self.columns))

    def to_polars(self) -> Any:
        """Return a polars data frame (polars must be installed)."""
        try:
            import polars
        except ImportError:
            raise MissingExtra("polars", "to_polars()") from None
        return polars.DataFrame(dict(self.columns))

    def to_arrow(self) -> Any:
        """Return an Arrow table (the extra 'tables')."""
        try:
            import pyarrow
        except ImportError:
            raise MissingExtra("tables", "to_arrow()") from None
        return pyarrow.table({k: pyarrow.array(c.tolist()) for k, c in self.columns.items()})
