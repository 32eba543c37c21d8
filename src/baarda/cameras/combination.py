"""Camera models made of others: `brown+ebner12` corrects by Brown's lens and then by Ebner's set."""

from __future__ import annotations

from collections.abc import Mapping

from baarda.cameras.base import CameraModel, Step
from baarda.cameras.pinhole import distance, flip, to_centre
from baarda.errors import UsageError


def combined(name: str, known: Mapping[str, CameraModel]) -> CameraModel:
    """Return the model of a name like ``brown+ebner12``: the steps of the second are added behind those of the first.

    Parameters
    ----------
    name : str
        Names of models joined by ``+``; the first has any `correct` model, the others a set on the centred point.
    known : mapping
        The models by name.

    Returns
    -------
    CameraModel

    Raises
    ------
    UsageError
        If there is no model of a name, one does not correct measured coordinates, or two have a parameter of one name.

    Examples
    --------
    >>> from baarda.cameras import models
    >>> combined("pinhole+ebner12", models()).order[2:5]
    ('principal_point_y', 'E1', 'E2')
    """
    parts = name.split("+")
    for part in parts:
        if part not in known:
            raise UsageError(f"unknown camera model {part!r}; known are {', '.join(known)}, and sums such as brown+ebner12")
    first, *others = (known[part] for part in parts)
    steps: tuple[Step, ...] = ()
    for m in (first, *others):
        if m.ideal != (distance,) or to_centre not in m.measured or flip not in m.measured:
            raise UsageError(f"camera model {m.name} does not correct measured coordinates and cannot be part of {name}")
    for m in others:
        if m.measured[:2] != (to_centre, flip):
            raise UsageError(f"camera model {m.name} corrects before the point is centred and can only be the first of {name}")
        steps += m.measured[2:]
    order = first.order + tuple(p.name for s in steps for p in s.parameters)
    twice = next((n for n in order if order.count(n) > 1), None)
    if twice is not None:
        raise UsageError(f"camera model {name}: two parts have a parameter {twice!r}")
    values = {k: v for m in (*reversed(others), first) for k, v in m.examples[0].items() if k in order}
    return CameraModel(
        name=name,
        description=" + ".join(m.description for m in (first, *others)),
        order=order,
        measured=first.measured + steps,
        ideal=(distance,),
        examples=(values,),
    )
