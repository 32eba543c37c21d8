"""OpenMVG scenes: the convention of its camera classes and damaged files."""

import json

import numpy as np
import pytest

from baarda.errors import InputError
from baarda.formats import read, recognise
from baarda.network import State

DISTORTIONS = {None: [], "disto_k1": [-0.05], "disto_k3": [-0.05, 0.02, -0.01], "disto_t2": [-0.05, 0.02, -0.01, 1e-3, -2e-3]}


def project(f, pp, disto, r, c, point):
    """Camera_Pinhole and its distortions: cam2ima(add_disto(X / Z))."""
    v = r @ (point - c)
    assert v[2] > 0
    x, y = v[:2] / v[2]
    r2 = x * x + y * y
    k1, k2, k3, t1, t2 = (*disto, 0, 0, 0, 0, 0)[:5] if len(disto) != 1 else (disto[0], 0, 0, 0, 0)
    d = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * d + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y
    yd = y * d + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
    return [float(f * xd + pp[0]), float(f * yd + pp[1])]


def scene(folder, kind="disto_k3", nested=False, control=False):
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (12, 3))
    base = {"width": 640, "height": 480, "focal_length": 700.0, "principal_point": [322.0, 238.0]}
    data = {**({"value0": base} if nested else base), **({} if kind is None else {kind: DISTORTIONS[kind]})}
    poses = []
    for i in range(3):
        a, b = 0.2 * i + 0.05, -0.1 * i
        r = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        r = r @ np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
        poses.append((r, r.T @ np.array([0.2 * i, 0.1, -5.0])))
    view = lambda i: {"local_path": "/", "filename": f"{i}.jpg", "width": 640, "height": 480, "id_view": i, "id_intrinsic": 0, "id_pose": i}  # noqa: E731
    seen = lambda p: [  # noqa: E731
        {"key": i, "value": {"id_feat": 0, "x": project(700.0, (322.0, 238.0), DISTORTIONS[kind], r, c, p)}}
        for i, (r, c) in enumerate(poses)
    ]
    landmarks = [{"key": k + 100, "value": {"X": p.tolist(), "observations": seen(p)}} for k, p in enumerate(points)]
    root = {
        "sfm_data_version": "0.3",
        "root_path": "/x",
        "views": [{"key": i, "value": {"ptr_wrapper": {"id": 1, "data": view(i)}}} for i in range(4)],
        "intrinsics": [{"key": 0, "value": {"polymorphic_name": "pinhole", "ptr_wrapper": {"id": 2, "data": data}}}],
        "extrinsics": [{"key": i, "value": {"rotation": r.tolist(), "center": c.tolist()}} for i, (r, c) in enumerate(poses)],
        "structure": landmarks[:10] if control else landmarks,
        "control_points": landmarks[10:] if control else [],
    }
    (folder / "sfm_data.json").write_text(json.dumps(root, indent=1))
    return folder / "sfm_data.json"


@pytest.mark.parametrize("kind", DISTORTIONS)
@pytest.mark.parametrize("nested", [False, True])
def test_the_documented_projection_gives_zero_residuals(tmp_path, kind, nested):
    path = scene(tmp_path, kind, nested)
    assert recognise(path).name == recognise(tmp_path).name == "openmvg"
    network = read(path)
    assert network.images.labels == ("0.jpg", "1.jpg", "2.jpg")
    assert any("1 view(s) without pose" in a for a in network.assumptions)
    group = network.observations[0]
    assert len(group) == 36
    assert np.abs(group.misclosures(network, State.of(network))).max() < 1e-9
    assert int((network.cameras[0].states > 0).sum()) == 3 + len(DISTORTIONS[kind])


def test_control_points_keep_their_marks(tmp_path):
    network = read(scene(tmp_path, control=True))
    assert network.points.labels[-2:] == ("110", "111")
    marks = network.observations[1]
    assert np.abs(marks.misclosures(network, State.of(network))).max() < 1e-8
    assert any("give them by --control" in a for a in network.assumptions)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"focal_length": 700.0', '"focal_length": -1', "focal_length: the focal length must be positive"),
        ('"disto_k3"', '"fisheye"', "intrinsic 'pinhole' is not supported"),
        ('"disto_k3"', '"disto_k1"', "disto_k1: must be 1 numbers"),
        ('"id_intrinsic": 0', '"id_intrinsic": 5', "intrinsic 5 is not among"),
        ('"1.jpg"', '"0.jpg"', "image '0.jpg' appears twice"),
        ('"key": 101', '"key": 100', "key 100 appears twice"),
        ('"center"', '"centre"', "'center' is missing"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, old, new, words):
    path = scene(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        read(path, format="openmvg")
    assert caught.value.line > 1
