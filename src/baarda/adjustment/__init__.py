"""The least-squares adjustment."""

from baarda.adjustment.result import Adjustment, Iteration
from baarda.adjustment.solve import Settings, adjust

__all__ = ["Adjustment", "Iteration", "Settings", "adjust"]
