"""Quadratic forms x' M^-1 x from a factor of M, and of what a singular M still tells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from baarda.errors import Singular, UsageError
from baarda.hypotheses.base import Floats

# A share of a variance that the other numbers do not explain: below it, rounding decides.
_UNEXPLAINED = 1e-12
# An eigenvalue of a scaled cofactor matrix that is taken for zero.
_ZERO = 1e-8


def vector_and_matrix(values: ArrayLike, matrix: ArrayLike, what: str = "cofactors") -> tuple[Floats, Floats]:
    """Return values and a symmetric matrix as arrays of matching shape, or raise UsageError."""
    x = np.atleast_1d(np.asarray(values, dtype=float))
    m = np.atleast_2d(np.asarray(matrix, dtype=float))
    if x.ndim != 1 or m.shape != (len(x), len(x)):
        raise UsageError(f"{what} must be a {len(x)} x {len(x)} matrix for {len(x)} values, not {m.shape}")
    if len(x) == 0:
        raise UsageError("no value to test")
    if not (np.isfinite(x).all() and np.isfinite(m).all()):
        raise UsageError(f"the values and {what} must be finite")
    return x, m


def variances(matrix: Floats, names: Sequence[str] = ()) -> Floats:
    """Return the diagonal of a cofactor matrix; raise UsageError where it is not positive."""
    d = np.diagonal(matrix)
    bad = np.flatnonzero(d <= 0.0)
    if len(bad):
        who = ", ".join(_name(names, int(i)) for i in bad[:5])
        raise UsageError(f"the cofactor of {who} is not positive: a fixed number cannot be tested")
    return np.asarray(d)


def _name(names: Sequence[str], i: int) -> str:
    return names[i] if i < len(names) else f"number {i + 1}"


def factor(matrix: Floats, names: Sequence[str] = ()) -> tuple[Floats, Floats]:
    """Return (s, L) with matrix = diag(s) L L' diag(s) and unit diagonal of L L'; raise Singular where it has no inverse."""
    s = np.sqrt(variances(matrix, names))
    scaled = matrix / s[:, None] / s[None, :]
    lower, info = linalg.lapack.dpotrf(scaled, lower=1, clean=1)
    # After the scaling, the square of a pivot is the share of the variance that the earlier numbers leave unexplained.
    weak = np.flatnonzero(np.diagonal(lower)[: info - 1 if info > 0 else None] ** 2 < _UNEXPLAINED)
    if info > 0 or len(weak):
        i = int(weak[0]) if len(weak) else info - 1
        j = int(np.argmax(np.abs(scaled[i, :i])))
        message = f"{_name(names, i)} is a linear combination of the other numbers tested (most correlated with {_name(names, j)})"
        raise Singular(message, (_name(names, j), _name(names, i)))
    return s, np.asarray(lower)


def whitened(values: Floats, matrix: Floats, names: Sequence[str] = ()) -> Floats:
    """Return z = L^-1 S^-1 x, whose squares sum to x' M^-1 x."""
    s, lower = factor(matrix, names)
    return np.asarray(linalg.solve_triangular(lower, values / s, lower=True))


def quadratic_form(values: Floats, matrix: Floats, names: Sequence[str] = ()) -> float:
    """Return x' M^-1 x; raise Singular where M has no inverse."""
    z = whitened(values, matrix, names)
    return float(z @ z)


def ranked_form(values: Floats, matrix: Floats, scale: Floats | None = None) -> tuple[float, int]:
    """Return x' M^+ x over the part that M determines, and the rank of that part.

    The eigenvalues are judged after scaling by `scale` (with a-priori sigmas they are shares between 0 and 1), by default by M's own
    diagonal.
    """
    if scale is None:
        d = np.diagonal(matrix)
        seen = d > _ZERO * d.max(initial=0.0)
        values, matrix, scale = values[seen], matrix[np.ix_(seen, seen)], np.sqrt(d[seen])
    if len(values) == 0:
        return 0.0, 0
    share, vectors = linalg.eigh(matrix / scale[:, None] / scale[None, :])
    known = share > _ZERO
    z = vectors[:, known].T @ (values / scale)
    return float((z * z / share[known]).sum()), int(known.sum())


def point_rows(groups: Sequence[str], count: int) -> dict[str, list[int]]:
    """Return the rows of each point in order of first appearance; raise UsageError unless there is one group per row."""
    if len(groups) != count:
        raise UsageError(f"{len(groups)} groups for {count} coordinates")
    rows: dict[str, list[int]] = {}
    for i, group in enumerate(groups):
        rows.setdefault(group, []).append(i)
    return rows
