"""Writing COLMAP text models; what COLMAP has no place for (sigmas, roles, states) is not written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from baarda.cameras import Camera
from baarda.errors import UsageError
from baarda.formats.base import first_pixel
from baarda.formats.colmap_model import CAMERA_MODELS
from baarda.formats.folder import write_folder
from baarda.formats.opencv_form import ORDER, as_opencv, plain_pixels
from baarda.network import Network
from baarda.observations import ImagePoints


def write(network: Network, path: Path) -> None:
    """Write a network as a COLMAP text model.

    Parameters
    ----------
    network : Network
        Cameras of COLMAP's models, or of OpenCV's, Pix4D's and Metashape's that FULL_OPENCV contains, all images oriented, all measured
        points with coordinates; points without image points are left out. Pixels whose first one has its centre at (0, 0) move by half
        a pixel to COLMAP's.
    path : Path
        The folder; it must not exist yet, or be empty.

    Raises
    ------
    UsageError
        If the network holds what COLMAP cannot express.
    OutputError
        If the folder cannot be written; nothing is left behind.
    """
    files = {"cameras.txt": _cameras(network), **_images_and_points(network)}
    write_folder(path, {name: "\n".join(lines) + "\n" for name, lines in files.items()})


def _ids(labels: list[str]) -> list[int]:
    """Return the labels as ids where all are different positive integers, else 1, 2, 3, ..."""
    if all(t.isascii() and t.isdigit() and t == str(int(t)) and 0 < int(t) < 2**32 - 1 for t in labels):
        return [int(t) for t in labels]
    return list(range(1, len(labels) + 1))


def _shift(network: Network) -> float:
    """Return what leads from the pixels of a network to COLMAP's, whose first one has its centre at 0.5."""
    first = first_pixel(network)
    return 0.0 if first is None else 0.5 - first


def _cameras(network: Network) -> list[str]:
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        f"# Number of cameras: {len(network.cameras)}",
    ]
    for number, c in zip(_ids([c.label for c in network.cameras]), network.cameras, strict=True):
        name, parameters = _parameters(c, _shift(network))
        if not plain_pixels(c) or c.image_size is None or not all(float(s).is_integer() for s in c.image_size):
            raise UsageError(f"camera {c.label}: COLMAP needs pixels from the upper left corner, y down, and the image size")
        values = " ".join(repr(v) for v in parameters)
        lines.append(f"{number} {name} {int(c.image_size[0])} {int(c.image_size[1])} {values}")
    return lines


def _parameters(camera: Camera, shift: float) -> tuple[str, list[float]]:
    """Return COLMAP's model and parameters; what is in OpenCV's terms becomes FULL_OPENCV."""
    if camera.model.name in CAMERA_MODELS.values():
        point = np.array([n.startswith("principal_point") for n in camera.model.order])
        return camera.model.name, (np.asarray(camera.values, dtype=float) + shift * point).tolist()
    found = as_opencv(camera)
    if found is None:
        raise UsageError(f"camera {camera.label}: COLMAP has no model {camera.model.name!r}")
    found["cx"] += shift
    found["cy"] += shift
    if camera.model.name == "pinhole":
        return "SIMPLE_PINHOLE", [found["fx"], found["cx"], found["cy"]]
    return "FULL_OPENCV", [found[n] for n in ORDER]


def _images_and_points(network: Network) -> dict[str, list[str]]:
    from scipy.spatial.transform import Rotation

    images, points = network.images, network.points
    oriented = np.isfinite(images.position).all(axis=1) & np.isfinite(images.rotation).all(axis=(1, 2))
    if not oriented.all():
        raise UsageError(f"image {images.labels[int(np.argmin(oriented))]} has no orientation")
    for label in images.labels:
        if not label or label != label.strip() or "\n" in label or "\r" in label or label.startswith("#"):
            raise UsageError(f"image {label!r}: COLMAP cannot hold this name")
    groups = [g for g in network.observations if isinstance(g, ImagePoints)]
    if len(groups) < len(network.observations) or not groups:
        raise UsageError("a COLMAP model holds image points only, and there must be some")
    image, point, xy = (np.concatenate([getattr(g, a) for g in groups]) for a in ("images", "points", "xy"))
    order = np.argsort(image, kind="stable")
    image, point, xy = image[order], point[order], xy[order] + _shift(network)
    unknown = np.flatnonzero(~np.isfinite(points.coordinates).all(axis=1) & (np.bincount(point, minlength=len(points.labels)) > 0))
    if len(unknown):
        raise UsageError(f"point {points.labels[unknown[0]]} has no coordinates")
    rotation = np.diag([1.0, -1.0, -1.0]) @ images.rotation
    translation = -np.einsum("nij,nj->ni", rotation, images.position)
    quaternion = np.roll(Rotation.from_matrix(rotation).as_quat(canonical=True), 1, axis=1)  # w first
    camera_ids, point_ids = _ids([c.label for c in network.cameras]), _ids(list(points.labels))
    begin = np.searchsorted(image, np.arange(len(images.labels) + 1))
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        f"# Number of images: {len(images.labels)}, mean observations per image: {len(image) / len(images.labels)!r}",
    ]
    for i, label in enumerate(images.labels):
        pose = " ".join(repr(v) for v in [*quaternion[i].tolist(), *translation[i].tolist()])
        rows = range(begin[i], begin[i + 1])
        lines.append(f"{i + 1} {pose} {camera_ids[images.cameras[i]]} {label}")
        lines.append(
            " ".join(f"{x!r} {y!r} {point_ids[point[k]]}" for k, (x, y) in zip(rows, xy[begin[i] : begin[i + 1]].tolist(), strict=True))
        )
    tracks: dict[int, list[str]] = {}
    for k, (i, p) in enumerate(zip(image.tolist(), point.tolist(), strict=True)):
        tracks.setdefault(p, []).append(f"{i + 1} {k - begin[i]}")
    table = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
        f"# Number of points: {len(tracks)}, mean track length: {len(point) / len(tracks)!r}",
    ]
    for p in sorted(tracks):
        xyz = " ".join(repr(v) for v in points.coordinates[p].tolist())
        table.append(f"{point_ids[p]} {xyz} 0 0 0 -1 {' '.join(tracks[p])}")  # COLMAP's mark of an error not computed
    return {"images.txt": lines, "points3D.txt": table}
