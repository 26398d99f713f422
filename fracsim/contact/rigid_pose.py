"""Free obstacles in implicit steps: their poses are unknowns of Newton's method beside the displacement of the body.

A pose z minimises the incremental potential Phi (rigid_body), together with u. Each iteration eliminates the poses from
its linear system (mechanics.eliminated_unknowns) and moves them along with u. With y = s z,

    r_y = dPhi/dz / s,    D = d2Phi/dz2 / s^2,    B = k d2E/dx dz.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from mpi4py import MPI

from ..array_types import Flags, Values
from ..errors import InputError
from ..forms.schemes import Scheme
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .node_contact import PoseDerivatives
from .obstacle import FreeObstacle, RigidMotion, RigidObstacle
from .obstacle_pairs import ObstaclePairs
from .pose import PosedShape, solve_matrix
from .rigid_body import SOLVER, RigidStep, RigidSystem, SystemDerivatives, is_positive_definite
from .rigid_obstacles import Increments, RigidObstacles


class FreePose:
    """Free obstacle in implicit steps.

    Attributes:
        body: the obstacle.
        motion: its state of motion at the start of a step, until that is accepted.
        step: the last step that began.
        z: (k,) increment in the step.
        posed: the obstacle at its current pose.
    """

    step: RigidStep
    z: Values

    def __init__(self, body: FreeObstacle) -> None:
        self.body, self.motion = body, body.start_motion()
        self.posed = PosedShape(body.shape, self.motion.pose)
        self._step_motion: RigidMotion | None = None  # motion with which the step began
        self._solution: Values | None = None  # z of the last solution of this step

    # --- steps ---

    def begin_step(self, step: RigidStep) -> None:
        """Begin a step, or begin it again, at its start."""
        if self._step_motion is not self.motion:
            self._solution = None
        self._step_motion, self.step = self.motion, step
        self.move_to(np.zeros(self.body.motion_basis.shape[1]))

    @property
    def in_step(self) -> bool:
        """Whether the step that began is not accepted yet."""
        return self._step_motion is self.motion

    def move_to(self, z: Values) -> None:
        """Move to the increment z (k,)."""
        self.z, self.posed = z, PosedShape(self.body.shape, self.step.pose(z))

    def end_motion(self, wrench: Values) -> RigidMotion:
        """State of motion at the end of the step; `wrench`: (p,) force and moment on the obstacle, N and N m."""
        self._solution = self.z
        return self.step.end_motion(self.z, wrench)

    def first_guess(
        self, increments: Sequence[Values], safe_fraction: Callable[[Values], float]
    ) -> tuple[Values, float]:
        """First guess of z (k,), and its fraction that closes no gap.

        The first of these without a collision: the last solution of the step, free flight, rest, and motion with a
        driven obstacle. If there is none, a fraction of the first of these.

        Args:
            increments: (p,) of the driven obstacles.
            safe_fraction: z -> fraction on which no gap closes.
        """
        best: tuple[Values, float] | None = None
        for z in self._guesses(increments):
            safe = safe_fraction(z)
            if best is None or safe == 1:
                best = z, safe
            if safe == 1:
                break
        assert best is not None
        return best

    def _guesses(self, increments: Sequence[Values]) -> Iterator[Values]:
        if self._solution is not None:
            yield self._solution
        yield self.step.free_flight
        yield np.zeros_like(self.step.free_flight)
        d = self.posed.pose.dim
        for increment in increments:
            if increment.any():
                yield np.asarray(np.linalg.lstsq(self.body.motion_basis[:d], increment[:d], rcond=None)[0])


@dataclass(frozen=True)
class PoseEquations:
    """Equations of the poses of all free obstacles; K: number of their unknowns.

    Attributes:
        contact: derivatives of contact.
        gradient: (K,) r_y, N and N m.
        hessian: (K, K) second derivatives of Phi, exact or their positive definite part.
    """

    contact: SystemDerivatives
    gradient: Values
    hessian: Values

    @cached_property
    def is_positive(self) -> bool:
        """Whether the second derivatives are positive definite."""
        return is_positive_definite(self.hessian)


@dataclass(frozen=True)
class PoseSystem:
    """Part of the poses in the linear system of an iteration.

    Attributes:
        equations: equations of the poses.
        touching: (K,) whether the obstacle of an unknown is in contact with the body; other columns of B are zero.
        B: (owned dofs, k) columns of these k, N/m and N.
    """

    equations: PoseEquations
    touching: Flags
    B: Values

    @cached_property
    def correction(self) -> Values:
        """(K,) D^-1 r_y, m and rad."""
        return solve_matrix(self.equations.hessian, self.equations.gradient)


class PoseUnknowns:
    """Poses of all free obstacles of a term as unknowns of Newton's method (EliminatingTerm); the same on all ranks.

    Attributes:
        free: free obstacles by their numbers.
        pairs: contact of these with other obstacles.
        has_step: whether a step has begun, and not the evaluation of a state.
    """

    def __init__(
        self, comm: MPI.Intracomm, free: Mapping[int, FreePose], pairs: ObstaclePairs, body: FreeRigidObstacles
    ) -> None:
        """`body`: the term, which has contact of the body with them."""
        self.free, self.pairs, self._comm, self._body, self.has_step = free, pairs, comm, body, False
        # at the current u and poses
        self._equations: dict[bool, PoseEquations] = {}  # whether with exact second derivatives ->
        self._system: PoseSystem | None = None
        self._start: list[Values] = []  # z at the start of the correction
        self._change: list[Values] = []  # of z in the correction

    @property
    def in_step(self) -> bool:
        """Whether a step has begun and is not accepted yet."""
        return self.has_step and all(pose.in_step for pose in self.free.values())

    def discard(self) -> None:
        """Discard equations, as u or poses have changed."""
        self._equations, self._system = {}, None

    def move_to(self, z: Sequence[Values]) -> None:
        """Move all to increments z (k,), in their order."""
        for pose, z_i in zip(self.free.values(), z, strict=True):
            pose.move_to(z_i)
        self._body.poses_moved()

    # --- equations ---

    @property
    def _rigid_system(self) -> RigidSystem:
        return RigidSystem([pose.step for pose in self.free.values()])

    @property
    def _z(self) -> list[Values]:
        return [pose.z for pose in self.free.values()]

    def _contact(self, *, exact: bool) -> SystemDerivatives:
        """Derivatives of all contact at the current poses (collective)."""
        of_body: dict[int, PoseDerivatives] = {}
        for contact in self._body.contacts:
            of_body |= contact.pose_derivatives(exact=exact)
        of_pairs, mixed = self.pairs.derivatives(self._body.posed, exact=exact)
        index = {number: row for row, number in enumerate(self.free)}
        return SystemDerivatives(
            [of_body[number] + of_pairs[number] if number in of_pairs else of_body[number] for number in self.free],
            {(index[i], index[j]): block for (i, j), block in mixed.items()},
        )

    def equations(self, *, exact: bool) -> PoseEquations:
        """Equations at the current u and poses, with exact second derivatives or their positive part (collective)."""
        if exact not in self._equations:
            contact = self._contact(exact=exact)
            parts = self._rigid_system.system(self._z, contact, exact=exact)
            self._equations[exact] = PoseEquations(contact, *parts)
        return self._equations[exact]

    def system(self) -> PoseSystem:
        """Linear system at the current u and poses (collective)."""
        if self._system is None:
            # all are asked, since the question is collective
            equations = self.equations(exact=all([contact.uses_exact_tangent() for contact in self._body.contacts]))
            mixed: dict[int, Values] = {}
            for contact in self._body.contacts:
                mixed |= contact.mixed_hessians()
            touching = np.concatenate([np.full(len(pose.z), number in mixed) for number, pose in self.free.items()])
            columns = [
                pose.step.factor * mixed[number] @ pose.step.pose_jacobian(pose.z)
                for number, pose in self.free.items()
                if number in mixed
            ]
            B = np.concatenate(columns, axis=1) if columns else np.empty((0, 0))
            self._system = PoseSystem(equations, touching, B)
        return self._system

    # --- Newton's method ---

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """B (owned dofs, k) and D^-1 (k, k) of obstacles in contact with the body (collective)."""
        if not self.in_step or not (touching := (system := self.system()).touching).any():
            return []
        compliance: Values = np.asarray(np.linalg.inv(system.equations.hessian), np.float64)
        return [(system.B.copy(), compliance[np.ix_(touching, touching)])]

    def condensed_residual(self) -> Values | None:
        """(owned dofs,) B D^-1 r_y, N; None where no obstacle touches the body (collective)."""
        if not self.in_step or not (system := self.system()).touching.any():
            return None
        return np.asarray(system.B @ system.correction[system.touching])

    def begin_correction(self, change: Values) -> None:
        """Compute the change of z that belongs to a change of u (owned dofs,), m (collective)."""
        system, rigid = self.system(), self._rigid_system
        equations, by_body = system.equations, np.zeros_like(system.equations.gradient)
        if system.touching.any():
            by_body[system.touching] = sum_over_ranks(self._comm, system.B.T @ change)
        dy = -solve_matrix(equations.hessian, equations.gradient + by_body)
        self._start, self._change = self._z, rigid.split(np.asarray(dy / rigid.level, np.float64))

    def increments(self) -> dict[int, Values]:
        """(p,) increments of the poses in the correction, by numbers."""
        items = zip(self.free.items(), self._start, self._change, strict=True)
        return {number: pose.step.pose_change(z, dz) for (number, pose), z, dz in items}

    def move_along(self, fraction: float) -> None:
        """Move to a fraction of the correction."""
        if self.in_step:
            self.move_to([z + fraction * dz for z, dz in zip(self._start, self._change, strict=True)])

    def unknowns_are_solved(self) -> bool:
        """Whether Newton's decrement of the poses is that of a solution (collective)."""
        if not self.in_step:
            return True
        system = self.system()
        scale = self._rigid_system.energy_scale(self._z, system.equations.contact)
        return float(system.equations.gradient @ system.correction) <= SOLVER.solved_decrement * scale

    def solve_unknowns(self) -> None:
        """Minimise Phi over all poses with the body held (collective)."""
        self._leave_for(self._rigid_system.minimise(self._z, self._contact_at, self._free_fraction))

    def _leave_for(self, z: Sequence[Values]) -> None:
        """Move all to increments z (k,), unless they are there."""
        if not all(np.array_equal(pose.z, z_i) for pose, z_i in zip(self.free.values(), z, strict=True)):
            self.move_to(z)

    def _contact_at(self, z: Sequence[Values], exact: bool) -> SystemDerivatives:
        self._leave_for(z)
        return self.equations(exact=exact).contact

    def _free_fraction(self, z: Sequence[Values], dz: Sequence[Values]) -> float:
        """Fraction of the changes dz from z that closes no gap, with the body at rest (collective)."""
        self._leave_for(z)
        items = zip(self.free.items(), z, dz, strict=True)
        increments = {number: pose.step.pose_change(z_i, dz_i) for (number, pose), z_i, dz_i in items}
        return self._body.free_fraction(increments)

    # --- energies ---

    def free_potential(self) -> float:
        """Potential of inertia and weight in the step, J."""
        return sum(pose.step.free_potential(pose.z) for pose in self.free.values())


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
        pairs: ObstaclePairs,
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
        self.parts = (*self.parts, self._unknowns)
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
        self._unknowns.has_step = bool(level.dt)
        if not is_new or not level.dt:
            return
        weights = level.contact_weights
        for number, pose in self.free.items():
            pose.begin_step(
                RigidStep(pose.body, pose.motion, self._scheme, level.dt, level.c_a, level.fraction, weights.factor)
            )
            # an estimate, by which the cells are chosen whose crack faces may be touched
            self.increments[number] = pose.step.increment(pose.step.free_flight)
        self.pairs.begin_step(self, level.dt, time_averaged=weights.time_averaged)
        self._unknowns.discard()

    def update_displacement(self) -> None:
        """Discard the equations of the poses, as u has changed."""
        self._unknowns.discard()

    def accept_step(self) -> None:
        """Give free obstacles their momentum (collective)."""
        of_body = {number: wrench for contact in self.contacts for number, wrench in contact.wrenches().items()}
        of_pairs = self.pairs.wrenches(self.posed)
        for number, pose in self.free.items():
            pose.motion = pose.end_motion(of_body[number] + of_pairs.get(number, 0.0))

    def velocity(self, number: int, x: Values) -> Values:
        """(d,) velocity of an obstacle at the start of the step, or (n, d) of its points at x (n, d), m/s."""
        return self.free[number].step.start_velocity(x) if number in self.free else super().velocity(number, x)

    # --- contact with the body ---

    def poses_moved(self) -> None:
        """Take over the poses of free obstacles."""
        for number, pose in self.free.items():
            self.posed[number] = pose.posed
            self.increments[number] = pose.step.increment(pose.z)
        self._tell_moved()

    def _tell_moved(self) -> None:
        self._unknowns.discard()
        super()._tell_moved()

    def may_use_exact_tangent(self) -> bool:
        """Whether exact tangents of contact leave the equations of the poses positive definite (collective)."""
        if not self._unknowns.in_step:
            return True
        allowed = all(contact.allows_exact_tangent for contact in self.contacts)
        return allowed and self._unknowns.equations(exact=True).is_positive

    def correction_increments(self) -> Increments:
        """Increments of free poses in a correction of Newton's method."""
        return self._unknowns.increments()

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
        for pose in self.free.values():
            start, end = pose.step.start.pose, pose.posed.pose
            work += pose.body.gravity_potential(start) - pose.body.gravity_potential(end)
        return work, dissipated

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
        # one fraction for all, and for the body: each guess was tested against the whole motion of the others
        fraction = min(self.pairs.safe_fraction(motions), *(safe for _, safe in guesses.values()))
        self._unknowns.move_to([fraction * z for z, _ in guesses.values()])
        return u if fraction == 1 else np.asarray(level.u_n + fraction * (u - level.u_n))

    def _first_guess(self, number: int, u: Values) -> tuple[Values, float]:
        """First guess (k,) of an increment, and its fraction that closes no gap with the body on its way to u."""
        pose, prescribed = self.free[number], self.prescribed_motions()
        contacts = [contact for contact in self.contacts if number in contact.group.numbers]

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
