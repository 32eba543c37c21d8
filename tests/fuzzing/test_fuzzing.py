"""The fuzzing itself: every reader has whole files, which are read; damaged ones are read or refused; cases repeat exactly."""

import contextlib

import pytest

from baarda.errors import BaardaError
from baarda.formats import formats, read
from fuzzing import run
from fuzzing.seeds import TABLES, base_folders, makers, seeds

COUNT = 15


def test_every_format_has_whole_files():
    missing = set(formats()) - set(makers())
    assert not missing, "write a generator of their whole files in tests/fuzzing/seeds.py"
    assert set(TABLES) <= set(makers())


@pytest.mark.parametrize("reader", list(makers()))
def test_damaged_files(tmp_path, reader):
    found = seeds(reader)
    assert [s.files for s in found] == [s.files for s in seeds(reader)]
    bases = {name: read(path) for name, path in base_folders(tmp_path / "bases").items()}
    for seed in found:
        with run.opened(seed, seed.files, tmp_path / "case") as path:
            run.as_the_command_line(seed, path, bases)  # whole files are read
    for number in range(COUNT):
        seed = found[number % len(found)]
        files = run.damaged(seed, reader, number, 5)
        assert files == run.damaged(seed, reader, number, 5)
        with run.opened(seed, files, tmp_path / "case") as path, contextlib.suppress(BaardaError):
            run.as_the_command_line(seed, path, bases)


def test_the_watch_and_the_clock(tmp_path):
    """A worker process sees what it must see: a file outside, a warning, an exception, too much memory."""
    (tmp_path / "outside").write_text("x")
    seed = run.Seed("residuals", "", {"v.csv": b"1\n2\n4\n"}, "v.csv")
    script = f"""
import sys, warnings
sys.path[:0] = {[str(run.Path(__file__).parents[1])]!r}
from fuzzing import run
watch = run.Watch()
warnings.simplefilter("error")
seed = run.Seed("residuals", "", {{"v.csv": b"1\\n2\\n4\\n"}}, "v.csv")
def case(action):
    run.as_the_command_line = lambda *_: action()
    with run.opened(seed, seed.files, run.Path({str(tmp_path / "case")!r})) as path:
        return run.outcome(seed, path, {{}}, watch, 6)[0]
run.SECONDS = 0.2
def forever():
    while True:
        pass
print(case(lambda: None), case(lambda: open({str(tmp_path / "outside")!r}).close()), case(lambda: warnings.warn("x")), case(lambda: 1 / 0),
      case(lambda: bytes(40 << 20)), case(forever), sep=",")
"""
    import subprocess
    import sys

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == "read,outside,warning UserWarning,ZeroDivisionError,memory,hang", done.stderr
    assert seed.size == 6
