"""Monte Carlo: sigmas of radar unknowns and intersected points, and how often the strategy deletes a term that is truly zero."""

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
from baarda.procedures.radar_simulation import PIXEL, SPEED, planimetry, simulate_radar

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
