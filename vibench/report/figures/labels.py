"""Labels of points, placed where they cover neither each other nor a point."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from vibench.arrays import Array

Box = tuple[float, float, float, float]
"""Left, bottom, right and top, in points (1/72 inch)."""

SIZE = 6.0
"""Size of the font of labels, in points."""

CHARACTER, HEIGHT = 0.62, 1.15
"""Width of a character and height of a line, in sizes of the font; no text is rendered to measure it."""

MARKER = 3.5
"""Half the width of what a label keeps clear around a point, in points."""

SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Sides of a point, in the order in which a label is tried there."""


def label_points(axes: Axes, points: list[tuple[float, float, str]]) -> int:
    """Write a label at every point (x, y, text) where there is room; returns the number of those without room.

    A point without a text is only kept clear. The axes must have their final size and limits.
    """
    drawn = [(x, y, text) for x, y, text in points if np.isfinite([x, y]).all()]
    if not drawn:
        return 0
    scale = 72.0 / float(axes.figure.dpi)
    places = scale * axes.transData.transform([(x, y) for x, y, _ in drawn])
    left, bottom, right, top = (scale * float(end) for end in axes.bbox.extents)
    taken: list[Box] = [(x - MARKER, y - MARKER, x + MARKER, y + MARKER) for x, y in places]
    missing = 0
    for (x, y, text), place in zip(drawn, places, strict=True):
        if not text:
            continue
        box = _free(place, text, taken, (left, bottom, right, top))
        if box is None:
            missing += 1
            continue
        taken.append(box)
        offset = (box[0] - place[0], box[1] - place[1])
        axes.annotate(
            text, (x, y), offset, textcoords="offset points", fontsize=SIZE, color="0.25", va="bottom", ha="left"
        )
    return missing


def _free(place: Array, text: str, taken: list[Box], inside: Box) -> Box | None:
    """The first box beside a point that is inside the panel and covers nothing."""
    width, height = CHARACTER * SIZE * len(text), HEIGHT * SIZE
    for across, up in SIDES:
        x = place[0] + (MARKER + 1.0 if across > 0 else -MARKER - 1.0 - width if across < 0 else -0.5 * width)
        y = place[1] + (MARKER if up > 0 else -MARKER - height if up < 0 else -0.5 * height)
        box = (x, y, x + width, y + height)
        within = box[0] >= inside[0] and box[1] >= inside[1] and box[2] <= inside[2] and box[3] <= inside[3]
        if within and not any(_overlap(box, other) for other in taken):
            return box
    return None


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
