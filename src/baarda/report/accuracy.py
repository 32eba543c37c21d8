"""Accuracy as standards of mapping and metrology state it: ASPRS Edition 2, NSSDA, circular and linear error, VDI/VDE 2634."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import UsageError
from baarda.network import AXES
from baarda.observations import Distances
from baarda.procedures.testing import Analysis

__all__ = [
    "ENOUGH_ASPRS",
    "ENOUGH_NSSDA",
    "Accuracy",
    "Lengths",
    "accuracy_json",
    "accuracy_of",
    "from_analysis",
    "length_deviations",
    "lengths_of",
]

Floats = NDArray[np.float64]

ENOUGH_ASPRS = 30
ENOUGH_NSSDA = 20
ROUND = (0.6, 1.0)  # ratio of the lesser to the larger horizontal RMSE for which NSSDA gives a radius
LEVEL = 0.05
# sqrt(-2 ln 0.05), sqrt(-2 ln 0.10): radius of a circular normal law; 1.9600 and 1.6449: two-sided quantiles of the normal law.
RADIUS_95, RADIUS_90, QUANTILE_95, QUANTILE_90 = 2.4477, 2.1460, 1.9600, 1.6449


@dataclass(frozen=True)
class Accuracy:
    """Accuracy from check points, in the unit of the coordinates; NaN where there are no points for a figure.

    Attributes
    ----------
    points : (3,) int array
        Number of check points with X, Y, Z.
    horizontal_points, vertical_points : int
        Points with X and Y; points with Z.
    mean, rmse : (3,) arrays
        Mean and root mean square of adjusted - given in X, Y, Z.
    mean_p : (3,) array
        Two-sided p-value of Student's test that the mean is zero.
    normal_p : (3,) array
        p-value of Shapiro and Wilk's test of the differences; NaN below 8 points.
    survey : (2,) array
        Root mean square error of the survey, horizontal and vertical; zero where the survey states none.
    survey_stated : bool
        Whether the survey states its precision.
    """

    points: NDArray[np.intp]
    horizontal_points: int
    vertical_points: int
    mean: Floats
    rmse: Floats
    mean_p: Floats
    normal_p: Floats
    rmse_h_fit: float
    survey: Floats
    survey_stated: bool

    @property
    def rmse_v_fit(self) -> float:
        """Root mean square error of Z against the check points."""
        return float(self.rmse[2])

    @property
    def rmse_h(self) -> float:
        """RMSE_H: fit to the check points and error of their survey, sqrt(RMSE_H1^2 + RMSE_H2^2)."""
        return float(np.hypot(self.rmse_h_fit, self.survey[0]))

    @property
    def rmse_v(self) -> float:
        """RMSE_V: fit to the check points and error of their survey, sqrt(RMSE_V1^2 + RMSE_V2^2)."""
        return float(np.hypot(self.rmse_v_fit, self.survey[1]))

    @property
    def rmse_3d(self) -> float:
        """RMSE_3D = sqrt(RMSE_H^2 + RMSE_V^2)."""
        return float(np.hypot(self.rmse_h, self.rmse_v))

    @property
    def ratio(self) -> float:
        """The lesser of the RMSE in X and Y divided by the larger; 1 where both are zero."""
        low, high = sorted(self.rmse[:2].tolist())
        return float(low / high) if high > 0.0 else float("nan") if np.isnan(low) else 1.0

    @property
    def radius_95(self) -> float:
        """NSSDA horizontal accuracy at 95 %: 2.4477 (RMSE_x + RMSE_y) / 2, that is 1.7308 RMSE_r for equal ones; NaN for a ratio below 0.6.

        FGDC-STD-007.3-1998, appendix 3-A, cases 1 and 2.
        """
        return self._radius(RADIUS_95)

    @property
    def radius_90(self) -> float:
        """CE90, circular error at 90 %: 2.1460 (RMSE_x + RMSE_y) / 2, that is 1.5175 RMSE_r for equal ones; NaN for a ratio below 0.6.

        FGDC-STD-007.3-1998, appendix 3-D.
        """
        return self._radius(RADIUS_90)

    @property
    def vertical_95(self) -> float:
        """NSSDA vertical accuracy at 95 %: 1.9600 RMSE_z (FGDC-STD-007.3-1998, appendix 3-A)."""
        return QUANTILE_95 * self.rmse_v_fit

    @property
    def vertical_90(self) -> float:
        """LE90, linear error at 90 %: 1.6449 RMSE_z (FGDC-STD-007.3-1998, appendix 3-D)."""
        return QUANTILE_90 * self.rmse_v_fit

    def _radius(self, factor: float) -> float:
        return factor * float(self.rmse[:2].mean()) if self.ratio >= ROUND[0] else float("nan")

    def conditions(self, axes: tuple[int, ...]) -> dict[str, bool | None]:
        """Return the conditions of NSSDA, CE90 and LE90 for some axes: held, not held, or None where they cannot be judged."""
        at = list(axes)
        out: dict[str, bool | None] = {"points": bool(self.points[at].min() >= ENOUGH_NSSDA)}
        if len(at) == 2:
            out["equal_axes"] = None if np.isnan(self.ratio) else self.ratio >= ROUND[0]
        # Each condition over several axes together at LEVEL (Bonferroni).
        for name, p in (("unbiased", self.mean_p[at]), ("normal", self.normal_p[at])):
            out[name] = None if np.isnan(p).any() else bool(p.min() > LEVEL / len(at))
        return out


def accuracy_of(differences: ArrayLike, survey: ArrayLike | None = None) -> Accuracy:
    """Return accuracy figures from the differences of check points.

    Parameters
    ----------
    differences : (n, 3) array
        Adjusted - given X, Y, Z, in one unit; NaN where a coordinate was not given.
    survey : (n, 3) array, optional
        Standard deviations of the given coordinates, same unit; NaN or zero = not stated.

    Returns
    -------
    Accuracy

    Raises
    ------
    UsageError
        If the shapes do not fit.

    Notes
    -----
    RMSE_H1 = sqrt(RMSE_X^2 + RMSE_Y^2) over the points with X and Y, RMSE_V1 = RMSE_Z; the survey's own error enters as
    RMSE_H = sqrt(RMSE_H1^2 + RMSE_H2^2), RMSE_V alike: ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023).


    Examples
    --------
    >>> a = accuracy_of([[0.03, -0.04, 0.05], [-0.03, 0.04, -0.05]], [[0.02, 0.0, 0.02]] * 2)
    >>> a.rmse_h_fit, a.rmse_v_fit, a.rmse_h, a.rmse_v
    (0.05, 0.05, 0.05385, 0.05385)
    """
    from scipy import stats

    d = np.asarray(differences, dtype=float)
    if d.ndim != 2 or d.shape[1] != 3:
        raise UsageError(f"differences of check points must be (n, 3), not {d.shape}")
    s = np.full(d.shape, np.nan) if survey is None else np.asarray(survey, dtype=float)
    if s.shape != d.shape:
        raise UsageError(f"standard deviations of check points must be {d.shape}, not {s.shape}")
    given = np.isfinite(d)
    stated = given & np.isfinite(s) & (s > 0.0)
    mean, rmse, mean_p, normal_p = (np.full(3, np.nan) for _ in range(4))
    for k in range(3):
        x = d[given[:, k], k]
        if not len(x):
            continue
        mean[k], rmse[k] = x.mean(), np.sqrt(np.mean(x * x))
        spread = float(x.std(ddof=1)) if len(x) > 1 else 0.0
        if spread > 0.0:
            mean_p[k] = 2.0 * stats.t.sf(abs(mean[k]) / spread * np.sqrt(len(x)), len(x) - 1)
            if len(x) >= 8:
                normal_p[k] = stats.shapiro(x).pvalue
    both = given[:, :2].all(axis=1)
    squares = np.where(stated, s, 0.0) ** 2
    own = [squares[both][:, :2].sum(axis=1), squares[given[:, 2], 2]]
    return Accuracy(
        given.sum(axis=0),
        int(both.sum()),
        int(given[:, 2].sum()),
        mean,
        rmse,
        mean_p,
        normal_p,
        _root(np.square(d[both, :2]).sum(axis=1)),
        np.array([float(np.sqrt(q.mean())) if len(q) else np.nan for q in own]),
        bool(stated.any()),
    )


def _root(squares: Floats) -> float:
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")


@dataclass(frozen=True)
class Lengths:
    """Given lengths against the lengths that the other observations determine.

    Attributes
    ----------
    starts, ends : tuple of str
        Names of the end points.
    given : (n,) array
        Calibrated lengths, object units.
    deviations : (n,) array
        Measured - calibrated length, the length left out of its own measurement; NaN where no other observation controls it.
    sigmas : (n,) array
        Predicted standard deviations of the deviations, measurement and calibration.
    span : float
        Largest distance of two object points of the block, the diagonal of the box around them.
    """

    starts: tuple[str, ...]
    ends: tuple[str, ...]
    given: Floats
    deviations: Floats
    sigmas: Floats
    span: float

    @property
    def largest(self) -> int | None:
        """The length that deviates most, None where none is controlled."""
        return int(np.nanargmax(np.abs(self.deviations))) if np.isfinite(self.deviations).any() else None

    def conditions(self) -> dict[str, bool]:
        """Return the conditions of VDI/VDE 2634 part 1 on number and size of the test lengths.

        At least seven lines of at least five lengths each, so 35 lengths; the longest at least two thirds of the space diagonal of the
        measuring volume, here of the box around all object points.
        """
        seen = np.isfinite(self.deviations)
        return {
            "lengths": int(seen.sum()) >= 35,
            "longest": bool(seen.any() and self.given[seen].max() >= 2.0 / 3.0 * self.span),
        }


def length_deviations(residuals: ArrayLike, redundancy: ArrayLike, sigmas: ArrayLike, sigma0: float = 1.0) -> tuple[Floats, Floats]:
    """Return what each length measures without itself, minus its given value, and the standard deviation of that.

    Parameters
    ----------
    residuals : (n,) array
        v = adjusted - given length.
    redundancy : (n,) array
        Redundancy numbers; below 1e-10 no other observation controls the length.
    sigmas : (n,) array
        Standard deviations of the given lengths, a priori.
    sigma0 : float
        Standard deviation of unit weight.

    Returns
    -------
    deviations, deviations_sigma : (n,) arrays
        v / r, the residual of the length had it not been observed, and sigma0 sigma / sqrt(r); NaN without control.

    Raises
    ------
    UsageError
        If the shapes differ.

    Notes
    -----
    Length deviation = measured - calibrated length: VDI/VDE 2634 part 1. A length that took part in the
    measurement cannot test it; v / r is exactly the deviation of an adjustment without it (for a linear model and lengths uncorrelated
    with other observations: Cook & Weisberg, Residuals and Influence in Regression, 1982, eq. 2.2.4).

    Examples
    --------
    >>> length_deviations([0.1, 0.0], [0.5, 0.0], [0.2, 0.2])
    (array([0.2, nan]), array([0.2828, nan]))
    """
    v, r, s = (np.asarray(x, dtype=float) for x in (residuals, redundancy, sigmas))
    if not v.shape == r.shape == s.shape or v.ndim != 1:
        raise UsageError("residuals, redundancy numbers and standard deviations of lengths must be equally many")
    share = np.where(r >= 1e-10, r, np.nan)
    return np.asarray(v / share), np.asarray(sigma0 * s / np.sqrt(share))


def lengths_of(analysis: Analysis) -> Lengths | None:
    """Return the observed distances of an adjustment as test lengths, each without itself; None where there are none.

    None, too, under a law of errors: v / r belongs to least squares.
    """
    a = analysis.adjustment
    points = a.network.points
    parts = [(g, a.offsets[i], a.offsets[i + 1]) for i, g in enumerate(a.groups) if isinstance(g, Distances) and len(g)]
    if not parts or not analysis.converged or a.law is not None:
        return None
    r, scale = a.redundancy_numbers, a.scale(analysis.options.sigma)
    found = [length_deviations(a.residuals[i:j], r[i:j], g.sigmas, scale) for g, i, j in parts]
    known = points.coordinates[~a.aside]
    return Lengths(
        tuple(points.labels[i] for g, _, _ in parts for i in g.starts),
        tuple(points.labels[i] for g, _, _ in parts for i in g.ends),
        np.concatenate([g.values for g, _, _ in parts]),
        np.concatenate([d for d, _ in found]),
        np.concatenate([s for _, s in found]),
        float(np.linalg.norm(known.max(axis=0) - known.min(axis=0))),
    )


def from_analysis(analysis: Analysis) -> Accuracy | None:
    """Return the accuracy from the check points of an adjustment; None without check points."""
    e = analysis.evidence.check if analysis.converged else None
    if e is None or not len(e.values) or any(name[-1] not in AXES for name in e.names):
        return None
    rows = {p: i for i, p in enumerate(dict.fromkeys(e.groups))}
    d, s = np.full((len(rows), 3), np.nan), np.full((len(rows), 3), np.nan)
    own = None if e.reference_covariance is None else np.sqrt(np.diag(e.reference_covariance))
    for j, (name, point) in enumerate(zip(e.names, e.groups, strict=True)):
        at = rows[point], AXES.index(name[-1])
        d[at] = e.values[j]
        if own is not None:
            s[at] = own[j]
    return accuracy_of(d, s)


def accuracy_json(analysis: Analysis) -> dict[str, Any] | None:
    """Return the member `accuracy` of result.json: figures in object units, conditions true, false or null (cannot be judged)."""
    a, lengths = from_analysis(analysis), lengths_of(analysis)
    if a is None and lengths is None:
        return None
    out: dict[str, Any] = {"unit": analysis.adjustment.network.unit, "asprs": None, "nssda": None, "vdi_vde_2634": None}
    if a is not None:
        out["asprs"] = {
            "points": {"horizontal": a.horizontal_points, "vertical": a.vertical_points},
            "enough_points": {"horizontal": a.horizontal_points >= ENOUGH_ASPRS, "vertical": a.vertical_points >= ENOUGH_ASPRS},
            "mean": dict(zip("xyz", a.mean, strict=True)),
            "rmse": dict(zip("xyz", a.rmse, strict=True)),
            "fit": {"rmse_h": a.rmse_h_fit, "rmse_v": a.rmse_v_fit},
            "survey": {"rmse_h": a.survey[0], "rmse_v": a.survey[1], "stated": a.survey_stated},
            "rmse_h": a.rmse_h,
            "rmse_v": a.rmse_v,
            "rmse_3d": a.rmse_3d,
        }
        out["nssda"] = {
            "horizontal_95": a.radius_95,
            "vertical_95": a.vertical_95,
            "ce90": a.radius_90,
            "le90": a.vertical_90,
            "ratio": a.ratio,
            "conditions": {"horizontal": a.conditions((0, 1)), "vertical": a.conditions((2,))},
        }
    if lengths is not None:
        out["vdi_vde_2634"] = {
            "lengths": [
                {"start": p, "end": q, "given": x, "deviation": d, "sigma": s}
                for p, q, x, d, s in zip(lengths.starts, lengths.ends, lengths.given, lengths.deviations, lengths.sigmas, strict=True)
            ],
            "largest": None if lengths.largest is None else lengths.deviations[lengths.largest],
            "conditions": lengths.conditions(),
        }
    return out
