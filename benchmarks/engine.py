"""Adjustment and exact statistics of image blocks beside pycolmap, ceres::Covariance and GTSAM, in one run.

    python benchmarks/engine.py [--sizes 20,100,500,2000] [--rounds 3] [--parts PART,...] [--large] [--out FILE]

Every round runs each task once, one after the other, so that all of them meet the same disturbances; times are medians, ratios are medians
of ratios within a round. Memory is measured in a process of its own for each task. Peers come from the extra `oracle`; those that are not
installed are left out. Nothing here is run by pytest.
"""

from __future__ import annotations

import argparse
import gc
import importlib.metadata
import importlib.util
import json
import logging
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import baarda
from baarda.adjustment.block import BlockSolver
from baarda.adjustment.linearize import Arrangement, linearize
from baarda.adjustment.point_order import rank_of_points
from baarda.adjustment.structure import analyse
from baarda.cameras import FIXED
from baarda.hypotheses.outliers import mdb, standardised, tau
from baarda.network import CONTROL, Network, State
from baarda.procedures.synthetic import synthetic

PARTS = ("adjustment", "statistics", "agreement", "pairs", "growth", "memory", "kinds", "starts")
MARGINALS = 30_000  # image points up to which GTSAM is asked for marginals
ALL_PAIRS = 30_000  # image points up to which ceres::Covariance is asked for all pairs of blocks
DENSE_PEER = 1100  # images up to which the dense inverse of pycolmap's covariance is reasonable in memory and time: 2000 with --large
FLIP = np.diag([1.0, -1.0, -1.0])  # photogrammetric camera axes to those of computer vision


def have(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


def block(kind: str, images: int, **options: Any) -> Network:
    """Return a block whose control points are held fixed, so that all programs solve the same problem."""
    return synthetic(kind, images, **{"seed": 1, "control_sigma": 0.0, **options}).network


# ---- this package ----
def adjust(network: Network, **options: Any) -> Any:
    """Adjust with a standard deviation of one pixel for all, as the peers weight."""
    return baarda.adjust(network, image_sigma=1.0, solver="block", **options)


def statistics(result: Any, afresh: bool = False) -> Any:
    """Compute all statistics from the linear system: factor, selected inverse, redundancy numbers, sigmas, w, tau, MDB.

    With `afresh` the Jacobians and the pattern are computed again as well: what pycolmap's covariance does too.
    """
    lin, structure = result.lin, result.solver.structure
    with threadpool_limits(limits=1, user_api="blas"):
        if afresh:
            network = result.network.shifted(result.shift)
            state, rank = State.of(network), rank_of_points(result.start.shifted(result.shift).points.coordinates)
            lin = linearize(network, state, result.numbering, Arrangement.of(result.groups, rank, network))
            structure = analyse(lin, rank, state.points)
        solver = BlockSolver.of(lin, structure, result.datum.held)
    return numbers(replace(result, lin=lin, solver=solver))


def numbers(found: Any) -> Any:
    """Compute all statistics with the factor of an adjustment."""
    r, v, qvv = found.redundancy_numbers, found.residuals, found.qvv
    for name in ("image_cofactors", "point_cofactors", "camera_estimates"):
        getattr(found, name)
    standardised(v, qvv)
    tau(v, qvv, found.variance_factor)
    mdb(found.sigmas**2, r)
    return found


# ---- pycolmap ----
class Colmap:
    """The same problem for pycolmap."""

    def __init__(self, network: Network) -> None:
        import pycolmap

        self.network = network
        self.rec = rec = pycolmap.Reconstruction()
        for i, c in enumerate(network.cameras):
            width, height = (int(s) for s in c.image_size or (1.0, 1.0))
            camera = pycolmap.Camera(model=c.model.name, width=width, height=height, params=c.values, camera_id=i + 1)
            rec.add_camera_with_trivial_rig(camera)
        group = network.observations[0]
        order = np.argsort(group.images, kind="stable")
        first = np.searchsorted(group.images[order], np.arange(len(network.images.labels) + 1))
        place = np.empty(len(group), dtype=np.intp)
        for i, label in enumerate(network.images.labels):
            own = order[first[i] : first[i + 1]]
            place[own] = np.arange(len(own))
            image = pycolmap.Image(label, group.xy[own], int(network.images.cameras[i]) + 1, i + 1)
            rotation = FLIP @ network.images.rotation[i]
            pose = pycolmap.Rigid3d(np.column_stack([rotation, -rotation @ network.images.position[i]]))
            rec.add_image_with_trivial_frame(image, pose)
        order = np.argsort(group.points, kind="stable")
        first = np.searchsorted(group.points[order], np.arange(len(network.points.labels) + 1))
        for j, x in enumerate(network.points.coordinates):
            rows = order[first[j] : first[j + 1]]
            track = pycolmap.Track([pycolmap.TrackElement(int(group.images[k]) + 1, int(place[k])) for k in rows])
            rec.add_point3D_with_id(j + 1, pycolmap.Point3D(xyz=x, track=track))
            for k in rows:
                rec.image(int(group.images[k]) + 1).set_point3D_for_point2D(int(place[k]), j + 1)
        self.config = pycolmap.BundleAdjustmentConfig()
        for i in range(len(network.images.labels)):
            self.config.add_image(i + 1)
        for j in np.flatnonzero((network.points.roles == CONTROL) & (network.points.states == FIXED).all(axis=1)):
            self.config.add_constant_point(int(j) + 1)
        self.options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=False)
        self.options.refine_focal_length = self.options.refine_extra_params = True
        ceres = self.options.ceres
        ceres.auto_select_solver_type = False
        solver = ceres.solver_options
        solver.linear_solver_type = type(solver.linear_solver_type).SPARSE_SCHUR
        solver.function_tolerance = solver.parameter_tolerance = solver.gradient_tolerance = 1e-10
        solver.max_num_iterations = 200
        solver.num_threads = threads()
        self.adjuster: Any = None

    def adjust(self) -> int:
        """Adjust; return the number of iterations."""
        import pycolmap

        self.adjuster = pycolmap.create_default_ceres_bundle_adjuster(self.options, self.config, self.rec)
        summary = self.adjuster.solve()
        return int(summary.ceres_summary.num_successful_steps + summary.ceres_summary.num_unsuccessful_steps)

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals, by our own projection of the adjusted values."""
        n = self.network
        matrices = np.array([self.rec.image(i + 1).cam_from_world().matrix() for i in range(len(n.images.labels))])
        rotation = FLIP @ matrices[:, :, :3]
        position = -np.einsum("nji,nj->ni", matrices[:, :, :3], matrices[:, :, 3])
        points = np.array([self.rec.point3D(j + 1).xyz for j in range(len(n.points.labels))])
        cameras = tuple(np.array(self.rec.camera(i + 1).params) for i in range(len(n.cameras)))
        state = State(cameras, position, rotation, points)
        return 0.5 * float((n.observations[0].misclosures(n, state) ** 2).sum())

    def covariance(self) -> dict[str, Any]:
        """Return covariances of images, cameras, and points *given the images*, which is what pycolmap offers."""
        import pycolmap

        found = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), self.rec, self.adjuster)
        if found is None:
            raise RuntimeError("pycolmap found no covariance")
        images = [found.get_cam_cov_from_world(i + 1) for i in range(len(self.network.images.labels))]
        points = [found.get_point_cov(j + 1) for j in range(len(self.network.points.labels))]
        cameras = [found.get_other_params_cov(self.rec.camera(i + 1).params) for i in range(len(self.network.cameras))]
        return {"images": images, "points": points, "cameras": cameras}

    def all_pairs(self) -> int:
        """Ask ceres::Covariance for every block that the redundancy numbers need; return how many."""
        import pyceres

        group = self.network.observations[0]
        cameras = [self.rec.camera(i + 1).params for i in range(len(self.network.cameras))]
        images = [self.rec.frame(self.rec.image(i + 1).frame_id).rig_from_world.params for i in range(len(self.network.images.labels))]
        points = [self.rec.point3D(j + 1).xyz for j in range(len(self.network.points.labels))]
        free = ~(self.network.points.states == FIXED).all(axis=1)
        camera = self.network.images.cameras
        pairs = [(c, c) for c in cameras] + [(p, p) for p in images] + [(cameras[camera[i]], p) for i, p in enumerate(images)]
        pairs += [(points[j], points[j]) for j in np.flatnonzero(free)]
        pairs += [(images[i], points[j]) for i, j in zip(group.images, group.points, strict=True) if free[j]]
        met = {(int(camera[i]), int(j)) for i, j in zip(group.images, group.points, strict=True) if free[j]}
        pairs += [(cameras[c], points[j]) for c, j in sorted(met)]
        options = pyceres.CovarianceOptions()
        options.num_threads = threads()
        covariance = pyceres.Covariance(options)
        problem = self.adjuster.problem
        if not covariance.compute(pairs, problem):
            raise RuntimeError("ceres::Covariance failed")
        for a, b in pairs:
            covariance.get_covariance_block_tangent_space(a, b, problem)
        return len(pairs)


# ---- GTSAM ----
def marginals(result: Any) -> tuple[float, np.ndarray]:
    """Return GTSAM's seconds for the marginal covariances of all points of an adjusted block with one camera, and these covariances."""
    import gtsam

    n, group = result.network, result.network.observations[0]
    camera, noise = n.cameras[0], gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    f, x0, y0, k1, k2 = camera.values
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    calibration, image, point = gtsam.symbol("k", 0), lambda i: gtsam.symbol("x", int(i)), lambda j: gtsam.symbol("p", int(j))
    values.insert(calibration, gtsam.Cal3Bundler(f, k1, k2, x0, y0))
    for i, (x, m) in enumerate(zip(n.images.position, n.images.rotation, strict=True)):
        values.insert(image(i), gtsam.Pose3(gtsam.Rot3((FLIP @ m).T), x))
    for j, x in enumerate(n.points.coordinates):
        values.insert(point(j), x)
    for i, j, xy in zip(group.images, group.points, group.xy, strict=True):
        graph.add(gtsam.GeneralSFMFactor2Cal3Bundler(xy, noise, image(i), point(j), calibration))
    fixed = (n.points.states == FIXED).all(axis=1)
    for j in np.flatnonzero(fixed):
        graph.add(gtsam.PriorFactorPoint3(point(j), n.points.coordinates[j], gtsam.noiseModel.Isotropic.Sigma(3, 1e-7)))
    start = time.perf_counter()
    found = gtsam.Marginals(graph, values)
    covariances = np.array([found.marginalCovariance(point(j)) for j in range(len(fixed))])
    return time.perf_counter() - start, covariances


# ---- measuring ----
def threads() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def load() -> str:
    return " ".join(f"{v:.1f}" for v in os.getloadavg()) if hasattr(os, "getloadavg") else "unknown"


class Paper:
    """Markdown, printed as it comes."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, line: str = "") -> None:
        print(line, flush=True)
        self.lines.append(line)

    def table(self, *head: str) -> None:
        self.say("| " + " | ".join(head) + " |")
        self.say("|" + "---|" * len(head))

    def row(self, *cells: Any) -> None:
        self.say("| " + " | ".join(c if isinstance(c, str) else f"{c:.4g}" for c in cells) + " |")


def timed(task: Callable[[], Any]) -> tuple[float, float, Any]:
    gc.collect()
    processor, start = time.process_time(), time.perf_counter()
    value = task()
    return time.perf_counter() - start, time.process_time() - processor, value


def middle(values: Any) -> float:
    return float(np.median(values)) if len(values) else float("nan")


@contextmanager
def compiled_loops() -> Iterator[None]:
    """Compiled loops whatever the size."""
    from baarda.adjustment import cluster_loops, kernels, vector_loops
    from baarda.observations import kernels as image_kernels

    kept = [(m, m.COMPILE_FROM) for m in (cluster_loops, kernels, vector_loops, image_kernels)]
    for module, _ in kept:
        module.COMPILE_FROM = 0
    try:
        yield
    finally:
        for module, size in kept:
            module.COMPILE_FROM = size


def warm() -> None:
    """Compile every loop before anything is timed."""
    with compiled_loops():
        statistics(adjust(block("aerial", 9, points=200)), afresh=True)


def describe(network: Network) -> tuple[int, int, int, float]:
    n = len(network.observations[0])
    points = len(network.points.labels)
    return len(network.images.labels), points, n, n / points


# ---- parts ----
def compare_blocks(paper: Paper, sizes: list[int], rounds: int, parts: list[str], large: bool) -> None:
    """Adjust and compute statistics at each size, both programs by turns."""
    rows: dict[str, list[tuple[Any, ...]]] = {"adjustment": [], "statistics": []}
    for size in sizes:
        network = block("aerial", size)
        images, points, n, _ = describe(network)
        peer = Colmap(network) if have("pycolmap") else None
        ours: dict[str, list[float]] = {"adjust": [], "adjust cpu": [], "statistics": [], "afresh": [], "cpu": []}
        theirs: dict[str, list[float]] = {"adjust": [], "adjust cpu": [], "covariance": [], "cpu": []}
        costs, iterations, result = [0.0, float("nan")], [0, 0], None
        for _ in range(rounds):
            wall, cpu, result = timed(lambda network=network: adjust(network))
            ours["adjust"].append(wall)
            ours["adjust cpu"].append(cpu)
            iterations[0], costs[0] = len(result.history) - 1, 0.5 * result.objective
            if peer is not None and "adjustment" in parts:
                peer = Colmap(network)
                wall, cpu, iterations[1] = timed(peer.adjust)
                theirs["adjust"].append(wall)
                theirs["adjust cpu"].append(cpu)
                costs[1] = peer.cost
            elif peer is not None and peer.adjuster is None:
                peer.adjust()
            if "statistics" in parts:
                wall, cpu, found = timed(lambda result=result: statistics(result))
                ours["statistics"].append(wall)
                ours["cpu"].append(cpu)
                wall, cpu, _ = timed(lambda result=result: statistics(result, afresh=True))
                ours["afresh"].append(wall)
                share = abs(float(found.redundancy_numbers.sum()) / found.redundancy - 1.0)
                if peer is not None and (size <= DENSE_PEER or large or size == 2000):
                    wall, cpu, _ = timed(peer.covariance)
                    theirs["covariance"].append(wall)
                    theirs["cpu"].append(cpu)
        ratio = middle(np.array(theirs["adjust"]) / np.array(ours["adjust"])) if theirs["adjust"] else float("nan")
        label = f"{images} images, {points} points, {n} image points"
        rows["adjustment"].append(
            (label, middle(ours["adjust"]), f"{iterations[0]}", middle(theirs["adjust"]), f"{iterations[1]}", ratio,
             middle(ours["adjust cpu"]), middle(theirs["adjust cpu"]), f"{costs[0]:.9g}", f"{abs(costs[1] / costs[0] - 1.0):.1e}")
        )  # fmt: skip
        if "statistics" in parts:
            both = [
                middle(np.array(theirs["covariance"]) / np.array(ours[k])) if theirs["covariance"] else float("nan")
                for k in ("statistics", "afresh")
            ]
            rows["statistics"].append(
                (label, middle(ours["statistics"]), middle(ours["afresh"]), middle(theirs["covariance"]), both[0], both[1],
                 middle(ours["cpu"]), middle(theirs["cpu"]), f"{share:.0e}")
            )  # fmt: skip
    if "adjustment" in parts:
        paper.say("\n### Adjustment to the same cost\n")
        paper.say(
            f"pycolmap: sparse Schur, tolerances 1e-10, {threads()} threads; same problem and start. Building its objects is not counted.\n"
        )
        paper.table(
            "block",
            "ours s",
            "iterations",
            "pycolmap s",
            "iterations",
            "ratio",
            "ours processor s",
            "pycolmap processor s",
            "cost",
            "costs differ by",
        )
        for row in rows["adjustment"]:
            paper.row(*row)
    if "statistics" in parts:
        paper.say("\n### All statistics against pycolmap's covariance\n")
        paper.say(
            "Ours: covariances of images, cameras and points (marginal), redundancy numbers, w, tau and MDB of every observation.\n"
            "pycolmap: covariances of images and cameras, and of points *given* the images; no redundancy numbers. 'afresh' includes\n"
            "Jacobians and pattern.\n"
        )
        paper.table(
            "block", "ours s", "afresh s", "pycolmap s", "ratio", "ratio afresh", "ours processor s", "pycolmap processor s", "sum of r"
        )
        for row in rows["statistics"]:
            paper.row(*row)


def agreement(paper: Paper, size: int) -> None:
    """Compare covariances with the peers' where they are defined alike."""
    paper.say(f"\n### Agreement of covariances, {size} images\n")
    network = block("aerial", size)
    result = adjust(network)
    own = result.scale("apriori") ** 2
    if have("pycolmap"):
        peer = Colmap(network)
        peer.adjust()
        found = peer.covariance()
        # theirs: rotation about the axes of computer vision, translation; ours: position, increments about the photogrammetric axes
        group = result.numbering["image"].columns.reshape(-1, 6)
        q = result.cofactors.blocks(group) * own
        worst = 0.0
        for i, theirs in enumerate(found["images"]):
            r = FLIP @ result.network.images.rotation[i]
            x = result.network.images.position[i]
            t = np.zeros((6, 6))  # translation = -R X0
            t[:3, 3:] = 0.5 * FLIP  # theirs is half the angle
            t[3:, :3] = -r
            for k in range(3):
                t[3:, 3 + k] = -np.cross(FLIP[:, k], r @ x)
            mine = t @ q[i] @ t.T
            size_of = np.sqrt(np.outer(np.diag(mine), np.diag(mine)))
            worst = max(worst, float(np.abs((mine - theirs) / size_of).max()))
        paper.say(f"- images, all 6 x 6 elements against pycolmap: relative difference at most {worst:.1e}")
        columns = result.numbering["camera"].columns
        mine = result.cofactors.of(columns[columns >= 0]) * own
        theirs = np.asarray(found["cameras"][0])
        theirs = theirs[np.ix_(*(2 * [[k for k in range(len(theirs)) if theirs[k, k] > 0]]))] if len(theirs) != len(mine) else theirs
        paper.say(f"- camera: {np.abs(mine / theirs - 1.0).max():.1e}")
        q = result.point_cofactors * own
        ratio = [np.sqrt(np.trace(c) / np.trace(q[j])) for j, c in enumerate(found["points"]) if c is not None and np.trace(q[j]) > 0]
        paper.say(
            f"- pycolmap's sigmas of points, given the images, are {np.median(ratio):.3f} of the true ones (median; least {min(ratio):.3f})"
        )
    if have("gtsam") and len(network.observations[0]) <= MARGINALS:
        seconds, covariances = marginals(result)
        q = result.point_cofactors * own
        free = np.einsum("nii->n", q) > 0.0
        d = np.sqrt(np.einsum("nii->ni", q[free]))
        worst = float(np.abs((covariances[free] - q[free]) / (d[:, :, None] * d[:, None, :])).max())
        paper.say(f"- points, all 3 x 3 elements against GTSAM's marginals: {worst:.1e} (GTSAM took {seconds:.2f} s for them)")


def pairs(paper: Paper, size: int, rounds: int) -> None:
    """Against ceres::Covariance for the same numbers."""
    network = block("aerial", size)
    if not (have("pycolmap") and have("pyceres")) or len(network.observations[0]) > ALL_PAIRS:
        return
    result, peer = adjust(network), Colmap(network)
    peer.adjust()
    ours, theirs, count = [], [], 0
    for _ in range(rounds):
        ours.append(timed(lambda: statistics(result))[0])
        seconds, _, count = timed(peer.all_pairs)
        theirs.append(seconds)
    paper.say(f"\n### ceres::Covariance for the same numbers, {size} images\n")
    paper.say(f"All {count} blocks that redundancy numbers need, by pyceres; ours is everything, tests and MDB included.\n")
    paper.table("loops", "ours s", "ceres::Covariance s", "ratio")
    paper.row("NumPy, as for all blocks of this size", middle(ours), middle(theirs), middle(np.array(theirs) / np.array(ours)))
    with compiled_loops():
        ours = [timed(lambda: statistics(result))[0] for _ in range(max(rounds, 3))]
    paper.row("compiled", middle(ours), middle(theirs), middle(theirs) / middle(ours))


def growth(paper: Paper, sizes: list[int], rounds: int) -> None:
    """Time of statistics against the number of images."""
    paper.say("\n### Growth of the statistics' time\n")
    paper.table("images", "image points", "statistics s", "afresh s", "us per image point", "exponent from the first")
    first: tuple[int, float] | None = None
    for size in sizes:
        network = block("aerial", size)
        result = adjust(network)
        seconds = middle([timed(lambda result=result: statistics(result))[0] for _ in range(rounds)])
        again = middle([timed(lambda result=result: statistics(result, afresh=True))[0] for _ in range(rounds)])
        first = first or (size, seconds)
        exponent = f"{np.log(seconds / first[1]) / np.log(size / first[0]):.2f}" if size > first[0] else "-"
        n = len(network.observations[0])
        paper.row(f"{size}", f"{n}", seconds, again, seconds / n * 1e6, exponent)


def memory(paper: Paper, sizes: list[int], large: bool) -> None:
    """Peak memory above the input, each task in a process of its own."""
    paper.say("\n### Peak memory above the input\n")
    paper.say(
        "Each in a fresh process, from the moment when the input (network, or pycolmap's objects) is there; compiled code included.\n"
    )
    paper.table(
        "images", "ours: adjust, MB", "ours: adjust and statistics, MB", "pycolmap: adjust, MB", "pycolmap: and covariance, MB", "ratio"
    )
    for size in sizes:
        found = [alone("ours", size, s) for s in ("adjust", "statistics")]
        found += [
            alone("pycolmap", size, s) if have("pycolmap") and (size <= 2000 or large) else float("nan") for s in ("adjust", "statistics")
        ]
        paper.row(f"{size}", *[f"{v:.0f}" for v in found], found[3] / found[1])


def alone(program: str, size: int, what: str) -> float:
    """Return the peak of a child process above its input, MB."""
    command = [sys.executable, __file__, "--child", program, what, str(size)]
    out = subprocess.run(command, capture_output=True, text=True, check=False)
    if out.returncode:
        print(out.stderr[-500:], file=sys.stderr)
        return float("nan")
    return float(json.loads(out.stdout.splitlines()[-1])["megabytes"])


def child(program: str, what: str, size: int) -> None:
    """Measure in this process: the highest resident set after the input is there, less that of the input."""
    network = block("aerial", size)
    peer = Colmap(network) if program == "pycolmap" else None
    gc.collect()
    before = resident()
    reset = reset_peak()
    if peer is not None:
        peer.adjust()
        if what == "statistics":
            peer.covariance()
    else:
        result = adjust(network)
        if what == "statistics":
            numbers(result)
    after = peak(reset)
    print(json.dumps({"megabytes": (after - before) / 1e6, "input": before / 1e6}))


def status(key: str) -> float:
    """Return a figure of /proc/self/status in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return 1024.0 * float(line.split()[1])
    raise RuntimeError(f"no {key}")


def resident() -> float:
    return status("VmRSS")


def reset_peak() -> bool:
    """Let the highest resident set begin anew, where the system allows it."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def peak(reset: bool) -> float:
    if reset:
        return status("VmHWM")
    import resource

    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def kinds(paper: Paper, scale: int, rounds: int) -> None:
    """What other comparisons leave out: long tracks, images that see all, dense camera graphs, a camera per image."""
    paper.say("\n### Other kinds of blocks\n")
    table = {
        "aerial, one camera": ("aerial", scale, {}),
        "aerial, a camera per image": ("aerial", scale, {"per_image_cameras": True}),
        "long tracks (up to all images)": ("long-tracks", scale, {}),
        "close range, every image sees all points": ("ring", scale, {"points": 10 * scale}),
        "dense camera graph": ("dense", scale, {}),
    }
    head = ("block", "images", "image points", "rays a point", "ours: adjust s", "statistics s", "us per image point", "fronts")
    paper.table(*head, "largest front", "pycolmap: adjust s", "covariance s", "ratios", "costs differ by")
    for name, (kind, images, options) in table.items():
        network = block(kind, images, **options)
        one, two, three, four, ratios = [], [], [], [], [[], []]
        cost, result = float("nan"), None
        for _ in range(rounds):
            wall, _, result = timed(lambda network=network: adjust(network))
            one.append(wall)
            two.append(timed(lambda result=result: statistics(result))[0])
            if have("pycolmap"):
                peer = Colmap(network)
                three.append(timed(peer.adjust)[0])
                cost = peer.cost
                four.append(timed(peer.covariance)[0])
                ratios[0].append(three[-1] / one[-1])
                ratios[1].append(four[-1] / two[-1])
        count, _, n, rays = describe(network)
        fronts = result.solver.structure.fronts
        differ = f"{abs(2.0 * cost / result.objective - 1.0):.0e}"
        paper.row(name, f"{count}", f"{n}", f"{rays:.1f}", middle(one), middle(two), middle(two) / n * 1e6, f"{len(fronts)}",
                  f"{max(len(f.columns) for f in fronts)}", middle(three), middle(four),
                  f"{middle(ratios[0]):.1f}, {middle(ratios[1]):.1f}", differ)  # fmt: skip


def starts(paper: Paper, images: int) -> None:
    """Poor starts: cost reached over the least cost, and iterations."""
    paper.say("\n### Poor starts\n")
    paper.say(
        "Start values disturbed by a multiple of the usual errors. Cost reached over the cost reached from the usual start; iterations\n"
        "include rejected steps (at most 200). These small blocks run without compiled loops.\n"
    )
    paper.table("block", "times the usual error", "behind a camera", "ours: cost", "iterations", "s", "pycolmap: cost", "iterations", "s")
    for kind in ("aerial", "ring", "long-tracks", "dense"):
        least = 0.5 * adjust(block(kind, images)).objective
        for size in (1.0, 5.0, 20.0, 50.0):
            network = block(kind, images, perturbation=size)
            group = network.observations[0]
            behind = 1.0 - float(group.in_front(network, State.of(network)).mean())
            try:
                seconds, _, result = timed(lambda network=network: adjust(network, iterations=200))
                own = (f"{0.5 * result.objective / least:.6g}", f"{len(result.history) - 1}", seconds)
            except baarda.errors.BaardaError as error:
                own = (type(error).__name__, "-", float("nan"))
            theirs: tuple[Any, ...] = ("-", "-", float("nan"))
            if have("pycolmap"):
                peer = Colmap(network)
                seconds, _, iterations = timed(peer.adjust)
                theirs = (f"{peer.cost / least:.6g}", f"{iterations}", seconds)
            paper.row(f"{kind} {images}", f"{size:g}", f"{behind:.1%}", *own, *theirs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="20,100,500", help="images of the aerial blocks")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--parts", default=",".join(PARTS), help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--kinds-size", type=int, default=60, help="images of the other kinds of blocks")
    parser.add_argument("--starts-size", type=int, default=20, help="images of the blocks with poor starts")
    parser.add_argument("--large", action="store_true", help="growth up to 8000 images; pycolmap's covariance at every size")
    parser.add_argument("--out", type=Path, help="also write the tables to this file")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    if have("pycolmap"):
        import pycolmap

        pycolmap.logging.minloglevel = 2
    if given.child:
        child(given.child[0], given.child[1], int(given.child[2]))
        return
    sizes, parts = [int(s) for s in given.sizes.split(",")], given.parts.split(",")
    unknown = set(parts) - set(PARTS)
    if unknown:
        parser.error(f"unknown part {sorted(unknown)[0]}; known are {', '.join(PARTS)}")
    paper = Paper()
    paper.say("## Engine\n")
    versions = ", ".join(
        f"{n} {importlib.metadata.version(n)}" for n in ("numpy", "scipy", "numba", "pycolmap", "pyceres", "gtsam") if have(n)
    )
    paper.say(f"{platform.machine()}, {threads()} cores, Python {platform.python_version()}, {versions}.")
    paper.say(f"Median of {given.rounds} rounds; load average at the start {load()}.")
    warm()
    if {"adjustment", "statistics"} & set(parts):
        compare_blocks(paper, sizes, given.rounds, parts, given.large)
    if "agreement" in parts:
        agreement(paper, min(20, sizes[0]))
    if "pairs" in parts:
        pairs(paper, min(20, sizes[0]), min(given.rounds, 3))
    if "growth" in parts:
        growth(paper, [*sizes, 8000] if given.large and 8000 not in sizes else sizes, given.rounds)
    if "memory" in parts:
        memory(paper, sizes, given.large)
    if "kinds" in parts:
        kinds(paper, given.kinds_size, min(given.rounds, 3))
    if "starts" in parts:
        starts(paper, given.starts_size)
    paper.say(f"\nLoad average at the end {load()}.")
    if given.out is not None:
        given.out.write_text("\n".join(paper.lines) + "\n")


if __name__ == "__main__":
    main()
