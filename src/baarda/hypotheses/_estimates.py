"""The estimated parameters of an evidence that can be tested, and results that say in words why a test is not applicable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from baarda.hypotheses._laws import f_law, f_name
from baarda.hypotheses.base import Estimates, Evidence, Floats, TestResult
from baarda.hypotheses.levels import Options, Policy, family_result


@dataclass(frozen=True)
class Judged:
    """Estimates with a positive cofactor, and what judges them.

    Attributes
    ----------
    estimates : Estimates
    variance_factor : float
        s0^2, or sigma0^2 with infinite `redundancy`.
    redundancy : float
    left_out : tuple of str
        Parameters whose cofactor is zero.
    """

    estimates: Estimates
    variance_factor: float
    redundancy: float
    left_out: tuple[str, ...]

    @property
    def note(self) -> str:
        """What is left out, in words; empty where nothing is."""
        return f"Not applicable to {', '.join(self.left_out)}: the cofactor is zero, the value is fixed." if self.left_out else ""


def judged(evidence: Evidence, options: Options) -> Judged | None:
    """Return the additional parameters that can be tested; None where there are none or nothing judges them."""
    e = evidence.additional
    if e is None or len(e.values) == 0 or evidence.vpv <= 0.0:
        return None
    aposteriori = options.sigma == "aposteriori"
    factor = evidence.variance_factor if aposteriori else evidence.sigma0_apriori**2
    r = float(evidence.redundancy) if aposteriori else np.inf
    known = np.diagonal(e.cofactors) > 0.0
    left_out = tuple(n for n, k in zip(e.names, known, strict=True) if not k)
    if left_out:
        groups = tuple(g for g, k in zip(e.groups, known, strict=True) if k) if e.groups else ()
        names = tuple(n for n, k in zip(e.names, known, strict=True) if k)
        e = Estimates(names, e.values[known], e.cofactors[np.ix_(known, known)], None, groups)
    return Judged(e, factor, r, left_out)


def not_applicable(
    name: str,
    null: str,
    reason: str,
    alpha: float,
    redundancy: float,
    labels: Sequence[str] = ("all",),
    df: int = 1,
    policy: Policy = "none",
) -> TestResult:
    """Return a family of which no member can be tested, with the reason in its note."""
    nothing: Floats = np.full(len(labels), np.nan)
    law, words = f_law(df, redundancy), f_name(df, redundancy)
    return family_result(name, null, nothing, law, words, alpha, policy, labels=labels, note=f"Not applicable: {reason}.")


def joined(*notes: str) -> str:
    """Return the sentences that are there, with a blank between them."""
    return " ".join(n for n in notes if n)
