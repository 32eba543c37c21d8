"""From independent models to the bundle: image coordinates, refinement, strip polynomials, resections, simultaneous adjustment.

Maarek & Konecny: stereoplotter models give image coordinates by collinearity; polynomials and single resections start the simultaneous
adjustment, whose residuals U are studied.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda import cameras
from baarda.adjustment import Adjustment, adjust
from baarda.cameras import FIXED, OBSERVED
from baarda.errors import BaardaError, Singular, UsageError
from baarda.geometry import rotation as rot
from baarda.geometry.resection import resect
from baarda.geometry.similarity import similarity
from baarda.geometry.strip_polynomial import BlockPolynomials, adjust_polynomials, connect_models
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import ImagePoints, ModelCoordinates, models

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Refine = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Model:
    """An independent model of two photographs.

    Attributes
    ----------
    label : str
    photographs : tuple of str
    centres : dict of str to (3,) array
        Perspective centre of each photograph, model units.
    rotations : dict of str to (3, 3) array
        Rotation of each photograph in the model, M = camera from model.
    points : dict of str to (3,) array
        Model coordinates of the points.
    """

    label: str
    photographs: tuple[str, ...]
    centres: Mapping[str, Floats]
    rotations: Mapping[str, Floats]
    points: Mapping[str, Floats]

    def image_coordinates(self, photograph: str, principal_distance: float) -> Floats:
        """Return the image coordinates (n, 2) of all points in a photograph, by collinearity.

        Parameters
        ----------
        photograph : str
        principal_distance : float

        Returns
        -------
        (n, 2) array
            In the unit of the principal distance, about the principal point, in the order of the points.

        Raises
        ------
        UsageError
            If the perspective centre or the rotation of the photograph is missing, or a point lies behind it.

        Notes
        -----
        x = -c u / w, (u, v, w) = M (X - X0): Maarek & Konecny, section 3.

        Examples
        --------
        >>> m = Model("1", ("a",), {"a": np.array([0.0, 0, 10.0])}, {"a": np.eye(3)}, {"p": np.array([1.0, 2.0, 0.0])})
        >>> m.image_coordinates("a", 150.0)
        array([[15., 30.]])
        """
        if photograph not in self.centres:
            raise UsageError(f"model {self.label}: the perspective centre of photograph {photograph} is missing")
        if photograph not in self.rotations:
            raise UsageError(f"model {self.label}: the rotation of photograph {photograph} is missing")
        d = np.array(list(self.points.values())).reshape(-1, 3) - self.centres[photograph]
        u = d @ np.asarray(self.rotations[photograph]).T
        behind = np.flatnonzero(u[:, 2] >= 0.0)
        if len(behind):
            raise UsageError(f"model {self.label}: point {list(self.points)[behind[0]]} lies behind photograph {photograph}")
        return np.asarray(-principal_distance * u[:, :2] / u[:, 2:])


@dataclass(frozen=True)
class Chain:
    """The stages of the chain.

    Attributes
    ----------
    network : Network
        Photographs, image coordinates and points, with the start values that the chain found.
    polynomials : BlockPolynomials
    start_points : dict of str to (3,) array
        Points by the polynomials.
    adjustment : Adjustment
        The simultaneous adjustment; its residuals are the U of the paper.
    """

    network: Network
    polynomials: BlockPolynomials
    start_points: dict[str, Floats]
    adjustment: Adjustment


def _centre_label(photograph: str) -> str:
    return f"perspective centre {photograph}"


def bundle_of_models(
    given: Sequence[Model], principal_distance: float, sigma: float, control: Points, refine: Refine | None = None, unit: str = "mm"
) -> Network:
    """Return the bundle network of the photographs of independent models, without start values of orientations and tie points.

    Parameters
    ----------
    given : sequence of Model
    principal_distance : float
        Of the camera, in `unit`.
    sigma : float
        A-priori standard deviation of the derived image coordinates, same unit.
    control : Points
        Control points of the object space.
    refine : callable, optional
        Applied to the image coordinates (n, 2) of each photograph: functions of `baarda.geometry.refinement`, combined.
    unit : str
        Of image coordinates.

    Returns
    -------
    Network
        One group of image points for each model; a point in two models is measured twice in the photograph that they share.

    Raises
    ------
    UsageError
        If a perspective centre is missing.
    """
    photographs = list(dict.fromkeys(p for m in given for p in m.photographs))
    labels = list(dict.fromkeys([*control.labels, *(label for m in given for label in m.points)]))
    index = {label: i for i, label in enumerate(labels)}
    groups = []
    for m in given:
        image, point, xy = [], [], []
        for name in m.photographs:
            found = m.image_coordinates(name, principal_distance)
            xy.append(found if refine is None else refine(found))
            image += [photographs.index(name)] * len(m.points)
            point += [index[label] for label in m.points]
        groups.append(ImagePoints.make(image, point, np.concatenate(xy), sigma, name=f"model {m.label}"))
    more = len(labels) - len(control.labels)

    def longer(table: Any, fill: Any) -> Any:
        return np.concatenate([table, np.full((more, *table.shape[1:]), fill, dtype=table.dtype)])

    points = Points(
        tuple(labels),
        longer(control.coordinates, np.nan),
        longer(control.roles, 0),
        longer(control.states, cameras.FREE),
        longer(control.given, np.nan),
        longer(control.sigmas, np.nan),
        longer(control.correlations, 0.0),
    )
    camera = cameras.create("1", cameras.model("pinhole"), {"principal_distance": principal_distance}, unit=unit, y_down=False)
    return Network((camera,), Images.make(photographs), points, tuple(groups), name="independent models")


def adjust_chain(
    given: Sequence[Model],
    control: Points,
    principal_distance: float,
    sigma: float,
    order: int = 2,
    refine: Refine | None = None,
    unit: str = "mm",
    **settings: Any,
) -> Chain:
    """Lead independent models through the whole chain to the simultaneous adjustment.

    Parameters
    ----------
    given : sequence of Model
    control : Points
    principal_distance, sigma, refine, unit
        See `bundle_of_models`.
    order : int
        Of the strip polynomials, 1 to 3.
    **settings
        Fields of `Settings`.

    Returns
    -------
    Chain

    Raises
    ------
    UsageError
        If a perspective centre is missing.
    Singular
        If models cannot be connected, control does not determine the polynomials, or a photograph cannot be resected.

    Notes
    -----
    Maarek & Konecny, section 3: polynomial adjustment for the pass points, resection of every photograph, simultaneous adjustment.
    """
    network = bundle_of_models(given, principal_distance, sigma, control, refine, unit)
    strip = connect_models(
        [m.points | {_centre_label(k): x for k, x in m.centres.items()} for m in map(_plain, given)], [m.label for m in given]
    )
    tied = {k: x for k, x in strip.points.items() if not k.startswith("perspective centre ")}
    use = control.roles == CONTROL
    known = {
        label: np.where(control.states[i] == cameras.FREE, np.nan, control.given[i]) for i, label in enumerate(control.labels) if use[i]
    }
    full = [label for label, x in known.items() if label in tied and np.isfinite(x).all()]
    try:  # the strip is levelled first: polynomials bend it only a little
        level = similarity(np.array([tied[k] for k in full]).reshape(-1, 3), np.array([known[k] for k in full]).reshape(-1, 3))
    except UsageError as error:
        raise Singular(f"the strip cannot be moved onto {len(full)} control point(s): {error}") from None
    tied = {k: level.apply(x) for k, x in tied.items()}
    polynomials = adjust_polynomials([tied], {k: x for k, x in known.items() if k in tied}, order)
    start = dict(polynomials.points)
    labels = network.points.labels
    coordinates = np.array([start.get(label, np.full(3, np.nan)) for label in labels])
    surveyed = np.isfinite(network.points.given) & (network.points.roles == CONTROL)[:, None]
    coordinates = np.where(surveyed, network.points.given, coordinates)
    position, turned = np.empty((len(network.images.labels), 3)), np.empty((len(network.images.labels), 3, 3))
    for i, name in enumerate(network.images.labels):
        rows = [(g.points[g.images == i], g.xy[g.images == i]) for g in network.observations]
        point, xy = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
        good = np.isfinite(coordinates[point]).all(axis=1)
        try:
            pose = resect(xy[good] / principal_distance, coordinates[point[good]], robust=False)
        except BaardaError as error:
            raise Singular(f"photograph {name} cannot be resected: {error}", [f"image {name}"]) from None
        position[i], turned[i] = pose.position, pose.rotation
    started = replace(
        network,
        images=replace(network.images, position=position, rotation=turned),
        points=replace(network.points, coordinates=coordinates),
    )
    return Chain(started, polynomials, start, adjust(started, **settings))


def _plain(m: Model) -> Any:
    """Return a model with its points and centres in plain dictionaries."""
    for name in m.photographs:
        if name not in m.centres:
            raise UsageError(f"model {m.label}: the perspective centre of photograph {name} is missing")
    return replace(m, points=dict(m.points), centres=dict(m.centres))


def block_of_models(given: Sequence[Model], control: Points, sigma: float, centre_sigma: float | None = None, unit: str = "m") -> Network:
    """Return the network of the spatial block adjustment of independent models by seven-parameter transformations.

    Parameters
    ----------
    given : sequence of Model
    control : Points
    sigma : float
        A-priori standard deviation of model coordinates.
    centre_sigma : float, optional
        That of perspective centres; the same without it.
    unit : str
        Of the model coordinates.

    Returns
    -------
    Network
        With the unknown group `model`; start values are found when it is adjusted.

    Raises
    ------
    UsageError
        If a perspective centre is missing.

    Notes
    -----
    Ackermann, Ebner & Klein (1973).
    """
    plain = [_plain(m) for m in given]
    labels = list(control.labels)
    for m in plain:
        labels += [*m.points, *(_centre_label(k) for k in m.centres)]
    labels = list(dict.fromkeys(labels))
    index = {label: i for i, label in enumerate(labels)}
    node, point, xyz, deviation = [], [], [], []
    for k, m in enumerate(plain):
        for label, x in [*m.points.items(), *((_centre_label(p), x) for p, x in m.centres.items())]:
            node.append(k)
            point.append(index[label])
            xyz.append(x)
            deviation.append(sigma if label in m.points or centre_sigma is None else centre_sigma)
    more = len(labels) - len(control.labels)
    points = Points.make(
        labels,
        np.concatenate([control.coordinates, np.full((more, 3), np.nan)]),
        np.concatenate([control.roles, np.zeros(more, dtype=np.int8)]),
        np.concatenate([control.states, np.full((more, 3), cameras.FREE)]),
        np.concatenate([control.given, np.full((more, 3), np.nan)]),
        np.concatenate([control.sigmas, np.full((more, 3), np.nan)]),
        np.concatenate([control.correlations, np.zeros((more, 3))]),
    )
    group = ModelCoordinates(
        np.array(node, dtype=np.intp),
        np.array(point, dtype=np.intp),
        np.array(xyz),
        np.tile(np.array(deviation)[:, None], (1, 3)),
        unit=unit,
    )
    declared = models([m.label for m in plain])
    settings = {"min_rays": 0}
    return Network((), Images.make(()), points, (group,), name="independent models", settings=settings, declared=(declared,))


@dataclass(frozen=True)
class SimulatedStrip:
    """A strip of models with known truth.

    Attributes
    ----------
    models : tuple of Model
    control : Points
    truth : dict of str to (3,) array
        All object points.
    position, rotation : arrays (p, 3), (p, 3, 3)
        True exterior orientation of the photographs.
    principal_distance : float
        mm.
    """

    models: tuple[Model, ...]
    control: Points
    truth: dict[str, Floats]
    position: Floats
    rotation: Floats
    principal_distance: float


def simulate_strip(
    count: int = 5, noise: float = 0.0, control_sigma: float | None = None, seed: int = 1972, every: int = 2, distort: Refine | None = None
) -> SimulatedStrip:
    """Simulate a strip of independent models: 60 % overlap, nine points in each model, control at every second base.

    Parameters
    ----------
    count : int
        Models.
    noise : float
        Standard deviation of image coordinates, mm, carried over to the model coordinates by intersection.
    control_sigma : float, optional
        Standard deviation of control coordinates, m; exact and fixed without it.
    seed : int
    every : int
        Bases between rows of control.
    distort : callable, optional
        Applied to true image coordinates (n, 2), mm, before the models are formed: systematic errors.

    Returns
    -------
    SimulatedStrip

    Raises
    ------
    UsageError
        If there is no model.

    Examples
    --------
    >>> made = simulate_strip(3)
    >>> len(made.models), len(made.models[0].points), len(made.truth)
    (3, 9, 15)
    """
    if count < 1:
        raise UsageError("a strip needs at least one model")
    rng = np.random.default_rng(seed)
    c, height, base = 152.4, 1500.0, 900.0
    photographs = count + 1
    position = np.stack([base * np.arange(photographs), np.zeros(photographs), np.full(photographs, height)], axis=1)
    position += rng.normal(0.0, [20.0, 20.0, 10.0], position.shape)
    omega, phi, kappa = rng.normal(0.0, [[0.02], [0.02], [0.03]], (3, photographs))
    rotation = rot.from_angles(omega, phi, kappa)
    truth = {}
    for i in range(photographs + 1):  # rows of three points at each base, one more at the end of the last model
        for j, y in enumerate((-1200.0, 0.0, 1200.0)):
            truth[f"{i + 1}{'abc'[j]}"] = np.array([base * (i - 0.5), y, 0.0]) + rng.normal(0.0, [60.0, 60.0, 40.0])
    made = []
    for k in range(count):
        labels = [f"{i + 1}{a}" for i in (k, k + 1, k + 2) for a in "abc"]
        x = np.array([truth[label] for label in labels])
        pair = (k, k + 1)
        xy = []
        for p in pair:
            u = (x - position[p]) @ rotation[p].T
            ideal = -c * u[:, :2] / u[:, 2:]
            xy.append((ideal if distort is None else distort(ideal)) + noise * rng.standard_normal(ideal.shape))
        # the model: rays of both photographs, intersected, in a system of its own
        turn, scale = rot.exp(rng.normal(0.0, 0.3, 3)), 1.0 / 5000.0 * rng.uniform(0.8, 1.2)
        rays = [np.concatenate([q / -c, np.ones((len(q), 1))], axis=1) @ rotation[p] for q, p in zip(xy, pair, strict=True)]
        met = np.array([_nearest(position[list(pair)], np.stack([rays[0][i], rays[1][i]])) for i in range(len(x))])
        origin = position[k] + rng.normal(0.0, 100.0, 3)
        names = tuple(f"photo {p + 1}" for p in pair)
        made.append(
            Model(
                str(k + 1),
                names,
                {n: scale * turn @ (position[p] - origin) for n, p in zip(names, pair, strict=True)},
                {n: rotation[p] @ turn.T for n, p in zip(names, pair, strict=True)},
                dict(zip(labels, scale * (met - origin) @ turn.T, strict=True)),
            )
        )
    chosen = [label for label in truth if (int(label[:-1]) - 1) % every == 0]
    x = np.array([truth[label] for label in chosen])
    sigma = np.full(x.shape, np.nan if control_sigma is None else control_sigma)
    given = x + (0.0 if control_sigma is None else control_sigma * rng.standard_normal(x.shape))
    states = np.full(x.shape, FIXED if control_sigma is None else OBSERVED)
    control = Points.make(chosen, given, np.full(len(x), CONTROL), states, given, sigma)
    return SimulatedStrip(tuple(made), control, truth, position, rotation, c)


def _nearest(origins: Floats, rays: Floats) -> Floats:
    """Return the point nearest to two rays."""
    d = rays / np.linalg.norm(rays, axis=1)[:, None]
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    return np.asarray(np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, origins)))
