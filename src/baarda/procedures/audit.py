"""Audit of another program's solution: evaluated where it stands, then compared with the rigorous minimum of the same observations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment, adjust
from baarda.adjustment.linear_system import Linearization
from baarda.errors import UsageError
from baarda.geometry import rotation as rot
from baarda.hypotheses.base import Evidence, TestResult
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import from_evidence as test_observations
from baarda.hypotheses.variance_factor import from_evidence as test_variance_factor
from baarda.network import EXTERIOR, Network, State, Table
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]

TESTED = ("global_variance_factor", "data_snooping")


@dataclass(frozen=True)
class Audit:
    """A solution as it stands, and the rigorous one.

    Attributes
    ----------
    adjustment : Adjustment
        The rigorous adjustment of the same observations, started from the solution.
    residuals : (n,) array
        v of the solution as it stands, in the units of the observations.
    objective : float
        v'Pv of the solution.
    tests : tuple of TestResult
        Global test and data snooping of the solution as it stands, with the redundancy numbers of the rigorous adjustment; empty where that
        did not converge.
    behind : int
        Rays of the solution whose point lies behind the camera.
    unknown : tuple of str
        Images and points of which the solution has no values; they are not part of it.
    """

    adjustment: Adjustment
    residuals: Floats
    objective: float
    tests: tuple[TestResult, ...]
    behind: int
    unknown: tuple[str, ...]

    @property
    def converged(self) -> bool:
        """Whether the rigorous minimum was found."""
        return self.adjustment.status == "converged"

    @property
    def excess(self) -> float:
        """By how much v'Pv of the solution exceeds the minimum, relatively."""
        return self.objective / self.adjustment.objective - 1.0

    @property
    def distance(self) -> float:
        """Root of the mean squared distance of the solution from the minimum, in sigmas of as many independent unknowns.

        From (v'Pv - min) / s0^2 = d' C^-1 d per unknown that the datum leaves: 1 = as far as another sample of the same observations.
        """
        a = self.adjustment
        free = a.numbering.count - a.datum.defect.count
        return float(np.sqrt(max(self.objective - a.objective, 0.0) / (a.variance_factor * free)))

    @cached_property
    def image_rms(self) -> tuple[float, float]:
        """Root mean square of the image residuals, pixels per coordinate: as it stands, and at the minimum."""
        a = self.adjustment
        rows = np.concatenate([np.full(len(g) * len(g.components), isinstance(g, ImagePoints)) for g in a.groups])
        stands, least = (float(np.sqrt(np.mean(v[rows] ** 2))) if rows.any() else float("nan") for v in (self.residuals, a.residuals))
        return stands, least

    @cached_property
    def differences(self) -> Table:
        """One row per unknown: name, group, unit, difference rigorous - solution, sigma (a posteriori), and their ratio.

        Rotations are increments about the camera axes, radians; in a free network the differences are those in the datum of the inner
        constraints, which the solution itself defines.
        """
        a = self.adjustment
        d, sigma = _difference(a), a.scale("aposteriori") * np.sqrt(_variances(a))
        kinds = np.array([g.kind for g in a.numbering.groups], dtype=object)[a.numbering.kinds]
        unit = np.asarray(a.unknown_table("aposteriori")["unit"], dtype=object)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(sigma > 0.0, d / sigma, np.nan)
        return Table(
            {
                "name": np.array(a.numbering.names, dtype=object),
                "group": kinds,
                "unit": unit,
                "difference": d,
                "sigma": sigma,
                "ratio": ratio,
            }
        )

    @cached_property
    def conditional_share(self) -> tuple[float, float] | None:
        """How much of the true sigma of the object points a program shows that holds the cameras fixed: median and least share.

        None without points that are unknown in all coordinates, and with combined observation equations.
        """
        a = self.adjustment
        columns = a.numbering["point"].columns.reshape(-1, 3)
        use = np.flatnonzero((columns >= 0).all(axis=1))
        if not len(use) or not self.converged:
            return None
        network = a.network.shifted(a.shift)
        state = State.of(network)
        normal = np.zeros((len(columns), 3, 3))
        for group in a.groups:
            for rows in group.linearize(network, state):
                if rows.condition is not None:
                    return None  # fewer conditions than observations: the point has no block of its own rows
                cofactor = rows.cofactor
                weight = np.eye(cofactor.shape[1]) / cofactor[:, None, :] if cofactor.ndim == 2 else np.linalg.inv(cofactor)
                for block in rows.blocks:
                    if block.kind == "point":
                        np.add.at(normal, block.nodes, np.swapaxes(block.jacobian, 1, 2) @ weight @ block.jacobian)
        conditional = np.sqrt(np.einsum("nii->ni", np.linalg.inv(normal[use])))
        marginal = np.sqrt(np.einsum("nii->ni", a.point_cofactors[use]))
        share = conditional / marginal
        return float(np.median(share)), float(share.min())

    def by_group(self) -> list[tuple[str, int, float, float, str]]:
        """Return for each group of unknowns: name, count, root mean square and largest of |difference| / sigma, and where that is."""
        t = self.differences
        out = []
        ratio = np.abs(np.asarray(t["ratio"], dtype=float))
        for kind in dict.fromkeys(t["group"].tolist()):
            rows = np.flatnonzero((t["group"] == kind) & np.isfinite(ratio))
            if len(rows):
                worst = rows[np.argmax(ratio[rows])]
                out.append((str(kind), len(rows), float(np.sqrt(np.mean(ratio[rows] ** 2))), float(ratio[worst]), str(t["name"][worst])))
        return out

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for result.json."""
        share = self.conditional_share
        return {
            "objective": self.objective,
            "minimum": self.adjustment.objective,
            "excess": self.excess,
            "distance": self.distance,
            "image_rms": {"solution": self.image_rms[0], "minimum": self.image_rms[1]},
            "converged": self.converged,
            "behind": self.behind,
            "not_in_the_solution": list(self.unknown),
            "conditional_share": None if share is None else {"median": share[0], "least": share[1]},
            "groups": [
                {"group": name, "unknowns": count, "rms": rms, "largest": largest, "at": at}
                for name, count, rms, largest, at in self.by_group()
            ],
            "tests": [
                {"name": t.name, "rejected": int(np.sum(t.rejected)), "of": int(np.size(t.rejected)), "level": t.alpha} for t in self.tests
            ],
        }


def audit(network: Network, options: Options | None = None, **settings: Any) -> Audit:
    """Evaluate a solution as it stands and adjust the same observations rigorously.

    Parameters
    ----------
    network : Network
        With the orientation of all its images.
    options : Options, optional
        Levels of the tests.
    **settings
        Of `baarda.adjustment.adjust`; not `robust`.

    Returns
    -------
    Audit

    Raises
    ------
    UsageError
        If an image has no orientation, or a law of errors is asked for.
    """
    options = Options() if options is None else options
    if settings.get("robust") is not None:
        raise UsageError("an audit evaluates by least squares; a law of errors (robust) does not go with it")
    images, points = network.images, network.points
    oriented = np.isfinite(images.position).all(axis=1) & np.isfinite(images.rotation).all(axis=(1, 2))
    if not len(images.labels) or not oriented.all():
        where = f"image {images.labels[int(np.argmin(oriented))]}" if len(images.labels) else "any image"
        raise UsageError(f"there is nothing to audit: the source has no orientation of {where}")
    result = adjust(network, **settings)
    missing = np.flatnonzero(~np.isfinite(points.coordinates).all(axis=1) & ~result.aside)
    start = result.start.shifted(result.shift)
    state = State.of(start)
    residuals = np.concatenate([-np.asarray(g.misclosures(start, state)).ravel() for g in result.groups])
    behind = sum(int((~g.in_front(start, state)).sum()) for g in result.groups if isinstance(g, ImagePoints))
    objective = result.history[0].objective
    tests: tuple[TestResult, ...] = ()
    if result.status == "converged":
        tests = _tests(_as_it_stands(result, residuals, objective), options)
    return Audit(result, residuals, objective, tests, behind, tuple(f"point {points.labels[i]}" for i in missing))


def _as_it_stands(result: Adjustment, residuals: Floats, objective: float) -> Evidence:
    """Return the evidence with the residuals of the solution; its geometry is that of the rigorous adjustment."""
    lin: Linearization = result.lin
    pv = np.empty(len(residuals))
    for c in lin.chunks:
        inverse = np.linalg.inv(c.factor)
        pv[c.rows] = (inverse.transpose(0, 2, 1) @ (inverse @ residuals[c.rows][:, :, None]))[:, :, 0]
    return replace(result.evidence, residuals=residuals, vpv=objective, pv=pv)


def _tests(evidence: Evidence, options: Options) -> tuple[TestResult, ...]:
    found = [*test_variance_factor(evidence, options), *test_observations(evidence, options)]
    return tuple(t for t in found if t.name in TESTED)


def suspected(a: Audit) -> NDArray[np.intp]:
    """Return the observations that data snooping rejects in the solution as it stands, the worst first."""
    found = [t for t in a.tests if t.name == "data_snooping"]
    if not found:
        return np.zeros(0, dtype=np.intp)
    rows = np.flatnonzero(found[0].rejected)
    return rows[np.argsort(-np.abs(np.asarray(found[0].statistic)[rows]), kind="stable")]


def _difference(a: Adjustment) -> Floats:
    """Return rigorous - solution of all unknowns; rotations as increments about the camera axes."""
    new, old = a.network, a.start
    out = np.zeros(a.numbering.count + 1)
    turn = rot.log(new.images.rotation @ old.images.rotation.transpose(0, 2, 1)) if len(new.images.labels) else np.zeros((0, 3))
    values = {
        "camera": np.concatenate([c.values - b.values for c, b in zip(new.cameras, old.cameras, strict=True)])
        if new.cameras
        else np.zeros(0),
        "image": np.concatenate([new.images.position - old.images.position, turn], axis=1).reshape(-1, len(EXTERIOR)).ravel(),
        "point": (new.points.coordinates - old.points.coordinates).ravel(),
        **{d.kind: d.values - b.values for d, b in zip(new.declared, old.declared, strict=True)},
    }
    for group in a.numbering.groups:
        out[group.columns] = values[group.kind]
    return out[:-1]


def _variances(a: Adjustment) -> Floats:
    """Return the diagonal of the cofactors of all unknowns."""
    out = np.zeros(a.numbering.count + 1)
    for g in a.numbering.groups:
        widths = np.diff(g.offsets)
        for width in np.unique(widths).tolist():
            at = g.of(np.flatnonzero(widths == width), width)
            out[at] = np.einsum("nii->ni", a.cofactors.blocks(at))
    return out[:-1]
