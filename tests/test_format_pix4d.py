"""Pix4Dmapper's folder of parameters by its documented files: projection, offset, adjustment, damaged files."""

import numpy as np
import pytest

import baarda
from baarda.errors import InputError
from baarda.formats import read, recognise, write
from baarda.network import State

W, H = 4608, 3456
F, CENTRE = 3952.81247514184087776812, (2233.46124792750424603582, 1667.92521335858214115433)
RADIAL, TANGENTIAL = (0.03833474118270804865, -0.01750917966495743258, 0.02049798716391852335), (2.4e-3, 2.9e-3)
OFFSET = (368009.0, 3955854.0, 97.0)
HEADING = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""


def project(r, t, x):
    """m = K [R | -R t] X with the distortion of Pix4D's article on camera parameters."""
    x, y, z = r @ (x - t)
    assert z > 0
    x, y = x / z, y / z
    r2 = x * x + y * y
    d = 1 + sum(k * r2 ** (j + 1) for j, k in enumerate(RADIAL))
    t1, t2 = TANGENTIAL
    xd = d * x + 2 * t1 * x * y + t2 * (r2 + 2 * x * x)
    yd = d * y + 2 * t2 * x * y + t1 * (r2 + 2 * y * y)
    return F * xd + CENTRE[0], F * yd + CENTRE[1]


def turn(a, axis):
    c, s = np.cos(a), np.sin(a)
    return np.array([[[1, 0, 0], [0, c, -s], [0, s, c]], [[c, 0, s], [0, 1, 0], [-s, 0, c]], [[c, -s, 0], [s, c, 0], [0, 0, 1]]][axis])


def scene(folder, noise=0.0, offset=True, name="maize"):
    rng = np.random.default_rng(7)
    xyz = np.stack([rng.uniform(-12, 12, 40), rng.uniform(-10, 10, 40), rng.uniform(-1, 1, 40)], axis=1)
    parameters, ties = [], []
    for i in range(6):
        t = np.array([-6.0 + 6.0 * (i % 3), -4.0 + 8.0 * (i // 3), 28.0 + i])
        r = np.diag([1.0, -1.0, -1.0]) @ turn(rng.uniform(-0.1, 0.1), 0) @ turn(rng.uniform(-0.1, 0.1), 1) @ turn(0.2 + np.pi * (i // 3), 2)
        rows = [[F, 0, CENTRE[0]], [0, F, CENTRE[1]], [0, 0, 1], RADIAL, TANGENTIAL, t, *r]
        parameters += [f"DJI 09{i}.JPG {W} {H}", *(" ".join(f"{v:.20f}" if v else "0" for v in row) for row in rows)]
        ties.append(f"DJI 09{i}")
        for k, x in enumerate(xyz):
            u, v = np.array(project(r, t, x)) + noise * rng.standard_normal(2)
            if 0 < u < W and 0 < v < H:
                ties.append(f"{k + 5000} {u:.10f} {v:.10f} 3.2")
        ties.append("-99")
    (folder / f"{name}_calibrated_camera_parameters.txt").write_text(HEADING + "\n".join(parameters) + "\n")
    (folder / f"{name}_tp_pix4d.txt").write_text("\n".join(ties) + "\n")
    if offset:
        (folder / f"{name}_offset.xyz").write_text(" ".join(f"{v:.3f}" for v in OFFSET) + "\n")
    return xyz


def test_the_documented_projection_gives_zero_residuals(tmp_path):
    xyz = scene(tmp_path)
    assert recognise(tmp_path).name == recognise(tmp_path / "maize_tp_pix4d.txt").name == "pix4d"
    network = read(tmp_path)
    assert network.images.labels[0] == "DJI 090.JPG" and len(network.cameras) == 1 and network.unit == "m"
    assert np.abs(network.observations[0].misclosures(network, State.of(network))).max() < 1e-5
    at = [int(label) - 5000 for label in network.points.labels]
    np.testing.assert_allclose(network.points.coordinates, xyz[at] + OFFSET, atol=1e-6)


def test_adjusts_and_reads_back_as_a_project(tmp_path):
    scene(tmp_path, noise=1.0, offset=False)
    network = read(tmp_path)
    assert network.unit == "model units"
    result = baarda.adjust(network)
    assert result.status == "converged" and 0.8 < result.sigma0 < 1.2
    write(network, tmp_path / "own", "project")
    again = read(tmp_path / "own")
    ours, theirs = (n.observations[0].misclosures(n, State.of(n)) for n in (network, again))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("calibrated_camera_parameters.txt", "3952.8", "-3952.8", "positive f"),
        ("calibrated_camera_parameters.txt", "091.JPG", "090.JPG", "appears twice"),
        ("calibrated_camera_parameters.txt", f"JPG {W} {H}", f"JPG 0 {H}", "beyond all cameras"),
        ("calibrated_camera_parameters.txt", "imageHeight", "imageDepth", "first line must be"),
        ("tp_pix4d.txt", "-99\n", "", "y is missing"),
        ("tp_pix4d.txt", "5001 ", "5000 ", "measured twice"),
        ("offset.xyz", "97.000", "", "three numbers"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, file, old, new, words):
    scene(tmp_path)
    path = tmp_path / f"maize_{file}"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, format="pix4d")
    assert caught.value.file == str(path) and caught.value.line >= 1
