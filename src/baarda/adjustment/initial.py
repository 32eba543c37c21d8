"""Start values for what a network does not know: resection, intersection, relative orientation to spread through the block.

Images that see enough known points are resected; points that enough oriented images see are intersected; both alternate. Where nothing
is known, or no image sees enough of it, a pair of images is oriented relatively and the model is carried on from there; a model that
stands free of the control is moved onto it by a similarity transformation as soon as three control points lie in it.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FREE, Optics
from baarda.errors import BaardaError, Singular, UsageError
from baarda.geometry.intersection import PointStatus, intersect
from baarda.geometry.relative_orientation import RelativeOrientation, relative_orientation
from baarda.geometry.resection import resect
from baarda.geometry.similarity import similarity
from baarda.network import Network, State, Viewpoints
from baarda.observations import ImagePoints, viewpoints_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]

ENOUGH = 4  # points for a resection
PARALLEL = 0.02  # root mean square angle of rays to their mean, radians, up to which they may meet almost at infinity


def complete(network: Network, aside: Bools) -> tuple[Network, list[str]]:
    """Return the network with start values for everything that takes part.

    Parameters
    ----------
    network : Network
    aside : (points,) bool array
        Points that do not take part.

    Returns
    -------
    network : Network
    notes : list of str
        Where start values came from.

    Raises
    ------
    Singular
        If images or points are left without start values; names them.
    UsageError
        If there are no image points to find them with.
    """
    for group in network.observations:
        if hasattr(group, "with_start"):  # kinds that know how to start the unknowns that they declare
            network = group.with_start(network, aside)
    images, points = network.images, network.points
    missing_images = np.asarray(~(np.isfinite(images.position).all(axis=1) & np.isfinite(images.rotation).all(axis=(1, 2))))
    missing_points = np.asarray(~np.isfinite(points.coordinates).all(axis=1) & ~aside)
    if not (missing_images.any() or missing_points.any()):
        return _nearer(network, aside, [])
    search = _Search(network, aside, ~missing_images, ~missing_points & ~aside)
    search.run()
    left = [f"image {images.labels[i]}" for i in np.flatnonzero(~search.oriented)]
    left += [f"point {points.labels[i]}" for i in np.flatnonzero(~search.known & ~aside)]
    if left:
        shown = ", ".join(left[:12]) + (f" and {len(left) - 12} more" if len(left) > 12 else "")
        raise Singular(f"no start values found for {len(left)} image(s) or point(s): {shown}{search.why}", left)
    notes = []
    if missing_images.any():
        notes.append(f"start values of {int(missing_images.sum())} image(s) by {' and '.join(search.methods)}")
    if missing_points.any():
        if count := int(missing_points.sum()) - int(search.far.sum()):
            notes.append(f"start values of {count} point(s) by intersection")
        if search.far.any():
            names = _names(points.labels, search.far)
            notes.append(f"start values of {int(search.far.sum())} point(s) far out on rays that do not meet: {names}")
    network = replace(
        network,
        images=replace(images, position=search.position, rotation=search.rotation),
        points=replace(points, coordinates=search.coordinates),
    )
    return _nearer(network, aside, notes)


def _names(labels: tuple[str, ...], which: Bools) -> str:
    at = np.flatnonzero(which)
    return ", ".join(labels[i] for i in at[:10]) + (", ..." if len(at) > 10 else "")


def _nearer(network: Network, aside: Bools, notes: list[str]) -> tuple[Network, list[str]]:
    """Bring the start values of points almost at infinity to where their distance still counts in the normal equations."""
    seen, points = viewpoints_of(network.observations, State.of(network)), network.points
    which = seen.beyond_start(points.coordinates) & (points.states == FREE).all(axis=1) & ~aside
    if not which.any():
        return network, notes
    note = f"start values of {int(which.sum())} point(s) almost at infinity brought nearer along their rays: {_names(points.labels, which)}"
    return replace(network, points=replace(points, coordinates=seen.nearer(points.coordinates, which))), [*notes, note]


class _Search:
    """The state of the search: what is oriented, what is known, and the normalised image coordinates of all rays."""

    def __init__(self, network: Network, aside: Bools, oriented: Bools, known: Bools) -> None:
        groups = [g for g in network.observations if isinstance(g, ImagePoints)]
        if not groups:
            raise UsageError("start values are missing and there are no image points to find them with")
        self.network = network
        self.image = np.concatenate([g.images for g in groups])
        self.point = np.concatenate([g.points for g in groups])
        use = ~aside[self.point]
        pixels, sigmas = np.concatenate([g.xy for g in groups])[use], np.concatenate([g.sigmas for g in groups])[use]
        self.image, self.point = self.image[use], self.point[use]
        self.xy, valid = _normalised(network, self.image, pixels)
        distance = np.array([_distance(network, i) for i in range(len(network.images.labels))])
        self.sigma = sigmas / distance[self.image][:, None]
        self.image, self.point, self.xy, self.sigma = self.image[valid], self.point[valid], self.xy[valid], self.sigma[valid]
        self.oriented, self.known = oriented.copy(), known.copy()
        self.fixed_frame = bool(known.any() or oriented.any())
        self.position, self.rotation = np.array(network.images.position), np.array(network.images.rotation)
        self.coordinates = np.array(network.points.coordinates)
        self.far = np.zeros(len(known), dtype=bool)  # placed where their rays do not meet
        self.methods: list[str] = []
        self.why = ""

    def run(self) -> None:
        """Alternate until nothing more is found."""
        while True:
            progress = self.resect_all() or self.intersect_all()
            if progress:
                continue
            if self.oriented.all() and (self.known | ~self.seen()).all():
                return
            if self.oriented.all() and self.place_far():
                continue
            if not self.start_model():
                return

    def seen(self) -> Bools:
        """Return which points have a ray."""
        return np.asarray(np.bincount(self.point, minlength=len(self.known)) > 0)

    def resect_all(self) -> bool:
        """Resect the images that see the most known points; those that see clearly fewer wait, unless the others fail."""
        usable = self.known[self.point]
        counts = np.bincount(self.image[usable], minlength=len(self.oriented))
        waiting = np.flatnonzero(~self.oriented & (counts >= ENOUGH))
        if not len(waiting):
            return False
        rich = counts[waiting] >= 0.5 * counts[waiting].max()
        done = self._resect(waiting[rich], usable) or self._resect(waiting[~rich], usable)
        if done:
            self._method("resection")
        return done

    def _resect(self, images: Ints, usable: Bools) -> bool:
        done = False
        for i in images:
            rows = np.flatnonzero(usable & (self.image == i))
            try:
                pose = resect(self.xy[rows], self.coordinates[self.point[rows]])
            except BaardaError as error:
                self.why = f" (image {self.network.images.labels[i]}: {error})"
                continue
            self.position[i], self.rotation[i] = pose.position, pose.rotation
            self.oriented[i] = done = True
        return done

    def intersect_all(self, min_angle: float = 0.02) -> bool:
        """Intersect unknown points; small angles only when nothing else is left."""
        wanted = ~self.known[self.point] & self.oriented[self.image]
        rows = np.flatnonzero(wanted)
        if not len(rows):
            return False
        for angle in (min_angle, 1e-3, 1e-5):
            found = intersect(
                self.xy[rows],
                self.rotation[self.image[rows]],
                self.position[self.image[rows]],
                self.point[rows],
                len(self.known),
                sigmas=self.sigma[rows],
                min_angle=angle,
            )
            good = found.status == PointStatus.OK
            if good.any():
                self.coordinates[good], self.known[good] = found.points[good], True
                return True
        return False

    def place_far(self) -> bool:
        """Place points whose rays are almost parallel, or meet behind the cameras, far out on their mean ray."""
        rows = np.flatnonzero(~self.known[self.point])
        rays = np.einsum("nji,nj->ni", self.rotation[self.image[rows]], np.column_stack([self.xy[rows], -np.ones(len(rows))]))
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        count = len(self.known)
        mean = np.stack([np.bincount(self.point[rows], rays[:, k], count) for k in range(3)], axis=1)
        size = np.linalg.norm(mean, axis=1)
        number = np.bincount(self.point[rows], minlength=count)
        parallel = (number >= 2) & (size > np.cos(PARALLEL) * number)
        seen = Viewpoints.of(self.image[rows], self.point[rows], self.position, count)
        good = parallel & (seen.base > 0.0)
        self.coordinates[good] = seen.centres[good] + mean[good]
        self.coordinates = seen.nearer(self.coordinates, good)
        self.known |= good
        self.far |= good
        return bool(good.any())

    def start_model(self) -> bool:
        """Orient a pair of images relatively: in the free network, or as a model that is then moved onto the control."""
        if self.fixed_frame:
            return self._model_on_control()
        pair = self._best_pair()
        if pair is None:
            return False
        first, second, model = pair
        self.position[first], self.rotation[first] = 0.0, np.eye(3)
        self.position[second], self.rotation[second] = model.base, model.rotation
        self.oriented[[first, second]] = True
        self.fixed_frame = True
        self._method("relative orientation")
        return True

    def _best_pair(self) -> tuple[int, int, RelativeOrientation] | None:
        """Return the pair with many common points and a large angle between the rays."""
        rows = [np.flatnonzero(self.image == i) for i in range(len(self.oriented))]
        shared = []
        for i, j in combinations(range(len(rows)), 2):
            count = len(np.intersect1d(self.point[rows[i]], self.point[rows[j]]))
            if count >= 6:
                shared.append((-count, i, j))
        best: tuple[float, int, int, RelativeOrientation] | None = None
        for _, i, j in sorted(shared)[:12]:
            _, a, b = np.intersect1d(self.point[rows[i]], self.point[rows[j]], return_indices=True)
            try:
                model = relative_orientation(self.xy[rows[i][a]], self.xy[rows[j][b]])
            except BaardaError as error:
                self.why = f" ({error})"
                continue
            points = model.points[np.isfinite(model.points).all(axis=1)]
            if not len(points):
                continue
            depth = float(np.median(np.linalg.norm(points, axis=1)))  # in bases
            score = len(points) * min(1.0, 3.0 / depth)
            if best is None or score > best[0]:
                best = (score, i, j, model)
        return None if best is None else best[1:]

    def _model_on_control(self) -> bool:
        """Build a free model of the images that are left, then move it onto what is known."""
        free = _Search.__new__(_Search)
        free.__dict__.update({k: (v.copy() if isinstance(v, np.ndarray) else v) for k, v in self.__dict__.items()})
        free.oriented, free.known = np.zeros_like(self.oriented), np.zeros_like(self.known)
        free.fixed_frame, free.methods = False, []
        free.run_free()
        common = free.known & self.known
        if common.sum() < 3:
            self.why = self.why or " (fewer than three known points lie in the model of the images)"
            return False
        try:
            move = similarity(free.coordinates[common], self.coordinates[common])
        except BaardaError as error:
            self.why = f" ({error})"
            return False
        new = free.oriented & ~self.oriented
        self.position[new] = move.apply(free.position[new])
        self.rotation[new] = free.rotation[new] @ move.rotation.T
        self.oriented |= new
        self._method("relative orientation")
        return bool(new.any())

    def run_free(self) -> None:
        """Grow one free model as far as it goes."""
        if not self.start_model():
            return
        while self.resect_all() or self.intersect_all():
            pass

    def _method(self, name: str) -> None:
        if name not in self.methods:
            self.methods.append(name)


def _normalised(network: Network, image: Ints, pixels: Floats) -> tuple[Floats, Bools]:
    """Return normalised coordinates of all rays and whether the distortion could be inverted."""
    out, valid = np.empty_like(pixels), np.empty(len(pixels), dtype=bool)
    camera = network.images.cameras[image]
    for i in np.unique(camera):
        rows = camera == i
        c = network.cameras[i]
        out[rows], valid[rows] = Optics.of(c).correct(pixels[rows], c.values[None])
    return out, valid


def _distance(network: Network, image: int) -> float:
    """Return the principal distance of an image's camera in source pixels."""
    c = network.cameras[network.images.cameras[image]]
    value = next((v for name, v in zip(c.model.order, c.values, strict=True) if name.startswith("principal_distance")), 1.0)
    return float(value / c.pixel_size[0])
