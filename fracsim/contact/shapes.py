"""Shapes of obstacles: half space, sphere, capsule, box, cylinder, and shapes made of others.

Edges are rounded, so that distances are C1 outside. In 2D a half space is bounded by a line, a sphere is a disk, a
capsule a stadium, a box a rectangle.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from ..array_types import Flags, Values
from ..errors import InputError
from .shape_base import (
    SHAPE,
    ConvexBody,
    QuadrantDistance,
    Shape,
    ShapeKernels,
    Tessellation,
    frame_about,
    lengths,
    polygon,
    profile,
    require_fillet,
    require_lengths,
    resized_fillet,
    revolved,
    rounded_block,
    rounded_box,
    surface_of_revolution,
    unit_vector,
)

__all__ = [
    "SHAPES", "Capsule", "HalfSpace", "OffsetShape", "RoundedBox", "RoundedCylinder", "Shape", "Sphere",
    "TranslatedShape",
]  # fmt: skip


@dataclass(frozen=True)
class HalfSpace:
    """Half space n . x <= 0.

    Attributes:
        direction: (d,) along n, of any length, out of the half space.
        extent: edge of the patch that `tessellate` returns, m.
        kernels: compiled functions; None: array code.
    """

    kind: ClassVar[str] = "plane"
    convex: ClassVar[bool] = True
    rotation_invariant: ClassVar[bool] = False
    min_radius: ClassVar[float] = float("inf")
    volume: ClassVar[float] = float("inf")
    direction: tuple[float, ...]
    extent: float = 1.0
    kernels: ShapeKernels | None = field(default=None, compare=False, repr=False, kw_only=True)

    def __post_init__(self) -> None:
        """Raise InputError without a direction or extent."""
        unit_vector(self.direction)
        require_lengths(self.kind, extent=self.extent)

    @property
    def dim(self) -> int:
        """Dimension, 2 or 3."""
        return len(self.direction)

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
        """Square patch of two triangles (in 2D one segment) about the reference point; not closed."""
        R, h = frame_about(unit_vector(self.direction)), self.extent / 2
        if self.dim == 2:
            # outward is to the right of a segment, as on a counterclockwise polygon
            return np.array([[h, 0.0], [-h, 0.0]]) @ R.T, np.array([[0, 1]], np.int32)
        square = np.array([[-h, -h, 0.0], [h, -h, 0.0], [h, h, 0.0], [-h, h, 0.0]])
        return square @ R.T, np.array([[0, 1, 2], [0, 2, 3]], np.int32)

    def inertia(self, density: float) -> Values:
        """Raise InputError: a half space has no finite mass."""
        raise InputError("a plane is a half space without end, so it cannot move freely: hold it or drive it")


@dataclass(frozen=True)
class _SweptSphere(ConvexBody):
    """All points within a radius of a point or segment, the core."""

    @property
    @abstractmethod
    def core(self) -> tuple[Values, float, float]:
        """Unit vector along the segment, half its length and the radius, m."""

    def _from_core(self, x: Values) -> tuple[Values, Values, Values]:
        """Vectors (n, d) from the closest points of the core, their lengths (n,), and heights along it (n,), m."""
        axis, half, _ = self.core
        height = x @ axis
        away = x - np.minimum(np.maximum(height, -half), half)[:, None] * axis
        return away, np.sqrt(np.einsum("nd,nd->n", away, away)), height

    def _distance(self, x: Values) -> Values:
        return self._from_core(x)[1] - self.core[2]

    def _normal(self, x: Values) -> Values:
        away, length, _ = self._from_core(x)
        return self._direction(away, length, length < np.finfo(float).tiny)

    def _direction(self, away: Values, length: Values, on_core: Flags) -> Values:
        """(n, d) unit vectors along `away` (n, d) of a length (n,), m; across the axis for points on the core (n,)."""
        if not on_core.any():
            return np.asarray(away / length[:, None])
        # on the core every direction across it is a closest one
        across = frame_about(self.core[0])[:, 0]
        return np.where(on_core[:, None], across, away / np.where(on_core, 1.0, length)[:, None])

    def _curvature(self, x: Values) -> Values:
        """(n, d, d) (P - n n^T) / |x - closest|, P across the axis beside the core, the identity beyond its ends."""
        axis, half, _ = self.core
        away, length, height = self._from_core(x)
        on_core = length < np.finfo(float).tiny
        n, P = self._direction(away, length, on_core), np.eye(self.dim)
        if half:
            P = P - (abs(height) < half)[:, None, None] * np.outer(axis, axis)
        inverse = np.where(on_core, 0.0, 1 / np.where(on_core, 1.0, length))
        return np.asarray((P - n[:, :, None] * n[:, None, :]) * inverse[:, None, None])

    def _radius(self) -> float:
        return self.core[2]

    def _depth(self) -> float:
        return self._radius()

    def _resized(self, by: float) -> Self:
        return replace(self, radius=self._radius() + by)  # type: ignore[call-arg]

    def _tessellate(self) -> Tessellation:
        axis, half, radius = self.core
        side = profile(0.0, half, radius)
        points, elements = polygon(side) if self.dim == 2 else surface_of_revolution(side)
        return points @ frame_about(axis).T, elements

    def _moments(self) -> tuple[float, Values]:
        axis, half, radius = self.core
        return revolved(axis, 0.0, half, radius)


@dataclass(frozen=True)
class Sphere(_SweptSphere):
    """Sphere about the reference point; in 2D a disk.

    Attributes:
        radius: m.
        dim: 2 or 3.
    """

    kind: ClassVar[str] = "sphere"
    radius: float
    dim: int = 3

    def __post_init__(self) -> None:
        """Raise InputError unless radius and dimension are valid."""
        require_lengths(self.kind, radius=self.radius)
        if self.dim not in (2, 3):
            raise InputError(f"a sphere in {self.dim} dimensions is not known: dim is 2 or 3")

    @property
    def rotation_invariant(self) -> bool:
        """True."""
        return True

    @cached_property
    def core(self) -> tuple[Values, float, float]:
        """Unit vector along the segment, half its length and the radius, m."""
        return unit_vector((*[0.0] * (self.dim - 1), 1.0)), 0.0, self.radius


@dataclass(frozen=True)
class Capsule(_SweptSphere):
    """All points within a radius of a segment; in 2D a stadium. Its overall length is length + 2 radius.

    Attributes:
        radius: m.
        length: of the segment, m.
        axis: (d,) along the segment.
    """

    kind: ClassVar[str] = "capsule"
    radius: float
    length: float
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Raise InputError unless lengths and axis are valid."""
        unit_vector(self.axis)
        require_lengths(self.kind, radius=self.radius, length=self.length)

    @property
    def dim(self) -> int:
        """Dimension, 2 or 3."""
        return len(self.axis)

    @cached_property
    def core(self) -> tuple[Values, float, float]:
        """Unit vector along the segment, half its length and the radius, m."""
        return unit_vector(self.axis), self.length / 2, self.radius


@dataclass(frozen=True)
class RoundedBox(ConvexBody):
    """Box with rounded edges; in 2D a rectangle.

    Inside a container the distance is C1 within the rounding of the wall. Farther in, where another wall becomes the
    nearest, its gradient jumps: a barrier must be thinner than the rounding.

    Attributes:
        size: (d,) full sizes, m.
        rounding: radius of the edges, m; default: `SHAPE.fillet_ratio` of the least half size.
    """

    kind: ClassVar[str] = "box"
    size: tuple[float, ...]
    rounding: float | None = None

    def __post_init__(self) -> None:
        """Raise InputError unless sizes and rounding are valid."""
        if len(self.size) not in (2, 3):
            raise InputError(f"a box of {len(self.size)} sizes is not known: give 2 or 3")
        for size in self.size:
            require_lengths(self.kind, size=size)
        require_fillet(self.kind, self.fillet, min(self.size) / 2)

    @property
    def dim(self) -> int:
        """Dimension, 2 or 3."""
        return len(self.size)

    @property
    def fillet(self) -> float:
        """Radius of the edges, m."""
        return SHAPE.fillet_ratio * min(self.size) / 2 if self.rounding is None else self.rounding

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

    def _tessellate(self) -> Tessellation:
        half = self._half()
        if self.dim == 3:
            return rounded_block(half, self.fillet)
        return polygon(profile(float(half[0]), float(half[1]), self.fillet))

    def _moments(self) -> tuple[float, Values]:
        return rounded_box(self._half(), self.fillet)


def _signs(x: Values) -> Values:
    """Signs -1 or 1, never 0: a point on a middle plane has a nearest face as well."""
    return np.where(x < 0, -1.0, 1.0)


@dataclass(frozen=True)
class RoundedCylinder(ConvexBody):
    """Finite cylinder with rounded edges, in 3D.

    In the half plane through the axis it is a quadrant, q = (rho - (R - r), |height| - (L / 2 - r)). Inside a
    container the distance is C1 within the rounding of the wall, as for a box.

    Attributes:
        radius: R, m.
        length: full length L, m.
        rounding: radius r of the edges, m; default: `SHAPE.fillet_ratio` of the radius.
        axis: (3,) direction.
    """

    kind: ClassVar[str] = "cylinder"
    radius: float
    length: float
    rounding: float | None = None
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Raise InputError unless lengths, rounding and axis are valid."""
        unit_vector(self.axis)
        if len(self.axis) != 3:
            raise InputError("a cylinder needs an axis of 3 numbers: in 2D take a sphere (a disk) or a box")
        require_lengths(self.kind, radius=self.radius, length=self.length)
        require_fillet(self.kind, self.fillet, min(self.radius, self.length / 2))
        if self.fillet == self.radius:
            raise InputError("the rounding of a cylinder is its radius: take a capsule")

    @property
    def dim(self) -> int:
        """Dimension, 3."""
        return 3

    @property
    def fillet(self) -> float:
        """Radius of the edges, m; of a thin disk at most half its thickness."""
        return min(SHAPE.fillet_ratio * self.radius, self.length / 2) if self.rounding is None else self.rounding

    @property
    def core(self) -> tuple[float, float]:
        """Radius and half length of the sharp core that the fillet grows, m."""
        return self.radius - self.fillet, self.length / 2 - self.fillet

    def _polar(self, x: Values) -> tuple[QuadrantDistance, Values, Values, Values]:
        """Quadrant distance, distances from the axis (n,), m, unit vectors (n, d) away from the axis and along it."""
        axis, (radius, half) = unit_vector(self.axis), self.core
        height = x @ axis
        across = x - height[:, None] * axis
        rho = lengths(across)
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
        """(n, d, d) quadrant's Hessian in the half plane, and f_rho / rho around the axis (0 on it)."""
        corner, rho, away, up = self._polar(x)
        plane = np.stack([away, up], axis=1)
        # across both, for which the sign does not matter
        around = np.eye(3) - away[:, :, None] * away[:, None, :] - up[:, :, None] * up[:, None, :]
        on_axis = rho < np.finfo(float).tiny
        hoop = np.where(on_axis, 0.0, corner.gradient[:, 0] / np.where(on_axis, 1.0, rho))
        in_plane = plane.transpose(0, 2, 1) @ corner.hessian @ plane
        return np.asarray(in_plane + hoop[:, None, None] * around)

    def _radius(self) -> float:
        return self.fillet

    def _depth(self) -> float:
        return min(self.radius, self.length / 2)

    def _resized(self, by: float) -> RoundedCylinder:
        rounding = resized_fillet(self.fillet, by)
        return replace(self, radius=self.radius + by, length=self.length + 2 * by, rounding=rounding)

    def _tessellate(self) -> Tessellation:
        radius, half = self.core
        side = profile(radius, half, self.fillet)
        points, triangles = surface_of_revolution(side)
        return points @ frame_about(unit_vector(self.axis)).T, triangles

    def _moments(self) -> tuple[float, Values]:
        radius, half = self.core
        return revolved(unit_vector(self.axis), radius, half, self.fillet)


@dataclass(frozen=True, eq=False)
class _DerivedShape:
    """Shape made of another one, whose dimension, convexity and compiled functions it has.

    Attributes:
        shape: original shape.
    """

    shape: Shape

    @property
    def kernels(self) -> ShapeKernels | None:
        """Compiled functions of the original shape."""
        return self.shape.kernels

    @property
    def dim(self) -> int:
        """Dimension, 2 or 3."""
        return self.shape.dim

    @property
    def convex(self) -> bool:
        """Whether the original shape is convex."""
        return self.shape.convex


@dataclass(frozen=True, eq=False)
class TranslatedShape(_DerivedShape):
    """Shape centred at an offset from its reference point, as of a pendulum about its hinge.

    Attributes:
        offset: (d,) its centre, m.
    """

    kind: ClassVar[str] = "shape on a hinge"
    rotation_invariant: ClassVar[bool] = False  # a rotation about the reference point moves it
    offset: Values

    @property
    def min_radius(self) -> float:
        """Smallest radius of curvature of the original shape, m."""
        return self.shape.min_radius

    @property
    def volume(self) -> float:
        """Volume of the original shape, m^3 (2D: m^2)."""
        return self.shape.volume

    def distance(self, x: Values) -> Values:
        """(n,) signed distances, m."""
        return self.shape.distance(x - self.offset)

    def normal(self, x: Values) -> Values:
        """(n, d) gradients of the distance."""
        return self.shape.normal(x - self.offset)

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""
        return self.shape.curvature(x - self.offset)

    def tessellate(self) -> Tessellation:
        """Tessellation of the original shape, moved."""
        points, elements = self.shape.tessellate()
        return points + self.offset, elements

    def inertia(self, density: float) -> Values:
        """Moment of inertia about the reference point: I + m (|o|^2 1 - o o^T) (Huygens and Steiner)."""
        mass, o = density * self.volume, self.offset
        central = self.shape.inertia(density)
        if self.dim == 2:
            return np.asarray(central + mass * (o @ o))
        return np.asarray(central + mass * ((o @ o) * np.eye(3) - np.outer(o, o)))


@dataclass(frozen=True, eq=False)
class OffsetShape(_DerivedShape):
    """All points within an offset of a shape: its distance minus the offset.

    Attributes:
        offset: m.
    """

    offset: float

    @property
    def rotation_invariant(self) -> bool:
        """Whether no rotation about the reference point changes the shape."""
        return self.shape.rotation_invariant

    def distance(self, x: Values) -> Values:
        """(n,) signed distances, m."""
        return self.shape.distance(x) - self.offset

    def normal(self, x: Values) -> Values:
        """(n, d) gradients of the distance."""
        return self.shape.normal(x)

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""
        return self.shape.curvature(x)


# the name that a study gives -> class
SHAPES: dict[str, type[Shape]] = {
    "plane": HalfSpace, "sphere": Sphere, "capsule": Capsule, "box": RoundedBox, "cylinder": RoundedCylinder,
}  # fmt: skip
