"""Terms of the balance for contact with analytic obstacles in explicit steps: a penalty in place of the barrier.

    E(u) = sum over obstacles of  sum over points in contact of  k_p (d - gap)^2 / 2 + k_p |s|^2 / 2

and where an obstacle is round, of the deepest points of facets off crack faces (facet_contact, with k_f in place of
areas). d is the gap below which the penalty acts, k_p the stiffness of a point, s the stretch of the spring of
friction. k_p = kappa A_p / d, A_p the share of the point in the surface, but at most `max_added` M_p, M_p its share of
its nodes' mass. So contact adds at most `max_added` to the square of the body's highest frequency, from which the step
is taken.
Forces at the end of a step are those that the next one starts with; the work of both is summed by the trapezoidal rule,
as in velocity Verlet.

Coulomb friction: each point in contact has a spring that slips when it pulls harder than mu N (Cundall and Strack 1979,
A discrete numerical model for granular assemblies). So a body at rest on a slope stays; with friction that depends on
the velocity alone it would creep.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..mesh.domain import Domain
from ..mesh.ghost_exchange import KeyLookup, find_saved_keys
from ..mesh.parallel import gather, max_over_ranks, sum_over_ranks
from .facet_contact import ContactFacets, evaluate_facets, merge_forces
from .laws import ObstacleLaw, Penalty, slipped, tangential
from .node_contact import ContactForces
from .obstacle import VerletObstacle
from .obstacle_term import ObstacleTerm
from .penalty_law import NodalMassShare
from .pose import PosedShape, min_distance
from .rigid_obstacles import RigidObstacles

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class PenaltyPolicy:
    """Tuned numbers of penalty contact.

    Attributes:
        near_gap: gap, in widths of the penalty, of points that may be in contact a step later.
        facet_share: part of what contact may add to the square of a frequency that facets may cause beside points.
        max_stretch: of facets, up to which ranks agree on the points at facets in contact.
    """

    near_gap: float = 3.0
    facet_share: float = 0.5
    max_stretch: float = 1.5


PENALTY = PenaltyPolicy()


@dataclass(frozen=True)
class FrictionSprings:
    """Springs of friction of one obstacle.

    Attributes:
        points: (k,) of the surface, ascending.
        slip: (k, d) stretch, m.
        stiffness: (k,) N/m.
    """

    points: Ints
    slip: Values
    stiffness: Values

    @classmethod
    def none(cls, dim: int) -> FrictionSprings:
        """No springs."""
        return cls(np.empty(0, np.int64), np.empty((0, dim)), np.empty(0))

    @property
    def force(self) -> Values:
        """(k, d) forces on the points, N."""
        return -self.stiffness[:, None] * self.slip

    @property
    def energy(self) -> float:
        """Stored energy, J."""
        return 0.5 * float(self.stiffness @ np.sum(self.slip**2, axis=1))

    def stretched(
        self, points: Ints, motion: Values, normal: Values, stiffness: Values, max_force: Values
    ) -> FrictionSprings:
        """Springs after a motion of points in contact; points out of contact lose theirs, new ones begin with none.

        Args:
            points: (k,) in contact.
            motion: (k, d) relative to the obstacle, m.
            normal: (k, d) unit normals.
            stiffness: (k,) N/m.
            max_force: (k,) mu N, N.
        """
        slip = motion.copy()
        if len(points) and len(self.points):
            rows = np.minimum(np.searchsorted(points, self.points), len(points) - 1)
            stays = points[rows] == self.points
            slip[rows[stays]] += self.slip[stays]
        slip = tangential(normal, slip)
        max_slip = np.divide(max_force, stiffness, out=np.zeros(len(slip)), where=stiffness > 0)
        return FrictionSprings(points, slipped(slip, max_slip), stiffness)

    def work(self, motion: Values) -> float:
        """Half the work of the forces by motions (k, d) of the points in a step, m, J."""
        return 0.5 * float(np.vdot(self.force, motion))


@dataclass(frozen=True)
class StepEnd:
    """Contact at the end of a step.

    Attributes:
        springs: of each obstacle.
        forces: (d,) sum of the forces of each obstacle on the body, N.
        all_far: whether the body is known to be far from all obstacles.
    """

    springs: list[FrictionSprings]
    forces: list[Values]
    all_far: bool = False


class PenaltyObstacleTerm(ObstacleTerm):
    """Obstacles in explicit steps.

    Attributes:
        stiffness: (n,) k_p of the points of this rank, N/m.
    """

    near_widths = PENALTY.near_gap
    shows_all_cells = True
    facets_may_be_cut = True  # and crack faces have no penalty of their own

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        bodies: RigidObstacles,
        numbers: Sequence[int],
        law: ObstacleLaw,
        mass: Values,
        max_added: float,
    ) -> None:
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            bodies: motion of all obstacles.
            numbers: numbers of the analytic ones.
            law: contact law with a penalty.
            mass: (owned dofs,) lumped, kg.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.

        Raises:
            InputError: if the body at rest overlaps an obstacle.
        """
        self._mass, self._max_added = mass, max_added
        dim, count = domain.dim, len(numbers)
        self._step_end = StepEnd([FrictionSprings.none(dim)] * count, [np.zeros(dim)] * count)
        self._start_points: Values | None = None  # (n, d) at the start of a step that is not accepted yet, m
        self._springs = self._step_end.springs
        super().__init__(domain, u, bodies, numbers, law)
        self._update_stiffness()

    def facets_for(self, number: int) -> ContactFacets | None:
        """Facets on which an obstacle acts, with their stiffness as areas; None if it acts on points alone."""
        return self._facets if number in self.facets.numbers else None

    # --- stiffness ---

    def _update_stiffness(self) -> None:
        """Compute the stiffness of the points of the current surface (collective)."""
        point_map, area = self.surface.local.point_map, self.surface.area
        mass = self.surface.interpolation.nodal_values(self._mass)[:, 0].copy()
        self._mass_share = mass_share = NodalMassShare(point_map.weights, mass, self._sum_at_nodes)
        self.stiffness: Values = self.law.barrier.curvature(np.zeros(len(area))) * area
        if np.isfinite(self._max_added):
            self.stiffness = np.minimum(self.stiffness, self._max_added * mass_share.point_masses(area))
        self._added_frequency, self._stiffness_of = self._max_rate(self.stiffness), (point_map, area)
        if self.facets.numbers:
            self._update_facets()

    def _sum_at_nodes(self, values: Values) -> Values:
        """(columns,) sums over the ranks of values (columns,) at the nodes of the points (collective)."""
        vector, interpolation = np.zeros((len(values), self._domain.dim)), self.surface.interpolation
        vector[:, 0] = values
        return np.asarray(interpolation.nodal_values(interpolation.sum_at_nodes(vector))[:, 0])

    def _max_rate(self, stiffness: Values) -> float:
        """Bound of omega^2 of springs k (n,), N/m, at the points of all ranks, 1/s^2 (collective)."""
        return max_over_ranks(self.comm, float(self._mass_share.node_rates(stiffness).max(initial=0.0)))

    def _update_facets(self) -> None:
        """Compute the stiffness k_f of facets off crack faces, kept as areas of ContactFacets (collective)."""
        surface, is_copy = self.surface, np.zeros(len(self.surface.area), bool)
        is_copy[surface.local.point_map.copies] = True
        facets, k = self.facets.active, self.law.barrier.curvature(np.zeros(1)) * self.facets.active.area
        if np.isfinite(self._max_added):
            masses = self._mass_share.point_masses(surface.area)
            per_mass = np.divide(surface.area, masses, out=np.zeros(len(masses)), where=masses > 0)
            # in a row of Gershgorin's bound each facet at a node has a weight of at most 1
            rate = facets.corners.shape[1] * per_mass[facets.corners].max(axis=1, initial=0.0)
            limit = PENALTY.facet_share * self._max_added
            k = np.minimum(k, limit * facets.area / np.where(rate > 0, rate, np.inf))
        acts = ~is_copy[facets.corners].any(axis=1)
        self._facets = ContactFacets(facets.corners[acts], k[acts], facets.smoothing)
        corners = surface.rest_positions[self._facets.corners]
        side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(initial=0.0))
        self._facet_reach = self.law.barrier.width + PENALTY.max_stretch * self.comm.allreduce(side, op=MPI.MAX)

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all points were in contact, 1/s^2 (collective).

        With that of the lightest free obstacle: the squares of a body and an obstacle on one spring add up.
        """
        free = {number: obstacle for number, obstacle in self.group.bodies.free.items() if number in self.group.numbers}
        of_free, added = cast("dict[int, VerletObstacle]", free), self._added_frequency
        if self.is_far():
            return added
        self.obstacle_forces()
        if self.facets.numbers:
            load, reach = np.zeros(len(self.stiffness)), PENALTY.near_gap * self.law.barrier.width
            for number in self.facets.numbers:
                near = self._facets.within_reach(self.group.posed[number], self.positions, reach)
                np.add.at(load, self._facets.corners[near], self._facets.area[near][:, None])
            if self.comm.allreduce(bool(load.any()), op=MPI.LOR):
                added += self._max_rate(load)
        return added + max(map(self._obstacle_frequency, of_free, of_free.values()), default=0.0)

    def _obstacle_frequency(self, number: int, obstacle: VerletObstacle) -> float:
        posed, reach = self.group.bodies.posed[number], PENALTY.near_gap * self.law.barrier.width
        near = self.point_candidates(posed, self.positions, reach)
        near = near[posed.distance(self.positions[near]) < reach]
        stiffness = obstacle.spring_stiffness(self.positions[near], self.stiffness[near], posed)
        if self.group.numbers.index(number) in self.facets.numbers:
            facets = self._facets.within_reach(posed, self.positions, reach)
            x = self._facets.closest_points(posed, self.positions, facets).position
            stiffness = stiffness + obstacle.spring_stiffness(x, self._facets.area[facets], posed)
        return obstacle.max_frequency(sum_over_ranks(self.comm, stiffness.reshape(-1)).reshape(stiffness.shape), posed)

    # --- steps ---

    def update_displacement(self) -> None:
        """Discard forces, and test whether obstacles are far while u is in the cache (collective)."""
        super().update_displacement()
        self.is_far()

    def is_far(self) -> bool:
        """Whether nothing is in contact at the current u, nor was at the end of the last step (collective)."""
        if self._far is None:
            self._far = self._step_end.all_far and self._ends_far()
        return self._far

    def _ends_far(self) -> bool:
        """Whether all obstacles are far at the current u (collective)."""
        return self.clearance.is_far([self.end_displacement], [(posed, posed) for posed in self.group.posed])

    def _starts_far(self) -> bool:
        return self._step_end.all_far

    def _begin_new_step(self) -> None:
        self.surface.release_points(self.level.u_n, partial(min_distance, self.group.start_posed))
        point_map, area = self._stiffness_of
        if self.comm.allreduce(point_map is not self.surface.local.point_map or area is not self.surface.area):
            self._update_stiffness()
        self._start_points = self.surface.positions(self.level.u_n)

    def _evaluate_obstacle(self, number: int, posed: PosedShape) -> ContactForces:
        """Forces of an obstacle at a given pose (collective)."""
        forces = self._normal_forces(number, posed)
        if not (coefficient := self.group.obstacles[number].friction):
            return forces
        if self.comm.size > 1 and number in self.facets.numbers:
            forces = self._at_shared_points(forces, posed)
        points, k, normal = forces.points, self.stiffness[forces.points], forces.normal
        total, k_total = normal, k
        if self.comm.size > 1 and number in self.facets.numbers:
            # of a point and the facets at it ranks have other parts of the force than of the stiffness
            sums = self.surface.sum_at_points(points, np.column_stack([normal, k]))
            total, k_total = sums[:, :-1], sums[:, -1]
        size = np.linalg.norm(total, axis=1)
        direction = total / np.where(size > 0, size, 1.0)[:, None]
        max_force = coefficient * size * k / np.where(k_total > 0, k_total, 1.0)
        motion = self._relative_motion(number, points)
        springs = self._step_end.springs[number].stretched(points, motion, direction, k, max_force)
        self._springs[number] = springs
        return replace(forces, friction=springs.force, energy=forces.energy + springs.energy)

    def _at_shared_points(self, forces: ContactForces, posed: PosedShape) -> ContactForces:
        """The same forces, with all points at facets in contact, which other ranks may have, by distances alone."""
        near = self.point_candidates(posed, self.positions, self._facet_reach)
        near = near[posed.distance(self.positions[near]) < self._facet_reach]
        points = np.union1d(forces.points, near)
        normal = np.zeros((len(points), self._domain.dim))
        normal[np.searchsorted(points, forces.points)] = forces.normal
        return replace(forces, points=points, normal=normal, friction=np.zeros_like(normal))

    def _normal_forces(self, number: int, posed: PosedShape) -> ContactForces:
        """Forces of the penalty of points, and of facets that an obstacle acts on."""
        law, points = self.law.barrier, self.point_candidates(posed, self.positions, self.law.barrier.width)
        gap = posed.distance(self.positions[points])
        touches = (gap < law.width) & (self.surface.area[points] > 0)
        points, closure = points[touches], law.width - gap[touches]
        pressure, normal = self.stiffness[points] * closure, posed.normal(self.positions[points])
        energy, no_friction = 0.5 * float(pressure @ closure), np.zeros_like(normal)
        forces = ContactForces(points, energy, pressure[:, None] * normal, no_friction, 0.0, _no_tangent)
        if number not in self.facets.numbers:
            return forces
        of_unit_rate = Penalty(law.width, law.width)
        return merge_forces(forces, *evaluate_facets(self._facets, posed, self.positions, of_unit_rate))

    def _relative_motion(self, number: int, points: Ints) -> Values:
        """(k, d) motion of points relative to an obstacle in the step, m; zero once the step is accepted."""
        x = self.positions[points]
        if self._start_points is None:
            return np.zeros_like(x)
        start = self._start_points[points]
        return np.asarray(x - start - self.group.bodies.point_motion(self.group.numbers[number], start))

    def obstacle_forces(self) -> list[ContactForces]:
        """Forces of each obstacle at the current u (collective)."""
        if self._contact_forces is None:
            self._springs = list(self._step_end.springs)
        return super().obstacle_forces()

    def accept_step(self) -> None:
        """Sum the work of the step, and store springs and forces for the next one (collective)."""
        if self.is_far():
            zeros: list[Values] = [np.zeros(self._domain.dim) for _ in self.group.obstacles]
            self.group.friction_loss, self.group.work, self.group.forces = 0.0, [0.0] * len(zeros), zeros
            return
        forces, previous, group = (
            [-self._current_force(n) for n in range(len(self.group.obstacles))],
            self._step_end,
            self.group,
        )
        group.friction_loss, group.forces = 0.0, [-force for force in forces]
        for number, obstacle in enumerate(self.group.obstacles):
            if obstacle.friction:
                # minus the work by the trapezoidal rule, minus the change of the energy of the springs
                for springs, sign in ((previous.springs[number], 1.0), (self._springs[number], -1.0)):
                    work = springs.work(self._relative_motion(number, springs.points))
                    group.friction_loss += sign * springs.energy - work
        for number in (number for number, obstacle in enumerate(self.group.obstacles) if not obstacle.free):
            shift = self.group.increments[number][: self._domain.dim]
            group.work[number] = float((forces[number] + previous.forces[number]) @ shift) / 2
        self._step_end, self._start_points = StepEnd(self._springs, forces, self._ends_far()), None

    # --- state ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Add new crack faces; springs of points that still exist stay (collective)."""
        springs = [(spring, self.surface.local.keys[spring.points]) for spring in self._step_end.springs]
        super().edges_broke(pattern)
        self._step_end = replace(self._step_end, springs=[self._matched_springs(*item) for item in springs])
        self._update_stiffness()

    def _matched_springs(self, spring: FrictionSprings, keys: Ints) -> FrictionSprings:
        """Springs of points with `keys` (k,), on the current surface."""
        points = KeyLookup(self.surface.local.keys)(keys) if len(keys) else spring.points
        matched = np.flatnonzero(points >= 0)
        matched = matched[np.argsort(points[matched])]
        return FrictionSprings(points[matched], spring.slip[matched], spring.stiffness[matched])

    # --- state: contact at the end of the last step (HistoryTerm) ---

    def snapshot(self) -> StepEnd:
        """Contact at the end of the last step."""
        return self._step_end

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self._step_end = cast("StepEnd", memory)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint (collective).

        Of springs on rank 0: keys of points, and rows of obstacle, rank, area, stretch, stiffness; and sums of forces
        on each rank. Ranks that share a point have a spring each.
        """
        springs = self._step_end.springs
        rows = [
            np.column_stack([np.full(len(spring.points), number), np.full(len(spring.points), self.comm.rank),
                             self.surface.area[spring.points], spring.slip, spring.stiffness])
            for number, spring in enumerate(springs)
        ]  # fmt: skip
        keys = self.surface.local.keys[np.concatenate([spring.points for spring in springs])]
        gathered = gather(self.comm, (keys, np.concatenate(rows), np.array(self._step_end.forces)))
        if gathered is None:
            return {}
        all_keys, all_rows, forces = zip(*gathered, strict=True)
        return {
            "spring_points": np.concatenate(all_keys),
            "springs": np.concatenate(all_rows),
            "pushed": np.array(forces),
        }

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective)."""
        rows, forces = saved["springs"], saved["pushed"]
        points = find_saved_keys(self.comm, self.surface.local.keys, saved["spring_points"])
        springs = [
            self._springs_from_rows(points[of_obstacle], rows[of_obstacle, 1:])
            for of_obstacle in (rows[:, 0] == number for number in range(len(self.group.obstacles)))
        ]
        if len(forces) == self.comm.size:
            local = forces[self.comm.rank]
        else:
            # written by another number of ranks: only the sum counts
            local = forces.sum(axis=0) if self.comm.rank == 0 else np.zeros_like(forces[0])
        self._step_end = StepEnd(springs, list(local))

    def _springs_from_rows(self, matched: Ints, rows: Values) -> FrictionSprings:
        """Springs of the points of this rank, from rows (k, 3 + d) of all ranks in a checkpoint.

        `matched`: (k,) point of each row; -1: it is of another rank.

        Where several ranks had a spring at one point, that of this rank counts, or of the lowest one, for the area
        that this rank has now.
        """
        rank, area, slip, k = np.split(rows, [1, 2, -1], axis=1)
        order = np.lexsort((rank[:, 0], rank[:, 0] != self.comm.rank, matched))
        order = order[matched[order] >= 0]
        points, first = np.unique(matched[order], return_index=True)
        selected = order[first]
        old_area = area[selected, 0]
        factor = np.where(old_area > 0, self.surface.area[points] / np.where(old_area > 0, old_area, 1.0), 1.0)
        return FrictionSprings(points, slip[selected], factor * k[selected, 0])


def _no_tangent() -> tuple[Values, Values]:
    raise NotImplementedError("explicit steps ask for no tangent")
