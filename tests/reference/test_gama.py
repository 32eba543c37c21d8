"""Networks of GNU Gama: redundancy, standardised residuals and estimated errors as printed; the kinds by differences; the reader."""

import json
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.cameras import FREE
from baarda.cli import app
from baarda.errors import InputError, UsageError
from baarda.formats import read, write
from baarda.hypotheses.outliers import estimated_error
from baarda.network import CONTROL, TIE, Declared, Images, Network, Points, State, unknowns_of
from baarda.observations import Angles, Directions, Distances, HeightDifferences, stations

NAMESPACE = "{http://www.gnu.org/software/gama/gama-local-adjustment}"
GON = np.pi / 200.0
# equations, unknowns, redundancy, sum of squares and standard deviation a posteriori in Gama's unit (m0 a priori = 10)
PRINTED = {
    "gama-local": (69, 32, 37, 3.4356008e3, 9.6360820),
    "azimuth-angle": (67, 34, 33, 3.2423920e3, 9.9123308),
    "azimuth-distance": (66, 33, 33, 3.2423952e3, 9.9123357),
    "fixed-azimuth": (70, 34, 36, 3.4297495e3, 9.7606772),
}
KINDS = {"directions": "direction", "azimuths": "azimuth", "distances": "distance"}


@pytest.fixture(scope="module", params=PRINTED)
def case(request, data):
    folder = data("gama_networks")
    network = read(folder / f"{request.param}.gkf")
    return request.param, network, baarda.adjust(network), ElementTree.parse(folder / f"{request.param}.xml").getroot()


def tag(name):
    return NAMESPACE + name


def printed_observations(root):
    """Return kind, from, to and the numbers of each observation of a result of gama-local."""
    out = {}
    for element in root.find(tag("observations")):
        kind = element.tag.removeprefix(NAMESPACE)
        key = (kind, element.find(tag("from")).text, element.find(tag("to")).text)
        out[key] = {e.tag.removeprefix(NAMESPACE): float(e.text) for e in element if e.tag not in (tag("from"), tag("to"))}
    return out


def ours(result):
    """Return the rows of the observation table by the same key."""
    rows = zip(result.observations.rows(), result.qvv, strict=True)
    return {(KINDS[r["group"]], r["point"], r["component"].rpartition(" to ")[2]): {**r, "qvv": q} for r, q in rows}


def test_sizes_and_sums(case):
    name, network, result, _ = case
    equations, unknowns, redundancy, squares, deviation = PRINTED[name]
    assert network.format == "gama"
    assert (result.count, result.numbering.count, result.redundancy) == (equations, unknowns, redundancy)
    # Gama stops after one linearisation (tol-abs 1000 mm); ours is the minimum, a little below
    assert 0.0 < squares - 100.0 * result.objective < 1e-5 * squares
    assert 10.0 * result.sigma0 == pytest.approx(deviation, rel=5e-6)
    assert result.redundancy_numbers.sum() == pytest.approx(redundancy, rel=1e-12)


def test_every_observation_as_printed(case):
    _, _, result, root = case
    printed, found = printed_observations(root), ours(result)
    assert set(printed) == set(found)
    for key, p in printed.items():
        row = found[key]
        angular = key[0] != "distance"
        unit = 1e-4 * GON if angular else 1e-3
        r, v = row["redundancy"], row["residual"] / unit
        weight = (10.0 * unit / row["sigma"]) ** 2
        assert r / weight == pytest.approx(p["qrr"], abs=6e-4), key
        assert 100.0 * (1.0 - np.sqrt(max(0.0, 1.0 - r))) == pytest.approx(p["f"], abs=2e-3), key
        assert ("std-residual" in p) == (r > 1e-10), key
        if r > 1e-10:
            assert abs(row["residual"]) / (result.sigma0 * np.sqrt(row["qvv"])) == pytest.approx(p["std-residual"], abs=2e-3), key
        difference = p["adj"] - p["obs"]
        turn = (difference + 200.0) % 400.0 - 200.0 if angular else difference
        assert v == pytest.approx(turn * (1e4 if angular else 1e3), abs=0.02), key
        if "err-obs" in p:  # Gama prints it where the observation is controlled, with the sign of the residual
            assert -estimated_error(v, r) == pytest.approx(p["err-obs"], abs=0.03), key
        if p["stdev"] > 0.0:
            assert result.sigma0 * row["sigma"] / unit * np.sqrt(1.0 - r) == pytest.approx(p["stdev"], rel=2e-4), key


def test_coordinates_and_their_covariances_as_printed(case):
    name, _, result, root = case
    adjusted = {p.find(tag("id")).text: p for p in root.find(tag("coordinates")).find(tag("adjusted"))}
    index = {label: i for i, label in enumerate(result.network.points.labels)}
    for label, element in adjusted.items():
        x, y = (float(element.find(tag(k)).text) for k in "xy")
        np.testing.assert_allclose(result.network.points.coordinates[index[label]], [y, x, 0.0], atol=2e-5)
    matrix = root.find(tag("coordinates")).find(tag("cov-mat"))
    dim = int(matrix.find(tag("dim")).text)
    upper = np.zeros((dim, dim))
    upper[np.triu_indices(dim)] = [float(e.text) for e in matrix.findall(tag("flt"))]
    names = [f"point {label}: {axis}" for label in adjusted for axis in ("Y", "X")]
    q = result.covariance(names)
    np.testing.assert_allclose(1e6 * q, (upper + np.triu(upper, 1).T)[: len(names), : len(names)], rtol=5e-4, atol=2e-3)
    shifts = root.find(tag("coordinates")).find(tag("orientation-shifts"))
    table = {r["name"]: r for r in result.unknowns.rows() if r["group"] == "station"}
    assert len(table) == dim - len(names) == len(shifts)
    for k, shift in enumerate(shifts):
        label, value = shift.find(tag("id")).text, float(shift.find(tag("adj")).text)
        row = table[f"station {label}: orientation"]
        assert (row["value"] / GON - value + 200.0) % 400.0 - 200.0 == pytest.approx(0.0, abs=2e-5)
        assert row["unit"] == "rad"
        assert row["sigma"] / (1e-4 * GON) == pytest.approx(np.sqrt(upper[len(names) + k, len(names) + k]), rel=5e-4)
    assert name in PRINTED


def test_linearised_where_gama_linearised_the_sum_is_the_printed_one(case):
    """One least-squares step from Gama's approximate coordinates and orientations, through the kinds alone."""
    name, network, _, root = case
    xy = np.array(network.points.coordinates)
    index = {label: i for i, label in enumerate(network.points.labels)}
    for p in root.find(tag("coordinates")).find(tag("approximate")):
        xy[index[p.find(tag("id")).text], :2] = [float(p.find(tag(k)).text) for k in "yx"]
    group = network.declared[0]
    values = np.array(group.values)
    for shift in root.find(tag("coordinates")).find(tag("orientation-shifts")):
        values[group.labels.index(shift.find(tag("id")).text)] = float(shift.find(tag("approx")).text) * GON
    started = replace(network, points=replace(network.points, coordinates=xy), declared=(replace(group, values=values),))
    misclosure, a = whitened(started)
    a /= np.linalg.norm(a, axis=0)
    v = a @ np.linalg.lstsq(a, misclosure, rcond=None)[0] - misclosure
    assert 100.0 * v @ v == pytest.approx(PRINTED[name][3], rel=2e-7)


def whitened(network):
    """Return misclosures and design matrix of all groups, divided by the standard deviations."""
    state, unknowns = State.of(network), unknowns_of(network)
    misclosure, a = [], []
    for group in network.observations:
        for rows in group.linearize(network, state):
            block = np.zeros((len(rows.index), unknowns.count + 1))
            for b in rows.blocks:
                columns = unknowns[b.kind].of(b.nodes, b.jacobian.shape[2])
                np.add.at(block, (np.arange(len(block))[:, None], columns), b.jacobian[:, 0])
            sigma = np.sqrt(rows.cofactor[:, 0])
            misclosure.append(rows.misclosure[:, 0] / sigma[:, 0])
            a.append(block[:, :-1] / sigma)
    return np.concatenate(misclosure), np.concatenate(a)


def test_mikhails_level_net(data):
    result = baarda.adjust(read(data("gama_networks") / "mikhail-7.4.gkf"))
    # a priori 10 mm for 1 km; the book has weights 1/dist
    heights = result.network.points.coordinates[1:, 2]
    np.testing.assert_allclose(heights, [825.22062433, 835.53543022, 809.53392822, 830.84602870], atol=6e-9)
    v = [-0.19937567, -0.02519411, -0.33543022, -0.14669611, -0.00789952, -0.13059848, 0.17397130, 0.10849800]
    np.testing.assert_allclose(result.residuals, v, atol=6e-9)
    assert 1e-4 * result.objective == pytest.approx(0.01617137, abs=6e-9)
    assert result.redundancy == 4
    assert 0.01 * result.sigma0 == pytest.approx(0.06358335, abs=6e-9)
    sigma = [r["sigma"] for r in result.unknowns.rows()]
    np.testing.assert_allclose(sigma, [0.18051, 0.16146, 0.20096, 0.17107], atol=6e-6)
    r = [0.5547, 0.4037, 0.5459, 0.5487, 0.4715, 0.4538, 0.4754, 0.5462]
    np.testing.assert_allclose(result.redundancy_numbers, r, atol=6e-5)
    tau = result.residuals / (result.sigma0 * np.sqrt(result.qvv))
    np.testing.assert_allclose(tau, [-0.9896, -0.2034, -1.8947, -0.7424, -0.0492, -0.9690, 1.0682, 0.6171], atol=6e-5)


def test_a_free_network_of_angles_and_distances(data):
    network = read(data("gama_networks") / "skorepa-dusek.gkf")
    result = baarda.adjust(network)
    assert (result.count, result.numbering.count, result.datum.defect.count, result.redundancy) == (13, 8, 3, 8)
    held = baarda.adjust(network, datum="minimal")
    np.testing.assert_allclose(held.redundancy_numbers, result.redundancy_numbers, atol=1e-10)
    np.testing.assert_allclose(held.residuals, result.residuals, atol=1e-9)
    assert any("constrained coordinates" in a for a in network.assumptions)


def test_orientations_turn_with_a_free_network(data):
    """Without any known point shifts and the rotation about Z are free, and only they: the stations know how they follow."""
    network = read(data("gama_networks") / "gama-local.gkf")
    points = network.points
    states = np.array(points.states)
    states[:, :2] = FREE
    loose = replace(network, points=replace(points, states=states, roles=np.full(len(points.labels), TIE), given=np.full((12, 3), np.nan)))
    result = baarda.adjust(loose)
    assert set(result.datum.defect.free) == {"shift along X", "shift along Y", "rotation about Z"}
    assert result.redundancy == 69 - 36 + 3
    turned = result.network.points.coordinates @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    group = replace(network.declared[0], values=result.network.declared[0].values - np.pi / 2)  # +X turns to +Y: bearings fall
    again = baarda.adjust(replace(loose, points=replace(loose.points, coordinates=turned), declared=(group,)))
    np.testing.assert_allclose(again.residuals, result.residuals, atol=1e-8)
    assert again.objective == pytest.approx(result.objective, rel=1e-9)


def test_scale_is_free_without_distances(data):
    network = read(data("gama_networks") / "gama-local.gkf")
    points = network.points
    states = np.array(points.states)
    states[:, :2] = FREE
    loose = replace(points, states=states, roles=np.full(len(points.labels), TIE), given=np.full((12, 3), np.nan))
    result = baarda.adjust(replace(network, points=loose, observations=network.observations[:1]))
    assert set(result.datum.defect.free) == {"shift along X", "shift along Y", "rotation about Z", "scale"}


def test_a_station_without_directions_has_no_unknown(data):
    network = read(data("gama_networks") / "gama-local.gkf")
    group = network.observations[0]
    at = network.declared[0].labels.index("424")
    fewer = replace(network, observations=(group.selected(group.sets != at), *network.observations[1:]))
    result = baarda.adjust(fewer)
    assert (result.count, result.numbering.count) == (67, 31)
    assert "station 424: orientation" not in result.numbering.names


@pytest.mark.parametrize("name", [*PRINTED, "mikhail-7.4", "skorepa-dusek"])
def test_project_folders_give_the_network_back(data, tmp_path, name):
    network = read(data("gama_networks") / f"{name}.gkf")
    write(network, tmp_path / "project", "project")
    again = read(tmp_path / "project")
    assert again.format == "project"
    for ours_, theirs in zip(network.observations, again.observations, strict=True):
        assert (type(ours_), ours_.name, ours_.unit) == (type(theirs), theirs.name, theirs.unit)
        np.testing.assert_array_equal(theirs.values, ours_.values)
        np.testing.assert_array_equal(theirs.sigmas, ours_.sigmas)
        np.testing.assert_array_equal(theirs.points_of(), ours_.points_of())
    assert [d.labels for d in again.declared] == [d.labels for d in network.declared]
    for a, b in zip(again.declared, network.declared, strict=True):
        assert type(a) is type(b)
        np.testing.assert_array_equal(a.values, b.values)
        np.testing.assert_array_equal(a.states, b.states)
    np.testing.assert_array_equal(again.points.coordinates, network.points.coordinates)
    np.testing.assert_array_equal(again.points.states, network.points.states)
    assert baarda.adjust(again).objective == pytest.approx(baarda.adjust(network).objective, rel=1e-12)


@pytest.mark.parametrize(
    ("file", "old", "new", "line", "words"),
    [
        ("declared", "station,2,", "tower,2,", 3, "'tower' are not known"),
        ("declared", "station,2,", "station,1,", 3, "orientation of station '1' appears twice"),
        ("declared", ",free", ",observed", 2, "an observed unknown needs a given value and a sigma"),
        ("directions", "\n1,1,2,", "\n77,1,2,", 2, "station '77'"),
        ("directions", "\n1,1,2,", "\n1,1,1,", 2, "must be different"),
        ("directions", "\n1,1,2,0.0,1.57", "\n1,1,2,0.0,-1.57", 2, "sigma"),
    ],
)
def test_project_tables_that_cannot_be_used(data, tmp_path, file, old, new, line, words):
    write(read(data("gama_networks") / "gama-local.gkf"), tmp_path / "p", "project")
    path = tmp_path / "p" / f"{file}.csv"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path / "p")
    assert caught.value.line == line


def test_the_command_line_adjusts_a_levelling_net(data, tmp_path):
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["adjust", str(data("gama_networks") / "mikhail-7.4.gkf"), "--out", str(out), "--quiet"])
    assert done.exit_code == 0, done.output
    assert (out / "project" / "height_differences.csv").is_file()
    text = (out / "tables" / "observations.csv").read_text(encoding="utf-8")
    assert "height difference to B" in text
    assert json.loads((out / "result.json").read_text(encoding="utf-8"))["counts"]["redundancy"] == 4


# ---- the kinds ----------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mixed():
    rng = np.random.default_rng(4)
    xyz = rng.uniform(-100.0, 100.0, (6, 3))
    a, b, c = np.array([0, 1, 2, 3, 4, 5]), np.array([1, 2, 3, 4, 5, 0]), np.array([3, 4, 5, 0, 1, 2])
    zero, sigma = np.zeros(6), np.full(6, 1e-3)
    groups = (
        Directions(a // 3, a, b, zero, sigma),
        Angles(a, b, c, zero, sigma),
        HeightDifferences(a, b, zero, sigma),
        Distances(a, c, zero, sigma),
    )
    return Network((), Images.make([]), Points.make(list("abcdef"), xyz), groups, declared=(stations(["A", "B"], [0.3, -2.0]),))


@pytest.mark.parametrize("group", range(4))
def test_partials_agree_with_differences(mixed, group):
    unknowns, state = unknowns_of(mixed), State.of(mixed)
    kind = mixed.observations[group]
    (rows,) = kind.linearize(mixed, state)
    dense = np.zeros((len(kind), unknowns.count + 1))
    for b in rows.blocks:
        np.add.at(dense, (np.arange(len(kind))[:, None], unknowns[b.kind].of(b.nodes, b.jacobian.shape[2])), b.jacobian[:, 0])
    h = 1e-4
    for k in range(unknowns.count):
        step = np.zeros(unknowns.count)
        step[k] = h
        up, down = (kind.misclosures(mixed, state.moved(unknowns, s * step))[:, 0] for s in (1.0, -1.0))
        np.testing.assert_allclose(dense[:, k], -(up - down) / (2 * h), atol=1e-8)
    np.testing.assert_array_equal(rows.misclosure, kind.misclosures(mixed, state))


def test_declared_unknowns_are_numbered_last_named_and_written_back(mixed):
    unknowns, state = unknowns_of(mixed), State.of(mixed)
    assert unknowns.count == 20
    assert unknowns.names[-2:] == ("station A: orientation", "station B: orientation")
    assert unknowns.name(19) == "station B: orientation"
    step = np.zeros(20)
    step[19] = 0.5
    written = state.moved(unknowns, step).write_to(mixed)
    np.testing.assert_allclose(written.declared[0].values, [0.3, -1.5])
    np.testing.assert_allclose(mixed.declared[0].values, [0.3, -2.0])
    fixed = replace(mixed, declared=(stations(["A", "B"], [0.3, -2.0], [0, FREE]),))
    assert unknowns_of(fixed).names[-1:] == ("station B: orientation",)
    assert unknowns_of(fixed).count == 19
    with pytest.raises(UsageError, match="no unknowns of the kind 'track'"):
        state["track"]


def test_declared_groups_are_checked():
    with pytest.raises(UsageError, match="cannot be called 'point'"):
        Declared.make("point", ["1"], ["a"], [""], [[1.0]])
    with pytest.raises(UsageError, match="values"):
        Declared("track", ("1", "2"), (("a", "b"), ("a",)), (("m", "m/s"), ("m",)), np.zeros(4), np.full(4, FREE))
    wide = Declared("track", ("1", "2"), (("a", "b"), ("a",)), (("m", "m/s"), ("m",)), np.zeros(3), np.full(3, FREE))
    assert wide.offsets.tolist() == [0, 2, 3]
    empty = Network((), Images.make([]), Points.make(["p"], np.zeros((1, 3))), (), declared=(wide, wide))
    with pytest.raises(UsageError, match="two groups of unknowns are called 'track'"):
        unknowns_of(empty)
    assert unknowns_of(replace(empty, declared=(wide,))).count == 3  # the point's: no observation sees a track
    seen = SimpleNamespace(nodes_of=lambda: {"track": np.array([0, 1])}, points_of=lambda: (np.array([0, 0]),))
    network = replace(empty, observations=(seen,), declared=(wide,))
    assert unknowns_of(network).names[3:] == ("track 1: a", "track 1: b", "track 2: a")
    assert unknowns_of(network, np.array([False])).count == 0


# ---- the reader ---------------------------------------------------------------------------------------------------------------------

SMALL = """<?xml version="1.0"?>
<gama-local xmlns="http://www.gnu.org/software/gama/gama-local">
<network axes-xy="{axes}" angles="{angles}">
<parameters sigma-apr="10"/>
<points-observations distance-stdev="5 2" direction-stdev="10" angle-stdev="20">
<point id="A" x="0" y="0" fix="xy"/>
<point id="B" x="100" y="0" fix="xy"/>
<point id="C" adj="xy"/>
<obs from="A">
<direction to="B" val="10"/>
<direction to="C" val="{left}"/>
<distance to="C" val="70.7107"/>
</obs>
<obs from="B">
<angle bs="A" fs="C" val="{angle}"/>
<distance to="C" val="70.7107" stdev="3"/>
</obs>
</points-observations>
</network>
</gama-local>
"""


@pytest.mark.parametrize(
    ("axes", "angles", "left", "angle", "expected"),
    [
        ("ne", "left-handed", 60, 350, (50, 50)),  # X = y, Y = x
        ("sw", "left-handed", 60, 350, (50, 50)),
        ("ne", "right-handed", 360, 50, (50, 50)),
        ("en", "left-handed", 60, 350, (50, -50)),
        ("en", "right-handed", 60, 350, (50, 50)),
    ],
)
def test_axes_and_turn(tmp_path, axes, angles, left, angle, expected):
    """C lies 50 gon beside the line from A along +x to B; on which side depends on the sense of axes and angles."""
    path = tmp_path / "n.gkf"
    path.write_text(SMALL.format(axes=axes, angles=angles, left=left, angle=angle))
    network = read(path)
    np.testing.assert_allclose(network.points.coordinates[2, :2], expected, atol=1e-3)
    result = baarda.adjust(network)
    assert result.redundancy == 2
    assert np.abs(result.residuals / result.sigmas).max() < 0.1
    assert network.points.roles.tolist() == [CONTROL, CONTROL, TIE]
    group = next(g for g in network.observations if isinstance(g, Distances))
    np.testing.assert_allclose(group.sigmas, [1e-3 * (5 + 2 * 0.0707107), 3e-3])


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('val="10"', 'val="ten"', 10, "val is not a number"),
        ('val="10"', 'val="10-20-30"', 10, "degrees are not supported"),
        ('val="10"', "", 10, "attribute val is missing"),
        ('<direction to="B"', '<z-angle to="B"', 10, "not supported"),
        ('direction to="B"', 'direction to="Z"', 10, "unknown point 'Z'"),
        ('direction to="B"', 'direction to="A"', 10, "different points"),
        ('stdev="3"', 'stdev="0"', 16, "must be positive"),
        ('stdev="3"', 'stdev="1e30"', 16, "not finite or too large"),
        ('direction-stdev="10"', "", 10, "no direction-stdev"),
        ('direction-stdev="10"', 'direction-stdev="a"', 5, "not understood"),
        ('id="C" adj="xy"', 'id="C" adj="x"', 8, "x and y together"),
        ('id="C" adj="xy"', 'id="C"', 11, "has no x and y"),
        ('<point id="C"', '<point id="D" adj="z"/><point id="C"', 8, "no start value found for z"),
        ('id="C" adj="xy"', 'id="C" z="1" adj="xyz"', 12, "horizontal distances"),
        ('id="B" x="100"', 'id="B"', 7, "x is fixed, but not given"),
        ('id="B"', 'id="A"', 7, "appears twice"),
        ("<parameters", "<something/><parameters", 4, "not supported"),
        ("</obs>", "", 18, "not well-formed"),
        ("<network", "<!DOCTYPE a><network", 3, "not well-formed"),
        ("<gama-local xmlns", '<!DOCTYPE a [<!ENTITY b "c">]><gama-local xmlns', 2, "declaration is not accepted"),
        ("axes-xy", 'axes-xy="no" other', 3, "is not known"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_line(tmp_path, old, new, line, words):
    path = tmp_path / "n.gkf"
    path.write_text(SMALL.format(axes="ne", angles="left-handed", left=60, angle=350).replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        read(path, format="gama")
    assert caught.value.line == line


def test_files_with_observations_that_are_not_supported_are_refused(data):
    with pytest.raises(InputError, match="cov-mat"):
        read(data("gama_networks") / "scale-cov-gon.gkf")
    with pytest.raises(InputError, match="coordinates"):
        read(data("gama_networks") / "minimal.gkf")


def test_points_without_start_values_are_named(tmp_path):
    path = tmp_path / "n.gkf"
    text = SMALL.format(axes="ne", angles="left-handed", left=60, angle=350)
    path.write_text(text.replace('<distance to="C" val="70.7107"/>', "").replace('<angle bs="A" fs="C" val="350"/>', ""))
    with pytest.raises(InputError, match=r"no start values found .* \(C\)"):
        read(path)


def test_all_tests_run_on_a_network_without_images(case):
    found = {t.name: t for t in baarda.test(case[2])}
    assert {"global_variance_factor", "data_snooping"} <= set(found)
    assert not found["global_variance_factor"].rejected  # Gama: passed
