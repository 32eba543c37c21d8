"""The datum of a network in parts: the defect from sums over the parts, and how it is tied down."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from baarda.adjustment.datum import free_combinations, steady
from baarda.adjustment.solve import Settings
from baarda.errors import DatumDefect
from baarda.procedures import helmert_part as tasks
from baarda.procedures.helmert_border import Handles, Parts

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class JointDatum:
    """The datum of a network in parts.

    Attributes
    ----------
    name : str
        ``control``, ``minimal`` or ``inner``.
    count : int
        The defect d.
    held : tuple of int arrays
        For each part the columns of its interior that are held while solving.
    held_border : int array
        Unknowns of the border that are held while solving.
    tie : Tie or None
        The inner constraints.
    inverse : (d, d) array
        (B'G)^-1.
    text : str
    free : Tie or None
        As `tie`, also of a minimal datum, whose conditions are over no kind of unknowns but `pins`.
    pins : tuple of (k, 2) int arrays
        For each part the columns of unknowns that a minimal datum holds, each with its number among all d of them.
    """

    name: str
    count: int
    held: tuple[Ints, ...]
    held_border: Ints
    tie: tasks.Tie | None
    inverse: Floats
    text: str
    free: tasks.Tie | None
    pins: tuple[Ints, ...]


def find_defect(parts: Parts, stands: Handles) -> tuple[Floats, tuple[str, ...], list[tasks.DatumSums]]:
    """Return the free combinations (7, d) of the similarity directions, as `baarda.adjustment.datum.find_defect`."""
    sums = parts.all(tasks.datum_sums, stands, parts.joint.size)
    gross, net = (sum(getattr(s, name) for s in sums) for name in ("gross", "net"))
    basis, free = free_combinations(gross, net, np.concatenate([s.triangle for s in sums]))
    if basis.shape[1]:
        everything = np.concatenate([s.all_unknowns for s in sums]) @ basis
        basis = basis @ np.linalg.inv(np.linalg.qr(everything, mode="r"))
    return basis, free, sums


def choose_datum(parts: Parts, stands: Handles, settings: Settings, at_start: bool) -> JointDatum:
    """Tie down the free transformations as the settings say."""
    count = len(parts.joint.at)
    none = np.zeros(0, dtype=np.intp)
    basis, single, sums = find_defect(parts, stands)
    d = basis.shape[1]
    if not d:
        text = "The datum is defined by the observations and known values (defect 0)."
        return JointDatum("control", 0, (none,) * count, none, None, np.zeros((0, 0)), text, None, ())
    free = ", ".join(single) if len(single) == d else f"{d} combination(s) of shifts, rotations and scale"
    if settings.datum == "control":
        raise DatumDefect(
            f"the known values do not define the datum: free are {free} (datum defect {d}); "
            "add control, or choose inner or minimal constraints (--datum inner)"
        )
    held, border, names, pins = _held(parts, stands, basis, free)
    if settings.datum == "minimal":
        text = f"Minimal constraints hold {d} unknown(s) at their start values: {names}."
        return JointDatum(
            "minimal",
            d,
            held,
            border,
            None,
            np.zeros((0, 0)),
            text,
            tasks.Tie(parts.joint.size, basis, (), basis if at_start else None),
            pins,
        )
    kinds: tuple[str, ...] = ("point",)
    far = sum(s.far for s in sums)
    where = "all object points" + (f" but {far} far one(s)" if far else "")
    if np.linalg.matrix_rank(np.concatenate([s.on_points for s in sums]) @ basis) < d:
        kinds, where = ("point", "image"), f"{where} and images"
    tie = tasks.Tie(parts.joint.size, basis, kinds, basis if at_start else None)
    inverse = np.linalg.inv(parts.total(tasks.gram, stands, tie))
    text = f"Free network: {d} inner constraint(s) over {where} tie down {free}."
    return JointDatum("inner", d, held, border, tie, inverse, text, tie, (np.zeros((0, 2), dtype=np.intp),) * count)


def at_present(parts: Parts, stands: Handles, datum: JointDatum) -> JointDatum:
    """Return the same conditions with the transformations that are free at present, see `baarda.adjustment.datum.Datum.at`."""
    if datum.tie is None or steady(datum.tie.basis):
        return datum
    basis, _, _ = find_defect(parts, stands)
    return replace(datum, tie=replace(datum.tie, basis=basis)) if basis.shape[1] == datum.count else datum


def at_result(parts: Parts, stands: Handles, settings: Settings, datum: JointDatum) -> JointDatum:
    """Return the datum whose conditions are about the result; a minimal datum, which names what was held, stays."""
    if datum.tie is None:
        return datum
    found = choose_datum(parts, stands, settings, False)
    if found.count == datum.count:
        return found
    tie = replace(datum.tie, start=None)
    return replace(datum, tie=tie, inverse=np.linalg.inv(parts.total(tasks.gram, stands, tie)))


def _held(parts: Parts, stands: Handles, basis: Floats, free: str) -> tuple[tuple[Ints, ...], Ints, str, tuple[Ints, ...]]:
    """Choose d orientation unknowns whose fixing removes the defect, best conditioned: in the parts, in the border, names, pins."""
    d = basis.shape[1]
    found = parts.all(tasks.candidates, stands, parts.joint.size, basis)
    border = np.full(parts.joint.border, -1)
    part, column, place = list[int](), list[int](), list[int]()
    squares, rows = list[float](), list[Floats]()
    for k, (c, at, f) in enumerate(zip(found, parts.joint.at, parts.joint.facts, strict=True)):
        here = dict(zip(f.border_columns.tolist(), at.tolist(), strict=True))
        for i, own in enumerate(c.columns.tolist()):
            b = here.get(own, -1)
            if b >= 0 and border[b] >= 0:
                squares[border[b]] += float(c.squares[i])
                continue
            if b >= 0:
                border[b] = len(part)
            part.append(k)
            column.append(own)
            place.append(b)
            squares.append(float(c.squares[i]))
            rows.append(c.directions[i])
    scaled = np.array(rows).reshape(-1, d) * np.sqrt(np.array(squares))[:, None]
    r, order = np.zeros((0, 0)), np.zeros(0, dtype=np.intp)
    if len(scaled):
        _, r, order = linalg.qr(scaled.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(r))
    if len(diagonal) < d or diagonal[-1] < 1e-9 * diagonal[0]:
        raise DatumDefect(f"the datum defect {d} ({free}) cannot be removed by holding orientation unknowns of images")
    chosen = np.sort(order[:d])
    count = len(parts.joint.at)
    held = tuple(np.array([column[i] for i in chosen if part[i] == k and place[i] < 0], dtype=np.intp) for k in range(count))
    top = np.array(sorted(place[i] for i in chosen if place[i] >= 0), dtype=np.intp)
    names: list[str] = [parts.joint.names[i] for i in top]
    asked = [parts.engine.submit(k, tasks.names_of, s, h) for k, (s, h) in enumerate(zip(stands, held, strict=True)) if len(h)]
    for more in parts.engine.gather(asked):
        names += more
    pins = tuple(
        np.array([(column[i], j) for j, i in enumerate(chosen) if part[i] == k], dtype=np.intp).reshape(-1, 2) for k in range(count)
    )
    return held, top, ", ".join(names), pins
