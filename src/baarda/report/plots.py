"""Figures as SVG text: drawn without pyplot, the same bytes for the same numbers, names never read as markup.

Colours come from one palette; a page may replace the three neutral ones (`INK`, `MUTED`, `LINE`) by its own.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.report.translation import tr

Floats = NDArray[np.float64]

INK, MUTED, LINE = "#24292f", "#656d76", "#c8ced6"
# Okabe & Ito: told apart without red-green vision; line styles differ as well.
BLUE, ORANGE, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#b0568f"
FONTS = "system-ui, 'Segoe UI', 'Liberation Sans', Arial, sans-serif"
MOST_MARKS = 2000  # beyond, marks are drawn as a picture

_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "baarda",
    "svg.image_inline": True,
    "text.parse_math": False,
    "text.usetex": False,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": False,
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlecolor": INK,
    "axes.labelsize": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "figure.dpi": 100,
    "savefig.facecolor": "none",
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "axes.axisbelow": True,
}


def drawn(name: str, size: tuple[float, float], draw: Callable[[Any], None]) -> str:
    """Return the SVG of a figure.

    Parameters
    ----------
    name : str
        Prefix of all ids, so that several figures can stand on one page; lower-case letters, digits and hyphens.
    size : tuple of float
        Width and height, inches.
    draw : callable
        Draws on the ``matplotlib.figure.Figure`` that it is given.

    Returns
    -------
    str
        An ``<svg>`` element that stands for itself, the same for the same input.

    Examples
    --------
    >>> svg = drawn("empty", (2.0, 1.0), lambda figure: None)
    >>> svg.startswith("<svg"), svg == drawn("empty", (2.0, 1.0), lambda figure: None)
    (True, True)
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    out = io.StringIO()
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")  # the reader's fonts draw the text, not ours
        # From matplotlib's own defaults: a user's matplotlibrc changes no report.
        matplotlib.rcdefaults()
        settings: Any = matplotlib.rcParams
        settings.update(_STYLE)
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure)
        figure.savefig(out, format="svg", dpi=130, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    # Names come from strangers: nothing that XML forbids, nothing that turns the direction of writing.
    lines = out.getvalue().split("\n")
    return _own("\n".join(t if t.isprintable() else "".join(c if c.isprintable() else "\ufffd" for c in t) for t in lines), name)


def _own(svg: str, name: str) -> str:
    """Drop prologue, comments and fonts, and make the ids of a drawing its own."""
    svg = svg[svg.index("<svg") :].rstrip() + "\n"
    svg = re.sub(r"<!--.*?-->\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)

    def tag(match: re.Match[str]) -> str:
        text = re.sub(r'\b(id|xlink:href|href)="(#?)([A-Za-z][^":]*)"', rf'\1="\2{name}-\3"', match[0])
        text = re.sub(r"url\(#([^)]*)\)", rf"url(#{name}-\1)", text)
        text = re.sub(r"(\d\.\d{2})\d+\b", r"\1", text) if " d=" in text else text  # paths: a hundredth of a point is enough
        return re.sub(r"(font-family: |font: [^'\";]*px )[^;\"]*", rf"\1{FONTS}", text)

    # Inside of text matplotlib writes no bare '<' or '>': what stands between them is a tag.
    return re.sub(r"<[^<>]*>", tag, svg)


def nice(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that does not exceed a positive value.

    Examples
    --------
    >>> nice(0.37), nice(7.2)
    (0.2, 5.0)
    """
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(f * power for f in (1.0, 2.0, 5.0) if f * power <= value * (1 + 1e-9)))


def _quiet(axes: Any, grid: str = "both") -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(True, axis=grid)
    axes.tick_params(length=3)


Curve = tuple[str, Floats, Floats, str, Any]


def law_curves(laws: Sequence[tuple[str, Callable[[Floats], Floats]]], x: Floats) -> list[Curve]:
    """Return label, x, density, colour and dashes of each law."""
    styles = [(INK, (0, (5, 2))), (BLUE, "solid"), (GREEN, (0, (1, 1.2))), (ORANGE, (0, (6, 1.5, 1, 1.5))), (PURPLE, (0, (3, 1)))]
    return [(label, x, density(x), *styles[i % len(styles)]) for i, (label, density) in enumerate(laws)]


def histogram(
    values: Floats, laws: Sequence[tuple[str, Callable[[Floats], Floats]]], label: str, name: str = "residual-law", reach: float = 5.0
) -> str:
    """Return the histogram of standardised residuals with the densities of laws.

    Parameters
    ----------
    values : (n,) array
    laws : sequence of (label, density)
    label : str
        Of the axis.
    name : str
    reach : float
        Values beyond are counted in the outer classes.
    """
    width = 0.25 if len(values) >= 500 else 0.5
    edges = np.arange(-reach, reach + width / 2, width)
    counts = np.histogram(np.clip(values, -reach, reach - 1e-12), edges)[0]
    density = counts / (len(values) * width)
    x = np.linspace(-reach, reach, 401) + 1e-9  # a law may have its density infinite at zero

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        axes.bar(edges[:-1], density, width, align="edge", color=BLUE, alpha=0.22, edgecolor=BLUE, linewidth=0.5, label=tr("residuals"))
        curves = law_curves(laws, x)
        for text, at, y, colour, dashes in curves:
            axes.plot(at, y, color=colour, linestyle=dashes, linewidth=1.5, label=text)
        usual = max([float(density.max()), *(float(np.median(y[np.abs(at) < 0.3])) for _, at, y, _, _ in curves)])
        axes.set_ylim(0.0, 1.15 * usual)
        axes.set_xlim(-reach, reach)
        axes.set_xlabel(tr(label))
        axes.set_ylabel(tr("density (per unit)"))
        figure.legend(loc="outside lower center", ncols=2)
        _quiet(axes, "y")

    return drawn(name, (5.2, 4.2), draw)


def quantiles(
    values: Floats, other: tuple[str, Callable[[Floats], Floats]] | None, label: str, name: str = "quantiles", most: int = 300
) -> str:
    """Return the normal Q-Q plot of standardised residuals with its 95 % band, and the line of another law.

    Parameters
    ----------
    values : (n,) array
    other : (label, quantile function) or None
        A second law drawn as a line.
    label : str
        Of the axis.
    name : str
    most : int
        Marks drawn: the outer ones all, the inner ones thinned out.
    """
    from scipy import stats

    y = np.sort(values)
    n = len(y)
    ends = min(60, n // 2)
    rank = np.unique(np.concatenate([np.arange(ends), np.linspace(0, n - 1, most).round().astype(int), np.arange(n - ends, n)])) + 1
    q = (rank - 0.5) / n
    x = stats.norm.ppf(q)
    low, high = (np.asarray(stats.norm.ppf(stats.beta.ppf(p, rank, n + 1 - rank))) for p in (0.025, 0.975))

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        axes.fill_between(x, low, high, color=MUTED, alpha=0.25, linewidth=0, label=tr("normal law, 95 % band of each mark"))
        axes.plot(x, x, color=INK, linewidth=0.9, linestyle=(0, (5, 2)))
        if other is not None:
            axes.plot(x, other[1](q), color=ORANGE, linewidth=1.4, label=other[0])
        axes.plot(x, y[rank - 1], ".", color=BLUE, markersize=3.2, label=tr("residuals"))
        axes.set_xlabel(tr("quantile of the normal law"))
        axes.set_ylabel(tr(label))
        axes.legend(loc="upper left")
        _quiet(axes)

    return drawn(name, (5.2, 4.2), draw)


def heat_map(matrix: Floats, labels: Sequence[str], name: str) -> str:
    """Return the lower triangle of a matrix of correlations as coloured cells with numbers.

    Parameters
    ----------
    matrix : (k, k) array
    labels : sequence of str
    name : str
    """
    k = len(labels)
    side = min(0.46 * k + 1.3, 9.0)
    edges = np.arange(k)
    lower = np.where(np.tri(k - 1, dtype=bool), matrix[1:, :-1], np.nan)

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        image = axes.pcolormesh(edges, edges, lower, cmap="RdBu_r", vmin=-1.0, vmax=1.0, edgecolors="#ffffff", linewidth=0.6)
        axes.invert_yaxis()
        axes.set_aspect("equal")
        axes.set_xticks(edges[:-1] + 0.5, labels[:-1], rotation=55, ha="right", rotation_mode="anchor")
        axes.set_yticks(edges[:-1] + 0.5, labels[1:])
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        for i, j in zip(*np.nonzero(np.isfinite(lower)), strict=True):
            if k <= 20:
                colour = "#ffffff" if abs(lower[i, j]) > 0.6 else "#24292e"
                text = f"{lower[i, j]:.2f}".replace("-0.00", "0.00")
                axes.text(j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=7.5, color=colour)
        bar = figure.colorbar(image, ax=axes, shrink=0.75, aspect=18)
        bar.set_label(tr("correlation"))
        bar.outline.set_visible(False)

    return drawn(name, (side + 0.8, side), draw)


def residual_grid(xy: Floats, v: Floats, size: tuple[float, float], columns: int = 16) -> tuple[Floats, Floats, Floats]:
    """Return the mean residual vectors of the cells of a grid: centres, means, counts.

    Parameters
    ----------
    xy, v : (n, 2) arrays
        Positions from the corner of the frame, and vectors.
    size : tuple of float
        Width and height of the frame, same unit as xy.
    columns : int
        Cells along the longer side.

    Returns
    -------
    centres, means : (k, 2) arrays
    counts : (k,) array

    Examples
    --------
    >>> residual_grid([[1.0, 1.0], [2.0, 1.0]], [[1.0, 0.0], [3.0, 0.0]], (10.0, 10.0), 2)[1:]
    (array([[2., 0.]]), array([2.]))
    """
    xy, v = np.asarray(xy, dtype=float), np.asarray(v, dtype=float)
    cell = max(size) / columns
    shape = [max(1, int(np.ceil(s / cell - 1e-9))) for s in size]
    at = [np.clip((xy[:, k] // cell).astype(int), 0, shape[k] - 1) for k in (0, 1)]
    code = at[0] + shape[0] * at[1]
    counts = np.bincount(code, minlength=shape[0] * shape[1]).astype(float)
    used = np.flatnonzero(counts)
    means = np.stack([np.bincount(code, weights=v[:, k], minlength=len(counts))[used] / counts[used] for k in (0, 1)], axis=1)
    centres = np.stack([(used % shape[0] + 0.5) * cell, (used // shape[0] + 0.5) * cell], axis=1)
    return centres, means, counts[used]


def vectors(
    at: Floats, v: Floats, marked: Any, frame: tuple[float, float, float, float], y_down: bool, name: str, word: str = "", unit: str = "px"
) -> tuple[str, float]:
    """Return residual vectors over an image, and the length of the scale arrow.

    Parameters
    ----------
    at, v : (n, 2) arrays
        Positions and vectors, pixels.
    marked : (n,) bool array
        Vectors drawn bold in the other colour.
    frame : tuple of float
        Left, right, lower and upper limit of the image coordinates.
    y_down : bool
        Whether y counts downwards.
    name, word, unit : str
        Prefix of ids, the word for marked vectors, unit of the vectors.
    """
    width, height = frame[1] - frame[0], frame[3] - frame[2]
    length = np.hypot(v[:, 0], v[:, 1])
    typical = float(np.quantile(length, 0.9)) or 1.0
    spacing = float(np.sqrt(width * height / max(len(at), 1)))
    longer = max(width, height)
    scale = 1.1 * float(np.clip(spacing, 0.02 * longer, 0.1 * longer)) / typical  # drawn pixels per pixel of residual
    rim = 0.05 * longer
    arrow = nice(1.5 * typical)
    across = 6.4 if width >= height else 5.2
    chosen = np.asarray(marked, dtype=bool)

    def draw(figure: Any) -> None:
        from matplotlib.patches import Rectangle

        axes = figure.add_subplot()
        many = len(at) > MOST_MARKS
        style = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / scale, "headwidth": 3.8, "headlength": 4.4, "headaxislength": 4.0}
        for rows, colour, thick in ((~chosen, BLUE, 0.0022), (chosen, ORANGE, 0.0034)):
            if rows.any():
                axes.quiver(*at[rows].T, *v[rows].T, color=colour, width=thick, rasterized=many, zorder=3, **style)
        axes.add_patch(Rectangle((frame[0], frame[2]), width, height, fill=False, edgecolor=MUTED, linewidth=0.8))
        axes.set_xlim(frame[0] - rim, frame[1] + rim)
        axes.set_ylim(*((frame[3] + rim, frame[2] - rim) if y_down else (frame[2] - rim, frame[3] + rim)))
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.set_aspect("equal")
        axes.set_xlabel(tr("image x (px)"))
        axes.set_ylabel(f"{tr('image y (px)')}, {tr('downwards' if y_down else 'upwards')}")
        axes.grid(True)
        axes.tick_params(length=3)
        # The scale arrow stands above the frame, in the units of the axes: as long as a vector of that size.
        share = arrow * scale / (width + 2.0 * rim)
        straight = {"arrowstyle": "<-", "color": INK, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (0.0, 1.045), (share, 1.045), "axes fraction", arrowprops=straight)
        axes.text(share + 0.015, 1.045, f"{arrow:g} {unit}", transform=axes.transAxes, va="center", fontsize=8.5)
        if chosen.any():
            axes.text(1.0, 1.045, word, transform=axes.transAxes, va="center", ha="right", fontsize=8.5, color=ORANGE)

    return drawn(name, (across, float(np.clip(across * 0.86 * height / width + 0.8, 3.0, 7.5))), draw), arrow


def plan(
    points: Floats,
    sigmas: Floats,
    roles: Sequence[str],
    cameras: Floats,
    directions: Floats,
    camera_labels: Sequence[str],
    unit: str,
    sigma_unit: str,
    name: str = "network-plan",
) -> str:
    """Return plan (X, Y) and elevation (X, Z) of a network.

    Parameters
    ----------
    points, cameras : (n, 3), (m, 3) arrays
        Object points and projection centres.
    sigmas : (n,) array
        Spatial standard deviations, coloured; zero = fixed.
    roles : sequence of str
        tie, control or check.
    directions : (m, 3) array
        Viewing directions, unit vectors.
    camera_labels : sequence of str
        Written beside the cameras when there are few.
    unit, sigma_unit : str
    name : str
    """
    low, high = core_of(points, cameras)
    # Long coordinates are told as an offset in the axis label.
    origin = np.where(np.abs(low) > 50.0 * np.maximum(high - low, 1e-12), np.floor(low / 100.0) * 100.0, 0.0)
    reach = 0.07 * float((high - low).max() or 1.0)
    marks = {"tie": ("o", 9.0 if len(points) <= 1000 else 4.0), "control": ("^", 34.0), "check": ("D", 26.0)}
    kinds = np.asarray(roles)
    spread = np.maximum(high - low, 1e-9)
    ratio = [float(np.clip(spread[k] / spread[0], 0.18, 1.6)) for k in (1, 2)]
    free = sigmas > 0.0
    limits = (float(np.quantile(sigmas[free], 0.02)), float(np.quantile(sigmas[free], 0.98))) if free.any() else (0.0, 1.0)

    def panel(axes: Any, k: int) -> Any:
        shown = None
        for kind, (marker, area) in marks.items():
            style = {"marker": marker, "rasterized": len(points) > MOST_MARKS, "zorder": 3 if kind == "tie" else 4}
            rim = {"linewidth": 0.35, "edgecolors": MUTED} if kind == "tie" else {"linewidth": 0.9, "edgecolors": INK}
            at = np.flatnonzero((kinds == kind) & free)
            if len(at):
                colours = {"c": sigmas[at], "cmap": "viridis", "vmin": limits[0], "vmax": limits[1]}
                where = (points[at][:, [0, k]] - origin[[0, k]]).T
                shown = axes.scatter(*where, area, label=tr(f"{kind} points"), **colours, **style, **rim)
            at = np.flatnonzero((kinds == kind) & ~free)
            if len(at):
                axes.scatter(points[at, 0] - origin[0], points[at, k] - origin[k], area, facecolors="none", edgecolors=INK, linewidths=0.9,
                             label=tr(f"fixed {kind} points"), **style)  # fmt: skip
        x, y = cameras[:, 0] - origin[0], cameras[:, k] - origin[k]
        many = len(cameras) > MOST_MARKS
        ends = np.stack([cameras[:, [0, k]], cameras[:, [0, k]] + reach * directions[:, [0, k]]], axis=1) - origin[[0, k]]
        from matplotlib.collections import LineCollection

        axes.add_collection(LineCollection(list(ends), colors=ORANGE, linewidths=0.9, rasterized=many, zorder=5))
        axes.scatter(x, y, 30.0 if len(cameras) <= 200 else 8.0, marker="s", facecolors="none", edgecolors=ORANGE, linewidths=1.2,
                     label=tr("images, viewing direction"), rasterized=many, zorder=5)  # fmt: skip
        if len(cameras) <= 30:
            for label, a, b in zip(camera_labels, x.tolist(), y.tolist(), strict=True):
                axes.annotate(label[:16], (a, b), xytext=(4, 4), textcoords="offset points", fontsize=7, color=MUTED)
        axes.set_aspect("equal" if 0.18 <= spread[k] / spread[0] <= 6.0 else "auto")
        for put, j in ((axes.set_xlim, 0), (axes.set_ylim, k)):
            edge = 0.06 * float(spread[j]) + 0.3 * reach
            put(low[j] - origin[j] - edge, high[j] - origin[j] + edge)
        axes.ticklabel_format(useOffset=False, style="plain")
        axes.set_xlabel(_axis("X", origin[0], unit))
        axes.set_ylabel(_axis("XYZ"[k], origin[k], unit))
        axes.set_title(tr("Plan" if k == 1 else "Elevation"), loc="left")
        axes.grid(True)
        axes.tick_params(length=3)
        return shown

    def draw(figure: Any) -> None:
        upper, lower = figure.subplots(2, 1, height_ratios=ratio)
        shown = panel(upper, 1)
        panel(lower, 2)
        handles, texts = upper.get_legend_handles_labels()
        figure.legend(handles, texts, loc="outside lower center", ncols=4)
        if shown is not None:
            bar = figure.colorbar(shown, ax=[upper, lower], shrink=0.6, aspect=28, extend="both")
            bar.set_label(f"{tr('spatial standard deviation')} ({sigma_unit})")
            bar.outline.set_visible(False)

    return drawn(name, (7.4, float(np.clip(5.6 * sum(ratio) + 1.6, 5.0, 11.0))), draw)


def core_of(points: Floats, cameras: Floats) -> tuple[Floats, Floats]:
    """Return the corners of the box that holds the cameras and nearly all points: a few far away do not make the others small.

    Parameters
    ----------
    points, cameras : (n, 3), (m, 3) arrays

    Returns
    -------
    low, high : (3,) arrays

    Examples
    --------
    >>> cloud = np.concatenate([np.random.default_rng(1).uniform(0, 1, (500, 3)), [[900.0, 0, 0]]])
    >>> bool(core_of(cloud, np.zeros((1, 3)))[1][0] < 2.0)
    True
    """
    if len(points):
        low, high = (np.quantile(points, q, axis=0) for q in (0.01, 0.99))
        rim = 0.25 * float((high - low).max())
        low, high = np.maximum(points.min(axis=0), low - rim), np.minimum(points.max(axis=0), high + rim)
        return np.asarray(np.minimum(low, cameras.min(axis=0))), np.asarray(np.maximum(high, cameras.max(axis=0)))
    return np.asarray(cameras.min(axis=0)), np.asarray(cameras.max(axis=0))


def _axis(letter: str, origin: float, unit: str) -> str:
    if origin == 0.0:
        return f"{letter} ({unit})"
    return f"{letter} {'-' if origin > 0 else '+'} {abs(origin):.0f} ({unit})"


def bars(values: Floats, beyond: Sequence[bool], labels: Sequence[str], axis: str, word: str, name: str) -> str:
    """Return one bar per image; those that a test rejects in the other colour and hatched.

    Parameters
    ----------
    values : (n,) array
    beyond : sequence of bool
        True where the test rejects.
    labels : sequence of str
        Written below the bars when there are few.
    axis, word, name : str
        Label of the axis, the word for rejected, prefix of ids.
    """
    rejected = np.asarray(beyond, dtype=bool)

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        x = np.arange(1, len(values) + 1)
        axes.bar(x[~rejected], values[~rejected], 0.75, color=BLUE, alpha=0.55, label=tr("agrees with the others"))
        if rejected.any():
            style = {"hatch": "////", "edgecolor": "#ffffff", "linewidth": 0.0}
            axes.bar(x[rejected], values[rejected], 0.75, color=ORANGE, alpha=0.75, label=tr(word), **style)
        axes.axhline(1.0, color=INK, linewidth=0.9, linestyle=(0, (5, 2)))
        axes.set_xlim(0.25, len(values) + 0.75)
        if len(values) <= 40:
            short = [t if len(t) <= 14 else f"{t[:12]}.." for t in labels]
            upright = sum(len(t) + 1 for t in short) > 90
            axes.set_xticks(x, short, **({"rotation": 60, "ha": "right", "rotation_mode": "anchor"} if upright else {}))
        axes.set_xlabel(tr("image" if len(values) <= 40 else "image, in the order of the table"))
        axes.set_ylabel(tr(axis))
        axes.margins(y=0.15)
        figure.legend(loc="outside upper left", ncols=2)
        _quiet(axes, "y")

    return drawn(name, (7.2, 2.6), draw)
