"""Radar as a user meets it: CSV input, verdict and report with units, selection, cross-validation, refusals with their exit codes."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda import adjust
from baarda.cameras import FIXED, FREE
from baarda.cli import app
from baarda.errors import InputError
from baarda.formats.project import project
from baarda.network import CONTROL, TIE
from baarda.procedures.radar_simulation import simulate_radar


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def table(network, columns=None, extra=None):
    """The CSV table of a network of one track; `extra` are columns that are the same everywhere."""
    o, p = network.observations[0], network.points
    extra = {"delay": 8700.0, "side": 1, **(extra or {})}
    lines = [",".join(["point", "t", "r", "sigma_t", "sigma_r", "X", "Y", "Z", *extra])]
    for i, tr, s in zip(o.points, o.tr, o.sigmas, strict=True):
        x = ["" if np.isnan(v) else repr(float(v)) for v in p.given[i]]
        lines.append(",".join([p.labels[i], *(repr(float(v)) for v in (*tr, *s)), *x, *(str(v) for v in extra.values())]))
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def made():
    return simulate_radar(1993)


# ---- CSV ------------------------------------------------------------------------------------------------------------------------------


def test_csv_table_is_the_project(made, tmp_path):
    (tmp_path / "radar.csv").write_text(table(made.network))
    network = baarda.read(tmp_path / "radar.csv")
    assert network.format == "radar-csv"
    assert any("order" in text for text in network.assumptions)
    assert adjust(network).objective == adjust(made.network).objective
    (tmp_path / "second.csv").write_text(table(made.network, extra={"order": 2, "squint_order": 1, "time_origin": 5.0}))
    small = adjust(baarda.read(tmp_path / "second.csv"))
    assert small.numbering.count == 2 + 1 + 9
    parameters = small.network.declared[0].parameters_of(0)
    assert {"squint1", "Z2"} <= set(parameters)
    assert "Z3" not in parameters


def test_csv_of_two_tracks_and_withheld_plan(tmp_path):
    """Heights alone, sigmas, roles, and a point whose coordinates stand in one of its rows only."""
    made = simulate_radar(8, order=2, sides=(1, -1), directions=(np.pi, np.pi), ties=3, deviations=np.zeros((3, 3)), control_sigma=0.5)
    o, p = made.network.observations[0], made.network.points
    lines = ["track,point,t,r,sigma_t,sigma_r,X,Y,Z,sigma_X,sigma_Y,sigma_Z,role,delay,side,order"]
    for track, i, tr, s in zip(o.tracks, o.points, o.tr, o.sigmas, strict=True):
        label, first = p.labels[i], track == 0
        x = [repr(float(v)) for v in p.given[i]] if first and np.isfinite(p.given[i]).all() else [""] * 3
        if label == "C3" and first:
            x[:2] = ["", ""]
        sx = ["0.5" if v else "" for v in x]
        role = "check" if label == "C4" and first else ""
        measured = [repr(float(v)) for v in (*tr, *s)]
        lines.append(",".join([str(track + 1), label, *measured, *x, *sx, role, "8700", "-1" if track else "1", "2"]))
    (tmp_path / "radar.csv").write_text("\n".join(lines) + "\n")
    network = baarda.read(tmp_path / "radar.csv")
    states = dict(zip(network.points.labels, network.points.states.tolist(), strict=True))
    assert states["C3"] == [2, 2, 1]
    assert states["C1"] == [1, 1, 1]
    assert states["T36"] == [2, 2, 2]
    roles = dict(zip(network.points.labels, network.points.roles.tolist(), strict=True))
    assert (roles["C3"], roles["C4"], roles["T36"]) == (CONTROL, 2, TIE)
    a = adjust(network)
    assert a.status == "converged"
    at = network.points.labels.index("C3")
    e = (a.network.points.coordinates - made.truth.points.coordinates)[at]
    assert (np.abs(e) < 4.5 * np.sqrt(np.diag(a.point_cofactors[at]))).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("\nC2,", f"\n{t.splitlines()[1]}\nC2,", 1), r"line 3: point C1 of track 1 appears already in line 2"),
        (lambda t: t.replace("C2,", "C1,", 1), r"line 3: X of point C1 differs from an earlier row"),
        (lambda t: t.replace(",8700.0,1\nC3", ",8701.0,1\nC3", 1), r"line 3: delay differs from line 2"),
        (lambda t: t.replace(",1\n", ",2\n"), r"line 2: side is 1"),
        (lambda t: t.replace("point,t,r", "point,t,q,r", 1), "unknown column 'q'"),
        (lambda t: t.replace(",1.0,", ",0.0,", 1), r"line 2: sigma_r must be there and positive"),
        (lambda t: re.sub(r"C1,[^,]*", "C1,nan", t, count=1), r"line 2: t is not finite"),
    ],
)
def test_csv_that_makes_no_sense(made, tmp_path, change, message):
    (tmp_path / "radar.csv").write_text(change(table(made.network)))
    with pytest.raises(InputError, match=message):
        baarda.read(tmp_path / "radar.csv")


def test_csv_with_impossible_orders(made, tmp_path):
    for column, value in (("order", "2.5"), ("order", "0"), ("squint_order", "99")):
        (tmp_path / "radar.csv").write_text(table(made.network, extra={column: value}))
        with pytest.raises(InputError, match=f"line 2: {column} must be a whole number"):
            baarda.read(tmp_path / "radar.csv")


# ---- the report -----------------------------------------------------------------------------------------------------------------------


def text_of(page):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r"<(style|script|svg).*?</\1>", "", page, flags=re.S)))


def test_units_selection_and_planimetric_accuracy(made, tmp_path):
    """No time in pixels: each component has its own unit in verdict, report and JSON; withheld points have intervals."""
    o = made.network.observations[0]
    tr = np.array(o.tr)
    tr[6] += [0.6, 0.0]  # 18 sigma
    (tmp_path / "radar.csv").write_text(table(replace(made.network, observations=(replace(o, tr=tr),))))
    done = run("adjust", tmp_path / "radar.csv", "--snoop", "--select", "--cross-validate", "5", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert re.search(r"from [\d.]+ s \(3\d observations\), [\d.]+ px \(3\d observations\)", done.stdout)
    page = text_of((tmp_path / "out" / "report.html").read_text())
    assert "s, px" not in page + done.stdout
    assert "range doppler t s, r px; angles degrees" in page
    assert re.search(r"range doppler, t 3\d 0\.0336\d* s range doppler, r 3\d 1 px", page)
    assert "Antenna tracks" in page
    assert re.search(r"horizontal 3\d [\d.]+ [\d.]+ [\d.]+ [\d.]+", page)  # rms, its interval, and what was predicted
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    step = document["snooping"]["steps"][0]
    assert (step["point"], step["component"], step["unit"]) == ("C7", "t", "s")
    assert step["estimated_error"] == pytest.approx(0.6, abs=0.2)
    names = {u["name"]: u["unit"] for u in document["unknowns"]}
    assert names["track 1: pixel_spacing"] == "m/px"
    deleted = {s["dropped"] for s in document["selection"] if s["dropped"]}
    assert deleted
    assert deleted <= {f"track 1: {c}" for c in ("X2", "Z2", "Z3", "Z4")}
    kinds = {e["name"] for e in document["cross_validation"]["errors"]}
    assert {"X", "Y", "horizontal"} <= kinds


# ---- refusals -------------------------------------------------------------------------------------------------------------------------


def changed(made, what):
    network, group = made.network, made.network.declared[0]
    o, points = network.observations[0], network.points
    if what == "few points":
        return replace(network, observations=(o.selected(np.arange(8)),))
    if what == "wrong side":
        values = np.array(group.values)
        values[group.named(0, "side")] = -1.0
        return replace(network, declared=(replace(group, values=values),))
    x = np.array(points.coordinates)
    if what == "collinear":  # points on one line along the flight; nothing is known of it
        x[:, 0] = x[0, 0]
        return replace(network, points=replace(points, coordinates=x, given=x))
    # points below the flight on one line, the flight known roughly: coordinates are those that such a flight gives
    from baarda.geometry import range_doppler as radar

    true = made.tracks
    x[:, 0], x[:, 2] = x[:, 0].mean(), 100.0
    arrays = true.arrays(np.zeros(len(x), dtype=int), true.layouts[0])
    s, r = radar.project(x, *arrays, np.zeros(len(x)))
    started = replace(group, values=np.array(true.values))
    table_ = replace(points, coordinates=x, given=x)
    return replace(network, points=table_, observations=(replace(o, tr=np.stack([s, r], axis=1)),), declared=(started,))


@pytest.mark.parametrize(
    ("what", "code", "message"),
    [
        ("few points", 3, "n = 16 observations, u = 17 unknowns"),
        ("wrong side", 2, "lies left of track 1, which looks right"),
        ("collinear", 3, "track 1: the control points lie on one line in plan"),
        ("collinear along a known flight", 3, "track 1: all 35 control points lie on one line"),
    ],
)
def test_refusals_and_exit_codes(made, tmp_path, what, code, message):
    project.write(changed(made, what), tmp_path / "p")
    done = run("adjust", tmp_path / "p", "--out", tmp_path / "out")
    assert (done.exit_code, message in done.stderr) == (code, True), done.stderr
    assert not (tmp_path / "out").exists()


def test_left_or_right_is_reported(made, tmp_path):
    """One track, a height, no control: both points are told, none is chosen."""
    true, network = made.tracks, made.network
    values = np.array(true.values)
    values[true.named(0, "side")] = 0.0
    states = np.full((len(network.points.labels), 3), FREE)
    states[:, 2] = FIXED
    given = np.array(network.points.given)
    given[:, :2] = np.nan
    points = replace(network.points, coordinates=given, given=given, states=states)
    blind = replace(network, points=points, declared=(replace(true, values=values, states=np.full(len(values), FIXED)),))
    project.write(blind, tmp_path / "p")
    done = run("adjust", tmp_path / "p", "--out", tmp_path / "out")
    assert done.exit_code == 3
    assert "have the same ranges; say on which side the antenna looks" in done.stderr


def test_simulated_image(tmp_path):
    """`simulate radar` writes the scenario of the paper; the same seed gives the same image."""
    done = run("simulate", "radar", "--out", tmp_path / "p", "--noise", "1", "--seed", "1993")
    assert done.exit_code == 0, done.stderr
    assert "35 control points, 70 observations" in done.stdout
    network = project.read(tmp_path / "p")
    assert network.observations[0].tr == pytest.approx(simulate_radar(1993).network.observations[0].tr, abs=0.0)
    assert run("simulate", "radar").exit_code == 2
    assert run("simulate", "radar", "--out", tmp_path / "q", "--noise", "0").exit_code == 2


def test_damaged_tables_end_in_a_message(made, tmp_path):
    import random

    from test_format_mutations import mutated

    good, rng = table(made.network).encode(), random.Random(6)
    refused = 0
    for _ in range(150):
        (tmp_path / "radar.csv").write_bytes(mutated(good, rng) or b" ")
        try:
            network = baarda.read(tmp_path / "radar.csv", format="radar-csv")
        except InputError as error:
            assert "radar.csv" in str(error)
            refused += 1
        else:
            assert len(network.observations[0]) >= 1
    assert 20 < refused < 150
