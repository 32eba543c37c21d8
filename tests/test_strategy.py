"""Grün's order, cross-validation, and the options of the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from baarda.cli import app
from baarda.errors import UsageError
from baarda.formats.project import write as write_project
from baarda.hypotheses.levels import Options
from baarda.procedures.cross_validation import cross_validate, folds_of
from baarda.procedures.strategy import Plan, carry_out
from networks import ring


def block(**more):
    return ring(**{"images": 7, "points": 26, "control": 9, "checks": 5, "seed": 3, "noise": 0.3, "free": FREE} | more)


FREE = ("principal_distance", "principal_point_x", "principal_point_y", "K1", "P1", "P2")


def test_gruens_order() -> None:
    network = block()
    group = network.observations[0]
    xy = np.array(group.xy)
    xy[20, 0] += 8.0
    a, found = carry_out(replace(network, observations=(replace(group, xy=xy),)), Plan(strategy="gruen"), Options(alpha_outlier=1e-4))
    assert [s.name for s in found.stages] == [
        "global test of the full data",
        "blunders",
        "global test",
        "all additional parameters",
        "single additional parameters",
        "correlated pairs",
        "orthogonalised parameters",
        "deletion",
        "global test of the final model",
        "control points",
        "check points",
    ]
    assert found.stages[0].rejected
    assert not found.stages[2].rejected
    assert "removed: 1 observation(s)" in found.stages[1].decision
    assert found.selection is not None
    assert set(found.selection.deleted) <= {"camera 1: P1", "camera 1: P2"}
    assert a.count == 2 * 182 + 27 - found.snooping.count


def test_stages_without_anything_to_test() -> None:
    _, found = carry_out(ring(free=("principal_distance",)), Plan(strategy="gruen"), Options(alpha_outlier=1e-9))
    told = {s.name: s.finding for s in found.stages}
    for name in ("all additional parameters", "correlated pairs", "control points", "check points"):
        assert told[name] == "not applicable: there is nothing to test"
    assert told["deletion"] == "There are no parameters to select."


def test_both_procedures_keep_the_first_start_values() -> None:
    network = block()
    a, _ = carry_out(network, Plan(snoop="coordinate", select=True), Options(alpha_outlier=1e-4))
    np.testing.assert_allclose(a.start.points.coordinates, network.points.coordinates)


# ---- cross-validation -----------------------------------------------------------------------------------------------------------------


def test_folds() -> None:
    parts = folds_of(30, 6, seed=1)
    assert [len(p) for p in parts] == [5] * 6
    assert sorted(np.concatenate(parts)) == list(range(30))
    with pytest.raises(UsageError, match="there are 3"):
        folds_of(3, 4)


def test_withheld_points_are_what_an_adjustment_without_them_predicts() -> None:
    from baarda.adjustment import adjust
    from baarda.network import CHECK

    network = block(checks=0)
    found = cross_validate(network, 9, Options(alpha=0.05))
    assert len(found.rows) == 27
    one = found.rows[0]
    i = network.points.labels.index(one.point)
    roles = np.array(network.points.roles)
    roles[i] = CHECK
    a = adjust(replace(network, points=replace(network.points, roles=roles)))
    e = a.evidence.check
    assert one.difference == pytest.approx(e.values[0], rel=1e-6)
    assert one.sigma == pytest.approx(np.sqrt(a.variance_factor * e.cofactors[0, 0] + 0.01**2), rel=1e-6)
    x = np.array([r.difference for r in found.rows if r.axis == "X"])
    error = next(e for e in found.errors if e.name == "X")
    assert error.rms == pytest.approx(np.sqrt(np.mean(x**2)))
    assert error.low < error.rms < error.high
    assert error.df <= 9.0 + 1e-9
    both = next(e for e in found.errors if e.name == "3d")
    assert both.rms**2 == pytest.approx(sum(next(e for e in found.errors if e.name == k).rms ** 2 for k in "XYZ"))


def test_fixed_control_is_withheld_too() -> None:
    found = cross_validate(ring(images=6, points=20, control=8, fixed_control=True, seed=2), 4)
    assert found.rejected <= 6
    assert all(np.isfinite(r.ratio) for r in found.rows)


def test_too_little_control() -> None:
    with pytest.raises(UsageError, match="there are 0"):
        cross_validate(ring(), 3)
    few = cross_validate(ring(images=6, points=20, control=4, seed=2, control_sigma=0.001), 4, datum="control")
    assert len({r.point for r in few.rows}) == 4
    with pytest.raises(UsageError, match="no control point could be predicted"):
        cross_validate(ring(images=6, points=20, control=3, seed=2), 3, datum="control")
    with pytest.raises(UsageError, match="2 folds"):
        Plan(folds=1)


# ---- command line -----------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def project(tmp_path):
    write_project(block(), tmp_path / "block")
    return tmp_path / "block"


def test_command_line(project, tmp_path) -> None:
    runner = CliRunner()
    out = runner.invoke(app, ["adjust", str(project), "--strategy", "gruen", "--cross-validate", "3", "--json", "--quiet"])
    assert out.exit_code == 0, out.output
    document = json.loads(out.stdout)
    assert len(document["strategy"]) == 11
    assert document["selection"][0]["step"] == 0
    assert document["cross_validation"]["errors"][0]["name"] == "X"
    assert document["snooping"]["unit"] == "coordinate"
    point = runner.invoke(
        app, ["adjust", str(project), "--snoop-unit", "point", "--select", "--criterion", "j", "--out", str(tmp_path / "r")]
    )
    assert point.exit_code == 0, point.output
    written = json.loads((tmp_path / "r" / "result.json").read_text())
    assert written["snooping"]["unit"] == "point"
    html = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    assert "(n + u) s0^2" in html
    assert 'id="snooping"' in html


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--criterion", "press"], "--criterion"),
        (["--snoop-unit", "pixel"], "--snoop-unit"),
        (["--strategy", "wu"], "--strategy"),
        (["--cross-validate", "1"], "--cross-validate"),
        (["--cross-validate", "40"], "control points"),
        (["--select", "--robust", "huber"], "least squares"),
    ],
)
def test_wrong_options(project, arguments, message) -> None:
    out = CliRunner().invoke(app, ["adjust", str(project), *arguments, "--json", "--quiet"])
    assert out.exit_code == 2, out.output
    assert message in out.stderr
