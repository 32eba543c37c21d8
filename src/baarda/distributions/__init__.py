"""Laws of errors: one file per law; evaluation, fitting, comparison, and SciPy-compatible forms of the modulated normal laws.

Names are loaded when first used: SciPy's `stats` only for `modulated_normal`, `radico`, `lineo`, `equi` and `quadri`.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from baarda.errors import UsageError

if TYPE_CHECKING:
    from baarda.distributions.base import Law

_PUBLIC = {
    "Distribution": "base",
    "Law": "base",
    "Shape": "base",
    "Histogram": "histogram",
    "equal_probability_edges": "histogram",
    "equal_width_edges": "histogram",
    "Fit": "result",
    "fit": "fitting",
    "profile_interval": "fitting",
    "fit_classes": "class_fitting",
    "compare_laws": "comparison",
    "Condensed": "condensed",
    "condense": "condensed",
    "condense_stream": "condensed",
    "log_likelihood": "tabulated",
    "log_likelihood_gradient": "tabulated",
    "modulated_normal": "_scipy_adapter",
    "radico": "_scipy_adapter",
    "lineo": "_scipy_adapter",
    "equi": "_scipy_adapter",
    "quadri": "_scipy_adapter",
    "as_scipy": "_scipy_adapter",
}

__all__ = sorted([*_PUBLIC, "law", "laws"])


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


@cache
def laws() -> dict[str, Law]:
    """Return all laws by name, in the order of their files.

    Examples
    --------
    >>> [name for name in laws() if name in ("normal", "radico")]
    ['radico', 'normal']
    """
    from baarda import discover
    from baarda.distributions.base import Law

    return {member.name: member for member in discover.members(__name__, Law) if isinstance(member, Law)}


def law(name: str) -> Law:
    """Return the law of a name.

    Raises
    ------
    UsageError
        If there is no such law; the message lists the names.

    Examples
    --------
    >>> law("lineo").fixed
    (('a', 1.0),)
    """
    known = laws()
    if name not in known:
        raise UsageError(f"no law named {name!r}; there are: {', '.join(known)}")
    return known[name]
