"""The contract of camera models: two chains of steps that meet in one plane.

The *measured* chain leads from the pixel (after the sensor transform) towards the ideal image, the *ideal* chain from the normalised image
coordinates (x = -U/W, y = -V/W, y up) towards the measured one. The observation equation is that both ends agree. A model that
corrects measured coordinates (photogrammetry) has its distortion steps in the measured chain; one that distorts ideal coordinates (computer
vision) in the ideal chain. Whoever adds a correction writes one `Step` with its partials; equation, inverse and both directions follow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.errors import UsageError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
# xy (n, 2) and parameters (n or 1, k) -> mapped (n, 2), partials to xy (n, 2, 2), partials to parameters (n, 2, k)
StepFunction = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]

FIXED, OBSERVED, FREE = 0, 1, 2
STATES = ("fixed", "observed", "free")


@dataclass(frozen=True)
class Parameter:
    """A parameter of a step: its name, the power of the plane unit in its unit, its value when nothing is known."""

    name: str
    power: int = 0
    default: float = 0.0


@dataclass(frozen=True)
class Step:
    """One map of the image plane onto itself.

    Attributes
    ----------
    name : str
    parameters : tuple of Parameter
    function : callable
        ``xy (n, 2), p (n or 1, k) -> (out (n, 2), d_xy (n, 2, 2), d_p (n, 2, k))``.
    additional : bool
        Whether the parameters are additional ones (distortion, affinity) and not the interior orientation.
    on_grid : bool
        Whether the function is written in units of the grid half-width b of the camera, as the orthogonal sets are: it is called with
        xy / b and parameters p / b^power, and its result is led back, so that its author sets b = 1.
    """

    name: str
    parameters: tuple[Parameter, ...]
    function: StepFunction
    additional: bool = False
    on_grid: bool = False

    def apply(self, xy: Floats, p: Floats, grid: float = 1.0) -> tuple[Floats, Floats, Floats]:
        """Apply the function in plane units; `grid` is the half-width b that a step on a grid is written for."""
        if not self.on_grid:
            return self.function(xy, p)
        units = grid ** np.array([q.power for q in self.parameters], dtype=float)
        out, d_xy, d_p = self.function(xy / grid, p / units)
        return out * grid, d_xy, d_p * (grid / units)


def additive(increment: StepFunction) -> StepFunction:
    """Turn an increment d(xy; p) with its partials into the map xy + d(xy; p)."""

    def function(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        d, d_xy, d_p = increment(xy, p)
        return xy + d, d_xy + np.eye(2), d_p

    return function


@dataclass(frozen=True)
class CameraModel:
    """A named combination of steps.

    Attributes
    ----------
    name : str
    description : str
        One line for `baarda cameras`.
    order : tuple of str
        All parameter names in the order of the model's users.
    measured, ideal : tuple of Step
        The two chains, see the module's first lines.
    examples : tuple of dict
        Realistic parameter values with ``unit`` pixels of a 1000 x 800 image, by which every model is examined; missing ones are default.
    """

    name: str
    description: str
    order: tuple[str, ...]
    measured: tuple[Step, ...] = ()
    ideal: tuple[Step, ...] = ()
    examples: tuple[dict[str, float], ...] = field(default=(), hash=False)

    def __post_init__(self) -> None:
        names = [p.name for s in self.steps for p in s.parameters]
        if sorted(names) != sorted(self.order):
            raise ValueError(f"camera model {self.name}: the order names {self.order}, the steps {names}")

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps, the measured chain first."""
        return self.measured + self.ideal

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters in the model's order."""
        known = {p.name: p for s in self.steps for p in s.parameters}
        return tuple(known[name] for name in self.order)

    @cached_property
    def additional(self) -> tuple[bool, ...]:
        """For each parameter whether it is an additional one."""
        known = {p.name: s.additional for s in self.steps for p in s.parameters}
        return tuple(known[name] for name in self.order)

    @cached_property
    def on_grid(self) -> bool:
        """Whether a step needs the grid half-width of the camera."""
        return any(s.on_grid for s in self.steps)

    def columns(self, step: Step) -> list[int]:
        """Return the positions of a step's parameters in the model's order."""
        return [self.order.index(p.name) for p in step.parameters]


@dataclass(frozen=True)
class Camera:
    """A camera: a model with values, states and the constant sensor transform from source pixels to its plane.

    Attributes
    ----------
    label : str
    model : CameraModel
    values : (k,) array
        Start or adjusted values, in powers of `unit`.
    states : (k,) int array
        0 fixed, 1 observed (with `sigmas`), 2 free.
    sigmas : (k,) array
        A-priori standard deviations of observed parameters, NaN elsewhere.
    unit : str
        Unit of the plane, ``"mm"`` or ``"px"``.
    pixel_size : (2,) array
        Plane units per source pixel, x and y, positive.
    origin : (2,) array
        Source pixel coordinates of the origin of the principal point's axes.
    y_down : bool
        Whether source rows are counted downwards; principal point and source pixels share that axis.
    image_size : tuple of float or None
        Width and height in source pixels.
    given : (k,) array or None
        Directly observed values where they differ from `values` (after an adjustment); None = `values`.
    grid : float or None
        Half-width b of the grid on which a set of additional parameters is orthogonal, plane units; None = half the larger image side.
    """

    label: str
    model: CameraModel
    values: Floats
    states: NDArray[np.int8]
    sigmas: Floats
    unit: str = "px"
    pixel_size: Floats = field(default_factory=lambda: np.ones(2))
    origin: Floats = field(default_factory=lambda: np.zeros(2))
    y_down: bool = True
    image_size: tuple[float, float] | None = None
    given: Floats | None = None
    grid: float | None = None

    @property
    def half_width(self) -> float:
        """The grid half-width b in plane units, 1 where the model has no step on a grid.

        Raises
        ------
        UsageError
            If the model needs it and neither it nor the image size is known.
        """
        if not self.model.on_grid:
            return 1.0
        if self.grid is not None:
            return float(self.grid)
        if self.image_size is None:
            raise UsageError(f"camera {self.label}: model {self.model.name} needs the image size, or the half-width of its grid")
        return 0.5 * float(np.max(np.asarray(self.image_size, dtype=float) * np.asarray(self.pixel_size, dtype=float)))

    @property
    def prior(self) -> Floats:
        """The directly observed values of parameters in state observed."""
        return self.values if self.given is None else self.given

    def __post_init__(self) -> None:
        k = len(self.model.order)
        for name in ("values", "states", "sigmas"):
            if len(getattr(self, name)) != k:
                raise UsageError(f"camera {self.label}: model {self.model.name} has {k} parameters, {name} has {len(getattr(self, name))}")
        if self.grid is not None and not 0.0 < self.grid < np.inf:
            raise UsageError(f"camera {self.label}: the half-width of the grid must be positive, not {self.grid}")

    def unit_of(self, k: int) -> str:
        """Return the unit of parameter k, for instance ``mm`` or ``mm^-2``; empty for a pure number."""
        power = self.model.parameters[k].power
        return "" if power == 0 else self.unit if power == 1 else f"{self.unit}^{power}"

    def with_values(self, values: Floats) -> Camera:
        """Return the camera with other parameter values; what was directly observed stays."""
        return replace(self, values=np.asarray(values, dtype=float), given=self.prior)


def create(
    label: str,
    model: CameraModel,
    values: dict[str, float],
    free: Sequence[str] = (),
    observed: dict[str, float] | None = None,
    **constants: Any,
) -> Camera:
    """Make a camera from named values.

    Parameters
    ----------
    label : str
    model : CameraModel
    values : dict
        Parameter values by name; the others take their defaults.
    free : sequence of str
        Parameters to estimate.
    observed : dict, optional
        A-priori standard deviation of each directly observed parameter.
    **constants
        `unit`, `pixel_size`, `origin`, `y_down`, `image_size`, `grid` of `Camera`.

    Raises
    ------
    UsageError
        If a name is not a parameter of the model.
    """
    observed = observed or {}
    unknown = [n for n in (*values, *free, *observed) if n not in model.order]
    if unknown:
        raise UsageError(f"camera {label}: model {model.name} has no parameter {unknown[0]!r}; it has {', '.join(model.order)}")
    states = np.array([FREE if n in free else OBSERVED if n in observed else FIXED for n in model.order], dtype=np.int8)
    return Camera(
        label=label,
        model=model,
        values=np.array([values.get(p.name, p.default) for p in model.parameters], dtype=float),
        states=states,
        sigmas=np.array([observed.get(n, np.nan) for n in model.order], dtype=float),
        **constants,
    )


@dataclass(frozen=True)
class Optics:
    """A camera model with the constants of a sensor: the functions that the adjustment calls, vectorised over points and parameters."""

    model: CameraModel
    pixel_size: Floats
    origin: Floats
    y_down: bool
    grid: float = 1.0

    @staticmethod
    def of(camera: Camera) -> Optics:
        """Return the optics of a camera."""
        size, origin = np.asarray(camera.pixel_size, dtype=float), np.asarray(camera.origin, dtype=float)
        return Optics(camera.model, size, origin, camera.y_down, camera.half_width)

    def _chain(self, steps: tuple[Step, ...], xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        n, k = len(xy), p.shape[1]
        d_xy, d_p = np.broadcast_to(np.eye(2), (n, 2, 2)), np.zeros((n, 2, k))
        for step in steps:
            if step.name == "flip" and not self.y_down:
                continue
            columns = self.model.columns(step)
            xy, s_xy, s_p = step.apply(xy, p[:, columns], self.grid)
            d_xy, d_p = s_xy @ d_xy, s_xy @ d_p
            if columns:
                d_p[:, :, columns] += s_p
        return xy, d_xy, d_p

    def from_measured(self, pixels: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        """Lead source pixels (n, 2) through the measured chain; also the partials to the pixels and the parameters."""
        xy, d_xy, d_p = self._chain(self.model.measured, (pixels - self.origin) * self.pixel_size, p)
        return xy, d_xy * self.pixel_size, d_p

    def from_ideal(self, normalised: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        """Lead normalised coordinates (n, 2) through the ideal chain; also the partials to them and to the parameters."""
        return self._chain(self.model.ideal, normalised, p)

    def distort(self, normalised: Floats, p: Floats, start: Floats | None = None) -> tuple[Floats, Floats, Floats, Bools]:
        """Map ideal normalised coordinates to source pixels.

        Parameters
        ----------
        normalised : (n, 2) array
        p : (n or 1, k) array
        start : (n, 2) array, optional
            Source pixels near the result, for instance the measured ones.

        Returns
        -------
        pixels : (n, 2) array
        d_normalised : (n, 2, 2) array
        d_p : (n, 2, k) array
        valid : (n,) bool array
            False where the correction cannot be inverted.
        """
        target, t_xy, t_p = self.from_ideal(normalised, p)
        if start is None:
            shift = self._chain(self.model.measured, np.zeros((1, 2)), p[:1])[0]  # where the origin lands
            sign = np.array([1.0, -1.0 if any(s.name == "flip" for s in self.model.measured) and self.y_down else 1.0])
            start = (target - shift) * sign / self.pixel_size + self.origin
        pixels, m_xy, m_p, valid = _invert(self.from_measured, target, start, p)
        inverse = _inverse_2x2(m_xy)
        return pixels, inverse @ t_xy, inverse @ (t_p - m_p), valid

    def correct(self, pixels: Floats, p: Floats) -> tuple[Floats, Bools]:
        """Map source pixels (n, 2) to ideal normalised coordinates (n, 2); also a flag where the distortion can be inverted."""
        target = self.from_measured(pixels, p)[0]
        scale = self.from_ideal(np.array([[0.0, 0.0], [1e-6, 0.0]]), p[:1])[0]
        slope = float(np.hypot(*(scale[1] - scale[0]))) * 1e6
        flips = sum(s.name == "flip" for s in self.model.ideal) % 2 == 1 and self.y_down
        start = (target - scale[0]) / slope * np.array([1.0, -1.0 if flips else 1.0])
        normalised, _, _, valid = _invert(self.from_ideal, target, start, p)
        return normalised, valid


def _inverse_2x2(a: Floats) -> Floats:
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    out = np.empty_like(a)
    with np.errstate(divide="ignore", invalid="ignore"):
        out[:, 0, 0], out[:, 1, 1] = a[:, 1, 1] / det, a[:, 0, 0] / det
        out[:, 0, 1], out[:, 1, 0] = -a[:, 0, 1] / det, -a[:, 1, 0] / det
    return out


def _invert(
    function: Callable[[Floats, Floats], tuple[Floats, Floats, Floats]], target: Floats, start: Floats, p: Floats, iterations: int = 50
) -> tuple[Floats, Floats, Floats, Bools]:
    """Solve function(xy; p) = target by Newton steps that are halved until the misfit falls."""
    xy = np.array(start, dtype=float)
    out, d_xy, d_p = function(xy, p)
    orientation = np.sign(np.linalg.det(d_xy))  # the sheet on which the start lies; a fold of the map lies beyond
    misfit = np.linalg.norm(target - out, axis=1)
    scale = np.linalg.norm(target, axis=1) + np.linalg.norm(out, axis=1) + np.finfo(float).tiny
    active = misfit > 4e-16 * scale
    for _ in range(iterations):
        rows = np.flatnonzero(active & np.isfinite(misfit))
        if not len(rows):
            break
        q = p if len(p) == 1 else p[rows]
        step = np.einsum("nij,nj->ni", _inverse_2x2(d_xy[rows]), target[rows] - out[rows])
        fraction = np.ones(len(rows))
        new = function(xy[rows] + step, q)
        new_misfit = np.linalg.norm(target[rows] - new[0], axis=1)
        for _ in range(8):
            worse = ~(new_misfit <= misfit[rows])
            if not worse.any():
                break
            fraction[worse] *= 0.5
            new = function(xy[rows] + fraction[:, None] * step, q)
            new_misfit = np.linalg.norm(target[rows] - new[0], axis=1)
        better = new_misfit < misfit[rows]
        moved = rows[better]
        xy[moved] += (fraction[:, None] * step)[better]
        out[moved], d_xy[moved], d_p[moved] = new[0][better], new[1][better], new[2][better]
        active[rows[~better]] = False  # rounding is reached, or no descent is left
        misfit[moved] = new_misfit[better]
        active &= misfit > 4e-16 * scale
    with np.errstate(invalid="ignore"):
        valid = (misfit <= 1e-12 * scale) & (np.sign(np.linalg.det(d_xy)) == orientation)
    return xy, d_xy, d_p, valid
