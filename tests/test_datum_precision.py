"""How firmly known values hold a network: against the cofactors of a rigid body written down here, and what the report says of it."""

from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.procedures.synthetic import synthetic
from baarda.procedures.testing import analyse
from baarda.report.sections import verdict
from baarda.report.sections.problems import problems
from networks import ring, with_distances


def on_a_line(sigma, known=4):
    """An aerial block whose control points lie nearly along a line through its middle."""
    made = synthetic("aerial", 9, points=120, control=0, seed=3)
    network, true = made.network, made.truth.points.coordinates
    middle, line = true.mean(axis=0), np.array([0.8, 0.6, 0.0])
    beside = np.linalg.norm(np.cross(true - middle, line), axis=1)
    chosen = np.argsort(beside)[:known]
    roles, given, sigmas = np.array(network.points.roles), np.array(network.points.given), np.array(network.points.sigmas)
    states = np.array(network.points.states)
    roles[chosen], given[chosen], sigmas[chosen], states[chosen] = 1, true[chosen], sigma, 1
    points = replace(network.points, roles=roles, given=given, sigmas=sigmas, states=states)
    return replace(network, points=points), chosen


def of_a_rigid_body(places, sigma):
    """Standard deviations of rotation (largest) and scale of a body of which these places are known alike."""
    x = places - places.mean(axis=0)
    rows = [np.hstack([np.eye(3), -np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]]), [[a], [b], [c]]]) for a, b, c in x]
    j = np.vstack(rows) / sigma
    q = np.linalg.inv(j.T @ j)
    return np.sqrt(np.linalg.eigvalsh(q[3:6, 3:6])[-1]), np.sqrt(q[6, 6])


@pytest.mark.parametrize("sigma", [0.1, 2.0, 20.0])
def test_against_a_rigid_body(sigma):
    network, chosen = on_a_line(sigma)
    a = baarda.adjust(network, iterations=60)
    rotation, scale = of_a_rigid_body(a.network.points.coordinates[chosen], sigma)
    assert a.datum_precision.rotation == pytest.approx(rotation, rel=1e-5)
    assert a.datum_precision.scale == pytest.approx(scale, rel=1e-5)
    x = a.network.points.coordinates[chosen]
    along = np.linalg.svd(x - x.mean(axis=0))[2][0]
    assert abs(a.datum_precision.axis @ along) > 0.99 and np.abs(a.datum_precision.axis).max() == a.datum_precision.axis.max()


def test_what_is_free_has_no_precision():
    assert baarda.adjust(ring()).datum_precision is None
    assert baarda.adjust(with_distances(ring(), [(0, 1)])).datum_precision is None


def test_the_report_tells_what_is_weak():
    firm, weak = (analyse(baarda.adjust(on_a_line(s)[0], iterations=60)) for s in (0.01, 20.0))
    told = {p[1]: p[2] for p in problems(weak)}
    assert not {p[1] for p in problems(firm)} & {"The orientation of the whole network is weak.", "The scale of the whole network is weak."}
    assert "a priori, the network taken as rigid" in told["The orientation of the whole network is weak."]
    unfinished = analyse(baarda.adjust(on_a_line(20.0)[0], iterations=2))
    assert not unfinished.converged
    assert "The orientation of the whole network is weak." in {p[1] for p in problems(unfinished)}
    assert [s.subject for s in verdict.sentences(unfinished)] == ["Convergence", "Datum"]
    firm = analyse(baarda.adjust(on_a_line(0.01)[0], iterations=2))
    assert [s.subject for s in verdict.sentences(firm)] == ["Convergence"]
