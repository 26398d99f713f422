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
from .contact_surface import Cuts, Skin
from .facet_contact import Facets, between, gripped_between, joined, matters
from .friction import Friction
from .laws import Law
from .node_contact import Grip, Start, Touch, grip, nothing, touch
from .obstacle import Obstacle
from .pose import Placed, least_distance
from .step_limit import Course, check_apart, refuse_overlap

Values = npt.NDArray[np.float64]


class Touching:
    """Obstacles, and the points that they act on at the end of a step.

    Attributes:
        obstacles: held or driven (or free: free_obstacles).    law: how they act.    skin: what touches them.
        x: (n, d) where its points are at the end of the step that belongs to u, m.
    """

    x: Values
    _grips: list[Grip | None]  # what friction holds of each
    _begun: list[Start | None]  # the points before each at the start of the step, where barriers act along the way

    def __init__(self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law) -> None:
        """InputError where the body at rest lies in an obstacle, or a free obstacle in another one (collective)."""
        self.obstacles, self.law, self.skin = tuple(obstacles), law, Skin(domain, law.barrier.width)
        self._course = Course(self.obstacles, self._led())
        self._domain, self._u, self._owned = domain, u, domain.node_count * domain.dim
        self.comm = domain.comm
        self._touches: list[Touch] | None = None
        self._end, self._dt = -np.inf, 0.0  # s, of the step that is taken or has been
        self._attempts = 0  # of Newton's method in it
        self._tangent_at: Values | None = None  # places of the points at the last tangent of this attempt
        check_apart(self.comm, self.skin.rest, self.obstacles)
        if any(each.free for each in self.obstacles):
            from .initial_overlap import check_free_apart

            check_free_apart(self.obstacles)
        self._sharp = self._felt_between()
        if self._sharp:
            self._check_facets()

    def _felt_between(self) -> list[int]:
        """Numbers of those that facets feel between their corners (collective)."""
        edge, width, every = self.skin.edge, self.law.barrier.width, enumerate(self.obstacles)
        return [number for number, each in every if matters(each.shape.least_radius, edge, width)]

    @property
    def edge(self) -> float:
        """Of the body's mesh in the mean, m (collective)."""
        return self.skin.edge

    @property
    def width(self) -> float:
        """Of the barrier, m."""
        return self.law.barrier.width

    def felt_by_points_alone(self) -> list[tuple[Obstacle, bool]]:
        """Each obstacle, and whether nothing between points feels it."""
        return [(each, number not in self._sharp) for number, each in enumerate(self.obstacles)]

    def _check_facets(self) -> None:
        """InputError where a facet of the body at rest is cut; what is nearly so waits until there is room
        (collective)."""
        x, placed = self.skin.rest, [each.placed(0.0) for each in self.obstacles]
        for number in self._sharp:
            distances = self.skin.facets.distances(placed[number], x, 0.0)
            refuse_overlap(self.comm, distances, number, self.obstacles[number])
        cuts = self._cuts(placed)
        assert cuts is not None
        self.skin.leave_out_cut(x, cuts)

    def _facets(self, number: int) -> Facets | None:
        """Facets that feel an obstacle."""
        return self.skin.facets if number in self._sharp else None

    def _cuts(self, placed: Sequence[Placed]) -> Cuts | None:
        """Gaps between facets and the obstacles that they feel, where these are now; None: they feel none."""
        if not self._sharp:
            return None
        sharp, width = [placed[number] for number in self._sharp], self.law.barrier.width
        return lambda facets, x: np.asarray(np.min([facets.gaps(each, x, width) for each in sharp], axis=0))

    def _are_uncut(self, x: Values) -> bool:
        """Whether no facet is cut with points at x (n, d) (collective)."""
        if (cuts := self._cuts(self._course.placed)) is None:
            return True
        return bool(self.comm.allreduce(bool((cuts(self.skin.facets, x) > 0).all()), op=MPI.LAND))

    def _led(self) -> list[int]:
        """Numbers of those whose way is known: all that are held or driven."""
        return list(range(len(self.obstacles)))

    def begin_step(self, level: TimeLevel) -> None:
        """Obstacles go to where they are at the end of the step; friction holds what is in touch at its start."""
        self._level, self._touches, self._attempts = level, None, 0
        end = level.t + (1 - level.fraction) * level.dt
        if not level.dt and abs(end - self._end) <= 1e-9 * self._dt:
            return  # a look at what a step has ended with: grips and ways are still those of the step
        self._end, self._dt, self._began_with = end, level.dt, level.v_n
        self._take_places(end - level.dt, end)
        self._forget_start()
        if level.dt:
            self._start_of_step()

    def _take_places(self, start: float, end: float) -> None:
        """Where obstacles are at the ends of a step, s."""
        self._course.begin(start, end)

    def _start_of_step(self) -> None:
        at = self._course.at_start
        self.skin.make_room(self._level.u_n, partial(least_distance, at), self._cuts(at))
        x = self.skin.places(self._level.u_n)
        gaps = [placed.distance(x) for placed in at]
        held = [grip(x, gap, self.skin.area, placed, self.law.barrier) for gap, placed in zip(gaps, at, strict=True)]
        if self._level.contact_weights.time_averaged:
            self._begun = [
                Start(gap, each.points, each.normal, each.start) for gap, each in zip(gaps, held, strict=True)
            ]
        self._pushed = [each.force @ each.normal for each in held]
        for number in self._sharp:
            found, _ = between(self.skin.facets, at[number], x, self.law.barrier)
            self._pushed[number] = self._pushed[number] + found.forces.sum(axis=(0, 1))
            if self.obstacles[number].friction:
                held[number] = gripped_between(held[number], found, x)
        self._grips = [each if obstacle.friction else None for each, obstacle in zip(held, self.obstacles, strict=True)]
        self._began = x

    def _forget_start(self) -> None:
        """The points are others than those that the step began with."""
        none = [None] * len(self.obstacles)
        self._grips, self._begun, self._touches, self._tangent_at = [*none], [*none], None, None

    def _at_end(self) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to the current u, m."""
        return self._level.displacement_at_end(self._u.x.array[: self._owned])

    def touching(self) -> list[Touch]:
        """What each obstacle does at the current u (collective)."""
        if self._touches is None:
            self.x = self.skin.places(self._at_end())
            self._touches = [self._feel(number, placed) for number, placed in enumerate(self._course.placed)]
        return self._touches

    def _feel(self, number: int, placed: Placed) -> Touch:
        """What an obstacle at `placed` does to the points where they are now."""
        if self._is_far(number, placed):
            return nothing(self._domain.dim)
        obstacle, held = self.obstacles[number], self._grips[number]
        rub = Friction(obstacle.friction, self.law.creep * self._dt) if held is not None else None
        under, start = self._under(number, placed), self._begun[number]
        if start is not None:
            start = start.seen(self._course.at_start[number].pose, placed.pose)
        found = touch(self.x, self.skin.area, placed, self.law.barrier, held, rub, under, start)
        if number not in self._sharp:
            return found
        then = None if start is None else (self._course.at_start[number], self._began)
        inner, stored = between(self.skin.facets, placed, self.x, self.law.barrier, then)
        return joined(found, inner, stored)

    def _is_far(self, number: int, placed: Placed) -> bool:
        """Whether an obstacle at `placed` is too far from all points to be felt, and was so as the step began."""
        held, start, width = self._grips[number], self._begun[number], self.law.barrier.width
        if (held is not None and len(held.points)) or (start is not None and len(start.known)):
            return False
        if placed.beyond(self.x) < width:
            return False
        return start is None or number not in self._sharp or self._course.at_start[number].beyond(self._began) >= width

    def _under(self, number: int, placed: Placed) -> Values:
        """(d,) or (k, d) way in the step of what is under the points that friction holds, m."""
        return np.asarray(self._course.ways[number][: self._domain.dim])

    def forces(self) -> Values:
        """(owned dofs,) forces of the obstacles on the nodes at the end of the step, N (collective)."""
        forces = np.zeros_like(self.skin.rest)
        for each in self.touching():
            forces[each.points] += each.normal + each.friction
        return self.skin.follow.assemble_to_nodes(forces)

    def rubbed(self, number: int) -> tuple[float, float]:
        """Work of friction on the body in the step, and what of it an obstacle does by its own way, this rank's share,
        J (collective); the rest is lost."""
        found, held = self.touching()[number], self._grips[number]
        if held is None or not len(held.points):
            return 0.0, 0.0
        force = found.friction[np.searchsorted(found.points, held.points)]
        under = self._under(number, self._course.placed[number])
        return float(np.vdot(force, self.x[held.points] - held.start)), float((force * under).sum())
