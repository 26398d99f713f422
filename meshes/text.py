"""Places and axes in words, for messages."""

from __future__ import annotations

from collections.abc import Iterable

from .data import Indices, Points

AXES = "xyz"


def format_point(point: Iterable[float]) -> str:
    """A point [m]: "(0, 0.5, 1)"."""
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"


def format_midpoint(points: Points, nodes: Indices) -> str:
    """The middle of some of the points: "(0, 0.5, 1) m"."""
    return format_point(points[nodes].mean(axis=0)) + " m"
