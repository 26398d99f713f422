"""State of contact between a body and analytic obstacles in a time step: surface, obstacles and lagged friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from ..array_types import Ints, Pattern, Values
from ..errors import InputError
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from .clearance import Clearance, FollowingPoints, ProximityCandidates, ShapeDistance, outline_radius
from .contact_surface import ContactSurface
from .crack_faces import ShownCells
from .facet_contact import ContactFacets, add_facet_friction, evaluate_facets, facets_matter, merge_forces
from .laws import CoulombFriction, FrictionDirection, GapPotential, ObstacleLaw, tangential
from .node_contact import ContactForces, LaggedContact, StepStart, evaluate_points, lag_contact, no_contact
from .obstacle import RigidObstacle
from .pose import PosedShape
from .rigid_obstacles import ObstacleGroup


def refuse_closed_gaps(comm: MPI.Intracomm, gaps: Values, number: int, obstacle: RigidObstacle) -> None:
    """Raise InputError where a gap (n,) to an obstacle at the start is not positive (collective)."""
    min_gap = comm.allreduce(float(gaps.min(initial=np.inf)), op=MPI.MIN)
    if min_gap <= 0:
        raise InputError(
            f"obstacle.{number}: {obstacle.name} overlaps the body at the start, by {-min_gap:.4g} m; "
            "move it away or make it smaller"
        )


@dataclass(frozen=True)
class StepContact:
    """Contact of an obstacle at the start of a step, on which its forces at the end depend.

    Attributes:
        lagged: contact with which friction is lagged; None: without friction.
        friction: law of friction.
        obstacle_motion: (d,) motion of the obstacle in the step, or (k, d) of its points in lagged contact, m.
        points: points at the start, where the barrier is averaged over the step; None: it is not.
        facets: obstacle and points (n, d) at the start, m, of which facets take their gaps.
    """

    lagged: LaggedContact | None
    friction: CoulombFriction | None
    obstacle_motion: Values
    points: StepStart | None
    facets: tuple[PosedShape, Values] | None

    def select(self, points: Ints) -> StepContact:
        """Contact of points (k,), ascending, which are numbered in this order."""
        lagged, motion = self.lagged, self.obstacle_motion
        if lagged is not None and motion.ndim == 2:
            motion = motion[np.isin(lagged.points, points)]
        return StepContact(
            lagged and lagged.select(points),
            self.friction,
            motion,
            self.points and self.points.select(points),
            self.facets and (self.facets[0], self.facets[1][points]),
        )


def evaluate_contact(
    x: Values,
    area: Values,
    posed: PosedShape,
    barrier: GapPotential,
    start: StepContact,
    facets: ContactFacets | None,
    candidates: Ints | None = None,
    direction: FrictionDirection | None = None,
) -> ContactForces:
    """Forces of an obstacle on points, and on the facets between them.

    Args:
        x: (n, d) positions of the points, m.
        area: (n,) areas of the points, m^2; 0 of those left out.
        posed: the obstacle.
        barrier: b.
        start: contact at the start of the step.
        facets: facets on which the obstacle acts; None: it acts on points alone.
        candidates: (m,) points, ascending, that may be in contact now; None: all.
        direction: of friction, for its tangent; None: the tangent is exact.
    """
    lagged = start.lagged, start.friction, start.obstacle_motion
    of_points = evaluate_points(x, area, posed, barrier, *lagged, start.points, candidates, direction)
    if facets is None:
        return of_points
    return merge_forces(of_points, *evaluate_facets(facets, posed, x, barrier, start.facets))


class ContactState:
    """Obstacles, and the points of a body that they act on at the end of a step.

    Attributes:
        group: the obstacles, which are analytic, and what they did to the body in the last step.
        law: contact law.
        surface: points and facets of the body that may touch.
        positions: (n, d) positions of these points at the end of the step that belongs to u, m.
        level: time level of the current or last step.
        lagged: contact of each obstacle at the start of the step; None: without friction.
        point_candidates: search for points near an obstacle.
        clearance: whether the body is far from the obstacles.
    """

    near_widths = 1.0  # distance, in widths of the barrier, within which an obstacle is not far
    shows_all_cells = False  # whether crack faces far from all obstacles are part of the surface, too
    facets_may_be_cut = False  # by curved obstacles
    positions: Values
    lagged: list[LaggedContact | None]
    level: TimeLevel
    _step_starts: list[StepStart | None]  # points at the start of the step, where barriers are averaged over it

    def __init__(self, domain: Domain, u: fem.Function, group: ObstacleGroup, law: ObstacleLaw) -> None:
        """Raise InputError where the body at rest, or a free obstacle, overlaps an obstacle (collective)."""
        self.group, self.law = group, law
        shapes, edge = [obstacle.shape for obstacle in group.obstacles], domain.mean_edge_length
        curved = [n for n, shape in enumerate(shapes) if facets_matter(shape.min_radius, edge, law.barrier.width)]
        self.surface = ContactSurface(domain, law.barrier.width, curved, facets_may_be_cut=self.facets_may_be_cut)
        self._shown = ShownCells(domain, law.barrier.width)
        self._pattern: Pattern = np.zeros(domain.cell_count, np.uint8)
        self._domain, self._u, self._owned = domain, u, domain.node_count * domain.dim
        self.comm = domain.comm
        self._is_damaged = False
        self._end_u: Values | None = None
        self._far: bool | None = None  # whether all obstacles are, at the current u and poses; None: not known yet
        self._released_at: float | None = None  # start of the step in which crack faces were released last, s
        self._start_is_known = True  # whether the contact at the start of the step is
        distances = [ShapeDistance(obstacle) for obstacle in self.group.obstacles]
        reach = self.near_widths * law.barrier.width
        self.clearance = Clearance(domain, distances, reach, self._following_points, self._hidden_distances)
        self._contact_forces: list[ContactForces] | None = None
        self._nodal_forces: Values | None = None  # of the present contact forces
        self._sticking_slips: list[float] | None = None  # m, of each obstacle in the step; None: not known yet
        self._directions: dict[int, FrictionDirection] = {}  # in this attempt, by the numbers of obstacles
        self._tangent_positions: Values | None = None  # of the points at the last tangent of this attempt
        self.point_candidates = ProximityCandidates(edge)
        self._refuse_contact()

    def _refuse_contact(self) -> None:
        """Raise InputError where the body at rest overlaps an obstacle (collective)."""
        group, x = self.group, self.surface.rest_positions
        posed = [obstacle.posed_at(0.0) for obstacle in group.obstacles]
        for index, shape in enumerate(posed):
            refuse_closed_gaps(self.comm, shape.distance(x), group.numbers[index], group.obstacles[index])
        for index in self.surface.curved:
            distances = self.surface.facets.distances(posed[index], x, 0.0)
            refuse_closed_gaps(self.comm, distances, group.numbers[index], group.obstacles[index])
        self.surface.exclude_cut_facets(posed)

    def facets_for(self, number: int) -> ContactFacets | None:
        """Facets on which an obstacle acts; None if it acts on points alone."""
        return self.surface.facets if number in self.surface.curved else None

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of the step, and store the contact at its start for friction."""
        self.group.bodies.begin_step(level)
        self.level = level
        self.discard_forces()
        if self.group.bodies.evaluates_result:
            return  # lagged contact is still that of the step
        self._start_velocity = level.v_n
        self._discard_start()
        self._start_is_known = not level.dt
        if level.dt and not self._starts_far():
            self._find_start()

    def _starts_far(self) -> bool:
        """Whether all obstacles are far at the start of the step (collective)."""
        return self.clearance.is_far([self.level.u_n], self.group.step_motions)

    def _find_start(self) -> None:
        """Store the contact at the start of the step, if it is not known yet (collective)."""
        if not self._start_is_known:
            self._start_is_known = True
            self._begin_new_step()

    # --- far obstacles ---

    def is_far(self) -> bool:
        """Whether nothing is in contact at the current u, nor was at the start of the step (collective)."""
        if self._far is None:
            self._far = self.clearance.is_far([self.level.u_n, self.end_displacement], self.group.step_motions)
        return self._far

    def evaluate_near(self) -> None:
        """Evaluate forces at the current u as if no obstacle were far, for motions that may come near (collective)."""
        if self.is_far():
            self._far, self._contact_forces = False, None
        self.obstacle_forces()

    def _following_points(self) -> FollowingPoints:
        """Points of this rank."""
        surface, point_map = self.surface, self.surface.point_map
        corners = surface.facets.corners if surface.curved else np.empty((0, self._domain.dim), np.int64)
        may_stay = not surface.is_retracted()
        return FollowingPoints(point_map.rest, point_map.weights, surface.columns, corners, may_stay=may_stay)

    def _hidden_distances(self, u: Values, posed: Sequence[PosedShape]) -> Sequence[float]:
        """Bounds of the distances of crack faces outside the surface from each obstacle, m (collective)."""
        if self.shows_all_cells or not self._is_damaged:
            return [np.inf] * len(posed)
        return self._shown.face_distances(posed, u)

    # --- surface ---

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces near obstacles to the surface (collective)."""
        self._pattern, u = pattern.copy(), self.end_displacement
        self._is_damaged = self.comm.allreduce(bool(pattern.any()), op=MPI.LOR)
        self.clearance.discard()
        if self.shows_all_cells or not self.group.bodies.dt:  # before the first step obstacles need not be in place
            self._shown.show_all()
        elif not self._shown.update(pattern, self.group.posed, u, None, 0.0):
            return
        self._rebuild_surface(u, self.group.posed)

    def _rebuild_surface(self, u: Values, posed: Sequence[PosedShape]) -> None:
        """Make the surface again, with points retracted that would lie in an obstacle (collective).

        Args:
            u: (owned dofs,) displacement, m.
            posed: obstacles at their poses.
        """
        self.clearance.discard()
        self.surface.edges_broke(self._pattern, self._shown.flags, u, posed)
        self._discard_start()

    def _show_cells_of_step(self, posed: Sequence[PosedShape]) -> None:
        """Make the surface again if it lacks crack faces that obstacles may reach in the step (collective)."""
        if self.shows_all_cells:
            return
        level, d, shift = self.level, self._domain.dim, 0.0
        for shape, q in zip(self.group.posed, self.group.increments, strict=True):
            rotation = float(np.linalg.norm(q[d:]))
            shift = max(shift, float(np.linalg.norm(q[:d])) + (rotation and rotation * outline_radius(shape)))
        if self._shown.update(self._pattern, posed, level.u_n, level.dt * level.v_n, shift):
            self._rebuild_surface(level.u_n, posed)

    def _begin_new_step(self) -> None:
        posed, barrier = self.group.start_posed, self.law.barrier
        self._show_cells_of_step(posed)
        u_n = self.level.u_n
        # a step that begins again, as edges broke in it, goes on with the crack faces of its last solution
        if not self.level.starts_at(self._released_at):
            self.surface.release(u_n, posed)
            self._released_at = self.level.start_time
        x = self.surface.positions(u_n)
        gaps = [shape.distance(x) for shape in posed]
        lagged = [
            lag_contact(x, gap, self.surface.area, shape, barrier) for gap, shape in zip(gaps, posed, strict=True)
        ]
        if self.level.contact_weights.time_averaged:
            self._step_starts = [StepStart(gap, contact) for gap, contact in zip(gaps, lagged, strict=True)]
        # for the work of normal forces by the trapezoidal rule
        self._start_forces = [contact.force @ contact.normal for contact in lagged]
        sum_at_points = None if self.comm.size == 1 else self.surface.sum_at_points
        for number in self.surface.curved:
            of_facets, *_ = evaluate_facets(self.surface.facets, posed[number], x, barrier)
            self._start_forces[number] = self._start_forces[number] + of_facets.forces.sum(axis=(0, 1))
            if self.group.obstacles[number].friction:
                lagged[number] = add_facet_friction(lagged[number], of_facets, x, sum_at_points)
        self.lagged = [
            contact if obstacle.friction else None
            for contact, obstacle in zip(lagged, self.group.obstacles, strict=True)
        ]
        self._start_positions = x

    def _discard_start(self) -> None:
        """Discard the contact at the start of the step, as the points are no longer the same."""
        none = [None] * len(self.group.obstacles)
        self.lagged, self._step_starts, self._tangent_positions = [*none], [*none], None
        self._sticking_slips, self._directions = None, {}
        self.discard_forces()

    def discard_forces(self) -> None:
        """Discard all that belongs to the last u and poses."""
        self._contact_forces = self._nodal_forces = self._far = self._end_u = None

    @property
    def end_displacement(self) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to u, m: one array as long as u stays."""
        if self._end_u is None:
            self._end_u = self.level.displacement_at_end(self._u.x.array[: self._owned])
        return self._end_u

    def obstacle_forces(self) -> list[ContactForces]:
        """Forces of each obstacle at the current u; of none that is far (collective)."""
        if self._contact_forces is None:
            if self.is_far():
                none = no_contact(self._domain.dim, self.law.barrier.width)
                self._contact_forces = [none for _ in self.group.obstacles]
                return self._contact_forces
            self._find_start()
            if self._sticking_slips is None:
                self._sticking_slips = self._compute_sticking_slips()
            self.positions = self.surface.positions(self.end_displacement)
            self._contact_forces = [
                self._evaluate_obstacle(number, posed) for number, posed in enumerate(self.group.posed)
            ]
        return self._contact_forces

    def _evaluate_obstacle(self, number: int, posed: PosedShape) -> ContactForces:
        """Forces of an obstacle at a given pose on the points."""
        start = self.step_contact(number)
        if start.friction is not None and start.lagged is not None:
            self._directions.setdefault(number, FrictionDirection(start.friction, start.lagged.normal))
        candidates = self.point_candidates(posed, self.positions, self.law.barrier.width)
        points, facets = (self.positions, self.surface.area), self.facets_for(number)
        direction = self._directions.get(number)
        return evaluate_contact(*points, posed, self.law.barrier, start, facets, candidates, direction)

    def step_contact(self, number: int) -> StepContact:
        """Contact of an obstacle at the start of the step, as its forces at the current pose depend on it."""
        lagged, start, friction, facet_start = self.lagged[number], self._step_starts[number], None, None
        if lagged is not None and self._sticking_slips is not None:
            friction = CoulombFriction(self.group.obstacles[number].friction, self._sticking_slips[number])
        if start is not None:
            start_posed = self.group.start_posed[number]
            start = start.carried_with(start_posed.pose, self.group.posed[number].pose)
            facet_start = start_posed, self._start_positions
        return StepContact(lagged, friction, self.contact_point_motion(number), start, facet_start)

    def _compute_sticking_slips(self) -> list[float]:
        """Slip in the step that counts as sticking, m, at each obstacle (collective)."""
        speeds = np.zeros(len(self.group.obstacles))
        if self.law.sticking_ratio and any(obstacle.friction for obstacle in self.group.obstacles):
            velocity = self.surface.interpolate(self._start_velocity)
            for number, lagged in enumerate(self.lagged):
                if lagged is not None and len(lagged.points):
                    of_obstacle = self.group.bodies.velocity(self.group.numbers[number], lagged.position)
                    relative = velocity[lagged.points] - of_obstacle
                    speeds[number] = np.linalg.norm(tangential(lagged.normal, relative), axis=1).max()
            self.comm.Allreduce(MPI.IN_PLACE, speeds, MPI.MAX)
        return [
            self.group.bodies.dt * max(self.law.sticking_speed, self.law.sticking_ratio * speed) for speed in speeds
        ]

    def contact_point_motion(self, number: int) -> Values:
        """(d,) motion of an obstacle in the step, or (k, d) of its points in lagged contact, m."""
        if (lagged := self.lagged[number]) is None:
            return np.zeros(self._domain.dim)
        return self.group.bodies.point_motion(self.group.numbers[number], lagged.obstacle_point)

    def contact_forces(self) -> Values | None:
        """(owned dofs,) forces of the obstacles on the nodes at the end of the step, N; None: far (collective)."""
        if self.is_far():
            return None
        contacts = self.obstacle_forces()
        if self._nodal_forces is None:
            points = np.concatenate([contact.points for contact in contacts])
            forces = np.concatenate([contact.normal + contact.friction for contact in contacts])
            self._nodal_forces = self.surface.nodal_forces_of(points, forces[..., None])[:, 0]
        return self._nodal_forces
