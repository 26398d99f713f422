"""Contact with obstacles of which some move freely: the same term, with their poses as further unknowns.

For a body that is at x the poses are the minimum of the incremental potential (rigid_pose), found by a small Newton
method within the term. The body sees what is left, a function of x alone:

    E(x) = min over z of Phi(x, z),    dE/dx = dPhi/dx at that z,    d2E/dx2 = Phi_xx - Phi_xz Phi_zz^-1 Phi_zx

So the system of equations keeps its size, and its solution is the same as if poses were among its unknowns. The last
part couples all points in touch with one another; it is of rank k, the freedoms of an obstacle, and is applied, not
stored. (Without it a disk of a third of the body's mass takes 17,892 iterations in place of 127, or finds no solution.)
Every rank finds the same poses from sums over all ranks. Free obstacles meet those that are held or driven
(obstacle_pairs), and one another (rigid_pose).

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..forms.schemes import Scheme
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .laws import ObstacleLaw
from .node_contact import ContactForces
from .obstacle import FreeObstacle, RigidObstacle
from .obstacle_pairs import ObstaclePairs
from .pose import PosedShape
from .rigid_body import RigidStep, is_positive_definite
from .rigid_obstacle_state import FreeObstacleBase
from .rigid_pose import BodySurroundings, CondensedPose, FreeObstacleSystem

Values = npt.NDArray[np.float64]

WALKS = 4  # until what is held back is let go, whatever it presses on


class FreeObstacleTerm(FreeObstacleBase):
    """Obstacles, at least one of them free.

    Attributes:
        free: the free ones by their number.
    """

    leaves_tangent_incomplete = True
    free: dict[int, CondensedPose]

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[RigidObstacle], law: ObstacleLaw, scheme: Scheme
    ) -> None:
        """InputError where the body at rest lies in an obstacle (collective)."""
        others = {number: each for number, each in enumerate(obstacles) if not each.free}
        self.free = {
            number: CondensedPose(each, ObstaclePairs(each, others, law.barrier))
            for number, each in enumerate(obstacles)
            if isinstance(each, FreeObstacle)
        }
        self._scheme, self._free_system = (
            scheme,
            FreeObstacleSystem(self.free, law.barrier) if len(self.free) > 1 else None,
        )
        self._equilibrium_positions: Values | None = None  # places of the points that poses belong to
        self._is_first_evaluation = False  # whether Newton's method begins: nothing has given way to anything yet
        self._held_fraction = 0.0  # share of their way to where they belong that free obstacles are held back from
        self._hold_count = 0  # on which they have been held back
        super().__init__(domain, u, obstacles, law)

    # --- a step ---

    def _begin_new_step(self) -> None:
        super()._begin_new_step()
        level, self._equilibrium_positions = self._level, None
        for number, each in self.free.items():
            step = RigidStep(
                each.body, each.motion, self._scheme, level.dt, level.c_a, level.fraction, level.contact_weights.factor
            )
            self._kinematics.increments[number] = each.begin_step(step, self._lagged[number])
            along = level.contact_weights.time_averaged
            each.obstacle_pairs.begin_step(each.motion.pose, self._kinematics.start_posed, along=along)
        if self._free_system is not None:
            self._free_system.begin_step(along=level.contact_weights.time_averaged)

    def accept_step(self) -> None:
        """The step is over: obstacles have the momentum that it gave them (collective)."""
        super().accept_step()
        found, others = self.obstacle_forces(), {} if self._free_system is None else self._free_system.wrenches()
        for number, each in self.free.items():
            each.end_step(found[number], self._surroundings(number), others.get(number, 0.0))

    # --- where free obstacles are ---

    def obstacle_forces(self) -> list[ContactForces]:
        """What each obstacle does at the current u, free ones where they belong then (collective)."""
        if self._contact_forces is None and self._in_step():
            self.positions = self.surface.positions(self._end_displacement())
            if not self.comm.allreduce(_same(self.positions, self._equilibrium_positions), op=MPI.LAND):
                self._equilibrium_positions = self.positions
                if self._is_first_evaluation:
                    self._approach_equilibrium()
                elif not self._held_fraction:
                    self._equilibrate()
                self._update_kinematics()
        return super().obstacle_forces()

    def _reset_equilibrium(self) -> None:
        """Newton's method begins, with poses that belong to no points yet."""
        self._equilibrium_positions, self._is_first_evaluation, self._held_fraction, self._hold_count = (
            None,
            True,
            0.0,
            0,
        )

    def _approach_equilibrium(self) -> None:
        """To where all belong, or as far as closes no gap by more than is safe: before a body that has not given way
        yet what is heavy would come to rest a hair's breadth away, with a force that tells nothing (collective)."""
        self._is_first_evaluation = False
        began = {number: each.z for number, each in self.free.items()}
        self._equilibrate()
        ways = {number: each.z - began[number] for number, each in self.free.items()}
        arounds = self._all_surroundings()
        if self._free_system is not None:
            share = self._free_system.free_fraction(arounds, began, ways)
        else:
            share = min(each.free_fraction(arounds[k], began[k], ways[k]) for k, each in self.free.items())
        self._hold_count += 1
        if self._hold_count == WALKS:
            share = 1.0
        self._held_fraction = 1 - share
        for number, each in self.free.items():
            each.move_to(began[number] + share * ways[number])
            if share < 1:
                each.discard_derivatives()

    def _equilibrate(self) -> None:
        """All are where they belong with the points where they are now (collective)."""
        if self._free_system is not None:
            return self._free_system.equilibrate(self._all_surroundings())
        for number, each in self.free.items():
            each.equilibrate(self._surroundings(number))

    def _all_surroundings(self) -> dict[int, BodySurroundings]:
        return {number: self._surroundings(number) for number in self.free}

    def _in_step(self) -> bool:
        """Whether this is no mere look, and the step that began is not over yet."""
        return bool(self._level.dt) and all(each.in_step for each in self.free.values())

    def _surroundings(self, number: int) -> BodySurroundings:
        return self._surroundings_at(number, self.positions)

    def _surroundings_at(self, number: int, x: Values) -> BodySurroundings:
        return BodySurroundings(
            self.surface, x, partial(self._evaluate_obstacle, number), self._facets_for(number), self._kinematics.posed
        )

    def _update_kinematics(self) -> None:
        """All see free obstacles where they are."""
        for number, each in self.free.items():
            self._kinematics.posed[number] = each.posed

    def _contact_point_motion(self, number: int, placed: PosedShape) -> Values:
        held = self._lagged[number]
        if number not in self.free or held is None:
            return super()._contact_point_motion(number, placed)
        return self.free[number].contact_point_motion(held, placed)

    # --- what they add to the balance ---

    def potential(self) -> float:
        """That of all obstacles, with the inertia and the weight of the free ones on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            for each in self.free.values():
                _, stopped = each.obstacle_pairs.energies(each.posed.pose, self._kinematics.posed)
                energy += each.step.free_potential(each.z) + level.contact_weight * level.fraction * stopped
            if self._free_system is not None:
                energy += level.contact_weight * level.fraction * self._free_system.energies()[1]
        return energy

    def stored_energy(self) -> float:
        """That of all obstacles, with the barriers between them on rank 0, J (collective)."""
        energy = super().stored_energy()
        if self.comm.rank == 0:
            placed = self._kinematics.posed
            energy += sum(each.obstacle_pairs.energies(each.posed.pose, placed)[0] for each in self.free.values())
            energy += 0.0 if self._free_system is None else self._free_system.energies()[0]
        return energy

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """Phi_xz and Phi_zz^-1 of each obstacle that is touched and under way (collective)."""
        if not self._in_step() or not (touches := self.obstacle_forces()) or self._held_fraction:
            return []
        counts = sum_over_ranks(self.comm, np.array([len(touches[number].points) for number in self.free]))
        touched = [number for number, count in zip(self.free, counts, strict=True) if count]
        if self._free_system is not None and touched:
            U = np.concatenate([self._mixed_block(number, touches[number]) for number in self.free], axis=1)
            return [(U, self._free_system.compliance(self._all_surroundings(), exact=self._tangent_is_exact))]
        return [(self._mixed_block(number, touches[number]), self._compliance(number)) for number in touched]

    def _mixed_block(self, number: int, found: ContactForces) -> Values:
        """(owned dofs, k) Phi_xz (collective)."""
        by_z = self.free[number].mixed_block(found, self.positions, exact=self._tangent_is_exact)
        forces = np.zeros((len(self.positions), *by_z.shape[1:]))
        forces[found.points] = by_z
        to_nodes = self.surface.interpolation.assemble_to_nodes
        return np.stack([to_nodes(each) for each in np.moveaxis(forces, 2, 0)], axis=1)

    def _compliance(self, number: int) -> Values:
        """(k, k) Phi_zz^-1 (collective)."""
        resistance = self.free[number].hessian(self._surroundings(number), exact=self._tangent_is_exact)
        return np.asarray(np.linalg.inv(resistance), np.float64)

    def _exact_tangent_allowed(self, moved: float) -> bool:
        """And all free obstacles stand where the potential is least (collective)."""
        if not super()._exact_tangent_allowed(moved):
            return False
        if self._free_system is not None:
            return is_positive_definite(self._free_system.hessian(self._all_surroundings(), exact=True))
        return all(
            is_positive_definite(each.hessian(self._surroundings(k), exact=True)) for k, each in self.free.items()
        )

    def _normal_work(self, number: int) -> float:
        if number not in self.free:
            return super()._normal_work(number)
        return self.free[number].normal_work(self.obstacle_forces()[number], self.positions)

    def step_work(self) -> tuple[float, float]:
        """With the work of gravity, and of other obstacles' motion, on free ones (collective)."""
        work, lost = super().step_work()
        if self.comm.rank == 0:
            for number, each in self.free.items():
                ends = self._kinematics.start_posed[number].pose, each.posed.pose
                work += each.body.gravity_potential(ends[0])[0] - each.body.gravity_potential(ends[1])[0]
                work += each.obstacle_pairs.work(ends[1], self._kinematics.posed, self._kinematics.increments)
        return work, lost

    # --- how far Newton's method may go ---

    def _obstacle_increments(self, moved: Values) -> list[Values]:
        """As Newton's method moves them together with the points (collective)."""
        ways, found = super()._obstacle_increments(moved), self.obstacle_forces()
        if self._held_fraction:
            return ways
        if self._free_system is not None:
            every = self._free_system.predict_increments(
                dict(enumerate(found)), self._all_surroundings(), moved, exact=self._tangent_is_exact
            )
            for number, q in every.items():
                ways[number] = q
            return ways
        for number, each in self.free.items():
            ways[number] = each.predict_increment(
                found[number], self._surroundings(number), moved, exact=self._tangent_is_exact
            )
        return ways

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess that has passed through nothing on its way from the start: free obstacles stop,
        or the body with them, before they meet (collective)."""
        u, level = super().feasible_guess(u), self._level
        self._reset_equilibrium()
        for each in self.free.values():
            each.discard_predictor()
        if not level.dt:
            return u
        x = self.surface.positions(level.u_n)
        moved = self.surface.positions(level.displacement_at_end(u)) - x
        share, taken = 1.0, {}
        for number, each in self.free.items():
            taken[number], free = self._first_guess(each, self._surroundings_at(number, x), moved)
            share = min(share, free)
        if self._free_system is not None:
            share = min(share, self._free_system.safe_guess(taken))
        for number, z in taken.items():
            self.free[number].move_to(share * z)
        self._update_kinematics()
        return u if share == 1 else np.asarray(level.u_n + share * (u - level.u_n))

    def _first_guess(self, each: CondensedPose, around: BodySurroundings, moved: Values) -> tuple[Values, float]:
        """Where one goes by itself, stays or is taken along by another one, whichever is free first, and the share of
        that way that closes no gap, with points that go by `moved` (n, d) (collective)."""
        others = self._kinematics.full_motions()
        along = [each.carried_by(way) for _, way in others.values() if way.any()]
        ways = [each.step.free_flight, 0 * each.step.free_flight, *along]
        first = 0.0
        for z in ways:
            share = each.safe_fraction(around, moved, z, others)
            if share == 1:
                return z, 1.0
            first = min(first, share) if first else share
        return ways[0], first

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap is open with the body at u, those between obstacles as well (collective)."""
        placed = self._kinematics.posed
        apart = all(each.obstacle_pairs.are_open(each.posed.pose, placed) for each in self.free.values())
        return super().is_feasible(u) and apart and (self._free_system is None or self._free_system.are_open())

    def remaining_motion(self) -> float:
        """And that of free ones which are held back (collective)."""
        if self._is_first_evaluation:
            self.obstacle_forces()
        return max(super().remaining_motion(), self._held_fraction)

    def continue_motion(self) -> None:
        """Free obstacles as well (collective)."""
        super().continue_motion()
        if self._held_fraction:
            self.obstacle_forces()
            self._approach_equilibrium()
            self._update_kinematics()
            self._contact_forces = None

    def _advance_obstacles(self, x: Values) -> None:
        """As far as free obstacles let others."""
        rest, still = self._kinematics.remaining_motions(), np.zeros_like(self._kinematics.increments[0])
        shares = [each.obstacle_pairs.safe_fraction(each.posed.pose, still, rest) for each in self.free.values()]
        self._kinematics.advance(
            x, self._kinematics.prescribed_motions(self._facets_for), self.surface.min_fraction, min(shares)
        )
        self._contact_forces = self._equilibrium_positions = None

    def restrict_motion(self) -> None:
        """All stay where the step began (collective)."""
        for each in self.free.values():
            each.return_to_start()
        self._update_kinematics()
        self._reset_equilibrium()
        super().restrict_motion()


def _same(x: Values, before: Values | None) -> bool:
    return before is not None and np.array_equal(x, before)
