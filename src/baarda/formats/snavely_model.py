"""What BAL problems and Bundler files hold alike: images with f, k1, k2, R, t, and object points with their image points.

P = R X + t with Snavely's camera axes, which are ours: M = R, projection centre -R't; image points from the image centre, y up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.errors import InputError, UsageError
from baarda.formats import checks
from baarda.network import Images, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

PARAMETERS = ("principal_distance", "k1", "k2")
LARGEST_PARAMETER = 1e12  # no lens has more, and its square must not overflow
#: models that Snavely's camera contains once the principal point is subtracted
_CONTAINED = ("snavely", "pinhole", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


@dataclass(frozen=True)
class SnavelyModel:
    """Images and points.

    Attributes
    ----------
    parameters : (n, 3) array
        f, k1, k2 of each image.
    rotation : (n, 3, 3) array
    translation : (n, 3) array
    points : (m, 3) array
    images_of, points_of : (k,) int arrays
        Image and object point of each image point.
    xy : (k, 2) array
        Image points, pixels from the image centre, y up.
    labels, point_labels : sequences of str
    """

    parameters: Floats
    rotation: Floats
    translation: Floats
    points: Floats
    images_of: Integers
    points_of: Integers
    xy: Floats
    labels: Sequence[str]
    point_labels: Sequence[str]

    def network(self, source: str, image_error: Callable[[int, str], InputError], notes: Sequence[str] = ()) -> Network:
        """Return the network: a camera for each image, all its parameters free, a free datum.

        Parameters
        ----------
        source : str
            Name of the format for the notes.
        image_error : callable
            Image and message to the error with file and line.
        notes : sequence of str
            Further assumptions.

        Raises
        ------
        InputError
            If a principal distance is not positive, a parameter beyond all lenses, a matrix no rotation, or an image has no image points.
        """
        for k, name in enumerate(PARAMETERS):
            values = self.parameters[:, k]
            bad = np.flatnonzero((np.abs(values) > LARGEST_PARAMETER) | ((values <= 0.0) & (k == 0)))
            if len(bad):
                what = "must be positive and below" if k == 0 else "must lie within"
                raise image_error(
                    int(bad[0]), f"image {self.labels[bad[0]]}: {name} {what} {LARGEST_PARAMETER:g}, not {values[bad[0]]:.17g}"
                )
        checks.rotation_matrices(self.rotation, image_error)
        checks.images_with_points(self.images_of, self.labels, np.ones(len(self.labels), dtype=bool), image_error)
        said = [
            f"image sigma 1 px, because a {source} has none",
            f"a {source} does not say which camera parameters were estimated: principal distance, k1 and k2 of every image are free",
            *notes,
        ]
        key = self.images_of * len(self.points) + self.points_of
        repeated = len(key) - len(np.unique(key))
        if repeated:
            said.append(f"{repeated} image point(s) measure a point that their image measures already; all are kept")
        model = camera_models.model("snavely")
        return Network(
            tuple(
                camera_models.create(label, model, dict(zip(PARAMETERS, p, strict=True)), free=PARAMETERS, y_down=False)
                for label, p in zip(self.labels, self.parameters.tolist(), strict=True)
            ),
            Images.make(self.labels, np.arange(len(self.labels)), self._position(), self.rotation),
            Points.make(self.point_labels, self.points),
            (ImagePoints.make(self.images_of, self.points_of, self.xy),),
            unit=checks.MODEL_UNITS,
            assumptions=tuple(said),
        )

    def _position(self) -> Floats:
        return np.asarray(-np.einsum("nji,nj->ni", self.rotation, self.translation))

    @staticmethod
    def of(network: Network, target: str) -> SnavelyModel:
        """Return what a network holds; points without image points are left out, and so are sigmas, roles and states.

        Parameters
        ----------
        network : Network
            Cameras that Snavely's camera contains exactly (pinhole, snavely, COLMAP's SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL), all images
            oriented, all measured points with coordinates.
        target : str
            Name of the format for messages.

        Raises
        ------
        UsageError
            If the network holds anything else.
        """
        images, points = network.images, network.points
        groups = [g for g in network.observations if isinstance(g, ImagePoints)]
        if len(groups) < len(network.observations) or not groups:
            raise UsageError(f"a {target} holds image points only, and there must be some")
        oriented = np.isfinite(images.position).all(axis=1) & np.isfinite(images.rotation).all(axis=(1, 2))
        if not oriented.all():
            raise UsageError(f"image {images.labels[int(np.argmin(oriented))]} has no orientation")
        image, point, pixels = (np.concatenate([getattr(g, a) for g in groups]) for a in ("images", "points", "xy"))
        used, index = np.unique(point, return_inverse=True)
        known = np.isfinite(points.coordinates[used]).all(axis=1)
        if not known.all():
            raise UsageError(f"point {points.labels[used[int(np.argmin(known))]]} has no coordinates")
        each = [_parameters(c, target) for c in network.cameras]
        values = np.array([v for v, _, _ in each])
        centre, sign = np.array([c for _, c, _ in each]), np.array([s for _, _, s in each])
        of = images.cameras[image]
        return SnavelyModel(
            values[images.cameras],
            np.asarray(images.rotation),
            np.asarray(-np.einsum("nij,nj->ni", images.rotation, images.position)),
            points.coordinates[used],
            image,
            index.astype(np.intp),
            (pixels - centre[of]) * np.stack([np.ones(len(of)), sign[of]], axis=1),
            images.labels,
            [points.labels[i] for i in used],
        )


def _parameters(camera: Camera, target: str) -> tuple[list[float], list[float], float]:
    """Return f, k1, k2 in pixels, the principal point in source pixels, and the sign of y."""
    size = np.ravel(camera.pixel_size)
    if camera.model.name not in _CONTAINED or (size != size[0]).any():
        raise UsageError(
            f"camera {camera.label}: a {target} cannot hold model {camera.model.name!r} with these pixels; "
            f"it holds square pixels and {', '.join(_CONTAINED)}"
        )
    value = dict(zip(camera.model.order, np.asarray(camera.values, dtype=float).tolist(), strict=True))
    centre = [
        float(o) + value.get(f"principal_point_{a}", 0.0) / float(size[0]) for a, o in zip("xy", np.ravel(camera.origin), strict=True)
    ]
    return (
        [value["principal_distance"] / float(size[0]), value.get("k1", 0.0), value.get("k2", 0.0)],
        centre,
        -1.0 if camera.y_down else 1.0,
    )
