"""Camera models: one file per projection or correction set."""

from __future__ import annotations

from baarda.cameras.base import FIXED, FREE, OBSERVED, STATES, Camera, CameraModel, Optics, create
from baarda.discover import members
from baarda.errors import UsageError

__all__ = ["FIXED", "FREE", "OBSERVED", "STATES", "Camera", "CameraModel", "Optics", "create", "model", "models"]


def models() -> dict[str, CameraModel]:
    """Return all camera models by name."""
    return {m.name: m for m in members("baarda.cameras", CameraModel) if isinstance(m, CameraModel)}


def model(name: str) -> CameraModel:
    """Return a camera model by name.

    Raises
    ------
    UsageError
        If there is none of that name.

    Examples
    --------
    >>> model("brown").order[:3]
    ('principal_distance', 'principal_point_x', 'principal_point_y')
    """
    known = models()
    if name not in known:
        raise UsageError(f"unknown camera model {name!r}; known are {', '.join(known)}")
    return known[name]
