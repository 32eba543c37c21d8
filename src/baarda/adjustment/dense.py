"""The dense solver: Cholesky factor of the scaled normal equations with LAPACK; for small networks and as an oracle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from baarda.adjustment.linear_system import Linearization
from baarda.errors import Singular

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


DEPENDENT = 1e-6  # smallest eigenvalue of the scaled normal matrix of a point below which its columns are made orthogonal first
SMALLEST = 1e-12  # a column that others explain to this share is not determined


@dataclass(frozen=True)
class DenseSolver:
    """A factored normal matrix; see `baarda.adjustment.solver.Solver` for the contract."""

    lin: Linearization
    kept: Ints
    factor: Floats
    transform: Any  # sparse (k, k): what it makes of the columns was factored
    rcond: float

    @staticmethod
    def of(lin: Linearization, held: Ints, damping: float = 0.0) -> DenseSolver:
        """Factor the normal equations with some unknowns held fixed.

        Raises
        ------
        Singular
            If unknowns are not determined; names the unknowns of the null space.
        """
        kept = np.setdiff1d(np.arange(lin.unknowns.count), held)
        scale = lin.scale[kept]
        normal = (lin.design.T @ lin.design).toarray()[np.ix_(kept, kept)] / np.outer(scale, scale)
        transform: Any = sparse.diags_array(1.0 / scale).tocsr()
        far = _nearly_dependent(lin, kept, normal)
        if far:  # normal equations lose the square of what the columns still hold
            transform = transform.tolil()
            for at, inverse in far:
                transform[np.ix_(at, at)] = inverse
            transform = transform.tocsr()
            columns = lin.design.tocsc()[:, kept] @ transform
            normal = (columns.T @ columns).toarray()
        factor, rcond = factorise(normal + damping * np.eye(len(kept)), [kept], lin)
        return DenseSolver(lin, kept, factor, transform, rcond)

    def at(self, lin: Linearization | None) -> DenseSolver:
        """Return this factor for the system at a state nearby, as an approximate one; None only lets the old system go."""
        return replace(self, lin=cast(Linearization, lin))

    def solve(self, rhs: Floats) -> Floats:
        """Return N^-1 rhs for (u,) or (u, k) right-hand sides; held unknowns stay zero."""
        columns = rhs.reshape(len(rhs), -1)
        out = np.zeros_like(columns)
        out[self.kept] = self.transform @ linalg.cho_solve((self.factor, True), self.transform.T @ columns[self.kept])
        return out.reshape(rhs.shape)

    def least_squares(self, y: Floats) -> tuple[Floats, Floats]:
        """Return x = N^-1 A'y for an (n,) vector in the place of the whitened observations, and A x."""
        x = self.solve(self.lin.transposed(y))
        return x, self.lin.times(x)

    def hat(self, whole: bool = True) -> list[Floats]:
        """Return for each chunk the (N, m, m) diagonal blocks of A N^-1 A'; without `whole` only their diagonals (N, m) if it is plain."""
        inverse = self._inverse
        out = []
        for c in self.lin.chunks:
            at = self.place[np.concatenate([p.columns for p in c.parts], axis=1)]
            jacobian = np.concatenate(c.partials(), axis=2)
            hat = np.asarray(jacobian @ inverse[at[:, :, None], at[:, None, :]] @ jacobian.transpose(0, 2, 1))
            out.append(hat if whole or not c.plain else np.einsum("nii->ni", hat).copy())
        return out

    def blocks(self, columns: Ints) -> Floats:
        """Return the (N, w, w) blocks of N^-1 for (N, w) columns; zero for columns below zero and held ones."""
        at = self.place[columns]
        return np.asarray(self._inverse[at[:, :, None], at[:, None, :]])

    def pairs(self, a: Ints, b: Ints) -> Floats:
        """Return the (len(a), len(b)) block of N^-1 for any columns; zero for columns below zero and held ones."""
        return np.asarray(self._inverse[np.ix_(self.place[a], self.place[b])])

    @cached_property
    def place(self) -> Ints:
        """Row of each unknown in the factor; the last one, for -1 and held unknowns, is a row of zeros in the inverse."""
        place = np.full(self.lin.unknowns.count + 1, len(self.kept))
        place[self.kept] = np.arange(len(self.kept))
        return place

    @cached_property
    def _inverse(self) -> Floats:
        n = len(self.kept)
        out = np.zeros((n + 1, n + 1))
        half, _ = linalg.lapack.dtrtri(self.factor, lower=1)
        half = np.tril(half) @ self.transform.T
        out[:n, :n] = half.T @ half
        return out


def _nearly_dependent(lin: Linearization, kept: Ints, normal: Floats) -> list[tuple[Ints, Floats]]:
    """Return the points whose three columns hardly differ, as those of points far away: their places, and R^-1 of the columns' QR.

    Columns that differ by rounding only are left for the factorisation to refuse.
    """
    place = np.full(lin.unknowns.count + 1, -1)
    place[kept] = np.arange(len(kept))
    at = place[lin.unknowns["point"].columns.reshape(-1, 3)]
    at = at[(at >= 0).all(axis=1)]
    at = at[np.linalg.eigvalsh(normal[at[:, :, None], at[:, None, :]])[:, 0] < DEPENDENT] if len(at) else at
    out: list[tuple[Ints, Floats]] = []
    design: Any = lin.design.tocsc() if len(at) else None
    for own in at:
        columns = design[:, kept[own]]
        rows = np.unique(columns.indices)
        r = np.linalg.qr(np.asarray(columns[rows].toarray(), dtype=float))[1]
        if r.shape[0] == 3 and np.all(np.abs(np.diag(r)) > SMALLEST * np.sqrt((r**2).sum(axis=0))):
            out.append((own, np.linalg.inv(r)))
    return out


def factorise(matrix: Floats, columns: list[Ints], lin: Linearization) -> tuple[Floats, float]:
    """Cholesky-factor a scaled normal matrix; return the lower factor and the reciprocal condition number.

    Parameters
    ----------
    matrix : (k, k) array
        Unit diagonal before elimination.
    columns : list of int arrays
        The unknowns of the rows, for the names in an error.

    Raises
    ------
    Singular
        If a null space shows that unknowns are not determined.
    """
    if not len(matrix):
        return matrix, 1.0
    factor, info = linalg.lapack.dpotrf(matrix, lower=1, clean=1)
    if info == 0:
        rcond, _ = linalg.lapack.dpocon(factor, np.abs(matrix).sum(axis=0).max(), uplo="L")
        if rcond > 1e-14:
            return factor, float(rcond)
    else:
        rcond = 0.0
    refuse_null_space(matrix, np.concatenate(columns), lin, failed=info != 0)
    return factor, float(rcond)


def refuse_null_space(matrix: Floats, columns: Ints, lin: Linearization, failed: bool) -> None:
    """Refuse a scaled normal matrix with a null space and name its unknowns.

    Parameters
    ----------
    matrix : (k, k) array
    columns : (k,) int array
        The unknowns of the rows.
    failed : bool
        Whether it could not be factored; else a null space must show beyond rounding.

    Raises
    ------
    Singular
    """
    names = lin.unknowns.names
    values, vectors = linalg.eigh(matrix)
    limit = len(matrix) * np.finfo(float).eps * values[-1]
    null = vectors[:, values <= limit]
    if not null.shape[1]:
        if not failed:
            return
        null = vectors[:, :1]
    share = (null**2).sum(axis=1)
    order = np.argsort(-share, kind="stable")
    hit = [names[columns[i]] for i in order if share[i] > 0.02 * share.max()]
    shown = ", ".join(hit[:12]) + (f" and {len(hit) - 12} more" if len(hit) > 12 else "")
    rows = np.sqrt(lin.row_sums(1.0 / lin.scale**2))
    spread = rows.max() / rows[rows > 0.0].min()
    hint = f" (or the a-priori sigmas are too different: weighted observations differ by a factor of {spread:.0e})" if spread > 1e6 else ""
    raise Singular(f"the observations do not determine {len(null.T)} combination(s) of unknowns; involved: {shown}{hint}", hit)
