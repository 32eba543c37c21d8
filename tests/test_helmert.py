"""Helmert blocking: the parts together give what the network gives in one piece."""

import json
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.adjustment import memory
from baarda.adjustment.block import BlockSolver
from baarda.adjustment.linearize import Arrangement, linearize
from baarda.adjustment.point_order import rank_for
from baarda.adjustment.solve import active_groups
from baarda.adjustment.structure import analyse
from baarda.cli import app
from baarda.errors import DatumDefect, NotEnoughMemory, RedundancyNotPositive, Singular, UsageError
from baarda.formats.project import write as write_project
from baarda.hypotheses.levels import Options
from baarda.network import State, Table, unknowns_of
from baarda.observations import CameraPositions, lever_arms, strips
from baarda.procedures import helmert, helmert_stand, helmert_statistics
from baarda.procedures.helmert import finish, gathered_tables, solve_blocked
from baarda.procedures.partition_folder import write_partition
from baarda.procedures.synthetic import synthetic
from baarda.procedures.task_engines import open_engine
from baarda.procedures.testing import analyse as analyse_whole
from baarda.report import helmert_report
from baarda.report.contents import table_csv
from networks import with_distances

KEYS = {"unknowns": ("name",), "points": ("point",), "images": ("image",), "observations": ("group", "image", "point", "component")}


def aerial(images=20, **options):
    return synthetic("aerial", images, points=options.pop("points", 12 * images), **options).network


def plain_tables(network, effects=False, **options):
    """The tables of an adjustment in one piece."""
    a = baarda.adjust(network, solver="block", **options)  # the dense solver rounds otherwise: eps times the condition number
    tested = analyse_whole(a, Options())
    more = {"w": tested.w, "tau": tested.tau} if not effects else dict(tested.observations.columns)
    observations = Table({**a.observations.columns, **more})
    return a, {"observations": observations, "points": a.points, "images": a.images, "unknowns": a.unknowns}


def keyed(table, kind):
    out = {tuple(row[k] for k in KEYS[kind]): row for row in table.rows()}
    assert len(out) == len(table)
    return out


def deviations(whole, parts):
    """The largest differences: values in sigmas, sigmas relative, redundancy numbers absolute, the rest relative to the column's size."""
    worst = {}

    def note(name, value):
        worst[name] = max(worst.get(name, 0.0), float(value))

    for kind in KEYS:
        a, b = keyed(whole[kind], kind), keyed(parts[kind], kind)
        assert a.keys() == b.keys()
        rows = [(a[k], b[k]) for k in a]
        for column in whole[kind].columns:
            x, y = ([r[i][column] for r in rows] for i in (0, 1))
            if not isinstance(x[0], float):
                assert x == y, column
                continue
            x, y = np.array(x), np.array(y)
            assert np.array_equal(np.isnan(x), np.isnan(y)), (kind, column)
            seen = np.isfinite(x)
            x, y = x[seen], y[seen]
            size = np.abs(x)
            sigma = {"value": "sigma", **{c: f"s{c}" for c in ("X", "Y", "Z", "X0", "Y0", "Z0", "omega_rad", "phi_rad", "kappa_rad")}}
            if kind != "observations" and column in sigma:
                size = np.array([r[0][sigma[column]] for r in rows])[seen]
            elif column in ("redundancy", "p_value") or column.startswith(("corr", "ellipse_azimuth")):
                size = np.ones(len(x))
            elif column not in ("sigma", *sigma.values()):
                size = np.full(len(x), size.max(initial=1e-300))
            if kind == "observations" and column not in ("observed", "sigma", "residual", "redundancy"):
                size = np.where(np.array([r[0]["redundancy"] for r in rows])[seen] > 1e-3, size, np.inf)  # else rounding is magnified
            use = size > 0.0
            assert x[~use] == pytest.approx(y[~use], rel=1e-13)
            if use.any():
                note(f"{kind}.{column}", (np.abs(x - y)[use] / size[use]).max())
    return worst


def compare(network, parts, folder, limit=1e-10, engine=None, effects=False, same_way=True, **options):
    a, whole = plain_tables(network, effects, **options)
    source = write_partition(network, parts, folder)
    with mock.patch.object(helmert_statistics, "MOST", helmert_statistics.MOST if effects else 0.0), open_engine(engine) as e:
        blocked = solve_blocked(source, e, **options)
        tables, told = gathered_tables(blocked, e), finish(blocked, e)
    assert blocked.converged and blocked.datum.name == a.datum.name and blocked.datum.count == a.datum.defect.count
    assert (blocked.joint.count, blocked.joint.unknowns, blocked.redundancy) == (a.count, a.numbering.count, a.redundancy)
    assert not same_way or len(blocked.history) == len(a.history)
    assert blocked.objective == pytest.approx(a.objective, rel=1e-12)
    assert told.redundancy_sum == pytest.approx(a.redundancy, rel=1e-10)
    found = deviations(whole, tables)
    wrong = {name: value for name, value in found.items() if value > limit and not name.endswith(("azimuth_rad", "effect"))}
    assert not wrong
    return blocked, told


@pytest.mark.parametrize("parts", [1, 2, 3, 5])
def test_control(parts, tmp_path):
    compare(aerial(), parts, tmp_path / "p")


@pytest.mark.parametrize("parts", [1, 2, 3, 5])
def test_free_network(parts, tmp_path):
    blocked, _ = compare(aerial(control=0), parts, tmp_path / "p")
    assert blocked.datum.count == 7 and "all object points" in blocked.datum.text


@pytest.mark.parametrize("parts", [2, 3])
def test_a_camera_for_each_image(parts, tmp_path):
    compare(aerial(per_image_cameras=True), parts, tmp_path / "p")


def test_all_columns_of_the_tables(tmp_path):
    compare(aerial(12), 2, tmp_path / "p", effects=True)


@pytest.mark.parametrize("datum", ["inner", "minimal"])
def test_damped_steps_do_not_move_the_datum(datum, tmp_path):
    network = aerial(12, points=150, seed=1, control=0, perturbation=20.0)
    blocked, _ = compare(network, 3, tmp_path / "p", limit=1e-6, same_way=False, datum=datum)  # damping goes other ways in parts
    assert any(h.accepted and h.damping > 0.0 for h in blocked.history)


def test_minimal_datum(tmp_path):
    network = aerial(control=0)
    a = baarda.adjust(network, datum="minimal")
    blocked, _ = compare(network, 3, tmp_path / "p", datum="minimal")
    assert sorted(blocked.datum.text.partition(": ")[2].split(", ")) == sorted(a.datum.text.partition(": ")[2].split(", "))


def test_distances_fixed_control_and_check_points(tmp_path):
    network = with_distances(aerial(16, control=4, control_sigma=0.0, checks=5), [(3, 40), (40, 80)])
    _, told = compare(network, 3, tmp_path / "p")
    assert sum(len(p.check_points) for p in told.parts) == 5


def test_directly_observed_images_and_cameras(tmp_path):
    network = aerial(16, control=0)
    states = np.array(network.images.states)
    states[:, :3] = 1
    given, sigmas = np.full((16, 6), np.nan), np.full((16, 6), np.nan)
    given[:, :3], sigmas[:, :3] = network.images.position, 0.5
    camera = network.cameras[0]
    seen = np.where(camera.states == 2, 1, camera.states).astype(np.int8)
    camera = replace(camera, states=seen, sigmas=np.where(seen == 1, np.maximum(1e-2 * np.abs(camera.values), 1e-9), np.nan))
    network = replace(network, images=replace(network.images, states=states, given=given, sigmas=sigmas), cameras=(camera,))
    compare(network, 3, tmp_path / "p")


def test_camera_positions_with_shared_lever_arm_and_strips(tmp_path):
    """Declared unknowns stand in the border, too."""
    network = aerial(20, control=4)
    rng = np.random.default_rng(3)
    arm, strip = np.zeros(20, dtype=np.intp), np.arange(20) // 10
    lever = np.array([0.2, -0.1, 0.4])
    values = network.images.position + np.einsum("nji,j->ni", network.images.rotation, lever) + 0.02 * rng.standard_normal((20, 3))
    covariances = np.broadcast_to(np.eye(3) * 0.05**2, (20, 3, 3)).copy()
    positions = CameraPositions(np.arange(20), arm, strip, np.tile(np.arange(10.0) - 4.5, 2), values, covariances)
    declared = (lever_arms(["a"], [lever], free=False), strips(["s1", "s2"], shift=True))
    network = replace(network, observations=(*network.observations, positions), declared=declared)
    source = write_partition(network, 2, tmp_path / "q")
    assert "strip" in {kind for kind, _ in source.border}
    compare(network, 2, tmp_path / "p")


def test_strongly_curved_start(tmp_path):
    """Damped and bent steps are those of the adjustment in one piece."""
    network = synthetic("ring", 12, points=60, perturbation=6.0).network
    a = baarda.adjust(network)
    blocked, _ = compare(network, 2, tmp_path / "p", limit=1e-9)
    assert [h.accepted for h in blocked.history] == [h.accepted for h in a.history]
    assert [h.damping for h in blocked.history] == pytest.approx([h.damping for h in a.history], rel=1e-6)


def test_not_kept_but_computed_again(tmp_path):
    source = write_partition(aerial(16), 3, tmp_path / "p")
    with open_engine() as e:
        kept, again = (solve_blocked(source, e, frugal=f) for f in (False, True))
        a, b = (gathered_tables(x, e) for x in (kept, again))
    assert kept.objective == again.objective
    assert all(np.array_equal(a["unknowns"][c], b["unknowns"][c]) for c in ("value", "sigma"))


@pytest.mark.parametrize("pool", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_any_executor(pool, tmp_path):
    import multiprocessing

    source = write_partition(aerial(12), 2, tmp_path / "p")
    made = pool(2) if pool is ThreadPoolExecutor else pool(2, multiprocessing.get_context("spawn"))
    with open_engine() as e:
        here = gathered_tables(solve_blocked(source, e), e)
    with made as executor, open_engine(executor) as e:
        there = gathered_tables(solve_blocked(source, e), e)
    assert all(np.array_equal(here["unknowns"][c], there["unknowns"][c]) for c in ("value", "sigma"))


# ---- the seam of the engine -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_border_against_dense_algebra(damping):
    """Reduced normal equations, right-hand sides, back-substitution and cofactors of a border, by dense matrices."""
    network = aerial(10, points=150)
    network = network.shifted(-network.centroid())
    groups = active_groups(network, np.ones(len(network.points.labels), dtype=bool))
    unknowns, state = unknowns_of(network), State.of(network)
    rank = rank_for(groups, state.points)
    lin = linearize(network, state, unknowns, Arrangement.of(groups, rank), 1)
    columns = np.concatenate([unknowns["camera"].columns, unknowns["image"].columns.reshape(-1, 6)[[2, 5, 7]].ravel()])
    columns = columns[columns >= 0]
    solver = BlockSolver.of(lin, analyse(lin, rank, state.points, border=columns), np.zeros(0, dtype=np.intp), damping)
    b, matrix = solver.border
    assert sorted(b) == sorted(columns)
    a = lin.design.toarray()
    n = a.T @ a
    inner = np.setdiff1d(np.arange(unknowns.count), b)
    damped = n + np.diag(damping * lin.scale**2 * np.isin(np.arange(len(n)), inner))
    g = np.linalg.solve(damped[np.ix_(inner, inner)], damped[np.ix_(inner, b)])
    schur = damped[np.ix_(b, b)] - damped[np.ix_(b, inner)] @ g
    s = np.sqrt(np.diag(n)[b])
    assert np.abs((matrix - schur) / np.outer(s, s)).max() < 1e-11
    rng = np.random.default_rng(1)
    y, x = rng.standard_normal(lin.count), rng.standard_normal(len(b)) / s
    c = a.T @ y
    assert np.abs((solver.reduced(y) - (c[b] - g.T @ c[inner])) / s).max() < 1e-9
    found, change = solver.expanded(y, x)
    expected = np.linalg.solve(damped[np.ix_(inner, inner)], c[inner]) - g @ x
    assert np.abs((found[inner] - expected) * lin.scale[inner]).max() < 1e-8
    assert np.array_equal(found[b], x) or np.allclose(found[b], x, rtol=1e-14)
    assert np.abs(change - a @ found).max() < 1e-8
    if damping == 0.0:
        more = np.diag(s**2)  # what the rest of the network adds
        whole = n.copy()
        whole[np.ix_(b, b)] += more
        q = np.linalg.inv(whole / np.outer(lin.scale, lin.scale)) / np.outer(lin.scale, lin.scale)
        given = solver.given(q[np.ix_(b, b)])
        hats = np.concatenate([np.einsum("nii->ni", h).ravel() for h in given.hat()])
        rows = np.concatenate([chunk.rows.ravel() for chunk in lin.chunks])
        assert np.abs(hats - np.einsum("ij,jk,ik->i", a, q, a)[rows]).max() < 1e-10
        part = helmert_statistics.PartSolver(solver, q[np.ix_(b, b)])
        rhs = rng.standard_normal((unknowns.count, 2)) * lin.scale[:, None]
        assert np.abs((part.solve(rhs) - q @ rhs) * lin.scale[:, None]).max() < 1e-8
        t, k, c = rng.standard_normal((unknowns.count, 2)), q @ rhs, np.diag([3.0, 5.0])
        moved = helmert_statistics.PartCofactors(part, unknowns.count, (t, k, c))
        expected = q - t @ k.T - k @ t.T + t @ c @ t.T
        every, mixed = np.arange(unknowns.count), np.abs(t) @ np.abs(k.T)
        size = np.sqrt(np.outer(np.diag(q), np.diag(q))) + mixed + mixed.T + np.abs(t) @ c @ np.abs(t.T)
        for got in (moved.solve(np.eye(unknowns.count)), moved.of(every)):
            assert (np.abs(got - expected) <= 1e-9 * size).all()


# ---- refusals -------------------------------------------------------------------------------------------------------------------------


def blocked_of(network, folder, parts=2, **options):
    source = write_partition(network, parts, folder)
    with open_engine() as e:
        return solve_blocked(source, e, **options)


def test_datum_is_not_defined_by_control(tmp_path):
    with pytest.raises(DatumDefect, match=r"free are .*datum defect 7"):
        blocked_of(aerial(12, control=0), tmp_path / "p", datum="control")


def test_partly_controlled_datum(tmp_path):
    network = aerial(16, control=2)
    blocked, _ = compare(network, 2, tmp_path / "p")
    assert blocked.datum.count == 1


def test_undetermined_border(tmp_path):
    network = aerial(12)
    network = network.with_camera_states(0, np.full(len(network.cameras[0].values), 2))
    values = np.array(network.cameras[0].values)
    network = replace(network, cameras=(network.cameras[0].with_values(values),))
    flat = replace(network.points, coordinates=network.points.coordinates)
    twice = replace(network, points=flat)
    images = twice.observations[0]
    few = images.selected(np.flatnonzero(images.images != 5))
    lost = replace(twice, observations=(few, images.selected(np.flatnonzero(images.images == 5)[:2])))
    lost = replace(lost, observations=(replace(few, name="most"), replace(lost.observations[1], name="few")))
    with pytest.raises(Singular, match="image"):
        blocked_of(lost, tmp_path / "p")


def test_no_redundancy(tmp_path):
    network = aerial(4, points=12, control=0)
    with pytest.raises((RedundancyNotPositive, Singular)):
        few = network.observations[0]
        blocked_of(replace(network, observations=(few.selected(np.arange(0, len(few), 3)),)), tmp_path / "p", parts=1, min_rays=0)


def test_options_that_do_not_go_with_parts(tmp_path):
    source = write_partition(aerial(12), 2, tmp_path / "p")
    with open_engine() as e:
        with pytest.raises(UsageError, match="--camera to split"):
            solve_blocked(source, e, camera="none")
        with pytest.raises(UsageError, match="least squares"):
            solve_blocked(source, e, robust="student")


def test_files_that_changed_are_refused(tmp_path):
    source = write_partition(aerial(12), 2, tmp_path / "p")
    file = source.place(1) / "points.csv"
    file.write_text(file.read_text() + "\n")
    with open_engine() as e, pytest.raises(baarda.errors.InputError, match="split again"):
        solve_blocked(source, e)


def test_too_little_memory_is_told_with_the_figure(tmp_path, monkeypatch):
    source = write_partition(aerial(12), 2, tmp_path / "p")
    monkeypatch.setattr(helmert_stand, "memory_limit", lambda: 3e5)
    with open_engine() as e, pytest.raises(NotEnoughMemory, match=r"part 0 would take .* GB of memory; the worker may take 0\.0003 GB"):
        solve_blocked(source, e)


def test_too_large_a_border_is_told_with_the_figure(tmp_path, monkeypatch):
    source = write_partition(aerial(12), 2, tmp_path / "p")
    with open_engine() as e, pytest.raises(NotEnoughMemory, match=r"border of \d+ unknowns needs about .* GB .* split into fewer parts"):
        monkeypatch.setattr(helmert.memory, "available", lambda: 1e6)
        monkeypatch.setattr(helmert, "DENSE", 1e9)
        solve_blocked(source, e)


def test_what_does_not_fit_in_one_piece_fits_in_parts(tmp_path, monkeypatch):
    """Under the same limit the plain run refuses, and the parts finish one after the other, computing again what they cannot keep."""
    network = aerial(24, points=1500)
    source = write_partition(network, 6, tmp_path / "p")
    told = []
    with open_engine() as e:
        needed = max(f.needed for f in solve_blocked(source, e).joint.facts)
        expected = gathered_tables(solve_blocked(source, e, frugal=True), e)
    limit = 1.2 * needed
    for module in (memory, helmert_stand.memory):
        monkeypatch.setattr(module, "available", lambda: limit)
    with pytest.raises(NotEnoughMemory, match="would take"):
        baarda.adjust(network, solver="block")
    with open_engine() as e:
        blocked = solve_blocked(source, e, tell=told.append)
        found = gathered_tables(blocked, e)
    assert any("computed again" in t for t in told)
    assert all(np.array_equal(expected["unknowns"][c], found["unknowns"][c]) for c in ("value", "sigma"))


# ---- the command line -----------------------------------------------------------------------------------------------------------------


def baarda_of(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("project") / "block"
    write_project(aerial(16, points=150, checks=3), folder)
    return folder


def test_split_adjust_and_adjust_again(project, tmp_path):
    run = baarda_of("split", project, "--parts", 3, "--out", tmp_path / "parts")
    assert run.exit_code == 0 and "part-002: " in run.stderr, run.output
    run = baarda_of("adjust", tmp_path / "parts", "--out", tmp_path / "out")
    assert run.exit_code == 0 and "Adjusted in 3 parts" in run.stdout, run.output
    assert "redundancy numbers, precision and tests of 3 parts, and their tables ...\nfigures and report ...\n" in run.stderr
    assert f"adjusted: s0 {json.loads((tmp_path / 'out' / 'result.json').read_text())['sigma0']['aposteriori']:.4g}, " in run.stderr
    whole = baarda_of("adjust", project, "--out", tmp_path / "whole", "--solver", "block")
    assert whole.exit_code == 0
    found, plain = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("out", "whole"))
    assert found["counts"] == plain["counts"]
    assert found["sigma0"]["aposteriori"] == pytest.approx(plain["sigma0"]["aposteriori"], rel=1e-12)
    assert found["parts"]["redundancy_sum"] == pytest.approx(found["counts"]["redundancy"], rel=1e-9)
    tests = {t["name"]: t for t in plain["tests"]}
    for t in found["tests"]:
        other = tests[t["name"]]
        assert t["null"] == other["null"] and t["law"] == other["law"] and t["rejected"] == other["rejected"]
        assert t["statistic"] == pytest.approx(other["statistic"], rel=1e-9)
        assert t.get("beyond") == other.get("beyond") and t.get("labels") == other.get("labels")
    assert [r["point"] for r in found["outliers"]] == [r["point"] for r in plain["outliers"]]
    rows = {r["point"]: r for r in plain["check_points"]}
    for r in found["check_points"]:
        assert r["dz"] == pytest.approx(rows[r["point"]]["dz"], rel=1e-8) and r["sz"] == pytest.approx(rows[r["point"]]["sz"], rel=1e-8)
    columns = [
        (tmp_path / n).read_text().splitlines()[0] for n in ("out/tables/observations/part-000.csv", "whole/tables/observations.csv")
    ]
    assert columns[0] == columns[1]
    again = baarda_of("adjust", tmp_path / "out" / "project", "--out", tmp_path / "again", "--quiet")
    assert again.exit_code == 0
    assert json.loads((tmp_path / "again" / "result.json").read_text())["iterations"] <= 2
    german = baarda_of("adjust", tmp_path / "parts", "--out", tmp_path / "out", "--language", "de")
    assert german.exit_code == 0 and "Ausgeglichen in 3 Teile" in german.stdout


def test_json_and_strict(project, tmp_path):
    baarda_of("split", project, "--parts", 2, "--out", tmp_path / "parts", "--quiet")
    run = baarda_of("adjust", tmp_path / "parts", "--json", "--quiet", "--strict", "--alpha-outlier", "0.2")
    assert run.exit_code == 1 and json.loads(run.stdout)["status"] == "converged" and "rejected: " in run.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--snoop"], "--snoop do"),
        (["--camera", "none"], "--camera do"),
        (["--robust", "student"], "--robust do"),
        (["--tables", "xml"], "--tables is csv or parquet"),
        (["--snoop-unit", "image"], "--snoop do"),
        (["--criterion", "bic"], "--criterion do"),
        (["--components-by", "camera"], "--components-by do"),
        (["--lever-arm", "0,0,1"], "--lever-arm do"),
        (["--position-model", "shift"], "--position-model do"),
    ],
)
def test_what_does_not_go_with_parts(arguments, message, project, tmp_path):
    baarda_of("split", project, "--parts", 2, "--out", tmp_path / "parts", "--quiet")
    run = baarda_of("adjust", tmp_path / "parts", "--out", tmp_path / "out", *arguments)
    assert run.exit_code == 2 and message in run.stderr and not (tmp_path / "out").exists()


def test_a_cluster_needs_parts(project):
    run = baarda_of("adjust", project, "--cluster", "local")
    assert run.exit_code == 2 and "first baarda split" in run.stderr


def test_too_many_parts(project, tmp_path):
    run = baarda_of("split", project, "--parts", 1000, "--out", tmp_path / "parts")
    assert run.exit_code == 2 and "too small for 1000 parts" in run.stderr and not (tmp_path / "parts").exists()


def test_long_tables_are_written_piece_by_piece(tmp_path, monkeypatch):
    monkeypatch.setattr(helmert_report, "AT_ONCE", 3)
    table = Table({"a": np.arange(8.0), "b": np.array(["x,y", *"bcdefgh"], dtype=object)})
    helmert_report.PartTables()(table, tmp_path / "t" / "part-000")
    assert (tmp_path / "t" / "part-000.csv").read_text() == table_csv(table)
