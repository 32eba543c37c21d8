"""From where the image points of a network see its object points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from baarda.network import State, Viewpoints
from baarda.observations.base import Ints, Kind
from baarda.observations.direct import CorrelatedPoints, Direct
from baarda.observations.image_coordinates import ImageCoordinates
from baarda.observations.image_points import ImagePoints


def viewpoints_of(groups: Sequence[Kind], state: State) -> Viewpoints:
    """Return from where each point is seen at a state; a point that other observations than those of images tie has no base."""
    seen = [g for g in groups if isinstance(g, ImagePoints)]
    nothing = np.zeros(0, dtype=np.intp)
    images, points = (np.concatenate([nothing, *(getattr(g, name) for g in seen)]) for name in ("images", "points"))
    found = Viewpoints.of(images, points, state.position, len(state.points))
    for group in groups:
        for end in _tied_by(group):
            found.base[end] = np.nan
    return found


def _tied_by(group: Any) -> tuple[Ints, ...]:
    """Return the points that a group ties otherwise than by rays."""
    if isinstance(group, (ImagePoints, ImageCoordinates)):
        return ()
    if isinstance(group, (Direct, CorrelatedPoints)):
        return (group.nodes,) if getattr(group, "kind", "point") == "point" else ()
    return tuple(group.points_of())
