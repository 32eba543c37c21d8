"""What is told about networks of directions and distances: units are never mixed, heights that are fixed are called so, epochs compare."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.cli import app
from baarda.formats import read
from baarda.hypotheses.levels import Options
from baarda.procedures.comparison import compare, epoch
from baarda.procedures.planning import error_free, plan, with_values
from baarda.procedures.proof import prove
from baarda.procedures.simulation import simulate
from baarda.procedures.testing import analyse
from baarda.report.comparison_report import result_json, tables, verdict
from baarda.report.sections.verdict import sentences
from baarda.report.simulation_verdict import sentences as planned_sentences


@pytest.fixture(scope="module")
def folder(data):
    return data("gama_networks")


@pytest.fixture(scope="module")
def local(folder):
    return read(folder / "gama-local.gkf")


def said(found, subject):
    return next(s.text for s in found if s.subject == subject)


def test_detectable_biases_are_told_by_unit(local):
    found = sentences(analyse(baarda.adjust(local), Options(replicas=99)))
    text = said(found, "Reliability")
    assert "rad (46 observations)" in text
    assert "m (23 observations)" in text
    assert " / fixed " in said(found, "Precision")


def test_uncontrolled_observations_disturb_nothing(folder):
    """Four observations of this network are controlled by no other: they have no w, and nothing warns (warnings are errors here)."""
    analysis = analyse(baarda.adjust(read(folder / "azimuth-angle.gkf")), Options(replicas=99))
    assert np.isnan(analysis.w).sum() == 4
    assert "4 observations are controlled by no other" in said(sentences(analysis), "Reliability")
    assert analysis.study is not None
    assert analysis.study.critical is not None


def test_levelling_tells_its_heights_alone(folder):
    found = sentences(analyse(baarda.adjust(read(folder / "mikhail-7.4.gkf")), Options(replicas=99)))
    assert "fixed / fixed / 0.18 m" in said(found, "Precision")


def test_a_plan_without_images_has_its_figures_by_unit(local):
    made = plan(local)
    text = said(planned_sentences(made, None), "Reliability")
    assert " rad (median; largest " in text
    assert " m (median; largest " in text


def test_replicas_of_a_network_without_cameras(local):
    proof = prove(simulate(plan(local), 12, seed=1))
    assert proof.replicas.count == 12
    assert all(p.holds for p in proof.sigmas)
    assert any("12 replicas: sampled / predicted" in s.text for s in planned_sentences(proof.replicas.planned, proof))


def measured(network, rng):
    truth = error_free(network)
    groups = [
        with_values(g, g.observed() + g.sigmas.reshape(g.observed().shape) * rng.standard_normal(g.observed().shape))
        for g in truth.observations
    ]
    return replace(truth, observations=tuple(groups))


def test_epochs_in_the_plane_are_compared(local):
    rng = np.random.default_rng(3)
    true = baarda.adjust(local).network
    first = epoch(measured(true, rng))
    still = compare(first, epoch(measured(true, rng)))
    assert len(still.labels) == 10
    assert not still.rejected
    assert still.congruence.df[0] == 20.0
    assert np.isnan(still.differences[:, 2]).all()
    assert np.isfinite(still.sigmas[:, :2]).all()
    coordinates = np.array(true.points.coordinates)
    row = list(true.points.labels).index("403")
    coordinates[row, 0] += 0.05
    moved = compare(first, epoch(measured(replace(true, points=replace(true.points, coordinates=coordinates)), rng)))
    assert moved.rejected
    assert moved.localisation.moved[0] == "403"
    assert "10 Z" in " ".join(verdict(moved))
    assert result_json(moved)["rms"]["z"] is None
    assert np.isnan(tables(moved)["points"]["dZ"]).all()


def test_two_adjustments_of_the_same_readings_are_described_not_tested(folder, tmp_path):
    done = CliRunner().invoke(
        app, ["compare", str(folder / "gama-local.gkf"), str(folder / "azimuth-angle.gkf"), "--out", str(tmp_path / "c")]
    )
    assert done.exit_code == 0, done.output
    assert "Both adjust the same observations" in done.output
