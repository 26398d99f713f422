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
from ..mechanics.surface_data import SurfaceData
from ..mechanics.term import Term
from ..mesh.domain import Domain
from ..mesh.split_surface.surface_map import SurfaceMap
from ..meshes.text import AXES
from .contact_state import Touching
from .contact_surface import clear_of, uncut
from .drawing import Drawings
from .laws import Law
from .node_contact import Touch
from .obstacle import Obstacle
from .pose import Placed, least_distance
from .step_limit import safe_shares, within_reach

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# of the width of the barrier: changes of points in touch below which tangents are exact, in a first attempt and in
# others. Without their negative eigenvalues Newton's method gains less than a digit an iteration to the end; further
# away CG may find none with them
NEAR_END = 0.01, 0.001


class Obstacles(Touching, Term):
    """Obstacles that the body cannot pass through."""

    name = "obstacles"
    separates_surface = True
    has_output_surfaces = True

    def __init__(self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law) -> None:
        """InputError where the body at rest lies in an obstacle (collective)."""
        super().__init__(domain, u, obstacles, law)
        self._coupling, self._drawings = CouplingBuilder(domain), Drawings(obstacles, domain.lower, domain.upper)
        # of the last step: work of each obstacle, J, what friction took, J, and forces on each, N
        self._worked, self._lost = [0.0] * len(self.obstacles), 0.0
        self._read: list[Values] | None = None  # None: not yet
        self._exact = False  # the last tangent

    def update_displacement(self) -> None:
        """What touches has to be found anew."""
        self._touches = None

    def gaps_at_rest(self) -> Values:
        """(obstacles,) least gaps to points, and to facets where they are felt, of the body at rest where each obstacle
        is at t = 0, m (collective)."""
        x, placed = self.skin.rest, [each.placed(0.0) for each in self.obstacles]
        least = np.array([self.skin.least(each.distance(x)) for each in placed])
        for number in self._sharp:
            facets = self.skin.facets.gaps(placed[number], x, self.width)
            least[number] = min(least[number], float(facets.min(initial=np.inf)))
        self.comm.Allreduce(MPI.IN_PLACE, least, MPI.MIN)
        return least

    # --- what it adds to the balance ---

    def contact_forces(self) -> Values:
        """(owned dofs,) forces at the end of the step, N (collective)."""
        return self.forces()

    def reference_forces(self) -> Values:
        """(owned dofs,) the same as they enter r, N (collective)."""
        return np.asarray(self._level.contact_weight * self.forces())

    def coupling_matrix(self) -> PETSc.Mat | None:
        """Minus the derivative of the forces, where anything is in touch (collective)."""
        touches = self.touching()
        points = np.concatenate([each.points for each in touches])
        moved, self._tangent_at = self._changed(points), self.x
        both = np.array([len(points), moved])
        self.comm.Allreduce(MPI.IN_PLACE, both, op=MPI.MAX)
        count, most = both
        if not count:
            return None
        self._exact = self._may_be_exact(most)
        part = self.skin.stiffness(points, np.concatenate([each.tangent(exact=self._exact) for each in touches]))
        for between in (each.between for each in touches if each.between is not None):
            inner = between.exact if self._exact else between.stiffness
            part = part + self.skin.stiffness_between(between.corners, inner)
        return self._coupling((self._level.contact_weights.factor * part).tocsr(), self.skin.columns)

    def _changed(self, points: Ints) -> float:
        """m, by which points (k,) have moved at most since the last tangent; infinite where there was none."""
        if self._tangent_at is None:
            return np.inf
        return float(np.linalg.norm((self.x - self._tangent_at)[points], axis=1).max(initial=0.0))

    def _may_be_exact(self, moved: float) -> bool:
        """Whether Newton's method is at its end, points in touch having moved by so much, m, at most (collective)."""
        return moved < NEAR_END[self._attempts > 1] * self.width

    def begin_solve(self) -> None:
        """Newton's method sets out on the step: after it has failed it is exact later."""
        self._tangent_at, self._exact, self._attempts = None, False, self._attempts + 1

    def stored_energy(self) -> float:
        """Energy of the barriers at the current u, this rank's share, J (collective)."""
        return sum(each.energy for each in self.touching())

    def potential(self) -> float:
        """Barriers and friction at the end of the step as they enter that of r, this rank's share, J (collective)."""
        return self._level.contact_weight * self._level.fraction * sum(each.potential for each in self.touching())

    def accept_step(self) -> None:
        """What contact has done in the step is booked (collective)."""
        self._lost, found = 0.0, self.touching()
        self._read = [_on_obstacle(each) for each in found]
        for number in range(len(self.obstacles)):
            moved, under = self.rubbed(number)
            self._worked[number] = self._pressed(number) + under
            self._lost += under - moved

    def _pressed(self, number: int) -> float:
        """Work of normal forces on the body in the step, by the way of the obstacle, this rank's share, J."""
        end, shift = self._level.contact_weights.end_work_share, self._course.ways[number][: self._domain.dim]
        pushed = end * self.touching()[number].normal.sum(axis=0) + (1 - end) * self._pushed[number]
        return float(pushed @ shift)

    def step_work(self) -> tuple[float, float]:
        """Work of the obstacles' own motion in the step on this rank, and what friction takes, J."""
        return sum(self._worked[number] for number in self._course.led), self._lost

    # --- how far Newton's method may go ---

    def max_step_fraction(self, change: Values) -> float:
        """Share of a change of u that closes no gap by more than nine tenths (collective)."""
        self.touching()
        moved = self.skin.follow(np.divide(change, self._level.fraction))
        along = enumerate(zip(self._course.placed, self._taken_along(moved), strict=True))
        every = [safe_shares(placed, self.x, moved, q, self._facets(number)) for number, (placed, q) in along]
        shares = [each[self.skin.area > 0] for each in every]
        return float(min(share.min(initial=1.0) for share in shares))

    def _taken_along(self, moved: Values) -> list[Values]:
        """(p,) how each obstacle gives way to a change `moved` (n, d) of the points, m (collective)."""
        return [np.zeros_like(way) for way in self._course.ways]

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u that has passed through nothing on its way from the start (collective)."""
        level = self._level
        if not level.dt:
            return u
        end = within_reach(self.skin, self._course.known(self._facets), level.u_n, level.displacement_at_end(u))
        return np.asarray(level.u_n + level.fraction * (end - level.u_n))

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap is open with the body at u (collective)."""
        x = self.skin.places(self._level.displacement_at_end(u))
        return self.skin.are_apart(least_distance(self._course.placed, x)) and self._are_uncut(x)

    def restrict_motion(self) -> None:
        """Obstacles wait on their way where they would meet the body at the step's start: what is jammed between them
        and something else cannot be taken along by a guess (collective)."""
        self._course.back_to_start()
        self._go_on(self.skin.places(self._level.u_n))

    def remaining_motion(self) -> float:
        """The share of the obstacles' way that is left."""
        return self._course.left

    def continue_motion(self) -> None:
        """The rest of the way, or as far as the body where it is now lets them (collective)."""
        self._tangent_at = None
        if self._course.left:
            self.touching()
            self._go_on(self.x)

    def _go_on(self, x: Values) -> None:
        self._course.go_on(x, self._course.known(self._facets), self.skin.safe)
        self._touches = None

    # --- what breaks, and what is drawn ---

    def where(self, t: float) -> list[Placed]:
        """Each obstacle at the time t of the state, s (not collective)."""
        return [each.placed(t) for each in self.obstacles]

    def separate_surface(self, at: SurfaceMap, elements: Ints, u: Values, t: float) -> SurfaceMap:
        """Drawn in where it would lie in an obstacle, or be cut by one that facets feel, as what touches is."""
        placed = self.where(t)
        at = clear_of(at, u, partial(least_distance, placed))
        if not self._sharp:
            return at
        facets = self.skin.facets_of(elements)
        return uncut(at, u, elements, lambda x: ~facets.are_open([placed[number] for number in self._sharp], x))

    def output_surfaces(self, t: float) -> dict[str, SurfaceData]:
        """Each obstacle at time t, s, by its name."""
        return self._drawings(self.where(t))

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """New walls are part of the surface, drawn in where they would lie in an obstacle (collective)."""
        placed = self._course.placed
        self.skin.edges_broke(pattern, self._at_end(), partial(least_distance, placed), self._cuts(placed))
        self._forget_start()

    def snapshot(self) -> object:
        """That of what touches."""
        return self.skin.memory()

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave of this surface (not collective)."""
        self.skin.recall(memory)

    def to_checkpoint(self) -> dict[str, Values]:
        """The same for a checkpoint (collective)."""
        return {"drawn_in": self.skin.saved()} | ({"cut": self.skin.saved_cut()} if self._sharp else {})

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        self.skin.restore(saved["drawn_in"])
        if "cut" in saved:
            self.skin.restore_cut(saved["cut"])

    def clear_search(self) -> None:
        """Forget where facets were searched (not collective)."""
        self.skin.forget()
        self._touches = None

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.skin.destroy()
        self._coupling.destroy()

    # --- columns of history.csv, and what the end of a run tells ---

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """contact_NAME_AXIS: (1,) force of the body on each obstacle in the last step, this rank's share, N."""
        return {
            f"contact_{each.name}_{axis}": partial(self._on_obstacle, number, place)
            for number, each in enumerate(self.obstacles)
            for place, axis in enumerate(AXES[: self._domain.dim])
        }

    def _on_obstacle(self, number: int, axis: int) -> Values:
        read = _on_obstacle(self.touching()[number]) if self._read is None else self._read[number]
        return read[axis : axis + 1]

    def minimum_columns(self) -> dict[str, Callable[[], float]]:
        """gap_NAME: least distance between each obstacle and this rank's surface, m; infinite where it has none. Of
        facets that of the place where they feel it."""
        return {f"gap_{each.name}": partial(self._gap, number) for number, each in enumerate(self.obstacles)}

    def _gap(self, number: int) -> float:
        self.touching()
        least, placed = self.skin.least(self._course.placed[number].distance(self.x)), self._course.placed[number]
        if (facets := self._facets(number)) is None:
            return least
        return min(least, float(facets.distances(placed, self.x, self.law.barrier.width).min(initial=np.inf)))

    def work_columns(self) -> dict[str, Callable[[], float]]:
        """work_NAME: what each obstacle has done on the body in the step that has ended, J."""
        return {f"work_{each.name}": partial(self._worked.__getitem__, k) for k, each in enumerate(self.obstacles)}

    def closings(self) -> list[float]:
        """How far each obstacle and the points of this rank that touch it at the end of the step would have come closer
        in it, had nothing stopped them, m (collective)."""
        moved, course, result = self._dt * self.skin.follow(self._began_with), self._course, []
        for way, placed, found in zip(course.ways, course.placed, self.touching(), strict=True):
            pushed = found.points[found.normal.any(axis=1)]  # and not merely rubbed
            closer = np.einsum("ni,ni->n", way[: self._domain.dim] - moved[pushed], placed.normal(self.x[pushed]))
            result.append(float(closer.max(initial=0.0)))
        return result


def _on_obstacle(found: Touch) -> Values:
    """(d,) force of the body on an obstacle, this rank's share, N."""
    return np.asarray(-(found.normal + found.friction).sum(axis=0))
