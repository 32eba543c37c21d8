"""Sets of additional parameters: orthogonal on their grids, also to the orientation; published formulas; units."""

from __future__ import annotations

import numpy as np
import pytest

from baarda import cameras
from baarda.cameras import Optics, create
from baarda.errors import UsageError

SETS = ["ebner12", "gruen44", "gruen12", "polynomial2", "polynomial3", "polynomial4", "polynomial5", "fourier1", "fourier2"]


def columns(name: str, points: np.ndarray, b: float) -> tuple[list[str], np.ndarray]:
    """Return the names and the columns (2 n, k) of a set's design matrix at points of the image plane."""
    model = cameras.model(name)
    step = model.measured[-1]
    p = np.zeros((1, len(step.parameters)))
    return [q.name for q in step.parameters], step.apply(points, p, b)[2].transpose(1, 0, 2).reshape(2 * len(points), -1)


def grid(width: int, b: float) -> np.ndarray:
    line = np.linspace(-b, b, width)
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)


def orientation(points: np.ndarray) -> np.ndarray:
    """Return the six terms that mimic the exterior orientation of a vertical image of flat ground."""
    x, y = points.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    pairs = ((one, zero), (zero, one), (x, y), (y, -x), (x * x, x * y), (x * y, y * y))
    return np.stack([np.concatenate(p) for p in pairs], axis=1)


def cosines(a: np.ndarray) -> np.ndarray:
    unit = a / np.linalg.norm(a, axis=0)
    return unit.T @ unit


@pytest.mark.parametrize(("name", "width", "count"), [("ebner12", 3, 12), ("gruen44", 5, 44)])
@pytest.mark.parametrize("b", [1.0, 0.1, 115.0])
def test_orthogonal_on_the_grid_also_to_the_orientation(name: str, width: int, count: int, b: float) -> None:
    points = grid(width, b)
    names, a = columns(name, points, b)
    assert len(names) == count
    assert 2 * width**2 - 6 == count  # with the six of the orientation the set spans every correction of the grid points
    six = orientation(points)
    products = cosines(np.column_stack([a, six]))
    own = products[:count, :count]
    np.testing.assert_allclose(own, np.eye(count), atol=1e-13)
    np.testing.assert_allclose(products[:count, count:], 0.0, atol=1e-13)
    assert np.linalg.matrix_rank(cosines(np.column_stack([a, six])), tol=1e-9) == 2 * width**2


def test_ebner_as_printed() -> None:
    b, x, y = 2.0, np.array([0.3, -1.7, 2.0]), np.array([1.1, 0.2, -2.0])
    k, m = x * x - 2 * b * b / 3, y * y - 2 * b * b / 3
    zero = np.zeros(3)
    dx = [x, y, -(2 * x * x - 4 * b * b / 3), x * y, m, zero, x * m, zero, k * y, zero, k * m, zero]
    dy = [-y, x, x * y, -(2 * y * y - 4 * b * b / 3), zero, k, zero, k * y, zero, x * m, zero, k * m]
    names, a = columns("ebner12", np.stack([x, y], axis=1), b)
    assert names == [f"E{j}" for j in range(1, 13)]
    np.testing.assert_allclose(a, np.concatenate([dx, dy], axis=1).T, rtol=1e-13, atol=1e-13)


def test_gruen_of_the_lowest_degrees_as_printed() -> None:
    b, x, y = 2.0, np.array([0.3, -1.7, 2.0]), np.array([1.1, 0.2, -2.0])
    p2 = lambda t: t * t - b * b / 2  # noqa: E731
    p3 = lambda t: t * (t * t - 17 * b * b / 20)  # noqa: E731
    p4 = lambda t: t * t * (t * t - 31 * b * b / 28) + 9 * b**4 / 70  # noqa: E731
    zero = np.zeros(3)
    names, a = columns("gruen44", np.stack([x, y], axis=1), b)
    low = [(x, -y), (y, x), (x * y, -10 / 7 * p2(y)), (-10 / 7 * p2(x), x * y), (p2(y), zero), (zero, p2(x))]
    for k, pair in enumerate(low):
        np.testing.assert_allclose(a[:, k], np.concatenate(pair), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(a[:, 6], np.concatenate([p3(x), zero]), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(a[:, 43], np.concatenate([zero, p4(x) * p4(y)]), rtol=1e-12, atol=1e-12)
    assert names == [f"G{j}" for j in range(1, 45)]


def test_gruens_simple_set_as_printed() -> None:
    x, y = np.array([0.3, -1.7, 2.0]), np.array([1.1, 0.2, -2.0])
    _, a = columns("gruen12", np.stack([x, y], axis=1), 7.0)
    zero = np.zeros_like(x)
    dx = [y, x * y, x * y * y, x * x * y, y * y, x * x * y * y, *[zero] * 6]
    dy = [*[zero] * 6, y, x * y, x * y * y, x * x * y, x * x, x * x * y * y]
    np.testing.assert_allclose(a, np.concatenate([dx, dy], axis=1).T, rtol=1e-13)


@pytest.mark.parametrize(("degree", "count"), [(2, 6), (3, 14), (4, 24), (5, 36)])
def test_polynomials_complete_the_orientation(degree: int, count: int) -> None:
    points = grid(9, 1.0)
    names, a = columns(f"polynomial{degree}", points, 1.0)
    assert len(names) == count == (degree + 1) * (degree + 2) - 6
    assert np.linalg.matrix_rank(np.column_stack([a, orientation(points)])) == (degree + 1) * (degree + 2)


@pytest.mark.parametrize(("degree", "count"), [(1, 16), (2, 48)])
def test_fourier_is_orthogonal_over_the_periods(degree: int, count: int) -> None:
    line = np.linspace(-1, 1, 12, endpoint=False)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    names, a = columns(f"fourier{degree}", points, 1.0)
    assert len(set(names)) == count
    np.testing.assert_allclose(cosines(a), np.eye(count), atol=1e-13)


@pytest.mark.parametrize("name", SETS)
def test_units_of_the_plane_do_not_matter(name: str) -> None:
    """The same camera in mm and in px: parameters of power m change by the pixel size to that power."""
    model, size = cameras.model(name), 0.004
    px = create("px", model, model.examples[0], image_size=(1000.0, 800.0))
    values = {p.name: v * size**p.power for p, v in zip(model.parameters, px.values, strict=True)}
    values |= {"principal_point_x": px.values[1] * size, "principal_point_y": px.values[2] * size}
    mm = create("mm", model, values, unit="mm", pixel_size=np.full(2, size), image_size=(1000.0, 800.0))
    assert mm.half_width == pytest.approx(2.0)
    points = np.random.default_rng(1).uniform(0, 800, (20, 2))
    ours, theirs = (Optics.of(c).correct(points, c.values[None])[0] for c in (px, mm))
    np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-13)


def test_the_half_width_is_needed_and_may_be_given() -> None:
    model = cameras.model("ebner12")
    camera = create("7", model, {"principal_distance": 900.0})
    with pytest.raises(UsageError, match="camera 7: model ebner12 needs the image size"):
        Optics.of(camera)
    assert Optics.of(create("7", model, {}, grid=400.0)).grid == 400.0
    assert create("7", cameras.model("brown"), {}).half_width == 1.0
    with pytest.raises(UsageError, match="half-width"):
        create("7", model, {}, grid=-1.0)
