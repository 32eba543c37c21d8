"""The compiled collinearity equations against their NumPy twin: every camera model, both residual planes, damaged input."""

from dataclasses import replace

import numpy as np
import pytest

from baarda import cameras
from baarda.cameras import Optics
from baarda.network import State
from baarda.observations import kernels
from networks import ring

if kernels.compiled() is None:
    pytest.skip("numba is not installed", allow_module_level=True)

PROGRAMMED = [
    name
    for name in cameras.models()
    if kernels.Program.of(Optics.of(cameras.create("c", cameras.model(name), {}, image_size=(1000.0, 800.0))))
]


def block(name, seed=0, points=30):
    """A ring of images with a camera of this model, every additional parameter away from zero."""
    rng = np.random.default_rng(seed)
    model = cameras.model(name)
    size = 1000.0
    values = {}
    for p in model.parameters:
        if p.name.startswith("principal_distance"):
            values[p.name] = size * (1.0 + 0.01 * rng.random())
        elif p.name == "principal_point_x":
            values[p.name] = 505.0
        elif p.name == "principal_point_y":
            values[p.name] = 396.0
        else:  # effects of some pixels whatever the power of the unit
            values[p.name] = p.default + 1e-2 * rng.standard_normal() * size**p.power
    network = ring(images=5, points=points, free=(), seed=seed)
    camera = cameras.create("1", model, values, free=model.order, image_size=(1000.0, 800.0))
    return replace(network, cameras=(camera,))


def evaluate(network, monkeypatch, compiled):
    monkeypatch.setattr(kernels, "COMPILE_FROM", 0 if compiled else 10**9)
    group, state = network.observations[0], State.of(network)
    used = [group._compiled(p, network, state, partials=True) is not None for p in group.pieces(network)]
    assert all(used) == compiled
    rows = group.linearize(network, state)
    return group.misclosures(network, state), rows


def agree(network, monkeypatch, rtol=2e-11):
    one, rows = evaluate(network, monkeypatch, True)
    two, expected = evaluate(network, monkeypatch, False)
    size = np.abs(network.observations[0].xy).max()
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-12 * size)
    assert len(rows) == len(expected)
    for a, b in zip(rows, expected, strict=True):
        np.testing.assert_array_equal(a.index, b.index)
        np.testing.assert_allclose(a.misclosure, b.misclosure, rtol=0, atol=1e-12 * size)
        np.testing.assert_array_equal(a.cofactor, b.cofactor)
        for p, q in zip(a.blocks, b.blocks, strict=True):
            assert p.kind == q.kind
            np.testing.assert_array_equal(p.nodes, q.nodes)
            scale = np.abs(q.jacobian).max(axis=(0, 1))
            assert (np.abs(p.jacobian - q.jacobian) <= rtol * np.maximum(scale, 1e-300)).all(), p.kind


def test_the_usual_cameras_are_compiled():
    assert {"brown", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "snavely"} <= set(PROGRAMMED)


@pytest.mark.parametrize("plane", ["image", "corrected"])
@pytest.mark.parametrize("name", PROGRAMMED)
def test_against_numpy(name, plane, monkeypatch):
    network = block(name)
    groups = tuple(replace(g, residual_plane=plane) for g in network.observations)
    agree(replace(network, observations=groups), monkeypatch)


@pytest.mark.parametrize("name", ["brown", "OPENCV"])
@pytest.mark.parametrize("down", [True, False])
def test_sensor_transforms(name, down, monkeypatch):
    network = block(name)
    camera = replace(network.cameras[0], pixel_size=np.array([0.9, 1.1]), origin=np.array([-3.5, 12.25]), y_down=down)
    for plane in ("image", "corrected"):
        groups = tuple(replace(g, residual_plane=plane) for g in network.observations)
        agree(replace(network, cameras=(camera,), observations=groups), monkeypatch)


def test_cameras_of_two_models_and_of_several_of_one(monkeypatch):
    network = block("brown")
    other = replace(block("OPENCV", 1).cameras[0], label="2")
    third = network.cameras[0].with_values(network.cameras[0].values * (1.0 + 1e-3))
    images = replace(network.images, cameras=np.array([0, 1, 2, 1, 0]))
    agree(replace(network, cameras=(network.cameras[0], other, replace(third, label="3")), images=images), monkeypatch)


def test_correlated_coordinates(monkeypatch):
    network = block("brown")
    group = network.observations[0]
    agree(replace(network, observations=(replace(group, correlations=0.5 * np.cos(np.arange(len(group)))),)), monkeypatch)


def test_pieces_of_any_size(monkeypatch):
    network = block("RADIAL")
    monkeypatch.setattr("baarda.observations.image_points.CHUNK", 7)
    agree(network, monkeypatch)


def test_points_behind_a_camera(monkeypatch):
    """The equations hold there too; that a point is behind is told by `in_front`, which is not compiled."""
    network = block("brown")
    points = np.array(network.points.coordinates)
    points[3] = network.images.position[0] * 1.3
    network = replace(network, cameras=block("PINHOLE").cameras, points=replace(network.points, coordinates=points))
    agree(network, monkeypatch, rtol=1e-9)
    assert not network.observations[0].in_front(network, State.of(network)).all()


def test_what_cannot_be_inverted_is_left_to_numpy(monkeypatch):
    """A distortion that folds: the compiled loop hands the piece back, so that both ways say the same."""
    network = block("brown")
    camera = network.cameras[0]
    values = np.array(camera.values)
    values[camera.model.order.index("K1")] = -2e-6
    network = replace(network, cameras=(camera.with_values(values),))
    group, state = network.observations[0], State.of(network)
    results = []
    for compile_from in (0, 10**9):
        monkeypatch.setattr(kernels, "COMPILE_FROM", compile_from)
        with np.errstate(all="ignore"):
            results.append(group.misclosures(network, state))
    np.testing.assert_array_equal(results[0], results[1])
    assert not np.isfinite(results[0]).all()


def test_a_state_without_numbers_gives_none(monkeypatch):
    """Missing or infinite values come out as such: never a finite misclosure from them, nor an endless loop."""
    network = block("brown")
    for value in (np.nan, np.inf):
        points = np.array(network.points.coordinates)
        points[4] = value
        damaged = replace(network, points=replace(network.points, coordinates=points))
        group, state = network.observations[0], State.of(damaged)
        for compile_from in (0, 10**9):
            monkeypatch.setattr(kernels, "COMPILE_FROM", compile_from)
            with np.errstate(all="ignore"):
                found = group.misclosures(damaged, state)
            assert not np.isfinite(found[group.points == 4]).any()
            assert np.isfinite(found[group.points != 4]).all()


def test_other_models_are_evaluated_by_numpy(monkeypatch):
    left = [n for n in cameras.models() if n not in PROGRAMMED]
    assert left
    monkeypatch.setattr(kernels, "COMPILE_FROM", 0)
    network = block("brown")
    for name in left:
        camera = cameras.create("1", cameras.model(name), {}, image_size=(1000.0, 800.0))
        changed = replace(network, cameras=(camera,))
        group = changed.observations[0]
        piece = group.pieces(changed)[0]
        assert group._compiled(piece, changed, State.of(changed), partials=True) is None


def rows(network, begin, end, plane="image", keep_camera=None, keep_image=range(6), weights=None, kind=np.int64):
    """Evaluate rows begin ... end - 1 by the compiled loop itself: what it returns, and its four results."""
    group, state, optics = network.observations[0], State.of(network), Optics.of(network.cameras[0])
    program, k = kernels.Program.of(optics), len(optics.model.order)
    keep_camera = np.arange(k) if keep_camera is None else np.array(keep_camera, dtype=np.intp)
    keep_image, n = np.array(keep_image, dtype=np.intp), end - begin
    out = [np.full(s, np.nan) for s in ((n, 2), (n, 2, len(keep_camera)), (n, 2, len(keep_image)), (n, 2, 3))]
    failed = kernels.compiled()(
        program.steps, program.places, program.measured, plane == "corrected", np.array([1.0, -1.0]), optics.pixel_size, optics.origin,
        state.camera_table(k), state.rotation, state.position, state.points, network.images.cameras, group.images.astype(kind),
        group.points.astype(kind), group.xy, np.ones((1, 2)) if weights is None else weights, begin, end, True, keep_camera, keep_image,
        *out,
    )  # fmt: skip
    return failed, out


def two_cameras(name):
    """A block of several batches of rows in which some batches have one camera and others two."""
    network = block(name, points=150)
    second = replace(network.cameras[0].with_values(network.cameras[0].values * (1.0 + 1e-3)), label="2")
    group = network.observations[0]
    order = np.argsort(group.images[: len(group)], kind="stable")
    images = replace(network.images, cameras=np.array([0, 0, 1, 0, 1]))
    return replace(network, cameras=(network.cameras[0], second), images=images, observations=(group.selected(order),))


@pytest.mark.parametrize("name, plane", [("RADIAL", "image"), ("FULL_OPENCV", "image"), ("brown", "image"), ("brown", "corrected")])
def test_a_row_does_not_depend_on_where_a_call_begins(name, plane):
    network = two_cameras(name)
    n = len(network.observations[0])
    assert n > 4 * kernels.BATCH
    weights = 1.0 + np.random.default_rng(3).random((n, 2))
    failed, whole = rows(network, 0, n, plane, weights=weights)
    assert failed == -1
    assert all(np.isfinite(x).all() for x in whole)
    for sizes in ([1, 2, 3, 5, 7, 8, 9, 31], [kernels.BATCH - 1, kernels.BATCH + 1, 17], [n - 1, 1]):
        begin = 0
        while begin < n:
            for size in sizes:
                end = min(n, begin + size)
                failed, part = rows(network, begin, end, plane, weights=weights)
                assert failed == -1
                for a, b in zip(part, whole, strict=True):
                    assert a.tobytes() == np.ascontiguousarray(b[begin:end]).tobytes()
                begin = end


@pytest.mark.parametrize("name", ["RADIAL", "FULL_OPENCV", "brown"])
def test_only_the_partials_to_keep(name):
    network = two_cameras(name)
    n, k = len(network.observations[0]), len(network.cameras[0].model.order)
    _, whole = rows(network, 0, n)
    for keep in ([], [k - 1], [0, 3], range(1, k)):
        _, some = rows(network, 0, n, keep_camera=keep, keep_image=[1, 5])
        np.testing.assert_array_equal(some[0], whole[0])
        np.testing.assert_array_equal(some[1], whole[1][:, :, list(keep)])
        np.testing.assert_array_equal(some[2], whole[2][:, :, [1, 5]])
        np.testing.assert_array_equal(some[3], whole[3])
    _, turned = rows(network, 0, n, keep_camera=range(k - 1, -1, -1), keep_image=[5, 4, 3, 2, 1, 0])
    np.testing.assert_array_equal(turned[1], whole[1][:, :, ::-1])
    np.testing.assert_array_equal(turned[2], whole[2][:, :, ::-1])


def test_weights_of_all_rows_and_narrow_indices():
    network = two_cameras("RADIAL")
    n = len(network.observations[0])
    _, expected = rows(network, 200, n)
    _, found = rows(network, 200, n, weights=np.ones((n, 2)), kind=np.int32)
    weights = np.random.default_rng(4).random((n, 2))
    _, weighted = rows(network, 200, n, weights=weights)
    for a, b, c in zip(expected, found, weighted, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_allclose(c, a * weights[200:].reshape(-1, 2, *[1] * (a.ndim - 2)), rtol=1e-13, atol=1e-300)


def test_the_first_row_that_cannot_be_inverted_is_named():
    network = two_cameras("brown")
    group = network.observations[0]
    bad = 3 * kernels.BATCH + 5
    points = np.array(network.points.coordinates)
    points[group.points[bad]] = np.nan
    network = replace(network, points=replace(network.points, coordinates=points))
    first = int(np.flatnonzero(group.points == group.points[bad])[0])
    assert rows(network, 0, len(group))[0] == first
    assert rows(network, first + 1, bad + 1)[0] == np.flatnonzero(group.points[first + 1 :] == group.points[bad])[0] + first + 1
    assert rows(network, 0, first)[0] == -1


def test_rows_that_do_not_lie_together(monkeypatch):
    """Some rows of a group, in any order, are what they are among all."""
    network = block("RADIAL")
    group, state = network.observations[0], State.of(network)
    monkeypatch.setattr(kernels, "COMPILE_FROM", 0)
    (piece,) = group.pieces(network)
    whole = group._compiled(piece, network, state, partials=True)
    for some in (slice(10, 20), np.arange(0, 30, 2), np.array([5, 4, 9]), np.array([7])):
        part = group._compiled(replace(piece, rows=piece.rows[some]), network, state, partials=True)
        for a, b in zip(part, whole, strict=True):
            np.testing.assert_array_equal(a, b[some])
