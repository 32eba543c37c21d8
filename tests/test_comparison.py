"""Two epochs: congruence, localisation, one datum for both, dependent adjustments, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.cli import app
from baarda.errors import UsageError
from baarda.formats.project import write
from baarda.geometry import rotation as rot
from baarda.hypotheses.levels import Options
from baarda.network import CONTROL
from baarda.procedures.comparison import compare, epoch
from baarda.procedures.planning import error_free
from baarda.procedures.synthetic import ring
from baarda.report.comparison_report import result_json, verdict, write_folder


def measured(truth, seed, moves=None, noise=0.5):
    """Return a network measured anew, some points moved since."""
    rng = np.random.default_rng(seed)
    coordinates = np.array(truth.points.coordinates)
    for i, move in (moves or {}).items():
        coordinates[i] += move
    net = error_free(replace(truth, points=replace(truth.points, coordinates=coordinates)))
    group, points = net.observations[0], net.points
    given = points.given + np.nan_to_num(points.sigmas) * rng.standard_normal(points.given.shape)
    seen = replace(group, xy=group.xy + noise * rng.standard_normal(group.xy.shape))
    return replace(net, points=replace(points, given=given), observations=(seen, *net.observations[1:]))


def turned(network, scale, angles, shift):
    """Return a free network in another coordinate system."""
    m = rot.from_angles(*angles)
    points, images = network.points, network.images
    move = lambda x: scale * x @ m.T + shift  # noqa: E731
    return replace(
        network,
        points=replace(points, coordinates=move(points.coordinates)),
        images=replace(images, position=move(images.position), rotation=images.rotation @ m.T),
    )


MOVES = {3: [0.01, 0.0, 0.0], 7: [0.0, 0.01, 0.0]}


@pytest.fixture(scope="module")
def free():
    return ring(6, points=20, control=0, seed=3).truth


@pytest.fixture(scope="module")
def controlled():
    return ring(6, points=20, control=6, seed=3).truth


@pytest.mark.parametrize("frame", ["auto", "common"])
@pytest.mark.parametrize("kind", ["free", "controlled"])
def test_moved_points_are_found_and_measured(kind, frame, request):
    truth = request.getfixturevalue(kind)
    c = compare(epoch(measured(truth, 1)), epoch(measured(truth, 2, MOVES)), frame=frame)
    assert c.rejected
    assert set(c.localisation.moved) == {"P03", "P07"}
    assert c.localisation.decided
    for i, move in MOVES.items():
        assert np.all(abs(c.differences[i] - move) < 4.5 * c.sigmas[i])
    stable = [i for i in range(20) if i not in MOVES]
    assert np.all(abs(c.differences[stable]) < 4.5 * c.sigmas[stable])
    still = compare(epoch(measured(truth, 1)), epoch(measured(truth, 4)), frame=frame)
    assert not still.rejected
    assert still.localisation is None


def test_another_coordinate_system_changes_nothing(free):
    no_scale = replace(free, observations=free.observations[:1])  # without scale bars the scale is free, too
    one, two = measured(no_scale, 1), measured(no_scale, 2, MOVES)
    here = compare(epoch(one), epoch(two))
    there = compare(epoch(one), epoch(turned(two, 3.0, (0.3, -0.2, 1.1), np.array([100.0, -40.0, 7.0]))))
    assert len(here.freedoms) == 7
    assert abs(1.0 / there.transformation.scale - 3.0) < 0.01
    assert np.isclose(here.congruence.statistic, there.congruence.statistic, rtol=1e-6)
    assert np.allclose(here.differences, there.differences, atol=1e-7)
    assert np.allclose(here.sigmas, there.sigmas, rtol=1e-5)


def test_result_does_not_depend_on_the_datum_of_the_epochs(free):
    one, two = measured(free, 1), measured(free, 2, MOVES)
    inner, minimal = (compare(epoch(one, datum=d), epoch(two, datum=d)) for d in ("inner", "minimal"))
    assert np.isclose(inner.congruence.statistic, minimal.congruence.statistic, rtol=1e-4)  # an S-transformation is linear
    assert np.allclose(inner.sigmas, minimal.sigmas, rtol=1e-3)  # the axes are those of the first epoch


def test_pooled_variance_factor_and_its_precondition(controlled):
    one, two = epoch(measured(controlled, 1)), epoch(measured(controlled, 2))
    c = compare(one, two)
    r = one.redundancy + two.redundancy
    assert c.redundancy == r
    assert np.isclose(c.variance_factor, (one.variance_factor * one.redundancy + two.variance_factor * two.redundancy) / r)
    loud = epoch(measured(controlled, 2, noise=1.5))
    other = compare(one, loud)
    assert other.variance_ratio.rejected
    assert other.redundancy == min(one.redundancy, loud.redundancy)
    assert any("variance factors differ" in n for n in other.notes)
    apriori = compare(one, two, Options(sigma="apriori"))
    assert apriori.congruence.law_name.startswith("chi2")


def test_two_adjustments_of_the_same_image_points_are_described(controlled):
    network = measured(controlled, 1)
    c = compare(epoch(network), epoch(network, as_it_is=True))
    assert c.dependent
    assert c.congruence is None
    assert not c.rejected
    assert c.second.as_it_is
    assert c.second.variance_factor > c.first.variance_factor  # the true values do not minimise v'Pv
    assert "no random sample" in verdict(c)[1]
    assert np.allclose(c.differences, network.points.coordinates - c.first.network.points.coordinates)


def test_common_control_is_said(controlled):
    one, two = measured(controlled, 1), measured(controlled, 2)
    at = controlled.points.roles == CONTROL
    shared = replace(two, points=replace(two.points, given=np.where(at[:, None], one.points.given, two.points.given)))
    notes = compare(epoch(one), epoch(shared)).notes
    assert any("6 control points have the same given coordinates" in n for n in notes)
    assert not compare(epoch(one), epoch(shared), frame="common").notes


def test_what_makes_no_sense(free, controlled):
    one, two = epoch(measured(controlled, 1)), epoch(measured(controlled, 2))
    with pytest.raises(UsageError, match="units"):
        compare(one, replace(two, adjustment=replace(two.adjustment, network=replace(two.network, unit="mm"))))
    with pytest.raises(UsageError, match="at least 3 points"):
        compare(one, two, points=["P01", "P02"])
    with pytest.raises(UsageError, match="not free in both"):
        compare(one, two, points=["P01", "P02", "X"])
    with pytest.raises(UsageError, match="no coordinates of its own"):
        compare(epoch(measured(free, 1)), two, frame="given")
    with pytest.raises(UsageError, match="the frame"):
        compare(one, two, frame="other")


def test_folder_json_and_command(free, tmp_path):
    write(measured(free, 1), tmp_path / "a")
    write(measured(free, 2, MOVES), tmp_path / "b")
    run = CliRunner().invoke
    done = run(app, ["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "o"), "--strict"])
    assert done.exit_code == 1, done.output
    assert "2 points moved" in done.output
    document = json.loads((tmp_path / "o" / "result.json").read_text())
    assert document["schema"] == "baarda.comparison/1"
    assert sorted(document["localisation"]["moved"]) == ["P03", "P07"]
    assert "NaN" not in (tmp_path / "o" / "result.json").read_text()
    again = run(app, ["compare", str(tmp_path / "a"), str(tmp_path / "a"), "--json", "--quiet"])
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)["dependent"] is True
    assert run(app, ["compare", str(tmp_path / "a"), str(tmp_path / "none")]).exit_code == 2


def test_result_folders_are_epochs(free, tmp_path):
    folders = []
    for name, network in (("a", measured(free, 1)), ("b", measured(free, 2, MOVES))):
        (tmp_path / name).mkdir()
        write(baarda.adjust(network).network, tmp_path / name / "project")
        (tmp_path / name / "result.json").write_text('{\n "schema": "baarda.result/1"\n}\n')
        folders.append(str(tmp_path / name))
    done = CliRunner().invoke(app, ["compare", *folders, "--json", "--quiet"])
    assert done.exit_code == 0, done.output
    direct = result_json(compare(epoch(measured(free, 1)), epoch(measured(free, 2, MOVES))))
    found = json.loads(done.stdout)
    assert np.isclose(found["tests"][1]["statistic"], direct["tests"][1]["statistic"], rtol=1e-6)


def test_written_twice_is_the_same(controlled, tmp_path):
    c = compare(epoch(measured(controlled, 1)), epoch(measured(controlled, 2, MOVES)))
    one, two = (write_folder(c, tmp_path / n) for n in "ab")
    for name in ("result.json", "report.html", "tables/points.csv"):
        assert (one / name).read_bytes() == (two / name).read_bytes()
