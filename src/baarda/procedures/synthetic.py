"""Realistic blocks with known truth, for planning, tests and benchmarks: aerial, close-range ring, long tracks, dense camera graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda import cameras
from baarda.cameras import FIXED, FREE, OBSERVED, Camera, Optics
from baarda.errors import UsageError
from baarda.geometry import collinearity
from baarda.geometry import rotation as rot
from baarda.network import CHECK, CONTROL, Images, Network, Points
from baarda.observations import Distances, ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

ROWS = 1 << 17  # rays projected at a time
FRAME = (6000.0, 4500.0)  # pixels
DISTANCE = 5500.0  # principal distance, pixels


@dataclass(frozen=True)
class Synthetic:
    """A block with its truth.

    Attributes
    ----------
    network : Network
        Observations with errors, start values perturbed.
    truth : Network
        The same tables with true values and observations without errors.
    """

    network: Network
    truth: Network


@dataclass(frozen=True)
class Plan:
    """What differs from block to block of one kind.

    Attributes
    ----------
    images : int
    points : int or None
        Number of object points; None is the usual number of the kind. An aerial block keeps those with at least 3 rays.
    seed : int
    noise : float
        Standard deviation of image coordinates, pixels; also their a-priori sigma. Zero gives observations without errors and sigma 0.5.
    perturbation : float
        Size of the errors of the start values; 0 starts at the truth, 1 is the usual start of an orientation by approximate sensors.
    per_image_cameras : bool
        A camera with parameters of its own for every image.
    model : str
        Camera model, for instance ``RADIAL`` (distorts ideal coordinates) or ``brown`` (corrects measured ones).
    control_sigma : float or None
        Standard deviation of control coordinates, object units; 0 holds control points fixed, None is the usual one of the kind.
    control : int or None
        Number of control points; None is the usual number, 0 leaves a free network.
    checks : int
        Number of check points, their reference without error.
    keep : float
        Share of the possible observations that is kept.
    """

    images: int = 20
    points: int | None = None
    seed: int = 0
    noise: float = 0.5
    perturbation: float = 1.0
    per_image_cameras: bool = False
    model: str = "RADIAL"
    control_sigma: float | None = None
    control: int | None = None
    checks: int = 0
    keep: float = 0.92

    def __post_init__(self) -> None:
        if self.images < 2:
            raise UsageError(f"a block needs at least 2 images, not {self.images}")
        if self.points is not None and self.points < 6:
            raise UsageError(f"a block needs at least 6 object points, not {self.points}")
        for name in ("noise", "perturbation", "control_sigma", "control", "checks"):
            value = getattr(self, name)
            if value is not None and not (value >= 0 and np.isfinite(value)):
                raise UsageError(f"{name} must not be negative, not {value}")
        if not 0.0 < self.keep <= 1.0:
            raise UsageError(f"keep is a share above 0 and up to 1, not {self.keep}")


@dataclass(frozen=True)
class _Scene:
    """True geometry of a block: what is where, and which image sees which point."""

    position: Floats
    rotation: Floats
    points: Floats
    image_of: Ints
    point_of: Ints
    xy: Floats
    size: float  # object units that a start position is uncertain by
    angle: float  # likewise radians
    control: Ints
    control_sigma: float
    unit: str


def synthetic(kind: str = "aerial", images: int = 20, **options: Any) -> Synthetic:
    """Make a block with known truth.

    Parameters
    ----------
    kind : {"aerial", "ring", "long-tracks", "dense"}
        Aerial block of 60/60 overlap; ring of convergent images that all see all points; strip round an area whose points are seen in many
        or all images; images all round whose pairs nearly all share points.
    images : int
        Number of images.
    **options
        The other fields of `Plan`.

    Returns
    -------
    Synthetic

    Raises
    ------
    UsageError
        If the kind or an option is not known or makes no sense.

    Examples
    --------
    >>> block = synthetic("ring", images=6, points=30, seed=1)
    >>> len(block.network.observations[0])
    180
    """
    makers: dict[str, Callable[[Plan, Camera, np.random.Generator], _Scene]] = {
        "aerial": _aerial,
        "ring": _ring,
        "long-tracks": _long_tracks,
        "dense": _dense,
    }
    name = kind.replace("_", "-")
    if name not in makers:
        raise UsageError(f"no kind of block is named {kind!r}; known are {', '.join(makers)}")
    known = set(Plan.__dataclass_fields__)
    for option in options:
        if option not in known:
            raise UsageError(f"unknown option {option!r}; known are {', '.join(sorted(known))}")
    plan = Plan(images=images, **options)
    rng = np.random.default_rng(plan.seed)
    cams = _cameras(plan, rng)
    scene = makers[name](plan, cams[0], rng)
    return _block(name, plan, cams, scene, rng)


def aerial(images: int = 20, **options: Any) -> Synthetic:
    """Make an aerial block: see `synthetic`.

    Examples
    --------
    >>> block = aerial(20)
    >>> len(block.truth.points.labels) > 3000
    True
    """
    return synthetic("aerial", images, **options)


def ring(images: int = 12, **options: Any) -> Synthetic:
    """Make a close-range ring: see `synthetic`.

    Examples
    --------
    >>> len(ring(5, points=20).network.points.labels)
    20
    """
    return synthetic("ring", images, **options)


def long_tracks(images: int = 30, **options: Any) -> Synthetic:
    """Make a strip of long tracks: see `synthetic`.

    Examples
    --------
    >>> len(long_tracks(8, points=20).network.images.labels)
    8
    """
    return synthetic("long-tracks", images, **options)


def dense(images: int = 30, **options: Any) -> Synthetic:
    """Make a block with a dense camera graph: see `synthetic`.

    Examples
    --------
    >>> len(dense(8, points=20).network.images.labels)
    8
    """
    return synthetic("dense", images, **options)


# ---- cameras ----
def _cameras(plan: Plan, rng: np.random.Generator) -> tuple[Camera, ...]:
    """Return the true cameras: distance and radial coefficients are unknowns."""
    model = cameras.model(plan.model)
    corrects = any(s.additional for s in model.measured)
    per = DISTANCE**2 if corrects else 1.0  # coefficients of measured coordinates have powers of the pixel in their unit
    centre = {"principal_point_x": FRAME[0] / 2.0 + 12.0, "principal_point_y": FRAME[1] / 2.0 - 9.0}
    sign = -1.0 if corrects else 1.0
    radial = {"K1": -0.06 * sign / per, "K2": 0.02 * sign / per**2, "k1": -0.06, "k2": 0.02}
    lengths = [n for n in model.order if n.startswith("principal_distance")]
    coefficients = [n for n in model.order if n in radial]
    count = plan.images if plan.per_image_cameras else 1
    varied = 1.0 + 0.002 * rng.standard_normal((count, 1 + len(coefficients))) * (count > 1)
    out = []
    for i in range(count):
        values = {**dict.fromkeys(lengths, DISTANCE * varied[i, 0]), **{n: v for n, v in centre.items() if n in model.order}}
        values |= {n: radial[n] * varied[i, 1 + j] for j, n in enumerate(coefficients)}
        out.append(cameras.create(str(i + 1), model, values, free=[*lengths, *coefficients], image_size=FRAME))
    return tuple(out)


def _seen(camera: Camera, position: Floats, rotation: Floats, points: Floats, image: Ints, point: Ints) -> tuple[NDArray[np.bool_], Floats]:
    """Return which rays fall into the frame, and their pixels, seen by one camera."""
    optics, p = Optics.of(camera), camera.values[None]
    inside, xy = np.zeros(len(image), dtype=bool), np.zeros((len(image), 2))
    half = 0.55 * np.array(FRAME) / DISTANCE
    for a in range(0, len(image), ROWS):
        at = slice(a, a + ROWS)
        ideal, _, front = collinearity.project(collinearity.camera_coordinates(rotation[image[at]], position[image[at]], points[point[at]]))
        near = np.flatnonzero(front & (np.abs(ideal) < half).all(axis=1))
        pixels, _, _, valid = optics.distort(ideal[near], p)
        inside[a + near] = valid & (pixels > 0.0).all(axis=1) & (pixels < FRAME).all(axis=1)
        xy[a + near] = pixels
    return inside, xy


# ---- kinds ----
def _aerial(plan: Plan, camera: Camera, rng: np.random.Generator) -> _Scene:
    """60/60 overlap, tilt 2.5 degrees, relief of 5 % of the height, control about one per nine images."""
    height, density = 1100.0, 1150.0  # metres above ground; points within a footprint, so that an image shows about 1000
    footprint = np.array(FRAME) / DISTANCE * height
    base = 0.4 * footprint
    across = int(np.ceil(np.sqrt(plan.images)))
    strip, along = np.divmod(np.arange(plan.images), across)
    strips = int(strip[-1]) + 1
    position = np.stack([along * base[0], strip * base[1], np.full(plan.images, height)], axis=1)
    position += rng.standard_normal(position.shape) * 0.01 * base[0]
    tilt = np.deg2rad(2.5) * rng.standard_normal((plan.images, 3))
    rotation = rot.from_angles(tilt[:, 0], tilt[:, 1], tilt[:, 2] + np.pi * (strip % 2))

    low, high = -0.5 * footprint, (np.array([across, strips]) - 1) * base + 0.5 * footprint
    area = float(np.prod((high - low) / footprint))
    count = round(density * area) if plan.points is None else 2 * plan.points + 50
    attempts = 8
    for _ in range(attempts):  # with a number of points asked for, more are drawn until enough have three rays
        points = np.empty((count, 3))
        points[:, :2] = rng.uniform(low, high, (count, 2))
        cell = np.round(points[:, :2] / base).astype(np.intp)
        points = points[np.lexsort((cell[:, 0], cell[:, 1]))]  # neighbours have neighbouring numbers
        points[:, 2] = _relief(points[:, :2], 0.05 * height, footprint[0], rng)
        image, point = _candidates(points, position, base, footprint, across, strips, plan.images)
        inside, xy = _seen(camera, position, rotation, points, image, point)
        inside &= rng.random(len(inside)) < plan.keep
        image, point, xy = image[inside], point[inside], xy[inside]
        rays = np.bincount(point, minlength=len(points))
        enough = rays >= 3
        if plan.points is None or enough.sum() >= plan.points:
            break
        count *= 2
    if plan.points is not None:
        enough[rng.permutation(np.flatnonzero(enough))[plan.points :]] = False
    if enough.sum() < 6:
        raise UsageError(f"{plan.images} images in this arrangement see too few points three times; take more images or points")
    kept = enough[point]
    number = np.cumsum(enough) - 1
    points, image, point, xy = points[enough], image[kept], number[point[kept]], xy[kept]
    wide, deep = max(3, round(across / 3)), max(2, round(strips / 3))
    wanted = wide * deep if plan.control is None else plan.control
    inner_low, inner_high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    x, y = np.meshgrid(np.linspace(0.05, 0.95, wide), np.linspace(0.05, 0.95, deep))
    grid = inner_low + (inner_high - inner_low) * np.stack([x.ravel(), y.ravel()], axis=1)
    if wanted != len(grid):
        grid = inner_low + (inner_high - inner_low) * rng.uniform(0.05, 0.95, (wanted, 2))
    sigma = 0.02 if plan.control_sigma is None else plan.control_sigma
    return _Scene(position, rotation, points, image, point, xy, 2.0, 0.004, _nearest(points[:, :2], grid), sigma, "m")


def _relief(xy: Floats, amplitude: float, width: float, rng: np.random.Generator) -> Floats:
    """Return hills of a few wavelengths and rough ground."""
    out = 0.1 * amplitude * rng.standard_normal(len(xy))
    for wavelength, share in ((2.3, 0.6), (0.9, 0.3), (0.31, 0.1)):
        direction, phase = rng.uniform(0.0, np.pi), rng.uniform(0.0, 2.0 * np.pi, 2)
        turned = xy @ np.array([[np.cos(direction), -np.sin(direction)], [np.sin(direction), np.cos(direction)]])
        angle = 2.0 * np.pi / (wavelength * width) * turned + phase
        out += share * amplitude * np.sin(angle[:, 0]) * np.cos(angle[:, 1])
    return np.asarray(out)


def _candidates(
    points: Floats, position: Floats, base: Floats, footprint: Floats, across: int, strips: int, images: int
) -> tuple[Ints, Ints]:
    """Return image and point of the rays that may fall into a frame: image centres within 0.72 of a footprint."""
    cell = np.round(points[:, :2] / base).astype(np.intp)
    image, point = [], []
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            i, j = cell[:, 0] + dx, cell[:, 1] + dy
            k = j * across + i
            at = np.flatnonzero((i >= 0) & (i < across) & (j >= 0) & (j < strips) & (k < images))
            near = (np.abs(points[at, :2] - position[k[at], :2]) < 0.72 * footprint).all(axis=1)
            image.append(k[at[near]])
            point.append(at[near])
    every, which = np.concatenate(point), np.concatenate(image)
    order = np.lexsort((which, every))
    return which[order], every[order]


def _nearest(places: Floats, wanted: Floats) -> Ints:
    """Return the different places nearest to the wanted ones."""
    from scipy.spatial import cKDTree

    if len(wanted) > len(places):
        raise UsageError(f"{len(wanted)} control or check points are asked for, but there are only {len(places)} object points")
    if not len(wanted):
        return np.zeros(0, dtype=np.intp)
    taken: dict[int, None] = {}
    tree = cKDTree(places)
    for w in wanted:
        k = 1
        while True:
            found = np.atleast_1d(tree.query(w, k=min(k, len(places)))[1])
            free = [int(i) for i in found if int(i) not in taken]
            if free:
                taken[free[0]] = None
                break
            k *= 2
    return np.array(list(taken), dtype=np.intp)


def _looking_at(position: Floats, target: Floats) -> Floats:
    """Return M of cameras that look at a target with a level x axis."""
    z = position - target
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(np.array([0.0, 0.0, 1.0]), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _convergent(plan: Plan, camera: Camera, rng: np.random.Generator, position: Floats, sees: Callable[[int], Any], count: int) -> _Scene:
    """A cloud of points within 2 units of the origin; `sees` says which image sees which point, before the frame decides."""
    rotation = _looking_at(position, np.zeros(3))
    roll = np.zeros((plan.images, 3))
    roll[:, 2] = np.pi / 2 * (np.arange(plan.images) % 4)  # without turned images the distance is hardly separable
    rotation = rot.exp(roll) @ rotation
    points = rng.uniform(-1.0, 1.0, (count, 3))
    points *= 2.0 / np.maximum(1.0, np.linalg.norm(points, axis=1))[:, None]
    point, image = np.nonzero(sees(count))
    inside, xy = _seen(camera, position, rotation, points, image, point)
    image, point, xy = image[inside], point[inside], xy[inside]
    if np.bincount(point, minlength=count).min() < 3:
        raise UsageError(f"{plan.images} images are too few: a point is seen by fewer than 3 of them")
    wanted = 6 if plan.control is None else plan.control
    spread = rng.uniform(-1.5, 1.5, (wanted, 3))
    sigma = 0.0005 if plan.control_sigma is None else plan.control_sigma
    return _Scene(position, rotation, points, image, point, xy, 0.02, 0.004, _nearest(points, spread), sigma, "m")


def _ring(plan: Plan, camera: Camera, rng: np.random.Generator) -> _Scene:
    """Images all round at changing heights; every image sees all points."""
    count = 100 if plan.points is None else plan.points
    angle = 2.0 * np.pi * np.arange(plan.images) / plan.images
    position = np.stack([8.0 * np.cos(angle), 8.0 * np.sin(angle), 2.5 + 2.0 * np.cos(3.0 * angle)], axis=1)
    return _convergent(plan, camera, rng, position, lambda n: np.ones((n, plan.images), dtype=bool), count)


def _long_tracks(plan: Plan, camera: Camera, rng: np.random.Generator) -> _Scene:
    """A strip on an arc of 120 degrees: a quarter of the points is in all images, the others in a part of at least three in a row."""
    count = 60 * plan.images if plan.points is None else plan.points
    angle = np.deg2rad(np.linspace(-60.0, 60.0, plan.images))
    position = np.stack([8.0 * np.cos(angle), 8.0 * np.sin(angle), 2.5 + 1.0 * np.cos(5.0 * angle)], axis=1)
    length = rng.integers(min(3, plan.images), plan.images + 1, count)
    length[rng.random(count) < 0.25] = plan.images
    first = np.floor(rng.random(count) * (plan.images - length + 1)).astype(np.intp)
    number = np.arange(plan.images)
    sees = (number >= first[:, None]) & (number < (first + length)[:, None])
    return _convergent(plan, camera, rng, position, lambda n: sees, count)


def _dense(plan: Plan, camera: Camera, rng: np.random.Generator) -> _Scene:
    """Images all round; each point is in a handful of them drawn at random, so that nearly every pair of images shares points."""
    count = 60 * plan.images if plan.points is None else plan.points
    angle, height = rng.uniform(0.0, 2.0 * np.pi, plan.images), rng.uniform(0.1, 0.8, plan.images)
    flat = np.sqrt(1.0 - height**2)
    radius = rng.uniform(7.5, 10.0, plan.images)[:, None]
    position = radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)
    rays = np.minimum(3 + rng.geometric(0.25, count), plan.images)

    def sees(n: int) -> Any:
        if plan.images * n > 5e7:
            raise UsageError(f"{plan.images} images and {n} points are more than this kind is made for")
        order = rng.random((n, plan.images)).argsort(axis=1).argsort(axis=1)
        return order < rays[:, None]

    return _convergent(plan, camera, rng, position, sees, count)


# ---- the block ----
def _block(kind: str, plan: Plan, cams: tuple[Camera, ...], scene: _Scene, rng: np.random.Generator) -> Synthetic:
    """Put tables, errors and start values together."""
    n, m = len(scene.position), len(scene.points)
    camera = np.arange(n) if plan.per_image_cameras else np.zeros(n, dtype=np.intp)
    xy = _own_pixels(cams, camera, scene) if plan.per_image_cameras else scene.xy
    sigma = plan.noise if plan.noise > 0.0 else 0.5
    width, digits = len(str(n - 1)), len(str(m - 1))
    images = Images.make([f"I{i:0{width}}" for i in range(n)], camera, scene.position, scene.rotation)
    points = _points(plan, scene, [f"P{i:0{digits}}" for i in range(m)], rng)
    rays = ImagePoints.make(scene.image_of, scene.point_of, xy, sigma)
    groups: tuple[Any, ...] = (rays,)
    if kind == "ring" and plan.control == 0:
        groups = (rays, _scale_bars(scene.points))
    truth = Network(cams, images, points, groups, unit=scene.unit, name=f"{kind} {n}")

    observed = [replace(rays, xy=xy + plan.noise * rng.standard_normal(xy.shape))]
    bars = [replace(g, values=g.values + g.sigmas * (plan.noise > 0.0) * rng.standard_normal(len(g))) for g in groups[1:]]
    p = plan.perturbation
    held = (points.states == FIXED) & (points.roles == CONTROL)[:, None]
    begin = np.where(held, scene.points, scene.points + p * scene.size * rng.standard_normal((m, 3)))
    drawn = scene.points + points.sigmas * (plan.noise > 0.0) * rng.standard_normal((m, 3))
    given = np.where(np.isfinite(points.sigmas) & (points.roles == CONTROL)[:, None], drawn, points.given)
    network = replace(
        truth,
        cameras=tuple(_begun(c, p, rng) for c in cams),
        images=replace(
            images,
            position=scene.position + p * scene.size * rng.standard_normal((n, 3)),
            rotation=rot.exp(p * scene.angle * rng.standard_normal((n, 3))) @ scene.rotation,
        ),
        points=replace(points, coordinates=begin, given=given),
        observations=(*observed, *bars),
    )
    return Synthetic(network, truth)


def _own_pixels(cams: tuple[Camera, ...], camera: Ints, scene: _Scene) -> Floats:
    """Return the pixels of all rays, each by the camera of its image; a little outside the frame is no harm."""
    optics, values = Optics.of(cams[0]), np.stack([c.values for c in cams])
    out = np.empty_like(scene.xy)
    for a in range(0, len(out), ROWS):
        at = slice(a, a + ROWS)
        image = scene.image_of[at]
        vectors = collinearity.camera_coordinates(scene.rotation[image], scene.position[image], scene.points[scene.point_of[at]])
        out[at] = optics.distort(collinearity.project(vectors)[0], values[camera[image]], start=scene.xy[at])[0]
    return out


def _points(plan: Plan, scene: _Scene, labels: list[str], rng: np.random.Generator) -> Points:
    """Return the true points with roles."""
    m = len(labels)
    roles, states = np.zeros(m, dtype=np.int8), np.full((m, 3), FREE, dtype=np.int8)
    given, sigmas = np.full((m, 3), np.nan), np.full((m, 3), np.nan)
    at = scene.control
    roles[at], given[at] = CONTROL, scene.points[at]
    if scene.control_sigma > 0.0:
        states[at], sigmas[at] = OBSERVED, scene.control_sigma
    else:
        states[at] = FIXED
    left = np.flatnonzero(roles == 0)
    if plan.checks > len(left):
        raise UsageError(f"{plan.checks} check points are asked for, but only {len(left)} points are not control points")
    check = np.sort(rng.choice(left, plan.checks, replace=False))
    roles[check], given[check], sigmas[check] = CHECK, scene.points[check], 0.0
    return Points.make(labels, scene.points, roles, states, given, sigmas)


def _scale_bars(points: Floats) -> Distances:
    """Return three distances of 0.1 mm between far points, which give a free ring its scale."""
    order = np.argsort(points[:, 0])
    starts, ends = order[:3], order[-3:]
    length = np.linalg.norm(points[ends] - points[starts], axis=1)
    return Distances(starts, ends, length, np.full(3, 1e-4))


def _begun(camera: Camera, p: float, rng: np.random.Generator) -> Camera:
    """Return a camera with start values: the distance off by some 0.3 %, coefficients by some 30 %."""
    share = np.where([name.startswith("principal_distance") for name in camera.model.order], 0.003, 0.3)
    factor = 1.0 + p * share * rng.standard_normal(len(camera.values))
    return replace(camera, values=np.where(camera.states == FREE, camera.values * factor, camera.values))
