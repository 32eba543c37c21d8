"""Rigorous least-squares adjustment of photogrammetric observations, and tests of everything that comes out.

The public names are loaded when first used: ``import baarda`` imports neither NumPy nor SciPy.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "read": "baarda.formats",
    "write_project": "baarda.formats.project:write",
    "write_covariance": "baarda.formats.covariance_file",
    "write_points": "baarda.formats.geojson",
    "adjust": "baarda.adjustment",
    "Adjustment": "baarda.adjustment",
    "Network": "baarda.network",
    "test": "baarda.procedures.testing",
    "fit": "baarda.distributions",
    "modulated_normal": "baarda.distributions",
    "radico": "baarda.distributions",
    "lineo": "baarda.distributions",
    "write_report": "baarda.report",
}
_MODULES = ("cameras", "distributions", "errors", "formats", "geometry", "hypotheses", "network")

__all__ = sorted([*_PUBLIC, *_MODULES, "__version__"])


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        module, _, member = _PUBLIC[name].partition(":")
        return getattr(import_module(module), member or name)
    if name in _MODULES:
        return import_module(f"baarda.{name}")
    raise AttributeError(f"module 'baarda' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
