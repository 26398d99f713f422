"""A plate with a slit from its left edge, as in single-edge notched tension and in crack branching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..parameters import require, require_affordable, require_not_negative, require_positive
from ..sizing import SizeField
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
