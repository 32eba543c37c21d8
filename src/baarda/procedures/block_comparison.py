"""What the rows of many blocks say together: whether their variance factors are equal, and which blocks lie outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from baarda.hypotheses.base import TestResult
from baarda.hypotheses.homogeneity import bartlett, variance_per_image
from baarda.procedures.batch import Row

__all__ = ["BatchStudy", "compare_blocks"]


@dataclass(frozen=True)
class BatchStudy:
    """What the rows say together.

    Attributes
    ----------
    rows : tuple of dict
    alpha : float
    bartlett : TestResult or None
        Whether the variance factors of all blocks are equal.
    per_block : TestResult or None
        The variance factor of each block against the pooled one of those that agree.
    outlying : tuple of str
        Blocks whose variance factor deviates, in the order in which they were found; see `compare_blocks`.
    pooled : float or None
        Pooled sigma0 of the other blocks.
    left_out : tuple of (str, str)
    """

    rows: tuple[Row, ...]
    alpha: float
    bartlett: TestResult | None = None
    per_block: TestResult | None = None
    outlying: tuple[str, ...] = ()
    pooled: float | None = None
    left_out: tuple[tuple[str, str], ...] = ()

    def having(self, status: str) -> list[Row]:
        """Return the rows of a status: converged, not_converged, failed."""
        return [r for r in self.rows if r["status"] == status]

    @property
    def gates(self) -> dict[str, bool]:
        """What ``--strict`` asks: True where a test of any block rejects."""
        names = ("global", "data_snooping", "check_points", "control_points")
        return {n: any(bool(r[f"{n}_rejected"]) for r in self.rows) for n in names}

    @property
    def exit_code(self) -> int:
        """The gravest exit status of a block: cannot be written 4, not converged or singular 3, input 2, else 0."""
        return max((int(r["exit_code"] or 0) for r in self.rows), default=0)


def compare_blocks(rows: Sequence[Row], alpha: float = 0.05) -> BatchStudy:
    """Compare the variance factors of blocks.

    Parameters
    ----------
    rows : sequence of dict
        See `COLUMNS`.
    alpha : float
        Level of Bartlett's test, and of the whole search for outlying blocks.

    Returns
    -------
    BatchStudy

    Notes
    -----
    Bartlett's test as in Maarek & Konecny, appendix eq. A-1 to A-4. Outlying blocks are searched one by one: the block with the smallest
    exceedance probability against the pooled variance of those left is taken out while it is below alpha / k (Bonferroni, k the number of
    blocks left), half of the blocks at most; one coarse block would else make all others look outlying.

    Examples
    --------
    >>> rows = [{"block": f"b{i}", "status": "converged", "sigma0": s, "redundancy": 100} for i, s in enumerate((1.0, 1.1, 0.9, 3.0))]
    >>> compare_blocks(rows).outlying
    ('b3',)
    """
    usable = [r for r in rows if r["status"] == "converged" and r["sigma0"] and r["redundancy"]]
    study = BatchStudy(tuple(rows), alpha)
    if len(usable) < 2:
        return replace(study, left_out=(("homogeneity of the variance factors", "it needs two converged blocks"),))
    s2, df = np.array([r["sigma0"] ** 2 for r in usable]), np.array([float(r["redundancy"]) for r in usable])
    labels = [str(r["block"]) for r in usable]
    left, outlying = list(range(len(usable))), list[str]()
    while len(left) > max(2, (len(usable) + 1) // 2):
        p = np.asarray(variance_per_image(s2[left], df[left], None, alpha).p_value)
        k = int(np.argmin(p))
        if p[k] > alpha / len(left):
            break
        if p[k] == 0.0:  # beyond the smallest number: the largest ratio decides
            k = int(np.argmax(np.abs(np.log(s2[left] * df[left].sum() / (s2[left] * df[left]).sum())) * np.sqrt(df[left])))
        outlying.append(labels[left.pop(k)])
    pooled = float((s2[left] * df[left]).sum() / df[left].sum())
    return replace(
        study,
        bartlett=replace(bartlett(s2, df, alpha), name="bartlett_blocks", null="The variance factors of all blocks are equal."),
        per_block=variance_per_image(s2, df, pooled, alpha, labels=labels)
        if outlying
        else variance_per_image(s2, df, None, alpha, labels=labels),
        outlying=tuple(outlying),
        pooled=float(np.sqrt(pooled)),
    )
