"""Contact with obstacles in explicit steps: the same term with a penalty in place of the barrier.

    E(u) = sum over obstacles of  sum over points in touch of  k_p (d - gap)^2 / 2 + k_p |s|^2 / 2

d the gap from which on it acts, k_p the stiffness of a point, s the stretch of the spring by which friction holds it
(penalty_obstacles). k_p = kappa A_p / d, A_p its share of the surface, but no more than `most` M_p, M_p what it carries
of its nodes' mass (penalty_law): contact then adds `most` at most to the square of the body's highest frequency, from
which the step is taken. Forces at the end of a step are those that the next one starts with; the work of both is taken
by trapezia, as velocity Verlet steps do.

Equations: docs/theory.md#explicit-contact.

Coulomb friction in explicit steps: each point in touch hangs on a spring that slips once it pulls harder than mu N.

P. A. Cundall, O. D. L. Strack: A discrete numerical model for granular assemblies. Geotechnique 29 (1979) 47-65. A
body at rest on a slope stays there: friction that is a function of the velocity alone would let it creep.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..mesh.domain import Domain
from ..mesh.parallel import gather
from ..mesh.split_surface.point_matching import match_points
from .friction import tangential
from .laws import ObstacleLaw
from .node_contact import ContactForces
from .obstacle import RigidObstacle
from .obstacle_term import ObstacleTerm
from .penalty_law import NodalMassShare
from .pose import PosedShape, min_distance

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class FrictionSprings:
    """The springs of one obstacle.

    Attributes:
        points: (k,) of the surface, ascending.    slip: (k, d) by which they are stretched, m.
        stiffness: (k,) N/m.
    """

    points: Ints
    slip: Values
    stiffness: Values

    @classmethod
    def none(cls, dim: int) -> FrictionSprings:
        """Nothing is in touch."""
        return cls(np.empty(0, np.int64), np.empty((0, dim)), np.empty(0))

    @property
    def force(self) -> Values:
        """(k, d) on the points, N."""
        return -self.stiffness[:, None] * self.slip

    @property
    def energy(self) -> float:
        """J."""
        return 0.5 * float(self.stiffness @ np.sum(self.slip**2, axis=1))

    def stretched(
        self, points: Ints, moved: Values, normal: Values, stiffness: Values, most: Values
    ) -> FrictionSprings:
        """After points (k,) in touch have moved by `moved` (k, d) over the obstacle: stretched across the `normal`
        (k, d), by forces of at most `most` (k,), N. Points that let go lose their springs, new ones begin with none."""
        slip = moved.copy()
        if len(points) and len(self.points):
            place = np.minimum(np.searchsorted(points, self.points), len(points) - 1)
            known = points[place] == self.points
            slip[place[known]] += self.slip[known]
        slip = tangential(normal, slip)
        pull = stiffness * np.linalg.norm(slip, axis=1)
        share = np.divide(most, pull, out=np.ones(len(pull)), where=pull > most)
        return FrictionSprings(points, share[:, None] * slip, stiffness)

    def dissipated(self, before: FrictionSprings, moved: Values) -> float:
        """What friction has taken, J, as points (n, d) moved by `moved`: its work by the trapezoidal rule, less what
        the springs store."""
        work = sum(float(np.vdot(each.force, moved[each.points])) for each in (before, self)) / 2
        return before.energy - self.energy - work


@dataclass(frozen=True)
class StepEnd:
    """What a step ended with: the springs of each obstacle, and the sums (d,) of its forces on the body, N."""

    springs: list[FrictionSprings]
    forces: list[Values]


class PenaltyObstacleTerm(ObstacleTerm):
    """Obstacles that explicit steps run into.

    Attributes:
        stiffness: (n,) k_p of the points of this rank, N/m.
    """

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        obstacles: Sequence[RigidObstacle],
        law: ObstacleLaw,
        mass: Values,
        most: float,
    ) -> None:
        """`mass`: (owned dofs,) lumped, kg; `most`: what contact may add to the square of the highest frequency, 1/s^2.

        InputError where the body at rest lies in an obstacle (collective).
        """
        self._mass, self._max_added = mass, most
        self._step_end = self._at_rest(len(obstacles), domain.dim)
        self._start_points: Values | None = None  # places of the points at the start of a step that is under way
        self._springs = self._step_end.springs
        super().__init__(domain, u, obstacles, law)
        self._update_stiffness()

    def _find_facet_obstacles(self) -> list[int]:
        return []  # facets have no penalty of their own

    @staticmethod
    def _at_rest(count: int, dim: int) -> StepEnd:
        return StepEnd([FrictionSprings.none(dim)] * count, [np.zeros(dim)] * count)

    # --- how stiff it is ---

    def _update_stiffness(self) -> None:
        """Stiffness of the points of the surface as it is now (collective)."""
        at, area = self.surface.point_map, self.surface.area
        carried = NodalMassShare(at, self.surface.interpolation, self._mass)
        self.stiffness: Values = self.law.barrier.curvature(np.zeros(len(area))) * area
        if np.isfinite(self._max_added):
            self.stiffness = np.minimum(self.stiffness, self._max_added * carried.point_masses(area))
        self._fastest, self._stiffened = carried.max_rate(self.stiffness), (at, area)

    def frequency_bound(self) -> float:
        """What contact adds at most, were all points in touch, 1/s^2."""
        return self._fastest

    # --- a step ---

    def _begin_new_step(self) -> None:
        self.surface.release_points(self._level.u_n, partial(min_distance, self._kinematics.start_posed))
        at, area = self._stiffened
        if self.comm.allreduce(at is not self.surface.point_map or area is not self.surface.area):
            self._update_stiffness()
        self._start_points = self.surface.positions(self._level.u_n)

    def _evaluate_obstacle(self, number: int, placed: PosedShape) -> ContactForces:
        law, gap = self.law.barrier, placed.distance(self.positions)
        points = np.flatnonzero((gap < law.width) & (self.surface.area > 0))
        gap, k, normal = gap[points], self.stiffness[points], placed.normal(self.positions[points])
        pressed = k * (law.width - gap)
        energy, rubbed = 0.5 * float(pressed @ (law.width - gap)), np.zeros_like(normal)
        if friction := self.obstacles[number].friction:
            moved = self._relative_motion(number, placed)[points]
            spring = self._step_end.springs[number].stretched(points, moved, normal, k, friction * pressed)
            self._springs[number], rubbed, energy = spring, spring.force, energy + spring.energy
        return ContactForces(points, energy, pressed[:, None] * normal, rubbed, 0.0, _no_tangent)

    def _relative_motion(self, number: int, placed: PosedShape) -> Values:
        """(n, d) way of the points over an obstacle in the step, m; none once it is over."""
        if self._start_points is None:
            return np.zeros_like(self.positions)
        return np.asarray(self.positions - self._start_points - self._obstacle_point_motion(number, placed))

    def _obstacle_point_motion(self, number: int, placed: PosedShape) -> Values:
        """(d,) or (n, d) way in the step of what is under the points, m."""
        return np.asarray(self._kinematics.increments[number][: self._domain.dim])

    def obstacle_forces(self) -> list[ContactForces]:
        """What each obstacle does at the current u (collective)."""
        if self._contact_forces is None:
            self._springs = list(self._step_end.springs)
        return super().obstacle_forces()

    def accept_step(self) -> None:
        """The step is over: its work is summed, and its springs are those that the next begins with (collective)."""
        found, past = self.obstacle_forces(), self._step_end
        pushed = [(each.normal + each.friction).sum(axis=0) for each in found]
        self._friction_loss, self._force_readings = 0.0, [-each for each in pushed]
        for number, (obstacle, placed) in enumerate(zip(self.obstacles, self._kinematics.posed, strict=True)):
            if obstacle.friction:
                self._friction_loss += self._springs[number].dissipated(
                    past.springs[number], self._relative_motion(number, placed)
                )
        for number in self._kinematics.prescribed:
            shift = self._kinematics.increments[number][: self._domain.dim]
            self._obstacle_work[number] = float((pushed[number] + past.forces[number]) @ shift) / 2
        self._step_end, self._start_points = StepEnd(self._springs, pushed), None

    # --- its past ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Springs of points that are still there go on (collective)."""
        held = [(spring, self.surface.identity(spring.points)) for spring in self._step_end.springs]
        super().edges_broke(pattern)
        self._step_end = StepEnd([self._matched_springs(*each) for each in held], self._step_end.forces)
        self._update_stiffness()

    def _matched_springs(self, spring: FrictionSprings, rows: Values) -> FrictionSprings:
        """Springs of the points with the identity `rows`, as the surface is now."""
        every = np.arange(len(self.surface.area))
        at = match_points(rows, self.surface.identity(every)) if len(rows) else spring.points
        kept = np.flatnonzero(at >= 0)
        kept = kept[np.argsort(at[kept])]
        return FrictionSprings(at[kept], spring.slip[kept], spring.stiffness[kept])

    def snapshot(self) -> object:
        """That of the points, and what the step ended with."""
        return super().snapshot(), self._step_end

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        points, self._step_end = cast("tuple[object, StepEnd]", memory)
        super().restore(points)

    def to_checkpoint(self) -> dict[str, Values]:
        """With rows of springs: obstacle, rank, share of the surface, identity, stretch, stiffness; and sums of forces
        on each rank, on rank 0 (collective). Ranks that share a point have a spring there each."""
        rows = [
            np.column_stack([np.full(len(each.points), k), np.full(len(each.points), self.comm.rank),
                             self.surface.area[each.points], self.surface.identity(each.points),
                             each.slip, each.stiffness])
            for k, each in enumerate(self._step_end.springs)
        ]  # fmt: skip
        gathered = gather(self.comm, (np.concatenate(rows), np.array(self._step_end.forces)))
        if gathered is None:
            return super().to_checkpoint()
        springs, pushed = zip(*gathered, strict=True)
        return super().to_checkpoint() | {"springs": np.concatenate(springs), "pushed": np.array(pushed)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        rows, pushed = saved["springs"], saved["pushed"]
        springs = [self._springs_from_rows(rows[rows[:, 0] == number, 1:]) for number in range(len(self.obstacles))]
        if len(pushed) == self.comm.size:
            own = pushed[self.comm.rank]
        else:  # by other ranks: the sum is what counts
            own = pushed.sum(axis=0) if self.comm.rank == 0 else np.zeros_like(pushed[0])
        self._step_end = StepEnd(springs, list(own))

    def _springs_from_rows(self, rows: Values) -> FrictionSprings:
        """Springs of the points of this rank, from rows of all ranks as `saved` has them. Where several had a spring at
        the same point that of this rank counts, or of the lowest, for the share that this rank has now."""
        rank, area, known, slip, k = np.split(rows, [1, 2, -1 - self._domain.dim, -1], axis=1)
        at = match_points(known, self.surface.identity(np.arange(len(self.surface.area))))
        order = np.lexsort((rank[:, 0], rank[:, 0] != self.comm.rank, at))
        order = order[at[order] >= 0]
        points, first = np.unique(at[order], return_index=True)
        which = order[first]
        had = area[which, 0]
        share = np.where(had > 0, self.surface.area[points] / np.where(had > 0, had, 1.0), 1.0)
        return FrictionSprings(points, slip[which], share * k[which, 0])


def _no_tangent() -> tuple[Values, Values]:
    raise NotImplementedError("explicit steps ask for no tangent")
