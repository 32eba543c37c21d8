"""The block in space: the numbers of the figure and of the viewer, and the page in a browser where one is here."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import baarda
from baarda.formats import dbat
from baarda.procedures.testing import analyse
from baarda.report import page, scene
from baarda.report.sections.base import Interactive
from baarda.report.sections.maps import cell_means
from networks import ring

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def aerial(data):
    return analyse(baarda.adjust(dbat.read(data("dbat_sxb") / "sxb.xml")))


@pytest.fixture(scope="module")
def block(aerial):
    return scene.scene_of(aerial)


def test_scene_holds_the_block(aerial, block):
    net = aerial.adjustment.network
    np.testing.assert_allclose(block.points + block.origin, net.points.coordinates, atol=1e-6)
    np.testing.assert_allclose(block.cameras + block.origin, net.images.position, atol=1e-6)
    table = aerial.adjustment.point_table("aposteriori")
    np.testing.assert_allclose(block.sigmas, np.sqrt(table["sX"] ** 2 + table["sY"] ** 2 + table["sZ"] ** 2), rtol=1e-9)
    assert block.total == len(block.names) == 381


def test_ellipsoids_are_those_of_the_point_table(aerial, block):
    table = aerial.adjustment.point_table("aposteriori")
    axes = np.sqrt(np.linalg.eigvalsh(block.covariances)[:, ::-1])
    for k, name in enumerate("abc"):
        np.testing.assert_allclose(axes[:, k], table[f"ellipsoid_{name}"][block.ellipsoids], rtol=1e-9)
    assert (np.diff(block.sigmas[block.ellipsoids]) <= 1e-12).all()


def test_suspected_rays_are_the_suspected_observations(aerial, block):
    o = aerial.observations
    wanted = {(o["image"][i], o["point"][i]) for i in aerial.suspected if o["image"][i]}
    assert {(block.images[i], block.names[p]) for i, p in block.rays.tolist()} == wanted


def test_axes_of_the_figure_are_orthonormal(block):
    view = block.view()
    np.testing.assert_allclose(view @ view.T, np.eye(2), atol=1e-12)
    assert view[1, 2] > 0.0  # Z points upwards


def test_pyramids_open_in_the_viewing_direction(block):
    corners = block.frustum()
    middle = corners[:, 1:].mean(axis=1) - corners[:, 0]
    np.testing.assert_allclose(middle, -block.depth * block.axes[:, 2, :], atol=1e-9 * block.depth)


def test_json_of_the_viewer_reads_back(block):
    text = block.to_json(page.printable)
    assert not set("<>&") & set(text)
    read = json.loads(text)
    count = len(read["names"])
    assert len(read["points"]) == 3 * count and len(read["sigma"]) == len(read["redundancy"]) == len(read["role"]) == count
    assert len(read["cameras"]) == 15 * len(read["images"]) and len(read["shapes"]) == 6 * len(read["ellipsoids"])
    assert len(read["rays"]) % 2 == 0 and all(0 <= i < count for i in read["rays"][1::2])
    assert set(read["role"]) <= set("ioh")
    reach = np.abs(np.concatenate([block.core, block.cameras])).max()
    np.testing.assert_allclose(np.array(read["points"]).reshape(-1, 3) * reach / 30000, block.points, atol=reach / 30000)


def test_hostile_names_cannot_leave_the_data():
    n = ring(control=3)
    evil = tuple(f"</script><script>alert({i})</script>\u202e" for i in range(len(n.points.labels)))
    n = replace(n, points=replace(n.points, labels=evil))
    analysis = analyse(baarda.adjust(n))
    text = page.html(analysis, page.sections(analysis))
    assert text.count("<script") == 2 and text.count("</script>") == 2 and "\u202e" not in text
    data = re.search(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)[1]
    assert json.loads(data)["names"][0].startswith("</script><script>alert(0)")


def test_large_blocks_are_sampled_and_the_page_says_so(monkeypatch):
    monkeypatch.setattr(scene, "MOST_POINTS", 20)
    monkeypatch.setattr(scene, "MOST_ELLIPSOIDS", 5)
    analysis = analyse(baarda.adjust(ring(points=60, control=4, checks=3)))
    found = scene.scene_of(analysis)
    assert len(found.names) == 20 and found.total == 60 and len(found.ellipsoids) == 5
    assert sum(r != "tie" for r in found.roles) == 7  # those of the survey are all there
    words = page.text([s for s in page.sections(analysis) if s.id == "space"])
    assert "Only 20 points are drawn" in words


def test_no_view_without_images():
    assert scene.scene_of(analyse(baarda.adjust(ring(), iterations=1))) is None


def test_cell_means_recomputed():
    rng = np.random.default_rng(1)
    xy, v = rng.uniform(0, [30, 20], (500, 2)), rng.normal(size=500)
    v[7] = np.nan
    means, counts = cell_means(xy, v, (0.0, 30.0, 0.0, 20.0), 6)
    assert means.shape == (4, 6) and counts.sum() == 499
    inside = (xy[:, 0] >= 10) & (xy[:, 0] < 15) & (xy[:, 1] >= 5) & (xy[:, 1] < 10) & np.isfinite(v)
    assert means[1, 2] == pytest.approx(v[inside].mean()) and counts[1, 2] == inside.sum()


def test_factor_of_the_ellipsoids_apriori():
    from baarda.hypotheses.levels import Options

    analysis = analyse(baarda.adjust(ring(control=4)), Options(sigma="apriori"))
    found = scene.scene_of(analysis)
    first = found.ellipsoids[0]
    np.testing.assert_allclose(found.covariances[0], stats.chi2(3).ppf(0.95) * analysis.adjustment.point_cofactors[first], rtol=1e-12)


def dump(page_text, folder):
    """Return the page as a browser has it after its scripts have run."""
    file = folder / "report.html"
    file.write_text(page_text, encoding="utf-8")
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        "--disable-background-networking",
        "--virtual-time-budget=3000",
    ]
    command = [CHROMIUM, *flags, f"--user-data-dir={folder / 'profile'}", "--dump-dom", file.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_viewer_turns_with_the_keys(aerial, tmp_path):
    """A second script, which only this test lets in, presses a key and waits for another picture."""
    made = page.sections(aerial)
    press = """<script>setTimeout(() => {
      const c = document.querySelector("canvas"), before = c.toDataURL();
      c.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowLeft"}));
      const wait = setInterval(() => { if (c.toDataURL() !== before) { document.title = "turned"; clearInterval(wait); } }, 50);
    }, 1000)</script></body>"""
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.html(aerial, made)).replace("</body>", press)
    assert "<title>turned</title>" in dump(text, tmp_path)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_viewer_runs_in_a_browser_without_network(aerial, tmp_path):
    """The script must have revealed the view and told its keys; a script error or a blocked script leaves it hidden."""
    made = page.sections(aerial)
    assert any(isinstance(b, Interactive) for s in made for b in s.blocks)
    file = tmp_path / "report.html"
    file.write_text(page.html(aerial, made), encoding="utf-8")
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        "--disable-background-networking",
        "--virtual-time-budget=2000",
    ]
    command = [CHROMIUM, *flags, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", file.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    shown = re.search(r'<div class="space" id="space-block-to-turn"([^>]*)>', dom)
    assert shown is not None and "hidden" not in shown[1]
    assert re.search(r"<output[^>]*>Drag to turn", dom)
    assert int(re.search(r'<canvas[^>]*width="(\d+)"', dom)[1]) > 300  # it has drawn
