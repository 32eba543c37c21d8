"""The collinearity equations and their partials.

A camera looks along -z, x to the right, y up: (U, V, W) = M (X - X0), ideal normalised image coordinates x = -U/W, y = -V/W, and
W < 0 in front of the camera.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from baarda.geometry.rotation import skew

Floats = NDArray[np.float64]


def camera_coordinates(rotation: Floats, position: Floats, points: Floats) -> Floats:
    """Return (U, V, W) = M (X - X0).

    Parameters
    ----------
    rotation : (n, 3, 3) array
        Camera from object.
    position : (n, 3) array
        Projection centres, object units.
    points : (n, 3) array
        Object points, object units.

    Returns
    -------
    (n, 3) array, object units

    Examples
    --------
    >>> camera_coordinates(np.eye(3)[None], np.array([[0.0, 0.0, 10.0]]), np.array([[1.0, 2.0, 0.0]]))
    array([[  1.,   2., -10.]])
    """
    return np.asarray(np.einsum("nij,nj->ni", rotation, points - position))


def project(vectors: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Project camera coordinates onto the plane at unit distance.

    Parameters
    ----------
    vectors : (n, 3) array
        (U, V, W).

    Returns
    -------
    xy : (n, 2) array
        -U/W, -V/W.
    partials : (n, 2, 3) array
        Partials with respect to U, V, W.
    in_front : (n,) bool array
        W < 0.

    Examples
    --------
    >>> project(np.array([[1.0, 2.0, -10.0]]))[0]
    array([[0.1, 0.2]])
    """
    u, v, w = vectors.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x, y = -u / w, -v / w
        partials = np.zeros((len(w), 2, 3))
        partials[:, 0, 0] = partials[:, 1, 1] = -1.0 / w
        partials[:, 0, 2], partials[:, 1, 2] = -x / w, -y / w
    return np.stack([x, y], axis=-1), partials, w < 0


def partials(rotation: Floats, vectors: Floats, d_vectors: Floats) -> tuple[Floats, Floats]:
    """Chain partials with respect to (U, V, W) to exterior orientation and object point.

    Parameters
    ----------
    rotation : (n, 3, 3) array
        Camera from object.
    vectors : (n, 3) array
        (U, V, W).
    d_vectors : (n, 2, 3) array
        Partials of the image coordinates with respect to (U, V, W).

    Returns
    -------
    exterior : (n, 2, 6) array
        Partials with respect to X0, Y0, Z0 and the three increments about the camera axes.
    point : (n, 2, 3) array
        Partials with respect to X, Y, Z.

    Examples
    --------
    >>> v = np.array([[1.0, 2.0, -10.0]])
    >>> partials(np.eye(3)[None], v, project(v)[1])[1]
    array([[[0.1 , 0.  , 0.01], [0.  , 0.1 , 0.02]]])
    """
    point = d_vectors @ rotation
    exterior = np.concatenate([-point, -d_vectors @ skew(vectors)], axis=-1)
    return exterior, point
