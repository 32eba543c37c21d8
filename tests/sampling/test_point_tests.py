"""Sizes and powers of the tests of check points, control points, deformation, variance ratio and variance components."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from threadpoolctl import threadpool_limits

import baarda
from baarda.hypotheses import _linear_model
from baarda.hypotheses.check_axes import check_axis, rms_interval
from baarda.hypotheses.check_points import check_point, check_points
from baarda.hypotheses.control_points import control_point, control_points
from baarda.hypotheses.deformation import deformation, deformation_point, moved_points
from baarda.hypotheses.levels import power_of_test
from baarda.hypotheses.variance_components import equal_variance_components, variance_component
from baarda.hypotheses.variance_factor import variance_ratio
from baarda.procedures.comparison import compare, epoch
from baarda.procedures.planning import error_free
from baarda.procedures.synthetic import ring
from baarda.procedures.variance_components import forms_and_traces, group_rows

pytestmark = pytest.mark.sampling

LEVELS = (0.10, 0.05, 0.01)
N, U, CONTROL = 60, 12, 6


@pytest.fixture(autouse=True)
def one_thread():
    """Small matrices only: threads would wait for each other."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


class Model:
    """A linear model with control rows that observe unknowns directly, and four check coordinates."""

    def __init__(self):
        rng = np.random.default_rng(5)
        self.design = rng.standard_normal((N, U))
        self.design[N - CONTROL :] = np.eye(CONTROL, U)
        self.covariance = np.diag(rng.uniform(0.5, 2.0, N))
        self.check = rng.standard_normal((6, U))
        self.root = np.linalg.cholesky(self.covariance)
        self.r = N - U

    def evidence(self, rng, shift=0.0, scale=1.0):
        observed = scale * self.root @ rng.standard_normal(N) + shift
        rows = list(range(N - CONTROL, N))
        return _linear_model.linear_model(self.design, observed, self.covariance, control=rows, check=(self.check, np.zeros(6)))


def streams(seed, count):
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]


def z_of(rates, expected):
    x = np.asarray(rates, dtype=float)
    spread = max(float(x.std(ddof=1)), np.sqrt(expected * (1 - expected)) * 0.05)
    return float((x.mean() - expected) / (spread / np.sqrt(len(x))))


def sizes(p_values):
    """Return the worst deviation over the levels of lists of p-values (arrays for families)."""
    return {level: z_of([np.mean(np.asarray(p) <= level) for p in p_values], level) for level in LEVELS}


def assert_sizes(p_values):
    z = sizes(p_values)
    assert max(abs(x) for x in z.values()) <= 4.0, z


@pytest.mark.parametrize("aposteriori", [True, False])
def test_sizes_of_check_and_control_points(aposteriori):
    model, found = Model(), {}
    axes, groups = list("XYZXYZ"), list("AAABBB")
    for rng in streams(1, 4000):
        e = model.evidence(rng)
        factor, r = (e.variance_factor, float(e.redundancy)) if aposteriori else (1.0, np.inf)
        c, k = e.check, e.control
        points = [f"{i // 3}" for i in range(CONTROL)]
        for t in (
            check_points(c.values, c.cofactors, factor, r),
            check_point(c.values, c.cofactors, factor, r, groups),
            check_axis(c.values, c.cofactors, factor, r, axes, groups),
            control_points(k.values, k.cofactors, factor, r),
            control_point(k.values, k.cofactors, factor, r, points),
        ):
            found.setdefault(t.name, []).append(t.p_value)
    assert len(found) == 5
    for p in found.values():
        assert_sizes(p)


def test_power_of_check_and_control_points_and_axes():
    model = Model()
    e = model.evidence(np.random.default_rng(0))
    move = 0.5 * np.array([1.5, -1.0, 0.5, 0.8, 0.0, -1.2])
    row = N - 2
    bias = np.zeros(N)
    bias[row] = 4.0 * model.root[row, row]
    hits = {"points": [], "point": [], "horizontal": [], "control": [], "control by s0": []}
    for rng in streams(2, 2000):
        e = model.evidence(rng)
        c = e.check
        hits["points"].append(check_points(c.values + move, c.cofactors, e.variance_factor, e.redundancy).rejected)
        hits["point"].append(check_point(c.values + move, c.cofactors, e.variance_factor, e.redundancy, list("AAABBB")).rejected[0])
        t = check_axis(c.values + move, c.cofactors, e.variance_factor, e.redundancy, list("XYZXYZ"), list("AAABBB"))
        hits["horizontal"].append(t.rejected[t.labels.index("horizontal")])
        e = model.evidence(rng, bias)
        k = e.control
        hits["control"].append(control_points(k.values, k.cofactors, 1.0, np.inf).rejected)
        hits["control by s0"].append(control_points(k.values, k.cofactors, e.variance_factor, e.redundancy).rejected)
    q = c.cofactors

    def lam(at):
        return move[at] @ np.linalg.solve(q[np.ix_(at, at)], move[at])

    expected = {
        "points": power_of_test(lam([0, 1, 2, 3, 4, 5]), 0.05, 6, model.r),
        "point": power_of_test(lam([0, 1, 2]), 0.05, 3, model.r),
        "horizontal": power_of_test(lam([0, 1, 3, 4]), 0.05, 4, model.r),
    }
    effect = model.evidence(np.random.default_rng(0), bias, 1e-9).control  # noncentrality: the form of the errorless residuals
    shown = effect.values @ np.linalg.solve(effect.cofactors, effect.values)
    expected["control"] = power_of_test(shown, 0.05, CONTROL)
    # Residuals of control are part of s0: R / v'Pv is a beta, that is F(d, r - d) of R against the rest; the bias shows in both.
    rest = model.r - CONTROL
    whole = float(model.evidence(np.random.default_rng(0), bias, 1e-9).vpv)
    assert whole == pytest.approx(shown, rel=1e-6)  # the bias lies in the control alone
    expected["control by s0"] = power_of_test(shown, 0.05, CONTROL, rest)
    for name, rates in hits.items():
        assert 0.1 < expected[name] < 0.995, (name, expected[name])
        assert abs(z_of(rates, expected[name])) <= 4.0, (name, np.mean(rates), expected[name])


def test_intervals_of_root_mean_squares_cover():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((9, 14)) * np.linspace(0.8, 1.2, 9)[:, None]
    c = root @ root.T
    true = np.sqrt(np.trace(c) / 3)
    covered = []
    for _ in range(3000):
        _, low, high = rms_interval(root @ rng.standard_normal(14), c, 3)
        covered.append(low <= true <= high)
    assert abs(np.mean(covered) - 0.95) < 0.01 + 4 * np.sqrt(0.05 * 0.95 / 4000)  # the law of a sum of unequal shares is approximate


def test_size_and_power_of_the_variance_ratio():
    rng = np.random.default_rng(4)
    r1, r2, count = 17, 40, 4000
    a, b = rng.chisquare(r1, count) / r1, rng.chisquare(r2, count) / r2
    assert_sizes([variance_ratio(x, r1, y, r2).p_value for x, y in zip(a, b, strict=True)])
    law = stats.f(r1, r2)
    expected = law.cdf(law.ppf(0.025) / 2.0) + law.sf(law.ppf(0.975) / 2.0)
    hits = [variance_ratio(2.0 * x, r1, y, r2).rejected for x, y in zip(a, b, strict=True)]
    assert abs(z_of(hits, expected)) <= 4.0


def test_power_of_deformation_and_of_its_points():
    rng = np.random.default_rng(6)
    m, r = 6, 25
    base = np.eye(3 * m) - np.kron(np.full((m, m), 1.0 / m), np.eye(3))
    root = base @ rng.standard_normal((3 * m, 3 * m + 4))
    q = root @ root.T
    groups = [str(i // 3) for i in range(3 * m)]
    move = np.zeros(3 * m)
    move[3:6] = [6.0, -5.0, 7.0]
    d0 = base @ move
    lam = d0 @ np.linalg.pinv(q, hermitian=True) @ d0
    joint, single, located = [], [], []
    for _ in range(1500):
        d, s2 = root @ rng.standard_normal(root.shape[1]) + d0, rng.chisquare(r) / r
        joint.append(deformation(d, q, s2, r).rejected)
        single.append(deformation_point(d, q, s2, r, groups).rejected[1])
        if len(located) < 200:
            located.append(moved_points(d, q, s2, r, groups).moved[:1])
    expected = power_of_test(lam, 0.05, 3 * m - 3, r)
    one = power_of_test(lam, 0.05, 3, r)  # all of the movement is that of the point, which takes all of the noncentrality
    assert 0.1 < expected < 0.99
    assert abs(z_of(joint, expected)) <= 4.0
    assert abs(z_of(single, one)) <= 4.0
    named = [x for x in located if x]
    assert np.mean([x == ("1",) for x in named]) > 0.8


def measured(truth, rng):
    net = error_free(truth)
    group, points = net.observations[0], net.points
    given = points.given + np.nan_to_num(points.sigmas) * rng.standard_normal(points.given.shape)
    return replace(
        net,
        points=replace(points, given=given),
        observations=(replace(group, xy=group.xy + 0.5 * rng.standard_normal(group.xy.shape)), *net.observations[1:]),
    )


@pytest.mark.parametrize("control", [0, 6], ids=["free", "control"])
def test_size_of_compare_on_whole_networks(control):
    truth = ring(4, points=10, control=control, seed=3).truth
    truth = truth if control else replace(truth, observations=truth.observations[:1])
    joint, single, ratio = [], [], []
    for rng in streams(7 + control, 250):
        c = compare(epoch(measured(truth, rng)), epoch(measured(truth, rng)))
        joint.append(c.congruence.p_value)
        single.append(np.asarray(c.points.p_value))
        ratio.append(c.variance_ratio.p_value)
    for p in (joint, single, ratio):
        assert_sizes(p)


def test_size_and_power_of_variance_components_in_a_linear_model():
    """4000 data sets of one geometry: three groups of 100, 80 and 60 observations, 20 unknowns; the law of one group is Satterthwaite's."""
    rng = np.random.default_rng(8)
    n, sizes_ = 240, (100, 80, 60)
    basis, _ = np.linalg.qr(rng.standard_normal((n, 20)))
    rest = np.eye(n) - basis @ basis.T
    codes = np.repeat(np.arange(3), sizes_)
    member = (codes == np.arange(3)[:, None]).astype(float)
    traces = np.array([[float((rest[np.ix_(codes == i, codes == j)] ** 2).sum()) for j in range(3)] for i in range(3)])
    names = ("a", "b", "c")
    errors = rng.standard_normal((n, 4000))
    forms = (member @ (rest @ errors) ** 2).T
    assert_sizes([np.asarray(variance_component(q, traces, names).p_value) for q in forms])
    assert_sizes([equal_variance_components(q, traces, names).p_value for q in forms])
    scales = np.where(codes == 1, 1.25, 1.0)
    forms = (member @ (rest @ (errors * scales[:, None])) ** 2).T
    single = np.array([np.asarray(variance_component(q, traces, names).rejected) for q in forms])
    equal = np.mean([equal_variance_components(q, traces, names).rejected for q in forms])
    # Mean and variance of each form e'M_i e of errors of variances D are tr(M_i D) and 2 tr(M_i D M_i D).
    weighted = [rest[:, codes == i] @ rest[codes == i] * scales**2 for i in range(3)]
    mean = np.array([np.trace(m) for m in weighted])
    spread = 2.0 * np.einsum("ij,ji->", weighted[1], weighted[1])
    r = traces.sum(axis=1)
    f = r[1] ** 2 / traces[1, 1]
    own = stats.chi2(2.0 * mean[1] ** 2 / spread, scale=spread / (2.0 * mean[1]))
    low, high = stats.chi2(f).ppf([0.025, 0.975]) * r[1] / f
    assert abs(single[:, 1].mean() - (own.sf(high) + own.cdf(low))) < 0.02
    shift = np.log(mean / r)
    v = 2.0 * traces / np.outer(r, r)
    c = np.eye(3)[1:] - np.eye(3)[:1]
    lam = c @ shift @ np.linalg.solve(c @ v @ c.T, c @ shift)
    assert abs(equal - power_of_test(lam, 0.05, 2)) < 0.06  # the covariance of the logarithms is that of the null
    assert single[:, [0, 2]].mean() < 0.10


def test_size_of_variance_components():
    truth = ring(6, points=25, control=12, seed=2, control_sigma=0.002).truth
    single, equal = [], []
    for rng in streams(9, 400):
        a = baarda.adjust(measured(truth, rng))
        rows, names = group_rows(a)
        forms, traces = forms_and_traces(a, rows, len(names))
        single.append(np.asarray(variance_component(forms, traces, names).p_value))
        equal.append(equal_variance_components(forms, traces, names).p_value)
    assert_sizes(single)
    assert_sizes(equal)
