"""Networks without some of their observations, and what the rest predicts for those.

A scalar observation is named by three integers: the group of the network it belongs to (or `CAMERA`, `IMAGE`, `POINT` for directly observed
values), its row (or node), and its component.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment
from baarda.cameras import FREE
from baarda.network import TIE, Images, Network, State
from baarda.observations import CorrelatedPoints, Direct, ImageCoordinates, ImagePoints, component_unit, direct_observations

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Key = tuple[int, int, int]

CAMERA, IMAGE, POINT, DECLARED = -1, -2, -3, -4  # of the declared groups the first; the others follow downwards
_CODES = {"camera": CAMERA, "image": IMAGE, "point": POINT}


def _grid(source: int, rows: int, components: int) -> Ints:
    """Return the (rows, components, 3) keys of a whole group."""
    out = np.empty((rows, components, 3), dtype=np.intp)
    out[:, :, 0] = source
    out[:, :, 1] = np.arange(rows)[:, None]
    out[:, :, 2] = np.arange(components)[None, :]
    return out


def direct_keys(group: Direct | CorrelatedPoints, network: Network) -> Ints:
    """Return the (rows, components, 3) keys of directly observed values."""
    if isinstance(group, CorrelatedPoints):
        out = _grid(POINT, len(group), 3)
        out[:, :, 1] = group.nodes[:, None]
        return out
    codes = {**_CODES, **{d.kind: DECLARED - i for i, d in enumerate(network.declared)}}
    return np.stack([np.full(len(group), codes[group.kind]), group.nodes, group.positions], axis=1)[:, None, :]


def without(network: Network, removed: Iterable[Key]) -> tuple[Network, list[Ints]]:
    """Return a network without some scalar observations, and the keys of those that are left.

    Parameters
    ----------
    network : Network
    removed : iterable of keys
        An image point that loses one coordinate becomes a single coordinate; a directly observed value becomes free.

    Returns
    -------
    network : Network
    keys : list of (rows, components, 3) int arrays
        One per observation group of the result.
    """
    gone: dict[int, list[tuple[int, int]]] = {}
    for source, row, component in removed:
        gone.setdefault(source, []).append((row, component))
    groups: list[Any] = []
    keys: list[Ints] = []
    for g, group in enumerate(network.observations):
        names = _grid(g, len(group), len(group.components))
        if g not in gone:
            groups.append(group)
            keys.append(names)
            continue
        used = np.ones(names.shape[:2], dtype=bool)
        at = np.array(gone[g])
        used[at[:, 0], at[:, 1]] = False
        whole = used.all(axis=1)
        groups.append(group.selected(whole))
        keys.append(names[whole])
        single = np.flatnonzero(used.any(axis=1) & ~whole)
        if isinstance(group, ImagePoints) and len(single):
            axes = np.argmax(used[single], axis=1)
            groups.append(ImageCoordinates(group.selected(single), axes))
            keys.append(names[single, axes][:, None, :])
    left = [i for i, group in enumerate(groups) if len(group)]
    changed = replace(network, observations=tuple(groups[i] for i in left))
    return _without_direct(changed, gone), [keys[i] for i in left]


def _without_direct(network: Network, gone: dict[int, list[tuple[int, int]]]) -> Network:
    cameras, images, points = list(network.cameras), network.images, network.points
    for node, k in gone.get(CAMERA, ()):
        states = np.array(cameras[node].states)
        states[k] = FREE
        cameras[node] = replace(cameras[node], states=states)
    if IMAGE in gone:
        states, at = np.array(images.states), np.array(gone[IMAGE])
        states[at[:, 0], at[:, 1]] = FREE
        images = replace(images, states=states)
    if POINT in gone:
        states, at = np.array(points.states), np.array(gone[POINT])
        states[at[:, 0], at[:, 1]] = FREE
        roles = np.array(points.roles)
        roles[at[:, 0]] = np.where((states[at[:, 0]] == FREE).all(axis=1), TIE, roles[at[:, 0]])
        points = replace(points, states=states, roles=roles)
    declared = list(network.declared)
    for i, d in enumerate(declared):
        if DECLARED - i in gone:
            states, at = np.array(d.states), np.array(gone[DECLARED - i])
            states[d.offsets[at[:, 0]] + at[:, 1]] = FREE
            declared[i] = replace(d, states=states)
    return replace(network, cameras=tuple(cameras), images=images, points=points, declared=tuple(declared))


def keys_of(adjustment: Adjustment, keys: Sequence[Ints]) -> Ints:
    """Return the (n, 3) keys of all scalar observations of an adjustment.

    Parameters
    ----------
    adjustment : Adjustment
    keys : sequence of arrays
        Of the observation groups of its network, from `without`.
    """
    active = ~adjustment.aside
    out = []
    for group, names in zip(adjustment.network.observations, keys, strict=True):
        keep = np.all([active[end] for end in group.points_of()], axis=0)
        if keep.any():
            out.append(names[keep].reshape(-1, 3))
    direct = [g for g in adjustment.groups[len(out) :] if isinstance(g, (Direct, CorrelatedPoints))]
    out += [direct_keys(g, adjustment.network).reshape(-1, 3) for g in direct]
    return np.concatenate(out)


def without_images(network: Network, keep: NDArray[np.bool_]) -> Network:
    """Return a network with some of its images only.

    Parameters
    ----------
    network : Network
    keep : (images,) bool array

    Returns
    -------
    Network
        Image points of the other images are gone, too; object points stay, even without observations.
    """
    im = network.images
    place = np.cumsum(keep) - 1
    fields = ("cameras", "position", "rotation", "states", "given", "sigmas")
    images = Images(tuple(n for n, k in zip(im.labels, keep, strict=True) if k), *(getattr(im, f)[keep] for f in fields))
    groups = []
    for group in network.observations:
        changed: Any = group
        if isinstance(group, ImagePoints):
            changed = group.selected(keep[group.images])
            changed = replace(changed, images=place[changed.images])
        elif isinstance(group, ImageCoordinates):
            changed = group.selected(keep[group.images])
            changed = replace(changed, whole=replace(changed.whole, images=place[changed.images]))
        if len(changed):
            groups.append(changed)
    return replace(network, images=images, observations=tuple(groups))


@dataclass(frozen=True)
class Predicted:
    """What an adjustment predicts for observations that took no part.

    Attributes
    ----------
    residuals : (k,) array
        Computed - observed, in the unit of each observation.
    cofactors : (k, k) array
        Of these residuals: Q of the observations plus A Qxx A'.
    observed, sigmas : (k,) arrays
    units : tuple of str
    groups : tuple of str
        Names of the groups.
    images, points : (k,) int arrays
        -1 = none.
    components : tuple of str
    """

    residuals: Floats
    cofactors: Floats
    observed: Floats
    sigmas: Floats
    units: tuple[str, ...]
    groups: tuple[str, ...]
    images: Ints
    points: Ints
    components: tuple[str, ...]


def predict(adjustment: Adjustment, base: Network, keys: Sequence[Key]) -> Predicted:
    """Predict observations of a network from an adjustment without them.

    Parameters
    ----------
    adjustment : Adjustment
        Of `without(base, ...)`.
    base : Network
        To which the keys refer.
    keys : sequence of keys

    Returns
    -------
    Predicted
    """
    k = len(keys)
    network, state = adjustment.network, State.of(adjustment.network)
    groups: list[Any] = list(base.observations)
    rows: dict[int, list[int]] = {}
    for source, row, _ in keys:
        rows.setdefault(source, []).append(row)
    jacobian, misclosure = np.zeros((k, adjustment.numbering.count)), np.empty(k)
    cofactors, observed, sigmas = np.zeros((k, k)), np.empty(k), np.empty(k)
    units, names, components = [""] * k, [""] * k, [""] * k
    codes = {"image": np.full(k, -1), "point": np.full(k, -1)}
    direct = direct_observations(base, np.ones(len(base.points.labels), dtype=bool)) if min(rows) < 0 else []
    parts: list[tuple[Any, dict[Key, tuple[int, int]]]] = []
    for source in sorted(s for s in rows if s >= 0):
        chosen = np.unique(rows[source])
        part = groups[source].selected(chosen)
        parts.append(
            (part, {(source, int(r), c): (i, c) for i, r in enumerate(chosen) for c in range(len(part.components))}),
        )
    for group in direct:
        table = direct_keys(group, base)
        parts.append((group, {tuple(table[i, c].tolist()): (i, c) for i in range(table.shape[0]) for c in range(table.shape[1])}))
    for part, places in parts:
        here = {j: places[key] for j, key in enumerate(keys) if key in places}
        if not here:
            continue
        labels = part.labels(network)
        values, deviations = part.observed(), part.sigma()
        for found in part.linearize(network, state):
            where = {int(i): n for n, i in enumerate(found.index)}
            mine = {j: (where[i], c) for j, (i, c) in here.items() if i in where}
            for j, (n, c) in mine.items():
                misclosure[j] = found.misclosure[n, c]
                for block in found.blocks:
                    group_columns = adjustment.numbering[block.kind].of(block.nodes[n : n + 1], block.jacobian.shape[2])[0]
                    free = group_columns >= 0
                    jacobian[j, group_columns[free]] += block.jacobian[n, c, free]
                for other, (m, d) in mine.items():
                    if m == n:
                        cofactors[j, other] = found.cofactor[n, c, d] if found.cofactor.ndim == 3 else (c == d) * found.cofactor[n, c]
        for j, (i, c) in here.items():
            observed[j], sigmas[j] = values[i, c], deviations[i, c]
            units[j], names[j] = component_unit(part, c), part.name
            components[j] = str(labels["component"][i]) if "component" in labels else part.components[c]
            for kind, code in codes.items():
                if kind in labels:
                    code[j] = labels[kind][i]
    for a in range(0, k, 256):  # right-hand sides at once
        cofactors[:, a : a + 256] += jacobian @ adjustment.solver.solve(np.ascontiguousarray(jacobian[a : a + 256].T))
    return Predicted(
        -misclosure, cofactors, observed, sigmas, tuple(units), tuple(names), codes["image"], codes["point"], tuple(components)
    )
