"""A bar with a notch in the middle of its lower side, as in bending and impact tests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import cos, radians, sin, tan
from typing import ClassVar, Literal

import numpy as np

from ..data import Indices, Points
from ..parameters import is_length, require, require_affordable, require_not_negative, require_one_of, require_positive
from ..sizing import SizeField
from ..topology import facets_on_nodes
from .profile import CutRectangle, Point, Profile


@dataclass(frozen=True)
class NotchedBar(CutRectangle):
    """A straight bar along x with a notch in the middle of its lower side; by default the Charpy V specimen.

    2D: x is the length, y the height. 3D: x the length, y the thickness, z the height. One corner is at the origin.

    Attributes:
        length: [m].
        height: [m].
        thickness: [m]; 0 makes a 2D mesh.
        notch: "V": flanks at `notch_angle` with a root rounded to `notch_radius` (0: sharp);
            "U": parallel flanks 2 `notch_radius` apart with a half-circle at the root;
            "slit": parallel flanks `notch_width` apart that end in a right-angled point.
        notch_depth: [m], from the lower side to the root.
        notch_angle: angle between the flanks of a V [degrees].
        notch_radius: root radius of a V or U [m].
        notch_width: width of a slit [m].
        h: cell size [m] away from the notch.
        h_notch: cell size [m] at the root; h / 4 where left out.
        refined: height above the root up to which cells keep the size `h_notch` [m].
        span: distance between two supports under the bar [m]; 0: no supports.
        patch: width of the supports and of the loaded strip above the notch [m].

    Groups: left, right (least and greatest x), bottom, top (least and greatest height), notch, in 3D front, back
    (least and greatest y), and with a span support-left, support-right (in bottom), load (in top).

    Raises:
        MeshError: a parameter is out of range, or the notch or the supports do not fit.
    """

    name: ClassVar[str] = "notched-bar"
    regions: ClassVar[tuple[str, ...]] = ()
    cut: ClassVar[str] = "notch"

    length: float = 0.055
    height: float = 0.010
    thickness: float = 0.010
    notch: Literal["V", "U", "slit"] = "V"
    notch_depth: float = 0.002
    notch_angle: float = 45.0
    notch_radius: float = 0.00025
    notch_width: float = 0.0005
    h: float = 0.001
    h_notch: float | None = None
    refined: float = 0.0
    span: float = 0.040
    patch: float = 0.001

    def __post_init__(self) -> None:
        require_one_of("notched-bar", "notch", self.notch, ("V", "U", "slit"))
        require_positive("notched-bar", length=self.length, height=self.height, notch_depth=self.notch_depth, h=self.h)
        require_positive("notched-bar", h_notch=self._fine, **({"patch": self.patch} if self.span else {}))
        require_not_negative("notched-bar", thickness=self.thickness, refined=self.refined, span=self.span)
        self._check_notch()
        self._check_supports()
        require_affordable("notched-bar", min(self.h, self._fine), self.cells_estimate())

    @property
    def _extent(self) -> tuple[float, float, float]:
        return self.length, self.height, self.thickness

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return (*super().groups, *(("support-left", "support-right", "load") if self.span else ()))

    def mouth(self) -> float:
        """Width of the notch where it meets the lower side [m]."""
        return 2 * (self._flank[0][0] - self.length / 2)

    # --- derived quantities ---------------------------------------------------------------------------------------

    @property
    def _fine(self) -> float:
        return self.h / 4 if self.h_notch is None else self.h_notch

    @property
    def _sizing(self) -> SizeField:
        middle, reach = self.length / 2, self._root_radius
        low, high = (middle - reach, self.notch_depth - reach), (middle + reach, self.notch_depth + self.refined)
        return SizeField(self.h, min(self._fine, self.h), low, high)

    @property
    def _half_angle(self) -> float:
        return radians(self.notch_angle) / 2 if self.notch == "V" else 0.0

    @property
    def _root_radius(self) -> float:
        return 0.0 if self.notch == "slit" else self.notch_radius

    def _check_notch(self) -> None:
        """Raise MeshError if the parameters of the notch are out of range."""
        if self.notch == "slit":
            require_positive("notched-bar", notch_width=self.notch_width)
        elif self.notch == "U":
            require_positive("notched-bar", notch_radius=self.notch_radius)
        else:
            require_not_negative("notched-bar", notch_radius=self.notch_radius)
            require(
                is_length(self.notch_angle) and 0 < self.notch_angle < 180,
                f"notched-bar: notch_angle = {self.notch_angle!r} must lie between 0 and 180 degrees "
                '(parallel flanks: notch = "U").',
            )
        minimum = self.notch_width / 2 if self.notch == "slit" else self._root_radius * (1 - sin(self._half_angle))
        require(
            minimum < self.notch_depth < self.height,
            f"notched-bar: notch_depth = {self.notch_depth!r} must be less than height = {self.height!r} and more than "
            f"the {minimum:.3g} m that the root of the notch takes.",
        )

    def _check_supports(self) -> None:
        """Raise MeshError if the notch or the supports do not fit."""
        mouth = self.mouth()
        require(mouth < self.length, f"notched-bar: the notch is {mouth:.3g} m wide, length = {self.length!r} m only.")
        require(
            not self.span or mouth + self.patch < self.span < self.length - self.patch,
            f"notched-bar: span = {self.span!r} leaves no room for supports of patch = {self.patch!r} between the "
            f"notch ({mouth:.3g} m wide) and the ends (length = {self.length!r}); span = 0 leaves the supports out.",
        )

    # --- the outline ----------------------------------------------------------------------------------------------

    @cached_property
    def _flank(self) -> tuple[Point, Point]:
        """Lower and upper end of the straight right flank."""
        middle, depth = self.length / 2, self.notch_depth
        if self.notch == "slit":
            x = middle + self.notch_width / 2
            return (x, 0.0), (x, depth - self.notch_width / 2)
        half, radius = self._half_angle, self._root_radius
        # The flank touches the root circle, of centre (middle, depth - radius), where its normal points right and up.
        x, y = middle + radius * cos(half), depth - radius * (1 - sin(half))
        return (x + y * tan(half), 0.0), (x, y)

    def _profile(self) -> Profile:
        middle = self.length / 2
        foot, shoulder = self._flank
        mirrored = [(self.length - x, y) for x, y in (shoulder, foot)]
        half, side = self.patch / 2, self.span / 2
        below = [middle - side - half, middle - side + half] if self.span else []
        above = [middle + half, middle - half] if self.span else []
        corners = [(0.0, 0.0), *((x, 0.0) for x in below), mirrored[1], mirrored[0]]
        root = len(corners)
        corners += [(middle, self.notch_depth), shoulder, foot, *((self.length - x, 0.0) for x in reversed(below))]
        corners += [(self.length, 0.0), (self.length, self.height), *((x, self.height) for x in above)]
        corners += [(0.0, self.height)]
        # a sharp notch ends in one point; corners that coincide are left out
        if not self._root_radius:
            return Profile([c for i, c in enumerate(corners) if i == 0 or c != corners[i - 1]], {})
        centre = (middle, self.notch_depth - self._root_radius)
        return Profile(corners, {root - 1: centre, root: centre})

    def _groups(self, points: Points, cells: Indices) -> dict[str, Indices]:
        groups = super()._groups(points, cells)
        if not self.span:
            return groups
        middle, side, reach = self.length / 2, self.span / 2, self.patch / 2 + 1e-9 * self.length
        positions = {"support-left": ("bottom", -side), "support-right": ("bottom", side), "load": ("top", 0.0)}
        return groups | {
            name: facets_on_nodes(groups[face], np.abs(points[:, 0] - (middle + position)) <= reach)
            for name, (face, position) in positions.items()
        }
