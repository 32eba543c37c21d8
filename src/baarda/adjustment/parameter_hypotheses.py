"""Hypotheses on named unknowns of an adjustment, by solves with its factor: no large block is ever inverted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.errors import Singular, UsageError
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.parameter_groups import equal_parameters, equal_parameters_of_epochs
from baarda.hypotheses.parameters import general_linear
from baarda.hypotheses.variance_inflation import ConditionIndices, condition_indices, mutual_inflation, variance_inflation

if TYPE_CHECKING:
    from baarda.adjustment.result import Adjustment

Floats = NDArray[np.float64]
Sigma = Literal["aposteriori", "apriori"]
_BATCH = 64  # right sides of one solve
Condition = tuple[Mapping[str, float], float]


def conditions(adjustment: Adjustment, rows: Sequence[Condition], alpha: float = 0.05, sigma: Sigma = "aposteriori") -> TestResult:
    """Test linear conditions between named camera parameters: H0: B x = w.

    Parameters
    ----------
    adjustment : Adjustment
    rows : sequence of (mapping, float)
        For each condition the coefficient of each unknown by its name, and the right side.
    alpha : float
        Level.
    sigma : {"aposteriori", "apriori"}
        Which variance factor judges.

    Returns
    -------
    TestResult
        T under F(b, r), or chi-square(b)/b; one solve with b right sides.

    Raises
    ------
    UsageError
        If a name is not that of an estimated camera parameter.
    Singular
        If the conditions depend on each other.

    Notes
    -----
    Grün, Photogrammetria 34 (1978) eq. 29-31.
    """
    values = dict(zip(adjustment.camera_estimates.names, adjustment.camera_estimates.values, strict=True))
    b = np.zeros((adjustment.numbering.count, len(rows)))
    d = np.zeros(len(rows))
    for k, (coefficients, w) in enumerate(rows):
        d[k] = -w
        for name, c in coefficients.items():
            if name not in values:
                raise UsageError(f"{name!r} is not an estimated camera parameter; known are {', '.join(values)}")
            b[adjustment.numbering.column(name), k] += c
            d[k] += c * values[name]
    m = b.T @ adjustment.cofactors.solve(b)
    factor, r = _judge(adjustment, sigma)
    null = "The camera parameters satisfy B x = w."
    return general_linear(d, 0.5 * (m + m.T), factor, r, None, alpha, name="linear_hypothesis", null=null)


def given_values(adjustment: Adjustment, values: Mapping[str, float], alpha: float = 0.05, sigma: Sigma = "aposteriori") -> TestResult:
    """Test whether camera parameters equal given values, for instance those of a calibration certificate taken as exact.

    Parameters
    ----------
    adjustment : Adjustment
    values : mapping
        Given value of each parameter by name.
    alpha, sigma
        See `conditions`.

    Returns
    -------
    TestResult
    """
    return conditions(adjustment, [({name: 1.0}, float(v)) for name, v in values.items()], alpha, sigma)


def equal_cameras(
    adjustment: Adjustment, a: str, b: str, parameters: Sequence[str] = (), alpha: float = 0.05, sigma: Sigma = "aposteriori"
) -> TestResult:
    """Test whether two cameras of one adjustment have the same parameters.

    Parameters
    ----------
    adjustment : Adjustment
    a, b : str
        Labels of the cameras.
    parameters : sequence of str
        Names of the parameters; empty = all that are estimated in both.
    alpha, sigma
        See `conditions`.

    Returns
    -------
    TestResult
        T under F(k, r) for k parameters, their mutual correlations included.

    Raises
    ------
    UsageError
        If they share no estimated parameter.
    """
    names = set(adjustment.camera_estimates.names)
    shared = parameters or [
        n.removeprefix(f"camera {a}: ")
        for n in adjustment.camera_estimates.names
        if n.startswith(f"camera {a}: ") and f"camera {b}: " + n.removeprefix(f"camera {a}: ") in names
    ]
    if not shared:
        raise UsageError(f"cameras {a} and {b} share no estimated parameter")
    return conditions(adjustment, [({f"camera {a}: {p}": 1.0, f"camera {b}: {p}": -1.0}, 0.0) for p in shared], alpha, sigma)


def equal_epochs(
    first: Adjustment, second: Adjustment, pairs: Mapping[str, str] | Sequence[str] = (), alpha: float = 0.05, sigma: Sigma = "aposteriori"
) -> TestResult:
    """Test whether camera parameters are the same in two independent adjustments.

    Parameters
    ----------
    first, second : Adjustment
        Two epochs without common observations.
    pairs : mapping or sequence of str
        Name of each parameter in the first and in the second epoch, or names that are the same in both; empty = all of the same name.
    alpha, sigma
        See `conditions`; a posteriori by the pooled variance factor, whose equality is to be tested first (`variance_ratio`).

    Returns
    -------
    TestResult
        T under F(k, r1 + r2).

    Raises
    ------
    UsageError
        If nothing is to be compared.

    Notes
    -----
    Grün (1978) p. 399.
    """
    e, f = first.camera_estimates, second.camera_estimates
    if isinstance(pairs, Mapping):
        couples = list(pairs.items())
    else:
        couples = [(n, n) for n in (pairs or [n for n in e.names if n in f.names])]
    if not couples:
        raise UsageError("the two epochs share no estimated camera parameter")
    taken = []
    for estimates, names in ((e, [a for a, _ in couples]), (f, [b for _, b in couples])):
        missing = [n for n in names if n not in estimates.names]
        if missing:
            raise UsageError(f"{missing[0]!r} is not an estimated camera parameter; known are {', '.join(estimates.names)}")
        at = np.array([estimates.names.index(n) for n in names])
        taken.append((estimates.values[at], estimates.cofactors[np.ix_(at, at)]))
    names = [a for a, _ in couples]
    if sigma == "apriori":
        return equal_parameters(*taken[0], *taken[1], 1.0, np.inf, None, alpha, names, "equal_epochs")
    own = [(*pair, a.variance_factor, a.redundancy) for pair, a in zip(taken, (first, second), strict=True)]
    return equal_parameters_of_epochs(*own[0], *own[1], alpha, names)


def _judge(adjustment: Adjustment, sigma: Sigma) -> tuple[float, float]:
    if sigma not in ("aposteriori", "apriori"):
        raise UsageError(f"sigma must be 'apriori' or 'aposteriori', not {sigma!r}")
    return (adjustment.scale(sigma) ** 2, float(adjustment.redundancy) if sigma == "aposteriori" else np.inf)


@dataclass(frozen=True)
class Collinearity:
    """How well the camera parameters of an adjustment can be told apart.

    Attributes
    ----------
    names : tuple of str
    inflation : (k,) array
        Variance inflation by all other unknowns.
    mutual : (k,) array or None
        Part of it caused by the other camera parameters; None where they depend on each other exactly.
    partners : tuple of (str, float)
        The unknown most correlated with each parameter, among camera parameters and orientation unknowns, and the correlation.
    conditions : ConditionIndices or None
        Of the camera parameters, everything else eliminated; None as `mutual`.
    dependent : str
        In words, which parameters depend on each other; empty where none do.
    """

    names: tuple[str, ...]
    inflation: Floats
    mutual: Floats | None
    partners: tuple[tuple[str, float], ...]
    conditions: ConditionIndices | None
    dependent: str


def collinearity(adjustment: Adjustment) -> Collinearity | None:
    """Return variance inflation, condition indices and the strongest correlation of each camera parameter; None where none is estimated.

    Parameters
    ----------
    adjustment : Adjustment

    Returns
    -------
    Collinearity or None

    Notes
    -----
    Grün (1978) p. 383; Belsley, Kuh, Welsch (1980) 3.2.
    """
    e = adjustment.camera_estimates
    if not e.names:
        return None
    columns = np.array([adjustment.numbering.column(n) for n in e.names], dtype=np.intp)
    inflation = variance_inflation(e.cofactors, adjustment.lin.norms[columns] ** 2)
    partners = _partners(adjustment, columns)
    mutual, indices, dependent = None, None, ""
    try:
        mutual, indices = mutual_inflation(e.cofactors, e.names), condition_indices(e.cofactors, e.names)
    except Singular as error:
        dependent = str(error)
    return Collinearity(e.names, inflation, mutual, partners, indices, dependent)


def _partners(adjustment: Adjustment, columns: NDArray[np.intp]) -> tuple[tuple[str, float], ...]:
    """Return for each column the camera parameter or orientation unknown most correlated with it, and the correlation."""
    numbering, cofactors = adjustment.numbering, adjustment.cofactors
    at = numbering["image"].columns.reshape(-1, 6)
    others = np.concatenate([columns, at[at >= 0]])
    variances = np.concatenate(
        [np.diag(adjustment.camera_estimates.cofactors), np.einsum("nii->ni", cofactors.blocks(at))[at >= 0] if len(at) else []]
    )
    out = []
    for first in range(0, len(columns), _BATCH):
        some = columns[first : first + _BATCH]
        unit = np.zeros((numbering.count, len(some)))
        unit[some, np.arange(len(some))] = 1.0
        q = cofactors.solve(unit)[others]
        size = np.outer(variances, variances[first : first + len(some)])
        rho = np.divide(q, np.sqrt(np.where(size > 0.0, size, 1.0)), out=np.zeros_like(q), where=size > 0.0)
        rho[others[:, None] == some[None, :]] = 0.0
        best = np.abs(rho).argmax(axis=0)
        out += [(numbering.names[others[i]], float(rho[i, j])) for j, i in enumerate(best)]
    return tuple(out)
