"""Collinearity of estimated parameters: variance inflation, condition indices, and who is correlated with whom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from baarda.errors import UsageError
from baarda.hypotheses._quadratic import factor, variances, vector_and_matrix
from baarda.hypotheses.base import Floats

__all__ = ["ConditionIndices", "condition_indices", "design_condition_indices", "mutual_inflation", "variance_inflation"]


def variance_inflation(cofactors: ArrayLike, weights: ArrayLike) -> Floats:
    """Return the variance inflation factors of parameters against an orthogonal design of the same columns.

    Parameters
    ----------
    cofactors : (k,) or (k, k) array
        Cofactors q_jj of the parameters from the whole adjustment, or their matrix.
    weights : (k,) array
        Diagonal a_j' P a_j of the normal equations, in the inverse units of the cofactors; with directly observed parameters including
        their own weight.

    Returns
    -------
    (k,) array
        VIF_j = q_jj a_j' P a_j = 1 / (1 - R_j^2) >= 1, R_j^2 the share of column j that all other columns explain (uncentred).

    Raises
    ------
    UsageError
        If a number is not positive or shapes differ.

    Notes
    -----
    Rao's bound var(z_j) >= sigma0^2 / (a_j' P a_j) in Grün (1978) p. 383, reached by an orthogonal design; Belsley, Kuh, Welsch,
    Regression Diagnostics (1980) 3.2. The sigma of a parameter is sqrt(VIF) times what it would be if nothing were correlated with it.

    Examples
    --------
    >>> variance_inflation([[2.0, 1.0], [1.0, 1.0]], [1.0, 2.0])
    array([2., 2.])
    """
    q = np.asarray(cofactors, dtype=float)
    q = variances(q if q.ndim == 2 else np.diag(np.atleast_1d(q)))
    w = np.atleast_1d(np.asarray(weights, dtype=float))
    if w.shape != q.shape or not (w > 0.0).all():
        raise UsageError("the weights must be positive, one per parameter")
    return np.asarray(q * w)


def mutual_inflation(cofactors: ArrayLike, names: Sequence[str] = ()) -> Floats:
    """Return the part of the variance inflation that the parameters cause each other, all other unknowns being eliminated.

    Parameters
    ----------
    cofactors : (k, k) array
        Joint cofactors of the parameters.
    names : sequence of str
        For messages.

    Returns
    -------
    (k,) array
        q_jj (Q^-1)_jj >= 1: what fixing all other parameters of the list would take off the variance.

    Raises
    ------
    Singular
        If a parameter is a combination of the others.

    Examples
    --------
    >>> mutual_inflation([[1.0, 0.8], [0.8, 1.0]])
    array([2.77777778, 2.77777778])
    """
    _, q = vector_and_matrix(np.zeros(len(np.atleast_2d(np.asarray(cofactors)))), cofactors)
    _, lower = factor(q, names)
    inverse = np.asarray(linalg.solve_triangular(lower, np.eye(len(lower)), lower=True))
    return np.asarray((inverse**2).sum(axis=0))


@dataclass(frozen=True)
class ConditionIndices:
    """Directions in which parameters are determined badly.

    Attributes
    ----------
    indices : (k,) array
        Condition indices eta = sqrt(largest eigenvalue / eigenvalue), ascending; 5-10 weak, above 30 strong dependences.
    proportions : (k, k) array
        Share of the variance of parameter j (column) that comes from direction i (row); columns sum to 1.
    """

    indices: Floats
    proportions: Floats

    def involved(self, names: Sequence[str], limit: float = 30.0, share: float = 0.5) -> list[tuple[float, list[str]]]:
        """Return the indices from `limit` on with the parameters that have more than `share` of their variance there."""
        found = []
        for eta, row in zip(self.indices, self.proportions, strict=True):
            if eta >= limit:
                found.append((float(eta), [n for n, p in zip(names, row, strict=True) if p > share]))
        return found[::-1]


def condition_indices(cofactors: ArrayLike, names: Sequence[str] = ()) -> ConditionIndices:
    """Return the condition indices of parameters from their cofactors: of the normal equations with all other unknowns eliminated.

    Parameters
    ----------
    cofactors : (k, k) array
        Joint cofactors of the parameters.
    names : sequence of str
        For messages.

    Returns
    -------
    ConditionIndices
        Of Q^-1 scaled to unit diagonal, so that units do not matter.

    Raises
    ------
    Singular
        If a parameter is a combination of the others.

    Notes
    -----
    Belsley, Kuh, Welsch (1980) 3.2 applied to the reduced design (I - H_x) A_z.

    Examples
    --------
    >>> c = condition_indices([[1.0, 0.8], [0.8, 1.0]])
    >>> c.indices, c.proportions
    (array([1., 3.]), array([[0.1, 0.1],
           [0.9, 0.9]]))
    """
    _, q = vector_and_matrix(np.zeros(len(np.atleast_2d(np.asarray(cofactors)))), cofactors)
    _, lower = factor(q, names)
    inverse = np.asarray(linalg.solve_triangular(lower, np.eye(len(lower)), lower=True))
    columns = inverse / np.sqrt((inverse**2).sum(axis=0))  # a design whose normal equations are the scaled inverse
    return design_condition_indices(columns)


def design_condition_indices(design: ArrayLike) -> ConditionIndices:
    """Return the condition indices of a (whitened) design matrix, columns scaled to unit length.

    Parameters
    ----------
    design : (n, k) array
        Design matrix of full column rank, n >= k.

    Returns
    -------
    ConditionIndices

    Raises
    ------
    UsageError
        If a column is zero or there are fewer rows than columns.

    Notes
    -----
    Belsley, Kuh, Welsch (1980) 3.2.

    Examples
    --------
    >>> design_condition_indices(np.eye(3)).indices
    array([1., 1., 1.])
    """
    a = np.asarray(design, dtype=float)
    if a.ndim != 2 or a.shape[0] < a.shape[1] or a.shape[1] == 0:
        raise UsageError(f"a design matrix has at least as many rows as columns, not shape {a.shape}")
    norms = np.linalg.norm(a, axis=0)
    if not (norms > 0.0).all():
        raise UsageError("a column of the design matrix is zero")
    _, singular, vectors = linalg.svd(a / norms, full_matrices=False)
    shares = (vectors / singular[:, None]) ** 2
    return ConditionIndices(singular[0] / singular, shares / shares.sum(axis=0))
