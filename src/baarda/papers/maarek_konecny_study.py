"""The study of Maarek & Konecny as a living example: simulated grid measurements, 19 resections, tests, laws, and the a of the errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from baarda import cameras
from baarda.distributions import law
from baarda.distributions.base import Floats
from baarda.errors import UsageError
from baarda.geometry import rotation as rot
from baarda.hypotheses import Evidence
from baarda.hypotheses._error_kurtosis import a_of_kurtosis, kurtosis_of_errors
from baarda.network import CONTROL, Images, Network, Points, State
from baarda.observations import ImagePoints
from baarda.papers import _maarek_konecny_printed as p
from baarda.procedures.multi_set_resection import SetResiduals, adjust_sets

__all__ = ["Study", "a_of_kurtosis", "elementary_errors", "grid_network", "scale_rule", "study"]

#: Name, number of sets, points a side of the grid.
SETS = (("9 points", 10, 3), ("25 points", 9, 5))
HALF_GRID = 80.0  # mm
PRINCIPAL_DISTANCE = 152.4  # mm
ENLARGEMENT = 2.0


def elementary_errors(size: int | tuple[int, ...], a: float, sigma: float, rng: np.random.Generator, number: int = 1000) -> Floats:
    """Return errors that are sums of elementary ones, of which some are zero.

    Parameters
    ----------
    size : int or tuple of int
        Shape of the result.
    a : float
        In each measurement an elementary error differs from zero with probability t, density (a + 1) t^a; infinity: t = 1 (Hagen).
    sigma : float
        Standard deviation of the sums.
    rng : Generator
    number : int
        Elementary errors per measurement, of equal size, either sign.

    Returns
    -------
    array
        Modulated normal with parameter a, up to the lattice of `number` elementary errors.

    Raises
    ------
    UsageError
        If a or sigma is outside of its range, or there is no elementary error.

    Notes
    -----
    Hagen's elementary errors with Romanowski's zeros: Maarek & Konecny, section 1.

    Examples
    --------
    >>> e = elementary_errors(100_000, 0.5, 2.0, np.random.default_rng(1))
    >>> round(float(e.std()), 1), round(float(np.mean(e**4) / np.mean(e**2) ** 2), 1)
    (2.0, 3.6)
    """
    if not a > -1.0 or not sigma > 0.0 or number < 1:
        raise UsageError(f"elementary errors need a > -1, sigma > 0 and number > 0, not a = {a}, sigma = {sigma}, number = {number}")
    share = rng.beta(a + 1.0, 1.0, size) if np.isfinite(a) else np.ones(size)
    active = rng.binomial(number, share)
    step = sigma / np.sqrt(number * ((a + 1.0) / (a + 2.0) if np.isfinite(a) else 1.0))
    return np.asarray(step * (2.0 * rng.binomial(active, 0.5) - active))


def grid_network(side: int, label: str, rng: np.random.Generator, errors: Floats, sigma: float) -> Network:
    """Return one set: a grid plate measured in one image, to be resected with six unknowns.

    Parameters
    ----------
    side : int
        Points a side.
    label : str
        Name of the set.
    rng : Generator
        For the true orientation, near the nominal one, from which the adjustment starts.
    errors : (2 side^2,) array
        Errors of x and y of each point, um in the twice enlarged image.
    sigma : float
        A-priori standard deviation, um.

    Returns
    -------
    Network
        Object unit mm, image unit um; all points fixed.
    """
    g = np.linspace(-HALF_GRID, HALF_GRID, side)
    grid = np.array([(x, y, 0.0) for y in g[::-1] for x in g])
    n = len(grid)
    camera = cameras.create(
        "A8", cameras.model("pinhole"), {"principal_distance": 1000.0 * ENLARGEMENT * PRINCIPAL_DISTANCE}, unit="um", y_down=False
    )
    points = Points.make(
        [f"{i // side + 1}.{i % side + 1}" for i in range(n)], grid, np.full(n, CONTROL), np.full((n, 3), cameras.FIXED), given=grid
    )
    position, turned = np.array([[0.0, 0.0, PRINCIPAL_DISTANCE]]), rot.exp(1e-3 * rng.standard_normal((1, 3)))
    nominal = Images.make([label], position=position, rotation=np.eye(3)[None])
    measured = ImagePoints.make(np.zeros(n, dtype=np.intp), np.arange(n), np.zeros((n, 2)), sigma)
    network = Network((camera,), nominal, points, (measured,), unit="mm", name=label)
    true = replace(network, images=replace(nominal, position=position + 0.1 * rng.standard_normal((1, 3)), rotation=turned))
    xy = -measured.misclosures(true, State.of(true)) + errors.reshape(n, 2)
    return replace(network, observations=(replace(measured, xy=xy),))


@dataclass(frozen=True)
class Study(SetResiduals):
    """Residuals of all sets, um, and the law that their errors were drawn from.

    Attributes
    ----------
    a, sigma : float
        The law that the errors were drawn from.
    seed : int
    """

    a: float
    sigma: float
    seed: int

    @property
    def evidence(self) -> Evidence:
        """What tests through Qvv need; the a-priori standard deviation is that of the errors."""
        return self.evidence_of(self.sigma)

    def kurtosis_of_errors(self, residuals: Floats) -> tuple[Floats, Floats]:
        """Estimate sigma^4 of the errors, and sigma^4 times their excess kurtosis, from residuals; both without bias.

        Parameters
        ----------
        residuals : (n,) or (n, B) array
            Columns for data sets.

        Returns
        -------
        fourth_power, fourth_cumulant : arrays of shape () or (B,)
            Their ratio estimates the excess kurtosis.

        Notes
        -----
        With v = -R e and independent errors of excess kurtosis g: E sum v_i^4 = sigma^4 (3 sum R_ii^2 + g sum R_ij^4) and
        E s0^4 = sigma^4 (1 + 2/r + g sum R_ii^2 / r^2): two linear equations.
        """
        return kurtosis_of_errors(residuals, self.redundancy, self.shares, float(self.fourth.sum()))

    @property
    def excess_kurtosis(self) -> float:
        """Estimated excess kurtosis of the errors."""
        power, cumulant = self.kurtosis_of_errors(self.residuals)
        return float(cumulant / power)

    def dilution(self) -> float:
        """Return the excess kurtosis of standardised residuals over that of the errors, averaged over the residuals."""
        return float(np.mean(self.fourth / self.shares**2))

    def replicas(self, number: int, a: float, seed: int) -> Floats:
        """Return residuals of simulated data sets, (n, number): errors of law a and the study's sigma, through the projectors."""
        rng = np.random.default_rng(seed)
        return self.residuals_of(elementary_errors((len(self.residuals), number), a, self.sigma, rng))


def study(a: float = 0.5, sigma: float = 7.92, seed: int = 1972) -> Study:
    """Simulate 10 sets of 9 and 9 sets of 25 grid points with modulated errors, and resect each.

    Parameters
    ----------
    a : float
        Of the errors; infinity for normal ones.
    sigma : float
        Their standard deviation, um.
    seed : int

    Returns
    -------
    Study

    Examples
    --------
    >>> made = study()
    >>> len(made.labels), made.residuals.size, made.redundancy
    (19, 630, 516)
    """
    rng = np.random.default_rng(seed)
    networks = []
    for name, number, side in SETS:
        for k in range(number):
            errors = elementary_errors(2 * side * side, a, sigma, rng)
            networks.append(grid_network(side, f"{name}, set {k + 1}", rng, errors, sigma))
    found = adjust_sets(networks).residuals
    return Study(found.labels, found.residuals, found.sets, found.redundancies, found.projectors, a, sigma, seed)


@dataclass(frozen=True)
class ScaleRule:
    """Shares of simulated data sets in which the rules of Table 4 reject, and in which a modulated law is taken instead of the normal."""

    rejected: dict[str, float]
    modulated_instead: float
    replicas: int


def scale_rule(
    made: Study, replicas: int = 2000, ends: str = "open", grouped: bool = False, a: float = float("inf"), seed: int = 1
) -> ScaleRule:
    """Simulate what the rules for mean and scale do to errors of a known law.

    Parameters
    ----------
    made : Study
        For its projectors and sigma.
    replicas : int
    ends : {"open", "closed"}
        Whether the outer of the 12 classes of 4 um reach to infinity.
    grouped : bool
        Take M_o, S_o and S_M from the mids of the classes, as the paper does, which widens them; else from the values.
    a : float
        Of the errors; infinity for truly normal ones.
    seed : int

    Returns
    -------
    ScaleRule
        Shares of replicas in which chi-square with 9 degrees of freedom rejects at 5 %: normal, lineo, radico with S_o, normal with S_M,
        Q_v; and in which normal with S_o is rejected while lineo or radico with S_o is accepted.

    Raises
    ------
    UsageError
        If `ends` is neither open nor closed.

    Examples
    --------
    >>> found = scale_rule(study(), replicas=200)
    >>> found.rejected["normal S_o"] > 0.4, found.rejected["normal Q_v"] < 0.15
    (True, True)
    """
    if ends not in ("open", "closed"):
        raise UsageError(f"ends are open or closed, not {ends!r}")
    rng = np.random.default_rng(seed)
    size = (len(made.residuals), replicas)
    errors = elementary_errors(size, a, made.sigma, rng) if np.isfinite(a) else made.sigma * rng.standard_normal(size)
    v = made.residuals_of(errors)
    n, limit = float(len(v)), float(special.chdtri(9, 0.05))
    squares = np.sum(v * v, axis=0)
    counts = _class_counts(v, p.V_LIMITS, ends)
    mean, total = v.mean(axis=0), squares
    if grouped:
        inside, mids = _class_counts(v, p.V_LIMITS, "closed"), (p.V_LIMITS[1:] + p.V_LIMITS[:-1]) / 2.0
        mean, total = mids @ inside / n, mids**2 @ inside
    s_o, s_m = np.sqrt(total / (made.redundancy - 1)), np.sqrt(total / (n - 1.0))

    def beyond(name: str, observed: Floats, edges: Floats, loc: Floats, scale: Floats) -> NDArray[np.bool_]:
        outer = edges.copy()
        if ends == "open":
            outer[0], outer[-1] = -np.inf, np.inf
        expected = n * np.diff(law(name)().cdf((outer[:, None] - loc) / scale), axis=0)
        return np.asarray(np.sum((observed - expected) ** 2 / expected, axis=0) > limit)

    wrong = {f"{name} S_o": beyond(name, counts, p.V_LIMITS, mean, s_o) for name in ("normal", "lineo", "radico")}
    z = v / (np.sqrt(squares / made.redundancy) * np.sqrt(made.shares)[:, None])
    wrong["normal S_M"] = beyond("normal", counts, p.V_LIMITS, mean, s_m)
    wrong["normal Q_v"] = beyond("normal", _class_counts(z, p.QV_LIMITS, ends), p.QV_LIMITS, np.zeros(1), np.ones(1))
    instead = wrong["normal S_o"] & ~(wrong["lineo S_o"] & wrong["radico S_o"])
    return ScaleRule({name: float(np.mean(b)) for name, b in wrong.items()}, float(np.mean(instead)), replicas)


def _class_counts(values: Floats, edges: Floats, ends: str) -> Floats:
    """Counts of each column, (k, B); with closed ends values beyond the outer limits are in no class."""
    below = np.stack([np.sum(values < b, axis=0) for b in edges]).astype(float)
    if ends == "open":
        below[0], below[-1] = 0.0, len(values)
    return np.diff(below, axis=0)
