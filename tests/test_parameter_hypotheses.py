"""Groups, equality of cameras and epochs, given values, collinearity: against constrained adjustments and dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.adjustment.parameter_hypotheses import collinearity, conditions, equal_cameras, equal_epochs, given_values
from baarda.errors import Singular, UsageError
from baarda.hypotheses import orthogonalisation, parameter_groups, parameters
from baarda.hypotheses._linear_model import linear_model
from baarda.hypotheses.base import Estimates, Evidence
from baarda.hypotheses.levels import Options
from baarda.hypotheses.variance_inflation import condition_indices, design_condition_indices, mutual_inflation, variance_inflation
from networks import BROWN, ring

FREE = ("principal_distance", "K1", "P1")


@pytest.fixture(scope="module")
def two():
    """Return a network with two cameras that are truly alike."""
    network = ring(control=5, free=FREE, seed=4)
    one = network.cameras[0]
    cameras = (one, replace(one, label="2"))
    half = np.arange(len(network.images.labels)) % 2
    return replace(network, cameras=cameras, images=replace(network.images, cameras=half))


def shared(network):
    """Return the same network with one camera: the hypothesis of equality as a constrained adjustment."""
    return replace(network, cameras=network.cameras[:1], images=replace(network.images, cameras=np.zeros(len(network.images.labels), int)))


def joint(seed: int = 3):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((40, 8)) + 0.5 * rng.standard_normal((40, 1))
    l_ = a @ rng.standard_normal(8) + rng.standard_normal(40)
    return a, l_, linear_model(a, l_, additional=range(2, 8))


def test_equality_of_cameras_is_the_growth_under_a_common_camera(two):
    free, common = baarda.adjust(two), baarda.adjust(shared(two))
    t = equal_cameras(free, "1", "2")
    assert t.df == (3.0, float(free.redundancy))
    # the problem is slightly curved: the constrained adjustment and the linear hypothesis agree to the order of the noise
    assert t.statistic * 3 * free.variance_factor == pytest.approx(common.objective - free.objective, rel=1e-2)
    assert common.redundancy - free.redundancy == 3
    found = {r.name: r for r in baarda.test(free)}
    pair = [found[n] for n in ("equal_cameras", "equal_camera_parameter", "additional_parameters_of_camera")]
    assert [len(r.labels) for r in pair] == [1, 2, 2]  # c is interior orientation, K1 and P1 are additional
    only = equal_cameras(free, "1", "2", ("K1", "P1"))
    assert pair[0].statistic[0] == pytest.approx(only.statistic, rel=1e-9)
    single = equal_cameras(free, "1", "2", ("K1",))
    assert pair[1].statistic[pair[1].labels.index("K1")] == pytest.approx(single.statistic, rel=1e-9)
    for solver in ("dense", "block"):
        assert equal_cameras(baarda.adjust(two, solver=solver), "1", "2").statistic == pytest.approx(t.statistic, rel=1e-6)


def test_cameras_that_differ_are_found(two):
    other = replace(two.cameras[1], values=two.cameras[1].values + np.where(np.array(two.cameras[1].model.order) == "K1", 3e-8, 0.0))
    network = ring(control=5, free=FREE, seed=4)
    group = network.observations[0]
    from baarda.network import State

    truth = replace(two, cameras=(two.cameras[0], other))
    bias = group.misclosures(two, State.of(two)) - group.misclosures(truth, State.of(truth))
    moved = replace(two, observations=(replace(group, xy=group.xy + bias),))
    t = equal_cameras(baarda.adjust(moved), "1", "2", ("K1",))
    assert t.p_value < 1e-6


def test_given_values_and_conditions(two):
    result = baarda.adjust(two)
    names = ["camera 1: K1", "camera 1: P1"]
    true = given_values(result, {n: BROWN.get(n.split(": ")[1], 0.0) for n in names})
    assert true.p_value > 1e-4
    values = dict(zip(result.camera_estimates.names, result.camera_estimates.values, strict=True))
    assert given_values(result, {n: values[n] for n in names}).statistic == pytest.approx(0.0, abs=1e-15)
    q = result.covariance(names, names) / result.variance_factor
    x = np.array([values[n] for n in names])
    assert given_values(result, dict.fromkeys(names, 0.0)).statistic == pytest.approx(
        parameters.general_linear(x, q, result.variance_factor, result.redundancy).statistic, rel=1e-9
    )
    apriori = given_values(result, dict.fromkeys(names, 0.0), sigma="apriori")
    assert apriori.law_name == "chi2(2) / 2"
    with pytest.raises(UsageError, match="not an estimated camera parameter"):
        given_values(result, {"camera 1: K2": 0.0})
    with pytest.raises(Singular):
        conditions(result, [({"camera 1: K1": 1.0}, 0.0), ({"camera 1: K1": 2.0}, 0.0)])
    with pytest.raises(UsageError, match="share no"):
        equal_cameras(result, "1", "9")


def test_equality_of_two_epochs_is_the_growth_of_a_joint_model() -> None:
    rng = np.random.default_rng(8)
    a, b = rng.standard_normal((30, 5)), rng.standard_normal((25, 5))
    z = rng.standard_normal(5)
    la, lb = a @ z + rng.standard_normal(30), b @ (z + np.eye(5)[4]) + rng.standard_normal(25)
    ea, eb = linear_model(a, la, additional=range(3, 5)), linear_model(b, lb, additional=range(3, 5))
    omega, r = ea.vpv + eb.vpv, ea.redundancy + eb.redundancy
    x, y = ea.additional, eb.additional
    t = parameter_groups.equal_parameters(x.values, x.cofactors, y.values, y.cofactors, omega / r, r)
    zero = np.zeros
    together = np.block([[a[:, :3], zero((30, 3)), a[:, 3:]], [zero((25, 3)), b[:, :3], b[:, 3:]]])
    assert t.statistic * 2 * omega / r == pytest.approx(linear_model(together, np.concatenate([la, lb])).vpv - omega, rel=1e-9)


def test_epochs_of_a_network():
    first, second = (baarda.adjust(ring(control=5, free=FREE, seed=s)) for s in (1, 2))
    t = equal_epochs(first, second)
    assert t.df == (3.0, first.redundancy + second.redundancy)
    assert t.p_value > 1e-3
    assert equal_epochs(first, second, ["camera 1: K1"]).df[0] == 1.0
    assert equal_epochs(first, second, {"camera 1: K1": "camera 1: K1"}, sigma="apriori").law_name.startswith("chi2")
    with pytest.raises(UsageError, match="not an estimated"):
        equal_epochs(first, second, ["camera 1: K3"])


def test_groups_are_the_general_hypothesis_and_the_growth_of_vpv() -> None:
    a, l_, e = joint()
    x, q = e.additional.values, e.additional.cofactors
    groups = ["a", "a", "b", "b", "b", "c"]
    t = parameter_groups.grouped_parameters(x, q, e.variance_factor, e.redundancy, groups)
    assert t.labels == ("a", "b", "c")
    assert t.law_name == "F(1 .. 3, 32)"
    for k, g in enumerate("abc"):
        rows = [i for i, h in enumerate(groups) if h == g]
        without = linear_model(np.delete(a, [2 + i for i in rows], axis=1), l_)
        assert t.statistic[k] * len(rows) * e.variance_factor == pytest.approx(without.vpv - e.vpv, rel=1e-9)
        alone = parameters.general_linear(x[rows], q[np.ix_(rows, rows)], e.variance_factor, e.redundancy)
        assert t.p_value[k] == pytest.approx(alone.p_value, rel=1e-9)


def test_deleting_a_parameter_of_a_network_raises_omega_by_its_form():
    """x^2 / q of the linearised system at the solution is what fixing the parameter at zero costs: asserted on the linear system itself."""
    result = baarda.adjust(ring(control=5, free=(*FREE, "K2"), seed=6))
    design, misclosure = result.lin.design.toarray(), result.lin.misclosure
    e = result.camera_estimates
    for k, name in enumerate(e.names):
        column = result.numbering.column(name)
        # at the solution A'l = 0; the constraint dx = -x for this unknown alone
        rest = np.delete(design, column, axis=1)
        target = misclosure + design[:, column] * e.values[k]
        scaled = rest / np.linalg.norm(rest, axis=0)
        left = target - scaled @ np.linalg.lstsq(scaled, target, rcond=None)[0]
        growth = float(left @ left) - result.objective
        assert growth == pytest.approx(e.values[k] ** 2 / e.cofactors[k, k], rel=1e-6)


def test_equality_by_all_by_parameter_and_by_pair() -> None:
    _, _, e = joint()
    x, q, s2, r = e.additional.values, e.additional.cofactors, e.variance_factor, e.redundancy
    groups, names = ["1", "1", "2", "2", "3", "3"], ["K1", "K2"] * 3
    everything = parameter_groups.equal_groups(x, q, s2, r, groups, names, "all")
    b = np.array([[1, 0, -1, 0, 0, 0], [1, 0, 0, 0, -1, 0], [0, 1, 0, -1, 0, 0], [0, 1, 0, 0, 0, -1.0]])
    assert everything.statistic[0] == pytest.approx(parameters.general_linear(x, q, s2, r, b).statistic, rel=1e-9)
    each = parameter_groups.equal_groups(x, q, s2, r, groups, names, "parameter")
    assert each.statistic[1] == pytest.approx(parameters.general_linear(x, q, s2, r, b[2:]).statistic, rel=1e-9)
    pair = parameter_groups.equal_groups(x, q, s2, r, groups, names, "pair")
    assert pair.labels == ("1, 2", "1, 3", "2, 3")
    at, to = [0, 1], [4, 5]
    alone = parameter_groups.equal_parameters(x[at], q[np.ix_(at, at)], x[to], q[np.ix_(to, to)], s2, r, q[np.ix_(at, to)])
    assert pair.statistic[1] == pytest.approx(alone.statistic, rel=1e-9)
    with pytest.raises(UsageError, match="nothing to compare"):
        parameter_groups.equal_groups(x, q, s2, r, groups, list("abcdef"))


# ---- what cannot be tested is said in words ----
def evidence_of(q: np.ndarray, names: tuple[str, ...] = ("K1", "K2", "P1"), groups: tuple[str, ...] = ()) -> Evidence:
    e = Estimates(names, np.arange(1.0, len(q) + 1.0), q, None, groups)
    return Evidence(residuals=np.zeros(9), sigmas=np.ones(9), vpv=4.0, redundancy=4, additional=e)


def every_test(e: Evidence) -> dict[str, object]:
    members = (parameters, orthogonalisation, parameter_groups)
    return {t.name: t for m in members for t in m.from_evidence(e, Options())}


def test_a_cofactor_of_zero_is_left_out_by_name() -> None:
    found = every_test(evidence_of(np.diag([1.0, 0.0, 2.0])))
    assert all("Not applicable to K2: the cofactor is zero" in t.note for n, t in found.items() if n != "bivariate_additional_parameters")
    assert found["additional_parameter"].labels == ("K1", "P1")
    assert found["all_additional_parameters"].df[0] == 2.0
    none = every_test(evidence_of(np.zeros((3, 3))))
    assert list(none) == ["additional_parameter"]
    assert none["additional_parameter"].note == "Not applicable: the cofactors of all additional parameters are zero."
    assert not none["additional_parameter"].rejected.any()


def test_equal_cameras_without_any_variance_of_the_difference() -> None:
    q = np.kron(np.ones((2, 2)), np.eye(2))  # both cameras are the same numbers
    names = tuple(f"camera {c}: {p}" for c in "12" for p in ("K1", "K2"))
    found = every_test(evidence_of(q, names, ("1", "1", "2", "2")))
    assert "cofactors are zero" in found["equal_cameras"].note
    assert found["equal_cameras"].details["tested"] == 0
    assert found["additional_parameters_of_camera"].details["tested"] == 2


def test_too_many_conditions_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameter_groups, "MOST_CONDITIONS", 1)
    names = tuple(f"camera {c}: {p}" for c in "12" for p in ("K1", "K2"))
    found = every_test(evidence_of(np.eye(4), names, ("1", "1", "2", "2")))
    assert "2 conditions of equality exceed the limit" in found["equal_cameras"].note


def test_nothing_in_the_result_is_not_a_number_where_parameters_depend_on_each_other(tmp_path):
    """Brown's B1, Ebner's E1 and c say nearly the same, B2 and E2 too: named; no NaN in any table."""
    import json
    from importlib.resources import files

    from baarda.procedures.testing import analyse
    from baarda.report.result_folder import write_folder

    network = baarda.read(files("baarda") / "data" / "camcal" / "camcaldemo.xml")
    analysis = analyse(baarda.adjust(network, camera="brown+ebner12"), Options(replicas=39))
    assert analysis.converged
    out = write_folder(analysis, tmp_path / "out")
    document = json.loads((out / "result.json").read_text())
    assert document["condition_indices"][-1] > 200
    worst = {row["name"]: row for row in document["variance_inflation"]}
    assert worst["camera 1: E2"]["most_correlated"] == "camera 1: B2"
    assert abs(worst["camera 1: B1"]["correlation"]) > 0.99
    for file in [out / "report.html", *(out / "tables").iterdir()]:
        text = file.read_text()
        assert ">nan<" not in text.lower()
        assert ",nan" not in text.lower()
    assert "Separability of the camera parameters" in (out / "report.html").read_text()


# ---- collinearity ----
def by_regression(a: np.ndarray, j: int) -> float:
    """Return 1 / (1 - R^2), uncentred, of the regression of a column on the others."""
    others = np.delete(a, j, axis=1)
    rest = a[:, j] - others @ np.linalg.lstsq(others, a[:, j], rcond=None)[0]
    return float(a[:, j] @ a[:, j] / (rest @ rest))


def test_variance_inflation_against_regression() -> None:
    a, _, e = joint()
    q = np.linalg.inv(a.T @ a)
    ours = variance_inflation(q, (a**2).sum(axis=0))
    theirs = [by_regression(a, j) for j in range(8)]
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    rest = a[:, 2:] - a[:, :2] @ np.linalg.lstsq(a[:, :2], a[:, 2:], rcond=None)[0]
    np.testing.assert_allclose(mutual_inflation(e.additional.cofactors), [by_regression(rest, j) for j in range(6)], rtol=1e-9)
    direct = design_condition_indices(rest)
    reduced = condition_indices(e.additional.cofactors)
    np.testing.assert_allclose(reduced.indices, direct.indices, rtol=1e-8)
    np.testing.assert_allclose(reduced.proportions, direct.proportions, atol=1e-8)
    np.testing.assert_allclose(reduced.proportions.sum(axis=0), 1.0, rtol=1e-12)
    assert direct.indices[-1] == pytest.approx(np.linalg.cond(rest / np.linalg.norm(rest, axis=0)), rel=1e-9)


def test_a_strong_dependence_names_who_is_involved() -> None:
    rng = np.random.default_rng(1)
    a = rng.standard_normal((50, 4))
    a[:, 3] = a[:, 1] + 1e-3 * rng.standard_normal(50)
    found = design_condition_indices(a).involved(["K1", "K2", "P1", "B1"])
    assert len(found) == 1
    assert found[0][1] == ["K2", "B1"]
    assert found[0][0] > 30


def test_orthogonal_parameters_are_not_inflated() -> None:
    assert variance_inflation(np.eye(3) / 4.0, np.full(3, 4.0)) == pytest.approx(np.ones(3))
    assert condition_indices(np.diag([1.0, 1e8])).indices == pytest.approx(np.ones(2))


def test_collinearity_of_a_network_against_dense_algebra():
    result = baarda.adjust(ring(control=5, free=FREE, seed=5))
    c = collinearity(result)
    design = result.lin.design.toarray()
    q = np.linalg.inv(design.T @ design)
    columns = [result.numbering.column(n) for n in c.names]
    np.testing.assert_allclose(c.inflation, np.diag(q)[columns] * (design[:, columns] ** 2).sum(axis=0), rtol=1e-6)
    assert (c.inflation >= c.mutual * (1 - 1e-9)).all()
    assert (c.mutual >= 1.0).all()
    s = np.sqrt(np.diag(q))
    rho = q / np.outer(s, s) - np.eye(len(q))
    others = np.array([i for i, n in enumerate(result.numbering.names) if n.startswith(("camera", "image"))])
    for column, (partner, value) in zip(columns, c.partners, strict=True):
        best = others[np.abs(rho[column, others]).argmax()]
        assert partner == result.numbering.names[best]
        assert value == pytest.approx(rho[column, best], rel=1e-6)
    assert collinearity(baarda.adjust(ring(control=5), camera="none")) is None


# ---- the way back ----
@pytest.mark.parametrize("basis", ["eigen", "triangular"])
def test_dropped_components_are_a_constrained_adjustment(basis):
    a, l_, e = joint()
    o = orthogonalisation.orthogonalise(e.additional.values, e.additional.cofactors, basis)
    keep = np.array([True, False, True, True, False, True])
    values, cofactors, growth = orthogonalisation.reduced_parameters(o, keep)
    back = o.back[:, keep]
    reduced = linear_model(np.column_stack([a[:, :2], a[:, 2:] @ back]), l_, additional=range(2, 6))
    np.testing.assert_allclose(back @ reduced.additional.values, values, rtol=1e-8)
    np.testing.assert_allclose(back @ reduced.additional.cofactors @ back.T, cofactors, rtol=1e-8, atol=1e-12)
    assert growth == pytest.approx(reduced.vpv - e.vpv, rel=1e-8)
    same, _, nothing = orthogonalisation.reduced_parameters(o, np.ones(6, dtype=bool))
    np.testing.assert_allclose(same, e.additional.values, rtol=1e-9)
    assert nothing == 0.0
    with pytest.raises(UsageError):
        orthogonalisation.reduced_parameters(o, [True])


def test_epochs_of_unequal_precision_are_judged_each_by_its_own_factor():
    q = np.diag([0.1, 0.2])
    pooled = parameter_groups.equal_parameters_of_epochs([1.0, 2.0], q, 1.0, 30, [1.2, 1.5], q, 1.3, 20)
    assert pooled.df == (2.0, 50.0)
    assert not pooled.details["variance_ratio"]["rejected"]
    own = parameter_groups.equal_parameters_of_epochs([1.0, 2.0], q, 1.0, 30, [1.2, 1.5], q, 9.0, 20)
    assert own.df == (2.0, 20.0)
    assert own.statistic == pytest.approx(0.5 * (0.04 / 1.0 + 0.25 / 2.0))  # differences over (1 + 9) q
    assert "differ" in own.note
