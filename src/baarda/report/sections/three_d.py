"""The block in space: a figure first, then the same to turn where scripts may run."""

from __future__ import annotations

from baarda.procedures.testing import Analysis
from baarda.report import drawings
from baarda.report.scene import MOST_RAYS, Scene, scene_of
from baarda.report.sections._facts import scaling
from baarda.report.sections._numbers import significant
from baarda.report.sections.base import Block, Figure, Interactive, SectionMaker, say


def _caption(analysis: Analysis, scene: Scene) -> str:
    free = scene.sigmas[scene.sigmas > 0.0]
    parts = [
        say(
            "{points} object points, coloured by their spatial standard deviation ({scaling}), and {images} images as "
            "pyramids that open in "
            "the viewing direction.",
            points=scene.total,
            images=len(scene.images),
            scaling=scaling(analysis),
        )
    ]
    if len(free):
        parts.append(
            say(
                "The standard deviations reach from {low} to {high} {unit}; ellipsoids of 95 % confidence, those of the "
                "weakest points, are "
                "drawn {times} times too large.",
                low=significant(float(free.min()), 2),
                high=significant(float(free.max()), 2),
                unit=scene.told,
                times=f"{scene.enlarged:g}",
            )
        )
    if scene.suspected:
        parts.append(
            say(
                "Lines join the images with the points that they measured under suspicion of a gross error: {count}.", count=scene.suspected
            )
        )
        if scene.suspected > MOST_RAYS:
            parts.append(say("Of these, the {most} worst are drawn.", most=MOST_RAYS))
    if len(scene.names) < scene.total:
        parts.append(
            say(
                "Only {shown} points are drawn: those of the survey, those under suspicion, the weakest, and an even sample of the others.",
                shown=len(scene.names),
            )
        )
    return " ".join(parts)


def _build(analysis: Analysis) -> list[Block] | None:
    from baarda.report.page import printable

    scene = scene_of(analysis)
    if scene is None:
        return None
    caption = _caption(analysis, scene)
    alt = say("The block seen from above and aside. {caption}", caption=caption)
    return [
        Figure("block-in-space", "The block in space", caption, alt, drawings.space(scene)),
        Interactive(
            "block-to-turn",
            "The block to turn",
            say("The same points, images, ellipsoids and suspected rays; a point tells its name and figures under the pointer."),
            say("The block of the figure above, to turn with the arrow keys, to enlarge with plus and minus. {caption}", caption=caption),
            scene.to_json(printable),
        ),
    ]


THREE_D = SectionMaker(132, "space", "Block in space", _build)
