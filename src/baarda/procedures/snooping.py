"""Iterated data snooping: the worst observation out, adjust again, and back in what is cleared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from baarda.adjustment import Adjustment
from baarda.distributions.base import Distribution
from baarda.errors import UsageError
from baarda.hypotheses.levels import Options
from baarda.network import Network
from baarda.procedures.camera_selection import apply_settings
from baarda.procedures.image_snooping import snoop_images
from baarda.procedures.robust_start import suspects
from baarda.procedures.snooping_search import Search
from baarda.procedures.snooping_steps import Snooping, SnoopStep
from baarda.procedures.suspicion import Unit

MOST = 0.2  # share of the observations beyond which they are not single gross errors


def snoop(
    network: Network,
    options: Options | None = None,
    unit: Unit = "coordinate",
    tell: Callable[[str], None] | None = None,
    most: float = MOST,
    law: str | Distribution | None = None,
    **settings: Any,
) -> tuple[Snooping, Adjustment]:
    """Remove gross errors one by one, the worst first, adjust again each time, and restore what is cleared.

    Parameters
    ----------
    network : Network
    options : Options, optional
        Level, choice of tau or w, policy of levels.
    unit : {"coordinate", "point", "image"}
        What is removed at once: a scalar observation; an image point; an image (see `image_snooping.snoop_images`).
    tell : callable, optional
        Is told of each decision.
    most : float
        Share of the observations that may be rejected at most.
    law : str or Distribution, optional
        Law of errors under which critical values of single coordinates are found (`error_law.critical_values`); the shape of a named
        modulated normal or Student law is fitted to the residuals before the search.
    **settings
        Fields of `Settings`. `robust` names a law of errors under which the search starts: what it downweights is out at first, and each
        observation must be cleared to come back; so errors that mask each other are found.

    Returns
    -------
    snooping : Snooping
    adjustment : Adjustment
        By least squares, without the rejected observations.

    Raises
    ------
    UsageError
        If the unit is unknown.

    Notes
    -----
    Baarda (1968); Pope (1976); Grün (1978) p. 385-391. A rejected observation is cleared when its difference from the prediction of the
    others is within the same level. No observation is removed without which a point, an image or the datum is not determined.
    """
    o = Options() if options is None else options
    if unit not in ("coordinate", "point", "image"):
        raise UsageError(f"snooping removes a coordinate, a point or an image at once, not {unit!r}")
    if law is not None and unit != "coordinate":
        raise UsageError("critical values under a law of errors (--snoop-law) are those of single coordinates")
    robust = settings.pop("robust", None)
    shapes = settings.pop("robust_shapes", None)
    prepared, rest = apply_settings(network, settings)
    if unit == "image":
        if robust is not None:
            raise UsageError("whole images are judged by least squares: no robust start (--robust) for them")
        return snoop_images(prepared, o, tell, **rest)
    search = Search(prepared, o, unit, rest, tell, most)
    search.need_convergence()
    if law is not None:
        search.use_law(law)
    if robust is not None:
        search.begin(suspects(search.a, search.rows_of_units(), prepared, robust, shapes, o, rest), robust)
    return search.run()


__all__ = ["MOST", "SnoopStep", "Snooping", "Unit", "snoop"]
