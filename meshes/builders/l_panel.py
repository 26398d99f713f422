"""A panel in the shape of an L, which cracks from its inner corner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..parameters import require, require_affordable, require_not_negative, require_positive
from ..sizing import SizeField, estimate_cells_in_box
from .profile import CutRectangle, Profile


@dataclass(frozen=True)
class LPanel(CutRectangle):
    """A square without its lower right quarter: a leg on the left, an arm on the right; by default Winkler's panel.

    2D: x is the length, y the height. 3D: x the length, y the thickness, z the height. One corner is at the origin; the
    leg stands on "bottom", and the inner corner is in the middle.

    Attributes:
        size: side of the square [m].
        thickness: [m]; 0 makes a 2D mesh.
        seat: distance from the end of the arm of a place on its lower side that is a node (2D), or a line of nodes,
            to be pushed at [m].
        h: cell size [m] away from the expected crack.
        h_corner: cell size [m] from the inner corner to the left side; h / 4 where left out.

    Groups: left, right (least and greatest x), bottom, top (least and greatest height), corner (the two sides that meet
    there), and in 3D front, back (least and greatest y).

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "l-panel"
    regions: ClassVar[tuple[str, ...]] = ()
    cut: ClassVar[str] = "corner"

    size: float = 0.5
    thickness: float = 0.0
    seat: float = 0.03
    h: float = 0.02
    h_corner: float | None = None

    def __post_init__(self) -> None:
        require_positive("l-panel", size=self.size, seat=self.seat, h=self.h, h_corner=self._fine)
        require_not_negative("l-panel", thickness=self.thickness)
        require(
            self.seat < self._middle,
            f"l-panel: seat = {self.seat!r} must be less than half of size = {self.size!r}: it is on the arm.",
        )
        require_affordable("l-panel", min(self.h, self._fine), self.cells_estimate())

    @property
    def _extent(self) -> tuple[float, float, float]:
        return self.size, self.size, self.thickness

    @property
    def _middle(self) -> float:
        return self.size / 2

    @property
    def _fine(self) -> float:
        return self.h / 4 if self.h_corner is None else self.h_corner

    @property
    def _sizing(self) -> SizeField:
        """Fine where the crack is expected, which rises by up to a third of its length."""
        middle = self._middle
        return SizeField(self.h, min(self._fine, self.h), (0.0, middle), (middle, middle * 4 / 3))

    def cells_estimate(self) -> int:
        """Approximate number of cells: of the square less those of its lower right quarter."""
        middle, depth = self._middle, (self.thickness,) if self.thickness else ()
        quarter = estimate_cells_in_box(self._sizing, (middle, 0.0, *(0.0 for _ in depth)), (self.size, middle, *depth))
        return max(1, round(super().cells_estimate() - quarter))

    def _profile(self) -> Profile:
        size, middle = self.size, self._middle
        leg = [(0.0, 0.0), (middle, 0.0), (middle, middle)]
        arm = [(size - self.seat, middle), (size, middle), (size, size), (0.0, size)]
        return Profile(leg + arm, {})
