"""The result of fitting a law: `Fit`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy import special

from baarda.distributions.base import Distribution
from baarda.distributions.histogram import Histogram

Rule = Literal["maximum_likelihood", "moments", "minimum_chi2", "grouped_likelihood"]


@dataclass(frozen=True)
class Fit:
    """A law fitted to data.

    Attributes
    ----------
    law : str
        Name of the law.
    distribution : Distribution
        The law with its values.
    rule : str
        How they were found.
    estimated : tuple of str
        Names of the parameters that were estimated; the others were given.
    n : int
        Number of values.
    log_likelihood : float or None
        Of the values (of the class counts for `grouped_likelihood`); None where only classes are known and another rule was used.
    standard_errors : mapping
        Standard error of each estimated parameter; None where it is on a bound or the rule gives none.
    histogram : Histogram or None
        Classes with observed and expected counts, when a chi-square was asked for.
    df : int or None
        Degrees of freedom of the chi-square: classes - 1 - estimated parameters.
    alpha : float
        Level of the chi-square test.
    at_bounds : tuple of str
        Parameters whose estimate is a bound of their range (a = inf: the normal law fits best).
    notes : tuple of str
        What the reader must know.
    """

    law: str
    distribution: Distribution
    rule: str
    estimated: tuple[str, ...]
    n: int
    log_likelihood: float | None = None
    standard_errors: Mapping[str, float | None] = field(default_factory=dict)
    histogram: Histogram | None = None
    df: int | None = None
    alpha: float = 0.05
    at_bounds: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """All parameters of the law by name."""
        return self.distribution.parameters

    @property
    def aic(self) -> float | None:
        """Akaike's criterion 2k - 2 log L."""
        return None if self.log_likelihood is None else 2.0 * len(self.estimated) - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float | None:
        """Schwarz's criterion k log n - 2 log L."""
        return None if self.log_likelihood is None else len(self.estimated) * float(np.log(self.n)) - 2.0 * self.log_likelihood

    @property
    def statistic(self) -> float | None:
        """The chi-square on classes."""
        return None if self.histogram is None else self.histogram.chi_square

    @property
    def p_value(self) -> float | None:
        """Exceedance probability of the chi-square with `df` degrees of freedom; None without any."""
        if self.histogram is None or not self.df or self.df < 1:
            return None
        return float(special.chdtrc(self.df, self.histogram.chi_square))

    @property
    def critical(self) -> float | None:
        """The limit of the chi-square at level `alpha`."""
        return None if self.df is None or self.df < 1 else float(special.chdtri(self.df, self.alpha))

    @property
    def rejected(self) -> bool | None:
        """Whether the chi-square test rejects the law at level `alpha`."""
        return None if self.p_value is None else bool(self.p_value < self.alpha)

    def as_dict(self) -> dict[str, Any]:
        """Return the row of `laws` in `result.json`; infinite parameters as None."""
        return {
            "law": self.law,
            "rule": self.rule,
            "parameters": {k: v if np.isfinite(v) else None for k, v in self.parameters.items()},
            "statistic": self.statistic,
            "df": self.df,
            "critical": self.critical,
            "p_value": self.p_value,
            "rejected": self.rejected,
            "log_likelihood": self.log_likelihood,
            "aic": self.aic,
            "bic": self.bic,
        }
