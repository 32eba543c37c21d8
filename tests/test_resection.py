"""Resection: exact scenes, noise against the least-squares optimum, gross errors, published and real images."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from baarda.errors import Singular, UsageError
from baarda.geometry.resection import resect, resect_three

Array = NDArray[np.float64]
DATA = Path(os.environ.get("BAARDA_DATA", Path(__file__).parents[2] / "shared" / "data"))
KINDS = ["solid", "plane", "aerial"]


def shared(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"reference data '{name}' not found: set BAARDA_DATA")
    return DATA / name


def camera(omega: float, phi: float, kappa: float) -> Array:
    """M = R3(kappa) R2(phi) R1(omega), the transpose of the camera-to-object product."""
    return Rotation.from_euler("XYZ", [omega, phi, kappa]).as_matrix().T


def project(M: Array, X0: Array, X: Array) -> Array:
    P = (X - X0) @ M.T
    return -P[:, :2] / P[:, 2:]


def scene(rng: np.random.Generator, n: int, kind: str) -> tuple[Array, Array, Array, Array]:
    """Image points, object points, M and X0: anywhere, an oblique plane, or flat terrain (20 degrees, depth range / height 0.001)."""
    while True:
        X0 = rng.normal(size=3) * 1e6
        if kind == "solid":
            M = Rotation.from_quat(rng.normal(size=4)).as_matrix()
            xy = rng.uniform(-0.5, 0.5, (n, 2))
            return xy, X0 + (np.column_stack([xy, -np.ones(n)]) * rng.uniform(10, 30, (n, 1))) @ M, M, X0
        tilt, half, height, relief = (0.4, 0.5, 100.0, 0.0) if kind == "plane" else (0.02, np.tan(np.radians(10)), 2000.0, 1.0)
        M = camera(*(rng.normal(size=3) * [tilt, tilt, 2]))
        xy = rng.uniform(-half, half, (n, 2))
        rays = np.column_stack([xy, -np.ones(n)]) @ M
        if np.all(rays[:, 2] < -0.15):
            X0[2] = height
            return xy, X0 + rays * ((rng.uniform(-relief, relief, n) - height) / rays[:, 2])[:, None], M, X0


def optimum(xy: Array, X: Array, M: Array, X0: Array) -> float:
    """Smallest rms near the true orientation, by an independent solver."""
    centre = X.mean(axis=0)

    def residuals(p: Array) -> Array:
        P = (X - centre) @ (Rotation.from_rotvec(p[:3]).as_matrix() @ M).T + p[3:]
        return (-P[:, :2] / P[:, 2:] - xy).ravel()

    start = np.r_[0.0, 0.0, 0.0, M @ (centre - X0)]
    best = least_squares(residuals, start, method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return float(np.sqrt(np.mean(best.fun**2)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [4, 5, 7, 8, 30])
def test_exact_scene_is_recovered(kind: str, n: int) -> None:
    rng = np.random.default_rng(100 + n)
    for _ in range(6):
        xy, X, M, X0 = scene(rng, n, kind)
        pose = resect(xy, X)
        assert pose.inliers.all()
        assert np.abs(pose.rotation - M).max() < 1e-8
        assert np.abs(pose.position - X0).max() < 1e-8 * np.ptp(X, axis=0).max()


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(4, 9), kind=st.sampled_from(KINDS))
@settings(derandomize=True, deadline=None, max_examples=40)
def test_pose_is_a_rotation_and_fits_exactly(seed: int, n: int, kind: str) -> None:
    xy, X, _, _ = scene(np.random.default_rng(seed), n, kind)
    pose = resect(xy, X)
    assert pose.rms < 1e-9
    assert np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) > 0
    assert np.all((X - pose.position) @ pose.rotation[2] < 0)
    assert np.allclose(project(pose.rotation, pose.position, X), xy, atol=1e-8)


@given(seed=st.integers(0, 2**32 - 1))
@settings(derandomize=True, deadline=None, max_examples=25)
def test_moving_the_object_system_moves_the_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, X, _, _ = scene(rng, 6, "solid")
    xy = xy + rng.normal(size=xy.shape) * 1e-3
    R, t, scale = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3) * 1e3, rng.uniform(0.1, 10)
    X = X - X.mean(axis=0)
    here, there = resect(xy, X), resect(xy, scale * X @ R.T + t)
    assert there.rms == pytest.approx(here.rms, rel=1e-9)
    assert np.allclose(there.rotation, here.rotation @ R.T, atol=1e-6)
    assert np.allclose(there.position, scale * R @ here.position + t, atol=1e-4 * scale)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [4, 6, 12])
@pytest.mark.parametrize("sigma", [1e-4, 2e-3])
def test_noisy_scene_reaches_the_optimum(kind: str, n: int, sigma: float) -> None:
    rng = np.random.default_rng(n)
    for _ in range(8):
        xy, X, M, X0 = scene(rng, n, kind)
        noisy = xy + rng.normal(size=xy.shape) * sigma
        pose = resect(noisy, X, robust=False)
        assert pose.rms <= optimum(noisy, X, M, X0) * (1 + 1e-8)


@pytest.mark.parametrize("tilt", [0.0, 1e-8, 1e-4, 0.01, 0.1])
def test_square_seen_frontally(tilt: float) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    M, X0 = camera(tilt, tilt / 2, 0.3), np.array([0.5, 0.5, 2.0])
    xy = project(M, X0, square)
    assert np.abs(resect(xy, square).position - X0).max() < 1e-8
    noisy = xy + np.random.default_rng(7).normal(size=xy.shape) * 1e-3
    assert resect(noisy, square).rms <= optimum(noisy, square, M, X0) * (1 + 1e-8)


def test_plane_under_a_narrow_angle_has_a_mirrored_alternative() -> None:
    rng = np.random.default_rng(3)
    X = np.column_stack([rng.uniform(-1, 1, (6, 2)), np.zeros(6)])
    M = camera(0.5, 0.2, 1.0)
    X0 = -M.T @ np.array([0.1, 0.0, -30.0])
    pose = resect(project(M, X0, X), X)
    assert np.allclose(pose.position, X0, atol=1e-7)
    mirrored = pose.alternatives[0]
    assert pose.rms < mirrored.rms < 1e-3
    # the two normals of the plane lie on opposite sides of the line of sight
    sight = X0 / np.linalg.norm(X0)
    assert np.arccos(mirrored.rotation[:, 2] @ M @ sight) == pytest.approx(np.arccos(sight[2]), abs=0.06)
    assert np.arccos(mirrored.rotation[:, 2] @ M[:, 2]) == pytest.approx(2 * np.arccos(sight[2]), abs=0.06)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "share"), [(12, 0.2), (30, 0.4), (200, 0.4)])
def test_gross_errors_are_left_out(kind: str, n: int, share: float) -> None:
    rng = np.random.default_rng(n)
    for _ in range(3):
        xy, X, M, X0 = scene(rng, n, kind)
        xy = xy + rng.normal(size=xy.shape) * 1e-4
        wrong = rng.permutation(n)[: int(share * n)]
        xy[wrong] += rng.choice([-1, 1], (len(wrong), 2)) * rng.uniform(0.05, 0.3, (len(wrong), 2))
        pose = resect(xy, X)
        good = np.ones(n, dtype=bool)
        good[wrong] = False
        assert not pose.inliers[wrong].any()
        assert (pose.inliers[good]).mean() > 0.9
        assert pose.rms <= optimum(xy[pose.inliers], X[pose.inliers], M, X0) * (1 + 1e-8)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("off", [1.0, 0.01])
def test_one_point_beside_a_straight_line(robust: bool, off: float) -> None:
    X = np.array([1e6, 1e6, 0.0]) + np.outer(np.linspace(-5, 5, 31), [1.0, 0.3, 0.1])
    X[9] += [0, off, 0]
    M, X0 = camera(0.1, -0.2, 0.7), np.array([1e6 + 1, 1e6 - 2, 12.0])
    pose = resect(project(M, X0, X), X, robust=robust)
    assert min(np.abs(p.position - X0).max() for p in (pose, *pose.alternatives)) < 1e-5


def test_result_is_deterministic_and_large_images_are_quick() -> None:
    rng = np.random.default_rng(1)
    xy, X, M, _ = scene(rng, 3000, "solid")
    xy = xy + rng.normal(size=xy.shape) * 1e-4
    first, second = resect(xy, X), resect(xy, X)
    assert np.array_equal(first.position, second.position)
    assert first.inliers.mean() > 0.99
    assert np.abs(first.rotation - M).max() < 1e-4


def test_sigmas_weight_the_points() -> None:
    rng = np.random.default_rng(5)
    xy, X, _, X0 = scene(rng, 7, "solid")
    xy[0] += 0.01
    sigmas = np.r_[1.0, np.full(6, 1e-4)]
    weighted, plain = resect(xy, X, sigmas), resect(xy, X)
    assert np.abs(weighted.position - X0).max() < 1e-6
    assert np.abs(plain.position - X0).max() > 1e-3
    assert np.allclose(weighted.residuals[0], -0.01, atol=1e-6)


def test_three_points_all_solutions() -> None:
    rng = np.random.default_rng(11)
    counts = set()
    for _ in range(60):
        xy, X, M, _ = scene(rng, 3, "solid")
        poses = resect_three(xy, X)
        counts.add(len(poses))
        assert min(np.abs(p.rotation - M).max() for p in poses) < 1e-7
        for p in poses:
            assert np.allclose(project(p.rotation, p.position, X), xy, atol=1e-9)
        down = [p.rotation[2, 2] for p in poses]
        assert down == sorted(down, reverse=True)
    assert counts <= {1, 2, 3, 4}
    assert {2, 4} <= counts


def test_three_points_of_a_symmetric_figure() -> None:
    """Equilateral triangle on the axis: four solutions, one frontal and three tilted (Haralick et al., section 2)."""
    angle = np.radians([90, 210, 330])
    X = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(3)])
    poses = resect_three(project(np.eye(3), np.array([0, 0, 2.0]), X), X)
    assert len(poses) == 4
    assert np.allclose(poses[0].position, [0, 0, 2.0], atol=1e-9)
    assert len({round(float(np.linalg.norm(p.position)), 6) for p in poses[1:]}) == 1


def test_refusals() -> None:
    line = np.array([1e6, 1e6, 100.0]) + np.outer(np.arange(5.0), [1.0, 2.0, 7.0])
    xy = np.random.default_rng(0).normal(size=(5, 2))
    with pytest.raises(Singular, match="straight line"):
        resect(xy, line)
    with pytest.raises(UsageError, match="at least 3"):
        resect(xy[:2], line[:2])
    with pytest.raises(UsageError, match="needed"):
        resect(xy[:4], line)
    with pytest.raises(UsageError, match="finite"):
        resect(xy[:3], [[0, 0, 0], [1, 0, np.nan], [0, 1, 0]])
    with pytest.raises(UsageError, match="sigmas"):
        resect(xy[:3], [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [1, 0, 1])
    with pytest.raises(UsageError, match="at least 5"):
        resect(xy[:4], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]], robust=True)
    with pytest.raises(Singular, match="coincide"):
        resect(np.zeros((3, 2)), [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(UsageError, match="three image points"):
        resect_three(xy[:4], line[:4])


def test_textbook_resection() -> None:
    """Mikhail, Bethel, McGlone (2001): one photo, five points, coordinates around 1e6."""
    folder = shared("resection_mikhail")
    constants = [float(v) for v in (folder / "cam.inp").read_text().split()]
    rows = [line.split() for line in (folder / "resect.inp").read_text().splitlines() if line.strip()]
    table = np.array([[float(v) for v in row[1:]] for row in rows])
    pose = resect((table[:, :2] - constants[6:8]) / constants[8], table[:, 2:])
    assert np.allclose(pose.position, [914260.4218627542, 575441.8355519563, 839.1304372341], atol=2e-5)
    assert np.allclose(pose.rotation, camera(-0.006507481143624, -0.008521803654879, -1.575322123689651), atol=2e-8)
    assert 10 * (pose.rms * constants[8]) ** 2 == pytest.approx(0.000751104878973, rel=1e-9)
    assert np.allclose(pose.residuals[0] * constants[8], [0.006870, 0.010089], atol=1e-6)


def test_calibration_images_with_four_coplanar_points() -> None:
    """21 images, four corners each: against the stations of the full block (their sigmas are about 0.2 mm, four points give some mm)."""
    folder = shared("dbat_camcal")
    control = np.loadtxt(folder / "reference/camcal-fixed.txt", delimiter=",", usecols=(0, 2, 3, 4))
    marks = np.loadtxt(folder / "measurements/markpts.txt", delimiter=",")
    stations = np.loadtxt(folder / "ref/camera_stations.txt", delimiter=",", usecols=range(8))
    f, px, py = 7.4569953411, 3.6154624127, 2.6132927582
    K, P = (4.5886067e-3, -4.513511e-5, -2.0525333e-6), (-6.128034e-5, -4.411716e-5)
    for row in stations:
        mark = marks[(marks[:, 0] == row[0]) & np.isin(marks[:, 1], control[:, 0])]
        X = np.array([control[control[:, 0] == code][0, 1:] for code in mark[:, 1]])
        u = mark[:, 2:4] * (5.43764 / 1704) * [1, -1]
        x, y = (u[:, 0] - px) * (1 + 3.8959753e-4), u[:, 1] + py
        r2 = x**2 + y**2
        radial = 1 + K[0] * r2 + K[1] * r2**2 + K[2] * r2**3
        xy = np.column_stack(
            [x * radial + P[0] * (r2 + 2 * x**2) + 2 * P[1] * x * y, y * radial + 2 * P[0] * x * y + P[1] * (r2 + 2 * y**2)]
        )
        pose = resect(xy / f, X)
        assert len(X) >= 3
        assert np.abs(pose.position - row[2:5]).max() < 0.005
        assert np.abs(pose.rotation - camera(*row[5:8])).max() < 0.003


SXB = {  # fixed control points, exterior orientation only: omega, phi, kappa (degrees), X0 (metres)
    1: ([0.783992, -0.419915, -89.916837], [999660.8333, 112369.9498, 1916.5917]),
    3: ([-0.169122, -0.022822, 94.401677], [1000076.4296, 112417.7691, 1910.4072]),
}


def test_aerial_images() -> None:
    folder = shared("dbat_sxb")
    control = np.loadtxt(folder / "reference/sxb-control.txt", delimiter=",", usecols=(0, 2, 3, 4))
    marks = np.loadtxt(folder / "measurements/markpts.txt", delimiter=",")
    for number in range(1, 6):
        mark = marks[(marks[:, 1] == number) & np.isin(marks[:, 0], control[:, 0])]
        X = np.array([control[control[:, 0] == code][0, 1:] for code in mark[:, 0]])
        xy = (mark[:, 2:] * 0.006 * [1, -1] - [26.5770, -38.8110]) / 123.9392
        pose = resect(xy, X, robust=False)
        assert pose.rms * 123.9392 / 0.006 < 1.2  # pixels
        assert np.abs(resect(xy, X).position - pose.position).max() < 5.0
        if number in SXB:
            angles, position = SXB[number]
            assert np.allclose(pose.position, position, atol=1e-3)
            assert np.allclose(pose.rotation, camera(*np.radians(angles)), atol=2e-8)


def test_same_orientation_as_colmap() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the oracle pycolmap is not installed (extra 'oracle')")
    rng = np.random.default_rng(21)
    least_squares_only = pycolmap.AbsolutePoseRefinementOptions()
    least_squares_only.loss_function_scale, least_squares_only.gradient_tolerance = 1e4, 1e-9
    lens = pycolmap.Camera(model="SIMPLE_PINHOLE", width=2000, height=2000, params=[1000.0, 1000.0, 1000.0])
    for kind in KINDS:
        xy, X, _, X0 = scene(rng, 40, kind)
        X, X0 = X - X.mean(axis=0), X0 - X.mean(axis=0)
        xy = xy + rng.normal(size=xy.shape) * 2e-4
        answer = pycolmap.estimate_and_refine_absolute_pose(xy * [1000, -1000] + 1000, X, lens, refinement_options=least_squares_only)
        theirs = answer["cam_from_world"].matrix()
        turned = np.diag([1.0, -1.0, -1.0])  # its camera looks along +z, y down
        pose = resect(xy, X)
        height = np.linalg.norm(X0)
        assert np.abs(turned @ theirs[:, :3] - pose.rotation).max() < 5e-5
        assert np.abs(-theirs[:, :3].T @ theirs[:, 3] - pose.position).max() < 5e-5 * height
