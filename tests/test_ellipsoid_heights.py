"""Points that one spaceborne radar track sees, with heights above the ellipsoid: intersection, adjustment, files, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from baarda import adjust
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import Singular, UsageError
from baarda.formats.project import project
from baarda.geometry import range_doppler as radar
from baarda.geometry.ellipsoid_height import ellipsoid_height
from baarda.geometry.tangent_frame import geocentric
from baarda.network import CONTROL, TIE, Images, Network, Points, State
from baarda.observations import EllipsoidHeights, RangeDoppler, tracks


def test_heights_and_normals():
    rng = np.random.default_rng(1)
    lla = np.stack([rng.uniform(-90, 90, 50), rng.uniform(-180, 180, 50), rng.uniform(-100, 9e5, 50)], axis=1)
    lla[:2, 0] = [90.0, -90.0]
    x = geocentric(lla)
    h, normal = ellipsoid_height(x)
    assert h == pytest.approx(lla[:, 2], abs=5e-9)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0, abs=1e-15)
    for k in range(3):
        step = 10.0 * np.eye(3)[k]
        numeric = (ellipsoid_height(x + step)[0] - ellipsoid_height(x - step)[0]) / 20.0
        assert normal[:, k] == pytest.approx(numeric, abs=1e-8)
    with pytest.raises(UsageError, match="geocentric coordinates in metres"):
        ellipsoid_height([[10.0, 20.0, 30.0]])


def orbits(n, seed):
    """Antennas anywhere above the Earth, descending or climbing a little, and points left or right of them."""
    rng = np.random.default_rng(seed)
    position = geocentric(np.stack([rng.uniform(-85, 85, n), rng.uniform(-180, 180, n), rng.uniform(5e5, 9e5, n)], axis=1))
    up = position / np.linalg.norm(position, axis=1)[:, None]
    velocity = rng.standard_normal((n, 3))
    velocity -= 0.98 * np.sum(velocity * up, axis=1)[:, None] * up
    velocity *= 7500.0 / np.linalg.norm(velocity, axis=1)[:, None]
    across = np.cross(up, velocity)
    left = rng.choice([1, -1], n)
    points = position + (rng.uniform(1.5e5, 6e5, n) * left / np.linalg.norm(across, axis=1))[:, None] * across + 2.0 * velocity
    height = rng.uniform(-50.0, 3000.0, n)
    for _ in range(6):
        found, normal = ellipsoid_height(points)
        points -= (found - height)[:, None] * normal
    return position, velocity, points, height, left


def test_intersection_inverts_range_and_doppler():
    position, velocity, points, height, left = orbits(200, 3)
    d = points - position
    distance = np.linalg.norm(d, axis=1)
    squint = np.arcsin(np.sum(velocity * d, axis=1) / np.linalg.norm(velocity, axis=1) / distance)
    two = radar.intersect_ellipsoid(position, velocity, squint, distance, height)
    mine = two[np.arange(200), np.where(left > 0, 0, 1)]
    assert np.abs(mine - points).max() < 1e-8  # coordinates of 6e6 m carry 1e-9
    other = two[np.arange(200), np.where(left > 0, 1, 0)] - position  # has the same range, squint and height
    assert np.linalg.norm(other, axis=1) == pytest.approx(distance, abs=1e-8)
    assert np.sum(velocity * other, axis=1) / np.linalg.norm(velocity, axis=1) == pytest.approx(distance * np.sin(squint), abs=1e-7)
    assert ellipsoid_height(other + position)[0] == pytest.approx(height, abs=1e-8)
    assert np.isnan(radar.intersect_ellipsoid([[7e6, 0, 0]], [[0, 0, 7000.0]], [0.0], [3e5], [0.0])).all()


NOISE = np.array([2e-4, 0.5])


def block(seed=3, side=1, ties=12, weighted=True, start=True):
    """A satellite in a circular orbit over control, and points of known ellipsoid height that only it sees."""
    rng = np.random.default_rng(seed)
    orbit, rate, controls = 7_171_000.0, 1.04e-3, 25
    t = np.linspace(-8.0, 8.0, 9)
    flown = orbit * np.stack([np.cos(rate * t), np.zeros(9), np.sin(rate * t)], axis=1)
    c = np.stack([np.polynomial.polynomial.polyfit(t, flown[:, k], 4) for k in range(3)])[None]
    true = tracks(["orbit"], c, [[0.0]], 12.5, 820_000.0, side=side)
    n = controls + ties
    along, across = rng.uniform(-0.35, 0.35, n), rng.uniform(2.0, 2.9, n)  # degrees
    height = rng.uniform(0.0, 2000.0, n)
    x = geocentric(np.stack([along, -side * across if side else across, height], axis=1))
    s, r = radar.project(x, *true.arrays(np.zeros(n, dtype=int), true.layouts[0]), np.zeros(n))
    measured = np.stack([s, r], axis=1) + NOISE * rng.standard_normal((n, 2))
    seen = RangeDoppler(np.zeros(n, dtype=int), np.arange(n), measured, np.tile(NOISE, (n, 1)))
    sigma = 0.3
    heights = EllipsoidHeights(np.arange(controls, n), height[controls:] + sigma * rng.standard_normal(ties), np.full(ties, sigma))
    known = np.arange(n) < controls
    states = np.where(known[:, None], OBSERVED if weighted else FIXED, FREE) * np.ones((1, 3), dtype=int)
    given = np.where(known[:, None], x + (2.0 * rng.standard_normal(x.shape) if weighted else 0.0), np.nan)
    deviation = np.where(known[:, None] & weighted, 2.0, np.nan)
    labels = [f"{'C' if k else 'T'}{i}" for i, k in enumerate(known)]
    points = Points.make(labels, given, np.where(known, CONTROL, TIE), states, given, deviation * np.ones((1, 3)))
    values, group_states, sigmas = np.array(true.values), np.array(true.states), np.full(len(true.values), np.nan)
    for axis in "XYZ":
        for k, prior in ((0, 50.0), (1, 0.05)):
            at = true.named(0, f"{axis}{k}")
            values[at] += prior * rng.standard_normal()
            group_states[at], sigmas[at] = OBSERVED, prior
        for k in (2, 3, 4):
            group_states[true.named(0, f"{axis}{k}")] = FIXED
    group_states[[true.named(0, "squint0"), true.named(0, "pixel_spacing")]] = FIXED
    flight = replace(true, values=values, states=group_states, given=values, sigmas=sigmas)
    network = Network((), Images.make(()), points, (seen, heights), declared=(flight,), settings={"min_rays": 0})
    return network, x, true


@pytest.fixture(scope="module", params=[1, -1], ids=["left", "right"])
def made(request):
    return block(side=request.param)


def test_points_of_one_track(made):
    """Each point has two radar coordinates and a height: three observations for three unknowns, and the truth within its sigmas."""
    network, x, _ = made
    a = adjust(network)
    assert a.status == "converged"
    assert a.redundancy == 2 * 25  # the points of given height add as many unknowns as observations
    tie = np.flatnonzero(network.points.roles == TIE)
    e = (a.network.points.coordinates - x)[tie]
    q = a.point_cofactors[tie]
    chi = np.einsum("ni,nij,nj->n", e, np.linalg.inv(q), e)
    assert 0.5 < chi.mean() / 3.0 < 2.2
    assert 0.001 < stats.chi2.cdf(a.objective, a.redundancy) < 0.999
    h, normal = ellipsoid_height(a.network.points.coordinates[tie])
    assert h == pytest.approx(network.observations[1].values, abs=1e-6)
    # along the normal the sigma is that of the given height
    assert np.sqrt(np.einsum("ni,nij,nj->n", normal, q, normal)) == pytest.approx(0.3, rel=1e-6)


def test_partials_and_offset(made):
    """A network whose coordinates were shifted gives the same heights."""
    network, x, _ = made
    full = replace(network, points=replace(network.points, coordinates=x))
    moved = full.shifted(np.array([-6e6, 3e5, 1e5]))
    group = network.observations[1]
    assert group.misclosures(moved, State.of(moved)) == pytest.approx(group.misclosures(full, State.of(full)), abs=5e-9)
    rows = group.linearize(moved, State.of(moved))[0]
    for k in range(3):
        ahead, back = (
            group.misclosures(moved, replace(State.of(moved), points=moved.points.coordinates + sign * 10.0 * np.eye(3)[k]))
            for sign in (1.0, -1.0)
        )
        assert rows.blocks[0].jacobian[:, 0, k] == pytest.approx(-(ahead - back)[:, 0] / 20.0, abs=1e-8)


def test_start_from_control_alone(made):
    """Without any flight data: a straight flight over the tangential plane is near enough where orbit curvature is given."""
    network, _, true = made
    group = network.declared[0]
    values, states = np.array(group.values), np.array(group.states)
    for axis in "XYZ":
        for k in (0, 1):
            at = group.named(0, f"{axis}{k}")
            values[at], states[at] = np.nan, FREE
    bare = replace(group, values=values, states=states, given=np.full(len(values), np.nan), sigmas=np.full(len(values), np.nan))
    a = adjust(replace(network, declared=(bare,)))
    assert a.status == "converged"
    at = [group.named(0, f"{axis}0") for axis in "XYZ"]
    assert np.linalg.norm(a.network.declared[0].values[at] - true.values[at]) < 3000.0


def test_project_files(made, tmp_path):
    network, _, _ = made
    project.write(network, tmp_path / "p")
    table = (tmp_path / "p" / "ellipsoid_heights.csv").read_text().splitlines()
    assert table[0] == "point,value,sigma"
    assert adjust(project.read(tmp_path / "p")).objective == adjust(network).objective


def test_left_or_right_is_told_not_guessed():
    network, _, _ = block(side=1)
    tie = np.flatnonzero(network.points.roles == TIE)
    group = network.declared[0]
    at = group.named(0, "side")
    for side in (0.0, -1.0):
        values = np.array(group.values)
        values[at] = side
        told = replace(network, declared=(replace(group, values=values),))
        if side:
            with pytest.raises(UsageError, match="lies left of track orbit, which looks right"):
                adjust(told)
        else:  # control shows it
            assert adjust(told).objective == pytest.approx(adjust(network).objective, rel=1e-9)
            roles = np.zeros(len(network.points.labels), dtype=int)
            blind = told.observations[0].selected(np.isin(told.observations[0].points, tie))
            with pytest.raises(Singular, match=r"point T25: .* have the same ranges; say on which side"):
                adjust(replace(told, points=replace(network.points, roles=roles), observations=(blind, told.observations[1])))
    some = network.observations[1].selected(np.arange(1, 12))
    with pytest.raises(Singular, match="point T25 is seen by one track only and has no given height"):
        adjust(replace(network, observations=(network.observations[0], some)))
