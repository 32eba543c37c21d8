"""Stepwise selection: exact increase of v'Pv, criteria against their thresholds, pairs, returns, and the cameras of networks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import baarda
from baarda.cameras import FREE, OBSERVED
from baarda.errors import Singular, UsageError
from baarda.procedures.camera_selection import select_parameters
from baarda.procedures.criteria import Fitted, criteria, falls_below
from baarda.procedures.selection import SelectionOptions, select_columns
from networks import ring
from reference.test_small_networks import chessboard


def problem(seed: int, n: int = 40, u: int = 8, zeros: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, u))
    x = np.concatenate([np.zeros(zeros), rng.uniform(1.0, 3.0, u - zeros)])
    return a, a @ x + rng.standard_normal(n)


@given(st.integers(0, 400), st.booleans())
def test_deleting_raises_the_objective_by_x2_over_q(seed: int, correlated: bool) -> None:
    a, l_ = problem(seed)
    root = np.eye(40) + 0.2 * np.random.default_rng(seed).standard_normal((40, 40)) / 6
    found = select_columns(a, l_, range(8), root @ root.T if correlated else None, deciding=())
    for step in found.steps[1:]:
        assert step.increase == pytest.approx(step.predicted_increase, rel=1e-9, abs=1e-9)
    for before, step in zip(found.steps, found.steps[1:], strict=False):
        if step.action == "deleted":
            assert step.objective - before.objective == pytest.approx(step.predicted_increase, rel=1e-8)
            assert step.redundancy == before.redundancy + 1
            assert step.p_value > 0.05
            s2 = before.objective / before.redundancy
            assert step.f_statistic == pytest.approx(step.predicted_increase / s2, rel=1e-9)


@given(st.integers(0, 400), st.sampled_from(["variance", "s", "j"]))
def test_criteria_fall_exactly_below_their_thresholds(seed: int, second: str) -> None:
    rng = np.random.default_rng(seed)
    n, r, f = 60, int(rng.integers(5, 50)), float(rng.uniform(0.0, 4.0))
    before = criteria(Fitted(float(r), n, r), second)
    after = criteria(Fitted(float(r + f), n, r + 1), second)
    for name in ("variance_factor", "criterion_b", "aic", "aicc", "bic"):
        limit = falls_below(name, n, r, second)
        if abs(f - limit) > 1e-9:
            assert (after[name] < before[name]) == (f < limit), name


def test_thresholds_of_the_literature() -> None:
    # r = 43, n = 60: 1, 1.51, 1.46
    assert falls_below("variance_factor", 60, 43) == 1.0
    assert falls_below("criterion_b", 60, 43) == pytest.approx(1.51, abs=0.005)
    assert falls_below("aic", 60, 43) == pytest.approx(1.46, abs=0.005)


def test_a_deletion_stands_while_one_criterion_falls() -> None:
    a, l_ = problem(3)
    for deciding in (("variance_factor",), ("criterion_b",), ("aic",), ("variance_factor", "criterion_b", "aic")):
        found = select_columns(a, l_, range(4), deciding=deciding)
        for step in found.steps[1:]:
            assert (step.action == "deleted") == any(k in step.fell for k in deciding)
    assert found.steps[0].action == "start"
    assert [s.step for s in found.steps] == list(range(len(found.steps)))


def test_the_least_significant_goes_first() -> None:
    a, l_ = problem(5)
    found = select_columns(a, l_)
    q = np.linalg.inv(a.T @ a)
    x = q @ a.T @ l_
    assert found.steps[1].parameter == f"x{np.argmin(x**2 / np.diagonal(q)) + 1}"


def test_a_parameter_returns() -> None:
    """x3 explains what x1 and x2 explain together: it goes last; where x1 was deleted before, it may be needed again."""
    for seed in range(300):
        rng = np.random.default_rng(seed)
        n = 12
        b = rng.standard_normal((n, 4))
        a = np.column_stack([b[:, 0], b[:, 1], b[:, 0] + b[:, 1] + 0.4 * b[:, 2], b[:, 3] + b[:, 0]])
        l_ = a @ [1.0, 1.0, 0.0, 0.5] + rng.standard_normal(n)
        found = select_columns(a, l_, alpha=0.2)
        back = [s for s in found.steps if s.action == "returned"]
        if back:
            break
    else:
        pytest.fail("no parameter returned in 300 problems")
    step = back[0]
    assert step.p_value <= 0.2
    assert step.increase == pytest.approx(step.predicted_increase, rel=1e-8)
    assert len({frozenset(found.deleted)}) == 1
    assert step.as_dict()["returned"] == step.parameter


def test_of_a_significant_pair_one_stays() -> None:
    rng = np.random.default_rng(1)
    t = rng.standard_normal(30)
    a = np.column_stack([np.ones(30), t + 0.02 * rng.standard_normal(30), t + 0.02 * rng.standard_normal(30)])
    l_ = 2.0 + 0.8 * t + 0.8 * rng.standard_normal(30)
    found = select_columns(a, l_, ["x2", "x3"])
    step = found.steps[1]
    assert step.action == "deleted"
    assert step.pair["rejected"]
    assert not step.pair["partner_significant"]
    assert abs(step.pair["correlation"]) > 0.95
    assert "stays for both" in step.note
    assert len(found.deleted) == 1


def test_an_insignificant_pair_goes() -> None:
    rng = np.random.default_rng(2)
    t = rng.standard_normal(30)
    a = np.column_stack([np.ones(30), t + 0.02 * rng.standard_normal(30), t + 0.02 * rng.standard_normal(30)])
    found = select_columns(a, 2.0 + 0.8 * rng.standard_normal(30), ["x2", "x3"], deciding=())
    assert set(found.deleted) == {"x2", "x3"}
    assert not found.steps[1].pair["rejected"]


def test_borders() -> None:
    a, l_ = problem(7)
    none = select_columns(a, l_, [])
    assert none.stopped == "There are no parameters to select."
    assert none.steps[0].note == none.stopped
    noise = np.random.default_rng(9).standard_normal(40)
    everything = select_columns(a, noise, deciding=(), alpha=1e-9)
    assert everything.fit.names == ()
    assert everything.stopped == "No parameter is left to delete."
    with pytest.raises(Singular, match="x9"):
        select_columns(np.column_stack([a, a[:, 0] + a[:, 1]]), l_)
    with pytest.raises(UsageError, match="residuals vanish"):
        select_columns(a, a @ np.ones(8) * 0.0)
    with pytest.raises(UsageError, match="unknown criterion"):
        SelectionOptions(deciding=("r2",))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="9b"):
        select_columns(a, l_, second="press")
    assert criteria(Fitted(3.0, 10, 1), "s")["criterion_b"] is None
    assert criteria(Fitted(3.0, 10, 2))["aicc"] is None


def test_check_values_are_told() -> None:
    a, l_ = problem(11)
    b = np.random.default_rng(0).standard_normal((5, 8))
    found = select_columns(a, l_, range(4), check=(b, b @ np.concatenate([np.zeros(4), np.ones(4)])), second="trace")
    assert all(s.criteria["check_rms"] > 0.0 for s in found.steps)
    assert all(s.criteria["criterion_b"] > 0.0 for s in found.steps)


# ---- networks -------------------------------------------------------------------------------------------------------------------------


def test_chessboard_drops_k2_and_p2(data) -> None:
    """k2 and k3 are not significant one by one, but they are together (correlation -.983): one of them stays."""
    found, a = select_parameters(chessboard(data("opencv_chessboard_left")))
    assert found.deleted == ("camera left: k2", "camera left: p2")
    first = found.steps[1]
    assert first.f_statistic == pytest.approx(0.51**2, abs=0.01)
    assert first.pair["partner"] == "camera left: k3"
    assert first.pair["correlation"] == pytest.approx(-0.983, abs=5e-4)
    assert first.pair["rejected"]
    for step in found.steps[1:]:
        assert step.increase == pytest.approx(step.predicted_increase, rel=0.01)  # the model is not linear
    again = baarda.adjust(replace(a.network, assumptions=()))
    assert again.objective == pytest.approx(a.objective, rel=1e-9)
    values = dict(zip(a.network.cameras[0].model.order, a.network.cameras[0].values, strict=True))
    assert values["k2"] == values["p2"] == 0.0
    assert any("deleted as insignificant" in text for text in a.assumptions)


def test_entering_by_one_linear_step_is_what_a_refit_finds(data) -> None:
    found, _ = select_parameters(chessboard(data("opencv_chessboard_left")), SelectionOptions(deciding=()))
    with_p2 = found.steps[-2].objective
    without = found.steps[-1].objective
    r = found.steps[-2].redundancy
    assert found.fit.entering["camera left: p2"] == pytest.approx((without - with_p2) / (with_p2 / r), rel=0.01)


def test_prior_values_of_deleted_parameters_stay_observations() -> None:
    network = ring(noise=0.3, free=("principal_distance", "K1", "P1"), seed=4)
    camera = network.cameras[0]
    states, sigmas, values = np.array(camera.states), np.array(camera.sigmas), np.array(camera.values)
    k = camera.model.order.index("P2")
    states[k], sigmas[k], values[k] = OBSERVED, 1e-6, 2e-7
    observed = replace(network, cameras=(replace(camera, states=states, sigmas=sigmas, values=values),))
    found, a = select_parameters(observed, SelectionOptions(deciding=(), alpha=1e-6))
    step = next(s for s in found.steps if s.parameter == "camera 1: P2")
    assert step.increase == pytest.approx(step.predicted_increase, rel=0.02)
    assert step.redundancy == found.steps[step.step - 1].redundancy + 1
    assert step.objective == pytest.approx(a.objective + 0.04, rel=0.02) or len(found.deleted) > 1


def test_no_parameters_and_no_convergence() -> None:
    network = ring(free=("principal_distance",))
    found, _ = select_parameters(network)
    assert found.stopped == "There are no parameters to select."
    with pytest.raises(UsageError, match="did not converge"):
        select_parameters(network, iterations=1)
    with pytest.raises(UsageError, match="exclude"):
        select_parameters(network, robust="huber")


def test_check_points_are_told_in_every_step() -> None:
    network = ring(control=6, checks=5, seed=2, free=("principal_distance", "K1", "P1", "P2"))
    found, _ = select_parameters(network, SelectionOptions(second="trace"))
    assert all(s.criteria["check_rms"] is not None for s in found.steps)
    assert all(s.criteria["criterion_b"] is not None for s in found.steps)
    row = found.steps[0].as_dict()
    assert {"step", "dropped", "f_statistic", "p_value", "unknowns", "variance_factor", "criterion_b", "aic", "bic", "check_rms"} <= set(
        row
    )


def test_states_are_kept_free() -> None:
    network = ring(free=("principal_distance", "K1", "P1", "P2"), seed=1)
    found, a = select_parameters(network)
    states = dict(zip(a.network.cameras[0].model.order, a.network.cameras[0].states, strict=True))
    assert states["K1"] == FREE
    assert all(states[n.split(": ")[1]] == 0 for n in found.deleted)
