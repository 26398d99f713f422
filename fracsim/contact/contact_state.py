"""State of contact between a body and obstacles in a time step: points, facets, obstacles and lagged friction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..errors import InputError
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.ghost_exchange import find_saved_keys
from ..mesh.parallel import gather
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.surface_map import SurfaceMap
from ..meshes.topology import row_keys
from .clearance import Clearance, FollowingPoints, ProximityCandidates, ShapeDistance, outline_radius
from .contact_surface import RETRACTION, TINY, ContactSurface, ShownCells, retract_cut_elements
from .facet_contact import FACETS, ContactFacets, add_facet_friction, evaluate_facets, facets_matter, merge_forces
from .laws import CoulombFriction, FrictionDirection, GapPotential, ObstacleLaw, tangential
from .node_contact import ContactForces, LaggedContact, StepStart, evaluate_points, lag_contact, no_contact
from .obstacle import RigidObstacle
from .pose import PosedShape, min_distance
from .rigid_obstacles import ObstacleGroup

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class SurfaceFacets:
    """Facets of a surface before obstacles so curved that they touch facets between their nodes (HistoryTerm).

    Facets of new crack faces without room are excluded.

    Attributes:
        numbers: numbers in their group of the obstacles that act on facets.
    """

    def __init__(
        self, surface: ContactSurface, group: ObstacleGroup, width: float, edge: float, *, may_be_cut: bool
    ) -> None:
        """Raise InputError where an obstacle cuts a facet of the body at rest (collective).

        Args:
            surface: points of the body.
            group: obstacles.
            width: of the barrier, m.
            edge: mean edge length of the mesh, m.
            may_be_cut: whether facets may be cut later on: none is excluded.
        """
        self._surface, self._group, self._width, self._may_be_cut = surface, group, width, may_be_cut
        shapes = [obstacle.shape for obstacle in group.obstacles]
        self.numbers = [n for n, shape in enumerate(shapes) if facets_matter(shape.min_radius, edge, width)]
        self._excluded: Ints = np.empty(0, np.int64)
        # areas and excluded facets for which the active facets were selected, and these
        self._active: tuple[Values, Ints, ContactFacets] | None = None
        if self.numbers:
            self._check_at_rest()

    def _check_at_rest(self) -> None:
        """Refuse facets that are cut; those that are cut only by the smoothing are excluded until there is room."""
        x, group = self._surface.rest_positions, self._group
        posed = [obstacle.posed_at(0.0) for obstacle in group.obstacles]
        for number in self.numbers:
            distances = self.active.distances(posed[number], x, 0.0)
            refuse_closed_gaps(self._surface.comm, distances, group.numbers[number], group.obstacles[number])
        if not self._may_be_cut:
            self._excluded = np.flatnonzero(self.gaps(posed, self._all_facets, x) <= 0)

    @cached_property
    def _all_facets(self) -> ContactFacets:
        return ContactFacets(*self._surface.local.facets(), FACETS.smoothing * self._width)

    @property
    def active(self) -> ContactFacets:
        """Facets of which neither a corner nor the facet itself is excluded (not collective)."""
        cached, area = self._active, self._surface.area
        if cached is None or cached[0] is not area or cached[1] is not self._excluded:
            selected = facets = self._all_facets
            if len(self._excluded) or (area == 0).any():
                active = np.asarray((area > 0)[facets.corners].all(axis=1))
                active[self._excluded] = False
                selected = ContactFacets(facets.corners[active], facets.area[active], facets.smoothing)
            cached = self._active = area, self._excluded, selected
        return cached[2]

    @property
    def excluded_count(self) -> int:
        """Number of excluded facets of this rank."""
        return len(self._excluded)

    def gaps(self, posed: Sequence[PosedShape], facets: ContactFacets, x: Values, reach: float | None = None) -> Values:
        """(m,) least gaps of facets to the curved ones of the obstacles, with points at x (n, d), m; infinite far away.

        `reach`: gap from which on an obstacle is far, m; None: the width of the barrier.
        """
        reach = self._width if reach is None else reach
        return np.asarray(np.min([facets.gaps(posed[n], x, reach) for n in self.numbers], axis=0))

    def are_open(self, posed: Sequence[PosedShape], x: Values) -> bool:
        """Whether no facet is cut with points at x (n, d), m (collective)."""
        if not self.numbers or self._may_be_cut:
            return True
        is_open = bool((self.gaps(posed, self.active, x) > 0).all())
        return bool(self._surface.comm.allreduce(is_open, op=MPI.LAND))

    def separate(self, points: SurfaceMap, surface: DrawnSurface, posed: Sequence[PosedShape]) -> SurfaceMap:
        """Points for output retracted where curved obstacles cut elements (collective)."""
        if not self.numbers:
            return points
        elements = surface.split.elements
        facets = ContactFacets(elements, np.ones(len(elements)), FACETS.smoothing * self._width)
        return retract_cut_elements(points, surface, lambda x: self.gaps(posed, facets, x, 0.0) <= 0)

    # --- new crack faces ---

    def edges_broke(self, add_faces: Callable[[], Ints], u: Values, posed: Sequence[PosedShape]) -> None:
        """Retract new points of facets that would be cut or in contact; exclude facets for which this fails.

        Args:
            add_faces: function that adds new faces to the surface, and returns the keys of the points of old ones.
            u: (owned dofs,) displacement, m.
            posed: obstacles.
        """
        excluded = self._keys(self._excluded)
        old_keys, surface = add_faces(), self._surface
        self.clear_caches()
        if not self.numbers or self._may_be_cut:
            return
        self._excluded, copies = self._find_facets(excluded), surface.local.point_map.copies
        is_new = np.zeros(len(surface.area), bool)
        is_new[copies] = ~np.isin(surface.local.keys[copies], old_keys)
        nodal = surface.interpolation.nodal_values(u)
        for _ in range(RETRACTION.facet_rounds):
            point_map, facets = surface.local.point_map, self.active
            has_new = is_new[facets.corners].any(axis=1)
            too_close = self.gaps(posed, facets, point_map(nodal)) < np.where(has_new, self._width, TINY)
            points = np.unique(facets.corners[too_close])
            points = points[is_new[points] & (point_map.share[points] > RETRACTION.min_arm)]
            if not len(points):
                break
            share = point_map.share.copy()
            share[points] *= RETRACTION.facet_factor
            surface.set_arms(share)
        closed = np.flatnonzero(is_new & (surface.area > 0))
        closed = closed[min_distance(posed, surface.local.point_map(nodal)[closed]) <= 0]
        if len(closed):
            surface.exclude_points(np.union1d(closed, np.flatnonzero(surface.area == 0)))
        self._exclude(np.flatnonzero(self._too_close(is_new, nodal, posed)))

    def release(self, release_points: Callable[[], None], u: Values, posed: Sequence[PosedShape]) -> None:
        """Undo releases of points that bring a facet into contact; include facets not in contact (collective).

        Args:
            release_points: function that releases points of the surface.
            u: (owned dofs,) displacement, m.
            posed: obstacles.
        """
        surface = self._surface
        old_map, excluded = surface.local.point_map, surface.area == 0
        release_points()
        if not self.numbers or self._may_be_cut:
            return
        # Every rank takes part, also those on which nothing has changed.
        point_map, nodal = surface.local.point_map, surface.interpolation.nodal_values(u)
        if point_map is old_map and not excluded.any() and not len(self._excluded):
            return
        moved = (point_map.share != old_map.share) | excluded
        undone = np.unique(self._all_facets.corners[self._too_close(moved, nodal, posed)])
        undone = undone[moved[undone]]
        if len(undone):
            share = point_map.share.copy()
            share[undone] = old_map.share[undone]
            surface.set_arms(share)
        if len(self._excluded):
            gap = self.gaps(posed, self._all_facets, surface.local.point_map(nodal))[self._excluded]
            if (gap >= self._width).any():
                self._excluded = self._excluded[gap < self._width]
        self._exclude(np.flatnonzero(self._too_close(excluded, nodal, posed)))

    def _too_close(self, moved: Flags, u: Values, posed: Sequence[PosedShape]) -> Flags:
        """(m,) facets that are cut, or have a point that has `moved` (n,) and would be in contact; u (nodes, d), m."""
        facets = self._all_facets
        min_gap = np.where(moved[facets.corners].any(axis=1), self._width, TINY)
        return np.asarray(self.gaps(posed, facets, self._surface.local.point_map(u)) < min_gap)

    def _exclude(self, facets: Ints) -> None:
        """Exclude these facets as well."""
        if len(np.setdiff1d(facets, self._excluded)):
            self._excluded = np.union1d(facets, self._excluded)

    def _keys(self, facets: Ints) -> Ints:
        """(k,) keys of facets (k,), of the keys of their corners."""
        if not len(facets):
            return facets
        return row_keys(np.sort(self._surface.local.keys[self._all_facets.corners[facets]], axis=1))

    def _find_facets(self, keys: Ints) -> Ints:
        """Numbers of the facets with `keys` (k,) that this rank has."""
        return np.flatnonzero(np.isin(self._all_keys(), keys)) if len(keys) else keys

    def _all_keys(self) -> Ints:
        return self._keys(np.arange(len(self._all_facets.corners)))

    # --- state ---

    def snapshot(self) -> object:
        """Excluded facets, and the keys of the points of their surface."""
        return self._excluded, self._surface.local.keys

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective); where edges have broken since it stays as it is."""
        excluded, keys = cast("tuple[Ints, Ints]", memory)
        if excluded is not self._excluded and self._surface.has_points(keys):
            self._excluded = excluded

    def to_checkpoint(self) -> dict[str, Values]:
        """Keys of excluded facets, on rank 0 (collective)."""
        gathered = gather(self._surface.comm, self._keys(self._excluded))
        return {} if gathered is None else {"cut_facets": np.concatenate(gathered)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the excluded facets from the keys of a checkpoint (collective)."""
        rows = find_saved_keys(self._surface.comm, self._all_keys(), saved["cut_facets"])
        self._excluded = np.sort(rows[rows >= 0])

    def clear_caches(self) -> None:
        """Discard facets, and candidates among them."""
        vars(self).pop("_all_facets", None)
        self._active = None


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
        surface: points of the body that may touch.
        facets: facets between them.
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
        self.surface = ContactSurface(domain, law.barrier.width)
        self._shown = ShownCells(domain, law.barrier.width)
        self._pattern: npt.NDArray[np.uint8] = np.zeros(domain.cell_count, np.uint8)
        self._domain, self._u, self._owned = domain, u, domain.node_count * domain.dim
        self.comm = domain.comm
        self._is_damaged = False
        self._end_u: Values | None = None
        self._far: bool | None = None  # whether all obstacles are, at the current u and poses; None: not known yet
        self._start_is_known = True  # whether the contact at the start of the step is
        distances = [ShapeDistance(obstacle) for obstacle in self.group.obstacles]
        reach = self.near_widths * law.barrier.width
        self.clearance = Clearance(domain, distances, reach, self._following_points, self._hidden_distances)
        self._contact_forces: list[ContactForces] | None = None
        self._nodal_forces: Values | None = None  # of the present contact forces
        self._sticking_slips: list[float] | None = None  # m, of each obstacle in the step; None: not known yet
        self._directions: dict[int, FrictionDirection] = {}  # in this attempt, by the numbers of obstacles
        self._tangent_positions: Values | None = None  # of the points at the last tangent of this attempt
        for number, obstacle in zip(self.group.numbers, self.group.obstacles, strict=True):
            refuse_closed_gaps(
                self.comm, obstacle.posed_at(0.0).distance(self.surface.rest_positions), number, obstacle
            )
        self.point_candidates = ProximityCandidates(domain.mean_edge_length)
        edge, may_be_cut = domain.mean_edge_length, self.facets_may_be_cut
        self.facets = SurfaceFacets(self.surface, group, law.barrier.width, edge, may_be_cut=may_be_cut)

    def facets_for(self, number: int) -> ContactFacets | None:
        """Facets on which an obstacle acts; None if it acts on points alone."""
        return self.facets.active if number in self.facets.numbers else None

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
        local, dim, area = self.surface.local, self._domain.dim, self.surface.area
        corners = self.facets.active.corners if self.facets.numbers else np.empty((0, dim), np.int64)
        retracted = (area == 0).any() or (local.point_map.share < 1).any() or self.facets.excluded_count
        return FollowingPoints(
            local.point_map.rest, local.point_map.weights, local.columns, corners, may_stay=not retracted
        )

    def _hidden_distances(self, u: Values, posed: Sequence[PosedShape]) -> Sequence[float]:
        """Bounds of the distances of crack faces outside the surface from each obstacle, m (collective)."""
        if self.shows_all_cells or not self._is_damaged:
            return [np.inf] * len(posed)
        return self._shown.face_distances(posed, u)

    # --- surface ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
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
        gaps = partial(min_distance, posed)
        self.clearance.discard()
        self.facets.edges_broke(partial(self.surface.edges_broke, self._pattern, self._shown.flags, u, gaps), u, posed)
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
        self.facets.release(partial(self.surface.release_points, u_n, partial(min_distance, posed)), u_n, posed)
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
        for number in self.facets.numbers:
            of_facets, *_ = evaluate_facets(self.facets.active, posed[number], x, barrier)
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
            velocity = self.surface.interpolation(self._start_velocity)
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
            self._nodal_forces = self.surface.interpolation.assemble_points_to_nodes(points, forces[..., None])[:, 0]
        return self._nodal_forces
