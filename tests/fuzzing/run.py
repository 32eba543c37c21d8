"""Damage files of every reader and count what is read, refused, and what breaks.

    python tests/fuzzing/run.py [--count 100000] [--format NAME ...] [--jobs 2] [--seed 0] [--keep DIR]

Each file is read as the command line reads it: the format is recognised by content; where none is, the format of its seed reads it.
A file counts as refused when the reader ends in an error that the command line prints as one message. Everything else is a crash: another
exception or a warning, more than SECONDS of processor time, more memory than `allowed`, a message that is endless or holds control
characters, or a file opened outside the folder that was given. Case k of a reader depends on the seed and on k alone:
``--format NAME --first K --count 1`` repeats it.

It lies beside the tests because its whole files come from their makers, and each crash that it finds becomes a test in `test_crashes.py`.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import tracemalloc
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any

sys.path[:0] = [p for p in (str(Path(__file__).resolve().parents[1]),) if p not in sys.path]

import pytest  # noqa: E402

from baarda.errors import LONGEST, BaardaError, InputError  # noqa: E402
from baarda.formats import read  # noqa: E402
from baarda.formats.control import with_control  # noqa: E402
from baarda.formats.odm_gcp import is_gcp_list, with_gcp_list  # noqa: E402
from baarda.network import Network  # noqa: E402
from fuzzing.mutations import mutated  # noqa: E402
from fuzzing.seeds import Seed, base_folders, makers, seeds  # noqa: E402

SECONDS = 10  # processor time of one file
PATIENCE = 600  # seconds of wall time after which a worker that does not answer is ended
ROOM, MULTIPLE = 32 * 1024**2, 200  # bytes, and bytes per byte of the input as it lies on the disk, packed or not
CEILING = 4 * 1024**3  # bytes of address space beyond that of the start, the last guard
CHUNK = 250  # files of one worker process
MEASURED = 4  # every so many files the memory is traced, which takes as long as reading


def allowed(size: int) -> int:
    """Return the bytes that reading an input of so many bytes may take at its peak."""
    return ROOM + MULTIPLE * size


@dataclass
class Crash:
    """What broke: the case, a word for the kind, where, the text."""

    reader: str
    case: int
    label: str
    kind: str
    place: str
    text: str
    files: dict[str, bytes]
    entry: str


@dataclass
class Count:
    """What happened to the files of one reader."""

    files: int = 0
    read: int = 0
    refused: int = 0
    crashes: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    peak: int = 0
    share: float = 0.0
    found: dict[tuple[str, str], Crash] = field(default_factory=dict)
    repeated: collections.Counter[tuple[str, str]] = field(default_factory=collections.Counter)


def damaged(seed: Seed, reader: str, number: int, start: int) -> dict[str, bytes]:
    """Return the files of a seed with one of them damaged, or left out, or empty."""
    rng = random.Random(f"{start}/{reader}/{number}")
    names = sorted(seed.files)
    name = rng.choice(names)
    if rng.random() < 0.01 and len(names) > 1:
        return {n: c for n, c in seed.files.items() if n != name}
    content = mutated(seed.files[name], rng)
    if rng.random() < 0.1 and len(names) > 1:
        other = rng.choice(names)
        return {**seed.files, name: content, other: mutated(seed.files[other], rng)}
    return {**seed.files, name: content}


class Overtime(BaseException):
    """The processor time of a file is used up."""


class Watch:
    """Sees every file that is opened while a case runs, and remembers those outside the allowed places."""

    def __init__(self) -> None:
        self.inside: tuple[str, ...] = ()
        self.strays: list[str] = []
        own = Path(__file__).resolve().parents[2] / "src"
        known = {sys.prefix, sys.base_prefix, sys.exec_prefix, own, *filter(None, sys.path)}
        self.libraries = tuple(str(Path(p).resolve()) for p in known)
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.inside:
            return
        if event in ("open", "os.listdir", "os.scandir", "glob.glob"):
            place = os.fspath(arguments[0]) if isinstance(arguments[0], (str, bytes, os.PathLike)) else ""
            text = os.fsdecode(place)
            whole = os.path.realpath(text) if text and "\0" not in text else ""
            if whole and not whole.startswith((*self.inside, *self.libraries)):
                self.strays.append(text)
        elif event.startswith(("socket.connect", "subprocess.", "os.system", "os.exec", "pickle.find_class", "urllib.")):
            self.strays.append(event)


@contextlib.contextmanager
def opened(seed: Seed, files: dict[str, bytes], folder: Path) -> Iterator[Path]:
    """Write the files of a case into a folder and yield the path that is read."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    try:
        yield folder / seed.entry
    finally:
        shutil.rmtree(folder)


def as_the_command_line(seed: Seed, path: Path, bases: dict[str, Network]) -> None:
    """Read a file by the entry point that the command line uses; tables of control and positions join a network read before."""
    if seed.reader == "residuals":
        from baarda.formats.residual_table import read as read_residuals

        read_residuals(path)
    elif seed.reader == "camera_positions":
        from baarda.formats.camera_positions import with_camera_positions

        with_camera_positions(bases[seed.reader], path, "free:0.1,0.2,0.3", "drift")
    elif seed.reader in bases:
        (with_gcp_list if is_gcp_list(path) else with_control)(bases[seed.reader], path)
    else:
        try:
            read(path)
        except InputError as error:
            if "recognise it" not in str(error):
                raise
            read(path, format=seed.reader)


def outcome(seed: Seed, path: Path, bases: dict[str, Network], watch: Watch | None, size: int, traced: bool = True) -> tuple[str, str, str]:
    """Return ``read``, ``refused`` or the kind of a crash, the place in the program, and the text."""

    def late(*_: object) -> None:
        raise Overtime

    signal.signal(signal.SIGPROF, late)
    if watch is not None:
        watch.strays = []
        watch.inside = (str(path.parents[len(Path(seed.entry).parts) - 1] if seed.entry != "." else path),)
    if traced:
        tracemalloc.start()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    kind, place, text = "read", "", ""
    try:
        as_the_command_line(seed, path, bases)
    except BaardaError as error:
        kind, text = "refused", str(error)
    except Overtime as error:
        _stop(watch)
        kind, place = "hang", _place(error)
    except MemoryError as error:
        _stop(watch)
        kind, place = "memory", _place(error)
    except Warning as error:
        _stop(watch)
        kind, place, text = f"warning {type(error).__name__}", _place(error), str(error)
    except Exception as error:  # whatever it is, it is a finding
        signal.setitimer(signal.ITIMER_PROF, 0)
        _stop(watch)
        kind, place, text = type(error).__name__, _place(error), "".join(traceback.format_exception(error))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        _stop(watch)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    if kind == "refused" and any((ord(c) < 32 and c != "\n") or 127 <= ord(c) < 160 or 0xD800 <= ord(c) < 0xE000 for c in text):
        kind, place = "message", repr(text)[-80:]
    if kind == "refused" and len(text) > LONGEST + 100:
        kind, place = "long message", f"{len(text)} characters: {text[:100]}"
    if watch is not None and watch.strays:
        kind, place, text = "outside", watch.strays[0], text
    if peak > allowed(size):
        kind, place = "memory", f"{peak / 1e6:.0f} MB for {size} bytes"
    return kind, place, f"{peak}\n{text}"


def _stop(watch: Watch | None) -> None:
    if watch is not None:
        watch.inside = ()


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "baarda" in f.filename] or list(frames)
    return f"{Path(own[-1].filename).name}:{own[-1].lineno} {own[-1].name}" if own else "?"


def work(reader: str, found: list[Seed], numbers: range, start: int, answer: Connection, at: Synchronized[int], scratch: str) -> None:
    """Read the cases of a chunk in this process and send their counts and crashes."""
    resource.setrlimit(resource.RLIMIT_AS, (CEILING + _address_space(), resource.RLIM_INFINITY))
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    here = Path(scratch) / str(os.getpid())
    bases = {name: read(path) for name, path in base_folders(here / "bases").items()}
    watch = Watch()
    for seed in found:  # what is imported on first use must not count
        with opened(seed, seed.files, here / "case") as path, contextlib.suppress(BaardaError):
            as_the_command_line(seed, path, bases)
    count = Count()
    for number in numbers:
        at.value = number
        seed = found[number % len(found)]
        files = damaged(seed, reader, number, start)
        size = sum(map(len, files.values()))
        with opened(seed, files, here / "case") as path:
            began = time.process_time()
            kind, place, text = outcome(seed, path, bases, watch, size, number // len(found) % MEASURED == 0)
            taken = time.process_time() - began
        peak, _, text = text.partition("\n")
        count.files += 1
        count.seconds += taken
        count.slowest = max(count.slowest, taken)
        count.peak = max(count.peak, int(peak))
        count.share = max(count.share, int(peak) / allowed(size))
        if kind in ("read", "refused"):
            setattr(count, kind, getattr(count, kind) + 1)
        else:
            count.crashes += 1
            key = (kind, place if kind != "memory" else "memory")
            count.repeated[key] += 1
            if key not in count.found:
                print(f"\n{reader} case {number} ({seed.label}): {kind} at {place}", file=sys.stderr, flush=True)
            count.found.setdefault(key, Crash(reader, number, seed.label, kind, place, text, files, seed.entry))
    shutil.rmtree(here, ignore_errors=True)
    answer.send(count)


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def merged(total: Count, part: Count) -> None:
    """Add the counts of a chunk."""
    for name in ("files", "read", "refused", "crashes", "seconds"):
        setattr(total, name, getattr(total, name) + getattr(part, name))
    for name in ("slowest", "peak", "share"):
        setattr(total, name, max(getattr(total, name), getattr(part, name)))
    for key, crash in part.found.items():
        total.found.setdefault(key, crash)
    total.repeated.update(part.repeated)


def available(readers: list[str]) -> list[str]:
    """Return the readers whose whole files can be made here: some need the program that writes the format."""
    out = []
    for reader in readers:
        try:
            seeds(reader)
            out.append(reader)
        except pytest.skip.Exception as error:
            print(f"{reader} is left out: {error}", file=sys.stderr)
    return out


def run(readers: list[str], count: int, first: int, start: int, jobs: int, quiet: bool = False) -> dict[str, Count]:
    """Read `count` damaged files, parted evenly among the readers, in worker processes; return the counts by reader."""
    each = {r: count // len(readers) + (i < count % len(readers)) for i, r in enumerate(readers)}
    parts = [(r, range(a, min(a + CHUNK, first + each[r]))) for r in readers for a in range(first, first + each[r], CHUNK)]
    parts.sort(key=lambda p: p[1][0])  # all readers in turn
    totals = {r: Count() for r in readers}
    whole = {r: seeds(r) for r in readers}
    context = multiprocessing.get_context("fork")  # what the parent has imported need not be imported again
    with tempfile.TemporaryDirectory(prefix="fuzzing-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as scratch:
        waiting: list[tuple[str, range]] = list(parts)
        running: list[Any] = []
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    reader, numbers = waiting.pop(0)
                    mine, theirs = context.Pipe(duplex=False)
                    at = context.Value("q", numbers[0])
                    process = context.Process(target=work, args=(reader, whole[reader], numbers, start, theirs, at, scratch))
                    process.start()
                    theirs.close()
                    running.append([process, mine, at, reader, numbers, (numbers[0], time.monotonic())])
                for entry in list(running):
                    process, mine, at, reader, numbers, seen = entry
                    if seen[0] != at.value:
                        entry[5] = (at.value, time.monotonic())
                    if mine.poll(0.05):
                        try:
                            merged(totals[reader], mine.recv())
                        except EOFError:  # the worker died
                            process.join()
                            waiting += _after(totals[reader], reader, numbers, at.value, f"ended by signal {-(process.exitcode or 0)}")
                    elif process.is_alive() and time.monotonic() - seen[1] > PATIENCE:
                        process.kill()
                        waiting += _after(totals[reader], reader, numbers, at.value, "hang")
                    elif process.is_alive():
                        continue
                    process.join()
                    running.remove(entry)
                    if not quiet:
                        done = sum(t.files for t in totals.values())
                        print(f"\r{done} files, {sum(t.crashes for t in totals.values())} crashes", end="", file=sys.stderr, flush=True)
        except KeyboardInterrupt:  # what is counted so far is told
            for entry in running:
                entry[0].kill()
                entry[0].join()
    if not quiet:
        print(file=sys.stderr)
    return totals


def _after(total: Count, reader: str, numbers: range, at: int, kind: str) -> list[tuple[str, range]]:
    """Count the case that ended a worker, and return what is left: the earlier cases once more, and the later ones."""
    total.files += 1
    total.crashes += 1
    total.repeated[(kind, "worker")] += 1
    total.found.setdefault((kind, "worker"), Crash(reader, at, "", kind, "the worker process", "", {}, ""))
    return [(reader, r) for r in (range(numbers[0], at), range(at + 1, numbers[-1] + 1)) if r]


def table(totals: dict[str, Count]) -> str:
    """Return the counts as a Markdown table."""
    head = "| reader | files | read | refused | crashes | ms each | slowest s | peak MB | of allowed |"
    lines = [head, "|" + "---|" * 9]
    whole = Count()
    for name, c in totals.items():
        merged(whole, c)
        lines.append(_row(name, c))
    return "\n".join([*lines, _row("all", whole)])


def _row(name: str, c: Count) -> str:
    ms = 1000 * c.seconds / max(1, c.files)
    return (
        f"| {name} | {c.files} | {c.read} | {c.refused} | {c.crashes} | {ms:.1f} | {c.slowest:.2f} | {c.peak / 1e6:.1f} | {c.share:.0%} |"
    )


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="files in total")
    parser.add_argument("--first", type=int, default=0, help="number of the first case of each reader")
    parser.add_argument("--format", action="append", choices=list(makers()), help="reader; may be repeated; default all")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="worker processes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder to write the first file of every crash to")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C, with the table
    totals = run(available(options.format or list(makers())), options.count, options.first, options.seed, options.jobs)
    print(table(totals))
    for reader, count in totals.items():
        for (kind, place), crash in sorted(count.found.items()):
            times = count.repeated[(kind, place)]
            print(f"\n{reader} case {crash.case} ({crash.label}): {kind} at {crash.place}, {times} times\n{crash.text[-1500:]}")
            if options.keep is not None:
                for name, content in crash.files.items():
                    file = options.keep / f"{reader}-{crash.case}" / name
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_bytes(content)
    return 1 if any(c.crashes for c in totals.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
