"""Cross-validation: control points withheld in turns, their errors against the precision that was predicted for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment import Adjustment, adjust
from baarda.cameras import FREE
from baarda.errors import BaardaError, UsageError
from baarda.hypotheses.base import Estimates
from baarda.hypotheses.levels import Options
from baarda.network import AXES, CHECK, CONTROL, Network
from baarda.observations import RangeDoppler

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
FEW = 3  # withheld points below which an RMS proves little


@dataclass(frozen=True)
class Fold:
    """One turn.

    Attributes
    ----------
    points : tuple of str
        Withheld control points.
    sigma0 : float or None
    redundancy : int or None
    problem : str
        Why the turn could not be adjusted; empty.
    """

    points: tuple[str, ...]
    sigma0: float | None
    redundancy: int | None
    problem: str = ""


@dataclass(frozen=True)
class Withheld:
    """A coordinate of a withheld control point.

    Attributes
    ----------
    fold : int
        From 1.
    point, axis : str
    difference : float
        Predicted - given.
    sigma : float
        Of the difference: the adjusted coordinate (a posteriori or a priori, as the options say) and the survey.
    ratio : float
        Difference over sigma; of law t(r), or the normal law.
    p_value : float
    """

    fold: int
    point: str
    axis: str
    difference: float
    sigma: float
    ratio: float
    p_value: float


@dataclass(frozen=True)
class Error:
    """The error along one axis, or of several together.

    Attributes
    ----------
    name : str
        X, Y, Z, horizontal or 3d.
    count : int
        Points.
    rms, low, high : float
        Root mean square and its confidence interval: chi-square of the equivalent degrees of freedom `df`.
    predicted : float
        Root mean square of the predicted standard deviations.
    ratio : float
        Mean square over mean predicted variance: about 1 where the prediction is right.
    p_value : float
        Of the ratio, two-sided.
    df : float
    """

    name: str
    count: int
    rms: float
    low: float
    high: float
    predicted: float
    ratio: float
    p_value: float
    df: float


@dataclass(frozen=True)
class CrossValidation:
    """The outcome of a cross-validation.

    Attributes
    ----------
    folds : tuple of Fold
    rows : tuple of Withheld
    errors : tuple of Error
    confidence : float
        Of the intervals.
    rejected : int
        Coordinates beyond their limit at level `alpha`.
    alpha : float
    note : str
        What the reader must know.
    """

    folds: tuple[Fold, ...]
    rows: tuple[Withheld, ...]
    errors: tuple[Error, ...]
    confidence: float
    rejected: int
    alpha: float
    note: str

    def as_dict(self) -> dict[str, Any]:
        """Return the addition to `result.json`."""
        return {
            "folds": [vars(f) for f in self.folds],
            "points": [vars(r) for r in self.rows],
            "errors": [vars(e) for e in self.errors],
            "confidence": self.confidence,
            "rejected": self.rejected,
            "alpha": self.alpha,
            "note": self.note,
        }


def folds_of(count: int, folds: int, seed: int = 0) -> list[Ints]:
    """Divide indices at random into folds of equal size, up to one.

    Parameters
    ----------
    count, folds : int
    seed : int

    Returns
    -------
    list of int arrays
        Sorted; together every index once.

    Raises
    ------
    UsageError
        If there are fewer indices than folds, or fewer than two folds.

    Examples
    --------
    >>> [len(f) for f in folds_of(35, 6)]
    [6, 6, 6, 6, 6, 5]
    """
    if not 2 <= folds <= count:
        raise UsageError(f"cross-validation in {folds} turns needs at least 2 turns and as many control points; there are {count}")
    order = np.random.default_rng(seed).permutation(count)
    return [np.sort(part) for part in np.array_split(order, folds)]


def cross_validate(
    network: Network, folds: int = 6, options: Options | None = None, tell: Callable[[str], None] | None = None, **settings: Any
) -> CrossValidation:
    """Withhold the control points in turns, adjust without them, and compare what is predicted for them.

    Parameters
    ----------
    network : Network
        With control points, fixed or weighted, that are measured in images.
    folds : int
        K turns; each control point is withheld once (Wu: 6 turns of 5 points).
    options : Options, optional
        `alpha` for tests and intervals, `sigma` for the variance factor, `seed` for the division.
    tell : callable, optional
        Is told of each turn.
    **settings
        Fields of `Settings`.

    Returns
    -------
    CrossValidation

    Raises
    ------
    UsageError
        If there are too few control points, or none can be predicted.

    Notes
    -----
    Wu, Liu & Lin (2000). A point that a single radar track sees is withheld in plan and keeps its height, as there. The turns share
    observations, and differences of one turn are correlated: intervals and p-values of the mean squares use the covariance of the
    differences within each turn (Satterthwaite's degrees of freedom) and take turns as independent.
    """
    o = Options() if options is None else options
    table = network.points
    rays = np.zeros(len(table.labels), dtype=int)
    for group in network.observations:
        for end in group.points_of():
            rays += np.bincount(end, minlength=len(rays))
    control = np.flatnonzero((table.roles == CONTROL) & (rays > 0) & np.isfinite(table.given).any(axis=1))
    plan = _plan_only(network)
    parts = folds_of(len(control), folds, o.seed)
    turns: list[Fold] = []
    rows: list[Withheld] = []
    blocks: list[tuple[Estimates, Floats]] = []
    for k, part in enumerate(parts):
        out = control[part]
        labels = tuple(table.labels[i] for i in out)
        try:
            a = adjust(_withholding(network, out, plan), **settings)
        except BaardaError as error:
            turns.append(Fold(labels, None, None, str(error)))
            continue
        if a.status != "converged":
            turns.append(Fold(labels, None, None, "the adjustment did not converge"))
            continue
        turns.append(Fold(labels, a.sigma0, a.redundancy))
        e = _differences(a, set(labels)) if not plan[out].any() else _predicted(a, out, plan)
        if e is None:
            continue
        scale = a.variance_factor if o.sigma == "aposteriori" else 1.0
        covariance = scale * e.cofactors + (0.0 if e.reference_covariance is None else e.reference_covariance)
        blocks.append((e, covariance))
        s = np.sqrt(np.diagonal(covariance))
        for name, point, d, sd in zip(e.names, e.groups, e.values, s, strict=True):
            t = float(d / sd)
            p = 2.0 * float(stats.t.sf(abs(t), a.redundancy) if o.sigma == "aposteriori" else stats.norm.sf(abs(t)))
            rows.append(Withheld(k + 1, point, name[-1], float(d), float(sd), t, p))
        if tell is not None:
            tell(f"turn {k + 1} of {folds}: {len(labels)} points withheld, rms {np.sqrt(np.mean(e.values**2)):.4g} {network.unit}")
    if not rows:
        reason = next((f.problem for f in turns if f.problem), "no withheld point is determined by images")
        raise UsageError(f"cross-validation: no control point could be predicted; {reason}")
    errors = tuple(
        found
        for name, axes in (("X", "X"), ("Y", "Y"), ("Z", "Z"), ("horizontal", "XY"), ("3d", "XYZ"))
        if (found := _error(name, axes, blocks, o.alpha)) is not None
    )
    return CrossValidation(
        tuple(turns), tuple(rows), errors, 1.0 - o.alpha, sum(r.p_value <= o.alpha for r in rows), o.alpha, _note(turns, rows, control, o)
    )


def _note(turns: list[Fold], rows: list[Withheld], control: Ints, o: Options) -> str:
    said = []
    failed = sum(bool(f.problem) for f in turns)
    if failed:
        said.append(f"{failed} of {len(turns)} turns could not be adjusted.")
    predicted = len({r.point for r in rows})
    if predicted < len(control):
        said.append(f"{len(control) - predicted} of {len(control)} control points could not be predicted.")
    if predicted < FEW:
        said.append(f"Only {predicted} point(s) were predicted: little evidence.")
    said.append(f"By chance alone about {len(rows) * o.alpha:.1f} of {len(rows)} coordinates lie beyond their limit.")
    return " ".join(said)


def _plan_only(network: Network) -> NDArray[np.bool_]:
    """Return which points one radar track alone sees: range and squint determine two coordinates, the third must be given."""
    radar, other = np.zeros(len(network.points.labels), dtype=int), np.zeros(len(network.points.labels), dtype=int)
    for group in network.observations:
        for end in group.points_of():
            (radar if isinstance(group, RangeDoppler) else other)[:] += np.bincount(end, minlength=len(radar))
    return np.asarray((radar == 1) & (other == 0))


def _withholding(network: Network, out: Ints, plan: NDArray[np.bool_]) -> Network:
    """Turn control points into check points; of those in `plan` only X and Y become free."""
    points = network.points
    roles, states, start = np.array(points.roles), np.array(points.states), np.array(points.coordinates)
    heights, out = out[plan[out]], out[~plan[out]]
    states[heights, :2] = FREE
    roles[out], states[out] = CHECK, FREE
    # the given coordinates only start the adjustment
    start[out] = np.where(np.isfinite(start[out]), start[out], points.given[out])
    sigmas = np.where(np.isfinite(points.sigmas), points.sigmas, 0.0)
    merged = np.where((roles == CHECK)[:, None], sigmas, points.sigmas)
    return replace(network, points=replace(points, roles=roles, states=states, coordinates=start, sigmas=merged))


def _differences(a: Adjustment, labels: set[str]) -> Estimates | None:
    """Return the differences of the withheld points (not of other check points)."""
    e = a.evidence.check
    if e is None:
        return None
    at = np.array([i for i, point in enumerate(e.groups) if point in labels], dtype=np.intp)
    if not len(at):
        return None
    square = np.ix_(at, at)
    return Estimates(
        tuple(e.names[i] for i in at),
        e.values[at],
        e.cofactors[square],
        None if e.reference_covariance is None else e.reference_covariance[square],
        tuple(e.groups[i] for i in at),
    )


def _predicted(a: Adjustment, out: Ints, plan: NDArray[np.bool_]) -> Estimates | None:
    """Return the differences of withheld points of which some keep their height."""
    points = a.network.points
    wanted = np.isfinite(points.given[out]) & ~a.aside[out, None] & ~(plan[out, None] & (np.arange(3) == 2))
    rows, axes = np.nonzero(wanted)
    rows = out[rows]
    if not len(rows):
        return None
    q = a.cofactors.of(a.numbering["point"].columns.reshape(-1, 3)[rows, axes])
    survey = np.nan_to_num(points.covariance(np.arange(len(points.labels))))[rows[:, None], axes[:, None], axes[None, :]]
    return Estimates(
        tuple(f"point {points.labels[i]}: {AXES[k]}" for i, k in zip(rows, axes, strict=True)),
        points.coordinates[rows, axes] - points.given[rows, axes],
        0.5 * (q + q.T),
        np.where(rows[:, None] == rows[None, :], survey, 0.0),
        tuple(points.labels[i] for i in rows),
    )


def _error(name: str, axes: str, blocks: list[tuple[Estimates, Floats]], alpha: float) -> Error | None:
    """Return the error over some axes of the points that have all of them."""
    square = mean = fourth = 0.0
    points = 0
    for e, covariance in blocks:
        complete = {p for p in set(e.groups) if {n[-1] for n, g in zip(e.names, e.groups, strict=True) if g == p} >= set(axes)}
        at = [i for i, (n, g) in enumerate(zip(e.names, e.groups, strict=True)) if n[-1] in axes and g in complete]
        if not at:
            continue
        c = covariance[np.ix_(at, at)]
        square += float(np.sum(e.values[at] ** 2))
        mean += float(np.trace(c))
        fourth += float(np.sum(c * c))
        points += len(complete)
    if not points or not mean > 0.0:
        return None
    # Satterthwaite: d'd is about mean/df chi2(df), with mean = tr C and variance 2 tr C^2
    df = mean * mean / fourth
    ratio = square / mean
    low, high = (square / points * df / float(stats.chi2.ppf(q, df)) for q in (1.0 - alpha / 2.0, alpha / 2.0))
    p = 2.0 * min(float(stats.chi2.sf(ratio * df, df)), float(stats.chi2.cdf(ratio * df, df)))
    rms, first, last, predicted = (float(np.sqrt(v)) for v in (square / points, low, high, mean / points))
    return Error(name, points, rms, first, last, predicted, ratio, min(p, 1.0), df)
