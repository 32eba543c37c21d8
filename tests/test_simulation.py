"""Planning and replicas: predictions without observed values, the same replicas for any number of processes, verdicts that can fail."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.cli import app
from baarda.errors import RedundancyNotPositive, UsageError
from baarda.formats.project import write
from baarda.hypotheses.levels import Options
from baarda.network import State
from baarda.observations import ImagePoints
from baarda.procedures.planning import error_free, plan
from baarda.procedures.proof import prove, rate_proof, sigma_proof
from baarda.procedures.simulation import Experiment, errors_of, groups_of, simulate, variances_of
from baarda.procedures.synthetic import aerial, ring
from baarda.report.simulation_report import result_json, verdict, write_folder
from networks import ring as small_ring
from networks import with_distances


@pytest.fixture(scope="module")
def planned():
    return plan(ring(5, points=14, checks=3, seed=2).network)


def test_observed_values_do_not_matter_when_planning():
    block = ring(5, points=14, perturbation=0.0, seed=2)
    group = block.network.observations[0]
    empty = replace(block.network, observations=(replace(group, xy=np.zeros_like(group.xy)),))
    from_start = plan(empty)
    assert from_start.source == "start"
    assert "do not fit" in from_start.reason or "converge" in from_start.reason or "could not" in from_start.reason
    same = plan(block.truth, truth="start")
    assert np.array_equal(variances_of(from_start.adjustment), variances_of(same.adjustment))


def test_prediction_equals_what_the_measured_network_says_a_priori():
    network = ring(5, points=14, seed=2).network
    measured, made = baarda.adjust(network), plan(network)
    assert np.allclose(made.adjustment.redundancy_numbers, measured.redundancy_numbers, atol=1e-9)
    assert np.allclose(variances_of(made.adjustment), variances_of(measured), rtol=1e-6)
    expected = baarda.procedures.testing.analyse(measured, Options()).observations["mdb"]
    assert np.allclose(made.mdb, expected, rtol=1e-6)


@pytest.mark.parametrize("plane", ["image", "corrected"])
def test_computed_observations_have_no_residuals(plane):
    network = with_distances(small_ring(control=4, model="brown", correlation=0.4), [(0, 5), (2, 7)])
    network = replace(network, observations=(replace(network.observations[0], residual_plane=plane), *network.observations[1:]))
    made = error_free(network)
    for group in made.observations:
        seen = replace(group, residual_plane="image") if isinstance(group, ImagePoints) else group
        assert abs(seen.misclosures(made, State.of(made))).max() < 1e-8


def test_start_values_must_be_complete():
    network = small_ring(start=False)
    group = network.observations[0]
    nothing = replace(network, observations=(replace(group, xy=np.zeros_like(group.xy)),))
    with pytest.raises(UsageError, match="start values are not complete: 6 of 6 images and 24 of 24 points"):
        plan(nothing)
    with pytest.raises(UsageError, match="law of errors"):
        plan(network, robust="student")
    with pytest.raises(UsageError, match="the truth is"):
        plan(network, truth="guess")


def test_too_small_a_network_cannot_be_planned():
    with pytest.raises(RedundancyNotPositive):
        plan(small_ring(images=2, points=4), truth="start")


def test_errors_follow_their_covariances():
    network = small_ring(images=4, points=8, control=3, correlation=0.7)
    experiment = Experiment(plan(network), {}, 0)
    drawn = np.array([experiment.errors(np.random.default_rng(k)) for k in range(2000)])
    a = experiment.planned.adjustment
    assert np.allclose(drawn.std(axis=0) / a.sigmas, 1.0, atol=0.08)
    rho = [np.corrcoef(drawn[:, i], drawn[:, i + 1])[0, 1] for i in range(0, 60, 2)]
    assert np.allclose(rho, 0.7, atol=0.06)


def test_errors_go_into_every_kind_of_observation():
    network = with_distances(small_ring(images=4, points=8, control=3), [(0, 5)])
    experiment = Experiment(plan(network), {}, 0)
    a = experiment.planned.adjustment
    made = experiment.network(np.arange(1.0, a.count + 1) * 1e-6, np.random.default_rng(0))
    again = baarda.adjust(made, iterations=1)
    observed = np.concatenate([g.observed().ravel() for g in again.groups]) - np.concatenate([g.observed().ravel() for g in a.groups])
    control = a.offsets[[g.name for g in a.groups].index("control points")]
    observed[control:] -= np.tile(again.shift - a.shift, 3)  # these rows are reduced to the centroid
    assert np.allclose(observed, np.arange(1.0, a.count + 1) * 1e-6, atol=1e-9)


def test_errors_of_unknowns_are_increments_from_the_truth():
    a = baarda.adjust(small_ring(images=4, points=8, control=3))
    step = 1e-3 * np.random.default_rng(0).standard_normal(a.numbering.count)
    moved = State.of(a.network).moved(a.numbering, step)
    result = replace(a, network=moved.write_to(a.network))
    assert np.allclose(errors_of(State.of(a.network), result), step, atol=1e-12)


def test_groups_name_every_unknown_once(planned):
    kinds, names = groups_of(planned.adjustment)
    assert len(set(names)) == len(names)
    assert set(kinds) == set(range(len(names)))
    assert names[0] == "camera 1: principal_distance"


def test_replicas_do_not_depend_on_the_number_of_processes(planned):
    one, two = (simulate(planned, 6, seed=5, jobs=jobs).batch for jobs in (1, 2))
    for name in ("vpv", "sums", "squares", "groups", "residuals", "tested", "rejected", "biased"):
        assert np.array_equal(getattr(one, name), getattr(two, name), equal_nan=True), name
    assert one.names == two.names
    assert {"global_variance_factor", "data_snooping", "data_snooping (a priori)", "check_points", "control_points"} <= set(one.names)


def test_more_replicas_begin_like_fewer(planned):
    few, more = (simulate(planned, n, seed=5).batch.vpv for n in (4, 9))
    assert np.array_equal(few, more[:4])


def test_wrong_predictions_are_found(planned):
    """Errors half as large again as stated: sigmas, v'Pv, the global test and the power disagree."""
    made = simulate(planned, 24, seed=1)
    b = made.batch
    wrong = replace(made, batch=replace(b, vpv=2.25 * b.vpv, squares=2.25 * b.squares, sums=1.5 * b.sums, groups=2.25 * b.groups))
    assert prove(made).holds
    bad = prove(wrong)
    assert not bad.holds
    assert not bad.objective.holds
    assert sum(not s.holds for s in bad.sigmas) > len(bad.sigmas) / 3
    assert any("beyond chance" in text for text in verdict(planned, bad))


def test_rates_and_ratios_on_plain_numbers():
    rng = np.random.default_rng(4)
    good = rate_proof("t", (rng.random(2000) < 0.05).astype(float), np.ones(2000), 0.05)
    assert good.holds
    assert good.low < 0.05 < good.high
    assert not rate_proof("t", (rng.random(2000) < 0.09).astype(float), np.ones(2000), 0.05).holds
    assert not rate_proof("t", np.zeros(20), np.ones(20), 0.05).told
    assert not sigma_proof("x", 1.5 * rng.standard_normal(500) ** 2, 1, 1.0).holds
    common = rng.standard_normal((500, 1)) + np.zeros((1, 30))  # thirty unknowns that are one: no more information than one
    assert sigma_proof("x", (common**2).mean(axis=1), 30, 1.0).holds
    low_high = sigma_proof("x", (common**2).mean(axis=1), 30, 1.0)
    alone = sigma_proof("x", common[:, 0] ** 2, 1, 1.0)
    assert abs((low_high.high - low_high.low) / (alone.high - alone.low) - 1) < 0.25


def test_numbers_that_make_no_sense(planned):
    for options in ({"replicas": 1}, {"replicas": 4, "jobs": 0}, {"replicas": 4, "seed": -1}):
        with pytest.raises(UsageError):
            simulate(planned, **options)


def test_folder_and_json(planned, tmp_path):
    proof = prove(simulate(planned, 4, seed=5))
    first, second = write_folder(planned, proof, tmp_path / "a"), write_folder(planned, proof, tmp_path / "b")
    for name in ("result.json", "tables/sampled.csv", "tables/sizes.csv", "tables/observations.csv", "report.html"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    document = json.loads((first / "result.json").read_text())
    assert document["schema"] == "baarda.simulation/1"
    assert document["proof"]["with_result"] == 4
    assert document == result_json(planned, proof)
    assert "NaN" not in (first / "result.json").read_text()
    assert baarda.read(first / "project").points.labels == planned.adjustment.network.points.labels
    assert result_json(planned)["proof"] is None


def test_command_line(tmp_path):
    run = CliRunner().invoke
    made = run(app, ["simulate", "ring", "--images", "5", "--points", "12", "--checks", "3", "--out", str(tmp_path / "p")])
    assert made.exit_code == 0, made.output
    done = run(app, ["simulate", str(tmp_path / "p"), "--replicas", "4", "--out", str(tmp_path / "o"), "--tables", "csv"])
    assert done.exit_code == 0, done.output
    assert "sampled / predicted standard deviations" in done.output
    assert (tmp_path / "o" / "report.html").is_file()
    told = run(app, ["simulate", str(tmp_path / "p"), "--json", "--quiet"])
    assert json.loads(told.stdout)["prediction"]["points"]["count"] == 12
    assert run(app, ["simulate", "ring"]).exit_code == 2
    assert run(app, ["simulate", str(tmp_path / "none")]).exit_code == 2
    assert run(app, ["simulate", "ring", "--out", str(tmp_path / "p")]).exit_code == 4


def test_aerial_project_reads_back(tmp_path):
    block = aerial(5, points=40, seed=9, checks=3)
    write(block.network, tmp_path / "p")
    again = baarda.read(tmp_path / "p")
    assert np.array_equal(again.observations[0].xy, block.network.observations[0].xy)


def test_a_test_that_misses_its_level_is_named(planned):
    """The sentence counts the tests that hold among all that were told, and names the others."""
    proof = prove(simulate(planned, 8, seed=4))
    told = next(p for p in proof.sizes if p.name == "data_snooping (a priori)")
    good = replace(told, name="good", z=0.5)
    bad = replace(told, name="bad", rate=0.3, expected=0.1, z=9.0)
    from baarda.report.simulation_verdict import sentences

    text = next(s.text for s in sentences(planned, replace(proof, sizes=(good, bad))) if s.subject == "Sizes of tests")
    assert text == "1 of 2 tests of true hypotheses reject as often as their level says; not so: bad (30 % instead of 10 %)."
