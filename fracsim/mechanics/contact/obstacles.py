"""Contact of a body with obstacles: a term of the balance (METHOD section 9).

    E(u) = sum over obstacles of  int b(gap(x)) dA  +  sum over points in touch of  mu lambda f0(|s|)

over the split surface x(u) (mesh.split.local), each point with its share of the reference surface. Forces balance where
the body will be at the end of a step, u_n + (u - u_n) / share, whatever level the scheme solves at; of a level inside
the step they count with its share, and those of the step's start with the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import bsr_matrix, csr_matrix, kron

from ...mesh.domain import Domain
from ...mesh.ranks import total
from ...mesh.split.identity import found_again
from ...mesh.split.local import Following, LocalSurface
from ...mesh.split.places import Places
from ...meshes.words import AXES
from ..coupling import Coupling
from ..drawn import Drawn
from ..term import Level, Term
from .barrier import Barrier
from .drawing import Drawing, least_extent
from .friction import Friction
from .obstacle import Obstacle
from .placed import Placed
from .reach import check_apart, safe_shares, within_reach
from .room import Known, drawn_in, let_out
from .touch import Grip, Touch, grip, touch

Values = npt.NDArray[np.float64]
TINY = float(np.finfo(float).tiny)
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Law:
    """How contact acts: the barrier, and the speed of slip, m/s, below which friction passes for sticking."""

    barrier: Barrier
    creep: float


class Obstacles(Term):
    """Obstacles that the body cannot pass through.

    Attributes:
        obstacles: held or driven (or free: free_obstacles).    law: how they act.    led: numbers of the former.
        area: (n,) of the points of this rank's surface, m^2; 0 of those left out.    follow: from nodes to points.
    """

    name = "obstacles"
    keeps_apart = True
    visible = True

    def __init__(self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law) -> None:
        """InputError where the body at rest lies in an obstacle (collective)."""
        self.obstacles, self.law = tuple(obstacles), law
        self.led = self._known()
        self._domain, self._u, self._owned = domain, u, domain.node_count * domain.dim
        self.comm = domain.comm
        self._surface, self._coupling = LocalSurface(domain), Coupling(domain)
        self.follow = Following(domain, self._surface)
        self.area: Values = self._surface.area
        self._touches: list[Touch] | None = None
        self._worked = [0.0] * len(self.obstacles)  # J, of each in the last step
        self._end, self._dt = -np.inf, 0.0  # s, of the step that is taken or has been
        check_apart(self.comm, self._surface.at.rest, self.obstacles)

    def _known(self) -> list[int]:
        """Those whose way is known: all that are held or driven."""
        return list(range(len(self.obstacles)))

    # --- a step ---

    def begin(self, level: Level) -> None:
        """Obstacles go to where they are at the end of the step; friction holds what is in touch at its start."""
        self._level, self._touches, late = level, None, 1 - level.share
        end = level.t + late * level.dt
        if not level.dt and abs(end - self._end) <= 1e-9 * self._dt:
            return  # a look at what a step has ended with: grips and ways are still those of the step
        self._end, self._dt, self._began_with = end, level.dt, level.v
        self._take_places(end - level.dt, end)
        self._grips: list[Grip | None] = [None] * len(self.obstacles)
        self._gone = 1.0  # share of their way
        if level.dt:
            self._start_of_step(late)

    def _take_places(self, start: float, end: float) -> None:
        """Where obstacles are at the ends of a step, s."""
        self._placed = [each.placed(end) for each in self.obstacles]
        self._at_start = [each.placed(start) for each in self.obstacles]
        self._ways = [each.way(start, end) for each in self.obstacles]

    def _start_of_step(self, late: float) -> None:
        at = self._at_start
        self._make_room(self.follow.nodal(self._level.u), at)
        x = self.places(self._level.u)
        held = self._starts = [grip(x, self.area, placed, self.law.barrier) for placed in at]
        self._grips = [each if obstacle.friction else None for each, obstacle in zip(held, self.obstacles, strict=True)]
        pushed = [each.force[:, None] * each.normal for each in held]
        self._pushed = [forces.sum(axis=0) for forces in pushed]
        self._before: Values = np.zeros(self._owned)
        if late:
            forces = np.zeros_like(x)
            for each, push in zip(held, pushed, strict=True):
                forces[each.points] += push
            self._before = np.asarray(late * self.follow.handed_down(forces))

    def displaced(self) -> None:
        """What touches has to be found anew."""
        self._touches = None

    def places(self, u: Values) -> Values:
        """(n, d) x of the points at the owned displacements u, m (collective)."""
        return np.asarray(self._surface.at.rest + self.follow(u))

    def _touching(self) -> list[Touch]:
        """What each obstacle does at the current u (collective)."""
        if self._touches is None:
            self.x = self.places(self._level.at_end(self._u.x.array[: self._owned]))
            self._touches = [self._touch(number) for number in range(len(self.obstacles))]
        return self._touches

    def _touch(self, number: int) -> Touch:
        obstacle, held = self.obstacles[number], self._grips[number]
        rub = Friction(obstacle.friction, self.law.creep * self._dt) if held is not None else None
        return touch(self.x, self.area, self._placed[number], self.law.barrier, held, rub, self._under(number))

    def _under(self, number: int) -> Values:
        """(d,) or (k, d) way in the step of what is under the points that friction holds, m."""
        return np.asarray(self._ways[number][: self._domain.dim])

    # --- what it adds to the balance ---

    def _forces(self, *, normal: bool = True) -> Values:
        """(owned dofs,) forces of the obstacles on the nodes at the end of the step, N; those of friction alone where
        not `normal` (collective)."""
        forces = np.zeros_like(self._surface.at.rest)
        for each in self._touching():
            forces[each.points] += each.friction + (each.normal if normal else 0.0)
        return self.follow.handed_down(forces)

    def add_force(self, rows: Values) -> None:
        """r -= forces (collective)."""
        rows -= self.scale()

    def scale(self) -> Values:
        """(owned dofs,) forces at the level, N (collective)."""
        share = self._level.share
        return self._forces() if share == 1 else share * self._forces() + self._before

    def coupling(self) -> PETSc.Mat | None:
        """Minus the derivative of the forces, where anything is in touch (collective)."""
        touches, d = self._touching(), self._domain.dim
        count = int(total(self.comm, sum(len(each.points) for each in touches))[0])
        if not count:
            return None
        points = np.concatenate([each.points for each in touches])
        blocks = np.concatenate([each.stiffness for each in touches])
        W = kron(self._surface.at.weights[points], np.eye(d), format="csr")
        return self._coupling((W.T @ _diagonal(blocks) @ W).tocsr(), self._surface.columns)

    def stored(self) -> float:
        """Energy of the barriers at the current u, this rank's share, J (collective)."""
        return sum(each.energy for each in self._touching())

    def potential(self) -> float:
        """share^2 times barriers and friction at the end of the step, less what the start's forces do, this rank's
        share, J (collective)."""
        share, u = self._level.share, self._u.x.array[: self._owned]
        energy = sum(each.energy + each.friction_energy for each in self._touching())
        return energy if share == 1 else share**2 * energy - float(self._before @ u)

    def drag(self) -> Values | None:
        """(owned dofs,) minus the forces of friction, N (collective)."""
        return -self._forces(normal=False) if any(each.friction for each in self.obstacles) else None

    # --- how far Newton's method may go ---

    def longest_step(self, change: Values) -> float:
        """Share of a change of u that closes no gap by more than nine tenths (collective)."""
        self._touching()
        moved = self.follow(np.divide(change, self._level.share))
        along = zip(self._placed, self._taken_along(moved), strict=True)
        shares = [safe_shares(placed, self.x, moved, q)[self.area > 0] for placed, q in along]
        return float(min(share.min(initial=1.0) for share in shares))

    def _taken_along(self, moved: Values) -> list[Values]:
        """(p,) how each obstacle gives way to a change `moved` (n, d) of the points, m (collective)."""
        return [np.zeros_like(way) for way in self._ways]

    def ways(self) -> list[tuple[Placed, Values]]:
        """Where each obstacle whose way is known is at the start of the step, and its way (p,) to the end."""
        return [(self._at_start[number], self._ways[number]) for number in self.led]

    def reachable(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u that has passed through nothing on its way from the start (collective)."""
        level = self._level
        if not level.dt:
            return u
        end = within_reach(self, level.u, self._level.at_end(u))
        return np.asarray(level.u + level.share * (end - level.u))

    def clear(self, u: Values) -> bool:
        """Whether every gap is open with the body at u (collective)."""
        x = self.places(self._level.at_end(u))
        least = [placed.distance(x)[self.area > 0].min(initial=np.inf) for placed in self._placed]
        return bool(self.comm.allreduce(min(least) > 0, op=MPI.LAND))

    def hold_back(self) -> None:
        """Obstacles wait on their way where they would meet the body at the step's start: what is jammed between them
        and something else cannot be taken along by a guess (collective)."""
        self._gone = 0.0
        self._go_on(self.places(self._level.u))

    def go_on(self) -> bool:
        """The rest of the way, or as far as the body where it is now lets them (collective)."""
        if self._gone == 1:
            return False
        self._touching()
        self._go_on(self.x)
        return True

    def _go_on(self, x: Values) -> None:
        """A share of the rest of the way that is safe with points at x (n, d)."""
        rest, still = 1 - self._gone, np.zeros_like(x)
        here = [(Placed(placed.shape, placed.pose.moved(self._gone * q)), q) for placed, q in self.ways()]
        shares = [safe_shares(placed, x, still, rest * q)[self.area > 0].min(initial=1.0) for placed, q in here]
        share = self.comm.allreduce(float(min(shares, default=1.0)), op=MPI.MIN)
        self._gone = 1.0 if share == 1 else self._gone + share * rest
        for number, (placed, q) in zip(self.led, self.ways(), strict=True):
            self._placed[number] = Placed(placed.shape, placed.pose.moved(self._gone * q))
        self._touches = None

    # --- what breaks, and what is told ---

    def where(self, t: float) -> list[Placed]:
        """Each obstacle at the time t of the state, s (not collective)."""
        return [each.placed(t) for each in self.obstacles]

    def apart(self, at: Places, u: Values, t: float) -> Places:
        """Drawn in where it would lie in an obstacle, as the points are that touch."""
        gaps = partial(_gaps, self.where(t))
        inside = at.copies[gaps(at(u))[at.copies] <= 0]
        return drawn_in(at, u, inside, at.share[inside], np.full(len(inside), TINY), gaps)[0] if len(inside) else at

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """New walls are part of the surface, drawn in where they would lie in an obstacle (collective)."""
        placed, width = self._placed, self.law.barrier.width
        u = self._level.at_end(self._u.x.array[: self._owned])
        old = self._surface.at
        gap = np.where(self.area > 0, _gaps(placed, self.places(u)), 0.0)
        known = Known.of(self._surface.identity(), old.share[old.copies], gap[old.copies], width)
        self._surface.follow_damage(pattern)
        self.follow.destroy()
        self.follow = Following(self._domain, self._surface)
        at, nodal = self._surface.at, self.follow.nodal(u)
        share, gap = known.again(self._surface.identity(), width)
        self._surface.at, out = drawn_in(at, nodal, at.copies, share, gap, partial(_gaps, placed))
        self._leave_out(out)
        self._grips, self._touches = [None] * len(self.obstacles), None

    def memory(self) -> object:
        """Shares of arms, and areas."""
        return self._surface.at.share, self.area

    def recall(self, memory: object) -> None:
        """Be again what `memory` gave of this surface (not collective)."""
        share, area = cast("tuple[Values, Values]", memory)
        if share is not self._surface.at.share:
            self._surface.at = self._surface.at.drawn_in(share)
        self.area = area

    def saved(self) -> dict[str, Values]:
        """Rows of copies that are drawn in or left out: identity, share, whether left out; on rank 0 (collective)."""
        at = self._surface.at
        which = np.flatnonzero((at.share[at.copies] < 1) | (self.area[at.copies] == 0))
        rows = self._surface.identity()[which]
        of = at.copies[which]
        known = np.column_stack([rows, at.share[of], self.area[of] == 0])
        gathered = self.comm.gather(known)
        return {"drawn_in": np.concatenate(gathered) if gathered is not None else known}

    def restore(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        rows, at = saved["drawn_in"], self._surface.at
        place = found_again(rows[:, :-2], self._surface.identity())
        which, share = at.copies[place[place >= 0]], np.ones(len(at.share))
        share[which] = rows[place >= 0, -2]
        self._surface.at = at.drawn_in(share)
        self._leave_out(which[rows[place >= 0, -1] > 0])

    def _leave_out(self, points: Ints) -> None:
        self.area = self._surface.area.copy()
        self.area[points] = 0.0

    def _make_room(self, nodal: Values, obstacles: Sequence[Placed]) -> None:
        """Points that were drawn in or left out come back as far as there is room."""
        width, gaps = self.law.barrier.width, partial(_gaps, obstacles)
        at = let_out(self._surface.at, nodal, width, gaps)
        if len(out := np.flatnonzero(self.area == 0)):
            at, out = drawn_in(at, nodal, out, np.ones(len(out)), np.full(len(out), width), gaps)
            self._leave_out(out)
        self._surface.at = at

    def readings(self) -> dict[str, Callable[[], Values]]:
        """contact_NAME_AXIS: (1,) forces of the body on each obstacle, this rank's share, N (collective)."""
        return {
            f"contact_{each.name}_{axis}": partial(self._on_obstacle, number, place)
            for number, each in enumerate(self.obstacles)
            for place, axis in enumerate(AXES[: self._domain.dim])
        }

    def least(self) -> dict[str, Callable[[], float]]:
        """gap_NAME: least distance between each obstacle and this rank's surface, m; infinite where it has none."""
        return {f"gap_{each.name}": partial(self._gap, number) for number, each in enumerate(self.obstacles)}

    def works(self) -> dict[str, Callable[[], float]]:
        """work_NAME: what each obstacle has done on the body in the step that has ended, J."""
        return {f"work_{each.name}": partial(self._worked.__getitem__, k) for k, each in enumerate(self.obstacles)}

    def closings(self) -> list[float]:
        """How far each obstacle and the points of this rank that touch it at the end of the step would have come closer
        in it, had nothing stopped them, m (collective)."""
        moved, result = self._dt * self.follow(self._began_with), []
        for way, placed, found in zip(self._ways, self._placed, self._touching(), strict=True):
            pushed = found.points[found.normal.any(axis=1)]  # and not merely rubbed
            closer = np.einsum("ni,ni->n", way[: self._domain.dim] - moved[pushed], placed.normal(self.x[pushed]))
            result.append(float(closer.max(initial=0.0)))
        return result

    def sizes(self) -> list[float]:
        """The least extent of each obstacle, m; infinite of a plane and of one that the body is in."""
        return [least_extent(each.shape) for each in self.obstacles]

    @property
    def edge(self) -> float:
        """Of the body's mesh in the mean, m (collective)."""
        return self._domain.mean_edge

    def _gap(self, number: int) -> float:
        self._touching()
        return float(self._placed[number].distance(self.x)[self.area > 0].min(initial=np.inf))

    def _on_obstacle(self, number: int, axis: int) -> Values:
        found = self._touching()[number]
        return -(found.normal + found.friction)[:, axis].sum(keepdims=True)

    @cached_property
    def _drawings(self) -> list[Drawing]:
        lower, upper = self._domain.lower, self._domain.upper
        return [Drawing(each.placed(0.0), lower, upper) for each in self.obstacles]

    def drawn(self, t: float) -> dict[str, Drawn]:
        """Each obstacle at time t, s, by its name."""
        each = zip(self.obstacles, self._drawings, self.where(t), strict=True)
        return {obstacle.name: drawing(placed) for obstacle, drawing, placed in each}

    def driven(self) -> tuple[float, float]:
        """Work of the obstacles' own motion in the step on this rank, and what of it friction takes, J (collective).

        Friction's `drag` counts the way of the body; the slip is that way less the obstacle's.
        """
        lost = 0.0
        for number in self.led:
            shift, found = self._ways[number][: self._domain.dim], self._touching()[number]
            pushed, rubbed = found.normal.sum(axis=0), float(found.friction.sum(axis=0) @ shift)
            self._worked[number] = float((pushed + self._pushed[number]) @ shift) / 2 + rubbed
            lost += rubbed
        return sum(self._worked[number] for number in self.led), lost

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.follow.destroy()
        self._coupling.destroy()


def _gaps(obstacles: Sequence[Placed], x: Values) -> Values:
    """(n,) least distance of places x (n, d) to the obstacles, m."""
    return np.asarray(np.min([placed.distance(x) for placed in obstacles], axis=0))


def _diagonal(blocks: Values) -> csr_matrix:
    """(n d, n d) of blocks (n, d, d)."""
    n, d = blocks.shape[:2]
    matrix = bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(n * d, n * d))
    return matrix.tocsr()
