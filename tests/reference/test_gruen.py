"""Grün's networks: Table 2, Table 3 and the expected test statistics, and what the paper's page may not hide."""

import json

import numpy as np
import pytest

import baarda
from baarda import papers
from baarda.papers import gruen

CELLS = ("x' pt 1", "y' pt 1", "x' pt 2", "y' pt 2")
FITTED = "delta0 sigma0 = 20.68"
# recomputed independently of the package
RI = {
    "A": (0.195, 0.527, 0.361),
    "B": (0.198, 0.525, 0.361),
    "C": (0.428, 0.646, 0.537),
    "D": (0.625, 0.625, 0.625),
    "E": (0.625, 0.625, 0.625),
}
SD = {
    "A": (0.257, 1.286, 0.258, 0.600),
    "B": (0.098, 0.287, 0.104, 0.163),
    "C": (0.085, 0.282, 0.090, 0.153),
    "D": (0.182, 0.907, 0.182, 0.423),
    "E": (0.071, 0.200, 0.071, 0.114),
}
MDB = {
    "A": (28.3, 27.2, np.inf, 32.0),
    "B": (31.5, 29.6, 204.8, 32.4),
    "C": (29.6, 27.7, 48.4, 27.3),
    "D": (25.5, 25.2, 32.4, 25.9),
    "E": (27.3, 26.8, 31.3, 26.2),
}
Q = {
    "A": (0.5335, 0.5776, 0, 0.4182),
    "B": (0.4323, 0.4877, 0.0102, 0.4077),
    "C": (0.4883, 0.5580, 0.1822, 0.5740),
    "D": (0.6584, 0.6761, 0.4063, 0.6366),
    "E": (0.5757, 0.5975, 0.4367, 0.6215),
}
W = {
    "A": (4.38, 4.56, 0, 3.88),
    "B": (3.94, 4.19, 0.61, 3.83),
    "C": (4.19, 4.48, 2.56, 4.55),
    "D": (4.87, 4.93, 3.82, 4.79),
    "E": (4.55, 4.64, 3.96, 4.73),
}
IMAGE = {"A": "1", "B": "3", "C": "3", "D": "1", "E": "3"}


@pytest.fixture(scope="module")
def made():
    return papers.paper("gruen").run()


def test_table_2(made):
    table = made.comparison("table-2")
    counts = [r for r in table.rows if r.labels[1] in ("n", "u", "r")]
    assert len(counts) == 15
    assert all(r.agrees for r in counts)
    for version in gruen.VERSIONS:
        np.testing.assert_allclose([table.value(version, f"RI({k})") for k in ("x'", "y'", "T")], RI[version], atol=6e-4)
        np.testing.assert_allclose([table.value(version, f"AI({k}) (mm)") for k in "XYZT"], SD[version], atol=6e-4)
    legible = [r for r in table.rows if r.labels[1].startswith("RI") and r.printed is not None]
    assert len(legible) == 11
    assert sum(r.agrees for r in legible) == 10
    assert all(abs(r.difference) < 0.0075 for r in legible)
    assert all(abs(r.difference) < 0.035 for r in table.rows if r.labels[1].startswith("AI") and r.printed is not None)


def test_table_3(made):
    table = made.comparison("table-3")
    for version in gruen.VERSIONS:
        where = f"{version}, image {IMAGE[version]}"
        np.testing.assert_allclose([table.value(where, c, "q_ii") for c in CELLS], Q[version], atol=6e-5)
        for cell, expected in zip(CELLS, MDB[version], strict=True):
            assert table.value(where, cell, FITTED) == pytest.approx(expected, abs=0.06)
            own = table.value(where, cell, "delta0 sigma0 = 20.66")
            assert own == pytest.approx(expected * 20.66 / 20.68, rel=2e-3)
    printed = [r for r in table.rows if r.printed is not None and r.labels[:2] != ("B, image 3", "x' pt 2")]
    far = [r for r in printed if abs(r.difference) > 0.1]
    assert (len(printed), len(far)) == (17, 1)
    assert far[0].labels == ("D, image 1", "y' pt 1", FITTED)
    assert far[0].reason.code == "illegible"
    assert table.row("A, image 1", "x' pt 2", FITTED).remark


def test_expected_statistics(made):
    table = made.comparison("expected-w")
    for version, expected in W.items():
        np.testing.assert_allclose([table.value(version, c, "expected |w|") for c in CELLS], expected, atol=6e-3)
        for cell, w in zip(CELLS, expected, strict=True):
            assert table.row(version, cell, "beyond 3.29").agrees
            assert table.value(version, cell, "beyond 3.29") == ("yes" if w > 3.29 else "no")


def test_an_adjustment_with_the_error_gives_the_expected_w():
    """The whole way: error-free observations of the planned network, one of them falsified, adjusted; w of that observation."""
    from dataclasses import replace

    from baarda.procedures.planning import error_free

    network = error_free(gruen.network("D"))
    group = network.observations[0]
    row = next(
        i
        for i in range(len(group))
        if network.images.labels[group.images[i]] == "1" and network.points.labels[group.points[i]] == gruen.POINT_2
    )
    xy = np.array(group.xy)
    xy[row, 0] += gruen.ERROR
    result = baarda.adjust(replace(network, observations=(replace(group, xy=xy),)))
    e = result.evidence
    w = e.residuals[2 * row] / (5.0 * np.sqrt(e.qvv[2 * row]))
    assert abs(w) == pytest.approx(3.82, abs=0.01)
    assert np.nanargmax(np.abs(e.residuals / np.sqrt(np.where(e.qvv > 1e-10, e.qvv, np.nan)))) == 2 * row


def test_levels(made):
    table = made.comparison("levels")
    assert table.value("lambda0 at 0.1 % and a power of 80 %") == pytest.approx(17.075, abs=5e-4)
    assert table.value("limit of tau, r = 39") == pytest.approx(3.127, abs=5e-4)
    for r, level, limit in ((39, 0.213, 1.172), (87, 0.369, 1.044), (135, 0.450, 1.011)):
        assert table.value(f"level of the global test coupled with them, r = {r}") == pytest.approx(level, abs=6e-4)
        assert table.value(f"limit of s0^2 / sigma0^2, r = {r}") == pytest.approx(limit, abs=6e-4)


def test_an_infinite_error_is_a_word_in_text_and_null_in_json(made, tmp_path):
    assert " inf " in papers.render_text(made)
    folder = papers.write(made, tmp_path / "out")
    content = json.loads((folder / "reproduce.json").read_text(encoding="utf-8"))
    table = next(c for c in content["comparisons"] if c["table"] == "table-3")
    assert [r["ours"] for r in table["rows"] if r["labels"][:2] == ["A, image 1", "x' pt 2"]][:2] == [None, None]
    assert "NaN" not in (folder / "reproduce.json").read_text(encoding="utf-8")
