"""w, tau, minimal detectable biases, image points, separability: against printed numbers and independent adjustments."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses import _linear_model, image_points, outliers, separability
from baarda.hypotheses.base import Evidence
from baarda.hypotheses.levels import Options

DATA = Path(os.environ.get("BAARDA_DATA", Path(__file__).parents[2] / "shared" / "data"))
linear_model = _linear_model.linear_model


def random_model(seed: int, n: int = 20, u: int = 5, correlated: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    c = np.diag(rng.uniform(0.3, 3.0, n))
    if correlated:
        root = np.eye(n) + 0.3 * rng.standard_normal((n, n)) / np.sqrt(n)
        c = root @ c @ root.T
    a = rng.standard_normal((n, u))
    return a, a @ rng.standard_normal(u) + np.linalg.cholesky(c) @ rng.standard_normal(n), c


def test_delta0() -> None:
    assert outliers.delta0(0.001, 0.80) == pytest.approx(4.132, abs=5e-4)


def test_pope_critical_value() -> None:
    assert outliers.critical_tau(39, 0.001) == pytest.approx(3.127, abs=5e-4)


def test_gruen_table_3_minimal_detectable_errors() -> None:
    # delta0 sigma0 = 20.68 um in Grün's table; cofactors of five legible cells (theory of the network, all P = I)
    factor = 20.68 / outliers.delta0()
    ours = outliers.mdb(1.0, [0.5335, 0.5776, 0.4182, 0.6584, 0.1822, 0.0], factor)
    np.testing.assert_allclose(ours[:5], [28.3, 27.2, 32.0, 25.5, 48.4], atol=0.06)
    assert np.isnan(ours[5])


@given(st.integers(2, 300), st.floats(-0.999, 0.999))
def test_tau_law_is_that_of_the_t_statistic(r: int, share: float) -> None:
    x = share * np.sqrt(r)
    law = outliers.TauLaw(r)
    t = x * np.sqrt((r - 1) / (r - x * x))
    assert law.sf(x) == pytest.approx(stats.t.sf(t, r - 1), rel=1e-7, abs=1e-300)
    assert law.cdf(x) + law.sf(x) == pytest.approx(1.0, abs=1e-12)
    assert outliers.externally_studentised([x], r)[0] == pytest.approx(t, rel=1e-9)


def test_tau_law_at_its_bound_and_with_one_degree_of_freedom() -> None:
    law = outliers.TauLaw(9)
    assert law.sf(3.0) == 0.0
    assert law.sf(3.1) == 0.0
    assert law.sf(-3.1) == 1.0
    one = outliers.data_snooping([1.0, -1.0], redundancy=1)
    np.testing.assert_array_equal(one.p_value, [1.0, 1.0])
    assert not one.rejected.any()


def test_statsmodels_influence() -> None:
    a, l_, _ = random_model(1)
    e = linear_model(a, l_)
    sm = pytest.importorskip("statsmodels.api", reason="the oracle statsmodels is not installed (extra 'oracle')")
    influence = sm.OLS(l_, a).fit().get_influence()
    tau = outliers.tau(e.residuals, e.qvv, e.variance_factor)
    np.testing.assert_allclose(-tau, influence.resid_studentized_internal, rtol=1e-9)
    np.testing.assert_allclose(-outliers.externally_studentised(tau, e.redundancy), influence.resid_studentized_external, rtol=1e-9)
    np.testing.assert_allclose(1.0 - e.redundancy_numbers, influence.hat_matrix_diag, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("correlated", [False, True])
def test_w_is_the_estimate_of_a_shift_over_its_sigma(correlated: bool) -> None:
    a, l_, c = random_model(2, correlated=correlated)
    e = linear_model(a, l_, c)
    w = outliers.standardised(e.pv, e.pqvvp, 1.0)
    sizes = outliers.mdb(e.redundancy_numbers / e.pqvvp, e.redundancy_numbers, 1.0)
    for i in range(len(l_)):
        shifted = linear_model(np.column_stack([a, np.eye(len(l_))[i]]), l_, c, additional=[a.shape[1]])
        shift, q = shifted.additional.values[0], shifted.additional.cofactors[0, 0]
        assert -w[i] == pytest.approx(shift / np.sqrt(q), rel=1e-8)
        assert w[i] ** 2 == pytest.approx(e.vpv - shifted.vpv, rel=1e-8)
        assert sizes[i] == pytest.approx(outliers.delta0() * np.sqrt(q), rel=1e-8)
        if not correlated:
            assert outliers.estimated_error(e.residuals, e.redundancy_numbers)[i] == pytest.approx(shift, rel=1e-8)


def test_external_reliability_is_the_effect_on_the_unknowns() -> None:
    a, l_, c = random_model(3)
    e = linear_model(a, l_, c)
    bias = outliers.mdb(np.diagonal(c), e.redundancy_numbers)
    normal = a.T @ np.linalg.solve(c, a)
    for i, external in enumerate(outliers.external_reliability(e.redundancy_numbers)):
        effect = np.linalg.solve(normal, a.T @ np.linalg.solve(c, np.eye(len(l_))[i] * bias[i]))
        assert external == pytest.approx(np.sqrt(effect @ normal @ effect), rel=1e-8)


@pytest.mark.parametrize("aposteriori", [False, True])
def test_image_point_is_a_shift_in_two_directions(aposteriori: bool) -> None:
    a, l_, c = random_model(4, correlated=True)
    e = linear_model(a, l_, c)
    p = np.linalg.inv(c)
    qvv = c - a @ np.linalg.solve(a.T @ p @ a, a.T)
    m = (p @ qvv @ p)[:2, :2]
    shifted = linear_model(np.column_stack([a, np.eye(len(l_))[:, :2]]), l_, c)
    if aposteriori:
        t = image_points(e.pv[:2], m[None], e.sigma0, e.redundancy)
        r = e.redundancy
        f = (e.vpv - shifted.vpv) / 2 / (shifted.vpv / (r - 2))
        assert t.p_value[0] == pytest.approx(stats.f.sf(f, 2, r - 2), rel=1e-8)
    else:
        t = image_points(e.pv[:2], m[None], 1.0)
        assert t.statistic[0] == pytest.approx(e.vpv - shifted.vpv, rel=1e-8)


def test_image_point_with_a_dead_direction_is_not_tested() -> None:
    t = image_points([[1.0, 0.0], [1.0, 2.0]], [np.diag([0.5, 0.0]), np.diag([0.5, 0.5])])
    assert np.isnan(t.p_value[0])
    assert t.details["uncontrolled"] == 1
    assert "cannot be tested" in t.note


def test_uncontrolled_observation() -> None:
    # The last observation alone determines the second unknown.
    a = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    e = linear_model(a, [1.0, 2.0, 2.5, 7.0], images=[0, 0, 0, 0])
    (result,) = outliers.from_evidence(e, Options())
    assert np.isnan(result.statistic[3])
    assert np.isfinite(result.statistic[:3]).all()
    assert not result.rejected[3]
    assert result.details["tested"] == 3
    assert np.isnan(outliers.mdb(1.0, e.redundancy_numbers)[3])
    assert np.isnan(outliers.estimated_error(e.residuals, e.redundancy_numbers)[3])
    assert np.isnan(outliers.external_reliability(e.redundancy_numbers)[3])


def test_labels_name_what_is_known() -> None:
    e = linear_model(np.ones((3, 1)), [1.0, 2.0, 4.0], images=[0, 1, -1])
    assert outliers.from_evidence(e, Options())[0].labels == ("image 0 observation 1", "image 1 observation 2", "observation 3")
    known = {
        "points": np.array([0, 1, 1]),
        "point_names": ("7", "9"),
        "components": np.array([0, 1, 2]),
        "component_names": ("x", "y", "Z"),
    }
    full = Evidence(**{**vars(e), **known, "groups": np.array([0, 0, 1]), "group_names": ("image_points", "control")})
    assert outliers.from_evidence(full, Options())[0].labels == ("image 0 point 7 x", "image 1 point 9 y", "control point 9 Z")


def test_apriori_and_aposteriori_differ_by_s0() -> None:
    a, l_, c = random_model(5)
    e = linear_model(a, l_, c, sigma0=2.0)
    (w,) = outliers.from_evidence(e, Options(sigma="apriori"))
    (t,) = outliers.from_evidence(e, Options())
    np.testing.assert_allclose(w.statistic * 2.0, t.statistic * e.sigma0)
    assert w.law_name == "N(0, 1)"
    assert t.law_name == "tau(15)"


def test_another_law_of_the_errors() -> None:
    t = outliers.data_snooping([3.3, 0.1], law=stats.t(4), alpha=0.001)
    assert not t.rejected.any()
    assert outliers.data_snooping([3.3, 0.1], alpha=0.001).rejected.tolist() == [True, False]


@pytest.mark.parametrize("rho", [-0.7, 0.0, 0.5, 0.95])
def test_wrong_choice_by_integration(rho: float) -> None:
    delta = 3.0
    x = np.linspace(delta - 9, delta + 9, 20001)
    conditional = stats.norm(rho * x, np.sqrt(1 - rho * rho))
    p = np.trapezoid(stats.norm.pdf(x - delta) * (conditional.sf(np.abs(x)) + conditional.cdf(-np.abs(x))), x)
    assert separability.wrong_choice(rho, delta) == pytest.approx(p, abs=1e-7)
    assert separability.wrong_choice(rho, separability.separable_delta(rho, 0.1)) == pytest.approx(0.1, abs=1e-9)


def test_not_separable() -> None:
    assert separability.separable_delta(1.0) == np.inf
    assert separability.wrong_choice(1.0, 4.0) == pytest.approx(0.5)


@pytest.mark.parametrize(
    "call",
    [
        lambda: outliers.standardised([1.0], [1.0, 2.0]),
        lambda: outliers.standardised([1.0], [1.0], 0.0),
        lambda: outliers.external_reliability([1.2]),
        lambda: image_points([[1.0, 2.0]], [[1.0]]),
        lambda: outliers.externally_studentised([4.0], 9),
        lambda: outliers.data_snooping([1.0], alpha=5.0),
        lambda: outliers.data_snooping([1.0], labels=["a", "b"]),
        lambda: separability.separable_delta(0.5, 0.6),
        lambda: separability.wrong_choice(1.5, 3.0),
    ],
)
def test_wrong_arguments(call: object) -> None:
    with pytest.raises(UsageError):
        call()  # type: ignore[operator]


def test_mikhail_levelling_net() -> None:
    """Mikhail (1976), example 7.4: heights, redundancy numbers and tau."""
    file = DATA / "gama_networks" / "mikhail-7.4.gkf"
    if not file.exists():
        pytest.skip("no geodetic networks at BAARDA_DATA")
    found = re.findall(r'<dh from="(\w)" to="(\w)" val="\s*([-\d.]+)" dist="\s*([\d.]+)"', file.read_text())
    a = np.zeros((len(found), 4))
    l_, variance = np.empty(len(found)), np.empty(len(found))
    for i, (start, end, value, distance) in enumerate(found):
        for name, sign in ((start, -1.0), (end, 1.0)):
            if name != "A":
                a[i, "BCDE".index(name)] = sign
        l_[i] = float(value) - 800.0 * ((end == "A") - (start == "A"))
        variance[i] = float(distance)
    e = linear_model(a, l_, variance, additional=range(4))
    np.testing.assert_allclose(e.additional.values, [825.22062433, 835.53543022, 809.53392822, 830.84602870], atol=6e-9)
    assert e.vpv == pytest.approx(0.01617137, abs=5e-9)
    np.testing.assert_allclose(np.sqrt(np.diagonal(e.additional.cofactors)) * e.sigma0, [0.18051, 0.16146, 0.20096, 0.17107], atol=5e-6)
    np.testing.assert_allclose(e.redundancy_numbers, [0.5547, 0.4037, 0.5459, 0.5487, 0.4715, 0.4538, 0.4754, 0.5462], atol=5e-5)
    (t,) = outliers.from_evidence(e, Options())
    np.testing.assert_allclose(t.statistic, [-0.9896, -0.2034, -1.8947, -0.7424, -0.0492, -0.9690, 1.0682, 0.6171], atol=5e-5)
