"""Contact of triangle-mesh obstacles with the body, a term of the balance, and with one another.

As for contact of a body with itself (self_contact), each rank has its own elements of the split surface, and the pairs
of its points. The points of an obstacle are no unknowns; they are where its motion says at the end of a step. Nothing
is gathered while bounding boxes of body and obstacles are apart. Barrier and lagged friction are those of ipctk.

Equations: docs/theory.md#contact, docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from dolfinx import fem

from ..array_types import Pattern, Values
from ..errors import InputError
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.ghost_exchange import with_straight_edges
from .clearance import Clearance
from .laws import ObstacleLaw
from .mesh_obstacles import MESH, BarrierPart, MeshObstacle, free_fraction_on_arcs
from .node_contact import PoseDerivatives, carried_derivatives
from .obstacle import RigidObstacle
from .obstacle_pairs import Numbers, PairDerivatives, PosedObstacles
from .pair_search import max_length
from .pose import Pose, point_jacobian
from .retractable_surface import SelfContactLaw
from .rigid_obstacles import ObstacleGroup, PoseContact, RigidObstacles
from .sample_points import IpcFriction
from .self_contact import BarrierBodySurface, SurfaceContact, mean_velocities
from .step_limit import PoseMotion, stop_before_meshes
from .triangle_mesh_shape import LIMITS, TriangleMeshShape, refine_triangles


class MeshObstacleTerm(SurfaceContact):
    """Triangle-mesh obstacles that the body cannot penetrate.

    Attributes:
        group: the obstacles, and what they did to the body in the last step.
        clearance: whether the body is far from the obstacles.
        pose_contact: contact as the obstacles see it.
    """

    name = "solids"

    def __init__(
        self, domain: Domain, u: fem.Function, bodies: RigidObstacles, numbers: Sequence[int], law: SelfContactLaw
    ) -> None:
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            bodies: motion of all obstacles.
            numbers: numbers of the triangle meshes.
            law: contact law.

        Raises:
            InputError: if an obstacle overlaps the body at rest.
        """
        self.group = ObstacleGroup(bodies, numbers, law.distance, self._gap, self._current_force)
        # the tangent by points and poses has a positive semi-definite form alone
        self.allows_exact_tangent = not any(obstacle.free for obstacle in self.group.obstacles)
        self._meshes = build_mesh_obstacles(self.group, domain.mean_edge_length)
        self._started_near = True
        self._far: bool | None = None  # at the current u; None: not known yet
        self._place_meshes(self.group.poses)
        super().__init__(domain, u, BarrierBodySurface(domain, u, law, self._meshes))
        self.clearance = Clearance(domain, self._meshes, law.distance, self.surface.following_points)
        self.pose_contact = PoseContact(self)
        self.parts = self.surface, self.group, self.clearance, self.pose_contact

    # --- surface and obstacles ---

    def _place_meshes(self, poses: Sequence[Pose]) -> None:
        """Move the meshes to poses."""
        for mesh, pose in zip(self._meshes, poses, strict=True):
            mesh.move_to(pose)

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        super().edges_broke(pattern)
        self.clearance.discard()

    def poses_moved(self) -> None:
        """Move the meshes to the poses of the obstacles, and discard forces."""
        self._place_meshes(self.group.poses)
        self._far = self._contact_force = self._stored = None

    def is_far(self) -> bool:
        """Whether nothing can be in contact at the current u, nor could at the start of the step (collective)."""
        if self._far is None:
            ends = [self.level.u_n, self.end_displacement]
            self._far = not self._started_near and self.clearance.is_far(ends, self.group.step_motions)
        return self._far

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        super().update_displacement()
        self._far = None

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of the step, and lag friction with the contact at its start."""
        self.group.bodies.begin_step(level)
        self.level, self._is_stale, self._far = level, True, None
        if self.group.bodies.evaluates_result:
            return  # friction is still that of the step
        self._start_velocity = level.v_n
        self.friction, self._tangent_displacement = self._no_friction(), None
        self._started_near = not self.clearance.is_far([level.u_n], self.group.step_motions)
        self.start_positions = None
        # one row that stands for all points of an obstacle
        zero: Values = np.zeros((1, 3))
        self._start_gradients = [zero for _ in self.group.obstacles]
        if level.dt and self._started_near:
            slip = self._sticking_slip(level)
            self._place_meshes(self.group.start_poses)
            self._extend_faces(level.u_n)
            self.start_positions = x = self.surface.positions(level.u_n)
            self._exchange_count = self.surface.exchange_count
            self._start_gradients = [part.full_gradient(x)[len(x) :] for part in self.contacts]
            self.friction = [part.lag_friction(x, slip) for part in self.contacts]
        self._place_meshes(self.group.poses)

    def _sticking_slip(self, level: TimeLevel) -> float:
        """Slip in the step that counts as sticking, m, with the largest speed relative to an obstacle (collective)."""
        square, mean = mean_velocities(self.comm, level.v_n.reshape(-1, self._domain.dim))
        centres = [pose.centre[None] for pose in self.group.start_poses]
        placed = zip(self.group.numbers, centres, strict=True)
        velocities = [self.group.bodies.velocity(number, centre).reshape(-1) for number, centre in placed]
        speed = float(np.sqrt(max(0.0, *(float(square - 2 * mean @ V + V @ V) for V in velocities))))
        return level.dt * self.surface.law.sticking_speed_at(speed)

    def accept_step(self) -> None:
        """Record forces and work of contact in the step (collective)."""
        forces: list[Values] = [np.zeros(3) for _ in self.group.obstacles]
        self.group.friction_loss, self.group.work, self.group.forces = 0.0, [0.0] * len(forces), forces
        if not self.is_far():
            self._record_work(self.end_positions(), forces)

    def _record_work(self, x: Values, forces: list[Values]) -> None:
        """Record work of this rank's pairs with the body at x (n, 3), m, and add forces on obstacles to `forces`, N."""
        end_weight, start_gradients, n = self.level.contact_weights.end_work_share, self._start_gradients, len(x)
        poses = self.group.start_poses
        for number, (part, mesh, start_pose) in enumerate(zip(self.contacts, self._meshes, poses, strict=True)):
            # of the obstacle on the body, at the points of the obstacle
            gradient, friction_work = part.full_gradient(x)[n:], 0.0
            forces[number] -= gradient.sum(axis=0)
            motion = mesh.positions - mesh.positions_at(start_pose)
            if (friction := self.friction[number]) is not None and self.start_positions is not None:
                of_friction = friction.gradient(part.points(x))
                friction_work = float(np.vdot(of_friction[n:], motion))
                self.group.friction_loss += friction_work + float(np.vdot(of_friction[:n], x - self.start_positions))
                forces[number] -= of_friction[n:].sum(axis=0)
            mean_gradient = end_weight * gradient + (1 - end_weight) * start_gradients[number]
            self.group.work[number] = float(np.vdot(mean_gradient, motion)) + friction_work

    # --- step limits ---

    def safe_fraction(self, u: Values, change: Values | None, moving: Mapping[int, PoseMotion]) -> float:
        """Fraction of motions of the body and of obstacles without a collision (collective).

        Args:
            u: (owned dofs,) displacement at the start, m.
            change: (owned dofs,) of it, m; None: the body is at rest.
            moving: motions of obstacles by their indices; others are not looked at.
        """
        motions = self.group.motions(moving)
        if self.clearance.is_far([u] if change is None else [u, u + change], motions):
            return 1.0
        x, fraction = self.surface.positions(u), 1.0
        end = x if change is None else x + self.surface.interpolate(change)
        for index, (posed, _) in moving.items():
            mesh, (_, end_posed) = self._meshes[index], motions[index]
            # contacts take the obstacle from the given pose to where it is
            mesh.move_to(end_posed.pose)
            fraction = min(fraction, self.contacts[index].free_fraction(x, end, posed.pose))
            mesh.move_to(self.group.poses[index])
        return fraction

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess of u, m, that crosses no obstacle on its way from the start (collective)."""
        level = self.level
        if not level.dt:
            return u
        if self.clearance.is_far([level.u_n, level.displacement_at_end(u)], self.group.step_motions):
            return u
        prescribed = [index for index, obstacle in enumerate(self.group.obstacles) if not obstacle.free]
        start_poses = [self.group.start_poses[index] for index in prescribed]
        end, parts = level.displacement_at_end(u), [self.contacts[index] for index in prescribed]
        if (guess := stop_before_meshes(self.surface, parts, level.u_n, end, start_poses)) is end:
            return u
        change: Values = guess - end
        if self.surface.law.corners_only:
            change = with_straight_edges(self._domain, change)
        return np.asarray(u + level.fraction * change)

    def is_feasible(self, u: Values) -> bool:
        """Whether nothing is crossed on the straight way from the start to u (collective)."""
        u_n, u_end = self.level.u_n, self.level.displacement_at_end(u)
        if self.clearance.is_far([u_n, u_end], self.group.step_motions):
            return True
        start, end = self.surface.positions(u_n), self.surface.positions(u_end)
        parts = zip(self.contacts, self.group.start_poses, strict=True)
        return min([part.free_fraction(start, end, pose) for part, pose in parts]) == 1

    # --- contact as the obstacles see it (PoseContact) ---

    def rank_wrench(self, index: int) -> Values:
        """(6,) force and moment on an obstacle, of this rank's pairs, N and N m (collective)."""
        return -self.rank_derivatives(index, exact=False).gradient

    def rank_derivatives(self, index: int, *, exact: bool) -> PoseDerivatives:
        """Energy and derivatives by the pose of an obstacle, of this rank's pairs (collective)."""
        x, part, friction = self.end_positions(), self.contacts[index], self.friction[index]
        # far on this rank; others may be near
        if part.is_far(x) and friction is None:
            return PoseDerivatives.none(6)
        energy = part.energy(x) + (0.0 if friction is None else friction.energy(part.points(x)))
        gradient, mesh = part.full_gradient(x, friction)[len(x) :], slice(x.size, None)
        H = part.full_hessian(x, friction, exact=exact)[mesh, mesh]
        return carried_derivatives(energy, gradient, H, self._meshes[index].arms, exact=exact)

    def rank_mixed_hessian(self, index: int) -> Values:
        """(columns, 18) second derivatives by nodes and the pose of an obstacle, of this rank's pairs (collective)."""
        x, part, point_map = self.end_positions(), self.contacts[index], self.surface.current.point_map
        if part.is_far(x) and self.friction[index] is None:
            return np.zeros((point_map.weights.shape[1], 18))
        H = part.full_hessian(x, self.friction[index])[: x.size, x.size :]
        mixed = H @ point_jacobian(self._meshes[index].arms).reshape(-1, 6)
        return point_map.nodal_forces(mixed.reshape(len(x), -1))

    def assemble_mixed_hessian(self, index: int, part: Values) -> Values:
        """(owned dofs, 6) sums at the nodes of what `rank_mixed_hessian` returned (collective)."""
        columns = part.reshape(-1, 3, 6)
        return np.stack([self.surface.sum_at_nodes(columns[:, :, axis]) for axis in range(6)], axis=1)

    def uses_exact_tangent(self) -> bool:
        """Whether the tangent at the current u may have negative eigenvalues: not with free obstacles."""
        return self.allows_exact_tangent

    # --- readings ---

    def _current_force(self, number: int) -> Values:
        """(3,) force of the body on an obstacle at the current u, of this rank's pairs, N (collective)."""
        return np.asarray(self.contacts[number].gradient(self.end_positions()).sum(axis=0))

    def _gap(self, number: int) -> float:
        """Least distance between an obstacle and the body, m, of this rank's pairs (collective)."""
        if self.is_far():
            return self.clearance.least_gap(number, self.end_displacement, self.group.posed)
        return self.contacts[number].gap(self.end_positions())

    def pushed_points(self) -> list[tuple[Values, Values, Values]]:
        """(n, 3) points of this rank before each obstacle, m, normal forces, N, start velocities, m/s (collective)."""
        x, velocity = self.end_positions(), self.surface.interpolate(self._start_velocity)
        return [(x, -self.surface.current.sum_at_points(part.gradient(x)), velocity) for part in self.contacts]


def build_mesh_obstacles(group: ObstacleGroup, edge: float) -> list[MeshObstacle]:
    """Obstacles of a group at the start, with edges of their triangles of at most `edge`, m, as those of the body.

    Raise InputError for a body too small for an obstacle: its motion would be searched in too many pieces.
    """
    result = []
    for number, obstacle in zip(group.numbers, group.obstacles, strict=True):
        shape = obstacle.shape
        assert isinstance(shape, TriangleMeshShape)
        points, triangles = refine_triangles(shape.points, shape.triangles, edge)
        longest = max_length((points[triangles] - points[np.roll(triangles, 1, axis=1)]).reshape(-1, 3))
        if longest > LIMITS.max_edge_ratio * edge:
            raise InputError(
                f"obstacle.{number}, {obstacle.name}: edges of the body are {edge:.3g} m long, those of the obstacle "
                f"{longest:.3g} m after refinement; their ratio may be {LIMITS.max_edge_ratio:g} at most; if the files "
                "have different units, change mesh.scale or the obstacle's scale"
            )
        name, rotates = f"obstacle.{number}: {obstacle.name}", obstacle.free or obstacle.spin is not None
        result.append(MeshObstacle(name, points, triangles, obstacle.friction, rotates=rotates))
    return result


# --- two triangle meshes ---


class MeshPair:
    """A pair of triangle-mesh obstacles, as obstacle_pairs.BarrierPair."""

    def __init__(
        self, numbers: Numbers, obstacles: Mapping[int, RigidObstacle], law: ObstacleLaw, stiffness: float
    ) -> None:
        """`obstacles`: by their numbers; `law`: distance and friction; `stiffness`: of the barrier, Pa."""
        self.numbers, self._law = numbers, law
        first, second = (obstacles[number] for number in numbers)
        friction = max(first.friction, second.friction)
        self._first, self._second = (MeshObstacle.of(obstacle, friction) for obstacle in (first, second))

        def build(distance: float) -> BarrierPart:
            mesh = self._first
            return BarrierPart.build(
                mesh.points, mesh.triangles, self._second, distance=distance, stiffness=stiffness, edge=mesh.edge
            )

        self._part = build(law.barrier.width)
        self._start = self._first.positions_at(first.posed_at(0.0).pose)  # (n, 3) of the first at the step's start, m
        self._start_pose = second.posed_at(0.0).pose  # of the second then
        if (gap := self._part.pairs.min_gap(self._part.points(self._start, self._start_pose))) < law.barrier.width:
            self._part = build(MESH.gap_share * gap)
        self._friction: IpcFriction | None = None

    def _near_positions(self, posed: PosedObstacles) -> Values | None:
        """(n, 3) points of the first, m, with the second at its pose; None: far, now and at the start of the step."""
        first, second = (posed[number].pose for number in self.numbers)
        if self._friction is None and self._first.spheres_are_far(first, self._second, second, self._part.reach):
            return None
        self._second.move_to(second)
        x = self._first.positions_at(first)
        return None if self._friction is None and self._part.is_far(x) else x

    def begin_step(self, motion: RigidObstacles, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s: friction is lagged; forces are those of the end of the step, whatever the scheme."""
        self._friction, posed = None, motion.start_posed
        if not self._part.friction or (x := self._near_positions(posed)) is None:
            return
        pressed = self._part.full_gradient(x).any(axis=1)
        if pressed.any():
            sides = zip(self.numbers, (x, self._second.positions), strict=True)
            velocity = np.concatenate([np.broadcast_to(motion.velocity(n, y), y.shape) for n, y in sides])
            speed = float(np.linalg.norm(np.ptp(velocity[pressed], axis=0)))
            slip = dt * max(self._law.sticking_speed, self._law.sticking_ratio * speed)
            self._start, self._start_pose = x, posed[self.numbers[1]].pose
            self._friction = self._part.lag_friction(x, slip)

    def is_open(self, posed: PosedObstacles) -> bool:
        """Whether the obstacles do not intersect."""
        return (x := self._near_positions(posed)) is None or not len(self._part.cut_elements(x))

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barrier, and potential of all forces in the step, J."""
        if (x := self._near_positions(posed)) is None:
            return 0.0, 0.0
        energy = self._part.energy(x)
        return energy, energy + (0.0 if self._friction is None else self._friction.energy(self._part.points(x)))

    def derivatives(self, posed: PosedObstacles, *, exact: bool) -> PairDerivatives | None:
        """Derivatives of the potential by both poses; None: out of contact."""
        if (x := self._near_positions(posed)) is None:
            return None
        gradient = self._part.full_gradient(x, self._friction)
        if not gradient.any():
            return None
        H, energy, n = self._part.full_hessian(x, self._friction, exact=exact), self.energies(posed)[1], len(x)
        arms = x - posed[self.numbers[0]].pose.centre, self._second.arms
        by_first = carried_derivatives(energy, gradient[:n], H[: x.size, : x.size], arms[0], exact=exact)
        by_second = carried_derivatives(energy, gradient[n:], H[x.size :, x.size :], arms[1], exact=exact)
        J, J_second = (point_jacobian(arm).reshape(arm.size, -1) for arm in arms)
        return by_first, by_second, np.asarray(J.T @ (H[: x.size, x.size :] @ J_second))

    def dissipated(self, posed: PosedObstacles) -> float:
        """Energy dissipated by friction in the step, J."""
        if self._friction is None or (x := self._near_positions(posed)) is None:
            return 0.0
        points, start = self._part.points(x), self._part.points(self._start, self._start_pose)
        return float(np.vdot(self._friction.gradient(points), points - start))

    def safe_fraction(self, first: PoseMotion, second: PoseMotion) -> float:
        """Fraction of the motions of both that leaves a tenth of each gap."""
        moving = first, second
        if not any(q.any() for _, q in moving):
            return 1.0

        def positions(fraction: float) -> Values:
            first_pose, second_pose = (posed.pose.incremented(fraction * q) for posed, q in moving)
            return self._part.points(self._first.positions_at(first_pose), second_pose)

        rotation = max(float(np.linalg.norm(q[3:])) for _, q in moving)
        return free_fraction_on_arcs(self._part.pairs.free_fraction, positions, rotation)
