"""What data snooping decided, step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from baarda.network import Table
from baarda.procedures.suspicion import Unit


@dataclass(frozen=True)
class SnoopStep:
    """One decision of the snooping.

    Attributes
    ----------
    step : int
    action : {"rejected", "restored", "kept"}
        "kept": suspected, but not removed, for the reason in `note`.
    group, image, point, component : str
        What it is about; empty where it does not apply.
    statistic_name : str
        ``tau``, ``w``, ``t`` (externally studentised), or the law of a joint test.
    statistic, p_value, level : float
        The p-value is that of normal errors; NaN under another law.
    limit : float or None
        Critical value of the statistic's size, where it was found under a law of errors.
    studentised : float or None
        Externally studentised residual of a single coordinate: by the s0 without it.
    estimated_error : float or None
        Observed - true, of a single coordinate, in `unit`.
    unit : str
    redundancy_number : float or None
    partner : str
        The observation whose statistic is correlated most.
    correlation : float or None
    wrong_choice : float or None
        Probability that of the two the good one has the larger statistic, for an error of the estimated size.
    separable_bias : float or None
        Smallest error, in `unit`, with which the wrong one of the two is blamed with probability 1 - power at most; infinite where both
        cannot be told apart.
    sigma0, redundancy : float, int
        After the decision.
    suspected : int
        Observations (or image points) beyond the limit before the decision.
    note : str
    """

    step: int
    action: str
    group: str
    image: str
    point: str
    component: str
    statistic_name: str
    statistic: float
    p_value: float
    level: float
    studentised: float | None
    estimated_error: float | None
    unit: str
    redundancy_number: float | None
    partner: str
    correlation: float | None
    wrong_choice: float | None
    separable_bias: float | None
    sigma0: float
    redundancy: int
    suspected: int
    note: str = ""
    limit: float | None = None


@dataclass(frozen=True)
class Snooping:
    """The outcome of iterated data snooping.

    Attributes
    ----------
    unit : {"coordinate", "point", "image"}
    steps : tuple of SnoopStep
    removed : Table or None
        One row per scalar observation that stays out, as in the table of observations.
    images : tuple of str
        Images that were removed.
    alpha : float
        Level of a single test (of the family, where `levels` says so).
    levels : str
    law : str
        Of the statistic.
    start : str
        Where the search started: least squares, or the name of a law of errors.
    stopped : str
        Why it ended, a sentence.
    """

    unit: Unit
    steps: tuple[SnoopStep, ...]
    removed: Table | None
    images: tuple[str, ...]
    alpha: float
    levels: str
    law: str
    start: str
    stopped: str

    @property
    def count(self) -> int:
        """Scalar observations that stay out."""
        return 0 if self.removed is None else len(self.removed)

    def as_dict(self) -> dict[str, Any]:
        """Return the addition to `result.json`."""
        table = self.removed
        return {
            "unit": self.unit,
            "alpha": self.alpha,
            "levels": self.levels,
            "law": self.law,
            "start": self.start,
            "stopped": self.stopped,
            "steps": [vars(s) for s in self.steps],
            "removed": [] if table is None else list(table.rows()),
            "images_removed": list(self.images),
        }
