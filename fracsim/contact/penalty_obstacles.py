"""Terms of the balance for contact with analytic obstacles in explicit steps: a penalty in place of the barrier.

    E(u) = sum over obstacles of  sum over points in contact of  k_p (d - gap)^2 / 2 + k_p |s|^2 / 2

and the same of the deepest points of facets off crack faces, where an obstacle is round (closest_point), with k_f and
the barycentric coordinates as weights. d is the gap below which the penalty acts, s the stretch of the spring of
friction (penalty_law). k_p = kappa A_p / d, A_p the share of the point in the surface, but at most `max_added` M_p, M_p
its share of its nodes' mass. So contact adds at most `max_added` to the square of the body's highest frequency, from
which the step is taken.
Forces at the end of a step are those that the next one starts with; the work of both is summed by the trapezoidal rule,
as in velocity Verlet.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..array_types import Ints, Values
from ..mesh.domain import Domain
from ..mesh.ghost_exchange import KeyLookup, find_saved_keys
from ..mesh.parallel import gather, max_over_ranks, sum_over_ranks
from ..meshes.topology import row_keys
from .facet_contact import ContactFacets
from .laws import ObstacleLaw, Penalty
from .node_contact import ContactForces
from .obstacle import VerletObstacle
from .obstacle_term import ObstacleTerm
from .penalty_law import PENALTY, NodalMassShare, PenaltyContacts, PenaltyForces, Slips, penalty_stiffness
from .pose import PosedShape
from .rigid_obstacles import RigidObstacles


@dataclass(frozen=True)
class StepEnd:
    """Contact at the end of a step.

    Attributes:
        slips: of points and facets in contact with each obstacle.
        forces: (d,) sum of the forces of each obstacle on the body, N.
        spring_energy: of all springs, J.
        all_far: whether the body is known to be far from all obstacles.
    """

    slips: list[Slips]
    forces: list[Values]
    spring_energy: float = 0.0
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
        self._step_end = StepEnd([Slips.none(dim)] * count, [np.zeros(dim)] * count)
        self._start_points: Values | None = None  # (n, d) at the start of a step that is not accepted yet, m
        self._touching: dict[int, tuple[PenaltyForces, Ints]] = {}  # at the current u, and keys of the contacts
        super().__init__(domain, u, bodies, numbers, law)
        self._update_stiffness()

    def facets_for(self, number: int) -> ContactFacets | None:
        """Facets on which an obstacle acts, with their stiffness as areas; None if it acts on points alone."""
        return self._facets if number in self.surface.curved else None

    # --- stiffness ---

    def _update_stiffness(self) -> None:
        """Compute the stiffness of the points of the current surface (collective)."""
        point_map, area = self.surface.point_map, self.surface.area
        mass = self.surface.nodal_values(self._mass)[:, 0].copy()
        self._mass_share = mass_share = NodalMassShare(point_map.weights, mass, self._sum_at_nodes)
        self.stiffness: Values = penalty_stiffness(mass_share, area, self._penalty_rate, self._max_added)
        self._added_frequency, self._stiffness_of = self._max_rate(self.stiffness), (point_map, area)
        if self.surface.curved:
            self._update_facets()

    @property
    def _penalty_rate(self) -> float:
        """Stiffness of an area, Pa/m."""
        return cast("Penalty", self.law.barrier).rate

    def _sum_at_nodes(self, values: Values) -> Values:
        """(columns,) sums over the ranks of values (columns,) at the nodes of the points (collective)."""
        vector: Values = np.zeros((len(values), self._domain.dim))
        vector[:, 0] = values
        return np.asarray(self.surface.nodal_values(self.surface.sum_at_nodes(vector))[:, 0])

    def _max_rate(self, stiffness: Values) -> float:
        """Bound of omega^2 of springs k (n,), N/m, at the points of all ranks, 1/s^2 (collective)."""
        return max_over_ranks(self.comm, float(self._mass_share.node_rates(stiffness).max(initial=0.0)))

    def _update_facets(self) -> None:
        """Compute the stiffness k_f of facets off crack faces, kept as areas of ContactFacets (collective)."""
        surface, is_copy = self.surface, np.zeros(len(self.surface.area), bool)
        is_copy[surface.point_map.copies] = True
        facets, k = self.surface.facets, self._penalty_rate * self.surface.facets.area
        if np.isfinite(self._max_added):
            masses = self._mass_share.point_masses(surface.area)
            per_mass = np.divide(surface.area, masses, out=np.zeros(len(masses)), where=masses > 0)
            # in a row of Gershgorin's bound each facet at a node has a weight of at most 1
            rate = facets.corners.shape[1] * per_mass[facets.corners].max(axis=1, initial=0.0)
            limit = PENALTY.facet_share * self._max_added
            k = np.minimum(k, limit * facets.area / np.where(rate > 0, rate, np.inf))
        acts = ~is_copy[facets.corners].any(axis=1)
        self._facets = ContactFacets(facets.corners[acts], k[acts], facets.smoothing)

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all points were in contact, 1/s^2 (collective).

        With that of the lightest free obstacle: the squares of a body and an obstacle on one spring add up.
        """
        free = {number: obstacle for number, obstacle in self.group.bodies.free.items() if number in self.group.numbers}
        of_free, added = cast("dict[int, VerletObstacle]", free), self._added_frequency
        if self.is_far():
            return added
        self.obstacle_forces()
        if self.surface.curved:
            load, reach = np.zeros(len(self.stiffness)), PENALTY.near_gap * self.law.barrier.width
            for number in self.surface.curved:
                near = self._facets.within_reach(self.group.posed[number], self.positions, reach)
                np.add.at(load, self._facets.corners[near], self._facets.area[near][:, None])
            if self.comm.allreduce(bool(load.any()), op=MPI.LOR):
                added += self._max_rate(load)
        return added + max(map(self._obstacle_frequency, of_free, of_free.values()), default=0.0)

    def _obstacle_frequency(self, number: int, obstacle: VerletObstacle) -> float:
        posed, reach = self.group.bodies.posed[number], PENALTY.near_gap * self.law.barrier.width
        near, _ = self._contacts(self.group.numbers.index(number), posed, reach)
        stiffness = obstacle.spring_stiffness(near.relative(self.positions), near.stiffness, posed)
        return obstacle.max_frequency(sum_over_ranks(self.comm, stiffness), posed)

    # --- steps ---

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
        self.surface.release(self.level.u_n, self.group.start_posed)
        point_map, area = self._stiffness_of
        if self.comm.allreduce(point_map is not self.surface.point_map or area is not self.surface.area):
            self._update_stiffness()
        self._start_points = self.surface.positions(self.level.u_n)

    def _contacts(self, number: int, posed: PosedShape, reach: float) -> tuple[PenaltyContacts, Ints]:
        """Points nearer than `reach`, m, to an obstacle, and facets that may be, and their keys.

        Where facets count, a point is one whose first corner carries all.
        """
        x, names = self.positions, self.surface.keys
        points = self.point_candidates(posed, x, reach)
        gap = posed.distance(x[points])
        near = (gap < reach) & (self.surface.area[points] > 0)
        points, gap = points[near], gap[near]
        keys, normal, stiffness = names[points], posed.normal(x[points]), self.stiffness[points]
        corners: Ints = points[:, None]
        weights: Values = np.ones((len(points), 1))
        if number in self.surface.curved:
            facets = self._facets.within_reach(posed, x, reach)
            of_facets, closest = self._facets.corners[facets], self._facets.closest_points(posed, x, facets)
            c = of_facets.shape[1]
            keys = np.append(keys, row_keys(np.sort(names[of_facets], axis=1)))
            corners = np.concatenate([np.repeat(corners, c, axis=1), of_facets])
            weights = np.concatenate([np.tile(np.eye(1, c), (len(points), 1)), closest.barycentric])
            gap, stiffness = np.append(gap, closest.gap), np.append(stiffness, self._facets.area[facets])
            normal = np.concatenate([normal, closest.normal])
        slip, touched = self._step_end.slips[number].at(keys)
        contacts = PenaltyContacts.of_points(corners, weights, gap, normal, stiffness, slip, stiffness * touched)
        return contacts, keys

    def _evaluate_obstacle(self, number: int, posed: PosedShape) -> ContactForces:
        """Forces of an obstacle at a given pose."""
        width, friction = self.law.barrier.width, self.group.obstacles[number].friction
        near, keys = self._contacts(number, posed, width)
        touches = near.gap < width
        contacts = near.select(touches)
        points, rows = np.unique(contacts.points, return_inverse=True)
        numbered = replace(contacts, points=rows.reshape(contacts.points.shape))
        forces = PenaltyForces(numbered, self._relative_motion(number, contacts), friction, width, len(points))
        self._touching[number] = forces, keys[touches]
        return ContactForces(points, forces.energy, forces.normal_force, forces.friction_force, 0.0, _no_tangent)

    def _relative_motion(self, number: int, contacts: PenaltyContacts) -> Values:
        """(k, d) motion of contacts relative to an obstacle in the step, m; zero once the step is accepted."""
        if self._start_points is None or not self.group.obstacles[number].friction:
            return np.zeros_like(contacts.normal)
        start = contacts.relative(self._start_points)
        motion = self.group.bodies.point_motion(self.group.numbers[number], start)
        return np.asarray(contacts.relative(self.positions) - start - motion)

    def accept_step(self) -> None:
        """Sum the work of the step, and store springs and forces for the next one (collective)."""
        if self.is_far():
            zeros: list[Values] = [np.zeros(self._domain.dim) for _ in self.group.obstacles]
            self.group.friction_loss, self.group.work, self.group.forces = 0.0, [0.0] * len(zeros), zeros
            return
        forces = [-self._current_force(number) for number in range(len(self.group.obstacles))]
        previous, group, touching = self._step_end, self.group, [self._touching[n] for n in range(len(forces))]
        group.forces = [-force for force in forces]
        group.friction_loss = previous.spring_energy + sum(part.dissipated(0.0) for part, _ in touching)
        for number in (number for number, obstacle in enumerate(self.group.obstacles) if not obstacle.free):
            shift = self.group.increments[number][: self._domain.dim]
            group.work[number] = float((forces[number] + previous.forces[number]) @ shift) / 2
        slips = [Slips(keys, part.slips) for part, keys in touching]
        energy = sum(part.spring_energy for part, _ in touching)
        self._step_end, self._start_points = StepEnd(slips, forces, energy, self._ends_far()), None

    # --- state ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Add new crack faces; springs of points and facets that still exist stay (collective)."""
        super().edges_broke(pattern)
        self._update_stiffness()

    # --- state: contact at the end of the last step (HistoryTerm) ---

    def snapshot(self) -> StepEnd:
        """Contact at the end of the last step."""
        return self._step_end

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self._step_end = cast("StepEnd", memory)

    def _spring_keys(self) -> Ints:
        """(k,) keys of all points and facets of this rank that may have a spring."""
        names = self.surface.keys
        corners = self._facets.corners if self.surface.curved else np.empty((0, self._domain.dim), np.int64)
        return np.append(names, row_keys(np.sort(names[corners], axis=1)))

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint, on rank 0 (collective).

        Of springs: keys, and rows of obstacle and stretch. Ranks that share a point have the same spring there.
        Points and facets that do not exist any more, since edges broke after the step, have none.
        """
        end, exists = self._step_end, KeyLookup(self._spring_keys())
        sums = sum_over_ranks(self.comm, np.append(np.array(end.forces).reshape(-1), end.spring_energy))
        rows = np.concatenate([np.insert(slips.slip, 0, number, axis=1) for number, slips in enumerate(end.slips)])
        keys = np.concatenate([slips.keys for slips in end.slips])
        which = exists(keys) >= 0
        if (gathered := gather(self.comm, (keys[which], rows[which]))) is None:
            return {}
        all_keys, all_rows = (np.concatenate(arrays) for arrays in zip(*gathered, strict=True))
        _, first = np.unique(np.column_stack([all_rows[:, 0], all_keys]), axis=0, return_index=True)
        return {"spring_keys": all_keys[first], "slips": all_rows[first], "pushed": sums}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective).

        Raises ValueError if it has keys of no element.
        """
        find_saved_keys(self.comm, self._spring_keys(), saved["spring_keys"])
        rows, keys, is_root = saved["slips"], saved["spring_keys"].astype(np.int64), self.comm.rank == 0
        *forces, energy = saved["pushed"] * is_root
        selected = [rows[:, 0] == number for number in range(len(self.group.obstacles))]
        slips = [Slips(keys[which], rows[which, 1:]) for which in selected]
        self._step_end = StepEnd(slips, list(np.reshape(forces, (len(slips), -1))), float(energy))


def _no_tangent() -> tuple[Values, Values]:
    raise NotImplementedError("explicit steps ask for no tangent")
