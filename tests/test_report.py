"""The report: what it says of real blocks, and that names from strangers, missing parts and a second run do no harm."""

import base64
import hashlib
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest

import baarda
from baarda.discover import modules
from baarda.formats import dbat
from baarda.hypotheses.levels import Options
from baarda.procedures.testing import analyse
from baarda.report import page, plots
from baarda.report.sections._facts import clusters, label_of
from baarda.report.sections._numbers import with_sigma
from baarda.report.sections.base import Cell, DataTable, Figure, Section, SectionMaker, Verdict
from networks import FREE_BROWN, ring

HOSTILE = (
    "<script>alert(1)</script>",
    "$x^2$",
    '"onload="x',
    "a&b",
    "{{7*7}}",
    "]]>-->",
    "&lt;",
    "\x1b[2J",
    "\u202eevil",
    "图像",
    "</svg>",
    "%s{0}",
)


@pytest.fixture(scope="module")
def calibration(camcal):
    return analyse(baarda.adjust(dbat.read(camcal)))


@pytest.fixture(scope="module")
def aerial(data):
    return analyse(baarda.adjust(dbat.read(data("dbat_sxb") / "sxb.xml")))


def hostile_network():
    n = ring(control=5, checks=2)

    def named(count):
        return tuple(f"{HOSTILE[k % len(HOSTILE)]}{k}" for k in range(count))

    return replace(
        n,
        name="<img src=x onerror=alert(1)>",
        assumptions=("<b>$\\alpha$</b>",),
        path="http://example.invalid/<i>",
        cameras=tuple(replace(c, label="<script>$x^2$") for c in n.cameras),
        images=replace(n.images, labels=named(len(n.images.labels))),
        points=replace(n.points, labels=named(len(n.points.labels))),
    )


@pytest.fixture(scope="module")
def hostile():
    return analyse(baarda.adjust(hostile_network()))


@pytest.fixture(scope="module", params=["calibration", "aerial", "hostile", "not_converged"])
def pages(request):
    if request.param == "not_converged":
        analysis = analyse(baarda.adjust(ring(), iterations=1))
    else:
        analysis = request.getfixturevalue(request.param)
    made = page.sections(analysis)
    return analysis, made, page.html(analysis, made)


VOID = {"meta", "br", "img", "link", "input", "hr"}


class Page(HTMLParser):
    """Reads a page as a browser would: elements with attributes, in balance."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.elements, self.open, self.words = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        assert len({k for k, _ in attrs}) == len(attrs), f"<{tag}> repeats an attribute"
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        self.words.append(data)

    def named(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


# ---- what it says ----------------------------------------------------------------------------------------------------------------------


def test_verdict_of_the_calibration(calibration):
    assert page.verdict(calibration) == [
        "The adjustment converged in 8 iterations: 4148 observations determine 423 unknowns with a redundancy of 3725, 0.90 per "
        "observation on average.",
        "The variance factor 2.608 lies outside 0.955..1.046: the residuals are 1.61 times as large as the a-priori sigmas promise.",
        "All 6 additional camera parameters differ significantly from zero at level 0.05 (smallest |t| = 11.2 for P2, limit 1.96).",
        "45 of 4148 observations are suspected of a gross error (|tau| above 3.29; chance alone would show 4.1); the worst is image 19 "
        "point 8 x with tau = -5.86: estimated error 1.03 px. 31 of them gather at points 1004, 1003, 1001, 1002.",
        "A gross error in an image coordinate is found with probability 0.80 from 0.43 px on (median, by the a-priori sigmas); the least "
        "controlled one, image 21 point 11 x, may hide up to 0.50 px.",
        "The object points have standard deviations of 0.039 / 0.039 / 0.065 mm in X / Y / Z (medians, a posteriori); the weakest is point "
        "90 with 0.112 mm in space.",
        "The residuals are not those of normal errors (Anderson-Darling 24.63, limit 0.72, p = 0.001 by simulated adjustments); of the "
        "laws tried the student law fits best by AIC.",
    ]


def test_verdict_of_the_aerial_block(aerial):
    said = page.verdict(aerial)
    assert 5 <= len(said) <= 8
    whole = " ".join(said)
    assert "variance factor 1.389 lies outside 0.923..1.080" in whole
    assert "2 check points differ from the survey by more than the predicted precision allows (T = 11.99, limit 2.10" in whole
    assert "contradicts its sigmas (T = 2.63, limit 1.42): 5 of 14 points are rejected singly, the worst is 492." in whole


def test_sentences_follow_the_tests():
    network = ring(control=5, checks=3)
    said = " ".join(page.verdict(analyse(baarda.adjust(network), Options(sigma="apriori"))))
    assert "lies within" in said and "|w| above" in said and "a priori" in said
    assert "no more than the predicted precision allows" in said and "agrees with its sigmas" in said
    too_small = ring(control=5, noise=0.05)  # sigma stays 0.1 px
    assert "only 0." in page.verdict(analyse(baarda.adjust(too_small, image_sigma=1.0)))[1]
    idle = ring(noise=0.3, free=(*FREE_BROWN, "K2", "K3"), points=12)
    assert "not differ significantly from zero" in " ".join(page.verdict(analyse(baarda.adjust(idle))))


def test_not_converged_says_so_and_tests_nothing():
    analysis = analyse(baarda.adjust(ring(), iterations=1))
    (only,) = page.verdict(analysis)
    assert "did not converge" in only and "nothing was tested" in only
    assert [s.id for s in page.sections(analysis)] == ["verdict", "problems", "data", "settings"]


def test_sections_come_in_order_and_vanish(calibration, aerial):
    ids = ["verdict", "problems", "data", "groups", "cameras", "collinearity", "images", "points", "suspected", "check-control"]
    ids += ["accuracy-statement", "tests", "law", "residual-vectors", "reliability-maps", "network-plan", "space", "settings"]
    assert [s.id for s in page.sections(aerial)] == [i for i in ids if i != "collinearity"]  # no camera parameter is estimated
    assert [s.id for s in page.sections(calibration)] == [i for i in ids if i not in ("check-control", "accuracy-statement")]


def test_suspected_observations_gather_at_the_control_points(calibration):
    found = [(c.label, c.suspected, c.tested, c.known) for c in clusters(calibration)]
    assert found == [("1004", 9, 42, "fixed control"), ("1003", 8, 42, "fixed control")] + [
        (p, 7, 42, "fixed control") for p in ("1001", "1002")
    ]


def test_the_report_judges_by_the_numbers_of_the_tests(calibration, aerial):
    for analysis in (calibration, aerial):
        test = analysis.tests_named("data_snooping")[0]
        np.testing.assert_allclose(analysis.tau, test.statistic, rtol=1e-12)
        worst = int(analysis.suspected[0])
        assert label_of(analysis, worst) == test.labels[worst]


def test_camera_table_of_the_calibration(calibration):
    section = next(s for s in page.sections(calibration) if s.id == "cameras")
    rows = {row[0]: row for row in section.blocks[0].rows}
    assert rows["principal_distance"][1:5] == ("mm", "7.4570", "0.0010", "7.5")
    assert rows["K3"][1:4] == ("mm⁻⁶", "-2.05e-06", "1.0e-07")
    assert rows["B2"][3] == "–" and rows["B2"][8] == "fixed"
    assert rows["P2"][7] == Cell("significant", "good")


def test_tables_are_limited_and_point_at_the_files(aerial):
    section = next(s for s in page.sections(aerial) if s.id == "points")
    table = next(b for b in section.blocks if isinstance(b, DataTable) and b.caption == "All points")
    assert len(table.rows) == 200 and table.folded
    assert table.note == "The first 200 of 381 rows; all are in tables/points.csv."


def test_every_row_fits_its_table(pages):
    for section in pages[1]:
        for block in section.blocks:
            if isinstance(block, DataTable):
                assert {len(row) for row in block.rows} == {len(block.columns)}, block.caption


@pytest.mark.parametrize(
    ("value", "sigma"), [(7.456995, 0.00104583), (-4.51351e-05, 2.6e-06), (999660.94, 0.465), (0.1, 0.0996), (3.2, 45.0), (0.0, 1e-9)]
)
def test_value_has_the_digits_of_its_sigma(value, sigma):
    v, s = with_sigma(value, sigma)
    assert float(s) == pytest.approx(sigma, rel=0.05)
    assert abs(float(v) - value) <= 0.06 * sigma
    assert len(v.split("e")[0].partition(".")[2]) <= 8


# ---- the page --------------------------------------------------------------------------------------------------------------------------


def test_page_is_well_formed(pages):
    _, made, text = pages
    read = Page(text)
    assert read.open == []
    assert text.startswith("<!DOCTYPE html>")
    assert read.named("html")[0]["lang"] == "en"
    ids = [a["id"] for _, a in read.elements if "id" in a]
    assert len(ids) == len(set(ids))
    links = {a["href"][1:] for a in read.named("a")}
    assert links <= set(ids) and {s.id for s in made} <= links
    assert len(read.named("h1")) == 1 and len(read.named("h2")) == len(made)


def test_page_loads_nothing(pages):
    _, _, text = pages
    read = Page(text)
    csp = next(a["content"] for a in read.named("meta") if a.get("http-equiv") == "Content-Security-Policy")
    assert csp.startswith("default-src 'none'; style-src 'unsafe-inline'; img-src data:")
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    if scripts:  # one, the viewer, and the page allows no other
        digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
        assert len(scripts) == 1 and f"script-src 'sha256-{digest}';" in csp
    else:
        assert "script-src" not in csp
    assert all(a in ({}, {"type": "application/json"}) for a in read.named("script"))
    assert not {tag for tag, _ in read.elements} & {"link", "iframe", "object", "embed", "img", "base", "form", "video", "audio"}
    for tag, attributes in read.elements:
        for key, value in attributes.items():
            assert not key.startswith("on"), (tag, key)
            if key in ("href", "src", "xlink:href"):
                assert value.startswith(("#", "data:image/png;base64,")), (tag, key, value)
            if key not in ("aria-label", "title"):
                assert "http:" not in (value or "") and "https:" not in (value or ""), (tag, key, value)
    style = text[text.index("<style>") : text.index("</style>")]
    assert "@import" not in style and "url(" not in style


def test_real_pages_do_not_even_name_an_address(calibration):
    assert "http" not in page.html(calibration, page.sections(calibration)).replace("http-equiv", "")


def test_page_is_accessible(pages):
    _, made, text = pages
    read = Page(text)
    drawings = [a for a in read.named("svg") if a.get("role") == "img"]
    assert all(a["tabindex"] == "0" and a["role"] == "img" and len(a["aria-label"]) > 40 for a in read.named("canvas"))
    assert len(drawings) == len(read.named("svg")) == sum(isinstance(b, Figure) for s in made for b in s.blocks)
    assert all(len(a["aria-label"]) > 40 for a in drawings)
    assert len(read.named("caption")) == len(read.named("table"))
    assert all(a.get("scope") in ("col", "row") for a in read.named("th"))
    regions = [a for a in read.named("div") if a.get("role") == "region"]
    assert all(a["tabindex"] == "0" and a["aria-label"] for a in regions)
    badges = re.findall(r'<span class="badge [^"]*">([^<]*)</span>', text)
    assert badges and all(b.strip() for b in badges), "a colour without a word"


def test_text_and_page_lay_out_the_same(pages):
    _, made, text = pages
    words = " ".join(" ".join(Page(text).words).split())
    plain = page.text(made)
    for number, section in enumerate(made, start=1):
        assert f"{number} {section.title}\n=" in plain
        for block in section.blocks:
            if isinstance(block, DataTable):
                assert block.caption in words and block.caption in plain
            elif isinstance(block, Verdict):
                assert all(page.printable(s.text) in words for s in block.sentences)
    lines = plain.splitlines()
    assert all(line == line.rstrip() for line in lines)


def test_hostile_names_stay_names(hostile):
    made = page.sections(hostile)
    text = page.html(hostile, made)
    read = Page(text)
    words = "".join(read.words)
    for name in ("<script>alert(1)</script>0", "$x^2$1", '"onload="x2', "a&b3", "{{7*7}}4", "]]>-->5"):
        assert name in words, name
    assert "<img src=x onerror=alert(1)>" in words and "<b>$\\alpha$</b>" in words
    assert text.count("<script") == 2 and "<script>alert" not in text and "<img" not in text and "<b>$" not in text
    for hidden in ("\x1b", "\u202e"):
        assert hidden not in text and hidden not in page.text(made) and hidden not in " ".join(page.verdict(hostile))
    plan = page.figures(made)["network-plan"]
    assert ">$x^2$1</text>" in plan and ">&lt;script&gt;alert" in plan  # written as it is, not set as a formula
    assert all(re.fullmatch(r"[a-z0-9-]+", name) for name in page.figures(made)), "a name reached a file name"


def test_figures_stand_alone(pages):
    drawings = page.figures(pages[1])
    for name, svg in drawings.items():
        root = ET.fromstring(svg)
        assert root.tag == "{http://www.w3.org/2000/svg}svg", name
        assert root.get("role") == "img" and root[0].tag.endswith("title") and root[1].tag.endswith("desc")
        assert not root.findall(".//{http://www.w3.org/2000/svg}metadata")
        assert "<!--" not in svg


def test_two_runs_give_the_same_bytes():
    def once():
        analysis = analyse(baarda.adjust(hostile_network()))
        made = page.sections(analysis)
        return page.html(analysis, made), page.text(made), page.figures(made)

    assert once() == once()


def test_members_are_one_file_each():
    makers = [[v for v in vars(m).values() if isinstance(v, SectionMaker)] for m in modules("baarda.report.sections")]
    assert [len(found) for found in makers] == [1] * len(makers)
    assert len({found[0].order for found in makers}) == len({found[0].id for found in makers}) == len(makers)
    assert all(re.fullmatch(r"[a-z-]+", found[0].id) for found in makers)


def test_a_maker_without_blocks_makes_nothing(hostile):
    assert SectionMaker(1, "x", "X", lambda analysis: None).make(hostile) is None
    assert SectionMaker(1, "x", "X", lambda analysis: []).make(hostile) is None
    assert isinstance(SectionMaker(1, "x", "X", lambda analysis: [Verdict(())]).make(hostile), Section)


# ---- figures ---------------------------------------------------------------------------------------------------------------------------


def test_figures_leave_matplotlib_as_it_was():
    before = dict(matplotlib.rcParams)
    first = plots.histogram(np.linspace(-3, 3, 50), [], "x")
    with matplotlib.rc_context({"font.size": 30.0, "axes.grid": True, "svg.fonttype": "path"}):
        assert plots.histogram(np.linspace(-3, 3, 50), [], "x") == first, "a user's settings change the report"
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize(("count", "rasters"), [(400, False), (6000, True)])
def test_many_marks_become_a_picture(count, rasters):
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 1.0, (count, 3))
    ends = (np.array([[0.5, 0.5, 3.0]]), np.array([[0.0, 0.0, -1.0]]))
    svg = plots.plan(points, rng.uniform(1.0, 2.0, count), ["tie"] * count, *ends, ["1"], "m", "mm")
    assert svg.count("<use ") < 100 if rasters else svg.count("<use ") > 2 * count
    assert len(svg) < 900_000


def test_residual_grid_means_by_cell():
    rng = np.random.default_rng(1)
    xy, v = rng.uniform(0.0, [300.0, 200.0], (500, 2)), rng.standard_normal((500, 2))
    centres, means, counts = plots.residual_grid(xy, v, (300.0, 200.0), 6)
    assert counts.sum() == 500 and len(centres) == 24
    np.testing.assert_allclose((means * counts[:, None]).sum(axis=0), v.sum(axis=0), atol=1e-12)
    for c, m, n in zip(centres, means, counts, strict=True):
        inside = (np.abs(xy - c) <= 25.0).all(axis=1)
        assert inside.sum() == n
        np.testing.assert_allclose(v[inside].mean(axis=0), m, atol=1e-12)


def test_vectors_are_drawn_to_scale():
    at, v = np.array([[100.0, 100.0], [300.0, 100.0]]), np.array([[1.0, 0.0], [0.0, 2.0]])
    svg, arrow = plots.vectors(at, v, [False, False], (0.0, 400.0, 0.0, 200.0), True, "v")
    assert arrow in (1.0, 2.0) and f">{arrow:g} px</text>" in svg


# ---- contrast --------------------------------------------------------------------------------------------------------------------------


def luminance(colour):
    """Relative luminance of #rrggbb (WCAG 2.2)."""
    parts = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("scheme", [0, 1, 2], ids=["light", "dark", "print"])
def test_colours_have_the_contrast_that_reading_needs(scheme, calibration):
    """At least 4.5 for text, 3 for graphics (WCAG 2.2, 1.4.3 and 1.4.11)."""
    text = page.html(calibration, [])
    block = re.findall(r":root \{(.*?)\}", text, re.DOTALL)[scheme]
    colours = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", block))

    def contrast(a, b):
        light, dark = sorted((luminance(colours[a]), luminance(colours[b])), reverse=True)
        return (light + 0.05) / (dark + 0.05)

    for ink in ("ink", "muted", "link"):
        assert contrast(ink, "paper") >= 4.5, ink
        assert contrast(ink, "panel") >= 4.5, ink
    for tone in ("good", "warn", "bad", "info"):
        assert contrast(tone, f"{tone}-paper") >= 4.5, tone
    for line in ("blue", "orange", "green"):
        assert contrast(line, "paper") >= 3.0, line


# ---- what a surveyor asks for ----------------------------------------------------------------------------------------------------------


def section(analysis, name):
    return next(s for s in page.sections(analysis) if s.id == name)


def test_iterations_are_a_figure(calibration):
    (figure,) = [b for b in section(calibration, "data").blocks if isinstance(b, Figure)]
    history = calibration.adjustment.history
    assert figure.name == "iterations" and "v'Pv falls from" in figure.caption
    assert f"in {len(history) - 1} iteration" in figure.caption
    assert ("Damped:" in figure.caption) == any(h.damping > 0.0 for h in history)
    assert ("refused" in figure.caption) == any(not h.accepted for h in history)
    assert "mathdefault" not in figure.svg and "1e-" in figure.svg
    assert figure.svg.count("relative step") == 1 and len(figure.alt) > len(figure.caption)


def test_expanded_uncertainties_state_their_factors(aerial):
    """The factors by the quantiles of t and F; the largest coordinate by its own standard deviation."""
    from scipy import stats

    table = next(b for b in section(aerial, "points").blocks if isinstance(b, DataTable) and b.caption.startswith("Expanded"))
    rows = {r[0]: r for r in table.rows}
    r = aerial.adjustment.redundancy
    assert rows["X"][1:3] == (f"{stats.t(r).ppf(0.975):.3f}", f"t({r})")
    assert rows["horizontal"][1] == f"{np.sqrt(2 * stats.f(2, r).ppf(0.95)):.3f}"
    assert rows["in space"][1] == f"{np.sqrt(3 * stats.f(3, r).ppf(0.95)):.3f}"
    points = aerial.adjustment.point_table("aposteriori")
    assert float(rows["Z"][4]) == pytest.approx(stats.t(r).ppf(0.975) * points["sZ"].max(), rel=2e-2)
    assert float(rows["horizontal"][4]) == pytest.approx(points["ellipse_a"].max(), rel=2e-2)
    apriori = analyse(baarda.adjust(ring(control=4)), Options(sigma="apriori"))
    table = next(b for b in section(apriori, "points").blocks if isinstance(b, DataTable) and b.caption.startswith("Expanded"))
    assert [row[1] for row in table.rows] == ["1.960", "1.960", "1.960", "2.448", "2.795"]


def test_two_values_of_a_are_explained(calibration):
    words = page.text([section(calibration, "law")])
    a = calibration.study.laws.modulated.parameters["a"]
    b = calibration.study.critical.law.parameters["a"]
    assert abs(a - b) > 0.01  # they do differ here
    said = " ".join(words.split())
    assert f"a = {a:.2f} is the law of the residuals" in said and f"a = {b:.2f} is the law of the errors" in said
    assert "listens to the tails" in said


def test_audit_speaks_in_the_verdict():
    from baarda.procedures.audit import audit

    network = ring(control=5, checks=3)
    solved = baarda.adjust(network).network
    for source, tone, words in (
        (solved, "good", "within what the observations can tell"),
        (network, "bad", "not the least-squares solution"),
    ):
        audited = audit(source, Options())
        analysis = replace(analyse(audited.adjustment), audit=audited)
        made = section(analysis, "verdict").blocks[0].sentences
        assert 5 <= len(made) <= 8
        assert made[0].subject == "Audit" and made[0].tone == tone and words in made[0].text and made[0].link == "audit"


def test_far_points_do_not_make_the_plan_small():
    rng = np.random.default_rng(2)
    cloud = rng.uniform(0.0, 10.0, (400, 3))
    low, high = plots.core_of(cloud, np.array([[5.0, 5.0, 30.0]]))
    np.testing.assert_allclose(low, cloud.min(axis=0))
    np.testing.assert_allclose(high, [*cloud.max(axis=0)[:2], 30.0])
    far = np.concatenate([cloud, [[900.0, 5.0, 5.0], [5.0, -700.0, 5.0]]])
    low, high = plots.core_of(far, np.array([[5.0, 5.0, 30.0]]))
    assert high[0] < 20.0 and low[1] > -10.0 and high[2] == 30.0


def test_text_and_json_hold_what_the_page_holds(aerial):
    """The same sections as text; every number of the verdict from the same analysis as the JSON."""
    from baarda.report.result_folder import result_json

    document = result_json(aerial)
    said = page.verdict(aerial)
    assert f"{document['counts']['observations']} observations" in said[0]
    assert f"{document['sigma0']['aposteriori'] ** 2:.3f}" in said[1]
    words = page.text(page.sections(aerial))
    assert all(" ".join(s.split()[:6]) in " ".join(words.split()) for s in said)


def test_plan_of_many_points_draws_a_sample_and_says_so(aerial, monkeypatch):
    from baarda.report.sections import plan

    tie = np.arange(500_000) % 1000 != 0
    rows = plan._sample(tie)
    assert len(rows) == plan.MOST_POINTS and set(np.flatnonzero(~tie)) <= set(rows.tolist()) and (np.diff(rows) > 0).all()
    assert "are drawn" not in section(aerial, "network-plan").blocks[0].caption
    monkeypatch.setattr(plan, "MOST_POINTS", 100)
    made = section(aerial, "network-plan").blocks[0]
    assert "Only 100 points are drawn: those of the survey and an even sample of the others." in made.caption


def test_rows_by_unit_are_those_of_each_row(aerial):
    from baarda.report.sections._facts import rows_by_unit, unit_of

    rows = np.arange(aerial.adjustment.count)
    parts = rows_by_unit(aerial, rows)
    assert sorted(np.concatenate(list(parts.values())).tolist()) == rows.tolist()
    first = [int(at[0]) for at in parts.values()]
    assert first == sorted(first)
    for unit, at in parts.items():
        assert all(unit_of(aerial, int(i)) == unit for i in at[:: max(1, len(at) // 20)])
