"""An adjustment joined with its tests: what the report and the result folder lay out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment
from baarda.adjustment.parameter_hypotheses import Collinearity, collinearity
from baarda.adjustment.robust import NOT_APPLICABLE
from baarda.distributions.fitting import Fit
from baarda.hypotheses import run
from baarda.hypotheses.base import Evidence, TestResult
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import TauLaw, external_reliability, mdb, standardised, tau
from baarda.network import Table
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
    """

    adjustment: Adjustment
    options: Options
    tests: tuple[TestResult, ...]
    strategy: Strategy | None = None
    components: VarianceComponents | None = None
    audit: Audit | None = None

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


def analyse(adjustment: Adjustment, options: Options | None = None) -> Analysis:
    """Test an adjustment.

    Parameters
    ----------
    adjustment : Adjustment
    options : Options, optional

    Returns
    -------
    Analysis
        Without tests when the adjustment did not converge.
    """
    options = Options() if options is None else options
    if adjustment.status != "converged":
        return Analysis(adjustment, options, ())
    evidence = adjustment.evidence
    applicable = NOT_APPLICABLE if adjustment.law is not None else {}
    tests = tuple(t for t in run(evidence, options) if t.name not in applicable)
    return Analysis(adjustment, options, tests)


def test(adjustment: Adjustment, **options: Any) -> list[TestResult]:
    """Return all tests of an adjustment; the keywords are the fields of `baarda.hypotheses.levels.Options`."""
    return list(analyse(adjustment, Options(**options)).tests)


test.__test__ = False  # type: ignore[attr-defined]
