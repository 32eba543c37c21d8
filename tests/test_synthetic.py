"""Synthetic blocks: statistics as stated, truth that the observations obey, start values that an adjustment overcomes."""

import numpy as np
import pytest

import baarda
from baarda.errors import UsageError
from baarda.network import CHECK, CONTROL, State
from baarda.procedures.synthetic import aerial, dense, long_tracks, ring, synthetic


def rays_of(network):
    return np.bincount(network.observations[0].points, minlength=len(network.points.labels))


def shares(network):
    """Return the share of pairs of images that see a point in common."""
    group = network.observations[0]
    n = len(network.images.labels)
    seen = np.zeros((n, len(network.points.labels)), dtype=bool)
    seen[group.images, group.points] = True
    common = seen.astype(int) @ seen.T.astype(int)
    return float((common[np.triu_indices(n, 1)] > 0).mean())


def test_aerial_block_has_the_stated_statistics():
    network = aerial(20).network
    rays = rays_of(network)
    assert abs(len(rays) - 3817) < 0.02 * 3817
    assert abs(rays.sum() - 16977) < 0.02 * 16977
    assert rays.min() >= 3
    assert (network.points.roles == CONTROL).sum() == 6


def test_larger_aerial_block_has_more_rays_per_point():
    rays = rays_of(aerial(100).network)
    assert abs(rays.mean() - 98151 / 18443) < 0.15
    assert abs(len(rays) - 18443) < 0.05 * 18443


def test_ring_long_tracks_and_dense_graphs_are_what_they_are_called():
    assert (rays_of(ring(7, points=20).network) == 7).all()
    tracks = rays_of(long_tracks(20, points=400).network)
    assert tracks.max() == 20
    assert (tracks == 20).mean() > 0.25
    assert tracks.mean() > 10
    assert shares(dense(20, points=800).network) == 1.0
    assert shares(aerial(20).network) < 1.0


@pytest.mark.parametrize("kind", ["aerial", "ring", "long-tracks", "dense"])
@pytest.mark.parametrize("options", [{}, {"model": "brown"}, {"per_image_cameras": True}], ids=["radial", "brown", "per image"])
def test_truth_fits_and_start_values_lead_to_it(kind, options):
    points = None if kind == "aerial" else 60
    block = synthetic(kind, 5 if kind == "aerial" else 8, points=points, seed=3, checks=4, **options)
    truth = block.truth
    assert max(abs(g.misclosures(truth, State.of(truth))).max() for g in truth.observations) < 1e-8
    group = block.network.observations[0]
    errors = group.xy - truth.observations[0].xy
    assert abs(errors.std() / 0.5 - 1) < 4 / np.sqrt(2 * errors.size)
    result = baarda.adjust(block.network)
    assert result.status == "converged"
    assert abs(result.sigma0 - 1) < 4 / np.sqrt(2 * result.redundancy)
    assert len(truth.cameras) == (len(truth.images.labels) if options.get("per_image_cameras") else 1)
    assert (truth.points.roles == CHECK).sum() == 4


def test_same_seed_same_block_other_seed_another():
    a, b, c = (dense(6, points=30, seed=s).network for s in (1, 1, 2))
    assert np.array_equal(a.observations[0].xy, b.observations[0].xy)
    assert not np.array_equal(a.points.coordinates, c.points.coordinates)


def test_control_held_fixed_and_no_perturbation():
    block = aerial(5, control_sigma=0.0, perturbation=0.0, noise=0.0, points=60)
    at = block.network.points.roles == CONTROL
    assert (block.network.points.states[at] == 0).all()
    assert np.array_equal(block.network.points.coordinates, block.truth.points.coordinates)
    assert np.array_equal(block.network.observations[0].xy, block.truth.observations[0].xy)


def test_a_free_ring_has_scale_bars_and_nothing_else():
    network = ring(6, points=20, control=0).network
    result = baarda.adjust(network)
    assert result.datum.defect.count == 6
    assert len(network.observations[1]) == 3


def test_number_of_points_asked_for():
    assert len(aerial(9, points=500).network.points.labels) == 500


@pytest.mark.parametrize(
    ("kind", "images", "options"),
    [
        ("strip", 5, {}),
        ("ring", 1, {}),
        ("ring", 2, {}),
        ("aerial", 2, {}),
        ("ring", 5, {"points": 3}),
        ("ring", 5, {"noise": -1.0}),
        ("ring", 5, {"keep": 0.0}),
        ("ring", 5, {"colour": 1}),
        ("ring", 5, {"points": 20, "control": 30}),
        ("ring", 5, {"points": 20, "checks": 18}),
    ],
)
def test_what_makes_no_sense_is_refused(kind, images, options):
    with pytest.raises(UsageError):
        synthetic(kind, images, **options)
