"""Many images resected independently from control: one adjustment each, homogeneity, pooled study, the verb."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from baarda import adjust, cameras
from baarda.cameras import FIXED
from baarda.cli import app
from baarda.errors import Singular, UsageError
from baarda.formats.project import project
from baarda.hypotheses.homogeneity import bartlett
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import ImagePoints
from baarda.papers.maarek_konecny_study import SETS, elementary_errors, grid_network
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.multi_set_resection import adjust_sets
from baarda.procedures.resection_sets import resect_sets, sets_of

QUICK = StudyOptions(laws=("normal", "lineo"), replicas=49)


def grids(factor=1.0, seed=4):
    """The 19 grid sets of the paper, each a network of its own; a factor for the errors of set 15."""
    rng = np.random.default_rng(seed)
    out = []
    for name, number, side in SETS:
        for k in range(number):
            errors = (factor if len(out) == 14 else 1.0) * elementary_errors(2 * side * side, np.inf, 8.0, rng)
            out.append(grid_network(side, f"{name} {k + 1}", rng, errors, 8.0))
    return out


def together(networks, start=True):
    """One network of many images, in mm: the grids of each size are the same points."""
    labels, coordinates, groups = [], [], []
    for i, n in enumerate(networks):
        names = [f"{len(n.points.labels)}: {label}" for label in n.points.labels]
        new = [k for k, name in enumerate(names) if name not in labels]
        labels += [names[k] for k in new]
        coordinates += [n.points.coordinates[k] for k in new]
        g = n.observations[0]
        groups.append((np.full(len(g), i), [labels.index(names[k]) for k in g.points], g.xy / 1000.0, g.sigmas / 1000.0))
    x = np.array(coordinates)
    images = Images.make(
        [n.images.labels[0] for n in networks],
        position=np.concatenate([n.images.position for n in networks]) if start else None,
        rotation=np.concatenate([n.images.rotation for n in networks]) if start else None,
    )
    image, point, xy, sigmas = (np.concatenate(c) for c in zip(*groups, strict=True))
    measured = ImagePoints.make(image, point, xy, sigmas)
    points = Points.make(labels, x, np.full(len(x), CONTROL), np.full(x.shape, FIXED), given=x)
    distance = networks[0].cameras[0].values[0] / 1000.0
    camera = cameras.create("A8", cameras.model("pinhole"), {"principal_distance": distance}, unit="mm", y_down=False)
    return Network((camera,), images, points, (measured,), unit="mm", name="grids")


@pytest.fixture(scope="module")
def separate():
    return grids()


@pytest.fixture(scope="module")
def made(separate):
    return resect_sets(sets_of([together(separate)]), study_options=QUICK)


def test_each_image_is_an_adjustment_of_its_own(separate, made):
    assert [s.label for s in made.sets] == [n.name for n in separate]
    assert made.redundancy == 516
    assert [a.redundancy for _, a in made.adjusted] == [12] * 10 + [44] * 9
    for (_, a), n in zip(made.adjusted, separate, strict=True):
        assert a.objective == pytest.approx(adjust(n).objective, rel=1e-9)


def test_homogeneity_and_pooled_study_are_those_of_the_sets(separate, made):
    other = adjust_sets(separate).residuals
    assert made.homogeneity.statistic == pytest.approx(other.homogeneity().statistic, rel=1e-8)
    assert made.sigma0 == pytest.approx(other.sigma0 / 8.0, rel=1e-9)
    assert made.against_pooled()[:, 0] == pytest.approx(other.against_pooled()["statistic"], rel=1e-8)
    # theory §1.2: two-sided 5 % limits of chi-square
    assert made.against_pooled()[0, 1:] == pytest.approx([4.40, 23.34], abs=6e-3)
    assert made.against_pooled()[18, 1:] == pytest.approx([27.57, 64.20], abs=6e-3)
    study = other.study(8.0, QUICK)
    assert made.study.redundancy == pytest.approx(516, rel=1e-9)
    assert made.study.values == pytest.approx(study.values, rel=1e-6, abs=1e-7)
    assert made.study.test("skewness_of_residuals").p_value == pytest.approx(study.test("skewness_of_residuals").p_value, rel=1e-5)
    # null laws go through the adjustments of the sets
    laws, others = made.study.laws.laws, study.laws.laws
    assert laws[0].test("anderson_darling").p_value == others[0].test("anderson_darling").p_value


def test_a_set_of_another_accuracy_is_found():
    made = resect_sets(sets_of([together(grids(2.0))]), study_options=QUICK)
    assert made.homogeneity.rejected
    assert made.gates["bartlett"]
    x, low, high = made.against_pooled().T
    assert (x > high)[14]
    assert made.homogeneity.statistic == pytest.approx(
        bartlett([a.variance_factor for _, a in made.adjusted], [12] * 10 + [44] * 9).statistic, rel=1e-12
    )
    assert (low < high).all()


def test_starts_from_control_alone(separate):
    """Without start values, and with wrong ones: the same minimum."""
    block = together(separate[:3], start=False)
    made = resect_sets(sets_of([block]), study_options=QUICK)
    for (_, a), n in zip(made.adjusted, separate, strict=False):
        assert a.objective == pytest.approx(adjust(n).objective, rel=1e-8)
    behind = replace(together(separate[:3]), images=replace(together(separate[:3]).images, position=np.full((3, 3), 1e5)))
    again = resect_sets(sets_of([behind]), study_options=QUICK)
    assert [a.objective for _, a in again.adjusted] == pytest.approx([a.objective for _, a in made.adjusted], rel=1e-8)


def weak(network):
    """One image keeps 2 points, one 3, one sees points of a single line."""
    g = network.observations[0]
    keep = np.ones(len(g), dtype=bool)
    for image, count in ((0, 2), (1, 3)):
        keep[np.flatnonzero(g.images == image)[count:]] = False
    x = network.points.coordinates[g.points]
    keep &= (g.images != 10) | (x[:, 1] == x[g.images == 10][0, 1])
    return replace(network, observations=(g.selected(keep),))


def test_failures_are_rows(separate):
    block = weak(together(separate, start=False))
    made = resect_sets(sets_of([block]), study_options=QUICK)
    assert [s.label for s in made.failed] == [separate[k].name for k in (0, 1, 10)]
    assert "2 control point(s)" in made.failed[0].reason
    assert "3 control point(s) with image coordinates: six unknowns need 4" in made.failed[1].reason
    assert "one straight line" in made.failed[2].reason
    assert made.redundancy == 516 - 12 - 12 - 44
    assert made.gates["failed sets"]
    with pytest.raises(Singular, match="none of 1 set"):
        resect_sets(sets_of([block])[:1])
    with pytest.raises(UsageError, match="no images"):
        sets_of([replace(block, images=Images.make(()))])


def test_labels_of_several_sources_are_told_apart(separate):
    one = replace(separate[0], path="a/b")
    other = replace(separate[0], path="c/d")
    labels = [label for label, _ in sets_of([one, other, separate[1]])]
    assert labels == ["a/b: 9 points 1", "c/d: 9 points 1", "9 points 2"]


def test_sets_of_different_sigmas_are_pooled_by_weight(separate):
    """Residuals are divided by their sigmas before they are pooled; correlated coordinates are not pooled, but adjusted."""
    heavy = [replace(n, observations=(replace(n.observations[0], sigmas=2.0 * n.observations[0].sigmas),)) for n in separate[:2]]
    made = resect_sets(sets_of([*heavy, *separate[2:]]), study_options=QUICK)
    assert made.adjusted[0][1].variance_factor == pytest.approx(adjust(separate[0]).variance_factor / 4.0, rel=1e-9)
    assert made.study is not None
    g = separate[0].observations[0]
    tied = replace(separate[0], observations=(replace(g, correlations=np.full(len(g), 0.5)),))
    found = resect_sets(sets_of([tied, *separate[1:3]]), study_options=QUICK)
    assert found.study is None
    assert "are correlated" in found.left_out
    assert len(found.adjusted) == 3


# ---- the verb -------------------------------------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def folder(separate, tmp_path_factory):
    where = tmp_path_factory.mktemp("resect")
    project.write(weak(together(separate, start=False)), where / "p")
    done = run("resect", where / "p", "--out", where / "out", "--replicas", "49")
    assert done.exit_code == 0, done.stderr
    return where, done


def test_verb_writes_a_folder(folder):
    where, done = folder
    assert "16 of 19 sets were resected, each by itself: 544 observations, pooled redundancy 448" in done.stdout
    assert "3 failed: 9 points 1, 9 points 2, 25 points 1" in done.stdout
    document = json.loads((where / "out" / "result.json").read_text())
    assert document["schema"] == "baarda.resections/1"
    assert document["counts"] == {"sets": 19, "adjusted": 16, "failed": 3, "observations": 544, "redundancy": 448}
    assert document["sets"][0]["status"] == "failed"
    assert document["homogeneity"]["df"] == [15]
    assert document["study"]["redundancy"] == pytest.approx(448, rel=1e-9)
    page = (where / "out" / "report.html").read_text()
    assert "Adjustments of the sets" in page
    assert "Laws of errors" in page
    rows = list(csv.DictReader((where / "out" / "tables" / "sets.csv").read_text().splitlines()))
    assert len(rows) == 19
    assert [r["status"] for r in rows].count("failed") == 3
    again = run("resect", where / "p", "--out", where / "again", "--replicas", "49", "--quiet")
    assert again.exit_code == 0
    assert again.stdout == ""
    for name in ("result.json", "tables/sets.csv", "tables/residuals.csv"):
        assert (where / "out" / name).read_bytes() == (where / "again" / name).read_bytes()


def test_pooled_residuals_are_a_table_of_the_verb_residuals(folder, tmp_path):
    where, _ = folder
    done = run("residuals", where / "out" / "tables" / "residuals.csv", "--column", "residual", "--replicas", "19", "--out", tmp_path / "r")
    assert done.exit_code == 0, done.stderr
    ours = json.loads((where / "out" / "result.json").read_text())["study"]
    theirs = json.loads((tmp_path / "r" / "result.json").read_text())
    assert theirs["sample"]["sigma0"] == pytest.approx(ours["sigma0"], rel=1e-9)
    assert theirs["counts"]["groups"] == 16


def test_verb_gates_and_refusals(folder, tmp_path):
    where, _ = folder
    strict = run("resect", where / "p", "--json", "--replicas", "19", "--quiet", "--strict")
    assert strict.exit_code == 1
    assert "failed sets" in strict.stderr
    assert json.loads(strict.stdout)["counts"]["failed"] == 3
    g = project.read(where / "p")
    project.write(replace(g, points=replace(g.points, roles=np.zeros(len(g.points.labels), dtype=int))), tmp_path / "q")
    none = run("resect", tmp_path / "q", "--out", tmp_path / "out")
    assert none.exit_code == 3
    assert "none of 19 set(s) could be adjusted" in none.stderr
    assert not (tmp_path / "out").exists()
    assert run("resect", tmp_path / "nothing").exit_code == 2
    assert run("resect", where / "p", "--tables", "xls", "--out", tmp_path / "out").exit_code == 2


def test_german(folder):
    """Report and verdict in German; JSON and tables the same bytes."""
    where, _ = folder
    done = run("resect", where / "p", "--out", where / "de", "--replicas", "49", "--language", "de")
    assert done.exit_code == 0, done.stderr
    assert "16 von 19 Sätzen für sich ausgeglichen (Rückwärtsschnitt): 544 Beobachtungen, gemeinsame Redundanz 448" in done.stdout
    assert "Die Varianzen der Sätze sind nicht nachweislich verschieden" in done.stdout
    page = (where / "de" / "report.html").read_text()
    assert "Ausgleichungen der Sätze" in page
    for name in ("result.json", "tables/sets.csv", "tables/residuals.csv"):
        assert (where / "de" / name).read_bytes() == (where / "out" / name).read_bytes()
    assert run("resect", where / "p", "--language", "xx", "--out", where / "no").exit_code == 2
