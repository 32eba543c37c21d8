"""The limits that the page "Files of strangers" states: memory, entities, packing, JSON, places."""

import io
import json
import tracemalloc
import zipfile
from pathlib import Path

import pytest

import test_format_metashape
from baarda.errors import BaardaError, InputError
from baarda.formats import read
from baarda.formats.base import read_lines
from baarda.formats.csv_table import read_csv
from baarda.formats.json_tree import parse_json
from baarda.formats.number_text import NumberText
from baarda.formats.xml_tree import parse_xml
from fuzzing.mutations import ENTITIES, packed
from fuzzing.run import MULTIPLE, allowed
from fuzzing.seeds import seeds

N = 30_000
HERE = Path("x")


@pytest.mark.parametrize(
    ("content", "reader"),
    [
        ("<r>" + "<a/>" * N + "</r>", lambda f: parse_xml(f.read_bytes(), f)),
        ("<r>" + "<a b='1'/>" * N + "</r>", lambda f: parse_xml(f.read_bytes(), f)),
        ("[" + "{}," * N + "{}]", lambda f: parse_json(f.read_text(), f)),
        ("[" + "[]," * N + "[]]", lambda f: parse_json(f.read_text(), f)),
        ("1\n" * N, lambda f: list(read_lines(f))),
        ("a\n" + "1\n" * N, lambda f: read_csv(f, ("a",))),
        ("a,b\n" + ",\n" * N, lambda f: read_csv(f, ("a", "b"))),
        ("1 " * N, lambda f: NumberText.of(f, f.read_bytes())),
        ("<document dbat_script_version='1'>" + "<c/>" * N + "</document>", lambda f: read(f, format="dbat")),
        ("<gama-local>" + "<c/>" * N + "</gama-local>", lambda f: read(f, format="gama")),
    ],
    ids=["xml", "attributes", "objects", "arrays", "lines", "csv", "columns", "numbers", "dbat", "gama"],
)
def test_the_densest_contents_take_less_memory_than_promised(tmp_path, content, reader):
    path = tmp_path / "x.txt"
    path.write_text(content)
    tracemalloc.start()
    try:
        reader(path)
    except BaardaError:
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MULTIPLE * len(content)
    assert MULTIPLE * len(content) < allowed(len(content))


@pytest.mark.parametrize("entity", ENTITIES)
@pytest.mark.parametrize("reader", ["dbat", "gama", "metashape"])
def test_no_entity_is_expanded(tmp_path, reader, entity):
    tried = 0
    for seed in seeds(reader):
        name = seed.entry if seed.files[seed.entry].startswith(b"<") else None
        if name is None:
            continue
        text = seed.files[name].decode()
        at = text.index("?>") + 2 if text.startswith("<?") else 0
        for file, content in seed.files.items():
            (tmp_path / seed.label / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / seed.label / file).write_bytes(content)
        (tmp_path / seed.label / name).write_text(text[:at] + entity + text[at:])
        with pytest.raises(InputError, match="document type or entity"):
            read(tmp_path / seed.label / name, format=reader)
        tried += 1
    assert tried


def test_an_archive_that_unpacks_a_thousandfold_and_one_with_too_many_parts(tmp_path, monkeypatch):
    path = tmp_path / "block.psz"
    path.write_bytes(packed([("doc.xml", b"<document>" + b" " * (64 << 20) + b"</document>")]))
    with pytest.raises(InputError, match=r"unpacks to \d+ bytes; the limit is \d+"):
        read(path, format="metashape")
    path.write_bytes(packed([(f"{i}", b"") for i in range(60)]))
    monkeypatch.setattr("baarda.formats.zip_parts.MOST_PARTS", 50)
    with pytest.raises(InputError, match="has 60 parts; the limit is 50"):
        read(path, format="metashape")


def test_parts_of_an_archive_with_hostile_names_are_never_written(tmp_path):
    path = tmp_path / "in" / "block.psz"
    path.parent.mkdir()
    test_format_metashape.psz(path.parent)
    with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as old:
        parts = [(n, old.read(n)) for n in old.namelist()]
    path.write_bytes(packed([*parts, ("../../outside.txt", b"x"), ("/etc/outside", b"x"), ("..\\outside", b"x")]))
    read(path)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["block.psz", "in"]


@pytest.mark.parametrize("text", ['{"a": NaN}', '{"a": -Infinity}', '{"a": 1, "a": 2}', "[" * 100_000, "9" * 6000, '{"a": 1e999}'])
def test_json_that_is_none(text):
    if "e999" in text:
        with pytest.raises(InputError):
            parse_json(text, HERE).need("a").number()
        return
    with pytest.raises(InputError):
        parse_json(text, HERE)


@pytest.mark.parametrize("name", ["../points.csv", "/etc/passwd", "a/../../b.csv", "..\\b.csv", "sub/points.csv"])
def test_tables_of_a_project_lie_in_its_folder(tmp_path, name):
    (seed,) = [s for s in seeds("project") if s.label == "ring"]
    for file, content in seed.files.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_bytes(content)
    header = (tmp_path / seed.entry).read_text()
    old = next(line for line in header.splitlines() if line.startswith("points = "))
    (tmp_path / seed.entry).write_text(header.replace(old, f"points = {json.dumps(name)}"))
    with pytest.raises(InputError, match=r"must be the plain name of a \.csv file"):
        read(tmp_path)
