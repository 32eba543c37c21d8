"""Many blocks: rows, resumption, failures, comparison; the same results from one process, several, and a cluster."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from baarda.cli import app
from baarda.errors import OutputError, UsageError
from baarda.executors import open_workers
from baarda.formats.project import write as write_project
from baarda.procedures import batch
from baarda.procedures.batch import BatchOptions, block_jobs, block_name, finished, folder_sha256, run_batch, sources
from baarda.procedures.block_comparison import compare_blocks
from baarda.procedures.synthetic import synthetic
from baarda.report.batch_report import begin, html, result_json, sections, summary_table, verdict, write_summary
from cluster_tasks import light


def make_blocks(folder, count=7):
    for k in range(count):
        write_project(synthetic("aerial", 3, points=12, seed=k).network, folder / f"b{k}")
    return folder


def contents_of(folder):
    files = (p for p in Path(folder).rglob("*") if p.is_file() and p.name != "run.json")
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    return make_blocks(tmp_path_factory.mktemp("blocks"))


def jobs_of(blocks, out, **options):
    options = {"settings": {"jobs": 1}, **options}
    return block_jobs(sources([f"{blocks}/b*"]), out, BatchOptions(**options))


@pytest.fixture(scope="module")
def plain(blocks, tmp_path_factory):
    """The run of one process, and its rows."""
    out = tmp_path_factory.mktemp("plain") / "out"
    begin(out)
    rows = run_batch(jobs_of(blocks, out), light)
    write_summary(compare_blocks(rows), out)
    return out, rows


def test_rows_are_those_of_single_adjustments(blocks, plain):
    import baarda

    _, rows = plain
    for k, row in enumerate(rows):
        a = baarda.adjust(baarda.read(blocks / f"b{k}"))
        assert row["sigma0"] == a.sigma0 and row["redundancy"] == a.redundancy
        assert row["status"] == "converged" and row["exit_code"] == 0 and row["source"] == f"{blocks}/b{k}"
        (tests,) = [t for t in baarda.test(a) if t.name == "data_snooping"]
        worst = int(np.nanargmax(np.abs(tests.statistic)))
        assert row["worst_observation"] == tests.labels[worst] and row["worst_statistic"] == tests.statistic[worst]


def test_processes_give_the_same_bytes(blocks, plain, tmp_path):
    out = tmp_path / "out"
    begin(out)
    with open_workers(None, 2) as workers:
        rows = run_batch(jobs_of(blocks, out), light, workers)
    write_summary(compare_blocks(rows), out)
    mine = contents_of(out)
    assert mine == contents_of(plain[0]) and "blocks/" in str(sorted(mine))


def test_finished_blocks_are_kept_and_all_else_is_done_again(blocks, plain, tmp_path):
    mine, out = tmp_path / "blocks", tmp_path / "out"
    shutil.copytree(blocks, mine)
    jobs = jobs_of(mine, out)
    begin(out)
    before = run_batch(jobs, light)
    told = []
    (jobs[0].folder / "tables" / "points.csv").write_text("changed")
    (jobs[1].folder / "report.html").unlink()
    jobs[2].record.unlink()
    table = mine / "b3" / "images.csv"
    table.write_text(table.read_text() + "\n")
    shutil.rmtree(jobs[4].folder)
    (out / "blocks" / f".{jobs[5].name}-half").mkdir()
    rows = run_batch(jobs, light, progress=lambda done, total, row: told.append(bool(row.get("kept"))))
    assert told == [False] * 5 + [True] * 2
    assert [r["result_sha256"] for r in rows] == [r["result_sha256"] for r in before]
    assert not list((out / "blocks").glob(".*"))
    other = jobs_of(mine, out, levels={"alpha": 0.01})
    assert [finished(j) for j in other] == [None] * 7 and finished(jobs[0]) is not None
    threads = jobs_of(mine, out, settings={"jobs": 2})
    assert all(finished(j) is not None for j in threads)


def test_a_file_that_a_script_names_is_noticed(tmp_path, data):
    source = tmp_path / "script"
    shutil.copytree(data("dbat_sxb"), source)
    jobs = block_jobs([str(source / "sxb.xml")], tmp_path / "out", BatchOptions(settings={"jobs": 1}))
    begin(tmp_path / "out")
    run_batch(jobs, light)
    assert finished(jobs[0]) is not None
    named = [p for p in json.loads(jobs[0].record.read_text())["inputs"] if p != jobs[0].place]
    assert named and all(str(source) in p for p in named)
    Path(named[0]).write_text(Path(named[0]).read_text() + "\n")
    assert finished(jobs[0]) is None


def test_failures_are_rows(blocks, tmp_path):
    mine = tmp_path / "in"
    shutil.copytree(blocks, mine)
    (mine / "b1" / "points.csv").write_text("nonsense\n1\n")
    (mine / "b2" / "image_points.csv").write_bytes((mine / "b2" / "image_points.csv").read_bytes()[:700])
    out = tmp_path / "out"
    begin(out)
    rows = run_batch(jobs_of(mine, out), light)
    assert [r["status"] for r in rows].count("converged") == 5
    bad = [r for r in rows if r["status"] == "failed"]
    assert len(bad) == 2 and all(r["message"] and r["exit_code"] in (2, 3) for r in bad)
    assert "points.csv" in bad[0]["message"] and str(mine) in bad[0]["message"]
    assert len(list((out / "blocks").iterdir())) == 5
    study = compare_blocks(rows)
    assert study.exit_code == max(r["exit_code"] for r in bad)
    assert any(s.startswith("Failed, without a result") for s in verdict(study))


def test_unforeseen_errors_are_rows_too(blocks, tmp_path, monkeypatch):
    def wrong(*args, **kwargs):
        raise ZeroDivisionError("by design")

    monkeypatch.setattr(batch, "analyse", wrong)
    rows = run_batch(jobs_of(blocks, tmp_path / "out")[:2], light)
    assert [r["message"] for r in rows] == ["unforeseen ZeroDivisionError: by design"] * 2


def test_outlying_blocks_are_found_and_equal_ones_are_not():
    rng = np.random.default_rng(5)

    def rows(scales):
        df = 150
        return [
            {**dict.fromkeys(batch.COLUMNS), "block": f"b{i}", "status": "converged", "redundancy": df, "sigma0": s * np.sqrt(c / df)}
            for i, (s, c) in enumerate(zip(scales, rng.chisquare(df, len(scales)), strict=True))
        ]

    scales = np.ones(60)
    scales[[7, 31]] = 40.0, 1.8  # the coarse one must not hide the fine one, nor make others look too small
    found = compare_blocks(rows(scales))
    assert found.outlying == ("b7", "b31") and found.bartlett.rejected and found.pooled == pytest.approx(1.0, abs=0.02)
    wrong = sum(bool(compare_blocks(rows(np.ones(40))).outlying) for _ in range(200))
    assert wrong <= 0.05 * 200 + 4 * np.sqrt(200 * 0.05 * 0.95)
    assert compare_blocks(rows(np.ones(1))).left_out


def test_names_are_stable_and_different():
    names = [block_name(s) for s in ("a/b", "a__b", "a-b", "a/../a/b", "../a/b", "x" * 300, "y" + "x" * 299, "ä/β", "a b", "a\nb")]
    assert len(set(names)) == len(names) - 1 and names[0] == names[3]  # the fourth is the first
    assert all(len(n) <= 130 and "/" not in n and not n.startswith(".") for n in names)


def test_sources_and_folders_that_make_no_sense(blocks, tmp_path):
    with pytest.raises(UsageError, match="nothing matches"):
        sources([f"{blocks}/none*"])
    with pytest.raises(UsageError, match="lies in the folder of the batch"):
        block_jobs([str(blocks / "b0")], blocks, BatchOptions())
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(OutputError, match="choose another place"):
        begin(tmp_path)


def test_summary_table_and_page(plain):
    out, rows = plain
    study = compare_blocks(rows)
    document = json.loads((out / "batch.json").read_text())
    assert document == json.loads(json.dumps(result_json(study))) and document["schema"] == "baarda.batch/1"
    assert document["counts"] == {"blocks": 7, "converged": 7, "not_converged": 0, "failed": 0}
    lines = (out / "tables" / "blocks.csv").read_text().splitlines()
    assert len(lines) == 8 and lines[0].startswith("block,source,status,message")
    assert float(lines[1].split(",")[lines[0].split(",").index("sigma0")]) == rows[0]["sigma0"]
    assert list(summary_table(study).columns) == [*batch.COLUMNS, "outlying"]
    page = html(study, sections(study))
    assert page.count("<svg") == 1 and rows[3]["block"] in page
    for row in rows:
        assert row["result_sha256"] == folder_sha256(out / "blocks" / row["block"])


def test_german_page(plain):
    from baarda.report.translation import language

    study = compare_blocks(plain[1])
    with language("de"):
        said, titles = verdict(study), [s.title for s in sections(study)]
        page = html(study, sections(study))
    assert said[0].startswith("7 Blöcke, davon 7 konvergiert und getestet") and titles[0] == "Urteil"
    assert 'lang="de"' in page and titles[1:] == ["Vergleich der Varianzfaktoren", "Blöcke"]


def test_command_line(blocks, tmp_path):
    out, two = tmp_path / "out", tmp_path / "two"
    shutil.copytree(blocks / "b0", two / "b0")
    (two / "bad.txt").write_text("nonsense")
    run = CliRunner().invoke(app, ["batch", f"{two}/b*", "--out", str(out), "--jobs", "1"])
    assert run.exit_code == 2 and "1 of 2 blocks have no tested result" in run.stderr and "1 of 2 blocks converged" in run.stdout
    lines = run.stderr.splitlines()
    first, last = (next(line for line in lines if line.startswith(f"{k} of 2  ")) for k in (1, 2))
    assert first.endswith(" s left") and not last.endswith("left")
    full = next(row["message"] for row in json.loads((out / "batch.json").read_text())["blocks"] if row["message"])
    assert len(full) > 200 and full not in run.stderr and f"{full[:140]}" in last and last.endswith(" ...")
    assert full[:140] in lines[-1] and lines[-1].endswith(" ...")
    folder = out / "blocks" / block_name(str(two / "b0"))
    assert json.loads((folder / "result.json").read_text())["schema"] == "baarda.result/1" and (folder / "report.html").is_file()
    (two / "bad.txt").unlink()
    again = CliRunner().invoke(app, ["batch", f"{two}/b*", "--out", str(out), "--jobs", "1", "--json"])
    assert again.exit_code == 0 and "kept" in again.stderr and "left" not in again.stderr
    assert json.loads(again.stdout) == json.loads((out / "batch.json").read_text())
    for wrong in (["--alpha", "2"], ["--tables", "xls"], ["--language", "xx"], ["--criterion", "none"]):
        refused = CliRunner().invoke(app, ["batch", f"{two}/b*", "--out", str(tmp_path / "none"), *wrong])
        assert refused.exit_code == 2 and not (tmp_path / "none").exists()
