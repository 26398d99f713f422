"""What touches in a step: points of the body (contact_surface), obstacles on their ways (step_limit), and what friction
holds."""

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
from .friction import CoulombFriction
from .laws import ObstacleLaw
from .node_contact import ContactForces, LaggedContact, StepStart, evaluate_points, lag_contact, no_contact
from .obstacle import RigidObstacle
from .pose import PosedShape, min_distance
from .step_limit import ObstacleKinematics, check_obstacles_apart, refuse_overlap

Values = npt.NDArray[np.float64]


class ContactState:
    """Obstacles, and the points that they act on at the end of a step.

    Attributes:
        obstacles: held or driven (or free: free_obstacles).    law: how they act.    skin: what touches them.
        x: (n, d) where its points are at the end of the step that belongs to u, m.
    """

    positions: Values
    _lagged: list[LaggedContact | None]  # what friction holds of each
    _step_starts: list[
        StepStart | None
    ]  # the points before each at the start of the step, where barriers act along the way

    def __init__(self, domain: Domain, u: fem.Function, obstacles: Sequence[RigidObstacle], law: ObstacleLaw) -> None:
        """InputError where the body at rest lies in an obstacle, or a free obstacle in another one (collective)."""
        self.obstacles, self.law, self.surface = tuple(obstacles), law, ContactSurface(domain, law.barrier.width)
        self._kinematics = ObstacleKinematics(self.obstacles, self._prescribed_numbers())
        self._domain, self._u, self._owned = domain, u, domain.node_count * domain.dim
        self.comm = domain.comm
        self._contact_forces: list[ContactForces] | None = None
        self._end, self._dt = -np.inf, 0.0  # s, of the step that is taken or has been
        self._attempts = 0  # of Newton's method in it
        self._tangent_positions: Values | None = None  # places of the points at the last tangent of this attempt
        check_obstacles_apart(self.comm, self.surface.rest_positions, self.obstacles)
        if any(each.free for each in self.obstacles):
            from .initial_overlap import check_free_apart

            check_free_apart(self.obstacles)
        self._facet_obstacles = self._find_facet_obstacles()
        if self._facet_obstacles:
            self._check_facets()

    def _find_facet_obstacles(self) -> list[int]:
        """Numbers of those that facets feel between their corners (collective)."""
        edge, width, every = self.surface.mean_edge_length, self.law.barrier.width, enumerate(self.obstacles)
        return [number for number, each in every if facets_matter(each.shape.min_radius, edge, width)]

    @property
    def mean_edge_length(self) -> float:
        """Of the body's mesh in the mean, m (collective)."""
        return self.surface.mean_edge_length

    @property
    def barrier_width(self) -> float:
        """Of the barrier, m."""
        return self.law.barrier.width

    def points_only_flags(self) -> list[tuple[RigidObstacle, bool]]:
        """Each obstacle, and whether nothing between points feels it."""
        return [(each, number not in self._facet_obstacles) for number, each in enumerate(self.obstacles)]

    def _check_facets(self) -> None:
        """InputError where a facet of the body at rest is cut; what is nearly so waits until there is room
        (collective)."""
        x, placed = self.surface.rest_positions, [each.posed_at(0.0) for each in self.obstacles]
        for number in self._facet_obstacles:
            distances = self.surface.facets.distances(placed[number], x, 0.0)
            refuse_overlap(self.comm, distances, number, self.obstacles[number])
        cuts = self._facet_gap_function(placed)
        assert cuts is not None
        self.surface.exclude_cut_facets(x, cuts)

    def _facets_for(self, number: int) -> ContactFacets | None:
        """Facets that feel an obstacle."""
        return self.surface.facets if number in self._facet_obstacles else None

    def _facet_gap_function(self, placed: Sequence[PosedShape]) -> FacetGapFunction | None:
        """Gaps between facets and the obstacles that they feel, where these are now; None: they feel none."""
        if not self._facet_obstacles:
            return None
        sharp, width = [placed[number] for number in self._facet_obstacles], self.law.barrier.width
        return lambda facets, x: np.asarray(np.min([facets.gaps(each, x, width) for each in sharp], axis=0))

    def _facets_are_open(self, x: Values) -> bool:
        """Whether no facet is cut with points at x (n, d) (collective)."""
        if (cuts := self._facet_gap_function(self._kinematics.posed)) is None:
            return True
        return bool(self.comm.allreduce(bool((cuts(self.surface.facets, x) > 0).all()), op=MPI.LAND))

    def _prescribed_numbers(self) -> list[int]:
        """Numbers of those whose way is known: all that are held or driven."""
        return list(range(len(self.obstacles)))

    def begin_step(self, level: TimeLevel) -> None:
        """Obstacles go to where they are at the end of the step; friction holds what is in touch at its start."""
        self._level, self._contact_forces, self._attempts = level, None, 0
        end = level.t + (1 - level.fraction) * level.dt
        if not level.dt and abs(end - self._end) <= 1e-9 * self._dt:
            return  # a look at what a step has ended with: grips and ways are still those of the step
        self._end, self._dt, self._start_velocity = end, level.dt, level.v_n
        self._place_obstacles(end - level.dt, end)
        self._discard_start()
        if level.dt:
            self._begin_new_step()

    def _place_obstacles(self, start: float, end: float) -> None:
        """Where obstacles are at the ends of a step, s."""
        self._kinematics.begin_step(start, end)

    def _begin_new_step(self) -> None:
        at = self._kinematics.start_posed
        self.surface.release_points(self._level.u_n, partial(min_distance, at), self._facet_gap_function(at))
        x = self.surface.positions(self._level.u_n)
        gaps = [placed.distance(x) for placed in at]
        held = [
            lag_contact(x, gap, self.surface.area, placed, self.law.barrier)
            for gap, placed in zip(gaps, at, strict=True)
        ]
        if self._level.contact_weights.time_averaged:
            self._step_starts = [
                StepStart(gap, each.points, each.normal, each.position) for gap, each in zip(gaps, held, strict=True)
            ]
        self._start_forces = [each.force @ each.normal for each in held]
        for number in self._facet_obstacles:
            found, _ = evaluate_facets(self.surface.facets, at[number], x, self.law.barrier)
            self._start_forces[number] = self._start_forces[number] + found.forces.sum(axis=(0, 1))
            if self.obstacles[number].friction:
                held[number] = add_facet_friction(held[number], found, x)
        self._lagged = [
            each if obstacle.friction else None for each, obstacle in zip(held, self.obstacles, strict=True)
        ]
        self._start_positions = x

    def _discard_start(self) -> None:
        """The points are others than those that the step began with."""
        none = [None] * len(self.obstacles)
        self._lagged, self._step_starts, self._contact_forces, self._tangent_positions = [*none], [*none], None, None

    def _end_displacement(self) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to the current u, m."""
        return self._level.displacement_at_end(self._u.x.array[: self._owned])

    def obstacle_forces(self) -> list[ContactForces]:
        """What each obstacle does at the current u (collective)."""
        if self._contact_forces is None:
            self.positions = self.surface.positions(self._end_displacement())
            self._contact_forces = [
                self._evaluate_obstacle(number, placed) for number, placed in enumerate(self._kinematics.posed)
            ]
        return self._contact_forces

    def _evaluate_obstacle(self, number: int, placed: PosedShape) -> ContactForces:
        """What an obstacle at `placed` does to the points where they are now."""
        if self._is_out_of_range(number, placed):
            return no_contact(self._domain.dim)
        obstacle, held = self.obstacles[number], self._lagged[number]
        rub = CoulombFriction(obstacle.friction, self.law.sticking_speed * self._dt) if held is not None else None
        under, start = self._contact_point_motion(number, placed), self._step_starts[number]
        if start is not None:
            start = start.carried_with(self._kinematics.start_posed[number].pose, placed.pose)
        found = evaluate_points(self.positions, self.surface.area, placed, self.law.barrier, held, rub, under, start)
        if number not in self._facet_obstacles:
            return found
        then = None if start is None else (self._kinematics.start_posed[number], self._start_positions)
        inner, stored = evaluate_facets(self.surface.facets, placed, self.positions, self.law.barrier, then)
        return merge_forces(found, inner, stored)

    def _is_out_of_range(self, number: int, placed: PosedShape) -> bool:
        """Whether an obstacle at `placed` is too far from all points to be felt, and was so as the step began."""
        held, start, width = self._lagged[number], self._step_starts[number], self.law.barrier.width
        if (held is not None and len(held.points)) or (start is not None and len(start.active)):
            return False
        if placed.distance_bound(self.positions) < width:
            return False
        return (
            start is None
            or number not in self._facet_obstacles
            or self._kinematics.start_posed[number].distance_bound(self._start_positions) >= width
        )

    def _contact_point_motion(self, number: int, placed: PosedShape) -> Values:
        """(d,) or (k, d) way in the step of what is under the points that friction holds, m."""
        return np.asarray(self._kinematics.increments[number][: self._domain.dim])

    def nodal_forces(self) -> Values:
        """(owned dofs,) forces of the obstacles on the nodes at the end of the step, N (collective)."""
        forces = np.zeros_like(self.surface.rest_positions)
        for each in self.obstacle_forces():
            forces[each.points] += each.normal + each.friction
        return self.surface.interpolation.assemble_to_nodes(forces)

    def friction_work(self, number: int) -> tuple[float, float]:
        """Work of friction on the body in the step, and what of it an obstacle does by its own way, this rank's share,
        J (collective); the rest is lost."""
        found, held = self.obstacle_forces()[number], self._lagged[number]
        if held is None or not len(held.points):
            return 0.0, 0.0
        force = found.friction[np.searchsorted(found.points, held.points)]
        under = self._contact_point_motion(number, self._kinematics.posed[number])
        return float(np.vdot(force, self.positions[held.points] - held.position)), float((force * under).sum())
