"""The law of errors of an adjustment: its residuals studied with null laws through the design matrix, and what the law means for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from baarda.adjustment import Adjustment
from baarda.distributions.base import Floats
from baarda.errors import UsageError
from baarda.hypotheses.levels import Options
from baarda.procedures.error_law import LEAST_BEYOND, CriticalValues, critical_values, statistics_of
from baarda.procedures.law_bootstrap import ResidualsOf
from baarda.procedures.law_study import LawsStudied, StudyOptions, study_laws
from baarda.procedures.residual_study import ScaleRule, scale_rules

FEWEST = 20  # residuals for a comparison of laws
NUMBERS = 6e4  # errors simulated for each law: 999 replicas up to 60 residuals, 99 from 600 on
MOST_NUMBERS = 2e6  # beyond 20 000 residuals 99 replicas take too long: null laws for independent values alone
CRITICAL_NUMBERS = 1e6  # errors simulated for critical values
MOST_CRITICAL_NUMBERS = 1e7
_LEAST, _MOST = 99, 999
_LEAST_CRITICAL, _MOST_CRITICAL = 200, 2000
_OTHERS = 0x6F7468657273  # stream of the errors of observations that are not studied

Ints = NDArray[np.intp]


@dataclass(frozen=True)
class AdjustmentLaws:
    """The laws of errors compared on the residuals of an adjustment.

    Attributes
    ----------
    options : StudyOptions
    values : (n,) array
        Residuals, each divided by its own standard deviation (tau).
    rows : (n,) integer array
        Their observations.
    what : str
        Which observations these are, in words.
    laws : LawsStudied
    scale_rules : tuple of ScaleRule
        The normal law with the standard deviation by each rule.
    critical : CriticalValues or None
        Critical values of w and tau and the minimal detectable bias under the modulated normal law of the errors.
    left_out : tuple of (str, str)
        What could not be done, and why.
    """

    options: StudyOptions
    values: Floats
    rows: Ints
    what: str
    laws: LawsStudied
    scale_rules: tuple[ScaleRule, ...]
    critical: CriticalValues | None
    left_out: tuple[tuple[str, str], ...] = ()


def study_adjustment(adjustment: Adjustment, tau: Floats, options: Options) -> AdjustmentLaws | None:
    """Study the law of errors of an adjustment by least squares.

    Parameters
    ----------
    adjustment : Adjustment
    tau : (n,) array
        Pope's tau of all observations, NaN where uncontrolled.
    options : Options
        Levels and seed.

    Returns
    -------
    AdjustmentLaws or None
        None where fewer than 20 residuals are controlled, or all are equal.

    Notes
    -----
    Studied are the residuals of image coordinates, or of all observations where there are few of these. The null laws take errors of each
    fitted law for them and normal ones for the others, map them through the design matrix, and divide by s0 sqrt(q) of the replica: exact
    for normal errors. The critical values take the a of the errors by the kurtosis relation through Qvv.
    """
    rows, what = _studied(adjustment, tau)
    values = tau[rows]
    if len(rows) < FEWEST or np.ptp(values) == 0.0:
        return None
    replicas = int(np.clip(NUMBERS // len(values), _LEAST, _MOST))
    o = StudyOptions(alpha=options.alpha, loc=0.0, replicas=replicas, seed=options.seed, numbers=MOST_NUMBERS)
    with threadpool_limits(limits=1, user_api="blas"):
        laws = study_laws(values, o, residuals_of(adjustment, rows, options.seed))
    base, share = (adjustment.residuals / adjustment.sigmas)[rows], adjustment.controlled_share[rows]
    rules, why = scale_rules(base, values, float(share.sum()), replace(o, classes="equal_probability"))
    left_out = [*laws.left_out, *why]
    critical = None
    try:
        critical = _critical(adjustment, options)
    except UsageError as error:
        left_out.append(("critical values under the law of errors", str(error)))
    return AdjustmentLaws(o, values, rows, what, laws, rules, critical, tuple(left_out))


def _studied(adjustment: Adjustment, tau: Floats) -> tuple[Ints, str]:
    images = np.isfinite(tau) & (np.asarray(adjustment.evidence.images) >= 0)
    if images.sum() >= FEWEST:
        return np.flatnonzero(images), "image coordinates"
    return np.flatnonzero(np.isfinite(tau)), "all observations"


def residuals_of(adjustment: Adjustment, rows: Ints, seed: int = 0) -> ResidualsOf:
    """Return the map from errors of some observations, (k, B), to their residuals divided by s0 sqrt(q) of each replica, (k, B).

    Parameters
    ----------
    adjustment : Adjustment
    rows : (k,) integer array
        The observations; the others get normal errors.
    seed : int
        Of those.

    Returns
    -------
    callable
    """
    statistics = statistics_of(adjustment)
    n = adjustment.count
    others = np.setdiff1d(np.arange(n), rows)

    def mapped(errors: Floats) -> Floats:
        white = np.empty((n, errors.shape[1]))
        white[rows] = errors
        if len(others):
            white[others] = np.random.default_rng([seed, _OTHERS]).standard_normal((errors.shape[1], len(others))).T
        w, vpv = statistics(white)
        return np.asarray(w[rows] / np.sqrt(vpv / adjustment.redundancy))

    return mapped


def _critical(adjustment: Adjustment, o: Options) -> CriticalValues:
    n = int(np.sum(adjustment.controlled_share > 0.0))
    least = max(_LEAST_CRITICAL, int(np.ceil(LEAST_BEYOND / (o.alpha_outlier * n))) + 1)
    replicas = max(least, int(np.clip(CRITICAL_NUMBERS // n, _LEAST_CRITICAL, _MOST_CRITICAL)))
    if replicas * n > MOST_CRITICAL_NUMBERS:
        raise UsageError(f"{n} observations at level {o.alpha_outlier:g} are too many to simulate; baarda.procedures.error_law does it")
    seed, power = o.seed, o.power
    return critical_values(adjustment, "modulated_normal", o.alpha_outlier, replicas, seed, family_alpha=o.alpha, power=power)
