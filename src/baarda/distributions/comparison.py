"""Several laws fitted to the same values, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from baarda.distributions import law as find_law
from baarda.distributions.base import Law
from baarda.distributions.class_fitting import histogram_of
from baarda.distributions.histogram import Ends, check_edges, count, equal_probability_edges, usual_number_of_classes
from baarda.distributions.likelihood import maximise
from baarda.distributions.result import Fit as Fit
from baarda.distributions.sample import Sample, check_values, given_values
from baarda.errors import UsageError

USUAL = ("normal", "radico", "lineo", "modulated_normal")


def compare_laws(
    values: ArrayLike,
    laws: Sequence[str | Law] = USUAL,
    *,
    classes: int | ArrayLike | None = None,
    loc: float | None = None,
    scale: float | None = None,
    shapes: Mapping[str, Mapping[str, float]] | None = None,
    ends: Ends = "open",
    alpha: float = 0.05,
) -> tuple[Fit, ...]:
    """Fit each law by maximum likelihood and test it by chi-square on classes.

    Parameters
    ----------
    values : (n,) array
        Residuals, usually each divided by its own standard deviation.
    laws : sequence of str or Law
        The laws.
    classes : int or (k+1,) array, optional
        Number of classes that are equally probable under each fitted law (default about 2 n^(2/5)), or class limits common to all laws.
    loc, scale : float, optional
        Given values, for instance 0 and 1 for standardised residuals; estimated when None.
    shapes : mapping, optional
        Given shape values by law name.
    ends : {"open", "closed"}
        End classes, where limits are given.
    alpha : float
        Level of the chi-square tests.

    Returns
    -------
    tuple of Fit
        In the order of `laws`, each with histogram, degrees of freedom (classes - 1 - estimated parameters), p-value and criteria.

    Raises
    ------
    UsageError
        If values are too few for two classes, not finite, or not covered by closed classes.

    Notes
    -----
    The p-values hold for independent values. Where parameters are estimated from the values themselves and not from the classes, the
    law of chi-square lies between the stated degrees of freedom and classes - 1 (Chernoff & Lehmann 1954): the test then rejects a
    little too often. For residuals of an adjustment see `baarda.hypotheses.goodness_of_fit`.

    Examples
    --------
    >>> rng = np.random.default_rng(7)
    >>> v = rng.standard_normal(5000) * np.sqrt(2.0 * rng.random(5000))
    >>> [(f.law, f.rejected) for f in compare_laws(v, ("normal", "equi"), loc=0.0, scale=1.0)]
    [('normal', True), ('equi', False)]
    """
    x = check_values(values)
    if not laws:
        raise UsageError("no laws given to compare")
    members = [find_law(name) if isinstance(name, str) else name for name in laws]
    limits = None if classes is None or isinstance(classes, int | np.integer) else check_edges(classes)
    if limits is not None:
        common = count(x, limits, ends)
    elif ends == "closed":
        raise UsageError("closed end classes need class limits")
    ordered = np.sort(x) if limits is None else x
    centre = loc if loc is not None else float(np.mean(x))
    sample = Sample.of(x, centre)
    results = []
    for member in members:
        given = given_values(member, loc, scale, (shapes or {}).get(member.name))
        found = maximise(member, sample, given, tuple(name for name in member.parameter_names if name not in given))
        estimated = len(found.estimated)
        if limits is not None:
            histogram = histogram_of(common, limits, found.distribution, ends)
        else:
            k = int(classes) if isinstance(classes, int | np.integer) else usual_number_of_classes(x.size, estimated)
            b = equal_probability_edges(found.distribution, k)
            histogram = histogram_of(count(ordered, b, is_sorted=True), b, found.distribution)
        results.append(replace(found, histogram=histogram, df=histogram.counts.size - 1 - estimated, alpha=alpha))
    return tuple(results)
