"""Laws that several tests share: F or chi-square by redundancy, laws that differ from member to member, bounded quadratic forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from baarda.errors import RedundancyNotPositive, UsageError
from baarda.hypotheses.base import Floats, Law, simulated_rank


def check_redundancy(redundancy: float) -> None:
    """Raise RedundancyNotPositive unless r > 0."""
    if not redundancy > 0:
        raise RedundancyNotPositive(f"the redundancy is {redundancy:g}: nothing can be tested")


def check_variance(value: float, name: str) -> None:
    """Raise UsageError unless a variance (factor) is positive and finite."""
    if not (value > 0.0 and np.isfinite(value)):
        raise UsageError(f"{name} must be positive and finite, not {value!r}")


def number(value: float) -> str:
    """Return a degree of freedom as text: whole numbers without a fraction."""
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.6g}"


def f_law(b: Any, redundancy: Any) -> Any:
    """Return F(b, r), and its limit chi-square(b)/b where r is infinite (variance factor known)."""
    b, r = np.broadcast_arrays(np.asarray(b, dtype=float), np.asarray(redundancy, dtype=float))
    if np.isinf(r).all():
        return stats.chi2(b, scale=1.0 / b) if b.ndim else stats.chi2(float(b), scale=1.0 / float(b))
    if np.isinf(r).any():
        raise UsageError("the redundancy of a family is either known (finite) for all tests or for none")
    return stats.f(b, r) if b.ndim else stats.f(float(b), float(r))


def f_name(b: float, redundancy: float) -> str:
    """Return the name of `f_law`."""
    return f"chi2({number(b)}) / {number(b)}" if np.isinf(redundancy) else f"F({number(b)}, {number(redundancy)})"


@dataclass(frozen=True)
class BoundedLaw:
    """Law of T = R / (b s0^2) where R is a part of v'Pv = r s0^2: (r / b) Beta(b/2, (r - b)/2).

    Attributes
    ----------
    b : (k,) array or float
        Rank of R.
    redundancy : float
        r.

    Notes
    -----
    R and v'Pv - R are independent chi-squares of b and r - b degrees of freedom; (r - b) R / (b (v'Pv - R)) ~ F(b, r - b) gives the same
    p-value. For b = 1 this is the square of Pope's tau. Where b = r, T is 1 always and nothing can be tested (p = 1).
    """

    b: Any
    redundancy: float

    def _beta(self) -> Any:
        b, rest = np.asarray(self.b, dtype=float), self.redundancy - np.asarray(self.b, dtype=float)
        return stats.beta(b / 2.0, np.where(rest > 0.5, rest, 1.0) / 2.0)

    def _whole(self) -> Any:
        return self.redundancy - np.asarray(self.b, dtype=float) <= 0.5  # b = r up to rounding of a trace

    def cdf(self, x: Any) -> Any:
        """Return P(T <= x)."""
        x = np.asarray(x, dtype=float)
        return np.where(self._whole(), np.where(x >= 1.0 - 1e-9, 1.0, 0.0), self._beta().cdf(x * self.b / self.redundancy))[()]

    def sf(self, x: Any) -> Any:
        """Return P(T >= x)."""
        x = np.asarray(x, dtype=float)
        return np.where(self._whole(), np.where(x <= 1.0 + 1e-9, 1.0, 0.0), self._beta().sf(x * self.b / self.redundancy))[()]

    def ppf(self, q: Any) -> Any:
        """Return the quantile."""
        return np.where(self._whole(), 1.0, self._beta().ppf(q) * self.redundancy / np.asarray(self.b, dtype=float))[()]


@dataclass(frozen=True)
class SimulatedFamily:
    """Simulated laws of the members of a family: the elementwise twin of `SimulatedLaw`.

    Attributes
    ----------
    values : (B, k) array
        The statistics of each simulated data set, sorted ascending along the first axis.
    """

    values: Floats

    def cdf(self, x: Any) -> Any:
        """Return P(T_j <= x_j), never zero."""
        return self._rank(x, "right")

    def sf(self, x: Any) -> Any:
        """Return P(T_j >= x_j), never zero."""
        n = len(self.values)
        return (2.0 + n) / (n + 1.0) - self._rank(x, "left")

    def ppf(self, q: Any) -> Any:
        """Return the quantile of each member."""
        n, k = self.values.shape
        rank = int(simulated_rank(q, n))
        return self.values[rank] if 0 <= rank < n else np.full(k, np.inf if rank >= n else -np.inf)

    def _rank(self, x: Any, side: Any) -> Floats:
        n, k = self.values.shape
        x = np.broadcast_to(np.asarray(x, dtype=float), (k,))
        below = [np.searchsorted(self.values[:, j], x[j], side=side) for j in range(k)]
        return np.asarray((1.0 + np.asarray(below, dtype=float)) / (n + 1.0))


@dataclass(frozen=True)
class MemberLaws:
    """Laws that differ from member to member of a family; probabilities are elementwise.

    Attributes
    ----------
    laws : Law
        Elementwise law.
    extreme : int
        Index of the member with the smallest p-value: `ppf`, and so the critical value of the result, is that member's.
    """

    laws: Law
    extreme: int

    def cdf(self, x: Any) -> Any:
        """Return P(T_j <= x_j)."""
        return self.laws.cdf(x)

    def sf(self, x: Any) -> Any:
        """Return P(T_j >= x_j)."""
        return self.laws.sf(x)

    def ppf(self, q: Any) -> Any:
        """Return the quantile of the extreme member."""
        return np.atleast_1d(self.laws.ppf(q))[self.extreme]


def member_laws(laws: Law, statistic: Floats, two_sided: bool) -> MemberLaws:
    """Return the laws of a family with the most extreme of its members singled out."""
    upper = np.asarray(laws.sf(statistic), dtype=float)
    p = np.minimum(upper, np.asarray(laws.cdf(statistic), dtype=float)) if two_sided else upper
    testable = np.where(np.isnan(p), np.inf, p)
    return MemberLaws(laws, int(np.argmin(testable)))


def same(values: ArrayLike) -> bool:
    """Return whether all numbers are equal."""
    v = np.asarray(values)
    return bool((v == v.flat[0]).all()) if v.size else True


def range_name(name: str, values: Sequence[float] | Floats) -> str:
    """Return ``name(value)``, or ``name(smallest .. largest)``, of a family's degrees of freedom."""
    v = np.asarray(values, dtype=float)
    return f"{name}({number(v.min())})" if same(v) else f"{name}({number(v.min())} .. {number(v.max())})"
