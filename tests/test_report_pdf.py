"""The report as PDF: the extra, its absence, the same bytes twice, and names from strangers."""

import json
import sys
from dataclasses import replace

import pytest
from typer.testing import CliRunner

import baarda
from baarda.cli import app
from baarda.errors import MissingExtra
from baarda.procedures.testing import analyse
from baarda.report import page, pdf, write_report
from baarda.report.sections.base import Cell, Column, DataTable, Figure, Interactive
from baarda.report.translation import language
from networks import ring

HOSTILE = ("#panic()", "$x^2$", "*bold*", "@ref", "<label>", "\\u{1f}", "`raw`", '"quote', "= head", "// gone", "\x1b[2J", "图像")


@pytest.fixture(scope="module")
def hostile():
    n = ring(control=5, checks=3)
    named = tuple(f"{HOSTILE[k % len(HOSTILE)]}{k}" for k in range(len(n.points.labels)))
    return analyse(baarda.adjust(replace(n, name='#include "/etc/passwd"', points=replace(n.points, labels=named))))


def test_content_is_strings_and_all_sections(hostile):
    made = page.sections(hostile)
    said = pdf.content(hostile, made)
    assert [s["title"] for s in said["sections"]] == [s.title for s in made]
    text = json.dumps(said, allow_nan=False, ensure_ascii=False)
    assert "\x1b" not in text and "#panic()0" in text
    for section, whole in zip(said["sections"], made, strict=True):
        assert len(section["blocks"]) == sum(not isinstance(b, Interactive) for b in whole.blocks)
    figures = [b for s in said["sections"] for b in s["blocks"] if b["kind"] == "figure"]
    assert len(figures) == sum(isinstance(b, Figure) for s in made for b in s.blocks)
    assert all(0.2 < f["width"] <= 1.0 and len(f["alt"]) > 40 for f in figures)


def test_wide_tables_lie_across():
    def columns(count):
        return tuple(Column(f"column-{k}") for k in range(count))

    assert pdf._table(DataTable("few", columns(4), (("1.0",) * 4,)))["across"] is False
    many = pdf._table(DataTable("many", columns(18), (("1.0",) * 17 + (Cell("failed", "bad"),),)))
    assert many["across"] is True and many["rows"][0][-1] == {"text": "failed", "tone": "bad"}


def test_without_the_extra_one_line(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "typst", None)
    with pytest.raises(MissingExtra, match=r'pip install "baarda\[pdf\]"'):
        pdf.check_pdf()
    run = CliRunner().invoke(app, ["demo", "--pdf", "--out", str(tmp_path / "out")])
    assert run.exit_code == 2 and run.output == "baarda: --pdf needs the 'pdf' extra: pip install \"baarda[pdf]\"\n"
    assert not (tmp_path / "out").exists()


def test_same_bytes_twice_in_both_languages(hostile):
    pytest.importorskip("typst")
    for code in ("en", "de"):
        with language(code):
            made = page.sections(hostile)
            first = pdf.pdf(hostile, made)
            assert first.startswith(b"%PDF-1.") and first.rstrip().endswith(b"%%EOF")
            assert pdf.pdf(hostile, page.sections(hostile)) == first


def test_command_line_writes_it_beside_the_page(tmp_path):
    pytest.importorskip("typst")
    out = tmp_path / "out"
    run = CliRunner().invoke(app, ["demo", "--pdf", "--language", "de", "--out", str(out)])
    assert run.exit_code == 0 and "Die Ausgleichung ist in 8 Iterationen konvergiert" in run.output
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    assert '<html lang="de">' in (out / "report.html").read_text(encoding="utf-8")
    assert json.loads((out / "result.json").read_text(encoding="utf-8"))["status"] == "converged"
    write_report(baarda.adjust(ring(control=4)), out)  # such a folder is ours: it may be replaced
    assert not (out / "report.pdf").exists()


def test_pdf_needs_a_folder():
    pytest.importorskip("typst")
    run = CliRunner().invoke(app, ["demo", "--pdf", "--json"])
    assert run.exit_code == 2 and "--pdf writes into the result folder" in run.output
