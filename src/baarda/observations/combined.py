"""The combined model B v + A x = l: conditions between several observations and the unknowns, row block by row block.

A kind states conditions F(observed, unknowns) = 0 of each row block. For given unknowns, the residuals that the conditions demand are the
smallest ones v with F(observed + v) = 0; `demanded` finds them, and `rows` makes of them, and of the partials there, row blocks of the
original observations: misclosures -v and partials K A with K = Q B'(B Q B')^-1. Least squares of these rows is the adjustment of the
combined model, with the conditions linearised at the adjusted observations (Pope 1972), not at the measured ones. Where there are as many
conditions as observations, v are the residuals of the explicit form, which the conditions define implicitly; where there are fewer, some
combinations of the observations are controlled by nothing, and `Rows.condition` says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from baarda.observations.base import Block, Floats, Ints, Rows

#: From (N, k) values of the observations to conditions F (N, m) and their partials B (N, m, k).
Conditions = Callable[[Floats], tuple[Floats, Floats]]


def gain(condition: Floats, cofactor: Floats) -> Floats:
    """Return K = Q B'(B Q B')^-1, (N, k, m): the residuals of the observations that a misfit of the conditions demands.

    Parameters
    ----------
    condition : (N, m, k) array
        Partials B of the conditions with respect to the observations.
    cofactor : (N, k, k) or (N, k) array
        Cofactors Q of the observations, or their diagonals.

    Returns
    -------
    (N, k, m) array
        NaN where conditions contradict or repeat each other.

    Notes
    -----
    Wu, Liu & Lin (2000), eqs. 5 and 6; Mikhail, Observations and Least Squares (1976), chapter 9. B Q B' is solved by QR of the whitened B.

    Examples
    --------
    >>> gain(np.array([[[1.0, 1.0]]]), np.array([[1.0, 3.0]]))
    array([[[0.25], [0.75]]])
    """
    factor = cofactor_root(cofactor)
    out = np.full((len(condition), condition.shape[2], condition.shape[1]), np.nan)
    good = np.isfinite(condition).all(axis=(1, 2))
    white = condition[good] @ factor[good]
    basis, upper = np.linalg.qr(white.transpose(0, 2, 1))
    diagonal = np.abs(np.einsum("nii->ni", upper))
    well = diagonal.min(axis=1) > 1e-13 * diagonal.max(axis=1)
    at = np.flatnonzero(good)[well]
    out[at] = factor[at] @ basis[well] @ np.linalg.inv(upper[well]).transpose(0, 2, 1)
    return out


def cofactor_root(cofactor: Floats) -> Floats:
    """Return L with Q = L L', (N, k, k), of full or diagonal cofactors."""
    if cofactor.ndim == 3:
        return np.asarray(np.linalg.cholesky(cofactor), dtype=float)
    out = np.zeros((*cofactor.shape, cofactor.shape[1]))
    np.einsum("nii->ni", out)[...] = np.sqrt(cofactor)
    return out


def demanded(conditions: Conditions, observed: Floats, cofactor: Floats, steps: int = 100) -> tuple[Floats, Floats]:
    """Return the smallest residuals that fulfil the conditions, and B at the observations corrected by them.

    Parameters
    ----------
    conditions : callable
        See `Conditions`.
    observed : (N, k) array
    cofactor : (N, k, k) or (N, k) array
    steps : int
        Limit of the iterations v <- K (B v - F).

    Returns
    -------
    residuals : (N, k) array
        v'Q^-1 v is least; NaN in row blocks whose iteration does not settle.
    condition : (N, m, k) array

    Notes
    -----
    Pope (1972), Some pitfalls to be avoided in the iterative adjustment of nonlinear problems: B is taken at observed + v.

    Examples
    --------
    The point of the circle x^2 + y^2 = 25 that is nearest to (6, 8):

    >>> circle = lambda v: (np.sum(v * v, axis=1, keepdims=True) - 25.0, 2.0 * v[:, None, :])
    >>> demanded(circle, np.array([[6.0, 8.0]]), np.ones((1, 2)))[0].round(12)
    array([[-3., -4.]])
    """
    size = np.sqrt(np.einsum("nii->ni", cofactor) if cofactor.ndim == 3 else cofactor)
    with np.errstate(all="ignore"):
        v, settled = _iterated(conditions, observed, cofactor, size, steps, 1.0)
        _, b = conditions(observed + v)
        for part in (0.5, 0.2) if b.shape[1] < b.shape[2] else ():  # far from a strongly curved surface full steps swing
            if settled.all():
                break
            other, there = _iterated(conditions, observed, cofactor, size, int(steps / part), part)
            v, settled = np.where((there & ~settled)[:, None], other, v), settled | there
            _, b = conditions(observed + v)
    return np.where(settled[:, None], v, np.nan), b


def _iterated(
    conditions: Conditions, observed: Floats, cofactor: Floats, size: Floats, steps: int, part: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Iterate with a part of each step; return the residuals, and which row blocks have settled."""
    v = np.zeros_like(observed)
    last = np.full(len(observed), np.inf)
    moving = np.ones(len(observed), dtype=bool)
    for _ in range(steps):
        f, b = conditions(observed + v)
        new = v + part * (np.einsum("nkm,nm->nk", gain(b, cofactor), np.einsum("nmk,nk->nm", b, v) - f) - v)
        step = np.max(np.abs(new - v) / size, axis=1)
        # rounding is reached where small steps no longer shrink
        moving &= ~((step == 0.0) | ((step <= 1e-7) & (step >= 0.99 * last)))
        if not moving.any():
            break
        v = np.where(moving[:, None], new, v)
        last = np.where(moving, step, last)
    return v, np.isfinite(v).all(axis=1) & (~moving | (last <= 1e-9 * part))


def rows(index: Ints, residuals: Floats, condition: Floats, cofactor: Floats, unknowns: Sequence[tuple[str, Ints, Floats]]) -> Rows:
    """Return row blocks of the original observations.

    Parameters
    ----------
    index : (N,) int array
        See `Rows`.
    residuals, condition : arrays
        From `demanded`.
    cofactor : (N, k, k) or (N, k) array
    unknowns : sequence of (kind, nodes, partials)
        Partials A (N, m, w) of the conditions with respect to the unknowns of the nodes, at the corrected observations.

    Returns
    -------
    Rows
    """
    k = -gain(condition, cofactor)
    blocks = tuple(Block(kind, nodes, k @ a) for kind, nodes, a in unknowns)
    return Rows(index, -residuals, blocks, cofactor, None if condition.shape[1] == condition.shape[2] else condition)
