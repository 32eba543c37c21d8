"""The adjustment: from a network with start values to adjusted unknowns, residuals and the factored system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from baarda.adjustment import kernels, memory
from baarda.adjustment.block import BlockSolver
from baarda.adjustment.camera_choice import with_cameras
from baarda.adjustment.connection import separate_parts
from baarda.adjustment.datum import Datum, Defect, find_defect, minimal_columns
from baarda.adjustment.dense import DenseSolver
from baarda.adjustment.free_motion import brought_back
from baarda.adjustment.initial import complete
from baarda.adjustment.iteration import iterate
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.linearize import Arrangement, check_finite, linearize
from baarda.adjustment.point_order import rank_for
from baarda.adjustment.result import Adjustment, Iteration
from baarda.adjustment.robust import adjust_under_law, check_law
from baarda.adjustment.solver import Solver
from baarda.adjustment.structure import analyse, inner_points
from baarda.cameras import FREE
from baarda.errors import DatumDefect, RedundancyNotPositive, Singular, UsageError
from baarda.network import CHECK, Network, State, Unknowns, unknowns_of
from baarda.observations import ImagePoints, Kind, direct_observations, viewpoints_of

Floats = NDArray[np.float64]
DENSE_LIMIT = 1500
RETURNED = 1e-7  # by what part v'Pv may change where no observation should
LEFT = " On the way the network was moved away from these constraints, by what changes no observation."


@dataclass(frozen=True)
class Settings:
    """How to adjust.

    Attributes
    ----------
    datum : {"auto", "control", "inner", "minimal"}
        Control defines the datum; inner constraints over all object points; minimal constraints; auto = control if it defines one,
        else inner.
    solver : {"auto", "dense", "block"}
        auto = dense up to 1500 unknowns.
    min_rays : int
        Points with fewer rays and unknown coordinates are set aside and listed.
    iterations : int
        Limit of the number of steps, rejected ones included.
    tolerance : float
        Converged when what is left changes the adjusted observations by less than this part of the residuals (both weighted norms): the
        last step, or the one that would follow it at the rate of the last two.
    camera : str, tuple of str or None
        Interior and additional parameters to estimate, or a preset: see `baarda.adjustment.camera_choice.with_cameras`. None leaves the
        states of the source, ``()`` fixes all.
    image_sigma : float or None
        Replaces the a-priori sigma of all image points, pixels.
    residual_plane : {"image", "corrected"} or None
        Replaces that of the source.
    robust : str or None
        Law of errors of a maximum-likelihood adjustment, a name of `baarda.distributions.laws`; None is least squares.
    robust_shapes : mapping or None
        Shapes of that law by name, for instance ``{"nu": 4.0}``. Those not given are estimated from the residuals of the least-squares
        start (a of the modulated normal, nu of Student's law) or take their usual value.
    progress : callable or None
        Is told every iteration.
    tell : callable or None
        Is told in words what takes time or memory.
    jobs : int or None
        Number of threads; None = one for each core. The results do not depend on it.
    """

    datum: Literal["auto", "control", "inner", "minimal"] = "auto"
    solver: Literal["auto", "dense", "block"] = "auto"
    min_rays: int = 2
    iterations: int = 50
    tolerance: float = 1e-10
    camera: tuple[str, ...] | str | None = None
    image_sigma: float | None = None
    residual_plane: str | None = None
    robust: str | None = None
    robust_shapes: Mapping[str, float] | None = field(default=None, hash=False)
    progress: Callable[[Iteration], None] | None = field(default=None, compare=False)
    tell: Callable[[str], None] | None = field(default=None, compare=False)
    jobs: int | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        for name, allowed in (("datum", ("auto", "control", "inner", "minimal")), ("solver", ("auto", "dense", "block"))):
            if getattr(self, name) not in allowed:
                raise UsageError(f"{name} must be one of {', '.join(allowed)}, not {getattr(self, name)!r}")
        if self.iterations < 1 or not 0 < self.tolerance < 1e-2:
            raise UsageError("iterations must be positive, the tolerance between 0 and 0.01")
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"the number of threads (--jobs) must be positive, not {self.jobs}")
        if self.min_rays < 0:
            raise UsageError(f"min_rays must not be negative, not {self.min_rays}")
        if self.image_sigma is not None and not 1e-12 < self.image_sigma < 1e12:
            raise UsageError(f"the image sigma (--image-sigma) must be positive, between 1e-12 and 1e12 px, not {self.image_sigma}")
        if self.robust is not None:
            check_law(self.robust, self.robust_shapes)
        elif self.robust_shapes:
            raise UsageError("robust_shapes are shapes of the law that robust names; none is named")

    @staticmethod
    def of(network: Network, options: Mapping[str, Any]) -> Settings:
        """Combine the settings found in a source with options, which win."""
        known = {f.name for f in fields(Settings)}
        unknown = [k for k in options if k not in known]
        if unknown:
            raise UsageError(f"unknown option {unknown[0]!r}; known are {', '.join(sorted(known))}")
        found = {k: v for k, v in network.settings.items() if k in known}
        return Settings(**{**found, **{k: v for k, v in options.items() if v is not None}})


def adjust(network: Network, **options: Any) -> Adjustment:
    """Adjust a network by least squares, or by maximum likelihood under another law of errors.

    Parameters
    ----------
    network : Network
        With or without start values.
    **options
        The fields of `Settings`; they win over the settings found in the source.

    Returns
    -------
    Adjustment

    Raises
    ------
    RedundancyNotPositive
        If there are not more observations than unknowns.
    DatumDefect
        If control is to define the datum and does not.
    Singular
        If unknowns are not determined.
    UsageError
        If an option makes no sense, an image has no points, or a start value cannot be found.
    """
    settings = Settings.of(network, options)
    with threadpool_limits(limits=1, user_api="blas"):  # two threads are slower here and sum in another order
        prepared, aside, notes = prepare(network, settings)
        try:
            return _adjust(network, settings, prepared, aside, notes)
        except (Singular, DatumDefect) as error:
            parts = separate_parts(prepared, active_groups(prepared, ~aside))
            if not parts:
                raise
            names = (error.names,) if isinstance(error, Singular) else ()
            raise type(error)(f"{error}; {parts}", *names) from None


def _adjust(network: Network, settings: Settings, prepared: Network, aside: NDArray[np.bool_], notes: list[str]) -> Adjustment:
    prepared, more = complete(prepared, aside)
    source, shift = prepared, -prepared.centroid()
    prepared = prepared.shifted(shift)
    groups = active_groups(prepared, ~aside)
    if not groups:
        raise RedundancyNotPositive(f"no observation takes part: no point has {max(settings.min_rays, 1)} rays or more (--min-rays)")
    unknowns = unknowns_of(prepared, ~aside, np.isin(np.arange(len(prepared.cameras)), prepared.images.cameras))
    if not unknowns.count:
        raise UsageError("nothing to adjust: all unknowns are fixed")

    start = State.of(prepared)
    kind = settings.solver if settings.solver != "auto" else "dense" if unknowns.count <= DENSE_LIMIT else "block"
    memory.check(
        memory.of_rows(unknowns, groups, prepared) + (memory.of_dense(unknowns) if kind == "dense" else 0.0),
        "the observations",
        settings.tell,
    )
    most = max((len(g) for g in groups if isinstance(g, ImagePoints)), default=0)
    if settings.tell is not None and kind == "block" and most >= kernels.COMPILE_FROM and not kernels.cached():
        settings.tell("compiling loops for the first time, about half a minute in all (see: baarda warmup)")
    rank = rank_for(groups, start.points)
    arranged = Arrangement.of(groups, rank if kind == "block" else None, prepared)
    lin = linearize(prepared, start, unknowns, arranged, settings.jobs)
    check_finite(lin, groups, prepared)
    defect = find_defect(lin, start)
    redundancy = lin.count - lin.uncontrolled - unknowns.count + defect.count
    if redundancy <= 0:
        lost = f", {lin.uncontrolled} combinations of them controlled by no condition" if lin.uncontrolled else ""
        raise RedundancyNotPositive(
            f"redundancy {redundancy}: n = {lin.count} observations{lost}, u = {unknowns.count} unknowns, "
            f"datum defect d = {defect.count}; a test needs r = n - u + d > 0"
        )
    structure = analyse(lin, rank, start.points) if kind == "block" else None
    if structure is not None:
        memory.release(lin.count)
        memory.check(memory.of_fronts(structure), "the factor and its inverse", settings.tell)

    def factor(lin: Linearization, datum: Datum, damping: float = 0.0) -> Solver:
        if structure is None:
            return DenseSolver.of(lin, datum.held, damping)
        return BlockSolver.of(lin, structure, datum.held, damping)

    viewpoints = viewpoints_of(groups, start)
    far = viewpoints.far(start.points)
    while True:
        datum = choose_datum(defect, lin, settings, prepared, far)
        given = [lin]
        del lin  # so that the iteration can let it go
        state, lin, history, converged = iterate(prepared, start, given.pop(), arranged, datum, factor, settings, viewpoints, far)
        more_far = (viewpoints.far(state.points) if converged else viewpoints.doubtful(state.points)) & ~far
        if datum.transfer is None or not more_far.any():
            break
        far |= more_far  # a free network must not hang on them: once more from the start
        lin = linearize(prepared, start, unknowns, arranged, settings.jobs)
    if settings.datum in ("inner", "minimal") and not defect.count:
        more = [*more, f"A datum by {settings.datum} constraints was asked for; observations and known values define it (defect 0)."]
    law = None
    if settings.robust is not None:
        found = adjust_under_law(prepared, state, lin, arranged, datum, factor, settings, redundancy, history)
        state, lin, history, converged, law = found
        more = [*more, *law.assumptions]
    left = ""
    if converged and defect.count:
        state, lin, left = _in_datum(prepared, start, state, lin, datum.at(lin, state), arranged)
    present = find_defect(lin, state) if datum.name == "inner" else defect  # a minimal datum names what was held
    if datum.name == "inner" and present.count == defect.count:
        datum = choose_datum(present, lin, settings, prepared, far)
    elif present.count != defect.count:
        more = [*more, f"The datum defect is that of the start values, {defect.count}; at the result it is {present.count}."]
    datum = replace(datum, text=datum.text + left)
    memory.release(lin.count)
    solver = factor(lin, datum)
    return Adjustment(
        network=state.shifted(-shift).write_to(source),
        start=source,
        numbering=unknowns,
        groups=tuple(groups),
        lin=lin,
        solver=solver,
        solver_name=kind,
        datum=datum,
        redundancy=redundancy,
        history=tuple(history),
        status="converged" if converged else "not_converged",
        aside=aside,
        assumptions=(*network.assumptions, *notes, *more),
        shift=shift,
        law=law,
    )


def _in_datum(
    network: Network, start: State, state: State, lin: Linearization, datum: Datum, groups: Arrangement
) -> tuple[State, Linearization, str]:
    """Bring a free network back to its datum; return what the datum's text must add where that cannot be done."""
    there = brought_back(state, start, lin.unknowns, datum)
    if there is state:
        return state, lin, ""
    if there is not None:
        again = linearize(network, there, lin.unknowns, groups, lin.workers)
        before, after = (float(some.misclosure @ some.misclosure) for some in (lin, again))
        if abs(after - before) <= RETURNED * max(before, lin.count * RETURNED):
            return there, again, ""
    return state, lin, LEFT


def prepare(network: Network, settings: Settings) -> tuple[Network, NDArray[np.bool_], list[str]]:
    """Apply the settings to a network: states of parameters and points, sigmas, points set aside.

    Returns
    -------
    network : Network
    aside : (points,) bool array
        Points that do not take part.
    notes : list of str
        What was decided.
    """
    network, notes = with_cameras(network, settings.camera)
    points = network.points
    states = np.array(points.states)
    states[points.roles == CHECK] = FREE
    observations = []
    for group in network.observations:
        changed = group
        if isinstance(group, ImagePoints):
            if settings.image_sigma is not None:
                changed = replace(changed, sigmas=np.broadcast_to(float(settings.image_sigma), changed.sigmas.shape))
            if settings.residual_plane is not None:
                changed = replace(changed, residual_plane=settings.residual_plane)
        observations.append(changed)
    network = replace(network, points=replace(points, states=states), observations=tuple(observations))

    rays = np.zeros(len(points.labels), dtype=int)
    seen = np.zeros(len(network.images.labels), dtype=bool)
    for group in network.observations:
        if isinstance(group, ImagePoints):
            rays += np.bincount(group.points, minlength=len(rays))
            seen[group.images] = True
    known = (states != FREE).all(axis=1)
    measured = rays > 0
    for group in network.observations:
        for end in group.points_of():
            measured[end] = True
    aside = (~known & (rays < settings.min_rays)) | (known & ~measured)
    if settings.min_rays == 0:
        aside &= known
    _say(notes, network, ~measured & aside, "without any observation, left out")
    _say(notes, network, measured & aside, f"with fewer than {settings.min_rays} rays, set aside")
    for group in network.observations:
        lost = np.any([aside[end] for end in group.points_of()], axis=0)
        if lost.any() and not isinstance(group, ImagePoints):
            notes.append(f"{int(lost.sum())} of {len(group)} {group.name} end at points set aside and are left out with them")
    blind = np.flatnonzero(~seen & (network.images.states == FREE).any(axis=1))
    if len(blind):
        names = ", ".join(network.images.labels[i] for i in blind[:12])
        raise UsageError(f"{len(blind)} image(s) without image points: {names}")
    return network, aside, notes


def _say(notes: list[str], network: Network, which: NDArray[np.bool_], text: str) -> None:
    at = np.flatnonzero(which)
    if len(at):
        names = ", ".join(network.points.labels[i] for i in at[:10]) + (", ..." if len(at) > 10 else "")
        notes.append(f"{len(at)} point(s) {text}: {names}")


def active_groups(network: Network, active: NDArray[np.bool_]) -> list[Kind]:
    """Return the observation groups without rows of points set aside, and the direct observations."""
    groups: list[Kind] = []
    for group in network.observations:
        keep = np.all([active[end] for end in group.points_of()], axis=0)
        chosen = group if keep.all() else group.selected(keep)
        if len(chosen):
            groups.append(chosen)
    groups.extend(direct_observations(network, active))
    return groups


def choose_datum(defect: Defect, lin: Linearization, settings: Settings, network: Network, far: NDArray[np.bool_] | None = None) -> Datum:
    """Tie down the free transformations as the settings say.

    Parameters
    ----------
    defect : Defect
    lin : Linearization
    settings : Settings
    network : Network
    far : (points,) bool array, optional
        Points almost at infinity, whose distances would tear at a free network: inner constraints leave them out where the others suffice.

    Raises
    ------
    DatumDefect
        If control is asked to define the datum and leaves freedoms.
    """
    none = np.zeros(0, dtype=np.intp)
    unknowns: Unknowns = lin.unknowns
    if not defect.count:
        return Datum("control", defect, none, None, "The datum is defined by the observations and known values (defect 0).")
    free = ", ".join(defect.free) if len(defect.free) == defect.count else f"{defect.count} combination(s) of shifts, rotations and scale"
    if settings.datum == "control":
        raise DatumDefect(
            f"the known values do not define the datum: free are {free} (datum defect {defect.count}); "
            "add control, or choose inner or minimal constraints (--datum inner)"
        )
    eliminated = inner_points(lin)
    early = np.zeros(unknowns.count + 1, dtype=bool)
    columns = unknowns["point"].columns.reshape(-1, 3)
    early[columns[eliminated].ravel()] = True
    images = unknowns["image"].columns
    held = none
    for some in (images[images >= 0], np.flatnonzero(~early[:-1]), np.arange(unknowns.count)):
        if len(some) >= defect.count and not len(held):
            held = minimal_columns(defect, lin, some)
    if len(held) < defect.count:
        raise DatumDefect(f"the datum defect {defect.count} ({free}) cannot be removed by holding unknowns")
    if settings.datum == "minimal":
        names = ", ".join(unknowns.names[i] for i in held)
        return Datum("minimal", defect, held, None, f"Minimal constraints hold {defect.count} unknown(s) at their start values: {names}.")
    on = np.zeros(unknowns.count)
    near = columns if far is None else columns[~far]
    left_out = 0 if far is None else int((columns[far] >= 0).any(axis=1).sum())
    points = "all object points" + (f" but {left_out} far one(s)" if left_out else "")
    candidates = {
        points: near[near >= 0],
        f"{points} and images": images[images >= 0],
        "all unknowns": np.arange(unknowns.count),  # as of a track over points that are held on one line
    }
    where, conditions = "", defect.basis
    for where, added in candidates.items():  # noqa: B007
        on[added] = 1.0
        conditions = defect.basis * on[:, None]
        if np.linalg.matrix_rank(conditions) == defect.count:
            break
    text = f"Free network: {defect.count} inner constraint(s) over {where} tie down {free}."
    return Datum("inner", defect, held, conditions, text)
