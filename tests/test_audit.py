"""Audit: what a solution is as it stands, and its distance from the minimum against known displacements."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.cameras import FIXED
from baarda.cli import app
from baarda.errors import UsageError
from baarda.formats import read, write
from baarda.geometry import rotation as rot
from baarda.network import State
from baarda.procedures.audit import audit, suspected
from networks import ring


@pytest.fixture(scope="module")
def minimum():
    return baarda.adjust(ring(control=5, noise=0.4))


def test_the_minimum_itself(minimum):
    a = audit(minimum.network)
    assert a.excess == pytest.approx(0.0, abs=1e-9)
    assert a.distance < 1e-4
    assert np.nanmax(np.abs(a.differences["ratio"])) < 1e-4
    np.testing.assert_allclose(a.residuals, minimum.residuals, atol=1e-6)
    assert all(not np.any(t.rejected) or t.name == "data_snooping" for t in a.tests)


def test_a_point_that_was_moved(minimum):
    names = ["point P9: X", "point P9: Y", "point P9: Z"]
    covariance = minimum.covariance(names)
    step = 4.0 * np.linalg.cholesky(covariance)[:, 0]
    points = minimum.network.points
    coordinates = np.array(points.coordinates)
    coordinates[9] += step
    a = audit(replace(minimum.network, points=replace(points, coordinates=coordinates)))
    t = a.differences
    at = [t["name"].tolist().index(n) for n in names]
    np.testing.assert_allclose(t["difference"][at], -step, rtol=1e-3)
    assert t["ratio"][at[0]] == pytest.approx(-4.0, rel=1e-3)
    # all other unknowns stand at the minimum: the growth of v'Pv is that of the point with everything else held
    rest = np.delete(np.abs(t["ratio"]), at)
    assert rest.max() < 1e-3
    normal = np.linalg.inv(minimum.covariance(list(minimum.numbering.names), sigma="apriori"))
    columns = [minimum.numbering.column(n) for n in names]
    grown = step @ normal[np.ix_(columns, columns)] @ step
    assert a.objective - a.adjustment.objective == pytest.approx(grown, rel=0.02)
    assert a.distance == pytest.approx(np.sqrt(grown / minimum.variance_factor / minimum.numbering.count), rel=0.02)
    assert {minimum.network.points.labels[i] for i in a.adjustment.evidence.points[suspected(a)[:3]]} == {"P9"}
    worst = {group: at for group, _, _, _, at in a.by_group()}
    assert worst["point"].startswith("point P9")


def test_an_image_that_was_turned(minimum):
    turn = np.array([2e-3, -1e-3, 5e-4])
    rotation = np.array(minimum.network.images.rotation)
    rotation[2] = rot.exp(turn) @ rotation[2]
    a = audit(replace(minimum.network, images=replace(minimum.network.images, rotation=rotation)))
    t = a.differences
    at = [t["name"].tolist().index(f"image I2: {k}") for k in ("omega", "phi", "kappa")]
    np.testing.assert_allclose(t["difference"][at], -turn, rtol=1e-3, atol=1e-7)
    assert a.distance > 1.0
    state = State.of(a.adjustment.start)
    group = a.adjustment.start.observations[0]
    own = group.misclosures(a.adjustment.start, state)
    assert a.image_rms[0] == pytest.approx(np.sqrt(np.mean(own**2)), rel=1e-9)


def test_conditional_sigmas_are_those_with_cameras_held(minimum):
    a = audit(minimum.network)
    network = minimum.network
    cameras = tuple(replace(c, states=np.full(len(c.states), FIXED, dtype=np.int8)) for c in network.cameras)
    images = replace(network.images, states=np.full((len(network.images.labels), 6), FIXED, dtype=np.int8))
    held = baarda.adjust(replace(network, cameras=cameras, images=images))
    share = np.sqrt(np.einsum("nii->ni", held.point_cofactors) / np.einsum("nii->ni", minimum.point_cofactors))
    assert a.conditional_share == pytest.approx((np.median(share), share.min()), rel=1e-4)
    assert share.min() < 0.9


def test_a_free_network_is_compared_in_its_own_datum():
    a = audit(baarda.adjust(ring(noise=0.4)).network)
    assert a.adjustment.datum.defect.count == 7
    assert np.nanmax(np.abs(a.differences["ratio"])) < 1e-4


def test_what_cannot_be_audited(minimum):
    network = minimum.network
    position = np.array(network.images.position)
    position[1] = np.nan
    with pytest.raises(UsageError, match="no orientation of image I1"):
        audit(replace(network, images=replace(network.images, position=position)))
    with pytest.raises(UsageError, match="law of errors"):
        audit(network, robust="huber")


def test_opensfm_and_colmap(data):
    berlin = audit(read(data("opensfm_berlin")))
    assert berlin.objective == pytest.approx(18737.63, abs=0.01)
    assert berlin.image_rms == pytest.approx((1.7424, 1.4301), abs=2e-4)
    assert berlin.distance == pytest.approx(0.457, abs=2e-3)
    assert max(largest for _, _, _, largest, _ in berlin.by_group()) > 5.0
    sceaux = audit(read(data("colmap_sceaux_txt")))
    assert sceaux.excess < 1e-3
    assert sceaux.distance == pytest.approx(0.0344, abs=5e-4)


def test_command_line(minimum, tmp_path):
    write(ring(control=5, noise=0.4), tmp_path / "block", "project")
    run = CliRunner().invoke(app, ["adjust", str(tmp_path / "block"), "--audit", "--out", str(tmp_path / "out"), "--quiet"])
    assert run.exit_code == 0, run.output
    found = json.loads((tmp_path / "out" / "result.json").read_text())["audit"]
    assert found["distance"] > 1.0
    assert found["minimum"] == pytest.approx(minimum.objective, rel=1e-6)
    page = (tmp_path / "out" / "report.html").read_text()
    assert 'id="audit"' in page
    assert "it is not the least-squares solution of these observations" in page
    refused = CliRunner().invoke(app, ["adjust", str(tmp_path / "block"), "--audit", "--snoop", "--out", str(tmp_path / "other")])
    assert refused.exit_code == 2
