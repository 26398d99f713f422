"""Rigid obstacles: held or driven, and free ones with a mass; their motion, overlaps, and tessellation for output."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ..array_types import Values
from ..errors import InputError
from ..mechanics.time_functions import TimeFunction
from ..meshes.data import AXES
from .pose import (
    Pose,
    PosedShape,
    point_jacobian,
    rotation_derivative,
    rotation_second_derivative,
    solve_matrix,
)
from .shape_base import Shape, frame_about, unit_vector
from .shapes import HalfSpace
from .triangle_mesh_shape import TriangleMeshShape, penetration_depth, surfaces_intersect


@dataclass(frozen=True)
class OverlapPolicy:
    """Tuned numbers of the search for overlaps.

    Attributes:
        iterations: of the search for the deepest point of an overlap.
        step_ratio: length of each step of that search, in the one before.
        min_overlap: overlap, in sizes of the free obstacle, below which obstacles merely touch.
        tessellation_depth: part of its size by which the tessellation of a shape lies within it at most.
    """

    iterations: int = 60
    step_ratio: float = 0.8
    min_overlap: float = 1e-6
    tessellation_depth: float = 0.02


OVERLAP = OverlapPolicy()


@dataclass(frozen=True, eq=False)
class RigidObstacle:
    """Rigid obstacle without a mass: held, or driven by a function of time.

    Attributes:
        name: of its columns in history.csv.
        shape: shape about its reference point.
        start_point: (d,) reference point at t = 0, m.
        prescribed_displacement: (d,) displacement at a time, m; None: held.
        friction: coefficient of friction with the body.
        spin: (3,) angular velocity about the reference point, rad/s (triangle meshes only); None: no rotation.
    """

    name: str
    shape: Shape
    start_point: Values
    prescribed_displacement: TimeFunction | None = None
    friction: float = 0.0
    spin: Values | None = None
    free: ClassVar[bool] = False  # whether it has a mass and moves by itself

    @cached_property
    def _at_rest(self) -> PosedShape | None:
        """Shape where it stays; None: it moves."""
        moves = self.free or self.spin is not None or self.prescribed_displacement is not None
        return None if moves else PosedShape(self.shape, Pose.at_point(self.start_point))

    def posed_at(self, t: float) -> PosedShape:
        """Shape at its pose at time t, s; the same object where it stays."""
        if self._at_rest is not None:
            return self._at_rest
        pose = Pose.at_point(self.start_point + self.displacement(t))
        if self.spin is not None:
            pose = pose.incremented(np.append(0 * self.start_point, t * self.spin))
        return PosedShape(self.shape, pose)

    def displacement(self, t: float) -> Values:
        """(d,) displacement of the reference point at time t, m."""
        return (
            np.zeros(len(self.start_point)) if self.prescribed_displacement is None else self.prescribed_displacement(t)
        )

    def pose_increment(self, start: float, end: float) -> Values:
        """(p,) increment of its pose from one time to another, s."""
        shift = self.displacement(end) - self.displacement(start)
        return np.concatenate([shift, np.zeros(self._rotations) if self.spin is None else (end - start) * self.spin])

    @cached_property
    def _rotations(self) -> int:
        """Number of rotational degrees of freedom."""
        return 1 if len(self.start_point) == 2 else 3


@dataclass(frozen=True, eq=False, kw_only=True)
class FreeObstacle(RigidObstacle):
    """Rigid obstacle with a mass. Its reference point is its centre of mass, or the hinge that it hangs on.

    Attributes:
        mass: kg (2D: per metre of thickness).
        inertia: (3, 3), in 2D (), about the reference point at the start, kg m^2.
        motion_basis: (p, k) admissible increments of the pose: q = motion_basis @ z, z (k,). The identity if free.
        mass_centre: (d,) centre of mass relative to the reference point, at the start, m.
        gravity: (d,) m/s^2.
        start_rate: (k,) dz/dt at the start, m/s and rad/s.
    """

    mass: float
    inertia: Values
    motion_basis: Values
    mass_centre: Values
    gravity: Values
    start_rate: Values
    free: ClassVar[bool] = True

    @cached_property
    def pose_size(self) -> int:
        """Number p of components of an increment of the pose."""
        return len(self.start_point) + self._rotations

    def mass_matrix(self, rotation: Values) -> Values:
        """(k, k) mass matrix of z at a rotation (d, d), kg and kg m^2.

        A reference point that is not the centre of mass is held: no motion couples the two.
        """
        d, full = len(self.start_point), np.zeros((self.pose_size, self.pose_size))
        full[:d, :d] = self.mass * np.eye(d)
        full[d:, d:] = rotation @ self.inertia @ rotation.T if d == 3 else self.inertia
        return np.asarray(self.motion_basis.T @ full @ self.motion_basis)

    def gravity_potential(self, pose: Pose) -> float:
        """Potential -m g . x of the centre of mass, J."""
        return -self.mass * float(self.gravity @ (pose.centre + pose.rotation @ self.mass_centre))

    def gravity_derivatives(self, pose: Pose) -> tuple[Values, Values]:
        """(p,) and (p, p) derivatives of the potential of gravity by an increment of the pose."""
        d, arm, force = len(self.start_point), pose.rotation @ self.mass_centre, self.mass * self.gravity
        gradient, hessian = np.zeros(self.pose_size), np.zeros((self.pose_size, self.pose_size))
        gradient[:d], gradient[d:] = -force, force @ rotation_derivative(arm[None])[0]
        hessian[d:, d:] = -rotation_second_derivative(force[None], arm[None])[0]
        return gradient, hessian

    def history_values(self, motion: RigidMotion) -> Values:
        """(2 d + 2 r + 1,) position and velocity of the centre of mass, rotation, angular velocity, kinetic energy."""
        pose, d = motion.pose, len(self.start_point)
        rate = np.linalg.solve(self.mass_matrix(pose.rotation), motion.momentum)
        arm, q = pose.rotation @ self.mass_centre, self.motion_basis @ rate
        velocity = q[:d] - rotation_derivative(arm[None])[0] @ q[d:]
        energy = 0.5 * float(motion.momentum @ rate)
        return np.concatenate([pose.centre + arm, velocity, motion.rotation, q[d:], [energy]])

    def start_motion(self) -> RigidMotion:
        """Motion at t = 0, before any contact."""
        pose = Pose.at_point(self.start_point)
        momentum = self.mass_matrix(pose.rotation) @ self.start_rate
        force = -self.motion_basis.T @ self.gravity_derivatives(pose)[0]
        return RigidMotion(pose, momentum, force, np.zeros(self._rotations))


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """State of motion of a free obstacle.

    Attributes:
        pose: its pose.
        momentum: (k,) M dz/dt, kg m/s and kg m^2/s, about the reference point.
        force: (k,) rate of the momentum that second-order schemes carry, N and N m.
        rotation: (r,) in 2D the angle since the start, rad, full turns counted; in 3D the rotation vector.
    """

    pose: Pose
    momentum: Values
    force: Values
    rotation: Values = field(default_factory=lambda: np.zeros(1))

    def to_array(self) -> Values:
        """All its numbers in one row."""
        return np.concatenate(
            [self.pose.centre, self.pose.rotation.reshape(-1), self.momentum, self.force, self.rotation]
        )

    def from_array(self, numbers: Values) -> RigidMotion:
        """State of motion of the same obstacle with the numbers of `to_array`."""
        d, k, r = self.pose.dim, len(self.momentum), len(self.rotation)
        centre, R, momentum, force, rotation, _ = np.split(numbers, np.cumsum([d, d * d, k, k, r]))
        return RigidMotion(Pose(centre, R.reshape(d, d)), momentum, force, rotation)


def column_names(body: FreeObstacle) -> list[str]:
    """Names of the numbers that `history_values` returns."""
    d = len(body.start_point)
    axes, rotation_axes = AXES[:d], AXES[2:] if d == 2 else AXES
    kinds = [("position", axes), ("velocity", axes), ("turn", rotation_axes), ("spin", rotation_axes)]
    return [*[f"{kind}_{body.name}_{axis}" for kind, names in kinds for axis in names], f"kinetic_{body.name}"]


# --- free obstacles in explicit steps ---


class VerletObstacle:
    """Free obstacle in explicit steps: velocity Verlet of its momentum.

        p_{n+1/2} = p_n + dt/2 f_n,    z = dt M^-1 p_{n+1/2},    p_{n+1} = p_{n+1/2} + dt/2 f_{n+1}

    p is the momentum of z, M the mass matrix at the middle of the step. Forces and moments are those on the points
    themselves: body and obstacle exchange momentum to round-off, in steps of any size.

    Attributes:
        body: the obstacle.
        motion: its state of motion at the start of a step, until that is accepted.
        gravity_work: work of gravity in the last step, J.
        increment: (p,) increment of the pose in the step.
    """

    gravity_work: float = 0.0
    increment: Values

    def __init__(self, body: FreeObstacle) -> None:
        self.body, self.motion = body, body.start_motion()

    def begin_step(self, dt: float) -> PosedShape:
        """Begin a step of dt, s; returns the obstacle at the pose of its end."""
        start, basis = self.motion.pose, self.body.motion_basis
        self._dt, self._half_momentum = dt, self.motion.momentum + dt / 2 * self.motion.force
        half = dt / 2 * solve_matrix(self.body.mass_matrix(start.rotation), self._half_momentum)
        mass = self.body.mass_matrix(start.incremented(basis @ half).rotation)
        self.increment = np.asarray(basis @ (dt * solve_matrix(mass, self._half_momentum)))
        return PosedShape(self.body.shape, start.incremented(self.increment))

    def end_step(self, posed: PosedShape, wrench: Values) -> float:
        """Accept the step; returns the work of contact on the obstacle, J.

        Args:
            posed: obstacle at the end.
            wrench: (p,) force and moment of the body on it there, N and N m.
        """
        start, body, pose = self.motion, self.body, posed.pose
        force = body.motion_basis.T @ (wrench - body.gravity_derivatives(pose)[0])
        rotation = pose.rotation_vector() if pose.dim == 3 else start.rotation + self.increment[2:]
        self.motion = RigidMotion(pose, self._half_momentum + self._dt / 2 * force, force, rotation)
        self.gravity_work = body.gravity_potential(start.pose) - body.gravity_potential(pose)
        change = float(body.history_values(self.motion)[-1] - body.history_values(start)[-1])
        return change - self.gravity_work

    def spring_stiffness(self, x: Values, k: Values, posed: PosedShape) -> Values:
        """(k, k) stiffness by z of springs k (n,), N/m, in any direction at positions x (n, d), m."""
        J = point_jacobian(x - posed.pose.centre) @ self.body.motion_basis
        return np.asarray(np.einsum("n,nip,niq->pq", k, J, J))

    def max_frequency(self, stiffness: Values, posed: PosedShape) -> float:
        """Square of the highest frequency on springs of a stiffness (k, k), with the body at rest, 1/s^2."""
        mass = self.body.mass_matrix(posed.pose.rotation)
        return float(np.linalg.eigvals(solve_matrix(mass, stiffness)).real.max(initial=0.0))


# --- overlaps ---


def free_pairs(are_free: Sequence[bool]) -> list[tuple[int, int]]:
    """Numbers of a free obstacle and another one, each pair once."""
    free_first = [(a, b) if are_free[a] else (b, a) for a, b in combinations(range(len(are_free)), 2)]
    return [(a, b) for a, b in free_first if are_free[a]]


def find_overlaps(
    posed: Sequence[PosedShape], pairs: Sequence[tuple[int, int]], min_overlap: float = OVERLAP.min_overlap
) -> Iterator[tuple[int, int, float]]:
    """Pairs that overlap, and how deep, m; `min_overlap`: in sizes of the first shape."""
    for a, b in pairs:
        size = float(np.ptp(posed[a].shape.tessellate()[0], axis=0).max())
        if (depth := overlap_depth(posed[a], posed[b])) > min_overlap * size:
            yield a, b, depth


def overlap_depth(body: PosedShape, second: PosedShape) -> float:
    """Depth of an overlap, m: minus the minimum of the distance to `second` over a convex body; negative if apart.

    Steepest descent from the points of its tessellation by ever shorter steps, each projected back onto the body. Of
    triangle meshes it is the depth of the deepest point; minus infinity where no point is inside.
    """
    if any(isinstance(posed.shape, TriangleMeshShape) for posed in (body, second)):
        return _mesh_overlap_depth(body, second)
    x = body.pose.points_to_space(body.shape.tessellate()[0])
    step, minimum = float(np.linalg.norm(np.ptp(x, axis=0))), second.distance(x)
    for _ in range(OVERLAP.iterations):
        x = x - step * second.normal(x)
        x = x - np.maximum(body.distance(x), 0.0)[:, None] * body.normal(x)
        minimum, step = np.minimum(minimum, second.distance(x)), OVERLAP.step_ratio * step
    return -float(minimum.min())


def _mesh_overlap_depth(first: PosedShape, second: PosedShape) -> float:
    """Depth of the deepest point of either shape in the other, m, one at least a triangle mesh; -inf if none is."""
    tessellations = [(posed.pose.points_to_space(posed.shape.tessellate()[0]), posed) for posed in (first, second)]
    analytic = [posed for posed in (first, second) if not isinstance(posed.shape, TriangleMeshShape)]
    if analytic:
        return -min(float(analytic[0].distance(x).min()) for x, posed in tessellations if posed is not analytic[0])
    surfaces = [(x, posed.shape.tessellate()[1].astype(np.int64)) for x, posed in tessellations]
    depth = penetration_depth(surfaces[0], surfaces[1], cut=surfaces_intersect(surfaces[0], surfaces[1]))
    return -np.inf if depth is None else depth


def check_free_obstacles(
    obstacles: Mapping[int, tuple[str, bool, PosedShape]], min_overlap: float = OVERLAP.min_overlap
) -> None:
    """Raise InputError where a free obstacle overlaps another one at the start.

    Args:
        obstacles: names of analytic obstacles, whether they are free, and their shapes at the start, by their numbers.
        min_overlap: in sizes of the free one, from which on it counts; a negative one: they may not touch either.
    """
    numbers, posed = list(obstacles), [shape for _, _, shape in obstacles.values()]
    pairs = free_pairs([is_free for _, is_free, _ in obstacles.values()])
    x = {a: posed[a].pose.points_to_space(posed[a].shape.tessellate()[0]) for a, _ in pairs}
    margin = {a: OVERLAP.tessellation_depth * float(np.ptp(points, axis=0).max()) for a, points in x.items()}
    near = [(a, b) for a, b in pairs if not posed[b].distance_bound(x[a]) > margin[a]]
    for a, b, depth in find_overlaps(posed, near, min_overlap):
        raise InputError(
            f"obstacle.{numbers[a]}: {obstacles[numbers[a]][0]} moves freely and overlaps {obstacles[numbers[b]][0]} "
            f"at the start, by {max(0.0, depth):.4g} m; move it away or make it smaller"
        )


# --- tessellation for output ---


@dataclass(frozen=True)
class SlabPolicy:
    """Slab that stands for a half space in output.

    Attributes:
        patch_size: its edge, in diagonals of the body's bounding box.
        thickness: in its edge, so that it is seen from the side.
    """

    patch_size: float = 2.0
    thickness: float = 0.01


SLAB = SlabPolicy()


type ObstacleTessellation = tuple[Values, npt.NDArray[np.int32], npt.NDArray[np.int32]]


def tessellate_obstacle(posed: PosedShape, lower: Values, upper: Values) -> ObstacleTessellation:
    """Points (n, d), m, in the frame of a shape, triangles (k, 3) and, in 2D, segments (m, 2) around them.

    Of a half space it is a slab near the body.

    Args:
        posed: the shape at the start.
        lower: (d,) lower corner of the body's bounding box then, m.
        upper: (d,) upper corner.
    """
    if isinstance(posed.shape, HalfSpace):
        middle = posed.pose.to_body((lower + upper)[None] / 2)[0]
        side = SLAB.patch_size * float(np.linalg.norm(upper - lower))
        points, elements = slab(unit_vector(posed.shape.direction), middle, side)
    else:
        points, elements = posed.shape.tessellate()
    if posed.shape.dim == 2:
        return points, _fan(posed.shape, len(points)), elements
    return points, elements, np.empty((0, 2), np.int32)


def slab(normal: Values, middle: Values, side: float) -> tuple[Values, npt.NDArray[np.int32]]:
    """Tessellation of a slab behind the plane n . x = 0.

    Args:
        normal: (d,) n.
        middle: (d,) point over the middle of the slab, m.
        side: edge of the slab, m.
    """
    d = len(normal)
    ranges = [*[[-0.5, 0.5]] * (d - 1), [-SLAB.thickness, 0.0]]
    corners = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, d)
    foot = middle - (middle @ normal) * normal
    points = foot + side * corners @ frame_about(normal).T
    if d == 2:
        order = np.array([0, 2, 3, 1])  # counterclockwise
        return points[order], np.array([[0, 1], [1, 2], [2, 3], [3, 0]], np.int32)
    # the number of a corner is the sum of these for its upper coordinates
    x, y, z = 4, 2, 1
    squares = [[0, y, x + y, x], [z, x + z, x + y + z, y + z], [0, x, x + z, z], [y, y + z, x + y + z, x + y],
               [0, z, y + z, y], [x, x + y, x + y + z, x + z]]  # fmt: skip
    a, b, c, e = np.array(squares, np.int32).T
    return points, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, e])])


def _fan(shape: Shape, count: int) -> npt.NDArray[np.int32]:
    """(k, 3) fan of triangles over a convex polygon of `count` points; empty for a hollow shape."""
    if not shape.convex:
        return np.empty((0, 3), np.int32)
    second = np.arange(1, count - 1, dtype=np.int32)
    return np.column_stack([np.zeros_like(second), second, second + 1])
