"""Planning: what a network will be able to tell, before it is measured: its precision and its reliability, without observed values."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.adjustment import Adjustment, adjust
from baarda.errors import BaardaError, UsageError
from baarda.geometry import rotation as rot
from baarda.hypotheses.levels import Options
from baarda.hypotheses.outliers import UNCONTROLLED, external_reliability, mdb
from baarda.network import CHECK, Network, State, Table
from baarda.observations import ImageCoordinates, ImagePoints

Floats = NDArray[np.float64]
Truth = Literal["auto", "adjusted", "start"]
_BELIEVABLE = 3.0  # a standard deviation of unit weight up to which adjusted values stand for a measured network


@dataclass(frozen=True)
class Planned:
    """A network with the geometry that is taken for true, and what follows from it.

    Attributes
    ----------
    adjustment : Adjustment
        Of observations without errors: its residuals are zero, its cofactors and redundancy numbers are the prediction.
    options : Options
        Levels and power behind minimal detectable biases.
    source : {"adjusted", "start"}
        Where the true geometry comes from.
    reason : str
        Why, in words.
    """

    adjustment: Adjustment
    options: Options
    source: str
    reason: str

    @cached_property
    def controlled(self) -> NDArray[np.bool_]:
        """Which observations others control."""
        return np.asarray(self.adjustment.controlled_share >= UNCONTROLLED)

    @cached_property
    def mdb(self) -> Floats:
        """Minimal detectable biases of all n scalar observations by their a-priori sigmas, each in the unit of its own observation.

        Pixels, metres and radians stand in one array: take medians and maxima by unit. NaN where no other observation controls it.
        """
        share, pqvvp = self.adjustment.controlled_share, np.asarray(self.adjustment.evidence.pqvvp)
        return mdb(share / np.where(self.controlled, pqvvp, 1.0), share, 1.0, self.options.alpha_outlier, self.options.power)

    @cached_property
    def observations(self) -> Table:
        """One row per scalar observation: what it contributes and what it can hide."""
        table = self.adjustment.observations
        share = self.adjustment.controlled_share
        keep = ("group", "image", "point", "component", "sigma", "redundancy")
        external = external_reliability(np.where(np.abs(share - 1.0) < 1e-12, 1.0, share), self.options.alpha_outlier, self.options.power)
        return Table({**{k: table[k] for k in keep}, "mdb": self.mdb, "external": external})


def error_free(network: Network) -> Network:
    """Return a network whose observations are computed from its coordinates: all residuals are zero.

    Parameters
    ----------
    network : Network
        With coordinates of images and points; observations of unknown points become NaN and must be set aside.

    Returns
    -------
    Network
        Directly observed values and the references of check points are the coordinates, too.

    Raises
    ------
    UsageError
        If observations of a kind cannot be replaced.

    Examples
    --------
    >>> from baarda.procedures.synthetic import ring
    >>> made = error_free(ring(4, points=10).network)
    >>> group = made.observations[0]
    >>> float(abs(group.misclosures(made, State.of(made))).max()) < 1e-9
    True
    """
    state = State.of(network)
    groups = []
    for group in network.observations:
        # The errors are those of the measured image, whatever the plane in which residuals are taken.
        groups.append(with_values(group, group.observed() - _in_the_image(group).misclosures(network, state)))
    images, points = network.images, network.points
    exterior = np.concatenate([images.position, rot.to_angles(images.rotation)], axis=1)
    return replace(
        network,
        cameras=tuple(replace(c, given=np.array(c.values)) for c in network.cameras),
        images=replace(images, given=np.where(np.isfinite(images.given), exterior, np.nan)),
        points=replace(points, given=np.where(np.isfinite(points.given), points.coordinates, np.nan)),
        observations=tuple(groups),
        declared=tuple(replace(d, given=np.where(np.isfinite(d.given), d.values, np.nan)) for d in network.declared),
    )


def _in_the_image(group: Any) -> Any:
    """Return image points with residuals in the image as measured; other groups as they are."""
    if isinstance(group, ImagePoints):
        return replace(group, residual_plane="image")
    return replace(group, whole=_in_the_image(group.whole)) if isinstance(group, ImageCoordinates) else group


def with_values(group: Any, values: Floats) -> Any:
    """Return an observation group with other observed values, (rows, components).

    Raises
    ------
    UsageError
        If the kind has no table of values.
    """
    if isinstance(group, ImagePoints):
        return replace(group, xy=values)
    if isinstance(group, ImageCoordinates):
        xy = np.array(group.whole.xy)
        xy[np.arange(len(xy)), group.axes] = values[:, 0]
        return replace(group, whole=replace(group.whole, xy=xy))
    if hasattr(group, "with_values"):
        return group.with_values(values)
    if "values" not in {f.name for f in fields(group)}:
        raise UsageError(f"observations of the kind {type(group).__name__} cannot be simulated")
    return replace(group, values=np.asarray(values).reshape(np.shape(group.values)))


def plan(network: Network, options: Options | None = None, truth: Truth = "auto", **settings: Any) -> Planned:
    """Predict precision and reliability of a network from its geometry alone.

    Parameters
    ----------
    network : Network
        A planned network: its observed values need not be measured ones. Or a measured network, whose adjusted geometry is then taken.
    options : Options, optional
        Levels and power.
    truth : {"auto", "adjusted", "start"}
        Which geometry is taken for true: that of an adjustment, the start values, or the first if it converges to a standard deviation of
        unit weight of at most 3, else the second.
    **settings
        Of the adjustment: the fields of `baarda.adjustment.Settings`.

    Returns
    -------
    Planned

    Raises
    ------
    UsageError
        If neither an adjustment nor start values give a geometry, or a law of errors other than the normal is asked for.
    BaardaError
        What `baarda.adjust` raises for the planned network: datum defect, singular, redundancy not positive.

    Examples
    --------
    >>> from baarda.procedures.synthetic import ring
    >>> made = plan(ring(5, points=12).network)
    >>> made.source, made.adjustment.objective < 1e-9
    ('adjusted', True)
    """
    chosen = Options() if options is None else options
    if settings.get("robust") is not None or network.settings.get("robust") is not None:
        raise UsageError("simulate predicts the least-squares adjustment; leave the law of errors (--robust) out")
    if truth not in ("auto", "adjusted", "start"):
        raise UsageError(f"the truth is 'auto', 'adjusted' or 'start', not {truth!r}")
    geometry, source, reason = _geometry(network, truth, settings)
    adjustment = adjust(error_free(geometry), **settings)
    if adjustment.status != "converged" or adjustment.objective > 1e-9 * adjustment.count:
        raise UsageError(
            "observations computed from the geometry do not reproduce it: points behind their camera, or beyond the reach of its distortion"
        )
    return Planned(adjustment, chosen, source, reason)


def _geometry(network: Network, truth: Truth, settings: dict[str, Any]) -> tuple[Network, str, str]:
    """Return the network with the coordinates that are taken for true."""
    failed = ""
    if truth != "start":
        try:
            first = adjust(network, **settings)
        except BaardaError as error:
            if truth == "adjusted":
                raise
            failed = f"the network could not be adjusted ({error})"
        else:
            if first.status != "converged":
                failed = "the adjustment of the observed values does not converge"
            elif truth == "auto" and first.sigma0 > _BELIEVABLE:
                failed = f"the observed values do not fit ({first.sigma0:.3g} is their standard deviation of unit weight)"
            else:
                return first.network, "adjusted", f"the adjusted geometry, standard deviation of unit weight {first.sigma0:.3g}"
            if truth == "adjusted":
                raise UsageError(f"the adjusted geometry cannot be taken for true: {failed}; use the start values (--truth start)")
    images, points = network.images, network.points
    used = np.zeros(len(points.labels), dtype=bool)
    for group in network.observations:
        for end in group.points_of():
            used[end] = True
    # Control given as coordinates is a start value as good as any.
    coordinates = np.where(np.isfinite(points.coordinates) | (points.roles == CHECK)[:, None], points.coordinates, points.given)
    missing = used & ~np.isfinite(coordinates).all(axis=1)
    lost = np.asarray(~(np.isfinite(images.position).all(axis=1) & np.isfinite(images.rotation).all(axis=(1, 2))))
    if missing.any() or lost.any():
        why = f"; {failed}" if failed else ""
        raise UsageError(
            f"the start values are not complete: {int(lost.sum())} of {len(lost)} images and {int(missing.sum())} of {int(used.sum())} "
            f"points have none{why}"
        )
    why = "the start values" + (f", because {failed}" if failed else "")
    return replace(network, points=replace(points, coordinates=coordinates)), "start", why
