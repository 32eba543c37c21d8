"""Problems of ODRPACK's user guide, and NIST's curves with errors in both coordinates: the combined model against ODRPACK.

Printed values: Boggs, Byrd, Rogers & Schnabel, User's Reference Guide for ODRPACK (NISTIR 92-4834, 1992), pages 39 and 49, and two more,
as SciPy's own tests of its ODRPACK state them. ODRPACK stops there where the sum of squares changes by less than 1e-8: parameters are good
to 1e-4 of their standard deviations, `NEAR`. The starts are nearer than those of the guide: points far from their curve are projected onto
it in each iteration here, not moved along with the parameters.
"""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from baarda import adjust
from baarda.network import Declared, Images, Network, Points
from baarda.observations import combined
from reference.test_nist_nonlinear import ASTRAY, MODELS, problem

NEAR = 1e-4


@dataclass(frozen=True)
class Conditions:
    """Rows of k observations with m conditions F(observations, parameters) = 0, partials by complex steps."""

    values: Any
    cofactors: Any
    function: Any
    name: str = "conditions"
    unit = ""

    @property
    def components(self):
        return tuple(f"l{k}" for k in range(self.values.shape[1]))

    def __len__(self):
        return len(self.values)

    def selected(self, keep):
        return replace(self, values=self.values[keep], cofactors=self.cofactors[keep])

    def points_of(self):
        return ()

    def nodes_of(self):
        return {"curve": np.zeros(len(self), dtype=int)}

    def observed(self):
        return self.values

    def sigma(self):
        return np.sqrt(np.einsum("nii->ni", self.cofactors))

    def labels(self, network):
        return {}

    def _at(self, b):
        steps = np.eye(self.values.shape[1])

        def conditions(values):
            partials = [np.imag(self.function(values + 1e-30j * e, b)) / 1e-30 for e in steps]
            return self.function(values, b), np.stack(partials, axis=2)

        return conditions

    def misclosures(self, network, state):
        with np.errstate(all="ignore"):
            return -combined.demanded(self._at(state["curve"].values), self.values, self.cofactors)[0]

    def linearize(self, network, state):
        b = state["curve"].values
        with np.errstate(all="ignore"):
            v, condition = combined.demanded(self._at(b), self.values, self.cofactors)
        size = np.where(b == 0.0, 1.0, np.abs(b))
        a = [np.imag(self.function(self.values + v, b + 1e-30j * s * e)) / (1e-30 * s) for s, e in zip(size, np.eye(len(b)), strict=True)]
        nodes = np.zeros(len(self), dtype=int)
        unknowns = [("curve", nodes, np.stack(a, axis=2))]
        return [combined.rows(np.arange(len(self)), v, condition, self.cofactors, unknowns)]


def network(values, cofactors, function, start):
    group = Declared.make("curve", ["1"], [f"b{k}" for k in range(len(start))], [""] * len(start), [start])
    rows = Conditions(np.asarray(values, dtype=float), np.asarray(cofactors, dtype=float), function)
    return Network((), Images.make(()), Points.make(()), (rows,), declared=(group,), settings={"min_rays": 0})


def diagonal(sigmas):
    return np.asarray(sigmas, dtype=float)[:, :, None] ** 2 * np.eye(np.shape(sigmas)[1])


def solved(net, **options):
    a = adjust(net, iterations=200, **options)
    assert a.status == "converged"
    q = a.covariance([f"curve 1: b{k}" for k in range(len(a.network.declared[0].values))], sigma="apriori")
    return a, a.network.declared[0].values, q


def near(a, b, q, printed, deviations):
    """Parameters as near as ODRPACK's stopping rule promises; standard deviations, which depend on them, alike."""
    s = np.sqrt(a.variance_factor * np.diag(q))
    assert (b - np.array(printed)) / s == pytest.approx(0.0, abs=NEAR)
    assert s == pytest.approx(deviations, rel=NEAR)


def explicit(values, b):
    return (values[:, 1] - b[0] - b[1] * (np.exp(b[2] * values[:, 0]) - 1.0) ** 2)[:, None]


def test_explicit_example():
    """ODRPACK guide, page 39: some abscissae are exact."""
    x = [0.0, 0.0, 5.0, 7.0, 7.5, 10.0, 16.0, 26.0, 30.0, 34.0, 34.5, 100.0]
    y = [1265.0, 1263.6, 1258.0, 1254.0, 1253.0, 1249.8, 1237.0, 1218.0, 1220.6, 1213.8, 1215.5, 1212.0]
    sigmas = np.ones((12, 2))
    sigmas[[0, 1, 11], 0] = 1e-7
    a, b, q = solved(network(np.stack([x, y], axis=1), diagonal(sigmas), explicit, [1260.0, -50.0, -0.1]))
    sd = [1.0349270280543437, 1.583997785262061, 0.0063321988657267]
    near(a, b, q, [1.2646548050648876e03, -5.4018409956678255e01, -8.7849712165253724e-02], sd)
    assert a.redundancy == 12 - 3
    # the guide's covariance follows ODRPACK's partials at the adjusted points, as ours does
    printed = [
        [4.4949592379003039e-01, -3.7421976890364739e-01, -8.0978217468468912e-04],
        [-3.7421976890364739e-01, 1.0529686462751804e00, -1.9453521827942002e-03],
        [-8.0978217468468912e-04, -1.9453521827942002e-03, 1.6827336938454476e-05],
    ]
    assert q == pytest.approx(np.array(printed), rel=NEAR)


def ellipse(values, b):
    dx, dy = values[:, 0] - b[0], values[:, 1] - b[1]
    return (b[2] * dx**2 + 2.0 * b[3] * dx * dy + b[4] * dy**2 - 1.0)[:, None]


def test_implicit_example():
    """ODRPACK guide, page 49: an ellipse through twenty points; no coordinate is a function of the other."""
    x = [0.5, 1.2, 1.6, 1.86, 2.12, 2.36, 2.44, 2.36, 2.06, 1.74, 1.34, 0.9, -0.28, -0.78, -1.36, -1.9, -2.5, -2.88, -3.18, -3.44]
    y = [-0.12, -0.6, -1.0, -1.4, -2.54, -3.36, -4.0, -4.75, -5.25, -5.64]
    y += [-5.97, -6.32, -6.44, -6.44, -6.41, -6.25, -5.88, -5.5, -5.24, -4.86]
    start = [-1.0, -3.0, 0.09, 0.02, 0.08]
    a, b, q = solved(network(np.stack([x, y], axis=1), np.tile(np.eye(2), (20, 1, 1)), ellipse, start))
    printed = [-0.9993809167281279, -2.9310484652026476, 0.0875730502693354, 0.0162299708984738, 0.0797537982976416]
    sd = [0.1113840353364371, 0.1097673310686467, 0.0041060738314314, 0.0027500347539902, 0.0034962501532468]
    near(a, b, q, printed, sd)
    assert a.redundancy == 20 - 5
    assert np.abs(ellipse(np.stack([x, y], axis=1) + a.residuals.reshape(-1, 2), b)).max() < 1e-12


def test_pearson():
    """Pearson's data with the sigmas of SciPy's test; with x and y exchanged the line is the same one."""
    x = [0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4]
    y = [5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5]
    sx = [0.03, 0.03, 0.04, 0.035, 0.07, 0.11, 0.13, 0.22, 0.74, 1.0]
    sy = [1.0, 0.74, 0.5, 0.35, 0.22, 0.22, 0.12, 0.12, 0.1, 0.04]

    def line(values, b):
        return (values[:, 1] - b[0] - b[1] * values[:, 0])[:, None]

    a, b, q = solved(network(np.stack([x, y], axis=1), diagonal(np.stack([sx, sy], axis=1)), line, [6.0, -0.5]))
    near(a, b, q, [5.4767400299231674, -0.4796082367610305], [0.3590121690702467, 0.0706291186037444])
    other, reverse, p = solved(network(np.stack([y, x], axis=1), diagonal(np.stack([sy, sx], axis=1)), line, [10.0, -2.0]))
    near(other, reverse, p, [11.4192022410781231, -2.0850374506165474], [0.9820231665657161, 0.3070515616198911])
    assert other.objective == pytest.approx(a.objective, rel=1e-12)
    assert reverse[1] == pytest.approx(1.0 / b[1], rel=1e-9)


def test_lorentz_peak():
    """A resonance with abscissae of very different weights."""
    x = [3.9094, 3.85945, 3.84976, 3.84716, 3.84551, 3.83964, 3.82608, 3.78847, 3.78163]
    x += [3.72558, 3.70274, 3.6973, 3.67373, 3.65982, 3.6562, 3.62498, 3.55525, 3.41886]
    y = [652, 910.5, 984, 1000, 1007.5, 1053, 1160.5, 1409.5, 1430, 1122, 957.5, 920, 777.5, 709.5, 698, 578.5, 418.5, 275.5]
    sx = [0.000972971, 0.000948268, 0.000707632, 0.000706679, 0.000706074, 0.000703918, 0.000698955, 0.000456856, 0.000455207]
    sx += [0.000662717, 0.000654619, 0.000652694, 0.000000859202, 0.00106589, 0.00106378, 0.00125483, 0.00140818, 0.00241839]

    def peak(values, b):
        u = values[:, 0]
        return (values[:, 1] - b[0] * b[1] * b[2] / np.sqrt((u * u - b[2] * b[2]) ** 2 + (b[1] * u) ** 2))[:, None]

    sigmas = np.stack([sx, np.full(18, 0.29)], axis=1)
    a, b, q = solved(network(np.stack([x, y], axis=1), diagonal(sigmas), peak, [1430.0, 0.134, 3.78]))
    sd = [7.3621186811330963e-01, 3.5068899941471650e-04, 2.4451209281408992e-04]
    near(a, b, q, [1.4306780846149925e03, 1.3390509034538309e-01, 3.7798193600109009e00], sd)


PROBLEMS = [name for name in MODELS if (name, 2) not in ASTRAY]


@pytest.mark.parametrize("name", PROBLEMS)
def test_nist_curves_with_errors_in_both_coordinates(data, name):
    """NIST's models and data, abscissae uncertain, too: sum of squares, parameters and both residuals of SciPy's ODRPACK."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        odr = pytest.importorskip("scipy.odr", reason="this SciPy has no orthogonal distance regression any more")
    _, certified, _, _, deviation, freedoms, table = problem(data("nist_strd_nonlinear"), name)
    y, x = table.T
    model = MODELS[name]
    sx, sy = np.full(len(x), 1e-3 * np.ptp(x)), np.full(len(x), deviation)

    def condition(values, b):
        return (values[:, 1] - model(b, values[:, 0]))[:, None]

    net = network(np.stack([x, y], axis=1), diagonal(np.stack([sx, sy], axis=1)), condition, certified)
    a, b, _ = solved(net)
    assert a.redundancy == freedoms
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = odr.ODR(
            odr.RealData(x, y, sx=sx, sy=sy), odr.Model(lambda p, t: model(p, t)), beta0=b, sstol=1e-15, partol=1e-15, maxit=1000
        ).run()
    assert a.objective <= found.sum_square * (1.0 + 1e-9)  # ODRPACK's partials are numerical
    assert a.objective == pytest.approx(found.sum_square, rel=1e-6)
    assert np.abs(b - found.beta) / a.unknowns["sigma"] == pytest.approx(0.0, abs=2e-3)
    v = a.residuals.reshape(-1, 2)
    assert v[:, 0] / sx == pytest.approx(found.delta / sx, abs=2e-3)
    assert v[:, 1] / sy == pytest.approx(found.eps / sy, abs=2e-3)
    assert a.redundancy_numbers.sum() == pytest.approx(freedoms, rel=1e-8)
