"""NVM files of VisualSFM: the convention of its documentation and damaged files."""

import numpy as np
import pytest

import baarda
from baarda.errors import InputError
from baarda.formats import read, recognise
from baarda.network import State


def rotation(q):
    w, x, y, z = q
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * k + 2 * k @ k


def measured(f, r, q, c, point):
    """(1 + r |m|^2 / f^2) m = f X / Z, solved for the measurement m by iteration."""
    x = rotation(q) @ (point - c)
    target = f * x[:2] / x[2]
    assert x[2] > 0
    m = target.copy()
    for _ in range(200):
        m = target / (1 + r * (m @ m) / f**2)
    return m


def scene(folder, fixed=""):
    rng = np.random.default_rng(11)
    points = rng.uniform(-1, 1, (15, 3))
    cameras = []
    for i in range(4):
        q = np.array([1.0, *rng.uniform(-0.2, 0.2, 3)])
        q /= np.linalg.norm(q)
        cameras.append((800.0 + i, -0.05 + 0.01 * i, q, rotation(q).T @ np.array([0.3 * i, -0.2 * i, -6.0])))
    lines = [f"NVM_V3 {fixed}", "", "4"]
    for i, (f, r, q, c) in enumerate(cameras):
        name = f"I{i}.jpg" if i else '"I 0.jpg"'
        lines.append(f"{name}\t{f!r} {' '.join(repr(float(v)) for v in (*q, *c))} {r!r} 0")
    lines += ["", "15"]
    for p in points:
        views = [f"{i} 0 {float(m[0])!r} {float(m[1])!r}" for i, camera in enumerate(cameras) for m in [measured(*camera, p)]]
        lines.append(" ".join([*(repr(float(v)) for v in p), "0 0 0 4", *views]))
    lines += ["", "0", "", "#the last part of NVM file points to the PLY files", "0"]
    path = folder / "a.nvm"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_documented_projection_gives_zero_residuals(tmp_path):
    path = scene(tmp_path)
    assert recognise(path).name == "nvm"
    network = read(path)
    assert network.images.labels == ("I 0.jpg", "I1.jpg", "I2.jpg", "I3.jpg")
    group = network.observations[0]
    assert len(group) == 60
    assert np.abs(group.misclosures(network, State.of(network))).max() < 1e-9
    result = baarda.adjust(network, camera="principal_distance")
    assert result.objective < 1e-10


def test_a_given_calibration_stays_fixed(tmp_path):
    network = read(scene(tmp_path, "FixedK 800 320 800 240 -0.05"))
    assert not any(c.states.any() for c in network.cameras)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("NVM_V3 ", "NVM_V3 Fixed", 1, "FixedK fx cx fy cy r"),
        ("\n4\n", "\n5\n", 9, "the file name|ten numbers|a number of the camera"),
        ("\n4\n", "\n-4\n", 3, "must stand alone, be positive"),
        ("\n4\n", "\n4000000000\n", 3, "not exceed the lines"),
        ("I2.jpg", "I1.jpg", 6, "appears twice .first in line 5."),
        ("801.0", "-801.0", 5, "must be positive"),
        ("801.0", "nan", 5, "not finite"),
        ("\n15\n", "\n16\n", 26, "measurements|a coordinate|number of measurements"),
        (" 0 0 0 4 ", " 0 0 0 5 ", 10, "5 measurements are announced"),
        (" 4 0 0 ", " 4 9 0 ", 10, "image 9 is not among"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, old, new, line, words):
    path = scene(tmp_path)
    text = path.read_text()
    if old == " 4 0 0 ":
        old, new = " 0 0 0 4 0 0 ", " 0 0 0 4 9 0 "
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        read(path, format="nvm")
    assert caught.value.line == line
