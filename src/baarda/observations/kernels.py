"""Image points, compiled: collinearity equations and the chains of the usual cameras, row by row.

The steps of a camera model are numbered here; a model with a step that has no number is evaluated by its NumPy functions, whose oracle
and twin this is. numba is imported on first use and only here.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import Optics

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

COMPILE_FROM = 60_000  # rows of a group from which the loops are compiled
FLIP, DISTANCE, DISTANCES, TO_CENTRE, FROM_CENTRE, LENS, AFFINITY, OPENCV = range(8)
_NUMBERS = {
    "flip": FLIP,
    "distance": DISTANCE,
    "distances": DISTANCES,
    "to_centre": TO_CENTRE,
    "from_centre": FROM_CENTRE,
    "lens": LENS,
    "affinity": AFFINITY,
}
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


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
            number = OPENCV if step.name.startswith("opencv ") else _NUMBERS.get(step.name)
            if number is None:
                return None
            if number == FLIP and not optics.y_down:
                continue
            columns = optics.model.columns(step)
            own = [-1] * 8
            if number == OPENCV:
                for name, column in zip(step.name.split()[1:], columns, strict=True):
                    own[_COEFFICIENTS.index(name)] = column
            else:
                own[: len(columns)] = columns
            steps.append(number)
            places.append(own)
            measured += k < len(optics.model.measured)
        return Program(np.array(steps, dtype=np.intp), np.array(places, dtype=np.intp).reshape(-1, 8), measured)


def _chain(steps: Ints, places: Ints, begin: int, end: int, xy: Floats, p: Floats, partials: bool, d: Floats, dp: Floats, k: int) -> None:
    """Lead xy (2,) through steps begin ... end; accumulate partials to xy in d (2, 2) and to the parameters in dp (2, k)."""
    d[0, 0] = d[1, 1] = 1.0
    d[0, 1] = d[1, 0] = 0.0
    if partials:
        for j in range(k):
            dp[0, j] = dp[1, j] = 0.0
    for s in range(begin, end):
        step, at = steps[s], places[s]
        x, y = xy[0], xy[1]
        a, b, c, e = 1.0, 0.0, 0.0, 1.0  # partials of the step: (a b; c e)
        if step == FLIP:
            xy[1] = -y
            e = -1.0
        elif step == DISTANCE:
            a = e = p[at[0]]
            xy[0], xy[1] = a * x, a * y
        elif step == DISTANCES:
            a, e = p[at[0]], p[at[1]]
            xy[0], xy[1] = a * x, e * y
        elif step == TO_CENTRE:
            xy[0], xy[1] = x - p[at[0]], y - p[at[1]]
        elif step == FROM_CENTRE:
            xy[0], xy[1] = x + p[at[0]], y + p[at[1]]
        elif step == LENS:
            k1, k2, k3, p1, p2 = p[at[0]], p[at[1]], p[at[2]], p[at[3]], p[at[4]]
            xx, yy, xy2 = x * x, y * y, 2.0 * x * y
            r2 = xx + yy
            radial = r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
            xy[0] = x + x * radial + p1 * (r2 + 2.0 * xx) + p2 * xy2
            xy[1] = y + y * radial + p1 * xy2 + p2 * (r2 + 2.0 * yy)
            a = 1.0 + radial + xx * slope + 6.0 * p1 * x + 2.0 * p2 * y
            e = 1.0 + radial + yy * slope + 2.0 * p1 * x + 6.0 * p2 * y
            b = c = x * y * slope + 2.0 * (p1 * y + p2 * x)
        elif step == AFFINITY:
            b1, b2 = p[at[0]], p[at[1]]
            xy[0] = x + b1 * x + b2 * y
            a, b = 1.0 + b1, b2
        else:
            k1 = p[at[0]] if at[0] >= 0 else 0.0
            k2 = p[at[1]] if at[1] >= 0 else 0.0
            k3 = p[at[2]] if at[2] >= 0 else 0.0
            k4 = p[at[3]] if at[3] >= 0 else 0.0
            k5 = p[at[4]] if at[4] >= 0 else 0.0
            k6 = p[at[5]] if at[5] >= 0 else 0.0
            p1 = p[at[6]] if at[6] >= 0 else 0.0
            p2 = p[at[7]] if at[7] >= 0 else 0.0
            xx, yy, xy2 = x * x, y * y, 2.0 * x * y
            r2 = xx + yy
            lower = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
            ratio = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / lower
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - ratio * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / lower
            xy[0] = x * ratio + p1 * xy2 + p2 * (r2 + 2.0 * xx)
            xy[1] = y * ratio + p1 * (r2 + 2.0 * yy) + p2 * xy2
            a = ratio + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
            e = ratio + yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
            b = c = x * y * slope + 2.0 * (p1 * x + p2 * y)
        d[0, 0], d[1, 0] = a * d[0, 0] + b * d[1, 0], c * d[0, 0] + e * d[1, 0]
        d[0, 1], d[1, 1] = a * d[0, 1] + b * d[1, 1], c * d[0, 1] + e * d[1, 1]
        if not partials:
            continue
        for j in range(k):
            dp[0, j], dp[1, j] = a * dp[0, j] + b * dp[1, j], c * dp[0, j] + e * dp[1, j]
        if step == DISTANCE:
            dp[0, at[0]] += x
            dp[1, at[0]] += y
        elif step == DISTANCES:
            dp[0, at[0]] += x
            dp[1, at[1]] += y
        elif step == TO_CENTRE:
            dp[0, at[0]] -= 1.0
            dp[1, at[1]] -= 1.0
        elif step == FROM_CENTRE:
            dp[0, at[0]] += 1.0
            dp[1, at[1]] += 1.0
        elif step == LENS:
            power = r2
            for j in range(3):
                dp[0, at[j]] += x * power
                dp[1, at[j]] += y * power
                power *= r2
            dp[0, at[3]] += r2 + 2.0 * xx
            dp[1, at[3]] += xy2
            dp[0, at[4]] += xy2
            dp[1, at[4]] += r2 + 2.0 * yy
        elif step == AFFINITY:
            dp[0, at[0]] += x
            dp[0, at[1]] += y
        elif step == OPENCV:
            power = r2 / lower
            for j in range(3):
                if at[j] >= 0:
                    dp[0, at[j]] += x * power
                    dp[1, at[j]] += y * power
                if at[j + 3] >= 0:
                    dp[0, at[j + 3]] -= x * power * ratio
                    dp[1, at[j + 3]] -= y * power * ratio
                power *= r2
            if at[6] >= 0:
                dp[0, at[6]] += xy2
                dp[1, at[6]] += r2 + 2.0 * yy
            if at[7] >= 0:
                dp[0, at[7]] += r2 + 2.0 * xx
                dp[1, at[7]] += xy2


def _evaluate(
    steps: Ints, places: Ints, measured: int, corrected: bool, to_pixels: Floats, pixel_size: Floats, origin: Floats,
    parameters: Floats, rotation: Floats, position: Floats, points: Floats, camera: Ints, image: Ints, point: Ints, pixels: Floats,
    partials: bool, weights: Floats, keep_camera: Ints, keep_image: Ints, misclosure: Floats, d_camera: Floats, d_image: Floats,
    d_point: Floats,
) -> int:  # fmt: skip
    """Fill the misclosures (n, 2) and partials of image points, each times its weight, of the parameters to keep.

    Returns the first row whose distortion could not be inverted, or -1.
    """
    k = parameters.shape[1]
    own = np.empty(6)
    d, dm = np.empty((2, 2)), np.empty((2, 2))
    dp, dmp = np.zeros((2, k)), np.zeros((2, k))
    target, xy = np.empty(2), np.empty(2)
    h = np.empty((2, 3))
    for i in range(len(pixels)):
        p = parameters[camera[i]]
        m = rotation[image[i]]
        x = points[point[i], 0] - position[image[i], 0]
        y = points[point[i], 1] - position[image[i], 1]
        z = points[point[i], 2] - position[image[i], 2]
        u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
        v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
        xn, yn = -u / w, -v / w
        target[0], target[1] = xn, yn
        _chain(steps, places, measured, len(steps), target, p, partials, d, dp, k)
        # the measured chain at the measured point, or its inverse
        px, py = pixels[i, 0], pixels[i, 1]
        if measured == 0:
            misclosure[i, 0] = px - (target[0] / pixel_size[0] + origin[0])
            misclosure[i, 1] = py - (target[1] / pixel_size[1] + origin[1])
            a, e = 1.0 / pixel_size[0], 1.0 / pixel_size[1]
            b = c = 0.0
        elif corrected:
            xy[0], xy[1] = (px - origin[0]) * pixel_size[0], (py - origin[1]) * pixel_size[1]
            _chain(steps, places, 0, measured, xy, p, partials, dm, dmp, k)
            misclosure[i, 0] = (xy[0] - target[0]) * to_pixels[0]
            misclosure[i, 1] = (xy[1] - target[1]) * to_pixels[1]
            a, e = to_pixels[0], to_pixels[1]
            b = c = 0.0
        else:
            least, done = np.inf, False
            bx, by = px, py
            for _ in range(50):
                xy[0], xy[1] = (px - origin[0]) * pixel_size[0], (py - origin[1]) * pixel_size[1]
                _chain(steps, places, 0, measured, xy, p, False, dm, dmp, k)
                rx, ry = target[0] - xy[0], target[1] - xy[1]
                misfit = np.sqrt(rx * rx + ry * ry)
                size = np.sqrt(target[0] ** 2 + target[1] ** 2) + np.sqrt(xy[0] ** 2 + xy[1] ** 2) + 1e-300
                if not misfit < least:  # rounding is reached, or no descent is left
                    done = least <= 1e-13 * size
                    break
                least, bx, by = misfit, px, py
                if misfit <= 4e-16 * size:
                    done = True
                    break
                det = dm[0, 0] * dm[1, 1] - dm[0, 1] * dm[1, 0]
                px += (dm[1, 1] * rx - dm[0, 1] * ry) / det / pixel_size[0]
                py += (dm[0, 0] * ry - dm[1, 0] * rx) / det / pixel_size[1]
            if not done:
                return i
            px, py = bx, by
            misclosure[i, 0], misclosure[i, 1] = pixels[i, 0] - px, pixels[i, 1] - py
            if partials:
                xy[0], xy[1] = (px - origin[0]) * pixel_size[0], (py - origin[1]) * pixel_size[1]
                _chain(steps, places, 0, measured, xy, p, True, dm, dmp, k)
            det = dm[0, 0] * dm[1, 1] - dm[0, 1] * dm[1, 0]
            a, b = dm[1, 1] / det / pixel_size[0], -dm[0, 1] / det / pixel_size[0]
            c, e = -dm[1, 0] / det / pixel_size[1], dm[0, 0] / det / pixel_size[1]
        misclosure[i, 0] *= weights[i, 0]
        misclosure[i, 1] *= weights[i, 1]
        if not partials:
            continue
        for place in range(len(keep_camera)):
            j = keep_camera[place]
            t0, t1 = dp[0, j] - dmp[0, j], dp[1, j] - dmp[1, j]
            d_camera[i, 0, place] = (a * t0 + b * t1) * weights[i, 0]
            d_camera[i, 1, place] = (c * t0 + e * t1) * weights[i, 1]
        for r in range(2):
            f0 = a * d[0, 0] + b * d[1, 0] if r == 0 else c * d[0, 0] + e * d[1, 0]
            f1 = a * d[0, 1] + b * d[1, 1] if r == 0 else c * d[0, 1] + e * d[1, 1]
            f0, f1 = f0 * weights[i, r], f1 * weights[i, r]
            h[r, 0], h[r, 1], h[r, 2] = -f0 / w, -f1 / w, -(f0 * xn + f1 * yn) / w
            for j in range(3):
                value = h[r, 0] * m[0, j] + h[r, 1] * m[1, j] + h[r, 2] * m[2, j]
                d_point[i, r, j] = value
                own[j] = -value
            own[3] = h[r, 2] * v - h[r, 1] * w
            own[4] = h[r, 0] * w - h[r, 2] * u
            own[5] = h[r, 1] * u - h[r, 0] * v
            for place in range(len(keep_image)):
                d_image[i, r, place] = own[keep_image[place]]
    return -1


@cache
def compiled() -> Any:
    """Return the compiled loop over image points, None without numba."""
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        return None
    global _chain
    original = _chain
    for cached in (True, False):  # no place to write the cache
        try:
            _chain = numba.njit(nogil=True, cache=cached, error_model="numpy")(original)
            return numba.njit(nogil=True, cache=cached, error_model="numpy")(_evaluate)
        except RuntimeError:
            continue
    return None
