"""An adjustment joined with its tests: what the report and the result folder lay out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment
from baarda.adjustment.robust import NOT_APPLICABLE
from baarda.distributions.comparison import compare_laws
from baarda.distributions.fitting import Fit
from baarda.hypotheses import run
from baarda.hypotheses.base import Evidence, TestResult
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import TauLaw, external_reliability, mdb, standardised, tau
from baarda.network import Table

Floats = NDArray[np.float64]
FEWEST = 20  # residuals for a comparison of laws


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
    laws : tuple of Fit
        Laws compared on residuals standardised by their own sigma.
    """

    adjustment: Adjustment
    options: Options
    tests: tuple[TestResult, ...]
    laws: tuple[Fit, ...]

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
        more = {
            "w": self.w,
            "tau": self.tau,
            "mdb": mdb(share / np.where(seen, pqvvp, 1.0), share, e.sigma0_apriori, o.alpha_outlier, o.power),
            "external": external_reliability(np.where(np.abs(share - 1.0) < 1e-12, 1.0, share), o.alpha_outlier, o.power),
            "estimated_error": np.divide(-pv, pqvvp, out=np.full(len(pv), np.nan), where=seen),
            "p_value": 2.0 * np.asarray(law.sf(np.abs(statistic))),
        }
        return Table({**self.adjustment.observations.columns, **more}, self.adjustment.observations.units)

    @cached_property
    def law_values(self) -> Floats:
        """Residuals on which laws are compared: those of image points (of all observations, if there are none), divided by their sigmas."""
        values = self.tau
        images = np.isfinite(values) & (np.asarray(self.evidence.images) >= 0)
        return values[images] if images.sum() >= FEWEST else values[np.isfinite(values)]

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
        return Analysis(adjustment, options, (), ())
    evidence = adjustment.evidence
    applicable = NOT_APPLICABLE if adjustment.law is not None else {}
    tests = tuple(t for t in run(evidence, options) if t.name not in applicable)
    result = Analysis(adjustment, options, tests, ())
    return Analysis(adjustment, options, tests, _laws(result))


def _laws(analysis: Analysis) -> tuple[Fit, ...]:
    """Compare laws on standardised residuals, where there are enough."""
    values = analysis.law_values
    return compare_laws(values, loc=0.0, scale=1.0, alpha=analysis.options.alpha) if len(values) >= FEWEST else ()


def test(adjustment: Adjustment, **options: Any) -> list[TestResult]:
    """Return all tests of an adjustment; the keywords are the fields of `baarda.hypotheses.levels.Options`."""
    return list(analyse(adjustment, Options(**options)).tests)


test.__test__ = False  # type: ignore[attr-defined]
