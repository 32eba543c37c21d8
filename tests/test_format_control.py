"""A separate table of control and check points."""

from dataclasses import replace

import numpy as np
import pytest

import baarda.formats as formats
from baarda.adjustment import adjust
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import InputError
from baarda.formats.control import with_control
from baarda.geometry import rotation as rot
from baarda.geometry.similarity import Similarity
from baarda.network import CHECK, CONTROL, TIE, State
from networks import ring, with_distances

HEAD = "point,role,X,Y,Z,sigma_X,sigma_Y,sigma_Z\n"


def table(tmp_path, text):
    file = tmp_path / "gcp.csv"
    file.write_text(text, encoding="utf-8")
    return file


def rows(network, labels, role="control", sigma="0.01", factor=1.0):
    at = [network.points.labels.index(label) for label in labels]
    xyz = network.points.coordinates[at] * factor
    return "".join(
        f"{label},{role},{x!r},{y!r},{z!r},{sigma},{sigma},{sigma}\n" for label, (x, y, z) in zip(labels, xyz.tolist(), strict=True)
    )


def test_replaces_what_the_source_says(tmp_path):
    n = ring(control=4, checks=2)
    text = HEAD + "P7,,1.5,-0.5,0.25,0.01,0.02,0.03\nP8,check,1,1,0,,,0.05\nP9,control,0.5,0.5,0.5,0,0,0\nP10,,,,0.4,,,0.02\n"
    p = with_control(n, table(tmp_path, text)).points
    assert [p.labels[i] for i in np.flatnonzero(p.roles != TIE)] == ["P7", "P8", "P9", "P10"]
    assert p.roles[[7, 8, 9, 10]].tolist() == [CONTROL, CHECK, CONTROL, CONTROL]
    assert p.states[[0, 7, 8, 9, 10]].tolist() == [[FREE] * 3, [OBSERVED] * 3, [FREE] * 3, [FIXED] * 3, [FREE, FREE, OBSERVED]]
    assert p.given[7].tolist() == [1.5, -0.5, 0.25] and p.sigmas[7].tolist() == [0.01, 0.02, 0.03]
    assert np.isnan(p.given[:7]).all() and np.isnan(p.sigmas[:7]).all() and np.isnan(p.given[10, :2]).all()
    assert p.coordinates[9].tolist() == [0.5, 0.5, 0.5]  # a fixed coordinate has its given value
    np.testing.assert_array_equal(p.coordinates[7], n.points.coordinates[7])  # an observed one keeps its start value


def test_covariances(tmp_path):
    text = HEAD.replace("\n", ",correlation_XY,correlation_XZ,correlation_YZ\n") + "P7,,1,1,1,0.01,0.02,0.03,0.5,,-0.25\n"
    n = with_control(ring(), table(tmp_path, text))
    expected = [[1e-4, 1e-4, 0], [1e-4, 4e-4, -1.5e-4], [0, -1.5e-4, 9e-4]]
    np.testing.assert_allclose(n.points.covariance(np.array([7]))[0], expected, atol=1e-18)


def test_through_read(tmp_path):
    formats.write(ring(control=3), tmp_path / "p", "project")
    n = formats.read(tmp_path / "p", control=table(tmp_path, "point,X,Y,Z\nP5,1,2,3\nP6,3,2,1\nelsewhere,0,0,0\n"))
    assert n.points.states[5].tolist() == [FIXED] * 3 and n.points.roles[0] == TIE
    assert n.assumptions[-2:] == (
        "3 control point(s) without sigma: held fixed",
        "1 point(s) of gcp.csv are not measured and left out: elsewhere",
    )


def test_a_model_without_datum_is_carried_over(tmp_path):
    n = ring(images=5, points=20, seed=1)
    truth = Similarity(37.5, rot.from_angles(0.4, -0.3, 2.0), np.array([4000.0, -2000.0, 300.0]))
    labels = [f"P{k}" for k in (1, 5, 9, 14)]
    world = replace(n, points=replace(n.points, coordinates=truth.apply(n.points.coordinates)))
    text = HEAD + rows(world, labels, sigma="0.5") + rows(world, ["P3"], role="check", sigma="")
    m = with_control(replace(n, unit="model units"), table(tmp_path, text))
    assert m.unit == "m" and "from model units" in m.assumptions[-1] and "scale 37.5" in m.assumptions[-1]
    np.testing.assert_allclose(m.points.coordinates, world.points.coordinates, atol=1e-8)
    # the same rays: nothing changes in the images
    group = n.observations[0]
    np.testing.assert_allclose(group.misclosures(m, State.of(m)), group.misclosures(n, State.of(n)), atol=1e-7)
    result = adjust(m)
    assert result.status == "converged" and result.datum.name == "control"
    np.testing.assert_allclose(result.network.points.coordinates[3], world.points.coordinates[3], atol=2.0)


BROKEN = {
    "empty": ("", None, "empty"),
    "no rows": (HEAD, 1, "no rows"),
    "unknown column": ("point,X,Y,Z,code\nP1,1,1,1,a\n", 1, "unknown column 'code'"),
    "given": ("point,X,Y,Z,given_X\nP1,1,1,1,1\n", 1, "unknown column 'given_X'"),
    "missing column": ("point,X,Y\nP1,1,1\n", 1, "'Z' is missing"),
    "truncated": (HEAD + "P1,control,1,1,1,1\n", 2, "6 fields"),
    "twice": (HEAD + "P1,,1,1,1,1,1,1\nP1,,1,1,1,1,1,1\n", 3, "'P1' appears twice (first in line 2)"),
    "NaN": (HEAD + "P1,,1,nan,1,1,1,1\n", 2, "Y is not finite"),
    "word": (HEAD + "P1,,1,one,1,1,1,1\n", 2, "Y is not a number: 'one'"),
    "negative sigma": (HEAD + "P1,,1,1,1,1,1,-1\n", 2, "sigma_Z must not be negative"),
    "sigma missing": (HEAD + "P1,,1,1,1,1,1,\n", 2, "sigma_Z is missing"),
    "coordinate missing": (HEAD + "P1,,1,,1,1,1,1\n", 2, "Y is observed, but its given value is missing"),
    "no coordinates": (HEAD + "P1,,,,,,,\n", 2, "without given coordinates"),
    "tie": (HEAD + "P2,,1,1,1,1,1,1\nP1,tie,1,1,1,,,\n", 3, "must be control or check"),
    "huge sigma": (HEAD + "P1,,1,1,1,1,1e200,1\n", 2, "the sigma of a coordinate = 1e+200"),
    "control character": (HEAD + "P\x011,,1,1,1,1,1,1\n", 2, "control character"),
    "role": (HEAD + "P1,GCP,1,1,1,1,1,1\n", 2, "role must be one of"),
    "not in the network": (HEAD + "Q1,,1,1,1,1,1,1\n", 2, "no point of the table is in the network, whose points are called P0, P1"),
    "free": ("point,X,Y,Z,state_X,state_Y,state_Z\nP1,1,1,1,free,free,free\n", 2, "no coordinate is fixed or observed"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_tables_are_refused_with_file_and_line(name, tmp_path):
    text, line, message = BROKEN[name]
    with pytest.raises(InputError) as caught:
        with_control(ring(), table(tmp_path, text))
    assert caught.value.file.endswith("gcp.csv") and caught.value.line == line, str(caught.value)
    assert message in str(caught.value)


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "mm"), (0.001, "km"), (100.0, "cm")])
def test_control_in_the_wrong_unit(factor, unit, tmp_path):
    n = ring()
    with pytest.raises(InputError, match=rf"gcp.csv, line 2: .*are the control coordinates in {unit} and not in m\?"):
        with_control(n, table(tmp_path, HEAD + rows(n, ["P1", "P2", "P3"], factor=factor)))


@pytest.mark.parametrize(
    ("change", "labels", "message"),
    [
        (lambda n: n, ["P1", "P2"], "at least 3 points"),
        (lambda n: with_distances(n, [(0, 1)]), ["P1", "P2", "P3"], "in model units"),
    ],
)
def test_a_model_that_cannot_be_carried_over(change, labels, message, tmp_path):
    n = change(replace(ring(), unit="model units"))
    with pytest.raises(InputError, match=message):
        with_control(n, table(tmp_path, HEAD + rows(n, labels)))


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "mm"), (0.001, "km")])
def test_control_in_the_wrong_unit_when_only_cameras_start(factor, unit, tmp_path):
    n = ring()
    text = HEAD + rows(n, ["P1", "P2", "P3", "P4"], factor=factor) + rows(n, ["P5", "P6"], role="check", sigma="", factor=factor)
    # the control's centre is not the origin: in the wrong unit it moves away from the cameras as far as it spreads
    n = replace(n, points=replace(n.points, coordinates=np.full_like(n.points.coordinates, np.nan)))
    with pytest.raises(InputError, match=rf"gcp.csv, line 2: .*are the control coordinates in {unit} and not in m\?") as caught:
        with_control(n, table(tmp_path, text))
    assert caught.value.exit_code == 2


def test_control_in_one_corner_of_a_large_block_is_taken(tmp_path):
    n = ring()
    text = HEAD + rows(n, ["P1", "P2", "P3"])
    away = n.images.position + np.linspace(0.0, 5000.0, len(n.images.labels))[:, None] * [1.0, 0.0, 0.0]
    n = replace(n, images=replace(n.images, position=away), points=replace(n.points, coordinates=np.full((24, 3), np.nan)))
    assert (with_control(n, table(tmp_path, text)).points.roles == CONTROL).sum() == 3


def test_no_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        with_control(ring(), tmp_path / "none.csv")
