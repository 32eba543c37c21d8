"""Rotations: angles, increments and partials against definitions, SciPy and differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from baarda.geometry import collinearity
from baarda.geometry import rotation as rot

ANGLE = st.floats(-3.1, 3.1)
TILT = st.floats(-1.5, 1.5)


@given(ANGLE, TILT, ANGLE)
@settings(derandomize=True, deadline=None)
def test_angles_there_and_back(omega, phi, kappa):
    m = rot.from_angles(omega, phi, kappa)
    np.testing.assert_allclose(rot.to_angles(m), [omega, phi, kappa], atol=1e-12)
    assert np.linalg.det(m) == pytest.approx(1.0)


@given(ANGLE, TILT, ANGLE)
@settings(derandomize=True, deadline=None)
def test_m_is_the_transpose_of_the_intrinsic_rotation(omega, phi, kappa):
    """SciPy's capital XYZ turns camera into object; M is camera from object (Kraus, appendix 2.1)."""
    np.testing.assert_allclose(
        rot.from_angles(omega, phi, kappa), Rotation.from_euler("XYZ", [omega, phi, kappa]).as_matrix().T, atol=1e-14
    )


def test_m_is_the_product_of_three_axis_rotations():
    o, p, k = 0.3, -0.7, 1.9
    r1 = np.array([[1, 0, 0], [0, np.cos(o), np.sin(o)], [0, -np.sin(o), np.cos(o)]])
    r2 = np.array([[np.cos(p), 0, -np.sin(p)], [0, 1, 0], [np.sin(p), 0, np.cos(p)]])
    r3 = np.array([[np.cos(k), np.sin(k), 0], [-np.sin(k), np.cos(k), 0], [0, 0, 1]])
    np.testing.assert_allclose(rot.from_angles(o, p, k), r3 @ r2 @ r1, atol=1e-15)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
@settings(derandomize=True, deadline=None)
def test_exponential_against_scipy(theta):
    np.testing.assert_allclose(rot.exp(np.array(theta)), Rotation.from_rotvec(theta).as_matrix(), atol=1e-14)


def test_exponential_of_tiny_vectors_keeps_its_digits():
    theta = np.array([3e-9, -2e-9, 1e-9])
    np.testing.assert_allclose(rot.exp(theta) - np.eye(3), rot.skew(theta), rtol=1e-7, atol=1e-17)
    np.testing.assert_array_equal(rot.exp(np.zeros(3)), np.eye(3))


@pytest.mark.parametrize("angles", [(0.1, 0.2, 0.3), (-2.0, 1.3, 3.0), (0.0, 0.0, 0.0), (1.0, -1.4, -2.0)])
def test_partials_of_angles_against_differences(angles):
    m = rot.from_angles(*angles)
    h = 1e-6
    numeric = np.stack([(rot.to_angles(rot.exp(h * e) @ m) - rot.to_angles(rot.exp(-h * e) @ m)) / (2 * h) for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(rot.angle_partials(m), numeric, atol=2e-8)


def test_at_the_singularity_angles_have_no_partials():
    m = rot.from_angles(0.4, np.pi / 2, 0.1)
    assert np.isnan(rot.angle_partials(m)[0, 0])
    omega, phi, kappa = rot.to_angles(m)
    assert omega == 0.0
    np.testing.assert_allclose(rot.from_angles(omega, phi, kappa), m, atol=1e-12)


def test_partials_of_the_collinearity_equations():
    rng = np.random.default_rng(3)
    m = rot.exp(rng.standard_normal((20, 3)))
    x0 = rng.standard_normal((20, 3))
    x = x0 + np.einsum("nji,nj->ni", m, np.column_stack([rng.uniform(-1, 1, (20, 2)), -rng.uniform(2, 5, 20)]))

    def project(m, x0, x):
        return collinearity.project(collinearity.camera_coordinates(m, x0, x))[0]

    v = collinearity.camera_coordinates(m, x0, x)
    xy, d_v, front = collinearity.project(v)
    assert front.all()
    np.testing.assert_allclose(xy, -v[:, :2] / v[:, 2:])
    exterior, point = collinearity.partials(m, v, d_v)
    h = 1e-6
    for j, e in enumerate(np.eye(3)):
        np.testing.assert_allclose(exterior[:, :, j], (project(m, x0 + h * e, x) - project(m, x0 - h * e, x)) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(point[:, :, j], (project(m, x0, x + h * e) - project(m, x0, x - h * e)) / (2 * h), atol=1e-8)
        turned = (project(rot.exp(h * e) @ m, x0, x) - project(rot.exp(-h * e) @ m, x0, x)) / (2 * h)
        np.testing.assert_allclose(exterior[:, :, 3 + j], turned, atol=1e-8)


def test_points_behind_are_flagged():
    assert not collinearity.project(np.array([[0.0, 0.0, 1.0]]))[2][0]
