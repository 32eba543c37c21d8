"""A table of image marks of control and check points for a network of any source; their coordinates come with a table of control."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from baarda.formats import checks
from baarda.formats.csv_table import read_csv
from baarda.formats.gcp_marks import Marks, some, with_marks
from baarda.formats.odm_gcp import image_finder
from baarda.network import TIE, Network

LARGEST = 1e9


def with_marks_table(network: Network, path: str | Path) -> Network:
    """Return the network with the image points of a table.

    Parameters
    ----------
    network : Network
    path : str or Path
        A CSV table with the columns image, point, x, y and, optional, sigma, or sigma_x and sigma_y: pixels as the network's source counts
        them, standard deviations in pixels (by default that of the other image points).

    Returns
    -------
    Network
        Marked points are tie points until a table of control says more; one whose label another point bears is called ``GCP label``.

    Raises
    ------
    InputError
        With file and line, if the table cannot be used or no image of it is in the network.
    """
    path = Path(path)
    table = read_csv(path, ("image", "point", "x", "y"), ("sigma", "sigma_x", "sigma_y"))
    xy = np.stack([table.numbers(n, None) for n in ("x", "y")], axis=1)
    far = np.flatnonzero(np.abs(xy).max(axis=1) > LARGEST)
    if len(far):
        raise table.error(int(far[0]), f"an image coordinate is beyond {LARGEST:g}")
    both = table.sigmas("sigma")
    sigmas = np.stack([np.where(np.isnan(s), both, s) for s in (table.sigmas("sigma_x"), table.sigmas("sigma_y"))], axis=1)
    zero = np.flatnonzero((sigmas == 0.0).any(axis=1))
    if len(zero):
        raise table.error(int(zero[0]), "the sigma of a mark must be positive")
    checks.sigma_range(sigmas, "the sigma of a mark", table.error)
    images, names = table.texts("image"), table.texts("point")
    find = image_finder(network)
    found = np.array([find(name) for name in images], dtype=np.intp)
    keep = np.flatnonzero(found >= 0)
    notes: list[str] = []
    if not len(keep):
        raise table.error(0, f"no image of the table is in the network, whose images are called {some(list(network.images.labels))}")
    if len(keep) < len(found):
        lost = sorted({images[i] for i in np.flatnonzero(found < 0).tolist()})
        notes.append(f"marks of {path.name} in {len(lost)} image(s) that are not in the network are left out: {some(lost)}")
    labels = list(dict.fromkeys(names))
    index = {label: i for i, label in enumerate(labels)}
    points = np.array([index[names[i]] for i in keep.tolist()], dtype=np.intp)
    checks.measured_once(found[keep], points, labels, lambda row, m: table.error(int(keep[row]), m), lambda row: table.line(int(keep[row])))
    marks = Marks(path, tuple(labels), np.full((len(labels), 3), np.nan), points, found[keep], xy[keep])
    before = len(network.observations)
    network = with_marks(network, marks, np.full(3, np.nan), notes, move=False, roles=np.full(len(labels), TIE))
    group = network.observations[before]
    group = replace(group, sigmas=np.where(np.isnan(sigmas[keep]), group.sigmas, sigmas[keep]))
    notes.append(f"{len(keep)} mark(s) of {len(np.unique(points))} point(s) come from {path.name}")
    observations = (*network.observations[:before], group, *network.observations[before + 1 :])
    return replace(network, observations=observations, assumptions=(*network.assumptions, *notes))
