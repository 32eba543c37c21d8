"""The datum: which similarity transformations the observations leave free, and how they are tied down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

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
    motions : (7, d) array
        The shifts, rotations (radians) and scalings (shares) that `basis` shows.
    steady : bool
        Whether these are free at every state.
    """

    basis: Floats
    free: tuple[str, ...]
    motions: Floats
    steady: bool

    @property
    def count(self) -> int:
        """The number d of freedoms."""
        return int(self.basis.shape[1])

    def at(self, unknowns: Unknowns, state: State) -> Defect:
        """Return the same transformations as they change the unknowns at another state."""
        return replace(self, basis=similarity_directions(unknowns, state, size=1.0) @ self.motions)


def mean_distance(state: State) -> float:
    """Return the root mean square distance of points and images from the origin, 1 where there is none."""
    known = state.points[np.isfinite(state.points).all(axis=1)]
    everything = np.concatenate([known, state.position])
    return (float(np.sqrt((everything**2).sum(axis=1).mean())) if len(everything) else 0.0) or 1.0


def similarity_directions(unknowns: Unknowns, state: State, some: Ints | None = None, size: float | None = None) -> Floats:
    """Return how the unknowns change under shifts, rotations and scaling of the object space, (u, 7).

    Parameters
    ----------
    unknowns : Unknowns
    state : State
        Coordinates near the origin (reduced to the centroid).
    some : (k,) int array, optional
        Unknowns; all, if not given.
    size : float, optional
        Rotation and scale are stated per this length; by default `mean_distance`, which makes all columns of one magnitude.

    Returns
    -------
    (u, 7) or (k, 7) array
    """
    length = mean_distance(state) if size is None else size

    def moved(x: Floats) -> Floats:
        shift = np.broadcast_to(np.eye(3), (len(x), 3, 3))
        return np.concatenate([shift, -skew(x) / length, x[:, :, None] / length], axis=2)  # omega x X = -[X]x omega

    def image(nodes: Ints) -> Floats:
        turn = np.zeros((len(nodes), 3, 7))
        turn[:, :, 3:6] = -state.rotation[nodes] / length
        return np.concatenate([moved(state.position[nodes]), turn], axis=1)

    of_nodes = {"image": (6, image), "point": (3, lambda nodes: moved(state.points[nodes]))}
    declared = {d.kind: d for d in state.declared}
    place = np.arange(unknowns.count + 1) if some is None else np.full(unknowns.count + 1, -1)
    if some is not None:
        place[some] = np.arange(len(some))
    place[-1] = -1
    out = np.zeros((unknowns.count if some is None else len(some), 7))
    for group in unknowns.groups:
        to = place[group.columns]
        if group.kind in of_nodes:
            width, directions = of_nodes[group.kind]
            to = to.reshape(-1, width)
            nodes = np.flatnonzero((to >= 0).any(axis=1))
            to, values = to[nodes].ravel(), directions(nodes).reshape(-1, 7)
        else:
            values = declared[group.kind].similarity(length) if group.kind in declared else np.zeros((len(to), 7))
        out[to[to >= 0]] = values[to >= 0]
    return out


SAMPLE = 2000  # row blocks of a chunk that are looked at first


def find_defect(lin: Linearization, state: State) -> Defect:
    """Find the transformations that change no observation: directions g with |A g|^2 <= 1e-18 times the sum of (A_ij g_j)^2.

    Parameters
    ----------
    lin : Linearization
    state : State

    Returns
    -------
    Defect
    """
    if lin.count > 40 * SAMPLE:
        a = lin.sample(SAMPLE).design
        used, columns = np.unique(a.indices, return_inverse=True)
        a = sparse.csr_array((a.data, columns, a.indptr), shape=(a.shape[0], len(used)))
        squares, g = a.multiply(a).tocsr(), similarity_directions(lin.unknowns, state, used)
        found = free_combinations(*products(lambda w: squares @ w, lambda w: squares.T @ w, lambda x: a @ x, g))
        if not found[0].shape[1]:
            return Defect(np.zeros((lin.unknowns.count, 0)), (), np.zeros((7, 0)), True)  # what some rows determine is determined
    size = mean_distance(state)
    g = similarity_directions(lin.unknowns, state, size=size)
    combinations, free = free_combinations(*products(lin.row_sums, lin.column_sums, lin.times, g))
    if combinations.shape[1]:  # orthonormal by R^-1, not Q: what does not move stays exactly zero (a column of K3 in pixels holds 1e18)
        combinations = combinations @ np.linalg.inv(np.linalg.qr(g @ combinations, mode="r"))
    return Defect(g @ combinations, free, combinations / np.repeat([1.0, size], [3, 4])[:, None], steady(combinations))


def products(
    row_sums: Callable[[Floats], Floats], column_sums: Callable[[Floats], Floats], times: Callable[[Floats], Floats], g: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the arguments of `free_combinations` for the directions g (u, 7).

    Parameters
    ----------
    row_sums, column_sums, times : callable
        Products of a design matrix, see `Linearization`.
    g : (u, 7) array
    """
    # Rows are brought to one size: what changes no observation does so whatever the weights are, and a weak observation must not drown.
    size = row_sums((g**2).sum(axis=1))
    weight_of_row = np.divide(1.0, np.sqrt(size), out=np.zeros_like(size), where=size > 0.0)
    image = weight_of_row[:, None] * times(g)
    return (g * column_sums(weight_of_row**2)[:, None]).T @ g, image.T @ image, image


def free_combinations(gross: Floats, net: Floats, image: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Return the combinations of the seven transformations that change no observation.

    Parameters
    ----------
    gross, net : (7, 7) arrays
        Sums over the observations of the products of what the transformations change through single unknowns, and in all.
    image : (n, 7) array
        What they change in all, or anything with the same products.

    Returns
    -------
    (7, d) array
    tuple of str
        The transformations that are free each by itself.
    """
    weight = np.sqrt(np.maximum(np.diag(gross), np.finfo(float).tiny))
    net, gross = net / np.outer(weight, weight), gross / np.outer(weight, weight)
    present = np.diag(gross) > 0.5
    if not present.any():
        return np.zeros((7, 0)), ()
    sizes, directions = linalg.eigh(gross[np.ix_(present, present)])
    moving = sizes > 1e-10 * sizes[-1]  # other combinations of the seven move no unknown: fewer than seven unknowns can move
    whiten = directions[:, moving] / np.sqrt(sizes[moving])
    if linalg.eigvalsh(whiten.T @ net[np.ix_(present, present)] @ whiten)[0] > 1e-8:
        return np.zeros((7, 0)), ()
    triangle = np.linalg.qr(image[:, present] / weight[present] @ whiten, mode="r")
    _, values, vectors = np.linalg.svd(triangle)  # not from the product: its rounding would hide a weak observation
    small = np.append(values, np.zeros(len(vectors) - len(values))) <= 1e-9
    combinations = np.zeros((7, int(small.sum())))
    combinations[present] = (whiten @ vectors[small].T) / weight[present][:, None]
    single = np.diag(net) <= 1e-18
    return combinations, tuple(name for name, p, s in zip(FREEDOMS, present, single, strict=True) if p and s)


def steady(combinations: Floats) -> bool:
    """Return whether the same transformations are free at every state: shifts alone, or all shifts with none or all rotations.

    Others have an axis or a centre, which may move with points that are observed or known in part.

    Parameters
    ----------
    combinations : (7, d) array
        Orthonormal in what they do to the unknowns, rotation and scale stated per mean distance.

    Examples
    --------
    >>> steady(np.eye(7)[:, :6]), steady(np.eye(7)[:, 3:6])
    (True, False)
    """
    least = 1e-9 * float(np.linalg.norm(combinations)) if combinations.size else 0.0
    turning = np.linalg.matrix_rank(combinations[3:], tol=least) if combinations.size else 0
    rotating = np.linalg.matrix_rank(combinations[3:6], tol=least) if combinations.size else 0
    return bool(turning == 0 or (combinations.shape[1] - turning == 3 and rotating in (0, 3)))


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

    def at(self, lin: Linearization, state: State) -> Datum:
        """Return the same conditions with the transformations that are free at another state; as they are, if those are more or fewer."""
        found = self.defect.at(lin.unknowns, state) if self.defect.steady else find_defect(lin, state)
        return replace(self, defect=found) if found.count == self.defect.count else self

    def transform(self, x: Floats) -> Floats:
        """Apply S to vectors of unknowns, (u,) or (u, k)."""
        t = self.transfer
        return x if t is None or self.conditions is None else x - t @ (self.conditions.T @ x)

    def transform_transposed(self, x: Floats) -> Floats:
        """Apply S' to vectors, (u,) or (u, k)."""
        t = self.transfer
        return x if t is None or self.conditions is None else x - self.conditions @ (t.T @ x)
