"""libmv problems: convention by the published initial cost, minimum, byte orders, damaged files; the formula of the camera."""

import struct

import numpy as np
import pytest

import baarda
from baarda.errors import InputError
from baarda.formats import read, recognise
from baarda.network import State

SAME = np.eye(3)


@pytest.fixture(scope="module")
def file(data):
    return data("libmv_tos_333") / "problem_01.bin"


def problem(order="<", letters=b"vP", cameras=((7, SAME), (9, SAME)), points=(3, 4), markers=((7, 3), (9, 3), (9, 4)), focal=500.0):
    """Return a small file: identity rotations, cameras 10 units before the points."""
    out = letters + struct.pack(order + "8f", focal, 10.0, 20.0, 0.1, 0.01, 0.001, 0.002, -0.003)
    out += struct.pack(order + "i", len(cameras))
    for label, rotation in cameras:
        out += struct.pack(order + "i12f", label, *np.asarray(rotation).T.ravel(), 0.0, 0.0, 10.0)
    out += struct.pack(order + "i", len(points))
    for label in points:
        out += struct.pack(order + "i3f", label, 1.0, label, 0.5)
    out += struct.pack(order + "i", len(markers))
    for image, track in markers:
        out += struct.pack(order + "2i2f", image, track, 100.0 + image, 200.0 + track)
    return out


def test_initial_cost_is_the_published_one(file):
    network = read(file)
    assert network.format == "libmv"
    assert (len(network.images.labels), len(network.points.labels), len(network.observations[0])) == (333, 26, 5421)
    state = State.of(network)
    cost = 0.5 * float((network.observations[0].misclosures(network, state) ** 2).sum())
    assert cost == pytest.approx(4607.594484462985, rel=1e-13)
    assert network.observations[0].in_front(network, state).all()


def test_the_minimum_is_the_known_one(file):
    result = baarda.adjust(read(file))
    assert result.status == "converged"
    assert result.redundancy == 8773
    assert 0.5 * result.objective == pytest.approx(4607.5919525854, rel=1e-7)
    assert result.sigma0 == pytest.approx(np.sqrt(2 * 4607.5919525854 / 8773), rel=1e-7)


@pytest.mark.parametrize(("order", "letter"), [("<", b"v"), (">", b"V")])
def test_both_byte_orders_and_a_point_by_hand(tmp_path, order, letter):
    path = tmp_path / "p.bin"
    path.write_bytes(problem(order, letter + b"P"))
    assert recognise(path).name == "libmv"
    network = read(path)
    assert network.images.labels == ("7", "9")
    assert network.points.labels == ("3", "4")
    np.testing.assert_array_equal(network.observations[0].xy, [[107.0, 203.0], [109.0, 203.0], [109.0, 204.0]])
    x, y = 1.0 / 10.5, 3.0 / 10.5
    k1, k2, k3, p1, p2 = (float(np.float32(v)) for v in (0.1, 0.01, 0.001, 0.002, -0.003))
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = [
        500.0 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 10.0,
        500.0 * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + 20.0,
    ]
    computed = network.observations[0].xy - network.observations[0].misclosures(network, State.of(network))
    np.testing.assert_allclose(computed[0], expected, rtol=1e-13)


def test_normalised_markers_are_said(tmp_path):
    path = tmp_path / "n.bin"
    path.write_bytes(problem(letters=b"vN"))
    assert any("normalised" in a for a in read(path).assumptions)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (problem()[:-1], "byte 178: 3 markers are announced"),
        (problem() + b"\0", "byte 230: the file goes on"),
        (problem()[:20], "eight numbers"),
        (b"xP" + problem()[2:], "must begin with v or V"),
        (problem(focal=-1.0), "focal length positive"),
        (problem(focal=float("nan")), "focal length positive"),
        (problem(markers=((7, 3), (8, 3))), "byte 198: a marker names camera 8"),
        (problem(markers=((7, 3), (9, 5))), "byte 198: a marker names point 5"),
        (problem(markers=((7, 3), (7, 4))), "byte 90: image '9' has no image points"),
        (problem(points=(3, 3)), "number 3 appears twice"),
        (problem(cameras=((7, SAME), (9, 2 * SAME))), "byte 90: the matrix is not a rotation"),
        (problem()[:34] + struct.pack("<i", 2**31 - 1) + problem()[38:], "cameras are announced"),
        (problem()[:34] + struct.pack("<i", -5) + problem()[38:], "must be positive, not -5"),
    ],
)
def test_damaged_files_are_refused(tmp_path, content, words):
    path = tmp_path / "bad.bin"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read(path, format="libmv")
