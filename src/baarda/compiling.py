"""Loops compiled by numba where it is installed, kept in its cache where there is a place for it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any


def compile_loops(functions: Sequence[Callable[..., Any]], inner: Sequence[Callable[..., Any]] = ()) -> list[Any] | None:
    """Compile functions to machine code that releases the interpreter lock.

    Parameters
    ----------
    functions : sequence of callable
    inner : sequence of callable
        Functions that these call by their names in the same module; each may call those before it. They become part of their callers: a
        true call counts a reference to each array, which costs more than many of them do.

    Returns
    -------
    list of callable or None
        None where numba is not installed.

    Examples
    --------
    >>> def double(x: float) -> float:
    ...     return 2.0 * x
    >>> loops = compile_loops([double])
    >>> loops is None or loops[0](4.0) == 8.0
    True
    """
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        return None

    def build(cached: bool) -> list[Any]:
        options = {"nogil": True, "cache": cached, "error_model": "numpy"}
        for function in inner:
            original = getattr(function, "py_func", function)
            setattr(sys.modules[original.__module__], original.__name__, numba.njit(**options, forceinline=True)(original))
        return [numba.njit(**options)(f) for f in functions]

    try:
        return build(cached=True)
    except RuntimeError:  # no place to write the cache
        return build(cached=False)
