"""The study over many replicas: the a of the errors is recovered through Qvv, and the S_o rule rejects truly normal errors."""

import numpy as np
import pytest

from baarda.distributions import law
from baarda.papers.maarek_konecny_study import a_of_kurtosis, scale_rule, study

pytestmark = pytest.mark.sampling


@pytest.fixture(scope="module")
def made():
    return study()


def truth(a, number=1000):
    """Return the excess kurtosis of sums of `number` elementary errors, exactly."""
    m1, m2 = ((a + 1) / (a + 2), (a + 1) / (a + 3)) if np.isfinite(a) else (1.0, 1.0)
    return (3 * (number - 1) * m2 + m1) / (number * m1**2) - 3.0


@pytest.mark.parametrize("a", [0.0, 0.5, 1.0, 3.0, np.inf])
def test_a_of_the_errors_is_recovered(made, a):
    replicas, excess = 8000, truth(a)
    power, cumulant = (np.concatenate(x) for x in zip(*(made.kurtosis_of_errors(made.replicas(2000, a, s)) for s in range(4)), strict=True))
    for sample, expected in ((power, made.sigma**4), (cumulant, excess * made.sigma**4), (cumulant - excess * power, 0.0)):
        assert abs(sample.mean() - expected) <= 4.0 * sample.std(ddof=1) / np.sqrt(replicas)
    if np.isfinite(a):
        spread = float((cumulant - excess * power).std(ddof=1) / power.mean() / np.sqrt(replicas))
        low, high = (a_of_kurtosis(excess + sign * 4.0 * spread) for sign in (1, -1))
        assert low <= a_of_kurtosis(cumulant.mean() / power.mean()) <= high
        assert low - 0.05 <= a <= high + 0.05  # the limits are narrow enough to tell a


def test_a_of_the_residuals_is_another(made):
    """The kurtosis of standardised residuals shows the diluted a, not that of the errors."""
    v = made.replicas(4000, 0.5, 11) / (made.sigma * np.sqrt(made.shares)[:, None])
    fourth = np.mean(v**4, axis=0) - 3.0
    expected = truth(0.5) * made.dilution()
    spread = fourth.std(ddof=1) / np.sqrt(4000)
    assert abs(fourth.mean() - expected) <= 4.0 * spread
    assert truth(0.5) - fourth.mean() > 10.0 * spread
    assert a_of_kurtosis(fourth.mean()) == pytest.approx(0.95, abs=0.06)


def test_s_o_rejects_truly_normal_errors(made):
    """About 57 % with open ends; a modulated law instead of the normal in about 30 % with closed ends."""
    opened, closed = scale_rule(made, 6000, "open", seed=2), scale_rule(made, 6000, "closed", seed=2)
    assert opened.rejected["normal S_o"] == pytest.approx(0.57, abs=0.03)
    assert closed.modulated_instead == pytest.approx(0.30, abs=0.04)
    # moments of class mids, as in the paper's Table 1, widen S_o further
    grouped = scale_rule(made, 6000, "closed", grouped=True, seed=2)
    assert grouped.rejected["normal S_o"] > closed.rejected["normal S_o"] + 0.05
    assert grouped.modulated_instead == pytest.approx(0.30, abs=0.05)


def test_q_v_does_not(made):
    """Standardised residuals keep near the level: parameters fitted to single values only bring it down to it."""
    found = scale_rule(made, 6000, "open", seed=3).rejected
    spread = np.sqrt(0.05 * 0.95 / 6000)
    assert abs(found["normal Q_v"] - 0.05) <= 4.0 * spread
    assert found["normal S_M"] < 0.09


def test_modulated_errors_are_seen_through_q_v(made):
    """With a = 1/2 the rules that keep their level for normal errors reject the normal law far more often."""
    normal = scale_rule(made, 2000, "open", seed=4).rejected
    modulated = scale_rule(made, 2000, "open", a=0.5, seed=4).rejected
    assert modulated["normal Q_v"] > 2.5 * normal["normal Q_v"]
    assert law("radico")().excess_kurtosis() == pytest.approx(truth(0.5), abs=0.01)
