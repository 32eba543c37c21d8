"""How a command ends that is interrupted, asked to end, killed, or meets what nobody foresaw: one line, its exit code, nothing left."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from baarda.cli import app, main
from baarda.executors import open_workers
from baarda.formats import digest
from baarda.formats.project import write as write_project
from baarda.procedures.synthetic import synthetic
from baarda.report import page

SOURCE = Path(__file__).parent.parent / "src"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SOURCE), str(Path(__file__).parent)]), "NO_COLOR": "1"}
posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    place = tmp_path_factory.mktemp("block") / "b"
    write_project(synthetic("aerial", 3, points=12, seed=1).network, place)
    return place


def began(*arguments, code=None, cwd=None):
    command = [sys.executable, *(("-m", "baarda") if code is None else ("-c", code)), *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd, env=ENVIRONMENT, start_new_session=True
    )


def alive(group):
    """The processes of a group that run; what only waits to be collected does not."""
    out = subprocess.run(["ps", "-eo", "pgid=,stat=,pid="], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in out.splitlines()]
    return [pid for pgid, stat, pid in rows if pgid == str(group) and not stat.startswith("Z")]


def gone(group, seconds=10.0):
    until = time.monotonic() + seconds
    while alive(group) and time.monotonic() < until:
        time.sleep(0.1)
    return not alive(group)


# ---- what nobody foresaw -------------------------------------------------------------------------------------------------------------


def broken(*_, **__):
    raise ValueError("by\ndesign")


def test_what_nobody_foresaw_is_one_line_and_no_failed_gate(block, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "sections", broken)
    done = CliRunner().invoke(app, ["adjust", str(block), "--out", str(tmp_path / "r"), "--quiet"])
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("baarda: unforeseen ValueError: by design (report/result_folder.py, line ")
    assert list(tmp_path.iterdir()) == []


def test_every_verb_is_guarded():
    assert len(app.registered_commands) > 10
    for verb in app.registered_commands:
        assert hasattr(verb.callback, "__wrapped__"), verb.callback


def test_what_nobody_foresaw_before_a_verb(monkeypatch, capsys):
    monkeypatch.setattr("baarda.cli._VERBS", ("nothing",))
    monkeypatch.setattr(sys, "argv", ["baarda", "--version"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert "unforeseen ModuleNotFoundError" in capsys.readouterr().err


# ---- interrupted ---------------------------------------------------------------------------------------------------------------------

EARLY = """
import os, signal, sys
class Signals:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.{number})
sys.meta_path.insert(0, Signals())
sys.argv = ["baarda", "--help"]
from baarda.cli import main
main()
"""


@posix
@pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
@pytest.mark.parametrize("module", ["typer", "baarda.cli.base", "baarda.cli.lists"])
def test_interruption_during_the_imports_is_one_line(module, number, code):
    process = began(code=EARLY.format(module=module, number=number))
    out, told = process.communicate(timeout=30)
    assert (process.returncode, out, told) == (code, "", "baarda: interrupted, nothing was written\n")


def test_the_handlers_of_the_caller_come_back(monkeypatch, capsys):
    before = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
    monkeypatch.setattr(sys, "argv", ["baarda", "--version"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code in (0, None)
    assert capsys.readouterr().out.startswith("baarda ")
    assert [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)] == before


@posix
def test_a_request_to_end_leaves_nothing(block, tmp_path):
    process = began("adjust", block, "--out", "r", cwd=tmp_path)
    line = process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    _, told = process.communicate(timeout=30)
    assert line.startswith("iteration")
    assert process.returncode == 143
    assert told.splitlines()[-1] == "baarda: interrupted, nothing was written"
    assert list(tmp_path.iterdir()) == []


WORK = """
import sys, time
from baarda.executors import open_workers
if __name__ == "__main__":
    with open_workers(jobs=2) as workers:
        for outcome in workers.run(time.sleep, [0.0, 60.0, 60.0]):
            print("begun", flush=True)
"""


@posix
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_the_process_that_began_them(number, tmp_path):
    (tmp_path / "work.py").write_text(WORK)
    process = subprocess.Popen(
        [sys.executable, "work.py"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=tmp_path,
        env=ENVIRONMENT,
        start_new_session=True,
    )
    assert process.stdout.readline() == b"begun\n"
    assert len(alive(process.pid)) >= 3
    process.send_signal(number)
    process.wait(timeout=60)
    process.stdout.close()
    assert gone(process.pid), alive(process.pid)


@posix
def test_a_batch_that_is_asked_to_end_leaves_no_process_and_nothing_half_written(block, tmp_path):
    process = began("batch", block, SOURCE.parent / "src", "--out", "o", "--jobs", "2", cwd=tmp_path)
    process.stderr.readline()  # one source is no block: its row comes first
    process.send_signal(signal.SIGTERM)
    _, told = process.communicate(timeout=30)
    assert process.returncode == 143, told
    assert "interrupted; finished blocks are kept in o" in told
    assert gone(process.pid), alive(process.pid)
    assert [p for p in tmp_path.rglob("*") if p.name.startswith(".")] == []


@posix
def test_workers_that_are_given_up_have_ended():
    with open_workers(jobs=2) as workers:
        outcomes = workers.run(time.sleep, [0.0, 300.0, 300.0])
        next(outcomes)
        begun, processes = time.monotonic(), [child.pid for child in multiprocessing.active_children()]
        outcomes.close()
    assert time.monotonic() - begun < 100.0  # does not wait for them
    assert len(processes) == 2
    for process in processes:  # the list of children may lag: the thread of the pool that collects them writes it
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


# ---- where a result comes from -------------------------------------------------------------------------------------------------------


def test_a_result_in_the_source_is_no_part_of_it(block, tmp_path):
    shutil.copytree(block, tmp_path / "p")
    before = digest(tmp_path / "p")
    done = CliRunner().invoke(app, ["adjust", str(tmp_path / "p"), "--out", str(tmp_path / "p" / "baarda-out"), "--quiet"])
    assert done.exit_code == 0, done.stderr
    assert json.loads((tmp_path / "p" / "baarda-out" / "result.json").read_text())["source"]["sha256"] == before
    assert digest(tmp_path / "p") == before


@pytest.mark.parametrize(
    ("head", "other", "counts"),
    [
        ("result.json", None, False),
        ("batch.json", None, False),
        ("result.json", "thesis.txt", True),  # somebody's own file lies in it
        ("index.json", None, True),
    ],
)
def test_only_results_of_ours_are_left_out_of_the_hash(head, other, counts, tmp_path):
    (tmp_path / "points.csv").write_text("point\n1\n")
    before = digest(tmp_path)
    inner = tmp_path / "deep" / "r"
    (inner / "tables").mkdir(parents=True)
    (inner / head).write_text('{\n "schema": "baarda.something/1"\n}')
    (inner / "run.json").write_text("{}")
    (inner / "tables" / "points.csv").write_text("1")
    if other is not None:
        (inner / other).write_text("years of work")
    assert (digest(tmp_path) != before) == counts
    own = digest(inner)  # as a source of its own it counts
    (inner / "tables" / "points.csv").write_text("2")
    assert digest(inner) != own
    (inner / "run.json").unlink()
    (inner / head).write_text('{"schema": "of somebody/1"}')
    assert digest(tmp_path) != before


@posix
@pytest.mark.parametrize("verb", ["adjust", "batch"])
def test_a_name_that_is_no_text_is_refused(verb, block, tmp_path):
    try:
        shutil.copytree(block, os.fsdecode(os.fsencode(tmp_path) + b"/bad\xff"))
    except (OSError, UnicodeError):
        pytest.skip("the file system takes UTF-8 names only")
    process = began(verb, os.fsdecode(os.fsencode(tmp_path) + b"/bad\xff"), "--out", "o", cwd=tmp_path)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 2
    assert told.count("\n") == 1
    assert "bad\\udcff: the name is not UTF-8" in told
    assert not (tmp_path / "o").exists()


@posix
def test_a_file_of_the_source_whose_name_is_no_text_is_hashed(tmp_path):
    (tmp_path / "points.csv").write_text("point\n1\n")
    before = digest(tmp_path)
    try:
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/x\xff")).touch()
    except (OSError, UnicodeError):
        pytest.skip("the file system takes UTF-8 names only")
    assert digest(tmp_path) != before
