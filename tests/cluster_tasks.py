"""What the workers of the cluster tests run: they import it by name."""

import errno
import os
import signal
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

MARKS = "BAARDA_TEST_MARKS"  # a folder that tells workers what has happened already
PHASES = {
    "reading": "baarda.procedures.batch.read",
    "adjusting": "baarda.procedures.batch.adjust",
    "testing": "baarda.procedures.batch.analyse",
    "writing": "baarda.report.contents._text",
    "hashing": "baarda.procedures.batch._row",
    "recording": "baarda.procedures.batch._write_whole",
}


def light(analysis, folder, facts):
    """Write a result folder without laws and figures."""
    import numpy as np  # here, not above: what a killed process did must be cheap to begin again

    from baarda.network import Table
    from baarda.report import contents
    from baarda.report.result_folder import MARK

    a = analysis.adjustment
    document = {"schema": "baarda.result/1", "sigma0": a.sigma0, "tests": [[t.name, t.statistic, t.p_value] for t in analysis.tests]}
    tables = {"points": a.point_table("aposteriori"), "observations": Table({"v": np.array(a.residuals)})}
    contents.write(contents.Contents(document, "<p>", tables=tables, facts=facts, network=a.network), folder, MARK)


def first_time(what):
    """Whether this is the first call of all workers."""
    try:
        (Path(os.environ[MARKS]) / what).mkdir()  # a file would be opened, and be taken for one that was read
    except FileExistsError:
        return False
    return True


def dying_block(job, write):
    """Kill the worker once in each phase, on the block of its number."""
    from baarda.procedures import batch

    phases = list(PHASES)
    with ExitStack() as stack:
        number = int(job.name.rsplit("b", 1)[1])
        if number < len(phases):
            phase = phases[number]
            true = _resolved(PHASES[phase])

            def die(*args, **kwargs):
                if phase == "writing" and args:
                    Path(args[0]).write_text("half")
                if first_time(phase):
                    os.kill(os.getpid(), signal.SIGKILL)
                return true(*args, **kwargs)

            stack.enter_context(mock.patch(PHASES[phase], die))
        return batch.adjust_block(job, write)


def _resolved(name):
    module, _, attribute = name.rpartition(".")
    return getattr(__import__(module, fromlist=[attribute]), attribute)


def full_disk(analysis, folder, facts):
    """Fail as on a full disk, always on the worker that comes first."""
    mark = Path(os.environ[MARKS]) / "full.worker"
    if first_time("full") or mark.read_text() == str(os.getpid()):
        mark.write_text(str(os.getpid()))

        def write(path, text):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))

        with mock.patch("baarda.report.contents._text", write):
            light(analysis, folder, facts)
    light(analysis, folder, facts)


def dies_on_seven(number):
    """Kill the worker on number 7, each time."""
    if number == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def refuses_odd(number):
    """Raise an error with a file and a line for odd numbers."""
    if number % 2:
        from baarda.errors import InputError

        raise InputError("odd", "numbers.txt", number)
    return number


def process_id(_):
    """Say who works."""
    return os.getpid()


def limit_of(_):
    """Say what the worker may take."""
    from baarda.executors import memory_limit

    return memory_limit()


def with_limit(job, write):
    """Adjust a block where hardly any memory may be taken."""
    from baarda.procedures import batch

    with mock.patch("baarda.procedures.batch.memory_limit", lambda: 1e4):
        return batch.adjust_block(job, write)


def dying_condense(job):
    """Kill the worker once, in the middle of the second file."""
    from baarda.procedures import lake_sums

    def values(*args):
        for number, piece in enumerate(_values(*args)):
            if job.index == 1 and number == 1 and first_time("condensing"):
                os.kill(os.getpid(), signal.SIGKILL)
            yield piece

    _values = lake_sums._values
    with mock.patch("baarda.procedures.lake_sums._values", values), mock.patch("baarda.procedures.lake_sums.PIECE", 1000):
        return lake_sums.condense_file(job)


def full_disk_once(table, place):
    """Write the table of a part of a large block; fail as on a full disk when the first worker gets there."""
    from baarda.report.helmert_report import PartTables

    if first_time("full table"):
        raise OSError(errno.ENOSPC, "No space left on device", str(place))
    PartTables("csv")(table, place)
