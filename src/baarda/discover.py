"""Find the members of a folder: one concept, one folder, one file per member."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from types import ModuleType


@cache
def modules(package: str) -> tuple[ModuleType, ...]:
    """Import and return the modules of a package, sorted by name; `base` and private modules are left out.

    Parameters
    ----------
    package : str
        Dotted name, for instance ``"baarda.cameras"``.

    Returns
    -------
    tuple of modules

    Examples
    --------
    >>> any(m.__name__.endswith("brown") for m in modules("baarda.cameras"))
    True
    """
    folder = importlib.import_module(package)
    names = sorted(m.name for m in pkgutil.iter_modules(folder.__path__) if m.name != "base" and not m.name.startswith("_"))
    return tuple(importlib.import_module(f"{package}.{name}") for name in names)


@cache
def members(package: str, contract: type) -> tuple[object, ...]:
    """Return the module-level instances of `contract` in a package, in the order of files and definitions.

    Parameters
    ----------
    package : str
        Dotted name of the folder.
    contract : type
        The class whose instances are members.

    Returns
    -------
    tuple of instances of `contract`
    """
    found: dict[int, object] = {}
    for module in modules(package):
        for name, value in vars(module).items():
            if isinstance(value, contract) and not name.startswith("_"):
                found.setdefault(id(value), value)
    return tuple(found.values())
