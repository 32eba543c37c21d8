"""Maarek & Konecny recomputed: printed values, our values, the reasons, and the study on simulated measurements."""

import csv
import json
from xml.etree import ElementTree

import numpy as np
import pytest

from baarda import papers
from baarda.adjustment import adjust
from baarda.distributions import law
from baarda.errors import OutputError, UsageError
from baarda.papers import Comparison, Reason, Reproduction, Row
from baarda.papers import _maarek_konecny_printed as printed
from baarda.papers._drawing import class_histogram
from baarda.papers._page import table_csv
from baarda.papers.maarek_konecny_study import a_of_kurtosis, elementary_errors, grid_network, scale_rule, study

CLOSED, NUMBERS, OPEN = "629 values, closed", "629 values against 630 P, closed", "630 values, open"


@pytest.fixture(scope="module")
def made():
    return papers.papers()["maarek-konecny"].run()


@pytest.fixture(scope="module")
def simulated():
    return study()


def values(comparison, quantity):
    return [r.ours for r in comparison.rows if r.labels[-1] == quantity]


# ---- the paper ----------------------------------------------------------------------------------------------------------------------


def test_expected_counts_of_table_1(made):
    table = made.comparison("table-1")
    exact = {
        "T normal": (2.56, 9.11, 25.28, 54.59, 91.85, 120.38, 122.91, 97.76, 60.57, 29.24, 10.99, 3.22),
        "T lineo": (3.24, 9.45, 23.59, 50.05, 88.92, 127.00, 131.08, 95.97, 55.80, 27.05, 11.13, 3.91),
        "T radico": (3.52, 9.61, 22.97, 47.92, 86.54, 130.64, 136.30, 94.01, 53.43, 26.21, 11.22, 4.20),
    }
    for quantity, expected in exact.items():
        np.testing.assert_allclose(values(table, quantity), expected, atol=0.00501)
    assert table.value("all", "M_o (um)") == pytest.approx(-0.333, abs=5e-4)
    assert table.value("all", "S_o (um)") == pytest.approx(7.92, abs=5e-3)
    assert table.value("all", "S_M (um)") == pytest.approx(7.17, abs=5e-3)
    assert table.row("-16 to -12", "T normal").reason.code == "slip"
    for name in ("lineo", "radico"):  # the printed counts belong to a narrower law
        assert 7.78 < table.value("all", f"S that the printed T {name} fit") < 7.90


@pytest.mark.parametrize(
    ("law_name", "choice", "expected"),
    [
        ("lineo", NUMBERS, 14.04),
        ("lineo", CLOSED, 14.07),
        ("lineo", OPEN, 14.82),
        ("radico", NUMBERS, 11.19),
        ("radico", CLOSED, 11.22),
        ("radico", OPEN, 12.36),
        ("normal S_o", NUMBERS, 23.26),
        ("normal S_o", CLOSED, 23.30),
        ("normal S_o", OPEN, 23.71),
        ("normal S_M", NUMBERS, 14.65),
        ("normal S_M", CLOSED, 14.67),
        ("normal S_M", OPEN, 16.47),
        ("normal Q_v", "630 values, closed", 15.41),
        ("normal S_P", NUMBERS, 14.37),
        ("normal S_P", CLOSED, 14.39),
        ("normal S_P", OPEN, 15.52),
    ],
)
def test_chi_squares_of_table_4(made, law_name, choice, expected):
    assert made.comparison("table-4").value(law_name, choice, "chi-square") == pytest.approx(expected, abs=0.00501)


def test_every_decision_of_table_4_in_every_treatment(made):
    decisions = [r for r in made.comparison("table-4").rows if r.labels[-1] == "decision"]
    assert len(decisions) == 17
    assert {r.labels[0] for r in decisions} == set(printed.V_CHI2)
    assert all(r.agrees for r in decisions)
    assert {r.labels[0] for r in decisions if r.ours == "reject"} == {"normal S_o"}


def test_minimum_of_chi_square(made):
    table = made.comparison("table-4")
    assert table.value("normal S_P", CLOSED, "M_P (um)") == pytest.approx(-0.261, abs=6e-4)
    assert table.value("normal S_P", CLOSED, "S_P (um)") == pytest.approx(7.271, abs=5e-4)
    assert table.value("normal S_P", CLOSED, "chi-square at the printed M_P, S_P") == pytest.approx(14.40, abs=5e-3)
    assert table.value("normal S_P", OPEN, "M_P (um)") == pytest.approx(-0.191, abs=5e-4)
    assert table.value("normal S_P", OPEN, "S_P (um)") == pytest.approx(7.324, abs=5e-4)


def test_law_with_a_free(made):
    table = made.comparison("free-law")
    expected = {CLOSED: (0.378, -0.378, 7.269, 5.10), OPEN: (0.392, -0.346, 7.242, 5.15)}
    for choice, numbers in expected.items():
        found = [r.ours for r in table.rows if r.labels[1] == choice]
        assert np.all(np.abs(np.subtract(found, numbers)) <= [6e-4, 6e-4, 6e-4, 6e-3])


def test_tables_2_and_3(made):
    assert made.comparison("table-2").value("all", "sum of the printed terms") == pytest.approx(12.62, abs=5e-3)
    assert made.comparison("table-2").value("all", "sum of terms") == pytest.approx(14.65, abs=5e-3)
    slips = [r.labels[0] for r in made.comparison("table-2").rows if r.labels[1] == "|F - T|" and not r.agrees]
    assert slips == ["8 to 12", "-12 to -8"]
    table = made.comparison("table-3")
    np.testing.assert_allclose(values(table, "T")[:6], (3.06, 10.42, 27.76, 57.86, 94.43, 120.62), atol=5e-3)
    assert table.value("all", "sum of the printed terms") == pytest.approx(14.21, abs=5e-3)
    assert table.value("all", "sum of terms") == pytest.approx(15.41, abs=5e-3)


def test_expected_counts_of_table_5(made):
    table = made.comparison("table-5")
    exact = {
        "T normal": (34.64, 31.76, 26.70, 20.58, 14.55, 9.43, 5.60, 3.05, 2.22, 0.41),
        "T lineo": (37.30, 32.69, 26.03, 19.22, 13.29, 8.65, 5.32, 3.10, 2.60, 0.65),
        "T radico": (39.14, 32.89, 25.40, 18.45, 12.71, 8.34, 5.22, 3.12, 2.75, 0.76),
    }
    for quantity, expected in exact.items():
        np.testing.assert_allclose(values(table, quantity), expected, atol=5.1e-3)
    assert table.value("10.5", "z") == pytest.approx(1.7736, abs=5e-5)
    assert table.value("21", "z") == pytest.approx(3.5473, abs=5e-5)
    assert table.value("all", "sum F t^2") == pytest.approx(10327.7, abs=0.05)


def test_table_6_but_for_lineo_at_17(made):
    table = made.comparison("table-6")
    exact = {  # open ends
        13: (31.5, 21.4, 17.1),
        15: (33.1, 21.8, 17.3),
        17: (47.4, 27.7, 21.6),
    }
    for df, expected in exact.items():
        found = [table.value(str(df), name, "open", "chi-square") for name in ("normal", "lineo", "radico")]
        np.testing.assert_allclose(found, expected, atol=0.0501)
        assert table.row(str(df), "all", "", "critical value").agrees
    assert table.value("17", "lineo", "open", "chi-square") == pytest.approx(27.70, abs=5e-3)
    assert table.value("17", "lineo", "closed", "chi-square") == pytest.approx(31.26, abs=5e-3)
    decisions = [r for r in table.rows if r.labels[-1] == "decision"]
    assert {r.labels[:2] for r in decisions if not r.agrees} == {("17", "lineo")}
    assert all((r.ours == "reject") == (r.labels[1] == "normal") for r in decisions if r.labels[:2] != ("17", "lineo"))
    assert table.row("17", "lineo", "open", "decision").reason.code == "end classes"


def test_bartlett_of_appendix_1(made):
    table = made.comparison("appendix-1")
    expected = {
        "9 points": (79.0, 4.843, 4.700, 2.103, 264.6, 16.919),
        "25 points": (66.33, 6.587, 6.532, 2.861, 833.8, 15.507),
    }
    for name, numbers in expected.items():
        found = [r.ours for r in table.rows if r.labels[0] == name][:6]
        assert np.all(np.abs(np.subtract(found, numbers)) <= [0.005, 5e-4, 5e-4, 5e-4, 0.05, 5e-4])
        assert table.row(name, "decision, corrected").ours == "accept"
        assert table.value(name, "sets whose variance differs from the pooled one, chi-square") == 0
    assert table.row("25 points", "critical value, 8 degrees of freedom").reason.code == "slip"


def test_fisher_ratios_are_descriptive(made):
    table = made.comparison("fisher")
    assert "Descriptive" in table.note
    assert "descriptive" in table.title
    assert table.value("all", "F(9, 9) at 95 %") == pytest.approx(3.179, abs=5e-4)
    assert all(r.agrees for r in table.rows)


def test_peaks_of_the_laws(made):
    assert all(r.agrees for r in made.comparison("laws").rows)


def test_every_difference_has_a_reason(made):
    rows = [r for c in made.comparisons for r in c.rows]
    assert len(rows) > 300
    assert all((r.reason is None) == r.agrees for r in rows)


def test_figures_1_to_8(made):
    names = [f.name for f in made.figures]
    assert names == [*(f"figure-{k}" for k in range(1, 9)), "figure-study"]
    ids = [e.get("id") for f in made.figures for e in ElementTree.fromstring(f.svg).iter() if e.get("id")]
    assert len(ids) == len(set(ids))
    assert all(f.alt and f.caption and f.title for f in made.figures)


# ---- the contract ---------------------------------------------------------------------------------------------------------------------


def test_a_row_needs_a_reason_exactly_where_it_differs():
    why = Reason("slip", "A slip.")
    assert Row(("x",), 1.23, 1.2349).agrees
    assert not Row(("x",), 1.23, 1.2351, reason=why).agrees
    assert Row(("x",), 1.23, 1.25, reason=why).difference == pytest.approx(0.02)
    with pytest.raises(UsageError, match="without a reason"):
        Row(("x",), 1.23, 1.25)
    with pytest.raises(UsageError, match="carry a reason"):
        Row(("x",), 1.23, 1.23, reason=why)
    with pytest.raises(UsageError, match="without a reason"):
        Row(("x",), "accept", "reject")
    with pytest.raises(UsageError, match="does not fit"):
        Comparison("t", "T", ("a", "b"), (Row(("x",), None, 1.0),))


def test_unknown_names_are_named():
    with pytest.raises(UsageError, match="maarek-konecny"):
        papers.paper("nobody")
    with pytest.raises(UsageError, match="no table"):
        Reproduction((), (), ()).comparison("table-1")


def test_text_says_everything(made):
    text = papers.render_text(made)
    for sentence in made.sentences:
        assert sentence.split()[0] in text
    assert "27.70" in text and "4.843" in text and "-0.261" in text
    assert all(c.title in text for c in made.comparisons)
    assert all(reason.code in text for c in made.comparisons for reason in c.reasons)


def test_folder_is_whole_and_the_same_again(made, tmp_path):
    first, second = papers.write(made, tmp_path / "a"), papers.write(papers.papers()["maarek-konecny"].run(), tmp_path / "b")
    names = sorted(str(f.relative_to(first)) for f in first.rglob("*") if f.is_file())
    assert [n for n in names if "/" not in n] == ["reproduce.html", "reproduce.json"]
    assert len([n for n in names if n.startswith("tables/")]) == len(made.comparisons)
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes()
    assert not [f for f in tmp_path.iterdir() if f.name.startswith(".")]
    papers.write(made, first)  # an earlier reproduction is replaced
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        papers.write(made, tmp_path / "mine")
    with pytest.raises(OutputError, match="exists"):
        papers.write(made, tmp_path / "mine" / "notes.txt")


def test_page_stands_alone(made):
    page = papers.html(made)
    assert "default-src 'none'" in page
    for forbidden in ("<script", "http://", "https://", "@import", "url(http", "<link", " src="):
        assert forbidden not in page.replace("http://www.w3.org/1999/xlink", "")
    assert page.count("<svg") == len(made.figures)


def test_page_escapes():
    evil = "<script>alert(1)</script>"
    c = Comparison("t", evil, (evil,), (Row((evil,), evil, evil, remark=evil),), evil)
    page = papers.html(Reproduction((c,), (), (evil,), title=evil, reference=evil))
    assert "<script" not in page


def test_json_and_csv_read_back(made, tmp_path):
    document = json.loads((papers.write(made, tmp_path / "x") / "reproduce.json").read_text(), parse_constant=lambda c: pytest.fail(c))
    assert document["schema"] == "baarda.reproduction/1"
    rows = next(c for c in document["comparisons"] if c["table"] == "table-4")["rows"]
    assert rows[0]["ours"] == made.comparison("table-4").rows[0].ours
    used = {r["reason"] for c in document["comparisons"] for r in c["rows"]} - {None}
    assert used == set(document["reasons"])
    lines = list(csv.DictReader(table_csv(made.comparison("table-6")).splitlines()))
    assert [float(x["ours"]) for x in lines if x["quantity"] == "chi-square"] == values(made.comparison("table-6"), "chi-square")


def test_drawing_does_not_read_markup():
    svg = class_histogram("t", np.array([1.0, 2.0]), np.array([-1.0, 0.0, 1.0]), [("$a<b$ & c", law("normal")())], 3.0, "<x>")
    assert "$a&lt;b$ &amp; c" in svg
    ElementTree.fromstring(svg)


# ---- the study ---------------------------------------------------------------------------------------------------------------------------


def test_study_has_the_sizes_of_the_paper(simulated):
    assert len(simulated.residuals) == 630
    assert simulated.redundancies.tolist() == [12] * 10 + [44] * 9
    assert simulated.redundancy == 516
    np.testing.assert_allclose(simulated.shares.sum(), 516, rtol=1e-12)
    for r in simulated.projectors:
        np.testing.assert_allclose(r @ r, r, atol=1e-12)
        np.testing.assert_allclose(r, r.T, atol=1e-12)
    # the shifts of the camera make the mean zero: the first moment cannot be tested on raw residuals
    assert max(abs(np.ones(len(r)) @ r @ np.ones(len(r))) for r in simulated.projectors) < 1e-4


def test_projector_stands_for_the_adjustment():
    errors = elementary_errors(50, 0.5, 7.92, np.random.default_rng(3))
    result = adjust(grid_network(5, "set", np.random.default_rng(4), errors, 7.92))
    assert result.status == "converged"
    assert result.redundancy == 44
    projector = -result.residuals_of(np.eye(50))
    np.testing.assert_allclose(result.residuals, -projector @ errors, atol=0.01)


@pytest.mark.parametrize("a", [-0.5, 0.0, 0.5, 2.0, np.inf])
def test_elementary_errors_have_the_moments_of_the_law(a):
    n, number = 400_000, 500
    e = elementary_errors(n, a, 3.0, np.random.default_rng(8), number)
    m1, m2 = ((a + 1) / (a + 2), (a + 1) / (a + 3)) if np.isfinite(a) else (1.0, 1.0)
    # exact fourth moment of K signs, K binomial(number, t): 3 K^2 - 2 K
    fourth = 81.0 * (3 * (number - 1) * m2 + m1) / (number * m1**2)
    for sample, expected in ((e**2, 9.0), (e**4, fourth)):
        assert abs(sample.mean() - expected) <= 4.0 * sample.std() / np.sqrt(n)
    assert fourth / 81.0 == pytest.approx(3.0 + (law("modulated_normal")(a=a).excess_kurtosis() if np.isfinite(a) else 0.0), abs=0.02)


@pytest.mark.parametrize("a", [-0.9, -0.25, 0.0, 0.5, 1.0, 2.0, 30.0])
def test_a_and_kurtosis_are_inverse(a):
    assert a_of_kurtosis(law("modulated_normal")(a=a).excess_kurtosis()) == pytest.approx(a, rel=1e-9, abs=1e-12)


def test_residuals_are_more_normal_than_errors(simulated):
    """A true a = 1/2 appears as about 1.43 with 18 observations and 0.78 with 50."""
    excess = law("radico")().excess_kurtosis()
    for size, expected in ((18, 1.43), (50, 0.78)):
        r = next(r for r in simulated.projectors if len(r) == size)
        dilution = np.mean(np.sum(r**4, axis=1) / np.diag(r) ** 2)
        assert a_of_kurtosis(excess * dilution) == pytest.approx(expected, abs=0.08)


def test_kurtosis_equations_are_exact(simulated):
    """The two linear equations against direct fourth moments: E v_i^2 v_k^2 for independent errors."""
    g, sigma = 0.7, 2.0
    r = float(simulated.redundancy)
    power, second = 0.0, 0.0
    for p in simulated.projectors:
        q = np.diag(p)
        power += np.sum(3 * q**2 + g * np.sum(p**4, axis=1))
        squares = p**2
        second += np.sum(2 * squares + g * squares @ squares.T)  # covariances of v_i^2, v_k^2
    s4 = (r**2 + second) / r**2
    left = np.array([[3 * np.sum(simulated.shares**2), simulated.fourth.sum()], [1 + 2 / r, np.sum(simulated.shares**2) / r**2]])
    solved = np.linalg.solve(left, sigma**4 * np.array([power, s4]))
    np.testing.assert_allclose(solved, [sigma**4, g * sigma**4], rtol=1e-10)


def test_study_is_the_same_again(simulated):
    again = study()
    assert again.residuals.tobytes() == simulated.residuals.tobytes()
    assert not np.array_equal(study(seed=1).residuals, simulated.residuals)


def test_bad_arguments(simulated):
    for arguments in ((10, -1.0, 1.0), (10, 0.5, 0.0)):
        with pytest.raises(UsageError, match="elementary errors"):
            elementary_errors(*arguments, np.random.default_rng(0))
    with pytest.raises(UsageError, match="ends"):
        scale_rule(simulated, 10, "ajar")


def test_study_tables(made):
    assert len([r for r in made.comparison("study-sets").rows if r.labels[1] == "S_i (um)"]) == 19
    a = made.comparison("study-a")
    assert abs(a.value("2000 replicas", "a of the errors, through Qvv") - 0.5) < 0.1
    assert a.value("2000 replicas", "a of the residuals, from their kurtosis") > 0.75
    assert {r.labels[0] for r in made.comparison("study-laws").rows} == set(printed.V_CHI2)
