"""Obstacles by the name that a user writes: half space, sphere, capsule, box, cylinder.

A half space bounded by a plane (in 2D a line).

Sphere and capsule (in 2D disk and stadium): all points within a radius of a point or a segment.

A box with rounded edges; in 2D a rectangle with rounded corners.

A finite cylinder with rounded edges, in 3D.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from ..errors import InputError
from .shape_base import (
    FILLET,
    ConvexBody,
    QuadrantDistance,
    Shape,
    Values,
    frame_about,
    require_fillet,
    require_lengths,
    resized_fillet,
    unit_vector,
)
from .tessellation import Tessellation, polygon, profile, revolved, rounded_block, rounded_box, surface_of_revolution

__all__ = ["SHAPES", "Capsule", "HalfSpace", "RoundedBox", "RoundedCylinder", "Shape", "Sphere"]


@dataclass(frozen=True)
class HalfSpace:
    """The half space n . x <= 0, n along `direction` (d numbers of any length), which points out of it."""

    kind: ClassVar[str] = "plane"
    direction: tuple[float, ...]
    extent: float = 1.0  # edge of the patch that is drawn, m

    def __post_init__(self) -> None:
        """InputError where it is no plane."""
        unit_vector(self.direction)
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
    def rotation_invariant(self) -> bool:
        """It is not."""
        return False

    @property
    def min_radius(self) -> float:
        """Infinite."""
        return float("inf")

    @property
    def volume(self) -> float:
        """Infinite."""
        return float("inf")

    def distance(self, x: Values) -> Values:
        """(n,) n . x, m."""
        return np.asarray(x @ unit_vector(self.direction))

    def normal(self, x: Values) -> Values:
        """(n, d) n at every point."""
        return np.tile(unit_vector(self.direction), (len(x), 1))

    def curvature(self, x: Values) -> Values:
        """(n, d, d) zero."""
        return np.zeros((len(x), self.dim, self.dim))

    def tessellate(self) -> Tessellation:
        """A square patch of two triangles (in 2D one segment) about the reference point; not closed."""
        R, h = frame_about(unit_vector(self.direction)), self.extent / 2
        if self.dim == 2:
            # outward is to the right of a segment, as on a counterclockwise polygon
            return np.array([[h, 0.0], [-h, 0.0]]) @ R.T, np.array([[0, 1]], np.int32)
        square = np.array([[-h, -h, 0.0], [h, -h, 0.0], [h, h, 0.0], [-h, h, 0.0]])
        return square @ R.T, np.array([[0, 1, 2], [0, 2, 3]], np.int32)

    def inertia(self, density: float) -> Values:
        """InputError: a half space has no finite mass."""
        raise InputError("a plane is a half space without end, so it cannot move freely: hold it or drive it")


@dataclass(frozen=True)
class _Swept(ConvexBody):
    """All within a radius of a segment or point, which the subclasses say."""

    @abstractmethod
    def _core(self) -> tuple[Values, float, float]:
        """Unit vector along the segment, half its length and the radius, m."""

    def _from_core(self, x: Values) -> tuple[Values, Values, Values]:
        """Vectors (n, d) from the nearest points of the segment, their lengths, and heights along it (n,)."""
        axis, half, _ = self._core()
        height = x @ axis
        away = x - np.clip(height, -half, half)[:, None] * axis
        return away, np.linalg.norm(away, axis=1), height

    def _distance(self, x: Values) -> Values:
        return self._from_core(x)[1] - self._core()[2]

    def _normal(self, x: Values) -> Values:
        away, length, _ = self._from_core(x)
        on_core = length < np.finfo(float).tiny
        if not on_core.any():
            return np.asarray(away / length[:, None])
        some = frame_about(self._core()[0])[:, 0]  # on the segment itself every direction across it is as good
        return np.where(on_core[:, None], some, away / np.where(on_core, 1.0, length)[:, None])

    def _curvature(self, x: Values) -> Values:
        """(P - n n^T) / |x - nearest|, P across the axis beside the segment and the identity beyond its ends."""
        axis, half, _ = self._core()
        _, length, height = self._from_core(x)
        n, beside = self._normal(x), (abs(height) < half).astype(float)
        P = np.eye(self.dim) - beside[:, None, None] * np.outer(axis, axis)
        on_core = length < np.finfo(float).tiny
        bent = (P - n[:, :, None] * n[:, None, :]) / np.where(on_core, 1.0, length)[:, None, None]
        return np.where(on_core[:, None, None], 0.0, bent)

    def _radius(self) -> float:
        return self._core()[2]

    def _depth(self) -> float:
        return self._radius()

    def _resized(self, by: float) -> Self:
        return replace(self, radius=self._radius() + by)  # type: ignore[call-arg]

    def _outline(self) -> Tessellation:
        axis, half, radius = self._core()
        side = profile(0.0, half, radius)
        points, elements = polygon(side) if self.dim == 2 else surface_of_revolution(side)
        return points @ frame_about(axis).T, elements

    def _moments(self) -> tuple[float, Values]:
        axis, half, radius = self._core()
        return revolved(axis, 0.0, half, radius)


@dataclass(frozen=True)
class Sphere(_Swept):
    """All within `radius` (m) of the centre; in 2D a disk."""

    kind: ClassVar[str] = "sphere"
    radius: float
    dim: int = 3

    def __post_init__(self) -> None:
        """InputError where it is no sphere."""
        require_lengths(self, radius=self.radius)
        if self.dim not in (2, 3):
            raise InputError(f"a sphere in {self.dim} dimensions is not known: dim is 2 or 3")

    @property
    def rotation_invariant(self) -> bool:
        """It is."""
        return True

    def _core(self) -> tuple[Values, float, float]:
        return np.eye(self.dim)[-1], 0.0, self.radius


@dataclass(frozen=True)
class Capsule(_Swept):
    """All within `radius` of a segment of `length` along `axis`, m: from end to end length + 2 radius. 2D: stadium."""

    kind: ClassVar[str] = "capsule"
    radius: float
    length: float
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """InputError where it is no capsule."""
        unit_vector(self.axis)
        require_lengths(self, radius=self.radius, length=self.length)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.axis)

    def _core(self) -> tuple[Values, float, float]:
        return unit_vector(self.axis), self.length / 2, self.radius


@dataclass(frozen=True)
class RoundedBox(ConvexBody):
    """A box of full `size` (d numbers, m), edges rounded with `rounding` (m, default: FILLET of the least half size).

    From inside, as of a container, the distance is C1 within the rounding of the wall; further in, where another wall
    becomes the nearest, its gradient jumps: a barrier must be thinner than the rounding.
    """

    kind: ClassVar[str] = "box"
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

    def _corner(self, x: Values) -> QuadrantDistance:
        return QuadrantDistance(abs(x) - self._half())

    def _distance(self, x: Values) -> Values:
        return self._corner(x).value - self.fillet

    def _normal(self, x: Values) -> Values:
        return _signs(x) * self._corner(x).gradient

    def _curvature(self, x: Values) -> Values:
        signs = _signs(x)
        return signs[:, :, None] * self._corner(x).hessian * signs[:, None, :]

    def _radius(self) -> float:
        return self.fillet

    def _depth(self) -> float:
        return min(self.size) / 2

    def _resized(self, by: float) -> RoundedBox:
        size = tuple(side + 2 * by for side in self.size)
        return replace(self, size=size, rounding=resized_fillet(self.fillet, by))

    def _outline(self) -> Tessellation:
        half = self._half()
        if self.dim == 3:
            return rounded_block(half, self.fillet)
        return polygon(profile(float(half[0]), float(half[1]), self.fillet))

    def _moments(self) -> tuple[float, Values]:
        return rounded_box(self._half(), self.fillet)


def _signs(x: Values) -> Values:
    """-1 or 1, never 0: on a middle plane there is a nearest face as well."""
    return np.where(x < 0, -1.0, 1.0)


@dataclass(frozen=True)
class RoundedCylinder(ConvexBody):
    """A cylinder of `radius` and full `length` along `axis`, edges rounded with `rounding` (m, default FILLET radius).

    In the half plane through the axis it is a corner, q = (rho - (R - r), |height| - (L / 2 - r)). From inside the
    distance is C1 within the rounding of the wall, as for a box.
    """

    kind: ClassVar[str] = "cylinder"
    radius: float
    length: float
    rounding: float | None = None
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """InputError where it is no cylinder."""
        unit_vector(self.axis)
        if len(self.axis) != 3:
            raise InputError("a cylinder needs an axis of 3 numbers: in 2D take a sphere (a disk) or a box")
        require_lengths(self, radius=self.radius, length=self.length)
        require_fillet(self, self.fillet, min(self.radius, self.length / 2))
        if self.fillet == self.radius:
            raise InputError("the rounding of a cylinder is its radius: take a capsule")

    @property
    def dim(self) -> int:
        """3."""
        return 3

    @property
    def fillet(self) -> float:
        """Radius of the edges, m; for a thin disk no more than half its thickness."""
        return min(FILLET * self.radius, self.length / 2) if self.rounding is None else self.rounding

    def _core(self) -> tuple[float, float]:
        """Radius and half length of the sharp core that the fillet grows, m."""
        return self.radius - self.fillet, self.length / 2 - self.fillet

    def _polar(self, x: Values) -> tuple[QuadrantDistance, Values, Values, Values]:
        """The corner, distances from the axis (n,), and unit vectors (n, d) away from the axis and up or down it."""
        axis, (radius, half) = unit_vector(self.axis), self._core()
        height = x @ axis
        across = x - height[:, None] * axis
        rho = np.linalg.norm(across, axis=1)
        on_axis = rho < np.finfo(float).tiny
        away = across / np.where(on_axis, 1.0, rho)[:, None]
        if on_axis.any():
            away[on_axis] = frame_about(axis)[:, 0]
        q = np.stack([rho - radius, abs(height) - half], axis=1)
        return QuadrantDistance(q), rho, away, np.where(height < 0, -1.0, 1.0)[:, None] * axis

    def _distance(self, x: Values) -> Values:
        return self._polar(x)[0].value - self.fillet

    def _normal(self, x: Values) -> Values:
        corner, _, away, up = self._polar(x)
        return corner.gradient[:, :1] * away + corner.gradient[:, 1:] * up

    def _curvature(self, x: Values) -> Values:
        """The corner's Hessian in the half plane, and f_rho / rho around the axis (0 on it: an end is nearest)."""
        corner, rho, away, up = self._polar(x)
        plane = np.stack([away, up], axis=1)
        around = np.cross(away, up)
        on_axis = rho < np.finfo(float).tiny
        ring = np.where(on_axis, 0.0, corner.gradient[:, 0] / np.where(on_axis, 1.0, rho))
        bent = plane.transpose(0, 2, 1) @ corner.hessian @ plane
        return np.asarray(bent + ring[:, None, None] * around[:, :, None] * around[:, None, :])

    def _radius(self) -> float:
        return self.fillet

    def _depth(self) -> float:
        return min(self.radius, self.length / 2)

    def _resized(self, by: float) -> RoundedCylinder:
        rounding = resized_fillet(self.fillet, by)
        return replace(self, radius=self.radius + by, length=self.length + 2 * by, rounding=rounding)

    def _outline(self) -> Tessellation:
        radius, half = self._core()
        side = profile(radius, half, self.fillet)
        points, triangles = surface_of_revolution(side)
        return points @ frame_about(unit_vector(self.axis)).T, triangles

    def _moments(self) -> tuple[float, Values]:
        radius, half = self._core()
        return revolved(unit_vector(self.axis), radius, half, self.fillet)


SHAPES: dict[str, type[Shape]] = {
    "plane": HalfSpace, "sphere": Sphere, "capsule": Capsule, "box": RoundedBox, "cylinder": RoundedCylinder,
}  # fmt: skip
