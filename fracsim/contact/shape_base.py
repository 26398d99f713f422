"""What a shape is, and what filled and hollow bodies have in common.

Directions that a user gives, and frames about them.

Signed distance to the corner q <= 0 of k-dimensional space: what boxes and cylinders are made of.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from .tessellation import Tessellation

Values = npt.NDArray[np.float64]
FILLET = 0.05  # default radius of rounded edges, as a share of the smallest radius or half size


class Shape(Protocol):
    """A shape in its own frame, centred at its reference point; d = 2 or 3, lengths in m."""

    kind: ClassVar[str]  # name in messages

    @property
    def dim(self) -> int:
        """d."""

    @property
    def convex(self) -> bool:
        """Whether the obstacle is convex, and so the distance a convex function."""

    @property
    def rotation_invariant(self) -> bool:
        """Whether no turn about its reference point changes it."""

    @property
    def min_radius(self) -> float:
        """Least radius of curvature of its surface where that is convex, m; infinite where it nowhere is."""

    @property
    def volume(self) -> float:
        """m^3, in 2D m^2; of a hollow body the room inside."""

    def distance(self, x: Values) -> Values:
        """(n,) signed distance of points x (n, d), m: positive outside the obstacle."""

    def normal(self, x: Values) -> Values:
        """(n, d) gradient of the distance, of length 1: it points out of the obstacle."""

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessian of the distance, 1/m."""

    def tessellate(self) -> Tessellation:
        """Points (n, d) and triangles (k, 3), in 2D segments (k, 2), that face where `normal` points."""

    def inertia(self, density: float) -> Values:
        """(3, 3) about the centre, kg m^2 for kg/m^3; in 2D () the polar moment for a mass per area."""


@dataclass(frozen=True, kw_only=True)
class ConvexBody(ABC):
    """A convex body; `hollow`: the obstacle is all that is outside it, as for what lies in a bowl or a container."""

    kind: ClassVar[str]
    hollow: bool = False

    @property
    @abstractmethod
    def dim(self) -> int:
        """2 or 3."""

    @property
    def convex(self) -> bool:
        """Unless it is hollow."""
        return not self.hollow

    def distance(self, x: Values) -> Values:
        """(n,) signed distance of points x (n, d), m."""
        return self._sign * self._distance(x)

    def normal(self, x: Values) -> Values:
        """(n, d) gradient of the distance."""
        return self._sign * self._normal(x)

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessian of the distance, 1/m."""
        return self._sign * self._curvature(x)

    def tessellate(self) -> Tessellation:
        """Closed surface or polygon; that of a hollow body faces inwards."""
        points, elements = self._outline()
        return points, np.ascontiguousarray(elements[:, ::-1]) if self.hollow else elements

    @property
    def rotation_invariant(self) -> bool:
        """A ball alone is."""
        return False

    @property
    def min_radius(self) -> float:
        """Least radius of curvature, m; infinite of a hollow body."""
        return float("inf") if self.hollow else self._radius()

    @property
    def volume(self) -> float:
        """m^3, in 2D m^2, of what is enclosed."""
        return self._moments()[0]

    def inertia(self, density: float) -> Values:
        """rho (tr S 1 - S), S = int x x^T dV (docs/theory.md#rigid-obstacles); in 2D rho tr S."""
        if self.hollow:
            raise InputError(f"a hollow {self.kind} has walls without thickness, so no inertia: hold it")
        S = self._moments()[1]
        return density * (np.trace(S) * np.eye(3) - S if self.dim == 3 else np.asarray(np.trace(S)))

    def inset(self, by: float) -> Self:
        """The body without the outermost `by` m of it, which is no more than `most_inset`; of a hollow one more room:
        distances are more by as much, at rounded edges by no less."""
        return self._resized(-self._sign * by)

    @property
    def max_inset(self) -> float:
        """m; infinite of a hollow body."""
        return float("inf") if self.hollow else self._depth() / 2

    @property
    def _sign(self) -> float:
        return -1.0 if self.hollow else 1.0

    @abstractmethod
    def _resized(self, by: float) -> Self:
        """The same with its surface further out by `by` m, which may be negative."""

    @abstractmethod
    def _depth(self) -> float:
        """The greatest distance of a point inside from the surface, m."""

    @abstractmethod
    def _distance(self, x: Values) -> Values: ...

    @abstractmethod
    def _normal(self, x: Values) -> Values: ...

    @abstractmethod
    def _curvature(self, x: Values) -> Values: ...

    @abstractmethod
    def _radius(self) -> float: ...

    @abstractmethod
    def _outline(self) -> Tessellation: ...

    @abstractmethod
    def _moments(self) -> tuple[float, Values]:
        """Volume and second moments S (d, d) of the filled body."""


def resized_fillet(fillet: float, by: float) -> float:
    """The rounding, m, of edges whose surface is further out by `by` m: never less than half of what it was."""
    return max(fillet + by, fillet / 2)


def require_lengths(shape: Shape, **lengths: float) -> None:
    """InputError unless every length is positive and finite."""
    for word, value in lengths.items():
        if not 0 < value < np.inf:
            name = shape.kind
            raise InputError(f"the {word} of a {name} is {value}: it must be a positive number of metres")


def require_fillet(shape: Shape, rounding: float, most: float) -> None:
    """InputError unless edges have a rounding that fits; a sharp edge has no curvature that Newton could use."""
    require_lengths(shape, rounding=rounding)
    if rounding > most:
        name = shape.kind
        raise InputError(f"the rounding of a {name} is {rounding} m, but at most {most} m fit into it: round it less")


def unit_vector(direction: tuple[float, ...]) -> Values:
    """(d,) the direction, of length 1; InputError where it is none."""
    vector = np.array(direction, float)
    length = float(np.linalg.norm(vector))
    if len(vector) not in (2, 3) or not 0 < length < np.inf:
        raise InputError(f"{direction} is no direction: give 2 or 3 numbers that are not all zero")
    return np.asarray(vector / length)


def frame_about(axis: Values) -> Values:
    """(d, d) a rotation whose last column is the unit vector `axis` (d,)."""
    if len(axis) == 2:
        return np.array([[axis[1], axis[0]], [-axis[0], axis[1]]])
    across = np.cross(np.eye(3)[np.argmin(abs(axis))], axis)
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(axis, across), axis])


class QuadrantDistance:
    """f(q) = |max(q, 0)| outside, max_i q_i inside, for points q (n, k); its gradient and Hessian.

    Offset by the rounding, f - r is exact inside the rounded body as well: a convex body grown by r is nowhere thicker.
    """

    def __init__(self, q: Values) -> None:
        self._q, self._out = q, np.maximum(q, 0)
        self._length = np.linalg.norm(self._out, axis=1)
        # too close to the corner to divide by the length: as if inside
        self._inside = self._length < np.finfo(float).tiny

    @cached_property
    def value(self) -> Values:
        """(n,) f, m."""
        return np.where(self._inside, self._q.max(axis=1), self._length)

    @cached_property
    def gradient(self) -> Values:
        """(n, k) gradient of f, of length 1; inside that of the nearest face."""
        nearest = np.eye(self._q.shape[1])[self._q.argmax(axis=1)]
        return np.where(self._inside[:, None], nearest, self._out / self._divisor[:, None])

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
