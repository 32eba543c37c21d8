"""The pages in a browser: nothing is fetched, no script fails, figures are seen, the view turns; paper, and scripts that may not run."""

import html
import json
import re
import shutil
import subprocess
import time

import pytest

import baarda
from baarda.formats import dbat
from baarda.hypotheses.levels import Options
from baarda.procedures.comparison import compare, epoch
from baarda.procedures.planning import plan
from baarda.procedures.synthetic import synthetic
from baarda.procedures.testing import analyse
from baarda.report import comparison_report, page, simulation_report
from baarda.report.sections.base import Figure
from baarda.report.translation import language
from networks import ring

CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--hide-scrollbars")

#: Heard before the page speaks: errors, and what its policy forbids.
EAR = """<script>
const heard = [];
addEventListener("error", (e) => heard.push(String(e.message || e.target.tagName)), true);
addEventListener("securitypolicyviolation", (e) => heard.push(e.violatedDirective));
</script>"""
#: Told when the page stands: what was fetched, which figures are seen, and what turning the view changes.
TONGUE = """<script>addEventListener("load", () => setTimeout(() => {
  const told = {fetched: performance.getEntriesByType("resource").map((e) => e.name), turned: []};
  told.figures = [...document.querySelectorAll("figure")].map((f) => {
    const svg = f.querySelector("svg"), r = svg.getBoundingClientRect();
    return {id: f.id, width: r.width, height: r.height, seen: svg.checkVisibility(), named: Boolean(svg.getAttribute("aria-label")),
            title: f.querySelector(".figure-title").textContent, caption: f.querySelector("figcaption").textContent};
  });
  told.wide = [...document.querySelectorAll(".scroll")].filter((e) => e.checkVisibility() && e.scrollWidth > e.clientWidth + 1)
    .map((e) => e.getAttribute("aria-label"));
  told.across = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const finish = () => {
    told.heard = heard;
    const box = document.createElement("pre");
    box.id = "told";
    box.textContent = JSON.stringify(told);
    document.body.append(box);
  };
  const canvas = document.querySelector("canvas");
  if (!canvas) { finish(); return; }
  const acts = [
    () => canvas.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowLeft"})),
    () => {
      const common = {pointerId: 1, clientY: 90, buttons: 1, bubbles: true};
      const at = (type, x) => canvas.dispatchEvent(new PointerEvent(type, {...common, clientX: x}));
      canvas.setPointerCapture = () => {};
      at("pointerdown", 200); at("pointermove", 260); at("pointerup", 260);
    },
  ];
  const next = () => {
    const act = acts.shift();
    if (!act) { finish(); return; }
    const before = canvas.toDataURL();
    act();
    let tries = 40;
    const wait = setInterval(() => {
      const turned = canvas.toDataURL() !== before;
      if (turned || !--tries) { clearInterval(wait); told.turned.push(turned); next(); }
    }, 50);
  };
  next();
}, 100));</script>"""


def browse(folder, file, *more):
    """Run the browser on a file and return what it prints."""
    profile = folder / f"profile-{time.monotonic_ns()}"
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", *more, file.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def heard_of(text, folder, width=1250):
    """Return what a page tells of itself, with the two scripts of this test let in by the policy of the page."""
    policy = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert "script-src" not in policy[1] or "'unsafe-inline'" not in policy[1].split("script-src")[1].split(";")[0]
    open_policy = re.sub(r" script-src[^;]*;|(?<=img-src data:;)", " script-src 'unsafe-inline';", policy[0], count=1)
    assert "script-src 'unsafe-inline'" in open_policy
    changed = text.replace(policy[0], open_policy + EAR).replace("</body>", TONGUE + "</body>")
    file = folder / "report.html"
    file.write_text(changed, encoding="utf-8")
    dom = browse(folder, file, f"--window-size={width},1000", "--virtual-time-budget=6000", "--dump-dom")
    found = re.search(r'<pre id="told">(.*?)</pre>', dom, re.DOTALL)
    assert found is not None, "the page told nothing"
    return json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))


@pytest.fixture(scope="module")
def aerial(data):
    return analyse(baarda.adjust(dbat.read(data("dbat_sxb") / "sxb.xml")))


@pytest.fixture(scope="module")
def calibration(camcal):
    return analyse(baarda.adjust(dbat.read(camcal)))


@pytest.fixture(scope="module", params=["aerial", "calibration", "aerial in German", "comparison", "simulation"])
def made(request):
    """Sections and page of each kind of report."""
    kind, _, german = request.param.partition(" in ")
    with language("de" if german else "en"):
        if kind == "comparison":
            c = compare(epoch(ring(5, points=20)), epoch(ring(5, points=20, noise=0.2)))
            sections = comparison_report.sections(c)
            return sections, comparison_report.html(c, sections)
        if kind == "simulation":
            planned = plan(ring(5, points=20, control=4))
            sections = simulation_report.sections(planned, None)
            return sections, simulation_report.html(planned, None, sections)
        analysis = request.getfixturevalue(kind)
        sections = page.sections(analysis)
        return sections, page.html(analysis, sections)


def test_nothing_is_fetched_no_script_fails_every_figure_is_seen(made, tmp_path):
    sections, text = made
    told = heard_of(text, tmp_path)
    assert told["fetched"] == [] and told["heard"] == []
    figures = [b for s in sections for b in s.blocks if isinstance(b, Figure)]
    assert [f["id"] for f in told["figures"]] == [f"figure-{b.name}" for b in figures]
    for f in told["figures"]:
        assert f["seen"] and f["width"] > 150 and f["height"] > 100 and f["named"] and f["title"] and len(f["caption"]) > 20, f
    assert told["across"] <= 0  # the page itself never scrolls sideways
    assert all(told["turned"]) and len(told["turned"]) == (2 if "<canvas" in text else 0)


def test_open_tables_fit_a_usual_window(made, tmp_path):
    """At 1250 pixels no table that is not folded needs a scroll bar."""
    assert heard_of(made[1], tmp_path)["wide"] == []


def test_narrow_windows_scroll_tables_not_the_page(aerial, tmp_path):
    told = heard_of(page.html(aerial, page.sections(aerial)), tmp_path, width=500)
    assert told["across"] <= 0 and told["wide"]


def test_prints_with_all_its_tables_and_without_scripts_the_same(aerial, tmp_path):
    """Folded tables come open on paper; a page whose scripts may not run prints as long."""
    text, file = page.html(aerial, page.sections(aerial)), tmp_path / "report.html"
    pages = []
    for policy in (r"\g<0>", ""):
        file.write_text(re.sub(r" script-src[^;]*;", policy, text), encoding="utf-8")
        out = tmp_path / f"{len(pages)}.pdf"
        browse(tmp_path, file, "--no-pdf-header-footer", f"--print-to-pdf={out}")
        data = out.read_bytes()
        assert data.startswith(b"%PDF") and data.rstrip().endswith(b"%%EOF")
        pages.append(len(re.findall(rb"/Type\s*/Page\b", data)))
    assert pages[0] == pages[1] >= 10


def test_without_scripts_only_the_view_is_missing(aerial, tmp_path):
    """The page in a frame that lets no script run: all is there, the view is hidden, and a sentence says why."""
    sections, file = page.sections(aerial), tmp_path / "frame.html"
    look = """<script>addEventListener("load", () => {
      const d = document.querySelector("iframe").contentDocument;
      const seen = (q) => [...d.querySelectorAll(q)].filter((e) => e.checkVisibility());
      const told = {figures: seen("figure svg").length, canvas: seen("canvas").length, tables: seen("table").length};
      told.words = seen("noscript").map((e) => e.textContent).join("");
      told.verdict = seen(".verdict li").length;
      document.title = JSON.stringify(told);
    });</script>"""
    inner = html.escape(page.html(aerial, sections), quote=True)
    file.write_text(
        f'<title>none</title>{look}<iframe sandbox="allow-same-origin" srcdoc="{inner}" width="1250" height="900"></iframe>', "utf-8"
    )
    dom = browse(tmp_path, file, "--virtual-time-budget=3000", "--dump-dom")
    told = json.loads(html.unescape(re.search(r"<title>(.*?)</title>", dom)[1]))
    assert told["figures"] == sum(isinstance(b, Figure) for s in sections for b in s.blocks) > 5
    assert told["canvas"] == 0 and "The view to turn needs JavaScript" in told["words"]
    assert 5 <= told["verdict"] <= 8 and told["tables"] > 10


def test_report_of_5000_points_is_small_and_opens_fast(tmp_path):
    """Below 4 MB, and open within two seconds: the best of three, since other work may hold the processor."""
    network = synthetic("aerial", 12, points=5000, seed=1).network
    analysis = analyse(baarda.adjust(network), Options(replicas=39, alpha=0.1))
    sections = page.sections(analysis)
    text = page.html(analysis, sections)
    assert len(text.encode("utf-8")) < 4e6
    # The real clock, at the end of loading, after the layout of the whole page was forced.
    tell = """<script>addEventListener("load", () => {
      document.body.getBoundingClientRect(); document.title = "opened " + performance.now(); });</script></body>"""
    file = tmp_path / "report.html"
    file.write_text(re.sub(r" script-src[^;]*;", " script-src 'unsafe-inline';", text, count=1).replace("</body>", tell), encoding="utf-8")
    times = []
    while len(times) < 3 and min(times, default=2000.0) >= 2000.0:
        dom = browse(tmp_path, file, "--window-size=1250,1000", "--dump-dom")
        times.append(float(re.search(r"<title>opened ([\d.]+)</title>", dom)[1]))
    assert min(times) < 2000.0
