"""Image points, compiled: collinearity equations and the chains of the usual cameras, in batches of rows.

The steps of a camera model are numbered here; a model with a step that has no number is evaluated by its NumPy functions, whose oracle
and twin this is.

The rows of a batch lie side by side in a scratch array, one stretch of BATCH numbers for each quantity (X, Y, ...), and every loop over
them is a simple one, which the compiler turns into vector instructions. Each row is computed by the same operations wherever a batch
begins and ends, so that its results do not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import Optics
from baarda.compiling import compile_loops

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

COMPILE_FROM = 60_000  # rows of a group from which the loops are compiled
FLIP, SCALE, TO_CENTRE, FROM_CENTRE, AFFINITY, LENS = range(6)
# for each step its number and which of the (at most 8) parameters that the number knows its own ones are; OpenCV's names tell by themselves
_NUMBERS: dict[str, tuple[int, tuple[int, ...]]] = {
    "flip": (FLIP, ()),
    "distance": (SCALE, (0, 0)),
    "distances": (SCALE, (0, 1)),
    "to_centre": (TO_CENTRE, (0, 1)),
    "from_centre": (FROM_CENTRE, (0, 1)),
    "affinity": (AFFINITY, (0, 1)),
    "lens": (LENS, (0, 1, 2, -1, -1, -1, 4, 3)),  # Brown's P1 and P2 are OpenCV's p2 and p1
}
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

BATCH = 128
# where quantities begin in the scratch of a chain: the point, the point before the step, the partials of the step (A B; C E) and of the
# chain (D00 D01; D10 D11), the step's parameters K1 ... P2 (for other steps than LENS K1 and K2 are the first two), and the partials of the
# new point to these eight, PX of x and PY of y
X, Y, X0, Y0, A, B, C, E, D00, D01, D10, D11 = range(0, 12 * BATCH, BATCH)
K1, K2, K3, K4, K5, K6, P1, P2 = range(12 * BATCH, 20 * BATCH, BATCH)
PX, PY, CHAIN = 20 * BATCH, 28 * BATCH, 36 * BATCH
# and in that of a batch: vector from the camera in its system, -1 / W, normalised and measured coordinates, weights; then of the inversion
U, V, W, INVERSE, XN, YN, MX, MY, WX, WY, BEST_X, BEST_Y, LEAST, STATE, PIXEL_X, PIXEL_Y = range(0, 16 * BATCH, BATCH)
H0, H1, H2, H3, H4, H5 = BEST_X, BEST_Y, LEAST, STATE, PIXEL_X, PIXEL_Y  # after it, of both coordinates to the vector from the camera
ROWS = 16 * BATCH
OPEN, DONE, FAILED = 0.0, 1.0, 2.0  # states of a row in the inversion


@dataclass(frozen=True)
class Program:
    """The two chains of a camera as numbers: step, and for each step the places of its parameters (-1 = not there).

    Attributes
    ----------
    steps : (s,) int array
        The measured chain, then the ideal one.
    places : (s, 8) int array
    measured : int
        Steps of the measured chain.
    """

    steps: Ints
    places: Ints
    measured: int

    @staticmethod
    def of(optics: Optics) -> Program | None:
        """Number the steps of a camera; None if one has no number."""
        steps, places, measured = [], [], 0
        for k, step in enumerate(optics.model.steps):
            columns = optics.model.columns(step)
            if step.name.startswith("opencv "):
                names = step.name.split()[1:]
                number, own = LENS, tuple(names.index(c) if c in names else -1 for c in _COEFFICIENTS)
            elif step.name in _NUMBERS:
                number, own = _NUMBERS[step.name]
            else:
                return None
            if number == FLIP and not optics.y_down:
                continue
            steps.append(number)
            places.append([columns[j] if j >= 0 else -1 for j in own] + [-1] * (8 - len(own)))
            measured += k < len(optics.model.measured)
        return Program(np.array(steps, dtype=np.intp), np.array(places, dtype=np.intp).reshape(-1, 8), measured)


def _chain(steps: Ints, places: Ints, slots: Ints, n: int, p: Floats, s: Floats, dp: Floats) -> None:
    """Lead the n points X, Y of the scratch s through the steps of a chain, in place.

    The parameters of the rows are p (k + 1, BATCH), the last row zeros: the place -1. The partials to the old point are left in D; those
    to parameters that have a slot are left in dp (slots, 2, BATCH).
    """
    dp[:] = 0.0
    touched = np.zeros(len(dp), dtype=np.bool_)  # whether dp holds anything yet
    for i in range(n):
        s[D00 + i], s[D01 + i], s[D10 + i], s[D11 + i] = 1.0, 0.0, 0.0, 1.0
    for step in range(len(steps)):
        number = steps[step]
        for q in range(0 if number == FLIP else 8 if number == LENS else 2):
            row, at = p[places[step, q]], K1 + q * BATCH
            for i in range(n):
                s[at + i] = row[i]
        shifts = number in (TO_CENTRE, FROM_CENTRE)
        if shifts:
            sign = -1.0 if number == TO_CENTRE else 1.0
            for i in range(n):
                s[X + i] += sign * s[K1 + i]
                s[Y + i] += sign * s[K2 + i]
                s[PX + i], s[PY + i] = sign, 0.0
                s[PX + BATCH + i], s[PY + BATCH + i] = 0.0, sign
        elif number == LENS:
            for i in range(n):
                x, y, p1, p2 = s[X + i], s[Y + i], s[P1 + i], s[P2 + i]
                k1, k2, k3, k4, k5, k6 = s[K1 + i], s[K2 + i], s[K3 + i], s[K4 + i], s[K5 + i], s[K6 + i]
                xx, yy, xy2 = x * x, y * y, 2.0 * x * y
                r2 = xx + yy
                lower = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
                ratio = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * lower
                slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - ratio * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) * lower
                s[X0 + i], s[Y0 + i] = x, y
                s[X + i] = x * ratio + p1 * xy2 + p2 * (r2 + 2.0 * xx)
                s[Y + i] = y * ratio + p1 * (r2 + 2.0 * yy) + p2 * xy2
                s[A + i] = ratio + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
                s[E + i] = ratio + yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
                s[B + i] = s[C + i] = x * y * slope + 2.0 * (p1 * x + p2 * y)
                # partials to k1, k4, p1, p2
                s[PX + i], s[PY + i] = x * r2 * lower, y * r2 * lower
                s[PX + 3 * BATCH + i], s[PY + 3 * BATCH + i] = -x * r2 * lower * ratio, -y * r2 * lower * ratio
                s[PX + 6 * BATCH + i], s[PY + 6 * BATCH + i] = xy2, r2 + 2.0 * yy
                s[PX + 7 * BATCH + i], s[PY + 7 * BATCH + i] = r2 + 2.0 * xx, xy2
            for q in (1, 2, 4, 5):
                if slots[step, q] >= 0:  # those to k1 or k4 times a power of r2
                    at, base = q * BATCH, q // 3 * 3 * BATCH
                    for i in range(n):
                        r2 = s[X0 + i] * s[X0 + i] + s[Y0 + i] * s[Y0 + i]
                        power = r2 if q % 3 == 1 else r2 * r2
                        s[PX + at + i], s[PY + at + i] = s[PX + base + i] * power, s[PY + base + i] * power
        else:  # linear: x' = a x + b y, y' = e y
            for i in range(n):
                if number == FLIP:
                    s[A + i], s[B + i], s[E + i] = 1.0, 0.0, -1.0
                elif number == SCALE:
                    s[A + i], s[B + i], s[E + i] = s[K1 + i], 0.0, s[K2 + i]
                else:
                    s[A + i], s[B + i], s[E + i] = 1.0 + s[K1 + i], s[K2 + i], 1.0
            ours, zero = (PX + BATCH, PY + BATCH) if number == AFFINITY else (PY + BATCH, PX + BATCH)
            for i in range(n):
                x, y = s[X + i], s[Y + i]
                s[X + i], s[Y + i], s[C + i] = s[A + i] * x + s[B + i] * y, s[E + i] * y, 0.0
                s[PX + i], s[PY + i] = x, 0.0
                s[ours + i], s[zero + i] = y, 0.0
        if not shifts:
            for i in range(n):
                a, b, c, e = s[A + i], s[B + i], s[C + i], s[E + i]
                d00, d01, d10, d11 = s[D00 + i], s[D01 + i], s[D10 + i], s[D11 + i]
                s[D00 + i], s[D10 + i] = a * d00 + b * d10, c * d00 + e * d10
                s[D01 + i], s[D11 + i] = a * d01 + b * d11, c * d01 + e * d11
            for j in range(len(dp)):
                if touched[j]:
                    for i in range(n):
                        t0, t1 = dp[j, 0, i], dp[j, 1, i]
                        dp[j, 0, i], dp[j, 1, i] = s[A + i] * t0 + s[B + i] * t1, s[C + i] * t0 + s[E + i] * t1
        for q in range(8):
            j = slots[step, q]
            if j >= 0:
                touched[j], at = True, q * BATCH
                for i in range(n):
                    dp[j, 0, i] += s[PX + at + i]
                    dp[j, 1, i] += s[PY + at + i]


def _invert(
    steps: Ints, places: Ints, size_x: float, size_y: float, origin_x: float, origin_y: float, n: int, p: Floats, ideal: Floats,
    s: Floats, g: Floats,
) -> int:  # fmt: skip
    """Find the pixels BEST of g that the measured chain leads to the points X, Y of the ideal one, by Newton steps from the measured ones.

    Returns the first row without a solution, or -1. A row that is done stays as it is while others go on.
    """
    none, nothing = np.full_like(places, -1), np.zeros((0, 2, BATCH))
    for i in range(n):
        g[PIXEL_X + i], g[PIXEL_Y + i] = g[MX + i], g[MY + i]
        g[BEST_X + i], g[BEST_Y + i], g[LEAST + i], g[STATE + i] = g[MX + i], g[MY + i], np.inf, OPEN
    for _ in range(50):
        for i in range(n):
            s[X + i], s[Y + i] = (g[PIXEL_X + i] - origin_x) * size_x, (g[PIXEL_Y + i] - origin_y) * size_y
        _chain(steps, places, none, n, p, s, nothing)
        going = 0
        for i in range(n):
            tx, ty, gx, gy = ideal[X + i], ideal[Y + i], s[X + i], s[Y + i]
            rx, ry = tx - gx, ty - gy
            misfit = np.sqrt(rx * rx + ry * ry)
            size = np.sqrt(tx * tx + ty * ty) + np.sqrt(gx * gx + gy * gy) + 1e-300
            least, state = g[LEAST + i], g[STATE + i]
            better = state == OPEN and misfit < least
            ended = state == OPEN and not misfit < least  # rounding is reached, or no descent is left
            state = (DONE if least <= 1e-13 * size else FAILED) if ended else state
            state = DONE if better and misfit <= 4e-16 * size else state
            g[STATE + i] = state
            going += state == OPEN
            g[LEAST + i] = misfit if better else least
            px, py = g[PIXEL_X + i], g[PIXEL_Y + i]
            g[BEST_X + i], g[BEST_Y + i] = px if better else g[BEST_X + i], py if better else g[BEST_Y + i]
            det = s[D00 + i] * s[D11 + i] - s[D01 + i] * s[D10 + i]
            g[PIXEL_X + i] = px + (s[D11 + i] * rx - s[D01 + i] * ry) / det / size_x
            g[PIXEL_Y + i] = py + (s[D00 + i] * ry - s[D10 + i] * rx) / det / size_y
        if going == 0:
            break
    for i in range(n):
        if g[STATE + i] != DONE:
            return i
    return -1


def _evaluate(
    steps: Ints, places: Ints, measured: int, corrected: bool, to_pixels: Floats, pixel_size: Floats, origin: Floats,
    parameters: Floats, rotation: Floats, position: Floats, points: Floats, camera_of_image: Ints, image: Ints, point: Ints,
    pixels: Floats, weights: Floats, begin: int, end: int, partials: bool, keep_camera: Ints, keep_image: Ints, misclosure: Floats,
    d_camera: Floats, d_image: Floats, d_point: Floats,
) -> int:  # fmt: skip
    """Evaluate rows begin ... end - 1 of image points: their misclosures and partials, each times its weight.

    Parameters
    ----------
    steps, places, measured
        The camera's `Program`.
    corrected : bool
        Whether residuals live in the plane where the two chains meet; `to_pixels` (2,) leads from there to pixels.
    pixel_size, origin : (2,) arrays
    parameters, rotation, position, points : (cameras, k), (images, 3, 3), (images, 3) and (points, 3) arrays
    camera_of_image : (images,) int array
    image, point, pixels : (n,), (n,) and (n, 2) arrays
    weights : (n, 2) array, or (1, 2) for all rows
    keep_camera, keep_image : int arrays
        Which of the k and of the 6 parameters d_camera and d_image are for.
    misclosure, d_camera, d_image, d_point : (m, 2), (m, 2, kept), (m, 2, kept) and (m, 2, 3) arrays
        The results, of row `begin` first; the last three only if `partials`.

    Returns
    -------
    int
        The first row whose distortion could not be inverted, or -1.
    """
    k, kept = parameters.shape[1], len(keep_camera) if partials else 0
    size_x, size_y, origin_x, origin_y = pixel_size[0], pixel_size[1], origin[0], origin[1]
    per_x, per_y = 1.0 / size_x, 1.0 / size_y
    slots = np.full_like(places, -1)  # where in dp the partials to the parameters of the steps go
    for j in range(kept):
        for step in range(len(steps)):
            for at in range(8):
                if places[step, at] == keep_camera[j]:
                    slots[step, at] = j
    p = np.zeros((k + 1, BATCH))
    s, m, g, own = np.empty(CHAIN), np.empty(CHAIN), np.empty(ROWS), np.empty(6)  # ideal chain, measured chain, batch, one row
    dp, dm = np.zeros((kept, 2, BATCH)), np.zeros((kept, 2, BATCH))  # of the ideal chain and of the measured one
    every = np.uint64(1 if len(weights) > 1 else 0)
    held = -1  # the camera of all rows of p
    whole = len(keep_image) == 6 and (keep_image == np.arange(6)).all()
    for first in range(begin, end, BATCH):
        n, to = min(BATCH, end - first), first - begin
        one, same = camera_of_image[image[first]], True
        for i in range(n):
            row = np.uint64(first + i)
            im, pt = np.uint64(image[row]), np.uint64(point[row])  # unsigned places spare the test for negative ones
            same = same and camera_of_image[im] == one
            x, y, z = points[pt, 0] - position[im, 0], points[pt, 1] - position[im, 1], points[pt, 2] - position[im, 2]
            g[U + i] = rotation[im, 0, 0] * x + rotation[im, 0, 1] * y + rotation[im, 0, 2] * z
            g[V + i] = rotation[im, 1, 0] * x + rotation[im, 1, 1] * y + rotation[im, 1, 2] * z
            g[W + i] = rotation[im, 2, 0] * x + rotation[im, 2, 1] * y + rotation[im, 2, 2] * z
            g[MX + i], g[MY + i] = pixels[row, 0], pixels[row, 1]
            g[WX + i], g[WY + i] = weights[every * row, 0], weights[every * row, 1]
        if not same:
            held = -1
            for i in range(n):
                for j in range(k):
                    p[j, i] = parameters[camera_of_image[image[first + i]], j]
        elif held != one:
            held = one
            for j in range(k):
                p[j, :] = parameters[one, j]
        for i in range(n):
            inverse = -1.0 / g[W + i]
            g[INVERSE + i], g[XN + i], g[YN + i] = inverse, g[U + i] * inverse, g[V + i] * inverse
            s[X + i], s[Y + i] = g[XN + i], g[YN + i]
        _chain(steps[measured:], places[measured:], slots[measured:], n, p, s, dp)
        # the measured chain at the measured point, or its inverse; (A B; C E) leads from where the chains meet to pixels
        if measured == 0:
            for i in range(n):
                misclosure[to + i, 0] = (g[MX + i] - (s[X + i] * per_x + origin_x)) * g[WX + i]
                misclosure[to + i, 1] = (g[MY + i] - (s[Y + i] * per_y + origin_y)) * g[WY + i]
                s[A + i], s[B + i], s[C + i], s[E + i] = g[WX + i] * per_x, 0.0, 0.0, g[WY + i] * per_y
        elif corrected:
            for i in range(n):
                m[X + i], m[Y + i] = (g[MX + i] - origin_x) * size_x, (g[MY + i] - origin_y) * size_y
            _chain(steps[:measured], places[:measured], slots[:measured], n, p, m, dm)
            for i in range(n):
                a, e = to_pixels[0] * g[WX + i], to_pixels[1] * g[WY + i]
                misclosure[to + i, 0], misclosure[to + i, 1] = (m[X + i] - s[X + i]) * a, (m[Y + i] - s[Y + i]) * e
                s[A + i], s[B + i], s[C + i], s[E + i] = a, 0.0, 0.0, e
        else:
            failed = _invert(steps[:measured], places[:measured], size_x, size_y, origin_x, origin_y, n, p, s, m, g)
            if failed >= 0:
                return first + failed
            for i in range(n):
                misclosure[to + i, 0] = (g[MX + i] - g[BEST_X + i]) * g[WX + i]
                misclosure[to + i, 1] = (g[MY + i] - g[BEST_Y + i]) * g[WY + i]
                m[X + i], m[Y + i] = (g[BEST_X + i] - origin_x) * size_x, (g[BEST_Y + i] - origin_y) * size_y
            if partials:
                _chain(steps[:measured], places[:measured], slots[:measured], n, p, m, dm)
                for i in range(n):
                    det = m[D00 + i] * m[D11 + i] - m[D01 + i] * m[D10 + i]
                    wx, wy = g[WX + i] * per_x / det, g[WY + i] * per_y / det
                    s[A + i], s[B + i], s[C + i], s[E + i] = m[D11 + i] * wx, -m[D01 + i] * wx, -m[D10 + i] * wy, m[D00 + i] * wy
        if not partials:
            continue
        for j in range(kept):
            for i in range(n):
                t0, t1 = dp[j, 0, i] - dm[j, 0, i], dp[j, 1, i] - dm[j, 1, i]
                d_camera[to + i, 0, j] = s[A + i] * t0 + s[B + i] * t1
                d_camera[to + i, 1, j] = s[C + i] * t0 + s[E + i] * t1
        for i in range(n):  # vectorised: what the partials of each row are made of
            a, b, c, e, inverse = s[A + i], s[B + i], s[C + i], s[E + i], g[INVERSE + i]
            d00, d01, d10, d11 = s[D00 + i], s[D01 + i], s[D10 + i], s[D11 + i]
            f0, f1 = (a * d00 + b * d10) * inverse, (a * d01 + b * d11) * inverse
            g0, g1 = (c * d00 + e * d10) * inverse, (c * d01 + e * d11) * inverse
            g[H0 + i], g[H1 + i], g[H2 + i] = f0, f1, f0 * g[XN + i] + f1 * g[YN + i]
            g[H3 + i], g[H4 + i], g[H5 + i] = g0, g1, g0 * g[XN + i] + g1 * g[YN + i]
        for i in range(n):
            im, to_row = np.uint64(image[first + i]), np.uint64(to + i)
            u, v, w = g[U + i], g[V + i], g[W + i]
            m00, m01, m02 = rotation[im, 0, 0], rotation[im, 0, 1], rotation[im, 0, 2]
            m10, m11, m12 = rotation[im, 1, 0], rotation[im, 1, 1], rotation[im, 1, 2]
            m20, m21, m22 = rotation[im, 2, 0], rotation[im, 2, 1], rotation[im, 2, 2]
            for r in range(2):
                h0, h1, h2 = (g[H0 + i], g[H1 + i], g[H2 + i]) if r == 0 else (g[H3 + i], g[H4 + i], g[H5 + i])
                x = h0 * m00 + h1 * m10 + h2 * m20
                y = h0 * m01 + h1 * m11 + h2 * m21
                z = h0 * m02 + h1 * m12 + h2 * m22
                omega, phi, kappa = h2 * v - h1 * w, h0 * w - h2 * u, h1 * u - h0 * v
                d_point[to_row, r, 0], d_point[to_row, r, 1], d_point[to_row, r, 2] = x, y, z
                if whole:
                    d_image[to_row, r, 0], d_image[to_row, r, 1], d_image[to_row, r, 2] = -x, -y, -z
                    d_image[to_row, r, 3], d_image[to_row, r, 4], d_image[to_row, r, 5] = omega, phi, kappa
                else:
                    own[0], own[1], own[2], own[3], own[4], own[5] = -x, -y, -z, omega, phi, kappa
                    for place in range(len(keep_image)):
                        d_image[to_row, r, place] = own[keep_image[place]]
    return -1


@cache
def compiled() -> Any:
    """Return the compiled loop over image points, None without numba."""
    loops = compile_loops((_evaluate,), (_chain, _invert))
    return None if loops is None else loops[0]
