"""Radar: equations, intersection, start values, adjustment of simulated images with known truth, project files, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

import baarda
from baarda import adjust
from baarda.adjustment.datum import Defect
from baarda.adjustment.solve import Settings, choose_datum
from baarda.cameras import FIXED, OBSERVED
from baarda.errors import InputError, RedundancyNotPositive, Singular, UsageError
from baarda.formats.project import project
from baarda.geometry import range_doppler as radar
from baarda.hypotheses.levels import Options
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import RangeDoppler, tracks
from baarda.procedures.camera_selection import select_parameters
from baarda.procedures.cross_validation import cross_validate
from baarda.procedures.radar_simulation import PIXEL, SPEED, planimetry, simulate_radar
from baarda.procedures.snooping import snoop


def some(n=6, seed=1, order=3, turns=2):
    rng = np.random.default_rng(seed)
    c = rng.standard_normal((n, 3, order + 1)) * 10.0 ** -np.arange(order + 1)
    c[:, 1, 1] += 120.0
    c[:, 2, 0] += 7000.0
    points = rng.uniform([4000, -3000, 0], [12000, 3000, 200], (n, 3))
    squint = rng.standard_normal((n, turns + 1)) * [0.05, 1e-3, 1e-5][: turns + 1]
    return points, c, squint, np.full(n, 4.0), np.full(n, 1000.0), rng.uniform(-20, 20, n), rng.uniform(500, 2000, n)


def test_partials_against_complex_step():
    arguments = some()
    p = radar.partials(*arguments)

    def step(k, shape_of=None):
        a = arguments[k]
        h = 1e-30
        out = []
        for index in np.ndindex(a.shape[1:]):
            moved = [x.astype(complex) for x in arguments]
            moved[k][(slice(None), *index)] += 1j * h
            out.append(np.imag(radar.conditions(*moved)) / h)
        return np.stack(out, axis=2).reshape(len(a), 2, *a.shape[1:])

    s, r = step(5), step(6)
    for found, wanted in (
        (p.observed, np.stack([s, r], axis=2)),
        (p.points, step(0)),
        (p.coefficients, step(1)),
        (p.squint, step(2)),
        (p.spacing, step(3)),
        (p.delay, step(4)),
    ):
        assert found == pytest.approx(wanted, rel=1e-11, abs=1e-10)


def test_projection_is_the_root_of_the_doppler_equation():
    points, c, squint, spacing, delay, _, _ = some(8, 3)
    s, r = radar.project(points, c, squint, spacing, delay, np.zeros(8))
    for i in range(8):
        one = tuple(a[i : i + 1] for a in (points, c, squint, spacing, delay))
        root = optimize.brentq(lambda t, one=one: radar.conditions(*one, np.array([t]), np.zeros(1))[0, 1], -60.0, 60.0, xtol=1e-13)
        assert s[i] == pytest.approx(root, abs=1e-11)
    assert np.abs(radar.conditions(points, c, squint, spacing, delay, s, r)).max() < 1e-8


@pytest.mark.parametrize("side", ["left", "right"])
def test_intersection_inverts_projection(side):
    """Projection and space intersection with given height, and from two tracks, come back to 1e-9 m."""
    points, c, squint, spacing, delay, _, _ = some(12, 5)
    points = points * ([-1, 1, 1] if side == "left" else [1, 1, 1])
    s, r = radar.project(points, c, squint, spacing, delay, np.zeros(12))
    a = radar.antenna(c, s)
    angle = np.sum(squint * radar.powers(s, 2), axis=1)
    two = radar.intersect_height(a.position, a.velocity, angle, spacing * r + delay, points[:, 2])
    assert np.abs(two[:, 0 if side == "left" else 1] - points).max() < 1e-9
    other = two[:, 1 if side == "left" else 0]  # the mirror image has the same coordinates
    again = radar.project(other, c, squint, spacing, delay, s)
    assert again[0] == pytest.approx(s, abs=1e-10)
    assert again[1] == pytest.approx(r, abs=1e-8)
    second = c.copy()
    second[:, 0, 0] += 5000.0
    s2, r2 = radar.project(points, second, squint, spacing, delay, np.zeros(12))
    b = radar.antenna(second, s2)
    angle2 = np.sum(squint * radar.powers(s2, 2), axis=1)
    for i in range(12):
        x = radar.intersect_ranges(
            np.stack([a.position[i], b.position[i]]),
            np.stack([a.velocity[i], b.velocity[i]]),
            np.array([angle[i], angle2[i]]),
            np.array([spacing[i] * r[i] + delay[i], spacing[i] * r2[i] + delay[i]]),
            points[i] + [100.0, -50.0, -80.0],
        )
        assert np.abs(x - points[i]).max() < 1e-9


def test_a_circle_that_does_not_reach_the_plane():
    assert np.isnan(radar.intersect_height([[0, 0, 3000]], [[0, 100, 0]], [0.0], [2000.0], [0.0])).all()


def test_one_flight_twice_determines_nothing():
    p, v = np.tile([0.0, 0.0, 3000.0], (2, 1)), np.tile([0.0, 100.0, 0.0], (2, 1))
    with pytest.raises(Singular, match="do not determine"):
        radar.intersect_ranges(p, v, np.zeros(2), np.full(2, 5000.0), np.array([4000.0, 0.0, 10.0]))


@pytest.mark.parametrize("direction", [0.0, 1.0, 2.5, np.pi, 4.0])
@pytest.mark.parametrize("side", [1, -1])
def test_flight_from_control(direction, side):
    """Straight flights in any direction, looking to either side, from control points alone."""
    made = simulate_radar(1, noise=(1e-9, 1e-9), directions=(direction,), sides=(side,), order=1)
    o = made.network.observations[0]
    found = radar.flight_from_control(made.truth.points.coordinates, o.tr[:, 0], o.tr[:, 1], 8700.0)
    true = made.tracks.arrays(np.array([0]), made.tracks.layouts[0])[0][0]
    assert found.side == ("left" if side > 0 else "right")
    assert found.position == pytest.approx(true[:, 0], abs=60.0)  # low relief bends the straight-line time a little
    assert found.velocity == pytest.approx(true[:, 1], abs=3.0)
    assert found.spacing == pytest.approx(PIXEL, rel=5e-3)


def test_control_that_does_not_determine_a_flight():
    rng = np.random.default_rng(2)
    y = np.linspace(0.0, 5000.0, 9)
    along = np.stack([np.full(9, 4000.0), y, rng.uniform(0, 100, 9)], axis=1)
    with pytest.raises(Singular, match="one line"):
        radar.flight_from_control(along, y / 100.0, np.full(9, 1000.0))
    with pytest.raises(UsageError, match="at least 5"):
        radar.flight_from_control(along[:4], y[:4], y[:4])
    plane = rng.uniform(0, 5000, (9, 3))
    with pytest.raises(Singular, match="does not grow"):
        radar.flight_from_control(plane, np.full(9, 3.0), plane[:, 0])


@pytest.fixture(scope="module")
def made():
    return simulate_radar(1993)


@pytest.fixture(scope="module")
def adjusted(made):
    return adjust(made.network)


def normalised(a, truth):
    """Errors of the unknown track parameters, and their joint cofactors."""
    t = a.unknowns
    names = [n for n in t["name"] if n.startswith("track")]
    values = dict(zip(t["name"], t["value"], strict=True))
    group = truth.declared[0]
    true = {
        f"track {label}: {name}": group.values[int(group.offsets[i]) + k]
        for i, label in enumerate(group.labels)
        for k, name in enumerate(group.parameters_of(i))
    }
    e = np.array([values[n] - true[n] for n in names])
    return e, a.covariance(names, sigma="apriori")


def test_yangmei(made, adjusted):
    """17 unknowns as in the paper; the truth lies within what the covariance predicts."""
    a = adjusted
    assert a.status == "converged"
    assert a.numbering.count == 17
    assert a.count == 70
    assert a.redundancy == 53
    assert a.redundancy_numbers.sum() == pytest.approx(53, rel=1e-9)
    assert stats.chi2.cdf(a.objective, 53) < 0.999
    e, c = normalised(a, made.truth)
    assert 0.0005 < stats.chi2.cdf(e @ np.linalg.solve(c, e), 17) < 0.9995
    assert set(a.unknowns["unit"]) >= {"rad", "m/px", "m", "m/s^4"}


def test_start_from_flight_data_and_from_control_agree(made, adjusted):
    flown = made.tracks.values.copy()
    rough = made.network.declared[0]
    flown[[rough.named(0, n) for n in ("X2", "X3", "X4", "Y2", "Y3", "Y4", "Z2")]] = 0.0
    flown[rough.named(0, "X0")] += 200.0
    flown[rough.named(0, "Z0")] -= 100.0
    flown[rough.named(0, "pixel_spacing")] = 4.0
    b = adjust(replace(made.network, declared=(replace(rough, values=flown),)))
    assert b.objective == pytest.approx(adjusted.objective, rel=1e-9)
    assert np.abs(b.unknowns["value"] - adjusted.unknowns["value"]) / b.unknowns["sigma"] == pytest.approx(0.0, abs=1e-4)


def test_dense_and_block_agree():
    network = simulate_radar(
        4, order=2, directions=(np.pi, np.pi), sides=(1, -1), ties=6, control_sigma=1.0, deviations=np.zeros((3, 3))
    ).network
    dense, block = adjust(network, solver="dense"), adjust(network, solver="block")
    assert block.redundancy_numbers == pytest.approx(dense.redundancy_numbers, abs=1e-8)
    assert block.unknowns["sigma"] == pytest.approx(dense.unknowns["sigma"], rel=1e-6)


@pytest.mark.parametrize("sides", [(1, 1), (1, -1)], ids=["same side", "both sides"])
def test_stereo(sides):
    """Two tracks: points without known coordinates are intersected, within their predicted sigmas."""
    made = simulate_radar(
        8, order=2, sides=sides, directions=(np.pi, np.pi + (0.3 if sides[1] == 1 else 0.0)), ties=10, deviations=np.zeros((3, 3))
    )
    a = adjust(made.network)
    assert a.status == "converged"
    tie = np.flatnonzero(a.network.points.roles != CONTROL)
    e = (a.network.points.coordinates - made.truth.points.coordinates)[tie]
    q = a.point_cofactors[tie]
    chi = np.einsum("ni,nij,nj->n", e, np.linalg.inv(q), e)
    assert 0.001 < stats.chi2.cdf(chi.sum(), 3 * len(tie)) < 0.999


def test_tracks_of_different_orders():
    """Nodes of different widths in one group: an order for each track, and for each axis."""
    made = simulate_radar(2, order=2, directions=(np.pi, np.pi), sides=(1, -1), ties=3, deviations=[[0.5, 0, 0], [-3, 0, 0], [0, 0, 0]])
    whole = made.network.declared[0]
    names = whole.parameters[0]
    keep = [i for i, n in enumerate(names) if n != "Z2"]
    n = len(names)
    second = tuple(names[i] for i in keep)
    values = np.concatenate([whole.values[:n], whole.values[n:][keep]])
    states = np.concatenate([whole.states[:n], whole.states[n:][keep]])
    units = (whole.units[0], tuple(whole.units[0][i] for i in keep))
    mixed = type(whole)("track", whole.labels, (names, second), units, values, states)
    a = adjust(replace(made.network, declared=(mixed,)))
    b = adjust(made.network)
    assert a.redundancy == b.redundancy + 1
    assert a.objective >= b.objective - 1e-9
    fixed = np.array(whole.states)
    fixed[whole.named(1, "Z2")] = FIXED
    start = np.array(whole.values)
    start[whole.named(1, "Z2")] = 0.0
    c = adjust(replace(made.network, declared=(replace(whole, states=fixed, values=start),)))
    assert a.objective == pytest.approx(c.objective, rel=1e-9)
    assert a.redundancy_numbers == pytest.approx(c.redundancy_numbers, abs=1e-8)


def test_squint_polynomial():
    """A squint angle that varies with time is recovered (the companion paper of 2000)."""
    squint = (0.02, 2e-4, -5e-6)
    made = simulate_radar(6, noise=(PIXEL / SPEED / 10, 0.1), order=2, squint=squint, deviations=[[1, 0, 0], [-9, 0, 0], [0, 0, 0]])
    a = adjust(made.network)
    e, c = normalised(a, made.truth)
    assert 0.0005 < stats.chi2.cdf(e @ np.linalg.solve(c, e), len(e)) < 0.9995
    values = dict(zip(a.unknowns["name"], a.unknowns["value"], strict=True))
    assert values["track 1: squint0"] == pytest.approx(0.02, abs=5e-3)


def test_spaceborne():
    """A satellite in a circular orbit seen in geocentric coordinates: start values are the orbit data, control has sigmas."""
    rng = np.random.default_rng(11)
    earth, orbit, rate = 6_371_000.0, 7_171_000.0, 1.04e-3  # m, m, rad/s
    t = np.linspace(-8.0, 8.0, 9)
    flown = orbit * np.stack([np.cos(rate * t), np.zeros(9), np.sin(rate * t)], axis=1)
    c = np.stack([np.polynomial.polynomial.polyfit(t, flown[:, k], 4) for k in range(3)])[None]
    true = tracks(["orbit"], c, [[0.0]], 12.5, 820_000.0, side=0)
    n = 30
    along, across = rng.uniform(-6e-3, 6e-3, n), rng.uniform(0.035, 0.05, n)
    h = rng.uniform(0, 2000, n)
    x = (earth + h)[:, None] * np.stack([np.cos(across) * np.cos(along), np.sin(across), np.cos(across) * np.sin(along)], axis=1)
    layout = true.layouts[0]
    s, r = radar.project(x, *true.arrays(np.zeros(n, dtype=int), layout), np.zeros(n))
    noise = np.array([2e-4, 0.5])
    o = RangeDoppler(
        np.zeros(n, dtype=int), np.arange(n), np.stack([s, r], axis=1) + noise * rng.standard_normal((n, 2)), np.tile(noise, (n, 1))
    )
    states = np.full((n, 3), OBSERVED)
    given = x + 2.0 * rng.standard_normal(x.shape)
    points = Points.make([str(i) for i in range(n)], given, np.full(n, CONTROL), states, given, np.full((n, 3), 2.0))
    # orbit data: positions and velocities good to 50 m and 0.05 m/s, accelerations known
    values, group_states, sigmas = np.array(true.values), np.array(true.states), np.full(len(true.values), np.nan)
    for axis in "XYZ":
        for k, sigma in ((0, 50.0), (1, 0.05)):
            at = true.named(0, f"{axis}{k}")
            values[at] += sigma * rng.standard_normal()
            group_states[at], sigmas[at] = OBSERVED, sigma
        for k in (2, 3, 4):
            group_states[true.named(0, f"{axis}{k}")] = FIXED
    group_states[[true.named(0, "squint0"), true.named(0, "pixel_spacing")]] = FIXED
    start = replace(true, values=values, states=group_states, given=values, sigmas=sigmas)
    a = adjust(Network((), Images.make(()), points, (o,), declared=(start,), settings={"min_rays": 0}))
    assert a.status == "converged"
    assert a.redundancy == 2 * n  # 2 n + 3 n + 6 observations, 3 n + 6 unknowns
    e = np.concatenate([a.network.declared[0].values[group_states == OBSERVED] - true.values[group_states == OBSERVED]])
    sigma = np.array([s for s, name in zip(a.unknown_table("apriori")["sigma"], a.unknowns["name"], strict=True) if "track" in name])
    assert (np.abs(e) < 4.5 * sigma).all()
    prior = sigmas[group_states == OBSERVED]
    assert (sigma < prior * (1 + 1e-9)).all()
    assert set(a.unknowns["state"]) == {"observed"}
    assert 0.001 < stats.chi2.cdf(a.objective, a.redundancy) < 0.999
    assert "track parameters" in set(a.observations["group"])
    table = a.observations
    shown = np.array([v for v, g in zip(table["observed"], table["group"], strict=True) if g == "track parameters"])
    assert sorted(shown) == pytest.approx(sorted(values[group_states == OBSERVED]), rel=1e-12)  # the reduction to the centroid is undone


def test_project_files(tmp_path, made, adjusted):
    project.write(made.network, tmp_path / "p")
    again = baarda.read(tmp_path / "p")
    assert again.declared[0].parameters == made.network.declared[0].parameters
    assert again.observations[0].tr == pytest.approx(made.network.observations[0].tr, abs=0.0)
    assert adjust(again).objective == adjusted.objective
    project.write(adjusted.network, tmp_path / "q")
    assert adjust(baarda.read(tmp_path / "q")).objective == pytest.approx(adjusted.objective, rel=1e-9)


def test_observed_track_parameters_in_files(tmp_path, made):
    group = made.tracks
    at = [group.named(0, n) for n in ("X0", "Z0", "squint0")]
    states, given, sigmas = np.array(group.states), np.full(len(group.values), np.nan), np.full(len(group.values), np.nan)
    states[at], given[at], sigmas[at] = OBSERVED, group.values[at] + [3.0, -2.0, 1e-4], [5.0, 5.0, 1e-3]
    network = replace(made.network, declared=(replace(group, states=states, given=given, sigmas=sigmas),))
    project.write(network, tmp_path / "p")
    again = baarda.read(tmp_path / "p")
    assert again.declared[0].given == pytest.approx(given, nan_ok=True, abs=0.0)
    a, b = adjust(network), adjust(again)
    assert a.objective == b.objective
    assert a.redundancy == 70 + 3 - 17
    table = (tmp_path / "p" / "declared.csv").read_text()
    (tmp_path / "p" / "declared.csv").write_text(table.replace(",observed,", ",free,", 1).replace(",5.0\n", ",\n", 1))
    with pytest.raises(InputError, match=r"declared\.csv, line \d+: an observed unknown needs"):
        baarda.read(tmp_path / "p")


def test_files_that_make_no_sense(tmp_path, made):
    project.write(made.network, tmp_path / "p")
    table = tmp_path / "p" / "range_doppler.csv"
    text = table.read_text()
    lines = text.splitlines()
    for change, message in (
        ([*lines[:3], lines[2], *lines[3:]], r"line 4: point C2 of track 1 appears already in line 3"),
        ([lines[0], lines[1].replace("1,C1", "7,C1"), *lines[2:]], r"line 2: .*7"),
        ([lines[0], lines[1].rsplit(",", 2)[0] + ",0,1.0", *lines[2:]], r"line 2: the sigmas of range doppler must be there and positive"),
    ):
        table.write_text("\n".join(change) + "\n")
        with pytest.raises(InputError, match=message):
            baarda.read(tmp_path / "p")
    table.write_text(text)
    declared = tmp_path / "p" / "declared.csv"
    declared.write_text("\n".join(line for line in declared.read_text().splitlines() if ",X1," not in line) + "\n")
    with pytest.raises(InputError, match="without a gap"):
        baarda.read(tmp_path / "p")


def test_refusals(made):
    network = made.network
    group = network.declared[0]
    few = np.array(network.observations[0].points) < 8
    with pytest.raises(RedundancyNotPositive, match="n = 16 observations, u = 17 unknowns"):
        adjust(replace(network, observations=(network.observations[0].selected(few),)))
    with pytest.raises(UsageError, match="at least 5 control points"):
        adjust(replace(network, observations=(network.observations[0].selected(np.arange(4)),)))
    wrong = np.array(group.values)
    wrong[group.named(0, "side")] = -1.0
    with pytest.raises(UsageError, match="lies left of track 1, which looks right"):
        adjust(replace(network, declared=(replace(group, values=wrong),)))
    points = network.points
    line = np.array(points.coordinates)
    line[:, 0] = line[0, 0]
    with pytest.raises(Singular, match=r"track 1: .* one line"):
        adjust(replace(network, points=replace(points, coordinates=line, given=line)))
    with pytest.raises(UsageError, match="side is 1"):
        tracks(["1"], np.zeros((1, 3, 2)), [[0.0]], 4.0, side=2)
    with pytest.raises(UsageError, match="no parameter 'X7'"):
        tracks(["1"], np.zeros((1, 3, 2)), [[0.0]], 4.0, fixed=("X7",))


def lonely(made, side, sees=1, height=True):
    """A point without plan coordinates, seen from tracks that are known and have no control."""
    true = made.tracks
    keep = [made.network.points.labels.index("T36")]
    rows = np.isin(made.truth.observations[0].points, keep) & (made.truth.observations[0].tracks < sees)
    values = np.array(true.values)
    values[[true.named(k, "side") for k in range(len(true.labels))]] = side
    group = replace(true, values=values, states=np.full(len(values), FIXED))
    x = np.full((1, 3), np.nan)
    given = np.full((1, 3), np.nan)
    states = np.full((1, 3), 2)
    role = 0
    if height:
        x[0, 2] = given[0, 2] = made.truth.points.coordinates[keep[0], 2]
        states[0, 2], role = FIXED, CONTROL
    o = made.truth.observations[0].selected(rows)
    o = replace(o, points=np.zeros(len(o), dtype=int))
    points = Points.make(["T36"], x, [role], states, given)
    network = Network((), Images.make(()), points, (o,), declared=(group,), settings={"min_rays": 0})
    return network, made.truth.points.coordinates[keep[0]]


def test_left_or_right_is_told_not_guessed():
    made = simulate_radar(9, ties=1, order=2, directions=(np.pi, np.pi), sides=(1, 1))
    network, _ = lonely(made, 0)
    with pytest.raises(Singular, match=r"point T36: \(.*\) and \(.*\) have the same ranges; say on which side"):
        adjust(network)
    with pytest.raises(Singular, match="one track only and has no given height"):
        adjust(lonely(made, 1, height=False)[0])


def test_intersection_with_given_height():
    """Known tracks, one of them or two: the point comes out where it is."""
    made = simulate_radar(9, ties=1, order=2, directions=(np.pi, 1.2), sides=(1, 1))
    for sees in (1, 2):
        network, true = lonely(made, 1, sees)
        if sees == 1:  # two observations for two unknowns: an intersection, but no adjustment
            with pytest.raises(RedundancyNotPositive):
                adjust(network)
            group = network.observations[0]
            started = group.with_start(network, np.zeros(1, dtype=bool))
            assert started.points.coordinates[0] == pytest.approx(true, abs=1e-7)
        else:
            assert adjust(network).network.points.coordinates[0] == pytest.approx(true, abs=1e-6)


def test_selection_drops_altitude_terms(made):
    """Wu's outcome on the simulated scenario: at the third stage all three criteria are least, two altitude terms are gone."""
    found, a = select_parameters(made.network)
    assert set(found.deleted) == {"track 1: Z3", "track 1: Z4"}
    assert a.numbering.count == 15
    for name in ("variance_factor", "criterion_b", "aic"):
        values = [s.criteria[name] for s in found.steps]
        assert int(np.argmin(values)) == 2
    group = a.network.declared[0]
    assert group.values[group.named(0, "Z4")] == 0.0
    # deleting raises v'Pv by x^2 / q, exactly in a linear model
    for s in found.steps[1:]:
        assert s.increase == pytest.approx(s.predicted_increase, abs=0.3)


def test_significant_terms_stay():
    """With all terms well beyond their sigmas nothing is deleted."""
    strong = [[60.0, -60.0, 50.0], [-700.0, 700.0, -400.0], [250.0, 200.0, 250.0]]
    made = simulate_radar(5, noise=(PIXEL / SPEED / 10, 0.1), deviations=np.array(strong) / 4)
    group = made.tracks
    found, _ = select_parameters(replace(made.network, declared=(replace(made.network.declared[0], values=group.values),)))
    assert found.deleted == ()


def test_withheld_points(made):
    """6 turns of 5 points that keep their height: errors of the size that is predicted for them."""
    p = planimetry(made.network)
    assert len(p.points) == 30
    assert ((p.low < p.predicted) & (p.predicted < p.high)).all()
    assert (p.rms > 3.0).all()
    assert (p.rms < 12.0).all()
    z = p.differences / p.sigmas
    assert np.abs(z).max() < 4.5
    with pytest.raises(UsageError, match="cannot be withheld"):
        planimetry(made.network, size=35)


def test_cross_validation_keeps_heights(made):
    c = cross_validate(made.network, 5)
    assert {r.axis for r in c.rows} == {"X", "Y"}
    assert len(c.rows) == 70
    horizontal = next(e for e in c.errors if e.name == "horizontal")
    assert horizontal.low < horizontal.predicted < horizontal.high


def test_snooping_finds_a_gross_error():
    """An error of 12 pixels in r of a control point: found, rejected; the point, which is known, is no loss."""
    made = simulate_radar(2)
    o = made.network.observations[0]
    tr = np.array(o.tr)
    tr[7, 1] += 12.0
    found, a = snoop(replace(made.network, observations=(replace(o, tr=tr),)), Options(), "coordinate", None)
    assert [(s.action, s.point, s.component) for s in found.steps] == [("rejected", "C8", "r")]
    assert found.steps[0].estimated_error == pytest.approx(12.0, abs=3.5)
    assert a.redundancy == 51


def test_priors_of_tracks_can_be_removed_and_predicted(made):
    """A grossly wrong prior of the antenna's position is found by snooping."""
    group = made.tracks
    at = [group.named(0, n) for n in ("X0", "Y0", "Z0")]
    states, given, sigmas = np.array(group.states), np.full(len(group.values), np.nan), np.full(len(group.values), np.nan)
    states[at], given[at], sigmas[at] = OBSERVED, group.values[at] + [0.0, 0.0, 900.0], 5.0
    network = replace(made.network, declared=(replace(made.network.declared[0], states=states, given=given, sigmas=sigmas),))
    found, _ = snoop(network, Options(), "coordinate", None)
    assert [(s.action, s.group, s.component) for s in found.steps] == [("rejected", "track parameters", "Z0")]


def test_inner_constraints_reach_a_track_over_points_that_are_held(made, monkeypatch):
    """Where neither free points nor images can take the constraints, the unknowns of the track do."""
    a = adjust(made.network)
    track = a.numbering["track"].columns
    basis = np.zeros((a.numbering.count, 1))
    basis[track[track >= 0][0]] = 1.0
    monkeypatch.setattr("baarda.adjustment.solve.minimal_columns", lambda defect, lin, candidates: candidates[:1])
    datum = choose_datum(Defect(basis, ("rotation about X",), np.eye(7)[:, 3:4], False), a.lin, Settings(), a.network)
    assert "over all unknowns" in datum.text
    assert np.isfinite(datum.transfer).all()
