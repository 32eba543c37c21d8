"""Criteria that choose between models of the same observations: variance factor, its variance, prediction, information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from baarda.errors import UsageError

Second = Literal["variance", "s", "j", "trace"]
Criterion = Literal["variance_factor", "criterion_b", "aic", "aicc", "bic", "check_rms"]
NAMES: tuple[str, ...] = get_args(Criterion)

#: How each criterion is told.
SPOKEN = {
    "variance_factor": "s0^2 (9a)",
    "criterion_b": "criterion 9b",
    "aic": "AIC (9c)",
    "aicc": "AICc",
    "bic": "BIC",
    "check_rms": "check-point error",
}
#: Readings of Wu's eq. 9b.
SECOND_SPOKEN = {
    "variance": "V(s0^2) = 2 s0^4 / r",
    "s": "s0^2 / (r - 1)",
    "j": "(n + u) s0^2",
    "trace": "trace of the covariance",
}


@dataclass(frozen=True)
class Fitted:
    """What the criteria need to know of a fitted model.

    Attributes
    ----------
    objective : float
        v'Pv.
    count : int
        Number n of original observations, the same for all models that are compared.
    redundancy : int
        r; n - r is the number of determined unknowns, u less the datum conditions.
    trace : float or None
        Trace of the covariance matrix of the unknowns (or of the object points: one unit).
    check_rms : float or None
        Root mean square of the check-point differences; None without check points.
    """

    objective: float
    count: int
    redundancy: int
    trace: float | None = None
    check_rms: float | None = None


def criteria(fitted: Fitted, second: Second = "variance") -> dict[str, float | None]:
    """Return all criteria of a model; each is to be as small as possible.

    Parameters
    ----------
    fitted : Fitted
    second : {"variance", "s", "j", "trace"}
        Reading of criterion 9b: V(s0^2) = 2 s0^4 / r; s0^2 / (r - 1); (n + u) s0^2; the trace of the covariance matrix.

    Returns
    -------
    dict
        ``variance_factor`` (9a), ``criterion_b`` (9b), ``aic`` = n ln(v'Pv) + 2u (9c), ``aicc`` = n ln(v'Pv) + 2 n (u + 1) / (n - u - 2),
        ``bic`` = n ln(v'Pv) + u ln n, ``check_rms``; None where a criterion does not exist.

    Raises
    ------
    UsageError
        If v'Pv vanishes, the reading is unknown, or the trace is asked for and absent.

    Notes
    -----
    Wu, Liu & Lin, ISPRS XXXIII B1 (2000) 348-351, eq. 9, where the symbol of 9b is illegible; Hurvich & Tsai, Biometrika 76 (1989) 297-307.

    Examples
    --------
    >>> c = criteria(Fitted(43.0, 60, 43))
    >>> c["variance_factor"], c["criterion_b"], c["aic"]
    (1.0, 0.0465, 259.67)
    """
    n, r = fitted.count, fitted.redundancy
    if not fitted.objective > 0.0:
        raise UsageError("the residuals vanish: no criterion can choose between models")
    if second not in SECOND_SPOKEN:
        raise UsageError(f"criterion 9b is one of {', '.join(SECOND_SPOKEN)}, not {second!r}")
    if second == "trace" and fitted.trace is None:
        raise UsageError("criterion 9b: this model has no trace of the covariance matrix")
    u, s2 = n - r, fitted.objective / r
    information = n * float(np.log(fitted.objective))
    readings: dict[str, Callable[[], float | None]] = {
        "variance": lambda: 2.0 * s2 * s2 / r,
        "s": lambda: s2 / (r - 1) if r > 1 else None,
        "j": lambda: (n + u) * s2,
        "trace": lambda: fitted.trace,
    }
    return {
        "variance_factor": s2,
        "criterion_b": readings[second](),
        "aic": information + 2.0 * u,
        "aicc": information + 2.0 * n * (u + 1) / (r - 2) if r > 2 else None,
        "bic": information + u * float(np.log(n)),
        "check_rms": fitted.check_rms,
    }


def falls_below(name: str, count: int, redundancy: int, second: Second = "variance") -> float:
    """Return the F below which a criterion falls when a parameter is deleted.

    Parameters
    ----------
    name : str
        A criterion that depends on v'Pv, n and u only.
    count, redundancy : int
        n, and r of the model with the parameter.
    second : str
        Reading of criterion 9b.

    Returns
    -------
    float

    Raises
    ------
    UsageError
        If the criterion depends on more than F.

    Notes
    -----
    Deleting raises v'Pv from r s0^2 to (r + F) s0^2 and the redundancy by 1.

    Examples
    --------
    >>> [falls_below(name, 60, 43) for name in ("variance_factor", "criterion_b", "aic")]
    [1.0, 1.51, 1.46]
    """
    n, r = float(count), float(redundancy)
    u = n - r
    if name == "variance_factor":
        return 1.0
    if name == "criterion_b":
        # each is a condition (r + F) / r < ratio of the penalties
        ratio = {"variance": ((r + 1) / r) ** 1.5, "s": (r + 1) / (r - 1), "j": (r + 1) / r * (n + u) / (n + u - 1)}
        if second not in ratio:
            raise UsageError("whether the trace of the covariance falls does not depend on F alone")
        return float(r * (ratio[second] - 1.0))
    penalty = {
        "aic": 2.0,
        "bic": float(np.log(n)),
        "aicc": 2.0 * n * (u + 1) / (r - 2) - 2.0 * n * u / (r - 1),
    }
    if name not in penalty:
        raise UsageError(f"whether {name} falls does not depend on F alone")
    return float(r * np.expm1(penalty[name] / n))
