"""Selection of additional camera parameters and of removable declared ones, each step a rigorous adjustment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from baarda.adjustment import Adjustment, adjust
from baarda.adjustment.linearize import linearize
from baarda.adjustment.solve import Settings, prepare
from baarda.cameras import FIXED, OBSERVED
from baarda.errors import UsageError
from baarda.hypotheses.levels import Options
from baarda.network import Network, State, unknowns_of
from baarda.procedures.criteria import Fitted
from baarda.procedures.selection import Fit, Selection, SelectionOptions, select

Floats = NDArray[np.float64]
Told = Callable[[str], None]


def apply_settings(network: Network, settings: dict[str, Any]) -> tuple[Network, dict[str, Any]]:
    """Apply the settings that change a network, and return it with the settings that are left for `adjust`.

    Parameters
    ----------
    network : Network
    settings : dict
        Fields of `Settings`.

    Returns
    -------
    network : Network
        With states and sigmas as the settings say, so that it can be changed and adjusted again and again.
    rest : dict
    """
    prepared, _, _ = prepare(network, Settings.of(network, settings))
    done = ("camera", "image_sigma", "residual_plane")
    kept = {k: v for k, v in prepared.settings.items() if k not in done}
    return replace(prepared, settings=kept), {k: v for k, v in settings.items() if k not in done}


def check_rms(a: Adjustment) -> float | None:
    """Return the root mean square of all check coordinates (adjusted - given); None without check points."""
    points = a.network.points
    d = (points.coordinates - points.given)[a.judges]
    d = d[np.isfinite(d)]
    return float(np.sqrt(np.mean(d * d))) if len(d) else None


class CameraModel:
    """A network as a model whose additional parameters may be deleted; see `baarda.procedures.selection.Model`.

    They are the additional parameters of the cameras and what declared groups call `removable`.

    Parameters
    ----------
    network : Network
        Prepared by `apply_settings`.
    settings : dict
        For `adjust`.
    with_trace : bool
        Whether criterion 9b needs the trace of the point covariances.
    tell : callable, optional
        Is told of each adjustment.
    """

    def __init__(self, network: Network, settings: dict[str, Any], with_trace: bool = False, tell: Told | None = None) -> None:
        self.base, self.settings, self.with_trace, self.tell = network, settings, with_trace, tell
        self.warm: Adjustment | None = None
        self.places: dict[str, tuple[int, int]] = {}
        used = set(network.images.cameras.tolist())
        for i, c in enumerate(network.cameras):
            for k, name in enumerate(c.model.order):
                if c.model.additional[k] and c.states[k] != FIXED and i in used:
                    self.places[f"camera {c.label}: {name}"] = (i, k)
        self.declared: dict[str, tuple[int, int]] = {}
        numbering = unknowns_of(network)
        for i, d in enumerate(network.declared):
            removable, columns = d.removable(), numbering[d.kind].columns
            for node, label in enumerate(d.labels):
                for k, name in enumerate(d.parameters_of(node), int(d.offsets[node])):
                    if removable[k] and columns[k] >= 0:
                        self.declared[f"{d.kind} {label}: {name}"] = (i, k)

    def fit(self, deleted: frozenset[str]) -> Fit:
        """Adjust with these parameters fixed at zero."""
        if self.tell is not None:
            self.tell("adjusting without " + ", ".join(sorted(deleted)) if deleted else "adjusting the full model")
        a = adjust(self._network(deleted, None if self.warm is None else self.warm.network), **self.settings)
        if a.status != "converged":
            gone = f" without {', '.join(sorted(deleted))}" if deleted else ""
            raise UsageError(f"the adjustment{gone} did not converge: parameters cannot be selected; {a.contradictions()}")
        self.warm = a
        names = tuple(name for name in (*self.places, *self.declared) if name not in deleted)
        columns = np.array([a.numbering.column(name) for name in names], dtype=np.intp)
        values = np.array([self._value(a.network, name) for name in names])
        q = a.cofactors.of(columns) if len(columns) else np.zeros((0, 0))
        omega, extra = self._priors(deleted)
        redundancy = a.redundancy + extra
        trace = a.variance_factor * float(np.einsum("nii->", a.point_cofactors)) if self.with_trace else None
        # An a-priori value of a deleted parameter still is an observation, whose residual is its distance from zero.
        fitted = Fitted(a.objective + omega, a.count + extra, redundancy, trace, check_rms(a))
        with threadpool_limits(limits=1, user_api="blas"):
            entering = self._entering(a, deleted, fitted)
        return Fit(names, values, 0.5 * (q + q.T), a.numbering.count, fitted, entering, a)

    def _value(self, network: Network, name: str) -> float:
        if name in self.places:
            i, k = self.places[name]
            return float(network.cameras[i].values[k])
        i, k = self.declared[name]
        return float(network.declared[i].values[k])

    def _prior(self, name: str) -> tuple[float, float] | None:
        """Return the a-priori value and sigma of a parameter; None if it has none."""
        if name in self.places:
            i, k = self.places[name]
            c = self.base.cameras[i]
            return (float(c.prior[k]), float(c.sigmas[k])) if c.states[k] == OBSERVED else None
        i, k = self.declared[name]
        d = self.base.declared[i]
        return (float(d.given[k]), float(d.sigmas[k])) if d.states[k] == OBSERVED else None

    def _network(self, deleted: frozenset[str], warm: Network | None = None) -> Network:
        """Return the network with these parameters fixed at zero, at the values found last."""
        source = self.base if warm is None else replace(warm, assumptions=self.base.assumptions)
        cameras = list(source.cameras)
        for i, c in enumerate(self.base.cameras):
            states, values = np.array(c.states), np.array(cameras[i].values)
            for name in deleted & self.places.keys():
                j, k = self.places[name]
                if j == i:
                    states[k], values[k] = FIXED, 0.0
            cameras[i] = replace(cameras[i], states=states, values=values)
        declared = list(source.declared)
        for i, d in enumerate(self.base.declared):
            states, values = np.array(d.states), np.array(declared[i].values)
            for name in deleted & self.declared.keys():
                j, k = self.declared[name]
                if j == i:
                    states[k], values[k] = FIXED, 0.0
            declared[i] = replace(declared[i], states=states, values=values)
        return replace(source, cameras=tuple(cameras), declared=tuple(declared))

    def _priors(self, deleted: frozenset[str]) -> tuple[float, int]:
        """Return v'Pv and number of the a-priori values of deleted parameters."""
        omega, count = 0.0, 0
        for name in sorted(deleted):
            prior = self._prior(name)
            if prior is not None:
                omega += (prior[0] / prior[1]) ** 2
                count += 1
        return omega, count

    def _entering(self, a: Adjustment, deleted: frozenset[str], fitted: Fitted) -> dict[str, float]:
        """Return the F of each deleted parameter in the model with it, by one linear step from the solution."""
        names, r = sorted(deleted), fitted.redundancy
        if not names or r < 2:
            return {}
        larger = self._network(frozenset(), a.network)  # the same state, with the columns of the deleted parameters
        used = np.isin(np.arange(len(larger.cameras)), larger.images.cameras)
        numbering = unknowns_of(larger, ~a.aside, used)
        full = linearize(larger, State.of(a.network), numbering, list(a.groups))
        unit = np.zeros((numbering.count, len(names)))
        unit[[numbering.column(name) for name in names], np.arange(len(names))] = 1.0
        columns = full.times(unit)
        side = a.lin.transposed(columns)
        share = np.einsum("nj,nj->j", columns, columns) - np.einsum("uj,uj->j", side, a.solver.solve(side))
        pull = columns.T @ a.lin.misclosure
        out = {}
        for j, name in enumerate(names):
            prior = self._prior(name)
            weight = pulled = 0.0
            if prior is not None:
                weight, pulled = prior[1] ** -2, prior[0] / prior[1] ** 2
            determined = float(share[j]) > 1e-12 * float(columns[:, j] @ columns[:, j])
            if determined or weight:
                gain = (float(pull[j]) + pulled) ** 2 / (float(share[j]) + weight)
                if gain < fitted.objective:
                    out[name] = gain / ((fitted.objective - gain) / (r - 1))
        return out


def selection_options(options: Options, **more: Any) -> SelectionOptions:
    """Return the selection options that go with the levels of an analysis."""
    alpha = options.global_level(1)
    return SelectionOptions(alpha, options.levels, options.sigma == "apriori", correlation_limit=options.correlation_limit, **more)


def select_parameters(
    network: Network, options: SelectionOptions | None = None, tell: Told | None = None, **settings: Any
) -> tuple[Selection, Adjustment]:
    """Drop the insignificant additional parameters of cameras and declared groups, one by one, and adjust again each time.

    Parameters
    ----------
    network : Network
    options : SelectionOptions, optional
    tell : callable, optional
        Is told of each adjustment.
    **settings
        Fields of `Settings`.

    Returns
    -------
    selection : Selection
    adjustment : Adjustment
        With the selected parameters; those deleted are fixed at zero. It starts from the adjustment before.

    Raises
    ------
    UsageError
        If an adjustment does not converge, or `robust` names a law of errors.

    Notes
    -----
    Each camera's parameters are selected on their own. v'Pv rises by x^2 / q exactly in a linear model; the table of steps states both.
    """
    o = SelectionOptions() if options is None else options
    if settings.get("robust") is not None:
        raise UsageError("parameters are selected by tests of least squares: --select and --robust exclude each other")
    prepared, rest = apply_settings(network, settings)
    found = select(CameraModel(prepared, rest, o.second == "trace", tell), o)
    chosen: Adjustment = found.fit.payload
    if found.deleted:
        chosen = chosen.with_assumptions(f"Additional parameters deleted as insignificant and fixed at zero: {', '.join(found.deleted)}.")
    return found, chosen
