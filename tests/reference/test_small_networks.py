"""OpenCV's chessboard, a planar sheet that is no unit square, an under-determined cut-out of a BAL problem."""

import csv

import numpy as np
import pytest

import baarda
from baarda import cameras
from baarda.cameras import FIXED, OBSERVED
from baarda.errors import RedundancyNotPositive
from baarda.formats import read
from baarda.geometry.rotation import exp
from baarda.hypotheses.outliers import tau
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import ImagePoints
from networks import control_table

OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def chessboard(folder, without=()):
    """The corners as a network: board points fixed, no start values for the images."""
    with (folder / "corners.csv").open(newline="") as f:
        rows = [r for r in csv.DictReader(f) if r["image"] not in without]
    images = list(dict.fromkeys(r["image"] for r in rows))
    points = list(dict.fromkeys(r["point"] for r in rows))
    place = {r["point"]: [float(r[f"{k}_mm"]) for k in "XYZ"] for r in rows}
    board = np.array([place[p] for p in points])
    start = {"principal_distance_x": 530.0, "principal_distance_y": 530.0, "principal_point_x": 320.0, "principal_point_y": 240.0}
    model = cameras.model("opencv")
    camera = cameras.create("left", model, start, free=model.order, image_size=(640.0, 480.0))
    n = len(points)
    table = Points.make(points, board, np.full(n, CONTROL), np.full((n, 3), FIXED), board)
    index = {p: i for i, p in enumerate(points)}
    group = ImagePoints.make(
        [images.index(r["image"]) for r in rows], [index[r["point"]] for r in rows], [[float(r["x_px"]), float(r["y_px"])] for r in rows]
    )
    return Network((camera,), Images.make(images), table, (group,), unit="mm")


def estimates(result):
    rows = [r for r in result.unknowns.rows() if r["group"] == "camera"]
    return {k: (r["value"], r["sigma"]) for k, r in zip(OPENCV, rows, strict=True)}


def test_chessboard_as_opencv_calibrates_it(data):
    result = baarda.adjust(chessboard(data("opencv_chessboard_left")))
    assert (result.count, result.numbering.count, result.redundancy) == (1404, 87, 1317)
    assert result.objective == pytest.approx(117.3016911454, rel=1e-9)
    assert result.sigma0 == pytest.approx(0.2984415241, rel=1e-9)
    printed = {
        "fx": (536.07424595, 0.92818761),
        "fy": (536.01715256, 0.97215539),
        "cx": (342.36999739, 0.97173325),
        "cy": (235.53755258, 1.07081569),
        "k1": (-0.26509078, 0.01164228),
        "k2": (-0.04672685, 0.09085641),
        "p1": (0.00183322, 0.00023535),
        "p2": (-0.00031467, 0.00029795),
        "k3": (0.25226374, 0.19755847),
    }
    for name, (value, sigma) in estimates(result).items():
        # OpenCV stops some 1e-6 sigma before the minimum
        assert value == pytest.approx(printed[name][0], abs=1e-5 * printed[name][1] + 5e-9), name
        assert sigma == pytest.approx(printed[name][1], rel=2e-4 if name[0] == "p" else 1e-5), name
    c = result.covariance([f"camera left: {n}" for n in cameras.model("opencv").order])
    r = c / np.sqrt(np.outer(np.diag(c), np.diag(c)))
    np.testing.assert_allclose([r[0, 1], r[4, 5], r[5, 8]], [0.980, -0.967, -0.983], atol=6e-4)
    t = {
        t.labels[i].split(": ")[-1]: float(t.statistic[i])
        for t in baarda.test(result)
        if t.name == "additional_parameter"
        for i in range(5)
    }
    assert abs(t["k2"]) == pytest.approx(0.51, abs=0.006)
    assert abs(t["p2"]) == pytest.approx(1.06, abs=0.006)
    assert abs(t["k3"]) == pytest.approx(1.28, abs=0.006)


def test_chessboard_worst_image(data):
    result = baarda.adjust(chessboard(data("opencv_chessboard_left")))
    e, o = result.evidence, result.observations
    worst = np.argsort(-np.abs(tau(e.pv, e.pqvvp, e.variance_factor)))
    assert {o["image"][i] for i in worst[:2]} == {"left02.jpg"}
    assert set(o["component"][worst[:2]]) == {"y"}


def test_chessboard_without_its_worst_image(data):
    folder = data("opencv_chessboard_left")
    name = next(n for n in chessboard(folder).images.labels if n.startswith("left02"))
    result = baarda.adjust(chessboard(folder, without=(name,)))
    assert (result.count, result.numbering.count, result.redundancy) == (1296, 81, 1215)
    assert result.objective == pytest.approx(35.5173224230, rel=1e-9)
    assert result.sigma0 == pytest.approx(0.1709747471, rel=1e-9)
    found = estimates(result)
    for k, (value, sigma) in {"fx": (534.1321470, 0.6266501), "fy": (534.1867580, 0.6361866), "cx": (342.8440815, 0.5807951)}.items():
        assert found[k][0] == pytest.approx(value, abs=1e-6)
        assert found[k][1] == pytest.approx(sigma, abs=1e-6)


NINE = ("principal_distance", "principal_point_x", "principal_point_y", "K1", "K2", "K3", "P1", "P2", "B1")


@pytest.fixture(scope="module")
def riva(data, tmp_path_factory):
    folder = data("dbat_riva_net3")
    table = control_table(folder / "ctrlpts-2d.txt", tmp_path_factory.mktemp("riva") / "control.csv")
    network = read(folder / "net3-canon7d-2d.txt", control=table)
    group = network.observations[0]
    from dataclasses import replace

    return replace(network, observations=(replace(group, sigmas=np.full(group.sigmas.shape, 0.1)),))


def test_riva_with_fixed_control(riva):
    result = baarda.adjust(riva, camera=NINE, min_rays=2)
    assert (result.count, result.numbering.count, result.redundancy) == (3336, 399, 2937)
    assert result.sigma0 == pytest.approx(3.5535545, abs=5e-7)
    rows = {r["name"].split(": ")[1]: r for r in result.unknowns.rows() if r["group"] == "camera"}
    assert rows["principal_distance"]["value"] == pytest.approx(17.923636, abs=2e-6)
    assert rows["principal_distance"]["sigma"] == pytest.approx(0.003189, abs=2e-6)
    assert rows["K1"]["value"] == pytest.approx(3.467188e-4, abs=2e-10)
    assert rows["B1"]["value"] == pytest.approx(-3.218394e-4, abs=2e-10)
    assert abs(rows["K3"]["value"] / rows["K3"]["sigma"]) < 1.0  # K3 is not significant


def test_riva_with_weighted_control_rejects_the_unit_square(riva):
    from dataclasses import replace

    p = riva.points
    control = (p.roles == CONTROL)[:, None]
    weighted = replace(p, states=np.where(control, OBSERVED, p.states), sigmas=np.where(control, 0.001, p.sigmas))
    result = baarda.adjust(replace(riva, points=weighted), camera=NINE, min_rays=2)
    assert (result.count, result.numbering.count, result.redundancy) == (3348, 411, 2937)
    assert result.sigma0 == pytest.approx(2.8246609, abs=5e-7)
    # Fixed, the square adds 37086.4 - 23433.0 to v'Pv for its 12 - 7 = 5 conditions beyond a similarity: F(5, 2937) = 342.
    fixed = baarda.adjust(riva, camera=NINE, min_rays=2)
    growth = (fixed.objective - result.objective) / 5 / result.variance_factor
    assert growth == pytest.approx(342.2, abs=0.1)
    tests = {t.name: t for t in baarda.test(result)}
    assert not tests["control_points"].rejected  # a millimetre is enough for the four corners


def test_riva_the_control_test_rejects_the_square_where_it_is_held_fixed(riva):
    """With a hundredth of a millimetre the corners are as good as fixed, but observed: the tests of control can judge them."""
    from dataclasses import replace

    p = riva.points
    control = (p.roles == CONTROL)[:, None]
    held = replace(p, states=np.where(control, OBSERVED, p.states), sigmas=np.where(control, 1e-5, p.sigmas))
    result = baarda.adjust(replace(riva, points=held), camera=NINE, min_rays=2)
    assert result.sigma0 == pytest.approx(3.439, abs=5e-4)
    tests = {t.name: t for t in baarda.test(result)}
    joint, each = tests["control_points"], tests["control_point"]
    assert joint.rejected
    assert joint.df[0] == 5.0  # a similarity takes seven of twelve coordinates
    assert joint.statistic == pytest.approx(191.33, abs=0.01)
    assert joint.critical == pytest.approx(2.2126, abs=5e-5)
    assert each.rejected.all()
    single = tests["additional_parameter"]
    t = dict(zip((n.split(": ")[1] for n in single.labels), np.asarray(single.statistic), strict=True))
    assert abs(t["K3"]) < 0.5
    assert all(abs(t[k]) > 7.0 for k in ("K1", "K2", "P1", "P2", "B1"))


@pytest.mark.parametrize("file", ["dubrovnik-3-7-pre.txt", "dubrovnik-3-7-18-pre.txt"])
def test_an_under_determined_block_is_refused(data, file):
    """Nine free parameters per image and 38 (36) observations: redundancy -3 (-5)."""
    tokens = (data("bal_dubrovnik_tiny") / file).read_text().split()
    n_cameras, n_points, n = (int(t) for t in tokens[:3])
    rows = np.array(tokens[3 : 3 + 4 * n], dtype=float).reshape(n, 4)
    rest = np.array(tokens[3 + 4 * n :], dtype=float)
    blocks, xyz = rest[: 9 * n_cameras].reshape(-1, 9), rest[9 * n_cameras :].reshape(-1, 3)
    model = cameras.model("RADIAL")
    free = ("principal_distance", "k1", "k2")
    cams = tuple(cameras.create(str(i), model, dict(zip(free, b[6:], strict=True)), free=free, y_down=False) for i, b in enumerate(blocks))
    rotation = exp(blocks[:, :3])
    position = -np.einsum("nji,nj->ni", rotation, blocks[:, 3:6])
    images = Images.make([str(i) for i in range(n_cameras)], np.arange(n_cameras), position, rotation)
    group = ImagePoints.make(rows[:, 0].astype(int), rows[:, 1].astype(int), rows[:, 2:])
    network = Network(cams, images, Points.make([str(i) for i in range(n_points)], xyz), (group,))
    cost = 0.5 * np.sum(group.misclosures(network, baarda.network.State.of(network)) ** 2)
    if n == 19:
        assert cost == pytest.approx(2764.219984, abs=5e-7)
    with pytest.raises(
        RedundancyNotPositive, match=rf"redundancy {2 * n - 48 + 7}: n = {2 * n} observations, u = 48 unknowns, datum defect d = 7"
    ):
        baarda.adjust(network)
    fixed = baarda.adjust(network, camera=())
    assert fixed.redundancy == 2 * n - 32
