"""Homogeneity of variances: Bartlett over sets or images, and each set against the pooled variance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses._laws import SimulatedFamily, check_variance, member_laws, number, range_name, same
from baarda.hypotheses._simulation import UNCONTROLLED, null_note, shares, simulate
from baarda.hypotheses.base import Evidence, Floats, Law, SimulatedLaw, TestResult
from baarda.hypotheses.levels import Options, Policy, check_level, family_result

__all__ = ["bartlett", "variance_per_image"]

ORDER = 30
_NULL = "All sets have the same variance."


def _sets(variances: ArrayLike, df: ArrayLike) -> tuple[Floats, Floats]:
    """Return variances and degrees of freedom of at least two sets, or raise UsageError."""
    s2, r = np.atleast_1d(np.asarray(variances, dtype=float)), np.asarray(df, dtype=float)
    r = np.full(s2.shape, float(r)) if r.ndim == 0 else r
    if s2.ndim != 1 or s2.shape != r.shape:
        raise UsageError(f"{s2.shape} variances for {r.shape} degrees of freedom")
    if len(s2) < 2:
        raise UsageError("homogeneity needs two sets")
    if not (s2 > 0.0).all() or not (r > 0.0).all():
        raise UsageError("variances and degrees of freedom must be positive")
    return s2, r


def _theta(variances: Floats, df: Floats) -> Floats:
    """Return Bartlett's uncorrected theta along the last axis."""
    pooled = (variances * df).sum(axis=-1) / df.sum()
    return np.asarray((df * np.log(pooled[..., None] / variances)).sum(axis=-1))


def _correction(df: Floats) -> float:
    return float(1.0 + ((1.0 / df).sum() - 1.0 / df.sum()) / (3.0 * (len(df) - 1)))


def bartlett(variances: ArrayLike, df: ArrayLike, alpha: float = 0.05, *, corrected: bool = True) -> TestResult:
    """Test whether independent sets have the same variance.

    Parameters
    ----------
    variances : (k,) array
        S_i^2 of the sets, k at least 2.
    df : float or (k,) array
        Their degrees of freedom r_i; the approximation is good from 5 on.
    alpha : float
        Level.
    corrected : bool
        Divide by Bartlett's correction C; False is the form of Maarek & Konecny.

    Returns
    -------
    TestResult
        theta / C under chi-square(k - 1); `details` has theta, C and the pooled variance.

    Raises
    ------
    UsageError
        If there are fewer than two sets, or a variance or degree of freedom is not positive.

    Notes
    -----
    Maarek & Konecny, appendix eq. A-1 to A-4, with the natural logarithm of S_i^2; M. S. Bartlett, Proc. R. Soc. A 160 (1937) 268-282.

    Examples
    --------
    >>> import numpy as np
    >>> t = bartlett(np.array([8, 7, 10, 9, 10, 9, 11, 8, 7, 9]) ** 2, 12)
    >>> t.statistic, t.critical, t.details["theta"]
    (4.700, 16.92, 4.843)
    """
    s2, r = _sets(variances, df)
    check_level(alpha)
    theta, c = float(_theta(s2, r)), _correction(r)
    few = int((r < 5.0).sum())
    return TestResult(
        "bartlett",
        _NULL,
        theta / c if corrected else theta,
        stats.chi2(len(s2) - 1),
        f"chi2({len(s2) - 1})",
        alpha,
        df=(float(len(s2) - 1),),
        note=f"{few} sets have fewer than 5 degrees of freedom: the chi-square law is approximate." if few else "",
        details={"theta": theta, "correction": c, "pooled_variance": float((s2 * r).sum() / r.sum()), "sets": len(s2)},
    )


def variance_per_image(
    variances: ArrayLike,
    df: ArrayLike,
    reference: float | None = None,
    alpha: float = 0.05,
    levels: Policy = "none",
    labels: Sequence[str] = (),
) -> TestResult:
    """Test the variance of each set against the pooled one, or against a known one: two-sided.

    Parameters
    ----------
    variances : (k,) array
        S_i^2 of independent sets.
    df : float or (k,) array
        Their degrees of freedom.
    reference : float, optional
        A variance known independently of the sets; absent: the pooled S^2 of the sets themselves.
    alpha, levels
        See `Options`.
    labels : sequence of str
        One per set.

    Returns
    -------
    TestResult
        A family: r_i S_i^2 / S^2, under chi-square(r_i) with a reference, and under R Beta(r_i/2, (R - r_i)/2), R = sum of r_i, with the
        pooled variance, of which each set is a part. The critical values are those of the extreme set where the r_i differ.

    Raises
    ------
    UsageError
        If there are fewer than two sets, or a variance or degree of freedom is not positive.

    Notes
    -----
    Maarek & Konecny, section 2, take chi-square in both cases.

    Examples
    --------
    >>> t = variance_per_image([64.0, 49.0, 100.0], 12, reference=79.0)
    >>> t.critical
    (4.40, 23.34)
    >>> variance_per_image([64.0, 49.0, 100.0], 12).critical
    (5.12, 20.14)
    """
    s2, r = _sets(variances, df)
    check_level(alpha)
    total = float(r.sum())
    pooled = float((s2 * r).sum() / total)
    if reference is not None:
        check_variance(reference, "the reference variance")
    scale = pooled if reference is None else float(reference)
    statistic = r * s2 / scale
    law: Law
    if same(r):
        law = stats.chi2(r[0]) if reference is not None else stats.beta(r[0] / 2.0, (total - r[0]) / 2.0, scale=total)
    else:
        each = stats.chi2(r) if reference is not None else stats.beta(r / 2.0, (total - r) / 2.0, scale=total)
        law = member_laws(each, statistic, two_sided=True)
    spoken = (
        range_name("chi2", r) if reference is not None else f"{range_name('Beta', r / 2.0)} of {number(total / 2.0)}, times {number(total)}"
    )
    return _per_set(statistic, law, spoken, alpha, levels, labels, s2, r, scale)


def _per_set(
    statistic: Floats,
    law: Law,
    spoken: str,
    alpha: float,
    levels: Policy,
    labels: Sequence[str],
    s2: Floats,
    r: Floats,
    scale: float,
    note: str = "",
) -> TestResult:
    null = "The variance of the set equals the common variance."
    details = {"variances": s2.tolist(), "df": r.tolist(), "reference": scale}
    name = "variance_per_image"
    return family_result(name, null, statistic, law, spoken, alpha, levels, labels=labels, tail="two-sided", note=note, details=details)


@dataclass(frozen=True)
class _Grouping:
    """Image observations sorted by image, and the degrees of freedom of the images."""

    rows: NDArray[np.intp]
    starts: NDArray[np.intp]
    df: Floats
    codes: NDArray[np.intp]

    def sums(self, squares: Floats) -> Floats:
        """Return the sum over each image along the first axis."""
        return np.asarray(np.add.reduceat(squares[self.rows], self.starts, axis=0))


def _group(images: NDArray[np.intp], weights: Floats) -> tuple[_Grouping, int]:
    """Return the images that have redundancy, and the number of those that have none."""
    order = np.argsort(images, kind="stable")
    order = order[images[order] >= 0]
    codes, starts = np.unique(images[order], return_index=True)
    if len(codes) == 0:
        return _Grouping(order, starts, np.zeros(0), codes), 0
    df = np.add.reduceat(weights[order], starts)
    kept = df >= UNCONTROLLED
    rows = order[np.repeat(kept, np.diff([*starts, len(order)]))]
    codes, starts = np.unique(images[rows], return_index=True)
    return _Grouping(rows, starts, df[kept], codes), int((~kept).sum())


@dataclass(frozen=True)
class _Images:
    """The images of an adjustment with their sums of squares, and what a reader must know of them."""

    groups: _Grouping
    sums: Floats
    note: str


def _images(evidence: Evidence) -> _Images | None:
    """Return the images that can be compared; None where there are fewer than two."""
    if evidence.images is None or (evidence.redundancy_numbers is None and evidence.qvv is None):
        return None
    share = shares(evidence)
    v = evidence.residuals / evidence.sigmas
    squares = v * v
    note = ""
    own = None if evidence.pv is None else evidence.pv * evidence.residuals / evidence.sigma0_apriori**2
    if own is not None and not np.allclose(own, squares, rtol=1e-6, atol=1e-12 * float(squares.max(initial=0.0))):
        if evidence.residuals_of is None and evidence.redundancy_numbers is not None:
            squares, share = own, evidence.redundancy_numbers
        else:
            note = " Observations are correlated: S_i^2 is the sum of (v / sigma)^2 by its expectation."
    elif evidence.redundancy_numbers is not None:
        share = evidence.redundancy_numbers
    groups, dropped = _group(evidence.images, share)
    sums = groups.sums(squares) if len(groups.df) else np.zeros(0)
    if len(groups.df) < 2 or not (sums > 0.0).all():
        return None
    if dropped:
        note += f" {dropped} images without redundancy are left out."
    return _Images(groups, sums, note)


def simulated_statistic(evidence: Evidence, options: Options) -> Callable[[Floats], Floats] | None:
    """Return the statistic that is simulated: the sum of the squared residuals of each image."""
    found = _images(evidence)
    return None if found is None else _sums_of(found.groups)


def _sums_of(groups: _Grouping) -> Callable[[Floats], Floats]:
    return lambda v: groups.sums(v * v).T


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return Bartlett's test over the images, and each image against the pooled variance.

    The images of one adjustment share unknowns: their variances are not independent, and the null law is simulated.
    """
    found = _images(evidence)
    return [] if found is None else _over_images(evidence, options, found.groups, found.sums, found.note)


def _over_images(evidence: Evidence, options: Options, groups: _Grouping, sums: Floats, note: str) -> list[TestResult]:
    df, total, k = groups.df, float(groups.df.sum()), len(groups.df)
    labels = [evidence.image_names[c] if c < len(evidence.image_names) else f"image {c}" for c in groups.codes]
    c = _correction(df)
    simulated = simulate(evidence, "homogeneity", _sums_of(groups), options)
    note = null_note(evidence, options, 0 if simulated is None else len(simulated)) + note
    s2 = sums / df
    statistic = df * s2 * total / sums.sum()
    alpha = options.global_level(1)
    if simulated is None:
        all_sets, each = bartlett(s2, df, options.global_level(k - 1)), variance_per_image(s2, df, None, alpha, options.levels, labels)
        note = f"{note} {all_sets.note}".strip()
        law, spoken, laws, spoken_each = all_sets.law, all_sets.law_name, each.law, each.law_name
    else:
        theta = np.sort(_theta(simulated / df, df) / c)
        parts = np.sort(simulated * total / simulated.sum(axis=1, keepdims=True), axis=0)
        law, spoken = SimulatedLaw(theta), f"simulated, {len(theta)} replicas"
        laws, spoken_each = member_laws(SimulatedFamily(parts), statistic, two_sided=True), spoken
    name, null = "bartlett_images", "The observations of all images have the same variance, up to their weights."
    theta0 = float(_theta(s2, df))
    details = {"theta": theta0, "correction": c, "pooled_variance": float(sums.sum() / total), "sets": k}
    freedom = (float(k - 1),)
    first = TestResult(name, null, theta0 / c, law, spoken, options.global_level(k - 1), df=freedom, note=note, details=details)
    second = _per_set(statistic, laws, spoken_each, alpha, options.levels, labels, s2, df, float(sums.sum() / total), note)
    if simulated is not None and second.alpha < 2.0 / (len(simulated) + 1.0):
        more = f" {len(simulated)} replicas cannot reach the level {second.alpha:.2g} of a single image: no image can be rejected."
        second = replace(second, note=second.note + more)
    return [first, second]
