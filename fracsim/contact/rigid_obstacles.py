"""Rigid obstacles of a study: their motion in a step, and terms of the balance for free ones.

    RigidObstacles         held and driven obstacles: motion prescribed, or restricted to a part of it
    FreeRigidObstacles     with free ones in implicit steps: poses are unknowns of Newton's method (rigid_pose)
    VerletRigidObstacles   with free ones in explicit steps: velocity Verlet

Terms of contact have the obstacles' poses from here. Inertia, weight and contact between obstacles are in these terms.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..forms.schemes import Scheme
from ..mechanics.term import Term, TimeLevel
from ..mechanics.term_protocols import SurfaceData
from ..mesh.domain import Domain
from .node_contact import LaggedContact
from .obstacle import FreeMotions, FreeObstacle, MovingObstacle, RigidMotion, RigidObstacle, VerletObstacle
from .obstacle_pairs import AllPairs
from .obstacle_tessellation import ObstacleTessellations
from .pose import PosedShape
from .pose_derivatives import PoseDerivatives
from .rigid_body import RigidStep
from .rigid_pose import FreePose, PoseUnknowns
from .step_limit import PoseMotion

if TYPE_CHECKING:
    from .penalty_obstacle_pairs import PenaltyPair

Values = npt.NDArray[np.float64]

type Increments = Mapping[int, Values]  # (p,) of poses, by the numbers of obstacles


class ObstacleContactTerm(Protocol):
    """Contact of the body with some obstacles, as the obstacles see it.

    Attributes:
        numbers: numbers of these obstacles.
        allows_exact_tangent: whether tangents are exact near the solution.
    """

    numbers: tuple[int, ...]
    allows_exact_tangent: bool

    def poses_moved(self) -> None:
        """Take over the poses of obstacles, and discard forces (not collective)."""

    def rest_fraction(self, increments: Increments, u: Values | None) -> float:
        """Fraction of increments from the current poses on which no gap to the body closes (collective).

        `u`: (owned dofs,) displacement of the body at rest, m; None: the current one at the end of the step.
        """

    def start_fraction(self, number: int, q: Values, u: Values) -> float:
        """Fraction of an increment (p,) of an obstacle and the motion of the body that closes no gap (collective).

        Both from the start of the step; `u`: (owned dofs,) displacement of the level after the motion, m.
        """

    def wrenches(self, numbers: Sequence[int]) -> Increments:
        """(p,) force and moment of the body on obstacles at the current u, N and N m, of all ranks (collective)."""

    def pose_derivatives(self, numbers: Sequence[int], *, exact: bool) -> Mapping[int, PoseDerivatives]:
        """Energy and derivatives by poses, of all ranks (collective)."""

    def mixed_hessians(self, numbers: Sequence[int]) -> Increments:
        """(owned dofs, p) d2E/dx dq by the increments q of poses, of obstacles in contact (collective)."""

    def uses_exact_tangent(self) -> bool:
        """Whether the tangent at the current u has negative eigenvalues of contact (collective)."""


class RigidObstacles(Term):
    """Held and driven obstacles.

    Attributes:
        obstacles: all obstacles of the study, by their numbers.
        free: free ones by their numbers.
        prescribed: numbers of those with a prescribed motion.
        posed: obstacles at their current poses.
        start_posed: obstacles at the start of the step.
        increments: (p,) increment of each pose in the step.
    """

    name = "rigid"
    obstacles: tuple[RigidObstacle, ...]
    free: Mapping[int, MovingObstacle]
    posed: list[PosedShape]
    start_posed: list[PosedShape]
    increments: list[Values]

    def __init__(
        self, domain: Domain, obstacles: Sequence[RigidObstacle], free: Mapping[int, MovingObstacle] | None = None
    ) -> None:
        """`obstacles`: by their numbers in the study; `free`: free ones, None: there are none."""
        self.comm, self.dim, self.obstacles, self.free = domain.comm, domain.dim, tuple(obstacles), free or {}
        self.prescribed = [number for number in range(len(obstacles)) if number not in self.free]
        self._contacts: list[ObstacleContactTerm] = []
        self._tessellations = ObstacleTessellations(self.obstacles, domain.bounds.lower, domain.bounds.upper)
        self._level: TimeLevel | None = None
        self._end, self._dt = -np.inf, 0.0  # s, of the current or last step
        self._travelled = 1.0  # fraction of the prescribed motion
        self._place(0.0, 0.0)

    def add_contact(self, contact: ObstacleContactTerm) -> None:
        """Add contact of the body with some of the obstacles."""
        self._contacts.append(contact)

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of a step; contact terms call it first, and it acts once."""
        if level is self._level:
            return
        self._level = level
        end = level.t + (1 - level.fraction) * level.dt
        if not level.dt and abs(end - self._end) <= 1e-9 * self._dt:
            return  # evaluation of a step's result: motions are still those of the step
        self._end, self._dt = end, level.dt
        self._place(end - level.dt, end)

    def _place(self, start: float, end: float) -> None:
        """Place obstacles at the times of the start and the end of a step, s."""
        self._travelled = 1.0
        self.posed = [obstacle.posed_at(end) for obstacle in self.obstacles]
        self.start_posed = [obstacle.posed_at(start) for obstacle in self.obstacles]
        self.increments = [obstacle.pose_increment(start, end) for obstacle in self.obstacles]
        for number, obstacle in self.free.items():
            shape = self.obstacles[number].shape
            self.posed[number] = self.start_posed[number] = PosedShape(shape, obstacle.motion.pose)

    def posed_at(self, t: float) -> list[PosedShape]:
        """Each obstacle at the time t of the state, s (not collective)."""
        return self._motions.place([obstacle.posed_at(t) for obstacle in self.obstacles])

    def output_surfaces(self, t: float) -> dict[str, SurfaceData]:
        """Tessellation of each obstacle at the time t of the state, s, by its name."""
        return self._tessellations(self.posed_at(t))

    def potential(self) -> float:
        """Potential of their motion, J: prescribed obstacles have none."""
        return 0.0

    # --- states of motion of free obstacles, and their columns ---

    @property
    def _motions(self) -> FreeMotions:
        return FreeMotions(self.free, self.comm.rank == 0)

    def _wrenches(self) -> dict[int, Values]:
        """(p,) force and moment of the body on each free obstacle, N and N m, of all ranks (collective)."""
        result = {number: np.zeros_like(self.increments[number]) for number in self.free}
        for contact in self._contacts:
            result |= contact.wrenches([number for number in self.free if number in contact.numbers])
        return result

    def kinetic_energy(self) -> float:
        """Kinetic energy of the free obstacles, on rank 0, J."""
        return self._motions.kinetic_energy()

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """Columns of the motion of free obstacles (FreeMotions.columns)."""
        return self._motions.columns()

    def minimum_columns(self) -> dict[str, Callable[[], float]]:
        """No columns."""
        return {}

    def work_columns(self) -> dict[str, Callable[[], float]]:
        """No columns."""
        return {}

    def snapshot(self) -> object:
        """States of motion."""
        return self._motions.snapshot()

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self._motions.restore(cast("dict[int, RigidMotion]", memory))

    def to_checkpoint(self) -> dict[str, Values]:
        """Rows of states of motion."""
        return self._motions.to_checkpoint() if self.free else {}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set states of motion from the rows of a checkpoint."""
        self._motions.from_checkpoint(saved)
        self._motions.place(self.posed)
        self._tell_moved()

    # --- motion of points of obstacles ---

    def contact_point_motion(self, number: int, lagged: LaggedContact) -> Values:
        """(d,) motion of an obstacle in the step to its current pose, or (k, d) of its points in lagged contact, m."""
        return np.asarray(self.increments[number][: self.dim])

    def point_motion(self, number: int, x: Values) -> Values:
        """(d,) motion of an obstacle in the step, or (n, d) of its points that were at x (n, d), m."""
        return np.asarray(self.increments[number][: self.dim])

    def velocity(self, number: int, x: Values) -> Values:
        """(d,) velocity of an obstacle at the start of the step, or (n, d) of its points at x (n, d), m/s."""
        return np.asarray(self.increments[number][: self.dim] / self._dt)

    def correction_increments(self) -> Increments:
        """Increments of free poses in a correction of Newton's method."""
        return {}

    def may_use_exact_tangent(self) -> bool:
        """Whether exact tangents of contact leave the equations of the poses positive definite (collective)."""
        return True

    # --- restriction of the prescribed motion ---

    def prescribed_motions(self) -> dict[int, PoseMotion]:
        """Full motion of each prescribed obstacle in the step, by its number."""
        return {number: (self.start_posed[number], self.increments[number]) for number in self.prescribed}

    def restrict_motion(self) -> None:
        """Hold obstacles where they would meet the body at the step's start (collective).

        A part that is jammed between an obstacle and something else cannot be moved along by a first guess.
        """
        assert self._level is not None
        self._move_prescribed(0.0)
        self._advance(self._level.u_n)

    def remaining_motion(self) -> float:
        """Fraction of the prescribed motion that remains in the step."""
        return 1.0 - self._travelled

    def continue_motion(self) -> None:
        """Advance restricted obstacles as far as the body at the current u allows (collective)."""
        if self._travelled < 1:
            self._advance(None)

    def _advance(self, u: Values | None) -> None:
        """Advance prescribed obstacles as far as the body and free obstacles at rest allow (collective)."""
        remaining = 1.0 - self._travelled
        increments = {number: remaining * self.increments[number] for number in self.prescribed}
        fraction = min(self._rest_fraction(increments, u), self._fraction_between(increments))
        self._move_prescribed(1.0 if fraction == 1 else self._travelled + fraction * remaining)

    def _rest_fraction(self, increments: Increments, u: Values | None) -> float:
        """Fraction of increments on which no gap to the body at rest closes, as of ObstacleContactTerm (collective)."""
        fractions = [
            contact.rest_fraction({number: q for number, q in increments.items() if number in contact.numbers}, u)
            for contact in self._contacts
        ]
        return min(fractions, default=1.0)

    def _fraction_between(self, increments: Increments) -> float:
        """Fraction of increments from current poses on which no gap between obstacles closes."""
        return 1.0

    def _move_prescribed(self, travelled: float) -> None:
        """Move prescribed obstacles to a fraction of their motion in the step."""
        self._travelled = travelled
        for number in self.prescribed:
            start = self.start_posed[number]
            pose = start.pose.incremented(travelled * self.increments[number])
            self.posed[number] = PosedShape(start.shape, pose)
        self._tell_moved()

    def _tell_moved(self) -> None:
        for contact in self._contacts:
            contact.poses_moved()


class FreeRigidObstacles(RigidObstacles):
    """Obstacles of which some are free, in implicit steps.

    Attributes:
        free: free obstacles by their numbers.
        pairs: contact of these with other obstacles.
    """

    leaves_tangent_incomplete = True
    free: dict[int, FreePose]

    def __init__(
        self,
        domain: Domain,
        obstacles: Sequence[RigidObstacle],
        scheme: Scheme,
        pairs: AllPairs,
    ) -> None:
        """Build the term.

        Args:
            domain: mesh of the body.
            obstacles: by their numbers in the study.
            scheme: of time integration.
            pairs: contact between obstacles.

        Raises:
            InputError: if a free obstacle overlaps another one.
        """
        free = {n: FreePose(obstacle) for n, obstacle in enumerate(obstacles) if isinstance(obstacle, FreeObstacle)}
        self.pairs, self._scheme = pairs, scheme
        self._unknowns = PoseUnknowns(domain.comm, free, self.pairs, self)
        super().__init__(domain, obstacles, free)
        if not self.pairs.are_open(self.posed):
            names = " or ".join(pose.body.name for pose in free.values())
            raise InputError(
                f"{names} moves freely and overlaps another obstacle at the start; move it away or make it smaller"
            )

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of a step, free ones to its start."""
        is_new = level is not self._level
        super().begin_step(level)
        if not is_new or not level.dt:
            return
        weights = level.contact_weights
        for number, pose in self.free.items():
            pose.begin_step(
                RigidStep(pose.body, pose.motion, self._scheme, level.dt, level.c_a, level.fraction, weights.factor)
            )
            self.increments[number] = pose.step.increment(pose.step.free_flight)
        self.pairs.begin_step(self, level.dt, time_averaged=weights.time_averaged)
        self._unknowns.discard()

    def update_displacement(self) -> None:
        """Discard the equations of the poses, as u has changed."""
        self._unknowns.discard()

    def accept_step(self) -> None:
        """Give free obstacles their momentum (collective)."""
        of_body, of_pairs = self._wrenches(), self.pairs.wrenches(self.posed)
        for number, pose in self.free.items():
            pose.motion = pose.end_motion(of_body[number] + of_pairs.get(number, 0.0))

    @property
    def _in_step(self) -> bool:
        """Whether a step has begun and is not accepted yet."""
        return self._level is not None and bool(self._level.dt) and self._unknowns.in_step

    # --- motion of points of obstacles ---

    def contact_point_motion(self, number: int, lagged: LaggedContact) -> Values:
        """(d,) motion of an obstacle in the step to its current pose, or (k, d) of its points in lagged contact, m."""
        if number not in self.free:
            return super().contact_point_motion(number, lagged)
        return self.free[number].contact_point_motion(lagged)

    def velocity(self, number: int, x: Values) -> Values:
        """(d,) velocity of an obstacle at the start of the step, or (n, d) of its points at x (n, d), m/s."""
        return self.free[number].step.start_velocity(x) if number in self.free else super().velocity(number, x)

    # --- contact with free obstacles (rigid_pose.BodyContact) ---

    def poses_moved(self) -> None:
        """Take over the poses of free obstacles."""
        for number, pose in self.free.items():
            self.posed[number] = pose.posed
            self.increments[number] = pose.step.increment(pose.z)
        self._tell_moved()

    def _tell_moved(self) -> None:
        self._unknowns.discard()
        super()._tell_moved()

    def pose_derivatives(self, *, exact: bool) -> dict[int, PoseDerivatives]:
        """Energy and derivatives of contact with the body by the pose of each free obstacle (collective)."""
        result: dict[int, PoseDerivatives] = {}
        for contact in self._contacts:
            numbers = [number for number in self.free if number in contact.numbers]
            result |= contact.pose_derivatives(numbers, exact=exact)
        return result

    def mixed_hessians(self) -> dict[int, Values]:
        """(owned dofs, p) second derivatives by nodes and the poses of obstacles in contact (collective)."""
        result: dict[int, Values] = {}
        for contact in self._contacts:
            result |= contact.mixed_hessians([number for number in self.free if number in contact.numbers])
        return result

    def uses_exact_tangent(self) -> bool:
        """Whether the tangents of all contact have negative eigenvalues (collective)."""
        return all([contact.uses_exact_tangent() for contact in self._contacts])

    def may_use_exact_tangent(self) -> bool:
        """Whether exact tangents of contact leave the equations of the poses positive definite (collective)."""
        if not self._in_step:
            return True
        allowed = all(contact.allows_exact_tangent for contact in self._contacts)
        return allowed and self._unknowns.equations(exact=True).is_positive

    def free_fraction(self, increments: Increments) -> float:
        """Fraction of increments of free poses on which no gap closes, the body at rest (collective)."""
        return min(self._rest_fraction(increments, None), self._fraction_between(increments))

    # --- unknowns of Newton's method (EliminatingTerm) ---

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """B (owned dofs, k) and D^-1 (k, k) of obstacles in contact with the body (collective)."""
        return self._unknowns.low_rank_updates() if self._in_step else []

    def condensed_residual(self) -> Values | None:
        """(owned dofs,) B D^-1 r_y, N; None where no obstacle touches the body (collective)."""
        return self._unknowns.condensed_residual() if self._in_step else None

    def begin_correction(self, change: Values) -> None:
        """Compute the change of the poses that belongs to a change of u (owned dofs,), m (collective)."""
        self._unknowns.begin_correction(change)

    def correction_increments(self) -> Increments:
        """Increments of free poses in a correction of Newton's method."""
        return self._unknowns.increments()

    def move_along(self, fraction: float) -> None:
        """Move free obstacles to a fraction of the correction."""
        self._unknowns.move_along(fraction)

    def unknowns_are_solved(self) -> bool:
        """Whether the poses are a solution (collective)."""
        return not self._in_step or self._unknowns.are_solved()

    def solve_unknowns(self) -> None:
        """Solve for the poses with the body held (collective)."""
        self._unknowns.solve()

    # --- energies ---

    def potential(self) -> float:
        """Potential of inertia, weight and contact between obstacles, on rank 0, J."""
        if self.comm.rank or self._level is None or not self._level.dt:
            return 0.0
        weight = self._level.contact_weight * self._level.fraction
        return self._unknowns.free_potential() + weight * self.pairs.energies(self.posed)[1]

    def stored_energy(self) -> float:
        """Energy of the barriers between obstacles, on rank 0, J."""
        return 0.0 if self.comm.rank else self.pairs.energies(self.posed)[0]

    def step_work(self) -> tuple[float, float]:
        """Work of gravity and prescribed obstacles on free ones, and dissipation between obstacles, on rank 0, J."""
        if self.comm.rank:
            return 0.0, 0.0
        work, dissipated = self.pairs.work(self.posed, self.increments)
        return self._unknowns.gravity_work() + work, dissipated

    # --- step limits ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of the correction on which no gap between obstacles closes."""
        return self._fraction_between(self._unknowns.increments())

    def _fraction_between(self, increments: Increments) -> float:
        at_rest = np.zeros_like(self.increments[0])
        motions = {number: (posed, increments.get(number, at_rest)) for number, posed in enumerate(self.posed)}
        return self.pairs.safe_fraction(motions)

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess of u, m, with poses that meet neither the body nor one another (collective)."""
        level = self._level
        if level is None or not level.dt:
            return u
        guesses = {number: self._first_guess(number, u) for number in self.free}
        motions = self.prescribed_motions()
        motions |= {n: (self.start_posed[n], self.free[n].step.increment(z)) for n, (z, _) in guesses.items()}
        fraction = min(self.pairs.safe_fraction(motions), *(safe for _, safe in guesses.values()))
        self._unknowns.move_to([fraction * z for z, _ in guesses.values()])
        return u if fraction == 1 else np.asarray(level.u_n + fraction * (u - level.u_n))

    def _first_guess(self, number: int, u: Values) -> tuple[Values, float]:
        """First guess (k,) of an increment, and its fraction that closes no gap with the body on its way to u."""
        pose, prescribed = self.free[number], self.prescribed_motions()
        contacts = [contact for contact in self._contacts if number in contact.numbers]

        def safe_fraction(z: Values) -> float:
            q = pose.step.increment(z)
            between = self.pairs.safe_fraction(prescribed | {number: (self.start_posed[number], q)})
            return min(between, *(contact.start_fraction(number, q, u) for contact in contacts))

        return pose.first_guess([increment for _, increment in prescribed.values()], safe_fraction)

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap between obstacles is open."""
        return self.pairs.are_open(self.posed)

    def restrict_motion(self) -> None:
        """Hold all obstacles at the start of the step (collective)."""
        self._unknowns.move_to([0 * pose.z for pose in self.free.values()])
        super().restrict_motion()


class VerletRigidObstacles(RigidObstacles):
    """Obstacles of which some are free, in explicit steps; between these and others a penalty acts, with friction.

    Attributes:
        free: free obstacles by their numbers.
    """

    free: dict[int, VerletObstacle]

    def __init__(self, domain: Domain, obstacles: Sequence[RigidObstacle], pairs: Sequence[PenaltyPair]) -> None:
        """`obstacles`: by their numbers in the study; `pairs`: of free ones and others."""
        numbered = enumerate(obstacles)
        free = {n: VerletObstacle(obstacle) for n, obstacle in numbered if isinstance(obstacle, FreeObstacle)}
        self._contact_work = dict.fromkeys(free, 0.0)  # of the body on each in the last step, J
        self._pairs = pairs
        super().__init__(domain, obstacles, free)

    def _place(self, start: float, end: float) -> None:
        super()._place(start, end)
        if end > start:
            for number, obstacle in self.free.items():
                self.posed[number] = obstacle.begin_step(end - start)

    def accept_step(self) -> None:
        """Give free obstacles their momentum (collective)."""
        increments = list(self.increments)
        for number, obstacle in self.free.items():
            increments[number] = obstacle.increment
        work_of_pairs = dict.fromkeys(range(len(self.obstacles)), 0.0)
        of_pairs = [np.zeros_like(q) for q in increments]
        for pair in self._pairs:
            pair.end_step(self.start_posed, self.posed, increments)
            for number, wrench, work in zip(pair.numbers, pair.forces.wrenches, pair.work, strict=True):
                of_pairs[number] += wrench
                work_of_pairs[number] += work
        for number, of_body in self._wrenches().items():
            work = self.free[number].end_step(self.posed[number], of_body + of_pairs[number])
            self._contact_work[number] = work - work_of_pairs[number]

    def stored_energy(self) -> float:
        """Energy of penalty and springs between obstacles at the end of the last step, on rank 0, J."""
        energies = [pair.forces.penalty_energy + pair.forces.spring_energy for pair in self._pairs]
        return 0.0 if self.comm.rank else sum(energies)

    # --- state: of motion, and contacts between obstacles ---

    def snapshot(self) -> object:
        """States of motion, and contacts at the end of the last step."""
        return super().snapshot(), [pair.snapshot() for pair in self._pairs]

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        motions, contacts = cast("tuple[object, list[object]]", memory)
        super().restore(motions)
        for pair, contact in zip(self._pairs, contacts, strict=True):
            pair.restore(contact)

    def to_checkpoint(self) -> dict[str, Values]:
        """Rows of states of motion, and contacts at the end of the last step."""
        arrays = super().to_checkpoint()
        for index, pair in enumerate(self._pairs):
            arrays |= pair.to_checkpoint(f"_{index}")
        return arrays

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set states of motion and contacts from the arrays of a checkpoint."""
        super().from_checkpoint(saved)
        for index, pair in enumerate(self._pairs):
            pair.from_checkpoint(saved, f"_{index}")

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all near points were in contact, 1/s^2.

        With the largest eigenvalues l_i, l_j of M^-1 K of both obstacles of a pair it is at most the largest sum of
        l_i + sqrt(l_i l_j) over the pairs of an obstacle (Gershgorin's bound for blocks).
        """
        sums = dict.fromkeys(self.free, 0.0)
        for pair in self._pairs:
            if (springs := pair.contacts.near_springs(pair.poses(self.posed))) is None:
                continue
            squares = {
                number: obstacle.max_frequency(obstacle.spring_stiffness(*springs, posed), posed)
                for number in pair.numbers
                if number in self.free
                for obstacle, posed in [(self.free[number], self.posed[number])]
            }
            coupling = float(np.sqrt(np.prod(list(squares.values())))) if len(squares) == 2 else 0.0
            for number, square in squares.items():
                sums[number] += square + coupling
        return max(sums.values())

    def work_on_body(self, number: int) -> float:
        """Work of a free obstacle on the body in the last step, on rank 0, J."""
        return 0.0 if self.comm.rank else -self._contact_work[number]

    def point_motion(self, number: int, x: Values) -> Values:
        """(d,) motion of an obstacle in the step, or (n, d) of its points that were at x (n, d), m."""
        if number not in self.free:
            return super().point_motion(number, x)
        return self.free[number].contact_point_motion(x, self.posed[number])

    def step_work(self) -> tuple[float, float]:
        """Work of gravity and prescribed obstacles on free ones, and dissipation between obstacles, on rank 0, J."""
        if self.comm.rank:
            return 0.0, 0.0
        items = [(number, work) for pair in self._pairs for number, work in zip(pair.numbers, pair.work, strict=True)]
        by_prescribed = -sum(work for number, work in items if number not in self.free)
        by_gravity = sum(obstacle.gravity_work for obstacle in self.free.values())
        return by_gravity + by_prescribed, sum(pair.dissipated for pair in self._pairs)
