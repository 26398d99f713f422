"""Contact of a body with solids, obstacles whose surface is read from a file: a term of the balance
(docs/theory.md#contact).

As that of a body with itself (self_contact): the split surface lies on rank 0, which finds what touches and hands
forces and stiffness down to the nodes. The points of a solid are no unknowns; they are where its way says at the end of
a step.

Whether a body may be near any solid at all: boxes around its nodes on all ranks, and around solids on their ways.

First guesses that have passed through no solid: what would is stopped before it, and taken along from there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..mechanics.extra_couplings import StiffCoupling
from ..mechanics.term import TimeLevel
from ..mechanics.term_protocols import SurfaceData
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from ..mesh.split_surface.surface_map import SurfaceMap
from ..meshes.text import AXES
from .drawing import ObstacleTessellations
from .ipc_pairs import KEPT, max_length
from .ipc_surface import SelfContactLaw
from .mesh_obstacles import AllMeshPairs, MeshContactSurface, MeshFriction, MeshObstacle, MeshObstaclePairs
from .obstacle import RigidObstacle
from .pose import Pose, PosedShape
from .self_contact import SelfContact
from .triangle_mesh_shape import TriangleMeshShape, refine_triangles

Values = npt.NDArray[np.float64]
ARMS = 2.0  # longest edges at rest: how far points of walls may be from the nodes that they follow
ROUNDS = 5  # in which points that follow several nodes are brought back
PIECES = 50  # of a way, each of an edge's length
WEIGHT = 1e-3  # of points that are stopped, from which on a node is brought back with them
Ints = npt.NDArray[np.int64]


class ProximityTest:
    """Boxes; nothing is gathered."""

    def __init__(self, domain: Domain, obstacles: Sequence[RigidObstacle], distance: float) -> None:
        """`distance`: of the barrier, m (collective)."""
        corners = domain.nodes[domain.cell_nodes]
        longest = float(np.ptp(corners, axis=1).max(initial=0.0)) * np.sqrt(domain.dim)
        self._reach = distance + ARMS * float(domain.comm.allreduce(longest, op=MPI.MAX))
        self._comm, self._X = domain.comm, domain.nodes[: domain.node_count]
        self._own = [_BoundingBox(each.shape.tessellate()[0]) for each in obstacles]

    def is_far(self, bodies: Sequence[Values], ways: Sequence[tuple[Pose, Pose]]) -> bool:
        """Whether nothing of a body with the owned displacements `bodies`, or between them, can be within the barrier
        of a solid between the two poses of its way (collective)."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for u in bodies:
            x = self._X + u.reshape(-1, 3)
            low, high = np.minimum(low, x.min(axis=0, initial=np.inf)), np.maximum(high, x.max(axis=0, initial=-np.inf))
        ends = np.concatenate([low, -high])
        self._comm.Allreduce(MPI.IN_PLACE, ends, MPI.MIN)
        low, high = ends[:3] - self._reach, -ends[3:] + self._reach
        return not any(
            np.all(low < above) and np.all(high > below)
            for below, above in (own.swept(*way) for own, way in zip(self._own, ways, strict=True))
        )


class _BoundingBox:
    """Of a solid's points (m, 3) in its own frame, m."""

    def __init__(self, points: Values) -> None:
        self._low, self._high = points.min(axis=0), points.max(axis=0)
        self._reach = float(np.linalg.norm(points, axis=1).max())

    def swept(self, start: Pose, end: Pose) -> tuple[Values, Values]:
        """(3,) corners of a box around it on its way, m; of one that is turned around a ball about its reference."""
        turned = not all(np.array_equal(each.rotation, np.eye(3)) for each in (start, end))
        low, high = (-self._reach, self._reach) if turned else (self._low, self._high)
        return np.minimum(start.centre, end.centre) + low, np.maximum(start.centre, end.centre) + high


def stop_before_meshes(
    front: MeshContactSurface, pairs: AllMeshPairs, start: Values, end: Values, before: Sequence[Pose]
) -> Values:
    """(nodes, 3) displacements at the `end` of a step, m, with points stopped where they would pass into a solid of
    `pairs`; at the `start` solids were at poses `before`; they are where they will be. The same array where none
    would."""
    at = front.point_map
    x = at(start)
    for _ in range(ROUNDS):
        to = at(end)
        if pairs.moving_free_fraction(x, to, before) == 1:
            return end
        back = np.sum([motion_corrections(*each, x, to) for each in zip(pairs.pairs, before, strict=True)], axis=0)
        if not back.any():
            return end
        end = end + _of_nodes(abs(at.weights).T, back)
    return end


def _of_nodes(weights: csr_matrix, back: Values) -> Values:
    """(nodes, 3) means of what is `back` (n, 3) over the points that are stopped, by `weights` (nodes, n) >= 0."""
    weight = weights @ back.any(axis=1).astype(float)
    taken = weight > WEIGHT
    return np.where(taken[:, None], (weights @ back) / np.where(taken, weight, 1.0)[:, None], 0.0)


def motion_corrections(facing: MeshObstaclePairs, before: Pose, x: Values, to: Values) -> Values:
    """(n, 3) what the ways of points from x to `to` lack of safe ones, m: seen from the solid a point stops where it
    comes as near to it as a tenth of its distance; piece by piece, each point on its own."""
    way = to - facing.mesh.pose.points_to_space(before.to_body(x))  # seen from the solid
    edge = facing.mean_edge_length
    count = min(max(1, int(np.ceil(max_length(way) / edge))), PIECES)
    now, there = to - way, to - way  # beside the solid where it is now
    going = np.ones(len(x), bool)
    for piece in range(count):
        step = to - way * (1 - (piece + 1) / count) - there
        length = np.linalg.norm(step, axis=1)
        safe = (1 - KEPT) * facing.safe_distances(now, min(1.01 * max_length(step) / (1 - KEPT), 2 * edge))
        going &= length <= safe
        now = now + np.where(going[:, None], step, 0.0)
        there = there + step
    return np.where(going[:, None], 0.0, now - to)


class MeshObstacleTerm(SelfContact):
    """Solids that the body cannot pass through.

    Attributes:
        obstacles: held or driven, their shapes solids.    law: how they act, but for friction, which each has its own.
    """

    name = "solids"
    _surface: MeshContactSurface | None
    _friction: MeshFriction | None  # type: ignore[assignment]

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: dict[int, RigidObstacle], law: SelfContactLaw
    ) -> None:
        """`obstacles`: by their number in the study. InputError where one overlaps the body at rest (collective)."""
        self.obstacles, edge = tuple(obstacles.values()), domain.mean_edge_length
        self._drawings = ObstacleTessellations(self.obstacles, domain.lower, domain.upper)
        self._meshes = on_root(domain.comm, lambda: [_standing(*each, edge) for each in obstacles.items()]) or []
        self._start_poses = [each.posed_at(0.0).pose for each in self.obstacles]
        self._increments: list[Values] = [np.zeros(6) for _ in self.obstacles]  # (6,) of each in the step
        self._place_meshes(1.0)
        self._end, self._dt = -np.inf, 0.0
        self._proximity = ProximityTest(domain, self.obstacles, law.distance)
        self._started_near = True
        self._far: bool | None = None  # of the current u; None: not known yet
        self._obstacle_work, self._friction_loss = [0.0] * len(obstacles), 0.0
        self._force_readings: list[Values] | None = None  # forces on each, N; None: not yet
        super().__init__(domain, u, law)

    @property
    def mean_edge_length(self) -> float:
        """Of the body's mesh in the mean, m."""
        return self._domain.mean_edge_length

    @property
    def barrier_width(self) -> float:
        """Of the barrier, m."""
        return self.law.distance

    def points_only_flags(self) -> list[tuple[RigidObstacle, bool]]:
        """As of other obstacles: points, sides and faces all feel a solid."""
        return [(each, False) for each in self.obstacles]

    # --- where the surface and the solids are ---

    def _rebuild(self) -> None:
        pattern, u = self._gathered_pattern(), self._gathered(self._u.x.array[: self._owned])

        def made() -> MeshContactSurface:
            assert self._skeleton is not None and pattern is not None and u is not None
            return MeshContactSurface(self._skeleton, pattern, self._meshes, self.law, u, self._surface)

        self._surface = on_root(self.comm, made)
        self._positions = self._start_positions = self._tangent_positions = self._friction = None
        self._is_stale = True

    def separate_surface(self, at: SurfaceMap, elements: Ints, u: Values, t: float) -> SurfaceMap:
        """Drawn in as the walls are that touch."""
        assert self._surface is not None
        return at.with_arm_share(np.minimum(self._surface.point_map.share, at.share))

    def posed_obstacles(self, t: float) -> list[PosedShape]:
        """Each solid at time t, s (not collective)."""
        return [each.posed_at(t) for each in self.obstacles]

    def output_surfaces(self, t: float) -> dict[str, SurfaceData]:
        """Each solid at time t, s, by its name."""
        return self._drawings(self.posed_obstacles(t))

    def _place_meshes(self, gone: float) -> None:
        """Solids have gone this share of their way in the step."""
        self._travelled, self._is_stale = gone, True
        self._poses = [self._pose_after(number, gone) for number in range(len(self.obstacles))]
        for each, pose in zip(self._meshes, self._poses, strict=False):  # they are on rank 0 alone
            each.move_to(pose)

    def _pose_after(self, number: int, gone: float) -> Pose:
        """Where a solid is after that share of its way."""
        return self._start_poses[number].incremented(gone * self._increments[number])

    def _step_poses(self) -> list[tuple[Pose, Pose]]:
        """Poses of each solid at the start of the step, and where it is at its end."""
        ends = [self._pose_after(number, 1.0) for number in range(len(self.obstacles))]
        return list(zip(self._start_poses, ends, strict=True))

    def _is_far(self) -> bool:
        """Whether nothing can touch at the current u, nor could as the step began: nothing rubs then (collective)."""
        if self._far is None:
            at_end = self._level.displacement_at_end(self._u.x.array[: self._owned])
            self._far = not self._started_near and self._proximity.is_far([self._level.u_n, at_end], self._step_poses())
        return self._far

    def update_displacement(self) -> None:
        """What touches has to be found anew."""
        super().update_displacement()
        self._far = None

    # --- what it adds to the balance: nothing, and nothing is gathered, where it is far ---

    def contact_forces(self) -> Values | None:  # type: ignore[override]
        """(owned dofs,) forces at the end of the step, N (collective)."""
        return None if self._is_far() else super().contact_forces()

    def reference_forces(self) -> Values | None:  # type: ignore[override]
        """(owned dofs,) the same as they enter r, N (collective)."""
        return None if self._is_far() else super().reference_forces()

    def coupling_matrix(self) -> PETSc.Mat | StiffCoupling | None:
        """Minus the derivative of the forces, where anything is in touch; as of SelfContact (collective)."""
        return None if self._is_far() else super().coupling_matrix()

    def stored_energy(self) -> float:
        """Energy of the barrier at the current u, on rank 0, J (collective)."""
        return 0.0 if self._is_far() else super().stored_energy()

    def stiffen_contact(self) -> float:
        """As of SelfContact (collective)."""
        return 0.0 if self._is_far() else super().stiffen_contact()

    def potential(self) -> float:
        """Barrier and friction as they enter that of r, on rank 0, J (collective)."""
        return 0.0 if self._is_far() else super().potential()

    # --- a step ---

    def begin_step(self, level: TimeLevel) -> None:
        """Solids go to where they are at the end of the step; friction holds what is in touch at its start."""
        self._level, self._is_stale, self._far, self._attempts = level, True, None, 0
        end = level.t + (1 - level.fraction) * level.dt
        if not level.dt and abs(end - self._end) <= 1e-9 * self._dt:
            return  # a look at what a step has ended with: friction and places are still those of the step
        self._end, self._dt, self._start_velocity = end, level.dt, level.v_n
        self._friction = self._tangent_positions = None
        self._place_obstacles(end - level.dt, end)
        self._started_near, self._start_positions = not self._proximity.is_far([level.u_n], self._step_poses()), None
        none: Values = np.zeros((1, 3))
        self._start_gradients = [none for _ in self.obstacles]
        if level.dt and self._started_near:
            nodal, creep = (
                self._gathered(level.u_n),
                max(self.law.sticking_speed, self.law.sticking_speed_ratio * self._speed(level.v_n)),
            )
            if self._surface is not None and nodal is not None:
                self._place_meshes(0.0)
                self._begin_on_root(self._surface, nodal, creep * level.dt)
        self._place_meshes(1.0)

    def _place_obstacles(self, start: float, end: float) -> None:
        """Where solids are at the ends of a step, s."""
        self._start_poses = [each.posed_at(start).pose for each in self.obstacles]
        self._increments = [each.pose_increment(start, end) for each in self.obstacles]

    def _begin_on_root(self, front: MeshContactSurface, nodal: Values, slip: float) -> None:
        """A step begins at displacements (nodes, 3), m, on rank 0; `slip`: that passes for sticking, m."""
        front.extend_faces(nodal)
        self._start_positions = x = front.point_map(nodal)
        self._start_gradients = [each.full_gradient(x)[len(x) :] for each in front.pairs.pairs]
        if any(each.friction for each in self._meshes):
            self._friction = front.pairs.lag_friction(x, slip)

    def accept_step(self) -> None:
        """What contact has done in the step is booked (collective)."""
        self._friction_loss, self._obstacle_work = 0.0, [0.0] * len(self.obstacles)
        read: list[Values] = [np.zeros(3) for _ in self.obstacles]
        self._force_readings = read
        if not self._is_far() and (x := self._end_positions()) is not None and self._surface is not None:
            self._record_work(x, self._surface, read)

    def _record_work(self, x: Values, front: MeshContactSurface, read: list[Values]) -> None:
        """The same on rank 0, with the body's points at x (n, 3), m; forces on each solid go into `read`, N."""
        end, pushed, n = self._level.contact_weights.end_work_share, self._start_gradients, len(x)
        for k, (each, start) in enumerate(zip(front.pairs.pairs, self._start_poses, strict=True)):
            normal, under = each.full_gradient(x)[n:], 0.0  # of the solid on the body, at the places where it does
            read[k] -= normal.sum(axis=0)
            moved = each.mesh.positions - each.mesh.positions_at(start)
            if self._friction is not None and self._start_positions is not None:
                friction = self._friction.full_gradient(each, x)
                under = float(np.vdot(friction[n:], moved))
                self._friction_loss += under + float(np.vdot(friction[:n], x - self._start_positions))
                read[k] -= friction[n:].sum(axis=0)
            self._obstacle_work[k] = float(np.vdot(end * normal + (1 - end) * pushed[k], moved)) + under

    def step_work(self) -> tuple[float, float]:
        """Work of the solids' own motion in the step, and what friction takes, on rank 0, J."""
        return sum(self._obstacle_work), self._friction_loss

    def damping_forces(self) -> None:
        """Friction is booked step by step: `driven`."""

    # --- how far Newton's method may go ---

    def max_step_fraction(self, change: Values) -> float:
        """Share of a change of u on the way of which nothing meets (collective)."""
        u, level = self._u.x.array[: self._owned], self._level
        ends = [level.displacement_at_end(u), level.displacement_at_end(u + change)]
        return 1.0 if self._proximity.is_far(ends, self._step_poses()) else super().max_step_fraction(change)

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u that has passed through nothing on its way from the start (collective)."""
        level = self._level
        if not level.dt or self._proximity.is_far([level.u_n, level.displacement_at_end(u)], self._step_poses()):
            return u
        start, end = self._gathered(level.u_n), self._gathered(level.displacement_at_end(u))

        def found() -> Values | None:
            assert self._surface is not None and start is not None and end is not None
            led = self._first_guess(self._surface, start, end)
            return None if led is end else led - end

        aside = on_root(self.comm, found)
        if not self.comm.bcast(aside is not None):
            return u
        by = np.asarray(self._gather.scatter(aside)).reshape(-1)
        return np.asarray(u + level.fraction * (self._domain.with_straight_edges(by) if self.law.corners_only else by))

    def _first_guess(self, front: MeshContactSurface, start: Values, end: Values) -> Values:
        """(nodes, 3) where the body gets to on its way from the `start` to the `end` of the step, on rank 0."""
        return stop_before_meshes(front, front.pairs, start, end, self._start_poses)

    def is_feasible(self, u: Values) -> bool:
        """Whether nothing is passed on the straight way from the start to u (collective)."""
        if self._proximity.is_far([self._level.u_n, self._level.displacement_at_end(u)], self._step_poses()):
            return True
        start, end = self._gathered(self._level.u_n), self._gathered(self._level.displacement_at_end(u))

        def found() -> bool:
            assert self._surface is not None and start is not None and end is not None
            at, pairs = self._surface.point_map, self._surface.pairs
            return pairs.moving_free_fraction(at(start), at(end), self._start_poses) == 1

        return from_root(self.comm, found)

    def restrict_motion(self) -> None:
        """Solids wait where the step began (collective)."""
        self._place_meshes(0.0)
        self._advance(self._level.u_n)

    def remaining_motion(self) -> float:
        """The share of the solids' way that is left."""
        return 1.0 - self._travelled

    def continue_motion(self) -> None:
        """The rest of the way, or as far as the body where it is now lets them (collective)."""
        if self.remaining_motion():
            self._advance(self._level.displacement_at_end(self._u.x.array[: self._owned]))

    def _advance(self, u: Values) -> None:
        """As far on their way as the body at the owned displacements u lets solids go (collective)."""
        nodal, gone = self._gathered(u), self._travelled

        def found() -> float:
            assert self._surface is not None and nodal is not None
            x, before = self._surface.point_map(nodal), [each.pose for each in self._meshes]
            self._place_meshes(1.0)
            return self._surface.pairs.moving_free_fraction(x, x, before)

        share = from_root(self.comm, found)
        self._place_meshes(1.0 if share == 1 else gone + share * (1.0 - gone))

    # --- columns of history.csv, and what the end of a run tells ---

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """contact_NAME_AXIS: (1,) force of the body on each solid in the last step, on rank 0, N."""
        return {
            f"contact_{each.name}_{axis}": partial(self._force_reading, number, place)
            for number, each in enumerate(self.obstacles)
            for place, axis in enumerate(AXES)
        }

    def _force_reading(self, number: int, axis: int) -> Values:
        if self._force_readings is None:
            x, front = self._end_positions(), self._surface
            force = (
                np.zeros(3) if x is None or front is None else front.pairs.pairs[number].body_gradient(x).sum(axis=0)
            )
        else:
            force = self._force_readings[number]
        return np.asarray(force[axis : axis + 1])

    def minimum_columns(self) -> dict[str, Callable[[], float]]:
        """gap_NAME: least distance between each solid and the body, m (on rank 0; infinite elsewhere)."""
        return {f"gap_{each.name}": partial(self._gap, number) for number, each in enumerate(self.obstacles)}

    def _gap(self, number: int) -> float:
        x = self._end_positions()
        return np.inf if x is None or self._surface is None else self._surface.pairs.pairs[number].gap(x)

    def work_columns(self) -> dict[str, Callable[[], float]]:
        """work_NAME: what each solid has done on the body in the step that has ended, J."""
        return {f"work_{each.name}": partial(self._work, k) for k, each in enumerate(self.obstacles)}

    def _work(self, number: int) -> float:
        return self._obstacle_work[number]

    def closing_distances(self) -> list[float]:
        """How far each solid and the points that it pushes would have come closer in the step, had nothing stopped
        them, m, on rank 0 (collective)."""
        if self._is_far():
            return [0.0] * len(self.obstacles)
        x, v = self._end_positions(), self._gathered(self._start_velocity)
        if x is None or v is None or self._surface is None:
            return [0.0] * len(self.obstacles)
        moved, result = self._dt * (self._surface.point_map.weights @ v), []
        for each, start in zip(self._surface.pairs.pairs, self._start_poses, strict=True):
            force = -each.body_gradient(x)
            size = np.linalg.norm(force, axis=1)
            on = size > 0
            under = x[on] - start.points_to_space(each.mesh.pose.to_body(x[on]))
            closer = np.einsum("ni,ni->n", under - moved[on], force[on] / size[on, None])
            result.append(float(closer.max(initial=0.0)))
        return result


def _standing(number: int, obstacle: RigidObstacle, edge: float) -> MeshObstacle:
    """A solid where it is at the start, with triangles as small as those of the body (rank 0)."""
    solid = obstacle.shape
    assert isinstance(solid, TriangleMeshShape)
    points, triangles = refine_triangles(solid.points, solid.triangles, edge)
    return MeshObstacle(f"obstacle.{number}: {obstacle.name}", points, triangles, obstacle.friction)
