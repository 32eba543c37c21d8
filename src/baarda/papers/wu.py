"""Wu 2000: criteria that select significant orientation parameters of a radar image; the image itself is not public."""

from __future__ import annotations

from typing import get_args

from scipy import stats

from baarda.papers.base import Comparison, Paper, Reason, Reproduction, Row, row
from baarda.procedures.criteria import SECOND_SPOKEN, SPOKEN, Second, falls_below

__all__ = ["deletion_rate", "reproduce"]

NAME, TITLE = "wu", "Significant SAR-image orientation parameters"
REFERENCE = "Wu, Liu, Lin, ISPRS Archives XXXIII, Part B1, Amsterdam 2000, pages 348-351."
CONTROL_POINTS, ALPHA = 30, 0.05
#: squint angle, pixel spacing, and polynomials of fourth order for X, Y and Z of the antenna
UNKNOWNS = ("tau", "M_r", *(f"{axis}{k}" for axis in "abc" for k in range(5)))
FINAL_UNKNOWNS = 15

RADAR = Reason(
    "not recomputed",
    "The image, its control points and the flight data are not public, and the range and Doppler equations of the experiment are not "
    "among the observations that can be adjusted here.",
)


def deletion_rate(limit: float, redundancy: int) -> float:
    """Return how often a parameter whose true value is zero has F(1, r) below a limit and is deleted.

    Parameters
    ----------
    limit : float
        F below which it is deleted.
    redundancy : int
        r of the model with the parameter.

    Returns
    -------
    float

    Notes
    -----
    Wu (2000) eqs. 8 and 9: F and the criteria (9a) to (9c) depend on the parameter through F alone.

    Examples
    --------
    >>> [deletion_rate(falls_below(name, 60, 43), 43) for name in ("variance_factor", "criterion_b", "aic")]
    [0.677, 0.774, 0.766]
    """
    return float(stats.f.cdf(limit, 1, redundancy))


def _counts() -> Comparison:
    n, u = 2 * CONTROL_POINTS, len(UNKNOWNS)
    rows = [
        row(("observations n",), 60, n, 0, remark="30 control points, two image coordinates each"),
        row(("unknowns u at the start",), 17, u, 0),
        row(("redundancy r at the start",), 43, n - u, 0),
    ]
    for r in range(n - u, n - FINAL_UNKNOWNS + 1):
        rows.append(row((f"limit of F(1, {r}) at 5 %",), None, float(stats.f.isf(ALPHA, 1, r)), 3))
    for name, q in (("lower", ALPHA / 2), ("upper", 1 - ALPHA / 2)):
        rows.append(row((f"{name} limit of r s0^2 / sigma0^2 at 5 %, r = {n - u}",), None, float(stats.chi2.ppf(q, n - u)), 2))
    return Comparison("counts", "The adjustment at its start", ("quantity",), tuple(rows), "Global test and F test (eq. 8).")


def _criteria() -> Comparison:
    n, r = 2 * CONTROL_POINTS, 2 * CONTROL_POINTS - len(UNKNOWNS)
    limits = [("F test (8) at 5 %", float(stats.f.isf(ALPHA, 1, r))), (SPOKEN["variance_factor"], falls_below("variance_factor", n, r))]
    limits += [(f"(9b) read as {SECOND_SPOKEN[s]}", falls_below("criterion_b", n, r, s)) for s in get_args(Second) if s != "trace"]
    limits += [(SPOKEN[name], falls_below(name, n, r)) for name in ("aic", "aicc", "bic")]
    rows: list[Row] = []
    for name, limit in limits:
        rows.append(row((name, "falls on deletion if F is below"), None, limit, 3))
        rows.append(row((name, "a true zero is deleted in"), None, deletion_rate(limit, r), 3))
    note = (
        f"n = {n}, r = {r}. Deleting a parameter raises v'Pv by x^2 / q = F s0^2, so every criterion is a limit of F. The symbol of (9b) "
        "is illegible: three readings. The F test proposes deletions that the criteria refuse; one stands while at least one of (9a) to "
        "(9c) falls, so that a true zero is deleted as often as by the most willing of the three. AICc and BIC are not in the paper."
    )
    return Comparison("criteria", "Criteria (8) and (9) as limits of F", ("criterion", "quantity"), tuple(rows), note)


def _experiment() -> Comparison:
    rows = [
        row(("unknowns in the end",), FINAL_UNKNOWNS, "-", 0, RADAR),
        row(("stage at which all three criteria are least",), 3, "-", 0, RADAR),
        row(("check points, root mean square X (m)",), 5.3, "-", 1, RADAR),
        row(("check points, root mean square Y (m)",), 4.2, "-", 1, RADAR),
    ]
    note = "GlobeSAR image of Yangmei, 35 points in six runs with five of them withheld. Table 1, the criteria of each stage, is lost."
    return Comparison("experiment", "The experiment", ("quantity",), tuple(rows), note)


def reproduce() -> Reproduction:
    """Recompute what the paper prints, or what follows from its formulas, without its data.

    Returns
    -------
    Reproduction

    Notes
    -----
    Wu (2000), eqs. 7 to 9.

    Examples
    --------
    >>> reproduce().comparison("counts").value("redundancy r at the start")
    43.0
    """
    tables = (_counts(), _criteria(), _experiment())
    rate = {r.labels[0]: float(r.ours) for r in tables[1].rows if r.labels[1].startswith("a true zero")}
    shares = ", ".join(f"{name} {value:.3f}" for name, value in list(rate.items())[:3]) + f", {SPOKEN['aic']} {rate[SPOKEN['aic']]:.3f}"
    sentences = (
        "The counts of the experiment, n = 60, u = 17, r = 43, are met.",
        f"A parameter that is truly zero is deleted with these probabilities: {shares}.",
        "Missing is the experiment: its data are not public, and neither its stages nor its 5.3 and 4.2 m at check points are recomputed.",
    )
    return Reproduction(tables, (), sentences, NAME, TITLE, REFERENCE)


paper = Paper(NAME, TITLE, REFERENCE, reproduce)
