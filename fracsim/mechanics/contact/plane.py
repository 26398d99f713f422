"""A half space bounded by a plane (in 2D a line)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import InputError
from .axes import Values, frame, unit
from .outlines import Outline
from .shape import require_lengths


@dataclass(frozen=True)
class Plane:
    """The half space n . x <= 0, n along `direction` (d numbers of any length), which points out of it."""

    direction: tuple[float, ...]
    extent: float = 1.0  # edge of the patch that is drawn, m

    def __post_init__(self) -> None:
        """InputError where it is no plane."""
        unit(self.direction)
        require_lengths(self, extent=self.extent)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.direction)

    @property
    def convex(self) -> bool:
        """A half space is."""
        return True

    @property
    def round(self) -> bool:
        """It is not."""
        return False

    @property
    def least_radius(self) -> float:
        """Infinite."""
        return float("inf")

    @property
    def volume(self) -> float:
        """Infinite."""
        return float("inf")

    def distance(self, x: Values) -> Values:
        """(n,) n . x, m."""
        return np.asarray(x @ unit(self.direction))

    def normal(self, x: Values) -> Values:
        """(n, d) n at every point."""
        return np.tile(unit(self.direction), (len(x), 1))

    def curvature(self, x: Values) -> Values:
        """(n, d, d) zero."""
        return np.zeros((len(x), self.dim, self.dim))

    def outline(self) -> Outline:
        """A square patch of two triangles (in 2D one segment) about the reference point; not closed."""
        R, h = frame(unit(self.direction)), self.extent / 2
        if self.dim == 2:
            # outward is to the right of a segment, as on a counterclockwise polygon
            return np.array([[h, 0.0], [-h, 0.0]]) @ R.T, np.array([[0, 1]], np.int32)
        square = np.array([[-h, -h, 0.0], [h, -h, 0.0], [h, h, 0.0], [-h, h, 0.0]])
        return square @ R.T, np.array([[0, 1, 2], [0, 2, 3]], np.int32)

    def inertia(self, density: float) -> Values:
        """InputError: a half space has no finite mass."""
        raise InputError("a plane is a half space without end, so it cannot move freely: hold it or drive it")
