"""Term of the balance for contact of a body with analytic obstacles.

    E(u) = sum over obstacles of  int b(gap(x)) dA  +  sum over points in contact of  mu lambda f0(|s|)

The integral runs over the split surface x(u), each point with its share of the reference area. Forces are those at
the end of the step, u_n + (u - u_n) / share, whatever level the scheme solves at.

Equations: docs/theory.md#contact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from ..mechanics.extra_couplings import CouplingBuilder
from ..mechanics.term import Term
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from ..mesh.split_surface.surface_map import SurfaceMap
from .contact_state import ContactState
from .contact_surface import retract_from_obstacles
from .laws import ObstacleLaw
from .node_contact import ContactForces
from .pose import min_distance
from .pose_derivatives import (
    PoseCoupling,
    PoseDerivatives,
    contact_wrench,
    resultant,
    sum_of_derivatives,
)
from .rigid_obstacles import ObstacleGroup, RigidObstacles
from .step_limit import safe_motion_fractions, stop_before_obstacles

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class ExactTangentPolicy:
    """Motion of points in contact since the last tangent, in barrier widths, below which tangents are exact.

    A tangent without its negative eigenvalues gains less than a digit an iteration to the end. Farther from the
    solution CG may find no solution with them.

    Attributes:
        first_attempt: in the first attempt at a step.
        later_attempts: after Newton's method has failed.
    """

    first_attempt: float = 0.01
    later_attempts: float = 0.001


EXACT_TANGENT = ExactTangentPolicy()


class ObstacleTerm(ContactState, Term):
    """Analytic obstacles that the body cannot penetrate.

    Attributes:
        pose_contact: contact as the obstacles see it.
    """

    name = "obstacles"

    def __init__(
        self, domain: Domain, u: fem.Function, bodies: RigidObstacles, numbers: Sequence[int], law: ObstacleLaw
    ) -> None:
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            bodies: motion of all obstacles.
            numbers: numbers of the analytic ones.
            law: contact law.

        Raises:
            InputError: if the body at rest overlaps an obstacle.
        """
        super().__init__(domain, u, ObstacleGroup(bodies, numbers, self._gap, self._current_force), law)
        # facets after the points that they are made of
        facets = (self.facets,) if self.facets.numbers else ()
        self.parts = (self.surface, *facets, self.group, self.clearance)
        self._has_tangent = False  # in this attempt of Newton's method
        self.pose_contact, self._coupling = PointPoseContact(self), CouplingBuilder(domain)
        self._is_exact: bool | None = None  # whether the tangent at the current u and poses is; None: not known yet

    def update_displacement(self) -> None:
        """Discard forces, as u has changed."""
        self.discard_forces()

    def discard_forces(self) -> None:
        """Discard forces, and whether the tangent is exact, as u or poses have changed."""
        super().discard_forces()
        self._is_exact = None

    # --- forces, tangent and energy ---

    def coupling_matrix(self) -> PETSc.Mat | None:
        """Minus the derivative of the forces; None where nothing is in contact (collective)."""
        self._has_tangent = True
        if self.is_far():
            self._tangent_positions = None
            return None
        contacts, exact = self.obstacle_forces(), self.uses_exact_tangent()
        # the next tangent is exact where points have hardly moved since
        self._tangent_positions = self.positions
        self._update_directions()
        points = np.concatenate([contact.points for contact in contacts])
        if not self.comm.allreduce(len(points)):
            return None
        groups = [(points[:, None], np.concatenate([contact.tangent(exact=exact) for contact in contacts]))]
        for facets in (contact.facets for contact in contacts if contact.facets is not None):
            groups.append((facets.corners, facets.hessian if exact else facets.stiffness))
        matrix = self.surface.stiffness(groups)
        return self._coupling(self.level.contact_weights.factor * matrix, self.surface.local.columns)

    def _update_directions(self) -> None:
        """Take the directions of friction of this iterate, of which the tangent is, as the last ones."""
        for number, direction in self._directions.items():
            if (lagged := self.lagged[number]) is not None:
                motion = self.positions[lagged.points] - lagged.position - self.contact_point_motion(number)
                self._directions[number] = direction.updated(motion)

    def uses_exact_tangent(self) -> bool:
        """Whether the tangent has negative eigenvalues of contact: near the solution (collective)."""
        if self._is_exact is None:
            points, motion = np.concatenate([contact.points for contact in self.obstacle_forces()]), np.inf
            if self.is_far():
                motion = 0.0 if self._has_tangent else np.inf
            elif self._tangent_positions is not None:
                moved = np.linalg.norm((self.positions - self._tangent_positions)[points], axis=1)
                motion = float(moved.max(initial=0.0))
            motion = self.comm.allreduce(motion, op=MPI.MAX)
            first = self._attempts <= 1
            limit = EXACT_TANGENT.first_attempt if first else EXACT_TANGENT.later_attempts
            self._is_exact = bool(motion < limit * self.law.barrier.width) and self.group.bodies.may_use_exact_tangent()
        return self._is_exact

    def begin_solve(self) -> None:
        """Count an attempt of Newton's method; after a failure tangents become exact later."""
        self._tangent_positions, self._is_exact, self._attempts = None, None, self._attempts + 1
        self._directions, self._has_tangent = {}, False

    def stored_energy(self) -> float:
        """Energy of the barriers at the current u, this rank's share, J (collective)."""
        return sum(contact.energy for contact in self.obstacle_forces())

    def potential(self) -> float:
        """Potential of barriers and friction as they enter the residual, this rank's share, J (collective)."""
        potentials = sum(contact.potential for contact in self.obstacle_forces())
        return self.level.contact_weight * self.level.fraction * potentials

    def accept_step(self) -> None:
        """Record forces and work of contact in the step (collective)."""
        group, indices = self.group, range(len(self.obstacles))
        group.friction_loss, group.forces = 0.0, [self._current_force(number) for number in indices]
        group.work = [0.0] * len(self.obstacles)
        for number in indices if not self.is_far() else ():
            on_body, by_obstacle = self._friction_work(number)
            group.work[number] = self._normal_work(number) + by_obstacle
            group.friction_loss += by_obstacle - on_body

    def _friction_work(self, number: int) -> tuple[float, float]:
        """Work of friction on the body in the step, and the part of it done by the obstacle's own motion.

        The difference is dissipated. Both of this rank, J (collective).
        """
        contact, lagged = self.obstacle_forces()[number], self.lagged[number]
        if lagged is None or not len(lagged.points):
            return 0.0, 0.0
        force = contact.friction[np.searchsorted(contact.points, lagged.points)]
        obstacle_motion = self.contact_point_motion(number)
        motion = self.positions[lagged.points] - lagged.position
        return float(np.vdot(force, motion)), float((force * obstacle_motion).sum())

    def _normal_work(self, number: int) -> float:
        """Work of normal forces on the body by the motion of an obstacle in the step, this rank's share, J."""
        end_weight, q = self.level.contact_weights.end_work_share, self.group.increments[number]
        contact, centre = self.obstacle_forces()[number], self.group.posed[number].pose.centre
        end = float(resultant(contact.normal, self.positions[contact.points] - centre) @ q)
        return end_weight * end + (1 - end_weight) * float(self._start_forces[number] @ q[: self._domain.dim])

    # --- step limits ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of a change of u (owned dofs,), m, that leaves a tenth of every gap (collective)."""
        increments, u = self.group.bodies.correction_increments(), self.end_displacement
        change_at_end = np.divide(change, self.level.fraction)
        if self.clearance.is_far([u, u + change_at_end], self.group.motions(increments)):
            return 1.0
        self.evaluate_near()
        motion = self.surface.interpolation(change_at_end)
        by_obstacle = [self._fractions(number, motion, increments.get(n)) for number, n in enumerate(self.numbers)]
        fractions = [values[self.surface.area > 0] for values in by_obstacle]
        return float(min(values.min(initial=1.0) for values in fractions))

    def _fractions(self, number: int, motion: Values, q: Values | None) -> Values:
        """(n,) fractions of the motion (n, d) of points, m, and an increment (p,), None: none, that close no gap."""
        if q is None:
            q = np.zeros_like(self.group.increments[number])
        facets, min_gap = self.facets_for(number), self.obstacle_forces()[number].min_gap
        return safe_motion_fractions(
            self.group.posed[number], self.positions, motion, q, facets, self.point_candidates, min_gap
        )

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess of u, m, that crosses no obstacle on its way from the start (collective)."""
        level = self.level
        if not level.dt or self.clearance.is_far([level.u_n, level.displacement_at_end(u)], self.group.step_motions):
            return u
        self._find_start()
        # free obstacles have a first guess of their own (rigid_pose)
        prescribed = self.group.bodies.prescribed_motions()
        motions = [(*prescribed[n], self.facets_for(i)) for i, n in enumerate(self.numbers) if n in prescribed]
        guess = level.displacement_at_end(u)
        if (end := stop_before_obstacles(self.surface, motions, level.u_n, guess)) is guess:
            return u
        return np.asarray(level.u_n + level.fraction * (end - level.u_n))

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap is open with the body at u (collective)."""
        u_n = self.level.u_n
        if self.clearance.is_far([u_n, self.level.displacement_at_end(u)], self.group.step_motions):
            return True
        x = self.surface.positions(self.level.displacement_at_end(u))
        return self.surface.gaps_are_open(min_distance(self.group.posed, x)) and self.facets.are_open(
            self.group.posed, x
        )

    # --- fracture, and surfaces for output ---

    def gather_separation(self) -> None:
        """Do nothing: obstacles are on all ranks."""

    def separate_surface(self, position: SurfaceMap, elements: Ints, u: Values, t: float) -> SurfaceMap:
        """Retract points of a surface for output that would lie in an obstacle, as those of contact are."""
        all_posed = self.group.bodies.posed_at(t)
        posed = [all_posed[number] for number in self.numbers]
        position = retract_from_obstacles(position, u, partial(min_distance, posed))
        return self.facets.separate(position, elements, u, posed)

    def clear_search(self) -> None:
        """Discard results of searches, which a checkpoint does not hold (not collective)."""
        self.facets.clear_caches()
        self._shown.discard()
        self.discard_forces()

    def destroy(self) -> None:
        """Destroy the objects of PETSc."""
        self.surface.destroy()
        self._coupling.destroy()

    # --- readings ---

    def _current_force(self, number: int) -> Values:
        """(d,) force of the body on an obstacle at the current u, this rank's share, N (collective)."""
        contact = self.obstacle_forces()[number]
        return np.asarray(-(contact.normal + contact.friction).sum(axis=0))

    def _gap(self, number: int) -> float:
        """Least distance between an obstacle and this rank's surface, m; infinite without a surface (collective)."""
        if self.is_far():
            return self.clearance.least_gap(number, self.end_displacement, self.group.posed)
        self.obstacle_forces()
        posed = self.group.posed[number]
        point_gap = self.surface.min_distance(posed.distance(self.positions))
        if (facets := self.facets_for(number)) is None:
            return point_gap
        facet_distances = facets.distances(posed, self.positions, self.law.barrier.width)
        return min(point_gap, float(facet_distances.min(initial=np.inf)))

    def closing_distances(self) -> list[float]:
        """Distance by which each obstacle and the points it pushes would have approached in the step, m (collective).

        It is that of the velocities at the start, without any contact; of this rank's points.
        """
        if self.is_far():
            return [0.0] * len(self.obstacles)
        motion, result = self.group.bodies.dt * self.surface.interpolation(self._start_velocity), list[float]()
        for increment, posed, contact in zip(
            self.group.increments, self.group.posed, self.obstacle_forces(), strict=True
        ):
            # points with a normal force, not with friction alone
            pushed = contact.points[contact.normal.any(axis=1)]
            relative = increment[: self._domain.dim] - motion[pushed]
            approach = np.einsum("ni,ni->n", relative, posed.normal(self.positions[pushed]))
            result.append(float(approach.max(initial=0.0)))
        return result


class PointPoseContact:
    """Contact of the body with analytic obstacles, as the obstacles see it (rigid_obstacles.PoseContact)."""

    allows_exact_tangent = True

    def __init__(self, term: ObstacleTerm) -> None:
        self._term, self.group = term, term.group
        # index of an obstacle, whether exact -> forces that the coupling is of, and the coupling
        self._couplings: dict[tuple[int, bool], tuple[ContactForces, PoseCoupling]] = {}

    def poses_moved(self) -> None:
        """Discard forces, as obstacles have moved."""
        self._term.discard_forces()

    def rest_fraction(self, increments: Mapping[int, Values], u: Values | None) -> float:
        """Fraction of increments (p,) from current poses on which no gap to the body closes (collective).

        `u`: (owned dofs,) displacement of the body at rest, m; None: the current one at the end of the step.
        """
        end = self._term.end_displacement if u is None else u
        if self._term.clearance.is_far([end], self.group.motions(increments)):
            return 1.0
        if u is None:
            self._term.evaluate_near()
        x = self._term.positions if u is None else self._term.surface.positions(u)
        fractions: list[Values] = [np.ones(len(x))]
        for number, n in enumerate(self.group.numbers):
            if n in increments:
                facets = self._term.facets_for(number)
                motion = np.zeros_like(x), increments[n], facets, self._term.point_candidates
                fractions.append(safe_motion_fractions(self.group.posed[number], x, *motion))
        return self._term.surface.min_fraction(np.min(fractions, axis=0))

    def start_fraction(self, number: int, q: Values, u: Values) -> float:
        """Fraction of an increment (p,) of an obstacle and the motion of the body that closes no gap (collective).

        Both from the start of the step; `u`: (owned dofs,) displacement of the level after the motion, m.
        """
        level, index = self._term.level, self.group.numbers.index(number)
        motions = self.group.motions({number: q}, from_start=True)
        if self._term.clearance.is_far([level.u_n, level.displacement_at_end(u)], motions):
            return 1.0
        x = self._term.surface.positions(level.u_n)
        motion = self._term.surface.positions(level.displacement_at_end(u)) - x
        facets = self._term.facets_for(index)
        return self._term.surface.min_fraction(
            safe_motion_fractions(self.group.start_posed[index], x, motion, q, facets, self._term.point_candidates)
        )

    def wrenches(self) -> dict[int, Values]:
        """(p,) force and moment of the body on free obstacles, N and N m, of all ranks (collective)."""
        if not (numbers := self.group.free):
            return {}
        if self._term.is_far():
            return {number: np.zeros(len(self.group.bodies.increments[number])) for number in numbers}
        contacts = self._term.obstacle_forces()
        local = [
            contact_wrench(contacts[index], self._term.positions, self.group.poses[index])
            for index in map(self.group.numbers.index, numbers)
        ]
        return dict(zip(numbers, sum_over_ranks(self._term.comm, np.array(local)), strict=True))

    def pose_derivatives(self, *, exact: bool) -> dict[int, PoseDerivatives]:
        """Energy and derivatives by the poses of free obstacles, of all ranks (collective)."""
        if not (numbers := self.group.free):
            return {}
        if self._term.is_far():
            sizes = [len(self.group.bodies.increments[number]) for number in numbers]
            none = [PoseDerivatives(0.0, np.zeros(size), np.zeros((size, size))) for size in sizes]
            return dict(zip(numbers, none, strict=True))
        local = [self._coupling(self.group.numbers.index(number), exact=exact).derivatives() for number in numbers]
        return dict(zip(numbers, sum_of_derivatives(local, self._term.comm), strict=True))

    def _coupling(self, index: int, *, exact: bool) -> PoseCoupling:
        """Coupling of the points and the pose of an obstacle at the current u and poses (collective)."""
        term, group = self._term, self.group
        contact, cached = term.obstacle_forces()[index], self._couplings.get((index, exact))
        # forces are evaluated anew where u or poses have changed
        if cached is None or cached[0] is not contact:
            poses = group.poses[index], term.lagged[index], group.start_poses[index]
            cached = contact, PoseCoupling(contact, term.positions, *poses, exact=exact)
            self._couplings[index, exact] = cached
        return cached[1]

    def mixed_hessians(self) -> dict[int, Values]:
        """(owned dofs, p) derivatives of minus the nodal forces by poses, of free obstacles in contact (collective)."""
        if not (numbers := self.group.free) or self._term.is_far():
            return {}
        contacts, exact = self._term.obstacle_forces(), self.uses_exact_tangent()
        indices = [self.group.numbers.index(number) for number in numbers]
        touching = sum_over_ranks(self._term.comm, np.array([len(contacts[index].points) for index in indices])) > 0
        interpolation = self._term.surface.interpolation
        return {
            number: interpolation.assemble_points_to_nodes(
                contacts[index].points, self._coupling(index, exact=exact).mixed_hessian()
            )
            for number, index, touches in zip(numbers, indices, touching, strict=True)
            if touches
        }

    def uses_exact_tangent(self) -> bool:
        """Whether the tangent at the current u has negative eigenvalues of contact (collective)."""
        return self._term.uses_exact_tangent()
