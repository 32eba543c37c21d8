"""Figures of the document: differences at check points, test lengths, maps over the image, and the view of the block in space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.report.plots import BLUE, GREEN, INK, MOST_MARKS, MUTED, ORANGE, drawn, nice
from baarda.report.scene import Scene
from baarda.report.translation import tr

Floats = NDArray[np.float64]


def _frame(axes: Any, low: Floats, high: Floats, unit: str, letters: str = "XY") -> Floats:
    """Set the limits of a plan, tell long coordinates as an offset, and return the offset."""
    reach = np.maximum(high - low, 1e-9)
    origin = np.where(np.abs(low) > 50.0 * reach, np.floor(low / 100.0) * 100.0, 0.0)
    rim = 0.08 * float(reach.max())
    axes.set_xlim(low[0] - origin[0] - rim, high[0] - origin[0] + rim)
    axes.set_ylim(low[1] - origin[1] - rim, high[1] - origin[1] + rim)
    axes.set_aspect("equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    for letter, o, put in zip(letters, origin.tolist(), (axes.set_xlabel, axes.set_ylabel), strict=True):
        put(f"{letter} ({unit})" if o == 0.0 else f"{letter} {'-' if o > 0 else '+'} {abs(o):.0f} ({unit})")
    axes.grid(True)
    axes.tick_params(length=3)
    return np.asarray(origin)


def check_vectors(
    points: Floats, at: Floats, differences: Floats, labels: Sequence[str], unit: str, told: str, name: str = "check-vectors"
) -> tuple[str, float]:
    """Return the plan of check points with their differences, and the length of the scale arrow.

    Parameters
    ----------
    points : (n, 3) array
        All object points, object units; drawn faintly, except those without coordinates (NaN).
    at, differences : (m, 3) arrays
        Check points, object units, and adjusted - given, in `told`; NaN where a coordinate was not given.
    labels : sequence of str
        Names of the check points, written beside them when there are few.
    unit, told : str
        Units of coordinates and differences.
    name : str
        Prefix of ids.

    Returns
    -------
    svg : str
    arrow : float
        Length of the scale arrow in `told`.

    Examples
    --------
    >>> svg, arrow = check_vectors(np.zeros((2, 3)), np.zeros((1, 3)), np.array([[3.0, 4.0, -2.0]]), ["7"], "m", "mm")
    >>> svg.startswith("<svg"), arrow
    (True, 5.0)
    """
    d = np.nan_to_num(differences)
    points = points[np.isfinite(points).all(axis=1)]  # a point that was set aside may have no coordinates
    largest = float(max(np.hypot(d[:, 0], d[:, 1]).max(), np.abs(d[:, 2]).max())) or 1.0
    everything = np.concatenate([points, at])[:, :2]
    low, high = everything.min(axis=0), everything.max(axis=0)
    reach = float(np.maximum(high - low, 1e-9).max())
    scale = 0.12 * reach / largest
    arrow = nice(largest)
    wide, tall = np.maximum(high - low, 0.2 * reach)
    size = (6.6, float(np.clip(5.6 * tall / wide + 1.0, 3.0, 7.5)))

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        o = _frame(axes, low, high, unit)
        axes.plot(
            *(points[:, :2] - o).T, ".", color=MUTED, markersize=1.8, alpha=0.6, rasterized=len(points) > MOST_MARKS, label=tr("points")
        )
        x, y = (at[:, :2] - o).T
        axes.plot(x, y, "D", markerfacecolor="none", markeredgecolor=INK, markersize=5, markeredgewidth=0.9, label=tr("check points"))
        style = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / scale, "width": 0.004, "zorder": 4}
        axes.quiver(x, y, d[:, 0], d[:, 1], color=BLUE, label=tr("horizontal difference"), **style)
        for sign, colour, words in ((1.0, ORANGE, tr("too high")), (-1.0, GREEN, tr("too low"))):
            rows = sign * d[:, 2] > 0.0
            if rows.any():
                axes.vlines(x[rows], y[rows], y[rows] + scale * d[rows, 2], color=colour, linewidth=2.6, alpha=0.8, label=words, zorder=3)
        if len(labels) <= 40:
            for text, a, b in zip(labels, x.tolist(), y.tolist(), strict=True):
                axes.annotate(text[:16], (a, b), xytext=(6, -9), textcoords="offset points", fontsize=7.5, color=MUTED)
        left, right = axes.get_xlim()
        share = arrow * scale / (right - left)
        straight = {"arrowstyle": "<-", "color": INK, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (0.0, 1.03), (share, 1.03), "axes fraction", arrowprops=straight)
        axes.text(share + 0.015, 1.03, f"{arrow:g} {told}", transform=axes.transAxes, va="center", fontsize=8.5)
        figure.legend(loc="outside lower center", ncols=3)

    return drawn(name, size, draw), arrow


def length_deviations(lengths: Floats, deviations: Floats, sigmas: Floats, unit: str, told: str, name: str = "length-deviations") -> str:
    """Return deviations of test lengths over their length, with twice their standard deviations.

    Parameters
    ----------
    lengths : (n,) array
        In `unit`.
    deviations, sigmas : (n,) arrays
        In `told`; NaN where a length has no control.
    unit, told : str
    name : str
        Prefix of ids.

    Returns
    -------
    str
    """

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        axes.axhline(0.0, color=INK, linewidth=0.9, linestyle=(0, (5, 2)))
        axes.errorbar(lengths, deviations, 2.0 * sigmas, fmt="o", color=BLUE, markersize=4, elinewidth=0.9, capsize=2.5)
        axes.set_xlabel(f"{tr('length')} ({unit})")
        axes.set_ylabel(f"{tr('deviation')} ({told})")
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.grid(True)
        axes.tick_params(length=3)

    return drawn(name, (6.2, 3.2), draw)


def iterations(
    counts: Sequence[int],
    objective: Floats,
    relative: Floats,
    damping: Floats,
    accepted: NDArray[np.bool_],
    what: str,
    name: str = "iterations",
) -> str:
    """Return the course of the iterations: what is made least, the relative step, and the damping where there was any.

    Parameters
    ----------
    counts : sequence of int
        Numbers of the iterations, from 0 for the start.
    objective, relative, damping : (n,) arrays
        What is made least, relative step (NaN where there is none), and Levenberg's damping (0 = none).
    accepted : (n,) array of bool
        Steps that were not refused.
    what : str
        Name of what is made least.
    name : str
        Prefix of ids.

    Returns
    -------
    str

    Examples
    --------
    >>> svg = iterations([0, 1], np.array([5.0, 2.0]), np.array([np.nan, 0.3]), np.zeros(2), np.ones(2, dtype=bool), "v'Pv")
    >>> svg.startswith("<svg")
    True
    """
    x = np.asarray(counts)
    panels = [(what, objective, BLUE), (tr("relative step"), relative, ORANGE)]
    if (damping > 0.0).any():
        panels.append((tr("damping"), np.where(damping > 0.0, damping, np.nan), GREEN))

    def draw(figure: Any) -> None:
        from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

        for axes, (title, values, colour) in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
            seen = np.isfinite(values) & accepted
            axes.plot(x[seen], values[seen], "o-", color=colour, markersize=3.5, linewidth=1.2)
            out = np.isfinite(values) & ~accepted
            axes.plot(x[out], values[out], "x", color=INK, markersize=5)
            known = values[np.isfinite(values)]
            # A log-likelihood may be negative, and a range below a power of ten has no ticks of its own on a logarithmic scale.
            if len(known) and known.min() > 0.0 and known.max() > 20.0 * known.min():
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(numticks=6))
                axes.yaxis.set_minor_formatter(NullFormatter())
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}"))
            axes.set_title(title, loc="left")
            axes.set_xlabel(tr("iteration"))
            axes.xaxis.get_major_locator().set_params(integer=True)
            for side in ("top", "right"):
                axes.spines[side].set_visible(False)
            axes.grid(True)
            axes.tick_params(length=3)

    return drawn(name, (3.0 * len(panels) + 0.4, 2.5), draw)


def cell_maps(cells: Sequence[tuple[str, Floats, str]], frame: tuple[float, float, float, float], y_down: bool, name: str) -> str:
    """Return maps over the image side by side: one value per cell of a grid.

    Parameters
    ----------
    cells : sequence of (title, (rows, columns) array, colour map)
        Values in cells from the corner of the frame; NaN = no observation there.
    frame : tuple of float
        Left, right, lower and upper limit of the image coordinates, pixels.
    y_down : bool
        Whether y counts downwards.
    name : str
        Prefix of ids.

    Returns
    -------
    str
    """
    left, right, low, high = frame
    tall = float(np.clip(3.3 * (high - low) / (right - left) + 1.5, 2.4, 5.5))

    def draw(figure: Any) -> None:
        for axes, (title, values, colours) in zip(np.atleast_1d(figure.subplots(1, len(cells))), cells, strict=True):
            rows, columns = values.shape
            x = np.linspace(left, right, columns + 1)
            y = np.linspace(low, high, rows + 1)
            # A few cells with hardly controlled points would take all colours from the others.
            known = values[np.isfinite(values)]
            low_end, high_end = float(known.min()), float(known.max())
            least, most = (float(np.quantile(known, q)) for q in (0.03, 0.97))
            outer = (
                low_end if most - low_end < 3.0 * (most - least) else least,
                high_end if high_end - least < 3.0 * (most - least) else most,
            )
            extend = ("both" if outer[1] < high_end else "min") if outer[0] > low_end else "max" if outer[1] < high_end else "neither"
            span = {"vmin": outer[0], "vmax": outer[1]} if outer[1] > outer[0] else {}
            shown = axes.pcolormesh(x, y, np.ma.masked_invalid(values), cmap=colours, rasterized=True, **span)
            axes.set_aspect("equal")
            if y_down:
                axes.invert_yaxis()
            axes.set_title(title, loc="left")
            axes.set_xlabel(tr("image x (px)"))
            axes.tick_params(length=3)
            axes.locator_params(nbins=5)
            bar = figure.colorbar(shown, ax=axes, location="bottom", shrink=0.9, aspect=24, extend=extend)
            bar.outline.set_visible(False)
        figure.axes[0].set_ylabel(tr("image y (px)"))

    return drawn(name, (3.7 * len(cells), tall), draw)


def space(scene: Scene, name: str = "block-in-space", most_ellipses: int = 60) -> str:
    """Return the view of a block in space: points coloured by their standard deviation, cameras, ellipsoids, suspected rays.

    Parameters
    ----------
    scene : Scene
    name : str
        Prefix of ids.
    most_ellipses : int
        Ellipsoids drawn, the largest.

    Returns
    -------
    str
    """
    view = scene.view()
    xy = scene.points @ view.T
    depth = scene.points @ np.cross(view[0], view[1])
    order = np.argsort(depth, kind="stable")
    ends = scene.frustum() @ view.T  # (cameras, 5, 2): centre and four corners
    seen = np.concatenate([scene.core @ view.T, ends.reshape(-1, 2)])
    low, high = seen.min(axis=0), seen.max(axis=0)
    span = np.maximum(high - low, 1e-9)
    size = (7.4, float(np.clip(6.6 * span[1] / span[0] + 1.4, 3.6, 8.0)))
    positive = scene.sigmas[scene.sigmas > 0.0]
    limits = (float(np.quantile(positive, 0.02)), float(np.quantile(positive, 0.98))) if len(positive) else (0.0, 1.0)

    def draw(figure: Any) -> None:
        from matplotlib.collections import EllipseCollection, LineCollection

        axes = figure.add_subplot()
        many = len(xy) > MOST_MARKS
        if len(scene.rays):
            lines = np.stack([ends[scene.rays[:, 0], 0], xy[scene.rays[:, 1]]], axis=1)
            axes.add_collection(
                LineCollection(list(lines), colors=ORANGE, linewidths=0.7, alpha=0.75, label=tr("suspected rays"), zorder=2)
            )
        chosen = scene.ellipsoids[:most_ellipses]
        if len(chosen):
            values, vectors = np.linalg.eigh(view @ scene.covariances[: len(chosen)] @ view.T)
            axis = 2.0 * scene.enlarged * np.sqrt(np.maximum(values, 0.0))
            angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
            style: dict[str, Any] = {"units": "xy", "facecolors": "none", "edgecolors": MUTED, "linewidths": 0.6, "zorder": 3}
            axes.add_collection(
                EllipseCollection(axis[:, 1], axis[:, 0], angle, offsets=xy[chosen], offset_transform=axes.transData, **style)
            )
        path = ends[:, [0, 1, 2, 0, 3, 4, 0, 1, 4, 3, 2], :]
        thin = 0.8 if len(path) <= 300 else 0.3
        axes.add_collection(
            LineCollection(list(path), colors=BLUE, linewidths=thin, label=tr("cameras"), rasterized=len(path) > 1000, zorder=4)
        )
        fixed = scene.sigmas[order] <= 0.0
        shown = axes.scatter(*xy[order[~fixed]].T, 9.0 if len(xy) <= 1000 else 3.0, c=scene.sigmas[order[~fixed]], cmap="viridis",
                             vmin=limits[0], vmax=limits[1], linewidth=0.0, rasterized=many, label=tr("points"), zorder=5)  # fmt: skip
        if fixed.any():
            axes.scatter(
                *xy[order[fixed]].T, 30.0, marker="^", facecolors="none", edgecolors=INK, linewidths=0.9, label=tr("fixed points"), zorder=6
            )
        # The three axes, from the lower left corner of the figure.
        corner, long = low - 0.02 * span, 0.08 * float(span.max())
        for k, letter in enumerate("XYZ"):
            tip = corner + long * view[:, k]
            axes.annotate("", tip, corner, arrowprops={"arrowstyle": "->", "color": INK, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0})
            axes.annotate(letter, corner + 1.25 * long * view[:, k], ha="center", va="center", fontsize=8.5)
        rim = 0.06 * float(span.max())
        axes.set_xlim(low[0] - rim - 0.3 * long, high[0] + rim)
        axes.set_ylim(low[1] - rim - 0.3 * long, high[1] + rim)
        axes.set_aspect("equal")
        axes.set_axis_off()
        figure.legend(loc="outside lower center", ncols=4)
        if len(positive):
            bar = figure.colorbar(shown, ax=axes, shrink=0.6, aspect=28, extend="both")
            bar.set_label(f"{tr('spatial standard deviation')} ({scene.told})")
            bar.outline.set_visible(False)

    return drawn(name, size, draw)
