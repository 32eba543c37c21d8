"""`baarda residuals` on broken input: one message that names the file, the exit code of the contract, nothing left behind."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from baarda.cli import app
from baarda.cli import residuals as verb

GOOD = "residual\n" + "\n".join(f"{v:.6f}" for v in np.random.default_rng(1).standard_normal(60)) + "\n"


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["residuals", *arguments, "--replicas", "19"])
    return done.exit_code, done.output


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("residual\n2\n2\n2\n2\n", [], "are equal (2): nothing can be tested"),
        ("residual\n1\n2\nnan\n", [], "line 4: residual is not a finite number"),
        ("residual\n1\ninf\n3\n", [], "line 3: residual is not a finite number"),
        ("residual\n1\n2\n", [], "has 2 values; at least 3"),
        ("residual,image\n1,a\n,b\n3,c\n", [], "line 3: residual is missing"),
        ("residual,sigma\n1,1\n2,-1\n3,1\n", [], "line 3: sigma must be positive"),
        ("residual,s\n1,1\n2,nan\n3,1\n", ["--sigma-column", "s"], "line 3: s is not a finite number"),
        ("residual,r\n1,1\n2,2\n3,1\n", ["--redundancy-column", "r"], "line 3: r must lie between 0 and 1"),
        (GOOD, ["--classes", "-1,0,1", "--ends", "closed"], "do not cover"),
        (GOOD, ["--classes", "1,0,-1"], "class limits must ascend"),
        (GOOD, ["--classes", "1,2"], "at least three"),
        (GOOD, ["--classes", "-1,x,1"], "a list of numbers"),
        (GOOD, ["--ends", "closed"], "closed end classes need class limits"),
        (GOOD, ["--ends", "half"], "ends are 'open' or 'closed'"),
        (GOOD, ["--mean", "nan"], "loc must be finite"),
        (GOOD, ["--alpha", "0"], "alpha"),
        (GOOD, ["--column", "w"], "column 'w' is missing"),
    ],
)
def test_one_message_and_exit_code_2(tmp_path, text, options, words):
    (tmp_path / "v.csv").write_text(text)
    code, said = run(str(tmp_path / "v.csv"), "--out", str(tmp_path / "out"), *options)
    assert code == 2, said
    last = said.strip().splitlines()[-1]
    assert last.startswith("baarda: ") and words in last
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("n", [3, 4, 7, 9, 12])
def test_few_values_are_studied_as_far_as_they_go(tmp_path, n):
    rows = "\n".join(str(v) for v in np.random.default_rng(n).standard_normal(n))
    (tmp_path / "v.csv").write_text(f"residual\n{rows}\n")
    code, said = run(str(tmp_path / "v.csv"), "--json")
    assert code == 0, said
    document = json.loads(said[said.index("{") :])
    assert "NaN" not in said and document["counts"]["values"] == n
    assert document["left_out"]


def test_classes_and_mean_from_the_command_line(tmp_path):
    (tmp_path / "v.csv").write_text(GOOD)
    code, said = run(str(tmp_path / "v.csv"), "--json", "--quiet", "--classes", "-5,-1,0,1,5", "--ends", "closed", "--mean", "0")
    assert code == 0, said
    options = json.loads(said)["options"]
    assert (options["classes"], options["ends"], options["loc"], options["replicas"]) == ([-5, -1, 0, 1, 5], "closed", 0, 19)


def test_progress_of_a_long_column(monkeypatch, capsys):
    with verb.reading(quiet=True) as progress:
        assert progress is None
    with verb.reading(quiet=False) as progress:
        for done in range(0, 101, 4):
            progress(done, 100)
    assert capsys.readouterr().err.count("read ") == 10

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("sys.stderr", screen := Terminal())
    with verb.reading(quiet=False) as progress:
        progress(50, 100)
        progress(100, 100)
    assert screen.getvalue()
