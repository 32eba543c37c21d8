"""Observations: one file per kind."""

from baarda.observations.angles import Angles
from baarda.observations.base import Block, Kind, Rows, component_unit
from baarda.observations.camera_positions import CameraPositions, LeverArms, Strips, lever_arms, strips
from baarda.observations.direct import CorrelatedPoints, Direct, direct_observations
from baarda.observations.directions import Directions, Stations, stations
from baarda.observations.distances import Distances
from baarda.observations.ellipsoid_heights import EllipsoidHeights
from baarda.observations.height_differences import HeightDifferences
from baarda.observations.image_coordinates import ImageCoordinates
from baarda.observations.image_points import ImagePoints
from baarda.observations.model_components import ModelHeights, ModelPlan
from baarda.observations.model_coordinates import ModelCoordinates, Models, models
from baarda.observations.range_doppler import RangeDoppler, Tracks, tracks
from baarda.observations.rays import viewpoints_of

__all__ = [
    "Angles",
    "Block",
    "CameraPositions",
    "CorrelatedPoints",
    "Direct",
    "Directions",
    "Distances",
    "EllipsoidHeights",
    "HeightDifferences",
    "ImageCoordinates",
    "ImagePoints",
    "Kind",
    "LeverArms",
    "ModelCoordinates",
    "ModelHeights",
    "ModelPlan",
    "Models",
    "RangeDoppler",
    "Rows",
    "Stations",
    "Strips",
    "Tracks",
    "component_unit",
    "direct_observations",
    "lever_arms",
    "models",
    "stations",
    "strips",
    "tracks",
    "viewpoints_of",
]
