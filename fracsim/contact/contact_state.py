"""State of contact between a body and obstacles in a time step: points, obstacles and lagged friction."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from .contact_surface import ContactSurface, FacetGapFunction
from .facet_contact import ContactFacets, add_facet_friction, evaluate_facets, facets_matter, merge_forces
from .laws import CoulombFriction, ObstacleLaw, tangential
from .node_contact import ContactForces, LaggedContact, StepStart, evaluate_points, lag_contact, no_contact
from .pose import PosedShape, min_distance
from .proximity import ProximityCandidates, ShownCells, outline_radius
from .rigid_obstacles import ObstacleGroup
from .step_limit import check_obstacles_apart, refuse_overlap

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class ContactState:
    """Obstacles, and the points of a body that they act on at the end of a step.

    Attributes:
        group: the obstacles, and what they did to the body in the last step.
        obstacles: these obstacles, which are analytic.
        numbers: their numbers in the study.
        law: contact law.
        barrier_width: gap from which on contact acts, m.
        surface: points of the body that may touch.
        positions: (n, d) positions of these points at the end of the step that belongs to u, m.
    """

    shows_all_cells = False  # whether crack faces far from all obstacles are part of the surface, too
    positions: Values
    _lagged: list[LaggedContact | None]  # contact at the start of the step, one per obstacle with friction
    _step_starts: list[StepStart | None]  # points at the start of the step, where barriers are averaged over it
    _started_near: list[Ints]  # points on which each obstacle acted then

    def __init__(self, domain: Domain, u: fem.Function, group: ObstacleGroup, law: ObstacleLaw) -> None:
        """Raise InputError where the body at rest, or a free obstacle, overlaps an obstacle (collective)."""
        self.group, self.numbers, self.obstacles, self.law = group, group.numbers, group.obstacles, law
        self.barrier_width = law.barrier.width
        self.surface = ContactSurface(domain, law.barrier.width)
        self._shown = ShownCells(domain, law.barrier.width)
        self._pattern: npt.NDArray[np.uint8] = np.zeros(domain.cell_count, np.uint8)
        self._domain, self._u, self._owned = domain, u, domain.node_count * domain.dim
        self.comm = domain.comm
        self._contact_forces: list[ContactForces] | None = None
        self._nodal_forces: Values | None = None  # of the present contact forces
        self._sticking_slips: list[float] | None = None  # m, of each obstacle in the step; None: not known yet
        self._end, self._dt = -np.inf, 0.0  # s, of the current or last step
        self._attempts = 0  # of Newton's method in the step
        self._tangent_positions: Values | None = None  # of the points at the last tangent of this attempt
        items = dict(zip(self.numbers, self.obstacles, strict=True))
        check_obstacles_apart(self.comm, self.surface.rest_positions, items)
        self._facet_obstacles = self._find_facet_obstacles()
        self._point_candidates = ProximityCandidates(self.surface.mean_edge_length)
        if self._facet_obstacles:
            self._check_facets()

    def _find_facet_obstacles(self) -> list[int]:
        """Numbers of obstacles so curved that facets touch them between their nodes (collective)."""
        edge, width = self.surface.mean_edge_length, self.law.barrier.width
        return [
            number
            for number, obstacle in enumerate(self.obstacles)
            if facets_matter(obstacle.shape.min_radius, edge, width)
        ]

    def _check_facets(self) -> None:
        """Raise InputError where an obstacle cuts a facet of the body at rest (collective).

        Facets that are cut only by the smoothing are excluded until there is room.
        """
        posed = self._refuse_cut_facets()
        facet_gaps = self._facet_gap_function(posed)
        assert facet_gaps is not None
        self.surface.exclude_cut_facets(self.surface.rest_positions, facet_gaps)

    def _refuse_cut_facets(self) -> list[PosedShape]:
        """Raise InputError where an obstacle cuts a facet of the body at rest; the obstacles there (collective)."""
        x, posed = self.surface.rest_positions, [obstacle.posed_at(0.0) for obstacle in self.obstacles]
        for number in self._facet_obstacles:
            distances = self.surface.facets.distances(posed[number], x, 0.0)
            refuse_overlap(self.comm, distances, self.numbers[number], self.obstacles[number])
        return posed

    def _facets_for(self, number: int) -> ContactFacets | None:
        """Facets on which an obstacle acts; None if it acts on points alone."""
        return self.surface.facets if number in self._facet_obstacles else None

    def _facet_gap_function(self, posed: Sequence[PosedShape]) -> FacetGapFunction | None:
        """Function for the gaps between facets and obstacles that act on them; None if none does."""
        if not self._facet_obstacles:
            return None
        curved, width = [posed[number] for number in self._facet_obstacles], self.law.barrier.width
        return lambda facets, x: np.asarray(np.min([facets.gaps(shape, x, width) for shape in curved], axis=0))

    def _facets_are_open(self, x: Values) -> bool:
        """Whether no facet is cut with points at x (n, d), m (collective)."""
        if (facet_gaps := self._facet_gap_function(self.group.posed)) is None:
            return True
        return bool(self.comm.allreduce(bool((facet_gaps(self.surface.facets, x) > 0).all()), op=MPI.LAND))

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of the step, and store the contact at its start for friction."""
        self.group.bodies.begin_step(level)
        self._level, self._attempts = level, 0
        self.discard_forces()
        end = level.t + (1 - level.fraction) * level.dt
        if not level.dt and abs(end - self._end) <= 1e-9 * self._dt:
            return  # evaluation of a step's result: lagged contact and motions are still those of the step
        self._end, self._dt, self._start_velocity = end, level.dt, level.v_n
        self._discard_start()
        if level.dt:
            self._begin_new_step()

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Add new crack faces near obstacles to the surface (collective)."""
        self._pattern, u = pattern.copy(), self._end_displacement()
        if self.shows_all_cells or not self._dt:  # before the first step obstacles need not be in place
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
        gaps, facet_gaps = partial(min_distance, posed), self._facet_gap_function(posed)
        self.surface.edges_broke(self._pattern, self._shown.flags, u, gaps, facet_gaps)
        self._discard_start()

    def _show_cells_of_step(self, posed: Sequence[PosedShape]) -> None:
        """Make the surface again if it lacks crack faces that obstacles may reach in the step (collective)."""
        level = self._level
        motion, shift = level.dt * level.v_n, self._max_increment()
        if not self.shows_all_cells and self._shown.update(self._pattern, posed, level.u_n, motion, shift):
            self._rebuild_surface(level.u_n, posed)

    def _max_increment(self) -> float:
        """Largest motion of points of the obstacles in the step, m."""
        d, motions = self._domain.dim, []
        for posed, q in zip(self.group.posed, self.group.increments, strict=True):
            rotation = float(np.linalg.norm(q[d:]))
            motions.append(float(np.linalg.norm(q[:d])) + (rotation and rotation * outline_radius(posed)))
        return max(motions)

    def _begin_new_step(self) -> None:
        posed, barrier = self.group.start_posed, self.law.barrier
        self._show_cells_of_step(posed)
        self.surface.release_points(self._level.u_n, partial(min_distance, posed), self._facet_gap_function(posed))
        x = self.surface.positions(self._level.u_n)
        gaps = [shape.distance(x) for shape in posed]
        lagged = [
            lag_contact(x, gap, self.surface.area, shape, barrier) for gap, shape in zip(gaps, posed, strict=True)
        ]
        if self._level.contact_weights.time_averaged:
            width, area = barrier.width, self.surface.area
            self._started_near = [np.flatnonzero((gap < width) & (area > 0)) for gap in gaps]
            self._step_starts = [
                StepStart(gap, contact.points, contact.normal, contact.position)
                for gap, contact in zip(gaps, lagged, strict=True)
            ]
        self._start_forces = [contact.force @ contact.normal for contact in lagged]
        sum_at_points = None if self.comm.size == 1 else self.surface.sum_at_points
        for number in self._facet_obstacles:
            of_facets, _ = evaluate_facets(self.surface.facets, posed[number], x, barrier)
            self._start_forces[number] = self._start_forces[number] + of_facets.forces.sum(axis=(0, 1))
            if self.obstacles[number].friction:
                lagged[number] = add_facet_friction(lagged[number], of_facets, x, sum_at_points)
        self._lagged = [
            contact if obstacle.friction else None for contact, obstacle in zip(lagged, self.obstacles, strict=True)
        ]
        self._start_positions = x

    def _discard_start(self) -> None:
        """Discard the contact at the start of the step, as the points are no longer the same."""
        none = [None] * len(self.obstacles)
        self._lagged, self._step_starts, self._tangent_positions = [*none], [*none], None
        self._sticking_slips = None
        self.discard_forces()

    def discard_forces(self) -> None:
        """Discard forces, as u or poses have changed."""
        self._contact_forces = self._nodal_forces = None

    def _end_displacement(self) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to the current u, m."""
        return self._level.displacement_at_end(self._u.x.array[: self._owned])

    def obstacle_forces(self) -> list[ContactForces]:
        """Forces of each obstacle at the current u (collective)."""
        if self._contact_forces is None:
            if self._sticking_slips is None:
                self._sticking_slips = self._compute_sticking_slips()
            self.positions = self.surface.positions(self._end_displacement())
            self._contact_forces = [
                self._evaluate_obstacle(number, posed) for number, posed in enumerate(self.group.posed)
            ]
        return self._contact_forces

    def _evaluate_obstacle(self, number: int, posed: PosedShape) -> ContactForces:
        """Forces of an obstacle at a given pose on the points."""
        if self._is_out_of_range(number, posed):
            return no_contact(self._domain.dim, self.law.barrier.width)
        obstacle, lagged = self.obstacles[number], self._lagged[number]
        friction = None
        if lagged is not None and self._sticking_slips is not None:
            friction = CoulombFriction(obstacle.friction, self._sticking_slips[number])
        obstacle_motion, start = self._contact_point_motion(number), self._step_starts[number]
        start_posed, candidates = self.group.start_posed[number], self._candidates(number, posed)
        if start is not None:
            start = start.carried_with(start_posed.pose, posed.pose)
        of_points = evaluate_points(
            self.positions,
            self.surface.area,
            posed,
            self.law.barrier,
            lagged,
            friction,
            obstacle_motion,
            start,
            candidates,
        )
        if number not in self._facet_obstacles:
            return of_points
        facet_start = None if start is None else (start_posed, self._start_positions)
        inner, stored = evaluate_facets(self.surface.facets, posed, self.positions, self.law.barrier, facet_start)
        return merge_forces(of_points, inner, stored)

    def _is_out_of_range(self, number: int, posed: PosedShape) -> bool:
        """Whether an obstacle is too far from all points and facets to act, now and at the start of the step."""
        lagged, width = self._lagged[number], self.law.barrier.width
        if (lagged is not None and len(lagged.points)) or len(self._candidates(number, posed)):
            return False
        if number not in self._facet_obstacles:
            return True
        ends = [(posed, self.positions)]
        if self._step_starts[number] is not None:
            ends.append((self.group.start_posed[number], self._start_positions))
        return not any(len(self.surface.facets.candidates(*end, width)) for end in ends)

    def _candidates(self, number: int, posed: PosedShape) -> Ints:
        """(k,) points on which an obstacle may act, or acted at the start of the step."""
        near, start = self._point_candidates(posed, self.positions, self.law.barrier.width), self._step_starts[number]
        return near if start is None else np.union1d(near, self._started_near[number])

    def _compute_sticking_slips(self) -> list[float]:
        """Slip in the step that counts as sticking, m, at each obstacle (collective)."""
        speeds = np.zeros(len(self.obstacles))
        if self.law.sticking_ratio and any(obstacle.friction for obstacle in self.obstacles):
            velocity = self.surface.interpolation(self._start_velocity)
            for number, lagged in enumerate(self._lagged):
                if lagged is not None and len(lagged.points):
                    relative = velocity[lagged.points] - self.group.bodies.velocity(
                        self.numbers[number], lagged.position
                    )
                    speeds[number] = np.linalg.norm(tangential(lagged.normal, relative), axis=1).max()
            self.comm.Allreduce(MPI.IN_PLACE, speeds, MPI.MAX)
        return [self._dt * max(self.law.sticking_speed, self.law.sticking_ratio * speed) for speed in speeds]

    def _contact_point_motion(self, number: int) -> Values:
        """(d,) motion of an obstacle in the step, or (k, d) of its points in lagged contact, m."""
        if (lagged := self._lagged[number]) is None:
            return np.zeros(self._domain.dim)
        return self.group.bodies.point_motion(self.numbers[number], lagged.obstacle_point)

    def nodal_forces(self) -> Values:
        """(owned dofs,) forces of the obstacles on the nodes at the end of the step, N (collective)."""
        contacts = self.obstacle_forces()
        if self._nodal_forces is None:
            points = np.concatenate([contact.points for contact in contacts])
            forces = np.concatenate([contact.normal + contact.friction for contact in contacts])
            self._nodal_forces = self.surface.interpolation.assemble_points_to_nodes(points, forces[..., None])[:, 0]
        return self._nodal_forces

    def friction_work(self, number: int) -> tuple[float, float]:
        """Work of friction on the body in the step, and the part of it done by the obstacle's own motion.

        The difference is dissipated. Both of this rank, J (collective).
        """
        contact, lagged = self.obstacle_forces()[number], self._lagged[number]
        if lagged is None or not len(lagged.points):
            return 0.0, 0.0
        force = contact.friction[np.searchsorted(contact.points, lagged.points)]
        obstacle_motion = self._contact_point_motion(number)
        motion = self.positions[lagged.points] - lagged.position
        return float(np.vdot(force, motion)), float((force * obstacle_motion).sum())
