"""Monte Carlo: sigmas of radar unknowns and intersected points, and how often the strategy deletes a term that is truly zero."""

import functools
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from scipy import stats

from baarda import adjust
from baarda.cameras import FIXED
from baarda.network import CONTROL
from baarda.observations import Tracks
from baarda.papers.wu import deletion_rate
from baarda.procedures.camera_selection import select_parameters
from baarda.procedures.criteria import falls_below
from baarda.procedures.radar_simulation import DEVIATIONS, LENGTH, PIXEL, SPEED, planimetry, simulate_radar

pytestmark = pytest.mark.sampling
FINE = (PIXEL / SPEED / 4.0, 0.25)  # so small that the model is linear within its sigmas


@dataclass(frozen=True)
class Restricted(Tracks):
    """Tracks of which one parameter only is a candidate."""

    only: str = ""

    def removable(self):
        return np.array([name == self.only for node in range(len(self.labels)) for name in self.parameters_of(node)])


def restricted(group, name):
    return Restricted(**{f.name: getattr(group, f.name) for f in fields(group)}, only=name)


def without(made, names):
    """The network of a scenario with some terms fixed at zero, started at the truth."""
    group = made.tracks
    states, values = np.array(made.network.declared[0].states), np.array(group.values)
    for name in names:
        states[group.named(0, name)], values[group.named(0, name)] = FIXED, 0.0
    return replace(made.network, declared=(replace(group, states=states, values=values),))


def test_unknowns_and_objective():
    """Standardised errors of all 17 unknowns have variance 1; v'Pv follows chi-square."""
    replicas, z, chi, omega = 250, [], [], []
    for k in range(replicas):
        made = simulate_radar(k, noise=FINE)
        a = adjust(without(made, ()))
        assert a.status == "converged"
        names = list(a.unknowns["name"])
        true = dict(zip((f"track 1: {n}" for n in made.tracks.parameters[0]), made.tracks.values, strict=True))
        e = a.unknowns["value"] - np.array([true[n] for n in names])
        c = a.covariance(names, sigma="apriori")
        z.append(e / np.sqrt(np.diag(c)))
        chi.append(e @ np.linalg.solve(c, e))
        omega.append(a.objective)
    z = np.array(z)
    # each of 17 mean squares, and the whole
    assert np.abs((z**2).mean(axis=0) - 1.0).max() < 4.5 * np.sqrt(2.0 / replicas)
    assert np.abs(z.mean(axis=0)).max() < 4.5 / np.sqrt(replicas)
    assert stats.kstest(chi, stats.chi2(17).cdf).pvalue > 1e-4
    assert stats.kstest(omega, stats.chi2(53).cdf).pvalue > 1e-4


def test_stereo_points():
    """Confidence ellipsoids of points intersected from two tracks cover them as often as they say."""
    chi = []
    for k in range(60):
        made = simulate_radar(k, noise=FINE, order=2, directions=(np.pi, 1.5), sides=(1, -1), ties=8, deviations=np.zeros((3, 3)))
        started = replace(made.network.points, coordinates=made.truth.points.coordinates)
        a = adjust(replace(made.network, declared=made.truth.declared, points=started))
        tie = np.flatnonzero(a.network.points.roles != CONTROL)
        e = (a.network.points.coordinates - made.truth.points.coordinates)[tie]
        chi.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(a.point_cofactors[tie]), e))
    covered = (np.concatenate(chi) <= stats.chi2(3).ppf(0.95)).reshape(60, -1).mean(axis=1)
    assert abs(covered.mean() - 0.95) < 4.0 * covered.std(ddof=1) / np.sqrt(60)


def test_planimetric_intervals():
    """Withheld points with given height: squared errors are as large as predicted (the a-posteriori covariance, on average)."""
    found = [planimetry(without(simulate_radar(k, noise=FINE), ()), turns=1) for k in range(150)]
    ratio = np.array([(p.rms / p.predicted) ** 2 for p in found])
    assert np.abs(ratio.mean(axis=0) - 1.0).max() < 4.0 * (ratio.std(axis=0, ddof=1) / np.sqrt(150)).max()


def test_rate_of_deletion():
    """One candidate that is truly zero: deleted at the rate of the most willing of the three criteria, 0.774 at r = 43 and alike at 54.

    Theory §2.2: F proposes, and a deletion stands while at least one of (9a) to (9c) falls.
    """
    replicas, deleted = 160, 0
    r = 54  # 70 observations, 16 unknowns: Z4 is the candidate, Z3 is absent
    limit = max(falls_below(name, 70, r) for name in ("variance_factor", "criterion_b", "aic"))
    rate = deletion_rate(limit, r)
    for k in range(replicas):
        network = without(simulate_radar(10_000 + k, noise=FINE), ("Z3",))
        found, _ = select_parameters(replace(network, declared=(restricted(network.declared[0], "Z4"),)))
        deleted += bool(found.deleted)
    assert abs(deleted / replicas - rate) < 4.0 * np.sqrt(rate * (1.0 - rate) / replicas)


def test_points_of_one_spaceborne_track():
    """Range, Doppler and a height above the ellipsoid: squared errors of the points are as large as predicted."""
    from test_ellipsoid_heights import block

    ratio = []
    for k in range(60):
        network, true, _ = block(500 + k)
        a = adjust(network)
        tie = np.flatnonzero(a.network.points.roles != CONTROL)
        e = (a.network.points.coordinates - true)[tie]
        ratio.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(a.point_cofactors[tie]), e).mean() / 3.0)
    assert abs(np.mean(ratio) - 1.0) < 4.0 * np.std(ratio, ddof=1) / np.sqrt(60)


def test_rate_of_keeping():
    """One candidate whose true value is three of its standard deviations: kept as often as the noncentral F law says (0.95)."""
    end, replicas, kept, r = 0.5 * LENGTH / SPEED, 100, 0, 54
    still = np.array(DEVIATIONS)
    planned = adjust(without(simulate_radar(1, noise=FINE), ("Z3",)))
    sigma = float(np.sqrt(planned.covariance("track 1: Z4", sigma="apriori")))
    still[2, 2] = 3.0 * sigma * end**4
    limit = max(falls_below(name, 70, r) for name in ("variance_factor", "criterion_b", "aic"))
    rate = float(stats.ncf(1, r, 9.0).sf(limit))
    for k in range(replicas):
        network = without(simulate_radar(20_000 + k, noise=FINE, deviations=still), ("Z3",))
        found, _ = select_parameters(replace(network, declared=(restricted(network.declared[0], "Z4"),)))
        kept += not found.deleted
    assert 0.9 < rate < 0.99
    assert abs(kept / replicas - rate) < 4.0 * np.sqrt(rate * (1.0 - rate) / replicas)


@functools.cache
def deletion_limit(n, r):
    """F below which the strategy deletes: the F test proposes, the most willing criterion decides."""
    willing = max(falls_below(name, n, r) for name in ("variance_factor", "criterion_b", "aic"))
    return min(float(stats.f.isf(0.05, 1, r)), willing)


def strategy(x, q, omega, n, r):
    """The strategy on a linear model: estimates, their cofactors, v'Pv; return which candidates are deleted."""
    left, gone = list(range(len(x))), []
    x, q = x.copy(), q.copy()
    while left:
        f = x[left] ** 2 / (np.diag(q)[left] * omega / r)
        i = left[int(np.argmin(f))]
        if f.min() > deletion_limit(n, r):
            break
        omega += x[i] ** 2 / q[i, i]
        x, q = x - q[:, i] / q[i, i] * x[i], q - np.outer(q[:, i], q[:, i]) / q[i, i]
        left.remove(i)
        gone.append(i)
        r += 1
    return tuple(sorted(gone))


@dataclass(frozen=True)
class RestrictedTwo(Tracks):
    """Tracks whose candidates are the two altitude terms that are truly zero."""

    def removable(self):
        return np.array([name in ("Z3", "Z4") for node in range(len(self.labels)) for name in self.parameters_of(node)])


def test_both_true_zeros_are_removed_at_the_rate_of_the_linear_model():
    """c3 = c4 = 0: no term, one, or both are deleted as often as the strategy deletes them from normal estimates of the same cofactors."""
    replicas = 100
    a = adjust(without(simulate_radar(1, noise=FINE), ()))
    q = a.covariance(["track 1: Z3", "track 1: Z4"], sigma="apriori")
    rng = np.random.default_rng(5)
    root, rates = np.linalg.cholesky(q), {}
    for _ in range(20_000):
        gone = strategy(root @ rng.standard_normal(2), q, rng.chisquare(53), 70, 53)
        rates[gone] = rates.get(gone, 0.0) + 1.0 / 20_000
    counts = dict.fromkeys(rates, 0)
    for k in range(replicas):
        network = without(simulate_radar(30_000 + k, noise=FINE), ())
        group = network.declared[0]
        two = RestrictedTwo(**{f.name: getattr(group, f.name) for f in fields(group)})
        found, _ = select_parameters(replace(network, declared=(two,)))
        gone = tuple(sorted(("Z3", "Z4").index(name.split(": ")[1]) for name in found.deleted))
        counts[gone] = counts.get(gone, 0) + 1
    for gone, rate in rates.items():
        assert abs(counts[gone] / replicas - rate) < 4.0 * np.sqrt(rate * (1.0 - rate) / replicas), (gone, counts, rates)
