"""The pages say what the program says: every figure is explained, every example for a new member works and passes the exam of its kind."""

import ast
import fnmatch
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import baarda
from baarda.hypotheses.levels import Options
from baarda.procedures.audit import audit
from baarda.procedures.strategy import Plan, carry_out
from baarda.procedures.testing import analyse
from baarda.procedures.variance_components import estimate_components
from baarda.report.result_folder import observation_table, result_json
from networks import ring, with_distances

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "guide" / "numbers.md"
SECTIONS = ROOT / "src" / "baarda" / "report" / "sections"
#: parts of captions and column names that the block fills in
FIELDS = {"{axis}": "X", "{a}": "X", "{name}": "X0"}
#: captions that are said in the section, not by name
FREE_CAPTIONS = {"{title}, numbers"}
#: keys that only special blocks have: highly correlated parameters, tests that do not apply
OCCASIONAL = {"correlations[].a", "correlations[].b", "correlations[].value", "selection[].pair.*", "tests[].applicable"}


def chapters(text, mark):
    """Return the texts below the headings of a level, by heading."""
    parts = re.split(rf"^{mark} (.+)$", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def said(text):
    """Return what a text sets as code."""
    return {s.replace("\\|", "|") for s in re.findall(r"`([^`\n]+)`", text)}


@pytest.fixture(scope="module")
def page():
    return chapters(PAGE.read_text(encoding="utf-8"), "##")


@pytest.fixture(scope="module")
def analyses():
    """Analyses that together fill every part of the result."""
    o = Options(replicas=99)
    net = with_distances(ring(images=6, points=30, control=6, checks=4, seed=1), [(10, 11), (12, 13)])
    xy = np.array(net.observations[0].xy)
    xy[17, 0] += 20
    wrong = replace(net, observations=(replace(net.observations[0], xy=xy), *net.observations[1:]))
    out = [analyse(baarda.adjust(net), o), analyse(baarda.adjust(net, robust="student"), o)]
    for network, plan in ((wrong, Plan(snoop="coordinate", select=True, folds=3)), (net, Plan(strategy="gruen"))):
        result, done = carry_out(network, plan, o, None)
        out.append(replace(analyse(result, o), strategy=done))
    audited = audit(net, o)
    out.append(replace(analyse(audited.adjustment, o), audit=audited))
    components, weighted = estimate_components(net, "group", o)
    out.append(replace(analyse(baarda.adjust(weighted), o), components=components))
    for a in out[1:]:
        a.__dict__["study"] = None  # the laws of one of them are enough
    return out


def paths(value, way=""):
    """Return the ways to all keys of a document; [] stands for the entries of a list."""
    if isinstance(value, dict):
        for k, v in value.items():
            key = f"{way}.{k}" if way else k
            yield key
            yield from paths(v, key)
    elif isinstance(value, list):
        for v in value:
            yield from paths(v, way + "[]")


def test_every_key_of_the_result_is_explained(page, analyses):
    known = said(page["result.json"])
    exact, patterns = {k for k in known if "*" not in k}, [re.escape(k).replace(r"\*", ".*") for k in known if "*" in k]
    missing = set()
    for a in analyses:
        document = result_json(a)
        json.dumps(document, allow_nan=False)
        missing |= {k for k in paths(document) if k not in exact and not any(re.fullmatch(p, k) for p in patterns)}
    assert not missing


def test_no_key_is_explained_that_is_not_there(page, analyses):
    there = {k for a in analyses for k in paths(result_json(a))}
    told = {k for k in said(page["result.json"]) if re.fullmatch(r"[a-z0-9_]+(\[\])?(\.[a-z0-9_*]+(\[\])?)+", k)} - OCCASIONAL
    assert told
    assert not {k for k in told if not fnmatch.filter(there, k.replace("[]", "[[]]"))}


def test_every_column_of_the_tables_is_explained(page, analyses):
    tables = chapters(page["Tables"], "###")
    for a in analyses:
        s = a.options.sigma
        columns = {
            "observations": observation_table(a),
            "points": a.adjustment.point_table(s),
            "images": a.adjustment.image_table(s),
            "unknowns": a.adjustment.unknown_table(s),
        }
        for name, table in columns.items():
            assert not set(table.columns) - said(tables[f"tables/{name}"]), name


#: reports of other verbs, by file, and the heading that explains them
OTHER = {
    "batch_report": "baarda batch",
    "comparison_report": "baarda compare",
    "helmert_report": "Parts of a block",
    "planimetry_height_report": "baarda models",
    "resection_report": "baarda resect",
    "residual_sections": "baarda residuals",
    "simulation_report": "baarda simulate",
}


def texts(node):
    """Return the texts that an expression of a section may be, fields of the block filled in."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) and node.value else []
    if isinstance(node, ast.IfExp):
        return texts(node.body) + texts(node.orelse)
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("say", "tr"):
        return texts(node.args[0])
    if isinstance(node, ast.JoinedStr):
        return ["".join(v.value if isinstance(v, ast.Constant) else "{" + ast.unparse(v.value) + "}" for v in node.values)]
    return []


def filled(text):
    for field, value in FIELDS.items():
        text = text.replace(field, value)
    return text


def unexplained(file, chapter):
    """Return the names of columns, tables and figures of a file that a chapter does not hold."""
    flat = re.sub(r"\s+", " ", chapter)
    missing = []
    for n in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        kind = getattr(n.func, "id", "") if isinstance(n, ast.Call) and n.args else ""
        names = [filled(t) for t in texts(n.args[1 if kind in ("Figure", "Interactive") else 0])] if kind else []
        if kind == "Column":
            missing += [name for name in names if name not in said(chapter)]
        elif kind in ("DataTable", "Figure", "Interactive"):
            missing += [name for name in names if name not in FREE_CAPTIONS and name not in flat]
    return missing


@pytest.mark.parametrize("file", sorted(f.name for f in SECTIONS.glob("*.py") if f.name not in ("__init__.py", "base.py")))
def test_every_column_table_and_figure_of_a_section_is_explained(page, file):
    calls = [n for n in ast.walk(ast.parse((SECTIONS / file).read_text(encoding="utf-8"))) if isinstance(n, ast.Call) and n.args]
    titles = [t for n in calls if getattr(n.func, "id", "") == "SectionMaker" for t in texts(n.args[2])]
    sections = chapters(page["Sections of the report"], "###")
    chapter = " ".join(sections[t] for t in (["Residual law"] if file == "_laws.py" else titles))
    assert not unexplained(SECTIONS / file, chapter)


@pytest.mark.parametrize("file", sorted(OTHER))
def test_every_column_table_and_figure_of_the_other_reports_is_explained(page, file):
    assert not unexplained(SECTIONS.parent / f"{file}.py", chapters(page["The other reports"], "###")[OTHER[file]])


PAGES = {
    "camera": ("cameras", "tests/laws/test_camera_laws.py"),
    "law": ("distributions", "tests/laws/test_distribution_laws.py"),
    "test": ("hypotheses", "tests/laws/test_hypothesis_laws.py"),
    "format": ("formats", ""),
}


def blocks(page):
    """Return the file that a page tells to write, its name, and the examples that use it."""
    text = (ROOT / "docs" / "extend" / f"{page}.md").read_text(encoding="utf-8")
    found = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    (source,) = [f for f in found if f.startswith("# src/baarda/")]
    name = re.match(r"# src/baarda/(\w+)/(\w+)\.py\n", source)
    return source, name[1], name[2], [f for f in found if f.startswith(">>>")]


RUN = """
import doctest, importlib, sys
sys.path[:0] = {path!r}
package = importlib.import_module("baarda.{folder}")
package.__path__.append({here!r})  # as if the file lay in the folder
text = open({examples!r}).read()
failed, tried = doctest.testfile({examples!r}, module_relative=False, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
assert tried and not failed
if {exam!r}:
    import pytest
    sys.exit(pytest.main([{exam!r}, "-n", "0", "-q", "-k", {member!r}, "-p", "no:cacheprovider", "--no-header"]))
"""


@pytest.mark.parametrize("page", PAGES)
def test_a_new_member_is_one_file(page, tmp_path):
    folder, exam = PAGES[page]
    source, into, name, examples = blocks(page)
    assert into == folder
    assert not (ROOT / "src" / "baarda" / into / f"{name}.py").exists()
    (tmp_path / f"{name}.py").write_text(source)
    (tmp_path / "examples.txt").write_text("\n\n".join(examples))
    code = RUN.format(
        path=[str(ROOT / "src"), str(ROOT / "tests")],
        folder=folder,
        here=str(tmp_path),
        examples=str(tmp_path / "examples.txt"),
        exam=exam,
        member=name,
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    if exam:
        assert re.search(r"[1-9]\d* passed|^\.+ ", done.stdout, re.MULTILINE), done.stdout
    for tool in (["ruff", "check", "--select", "E,F,W,I,B,D", "--ignore", "D100,D203,D205,D213,D401,E501"],):
        lint = subprocess.run([sys.executable, "-m", *tool, str(tmp_path / f"{name}.py")], capture_output=True, text=True, cwd=ROOT)
        assert lint.returncode == 0, lint.stdout
