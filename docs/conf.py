"""The documentation site: built by one command, examples executed, nothing fetched.

Build it by ``python -m sphinx -W --keep-going -b html docs build/docs``.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

from pygments.lexers.special import TextLexer
from sphinx.highlighting import lexers

import baarda

lexers["csv"] = TextLexer()

project = "baarda"
author = "The baarda developers"
copyright = f"2026, {author}"
version = release = baarda.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "executed", "docstrings"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "_ext"]
myst_heading_anchors = 4
default_role = "code"
suppress_warnings = ["ref.python"]  # words in docstrings are no names to look up

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings state them
autodoc_inherit_docstrings = False
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = "pydata_sphinx_theme"
html_title = "baarda"
html_static_path: list[str] = []
html_show_sourcelink = False
html_theme_options = {
    "show_prev_next": True,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "show_toc_level": 2,
    "navbar_end": ["theme-switcher"],
    "footer_start": ["copyright"],
    "footer_end": [],
}


def other_pages(app: object, page: str, content: list[str]) -> None:
    """Name every page of this folder in the reference: a new one is listed by being there."""
    if page == "reference/index":
        here = sorted(p.stem for p in Path(__file__).parent.glob("*.md") if p.stem != "index")
        content[0] = content[0].replace("@others@", "\n".join(f"/{p}" for p in here if f"/{p}\n" not in content[0]))


def setup(app: object) -> None:
    """Register with Sphinx."""
    app.connect("source-read", other_pages)  # type: ignore[attr-defined]
