"""Maximum-likelihood (M-) adjustment under a law of errors other than the normal: a start by least squares, then Newton with damping.

The errors of the whitened observations, divided by a common scale s that is estimated together with the unknowns, follow the standard
law f: the adjustment minimises -sum log f(v_i / s) + r log s. With the redundancy r in place of n the scale obeys sum u psi(u) = r,
u = v / s, psi = -(log f)', which for the normal law is s0^2 = v'Pv / r.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from baarda.adjustment.datum import Datum
from baarda.adjustment.likelihood import iterate
from baarda.adjustment.linear_system import Linearization
from baarda.adjustment.linearize import Arrangement
from baarda.adjustment.result import Iteration
from baarda.adjustment.solver import Solver
from baarda.distributions import law as find_law
from baarda.distributions.base import Distribution
from baarda.distributions.modulated import ModulatedNormal
from baarda.distributions.student import Student
from baarda.errors import UsageError
from baarda.hypotheses._error_kurtosis import a_of_kurtosis, kurtosis_of_errors
from baarda.network import Network, State

if TYPE_CHECKING:
    from baarda.adjustment.solve import Settings

Floats = NDArray[np.float64]
Factor = Callable[..., Solver]

SMALLEST_A = 0.25  # below, a modulated density is so pointed that the most likely adjustment only chooses which observations to fit exactly
ENOUGH = 0.75  # r/n from which simulations show that the predicted sigmas of resistant laws cover
EXACT_KURTOSIS = 2000  # observations up to which sum R_ij^4 is summed, not estimated by random signs
PROBES = 256

_OF_LEAST_SQUARES = "the residuals of this adjustment are no sample of the errors, and the null law is that of least-squares residuals"
_COFACTORS = "the cofactors of least-squares residuals do not hold"
#: What `baarda.hypotheses` and the procedures around it do not judge under a law of errors, and why.
NOT_APPLICABLE = {
    "global_variance_factor": "v'Pv is not minimal and not chi-square",
    "mean_of_residuals": _OF_LEAST_SQUARES,
    "skewness_of_residuals": _OF_LEAST_SQUARES,
    "kurtosis_of_residuals": _OF_LEAST_SQUARES,
    "jarque_bera": _OF_LEAST_SQUARES,
    "goodness_of_fit": _OF_LEAST_SQUARES,
    "law_study": _OF_LEAST_SQUARES,
    "critical_values": "w and tau are standardised least-squares residuals",
    "bartlett_images": _OF_LEAST_SQUARES,
    "variance_per_image": _OF_LEAST_SQUARES,
    "data_snooping": "w and tau are standardised least-squares residuals; gross errors show by their weights",
    "control_points": _COFACTORS,
    "control_point": _COFACTORS,
    "vdi_vde_2634": "v / r is the deviation of a length left out for least-squares residuals only",
}
#: Why estimates (parameters, check points) are not judged with a-priori sigmas under a law of errors.
NOT_APRIORI = "under a law of errors its scale is estimated, and no a-priori sigma gives the covariance: judge a posteriori"
#: Why check points are not judged under a redescending law: simulated with errors of the law, and twelve rays to each point, the joint test
#: at level 0.05 rejects 0.10 (Student, 3 degrees of freedom) to 0.19 (Cauchy), with four rays 0.12 (Student, estimated) to 0.78 (Cauchy).
NOT_CHECKED = "under a law that gives up large errors the covariance of a point is too small, for few rays determine it"
#: Why parameters are not judged under a redescending law where r/n is below `ENOUGH`.
NOT_ENOUGH = (
    "under a law that gives up large errors the covariances can be far too small with so few redundant observations (r/n below 0.75)"
)


@dataclass(frozen=True)
class LawOfErrors:
    """The law of errors that an adjustment used.

    Attributes
    ----------
    name : str
        Of the law.
    distribution : Distribution
        With its values: of errors divided by their a-priori standard deviations; `scale` was estimated.
    estimated : tuple of str
        What was estimated: ``scale``, and shapes found from the residuals of the least-squares start.
    excess_kurtosis : float or None
        Of the errors, where a shape was found from it.
    covariance_factor : float
        Covariance of the unknowns = this times (A'PA)^-1.
    covariance_text : str
        Formula and source of the factor.
    resistance : {"none", "bounded", "redescending"}
        What a growing gross error does: pulls on without bound, pulls no more than a limit, or loses its pull.
    weights : (n,) array
        psi(u)/u of each whitened observation over the weight that an error of zero size (or a hundredth of the scale, where the weight
        is infinite at zero) has.
    redundancy_share : float
        r/n.
    start : tuple of Iteration
        The iterations of the least-squares start.

    Notes
    -----
    A modulated normal law is efficient, not outlier-resistant: psi(u)/u stays above a positive bound. With many unknowns (r/n near 1/2) the
    most likely adjustment is not even efficient, since residuals mix the errors (Bean, Bickel, El Karoui & Yu, PNAS 110, 2013).
    """

    name: str
    distribution: Distribution
    estimated: tuple[str, ...]
    excess_kurtosis: float | None
    covariance_factor: float
    covariance_text: str
    resistance: str
    weights: Floats
    redundancy_share: float
    start: tuple[Iteration, ...]

    @property
    def scale(self) -> float:
        """The estimated common scale of the errors divided by their a-priori standard deviations."""
        return float(self.distribution.scale)

    @property
    def values(self) -> dict[str, float]:
        """Shapes and scale by name."""
        return {k: v for k, v in self.distribution.parameters.items() if k != "loc"}

    @property
    def assumptions(self) -> tuple[str, ...]:
        """What the report must say."""
        values = ", ".join(f"{k} = {v:.4g}{' (estimated)' if k in self.estimated else ''}" for k, v in self.values.items())
        kurtosis = ""
        if self.excess_kurtosis is not None:
            kurtosis = f" Excess kurtosis of the errors, from the least-squares residuals: {self.excess_kurtosis:.3f}."
            if self.values.get("a") == SMALLEST_A:
                kurtosis += f" It asks for a below {SMALLEST_A}, the smallest that an adjustment uses; are there gross errors?"
        spoken = {
            "none": "efficient if the law holds, NOT resistant to gross errors: the influence of an error grows without bound",
            "bounded": "a gross error has a bounded influence on the unknowns, but widens the scale; an error at an observation "
            "that nothing controls is not resisted",
            "redescending": "a gross error loses its influence; an error at an observation that nothing controls is not resisted, and the "
            "likelihood may have several maxima (found: the one reached from Huber's adjustment)",
        }
        few = ""
        if self.redundancy_share < ENOUGH:
            few = (
                f" With a redundancy of only {self.redundancy_share:.2f} n they are approximate; under laws that resist gross errors they "
                "can be far too small, and a maximum-likelihood adjustment may be less precise than least squares."
            )
        return (
            f"Adjusted by maximum likelihood under the {self.name} law of errors, {values}: {spoken[self.resistance]}.{kurtosis}",
            f"Covariances under the law of errors: {self.covariance_text}.{few}",
            "Tests that judge residuals, or need v'Pv or the cofactors of least-squares residuals, are not applicable under a law of "
            "errors: they are listed with their reasons.",
        )


def check_law(name: str, shapes: Mapping[str, float] | None) -> Distribution:
    """Return the standard law of a name with given shapes, the others at their usual values.

    Parameters
    ----------
    name : str
        A member of `baarda.distributions.laws`, symmetric, with a density whose logarithm has a derivative everywhere.
    shapes : mapping or None
        Values of shapes.

    Returns
    -------
    Distribution

    Raises
    ------
    UsageError
        If there is no such law or shape, or the law gives no smooth likelihood.

    Examples
    --------
    >>> check_law("student", {"nu": 4.0}).nu
    4.0
    """
    member = find_law(name)
    known = [s.name for s in member.free_shapes]
    for shape in shapes or {}:
        if shape not in known:
            raise UsageError(f"law {name}: no shape {shape!r} to give (has {', '.join(known) or 'none'})")
    found = member(**dict(shapes or {}))
    _check_smooth(name, found)
    return found


def _check_smooth(name: str, law: Distribution) -> None:
    if isinstance(law, ModulatedNormal):
        pointed = law.a < SMALLEST_A
    else:
        pointed = law._smoothness(*law.shape_values) < 1
    if pointed or not law.symmetric:
        values = ", ".join(f"{s.name} = {v:g}" for s, v in zip(law.shapes, law.shape_values, strict=True))
        raise UsageError(
            f"law {name}{f' with {values}' if values else ''}: its density is pointed at zero: the most likely adjustment fits some "
            f"observations exactly; an adjustment needs a smooth one (modulated_normal with a >= {SMALLEST_A}, student, cauchy, huber, ...)"
        )


def adjust_under_law(
    network: Network,
    state: State,
    lin: Linearization,
    groups: Arrangement,
    datum: Datum,
    factor: Factor,
    settings: Settings,
    redundancy: int,
    start: list[Iteration],
) -> tuple[State, Linearization, list[Iteration], bool, LawOfErrors]:
    """Adjust under the law of the settings, from a least-squares adjustment.

    Parameters
    ----------
    network : Network
        Prepared.
    state, lin : State, Linearization
        Of the least-squares solution.
    groups, datum, factor
        Observations, datum, and what makes a `Solver` of a linearization.
    settings : Settings
        `robust` names the law, `robust_shapes` gives shapes.
    redundancy : int
        r.
    start : list of Iteration
        Of the least-squares adjustment.

    Returns
    -------
    state, linearization, history, converged, law
        The objective of the history is -sum log f(v/s) + r log s.

    Raises
    ------
    UsageError
        If the law cannot be used, or all residuals vanish.

    Notes
    -----
    P. J. Huber, Robust Statistics (1981), chapter 7. A redescending law starts from Huber's adjustment (k = 1.345), whose objective has
    one minimum.
    """
    name = str(settings.robust)
    if not float(lin.misclosure @ lin.misclosure) > lin.count * 1e-16:
        raise UsageError("the residuals of the least-squares adjustment vanish: no law of errors can be adjusted")
    law, estimated, excess = with_fitted_shapes(
        name, settings.robust_shapes, lambda: excess_kurtosis_of_errors(lin, factor(lin, datum), redundancy), SMALLEST_A
    )
    resistance = resistance_of(law)
    if resistance == "redescending":
        state, lin, _, _, _ = iterate(network, state, lin, groups, datum, factor, settings, find_law("huber")(), redundancy)
    state, lin, history, converged, scale = iterate(network, state, lin, groups, datum, factor, settings, law, redundancy)
    variance, text = covariance_factor(lin.misclosure / scale, law, redundancy)
    u = np.abs(lin.misclosure) / scale
    used = LawOfErrors(
        name=name,
        distribution=replace(law, scale=scale),
        estimated=(*estimated, "scale"),
        excess_kurtosis=excess,
        covariance_factor=variance * scale**2,
        covariance_text=text,
        resistance=resistance,
        weights=np.asarray(weight(u, law) / weight(np.zeros(1), law)),
        redundancy_share=redundancy / lin.count,
        start=tuple(start),
    )
    return state, lin, history, converged, used


def weight(u: Floats, law: Distribution) -> Floats:
    """Return psi(u)/u, at and below a hundredth of the scale its value there."""
    size = np.maximum(np.abs(u), 0.01)
    return np.asarray(-law.score(size) / size)


def resistance_of(law: Distribution) -> str:
    """Return how the influence of an error ends: ``none``, ``bounded`` or ``redescending``.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> [resistance_of(law(name)()) for name in ("lineo", "huber", "cauchy")]
    ['none', 'bounded', 'redescending']
    """
    near, far = np.abs(law.score(np.array([1e4, 1e6])))
    return "none" if far > 2.0 * near else "redescending" if far < 0.5 * near else "bounded"


# ---- shapes from the residuals of the start -------------------------------------------------------------------------------------------


def with_fitted_shapes(
    name: str, given: Mapping[str, float] | None, excess_of: Callable[[], float], smallest_a: float = -1.0
) -> tuple[Distribution, tuple[str, ...], float | None]:
    """Return the standard law of a name; a of the modulated normal and nu of Student's, where not given, by the kurtosis of the errors.

    Parameters
    ----------
    name : str
        A member of `baarda.distributions.laws`.
    given : mapping or None
        Shapes that are given.
    excess_of : callable
        Returns the excess kurtosis of the errors; called only where it is needed.
    smallest_a : float
        Least a of a modulated normal law.

    Returns
    -------
    law : Distribution
        Shapes that are neither given nor found have their usual value.
    estimated : tuple of str
    excess : float or None

    Raises
    ------
    UsageError
        If the kurtosis is infinite (gross errors) and no least a is set.

    Examples
    --------
    >>> with_fitted_shapes("student", None, lambda: 1.0)[0].nu
    10.0
    """
    member = find_law(name)
    law = member(**dict(given or {}))
    free = {s.name for s in member.free_shapes} - set(given or {})
    if isinstance(law, ModulatedNormal) and "a" in free:
        excess = excess_of()
        a = max(a_of_kurtosis(excess), smallest_a)
        if a == -1.0:
            raise UsageError("gross errors carry all of v'Pv: the kurtosis of the errors, and with it a, cannot be estimated")
        return replace(law, a=a), ("a",), excess
    if isinstance(law, Student) and "nu" in free:
        excess = excess_of()
        return replace(law, nu=4.0 + 6.0 / excess if excess > 0.0 else np.inf), ("nu",), excess
    return law, (), None


def excess_kurtosis_of_errors(lin: Linearization, solver: Solver, redundancy: int) -> float:
    """Estimate the excess kurtosis of whitened errors from whitened least-squares residuals through R = I - A (A'A)^-1 A'.

    Parameters
    ----------
    lin : Linearization
        At the least-squares solution.
    solver : Solver
        Its factor.
    redundancy : int
        r.

    Returns
    -------
    float
        By `kurtosis_of_errors`; infinite where single errors carry all of v'Pv. Sum R_ij^4 is exact up to 2000 observations, beyond it by
        E (R z)_i^4 = 3 R_ii^2 - 2 sum R_ij^4 over 256 vectors z of random signs.
    """
    n = lin.count
    shares = np.empty(n)
    for chunk, hat in zip(lin.chunks, solver.hat(whole=False), strict=True):
        shares[chunk.rows] = 1.0 - (hat if hat.ndim == 2 else np.einsum("nii->ni", hat))

    def residuals_of(e: Floats) -> Floats:
        return np.asarray(e - lin.times(solver.solve(lin.transposed(e))))

    width = 64
    fourth = 0.0
    if n <= EXACT_KURTOSIS:
        for first in range(0, n, width):
            unit = np.zeros((n, min(width, n - first)))
            unit[np.arange(first, first + unit.shape[1]), np.arange(unit.shape[1])] = 1.0
            fourth += float(np.sum(residuals_of(unit) ** 4))
    else:
        rng = np.random.default_rng(0)
        total = 0.0
        for _ in range(0, PROBES, 16):
            total += float(np.sum(residuals_of(rng.choice(np.array([-1.0, 1.0]), (n, 16))) ** 4))
        fourth = 0.5 * (3.0 * float(shares @ shares) - total / PROBES)
    power, cumulant = kurtosis_of_errors(lin.misclosure, redundancy, shares, fourth)
    if power <= 0.0 < cumulant:
        return float("inf")
    return float(cumulant / power)


# ---- covariance -----------------------------------------------------------------------------------------------------------------------


def covariance_factor(u: Floats, law: Distribution, redundancy: int) -> tuple[float, str]:
    """Return m such that m s^2 (A'PA)^-1 is the covariance of the unknowns, and how it was found.

    Parameters
    ----------
    u : (n,) array
        Whitened residuals divided by the scale s.
    law : Distribution
        Standard law.
    redundancy : int
        r.

    Returns
    -------
    factor : float
        With p = 1 - r/n and c from mean 1/(1 + c psi'(u)) = r/n: c^2 (r/n) mean psi(u)^2 / p^2. For few unknowns (p near 0) this is the
        sandwich mean psi^2 / (mean psi')^2; for the normal law v'Pv / r exactly.
    text : str

    Notes
    -----
    El Karoui, Bean, Bickel, Lim & Yu, PNAS 110 (2013) 14557-14562: u + c psi(u) is an observation's residual in the adjustment without
    it. Where psi' is so negative that no c exists, Huber's formula with its correction for the number of unknowns (1981, eq. 7.6.6).

    Examples
    --------
    >>> from baarda.distributions import law
    >>> covariance_factor(np.array([1.0, -1.0, 1.0, 1.0]), law("normal")(), 2)[0]
    2.0
    """
    n = len(u)
    share = redundancy / n
    psi = -law.score(u)
    step = 1e-6 * np.maximum(np.abs(u), 1e-3)
    slope = (law.score(u - step) - law.score(u + step)) / (2.0 * step)
    square = float(np.mean(psi**2))
    largest = 1.0 / max(-float(slope.min()), 1e-12)

    def missing(c: float) -> float:
        return float(np.mean(1.0 / (1.0 + c * slope))) - share

    grid = np.concatenate([np.geomspace(1e-6, min(0.999 * largest, 1e6), 200)])
    below = np.flatnonzero(np.array([missing(c) for c in grid]) <= 0.0)
    if len(below) and below[0] > 0:
        c = float(optimize.brentq(missing, grid[below[0] - 1], grid[below[0]], xtol=1e-14, rtol=1e-14))
        formula = "s^2 c^2 (r/n) mean(psi^2) / (1 - r/n)^2 times (A'PA)^-1, with mean 1/(1 + c psi') = r/n (El Karoui et al. 2013)"
        return c * c * share * square / (1.0 - share) ** 2, formula
    mean = float(np.mean(slope))
    if mean <= 0.0:
        raise UsageError("under this law of errors the residuals have no mean curvature: too few fit it")
    correction = 1.0 + (1.0 - share) * float(np.var(slope)) / mean**2
    formula = "K^2 s^2 sum(psi^2) / r / mean(psi')^2 times (A'PA)^-1, K = 1 + (u/n) var(psi') / mean(psi')^2 (Huber 1981, eq. 7.6.6)"
    return correction**2 * square / share / mean**2, formula
