"""Grouping values into classes, and the counts that a law expects there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.distributions.base import Distribution, Floats
from baarda.errors import UsageError

Ends = Literal["open", "closed"]


@dataclass(frozen=True)
class Histogram:
    """Counts in classes, and what a law expects.

    Attributes
    ----------
    edges : (k+1,) array
        Class limits, ascending; a class contains its lower limit. Infinite outer limits are allowed.
    counts : (k,) array
        Observed counts.
    expected : (k,) array
        Expected counts under the law.
    ends : {"open", "closed"}
        Whether the outer classes reach to infinity when probabilities are taken, or stop at the outer limits.
    total : float
        The number of values that probabilities were multiplied with; with closed ends it may exceed the sum of the counts.
    """

    edges: Floats
    counts: Floats
    expected: Floats
    ends: Ends
    total: float

    @property
    def terms(self) -> Floats:
        """The contributions (F - T)^2 / T of the classes."""
        return (self.counts - self.expected) ** 2 / self.expected

    @property
    def chi_square(self) -> float:
        """The sum of the contributions."""
        return float(np.sum(self.terms))


def count(values: ArrayLike, edges: ArrayLike, ends: Ends = "open", *, is_sorted: bool = False) -> NDArray[np.int64]:
    """Count values in classes [b_j, b_(j+1)); the outer classes take everything beyond when the ends are open.

    Parameters
    ----------
    values : (n,) array
        Values; sorted ascending if `is_sorted` says so (then no pass over the values is needed).
    edges : (k+1,) array
        Class limits, ascending.
    ends : {"open", "closed"}
        What becomes of values outside the outer limits: taken by the outer classes, or refused.

    Returns
    -------
    (k,) array of int

    Raises
    ------
    UsageError
        If limits do not ascend, or the classes do not cover the values and their ends are closed.

    Examples
    --------
    >>> count([-3.0, 0.0, 0.5, 1.0, 9.0], [-1.0, 0.0, 1.0, 2.0])
    array([1, 2, 2])
    """
    x = np.asarray(values, dtype=float).ravel()
    b = check_edges(edges)
    if ends == "closed":
        low, high = (x[0], x[-1]) if is_sorted and x.size else (x.min(initial=np.inf), x.max(initial=-np.inf))
        if x.size and (low < b[0] or high > b[-1]):
            outside = int(np.sum((x < b[0]) | (x > b[-1])))
            raise UsageError(
                f"the classes from {b[0]:g} to {b[-1]:g} do not cover {outside} of {x.size} values (lowest {low:g}, highest {high:g})"
            )
    inner = b[1:-1]
    if is_sorted:
        cuts = np.searchsorted(x, inner, side="left")
        return np.diff(np.concatenate([[0], cuts, [x.size]])).astype(np.int64)
    return np.bincount(np.searchsorted(inner, x, side="right"), minlength=b.size - 1).astype(np.int64)


def check_edges(edges: ArrayLike) -> Floats:
    """Return class limits as an array, or raise `UsageError`: at least two, ascending, none missing."""
    b = np.asarray(edges, dtype=float).ravel()
    if b.size < 3:
        raise UsageError(f"{b.size} class limits given: at least three (two classes) are needed")
    if np.any(np.isnan(b)) or not np.all(np.diff(b) > 0.0):
        raise UsageError("class limits must ascend strictly")
    return b


def probabilities(distribution: Distribution, edges: ArrayLike, ends: Ends = "open") -> Floats:
    """Return the probability of each class, without cancellation in either tail.

    Parameters
    ----------
    distribution : Distribution
        The law with its values.
    edges : (k+1,) array
        Class limits.
    ends : {"open", "closed"}
        Whether the outer classes reach to infinity.

    Returns
    -------
    (k,) array

    Examples
    --------
    >>> from baarda.distributions import law
    >>> probabilities(law("normal")(), [-1.0, 0.0, 1.0]).round(6)
    array([0.5, 0.5])
    >>> probabilities(law("normal")(), [-1.0, 0.0, 1.0], "closed").round(6)
    array([0.341345, 0.341345])
    """
    b = np.array(edges, dtype=float)
    if ends == "open":
        b[0], b[-1] = -np.inf, np.inf
    lower, upper = distribution.cdf(b), distribution.sf(b)
    return np.asarray(np.where(lower[1:] < 0.5, np.diff(lower), -np.diff(upper)))


def equal_probability_edges(distribution: Distribution, classes: int) -> Floats:
    """Return the limits of classes that are equally probable under a law; the outer ones are infinite.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> equal_probability_edges(law("normal")(), 4).round(4)
    array([   -inf, -0.6745,  0.    ,  0.6745,     inf])
    """
    if classes < 2:
        raise UsageError(f"{classes} classes asked for: at least two are needed")
    return np.concatenate([[-np.inf], distribution.ppf(np.arange(1, classes) / classes), [np.inf]])


def equal_width_edges(values: ArrayLike, classes: int) -> Floats:
    """Return the limits of classes of equal width over the range of the values.

    Examples
    --------
    >>> equal_width_edges([0.0, 1.0, 3.0], 3)
    array([0., 1., 2., 3.])
    """
    x = np.asarray(values, dtype=float)
    if classes < 2:
        raise UsageError(f"{classes} classes asked for: at least two are needed")
    if not x.max() > x.min():
        raise UsageError("all values are equal: there is no range to divide into classes")
    return np.linspace(x.min(), x.max(), classes + 1)


def usual_number_of_classes(n: int, estimated: int = 0) -> int:
    """Return 2 n^(2/5) equally probable classes (Mann & Wald 1942, weakened), at least 5 expected values in each, at most 100."""
    return max(estimated + 2, min(int(2.0 * n**0.4), n // 5, 100))


def merge_small(edges: ArrayLike, counts: ArrayLike, expected: ArrayLike, least: float = 5.0) -> tuple[Floats, Floats, Floats]:
    """Merge classes from the outside inwards until every expected count reaches `least`.

    Parameters
    ----------
    edges : (k+1,) array
        Class limits.
    counts, expected : (k,) arrays
        Observed and expected counts.
    least : float
        Smallest expected count admitted.

    Returns
    -------
    edges, counts, expected
        The merged classes.

    Raises
    ------
    UsageError
        If fewer than two classes would remain.

    Examples
    --------
    >>> merge_small([0, 1, 2, 3, 4], [1, 9, 8, 0], [2.0, 9.0, 8.0, 1.0])[1]
    array([10.,  8.])
    """
    b, f, t = (np.array(x, dtype=float) for x in (edges, counts, expected))
    while f.size > 1 and t.min() < least:
        j = int(np.argmin(t))
        # towards the centre of mass: the neighbour on the inner side, or the smaller one in the middle
        left = j > 0 and (j == f.size - 1 or t[j - 1] <= t[j + 1])
        i = j - 1 if left else j
        f[i] += f[i + 1]
        t[i] += t[i + 1]
        f, t, b = np.delete(f, i + 1), np.delete(t, i + 1), np.delete(b, i + 1)
    if f.size < 2 or t.min() < least:
        raise UsageError(f"fewer than two classes remain when each must expect at least {least:g} values")
    return b, f, t
