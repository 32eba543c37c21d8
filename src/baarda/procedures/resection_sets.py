"""Many images resected independently from control points, one adjustment each: homogeneity between them, and a study of all residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baarda.adjustment import Adjustment, adjust
from baarda.cameras import FIXED, FREE
from baarda.errors import BaardaError, Singular, UsageError
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.homogeneity import bartlett
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import critical_tau
from baarda.hypotheses.variance_factor import global_variance_factor
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import ImagePoints
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.residual_study import LEAST, ResidualStudy, study
from baarda.procedures.testing import Analysis

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
UNCONTROLLED = 1e-10
LEAST_POINTS = 4
_KEPT = ("residual_plane", "image_sigma", "iterations", "tolerance")  # settings of a source that mean something for one image


@dataclass(frozen=True)
class ResectedSet:
    """One set: an image, its control points, and what came of it.

    Attributes
    ----------
    label : str
    points : int
        Control points measured in the image.
    adjustment : Adjustment or None
        None where it failed.
    reason : str
        Why it failed; empty where it did not.
    exit_code : int
        What the failure alone would have exited with.
    """

    label: str
    points: int
    adjustment: Adjustment | None = None
    reason: str = ""
    exit_code: int = 0


@dataclass(frozen=True)
class Resections:
    """All sets, and what they say together.

    Attributes
    ----------
    sets : tuple of ResectedSet
        In the order of the images.
    options : Options
    homogeneity : TestResult or None
        Bartlett's test of equal variance factors; None for a single set.
    study : ResidualStudy or None
        Of the residuals of all sets, divided by their own standard deviations.
    left_out : str
        Why there is no study; empty where there is one.
    """

    sets: tuple[ResectedSet, ...]
    options: Options
    homogeneity: TestResult | None
    study: ResidualStudy | None
    left_out: str = ""

    @cached_property
    def adjusted(self) -> tuple[tuple[str, Adjustment], ...]:
        """Label and adjustment of the sets that were adjusted."""
        return tuple((s.label, s.adjustment) for s in self.sets if s.adjustment is not None)

    @property
    def failed(self) -> tuple[ResectedSet, ...]:
        """The sets that were not."""
        return tuple(s for s in self.sets if s.adjustment is None)

    @property
    def redundancy(self) -> int:
        """Sum of the redundancies."""
        return sum(a.redundancy for _, a in self.adjusted)

    @property
    def sigma0(self) -> float:
        """Pooled standard deviation of unit weight."""
        return float(np.sqrt(sum(a.objective for _, a in self.adjusted) / self.redundancy))

    def against_pooled(self) -> Floats:
        """Return for each adjusted set r S_i^2 / S^2 and its two-sided chi-square limits, (k, 3).

        S^2 is the pooled variance, of which each set is a part: the test is approximate and a little too mild (Maarek & Konecny, step 2).
        """
        r = np.array([a.redundancy for _, a in self.adjusted], dtype=float)
        ratio = np.array([a.objective for _, a in self.adjusted]) / self.sigma0**2
        low, high = (stats.chi2.ppf(q, r) for q in (self.options.alpha / 2.0, 1.0 - self.options.alpha / 2.0))
        return np.stack([ratio, low, high], axis=1)

    def global_tests(self) -> list[TestResult]:
        """Return the global test of each adjusted set: its variance factor against the a-priori one."""
        return [global_variance_factor(a.objective, a.redundancy, alpha=self.options.alpha) for _, a in self.adjusted]

    @cached_property
    def outliers(self) -> list[tuple[Floats, float]]:
        """tau of every observation of each adjusted set, and its limit at the level of single observations."""
        out = []
        for _, a in self.adjusted:
            limit = critical_tau(a.redundancy, self.options.alpha_outlier) if a.redundancy > 1 else float("nan")
            out.append((Analysis(a, self.options, ()).tau, limit))
        return out

    @property
    def gates(self) -> dict[str, bool]:
        """What ``--strict`` asks: True where a test rejects, or sets failed."""
        beyond = any(bool((np.abs(tau) > limit).any()) for tau, limit in self.outliers)
        out = {"failed sets": bool(self.failed), "data_snooping": beyond}
        if self.homogeneity is not None:
            out["bartlett"] = bool(self.homogeneity.rejected)
        whole = None if self.study is None else self.study.test("global_variance_factor")
        return out if whole is None else {**out, "global_variance_factor": bool(whole.rejected)}


def sets_of(networks: Sequence[Network]) -> list[tuple[str, Network]]:
    """Take networks apart into one network for each image, with the control points that it sees.

    Parameters
    ----------
    networks : sequence of Network

    Returns
    -------
    list of (str, Network)
        Label and network of each image: its camera, six unknowns, control held at its given coordinates. A label that several networks
        use is preceded by the path or name of its network.

    Raises
    ------
    UsageError
        If there is no image at all.

    Examples
    --------
    >>> from baarda.papers.maarek_konecny_study import grid_network
    >>> made = grid_network(3, "one", np.random.default_rng(1), np.zeros(18), 8.0)
    >>> [(label, len(n.points.labels)) for label, n in sets_of([made])]
    [('one', 9)]
    """
    every = [label for n in networks for label in n.images.labels]
    if not every:
        raise UsageError("there are no images to resect")
    twice = {label for label in every if every.count(label) > 1}
    out = []
    for number, n in enumerate(networks, start=1):
        for i, label in enumerate(n.images.labels):
            origin = n.path or n.name or str(number)
            out.append((f"{origin}: {label}" if label in twice else label, _of_image(n, i)))
    return out


def _of_image(network: Network, image: int) -> Network:
    points = network.points
    given = np.where(np.isfinite(points.given), points.given, points.coordinates)
    known = (points.roles == CONTROL) & np.isfinite(given).all(axis=1)
    rows = [
        (g, np.flatnonzero((g.images == image) & known[g.points])) for g in network.observations if isinstance(g, ImagePoints) and len(g)
    ]
    used = np.unique(np.concatenate([np.zeros(0, dtype=np.intp), *(g.points[at] for g, at in rows)]))
    index = np.full(len(points.labels), -1)
    index[used] = np.arange(len(used))
    groups = tuple(
        replace(part, images=np.zeros(len(part), dtype=np.intp), points=index[part.points])
        for part in (g.selected(at) for g, at in rows if len(at))
    )
    x = given[used]
    table = Points.make(
        [points.labels[i] for i in used], x, np.full(len(used), CONTROL), np.full(x.shape, FIXED), given=x, sigmas=np.full(x.shape, np.nan)
    )
    cameras = () if not network.cameras else (network.cameras[int(network.images.cameras[image])],)
    position, rotation = network.images.position[image : image + 1], network.images.rotation[image : image + 1]
    images = Images.make([network.images.labels[image]], position=position, rotation=rotation, states=np.full((1, 6), FREE))
    settings = {k: v for k, v in network.settings.items() if k in _KEPT}
    return replace(network, cameras=cameras, images=images, points=table, observations=groups, declared=(), settings=settings)


def resect_sets(
    sets: Sequence[tuple[str, Network]],
    options: Options | None = None,
    study_options: StudyOptions | None = None,
    tell: Callable[[str], None] | None = None,
    **settings: Any,
) -> Resections:
    """Resect many images, each by an adjustment of its own, and judge them together; a failure is a set without adjustment.

    Parameters
    ----------
    sets : sequence of (str, Network)
        From `sets_of`.
    options : Options, optional
        Levels.
    study_options : StudyOptions, optional
        Of the study of all residuals.
    tell : callable, optional
        Is told of each set.
    **settings
        Fields of `Settings`; camera parameters stay fixed unless `camera` says otherwise.

    Returns
    -------
    Resections

    Raises
    ------
    UsageError
        If no set could be adjusted because sources make no sense; the message is that of the first.
    Singular
        If no set could be adjusted for want of control.

    Notes
    -----
    Maarek & Konecny, steps 1 to 3: 19 grid sets, each a space resection of six unknowns; Bartlett's test; residuals pooled.

    Examples
    --------
    >>> from baarda.papers.maarek_konecny_study import grid_network
    >>> rng = np.random.default_rng(1)
    >>> made = [grid_network(3, str(k), rng, 8.0 * rng.standard_normal(18), 8.0) for k in range(3)]
    >>> resect_sets(sets_of(made), study_options=StudyOptions(replicas=19)).redundancy
    36
    """
    o = Options() if options is None else options
    chosen = {"camera": (), **{k: v for k, v in settings.items() if v is not None}}
    found = []
    for label, network in sets:
        found.append(_resected(label, network, chosen))
        if tell is not None:
            a = found[-1].adjustment
            tell(f"set {label}: " + (f"redundancy {a.redundancy}, s0 {a.sigma0:.4g}" if a is not None else found[-1].reason))
    good = [s.adjustment for s in found if s.adjustment is not None]
    if not good:
        worst = max(found, key=lambda s: s.exit_code)
        kind = Singular if worst.exit_code == 3 else UsageError
        raise kind(f"none of {len(found)} set(s) could be adjusted; set {worst.label}: {worst.reason}")
    factors, df = [a.variance_factor for a in good], [a.redundancy for a in good]
    exact = [s.label for s in found if s.adjustment is not None and not s.adjustment.variance_factor > 0.0]
    homogeneity = bartlett(factors, df, o.alpha) if len(good) > 1 and not exact else None
    made = Resections(tuple(found), o, homogeneity, None)
    pooled, why = _pooled(made, study_options)
    return replace(made, study=pooled, left_out=why)


def _resected(label: str, network: Network, settings: dict[str, Any]) -> ResectedSet:
    count = len(network.points.labels)
    nothing = replace(network.images, position=np.full((1, 3), np.nan), rotation=np.full((1, 3, 3), np.nan))
    reason, code = "", 3
    # first from the source's orientation, where it has one, then from control points alone
    for start in (network, replace(network, images=nothing)):
        try:
            if count < LEAST_POINTS:
                raise Singular(f"{count} control point(s) with image coordinates: six unknowns need {LEAST_POINTS} to be tested")
            a = adjust(start, **settings)
        except BaardaError as error:
            reason, code = str(error), error.exit_code
            continue
        if a.status == "converged":
            return ResectedSet(label, count, a)
        reason, code = f"not converged after {len(a.history) - 1} iterations; {a.contradictions()}", 3
    return ResectedSet(label, count, None, reason, code)


def pooled_columns(made: Resections) -> tuple[Floats, Ints, Floats, Floats]:
    """Return residuals, set of each (in the order of the adjusted ones), a-priori sigmas and redundancy numbers of all adjusted sets."""
    parts = [a for _, a in made.adjusted]
    codes = np.repeat(np.arange(len(parts)), [a.count for a in parts])
    return (
        np.concatenate([a.residuals for a in parts]),
        codes,
        np.concatenate([a.sigmas for a in parts]),
        np.concatenate([a.redundancy_numbers for a in parts]),
    )


def _pooled(made: Resections, options: StudyOptions | None) -> tuple[ResidualStudy | None, str]:
    correlated = [label for label, a in made.adjusted if any(c.correlated for c in a.lin.chunks)]
    if correlated:
        return None, f"the image coordinates of set {correlated[0]} are correlated: residuals are studied one by one"
    v, codes, sigmas, shares = pooled_columns(made)
    if (shares >= UNCONTROLLED).sum() < LEAST:
        return None, "fewer than 3 residuals are controlled by other observations"
    parts = [a for _, a in made.adjusted]
    offsets = np.concatenate([[0], np.cumsum([a.count for a in parts])])

    def standardised_of(errors: Floats) -> Floats:
        u = np.concatenate([a.residuals_of(errors[offsets[k] : offsets[k + 1]]) for k, a in enumerate(parts)])
        s = np.sqrt(np.sum(u * u, axis=0) / shares.sum())
        return np.asarray(u / (s * np.sqrt(shares)[:, None]))

    names = [label for label, _ in made.adjusted]
    through = standardised_of if (shares >= UNCONTROLLED).all() else None
    try:
        return study(v, codes, sigmas, shares, options, group_names=names, residuals_of=through), ""
    except UsageError as error:
        return None, str(error)
