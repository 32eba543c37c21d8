"""Every camera model passes the same exam: partials against differences, both directions undo each other, many cameras at once."""

import numpy as np
import pytest

from baarda import cameras
from baarda.cameras import Optics, create

CASES = [(m, i) for m in cameras.models().values() for i in range(len(m.examples))]
IDS = [f"{m.name}-{i}" for m, i in CASES]


def optics_and_parameters(model, example, **constants):
    camera = create("c", model, model.examples[example], image_size=(1000.0, 800.0), **constants)
    return Optics.of(camera), camera.values[None]


def pixels(n=60):
    rng = np.random.default_rng(7)
    return rng.uniform([0.0, 0.0], [1000.0, 800.0], (n, 2))


def differences(function, x, steps):
    out = []
    for j, h in enumerate(steps):
        up, down = x.copy(), x.copy()
        up[..., j] += h
        down[..., j] -= h
        out.append((function(up) - function(down)) / (2 * h))
    return np.stack(out, axis=-1)


def test_every_model_has_an_example():
    assert all(m.examples and m.description for m in cameras.models().values())


@pytest.mark.parametrize(("model", "example"), CASES, ids=IDS)
@pytest.mark.parametrize("y_down", [True, False])
def test_directions_undo_each_other(model, example, y_down):
    optics, p = optics_and_parameters(model, example, y_down=y_down)
    measured = pixels()
    normalised, valid = optics.correct(measured, p)
    assert valid.all()
    assert np.abs(normalised).max() < 2
    back, _, _, valid = optics.distort(normalised, p)
    assert valid.all()
    np.testing.assert_allclose(back, measured, rtol=0, atol=2e-10)


@pytest.mark.parametrize(("model", "example"), CASES, ids=IDS)
def test_partials_agree_with_differences(model, example):
    optics, p = optics_and_parameters(model, example)
    measured = pixels()
    normalised, _ = optics.correct(measured, p)
    _, d_n, d_p, _ = optics.distort(normalised, p)
    numeric = differences(lambda n: optics.distort(n, p)[0], normalised, [1e-6, 1e-6])
    np.testing.assert_allclose(d_n, numeric, rtol=1e-7, atol=1e-5)
    scale = np.maximum(np.abs(p[0]), [10.0 ** (3 * q.power) for q in model.parameters])
    numeric = differences(lambda q: optics.distort(normalised, q)[0], p, 1e-6 * scale)
    np.testing.assert_allclose(d_p * scale, numeric * scale, rtol=1e-6, atol=2e-3 * 1e-2)
    _, m_px, m_p = optics.from_measured(measured, p)
    np.testing.assert_allclose(m_px, differences(lambda x: optics.from_measured(x, p)[0], measured, [1e-3, 1e-3]), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(
        m_p * scale, differences(lambda q: optics.from_measured(measured, q)[0], p, 1e-6 * scale) * scale, rtol=1e-6, atol=1e-4
    )


@pytest.mark.parametrize(("model", "example"), CASES, ids=IDS)
def test_one_row_of_parameters_per_point_gives_the_same(model, example):
    optics, p = optics_and_parameters(model, example)
    measured = pixels()
    many = np.repeat(p, len(measured), axis=0)
    normalised, _ = optics.correct(measured, p)
    for one, each in zip(optics.distort(normalised, p), optics.distort(normalised, many), strict=True):
        np.testing.assert_allclose(each, one, rtol=1e-12, atol=1e-12)


def test_the_y_axis_is_mirrored_and_nothing_else():
    """A camera whose rows count upwards sees the mirror image of one whose rows count downwards."""
    model = cameras.model("brown")
    values = {**model.examples[0], "principal_point_y": 0.0}
    down, up = (Optics.of(create("c", model, values, y_down=d)) for d in (True, False))
    p = create("c", model, values).values[None]
    measured = pixels() - [0.0, 400.0]
    np.testing.assert_allclose(up.correct(measured * [1, -1], p)[0], down.correct(measured, p)[0], atol=1e-14)


def test_opencv_against_its_published_formula():
    """The nine-parameter order fx fy cx cy k1 k2 p1 p2 k3, evaluated by hand at one point (camera looks along -z, y up)."""
    model = cameras.model("opencv")
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = v = (536.0, 537.0, 342.0, 235.0, -0.26, -0.04, 1.8e-3, -3e-4, 0.25)
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    optics = Optics.of(create("c", model, dict(zip(model.order, v, strict=True))))
    got = optics.distort(np.array([[x, -y]]), np.array([v]))[0][0]
    np.testing.assert_allclose(got, [fx * xd + cx, fy * yd + cy], rtol=1e-14)
