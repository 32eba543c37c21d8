"""Lever arm, shift and drift: the predicted standard deviations against the scatter of simulated positions."""

from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.network import State
from baarda.observations import CameraPositions, lever_arms, strips
from networks import ring

ARM, LINE = np.array([0.1, 0.2, -0.3]), np.array([0.5, -0.2, 0.1, 0.01, 0.0, -0.02])


@pytest.mark.sampling
def test_predicted_covariance_of_arm_shift_and_drift():
    base = ring(images=8, points=16, control=6, noise=0.3, free=(), control_sigma=0.005)
    truth = baarda.adjust(base).network
    group = truth.observations[0]
    exact = replace(group, xy=group.xy - group.misclosures(truth, State.of(truth)))
    i = np.arange(8)
    times = i - 3.5
    antenna = truth.images.position + np.einsum("nji,j->ni", truth.images.rotation, ARM) + LINE[:3] + times[:, None] * LINE[3:]
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 4.0, -0.5], [0.0, -0.5, 9.0]]) * 1e-6
    root = np.linalg.cholesky(covariance)
    zero = np.zeros(8, dtype=int)
    declared = (lever_arms(["1"], [ARM], True), strips(["a"], True, True))
    rng = np.random.default_rng(7)
    names = [f"lever_arm 1: {a}" for a in "xyz"] + [f"strip a: {k}_{a}" for k in ("shift", "drift") for a in "XYZ"]
    found, chi2 = [], []
    control = truth.points.roles == 1
    for _ in range(300):
        points = truth.points
        given = np.where(control[:, None], points.coordinates + 0.005 * rng.standard_normal(points.given.shape), np.nan)
        rays = replace(exact, xy=exact.xy + group.sigmas * rng.standard_normal(exact.xy.shape))
        positions = CameraPositions(i, zero, zero, times, antenna + rng.standard_normal((8, 3)) @ root.T, np.tile(covariance, (8, 1, 1)))
        network = replace(truth, points=replace(points, given=given), observations=(rays, positions), declared=declared)
        result = baarda.adjust(network)
        value = dict(zip(result.unknowns["name"], result.unknowns["value"], strict=True))
        d = np.array([value[n] for n in names]) - np.concatenate([ARM, LINE])
        found.append(d)
        chi2.append(d @ np.linalg.solve(result.covariance(names, sigma="apriori"), d))
    # a sum of 300 chi-squares of 9 degrees of freedom
    z = (np.sum(chi2) - 300 * 9) / np.sqrt(2 * 300 * 9)
    assert abs(z) < 4.0
    d = np.array(found)
    assert (np.abs(d.mean(axis=0)) < 4.0 * d.std(axis=0) / np.sqrt(300)).all()
