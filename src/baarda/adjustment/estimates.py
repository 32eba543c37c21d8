"""Estimates that tests ask for, with their joint cofactors: camera parameters, differences at check points, residuals of control."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from baarda.hypotheses.base import Estimates
from baarda.network import AXES
from baarda.observations import CorrelatedPoints, Direct

if TYPE_CHECKING:
    from baarda.adjustment.result import Adjustment


def of_cameras(a: Adjustment, additional_only: bool) -> Estimates:
    """Return the estimated camera parameters, or the additional ones of them, with their joint cofactors."""
    group = a.numbering["camera"]
    names, values, columns, labels = [], [], [], []
    for i, camera in enumerate(a.network.cameras):
        for k, name in enumerate(camera.model.order):
            column = group.columns[group.offsets[i] + k]
            if column >= 0 and (camera.model.additional[k] or not additional_only):
                names.append(f"camera {camera.label}: {name}")
                values.append(camera.values[k])
                columns.append(column)
                labels.append(camera.label)
    at = np.array(columns, dtype=np.intp)
    q = a.cofactors.of(at) if len(at) else np.zeros((0, 0))
    return Estimates(tuple(names), np.array(values, dtype=float), 0.5 * (q + q.T), None, tuple(labels))


def camera_correlations(a: Adjustment, limit: float) -> list[tuple[str, str, float]]:
    """Return the pairs of unknowns with a camera parameter whose correlation reaches the limit, the highest first."""
    e, group = a.camera_estimates, a.numbering["image"]
    if not e.names:
        return []
    columns = np.array([a.numbering.column(name) for name in e.names], dtype=np.intp)
    at = group.columns.reshape(-1, 6)
    images = at[at >= 0]
    variances = np.einsum("nii->ni", a.cofactors.blocks(at))[at >= 0]
    others = np.concatenate([columns, images])
    q = a.cofactors.of(others, columns)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = q / np.sqrt(np.outer(np.concatenate([np.diag(e.cofactors), variances]), np.diag(e.cofactors)))
    r[: len(columns)] = np.tril(r[: len(columns)], -1)
    rows, which = np.nonzero(np.abs(r) >= limit)
    found = [(e.names[j], a.numbering.names[others[i]], float(r[i, j])) for i, j in zip(rows, which, strict=True)]
    return sorted(found, key=lambda pair: -abs(pair[2]))


def removable(a: Adjustment) -> Estimates:
    """Return additional camera parameters, and what declared groups call removable, with their joint cofactors."""
    cameras = of_cameras(a, additional_only=True)
    names, values, labels = list(cameras.names), cameras.values.tolist(), list(cameras.groups)
    for d in a.network.declared:
        removable, columns = d.removable(), a.numbering[d.kind].columns
        for node, label in enumerate(d.labels):
            for k, name in enumerate(d.parameters_of(node), int(d.offsets[node])):
                if removable[k] and columns[k] >= 0:
                    names.append(f"{d.kind} {label}: {name}")
                    values.append(float(d.values[k]))
                    labels.append(label)
    if len(names) == len(cameras.names):
        return cameras
    q = a.cofactors.of(np.array([a.numbering.column(name) for name in names], dtype=np.intp))
    return Estimates(tuple(names), np.array(values), 0.5 * (q + q.T), None, tuple(labels))


def of_check_points(a: Adjustment) -> Estimates | None:
    """Return adjusted less given coordinates of the check points, with both cofactors; None without check points."""
    points = a.network.points
    rows, axes = np.nonzero(a.judges[:, None] & np.isfinite(points.given))
    if not len(rows):
        return None
    q = a.cofactors.of(a.numbering["point"].columns.reshape(-1, 3)[rows, axes])
    covariance = points.covariance(np.arange(len(points.labels)))
    same = rows[:, None] == rows[None, :]
    reference = np.where(same, np.nan_to_num(covariance[rows[:, None], axes[:, None], axes[None, :]]), 0.0)
    return Estimates(
        tuple(f"point {points.labels[i]}: {AXES[k]}" for i, k in zip(rows, axes, strict=True)),
        points.coordinates[rows, axes] - points.given[rows, axes],
        0.5 * (q + q.T),
        reference,
        tuple(points.labels[i] for i in rows),
    )


def of_control(a: Adjustment) -> Estimates | None:
    """Return the residuals of observed control coordinates, with their cofactors; None where there are none."""
    columns, names, labels, rows, cofactors = [], [], [], [], []
    numbering = a.numbering["point"].columns.reshape(-1, 3)
    for g, group in enumerate(a.groups):
        if isinstance(group, Direct) and group.kind == "point":
            nodes, axes = group.nodes, group.positions
            cofactors.append(np.diag(group.sigmas**2))
        elif isinstance(group, CorrelatedPoints):
            nodes, axes = np.repeat(group.nodes, 3), np.tile(np.arange(3), len(group))
            q = np.zeros((3 * len(group), 3 * len(group)))
            for i, c in enumerate(group.covariances):
                q[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = c
            cofactors.append(q)
        else:
            continue
        columns.append(numbering[nodes, axes])
        labels += [a.network.points.labels[i] for i in nodes]
        names += [f"point {a.network.points.labels[i]}: {AXES[k]}" for i, k in zip(nodes, axes, strict=True)]
        rows.append(np.arange(a.offsets[g], a.offsets[g + 1]))
    if not columns:
        return None
    prior = block_diag(*cofactors)
    q = prior - a.cofactors.of(np.concatenate(columns))
    return Estimates(tuple(names), a.residuals[np.concatenate(rows)], 0.5 * (q + q.T), prior, tuple(labels))
