"""Statistics of one part of a network: an adjustment whose cofactors and variance factor are those of the whole network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment.block import BlockSolver
from baarda.adjustment.covariance import Cofactors
from baarda.adjustment.datum import Datum, Defect
from baarda.adjustment.result import Adjustment
from baarda.adjustment.solver import Solver
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import TauLaw, external_reliability, mdb, standardised
from baarda.network import Table
from baarda.observations import ImagePoints
from baarda.procedures.external_reliability import MOST, external_effects
from baarda.procedures.helmert_part import Tie, tied
from baarda.procedures.helmert_stand import Part, Stand
from baarda.procedures.partition_folder import write_files

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
TableWriter = Callable[[Table, Path], object]

WORST = 1000  # rejected observations that a part tells of


class Whole(NamedTuple):
    """What a part must know of the whole network.

    Attributes
    ----------
    objective : float
        v'Pv.
    redundancy, unknowns : int
    converged : bool
    defect : int
    datum_name, datum_text : str
    """

    objective: float
    redundancy: int
    unknowns: int
    converged: bool
    defect: int
    datum_name: str
    datum_text: str


class PartSolver:
    """The solver of a part whose border is solved by the whole network: a `baarda.adjustment.solver.Solver` for the statistics.

    Parameters
    ----------
    solver : BlockSolver
        Of the part.
    border : (b, b) array
        Cofactors of its border in the whole network, in the order of the solver's border.
    """

    def __init__(self, solver: BlockSolver, border: Floats) -> None:
        self.solver, self.border = solver, border
        self.given = solver.given(border)

    @property
    def rcond(self) -> float:
        """No part has a condition number of its own."""
        return self.solver.rcond

    def at(self, lin: Any) -> Solver:
        """Return this factor for the system at a state nearby."""
        return PartSolver(self.solver.at(lin), self.border)

    def solve(self, rhs: Floats) -> Floats:
        """Return the cofactors of the part's unknowns in the whole network times (u,) or (u, k) right-hand sides on them."""
        first = self.solver.solve(rhs)
        columns = self.solver.border[0]
        scale = self.solver.lin.scale[columns].reshape(-1, *([1] * (rhs.ndim - 1))) ** 2
        more = np.zeros_like(rhs)  # in the rows of the border stands what reaches it, divided by the scale squared
        own = self.border @ (scale * first[columns])
        more[columns] = scale * (own - first[columns])
        out = first + self.solver.solve(more)
        out[columns] = own
        return np.asarray(out)

    def least_squares(self, y: Floats) -> tuple[Floats, Floats]:
        """Return x and A x for observations of this part alone."""
        x = self.solve(self.solver.lin.transposed(y))
        return x, self.solver.lin.times(x)

    def hat(self, whole: bool = True) -> list[Floats]:
        """Return for each chunk the (N, m, m) diagonal blocks of A N^-1 A'; without `whole` only their diagonals (N, m) if it is plain."""
        return self.given.hat(whole)

    def blocks(self, columns: Ints) -> Floats:
        """Return the (N, w, w) blocks of N^-1 for (N, w) columns."""
        return self.given.blocks(columns)

    def pairs(self, a: Ints, b: Ints) -> Floats:
        """Return the (len(a), len(b)) block of N^-1 for columns a and b; zero where a column is -1."""
        return self.given.pairs(a, b)


class PartCofactors(Cofactors):
    """Cofactors of the unknowns of a part in the whole network, in its datum: Q - T K' - K T' + T C T'.

    T = G (B'G)^-1, K = N^-1 B and C = B'N^-1 B of the inner constraints B'x = 0; without them Q = N^-1.
    """

    def __init__(self, part: PartSolver, count: int, rows: tuple[Floats, Floats, Floats] | None) -> None:
        super().__init__(part, cast(Datum, None), count)
        padded = None
        if rows is not None:
            t, k, c = rows
            last = np.zeros((1, c.shape[1]))  # of fixed parameters
            padded = np.concatenate([t, last]), np.concatenate([k, last]), c
        self.__dict__["_inner"] = padded

    def solve(self, rhs: Floats) -> Floats:
        """Return Q rhs of the part's unknowns, for (u,) or (u, k) right-hand sides on them."""
        out = self.solver.solve(rhs)
        if self._inner is None:
            return out
        t, k, c = self._inner[0][:-1], self._inner[1][:-1], self._inner[2]
        return np.asarray(out - t @ (k.T @ rhs) - k @ (t.T @ rhs) + t @ (c @ (t.T @ rhs)))


@dataclass(frozen=True)
class PartAdjustment(Adjustment):
    """The part of an adjusted network that one worker holds; variance factor, redundancy and cofactors are those of the whole.

    Attributes
    ----------
    whole : Whole
    part : Part
    moved : tuple of arrays, or None
        T, K and C of the inner constraints, see `PartCofactors`.
    """

    whole: Whole = field(kw_only=True)
    part: Part = field(kw_only=True)
    moved: tuple[Floats, Floats, Floats] | None = field(kw_only=True, default=None)

    @property
    def objective(self) -> float:
        """v'Pv of the whole network."""
        return self.whole.objective

    @cached_property
    def cofactors(self) -> Cofactors:
        """Cofactors of the part's unknowns in the datum chosen."""
        return PartCofactors(cast(PartSolver, self.solver), self.numbering.count, self.moved)

    def __reduce__(self) -> Any:
        raise TypeError("the statistics of a part stay with their worker")


class Statistics:
    """The adjustment of a part, made when it is first asked for; travels as a recipe."""

    def __init__(self, stand: Stand, border: Floats, whole: Whole, tie: Tie | None, inverse: Floats, k: Floats | None, c: Floats) -> None:
        self.recipe = (stand, border, whole, tie, inverse, k, c)
        self._made: PartAdjustment | None = None

    def __reduce__(self) -> Any:
        return Statistics, self.recipe

    @property
    def adjustment(self) -> PartAdjustment:
        """The adjustment."""
        if self._made is None:
            self._made = self._adjusted()
        return self._made

    def rest(self) -> None:
        """After a task: let go where memory is short."""
        if self.recipe[0].source.frugal:
            self._made = None
            self.recipe[0].rest()

    def _adjusted(self) -> PartAdjustment:
        stand, border, whole, tie, inverse, k, c = self.recipe
        part, lin, solver = stand.part, stand.lin, stand.solver
        columns = solver.border[0]
        place = np.argsort(part.border)[np.searchsorted(np.sort(part.border), columns)] if len(columns) else columns
        given = PartSolver(solver, border[np.ix_(place, place)])
        moved = None
        if tie is not None and k is not None:
            moved = (tied(stand, tie)[0] @ inverse, k, c)
        none = np.zeros(0, dtype=np.intp)
        defect = Defect(np.zeros((lin.unknowns.count, whole.defect)), (), np.zeros((7, whole.defect)), False)
        datum = Datum(whole.datum_name, defect, none, None, whole.datum_text)
        return PartAdjustment(
            network=stand.state.write_to(part.network).shifted(-part.shift),
            start=part.start.write_to(part.network).shifted(-part.shift),
            numbering=part.unknowns,
            groups=tuple(part.groups),
            lin=lin,
            solver=given,
            solver_name="block",
            datum=datum,
            redundancy=whole.redundancy,
            history=(),
            status="converged" if whole.converged else "not_converged",
            aside=part.aside,
            assumptions=part.assumptions,
            shift=part.shift,
            whole=whole,
            part=part,
            moved=moved,
        )


def statistics(stand: Stand, border: Floats, whole: Whole, tie: Tie | None, inverse: Floats, k: Floats | None, c: Floats) -> Statistics:
    """Return the statistics of a part, from the cofactors (b, b) of its border in the order of its codes, and those of the constraints."""
    return Statistics(stand, border, whole, tie, inverse, k, c)


class ImageSums(NamedTuple):
    """Of the images of the border that a part holds: their codes, numbers of image points, sums of squared residuals."""

    codes: Ints
    points: Ints
    squares: Floats


def image_sums(s: Statistics) -> ImageSums:
    """Return what the residuals of a part say of the images of the border."""
    count, square = _of_images(s.adjustment)
    found = [(c, s.adjustment.part.number_of("image", label)) for c, kind, label in _border(s.adjustment.part) if kind == "image"]
    codes, at = np.array([f[0] for f in found], dtype=np.intp), np.array([f[1] for f in found], dtype=np.intp)
    s.rest()
    return ImageSums(codes, count[at], square[at])


def _border(part: Part) -> list[tuple[int, str, str]]:
    return [(code, kind, label) for code, (kind, label) in zip(part.source.codes, part.source.border, strict=True)]


def _of_images(a: PartAdjustment) -> tuple[Ints, Floats]:
    n = len(a.network.images.labels)
    count, square = np.zeros(n, dtype=np.intp), np.zeros(n)
    for g, group in enumerate(a.groups):
        if isinstance(group, ImagePoints):
            v = a.residuals[a.offsets[g] : a.offsets[g + 1]].reshape(-1, 2)
            count += np.bincount(group.images, minlength=n)
            square += np.bincount(group.images, weights=(v**2).sum(axis=1), minlength=n)
    return count, square


class PartSummary(NamedTuple):
    """What a part tells of its observations and points.

    Attributes
    ----------
    redundancy : float
        Sum of its redundancy numbers.
    tested, uncontrolled, beyond : int
        Observations that were tested, could not be, and were rejected.
    rejected : tuple of dict
        The worst of them.
    extreme : (str, float, float)
        Label, statistic and p-value of the extreme one.
    image_squares : (2,) array
        Sums of squared residuals of image points in x and y.
    image_points : int
    check_points : tuple of dict
    unknowns : tuple of dict
        Rows of the cameras that the part owns.
    project_sha256 : str
        Of the adjusted network that was written; empty where none was.
    """

    redundancy: float
    tested: int
    uncontrolled: int
    beyond: int
    rejected: tuple[dict[str, Any], ...]
    extreme: tuple[str, float, float] | None
    image_squares: Floats
    image_points: int
    check_points: tuple[dict[str, Any], ...]
    unknowns: tuple[dict[str, Any], ...]
    project_sha256: str = ""


def observation_table(a: PartAdjustment, options: Options) -> Table:
    """Return the observation table of a part as that of a whole adjustment; without tests where it did not converge."""
    table = a.observations
    if not a.whole.converged:
        return Table({**table.columns, "status": np.full(len(table), "used", dtype=object)}, table.units)
    pv, pqvvp, share = a.pv, a.pqvvp, a.controlled_share
    w = standardised(pv, pqvvp, 1.0, share)
    tau = standardised(pv, pqvvp, a.sigma0, share)
    judged, law = (tau, TauLaw(a.redundancy)) if options.sigma == "aposteriori" else (w, stats.norm())
    seen = np.isfinite(judged)
    smallest = mdb(share / np.where(seen, pqvvp, 1.0), share, 1.0, options.alpha_outlier, options.power)
    n = len(pv)
    effect, on = np.full(n, np.nan), np.full(n, "", dtype=object)
    if 1.0 * a.whole.unknowns**2 <= MOST:  # as in one piece
        effects = external_effects(a, smallest)
        effect, on = effects.values, effects.names
    more = {
        "w": w,
        "tau": tau,
        "mdb": smallest,
        "external": external_reliability(np.where(np.abs(share - 1.0) < 1e-12, 1.0, share), options.alpha_outlier, options.power),
        "estimated_error": np.divide(-pv, pqvvp, out=np.full(n, np.nan), where=seen),
        "p_value": 2.0 * np.asarray(law.sf(np.abs(judged))),
        "effect": effect,
        "effect_on": on,
        "status": np.full(n, "used", dtype=object),
    }
    return Table({**table.columns, **more}, table.units)


def owned_rows(part: Part, kind: str, labels: Any) -> NDArray[np.bool_]:
    """Return which labels of a kind the part writes the rows of."""
    own = set(part.source.owned)
    away = {label for code, k, label in _border(part) if k == kind and code not in own}
    return np.array([label not in away for label in labels], dtype=bool)


def tables_of(a: PartAdjustment, options: Options, border_images: ImageSums) -> dict[str, Table]:
    """Return the tables of a part: rows of the border are those that it owns, with the sums over all parts."""
    images = dict(a.image_table(options.sigma).columns)
    count, squares = np.array(images["points"]), np.array(images["rms"])
    at = {label: i for i, label in enumerate(images["image"].tolist())}
    code_of = {code: label for code, kind, label in _border(a.part) if kind == "image"}
    for code, n, square in zip(*(b.tolist() for b in border_images), strict=True):
        row = at[code_of[code]]
        count[row], squares[row] = n, np.sqrt(square / (2 * n)) if n else np.nan
    images |= {"points": count, "rms": squares}
    mine = owned_rows(a.part, "image", images["image"].tolist())
    unknowns = a.unknown_table(options.sigma)
    away = {f"{kind} {label}: " for code, kind, label in _border(a.part) if code not in set(a.part.source.owned)}
    keep = np.array([name[: name.rfind(": ") + 2] not in away for name in unknowns["name"]], dtype=bool)
    return {
        "observations": observation_table(a, options),
        "points": a.point_table(options.sigma),
        "images": Table({name: column[mine] for name, column in images.items()}),
        "unknowns": Table({name: column[keep] for name, column in unknowns.columns.items()}),
    }


def finished(
    s: Statistics, options: Options, border_images: ImageSums, out: str | None, name: str, write: TableWriter | None
) -> PartSummary:
    """Write the tables and the adjusted project of a part, and tell what belongs to the whole.

    Parameters
    ----------
    s : Statistics
    options : Options
    border_images : ImageSums
        Of the images of the border that the part owns, over all parts.
    out : str or None
        The folder of the result; tables go to ``tables/KIND/NAME``, the adjusted network to ``project/NAME``.
    name : str
        Of the part.
    write : callable or None
        Writes a table to a path without extension.
    """
    a = s.adjustment
    made = tables_of(a, options, border_images)
    sha256 = ""
    if out is not None and write is not None:
        for kind, table in made.items():
            write(table, Path(out) / "tables" / kind / name)
        sha256 = write_files(a.network, Path(out) / "project" / name)
    summary = _summary(a, made, options)._replace(project_sha256=sha256)
    s.rest()
    return summary


def all_tables(s: Statistics, options: Options, border_images: ImageSums) -> dict[str, Table]:
    """Return the tables of a part, for small networks."""
    return tables_of(s.adjustment, options, border_images)


def _summary(a: PartAdjustment, made: dict[str, Table], options: Options) -> PartSummary:
    o = made["observations"]
    image = np.array([isinstance(g, ImagePoints) for g in a.groups], dtype=bool)
    squares, count = np.zeros(2), 0
    for g in np.flatnonzero(image):
        v = a.residuals[a.offsets[g] : a.offsets[g + 1]].reshape(-1, 2)
        squares += (v**2).sum(axis=0)
        count += len(v)
    rejected: tuple[dict[str, Any], ...] = ()
    tested = uncontrolled = beyond = 0
    extreme = None
    if "p_value" in o.columns:
        p = o["p_value"]
        tested, uncontrolled = int(np.isfinite(p).sum()), int(np.isnan(p).sum())
        out = np.flatnonzero(p <= options.alpha_outlier * (1.0 + 1e-12))
        beyond = len(out)
        judged = o["tau"] if options.sigma == "aposteriori" else o["w"]
        worst = out[np.argsort(-np.abs(judged[out]), kind="stable")][:WORST]
        keys = ("group", "image", "point", "component", "residual", "redundancy", "w", "tau", "mdb", "estimated_error", "p_value")
        rejected = tuple({k: _plain(o[k][i]) for k in keys} for i in worst)
        if tested:
            i = int(np.nanargmax(np.abs(judged)))
            words = [f"image {o['image'][i]}" if o["image"][i] else str(o["group"][i])]
            words += [f"point {o['point'][i]}"] if o["point"][i] else []
            extreme = (" ".join([*words, str(o["component"][i])]), float(judged[i]), float(p[i]))
    unknowns = tuple(row for row in made["unknowns"].rows() if row["group"] not in ("image", "point"))
    return PartSummary(
        float(a.redundancy_numbers.sum()), tested, uncontrolled, beyond, rejected, extreme, squares, count, _check_points(a), unknowns
    )


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _check_points(a: PartAdjustment) -> tuple[dict[str, Any], ...]:
    """Return differences and a-posteriori standard deviations of the check points."""
    points = a.network.points
    rows = np.flatnonzero(a.judges)
    if not len(rows):
        return ()
    d = points.coordinates[rows] - points.given[rows]
    s = a.sigma0 * np.sqrt(np.einsum("nii->ni", a.point_cofactors[rows]))
    return tuple(
        {"point": points.labels[i]} | dict(zip(("dx", "dy", "dz", "sx", "sy", "sz"), [*di.tolist(), *si.tolist()], strict=True))
        for i, di, si in zip(rows.tolist(), d, s, strict=True)
    )
