"""A simulated radar image with known truth, like that of Yangmei (Wu, Liu & Lin 2000), and withheld points with given height."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment import Adjustment, adjust
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import UsageError
from baarda.geometry import range_doppler as radar
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import RangeDoppler, Tracks, tracks
from baarda.procedures.cross_validation import folds_of

Floats = NDArray[np.float64]

#: Yangmei: object coordinates of the middle of the image, and its size along and across the flight, m.
CENTRE, LENGTH, WIDTH = (263_000.0, 2_740_272.0), 9000.0, 12_000.0
HEIGHTS = (75.1, 210.9)
FLYING_HEIGHT, SPEED, PIXEL = 7095.4, 120.0, 4.04
DELAY = 8700.0  # slant range of the first pixel
#: Deviations from a straight level flight at the ends of the image, m: powers 2, 3, 4 of X and Y, and 2 of Z; 3 and 4 of Z are zero.
DEVIATIONS = ((6.0, -5.0, 7.0), (-60.0, 50.0, -60.0), (-12.0, 0.0, 0.0))


@dataclass(frozen=True)
class RadarScenario:
    """A network of radar observations, and the truth.

    Attributes
    ----------
    network : Network
        Control points, measured coordinates, tracks with rough start values.
    truth : Network
        The same with true tracks, points and observations.
    """

    network: Network
    truth: Network

    @property
    def tracks(self) -> Tracks:
        """The true tracks."""
        return self.truth.declared[0]  # type: ignore[return-value]


def flight(middle: Sequence[float], height: float, direction: float, side: int, deviations: Any = DEVIATIONS, order: int = 4) -> Floats:
    """Return the polynomials (3, order + 1) of a flight past an area.

    Parameters
    ----------
    middle : (2,) sequence
        Middle of the image in plan, m.
    height : float
    direction : float
        Azimuth of the flight, radians clockwise from +Y.
    side : int
        1 = looks left, -1 = looks right.
    deviations : (3, 3) array_like
        From straight and level, at both ends of the image, m: powers 2, 3, 4 of X, Y, Z.
    order : int
        1 to 4.

    Returns
    -------
    (3, order + 1) array
        In seconds from the middle of the image.

    Examples
    --------
    >>> flight((0.0, 0.0), 7000.0, 0.0, -1, order=1).round(1)
    array([[-11379.4,      0. ],
           [     0. ,    120. ],
           [  7000. ,      0. ]])
    """
    forward = np.array([np.sin(direction), np.cos(direction)])
    left = np.array([-forward[1], forward[0]])
    near = np.sqrt(DELAY**2 - FLYING_HEIGHT**2)
    out = np.zeros((3, max(order, 1) + 1))
    out[:2, 0] = np.asarray(middle) - side * left * (near + 0.5 * WIDTH + 345.0)
    out[:2, 1] = SPEED * forward
    out[2, 0] = height
    end = 0.5 * LENGTH / SPEED
    for k in range(2, order + 1):
        out[:, k] = np.asarray(deviations, dtype=float)[:, k - 2] / end**k
    return out


def simulate_radar(
    seed: int | np.random.Generator = 1993,
    noise: tuple[float, float] = (PIXEL / SPEED, 1.0),
    points: int = 35,
    order: int = 4,
    squint: Sequence[float] = (0.0,),
    directions: Sequence[float] = (np.pi,),
    sides: Sequence[int] = (1,),
    control_sigma: float | None = None,
    deviations: Any = DEVIATIONS,
    ties: int = 0,
    area: int = 1980,
) -> RadarScenario:
    """Simulate radar images of one area with known truth.

    Parameters
    ----------
    seed : int or Generator
        For the noise.
    noise : (float, float)
        Standard deviations of t (s) and r (pixels); those given to the adjustment, too.
    points : int
        Control points.
    order : int
        Of the polynomials.
    squint : sequence of float
        True polynomial of the squint angle, radians.
    directions, sides : sequences
        Azimuth of each flight, and where it looks: 1 left, -1 right.
    control_sigma : float, optional
        Standard deviation of the control coordinates, m; without it they are exact and fixed.
    deviations : (3, 3) array_like
        See `flight`.
    ties : int
        Further points without known coordinates.
    area : int
        Seed of the points (a Halton sequence), which are the same whatever the noise is.

    Returns
    -------
    RadarScenario

    Raises
    ------
    UsageError
        If directions and sides differ in number.

    Notes
    -----
    Wu, Liu & Lin (2000): 7.0 km height, 120 m/s, 4 m pixels, 9 km x 12 km, 35 points of 75.1 to 210.9 m height, fourth order, n = 70.

    Examples
    --------
    >>> made = simulate_radar()
    >>> len(made.network.points.labels), made.network.observations[0].tr.shape
    (35, (35, 2))
    """
    if len(directions) != len(sides) or not len(sides):
        raise UsageError(f"{len(directions)} directions and {len(sides)} sides do not belong together")
    rng, place = np.random.default_rng(seed), np.random.default_rng(area)
    count, images = points + ties, len(sides)
    x = np.empty((count, 3))
    x[:, :2] = np.array(CENTRE) + [WIDTH, LENGTH] * (stats.qmc.Halton(2, rng=place).random(count) - 0.5)
    x[:, 2] = place.uniform(*HEIGHTS, count)
    coefficients = np.stack([flight(CENTRE, FLYING_HEIGHT, d, s, deviations, order) for d, s in zip(directions, sides, strict=True)])
    turn = np.tile(np.asarray(squint, dtype=float), (images, 1))
    true = tracks([str(k + 1) for k in range(images)], coefficients, turn, PIXEL, DELAY, side=sides)
    track, point = np.repeat(np.arange(images), count), np.tile(np.arange(count), images)
    layout = true.layouts[0]
    arrays = true.arrays(track, layout)
    s, r = radar.project(x[point], *arrays, np.zeros(len(point)))
    sigmas = np.broadcast_to(np.asarray(noise, dtype=float), (len(point), 2)).copy()
    exact = RangeDoppler(track, point, np.stack([s, r], axis=1), sigmas)
    known = np.arange(count) < points
    states = np.where(known, FIXED if control_sigma is None else OBSERVED, FREE)[:, None] * np.ones((1, 3), dtype=int)
    surveyed = x + (0.0 if control_sigma is None else control_sigma * rng.standard_normal(x.shape))
    deviation = np.full((count, 3), np.nan)
    if control_sigma is not None:
        deviation[known] = control_sigma
    roles = np.where(known, CONTROL, 0)
    given = np.where(known[:, None], surveyed, np.nan)
    labels = [f"{'C' if k else 'T'}{i + 1}" for i, k in enumerate(known)]
    table = Points.make(labels, given, roles, states, given, deviation)
    measured = replace(exact, tr=exact.tr + sigmas * rng.standard_normal(exact.tr.shape))
    nothing = np.full_like(coefficients, np.nan)
    rough = tracks(true.labels, nothing, np.zeros_like(turn), np.nan, DELAY, side=sides)
    settings = {"min_rays": 0}
    network = Network((), Images.make(()), table, (measured,), name="radar", settings=settings, declared=(rough,))
    truth = replace(network, points=replace(table, coordinates=x), observations=(exact,), declared=(true,))
    return RadarScenario(network, truth)


@dataclass(frozen=True)
class Planimetry:
    """Planimetric accuracy from withheld points whose height stays given.

    Attributes
    ----------
    points : tuple of str
        Withheld points, turn by turn.
    turns : (n,) int array
    differences, sigmas : (n, 2) arrays
        X and Y, predicted - given, and their standard deviations (a posteriori, survey included).
    rms : (3,) array
        Along X, along Y, and horizontal.
    low, high : (3,) arrays
        Confidence limits of the rms.
    predicted : (3,) array
        Root mean squares of the predicted standard deviations.
    sigma0 : (turns,) array
    confidence : float
    """

    points: tuple[str, ...]
    turns: NDArray[np.intp]
    differences: Floats
    sigmas: Floats
    rms: Floats
    low: Floats
    high: Floats
    predicted: Floats
    sigma0: Floats
    confidence: float


def withhold_plan(network: Network, out: Sequence[int]) -> Network:
    """Return a network in which some control points keep their height only.

    Parameters
    ----------
    network : Network
    out : sequence of int
        Indices of control points.

    Returns
    -------
    Network
        X and Y of these points are free; their survey only starts them.
    """
    points = network.points
    states, at = np.array(points.states), np.asarray(out, dtype=np.intp)
    states[at, :2] = FREE
    return replace(network, points=replace(points, states=states))


def planimetry(
    network: Network,
    turns: int = 6,
    size: int | None = 5,
    seed: int = 0,
    alpha: float = 0.05,
    tell: Callable[[str], None] | None = None,
    **settings: Any,
) -> Planimetry:
    """Withhold X and Y of control points in turns, intersect them with their given height, and compare.

    Parameters
    ----------
    network : Network
        With control points.
    turns : int
    size : int, optional
        Points withheld in each turn, drawn anew; without it every point is withheld once.
    seed : int
        For the draws.
    alpha : float
        1 - alpha is the confidence of the intervals.
    tell : callable, optional
        Is told of each turn.
    **settings
        Fields of `Settings`.

    Returns
    -------
    Planimetry

    Raises
    ------
    UsageError
        If there are too few control points, or a turn does not converge.

    Notes
    -----
    Wu, Liu & Lin (2000): 6 turns of 5 points. Intervals by chi-square with Satterthwaite's degrees of freedom, from the joint covariance of
    the differences of a turn; turns are taken as independent.
    """
    table = network.points
    control = np.flatnonzero((table.roles == CONTROL) & np.isfinite(table.given).all(axis=1))
    if size is None:
        parts = folds_of(len(control), turns, seed)
    elif not 1 <= size <= len(control) - 1 or turns < 1:
        raise UsageError(f"{size} of {len(control)} control points cannot be withheld")
    else:
        rng = np.random.default_rng(seed)
        parts = [np.sort(rng.permutation(len(control))[:size]) for _ in range(turns)]
    return planimetry_of([(network, control[part]) for part in parts], alpha, tell, **settings)


def planimetry_of(
    turns: Sequence[tuple[Network, NDArray[np.intp]]], alpha: float = 0.05, tell: Callable[[str], None] | None = None, **settings: Any
) -> Planimetry:
    """Withhold X and Y of given points of given networks, one after the other.

    Parameters
    ----------
    turns : sequence of (Network, int array)
        For each turn the network, and the indices of the control points that keep their height only.
    alpha, tell, **settings
        See `planimetry`.

    Returns
    -------
    Planimetry

    Raises
    ------
    UsageError
        If a turn does not converge.
    """
    labels: list[str] = []
    turn, differences, sigmas, sigma0 = [], [], [], []
    mean, fourth, square = np.zeros(3), np.zeros(3), np.zeros(3)
    for k, (network, out) in enumerate(turns):
        a = adjust(withhold_plan(network, out.tolist()), **settings)
        if a.status != "converged":
            raise UsageError(f"turn {k + 1} did not converge; {a.contradictions()}")
        d, c = _plan_errors(a, out)
        for j, at in enumerate((np.arange(0, 2 * len(out), 2), np.arange(1, 2 * len(out), 2), np.arange(2 * len(out)))):
            block = c[np.ix_(at, at)]
            square[j] += float(np.sum(d.ravel()[at] ** 2))
            mean[j] += float(np.trace(block))
            fourth[j] += float(np.sum(block * block))
        labels += [network.points.labels[i] for i in out]
        turn += [k] * len(out)
        differences.append(d)
        sigmas.append(np.sqrt(np.diag(c)).reshape(-1, 2))
        sigma0.append(a.sigma0)
        if tell is not None:
            tell(f"turn {k + 1} of {len(turns)}: {len(out)} points withheld in plan, rms {np.sqrt(np.mean(d**2)):.4g} {network.unit}")
    df = mean**2 / fourth
    low, high = (np.sqrt(square / len(labels) * df / stats.chi2.ppf(q, df)) for q in (1.0 - alpha / 2.0, alpha / 2.0))
    rms, predicted = np.sqrt(square / len(labels)), np.sqrt(mean / len(labels))
    return Planimetry(
        tuple(labels),
        np.array(turn),
        np.concatenate(differences),
        np.concatenate(sigmas),
        rms,
        low,
        high,
        predicted,
        np.array(sigma0),
        1 - alpha,
    )


def _plan_errors(a: Adjustment, out: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return differences (n, 2) of X and Y from the survey, and their joint covariance (2 n, 2 n), survey included."""
    points = a.network.points
    columns = a.numbering["point"].columns.reshape(-1, 3)[out, :2].ravel()
    c = a.variance_factor * a.cofactors.of(columns)
    survey = np.nan_to_num(points.covariance(out)[:, :2, :2])
    for i, block in enumerate(survey):
        c[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += block
    return points.coordinates[out, :2] - points.given[out, :2], 0.5 * (c + c.T)
