"""General linear hypothesis and tests of parameters: certified F values, constrained adjustments, statsmodels."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from baarda.errors import RedundancyNotPositive, Singular, UsageError
from baarda.hypotheses import _linear_model, orthogonalisation, parameters
from baarda.hypotheses.base import Estimates, Evidence
from baarda.hypotheses.levels import Options, single_level

DATA = Path(os.environ.get("BAARDA_DATA", Path(__file__).parents[2] / "shared" / "data")) / "nist_strd_linear_anova"
linear_model = _linear_model.linear_model


def model(seed: int, n: int = 25, u: int = 6, additional: int = 4) -> tuple[np.ndarray, np.ndarray, Evidence]:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, u)) + 0.8 * rng.standard_normal((n, 1))
    l_ = a @ rng.standard_normal(u) + rng.standard_normal(n)
    return a, l_, linear_model(a, l_, additional=range(u - additional, u))


def numbers(name: str, columns: int) -> np.ndarray:
    if not (DATA / name).exists():
        pytest.skip("no certified statistics at BAARDA_DATA")
    lines = (DATA / name).read_text().splitlines()[60:]
    return np.array([[float(x) for x in line.split()] for line in lines if len(line.split()) == columns])


def test_norris_certified_straight_line() -> None:
    y, x = numbers("Norris.dat", 2).T
    e = linear_model(np.column_stack([np.ones_like(x), x]), y, additional=[0, 1])
    np.testing.assert_allclose(e.additional.values, [-0.262323073774029, 1.00211681802045], rtol=1e-10)
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(e.additional.cofactors)) * e.sigma0, [0.232818234301152, 0.429796848199937e-3], rtol=1e-10
    )
    assert e.sigma0 == pytest.approx(0.884796396144373, rel=1e-10)
    t = parameters.single_parameter(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy)
    assert t.statistic[1] ** 2 == pytest.approx(5436385.54079785, rel=1e-10)
    slope = parameters.general_linear(e.additional.values, e.additional.cofactors, e.variance_factor, 34, [[0.0, 1.0]])
    assert slope.statistic == pytest.approx(5436385.54079785, rel=1e-10)


@pytest.mark.parametrize(
    ("name", "offset", "f", "s0", "digits"),
    [
        ("SiRstv.dat", 0.0, 1.18046237440255, 0.104076068334656, 1e-10),
        ("SmLs01.dat", 0.0, 21.0, 0.1, 1e-10),
        ("SmLs04.dat", 1e6, 21.0, 0.1, 1e-9),
    ],
)
def test_certified_analysis_of_variance(name: str, offset: float, f: float, s0: float, digits: float) -> None:
    treatment, response = numbers(name, 2).T
    k = int(treatment.max())
    e = linear_model((treatment[:, None] == np.arange(1, k + 1)).astype(float), response - offset, additional=range(k))
    contrasts = np.column_stack([np.ones(k - 1), -np.eye(k - 1)])
    t = parameters.general_linear(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy, contrasts)
    assert t.statistic == pytest.approx(f, rel=digits)
    assert e.sigma0 == pytest.approx(s0, rel=digits)
    assert t.df == (k - 1, len(response) - k)


@given(st.integers(0, 10_000))
def test_the_form_is_the_growth_of_vpv_under_the_constraint(seed: int) -> None:
    a, l_, e = model(seed)
    t = parameters.general_linear(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy)
    assert t.statistic * 4 * e.variance_factor == pytest.approx(linear_model(a[:, :2], l_).vpv - e.vpv, rel=1e-7)
    single = parameters.single_parameter(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy)
    for i in range(4):
        without = linear_model(np.delete(a, 2 + i, axis=1), l_)
        assert single.statistic[i] ** 2 * e.variance_factor == pytest.approx(without.vpv - e.vpv, rel=1e-7, abs=1e-9)


def test_statsmodels_f_and_t() -> None:
    a, l_, e = model(3)
    sm = pytest.importorskip("statsmodels.api", reason="the oracle statsmodels is not installed (extra 'oracle')")
    fit = sm.OLS(l_, a).fit()
    b, w = np.array([[0.0, 0, 1, -1, 0, 0], [0, 0, 0, 2, 0, 1.0]]), np.array([0.3, -0.2])
    theirs = fit.f_test((b, w))
    ours = parameters.general_linear(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy, (b[:, 2:], w))
    assert ours.statistic == pytest.approx(float(theirs.fvalue), rel=1e-9)
    assert ours.p_value == pytest.approx(float(theirs.pvalue), rel=1e-9)
    t = parameters.single_parameter(e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy)
    np.testing.assert_allclose(t.p_value, fit.pvalues[2:], rtol=1e-9)


def test_given_values_as_hypothesis() -> None:
    _, _, e = model(4)
    x, q = e.additional.values, e.additional.cofactors
    assert parameters.general_linear(x, q, 1.0, 10, x).statistic == 0.0
    assert parameters.general_linear(x, q, 1.0, 10, x).p_value == 1.0


def test_known_variance_factor_is_the_limit() -> None:
    _, _, e = model(5)
    known = parameters.general_linear(e.additional.values, e.additional.cofactors, 1.0, np.inf)
    many = parameters.general_linear(e.additional.values, e.additional.cofactors, 1.0, 10_000_000)
    assert known.p_value == pytest.approx(many.p_value, rel=1e-4)
    assert known.p_value == pytest.approx(stats.chi2.sf(known.statistic * 4, 4), rel=1e-12)
    assert known.law_name == "chi2(4) / 4"


def test_bivariate_is_gruens_formula_and_the_general_hypothesis() -> None:
    _, _, e = model(6)
    x, q, s2, r = e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy
    t = parameters.bivariate_parameters(x, q, s2, r, limit=0.0, names="abcd")
    assert t.labels == ("a, b", "a, c", "a, d", "b, c", "b, d", "c, d")
    for value, (k, m) in zip(t.statistic, zip(*np.triu_indices(4, 1), strict=True), strict=True):
        top = q[m, m] * x[k] ** 2 - 2 * q[k, m] * x[k] * x[m] + q[k, k] * x[m] ** 2
        assert value == pytest.approx(top / (2 * s2 * (q[k, k] * q[m, m] - q[k, m] ** 2)), rel=1e-9)
        assert value == pytest.approx(parameters.general_linear(x[[k, m]], q[np.ix_([k, m], [k, m])], s2, r).statistic, rel=1e-9)


def test_pairs_above_the_limit_or_the_most_correlated_one() -> None:
    q = np.array([[1.0, 0.97, 0.1], [0.97, 1.0, 0.2], [0.1, 0.2, 1.0]])
    assert parameters.bivariate_parameters([1.0, 1.0, 1.0], q, 1.0, 9, 0.95).labels == ("parameter 1, parameter 2",)
    only = parameters.bivariate_parameters([1.0, 1.0, 1.0], q, 1.0, 9, 0.99)
    assert only.labels == ("parameter 1, parameter 2",)
    assert "most correlated" in only.note


@pytest.mark.parametrize("basis", ["eigen", "triangular"])
def test_orthogonalised_parameters_sum_to_the_joint_test_and_lead_back(basis: str) -> None:
    _, _, e = model(7)
    x, q, s2, r = e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy
    t = orthogonalisation.orthogonalised_parameters(x, q, s2, r, basis=basis)  # type: ignore[arg-type]
    assert (t.statistic**2).sum() / 4 == pytest.approx(parameters.general_linear(x, q, s2, r).statistic, rel=1e-9)
    o = orthogonalisation.orthogonalise(x, q, basis)  # type: ignore[arg-type]
    np.testing.assert_allclose(o.back @ o.values, x, rtol=1e-9)
    np.testing.assert_allclose(o.back @ np.diag(o.cofactors) @ o.back.T, q, rtol=1e-9, atol=1e-12)


@given(st.lists(st.floats(1e-6, 1e6), min_size=4, max_size=4))
def test_eigen_basis_does_not_depend_on_units(units: list[float]) -> None:
    _, _, e = model(8)
    x, q, u = e.additional.values, e.additional.cofactors, np.array(units)
    one = orthogonalisation.orthogonalised_parameters(x, q, 1.0, 9)
    two = orthogonalisation.orthogonalised_parameters(x * u, q * u[:, None] * u, 1.0, 9)
    np.testing.assert_allclose(one.statistic, two.statistic, rtol=1e-6)
    assert one.labels == two.labels


def test_sidak_family_of_parameters() -> None:
    t = parameters.single_parameter(np.ones(12), np.ones(12), 1.0, 30, levels="sidak")
    assert t.alpha == single_level(0.05, 12)
    assert "Šidák for 12 tests" in t.note


def test_wu_critical_values() -> None:
    for r, value in ((43, 4.067), (44, 4.062), (45, 4.057)):
        assert parameters.general_linear([1.0], [[1.0]], 1.0, r).critical == pytest.approx(value, abs=5e-4)


def dependent(c: float) -> Evidence:
    q = np.array([[1.0, c, 0.0], [c, 1.0, 0.0], [0.0, 0.0, 2.0]])
    e = Estimates(("K1", "K2", "P1"), np.array([1.0, 1.0, 0.5]), q)
    return Evidence(residuals=np.zeros(5), sigmas=np.ones(5), vpv=4.0, redundancy=4, additional=e)


def test_perfectly_correlated_pair_is_said_in_words() -> None:
    with pytest.raises(Singular, match="K2 is a linear combination") as caught:
        parameters.general_linear([1.0, 1.0], [[1.0, 1.0], [1.0, 1.0]], 1.0, 4, names=("K1", "K2"))
    assert caught.value.names == ("K1", "K2")
    found = {t.name: t for t in parameters.from_evidence(dependent(1.0), Options())}
    joint = found["all_additional_parameters"]
    assert joint.df == (2.0, 4.0)
    assert "K2" in joint.note
    assert joint.statistic == pytest.approx((1.0 + 0.125) / 2, rel=1e-9)
    assert np.isfinite(found["additional_parameter"].p_value).all()
    pair = found["bivariate_additional_parameters"]
    assert pair.note.startswith("Not applicable: the parameters are perfectly correlated")
    assert pair.labels == ("K1, K2",)
    assert np.isnan(pair.statistic).all()
    assert not pair.rejected.any()
    for t in orthogonalisation.from_evidence(dependent(1.0), Options()):
        assert t.note.startswith("Not applicable: K2 is a linear combination")
        assert t.details["tested"] == 0


def test_perfect_pair_among_others_is_left_out_by_name() -> None:
    q = np.array([[1.0, 1.0, 0.97], [1.0, 1.0, 0.97], [0.97, 0.97, 1.0]])
    t = parameters.bivariate_parameters([1.0, 1.0, 1.0], q, 1.0, 9, 0.95, names=("K1", "K2", "K3"))
    assert t.labels == ("K1, K3", "K2, K3")
    assert t.details["perfectly_correlated"] == ["K1, K2"]


def test_all_insignificant_parameters() -> None:
    e = Evidence(residuals=np.zeros(9), sigmas=np.ones(9), vpv=7.0, redundancy=7, additional=Estimates(("a", "b"), np.zeros(2), np.eye(2)))
    found = [*parameters.from_evidence(e, Options()), *orthogonalisation.from_evidence(e, Options())]
    assert len(found) == 5
    assert not any(np.any(t.rejected) for t in found)


@pytest.mark.parametrize(
    "call",
    [
        lambda: parameters.general_linear([1.0], np.eye(2), 1.0, 4),
        lambda: parameters.general_linear([1.0], [[1.0]], 0.0, 4),
        lambda: parameters.general_linear([1.0], [[1.0]], 1.0, 4, alpha=5.0),
        lambda: parameters.general_linear([1.0], [[1.0]], 1.0, 4, (np.eye(2), [0.0, 0.0])),
        lambda: parameters.general_linear([np.nan], [[1.0]], 1.0, 4),
        lambda: parameters.single_parameter([1.0], [0.0], 1.0, 4, names=["K1"]),
        lambda: parameters.bivariate_parameters([1.0], [[1.0]], 1.0, 4),
        lambda: orthogonalisation.orthogonalise([1.0], [[1.0]], "fourier"),  # type: ignore[arg-type]
    ],
)
def test_wrong_arguments(call: object) -> None:
    with pytest.raises(UsageError):
        call()  # type: ignore[operator]


def test_no_redundancy() -> None:
    with pytest.raises(RedundancyNotPositive):
        parameters.general_linear([1.0], [[1.0]], 1.0, 0)
