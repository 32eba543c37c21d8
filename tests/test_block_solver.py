"""The block solver against dense algebra: every mixture of unknowns, NumPy twins and compiled loops, any number of threads."""

import subprocess
import sys
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy import linalg
from threadpoolctl import threadpool_limits

import baarda
from baarda import cameras
from baarda.adjustment import block as block_module
from baarda.adjustment import cluster_loops, kernels, vector_loops, workers
from baarda.adjustment import clusters as clusters_
from baarda.adjustment.block import BlockSolver
from baarda.adjustment.datum import find_defect
from baarda.adjustment.dense import DenseSolver
from baarda.adjustment.dissection import dissect
from baarda.adjustment.linearize import Arrangement, linearize
from baarda.adjustment.point_order import rank_of_points
from baarda.adjustment.solve import Settings, active_groups, choose_datum, prepare
from baarda.adjustment.structure import analyse, inner_points
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import Singular, UsageError
from baarda.network import CONTROL, Images, Network, Points, State, unknowns_of
from baarda.observations import ImagePoints
from baarda.observations import kernels as image_kernels
from baarda.procedures.synthetic import synthetic
from networks import with_distances

SWITCHES = (cluster_loops, kernels, vector_loops, image_kernels)
EPS = np.finfo(float).eps


@pytest.fixture(autouse=True)
def one_thread_for_blas():
    """The oracles are small; threads of theirs only stand in each other's way."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@pytest.fixture(params=["twins", "compiled", "evaluated"])
def loops(request, monkeypatch):
    """Everything by NumPy, everything by compiled loops, or these with partials that are evaluated wherever they are needed."""
    if request.param != "twins" and kernels.compiled() is None:
        pytest.skip("numba is not installed")
    for module in SWITCHES:
        monkeypatch.setattr(module, "COMPILE_FROM", 10**9 if request.param == "twins" else 0)
    monkeypatch.setattr("baarda.adjustment.linearize.EVALUATED_FROM", 0 if request.param == "evaluated" else 10**9)
    return request.param


@pytest.fixture(params=["dense clusters", "sparse clusters"])
def clusters(request, monkeypatch):
    """Clusters whose points are treated together, or one by one."""
    monkeypatch.setattr(clusters_, "SPARSE", 1e-9 if request.param == "sparse clusters" else 1e9)
    return request.param


# ---- networks ----
def made(kind, **options):
    return synthetic(kind, seed=3, **options).network


def correlated(network, size=0.6):
    """Give x and y of every image point a correlation of its own, so that no two cofactor matrices are equal."""
    group = network.observations[0]
    r = size * np.sin(np.arange(len(group)))
    return replace(network, observations=(replace(group, correlations=r), *network.observations[1:]))


def partly_fixed(network):
    """Points with one, two or three fixed coordinates, seen by all images that saw them."""
    states = np.array(network.points.states)
    states[10, 2] = states[11, 0] = states[11, 1] = FIXED
    states[12] = FIXED
    return replace(network, points=replace(network.points, states=states))


def in_all_images(images=15):
    """One point in every image, the others in three neighbours each: a row of the reduced system that joins everything."""
    rng = np.random.default_rng(5)
    network = made("ring", images=images, points=80)
    group = network.observations[0]
    control = network.points.roles[group.points] == CONTROL
    first = rng.integers(0, images, 80)
    near = (group.images - first[group.points]) % images < 4
    return replace(network, observations=(group.selected(near | (group.points == 7) | control), *network.observations[1:]))


def chain(images, points):
    """Images in a row, each point in four neighbours: a tree of many fronts."""
    network = made("ring", images=images, points=points, per_image_cameras=True)
    group = network.observations[0]
    first = np.argsort(np.argsort(network.points.coordinates[:, 0])) * (images - 3) // points
    near = group.images - first[group.points]
    return replace(network, observations=(group.selected((near >= 0) & (near < 4)),))


def joined_points(network):
    """Distances between points: their ends stay in the reduced system, alone or in chains."""
    return with_distances(network, [(0, 9), (9, 20), (20, 0), (30, 31), (40, 50)])


def single_rays(network):
    """Points seen by one image only, known from their observed coordinates alone; a control point without any ray."""
    group, points = network.observations[0], network.points
    states, roles = np.array(points.states), np.array(points.roles)
    given, sigmas = np.array(points.given), np.array(points.sigmas)
    for p in (15, 16):
        states[p], roles[p], sigmas[p] = OBSERVED, CONTROL, 0.01
        given[p] = points.coordinates[p] + 0.001
    alone = (group.points == 15) & (group.images != group.images[group.points == 15][0])
    keep = ~alone & (group.points != 16)
    return replace(
        network, observations=(group.selected(keep),), points=replace(points, states=states, roles=roles, given=given, sigmas=sigmas)
    )


def correlated_control(network):
    """Surveyed coordinates with correlations: row blocks of three observations on an inner point."""
    correlations = np.array(network.points.correlations)
    correlations[network.points.roles == CONTROL] = (0.5, -0.3, 0.2)
    return replace(network, points=replace(network.points, correlations=correlations))


def two_models(network):
    """Every other image with a camera of another model and width, a prior for one of its parameters, and a fixed one."""
    values = {"principal_distance": 5510.0, "principal_point_x": 3012.0, "principal_point_y": 2241.0, "k1": -0.06}
    camera = cameras.create(
        "other", cameras.model("SIMPLE_RADIAL"), values, ["principal_distance"], {"k1": 0.01}, image_size=(6000.0, 4500.0)
    )
    number = np.arange(len(network.images.labels)) % 2
    return replace(network, cameras=(*network.cameras, camera), images=replace(network.images, cameras=number))


def observed_orientation(network):
    """Projection centres and one angle with priors; an image whose orientation is known."""
    images = network.images
    states, given, sigmas = np.array(images.states), np.array(images.given), np.array(images.sigmas)
    states[1:4, :3], given[1:4, :3], sigmas[1:4, :3] = OBSERVED, images.position[1:4], 0.05
    states[5] = FIXED
    return replace(network, images=replace(images, states=states, given=given, sigmas=sigmas))


def several_groups(network):
    """Image points in two groups, of different sigmas: two chunks of the same kind for one point."""
    group = network.observations[0]
    half = np.arange(len(group)) % 3 == 0
    return replace(
        network, observations=(group.selected(half), replace(group.selected(~half), name="others", sigmas=2.0 * group.sigmas[~half]))
    )


def disconnected(control_of_second):
    """Two blocks with nothing in common."""
    one, two = made("ring", images=5, points=30), made("ring", images=4, points=30, control=control_of_second)
    cams = (*one.cameras, *two.cameras)
    a, b = one.images, two.images
    n, m = len(a.labels), len(one.points.labels)
    images = Images.make(
        [*a.labels, *(f"Z{k}" for k in b.labels)], np.concatenate([a.cameras, b.cameras + len(one.cameras)]),
        np.concatenate([a.position, b.position + 100.0]), np.concatenate([a.rotation, b.rotation]),
    )  # fmt: skip
    p, q = one.points, two.points
    both = {k: np.concatenate([getattr(p, k), getattr(q, k)]) for k in ("roles", "states", "sigmas", "correlations")}
    points = Points((*p.labels, *(f"Z{k}" for k in q.labels)), np.concatenate([p.coordinates, q.coordinates + 100.0]),
                    given=np.concatenate([p.given, q.given + 100.0]), **both)  # fmt: skip
    g, h = one.observations[0], two.observations[0]
    group = ImagePoints.make(
        np.concatenate([g.images, h.images + n]), np.concatenate([g.points, h.points + m]), np.concatenate([g.xy, h.xy]), 0.5
    )
    return Network(cams, images, points, (group,))


NETWORKS = {
    "aerial": lambda: made("aerial", images=9, points=100),
    "aerial, corrects": lambda: made("aerial", images=9, points=90, model="brown"),
    "aerial, two distances": lambda: made("aerial", images=9, points=90, model="OPENCV", per_image_cameras=True),
    "ring, free": lambda: made("ring", images=6, points=40, control=0),
    "long tracks": lambda: made("long-tracks", images=12, points=90),
    "dense": lambda: made("dense", images=12, points=90),
    "per-image cameras": lambda: made("aerial", images=9, points=100, per_image_cameras=True),
    "fixed control": lambda: made("aerial", images=9, points=90, control_sigma=0.0),
    "correlated": lambda: correlated(made("ring", images=6, points=40)),
    "partly fixed": lambda: partly_fixed(made("ring", images=6, points=40)),
    "a point in all images": in_all_images,
    "chain": lambda: chain(12, 90),
    "joined points": lambda: joined_points(made("aerial", images=9, points=90)),
    "single rays": lambda: single_rays(made("ring", images=6, points=40)),
    "correlated control": lambda: correlated_control(made("ring", images=6, points=40)),
    "two models": lambda: two_models(made("ring", images=8, points=40)),
    "observed orientation": lambda: observed_orientation(made("ring", images=8, points=40)),
    "several groups": lambda: several_groups(made("ring", images=6, points=40)),
    "two parts": lambda: disconnected(6),
}


@dataclass(frozen=True)
class System:
    lin: object
    pattern: object
    held: np.ndarray
    rhs: np.ndarray
    points: np.ndarray


def system(network, workers_=None, min_rays=0, **options):
    """Linearise a network at its start as `adjust` does, arranged for the block solver."""
    settings = Settings(min_rays=min_rays, **options)
    network, aside, _ = prepare(network, settings)
    network = network.shifted(-network.centroid())
    groups = active_groups(network, ~aside)
    unknowns = unknowns_of(network, ~aside, np.isin(np.arange(len(network.cameras)), network.images.cameras))
    state = State.of(network)
    rank = rank_of_points(state.points)
    lin = linearize(network, state, unknowns, Arrangement.of(groups, rank, network), workers_)
    pattern = analyse(lin, rank, state.points)
    datum = choose_datum(find_defect(lin, state), lin, settings, network)
    return System(lin, pattern, datum.held, lin.transposed(lin.misclosure), state.points)


def oracle(s, damping=0.0):
    """Inverse, redundancy numbers, solution and condition number by orthogonal factors of the dense, scaled design matrix."""
    lin = s.lin
    kept = np.setdiff1d(np.arange(lin.unknowns.count), s.held)
    scale = lin.scale[kept]
    a = lin.design.toarray()[:, kept] / scale
    stacked = np.vstack([a, np.sqrt(damping) * np.eye(len(kept))]) if damping else a
    q, r = linalg.qr(stacked, mode="economic")
    cond = np.linalg.cond(r)
    half = linalg.solve_triangular(r, np.eye(len(kept))) / scale[:, None]
    inverse = np.zeros((lin.unknowns.count, lin.unknowns.count))
    inverse[np.ix_(kept, kept)] = half @ half.T
    q = q[: lin.count]
    x = np.zeros(lin.unknowns.count)
    x[kept] = linalg.solve_triangular(r, q.T @ lin.misclosure) / scale
    return inverse, q, x, cond


def compare(s, solver, damping=0.0):
    """Check hat blocks, blocks of the inverse, and solutions against the oracle."""
    inverse, q, x, cond = oracle(s, damping)
    tolerance = max(1e-10, EPS * cond**2)
    total = 0.0
    for c, hat in zip(s.lin.chunks, solver.hat(), strict=True):
        own = q[c.rows]  # (N, m, u)
        expected = own @ own.transpose(0, 2, 1)
        assert np.abs(hat - expected).max(initial=0.0) <= tolerance
        total += np.einsum("nii->", hat)
    free = s.lin.unknowns.count - len(s.held)
    if not damping:
        assert s.lin.count - total == pytest.approx(s.lin.count - free, rel=1e-9)
    for group in s.lin.unknowns.groups:
        widths = np.diff(group.offsets)
        for width in np.unique(widths[widths > 0]):
            columns = group.columns[group.offsets[:-1][widths == width][:, None] + np.arange(width)]
            columns = columns[(columns >= 0).any(axis=1)]
            if not len(columns):
                continue
            padded = np.zeros((len(inverse) + 1, len(inverse) + 1))
            padded[:-1, :-1] = inverse
            expected = padded[columns[:, :, None], columns[:, None, :]]
            got = solver.blocks(columns)
            sigma = np.sqrt(np.einsum("nii->ni", expected))
            size = sigma[:, :, None] * sigma[:, None, :]
            assert np.abs(got - expected).max() <= tolerance * max(size.max(), 1e-300)
            there = size > 0.0
            assert (np.abs(got - expected)[there] <= tolerance * size[there]).all(), group.kind
            assert (got[~there] == 0.0).all()
    some = np.unique(np.linspace(0, len(inverse) - 1, 25).astype(int))
    camera = s.lin.unknowns["camera"].columns
    for a, b in ((some, np.append(some[:7], -1)), (camera, s.lin.unknowns["image"].columns[:12])):
        expected = np.zeros((len(inverse) + 1, len(inverse) + 1))
        expected[:-1, :-1] = inverse
        size = np.sqrt(np.outer(np.diag(expected)[a], np.diag(expected)[b]))
        assert (np.abs(solver.pairs(a, b) - expected[np.ix_(a, b)]) <= tolerance * size).all()
    got = solver.solve(s.rhs)
    assert (got[s.held] == 0.0).all()
    moved = np.sqrt(np.abs(np.diag(inverse)))
    assert (np.abs(got - x) <= tolerance * np.maximum(moved, 1e-300) * max(np.linalg.norm(s.lin.misclosure), 1.0)).all()
    several = np.column_stack([s.rhs, np.cos(np.arange(len(s.rhs))) * s.lin.scale])
    both = solver.solve(several)
    assert (np.abs(both[:, 0] - x) <= tolerance * np.maximum(moved, 1e-300) * max(np.linalg.norm(s.lin.misclosure), 1.0)).all()
    y = np.cos(np.arange(s.lin.count))
    step, change = solver.least_squares(y)
    assert (np.abs(step - inverse @ s.lin.transposed(y)) <= tolerance * np.maximum(moved, 1e-300) * np.linalg.norm(y)).all()
    assert np.abs(change - s.lin.times(step)).max() <= 1e-10 * np.linalg.norm(y)
    exact = inverse @ several[:, 1]
    assert (np.abs(both[:, 1] - exact) <= tolerance * np.maximum(moved, 1e-300) * np.linalg.norm(several[:, 1] * moved)).all()
    return cond


@pytest.mark.parametrize("name", list(NETWORKS))
def test_against_dense_algebra(name, loops, clusters):
    s = system(NETWORKS[name]())
    cond = compare(s, BlockSolver.of(s.lin, s.pattern, s.held))
    assert cond < 1e7  # the tolerance stays meaningful


@pytest.mark.parametrize("name", ["aerial", "joined points", "partly fixed", "two models"])
def test_damped_system(name, loops, clusters):
    s = replace(system(NETWORKS[name]()), held=np.zeros(0, dtype=np.intp))
    compare(s, BlockSolver.of(s.lin, s.pattern, s.held, 1e-3), 1e-3)


@pytest.mark.parametrize("name", ["ring, free", "aerial", "joined points"])
def test_held_columns(name, loops, clusters):
    """Any unknown may be held: of cameras, images, inner points, all three coordinates of one, joined points."""
    s = system(NETWORKS[name]())
    unknowns = s.lin.unknowns
    inner = np.flatnonzero(inner_points(s.lin))
    points = unknowns["point"].columns.reshape(-1, 3)
    image = unknowns["image"].columns
    held = [*s.held, unknowns["camera"].columns.max(), image[6], *points[inner[3]], points[inner[5]][1], points[9][0]]
    s = replace(s, held=np.unique(held))
    compare(s, BlockSolver.of(s.lin, s.pattern, s.held))


@pytest.mark.parametrize("name", list(NETWORKS))
def test_a_part_of_a_larger_network(name, loops, clusters):
    """Some images, cameras and joined points are left as a border; with the border's solution and cofactors all comes out as before."""
    s = system(NETWORKS[name]())
    lin = s.lin
    image, camera = lin.unknowns["image"].columns.reshape(-1, 6), lin.unknowns["camera"].columns
    shared = np.concatenate([image[1], image[-1], camera])
    pattern = analyse(lin, rank_of_points(s.points), s.points, shared[shared >= 0])
    part = BlockSolver.of(lin, pattern, s.held)
    columns, matrix = part.border
    assert set(columns) == set(np.setdiff1d(shared, [-1, *s.held]))
    inverse, _, x, cond = oracle(s)
    kept = np.ix_(columns, columns)
    size = np.sqrt(np.diag(matrix))
    tolerance = max(1e-10, EPS * cond**2)
    assert np.abs((matrix - np.linalg.inv(inverse[kept])) / np.outer(size, size)).max() <= tolerance
    y = lin.misclosure
    moved = np.sqrt(np.abs(np.diag(inverse)))
    own = np.abs(np.linalg.solve(matrix, part.reduced(y)) - x[columns])
    assert (own <= tolerance * moved[columns] * max(np.linalg.norm(y), 1.0)).all()
    found, change = part.expanded(y, x[columns])
    assert (np.abs(found - x) <= tolerance * np.maximum(moved, 1e-300) * max(np.linalg.norm(y), 1.0)).all()
    assert np.abs(change - lin.times(found)).max() <= 1e-10 * max(np.linalg.norm(y), 1.0)
    with pytest.raises(baarda.errors.UsageError, match="cofactors of its border"):
        part.hat()
    whole, part = BlockSolver.of(lin, s.pattern, s.held), part.given(inverse[kept])
    for a, b in zip(part.hat(), whole.hat(), strict=True):
        assert np.abs(a - b).max(initial=0.0) <= tolerance
    for nodes in (lin.unknowns["point"].columns.reshape(-1, 3), image):
        nodes = nodes[(nodes >= 0).any(axis=1)]
        size = np.sqrt(np.einsum("nii->n", whole.blocks(nodes)))[:, None, None] ** 2
        assert np.abs(part.blocks(nodes) - whole.blocks(nodes)).max() <= tolerance * size.max()


@pytest.mark.parametrize("name", list(NETWORKS))
def test_diagonals_of_hats_are_handed_over(name, loops):
    """Without correlations only diagonals are stored, the same to the last bit; they can be had again, and the blocks too."""
    s = system(NETWORKS[name]())
    solver, other = BlockSolver.of(s.lin, s.pattern, s.held), BlockSolver.of(s.lin, s.pattern, s.held)
    first, again, whole, after = solver.hat(whole=False), solver.hat(whole=False), solver.hat(), solver.hat(whole=False)
    assert [h.ndim == 2 for h in first] == [c.plain for c in s.lin.chunks]
    assert all(c.plain for c in s.lin.chunks) == ("correlated" not in name)
    for c, a, b, h, d in zip(s.lin.chunks, first, again, whole, after, strict=True):
        assert h.shape == (len(c.first), c.m, c.m)
        for found in (a, b, d):
            np.testing.assert_array_equal(found, np.einsum("nii->ni", h) if c.plain else h)
    for a, b in zip(whole, other.hat(), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(DenseSolver.of(s.lin, s.held).hat(whole=False), first, strict=True):
        assert a.shape == b.shape


def test_blocks_of_the_inverse_are_of_one_node():
    s = system(NETWORKS["aerial"]())
    solver = BlockSolver.of(s.lin, s.pattern, s.held)
    images = s.lin.unknowns["image"].columns.reshape(-1, 6)
    np.testing.assert_array_equal(solver.blocks(images[:, [4, 0]]), solver.blocks(images)[:, [4, 0]][:, :, [4, 0]])
    with pytest.raises(baarda.errors.UsageError, match="of one node"):
        solver.blocks(images[:2].reshape(1, -1))


def test_points_in_any_order_and_choice():
    s = system(NETWORKS["joined points"]())
    solver = BlockSolver.of(s.lin, s.pattern, s.held)
    columns = s.lin.unknowns["point"].columns.reshape(-1, 3)
    every = solver.blocks(columns)
    np.testing.assert_array_equal(solver.blocks(columns[::-2]), every[::-2])
    np.testing.assert_array_equal(solver.blocks(columns[:, [2, 0]]), every[:, [2, 0]][:, :, [2, 0]])


def test_all_cameras_known(loops):
    """Without nodes there is nothing to reduce to: points alone."""
    network = made("ring", images=5, points=20)
    cams = tuple(replace(c, states=np.zeros(len(c.values), dtype=np.int8)) for c in network.cameras)
    images = replace(network.images, states=np.zeros((5, 6), dtype=np.int8))
    s = system(replace(network, cameras=cams, images=images))
    assert not s.pattern.fronts
    solver = BlockSolver.of(s.lin, s.pattern, s.held)
    compare(s, solver)
    assert solver.rcond == 1.0


def test_all_points_known(loops):
    """Without inner points everything is a front: resections."""
    network = made("ring", images=5, points=20)
    s = system(replace(network, points=replace(network.points, states=np.zeros((20, 3), dtype=np.int8), given=network.points.coordinates)))
    assert not len(s.pattern.points)
    compare(s, BlockSolver.of(s.lin, s.pattern, s.held))


def test_weights_of_rows(loops, clusters):
    """`weighted`, which likelihood adjustments use, is the system with rows multiplied."""
    s = system(NETWORKS["joined points"]())
    roots = 0.5 + np.random.default_rng(0).random(s.lin.count)
    lin = s.lin.weighted(roots)
    np.testing.assert_allclose(lin.design.toarray(), roots[:, None] * s.lin.design.toarray(), rtol=1e-14)
    np.testing.assert_array_equal(lin.misclosure, roots * s.lin.misclosure)
    weighted = replace(s, lin=lin, rhs=lin.transposed(lin.misclosure))
    compare(weighted, BlockSolver.of(lin, s.pattern, s.held))


@pytest.mark.parametrize("name", list(NETWORKS))
def test_products_with_the_design_matrix(name, loops):
    s = system(NETWORKS[name]())
    a, rng = s.lin.design.toarray(), np.random.default_rng(1)
    x, y = rng.standard_normal(a.shape[1]) / s.lin.scale, rng.standard_normal(a.shape[0])
    size = np.abs(a) @ np.abs(x)
    assert (np.abs(s.lin.times(x) - a @ x) <= 1e-13 * size + 1e-300).all()
    assert (np.abs(s.lin.transposed(y) - a.T @ y) <= 1e-13 * (np.abs(a).T @ np.abs(y)) + 1e-300).all()
    np.testing.assert_allclose(s.lin.row_sums(x**2), (a**2) @ x**2, rtol=1e-12)
    np.testing.assert_allclose(s.lin.column_sums(y**2), (a**2).T @ y**2, rtol=1e-12)
    kinds = {"point"}
    own = np.array([s.lin.unknowns.groups[k].kind in kinds for k in s.lin.unknowns.kinds])
    np.testing.assert_allclose(s.lin.times(x, kinds), a[:, own] @ x[own], rtol=1e-9, atol=1e-12 * size.max())
    np.testing.assert_allclose(s.lin.transposed(y, kinds)[own], (a.T @ y)[own], rtol=1e-9, atol=1e-10 * s.lin.scale.max())
    assert (s.lin.transposed(y, kinds)[~own] == 0.0).all()


# ---- larger systems against the dense solver ----
LARGE = {
    "aerial": lambda: made("aerial", images=25, points=900),
    "long tracks": lambda: made("long-tracks", images=30, points=650),
    "dense": lambda: made("dense", images=30, points=700),
    "per-image cameras": lambda: made("aerial", images=36, points=650, per_image_cameras=True),
}


@pytest.mark.parametrize("name", list(LARGE))
@pytest.mark.parametrize("compiled", [True, False])
def test_thousands_of_unknowns(name, compiled, monkeypatch):
    for module in SWITCHES:
        monkeypatch.setattr(module, "COMPILE_FROM", 0 if compiled else 10**9)
    s = system(LARGE[name]())
    assert 2000 < s.lin.unknowns.count <= 5000
    against_dense_solver(s)


def against_dense_solver(s):
    solver, dense = BlockSolver.of(s.lin, s.pattern, s.held), DenseSolver.of(s.lin, s.held)
    tolerance = max(1e-10, EPS / dense.rcond)
    total = 0.0
    for one, two in zip(solver.hat(), dense.hat(), strict=True):
        assert np.abs(one - two).max(initial=0.0) <= tolerance
        total += np.einsum("nii->", one)
    redundancy = s.lin.count - s.lin.unknowns.count + len(s.held)
    assert s.lin.count - total == pytest.approx(redundancy, rel=1e-9)
    for kind, width in (("image", 6), ("point", 3)):
        columns = s.lin.unknowns[kind].columns.reshape(-1, width)
        columns = columns[(columns >= 0).any(axis=1)]
        one, two = solver.blocks(columns), dense.blocks(columns)
        sigma = np.sqrt(np.einsum("nii->ni", two))
        size = sigma[:, :, None] * sigma[:, None, :]
        assert (np.abs(one - two)[size > 0.0] <= tolerance * size[size > 0.0]).all()
    x, y = solver.solve(s.rhs), dense.solve(s.rhs)
    assert np.linalg.norm((x - y) * s.lin.scale) <= tolerance * np.linalg.norm(s.lin.misclosure)


def cut_out(network, images):
    """Return the images with all their cameras and image points, and the points that at least two of them see."""
    group = network.observations[0]
    chosen = group.selected(np.isin(group.images, images))
    rays = np.bincount(chosen.points, minlength=len(network.points.labels))
    chosen = chosen.selected(rays[chosen.points] >= 2)
    kept, points = np.unique(chosen.images), np.unique(chosen.points)
    number = np.full(len(network.images.labels), -1)
    number[kept] = np.arange(len(kept))
    place = np.full(len(network.points.labels), -1)
    place[points] = np.arange(len(points))
    table = {k: getattr(network.images, k)[kept] for k in ("cameras", "position", "rotation", "states", "given", "sigmas")}
    rows = {k: getattr(network.points, k)[points] for k in ("coordinates", "roles", "states", "given", "sigmas", "correlations")}
    return replace(
        network,
        images=Images(tuple(network.images.labels[i] for i in kept), **table),
        points=Points(tuple(network.points.labels[i] for i in points), **rows),
        observations=(replace(chosen, images=number[chosen.images], points=place[chosen.points]),),
    )


def test_camera_complete_cut_out_of_a_large_block(monkeypatch):
    monkeypatch.setattr(kernels, "COMPILE_FROM", 0)
    block = made("aerial", images=100, points=4000)
    across = 10
    centre = [r * across + c for r in range(4, 8) for c in range(4, 8)]
    s = system(cut_out(block, centre))
    assert 2000 < s.lin.unknowns.count <= 5000
    against_dense_solver(s)


def test_cut_out_of_real_images(data, monkeypatch):
    """Part of BAL's Dubrovnik: a camera per image, long and short tracks, a free network."""
    network = baarda.formats.read(data("bal_dubrovnik16") / "problem-16-22106-pre.txt")
    group = network.observations[0]
    rng = np.random.default_rng(2)
    chosen = rng.choice(len(network.points.labels), 1100, replace=False)
    s = system(cut_out(replace(network, observations=(group.selected(np.isin(group.points, chosen)),)), np.arange(16)))
    assert 2000 < s.lin.unknowns.count <= 5000
    for compile_from in (0, 10**9):
        for module in SWITCHES:
            monkeypatch.setattr(module, "COMPILE_FROM", compile_from)
        against_dense_solver(s)


@pytest.mark.parametrize("name", list(NETWORKS))
def test_evaluated_partials_are_the_stored_ones(name, monkeypatch):
    if kernels.compiled() is None:
        pytest.skip("numba is not installed")
    for module in SWITCHES:
        monkeypatch.setattr(module, "COMPILE_FROM", 0)
    stored = system(NETWORKS[name]()).lin
    monkeypatch.setattr("baarda.adjustment.linearize.EVALUATED_FROM", 0)
    evaluated = system(NETWORKS[name]()).lin
    assert stored.stored
    assert evaluated.stored == (name == "correlated")
    roots = 1.0 + np.arange(stored.count) % 7
    for a, b in ((stored, evaluated), (stored.weighted(roots), evaluated.weighted(roots)), (stored.sample(50), evaluated.sample(50))):
        np.testing.assert_array_equal(a.misclosure, b.misclosure)
        assert abs(a.design - b.design).max() <= 1e-15 * abs(a.design).max()
    np.testing.assert_allclose(stored.scale, evaluated.scale, rtol=1e-14)


# ---- threads ----
@pytest.mark.parametrize("name", ["aerial", "joined points", "dense", "several groups"])
def test_threads_change_no_bit(name, loops, monkeypatch):
    network = NETWORKS[name]()
    monkeypatch.setattr("baarda.adjustment.linear_system.PIECE", 97)
    monkeypatch.setattr("baarda.observations.image_points.CHUNK", 101)
    monkeypatch.setattr("baarda.adjustment.structure.RUN", 103)
    results = []
    for count in (1, 2, 3):
        monkeypatch.setattr(workers, "worker_count", lambda _, count=count: count)
        r = baarda.adjust(network, solver="block")
        assert r.status == "converged"
        results.append((r.unknowns["value"], r.unknowns["sigma"], r.redundancy_numbers, r.residuals, [h.objective for h in r.history]))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_more_fronts_than_threads_change_no_bit(monkeypatch):
    """A tree of many fronts, so that the order in which they finish varies."""
    monkeypatch.setattr(kernels, "COMPILE_FROM", 10**9)
    for name, value in (("BASE", 1), ("MOST", 2)):
        monkeypatch.setattr(clusters_, name, value)
    monkeypatch.setattr("baarda.adjustment.structure.dissect", lambda graph, places: dissect(graph, None, 3))
    s = system(chain(80, 450))
    assert len(s.pattern.fronts) > 6
    results = []
    for count in (1, 2, 3):
        lin = replace(s.lin, workers=count)
        solver = BlockSolver.of(lin, s.pattern, s.held)
        results.append([solver.solve(s.rhs), *solver.hat(), *solver.panels])
    for other in results[1:]:
        assert len(other) == len(results[0])
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


# ---- whole adjustments ----
@pytest.mark.parametrize("name", list(NETWORKS))
def test_adjustments_agree(name, clusters):
    network = NETWORKS[name]()
    rays = 1 if name == "single rays" else 2
    dense, block = (baarda.adjust(network, solver=s, min_rays=rays) for s in ("dense", "block"))
    assert dense.status == block.status == "converged"
    assert block.redundancy == dense.redundancy
    assert block.objective == pytest.approx(dense.objective, rel=1e-10)
    tolerance = max(1e-9, EPS / dense.solver.rcond)
    assert np.abs(block.redundancy_numbers - dense.redundancy_numbers).max() <= 10 * tolerance
    assert block.redundancy_numbers.sum() == pytest.approx(block.redundancy, rel=1e-9)
    sigma = dense.unknowns["sigma"]
    np.testing.assert_allclose(block.unknowns["sigma"], sigma, rtol=1e-6)
    assert (np.abs(block.unknowns["value"] - dense.unknowns["value"]) <= 1e-5 * sigma).all()


def test_a_part_without_control_is_named():
    """Two parts, one of which nothing ties down: a named error of unknowns of that part, no crash, from either solver."""
    network = disconnected(0)
    for solver in ("block", "dense"):
        with pytest.raises(Singular) as caught:
            baarda.adjust(network, solver=solver)
        assert " Z" in str(caught.value)
        named = ", ".join(network.images.labels[5:8])
        assert "the block falls into 2 parts that no point joins: 5 image(s) (" in str(caught.value)
        assert f"; 4 image(s) ({named}, ...) with 30 point(s)" in str(caught.value)


def test_two_free_parts_are_named():
    """Two parts without control: the datum defect of the whole is 7, of the parts 14."""
    one = disconnected(0)
    roles, states = np.zeros_like(one.points.roles), np.full_like(one.points.states, FREE)
    network = replace(one, points=replace(one.points, roles=roles, states=states))
    for solver in ("block", "dense"):
        with pytest.raises(Singular, match="falls into 2 parts"):
            baarda.adjust(network, solver=solver)


@pytest.mark.parametrize("searched", [4000, 10])
def test_weak_fronts_are_named_whichever_front_shows_them(searched, monkeypatch):
    """Distances far too weak to fix the scale, and a part without control, in a tree of several fronts."""
    monkeypatch.setattr(block_module, "SEARCHED", searched)
    monkeypatch.setattr("baarda.adjustment.structure.dissect", partial(dissect, leaf=3))
    for control in (0, 1, 2):
        with pytest.raises(Singular, match="do not determine"):
            baarda.adjust(disconnected(control), solver="block")


def test_a_ray_alone_determines_no_point():
    network = made("ring", images=6, points=40)
    group = network.observations[0]
    at = np.flatnonzero(network.points.roles == 0)[4]
    alone = (group.points == at) & (group.images != 2)
    cut = replace(network, observations=(group.selected(~alone),))
    for rays in (0, 1):
        for solver in ("block", "dense"):
            with pytest.raises(Singular, match=f"point {network.points.labels[at]}: "):
                baarda.adjust(cut, solver=solver, min_rays=rays)
    r = baarda.adjust(cut, solver="block")
    assert r.aside[at]


def test_identical_projection_centres_are_named():
    """Two images from one place see a point on parallel rays; no other image sees it."""
    network = made("ring", images=6, points=40, perturbation=0.0)
    images = network.images
    position = np.array(images.position)
    position[1] = position[0]
    group = network.observations[0]
    at = int(np.flatnonzero(network.points.roles == 0)[4])
    cut = group.selected((group.points != at) | (group.images < 2))
    states = np.array(images.states)
    states[:2] = FIXED
    rotation = np.array(images.rotation)
    rotation[1] = rotation[0]
    damaged = replace(network, images=replace(images, position=position, rotation=rotation, states=states), observations=(cut,))
    for module_loops in (0, 10**9):
        with pytest.MonkeyPatch.context() as patch:
            for module in SWITCHES:
                patch.setattr(module, "COMPILE_FROM", module_loops)
            with pytest.raises(Singular, match=f"point {network.points.labels[at]}"):
                baarda.adjust(damaged, solver="block")


def test_weak_distance_of_a_far_point():
    """A point a thousand bases away: nearly parallel rays lose no digits by the elimination."""
    network = made("ring", images=4, points=30, perturbation=0.0, noise=0.0)
    images, points = network.images, network.points
    position = images.position.copy()
    position[1] = position[0] + 0.002
    rotation = images.rotation.copy()
    rotation[1] = rotation[0]
    truth = replace(network, images=replace(images, position=position, rotation=rotation))
    group = truth.observations[0]
    at = int(np.flatnonzero(points.roles == 0)[3])
    group = group.selected((group.points != at) | (group.images < 2))
    truth = replace(truth, observations=(group,))
    xy = group.xy - group.misclosures(truth, State.of(truth))
    truth = replace(truth, observations=(replace(group, xy=xy),))
    s = system(truth)
    cond = compare(s, BlockSolver.of(s.lin, s.pattern, s.held))
    assert cond > 1e4


@pytest.mark.parametrize("points", [0, 1])
def test_too_little_is_refused(points):
    network = made("ring", images=4, points=30)
    group = network.observations[0]
    with pytest.raises((UsageError, baarda.errors.BaardaError)):
        baarda.adjust(replace(network, observations=(group.selected(group.points < points),)), solver="block")


# ---- without numba ----
def test_without_numba():
    code = """
import sys
sys.modules["numba"] = None
import numpy as np
import baarda
from baarda.adjustment import kernels, vector_loops
from baarda.observations import kernels as image_kernels
from baarda.procedures.synthetic import synthetic
for module in (kernels, vector_loops, image_kernels):
    module.COMPILE_FROM = 0
    assert module.compiled() is None
r = baarda.adjust(synthetic("aerial", images=9, points=100, seed=3).network, solver="block")
assert r.status == "converged"
assert abs(r.redundancy_numbers.sum() / r.redundancy - 1.0) < 1e-9
print(repr(r.objective))
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert out.returncode == 0, out.stderr
    assert float(out.stdout) == pytest.approx(baarda.adjust(NETWORKS["aerial"](), solver="block").objective, rel=1e-10)


def test_no_place_to_cache_compiled_loops():
    """Where numba finds no folder for its cache the loops are compiled anyway."""
    code = """
import numba
real = numba.njit
def njit(*args, cache=False, **rest):
    if cache:
        raise RuntimeError("cannot cache function: no locator available")
    return real(*args, **rest)
numba.njit = njit
from baarda.adjustment import kernels, vector_loops
from baarda.observations import kernels as image_kernels
assert vector_loops.compiled() is not None
assert image_kernels.compiled() is not None
assert kernels.compiled() is not None
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert out.returncode == 0, out.stderr


# ---- interruptions ----
PHASES = {
    "linearisation": "baarda.observations.image_points.ImagePoints.linearize_piece",
    "trial": "baarda.observations.image_points.ImagePoints.misclosures_of_piece",
    "pattern": "baarda.adjustment.solve.analyse",
    "factor": "baarda.adjustment.lapack.cholesky",
    "solution": "baarda.adjustment.block.BlockSolver.solve",
    "inverse": "baarda.adjustment.lapack.invert_from_cholesky",
    "tests": "baarda.procedures.testing.analyse",
    "report": "baarda.report.page.html",
}


@pytest.mark.skipif(sys.platform == "win32", reason="no such signal")
@pytest.mark.parametrize("phase", list(PHASES))
def test_an_interruption_leaves_nothing(phase, tmp_path):
    """SIGINT while a phase begins, in whatever thread: exit code 130, one line, no folder, no temporary file."""
    code = """
import importlib, os, signal, sys
target, project, out = sys.argv[1:]
parts = target.split(".")
holder = None
for i in range(len(parts) - 1, 0, -1):
    try:
        holder, rest = importlib.import_module(".".join(parts[:i])), parts[i:]
        break
    except ModuleNotFoundError:
        continue
for name in rest[:-1]:
    holder = getattr(holder, name)
original = getattr(holder, rest[-1])
def interrupted(*args, **options):
    os.kill(os.getpid(), signal.SIGINT)
    return original(*args, **options)
setattr(holder, rest[-1], interrupted)
from baarda.cli import main
sys.argv = ["baarda", "adjust", project, "--solver", "block", "--quiet", "--out", out]
main()
"""
    project = tmp_path / "in" / "ring.txt"
    project.parent.mkdir()
    network = made("ring", images=5, points=30)
    cams = tuple(
        cameras.create(str(i), cameras.model("snavely"), {"principal_distance": 5500.0}, free=("principal_distance",)) for i in range(5)
    )
    baarda.formats.write(replace(network, cameras=cams, images=replace(network.images, cameras=np.arange(5))), project, "bal")
    target = tmp_path / "out"
    target.mkdir()
    command = [sys.executable, "-c", code, PHASES[phase], str(project), str(target / "result")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 130, done.stderr
    assert done.stderr.strip() == "baarda: interrupted, nothing was written"
    assert not list(target.iterdir())
    assert [p.name for p in project.parent.iterdir()] == ["ring.txt"]
