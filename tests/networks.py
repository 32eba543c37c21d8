"""Small networks with known truth."""

from dataclasses import replace

import numpy as np

from baarda import cameras
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.geometry import rotation as rot
from baarda.network import CHECK, CONTROL, Images, Network, Points
from baarda.observations import Distances, ImagePoints

BROWN = {
    "principal_distance": 1000.0,
    "principal_point_x": 505.0,
    "principal_point_y": 396.0,
    "K1": 3e-8,
    "P1": 2e-7,
}
FREE_BROWN = ("principal_distance", "principal_point_x", "principal_point_y", "K1")


def looking_at(position, target):
    """Return M of a camera at `position` that looks at `target` with its x axis horizontal."""
    z = position - target
    z = z / np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.99 else [0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def ring(
    images=6,
    points=24,
    noise=0.3,
    seed=0,
    control=0,
    checks=0,
    free=FREE_BROWN,
    model="brown",
    values=None,
    per_image=False,
    control_sigma=0.01,
    fixed_control=False,
    origin=(0.0, 0.0, 0.0),
    correlation=0.0,
    keep=1.0,
    start=True,
):
    """Cameras on a ring around a cloud of points; start values are the truth, disturbed a little."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-2.0, 2.0, (points, 3)) * [1.0, 1.0, 0.6]
    angle = 2 * np.pi * np.arange(images) / images
    position = np.stack([6 * np.cos(angle), 6 * np.sin(angle), 2.0 + 1.5 * np.cos(3 * angle)], axis=1)
    rotation = np.stack([looking_at(p, np.zeros(3)) for p in position])
    rotation = rot.exp(np.stack([np.zeros(images), np.zeros(images), (np.pi / 2) * (np.arange(images) % 4)], axis=1)) @ rotation
    chosen = BROWN if values is None else values
    count = images if per_image else 1
    cams = tuple(cameras.create(str(i + 1), cameras.model(model), chosen, free=free, image_size=(1000.0, 800.0)) for i in range(count))
    camera = np.arange(images) if per_image else np.zeros(images, dtype=int)
    i, j = np.meshgrid(np.arange(images), np.arange(points), indexing="ij")
    used = rng.random(i.shape) < keep
    i, j = i[used], j[used]
    network = Network(
        cams,
        Images.make([f"I{k}" for k in range(images)], cameras=camera, position=position, rotation=rotation),
        Points.make([f"P{k}" for k in range(points)], truth),
        (ImagePoints.make(i, j, np.zeros((len(i), 2)), max(noise, 0.1), np.full(len(i), correlation)),),
    )
    group = network.observations[0]
    xy = -group.misclosures(network, _state(network))
    s = group.sigmas
    e = rng.standard_normal((len(i), 2))
    e[:, 1] = correlation * e[:, 0] + np.sqrt(1 - correlation**2) * e[:, 1]
    group = replace(group, xy=xy + (e * s if noise else 0.0))

    shift = np.asarray(origin, dtype=float)
    roles, states = np.zeros(points, dtype=np.int8), np.full((points, 3), FREE, dtype=np.int8)
    given, sigmas = np.full((points, 3), np.nan), np.full((points, 3), np.nan)
    roles[:control] = CONTROL
    given[:control] = truth[:control]
    if fixed_control:
        states[:control] = FIXED
    else:
        states[:control] = OBSERVED
        sigmas[:control] = control_sigma
        given[:control] += control_sigma * rng.standard_normal((control, 3))
    last = slice(control, control + checks)
    roles[last], given[last], sigmas[last] = CHECK, truth[last], 0.0
    begin = truth + 0.01 * rng.standard_normal(truth.shape)
    if fixed_control:
        begin[:control] = truth[:control]
    table = Points.make(network.points.labels, begin if start else np.where(states == FIXED, truth, np.nan), roles, states, given, sigmas)
    if not start and control:
        table = replace(table, coordinates=np.where(np.isfinite(given) & (roles == CONTROL)[:, None], given, np.nan))
    disturbed = replace(
        network.images,
        position=position + 0.02 * rng.standard_normal(position.shape),
        rotation=rot.exp(0.003 * rng.standard_normal((images, 3))) @ rotation,
    )
    made = replace(
        network,
        images=disturbed if start else Images.make(network.images.labels, cameras=camera),
        points=table,
        observations=(group,),
    )
    return replace(made.shifted(shift), offset=np.zeros(3)) if shift.any() else made


def with_distances(network, pairs, sigma=0.001):
    """Add error-free distances between pairs of points, computed from the start coordinates."""
    a, b = np.array(pairs).T
    x = network.points.coordinates
    length = np.linalg.norm(x[a] - x[b], axis=1)
    group = Distances(a, b, length, np.full(len(a), sigma))
    return replace(network, observations=(*network.observations, group))


def _state(network):
    from baarda.network import State

    return State.of(network)


def control_table(source, target):
    """Write one of DBAT's coordinate tables (id, name, X, Y, Z[, sX, sY, sZ]) as a control table; return its path."""
    lines = [line.split(",") for line in source.read_text().splitlines() if line.strip() and not line.startswith("#")]
    names = ["point", "X", "Y", "Z"] + (["sigma_X", "sigma_Y", "sigma_Z"] if len(lines[0]) == 8 else [])
    rows = [",".join(names)] + [",".join([t[0].strip(), *(v.strip() for v in t[2:])]) for t in lines]
    target.write_text("\n".join(rows) + "\n")
    return target
