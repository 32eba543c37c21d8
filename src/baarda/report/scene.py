"""The block in space as numbers: what the static figure draws and the viewer of the page turns."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.observations import ImagePoints
from baarda.procedures.testing import Analysis
from baarda.report.sections._numbers import finer
from baarda.report.translation import tr

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

MOST_POINTS = 5000
MOST_ELLIPSOIDS = 300
MOST_RAYS = 200
AZIMUTH, ELEVATION = -60.0, 25.0  # from where the figure looks, degrees
_WHOLE = 30000  # coordinates go to the page as whole numbers up to this


@dataclass(frozen=True)
class Scene:
    """A block in space, in object units about `origin`.

    Attributes
    ----------
    points : (n, 3) array
    core : (k, 3) array
        Points that a view must hold: all but the farthest hundredth.
    sigmas : (n,) array
        Spatial standard deviations in `told`; zero = fixed.
    redundancy : (n,) array
        Mean redundancy number of the image coordinates of a point; NaN without any.
    roles, names : tuple of str
    total : int
        Points of the block, of which the n are shown.
    ellipsoids : (e,) int array
        Points with an ellipsoid, the largest first.
    covariances : (e, 3, 3) array
        Their covariances times the squared factor of the 95 % ellipsoid, object units squared.
    enlarged : float
        Factor by which ellipsoids are drawn larger.
    cameras : (m, 3) array
        Projection centres.
    axes : (m, 3, 3) array
        Rows: the camera's x, y, z axes in object space; it looks along -z.
    half : (m, 2) array
        Half width and height of the image at distance one.
    depth : float
        How long the pyramids of the cameras are drawn.
    images : tuple of str
    rays : (k, 2) int array
        Camera and point of suspected image points, the worst first.
    suspected : int
        Suspected image points, of which the k are shown.
    origin : (3,) array
    unit, told : str
        Units of coordinates and of standard deviations.
    """

    points: Floats
    core: Floats
    sigmas: Floats
    redundancy: Floats
    roles: tuple[str, ...]
    names: tuple[str, ...]
    total: int
    ellipsoids: Ints
    covariances: Floats
    enlarged: float
    cameras: Floats
    axes: Floats
    half: Floats
    depth: float
    images: tuple[str, ...]
    rays: Ints
    suspected: int
    origin: Floats
    unit: str
    told: str

    def view(self) -> Floats:
        """Return the axes to the right and upwards of the figure, (2, 3)."""
        a, e = np.radians(AZIMUTH), np.radians(ELEVATION)
        return np.array([[-np.sin(a), np.cos(a), 0.0], [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]])

    def frustum(self) -> Floats:
        """Return the centre and the four corners of the pyramid of each camera, (m, 5, 3)."""
        x, y, z = (self.axes[:, k, :] for k in range(3))
        w, h = self.half[:, :1], self.half[:, 1:]
        corners = [self.cameras + self.depth * (i * w * x + j * h * y - z) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        return np.stack([self.cameras, *corners], axis=1)

    def to_json(self, name_of: Any = str) -> str:
        """Return the scene for the viewer of the page.

        Parameters
        ----------
        name_of : callable
            Makes a name from a stranger printable.

        Returns
        -------
        str
            JSON without angle brackets or ampersands.
        """
        reach = float(np.abs(np.concatenate([self.core, self.cameras])).max()) or 1.0
        step = reach / _WHOLE
        # The farthest points may lie outside of the whole numbers: they stay where they are, with more digits.
        whole = np.rint(self.points / step).astype(int)
        document = {
            "unit": self.unit,
            "told": self.told,
            "radius": float(f"{np.linalg.norm(np.concatenate([self.core, self.cameras]), axis=1).max() / step:.6g}"),
            "view": [AZIMUTH, ELEVATION],
            "points": whole.ravel().tolist(),
            "sigma": [float(f"{s:.3g}") for s in self.sigmas.tolist()],
            "redundancy": [None if r != r else round(r, 2) for r in self.redundancy.tolist()],
            "role": "".join(r[1] for r in self.roles),  # tIe, cOntrol, cHeck
            "names": [name_of(n) for n in self.names],
            "ellipsoids": self.ellipsoids.tolist(),
            "shapes": [
                float(f"{v:.4g}")
                for c in (self.covariances * (self.enlarged / step) ** 2)
                for v in c[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].tolist()
            ],
            "cameras": np.rint(self.frustum() / step).astype(int).reshape(-1).tolist(),
            "images": [name_of(n) for n in self.images],
            "rays": self.rays.ravel().tolist(),
            "words": {
                key: tr(text)
                for key, text in {
                    "point": "point",
                    "image": "image",
                    "sigma": "spatial standard deviation",
                    "redundancy": "mean redundancy number",
                    "fixed": "fixed",
                    "help": "Drag to turn, wheel or + and - to zoom, arrow keys to turn, 0 to start again.",
                }.items()
            },
        }
        text = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
        return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def scene_of(analysis: Analysis) -> Scene | None:
    """Return the block of an adjustment in space; None without images or object points.

    Parameters
    ----------
    analysis : Analysis

    Returns
    -------
    Scene or None
    """
    a = analysis.adjustment
    net = a.network
    finite = ~a.aside
    finite[a.far.points] = False
    use = np.flatnonzero(finite)
    if not analysis.converged or not net.images.labels or not len(use):
        return None
    e = analysis.evidence
    covariances = a.scale(analysis.options.sigma) ** 2 * a.point_cofactors
    whole = np.sqrt(np.maximum(np.einsum("nii->n", covariances), 0.0))
    worst = _suspected(analysis)
    shown = _shown(use, net.points.roles, worst[:MOST_RAYS, 1], whole)
    place = np.full(len(net.points.labels), -1)
    place[shown] = np.arange(len(shown))
    redundancy = np.full(len(place), np.nan)
    if e.points is not None:
        rows = np.flatnonzero(e.points >= 0)
        count = np.bincount(e.points[rows], minlength=len(place))
        total = np.bincount(e.points[rows], weights=a.redundancy_numbers[rows], minlength=len(place))
        np.divide(total, count, out=redundancy, where=count > 0)
    coordinates, centres = net.points.coordinates[shown], net.images.position
    low, high = (np.quantile(net.points.coordinates[use], q, axis=0) for q in (0.01, 0.99))
    rim = 0.1 * float((high - low).max())
    inside = ((net.points.coordinates[use] >= low - rim) & (net.points.coordinates[use] <= high + rim)).all(axis=1)
    core = net.points.coordinates[use[inside]] if inside.any() else coordinates
    everything = np.concatenate([core, centres])
    origin = np.asarray((everything.min(axis=0) + everything.max(axis=0)) / 2.0)
    extent = float((everything.max(axis=0) - everything.min(axis=0)).max()) or 1.0
    free = shown[whole[shown] > 0.0]
    largest = free[np.argsort(-whole[free], kind="stable")][:MOST_ELLIPSOIDS]
    known = stats.f(3, a.redundancy).ppf(0.95) * 3 if analysis.options.sigma == "aposteriori" else stats.chi2(3).ppf(0.95)
    regions = covariances[largest] * float(known)
    axis = float(np.sqrt(np.median(np.linalg.eigvalsh(regions)[:, -1]))) if len(largest) else 0.0
    told, factor = finer(net.unit, whole[free])
    return Scene(
        coordinates - origin,
        core - origin,
        whole[shown] * factor,
        redundancy[shown],
        tuple(("tie", "control", "check")[r] for r in net.points.roles[shown].tolist()),
        tuple(net.points.labels[i] for i in shown),
        len(use),
        place[largest],
        regions,
        _rounded(0.02 * extent / axis) if axis > 0.0 else 1.0,
        centres - origin,
        net.images.rotation,
        _halves(net),
        0.07 * extent,
        net.images.labels,
        np.array([(i, place[p]) for i, p in worst[:MOST_RAYS].tolist() if place[p] >= 0], dtype=np.intp).reshape(-1, 2),
        len(worst),
        origin,
        net.unit,
        told,
    )


def _rounded(factor: float) -> float:
    from baarda.report.plots import nice

    return max(1.0, nice(factor))


def _suspected(analysis: Analysis) -> Ints:
    """Return image and point of the suspected image coordinates, the worst first, each once."""
    a = analysis.adjustment
    found: dict[tuple[int, int], None] = {}
    for row in analysis.suspected.tolist():
        g = int(np.searchsorted(a.offsets, row, side="right")) - 1
        group = a.groups[g]
        if isinstance(group, ImagePoints):
            i = (row - int(a.offsets[g])) // 2
            found.setdefault((int(group.images[i]), int(group.points[i])))
    return np.array(list(found), dtype=np.intp).reshape(-1, 2)


def _shown(use: Ints, roles: Any, suspected: Ints, sizes: Floats) -> Ints:
    """Return the points to show: all, or those with a role, those suspected, the weakest, and an even sample of the others."""
    if len(use) <= MOST_POINTS:
        return use
    wanted = np.zeros(len(sizes), dtype=bool)
    wanted[suspected] = True
    known = use[np.asarray(roles)[use] > 0]
    wanted[known[: MOST_POINTS // 2]] = True
    wanted[use[np.argsort(-sizes[use], kind="stable")][:MOST_ELLIPSOIDS]] = True
    rest = use[~wanted[use]]
    left = MOST_POINTS - int(wanted[use].sum())
    wanted[rest[np.linspace(0, len(rest) - 1, left).astype(int)]] = True
    return use[wanted[use]]


def _halves(net: Any) -> Floats:
    """Return half width and height of the image of each camera at distance one; a usual one where the format is not known."""
    out = []
    for c in net.cameras:
        half = np.array([0.36, 0.24])
        distance = float(c.values[0]) if c.model.order[0].startswith("principal_distance") else 0.0
        if c.image_size is not None and distance > 0.0:
            half = np.array(c.image_size) * np.abs(np.array(c.pixel_size)) / 2.0 / distance
        out.append(np.clip(half, 0.08, 1.2))
    return np.asarray(np.array(out).reshape(-1, 2)[net.images.cameras])
