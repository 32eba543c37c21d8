"""PATB and BINGO blocks by their documented records: projection, readings of the rotation, control, adjustment, damaged files."""

import numpy as np
import pytest

import baarda
from baarda.errors import InputError
from baarda.formats import read, recognise, write
from baarda.geometry import rotation as rot
from baarda.network import CHECK, CONTROL, State

C = 153.6921  # mm


def truth(points=30, seed=4):
    """A block of two strips of three photos, nearly vertical, flown in opposite directions."""
    rng = np.random.default_rng(seed)
    xyz = np.stack([rng.uniform(0, 2400, points), rng.uniform(0, 1900, points), rng.uniform(100, 300, points)], axis=1) + np.array(
        [4.5e5, 5.4e6, 0]
    )
    poses = {}
    for k in range(6):
        centre = np.array([4.5e5 + 400 + 800 * (k % 3), 5.4e6 + 500 + 900 * (k // 3), 1700 + 10 * k])
        poses[f"{1001 + k}"] = centre, rng.uniform(-0.05, 0.05, 2), 0.2 + np.pi * (k // 3)
    return xyz, poses


def seen(m, centre, xyz, noise, rng):
    """Collinearity equations of Kraus (2007), millimetres; points within 115 mm."""
    u = (xyz - centre) @ m.T
    xy = -C * u[:, :2] / u[:, 2:] + noise * rng.standard_normal((len(xyz), 2))
    return [(k, *v) for k, v in enumerate(xy.tolist()) if max(map(abs, v)) < 115.0]


def patb(folder, transposed=False, noise=0.0, control=6, unit=1000.0):
    xyz, poses = truth()
    rng = np.random.default_rng(1)
    image, orientation = [], []
    for label, (centre, tilt, kappa) in poses.items():
        m = rot.from_angles(*tilt, kappa)
        e = (m if transposed else m.T).ravel()
        orientation += [f"{label:>16}{'':16}" + "".join(f"{v:16.5f}" for v in centre), "".join(f"{v:16.12f}" for v in e[:5]),
                        "".join(f"{v:16.12f}" for v in e[5:])]  # fmt: skip
        image.append(f"{label:>12}{unit * C:14.3f}")
        image += [f"{k + 1:>12}{unit * x:14.4f}{unit * y:14.4f}   1" for k, x, y in seen(m, centre, xyz, noise, rng)] + ["-99"]
    (folder / "block.im").write_text("\n".join([*image, "-99"]) + "\n")
    (folder / "block.ori").write_text("\n".join(orientation) + "\n")
    if control:
        plan = [f"{k + 1:>12}{xyz[k, 0]:16.4f}{xyz[k, 1]:16.4f}   1" for k in range(control)]
        height = [f"{k + 1:>12}{xyz[k, 2]:16.4f}   1" for k in range(control + 2)]
        (folder / "block.con").write_text("\n".join([*plan, "-99", *height, "-99"]) + "\n")
    return xyz, poses


def bingo(folder, noise=0.0, omega_first=False):
    xyz, poses = truth()
    rng = np.random.default_rng(2)
    image, itera = [], ["* start values"]
    for label, (centre, tilt, kappa) in poses.items():
        phi, omega = tilt
        m = rot.from_angles(*tilt, kappa) if omega_first else turn(kappa, 2) @ turn(omega, 0) @ turn(phi, 1)
        angles = [v * 200 / np.pi for v in (phi, omega, kappa)]
        itera.append(f"ORIA {label} " + " ".join(f"{v:.10f}" for v in (*centre, *angles)) + " RMK")
        image.append(f"{label} RMK")
        image += [f"{k + 1} {x + 0.012:.6f} {y - 0.021:.6f}" for k, x, y in seen(m, centre, xyz, noise, rng)] + ["-99"]
    itera += [f"CORD {k + 1} " + " ".join(f"{v:.4f}" for v in p) for k, p in enumerate(xyz[:20])]
    geoin = ["C a comment", f"CAPA RMK NORM {C} 0.012 -0.021", "ECCA RMK 0.1 0.0 1.2"]
    geoin += [f"{'CHCK' if k == 5 else 'CONT'} {k + 1} " + " ".join(f"{v:.4f}" for v in p) for k, p in enumerate(xyz[:6])]
    for name, lines in (("image.dat", image), ("itera.dat", itera), ("geoin.dat", geoin)):
        (folder / name).write_text("\n".join(lines) + "\n")
    return xyz, poses


def turn(a, axis):
    """Wolf's R1, R2, R3."""
    c, s = np.cos(a), np.sin(a)
    return np.array([[[1, 0, 0], [0, c, s], [0, -s, c]], [[c, 0, -s], [0, 1, 0], [s, 0, c]], [[c, s, 0], [-s, c, 0], [0, 0, 1]]][axis])


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("unit", [1000.0, 1.0])
def test_patb_points_meet_under_either_reading_of_the_rotation(tmp_path, transposed, unit):
    patb(tmp_path, transposed, unit=unit)
    assert recognise(tmp_path).name == recognise(tmp_path / "block.im").name == "patb"
    network = read(tmp_path)
    assert network.cameras[0].values[0] == pytest.approx(C)
    misfit = network.observations[0].misclosures(network, State.of(network))
    assert np.nanmax(np.abs(misfit)) < 0.3  # 4 decimals of the coordinates, in micrometres or millimetres
    words = "from the object to the photo" if transposed else "from the photo to the object"
    assert any(words in a and "median" in a for a in network.assumptions)


def test_patb_control_in_plan_and_height(tmp_path):
    xyz, _ = patb(tmp_path)
    network = read(tmp_path)
    rows = {label: k for k, label in enumerate(network.points.labels)}
    full, height = rows["1"], rows["8"]
    assert network.points.roles[[full, height]].tolist() == [CONTROL, CONTROL]
    assert network.points.states[full].tolist() == [0, 0, 0] and network.points.states[height].tolist() == [2, 2, 0]
    np.testing.assert_allclose(network.points.coordinates[height], xyz[7], atol=0.05)


def test_patb_adjusts_and_reads_back_as_a_project(tmp_path):
    patb(tmp_path, noise=0.005)
    network = read(tmp_path)
    result = baarda.adjust(network)
    assert result.status == "converged" and 0.7 < result.sigma0 < 1.3  # sigma 5 um was simulated
    write(network, tmp_path / "project", "project")
    again = read(tmp_path / "project")
    ours, theirs = (n.observations[0].misclosures(n, State.of(n)) for n in (network, again))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.parametrize("omega_first", [False, True])
def test_bingo_points_meet_under_either_order_of_angles(tmp_path, omega_first):
    bingo(tmp_path, omega_first=omega_first)
    assert recognise(tmp_path).name == recognise(tmp_path / "itera.dat").name == "bingo"
    network = read(tmp_path)
    misfit = network.observations[0].misclosures(network, State.of(network))
    assert np.nanmedian(np.abs(misfit)) < 0.05
    assert any(("omega first" if omega_first else "phi first") in a for a in network.assumptions) or omega_first
    assert network.cameras[0].values[:3].tolist() == pytest.approx([C, 0.012, -0.021])
    roles = dict(zip(network.points.labels, network.points.roles.tolist(), strict=True))
    assert roles["1"] == CONTROL and roles["6"] == CHECK


def test_bingo_adjusts(tmp_path):
    bingo(tmp_path, noise=0.005)
    result = baarda.adjust(read(tmp_path))
    assert result.status == "converged" and 0.7 < result.sigma0 < 1.3


DAMAGES = [
    (patb, "block.im", "153692.100", "-1.0", "principal distance must be positive"),
    (patb, "block.im", "\n-99\n-99\n", "\n", "no end"),
    (patb, "block.ori", " 0.9", " 9.9", "not a rotation"),
    (patb, "block.ori", "1002", "1001", "appears twice"),
    (bingo, "geoin.dat", "153.6921", "-153.6921", "principal distance must be positive"),
    (bingo, "geoin.dat", "CAPA", "KAPA", "no camera"),
    (bingo, "geoin.dat", "CONT 2", "CONT 1", "appears twice"),
    (bingo, "itera.dat", "ORIA 1002", "ORIA 1001", "appears twice"),
    (bingo, "itera.dat", "CORD 20 ", "CORD 20 x", "not a number"),
    (bingo, "image.dat", "1002 RMK", "1001 RMK", "appears twice"),
]


@pytest.mark.parametrize(("make", "file", "old", "new", "words"), DAMAGES)
def test_damaged_files_are_refused_with_the_line(tmp_path, make, file, old, new, words):
    make(tmp_path)
    path = tmp_path / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1) if words != "no end" else text.replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, format=make.__name__)
    assert caught.value.file == str(path)
