"""Variance components: the fixed point, recovery of true variances, what cannot be estimated, and traces against dense matrices."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

import baarda
from baarda.cli import app
from baarda.errors import UsageError
from baarda.formats.project import write
from baarda.hypotheses.variance_components import equal_variance_components, variance_component
from baarda.procedures import variance_components as vc
from baarda.procedures.synthetic import ring
from baarda.procedures.variance_components import estimate_components, forms_and_traces, group_rows
from networks import ring as small_ring
from networks import with_distances


def mixed(seed=0, image=2.0, control=0.5, distances=3.0):
    """A ring with control and distances whose stated sigmas are the true ones times these factors."""
    rng = np.random.default_rng(seed)
    block = ring(8, points=40, control=14, seed=seed, control_sigma=0.002)
    network, truth = block.network, block.truth
    pairs = rng.choice(40, (40, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    network = with_distances(replace(network, points=replace(network.points, coordinates=truth.points.coordinates)), pairs, 0.001)
    bars = network.observations[1]
    bars = replace(bars, values=bars.values + 0.001 * rng.standard_normal(len(bars)), sigmas=bars.sigmas * distances)
    group = network.observations[0]
    points = replace(network.points, sigmas=network.points.sigmas * control)
    return replace(network, points=points, observations=(replace(group, sigmas=group.sigmas * image), bars))


def test_true_variances_are_recovered_and_residuals_then_fit():
    network = mixed()
    found, scaled = estimate_components(network)
    assert found.converged
    for c, true in zip(found.components, (1 / 2.0, 1 / 3.0, 1 / 0.5), strict=True):
        root = np.sqrt(c.factor)
        assert c.outcome == "estimated"
        assert abs(root - true) < 4 * c.deviation / (2 * root), c
    a = baarda.adjust(scaled)
    rows, names = group_rows(a)
    forms, traces = forms_and_traces(a, rows, len(names))
    assert np.allclose(forms / traces.sum(axis=1), 1.0, atol=1e-3)
    assert abs(a.variance_factor - 1.0) < 1e-3
    assert [t.name for t in found.tests] == ["variance_component", "equal_variance_components"]
    assert found.tests[1].rejected


def test_stated_variances_that_are_right_stay():
    found, _ = estimate_components(mixed(3, 1.0, 1.0, 1.0))
    assert all(abs(c.factor - 1.0) < 4 * c.deviation for c in found.components)
    assert not found.tests[1].rejected
    assert not np.any(found.tests[0].rejected)


def test_result_does_not_depend_on_the_stated_variances():
    one, two = (estimate_components(mixed(0, *f))[0] for f in ((2.0, 0.5, 3.0), (1.0, 1.0, 1.0)))
    assert np.allclose([c.after for c in one.components], [c.after for c in two.components], rtol=1e-3)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_traces_equal_those_of_dense_matrices(correlation, monkeypatch):
    network = with_distances(small_ring(images=5, points=16, control=6, correlation=correlation), [(i, i + 7) for i in range(8)])
    a = baarda.adjust(network, camera=())
    white = a.lin.design.toarray() if hasattr(a.lin.design, "toarray") else np.asarray(a.lin.design)
    r = np.eye(a.count) - white @ np.linalg.pinv(white)
    rows, names = group_rows(a)
    dense = np.array([[(r[np.ix_(rows == i, rows == j)] ** 2).sum() for j in range(len(names))] for i in range(len(names))])
    forms, traces = forms_and_traces(a, rows, len(names))
    assert np.allclose(traces, dense, atol=1e-8)
    assert np.allclose(forms.sum(), a.objective)
    monkeypatch.setattr(vc, "EXACT", 10)
    monkeypatch.setattr(vc, "PROBES", 2000)
    assert np.allclose(forms_and_traces(a, rows, len(names))[1], dense, rtol=0.1, atol=0.3)
    assert np.allclose(forms_and_traces(a, rows, len(names))[1].sum(axis=1), dense.sum(axis=1))


def test_one_component_for_each_camera():
    block = ring(6, points=60, per_image_cameras=True, seed=2)
    group = block.network.observations[0]
    truth = block.truth.observations[0].xy
    noisy = np.where((group.images == 2)[:, None], truth + 3 * (group.xy - truth), group.xy)
    found, _ = estimate_components(replace(block.network, observations=(replace(group, xy=noisy),)), by="camera")
    factors = {c.name: np.sqrt(c.factor) for c in found.components}
    assert 2.3 < factors["image points of camera 3"] < 3.7
    assert all(0.7 < f < 1.4 for n, f in factors.items() if n.startswith("image points") and not n.endswith(" 3"))


def test_groups_that_cannot_be_estimated_are_said():
    found, _ = estimate_components(ring(6, points=30, control=0, seed=4).network)
    c = found.components[1]
    assert c.outcome == "too little redundancy"
    assert c.deviation is None
    assert c.factor == 1.0
    assert any("too little to estimate" in n for n in found.notes)


def test_a_variance_that_vanishes_is_said():
    network = ring(8, points=40, control=14, seed=1, control_sigma=0.0005).network
    weak = replace(network, points=replace(network.points, sigmas=100.0 * network.points.sigmas))
    given = np.where(np.isfinite(network.points.given), baarda.adjust(weak).network.points.coordinates, np.nan)  # no residuals are left
    found, scaled = estimate_components(replace(network, points=replace(network.points, given=given)))
    c = found.components[1]
    assert c.outcome == "not positive"
    assert c.factor == 1.0
    assert np.array_equal(scaled.points.sigmas, network.points.sigmas, equal_nan=True)
    assert any("no positive variance" in n for n in found.notes)


def test_limit_of_iterations_is_said():
    found, _ = estimate_components(mixed(), iterations=1)
    assert not found.converged
    assert "not settled after 1 iterations" in found.notes[-1]


def test_image_sigma_is_the_stated_one():
    plain, stated = (estimate_components(mixed(), **s)[0] for s in ({}, {"image_sigma": 4.0}))
    assert stated.components[0].before == 4.0
    assert np.isclose(stated.components[0].after, plain.components[0].after, rtol=1e-3)


def test_what_makes_no_sense():
    with pytest.raises(UsageError, match="at least two groups"):
        estimate_components(small_ring())
    with pytest.raises(UsageError, match="by 'group' or 'camera'"):
        estimate_components(mixed(), by="image")
    with pytest.raises(UsageError, match="law of errors"):
        estimate_components(mixed(), robust="student")


def test_plain_numbers():
    # One group: the chi-square test of the variance factor.
    t = variance_component([60.0], [[43.0]], ["all"])
    assert np.isclose(float(np.asarray(t.p_value)[0]), 2 * stats.chi2(43).sf(60.0))
    # Two independent groups: near Bartlett's test.
    q, r = np.array([60.0, 30.0]), np.array([40.0, 50.0])
    ours = equal_variance_components(q, np.diag(r), ["a", "b"])
    bartlett = baarda.hypotheses.bartlett(q / r, r)
    assert np.isclose(ours.p_value, bartlett.p_value, rtol=0.1)
    with pytest.raises(UsageError):
        equal_variance_components([1.0], [[3.0]], ["a"])
    with pytest.raises(UsageError):
        variance_component([1.0, 2.0], [[3.0]], ["a", "b"])
    assert np.isnan(np.asarray(variance_component([0.0, 9.0], [[0.0, 0.0], [0.0, 9.0]], ["a", "b"]).p_value)[0])


def test_command_adjusts_with_the_estimated_variances(tmp_path, monkeypatch):
    monkeypatch.setattr("baarda.procedures.testing.study_adjustment", lambda *_: None)  # the laws of errors take their time
    write(mixed(), tmp_path / "p")
    done = CliRunner().invoke(app, ["adjust", str(tmp_path / "p"), "--variance-components", "--out", str(tmp_path / "o"), "--quiet"])
    assert done.exit_code == 0, done.output
    document = json.loads((tmp_path / "o" / "result.json").read_text())
    assert abs(document["sigma0"]["aposteriori"] - 1.0) < 1e-3
    assert [c["name"] for c in document["variance_components"]["components"]] == ["image points", "distances", "control points"]
    assert "Variance components" in (tmp_path / "o" / "report.html").read_text()
