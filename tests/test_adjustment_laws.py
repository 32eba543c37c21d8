"""The law of errors of an adjustment: the moments with 1'Qvv1, p-values through R, critical values, report and result.json."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

import baarda
from baarda.errors import UsageError
from baarda.hypotheses import jarque_bera, moments
from baarda.hypotheses._linear_model import linear_model
from baarda.hypotheses.levels import Options
from baarda.hypotheses.moments import sum_of_residuals
from baarda.hypotheses.normality import jarque_bera_of_moments
from baarda.hypotheses.outliers import TauLaw
from baarda.procedures.adjustment_laws import residuals_of
from baarda.procedures.law_bootstrap import CHI_SQUARE, STATISTICS
from baarda.procedures.testing import analyse
from baarda.report.result_folder import result_json, write_folder
from networks import ring


@pytest.fixture(scope="module")
def analysis():
    return analyse(baarda.adjust(ring(control=5)))


# ---- moments --------------------------------------------------------------------------------------------------------------------------


def model(constant: bool, correlated: bool = False):
    rng = np.random.default_rng(5)
    a = rng.standard_normal((40, 5))
    if constant:
        a[:, 0] = 1.0
    c = np.eye(40)
    if correlated:
        c[np.arange(0, 40, 2), np.arange(1, 40, 2)] = c[np.arange(1, 40, 2), np.arange(0, 40, 2)] = 0.6
    return a, c, linear_model(a, rng.standard_normal(40), c)


def test_mean_by_its_own_cofactor():
    a, _, e = model(constant=False)
    r = np.eye(40) - a @ np.linalg.solve(a.T @ a, a.T)
    t = moments.from_evidence(e, Options(replicas=99))[0]
    assert t.details["cofactor"] == pytest.approx(float(r.sum()), rel=1e-10)
    assert t.statistic == pytest.approx(e.residuals.sum() / (e.sigma0 * np.sqrt(r.sum())))
    assert t.p_value == pytest.approx(2.0 * float(TauLaw(35).sf(abs(t.statistic))))
    assert "exact" in t.note


def test_mean_of_correlated_observations_is_simulated():
    _, _, e = model(constant=False, correlated=True)
    t = moments.from_evidence(e, Options(replicas=199))[0]
    assert "simulated" in t.law_name and "by simulation" in t.note


def test_a_mean_that_is_zero_anyway_is_not_applicable():
    _, _, e = model(constant=True)
    t = moments.from_evidence(e, Options(replicas=99))[0]
    assert t.details["applicable"] is False
    assert "not applicable" in t.law_name and "1'Qvv1 is zero" in t.note
    assert (t.p_value, t.rejected) == (1.0, False)
    assert np.isfinite([t.statistic, *t.critical]).all()


@pytest.mark.parametrize("arguments", [(np.nan, 1.0, 1.0, 5), (1.0, np.inf, 1.0, 5), (1.0, 1.0, 0.0, 5)])
def test_wrong_sums(arguments):
    with pytest.raises(UsageError):
        sum_of_residuals(*arguments)


def test_jarque_bera_against_scipy():
    x = np.random.default_rng(7).standard_normal(150)
    t = jarque_bera(x, replicas=0)
    ours = stats.jarque_bera(x)
    assert (t.statistic, t.p_value) == pytest.approx((ours.statistic, ours.pvalue))
    assert jarque_bera_of_moments(150, stats.skew(x), stats.kurtosis(x) + 3.0).statistic == pytest.approx(t.statistic)
    assert jarque_bera(x).p_value == pytest.approx(t.p_value, abs=0.1)
    assert jarque_bera(5.0 + 3.0 * x).p_value == jarque_bera(x).p_value


def test_jarque_bera_through_an_adjustment():
    a, _, e = model(constant=False)
    r = np.eye(40) - a @ np.linalg.solve(a.T @ a, a.T)
    root = np.sqrt(np.diag(r))
    t = jarque_bera(e.residuals / root, residuals_of=lambda z: -(r @ z) / root[:, None], replicas=199, seed=0)
    own = moments.from_evidence(e, Options(replicas=199))[3]
    assert t.name == own.name == "jarque_bera"
    assert t.statistic == pytest.approx(own.statistic)
    assert t.p_value == pytest.approx(own.p_value)
    with pytest.raises(UsageError, match="keep the shape"):
        jarque_bera(e.residuals, residuals_of=lambda z: z[:3])


@pytest.mark.parametrize("values", [[1.0, 2.0, 3.0], [1.0] * 9, [1.0, np.nan, 2.0, 3.0], [1.0, np.inf, 2.0, 3.0]])
def test_jarque_bera_of_what_tells_nothing(values):
    with pytest.raises(UsageError):
        jarque_bera(values)


# ---- laws -----------------------------------------------------------------------------------------------------------------------------


def test_both_p_values_of_every_law(analysis):
    study = analysis.study
    assert len(study.laws.laws) == 9 and study.laws.adjusted
    for s in study.laws.laws:
        assert [t.name for t in s.tests] == [t.name for t in s.independent] == [*STATISTICS, CHI_SQUARE]
        assert "through the design matrix" in s.tests[0].note and "independent" in s.independent[0].note
        assert s.fit.histogram is not None and 0.0 < s.tests[3].p_value <= 1.0
    assert study.laws.ratio is not None and "design matrix" in study.laws.ratio.note
    described = [r for r in study.scale_rules if r.described]
    assert [r.symbol for r in described] == ["S_o"] and described[0].p_value is None
    assert {r.symbol for r in study.scale_rules} == {"S_M", "S_o", "Q_v", "S_P"}


def test_the_map_gives_tau_of_each_replica(analysis):
    adjustment, rows = analysis.adjustment, analysis.study.rows
    mapped = residuals_of(adjustment, rows, 3)
    e = np.random.default_rng(1).standard_normal((len(rows), 2000))
    tau = mapped(e)
    assert tau.shape == e.shape
    np.testing.assert_array_equal(mapped(e), tau)
    np.testing.assert_allclose(mapped(7.0 * e)[:, :3], tau[:, :3], atol=2.5)  # only the few other observations tell the scale
    assert np.mean(tau**2, axis=1) == pytest.approx(np.ones(len(rows)), abs=0.2)  # E tau^2 = 1 for every observation


def test_critical_values_under_the_law_of_the_errors(analysis):
    found = analysis.study.critical
    o = analysis.options
    assert (found.alpha, found.power, found.family_alpha) == (o.alpha_outlier, o.power, o.alpha)
    assert sum(c.count for c in found.classes) == np.sum(found.members >= 0)
    for c in found.classes:
        assert c.w.normal == pytest.approx(stats.norm.isf(o.alpha_outlier / 2.0))
        assert c.w.error > 0.0


def test_result_json(analysis, tmp_path):
    document = result_json(analysis)
    json.dumps(document, allow_nan=False)
    row = {"law", "rule", "parameters", "statistic", "df", "critical", "p_value", "rejected", "log_likelihood", "aic", "bic"}
    assert all(row <= set(law) for law in document["laws"])
    assert all(set(law["distribution_tests"]) == {*STATISTICS, CHI_SQUARE} == set(law["independent_tests"]) for law in document["laws"])
    assert document["critical_values"]["law"] == "modulated_normal"
    assert document["law_study"]["adjusted"] is True
    assert any(t["name"] == "jarque_bera" for t in document["tests"])
    write_folder(analysis, tmp_path / "r")
    page = (tmp_path / "r" / "report.html").read_text()
    for words in ("Laws compared", "independent", "Classes", "The normal law with the standard deviation by each rule", "Jarque-Bera"):
        assert words in page
    assert ("Critical values under the law of the errors" in page) or ("as normal as can be" in page)


def test_nothing_is_simulated_before_it_is_asked_for(analysis):
    fresh = analyse(analysis.adjustment)
    assert "study" not in vars(fresh)
    assert fresh.laws == tuple(s.fit for s in fresh.study.laws.laws)
