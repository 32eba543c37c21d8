"""Monte Carlo on the user's own network: predicted sigmas, sizes and powers of the tests, minimal detectable biases, each against replicas.

Replica k draws normal errors from child k of the seed, so that the outcome does not depend on how many processes share the work.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from baarda.adjustment import Adjustment, adjust
from baarda.errors import BaardaError, NotEnoughMemory, UsageError
from baarda.hypotheses import run
from baarda.hypotheses.base import Estimates, Evidence, TestResult
from baarda.hypotheses.levels import Options
from baarda.network import AXES, CHECK, EXTERIOR, Network, State
from baarda.observations import CorrelatedPoints, Direct
from baarda.procedures.planning import Planned, plan, with_values

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

BATCH = 4  # replicas that one task computes; fixed, so that sums do not depend on the number of processes
WEAK = 1e-3  # share of an observation's error that must show in its residual for the proof of its detectable bias
_APRIORI = ("outliers", "parameters", "check_points", "control_points")  # also judged with the given variance factor


@dataclass(frozen=True)
class Batch:
    """What some replicas yield.

    Attributes
    ----------
    failed : tuple of str
        Why replicas have no result.
    vpv : (k,) array
    sums, squares : (u,) arrays
        Of the standardised errors of the unknowns, over the replicas.
    groups : (k, g) array
        Mean square of the standardised errors of each group of unknowns.
    residuals : (n,) array
        Sum over the replicas of v^2 / qvv; NaN where qvv is zero.
    names : tuple of str
        Tests.
    levels : tuple of float
        Level of each test.
    tested, rejected : (k, t) arrays
        Numbers of members of each test, and of those rejected.
    biased : (k, 3) array
        Row that got a bias, whether w detects it, and whether it is the largest |w|; NaN where none was added.
    """

    failed: tuple[str, ...]
    vpv: Floats
    sums: Floats
    squares: Floats
    groups: Floats
    residuals: Floats
    names: tuple[str, ...]
    levels: tuple[float, ...]
    tested: Floats
    rejected: Floats
    biased: Floats


@dataclass(frozen=True)
class Replicas:
    """All replicas of a planned network.

    Attributes
    ----------
    planned : Planned
    asked : int
        Number of replicas asked for.
    seed : int
    batch : Batch
        All of them together.
    group_names : tuple of str
        Groups of unknowns.
    group_counts : (g,) int array
        Unknowns of each group.
    sigmas : (u,) array
        Predicted a-priori standard deviations of the unknowns; image angles are increments about the camera axes (radians).
    """

    planned: Planned
    asked: int
    seed: int
    batch: Batch
    group_names: tuple[str, ...]
    group_counts: Ints
    sigmas: Floats

    @property
    def count(self) -> int:
        """Number of replicas with a result."""
        return len(self.batch.vpv)


class Experiment:
    """A planned network made ready for replicas: errors in, one batch of outcomes out.

    Parameters
    ----------
    planned : Planned
    settings : mapping
        Of the adjustment.
    seed : int
    """

    def __init__(self, planned: Planned, settings: dict[str, Any], seed: int) -> None:
        a = planned.adjustment
        self.planned, self.settings, self.seed = planned, settings, seed
        self.state = State.of(a.network)
        self.values = [g.observed() for g in a.groups]
        self.variances = variances_of(a)
        self.kinds, self.names = groups_of(a)
        alpha = planned.options.alpha
        fewest = round(1.0 / alpha) - 1 if alpha > 1e-3 else 999  # so many simulated values keep the level exactly
        self.options = replace(planned.options, replicas=max(fewest, 19), levels="none")
        self.candidates = np.flatnonzero(a.controlled_share >= WEAK)

    def errors(self, rng: np.random.Generator) -> Floats:
        """Draw errors of all n observations, each in its unit, with their a-priori covariances."""
        a = self.planned.adjustment
        z, e = rng.standard_normal(a.count), np.empty(a.count)
        for c in a.lin.chunks:
            e[c.rows] = (c.factor @ z[c.rows][:, :, None])[:, :, 0]
        return e

    def network(self, errors: Floats, rng: np.random.Generator) -> Network:
        """Return the true network with errors in its observations, directly observed values and check references."""
        a = self.planned.adjustment
        net = a.network
        cameras = [np.array(c.prior) for c in net.cameras]
        exterior, given = np.array(net.images.given), np.array(net.points.given)
        declared = {d.kind: d for d in net.declared}
        groups = []
        for g, group in enumerate(a.groups):
            e = errors[a.offsets[g] : a.offsets[g + 1]].reshape(len(group), -1)
            if isinstance(group, CorrelatedPoints):
                given[group.nodes] += e
            elif isinstance(group, Direct) and group.kind == "camera":
                for node, k, value in zip(group.nodes, group.positions, e[:, 0], strict=True):
                    cameras[node][k] += value
            elif isinstance(group, Direct) and group.kind in declared:
                d = declared[group.kind]
                value = np.array(d.given)
                value[d.offsets[group.nodes] + group.positions] += e[:, 0]
                declared[group.kind] = replace(d, given=value)
            elif isinstance(group, Direct):
                table = exterior if group.kind == "image" else given
                table[group.nodes, group.positions] += e[:, 0]
            else:
                groups.append(with_values(group, self.values[g] + e))
        at = np.flatnonzero(net.points.roles == CHECK)
        if len(at):
            covariance = np.nan_to_num(net.points.covariance(at))
            value, vectors = np.linalg.eigh(covariance)
            root = vectors * np.sqrt(np.maximum(value, 0.0))[:, None, :]  # exact coordinates have variance zero
            given[at] += (root @ rng.standard_normal((len(at), 3, 1)))[:, :, 0]
        return replace(
            net,
            cameras=tuple(replace(c, given=v) for c, v in zip(net.cameras, cameras, strict=True)),
            images=replace(net.images, given=exterior),
            points=replace(net.points, given=given),
            observations=tuple(groups),
            declared=tuple(declared.values()),
        )

    def batch(self, first: int, stop: int) -> Batch:
        """Compute the replicas first, ..., stop - 1."""
        with threadpool_limits(limits=1, user_api="blas"):  # many small matrices: threads would wait for each other
            return self._batch(first, stop)

    def _batch(self, first: int, stop: int) -> Batch:
        failed: list[str] = []
        vpv, means, tested, rejected, biased = [], [], [], [], []
        names: tuple[str, ...] = ()
        levels: tuple[float, ...] = ()
        a = self.planned.adjustment
        sums, squares, residuals = np.zeros(len(self.variances)), np.zeros(len(self.variances)), np.zeros(a.count)
        controlled = self.planned.controlled
        for k in range(first, stop):
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(k,)))
            errors = self.errors(rng)
            reference = int(rng.integers(2**31))
            try:
                result = self._adjusted(errors, reference)
                found = self._tests(result, k)
                detection = self._detection(errors, reference, rng)
            except BaardaError as error:
                failed.append(f"replica {k + 1}: {error}")
                continue
            z = errors_of(self.state, result) / np.sqrt(self.variances)
            sums, squares = sums + z, squares + z**2
            means.append([float((z[self.kinds == i] ** 2).mean()) for i in range(len(self.names))])
            with np.errstate(divide="ignore", invalid="ignore"):
                residuals += np.where(controlled, result.residuals**2 / a.qvv, np.nan)
            vpv.append(result.objective)
            names, levels = tuple(name for name, _ in found), tuple(t.alpha for _, t in found)
            p = [np.atleast_1d(np.asarray(t.p_value, dtype=float)) for _, t in found]
            tested.append([float(np.isfinite(x).sum()) for x in p])
            rejected.append([float(np.sum(t.rejected)) for _, t in found])
            biased.append(detection)
        width, groups = len(names), len(self.names)
        return Batch(
            tuple(failed),
            np.array(vpv),
            sums,
            squares,
            np.array(means, dtype=float).reshape(-1, groups),
            residuals,
            names,
            levels,
            np.array(tested, dtype=float).reshape(-1, width),
            np.array(rejected, dtype=float).reshape(-1, width),
            np.array(biased, dtype=float).reshape(-1, 3),
        )

    def _adjusted(self, errors: Floats, reference: int) -> Adjustment:
        result = adjust(self.network(errors, np.random.default_rng(reference)), **self.settings)
        if result.status != "converged":
            raise UsageError(f"not converged after {len(result.history) - 1} iterations")
        return result

    def _tests(self, result: Adjustment, k: int) -> list[tuple[str, TestResult]]:
        return judged(self._against_truth(result.evidence), replace(self.options, seed=k))

    def _against_truth(self, evidence: Evidence) -> Evidence:
        """Let the tests of parameters ask for the true values instead of zero: that hypothesis is true."""
        truth = self.planned.adjustment.evidence

        def shifted(e: Estimates | None, t: Estimates | None) -> Estimates | None:
            return None if e is None or t is None else replace(e, values=e.values - t.values)

        return replace(
            evidence, additional=shifted(evidence.additional, truth.additional), interior=shifted(evidence.interior, truth.interior)
        )

    def _detection(self, errors: Floats, reference: int, rng: np.random.Generator) -> tuple[float, float, float]:
        """Add a minimal detectable bias to one observation drawn at random and look whether w finds it."""
        if not len(self.candidates):
            return np.nan, np.nan, np.nan
        row = int(rng.choice(self.candidates))
        changed = errors.copy()
        changed[row] += float(rng.choice([-1.0, 1.0])) * self.planned.mdb[row]
        e = self._adjusted(changed, reference).evidence
        from scipy import stats

        seen = self.planned.controlled
        w = np.where(seen, np.abs(np.asarray(e.pv)) / np.sqrt(np.where(seen, np.asarray(e.pqvvp), 1.0)), -np.inf)
        limit = float(stats.norm.isf(self.options.alpha_outlier / 2.0))
        return float(row), float(w[row] > limit), float(w[row] == w.max())


def judged(evidence: Evidence, options: Options) -> list[tuple[str, TestResult]]:
    """Run all tests, and those of observations, parameters and points also with the given variance factor.

    Parameters
    ----------
    evidence : Evidence
    options : Options

    Returns
    -------
    list of (str, TestResult)
        Names; those of the second kind end with "(a priori)".
    """
    from importlib import import_module

    found: dict[str, TestResult] = {}
    for t in run(evidence, replace(options, sigma="aposteriori")):
        found.setdefault(t.name, t)
    for name in _APRIORI:
        member = import_module(f"baarda.hypotheses.{name}")
        for t in member.from_evidence(evidence, replace(options, sigma="apriori")):
            found.setdefault(f"{t.name} (a priori)", t)
    return list(found.items())


def variances_of(a: Adjustment) -> Floats:
    """Return the a-priori variances of all unknowns, (u,); image angles are increments about the camera axes."""
    out = np.empty(a.numbering.count)
    for kind, width in (("image", 6), ("point", 3)):
        columns = a.numbering[kind].columns.reshape(-1, width)
        used = columns >= 0
        out[columns[used]] = np.einsum("nii->ni", a.cofactors.blocks(columns))[used]
    for group in a.numbering.groups:
        columns = group.columns[group.columns >= 0]
        if group.kind not in ("image", "point") and len(columns):
            out[columns] = np.diag(a.cofactors.of(columns))
    return out


def errors_of(truth: State, result: Adjustment) -> Floats:
    """Return adjusted minus true unknowns, (u,); for image angles the increments about the camera axes that lead from true to adjusted."""
    return State.of(result.network).departure(result.numbering, truth)


def groups_of(a: Adjustment) -> tuple[Ints, tuple[str, ...]]:
    """Return for each unknown its group, and the names of the groups: each camera parameter, each orientation and coordinate component."""
    names: dict[str, int] = {}
    out = np.empty(a.numbering.count, dtype=np.intp)
    for group in a.numbering.groups:
        if group.kind in ("image", "point"):
            continue
        for i, label in enumerate(group.labels):
            for k, parameter in enumerate(group.parameters_of(i)):
                column = group.columns[group.offsets[i] + k]
                if column >= 0:
                    name = f"{group.kind} {label}: {parameter}" if len(group.labels) <= 10 else f"{group.kind}s: {parameter}"
                    out[column] = names.setdefault(name, len(names))
    for kind, components in (("image", EXTERIOR), ("point", AXES)):
        columns = a.numbering[kind].columns.reshape(-1, len(components))
        for k, component in enumerate(components):
            used = columns[:, k] >= 0
            if used.any():
                told = component if kind == "point" or k < 3 else f"angle about camera {AXES[k - 3].lower()}"
                out[columns[used, k]] = names.setdefault(f"{kind}s: {told}", len(names))
    return out, tuple(names)


def simulate(
    planned: Planned,
    replicas: int,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[int], None] | None = None,
    **settings: Any,
) -> Replicas:
    """Adjust and test replicas of a planned network.

    Parameters
    ----------
    planned : Planned
    replicas : int
        At least 2.
    seed : int
        Replica k uses child k.
    jobs : int
        Number of processes; the outcome does not depend on it.
    progress : callable, optional
        Is told the number of replicas done.
    **settings
        Of the adjustment, those of the prediction.

    Returns
    -------
    Replicas

    Raises
    ------
    UsageError
        If numbers make no sense, or no replica could be adjusted.

    Examples
    --------
    >>> from baarda.procedures.synthetic import ring
    >>> made = simulate(plan(ring(4, points=10).network), 4, seed=1)
    >>> made.count
    4
    """
    if replicas < 2:
        raise UsageError(f"a simulation needs at least 2 replicas, not {replicas}")
    if jobs < 1:
        raise UsageError(f"the number of jobs must be positive, not {jobs}")
    if seed < 0:
        raise UsageError(f"the seed must not be negative, not {seed}")
    pieces = [(k, min(k + BATCH, replicas)) for k in range(0, replicas, BATCH)]
    experiment = Experiment(planned, settings, seed)
    batches = []
    for piece, made in zip(pieces, _computed(experiment, pieces, jobs), strict=True):
        batches.append(made)
        if progress is not None:
            progress(piece[1])
    whole = _joined(batches)
    if not len(whole.vpv):
        raise UsageError(f"no replica could be adjusted; {whole.failed[0]}")
    counts = np.bincount(experiment.kinds, minlength=len(experiment.names))
    return Replicas(planned, replicas, seed, whole, experiment.names, counts, np.sqrt(experiment.variances))


def _computed(experiment: Experiment, pieces: Sequence[tuple[int, int]], jobs: int) -> Iterator[Batch]:
    """Yield the batches in order."""
    if jobs == 1 or len(pieces) == 1:
        for first, stop in pieces:
            yield experiment.batch(first, stop)
        return
    # Processes get the network as a project, which reads back exactly; camera models are code and are not sent.
    from baarda.formats.project import write

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network"
        write(experiment.planned.adjustment.network, path)
        arguments = (str(path), experiment.settings, experiment.planned.options, experiment.seed)
        workers = min(jobs, len(pieces))
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin, initargs=arguments) as pool:
            try:
                yield from pool.map(_piece, pieces)
            except BrokenProcessPool:
                raise NotEnoughMemory(
                    "a process that computes replicas was lost, most likely for want of memory; take fewer --jobs"
                ) from None
            finally:
                pool.shutdown(wait=False, cancel_futures=True)  # after an interruption nothing more is begun


_READY: list[Experiment] = []


def _begin(path: str, settings: dict[str, Any], options: Options, seed: int) -> None:
    from baarda.executors import end_with_parent
    from baarda.formats import read

    end_with_parent()
    network = read(path)
    _READY.append(Experiment(plan(network, options, "start", **settings), settings, seed))


def _piece(piece: tuple[int, int]) -> Batch:
    return _READY[0].batch(*piece)


def _joined(batches: Sequence[Batch]) -> Batch:
    done = [b for b in batches if len(b.vpv)] or list(batches[:1])
    names = done[0].names
    if any(b.names != names for b in done):
        raise UsageError("the replicas allow different tests; the network is at the edge of what can be tested")
    return Batch(
        tuple(text for b in batches for text in b.failed),
        np.concatenate([b.vpv for b in done]),
        np.sum([b.sums for b in done], axis=0),
        np.sum([b.squares for b in done], axis=0),
        np.concatenate([b.groups for b in done]),
        np.sum([b.residuals for b in done], axis=0),
        names,
        done[0].levels,
        np.concatenate([b.tested for b in done]),
        np.concatenate([b.rejected for b in done]),
        np.concatenate([b.biased for b in done]),
    )


__all__ = ["Batch", "Experiment", "Replicas", "errors_of", "groups_of", "judged", "simulate", "variances_of"]
