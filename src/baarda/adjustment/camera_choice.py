"""Which camera parameters are estimated: what `--camera` asks for, applied to the cameras of a network."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import FIXED, FREE, Camera, CameraModel, model, models
from baarda.cameras.conversion import Conversion, converted
from baarda.errors import UsageError
from baarda.network import Network
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]
Choice = tuple[str, ...] | str | None
SETS = "camera_sets"  # key of the settings of a network under which a project keeps its own sets
_WORDS = ("source", "none", "all")
_HELD = "fixed-"


@dataclass(frozen=True)
class Preset:
    """A camera model to change to: its parts, and which of them keep their parameters fixed."""

    parts: tuple[str, ...]
    held: tuple[bool, ...]


def with_cameras(network: Network, choice: Choice) -> tuple[Network, list[str]]:
    """Return a network whose cameras have the models and free parameters that a choice names.

    Parameters
    ----------
    network : Network
    choice : str, tuple of str, or None
        None and ``"source"``: as the source has it. ``"none"`` and ``()``: all camera parameters fixed. ``"all"``: all estimated. A list
        of parameters (separated by commas in a string): these are estimated, the others fixed. A preset, alone or in the list: a camera
        model (``"ebner12"``) or a sum of them (``"fixed-brown+ebner12"``, ``"source+gruen44"``): every camera is converted to it; its
        additional parameters are estimated, those of a part with ``fixed-`` keep their converted values, interior orientation stays as
        free or fixed as it was. Parameters of known sigma stay observed.

    Returns
    -------
    network : Network
    notes : list of str
        What was converted, with the misfit, for the report.

    Raises
    ------
    UsageError
        If a name is neither a parameter nor a preset, or a camera cannot be converted.

    Examples
    --------
    >>> from importlib.resources import files
    >>> import baarda
    >>> network, notes = with_cameras(baarda.read(files("baarda") / "data/camcal/camcaldemo.xml"), "fixed-source+ebner12")
    >>> network.cameras[0].model.name, len(notes)
    ('brown+ebner12', 1)
    """
    if choice is None:
        return network, []
    names = tuple(t.strip() for t in choice.split(",") if t.strip()) if isinstance(choice, str) else tuple(choice)
    own: tuple[CameraModel, ...] = tuple(network.settings.get(SETS, ()))
    presets = [p for p in (_preset(n, own) for n in names) if p is not None]
    if len(presets) > 1:
        raise UsageError("--camera takes one preset; join several sets by +, for instance brown+ebner12")
    names = tuple(n for n in names if _preset(n, own) is None)
    notes: list[str] = []
    cameras = network.cameras
    if presets:
        cameras, notes = _converted(network, presets[0], own)
    known = {name for c in cameras for name in c.model.order}
    unknown = [n for n in names if n not in known and n not in _WORDS]
    if unknown:
        described = ", ".join([*models(), *(m.name for m in own)])
        raise UsageError(
            f"no camera has a parameter {unknown[0]!r}; known are {', '.join(sorted(known))}; presets are {described}, sums such as "
            "fixed-brown+ebner12, and source, none, all"
        )
    keep = bool(presets) or "source" in names
    return replace(network, cameras=tuple(_with_free(c, names, keep) for c in cameras)), notes


def _with_free(camera: Camera, names: tuple[str, ...], keep: bool) -> Camera:
    """Return the camera with the named parameters estimated and the others fixed, or (keep) as they are."""
    wanted = np.isin(camera.model.order, names) | ("all" in names)
    others = camera.states if keep else FIXED
    return replace(camera, states=np.where(wanted, np.where(camera.states == FIXED, FREE, camera.states), others).astype(np.int8))


def _preset(text: str, own: Iterable[CameraModel]) -> Preset | None:
    """Return the preset of a text like ``fixed-brown+ebner12``; None where the text is no preset."""
    if text in _WORDS:
        return None
    known = {*models(), *(m.name for m in own), "source"}
    parts = tuple(text.split("+"))
    held = tuple(p.startswith(_HELD) and p not in known for p in parts)
    plain = tuple(p.removeprefix(_HELD) if h else p for p, h in zip(parts, held, strict=True))
    if len(parts) == 1 and plain[0] not in known:
        return None
    wrong = next((p for p in plain if p not in known), None)
    if wrong is not None:
        raise UsageError(f"unknown camera model {wrong!r} in --camera {text}; known are {', '.join(sorted(known))}")
    return Preset(plain, held)


def _converted(network: Network, preset: Preset, own: tuple[CameraModel, ...]) -> tuple[tuple[Camera, ...], list[str]]:
    cameras: list[Camera] = []
    groups: dict[tuple[str, str], list[Conversion]] = {}
    for i, camera in enumerate(network.cameras):
        had = tuple(p for p in re.split(r"\+", camera.model.name))
        parts = [q for p in preset.parts for q in (had if p == "source" else (p,))]
        held = [h for p, h in zip(preset.parts, preset.held, strict=True) for _ in (had if p == "source" else (p,))]
        target = model("+".join(parts), own)
        pieces = [model(p, own) for p in parts]
        added = {p.name for m in pieces[1:] for s in m.steps if s.additional for p in s.parameters}
        frozen = {p.name for m, h in zip(pieces, held, strict=True) if h for s in m.steps if s.additional for p in s.parameters}
        c = converted(camera, target, _measured(network, i), added)
        states = np.where(np.isin(target.order, list(frozen)), FIXED, c.camera.states)
        free = np.array(target.additional) & ~np.isin(target.order, list(frozen)) & (states == FIXED)
        cameras.append(replace(c.camera, states=np.where(free, FREE, states).astype(np.int8)))
        groups.setdefault((camera.model.name, target.name), []).append(c)
    return tuple(cameras), [_note(old, new, found) for (old, new), found in groups.items()]


def _measured(network: Network, camera: int) -> Floats:
    """Return all image points of a camera, source pixels."""
    groups = [g for g in network.observations if isinstance(g, ImagePoints)]
    return np.concatenate([np.zeros((0, 2)), *(g.xy[network.images.cameras[g.images] == camera] for g in groups)])


def _note(old: str, new: str, found: list[Conversion]) -> str:
    labels = [c.camera.label for c in found]
    who = f"camera {labels[0]}" if len(found) == 1 else f"{len(found)} cameras ({', '.join(labels[:6])}{', ...' if len(found) > 6 else ''})"
    if old == new:
        return f"{who}: model {new} as in the source, its additional parameters estimated or fixed as --camera says"
    if not any(c.fitted for c in found):
        return f"{who}: model {old} became {new}; all values were carried over, the two map alike"
    rms, largest = max(c.rms for c in found), max(c.largest for c in found)
    return (
        f"{who}: model {old} became {new}; start values were fitted over the part of the image that has points, misfit {rms:.3g} px rms "
        f"per coordinate, {largest:.3g} px at most"
    )
