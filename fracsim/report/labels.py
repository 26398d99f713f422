"""Names beside the points of a plot, none on another: each goes where there is room by its point, or is left out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

SIZE = 7.5  # points
WIDTH = 0.6  # of a letter, over its size: wider than most
# where a name may lie: (right or left of its point, points above it), the best first
PLACES = [(side, up) for up in (4.0, -10.0, 14.0, -20.0, 24.0, -30.0) for side in (1, -1)]

Box = tuple[float, float, float, float]  # left, bottom, right, top


def label_points(axes: Any, named: Iterable[tuple[float, float, str]], points: Iterable[tuple[float, float]]) -> None:
    """Write (x, y, name) beside their points, clear of one another, of all `points` and of the frame. What has no room
    is in the tables. The frame must have its scales and its legend."""
    axes.figure.draw_without_rendering()  # the layout is worked out as it is drawn
    scale = axes.figure.dpi / 72
    frame: Box = tuple(axes.bbox.extents)
    taken = [_around(axes.transData.transform(point), 2.5 * scale) for point in points if np.isfinite(point).all()]
    for x, y, name in named:
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        at = axes.transData.transform((x, y))
        for side, up in PLACES:
            box = _box(at, name, side, up, scale)
            if _inside(box, frame) and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                axes.annotate(name, (x, y), textcoords="offset points", xytext=(4 * side, up), fontsize=SIZE,
                              ha="left" if side > 0 else "right")  # fmt: skip
                break


def _box(at: Any, name: str, side: int, up: float, scale: float) -> Box:
    """What a name takes, in pixels."""
    near, far = sorted((4.0 * side, (4.0 + WIDTH * SIZE * len(name)) * side))
    left, bottom = at[0] + near * scale, at[1] + (up - 0.25 * SIZE) * scale
    return left, bottom, at[0] + far * scale, bottom + 1.25 * SIZE * scale


def _around(at: Any, reach: float) -> Box:
    return at[0] - reach, at[1] - reach, at[0] + reach, at[1] + reach


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _inside(box: Box, frame: Box) -> bool:
    return box[0] >= frame[0] and box[2] <= frame[2] and box[1] >= frame[1] and box[3] <= frame[3]
