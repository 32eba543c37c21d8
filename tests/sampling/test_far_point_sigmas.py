"""Inverse distances of points almost at infinity have the sigmas that their coordinates give them, and v'Pv is chi-square."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import baarda
from baarda.network import State
from baarda.observations import viewpoints_of
from test_far_points import far_network

REPLICAS = 400


@pytest.mark.sampling
@pytest.mark.parametrize("factor", [1e3, 1e6])
def test_inverse_distances_are_covered(factor: float) -> None:
    """Within 4 standard errors: the mean of v'Pv, and how often 95 % intervals of the inverse distances cover the truth."""
    ratios, left, redundancy = [], [], 0
    for seed in range(REPLICAS):
        network, truth, chosen = far_network(factor, images=4, points=40, wrong=0.2, seed=seed)
        found = baarda.adjust(network, solver="dense")
        assert found.status == "converged"
        state = State.of(found.network)
        seen, true = viewpoints_of(found.groups, state), State.of(truth)
        ray, exact = (state.points - seen.centres)[chosen], (true.points - viewpoints_of(truth.observations, true).centres)[chosen]
        r, s = np.linalg.norm(ray, axis=1), np.linalg.norm(exact, axis=1)
        side = np.sign(np.einsum("ni,ni->n", ray, exact))  # behind the images the inverse distance is negative
        deviation = np.sqrt(np.einsum("ni,nij,nj->n", ray, found.point_cofactors[chosen], ray)) / r
        ratios.append((side / r - 1.0 / s) / (deviation / r**2))
        left.append(found.objective - found.redundancy)
        redundancy += found.redundancy
    covered = np.abs(np.concatenate(ratios)) < stats.norm.ppf(0.975)
    share = covered.reshape(REPLICAS, -1).mean(axis=1)
    assert abs(share.mean() - 0.95) <= 4.0 * share.std() / np.sqrt(REPLICAS)
    assert abs(np.sum(left)) <= 4.0 * np.sqrt(2.0 * redundancy)
