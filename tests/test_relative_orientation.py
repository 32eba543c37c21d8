"""Relative orientation: exact scenes, planes, noise against the optimum, gross errors, missing parallax, a real aerial pair."""

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
from baarda.geometry.relative_orientation import RelativeOrientation, relative_orientation

Array = NDArray[np.float64]
DATA = Path(os.environ.get("BAARDA_DATA", Path(__file__).parents[2] / "shared" / "data"))
KINDS = ["solid", "plane", "narrow", "forward"]


def project(M: Array, X0: Array, X: Array) -> Array:
    P = (X - X0) @ M.T
    return -P[:, :2] / P[:, 2:]


def scene(rng: np.random.Generator, n: int, kind: str) -> tuple[Array, Array, Array, Array, Array]:
    """Both images, M2, base and model points: a solid, a tilted plane, almost flat terrain under 20 degrees, or a forward motion."""
    while True:
        M = Rotation.from_euler("xyz", rng.normal(size=3) * [0.15, 0.15, 0.5]).as_matrix()
        base = np.array([0.1, 0.05, -1.0]) if kind == "forward" else rng.normal(size=3) * [1, 1, 0.3]
        base /= np.linalg.norm(base)
        rays = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)) * (0.35 if kind == "narrow" else 1.0), -np.ones(n)])
        if kind == "plane":
            X = rays * (-3 / (rays @ np.r_[rng.normal(size=2) * 0.3, 1.0]))[:, None]
        else:
            low, high = {"solid": (2, 6), "narrow": (3.992, 4.008), "forward": (3, 9)}[kind]
            X = rays * rng.uniform(low, high, (n, 1))
        P = (X - base) @ M.T
        if np.all(P[:, 2] < -0.5) and np.abs(P[:, :2] / P[:, 2:]).max() < 1.5:
            return project(np.eye(3), np.zeros(3), X), project(M, base, X), M, base, X


def distances(xy1: Array, xy2: Array, M: Array, base: Array) -> Array:
    """Sampson distances written out from the determinant of base and rays, derivatives by exact bilinearity."""
    r1, r2 = (np.column_stack([xy, -np.ones(len(xy))]) for xy in (xy1, xy2))
    volume = np.sum(np.cross(base, r1) * (r2 @ M), axis=1)
    d1 = np.stack([np.sum(np.cross(base, e) * (r2 @ M), axis=1) for e in np.eye(3)[:2]])
    d2 = np.stack([np.cross(base, r1) @ M.T @ e for e in np.eye(3)[:2]])
    return volume / np.sqrt(np.sum(d1**2, axis=0) + np.sum(d2**2, axis=0))


def optimum(xy1: Array, xy2: Array, M: Array, base: Array) -> float:
    def residuals(p: Array) -> Array:
        shifted = base + p[3:]
        return distances(xy1, xy2, Rotation.from_rotvec(p[:3]).as_matrix() @ M, shifted / np.linalg.norm(shifted))

    best = least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return float(np.sqrt(np.mean(best.fun**2)))


def errors(pair: RelativeOrientation, M: Array, base: Array) -> list[float]:
    """Largest difference of rotation and base, for the orientation found and its alternatives."""
    return [float(max(np.abs(p.rotation - M).max(), np.abs(p.base - base).max())) for p in (pair, *pair.alternatives)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [5, 6, 8, 25, 100])
def test_exact_scene_is_recovered(kind: str, n: int) -> None:
    rng = np.random.default_rng(200 + n)
    for _ in range(4):
        xy1, xy2, M, base, X = scene(rng, n, kind)
        pair = relative_orientation(xy1, xy2)
        found = errors(pair, M, base)
        # five points, and points in a plane, can have several exact orientations
        best = int(np.argmin(found)) if n == 5 or kind == "plane" else 0
        assert found[best] < 1e-8
        assert pair.inliers.all()
        assert pair.rms < 1e-12
        assert np.abs((pair, *pair.alternatives)[best].points - X).max() < 1e-7


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(5, 12), kind=st.sampled_from(KINDS))
@settings(derandomize=True, deadline=None, max_examples=25)
def test_result_is_in_front_and_normalised(seed: int, n: int, kind: str) -> None:
    xy1, xy2, *_ = scene(np.random.default_rng(seed), n, kind)
    pair = relative_orientation(xy1, xy2)
    for p in (pair, *pair.alternatives):
        assert np.allclose(p.rotation @ p.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(p.rotation) > 0
        assert np.linalg.norm(p.base) == pytest.approx(1.0)
        assert np.allclose(p.residuals, distances(xy1, xy2, p.rotation, p.base), atol=1e-12)
    assert np.all(pair.points[:, 2] < 0)
    assert np.all((pair.points - pair.base) @ pair.rotation[2] < 0)
    assert np.allclose(project(np.eye(3), np.zeros(3), pair.points), xy1, atol=1e-9)
    assert np.allclose(project(pair.rotation, pair.base, pair.points), xy2, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [7, 12, 60])
def test_noisy_scene_reaches_the_optimum(kind: str, n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(4):
        xy1, xy2, M, base, _ = scene(rng, n, kind)
        xy1, xy2 = (xy + rng.normal(size=xy.shape) * 1e-4 for xy in (xy1, xy2))
        pair = relative_orientation(xy1, xy2, robust=False)
        assert pair.rms <= optimum(xy1, xy2, M, base) * (1 + 1e-6)
        assert min(errors(pair, M, base)) < 0.15


def test_plane_reports_both_orientations() -> None:
    """A plane has two exact orientations; about one pair in six sees all points in front of both cameras in either."""
    rng = np.random.default_rng(9)
    pairs = [relative_orientation(*scene(rng, 12, "plane")[:2]) for _ in range(25)]
    assert {len(p.alternatives) for p in pairs if all(a.rms < 1e-10 for a in p.alternatives)} == {0, 1}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "share"), [(40, 0.2), (150, 0.4)])
def test_gross_errors_are_left_out(kind: str, n: int, share: float) -> None:
    rng = np.random.default_rng(n)
    for _ in range(2):
        xy1, xy2, M, base, _ = scene(rng, n, kind)
        xy1, xy2 = (xy + rng.normal(size=xy.shape) * 1e-4 for xy in (xy1, xy2))
        wrong = rng.permutation(n)[: int(share * n)]
        xy2[wrong] = rng.uniform(-0.5, 0.5, (len(wrong), 2))
        pair = relative_orientation(xy1, xy2)
        good = np.ones(n, dtype=bool)
        good[wrong] = False
        assert pair.inliers[good].mean() > 0.9
        assert pair.inliers[wrong].mean() < 0.2  # a wrong point may lie on its epipolar line by chance
        assert min(errors(pair, M, base)) < 0.05


def test_result_is_deterministic() -> None:
    xy1, xy2, *_ = scene(np.random.default_rng(2), 500, "narrow")
    xy2 = xy2 + np.random.default_rng(3).normal(size=xy2.shape) * 1e-4
    first, second = relative_orientation(xy1, xy2), relative_orientation(xy1, xy2)
    assert np.array_equal(first.rotation, second.rotation)
    assert np.array_equal(first.inliers, second.inliers)


@pytest.mark.parametrize("n", [5, 10, 50])
@pytest.mark.parametrize("sigma", [0.0, 1e-4])
def test_rotation_alone_is_refused(n: int, sigma: float) -> None:
    rng = np.random.default_rng(4)
    xy1, _, M, _, X = scene(rng, n, "solid")
    xy2 = project(M, np.zeros(3), X) + rng.normal(size=xy1.shape) * sigma
    if n == 5 and sigma > 0:
        return  # five pairs fit exactly: nothing tells noise from parallax
    with pytest.raises(Singular, match="parallax"):
        relative_orientation(xy1, xy2)


def test_refusals() -> None:
    xy1, xy2, *_ = scene(np.random.default_rng(5), 8, "solid")
    with pytest.raises(UsageError, match="at least 5"):
        relative_orientation(xy1[:4], xy2[:4])
    with pytest.raises(UsageError, match="shape"):
        relative_orientation(xy1, xy2[:7])
    with pytest.raises(UsageError, match="finite"):
        relative_orientation(xy1, xy2 * np.nan)
    with pytest.raises(UsageError, match="at least 7"):
        relative_orientation(xy1[:6], xy2[:6], robust=True)


def test_coincident_points_are_refused() -> None:
    with pytest.raises(Singular):
        relative_orientation(np.zeros((9, 2)), np.zeros((9, 2)))


EO = {  # dbat_sxb, bundle with tie points: omega, phi, kappa (degrees), X0 (metres)
    3: ([-0.159645, 0.006196, 94.400652], [1000077.371177, 112417.544493, 1910.362078]),
    4: ([-0.202540, 0.134993, 96.145997], [1000094.134327, 112202.936957, 1906.983111]),
}


def test_aerial_pair() -> None:
    """24 x 35 degrees, base / height 0.12, almost flat town: against the bundle's orientation within the sigmas of two images alone."""
    folder = DATA / "dbat_sxb"
    if not folder.is_dir():
        pytest.skip("reference data 'dbat_sxb' not found: set BAARDA_DATA")
    marks = np.loadtxt(folder / "measurements/smartpts.txt", delimiter=",")
    images = [{row[0]: (row[2:] * 0.006 * [1, -1] - [26.5770, -38.8110]) / 123.9392 for row in marks[marks[:, 1] == k]} for k in (3, 4)]
    both = sorted(set(images[0]) & set(images[1]))
    xy1, xy2 = (np.array([image[code] for code in both]) for image in images)
    pair = relative_orientation(xy1, xy2)
    M1, M2 = (Rotation.from_euler("XYZ", np.radians(EO[k][0])).as_matrix().T for k in (3, 4))
    base = M1 @ (np.array(EO[4][1]) - EO[3][1])
    assert len(both) > 100
    assert pair.inliers.mean() > 0.9
    assert pair.rms * 123.9392 / 0.006 < 1.0  # pixels
    assert Rotation.from_matrix(pair.rotation @ (M2 @ M1.T).T).magnitude() < 0.003
    assert np.arccos(pair.base @ base / np.linalg.norm(base)) < 0.03


def test_same_as_colmap() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the oracle pycolmap is not installed (extra 'oracle')")
    rng = np.random.default_rng(6)
    lens = pycolmap.Camera(model="SIMPLE_PINHOLE", width=2000, height=2000, params=[1000.0, 1000.0, 1000.0])
    turned = np.diag([1.0, -1.0, -1.0])  # its camera looks along +z, y down
    xy1, xy2, *_ = scene(rng, 100, "solid")
    xy1, xy2 = (xy + rng.normal(size=xy.shape) * 1e-4 for xy in (xy1, xy2))
    pixels = [xy * [1000, -1000] + 1000 for xy in (xy1, xy2)]
    theirs = pycolmap.estimate_essential_matrix(*pixels, lens, lens)["cam2_from_cam1"].matrix()
    pair = relative_orientation(xy1, xy2)
    M = turned @ theirs[:, :3] @ turned
    base = -M.T @ turned @ theirs[:, 3]
    base /= np.linalg.norm(base)
    assert np.abs(pair.rotation - M).max() < 2e-3
    assert np.abs(pair.base - base).max() < 2e-3
    assert np.sqrt(np.mean(distances(xy1, xy2, M, base)[pair.inliers] ** 2)) >= pair.rms
