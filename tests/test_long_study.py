"""Long columns of residuals: the streamed study agrees with the one in memory, and what cannot be streamed is read as before."""

from __future__ import annotations

import json

import numpy as np
import pytest

from baarda.distributions import law, profile_interval
from baarda.distributions.condensed import condense
from baarda.errors import InputError, UsageError
from baarda.formats import long_column
from baarda.formats.long_column import open_long
from baarda.hypotheses.goodness_of_fit import empirical_statistics
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.long_study import _representatives, binned_statistics, study_long
from baarda.procedures.residual_study import study
from baarda.report import residual_report

FEW = StudyOptions(laws=("normal", "radico", "modulated_normal", "laplace"), replicas=99)


@pytest.fixture(scope="module")
def values():
    return 1.0 + law("radico")(scale=3.0).rvs(200_000, np.random.default_rng(3))


def test_both_studies_agree(values):
    told: list[int] = []
    a, b = study_long(np.array_split(values, 7), FEW, progress=told.append), study(values, options=FEW)
    assert told[-1] == a.n == b.n == len(values)
    assert (a.mean, a.deviation, a.skewness, a.kurtosis) == pytest.approx((b.mean, b.deviation, b.skewness, b.kurtosis), rel=1e-7, abs=1e-7)
    assert [t.name for t in a.tests] == [t.name for t in b.tests]
    for s, t in zip(a.tests, b.tests, strict=True):
        assert s.statistic == pytest.approx(t.statistic, rel=1e-5, abs=1e-5)
    for s, t in zip(a.laws.laws, b.laws.laws, strict=True):
        assert s.fit.log_likelihood == pytest.approx(t.fit.log_likelihood, rel=1e-9)
        assert a.laws.rejected(s) == b.laws.rejected(t)
        assert s.test("anderson_darling").statistic == pytest.approx(t.test("anderson_darling").statistic, rel=0.03, abs=0.02)
        assert s.fit.df == pytest.approx(t.fit.df, abs=3)
    assert a.laws.ratio.statistic == pytest.approx(b.laws.ratio.statistic, rel=1e-4)
    assert a.laws.interval == pytest.approx(b.laws.interval, rel=1e-3)
    assert a.gates == b.gates
    assert [r.symbol for r in a.scale_rules] == [r.symbol for r in b.scale_rules]
    assert not a.laws.rounded


def test_counts_on_classes_between_bins_are_exact(values):
    found = study_long([values], FEW)
    histogram = found.laws.laws[0].fit.histogram
    counts = np.histogram(values, histogram.edges)[0]
    np.testing.assert_array_equal(histogram.counts, counts)


@pytest.mark.parametrize("name", ["normal", "lineo", "student"])
def test_binned_statistics(name):
    member = law(name)
    d = member(**({"nu": 4.0} if name == "student" else {}), loc=0.3, scale=2.0)
    x = np.sort(d.rvs(30_000, np.random.default_rng(9)))
    exact = np.array([float(t) for t in empirical_statistics(d.cdf(x), d.sf(x))])
    assert binned_statistics(condense(x, 0.1), d) == pytest.approx(exact, rel=0.06, abs=0.02)


def test_ranges_hold_their_values():
    x = np.concatenate([np.random.default_rng(2).standard_normal(5000), [0.0, 1e-300, -1e300, 64.0]])
    lower, upper, counts = condense(x).ranges()
    assert counts.sum() == len(x)
    assert np.all(np.diff(lower) > 0.0) and np.all(lower[1:] >= upper[:-1])
    inside = [int(np.sum((x >= a) & (x < b) if a >= 0.0 else (x > a) & (x <= b) & (x != 0.0))) for a, b in zip(lower, upper, strict=True)]
    assert inside == counts.tolist()


def test_profile_interval_of_condensed_values(values):
    whole = profile_interval(values, "modulated_normal", "a", loc=1.0)
    assert profile_interval(condense(values, 1.0), "modulated_normal", "a", loc=1.0) == pytest.approx(whole, rel=1e-6)


def test_representatives_keep_ends_and_quantiles(values):
    c = condense(values, 1.0)
    r = _representatives(c, float(values.min()), float(values.max()))
    assert (r[0], r[-1]) == (values.min(), values.max())
    q = [0.001, 0.1, 0.5, 0.9, 0.999]
    np.testing.assert_allclose(np.quantile(r, q), np.quantile(values, q), rtol=0.01, atol=0.01)


def test_rounded_values_are_recognised():
    x = np.round(law("normal")(scale=3.0).rvs(50_000, np.random.default_rng(1)))
    found = study_long([x], FEW)
    assert found.laws.rounded and found.laws.judged_by(found.laws.laws[0]) == "chi_square"


@pytest.mark.parametrize(
    ("chunks", "words"),
    [
        ([np.full(20_000, 3.0)], "are equal"),
        ([np.arange(20_000.0), np.array([1.0, np.nan])], "finite"),
        ([np.arange(20_000.0), np.array([np.inf])], "finite"),
        ([np.arange(5.0)], "few enough"),
        ([], "no values"),
    ],
)
def test_broken_streams(chunks, words):
    with pytest.raises(UsageError, match=words):
        study_long(chunks, FEW)


def test_given_class_limits_need_the_values():
    with pytest.raises(UsageError, match="automatic classes"):
        study_long([np.arange(20_000.0)], StudyOptions(classes=(0.0, 1.0, 2.0)))


def test_what_is_streamed(tmp_path):
    x = np.arange(100.0)
    np.save(tmp_path / "plain.npy", x)
    np.save(tmp_path / "two.npy", np.column_stack([x, x]))
    np.save(tmp_path / "named.npy", np.array([(v, 1.0) for v in x], dtype=[("residual", float), ("other", float)]))
    np.save(tmp_path / "grouped.npy", np.array([(v, 1) for v in x], dtype=[("residual", float), ("image", int)]))
    (tmp_path / "v.csv").write_text("residual\n1\n2\n")
    opened = {f.stem: open_long(f, least=100) for f in tmp_path.iterdir()}
    assert {name for name, found in opened.items() if found is not None} == {"plain", "named"}
    assert opened["plain"][1] == "1" and opened["named"][1] == "residual"
    assert open_long(tmp_path / "plain.npy", least=101) is None
    assert open_long(tmp_path / "plain.npy", group="1", least=5) is None
    assert open_long(tmp_path / "two.npy", "2", least=5) is None
    (tmp_path / "rubbish.npy").write_bytes(b"\x93NUMPY\x01\x00rubbish")
    assert open_long(tmp_path / "rubbish.npy", least=5) is None


def test_report_of_a_long_column(tmp_path, monkeypatch, values):
    monkeypatch.setattr(residual_report, "open_long", lambda *a, **k: long_column.open_long(*a, **k, least=1000))
    np.save(tmp_path / "v.npy", values)
    told: list[tuple[int, int]] = []
    made = residual_report.run(tmp_path / "v.npy", tmp_path / "out", options=FEW, progress=lambda *n: told.append(n))
    assert told[-1] == (len(values), len(values))
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document == made.document
    assert document["counts"]["values"] == len(values)
    assert (document["sample"]["minimum"], document["sample"]["maximum"]) == (values.min(), values.max())
    assert any("stream" in text for text in document["assumptions"])
    np.save(tmp_path / "w.npy", np.append(values, np.nan))
    with pytest.raises(InputError, match=r"w\.npy.*finite"):
        residual_report.run(tmp_path / "w.npy", tmp_path / "none", options=FEW)
    assert not (tmp_path / "none").exists()


def test_parquet_column(tmp_path, values):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(arrow.table({"residual": values, "other": values}), tmp_path / "v.parquet")
    stream, column = open_long(tmp_path / "v.parquet", least=1000)
    assert (stream.total, column) == (len(values), "residual")
    found = study_long(stream, FEW)
    assert found.mean == pytest.approx(values.mean())
    parquet.write_table(arrow.table({"residual": values, "group": values}), tmp_path / "g.parquet")
    assert open_long(tmp_path / "g.parquet", least=1000) is None
