"""What a law of errors is: `Distribution` (a law with values), `Shape` (a parameter beyond mean and scale), `Law` (a named member)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baarda.errors import UsageError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """A shape parameter of a law.

    Attributes
    ----------
    name : str
        Name, also the field name of the distribution.
    lower, upper : float
        Bounds; the lower one is excluded, the upper one is admitted when `upper_closed`.
    start : float
        A usual value, where a fit may start.
    upper_closed : bool
        Whether the upper bound itself is a law (the modulated normal at a = inf is the normal).
    search : tuple of float, optional
        The part of the range that a fit searches, where the whole range is not sensible.
    flat_limit : bool
        Whether the likelihood has slope zero in 1/value at the infinite bound, so that a fit searches in 1/value^2.
    """

    name: str
    lower: float
    upper: float
    start: float
    upper_closed: bool = False
    search: tuple[float, float] | None = None
    flat_limit: bool = False

    def admits(self, value: ArrayLike) -> Any:
        """Return whether the value (or each value) is inside the bounds."""
        v = np.asarray(value, dtype=float)
        return (v > self.lower) & ((v <= self.upper) if self.upper_closed else (v < self.upper))

    def to_unit(self, value: Any) -> Any:
        """Return the coordinate of a value in (0, 1) that a fit searches: 1/(value - lower + 1), its square, or a share of the range."""
        if np.isinf(self.upper):
            u = 1.0 / (value - self.lower + 1.0)
            return u * u if self.flat_limit else u
        return (value - self.lower) / (self.upper - self.lower)

    def from_unit(self, t: Any) -> Any:
        """Return the value at a coordinate; 0 is an infinite upper bound."""
        if not np.isinf(self.upper):
            return self.lower + t * (self.upper - self.lower)
        with np.errstate(divide="ignore"):
            u = np.sqrt(t) if self.flat_limit else np.asarray(t, dtype=float)
            return (1.0 / u - 1.0 + self.lower)[()]

    def slope(self, t: Any) -> Any:
        """Return d value / d coordinate."""
        if not np.isinf(self.upper):
            return np.full(np.shape(t), self.upper - self.lower)[()]
        return -0.5 * np.asarray(t, dtype=float) ** -1.5 if self.flat_limit else -1.0 / np.square(t)

    def usual_values(self) -> tuple[float, ...]:
        """Return values spread over the range, where a fit may start."""
        if np.isinf(self.upper):
            return tuple(1.0 / u - 1.0 + self.lower for u in (0.1, 0.25, 0.4, 0.55, 0.7, 0.85))
        return tuple(self.lower + u * (self.upper - self.lower) for u in (0.05, 0.2, 0.5, 0.8))

    def limits(self) -> tuple[float, float]:
        """Return the bounds of the coordinate for a fit."""
        low, high = sorted(float(self.to_unit(v)) for v in self.search) if self.search else (0.0, 1.0)
        return (low if self.upper_closed else max(low, 1e-6)), min(high, 1.0 - 1e-6)


@dataclass(frozen=True)
class Distribution:
    """A continuous law of errors with the values of its parameters.

    A member's author writes the functions of the standard law (`loc` 0, `scale` 1), on arrays `z` and shapes that broadcast:
    `_logpdf`, `_sf` and `_moments` always, `_cdf` for a law that is not symmetric; and, where the derived ones (numerical inversion,
    differences, quadrature) are too slow or too rough, `_pdf`, `_isf`, `_rvs`, `_score`, `_gradient`, `_entropy`.

    Attributes
    ----------
    loc : float
        Location: the centre of a symmetric law, hence mean and median.
    scale : float
        Scale > 0; for the normal and the modulated normal laws the standard deviation (`scale_is_sd`).

    Raises
    ------
    UsageError
        If a parameter is outside its bounds.
    """

    loc: float = field(default=0.0, kw_only=True)
    scale: float = field(default=1.0, kw_only=True)

    family: ClassVar[str] = ""
    shapes: ClassVar[tuple[Shape, ...]] = ()
    symmetric: ClassVar[bool] = True
    scale_is_sd: ClassVar[bool] = False
    by_shape: ClassVar[bool] = False  # evaluation with one shape value for many z is much cheaper than with a shape each

    def __post_init__(self) -> None:
        if not np.isfinite(self.loc):
            raise UsageError(f"{self.family}: loc = {self.loc} is not finite")
        if not (np.isfinite(self.scale) and self.scale > 0.0):
            raise UsageError(f"{self.family}: scale = {self.scale} is not a positive number")
        for shape in self.shapes:
            value = getattr(self, shape.name)
            if not shape.admits(value):
                close = "]" if shape.upper_closed else ")"
                raise UsageError(f"{self.family}: {shape.name} = {value} is outside ({shape.lower:g}, {shape.upper:g}{close}")

    # ---- the standard law: what a member's author writes --------------------------------------------------------------------------

    @classmethod
    def _logpdf(cls, z: Floats, *shapes: Any) -> Any:
        raise NotImplementedError

    @classmethod
    def _sf(cls, z: Floats, *shapes: Any) -> Any:
        raise NotImplementedError

    @classmethod
    def _cdf(cls, z: Floats, *shapes: Any) -> Any:
        if not cls.symmetric:
            raise NotImplementedError
        return cls._sf(-z, *shapes)

    @classmethod
    def _pdf(cls, z: Floats, *shapes: Any) -> Any:
        return np.exp(cls._logpdf(z, *shapes))

    @classmethod
    def _isf(cls, q: Floats, *shapes: Any) -> Any:
        return _invert(cls, q, shapes)

    @classmethod
    def _ppf(cls, q: Floats, *shapes: Any) -> Any:
        return -cls._isf(q, *shapes) if cls.symmetric else cls._isf(1.0 - q, *shapes)

    @classmethod
    def _rvs(cls, rng: np.random.Generator, size: int | tuple[int, ...], *shapes: Any) -> Any:
        return cls._ppf(rng.random(size), *shapes)

    @classmethod
    def _score(cls, z: Floats, *shapes: Any) -> Any:
        step = 1e-5 * (1.0 + np.abs(z))
        return (cls._logpdf(z + step, *shapes) - cls._logpdf(z - step, *shapes)) / (2.0 * step)

    @classmethod
    def _gradient(cls, z: Floats, *shapes: Any) -> tuple[Floats, ...]:
        """Derivatives of log f with respect to the shapes, by central differences."""
        out = []
        for i, value in enumerate(shapes):
            step = 1e-5 * (1.0 + np.abs(value))
            up = cls._logpdf(z, *shapes[:i], value + step, *shapes[i + 1 :])
            down = cls._logpdf(z, *shapes[:i], value - step, *shapes[i + 1 :])
            out.append((up - down) / (2.0 * step))
        return tuple(out)

    @classmethod
    def _log_and_score(cls, z: Floats, *shapes: Any) -> tuple[Floats, Floats]:
        """`_logpdf` and `_score` together, where intermediate results can be shared."""
        return cls._logpdf(z, *shapes), cls._score(z, *shapes)

    @classmethod
    def _likelihood(cls, z: Floats, *shapes: Any) -> tuple[Floats, Floats, tuple[Floats, ...]]:
        """Log-density, its derivative by z and its derivatives by the shapes in one go: members override it where they share work."""
        return cls._logpdf(z, *shapes), cls._score(z, *shapes), cls._gradient(z, *shapes)

    @classmethod
    def _moments(cls, *shapes: Any) -> tuple[Any, Any, Any, Any]:
        """Mean, variance, skewness and excess kurtosis of the standard law."""
        raise NotImplementedError

    @classmethod
    def _closed_form(cls, points: Floats, weights: Floats, loc: float | None) -> tuple[float, float] | None:
        """Maximum-likelihood loc and scale of a law without free shapes where a formula exists (loc given or None)."""
        return None

    @classmethod
    def _closed_columns(cls, x: Floats, loc: float | None) -> tuple[Floats, Floats] | None:
        """The same for each column of an array, (n, B) -> (B,), (B,)."""
        return None

    @classmethod
    def _smoothness(cls, *shapes: Any) -> int:
        """2: log f has a finite second derivative everywhere; 1: only a first one (information from outer products); 0: a kink or cusp.

        With a kink, the likelihood has a local maximum in `loc` at many an observation.
        """
        return 2

    @classmethod
    def _entropy(cls, *shapes: Any) -> float:
        q = np.linspace(-38.0, 38.0, 4001)  # midpoints in the logit of the probability: the integrand falls like exp(-|q|)
        tail = 1.0 / (1.0 + np.exp(np.abs(q)))
        z = np.where(q > 0, cls._isf(tail, *shapes), cls._ppf(tail, *shapes))
        return float(-np.sum(cls._logpdf(z, *shapes) * tail * (1.0 - tail)) * (q[1] - q[0]))

    # ---- what a user calls ----------------------------------------------------------------------------------------------------------

    @property
    def shape_values(self) -> tuple[float, ...]:
        """The values of the shape parameters, in the order of `shapes`."""
        return tuple(float(getattr(self, s.name)) for s in self.shapes)

    @property
    def parameters(self) -> dict[str, float]:
        """All parameters by name: shapes, `loc`, `scale`."""
        return {s.name: float(getattr(self, s.name)) for s in self.shapes} | {"loc": float(self.loc), "scale": float(self.scale)}

    def _z(self, x: ArrayLike) -> Floats:
        return (np.asarray(x, dtype=float) - self.loc) / self.scale

    def logpdf(self, x: ArrayLike) -> Any:
        """Return the logarithm of the density at `x` (any shape)."""
        return _plain(self._logpdf(self._z(x), *self.shape_values) - np.log(self.scale))

    def pdf(self, x: ArrayLike) -> Any:
        """Return the density at `x` (any shape), in 1/unit of `x`."""
        return _plain(self._pdf(self._z(x), *self.shape_values) / self.scale)

    def cdf(self, x: ArrayLike) -> Any:
        """Return P(X <= x)."""
        return _plain(self._cdf(self._z(x), *self.shape_values))

    def sf(self, x: ArrayLike) -> Any:
        """Return P(X > x), accurate in the upper tail."""
        return _plain(self._sf(self._z(x), *self.shape_values))

    def ppf(self, q: ArrayLike) -> Any:
        """Return the quantile: `cdf(ppf(q)) = q`; NaN outside [0, 1]."""
        return _plain(self.loc + self.scale * self._ppf(np.asarray(q, dtype=float), *self.shape_values))

    def isf(self, q: ArrayLike) -> Any:
        """Return the upper quantile: `sf(isf(q)) = q`; NaN outside [0, 1]."""
        return _plain(self.loc + self.scale * self._isf(np.asarray(q, dtype=float), *self.shape_values))

    def rvs(self, size: int | tuple[int, ...], rng: np.random.Generator) -> Floats:
        """Draw values of the law with a NumPy generator."""
        return np.asarray(self.loc + self.scale * self._rvs(rng, size, *self.shape_values))

    def score(self, x: ArrayLike) -> Any:
        """Return d log f / dx at `x`; -score/(x - loc) is the weight of a maximum-likelihood adjustment under the law."""
        return _plain(self._score(self._z(x), *self.shape_values) / self.scale)

    def mean(self) -> float:
        """Return the expectation."""
        return float(self.loc + self.scale * self._moments(*self.shape_values)[0])

    def var(self) -> float:
        """Return the variance; infinite or NaN where it does not exist."""
        return float(self.scale**2 * self._moments(*self.shape_values)[1])

    def std(self) -> float:
        """Return the standard deviation."""
        return float(np.sqrt(self.var()))

    def skewness(self) -> float:
        """Return the skewness."""
        return float(self._moments(*self.shape_values)[2])

    def excess_kurtosis(self) -> float:
        """Return the kurtosis minus 3."""
        return float(self._moments(*self.shape_values)[3])

    def entropy(self) -> float:
        """Return the differential entropy, in nats."""
        return float(self._entropy(*self.shape_values) + np.log(self.scale))


@dataclass(frozen=True)
class Law:
    """A member: a family of laws under a name, perhaps with some shapes held at fixed values (radico = modulated normal, a = 1/2).

    Attributes
    ----------
    name : str
        Name, unique among the members.
    distribution : type
        The class that holds the formulas.
    description : str
        One line for the list of laws.
    fixed : tuple of (name, value)
        Shapes held fixed.

    Examples
    --------
    >>> from baarda.distributions import law
    >>> law("radico")(scale=2.0).std()
    2.0
    """

    name: str
    distribution: type[Distribution]
    description: str
    fixed: tuple[tuple[str, float], ...] = ()

    @property
    def free_shapes(self) -> tuple[Shape, ...]:
        """The shapes that are not fixed."""
        held = dict(self.fixed)
        return tuple(s for s in self.distribution.shapes if s.name not in held)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters that may be given or fitted: free shapes, `loc`, `scale`."""
        return (*(s.name for s in self.free_shapes), "loc", "scale")

    def __call__(self, **parameters: float) -> Distribution:
        """Return the law with the given values; shapes left out take their usual value, `loc` 0, `scale` 1."""
        for name in parameters:
            if name not in self.parameter_names:
                raise UsageError(f"law {self.name}: no parameter {name!r} (has {', '.join(self.parameter_names)})")
        values: dict[str, float] = {s.name: s.start for s in self.free_shapes} | dict(self.fixed) | parameters
        return self.distribution(**values)

    def with_values(self, parameters: Mapping[str, float]) -> Distribution:
        """Return the law with all values given by name, fixed shapes included or not."""
        held = {name for name, _ in self.fixed}
        return self(**{k: float(v) for k, v in parameters.items() if k not in held})


def _plain(values: Any) -> Any:
    """Return a float for a scalar, the array otherwise."""
    return float(values) if np.ndim(values) == 0 else values


def _invert(cls: type[Distribution], q: Floats, shapes: tuple[Any, ...]) -> Any:
    """Upper quantiles of a standard law by bracketing and bisection on a doubling grid, finished by Newton steps."""
    q, *expanded = np.broadcast_arrays(np.asarray(q, dtype=float), *[np.asarray(s, dtype=float) for s in shapes])
    out = np.full(q.shape, np.nan)
    out[q == 0.0] = np.inf
    out[q == 1.0] = -np.inf
    todo = (q > 0.0) & (q < 1.0)
    if not todo.any():
        return out
    p = q[todo]
    parts = tuple(s[todo] for s in expanded)
    low, high = np.full(p.shape, -1.0), np.full(p.shape, 1.0)
    for _ in range(1100):
        short = cls._sf(high, *parts) > p
        if not short.any():
            break
        high[short] *= 2.0
    for _ in range(1100):
        short = cls._sf(low, *parts) < p
        if not short.any():
            break
        low[short] *= 2.0
    x = 0.5 * (low + high)
    for _ in range(200):
        # Newton on the logarithm of the smaller tail area, inside the bracket; else bisection
        upper, lower = cls._sf(x, *parts), cls._cdf(x, *parts)
        above = upper > p
        low, high = np.where(above, x, low), np.where(above, high, x)
        density = cls._pdf(x, *parts)
        with np.errstate(all="ignore"):
            step = np.where(p < 0.5, upper / density * np.log(upper / p), -lower / density * np.log(lower / (1.0 - p)))
        proposal = x + step
        bad = ~((proposal > low) & (proposal < high))
        proposal = np.where(bad, 0.5 * (low + high), proposal)
        change = np.abs(proposal - x)
        x = proposal
        if np.all(change <= 2e-16 * np.abs(x) + 1e-300):
            break
    out[todo] = x
    return out


def parameter_fields(distribution: type[Distribution]) -> tuple[str, ...]:
    """Return the names of all parameters of a class: shapes, `loc`, `scale`."""
    return tuple(sorted((f.name for f in fields(distribution)), key=lambda n: n in ("loc", "scale")))
