"""BLAS and LAPACK on parts of row-major matrices, without copies and without the interpreter lock.

SciPy offers its routines to compiled callers by address (`scipy.linalg.cython_blas`); a call through ctypes releases the lock, so that
threads can work on several fronts. Fortran sees a row-major matrix transposed: its upper triangle is our lower one.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

Floats = NDArray[np.float64]


@cache
def _routine(name: str) -> Any:
    module = cython_lapack if name in ("dpotrf", "dpotri") else cython_blas
    capsule = module.__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype, api.PyCapsule_GetPointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    signature = api.PyCapsule_GetName(capsule).decode()
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * (signature.count(",") + 1))(address)


def _call(name: str, *arguments: Any) -> None:
    kept = []
    for a in arguments:
        if isinstance(a, str):
            kept.append(ctypes.c_char_p(a.encode()))
        elif isinstance(a, float):
            kept.append(ctypes.byref(ctypes.c_double(a)))  # type: ignore[arg-type]
        elif isinstance(a, np.ndarray):
            kept.append(ctypes.c_void_p(a.ctypes.data))  # type: ignore[arg-type]
        else:
            kept.append(ctypes.byref(ctypes.c_int(a)))  # type: ignore[arg-type]
    _routine(name)(*kept)


def _leading(a: Floats) -> int:
    """Return the distance of rows; the columns must follow each other."""
    if a.dtype != np.float64 or a.ndim != 2 or (a.shape[1] > 1 and a.strides[1] != 8):
        raise ValueError("needed is a matrix of doubles whose columns follow each other")
    distance = a.strides[0] // 8 if a.shape[0] > 1 else 0
    return int(max(distance, a.shape[1], 1))


def cholesky(a: Floats) -> int:
    """Replace the lower triangle of `a` by its factor; return 0, or the number (from 1) of the pivot that is not positive."""
    info: Any = ctypes.c_int(0)
    _routine("dpotrf")(
        ctypes.c_char_p(b"U"), ctypes.byref(ctypes.c_int(len(a))), ctypes.c_void_p(a.ctypes.data), ctypes.byref(ctypes.c_int(_leading(a))),
        ctypes.byref(info),
    )  # fmt: skip
    found: int = info.value
    return found


def invert_from_cholesky(a: Floats) -> None:
    """Replace a lower factor by the lower triangle of the inverse of L L'."""
    info = ctypes.c_int(0)
    _routine("dpotri")(
        ctypes.c_char_p(b"U"), ctypes.byref(ctypes.c_int(len(a))), ctypes.c_void_p(a.ctypes.data), ctypes.byref(ctypes.c_int(_leading(a))),
        ctypes.byref(info),
    )  # fmt: skip


def solve_right_transposed(lower: Floats, b: Floats) -> None:
    """Replace b (s, p) by b L^-T."""
    _call("dtrsm", "L", "U", "T", "N", b.shape[1], b.shape[0], 1.0, lower, _leading(lower), b, _leading(b))


def solve_right(lower: Floats, b: Floats) -> None:
    """Replace b (s, p) by b L^-1."""
    _call("dtrsm", "L", "U", "N", "N", b.shape[1], b.shape[0], 1.0, lower, _leading(lower), b, _leading(b))


def solve_left(lower: Floats, b: Floats) -> None:
    """Replace b (p, k) by L^-1 b."""
    _call("dtrsm", "R", "U", "N", "N", b.shape[1], b.shape[0], 1.0, lower, _leading(lower), b, _leading(b))


def solve_left_transposed(lower: Floats, b: Floats) -> None:
    """Replace b (p, k) by L^-T b."""
    _call("dtrsm", "R", "U", "T", "N", b.shape[1], b.shape[0], 1.0, lower, _leading(lower), b, _leading(b))


def subtract_square(b: Floats, c: Floats) -> None:
    """Subtract b b' from the lower triangle of c."""
    _call("dsyrk", "U", "T", c.shape[0], b.shape[1], -1.0, b, _leading(b), 1.0, c, _leading(c))


def multiply(a: Floats, b: Floats, c: Floats, factor: float = 1.0, keep: float = 0.0) -> None:
    """Set c = factor a b + keep c."""
    _call("dgemm", "N", "N", b.shape[1], a.shape[0], a.shape[1], factor, b, _leading(b), a, _leading(a), keep, c, _leading(c))


def multiply_transposed(a: Floats, b: Floats, c: Floats, factor: float = 1.0, keep: float = 0.0) -> None:
    """Set c = factor a' b + keep c."""
    _call("dgemm", "N", "T", b.shape[1], a.shape[1], a.shape[0], factor, b, _leading(b), a, _leading(a), keep, c, _leading(c))
