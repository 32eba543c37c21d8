"""The adjustment against dense algebra written here, and both solvers against each other on every kind of network."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

import baarda
from baarda import cameras
from baarda.adjustment import memory
from baarda.adjustment.linearize import linearize, whitened_misclosures
from baarda.adjustment.solve import Settings, active_groups, prepare
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import DatumDefect, RedundancyNotPositive, Singular, UsageError
from baarda.network import Images, Network, Points, State, unknowns_of
from baarda.observations import Distances, ImagePoints
from baarda.procedures.synthetic import synthetic
from networks import BROWN, FREE_BROWN, ring, with_distances


def correlated_control():
    n = ring(control=5, correlation=0.4)
    return replace(n, points=replace(n.points, correlations=np.where(n.points.roles[:, None] == 1, [0.5, -0.2, 0.1], 0.0)))


def observed_camera():
    n = ring(control=4, free=())
    states, sigmas = np.array(n.cameras[0].states), np.array(n.cameras[0].sigmas)
    states[0], sigmas[0], states[3] = OBSERVED, 5.0, FREE
    return replace(n, cameras=(replace(n.cameras[0], states=states, sigmas=sigmas),))


def observed_orientation():
    n = ring(control=0)
    given, sigmas, states = np.array(n.images.given), np.array(n.images.sigmas), np.array(n.images.states)
    given[:, :3], sigmas[:, :3], states[:, :3] = n.images.position, 0.02, OBSERVED
    from baarda.geometry.rotation import to_angles

    given[0, 3:], sigmas[0, 3:], states[0, 3:] = to_angles(n.images.rotation[0]), 0.001, OBSERVED
    return replace(n, images=replace(n.images, given=given, sigmas=sigmas, states=states))


def partly_fixed_points():
    n = ring(control=4, fixed_control=True)
    states = np.array(n.points.states)
    states[6:9, 2] = FIXED
    return replace(n, points=replace(n.points, states=states))


def two_models():
    n = ring(images=6, control=4, per_image=True)
    other = cameras.model("OPENCV")
    names = {"principal_distance_x": 1000.0, "principal_distance_y": 1000.0, "principal_point_x": 505.0, "principal_point_y": 396.0}
    last = cameras.create("cv", other, names, free=("principal_distance_x", "k1"))
    return replace(n, cameras=(*n.cameras[:5], last))


NETWORKS = {
    "weighted control": lambda: ring(control=5),
    "fixed control": lambda: ring(control=4, fixed_control=True),
    "correlated": correlated_control,
    "free": lambda: ring(),
    "free, incomplete": lambda: ring(images=8, points=40, keep=0.5, seed=3),
    "free, scale bar": lambda: with_distances(ring(), [(0, 1), (2, 3), (1, 4)]),
    "observed camera": observed_camera,
    "observed orientation": observed_orientation,
    "partly fixed": partly_fixed_points,
    "per-image cameras": lambda: ring(control=6, per_image=True, free=("principal_distance", "K1")),
    "two models": two_models,
    "far from the origin": lambda: ring(control=5, origin=(1.0e6, 5.0e6, 300.0)),
    "corrected plane": lambda: in_corrected_plane(ring(control=5)),
    "check points": lambda: ring(control=4, checks=3),
}


def in_corrected_plane(n):
    return replace(n, observations=tuple(replace(g, residual_plane="corrected") for g in n.observations))


@pytest.fixture(scope="module", params=list(NETWORKS))
def solved(request):
    network = NETWORKS[request.param]()
    return network, baarda.adjust(network, solver="dense"), baarda.adjust(network, solver="block")


def test_converges(solved):
    _, dense, block = solved
    assert dense.status == block.status == "converged"
    assert dense.redundancy == dense.count - dense.numbering.count + dense.datum.defect.count


def test_the_gradient_vanishes(solved):
    _, dense, _ = solved
    a, misclosure = dense.lin.design.toarray() / dense.lin.scale, dense.lin.misclosure
    assert np.abs(a.T @ misclosure).max() <= 1e-7 * np.linalg.norm(misclosure)


def test_redundancy_numbers_against_qr(solved):
    """The oracle: an orthogonal factor of the whitened, scaled design matrix; its rank gives u - d."""
    _, dense, block = solved
    a = dense.lin.design.toarray() / dense.lin.scale
    u, s, _ = linalg.svd(a, full_matrices=False)
    rank = int((s > 1e-10 * s[0]).sum())
    assert rank == dense.numbering.count - dense.datum.defect.count
    cond = s[0] / s[rank - 1]
    tolerance = max(1e-10, np.finfo(float).eps * cond**2)
    h = u[:, :rank] @ u[:, :rank].T
    white = -dense.lin.misclosure
    oracle = np.empty(dense.count)
    for c in dense.lin.chunks:
        for rows, f in zip(c.rows, c.factor, strict=True):
            rest = np.eye(len(rows)) - h[np.ix_(rows, rows)]
            oracle[rows] = np.diag(f @ rest @ np.linalg.inv(f))
            np.testing.assert_allclose(dense.residuals[rows], f @ white[rows], rtol=1e-12, atol=1e-14)
    assert np.abs(dense.redundancy_numbers - oracle).max() <= tolerance
    assert np.abs(block.redundancy_numbers - dense.redundancy_numbers).max() <= tolerance
    assert dense.redundancy_numbers.sum() == pytest.approx(dense.redundancy, rel=1e-9)
    assert block.redundancy_numbers.sum() == pytest.approx(dense.redundancy, rel=1e-9)


def test_solvers_agree(solved):
    _, dense, block = solved
    assert block.objective == pytest.approx(dense.objective, rel=1e-10)
    for table in ("unknowns", "points", "images"):
        one, two = getattr(dense, table), getattr(block, table)
        for name, column in one.columns.items():
            if column.dtype.kind == "f" and name != "ellipse_azimuth_rad":
                np.testing.assert_allclose(two[name], column, rtol=2e-6, atol=1e-9, err_msg=f"{table} {name}")


def test_covariance_against_the_pseudo_inverse(solved):
    """In a free network the inner constraints over the points give the S-transform of any generalised inverse."""
    _, dense, block = solved
    a = dense.lin.design.toarray()
    scaled = a / dense.lin.scale
    q = np.linalg.pinv(scaled.T @ scaled, rcond=1e-13, hermitian=True) / np.outer(dense.lin.scale, dense.lin.scale)
    if dense.datum.conditions is not None and dense.datum.defect.count:
        g, b = dense.datum.defect.basis, dense.datum.conditions
        s = np.eye(len(q)) - g @ np.linalg.solve(b.T @ g, b.T)
        q = s @ q @ s.T
    every = np.arange(len(q))
    for result in (dense, block):
        got = result.cofactors.of(every)
        scale = np.sqrt(np.outer(np.diag(q), np.diag(q)))
        assert np.abs(got - q).max() <= 1e-5 * scale.max()
        np.testing.assert_allclose(got / scale, q / scale, atol=2e-5)


def test_residuals_of_simulated_errors(solved):
    """residuals_of maps errors as the projector does: -(I - H) e for uncorrelated observations, and it forgets A x."""
    _, dense, block = solved
    rng = np.random.default_rng(1)
    e = rng.standard_normal((dense.count, 3))
    np.testing.assert_allclose(block.residuals_of(e), dense.residuals_of(e), atol=1e-6)
    x = rng.standard_normal((dense.numbering.count, 1)) / dense.lin.scale[:, None]
    assert np.abs(dense.residuals_of(dense.lin.design @ x)).max() < 1e-6


def test_partials_of_every_network_against_differences(solved):
    _, dense, _ = solved
    state = State.of(dense.network.shifted(dense.shift))
    net = dense.network.shifted(dense.shift)
    groups = active_groups(net, ~dense.aside)
    lin = linearize(net, state, dense.numbering, groups)
    rng = np.random.default_rng(5)
    for _ in range(3):
        d = rng.standard_normal(dense.numbering.count) / dense.lin.scale
        h = 1e-4
        up = whitened_misclosures(net, state.moved(dense.numbering, h * d), groups)
        down = whitened_misclosures(net, state.moved(dense.numbering, -h * d), groups)
        np.testing.assert_allclose((down - up) / (2 * h), lin.design @ d, rtol=1e-6, atol=1e-6)


def test_minimal_and_inner_constraints_tell_the_same():
    n = ring()
    inner, minimal = baarda.adjust(n, datum="inner"), baarda.adjust(n, datum="minimal")
    assert inner.datum.defect.count == minimal.datum.defect.count == 7
    assert inner.objective == pytest.approx(minimal.objective, rel=1e-12)
    np.testing.assert_allclose(inner.redundancy_numbers, minimal.redundancy_numbers, atol=1e-10)
    np.testing.assert_allclose(inner.covariance("camera 1: K1", "camera 1: K1"), minimal.covariance("camera 1: K1", "camera 1: K1"))
    trace = [np.square(r.points["sX"]).sum() + np.square(r.points["sY"]).sum() + np.square(r.points["sZ"]).sum() for r in (inner, minimal)]
    assert trace[0] < trace[1]  # inner constraints have the smallest trace over the points
    held = [n for n in minimal.unknowns.rows() if n["sigma"] == 0.0]
    assert len(held) == 7
    assert "Minimal constraints hold 7" in minimal.datum.text


def test_inner_constraints_do_not_move_the_points_as_a_whole():
    n = ring()
    r = baarda.adjust(n, datum="inner")
    d = r.network.points.coordinates - n.points.coordinates
    assert np.abs(d.mean(axis=0)).max() < 1e-6


def test_the_datum_defect_is_found_not_assumed():
    assert baarda.adjust(with_distances(ring(), [(0, 1)])).datum.defect.count == 6
    assert baarda.adjust(observed_orientation()).datum.defect.count == 0
    r = baarda.adjust(ring())
    assert len(r.datum.defect.free) == 7
    one = ring(control=1, fixed_control=True)
    assert baarda.adjust(one).datum.defect.count == 4


def test_one_image_over_fixed_points_has_no_defect():
    """Six unknowns cannot follow seven transformations: what moves nothing is no freedom."""
    n = ring(images=1, points=8, control=8, fixed_control=True, free=())
    assert baarda.adjust(n).datum.defect.count == 0


def test_control_is_asked_for_and_does_not_define_the_datum():
    with pytest.raises(DatumDefect, match=r"scale.*defect 7"):
        baarda.adjust(ring(), datum="control")


def test_a_defect_beyond_the_datum_is_named():
    n = ring(control=5, free=("principal_distance", "K1", "B1", "B2"))
    one_image_point = replace(n, observations=tuple(g.selected(np.flatnonzero((g.points != 9) | (g.images == 0))) for g in n.observations))
    for solver in ("dense", "block"):
        with pytest.raises(Singular, match="point P9"):
            baarda.adjust(one_image_point, min_rays=1, solver=solver)
        r = baarda.adjust(one_image_point, solver=solver)
        assert r.aside.sum() == 1
        assert any("P9" in text for text in r.assumptions)


def nadir_over_a_plane():
    """Vertical images of a plane: principal distance and flying height cannot be told apart."""
    rng = np.random.default_rng(2)
    x = np.concatenate([rng.uniform(-3, 3, (12, 2)), np.zeros((12, 1))], axis=1)
    values = {"principal_distance": 1000.0, "principal_point_x": 500.0, "principal_point_y": 400.0}
    camera = cameras.create("1", cameras.model("pinhole"), values, free=("principal_distance",))
    images = Images.make(["a", "b"], position=np.array([[0.0, 0.0, 10.0], [1.0, 0.0, 10.0]]), rotation=np.stack([np.eye(3)] * 2))
    points = Points.make([f"P{i}" for i in range(12)], x, roles=np.ones(12), states=np.full((12, 3), FIXED), given=x)
    i, j = np.repeat([0, 1], 12), np.tile(np.arange(12), 2)
    n = Network((camera,), images, points, (ImagePoints.make(i, j, np.zeros((24, 2))),))
    group = n.observations[0]
    return replace(n, observations=(replace(group, xy=-group.misclosures(n, State.of(n))),))


@pytest.mark.parametrize("solver", ["dense", "block"])
def test_unknowns_that_cannot_be_told_apart_are_named(solver):
    with pytest.raises(Singular, match="principal_distance") as caught:
        baarda.adjust(nadir_over_a_plane(), solver=solver)
    assert set(caught.value.names) == {"camera 1: principal_distance", "image a: Z0", "image b: Z0"}


def test_refuses_without_redundancy():
    n = ring(images=2, points=5, free=())
    with pytest.raises(RedundancyNotPositive, match="redundancy 0: n = 20"):
        baarda.adjust(n)


def test_far_coordinates_lose_no_digits():
    near, far = baarda.adjust(ring(control=5)), baarda.adjust(ring(control=5, origin=(1.0e6, 5.0e6, 300.0)))
    assert far.sigma0 == pytest.approx(near.sigma0, rel=1e-7)
    np.testing.assert_allclose(far.points["sX"], near.points["sX"], rtol=1e-5)
    np.testing.assert_allclose(far.points["X"] - 1.0e6, near.points["X"], atol=1e-7)


def test_start_values_from_control_alone():
    n = ring(control=6, start=False, noise=0.2)
    r = baarda.adjust(n)
    full = baarda.adjust(ring(control=6, noise=0.2))
    assert r.objective == pytest.approx(full.objective, rel=1e-8)
    assert any("resection" in text for text in r.assumptions)


def test_start_values_in_a_free_network():
    n = ring(start=False, noise=0.2, free=())
    r = baarda.adjust(n)
    full = baarda.adjust(ring(noise=0.2, free=()))
    assert r.objective == pytest.approx(full.objective, rel=1e-8)
    assert any("relative orientation" in text for text in r.assumptions)


def test_images_without_points_are_refused():
    n = ring(control=4)
    n = replace(n, observations=tuple(g.selected(g.images != 2) for g in n.observations))
    with pytest.raises(UsageError, match="without image points: I2"):
        baarda.adjust(n)


def test_exact_observations_are_met():
    r = baarda.adjust(ring(noise=0.0, control=5, fixed_control=True))
    assert r.status == "converged"
    assert r.objective < 1e-12


def test_a_poor_start_is_damped_not_lost():
    n = ring(control=6, noise=0.2)
    rng = np.random.default_rng(4)
    poor = replace(n, points=replace(n.points, coordinates=n.points.coordinates + 0.6 * rng.standard_normal(n.points.coordinates.shape)))
    poor = replace(poor, images=replace(poor.images, position=poor.images.position + 0.7 * rng.standard_normal((6, 3))))
    assert baarda.adjust(poor).objective == pytest.approx(baarda.adjust(n).objective, rel=1e-8)


def test_both_residual_planes_are_close_and_not_equal():
    n = ring(control=5, noise=0.3)
    image, corrected = baarda.adjust(n), baarda.adjust(n, residual_plane="corrected")
    assert corrected.sigma0 == pytest.approx(image.sigma0, rel=0.05)
    assert corrected.objective != image.objective


def test_the_image_plane_solves_the_combined_model():
    """The explicit form meets the conditions of the combined model B v + A x = l: equations hold, and A'k = 0."""
    n = ring(images=4, points=10, control=4, fixed_control=True, noise=0.5, free=("principal_distance", "K1"))
    r = baarda.adjust(n)
    group, camera = r.groups[0], r.network.cameras[0]
    optics, p = cameras.Optics.of(camera), camera.values[None]
    v = r.residuals.reshape(-1, 2)
    from baarda.geometry import collinearity

    state = State.of(r.network)
    vectors = collinearity.camera_coordinates(state.rotation[group.images], state.position[group.images], state.points[group.points])
    target, _, d_ideal = optics.from_ideal(collinearity.project(vectors)[0], p)
    reached, b, d_measured = optics.from_measured(group.xy + v, p)
    np.testing.assert_allclose(reached, target, atol=1e-9)  # the condition holds at the adjusted observations
    k = np.einsum("nji,nj->ni", np.linalg.inv(b), v / group.sigmas**2)  # correlates: v = Q B' k
    free = camera.states == FREE
    a = (d_ideal - d_measured)[:, :, free]
    share = np.abs(np.einsum("nic,ni->c", a, k)) / np.einsum("nic,ni->c", np.abs(a), np.abs(k))
    assert share.max() < 1e-8  # A'k = 0: v'Pv is stationary under the condition


def test_covariance_by_name():
    r = baarda.adjust(ring(control=5))
    names = ["camera 1: principal_distance", "camera 1: K1"]
    c = r.covariance(names)
    assert c.shape == (2, 2)
    assert r.covariance(*names) == pytest.approx(c[0, 1])
    assert r.covariance(names, sigma="apriori")[0, 0] == pytest.approx(c[0, 0] / r.variance_factor)
    sigma = {row["name"]: row["sigma"] for row in r.unknowns.rows()}
    assert np.sqrt(c[1, 1]) == pytest.approx(sigma["camera 1: K1"])
    with pytest.raises(UsageError, match="no unknown is named"):
        r.covariance("camera 1: K9", "camera 1: K1")


def test_options_are_checked():
    n = ring(control=4)
    for bad in ({"datum": "none"}, {"solver": "qr"}, {"image_sigma": -1.0}, {"camera": ("k9",)}, {"speed": 3}):
        with pytest.raises(UsageError):
            baarda.adjust(n, **bad)


def test_the_networks_arrays_are_not_touched():
    n = ring(control=5)
    before = [np.array(n.points.coordinates), np.array(n.images.rotation), np.array(n.cameras[0].values)]
    baarda.adjust(n)
    for a, b in zip(before, [n.points.coordinates, n.images.rotation, n.cameras[0].values], strict=True):
        np.testing.assert_array_equal(a, b)


def test_two_runs_are_identical():
    one, two = (baarda.adjust(ring(control=5), solver=s) for s in ("block", "block"))
    np.testing.assert_array_equal(one.residuals, two.residuals)
    np.testing.assert_array_equal(one.redundancy_numbers, two.redundancy_numbers)


def test_levelled_distances_without_images():
    """A network of distances alone: no images, datum defect 6."""
    rng = np.random.default_rng(3)
    x = rng.uniform(0, 10, (7, 3))
    a, b = np.triu_indices(7, 1)
    d = np.linalg.norm(x[a] - x[b], axis=1) + 0.001 * rng.standard_normal(len(a))
    n = Network((), Images.make([]), Points.make([f"P{i}" for i in range(7)], x), (Distances(a, b, d, np.full(len(a), 0.001)),))
    for solver in ("dense", "block"):
        r = baarda.adjust(n, solver=solver, min_rays=0)
        assert (r.count, r.numbering.count, r.datum.defect.count, r.redundancy) == (21, 21, 6, 6)
        assert 0.3 < r.sigma0 < 2.0


def test_image_sigma_scales_the_sigma0():
    n = ring(control=4, fixed_control=True)
    one, ten = baarda.adjust(n, image_sigma=1.0), baarda.adjust(n, image_sigma=10.0)
    assert ten.sigma0 == pytest.approx(one.sigma0 / 10)
    np.testing.assert_allclose(ten.points["sX"], one.points["sX"], rtol=1e-6)


def test_free_and_fixed_brown_names():
    assert set(FREE_BROWN) <= set(cameras.model("brown").order)
    assert set(BROWN) <= set(cameras.model("brown").order)
    assert ImagePoints.components == ("x", "y")


@pytest.mark.parametrize("blunder", [20.0, 100.0, 200.0, 400.0])
def test_a_gross_error_does_not_stop_the_iteration(blunder):
    n = ring(control=5, noise=0.3)
    group = n.observations[0]
    xy = np.array(group.xy)
    xy[40, 1] += blunder
    r = baarda.adjust(replace(n, observations=(replace(group, xy=xy),)))
    assert r.status == "converged"
    gradient = r.lin.design.T @ r.lin.misclosure / r.lin.scale
    assert np.abs(gradient).max() <= 1e-5 * np.linalg.norm(r.lin.misclosure)
    assert "point P16 y" in r.contradictions()


def test_distances_to_points_set_aside_are_told():
    n = with_distances(ring(control=5), [(8, 9)])
    n = replace(
        n, observations=tuple(g.selected((g.points != 9) | (g.images == 0)) if isinstance(g, ImagePoints) else g for g in n.observations)
    )
    r = baarda.adjust(n)
    assert any("1 of 1 distances end at points set aside" in text for text in r.assumptions)


def test_weights_do_not_change_the_datum_defect():
    """Tiny image sigmas beside weighted control: the datum stays defined; where digits run out, the weights are named."""
    from baarda.adjustment.datum import find_defect

    n = ring(control=5)
    for sigma in (1.0, 1e-4, 1e-8, 1e-11):
        prepared, aside, _ = prepare(n, Settings(image_sigma=sigma))
        prepared = prepared.shifted(-prepared.centroid())
        state = State.of(prepared)
        lin = linearize(prepared, state, unknowns_of(prepared, ~aside), active_groups(prepared, ~aside))
        assert find_defect(lin, state).count == 0
    with pytest.raises(Singular, match="sigmas are too different"):
        baarda.adjust(n, image_sigma=1e-10)


# ---- memory ----
def test_equal_standard_deviations_are_one_number():
    network = synthetic("ring", images=5, points=30, seed=3, control_sigma=0.0).network
    one, two = (baarda.adjust(network, image_sigma=s) for s in (1.0, 2.0))
    assert one.sigmas.strides == (0,)
    assert one.sigmas.shape == (one.count,)
    assert (two.sigmas == 2.0).all()
    np.testing.assert_array_equal(one.qvv, one.redundancy_numbers)
    np.testing.assert_allclose(two.qvv, 4.0 * two.redundancy_numbers, rtol=1e-15)
    np.testing.assert_allclose(two.redundancy_numbers, one.redundancy_numbers, rtol=1e-9)


def test_start_values_are_those_of_the_source():
    network = synthetic("ring", images=5, points=30, seed=3).network
    result = baarda.adjust(network)
    np.testing.assert_array_equal(result.start.points.coordinates, network.points.coordinates)
    np.testing.assert_array_equal(result.network.points.given, network.points.given)
    np.testing.assert_array_equal(result.network.offset, network.offset)


def test_memory_can_be_handed_back_at_any_size():
    memory.release(0)
    memory.release(memory.MANY)


def test_what_no_point_can_satisfy_is_named():
    with pytest.raises(RedundancyNotPositive, match=r"no observation takes part: no point has 99 rays or more \(--min-rays\)"):
        baarda.adjust(ring(), min_rays=99)
