"""What the worker of one part does in Helmert blocking: linearise, eliminate, substitute back.

Every function here is a task: it takes the objects of its own part, which stay where they are, and small arrays, and returns either such
an object or small arrays. Points and observations are read by the worker and go nowhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment.block import BlockSolver
from baarda.adjustment.datum import products, similarity_directions, steady
from baarda.adjustment.free_motion import carried
from baarda.adjustment.linearize import check_finite, whitened_misclosures
from baarda.adjustment.solve import Settings
from baarda.errors import UsageError
from baarda.network import State
from baarda.observations import ImageCoordinates, ImagePoints, viewpoints_of
from baarda.procedures.helmert_stand import Part, Source, Stand

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]


def settled(stand: Stand, frugal: bool) -> Stand:
    """Return the part at its start values, keeping (or not keeping) between tasks what it computes."""
    part = Part.__new__(Part)
    part.__dict__.update(stand.part.__dict__)
    part.source = replace(part.source, frugal=frugal)
    out = Stand(part, stand.state)
    out.rest()
    return out


class Step(NamedTuple):
    """Increments x of the part's unknowns and the change A x of its observations."""

    x: Floats
    change: Floats


# ---- loading and the datum ------------------------------------------------------------------------------------------------------------


class Facts(NamedTuple):
    """What the coordinator knows of a part."""

    codes: Ints
    border_columns: Ints
    owned_unknowns: int
    observations: int
    uncontrolled: int
    objective: float
    squares: float
    places: int
    needed: float
    aside: tuple[str, ...]
    notes: tuple[str, ...]
    assumptions: tuple[str, ...]
    names: tuple[str, ...]
    counts: dict[str, int]
    settings: Settings


def begin(source: Source) -> Stand:
    """Read a part, number its unknowns, and return it at its start values."""
    part = Part(source)
    out = Stand(part, part.start)
    out.rest()
    return out


def facts(stand: Stand) -> Facts:
    """Linearise at the start and tell counts and sums."""
    part, lin = stand.part, stand.lin
    check_finite(lin, part.groups, part.network)
    part.structure_of(lin)
    points, roles = part.start.points, part.network.points.roles[~part.aside]
    known = points[np.isfinite(points).all(axis=1)]
    mine = _owned_nodes(part, "image", len(part.network.images.labels))
    everything = np.concatenate([known, part.start.position[mine]])
    names = tuple(part.unknowns.name(int(c)) for c in part.border)
    image_rows = sum(len(g) * len(g.components) for g in part.groups if isinstance(g, (ImageCoordinates, ImagePoints)))
    found = Facts(
        part.codes,
        part.border,
        int(part.owned.sum()),
        lin.count,
        lin.uncontrolled,
        float(lin.misclosure @ lin.misclosure),
        float((everything**2).sum()),
        len(everything),
        part.needed,
        tuple(part.network.points.labels[i] for i in np.flatnonzero(part.aside)),
        tuple(part.notes),
        tuple(part.assumptions),
        names,
        {
            "object_points": len(roles),
            "control_points": int((roles == 1).sum()),
            "check_points": int((roles == 2).sum()),
            "image_observations": image_rows,
        },
        part.settings,
    )
    stand.rest()
    return found


def _owned_nodes(part: Part, kind: str, count: int) -> Bools:
    """Return which nodes of a kind the part owns."""
    out = np.ones(count, dtype=bool)
    own = set(part.source.owned)
    for (k, label), code in zip(part.source.border, part.source.codes, strict=True):
        if k == kind and code not in own:
            out[part.number_of(kind, label)] = False
    return out


def directions(part: Part, state: State, size: float) -> Floats:
    """Return the seven similarity directions of the part's unknowns, rotation and scale per the network's size."""
    return similarity_directions(part.unknowns, state, size=size)


class DatumSums(NamedTuple):
    """What the parts add up to find the datum defect, see `baarda.adjustment.datum`: (7, 7) arrays, and the number of far points."""

    gross: Floats
    net: Floats
    triangle: Floats
    all_unknowns: Floats
    on_points: Floats
    on_images: Floats
    far: int


def datum_sums(stand: Stand, size: float) -> DatumSums:
    """Return the sums of a part by which the datum defect is found; triangles are those of QR factorisations."""
    part, lin = stand.part, stand.lin
    g = directions(part, stand.state, size)
    gross, net, image = products(lin.row_sums, lin.column_sums, lin.times, g)
    stand.rest()
    return DatumSums(
        gross,
        net,
        _triangle(image),
        _triangle(g[part.owned]),
        _triangle(g[_of_kind(part, "point")]),
        _triangle(g[_of_kind(part, "image") & part.owned]),
        int((part.unknowns["point"].columns.reshape(-1, 3)[part.far] >= 0).any(axis=1).sum()),
    )


def _triangle(a: Floats) -> Floats:
    out = np.zeros((7, 7))
    if len(a):
        r = np.linalg.qr(a, mode="r")
        out[: len(r)] = r
    return out


def _of_kind(part: Part, kind: str) -> Bools:
    columns = part.unknowns[kind].columns
    if kind == "point":  # see `baarda.adjustment.solve.choose_datum`
        columns = columns.reshape(-1, 3)[~part.far]
    out = np.zeros(part.unknowns.count, dtype=bool)
    out[columns[columns >= 0]] = True
    return out


class Candidates(NamedTuple):
    """Unknowns that may be held: their columns, norms squared of the part's columns, and directions (k, d)."""

    columns: Ints
    squares: Floats
    directions: Floats


def candidates(stand: Stand, size: float, basis: Floats) -> Candidates:
    """Return the orientation unknowns of the images, those of the border included."""
    part, lin = stand.part, stand.lin
    columns = part.unknowns["image"].columns
    columns = columns[columns >= 0]
    squares = lin.scale[columns] ** 2
    found = Candidates(columns, squares, directions(part, stand.state, size)[columns] @ basis)
    stand.rest()
    return found


def names_of(stand: Stand, columns: Ints) -> tuple[str, ...]:
    """Return the names of unknowns."""
    return tuple(stand.part.unknowns.name(int(c)) for c in columns)


@dataclass(frozen=True)
class Tie:
    """The inner constraints B'x = 0 as a part sees them.

    Attributes
    ----------
    size : float
    basis : (7, d) array
        The combinations of the seven similarity directions that are free at the present state.
    kinds : tuple of str
        Kinds of unknowns that the constraints are over.
    start : (7, d) array or None
        Those at the start values, if the conditions B are about these.
    """

    size: float
    basis: Floats
    kinds: tuple[str, ...]
    start: Floats | None


def tied(stand: Stand, tie: Tie) -> tuple[Floats, Floats]:
    """Return the basis G (u, d) and the conditions B (u, d) of a part; rows of the border that another part owns are left out of B."""
    part = stand.part
    g = directions(part, stand.state, tie.size) @ tie.basis
    b = g if tie.start is None else directions(part, part.start, tie.size) @ tie.start
    on = np.zeros(len(g), dtype=bool)
    for kind in tie.kinds:
        on |= _of_kind(part, kind)
    return g, b * (on & part.owned)[:, None]


# ---- one step -------------------------------------------------------------------------------------------------------------------------


def factored(stand: Stand, old: Stand | None, held: Ints, damping: float) -> Stand:
    """Return the part with its factor: a new one, or (old) that of the last iteration as an approximate one."""
    out = stand.with_factor(held, damping, old)
    if not out.source.frugal:
        _ = out.solver
    return out


class Reduced(NamedTuple):
    """The normal equations of a part reduced to its border, in the order of its codes: matrix, right-hand side, column norms squared."""

    matrix: Floats | None
    rhs: Floats
    column_squares: Floats | None


def reduced(stand: Stand, y: Step | None, with_matrix: bool) -> Reduced:
    """Eliminate the interior of a part: of the misclosures, or of other values in their place (the change of a step)."""
    solver = stand.solver
    where = _places(stand, solver)
    values = stand.lin.misclosure if y is None else y.change
    rhs = np.zeros(len(where))
    own = solver.reduced(values)
    rhs[:] = own[where]
    matrix = squares = None
    if with_matrix:
        matrix = solver.border[1][np.ix_(where, where)]
        squares = _column_squares(stand)
    stand.rest()
    return Reduced(matrix, rhs, squares)


def _column_squares(stand: Stand) -> Floats:
    """Return the squares of the norms of the border's columns in this part; zero where the part says nothing of them."""
    lin, border = stand.lin, stand.part.border
    scale = lin.scale[border]
    if (scale == 1.0).any():  # what stands for zero, too
        return np.asarray(lin.column_sums(np.ones(lin.count))[border])
    return np.asarray(scale**2)


def _places(stand: Stand, solver: BlockSolver) -> Ints:
    """Return where the border unknowns, in the order of the part's codes, stand in the solver's border."""
    columns = solver.border[0]
    if len(columns) != len(stand.part.border):
        raise UsageError("a border unknown is held within a part")
    order = np.argsort(columns)
    return order[np.searchsorted(columns[order], stand.part.border)] if len(columns) else order


def expanded(stand: Stand, y: Step | None, border: Floats) -> Step:
    """Substitute back from the border's solution, in the order of the part's codes."""
    solver = stand.solver
    x = np.empty(len(border))
    x[_places(stand, solver)] = border
    found = Step(*solver.expanded(stand.lin.misclosure if y is None else y.change, x))
    stand.rest()
    return found


def condition_sums(stand: Stand, step: Step, tie: Tie) -> Floats:
    """Return B'x and B'G of a part, (d, 1 + d)."""
    g, b = tied(stand, tie)
    stand.rest()
    return np.asarray(b.T @ np.column_stack([step.x, g]))


def transferred(stand: Stand, step: Step, tie: Tie, t: Floats) -> Step:
    """Return the step moved along the free directions, x - G t, into the datum asked for."""
    g, _ = tied(stand, tie)
    x = step.x - g @ t
    found = Step(x, step.change if steady(tie.basis) else stand.lin.times(x))  # see `baarda.adjustment.iteration`
    stand.rest()
    return found


def drift(stand: Stand, tie: Tie, pins: Ints) -> Floats:
    """Return by how much a part's state misses the datum of the start, and how the free transformations change that, (d, 1 + d).

    `pins` (k, 2): columns of unknowns of a minimal datum, each with its number among all d of them.
    """
    part = stand.part
    g, b = tied(stand, tie)
    b[pins[:, 0], pins[:, 1]] = 1.0
    found = np.asarray(b.T @ np.column_stack([stand.state.departure(part.unknowns, part.start), g]))
    stand.rest()
    return found


def vpv(stand: Stand) -> float:
    """Return the v'Pv of a part."""
    found = float(stand.lin.misclosure @ stand.lin.misclosure)
    stand.rest()
    return found


def carried_along(stand: Stand, motion: Floats) -> Stand:
    """Return the part at its state after a free transformation."""
    found = Stand(stand.part, carried(stand.state, stand.part.unknowns, motion))
    stand.rest()
    return found


class StepSums(NamedTuple):
    """Products of the change c of a step, the misclosures l and the change b of the last step."""

    cl: float
    cc: float
    cb: float
    bb: float


def step_sums(stand: Stand, step: Step, before: Step | None) -> StepSums:
    """Return the sums of a part."""
    c = step.change
    b = np.zeros(0) if before is None else before.change
    found = StepSums(
        float(c @ stand.lin.misclosure), float(c @ c), 0.0 if before is None else float(c @ b), 0.0 if before is None else float(b @ b)
    )
    stand.rest()
    return found


def curvature(stand: Stand, step: Step, h: float) -> Step:
    """Return the second derivative of the observations along a step, in the place of a step's change."""
    part = stand.part
    values = whitened_misclosures(part.network, _moved(stand, step.x, h), part.arranged, part.settings.jobs)
    found = 2.0 / h * ((stand.lin.misclosure - values) / h - step.change)
    stand.rest()
    return Step(np.zeros(0), found)


def finite(step: Step) -> bool:
    """Return whether all values are finite."""
    return bool(np.isfinite(step.change).all())


def norms(stand: Stand, step: Step, bend: Step, scale: Floats) -> Floats:
    """Return the squares of the scaled step and of its bend, (2,), each unknown in one part; `scale` is that of the border."""
    part = stand.part
    weight = np.array(stand.lin.scale)
    weight[part.border] = scale
    stand.rest()
    return np.array([float((weight[part.owned] * s.x[part.owned]) @ (weight[part.owned] * s.x[part.owned])) for s in (step, bend)])


def bent(step: Step, bend: Step) -> Step:
    """Return a step with its second-order correction."""
    return Step(step.x - 0.5 * bend.x, step.change)


def _moved(stand: Stand, x: Floats, length: float) -> State:
    part, state = stand.part, stand.state
    return state.moved(part.unknowns, length * x, viewpoints_of(part.groups, state))


class Trial(NamedTuple):
    """Where a step leads: the part there, and its v'Pv."""

    stand: Stand
    objective: float


def tried(stand: Stand, step: Step, length: float, near: bool) -> Trial:
    """Take a step; `near` the solution it is linearised at once, because it is as good as sure to be taken."""
    part = stand.part
    state = _moved(stand, step.x, length)
    there = Stand(part, state)
    if near:
        stand._lin = None  # its memory is needed; the factor may serve on
        if stand._solver is not None:
            stand._solver = stand._solver.at(None)
        values = there.lin.misclosure
    else:
        values = whitened_misclosures(part.network, state, part.arranged, part.settings.jobs)
    there.rest()
    with np.errstate(over="ignore"):
        value = float(values @ values) if np.isfinite(values).all() else np.inf
    stand.rest()
    return Trial(there, value)


def stand_of(trial: Trial) -> Stand:
    """Return the part of a trial."""
    return trial.stand


def objective_of(trial: Trial) -> float:
    """Return the v'Pv of a trial."""
    return trial.objective


# ---- cofactors ------------------------------------------------------------------------------------------------------------------------


class Constraint(NamedTuple):
    """Of the inner constraints: N^-1 B before the border is solved, with the reduced right-hand sides of the border."""

    x: Floats
    rhs: Floats


def constraint_solved(stand: Stand, tie: Tie) -> Constraint:
    """Eliminate the interior for the conditions B as right-hand sides."""
    solver = stand.solver
    b = tied(stand, tie)[1]
    x = solver.solve(b)  # with a border: its rows hold what reaches it, divided by the scale squared
    rhs = x[stand.part.border] * stand.lin.scale[stand.part.border, None] ** 2
    stand.rest()
    return Constraint(x, rhs)


def rhs_of(c: Constraint) -> Floats:
    """Return the reduced right-hand sides."""
    return c.rhs


def constraint_expanded(stand: Stand, c: Constraint, border: Floats) -> Floats:
    """Return N^-1 B of the part's unknowns, (u, d), from the border's solution (b, d)."""
    columns = stand.part.border
    more = np.zeros_like(c.x)
    more[columns] = stand.lin.scale[columns, None] ** 2 * (border - c.x[columns])
    found = c.x + stand.solver.solve(more)
    stand.rest()
    return np.asarray(found)


def condition_products(stand: Stand, k: Floats, tie: Tie) -> Floats:
    """Return B'N^-1 B of a part, (d, d)."""
    found = np.asarray(tied(stand, tie)[1].T @ k)
    stand.rest()
    return found


def gram(stand: Stand, tie: Tie) -> Floats:
    """Return B'G of a part, (d, d)."""
    g, b = tied(stand, tie)
    stand.rest()
    return np.asarray(b.T @ g)
