"""Predicted against sampled on whole networks: sigmas, v'Pv, the size of every test and the power at the minimal detectable bias."""

from dataclasses import replace

import numpy as np
import pytest

from baarda.network import CHECK
from baarda.procedures.planning import plan
from baarda.procedures.proof import prove
from baarda.procedures.simulation import simulate
from baarda.procedures.synthetic import synthetic

pytestmark = pytest.mark.sampling


def with_reference(network, sigma):
    """Return the network with check points whose survey has errors of its own."""
    at = network.points.roles == CHECK
    sigmas = np.where(at[:, None], sigma, network.points.sigmas)
    return replace(network, points=replace(network.points, sigmas=sigmas))


@pytest.mark.parametrize(
    ("kind", "options", "replicas"),
    [
        ("ring", {"images": 5, "points": 14, "checks": 4}, 400),
        ("ring", {"images": 5, "points": 14, "control": 0, "model": "brown"}, 300),
        ("long-tracks", {"images": 6, "points": 20, "checks": 3}, 200),
        ("dense", {"images": 6, "points": 20, "per_image_cameras": True, "model": "SIMPLE_RADIAL"}, 200),
        ("aerial", {"images": 5, "points": 25, "checks": 4}, 150),
    ],
    ids=["ring", "free ring", "long tracks", "camera of every image", "aerial"],
)
def test_predictions_hold(kind, options, replicas):
    network = synthetic(kind, seed=8, **options).network
    proof = prove(simulate(plan(network), replicas, seed=21))
    assert proof.replicas.count == replicas
    wrong = [(p.name, p.z) for p in (*proof.sigmas, proof.residuals, proof.objective, *proof.sizes, proof.power) if not p.holds]
    assert not wrong
    assert proof.worst[2] > 1e-4
    assert sum(p.told for p in proof.sizes) >= 15


def test_check_points_with_errors_of_their_own():
    network = with_reference(synthetic("ring", images=5, points=14, checks=5, seed=8).network, 0.0007)
    proof = prove(simulate(plan(network), 200, seed=3))
    sizes = {p.name: p for p in proof.sizes}
    for name in ("check_points", "check_point", "check_points (a priori)", "check_point (a priori)"):
        assert sizes[name].told
        assert sizes[name].holds
