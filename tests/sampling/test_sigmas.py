"""Predicted sigmas against Monte Carlo: replicas of small networks with known truth; nothing is believed before."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import baarda
from baarda.network import State
from baarda.procedures.synthetic import synthetic
from networks import ring

pytestmark = pytest.mark.sampling
REPLICAS = 400
BLOCK_REPLICAS = 200


def truth_of(network):
    """Return the network with error-free observations of its own adjusted state."""
    r = baarda.adjust(network)
    net = r.network
    groups = tuple(replace(g, xy=g.xy - g.misclosures(net, State.of(net))) for g in net.observations)
    points = net.points
    given = np.where(np.isfinite(points.given), points.coordinates, np.nan)
    return replace(net, observations=groups, points=replace(points, given=given))


def disturbed(network, rng):
    """Add normal errors of the stated sigmas to all observations."""
    groups = []
    for g in network.observations:
        e = rng.standard_normal(g.xy.shape)
        e[:, 1] = g.correlations * e[:, 0] + np.sqrt(1 - g.correlations**2) * e[:, 1]
        groups.append(replace(g, xy=g.xy + g.sigmas * e))
    points = network.points
    noise = np.where(points.states == 1, np.nan_to_num(points.sigmas), 0.0) * rng.standard_normal(points.given.shape)
    return replace(network, observations=tuple(groups), points=replace(points, given=points.given + noise))


@pytest.mark.parametrize(
    ("name", "make", "plane"),
    [
        ("weighted control", lambda: ring(images=4, points=10, control=5, noise=0.3, free=("principal_distance", "K1")), "image"),
        ("corrected plane", lambda: ring(images=4, points=10, control=5, noise=0.3, free=("principal_distance",)), "corrected"),
        ("correlated", lambda: ring(images=4, points=10, control=5, noise=0.3, free=(), correlation=0.6), "image"),
        ("free network", lambda: ring(images=4, points=10, noise=0.3, free=()), "image"),
    ],
)
def test_scatter_of_replicas(name, make, plane):
    network = truth_of(make())
    prediction = baarda.adjust(network, residual_plane=plane)
    table = prediction.unknown_table("apriori")
    predicted = table["sigma"]
    values, objective, redundancy = [], [], []
    for child in np.random.SeedSequence(20).spawn(REPLICAS):
        r = baarda.adjust(disturbed(network, np.random.default_rng(child)), residual_plane=plane)
        assert r.status == "converged"
        values.append(r.unknowns["value"])
        objective.append(r.objective)
        redundancy.append(r.redundancy_numbers)
    values = np.array(values)
    angle = np.array([n.endswith(("omega", "phi", "kappa")) for n in table["name"]])
    values[:, angle] = np.remainder(values[:, angle] - values[0, angle] + np.pi, 2 * np.pi) - np.pi
    ratio = (REPLICAS - 1) * values.var(axis=0, ddof=1) / predicted**2
    level = 0.001 / len(predicted)
    low, high = stats.chi2(REPLICAS - 1).ppf([level / 2, 1 - level / 2])
    outside = [f"{n}: {q / (REPLICAS - 1):.3f}" for n, q in zip(table["name"], ratio, strict=True) if not low <= q <= high]
    assert not outside, f"{name}: s^2/sigma^2 outside {low / (REPLICAS - 1):.3f}..{high / (REPLICAS - 1):.3f}: {outside}"
    r = prediction.redundancy
    z = (np.mean(objective) - r) / np.sqrt(2 * r / REPLICAS)
    assert abs(z) < 4  # v'Pv is chi-square with r degrees of freedom
    p = stats.kstest(objective, stats.chi2(r).cdf).pvalue
    assert p > 1e-4


def test_sigmas_of_residuals():
    """Each residual of the replicas scatters as its cofactor says."""
    network = truth_of(ring(images=4, points=8, control=5, noise=0.3, free=("principal_distance",)))
    prediction = baarda.adjust(network)
    v = np.array(
        [baarda.adjust(disturbed(network, np.random.default_rng(child))).residuals for child in np.random.SeedSequence(21).spawn(REPLICAS)]
    )
    ratio = (v**2).sum(axis=0) / prediction.qvv
    level = 0.001 / len(ratio)
    low, high = stats.chi2(REPLICAS).ppf([level / 2, 1 - level / 2])
    assert ((ratio > low) & (ratio < high)).all()


BLOCKS = {
    "ring": lambda: synthetic("ring", images=6, points=40, control=6, noise=0.5, seed=4),
    "aerial": lambda: synthetic("aerial", images=9, points=80, noise=0.5, seed=4),
    "a camera per image": lambda: synthetic("aerial", images=9, points=80, noise=0.5, seed=4, per_image_cameras=True),
    "long tracks": lambda: synthetic("long-tracks", images=8, points=40, noise=0.5, seed=4),
}


@pytest.mark.parametrize("name", list(BLOCKS))
def test_block_solver_on_synthetic_blocks(name):
    """Sigmas of all unknowns, of the joint covariance of an image and a point, and of v'Pv, from truth known beforehand.

    Unlike above the prediction is made at the truth, and every replica starts from there.
    """
    truth = truth_of(BLOCKS[name]().truth)
    prediction = baarda.adjust(truth, solver="block")
    assert prediction.solver_name == "block"
    table = prediction.unknown_table("apriori")
    values, objective = [], []
    for child in np.random.SeedSequence(30).spawn(BLOCK_REPLICAS):
        r = baarda.adjust(disturbed(truth, np.random.default_rng(child)), solver="block")
        assert r.status == "converged"
        values.append(r.unknowns["value"])
        objective.append(r.objective)
    values = np.array(values)
    angle = np.array([n.endswith(("omega", "phi", "kappa")) for n in table["name"]])
    values[:, angle] = np.remainder(values[:, angle] - values[0, angle] + np.pi, 2 * np.pi) - np.pi
    n = BLOCK_REPLICAS
    ratio = values.var(axis=0, ddof=1) / table["sigma"] ** 2
    level = 0.001 / len(ratio)
    low, high = stats.chi2(n - 1).ppf([level / 2, 1 - level / 2]) / (n - 1)
    outside = [f"{name}: {q:.3f}" for name, q in zip(table["name"], ratio, strict=True) if not low <= q <= high]
    assert not outside, f"s^2/sigma^2 outside {low:.3f}..{high:.3f}: {outside}"
    spread = np.sqrt(2.0 / (n - 1) * np.mean(_squared_correlations(prediction)))  # of the mean of all ratios
    assert abs(ratio.mean() - 1.0) < 4 * spread
    r = prediction.redundancy
    assert abs(np.mean(objective) - r) < 4 * np.sqrt(2 * r / n)
    assert stats.kstest(objective, stats.chi2(r).cdf).pvalue > 1e-4


def _squared_correlations(adjusted):
    """Squared correlations of all pairs of unknowns, by which sampled variances are correlated."""
    q = adjusted.cofactors.of(np.arange(adjusted.numbering.count))
    return q**2 / np.outer(np.diag(q), np.diag(q))
