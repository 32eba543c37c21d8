"""An adjustment joined with its tests: what the report and the result folder lay out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment
from baarda.adjustment.parameter_hypotheses import Collinearity, collinearity
from baarda.adjustment.robust import ENOUGH, NOT_APPLICABLE, NOT_APRIORI, NOT_CHECKED, NOT_ENOUGH, LawOfErrors
from baarda.distributions.fitting import Fit
from baarda.hypotheses import run
from baarda.hypotheses._simulation import affordable
from baarda.hypotheses.base import Evidence, TestResult
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import TauLaw, external_reliability, mdb, standardised, tau
from baarda.network import Table
from baarda.observations import CorrelatedPoints, Direct, Distances
from baarda.procedures.adjustment_laws import AdjustmentLaws, study_adjustment
from baarda.procedures.external_reliability import external_effects

if TYPE_CHECKING:
    from baarda.procedures.audit import Audit
    from baarda.procedures.strategy import Strategy
    from baarda.procedures.variance_components import VarianceComponents

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Analysis:
    """An adjustment with everything that was tested.

    Attributes
    ----------
    adjustment : Adjustment
    options : Options
        Levels and choices.
    tests : tuple of TestResult
        Empty when the adjustment did not converge.
    strategy : Strategy or None
        What procedures around the adjustment did: snooping, selection, cross-validation.
    components : VarianceComponents or None
        Variances of groups of observations, estimated before the adjustment.
    audit : Audit or None
        The solution of the source as it stands.
    not_applicable : mapping of str to str
        What is not judged under a law of errors, by the name of the test, and why; empty for least squares.
    """

    adjustment: Adjustment
    options: Options
    tests: tuple[TestResult, ...]
    strategy: Strategy | None = None
    components: VarianceComponents | None = None
    audit: Audit | None = None
    not_applicable: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def study(self) -> AdjustmentLaws | None:
        """Laws of errors compared on residuals divided by their own sigmas: simulated when first asked for.

        None where nothing was tested, under a law of errors, and with fewer than 20 residuals.
        """
        if not self.tests or self.adjustment.law is not None:
            return None
        return study_adjustment(self.adjustment, self.tau, self.options)

    @property
    def laws(self) -> tuple[Fit, ...]:
        """The laws fitted to the residuals."""
        return () if self.study is None else tuple(s.fit for s in self.study.laws.laws)

    @property
    def converged(self) -> bool:
        """Whether the adjustment converged; without it nothing is tested."""
        return self.adjustment.status == "converged"

    def tests_named(self, name: str) -> list[TestResult]:
        """Return the tests of this name."""
        return [t for t in self.tests if t.name == name]

    @cached_property
    def evidence(self) -> Evidence:
        """The evidence that was tested."""
        return self.adjustment.evidence

    @cached_property
    def collinearity(self) -> Collinearity | None:
        """How well the camera parameters can be told apart; None where none is estimated."""
        return collinearity(self.adjustment)

    @cached_property
    def w(self) -> Floats:
        """Baarda's w of every observation, a priori sigma0; NaN where uncontrolled, and under a law of errors other than the normal."""
        e = self.evidence
        if e.pv is None:
            return np.full(len(e.residuals), np.nan)
        return standardised(_present(e.pv), _present(e.pqvvp), e.sigma0_apriori, self.adjustment.controlled_share)

    @cached_property
    def tau(self) -> Floats:
        """Pope's tau of every observation, a posteriori s0; NaN where uncontrolled, and under a law of errors other than the normal."""
        e = self.evidence
        if e.pv is None:
            return np.full(len(e.residuals), np.nan)
        return tau(_present(e.pv), _present(e.pqvvp), e.variance_factor, self.adjustment.controlled_share)

    @cached_property
    def observations(self) -> Table:
        """The observation table with w, tau, mdb, external reliability, estimated error and the p-value of the test that judges."""
        from scipy import stats

        e, o = self.evidence, self.options
        if e.pv is None:
            none = np.full(len(e.residuals), np.nan)
            table = self.adjustment.observations
            return Table(
                {**table.columns, **dict.fromkeys(("w", "tau", "mdb", "external", "estimated_error", "p_value"), none)}, table.units
            )
        share = self.adjustment.controlled_share
        statistic, law = (self.tau, TauLaw(e.redundancy)) if o.sigma == "aposteriori" else (self.w, stats.norm())
        pv, pqvvp = _present(e.pv), _present(e.pqvvp)
        seen = np.isfinite(statistic)
        smallest = mdb(share / np.where(seen, pqvvp, 1.0), share, e.sigma0_apriori, o.alpha_outlier, o.power)
        effects = external_effects(self.adjustment, smallest)
        more = {
            "w": self.w,
            "tau": self.tau,
            "mdb": smallest,
            "external": external_reliability(np.where(np.abs(share - 1.0) < 1e-12, 1.0, share), o.alpha_outlier, o.power),
            "estimated_error": np.divide(-pv, pqvvp, out=np.full(len(pv), np.nan), where=seen),
            "p_value": 2.0 * np.asarray(law.sf(np.abs(statistic))),
            "effect": effects.values,
            "effect_on": effects.names,
        }
        return Table({**self.adjustment.observations.columns, **more}, self.adjustment.observations.units)

    @cached_property
    def suspected(self) -> NDArray[np.intp]:
        """Rows of the observations that the outlier test rejects, the worst first."""
        found = self.tests_named("data_snooping")
        if not found:
            return np.zeros(0, dtype=np.intp)
        rows = np.flatnonzero(found[0].rejected)
        return rows[np.argsort(-np.abs(np.asarray(found[0].statistic)[rows]), kind="stable")]

    @cached_property
    def gates(self) -> dict[str, bool]:
        """The gates of ``--strict``: True where the test was done and rejects."""
        names = ("global_variance_factor", "data_snooping", "check_points", "control_points")
        return {n: any(bool(np.any(t.rejected)) for t in self.tests_named(n)) for n in names if self.tests_named(n)}


def _present(values: Floats | None) -> Floats:
    if values is None:
        raise ValueError("an adjustment yields all evidence")
    return values


def analyse(adjustment: Adjustment, options: Options | None = None, progress: Callable[[int, int], None] | None = None) -> Analysis:
    """Test an adjustment.

    Parameters
    ----------
    adjustment : Adjustment
    options : Options, optional
    progress : callable, optional
        Called with the numbers of simulated data sets that are done and in all, 0 done first.

    Returns
    -------
    Analysis
        Without tests when the adjustment did not converge.
    """
    options = Options() if options is None else options
    if adjustment.status != "converged":
        return Analysis(adjustment, options, ())
    evidence = adjustment.evidence if progress is None else _counted(adjustment.evidence, options, progress)
    if adjustment.law is None:
        return Analysis(adjustment, options, tuple(run(evidence, options)))
    made = run(evidence, replace(options, replicas=1))  # the tests that simulate are those of residuals: none of them is kept
    reasons = _reasons(adjustment, adjustment.law, dict.fromkeys(t.name for t in made), options)
    return Analysis(adjustment, options, tuple(t for t in made if t.name not in reasons), not_applicable=reasons)


def _reasons(adjustment: Adjustment, law: LawOfErrors, made: Iterable[str], options: Options) -> dict[str, str]:
    """Return what is not judged under the law of errors of an adjustment, as far as the network has it, and why."""
    images, groups = adjustment.evidence.images, adjustment.groups
    several = images is not None and len(np.unique(images[images >= 0])) > 1
    control = any(isinstance(g, CorrelatedPoints) or (isinstance(g, Direct) and g.kind == "point") for g in groups)
    absent = [] if several else ["bartlett_images", "variance_per_image"]
    absent += [] if control else ["control_points", "control_point"]
    absent += [] if any(isinstance(g, Distances) for g in groups) else ["vdi_vde_2634"]
    reasons = {name: why for name, why in NOT_APPLICABLE.items() if name not in absent}
    for name in made:
        if name in NOT_APPLICABLE:
            continue
        if options.sigma == "apriori":
            reasons[name] = NOT_APRIORI
        elif law.resistance == "redescending" and name.startswith("check_"):
            reasons[name] = NOT_CHECKED
        elif law.resistance == "redescending" and law.redundancy_share < ENOUGH:
            reasons[name] = NOT_ENOUGH
    return reasons


def _counted(evidence: Evidence, options: Options, progress: Callable[[int, int], None]) -> Evidence:
    """Return the evidence with a map from errors to residuals that tells how many data sets have gone through it."""
    mapped, total, done = evidence.residuals_of, affordable(evidence, options), 0
    if mapped is None or total == 0:
        return evidence

    def told(errors: Floats) -> Floats:
        nonlocal done
        if done < total:  # tests simulate all of them in one pass; what one of them asks for beyond it is not counted
            progress(done, total)
        done += errors.shape[1]
        return mapped(errors)

    return replace(evidence, residuals_of=told)


def test(adjustment: Adjustment, **options: Any) -> list[TestResult]:
    """Return all tests of an adjustment; the keywords are the fields of `baarda.hypotheses.levels.Options`."""
    return list(analyse(adjustment, Options(**options)).tests)


test.__test__ = False  # type: ignore[attr-defined]
