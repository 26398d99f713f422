"""Terms of the balance for contact with analytic obstacles of which some are free rigid bodies.

In implicit steps the poses of free obstacles are unknowns of Newton's method beside u (rigid_pose). All ranks have the
same poses, from sums over all ranks.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..forms.schemes import Scheme
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .laws import ObstacleLaw
from .node_contact import ContactForces
from .obstacle import FreeMotions, FreeObstacle, PlaceableObstacle, RigidMotion, RigidObstacle
from .obstacle_pairs import ObstaclePairs
from .obstacle_term import ObstacleTerm
from .pose import PosedShape
from .pose_derivatives import (
    PoseDerivatives,
    contact_wrench,
    point_pose_hessian,
    pose_derivatives,
    resultant,
    sum_of_derivatives,
)
from .rigid_body import RigidStep
from .rigid_pose import FreePose, PoseUnknowns
from .step_limit import safe_motion_fractions

Values = npt.NDArray[np.float64]


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
        pairs: contact of these with other obstacles.
    """

    leaves_tangent_incomplete = True
    free: dict[int, FreePose]

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[RigidObstacle], law: ObstacleLaw, scheme: Scheme
    ) -> None:
        """Raise InputError where the body at rest overlaps an obstacle (collective)."""
        numbered = dict(enumerate(obstacles))
        self.free = {n: FreePose(obstacle) for n, obstacle in numbered.items() if isinstance(obstacle, FreeObstacle)}
        self._scheme, self.pairs = scheme, ObstaclePairs(numbered, law.barrier)
        self._unknowns = PoseUnknowns(domain.comm, self.free, self.pairs, self)
        super().__init__(domain, u, obstacles, law)

    # --- steps ---

    def _begin_new_step(self) -> None:
        super()._begin_new_step()
        level, weights = self._level, self._level.contact_weights
        for number, pose in self.free.items():
            pose.begin_step(
                RigidStep(pose.body, pose.motion, self._scheme, level.dt, level.c_a, level.fraction, weights.factor)
            )
            self._kinematics.increments[number] = pose.step.increment(pose.step.free_flight)
        self.pairs.begin_step(self._kinematics.start_posed, time_averaged=weights.time_averaged)
        self.poses_moved()

    def accept_step(self) -> None:
        """Record contact in the step, and give free obstacles their momentum (collective)."""
        super().accept_step()
        contacts, of_pairs = self.obstacle_forces(), self.pairs.wrenches(self.posed())
        for number, pose in self.free.items():
            of_body = contact_wrench(contacts[number], self.positions, pose.posed.pose)
            wrench = sum_over_ranks(self.comm, of_body) + of_pairs.get(number, 0.0)
            pose.motion = pose.end_motion(wrench)

    # --- contact of the body with free obstacles (rigid_pose.BodyContact) ---

    def posed(self) -> list[PosedShape]:
        """All obstacles at their current poses."""
        return self._kinematics.posed

    def poses_moved(self) -> None:
        """Take over the poses of free obstacles, and discard forces."""
        for number, pose in self.free.items():
            self._kinematics.posed[number] = pose.posed
        self.discard_forces()

    def discard_forces(self) -> None:
        """Discard forces and the equations of the poses, as u or poses have changed."""
        super().discard_forces()
        self._unknowns.discard()

    def pose_derivatives(self) -> dict[int, PoseDerivatives]:
        """Energy and derivatives by the pose of each free obstacle, of all ranks (collective)."""
        contacts = self.obstacle_forces()
        local = [
            pose_derivatives(
                contacts[number], self.positions, pose.posed.pose, self._lagged[number], pose.step.start.pose
            )
            for number, pose in self.free.items()
        ]
        return dict(zip(self.free, sum_of_derivatives(local, self.comm), strict=True))

    def mixed_hessians(self) -> dict[int, Values]:
        """(owned dofs, p) derivatives of minus the nodal forces by the pose, of obstacles in contact (collective)."""
        contacts, exact = self.obstacle_forces(), self.uses_exact_tangent()
        counts = sum_over_ranks(self.comm, np.array([len(contacts[number].points) for number in self.free]))
        touching = [number for number, count in zip(self.free, counts, strict=True) if count]
        return {number: self._mixed_hessian(number, contacts[number], exact=exact) for number in touching}

    def _mixed_hessian(self, number: int, contact: ContactForces, *, exact: bool) -> Values:
        pose = self.free[number]
        by_pose = point_pose_hessian(
            contact, self.positions, pose.posed.pose, self._lagged[number], pose.step.start.pose, exact=exact
        )
        return self.surface.interpolation.assemble_points_to_nodes(contact.points, by_pose)

    def free_fraction(self, increments: Mapping[int, Values]) -> float:
        """Fraction of increments (p,) of free poses on which no gap to the body at rest closes (collective)."""
        self.obstacle_forces()
        at_rest = 0 * self.positions
        fractions: list[Values] = [np.ones(len(self.positions))]
        for number, q in increments.items():
            posed = self._kinematics.posed[number]
            facets = self._facets_for(number)
            fractions.append(safe_motion_fractions(posed, self.positions, at_rest, q, facets, self._point_candidates))
        return self.surface.min_fraction(np.min(fractions, axis=0))

    def _may_be_exact(self) -> bool:
        """Whether the exact second derivative by the poses is positive definite (collective)."""
        return not self._in_step() or self._unknowns.equations().exact_is_positive

    def _in_step(self) -> bool:
        """Whether a step has begun and is not accepted yet."""
        return bool(self._level.dt) and self._unknowns.in_step

    def _contact_point_motion(self, number: int, posed: PosedShape) -> Values:
        lagged = self._lagged[number]
        if number not in self.free or lagged is None:
            return super()._contact_point_motion(number, posed)
        return self.free[number].contact_point_motion(lagged, posed)

    def _obstacle_velocity(self, number: int, x: Values) -> Values:
        return (
            self.free[number].step.start_velocity(x) if number in self.free else super()._obstacle_velocity(number, x)
        )

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
        """Potential of contact, with inertia and weight of free obstacles on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            of_pairs = self.pairs.energies(self.posed())[1]
            energy += self._unknowns.free_potential() + level.contact_weight * level.fraction * of_pairs
        return energy

    def stored_energy(self) -> float:
        """Energy of all barriers, those between obstacles on rank 0, J (collective)."""
        energy = super().stored_energy()
        return energy if self.comm.rank else energy + self.pairs.energies(self.posed())[0]

    def _normal_work(self, number: int) -> float:
        if number not in self.free:
            return super()._normal_work(number)
        pose, contact = self.free[number], self.obstacle_forces()[number]
        force = resultant(contact.normal, self.positions[contact.points] - pose.posed.pose.centre)
        return float(force @ pose.step.increment(pose.z))

    def step_work(self) -> tuple[float, float]:
        """Work of obstacles' own motion, of gravity and other obstacles on free ones; dissipation (collective)."""
        work, dissipation = super().step_work()
        if self.comm.rank == 0:
            work += self._unknowns.gravity_work() + self.pairs.work(self.posed(), self._kinematics.increments)
        return work, dissipation

    # --- step limits ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of a correction of u (owned dofs,), m, and poses that leaves a tenth of every gap (collective)."""
        between = self._unknowns.fraction_between_obstacles(self._unknowns.increments())
        return min(super().max_step_fraction(change), between)

    def _obstacle_increments(self) -> list[Values]:
        """(p,) increments of the poses in a correction."""
        increments = super()._obstacle_increments()
        for number, q in self._unknowns.increments().items():
            increments[number] = q
        return increments

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess without a collision: obstacles stop before they meet, or the body (collective)."""
        u, level = super().feasible_guess(u), self._level
        if not level.dt:
            return u
        x = self.surface.positions(level.u_n)
        motion = self.surface.positions(level.displacement_at_end(u)) - x
        guesses = {number: self._first_guess(number, x, motion) for number in self.free}
        motions = {n: (self.free[n].start_posed, self.free[n].step.increment(z)) for n, (z, _) in guesses.items()}
        fraction = min(self.pairs.safe_fraction(motions), *(safe for _, safe in guesses.values()))
        self._unknowns.move_to([fraction * z for z, _ in guesses.values()])
        return u if fraction == 1 else np.asarray(level.u_n + fraction * (u - level.u_n))

    def _first_guess(self, number: int, x: Values, motion: Values) -> tuple[Values, float]:
        """First guess (k,) of an increment, and its fraction that closes no gap (collective).

        Args:
        number: of the free obstacle.
        x: (n, d) points of the body at the start of the step, m.
        motion: (n, d) of the points, m.
        """
        pose, prescribed = self.free[number], self._kinematics.full_motions()

        def safe_fraction(z: Values) -> float:
            start, q = pose.start_posed, pose.step.increment(z)
            of_points = safe_motion_fractions(start, x, motion, q, self._facets_for(number), self._point_candidates)
            of_pairs = self.pairs.safe_fraction(prescribed | {number: (start, q)})
            return min(of_pairs, self.surface.min_fraction(of_points))

        return pose.first_guess([increment for _, increment in prescribed.values()], safe_fraction)

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap is open with the body at u, also between obstacles (collective)."""
        return super().is_feasible(u) and self.pairs.are_open(self.posed())

    def _advance_obstacles(self, x: Values) -> None:
        """Advance prescribed obstacles as far as the body and free obstacles allow."""
        remaining, at_rest = self._kinematics.remaining_motions(), np.zeros_like(self._kinematics.increments[0])
        fraction = self.pairs.safe_fraction(remaining | {n: (pose.posed, at_rest) for n, pose in self.free.items()})
        motions = self._kinematics.prescribed_motions(self._facets_for)
        self._kinematics.advance(x, motions, self.surface.min_fraction, fraction)
        self.discard_forces()

    def restrict_motion(self) -> None:
        """Hold all obstacles at the start of the step (collective)."""
        self._unknowns.move_to([0 * pose.z for pose in self.free.values()])
        super().restrict_motion()
