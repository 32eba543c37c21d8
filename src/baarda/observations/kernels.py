"""Image points, compiled: collinearity equations and the chains of the usual cameras, row by row.

The steps of a camera model are numbered here; a model with a step that has no number is evaluated by its NumPy functions, whose oracle
and twin this is.
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


def _chain(
    steps: Ints, places: Ints, begin: int, end: int, x: float, y: float, parameters: Floats, camera: int, partials: bool, dp: Floats
) -> tuple[float, float, float, float, float, float]:
    """Lead a point through steps begin ... end of a camera (a row of the table of parameters).

    Returned are the new point and the partials (d00 d01; d10 d11) to the old one; those to the parameters are accumulated in dp (2, k).
    """
    d00, d01, d10, d11 = 1.0, 0.0, 0.0, 1.0
    if partials:
        for j in range(parameters.shape[1]):
            dp[0, j] = dp[1, j] = 0.0
    used = False  # whether dp holds anything yet
    for s in range(begin, end):
        step = steps[s]
        a, b, c, e = 1.0, 0.0, 0.0, 1.0  # partials of the step: (a b; c e)
        x0, y0 = x, y
        r2 = xx = yy = xy2 = ratio = lower = 0.0
        if step == FLIP:
            y = -y0
            e = -1.0
        elif step == DISTANCE:
            a = e = parameters[camera, places[s, 0]]
            x, y = a * x0, a * y0
        elif step == DISTANCES:
            a, e = parameters[camera, places[s, 0]], parameters[camera, places[s, 1]]
            x, y = a * x0, e * y0
        elif step == TO_CENTRE:
            x, y = x0 - parameters[camera, places[s, 0]], y0 - parameters[camera, places[s, 1]]
        elif step == FROM_CENTRE:
            x, y = x0 + parameters[camera, places[s, 0]], y0 + parameters[camera, places[s, 1]]
        elif step == LENS:
            k1, k2, k3 = parameters[camera, places[s, 0]], parameters[camera, places[s, 1]], parameters[camera, places[s, 2]]
            p1, p2 = parameters[camera, places[s, 3]], parameters[camera, places[s, 4]]
            xx, yy, xy2 = x0 * x0, y0 * y0, 2.0 * x0 * y0
            r2 = xx + yy
            radial = r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
            x = x0 + x0 * radial + p1 * (r2 + 2.0 * xx) + p2 * xy2
            y = y0 + y0 * radial + p1 * xy2 + p2 * (r2 + 2.0 * yy)
            a = 1.0 + radial + xx * slope + 6.0 * p1 * x0 + 2.0 * p2 * y0
            e = 1.0 + radial + yy * slope + 2.0 * p1 * x0 + 6.0 * p2 * y0
            b = c = x0 * y0 * slope + 2.0 * (p1 * y0 + p2 * x0)
        elif step == AFFINITY:
            b1, b2 = parameters[camera, places[s, 0]], parameters[camera, places[s, 1]]
            x = x0 + b1 * x0 + b2 * y0
            a, b = 1.0 + b1, b2
        else:
            k1 = parameters[camera, places[s, 0]] if places[s, 0] >= 0 else 0.0
            k2 = parameters[camera, places[s, 1]] if places[s, 1] >= 0 else 0.0
            k3 = parameters[camera, places[s, 2]] if places[s, 2] >= 0 else 0.0
            k4 = parameters[camera, places[s, 3]] if places[s, 3] >= 0 else 0.0
            k5 = parameters[camera, places[s, 4]] if places[s, 4] >= 0 else 0.0
            k6 = parameters[camera, places[s, 5]] if places[s, 5] >= 0 else 0.0
            p1 = parameters[camera, places[s, 6]] if places[s, 6] >= 0 else 0.0
            p2 = parameters[camera, places[s, 7]] if places[s, 7] >= 0 else 0.0
            xx, yy, xy2 = x0 * x0, y0 * y0, 2.0 * x0 * y0
            r2 = xx + yy
            lower = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
            ratio = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / lower
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - ratio * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / lower
            x = x0 * ratio + p1 * xy2 + p2 * (r2 + 2.0 * xx)
            y = y0 * ratio + p1 * (r2 + 2.0 * yy) + p2 * xy2
            a = ratio + xx * slope + 2.0 * p1 * y0 + 6.0 * p2 * x0
            e = ratio + yy * slope + 6.0 * p1 * y0 + 2.0 * p2 * x0
            b = c = x0 * y0 * slope + 2.0 * (p1 * x0 + p2 * y0)
        d00, d10 = a * d00 + b * d10, c * d00 + e * d10
        d01, d11 = a * d01 + b * d11, c * d01 + e * d11
        if not partials:
            continue
        if used and step != TO_CENTRE and step != FROM_CENTRE:
            for j in range(parameters.shape[1]):
                dp[0, j], dp[1, j] = a * dp[0, j] + b * dp[1, j], c * dp[0, j] + e * dp[1, j]
        used = used or step != FLIP
        if step == DISTANCE:
            dp[0, places[s, 0]] += x0
            dp[1, places[s, 0]] += y0
        elif step == DISTANCES:
            dp[0, places[s, 0]] += x0
            dp[1, places[s, 1]] += y0
        elif step == TO_CENTRE:
            dp[0, places[s, 0]] -= 1.0
            dp[1, places[s, 1]] -= 1.0
        elif step == FROM_CENTRE:
            dp[0, places[s, 0]] += 1.0
            dp[1, places[s, 1]] += 1.0
        elif step == LENS:
            power = r2
            for j in range(3):
                dp[0, places[s, j]] += x0 * power
                dp[1, places[s, j]] += y0 * power
                power *= r2
            dp[0, places[s, 3]] += r2 + 2.0 * xx
            dp[1, places[s, 3]] += xy2
            dp[0, places[s, 4]] += xy2
            dp[1, places[s, 4]] += r2 + 2.0 * yy
        elif step == AFFINITY:
            dp[0, places[s, 0]] += x0
            dp[0, places[s, 1]] += y0
        elif step == OPENCV:
            power = r2 / lower
            for j in range(3):
                if places[s, j] >= 0:
                    dp[0, places[s, j]] += x0 * power
                    dp[1, places[s, j]] += y0 * power
                if places[s, j + 3] >= 0:
                    dp[0, places[s, j + 3]] -= x0 * power * ratio
                    dp[1, places[s, j + 3]] -= y0 * power * ratio
                power *= r2
            if places[s, 6] >= 0:
                dp[0, places[s, 6]] += xy2
                dp[1, places[s, 6]] += r2 + 2.0 * yy
            if places[s, 7] >= 0:
                dp[0, places[s, 7]] += r2 + 2.0 * xx
                dp[1, places[s, 7]] += xy2
    return x, y, d00, d01, d10, d11


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
    dp, dmp = np.zeros((2, k)), np.zeros((2, k))
    size_x, size_y, origin_x, origin_y = pixel_size[0], pixel_size[1], origin[0], origin[1]
    for i in range(len(pixels)):
        cam, im, pt = camera[i], image[i], point[i]
        m00, m01, m02 = rotation[im, 0, 0], rotation[im, 0, 1], rotation[im, 0, 2]
        m10, m11, m12 = rotation[im, 1, 0], rotation[im, 1, 1], rotation[im, 1, 2]
        m20, m21, m22 = rotation[im, 2, 0], rotation[im, 2, 1], rotation[im, 2, 2]
        x, y, z = points[pt, 0] - position[im, 0], points[pt, 1] - position[im, 1], points[pt, 2] - position[im, 2]
        u = m00 * x + m01 * y + m02 * z
        v = m10 * x + m11 * y + m12 * z
        w = m20 * x + m21 * y + m22 * z
        xn, yn = -u / w, -v / w
        tx, ty, d00, d01, d10, d11 = _chain(steps, places, measured, len(steps), xn, yn, parameters, cam, partials, dp)
        # the measured chain at the measured point, or its inverse
        px, py = pixels[i, 0], pixels[i, 1]
        if measured == 0:
            misclosure[i, 0] = (px - (tx / size_x + origin_x)) * weights[i, 0]
            misclosure[i, 1] = (py - (ty / size_y + origin_y)) * weights[i, 1]
            a, e = 1.0 / size_x, 1.0 / size_y
            b = c = 0.0
        elif corrected:
            gx, gy, _, _, _, _ = _chain(
                steps, places, 0, measured, (px - origin_x) * size_x, (py - origin_y) * size_y, parameters, cam, partials, dmp
            )
            misclosure[i, 0] = (gx - tx) * to_pixels[0] * weights[i, 0]
            misclosure[i, 1] = (gy - ty) * to_pixels[1] * weights[i, 1]
            a, e = to_pixels[0], to_pixels[1]
            b = c = 0.0
        else:
            least, done = np.inf, False
            bx, by = px, py
            q00, q01, q10, q11 = 1.0, 0.0, 0.0, 1.0
            for _ in range(50):
                gx, gy, q00, q01, q10, q11 = _chain(
                    steps, places, 0, measured, (px - origin_x) * size_x, (py - origin_y) * size_y, parameters, cam, False, dmp
                )
                rx, ry = tx - gx, ty - gy
                misfit = np.sqrt(rx * rx + ry * ry)
                size = np.sqrt(tx * tx + ty * ty) + np.sqrt(gx * gx + gy * gy) + 1e-300
                if not misfit < least:  # rounding is reached, or no descent is left
                    done = least <= 1e-13 * size
                    break
                least, bx, by = misfit, px, py
                if misfit <= 4e-16 * size:
                    done = True
                    break
                det = q00 * q11 - q01 * q10
                px += (q11 * rx - q01 * ry) / det / size_x
                py += (q00 * ry - q10 * rx) / det / size_y
            if not done:
                return i
            misclosure[i, 0], misclosure[i, 1] = (pixels[i, 0] - bx) * weights[i, 0], (pixels[i, 1] - by) * weights[i, 1]
            if partials:
                _, _, q00, q01, q10, q11 = _chain(
                    steps, places, 0, measured, (bx - origin_x) * size_x, (by - origin_y) * size_y, parameters, cam, True, dmp
                )
            det = q00 * q11 - q01 * q10
            a, b = q11 / det / size_x, -q01 / det / size_x
            c, e = -q10 / det / size_y, q00 / det / size_y
        if not partials:
            continue
        wx, wy = weights[i, 0], weights[i, 1]
        for place in range(len(keep_camera)):
            j = keep_camera[place]
            t0, t1 = dp[0, j] - dmp[0, j], dp[1, j] - dmp[1, j]
            d_camera[i, 0, place] = (a * t0 + b * t1) * wx
            d_camera[i, 1, place] = (c * t0 + e * t1) * wy
        for r in range(2):
            f0 = (a * d00 + b * d10) * wx if r == 0 else (c * d00 + e * d10) * wy
            f1 = (a * d01 + b * d11) * wx if r == 0 else (c * d01 + e * d11) * wy
            h0, h1, h2 = -f0 / w, -f1 / w, -(f0 * xn + f1 * yn) / w
            p0, p1, p2 = h0 * m00 + h1 * m10 + h2 * m20, h0 * m01 + h1 * m11 + h2 * m21, h0 * m02 + h1 * m12 + h2 * m22
            d_point[i, r, 0], d_point[i, r, 1], d_point[i, r, 2] = p0, p1, p2
            own[0], own[1], own[2] = -p0, -p1, -p2
            own[3], own[4], own[5] = h2 * v - h1 * w, h0 * w - h2 * u, h1 * u - h0 * v
            for place in range(len(keep_image)):
                d_image[i, r, place] = own[keep_image[place]]
    return -1


@cache
def compiled() -> Any:
    """Return the compiled loop over image points, None without numba."""
    loops = compile_loops((_evaluate,), (_chain,))
    return None if loops is None else loops[0]
