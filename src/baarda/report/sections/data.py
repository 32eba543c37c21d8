"""Data and model: what was adjusted, how, and how the iterations went."""

from __future__ import annotations

import numpy as np

from baarda.network import ROLES
from baarda.observations import ImagePoints, component_unit
from baarda.procedures.testing import Analysis
from baarda.report import drawings
from baarda.report.sections._facts import MOST_ROWS, first
from baarda.report.sections._numbers import finer, fixed, plural, significant
from baarda.report.sections.base import Block, Column, DataTable, Figure, Paragraph, SectionMaker, say
from baarda.report.translation import tr

_PLANES = {
    "image": "image plane: v belongs to the coordinates as measured",
    "corrected": "corrected plane: v belongs to the coordinates after the distortion was removed (stated in source pixels)",
}


def _counts(analysis: Analysis) -> DataTable:
    a = analysis.adjustment
    net = a.network
    used = ~a.aside
    rows: list[tuple[str, str, str]] = [
        ("images", str(len(net.images.labels)), "each with six elements of exterior orientation"),
        ("cameras", str(len(net.cameras)), "each with its own interior orientation"),
        ("object points", str(int(used.sum())), "points that take part, control and check points included"),
    ]
    for code in (1, 2):
        count = int(((net.points.roles == code) & used).sum())
        meaning = ("", "take part with their coordinates, fixed or weighted", "their coordinates do not take part; they judge")[code]
        rows.append((f"{ROLES[code]} points", str(count), meaning))
    image = sum(2 * len(g) for g in a.groups if isinstance(g, ImagePoints))
    rows += [
        ("image coordinates", str(image), "two for each image point"),
        ("observations n", str(a.count), "image coordinates and everything known beforehand with a sigma"),
        ("unknowns u", str(a.numbering.count), "free and observed parameters; fixed ones are none"),
        ("datum conditions d", str(a.datum.defect.count), "freedoms of the object space that were tied down by conditions"),
        ("redundancy r", str(a.redundancy), "r = n - u + d: surplus observations, on which every test rests"),
        ("v'Pv", significant(a.objective, 5), "weighted sum of squared residuals, P from the a-priori sigmas"),
    ]
    if analysis.converged:
        rows.append(("s0", fixed(a.sigma0, 4), "a-posteriori standard deviation of unit weight, sqrt(v'Pv / r); a priori it is 1"))
    columns = (Column("quantity", "", "", "left"), Column("value"), Column("meaning", "", "", "left"))
    return DataTable("Counts", columns, tuple(rows))


def _model(analysis: Analysis) -> list[Block]:
    a = analysis.adjustment
    net = a.network
    planes = sorted({g.residual_plane for g in a.groups if isinstance(g, ImagePoints)})
    solvers = {"dense": "dense normal equations (LAPACK)", "block": "block elimination of the points"}
    rows = [
        ("datum", a.datum.text),
        ("camera models", "; ".join(f"camera {c.label}: {c.model.name} ({c.model.description})" for c in net.cameras[:8])),
        ("residuals", "; ".join(_PLANES[p] for p in planes) if planes else "of each observation as given"),
        ("solver", solvers.get(a.solver_name, a.solver_name)),
        ("units", _units(analysis)),
        ("rotation", "camera from object, M = R3(kappa) R2(phi) R1(omega); the camera looks along -z, x right, y up"),
    ]
    if not net.cameras:
        rows = [row for row in rows if row[0] not in ("camera models", "rotation")]
    columns = (Column("item", "", "", "left"), Column("choice", "", "", "left"))
    return [
        DataTable(
            "Model",
            columns,
            tuple(rows),
            "" if len(net.cameras) <= 8 else say("The first {most} of {count} cameras.", most=8, count=len(net.cameras)),
        )
    ]


def _apriori(analysis: Analysis) -> DataTable:
    a = analysis.adjustment
    rows = []
    for group in a.groups:
        s = group.sigma()
        same = isinstance(group, ImagePoints) or group.name.startswith(("control", "distances"))
        if getattr(group, "units", None) is not None:  # components of different units
            for c, component in enumerate(group.components):
                rows.append((f"{group.name}, {component}", str(len(group)), _span(s[:, c], component_unit(group, c))))
            continue
        unit, factor = finer(group.unit, s) if same else (group.unit, 1.0)
        rows.append((group.name, str(len(group) * len(group.components)), _span(s * factor, unit)))
    columns = (
        Column("group", "", "observations of one kind", "left"),
        Column("n", "", "number of scalar observations"),
        Column("a-priori sigma", "", "standard deviation assumed before the adjustment, unit as stated"),
    )
    return DataTable("A-priori standard deviations", columns, tuple(rows))


def _units(analysis: Analysis) -> str:
    a = analysis.adjustment
    told = [
        f"{group.name} {', '.join(f'{name} {component_unit(group, c)}' for c, name in enumerate(group.components))}"
        for group in a.groups
        if getattr(group, "units", None) is not None
    ]
    if not told:
        return say("object space {unit}; image px; angles degrees in this report, radians in the tables", unit=a.network.unit)
    seen = [tr("image px")] * bool(a.network.images.labels)
    units = "; ".join([*seen, *told])
    return say("object space {unit}; {units}; angles degrees in this report, radians in the tables", unit=a.network.unit, units=units)


def _span(sigmas: np.ndarray, unit: str) -> str:
    low, high = float(sigmas.min()), float(sigmas.max())
    size = f"{low:.4g}" if np.isclose(low, high) else say("{low} to {high}", low=f"{low:.3g}", high=f"{high:.3g}")
    return f"{size} {unit}".strip()


def _history(analysis: Analysis) -> DataTable:
    rows = []
    history = analysis.adjustment.history
    for i in history[:MOST_ROWS]:
        step = "" if i.relative_step is None else f"{i.relative_step:.1e}"
        rows.append(
            (str(i.count), f"{i.objective:.6g}", step, f"{i.damping:.0e}" if i.damping else "0", "taken" if i.accepted else "refused")
        )
    columns = (
        Column("iteration", "", "0 = start values"),
        Column("v'Pv", "", "weighted sum of squared residuals after the step")
        if analysis.adjustment.law is None
        else Column("- log L", "", "minus the log-likelihood after the step"),
        Column("relative step", "", "change of the adjusted observations by the step, as a part of the residuals (weighted norms)"),
        Column("damping", "", "Levenberg's damping; 0 = full Gauss-Newton step"),
        Column("step", "", "a step that does not lower it is refused and damped", "left"),
    )
    return DataTable("Iterations", columns, tuple(rows), first(len(history), MOST_ROWS, "the project's history"), folded=True)


def _course(analysis: Analysis) -> list[Block]:
    """Return the figure of the iterations; nothing where no step was taken."""
    a = analysis.adjustment
    steps = a.history
    if len(steps) < 2:
        return []
    relative = np.array([np.nan if s.relative_step is None else s.relative_step for s in steps])
    damping, accepted = np.array([s.damping for s in steps]), np.array([s.accepted for s in steps])
    what = "v'Pv" if a.law is None else "- log L"
    svg = drawings.iterations([s.count for s in steps], np.array([s.objective for s in steps]), relative, damping, accepted, what)
    known = relative[np.isfinite(relative)]
    caption = say(
        "{what} falls from {first} to {last} in {steps}; the last relative step is {step}.",
        what=what,
        first=significant(steps[0].objective, 4),
        last=significant(steps[-1].objective, 4),
        steps=plural(len(steps) - 1, "iteration"),
        step=f"{known[-1]:.1e}" if len(known) else tr("none"),
    )
    if (damping > 0.0).any():
        caption += " " + say(
            "Damped: {count}, at most with {most}.", count=plural(int((damping > 0.0).sum()), "step"), most=f"{damping.max():.0e}"
        )
    else:
        caption += " " + tr("No step was damped: all are full Gauss-Newton steps.")
    if not accepted.all():
        caption += " " + say("Crosses: {count} refused, because it would have raised the sum.", count=int((~accepted).sum()))
    alt = say("Curves over the iterations. {caption}", caption=caption)
    return [Figure("iterations", "Course of the iterations", caption, alt, svg)]


def _build(analysis: Analysis) -> list[Block]:
    name = analysis.adjustment.network.name
    intro: list[Block] = [Paragraph(say("Project: {name}.", name=name))] if name else []
    return [*intro, _counts(analysis), *_model(analysis), _apriori(analysis), *_course(analysis), _history(analysis)]


DATA = SectionMaker(30, "data", "Data and model", _build)
