"""Contact of a body with solids of which some move freely: the same term, with their poses as further unknowns.

As for other free obstacles (free_obstacles): the body sees what is left once the poses are eliminated, which rank 0
finds; all ranks are told.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..errors import InputError
from ..forms.schemes import Scheme
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from .barrier import Barrier
from .ipc_surface import Law
from .mesh_obstacle_term import Solids, led_past
from .mesh_obstacles import Front
from .mesh_rigid_body import Before, FreeSolid
from .obstacle import Flight, FreeObstacle, Obstacle, rows_of
from .obstacle_pairs import Stops
from .pose import Placed, Pose
from .rigid_body import RigidStep
from .rigid_obstacle_state import columns_of
from .step_limit import Going
from .triangle_mesh_shape import Solid

Values = npt.NDArray[np.float64]


class FreeSolids(Solids):
    """Solids, at least one of them free.

    Attributes:
        free: the free ones by their place among `obstacles`.
    """

    exact_at_end = False  # what is left of poses has a positive part alone
    free: dict[int, FreeSolid]

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        obstacles: dict[int, Obstacle],
        law: Law,
        scheme: Scheme,
        others: dict[int, Obstacle],
        barrier: Barrier,
    ) -> None:
        """As for Solids; `others`: held or driven obstacles of other shapes, which free solids meet with their points
        by that barrier. InputError where one overlaps the body at rest, or a free one another (collective)."""
        bodies = {k: each for k, each in enumerate(obstacles.values()) if isinstance(each, FreeObstacle)}
        self.free = {k: FreeSolid(each) for k, each in bodies.items()}
        self._scheme, self._others, self._settled = scheme, others, True
        super().__init__(domain, u, obstacles, law)
        self._others_at = self._others_from = {number: each.placed(0.0) for number, each in others.items()}
        self._others_way: dict[int, Values] = {number: np.zeros(6) for number in others}
        if self._solids:  # on rank 0
            for k, each in self.free.items():
                each.stops = Stops(self._refined(k), others, barrier)
        on_root(self.comm, self._check_stops)

    def _refined(self, k: int) -> FreeObstacle:
        body, standing = self.free[k].body, self._solids[k]
        return replace(body, shape=Solid(standing.points, standing.triangles))

    def _check_stops(self) -> None:
        for k, each in self.free.items():
            if not each.stops.are_open(each.pose, self._others_at):
                raise InputError(
                    f"{self._solids[k].name} moves freely and overlaps another obstacle at the start; move it away or "
                    "make it smaller"
                )

    # --- a step ---

    def _take_places(self, start: float, end: float) -> None:
        super()._take_places(start, end)
        self._others_from = {number: each.placed(start) for number, each in self._others.items()}
        self._others_at = {number: each.placed(end) for number, each in self._others.items()}
        self._others_way = {number: each.way(start, end) for number, each in self._others.items()}
        level = self._level
        for k, each in self.free.items():
            self._from[k], self._ways[k] = each.flight.pose, np.zeros(6)
            each.look()
            if level.dt:
                factor = level.contact_weights.factor
                each.begin(RigidStep(each.body, each.flight, self._scheme, level.dt, level.c_a, level.fraction, factor))
                if self.comm.rank == 0:
                    each.stops.begin(each.pose, self._others_from, along=level.contact_weights.time_averaged)

    def begin_step(self, level: TimeLevel) -> None:
        """Free ones stay where they begin until they are looked for."""
        super().begin_step(level)
        self._settled = False

    def _gone_to(self, number: int, gone: float) -> Pose:
        return self.free[number].pose if number in self.free else super()._gone_to(number, gone)

    def accept_step(self) -> None:
        """The step is over: solids have the momentum that it gave them (collective)."""
        super().accept_step()
        x = None if self._is_far() else self._places()
        flights = from_root(self.comm, lambda: {k: self._arrived(k, x) for k in self.free})
        for each in self.free.values():
            each.found()
        self.fly(flights)

    def _arrived(self, k: int, x: Values | None) -> Flight:
        each = self.free[k]
        return each.step.arrived(each.z, each.pushed(self._before(k, x)))

    # --- where free ones are ---

    @property
    def _under_way(self) -> bool:
        return bool(self._level.dt) and all(each.is_under_way for each in self.free.values())

    def update_displacement(self) -> None:
        """All has to be found anew."""
        super().update_displacement()
        self._settled = False

    def _is_far(self) -> bool:
        self._settle()
        return super()._is_far()

    def _places(self) -> Values | None:
        self._settle()
        return super()._places()

    def _settle(self) -> None:
        """Free ones are where they belong with the body at the current u (collective)."""
        if self._settled or not self._under_way:
            return
        self._settled = True
        for near in (not super()._is_far(), True):
            x = super()._places() if near else None
            self._put_free(from_root(self.comm, partial(self._settled_ways, x)))
            if near or super()._is_far():
                break

    def _settled_ways(self, x: Values | None) -> dict[int, Values]:
        """(k,) z of each, on rank 0."""
        return {k: each.settle(self._before(k, x)) for k, each in self.free.items()}

    def _put_free(self, ways: Mapping[int, Values]) -> None:
        for k, z in ways.items():
            self.free[k].put(z)
            self._now[k] = self.free[k].pose
            if self._solids:
                self._solids[k].put(self.free[k].pose)
        self._far = self._struck = None

    def _before(self, k: int, x: Values | None) -> Before:
        """What is around a free one, on rank 0; `x`: as in Before."""
        if x is None or self._surface is None:
            return Before(None, None, None, self._others_at)
        facing = self._surface.pairs.each[k]
        rubbing = None if self._rubbing is None else self._rubbing.with_one(facing)
        return Before(facing, rubbing, x, self._others_at, self._start)

    # --- what they add to the balance ---

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """Phi_xz and Phi_zz^-1 of each that is touched and under way (collective)."""
        if not self._under_way or self._is_far():
            return []
        x = self._places()

        def found() -> list[tuple[Values, Values]]:
            assert self._surface is not None and x is not None
            given = [self.free[k].given_way(self._before(k, x)) for k in self.free]
            return [(self._to_nodes(mixed), compliance) for mixed, compliance in (each for each in given if each)]

        parts = on_root(self.comm, found) or []
        self._put_free({k: each.z for k, each in self.free.items()})
        compliances = self.comm.bcast([compliance for _, compliance in parts])
        mixed = [self._gather.scatter(parts[i][0] if parts else None) for i in range(len(compliances))]
        return [(U.reshape(self._owned, len(C)), C) for U, C in zip(mixed, compliances, strict=True)]

    def _to_nodes(self, mixed: Values) -> Values:
        """(nodes, 3 k) of what is (3 n, k) at points."""
        assert self._surface is not None
        return self._surface.handed_down(mixed.reshape(-1, 3 * mixed.shape[1]))

    def potential(self) -> float:
        """With the inertia and the weight of free ones, on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            for each in self.free.values():
                energy += each.step.own(each.z) + level.contact_weight * level.fraction * self._stopped(each)[1]
        return energy

    def stored_energy(self) -> float:
        """With the barriers between obstacles, on rank 0, J (collective)."""
        energy = super().stored_energy()
        return energy + sum(self._stopped(each)[0] for each in self.free.values()) if self.comm.rank == 0 else energy

    def _stopped(self, each: FreeSolid) -> tuple[float, float]:
        return each.stops.energies(each.pose, self._others_at)

    def kinetic_energy(self) -> float:
        """Energy of motion of the free solids, on rank 0, J."""
        return 0.0 if self.comm.rank else sum(float(each.body.told(each.flight)[-1]) for each in self.free.values())

    def step_work(self) -> tuple[float, float]:
        """With the work of gravity, and of other obstacles' motion, on free ones; on rank 0, J."""
        work = sum(done for k, done in enumerate(self._worked) if k not in self.free)
        if self.comm.rank == 0:
            for k, each in self.free.items():
                work += each.body.weight(self._from[k])[0] - each.body.weight(each.pose)[0]
                work += each.stops.work(each.pose, self._others_at, self._others_way)
        return work, self._lost

    # --- how far Newton's method may go ---

    def _free(self, x: Values | None, way: Values | None) -> float:
        assert self._surface is not None and x is not None and way is not None
        moved, before, shares = self._surface.at.weights @ way, [each.pose for each in self._solids], [1.0]
        for k, each in self.free.items():
            pose = each.taken_along(self._before(k, x), moved)
            still: dict[int, Going] = {number: (placed, np.zeros(6)) for number, placed in self._others_at.items()}
            shares.append(each.stops.safe_share(before[k], before[k].way_to(pose), still))
            each.put(each.z)
            self._solids[k].put(pose)
        shares.append(self._surface.pairs.along(x, x + moved, before))
        for k in self.free:
            self._solids[k].put(before[k])
        return min(shares)

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u that has passed through nothing on its way from the start: free solids stop,
        or the body with them, before they meet (collective)."""
        if not self._level.dt:
            return super().feasible_guess(u)
        for each in self.free.values():
            each.forget_way()
        self._put_free({k: each.step.ahead for k, each in self.free.items()})
        guess = super().feasible_guess(u)
        self._put_free(self.comm.bcast({k: each.z for k, each in self.free.items()}))
        self._settled = False
        return guess

    def _guided(self, front: Front, start: Values, end: Values) -> Values:
        led = [k for k in range(len(self.obstacles)) if k not in self.free]
        to, share = end, 1.0
        if led:
            to = led_past(front, front.pairs.some(led), start, end, [self._from[k] for k in led])
        ways = [*(self._ways[k] for k in led), *self._others_way.values()]
        x_to, taken = front.at(to), {}
        self._start = front.at(start) if self._start is None else self._start
        for k, each in self.free.items():
            around = Before(front.pairs.each[k], None, None, self._others_from, self._start)
            taken[k], safe = each.guess(around, x_to, ways)
            share = min(share, safe)
        self._put_free({k: share * z for k, z in taken.items()})
        return to if share == 1 else start + share * (to - start)

    def is_feasible(self, u: Values) -> bool:
        """Whether nothing is passed on the straight way from the start to u, nor any stop entered (collective)."""
        at = self._others_at
        every = self.free.values()
        apart = from_root(self.comm, lambda: all(each.stops.are_open(each.pose, at) for each in every))
        return super().is_feasible(u) and apart

    def restrict_motion(self) -> None:
        """All stay where the step began (collective)."""
        self._put_free({k: 0 * each.z for k, each in self.free.items()})
        super().restrict_motion()

    # --- their flights are their past, and told ---

    def flights(self) -> dict[int, Flight]:
        """How each moves, by its place."""
        return {k: each.flight for k, each in self.free.items()}

    def fly(self, flights: Mapping[int, Flight]) -> None:
        """Move again as `flights` gave it."""
        for k, each in self.free.items():
            each.flight = flights[k]

    def snapshot(self) -> object:
        """That of the surface, and how solids move."""
        return super().snapshot(), self.flights()

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        surface, flights = cast("tuple[object, dict[int, Flight]]", memory)
        super().restore(surface)
        self.fly(flights)

    def to_checkpoint(self) -> dict[str, Values]:
        """With rows of how solids move (collective)."""
        return super().to_checkpoint() | {"flights": rows_of(each.flight for each in self.free.values())}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        for row, each in enumerate(self.free.values()):
            each.flight = each.flight.like(saved["flights"][row])

    def where(self, t: float) -> list[Placed]:
        """Each solid at the time t of the state, s (not collective)."""
        here = super().where(t)
        for k, each in self.free.items():
            here[k] = Placed(here[k].shape, each.flight.pose)
        return here

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """With the columns of all that are free (flights)."""
        return super().summed_columns() | columns_of(self.free.values(), self.comm)
