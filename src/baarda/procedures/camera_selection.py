"""Selection of the additional camera parameters of a network, each step a rigorous adjustment."""

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
from baarda.network import CHECK, Network, State, unknowns_of
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


def check_rms(network: Network, aside: NDArray[np.bool_]) -> float | None:
    """Return the root mean square of all check coordinates (adjusted - given); None without check points."""
    points = network.points
    d = (points.coordinates - points.given)[(points.roles == CHECK) & ~aside]
    d = d[np.isfinite(d)]
    return float(np.sqrt(np.mean(d * d))) if len(d) else None


class CameraModel:
    """A network as a model whose additional camera parameters may be deleted; see `baarda.procedures.selection.Model`.

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

    def fit(self, deleted: frozenset[str]) -> Fit:
        """Adjust with these parameters fixed at zero."""
        if self.tell is not None:
            self.tell("adjusting without " + ", ".join(sorted(deleted)) if deleted else "adjusting the full model")
        a = adjust(self._network(deleted, None if self.warm is None else self.warm.network), **self.settings)
        if a.status != "converged":
            gone = f" without {', '.join(sorted(deleted))}" if deleted else ""
            raise UsageError(f"the adjustment{gone} did not converge: parameters cannot be selected; {a.contradictions()}")
        self.warm = a
        e = a._camera_estimates(additional_only=True)
        at = [i for i, name in enumerate(e.names) if name in self.places]
        omega, extra = self._priors(deleted)
        redundancy = a.redundancy + extra
        trace = a.variance_factor * float(np.einsum("nii->", a.point_cofactors)) if self.with_trace else None
        # An a-priori value of a deleted parameter still is an observation, whose residual is its distance from zero.
        fitted = Fitted(a.objective + omega, a.count + extra, redundancy, trace, check_rms(a.network, a.aside))
        with threadpool_limits(limits=1, user_api="blas"):
            entering = self._entering(a, deleted, fitted)
        names = tuple(e.names[i] for i in at)
        return Fit(names, e.values[at], e.cofactors[np.ix_(at, at)], a.numbering.count, fitted, entering, a)

    def _network(self, deleted: frozenset[str], warm: Network | None = None) -> Network:
        """Return the network with these parameters fixed at zero, at the values found last."""
        source = self.base if warm is None else replace(warm, assumptions=self.base.assumptions)
        cameras = list(source.cameras)
        for i, c in enumerate(self.base.cameras):
            states, values = np.array(c.states), np.array(cameras[i].values)
            for name in deleted:
                j, k = self.places[name]
                if j == i:
                    states[k], values[k] = FIXED, 0.0
            cameras[i] = replace(cameras[i], states=states, values=values)
        return replace(source, cameras=tuple(cameras))

    def _priors(self, deleted: frozenset[str]) -> tuple[float, int]:
        """Return v'Pv and number of the a-priori values of deleted parameters."""
        omega, count = 0.0, 0
        for name in sorted(deleted):
            i, k = self.places[name]
            c = self.base.cameras[i]
            if c.states[k] == OBSERVED:
                omega += float((c.prior[k] / c.sigmas[k]) ** 2)
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
            i, k = self.places[name]
            c = self.base.cameras[i]
            weight = pulled = 0.0
            if c.states[k] == OBSERVED:
                weight, pulled = float(c.sigmas[k] ** -2), float(c.prior[k] / c.sigmas[k] ** 2)
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
    """Drop the insignificant additional parameters of all cameras, one by one, and adjust again each time.

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
