"""Test of whole image points: x and y together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from baarda.errors import UsageError
from baarda.hypotheses._laws import BoundedLaw, check_redundancy, check_variance, number
from baarda.hypotheses.base import Floats, Law, TestResult
from baarda.hypotheses.levels import Policy, family_result

__all__ = ["image_points"]

# Below this share of the product of its diagonal, the determinant of a block is that of a point with an uncontrolled direction.
UNCONTROLLED = 1e-10


def image_points(
    numerators: ArrayLike,
    blocks: ArrayLike,
    sigma0: float = 1.0,
    redundancy: float | None = None,
    alpha: float = 0.001,
    levels: Policy = "none",
    labels: Sequence[str] = (),
) -> TestResult:
    """Test each image point, x and y together: no gross error in any direction.

    Parameters
    ----------
    numerators : (m, 2) array
        (P v) of the pairs, or v where observations are uncorrelated.
    blocks : (m, 2, 2) array
        The blocks of P Qvv P, or of Qvv.
    sigma0 : float
        Standard deviation of unit weight: a priori, or a posteriori if `redundancy` is given.
    redundancy : float, optional
        r if sigma0 is that of the same adjustment.
    alpha, levels, labels
        As in `data_snooping`.

    Returns
    -------
    TestResult
        u' M^-1 u / sigma0^2 under chi-square(2); a posteriori r Beta(1, (r - 2)/2). NaN where a direction of the point is uncontrolled.

    Raises
    ------
    UsageError
        If the shapes are not those of pairs.

    Notes
    -----
    Baarda's test with a two-dimensional alternative; the a-posteriori form is the two-dimensional tau.

    Examples
    --------
    >>> import numpy as np
    >>> image_points([[3.0, 1.0]], [np.diag([0.5, 0.8])]).statistic
    array([19.25])
    """
    u, m = np.atleast_2d(np.asarray(numerators, dtype=float)), np.asarray(blocks, dtype=float)
    if u.ndim != 2 or u.shape[1] != 2 or m.shape != (len(u), 2, 2):
        raise UsageError(f"image points come as (m, 2) residuals and (m, 2, 2) blocks, not {u.shape} and {m.shape}")
    check_variance(sigma0, "sigma0")
    statistic = _pairs(u, m) / sigma0**2
    null = "The image point has no gross error in x or y."
    law: Law = stats.chi2(2)
    spoken: str = "chi2(2)"
    df: tuple[float, ...] = (2.0,)
    if redundancy is not None:
        check_redundancy(redundancy - 2)
        statistic = statistic / 2.0
        law, spoken, df = (
            BoundedLaw(2.0, redundancy),
            f"{number(redundancy)}/2 Beta(1, {number((redundancy - 2) / 2)})",
            (2.0, float(redundancy)),
        )
    unseen = int(np.isnan(statistic).sum())
    note = f"{unseen} image points with an uncontrolled direction cannot be tested." if unseen else ""
    return family_result(
        "image_point", null, statistic, law, spoken, alpha, levels, labels=labels, df=df, note=note, details={"uncontrolled": unseen}
    )


def _pairs(u: Floats, m: Floats) -> Floats:
    """Return u' M^-1 u of 2 x 2 blocks; NaN where M has no inverse."""
    a, b, c = m[:, 0, 0], m[:, 0, 1], m[:, 1, 1]
    det = a * c - b * b
    seen = (a > 0.0) & (c > 0.0) & (det > UNCONTROLLED * a * c)
    top = c * u[:, 0] ** 2 - 2.0 * b * u[:, 0] * u[:, 1] + a * u[:, 1] ** 2
    out = np.full(len(u), np.nan)
    np.divide(top, det, out=out, where=seen)
    return out
