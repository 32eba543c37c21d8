"""The report: sections of an analysis, laid out as text or as one self-contained page."""

from __future__ import annotations

import base64
import hashlib
import re
import textwrap
from html import escape
from importlib import resources
from typing import Any

from baarda.discover import members
from baarda.procedures.testing import Analysis
from baarda.report import plots
from baarda.report.sections.base import (
    WORDS,
    Block,
    Cell,
    DataTable,
    Figure,
    Interactive,
    Items,
    Paragraph,
    Section,
    SectionMaker,
    Verdict,
    say,
)
from baarda.report.sections.verdict import sentences
from baarda.report.translation import current, tr

__all__ = ["facts", "figures", "html", "name_of", "overall", "printable", "render", "sections", "text", "verdict"]

_WIDTH = 100


def sections(analysis: Analysis) -> list[Section]:
    """Return the sections of the report that apply, in order.

    Parameters
    ----------
    analysis : Analysis

    Returns
    -------
    list of Section
    """
    makers = [m for m in members("baarda.report.sections", SectionMaker) if isinstance(m, SectionMaker)]
    made = (m.make(analysis) for m in sorted(makers, key=lambda m: (m.order, m.id)))
    return [s for s in made if s is not None]


def verdict(analysis: Analysis) -> list[str]:
    """Return the outcome in five to eight plain sentences; one or two if the adjustment did not converge.

    Parameters
    ----------
    analysis : Analysis

    Returns
    -------
    list of str
    """
    return [printable(s.text) for s in sentences(analysis)]


def printable(words: str) -> str:
    r"""Return text without the characters that steer a terminal or turn the direction of writing; names come from strangers.

    Examples
    --------
    >>> printable("point \x1b[2J7")
    'point �[2J7'
    """
    return words if words.isprintable() else "".join(c if c.isprintable() else "\ufffd" for c in words)


def figures(made: list[Section]) -> dict[str, str]:
    """Return the figures of sections as SVG documents by file name without extension.

    Parameters
    ----------
    made : list of Section

    Returns
    -------
    dict of str
    """
    return {b.name: f'<?xml version="1.0" encoding="utf-8"?>\n{_labelled(b)}' for s in made for b in s.blocks if isinstance(b, Figure)}


def _labelled(figure: Figure) -> str:
    """Return the SVG with title and description for those who do not see it."""
    alt = escape(printable(figure.alt))
    said = f"<title>{escape(printable(figure.title))}</title>\n<desc>{alt}</desc>"
    head, rest = figure.svg.split(">", 1)
    return f'{head} role="img" aria-label="{alt}">\n {said}{rest}'


def text(made: list[Section]) -> str:
    """Return sections as plain text.

    Parameters
    ----------
    made : list of Section

    Returns
    -------
    str

    Examples
    --------
    >>> print(text([Section("a", "First", (Paragraph("One word."),))]), end="")
    1 First
    =======
    <BLANKLINE>
    One word.
    """
    lines: list[str] = []
    for number, section in enumerate(made, start=1):
        head = f"{number} {section.title}"
        lines += [*([""] if lines else []), head, "=" * len(head)]
        for block in section.blocks:
            lines += ["", *_text(block)]
    return "\n".join(printable(line.rstrip()) for line in lines) + "\n"


def _text(block: Block) -> list[str]:
    if isinstance(block, Paragraph):
        return textwrap.wrap(block.text, _WIDTH)
    if isinstance(block, Items):
        wrapped = [textwrap.wrap(e, _WIDTH, initial_indent="- ", subsequent_indent="  ") for e in block.entries]
        return [block.intro, *(line for lines in wrapped for line in lines)]
    if isinstance(block, Verdict):
        out: list[str] = []
        for s in block.sentences:
            head = f"[{tr(WORDS[s.tone])}] "
            out += textwrap.wrap(head + s.text, _WIDTH, subsequent_indent="    ")
        return out
    if isinstance(block, Figure):
        return textwrap.wrap(f"[{tr('Figure')} {block.name}: {block.title}. {block.alt}]", _WIDTH)
    if isinstance(block, Interactive):
        return textwrap.wrap(f"[{block.title}. {block.caption}]", _WIDTH)
    return _text_table(block)


def _plain(cell: str | Cell) -> str:
    return " ".join((cell.text if isinstance(cell, Cell) else cell).split("\n"))


def _text_table(table: DataTable) -> list[str]:
    heads = [[c.name for c in table.columns], [f"({c.unit})" if c.unit else "" for c in table.columns]]
    body = [[_plain(c) for c in row] for row in table.rows]
    most = 44 if len(table.columns) > 3 else 72
    grid: list[list[str]] = [h for h in heads if any(h)]
    rule = len(grid)
    for row in body:
        cells = [textwrap.wrap(c, most, subsequent_indent="  ") if len(c) > most else [c] for c in row]
        for i in range(max(len(c) for c in cells)):
            grid.append([c[i] if i < len(c) else "" for c in cells])
    widths = [max(len(row[k]) for row in grid) for k in range(len(table.columns))] if grid else []
    right = [c.align == "right" for c in table.columns]
    lines = ["  ".join(v.rjust(w) if r else v.ljust(w) for v, w, r in zip(row, widths, right, strict=True)) for row in grid]
    lines.insert(rule, "-" * (sum(widths) + 2 * max(0, len(widths) - 1)))
    meanings = [f"{names}: {meaning}" for names, meaning in glossary(table)]
    notes = [w for t in ("; ".join(meanings), table.note) if t for w in textwrap.wrap(t, _WIDTH)]
    return [table.caption, "", *lines, *([""] if notes else []), *notes]


def glossary(table: DataTable) -> list[tuple[str, str]]:
    """Return what the columns of a table mean: names and meaning, names that mean the same together."""
    out: dict[str, list[str]] = {}
    for c in table.columns:
        if c.meaning:
            out.setdefault(c.meaning, []).append(c.name)
    return [(", ".join(named), meaning) for meaning, named in out.items()]


def html(analysis: Analysis, made: list[Section]) -> str:
    """Return the sections of an adjustment as one page, see `render`.

    Parameters
    ----------
    analysis : Analysis
        For the head of the page.
    made : list of Section
        See `sections`.

    Returns
    -------
    str
    """
    return render("Adjustment report", name_of(analysis), analysis.adjustment.status, overall(analysis, made), facts(analysis), made)


def name_of(analysis: Analysis) -> str:
    """Return what the report is about: the name of the project, else where it was read."""
    net = analysis.adjustment.network
    return net.name or net.path or tr("network in memory")


def render(kind: str, name: str, status: str, overall: tuple[str, str], facts: list[tuple[str, str]], made: list[Section]) -> str:
    """Return sections as one page: nothing loaded from anywhere, readable offline, without scripts but for a view in space.

    Parameters
    ----------
    kind, name : str
        What is reported, and on what.
    status : str
        Outcome in one word.
    overall : (str, str)
        Tone and words of the whole.
    facts : list of (str, str)
        Names and values for the head of the page.
    made : list of Section

    Returns
    -------
    str
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    folder = resources.files("baarda.report") / "texts"
    environment = Environment(
        autoescape=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
        loader=FunctionLoader(lambda template: (folder / template).read_text(encoding="utf-8")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["cell"] = lambda value: isinstance(value, Cell)
    context: dict[str, Any] = {
        "kind": tr(kind),
        "language": current(),
        "tr": tr,
        "name": name,
        "status": status,
        "sections": [(n, s, [(type(b).__name__.lower(), b) for b in s.blocks]) for n, s in enumerate(made, start=1)],
        "words": {tone: tr(word) for tone, word in WORDS.items()},
        "inline": _inline,
        "glossary": glossary,
        "facts": [(tr(key), value) for key, value in facts],
        **_viewer(folder, made),
        "overall": overall,
    }
    return environment.get_template("report.html.j2").render(context)


def _viewer(folder: Any, made: list[Section]) -> dict[str, str]:
    """Return the script of views in space and the rule that lets only it run; nothing where the page has none."""
    if not any(isinstance(b, Interactive) for s in made for b in s.blocks):
        return {"viewer": "", "allowed": ""}
    script = (folder / "viewer.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return {"viewer": script, "allowed": f" script-src 'sha256-{digest}';"}


def overall(analysis: Analysis, made: list[Section]) -> tuple[str, str]:
    """Return tone and words of the whole: the gravest sentence decides."""
    if not analysis.converged:
        return "bad", tr("Not converged: no result")
    tones = [s.tone for section in made for b in section.blocks if isinstance(b, Verdict) for s in b.sentences]
    bad, warn = tones.count("bad"), tones.count("warn")
    if bad and warn:
        one = "{bad} of {total} statements failed a test, {warn} needs attention"
        more = "{bad} of {total} statements failed a test, {warn} need attention"
        return "bad", say(one if warn == 1 else more, bad=bad, warn=warn, total=len(tones))
    if bad:
        return "bad", say("{bad} of {total} statements failed a test", bad=bad, total=len(tones))
    if warn:
        one = "No statement failed; {warn} of {total} needs attention"
        more = "No statement failed; {warn} of {total} need attention"
        return "warn", say(one if warn == 1 else more, warn=warn, total=len(tones))
    return "good", tr("No statement failed")


def facts(analysis: Analysis) -> list[tuple[str, str]]:
    """Return names and values for the head of the page."""
    a = analysis.adjustment
    net = a.network
    facts = [("images", str(len(net.images.labels))), ("points", str(int((~a.aside).sum()))), ("observations n", str(a.count))]
    facts += [("unknowns u", str(a.numbering.count)), ("redundancy r", str(a.redundancy))]
    return [*facts, ("s0", f"{a.sigma0:.3f}")] if analysis.converged else facts


def _inline(figure: Figure) -> str:
    """Return the SVG for a page: colours follow the page, no namespaces (an HTML parser knows them)."""
    svg = re.sub(r' xmlns(:xlink)?="[^"]*"', "", figure.svg, count=2)
    svg = re.sub(r"<defs>\s*<style type=\"text/css\">[^<]*</style>\s*</defs>\s*", "", svg, count=1)
    for colour, variable in (
        (plots.INK, "ink"),
        (plots.MUTED, "muted"),
        (plots.LINE, "line"),
        (plots.BLUE, "blue"),
        (plots.ORANGE, "orange"),
        (plots.GREEN, "green"),
    ):
        svg = svg.replace(f": {colour}", f": var(--{variable})")
    head, rest = svg.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    width = re.search(r'viewBox="0 0 ([\d.]+)', head)
    style = f' style="width: {float(width[1]) / 72 * 96:.0f}px"' if width else ""
    # matplotlib escapes the text inside of the drawing.
    return f'{head} role="img" aria-label="{escape(printable(figure.alt))}"{style}>{rest}'
