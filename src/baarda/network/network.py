"""The network: cameras, images, object points and groups of observations as frozen columnar tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE, OBSERVED, Camera
from baarda.errors import UsageError
from baarda.network.declared import Declared

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
States = NDArray[np.int8]

TIE, CONTROL, CHECK = 0, 1, 2
ROLES = ("tie", "control", "check")
EXTERIOR = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
AXES = ("X", "Y", "Z")


def _frozen(obj: Any, **arrays: Any) -> None:
    """Store read-only views; the caller's arrays stay as they are."""
    for name, a in arrays.items():
        view = np.asarray(a).view()
        view.flags.writeable = False
        object.__setattr__(obj, name, view)


@dataclass(frozen=True)
class Images:
    """Images with exterior orientation.

    Attributes
    ----------
    labels : tuple of str
    cameras : (n,) int array
        Index of each image's camera.
    position : (n, 3) array
        Start or adjusted projection centre, object units; NaN = missing.
    rotation : (n, 3, 3) array
        Start or adjusted M, camera from object; NaN = missing.
    states : (n, 6) int8 array
        State of X0 Y0 Z0 omega phi kappa; the three angles are fixed together or not at all.
    given, sigmas : (n, 6) arrays
        Directly observed values and their standard deviations (object units, radians); NaN elsewhere.
    """

    labels: tuple[str, ...]
    cameras: Ints
    position: Floats
    rotation: Floats
    states: States
    given: Floats
    sigmas: Floats

    def __post_init__(self) -> None:
        n = len(self.labels)
        _frozen(self, cameras=np.asarray(self.cameras, dtype=np.intp), states=np.asarray(self.states, dtype=np.int8))
        _frozen(self, **{k: np.asarray(getattr(self, k), dtype=float) for k in ("position", "rotation", "given", "sigmas")})
        shapes = {"cameras": (n,), "position": (n, 3), "rotation": (n, 3, 3), "states": (n, 6), "given": (n, 6), "sigmas": (n, 6)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise UsageError(f"images: {name} has shape {getattr(self, name).shape}, needed is {shape}")
        fixed = self.states[:, 3:] == FIXED
        partly = np.flatnonzero(fixed.any(axis=1) & ~fixed.all(axis=1))
        if len(partly):
            label = self.labels[partly[0]]
            raise UsageError(f"image {label}: omega, phi and kappa must be fixed together (observe a single angle instead)")

    @staticmethod
    def make(
        labels: Sequence[str],
        cameras: Any = None,
        position: Any = None,
        rotation: Any = None,
        states: Any = None,
        given: Any = None,
        sigmas: Any = None,
    ) -> Images:
        """Make images with defaults: first camera, no start values, everything free, nothing observed."""
        n = len(labels)
        nan = np.full
        return Images(
            tuple(labels),
            np.zeros(n, dtype=np.intp) if cameras is None else cameras,
            nan((n, 3), np.nan) if position is None else position,
            nan((n, 3, 3), np.nan) if rotation is None else rotation,
            nan((n, 6), FREE, dtype=np.int8) if states is None else states,
            nan((n, 6), np.nan) if given is None else given,
            nan((n, 6), np.nan) if sigmas is None else sigmas,
        )


@dataclass(frozen=True)
class Points:
    """Object points.

    Attributes
    ----------
    labels : tuple of str
    coordinates : (n, 3) array
        Start or adjusted X, Y, Z; NaN = missing.
    roles : (n,) int8 array
        0 tie, 1 control (enters the adjustment), 2 check (only judges it).
    states : (n, 3) int8 array
        State of each coordinate; coordinates of check points are free.
    given, sigmas : (n, 3) arrays
        Surveyed coordinates of control and check points and their standard deviations; NaN = none; an exact check coordinate has sigma 0.
    correlations : (n, 3) array
        Correlations XY, XZ, YZ of the surveyed coordinates.
    """

    labels: tuple[str, ...]
    coordinates: Floats
    roles: States
    states: States
    given: Floats
    sigmas: Floats
    correlations: Floats

    def __post_init__(self) -> None:
        n = len(self.labels)
        _frozen(self, roles=np.asarray(self.roles, dtype=np.int8), states=np.asarray(self.states, dtype=np.int8))
        _frozen(self, **{k: np.asarray(getattr(self, k), dtype=float) for k in ("coordinates", "given", "sigmas", "correlations")})
        for name in ("coordinates", "states", "given", "sigmas", "correlations"):
            if getattr(self, name).shape != (n, 3):
                raise UsageError(f"points: {name} has shape {getattr(self, name).shape}, needed is {(n, 3)}")

    @staticmethod
    def make(
        labels: Sequence[str],
        coordinates: Any = None,
        roles: Any = None,
        states: Any = None,
        given: Any = None,
        sigmas: Any = None,
        correlations: Any = None,
    ) -> Points:
        """Make points with defaults: tie points, free, without start values."""
        n = len(labels)
        return Points(
            tuple(labels),
            np.full((n, 3), np.nan) if coordinates is None else coordinates,
            np.zeros(n, dtype=np.int8) if roles is None else roles,
            np.full((n, 3), FREE, dtype=np.int8) if states is None else states,
            np.full((n, 3), np.nan) if given is None else given,
            np.full((n, 3), np.nan) if sigmas is None else sigmas,
            np.zeros((n, 3)) if correlations is None else correlations,
        )

    def covariance(self, rows: Ints) -> Floats:
        """Return the (k, 3, 3) covariance matrices of the surveyed coordinates of some points."""
        c = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
        for j, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            c[:, a, b] = c[:, b, a] = self.correlations[rows, j]
        s = self.sigmas[rows]
        return c * s[:, :, None] * s[:, None, :]


class ObservationGroup(Protocol):
    """What a network knows of its observations; the kinds live in `baarda.observations`."""

    @property
    def name(self) -> str:
        """Name of the group."""

    def __len__(self) -> int: ...

    def selected(self, keep: Any) -> ObservationGroup:
        """Return the group with some of its rows only (index or mask)."""

    def points_of(self) -> tuple[Ints, ...]:
        """Return the indices of the object points in each row, one array per end."""


@dataclass(frozen=True)
class Network:
    """Cameras, images, points and observations that belong together.

    Attributes
    ----------
    cameras : tuple of Camera
    images : Images
    points : Points
    observations : tuple of observation groups
    unit : str
        Unit of object coordinates.
    name : str
    offset : (3,) array
        What was added to the object coordinates of the source.
    settings : mapping
        Options found in the source (`datum`, `min_rays`, ...); options given to `adjust` win over them.
    assumptions : tuple of str
        What a reader assumed because the source does not say; every one is listed in the report.
    path, format : str
        Where the network was read from.
    sha256 : str or None
        Of the source file, or over the sorted names and contents of a source folder.
    declared : tuple of Declared
        Groups of unknowns that observation kinds declare for themselves, each of another kind.
    """

    cameras: tuple[Camera, ...]
    images: Images
    points: Points
    observations: tuple[Any, ...]
    unit: str = "m"
    name: str = ""
    offset: Floats = field(default_factory=lambda: np.zeros(3))
    settings: Mapping[str, Any] = field(default_factory=dict)
    assumptions: tuple[str, ...] = ()
    path: str = ""
    format: str = ""
    sha256: str | None = None
    declared: tuple[Declared, ...] = ()

    def shifted(self, shift: Floats) -> Network:
        """Return the network with `shift` added to all object coordinates; `offset` remembers the sum."""
        im, pt = self.images, self.points
        given = im.given + np.concatenate([shift, np.zeros(3)])
        return replace(
            self,
            images=replace(im, position=im.position + shift, given=given),
            points=replace(pt, coordinates=pt.coordinates + shift, given=pt.given + shift),
            offset=self.offset + shift,
            declared=tuple(d.shifted(shift) for d in self.declared),
        )

    def centroid(self) -> Floats:
        """Return the middle (medians) of all known object coordinates, rounded to whole units; zero where nothing is known."""
        known = self.points.coordinates[np.isfinite(self.points.coordinates).all(axis=1)]
        if not len(known):
            known = self.images.position[np.isfinite(self.images.position).all(axis=1)]
        return np.round(np.median(known, axis=0)) + 0.0 if len(known) else np.zeros(3)

    def with_camera_states(self, index: int, states: States) -> Network:
        """Return the network with other states of one camera's parameters."""
        cameras = list(self.cameras)
        cameras[index] = replace(cameras[index], states=np.asarray(states, dtype=np.int8))
        return replace(self, cameras=tuple(cameras))


__all__ = [
    "AXES",
    "CHECK",
    "CONTROL",
    "EXTERIOR",
    "FIXED",
    "FREE",
    "OBSERVED",
    "ROLES",
    "TIE",
    "Images",
    "Network",
    "ObservationGroup",
    "Points",
]
