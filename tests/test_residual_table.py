"""Tables of residuals: what is read from CSV, NPY and Parquet, and the one clear message for everything that is wrong."""

import pickle

import numpy as np
import pytest

from baarda.errors import BaardaError, InputError, MissingExtra
from baarda.formats.residual_table import read

GOOD = "image,residual,sigma,redundancy\na,0.3,1,0.5\na,-0.1,1,0.6\nb,-0.2,2,0.7\n"


@pytest.fixture
def csv(tmp_path):
    def make(text, name="v.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return make


@pytest.fixture
def npy(tmp_path):
    def make(values):
        np.save(tmp_path / "v.npy", values, allow_pickle=True)
        return tmp_path / "v.npy"

    return make


def test_all_columns_of_a_csv(csv):
    table = read(csv(GOOD))
    assert (table.format, table.column, table.group, table.sigma, table.redundancy) == ("csv", "residual", "image", "sigma", "redundancy")
    np.testing.assert_array_equal(table.values, [0.3, -0.1, -0.2])
    np.testing.assert_array_equal(table.groups, [0, 0, 1])
    assert table.group_names == ("a", "b")
    np.testing.assert_array_equal(table.sigmas, [1, 1, 2])
    np.testing.assert_array_equal(table.redundancy_numbers, [0.5, 0.6, 0.7])


@pytest.mark.parametrize(
    ("text", "column", "values"),
    [
        ("name,v\nx,1\ny,2\nz,4\n", "v", [1, 2, 4]),
        ("name;v\r\nx;1\r\ny;2\r\nz;4\r\n", "v", [1, 2, 4]),
        ("# made by hand\n\nv\tname\n1\tx\n2\ty\n\n4\tz\n", "v", [1, 2, 4]),
        ("\ufeffv\n1e-3\n-2\n+.5", "v", [1e-3, -2, 0.5]),
        ("1.5\n2\n-3\n", "1", [1.5, 2, -3]),
        ('v,"a\nb"\n1,"x, y"\n2,"line\nbreak"\n4,z\n', "v", [1, 2, 4]),
    ],
)
def test_plain_tables(csv, text, column, values):
    table = read(csv(text))
    assert table.column == column
    np.testing.assert_array_equal(table.values, values)


def test_image_comes_before_group_and_any_column_can_be_chosen(csv):
    path = csv("image,group,strip,residual\na,g,s,1\nb,g,t,2\nb,h,t,3\n")
    assert read(path).group == "image"
    assert read(path, group="strip").group_names == ("s", "t")


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("residual\n1\n2\nnan\n", {}, "line 4: residual is not a finite number"),
        ("residual\n1\n-inf\n3\n", {}, "line 3: residual is not a finite number"),
        ("residual\n1\n1e999\n3\n", {}, "line 3: residual is not a finite number"),
        ("residual\n5\n5\n5\n5\n", {}, "all 4 values of column 'residual' are equal (5)"),
        ("residual\n5\n6\n", {}, "has 2 values; at least 3"),
        ("residual\n5\n", {}, "has 1 value; at least 3"),
        ("residual\n", {}, "no rows"),
        ("", {}, "the file is empty"),
        ("\n\n# only a comment\n", {}, "no rows"),
        ("residual,x\n1,2\n3\n", {}, "line 3: the row has 1 field, the header 2"),
        ("residual,x\n1,2\n3,4,5\n", {}, "line 3: the row has 3 fields, the header 2"),
        ("residual,x\n1,2\n3,4\n5", {}, "line 4: the row has 1 field"),
        ("residual\n1\nabc\n3\n", {}, "line 3: residual is not a number: 'abc'"),
        ("residual\n1\n1_000\n3\n", {}, "line 3: residual is not a number: '1_000'"),
        ("residual;x\n1;1\n0,5;1\n3;1\n", {}, "write decimals with a point"),
        ("residual,x\n1,1\n,1\n3,1\n", {}, "line 3: residual is missing"),
        ("residual,residual\n1,2\n", {}, "column 'residual' appears twice"),
        ("a,b\nx,y\nz,w\n", {}, "no column of numbers; the columns are: a, b"),
        ("a,b\n1,2\n3,4\n5,6\n", {}, "choose one of a, b with --column"),
        ("a,b\n1,2\n3,4\n5,6\n", {"column": "c"}, "column 'c' is missing; there are: a, b"),
        ("a,b\n1,2\n3,4\n5,6\n", {"column": "a", "group": "strip"}, "column 'strip' is missing"),
        ("a,b\nx,2\ny,4\nz,6\n", {"column": "a"}, "line 2: a is not a number: 'x'"),
        ("residual,sigma\n1,1\n2,-1\n3,1\n", {}, "line 3: sigma must be positive: -1"),
        ("residual,sigma\n1,1\n2,0\n3,1\n", {}, "line 3: sigma must be positive: 0"),
        ("residual,redundancy\n1,1\n2,-0.2\n3,1\n", {}, "line 3: redundancy must lie between 0 and 1: -0.2"),
        ("residual,redundancy\n1,1\n2,1.5\n3,1\n", {}, "line 3: redundancy must lie between 0 and 1: 1.5"),
        ('residual\n1\n"2\n3\n', {}, "not a CSV table"),
        (b"residual\n1\n\xff\n", {}, "line 3: the file is not UTF-8 text"),
        (b"residual\n1\n2\x00\n3\n", {}, "v.csv"),
        (b"PK\x03\x04rubbish", {}, "ZIP archive"),
        (b"PAR1rubbish", {}, "arquet"),
        (b"\x93NUMPY\x01\x00rubbish", {}, "not a readable NPY array"),
        ("residual\n" + "1" * 200_000 + "\n", {}, "not a CSV table"),
    ],
)
def test_broken_tables(csv, text, options, message):
    with pytest.raises((InputError, MissingExtra)) as found:
        read(csv(text), **options)
    said = str(found.value)
    assert message in said
    assert "\n" not in said


def test_the_line_of_a_value_after_quoted_line_breaks(csv):
    with pytest.raises(InputError, match="line 5: residual is not a finite"):
        read(csv('residual,name\n1,"two\nlines"\n\n nan,x\n3,y\n'))


def test_a_line_without_end(csv):
    with pytest.raises(InputError, match="longer than"):
        read(csv(b"residual\n" + b"1," * 600_000))


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "absent.csv")
    with pytest.raises(InputError, match="is a folder"):
        read(tmp_path)


@pytest.mark.parametrize(
    "values",
    [np.array([1.0, 2, 4]), np.array([[1.0, 2, 4]]).T, np.array([1, 2, 4], dtype=np.int32), np.array([1, 2, 4], dtype=">f4")],
    ids=["1-D", "2-D", "int", "big-endian"],
)
def test_npy(npy, values):
    table = read(npy(values))
    assert (table.format, table.column) == ("npy", "1")
    np.testing.assert_array_equal(table.values, [1, 2, 4])


def test_columns_of_npy(npy):
    path = npy(np.array([[1.0, 7], [2, 7], [4, 8]]))
    table = read(path, column="1", group="2")
    assert table.group_names == ("7", "8")
    with pytest.raises(InputError, match="choose one of 1, 2"):
        read(path)


def test_structured_npy(npy):
    kind = [("image", "U5"), ("residual", "f4"), ("sigma", "f8"), ("xy", "f8", 2)]
    table = read(npy(np.array([("b", 1, 1, (0, 0)), ("a", 2, 1, (0, 0)), ("b", 4, 2, (0, 0))], dtype=kind)))
    assert table.group_names == ("b", "a")
    np.testing.assert_array_equal(table.groups, [0, 1, 0])
    assert any("xy" in a for a in table.assumptions)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.array([1.0, None, 3.0], dtype=object), "Python objects is refused"),
        (np.array([1.0, np.nan, 3.0]), "value 2: 1 is not a finite number"),
        (np.array([1.0, 1.0, 1.0]), "are equal"),
        (np.array([1.0, 2.0]), "at least 3"),
        (np.array([]), "at least 3"),
        (np.array(1.0), "0 dimensions"),
        (np.zeros((2, 2, 2)), "3 dimensions"),
        (np.array(["a", "b", "c"]), "no column of numbers"),
        (np.array([1j, 2, 3]), "no column of numbers"),
        (np.zeros((1, 20_000)), "transposed"),
    ],
)
def test_broken_npy(npy, values, message):
    with pytest.raises(InputError, match=message):
        read(npy(values))


def test_nothing_is_unpickled(npy, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "exploded"), "w"))

    for path in (npy(np.array([Bomb()], dtype=object)), tmp_path / "p.npy"):
        if path.name == "p.npy":
            path.write_bytes(pickle.dumps(Bomb()))
        with pytest.raises(InputError):
            read(path)
    assert not (tmp_path / "exploded").exists()


def test_truncated_and_spoilt_npy(npy, tmp_path):
    data = npy(np.arange(100.0)).read_bytes()
    rng = np.random.default_rng(0)
    spoilt = tmp_path / "s.npy"
    for k in range(300):
        cut = bytearray(data[: rng.integers(8, len(data))] if k % 2 else data)
        for at in rng.integers(6, min(len(cut), 128), 3):
            cut[at] = rng.integers(256)
        spoilt.write_bytes(cut)
        try:
            table = read(spoilt)
        except BaardaError:
            continue
        assert np.isfinite(table.values).all()


def test_spoilt_csv(csv):
    data = (GOOD * 1).encode() + b'c,"0.5",1,0.5\n' * 20
    rng = np.random.default_rng(1)
    for _ in range(300):
        bad = bytearray(data[: rng.integers(1, len(data))])
        for at in rng.integers(0, len(bad), 4):
            bad[at] = rng.choice(list(b'\n\r",;\t\x00\xff\\a1e.-'))
        try:
            table = read(csv(bytes(bad)))
        except BaardaError as error:
            assert str(error)
            continue
        assert len(table.values) >= 3


def test_parquet(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="the extra 'tables' is not installed")
    from pyarrow import parquet

    path = tmp_path / "v.parquet"

    def written(**columns):
        parquet.write_table(pyarrow.table(columns), path)
        return path

    table = read(written(image=["b", "a", "b"], residual=[1.0, 2.0, 4.0], sigma=[1, 1, 2]))
    assert (table.format, table.group_names) == ("parquet", ("b", "a"))
    np.testing.assert_array_equal(table.values, [1, 2, 4])
    with pytest.raises(InputError, match="value 2: residual is missing"):
        read(written(residual=[1.0, None, 3.0]))
    with pytest.raises(InputError, match="value 1: residual is not a finite"):
        read(written(residual=[np.nan, 2.0, 3.0]))
    with pytest.raises(InputError, match="not real numbers"):
        read(written(residual=["a", "b", "c"]))
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match="not a readable Parquet table"):
        read(path)
