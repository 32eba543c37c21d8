"""Intersection: exact and noisy points, order of the rays, status of bad geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from baarda.errors import UsageError
from baarda.geometry.intersection import PointStatus, intersect

Array = NDArray[np.float64]
DOWN = np.eye(3)


def block(rng: np.random.Generator, n_points: int, n_rays: int) -> tuple[Array, Array, Array, NDArray[np.int64], Array]:
    """Rays of an aerial block at coordinates of 1e6 m: image coordinates, rotations, positions, point codes, points."""
    X = rng.uniform(-500, 500, (n_points, 3)) * [1, 1, 0.1] + [1e6, 5e6, 100]
    M = Rotation.from_euler("xyz", rng.normal(size=(40, 3)) * [0.05, 0.05, 2]).as_matrix()
    X0 = rng.uniform(-700, 700, (40, 3)) * [1, 1, 0.05] + [1e6, 5e6, 1500]
    point, image = rng.integers(0, n_points, n_rays), rng.integers(0, 40, n_rays)
    P = np.einsum("nij,nj->ni", M[image], X[point] - X0[image])
    return -P[:, :2] / P[:, 2:], M[image], X0[image], point, X


def test_exact_points_are_recovered() -> None:
    xy, M, X0, point, X = block(np.random.default_rng(0), 500, 3000)
    found = intersect(xy, M, X0, point, 500)
    ok = found.status == PointStatus.OK
    assert ok.mean() > 0.95
    assert np.abs(found.points - X)[ok].max() < 1e-8
    assert np.array_equal(found.rays, np.bincount(point, minlength=500))
    assert np.nanmax(found.rms) < 1e-12


@given(seed=st.integers(0, 2**32 - 1))
@settings(derandomize=True, deadline=None, max_examples=20)
def test_order_of_rays_and_large_coordinates_do_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, M, X0, point, _ = block(rng, 12, 60)
    xy = xy + rng.normal(size=xy.shape) * 1e-4
    order, shift = rng.permutation(60), np.array([1e6, 5e6, 0])
    here = intersect(xy, M, X0, point, 12)
    there = intersect(xy[order], M[order], (X0 - shift)[order], point[order], 12)
    assert np.array_equal(here.status, there.status)
    assert np.allclose(here.points - shift, there.points, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize("weighted", [False, True])
def test_noisy_points_reach_the_optimum(weighted: bool) -> None:
    rng = np.random.default_rng(1)
    xy, M, X0, point, X = block(rng, 30, 150)
    sigmas = rng.uniform(1e-5, 3e-4, len(xy)) if weighted else np.full(len(xy), 1e-4)
    xy = xy + rng.normal(size=xy.shape) * sigmas[:, None]
    found = intersect(xy, M, X0, point, 30, sigmas=sigmas if weighted else None)
    for k in np.flatnonzero(found.status == PointStatus.OK):
        use = point == k

        def residuals(shift: Array, use: NDArray[np.bool_] = use, k: int = k) -> Array:
            P = np.einsum("nij,nj->ni", M[use], X[k] + shift - X0[use])
            return ((-P[:, :2] / P[:, 2:] - xy[use]) / sigmas[use, None]).ravel()

        best = least_squares(residuals, np.zeros(3), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert np.sum(residuals(found.points[k] - X[k]) ** 2) <= np.sum(best.fun**2) * (1 + 1e-6) + 1e-12
        mean = np.sum(best.fun**2) / np.sum(2 / sigmas[use] ** 2)
        assert found.rms[k] == pytest.approx(np.sqrt(mean), rel=1e-5, abs=1e-12)


def test_status_of_bad_geometry() -> None:
    xy = [[0.1, 0], [0, 0], [0, 0], [0.1, 0], [0.1 + 1e-5, 0], [0.1, 0], [-0.1, 0], [-0.1, 0], [0.1, 0]]
    X0 = [[0, 0, 9], [5, 0, 9], [5, 0, 10], [0, 0, 10], [0, 0, 10], [0, 0, 10], [2, 0, 10], [0, 0, 10], [2, 0, 10]]
    #     one ray     same line twice       almost the same ray       good                  meet above the cameras
    point = [0, 1, 1, 2, 2, 3, 3, 4, 4]
    found = intersect(xy, DOWN, X0, point, 6)
    S = PointStatus
    assert list(found.status) == [S.TOO_FEW_RAYS, S.ALMOST_PARALLEL, S.ALMOST_PARALLEL, S.OK, S.BEHIND_CAMERA, S.TOO_FEW_RAYS]
    assert found.rays.tolist() == [1, 2, 2, 2, 2, 0]
    assert np.isnan(found.points[[0, 1, 2, 5]]).all()
    assert np.allclose(found.points[3], [1, 0, 0], atol=1e-12)
    assert np.allclose(found.points[4], [1, 0, 20], atol=1e-12)
    assert np.isnan(found.rms[[0, 1, 2, 4, 5]]).all()
    assert np.allclose(found.angles[:5], [0, 0, 1e-5 / 1.01, 2 * np.arctan(0.1), 2 * np.arctan(0.1)], rtol=1e-4)
    assert np.isnan(found.angles[5])


def test_rays_that_face_each_other_count_as_parallel() -> None:
    up = np.diag([1.0, -1.0, -1.0])
    found = intersect([[0, 0], [0, 0]], [DOWN, up], [[0, 0, 10], [0, 0, -10]], [0, 0])
    assert found.status[0] == PointStatus.ALMOST_PARALLEL


def test_small_parallax_is_intersected_when_allowed() -> None:
    x = np.array([1e-4, -1e-4])
    found = intersect(np.column_stack([x, x * 0]), DOWN, [[0, 0, 1000], [0.2, 0, 1000]], [0, 0], min_angle=1e-5)
    assert found.angles[0] == pytest.approx(2e-4, rel=1e-6)
    assert np.allclose(found.points[0], [0.1, 0, 0], atol=1e-5)


def test_more_rays_and_fewer_than_wanted() -> None:
    xy, M, X0, point, _ = block(np.random.default_rng(3), 50, 200)
    found = intersect(xy, M, X0, point, 50, min_rays=4)
    assert np.array_equal(found.status == PointStatus.TOO_FEW_RAYS, np.bincount(point, minlength=50) < 4)


def test_angle_of_many_rays_is_close_to_the_largest() -> None:
    rng = np.random.default_rng(4)
    xy, M, X0, point, X = block(rng, 40, 400)
    found = intersect(xy, M, X0, point, 40)
    for k in range(40):
        d = X0[point == k] - X[k]
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        largest = np.arccos(np.clip(d @ d.T, -1, 1)).max()
        assert 0.5 * largest - 1e-9 <= found.angles[k] <= largest + 1e-9


def test_no_rays_at_all() -> None:
    found = intersect(np.empty((0, 2)), np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0, dtype=int), 2)
    assert found.points.shape == (2, 3)
    assert list(found.status) == [PointStatus.TOO_FEW_RAYS] * 2


def test_same_as_colmap_midpoint() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the oracle pycolmap is not installed (extra 'oracle')")
    turned = np.diag([1.0, -1.0, -1.0])  # its camera looks along +z, y down
    rng = np.random.default_rng(5)
    for _ in range(5):
        X, M = rng.normal(size=3), Rotation.from_euler("xyz", rng.normal(size=(2, 3)) * 0.1).as_matrix()
        X0 = np.array([[-1, 0, 8.0], [1, 0.5, 9.0]])
        P = np.einsum("nij,nj->ni", M, X - X0)
        xy = -P[:, :2] / P[:, 2:]
        theirs = pycolmap.triangulate_point(*[np.column_stack([turned @ m, -turned @ m @ c]) for m, c in zip(M, X0)], *(xy * [1, -1]))
        assert np.allclose(intersect(xy, M, X0, [0, 0]).points[0], theirs, atol=1e-9)


def test_refusals() -> None:
    xy, X0 = np.zeros((2, 2)), np.zeros((2, 3))
    with pytest.raises(UsageError, match="from 0 to 0"):
        intersect(xy, DOWN, X0, [0, 1], 1)
    with pytest.raises(UsageError, match="from 0"):
        intersect(xy, DOWN, X0, [0, -1])
    with pytest.raises(UsageError, match="integers"):
        intersect(xy, DOWN, X0, [0.0, 1.0])
    with pytest.raises(UsageError, match="codes"):
        intersect(xy, DOWN, X0, [0])
    with pytest.raises(UsageError, match="for 2 rays"):
        intersect(xy, np.eye(2), X0, [0, 0])
    with pytest.raises(UsageError, match="finite"):
        intersect(xy * np.nan, DOWN, X0, [0, 0])
    with pytest.raises(UsageError, match="sigmas"):
        intersect(xy, DOWN, X0, [0, 0], sigmas=[0, 1])
    with pytest.raises(UsageError, match="min_rays"):
        intersect(xy, DOWN, X0, [0, 0], min_rays=1)
