"""A reproduction as text, as a page, as JSON, and as a folder."""

from __future__ import annotations

import csv
import io
import json
import textwrap
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

from baarda import __version__
from baarda.formats.folder import Mark, write_folder
from baarda.papers._drawing import document, inline
from baarda.papers.base import Comparison, Reproduction, Row, Value

SCHEMA = "baarda.reproduction/1"
MARK = Mark("reproduce.json", "baarda.reproduction/", ("reproduce.html", "reproduce.json", "tables", "figures"))
_WIDTH = 100


def _shown(value: Value | None, decimals: int) -> str:
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    return f"{value:.{decimals}f}" if abs(value) < float("inf") else "inf"


def _difference(r: Row) -> str:
    if r.difference is None or not abs(r.difference) < float("inf"):
        return "" if r.agrees else "differs"
    return "0" if r.agrees else f"{r.difference:+.{r.decimals}f}"


def _why(r: Row) -> str:
    return "; ".join(t for t in ("" if r.reason is None else r.reason.code, r.remark) if t)


def rows(c: Comparison) -> Iterator[tuple[tuple[str, ...], str, str, str, str]]:
    """Yield labels, printed value, ours, difference and reason of each row, as text."""
    for r in c.rows:
        yield r.labels, _shown(r.printed, r.decimals), _shown(r.ours, r.decimals), _difference(r), _why(r)


def render_text(reproduction: Reproduction) -> str:
    """Return a reproduction as plain text: outcome, tables, captions of the figures.

    Parameters
    ----------
    reproduction : Reproduction

    Returns
    -------
    str

    Examples
    --------
    >>> print(render_text(Reproduction((), (), ("All agrees.",), title="A paper")), end="")
    A paper
    =======
    <BLANKLINE>
    - All agrees.
    """
    lines = [reproduction.title, "=" * len(reproduction.title)]
    lines += textwrap.wrap(reproduction.reference, _WIDTH)
    lines.append("")
    for s in reproduction.sentences:
        lines += textwrap.wrap(s, _WIDTH, initial_indent="- ", subsequent_indent="  ")
    for c in reproduction.comparisons:
        lines += ["", c.title, "-" * len(c.title), *textwrap.wrap(c.note, _WIDTH), *([""] if c.note else []), *_grid(c)]
        for reason in c.reasons:
            lines += textwrap.wrap(f"{reason.code}: {reason.text}", _WIDTH, subsequent_indent="  ")
    for f in reproduction.figures:
        lines += ["", *textwrap.wrap(f"[{f.title}. {f.alt}]", _WIDTH)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _grid(c: Comparison) -> list[str]:
    table = [[*c.columns, *c.heads, "difference", "reason"]]
    table += [[*labels, printed, ours, difference, why] for labels, printed, ours, difference, why in rows(c)]
    widths = [max(len(line[k]) for line in table) for k in range(len(table[0]))]
    right = range(len(c.columns), len(c.columns) + 3)
    lines = [
        "  ".join(t.rjust(w) if k in right else t.ljust(w) for k, (t, w) in enumerate(zip(line, widths, strict=True))) for line in table
    ]
    return [lines[0], "-" * len(lines[0].rstrip()), *lines[1:], ""]


def html(reproduction: Reproduction) -> str:
    """Return a reproduction as one page: no scripts, nothing loaded from anywhere.

    Parameters
    ----------
    reproduction : Reproduction

    Returns
    -------
    str

    Examples
    --------
    >>> "<h1>a &lt; b</h1>" in html(Reproduction((), (), (), title="a < b"))
    True
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    folder = resources.files("baarda.papers") / "texts"
    environment = Environment(
        autoescape=True,
        loader=FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("reproduce.html.j2").render(made=reproduction, rows=rows, inline=inline)


def document_json(reproduction: Reproduction) -> dict[str, Any]:
    """Return the content of `reproduce.json`: every value in full, infinite ones as None."""
    reasons = {r.code: r.text for c in reproduction.comparisons for r in c.reasons}
    return {
        "schema": SCHEMA,
        "paper": {"name": reproduction.name, "title": reproduction.title, "reference": reproduction.reference},
        "sentences": list(reproduction.sentences),
        "comparisons": [
            {
                "table": c.table,
                "title": c.title,
                "columns": list(c.columns),
                "heads": list(c.heads),
                "note": c.note,
                "rows": [
                    {
                        "labels": list(r.labels),
                        "printed": _finite(r.printed),
                        "ours": _finite(r.ours),
                        "difference": _finite(r.difference),
                        "decimals": r.decimals,
                        "agrees": r.agrees,
                        "reason": None if r.reason is None else r.reason.code,
                        "remark": r.remark,
                    }
                    for r in c.rows
                ],
            }
            for c in reproduction.comparisons
        ],
        "reasons": reasons,
        "figures": [{"name": f.name, "title": f.title, "caption": f.caption, "alt": f.alt} for f in reproduction.figures],
        "software": {"name": "baarda", "version": __version__},
    }


def _finite(value: Value | None) -> Value | None:
    return value if value is None or isinstance(value, str) or abs(value) < float("inf") else None


def table_csv(c: Comparison) -> str:
    """Return a comparison as CSV; numbers read back exactly."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*c.columns, *c.heads, "difference", "reason", "remark"])
    for r in c.rows:
        values = ["" if v is None else v if isinstance(v, str) else repr(float(v)) for v in (r.printed, r.ours, r.difference)]
        writer.writerow([*r.labels, *values, "" if r.reason is None else r.reason.code, r.remark])
    return out.getvalue()


def write(reproduction: Reproduction, folder: str | Path) -> Path:
    """Write `reproduce.html`, `reproduce.json`, `tables/*.csv` and `figures/*.svg`.

    Parameters
    ----------
    reproduction : Reproduction
    folder : str or Path
        There whole or not at all; an earlier reproduction there is replaced.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    OutputError
        If the folder holds something else, or cannot be written.
    """
    target = Path(folder)
    files = {
        "reproduce.html": html(reproduction),
        "reproduce.json": json.dumps(document_json(reproduction), indent=1, allow_nan=False, ensure_ascii=False) + "\n",
    }
    files |= {f"tables/{c.table}.csv": table_csv(c) for c in reproduction.comparisons}
    files |= {f"figures/{f.name}.svg": document(f.svg, f.title, f.alt) for f in reproduction.figures}
    write_folder(target, files, mark=MARK)
    return target
