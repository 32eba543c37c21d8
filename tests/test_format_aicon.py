"""AICON projects: the documented projection, residuals that AICON itself printed, inactive measurements, damaged files."""

import numpy as np
import pytest

import baarda
from baarda.errors import InputError
from baarda.formats import read, recognise, write
from baarda.network import CONTROL, State
from networks import looking_at

C, X0, Y0, R0 = 28.78507, 0.01735, 0.05669, 13.488
A, B, SHEAR = (-1.09607e-4, 1.49566e-7, 0.0), (5.79843e-6, -8.64454e-6), (-7.00801e-5, -3.12627e-5)
IOR = """       1     -999   -28.78507     0.01735     0.05669 -1.09607e-004 1.49566e-007     13.488
                                               0.00000e+000
                                               5.79843e-006 -8.64454e-006
                                               -7.00801e-005 -3.12627e-005
                                                  35.96800    23.97900  8688  5792
"""
# image 1 of the example of applied-geodesy/bundle-adjustment, adjusted by AICON 3D Studio: point, X, Y, Z, x, y, v_x, v_y (mm)
EOR = "1 1 1606.29121 -869.46812 244.44805 1.38765400 0.65197607 -2.97428824 0 307 3\n"
PRINTED = [
    (6, 573.0039, -49.4291, -121.6922, 7.110610874440, 3.555003198393, -0.000099847905, 0.000325636855),
    (14, 973.4068, -14.7037, 456.1994, -1.237267734656, -10.186976398455, 0.000153619486, 0.000297827139),
    (15, 598.4174, -59.8312, -16.2175, 6.898168771318, 1.397497196925, -0.000481757467, 0.000437813811),
    (43, 182.2619, -13.0337, 554.4255, 11.002676180045, -10.815561356955, -0.000542011304, 0.000384726665),
    (47, 589.9857, -14.3504, -163.6962, 6.283307027801, 4.381005079211, 0.000559674434, 0.000006632048),
    (87, 209.2133, -10.9669, 459.7474, 10.697752961115, -8.968244352532, -0.000003511390, -0.000133642343),
    (1057, 242.1592, -26.6451, 272.9401, 10.654320396560, -5.325326106172, -0.000414609302, 0.000174807819),
    (45, 1138.9008, 2.1214, 276.9664, -5.268760023785, -4.906505710435, 0.000590201312, 0.000342813300),
]


def project(m, x0, point):
    """Luhmann et al., Close-Range Photogrammetry, 3.3, with everything added to the ideal point."""
    u = m @ (point - x0)
    assert u[2] < 0
    x, y = -C * u[0] / u[2], -C * u[1] / u[2]
    r2 = x * x + y * y
    q = sum(a * (r2 ** (k + 1) - R0 ** (2 * k + 2)) for k, a in enumerate(A))
    dx = x * q + B[0] * (r2 + 2 * x * x) + 2 * B[1] * x * y + SHEAR[0] * x + SHEAR[1] * y
    dy = y * q + B[1] * (r2 + 2 * y * y) + 2 * B[0] * x * y
    return x + dx + X0, y + dy + Y0


def angles(m):
    return np.arctan2(-m[2, 1], m[2, 2]), np.arcsin(m[2, 0]), np.arctan2(-m[1, 0], m[0, 0])


def scene(folder, images=6, points=20, noise=0.0, control=0, stem="block"):
    rng = np.random.default_rng(5)
    xyz = rng.uniform(-400, 400, (points, 3))
    a = 2 * np.pi * np.arange(images) / images
    centres = np.stack([1200 * np.cos(a), 1200 * np.sin(a), 500 + 200 * np.cos(3 * a)], axis=1)
    roll = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = [np.linalg.matrix_power(roll, k % 4) @ looking_at(c, np.zeros(3)) for k, c in enumerate(centres)]
    eor = [
        f"{i + 1} 1 " + " ".join(f"{v!r}" for v in map(float, (*c, *angles(m)))) + " 0 20 3"
        for i, (m, c) in enumerate(zip(poses, centres, strict=True))
    ]
    phc = ["# image coordinates"]
    for i, (m, c) in enumerate(zip(poses, centres, strict=True)):
        for k, p in enumerate(xyz):
            x, y = np.array(project(m, c, p)) + noise * rng.standard_normal(2)
            phc.append(f"{i + 1} {k + 100} {x!r} {y!r} 0.0002 0.0003 0 0 1 1 1".replace("np.float64(", "").replace(")", ""))
    obc = [f"{k + 100} " + " ".join(repr(v) for v in p.tolist()) + f" 0.01 0.01 0.02 6 1 {int(k >= control)} 0" for k, p in enumerate(xyz)]
    length = float(np.linalg.norm(xyz[0] - xyz[1]))
    files = {"ior": IOR, "eor": "\n".join(eor) + "\n", "phc": "\n".join(phc) + "\n", "obc": "\n".join(obc) + "\n",
             "scale": f'0 "a bar" 100 101 {length!r} 0.005 1\n1 "off" 100 102 1.0 0.01 0\n'}  # fmt: skip
    for kind, text in files.items():
        (folder / f"{stem}.{kind}").write_text(text)
    return folder


def test_the_documented_projection_gives_zero_residuals(tmp_path):
    scene(tmp_path)
    assert recognise(tmp_path).name == recognise(tmp_path / "block.phc").name == "aicon"
    network = read(tmp_path)
    state = State.of(network)
    assert np.abs(network.observations[0].misclosures(network, state)).max() < 1e-8
    assert np.abs(network.observations[1].misclosures(network, state)).max() < 1e-9
    camera = network.cameras[0]
    assert dict(zip(camera.model.order, camera.values, strict=True))["A1"] == A[0] and camera.grid == R0
    np.testing.assert_allclose(network.observations[0].sigmas[0], np.array([0.0002, 0.0003]) / (35.968 / 8688), rtol=1e-4)
    assert any("1 scale bar(s)" in a for a in network.assumptions)


def test_residuals_that_aicon_printed(tmp_path):
    """What the printed digits leave: 5e-6 mm of the principal point, 5e-5 mm of the object points; one pixel is 4.1e-3 mm."""
    (tmp_path / "a.ior").write_text(IOR)
    (tmp_path / "a.eor").write_text(EOR)
    (tmp_path / "a.obc").write_text("".join(f"{r[0]} {r[1]} {r[2]} {r[3]}\n" for r in PRINTED))
    (tmp_path / "a.phc").write_text("".join(f"1 {r[0]} {r[4]} {r[5]} 0.0001 0.0001 {r[6]} {r[7]} 1 1 1\n" for r in PRINTED))
    network = read(tmp_path)
    ours = -network.observations[0].misclosures(network, State.of(network)) * network.cameras[0].pixel_size
    assert np.abs(ours - np.array([r[6:] for r in PRINTED])).max() < 6e-6


def test_adjusts_with_a_scale_bar_and_reads_back_as_a_project(tmp_path):
    network = read(scene(tmp_path, noise=2.5e-4))
    result = baarda.adjust(network)
    assert result.status == "converged" and 0.7 < result.sigma0 < 1.3
    write(network, tmp_path / "project", "project")
    again = read(tmp_path / "project")
    ours, theirs = (n.observations[0].misclosures(n, State.of(n)) for n in (network, again))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_held_points_are_control_and_inactive_rows_are_left_out(tmp_path):
    scene(tmp_path, control=3)
    phc = tmp_path / "block.phc"
    phc.write_text(phc.read_text().replace(" 1 1 1\n", " 1 0 1\n", 2))
    network = read(tmp_path)
    assert (network.points.roles == CONTROL).sum() == 3 and network.points.sigmas[0].tolist() == [0.01, 0.01, 0.02]
    assert len(network.observations[0]) == 118
    assert any("2 image point(s) that AICON set inactive" in a for a in network.assumptions)


@pytest.mark.parametrize(
    ("kind", "old", "new", "words"),
    [
        ("ior", "-28.78507", "28.78507", "must be negative"),
        ("ior", "8688", "0", "positive size"),
        ("ior", "-7.00801e-005 -3.12627e-005", "", "five lines per camera"),
        ("eor", " 0 20 3", " 1 20 3", "rotation order 1"),
        ("eor", "2 1 ", "1 1 ", "image 1 appears twice"),
        ("obc", "101 ", "100 ", "point 100 appears twice"),
        ("phc", "1 101 ", "1 100 ", "measured twice"),
        ("phc", " 0.0002 ", " 0 ", "must be positive"),
        ("scale", " 0.005 1", " 0 1", "must be positive"),
        ("scale", "101", "100", "two points"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, kind, old, new, words):
    scene(tmp_path)
    path = tmp_path / f"block.{kind}"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, format="aicon")
    assert caught.value.file == str(path) and caught.value.line >= 1
