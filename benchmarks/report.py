"""Time from reading to the finished report, and the share that report and tables take; size and opening of the page; large results.

    python benchmarks/report.py [--source FOLDER] [--images 500] [--points 0] [--large 500000] [--rounds 3] [--out FILE]

Each stage is one of: read, adjust (iterations to the minimum), statistics (selected inverse, redundancy numbers, standard deviations of all
unknowns, tests of observations, parameters and points), simulations (null laws of the tests of residuals and the comparison of laws),
report (sections, figures, page), tables (tables and JSON, written), project (the adjusted network). Times are the least of the rounds, wall
clock and processor; a round is a process of its own, so that nothing is warm. Nothing here is run by pytest.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

STAGES = ("read", "adjust", "statistics", "simulations", "report", "tables", "project")
CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)


class Watch:
    """Wall clock and processor seconds of named stages."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}
        self.lap()

    def lap(self, stage: str = "") -> None:
        """Credit the time since the last call to a stage."""
        now, cpu = time.perf_counter(), time.process_time()
        if stage:
            self.wall[stage] = self.wall.get(stage, 0.0) + now - self.last[0]
            self.cpu[stage] = self.cpu.get(stage, 0.0) + cpu - self.last[1]
        self.last = now, cpu


def once(source: str, images: int, points: int) -> dict[str, Any]:
    """Run all stages once in this process."""
    from dataclasses import replace

    import baarda
    from baarda.formats import read
    from baarda.formats.project import write as write_project
    from baarda.hypotheses.levels import Options
    from baarda.procedures.synthetic import synthetic
    from baarda.procedures.testing import Analysis, analyse
    from baarda.report import contents, page
    from baarda.report.result_folder import MARK, observation_table, result_json

    if source:
        watch = Watch()
        network = read(source)
    else:
        network = synthetic("aerial", images, seed=1, **({"points": points} if points else {})).network
        watch = Watch()
    watch.lap("read")
    result = baarda.adjust(network)
    watch.lap("adjust")
    analysis: Analysis = analyse(result, Options())
    watch.lap("simulations")
    # The tests are run once more with nothing to simulate: what they cost without replicas is statistics.
    plain = replace(result.evidence, residuals_of=None)
    watch.lap()
    from baarda.hypotheses import run

    run(plain, Options(replicas=1))
    watch.lap("statistics")
    watch.wall["simulations"] -= watch.wall["statistics"]
    watch.cpu["simulations"] -= watch.cpu["statistics"]
    _ = analysis.observations, analysis.collinearity, result.point_cofactors, result.image_cofactors
    watch.lap("statistics")
    _ = analysis.study
    watch.lap("simulations")
    sections = page.sections(analysis)
    html, figures = page.html(analysis, sections), page.figures(sections)
    watch.lap("report")
    sigma = analysis.options.sigma
    tables = {"observations": observation_table(analysis), "points": result.point_table(sigma)}
    tables |= {"images": result.image_table(sigma), "unknowns": result.unknown_table(sigma)}
    with tempfile.TemporaryDirectory() as folder:
        out = contents.write(contents.Contents(result_json(analysis), html, figures, tables), Path(folder) / "out", MARK)
        watch.lap("tables")
        write_project(result.network, Path(folder) / "project")
        watch.lap("project")
        opened = [opening(out / "report.html") for _ in range(3)] if CHROMIUM else []
    known = [o for o in opened if o is not None]
    return {
        "images": len(network.images.labels),
        "points": int((~result.aside).sum()),
        "observations": result.count,
        "unknowns": result.numbering.count,
        "wall": watch.wall,
        "cpu": watch.cpu,
        "page": len(html.encode("utf-8")),
        "opened": min(known) if known else None,
        "sampled": "points are drawn" in html,
    }


def opening(file: Path) -> float | None:
    """Return the milliseconds until a browser has loaded a page, its figures and scripts."""
    # The real clock, at the end of loading, after the layout of the whole page was forced.
    tell = """<script>addEventListener("load", () => {
      document.body.getBoundingClientRect(); document.title = "opened " + performance.now(); });</script></body>"""
    text = file.read_text(encoding="utf-8")
    text = re.sub(r" script-src[^;]*;", " script-src 'unsafe-inline';", text, count=1).replace("</body>", tell)
    with tempfile.TemporaryDirectory() as folder:
        changed = Path(folder) / "report.html"
        changed.write_text(text, encoding="utf-8")
        flags = (
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--window-size=1250,1000",
        )
        command = [str(CHROMIUM), *flags, f"--user-data-dir={folder}/profile", "--dump-dom", changed.as_uri()]
        dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False).stdout
    found = re.search(r"<title>opened ([\d.]+)</title>", dom)
    return float(found[1]) if found else None


def rounds(count: int, *arguments: str) -> dict[str, Any]:
    """Return the least times of several processes."""
    made = []
    for _ in range(count):
        run = subprocess.run([sys.executable, __file__, "--once", *arguments], capture_output=True, text=True, check=False)
        if run.returncode:
            raise SystemExit(run.stderr[-2000:])
        made.append(json.loads(run.stdout.splitlines()[-1]))
    best = made[0]
    for kind in ("wall", "cpu"):
        best[kind] = {s: min(m[kind][s] for m in made) for s in STAGES}
    opened = [m["opened"] for m in made if m["opened"] is not None]
    best["opened"] = min(opened) if opened else None
    return best


def told(title: str, found: dict[str, Any]) -> str:
    """Return a result as Markdown."""
    out = [f"### {title}", ""]
    out.append(f"{found['images']} images, {found['points']} points, {found['observations']} observations, {found['unknowns']} unknowns")
    out += ["", "| stage | wall s | processor s | share of the processor time |", "|---|---|---|---|"]
    whole = sum(found["cpu"].values())
    for s in STAGES:
        out.append(f"| {s} | {found['wall'][s]:.2f} | {found['cpu'][s]:.2f} | {100 * found['cpu'][s] / whole:.0f} % |")
    core = sum(found["cpu"][s] for s in ("adjust", "statistics"))
    own = sum(found["cpu"][s] for s in ("report", "tables"))
    out += [
        "",
        f"Report and tables take {own / core:.2f} of adjustment and statistics, {own / (whole - own):.2f} of all the rest.",
    ]
    opened = "not measured (no Chromium)" if found["opened"] is None else f"opens in {found['opened']:.0f} ms"
    sampled = "; the view in space draws a sample and says so" if found["sampled"] else ""
    return "\n".join([*out, f"Page: {found['page'] / 1e6:.2f} MB, {opened}{sampled}.", ""])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("BAARDA_DATA", Path(__file__).parents[2] / "shared" / "data")) / "colmap_sceaux_txt"
    parser.add_argument("--source", default=str(default), help="a source of any format")
    parser.add_argument("--images", type=int, default=500, help="images of the synthetic block; 0 leaves it out")
    parser.add_argument("--points", type=int, default=0, help="its points; 0 = the usual number")
    parser.add_argument("--large", type=int, default=0, help="points of a large block of 100 images; 0 leaves it out")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, help="file for the results as JSON")
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.once:
        print(json.dumps(once(given.source, given.images, given.points)))
        return
    found: dict[str, Any] = {}
    if given.source and Path(given.source).exists():
        name = Path(given.source).name
        found[name] = rounds(given.rounds, "--source", given.source)
        print(told(name, found[name]), flush=True)
    if given.images:
        title = f"synthetic block of {given.images} images"
        found[title] = rounds(given.rounds, "--source", "", "--images", str(given.images), "--points", str(given.points))
        print(told(title, found[title]), flush=True)
    if given.large:
        title = f"large block of {given.large} points"
        found[title] = rounds(1, "--source", "", "--images", "100", "--points", str(given.large))
        print(told(title, found[title]), flush=True)
    if given.out:
        given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
