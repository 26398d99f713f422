"""A box with rounded edges; in 2D a rectangle with rounded corners."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...errors import InputError
from .corner import Corner
from .moments import rounded_box
from .outlines import Outline, polygon, profile, rounded_block
from .shape import FILLET, Body, Values, require_fillet, require_lengths, resized_fillet


@dataclass(frozen=True)
class Box(Body):
    """A box of full `size` (d numbers, m), edges rounded with `rounding` (m, default: FILLET of the least half size).

    From inside, as of a container, the distance is C1 within the rounding of the wall; further in, where another wall
    becomes the nearest, its gradient jumps: a barrier must be thinner than the rounding.
    """

    size: tuple[float, ...]
    rounding: float | None = None

    def __post_init__(self) -> None:
        """InputError where it is no box."""
        if len(self.size) not in (2, 3):
            raise InputError(f"a box of {len(self.size)} sizes is not known: give 2 or 3")
        for size in self.size:
            require_lengths(self, size=size)
        require_fillet(self, self.fillet, min(self.size) / 2)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.size)

    @property
    def fillet(self) -> float:
        """Radius of the edges, m."""
        return FILLET * min(self.size) / 2 if self.rounding is None else self.rounding

    def _half(self) -> Values:
        """(d,) half sizes of the sharp core that the fillet grows, m."""
        return np.array(self.size) / 2 - self.fillet

    def _corner(self, x: Values) -> Corner:
        return Corner(abs(x) - self._half())

    def _distance(self, x: Values) -> Values:
        return self._corner(x).value - self.fillet

    def _normal(self, x: Values) -> Values:
        return _signs(x) * self._corner(x).slope

    def _curvature(self, x: Values) -> Values:
        signs = _signs(x)
        return signs[:, :, None] * self._corner(x).curvature * signs[:, None, :]

    def _radius(self) -> float:
        return self.fillet

    def _depth(self) -> float:
        return min(self.size) / 2

    def _resized(self, by: float) -> Box:
        size = tuple(side + 2 * by for side in self.size)
        return replace(self, size=size, rounding=resized_fillet(self.fillet, by))

    def _outline(self) -> Outline:
        half = self._half()
        if self.dim == 3:
            return rounded_block(half, self.fillet)
        return polygon(profile(float(half[0]), float(half[1]), self.fillet))

    def _moments(self) -> tuple[float, Values]:
        return rounded_box(self._half(), self.fillet)


def _signs(x: Values) -> Values:
    """-1 or 1, never 0: on a middle plane there is a nearest face as well."""
    return np.where(x < 0, -1.0, 1.0)
