"""What several sections need of an analysis, derived once and told in one way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED
from baarda.hypotheses.base import TestResult
from baarda.network import AXES, CONTROL
from baarda.observations import Direct, ImageCoordinates, ImagePoints, component_unit
from baarda.procedures.testing import Analysis
from baarda.report.sections.base import say

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

MOST_ROWS = 200


def result_of(analysis: Analysis, name: str) -> TestResult | None:
    """Return the first test of this name."""
    found = analysis.tests_named(name)
    return found[0] if found else None


def scaling(analysis: Analysis) -> str:
    """Return which variance factor scales standard deviations, in words."""
    return "a posteriori" if analysis.options.sigma == "aposteriori" else "a priori"


def judge(analysis: Analysis) -> tuple[str, Floats, float]:
    """Return the statistic that judges single observations (tau or w), its values and the limit of its size."""
    name, values = ("tau", analysis.tau) if analysis.options.sigma == "aposteriori" else ("w", analysis.w)
    test = result_of(analysis, "data_snooping")
    critical = np.nan if test is None else float(np.max(np.abs(test.critical)))
    return name, values, critical


def image_rows(analysis: Analysis) -> NDArray[np.bool_]:
    """Return which scalar observations are image coordinates."""
    a = analysis.adjustment
    return np.concatenate([np.full(len(g) * len(g.components), isinstance(g, (ImageCoordinates, ImagePoints))) for g in a.groups])


def unit_of(analysis: Analysis, row: int) -> str:
    """Return the unit of a scalar observation."""
    a = analysis.adjustment
    g = int(np.searchsorted(a.offsets, row, side="right")) - 1
    group: Any = a.groups[g]
    if isinstance(group, Direct):
        i = row - int(a.offsets[g])
        if group.kind == "camera":
            return str(a.network.cameras[group.nodes[i]].unit_of(int(group.positions[i])))
        if group.kind == "image":
            return "rad" if group.positions[i] >= 3 else a.network.unit
    return component_unit(group, (row - int(a.offsets[g])) % len(group.components))


def rows_by_unit(analysis: Analysis, rows: Ints) -> dict[str, Ints]:
    """Return scalar observations, ascending, by their unit in the order in which the units appear: units are never mixed."""
    a = analysis.adjustment
    parts: list[tuple[str, Ints]] = []
    places = np.searchsorted(a.offsets, rows, side="right") - 1
    for g in np.unique(places).tolist():
        at, group = rows[places == g], a.groups[g]
        # Directly observed values have units of their own, row by row; others one for each component.
        if isinstance(group, Direct):
            parts += [(unit_of(analysis, row), np.array([row], dtype=np.intp)) for row in at.tolist()]
            continue
        component = (at - int(a.offsets[g])) % len(group.components)
        parts += [(unit_of(analysis, int(at[component == c][0])), at[component == c]) for c in np.unique(component).tolist()]
    joined: dict[str, list[Ints]] = {}
    for unit, at in sorted(parts, key=lambda p: int(p[1][0])):
        joined.setdefault(unit, []).append(at)
    return {unit: np.sort(np.concatenate(at)) for unit, at in joined.items()}


def label_of(analysis: Analysis, row: int) -> str:
    """Return the name of a scalar observation: image, point and component; its group where it is no image coordinate."""
    a, table = analysis.adjustment, analysis.observations
    g = int(np.searchsorted(a.offsets, row, side="right")) - 1
    image, point = table["image"][row], table["point"][row]
    head = "" if isinstance(a.groups[g], (ImageCoordinates, ImagePoints)) else f"{table['group'][row]},"
    parts = (
        head,
        say("image {name}", name=image) if image else "",
        say("point {name}", name=point) if point else "",
        str(table["component"][row]),
    )
    return " ".join(part for part in parts if part)


def bare(name: str, analysis: Analysis) -> str:
    """Return the name of a camera parameter without its camera where there is only one."""
    cameras = analysis.adjustment.network.cameras
    return name.removeprefix(f"camera {cameras[0].label}: ") if len(cameras) == 1 else name


@dataclass(frozen=True)
class Share:
    """A part of the observations with its statistics; see `shares`."""

    group: str
    component: str
    rows: Ints
    unit: str
    redundancy: float
    rms: float
    vpv: float

    @property
    def sigma0(self) -> float:
        """The standard deviation of unit weight of this part, sqrt(v'Pv / sum of redundancy numbers)."""
        return float(np.sqrt(self.vpv / self.redundancy)) if self.redundancy > 1e-10 and self.vpv >= 0.0 else float("nan")


def shares(analysis: Analysis) -> list[Share]:
    """Return the statistics of each observation group and, where it has several of few kinds, each component."""
    a = analysis.adjustment
    e = analysis.evidence
    pv = e.residuals / e.sigmas**2 if e.pv is None else e.pv
    energy, r = pv * e.residuals, a.redundancy_numbers
    components = analysis.observations["component"]
    out = []
    for g, group in enumerate(a.groups):
        rows = np.arange(a.offsets[g], a.offsets[g + 1])
        kinds = list(dict.fromkeys(components[rows].tolist()))
        parts = [("", rows)]
        if 1 < len(kinds) <= 12:
            parts += [(kind, rows[components[rows] == kind]) for kind in kinds]
        for kind, at in parts:
            units = {unit_of(analysis, int(i)) for i in at[: 2000 if isinstance(group, Direct) else len(group.components)]}
            same = len(units) == 1
            rms = float(np.sqrt(np.mean(e.residuals[at] ** 2))) if same else float("nan")
            out.append(Share(group.name, kind, at, units.pop() if same else "", float(r[at].sum()), rms, float(energy[at].sum())))
    return out


def sensor_residuals(analysis: Analysis, camera: int) -> tuple[Floats, Floats]:
    """Return measured positions and residuals of all image points of a camera, (n, 2) each, pixels."""
    a = analysis.adjustment
    xy, v = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for g, group in enumerate(a.groups):
        if isinstance(group, ImagePoints):
            chosen = a.network.images.cameras[group.images] == camera
            xy.append(group.xy[chosen])
            v.append(a.residuals[a.offsets[g] : a.offsets[g + 1]].reshape(-1, 2)[chosen])
    return np.concatenate(xy), np.concatenate(v)


def correlation_matrix(cofactors: Floats) -> Floats:
    """Return the correlations of a cofactor matrix; NaN (told as missing) where a variance is not positive."""
    q = np.diag(cofactors)
    s = np.sqrt(np.where(q > 0.0, q, np.nan))
    return np.asarray(cofactors / s[:, None] / s[None, :])


def deviations_of(variances: Floats, of: Floats) -> Floats:
    """Return standard deviations of differences of variances: zero up to rounding in the variances `of` that they are parts of, NaN below.

    Examples
    --------
    >>> deviations_of(np.array([4.0, -1e-17, -0.1]), np.ones(3))
    array([ 2.,  0., nan])
    """
    rounded = np.where(np.abs(variances) <= 1e-10 * of, 0.0, variances)
    return np.sqrt(np.where(rounded >= 0.0, rounded, np.nan))


def point_sigmas(analysis: Analysis) -> tuple[Any, Floats]:
    """Return the point table and the (n, 3) standard deviations of the points; zero where a coordinate is fixed."""
    table = analysis.adjustment.point_table(analysis.options.sigma)
    return table, np.stack([table[f"s{axis}"] for axis in AXES], axis=1)


def almost_infinite(analysis: Analysis) -> NDArray[np.bool_]:
    """Return which rows of the point table are of points that cannot be told from infinity."""
    a = analysis.adjustment
    which = np.zeros(len(a.aside), dtype=bool)
    which[a.far.points] = True
    return which[~a.aside]


def spatial(sigmas: Floats) -> Floats:
    """Return the spatial standard deviation sqrt(sX^2 + sY^2 + sZ^2)."""
    return np.asarray(np.sqrt((sigmas**2).sum(axis=1)))


def first(count: int, most: int, where: str) -> str:
    """Return the note of a shortened table, empty where it is whole."""
    return say("The first {most} of {count} rows; all are in {where}.", most=most, count=count, where=where) if count > most else ""


@dataclass(frozen=True)
class Cluster:
    """A point or an image at which more observations are suspected than chance would gather there."""

    kind: str
    label: str
    suspected: int
    tested: int
    known: str  # "fixed control", "weighted control" or empty


def clusters(analysis: Analysis) -> list[Cluster]:
    """Return the points and images where suspected observations gather (binomial tail below 0.001 after Bonferroni), the largest first."""
    from scipy import stats

    rows = analysis.suspected
    e, points = analysis.evidence, analysis.adjustment.network.points
    tested = np.isfinite(analysis.tau)
    out = []
    for kind, codes, labels in (("point", e.points, e.point_names), ("image", e.images, e.image_names)):
        if codes is None or len(rows) < 3:
            continue
        here = codes >= 0
        total = np.bincount(codes[here & tested], minlength=len(labels))
        found = np.bincount(codes[rows][codes[rows] >= 0], minlength=len(labels))
        share = found.sum() / max(int(total.sum()), 1)
        p = stats.binom.sf(found - 1, np.maximum(total, 1), share)
        for i in np.flatnonzero((found >= 3) & (p * np.count_nonzero(total) < 0.001)):
            known = ""
            if kind == "point" and points.roles[i] == CONTROL:
                known = "fixed control" if (points.states[i] == FIXED).all() else "weighted control"
            out.append(Cluster(kind, labels[i], int(found[i]), int(total[i]), known))
    return sorted(out, key=lambda c: -c.suspected)


def insignificant(analysis: Analysis) -> tuple[list[str], Sequence[str]]:
    """Return the names of the additional parameters that do not differ from zero, and of all that were tested."""
    test = result_of(analysis, "additional_parameter")
    if test is None:
        return [], ()
    return [bare(n, analysis) for n, r in zip(test.labels, np.asarray(test.rejected), strict=True) if not r], test.labels
