"""Wu's criteria as limits of F, against what deletions do to simulated models, and what is said to be missing."""

import numpy as np
import pytest

from baarda import papers
from baarda.papers.wu import deletion_rate
from baarda.procedures.criteria import Fitted, criteria


@pytest.fixture(scope="module")
def made():
    return papers.paper("wu").run()


def test_counts_and_limits(made):
    table = made.comparison("counts")
    assert all(r.agrees for r in table.rows)
    for r, limit in ((43, 4.067), (44, 4.062), (45, 4.057)):
        assert table.value(f"limit of F(1, {r}) at 5 %") == pytest.approx(limit, abs=6e-4)
    assert table.value("lower limit of r s0^2 / sigma0^2 at 5 %, r = 43") == pytest.approx(26.79, abs=6e-3)
    assert table.value("upper limit of r s0^2 / sigma0^2 at 5 %, r = 43") == pytest.approx(62.99, abs=6e-3)


@pytest.mark.parametrize(
    ("criterion", "limit", "rate"),
    [
        ("F test (8) at 5 %", 4.067, 0.950),
        ("s0^2 (9a)", 1.0, 0.677),
        ("(9b) read as V(s0^2) = 2 s0^4 / r", 1.51, 0.774),
        ("AIC (9c)", 1.46, 0.766),
    ],
)
def test_deletion_rates(made, criterion, limit, rate):
    table = made.comparison("criteria")
    assert table.value(criterion, "falls on deletion if F is below") == pytest.approx(limit, abs=6e-3)
    assert table.value(criterion, "a true zero is deleted in") == pytest.approx(rate, abs=6e-4)


def test_rates_are_those_of_refitted_models(made):
    """Models of 17 parameters and 60 observations, one parameter truly zero, each fitted with and without it."""
    rng = np.random.default_rng(2000)
    n, u, replicas = 60, 17, 4000
    a = rng.normal(size=(n, u))
    e = rng.normal(size=(n, replicas))
    omega = [((e - q @ (q.T @ e)) ** 2).sum(axis=0) for q in (np.linalg.qr(a)[0], np.linalg.qr(a[:, :-1])[0])]
    fell = dict.fromkeys(("variance_factor", "criterion_b", "aic"), 0)
    for full, less in zip(*omega, strict=True):
        before, after = criteria(Fitted(full, n, n - u)), criteria(Fitted(less, n, n - u + 1))
        for name in fell:
            fell[name] += after[name] < before[name]
    table = made.comparison("criteria")
    for name, spoken in (("variance_factor", "s0^2 (9a)"), ("criterion_b", "(9b) read as V(s0^2) = 2 s0^4 / r"), ("aic", "AIC (9c)")):
        p = table.value(spoken, "a true zero is deleted in")
        assert abs(fell[name] / replicas - p) < 4.0 * np.sqrt(p * (1 - p) / replicas)
    f = (omega[1] - omega[0]) / (omega[0] / (n - u))
    p = deletion_rate(table.value("F test (8) at 5 %", "falls on deletion if F is below"), n - u)
    limit = table.value("F test (8) at 5 %", "falls on deletion if F is below")
    assert abs((f <= limit).mean() - p) < 4.0 * np.sqrt(p * (1 - p) / replicas)


def test_the_experiment_is_simulated_and_says_so(made):
    """As in the paper: 17 unknowns, three stages, two altitude terms go; check errors are those that such noise must give."""
    table = made.comparison("experiment")
    assert table.value("observations n") == 60
    assert table.value("unknowns in the end") == 15
    assert table.value("stage at which all three criteria are least") == "3"
    for axis, printed in (("X", 5.3), ("Y", 4.2)):
        r = table.row(f"check points, root mean square {axis} (m)")
        assert 0.6 * printed < r.ours < 1.7 * printed
        assert r.agrees or r.reason.code == "simulated"
        assert "95 % interval" in r.remark
    stages = made.comparison("stages")
    assert all(r.printed is None for r in stages.rows)
    assert {r.labels[0] for r in stages.rows} >= {"1: full model", "2: Z4 deleted", "3: Z3 deleted"}
    assert any("Z3 and Z4 are truly zero" in s for s in made.sentences)
    assert "not public" in papers.render_text(made)
