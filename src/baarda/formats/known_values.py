"""Start value, state, given value and sigma of unknowns: what a table says is taken, what it does not say follows from the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE, OBSERVED, STATES
from baarda.formats.checks import SIGMAS, camera_range, sigma_range
from baarda.formats.csv_table import CsvTable
from baarda.geometry import rotation as rot
from baarda.network import AXES, CHECK, CONTROL, EXTERIOR, Network

ANGLES = ("omega", "phi", "kappa")
Floats = NDArray[np.float64]
States = NDArray[np.int8]


def columns_of(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the optional columns that `known_values` reads."""
    return tuple(f"{kind}_{name}" for kind in ("state", "given", "sigma") for name in names)


@dataclass(frozen=True)
class KnownValues:
    """What is known of k parameters in n rows; all arrays are (n, k).

    Attributes
    ----------
    values : array
        Start values, NaN = missing; a fixed parameter has one.
    states, given, sigmas : arrays
        As in `baarda.network.Images` and `Points`.
    without_sigma : bool array
        Given values without a column of sigmas, taken as exact.
    """

    values: Floats
    states: States
    given: Floats
    sigmas: Floats
    without_sigma: NDArray[np.bool_]


def known_values(
    table: CsvTable,
    names: Sequence[str],
    values: Floats,
    known: NDArray[np.bool_] | None = None,
    judging: NDArray[np.bool_] | None = None,
) -> KnownValues:
    """Read the columns ``state_*``, ``given_*`` and ``sigma_*`` of some parameters.

    Parameters
    ----------
    table : CsvTable
    names : sequence of str
        The k parameters.
    values : (n, k) array
        Start values, NaN = missing.
    known : (n,) bool array, optional
        Rows whose values are given by their nature (control, check); by default those with a sigma.
    judging : (n,) bool array, optional
        Rows among them that only judge the adjustment (check points): free, a sigma of zero stays.

    Returns
    -------
    KnownValues

    Raises
    ------
    InputError
        With file and line, if a state contradicts the values.

    Notes
    -----
    Without a state a parameter is observed if its sigma is positive, fixed if its sigma is zero, else free. Without a column of given
    values the start values are given; without a column of sigmas given values are exact.
    """
    n, k = values.shape
    values = values.copy()
    judging = np.zeros(n, dtype=bool) if judging is None else judging
    states, given = np.full((n, k), FREE, dtype=np.int8), np.full((n, k), np.nan)
    sigmas, without = np.full((n, k), np.nan), np.zeros((n, k), dtype=bool)
    for j, name in enumerate(names):
        said = table.choices(f"state_{name}", STATES)
        sigma = table.sigmas(f"sigma_{name}")
        start = values[:, j]
        if f"given_{name}" in table.columns:
            value = table.numbers(f"given_{name}")
        else:
            from_start = (known if known is not None else np.isfinite(sigma)) | (said == OBSERVED)
            value = np.where(from_start, start, np.nan)
        if known is not None:
            if f"sigma_{name}" not in table.columns:
                without[:, j] = known & np.isfinite(value) & (said == -1)
                sigma = np.where(without[:, j], 0.0, sigma)
            bare = known & ~judging & (said == -1) & np.isfinite(value) & np.isnan(sigma)
            _complain(table, bare, f"sigma_{name} is missing (0 = exact, held fixed)")
        follows = np.where(judging, FREE, np.where(sigma > 0.0, OBSERVED, np.where(sigma == 0.0, FIXED, FREE)))
        state = np.where(said >= 0, said, follows)
        zero = (state == OBSERVED) & (sigma == 0.0)
        state = np.where(zero, FIXED, state)
        sigma = np.where((state == FIXED) & ((said != FIXED) | zero) & (sigma == 0.0), np.nan, sigma)
        _complain(table, (state == OBSERVED) & ~np.isfinite(value), f"{name} is observed, but its given value is missing")
        _complain(table, (state == OBSERVED) & ~np.isfinite(sigma), f"{name} is observed, but sigma_{name} is missing")
        start = np.where((state == FIXED) & np.isnan(start), value, start)
        _complain(table, (state == FIXED) & np.isnan(start), f"{name} is fixed, but has no value")
        with np.errstate(over="ignore"):  # an infinite difference is one
            difference = start - value
        if name in ANGLES:
            difference = np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi
        apart = np.abs(difference) > 1e-9 * (1.0 + np.abs(value))
        _complain(table, (state == FIXED) & apart, f"{name} is fixed, but its start value differs from given_{name}")
        values[:, j], states[:, j], given[:, j], sigmas[:, j] = start, state, value, sigma
    return KnownValues(values, states, given, sigmas, without)


def _complain(table: CsvTable, bad: NDArray[np.bool_], message: str) -> None:
    rows = np.flatnonzero(bad)
    if len(rows):
        raise table.error(int(rows[0]), message)


def with_unknowns(network: Network, table: CsvTable) -> Network:
    """Apply a table of directly observed unknowns with the columns name (``kind label: parameter``), value and sigma.

    Parameters
    ----------
    network : Network
    table : CsvTable
        A sigma of zero holds the unknown fixed; without a value the start value was observed.

    Returns
    -------
    Network

    Raises
    ------
    InputError
        With file and line.
    """
    table.labels("name", "unknown")
    value, sigma = table.numbers("value"), table.sigmas("sigma", None)
    of_camera = np.array([name.startswith("camera ") for name in table.texts("name")])
    for of_kind, smallest in ((of_camera, 1e-60), (~of_camera, SIGMAS[0])):
        sigma_range(np.where(of_kind, sigma, 0.0), "sigma", table.error, smallest)
    camera_range(np.where(of_camera, value, 0.0), "value", table.error)
    cameras, images, points = network.cameras, network.images, network.points
    labels = {
        "camera": {c.label: i for i, c in enumerate(cameras)},
        "image": {label: i for i, label in enumerate(images.labels)},
        "point": {label: i for i, label in enumerate(points.labels)},
    }
    exterior = np.concatenate([images.position, rot.to_angles(images.rotation)], axis=1)
    # of each kind start values, states, given values, sigmas; all are indexed by node, then by parameter
    tables: dict[str, tuple[Any, ...]] = {
        "camera": tuple([np.array(getattr(c, a)) for c in cameras] for a in ("values", "states", "prior", "sigmas")),
        "image": tuple(np.array(a) for a in (exterior, images.states, images.given, images.sigmas)),
        "point": tuple(np.array(a) for a in (points.coordinates, points.states, points.given, points.sigmas)),
    }
    roles = np.array(points.roles)
    touched = set()
    for row, name in enumerate(table.texts("name")):
        owner, _, parameter = name.rpartition(": ")
        kind, _, label = owner.partition(" ")
        if label not in labels.get(kind, {}):
            raise table.error(row, f"unknown {name!r} is not in the network; names look like 'camera 1: K1', 'image 7: X0', 'point 12: Z'")
        i = labels[kind][label]
        order = cameras[i].model.order if kind == "camera" else EXTERIOR if kind == "image" else AXES
        if parameter not in order:
            raise table.error(row, f"{owner} has no parameter {parameter!r}; it has {', '.join(order)}")
        k = order.index(parameter)
        start, states, given, sigmas = tables[kind]
        observed = float(start[i][k] if np.isnan(value[row]) else value[row])
        if np.isnan(observed):
            raise table.error(row, f"the value of {name!r} is missing")
        if states[i][k] == OBSERVED:
            raise table.error(row, f"{name!r} is declared as observed in its own table already")
        if sigma[row] == 0.0 and parameter in ANGLES:
            raise table.error(row, "a single angle cannot be fixed; give it a sigma, or fix all three in the table of images")
        if kind == "point":
            if roles[i] == CHECK:
                raise table.error(row, f"{owner} is a check point and cannot be observed")
            roles[i] = CONTROL
        states[i][k] = OBSERVED if sigma[row] > 0.0 else FIXED
        given[i][k] = observed
        sigmas[i][k] = sigma[row] if sigma[row] > 0.0 else np.nan
        if sigma[row] == 0.0 or np.isnan(start[i][k]):
            start[i][k] = observed
        touched.add((kind, i))
    done = tuple(
        replace(c, values=v, states=s, given=g, sigmas=e) if ("camera", i) in touched else c
        for i, (c, v, s, g, e) in enumerate(zip(cameras, *tables["camera"], strict=True))
    )
    start, states, given, sigmas = tables["image"]
    images = replace(images, position=start[:, :3], states=states, given=given, sigmas=sigmas)
    start, states, given, sigmas = tables["point"]
    points = replace(points, coordinates=start, roles=roles, states=states, given=given, sigmas=sigmas)
    return replace(network, cameras=done, images=images, points=points)
