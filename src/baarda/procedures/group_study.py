"""Groups of residuals, and whether they have the same variance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.distributions.base import Floats
from baarda.errors import UsageError
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.homogeneity import bartlett, variance_per_image
from baarda.procedures.law_study import StudyOptions

Ints = NDArray[np.intp]
UNCONTROLLED = 1e-10  # a residual whose redundancy number is below is zero by construction


@dataclass(frozen=True)
class Groups:
    """The groups of the values and the variance of each.

    Attributes
    ----------
    names : tuple of str
    codes : (n,) integer array
        Group of each controlled value.
    counts, means, variances, df : (k,) arrays
        Of the (weighted) residuals. The variance is that about the group's mean with n_g - 1 degrees of freedom, or, where redundancy
        numbers are given, v'Pv / r_g with r_g their sum; NaN without any.
    by_redundancy : bool
        Which of the two.
    tests : tuple of TestResult
        Bartlett (corrected), Bartlett as the paper has it, each group against the pooled variance, Brown-Forsythe; as far as they apply.
    """

    names: tuple[str, ...]
    codes: Ints
    counts: Ints
    means: Floats
    variances: Floats
    df: Floats
    by_redundancy: bool
    tests: tuple[TestResult, ...] = ()

    @property
    def tested(self) -> Ints:
        """Indices of the groups that have degrees of freedom and a variance."""
        return np.flatnonzero((self.df > UNCONTROLLED) & (self.variances > 0.0))

    def test(self, name: str) -> TestResult | None:
        """Return the test of this name."""
        return next((t for t in self.tests if t.name == name), None)


def coded(groups: Sequence[object] | NDArray[Any], names: Sequence[str], n: int) -> tuple[Ints, tuple[str, ...]]:
    """Return codes and names of groups, in the order of their first appearance when they come as labels.

    Parameters
    ----------
    groups : (n,) sequence
        Labels, or codes into `names`.
    names : sequence of str
        Empty when `groups` are labels.
    n : int
        Number of residuals.

    Returns
    -------
    codes : (n,) integer array
    names : tuple of str

    Raises
    ------
    UsageError
        If there is not one group per residual, or a code has no name.

    Examples
    --------
    >>> coded(["b", "a", "b"], (), 3)
    (array([0, 1, 0]), ('b', 'a'))
    """
    if len(groups) != n:
        raise UsageError(f"{len(groups)} groups for {n} residuals")
    if names:
        codes = np.asarray(groups)
        if codes.dtype.kind not in "iu" or (n and (codes.min() < 0 or codes.max() >= len(names))):
            raise UsageError(f"codes of groups are integers from 0 to {len(names) - 1}")
        return codes.astype(np.intp), tuple(names)
    index: dict[str, int] = {}
    coded = np.array([index.setdefault(str(g), len(index)) for g in groups], dtype=np.intp)
    return coded, tuple(index)


def study_groups(
    codes: Ints, names: tuple[str, ...], base: Floats, x: Floats, r: Floats | None, o: StudyOptions
) -> tuple[Groups, list[tuple[str, str]]]:
    """Compare the variances of groups.

    Parameters
    ----------
    codes : (n,) integer array
        Group of each value.
    names : tuple of str
    base : (n,) array
        Raw or weighted residuals.
    x : (n,) array
        The values studied, of equal variance.
    r : (n,) array or None
        Redundancy numbers; without them each group has its own mean and n_g - 1 degrees of freedom.
    o : StudyOptions

    Returns
    -------
    Groups
    left_out : list of (str, str)
        What could not be tested, and why.

    Notes
    -----
    Maarek & Konecny, section 2 and appendix 1.

    Examples
    --------
    >>> v = np.array([1.0, -1.0, 0.5, 3.0, -2.0, 1.5])
    >>> made, _ = study_groups(np.array([0, 0, 0, 1, 1, 1]), ("a", "b"), v, v, None, StudyOptions())
    >>> made.variances.round(3), made.test("bartlett").df
    (array([1.083, 6.583]), (1.0,))
    """
    k = len(names)
    counts = np.bincount(codes, minlength=k)
    some = np.maximum(counts, 1)
    means = np.bincount(codes, base, k) / some
    if r is None:
        sums, df = np.bincount(codes, (base - means[codes]) ** 2, k), np.asarray(counts - 1.0, dtype=float)
    else:
        sums, df = np.bincount(codes, base**2, k), np.asarray(np.bincount(codes, r, k), dtype=float)
    usable = df > UNCONTROLLED
    variances = np.divide(sums, df, out=np.full(k, np.nan), where=usable)
    means = np.where(counts > 0, means, np.nan)
    return compare_groups(Groups(names, codes, counts, means, variances, df, r is not None), x, o)


def compare_groups(made: Groups, x: Floats, o: StudyOptions) -> tuple[Groups, list[tuple[str, str]]]:
    """Add the tests of equal variances to groups.

    Parameters
    ----------
    made : Groups
        Without tests.
    x : (n,) array
        The values studied; none where only their sums are known, which leaves out the test of Brown and Forsythe.
    o : StudyOptions

    Returns
    -------
    Groups
    left_out : list of (str, str)
        What could not be tested, and why.

    Examples
    --------
    >>> none = np.zeros(0, dtype=np.intp)
    >>> two = Groups(("a", "b"), none, np.array([9, 9]), np.zeros(2), np.array([1.0, 4.0]), np.array([8.0, 8.0]), False)
    >>> [t.name for t in compare_groups(two, np.zeros(0), StudyOptions())[0].tests]
    ['bartlett', 'bartlett_uncorrected', 'variance_per_group']
    """
    names, k, usable, variances = made.names, len(made.names), made.df > UNCONTROLLED, made.variances
    left_out: list[tuple[str, str]] = []
    if not usable.all():
        lost = [names[i] for i in np.flatnonzero(~usable)]
        left_out.append((f"variance of {len(lost)} of {k} groups", f"no degree of freedom: {_some(lost)}"))
    flat = np.flatnonzero(usable & (variances == 0.0))
    if len(flat):
        left_out.append(("homogeneity of variances", f"all residuals are equal in {_some([names[i] for i in flat])}"))
        return made, left_out
    at = np.flatnonzero(usable)
    if len(at) < 2:
        left_out.append(("homogeneity of variances", "it needs two groups with degrees of freedom"))
        return made, left_out
    return replace(made, tests=_homogeneity(made, at, x, o)), left_out


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _homogeneity(groups: Groups, at: Ints, x: Floats, o: StudyOptions) -> tuple[TestResult, ...]:
    s2, df = groups.variances[at], groups.df[at]
    common = bartlett(s2, df, o.alpha)
    theirs = bartlett(s2, df, o.alpha, corrected=False)
    each = variance_per_image(s2, df, None, o.alpha, o.levels, [groups.names[i] for i in at])
    said = "Exact for normal residuals of groups that were adjusted separately; modulated errors make it reject too often."
    if groups.by_redundancy:
        said += " Groups of one adjustment share unknowns: approximate."
    out = [
        replace(common, note=f"{said} {common.note}".strip()),
        replace(theirs, name="bartlett_uncorrected", note="The form of Maarek & Konecny, without Bartlett's correction."),
        replace(each, name="variance_per_group", note=f"{said} {each.note}".strip()),
    ]
    robust = _brown_forsythe(x, groups.codes, len(groups.names), o.alpha)
    return (*out, robust) if robust is not None else tuple(out)


def _brown_forsythe(x: Floats, codes: Ints, k: int, alpha: float) -> TestResult | None:
    """Analysis of variance of the distances from the group's median: homogeneity without a normal law.

    M. B. Brown, A. B. Forsythe, J. Am. Stat. Ass. 69 (1974) 364-367.
    """
    order = np.lexsort((x, codes))
    counts = np.bincount(codes, minlength=k)
    full = np.flatnonzero(counts)
    if len(full) < 2 or len(x) <= len(full):
        return None
    starts = (np.cumsum(counts) - counts)[full]
    low, high = starts + (counts[full] - 1) // 2, starts + counts[full] // 2
    medians = np.zeros(k)
    medians[full] = 0.5 * (x[order[low]] + x[order[high]])
    z = np.abs(x - medians[codes])
    means = np.bincount(codes, z, k) / np.maximum(counts, 1)
    within = float(np.sum((z - means[codes]) ** 2))
    if within == 0.0:
        return None
    between = float(np.sum(counts * (means - z.mean()) ** 2))
    df = (len(full) - 1, len(x) - len(full))
    return TestResult(
        "brown_forsythe",
        "All groups have the same spread, whatever their law.",
        between / df[0] / (within / df[1]),
        stats.f(*df),
        f"F({df[0]}, {df[1]})",
        alpha,
        df=(float(df[0]), float(df[1])),
        note="Analysis of variance of the distances from the medians of the groups: does not lean on the normal law.",
    )
