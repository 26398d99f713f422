"""Contact of a body with obstacles: a term of the balance (docs/theory.md#contact).

    E(u) = sum over obstacles of  int b(gap(x)) dA  +  sum over points in touch of  mu lambda f0(|s|)

over the split surface x(u) (contact_surface), each point with its share of the reference surface. Forces are those
where the body will be at the end of a step, u_n + (u - u_n) / share, whatever level the scheme solves at (blow).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from ..mechanics.extra_couplings import CouplingBuilder
from ..mechanics.term import Term
from ..mechanics.term_protocols import SurfaceData
from ..mesh.domain import Domain
from ..mesh.split_surface.surface_map import SurfaceMap
from ..meshes.text import AXES
from .contact_state import ContactState
from .contact_surface import retract_cut_elements, retract_from_obstacles
from .drawing import ObstacleTessellations
from .laws import ObstacleLaw
from .node_contact import ContactForces
from .obstacle import RigidObstacle
from .pose import PosedShape, min_distance
from .step_limit import safe_motion_fractions, stop_before_obstacles

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# of the width of the barrier: changes of points in touch below which tangents are exact, in a first attempt and in
# others. Without their negative eigenvalues Newton's method gains less than a digit an iteration to the end; further
# away CG may find none with them
NEAR_END = 0.01, 0.001


class ObstacleTerm(ContactState, Term):
    """Obstacles that the body cannot pass through."""

    name = "obstacles"

    def __init__(self, domain: Domain, u: fem.Function, obstacles: Sequence[RigidObstacle], law: ObstacleLaw) -> None:
        """InputError where the body at rest lies in an obstacle (collective)."""
        super().__init__(domain, u, obstacles, law)
        self._coupling = CouplingBuilder(domain)
        self._drawings = ObstacleTessellations(obstacles, domain.lower, domain.upper)
        # of the last step: work of each obstacle, J, what friction took, J, and forces on each, N
        self._obstacle_work, self._friction_loss = [0.0] * len(self.obstacles), 0.0
        self._force_readings: list[Values] | None = None  # None: not yet
        self._tangent_is_exact = False  # the last tangent

    def update_displacement(self) -> None:
        """What touches has to be found anew."""
        self._contact_forces = None

    def rest_gaps(self) -> Values:
        """(obstacles,) least gaps to points, and to facets where they are felt, of the body at rest where each obstacle
        is at t = 0, m (collective)."""
        x, placed = self.surface.rest_positions, [each.posed_at(0.0) for each in self.obstacles]
        least = np.array([self.surface.min_distance(each.distance(x)) for each in placed])
        for number in self._facet_obstacles:
            facets = self.surface.facets.gaps(placed[number], x, self.barrier_width)
            least[number] = min(least[number], float(facets.min(initial=np.inf)))
        self.comm.Allreduce(MPI.IN_PLACE, least, MPI.MIN)
        return least

    # --- what it adds to the balance ---

    def contact_forces(self) -> Values:
        """(owned dofs,) forces at the end of the step, N (collective)."""
        return self.nodal_forces()

    def reference_forces(self) -> Values:
        """(owned dofs,) the same as they enter r, N (collective)."""
        return np.asarray(self._level.contact_weight * self.nodal_forces())

    def coupling_matrix(self) -> PETSc.Mat | None:
        """Minus the derivative of the forces, where anything is in touch (collective)."""
        touches = self.obstacle_forces()
        points = np.concatenate([each.points for each in touches])
        moved, self._tangent_positions = self._max_motion(points), self.positions
        both = np.array([len(points), moved])
        self.comm.Allreduce(MPI.IN_PLACE, both, op=MPI.MAX)
        count, most = both
        if not count:
            return None
        self._tangent_is_exact = self._exact_tangent_allowed(most)
        part = self.surface.point_stiffness(
            points, np.concatenate([each.tangent(exact=self._tangent_is_exact) for each in touches])
        )
        for between in (each.facets for each in touches if each.facets is not None):
            inner = between.hessian if self._tangent_is_exact else between.stiffness
            part = part + self.surface.facet_stiffness(between.corners, inner)
        return self._coupling((self._level.contact_weights.factor * part).tocsr(), self.surface.node_numbers)

    def _max_motion(self, points: Ints) -> float:
        """m, by which points (k,) have moved at most since the last tangent; infinite where there was none."""
        if self._tangent_positions is None:
            return np.inf
        return float(np.linalg.norm((self.positions - self._tangent_positions)[points], axis=1).max(initial=0.0))

    def _exact_tangent_allowed(self, moved: float) -> bool:
        """Whether Newton's method is at its end, points in touch having moved by so much, m, at most (collective)."""
        return moved < NEAR_END[self._attempts > 1] * self.barrier_width

    def begin_solve(self) -> None:
        """Newton's method sets out on the step: after it has failed it is exact later."""
        self._tangent_positions, self._tangent_is_exact, self._attempts = None, False, self._attempts + 1

    def stored_energy(self) -> float:
        """Energy of the barriers at the current u, this rank's share, J (collective)."""
        return sum(each.energy for each in self.obstacle_forces())

    def potential(self) -> float:
        """Barriers and friction at the end of the step as they enter that of r, this rank's share, J (collective)."""
        potentials = sum(each.potential for each in self.obstacle_forces())
        return self._level.contact_weight * self._level.fraction * potentials

    def accept_step(self) -> None:
        """What contact has done in the step is booked (collective)."""
        self._friction_loss, found = 0.0, self.obstacle_forces()
        self._force_readings = [_on_obstacle(each) for each in found]
        for number in range(len(self.obstacles)):
            moved, under = self.friction_work(number)
            self._obstacle_work[number] = self._normal_work(number) + under
            self._friction_loss += under - moved

    def _normal_work(self, number: int) -> float:
        """Work of normal forces on the body in the step, by the way of the obstacle, this rank's share, J."""
        end, shift = self._level.contact_weights.end_work_share, self._kinematics.increments[number][: self._domain.dim]
        pushed = end * self.obstacle_forces()[number].normal.sum(axis=0) + (1 - end) * self._start_forces[number]
        return float(pushed @ shift)

    def step_work(self) -> tuple[float, float]:
        """Work of the obstacles' own motion in the step on this rank, and what friction takes, J."""
        return sum(self._obstacle_work[number] for number in self._kinematics.prescribed), self._friction_loss

    # --- how far Newton's method may go ---

    def max_step_fraction(self, change: Values) -> float:
        """Share of a change of u that closes no gap by more than nine tenths (collective)."""
        self.obstacle_forces()
        moved = self.surface.interpolation(np.divide(change, self._level.fraction))
        along = enumerate(zip(self._kinematics.posed, self._obstacle_increments(moved), strict=True))
        every = [
            safe_motion_fractions(placed, self.positions, moved, q, self._facets_for(number))
            for number, (placed, q) in along
        ]
        shares = [each[self.surface.area > 0] for each in every]
        return float(min(share.min(initial=1.0) for share in shares))

    def _obstacle_increments(self, moved: Values) -> list[Values]:
        """(p,) how each obstacle gives way to a change `moved` (n, d) of the points, m (collective)."""
        return [np.zeros_like(way) for way in self._kinematics.increments]

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u that has passed through nothing on its way from the start (collective)."""
        level = self._level
        if not level.dt:
            return u
        end = stop_before_obstacles(
            self.surface, self._kinematics.prescribed_motions(self._facets_for), level.u_n, level.displacement_at_end(u)
        )
        return np.asarray(level.u_n + level.fraction * (end - level.u_n))

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap is open with the body at u (collective)."""
        x = self.surface.positions(self._level.displacement_at_end(u))
        return self.surface.gaps_are_open(min_distance(self._kinematics.posed, x)) and self._facets_are_open(x)

    def restrict_motion(self) -> None:
        """Obstacles wait on their way where they would meet the body at the step's start: what is jammed between them
        and something else cannot be taken along by a guess (collective)."""
        self._kinematics.return_to_start()
        self._advance_obstacles(self.surface.positions(self._level.u_n))

    def remaining_motion(self) -> float:
        """The share of the obstacles' way that is left."""
        return self._kinematics.remaining_fraction

    def continue_motion(self) -> None:
        """The rest of the way, or as far as the body where it is now lets them (collective)."""
        self._tangent_positions = None
        if self._kinematics.remaining_fraction:
            self.obstacle_forces()
            self._advance_obstacles(self.positions)

    def _advance_obstacles(self, x: Values) -> None:
        self._kinematics.advance(x, self._kinematics.prescribed_motions(self._facets_for), self.surface.min_fraction)
        self._contact_forces = None

    # --- what breaks, and what is drawn ---

    def posed_obstacles(self, t: float) -> list[PosedShape]:
        """Each obstacle at the time t of the state, s (not collective)."""
        return [each.posed_at(t) for each in self.obstacles]

    def separate_surface(self, at: SurfaceMap, elements: Ints, u: Values, t: float) -> SurfaceMap:
        """Drawn in where it would lie in an obstacle, or be cut by one that facets feel, as what touches is."""
        placed = self.posed_obstacles(t)
        at = retract_from_obstacles(at, u, partial(min_distance, placed))
        if not self._facet_obstacles:
            return at
        facets = self.surface.facets_from(elements)
        return retract_cut_elements(
            at, u, elements, lambda x: ~facets.are_open([placed[number] for number in self._facet_obstacles], x)
        )

    def output_surfaces(self, t: float) -> dict[str, SurfaceData]:
        """Each obstacle at time t, s, by its name."""
        return self._drawings(self.posed_obstacles(t))

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """New walls are part of the surface, drawn in where they would lie in an obstacle (collective)."""
        placed = self._kinematics.posed
        self.surface.edges_broke(
            pattern, self._end_displacement(), partial(min_distance, placed), self._facet_gap_function(placed)
        )
        self._discard_start()

    def snapshot(self) -> object:
        """That of what touches."""
        return self.surface.snapshot()

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave of this surface (not collective)."""
        self.surface.restore(memory)

    def to_checkpoint(self) -> dict[str, Values]:
        """The same for a checkpoint (collective)."""
        return {"drawn_in": self.surface.to_checkpoint()} | (
            {"cut": self.surface.cut_to_checkpoint()} if self._facet_obstacles else {}
        )

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        self.surface.from_checkpoint(saved["drawn_in"])
        if "cut" in saved:
            self.surface.cut_from_checkpoint(saved["cut"])

    def clear_search(self) -> None:
        """Forget where facets were searched (not collective)."""
        self.surface.clear_caches()
        self._contact_forces = None

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.surface.destroy()
        self._coupling.destroy()

    # --- columns of history.csv, and what the end of a run tells ---

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """contact_NAME_AXIS: (1,) force of the body on each obstacle in the last step, this rank's share, N."""
        return {
            f"contact_{each.name}_{axis}": partial(self._force_reading, number, place)
            for number, each in enumerate(self.obstacles)
            for place, axis in enumerate(AXES[: self._domain.dim])
        }

    def _force_reading(self, number: int, axis: int) -> Values:
        read = (
            _on_obstacle(self.obstacle_forces()[number])
            if self._force_readings is None
            else self._force_readings[number]
        )
        return read[axis : axis + 1]

    def minimum_columns(self) -> dict[str, Callable[[], float]]:
        """gap_NAME: least distance between each obstacle and this rank's surface, m; infinite where it has none. Of
        facets that of the place where they feel it."""
        return {f"gap_{each.name}": partial(self._gap, number) for number, each in enumerate(self.obstacles)}

    def _gap(self, number: int) -> float:
        self.obstacle_forces()
        least, placed = (
            self.surface.min_distance(self._kinematics.posed[number].distance(self.positions)),
            self._kinematics.posed[number],
        )
        if (facets := self._facets_for(number)) is None:
            return least
        return min(least, float(facets.distances(placed, self.positions, self.law.barrier.width).min(initial=np.inf)))

    def work_columns(self) -> dict[str, Callable[[], float]]:
        """work_NAME: what each obstacle has done on the body in the step that has ended, J."""
        return {
            f"work_{each.name}": partial(self._obstacle_work.__getitem__, k) for k, each in enumerate(self.obstacles)
        }

    def closing_distances(self) -> list[float]:
        """How far each obstacle and the points of this rank that touch it at the end of the step would have come closer
        in it, had nothing stopped them, m (collective)."""
        moved, course, result = self._dt * self.surface.interpolation(self._start_velocity), self._kinematics, []
        for way, placed, found in zip(course.increments, course.posed, self.obstacle_forces(), strict=True):
            pushed = found.points[found.normal.any(axis=1)]  # and not merely rubbed
            closer = np.einsum(
                "ni,ni->n", way[: self._domain.dim] - moved[pushed], placed.normal(self.positions[pushed])
            )
            result.append(float(closer.max(initial=0.0)))
        return result


def _on_obstacle(found: ContactForces) -> Values:
    """(d,) force of the body on an obstacle, this rank's share, N."""
    return np.asarray(-(found.normal + found.friction).sum(axis=0))
