"""Radar image coordinates of one or several tracks as one CSV table; the tracks are found from the control points in it."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.formats.base import Format
from baarda.formats.checks import sigma_range
from baarda.formats.csv_table import CsvTable, read_csv
from baarda.network import AXES, CHECK, CONTROL, ROLES, TIE, Images, Network, Points
from baarda.observations import RangeDoppler, Tracks, tracks

Floats = NDArray[np.float64]
REQUIRED = ("point", "t", "r")
SIGMAS = tuple(f"sigma_{axis}" for axis in AXES)
CONSTANT = {"delay": 0.0, "side": 0.0, "time_origin": 0.0, "order": 4.0, "squint_order": 0.0}
OPTIONAL = ("track", "sigma_t", "sigma_r", "role", *AXES, *SIGMAS, *CONSTANT)
LARGEST_ORDER = 20


def recognises(path: Path) -> bool:
    """Return whether the first line of a file names point, t and r."""
    if not path.is_file() or path.suffix.lower() != ".csv":
        return False
    with path.open("rb") as file:
        first = file.readline(4096).decode("utf-8-sig", "replace")
    try:
        header = {name.strip() for name in next(csv.reader([first]), [])}
    except csv.Error:
        return False
    return set(REQUIRED) <= header


def read(path: Path) -> Network:
    r"""Read a table of radar image coordinates.

    Parameters
    ----------
    path : Path
        Columns point, t, r; optional track, sigma_t (default 1), sigma_r (default 1 px), role, X, Y, Z, sigma_X, sigma_Y, sigma_Z, and,
        the same in all rows of a track, delay, side, time_origin, order (of the position polynomials, 4), squint_order (0).

    Returns
    -------
    Network
        Tracks without start values: they are found from the control points.

    Raises
    ------
    InputError
        With file and line.

    Examples
    --------
    >>> import tempfile
    >>> text = "point,t,r,X,Y,Z,delay\na,1.5,800,1000,2000,50,5000\nb,2.5,900,,,60,5000\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "radar.csv").write_text(text)
    ...     network = read(Path(folder, "radar.csv"))
    >>> network.points.roles.tolist(), network.points.states[1].tolist(), network.declared[0].named(0, "Z4")
    ([1, 1], [2, 2, 0], 17)
    """
    table = read_csv(path, REQUIRED, OPTIONAL)
    notes: list[str] = []
    names = table.texts("track", "1")
    labels = list(dict.fromkeys(names))
    node = np.array([labels.index(name) for name in names], dtype=np.intp)
    points, index = _points(table, notes)
    sigmas = []
    for name, unit in (("sigma_t", ""), ("sigma_r", " px")):
        s = table.sigmas(name)
        if np.isnan(s).all():
            notes.append(f"{path.name} has no {name}: 1{unit} was taken")
            s = np.ones(len(s))
        bad = np.flatnonzero(~(s > 0.0))
        if len(bad):
            raise table.error(int(bad[0]), f"{name} must be there and positive")
        sigma_range(s, name, table.error)
        sigmas.append(s)
    first: dict[tuple[int, int], int] = {}
    for row, key in enumerate(zip(node.tolist(), index.tolist(), strict=True)):
        if key in first:
            message = f"point {points.labels[key[1]]} of track {labels[key[0]]} appears already in line {table.line(first[key])}"
            raise table.error(row, message)
        first[key] = row
    tr = np.stack([table.numbers("t", None), table.numbers("r", None)], axis=1)
    group = RangeDoppler(node, index, tr, np.stack(sigmas, axis=1))
    flown = _tracks(table, node, labels, notes)
    settings = {"min_rays": 0}
    return Network((), Images.make(()), points, (group,), settings=settings, assumptions=tuple(notes), declared=(flown,))


def _constant(table: CsvTable, name: str, node: NDArray[np.intp], track: int) -> float:
    """Return the value of a column that is the same in all rows of a track."""
    values = table.numbers(name, CONSTANT[name])
    rows = np.flatnonzero(node == track)
    other = rows[values[rows] != values[rows[0]]]
    if len(other):
        raise table.error(int(other[0]), f"{name} differs from line {table.line(int(rows[0]))} of the same track")
    return float(values[rows[0]])


def _tracks(table: CsvTable, node: NDArray[np.intp], labels: list[str], notes: list[str]) -> Tracks:
    if "delay" not in table.columns:
        notes.append(f"{table.file.name} has no column delay: the slant range of r = 0 was taken as 0")
    if "order" not in table.columns:
        notes.append(f"{table.file.name} has no column order: the position polynomials are of order {CONSTANT['order']:g}")
    made = []
    for k, label in enumerate(labels):
        value = {name: _constant(table, name, node, k) for name in CONSTANT}
        row = int(np.flatnonzero(node == k)[0])
        for name, least in (("order", 1), ("squint_order", 0)):
            if value[name] != int(value[name]) or not least <= value[name] <= LARGEST_ORDER:
                raise table.error(row, f"{name} must be a whole number from {least} to {LARGEST_ORDER}, not {value[name]:g}")
        if value["side"] not in (-1.0, 0.0, 1.0):
            raise table.error(row, f"side is 1 (left), -1 (right) or 0 (not known), not {value['side']:g}")
        nothing = np.full((1, 3, int(value["order"]) + 1), np.nan)
        squint = np.zeros((1, int(value["squint_order"]) + 1))
        made.append(tracks([label], nothing, squint, np.nan, value["delay"], value["time_origin"], value["side"]))
    return Tracks(
        made[0].kind,
        tuple(labels),
        tuple(t.parameters[0] for t in made),
        tuple(t.units[0] for t in made),
        np.concatenate([t.values for t in made]),
        np.concatenate([t.states for t in made]),
    )


def _points(table: CsvTable, notes: list[str]) -> tuple[Points, NDArray[np.intp]]:
    """Return the points, and the point of each row; a point may have its coordinates in any one of its rows."""
    names = table.texts("point")
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        rows_of.setdefault(name, []).append(row)
    table_labels = list(rows_of)
    x = np.stack([table.numbers(axis) for axis in AXES], axis=1)
    s = np.stack([table.sigmas(name) for name in SIGMAS], axis=1)
    role = table.choices("role", ROLES)
    n = len(table_labels)
    given, sigmas, roles = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full(n, -1)
    for i, rows in enumerate(rows_of.values()):
        for row in rows:
            for values, out, what in ((x, given, AXES), (s, sigmas, SIGMAS)):
                for k in range(3):
                    value = values[row, k]
                    if np.isfinite(value) and np.isfinite(out[i, k]) and value != out[i, k]:
                        raise table.error(row, f"{what[k]} of point {table_labels[i]} differs from an earlier row")
                    if np.isfinite(value):
                        out[i, k] = value
            if role[row] >= 0:
                roles[i] = role[row]
    known = np.isfinite(given)
    for i, rows in enumerate(rows_of.values()):
        lost = (np.isfinite(sigmas[i]) & ~known[i]).any()
        if lost or (roles[i] > TIE and not known[i].any()):
            raise table.error(rows[0], f"point {table_labels[i]} has a role or a sigma, but no coordinate to it")
    roles = np.where(roles >= 0, roles, np.where(known.any(axis=1), CONTROL, TIE))
    states = np.where(known, np.where(sigmas > 0.0, OBSERVED, FIXED), FREE)
    states[roles != CONTROL] = FREE
    held = states == FIXED
    if held.any():
        notes.append(f"{int(held.any(axis=1).sum())} control point(s) without sigmas are held fixed")
    exact = (roles == CHECK)[:, None] & known & np.isnan(sigmas)
    deviation = np.where(exact, 0.0, np.where(held, np.nan, sigmas))
    index = {label: i for i, label in enumerate(table_labels)}
    start = np.where((roles == TIE)[:, None] & ~known.all(axis=1)[:, None], np.nan, given)
    used = np.where((roles == TIE)[:, None], np.nan, given)
    made = Points.make(table_labels, start, roles, states, used, np.where((roles == TIE)[:, None], np.nan, deviation))
    return made, np.array([index[name] for name in names], dtype=np.intp)


radar_csv = Format("radar-csv", "radar image coordinates t, r of one or several tracks with control, one CSV table", recognises, read)
