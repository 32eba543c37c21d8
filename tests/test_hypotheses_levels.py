"""Levels of families, Baarda's coupled levels, noncentralities."""

from __future__ import annotations

import importlib
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from baarda import hypotheses
from baarda.errors import UsageError
from baarda.hypotheses.levels import Options, applied_level, baarda_level, noncentrality, power_of_test, single_level

P_VALUES = st.lists(st.floats(1e-6, 0.999), min_size=1, max_size=30, unique=True)


def test_gruen_level_of_twelve_parameters() -> None:
    assert single_level(0.05, 12) == pytest.approx(0.00427, abs=5e-6)


def test_lambda0_and_delta0_of_the_default_levels() -> None:
    assert noncentrality(0.001, 0.80) == pytest.approx(17.075, abs=5e-4)
    assert noncentrality(0.001, 0.80, 1.0000001) == pytest.approx(noncentrality(0.001, 0.80), rel=1e-5)


@pytest.mark.parametrize(("df", "alpha", "ratio"), [(39, 0.213, 1.172), (87, 0.369, 1.044), (135, 0.450, 1.011)])
def test_baarda_coupled_global_level(df: int, alpha: float, ratio: float) -> None:
    level = baarda_level(df)
    assert level == pytest.approx(alpha, abs=5e-4)
    assert stats.chi2.isf(level, df) / df == pytest.approx(ratio, abs=5e-4)
    assert power_of_test(noncentrality(0.001, 0.8), level, df) == pytest.approx(0.8, abs=1e-9)


@pytest.mark.parametrize("df", [1, 2, 7, 60])
@pytest.mark.parametrize(("alpha", "power"), [(0.001, 0.8), (0.05, 0.9), (0.01, 0.5)])
def test_noncentrality_reaches_the_power(df: int, alpha: float, power: float) -> None:
    lam = noncentrality(alpha, power, df)
    assert stats.ncx2.sf(stats.chi2.isf(alpha, df), df, lam) == pytest.approx(power, abs=1e-8)


def test_power_without_shift_is_the_level() -> None:
    assert power_of_test(0.0, 0.05, 3) == pytest.approx(0.05)
    assert power_of_test(0.0, 0.05, 3, 20) == pytest.approx(0.05)


@given(P_VALUES, st.sampled_from([("sidak", "sidak"), ("bonferroni", "bonferroni"), ("holm", "holm"), ("fdr", "fdr_bh")]))
def test_decisions_are_those_of_statsmodels(p: list[float], policy: tuple[str, str]) -> None:
    level = applied_level(p, 0.05, policy[0])  # type: ignore[arg-type]
    assume((np.abs(np.array(p) / level - 1.0) > 1e-9).all())
    ours = np.array(p) < level
    multitest = pytest.importorskip("statsmodels.stats.multitest", reason="the oracle statsmodels is not installed (extra 'oracle')")
    theirs, *_ = multitest.multipletests(p, 0.05, method=policy[1])
    assert (ours == theirs).all()


@given(P_VALUES)
def test_holm_never_rejects_less_than_bonferroni(p: list[float]) -> None:
    assert applied_level(p, 0.05, "holm") >= applied_level(p, 0.05, "bonferroni") >= single_level(0.05, len(p), "bonferroni")


def test_untestable_members_do_not_count() -> None:
    assert applied_level([0.01, np.nan, 0.5], 0.05, "bonferroni") == 0.025
    assert applied_level([np.nan], 0.05, "holm") == 0.05


@pytest.mark.parametrize(
    "wrong",
    [
        {"alpha": 5.0},
        {"alpha_outlier": 0.0},
        {"power": 1.0},
        {"power": 0.0005},
        {"sigma": "both"},
        {"levels": "best"},
        {"replicas": 0},
        {"correlation_limit": 1.0},
    ],
)
def test_options_that_make_no_sense(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        Options(**wrong)  # type: ignore[arg-type]


def test_functions_win_over_files_of_the_same_name() -> None:
    for name in ("check_points", "control_points", "deformation", "image_points"):
        importlib.import_module(f"baarda.hypotheses.{name}")
    for name in ("check_points", "control_points", "deformation", "image_points", "bartlett", "general_linear", "linear_model", "tau"):
        assert callable(getattr(hypotheses, name)), name
    assert hypotheses.levels.Options is hypotheses.Options is Options
    assert "bartlett" in dir(hypotheses)
    with pytest.raises(AttributeError):
        _ = hypotheses.no_such_test


def test_importing_the_package_is_cheap() -> None:
    code = "import sys, baarda.hypotheses; sys.exit(any(m in sys.modules for m in ('numpy', 'scipy')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
