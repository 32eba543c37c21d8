"""Block adjustment of independent models in plan and height by turns: four unknowns of each model, then three, until both stand still.

The plan half moves, turns about the vertical and scales levelled models; ground points have X and Y. The height half lifts and tilts them;
ground points have Z, perspective centres all three coordinates, for their plan positions carry the tilt along the strip. Each half is a
rigorous adjustment with all statistics; what they neglect is the effect of tilts on the plan of ground points, which levelling removes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment, adjust
from baarda.cameras import FIXED, FREE
from baarda.errors import Singular, UsageError
from baarda.geometry import rotation as rot
from baarda.network import CONTROL, TIE, Images, Network, Points
from baarda.observations import ModelCoordinates, ModelHeights, ModelPlan, Models

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
#: How labels of perspective centres begin.
CENTRE = "perspective centre"
LIMIT = 60
#: Of the free unknowns X0 Y0 Z0, rotations, scale of a model in either half.
PLAN_STATES = (FREE, FREE, FIXED, FIXED, FIXED, FREE, FREE)
HEIGHT_STATES = (FIXED, FIXED, FREE, FREE, FREE, FIXED, FIXED)


@dataclass(frozen=True)
class PlanimetryHeight:
    """Both halves at the end.

    Attributes
    ----------
    network : Network
        The block that was given, with the coordinates and transformations found.
    plan, height : Adjustment
        With the levelled models; statistics hold for the model coordinates along the levelled axes.
    changes : tuple of float
        Largest change of a coordinate in each round, object units.
    converged : bool
    """

    network: Network
    plan: Adjustment
    height: Adjustment
    changes: tuple[float, ...]
    converged: bool

    @property
    def redundancy(self) -> int:
        """Of both halves."""
        return self.plan.redundancy + self.height.redundancy

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight over both halves."""
        return float(np.sqrt((self.plan.objective + self.height.objective) / self.redundancy))


def adjust_planimetry_height(
    network: Network, centres: Sequence[str] | None = None, tell: Callable[[str], None] | None = None, rounds: int = LIMIT, **settings: Any
) -> PlanimetryHeight:
    """Adjust a block of independent models in plan and height by turns.

    Parameters
    ----------
    network : Network
        With one group of `ModelCoordinates`, as from `baarda.procedures.independent_models.block_of_models`.
    centres : sequence of str, optional
        Labels of the perspective centres; those that begin with "perspective centre" without it.
    tell : callable, optional
        Is told of each round.
    rounds : int
        Limit.
    **settings
        Fields of `Settings`, for both halves.

    Returns
    -------
    PlanimetryHeight

    Raises
    ------
    UsageError
        If there is not one group of model coordinates, or a model has no perspective centre.
    Singular
        If control does not define plan or height.
    RedundancyNotPositive
        If a half has no surplus observations.

    Notes
    -----
    Ackermann, Ebner & Klein, Block triangulation with independent models, Photogrammetric Engineering 39 (1973) 967-981.

    Examples
    --------
    >>> from baarda.procedures.independent_models import block_of_models, simulate_strip
    >>> made = simulate_strip(3, noise=0.005)
    >>> found = adjust_planimetry_height(block_of_models(made.models, made.control, 2e-5))
    >>> found.converged, found.plan.redundancy, found.height.redundancy
    (True, 30, 18)
    """
    groups = [g for g in network.observations if isinstance(g, ModelCoordinates)]
    if len(groups) != 1 or len(network.observations) != 1:
        raise UsageError("a planimetry-height adjustment needs one group of model coordinates, and nothing else")
    group = groups[0]
    network = group.with_start(network, np.zeros(len(network.points.labels), dtype=bool))
    models = _models(network)
    labels = network.points.labels
    is_centre = np.array([t.startswith(CENTRE) if centres is None else t in centres for t in labels], dtype=bool)
    _refuse(group, models, labels, is_centre, network)
    if rounds < 1:
        raise UsageError(f"the number of rounds must be positive, not {rounds}")
    seen = np.unique(group.points)
    size = float(np.ptp(network.points.coordinates[seen], axis=0).max())
    changes: list[float] = []
    while True:
        before = network.points.coordinates[seen]
        network, models, plan = _half_round(network, models, group, _plan_network, is_centre, settings)
        network, models, height = _half_round(network, models, group, _height_network, is_centre, settings)
        changes.append(float(np.abs(network.points.coordinates[seen] - before).max()))
        if tell is not None:
            told = f"plan s0 {plan.sigma0:.5g}, height s0 {height.sigma0:.5g}, largest change {changes[-1]:.3g} {network.unit}"
            tell(f"round {len(changes)}: {told}")
        # rounding is reached where small changes no longer shrink
        still = changes[-1] <= 1e-11 * size or (len(changes) > 1 and changes[-1] <= 1e-8 * size and changes[-1] >= 0.5 * changes[-2])
        if still or len(changes) == rounds:
            network = replace(network, declared=tuple(models if d.kind == models.kind else d for d in network.declared))
            return PlanimetryHeight(network, plan, height, tuple(changes), still)


def _half_round(
    network: Network,
    models: Models,
    group: ModelCoordinates,
    half_of: Callable[[Network, Models, Floats, NDArray[np.bool_]], Network],
    is_centre: NDArray[np.bool_],
    settings: dict[str, Any],
) -> tuple[Network, Models, Adjustment]:
    """Level the models, adjust one half, and carry over what it found."""
    level, levelled = _levelled(models, group)
    half = half_of(network, level, levelled, is_centre)
    a = adjust(half, **settings)
    if a.status != "converged":
        raise Singular(f"the adjustment of {half.name} did not converge; {a.contradictions()}")
    return _moved(network, a), _after(models, a, level), a


def _models(network: Network) -> Models:
    found = next((d for d in network.declared if isinstance(d, Models)), None)
    if found is None:
        raise UsageError("the network declares no models")
    return found


def _refuse(group: ModelCoordinates, models: Models, labels: Sequence[str], is_centre: NDArray[np.bool_], network: Network) -> None:
    """Name what makes the block impossible before numbers do."""
    for m in np.unique(group.models).tolist():
        if not is_centre[group.points[group.models == m]].any():
            raise UsageError(f"model {models.labels[m]} has no perspective centre: nothing carries its tilt along the strip")
    points = network.points
    used = np.isin(np.arange(len(labels)), group.points) & (points.roles == CONTROL)
    plan = used & (points.states[:, :2] != FREE).all(axis=1) & np.isfinite(points.given[:, :2]).all(axis=1)
    up = used & (points.states[:, 2] != FREE) & np.isfinite(points.given[:, 2])
    if plan.sum() < 2:
        raise Singular(f"{int(plan.sum())} control point(s) with X and Y: the plan of the block needs 2")
    if up.sum() < 3:
        raise Singular(f"{int(up.sum())} control point(s) with Z: the height of the block needs 3, not on one line")


def _levelled(models: Models, group: ModelCoordinates) -> tuple[Models, Floats]:
    """Return the models turned so that their z axes are vertical, and the measured coordinates turned likewise, (n, 3)."""
    r = models.rotations
    turns = np.array([_smallest_turn(x) for x in r[:, :, 2]])
    values = np.array(models.values.reshape(-1, 7))
    values[:, 3:6] = rot.log(turns @ r)
    values[:, 3:5] = 0.0  # what rounding left of the tilts
    return replace(models, values=values.ravel()), np.einsum("nij,nj->ni", turns[group.models], group.xyz)


def _smallest_turn(up: Floats) -> Floats:
    """Return the rotation by the smallest angle that brings a unit vector to the z axis."""
    axis = np.array([up[1], -up[0], 0.0])  # up x z
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-15:
        return np.eye(3) if cosine > 0.0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(rot.exp(axis / sine * np.arctan2(sine, cosine)))


def _table(network: Network, keep: Ints, states: NDArray[np.int8], axes: Sequence[int]) -> Points:
    """Return some points, known beforehand along some axes only; FIXED elsewhere."""
    p = network.points
    known = np.zeros(3, dtype=bool)
    known[list(axes)] = True
    observed = known & (p.states[keep] != FREE) & (p.roles[keep] == CONTROL)[:, None]
    correlations = p.correlations[keep] if tuple(axes) == (0, 1) else np.zeros((len(keep), 3))
    correlations = np.where([True, False, False], correlations, 0.0)
    return Points.make(
        [p.labels[i] for i in keep],
        p.coordinates[keep],
        np.where(observed.any(axis=1), CONTROL, TIE),
        np.where(observed, p.states[keep], states),
        np.where(observed, p.given[keep], np.nan),
        np.where(observed, p.sigmas[keep], np.nan),
        correlations,
    )


def _states(models: Models, states: tuple[int, ...]) -> Models:
    fixed = models.states.reshape(-1, 7) == FIXED
    return replace(models, states=np.where(fixed, FIXED, np.array(states)).ravel())


def _renumbered(network: Network, keep: Ints) -> Ints:
    index = np.full(len(network.points.labels), -1)
    index[keep] = np.arange(len(keep))
    return index


def _plan_network(network: Network, level: Models, xyz: Floats, is_centre: NDArray[np.bool_]) -> Network:
    group = network.observations[0]
    rows = np.flatnonzero(~is_centre[group.points])
    keep = np.unique(group.points[rows])
    states = np.tile(np.array([FREE, FREE, FIXED], dtype=np.int8), (len(keep), 1))
    table = _table(network, keep, states, (0, 1))
    measured = ModelPlan(
        group.models[rows], _renumbered(network, keep)[group.points[rows]], xyz[rows, :2], group.sigmas[rows, :2], unit=group.unit
    )
    return _half(network, table, (measured,), _states(level, PLAN_STATES), "plan")


def _height_network(network: Network, level: Models, xyz: Floats, is_centre: NDArray[np.bool_]) -> Network:
    group = network.observations[0]
    keep = np.unique(group.points)
    states = np.where(is_centre[keep, None], FREE, np.array([FIXED, FIXED, FREE], dtype=np.int8))
    table = _table(network, keep, states, (2,))
    index = _renumbered(network, keep)
    ground, centre = (np.flatnonzero(is_centre[group.points] == c) for c in (False, True))
    heights = ModelHeights(group.models[ground], index[group.points[ground]], xyz[ground, 2:], group.sigmas[ground, 2:], unit=group.unit)
    centres = ModelCoordinates(
        group.models[centre], index[group.points[centre]], xyz[centre], group.sigmas[centre], name="perspective centres", unit=group.unit
    )
    return _half(network, table, (heights, centres), _states(level, HEIGHT_STATES), "height")


def _half(network: Network, points: Points, observations: tuple[Any, ...], level: Models, name: str) -> Network:
    title = f"{network.name}, {name}" if network.name else name
    settings = {**network.settings, "min_rays": 0}
    return replace(
        network,
        cameras=(),
        images=Images.make(()),
        points=points,
        observations=observations,
        name=title,
        settings=settings,
        declared=(level,),
    )


def _moved(network: Network, half: Adjustment) -> Network:
    """Return the network with the coordinates that a half has found."""
    index = {t: i for i, t in enumerate(network.points.labels)}
    x = np.array(network.points.coordinates)
    x[[index[t] for t in half.network.points.labels]] = half.network.points.coordinates
    return replace(network, points=replace(network.points, coordinates=x))


def _after(models: Models, half: Adjustment, level: Models) -> Models:
    """Return the transformations of the models as they were measured, from those of the levelled ones after a half."""
    found = next(d for d in half.network.declared if isinstance(d, Models))
    turns = level.rotations @ models.rotations.transpose(0, 2, 1)  # levelled from measured
    values = np.array(found.values.reshape(-1, 7))
    values[:, 3:6] = rot.log(turns.transpose(0, 2, 1) @ found.rotations)
    return replace(models, values=values.ravel())
