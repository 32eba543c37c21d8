"""Data snooping of a linear model: each removal and each return by a closed-form update, which is exact here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, special, stats

from baarda.errors import RedundancyNotPositive, Singular, UsageError
from baarda.hypotheses.levels import Options, applied_level
from baarda.hypotheses.outliers import UNCONTROLLED, TauLaw

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RowStep:
    """A decision: ``rejected`` or ``restored``, which row, its tau, w or t before it, and v'Pv and r after it."""

    action: str
    row: int
    statistic: float
    p_value: float
    vpv: float
    redundancy: int


@dataclass(frozen=True)
class RowsSnooped:
    """The outcome.

    Attributes
    ----------
    removed : tuple of int
        Rows that stay out.
    steps : tuple of RowStep
    vpv : float
    redundancy : int
    shifts : (k,) array
        Estimated errors of the removed rows, observed - true, in their units.
    """

    removed: tuple[int, ...]
    steps: tuple[RowStep, ...]
    vpv: float
    redundancy: int
    shifts: Floats


@dataclass
class _System:
    """P v, the diagonal of P Qvv P and v'Pv of the rows that are left; columns of P Qvv P of all rows on demand."""

    white: Floats  # inverse of the lower factor of the covariance: (n,) standard deviations inverted, or (n, n)
    basis: Floats
    pv: Floats
    diagonal: Floats
    vpv: float
    redundancy: int
    updates: list[Floats]

    def column(self, i: int) -> Floats:
        """Return a column of P Qvv P in the full model."""
        n = len(self.pv)
        unit = np.zeros(n)
        if self.white.ndim == 1:
            unit[i] = self.white[i]
            rest = unit - self.basis @ (self.basis[i] * self.white[i])
            return np.asarray(self.white * rest)
        unit = self.white[:, i]
        return np.asarray(self.white.T @ (unit - self.basis @ (self.basis.T @ unit)))

    def remove(self, i: int) -> None:
        """Take a row out: a rank-one update of residuals and cofactors."""
        c = self.column(i)
        for u in self.updates:
            c = c - u * u[i]
        pull = self.pv[i]
        self.vpv -= float(pull * pull / c[i])
        self.pv = self.pv - c * (pull / c[i])
        self.diagonal = self.diagonal - c * c / c[i]
        self.diagonal[i] = 0.0
        self.redundancy -= 1
        self.updates.append(c / np.sqrt(c[i]))


def _system(design: ArrayLike, observed: ArrayLike, covariance: ArrayLike | None) -> _System:
    a, l_ = np.atleast_2d(np.asarray(design, dtype=float)), np.asarray(observed, dtype=float)
    n, u = a.shape
    if l_.shape != (n,):
        raise UsageError(f"{l_.shape} observations for {n} rows")
    if n <= u:
        raise RedundancyNotPositive(f"{n} observations for {u} unknowns")
    c = np.ones(n) if covariance is None else np.asarray(covariance, dtype=float)
    if c.ndim == 1:
        white = 1.0 / np.sqrt(c)
        a, l_ = a * white[:, None], l_ * white
    else:
        white = np.asarray(linalg.solve_triangular(np.linalg.cholesky(c), np.eye(n), lower=True))
        a, l_ = white @ a, white @ l_
    size = np.linalg.norm(a, axis=0)
    basis, upper = np.linalg.qr(a / np.where(size > 0.0, size, 1.0))
    pivots = np.abs(np.diagonal(upper))
    if pivots.min() < 1e-12 * pivots.max():
        raise Singular("the columns of the design matrix depend on each other")
    z = basis @ (basis.T @ l_) - l_
    if white.ndim == 1:
        rest = np.maximum(1.0 - np.einsum("nu,nu->n", basis, basis), 0.0)
        pv, diagonal = white * z, white**2 * rest
    else:
        half = white - basis @ (basis.T @ white)
        pv, diagonal = white.T @ z, np.einsum("ij,ij->j", half, half)
    return _System(white, basis, pv, diagonal, float(z @ z), n - u, [])


def snoop_rows(design: ArrayLike, observed: ArrayLike, covariance: ArrayLike | None = None, options: Options | None = None) -> RowsSnooped:
    """Remove gross errors from the observations of a linear model one by one, the worst first, and restore what is cleared.

    Parameters
    ----------
    design : (n, u) array
        Design matrix A.
    observed : (n,) array
        Observations l.
    covariance : (n,) or (n, n) array, optional
        Their covariance matrix, or variances, for sigma0 = 1; absent: unit weights.
    options : Options, optional
        `sigma`: tau (a posteriori) or w (a priori); `alpha_outlier` or, with a policy, `alpha` and `levels`.

    Returns
    -------
    RowsSnooped

    Raises
    ------
    RedundancyNotPositive, Singular, UsageError
        If the model cannot be adjusted.

    Notes
    -----
    Baarda (1968), Pope (1976). Removing row i changes P v by -c (Pv)_i / c_i and P Qvv P by -c c'/c_i, with c its column: no adjustment is
    repeated. A removed row returns when its shift, estimated together with those of the other removed rows, is not significant.

    Examples
    --------
    >>> import numpy as np
    >>> found = snoop_rows(np.ones((8, 1)), [5.1, 5.0, 4.9, 5.2, 9.0, 4.8, 5.0, 5.1], options=Options(alpha_outlier=0.01))
    >>> found.removed, found.shifts
    ((4,), array([3.986]))
    """
    o = Options() if options is None else options
    full = _system(design, observed, covariance)
    s = _copy(full)
    weight = full.white**2 if full.white.ndim == 1 else np.einsum("ij,ij->j", full.white, full.white)
    removed: list[int] = []
    steps: list[RowStep] = []
    settled: set[int] = set()
    while True:
        p, value, level = _judged(s, weight, o)
        i = int(np.nanargmin(p)) if np.isfinite(p).any() else -1
        if i >= 0 and p[i] <= level * (1.0 + 1e-12):
            tied = np.flatnonzero(p == p[i])
            i = int(tied[np.argmax(np.abs(value[tied]))])
            s.remove(i)
            removed.append(i)
            steps.append(RowStep("rejected", i, float(value[i]), float(p[i]), s.vpv, s.redundancy))
            continue
        shifts, t, q = _shifts(full, s, removed, o)
        open_rows = [k for k, row in enumerate(removed) if row not in settled and q[k] > level]
        if not open_rows:
            return RowsSnooped(tuple(removed), tuple(steps), s.vpv, s.redundancy, shifts)
        best = max(open_rows, key=lambda k: float(q[k]))
        row = removed.pop(best)
        settled.add(row)
        s = _copy(full)
        for other in removed:
            s.remove(other)
        steps.append(RowStep("restored", row, float(t[best]), float(q[best]), s.vpv, s.redundancy))


def _copy(s: _System) -> _System:
    return _System(s.white, s.basis, s.pv.copy(), s.diagonal.copy(), s.vpv, s.redundancy, [])


def _judged(s: _System, weight: Floats, o: Options) -> tuple[Floats, Floats, float]:
    """Return the p-values and the statistics of the rows that are left, and the level."""
    seen = s.diagonal > UNCONTROLLED * weight
    value = np.full(len(s.pv), np.nan)
    aposteriori = o.sigma == "aposteriori"
    if aposteriori and (s.redundancy < 1 or s.vpv <= 0.0):
        return value, value, 0.0
    scale = np.sqrt(s.vpv / s.redundancy) if aposteriori else 1.0
    np.divide(s.pv, np.sqrt(np.where(seen, s.diagonal, 1.0)) * scale, out=value, where=seen)
    if aposteriori:
        p = np.minimum(1.0, 2.0 * np.asarray(TauLaw(float(s.redundancy)).sf(np.abs(value))))
    else:
        p = 2.0 * special.ndtr(-np.abs(value))
    single = o.levels in ("none", "baarda")
    return p, value, applied_level(p, o.alpha_outlier if single else o.alpha, o.levels)


def _shifts(full: _System, s: _System, removed: list[int], o: Options) -> tuple[Floats, Floats, Floats]:
    """Return the shifts of all removed rows together, their t (or w), and p-values."""
    if not removed:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    block = np.stack([full.column(i)[removed] for i in removed], axis=1)
    inverse = np.linalg.inv(block)
    shifts = -inverse @ full.pv[removed]
    aposteriori = o.sigma == "aposteriori"
    factor = s.vpv / s.redundancy if aposteriori else 1.0
    t = shifts / np.sqrt(factor * np.diagonal(inverse))
    p = 2.0 * (stats.t.sf(np.abs(t), s.redundancy) if aposteriori else stats.norm.sf(np.abs(t)))
    return shifts, t, np.asarray(p)
