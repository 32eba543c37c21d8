"""Residuals in partitioned Parquet: the same numbers as from one table, the same bytes from any workers, faults named, passes continued."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from baarda.cli import app
from baarda.errors import InputError, NotEnoughMemory, UsageError
from baarda.executors import TaskFailed, Workers, open_workers
from baarda.formats.residual_lake import footer_sha256, is_lake, open_lake, read_pieces
from baarda.procedures import lake_study
from baarda.procedures.lake_study import group_moments, pass_over, study_lake
from baarda.procedures.lake_sums import GroupSums, PartJob, bound, condense_file
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.residual_study import study
from baarda.report.lake_report import run_lake
from baarda.report.translation import language

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
QUICK = StudyOptions(laws=("normal",), replicas=19)
ROWS, FILES, IMAGES = 9000, 5, 40


def columns(k):
    rng = np.random.default_rng(k)
    image = rng.integers(0, IMAGES, ROWS)
    sigma, r = rng.uniform(0.5, 2.0, ROWS), rng.uniform(0.3, 1.0, ROWS)
    v = 1.3 * rng.standard_normal(ROWS) * sigma * np.sqrt(r) * np.where(image == 7, 1.2, 1.0)
    return {"residual": v, "image": image, "sigma": sigma, "redundancy": r}


def make_lake(folder, kind=float, kept=("residual", "image")):
    for k in range(FILES):
        made = {n: v.astype(kind) if n == "residual" else v for n, v in columns(k).items() if n in kept}
        if k % 2 and "image" in made:
            made["image"] = pa.array([str(i) for i in made["image"]]).dictionary_encode()  # text here, whole numbers there
        place = folder / f"part={k // 2}"
        place.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(made), place / f"{k}.parquet", row_group_size=2500, write_page_checksum=True)
    (folder / "_SUCCESS").write_text("")
    (folder / ".hidden.parquet").write_text("not one of them")
    return folder


def whole(*names):
    parts = [columns(k) for k in range(FILES)]
    return [np.concatenate([p[n] for p in parts]) for n in names]


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    return make_lake(tmp_path_factory.mktemp("raw"))


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    return make_lake(tmp_path_factory.mktemp("full"), kept=("residual", "image", "sigma", "redundancy"))


def agree(mine, theirs):
    """Two studies have the same moments, tests and laws."""
    for name in ("n", "mean", "deviation", "skewness", "kurtosis", "redundancy", "sigma0"):
        if getattr(theirs, name) is not None:
            assert getattr(mine, name) == pytest.approx(getattr(theirs, name), rel=1e-8, abs=1e-8), name
    assert mine.kind == theirs.kind and mine.set_aside == theirs.set_aside
    for t in mine.tests:
        assert t.statistic == pytest.approx(theirs.test(t.name).statistic, rel=1e-6), t.name
    for a, b in zip(mine.laws.laws, theirs.laws.laws, strict=True):
        assert a.fit.log_likelihood == pytest.approx(b.fit.log_likelihood, rel=1e-9)
        assert a.fit.parameters == pytest.approx(b.fit.parameters, rel=1e-3, abs=1e-4)
        assert a.fit.statistic == pytest.approx(b.fit.statistic, rel=0.5)  # classes end between bins


def agree_in_groups(mine, theirs, order):
    at = [mine.names.index(n) for n in order]
    for name in ("counts", "means", "variances", "df"):
        assert np.allclose(getattr(mine, name)[at], getattr(theirs, name), rtol=1e-9, atol=1e-12), name
    for name in ("bartlett", "bartlett_uncorrected"):
        assert mine.test(name).statistic == pytest.approx(theirs.test(name).statistic, rel=1e-8)
    each = np.asarray(mine.test("variance_per_group").p_value)[at]
    assert np.allclose(each, theirs.test("variance_per_group").p_value, rtol=1e-6, atol=1e-12)
    assert mine.test("brown_forsythe").statistic == pytest.approx(theirs.test("brown_forsythe").statistic, rel=0.1)


@pytest.mark.parametrize("options", [QUICK, StudyOptions(laws=("normal", "modulated_normal"), replicas=99, loc=0.0)])
def test_raw_residuals_as_from_one_table(raw, options):
    v, image = whole("residual", "image")
    found, passed = study_lake(open_lake(raw), options)
    theirs = study(v, [str(i) for i in image], options=options)
    agree(found.study, theirs)
    agree_in_groups(found.study.groups, theirs.groups, theirs.groups.names)
    assert passed.sums.rows == len(v) and found.study.values.min() == v.min() and found.study.values.max() == v.max()


def test_standardised_residuals_as_from_one_table(full):
    v, image, sigma, r = whole("residual", "image", "sigma", "redundancy")
    found, _ = study_lake(open_lake(full), QUICK)
    theirs = study(v, [str(i) for i in image], sigma, r, QUICK)
    agree(found.study, theirs)
    agree_in_groups(found.study.groups, theirs.groups, theirs.groups.names)
    rules = {x.symbol: x for x in theirs.scale_rules}
    mine = {x.symbol: x for x in found.study.scale_rules}
    assert set(mine) == {"S_o", "Q_v"} and mine["Q_v"].rejected == rules["Q_v"].rejected
    assert mine["S_o"].deviation == pytest.approx(found.study.sigma0)


def test_weighted_residuals_and_rows_set_aside(tmp_path):
    rng = np.random.default_rng(8)
    v, sigma, r = rng.standard_normal(4000), np.full(4000, 2.0), np.where(np.arange(4000) % 10, 0.5, 0.0)
    parquet.write_table(pa.table({"residual": v, "sigma": sigma, "redundancy": r}), tmp_path / "a.parquet")
    found, _ = study_lake(open_lake(tmp_path), QUICK)
    assert found.study.set_aside == 400 and found.study.n == 3600 and found.study.groups is None
    agree(found.study, study(v, None, sigma, r, QUICK))
    parquet.write_table(pa.table({"residual": v, "sigma": sigma}), tmp_path / "a.parquet")
    agree(study_lake(open_lake(tmp_path), QUICK)[0].study, study(v, None, sigma, None, QUICK))


def test_shape_of_the_groups(raw):
    v, image = whole("residual", "image")
    found, _ = study_lake(open_lake(raw), QUICK)
    skewness, kurtosis = group_moments(found)
    for name in ("0", "7", "39"):
        i, x = found.groups.names.index(name), v[image == int(name)]
        d = (x - x.mean()) / x.std()
        assert skewness[i] == pytest.approx(np.mean(d**3), abs=1e-9) and kurtosis[i] == pytest.approx(np.mean(d**4), rel=1e-9)
        assert found.medians[i] == pytest.approx(np.median(x), abs=0.03 * x.std())
        assert found.deviations[i] == pytest.approx(1.4826 * np.median(np.abs(x - np.median(x))), rel=0.05)
        assert found.groups.counts[i].sum() == len(x)


def test_sums_do_not_depend_on_the_pieces(raw, monkeypatch):
    lake = open_lake(raw)
    one = condense_file(PartJob(lake, 1, 0.1)).sums
    monkeypatch.setattr("baarda.procedures.lake_sums.PIECE", 1234)
    many = condense_file(PartJob(lake, 1, 0.1)).sums
    assert np.array_equal(one.condensed.counts, many.condensed.counts) and np.array_equal(one.condensed.squares, many.condensed.squares)
    assert np.allclose(one.groups.sums[one.groups.places(many.groups.names)], many.groups.sums, rtol=1e-12)
    assert one.groups.counts.sum() == many.groups.counts.sum() == ROWS


def test_merging_groups_keeps_their_order():
    a, b = GroupSums(), GroupSums()
    x = np.array([1.0, -2.0, 3.0])
    a.add(np.array([0, 1, 0]), ("p", "q"), x, x, None)
    b.add(np.array([0, 1, 2]), ("q", "r", "p"), x, x, None)
    a.merge(b.trimmed())
    assert a.names == ("p", "q", "r") and a.sums[:3, 0].tolist() == [3.0, 2.0, 1.0] and a.sums[:3, 1].tolist() == [7.0, -1.0, -2.0]
    assert a.counts[:3].sum(axis=1).tolist() == [3, 2, 1] and sorted(a.counts.sum(axis=0).tolist()) == [2, 2, 2]


def folder_bytes(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file() and p.name != "run.json"}


def test_processes_give_the_same_bytes(raw, tmp_path):
    run_lake(raw, tmp_path / "one", options=QUICK)
    with open_workers(None, 2) as workers:
        run_lake(raw, tmp_path / "two", options=QUICK, workers=workers)
    assert folder_bytes(tmp_path / "one") == folder_bytes(tmp_path / "two")


def test_a_corrupt_file_is_named_and_the_pass_goes_on_afterwards(raw, tmp_path):
    mine = tmp_path / "lake"
    shutil.copytree(raw, mine)
    bad = mine / "part=1" / "3.parquet"
    good = bad.read_bytes()
    told, out = [], tmp_path / "out"
    for broken in (good[:-100], good[: len(good) // 3], b"", b"PAR1" + bytes(200), good[:300] + bytes(900) + good[1200:]):
        bad.write_bytes(broken)
        with pytest.raises((TaskFailed, InputError), match=r"part=1/3.parquet") as found:
            run_lake(mine, out, options=QUICK)
        assert found.value.exit_code == 2 and not out.exists()
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["out.unfinished.npz"]
    bad.write_bytes(good)
    run_lake(mine, out, options=QUICK, tell=told.append)
    assert "3 files had been read by an earlier run" in told and not (tmp_path / "out.unfinished.npz").exists()
    run_lake(raw, tmp_path / "plain", options=QUICK)
    mine, plain = folder_bytes(out), folder_bytes(tmp_path / "plain")
    for name in set(plain) - {"result.json", "report.html"}:  # these tell the path
        assert mine[name] == plain[name], name
    assert json.loads(mine["result.json"])["source"]["sha256"] == json.loads(plain["result.json"])["source"]["sha256"]


def test_the_time_left_does_not_count_what_an_earlier_pass_read(monkeypatch, capsys):
    from types import SimpleNamespace

    from baarda.cli import residuals as verb
    from baarda.report import lake_report

    now = [0.0]

    def passes(*_, progress, **__):
        for done in (4, 5, 6, 10):  # 3 of 10 had been read
            now[0] += 10.0 if done < 10 else 40.0
            progress(done, 10, 1000 * done)

    monkeypatch.setattr(verb, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(lake_report, "run_lake", passes)
    verb.study_lake("lake", None, (None,) * 4, QUICK, {}, (None, 1), False, 0.0)
    assert capsys.readouterr().err.splitlines() == [
        " 4 of 10 files, 4000 rows, 10 s, about 60 s left",
        " 5 of 10 files, 5000 rows, 20 s, about 50 s left",
        " 6 of 10 files, 6000 rows, 30 s, about 40 s left",
        "10 of 10 files, 1e+04 rows, 70 s",
        "laws of errors, fitted and simulated; figures and tables ...",
    ]


def test_an_earlier_pass_over_other_files_is_not_gone_on_with(raw, tmp_path):
    mine, saved = tmp_path / "lake", tmp_path / "saved.npz"
    shutil.copytree(raw, mine)
    lake = open_lake(mine)

    class Stopping(Workers):
        def run(self, function, items, ahead=None, again=()):
            yield from list(super().run(function, items, ahead, again))[:3]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pass_over(lake, None, Stopping(), saved=saved)
    assert pass_over(lake, None, saved=saved).continued == 3
    assert pass_over(lake, 0.25, saved=saved).continued == 0
    file = mine / lake.files[2]
    parquet.write_table(parquet.ParquetFile(file).read().slice(1), file)
    assert pass_over(open_lake(mine), None, saved=saved).continued == 0
    saved.write_bytes(b"nonsense")
    assert pass_over(lake, None, saved=saved).continued == 0


@pytest.mark.parametrize(
    ("column", "values", "said"),
    [
        ("residual", [0.1, None, 0.3], r"a.parquet: row 2: residual is missing"),
        ("residual", [0.1, 0.2, float("nan")], r"a.parquet: row 3: residual is not a finite number"),
        ("sigma", [0.0, 1.0, 1.0], r"row 1: sigma must be positive: 0"),
        ("redundancy", [0.5, 0.5, 1.5], r"row 3: redundancy must lie between 0 and 1: 1.5"),
        ("residual", ["a", "b", "c"], r"column 'residual' holds string"),
    ],
)
def test_rows_that_cannot_be_used_are_named(tmp_path, column, values, said):
    good = {"residual": [0.1, 0.2, 0.3], "sigma": [1.0, 1.0, 1.0], "redundancy": [0.5, 0.5, 0.5]}
    parquet.write_table(pa.table({**good, column: values}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match=said):
        list(read_pieces(open_lake(tmp_path), 0))


def test_groups_from_folders_and_missing_columns(tmp_path):
    for block in ("east", "west%20side"):
        place = tmp_path / f"block={block}"
        place.mkdir()
        parquet.write_table(pa.table({"residual": np.arange(10.0)}), place / "a.parquet")
    lake = open_lake(tmp_path, group="block")
    assert [p.names for i in range(2) for p in read_pieces(lake, i)] == [("east",), ("west side",)]
    parquet.write_table(pa.table({"other": np.arange(10.0)}), tmp_path / "block=east" / "b.parquet")
    with pytest.raises(InputError, match=r"b.parquet: column 'residual' is missing"):
        list(read_pieces(open_lake(tmp_path), 1))
    with pytest.raises(InputError, match="no Parquet file lies below it"):
        open_lake(tmp_path / "block=none")
    with pytest.raises(InputError, match="it has no footer"):
        (tmp_path / "c.parquet").write_text("words, words, words, words")
        footer_sha256(open_lake(tmp_path), 3)
    assert not is_lake(tmp_path / "c.parquet") and is_lake(tmp_path)


def test_too_little_to_study(tmp_path):
    parquet.write_table(pa.table({"residual": np.ones(2000)}), tmp_path / "a.parquet")
    with pytest.raises(UsageError, match="all 2000 residuals are equal"):
        study_lake(open_lake(tmp_path), QUICK)
    parquet.write_table(pa.table({"residual": np.arange(50.0)}), tmp_path / "a.parquet")
    with pytest.raises(UsageError, match="from 1000 on"):
        study_lake(open_lake(tmp_path), QUICK)
    with pytest.raises(UsageError, match="automatic classes"):
        study_lake(open_lake(tmp_path), StudyOptions(classes=(-1.0, 0.0, 1.0)))


def test_memory_is_refused_with_the_figure(raw, monkeypatch):
    small = Workers()
    small.memory = 300e6
    with pytest.raises(NotEnoughMemory, match=r"needs 0.60 GB of memory at least.*may take 0.30 GB"):
        study_lake(open_lake(raw), QUICK, small)
    monkeypatch.setattr("baarda.procedures.lake_sums.memory_limit", lambda: bound(IMAGES - 1, 9))
    with pytest.raises(TaskFailed, match=r"0.parquet: 40 groups in \d+ bins need 0.60 GB of memory; the worker may take 0.60 GB") as found:
        study_lake(open_lake(raw), QUICK)
    assert found.value.exit_code == 4


def test_addresses_of_fsspec(raw, tmp_path):
    pytest.importorskip("fsspec")
    here = pass_over(open_lake(raw))
    there = pass_over(open_lake(f"file://{raw}"))
    assert here.sha256 == there.sha256 and np.array_equal(here.sums.groups.sums, there.sums.groups.sums)
    with pytest.raises(InputError, match="no such kind of store"):
        open_lake("nowhere://bucket/lake")
    with pytest.raises(InputError, match="no Parquet file"):
        open_lake(f"file://{tmp_path}/none")


def test_german_report(raw, tmp_path):
    out = run_lake(raw, tmp_path / "de", options=QUICK, spoken="de")
    english = run_lake(raw, options=QUICK)
    assert out.document == english.document and "45000" in out.verdict[0] and out.verdict != english.verdict
    page = (tmp_path / "de" / "report.html").read_text()
    assert "5 Dateien mit 45000 Zeilen wurden in einem Durchgang gelesen" in page
    with language("de"):
        assert lake_study  # the language ends with the block


def test_command_line(raw, tmp_path):
    out = tmp_path / "out"
    run = CliRunner().invoke(app, ["residuals", str(raw), "--out", str(out), "--jobs", "1", "--replicas", "19", "--json"])
    assert run.exit_code == 0, run.output
    document = json.loads(run.stdout)
    assert document["counts"] == {"values": 45000, "set_aside": 0, "groups": 40} and document["source"]["format"] == "parquet"
    assert "5 files" in run.stderr and "memory of a worker: 600 MB" in run.stderr
    assert "5 of 5 files, 4.5e+04 rows, " in run.stderr and run.stderr.count(" left") == 0  # a short pass tells only its end
    rows = (out / "tables" / "histograms.csv").read_text().splitlines()
    assert sum(int(line.rsplit(",", 1)[1]) for line in rows[1:]) == 45000
    assert json.loads((out / "run.json").read_text())["peak_memory_of_a_worker"] > 0
    table = tmp_path / "v.csv"
    table.write_text("residual\n" + "\n".join(map(str, range(30))))
    wrong = CliRunner().invoke(app, ["residuals", str(table), "--cluster", "local", "--out", str(tmp_path / "no")])
    assert wrong.exit_code == 2 and "--cluster is for a folder or an address of partitioned Parquet" in wrong.stderr
