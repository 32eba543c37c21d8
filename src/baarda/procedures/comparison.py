"""Two adjustments of the same points: one datum for both, equal precision, congruence, and which points have moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment, adjust
from baarda.adjustment.datum import FREEDOMS
from baarda.errors import Singular, UsageError
from baarda.geometry.rotation import skew
from baarda.geometry.similarity import Similarity, similarity
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.deformation import Localisation, deformation, deformation_point, moved_points, pooled_variance_factor
from baarda.hypotheses.levels import Options
from baarda.hypotheses.variance_factor import variance_ratio
from baarda.network import AXES, CHECK, CONTROL, Network, State
from baarda.observations import ImagePoints
from baarda.procedures.planning import plan

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Frame = Literal["auto", "given", "common"]

MOST = 400  # points compared; their joint cofactor matrix is dense
COLUMNS = 64  # right-hand sides solved at a time
_SAME = 0.5  # share of equal image coordinates beyond which two adjustments are not independent


@dataclass(frozen=True)
class Epoch:
    """What a comparison needs of one adjustment.

    Attributes
    ----------
    adjustment : Adjustment
        Its cofactors; of the network as it is, if `as_it_is`.
    variance_factor : float
        s0^2.
    redundancy : float
        r.
    observations : tuple
        Observation groups of the source.
    as_it_is : bool
        Whether the coordinates of the source were taken without adjusting them.
    """

    adjustment: Adjustment
    variance_factor: float
    redundancy: float
    observations: tuple[Any, ...]
    as_it_is: bool = False

    @property
    def network(self) -> Network:
        """The network with the coordinates that are compared."""
        return self.adjustment.network

    def coordinates(self, rows: Ints) -> Floats:
        """Return coordinates of points, (k, 3), in the system of the source."""
        return np.asarray(self.network.points.coordinates[rows] - self.network.offset)

    def cofactors(self, rows: Ints) -> Floats:
        """Return the joint cofactors of points, (3 k, 3 k); zero for fixed coordinates."""
        a = self.adjustment
        columns = a.numbering["point"].columns.reshape(-1, 3)[rows].ravel()
        parts = [a.cofactors.of(columns, columns[i : i + COLUMNS]) for i in range(0, len(columns), COLUMNS)]
        q = np.concatenate(parts, axis=1)
        return np.asarray(0.5 * (q + q.T))


@dataclass(frozen=True)
class Comparison:
    """The outcome of a comparison; differences are second minus first.

    Attributes
    ----------
    first, second : Epoch
    labels : tuple of str
        Points compared.
    differences : (k, 3) array
        In the common datum, tied to the stable points; NaN where a coordinate is fixed in one of the two.
    sigmas : (k, 3) array
        Standard deviations of these differences.
    coordinates : (k, 3) array
        Of the first epoch.
    freedoms : tuple of str
        Transformations that were taken out.
    transformation : Similarity or None
        What brought the second to the first beforehand.
    dependent : bool
        Whether both adjust the same image points: then nothing is tested.
    variance_ratio, congruence : TestResult or None
    points : TestResult or None
        The test of each point.
    localisation : Localisation or None
        Which points moved, where the congruence test rejects.
    variance_factor, redundancy : float
        That judged.
    options : Options
    notes : tuple of str
        What was decided, left out, or must be known.
    """

    first: Epoch
    second: Epoch
    labels: tuple[str, ...]
    differences: Floats
    sigmas: Floats
    coordinates: Floats
    freedoms: tuple[str, ...]
    transformation: Similarity | None
    dependent: bool
    variance_ratio: TestResult | None
    congruence: TestResult | None
    points: TestResult | None
    localisation: Localisation | None
    variance_factor: float
    redundancy: float
    options: Options
    notes: tuple[str, ...]

    @property
    def rejected(self) -> bool:
        """The gate of ``--strict``: True where the congruence test was done and rejects."""
        return self.congruence is not None and bool(self.congruence.rejected)


def epoch(network: Network, as_it_is: bool = False, **settings: Any) -> Epoch:
    """Adjust a network for a comparison, or take it as it is.

    Parameters
    ----------
    network : Network
    as_it_is : bool
        Take the coordinates of the source, for instance of another program, without adjusting them; v'Pv and cofactors are theirs.
    **settings
        The fields of `baarda.adjustment.Settings`.

    Returns
    -------
    Epoch

    Raises
    ------
    UsageError
        If the adjustment does not converge.

    Examples
    --------
    >>> from baarda.procedures.synthetic import ring
    >>> epoch(ring(5, points=12).network).redundancy
    69.0
    """
    if as_it_is:
        made = plan(network, None, "start", **settings).adjustment
        groups = [g for g in made.groups if isinstance(g, ImagePoints)]
        active = ~made.aside
        from baarda.adjustment.linearize import whitened_misclosures
        from baarda.adjustment.solve import Settings, active_groups, prepare

        prepared = prepare(network, Settings.of(network, settings))[0]
        observed = active_groups(prepared, active)
        v = whitened_misclosures(prepared, State.of(made.network), observed)
        if not groups or not np.isfinite(v).all():
            raise UsageError("the observations of the solution cannot be computed from its coordinates")
        return Epoch(made, float(v @ v) / made.redundancy, float(made.redundancy), network.observations, True)
    result = adjust(network, **settings)
    if result.status != "converged":
        raise UsageError(f"{network.path or network.name}: not converged, {result.contradictions()}")
    return Epoch(result, result.variance_factor, float(result.redundancy), network.observations)


def compare(
    first: Epoch, second: Epoch, options: Options | None = None, frame: Frame = "auto", points: Sequence[str] | None = None
) -> Comparison:
    """Compare two adjustments of the same points.

    Parameters
    ----------
    first, second : Epoch
        Independent epochs; or adjustments of the same image points, which are described, not tested.
    options : Options, optional
        `alpha` and which variance factor judges.
    frame : {"auto", "given", "common"}
        Compare the coordinates as they are given, or after taking out what the datum leaves free (shifts, rotations, scale); auto takes out
        what at least one of the two leaves free.
    points : sequence of str, optional
        Points to compare; by default all of which both determine a coordinate, at most 400. Coordinates that are fixed in one of the two
        are not compared; where a whole similarity transformation is taken out, points with such coordinates are left out.

    Returns
    -------
    Comparison

    Raises
    ------
    UsageError
        If units differ, or too few points are common.
    Singular
        If the cofactors of the differences are not those of an adjustment.

    Notes
    -----
    W. Baarda, S-transformations and criterion matrices (1973); H. Pelzer, DGK C 164 (1971); A. Grün, Photogrammetria 34 (1978) 399-400.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from baarda.procedures.synthetic import ring
    >>> truth = ring(5, points=12).truth
    >>> rng = np.random.default_rng(1)
    >>> def measured():
    ...     group = truth.observations[0]
    ...     return replace(truth, observations=(replace(group, xy=group.xy + 0.5 * rng.standard_normal(group.xy.shape)),))
    >>> compare(epoch(measured()), epoch(measured())).rejected
    False
    """
    o = Options() if options is None else options
    notes: list[str] = []
    if frame not in ("auto", "given", "common"):
        raise UsageError(f"the frame is 'auto', 'given' or 'common', not {frame!r}")
    if first.network.unit != second.network.unit:
        raise UsageError(f"the object units differ: {first.network.unit} and {second.network.unit}")
    freedoms = _freedoms(first, second, frame)
    labels, rows, used = _common(first, second, points, len(freedoms) >= 6, notes)
    x1, x2 = first.coordinates(rows[0]), second.coordinates(rows[1])
    q1, q2 = first.cofactors(rows[0]), second.cofactors(rows[1])
    transformation = None
    if len(freedoms) >= 6:
        transformation = similarity(x2, x1, with_scale="scale" in freedoms)
        turn = transformation.scale * np.kron(np.eye(len(labels)), transformation.rotation)
        x2, q2 = transformation.apply(x2), turn @ q2 @ turn.T
    dependent = _share_of_equal(first, second) > _SAME
    ratio, factor, r, weights = _factors(first, second, o, dependent, notes)
    at = np.flatnonzero(used)
    d, q = (x2 - x1).ravel()[at], (weights[0] * q1 + weights[1] * q2)[np.ix_(at, at)]
    if dependent:
        q = np.asarray(q1)[np.ix_(at, at)]  # what the differences are measured with
    point = at // 3
    g = _independent(_directions(x1, freedoms)[at])
    reduced, cofactors = _transformed(d, q, g, np.ones(len(at), dtype=bool))
    congruence = family = localisation = None
    if not dependent:
        defect = g.shape[1]
        each = [labels[i] for i in point]
        congruence = deformation(reduced, cofactors, factor, r, o.global_level(len(d) - defect), defect)
        family = deformation_point(reduced, cofactors, factor, r, each, o.global_level(3), o.levels, defect)
        if congruence.rejected:
            localisation = moved_points(reduced, cofactors, factor, r, each, o.global_level(3), defect)
            stable = np.isin(labels, localisation.stable)
            if stable[point].sum() > defect and stable.sum() >= 3:
                reduced, cofactors = _transformed(d, q, g, stable[point])
            if not localisation.decided:
                notes.append("Too few points are left to tell the stable from the moved ones: most of them differ.")
        notes += _control_notes(first, second, freedoms)
    differences, deviations = np.full((2, len(labels), 3), np.nan)
    differences.ravel()[at], deviations.ravel()[at] = reduced, np.sqrt(factor * _variances(cofactors, q))
    return Comparison(
        first,
        second,
        labels,
        differences,
        deviations,
        x1,
        freedoms,
        transformation,
        dependent,
        ratio,
        congruence,
        family,
        localisation,
        factor,
        r,
        o,
        tuple(notes),
    )


def _variances(cofactors: Floats, of: Floats) -> Floats:
    """Return the diagonal of transformed cofactors; what rounding leaves below zero is zero, more is an error."""
    own, rounding = np.diag(cofactors), 1e-9 * np.diag(of).max(initial=0.0)
    if (own < -rounding).any():
        raise Singular("the cofactors of the differences have a negative variance")
    return np.asarray(np.where(own > 0.0, own, 0.0))


def _common(
    first: Epoch, second: Epoch, points: Sequence[str] | None, whole: bool, notes: list[str]
) -> tuple[tuple[str, ...], tuple[Ints, Ints], NDArray[np.bool_]]:
    """Return the labels of the points to compare, their rows in both networks, and which coordinates (k, 3) both determine."""
    free = [e.adjustment.numbering["point"].columns.reshape(-1, 3) >= 0 for e in (first, second)]
    every = [{label: i for i, label in enumerate(e.network.points.labels)} for e in (first, second)]
    shared = {p: free[0][every[0][p]] & free[1][every[1][p]] for p in every[0] if p in every[1]}
    known = [p for p, used in shared.items() if (used.all() if whole else used.any())]
    places = [{p: place[p] for p in known} for place in every]
    if points is not None:
        missing = [p for p in points if p not in set(known)]
        if missing:
            raise UsageError(f"{len(missing)} points to compare are not free in both networks, first {missing[0]!r}")
        known = list(dict.fromkeys(points))
    if len(known) < 3:
        raise UsageError(f"a comparison needs at least 3 points that both networks determine; common are {len(known)}")
    if len(known) > MOST:
        roles = first.network.points.roles
        marked = [p for p in known if roles[places[0][p]] in (CONTROL, CHECK)][:MOST]
        others = [p for p in known if p not in set(marked)]
        left = MOST - len(marked)
        at = np.unique(np.linspace(0, len(others) - 1, left).round().astype(int)) if left else np.zeros(0, dtype=int)
        chosen = {*marked, *(others[i] for i in at)}
        notes.append(f"{len(known)} points are common; {len(chosen)} of them are compared, control and check points first.")
        known = [p for p in known if p in chosen]
    rows = tuple(np.array([place[p] for p in known], dtype=np.intp) for place in places)
    used = np.array([shared[p] for p in known])
    if not used.all():
        told = ", ".join(f"{int(n)} {axis}" for n, axis in zip((~used).sum(axis=0), AXES, strict=True) if n)
        notes.append(f"Coordinates that are fixed in one of the two are not compared: {told}.")
    return tuple(known), (rows[0], rows[1]), used


def _freedoms(first: Epoch, second: Epoch, frame: Frame) -> tuple[str, ...]:
    """Return the transformations to take out."""
    defects = [e.adjustment.datum.defect for e in (first, second)]
    if frame == "given":
        if any(d.count for d in defects):
            raise UsageError("a free network has no coordinates of its own to compare as given; leave --frame out")
        return ()
    if frame == "common":
        return FREEDOMS
    if not any(d.count for d in defects):
        return ()
    if any(len(d.free) != d.count for d in defects):
        return FREEDOMS  # combinations of shifts, rotations and scale
    return tuple(f for f in FREEDOMS if any(f in d.free for d in defects))


def _directions(x: Floats, freedoms: Sequence[str]) -> Floats:
    """Return how coordinates change under the freedoms, (3 k, d), about the mean of the points."""
    y = x - x.mean(axis=0)
    size = float(np.sqrt((y**2).sum(axis=1).mean()))
    shift = np.broadcast_to(np.eye(3), (len(x), 3, 3))
    every = np.concatenate([shift, -skew(y) / size, y[:, :, None] / size], axis=2).reshape(-1, 7)
    return np.asarray(every[:, [FREEDOMS.index(f) for f in freedoms]])


def _independent(g: Floats) -> Floats:
    """Return the directions that the compared coordinates show, orthonormal: a network in the plane has no shift in Z."""
    if not g.shape[1]:
        return g
    left, size, _ = np.linalg.svd(g, full_matrices=False)
    return np.asarray(left[:, size > 1e-9 * size[0]])


def _transformed(d: Floats, q: Floats, g: Floats, datum: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Apply the S-transformation S = I - G (G'E G)^-1 G'E to differences and cofactors; E selects the datum's coordinates (Baarda 1973)."""
    if not g.shape[1]:
        return d, q
    on = g * datum[:, None]
    s = np.eye(len(d)) - g @ np.linalg.solve(on.T @ g, on.T)
    moved = s @ q @ s.T
    return s @ d, 0.5 * (moved + moved.T)


def _factors(
    first: Epoch, second: Epoch, o: Options, dependent: bool, notes: list[str]
) -> tuple[TestResult | None, float, float, tuple[float, float]]:
    """Return the variance ratio test, the variance factor and redundancy that judge, and the weights of both cofactor matrices."""
    if dependent:
        return None, first.variance_factor, first.redundancy, (1.0, 1.0)
    ratio = variance_ratio(
        first.variance_factor, first.redundancy, second.variance_factor, second.redundancy, o.global_level(first.redundancy)
    )
    if o.sigma == "apriori":
        return ratio, 1.0, np.inf, (1.0, 1.0)
    if not ratio.rejected:
        factor, r = pooled_variance_factor(first.variance_factor, first.redundancy, second.variance_factor, second.redundancy)
        return ratio, factor, r, (1.0, 1.0)
    notes.append(
        "The variance factors differ: each epoch is judged by its own, with the smaller redundancy; the laws are then approximate."
    )
    return ratio, 1.0, min(first.redundancy, second.redundancy), (first.variance_factor, second.variance_factor)


def _share_of_equal(first: Epoch, second: Epoch) -> float:
    """Return the share of image points with equal coordinates in both; of all other observed values where there are no image points."""
    pixels = [
        np.concatenate([g.xy for g in e.observations if isinstance(g, ImagePoints)] or [np.zeros((0, 2))]).view(complex).ravel()
        for e in (first, second)
    ]
    if not any(len(p) for p in pixels):
        pixels = [np.concatenate([np.zeros(0), *(np.ravel(g.observed()) for g in e.observations)]) for e in (first, second)]
    fewer, more = sorted(pixels, key=len)
    return float(np.isin(fewer, more).mean()) if len(fewer) else 0.0


def _control_notes(first: Epoch, second: Epoch, freedoms: Sequence[str]) -> list[str]:
    """Tell when both epochs rest on the same surveyed coordinates."""
    tables = [e.network.points for e in (first, second)]
    given = [
        {label: tuple(t.given[i] - e.network.offset) for i, label in enumerate(t.labels) if t.roles[i] == CONTROL}
        for e, t in zip((first, second), tables, strict=True)
    ]
    shared = sum(1 for label, xyz in given[0].items() if given[1].get(label) == xyz)
    if not shared or freedoms:
        return []
    return [
        f"{shared} control points have the same given coordinates in both epochs: their errors are common, the test takes them for "
        "independent and is on the safe side. --frame common leaves the control's datum out."
    ]
