"""Check points by axis: X, Y, Z, horizontal and in space, with the root mean square of each and its confidence interval."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses._laws import check_redundancy, check_variance, f_law, member_laws, same
from baarda.hypotheses._quadratic import point_rows, vector_and_matrix
from baarda.hypotheses.base import Evidence, Floats, Law, TestResult
from baarda.hypotheses.check_points import _APPROXIMATE, _KNOWN, _joint
from baarda.hypotheses.levels import Options, Policy, check_level, family_result

__all__ = ["check_axis", "rms_interval"]

ORDER = 72
SETS = (("X", ("X",)), ("Y", ("Y",)), ("Z", ("Z",)), ("horizontal", ("X", "Y")), ("3D", ("X", "Y", "Z")))


def rms_interval(differences: ArrayLike, covariance: ArrayLike, points: int, level: float = 0.95) -> tuple[float, float, float]:
    """Return the root mean square of differences per point with its confidence interval.

    Parameters
    ----------
    differences : (p,) array
        Adjusted - given coordinates, all of an axis or of several.
    covariance : (p, p) array
        Their predicted covariance; only its shape matters, not its size.
    points : int
        Number of points the squares are averaged over.
    level : float
        Confidence.

    Returns
    -------
    rms, lower, upper : float
        sqrt(sum d^2 / points), and the interval of its expectation: the sum of squares follows chi-square of
        f = tr(C)^2 / tr(C^2) degrees of freedom but for a factor (Satterthwaite 1946); f = p for independent differences of equal
        variance.

    Raises
    ------
    UsageError
        If the shapes make no sense.

    Examples
    --------
    >>> rms_interval([0.02, -0.03, 0.05, 0.01], np.eye(4), 4)
    (0.03123, 0.01871, 0.08973)
    """
    d, c = vector_and_matrix(differences, covariance, "covariance")
    check_level(level, "level")
    if points < 1:
        raise UsageError(f"the number of points must be positive, not {points}")
    f = float(np.trace(c)) ** 2 / float((c * c).sum())
    rms = float(np.sqrt(d @ d / points))
    low, high = np.sqrt(f / stats.chi2.ppf([0.5 + level / 2.0, 0.5 - level / 2.0], f))
    return rms, rms * float(low), rms * float(high)


def check_axis(
    differences: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    axes: Sequence[str],
    groups: Sequence[str],
    reference_covariance: ArrayLike | None = None,
    alpha: float = 0.05,
    levels: Policy = "none",
) -> TestResult:
    """Test check points by axis: all X, all Y, all Z, all horizontal positions, all positions in space.

    Parameters
    ----------
    differences : (p,) array
        Adjusted - given coordinates.
    cofactors : (p, p) array
        Cofactors of the adjusted coordinates.
    variance_factor : float
        s0^2, or sigma0^2 if `redundancy` is infinite.
    redundancy : float
        r.
    axes : sequence of {"X", "Y", "Z"}
        Axis of each difference.
    groups : sequence of str
        Point of each difference.
    reference_covariance : (p, p) array, optional
        Covariance of the reference; absent: exact.
    alpha, levels
        See `Options`.

    Returns
    -------
    TestResult
        A family with the members that the data allow among X, Y, Z, horizontal (points with X and Y), 3D (points with all): each
        d' (s0^2 Q + C)^-1 d / p as in `check_points`. `details` has for each member points, mean, rms, its 95 % interval, and the
        predicted rms, in the unit of the differences.

    Raises
    ------
    Singular
        If coordinates depend on each other.
    RedundancyNotPositive, UsageError
        If r, the variance factor or the shapes make no sense.

    Notes
    -----
    Grün, Photogrammetria 34 (1978) eq. 47-48 for groups of coordinates.

    Examples
    --------
    >>> t = check_axis([0.02, -0.03, 0.05, -0.04], np.diag([0.4, 0.9, 0.4, 0.9]), 0.001, 50, ["X", "Z", "X", "Z"], ["7", "7", "8", "8"])
    >>> t.labels, t.details["points"]
    (('X', 'Z'), [2, 2])
    """
    d, q = vector_and_matrix(differences, cofactors)
    check_redundancy(redundancy)
    check_variance(variance_factor, "the variance factor")
    if len(axes) != len(d) or not set(axes) <= {"X", "Y", "Z"}:
        raise UsageError("each difference needs its axis: X, Y or Z")
    c = None if reference_covariance is None else vector_and_matrix(d, reference_covariance, "reference_covariance")[1]
    predicted = variance_factor * q + (0.0 if c is None else c)
    rows = point_rows(groups, len(d))
    labels, statistic, first, second = [], [], [], []
    details: dict[str, list[Any]] = {k: [] for k in ("points", "mean", "rms", "interval", "predicted")}
    for name, members in SETS:
        chosen = [at for at in ([i for i in point if axes[i] in members] for point in rows.values()) if len(at) == len(members)]
        at = [i for point in chosen for i in point]
        if not at:
            continue
        block = np.ix_(at, at)
        told = [f"point {groups[i]}: {axes[i]}" for i in at]
        value, df = _joint(d[at], q[block], variance_factor, redundancy, None if c is None else c[block], told)
        labels.append(name)
        statistic.append(value)
        first.append(float(len(at)))
        second.append(df)
        rms, low, high = rms_interval(d[at], predicted[block], len(chosen))
        details["points"].append(len(chosen))
        details["mean"].append(float(d[at].mean()) if len(members) == 1 else None)
        details["rms"].append(rms)
        details["interval"].append([low, high])
        details["predicted"].append(float(np.sqrt(np.trace(predicted[block]) / len(chosen))))
    law: Law = f_law(np.array(first), np.array(second))
    values: Floats = np.array(statistic)
    law = f_law(first[0], second[0]) if same(np.array(first)) and same(np.array(second)) else member_laws(law, values, two_sided=False)
    spoken = "F of the number of coordinates and the redundancy" if np.isfinite(redundancy) else "chi2 / number of coordinates"
    note = "" if c is None else _APPROXIMATE if np.isfinite(redundancy) else _KNOWN
    null = "The adjusted coordinates of the check points agree with the reference along the axis."
    return family_result("check_axis", null, values, law, spoken, alpha, levels, labels=labels, note=note, details=details)


def axes_of(names: Sequence[str]) -> list[str] | None:
    """Return the axis at the end of each name (``point 7: X``), None where a name has none."""
    found = [name.rpartition(": ")[2] for name in names]
    return found if all(axis in ("X", "Y", "Z") for axis in found) else None


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests by axis; none without check points or where their coordinates do not name their axis."""
    e = evidence.check
    if e is None or len(e.values) == 0 or evidence.vpv <= 0.0:
        return []
    axes = axes_of(e.names)
    if axes is None:
        return []
    aposteriori = options.sigma == "aposteriori"
    factor0 = evidence.variance_factor if aposteriori else evidence.sigma0_apriori**2
    r = float(evidence.redundancy) if aposteriori else np.inf
    groups = e.groups or e.names
    level = options.global_level(axes.count(max(set(axes), key=axes.count)))
    return [check_axis(e.values, e.cofactors, factor0, r, axes, groups, e.reference_covariance, level, options.levels)]
