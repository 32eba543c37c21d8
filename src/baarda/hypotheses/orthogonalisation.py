"""A-posteriori orthogonalisation: uncorrelated combinations of the additional parameters, their tests, and the way back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from baarda.errors import Singular, UsageError
from baarda.hypotheses._estimates import joined, judged, not_applicable
from baarda.hypotheses._quadratic import factor, variances, vector_and_matrix
from baarda.hypotheses.base import Evidence, Floats, TestResult
from baarda.hypotheses.levels import Options, Policy
from baarda.hypotheses.parameters import single_parameter

__all__ = ["Orthogonalised", "orthogonalise", "orthogonalised_parameters", "reduced_parameters"]

ORDER = 51


@dataclass(frozen=True)
class Orthogonalised:
    """Uncorrelated combinations of correlated estimates.

    Attributes
    ----------
    values : (k,) array
        z*, uncorrelated.
    cofactors : (k,) array
        Their cofactors.
    back : (k, k) array
        z = back @ z*: the way back, also after components were set to zero.
    """

    values: Floats
    cofactors: Floats
    back: Floats


def orthogonalise(
    values: ArrayLike, cofactors: ArrayLike, basis: Literal["eigen", "triangular"] = "eigen", names: Sequence[str] = ()
) -> Orthogonalised:
    """Return uncorrelated combinations of estimates.

    Parameters
    ----------
    values : (k,) array
        Estimates z.
    cofactors : (k, k) array
        Their cofactors.
    basis : {"eigen", "triangular"}
        Eigenvectors of the correlation matrix (independent of units), or the triangular factor (keeps the order: component j is
        parameter j cleaned of the earlier ones).
    names : sequence of str
        For messages.

    Returns
    -------
    Orthogonalised

    Raises
    ------
    Singular
        If a parameter is a combination of others.
    UsageError
        If the basis is unknown or shapes do not fit.

    Notes
    -----
    Grün (1978) p. 397: feasible a posteriori in close range; sum of t_i^2 = p T of the joint test.

    Examples
    --------
    >>> o = orthogonalise([1.0, 2.0], [[4.0, 1.0], [1.0, 2.0]], "triangular")
    >>> o.values, o.cofactors
    (array([1.  , 1.75]), array([4.  , 1.75]))
    """
    z, q = vector_and_matrix(values, cofactors)
    s, lower = factor(q, names)
    if basis == "triangular":
        pivots = np.diagonal(lower)
        star = np.asarray(linalg.solve_triangular(lower, z / s, lower=True)) * pivots * s
        return Orthogonalised(star, (pivots * s) ** 2, s[:, None] * lower / (pivots * s)[None, :])
    if basis != "eigen":
        raise UsageError(f"the basis is 'eigen' or 'triangular', not {basis!r}")
    share, vectors = linalg.eigh(lower @ lower.T)
    # Best determined last in LAPACK's order; a sign rule makes the result reproducible.
    vectors = vectors * np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(len(z))] < 0.0, -1.0, 1.0)
    return Orthogonalised(vectors.T @ (z / s), share, s[:, None] * vectors)


def orthogonalised_parameters(
    values: ArrayLike,
    cofactors: ArrayLike,
    variance_factor: float,
    redundancy: float,
    alpha: float = 0.05,
    levels: Policy = "none",
    names: Sequence[str] = (),
    basis: Literal["eigen", "triangular"] = "eigen",
    name: str = "orthogonalised_parameters",
) -> TestResult:
    """Test uncorrelated combinations of the parameters one by one: t tests that correlation does not mislead.

    Parameters
    ----------
    values, cofactors, variance_factor, redundancy, alpha, levels, names, name
        As in `general_linear` and `single_parameter`.
    basis : {"eigen", "triangular"}
        See `orthogonalise`.

    Returns
    -------
    TestResult
        A family: z*_i / (s0 sqrt(d_i)) under t(r); labels name the parameters that dominate a component.

    Raises
    ------
    Singular, UsageError, RedundancyNotPositive
        As `orthogonalise` and `single_parameter`.

    Notes
    -----
    Grün (1978) p. 397.

    Examples
    --------
    >>> t = orthogonalised_parameters([1.0, 2.0], [[1.0, 0.5], [0.5, 2.0]], 0.25, 10)
    >>> float((t.statistic**2).sum() / 2)  # T of general_linear
    4.571
    """
    o = orthogonalise(values, cofactors, basis, names)
    words = tuple(names) or tuple(f"parameter {i + 1}" for i in range(len(o.values)))
    weights = np.abs(o.back) / np.sqrt(variances(np.asarray(cofactors, dtype=float), names))[:, None]
    if basis == "triangular":
        labels = [words[0], *(f"{w} cleaned of the earlier ones" for w in words[1:])]
    else:
        labels = []
        for j in range(len(words)):
            order = np.argsort(-weights[:, j], kind="stable")
            main = [words[i] for i in order if weights[i, j] > 0.5 * weights[order[0], j]][:4]
            labels.append(f"component {j + 1} ({', '.join(main)})")
    t = single_parameter(o.values, o.cofactors, variance_factor, redundancy, 0.0, alpha, levels, labels, name)
    details = {**t.details, "basis": basis}
    null = "The uncorrelated combination of the parameters is zero."
    return TestResult(t.name, null, t.statistic, t.law, t.law_name, t.alpha, t.tail, t.df, t.labels, t.note, details)


def reduced_parameters(orthogonalised: Orthogonalised, keep: ArrayLike) -> tuple[Floats, Floats, float]:
    """Set components to zero and lead the others back to the parameters.

    Parameters
    ----------
    orthogonalised : Orthogonalised
    keep : (k,) bool array
        Components that stay, for instance those whose test rejects.

    Returns
    -------
    values : (k,) array
        z = S z* with the dropped z* zero: the least-squares estimates under that hypothesis.
    cofactors : (k, k) array
        Their cofactors, of the rank that was kept.
    growth : float
        How much v'Pv grows: the sum of z*^2 / d over the dropped components.

    Raises
    ------
    UsageError
        If there is not one flag per component.

    Notes
    -----
    Grün (1978) p. 397.

    Examples
    --------
    >>> o = orthogonalise([1.0, 2.0], [[4.0, 1.0], [1.0, 2.0]], "triangular")
    >>> values, cofactors, growth = reduced_parameters(o, [False, True])
    >>> values, growth
    (array([0.  , 1.75]), 0.25)
    """
    kept = np.asarray(keep, dtype=bool)
    if kept.shape != orthogonalised.values.shape:
        raise UsageError(f"{kept.shape} flags for {len(orthogonalised.values)} components")
    back = orthogonalised.back[:, kept]
    dropped = orthogonalised.values[~kept] ** 2 / orthogonalised.cofactors[~kept]
    return back @ orthogonalised.values[kept], (back * orthogonalised.cofactors[kept]) @ back.T, float(dropped.sum())


def from_evidence(evidence: Evidence, options: Options) -> list[TestResult]:
    """Return the tests of the orthogonalised additional parameters: by eigenvectors, and in their order (triangular)."""
    j = judged(evidence, options)
    if j is None or len(j.estimates.values) < 2:
        return []
    e, alpha, policy = j.estimates, options.global_level(1), options.levels
    given = (e.values, e.cofactors, j.variance_factor, j.redundancy, alpha, policy, e.names)
    results = []
    bases: tuple[tuple[Literal["eigen", "triangular"], str], ...] = (
        ("eigen", "orthogonalised_additional_parameters"),
        ("triangular", "successive_additional_parameters"),
    )
    for basis, name in bases:
        try:
            found = orthogonalised_parameters(*given, basis, name)
            results.append(replace(found, note=joined(found.note, j.note)))
        except Singular as error:
            null = "The uncorrelated combination of the parameters is zero."
            results.append(not_applicable(name, null, str(error), alpha, j.redundancy, e.names, 1, policy))
    return results
