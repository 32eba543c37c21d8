"""A camera under another model: values carried over where their meaning is the same, fitted over the image where it is not."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from baarda.cameras.base import FIXED, FREE, OBSERVED, Camera, CameraModel, Floats, Optics
from baarda.errors import UsageError

_SIDE = 21  # points along a side of the image at which two models are compared
_STEPS = 30
_SAME = 1e-9  # pixels
_PLANAR = 1e-10  # directions in which columns of unit length say less than this are left alone


@dataclass(frozen=True)
class Conversion:
    """A camera under another model, and how far the two disagree.

    Attributes
    ----------
    camera : Camera
    rms, largest : float
        Difference of the two models over the compared part of the image: root mean square of a coordinate, largest length, source pixels.
    fitted : tuple of str
        Parameters whose values were fitted; empty where all were carried over.
    """

    camera: Camera
    rms: float
    largest: float
    fitted: tuple[str, ...]


def converted(camera: Camera, model: CameraModel, measured: Floats | None = None, hold: Collection[str] = ()) -> Conversion:
    """Return a camera under another model that maps as nearly the same as that model can.

    Parameters
    ----------
    camera : Camera
    model : CameraModel
    measured : (n, 2) array, optional
        Measured image points, source pixels: the models are compared over the rectangle around them, else over the whole image.
    hold : collection of str
        Parameters of the new model that are not fitted and start at zero (or what was carried over).

    Returns
    -------
    Conversion
        Parameters of the same step in the same place keep value, state and sigma; interior orientation that is fixed or observed keeps its
        value. The rest is fitted by least squares of image coordinates and is free (additional parameters) or as the source has it.

    Raises
    ------
    UsageError
        If the image size is not known and no image points are given, or the camera cannot be inverted anywhere.

    Examples
    --------
    >>> from baarda.cameras import create, model
    >>> brown = create("1", model("brown"), {"principal_distance": 900.0, "K1": 1e-8}, image_size=(1000, 800))
    >>> c = converted(brown, model("brown+ebner12"))
    >>> c.largest, c.fitted
    (0.0, ())
    """
    if measured is not None and len(measured):
        low, high = measured.min(axis=0), measured.max(axis=0)
    elif camera.image_size is not None:
        low, high = np.zeros(2), np.asarray(camera.image_size, dtype=float)
    else:
        raise UsageError(f"camera {camera.label}: the image size must be known to convert model {camera.model.name} to {model.name}")
    pixels = np.stack(np.meshgrid(*np.linspace(low, high, _SIDE).T, indexing="ij"), axis=-1).reshape(-1, 2)
    normalised, valid = Optics.of(camera).correct(pixels, camera.values[None])
    pixels, normalised = pixels[valid], normalised[valid]
    if not len(pixels):
        raise UsageError(f"camera {camera.label}: its distortion cannot be inverted anywhere in the image")
    new, carried = _carried(camera, model)
    if model.on_grid and new.grid is None and new.image_size is None:
        centre = np.array([camera.values[camera.model.order.index(f"principal_point_{a}")] for a in "xy"])
        size = np.asarray(camera.pixel_size)
        new = replace(new, grid=float(np.abs((np.stack([low, high]) - camera.origin) * size - centre).max()))
    optics = Optics.of(new)
    misfit = _misfit(optics, new.values, normalised, pixels)[0]
    fit = np.array([name not in carried and name not in hold for name in model.order])
    fitted: tuple[str, ...] = ()
    if fit.any() and np.abs(misfit).max() > _SAME:
        fitted = tuple(name for name, f in zip(model.order, fit, strict=True) if f)
        values, misfit = _fitted(optics, new.values, fit, normalised, pixels)
        new = replace(new, values=values)
    return Conversion(new, float(np.sqrt(np.mean(misfit**2))), float(np.linalg.norm(misfit, axis=1).max()), fitted)


def _carried(camera: Camera, model: CameraModel) -> tuple[Camera, set[str]]:
    """Return the camera with what the two models share, and the names of values that are not to be fitted."""
    old = camera.model
    same = {p.name for chain in ("measured", "ideal") for s in getattr(old, chain) if s in getattr(model, chain) for p in s.parameters}
    interior = {n for n, a in zip(old.order, old.additional, strict=True) if not a}
    at = {name: k for k, name in enumerate(old.order)}
    values = np.array([p.default for p in model.parameters], dtype=float)
    states = np.full(len(values), FREE, dtype=np.int8)
    sigmas, given = np.full(len(values), np.nan), np.full(len(values), np.nan)
    kept = set()
    for j, (name, additional) in enumerate(zip(model.order, model.additional, strict=True)):
        if name in at and (name in same or (name in interior and not additional)):
            k = at[name]
            values[j], states[j], sigmas[j], given[j] = camera.values[k], camera.states[k], camera.sigmas[k], camera.prior[k]
            if additional or states[j] != FREE:
                kept.add(name)
        elif name.startswith("principal_distance"):  # one distance against two: their mean, free unless all were fixed
            ks = [k for n, k in at.items() if n.startswith("principal_distance")]
            values[j] = float(np.mean(camera.values[ks]))
            states[j] = FIXED if (camera.states[ks] == FIXED).all() else FREE
    given = np.where(states == OBSERVED, given, values)
    prior = None if np.array_equal(given, values) else given
    return replace(camera, model=model, values=values, states=states, sigmas=sigmas, given=prior), kept


def _misfit(optics: Optics, values: Floats, normalised: Floats, pixels: Floats) -> tuple[Floats, Floats]:
    computed, _, d_p, valid = optics.distort(normalised, values[None], start=pixels)
    return np.where(valid[:, None], computed - pixels, np.inf), d_p


def _fitted(optics: Optics, values: Floats, fit: Floats, normalised: Floats, pixels: Floats) -> tuple[Floats, Floats]:
    """Return the values with those of `fit` by least squares, and the misfit; of several solutions the smallest change."""
    misfit, d_p = _misfit(optics, values, normalised, pixels)
    for _ in range(_STEPS):
        a = d_p[:, :, fit].reshape(misfit.size, -1)
        scale = np.linalg.norm(a, axis=0)
        scale[scale == 0.0] = 1.0
        step = np.linalg.lstsq(a / scale, -misfit.ravel(), rcond=_PLANAR)[0] / scale
        before = float(np.sum(misfit**2))
        for fraction in 0.5 ** np.arange(8):
            trial = values.copy()
            trial[fit] += fraction * step
            new = _misfit(optics, trial, normalised, pixels)
            after = float(np.sum(new[0] ** 2))
            if after < before:
                values, (misfit, d_p) = trial, new
                break
        else:
            break
        if before - after <= 1e-12 * before:
            break
    return values, misfit
