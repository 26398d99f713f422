"""Terms of the balance for contact with analytic obstacles of which some are free rigid bodies.

For a body at x the poses z minimise the incremental potential Phi (rigid_pose), by a small Newton method within the
term. The body is in contact with a function of x alone:

    E(x) = min over z of Phi(x, z),    dE/dx = dPhi/dx at that z,    d2E/dx2 = Phi_xx - Phi_xz Phi_zz^-1 Phi_zx

So the system of equations keeps its size, with the solution of the full system. The last part couples all points in
contact with one another. Its rank is that of the poses, and it is applied, not stored. Every rank finds the same poses
from sums over all ranks.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..forms.schemes import Scheme
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .laws import ObstacleLaw
from .node_contact import ContactForces
from .obstacle import FreeMotions, FreeObstacle, PlaceableObstacle, RigidMotion, RigidObstacle
from .obstacle_pairs import ObstaclePairs
from .obstacle_term import ObstacleTerm
from .pose import PosedShape
from .rigid_body import RigidStep, is_positive_definite
from .rigid_pose import BodySurroundings, CondensedPose, FreeObstacleSystem

Values = npt.NDArray[np.float64]

# evaluations in which free obstacles are held back, before they are released whatever they press on
MAX_HOLDS = 4


class FreeObstacleBase(ObstacleTerm):
    """Term with obstacles of which some are free.

    Attributes:
        free: the free ones by their numbers.
    """

    free: Mapping[int, PlaceableObstacle]

    @property
    def _motions(self) -> FreeMotions:
        return FreeMotions(self.free, self.comm.rank == 0)

    def _prescribed_numbers(self) -> list[int]:
        return [number for number in super()._prescribed_numbers() if number not in self.free]

    def _place_obstacles(self, start: float, end: float) -> None:
        super()._place_obstacles(start, end)
        for number, obstacle in self.free.items():
            self._kinematics.hold_at_start(number, obstacle.reset_pose())

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

    def kinetic_energy(self) -> float:
        """Kinetic energy of the free obstacles, on rank 0, J."""
        return self._motions.kinetic_energy()

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """Columns of all obstacles, and those of the motion of free ones (FreeMotions.columns)."""
        return super().summed_columns() | self._motions.columns()


# --- implicit steps ---


class FreeObstacleTerm(FreeObstacleBase):
    """Obstacles, at least one of them free, in implicit steps.

    Attributes:
        free: the free ones by their numbers.
    """

    leaves_tangent_incomplete = True
    free: dict[int, CondensedPose]

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[RigidObstacle], law: ObstacleLaw, scheme: Scheme
    ) -> None:
        """Raise InputError where the body at rest overlaps an obstacle (collective)."""
        prescribed = {number: obstacle for number, obstacle in enumerate(obstacles) if not obstacle.free}
        self.free = {
            number: CondensedPose(obstacle, ObstaclePairs(obstacle, prescribed, law.barrier))
            for number, obstacle in enumerate(obstacles)
            if isinstance(obstacle, FreeObstacle)
        }
        self._scheme = scheme
        self._free_system = FreeObstacleSystem(self.free, law.barrier) if len(self.free) > 1 else None
        self._equilibrium_positions: Values | None = None  # (n, d) of points for which the poses are in equilibrium
        self._is_first_evaluation = False  # of a solve: the body has not been moved by the obstacles yet
        self._held_fraction = 0.0  # fraction of their way to equilibrium from which free obstacles are held back
        self._hold_count = 0  # evaluations in which they were held back
        super().__init__(domain, u, obstacles, law)

    # --- steps ---

    def _begin_new_step(self) -> None:
        super()._begin_new_step()
        level, self._equilibrium_positions = self._level, None
        weights = level.contact_weights
        for number, obstacle in self.free.items():
            step = RigidStep(
                obstacle.body, obstacle.motion, self._scheme, level.dt, level.c_a, level.fraction, weights.factor
            )
            self._kinematics.increments[number] = obstacle.begin_step(step, self._lagged[number])
            obstacle.obstacle_pairs.begin_step(
                obstacle.motion.pose, self._kinematics.start_posed, along=weights.time_averaged
            )
        if self._free_system is not None:
            self._free_system.begin_step(along=weights.time_averaged)

    def accept_step(self) -> None:
        """Record contact in the step, and give free obstacles their momentum (collective)."""
        super().accept_step()
        contacts, wrenches = self.obstacle_forces(), {} if self._free_system is None else self._free_system.wrenches()
        for number, obstacle in self.free.items():
            obstacle.end_step(contacts[number], self._surroundings(number), wrenches.get(number, 0.0))

    # --- equilibrium of free obstacles ---

    def obstacle_forces(self) -> list[ContactForces]:
        """Forces of each obstacle at the current u, free ones in equilibrium (collective)."""
        if self._contact_forces is None and self._in_step():
            self.positions = self.surface.positions(self._end_displacement())
            if not self.comm.allreduce(_is_same(self.positions, self._equilibrium_positions), op=MPI.LAND):
                self._equilibrium_positions = self.positions
                if self._is_first_evaluation:
                    self._approach_equilibrium()
                elif not self._held_fraction:
                    self._equilibrate()
                self._update_kinematics()
        return super().obstacle_forces()

    def _reset_equilibrium(self) -> None:
        """Begin a solve: poses are not in equilibrium."""
        self._equilibrium_positions, self._is_first_evaluation = None, True
        self._held_fraction, self._hold_count = 0.0, 0

    def _approach_equilibrium(self) -> None:
        """Move free obstacles towards equilibrium as far as is safe (collective).

        Before a body that has not given way yet, a heavy obstacle would come to rest at a tiny distance, with a force
        that is of no use.
        """
        self._is_first_evaluation = False
        start = {number: obstacle.z for number, obstacle in self.free.items()}
        self._equilibrate()
        changes = {number: obstacle.z - start[number] for number, obstacle in self.free.items()}
        surroundings = self._all_surroundings()
        if self._free_system is not None:
            fraction = self._free_system.free_fraction(surroundings, start, changes)
        else:
            fraction = min(
                obstacle.free_fraction(surroundings[number], start[number], changes[number])
                for number, obstacle in self.free.items()
            )
        self._hold_count += 1
        if self._hold_count == MAX_HOLDS:
            fraction = 1.0
        self._held_fraction = 1 - fraction
        for number, obstacle in self.free.items():
            obstacle.move_to(start[number] + fraction * changes[number])
            if fraction < 1:
                obstacle.discard_derivatives()

    def _equilibrate(self) -> None:
        """Move all free obstacles to equilibrium with the points at their current positions (collective)."""
        if self._free_system is not None:
            return self._free_system.equilibrate(self._all_surroundings())
        for number, obstacle in self.free.items():
            obstacle.equilibrate(self._surroundings(number))

    def _all_surroundings(self) -> dict[int, BodySurroundings]:
        return {number: self._surroundings(number) for number in self.free}

    def _in_step(self) -> bool:
        """Whether a step has begun and is not accepted yet."""
        return bool(self._level.dt) and all(obstacle.in_step for obstacle in self.free.values())

    def _surroundings(self, number: int) -> BodySurroundings:
        return self._surroundings_at(number, self.positions)

    def _surroundings_at(self, number: int, x: Values) -> BodySurroundings:
        evaluate, facets = partial(self._evaluate_obstacle, number), self._facets_for(number)
        return BodySurroundings(self.surface, x, evaluate, facets, self._kinematics.posed)

    def _update_kinematics(self) -> None:
        """Set the poses of free obstacles in the kinematics of all."""
        for number, obstacle in self.free.items():
            self._kinematics.posed[number] = obstacle.posed

    def _contact_point_motion(self, number: int, posed: PosedShape) -> Values:
        lagged = self._lagged[number]
        if number not in self.free or lagged is None:
            return super()._contact_point_motion(number, posed)
        return self.free[number].contact_point_motion(lagged, posed)

    # --- forces, tangent and energy ---

    def potential(self) -> float:
        """Potential of contact, with inertia and weight of free obstacles on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            for obstacle in self.free.values():
                _, of_pairs = obstacle.obstacle_pairs.energies(obstacle.posed.pose, self._kinematics.posed)
                energy += obstacle.step.free_potential(obstacle.z) + level.contact_weight * level.fraction * of_pairs
            if self._free_system is not None:
                energy += level.contact_weight * level.fraction * self._free_system.energies()[1]
        return energy

    def stored_energy(self) -> float:
        """Energy of all barriers, those between obstacles on rank 0, J (collective)."""
        energy = super().stored_energy()
        if self.comm.rank == 0:
            posed = self._kinematics.posed
            energy += sum(body.obstacle_pairs.energies(body.posed.pose, posed)[0] for body in self.free.values())
            energy += 0.0 if self._free_system is None else self._free_system.energies()[0]
        return energy

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """Phi_xz (owned dofs, k) and Phi_zz^-1 (k, k) of obstacles in contact (collective)."""
        if not self._in_step() or not (contacts := self.obstacle_forces()) or self._held_fraction:
            return []
        counts = sum_over_ranks(self.comm, np.array([len(contacts[number].points) for number in self.free]))
        touched = [number for number, count in zip(self.free, counts, strict=True) if count]
        if self._free_system is not None and touched:
            U = np.concatenate([self._mixed_block(number, contacts[number]) for number in self.free], axis=1)
            return [(U, self._free_system.compliance(self._all_surroundings(), exact=self._tangent_is_exact))]
        return [(self._mixed_block(number, contacts[number]), self._compliance(number)) for number in touched]

    def _mixed_block(self, number: int, contact: ContactForces) -> Values:
        """(owned dofs, k) Phi_xz (collective)."""
        by_z = self.free[number].mixed_block(contact, self.positions, exact=self._tangent_is_exact)
        forces = np.zeros((len(self.positions), *by_z.shape[1:]))
        forces[contact.points] = by_z
        to_nodes = self.surface.interpolation.assemble_to_nodes
        return np.stack([to_nodes(column) for column in np.moveaxis(forces, 2, 0)], axis=1)

    def _compliance(self, number: int) -> Values:
        """(k, k) Phi_zz^-1 (collective)."""
        hessian = self.free[number].hessian(self._surroundings(number), exact=self._tangent_is_exact)
        return np.asarray(np.linalg.inv(hessian), np.float64)

    def _exact_tangent_allowed(self, motion: float) -> bool:
        """Whether Newton's method is near the solution, and Phi_zz is positive definite (collective)."""
        if not super()._exact_tangent_allowed(motion):
            return False
        if self._free_system is not None:
            return is_positive_definite(self._free_system.hessian(self._all_surroundings(), exact=True))
        return all(
            is_positive_definite(obstacle.hessian(self._surroundings(number), exact=True))
            for number, obstacle in self.free.items()
        )

    def _normal_work(self, number: int) -> float:
        if number not in self.free:
            return super()._normal_work(number)
        return self.free[number].normal_work(self.obstacle_forces()[number], self.positions)

    def step_work(self) -> tuple[float, float]:
        """Work of obstacles' own motion, of gravity and other obstacles on free ones; dissipation (collective)."""
        work, dissipation = super().step_work()
        if self.comm.rank == 0:
            for number, obstacle in self.free.items():
                start, end = self._kinematics.start_posed[number].pose, obstacle.posed.pose
                work += obstacle.body.gravity_potential(start)[0] - obstacle.body.gravity_potential(end)[0]
                work += obstacle.obstacle_pairs.work(end, self._kinematics.posed, self._kinematics.increments)
        return work, dissipation

    # --- step limits ---

    def _obstacle_increments(self, motion: Values) -> list[Values]:
        """(p,) increments of the poses with which Newton's method moves obstacles and points (collective)."""
        increments, contacts = super()._obstacle_increments(motion), self.obstacle_forces()
        if self._held_fraction:
            return increments
        exact = self._tangent_is_exact
        if self._free_system is not None:
            predicted = self._free_system.predict_increments(
                dict(enumerate(contacts)), self._all_surroundings(), motion, exact=exact
            )
            for number, q in predicted.items():
                increments[number] = q
            return increments
        for number, obstacle in self.free.items():
            increments[number] = obstacle.predict_increment(
                contacts[number], self._surroundings(number), motion, exact=exact
            )
        return increments

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess without a collision: obstacles stop before they meet, or the body (collective)."""
        u, level = super().feasible_guess(u), self._level
        self._reset_equilibrium()
        for obstacle in self.free.values():
            obstacle.discard_predictor()
        if not level.dt:
            return u
        x = self.surface.positions(level.u_n)
        motion = self.surface.positions(level.displacement_at_end(u)) - x
        fraction, guesses = 1.0, {}
        for number, obstacle in self.free.items():
            guesses[number], safe = self._first_guess(obstacle, self._surroundings_at(number, x), motion)
            fraction = min(fraction, safe)
        if self._free_system is not None:
            fraction = min(fraction, self._free_system.safe_guess(guesses))
        for number, z in guesses.items():
            self.free[number].move_to(fraction * z)
        self._update_kinematics()
        return u if fraction == 1 else np.asarray(level.u_n + fraction * (u - level.u_n))

    def _first_guess(
        self, obstacle: CondensedPose, surroundings: BodySurroundings, motion: Values
    ) -> tuple[Values, float]:
        """First guess (k,) of an increment, and its fraction that closes no gap (collective).

        The first of these without a collision: free flight, rest, motion with a driven obstacle.

        Args:
            obstacle: free obstacle.
            surroundings: body at the start of the step.
            motion: (n, d) of the points, m.
        """
        motions = self._kinematics.full_motions()
        carried = [obstacle.carried_by(increment) for _, increment in motions.values() if increment.any()]
        guesses = [obstacle.step.free_flight, 0 * obstacle.step.free_flight, *carried]
        fraction = 0.0
        for z in guesses:
            safe = obstacle.safe_fraction(surroundings, motion, z, motions)
            if safe == 1:
                return z, 1.0
            fraction = min(fraction, safe) if fraction else safe
        return guesses[0], fraction

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap is open with the body at u, also between obstacles (collective)."""
        posed = self._kinematics.posed
        apart = all(body.obstacle_pairs.are_open(body.posed.pose, posed) for body in self.free.values())
        return super().is_feasible(u) and apart and (self._free_system is None or self._free_system.are_open())

    def remaining_motion(self) -> float:
        """Remaining fraction of the motion of prescribed obstacles, or of free ones to equilibrium (collective)."""
        if self._is_first_evaluation:
            self.obstacle_forces()
        return max(super().remaining_motion(), self._held_fraction)

    def continue_motion(self) -> None:
        """Advance held obstacles, and free ones towards equilibrium (collective)."""
        super().continue_motion()
        if self._held_fraction:
            self.obstacle_forces()
            self._approach_equilibrium()
            self._update_kinematics()
            self._contact_forces = None

    def _advance_obstacles(self, x: Values) -> None:
        """Advance prescribed obstacles as far as the body and free obstacles allow."""
        remaining, no_motion = self._kinematics.remaining_motions(), np.zeros_like(self._kinematics.increments[0])
        fractions = [
            obstacle.obstacle_pairs.safe_fraction(obstacle.posed.pose, no_motion, remaining)
            for obstacle in self.free.values()
        ]
        motions = self._kinematics.prescribed_motions(self._facets_for)
        self._kinematics.advance(x, motions, self.surface.min_fraction, min(fractions))
        self._contact_forces = self._equilibrium_positions = None

    def restrict_motion(self) -> None:
        """Hold all obstacles at the start of the step (collective)."""
        for obstacle in self.free.values():
            obstacle.return_to_start()
        self._update_kinematics()
        self._reset_equilibrium()
        super().restrict_motion()


def _is_same(x: Values, previous: Values | None) -> bool:
    return previous is not None and np.array_equal(x, previous)
