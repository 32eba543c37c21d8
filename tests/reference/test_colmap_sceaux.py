"""A COLMAP model of 11 photographs: converges from the model in a free datum; both solvers agree on camera-complete cut-outs."""

from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.formats import read
from baarda.network import Images, Points


@pytest.fixture(scope="module")
def network(data):
    return read(data("colmap_sceaux_txt"))


@pytest.fixture(scope="module")
def result(network):
    return baarda.adjust(network)


def test_size(network):
    assert len(network.images.labels) == 11
    assert len(network.points.labels) == 7862
    assert len(network.observations[0]) == 37123


def test_converges_from_the_model_in_a_free_datum(result):
    assert result.status == "converged"
    assert result.datum.name == "inner"
    assert result.datum.defect.count == 7
    assert (result.count, result.numbering.count, result.redundancy) == (74246, 23654, 50599)
    c = dict(zip(result.network.cameras[0].model.order, result.network.cameras[0].values, strict=True))
    assert c["principal_distance"] == pytest.approx(2971.71, abs=2.0)  # the robust loss of COLMAP is not ours
    assert c["k1"] == pytest.approx(-0.164224, abs=1e-3)
    assert not result.behind


def test_redundancy_numbers(result):
    r = result.redundancy_numbers
    assert r.sum() == pytest.approx(result.redundancy, rel=1e-9)
    assert r.min() > -1e-10
    assert r.max() < 1 + 1e-10


def cut_out(network, images, points):
    """The first images with all their rays to some of the points they share."""
    group = network.observations[0]
    rows = np.flatnonzero(group.images < images)
    rays = np.bincount(group.points[rows], minlength=len(network.points.labels))
    chosen = np.flatnonzero(rays >= 2)[:points]
    rows = rows[np.isin(group.points[rows], chosen)]
    number = np.full(len(network.points.labels), -1)
    number[chosen] = np.arange(len(chosen))
    im, pt = network.images, network.points
    group = replace(group.selected(rows), points=number[group.points[rows]])
    return replace(
        network,
        images=Images.make(im.labels[:images], im.cameras[:images], im.position[:images], im.rotation[:images]),
        points=Points.make([pt.labels[i] for i in chosen], pt.coordinates[chosen]),
        observations=(group,),
    )


@pytest.mark.parametrize(("images", "points"), [(3, 120), (6, 500), (11, 1640)])
def test_dense_and_block_agree(network, images, points):
    part = cut_out(network, images, points)
    block, dense = baarda.adjust(part, solver="block"), baarda.adjust(part, solver="dense")
    assert dense.numbering.count == 2 + 6 * images + 3 * points
    cond2 = 1.0 / dense.solver.rcond
    difference = np.abs(block.redundancy_numbers - dense.redundancy_numbers).max()
    assert difference <= max(1e-10, np.finfo(float).eps * cond2)
    assert block.redundancy_numbers.sum() == pytest.approx(block.redundancy, rel=1e-9)
    np.testing.assert_allclose(block.points["sX"], dense.points["sX"], rtol=1e-6)
    assert block.objective == pytest.approx(dense.objective, rel=1e-10)
