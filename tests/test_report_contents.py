"""What result folders hold and how they are written: tables that read back, JSON without NaN, whole folders or none."""

import csv
import io
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from baarda.errors import MissingExtra, OutputError, UsageError
from baarda.formats import read
from baarda.formats.folder import Mark
from baarda.network import Table
from baarda.report import contents
from networks import ring

MARK = Mark("summary.json", "baarda.example/", ("summary.json", "report.html", "run.json", "tables", "figures", "project", "more.bin"))
#: The csv module drops a carriage return that stands alone, and reads no NUL.
TEXT = st.text(alphabet=st.characters(exclude_characters="\r\0", exclude_categories=()), max_size=6)


@given(
    st.lists(st.tuples(TEXT, st.floats(), st.integers(-5, 5)), max_size=8),
    st.lists(TEXT, min_size=3, max_size=3, unique=True),
)
def test_tables_read_back_exactly(rows, heads):
    columns = [np.array([r[0] for r in rows], dtype=object), np.array([r[1] for r in rows], dtype=float), np.array([r[2] for r in rows])]
    text = contents.table_csv(Table(dict(zip(heads, columns, strict=True))))
    lines = list(csv.reader(io.StringIO(text, newline="")))
    assert lines[0] == heads
    assert [(t, x, k) for t, x, k in lines[1:]] == [(t, repr(x) if math.isfinite(x) else "", str(k)) for t, x, k in rows]


def test_a_column_of_empty_fields_keeps_its_rows():
    text = contents.table_csv(Table({"x": np.array([np.nan, 1.0, np.inf])}))
    assert [row for row in csv.reader(io.StringIO(text)) if row] == [["x"], [""], ["1.0"], [""]]


def test_json_has_no_nan_and_plain_numbers():
    made = contents.json_text({"a": np.array([1.0, np.nan]), "b": {"c": (np.int64(2), np.bool_(True), float("-inf"))}})
    assert json.loads(made) == {"a": [1.0, None], "b": {"c": [2, True, None]}} and made.endswith("}\n")


def test_a_folder_has_all_its_parts(tmp_path):
    network = ring(3, points=12)
    table = Table({"point": np.array(["a", "\ud800"], dtype=object), "x": np.array([1.5, np.nan])})
    made = contents.Contents(
        {"schema": "baarda.example/1", "x": float("nan")},
        "<p>Done.",
        {"one": "<svg/>"},
        {"t": table},
        {"seconds": 1},
        {"more.bin": b"\0"},
        network,
    )
    out = contents.write(made, tmp_path / "out", MARK)
    assert json.loads((out / "summary.json").read_text(encoding="utf-8")) == {"schema": "baarda.example/1", "x": None}
    assert (out / "tables" / "t.csv").read_text(encoding="utf-8") == "point,x\na,1.5\n\\ud800,\n"
    assert (out / "figures" / "one.svg").read_text(encoding="utf-8") == "<svg/>" and (out / "more.bin").read_bytes() == b"\0"
    assert json.loads((out / "run.json").read_text(encoding="utf-8")) == {"seconds": 1}
    assert read(out / "project").points.labels == network.points.labels
    contents.write(contents.Contents({"schema": "baarda.example/1"}, ""), out, MARK)  # ours: replaced
    assert not (out / "more.bin").exists() and not (out / "project").exists()


def test_nothing_is_left_of_a_folder_that_fails(tmp_path):
    class Broken(Table):
        def __getitem__(self, name):
            raise RuntimeError

        @property
        def columns(self):
            raise RuntimeError("no columns")

    broken = object.__new__(Broken)
    with pytest.raises(RuntimeError):
        contents.write(contents.Contents({"schema": "baarda.example/1"}, "", tables={"t": broken}), tmp_path / "out", MARK)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x", encoding="utf-8")
    with pytest.raises(OutputError):
        contents.write(contents.Contents({"schema": "baarda.example/1"}, ""), tmp_path / "out", MARK)
    assert (tmp_path / "out" / "mine.txt").exists()


def test_formats_of_tables_are_refused_before_any_work(monkeypatch):
    with pytest.raises(UsageError, match="--tables is csv or parquet, not 'xls'"):
        contents.check_tables("xls")
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match="tables"):
        contents.check_tables("parquet")


def test_parquet(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    made = contents.Contents({"schema": "baarda.example/1"}, "", tables={"t": Table({"x": np.array([1.0, 2.0])})})
    out = contents.write(made, tmp_path / "out", MARK, "parquet")
    assert parquet.read_table(out / "tables" / "t.parquet")["x"].to_pylist() == [1.0, 2.0]
