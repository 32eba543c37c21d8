"""OpenSfM data sets: the convention against its documentation, damaged files, writing; lists of ground control."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.errors import InputError, MissingExtra, UsageError
from baarda.formats import read, recognise, write
from baarda.geometry.tangent_frame import TangentFrame
from baarda.network import CHECK, CONTROL, State

W, H = 400, 300
CAMERAS = {
    "perspective": {"focal": 0.9, "k1": -0.05, "k2": 0.01},
    "simple_radial": {"focal_x": 0.9, "focal_y": 0.91, "c_x": 0.01, "c_y": -0.02, "k1": -0.05},
    "radial": {"focal_x": 0.9, "focal_y": 0.91, "c_x": 0.01, "c_y": -0.02, "k1": -0.05, "k2": 0.02},
    "brown": {"focal_x": 0.9, "focal_y": 0.91, "c_x": 0.01, "c_y": -0.02, "k1": -0.05, "k2": 0.02, "k3": 0.01, "p1": 1e-3, "p2": -2e-3},
}
ORIGIN = (52.5, 13.4, 30.0)


def rodrigues(v):
    t = np.linalg.norm(v)
    a = np.asarray(v) / t
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(t) * k + (1 - np.cos(t)) * k @ k


def project(camera, rotation, translation, point):
    """OpenSfM's documentation, geometry: normalised image coordinates of a world point."""
    x, y, z = rodrigues(rotation) @ point + translation
    assert z > 0
    x, y = x / z, y / z
    r2 = x * x + y * y
    k1, k2, k3, p1, p2 = (camera.get(k, 0.0) for k in ("k1", "k2", "k3", "p1", "p2"))
    d = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = d * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = d * y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    fx, fy = camera.get("focal_x", camera.get("focal")), camera.get("focal_y", camera.get("focal"))
    return float(fx * u + camera.get("c_x", 0.0)), float(fy * v + camera.get("c_y", 0.0))


def scene(folder, kind="perspective", version=2, points=12, shots=3, reference=True):
    """Write a data set in OpenSfM's convention; return its camera, shots and points."""
    rng = np.random.default_rng(5)
    camera = {"projection_type": kind, "width": W, "height": H, **CAMERAS[kind]}
    xyz = rng.uniform(-2, 2, (points, 3)) + np.array([0, 0, 8])
    pose = {f"{i}.jpg": (rng.uniform(-0.2, 0.2, 3), rng.uniform(-1, 1, 3)) for i in range(shots)}
    model = {
        "cameras": {"v2 c": camera},
        "shots": {k: {"rotation": list(r), "translation": list(t), "camera": "v2 c"} for k, (r, t) in pose.items()},
        "points": {str(i): {"color": [0, 0, 0], "coordinates": list(p)} for i, p in enumerate(xyz)},
    }
    if reference:
        model["reference_lla"] = dict(zip(("latitude", "longitude", "altitude"), ORIGIN, strict=True))
    (folder / "reconstruction.json").write_text(json.dumps([model], indent=1))
    tail = {0: "", 1: "\t0.001", 2: "\t0.001"}[version] + "\t1\t2\t3" + ("\t-1\t-1" if version == 2 else "")
    lines = [f"OPENSFM_TRACKS_VERSION_v{version}"] if version else []
    for k, (r, t) in pose.items():
        for i, p in enumerate(xyz):
            x, y = project(camera, r, t, p)
            lines.append(f"{k}\t{i}\t{i}\t{x!r}\t{y!r}{tail}")
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    return camera, pose, xyz


def misclosures(network):
    state = State.of(network)
    return np.concatenate([g.misclosures(network, state).ravel() for g in network.observations])


@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize("version", [0, 1, 2])
def test_the_documented_projection_gives_zero_residuals(tmp_path, kind, version):
    scene(tmp_path, kind, version)
    assert recognise(tmp_path).name == recognise(tmp_path / "reconstruction.json").name == "opensfm"
    network = read(tmp_path)
    assert network.unit == "m"
    assert len(misclosures(network)) == 72
    assert np.abs(misclosures(network)).max() < 1e-9


@pytest.mark.parametrize("kind", CAMERAS)
def test_round_trip(tmp_path, kind):
    scene(tmp_path, kind)
    network = read(tmp_path)
    write(network, tmp_path / "out", "opensfm")
    again = read(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "reconstruction.json").read_text())[0]["cameras"]["v2 c"]["projection_type"] == kind
    assert again.cameras[0].model.name == network.cameras[0].model.name
    np.testing.assert_allclose(again.cameras[0].values, network.cameras[0].values, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(again.cameras[0].states, network.cameras[0].states)
    np.testing.assert_allclose(again.images.position, network.images.position, atol=1e-12)
    np.testing.assert_array_equal(again.points.coordinates, network.points.coordinates)
    np.testing.assert_allclose(again.observations[0].xy, network.observations[0].xy, atol=1e-10)
    assert again.settings == network.settings


def test_pixels_of_colmap_move_by_half(data, tmp_path):
    source = read(data("colmap_sceaux_txt"))
    group = source.observations[0]
    once = np.unique(group.images * len(source.points.labels) + group.points, return_index=True)[1]
    source = replace(source, observations=(group.selected(once),))  # COLMAP permits repeated marks
    write(source, tmp_path / "out", "opensfm")
    again = read(tmp_path / "out")
    np.testing.assert_allclose(np.sort(misclosures(again)), np.sort(misclosures(source)), atol=1e-8)
    at = [k for k, name in enumerate(again.cameras[0].model.order) if name.startswith("principal_point")]
    old = dict(zip(source.cameras[0].model.order, source.cameras[0].values, strict=True))
    np.testing.assert_allclose(again.cameras[0].values[at], [old["principal_point_x"] - 0.5, old["principal_point_y"] - 0.5], rtol=1e-14)


@pytest.mark.parametrize(
    ("file", "old", "new", "line", "words"),
    [
        (
            "reconstruction.json",
            '"perspective"',
            '"fisheye"',
            5,
            "cameras.v2 c.projection_type: projection type 'fisheye' is not supported; supported are",
        ),
        ("reconstruction.json", '"width": 400', '"width": 0', 6, "width: must be a whole number from 1"),
        ("reconstruction.json", '"focal": 0.9', '"focal": -0.9', 8, "focal must be there and positive"),
        ("reconstruction.json", '"focal": 0.9', '"focal": NaN', 8, "NaN is not a JSON number"),
        ("reconstruction.json", '"focal": 0.9', '"focal": 1e999', 8, "focal: inf is beyond"),
        ("reconstruction.json", '"focal": 0.9', '"focal": true', 8, "must be a number, not true or false"),
        ("reconstruction.json", '"camera": "v2 c"', '"camera": "other"', 25, "camera 'other' is not among the cameras"),
        ("reconstruction.json", '"0.jpg"', '"0.jpg\\n"', 14, "control character"),
        ("reconstruction.json", '"1.jpg"', '"0.jpg"', 27, "key '0.jpg' appears twice"),
        ("tracks.csv", "_v2", "_v9", 1, "version of tracks is not supported"),
        ("tracks.csv", "0.jpg\t1\t1\t", "0.jpg\t0\t1\t", 3, "measured twice in this image .first in line 2."),
        ("tracks.csv", "0.jpg\t1\t1\t", "0.jpg\t1\t1\tx\t", 3, "12 fields, parted by tabs, where 11 are expected"),
        ("tracks.csv", "0.jpg\t1\t1\t", "0.jpg\t1\t1\t1e5", 3, "must be numbers|beyond all images"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, file, old, new, line, words):
    scene(tmp_path)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, format="opensfm")
    assert caught.value.line == line
    assert caught.value.file.endswith(file)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '[{"cameras": {}}]', "[]", "[{}", '[{"cameras": {}, "shots": {}, "points": {}}]', "[1" + "0" * 5000 + "]"]
)
def test_hostile_reconstructions(tmp_path, text):
    scene(tmp_path)
    (tmp_path / "reconstruction.json").write_text(text)
    with pytest.raises(InputError):
        read(tmp_path, format="opensfm")


def test_the_largest_reconstruction_is_used(tmp_path):
    scene(tmp_path)
    root = json.loads((tmp_path / "reconstruction.json").read_text())
    small = {**root[0], "shots": dict(list(root[0]["shots"].items())[:1])}
    (tmp_path / "reconstruction.json").write_text(json.dumps([small, *root]))
    network = read(tmp_path)
    assert len(network.images.labels) == 3
    assert any("2 reconstructions: the largest, with 3 of 4 shots" in a for a in network.assumptions)


def control_list(folder, system, coordinates, pose, camera, xyz, names=True):
    lines = [system]
    for i, c in enumerate(coordinates):
        for k, (r, t) in pose.items():
            x, y = project(camera, r, t, xyz[i])
            px, py = x * W + (W - 1) / 2, y * W + (H - 1) / 2
            lines.append(" ".join([*(repr(float(v)) for v in c), repr(float(px)), repr(float(py)), k, *([f"T{i}"] if names else [])]))
    path = folder / "list.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_local_list_as_control(tmp_path):
    camera, pose, xyz = scene(tmp_path)
    path = control_list(tmp_path, "LOCAL", 2.0 * xyz[:5] + [100.0, 0.0, 0.0], pose, camera, xyz)
    network = baarda.read(tmp_path, control=path)
    assert network.points.labels[-5:] == ("T0", "T1", "T2", "T3", "T4")
    assert (network.points.roles[-5:] == CONTROL).all()
    assert any("scale 2, rms distance" in a for a in network.assumptions)
    assert np.abs(misclosures(network)).max() < 1e-8
    np.testing.assert_allclose(network.points.sigmas[-1], [0.01, 0.01, 0.1])
    result = baarda.adjust(network, camera=())
    assert result.datum.defect.count == 0
    assert result.objective < 1e-12


def test_a_local_list_carries_model_units_over(tmp_path):
    camera, pose, xyz = scene(tmp_path, reference=False)
    path = control_list(tmp_path, "LOCAL", 3.0 * xyz[:4], pose, camera, xyz, names=False)
    network = baarda.read(tmp_path, control=path)
    assert network.unit == "m"
    assert network.points.labels[-4:] == ("gcp 1", "gcp 2", "gcp 3", "gcp 4")
    assert np.abs(misclosures(network)).max() < 1e-8


def test_geographic_coordinates_meet_the_frame_of_the_source(tmp_path):
    camera, pose, xyz = scene(tmp_path)
    frame = TangentFrame(*ORIGIN)
    lla = np.array([ORIGIN] * 4)
    for _ in range(20):  # the inverse of the frame by Newton steps of a sphere
        d = frame.local(lla) - xyz[:4]
        lla[:, 0] -= np.degrees(d[:, 1] / 6371e3)
        lla[:, 1] -= np.degrees(d[:, 0] / 6371e3 / np.cos(np.radians(52.5)))
        lla[:, 2] -= d[:, 2]
    network = baarda.read(tmp_path, control=control_list(tmp_path, "WGS84", lla[:, [1, 0, 2]], pose, camera, xyz))
    np.testing.assert_allclose(network.points.given[-4:], xyz[:4], atol=1e-6)
    assert any("(scale 1, rms distance" in a for a in network.assumptions)


def test_projections_need_the_extra(tmp_path):
    camera, pose, xyz = scene(tmp_path)
    path = control_list(tmp_path, "WGS84 UTM 33N", xyz[:4], pose, camera, xyz)
    try:
        import pyproj  # noqa: F401
    except ImportError:
        with pytest.raises(MissingExtra, match="'geo' extra"):
            baarda.read(tmp_path, control=path)


def test_two_control_points_only_check(tmp_path):
    camera, pose, xyz = scene(tmp_path)
    network = baarda.read(tmp_path, control=control_list(tmp_path, "LOCAL", xyz[:2], pose, camera, xyz))
    assert (network.points.roles[-2:] == CHECK).all()
    assert any("the datum needs three" in a for a in network.assumptions)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("LOCAL", "LOKAL", None, ""),
        (" 0.jpg T0", " 0.jpg", 3, "another|coordinates|T0"),
        (" 1.jpg T0", "", 3, "image is missing"),
        (" 1.jpg T0", " 0.jpg T0", 3, "measured twice"),
    ],
)
def test_damaged_lists(tmp_path, old, new, line, words):
    camera, pose, xyz = scene(tmp_path)
    path = control_list(tmp_path, "LOCAL", xyz[:3], pose, camera, xyz)
    path.write_text(path.read_text().replace(old, new, 1))
    if line is None:
        with pytest.raises(InputError):
            baarda.read(tmp_path, control=path)
    elif old.endswith("0.jpg T0"):
        assert "gcp 1" in baarda.read(tmp_path, control=path).points.labels
    else:
        with pytest.raises(InputError, match=words) as caught:
            baarda.read(tmp_path, control=path)
        assert caught.value.line == line


def test_what_opensfm_cannot_hold(tmp_path, data):
    network = read(data("bal_dubrovnik_tiny") / "dubrovnik-3-7-pre.txt")
    with pytest.raises(UsageError, match=re.escape("OpenSfM has no model 'snavely'")):
        write(network, tmp_path / "out", "opensfm")
    assert not (tmp_path / "out").exists()
