"""The modulated normal laws, and any other member, as SciPy continuous distributions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from baarda.distributions import law as find_law
from baarda.distributions.base import Law
from baarda.distributions.fitting import fit as fit_law
from baarda.errors import UsageError


class SciPyLaw(stats.rv_continuous):
    """A member as `scipy.stats.rv_continuous`: own _pdf, _cdf, _sf, _ppf, _isf, _logpdf, _rvs, _stats and `fit`.

    Parameters
    ----------
    member : Law
        The law; shapes that it holds fixed are not shapes of the SciPy distribution.
    """

    def __init__(self, member: Law, **kwargs: Any) -> None:
        self._member = member
        names = ", ".join(s.name for s in member.free_shapes)
        kwargs = {"name": member.name, "longname": member.description, "shapes": names or None} | kwargs
        super().__init__(**kwargs)

    def _updated_ctor_param(self) -> dict[str, Any]:
        return dict(super()._updated_ctor_param()) | {"member": self._member}  # type: ignore[misc]

    def _all(self, args: tuple[Any, ...], named: Mapping[str, Any] | None = None) -> tuple[Any, ...]:
        """All shapes of the class, the fixed ones included, as arrays; SciPy's newer distributions pass them by name."""
        own = dict(named or {}) or dict(zip((s.name for s in self._member.free_shapes), args, strict=True))
        held = dict(self._member.fixed)
        return tuple(np.asarray(own.get(s.name, held.get(s.name)), dtype=float) for s in self._member.distribution.shapes)

    def _argcheck(self, *args: Any) -> Any:
        good: Any = True
        for shape, value in zip(self._member.free_shapes, args, strict=True):
            good = good & shape.admits(value)
        return good

    def _shape_info(self) -> list[Any]:
        from scipy.stats._distn_infrastructure import _ShapeInfo

        return [_ShapeInfo(s.name, False, (s.lower, s.upper), (False, s.upper_closed)) for s in self._member.free_shapes]

    def _pdf(self, x: Any, *args: Any, **named: Any) -> Any:
        return self._member.distribution._pdf(x, *self._all(args, named))

    def _logpdf(self, x: Any, *args: Any, **named: Any) -> Any:
        return self._member.distribution._logpdf(x, *self._all(args, named))

    def _cdf(self, x: Any, *args: Any, **named: Any) -> Any:
        return self._member.distribution._cdf(x, *self._all(args, named))

    def _sf(self, x: Any, *args: Any, **named: Any) -> Any:
        return self._member.distribution._sf(x, *self._all(args, named))

    def _ppf(self, q: Any, *args: Any, **named: Any) -> Any:
        return self._member.distribution._ppf(q, *self._all(args, named))

    def _isf(self, q: Any, *args: Any, **named: Any) -> Any:
        return self._member.distribution._isf(q, *self._all(args, named))

    def _rvs(self, *args: Any, size: Any = None, random_state: Any = None) -> Any:
        rng = random_state
        if isinstance(rng, np.random.RandomState):  # SciPy's legacy state has no `random(size)` of the same stream: seed a generator
            rng = np.random.Generator(np.random.PCG64(rng.randint(0, 2**31 - 1, size=4)))
        return self._member.distribution._rvs(rng, () if size is None else size, *self._all(args))

    def _stats(self, *args: Any, **kwds: Any) -> Any:
        return self._member.distribution._moments(*self._all(args))

    def _entropy(self, *args: Any) -> Any:
        one = np.vectorize(lambda *s: self._member.distribution._entropy(*s))
        shapes = self._all(args)
        return one(*shapes) if shapes else self._member.distribution._entropy()

    def _fitstart(self, data: Any, args: Any = None) -> Any:
        found = fit_law(data, self._member, rule="moments")
        free = tuple(min(found.parameters[s.name], 50.0) for s in self._member.free_shapes)
        return (*free, found.parameters["loc"], found.parameters["scale"])

    def fit(self, data: Any, *args: Any, **kwds: Any) -> tuple[float, ...]:
        """Estimate shapes, loc and scale by maximum likelihood (or `method="MM"`: moments).

        Parameters
        ----------
        data : (n,) array
            Values.
        *args, **kwds
            As in SciPy: starting values (not needed, ignored), ``floc``, ``fscale``, ``f0`` or ``fa`` to hold a parameter.

        Returns
        -------
        tuple of float
            Shapes, loc, scale.

        Raises
        ------
        UsageError
            For values that cannot be fitted, or an unknown keyword.
        """
        names = [s.name for s in self._member.free_shapes]
        held: dict[str, float] = {}
        known = {"floc": "loc", "fscale": "scale"}
        for i, name in enumerate(names):
            known |= {f"f{i}": name, f"f{name}": name, f"fix_{name}": name}
        method = str(kwds.pop("method", "MLE")).upper()
        for key in (*names, "loc", "scale", "optimizer"):
            kwds.pop(key, None)
        for key, value in kwds.items():
            if key not in known:
                raise UsageError(f"{self.name}.fit: unknown keyword {key!r}")
            if value is not None:
                held[known[key]] = float(value)
        if method not in ("MLE", "MM"):
            raise UsageError(f"{self.name}.fit: no method {method!r} (MLE, MM)")
        result = fit_law(
            data,
            self._member,
            rule="maximum_likelihood" if method == "MLE" else "moments",
            loc=held.pop("loc", None),
            scale=held.pop("scale", None),
            shapes=held,
        )
        p: Mapping[str, float] = result.parameters
        return tuple(p[name] for name in (*names, "loc", "scale"))


def as_scipy(name: str) -> SciPyLaw:
    """Return a member as a SciPy continuous distribution.

    Examples
    --------
    >>> float(as_scipy("laplace").sf(0.0))
    0.5
    """
    return SciPyLaw(find_law(name))


modulated_normal = as_scipy("modulated_normal")
equi = as_scipy("equi")
radico = as_scipy("radico")
lineo = as_scipy("lineo")
quadri = as_scipy("quadri")
