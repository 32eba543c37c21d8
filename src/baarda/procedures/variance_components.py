"""Variance components: the variance of each group of observations estimated from its own residuals, until all fit together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment, adjust
from baarda.cameras import OBSERVED
from baarda.errors import UsageError
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.levels import Options
from baarda.hypotheses.variance_components import equal_variance_components, variance_component
from baarda.network import CONTROL, Network
from baarda.observations import CorrelatedPoints, Direct, ImageCoordinates, ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
By = Literal["group", "camera"]

EXACT = 600  # observations up to which traces are computed without random probes
PROBES = 32
TOLERANCE = 1e-4  # relative change of a variance below which an iteration is the last
FEWEST = 1.0  # redundancy a group needs
SMALLEST = 1e-4  # part of the stated variance below which a component counts as not positive


@dataclass(frozen=True)
class Component:
    """One group of observations.

    Attributes
    ----------
    name : str
    count : int
        Observations.
    redundancy : float
        Sum of its redundancy numbers, at the end.
    factor : float
        Estimated variance divided by the stated one.
    deviation : float or None
        Standard deviation of this factor; None where it was not estimated.
    before, after : float
        Median standard deviation of its observations, stated and estimated.
    outcome : {"estimated", "too little redundancy", "not positive"}
    """

    name: str
    count: int
    redundancy: float
    factor: float
    deviation: float | None
    before: float
    after: float
    outcome: str


@dataclass(frozen=True)
class VarianceComponents:
    """Estimated variance components.

    Attributes
    ----------
    components : tuple of Component
    iterations : int
    converged : bool
    tests : tuple of TestResult
        Of the stated variances: each group, and all against each other.
    exact : bool
        Whether traces are exact; else from random probes.
    notes : tuple of str
        What could not be estimated, in words.
    """

    components: tuple[Component, ...]
    iterations: int
    converged: bool
    tests: tuple[TestResult, ...]
    exact: bool
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return what `result.json` says."""
        tests = []
        for t in self.tests:
            numbers = {"statistic": t.statistic, "p_value": t.p_value, "rejected": t.rejected}
            tests.append({"name": t.name, "null": t.null, "law": t.law_name, "alpha": t.alpha, "labels": list(t.labels), **numbers})
        return {
            "components": [vars(c) for c in self.components],
            "iterations": self.iterations,
            "converged": self.converged,
            "exact": self.exact,
            "tests": tests,
            "notes": list(self.notes),
        }


def estimate_components(
    network: Network,
    by: By = "group",
    options: Options | None = None,
    iterations: int = 30,
    tell: Callable[[str], None] | None = None,
    **settings: Any,
) -> tuple[VarianceComponents, Network]:
    """Estimate the variance of each group of observations.

    Parameters
    ----------
    network : Network
    by : {"group", "camera"}
        One component for each group of observations (image points, distances, control points, ...); or one for the image points of each
        camera.
    options : Options, optional
        Level of the tests.
    iterations : int
        Limit.
    tell : callable, optional
        Is told of each iteration.
    **settings
        Of the adjustment.

    Returns
    -------
    components : VarianceComponents
    network : Network
        With the estimated standard deviations; adjust it without `image_sigma`.

    Raises
    ------
    UsageError
        If an adjustment does not converge, there are no two groups, or a law of errors other than the normal is asked for.

    Notes
    -----
    Helmert's equations T s = q with q_i = v_i'P_i v_i and T_ij = tr(R_ij R_ji) (BIQUE for normal errors, K.-R. Koch 1999, 3.6), iterated;
    where their solution has a part that is not positive, that step is Förstner's (1979), s_i^2 = v_i'P_i v_i / r_i, never negative.
    Both have the same solution: s_i^2 = 1 for every group.

    Examples
    --------
    >>> from baarda.procedures.synthetic import ring
    >>> found, _ = estimate_components(ring(6, points=30, seed=4).network)
    >>> [c.name for c in found.components], found.converged
    (['image points', 'control points'], True)
    """
    o = Options() if options is None else options
    if by not in ("group", "camera"):
        raise UsageError(f"variance components are by 'group' or 'camera', not {by!r}")
    if settings.get("robust") is not None or network.settings.get("robust") is not None:
        raise UsageError("variance components are those of least squares: leave the law of errors (--robust) out")
    stated = settings.get("image_sigma") if settings.get("image_sigma") is not None else network.settings.get("image_sigma")
    if stated is not None:
        network = _with_image_sigma(network, float(stated))
        network = replace(network, settings={k: v for k, v in network.settings.items() if k != "image_sigma"})
    settings = {k: v for k, v in settings.items() if k != "image_sigma"}
    names: tuple[str, ...] = ()
    factors = np.zeros(0)
    tests: tuple[TestResult, ...] = ()
    held: dict[str, str] = {}
    free_before: set[str] = set()
    before: Floats = np.zeros(0)
    converged, count = False, 0
    current, change = network, np.inf
    while True:
        a = adjust(current, **settings)
        if a.status != "converged":
            raise UsageError(f"variance components: the adjustment of iteration {count} does not converge; {a.contradictions()}")
        rows, found = group_rows(a, by)
        forms, traces = forms_and_traces(a, rows, len(found), o.seed)
        r = traces.sum(axis=1)
        if not count:
            names, factors, before = found, np.ones(len(found)), _medians(a, rows, len(found))
            if len(names) < 2:
                raise UsageError(f"variance components need at least two groups of observations; there is {names[0]!r} only")
        # A group's redundancy grows with its stated variances: it may be estimable later; one that runs towards none has no variance.
        for n, x in zip(names, r, strict=True):
            if n in free_before and x < 0.5 * FEWEST:
                held[n] = "not positive"
            elif n not in held and n not in free_before and x < FEWEST:
                held[n] = "too little redundancy"
            elif held.get(n) == "too little redundancy" and x >= FEWEST:
                del held[n]
        free_before = {n for n in names if n not in held}
        if not count:
            tests = _tests(forms, traces, names, held, o)
        free = np.array([n not in held for n in names])
        step = _step(forms, traces, free)
        change = float(np.abs(step[free] - 1.0).max()) if free.any() else 0.0
        converged = change <= TOLERANCE
        if tell is not None:
            told = ", ".join(f"{n} {np.sqrt(x):.4g}" for n, x in zip(names, factors, strict=True))
            tell(f"variance components, iteration {count}: factors of sigma {told}; largest change {change:.1e}")
        lost = any(held.get(n) == "not positive" and x != 1.0 for n, x in zip(names, factors, strict=True))
        converged = converged and not lost
        if converged or count >= iterations:
            break
        factors = factors * step
        for n, x in zip(names, factors, strict=True):
            if x < SMALLEST and n not in held:
                held[n] = "not positive"
        factors = np.array([1.0 if held.get(n) == "not positive" else x for n, x in zip(names, factors, strict=True)])
        current = with_factors(network, a, dict(zip(names, np.sqrt(factors), strict=True)), by)
        count += 1
    deviations = _deviations(traces, free, factors)
    parts = tuple(
        Component(
            n,
            int((rows == i).sum()),
            float(r[i]),
            float(factors[i]),
            None if n in held else float(deviations[i]),
            float(before[i]),
            float(before[i] * np.sqrt(factors[i])),
            held.get(n, "estimated"),
        )
        for i, n in enumerate(names)
    )
    exact = a.count <= EXACT
    return VarianceComponents(parts, count, converged, tests, exact, _notes(parts, converged, count, change)), current


def group_rows(a: Adjustment, by: By = "group") -> tuple[Ints, tuple[str, ...]]:
    """Return for each scalar observation its component, and the names of the components."""
    names: dict[str, int] = {}
    out = np.empty(a.count, dtype=np.intp)
    cameras = a.network.cameras
    for g, group in enumerate(a.groups):
        at = np.arange(a.offsets[g], a.offsets[g + 1]).reshape(len(group), -1)
        if by == "camera" and len(cameras) > 1 and isinstance(group, (ImagePoints, ImageCoordinates)):
            camera = a.network.images.cameras[group.images]
            for c in np.unique(camera):
                out[at[camera == c]] = names.setdefault(_camera_name(cameras[c].label), len(names))
        else:
            out[at] = names.setdefault(_name(group), len(names))
    return out, tuple(names)


def _camera_name(label: str) -> str:
    return f"image points of camera {label}"


def _name(group: Any) -> str:
    if isinstance(group, CorrelatedPoints):
        return "control points"
    return str(group.whole.name if isinstance(group, ImageCoordinates) else group.name)


def forms_and_traces(a: Adjustment, rows: Ints, count: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Return v_i'P_i v_i and T_ij = tr(R_ij R_ji) of groups of observations, R = Qvv P.

    Parameters
    ----------
    a : Adjustment
    rows : (n,) int array
        Group of each observation; correlated observations belong to one group.
    count : int
        Number of groups.
    seed : int
        Of the random probes of large networks.

    Returns
    -------
    forms : (g,) array
    traces : (g, g) array
        Rows sum to the redundancies, which are exact; parts between groups are from probes where there are more than 600 observations.
    """
    white = _whitened(a, (a.residuals / a.sigmas)[:, None])[:, 0]
    forms = np.bincount(rows, weights=white**2, minlength=count).astype(float)
    redundancies = np.bincount(rows, weights=a.redundancy_numbers, minlength=count).astype(float)
    traces = np.zeros((count, count))
    for j in range(count):
        at = np.flatnonzero(rows == j)
        if a.count <= EXACT:
            probes = np.zeros((a.count, len(at)))
            probes[at, np.arange(len(at))] = 1.0
            share = 1.0
        else:
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(j,)))
            probes = np.zeros((a.count, PROBES))
            probes[at] = rng.choice([-1.0, 1.0], (len(at), PROBES))
            share = 1.0 / PROBES
        square = (_whitened(a, a.residuals_of(probes)) ** 2).sum(axis=1) * share
        traces[:, j] = np.bincount(rows, weights=square, minlength=count)
    traces = 0.5 * (traces + traces.T)
    between = traces - np.diag(np.diag(traces))
    return forms, between + np.diag(redundancies - between.sum(axis=1))  # R is idempotent: rows sum to the redundancies


def _whitened(a: Adjustment, standardised: Floats) -> Floats:
    """Turn residuals divided by their sigmas into whitened ones, (n, k)."""
    out = np.array(standardised)
    for c in a.lin.chunks:
        if c.factor.shape[1] > 1 and np.any(np.tril(c.factor, -1)):
            values = standardised[c.rows] * a.sigmas[c.rows][:, :, None]
            out[c.rows] = np.linalg.solve(c.factor, values)
    return out


def _medians(a: Adjustment, rows: Ints, count: int) -> Floats:
    return np.array([float(np.median(a.sigmas[rows == i])) for i in range(count)])


def _step(forms: Floats, traces: Floats, free: NDArray[np.bool_]) -> Floats:
    """Return the factors of this iteration, 1 for groups held."""
    step = np.ones(len(forms))
    at = np.flatnonzero(free)
    if not len(at):
        return step
    held = np.flatnonzero(~free)
    right = forms[at] - traces[np.ix_(at, held)].sum(axis=1)
    try:
        solved = np.linalg.solve(traces[np.ix_(at, at)], right)
    except np.linalg.LinAlgError:
        solved = np.full(len(at), -1.0)
    simple = forms[at] / traces.sum(axis=1)[at]
    # A part that is not clearly positive is no variance: the whole step is Förstner's, which shrinks it slowly.
    step[at] = solved if (solved > 0.1).all() else simple
    return step


def _deviations(traces: Floats, free: NDArray[np.bool_], factors: Floats) -> Floats:
    """Return standard deviations of the factors: covariance 2 T^-1 of relative variances of normal errors."""
    out = np.full(len(factors), np.nan)
    at = np.flatnonzero(free)
    if len(at):
        inverse = np.linalg.pinv(traces[np.ix_(at, at)], hermitian=True)
        out[at] = factors[at] * np.sqrt(2.0 * np.diag(inverse))
    return out


def _tests(forms: Floats, traces: Floats, names: Sequence[str], held: Mapping[str, str], o: Options) -> tuple[TestResult, ...]:
    level = o.global_level(float(len(names)))
    tests = [variance_component(forms, traces, names, level, o.levels)]
    at = np.array([i for i, n in enumerate(names) if n not in held], dtype=np.intp)
    if len(at) > 1:
        # A group that is held keeps its share of the others' redundancy.
        block = traces[np.ix_(at, at)]
        block = block + np.diag(traces.sum(axis=1)[at] - block.sum(axis=1))
        tests.append(equal_variance_components(forms[at], block, [names[i] for i in at], level))
    return tuple(tests)


def with_factors(network: Network, a: Adjustment, factors: Mapping[str, float], by: By = "group") -> Network:
    """Return a network with standard deviations multiplied by the factor of their component.

    Parameters
    ----------
    network : Network
    a : Adjustment
        Tells which directly observed values take part.
    factors : mapping
        Factors of standard deviations by name of the component.
    by : {"group", "camera"}

    Raises
    ------
    UsageError
        If a kind of observations has no standard deviations to change.
    """
    groups = []
    for group in network.observations:
        if by == "camera" and len(network.cameras) > 1 and isinstance(group, (ImagePoints, ImageCoordinates)):
            of = np.array([factors.get(_camera_name(c.label), 1.0) for c in network.cameras])
            factor: Any = of[network.images.cameras[group.images]]
        else:
            factor = factors.get(_name(group), 1.0)
        groups.append(_scaled(group, factor))
    cameras, images, points = network.cameras, network.images, network.points
    direct = {group.kind: factors[_name(group)] for group in a.groups if isinstance(group, Direct)}
    if any(isinstance(group, CorrelatedPoints) for group in a.groups):
        direct["point"] = factors["control points"]
    if "camera" in direct:
        cameras = tuple(replace(c, sigmas=np.where(c.states == OBSERVED, c.sigmas * direct["camera"], c.sigmas)) for c in cameras)
    if "image" in direct:
        images = replace(images, sigmas=images.sigmas * direct["image"])
    if "point" in direct:
        at = (points.roles == CONTROL)[:, None]
        points = replace(points, sigmas=np.where(at, points.sigmas * direct["point"], points.sigmas))
    return replace(network, observations=tuple(groups), cameras=cameras, images=images, points=points)


def _scaled(group: Any, factor: Any) -> Any:
    if isinstance(group, ImagePoints):
        return replace(group, sigmas=group.sigmas * np.reshape(factor, (-1, 1)))
    if isinstance(group, ImageCoordinates):
        return replace(group, whole=_scaled(group.whole, factor))
    if not hasattr(group, "sigmas"):
        raise UsageError(f"the standard deviations of {group.name} cannot be changed")
    return replace(group, sigmas=group.sigmas * factor)


def _with_image_sigma(network: Network, sigma: float) -> Network:
    def stated(group: Any) -> Any:
        if isinstance(group, ImagePoints):
            return replace(group, sigmas=np.full(group.sigmas.shape, sigma))
        return replace(group, whole=stated(group.whole)) if isinstance(group, ImageCoordinates) else group

    return replace(network, observations=tuple(stated(g) for g in network.observations))


def _notes(parts: Sequence[Component], converged: bool, count: int, change: float) -> tuple[str, ...]:
    notes = []
    for c in parts:
        if c.outcome == "too little redundancy":
            notes.append(f"{c.name}: redundancy {c.redundancy:.2g}, too little to estimate a variance; the stated one is kept.")
        elif c.outcome == "not positive":
            notes.append(
                f"{c.name}: no positive variance explains its residuals (they are smaller than errors of the other groups alone would make "
                "them); the stated one is kept."
            )
    if not converged:
        notes.append(f"The components have not settled after {count} iterations (last change {change:.1e}).")
    return tuple(notes)
