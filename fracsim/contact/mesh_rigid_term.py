"""Term of the balance for contact with triangle-mesh obstacles of which some are free rigid bodies.

As for analytic obstacles (rigid_obstacle_term) the poses of free ones are unknowns of Newton's method beside u. Contact
with the body is evaluated on rank 0, contact with analytic obstacles on every rank.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..errors import InputError
from ..forms.schemes import Scheme
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from .ipc_surface import SelfContactLaw
from .laws import Barrier
from .mesh_obstacle_term import MeshObstacleTerm, stop_before_meshes
from .mesh_obstacles import MeshContactSurface, MeshObstaclePairs
from .obstacle import FreeMotions, FreeObstacle, RigidMotion, RigidObstacle
from .obstacle_pairs import ObstaclePairs
from .pose import Pose, PosedShape
from .pose_derivatives import PoseDerivatives, point_jacobian, point_set_derivatives
from .rigid_body import RigidStep
from .rigid_pose import FreePose, PoseUnknowns
from .triangle_mesh_shape import TriangleMeshShape, refine_triangles

Values = npt.NDArray[np.float64]


class FreeMeshTerm(MeshObstacleTerm):
    """Triangle-mesh obstacles, at least one of them free.

    Attributes:
        free: the free ones by their place among `obstacles`.
        pairs: contact of these with analytic obstacles, whose numbers follow those of triangle-mesh obstacles.
    """

    leaves_tangent_incomplete = True
    exact_near_solution = False  # the tangent by points and poses has a positive semi-definite form alone
    free: dict[int, FreePose]

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        obstacles: dict[int, RigidObstacle],
        law: SelfContactLaw,
        scheme: Scheme,
        analytic: dict[int, RigidObstacle],
        barrier: Barrier,
    ) -> None:
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            obstacles: triangle-mesh obstacles by their numbers in the study.
            law: contact law with the body.
            scheme: of time integration.
            analytic: held or driven analytic obstacles, with which free ones are in contact at their points.
            barrier: of the contact with these.

        Raises:
            InputError: if an obstacle overlaps the body at rest, or a free one another obstacle.
        """
        numbered = enumerate(obstacles.values())
        free = {index: obstacle for index, obstacle in numbered if isinstance(obstacle, FreeObstacle)}
        self.free = {index: FreePose(obstacle) for index, obstacle in free.items()}
        self._analytic = {len(obstacles) + index: obstacle for index, obstacle in enumerate(analytic.values())}
        refined: dict[int, RigidObstacle] = {
            index: _with_small_triangles(obstacle, domain.mean_edge_length) for index, obstacle in free.items()
        }
        self.pairs = ObstaclePairs(refined | self._analytic, barrier)
        self._scheme, self._unknowns = scheme, PoseUnknowns(domain.comm, self.free, self.pairs, self)
        self._place_analytic(0.0, 0.0)
        super().__init__(domain, u, obstacles, law)
        self._motions = FreeMotions(self.free, self.comm.rank == 0)
        if not self.pairs.are_open(self.posed()):
            names = " or ".join(obstacle.name for obstacle in free.values())
            raise InputError(
                f"{names} moves freely and overlaps another obstacle at the start; move it away or make it smaller"
            )

    # --- steps ---

    def _place_analytic(self, start: float, end: float) -> None:
        """Place analytic obstacles at the times of a step, s."""
        items = self._analytic.items()
        self._analytic_posed = {number: obstacle.posed_at(end) for number, obstacle in items}
        self._analytic_motions = {
            number: (obstacle.posed_at(start), obstacle.pose_increment(start, end)) for number, obstacle in items
        }

    def _place_obstacles(self, start: float, end: float) -> None:
        super()._place_obstacles(start, end)
        self._place_analytic(start, end)
        level, weights = self._level, self._level.contact_weights
        for number, pose in self.free.items():
            self._start_poses[number], self._increments[number] = pose.motion.pose, np.zeros(6)
            pose.reset_pose()
            if level.dt:
                pose.begin_step(
                    RigidStep(pose.body, pose.motion, self._scheme, level.dt, level.c_a, level.fraction, weights.factor)
                )
        if level.dt:
            start_posed = {number: posed for number, (posed, _) in self._analytic_motions.items()}
            self.pairs.begin_step(self.posed() | start_posed, time_averaged=weights.time_averaged)

    def begin_step(self, level: TimeLevel) -> None:
        """Begin a step with free obstacles at their start poses."""
        super().begin_step(level)
        self._unknowns.discard()

    def _pose_after(self, number: int, travelled: float) -> Pose:
        return self.free[number].posed.pose if number in self.free else super()._pose_after(number, travelled)

    def accept_step(self) -> None:
        """Record contact in the step, and give free obstacles their momentum (collective)."""
        super().accept_step()
        if self._in_step():
            contact = self._unknowns.equations().contact
            for pose, derivatives in zip(self.free.values(), contact.bodies, strict=True):
                pose.motion = pose.end_motion(-derivatives.gradient)

    def update_displacement(self) -> None:
        """Discard positions, forces and the equations of the poses, as u has changed."""
        super().update_displacement()
        self._unknowns.discard()

    def _in_step(self) -> bool:
        """Whether a step has begun and is not accepted yet."""
        return bool(self._level.dt) and self._unknowns.in_step

    # --- contact of the body with free obstacles (rigid_pose.BodyContact) ---

    def posed(self) -> dict[int, PosedShape]:
        """Free and analytic obstacles at their current poses, by their numbers in `pairs`."""
        return {number: pose.posed for number, pose in self.free.items()} | self._analytic_posed

    def poses_moved(self) -> None:
        """Take over the poses of free obstacles, and discard forces."""
        for number, pose in self.free.items():
            self._poses[number] = pose.posed.pose
            if self._meshes:
                self._meshes[number].move_to(pose.posed.pose)
        self._far = self._contact_force = self._stored = None

    def pose_derivatives(self) -> dict[int, PoseDerivatives]:
        """Energy and derivatives of contact with the body by the pose of each free obstacle (collective)."""
        p = len(self._increments[0])
        none = PoseDerivatives(0.0, np.zeros(p), np.zeros((p, p)), np.zeros((p, p)))
        if self._is_far():
            return dict.fromkeys(self.free, none)
        x = self._end_positions()
        near = from_root(self.comm, lambda: {number: self._derivatives_on_root(number, x) for number in self.free})
        return {number: none if by_pose is None else by_pose for number, by_pose in near.items()}

    def _derivatives_on_root(self, number: int, x: Values | None) -> PoseDerivatives | None:
        """Derivatives by the pose of a free obstacle with the body at x (n, 3), m; None: the body is far."""
        assert self._surface is not None and x is not None
        pairs, n = self._surface.pairs.pairs[number], len(x)
        if pairs.is_far(x):
            return None
        points, mesh = pairs.with_mesh(x), slice(3 * n, None)
        energy, gradient = pairs.energy(points), pairs.gradient(points)
        exact, positive = pairs.hessian(points, exact=True), pairs.hessian(points)
        if self._friction is not None and (friction := self._friction.friction_with(pairs)) is not None:
            energy, gradient = energy + friction.energy(points), gradient + friction.gradient(points)
            exact, positive = exact + friction.hessian(points, exact=True), positive + friction.hessian(points)
        arms = pairs.mesh.positions - pairs.mesh.pose.centre
        return point_set_derivatives(energy, gradient[n:], exact[mesh, mesh], positive[mesh, mesh], arms)

    def mixed_hessians(self) -> dict[int, Values]:
        """(owned dofs, p) second derivatives by nodes and the pose of obstacles in contact (collective)."""
        if self._is_far():
            return {}
        x = self._end_positions()
        by_pose = on_root(self.comm, lambda: {number: self._mixed_on_root(number, x) for number in self.free}) or {}
        touching = self.comm.bcast([number for number, mixed in by_pose.items() if mixed is not None])
        return {number: self._gather.scatter(by_pose.get(number)).reshape(self._owned, -1) for number in touching}

    def _mixed_on_root(self, number: int, x: Values | None) -> Values | None:
        """(nodes, 3 p) second derivatives by nodes and pose with the body at x (n, 3), m; None: no contact."""
        assert self._surface is not None and x is not None
        pairs, body = self._surface.pairs.pairs[number], slice(0, x.size)
        if pairs.is_far(x):
            return None
        points = pairs.with_mesh(x)
        H = pairs.hessian(points)
        if self._friction is not None and (friction := self._friction.friction_with(pairs)) is not None:
            H = H + friction.hessian(points)
        J = point_jacobian(pairs.mesh.positions - pairs.mesh.pose.centre).reshape(-1, 6)
        mixed = H[body, x.size :] @ J
        return self._surface.nodal_forces(mixed.reshape(len(x), -1)) if mixed.any() else None

    def uses_exact_tangent(self) -> bool:
        """False: tangents are positive semi-definite."""
        return False

    def free_fraction(self, increments: Mapping[int, Values]) -> float:
        """Fraction of increments (p,) of free poses on which no gap to the body at rest closes (collective)."""
        return self._fraction_along(increments, None)

    # --- unknowns of Newton's method (EliminatingTerm) ---

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """B (owned dofs, k) and D^-1 (k, k) of obstacles in contact with the body (collective)."""
        return self._unknowns.low_rank_updates() if self._in_step() else []

    def condensed_residual(self) -> Values | None:
        """(owned dofs,) B D^-1 r_y, N; None where no obstacle touches the body (collective)."""
        return self._unknowns.condensed_residual() if self._in_step() else None

    def begin_correction(self, change: Values) -> None:
        """Compute the change of the poses that belongs to a change of u (owned dofs,), m (collective)."""
        self._unknowns.begin_correction(change)

    def move_along(self, fraction: float) -> None:
        """Move free obstacles to a fraction of the correction."""
        self._unknowns.move_along(fraction)

    def unknowns_are_solved(self) -> bool:
        """Whether the poses are a solution (collective)."""
        return not self._in_step() or self._unknowns.are_solved()

    def solve_unknowns(self) -> None:
        """Solve for the poses with the body held (collective)."""
        self._unknowns.solve()

    # --- energies ---

    def potential(self) -> float:
        """Potential of contact, with inertia and weight of free obstacles, on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            of_pairs = self.pairs.energies(self.posed())[1]
            energy += self._unknowns.free_potential() + level.contact_weight * level.fraction * of_pairs
        return energy

    def stored_energy(self) -> float:
        """Energy of all barriers, on rank 0, J (collective)."""
        energy = super().stored_energy()
        return energy if self.comm.rank else energy + self.pairs.energies(self.posed())[0]

    def kinetic_energy(self) -> float:
        """Kinetic energy of the free obstacles, on rank 0, J."""
        return self._motions.kinetic_energy()

    def step_work(self) -> tuple[float, float]:
        """Work of obstacles' own motion, of gravity and of other obstacles on free ones; dissipation; on rank 0, J."""
        work = sum(by_obstacle for number, by_obstacle in enumerate(self._obstacle_work) if number not in self.free)
        if self.comm.rank == 0:
            increments = {number: increment for number, (_, increment) in self._analytic_motions.items()}
            work += self._unknowns.gravity_work() + self.pairs.work(self.posed(), increments)
        return work, self._friction_loss

    # --- step limits ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of a correction of u (owned dofs,), m, and poses without a collision (collective)."""
        increments = self._unknowns.increments()
        return min(self._unknowns.fraction_between_obstacles(increments), self._fraction_along(increments, change))

    def _fraction_along(self, increments: Mapping[int, Values], change: Values | None) -> float:
        """Fraction of increments (p,) of free poses and a change of u, m, without a collision (collective).

        `change`: (owned dofs,); None: the body is at rest.
        """
        u, level = self._u.x.array[: self._owned], self._level
        ends = [level.displacement_at_end(end) for end in ([u] if change is None else [u, u + change])]
        poses = self._step_poses()
        for number, q in increments.items():
            start = self.free[number].posed.pose
            poses[number] = start, start.incremented(q)
        if self._proximity.is_far(ends, poses):
            return 1.0
        x = self._end_positions()
        motion = None if change is None else self._gathered(np.divide(change, level.fraction))
        return from_root(self.comm, lambda: self._fraction_on_root(increments, x, motion))

    def _fraction_on_root(self, increments: Mapping[int, Values], x: Values | None, motion: Values | None) -> float:
        """Fraction on rank 0 with points of the body at x (n, 3) and a motion (nodes, 3), m; None: at rest."""
        assert self._surface is not None and x is not None
        end = x if motion is None else x + self._surface.point_map.weights @ motion
        start_poses = [mesh.pose for mesh in self._meshes]
        for number, q in increments.items():
            self._meshes[number].move_to(start_poses[number].incremented(q))
        fraction = self._surface.pairs.moving_free_fraction(x, end, start_poses)
        for number in increments:
            self._meshes[number].move_to(start_poses[number])
        return fraction

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess without a collision: free obstacles stop before they meet the body, or both stop.

        Collective.
        """
        if not self._level.dt:
            return super().feasible_guess(u)
        guesses = [self._first_pose(number, lambda z: 1.0) for number in self.free]
        fraction = min(safe for _, safe in guesses)
        self._unknowns.move_to([fraction * z for z, _ in guesses])
        guess = super().feasible_guess(u)
        self._unknowns.move_to(self.comm.bcast([pose.z for pose in self.free.values()]))
        return guess

    def _first_pose(self, number: int, fraction_with_body: Callable[[Values], float]) -> tuple[Values, float]:
        """First guess (k,) of an increment, and its fraction that closes no gap, also with the body."""
        pose = self.free[number]
        prescribed = [self._increments[index] for index in range(len(self.obstacles)) if index not in self.free]

        def safe_fraction(z: Values) -> float:
            motions = self._analytic_motions | {number: (pose.start_posed, pose.step.increment(z))}
            return min(self.pairs.safe_fraction(motions), fraction_with_body(z))

        analytic = [increment for _, increment in self._analytic_motions.values()]
        return pose.first_guess([*prescribed, *analytic], safe_fraction)

    def _first_guess(self, surface: MeshContactSurface, start: Values, end: Values) -> Values:
        prescribed = [number for number in range(len(self.obstacles)) if number not in self.free]
        stopped = end
        if prescribed:
            start_poses = [self._start_poses[number] for number in prescribed]
            stopped = stop_before_meshes(surface, surface.pairs.select(prescribed), start, end, start_poses)
        x, x_end, guesses = surface.point_map(start), surface.point_map(stopped), []
        for number, pose in self.free.items():
            with_body = partial(_fraction_with_body, surface.pairs.pairs[number], pose, x, x_end)
            guesses.append(self._first_pose(number, with_body))
        fraction = min(safe for _, safe in guesses)
        self._unknowns.move_to([fraction * z for z, _ in guesses])
        return stopped if fraction == 1 else start + fraction * (stopped - start)

    def is_feasible(self, u: Values) -> bool:
        """Whether nothing is crossed on the straight way from the start to u, nor by free obstacles (collective)."""
        return super().is_feasible(u) and self.pairs.are_open(self.posed())

    def restrict_motion(self) -> None:
        """Hold all obstacles at the start of the step (collective)."""
        self._unknowns.move_to([0 * pose.z for pose in self.free.values()])
        super().restrict_motion()

    # --- state ---

    def snapshot(self) -> object:
        """State of the surface, and states of motion."""
        return super().snapshot(), self._motions.snapshot()

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        surface, motions = cast("tuple[object, dict[int, RigidMotion]]", memory)
        super().restore(surface)
        self._motions.restore(motions)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint, with rows of states of motion (collective)."""
        return super().to_checkpoint() | self._motions.to_checkpoint()

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        super().from_checkpoint(saved)
        self._motions.from_checkpoint(saved)

    def posed_obstacles(self, t: float) -> list[PosedShape]:
        """Each obstacle at the time t of the state, s (not collective)."""
        return self._motions.place(super().posed_obstacles(t))

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """Columns of all obstacles, and those of the motion of free ones (FreeMotions.columns)."""
        return super().summed_columns() | self._motions.columns()


def _fraction_with_body(pairs: MeshObstaclePairs, pose: FreePose, x: Values, end: Values, z: Values) -> float:
    """Fraction of an increment z (k,) and the motion of points from x to `end` (n, 3), m, without a collision."""
    pairs.mesh.move_to(pose.step.pose(z))
    return pairs.moving_free_fraction(x, end, pose.step.start.pose)


def _with_small_triangles(obstacle: FreeObstacle, edge: float) -> FreeObstacle:
    """Obstacle with triangles as small as those of the body; `edge`: mean edge of its mesh, m."""
    shape = obstacle.shape
    assert isinstance(shape, TriangleMeshShape)
    return replace(obstacle, shape=TriangleMeshShape(*refine_triangles(shape.points, shape.triangles, edge)))
