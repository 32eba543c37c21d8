"""The tables of an adjustment: unknowns, object points, images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import STATES
from baarda.geometry import rotation as rot
from baarda.network import AXES, ROLES, Network, Table
from baarda.observations import ImagePoints

if TYPE_CHECKING:
    from baarda.adjustment.result import Adjustment

Floats = NDArray[np.float64]
Scaling = Literal["apriori", "aposteriori"]


def unknown_table(a: Adjustment, sigma: Scaling) -> Table:
    """Return the table of unknowns with sigmas of either variance factor."""
    s0, numbering, net = a.scale(sigma), a.numbering, a.network
    columns: dict[str, list[Any]] = {k: [] for k in ("name", "group", "unit", "value", "sigma", "initial", "state")}
    order: list[int] = []

    def add(column: int, *row: Any) -> None:
        if column >= 0:
            order.append(column)
            for key, value in zip(columns, row, strict=True):
                columns[key].append(value)

    camera = numbering["camera"]
    q = {n: float(v) for n, v in zip(a.camera_estimates.names, np.diag(a.camera_estimates.cofactors), strict=True)}
    for i, c in enumerate(net.cameras):
        for k, name in enumerate(c.model.order):
            full = f"camera {c.label}: {name}"
            if full in q:
                state = STATES[c.states[k]]
                value = (full, "camera", c.unit_of(k), c.values[k], s0 * np.sqrt(q[full]), a.start.cameras[i].values[k], state)
                add(camera.columns[camera.offsets[i] + k], *value)
    for kind, adjusted, first, states, units, cofactors in (
        ("image", _exterior(net), _exterior(a.start), net.images.states, (net.unit,) * 3 + ("rad",) * 3, a.image_cofactors),
        ("point", net.points.coordinates, a.start.points.coordinates, net.points.states, (net.unit,) * 3, a.point_cofactors),
    ):
        group = numbering[kind]
        at = group.columns.reshape(adjusted.shape)
        deviation = s0 * np.sqrt(np.einsum("nii->ni", cofactors))
        for i, label in enumerate(group.labels):
            names = group.parameters_of(i)
            for k in np.flatnonzero(at[i] >= 0).tolist():
                row = (
                    f"{kind} {label}: {names[k]}",
                    kind,
                    units[k],
                    adjusted[i, k],
                    deviation[i, k],
                    first[i, k],
                    STATES[states[i, k]],
                )
                add(at[i, k], *row)
    for declared, first_values in zip(net.declared, a.start.declared, strict=True):
        group = numbering[declared.kind]
        for width in np.unique(declared.widths).tolist():
            nodes = np.flatnonzero(declared.widths == width)
            at = group.of(nodes, width)
            deviation = s0 * np.sqrt(np.einsum("nii->ni", a.cofactors.blocks(at)))
            values, starts = declared.of(nodes, width), first_values.of(nodes, width)
            for i, node in enumerate(nodes.tolist()):
                for k in np.flatnonzero(at[i] >= 0).tolist():
                    full = f"{declared.kind} {declared.labels[node]}: {group.parameters_of(node)[k]}"
                    unit = declared.unit_of(node, k)
                    state = STATES[declared.states[declared.offsets[node] + k]]
                    add(at[i, k], full, declared.kind, unit, values[i, k], deviation[i, k], starts[i, k], state)
    arrays = {k: np.array(v, dtype=float if k in ("value", "sigma", "initial") else object) for k, v in columns.items()}
    return Table({k: v[np.argsort(order, kind="stable")] for k, v in arrays.items()})


def point_table(a: Adjustment, sigma: Scaling, probability: float = 0.95) -> Table:
    """Return coordinates, sigmas, correlations, rays and the confidence ellipsoid and horizontal ellipse of the points.

    The semi-axes are those of the region that covers the point with `probability`: factors sqrt(k F(k, r)) a posteriori, sqrt(chi2(k))
    a priori, k = 3 for the ellipsoid and 2 for the ellipse; the azimuth of the major axis counts from +Y clockwise, radians.
    """
    from scipy import stats

    s0 = a.scale(sigma)
    points = a.network.points
    use = np.flatnonzero(~a.aside)
    c = s0**2 * a.point_cofactors[use]
    s = np.sqrt(np.einsum("nii->ni", c))
    with np.errstate(divide="ignore", invalid="ignore"):
        r = c / (s[:, :, None] * s[:, None, :])
    rays = np.zeros(len(points.labels), dtype=int)
    for g in a.groups:
        if isinstance(g, ImagePoints):
            rays += np.bincount(g.points, minlength=len(rays))
    factor = [
        np.sqrt(k * stats.f(k, a.redundancy).ppf(probability)) if sigma == "aposteriori" else np.sqrt(stats.chi2(k).ppf(probability))
        for k in (2, 3)
    ]
    axes3 = factor[1] * _roots(np.linalg.eigvalsh(c))[:, ::-1]
    values, vectors = np.linalg.eigh(c[:, :2, :2])
    axes2 = factor[0] * _roots(values)[:, ::-1]
    azimuth = np.mod(np.arctan2(vectors[:, 0, 1], vectors[:, 1, 1]), np.pi)
    columns: dict[str, Any] = {
        "point": np.array(points.labels, dtype=object)[use],
        "role": np.array(ROLES)[points.roles[use]].astype(object),
    }
    columns |= {a: points.coordinates[use, k] for k, a in enumerate(AXES)} | {f"s{a}": s[:, k] for k, a in enumerate(AXES)}
    columns |= {f"corr_{a}{b}": r[:, i, j] for a, b, i, j in (("X", "Y", 0, 1), ("X", "Z", 0, 2), ("Y", "Z", 1, 2))}
    columns["rays"] = rays[use]
    columns |= {f"ellipsoid_{name}": axes3[:, k] for k, name in enumerate("abc")}
    columns |= {"ellipse_a": axes2[:, 0], "ellipse_b": axes2[:, 1], "ellipse_azimuth_rad": azimuth}
    return Table(columns, dict.fromkeys((*AXES, "sX", "sY", "sZ"), a.network.unit))


def image_table(a: Adjustment, sigma: Scaling) -> Table:
    """Return exterior orientation with sigmas, number of points and rms of the residuals of each image."""
    images = a.network.images
    n = len(images.labels)
    values = _exterior(a.network)
    deviation = a.scale(sigma) * np.sqrt(np.einsum("nii->ni", a.image_cofactors))
    count, square = np.zeros(n, dtype=int), np.zeros(n)
    for g, group in enumerate(a.groups):
        if isinstance(group, ImagePoints):
            v = a.residuals[a.offsets[g] : a.offsets[g + 1]].reshape(-1, 2)
            count += np.bincount(group.images, minlength=n)
            square += np.bincount(group.images, weights=(v**2).sum(axis=1), minlength=n)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(square / (2 * count))
    names = ("X0", "Y0", "Z0", "omega_rad", "phi_rad", "kappa_rad")
    columns: dict[str, Any] = {
        "image": np.array(images.labels, dtype=object),
        "camera": np.array([c.label for c in a.network.cameras], dtype=object)[images.cameras],
    }
    columns |= {name: values[:, k] for k, name in enumerate(names)} | {f"s{name}": deviation[:, k] for k, name in enumerate(names)}
    return Table(columns | {"points": count, "rms": rms})


def _roots(values: NDArray[np.floating[Any]]) -> Floats:
    """Return square roots of ascending eigenvalues; rounding about zero is zero, a truly negative one stays visible as NaN."""
    rounding = np.abs(values) <= 1e-12 * np.abs(values[:, -1:])
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.where(rounding, 0.0, values)))


def _exterior(network: Network) -> Floats:
    """(images, 6): X0 Y0 Z0 omega phi kappa."""
    return np.concatenate([network.images.position, rot.to_angles(network.images.rotation)], axis=1)
