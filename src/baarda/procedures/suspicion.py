"""Which observations of an adjustment are suspected: w and tau of coordinates, and the joint tests of image points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from threadpoolctl import threadpool_limits

from baarda.adjustment import Adjustment
from baarda.hypotheses._laws import BoundedLaw
from baarda.hypotheses.levels import Options, applied_level, baarda_level
from baarda.hypotheses.outliers import UNCONTROLLED
from baarda.observations import CorrelatedPoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Unit = Literal["coordinate", "point", "image"]


@dataclass(frozen=True)
class Judged:
    """All units of an adjustment with their tests.

    Attributes
    ----------
    adjustment : Adjustment
    rows : list of int arrays
        Scalar rows of each unit.
    statistic, p_value : (k,) arrays
        NaN where a unit is uncontrolled.
    level : (k,) array
    limits : (k,) array or None
        Critical values of the root of the statistic that take the place of the level, infinite where a unit is uncontrolled.
    """

    adjustment: Adjustment
    rows: tuple[Ints, ...]
    statistic: Floats
    p_value: Floats
    level: Floats
    limits: Floats | None = None

    @cached_property
    def suspected(self) -> Ints:
        """Units beyond their limit, the worst first."""
        if self.limits is not None:
            excess = np.nan_to_num(np.sqrt(self.statistic) / self.limits)
            beyond = np.flatnonzero(excess > 1.0)
            return np.asarray(beyond[np.argsort(-excess[beyond], kind="stable")])
        with np.errstate(invalid="ignore"):
            hit = np.flatnonzero(self.p_value <= self.level * (1.0 + 1e-12))
        order = np.lexsort((-self.statistic[hit], self.p_value[hit]))
        return np.asarray(hit[order])


def weighted_cofactors(a: Adjustment) -> list[tuple[Ints, Floats, Floats]]:
    """Return for each chunk the scalar rows (N, m), P v (N, m), and the blocks of P Qvv P (N, m, m)."""
    out = []
    with threadpool_limits(limits=1, user_api="blas"):
        hats = a.solver.hat()
    for c, hat in zip(a.lin.chunks, hats, strict=True):
        inverse = np.linalg.inv(c.factor)
        weighted = inverse.transpose(0, 2, 1)
        g = weighted @ (np.eye(hat.shape[1]) - hat) @ inverse
        out.append((c.rows, -(weighted @ a.lin.misclosure[c.rows][:, :, None])[:, :, 0], g))
    return out


def judge(a: Adjustment, unit: Unit, options: Options) -> Judged:
    """Test all observations (unit ``coordinate``) or all image points and other row blocks (``point``) of an adjustment.

    Parameters
    ----------
    a : Adjustment
        By least squares.
    unit : {"coordinate", "point"}
        Control points with a full covariance matrix are always judged as a whole.
    options : Options
        `sigma` chooses between tau and w, `levels` the policy.

    Returns
    -------
    Judged
        Statistic u' M^-1 u / (m s0^2), the square of tau or w for one coordinate: Baarda (1968), Pope (1976).
    """
    together = np.concatenate([np.full(len(g) * len(g.components), isinstance(g, CorrelatedPoints)) for g in a.groups])
    rows: list[Ints] = []
    forms, sizes = [], []
    for at, pv, g in weighted_cofactors(a):
        m = at.shape[1]
        weight = np.einsum("nii->ni", g)
        whole = np.full(len(at), unit == "point" and m > 1) | together[at[:, 0]]
        if whole.any():
            values, vectors = np.linalg.eigh(g[whole])
            seen = values[:, 0] > UNCONTROLLED * values[:, -1]
            part = np.einsum("nij,ni->nj", vectors, pv[whole])
            form = np.full(len(values), np.nan)
            form[seen] = (part[seen] ** 2 / values[seen]).sum(axis=1)
            rows += list(at[whole])
            forms.append(form)
            sizes.append(np.full(len(values), m))
        if not whole.all():
            flat = at[~whole].ravel()
            w, v = weight[~whole].ravel(), pv[~whole].ravel()
            seen = a.controlled_share[flat] >= UNCONTROLLED
            form = np.full(len(flat), np.nan)
            np.divide(v * v, w, out=form, where=seen)
            rows += list(flat[:, None])
            forms.append(form)
            sizes.append(np.ones(len(flat), dtype=int))
    q, m = np.concatenate(forms), np.concatenate(sizes)
    if options.sigma == "aposteriori":
        statistic = q / (m * a.variance_factor)
        p = np.asarray(BoundedLaw(m.astype(float), float(a.redundancy)).sf(statistic), dtype=float)
    else:
        statistic = q / m
        p = np.asarray(stats.chi2(m).sf(q), dtype=float)
    p = np.where(np.isnan(q), np.nan, p)
    if options.levels == "baarda":
        known = {int(k): baarda_level(int(k), options.alpha_outlier, options.power) for k in np.unique(m)}
        level = np.array([known[int(k)] for k in m])
    else:
        single = options.levels == "none"
        level = np.full(len(p), applied_level(p, options.alpha_outlier if single else options.alpha, options.levels))
    return Judged(a, tuple(rows), statistic, p, level)


def cofactor_column(a: Adjustment, row: int) -> Floats:
    """Return a column of P Qvv P, (n,), by one solve."""
    y = np.zeros(a.count)
    for c in a.lin.chunks:
        hit = np.argwhere(c.rows == row)
        if len(hit):
            n, i = hit[0]
            y[c.rows[n]] = np.linalg.inv(c.factor[n])[:, i]
    with threadpool_limits(limits=1, user_api="blas"):
        y = y - a.lin.times(a.solver.solve(a.lin.transposed(y)))
    out = np.empty(a.count)
    for c in a.lin.chunks:
        out[c.rows] = np.einsum("nji,nj->ni", np.linalg.inv(c.factor), y[c.rows])
    return out
