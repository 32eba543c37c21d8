"""The combined model B v + A x = l: against the explicit form, orthogonal distance regression, and a published fit of a line."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from baarda import adjust
from baarda.adjustment.linearize import linearize
from baarda.errors import UsageError
from baarda.network import Declared, Images, Network, Points, State, unknowns_of
from baarda.observations import Block, Rows, combined
from baarda.procedures.radar_simulation import simulate_radar


@dataclass(frozen=True)
class Curve:
    """Points (x, y), both measured, of a curve y = f(x, parameters): one condition for two observations."""

    xy: Any
    sigmas: Any
    function: Any
    covariances: Any
    name: str = "curve"

    components = ("x", "y")
    unit = ""

    def __len__(self):
        return len(self.xy)

    def selected(self, keep):
        return replace(self, xy=self.xy[keep], sigmas=self.sigmas[keep], covariances=self.covariances[keep])

    def points_of(self):
        return ()

    def nodes_of(self):
        return {"curve": np.zeros(len(self), dtype=int)}

    def observed(self):
        return self.xy

    def sigma(self):
        return self.sigmas

    def labels(self, network):
        return {}

    def _conditions(self, b):
        def conditions(values):
            x, y = values.T
            slope = np.imag(self.function(x + 1e-30j, b)) / 1e-30
            return (y - self.function(x, b))[:, None], np.stack([-slope, np.ones_like(x)], axis=1)[:, None, :]

        return conditions

    def misclosures(self, network, state):
        return -combined.demanded(self._conditions(state["curve"].values), self.xy, self.covariances)[0]

    def linearize(self, network, state):
        b = state["curve"].values
        v, condition = combined.demanded(self._conditions(b), self.xy, self.covariances)
        x = (self.xy + v)[:, 0]
        steps = 1e-30j * np.eye(len(b))
        a = -np.stack([np.imag(self.function(x, b + h)) / 1e-30 for h in steps], axis=1)[:, None, :]
        nodes = np.zeros(len(self), dtype=int)
        return [combined.rows(np.arange(len(self)), v, condition, self.covariances, [("curve", nodes, a)])]


def curve_network(xy, sigmas, function, start, correlation=0.0):
    """A network with nothing but a curve."""
    covariances = np.zeros((len(xy), 2, 2))
    covariances[:, 0, 0], covariances[:, 1, 1] = sigmas[:, 0] ** 2, sigmas[:, 1] ** 2
    covariances[:, 0, 1] = covariances[:, 1, 0] = correlation * sigmas[:, 0] * sigmas[:, 1]
    names = [f"b{k}" for k in range(len(start))]
    group = Declared.make("curve", ["1"], names, [""] * len(start), [start])
    curve = Curve(xy, sigmas, function, covariances)
    return Network((), Images.make(()), Points.make(()), (curve,), declared=(group,), settings={"min_rays": 0})


def line(x, b):
    return b[0] + b[1] * x


def growth(x, b):
    return b[0] * np.exp(b[1] * x) + b[2]


def parabola(x, b):
    return b[0] + b[1] * x + b[2] * x**2


def odr(xy, sigmas, function, start):
    """SciPy's ODRPACK."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from scipy import odr as scipy_odr

        model = scipy_odr.Model(lambda b, x: function(x, b))
        data = scipy_odr.RealData(xy[:, 0], xy[:, 1], sx=sigmas[:, 0], sy=sigmas[:, 1])
        return scipy_odr.ODR(data, model, beta0=start, sstol=1e-15, partol=1e-15, maxit=500).run()


@pytest.mark.parametrize(
    ("function", "truth", "start"),
    [(line, (1.0, 0.7), (0.5, 0.5)), (parabola, (1.0, -0.5, 0.2), (0.8, -0.4, 0.25)), (growth, (1.0, 0.4, 0.3), (1.2, 0.35, 0.2))],
)
def test_orthogonal_distance_regression(function, truth, start):
    """Parameters, residuals of both coordinates, and covariance are those of ODRPACK."""
    rng = np.random.default_rng(4)
    x = np.linspace(0.0, 5.0, 25)
    sigmas = np.stack([rng.uniform(0.05, 0.2, 25), rng.uniform(0.05, 0.3, 25)], axis=1)
    xy = np.stack([x, function(x, np.array(truth))], axis=1) + sigmas * rng.standard_normal((25, 2))
    a = adjust(curve_network(xy, sigmas, function, start))
    found = odr(xy, sigmas, function, start)
    assert np.abs(a.network.declared[0].values - found.beta) / a.unknowns["sigma"] == pytest.approx(
        0.0, abs=1e-5
    )  # its partials are numerical
    assert a.objective == pytest.approx(found.sum_square, rel=1e-9)
    v = a.residuals.reshape(-1, 2)
    assert v[:, 0] == pytest.approx(found.delta, abs=2e-6)
    assert v[:, 1] == pytest.approx(found.eps, abs=2e-6)
    # n = 50 coordinates, 25 of which only say where on the curve the points are
    assert a.redundancy == 25 - len(truth)
    assert a.variance_factor == pytest.approx(found.res_var, rel=1e-9)
    assert a.redundancy_numbers.sum() == pytest.approx(a.redundancy, rel=1e-10)


def test_york_line():
    """Pearson's data with York's weights: the standard example of a line with errors in both coordinates (York 1966)."""
    x = [0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4]
    y = [5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5]
    wx = [1000.0, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0]
    wy = [1.0, 1.8, 4, 8, 20, 20, 70, 70, 100, 500]
    a = adjust(curve_network(np.stack([x, y], axis=1), 1.0 / np.sqrt(np.stack([wx, wy], axis=1)), line, (6.0, -0.5)))
    assert a.network.declared[0].values == pytest.approx([5.47991022, -0.480533407], abs=6e-9)
    assert a.variance_factor == pytest.approx(1.4833, abs=6e-5)  # chi2 / (n - 2) = 11.8664 / 8
    # standard errors from the adjusted points, a priori: York et al., Am. J. Phys. 72 (2004) 367
    s = np.sqrt(np.diag(a.covariance(["curve 1: b0", "curve 1: b1"], sigma="apriori")))
    assert s == pytest.approx([0.294971, 0.0579850], rel=3e-6)


def test_correlated_line_is_whitened_line():
    """With a correlation the fit is that of the general Lagrangian solution, computed here block by block."""
    rng = np.random.default_rng(7)
    x = np.linspace(0.0, 4.0, 12)
    sigmas = rng.uniform(0.1, 0.3, (12, 2))
    xy = np.stack([x, 1.0 + 0.5 * x], axis=1) + sigmas * rng.standard_normal((12, 2))
    network = curve_network(xy, sigmas, line, (1.0, 0.5), correlation=0.6)
    a = adjust(network)
    b = a.network.declared[0].values
    q = network.observations[0].covariances
    # the textbook formulas with the full matrices, at the solution
    big_b = np.zeros((12, 24))
    big_q = np.zeros((24, 24))
    for i in range(12):
        big_b[i, 2 * i : 2 * i + 2] = (-b[1], 1.0)
        big_q[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = q[i]
    v = a.residuals
    big_a = -np.stack([np.ones(12), (xy + v.reshape(-1, 2))[:, 0]], axis=1)
    ql = np.linalg.inv(big_b @ big_q @ big_b.T)
    qx = np.linalg.inv(big_a.T @ ql @ big_a)
    names = ["curve 1: b0", "curve 1: b1"]
    assert a.covariance(names, sigma="apriori") == pytest.approx(qx, rel=1e-9)
    w = -(xy[:, 1] - line(xy[:, 0], b))
    assert v == pytest.approx(big_q @ big_b.T @ ql @ w, abs=1e-12)  # the line is linear in x and y
    qvv = big_q @ big_b.T @ (ql - ql @ big_a @ qx @ big_a.T @ ql) @ big_b @ big_q
    assert a.qvv == pytest.approx(np.diag(qvv), rel=1e-9)
    p = np.linalg.inv(big_q)
    assert a.redundancy_numbers == pytest.approx(np.diag(qvv @ p), rel=1e-9)
    e = rng.standard_normal((24, 3))
    factor = np.zeros((24, 24))
    for i in range(12):
        factor[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = np.linalg.cholesky(q[i])
    assert a.residuals_of(e) == pytest.approx(-(qvv @ p @ factor @ e) / a.sigmas[:, None], abs=1e-10)
    dense, block = adjust(network, solver="dense"), adjust(network, solver="block")
    assert block.redundancy_numbers == pytest.approx(dense.redundancy_numbers, abs=1e-10)
    with pytest.raises(UsageError, match="fewer conditions"):
        adjust(network, robust="huber")


@dataclass(frozen=True)
class Explicit:
    """t and r in closed form, for straight flights without squint: v = f(x) - l."""

    whole: Any
    name: str = "explicit"

    components = ("t", "r")
    unit = ""

    def __len__(self):
        return len(self.whole)

    def selected(self, keep):
        return replace(self, whole=self.whole.selected(keep))

    def points_of(self):
        return self.whole.points_of()

    def nodes_of(self):
        return self.whole.nodes_of()

    def observed(self):
        return self.whole.tr

    def sigma(self):
        return self.whole.sigmas

    def labels(self, network):
        return {}

    def _computed(self, points, v):
        # squint0, spacing, delay, X0, X1, Y0, Y1, Z0, Z1, origin, side
        p, velocity = np.stack([v[:, 3], v[:, 5], v[:, 7]], axis=1), np.stack([v[:, 4], v[:, 6], v[:, 8]], axis=1)
        square, d = np.sum(velocity * velocity, axis=1), points - p
        s = np.sum(velocity * d, axis=1) / square
        across = d - s[:, None] * velocity
        return np.stack([s + v[:, 9], (np.sqrt(np.sum(across * across, axis=1)) - v[:, 2]) / v[:, 1]], axis=1)

    def misclosures(self, network, state):
        return self.whole.tr - self._computed(state.points[self.whole.points], state["track"].of(self.whole.tracks, 11))

    def linearize(self, network, state):
        x, v = state.points[self.whole.points], state["track"].of(self.whole.tracks, 11)
        d_point = np.stack([np.imag(self._computed(x + 1e-30j * e, v)) / 1e-30 for e in np.eye(3)], axis=2)
        d_track = np.stack([np.imag(self._computed(x, v + 1e-30j * e)) / 1e-30 for e in np.eye(11)], axis=2)
        blocks = (Block("point", self.whole.points, d_point), Block("track", self.whole.tracks, d_track))
        return [Rows(np.arange(len(self)), self.misclosures(network, state), blocks, self.whole.sigmas**2)]


def test_radar_equals_its_explicit_form():
    """Unknowns, residuals, their cofactors and redundancy numbers of the combined and of the explicit model are the same."""
    made = simulate_radar(3, order=1, directions=(np.pi, np.pi), sides=(1, -1), ties=4, control_sigma=0.5).network
    at = [made.declared[0].named(k, "squint0") for k in range(2)]
    states = np.array(made.declared[0].states)
    states[at] = 0
    made = replace(made, declared=(replace(made.declared[0], states=states),))
    a = adjust(made, tolerance=1e-13)
    started = replace(a.start, observations=(Explicit(made.observations[0]),))
    b = adjust(started, tolerance=1e-13)
    assert a.status == b.status == "converged"
    assert a.redundancy == b.redundancy
    assert a.objective == pytest.approx(b.objective, rel=1e-10)
    assert a.residuals / a.sigmas == pytest.approx(b.residuals / b.sigmas, abs=1e-10)
    assert a.unknowns["value"] == pytest.approx(b.unknowns["value"], rel=1e-10)
    assert a.unknowns["sigma"] == pytest.approx(b.unknowns["sigma"], rel=1e-10)
    assert a.redundancy_numbers == pytest.approx(b.redundancy_numbers, abs=1e-10)
    assert a.qvv / a.sigmas**2 == pytest.approx(b.qvv / b.sigmas**2, abs=1e-10)


def test_rows_of_both_forms_at_one_state():
    """Linearised at the same state, misclosures and design matrices agree to 1e-10."""
    made = simulate_radar(5, order=1, directions=(np.pi, np.pi), sides=(1, -1)).truth
    measured = simulate_radar(5, order=1, directions=(np.pi, np.pi), sides=(1, -1)).network.observations[0]
    made = made.shifted(-made.centroid())
    state, unknowns = State.of(made), unknowns_of(replace(made, observations=(measured,)))
    one, other = (linearize(made, state, unknowns, [g]) for g in (measured, Explicit(measured)))
    assert one.misclosure == pytest.approx(other.misclosure, abs=1e-8)
    a, b = one.design.toarray(), other.design.toarray()
    keep = [i for i, name in enumerate(unknowns.names) if "squint" not in name]
    size = np.linalg.norm(b[:, keep], axis=0)
    assert np.abs((a[:, keep] - b[:, keep]) / size).max() < 1e-10


def test_contradictory_conditions_cannot_be_computed():
    """Two conditions that are one do not determine residuals; the observation is named, nothing is guessed."""
    b = np.array([[[1.0, 2.0], [2.0, 4.0]]])
    assert np.isnan(combined.gain(b, np.ones((1, 2)))).all()
    v, _ = combined.demanded(lambda x: (x**2 + 1.0, 2.0 * x[:, :, None] * np.eye(1)), np.ones((1, 1)), np.ones((1, 1)))
    assert np.isnan(v).all()  # x^2 + 1 = 0
