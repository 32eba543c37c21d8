"""Maximum-likelihood adjustment under laws of errors, and critical values under them."""

import html
import json
from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.adjustment import robust as robust_module
from baarda.adjustment.likelihood import scale_of
from baarda.adjustment.linearize import whitened_misclosures
from baarda.adjustment.robust import NOT_APPLICABLE, covariance_factor, excess_kurtosis_of_errors, resistance_of
from baarda.distributions import law
from baarda.errors import UsageError
from baarda.hypotheses import run
from baarda.hypotheses._error_kurtosis import kurtosis_of_errors
from baarda.hypotheses.levels import Options
from baarda.network import State
from baarda.procedures import error_law
from baarda.procedures.error_law import critical_values, critical_values_of_projector
from baarda.procedures.testing import analyse
from baarda.report import page
from baarda.report.result_folder import result_json
from baarda.report.translation import catalogue, language, tr
from networks import ring, with_distances

LAWS = [
    ("normal", {}),
    ("modulated_normal", {"a": 0.5}),
    ("modulated_normal", {"a": 2.0}),
    ("lineo", {}),
    ("student", {"nu": 4.0}),
    ("cauchy", {}),
    ("huber", {"k": 1.0}),
    ("logistic", {}),
    ("contaminated_normal", {}),
]
SMALL = {"images": 5, "points": 12, "control": 4, "free": ("principal_distance",), "seed": 3}


@pytest.fixture(scope="module")
def network():
    return ring(**SMALL)


@pytest.fixture(scope="module")
def plain(network):
    return baarda.adjust(network)


def test_normal_law_is_least_squares(network, plain):
    r = baarda.adjust(network, robust="normal")
    assert r.status == "converged"
    assert r.unknowns["value"] == pytest.approx(plain.unknowns["value"], rel=1e-9, abs=1e-9)
    assert r.law.scale == pytest.approx(plain.sigma0, rel=1e-9)
    assert r.law.covariance_factor == pytest.approx(plain.variance_factor, rel=1e-9)
    for sigma in ("apriori", "aposteriori"):
        assert r.unknown_table(sigma)["sigma"] == pytest.approx(plain.unknown_table(sigma)["sigma"], rel=1e-8)
    assert r.law.weights == pytest.approx(1.0)
    assert plain.law is None


@pytest.mark.parametrize(("name", "shapes"), LAWS)
def test_solution_is_the_most_likely(network, name, shapes):
    """Gradient zero, scale equation, falling objective, and no neighbour more likely."""
    r = baarda.adjust(network, robust=name, robust_shapes=shapes or None, datum="minimal")
    assert r.status == "converged"
    standard = law(name)(**shapes)
    s, v = r.law.scale, r.lin.misclosure
    psi = -standard.score(v / s)
    assert np.abs(r.lin.design.T @ psi / r.lin.scale).max() < 1e-6
    assert np.sum(v / s * psi) == pytest.approx(r.redundancy, rel=1e-9)
    values = [h.objective for h in r.history]
    assert np.all(np.diff(values) <= 1e-9)
    assert values[-1] == pytest.approx(-np.sum(standard.logpdf(v / s)) + r.redundancy * np.log(s), abs=1e-8)

    moved = r.network.shifted(r.shift)
    state, best = State.of(moved), values[-1]
    rng = np.random.default_rng(5)
    for size in (1e-3, 0.03, 0.3):
        for _ in range(5):
            step = size * rng.standard_normal(r.numbering.count) / r.lin.scale
            near = whitened_misclosures(moved, state.moved(r.numbering, step), list(r.groups))
            for t in (s, s * np.exp(size * rng.standard_normal())):
                assert -np.sum(standard.logpdf(near / t)) + r.redundancy * np.log(t) >= best - 1e-7


def test_solvers_and_datums_agree(network):
    options = {"robust": "student", "robust_shapes": {"nu": 3.0}}
    dense, block = (baarda.adjust(network, solver=s, **options) for s in ("dense", "block"))
    assert block.unknowns["value"] == pytest.approx(dense.unknowns["value"], rel=1e-7, abs=1e-8)
    free = ring(**{**SMALL, "control": 0, "free": ()})
    inner, minimal = (baarda.adjust(free, datum=d, **options) for d in ("inner", "minimal"))
    assert inner.residuals == pytest.approx(minimal.residuals, abs=1e-7)
    assert inner.law.covariance_factor == pytest.approx(minimal.law.covariance_factor, rel=1e-7)
    assert inner.datum.name == "inner"
    assert np.trace(inner.cofactors.of(np.arange(inner.numbering.count))) < np.trace(minimal.cofactors.of(np.arange(inner.numbering.count)))


def test_same_twice(network):
    a, b = (baarda.adjust(network, robust="modulated_normal") for _ in range(2))
    assert a.unknowns["value"].tobytes() == b.unknowns["value"].tobytes()
    assert a.law.values == b.law.values


def test_influence_of_a_gross_error_ends_or_grows():
    make = ring(images=8, points=20, control=8, free=("principal_distance",), seed=4)
    truth = baarda.adjust(make)
    sigma = truth.unknown_table("apriori")["sigma"]
    points = np.array([n.startswith("point") for n in truth.unknowns["name"]])
    group = make.observations[0]

    def change(name, size):
        xy = group.xy.copy()
        xy[37, 0] += size * group.sigmas[37, 0]
        r = baarda.adjust(replace(make, observations=(replace(group, xy=xy),)), robust=name)
        assert r.status == "converged"
        if r.law is not None and r.law.resistance != "none":
            assert np.argmin(r.law.weights) == 74
            assert r.observations["weight"][74] < 0.1
        return np.abs((r.unknowns["value"] - truth.unknowns["value"]) / sigma)[points].max()

    small, large = ({name: change(name, size) for name in (None, "modulated_normal", "huber", "student", "cauchy")} for size in (100, 300))
    for name in (None, "modulated_normal"):
        assert large[name] > 2.0 * small[name]
    for name in ("huber", "student", "cauchy"):
        assert large[name] < 0.1 * large[None]
        assert abs(large[name] - small[name]) < 0.02 * (large[None] - small[None])


def test_words_of_resistance(network):
    for name, word in (("modulated_normal", "NOT resistant"), ("huber", "bounded influence"), ("cauchy", "loses its influence")):
        shapes = {"a": 1.0} if name == "modulated_normal" else None
        said = " ".join(baarda.adjust(network, robust=name, robust_shapes=shapes).assumptions)
        assert word in said
        assert "not applicable" in said
    assert [resistance_of(law(n)()) for n in ("normal", "logistic", "student")] == ["none", "bounded", "redescending"]


def test_shapes_are_estimated_through_the_geometry(network, plain, monkeypatch):
    excess = excess_kurtosis_of_errors(plain.lin, plain.solver, plain.redundancy)
    projector = np.eye(plain.count) - plain.lin.design @ plain.solver.solve(plain.lin.design.T.toarray())
    power, cumulant = kurtosis_of_errors(plain.lin.misclosure, plain.redundancy, np.diag(projector), float(np.sum(projector**4)))
    assert excess == pytest.approx(cumulant / power, rel=1e-9)
    found = {name: baarda.adjust(network, robust=name).law for name in ("modulated_normal", "student")}
    for used in found.values():
        assert used.excess_kurtosis == pytest.approx(excess, rel=1e-6)
        assert used.estimated == (next(iter(used.values)), "scale")
    if excess > 0:
        assert found["student"].values["nu"] == pytest.approx(4 + 6 / excess)
    else:
        assert np.isinf(found["modulated_normal"].values["a"])
    assert baarda.adjust(network, robust="cauchy").law.estimated == ("scale",)
    monkeypatch.setattr(robust_module, "EXACT_KURTOSIS", 0)
    monkeypatch.setattr(robust_module, "PROBES", 4096)
    squares = float(np.sum(np.diag(projector) ** 2))
    probed = excess_kurtosis_of_errors(plain.lin, plain.solver, plain.redundancy)
    # the relation solved for sum R_ij^4, which the probes estimate
    assert squares > 0
    assert probed == pytest.approx(excess, abs=0.02)


def test_heavy_residuals_ask_for_too_small_an_a():
    make = ring(images=6, points=16, control=6, free=(), seed=1)
    group = make.observations[0]
    xy = group.xy.copy()
    xy[::25] += 15.0 * group.sigmas[::25]
    used = baarda.adjust(replace(make, observations=(replace(group, xy=xy),)), robust="modulated_normal", iterations=100).law
    assert used.values["a"] == 0.25
    assert "gross errors?" in " ".join(used.assumptions)


def test_evidence_leaves_out_what_least_squares_alone_has():
    r = baarda.adjust(ring(**{**SMALL, "checks": 3}), robust="huber")
    e = r.evidence
    assert e.qvv is e.redundancy_numbers is e.pv is e.pqvvp is e.control is e.residuals_of is None
    assert e.variance_factor == pytest.approx(r.law.covariance_factor)
    assert np.isnan(r.observations["redundancy"]).all()
    kept = {t.name for t in run(e)} - set(NOT_APPLICABLE)
    assert "check_points" in kept
    with pytest.raises(UsageError, match="least squares"):
        critical_values(r, "radico")


def test_what_is_not_judged_is_listed_with_its_reason(network):
    checked = with_distances(ring(**{**SMALL, "checks": 3}), [(5, 6), (7, 8)])
    least_squares, huber, cauchy = (
        analyse(baarda.adjust(checked, robust=name), Options(replicas=19)) for name in (None, "huber", "cauchy")
    )
    apriori = analyse(huber.adjustment, Options(replicas=19, sigma="apriori"))
    assert result_json(least_squares)["not_applicable"] == []
    assert {t.name for t in least_squares.tests} >= {"jarque_bera", "goodness_of_fit", "data_snooping", "control_points"}
    for a in (huber, cauchy, apriori):
        document = result_json(a)
        json.dumps(document, allow_nan=False)
        made, listed = [t["name"] for t in document["tests"]], [t["name"] for t in document["not_applicable"]]
        assert not set(made) & set(listed)
        assert set(listed) >= set(NOT_APPLICABLE)
        # nothing vanishes: what least squares would judge is judged or listed
        assert {t.name for t in least_squares.tests} <= set(made) | set(listed)
        assert all(len(t["reason"]) > 20 for t in document["not_applicable"])
        assert (
            document["laws"] == [] and document["law_study"] is document["critical_values"] is document["accuracy"]["vdi_vde_2634"] is None
        )
        for code in ("en", "de"):
            with language(code):
                text = html.unescape(page.html(a, page.sections(a)))
                assert all(tr(t["reason"]) in text for t in document["not_applicable"])
                assert code == "en" or all(t["reason"] in catalogue(code) for t in document["not_applicable"])
    assert "check_points" in result_json(huber)["tests"][0]["name"]
    assert not cauchy.tests and "check_points" in cauchy.not_applicable  # redescending, and few redundant observations
    assert not apriori.tests and "a posteriori" in apriori.not_applicable["check_points"]
    row = result_json(apriori)["check_points"][0]
    assert row["dx"] is not None and row["statistic"] is row["p_value"] is row["rejected"] is None
    assert "control_points" not in analyse(baarda.adjust(ring(**{**SMALL, "fixed_control": True}), robust="huber")).not_applicable
    assert "vdi_vde_2634" not in analyse(baarda.adjust(network, robust="huber")).not_applicable


def test_covariance_factor_is_the_sandwich_for_few_unknowns():
    rng = np.random.default_rng(8)
    standard = law("student")(nu=4.0)
    u = standard.rvs(20_000, rng)
    factor, text = covariance_factor(u, standard, 19_999)
    psi = -standard.score(u)
    step = 1e-5
    slope = (standard.score(u - step) - standard.score(u + step)) / (2 * step)
    assert factor == pytest.approx(np.mean(psi**2) / np.mean(slope) ** 2, rel=1e-3)
    assert factor == pytest.approx(1 / (5 / 7), rel=0.03)  # the inverse of Fisher's information (nu + 1)/(nu + 3)
    assert "El Karoui" in text
    # so negative a curvature that no c exists
    factor, text = covariance_factor(np.array([0.0, 0.1, -0.2, 0.1, 0.3, 1.7, -1.8, 1.6]), law("cauchy")(), 3)
    assert factor > 0
    assert "Huber" in text


def test_scale_equation():
    v = np.array([1.0, -2.0, 0.5, 4.0, -0.3, 0.8])
    s = scale_of(v, law("cauchy")(), 4)
    u = v / s
    assert np.sum(2 * u * u / (1 + u * u)) == pytest.approx(4.0)
    assert scale_of(v, law("cauchy")(), 4, 5.0 * s) == pytest.approx(s)
    with pytest.raises(UsageError, match="vanish"):
        scale_of(np.array([1.0, 0.0, 0.0, 0.0]), law("cauchy")(), 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robust": "nonsense"}, "no law named"),
        ({"robust": "laplace"}, "pointed"),
        ({"robust": "equi"}, "pointed"),
        ({"robust": "modulated_normal", "robust_shapes": {"a": 0.1}}, "pointed"),
        ({"robust": "student", "robust_shapes": {"a": 1.0}}, "no shape 'a'"),
        ({"robust": "cauchy", "robust_shapes": {"nu": 2.0}}, "no shape 'nu'"),
        ({"robust": "student", "robust_shapes": {"nu": -2.0}}, "outside"),
        ({"robust_shapes": {"nu": 4.0}}, "none is named"),
    ],
)
def test_what_makes_no_sense_is_refused(network, options, message):
    with pytest.raises(UsageError, match=message):
        baarda.adjust(network, **options)


def test_residuals_that_vanish_are_refused(plain):
    net = plain.network
    groups = tuple(replace(g, xy=g.xy - g.misclosures(net, State.of(net))) for g in net.observations)
    given = np.where(np.isfinite(net.points.given), net.points.coordinates, np.nan)
    exact = replace(net, observations=groups, points=replace(net.points, given=given))
    with pytest.raises(UsageError, match="vanish"):
        baarda.adjust(exact, robust="student")


# ---- critical values ------------------------------------------------------------------------------------------------------------------


def test_normal_errors_give_the_normal_critical_values(plain):
    found = critical_values(plain, "normal", alpha=0.01, replicas=1500, seed=2)
    for c in found.classes:
        for limit in (c.w, c.tau, c.delta0):
            assert abs(limit.value - limit.normal) < 4 * limit.error
            assert limit.error < 0.08
        assert c.level_w == pytest.approx(0.01, rel=0.3)
    assert found.family_w.value == found.family_w.normal
    lows = [c.lowest for c in found.classes]
    assert lows == sorted(lows)
    assert sum(c.count for c in found.classes) == np.sum(found.members >= 0)


@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_mdb_beside_the_normal_one(correlation):
    a = baarda.adjust(ring(**{**SMALL, "correlation": correlation}))
    found = critical_values(a, law("radico")(scale=3.0), alpha=0.01, replicas=600)
    assert found.mdb_normal == pytest.approx(np.asarray(analyse(a, baarda_options(0.01)).observations["mdb"], dtype=float))
    assert np.all(found.mdb > 0.97 * found.mdb_normal)
    assert np.median(found.mdb / found.mdb_normal) > 1.0
    assert np.mean([c.w.value - c.w.normal for c in found.classes]) > 0.0


def baarda_options(alpha):
    from baarda.hypotheses.levels import Options

    return Options(alpha_outlier=alpha)


def test_plain_projector_gives_the_same(plain):
    projector = np.eye(plain.count) - plain.lin.design @ plain.solver.solve(plain.lin.design.T.toarray())
    a = critical_values(plain, law("lineo")(), alpha=0.02, replicas=400, seed=9)
    b = critical_values_of_projector(projector, law("lineo")(), alpha=0.02, replicas=400, seed=9)
    assert b.mdb * plain.sigmas == pytest.approx(a.mdb, rel=1e-8)
    for x, y in zip(a.classes, b.classes, strict=True):
        assert (y.w.value, y.tau.value) == pytest.approx((x.w.value, x.tau.value), rel=1e-8)


def test_replicas_do_not_depend_on_chunks(plain, monkeypatch):
    first = critical_values(plain, "modulated_normal", alpha=0.02, replicas=300, shapes={"a": 0.0})
    monkeypatch.setattr(error_law, "_CHUNK", 7.0 * plain.count)
    again = critical_values(plain, "modulated_normal", alpha=0.02, replicas=300, shapes={"a": 0.0})
    assert again.mdb == pytest.approx(first.mdb, rel=1e-12)
    assert again.family_tau.value == pytest.approx(first.family_tau.value, rel=1e-12)
    assert critical_values(plain, "student", alpha=0.02, replicas=300).law.family == "student"


def test_uncontrolled_observations_have_no_mdb():
    r = np.eye(21) - 1.0 / 20.0
    r[20], r[:, 20] = 0.0, 0.0
    found = critical_values_of_projector(r, law("radico")(), alpha=0.02, replicas=400)
    assert np.isnan(found.mdb[20])
    assert found.members[20] == -1
    assert np.isfinite(found.mdb[:20]).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"law": "cauchy"}, "no variance"),
        ({"law": "radico", "replicas": 100}, "too few"),
        ({"law": "radico", "alpha": 1e-5, "replicas": 300}, "are needed"),
        ({"law": "radico", "alpha": 2.0}, "fraction"),
        ({"law": law("radico")(), "shapes": {"a": 1.0}}, "by the law itself"),
    ],
)
def test_critical_values_that_make_no_sense(plain, options, message):
    with pytest.raises(UsageError, match=message):
        critical_values(plain, **options)
    with pytest.raises(UsageError, match="square"):
        critical_values_of_projector(np.ones((2, 3)), law("radico")())


def test_the_verdict_says_which_law_and_what_it_resists():
    from baarda.hypotheses.levels import Options
    from baarda.procedures.testing import analyse
    from baarda.report.sections.verdict import sentences

    made = baarda.adjust(ring(control=5), robust="modulated_normal", robust_shapes={"a": 0.5})
    text = next(s.text for s in sentences(analyse(made, Options())) if s.subject == "Law of errors")
    assert "maximum likelihood under the modulated_normal law" in text
    assert "NOT resistant to gross errors" in text
    assert "not applicable under a law of errors" in text
