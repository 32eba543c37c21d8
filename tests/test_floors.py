"""Imports flow down: a file imports lower floors and its own folder, nothing else of the package."""

import ast
from pathlib import Path

SOURCE = Path(__file__).parent.parent / "src" / "baarda"
FLOORS = {
    "errors": 0,
    "discover": 0,
    "geometry": 1,
    "cameras": 1,
    "distributions": 1,
    "network": 2,
    "hypotheses": 2,
    "executors": 2,
    "observations": 3,
    "adjustment": 4,
    "formats": 4,
    "procedures": 5,
    "report": 6,
    "papers": 6,
    "cli": 7,
}


def imported_rooms(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names = [node.module] if node.module != "baarda" else [f"baarda.{a.name}" for a in node.names]
        elif isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "baarda" and len(parts) > 1 and parts[1] in FLOORS:
                yield node.lineno, parts[1]


def test_imports_flow_down():
    wrong = []
    for path in sorted(SOURCE.rglob("*.py")):
        room = path.relative_to(SOURCE).parts[0].removesuffix(".py")
        if room not in FLOORS:
            continue
        for line, other in imported_rooms(path):
            if other != room and FLOORS[other] >= FLOORS[room]:
                wrong.append(f"{path.relative_to(SOURCE)}:{line} imports {other}")
    assert not wrong, "\n".join(wrong)


def test_every_room_has_a_floor():
    rooms = {p.name for p in SOURCE.iterdir() if p.is_dir() and p.name not in ("data", "__pycache__")}
    assert rooms <= set(FLOORS)


def test_no_drawers():
    names = {p.stem for p in SOURCE.rglob("*.py")}
    assert not names & {"io", "utils", "util", "helpers", "tests", "statistics", "misc", "common"}
