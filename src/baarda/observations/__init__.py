"""Observations: one file per kind."""

from baarda.observations.angles import Angles
from baarda.observations.base import Block, Kind, Rows
from baarda.observations.direct import CorrelatedPoints, Direct, direct_observations
from baarda.observations.directions import Directions, Stations, stations
from baarda.observations.distances import Distances
from baarda.observations.height_differences import HeightDifferences
from baarda.observations.image_coordinates import ImageCoordinates
from baarda.observations.image_points import ImagePoints

__all__ = [
    "Angles",
    "Block",
    "CorrelatedPoints",
    "Direct",
    "Directions",
    "Distances",
    "HeightDifferences",
    "ImageCoordinates",
    "ImagePoints",
    "Kind",
    "Rows",
    "Stations",
    "direct_observations",
    "stations",
]
