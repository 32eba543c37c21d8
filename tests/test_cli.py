"""The command line as a user meets it: exit codes, streams, one clear message, nothing half-written."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


def run(*arguments, cwd=None, **options):
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent / "src"), "NO_COLOR": "1"}
    command = [sys.executable, "-m", "baarda", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", cwd=cwd, env=environment, check=False, **options)


class Clock:
    """Stands for the module `time`: moves only when told to."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    from baarda.cli import progress

    monkeypatch.setattr(progress, "time", stopped := Clock())
    return stopped


def test_iterations_tell_when_they_end(clock, capsys):
    from baarda.adjustment.result import Iteration
    from baarda.cli.progress import Iterations

    tell = Iterations(-5.0, 1e-10)
    steps = [(1.0, 0.0, True), (1e-2, 0.0, True), (1e-3, 0.0, True), (0.5, 0.0, False), (1e-3, 1e-7, True), (1e-4, 0.0, True)]
    steps += [(1e-5, 0.0, True), (1e-10, 0.0, True), (1e-10, 0.0, True)]
    for count, (relative, damping, accepted) in enumerate(steps, start=1):
        clock.now += 10.0
        tell(Iteration(count, 12.5, relative, damping, accepted))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "iteration  1  v'Pv 12.5  relative step 1.0e+00  15.0 s"
    ends = [line.partition(" s, ")[2] for line in lines]
    # only after two plain steps in a row; 1e-3 by a rate of 0.1 needs 7 steps of 10 s; nothing at the end
    assert ends == [
        "",
        "about 40 s of iterations left",
        "about 70 s of iterations left",
        "",
        "",
        "",
        "about 50 s of iterations left",
        "",
        "",
    ]


def test_pieces_are_told_now_and_then(clock, capsys):
    from baarda.cli.progress import Counted

    tell = Counted("data sets simulated")
    for done in range(10):
        tell(done, 10)
        clock.now += 1.5
    assert capsys.readouterr().err.splitlines() == [
        "2 of 10 data sets simulated, about 12 s left",
        "4 of 10 data sets simulated, about 9 s left",
        "6 of 10 data sets simulated, about 6 s left",
        "8 of 10 data sets simulated, about 3 s left",
    ]


def test_counting_the_simulated_data_sets_changes_nothing():
    import numpy as np

    import baarda
    from baarda.hypotheses.levels import Options
    from baarda.procedures.testing import analyse
    from networks import ring

    result, options, seen = baarda.adjust(ring(images=4, points=8, control=4)), Options(replicas=99), []
    plain, told = analyse(result, options), analyse(result, options, lambda done, total: seen.append((done, total)))
    assert seen == [(0, 99)]
    assert [t.name for t in told.tests] == [t.name for t in plain.tests]
    for a, b in zip(told.tests, plain.tests, strict=True):
        assert np.array_equal(a.statistic, b.statistic, equal_nan=True) and np.array_equal(a.p_value, b.p_value, equal_nan=True)


@pytest.fixture(scope="module")
def two_demos(tmp_path_factory):
    """The demo, twice, from a folder without the sources."""
    folder = tmp_path_factory.mktemp("demo")
    first, second = run("demo", "--out", "one", cwd=folder), run("demo", "--out", "two", "--quiet", cwd=folder)
    return folder, first, second


def test_demo_writes_the_folder_of_the_contract(two_demos):
    folder, first, _ = two_demos
    assert first.returncode == 0, first.stderr
    assert {p.name for p in (folder / "one").iterdir()} == {"report.html", "result.json", "run.json", "tables", "figures", "project"}
    assert {p.name for p in (folder / "one" / "tables").iterdir()} == {"observations.csv", "points.csv", "images.csv", "unknowns.csv"}
    assert "4148 observations" in first.stdout
    assert "v'Pv" in first.stderr
    assert "v'Pv" not in first.stdout
    told = first.stderr.splitlines()
    adjusted = told.index("adjusted: s0 1.615, redundancy 3725, image residuals 0.153 px rms per coordinate")
    assert told[0].startswith("iteration  1  v'Pv ") and told[adjusted - 1].startswith("iteration ")
    assert [line for line in told[adjusted + 1 :] if line.endswith(" ...")] == [
        "redundancy numbers and precision ...",
        "tests and their simulated null laws ...",
        "laws of errors, fitted and simulated ...",
        "tables, figures and report ...",
    ]


def test_demo_numbers(two_demos):
    result = json.loads((two_demos[0] / "one" / "result.json").read_text())
    c = result["counts"]
    assert (c["observations"], c["unknowns"], c["redundancy"], c["datum_defect"]) == (4148, 423, 3725, 0)
    assert (c["images"], c["object_points"], c["control_points"], c["image_observations"]) == (21, 100, 4, 4148)
    assert result["sigma0"]["aposteriori"] == pytest.approx(1.61480435, abs=5e-9)
    assert result["schema"] == "baarda.result/1"
    assert result["status"] == "converged"
    names = {t["name"] for t in result["tests"]}
    assert names >= {"global_variance_factor", "mean_of_residuals", "skewness_of_residuals", "kurtosis_of_residuals", "bartlett_images"}
    assert names >= {"variance_per_image", "all_additional_parameters", "additional_parameter", "data_snooping"}
    assert [law["law"] for law in result["laws"]][:4] == ["normal", "radico", "lineo", "modulated_normal"]
    assert len(result["outliers"]) == 45
    assert (result["outliers"][0]["image"], result["outliers"][0]["point"]) == ("19", "8")
    pair = next(p for p in result["correlations"] if {p["a"], p["b"]} == {"camera 1: K2", "camera 1: K3"})
    assert pair["value"] == pytest.approx(-0.9786, abs=5e-5)


def test_two_runs_give_the_same_bytes(two_demos):
    folder, _, second = two_demos
    assert second.returncode == 0
    assert second.stdout == second.stderr == ""
    files = sorted(p.relative_to(folder / "one") for p in (folder / "one").rglob("*") if p.is_file())
    for name in files:
        if name.name != "run.json":
            assert (folder / "one" / name).read_bytes() == (folder / "two" / name).read_bytes(), name


def test_the_adjusted_project_is_read_again(two_demos):
    folder = two_demos[0]
    again = run("adjust", folder / "one" / "project", "--json", "--quiet")
    assert again.returncode == 0, again.stderr
    result = json.loads(again.stdout)
    assert result["sigma0"]["aposteriori"] == pytest.approx(1.61480435, abs=5e-9)
    assert result["counts"]["redundancy"] == 3725
    assert not (Path.cwd() / "baarda-out").exists()


def test_json_has_no_nan(two_demos):
    text = (two_demos[0] / "one" / "result.json").read_text()

    def refuse(value):
        raise AssertionError(value)

    json.loads(text, parse_constant=refuse)


def test_strict_gate(tmp_path):
    done = run("demo", "--out", tmp_path / "r", "--strict", "--quiet")
    assert done.returncode == 1
    assert "global_variance_factor" in done.stderr
    assert (tmp_path / "r" / "result.json").is_file()


def test_not_converged_writes_a_folder_without_tests(camcal, tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from baarda.adjustment import solve
    from baarda.cli import app

    usual = solve.Settings.of
    monkeypatch.setattr(solve.Settings, "of", staticmethod(lambda n, o: usual(n, {**o, "iterations": 2})))
    done = CliRunner().invoke(app, ["adjust", str(camcal), "--out", str(tmp_path / "r")])
    assert done.exit_code == 3
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["status"] == "not_converged"
    assert result["tests"] == []


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["adjust", "missing.txt"], 2, "no such file"),
        (["adjust"], 2, "SOURCE"),
        (["adjust", "empty.txt"], 2, "empty"),
        (["adjust", "strange.txt"], 2, "no known format"),
        (["adjust", "strange.txt", "--format", "colmap"], 2, "strange.txt"),
        (["adjust", "strange.txt", "--format", "nothing"], 2, "unknown format"),
        (["demo", "--datum", "x"], 2, "datum"),
        (["demo", "--solver", "qr", "--out", "o"], 2, "solver"),
        (["demo", "--alpha", "2", "--out", "o"], 2, "alpha"),
        (["demo", "--tables", "xml", "--out", "o"], 2, "tables"),
        (["demo", "--sigma", "both", "--out", "o"], 2, "sigma"),
        (["nonsense"], 2, "nonsense"),
        (["demo", "--out", "strange.txt"], 4, "is not an empty folder"),
        (["demo", "--out", "/proc/nothing/here"], 4, "cannot write"),
    ],
)
def test_failures_are_one_message(tmp_path, arguments, code, words):
    (tmp_path / "empty.txt").touch()
    (tmp_path / "strange.txt").write_text("hello\n")
    before = sorted(tmp_path.rglob("*"))
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(tmp_path.rglob("*")) == before  # nothing half-written


def test_singular_network_leaves_no_folder(data, tmp_path):
    done = run("adjust", data("dbat_camcal") / "pm" / "camcal-pmexport.txt", "--out", "r", cwd=tmp_path)
    assert done.returncode == 3
    assert "datum defect 7" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", ["", '{"my": "thing"}', '{"schema": "baarda.result/1"}'])
def test_a_folder_of_someone_else_is_not_replaced(tmp_path, content):
    """Not even one with a file of our name in it, and not a result folder that holds a stranger's file."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    if content:
        (tmp_path / "mine" / "result.json").write_text(content)
    done = run("demo", "--out", "mine", "--quiet", cwd=tmp_path)
    assert done.returncode == 4
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_interruption_leaves_nothing(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent / "src")}
    command = [sys.executable, "-m", "baarda", "demo", "--out", "r"]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr:  # interrupt while the adjustment runs
            if line.startswith("iteration"):
                break
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130
    assert "interrupted" in rest
    assert list(tmp_path.iterdir()) == []


def test_interruption_between_the_renames_brings_the_earlier_folder_back(tmp_path, monkeypatch):
    from baarda.formats.folder import whole_folder
    from baarda.report.result_folder import MARK

    old = tmp_path / "r"
    old.mkdir()
    (old / "result.json").write_text('{"schema": "baarda.result/1"}')
    usual = Path.rename

    def interrupted(self, target):
        done = usual(self, target)
        if self == old:
            raise KeyboardInterrupt
        return done

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt), whole_folder(old, MARK) as folder:
        (folder / "result.json").write_text("new")
    assert [p.name for p in tmp_path.iterdir()] == ["r"]
    assert "baarda.result" in (old / "result.json").read_text()


def test_a_link_is_followed(tmp_path):
    from baarda.formats.folder import write_folder

    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    write_folder(tmp_path / "link", {"a.txt": "x"})
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text() == "x"


@pytest.mark.skipif(os.name == "nt" or not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output(camcal):
    with Path("/dev/full").open("w") as full:
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent / "src")}
        command = [sys.executable, "-m", "baarda", "adjust", str(camcal), "--json", "--quiet"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment, check=False)
    assert done.returncode == 4
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(os.name == "nt" or not shutil.which("bash"), reason="POSIX limits")
def test_a_full_disk_leaves_nothing(tmp_path):
    """A limit on the size of files stands for the full disk: writing fails in the middle."""

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    done = run("demo", "--out", "r", "--quiet", cwd=tmp_path, preexec_fn=limit)
    assert done.returncode == 4, done.stderr
    assert "cannot write" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_help_imports_nothing_heavy():
    code = "import sys; sys.argv=['baarda','--help']\nfrom baarda.cli import main\ntry:\n  main()\nfinally:\n  print(sorted(sys.modules))"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent / "src")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    modules = done.stdout[done.stdout.rindex("[") :]
    assert "'typer'" in modules
    for heavy in ("numpy", "scipy", "matplotlib", "numba", "pydantic", "jinja2"):
        assert f"'{heavy}'" not in modules, heavy


def test_importing_baarda_is_cheap():
    code = "import sys, baarda; assert not {'numpy', 'scipy'} & set(sys.modules); print(baarda.__version__, len(dir(baarda)))"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent / "src")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("verb", ["formats", "cameras", "laws", "tests"])
def test_lists(verb):
    done = run(verb)
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) >= 3
    assert all(len(line.split(maxsplit=1)) == 2 for line in done.stdout.splitlines())


def test_version():
    assert run("--version").stdout.startswith("baarda 0.")
    assert time.time() > 0


def test_convert_to_the_project_and_back(data, tmp_path):
    done = run("convert", data("dbat_sxb") / "sxb.xml", "--to", "project", "--out", tmp_path / "p")
    assert done.returncode == 0, done.stderr
    result = json.loads(run("adjust", tmp_path / "p", "--json", "--quiet").stdout)
    assert result["sigma0"]["aposteriori"] == pytest.approx(1.1785983161860711, rel=1e-9)
    points = {row["point"]: row for row in result["check_points"]}
    assert points["351"]["dz"] == pytest.approx(-0.459, abs=5e-4)
    assert points["410"]["p_value"] is not None


def test_residuals_of_a_table(tmp_path):
    import numpy as np

    rng = np.random.default_rng(3)
    values = rng.standard_normal(300)
    rows = "\n".join(f"{'ab'[i % 2]},{v!r}" for i, v in enumerate(values.tolist()))
    (tmp_path / "t.csv").write_text("group,residual\n" + rows + "\n")
    done = run("residuals", "t.csv", "--out", "r", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "300 values" in done.stdout
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["schema"] == "baarda.residuals/1"
    again = run("residuals", "t.csv", "--json", "--quiet", cwd=tmp_path)
    assert json.loads(again.stdout) == result
    (tmp_path / "t.csv").write_text("residual\n1\nnan\n")
    broken = run("residuals", "t.csv", "--out", "s", cwd=tmp_path)
    assert broken.returncode == 2
    assert "t.csv, line 3" in broken.stderr
    assert not (tmp_path / "s").exists()


def test_reproduce(tmp_path):
    done = run("reproduce", "maarek-konecny", "--out", "r", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "17 of 17 decisions" in done.stdout
    assert {p.name for p in (tmp_path / "r").iterdir()} == {"reproduce.html", "reproduce.json", "tables", "figures"}
    wrong = run("reproduce", "nobody", cwd=tmp_path)
    assert (wrong.returncode, "no paper named 'nobody'" in wrong.stderr) == (2, True)


def test_adjustment_under_a_law(data, tmp_path):
    done = run("adjust", data("dbat_sxb") / "sxb.xml", "--robust", "huber", "--out", "r", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["law_of_errors"]["name"] == "huber"
    steps = [line for line in done.stderr.splitlines() if line.startswith("iteration")]
    under_the_law = [k for k, line in enumerate(steps) if "- log L" in line]
    assert under_the_law == list(range(under_the_law[0], len(steps))) and under_the_law[0] > 0  # least squares comes first
    assert all("v'Pv" in line for line in steps[: under_the_law[0]])
    assert f"- log L {result['history'][-1]['objective']:.10g} " in steps[-1]
    assert "adjusted: huber law of errors, scale " in done.stderr and "simulated" not in done.stderr
    names = {t["name"] for t in result["tests"]}
    assert "check_points" in names
    assert not names & {"global_variance_factor", "data_snooping", "control_points"}
    assert "maximum likelihood under the huber law" in " ".join(result["assumptions"])
    assert "uncontrolled" not in done.stdout
    assert run("adjust", data("dbat_sxb") / "sxb.xml", "--robust", "nothing", cwd=tmp_path).returncode == 2
