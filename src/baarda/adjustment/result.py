"""What an adjustment found: unknowns, residuals, redundancy numbers, any block of the covariance matrix, and the evidence for tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from baarda.adjustment import estimates, tables
from baarda.adjustment.covariance import Cofactors
from baarda.adjustment.datum import Datum
from baarda.adjustment.datum_precision import DatumPrecision, datum_precision
from baarda.adjustment.far_points import FarPoints, far_points
from baarda.adjustment.linear_system import Chunk, Linearization
from baarda.adjustment.linearize import offsets_of
from baarda.adjustment.memory import release
from baarda.adjustment.solver import Solver
from baarda.errors import UsageError
from baarda.geometry import rotation as rot
from baarda.hypotheses.base import Estimates, Evidence
from baarda.network import CHECK, Network, State, Table, Unknowns
from baarda.observations import CorrelatedPoints, Direct, ImageCoordinates, ImagePoints, Kind

if TYPE_CHECKING:
    from baarda.adjustment.robust import LawOfErrors

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Scaling = Literal["apriori", "aposteriori"]


@dataclass(frozen=True)
class Iteration:
    """One step: v'Pv (or, under a law of errors, minus the log-likelihood) after it, the relative step, damping, whether it was taken."""

    count: int
    objective: float
    relative_step: float | None
    damping: float
    accepted: bool


@dataclass(frozen=True)
class Adjustment:
    """A network adjusted by least squares, or by maximum likelihood under another law of errors.

    Under a law, `redundancy_numbers`, `qvv`, `controlled_share` and `residuals_of` still describe the geometry, that is the least-squares
    adjustment of the same observations, but no longer the residuals: the evidence leaves them out.

    Attributes
    ----------
    network : Network
        With adjusted values.
    start : Network
        With start values.
    numbering : Unknowns
        Names and columns of the unknowns.
    groups : tuple of observation groups
        All observations that took part, direct ones included.
    lin : Linearization
        The whitened system at the solution, coordinates reduced by `shift`.
    solver : Solver
        Its factor.
    datum : Datum
    redundancy : int
        r = n - u + d, less the combinations of observations that no condition of a combined model controls.
    history : tuple of Iteration
    status : {"converged", "not_converged"}
    aside : (points,) bool array
        Points set aside.
    assumptions : tuple of str
    law : LawOfErrors or None
        The law of errors of a maximum-likelihood adjustment with its values; None for least squares.
    """

    network: Network
    start: Network
    numbering: Unknowns
    groups: tuple[Kind, ...]
    lin: Linearization
    solver: Solver
    solver_name: str
    datum: Datum
    redundancy: int
    history: tuple[Iteration, ...]
    status: str
    aside: NDArray[np.bool_]
    assumptions: tuple[str, ...]
    shift: Floats
    law: LawOfErrors | None = None

    # ---- numbers of the whole ----
    @property
    def count(self) -> int:
        """The number n of observations."""
        return self.lin.count

    @property
    def objective(self) -> float:
        """v'Pv."""
        return float(self.lin.misclosure @ self.lin.misclosure)

    @property
    def variance_factor(self) -> float:
        """The a-posteriori variance factor s0^2 = v'Pv / r."""
        return self.objective / self.redundancy

    @property
    def sigma0(self) -> float:
        """The a-posteriori standard deviation of unit weight (a priori it is 1)."""
        return float(np.sqrt(self.variance_factor))

    def scale(self, sigma: Scaling) -> float:
        """Return sigma0 a priori (1) or a posteriori: what the roots of cofactors are multiplied with.

        Under a law of errors the root of its covariance factor; a priori with the law's standard deviation (its scale, where it has none)
        taken as 1 instead of as estimated.
        """
        if sigma not in ("apriori", "aposteriori"):
            raise UsageError(f"sigma must be 'apriori' or 'aposteriori', not {sigma!r}")
        if self.law is not None:
            deviation = self.law.distribution.std()
            size = deviation if np.isfinite(deviation) else self.law.scale
            return float(np.sqrt(self.law.covariance_factor)) / (size if sigma == "apriori" else 1.0)
        return 1.0 if sigma == "apriori" else self.sigma0

    # ---- observations ----
    @cached_property
    def offsets(self) -> Ints:
        """First scalar row of each group, and n."""
        return offsets_of(self.groups)

    @cached_property
    def residuals(self) -> Floats:
        """v = adjusted - observed of all n observations, each in its unit."""
        return self._of_misclosures(lambda sigma, white: -white * sigma, lambda f, white: -(f @ white[:, :, None])[:, :, 0])

    @cached_property
    def sigmas(self) -> Floats:
        """A-priori standard deviations of all n observations; one number in memory where all are equal."""
        given = [g.sigma() for g in self.groups]
        if all(not any(s.strides) and s.flat[0] == given[0].flat[0] for s in given):
            return np.broadcast_to(given[0].flat[0], (self.count,))
        return np.concatenate([s.ravel() for s in given])

    def _of_misclosures(self, plain: Callable[[Floats, Floats], Floats], full: Callable[[Floats, Floats], Floats]) -> Floats:
        """Put together one number of each observation, of standard deviations (N, m) or factors (N, m, m) and whitened misclosures."""
        out = np.empty(self.count)
        for c in self.lin.chunks:
            correlated = c.correlated
            for some in c.pieces():
                rows, factor = c.rows_of(some), c.factor[some]
                white = self.lin.misclosure[rows]
                out[rows] = full(factor, white) if correlated else plain(np.einsum("nii->ni", factor), white)
        return out

    @cached_property
    def _shares(self) -> tuple[Floats, dict[int, Floats]]:
        """The redundancy numbers, and by their number the hats of the chunks that are not plain."""
        with threadpool_limits(limits=1, user_api="blas"):
            hats = self.solver.hat(whole=False)
        whole = {k: hat for k, (c, hat) in enumerate(zip(self.lin.chunks, hats, strict=True)) if not c.plain}
        out = np.empty(self.count)
        for k, c in enumerate(self.lin.chunks):
            for some in c.pieces():
                if k in whole:
                    left, inverse = c.factor[some] @ _rest(c, whole[k], some), np.linalg.inv(c.factor[some])
                    out[c.rows_of(some)] = np.einsum("nij,nji->ni", left, inverse)
                else:
                    out[c.rows_of(some)] = 1.0 - hats[k][some]
        del hats
        release(self.count)
        return out, whole

    def _diagonal(self, plain: Callable[[Floats, Floats], Floats], full: Callable[[Floats, Floats], Floats]) -> Floats:
        """Put together one number of each observation.

        `plain` makes it of standard deviations (N, m) and redundancy numbers, `full` of the factors (N, m, m) and the blocks I - H of
        whitened residuals of correlated observations, or of those that their conditions control in part only.
        """
        redundancy, whole = self._shares
        out = np.empty(self.count)
        for k, c in enumerate(self.lin.chunks):
            for some in c.pieces():
                rows, factor = c.rows_of(some), c.factor[some]
                if k in whole:
                    out[rows] = full(factor, _rest(c, whole[k], some))
                else:
                    out[rows] = plain(np.einsum("nii->ni", factor), redundancy[rows])
        return out

    @property
    def redundancy_numbers(self) -> Floats:
        """r_i = (Qvv P)_ii of all n observations; they sum to r."""
        return self._shares[0]

    @property
    def controlled_share(self) -> Floats:
        """(P Qvv P)_ii / P_ii, between 0 and 1.

        The redundancy number of uncorrelated observations, and what stands for it in w, mdb and external reliability of correlated ones.
        """
        return self.pqvvp / self._diagonal(lambda sigma, _: 1.0 / sigma**2, lambda f, _: _squares(np.linalg.inv(f)))

    @cached_property
    def qvv(self) -> Floats:
        """Diagonal of the cofactor matrix of the residuals."""
        if all(c.plain and not c.factor.strides[0] and (np.diagonal(c.factor[0]) == 1.0).all() for c in self.lin.chunks if len(c.first)):
            return self.redundancy_numbers  # all standard deviations are 1
        return self._diagonal(lambda sigma, r: r * sigma**2, lambda f, rest: np.einsum("nij,nij->ni", f @ rest, f))

    @cached_property
    def pv(self) -> Floats:
        """P v."""
        return self._of_misclosures(
            lambda sigma, white: -white / sigma, lambda f, white: -(np.linalg.inv(f).transpose(0, 2, 1) @ white[:, :, None])[:, :, 0]
        )

    @cached_property
    def pqvvp(self) -> Floats:
        """Diagonal of P Qvv P."""
        return self._diagonal(lambda sigma, r: r * (1.0 / sigma**2), lambda f, rest: _quadratic(np.linalg.inv(f), rest))

    def residuals_of(self, errors: Floats) -> Floats:
        """Map standardised errors (n, k), whitened and independent, to standardised residuals -Qvv P e, each divided by its sigma."""
        with threadpool_limits(limits=1, user_api="blas"):
            white = self.lin.times(self.solver.solve(self.lin.transposed(errors))) - errors
        for c in self.lin.chunks:
            if c.controlled is not None:
                white[c.rows] += errors[c.rows] - np.einsum("nij,nj...->ni...", c.controlled, errors[c.rows])
        correlated = [c for c in self.lin.chunks if c.correlated]
        for c in correlated:
            values = np.einsum("nij,njk->nik", c.factor, white[c.rows])
            white[c.rows] = values / self.sigmas[c.rows][:, :, None]
        return np.asarray(white)

    def _codes(self) -> dict[str, Any]:
        """Group, image and point codes and component names of all observations."""
        n = self.count
        out: dict[str, Any] = {"group": np.empty(n, dtype=np.intp), "image": np.full(n, -1), "point": np.full(n, -1)}
        component = np.empty(n, dtype=object)
        for g, group in enumerate(self.groups):
            rows = slice(self.offsets[g], self.offsets[g + 1])
            m = len(group.components)
            labels = group.labels(self.network)
            out["group"][rows] = g
            for kind in ("image", "point"):
                if kind in labels:
                    out[kind][rows] = np.repeat(labels[kind], m)
            component[rows] = np.repeat(labels["component"], m) if "component" in labels else np.tile(group.components, len(group))
        out["component"] = component
        return out

    @cached_property
    def observations(self) -> Table:
        """One row per scalar observation: group, image, point, component, observed, sigma, residual, redundancy.

        Under a law of errors the redundancy numbers, which are not applicable, are NaN, and the weights of the last iteration are added.
        """
        codes = self._codes()
        images, points = (
            np.array([*self.network.images.labels, ""], dtype=object),
            np.array([*self.network.points.labels, ""], dtype=object),
        )
        observed = np.concatenate([g.observed().ravel() for g in self.groups])
        direct = np.concatenate([np.full(len(g) * len(g.components), isinstance(g, (Direct, CorrelatedPoints))) for g in self.groups])
        observed = observed - np.where(direct, self._shift_of(codes), 0.0)
        weight = {} if self.law is None else {"weight": self.law.weights}
        return Table(
            {
                "group": np.array([g.name for g in self.groups], dtype=object)[codes["group"]],
                "image": images[codes["image"]],
                "point": points[codes["point"]],
                "component": codes["component"],
                "observed": observed,
                "sigma": self.sigmas,
                "residual": self.residuals,
                "redundancy": self.redundancy_numbers if self.law is None else np.full(self.count, np.nan),
            }
            | weight
        )

    def _shift_of(self, codes: dict[str, Any]) -> Floats:
        """What the reduction to the centroid added to each directly observed coordinate."""
        axis = {"X": 0, "Y": 1, "Z": 2, "X0": 0, "Y0": 1, "Z0": 2}
        shift = np.append(self.shift, 0.0)
        return np.asarray(shift[[axis.get(c, 3) for c in codes["component"]]])

    # ---- unknowns ----
    @cached_property
    def cofactors(self) -> Cofactors:
        """Cofactors of the unknowns in the datum chosen."""
        return Cofactors(self.solver, self.datum, self.numbering.count)

    def covariance(self, a: str | Sequence[str], b: str | Sequence[str] | None = None, sigma: Scaling = "aposteriori") -> Any:
        """Return covariances of named unknowns.

        Parameters
        ----------
        a, b : str or sequence of str
            Names like ``"camera 1: K1"``; without b the covariance matrix of a.
        sigma : {"aposteriori", "apriori"}
            Which variance factor scales the cofactors.

        Returns
        -------
        float or (len(a), len(b)) array
            A number if both are single names. Image angles are increments about the camera axes (radians).

        Raises
        ------
        UsageError
            If a name is not that of an unknown.
        """
        b = a if b is None else b
        columns = [np.array([self.numbering.column(n) for n in ([x] if isinstance(x, str) else x)]) for x in (a, b)]
        block = self.scale(sigma) ** 2 * self.cofactors.of(columns[0], columns[1])
        return float(block[0, 0]) if isinstance(a, str) and isinstance(b, str) else block

    def _blocks(self, kind: str, width: int) -> Floats:
        group = self.numbering[kind]
        return self.cofactors.blocks(group.columns.reshape(-1, width))

    @cached_property
    def point_cofactors(self) -> Floats:
        """(points, 3, 3) cofactors of X Y Z; zero for fixed coordinates."""
        return self._blocks("point", 3)

    @cached_property
    def image_cofactors(self) -> Floats:
        """(images, 6, 6) cofactors of X0 Y0 Z0 omega phi kappa; NaN for angles at the singularity."""
        q = self._blocks("image", 6)
        t = np.zeros((len(q), 6, 6))
        t[:, :3, :3] = np.eye(3)
        t[:, 3:, 3:] = rot.angle_partials(self.network.images.rotation)
        return np.asarray(t @ q @ t.transpose(0, 2, 1))

    @cached_property
    def camera_estimates(self) -> Estimates:
        """All estimated camera parameters with their joint cofactors."""
        return estimates.of_cameras(self, additional_only=False)

    def camera_correlations(self, limit: float = 0.95) -> list[tuple[str, str, float]]:
        """Return the pairs of unknowns with a camera parameter whose correlation reaches the limit, the highest first.

        Camera parameters among themselves, and with the orientation unknowns of the images.
        """
        return estimates.camera_correlations(self, limit)

    @cached_property
    def additional_estimates(self) -> Estimates:
        """Additional camera parameters, and what declared groups call removable, with their joint cofactors."""
        return estimates.removable(self)

    @cached_property
    def evidence(self) -> Evidence:
        """Everything that tests may ask for.

        Under a law of errors only what holds there: residuals, and estimates with a variance factor (covariance factor of the law), so that
        tests of parameters and of check points are Wald tests. `baarda.adjustment.robust.NOT_APPLICABLE` lists the tests to leave out;
        `NOT_CHECKED`, `NOT_ENOUGH` and `NOT_APRIORI` say when others are.
        """
        codes = self._codes()
        names = tuple(dict.fromkeys(codes["component"].tolist()))
        index = {name: i for i, name in enumerate(names)}
        kinds = (ImageCoordinates, ImagePoints)
        image_rows = np.concatenate([np.full(len(g) * len(g.components), isinstance(g, kinds)) for g in self.groups])
        interior = self.camera_estimates
        additional = self.additional_estimates
        evidence = Evidence(
            residuals=self.residuals,
            sigmas=self.sigmas,
            vpv=self.objective,
            redundancy=self.redundancy,
            unknowns=self.numbering.count,
            qvv=self.qvv,
            redundancy_numbers=self.redundancy_numbers,
            pv=self.pv,
            pqvvp=self.pqvvp,
            groups=codes["group"],
            images=np.where(image_rows, codes["image"], -1),
            points=codes["point"],
            components=np.array([index[c] for c in codes["component"]], dtype=np.intp),
            group_names=tuple(g.name for g in self.groups),
            image_names=self.network.images.labels,
            point_names=self.network.points.labels,
            component_names=names,
            additional=additional if additional.names else None,
            interior=interior if interior.names else None,
            check=estimates.of_check_points(self),
            control=estimates.of_control(self),
            residuals_of=self.residuals_of,
        )
        if self.law is None:
            return evidence
        return replace(
            evidence,
            vpv=self.law.covariance_factor * self.redundancy,
            qvv=None,
            redundancy_numbers=None,
            pv=None,
            pqvvp=None,
            control=None,
            residuals_of=None,
        )

    @cached_property
    def unknowns(self) -> Table:
        """One row per unknown: name, group, unit, value, sigma (a posteriori), initial, state."""
        return self.unknown_table("aposteriori")

    def unknown_table(self, sigma: Scaling) -> Table:
        """Return the table of unknowns with sigmas of either variance factor."""
        return tables.unknown_table(self, sigma)

    @cached_property
    def points(self) -> Table:
        """One row per object point that took part, sigmas a posteriori."""
        return self.point_table("aposteriori")

    def point_table(self, sigma: Scaling, probability: float = 0.95) -> Table:
        """Return coordinates, sigmas, correlations, rays and confidence regions of the points; see `tables.point_table`."""
        return tables.point_table(self, sigma, probability)

    @cached_property
    def images(self) -> Table:
        """One row per image, sigmas a posteriori."""
        return self.image_table("aposteriori")

    def image_table(self, sigma: Scaling) -> Table:
        """Return exterior orientation with sigmas, number of points and rms of the residuals of each image."""
        return tables.image_table(self, sigma)

    @cached_property
    def far(self) -> FarPoints:
        """The points that cannot be told from infinity; none is sought where the adjustment did not converge."""
        if self.status != "converged":
            return FarPoints(np.zeros(0, dtype=np.intp), np.zeros(0))
        return far_points(self)

    @cached_property
    def datum_precision(self) -> DatumPrecision | None:
        """How well rotation and scale of the whole network are determined; None where they are free or move no unknown."""
        return None if self.datum.defect.count else datum_precision(self.lin, State.of(self.network).shifted(self.shift))

    @cached_property
    def judges(self) -> NDArray[np.bool_]:
        """Which points judge as check points: those that took part, but not what cannot be told from infinity; none in a free network."""
        out = np.asarray((self.network.points.roles == CHECK) & ~self.aside)
        if self.datum.defect.count:  # its position, rotation or scale is that of the start values
            out[:] = False
        if out.any():
            out[self.far.points] = False
        return out

    @cached_property
    def behind(self) -> list[tuple[str, str]]:
        """Image and point of rays whose adjusted point lies behind the camera."""
        out = []
        state = State.of(self.network)
        for group in self.groups:
            if isinstance(group, ImagePoints):
                for row in np.flatnonzero(~group.in_front(self.network, state)):
                    out.append((self.network.images.labels[group.images[row]], self.network.points.labels[group.points[row]]))
        return out

    def contradictions(self, count: int = 3) -> str:
        """Return in words the observations with the largest |v / sigma|: where to look when an adjustment does not converge."""
        size = np.abs(self.residuals / self.sigmas)
        codes, out = self._codes(), []
        for row in np.argsort(-size, kind="stable")[:count]:
            named = (("image", self.network.images.labels), ("point", self.network.points.labels))
            place = [f"{kind} {labels[codes[kind][row]]}" for kind, labels in named if codes[kind][row] >= 0]
            out.append(" ".join([*place, str(codes["component"][row])]) + f" ({size[row]:.3g})")
        return "largest |v / sigma|: " + ", ".join(out)

    def with_assumptions(self, *more: str) -> Adjustment:
        """Return the result with further assumptions for the report."""
        return replace(self, assumptions=(*self.assumptions, *more))


def _rest(c: Chunk, hat: Floats, some: slice) -> Floats:
    """Return the blocks (n, m, m) of what the hats leave to whitened residuals."""
    return np.asarray((np.eye(c.m) if c.controlled is None else c.controlled[some]) - hat[some])


def _quadratic(inverse: Any, rest: Floats) -> Floats:
    """Return the diagonals (n, m) of L^-T R L^-1."""
    return np.asarray(np.einsum("nij,nji->ni", inverse.transpose(0, 2, 1) @ rest, inverse))


def _squares(inverse: Any) -> Floats:
    """Return the diagonals (n, m) of L^-T L^-1."""
    return np.asarray(np.einsum("nji,nji->ni", inverse, inverse))
