"""Many sets at once: the 19 grid sets of Maarek & Konecny as a workflow."""

from dataclasses import replace

import numpy as np
import pytest

from baarda import adjust
from baarda.errors import UsageError
from baarda.papers.maarek_konecny_study import SETS, elementary_errors, grid_network
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.multi_set_resection import adjust_sets


def sets(sigmas, seed=4):
    """10 sets of 9 and 9 sets of 25 grid points; a factor for the errors of each set."""
    rng = np.random.default_rng(seed)
    out = []
    for name, number, side in SETS:
        for k in range(number):
            errors = sigmas[len(out)] * elementary_errors(2 * side * side, np.inf, 8.0, rng)
            out.append(grid_network(side, f"{name}, set {k + 1}", rng, errors, 8.0))
    return out


@pytest.fixture(scope="module")
def made():
    return adjust_sets(sets(np.ones(19)))


def test_counts_are_those_of_the_paper(made):
    v = made.residuals
    assert len(v.labels) == 19
    assert len(v.residuals) == 630
    assert v.redundancy == 516
    assert v.redundancies.tolist() == [12] * 10 + [44] * 9
    assert v.shares.sum() == pytest.approx(516, rel=1e-9)
    for k, a in enumerate(made.adjustments):
        assert v.variances[k] == pytest.approx(64.0 * a.variance_factor, rel=1e-9)


def test_projectors_lead_errors_to_residuals(made):
    """-R e of the true errors are the residuals, but for the curvature of the model."""
    v = made.residuals
    for k in (0, 12):
        r = v.projectors[k]
        assert r @ r == pytest.approx(r, abs=1e-9)
    e = np.random.default_rng(1).standard_normal((630, 5))
    u = v.residuals_of(e)
    assert (np.sum(u * u, axis=0) / v.redundancy).mean() == pytest.approx(1.0, abs=0.2)


def test_homogeneous_sets(made):
    assert not made.residuals.homogeneity(0.001).rejected
    table = made.residuals.against_pooled()
    # theory §1.2: two-sided 5 % limits of chi-square
    assert table["lower"][0] == pytest.approx(4.40, abs=6e-3)
    assert table["upper"][0] == pytest.approx(23.34, abs=6e-3)
    assert table["lower"][18] == pytest.approx(27.57, abs=6e-3)
    assert table["upper"][18] == pytest.approx(64.20, abs=6e-3)
    assert table["rejected"].sum() <= 4


def test_a_set_of_another_accuracy_is_found():
    factors = np.ones(19)
    factors[14] = 2.0
    v = adjust_sets(sets(factors)).residuals
    assert v.homogeneity(0.001).rejected
    table = v.against_pooled(0.001)
    assert table["set"][table["rejected"]].tolist() == ["25 points, set 5"]


def test_pooled_study(made):
    found = made.residuals.study(8.0, StudyOptions(laws=("normal", "lineo"), replicas=99))
    assert found.kind == "standardised"
    assert found.redundancy == pytest.approx(516, rel=1e-9)
    assert found.sigma0 == pytest.approx(made.residuals.sigma0 / 8.0, rel=1e-9)
    assert found.groups.test("bartlett").statistic == pytest.approx(made.residuals.homogeneity().statistic, rel=1e-6)
    table = made.residuals.table(8.0)
    assert len(table["residual"]) == 630


def test_sets_that_cannot_be_pooled():
    one, other = sets(np.ones(19))[:2]
    with pytest.raises(UsageError, match="there are no sets"):
        adjust_sets([])
    with pytest.raises(UsageError, match="two sets are called '9 points, set 1'"):
        adjust_sets([one, one])
    group = other.observations[0]
    heavier = replace(other, observations=(replace(group, sigmas=2.0 * group.sigmas),))
    with pytest.raises(UsageError, match="different a-priori sigmas"):
        adjust_sets([one, heavier])
    uneven = np.array(group.sigmas)
    uneven[0] *= 2.0
    with pytest.raises(UsageError, match="9 points, set 2: only observations of equal"):
        adjust_sets([one, replace(other, observations=(replace(group, sigmas=uneven),))])
    with pytest.raises(Exception, match="set 9 points, set 2: "):
        adjust_sets([one, replace(other, observations=(group.selected(np.arange(2)),))])
    assert adjust(one).redundancy == 12
