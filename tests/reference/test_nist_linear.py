"""NIST's certified straight line and analyses of variance, read from their files; dense models against statsmodels' influence."""

import re

import numpy as np
import pytest

from baarda.hypotheses import parameters
from baarda.hypotheses._linear_model import linear_model
from baarda.hypotheses.outliers import estimated_error, externally_studentised, tau

NUMBER = r"([-+]?\d+\.\d+(?:E[-+]?\d+)?)"


def lines_of(folder, name):
    text = (folder / name).read_text(encoding="ascii").splitlines()
    return text[:60], np.array([[float(t) for t in line.split()] for line in text[60:] if line.strip()])


def certified(header, pattern):
    found = re.search(pattern, "\n".join(header))
    assert found, pattern
    return [float(t) for t in found.groups()]


@pytest.fixture(scope="module")
def folder(data):
    return data("nist_strd_linear_anova")


@pytest.mark.parametrize("name", ["SiRstv.dat", "SmLs01.dat", "SmLs04.dat"])
def test_analysis_of_variance(folder, name):
    header, table = lines_of(folder, name)
    between, _, f = certified(header, rf"Between \w+\s+\d+\s+{NUMBER}\s+{NUMBER}\s+{NUMBER}")
    within, _ = certified(header, rf"Within \w+\s+\d+\s+{NUMBER}\s+{NUMBER}")
    (share,) = certified(header, rf"R-Squared\s+{NUMBER}")
    (deviation,) = certified(header, rf"Residual\s+Standard Deviation\s+{NUMBER}")
    treatment, response = table.T
    k, n = int(treatment.max()), len(response)
    digits = 1e-9 if name == "SmLs04.dat" else 1e-10  # its seven constant leading digits cost one in double precision
    y = response - np.round(response.min())  # exact: whole numbers are taken off
    e = linear_model((treatment[:, None] == np.arange(1, k + 1)).astype(float), y, additional=range(k))
    equal = np.column_stack([np.ones(k - 1), -np.eye(k - 1)])
    test = parameters.general_linear(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy, equal)
    assert e.redundancy == n - k
    assert e.vpv == pytest.approx(within, rel=digits)
    assert e.sigma0 == pytest.approx(deviation, rel=digits)
    assert test.statistic == pytest.approx(f, rel=digits)
    assert test.statistic * (k - 1) * e.variance_factor == pytest.approx(between, rel=digits)
    # the model of one mean: the form of the test is the growth of v'Pv
    mean = linear_model(np.ones((n, 1)), y)
    assert mean.vpv - e.vpv == pytest.approx(between, rel=digits)
    assert 1.0 - e.vpv / mean.vpv == pytest.approx(share, rel=digits)


def test_norris(folder):
    header, table = lines_of(folder, "Norris.dat")
    y, x = table.T
    e = linear_model(np.column_stack([np.ones_like(x), x]), y, additional=[0, 1])
    for k in range(2):
        value, sigma = certified(header, rf"B{k}\s+{NUMBER}\s+{NUMBER}")
        assert e.additional.values[k] == pytest.approx(value, rel=1e-10)
        assert e.sigma0 * np.sqrt(e.additional.cofactors[k, k]) == pytest.approx(sigma, rel=1e-10)
    (deviation,) = certified(header, rf"Residual\s+Standard Deviation\s+{NUMBER}")
    (share,) = certified(header, rf"R-Squared\s+{NUMBER}")
    regression, _, f = certified(header, rf"Regression\s+1\s+{NUMBER}\s+{NUMBER}\s+{NUMBER}")
    rest, _ = certified(header, rf"Residual\s+34\s+{NUMBER}\s+{NUMBER}")
    assert e.sigma0 == pytest.approx(deviation, rel=1e-10)
    assert e.vpv == pytest.approx(rest, rel=1e-10)
    slope = parameters.general_linear(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy, [[0.0, 1.0]])
    assert slope.statistic == pytest.approx(f, rel=1e-10)
    mean = linear_model(np.ones((36, 1)), y)
    assert mean.vpv - e.vpv == pytest.approx(regression, rel=1e-10)
    assert 1.0 - e.vpv / mean.vpv == pytest.approx(share, rel=1e-10)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("weighted", [False, True])
def test_dense_models_against_statsmodels(seed, weighted):
    sm = pytest.importorskip("statsmodels.api", reason="the oracle statsmodels is not installed (extra 'oracle')")
    rng = np.random.default_rng(100 + seed)
    n, u = int(rng.integers(12, 60)), int(rng.integers(2, 8))
    a = rng.normal(size=(n, u)) * 10.0 ** rng.uniform(-4, 4, u) + rng.normal(size=(n, 1))
    variance = 10.0 ** rng.uniform(-2, 2, n) if weighted else np.ones(n)
    y = a @ rng.normal(size=u) + np.sqrt(variance) * rng.standard_t(4, size=n)
    e = linear_model(a, y, variance, additional=range(u))
    fit = sm.WLS(y, a, weights=1.0 / variance).fit() if weighted else sm.OLS(y, a).fit()
    influence = sm.OLS(fit.model.wendog, fit.model.wexog).fit().get_influence()  # WLS itself offers none
    own = tau(e.residuals, e.qvv, e.variance_factor)
    np.testing.assert_allclose(e.additional.values, fit.params, rtol=1e-8)
    np.testing.assert_allclose(e.sigma0 * np.sqrt(np.diag(e.additional.cofactors)), fit.bse, rtol=1e-8)
    assert e.vpv == pytest.approx(fit.ssr, rel=1e-9)
    np.testing.assert_allclose(1.0 - e.redundancy_numbers, influence.hat_matrix_diag, atol=1e-10)
    np.testing.assert_allclose(-own, influence.resid_studentized_internal, rtol=1e-7)
    np.testing.assert_allclose(-externally_studentised(own, e.redundancy), influence.resid_studentized_external, rtol=1e-7)
    # Cook's distance is the squared effect of the estimated error on the unknowns, in units of u s0^2
    r = e.redundancy_numbers
    effect = estimated_error(e.residuals, r) ** 2 / variance * (1.0 - r)
    np.testing.assert_allclose(effect / (u * e.variance_factor), influence.cooks_distance[0], rtol=1e-7)
    single = parameters.single_parameter(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy)
    np.testing.assert_allclose(single.statistic, fit.tvalues, rtol=1e-7)
    np.testing.assert_allclose(single.p_value, fit.pvalues, rtol=1e-6, atol=1e-300)
