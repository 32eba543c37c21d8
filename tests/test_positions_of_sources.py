"""Measured camera positions that a source holds: OpenSfM's GPS, Metashape's references, as observations when they are asked for."""

import json
import zipfile

import numpy as np
import pytest

import baarda
import test_format_metashape
import test_format_opensfm
from baarda.errors import InputError, UsageError
from baarda.formats import read, write
from baarda.formats.camera_positions import with_camera_positions
from baarda.network import State
from baarda.observations import CameraPositions
from networks import ring
from test_cli import run


def opensfm(folder, **shot):
    test_format_opensfm.scene(folder)
    file = folder / "reconstruction.json"
    model = json.loads(file.read_text())
    for k, s in enumerate(model[0]["shots"].values()):
        r, t = test_format_opensfm.rodrigues(np.array(s["rotation"])), np.array(s["translation"])
        s.update({"gps_position": (-r.T @ t).tolist(), "gps_dop": 0.5, "capture_time": 1e9 + 2.0 * k, **shot})
    file.write_text(json.dumps(model, indent=1))
    return folder


def test_opensfm(tmp_path):
    network = with_camera_positions(read(opensfm(tmp_path)), "source", model="shift")
    group = network.observations[-1]
    assert isinstance(group, CameraPositions) and (group.sigma() == 0.5).all()
    assert np.abs(group.misclosures(network, State.of(network))).max() < 1e-12
    assert group.times.tolist() == [-2.0, 0.0, 2.0]
    assert any("gps_dop" in a for a in network.assumptions)


def test_opensfm_names_its_frame_in_a_file_of_its_own(tmp_path):
    test_format_opensfm.scene(tmp_path, reference=False)
    assert read(tmp_path).unit == "model units"
    (tmp_path / "reference_lla.json").write_text('{"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}')
    network = read(tmp_path)
    assert network.unit == "m" and network.settings["reference_lla"] == (52.5, 13.4, 30.0)
    (tmp_path / "reference_lla.json").write_text('{"latitude": "x"}')
    with pytest.raises(InputError, match="latitude: must be a number"):
        read(tmp_path)


def test_opensfm_without_a_precision_takes_its_usual_one(tmp_path):
    network = with_camera_positions(read(opensfm(tmp_path, gps_dop=None)), "source")
    assert (network.observations[-1].sigma() == 15.0).all()
    assert any("3 shot(s) have no gps_dop" in a for a in network.assumptions)


@pytest.mark.parametrize("value", [0.0, -1.0, 1e9, "5", True])
def test_opensfm_refuses_what_is_no_precision(tmp_path, value):
    opensfm(tmp_path, gps_dop=value)
    with pytest.raises(InputError, match=r"gps_dop") as caught:
        with_camera_positions(read(tmp_path), "source")
    assert caught.value.line > 1


def metashape(folder, crs, accuracy=""):
    """Give every camera its own projection centre as reference, longitude first where the system is geographic."""
    path, _ = test_format_metashape.psz(folder, crs=crs)
    network = read(path)
    position = network.images.position
    if crs == test_format_metashape.WGS84:
        note = next(a for a in network.assumptions if "touches the ellipsoid" in a)
        latitude, longitude = (float(note.split(w)[1].split(",")[0]) for w in ("latitude ", "longitude "))
        from baarda.geometry.tangent_frame import TangentFrame

        position = TangentFrame(latitude, longitude, 0.0).geographic(position)[:, [1, 0, 2]]
    with zipfile.ZipFile(path) as z:
        parts = {n: z.read(n) for n in z.namelist()}
    doc = parts["doc.xml"].decode()
    for label, p in zip(network.images.labels, position.tolist(), strict=True):
        before = f'label="{label}">'
        assert before in doc
        doc = doc.replace(before, f'{before}<reference x="{p[0]!r}" y="{p[1]!r}" z="{p[2]!r}" {accuracy} enabled="true"/>')
    test_format_metashape.zipped(path, {**parts, "doc.xml": doc})
    return path


@pytest.mark.parametrize("crs", [test_format_metashape.LOCAL, test_format_metashape.WGS84])
def test_metashape(tmp_path, crs):
    network = with_camera_positions(read(metashape(tmp_path, crs, 'sxy="0.02" sz="0.04"')), "source")
    group = network.observations[-1]
    assert len(group) == 4
    np.testing.assert_allclose(group.sigma(), np.tile([0.02, 0.02, 0.04], (4, 1)))
    assert np.abs(group.misclosures(network, State.of(network))).max() < 1e-6
    assert baarda.adjust(network).status == "converged"


def test_metashape_accuracies_of_the_chunk_and_of_a_camera(tmp_path):
    path = metashape(tmp_path, test_format_metashape.LOCAL, 'sxyz="0.03"')
    assert (with_camera_positions(read(path), "source").observations[-1].sigma() == 0.03).all()
    path.unlink()
    network = with_camera_positions(read(metashape(tmp_path, test_format_metashape.LOCAL)), "source")
    assert (network.observations[-1].sigma() == 10.0).all()
    assert any("accuracy_cameras is not said" in a for a in network.assumptions)


def test_sources_without_positions_say_so(tmp_path, data):
    with pytest.raises(UsageError, match=r"colmap holds no measured camera positions.*opensfm"):
        with_camera_positions(read(data("colmap_sceaux_txt")), "source")
    test_format_opensfm.scene(tmp_path)
    with pytest.raises(InputError, match="no shot has a gps_position"):
        with_camera_positions(read(tmp_path), "source")


def test_the_command_line(tmp_path):
    """A free ring gets scale, place and orientation from its GPS positions; their residuals are tested like all others."""
    values = {"principal_distance": 1000.0, "principal_point_x": 499.5, "principal_point_y": 399.5, "k1": -0.02, "k2": 0.0}
    network = ring(images=8, points=40, noise=0.5, model="RADIAL", values=values, free=("principal_distance", "k1"))
    write(network, tmp_path / "block", "opensfm")
    file = tmp_path / "block" / "reconstruction.json"
    model = json.loads(file.read_text())
    rng = np.random.default_rng(3)
    for s in model[0]["shots"].values():
        r, t = test_format_opensfm.rodrigues(np.array(s["rotation"])), np.array(s["translation"])
        s.update({"gps_position": (-r.T @ t + 0.05 * rng.standard_normal(3)).tolist(), "gps_dop": 0.05})
    model[0]["reference_lla"] = {"latitude": 52.0, "longitude": 13.0, "altitude": 40.0}
    file.write_text(json.dumps(model))
    out = tmp_path / "out"
    done = run("adjust", str(tmp_path / "block"), "--camera-positions", "source", "--position-model", "none", "--out", str(out), "--quiet")
    assert done.returncode == 0, done.stderr
    result = json.loads((out / "result.json").read_text())
    assert result["counts"]["observations"] - result["counts"]["image_observations"] == 24
    assert result["counts"]["datum_defect"] == 0 and 0.4 < result["sigma0"]["aposteriori"] < 0.65  # 0.5 px, where 1 px is assumed


def test_a_real_block(data):
    """Positions of three images in a row, 5 m each, beside a block in the same frame."""
    network = with_camera_positions(read(data("opensfm_berlin")), "source")
    group = network.observations[-1]
    assert len(group) == 3 and (group.sigma() == 5.0).all()
    assert np.abs(group.misclosures(network, State.of(network))).max() < 15.0
