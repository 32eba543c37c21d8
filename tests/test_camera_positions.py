"""Measured camera positions: derivatives, lever arm, shift and drift recovered, datum, tables, projects, command line."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.cli import app
from baarda.errors import InputError, UsageError
from baarda.formats import read, write
from baarda.formats.camera_positions import with_camera_positions
from baarda.geometry import rotation as rot
from baarda.network import State, unknowns_of
from networks import ring

ARM, SHIFT, DRIFT = np.array([0.1, 0.2, -0.3]), np.array([0.5, -0.2, 0.1]), np.array([0.02, 0.0, -0.01])


def table(path, network, arm=ARM, shift=SHIFT, drift=0.0 * DRIFT, noise=0.0, strips=1, seed=0, sigma=0.002):
    """Write positions of the antennas of a network taken as truth."""
    rng = np.random.default_rng(seed)
    images = network.images
    lines = ["image,X,Y,Z,sigma_X,sigma_Y,sigma_Z,correlation_XY,strip,time"]
    for i, label in enumerate(images.labels):
        g = images.position[i] + images.rotation[i].T @ arm + shift + (i - (len(images.labels) - 1) / 2) * drift
        g = g + noise * rng.standard_normal(3)
        lines.append(f"{label},{g[0]!r},{g[1]!r},{g[2]!r},{sigma},{sigma},{2 * sigma},0.3,{i % strips},{100 + i}".replace("np.float64", ""))
    path.write_text("\n".join(lines).replace("(", "").replace(")", "") + "\n")
    return path


@pytest.fixture(scope="module")
def truth():
    return baarda.adjust(ring(images=8, points=30, control=6)).network


def test_partials_against_differences(truth, tmp_path):
    network = with_camera_positions(truth, table(tmp_path / "p.csv", truth), "free:0.3,-0.2,0.1", "drift")
    group = network.observations[-1]
    state = State.of(network)
    unknowns = unknowns_of(network)
    rows = group.linearize(network, state)[0]
    dense = np.zeros((3 * len(group), unknowns.count))
    for block in rows.blocks:
        columns = unknowns[block.kind].of(block.nodes, block.jacobian.shape[2])
        for i, at in enumerate(columns):
            free = at >= 0
            dense[3 * i : 3 * i + 3, at[free]] += block.jacobian[i][:, free]
    used = np.flatnonzero(np.abs(dense).sum(axis=0))
    assert len(used) == 8 * 6 + 3 + 6
    for column in used:
        step = np.zeros(unknowns.count)
        step[column] = 1e-6
        up, down = (group.misclosures(network, state.moved(unknowns, s)) for s in (step, -step))
        np.testing.assert_allclose(-(up - down).ravel() / 2e-6, dense[:, column], atol=1e-7)


@pytest.mark.parametrize("solver", ["dense", "block"])
def test_exact_positions_give_arm_shift_and_drift_back(truth, tmp_path, solver):
    path = table(tmp_path / "p.csv", truth, drift=DRIFT, sigma=1e-6)
    result = baarda.adjust(with_camera_positions(truth, path, "free", "drift"), solver=solver)
    found = dict(zip(result.unknowns["name"], result.unknowns["value"], strict=True))
    for k, axis in enumerate("xyz"):
        assert found[f"lever_arm 1: {axis}"] == pytest.approx(ARM[k], abs=2e-5)
        assert found[f"strip 0: shift_{axis.upper()}"] == pytest.approx(SHIFT[k], abs=2e-5)
        assert found[f"strip 0: drift_{axis.upper()}"] == pytest.approx(DRIFT[k], abs=2e-5)
    assert result.redundancy_numbers.sum() == pytest.approx(result.redundancy, rel=1e-9)
    rows = result.observations["group"] == "camera positions"
    assert rows.sum() == 24
    assert set(result.observations["component"][rows]) == {"X0", "Y0", "Z0"}


def test_positions_carry_a_free_network_over_and_define_its_datum(tmp_path):
    free = baarda.adjust(ring(images=8, points=30)).network
    turn, scale, shift = rot.exp(np.array([0.2, -0.4, 1.0])), 7.0, np.array([4e5, 5e6, 300.0])
    images = replace(free.images, position=scale * free.images.position @ turn.T + shift, rotation=free.images.rotation @ turn.T)
    moved = replace(free, images=images)
    path = table(tmp_path / "p.csv", moved, arm=np.zeros(3), shift=np.zeros(3))
    network = with_camera_positions(free, path)
    assert any("carried over to 8 camera positions (scale 7, rms distance" in a for a in network.assumptions)
    result = baarda.adjust(network)
    assert result.datum.defect.count == 0
    np.testing.assert_allclose(result.network.images.position, images.position, atol=0.02)
    rows = result.observations["group"] == "camera positions"
    np.testing.assert_allclose(result.observations["observed"][rows].reshape(-1, 3), images.position, atol=1e-6)


def test_a_free_shift_leaves_three_freedoms(tmp_path):
    free = baarda.adjust(ring(images=8, points=30)).network
    path = table(tmp_path / "p.csv", free, arm=np.zeros(3))
    result = baarda.adjust(with_camera_positions(free, path, model="shift"))
    assert result.datum.defect.count == 3
    assert set(result.datum.defect.free) == {"shift along X", "shift along Y", "shift along Z"}


def test_a_project_keeps_positions(truth, tmp_path):
    path = table(tmp_path / "p.csv", truth, strips=2)
    network = with_camera_positions(truth, path, "free", "shift")
    write(network, tmp_path / "project", "project")
    again = read(tmp_path / "project")
    a, b = network.observations[-1], again.observations[-1]
    for name in ("images", "arms", "lines", "times", "values"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_allclose(b.covariances, a.covariances, rtol=1e-12)
    assert [d.kind for d in again.declared] == ["lever_arm", "strip"]
    np.testing.assert_array_equal(again.declared[1].states, network.declared[1].states)
    assert baarda.adjust(again).objective == pytest.approx(baarda.adjust(network).objective, rel=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("I3,", "I2,", 5, "image 'I2' appears twice"),
        (",0.002,", ",0.0,", 2, "must be positive"),
        (",0.002,", ",,", 2, "sigma_X is missing"),
        (",0.3,0,", ",1.3,0,", 2, "correlations"),
        ("image,X", "image,E", 1, "unknown column 'E'"),
    ],
)
def test_damaged_tables(truth, tmp_path, old, new, line, words):
    path = table(tmp_path / "p.csv", truth)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        with_camera_positions(truth, path)
    assert caught.value.line == line


def test_options_that_make_no_sense(truth, tmp_path):
    path = table(tmp_path / "p.csv", truth)
    for options in ({"lever_arm": "1,2"}, {"lever_arm": "free:x"}, {"lever_arm": "nan,0,0"}, {"model": "spline"}):
        with pytest.raises(UsageError):
            with_camera_positions(truth, path, **options)
    with pytest.raises(UsageError, match="already"):
        with_camera_positions(with_camera_positions(truth, path), path)
    path.write_text(path.read_text().replace(",time", ",zeit", 1))
    with pytest.raises(InputError, match="unknown column"):
        with_camera_positions(truth, path)


def test_command_line(truth, tmp_path):
    write(truth, tmp_path / "block", "project")
    path = table(tmp_path / "p.csv", truth)
    arguments = ["adjust", str(tmp_path / "block"), "--out", str(tmp_path / "out"), "--camera-positions", str(path), "--lever-arm", "free"]
    arguments += [
        "--position-model",
        "shift",
        "--covariance",
        str(tmp_path / "covariance"),
        "--points",
        str(tmp_path / "points.csv"),
        "--quiet",
    ]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "covariance" / "index.csv").is_file()
    assert (tmp_path / "points.csv").is_file()
    assert "lever_arm 1: x" in (tmp_path / "out" / "tables" / "unknowns.csv").read_text()
    alone = CliRunner().invoke(app, ["adjust", str(tmp_path / "block"), "--lever-arm", "free", "--out", str(tmp_path / "other")])
    assert alone.exit_code == 2
