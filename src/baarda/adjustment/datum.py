"""The datum: which similarity transformations the observations leave free, and how they are tied down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from baarda.adjustment.linear_system import Linearization
from baarda.geometry.rotation import skew
from baarda.network import State, Unknowns

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

FREEDOMS = ("shift along X", "shift along Y", "shift along Z", "rotation about X", "rotation about Y", "rotation about Z", "scale")


@dataclass(frozen=True)
class Defect:
    """The datum defect d of a linear system.

    Attributes
    ----------
    basis : (u, d) array
        Directions of the unknowns that change no observation.
    free : tuple of str
        The basic transformations that are free each by itself.
    """

    basis: Floats
    free: tuple[str, ...]

    @property
    def count(self) -> int:
        """The number d of freedoms."""
        return int(self.basis.shape[1])


def similarity_directions(unknowns: Unknowns, state: State) -> Floats:
    """Return how the unknowns change under shifts, rotations and scaling of the object space, (u, 7).

    Parameters
    ----------
    unknowns : Unknowns
    state : State
        Coordinates near the origin (reduced to the centroid).

    Returns
    -------
    (u, 7) array
        Rotation and scale are stated per mean distance from the origin, so that all columns are of one magnitude.
    """

    def moved(x: Floats) -> Floats:
        shift = np.broadcast_to(np.eye(3), (len(x), 3, 3))
        return np.concatenate([shift, -skew(x) / size, x[:, :, None] / size], axis=2)  # omega x X = -[X]x omega

    known = state.points[np.isfinite(state.points).all(axis=1)]
    everything = np.concatenate([known, state.position])
    size = (float(np.sqrt((everything**2).sum(axis=1).mean())) if len(everything) else 0.0) or 1.0
    turn = np.zeros((len(state.position), 3, 7))
    turn[:, :, 3:6] = -state.rotation / size
    parts = {
        "camera": np.zeros((len(unknowns["camera"].columns), 7)),
        "image": np.concatenate([moved(state.position), turn], axis=1).reshape(-1, 7),
        "point": moved(state.points).reshape(-1, 7),
        **{d.kind: d.similarity(size) for d in state.declared},
    }
    out = np.zeros((unknowns.count, 7))
    for group in unknowns.groups:
        used = group.columns >= 0
        out[group.columns[used]] = parts[group.kind][used]
    return out


SAMPLE = 10_000  # row blocks of a chunk that are looked at first


def find_defect(lin: Linearization, state: State, tolerance: float = 1e-18) -> Defect:
    """Find the transformations that change no observation.

    Parameters
    ----------
    lin : Linearization
    state : State
    tolerance : float
        A direction g is free if |A g|^2 <= tolerance * sum of (A_ij g_j)^2.

    Returns
    -------
    Defect
    """
    g = similarity_directions(lin.unknowns, state)
    if lin.count > 8 * SAMPLE and not _defect_of(lin.sample(SAMPLE), g, tolerance).count:
        return Defect(np.zeros((len(g), 0)), ())  # what some rows determine is determined
    return _defect_of(lin, g, tolerance)


def _defect_of(lin: Linearization, g: Floats, tolerance: float) -> Defect:
    # Rows are brought to one size: what changes no observation does so whatever the weights are, and a weak observation must not drown.
    size = lin.row_sums((g**2).sum(axis=1))
    weight_of_row = np.divide(1.0, np.sqrt(size), out=np.zeros_like(size), where=size > 0.0)
    image = weight_of_row[:, None] * lin.times(g)
    gross = (g * lin.column_sums(weight_of_row**2)[:, None]).T @ g
    net = image.T @ image
    weight = np.sqrt(np.maximum(np.diag(gross), np.finfo(float).tiny))
    net, gross = net / np.outer(weight, weight), gross / np.outer(weight, weight)
    present = np.diag(gross) > 0.5
    if not present.any():
        return Defect(np.zeros((len(g), 0)), ())
    sizes, directions = linalg.eigh(gross[np.ix_(present, present)])
    moving = sizes > 1e-10 * sizes[-1]  # other combinations of the seven move no unknown: fewer than seven unknowns can move
    whiten = directions[:, moving] / np.sqrt(sizes[moving])
    reduced = whiten.T @ net[np.ix_(present, present)] @ whiten
    if linalg.eigvalsh(reduced)[0] > 1e-8:
        return Defect(np.zeros((len(g), 0)), ())
    triangle = np.linalg.qr(image[:, present] / weight[present] @ whiten, mode="r")
    _, values, vectors = np.linalg.svd(triangle)  # not from the product: its rounding would hide a weak observation
    small = np.append(values, np.zeros(len(vectors) - len(values))) <= np.sqrt(tolerance)
    basis = (g[:, present] / weight[present]) @ (whiten @ vectors[small].T)
    single = np.diag(net) <= tolerance
    free = tuple(name for name, p, s in zip(FREEDOMS, present, single, strict=True) if p and s)
    return Defect(np.linalg.qr(basis)[0] if basis.shape[1] else basis, free)


def minimal_columns(defect: Defect, lin: Linearization, candidates: Ints) -> Ints:
    """Choose d unknowns whose fixing removes the defect, best conditioned, sorted.

    Parameters
    ----------
    defect : Defect
    lin : Linearization
    candidates : int array
        Columns that may be chosen.
    """
    if not defect.count:
        return np.zeros(0, dtype=np.intp)
    scaled = defect.basis[candidates] * lin.scale[candidates, None]
    _, r, order = linalg.qr(scaled.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(r))
    if len(diagonal) < defect.count or diagonal[-1] < 1e-9 * diagonal[0]:
        return np.zeros(0, dtype=np.intp)
    return np.sort(candidates[order[: defect.count]])


@dataclass(frozen=True)
class Datum:
    """A solved datum: unknowns held while solving, and the S-transformation to the conditions asked for.

    Attributes
    ----------
    name : str
        ``control``, ``minimal`` or ``inner``.
    defect : Defect
    held : (d,) int array
        Columns held fixed while solving.
    conditions : (u, d) array or None
        B of the inner constraints B'x = 0; None leaves the minimal datum.
    text : str
        What was done, in words.
    """

    name: str
    defect: Defect
    held: Ints
    conditions: Floats | None
    text: str

    @property
    def transfer(self) -> Floats | None:
        """T = G (B'G)^-1, so that S = I - T B' (Baarda 1973)."""
        if self.conditions is None or not self.defect.count:
            return None
        g = self.defect.basis
        return np.asarray(np.linalg.solve((self.conditions.T @ g).T, g.T).T)

    def transform(self, x: Floats) -> Floats:
        """Apply S to vectors of unknowns, (u,) or (u, k)."""
        t = self.transfer
        return x if t is None or self.conditions is None else x - t @ (self.conditions.T @ x)

    def transform_transposed(self, x: Floats) -> Floats:
        """Apply S' to vectors, (u,) or (u, k)."""
        t = self.transfer
        return x if t is None or self.conditions is None else x - self.conditions @ (t.T @ x)
