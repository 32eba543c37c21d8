"""Monte Carlo: sigmas of the block adjustment of independent models, and of the bundle at the end of the chain."""

from dataclasses import replace

import numpy as np
import pytest

from baarda import adjust
from baarda.network import TIE, State
from baarda.observations import Models
from baarda.procedures.independent_models import adjust_chain, block_of_models, simulate_strip
from baarda.procedures.planimetry_height import adjust_planimetry_height
from baarda.procedures.planning import plan
from baarda.procedures.proof import prove
from baarda.procedures.simulation import errors_of, simulate, variances_of

pytestmark = pytest.mark.sampling


def test_unknowns_of_a_block_of_models():
    """Replicas of the planned block: sampled variances of all points and transformations are the predicted ones."""
    made = simulate_strip(5, control_sigma=0.05)
    a = adjust(block_of_models(made.models, made.control, 2e-5))
    planned = plan(a.network)
    found = simulate(planned, 150, seed=3, jobs=1)
    assert prove(found).holds
    assert abs(found.batch.vpv.mean() - planned.adjustment.redundancy) < 4.0 * np.sqrt(2.0 * planned.adjustment.redundancy / found.count)


def test_points_of_the_chain():
    """Model coordinates have lost the y parallaxes of their models: sigmas of the bundle are not exceeded, and v'Pv stays below r."""
    ratio, objective = [], []
    for k in range(60):
        made = simulate_strip(5, noise=0.008, seed=1000 + k)
        a = adjust_chain(made.models, made.control, made.principal_distance, 0.008).adjustment
        tie = np.flatnonzero(a.network.points.roles == TIE)
        e = np.array([a.network.points.coordinates[i] - made.truth[a.network.points.labels[i]] for i in tie])
        ratio.append(np.mean(e**2 / np.einsum("nii->ni", a.point_cofactors[tie])))
        objective.append(a.variance_factor)
    assert np.mean(ratio) < 1.0 + 4.0 * np.std(ratio) / np.sqrt(60)
    assert np.mean(objective) < 1.0


def test_errors_of_rotations_are_increments():
    """The departure of transformations is in the increments that the covariance speaks of."""
    made = simulate_strip(2)
    a = adjust(block_of_models(made.models, made.control, 2e-5))
    group = a.network.declared[0]
    assert isinstance(group, Models)
    step = np.tile([1.0, -2.0, 0.5, 1e-3, -2e-3, 3e-3, 1e-6], 2)
    assert group.moved(step).departure(group) == pytest.approx(step, rel=1e-6, abs=1e-12)
    assert errors_of(State.of(a.network), a) == pytest.approx(0.0, abs=1e-12)
    assert (variances_of(a) > 0.0).all()


def test_points_of_the_planimetry_height_adjustment():
    """Predicted sigmas of plan and height cover the sampled errors: what levelling neglects is of second order."""
    plan, height, objective = [], [], []
    for k in range(60):
        made = simulate_strip(5, seed=1)
        rng = np.random.default_rng(3000 + k)
        given = [replace(m, points=_spoiled(m.points, rng), centres=_spoiled(m.centres, rng)) for m in made.models]
        found = adjust_planimetry_height(block_of_models(given, made.control, 2e-5))
        for half, axes, out in ((found.plan, [0, 1], plan), (found.height, [2], height)):
            p = half.network.points
            tie = [i for i, label in enumerate(p.labels) if p.roles[i] == TIE and not label.startswith("perspective")]
            e = np.array([p.coordinates[i] - made.truth[p.labels[i]] for i in tie])[:, axes]
            q = half.point_cofactors[tie][:, axes][:, :, axes]
            out.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(q), e).mean() / len(axes))
        objective.append((found.plan.objective + found.height.objective) / found.redundancy)
    for ratio in (plan, height, objective):
        assert abs(np.mean(ratio) - 1.0) < 4.0 * np.std(ratio, ddof=1) / np.sqrt(60)


def _spoiled(points, rng):
    return {k: x + 2e-5 * rng.standard_normal(3) for k, x in points.items()}
