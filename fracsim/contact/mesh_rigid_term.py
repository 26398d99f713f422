"""Term of the balance for contact with triangle-mesh obstacles of which some are free rigid bodies.

As for analytic obstacles (rigid_obstacle_term) the poses are eliminated. Rank 0 finds them and sends them to all.

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
from .mesh_obstacles import MeshContactSurface
from .mesh_rigid_body import FreeMesh, MeshSurroundings
from .obstacle import FreeMotions, FreeObstacle, RigidMotion, RigidObstacle
from .obstacle_pairs import ObstaclePairs
from .pose import Pose, PosedShape
from .rigid_body import RigidStep
from .step_limit import PoseMotion
from .triangle_mesh_shape import TriangleMeshShape

Values = npt.NDArray[np.float64]


class FreeMeshTerm(MeshObstacleTerm):
    """Triangle-mesh obstacles, at least one of them free.

    Attributes:
        free: the free ones by their place among `obstacles`.
    """

    exact_near_solution = False  # the condensed part has a positive definite form alone
    free: dict[int, FreeMesh]

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
        items = enumerate(obstacles.values())
        self.free = {number: FreeMesh(obstacle) for number, obstacle in items if isinstance(obstacle, FreeObstacle)}
        self._scheme, self._other_obstacles, self._in_equilibrium = scheme, analytic, True
        super().__init__(domain, u, obstacles, law)
        self._motions = FreeMotions(self.free, self.comm.rank == 0)
        self._others_posed = self._others_start = {
            number: obstacle.posed_at(0.0) for number, obstacle in analytic.items()
        }
        self._others_increments: dict[int, Values] = {number: np.zeros(6) for number in analytic}
        # meshes are on rank 0 alone
        if self._meshes:
            for number, body in self.free.items():
                body.obstacle_pairs = ObstaclePairs(self._refined_body(number), analytic, barrier)
        on_root(self.comm, self._check_free_apart)

    def _refined_body(self, number: int) -> FreeObstacle:
        """Free obstacle with the refined triangles of its mesh."""
        mesh = self._meshes[number]
        return replace(self.free[number].body, shape=TriangleMeshShape(mesh.points, mesh.triangles))

    def _check_free_apart(self) -> None:
        for number, body in self.free.items():
            if not body.obstacle_pairs.are_open(body.pose, self._others_posed):
                raise InputError(
                    f"{self._meshes[number].name} moves freely and overlaps another obstacle at the start; move it "
                    "away or make it smaller"
                )

    # --- steps ---

    def _place_obstacles(self, start: float, end: float) -> None:
        super()._place_obstacles(start, end)
        analytic = self._other_obstacles.items()
        self._others_start = {number: obstacle.posed_at(start) for number, obstacle in analytic}
        self._others_posed = {number: obstacle.posed_at(end) for number, obstacle in analytic}
        self._others_increments = {number: obstacle.pose_increment(start, end) for number, obstacle in analytic}
        level, weights = self._level, self._level.contact_weights
        for number, body in self.free.items():
            self._start_poses[number], self._increments[number] = body.motion.pose, np.zeros(6)
            body.reset_pose()
            if level.dt:
                step = RigidStep(
                    body.body, body.motion, self._scheme, level.dt, level.c_a, level.fraction, weights.factor
                )
                body.begin_step(step)
                if self.comm.rank == 0:
                    body.obstacle_pairs.begin_step(body.pose, self._others_start, along=weights.time_averaged)

    def begin_step(self, level: TimeLevel) -> None:
        """Begin a step with free obstacles at their start poses."""
        super().begin_step(level)
        self._in_equilibrium = False

    def _pose_after(self, number: int, travelled: float) -> Pose:
        return self.free[number].pose if number in self.free else super()._pose_after(number, travelled)

    def accept_step(self) -> None:
        """Record contact in the step, and give free obstacles their momentum (collective)."""
        super().accept_step()
        x = None if self._is_far() else self._end_positions()
        motions = from_root(self.comm, lambda: {number: self._end_motion(number, x) for number in self.free})
        for body in self.free.values():
            body.store_solution()
        self._motions.restore(motions)

    def _end_motion(self, number: int, x: Values | None) -> RigidMotion:
        """State of motion of a free obstacle at the end of the step, on rank 0."""
        body = self.free[number]
        return body.step.end_motion(body.z, body.wrench(self._surroundings(number, x)))

    # --- equilibrium of free obstacles ---

    @property
    def _in_step(self) -> bool:
        return bool(self._level.dt) and all(body.in_step for body in self.free.values())

    def update_displacement(self) -> None:
        """Discard positions, forces and equilibrium, as u has changed."""
        super().update_displacement()
        self._in_equilibrium = False

    def _is_far(self) -> bool:
        self._equilibrate()
        return super()._is_far()

    def _end_positions(self) -> Values | None:
        self._equilibrate()
        return super()._end_positions()

    def _equilibrate(self) -> None:
        """Move free obstacles to equilibrium with the body at the current u (collective)."""
        if self._in_equilibrium or not self._in_step:
            return
        self._in_equilibrium = True
        # without the body first, if it is far; with it, if obstacles have come near by their own motion
        for near in (not super()._is_far(), True):
            x = super()._end_positions() if near else None
            self._move_free(from_root(self.comm, partial(self._equilibrium_increments, x)))
            if near or super()._is_far():
                break

    def _equilibrium_increments(self, x: Values | None) -> dict[int, Values]:
        """(k,) z of each free obstacle in equilibrium, on rank 0."""
        return {number: body.equilibrate(self._surroundings(number, x)) for number, body in self.free.items()}

    def _move_free(self, increments: Mapping[int, Values]) -> None:
        """Move free obstacles to increments z, by numbers."""
        for number, z in increments.items():
            self.free[number].move_to(z)
            self._poses[number] = self.free[number].pose
            if self._meshes:
                self._meshes[number].move_to(self.free[number].pose)
        self._far = self._contact_force = None

    def _surroundings(self, number: int, x: Values | None) -> MeshSurroundings:
        """Body and obstacles around a free obstacle, on rank 0; `x`: positions as in MeshSurroundings."""
        if x is None or self._surface is None:
            return MeshSurroundings(None, None, None, self._others_posed)
        pairs = self._surface.pairs.pairs[number]
        friction = None if self._friction is None else self._friction.friction_with(pairs)
        return MeshSurroundings(pairs, friction, x, self._others_posed, self._start_positions)

    # --- forces, tangent and energy ---

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """Phi_xz (owned dofs, k) and Phi_zz^-1 (k, k) of free obstacles in contact (collective)."""
        if not self._in_step or self._is_far():
            return []
        x = self._end_positions()

        def condensed_on_root() -> list[tuple[Values, Values]]:
            assert self._surface is not None and x is not None
            condensed = [self.free[number].condensation(self._surroundings(number, x)) for number in self.free]
            return [(self._to_nodes(mixed), compliance) for mixed, compliance in (item for item in condensed if item)]

        parts = on_root(self.comm, condensed_on_root) or []
        self._move_free({number: body.z for number, body in self.free.items()})
        compliances = self.comm.bcast([compliance for _, compliance in parts])
        mixed = [self._gather.scatter(parts[i][0] if parts else None) for i in range(len(compliances))]
        return [(U.reshape(self._owned, len(C)), C) for U, C in zip(mixed, compliances, strict=True)]

    def _to_nodes(self, mixed: Values) -> Values:
        """(nodes, 3 k) values at nodes of values (3 n, k) at points."""
        assert self._surface is not None
        return self._surface.nodal_forces(mixed.reshape(-1, 3 * mixed.shape[1]))

    def potential(self) -> float:
        """Potential of contact, with inertia and weight of free obstacles, on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            for body in self.free.values():
                of_pairs = self._pair_energies(body)[1]
                energy += body.step.free_potential(body.z) + level.contact_weight * level.fraction * of_pairs
        return energy

    def stored_energy(self) -> float:
        """Energy of all barriers, on rank 0, J (collective)."""
        energy = super().stored_energy()
        if self.comm.rank:
            return energy
        return energy + sum(self._pair_energies(body)[0] for body in self.free.values())

    def _pair_energies(self, body: FreeMesh) -> tuple[float, float]:
        """Energy of contact with analytic obstacles, and potential of its forces in the step, J."""
        return body.obstacle_pairs.energies(body.pose, self._others_posed)

    def kinetic_energy(self) -> float:
        """Kinetic energy of the free obstacles, on rank 0, J."""
        return self._motions.kinetic_energy()

    def step_work(self) -> tuple[float, float]:
        """Work of obstacles' own motion, of gravity and of other obstacles on free ones; dissipation; on rank 0, J."""
        work = sum(by_obstacle for number, by_obstacle in enumerate(self._obstacle_work) if number not in self.free)
        if self.comm.rank == 0:
            for number, body in self.free.items():
                start = self._start_poses[number]
                work += body.body.gravity_potential(start)[0] - body.body.gravity_potential(body.pose)[0]
                work += body.obstacle_pairs.work(body.pose, self._others_posed, self._others_increments)
        return work, self._friction_loss

    # --- step limits ---

    def _free_fraction(self, x: Values | None, motion: Values | None) -> float:
        assert self._surface is not None and x is not None and motion is not None
        point_motion = self._surface.point_map.weights @ motion
        start_poses, fractions = [mesh.pose for mesh in self._meshes], [1.0]
        analytic: dict[int, PoseMotion] = {number: (posed, np.zeros(6)) for number, posed in self._others_posed.items()}
        for number, body in self.free.items():
            pose, start = body.predict_pose(self._surroundings(number, x), point_motion), start_poses[number]
            fractions.append(body.obstacle_pairs.safe_fraction(start, start.increment_to(pose), analytic))
            body.move_to(body.z)
            self._meshes[number].move_to(pose)
        fractions.append(self._surface.pairs.moving_free_fraction(x, x + point_motion, start_poses))
        for number in self.free:
            self._meshes[number].move_to(start_poses[number])
        return min(fractions)

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess without a collision: free obstacles stop before they meet the body, or both stop.

        Collective.
        """
        if not self._level.dt:
            return super().feasible_guess(u)
        for body in self.free.values():
            body.discard_predictor()
        self._move_free({number: body.step.free_flight for number, body in self.free.items()})
        guess = super().feasible_guess(u)
        self._move_free(self.comm.bcast({number: body.z for number, body in self.free.items()}))
        self._in_equilibrium = False
        return guess

    def _first_guess(self, surface: MeshContactSurface, start: Values, end: Values) -> Values:
        prescribed = [number for number in range(len(self.obstacles)) if number not in self.free]
        stopped, fraction = end, 1.0
        if prescribed:
            start_poses = [self._start_poses[number] for number in prescribed]
            stopped = stop_before_meshes(surface, surface.pairs.select(prescribed), start, end, start_poses)
        increments = [*(self._increments[number] for number in prescribed), *self._others_increments.values()]
        x_end, guesses = surface.point_map(stopped), {}
        self._start_positions = surface.point_map(start) if self._start_positions is None else self._start_positions
        for number, body in self.free.items():
            pairs = surface.pairs.pairs[number]
            surroundings = MeshSurroundings(pairs, None, None, self._others_start, self._start_positions)
            guesses[number], safe = body.first_guess(surroundings, x_end, increments)
            fraction = min(fraction, safe)
        self._move_free({number: fraction * z for number, z in guesses.items()})
        return stopped if fraction == 1 else start + fraction * (stopped - start)

    def is_feasible(self, u: Values) -> bool:
        """Whether nothing is crossed on the straight way from the start to u, nor by free obstacles (collective)."""
        posed, bodies = self._others_posed, self.free.values()
        apart = from_root(self.comm, lambda: all(body.obstacle_pairs.are_open(body.pose, posed) for body in bodies))
        return super().is_feasible(u) and apart

    def restrict_motion(self) -> None:
        """Hold all obstacles at the start of the step (collective)."""
        self._move_free({number: 0 * body.z for number, body in self.free.items()})
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
