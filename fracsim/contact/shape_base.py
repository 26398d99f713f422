"""Base of obstacle shapes: signed distance, tessellation, moments of inertia, and what boxes and cylinders share.

Tessellations are closed, face outwards, and lie within 1 % of the volume. Volume and second moments of rounded bodies
are exact, by slices.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from math import comb, pi
from typing import TYPE_CHECKING, ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.special import beta

from ..array_types import Values
from ..errors import InputError

if TYPE_CHECKING:
    from .laws import Barrier

Ints = npt.NDArray[np.int32]
Tessellation = tuple[Values, Ints]


@dataclass(frozen=True)
class ShapePolicy:
    """Tuned numbers of shapes.

    Attributes:
        fillet_ratio: default radius of rounded edges, in the smallest radius or half size.
        min_fillet_ratio: part of a fillet that an inset body keeps.
        arc_steps: elements of a tessellated quarter circle.
    """

    fillet_ratio: float = 0.05
    min_fillet_ratio: float = 0.5
    arc_steps: int = 12


SHAPE = ShapePolicy()


class ShapeKernels(Protocol):
    """Compiled functions of shapes at a pose (shape_kernels); x (n, d) are points of space, m."""

    def pack(self, shape: Shape, centre: Values, rotation: Values) -> Values:
        """Numbers of a shape at a pose, as the functions take them."""

    def distance(self, packed: Values, x: Values) -> Values:
        """(n,) signed distances, m."""

    def normal(self, packed: Values, x: Values) -> Values:
        """(n, d) gradients of the distance."""

    def curvature(self, packed: Values, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""

    def find_closest_points(
        self, packed: Values, x: Values, smoothing: float, tolerance: float, barycentric: Values
    ) -> None:
        """Search for the closest points of facets (closest_point).

        Args:
            packed: the shape at its pose.
            x: (k, c, d) corners, m.
            smoothing: mu, m.
            tolerance: remaining derivative by barycentric coordinates, in facet sizes.
            barycentric: (k, c) coordinates to start from, nan: a guess; overwritten by those of the closest points.
        """

    def facet_energy(
        self,
        packed: Values,
        x: Values,
        barycentric: Values,
        smoothing: float,
        law: Barrier,
        start: Values | None,
        area: Values,
        *,
        second: bool,
    ) -> tuple[Values, Values]:
        """Energy of facets and its derivatives (shape_kernels)."""


class Shape(Protocol):
    """Shape in its own frame, centred at its reference point; d = 2 or 3, lengths in m.

    Attributes:
        kind: name in messages.
    """

    kind: ClassVar[str]

    @property
    def kernels(self) -> ShapeKernels | None:
        """Compiled functions for the shape at a pose; None: the methods here are used."""

    @property
    def dim(self) -> int:
        """Dimension d."""

    @property
    def convex(self) -> bool:
        """Whether the obstacle is convex, and its distance a convex function."""

    @property
    def rotation_invariant(self) -> bool:
        """Whether no rotation about its reference point changes it."""

    @property
    def min_radius(self) -> float:
        """Smallest radius of curvature of its convex surface, m; infinite where it has none."""

    @property
    def volume(self) -> float:
        """Volume, m^3 (2D: area, m^2); of a hollow body that of the cavity."""

    @property
    def max_inset(self) -> float:
        """Largest inset, m; infinite for a half space and a hollow body."""

    def inset(self, by: float) -> Shape:
        """The obstacle with its surface receded by `by` <= `max_inset`, m: distances grow by at least as much."""

    def distance(self, x: Values) -> Values:
        """(n,) signed distances of points x (n, d), m: positive outside the obstacle."""

    def normal(self, x: Values) -> Values:
        """(n, d) gradients of the distance, of length 1, out of the obstacle."""

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""

    def tessellate(self) -> Tessellation:
        """Points (n, d), m, and triangles (k, 3) (2D: segments (k, 2)) that face along `normal`."""

    def inertia(self, density: float) -> Values:
        """(3, 3) moment of inertia about the centre, kg m^2; in 2D () polar moment, kg m^2 per m of thickness."""


@dataclass(frozen=True, kw_only=True)
class ConvexBody(ABC):
    """Core that is grown by a radius r, the fillet; or the space outside this body.

        distance = f(q(x)) - r,    f: signed distance to the quadrant q <= 0 (QuadrantDistance)

    The coordinates q (n, k) of a point tell how far it is outside the core, along directions that are orthogonal.

    Attributes:
        kind: name in messages.
        hollow: the obstacle is the space outside the body, as for what lies in a container.
        kernels: compiled functions; None: array code.
    """

    kind: ClassVar[str]
    hollow: bool = False
    kernels: ShapeKernels | None = field(default=None, compare=False, repr=False)

    @property
    @abstractmethod
    def dim(self) -> int:
        """Dimension, 2 or 3."""

    @property
    @abstractmethod
    def fillet(self) -> float:
        """Radius r by which the core is grown, m."""

    @property
    @abstractmethod
    def depth(self) -> float:
        """Largest distance of an inner point from the surface, m."""

    @abstractmethod
    def resized(self, by: float) -> Self:
        """The body with its surface moved outwards by `by`, m, which may be negative."""

    @abstractmethod
    def core_coordinates(self, x: Values) -> tuple[Values, Values]:
        """(n, k) q at points x (n, d), m, and their gradients (n, k, d), of length 1."""

    @abstractmethod
    def core_curvature(self, x: Values, corner: QuadrantDistance) -> Values:
        """(n, d, d) part of the Hessian of f(q(x)) by the second derivatives of q, 1/m; `corner`: f at q(x)."""

    @abstractmethod
    def outline(self) -> Tessellation:
        """Closed surface or polygon of the filled body."""

    @abstractmethod
    def moments(self) -> tuple[float, Values]:
        """Volume, m^3 (2D: m^2), and S = int x x^T dV (d, d) of the filled body."""

    @property
    def convex(self) -> bool:
        """True unless the body is hollow."""
        return not self.hollow

    @property
    def _sign(self) -> float:
        return -1.0 if self.hollow else 1.0

    def distance(self, x: Values) -> Values:
        """(n,) signed distances of points x (n, d), m."""
        return self._sign * (QuadrantDistance(self.core_coordinates(x)[0]).value - self.fillet)

    def normal(self, x: Values) -> Values:
        """(n, d) gradients of the distance."""
        q, directions = self.core_coordinates(x)
        return self._sign * np.asarray(np.einsum("nk,nkd->nd", QuadrantDistance(q).gradient, directions))

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""
        q, directions = self.core_coordinates(x)
        corner = QuadrantDistance(q)
        along = directions.transpose(0, 2, 1) @ corner.hessian @ directions
        return self._sign * np.asarray(along + self.core_curvature(x, corner))

    def tessellate(self) -> Tessellation:
        """Closed surface or polygon; that of a hollow body faces inwards."""
        points, elements = self.outline()
        return points, np.ascontiguousarray(elements[:, ::-1]) if self.hollow else elements

    @property
    def rotation_invariant(self) -> bool:
        """False; True for spheres."""
        return False

    @property
    def min_radius(self) -> float:
        """Smallest radius of curvature, m; infinite for a hollow body."""
        return float("inf") if self.hollow else self.fillet

    @property
    def volume(self) -> float:
        """Enclosed volume, m^3 (2D: area, m^2)."""
        return self.moments()[0]

    def inertia(self, density: float) -> Values:
        """Moment of inertia rho (tr S 1 - S) with S = int x x^T dV; in 2D rho tr S."""
        if self.hollow:
            raise InputError(f"a hollow {self.kind} has walls without thickness, so no inertia: hold it")
        S = self.moments()[1]
        return density * (np.trace(S) * np.eye(3) - S if self.dim == 3 else np.asarray(np.trace(S)))

    def inset(self, by: float) -> Self:
        """The obstacle with its surface receded by `by` <= `max_inset`, m: distances grow by at least as much."""
        return self.resized(-self._sign * by)

    @property
    def max_inset(self) -> float:
        """Largest inset, m; infinite for a hollow body."""
        return float("inf") if self.hollow else self.depth / 2


def resized_fillet(fillet: float, by: float) -> float:
    """Fillet radius of a body whose surface moves outwards by `by`, m."""
    return max(fillet + by, fillet * SHAPE.min_fillet_ratio)


def require_lengths(kind: str, **lengths: float) -> None:
    """Raise InputError unless every length of a shape is positive and finite."""
    for word, value in lengths.items():
        if not 0 < value < np.inf:
            raise InputError(f"the {word} of a {kind} is {value}: it must be a positive number of metres")


def require_fillet(kind: str, rounding: float, largest: float) -> None:
    """Raise InputError unless a fillet is positive and fits; a sharp edge has no curvature for Newton's method."""
    require_lengths(kind, rounding=rounding)
    if rounding > largest:
        raise InputError(
            f"the rounding of a {kind} is {rounding} m, but at most {largest} m fit into it: round it less"
        )


def lengths(vectors: Values) -> Values:
    """(n,) lengths of vectors (n, d); a third of the time of np.linalg.norm for few of them."""
    return np.asarray(np.sqrt(np.einsum("nd,nd->n", vectors, vectors)))


@lru_cache
def unit_vector(direction: tuple[float, ...]) -> Values:
    """(d,) unit vector along a direction, read-only; InputError if it has no direction."""
    vector = np.array(direction, float)
    length = float(np.linalg.norm(vector))
    if len(vector) not in (2, 3) or not 0 < length < np.inf:
        raise InputError(f"{direction} is no direction: give 2 or 3 numbers that are not all zero")
    vector /= length
    vector.setflags(write=False)
    return vector


def frame_about(axis: Values) -> Values:
    """(d, d) rotation whose last column is the unit vector `axis` (d,)."""
    if len(axis) == 2:
        return np.array([[axis[1], axis[0]], [-axis[0], axis[1]]])
    across = np.cross(np.eye(3)[np.argmin(abs(axis))], axis)
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(axis, across), axis])


class QuadrantDistance:
    """Signed distance to the quadrant or octant q <= 0: f(q) = |max(q, 0)| outside, max_i q_i inside.

    Offset by a rounding r, f - r is exact inside the rounded body too: a convex body grown by r is nowhere thicker.
    """

    def __init__(self, q: Values) -> None:
        """`q`: (n, k) points, m."""
        self._q, self._outside = q, np.maximum(q, 0)
        self._length = lengths(self._outside)
        # too close to the corner to divide by the length: as if inside
        self._inside = self._length < np.finfo(float).tiny

    @cached_property
    def value(self) -> Values:
        """(n,) f, m."""
        return np.where(self._inside, self._q.max(axis=1), self._length)

    @cached_property
    def gradient(self) -> Values:
        """(n, k) gradient of f, of length 1; inside that of the nearest face."""
        nearest_face = np.eye(self._q.shape[1])[self._q.argmax(axis=1)]
        return np.where(self._inside[:, None], nearest_face, self._outside / self._divisor[:, None])

    @cached_property
    def hessian(self) -> Values:
        """(n, k, k) Hessian of f: (diag(q >= 0) - n n^T) / f outside, 0 inside, 1/m.

        q = 0 counts as outside: where a core has no thickness, q is never negative and 0 on its middle plane.
        """
        n, active = self.gradient, (self._q >= 0).astype(float)
        tangent = active[:, :, None] * np.eye(n.shape[1]) - n[:, :, None] * n[:, None, :]
        return np.where(self._inside[:, None, None], 0.0, tangent / self._divisor[:, None, None])

    @cached_property
    def _divisor(self) -> Values:
        return np.where(self._inside, 1.0, self._length)


# --- tessellations ---


def measures(x: Values, elements: npt.NDArray[np.integer]) -> Values:
    """(m,) areas of triangles (m, 3), m^2, or lengths of segments (m, 2), m, with points at x (n, d), m."""
    side = x[elements[:, 1:]] - x[elements[:, :1]]
    spanned = side[:, 0] if x.shape[1] == 2 else 0.5 * np.cross(side[:, 0], side[:, 1])
    return np.asarray(np.linalg.norm(spanned, axis=1))


def profile(core_radius: float, half: float, rounding: float) -> Values:
    """(k, 2) half a meridian of a rectangle grown by the rounding: (distance from the axis, height), from below, m."""
    angle = np.linspace(0, np.pi / 2, SHAPE.arc_steps + 1)
    arc = rounding * np.column_stack([np.cos(angle), np.sin(angle)])
    upper = arc + np.array([core_radius, half])
    upper[-1, 0] = core_radius  # not cos(pi/2)
    lower = upper[::-1] * [1, -1]
    return np.concatenate([lower[:-1] if half == 0 else lower, upper])


def polygon(side: Values) -> Tessellation:
    """Counterclockwise segments around a half profile (k, 2) and its mirror image."""
    mirrored = side[::-1] * [-1, 1]
    points = np.concatenate([side, mirrored[mirrored[:, 0] < 0]])
    index = np.arange(len(points), dtype=np.int32)
    return points, np.column_stack([index, np.roll(index, -1)])


def surface_of_revolution(side: Values) -> Tessellation:
    """Triangles of a half profile (k, 2) rotated about the last axis, with a pole at either end."""
    heights, side, steps = side[[0, -1], 1], side[side[:, 0] > 0], 4 * SHAPE.arc_steps
    angle = np.arange(steps) * (2 * np.pi / steps)
    circle = np.stack([np.cos(angle), np.sin(angle), np.ones(steps)], axis=1)
    rings = (side[:, None, [0, 0, 1]] * circle).reshape(-1, 3)
    poles = np.array([[0, 0, heights[0]], [0, 0, heights[1]]])
    index = np.arange(len(rings)).reshape(-1, steps)
    first, last = (np.full((1, steps), len(rings) + end) for end in (0, 1))
    grid = np.concatenate([first, index, last])
    return np.concatenate([rings, poles]), _triangles(np.column_stack([grid, grid[:, 0]]))


def rounded_block(half: Values, rounding: float) -> Tessellation:
    """Triangles of a box of half sizes (3,), m, grown by the rounding: octants of a sphere, moved to the corners."""
    arc = np.tan(np.linspace(0, np.pi / 4, SHAPE.arc_steps // 2 + 1))
    sides, steps = np.concatenate([-arc[::-1], arc]), np.arange(2 * len(arc))
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    triangles = _faces_of_cube(len(steps))
    used, index = np.unique(triangles, return_inverse=True)
    direction = sides[lattice[used]]
    corner = np.where(lattice[used] < len(arc), -half, half)
    points = corner + rounding * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return points, index.reshape(-1, 3).astype(np.int32)


def _faces_of_cube(count: int) -> Ints:
    """Triangles on the six faces of a lattice of count^3 points, facing outwards."""
    lattice = np.arange(count**3).reshape(count, count, count)
    faces = []
    for axis in range(3):
        low, high = lattice.take(0, axis), lattice.take(-1, axis)
        # the two other axes, in ascending order, are right-handed about axes 0 and 2
        faces += [low, high.T] if axis == 1 else [low.T, high]
    return np.concatenate([_triangles(np.asarray(face.T)) for face in faces])


def _triangles(grid: npt.NDArray[np.integer]) -> Ints:
    """Two triangles per cell of a grid of point numbers, columns x rows right-handed; none where points coincide."""
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    triangles = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return triangles[distinct].astype(np.int32)


# --- volume and second moments ---


def slices(power: int, half: float, rounding: float, area: Polynomial) -> float:
    """Integral of |x|^power A(s(x)) dx along an axis of a body that is a core of half length h grown by r on all sides.

    A(s) is the measure (or moment) of a slice of the core grown by s: s = r for |x| <= h, and s = sqrt(r^2 - t^2)
    at |x| = h + t. With int_0^r t^k s^m dt = r^(k + m + 1) / 2 * beta((k + 1) / 2, m / 2 + 1) all is exact.
    """
    total = half ** (power + 1) / (power + 1) * float(area(rounding))
    for m, factor in enumerate(area.coef):
        for k in range(power + 1):
            cap = rounding ** (k + m + 1) / 2 * float(beta((k + 1) / 2, m / 2 + 1))
            total += float(factor) * comb(power, k) * half ** (power - k) * cap
    return 2 * total


def revolved(axis: Values, core_radius: float, half: float, rounding: float) -> tuple[float, Values]:
    """Volume and S = int x x^T dV (d, d) of a cylinder (in 2D a rectangle) about `axis`, grown by the rounding."""
    radius = Polynomial([core_radius, 1.0])
    is_flat = len(axis) == 2
    area, across = (2 * radius, 2 / 3 * radius**3) if is_flat else (pi * radius**2, pi / 4 * radius**4)
    volume, along = (slices(power, half, rounding, area) for power in (0, 2))
    projector = np.outer(axis, axis)
    return volume, along * projector + slices(0, half, rounding, across) * (np.eye(len(axis)) - projector)


def rounded_box(half: Values, rounding: float) -> tuple[float, Values]:
    """Volume and S = int x x^T dV (d, d) of a box of half sizes (d,), m, grown by the rounding."""
    areas = [_slice_of_box(2 * np.delete(half, axis)) for axis in range(len(half))]
    moments = [slices(2, float(h), rounding, area) for h, area in zip(half, areas, strict=True)]
    return slices(0, float(half[0]), rounding, areas[0]), np.diag(moments)


def _slice_of_box(sizes: Values) -> Polynomial:
    """A(s) of a segment or a rectangle of these sizes, grown by s (Steiner's formula)."""
    if len(sizes) == 1:
        return Polynomial([sizes[0], 2.0])
    return Polynomial([sizes[0] * sizes[1], 2 * sizes.sum(), pi])
