"""Docstrings are plain text with single backticks; what reStructuredText would take for markup in them is escaped."""

import re
from importlib.util import find_spec
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList

_FIELD = re.compile(r"(``.*?``|`.*?`)")


def escaped(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Escape bars, stars and underscores at the ends of words outside code; examples stay as they are."""
    lines[:] = _plain_references(lines)
    for i, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            parts = _FIELD.split(line)
            parts[::2] = [re.sub(r"(?<!\\)([|*])", r"\\\1", re.sub(r"(?<=\w)_(?=\W|$)", r"\\_", p)) for p in parts[::2]]
            lines[i] = "".join(parts)


def _plain_references(lines: list[str]) -> list[str]:
    """Show numbered references as paragraphs: footnotes would have to be unique over a page."""
    out: list[str] = []
    indent = None  # of the reference that a line may continue
    for line in lines:
        found = re.match(r"(\s*)\.\. (\[\d+\] .*)", line)
        if found:
            indent = found[1]
            out += ["", indent + found[2]]
        elif indent is not None and line.startswith(indent + "   "):
            out.append(indent + line.strip())
        else:
            indent = None
            out.append(re.sub(r"(\[\d+\])_(?=\W|$)", r"\1", line))
    return out


def plain_types(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Show types as text: words such as "array" or "n" are no names to look up."""
    for i, line in enumerate(lines):
        found = re.match(r"(\s*:(?:var)?type [^:]+:) (.+)$", line)
        if found:
            lines[i] = f"{found[1]} ``{found[2].replace('`', '').replace(chr(92), '').strip('*')}``"


class ModulesOf(Directive):
    """All public modules of a package, each with its public names."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the documentation of the package and its modules."""
        from baarda.discover import modules

        package = self.arguments[0]
        base = [f"{package}.base"] if find_spec(f"{package}.base") else []
        names = base + [m.__name__ for m in modules(package)]
        text = [line for n in names for line in (f".. rubric:: {n}", "", f".. automodule:: {n}", "   :members:", "")]
        node = nodes.section()
        node.document = self.state.document
        self.state.nested_parse(StringList(text, source=package), 0, node)
        return node.children


def setup(app: Any) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("autodoc-process-docstring", escaped, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", plain_types, priority=900)  # behind it
    app.add_directive("modules-of", ModulesOf)
    return {"parallel_read_safe": True}
