"""Examples that run while the site is built: what they print must be what the page says, and figures come from the block on the page.

Every page has one namespace and one empty folder. Blocks that begin with ``>>>`` are run as doctests; blocks of language `console` whose
lines begin with ``$ baarda`` are run as commands; `report-figure` and `report-table` show a part of the report of `analysis`, a name that
an example before has defined. A difference is a warning, so that ``-W`` ends the build.
"""

import contextlib
import doctest
import io
import os
import re
import tempfile
import warnings
from html import escape
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.util import logging

logger = logging.getLogger(__name__)
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


class part(nodes.General, nodes.Element):
    """A place for a figure or a table of the report."""


class Shown(Directive):
    """A figure (by file name) or a table (by caption) of the report."""

    required_arguments = 1
    final_argument_whitespace = True
    option_spec: ClassVar = {"rows": int}

    def run(self) -> list[nodes.Node]:
        """Leave a place that is filled when the examples before it have run."""
        place = part(kind=self.name, wanted=self.arguments[0], rows=self.options.get("rows", 12))
        place.source, place.line = self.state_machine.get_source_and_line(self.lineno)
        return [place]


def execute(app: Any, doctree: nodes.document) -> None:
    """Run the examples of a page in their order and fill the places."""
    found = [n for n in doctree.findall() if isinstance(n, part) or _runs(n)]
    if app.env.docname.startswith("extend/"):  # they need the new file in its folder: a test of the package runs them
        return
    if not found or app.builder.name not in ("html", "dirhtml", "singlehtml"):
        return
    here = Path.cwd()
    namespace: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        os.chdir(folder)
        try:
            for node in found:
                if isinstance(node, part):
                    node.replace_self(nodes.raw("", _part(node, namespace), format="html"))
                elif node["language"] == "console":
                    _commands(node)
                else:
                    _doctest(node, namespace)
        finally:
            os.chdir(here)


def _runs(node: nodes.Node) -> bool:
    if not isinstance(node, nodes.literal_block):
        return False
    language, text = node.get("language"), node.astext()
    return (language in ("python", "pycon") and text.startswith(">>>")) or (language == "console" and text.startswith("$ baarda"))


def _doctest(node: nodes.Element, namespace: dict[str, Any]) -> None:
    test = doctest.DocTestParser().get_doctest(node.astext() + "\n", namespace, "example", node.source, node.line or 0)
    told = io.StringIO()
    runner = doctest.DocTestRunner(optionflags=FLAGS, verbose=False)
    with contextlib.redirect_stderr(io.StringIO()):
        runner.run(test, out=told.write, clear_globs=False)
    namespace.update(test.globs)
    if runner.failures:
        logger.warning("an example fails:\n%s", told.getvalue(), location=node)


def _commands(node: nodes.Element) -> None:
    """Run commands; the lines below each, if any, are its standard output (``...`` stands for anything)."""
    from typer.testing import CliRunner

    from baarda.cli import app as program

    for piece in re.split(r"^\$ ", node.astext(), flags=re.MULTILINE)[1:]:
        line, _, wanted = piece.partition("\n")
        result = CliRunner().invoke(program, line.partition("#")[0].split()[1:])
        if result.exit_code:
            logger.warning("%s ends with %s:\n%s", line, result.exit_code, result.output, location=node)
        elif wanted.strip() and not doctest.OutputChecker().check_output(wanted.strip() + "\n", result.stdout.strip() + "\n", FLAGS):
            logger.warning("%s prints\n%s", line, result.stdout, location=node)


def _part(node: nodes.Element, namespace: dict[str, Any]) -> str:
    from baarda.report import page
    from baarda.report.sections.base import DataTable, Figure

    if "sections of the report" not in namespace:
        namespace["sections of the report"] = page.sections(namespace["analysis"])
    blocks = [b for s in namespace["sections of the report"] for b in s.blocks]
    for b in blocks:
        if node["kind"] == "report-figure" and isinstance(b, Figure) and b.name == node["wanted"]:
            svg = b.svg[b.svg.index("<svg") :]
            drawing = f'<div style="background: white; padding: 0.5rem" role="img" aria-label="{escape(b.alt)}">{svg}</div>'
            caption = f"<figcaption><strong>{escape(b.title)}.</strong> {escape(b.caption)}</figcaption>"
            return f'<figure class="report">{drawing}{caption}</figure>'
        if node["kind"] == "report-table" and isinstance(b, DataTable) and b.caption == node["wanted"]:
            return _table(b, node["rows"])
    logger.warning("the report has no %s %r", node["kind"], node["wanted"], location=node)
    return ""


def _table(table: Any, most: int) -> str:
    heads = "".join(
        f'<th scope="col" title="{escape(c.meaning)}" style="text-align:{c.align}">{escape(c.name)}'
        f"{'<br>' + escape(c.unit) if c.unit else ''}</th>"
        for c in table.columns
    )
    rows = []
    for row in table.rows[:most]:
        cells = (escape(getattr(v, "text", v)).replace("\n", "<br>") for v in row)
        rows.append("".join(f'<td style="text-align:{c.align}">{v}</td>' for c, v in zip(table.columns, cells, strict=True)))
    left = len(table.rows) - most
    note = f"<p>The first {most} of {len(table.rows)} rows.</p>" if left > 0 else ""
    body = "".join(f"<tr>{r}</tr>" for r in rows)
    inner = f"<caption>{escape(table.caption)}</caption><thead><tr>{heads}</tr></thead><tbody>{body}</tbody>"
    return f'<div class="pst-scrollable-table-container"><table class="table">{inner}</table></div>{note}'


def nothing_is_fetched(app: Any, error: Exception | None) -> None:
    """Refuse a page that would load anything from another place."""
    if error is not None or app.builder.format != "html":
        return
    attribute = r"""(?:src=|url\(|@import\s|<link[^>]*rel=["'](?:stylesheet|preload|icon)["'][^>]*href=)["']?"""
    loads = re.compile(attribute + r"""(?:https?:)?//[^"')\s]+""")
    for path in Path(app.outdir).rglob("*.html"):
        for found in loads.finditer(path.read_text(encoding="utf-8")):
            logger.warning("%s loads %s", path.name, found[0])


def setup(app: Any) -> dict[str, Any]:
    """Register with Sphinx."""
    app.add_node(part)
    app.add_directive("report-figure", Shown)
    app.add_directive("report-table", Shown)
    app.connect("doctree-read", execute)
    app.connect("build-finished", nothing_is_fetched)
    return {"parallel_read_safe": False}
