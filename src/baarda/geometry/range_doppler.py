"""Range and Doppler equations of a radar image: slant range and squint angle from a moving antenna to an object point.

At time s the antenna stands at P(s), moves with P'(s), and sees a point X at the slant range R = |X - P| where the unit velocity u makes
u . (X - P) = R sin(squint). The image coordinate across the track is r = (R - delay) / spacing. Wu, Liu & Lin, ISPRS XXXIII B1 (2000)
348-351, eqs. 1 to 4; Leberl, Radargrammetric Image Processing (1990), chapter 4. Nothing here depends on the units: those of the object
space for lengths, any for time.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import Singular, UsageError
from baarda.geometry.ellipsoid_height import ellipsoid_height

Floats = NDArray[np.float64]
Side = Literal["left", "right"]


class Antenna(NamedTuple):
    """Position, velocity and acceleration at some times, (n, 3) each."""

    position: Floats
    velocity: Floats
    acceleration: Floats


class Partials(NamedTuple):
    """Partials of the two conditions (range, Doppler), each (n, 2, ...).

    `observed` is with respect to time and image coordinate r, `points` X Y Z, `coefficients` (n, 2, 3, p + 1) those of the polynomials,
    `squint` (n, 2, q + 1) those of the squint angle, `spacing` and `delay` (n, 2).
    """

    observed: Floats
    points: Floats
    coefficients: Floats
    squint: Floats
    spacing: Floats
    delay: Floats


def powers(s: Any, order: int, derivative: int = 0) -> Any:
    """Return s^k for k = 0 ... order, or a derivative of it, (n, order + 1).

    Examples
    --------
    >>> powers(np.array([2.0]), 3, 1)
    array([[ 0., 1., 4., 12.]])
    """
    k = np.arange(order + 1)
    factor = np.ones(order + 1)
    for j in range(derivative):
        factor = factor * (k - j)
    return factor * s[:, None] ** np.maximum(k - derivative, 0)


def antenna(coefficients: Any, s: Any) -> Antenna:
    """Return the state of the antenna.

    Parameters
    ----------
    coefficients : (n, 3, p + 1) array
        Polynomials of X, Y and Z in time, lowest power first.
    s : (n,) array
        Time from the origin of the polynomials.

    Returns
    -------
    Antenna

    Notes
    -----
    Wu, Liu & Lin (2000), eq. 4.

    Examples
    --------
    >>> antenna(np.array([[[1.0, 2.0], [0.0, 0.0], [5.0, 0.0]]]), np.array([3.0])).position
    array([[7., 0., 5.]])
    """
    order = coefficients.shape[2] - 1
    return Antenna(*(np.einsum("nak,nk->na", coefficients, powers(s, order, d)) for d in range(3)))


def _norm(v: Any) -> Any:
    return np.sqrt(np.sum(v * v, axis=-1))


def conditions(points: Any, coefficients: Any, squint: Any, spacing: Any, delay: Any, s: Any, r: Any) -> Any:
    """Return by how much points and image coordinates miss the range and the Doppler equation, in object units.

    Parameters
    ----------
    points : (n, 3) array
    coefficients : (n, 3, p + 1) array
    squint : (n, q + 1) array
        Polynomial of the squint angle in time, radians.
    spacing, delay : (n,) arrays
        Slant range of one pixel, and of the first one.
    s, r : (n,) arrays
        Time and image coordinate across the track.

    Returns
    -------
    (n, 2) array
        R - spacing r - delay, and u . (X - P) - R sin(squint).

    Notes
    -----
    Wu, Liu & Lin (2000), eqs. 1 to 3.

    Examples
    --------
    >>> flight = np.array([[[0.0, 0.0], [0.0, 100.0], [3000.0, 0.0]]])
    >>> one = np.ones(1)
    >>> conditions(np.array([[4000.0, 200.0, 0.0]]), flight, np.zeros((1, 1)), 4.0 * one, 1000.0 * one, 2.0 * one, 1000.0 * one)
    array([[0., 0.]])
    """
    a = antenna(coefficients, s)
    d = points - a.position
    distance = _norm(d)
    angle = np.einsum("nk,nk->n", squint, powers(s, squint.shape[1] - 1))
    along = np.sum(a.velocity * d, axis=1) / _norm(a.velocity)
    return np.stack([distance - spacing * r - delay, along - distance * np.sin(angle)], axis=1)


def partials(points: Floats, coefficients: Floats, squint: Floats, spacing: Floats, delay: Floats, s: Floats, r: Floats) -> Partials:
    """Return the partials of `conditions`, whose arguments it takes."""
    order, n = coefficients.shape[2] - 1, len(s)
    a = antenna(coefficients, s)
    d = points - a.position
    distance, speed = _norm(d), _norm(a.velocity)
    e, u = d / distance[:, None], a.velocity / speed[:, None]
    turn = powers(s, squint.shape[1] - 1)
    angle = np.einsum("nk,nk->n", squint, turn)
    rate = np.einsum("nk,nk->n", squint, powers(s, squint.shape[1] - 1, 1))
    to_point = np.stack([e, u - np.sin(angle)[:, None] * e], axis=1)
    # u . d changes with the direction of flight by what of d is across it
    to_velocity = (d - np.sum(u * d, axis=1)[:, None] * u) / speed[:, None]
    arm = distance * np.cos(angle)
    observed = np.zeros((n, 2, 2))
    observed[:, :, 0] = -np.einsum("nca,na->nc", to_point, a.velocity)
    observed[:, 1, 0] += np.sum(to_velocity * a.acceleration, axis=1) - arm * rate
    observed[:, 0, 1] = -spacing
    to_coefficients = -to_point[:, :, :, None] * powers(s, order)[:, None, None, :]
    to_coefficients[:, 1] += to_velocity[:, :, None] * powers(s, order, 1)[:, None, :]
    to_squint = np.zeros((n, 2, squint.shape[1]))
    to_squint[:, 1] = -arm[:, None] * turn
    to_spacing, to_delay = np.zeros((n, 2)), np.zeros((n, 2))
    to_spacing[:, 0], to_delay[:, 0] = -r, -1.0
    return Partials(observed, to_point, to_coefficients, to_squint, to_spacing, to_delay)


def project(
    points: Floats, coefficients: Floats, squint: Floats, spacing: Floats, delay: Floats, start: Floats, steps: int = 50
) -> tuple[Floats, Floats]:
    """Return when the antenna sees points, and where across the track.

    Parameters
    ----------
    points, coefficients, squint, spacing, delay : arrays
        See `conditions`.
    start : (n,) array
        Time to start from.
    steps : int
        Limit of the Newton steps.

    Returns
    -------
    s, r : (n,) arrays
        Time and image coordinate; NaN where the Doppler equation has no root that is reached.

    Examples
    --------
    >>> flight = np.array([[[0.0, 0.0], [0.0, 100.0], [3000.0, 0.0]]])
    >>> one = np.ones(1)
    >>> project(np.array([[4000.0, 200.0, 0.0]]), flight, np.zeros((1, 1)), 4.0 * one, 1000.0 * one, 0.0 * one)
    (array([2.]), array([1000.]))
    """
    s = np.array(start, dtype=float)
    last = np.full(len(s), np.inf)
    moving = np.ones(len(s), dtype=bool)
    zero = np.zeros(len(s))
    with np.errstate(all="ignore"):
        for _ in range(steps):
            doppler = conditions(points, coefficients, squint, spacing, delay, s, zero)[:, 1]
            step = -doppler / partials(points, coefficients, squint, spacing, delay, s, zero).observed[:, 1, 0]
            # rounding is reached where steps no longer shrink
            moving &= ~((np.abs(step) >= 0.5 * last) & (np.abs(step) <= 1e-9 * (np.abs(s) + np.abs(start) + 1.0)))
            if not moving.any():
                break
            s = np.where(moving, s + step, s)
            last = np.where(moving, np.abs(step), last)
        distance = _norm(points - antenna(coefficients, s).position)
    good = np.isfinite(s) & (~moving | (last <= 1e-9 * (np.abs(s) + np.abs(start) + 1.0)))
    return np.where(good, s, np.nan), np.where(good, (distance - delay) / spacing, np.nan)


def intersect_height(position: ArrayLike, velocity: ArrayLike, squint: ArrayLike, distance: ArrayLike, height: ArrayLike) -> Floats:
    """Intersect one range circle with a horizontal plane: the points left and right of the flight.

    Parameters
    ----------
    position, velocity : (n, 3) array_like
        Of the antenna; the Z axis is the vertical.
    squint, distance, height : (n,) array_like
        Squint angle (radians), slant range, and given height of the point.

    Returns
    -------
    (n, 2, 3) array
        The point to the left, and that to the right; NaN where the circle does not reach the plane.

    Notes
    -----
    Range, squint and height have two solutions, mirrored at the vertical plane of the flight; which one was seen is not in them.

    Examples
    --------
    >>> intersect_height([[0, 0, 3000]], [[0, 100, 0]], [0.0], [5000.0], [0.0])[0].tolist()
    [[-4000.0, 0.0, 0.0], [4000.0, 0.0, 0.0]]
    """
    p, v = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
    rho, angle, z = (np.asarray(a, dtype=float) for a in (distance, squint, height))
    u = v / _norm(v)[:, None]
    level = np.hypot(u[:, 0], u[:, 1])
    h = z - p[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = (rho * np.sin(angle) - u[:, 2] * h) / level
        aside = np.sqrt(rho**2 - h**2 - ahead**2)
        forward = u[:, :2] / level[:, None]
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    out = np.empty((len(p), 2, 3))
    out[:, :, 2] = z[:, None]
    for k, sign in enumerate((1.0, -1.0)):
        out[:, k, :2] = p[:, :2] + ahead[:, None] * forward + sign * aside[:, None] * left
    return np.where(np.isfinite(out).all(axis=2, keepdims=True), out, np.nan)


def intersect_ellipsoid(position: ArrayLike, velocity: ArrayLike, squint: ArrayLike, distance: ArrayLike, height: ArrayLike) -> Floats:
    """Intersect one range circle with a surface of constant height above the ellipsoid: the points left and right of the flight.

    Parameters
    ----------
    position, velocity : (n, 3) array_like
        Of the antenna, geocentric, m and m per unit of time.
    squint, distance, height : (n,) array_like
        Squint angle (radians), slant range, and given height of the point above the ellipsoid of WGS 84, m.

    Returns
    -------
    (n, 2, 3) array
        The point to the left, and that to the right, seen from above; NaN where the circle does not reach the surface.

    Notes
    -----
    Closed form on the sphere through the foot of the antenna, then Newton steps on range, Doppler and height. Like `intersect_height`, it
    cannot tell left from right.

    Examples
    --------
    >>> found = intersect_ellipsoid([[7e6, 0, 0]], [[0, 0, 7000.0]], [0.0], [8e5], [0.0])[0]
    >>> found[:, 1].round(-3).tolist()
    [-480000.0, 480000.0]
    """
    p, v = np.asarray(position, dtype=float).reshape(-1, 3), np.asarray(velocity, dtype=float).reshape(-1, 3)
    rho, angle, h = (np.asarray(a, dtype=float).reshape(-1) for a in (distance, squint, height))
    u, above = v / _norm(v)[:, None], _norm(p)
    foot = above - ellipsoid_height(p)[0]  # radius of the ellipsoid below the antenna, nearly
    up = p / above[:, None]
    side = np.cross(up, u)
    with np.errstate(invalid="ignore", divide="ignore"):
        side = side / _norm(side)[:, None]
        along = np.cross(side, up)  # level, forwards
        down = ((foot + h) ** 2 - above**2 - rho**2) / (2.0 * above)
        ahead = (rho * np.sin(angle) - np.sum(u * up, axis=1) * down) / np.sum(u * along, axis=1)
        aside = np.sqrt(rho**2 - down**2 - ahead**2)
    out = np.empty((len(p), 2, 3))
    for k, sign in enumerate((1.0, -1.0)):
        x = p + down[:, None] * up + ahead[:, None] * along + sign * aside[:, None] * side
        for _ in range(8):  # from the sphere, Newton's steps double the digits
            good = np.flatnonzero(np.isfinite(x).all(axis=1))
            d = x[good] - p[good]
            reach, sine = _norm(d), np.sin(angle[good])
            found, normal = ellipsoid_height(x[good])
            misfit = np.stack([reach - rho[good], np.sum(u[good] * d, axis=1) - reach * sine, found - h[good]], axis=1)
            e = d / reach[:, None]
            a = np.stack([e, u[good] - sine[:, None] * e, normal], axis=1)
            crosses = np.abs(np.linalg.det(a)) > 1e-12
            x[good[~crosses]] = np.nan  # the circle touches the surface
            x[good[crosses]] -= np.linalg.solve(a[crosses], misfit[crosses][:, :, None])[:, :, 0]
        out[:, k] = x
    return np.where(np.isfinite(out).all(axis=2, keepdims=True), out, np.nan)


def intersect_ranges(position: Floats, velocity: Floats, squint: Floats, distance: Floats, start: Floats, steps: int = 50) -> Floats:
    """Intersect the range circles of one point from two or more antenna positions.

    Parameters
    ----------
    position, velocity : (k, 3) array
        k >= 2 antennas.
    squint, distance : (k,) array
    start : (3,) array
        Near the point that was seen: from parallel tracks a second one, mirrored, has the same ranges.

    Returns
    -------
    (3,) array

    Raises
    ------
    Singular
        If the circles do not determine a point, or do not meet from here.

    Examples
    --------
    >>> p, v = np.array([[0.0, 0, 3000], [8000, 0, 3000]]), np.array([[0.0, 100, 0], [0, 100, 0]])
    >>> intersect_ranges(p, v, np.zeros(2), np.array([5000.0, 5000]), np.array([4100.0, 10, 50]))
    array([4.e+03, 0.e+00, 0.e+00])
    """
    u = velocity / _norm(velocity)[:, None]
    x, last = np.array(start, dtype=float), np.inf
    for _ in range(steps):
        d = x - position
        length = _norm(d)
        e = d / length[:, None]
        misfit = np.concatenate([length - distance, np.sum(u * d, axis=1) - length * np.sin(squint)])
        a = np.concatenate([e, u - np.sin(squint)[:, None] * e])
        step, _, rank, _ = np.linalg.lstsq(a, -misfit, rcond=1e-9)
        if rank < 3 or not np.isfinite(step).all():
            break
        size = float(np.linalg.norm(step))
        x = x + step
        if size <= 1e-14 * float(length.max()) or (size >= 0.5 * last and size <= 1e-7 * float(length.max())):
            return np.asarray(x, dtype=float)
        last = size
    raise Singular("the ranges do not determine the point (tracks that see it from the same direction, or a start on the wrong side)")


class Flight(NamedTuple):
    """A straight flight that fits control: position (3,) at s = 0, velocity (3,), pixel spacing, and on which side the points lie."""

    position: Floats
    velocity: Floats
    spacing: float
    side: Side


def flight_from_control(points: ArrayLike, s: ArrayLike, r: ArrayLike, delay: float = 0.0) -> Flight:
    """Find a straight level flight, looking across its track, from control points alone.

    Parameters
    ----------
    points : (n, 3) array_like
        Control points, n >= 5; the Z axis is the vertical.
    s, r : (n,) array_like
        Measured time and image coordinate across the track.
    delay : float
        Slant range of r = 0.

    Returns
    -------
    Flight
        A start for the adjustment. The side follows from the control points: their ranges grow away from the track.

    Raises
    ------
    UsageError
        If there are fewer than five points.
    Singular
        If the points do not determine the flight: they lie on a line along or across it.

    Notes
    -----
    Time is linear in the horizontal position along the flight. With y across it and the delay known, (spacing r + delay)^2 =
    (y - y0)^2 + (Z - H)^2 is linear in y0 and y0^2 + H^2; the spacing is searched, and the term 2 H Z is taken from the step before, since
    low relief determines H only through the constant term.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(4000.0, 9000.0, 3), [0.0, 500.0, 900.0])
    >>> points = np.stack([x.ravel(), y.ravel(), np.tile([0.0, 50.0, 20.0], 3)], axis=1)
    >>> ranges = np.hypot(points[:, 0] - 100.0, points[:, 2] - 3000.0)
    >>> found = flight_from_control(points, points[:, 1] / 100.0, (ranges - 1000.0) / 4.0, 1000.0)
    >>> found.position.round(3), found.velocity.round(6) + 0.0, round(found.spacing, 9), found.side
    (array([ 100., 0., 3000.]), array([ 0., 100., 0.]), 4.0, 'right')
    """
    x, t, pixel = (np.asarray(a, dtype=float) for a in (points, s, r))
    if x.ndim != 2 or x.shape[1] != 3 or t.shape != (len(x),) or pixel.shape != (len(x),):
        raise UsageError(f"control of shape {x.shape}, times {t.shape} and ranges {pixel.shape} do not belong together")
    if len(x) < 5:
        raise UsageError(f"a flight needs at least 5 control points, there are {len(x)}")
    if not (np.isfinite(x).all() and np.isfinite(t).all() and np.isfinite(pixel).all()):
        raise UsageError("control points and their image coordinates must be finite numbers")
    centre = x.mean(axis=0)
    d = x - centre
    spread = np.linalg.svd(d[:, :2], compute_uv=False)
    if spread[1] <= 1e-6 * spread[0]:
        raise Singular("the control points lie on one line in plan: they do not determine the flight")
    (gx, gy, first), *_ = np.linalg.lstsq(np.column_stack([d[:, :2], np.ones(len(d))]), t, rcond=None)
    slope = float(np.hypot(gx, gy))
    if slope * spread[0] <= 1e-9 * float(np.abs(t).max()):
        raise Singular("time does not grow along the control points: they do not determine the flight")
    forward = np.array([gx, gy]) / slope
    across = np.array([-forward[1], forward[0]])  # to the left
    y, z = d[:, :2] @ across, d[:, 2]
    if np.linalg.svd(np.stack([y, d[:, :2] @ forward], axis=1), compute_uv=False)[1] <= 1e-6 * spread[0]:
        raise Singular("the control points lie along the flight: they do not determine it")
    spacing, height = 0.0, 0.0
    for _ in range(200):
        spacing, y0, square = _across(pixel, y, z, delay, height)
        new = float(np.sqrt(square)) if square > 0.0 else 0.5 * height
        done = abs(new - height) <= 1e-10 * new
        height = new
        if done:
            break
    if not (spacing > 0.0 and height > 0.0):
        raise Singular("no flight above the control points fits their ranges (is the delay right, or the direction of r turned round?)")
    start = -first / slope  # along the flight, at s = 0
    plan = centre[:2] + start * forward + y0 * across
    side: Side = "left" if np.median(y) > y0 else "right"
    return Flight(np.array([*plan, centre[2] + height]), np.array([*(forward / slope), 0.0]), spacing, side)


def _across(pixel: Floats, y: Floats, z: Floats, delay: float, height: float) -> tuple[float, float, float]:
    """Return pixel spacing m, y0 and H^2 from y^2 + z^2 - 2 H z - (m r + delay)^2 = 2 y0 y - (y0^2 + H^2), with H given on the left."""
    a = np.column_stack([2.0 * y, -np.ones(len(y))])

    def fit(m: float) -> tuple[Floats, Floats, Floats]:
        right = y**2 + z**2 - 2.0 * height * z - (m * pixel + delay) ** 2
        solved = np.asarray(np.linalg.lstsq(a, right, rcond=None)[0], dtype=float)
        slope = -2.0 * (m * pixel + delay) * pixel
        return solved, right - a @ solved, np.asarray(slope - a @ np.linalg.lstsq(a, slope, rcond=None)[0], dtype=float)

    # the misfit has several minima in m: search over six decades, then refine
    size = max(float(np.ptp(y)), 1.0) / float(np.abs(pixel).max())
    m = float(min(np.geomspace(1e-3, 1e3, 601) * size, key=lambda k: float(np.sum(fit(float(k))[1] ** 2))))
    for _ in range(50):
        _, rest, slope = fit(m)
        step = -float(slope @ rest) / float(slope @ slope)
        m += step
        if abs(step) <= 1e-15 * abs(m):
            break
    solved, _, _ = fit(m)
    return m, float(solved[0]), float(solved[1] - solved[0] ** 2)
