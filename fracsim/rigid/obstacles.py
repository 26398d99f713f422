"""Obstacles among rigid bodies: fixed or driven ones, and free ones, which move like bodies that do not break.

Bodies are numbered as follows: fragments, free obstacles, parts of prescribed (fixed or driven) obstacles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..contact.obstacle import RigidObstacle
from ..contact.pose import Pose, PosedShape
from ..contact.shape_base import frame_about, unit_vector
from ..contact.shapes import Capsule, HalfSpace, RoundedBox, RoundedCylinder, Shape, Sphere
from ..errors import InputError
from .bodies import Bodies
from .convex_decomposition import Polyhedron, convex_parts, hull_corners

if TYPE_CHECKING:
    from ..contact.obstacle import FreeObstacle
    from .contact_points import ContactImpulses

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


# --- shapes ---


@dataclass(frozen=True)
class PrimitiveShape:
    """Shape of MuJoCo, relative to a reference point.

    Attributes:
        kind: plane, sphere, capsule, cylinder, box or hull.
        size: half sizes and radii as MuJoCo has them, m.
        rotation: (3, 3) from the axes of the kind, whose own axis or normal is z.
        half_size: half the size of the obstacle, m; infinite for a plane.
        corners: (n, 3) of a hull, m.
        friction: coefficient of Coulomb's friction of a free obstacle; None: that of its body.
    """

    kind: str
    size: tuple[float, float, float]
    rotation: Values
    half_size: float
    corners: Values | None = None
    friction: float | None = None

    @property
    def extreme_points(self) -> Values:
        """Points (k, 3), m, one of which is as far from the reference point as the shape reaches."""
        if self.corners is not None:
            return self.corners
        x, y, z = self.size
        return np.array([[x + y, 0.0, 0.0] if self.kind == "capsule" else [x, y, z]])


@dataclass(frozen=True)
class CollisionShapePolicy:
    """Tuned numbers of the shapes that collide.

    Attributes:
        prism_sides: sides of the prism in a cylinder. Its faces are 3.4 % of the radius below the cylinder.
        max_round_deviation: largest distance of boundary nodes from the surface of a round solid, in radii: round-off,
            also of single precision.
        max_shell_deviation: mean distance of the hull from a closed shell, in thicknesses, up to which it is convex.
    """

    prism_sides: int = 12
    max_round_deviation: float = 1e-6
    max_shell_deviation: float = 0.01


COLLISION_SHAPES = CollisionShapePolicy()


def cylinder_parts(cylinder: PrimitiveShape) -> list[PrimitiveShape]:
    """Return a cylinder and a prism inscribed in it, as the parts of a body that moves.

    MuJoCo finds the line on which a cylinder rolls, and at most four contacts of its rim. The corners of the prism are
    contacts where the cylinder tilts or spins.
    """
    sides = COLLISION_SHAPES.prism_sides
    angle = 2 * np.pi * np.arange(sides) / sides
    radius, half, _ = cylinder.size
    rim = radius * np.stack([np.cos(angle), np.sin(angle)])
    ends = [np.concatenate([rim, np.full((1, sides), z)]) for z in (half, -half)]
    corners = np.ascontiguousarray((cylinder.rotation @ np.concatenate(ends, axis=1)).T)
    return [cylinder, replace(cylinder, kind="hull", corners=corners)]


# Convex part of a body: corners (n, 3) of a hull relative to the centre, in the axes at rest, m, or a shape.
Part = Values | PrimitiveShape


@dataclass(frozen=True)
class PrescribedObstacle:
    """Convex part of an obstacle that is fixed or driven.

    Attributes:
        shape: relative to the reference point.
        position: (3,) of the reference point, m.
        friction: coefficient of Coulomb's friction with bodies.
        driven: whether it ever moves.
    """

    shape: PrimitiveShape
    position: Values
    friction: float = 0.0
    driven: bool = False


def obstacle_parts(shape: Shape, name: str) -> list[PrimitiveShape]:
    """Return the convex parts of the shape of an obstacle; `name` is for error messages.

    Rounded edges are sharp. A shape from a file becomes a union of convex hulls. Raises InputError for other shapes.
    """
    from ..contact.triangle_mesh_shape import TriangleMeshShape

    if not isinstance(shape, TriangleMeshShape):
        return [obstacle_primitive(shape, name)]
    half_size = float(np.ptp(shape.points, axis=0).min()) / 2
    parts = convex_parts(Polyhedron.from_triangles(shape.points, shape.triangles).without_cavities)
    return [PrimitiveShape("hull", (0.0, 0.0, 0.0), np.eye(3), half_size, corners) for corners in parts]


def obstacle_primitive(shape: Shape, name: str) -> PrimitiveShape:
    """Return MuJoCo's shape for that of an obstacle. Raises InputError if there is none."""
    if shape.dim != 3:
        raise InputError(f'{name} has {shape.dim} dimensions: time.scheme = "rigid" is for bodies in space')
    if not shape.convex:
        raise InputError(f'{name} is hollow, which time.scheme = "rigid" does not have: build it of boxes or planes')
    upright = np.eye(3)
    match shape:
        case HalfSpace():
            return PrimitiveShape("plane", (0.0, 0.0, 1.0), frame_about(unit_vector(shape.direction)), np.inf)
        case Sphere():
            return PrimitiveShape("sphere", (shape.radius, 0.0, 0.0), upright, shape.radius)
        case Capsule():
            size = (shape.radius, shape.length / 2, 0.0)
            return PrimitiveShape("capsule", size, frame_about(unit_vector(shape.axis)), shape.radius)
        case RoundedCylinder():
            size = (shape.radius, shape.length / 2, 0.0)
            half_size = min(shape.radius, shape.length / 2)
            return PrimitiveShape("cylinder", size, frame_about(unit_vector(shape.axis)), half_size)
        case RoundedBox():
            x, y, z = (side / 2 for side in shape.size)
            return PrimitiveShape("box", (x, y, z), upright, min(x, y, z))
    raise InputError(f'{name}: time.scheme = "rigid" has no {shape.kind}')


# --- the obstacles of a study ---


class ObstacleSet:
    """Obstacles of a study beside its bodies.

    Attributes:
        obstacles: all of them.
        free_numbers: numbers of those that move freely.
        obstacle_of: (m,) number of the obstacle of each free body, and then of each part of prescribed ones.
        convex_parts: of each free obstacle.
        hull_points: outermost points (k, 3) of each free obstacle, m.
        half_sizes: (m,) m; infinite for planes.
    """

    def __init__(self, obstacles: Sequence[RigidObstacle]) -> None:
        """Divide the obstacles into convex parts."""
        self.obstacles = obstacles
        self.free_numbers = [number for number, obstacle in enumerate(obstacles) if obstacle.free]
        shapes = [obstacle_parts(obstacle.shape, f"obstacle {obstacle.name}") for obstacle in obstacles]
        for number in self.free_numbers:
            if shapes[number][0].kind == "cylinder":
                shapes[number] = cylinder_parts(shapes[number][0])
        self.convex_parts: list[list[Part]] = [
            [replace(part, friction=obstacles[number].friction) for part in shapes[number]]
            for number in self.free_numbers
        ]
        self.hull_points = [_hull_points(shapes[number]) for number in self.free_numbers]
        self._prescribed = [
            (number, part)
            for number, obstacle in enumerate(obstacles) if not obstacle.free
            for part in shapes[number]
        ]  # fmt: skip
        numbers = [*self.free_numbers, *(number for number, _ in self._prescribed)]
        self.obstacle_of: Ints = np.array(numbers, np.int64)
        free_sizes = [shapes[number][0].half_size for number in self.free_numbers]
        self.half_sizes = np.array([*free_sizes, *(part.half_size for _, part in self._prescribed)])
        self.driven = any(obstacle.prescribed_displacement is not None for obstacle in obstacles)

    def free_bodies(self) -> Bodies:
        """Return the free obstacles as bodies at the start."""
        free = [cast("FreeObstacle", self.obstacles[number]) for number in self.free_numbers]
        centre = np.array([obstacle.start_point for obstacle in free]).reshape(-1, 3)
        rate = np.array([obstacle.start_rate for obstacle in free]).reshape(-1, 6)
        inertia = np.array([obstacle.inertia for obstacle in free]).reshape(-1, 3, 3)
        mass, rotation = np.array([obstacle.mass for obstacle in free]), np.tile(np.eye(3), (len(free), 1, 1))
        return Bodies(mass, centre, inertia, centre, rotation, rate[:, :3], rate[:, 3:])

    def prescribed_obstacles(self, t: float) -> list[PrescribedObstacle]:
        """Return the parts of fixed and driven obstacles at a time, s."""
        result = []
        for number, part in self._prescribed:
            obstacle, point = self.obstacles[number], self.reference_point(number, t)
            result.append(
                PrescribedObstacle(part, point, obstacle.friction, obstacle.prescribed_displacement is not None)
            )
        return result

    def reference_points(self, t: float) -> Values | None:
        """Return the reference points (m, 3), m, of prescribed parts at a time, s; None if no obstacle is driven."""
        if not self.driven:
            return None
        return np.array([self.reference_point(number, t) for number, _ in self._prescribed])

    def reference_point(self, number: int, t: float) -> Values:
        """Return the reference point (3,), m, of a prescribed obstacle at a time, s."""
        return np.asarray(self.obstacles[number].start_point + self.obstacles[number].displacement(t), float)

    def displacements(self, t: float, dt: float) -> Values:
        """Return how far prescribed obstacles move (obstacles, 3), m, from a time on, within dt, s."""
        numbers = range(len(self.obstacles))
        moved = [self.reference_point(number, t + dt) - self.reference_point(number, t) for number in numbers]
        return np.array(moved).reshape(-1, 3)

    def forces_and_work(
        self, impulses: ContactImpulses, fragment_count: int, t: float, dt: float
    ) -> tuple[Values, Values]:
        """Return mean forces (obstacles, 3), N, of fragments on obstacles, and the work (obstacles,), J, of obstacles.

        Args:
            impulses: of a step of all bodies.
            fragment_count: number of fragments, which precede the obstacles.
            t: start of the step, s.
            dt: s.
        """
        of_fragments, of_obstacles = np.zeros((2, len(self.obstacles), 3))
        # the second body of a contact receives the impulse, the first one its reaction
        sides = ((impulses.first, impulses.second, -1.0), (impulses.second, impulses.first, 1.0))
        for receiver, partner, sign in sides:
            is_fragment = partner < fragment_count
            for chosen, total in ((is_fragment, of_fragments), (~is_fragment, of_obstacles)):
                rows = (receiver >= fragment_count) & chosen
                owner = self.obstacle_of[receiver[rows] - fragment_count]
                np.add.at(total, owner, sign * impulses.impulse[rows] / dt)
        work = -np.einsum("mi,mi->m", of_fragments + of_obstacles, self.displacements(t, dt))
        return of_fragments, work

    def placed_shapes(self, t: float, bodies: Bodies) -> list[PosedShape]:
        """Return all obstacles at a time, s; the free ones are the last of `bodies`."""
        first = len(bodies) - len(self.free_numbers)
        result = [obstacle.posed_at(t) for obstacle in self.obstacles]
        for body, number in enumerate(self.free_numbers, first):
            result[number] = PosedShape(
                self.obstacles[number].shape, Pose(bodies.position[body], bodies.rotation[body])
            )
        return result

    @property
    def masses(self) -> Values:
        """Masses (m,) of free obstacles and then of the parts of prescribed ones, kg; infinite for the latter."""
        return np.concatenate([self.free_bodies().mass, np.full(len(self._prescribed), np.inf)])

    # --- columns of history.csv ---

    def columns(self) -> list[str]:
        """Return the names of the columns of free obstacles."""
        if not self.free_numbers:
            return []
        from ..contact.obstacle import column_names

        free = [cast("FreeObstacle", self.obstacles[number]) for number in self.free_numbers]
        return [name for obstacle in free for name in column_names(obstacle)]

    def readings(self, bodies: Bodies) -> Values:
        """Return the values of the columns: position, velocity, rotation, spin and kinetic energy of each."""
        free = bodies.select(slice(len(bodies) - len(self.free_numbers), None))
        rotation = Rotation.from_matrix(free.rotation).as_rotvec() if self.free_numbers else free.spin
        values = [free.position, free.velocity, rotation, free.spin, free.kinetic_energies[:, None]]
        return np.concatenate(values, axis=1).ravel()


def _hull_points(parts: Sequence[PrimitiveShape]) -> Values:
    """Return the corners (k, 3), m, that a plane may touch; none of spheres and capsules, which MuJoCo has itself."""
    hulls = [part.corners for part in parts if part.corners is not None]
    return hull_corners(np.concatenate(hulls)) if hulls else np.empty((0, 3))
