"""Evidence of a small linear model: for the tests of models that need no photogrammetry, and for the examination of every member."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from baarda.errors import RedundancyNotPositive, Singular, UsageError
from baarda.hypotheses.base import Estimates, Evidence, Floats

__all__ = ["linear_model"]


def linear_model(
    design: ArrayLike,
    observed: ArrayLike,
    covariance: ArrayLike | None = None,
    sigma0: float = 1.0,
    *,
    images: ArrayLike | None = None,
    additional: Sequence[int] = (),
    control: Sequence[int] = (),
    check: tuple[ArrayLike, ArrayLike] | None = None,
    check_covariance: ArrayLike | None = None,
) -> Evidence:
    """Adjust a small linear model and return the evidence for all tests.

    Parameters
    ----------
    design : (n, u) array
        A of l = A x + e.
    observed : (n,) array
        l.
    covariance : (n,) or (n, n) array, optional
        A-priori variances, or covariance matrix, of l; 1 if absent.
    sigma0 : float
        A-priori standard deviation of unit weight.
    images : (n,) array of int, optional
        Set of each observation, -1 for none.
    additional : sequence of int
        Columns that are additional parameters.
    control : sequence of int
        Rows that are control coordinates.
    check : pair of (p, u) and (p,) arrays, optional
        Functions of x and their reference values.
    check_covariance : (p, p) array, optional
        Covariance of the reference values.

    Returns
    -------
    Evidence

    Raises
    ------
    RedundancyNotPositive
        If n <= u.
    Singular
        If columns of A depend on each other.

    Notes
    -----
    QR of the whitened, column-scaled design matrix; n x n arrays: for n up to a few thousand.

    Examples
    --------
    >>> e = linear_model([[1, 0], [1, 1], [1, 2]], [0.0, 1.1, 1.9])
    >>> e.redundancy, e.vpv, e.redundancy_numbers
    (1, 0.015, array([0.167, 0.667, 0.167]))
    """
    a, l_ = np.atleast_2d(np.asarray(design, dtype=float)), np.asarray(observed, dtype=float)
    n, u = a.shape
    if l_.shape != (n,):
        raise UsageError(f"{l_.shape} observations for {n} rows")
    if n <= u:
        raise RedundancyNotPositive(f"{n} observations for {u} unknowns")
    c = np.ones(n) if covariance is None else np.asarray(covariance, dtype=float)
    c = np.diag(c) if c.ndim == 1 else c
    lower = np.linalg.cholesky(c / sigma0**2)  # Q = L L'
    white = linalg.solve_triangular(lower, a, lower=True)
    scale = np.linalg.norm(white, axis=0)
    basis, upper = linalg.qr(white / scale, mode="economic")
    if np.abs(np.diagonal(upper)).min() < 1e-12 * np.abs(np.diagonal(upper)).max():
        raise Singular("the columns of the design matrix depend on each other")
    inverse = linalg.solve_triangular(upper, np.eye(u))
    qxx = inverse @ inverse.T / scale[:, None] / scale[None, :]
    e = linalg.solve_triangular(lower, l_, lower=True)
    x = inverse @ (basis.T @ e) / scale
    z = basis @ (basis.T @ e) - e
    v = lower @ z
    rest = np.eye(n) - basis @ basis.T
    qvv = lower @ rest @ lower.T
    p_half = linalg.solve_triangular(lower, np.eye(n), lower=True)
    sigmas = np.sqrt(np.diagonal(c))

    def residuals_of(errors: Floats) -> Floats:
        return np.asarray((lower @ (basis @ (basis.T @ errors) - errors)) * (sigma0 / sigmas)[:, None])

    def chosen(rows: Sequence[int]) -> Estimates | None:
        at = np.ix_(rows, rows)
        return Estimates(tuple(f"control {i}" for i in rows), v[list(rows)], qvv[at], c[at]) if len(rows) else None

    columns = list(additional)
    checked = None
    if check is not None:
        f = np.atleast_2d(np.asarray(check[0], dtype=float))
        given = np.asarray(check[1], dtype=float)
        reference = None if check_covariance is None else np.asarray(check_covariance, dtype=float)
        checked = Estimates(tuple(f"check {i}" for i in range(len(f))), f @ x - given, f @ qxx @ f.T, reference)
    return Evidence(
        residuals=v,
        sigmas=sigmas,
        vpv=float(z @ z),
        redundancy=n - u,
        unknowns=u,
        sigma0_apriori=sigma0,
        qvv=np.diagonal(qvv).copy(),
        redundancy_numbers=np.diagonal(lower @ rest @ p_half).copy(),
        pv=p_half.T @ z,
        pqvvp=np.diagonal(p_half.T @ rest @ p_half).copy(),
        images=None if images is None else np.asarray(images, dtype=np.intp),
        image_names=() if images is None else tuple(str(i) for i in range(int(np.max(np.asarray(images))) + 1)),
        additional=Estimates(tuple(f"unknown {i}" for i in columns), x[columns], qxx[np.ix_(columns, columns)]) if columns else None,
        control=chosen(control),
        check=checked,
        residuals_of=residuals_of,
    )
