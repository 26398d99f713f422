"""Contact with obstacles of which some move freely: the same term, with their poses as further unknowns.

For a body that is at x the poses are the minimum of the incremental potential (rigid_pose), found by a small Newton
method within the term. The body sees what is left, a function of x alone:

    E(x) = min over z of Phi(x, z),    dE/dx = dPhi/dx at that z,    d2E/dx2 = Phi_xx - Phi_xz Phi_zz^-1 Phi_zx

So the system of equations keeps its size, and its solution is the same as if poses were among its unknowns. The last
part couples all points in touch with one another; it is of rank k, the freedoms of an obstacle, and is applied, not
stored. (Without it a disk of a third of the body's mass takes 17,892 iterations in place of 127, or finds no solution.)
Every rank finds the same poses from sums over all ranks. Free obstacles meet those that are held or driven
(obstacle_pairs), and one another (rigid_pose).

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..forms.schemes import Scheme
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .laws import Law
from .node_contact import Touch
from .obstacle import FreeObstacle, Obstacle
from .obstacle_pairs import Stops
from .pose import Placed
from .rigid_body import RigidStep, is_positive
from .rigid_obstacle_state import Flights
from .rigid_pose import Around, FreePose, Mutual

Values = npt.NDArray[np.float64]

WALKS = 4  # until what is held back is let go, whatever it presses on


class FreeObstacles(Flights):
    """Obstacles, at least one of them free.

    Attributes:
        free: the free ones by their number.
    """

    leaves_tangent_incomplete = True
    free: dict[int, FreePose]

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law, scheme: Scheme
    ) -> None:
        """InputError where the body at rest lies in an obstacle (collective)."""
        others = {number: each for number, each in enumerate(obstacles) if not each.free}
        self.free = {
            number: FreePose(each, Stops(each, others, law.barrier))
            for number, each in enumerate(obstacles)
            if isinstance(each, FreeObstacle)
        }
        self._scheme, self._mutual = scheme, Mutual(self.free, law.barrier) if len(self.free) > 1 else None
        self._settled_at: Values | None = None  # places of the points that poses belong to
        self._begins = False  # whether Newton's method begins: nothing has given way to anything yet
        self._waits = 0.0  # share of their way to where they belong that free obstacles are held back from
        self._walks = 0  # on which they have been held back
        super().__init__(domain, u, obstacles, law)

    # --- a step ---

    def _start_of_step(self) -> None:
        super()._start_of_step()
        level, self._settled_at = self._level, None
        for number, each in self.free.items():
            step = RigidStep(
                each.body, each.flight, self._scheme, level.dt, level.c_a, level.fraction, level.contact_weights.factor
            )
            self._course.ways[number] = each.begin(step, self._grips[number])
            each.stops.begin(each.flight.pose, self._course.at_start, along=level.contact_weights.time_averaged)
        if self._mutual is not None:
            self._mutual.begin(along=level.contact_weights.time_averaged)

    def accept_step(self) -> None:
        """The step is over: obstacles have the momentum that it gave them (collective)."""
        super().accept_step()
        found, others = self.touching(), {} if self._mutual is None else self._mutual.forces()
        for number, each in self.free.items():
            each.arrive(found[number], self._around(number), others.get(number, 0.0))

    # --- where free obstacles are ---

    def touching(self) -> list[Touch]:
        """What each obstacle does at the current u, free ones where they belong then (collective)."""
        if self._touches is None and self._is_under_way():
            self.x = self.skin.places(self._at_end())
            if not self.comm.allreduce(_same(self.x, self._settled_at), op=MPI.LAND):
                self._settled_at = self.x
                if self._begins:
                    self._walk()
                elif not self._waits:
                    self._settle()
                self._place()
        return super().touching()

    def _set_off(self) -> None:
        """Newton's method begins, with poses that belong to no points yet."""
        self._settled_at, self._begins, self._waits, self._walks = None, True, 0.0, 0

    def _walk(self) -> None:
        """To where all belong, or as far as closes no gap by more than is safe: before a body that has not given way
        yet what is heavy would come to rest a hair's breadth away, with a force that tells nothing (collective)."""
        self._begins = False
        began = {number: each.z for number, each in self.free.items()}
        self._settle()
        ways = {number: each.z - began[number] for number, each in self.free.items()}
        arounds = self._arounds()
        if self._mutual is not None:
            share = self._mutual.free(arounds, began, ways)
        else:
            share = min(each.free(arounds[k], began[k], ways[k]) for k, each in self.free.items())
        self._walks += 1
        if self._walks == WALKS:
            share = 1.0
        self._waits = 1 - share
        for number, each in self.free.items():
            each.put(began[number] + share * ways[number])
            if share < 1:
                each.forget_push()

    def _settle(self) -> None:
        """All are where they belong with the points where they are now (collective)."""
        if self._mutual is not None:
            return self._mutual.settle(self._arounds())
        for number, each in self.free.items():
            each.settle(self._around(number))

    def _arounds(self) -> dict[int, Around]:
        return {number: self._around(number) for number in self.free}

    def _is_under_way(self) -> bool:
        """Whether this is no mere look, and the step that began is not over yet."""
        return bool(self._level.dt) and all(each.is_under_way for each in self.free.values())

    def _around(self, number: int) -> Around:
        return self._around_at(number, self.x)

    def _around_at(self, number: int, x: Values) -> Around:
        return Around(self.skin, x, partial(self._feel, number), self._facets(number), self._course.placed)

    def _place(self) -> None:
        """All see free obstacles where they are."""
        for number, each in self.free.items():
            self._course.placed[number] = each.placed

    def _under(self, number: int, placed: Placed) -> Values:
        held = self._grips[number]
        if number not in self.free or held is None:
            return super()._under(number, placed)
        return self.free[number].under(held, placed)

    # --- what they add to the balance ---

    def potential(self) -> float:
        """That of all obstacles, with the inertia and the weight of the free ones on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            for each in self.free.values():
                _, stopped = each.stops.energies(each.placed.pose, self._course.placed)
                energy += each.step.own(each.z) + level.contact_weight * level.fraction * stopped
            if self._mutual is not None:
                energy += level.contact_weight * level.fraction * self._mutual.energies()[1]
        return energy

    def stored_energy(self) -> float:
        """That of all obstacles, with the barriers between them on rank 0, J (collective)."""
        energy = super().stored_energy()
        if self.comm.rank == 0:
            placed = self._course.placed
            energy += sum(each.stops.energies(each.placed.pose, placed)[0] for each in self.free.values())
            energy += 0.0 if self._mutual is None else self._mutual.energies()[0]
        return energy

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """Phi_xz and Phi_zz^-1 of each obstacle that is touched and under way (collective)."""
        if not self._is_under_way() or not (touches := self.touching()) or self._waits:
            return []
        counts = sum_over_ranks(self.comm, np.array([len(touches[number].points) for number in self.free]))
        touched = [number for number, count in zip(self.free, counts, strict=True) if count]
        if self._mutual is not None and touched:
            U = np.concatenate([self._mixed(number, touches[number]) for number in self.free], axis=1)
            return [(U, self._mutual.compliance(self._arounds(), exact=self._exact))]
        return [(self._mixed(number, touches[number]), self._compliance(number)) for number in touched]

    def _mixed(self, number: int, found: Touch) -> Values:
        """(owned dofs, k) Phi_xz (collective)."""
        by_z = self.free[number].by_z(found, self.x, exact=self._exact)
        forces = np.zeros((len(self.x), *by_z.shape[1:]))
        forces[found.points] = by_z
        return np.stack([self.skin.follow.assemble_to_nodes(each) for each in np.moveaxis(forces, 2, 0)], axis=1)

    def _compliance(self, number: int) -> Values:
        """(k, k) Phi_zz^-1 (collective)."""
        resistance = self.free[number].resistance(self._around(number), exact=self._exact)
        return np.asarray(np.linalg.inv(resistance), np.float64)

    def _may_be_exact(self, moved: float) -> bool:
        """And all free obstacles stand where the potential is least (collective)."""
        if not super()._may_be_exact(moved):
            return False
        if self._mutual is not None:
            return is_positive(self._mutual.resistance(self._arounds(), exact=True))
        return all(is_positive(each.resistance(self._around(k), exact=True)) for k, each in self.free.items())

    def _pressed(self, number: int) -> float:
        if number not in self.free:
            return super()._pressed(number)
        return self.free[number].pressed(self.touching()[number], self.x)

    def step_work(self) -> tuple[float, float]:
        """With the work of gravity, and of other obstacles' motion, on free ones (collective)."""
        work, lost = super().step_work()
        if self.comm.rank == 0:
            for number, each in self.free.items():
                ends = self._course.at_start[number].pose, each.placed.pose
                work += each.body.weight(ends[0])[0] - each.body.weight(ends[1])[0]
                work += each.stops.work(ends[1], self._course.placed, self._course.ways)
        return work, lost

    # --- how far Newton's method may go ---

    def _taken_along(self, moved: Values) -> list[Values]:
        """As Newton's method moves them together with the points (collective)."""
        ways, found = super()._taken_along(moved), self.touching()
        if self._waits:
            return ways
        if self._mutual is not None:
            every = self._mutual.taken_along(dict(enumerate(found)), self._arounds(), moved, exact=self._exact)
            for number, q in every.items():
                ways[number] = q
            return ways
        for number, each in self.free.items():
            ways[number] = each.taken_along(found[number], self._around(number), moved, exact=self._exact)
        return ways

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess that has passed through nothing on its way from the start: free obstacles stop,
        or the body with them, before they meet (collective)."""
        u, level = super().feasible_guess(u), self._level
        self._set_off()
        for each in self.free.values():
            each.forget_way()
        if not level.dt:
            return u
        x = self.skin.places(level.u_n)
        moved = self.skin.places(level.displacement_at_end(u)) - x
        share, taken = 1.0, {}
        for number, each in self.free.items():
            taken[number], free = self._first_guess(each, self._around_at(number, x), moved)
            share = min(share, free)
        if self._mutual is not None:
            share = min(share, self._mutual.safe_guess(taken))
        for number, z in taken.items():
            self.free[number].put(share * z)
        self._place()
        return u if share == 1 else np.asarray(level.u_n + share * (u - level.u_n))

    def _first_guess(self, each: FreePose, around: Around, moved: Values) -> tuple[Values, float]:
        """Where one goes by itself, stays or is taken along by another one, whichever is free first, and the share of
        that way that closes no gap, with points that go by `moved` (n, d) (collective)."""
        others = self._course.whole()
        along = [each.led_by(way) for _, way in others.values() if way.any()]
        ways = [each.step.ahead, 0 * each.step.ahead, *along]
        first = 0.0
        for z in ways:
            share = each.safe_share(around, moved, z, others)
            if share == 1:
                return z, 1.0
            first = min(first, share) if first else share
        return ways[0], first

    def is_feasible(self, u: Values) -> bool:
        """Whether every gap is open with the body at u, those between obstacles as well (collective)."""
        placed = self._course.placed
        apart = all(each.stops.are_open(each.placed.pose, placed) for each in self.free.values())
        return super().is_feasible(u) and apart and (self._mutual is None or self._mutual.are_open())

    def remaining_motion(self) -> float:
        """And that of free ones which are held back (collective)."""
        if self._begins:
            self.touching()
        return max(super().remaining_motion(), self._waits)

    def continue_motion(self) -> None:
        """Free obstacles as well (collective)."""
        super().continue_motion()
        if self._waits:
            self.touching()
            self._walk()
            self._place()
            self._touches = None

    def _go_on(self, x: Values) -> None:
        """As far as free obstacles let others."""
        rest, still = self._course.rest(), np.zeros_like(self._course.ways[0])
        shares = [each.stops.safe_share(each.placed.pose, still, rest) for each in self.free.values()]
        self._course.go_on(x, self._course.known(self._facets), self.skin.safe, min(shares))
        self._touches = self._settled_at = None

    def restrict_motion(self) -> None:
        """All stay where the step began (collective)."""
        for each in self.free.values():
            each.stay()
        self._place()
        self._set_off()
        super().restrict_motion()


def _same(x: Values, before: Values | None) -> bool:
    return before is not None and np.array_equal(x, before)
