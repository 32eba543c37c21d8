"""Strips of models: connection by similarity transformations, and polynomial adjustment of strips and blocks to start pass points.

In plan the polynomial is conformal, X + i Y = c0 + c1 w + c2 w^2 + ... with w = x + i y; heights follow Z = |c1| z + d00 + d10 x + d01 y +
d20 x^2 + d11 x y + d30 x^3 + d21 x^2 y, with x along the strip. Schut, Polynomial transformation of analytical strip triangulation,
NRC Canada (1961); Manual of Photogrammetry, 4th ed. (1980), chapter 9. It is no rigorous adjustment: it starts one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import Singular, UsageError
from baarda.geometry.similarity import similarity

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Complex = NDArray[np.complex128]
#: Powers of x and y in the polynomial of heights, by its order.
HEIGHT_TERMS = {1: ((0, 0), (1, 0), (0, 1)), 2: ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1))}
HEIGHT_TERMS[3] = (*HEIGHT_TERMS[2], (3, 0), (2, 1))


@dataclass(frozen=True)
class StripPolynomial:
    """The polynomials of one strip.

    Attributes
    ----------
    centre : (3,) array
        Subtracted from strip coordinates.
    scale : float
        By which they are divided.
    axis : complex
        By which plan coordinates are multiplied to bring x along the strip.
    plan : (p + 1,) complex array
    height : (q,) array
    terms : tuple of (int, int)
        Powers of the height polynomial.
    """

    centre: Floats
    scale: float
    axis: complex
    plan: Complex
    height: Floats
    terms: tuple[tuple[int, int], ...]

    def apply(self, points: ArrayLike) -> Floats:
        """Return object coordinates of strip coordinates, (n, 3) to (n, 3).

        Examples
        --------
        >>> p = StripPolynomial(np.zeros(3), 1.0, 1.0, np.array([1.0, 2.0j]), np.array([5.0, 0.0, 0.0]), HEIGHT_TERMS[1])
        >>> p.apply([[3.0, 0.0, 1.0]])
        array([[1., 6., 7.]])
        """
        w, z = _reduced(np.asarray(points, dtype=float), self.centre, self.scale, self.axis)
        plan = np.polynomial.polynomial.polyval(w, self.plan)
        height = abs(self.plan[1]) * z + _height_rows(w, self.terms) @ self.height
        return np.stack([plan.real, plan.imag, height], axis=1)


def _reduced(points: Floats, centre: Floats, scale: float, axis: complex) -> tuple[Complex, Floats]:
    d = (points - centre) / scale
    return np.asarray((d[:, 0] + 1j * d[:, 1]) * axis), np.asarray(d[:, 2])


def _height_rows(w: Complex, terms: Sequence[tuple[int, int]]) -> Floats:
    return np.stack([w.real**i * w.imag**j for i, j in terms], axis=1)


@dataclass(frozen=True)
class BlockPolynomials:
    """A polynomial adjustment of several strips.

    Attributes
    ----------
    strips : tuple of StripPolynomial
    points : dict of str to (3,) array
        Mean of the strips for each point.
    residuals : dict of (int, str) to (3,) array
        Transformed - control, or transformed - mean of tie points.
    redundancy : int
        Of plan and height together.
    sigma0 : float
        Of one coordinate, object units.
    """

    strips: tuple[StripPolynomial, ...]
    points: dict[str, Floats]
    residuals: dict[tuple[int, str], Floats]
    redundancy: int
    sigma0: float


def adjust_polynomials(strips: Sequence[Mapping[str, Floats]], control: Mapping[str, Floats], order: int = 2) -> BlockPolynomials:
    """Transform strips to the object system by polynomials, tied together at their common points, in one linear adjustment.

    Parameters
    ----------
    strips : sequence of mappings
        For each strip the (3,) coordinates of its points by label.
    control : mapping
        Object coordinates by label; NaN in X and Y for height control only, in Z for plan control only.
    order : int
        1 to 3, for plan and height.

    Returns
    -------
    BlockPolynomials

    Raises
    ------
    UsageError
        If the order is not 1 to 3, or a point has half of its plan coordinates.
    Singular
        If control and tie points do not determine the polynomials; says how many of what there are.

    Notes
    -----
    Schut (1961). Control and tie points have unit weight; a tie point between strips a and b demands that both give the same coordinates.

    Examples
    --------
    >>> strip = {"a": np.zeros(3), "b": np.array([1.0, 0, 0]), "c": np.array([0, 1.0, 0]), "d": np.array([1.0, 1, 1])}
    >>> control = {k: 10.0 * strip[k] + 5.0 for k in "abc"}
    >>> adjust_polynomials([strip], control, 1).points["d"].round(9)
    array([15., 15., 15.])
    """
    if order not in HEIGHT_TERMS:
        raise UsageError(f"the order of a strip polynomial is 1, 2 or 3, not {order}")
    for label, given in control.items():
        if np.isnan(given[0]) != np.isnan(given[1]):
            raise UsageError(f"control point {label} has half of its plan coordinates")
    terms = HEIGHT_TERMS[order]
    frames = [_frame(np.array(list(s.values()))) for s in strips]
    w: list[dict[str, complex]] = []
    z: list[dict[str, float]] = []
    for s, f in zip(strips, frames, strict=True):
        plan, up = _reduced(np.array(list(s.values())), *f)
        w.append(dict(zip(s, plan.tolist(), strict=True)))
        z.append(dict(zip(s, up.tolist(), strict=True)))
    links = _links(strips)
    width, wide = order + 1, len(terms)
    rows: list[Complex] = []
    right: list[complex] = []
    for label, first, k in links:
        x: Floats | None = control.get(label)
        known = x is not None and bool(np.isfinite(x[0]))
        if first is None and not known:
            continue
        row = np.zeros((len(strips), width), dtype=complex)
        row[k] = w[k][label] ** np.arange(width)
        if not known and first is not None:
            row[first] -= w[first][label] ** np.arange(width)
        rows.append(row.ravel())
        right.append(complex(x[0], x[1]) if known and x is not None else 0j)
    solved, rest = _solve(rows, right, len(strips) * width, "plan")
    plans = solved.reshape(len(strips), width)
    square, count = float(np.sum(np.abs(rest) ** 2)), 2 * len(rest)
    rows, right = [], []
    for label, first, k in links:
        x = control.get(label)
        known = x is not None and bool(np.isfinite(x[2]))
        if first is None and not known:
            continue
        row = np.zeros((len(strips), wide), dtype=complex)
        row[k] = _height_rows(np.array([w[k][label]]), terms)[0]
        value = -abs(plans[k, 1]) * z[k][label]
        if known and x is not None:
            value += float(x[2])
        elif first is not None:
            row[first] -= _height_rows(np.array([w[first][label]]), terms)[0]
            value += abs(plans[first, 1]) * z[first][label]
        rows.append(row.ravel())
        right.append(complex(value))
    solved, rest = _solve(rows, right, len(strips) * wide, "height")
    heights = solved.real.reshape(len(strips), wide)
    square, count = square + float(np.sum(np.abs(rest) ** 2)), count + len(rest)
    found = tuple(StripPolynomial(*f, c, d, terms) for f, c, d in zip(frames, plans, heights, strict=True))
    own = [dict(zip(s, p.apply(np.array(list(s.values()))), strict=True)) for s, p in zip(strips, found, strict=True)]
    mean = {label: np.mean([o[label] for o in own if label in o], axis=0) for label, first, _ in links if first is None}
    residuals = {}
    for k, o in enumerate(own):
        for label, moved in o.items():
            if label in control or sum(label in other for other in own) > 1:
                given = control.get(label, mean[label])
                residuals[k, label] = moved - np.where(np.isfinite(given), given, mean[label])
    redundancy = count - len(strips) * (2 * width + wide)
    sigma0 = float(np.sqrt(square / redundancy)) if redundancy > 0 else float("nan")
    return BlockPolynomials(found, mean, residuals, redundancy, sigma0)


def _frame(points: Floats) -> tuple[Floats, float, complex]:
    """Return centre, scale, and the turn that brings the longest direction in plan to x."""
    centre = points.mean(axis=0)
    d = points - centre
    scale = float(np.abs(d[:, :2]).max())
    if not scale > 0.0:
        raise Singular("a strip whose points all lie in one place cannot be transformed")
    _, _, vt = np.linalg.svd(d[:, :2])
    return centre, scale, complex(vt[0, 0], -vt[0, 1])


def _links(strips: Sequence[Mapping[str, Floats]]) -> list[tuple[str, int | None, int]]:
    """Return each point of each strip: label, the first strip that has it (None for that one), and the strip."""
    first: dict[str, int] = {}
    out: list[tuple[str, int | None, int]] = []
    for k, s in enumerate(strips):
        for label in s:
            out.append((label, first.get(label), k))
            first.setdefault(label, k)
    return out


def _solve(rows: list[Complex], right: list[complex], unknowns: int, what: str) -> tuple[Complex, Complex]:
    """Solve a linear system by least squares; return the solution and what is left."""
    a, b = np.array(rows).reshape(len(rows), unknowns), np.array(right)
    if len(a) < unknowns:
        raise Singular(f"{len(a)} control and tie points for {unknowns} coefficients in {what}: the strip polynomials are not determined")
    norm = np.linalg.norm(a, axis=0)
    norm[norm == 0.0] = 1.0
    solved, _, rank, _ = np.linalg.lstsq(a / norm, b, rcond=1e-10)
    if rank < unknowns:
        raise Singular(
            f"the control and tie points do not determine the strip polynomials in {what} (on one line, or a strip without control)"
        )
    return np.asarray(solved / norm), np.asarray(a @ (solved / norm) - b)


@dataclass(frozen=True)
class Connected:
    """Models connected one to another.

    Attributes
    ----------
    points : dict of str to (3,) array
        In the system of the first model; means where several models have a point.
    rotations : (m, 3, 3) array
        strip = scale rotation model + translation.
    scales : (m,) array
    translations : (m, 3) array
    rms : float
        Of the differences at common points, strip units.
    """

    points: dict[str, Floats]
    rotations: Floats
    scales: Floats
    translations: Floats
    rms: float


def connect_models(models: Sequence[Mapping[str, Floats]], names: Sequence[str] = ()) -> Connected:
    """Connect independent models to a strip: each by a similarity transformation onto what is there already.

    Parameters
    ----------
    models : sequence of mappings
        For each model the (3,) coordinates of its points, perspective centres included, by label.
    names : sequence of str
        Of the models, for messages.

    Returns
    -------
    Connected

    Raises
    ------
    Singular
        If a model has no three points, not on one line, in common with the others.

    Notes
    -----
    Ackermann, Ebner & Klein, Block triangulation with independent models, Photogrammetric Engineering 39 (1973) 967-981: perspective
    centres carry the angle along the strip.

    Examples
    --------
    >>> one = {"a": np.zeros(3), "b": np.array([1.0, 0, 0]), "c": np.array([0, 1.0, 0]), "d": np.array([0, 0, 1.0])}
    >>> other = {k: 2.0 * v + 1.0 for k, v in one.items() if k != "d"} | {"e": np.array([3.0, 3.0, 3.0])}
    >>> connect_models([one, other]).points["e"].round(9)
    array([1., 1., 1.])
    """
    titles = tuple(names) or tuple(str(k + 1) for k in range(len(models)))
    sums = {label: np.array(x, dtype=float) for label, x in models[0].items()}
    counts = dict.fromkeys(sums, 1)
    rotations, scales, translations = np.tile(np.eye(3), (len(models), 1, 1)), np.ones(len(models)), np.zeros((len(models), 3))
    left = list(range(1, len(models)))
    square, compared = 0.0, 0
    while left:
        common = {k: [label for label in models[k] if label in sums] for k in left}
        k = max(left, key=lambda j: len(common[j]))
        left.remove(k)
        here = np.array([sums[label] / counts[label] for label in common[k]]).reshape(-1, 3)
        try:
            move = similarity(np.array([models[k][label] for label in common[k]]).reshape(-1, 3), here)
        except UsageError as error:
            raise Singular(f"model {titles[k]} cannot be connected: {error}", [f"model {titles[k]}"]) from None
        rotations[k], scales[k], translations[k] = move.rotation, move.scale, move.translation
        for label, x in models[k].items():
            moved = move.apply(x)
            if label in sums:
                square += float(np.sum((moved - sums[label] / counts[label]) ** 2))
                compared += 3
                sums[label] = sums[label] + moved
                counts[label] += 1
            else:
                sums[label], counts[label] = moved, 1
    points = {label: x / counts[label] for label, x in sums.items()}
    return Connected(points, rotations, scales, translations, float(np.sqrt(square / compared)) if compared else 0.0)
