"""Numbers as people read them: as many digits as they are worth, no more."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from baarda.report.translation import tr

MISSING = "–"
_MOST_DECIMALS = 6  # of a value; beyond, powers of ten
_NO_MORE = 9  # of a column
_FINER = {"m": (("mm", 1e3, 1e-2), ("µm", 1e6, 1e-5)), "mm": (("µm", 1e3, 1e-3),), "km": (("m", 1e3, 1e-2),)}


def fixed(value: float | None, decimals: int) -> str:
    """Return a number with a fixed count of decimals; a dash where there is none.

    Examples
    --------
    >>> fixed(-0.0004, 2), fixed(float("nan"), 2)
    ('0.00', '–')
    """
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def significant(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits; digits before the point are never rounded away.

    Examples
    --------
    >>> significant(57426.43), significant(0.0123456), significant(-2.05e-06), significant(2.0)
    ('57426', '0.0123', '-2.05e-06', '2.00')
    """
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if value == 0.0:
        return "0"
    if not 1e-4 <= abs(value) < 1e9:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - _exponent(value, digits))}f}"


def probability(p: float | None) -> str:
    """Return a p-value.

    Examples
    --------
    >>> probability(0.03456), probability(1e-9), probability(0.5)
    ('0.035', '< 0.0001', '0.50')
    """
    if p is None or math.isnan(p):
        return MISSING
    return "< 0.0001" if p < 1e-4 else f"{p:.4f}" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def p_stated(p: float | None) -> str:
    """Return a p-value with its sign of equality, as a sentence needs it.

    Examples
    --------
    >>> p_stated(0.03456), p_stated(1e-9)
    ('= 0.035', '< 0.0001')
    """
    text = probability(p)
    return text if text.startswith("<") else f"= {text}"


def _exponent(value: float, digits: int) -> int:
    """Return the decimal exponent after rounding (0.0996 to two digits is 0.10)."""
    return int(f"{abs(value):.{digits - 1}e}".split("e")[1])


def with_sigma(value: float | None, sigma: float | None, digits: int = 2) -> tuple[str, str]:
    """Return a value and its standard deviation: the sigma to `digits` digits, the value to match.

    Parameters
    ----------
    value, sigma : float or None
        In the same unit; sigma None, NaN or 0 where there is none.
    digits : int
        Digits of sigma.

    Returns
    -------
    tuple of str

    Notes
    -----
    GUM (JCGM 100) 7.2.6.

    Examples
    --------
    >>> with_sigma(7.45699534, 0.00104583), with_sigma(-4.51351e-05, 2.6e-06), with_sigma(12.5, None)
    (('7.4570', '0.0010'), ('-4.51e-05', '2.6e-06'), ('12.5', '–'))
    """
    if value is None or not math.isfinite(value):
        return MISSING, MISSING
    if sigma is None or not math.isfinite(sigma) or sigma <= 0.0:
        return (f"{value:.9g}"), MISSING
    decimals = digits - 1 - _exponent(sigma, digits)
    if decimals <= _MOST_DECIMALS:
        return fixed(value, max(0, decimals)), fixed(sigma, max(0, decimals))
    mantissa = max(0, decimals + _exponent(value, 17)) if value else 0
    return f"{value:.{mantissa}e}", f"{sigma:.{digits - 1}e}"


def decimals_for(values: ArrayLike, digits: int = 2, most: int = _NO_MORE) -> int:
    """Return the decimals that show the typical (median) size of some numbers with so many digits.

    Examples
    --------
    >>> decimals_for([0.012, 0.015, 3.0]), decimals_for([1200.0]), decimals_for([])
    (3, 0, 2)
    """
    x = np.abs(np.asarray(values, dtype=float))
    x = x[np.isfinite(x) & (x > 0.0)]
    if not len(x):
        return digits
    return int(min(max(0, digits - 1 - _exponent(float(np.median(x)), digits)), most))


def column(values: ArrayLike, digits: int = 3) -> list[str]:
    """Return numbers of one column with a common count of decimals.

    Examples
    --------
    >>> column([0.0123, 0.5, float("nan")], 2)
    ['0.01', '0.50', '–']
    """
    x = np.asarray(values, dtype=float)
    decimals = decimals_for(x, digits, _NO_MORE + 1)
    return [fixed(v, decimals) if decimals <= _NO_MORE else significant(v, digits) for v in x.tolist()]


def finer(unit: str, sizes: ArrayLike) -> tuple[str, float]:
    """Return the unit in which small lengths are told, and the factor that leads to it.

    Examples
    --------
    >>> finer("m", [4e-5, 6e-5]), finer("m", [0.02]), finer("ft", [1e-5])
    (('mm', 1000.0), ('m', 1.0), ('ft', 1.0))
    """
    x = np.abs(np.asarray(sizes, dtype=float))
    x = x[np.isfinite(x) & (x > 0.0)]
    best = (unit, 1.0)
    if len(x):
        for name, factor, below in _FINER.get(unit, ()):
            if float(np.median(x)) < below:
                best = (name, factor)
    return best


def powers(unit: str) -> str:
    """Return a unit with its power raised.

    Examples
    --------
    >>> powers("mm^-2"), powers("px")
    ('mm⁻²', 'px')
    """
    head, _, power = unit.partition("^")
    return head + power.translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def names(labels: Iterable[str], most: int = 6) -> str:
    """Return labels as a list, the first ones only.

    Examples
    --------
    >>> names(["a", "b", "c"], 2)
    'a, b and 1 more'
    """
    known: Sequence[str] = list(labels)
    if len(known) <= most:
        return ", ".join(known)
    return tr("{names} and {count} more").format(names=", ".join(known[:most]), count=len(known) - most)


def plural(count: int, word: str, words: str = "") -> str:
    """Return a count with its noun.

    Examples
    --------
    >>> plural(1, "image"), plural(3, "image")
    ('1 image', '3 images')
    """
    return f"{count} {tr(word if count == 1 else words or word + 's')}"
