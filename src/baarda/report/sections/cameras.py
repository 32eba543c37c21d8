"""Cameras: interior orientation and additional parameters with sigmas, tests and correlations."""

from __future__ import annotations

import numpy as np

from baarda.cameras import STATES
from baarda.procedures.testing import Analysis
from baarda.report import plots
from baarda.report.sections._facts import MOST_ROWS, correlation_matrix, first, result_of, scaling
from baarda.report.sections._numbers import MISSING, fixed, powers, probability, significant, with_sigma
from baarda.report.sections.base import Block, Cell, Column, DataTable, Figure, Paragraph, SectionMaker, say
from baarda.report.translation import tr

_MOST_MAPS = 4

_MEANINGS = {
    "principal_distance": "distance of the projection centre from the image plane",
    "principal_point_x": "foot of the perpendicular from the projection centre, x",
    "principal_point_y": "foot of the perpendicular from the projection centre, y",
    "K1": "radial distortion, r³",
    "K2": "radial distortion, r⁵",
    "K3": "radial distortion, r⁷",
    "P1": "decentring distortion",
    "P2": "decentring distortion",
    "B1": "affinity (scale of x against y)",
    "B2": "shear of the axes",
}


def _parameters(analysis: Analysis) -> DataTable:
    a = analysis.adjustment
    scale = a.scale(analysis.options.sigma)
    sigma = {n: scale * float(np.sqrt(q)) for n, q in zip(a.camera_estimates.names, np.diag(a.camera_estimates.cofactors), strict=True)}
    test = result_of(analysis, "additional_parameter")
    tests = {} if test is None else {n: i for i, n in enumerate(test.labels)}
    rows: list[tuple[str | Cell, ...]] = []
    several = len(a.network.cameras) > 1
    for i, camera in enumerate(a.network.cameras):
        for k, parameter in enumerate(camera.model.order):
            name = f"camera {camera.label}: {parameter}"
            value, deviation = with_sigma(float(camera.values[k]), sigma.get(name))
            initial = f"{float(a.start.cameras[i].values[k]):.6g}"
            t, p, decision = "", "", Cell("")
            if test is not None and name in tests:
                j = tests[name]
                t, p = significant(float(np.asarray(test.statistic)[j]), 3), probability(float(np.asarray(test.p_value)[j]))
                decision = Cell("significant", "good") if np.asarray(test.rejected)[j] else Cell("not significant", "warn")
            state = STATES[camera.states[k]] if name in sigma else "fixed"
            head = (camera.label, parameter) if several else (parameter,)
            rows.append(
                (*head, powers(camera.unit_of(k)) or "1", value, deviation, initial, t, p, decision, state, _MEANINGS.get(parameter, ""))
            )
            if len(rows) >= MOST_ROWS:
                break
        if len(rows) >= MOST_ROWS:
            break
    limit = ""
    if test is not None and isinstance(test.critical, tuple):
        limit = say(" (limit {limit} at level {alpha})", limit=fixed(test.critical[1], 2), alpha=f"{test.alpha:.3g}")
    columns = (
        *((Column("camera", "", "", "left"),) if several else ()),
        Column("parameter", "", "", "left"),
        Column("unit", "", "unit of value, sigma and initial; 1 = pure number", "left"),
        Column("value", "", "adjusted value"),
        Column("sigma", "", say("standard deviation, {scaling}", scaling=scaling(analysis))),
        Column("initial", "", "value before the adjustment"),
        Column("t", "", tr("value / sigma: test that an additional parameter is zero") + limit),
        Column("p", "", "probability of a |t| as large if the parameter were zero"),
        Column("decision", "", "", "left"),
        Column("state", "", "free: estimated; observed: estimated with a prior sigma; fixed: held", "left"),
        Column("meaning", "", "", "left"),
    )
    count = sum(len(c.values) for c in a.network.cameras)
    return DataTable("Interior orientation and additional parameters", columns, tuple(rows), first(count, MOST_ROWS, "tables/unknowns.csv"))


def _sensors(analysis: Analysis) -> DataTable:
    net = analysis.adjustment.network
    rows = []
    for i, c in enumerate(net.cameras[:50]):
        size = MISSING if c.image_size is None else f"{c.image_size[0]:g} x {c.image_size[1]:g}"
        pixel = f"{c.pixel_size[0]:.5g} x {c.pixel_size[1]:.5g}"
        count = int((net.images.cameras == i).sum())
        rows.append((c.label, c.model.name, str(count), size, pixel, c.unit, "down" if c.y_down else "up"))
    columns = (
        Column("camera", "", "", "left"),
        Column("model", "", "name of the camera model", "left"),
        Column("images", "", "number of images taken with it"),
        Column("image size", "px", "width x height"),
        Column("pixel size", "plane unit / px", "width x height of one pixel in the unit of the image plane"),
        Column("unit", "", "unit of the image plane, in which the parameters are stated", "left"),
        Column("y axis", "", "direction in which source rows are counted", "left"),
    )
    return DataTable("Sensors", columns, tuple(rows), first(len(net.cameras), 50, "project/cameras.csv"))


def _correlations(analysis: Analysis) -> list[Block]:
    e = analysis.adjustment.camera_estimates
    blocks: list[Block] = []
    labels = list(dict.fromkeys(e.groups))
    for i, label in enumerate(labels[:_MOST_MAPS]):
        at = np.array([j for j, g in enumerate(e.groups) if g == label])
        if len(at) < 2:
            continue
        short = [e.names[j].split(": ", 1)[1] if label in e.names[j] else e.names[j] for j in at]
        short = [n.rsplit(": ", 1)[-1] for n in short]
        c = correlation_matrix(e.cofactors[np.ix_(at, at)])
        upper = np.abs(np.triu(c, 1))
        k, m = np.unravel_index(int(np.argmax(upper)), upper.shape)
        rows = tuple((short[a], *(fixed(c[a, b], 2) if b < a else "1" if a == b else "" for b in range(len(at)))) for a in range(len(at)))
        columns = (Column("", "", "", "left"), *(Column(s) for s in short))
        most = say("highest: {a} and {b}, {r}", a=short[k], b=short[m], r=fixed(float(c[k, m]), 3))
        title = say("Correlations of the parameters of camera {label}", label=label)
        if len(at) == 2:  # a map of one cell says no more than its number
            pair = {"label": label, "a": short[0], "b": short[1], "r": fixed(float(c[0, 1]), 3)}
            blocks.append(Paragraph(say("Correlation of the two estimated parameters of camera {label}, {a} and {b}: {r}.", **pair)))
            continue
        figure = plots.heat_map(c, short, f"correlations-{i + 1}")
        alt = say("Matrix of the correlations of {count} camera parameters; {most}.", count=len(at), most=most)
        caption = say(
            "Correlations between -1 (blue) and +1 (red), {most}. Beyond 0.95 two parameters can hardly be told apart. They do not "
            "depend on the variance factor.",
            most=most,
        )
        blocks.append(Figure(f"correlations-{i + 1}", title, caption, alt, figure))
        if len(at) <= 20:
            blocks.append(DataTable(say("{title}, numbers", title=title), columns, rows, folded=True))
    return blocks


def _build(analysis: Analysis) -> list[Block] | None:
    if not analysis.converged or not analysis.adjustment.network.cameras:
        return None
    return [_parameters(analysis), _sensors(analysis), *_correlations(analysis)]


CAMERAS = SectionMaker(50, "cameras", "Cameras", _build)
