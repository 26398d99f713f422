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
from .laws import Law
from .node_contact import Touch
from .obstacle import Obstacle
from .obstacle_term import Obstacles
from .penalty_law import Carried
from .pose import Placed, least_distance

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Springs:
    """The springs of one obstacle.

    Attributes:
        points: (k,) of the surface, ascending.    slip: (k, d) by which they are stretched, m.
        stiffness: (k,) N/m.
    """

    points: Ints
    slip: Values
    stiffness: Values

    @classmethod
    def none(cls, dim: int) -> Springs:
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

    def pulled(self, points: Ints, moved: Values, normal: Values, stiffness: Values, most: Values) -> Springs:
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
        return Springs(points, share[:, None] * slip, stiffness)

    def lost(self, before: Springs, moved: Values) -> float:
        """What friction has taken, J, as points (n, d) moved by `moved`: its work by the trapezoidal rule, less what
        the springs store."""
        work = sum(float(np.vdot(each.force, moved[each.points])) for each in (before, self)) / 2
        return before.energy - self.energy - work


@dataclass(frozen=True)
class Past:
    """What a step ended with: the springs of each obstacle, and the sums (d,) of its forces on the body, N."""

    springs: list[Springs]
    pushed: list[Values]


class ExplicitObstacles(Obstacles):
    """Obstacles that explicit steps run into.

    Attributes:
        stiffness: (n,) k_p of the points of this rank, N/m.
    """

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law, mass: Values, most: float
    ) -> None:
        """`mass`: (owned dofs,) lumped, kg; `most`: what contact may add to the square of the highest frequency, 1/s^2.

        InputError where the body at rest lies in an obstacle (collective).
        """
        self._mass, self._most = mass, most
        self._past = self._at_rest(len(obstacles), domain.dim)
        self._from: Values | None = None  # places of the points at the start of a step that is under way
        self._springs = self._past.springs
        super().__init__(domain, u, obstacles, law)
        self._stiffen()

    def _felt_between(self) -> list[int]:
        return []  # facets have no penalty of their own

    @staticmethod
    def _at_rest(count: int, dim: int) -> Past:
        return Past([Springs.none(dim)] * count, [np.zeros(dim)] * count)

    # --- how stiff it is ---

    def _stiffen(self) -> None:
        """Stiffness of the points of the surface as it is now (collective)."""
        at, area = self.skin.at, self.skin.area
        carried = Carried(at, self.skin.follow, self._mass)
        self.stiffness: Values = self.law.barrier.curvature(np.zeros(len(area))) * area
        if np.isfinite(self._most):
            self.stiffness = np.minimum(self.stiffness, self._most * carried.masses(area))
        self._fastest, self._stiffened = carried.fastest(self.stiffness), (at, area)

    def frequency_bound(self) -> float:
        """What contact adds at most, were all points in touch, 1/s^2."""
        return self._fastest

    # --- a step ---

    def _start_of_step(self) -> None:
        self.skin.make_room(self._level.u_n, partial(least_distance, self._course.at_start))
        at, area = self._stiffened
        if self.comm.allreduce(at is not self.skin.at or area is not self.skin.area):
            self._stiffen()
        self._from = self.skin.places(self._level.u_n)

    def _feel(self, number: int, placed: Placed) -> Touch:
        law, gap = self.law.barrier, placed.distance(self.x)
        points = np.flatnonzero((gap < law.width) & (self.skin.area > 0))
        gap, k, normal = gap[points], self.stiffness[points], placed.normal(self.x[points])
        pressed = k * (law.width - gap)
        energy, rubbed = 0.5 * float(pressed @ (law.width - gap)), np.zeros_like(normal)
        if friction := self.obstacles[number].friction:
            moved = self._moved(number, placed)[points]
            spring = self._past.springs[number].pulled(points, moved, normal, k, friction * pressed)
            self._springs[number], rubbed, energy = spring, spring.force, energy + spring.energy
        return Touch(points, energy, pressed[:, None] * normal, rubbed, 0.0, _no_tangent)

    def _moved(self, number: int, placed: Placed) -> Values:
        """(n, d) way of the points over an obstacle in the step, m; none once it is over."""
        if self._from is None:
            return np.zeros_like(self.x)
        return np.asarray(self.x - self._from - self._way_under(number, placed))

    def _way_under(self, number: int, placed: Placed) -> Values:
        """(d,) or (n, d) way in the step of what is under the points, m."""
        return np.asarray(self._course.ways[number][: self._domain.dim])

    def touching(self) -> list[Touch]:
        """What each obstacle does at the current u (collective)."""
        if self._touches is None:
            self._springs = list(self._past.springs)
        return super().touching()

    def accept_step(self) -> None:
        """The step is over: its work is summed, and its springs are those that the next begins with (collective)."""
        found, past = self.touching(), self._past
        pushed = [(each.normal + each.friction).sum(axis=0) for each in found]
        self._lost, self._read = 0.0, [-each for each in pushed]
        for number, (obstacle, placed) in enumerate(zip(self.obstacles, self._course.placed, strict=True)):
            if obstacle.friction:
                self._lost += self._springs[number].lost(past.springs[number], self._moved(number, placed))
        for number in self._course.led:
            shift = self._course.ways[number][: self._domain.dim]
            self._worked[number] = float((pushed[number] + past.pushed[number]) @ shift) / 2
        self._past, self._from = Past(self._springs, pushed), None

    # --- its past ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Springs of points that are still there go on (collective)."""
        held = [(spring, self.skin.identity(spring.points)) for spring in self._past.springs]
        super().edges_broke(pattern)
        self._past = Past([self._again(*each) for each in held], self._past.pushed)
        self._stiffen()

    def _again(self, spring: Springs, rows: Values) -> Springs:
        """Springs of the points with the identity `rows`, as the surface is now."""
        at = match_points(rows, self.skin.identity(np.arange(len(self.skin.area)))) if len(rows) else spring.points
        kept = np.flatnonzero(at >= 0)
        kept = kept[np.argsort(at[kept])]
        return Springs(at[kept], spring.slip[kept], spring.stiffness[kept])

    def snapshot(self) -> object:
        """That of the points, and what the step ended with."""
        return super().snapshot(), self._past

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        points, self._past = cast("tuple[object, Past]", memory)
        super().restore(points)

    def to_checkpoint(self) -> dict[str, Values]:
        """With rows of springs: obstacle, rank, share of the surface, identity, stretch, stiffness; and sums of forces
        on each rank, on rank 0 (collective). Ranks that share a point have a spring there each."""
        rows = [
            np.column_stack([np.full(len(each.points), k), np.full(len(each.points), self.comm.rank),
                             self.skin.area[each.points], self.skin.identity(each.points), each.slip, each.stiffness])
            for k, each in enumerate(self._past.springs)
        ]  # fmt: skip
        gathered = gather(self.comm, (np.concatenate(rows), np.array(self._past.pushed)))
        if gathered is None:
            return super().to_checkpoint()
        springs, pushed = zip(*gathered, strict=True)
        return super().to_checkpoint() | {"springs": np.concatenate(springs), "pushed": np.array(pushed)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        rows, pushed = saved["springs"], saved["pushed"]
        springs = [self._springs_of(rows[rows[:, 0] == number, 1:]) for number in range(len(self.obstacles))]
        if len(pushed) == self.comm.size:
            own = pushed[self.comm.rank]
        else:  # by other ranks: the sum is what counts
            own = pushed.sum(axis=0) if self.comm.rank == 0 else np.zeros_like(pushed[0])
        self._past = Past(springs, list(own))

    def _springs_of(self, rows: Values) -> Springs:
        """Springs of the points of this rank, from rows of all ranks as `saved` has them. Where several had a spring at
        the same point that of this rank counts, or of the lowest, for the share that this rank has now."""
        rank, area, known, slip, k = np.split(rows, [1, 2, -1 - self._domain.dim, -1], axis=1)
        at = match_points(known, self.skin.identity(np.arange(len(self.skin.area))))
        order = np.lexsort((rank[:, 0], rank[:, 0] != self.comm.rank, at))
        order = order[at[order] >= 0]
        points, first = np.unique(at[order], return_index=True)
        which = order[first]
        had = area[which, 0]
        share = np.where(had > 0, self.skin.area[points] / np.where(had > 0, had, 1.0), 1.0)
        return Springs(points, slip[which], share * k[which, 0])


def _no_tangent() -> tuple[Values, Values]:
    raise NotImplementedError("explicit steps ask for no tangent")
