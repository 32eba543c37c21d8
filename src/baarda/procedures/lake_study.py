"""The study of residuals in partitioned Parquet: one pass of mergeable sums over any number of workers, then laws and tests."""

from __future__ import annotations

import hashlib
import json
import os
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from threadpoolctl import threadpool_limits

from baarda import __version__
from baarda.distributions.base import Floats
from baarda.distributions.class_fitting import fit_classes
from baarda.distributions.condensed import Condensed
from baarda.errors import InputError, NotEnoughMemory, UsageError
from baarda.executors import Outcome, Workers
from baarda.formats.residual_lake import Lake, footer_sha256, read_pieces
from baarda.hypotheses.base import TestResult
from baarda.hypotheses.moments import moment_tests
from baarda.hypotheses.normality import jarque_bera_of_moments
from baarda.hypotheses.variance_factor import global_variance_factor
from baarda.procedures.group_study import UNCONTROLLED, Groups, compare_groups
from baarda.procedures.lake_sums import PER_OCTAVE_BITS, SUMS, FilePart, GroupSums, LakeSums, PartJob, bound, condense_file
from baarda.procedures.law_study import StudyOptions
from baarda.procedures.long_study import _counts, _edges, _laws, _moments, _representatives
from baarda.procedures.residual_study import Kind, ResidualStudy, ScaleRule, _a_of_errors

__all__ = ["LakeStudy", "Passed", "pass_over", "study_lake", "study_sums"]

LEAST = 1000
AHEAD = 8  # files condensed before the one that is merged next, for each worker
_SAVE_EVERY = 60.0  # seconds
_NOTE = "Law for independent values of equal variance: approximate for residuals of an adjustment."
_SCHEMA = "baarda.lake-pass/1"


@dataclass(frozen=True)
class Passed:
    """One pass over a lake.

    Attributes
    ----------
    sums : LakeSums
    footers : tuple of str
        Hashes of the files' footers.
    peak : float
        Largest memory of a worker, bytes.
    continued : int
        Files that an earlier pass had done.
    """

    sums: LakeSums
    footers: tuple[str, ...]
    peak: float = 0.0
    continued: int = 0

    @property
    def sha256(self) -> str:
        """A hash of all footers in order."""
        return hashlib.sha256("\n".join(self.footers).encode()).hexdigest()


@dataclass(frozen=True)
class LakeStudy:
    """A study of a lake.

    Attributes
    ----------
    study : ResidualStudy
    groups : GroupSums
        Power sums and histograms by group.
    centre : float
        From which the sums are formed.
    medians, deviations : (k,) arrays
        Of the values of each group, from the histograms: median, and median absolute deviation times 1.4826.
    """

    study: ResidualStudy
    groups: GroupSums
    centre: float
    medians: Floats
    deviations: Floats


def study_lake(
    lake: Lake,
    options: StudyOptions | None = None,
    workers: Workers | None = None,
    *,
    saved: Path | None = None,
    progress: Callable[[int, int, int], None] | None = None,
) -> tuple[LakeStudy, Passed]:
    """Study the residuals of a lake in one pass.

    Parameters
    ----------
    lake : Lake
        See `baarda.formats.residual_lake.open_lake`.
    options : StudyOptions, optional
        Classes must be automatic.
    workers : Workers, optional
        See `baarda.executors.open_workers`; they must see the lake under the same address. The result does not depend on them.
    saved : Path, optional
        Where an interrupted pass is kept: the same call goes on from there, if files and columns are the same.
    progress : callable, optional
        Called with the numbers of files done and in all, and of rows read.

    Returns
    -------
    study : LakeStudy
    passed : Passed

    Raises
    ------
    InputError, TaskFailed
        If a file cannot be used; the message names file and row.
    NotEnoughMemory
        If workers may take less than the least that is needed.
    UsageError
        If there are fewer than 1000 values, all are equal, or options make no sense.

    Examples
    --------
    >>> import tempfile, pyarrow
    >>> from pyarrow import parquet
    >>> from baarda.formats.residual_lake import open_lake
    >>> rng = np.random.default_rng(1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("a", "b"):
    ...         parquet.write_table(pyarrow.table({"residual": rng.standard_normal(5000)}), f"{folder}/{name}.parquet")
    ...     found, _ = study_lake(open_lake(folder), StudyOptions(laws=("normal",), replicas=99))
    >>> found.study.n, found.study.gates["goodness_of_fit"]
    (10000, False)
    """
    o = StudyOptions() if options is None else options
    if not isinstance(o.classes, str):
        raise UsageError("a lake of residuals is studied on automatic classes")
    if o.loc and (lake.sigma is not None or lake.redundancy is not None):
        raise UsageError(f"loc = {o.loc:g} has no meaning for weighted residuals: only 0 has")
    passed = pass_over(lake, o.loc, workers, saved=saved, progress=progress)
    with threadpool_limits(limits=1, user_api="blas"):  # more threads sum in another order
        return study_sums(passed.sums, lake, o), passed


# ---- the pass ------------------------------------------------------------------------------------------------------------------------


def first_centre(lake: Lake) -> float:
    """Return the mean of the values of the first piece that has any: bins are narrow near it."""
    for index in range(len(lake.files)):
        for piece in read_pieces(lake, index):
            x = piece.residuals if piece.sigmas is None else piece.residuals / piece.sigmas
            if piece.redundancy is not None:
                kept = piece.redundancy >= UNCONTROLLED
                x = x[kept] / np.sqrt(piece.redundancy[kept])
            if len(x):
                return float(np.mean(x))
    raise InputError("the files hold no values", lake.address)


def pass_over(
    lake: Lake,
    loc: float | None = None,
    workers: Workers | None = None,
    *,
    saved: Path | None = None,
    progress: Callable[[int, int, int], None] | None = None,
) -> Passed:
    """Condense all files of a lake and merge them in order; parameters as those of `study_lake`.

    Parameters
    ----------
    lake : Lake
    loc : float, optional
        Known expectation, from which distances are taken; by default the mean of the first piece.
    workers, saved, progress
        See `study_lake`.

    Returns
    -------
    Passed
    """
    engine = Workers() if workers is None else workers
    least = bound(0)
    if engine.memory < least:
        raise NotEnoughMemory(
            f"a worker needs {least / 1e9:.2f} GB of memory at least, and {(bound(10**6) - least) / 1e9:.1f} GB more for a million groups; "
            f"the workers may take {engine.memory / 1e9:.2f} GB"
        )
    centre = first_centre(lake) if loc is None else loc
    state, footers = (LakeSums(), list[str]()) if saved is None else _load(saved, lake, centre)
    continued, peak, last = len(footers), 0.0, time.monotonic()
    waiting: dict[int, FilePart] = {}
    jobs = [PartJob(lake, i, centre) for i in range(continued, len(lake.files))]
    try:
        for outcome in engine.run(condense_file, jobs, AHEAD * max(1, engine.count), again=("OutputError", "WorkerDied")):
            _take(outcome, waiting, continued)
            while (part := waiting.pop(len(footers), None)) is not None:
                state.merge(part.sums)
                footers.append(part.footer)
                peak = max(peak, part.peak)
                if progress is not None:
                    progress(len(footers), len(lake.files), state.rows)
            if saved is not None and time.monotonic() - last > _SAVE_EVERY:
                _save(saved, lake, centre, state, footers)
                last = time.monotonic()
    except BaseException:
        if saved is not None and len(footers) > continued:
            _save(saved, lake, centre, state, footers)
        raise
    return Passed(state, tuple(footers), peak, continued)


def _take(outcome: Outcome[FilePart], waiting: dict[int, FilePart], before: int) -> None:
    waiting[before + outcome.index] = outcome.result()


def _head(lake: Lake, centre: float, footers: Sequence[str]) -> dict[str, Any]:
    columns = [lake.column, lake.group, lake.sigma, lake.redundancy]
    files = list(lake.files[: len(footers)])
    return {"schema": _SCHEMA, "version": __version__, "columns": columns, "centre": centre, "files": files, "footers": list(footers)}


def _save(path: Path, lake: Lake, centre: float, state: LakeSums, footers: Sequence[str]) -> None:
    """Keep a pass that is not at its end; numbers and texts only."""
    c, g = state.condensed, state.groups.trimmed()
    numbers = {n: getattr(state, n) for n in ("low", "high", "rows", "set_aside", "squares", "redundancy", "redundancy_squares")}
    head = {
        **_head(lake, centre, footers),
        "numbers": {k: v if np.isfinite(v) else None for k, v in numbers.items()},
        "names": list(g.names),
    }
    arrays: dict[str, Any] = {"sums": g.sums, "keys": g.keys, "counts": g.counts}
    if c is not None:
        arrays |= {f"c_{n}": getattr(c, n) for n in ("keys", "counts", "high", "low", "squares")}
    beside = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        with beside.open("wb") as f:
            np.savez(f, head=np.frombuffer(json.dumps(head).encode(), dtype=np.uint8), **arrays)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def _load(path: Path, lake: Lake, centre: float) -> tuple[LakeSums, list[str]]:
    """Return a pass that was kept, if it was one over the same beginning of the lake."""
    nothing = LakeSums(), list[str]()
    try:
        with np.load(path, allow_pickle=False) as data:
            head = json.loads(data["head"].tobytes().decode())
            footers = head["footers"]
            expected = _head(lake, centre, footers)
            if any(head[k] != v for k, v in expected.items()):
                return nothing
            arrays = {n: data[n] for n in data.files if n != "head"}
        if any(footer_sha256(lake, i) != f for i, f in enumerate(footers)):
            return nothing
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, InputError):
        return nothing
    ends = {"low": np.inf, "high": -np.inf}
    numbers: dict[str, Any] = {k: ends[k] if v is None else v for k, v in head["numbers"].items()}
    index = {name: i for i, name in enumerate(head["names"])}
    groups = GroupSums(index, arrays["sums"], arrays["keys"], arrays["counts"].astype(np.int64))
    c = Condensed(centre, *(arrays[f"c_{n}"] for n in ("keys", "counts", "high", "low", "squares"))) if "c_keys" in arrays else None
    return LakeSums(c, **numbers, groups=groups), list(footers)


# ---- from the sums to the study ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scaled(Condensed):
    """Condensed values times a factor."""

    factor: float = 1.0

    @property
    def sums(self) -> Floats:
        return super().sums * self.factor

    def ranges(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        lower, upper, counts = super().ranges()
        return lower * self.factor, upper * self.factor, counts

    def points(self, *, folded: bool = False, per_octave: int = 64) -> tuple[Floats, Floats]:
        at, weights = super().points(folded=folded, per_octave=per_octave)
        return at * self.factor, weights


def study_sums(sums: LakeSums, lake: Lake, o: StudyOptions) -> LakeStudy:
    """Study what a pass condensed.

    Parameters
    ----------
    sums : LakeSums
    lake : Lake
        For the columns in use.
    o : StudyOptions

    Returns
    -------
    LakeStudy

    Raises
    ------
    UsageError
        If there are too few values, or all are equal.
    """
    c = sums.condensed
    if c is None or c.n < LEAST:
        raise UsageError(f"{0 if c is None else c.n} controlled residuals: a lake is studied from {LEAST} on")
    if sums.low == sums.high:
        raise UsageError(f"all {c.n} residuals are equal ({sums.low:g}): nothing can be tested")
    shift, kind, sigma0, factor = c.centre, _kind(lake), None, 1.0
    total = sums.redundancy if lake.redundancy is not None else None
    if total is not None:
        sigma0 = float(np.sqrt(sums.squares / total))
        factor = 1.0 / sigma0
        c = _Scaled(c.centre * factor, c.keys, c.counts, c.high, c.low, c.squares, factor)
    n, moments = c.n, _moments(c)
    about = (moments[0] - (o.loc or 0.0), *moments[1:])
    tests: list[TestResult] = []
    if total is not None and lake.sigma is not None:
        said = "r is the sum of the redundancy numbers of the table, which must hold all observations of the adjustment."
        tests.append(replace(global_variance_factor(sums.squares, total, alpha=o.alpha), note=said))
    tests += [*moment_tests(n, about, o.alpha, _NOTE), jarque_bera_of_moments(n, moments[2], moments[3], o.alpha, note=_NOTE)]
    laws, rules = _laws(c, moments[:2], o)
    if total is not None:
        rules = _standardised_rules(c, sums, total, moments, o)
    groups, left_out = _groups(sums, lake, shift, o)
    left_out += [("values one by one", "the lake was read in one pass: figures show representative values"), *laws.left_out]
    share = None if total is None else np.sqrt(np.array([sums.redundancy_squares / n]))
    values = _representatives(c, sums.low * factor, sums.high * factor)
    study = ResidualStudy(
        o,
        values,
        kind,
        values,
        sums.set_aside,
        *moments,
        total,
        sigma0,
        tuple(tests),
        groups,
        rules,
        laws,
        _a_of_errors(laws, share),
        tuple(left_out),
        n,
    )
    medians, deviations = _robust(sums.groups, shift)
    return LakeStudy(study, sums.groups, shift, medians, deviations)


def _kind(lake: Lake) -> Kind:
    return "standardised" if lake.redundancy is not None else "raw" if lake.sigma is None else "weighted"


def _standardised_rules(
    c: Condensed, sums: LakeSums, total: float, moments: tuple[float, float, float, float], o: StudyOptions
) -> tuple[ScaleRule, ...]:
    """S_o for description, and Q_v on classes: the normal law N(0, 1) of values divided by their own standard deviations."""
    edges = _edges(c, moments[0] if o.loc is None else o.loc, moments[1], o)
    judged = None
    if edges is not None:
        judged = fit_classes(_counts(c, edges), edges, "normal", loc=0.0, scale=1.0, estimated=1, alpha=o.alpha)
    described = ScaleRule("redundancy", "S_o", 0.0, float(np.sqrt(sums.squares / total)), None, described=True)
    return described, ScaleRule("standardised", "Q_v", 0.0, 1.0, judged)


def _groups(sums: LakeSums, lake: Lake, shift: float, o: StudyOptions) -> tuple[Groups | None, list[tuple[str, str]]]:
    """Moments and tests of the groups from their sums."""
    if lake.group is None:
        return None, []
    g = sums.groups
    k = len(g.index)
    n, d, d2, _, _, r, _, _ = g.sums[:k].T
    some = np.maximum(n, 1.0)
    by_redundancy = lake.redundancy is not None
    squares = d2 + 2.0 * shift * d + n * shift * shift if by_redundancy else d2 - d * d / some
    df = np.array(r) if by_redundancy else n - 1.0
    usable = df > UNCONTROLLED
    variances = np.divide(squares, df, out=np.full(k, np.nan), where=usable)
    means = np.where(n > 0, shift + d / some, np.nan)
    none = np.zeros(0, dtype=np.intp)
    made, left_out = compare_groups(Groups(g.names, none, n.astype(np.int64), means, variances, df, by_redundancy), np.zeros(0), o)
    robust = _brown_forsythe(g, o.alpha)
    return (made if robust is None else replace(made, tests=(*made.tests, robust))), left_out


def _bins(g: GroupSums) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return the limits of the bins, ascending, as distances from the centre, and the counts of each group in them."""
    side = 1 << (11 + PER_OCTAVE_BITS)
    places = (g.keys & (side - 1)).astype(np.uint64)
    near, far = ((places + np.uint64(i) << np.uint64(52 - PER_OCTAVE_BITS)).view(np.float64) for i in (0, 1))
    negative = g.keys >= side
    lower, upper = np.where(negative, -far, near), np.where(negative, -near, far)
    order = np.argsort(lower, kind="stable")
    return lower[order], upper[order], g.counts[: len(g.index)][:, order]


def _quantile(lower: Floats, upper: Floats, counts: NDArray[np.int64]) -> Floats:
    """Return the median of each row of counts; values rise evenly within a bin."""
    if not counts.size:
        return np.zeros(len(counts))
    after = np.cumsum(counts, axis=1)
    half = 0.5 * after[:, -1:]
    k = np.minimum((after < half).sum(axis=1), counts.shape[1] - 1)
    rows = np.arange(len(counts))
    inside = counts[rows, k]
    share = np.divide(half[:, 0] - (after[rows, k] - inside), inside, out=np.zeros(len(counts)), where=inside > 0)
    return np.where(after[:, -1] > 0, lower[k] + share * (upper[k] - lower[k]), np.nan)


def _robust(g: GroupSums, shift: float) -> tuple[Floats, Floats]:
    """Return median and scaled median absolute deviation of each group."""
    lower, upper, counts = _bins(g)
    medians = _quantile(lower, upper, counts)
    deviations = np.full(len(medians), np.nan)
    middle = 0.5 * (lower + upper)
    for i, m in enumerate(medians):  # the order of the distances is another one for each median
        some = np.flatnonzero(counts[i])
        if len(some):
            distance = np.abs(middle[some] - m)
            order = np.argsort(distance, kind="stable")
            after = np.cumsum(counts[i, some[order]])
            deviations[i] = 1.4826 * float(np.interp(0.5 * after[-1], after - 0.5 * counts[i, some[order]], distance[order]))
    return shift + medians, deviations


def _brown_forsythe(g: GroupSums, alpha: float) -> TestResult | None:
    """Brown and Forsythe's test from sums and bins: squares exactly, medians and distances from bins of a quarter octave."""
    lower, upper, counts = _bins(g)
    k = len(g.index)
    n, e, e2 = g.sums[:k, SUMS.index("n")], g.sums[:k, SUMS.index("e")], g.sums[:k, SUMS.index("e2")]
    full = np.flatnonzero(n)
    if len(full) < 2 or n.sum() <= len(full):
        return None
    medians = _quantile(lower, upper, counts)
    distances = np.zeros(k)
    for i in full:
        m = medians[i]
        a, b = lower - m, upper - m  # the mean of |x - m| where x is even between the limits
        inside = (a < 0.0) & (b > 0.0)
        mean = np.where(inside, 0.5 * (a * a + b * b) / np.where(inside, b - a, 1.0), np.abs(0.5 * (a + b)))
        distances[i] = float((counts[i] * mean).sum())
    means = np.divide(distances, n, out=np.zeros(k), where=n > 0)
    within = float(np.sum((e2 - 2.0 * medians * e + n * medians**2)[full] - (n * means**2)[full]))
    if not within > 0.0:
        return None
    whole = float(distances.sum() / n.sum())
    between = float(np.sum(n * (means - whole) ** 2))
    df = (len(full) - 1, int(n.sum()) - len(full))
    return TestResult(
        "brown_forsythe",
        "All groups have the same spread, whatever their law.",
        between / df[0] / (within / df[1]),
        stats.f(*df),
        f"F({df[0]}, {df[1]})",
        alpha,
        df=(float(df[0]), float(df[1])),
        note="Medians and distances from bins of a quarter octave: the statistic is good to a few percent.",
    )


def group_moments(found: LakeStudy) -> tuple[Floats, Floats]:
    """Return skewness and kurtosis of the (weighted) residuals of each group; NaN where the variance is zero.

    Parameters
    ----------
    found : LakeStudy

    Returns
    -------
    skewness, kurtosis : (k,) arrays
    """
    n, d, d2, d3, d4 = found.groups.sums[: len(found.groups.index), :5].T
    n = np.maximum(n, 1.0)
    m, m2 = d / n, d2 / n - (d / n) ** 2
    third = d3 / n - 3.0 * m * d2 / n + 2.0 * m**3
    fourth = d4 / n - 4.0 * m * d3 / n + 6.0 * m * m * d2 / n - 3.0 * m**4
    some = m2 > 0.0
    safe = np.where(some, m2, 1.0)
    return np.where(some, third / safe**1.5, np.nan), np.where(some, fourth / safe**2, np.nan)
