"""Many independent sets at once, each with its own adjustment: homogeneity between the sets, and a study of all residuals together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment import Adjustment, adjust
from baarda.errors import BaardaError, UsageError
from baarda.hypotheses import Evidence
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.homogeneity import bartlett
from baarda.network import Network, Table
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.residual_study import ResidualStudy
from baarda.procedures.residual_study import study as study_residuals

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SetResiduals:
    """Residuals of all sets, and the maps from errors to residuals.

    Attributes
    ----------
    labels : tuple of str
        Names of the sets.
    residuals : (n,) array
        V, in the unit of the observations.
    sets : (n,) int array
        Set of each residual.
    redundancies : (k,) int array
        r of each set.
    projectors : tuple of arrays
        R = Qvv P of each set: v = -R e.
    """

    labels: tuple[str, ...]
    residuals: Floats
    sets: NDArray[np.intp]
    redundancies: NDArray[np.intp]
    projectors: tuple[Floats, ...]

    @cached_property
    def shares(self) -> Floats:
        """Redundancy numbers R_ii, for equal weights the cofactors of the residuals."""
        return np.concatenate([np.diag(r) for r in self.projectors])

    @cached_property
    def fourth(self) -> Floats:
        """Sum over j of R_ij^4, for each residual."""
        return np.concatenate([np.sum(r**4, axis=1) for r in self.projectors])

    @property
    def redundancy(self) -> int:
        """Sum of the redundancies."""
        return int(self.redundancies.sum())

    @cached_property
    def variances(self) -> Floats:
        """S_i^2 = V'V / r of each set, in the unit of the observations squared."""
        return np.bincount(self.sets, self.residuals**2) / self.redundancies

    @property
    def sigma0(self) -> float:
        """The pooled S_o."""
        return float(np.sqrt(self.residuals @ self.residuals / self.redundancy))

    @property
    def standardised(self) -> Floats:
        """V / (S_o sqrt(q))."""
        return np.asarray(self.residuals / (self.sigma0 * np.sqrt(self.shares)))

    def residuals_of(self, errors: Floats) -> Floats:
        """Map errors (n, B) to residuals -R e, (n, B), set by set."""
        ends = np.cumsum([len(r) for r in self.projectors])
        return np.concatenate([-(r @ e) for r, e in zip(self.projectors, np.split(errors, ends[:-1]), strict=True)])

    def evidence_of(self, sigma: float) -> Evidence:
        """Return what tests through Qvv need, for an a-priori standard deviation of the observations."""
        return Evidence(
            residuals=self.residuals,
            sigmas=np.full(len(self.residuals), sigma),
            vpv=float(self.residuals @ self.residuals) / sigma**2,
            redundancy=self.redundancy,
            qvv=self.shares * sigma**2,
            redundancy_numbers=self.shares,
            residuals_of=self.residuals_of,
        )

    def homogeneity(self, alpha: float = 0.05) -> TestResult:
        """Test whether all sets have the same variance: Bartlett, corrected.

        Notes
        -----
        Maarek & Konecny, appendix A-1 to A-4.
        """
        return bartlett(self.variances, self.redundancies, alpha)

    def against_pooled(self, alpha: float = 0.05) -> Table:
        """Return for each set r S_i^2 / S^2 beside its two-sided chi-square limits, as the paper does.

        S^2 is the pooled variance, of which each set is a part: the test is approximate and a little too mild.
        """
        ratio = self.redundancies * self.variances / self.sigma0**2
        low, high = (np.asarray(stats.chi2.ppf(q, self.redundancies)) for q in (alpha / 2.0, 1.0 - alpha / 2.0))
        return Table(
            {
                "set": np.array(self.labels, dtype=object),
                "redundancy": self.redundancies,
                "deviation": np.sqrt(self.variances),
                "statistic": ratio,
                "lower": low,
                "upper": high,
                "rejected": (ratio < low) | (ratio > high),
            }
        )

    def table(self, sigma: float) -> Table:
        """Return a table of residuals that the verb `residuals` reads: set, residual, sigma, redundancy."""
        return Table(
            {
                "group": np.array(self.labels, dtype=object)[self.sets],
                "residual": self.residuals,
                "sigma": np.full(len(self.residuals), sigma),
                "redundancy": self.shares,
            }
        )

    def study(self, sigma: float, options: StudyOptions | None = None) -> ResidualStudy:
        """Study the residuals of all sets together: moments, homogeneity, scale rules, laws of errors.

        Parameters
        ----------
        sigma : float
            A-priori standard deviation of the observations.
        options : StudyOptions, optional

        Returns
        -------
        ResidualStudy
            Null laws by simulated adjustments: errors are led through the projectors of the sets.

        Raises
        ------
        UsageError
            See `baarda.procedures.residual_study.study`.
        """

        def standardised_of(errors: Floats) -> Floats:
            v = self.residuals_of(errors)
            s = np.sqrt(np.sum(v * v, axis=0) / self.redundancy)
            return np.asarray(v / (s * np.sqrt(self.shares)[:, None]))

        n = len(self.residuals)
        return study_residuals(
            self.residuals,
            self.sets,
            np.full(n, sigma),
            self.shares,
            options,
            group_names=self.labels,
            residuals_of=standardised_of if (self.shares > 1e-10).all() else None,
        )


@dataclass(frozen=True)
class MultiSet:
    """Independent sets and their adjustments.

    Attributes
    ----------
    adjustments : tuple of Adjustment
    residuals : SetResiduals
    """

    adjustments: tuple[Adjustment, ...]
    residuals: SetResiduals


def adjust_sets(networks: Sequence[Network], tell: Callable[[str], None] | None = None, **settings: Any) -> MultiSet:
    """Adjust each of many independent sets by itself and collect their residuals.

    Parameters
    ----------
    networks : sequence of Network
        Each with its own unknowns; their names are the names of the sets.
    tell : callable, optional
        Is told of each set.
    **settings
        Fields of `Settings`.

    Returns
    -------
    MultiSet

    Raises
    ------
    UsageError
        If there is no set, two have the same name, one does not converge, or observations have different a-priori sigmas or correlations,
        whose residuals cannot be pooled as they are. The message names the set.

    Notes
    -----
    Maarek & Konecny, steps 1 and 2: 10 sets of 9 points and 9 sets of 25, each a space resection of six unknowns.

    Examples
    --------
    >>> from baarda import cameras
    >>> from baarda.network import CONTROL, Images, Points
    >>> from baarda.observations import ImagePoints
    >>> grid = np.array([(x, y, 0.0) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
    >>> camera = cameras.create("1", cameras.model("pinhole"), {"principal_distance": 1000.0}, y_down=False)
    >>> images = Images.make(["1"], position=[[0.0, 0.0, 5.0]], rotation=np.eye(3)[None])
    >>> points = Points.make(list("abcdefghi"), grid, np.full(9, CONTROL), np.zeros((9, 3)), given=grid)
    >>> def network(k):
    ...     xy = 200.0 * grid[:, :2] + np.random.default_rng(k).standard_normal((9, 2))
    ...     return Network((camera,), images, points, (ImagePoints.make(np.zeros(9, int), range(9), xy),), name=str(k))
    >>> adjust_sets([network(1), network(2)]).residuals.redundancy
    24
    """
    if not networks:
        raise UsageError("there are no sets")
    labels = [network.name or str(k + 1) for k, network in enumerate(networks)]
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise UsageError(f"two sets are called {twice!r}")
    found: list[Adjustment] = []
    for label, network in zip(labels, networks, strict=True):
        try:
            a = adjust(network, **settings)
        except BaardaError as error:
            raise type(error)(f"set {label}: {error}") from None
        if a.status != "converged":
            raise UsageError(f"set {label} did not converge; {a.contradictions()}")
        if np.ptp(a.sigmas) > 1e-12 * a.sigmas[0] or any(c.correlated for c in a.lin.chunks):
            raise UsageError(f"set {label}: only observations of equal, uncorrelated weight can be pooled as they are")
        found.append(a)
        if tell is not None:
            tell(f"set {label}: {a.count} observations, redundancy {a.redundancy}, s0 {a.sigma0:.4g}")
    if len({float(a.sigmas[0]) for a in found}) > 1:
        raise UsageError("the sets have different a-priori sigmas: their residuals cannot be pooled as they are")
    return MultiSet(tuple(found), collected(labels, found))


def collected(labels: Sequence[str], adjustments: Sequence[Adjustment]) -> SetResiduals:
    """Return the residuals of adjusted sets with their projectors."""
    sets = np.repeat(np.arange(len(labels)), [a.count for a in adjustments])
    return SetResiduals(
        tuple(labels),
        np.concatenate([a.residuals for a in adjustments]),
        sets,
        np.array([a.redundancy for a in adjustments]),
        tuple(-a.residuals_of(np.eye(a.count)) for a in adjustments),
    )
