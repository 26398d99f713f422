"""Plates: with a slit from the left edge, with a hole, and in the shape of an L."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import ClassVar

from ..parameters import CurvedBoundary, require, require_affordable, require_not_negative, require_positive
from ..sizing import SizeField, estimate_cells_in_box
from .profile import CutRectangle, Profile


@dataclass(frozen=True)
class NotchedPlate(CutRectangle):
    """A plate with a straight slit from its left edge towards +x; by default the crack branching plate.

    2D: x is the length, y the height. 3D: x the length, y the thickness, z the height. One corner is at the origin.
    Single-edge notched tension: length = height = 0.001, notch_length = 0.0005, notch_width = 5e-6.

    Attributes:
        length: [m].
        height: [m].
        thickness: [m]; 0 makes a 2D mesh.
        notch_length: from the left edge to the tip of the slit [m].
        notch_width: distance of the slit's parallel flanks [m]; they end in a right-angled point at the tip.
        notch_position: height of the slit [m]; in the middle where left out.
        h: cell size [m] away from the tip.
        h_tip: cell size [m] at the tip; h / 4 where left out.
        refined: distance ahead of the tip up to which cells keep the size `h_tip` [m].

    Groups: left, right (least and greatest x), bottom, top (least and greatest height), notch, and in 3D front, back
    (least and greatest y).

    Raises:
        MeshError: a parameter is out of range, or the slit does not fit.
    """

    name: ClassVar[str] = "notched-plate"
    regions: ClassVar[tuple[str, ...]] = ()
    cut: ClassVar[str] = "notch"

    length: float = 0.100
    height: float = 0.040
    thickness: float = 0.0
    notch_length: float = 0.050
    notch_width: float = 0.0005
    notch_position: float | None = None
    h: float = 0.001
    h_tip: float | None = None
    refined: float = 0.0

    def __post_init__(self) -> None:
        require_positive("notched-plate", length=self.length, height=self.height, h=self.h, h_tip=self._fine)
        require_positive("notched-plate", notch_length=self.notch_length, notch_width=self.notch_width)
        require_not_negative(
            "notched-plate", thickness=self.thickness, refined=self.refined, notch_position=self._position
        )
        half = self.notch_width / 2
        require(
            half < self.notch_length < self.length,
            f"notched-plate: notch_length = {self.notch_length!r} must be less than length = {self.length!r} and more "
            f"than half of notch_width = {self.notch_width!r}.",
        )
        require(
            half < self._position < self.height - half,
            f"notched-plate: a slit of notch_width = {self.notch_width!r} at notch_position = {self._position!r} does "
            f"not lie within height = {self.height!r}.",
        )
        require_affordable("notched-plate", min(self.h, self._fine), self.cells_estimate())

    @property
    def _extent(self) -> tuple[float, float, float]:
        return self.length, self.height, self.thickness

    @property
    def _fine(self) -> float:
        return self.h / 4 if self.h_tip is None else self.h_tip

    @property
    def _position(self) -> float:
        return self.height / 2 if self.notch_position is None else self.notch_position

    @property
    def _sizing(self) -> SizeField:
        tip = (self.notch_length, self._position)
        ahead = min(self.notch_length + self.refined, self.length)
        return SizeField(self.h, min(self._fine, self.h), tip, (ahead, self._position))

    def _profile(self) -> Profile:
        half, y, tip = self.notch_width / 2, self._position, self.notch_length
        outside = [(0.0, 0.0), (self.length, 0.0), (self.length, self.height), (0.0, self.height)]
        slit = [(0.0, y + half), (tip - half, y + half), (tip, y), (tip - half, y - half), (0.0, y - half)]
        return Profile(outside + slit, {})


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
