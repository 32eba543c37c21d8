"""Long columns in NPY and Parquet files, read in pieces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from baarda.distributions import condense, condense_stream
from baarda.errors import InputError, MissingExtra, UsageError
from baarda.formats.value_stream import open_values


def values(n: int = 10_000) -> np.ndarray:
    return np.random.default_rng(0).standard_normal(n)


def test_npy_in_pieces(tmp_path: Path) -> None:
    x = values()
    np.save(tmp_path / "v.npy", x)
    stream = open_values(tmp_path / "v.npy", piece=3000)
    assert len(stream) == stream.total == x.size
    assert [p.size for p in stream] == [3000, 3000, 3000, 1000]
    for _ in range(2):  # it can be read again
        assert np.array_equal(np.concatenate(list(stream)), x)
    c = condense_stream(stream)
    assert np.array_equal(c.squares, condense(x).squares)


@pytest.mark.parametrize("dtype", ["f4", ">f8", "i2", "u8"])
def test_npy_of_other_types_and_shapes(tmp_path: Path, dtype: str) -> None:
    x = np.round(100 * np.abs(values(600))).astype(dtype).reshape(20, 30)
    for order in "CF":
        np.save(tmp_path / "v.npy", np.asarray(x, order=order))
        c = condense_stream(open_values(tmp_path / "v.npy", piece=77))
        assert np.array_equal(c.squares, condense(x).squares)


def test_npy_with_named_columns(tmp_path: Path) -> None:
    table = np.zeros(100, dtype=[("name", "S3"), ("v", "f8"), ("w", "f4")])
    table["v"] = values(100)
    np.save(tmp_path / "t.npy", table)
    assert np.array_equal(np.concatenate(list(open_values(tmp_path / "t.npy", "v", piece=7))), table["v"])
    for column, words in ((None, "choose a column; columns of numbers are v, w"), ("x", "there are name, v, w"), ("name", "real numbers")):
        with pytest.raises(InputError, match=words):
            open_values(tmp_path / "t.npy", column)
    np.save(tmp_path / "one.npy", table[["name", "v"]])
    assert open_values(tmp_path / "one.npy").column == "v"


def test_bad_files_are_named(tmp_path: Path) -> None:
    file = tmp_path / "v.npy"
    with pytest.raises(InputError, match=r"v\.npy"):
        open_values(file)
    file.write_bytes(b"1,2,3\n")
    with pytest.raises(InputError, match="neither an NPY nor a Parquet file"):
        open_values(file)
    np.save(file, values(100))
    with pytest.raises(InputError, match="no column"):
        open_values(file, "v")
    with pytest.raises(UsageError):
        open_values(file, piece=0)
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    with pytest.raises(InputError, match="ends before its 100 values"):
        open_values(file)
    file.write_bytes(whole[:20])
    with pytest.raises(InputError, match="damaged"):
        open_values(file)
    for wrong in (np.array([1j]), np.array([True]), np.array(["a"])):
        np.save(file, wrong)
        with pytest.raises(InputError, match="not real numbers"):
            open_values(file)
    np.save(file, np.array([None]), allow_pickle=True)
    with pytest.raises(InputError, match="not real numbers"):
        open_values(file)


def test_an_empty_array_has_no_values(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.zeros(0))
    with pytest.raises(UsageError, match="no values"):
        condense_stream(open_values(tmp_path / "v.npy"))


def test_parquet_in_pieces(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    x = values()
    file = tmp_path / "v.parquet"
    table = pa.table({"name": ["a"] * x.size, "v": x, "w": x.astype(np.float32)})
    parquet.write_table(table, file, row_group_size=1234)
    stream = open_values(file, "v", piece=1000)
    assert stream.total == x.size
    assert max(p.size for p in stream) <= 1000
    assert np.array_equal(np.concatenate(list(stream)), x)
    next(iter(stream))  # may be left early
    assert np.array_equal(condense_stream(open_values(file, "v")).squares, condense(x).squares)
    with pytest.raises(InputError, match="choose a column; columns of numbers are v, w"):
        open_values(file)
    with pytest.raises(InputError, match="there is no column 'x'"):
        open_values(file, "x")
    with pytest.raises(InputError, match="real numbers"):
        open_values(file, "name")
    parquet.write_table(pa.table({"v": [1.0] * 2500 + [None, 2.0]}), file)
    with pytest.raises(InputError, match="'v' has no value in row 2501"):
        list(open_values(file, piece=1000))
    file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(InputError, match="damaged Parquet file"):
        open_values(file)


def test_parquet_without_pyarrow_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "v.parquet").write_bytes(b"PAR1....")
    for name in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(MissingExtra, match=r"baarda\[tables\]"):
        open_values(tmp_path / "v.parquet")
