"""A start for data snooping that errors which mask each other do not spoil: what a robust adjustment suspects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment import Adjustment, adjust
from baarda.errors import UsageError
from baarda.hypotheses.levels import Options
from baarda.network import Network

Ints = NDArray[np.intp]
NORMAL_MAD = 0.6744897501960817  # median of |N(0, 1)|


def suspects(
    a: Adjustment,
    units: Sequence[Ints],
    network: Network,
    law: str,
    shapes: Mapping[str, float] | None,
    options: Options,
    settings: Mapping[str, Any],
) -> list[Ints]:
    """Return the units with residuals beyond the limit of good observations in a robust adjustment, the worst first.

    Parameters
    ----------
    a : Adjustment
        By least squares: the redundancy numbers.
    units : sequence of int arrays
        Scalar rows of each unit.
    network : Network
    law : str
        Law of errors, bounded or redescending (cauchy, student, huber, ...).
    shapes : mapping or None
        Of the law.
    options : Options
        `alpha_outlier` sets the limit.
    settings : mapping
        Fields of `Settings`.

    Returns
    -------
    list of int arrays

    Raises
    ------
    UsageError
        If the law does not resist gross errors, or the robust adjustment does not converge.

    Notes
    -----
    Residuals are divided by sigma sqrt(r_i) and by a scale that gross errors do not move: the median of their sizes over 0.6745. The
    start is generous; what is innocent is restored later.
    """
    found = adjust(network, robust=law, robust_shapes=shapes, **settings)
    if found.law is None or found.law.resistance == "none":
        raise UsageError(f"law {law} does not resist gross errors: start the snooping under cauchy, student, huber or the like")
    if found.status != "converged":
        raise UsageError(f"the adjustment under the law {law} did not converge: start the snooping from least squares")
    share = a.redundancy_numbers
    seen = share > 0.01
    z = np.zeros(found.count)
    np.divide(np.abs(found.residuals), found.sigmas * np.sqrt(np.where(seen, share, 1.0)), out=z, where=seen)
    scale = float(np.median(z[seen])) / NORMAL_MAD
    limit = float(stats.norm.isf(options.alpha_outlier / 2.0)) * (scale if options.sigma == "aposteriori" else 1.0)
    size = np.array([float(z[rows].max()) for rows in units])
    order = np.argsort(-size, kind="stable")
    return [units[i] for i in order if size[i] > limit]
