"""Similarity transformation: exact, weighted, fixed scale, planar points, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from baarda.errors import UsageError
from baarda.geometry.similarity import similarity


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 20), planar=st.booleans())
@settings(derandomize=True, deadline=None, max_examples=60)
def test_exact_transformation_is_recovered(seed: int, n: int, planar: bool) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(n, 3)) * [1, 1, 0 if planar else 1] * 100
    R, t, scale = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3) * 1e4, rng.uniform(0.01, 100)
    found = similarity(source, scale * source @ R.T + t)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert np.allclose(found.rotation, R, atol=1e-7)
    assert np.allclose(found.translation, t, atol=1e-7 * (1 + scale) * 1e2)
    assert np.allclose(found.apply(source), scale * source @ R.T + t, atol=1e-8 * scale * 100 + 1e-9)


@given(seed=st.integers(0, 2**32 - 1), with_scale=st.booleans())
@settings(derandomize=True, deadline=None, max_examples=15)
def test_weighted_fit_is_the_least_squares_optimum(seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal([1e3, -1e3, 50], 1.0, (8, 3))
    target = 1.3 * source @ Rotation.from_quat(rng.normal(size=4)).as_matrix().T + rng.normal(size=(8, 3)) * 0.2
    weights = rng.uniform(0.1, 10, 8)
    scale, R, t = similarity(source, target, weights, with_scale)
    assert with_scale or scale == 1.0
    centre = source.mean(axis=0)

    def residuals(p: np.ndarray) -> np.ndarray:
        s = scale * np.exp(p[6]) if with_scale else 1.0
        moved = s * (source - centre) @ (Rotation.from_rotvec(p[:3]).as_matrix() @ R).T + scale * R @ centre + t + p[3:6]
        return (np.sqrt(weights)[:, None] * (moved - target)).ravel()

    best = least_squares(residuals, np.zeros(7), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.sum(residuals(np.zeros(7)) ** 2) <= np.sum(best.fun**2) * (1 + 1e-9)


def test_zero_weight_removes_a_point() -> None:
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    target[5] = 1e6
    with_zero, without = similarity(source, target, [1, 1, 1, 1, 1, 0]), similarity(source[:5], target[:5])
    assert np.allclose(with_zero.rotation, without.rotation)
    assert with_zero.scale == pytest.approx(without.scale)


def test_mirror_image_still_gives_a_rotation() -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(10, 3))
    found = similarity(source, source * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_large_coordinates() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(10, 3)) * 100 + [4e6, 5e6, 100]
    R = Rotation.from_euler("xyz", [0.1, -0.2, 2]).as_matrix()
    target = 0.5 * (source - [4e6, 5e6, 0]) @ R.T
    assert np.allclose(similarity(source, target).apply(source), target, atol=1e-8)


def test_same_as_colmap() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the oracle pycolmap is not installed (extra 'oracle')")
    rng = np.random.default_rng(3)
    source, target = rng.normal(size=(12, 3)), rng.normal(size=(12, 3)) + 3
    ours, theirs = similarity(source, target), pycolmap.estimate_sim3d(source, target).matrix()
    assert np.allclose(ours.scale * ours.rotation, theirs[:, :3], atol=1e-9)
    assert np.allclose(ours.translation, theirs[:, 3], atol=1e-9)


def test_refusals() -> None:
    line = np.array([1e6, 1e6, 0.0]) + np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    solid = np.random.default_rng(4).normal(size=(5, 3))
    with pytest.raises(UsageError, match="source points lie on one straight line"):
        similarity(line, solid)
    with pytest.raises(UsageError, match="target points lie on one straight line"):
        similarity(solid, line)
    with pytest.raises(UsageError, match="source points"):
        similarity(np.ones((4, 3)), solid[:4])
    with pytest.raises(UsageError, match="at least 3"):
        similarity(solid[:2], solid[:2])
    with pytest.raises(UsageError, match="at least 3"):
        similarity(solid, solid, [1, 1, 0, 0, 0])
    with pytest.raises(UsageError, match="shape"):
        similarity(solid, solid[:4])
    with pytest.raises(UsageError, match="weights"):
        similarity(solid, solid, [1, 1, 1, 1, -1])
    with pytest.raises(UsageError, match="finite"):
        similarity(solid, np.full((5, 3), np.nan))
