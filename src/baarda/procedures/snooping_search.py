"""The search of data snooping: adjust, suspect, remove or keep, restore."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment import Adjustment, adjust
from baarda.adjustment.solve import Settings, prepare
from baarda.cameras import FREE
from baarda.distributions.base import Distribution
from baarda.errors import BaardaError, UsageError
from baarda.hypotheses.levels import Options, baarda_level, single_level
from baarda.hypotheses.outliers import UNCONTROLLED, delta0, externally_studentised
from baarda.hypotheses.separability import separable_delta, wrong_choice
from baarda.network import Network, Table
from baarda.observations import component_unit
from baarda.procedures.error_law import critical_values
from baarda.procedures.removal import Key, Predicted, keys_of, predict, without
from baarda.procedures.snooping_steps import Snooping, SnoopStep
from baarda.procedures.suspicion import Judged, Unit, cofactor_column, judge

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Told = Callable[[str], None]

ALIKE = 1e-9  # statistics whose |correlation| is 1 up to this cannot be told apart


class Search:
    """The state of one search."""

    def __init__(self, base: Network, options: Options, unit: Unit, settings: Mapping[str, Any], tell: Told | None, most: float) -> None:
        self.base, self.o, self.unit, self.settings, self.tell, self.most = base, options, unit, dict(settings), tell, most
        self.removed: list[tuple[Key, ...]] = []
        self.refused: dict[tuple[Key, ...], str] = {}
        self.restored: set[tuple[Key, ...]] = set()
        self.steps: list[SnoopStep] = []
        self.start = "least squares"
        self.first, self.keys = self._adjust([])
        self.a = self.first
        self.limit = int(most * self.first.count)
        self.law: Distribution | None = None
        self.limits: dict[Key, float] = {}

    def need_convergence(self) -> None:
        """Refuse an adjustment that did not converge."""
        if self.a.status != "converged":
            raise UsageError(f"the adjustment did not converge: observations cannot be judged; {self.a.contradictions()}")

    def use_law(self, law: str | Distribution) -> None:
        """Find critical values under a law of errors, fitted to the residuals of the first adjustment where its shape is not given."""
        count = int((self.a.controlled_share >= UNCONTROLLED).sum())
        alpha = self.o.alpha_outlier
        if self.o.levels not in ("none", "baarda"):
            alpha = single_level(self.o.alpha, count, self.o.levels)
        found = critical_values(self.a, law, alpha, seed=self.o.seed)
        self.law = found.law
        aposteriori = self.o.sigma == "aposteriori"
        values = np.array([*((c.tau if aposteriori else c.w).value for c in found.classes), np.inf])
        self.limits = {key: float(v) for key, v in zip(map(_key, self.keys), values[found.members], strict=True)}

    def _judge(self) -> Judged:
        judged = judge(self.a, self.unit, self.o)
        if self.law is None:
            return judged
        limits = np.array([self.limits.get(_key(self.keys[rows[0]]), np.inf) if len(rows) == 1 else np.inf for rows in judged.rows])
        nothing = np.full(len(limits), np.nan)
        return replace(judged, limits=limits, p_value=nothing)

    # ---- adjusting ----
    def _adjust(self, removed: list[tuple[Key, ...]], warm: Adjustment | None = None) -> tuple[Adjustment, Ints]:
        network, keys = self._network(removed, warm)
        a = adjust(network, **self.settings)
        return a, keys_of(a, keys)

    def _network(self, removed: list[tuple[Key, ...]], warm: Adjustment | None) -> tuple[Network, list[Ints]]:
        source = self.base
        if warm is not None:  # values of the adjustment before, states and given values of the base
            net = warm.network
            cameras = tuple(c.with_values(v.values) for c, v in zip(self.base.cameras, net.cameras, strict=True))
            images = replace(self.base.images, position=net.images.position, rotation=net.images.rotation)
            points = replace(self.base.points, coordinates=net.points.coordinates)
            source = replace(self.base, cameras=cameras, images=images, points=points, declared=net.declared)
        return without(source, (key for u in removed for key in u))

    def _try(self, removed: list[tuple[Key, ...]]) -> tuple[Adjustment, Ints] | str:
        """Adjust without some units; where that undermines the network, return why."""
        network, _ = self._network(removed, self.a)
        try:
            aside = prepare(network, Settings.of(network, self.settings))[1]
            unknown = (network.points.states == FREE).any(axis=1)  # a known point that nothing measures any more is no loss
            lost = np.flatnonzero(aside & ~self.first.aside & unknown)
            if len(lost):
                names = ", ".join(self.base.points.labels[i] for i in lost[:5])
                return f"point {names} would no longer be determined by enough whole image points"
            a, keys = self._adjust(removed, self.a)
        except BaardaError as error:
            return f"without it the network would not be determined: {error}"
        if a.datum.defect.count != self.first.datum.defect.count:
            return "without it the datum would not be defined"
        if a.status != "converged":
            return "the adjustment without it does not converge"
        return a, keys

    def rows_of_units(self) -> tuple[Ints, ...]:
        """Return the scalar rows of each unit of the current adjustment."""
        return judge(self.a, self.unit, self.o).rows

    def _names(self, rows: Ints) -> tuple[Key, ...]:
        return tuple(_key(k) for k in self.keys[rows])

    def begin(self, suspected: list[Ints], law: str) -> None:
        """Start without the units that a robust adjustment suspects, as far as the network stays determined."""
        self.start = law
        units = [self._names(rows) for rows in suspected]
        found = self._try(units) if units else ""
        kept: list[tuple[Key, ...]] = []
        if isinstance(found, str) and units:  # not all at once: one by one, the worst first
            for unit in units:
                trial = self._try([*kept, unit])
                if not isinstance(trial, str):
                    kept.append(unit)
                    self.a, self.keys = trial
        elif not isinstance(found, str):
            kept = units
            self.a, self.keys = found
        self.removed = kept
        self._say(f"robust start ({law}): {len(kept)} suspected, s0 = {self.a.sigma0:.4g}")
        while self._restore_many():  # observations that mask each other stay far from what the others predict
            self._say(f"robust start ({law}): {len(self.removed)} left, s0 = {self.a.sigma0:.4g}")

    def _restore_many(self) -> bool:
        """Restore all units of a robust start that are cleared; return whether any were."""
        values = self._cleared(self.removed)
        back = [u for u, margin in zip(self.removed, values, strict=True) if margin > 0.0]
        found = self._try([u for u in self.removed if u not in back]) if back else ""
        if isinstance(found, str):
            return False
        self.removed = [u for u in self.removed if u not in back]
        self.a, self.keys = found
        return True

    def _cleared(self, units: list[tuple[Key, ...]]) -> list[float]:
        """Return for each removed unit how clearly it is cleared by the prediction from the others: positive where it is."""
        if not units:
            return []
        p = predict(self.a, self.base, [k for u in units for k in u])
        at = np.cumsum([0, *(len(u) for u in units)])
        out = []
        for i, u in enumerate(units):
            statistic, value = self._p_predicted(p, np.arange(at[i], at[i + 1]))
            if self.law is None:
                out.append(value - self._restoring_level(len(u)))
            else:
                r = self.a.redundancy
                size = abs(statistic)
                if self.o.sigma == "aposteriori":  # t without it as tau with it
                    size *= np.sqrt((r + 1) / (r + size**2))
                out.append(1.0 - size / self.limits.get(u[0], np.inf))
        return out

    # ---- the loop ----
    def run(self) -> tuple[Snooping, Adjustment]:
        """Reject and restore until nothing changes; return the decisions and the last adjustment."""
        stopped = ""
        while not stopped:
            if self._reject_one():
                if sum(len(u) for u in self.removed) > self.limit:
                    stopped = (
                        f"More than {self.most:.0%} of the observations were rejected: these are no single gross errors. The model or the "
                        "a-priori sigmas are wrong, or the residuals are far from normal."
                    )
            elif not self._restore_one():
                left = len(self._judge().suspected)
                stopped = (
                    "No observation is suspected any more."
                    if not left
                    else f"{left} suspected observation(s) could not be removed: see there."
                )
        law = f"tau({self.a.redundancy})" if self.o.sigma == "aposteriori" else "N(0, 1)"
        if self.unit == "point":
            law = f"F(2, {self.a.redundancy - 2})" if self.o.sigma == "aposteriori" else "chi2(2)"
        if self.law is not None:
            values = ", ".join(f"{k} = {v:.4g}" for k, v in self.law.parameters.items() if k not in ("loc", "scale"))
            law = f"simulated under the {self.law.family} law of errors{', ' + values if values else ''}"
        alpha = self.o.alpha_outlier if self.o.levels in ("none", "baarda") else self.o.alpha
        found = Snooping(self.unit, tuple(self.steps), self._table(), (), alpha, self.o.levels, law, self.start, stopped)
        chosen = replace(self.a, start=self._start())
        if found.count:
            chosen = chosen.with_assumptions(f"{found.count} observation(s) were rejected by data snooping; see there.")
        return found, chosen

    def _start(self) -> Network:
        """Return the first start values on the final network."""
        first = self.first.start
        return replace(self.a.start, cameras=first.cameras, images=first.images, points=first.points)

    def _say(self, text: str) -> None:
        if self.tell is not None:
            self.tell(text)

    def _reject_one(self) -> bool:
        """Remove the worst suspected unit that can be removed; return whether one was."""
        judged = self._judge()
        for i in judged.suspected.tolist():
            rows = judged.rows[i]
            unit = self._names(rows)
            if unit in self.refused:
                continue
            told = self._describe(judged, i)
            found: tuple[Adjustment, Ints] | str
            if told["correlation"] is not None and 1.0 - abs(told["correlation"]) < ALIKE:
                found = f"it cannot be told from {told['partner']}: the statistics are equal whichever of both is wrong"
            else:
                found = self._try([*self.removed, unit])
            if isinstance(found, str):
                self.refused[unit] = found
                self._step("kept", told, f"Suspected, but kept: {found}.")
                continue
            self.removed.append(unit)
            self.a, self.keys = found
            self._step("rejected", told, "")
            return True
        return False

    def _restore_one(self) -> bool:
        """Restore the removed unit that is cleared most clearly, each at most once; return whether one was."""
        open_units = [u for u in self.removed if u not in self.restored]
        if not open_units:
            return False
        values = self._cleared(open_units)
        best = max(range(len(open_units)), key=lambda i: values[i])
        if values[best] <= 0.0:
            return False
        unit = open_units[best]
        found = self._try([u for u in self.removed if u != unit])
        self.restored.add(unit)
        if isinstance(found, str):
            return True
        p = predict(self.a, self.base, unit)
        rows = np.arange(len(unit))
        statistic, value = self._p_predicted(p, rows)
        j = int(rows[0])
        labels = self.base.images.labels, self.base.points.labels
        told = {
            "group": p.groups[j],
            "image": labels[0][p.images[j]] if p.images[j] >= 0 else "",
            "point": labels[1][p.points[j]] if p.points[j] >= 0 else "",
            "component": p.components[j] if len(rows) == 1 else "",
            "statistic_name": ("t" if self.o.sigma == "aposteriori" else "w") if len(rows) == 1 else "F",
            "statistic": statistic,
            "p_value": value,
            "level": self._restoring_level(len(unit)),
            "limit": self.limits.get(unit[0]),
            "studentised": None,
            "estimated_error": -float(p.residuals[j]) if len(rows) == 1 else None,
            "unit": p.units[j],
            "redundancy_number": None,
            "partner": "",
            "correlation": None,
            "wrong_choice": None,
            "separable_bias": None,
            "suspected": 0,
        }
        self.removed.remove(unit)
        self.a, self.keys = found
        self._step("restored", told, "Cleared: it agrees with the prediction from the others.")
        return True

    def _restoring_level(self, m: int) -> float:
        if self.o.levels == "baarda":
            return baarda_level(m, self.o.alpha_outlier, self.o.power)
        return float(judge(self.a, self.unit, self.o).level[0]) if self.o.levels != "none" else self.o.alpha_outlier

    def _p_predicted(self, p: Predicted, rows: Ints) -> tuple[float, float]:
        """Return the statistic of removed observations (signed t or w of one, else F) and its p-value."""
        m = len(rows)
        d, q = p.residuals[rows], p.cofactors[np.ix_(rows, rows)]
        form = float(d @ np.linalg.solve(q, d))
        if self.o.sigma == "aposteriori":
            f = form / m / self.a.variance_factor
            value = float(stats.f.sf(f, m, self.a.redundancy))
        else:
            f = form / m
            value = float(stats.chi2.sf(form, m))
        return (float(np.sign(d[0]) * np.sqrt(f)) if m == 1 else f), value

    # ---- telling ----
    def _describe(self, judged: Judged, i: int) -> dict[str, Any]:
        """Tell what is suspected, how strongly, and from which other observation it is hardest to tell apart."""
        a, rows = self.a, judged.rows[i]
        o = a.observations
        row = int(rows[0]) if len(rows) == 1 else int(rows[np.argmax(np.abs(a.residuals[rows] / a.sigmas[rows]))])
        single = len(rows) == 1
        sign = float(np.sign(a.residuals[row]))
        value = sign * float(np.sqrt(judged.statistic[i])) if single else float(judged.statistic[i])
        column = cofactor_column(a, row)
        own = float(column[row])
        share = float(a.controlled_share[row])
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = column / np.sqrt(own * a.pqvvp)
        rho[rows] = 0.0
        rho[a.controlled_share < UNCONTROLLED] = 0.0
        other = int(np.argmax(np.abs(rho)))
        correlation = float(np.clip(rho[other], -1.0, 1.0))
        error = -float(a.pv[row]) / own
        aposteriori = self.o.sigma == "aposteriori"
        known = delta0(self.o.alpha_outlier, self.o.power)
        name = (
            ("tau" if aposteriori else "w") if single else (f"F-type of {len(rows)}" if aposteriori else f"chi2({len(rows)}) / {len(rows)}")
        )
        studentised = None
        if single and aposteriori and a.redundancy > 1:
            t = float(externally_studentised([value], a.redundancy)[0])
            studentised = t if np.isfinite(t) else None
        # the shift of w that an error of the estimated size means
        shift = abs(error) * np.sqrt(own)
        bias = max(separable_delta(correlation, min(1.0 - self.o.power, 0.499)), 0.0) / np.sqrt(own)
        return {
            "group": str(o["group"][row]),
            "image": str(o["image"][row]),
            "point": str(o["point"][row]),
            "component": str(o["component"][row]) if single else "",
            "statistic_name": name,
            "statistic": value,
            "p_value": float(judged.p_value[i]),
            "level": float(judged.level[i]),
            "limit": None if judged.limits is None else float(judged.limits[i]),
            "studentised": studentised,
            "estimated_error": error if single else None,
            "unit": self._unit_of(row),
            "redundancy_number": share if single else None,
            "partner": " ".join(t for t in (str(o["image"][other]), str(o["point"][other]), str(o["component"][other])) if t),
            "correlation": correlation,
            "wrong_choice": float(wrong_choice(correlation, max(shift, known))) if single else None,
            "separable_bias": float(bias) if single else None,
            "suspected": len(judged.suspected),
        }

    def _unit_of(self, row: int) -> str:
        g = int(np.searchsorted(self.a.offsets, row, side="right")) - 1
        group = self.a.groups[g]
        return component_unit(group, (row - int(self.a.offsets[g])) % len(group.components))

    def _step(self, action: str, told: dict[str, Any], note: str) -> None:
        step = SnoopStep(step=len(self.steps) + 1, action=action, sigma0=self.a.sigma0, redundancy=self.a.redundancy, note=note, **told)
        self.steps.append(step)
        place = " ".join(t for t in (step.image, step.point, step.component) if t)
        self._say(f"{action:<8} {place}  {step.statistic_name} = {step.statistic:.2f}  s0 = {step.sigma0:.5g}")

    def _table(self) -> Table | None:
        """Return the observations that stay out, with what the adjustment without them predicts."""
        if not self.removed:
            return None
        p = predict(self.a, self.base, [k for u in self.removed for k in u])
        q = np.diagonal(p.cofactors)
        images = np.array([*self.base.images.labels, ""], dtype=object)
        points = np.array([*self.base.points.labels, ""], dtype=object)
        t = p.residuals / np.sqrt(q * self.a.variance_factor)
        n = np.full(len(q), np.nan)
        aposteriori = self.o.sigma == "aposteriori"
        w = p.residuals / np.sqrt(q)
        value = 2.0 * (stats.t.sf(np.abs(t), self.a.redundancy) if aposteriori else stats.norm.sf(np.abs(w)))
        return Table(
            {
                "group": np.array(p.groups, dtype=object),
                "image": images[p.images],
                "point": points[p.points],
                "component": np.array(p.components, dtype=object),
                "observed": p.observed,
                "sigma": p.sigmas,
                "residual": p.residuals,
                "redundancy": n,
                "w": w,
                "tau": n,
                # the bias of an observation left out that the prediction detects
                "mdb": delta0(self.o.alpha_outlier, self.o.power) * np.sqrt(q),
                "external": np.zeros(len(q)),
                "estimated_error": -p.residuals,
                "p_value": np.asarray(value),
            }
        )


def _key(values: Ints) -> Key:
    return (int(values[0]), int(values[1]), int(values[2]))
