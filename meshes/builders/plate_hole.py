"""A quarter of a plate with a round hole, with its two planes of symmetry."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import ClassVar

from ..parameters import CurvedBoundary, require, require_affordable, require_not_negative, require_positive
from ..sizing import SizeField
from .profile import CutRectangle, Profile


@dataclass(frozen=True)
class PlateHole(CutRectangle):
    """The quarter x > 0, height > 0 of a plate of twice this length and height with a hole around the origin.

    2D: x is the length, y the height. 3D: x the length, y the thickness, z the height. With symmetry conditions on
    "left" and "bottom" it stands for the whole plate.

    Attributes:
        length: of the quarter [m].
        height: of the quarter [m].
        thickness: [m]; 0 makes a 2D mesh.
        radius: of the hole [m].
        h: cell size [m] away from the hole.
        h_hole: cell size [m] at the hole, up to twice its radius around the origin; h / 4 where left out.

    Groups: left, right (least and greatest x), bottom, top (least and greatest height), hole, and in 3D front, back
    (least and greatest y).

    Raises:
        MeshError: a parameter is out of range, or the hole does not fit.
    """

    name: ClassVar[str] = "plate-hole"
    regions: ClassVar[tuple[str, ...]] = ()
    cut: ClassVar[str] = "hole"

    length: float = 0.05
    height: float = 0.05
    thickness: float = 0.0
    radius: float = 0.01
    h: float = 0.004
    h_hole: float | None = None

    def __post_init__(self) -> None:
        require_positive(
            "plate-hole", length=self.length, height=self.height, radius=self.radius, h=self.h, h_hole=self._fine
        )
        require_not_negative("plate-hole", thickness=self.thickness)
        require(
            self.radius < min(self.length, self.height),
            f"plate-hole: radius = {self.radius!r} must be less than length = {self.length!r} and height = "
            f"{self.height!r}.",
        )
        require_affordable("plate-hole", min(self.h, self._fine), self.cells_estimate())

    @property
    def _extent(self) -> tuple[float, float, float]:
        return self.length, self.height, self.thickness

    def cells_estimate(self) -> int:
        """Approximate number of cells: of the rectangle less those of the hole."""
        return max(1, round(super().cells_estimate() - pi / 4 * self._cells_within(self.radius, self.radius)))

    @property
    def curved_boundaries(self) -> tuple[CurvedBoundary, ...]:
        """The hole."""
        return (CurvedBoundary(("hole",), self.radius, 1 if self.thickness else None),)

    def _profile(self) -> Profile:
        r, length, height = self.radius, self.length, self.height
        return Profile([(r, 0.0), (length, 0.0), (length, height), (0.0, height), (0.0, r)], {4: (0.0, 0.0)})

    @property
    def _fine(self) -> float:
        return self.h / 4 if self.h_hole is None else self.h_hole

    @property
    def _sizing(self) -> SizeField:
        reach = min(2 * self.radius, self.length), min(2 * self.radius, self.height)
        return SizeField(self.h, min(self._fine, self.h), (0.0, 0.0), reach)
