"""Independent models in plan and height by turns: closed forms, the spatial block, statistics, refusals, the verb."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from baarda import adjust
from baarda.cameras import FIXED, FREE
from baarda.cli import app
from baarda.errors import RedundancyNotPositive, Singular, UsageError
from baarda.formats.project import project
from baarda.geometry import rotation as rot
from baarda.network import CONTROL, TIE, Points, State
from baarda.observations import ModelHeights, ModelPlan
from baarda.procedures.independent_models import Model, block_of_models, simulate_strip
from baarda.procedures.planimetry_height import adjust_planimetry_height

NOISE = 2e-5


def measured(count=5, seed=2, noise=NOISE, control_sigma=None):
    """A strip of models whose coordinates have independent errors, and the truth."""
    made = simulate_strip(count, seed=seed, control_sigma=control_sigma)
    rng = np.random.default_rng(seed)

    def spoiled(x):
        return {k: v + noise * rng.standard_normal(3) for k, v in x.items()}

    given = [replace(m, points=spoiled(m.points), centres=spoiled(m.centres)) for m in made.models]
    truth = made.truth | {f"perspective centre photo {i + 1}": p for i, p in enumerate(made.position)}
    return made, given, truth


@pytest.fixture(scope="module")
def strip():
    made, given, truth = measured(6)
    network = block_of_models(given, made.control, NOISE)
    return network, adjust_planimetry_height(network), truth


def test_exact_models_give_the_truth():
    made, given, truth = measured(5, noise=0.0)
    found = adjust_planimetry_height(block_of_models(given, made.control, NOISE))
    assert found.converged
    for i, label in enumerate(found.network.points.labels):
        assert found.network.points.coordinates[i] == pytest.approx(truth[label], abs=1e-7)
    models = found.network.declared[0]
    for m, given_model in enumerate(given):
        x = np.array([truth[k] for k in given_model.points])
        v = models.values.reshape(-1, 7)[m]
        assert v[6] * (x - v[:3]) @ models.rotations[m].T == pytest.approx(np.array(list(given_model.points.values())), abs=1e-10)


def test_halves_of_one_model_are_closed_forms():
    """Plan: a complex straight line (Helmert's transformation); height: a plane through the levelled heights and both centres."""
    rng = np.random.default_rng(7)
    x = rng.uniform(-1000, 1000, (8, 3)) * [1.0, 1.0, 0.05]
    centres = np.array([[-300.0, 0.0, 1500.0], [300.0, 10.0, 1490.0]])
    turn = rot.exp(np.array([0.02, -0.03, 0.8]))
    model = 1e-3 * (np.vstack([x, centres]) - [50.0, 60.0, 20.0]) @ turn.T + 1e-4 * rng.standard_normal((10, 3))
    labels = [f"p{i}" for i in range(8)]
    control = Points.make(labels, x, np.full(8, CONTROL), np.full((8, 3), FIXED), x)
    one = Model("1", ("a", "b"), dict(zip("ab", model[8:], strict=True)), {}, dict(zip(labels, model[:8], strict=True)))
    found = adjust_planimetry_height(block_of_models([one], control, 1e-4))
    plan, height = found.plan, found.height
    xy = plan.network.observations[0].values
    # a centre seen in one model only is determined by it, and controls nothing
    assert (plan.redundancy, height.redundancy) == (2 * 8 - 4, 8 - 3)
    w, z = x[:, 0] + 1j * x[:, 1], xy[:, 0] + 1j * xy[:, 1]
    (a, b), *_ = np.linalg.lstsq(np.stack([w, np.ones(8)], axis=1), z, rcond=None)
    rest = a * w + b - z
    assert plan.objective == pytest.approx(np.sum(np.abs(rest) ** 2) / 1e-8, rel=1e-8)
    assert plan.network.declared[0].values[6] == pytest.approx(abs(a), rel=1e-10)
    # the tilt is that of the plane that heights of model and ground differ by, up to second order of a tilt that levelling has removed
    measured_z = height.network.observations[0].values[:, 0]
    scale = plan.network.declared[0].values[6]
    plane, *_ = np.linalg.lstsq(np.column_stack([x[:, :2], np.ones(8)]), measured_z - scale * x[:, 2], rcond=None)
    rest = np.column_stack([x[:, :2], np.ones(8)]) @ plane - (measured_z - scale * x[:, 2])
    assert height.objective == pytest.approx(np.sum(rest**2) / 1e-8, rel=1e-6)
    assert np.abs(plane[:2]).max() < 1e-9  # level


def test_statistics_and_truth(strip):
    network, found, truth = strip
    spatial = adjust(network)
    assert found.converged
    assert found.redundancy == spatial.redundancy
    for half in (found.plan, found.height):
        assert half.redundancy_numbers.sum() == pytest.approx(half.redundancy, rel=1e-9)
        assert 0.001 < stats.chi2.cdf(half.objective, half.redundancy) < 0.999
        assert adjust(half.start, solver="block").redundancy_numbers == pytest.approx(half.redundancy_numbers, abs=1e-8)
    for half, axes in ((found.plan, [0, 1]), (found.height, [2])):
        p = half.network.points
        tie = [i for i, label in enumerate(p.labels) if p.roles[i] == TIE and not label.startswith("perspective")]
        e = np.array([p.coordinates[i] - truth[p.labels[i]] for i in tie])[:, axes]
        q = half.point_cofactors[tie][:, axes][:, :, axes]
        z = np.einsum("ni,nij,nj->n", e, np.linalg.inv(q), e)
        assert 0.3 < z.mean() / len(axes) < 2.5
    # and the spatial block, whose unknowns are the same, is as near as errors allow
    d = found.network.points.coordinates - spatial.network.points.coordinates
    s = np.sqrt(np.einsum("nii->ni", spatial.point_cofactors))
    assert (np.abs(d)[s > 0] < 2.0 * s[s > 0]).all()


def test_orientation_of_the_models_does_not_matter(strip):
    """Models in any orientation are levelled first."""
    network, found, _ = strip
    group = network.observations[0]
    rng = np.random.default_rng(3)
    turns = rot.exp(rng.normal(0.0, 1.0, (6, 3)))
    turned = replace(group, xyz=np.einsum("nij,nj->ni", turns[group.models], group.xyz))
    again = adjust_planimetry_height(replace(network, observations=(turned,)))
    assert again.plan.objective == pytest.approx(found.plan.objective, rel=1e-6)
    assert again.height.objective == pytest.approx(found.height.objective, rel=1e-6)
    assert again.network.points.coordinates == pytest.approx(found.network.points.coordinates, abs=1e-5)
    assert again.network.declared[0].rotations == pytest.approx(
        np.einsum("nij,njk->nik", turns, found.network.declared[0].rotations), abs=1e-8
    )


def test_control_in_plan_or_height_only(strip):
    """Weighted control with correlated plan; height control without plan."""
    made, given, _ = measured(5, control_sigma=0.05)
    c = made.control
    states, values = np.array(c.states), np.array(c.given)
    states[0], values[0] = [FREE, FREE, FIXED], [np.nan, np.nan, values[0, 2]]
    sigmas = np.array(c.sigmas)
    sigmas[0] = np.nan
    control = replace(c, states=states, given=values, sigmas=sigmas, correlations=np.tile([0.4, 0.0, 0.0], (len(c.labels), 1)))
    found = adjust_planimetry_height(block_of_models(given, control, NOISE))
    full = adjust_planimetry_height(block_of_models(given, c, NOISE))
    assert found.converged
    assert found.plan.redundancy == full.plan.redundancy - 2
    assert found.height.redundancy == full.height.redundancy  # one point fixed instead of observed: an unknown and an observation less


def test_what_is_missing_is_named(strip):
    network, _, _ = strip
    made, given, _ = measured(5)
    group = network.observations[0]
    centre = np.array([label.startswith("perspective") for label in network.points.labels])
    lost = group.selected(~((group.models == 2) & centre[group.points]))
    with pytest.raises(UsageError, match="model 3 has no perspective centre"):
        adjust_planimetry_height(replace(network, observations=(lost,)))
    with pytest.raises(UsageError, match="one group of model coordinates"):
        adjust_planimetry_height(replace(network, observations=()))
    for count, what in ((1, "with X and Y: the plan of the block needs 2"), (2, "with Z: the height of the block needs 3")):
        points = network.points
        roles = np.array(points.roles)
        roles[np.flatnonzero(roles == CONTROL)[count:]] = TIE
        started = replace(network, points=replace(points, roles=roles, coordinates=np.nan_to_num(points.coordinates)))
        started = replace(started, declared=(replace(network.declared[0], values=np.tile([0.0, 0, 0, 0, 0, 0, 1.0], 6)),))
        with pytest.raises(Singular, match=rf"{count} control point\(s\) {what}"):
            adjust_planimetry_height(started)
    one = block_of_models(given[:1], made.control, NOISE)
    measured_points = [one.points.labels[i] for i in one.observations[0].points]
    few = np.array([label in ("1a", "1b", "3c") or label.startswith("perspective") for label in measured_points])
    with pytest.raises(RedundancyNotPositive):
        adjust_planimetry_height(replace(one, observations=(one.observations[0].selected(few),)))
    assert not adjust_planimetry_height(network, rounds=1).converged


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_verb(tmp_path):
    made, given, _ = measured(3)
    network = block_of_models(given, made.control, NOISE)
    found = adjust_planimetry_height(network)
    project.write(network, tmp_path / "p")
    done = run("models", tmp_path / "p", "--form", "planimetry-height", "--out", tmp_path / "out", "--language", "de")
    assert done.exit_code == 0, done.stderr
    assert f"Redundanz {found.redundancy} ({found.plan.redundancy} in der Lage, {found.height.redundancy} in der Höhe)" in done.stdout
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document["schema"] == "baarda.planimetry_height/1"
    assert document["verdict"][0].startswith("Rounds: Plan and height were adjusted by turns")  # JSON is English
    assert document["plan"]["objective"]["final"] == pytest.approx(found.plan.objective, rel=1e-6)
    assert document["height"]["counts"]["redundancy"] == found.height.redundancy
    assert "Ausgeglichene Punkte" in (tmp_path / "out" / "report.html").read_text()
    for name in ("plan.html", "height.html"):
        assert "<html" in (tmp_path / "out" / name).read_text()
    again = adjust(project.read(tmp_path / "out" / "project"))  # the adjusted block is a project like any other
    assert again.redundancy == found.redundancy
    whole = run("models", tmp_path / "p", "--json", "--quiet")
    assert whole.exit_code == 0
    assert json.loads(whole.stdout)["counts"]["redundancy"] == found.redundancy
    assert run("models", tmp_path / "p", "--form", "flat").exit_code == 2
    group = network.observations[0]
    centre = np.array([label.startswith("perspective") for label in network.points.labels])
    project.write(replace(network, observations=(group.selected(~centre[group.points]),)), tmp_path / "q")
    lost = run("models", tmp_path / "q", "--form", "planimetry-height", "--out", tmp_path / "no")
    assert lost.exit_code == 2
    assert "has no perspective centre" in lost.stderr
    assert not (tmp_path / "no").exists()


def test_halves_in_project_files(strip, tmp_path):
    _, found, _ = strip
    for name, half in (("plan", found.plan), ("height", found.height)):
        project.write(half.network, tmp_path / name)
        again = adjust(project.read(tmp_path / name))
        assert again.objective == pytest.approx(half.objective, rel=1e-9)
        assert again.redundancy == half.redundancy


def test_rows_of_the_halves_are_those_of_the_whole(strip):
    """x, y and z of a model, and their partials, whichever kind of observation holds them."""
    network, _, _ = strip
    group = network.observations[0]
    net = group.with_start(network, np.zeros(len(network.points.labels), dtype=bool))
    state = State.of(net)
    whole = group.linearize(net, state)[0]
    for kind, axes in ((ModelPlan, [0, 1]), (ModelHeights, [2])):
        part = kind(group.models, group.points, group.xyz[:, axes], group.sigmas[:, axes])
        rows = part.linearize(net, state)[0]
        assert rows.misclosure == pytest.approx(whole.misclosure[:, axes], abs=1e-15)
        assert part.misclosures(net, state) == pytest.approx(whole.misclosure[:, axes], abs=1e-15)
        for mine, theirs in zip(rows.blocks, whole.blocks, strict=True):
            assert mine.jacobian == pytest.approx(theirs.jacobian[:, axes], abs=1e-12)
        assert part.with_values(part.values + 1.0).observed() == pytest.approx(part.values + 1.0)


@pytest.mark.parametrize(
    ("what", "code", "message"),
    [
        ("few", 3, "redundancy"),
        ("apart", 3, "model 3 cannot be connected"),
        ("two control points", 3, "cannot be moved onto 2 control point"),
        ("collinear", 3, "lie on one straight line"),
    ],
)
def test_spatial_blocks_that_cannot_be_adjusted(strip, tmp_path, what, code, message):
    """Named, refused, nothing written."""
    made, given, _ = measured(3)
    network = block_of_models(given, made.control, NOISE)
    group, labels = network.observations[0], network.points.labels
    names = np.array(labels)[group.points]
    if what == "few":
        one = replace(given[0], points={k: x for k, x in given[0].points.items() if k in ("1a", "1b")}, photographs=("photo 1",))
        one = replace(one, centres={"photo 1": one.centres["photo 1"]})
        network = block_of_models([one], Points.make(()), NOISE)
    elif what == "apart":
        keep = (group.models != 2) | np.isin(names, ["5a", "5b", "5c", "perspective centre photo 4"])
        network = replace(network, observations=(group.selected(keep),))
    elif what == "two control points":
        roles = np.array(network.points.roles)
        roles[np.flatnonzero(roles == CONTROL)[2:]] = TIE
        coordinates = np.where((roles == CONTROL)[:, None], network.points.coordinates, np.nan)
        states = np.where((roles == CONTROL)[:, None], network.points.states, FREE)
        network = replace(network, points=replace(network.points, roles=roles, coordinates=coordinates, states=states))
    else:
        control = network.points.roles == CONTROL
        line = np.where(control[:, None], np.outer(np.arange(len(labels)), [100.0, 50.0, 1.0]), network.points.coordinates)
        given_line = np.where(control[:, None], line, network.points.given)
        network = replace(network, points=replace(network.points, coordinates=line, given=given_line))
    project.write(network, tmp_path / "p")
    done = run("adjust", tmp_path / "p", "--out", tmp_path / "out")
    assert (done.exit_code, message in done.stderr) == (code, True), done.stderr
    assert not (tmp_path / "out").exists()
