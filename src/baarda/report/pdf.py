"""The report as PDF, typeset by Typst (extra `pdf`): the same sections, every text passed as data and never as markup."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from importlib import resources
from pathlib import Path
from typing import Any

from baarda.errors import MissingExtra, OutputError
from baarda.procedures.testing import Analysis
from baarda.report import page, plots
from baarda.report.sections.base import WORDS, Block, Cell, DataTable, Figure, Interactive, Items, Paragraph, Section, Verdict
from baarda.report.translation import current, tr

__all__ = ["check_pdf", "pdf"]

_WIDE = 24  # characters from which a column may wrap
_INCHES = 7.0  # width of the printed page
_TALL = 7.8  # height of the largest figure, so that title and caption stay on its page
_ACROSS = 165  # characters of the smallest type that a page takes upright


def check_pdf() -> None:
    """Refuse, before any work, where the extra is not installed.

    Raises
    ------
    MissingExtra
    """
    try:
        import typst  # noqa: F401
    except ImportError:
        raise MissingExtra("pdf", "--pdf") from None


def pdf(analysis: Analysis, made: list[Section]) -> bytes:
    """Return the report of an adjustment as PDF, the same bytes for the same report.

    Parameters
    ----------
    analysis : Analysis
        For the head of the document.
    made : list of Section
        See `baarda.report.page.sections`.

    Returns
    -------
    bytes

    Raises
    ------
    MissingExtra
        Without the extra `pdf`.
    OutputError
        If the document cannot be typeset.
    """
    check_pdf()
    import matplotlib
    import typst

    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    template = resources.files("baarda.report") / "texts" / "report.typ"
    with tempfile.TemporaryDirectory(prefix="baarda-pdf-") as name:
        folder = Path(name)
        (folder / "figures").mkdir()
        (folder / "report.typ").write_text(template.read_text(encoding="utf-8"), encoding="utf-8")
        (folder / "data.json").write_text(json.dumps(content(analysis, made), ensure_ascii=False, allow_nan=False), encoding="utf-8")
        for figure, svg in page.figures(made).items():
            (folder / "figures" / f"{figure}.svg").write_text(svg.replace(plots.FONTS, "'DejaVu Sans'"), encoding="utf-8")
        try:
            return bytes(typst.compile(str(folder / "report.typ"), root=name, font_paths=[str(fonts)]))
        except typst.TypstError as error:
            raise OutputError(f"the PDF could not be typeset: {error}") from None
        finally:
            shutil.rmtree(folder / "figures", ignore_errors=True)


def content(analysis: Analysis, made: list[Section]) -> dict[str, Any]:
    """Return what the template of the PDF lays out: printable strings and nothing else."""
    said = page.printable
    return {
        "language": current(),
        "kind": tr("Adjustment report"),
        "name": said(page.name_of(analysis)),
        "overall": list(page.overall(analysis, made)),
        "words": {tone: tr(word) for tone, word in WORDS.items()},
        "facts": [[tr(key), value] for key, value in page.facts(analysis)],
        "sections": [
            {"number": str(n), "title": said(s.title), "blocks": [_block(b) for b in s.blocks if not isinstance(b, Interactive)]}
            for n, s in enumerate(made, start=1)
        ],
    }


def _block(block: Block) -> dict[str, Any]:
    said = page.printable
    if isinstance(block, Paragraph):
        return {"kind": "paragraph", "text": said(block.text), "tone": block.tone}
    if isinstance(block, Items):
        return {"kind": "items", "intro": said(block.intro), "entries": [said(e) for e in block.entries]}
    if isinstance(block, Verdict):
        return {
            "kind": "verdict",
            "sentences": [{"subject": said(s.subject), "text": said(s.text), "tone": s.tone} for s in block.sentences],
        }
    if isinstance(block, Figure):
        found = re.search(r'width="([\d.]+)pt"', block.svg)
        height = re.search(r'height="([\d.]+)pt"', block.svg)
        width = min(1.0, float(found[1]) / 72.0 / _INCHES) if found else 0.9
        if found and height:
            width = min(width, _TALL * float(found[1]) / float(height[1]) / _INCHES)
        texts = {k: said(v) for k, v in (("title", block.title), ("caption", block.caption), ("alt", block.alt))}
        return {"kind": "figure", "name": block.name, "width": width, **texts}
    if isinstance(block, DataTable):
        return _table(block)
    raise TypeError(f"no such block: {type(block).__name__}")


def _table(table: DataTable) -> dict[str, Any]:
    rows = [[_cell(c) for c in row] for row in table.rows]
    longest = [max((len(part) for row in rows for part in row[k]["text"].split("\n")), default=0) for k in range(len(table.columns))]
    words = [max(len(word) for word in re.split(r"[ ,]", f"{c.name} {c.unit}")) for c in table.columns]
    need = sum(max(w, min(n, _WIDE)) + 2 for w, n in zip(words, longest, strict=True))
    return {
        "kind": "table",
        "across": need > _ACROSS,
        "caption": page.printable(table.caption),
        "columns": [
            {"name": page.printable(c.name), "unit": page.printable(c.unit), "align": c.align, "wide": c.align == "left" and n > _WIDE}
            for c, n in zip(table.columns, longest, strict=True)
        ],
        "rows": rows,
        "note": page.printable(table.note),
        "glossary": [[page.printable(names), page.printable(meaning)] for names, meaning in page.glossary(table)],
    }


def _cell(cell: str | Cell) -> dict[str, str]:
    text, tone = (cell.text, cell.tone) if isinstance(cell, Cell) else (cell, "")
    return {"text": "\n".join(page.printable(line) for line in text.strip().split("\n")), "tone": tone}
