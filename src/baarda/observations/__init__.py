"""Observations: one file per kind."""

from baarda.observations.base import Block, Kind, Rows
from baarda.observations.direct import CorrelatedPoints, Direct, direct_observations
from baarda.observations.distances import Distances
from baarda.observations.image_points import ImagePoints

__all__ = ["Block", "CorrelatedPoints", "Direct", "Distances", "ImagePoints", "Kind", "Rows", "direct_observations"]
