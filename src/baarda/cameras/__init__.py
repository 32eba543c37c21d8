"""Camera models: one file per projection or correction set."""

from __future__ import annotations

from collections.abc import Sequence

from baarda.cameras.base import FIXED, FREE, OBSERVED, STATES, Camera, CameraModel, Optics, create
from baarda.cameras.combination import combined
from baarda.discover import members
from baarda.errors import UsageError

__all__ = ["FIXED", "FREE", "OBSERVED", "STATES", "Camera", "CameraModel", "Optics", "create", "model", "models"]


def models() -> dict[str, CameraModel]:
    """Return all camera models by name."""
    return {m.name: m for m in members("baarda.cameras", CameraModel) if isinstance(m, CameraModel)}


def model(name: str, own: Sequence[CameraModel] = ()) -> CameraModel:
    """Return a camera model by name.

    Parameters
    ----------
    name : str
        A name of `models` or of `own`, or several joined by ``+``: see `baarda.cameras.combination.combined`.
    own : sequence of CameraModel
        Models of a project beside those of the package.

    Raises
    ------
    UsageError
        If there is none of that name.

    Examples
    --------
    >>> model("brown").order[:3]
    ('principal_distance', 'principal_point_x', 'principal_point_y')
    >>> len(model("brown+ebner12").order)
    22
    """
    known = {**models(), **{m.name: m for m in own}}
    if "+" in name:
        return combined(name, known)
    if name not in known:
        raise UsageError(f"unknown camera model {name!r}; known are {', '.join(known)}")
    return known[name]
