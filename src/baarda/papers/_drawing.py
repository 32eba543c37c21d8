"""Figures of papers as SVG text: class counts with the curves of laws; the same bytes for the same numbers."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from baarda.distributions.base import Distribution, Floats

INK, MUTED, LINE, BLUE, ORANGE, GREEN = "#24292f", "#656d76", "#c8ced6", "#0072b2", "#d55e00", "#009e73"
_DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5)))
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "baarda",
    "text.parse_math": False,
    "axes.unicode_minus": False,
    "axes.facecolor": "none",
    "axes.edgecolor": MUTED,
    "axes.axisbelow": True,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}


def class_histogram(
    name: str, counts: Floats, edges: Floats, laws: Sequence[tuple[str, Distribution]], total: float, label: str, unit: str = ""
) -> str:
    """Return class counts, divided by the class width, with the curves of laws.

    Parameters
    ----------
    name : str
        Prefix of all ids: lower-case letters, digits, hyphens.
    counts, edges : (k,) and (k+1,) arrays
        Counts and finite class limits.
    laws : sequence of (label, law)
    total : float
        Number of values that the densities are multiplied with.
    label : str
        Of the horizontal axis.
    unit : str
        Its unit; the vertical axis is "values per unit".

    Returns
    -------
    str
        An ``<svg>`` element.

    Examples
    --------
    >>> svg = class_histogram("tiny", np.array([2.0, 3.0]), np.array([-1.0, 0.0, 1.0]), [], 5.0, "x")
    >>> svg.startswith("<svg"), svg == class_histogram("tiny", np.array([2.0, 3.0]), np.array([-1.0, 0.0, 1.0]), [], 5.0, "x")
    (True, True)
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    width = np.diff(edges)
    x = np.linspace(1.12 * edges[0], 1.12 * edges[-1], 400)  # even: no point at a centre where a density is infinite
    out = io.StringIO()
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # a user's matplotlibrc changes nothing
        settings: Any = matplotlib.rcParams
        settings.update(_STYLE)
        figure = Figure(figsize=(5.2, 3.3), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot()
        axes.bar(edges[:-1], counts / width, width, align="edge", color=BLUE, alpha=0.25, edgecolor=BLUE, linewidth=0.6, label="counts")
        for (text, law), colour, dashes in zip(laws, (INK, ORANGE, GREEN, BLUE), _DASHES, strict=False):
            axes.plot(x, total * law.pdf(x), color=colour, linestyle=dashes, linewidth=1.5, label=text)
        axes.set_xlim(x[0], x[-1])
        axes.set_ylim(0.0, None)
        axes.set_xlabel(f"{label} ({unit})" if unit else label)
        axes.set_ylabel(f"values per {unit or 'unit'}")
        axes.grid(True, axis="y")
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.legend(loc="upper right", fontsize=8.5)
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return _own(out.getvalue(), name)


def _own(svg: str, name: str) -> str:
    """Drop prologue and comments, and make the ids of a drawing its own so that several can stand on one page."""
    svg = re.sub(r"<!--.*?-->\s*|<metadata>.*?</metadata>\s*", "", svg[svg.index("<svg") :], flags=re.DOTALL).rstrip() + "\n"
    svg = re.sub(r'\b(id|xlink:href|href)="(#?)([A-Za-z][^":]*)"', rf'\1="\2{name}-\3"', svg)
    return re.sub(r"url\(#([^)]*)\)", rf"url(#{name}-\1)", svg)


def document(svg: str, title: str, alt: str) -> str:
    """Return an ``<svg>`` element as a file that says what it shows."""
    head, rest = svg.split(">", 1)
    said = f"<title>{escape(title)}</title>\n<desc>{escape(alt)}</desc>"
    return f'<?xml version="1.0" encoding="utf-8"?>\n{head} role="img" aria-label="{escape(alt)}">\n{said}{rest}'


def inline(svg: str, alt: str) -> str:
    """Return an ``<svg>`` element for a page, whose neutral colours it takes."""
    svg = re.sub(r"<defs>\s*<style type=\"text/css\">[^<]*</style>\s*</defs>\s*", "", svg, count=1)
    for colour, variable in ((INK, "ink"), (MUTED, "muted"), (LINE, "line")):
        svg = svg.replace(f": {colour}", f": var(--{variable})")
    head, rest = svg.split(">", 1)
    head = re.sub(r' (?:width|height|xmlns|xmlns:xlink)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{escape(alt)}">{rest}'
