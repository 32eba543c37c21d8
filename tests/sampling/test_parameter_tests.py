"""Tests of parameters by simulation: size at 10, 5 and 1 %, and power against the noncentral laws."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from baarda.hypotheses import orthogonalisation, parameter_groups, parameters
from baarda.hypotheses._linear_model import linear_model
from baarda.hypotheses.deformation import pooled_variance_factor
from baarda.hypotheses.levels import power_of_test

pytestmark = pytest.mark.sampling

LEVELS = (0.10, 0.05, 0.01)
REPLICAS = 4000
GROUPS, NAMES = ("1", "1", "1", "2", "2", "2"), ("K1", "K2", "P1") * 2
TRUTH = np.array([0.35, -0.2, 0.15, 0.1, 0.3, -0.25])
GIVEN = np.array([0.1, 0.0, -0.1, 0.2, 0.0, 0.1])
DIFFERENCES = np.column_stack([np.eye(3), -np.eye(3)])


class Model:
    """A linear model with 4 nuisance unknowns and the parameters of two cameras, the second of each highly correlated with the first."""

    def __init__(self, seed: int, n: int = 40) -> None:
        rng = np.random.default_rng(seed)
        self.design = rng.standard_normal((n, 10))
        self.design[:, 5] += 4.0 * self.design[:, 4]
        self.design[:, 8] += 3.0 * self.design[:, 7]
        e = linear_model(self.design, np.zeros(n), additional=range(4, 10))
        self.q = e.additional.cofactors
        self.r = e.redundancy
        self.solve = np.linalg.pinv(self.design)

    def draw(self, count: int, seed: int, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return estimates (count, 6) and variance factors (count,) of simulated observations of unit variance."""
        e = np.random.default_rng(seed).standard_normal((count, len(self.design)))
        observed = e + self.design[:, 4:] @ truth
        x = observed @ self.solve.T
        v = observed - x @ self.design.T
        return x[:, 4:], np.einsum("ij,ij->i", v, v) / self.r


ONE, TWO = Model(1), Model(2, 35)
POOLED = ONE.r + TWO.r

# name -> p-values of one data set (x, s0^2) under a hypothesis about the shift d = truth - expected, and the noncentralities (lambda, b)
Test = Callable[[np.ndarray, float], np.ndarray]


def noncentral(b: np.ndarray, d: np.ndarray) -> tuple[float, int]:
    m = b @ ONE.q @ b.T
    return float((b @ d) @ np.linalg.solve(m, b @ d)), len(b)


EYE = np.eye(6)
PAIRS = [(k, m) for k in range(6) for m in range(k + 1, 6)]
ORTHOGONAL = {basis: orthogonalisation.orthogonalise(np.zeros(6), ONE.q, basis) for basis in ("eigen", "triangular")}
BACKS = {basis: np.linalg.inv(o.back) for basis, o in ORTHOGONAL.items()}
TESTS: dict[str, tuple[Test, list[np.ndarray]]] = {
    "all": (lambda x, s2: parameters.general_linear(x, ONE.q, s2, ONE.r).p_value, [EYE]),
    "single": (lambda x, s2: parameters.single_parameter(x, ONE.q, s2, ONE.r).p_value, [EYE[[k]] for k in range(6)]),
    "pairs": (lambda x, s2: parameters.bivariate_parameters(x, ONE.q, s2, ONE.r, 0.0).p_value, [EYE[[k, m]] for k, m in PAIRS]),
    "groups": (
        lambda x, s2: parameter_groups.grouped_parameters(x, ONE.q, s2, ONE.r, ["a", "a", "b", "b", "b", "c"]).p_value,
        [EYE[:2], EYE[2:5], EYE[5:]],
    ),
    "equality of two cameras": (
        lambda x, s2: parameter_groups.equal_parameters(x[:3], ONE.q[:3, :3], x[3:], ONE.q[3:, 3:], s2, ONE.r, ONE.q[:3, 3:]).p_value,
        [DIFFERENCES],
    ),
    "equality by parameter": (
        lambda x, s2: parameter_groups.equal_groups(x, ONE.q, s2, ONE.r, GROUPS, NAMES, "parameter").p_value,
        [DIFFERENCES[[k]] for k in range(3)],
    ),
    "equality of all cameras": (
        lambda x, s2: parameter_groups.equal_groups(x, ONE.q, s2, ONE.r, GROUPS, NAMES, "all").p_value,
        [DIFFERENCES],
    ),
    "eigen": (
        lambda x, s2: orthogonalisation.orthogonalised_parameters(x, ONE.q, s2, ONE.r).p_value,
        [BACKS["eigen"][[k]] for k in range(6)],
    ),
    "triangular": (
        lambda x, s2: orthogonalisation.orthogonalised_parameters(x, ONE.q, s2, ONE.r, basis="triangular").p_value,
        [BACKS["triangular"][[k]] for k in range(6)],
    ),
}


def deviations(p: np.ndarray, level: float, expected: np.ndarray) -> np.ndarray:
    """Return the deviation of each column's rate from its expectation in standard errors."""
    rate = (p <= level).mean(axis=0)
    return (rate - expected) / np.sqrt(expected * (1.0 - expected) / len(p))


@pytest.mark.parametrize("name", TESTS)
def test_size(name: str) -> None:
    test, _ = TESTS[name]
    x, s2 = ONE.draw(REPLICAS, 10, np.zeros(6))
    p = np.array([np.atleast_1d(test(a, float(b))) for a, b in zip(x, s2, strict=True)])
    for level in LEVELS:
        z = deviations(p, level, np.full(p.shape[1], level))
        assert np.abs(z).max() <= 4.0, (level, z)


@pytest.mark.parametrize("name", TESTS)
def test_power(name: str) -> None:
    test, hypotheses = TESTS[name]
    x, s2 = ONE.draw(REPLICAS, 11, TRUTH)
    p = np.array([np.atleast_1d(test(a, float(b))) for a, b in zip(x, s2, strict=True)])
    assert p.shape[1] == len(hypotheses)
    for level in LEVELS:
        expected = np.array([power_of_test(lam, level, b, ONE.r) for lam, b in (noncentral(h, TRUTH) for h in hypotheses)])
        assert expected.max() > 2.0 * level  # the alternative can be seen
        z = deviations(p, level, expected)
        assert np.abs(z).max() <= 4.0, (level, z)


@pytest.mark.parametrize("truth", [GIVEN, TRUTH], ids=["size", "power"])
def test_given_values(truth: np.ndarray) -> None:
    x, s2 = ONE.draw(REPLICAS, 12, truth)
    p = np.array([parameters.general_linear(a, ONE.q, float(b), ONE.r, GIVEN).p_value for a, b in zip(x, s2, strict=True)])
    t = np.array([parameters.single_parameter(a, ONE.q, float(b), ONE.r, GIVEN).p_value for a, b in zip(x, s2, strict=True)])
    d = truth - GIVEN
    for level in LEVELS:
        lam, b = noncentral(EYE, d)
        assert abs(deviations(p[:, None], level, np.array([power_of_test(lam, level, b, ONE.r)]))[0]) <= 4.0
        single = np.array([power_of_test(noncentral(EYE[[k]], d)[0], level, 1, ONE.r) for k in range(6)])
        assert np.abs(deviations(t, level, single)).max() <= 4.0


@pytest.mark.parametrize("shift", [0.0, 1.0], ids=["size", "power"])
def test_equality_of_two_epochs(shift: float) -> None:
    d = shift * np.array([0.0, 0.0, 0.3, 0.0, 0.0, -0.2])
    x, sx = ONE.draw(REPLICAS, 13, TRUTH + d)
    y, sy = TWO.draw(REPLICAS, 14, TRUTH)
    p = []
    for a, b, s, t in zip(x, y, sx, sy, strict=True):
        s2, r = pooled_variance_factor(float(s), ONE.r, float(t), TWO.r)
        p.append(parameter_groups.equal_parameters(a, ONE.q, b, TWO.q, s2, r).p_value)
    lam = float(d @ np.linalg.solve(ONE.q + TWO.q, d))
    for level in LEVELS:
        expected = np.array([power_of_test(lam, level, 6, POOLED)])
        assert abs(deviations(np.array(p)[:, None], level, expected)[0]) <= 4.0


def test_known_variance_factor() -> None:
    x, _ = ONE.draw(REPLICAS, 15, TRUTH)
    p = np.array([parameters.general_linear(a, ONE.q, 1.0, np.inf).p_value for a in x])
    t = np.array([parameters.single_parameter(a, ONE.q, 1.0, np.inf).p_value for a in x])
    for level in LEVELS:
        lam, b = noncentral(EYE, TRUTH)
        assert abs(deviations(p[:, None], level, np.array([stats.ncx2.sf(stats.chi2.isf(level, b), b, lam)]))[0]) <= 4.0
        single = np.array([power_of_test(noncentral(EYE[[k]], TRUTH)[0], level, 1) for k in range(6)])
        assert np.abs(deviations(t, level, single)).max() <= 4.0
