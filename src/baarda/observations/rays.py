"""From where the image points of a network see its object points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baarda.network import State, Viewpoints
from baarda.observations.base import Kind
from baarda.observations.image_points import ImagePoints


def viewpoints_of(groups: Sequence[Kind], state: State) -> Viewpoints:
    """Return from where each point is seen at a state."""
    seen = [g for g in groups if isinstance(g, ImagePoints)]
    nothing = np.zeros(0, dtype=np.intp)
    images, points = (np.concatenate([nothing, *(getattr(g, name) for g in seen)]) for name in ("images", "points"))
    return Viewpoints.of(images, points, state.position, len(state.points))
