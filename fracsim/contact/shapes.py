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

from ..array_types import Values
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
    "SHAPES", "Capsule", "HalfSpace", "RevolvedBody", "RoundedBox", "RoundedCylinder", "Shape", "Sphere",
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
    max_inset: ClassVar[float] = float("inf")
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

    def inset(self, by: float) -> TranslatedShape:
        """The half space with its surface receded by `by`, m."""
        return TranslatedShape(self, -by * unit_vector(self.direction))

    def inertia(self, density: float) -> Values:
        """Raise InputError: a half space has no finite mass."""
        raise InputError("a plane is a half space without end, so it cannot move freely: hold it or drive it")


@dataclass(frozen=True)
class RevolvedBody(ConvexBody):
    """Cylinder that is grown by a fillet; in 2D a rectangle. Without a radius its core is a segment, or a point.

    In the half plane through the axis q = (rho - R, |height| - H), rho the distance from the axis.

    Attributes:
        radius: of the body, m; that of the fillet, too, where the core has none.
    """

    radius: float

    @property
    @abstractmethod
    def core(self) -> tuple[Values, float, float]:
        """Unit vector (d,) along the axis, radius R and half length H of the core, m."""

    @property
    def fillet(self) -> float:
        """Radius by which the core is grown, m."""
        return self.radius

    @property
    def depth(self) -> float:
        """Largest distance of an inner point from the surface, m."""
        return self.radius

    def resized(self, by: float) -> Self:
        """The body with its surface moved outwards by `by`, m, which may be negative."""
        return replace(self, radius=self.radius + by)

    def _polar(self, x: Values) -> tuple[Values, Values, Values]:
        """Heights (n,) and distances from the axis (n,), m, and unit vectors away from it (n, d)."""
        axis = self.core[0]
        height = x @ axis
        across = x - height[:, None] * axis
        rho = lengths(across)
        on_axis = rho < np.finfo(float).tiny
        away = across / np.where(on_axis, 1.0, rho)[:, None]
        if on_axis.any():
            away[on_axis] = frame_about(axis)[:, 0]
        return height, rho, away

    def core_coordinates(self, x: Values) -> tuple[Values, Values]:
        """(n, 2) q at points x (n, d), m, and their gradients (n, 2, d): away from the axis, and along it."""
        (axis, radius, half), (height, rho, away) = self.core, self._polar(x)
        up = np.where(height < 0, -1.0, 1.0)[:, None] * axis
        return np.stack([rho - radius, abs(height) - half], axis=1), np.stack([away, up], axis=1)

    def core_curvature(self, x: Values, corner: QuadrantDistance) -> Values:
        """(n, d, d) f_rho / rho around the axis, 1/m; on the axis its limit, the second derivative f_rho,rho."""
        axis, (_, rho, away) = self.core[0], self._polar(x)
        around = np.eye(self.dim) - away[:, :, None] * away[:, None, :] - np.outer(axis, axis)
        on_axis = rho < np.finfo(float).tiny
        hoop = np.where(on_axis, corner.hessian[:, 0, 0], corner.gradient[:, 0] / np.where(on_axis, 1.0, rho))
        return np.asarray(hoop[:, None, None] * around)

    def outline(self) -> Tessellation:
        """Surface of revolution, or polygon, of the filled body."""
        axis, radius, half = self.core
        side = profile(radius, half, self.fillet)
        points, elements = polygon(side) if self.dim == 2 else surface_of_revolution(side)
        return points @ frame_about(axis).T, elements

    def moments(self) -> tuple[float, Values]:
        """Volume, m^3 (2D: m^2), and S = int x x^T dV (d, d) of the filled body."""
        return revolved(*self.core, self.fillet)


@dataclass(frozen=True)
class Sphere(RevolvedBody):
    """Sphere about the reference point; in 2D a disk.

    Attributes:
        radius: m.
        dim: 2 or 3.
    """

    kind: ClassVar[str] = "sphere"
    rotation_invariant: ClassVar[bool] = True
    dim: int = 3

    def __post_init__(self) -> None:
        """Raise InputError unless radius and dimension are valid."""
        require_lengths(self.kind, radius=self.radius)
        if self.dim not in (2, 3):
            raise InputError(f"a sphere in {self.dim} dimensions is not known: dim is 2 or 3")

    @cached_property
    def core(self) -> tuple[Values, float, float]:
        """The centre: a vector (d,), and twice 0 m."""
        return unit_vector((*[0.0] * (self.dim - 1), 1.0)), 0.0, 0.0


@dataclass(frozen=True)
class Capsule(RevolvedBody):
    """All points within a radius of a segment; in 2D a stadium. Its overall length is length + 2 radius.

    Attributes:
        radius: m.
        length: of the segment, m.
        axis: (d,) along the segment.
    """

    kind: ClassVar[str] = "capsule"
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
        """The segment: unit vector (d,) along it, 0 m, and half its length, m."""
        return unit_vector(self.axis), 0.0, self.length / 2


@dataclass(frozen=True)
class RoundedCylinder(RevolvedBody):
    """Finite cylinder with rounded edges, in 3D.

    Inside a container the distance is C1 within the rounding of the wall, as for a box.

    Attributes:
        radius: m.
        length: full length, m.
        rounding: radius of the edges, m; default: `SHAPE.fillet_ratio` of the radius.
        axis: (3,) direction.
    """

    kind: ClassVar[str] = "cylinder"
    dim: ClassVar[int] = 3
    length: float
    rounding: float | None = None
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Raise InputError unless lengths, rounding and axis are valid."""
        unit_vector(self.axis)
        if len(self.axis) != 3:
            raise InputError("a cylinder needs an axis of 3 numbers: in 2D take a sphere (a disk) or a box")
        require_lengths(self.kind, radius=self.radius, length=self.length)
        require_fillet(self.kind, self.fillet, self.depth)
        if self.fillet == self.radius:
            raise InputError("the rounding of a cylinder is its radius: take a capsule")

    @property
    def fillet(self) -> float:
        """Radius of the edges, m; of a thin disk at most half its thickness."""
        return min(SHAPE.fillet_ratio * self.radius, self.length / 2) if self.rounding is None else self.rounding

    @property
    def core(self) -> tuple[Values, float, float]:
        """Unit vector (d,) along the axis, radius R and half length H of the core, m."""
        return unit_vector(self.axis), self.radius - self.fillet, self.length / 2 - self.fillet

    @property
    def depth(self) -> float:
        """Radius or half the length, m: the smaller one."""
        return min(self.radius, self.length / 2)

    def resized(self, by: float) -> RoundedCylinder:
        """Cylinder with its surface moved outwards by `by`, m."""
        rounding = resized_fillet(self.fillet, by)
        return replace(self, radius=self.radius + by, length=self.length + 2 * by, rounding=rounding)


@dataclass(frozen=True)
class RoundedBox(ConvexBody):
    """Box with rounded edges; in 2D a rectangle. q = |x| - h, h the half sizes of its core.

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
        require_fillet(self.kind, self.fillet, self.depth)

    @property
    def dim(self) -> int:
        """Dimension, 2 or 3."""
        return len(self.size)

    @property
    def fillet(self) -> float:
        """Radius of the edges, m."""
        return SHAPE.fillet_ratio * self.depth if self.rounding is None else self.rounding

    @property
    def core(self) -> Values:
        """(d,) half sizes of the core, m."""
        return np.array(self.size) / 2 - self.fillet

    @property
    def depth(self) -> float:
        """Least half size, m."""
        return min(self.size) / 2

    def resized(self, by: float) -> RoundedBox:
        """Box with its surface moved outwards by `by`, m."""
        size = tuple(side + 2 * by for side in self.size)
        return replace(self, size=size, rounding=resized_fillet(self.fillet, by))

    def core_coordinates(self, x: Values) -> tuple[Values, Values]:
        """(n, d) q at points x (n, d), m, and their gradients (n, d, d)."""
        # never 0: a point on a middle plane has a nearest face as well
        signs = np.where(x < 0, -1.0, 1.0)
        return abs(x) - self.core, signs[:, :, None] * np.eye(self.dim)

    def core_curvature(self, x: Values, corner: QuadrantDistance) -> Values:
        """(n, d, d) zero: faces are plane."""
        return np.zeros((len(x), self.dim, self.dim))

    def outline(self) -> Tessellation:
        """Surface or polygon of the filled box."""
        half = self.core
        if self.dim == 3:
            return rounded_block(half, self.fillet)
        return polygon(profile(float(half[0]), float(half[1]), self.fillet))

    def moments(self) -> tuple[float, Values]:
        """Volume, m^3 (2D: m^2), and S = int x x^T dV (d, d) of the filled box."""
        return rounded_box(self.core, self.fillet)


@dataclass(frozen=True, eq=False)
class TranslatedShape:
    """Shape centred at an offset from its reference point, as of a pendulum about its hinge.

    Attributes:
        shape: original shape, whose compiled functions serve this one, too.
        offset: (d,) its centre, m.
        growth: length by which all distances are smaller, m, as of a shape that is grown.
    """

    kind: ClassVar[str] = "shape on a hinge"
    shape: Shape
    offset: Values
    growth: float = 0.0

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

    @property
    def rotation_invariant(self) -> bool:
        """Whether no rotation about the reference point changes the shape: with an offset all do."""
        return self.shape.rotation_invariant and not self.offset.any()

    @property
    def min_radius(self) -> float:
        """Smallest radius of curvature of the original shape, m."""
        return self.shape.min_radius

    @property
    def max_inset(self) -> float:
        """Largest inset of the original shape, m."""
        return self.shape.max_inset

    def inset(self, by: float) -> TranslatedShape:
        """The shape with its surface receded by `by`, m."""
        return replace(self, shape=self.shape.inset(by))

    @property
    def volume(self) -> float:
        """Volume of the original shape, m^3 (2D: m^2)."""
        return self.shape.volume

    def distance(self, x: Values) -> Values:
        """(n,) signed distances, m."""
        return self.shape.distance(x - self.offset) - self.growth

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


# the name that a study gives -> class
SHAPES: dict[str, type[Shape]] = {
    "plane": HalfSpace, "sphere": Sphere, "capsule": Capsule, "box": RoundedBox, "cylinder": RoundedCylinder,
}  # fmt: skip
