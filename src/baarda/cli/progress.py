"""How far a run has come and how long it still takes, in words: lines on the error stream."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import typer

_EVERY = 2.0  # seconds between two lines that only count
_WORTH = 2.0  # seconds: who has read so little is at the end already
_SHRINKS = 0.97  # steps that shrink more slowly tell nothing about the end


def about(seconds: float) -> str:
    """Return a rough duration.

    Examples
    --------
    >>> about(0.2), about(37.6), about(200.0), about(9000.0)
    ('about 1 s', 'about 38 s', 'about 3 min', 'about 2.5 h')
    """
    if seconds < 90.0:
        return f"about {max(1.0, seconds):.0f} s"
    return f"about {seconds / 60.0:.0f} min" if seconds < 5400.0 else f"about {seconds / 3600.0:.1f} h"


def left(elapsed: float, done: int, todo: int) -> str:
    """Return how long `todo` pieces take if `done` ones took `elapsed` seconds, after a comma; nothing where that is not known.

    Examples
    --------
    >>> left(10.0, 2, 6), left(10.0, 0, 8), left(10.0, 8, 0)
    (', about 30 s left', '', '')
    """
    return f", {about(elapsed / done * todo)} left" if done > 0 and todo > 0 else ""


def shortened(text: str, length: int = 160) -> str:
    """Return the beginning of a text that is long.

    Examples
    --------
    >>> shortened("no column 'x'; there are a, b, c, d", 25)
    "no column 'x'; there are ..."
    >>> shortened("short")
    'short'
    """
    return text if len(text) <= length else text[: length + 1].rsplit(" ", 1)[0][:length] + " ..."


def steps_left(before: float, now: float, tolerance: float) -> int | None:
    """Return how many steps are left, from the sizes of the last two; None where they hardly shrink.

    Iteration ends where the next step, by the rate of the last two and with caution, is below the tolerance.

    Examples
    --------
    >>> steps_left(1e-2, 1e-3, 1e-10), steps_left(1e-8, 1e-10, 1e-10), steps_left(1e-3, 0.99e-3, 1e-10)
    (7, 0, None)
    """
    rate = now / before if before > 0.0 else 1.0
    if not 0.0 < rate < _SHRINKS:
        return None
    target = tolerance / min(10.0 * rate, 1.0)
    return max(0, math.ceil(math.log(target / now) / math.log(rate) - 1e-9))


class Iterations:
    """Tells each iteration: what falls, the step, the time since the start and, after two plain steps, the time that is left.

    Parameters
    ----------
    started : float
        `time.perf_counter()` at the start of the run.
    tolerance : float
        Relative step at which iteration ends.
    robust : bool
        Whether a law of errors is adjusted: least squares comes first, then minus the log-likelihood falls.
    """

    def __init__(self, started: float, tolerance: float, robust: bool = False) -> None:
        self.started, self.tolerance, self.robust = started, tolerance, robust
        self._count, self._stage, self._last = 0, 0, time.perf_counter()
        self._before: float | None = None  # the last step, if it was taken without damping

    def __call__(self, step: Any) -> None:
        """Tell one iteration."""
        now = time.perf_counter()
        if step.count <= self._count:  # the count begins anew: another objective
            self._stage, self._before = self._stage + 1, None
        what = "- log L" if self.robust and self._stage else "v'Pv"
        relative = "" if step.relative_step is None else f"  relative step {step.relative_step:.1e}"
        damping = f"  damping {step.damping:.0e}" if step.damping else ""
        taken = "" if step.accepted else "  rejected"
        rest = self._left(step, now - self._last)
        typer.echo(
            f"iteration {step.count:>2}  {what} {step.objective:.10g}{relative}{damping}{taken}  {now - self.started:.1f} s{rest}", err=True
        )
        self._count, self._last = step.count, now

    def _left(self, step: Any, seconds: float) -> str:
        plain = step.accepted and step.damping == 0.0 and step.relative_step is not None
        before, self._before = self._before, step.relative_step if plain else None
        if before is None or self._before is None:
            return ""
        rest = (steps_left(before, self._before, self.tolerance) or 0) * seconds
        return f", {about(rest)} of iterations left" if rest >= _WORTH else ""


class Counted:
    """Tells now and then how many of many equal pieces are done and how long the others take.

    Parameters
    ----------
    what : str
        The pieces.
    every : float
        Seconds between two lines.
    """

    def __init__(self, what: str, every: float = _EVERY) -> None:
        self.what, self.every = what, every
        self._begin = self._last = time.perf_counter()

    def __call__(self, done: int, total: int) -> None:
        """Tell that `done` of `total` are done; 0 starts the clock."""
        now = time.perf_counter()
        if done == 0:
            self._begin = self._last = now
        elif now - self._last >= self.every:
            self._last = now
            typer.echo(f"{done} of {total} {self.what}{left(now - self._begin, done, total - done)}", err=True)


def stage(quiet: bool) -> Callable[[str], None]:
    """Return what tells the stage that begins: a line on the error stream, nothing where quiet."""
    return (lambda text: None) if quiet else (lambda text: typer.echo(f"{text} ...", err=True))


def first_answer(adjustment: Any) -> str:
    """Return in one line what is known before anything is tested: size of the residuals and redundancy.

    Parameters
    ----------
    adjustment : Adjustment
        Converged.

    Returns
    -------
    str

    Examples
    --------
    >>> import baarda
    >>> from importlib.resources import files
    >>> network = baarda.read(files("baarda") / "data" / "camcal" / "camcaldemo.xml")
    >>> first_answer(baarda.adjust(network))
    'adjusted: s0 1.615, redundancy 3725, image residuals 0.15 px rms per coordinate'
    """
    import numpy as np

    from baarda.observations import ImagePoints

    a = adjustment
    law = a.law
    size = f"s0 {a.sigma0:.4g}" if law is None else f"{law.name.replace('_', ' ')} law of errors, scale {law.scale:.4g}"
    rows = [a.residuals[a.offsets[g] : a.offsets[g + 1]] for g, k in enumerate(a.groups) if isinstance(k, ImagePoints)]
    v = np.concatenate(rows) if rows else np.zeros(0)
    image = f", image residuals {np.sqrt(np.mean(v**2)):.3g} px rms per coordinate" if len(v) else ""
    return f"adjusted: {size}, redundancy {a.redundancy}{image}"
