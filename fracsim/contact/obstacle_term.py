"""Term of the balance for contact of a body with analytic obstacles.

    E(u) = sum over obstacles of  int b(gap(x)) dA  +  sum over points in contact of  mu lambda f0(|s|)

The integral runs over the split surface x(u), each point with its share of the reference area. Forces are those at
the end of the step, u_n + (u - u_n) / share, whatever level the scheme solves at.

Equations: docs/theory.md#contact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..array_types import Ints, Values
from ..mechanics.extra_couplings import CouplingBuilder
from ..mechanics.term import Term
from ..mechanics.term_protocols import ContactPatchValues
from ..mesh.domain import Domain
from ..mesh.ghost_exchange import KeyLookup
from ..mesh.parallel import allgather, sum_over_ranks
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.surface_map import SurfaceMap, nodal_stiffness
from .contact_state import ContactState, evaluate_contact
from .facet_contact import ContactFacets
from .laws import BARRIER, ObstacleLaw
from .node_contact import ContactForces, PoseCoupling, PoseDerivatives, contact_wrench
from .pose import resultant
from .rigid_obstacles import ObstacleGroup, PoseContact, RigidObstacles
from .step_limit import PoseMotion, safe_motion_fractions, stop_before_obstacles


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
        super().__init__(
            domain, u, ObstacleGroup(bodies, numbers, law.barrier.width, self._gap, self._current_force), law
        )
        self.pose_contact, self._coupling = PoseContact(self), CouplingBuilder(domain)
        self.parts = (self.surface, self.group, self.clearance, self.pose_contact)
        self._has_tangent = False  # in this attempt of Newton's method
        # index of an obstacle, whether exact -> forces that a coupling with its pose is of, and the coupling
        self._couplings: dict[tuple[int, bool], tuple[ContactForces, PoseCoupling]] = {}
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
        if not self.comm.allreduce(sum(len(contact.points) for contact in contacts)):
            return None
        matrix = nodal_stiffness(self.surface.point_map.weights, stiffness_blocks(contacts, exact=exact))
        return self._coupling(self.level.contact_weights.factor * matrix, self.surface.columns)

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
            is_near = motion < BARRIER.exact_tangent * self.law.barrier.width
            self._is_exact = bool(is_near) and self.group.bodies.may_use_exact_tangent()
        return self._is_exact

    def begin_solve(self) -> None:
        """Discard the last tangent, as an attempt of Newton's method begins."""
        self._tangent_positions = self._is_exact = None
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
        group, indices = self.group, range(len(self.group.obstacles))
        group.friction_loss, group.forces = 0.0, [self._current_force(number) for number in indices]
        group.work = [0.0] * len(self.group.obstacles)
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

    def safe_fraction(self, u: Values, change: Values | None, moving: Mapping[int, PoseMotion]) -> float:
        """Fraction of motions of the body and of obstacles that leaves a tenth of every gap (collective).

        Args:
            u: (owned dofs,) displacement at the start, m.
            change: (owned dofs,) of it, m; None: the body is at rest.
            moving: motions of obstacles by their indices; others are not looked at.
        """
        if self.clearance.is_far([u] if change is None else [u, u + change], self.group.motions(moving)):
            return 1.0
        is_current = u is self.end_displacement
        if is_current:
            self.evaluate_near()
        x = self.positions if is_current else self.surface.positions(u)
        motion = np.zeros_like(x) if change is None else self.surface.interpolate(change)
        fractions: list[Values] = [np.ones(len(x))]
        for index, (posed, q) in moving.items():
            # gaps of the current forces are those at the current poses
            min_gap = self.obstacle_forces()[index].min_gap if is_current else 0.0
            limits = self.facets_for(index), self.point_candidates, min_gap
            fractions.append(safe_motion_fractions(posed, x, motion, q, *limits))
        return self.surface.min_fraction(np.min(fractions, axis=0))

    def patch(self, nodes: Ints) -> ObstaclePatch:
        """Contact of nodes (k,), by their ascending global numbers, that move from the current u (collective)."""
        return ObstaclePatch(self, nodes)

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess of u, m, that crosses no obstacle on its way from the start (collective)."""
        level = self.level
        if not level.dt or self.clearance.is_far([level.u_n, level.displacement_at_end(u)], self.group.step_motions):
            return u
        self._find_start()
        # free obstacles have a first guess of their own (rigid_pose)
        prescribed = self.group.bodies.prescribed_motions()
        motions = [(*prescribed[n], self.facets_for(i)) for i, n in enumerate(self.group.numbers) if n in prescribed]
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
        return self.surface.is_open(self.group.posed, x)

    # --- contact as the obstacles see it (PoseContact) ---

    allows_exact_tangent = True

    def poses_moved(self) -> None:
        """Discard forces, as obstacles have moved."""
        self.discard_forces()

    def rank_wrench(self, index: int) -> Values:
        """(p,) force and moment on an obstacle, of this rank, N and N m (collective)."""
        return contact_wrench(self.obstacle_forces()[index], self.positions, self.group.poses[index])

    def rank_derivatives(self, index: int, *, exact: bool) -> PoseDerivatives:
        """Energy and derivatives by the pose of an obstacle, of this rank (collective)."""
        return self._pose_coupling(index, exact=exact).derivatives()

    def rank_mixed_hessian(self, index: int) -> Values:
        """(k, d, p) derivatives of minus the forces on points by the pose of an obstacle, of this rank (collective)."""
        return self._pose_coupling(index, exact=self.uses_exact_tangent()).mixed_hessian()

    def assemble_mixed_hessian(self, index: int, part: Values) -> Values:
        """(owned dofs, p) sums at the nodes of what `rank_mixed_hessian` returned (collective)."""
        return self.surface.nodal_forces_of(self.obstacle_forces()[index].points, part)

    def _pose_coupling(self, index: int, *, exact: bool) -> PoseCoupling:
        """Coupling of the points and the pose of an obstacle at the current u and poses (collective)."""
        contact, cached = self.obstacle_forces()[index], self._couplings.get((index, exact))
        # forces are evaluated anew where u or poses have changed
        if cached is None or cached[0] is not contact:
            poses = self.group.poses[index], self.lagged[index], self.group.start_poses[index]
            cached = contact, PoseCoupling(contact, self.positions, *poses, exact=exact)
            self._couplings[index, exact] = cached
        return cached[1]

    # --- fracture, and surfaces for output ---

    def separate_surface(self, points: SurfaceMap, surface: DrawnSurface, u: Values, t: float) -> SurfaceMap:
        """Retract points of a surface for output that would lie in an obstacle, as those of contact are."""
        all_posed = self.group.bodies.posed_at(t)
        return self.surface.separate(points, surface, [all_posed[number] for number in self.group.numbers])

    def clear_search(self) -> None:
        """Discard results of searches, which a checkpoint does not hold (not collective)."""
        self.surface.clear_search()
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

    def pushed_points(self) -> list[tuple[Values, Values, Values]]:
        """(k, d) points of this rank in contact with each obstacle, m, normal forces, N, start velocities, m/s."""
        velocity = self.surface.interpolate(self._start_velocity)
        contacts = self.obstacle_forces()
        return [(self.positions[contact.points], contact.normal, velocity[contact.points]) for contact in contacts]


def stiffness_blocks(contacts: Sequence[ContactForces], *, exact: bool) -> list[tuple[Ints, Values]]:
    """(k, c) points and (k, c d, c d) minus the derivatives of their forces, N/m: of points, and of facets."""
    points = np.concatenate([contact.points for contact in contacts])
    groups = [(points[:, None], np.concatenate([contact.tangent(exact=exact) for contact in contacts]))]
    for facets in (contact.facets for contact in contacts if contact.facets is not None):
        groups.append((facets.corners, facets.hessian if exact else facets.stiffness))
    return groups


# --- few nodes that move while all others stay, for nonlinear elimination (docs/theory.md#newtons-method) ---


class ObstaclePatch:
    """Potential of the contact of k nodes that move by w (k, d), m, with all others fixed (ContactPatch).

    A point is x = x_0 + W w / f, with the part f of the step that has passed at the displacement. Obstacles stay. The
    potential is that of the points that follow these nodes, and of all corners of facets with such a point: others add
    a constant. Each rank evaluates its points, and all have the sums.
    """

    def __init__(self, term: ObstacleTerm, nodes: Ints) -> None:
        """Choose the points that follow nodes (k,), by their ascending global numbers (collective)."""
        term.evaluate_near()
        self._level, self._comm, self._barrier, surface = term.level, term.comm, term.law.barrier, term.surface
        weights = _columns_of(nodes, surface.point_map.weights, surface.columns)
        moves = np.diff(weights.indptr) > 0
        used, facets = moves.copy(), None
        if surface.curved:
            active = surface.facets
            chosen = moves[active.corners].any(axis=1)
            corners = active.corners[chosen]
            used[corners] = True
            facets = ContactFacets((np.cumsum(used) - 1)[corners], active.area[chosen], active.smoothing)
        points, self._at_rest = np.flatnonzero(used), np.zeros_like(term.group.increments[0])
        self._start, self._area, self._weights = term.positions[points], surface.area[points], weights[points]
        self._contacts = [
            (posed, term.step_contact(number).select(points), facets if number in surface.curved else None)
            for number, posed in enumerate(term.group.posed)
        ]

    def _positions(self, w: Values) -> Values:
        """(n, d) positions of its points, m."""
        return np.asarray(self._start + self._weights @ w / self._level.fraction)

    def evaluate(self, w: Values) -> ContactPatchValues:
        """Potential at w (k, d), m, with its derivatives (collective)."""
        x, level = self._positions(w), self._level
        contacts = [
            evaluate_contact(x, self._area, posed, self._barrier, start, facets)
            for posed, start, facets in self._contacts
        ]
        forces = np.zeros(x.shape)
        for contact in contacts:
            forces[contact.points] -= contact.normal + contact.friction
        potential = sum_over_ranks(self._comm, np.array([sum(contact.potential for contact in contacts)]))
        gradient = sum_over_ranks(self._comm, self._weights.T @ forces)
        blocks = nodal_stiffness(self._weights, stiffness_blocks(contacts, exact=True))
        stiffness, weight = sum(allgather(self._comm, blocks)), level.contact_weight
        return ContactPatchValues(
            weight * level.fraction * float(potential[0]), weight * gradient, level.contact_weights.factor * stiffness
        )

    def free_fraction(self, w: Values, step: Values) -> float:
        """Fraction in [0, 1] of a step (k, d), m, from w (k, d) that leaves a tenth of every gap (collective)."""
        x, motion, fraction = self._positions(w), np.asarray(self._weights @ step / self._level.fraction), 1.0
        for posed, _, facets in self._contacts:
            fractions = safe_motion_fractions(posed, x, motion, self._at_rest, facets)
            fraction = min(fraction, float(fractions[self._area > 0].min(initial=1.0)))
        return float(self._comm.allreduce(fraction, op=MPI.MIN))


def _columns_of(nodes: Ints, weights: csr_matrix, numbers: Ints) -> csr_matrix:
    """(n, k) columns of nodes (k,) in weights (n, m), whose columns are of nodes with global `numbers` (m,)."""
    rows = KeyLookup(numbers)(nodes)
    present = np.flatnonzero(rows >= 0)
    selection = np.ones(len(present)), (rows[present], present)
    return weights @ csr_matrix(selection, shape=(len(numbers), len(nodes)))
