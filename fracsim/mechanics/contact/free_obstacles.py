"""Contact with obstacles of which some move freely: the same term, with their poses as further unknowns.

For a body that is at x the poses are the minimum of the incremental potential (rigid_step), found by a small Newton
method within the term. The body sees what is left, a function of x alone:

    E(x) = min over z of Phi(x, z),    dE/dx = dPhi/dx at that z,    d2E/dx2 = Phi_xx - Phi_xz Phi_zz^-1 Phi_zx

So the system of equations keeps its size, and its solution is the same as if poses were among its unknowns. The last
part couples all points in touch with one another; it is of rank k, the freedoms of an obstacle, and is applied, not
stored. (Without it a disk of a third of the body's mass takes 17,892 iterations in place of 127, or finds no solution.)
Every rank finds the same poses from sums over all ranks. Free obstacles meet the body alone, not one another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ...forms.schemes import Scheme
from ...mesh.domain import Domain
from ...mesh.ranks import total
from ...meshes.words import AXES
from .free_obstacle import Flight, FreeObstacle
from .obstacle import Obstacle
from .obstacles import Law, Obstacles
from .placed import Placed
from .push import Push, by_point_and_pose, on_obstacle, push, resultant
from .reach import safe_shares
from .rigid_step import RigidStep
from .touch import Touch

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Way:
    """A step of Newton's method that is under way: from points at x (n, d) by `moved`, from poses z by `dz`."""

    x: Values
    moved: Values
    z: dict[int, Values]
    dz: dict[int, Values]


class FreeObstacles(Obstacles):
    """Obstacles, at least one of them free.

    Attributes:
        free: the free ones by their number.    flights: how they move, at the start of a step until it is over.
    """

    condenses = True

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law, scheme: Scheme
    ) -> None:
        """InputError where the body at rest lies in an obstacle (collective)."""
        self.free = {number: each for number, each in enumerate(obstacles) if isinstance(each, FreeObstacle)}
        self.flights = {number: each.at_first() for number, each in self.free.items()}
        self._scheme = scheme
        self._steps: dict[int, RigidStep] = {}
        self._z: dict[int, Values] = {}
        self._found: dict[int, Values] = {}  # z of the last solution of this step
        self._pushes: dict[int, Push] = {}  # what contact does to obstacles at z
        self._way: _Way | None = None
        self._settled_at: Values | None = None  # places of the points that poses belong to
        super().__init__(domain, u, obstacles, law)

    def _known(self) -> list[int]:
        return [number for number in super()._known() if number not in self.free]

    # --- a step ---

    def _take_places(self, start: float, end: float) -> None:
        super()._take_places(start, end)
        for number, flight in self.flights.items():
            self._placed[number] = self._at_start[number] = Placed(self.obstacles[number].shape, flight.pose)

    def _start_of_step(self, late: float) -> None:
        super()._start_of_step(late)
        level, before = self._level, {number: step.start for number, step in self._steps.items()}
        self._way = self._settled_at = None
        for number, body in self.free.items():
            flight = self.flights[number]
            self._steps[number] = RigidStep(
                body, flight, self._scheme, level.dt, level.c_a, level.share, self._pushed_at_start(number)
            )
            self._z[number] = np.zeros(body.ways.shape[1])
            self._ways[number] = self._steps[number].increment(self._steps[number].ahead)
            if before.get(number) is not flight:
                self._found.pop(number, None)

    def _pushed_at_start(self, number: int) -> Values:
        """(p,) force and moment of the body on an obstacle at the start of the step, N and N m (collective)."""
        held = self._starts[number]
        return total(
            self.comm, resultant(-held.force[:, None] * held.normal, held.start - self._at_start[number].pose.centre)
        )

    def memory(self) -> object:
        """That of the points, and how obstacles move."""
        return super().memory(), dict(self.flights)

    def recall(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        points, flights = cast("tuple[object, dict[int, Flight]]", memory)
        super().recall(points)
        self.flights = dict(flights)

    def saved(self) -> dict[str, Values]:
        """With rows of how obstacles move (collective)."""
        return super().saved() | {"flights": np.array([flight.flat() for flight in self.flights.values()])}

    def restore(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().restore(saved)
        rows = saved["flights"]
        self.flights = {number: self.flights[number].like(rows[k]) for k, number in enumerate(self.free)}

    def arrive(self) -> None:
        """The step is over: obstacles have the momentum that it gave them (collective)."""
        found = self._touching()
        for number, step in self._steps.items():
            pushed = total(self.comm, on_obstacle(found[number], self.x, self._placed[number].pose))
            self.flights[number] = step.arrived(self._z[number], pushed)
        self._found = dict(self._z)

    # --- where free obstacles are ---

    def _touching(self) -> list[Touch]:
        if self._touches is None and self._level.dt and self._is_under_way():
            self.x = self.places(self._level.at_end(self._u.x.array[: self._owned]))
            if not self.comm.allreduce(_same(self.x, self._settled_at), op=MPI.LAND):
                self._settled_at = self.x
                for number in self.free:
                    self._settle(number)
        return super()._touching()

    def _is_under_way(self) -> bool:
        """Whether the step that began is not over yet."""
        return all(self._steps[number].start is flight for number, flight in self.flights.items())

    def _settle(self, number: int) -> None:
        """The pose that belongs to the points where they are now (collective)."""
        self._pushes.pop(number, None)
        for z in self._candidates(number):
            self._put(number, z)
            if self._is_open(number):
                break
        else:
            return  # the body is in the obstacle: Newton's method finds no finite force, and fails
        step = self._steps[number]
        z, self._pushes[number] = step.settle(z, partial(self._push, number), partial(self._free, number))
        self._put(number, z)

    def _candidates(self, number: int) -> Iterator[Values]:
        """Ways z to start from: where a step of Newton's method takes the obstacle along, where it is, where it was
        once this step was solved, and where the step began."""
        if (way := self._way) is not None:
            gone = total(self.comm, [float(np.vdot(self.x - way.x, way.moved)), float(np.vdot(way.moved, way.moved))])
            share = float(np.clip(gone[0] / gone[1], 0.0, 1.0)) if gone[1] > 0 else 0.0
            yield way.z[number] + share * way.dz[number]
        yield self._z[number]
        if number in self._found:
            yield self._found[number]
        yield np.zeros_like(self._z[number])

    def _put(self, number: int, z: Values) -> None:
        self._z[number] = z
        self._placed[number] = Placed(self.obstacles[number].shape, self._steps[number].pose(z))

    def _is_open(self, number: int) -> bool:
        least = self._placed[number].distance(self.x)[self.area > 0].min(initial=np.inf)
        return bool(self.comm.allreduce(bool(least > 0), op=MPI.LAND))

    def _push(self, number: int, z: Values) -> Push:
        """What contact does to the obstacle at z, of all ranks (collective)."""
        self._put(number, z)
        found, pose = self._touch(number), self._placed[number].pose
        mine = push(found, self.x, pose, self._grips[number], self._at_start[number].pose)
        parts = [np.atleast_1d(mine.energy), mine.gradient, mine.hessian.reshape(-1), mine.stiffness.reshape(-1)]
        p = len(mine.gradient)
        energy, gradient, *both = np.split(total(self.comm, np.concatenate(parts)), [1, 1 + p, 1 + p + p * p])
        return Push(float(energy[0]), gradient, *(each.reshape(p, p) for each in both))

    def _free(self, number: int, z: Values, dz: Values) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is (collective)."""
        self._put(number, z)
        q = self._steps[number].onward(z, dz)
        share = safe_shares(self._placed[number], self.x, np.zeros_like(self.x), q)[self.area > 0].min(initial=1.0)
        return float(self.comm.allreduce(float(share), op=MPI.MIN))

    def _under(self, number: int) -> Values:
        held = self._grips[number]
        if number not in self.free or held is None:
            return super()._under(number)
        then, now = self._at_start[number].pose, self._placed[number].pose
        return now.points_to_space(then.to_body(held.start)) - held.start

    # --- what they add to the balance ---

    def potential(self) -> float:
        """That of all obstacles, with the inertia and the weight of the free ones on rank 0, J (collective)."""
        energy = super().potential()
        if self.comm.rank == 0 and self._level.dt:
            energy += sum(self._steps[number].own(z) for number, z in self._z.items())
        return energy

    def low_rank(self) -> list[tuple[Values, Values]]:
        """Phi_xz and Phi_zz^-1 of each obstacle that is touched and under way (collective)."""
        if not (self._level.dt and self._is_under_way()):
            return []
        touches = self._touching()
        counts = total(self.comm, np.array([len(touches[number].points) for number in self.free]))
        touched = [number for number, count in zip(self.free, counts, strict=True) if count]
        return [(self._mixed(number, touches[number]), _inverse(self._resistance(number))) for number in touched]

    def _mixed(self, number: int, found: Touch) -> Values:
        """(owned dofs, k) Phi_xz (collective)."""
        by_z = self._by_z(number, found)
        forces = np.zeros((len(self.x), *by_z.shape[1:]))
        forces[found.points] = by_z
        return np.stack([self.follow.handed_down(each) for each in np.moveaxis(forces, 2, 0)], axis=1)

    def _by_z(self, number: int, found: Touch) -> Values:
        """(k, d, ways) derivative of minus the forces on points by z."""
        by_way = self._steps[number].by_way(self._z[number])
        return by_point_and_pose(found, self.x, self._placed[number].pose) @ by_way

    def _resistance(self, number: int) -> Values:
        """(k, k) Phi_zz, its positive definite part (collective)."""
        z = self._z[number]
        return self._steps[number].system(z, self._pushes.get(number) or self._push(number, z))[2]

    def driven(self) -> tuple[float, float]:
        """With the work of gravity on free obstacles, and what friction takes of their way (collective)."""
        work, lost = super().driven()
        for number, body in self.free.items():
            rubbed = self._rubbed(number)
            self._worked[number] = self._pressed(number) + rubbed
            lost += rubbed
            if self.comm.rank == 0:
                ends = self._at_start[number].pose, self._placed[number].pose
                work += body.weight(ends[0])[0] - body.weight(ends[1])[0]
        return work, lost

    def _rubbed(self, number: int) -> float:
        """Work of friction on the body in the step, by the way of what is under it on this rank, J."""
        found, held = self._touching()[number], self._grips[number]
        if held is None:
            return 0.0
        return float(np.vdot(found.friction[np.searchsorted(found.points, held.points)], self._under(number)))

    def _pressed(self, number: int) -> float:
        """Work of normal forces on the body in the step, by the way of the obstacle, this rank's share, J."""
        step, found = self._steps[number], self._touching()[number]
        force = resultant(found.normal, self.x[found.points] - self._placed[number].pose.centre)
        if self.comm.rank == 0:
            force = force - step.pushed
        return float(force @ step.increment(self._z[number])) / 2

    def kinetic(self) -> float:
        """Energy of motion of the free obstacles, on rank 0, J."""
        if self.comm.rank:
            return 0.0
        return float(sum(body.told(self.flights[number])[-1] for number, body in self.free.items()))

    # --- how far Newton's method may go ---

    def _taken_along(self, moved: Values) -> list[Values]:
        """As Newton's method moves them together with the points (collective)."""
        ways, found, dz = super()._taken_along(moved), self._touching(), {}
        for number in self.free:
            mixed = self._by_z(number, found[number])
            pushed = total(self.comm, np.einsum("kdz,kd->z", mixed, moved[found[number].points]))
            dz[number] = -np.linalg.solve(self._resistance(number), pushed)
            ways[number] = self._steps[number].onward(self._z[number], dz[number])
        self._way = _Way(self.x, moved, dict(self._z), dz)
        return ways

    def reachable(self, u: Values) -> Values:
        """(owned dofs,) a first guess that has passed through nothing on its way from the start: free obstacles stop,
        or the body with them, before they meet (collective)."""
        u, level = super().reachable(u), self._level
        self._way = self._settled_at = None
        if not level.dt:
            return u
        x = self.places(level.u)
        moved = self.places(level.at_end(u)) - x
        share, taken = 1.0, {}
        for number, step in self._steps.items():
            ahead, stays = (self._together(number, x, moved, z) for z in (step.ahead, 0 * step.ahead))
            taken[number] = step.ahead if ahead == 1 or stays < 1 else 0 * step.ahead
            share = min(share, ahead if stays < 1 else 1.0)
        for number, z in taken.items():
            self._put(number, share * z)
        return u if share == 1 else np.asarray(level.u + share * (u - level.u))

    def _together(self, number: int, x: Values, moved: Values, z: Values) -> float:
        """Share of the ways of points and obstacle, from the start of the step, that closes no gap (collective)."""
        shares = safe_shares(self._at_start[number], x, moved, self._steps[number].increment(z))[self.area > 0]
        return float(self.comm.allreduce(float(shares.min(initial=1.0)), op=MPI.MIN))

    def hold_back(self) -> None:
        """All stay where the step began (collective)."""
        for number, z in self._z.items():
            self._put(number, 0 * z)
        self._settled_at = None
        super().hold_back()

    # --- what is told ---

    def where(self, t: float) -> list[Placed]:
        """Each obstacle at the time t of the state, s (not collective)."""
        here = super().where(t)
        for number, flight in self.flights.items():
            here[number] = Placed(here[number].shape, flight.pose)
        return here

    def readings(self) -> dict[str, Callable[[], Values]]:
        """With position_NAME_x, velocity_NAME_x of the centre of mass, m and m/s, turn_NAME_z, spin_NAME_z in rad and
        rad/s, and kinetic_NAME in J of each that is free."""
        columns = super().readings()
        for number, body in self.free.items():
            columns |= {name: partial(self._reading, number, place) for place, name in enumerate(_columns(body))}
        return columns

    def _reading(self, number: int, place: int) -> Values:
        if self.comm.rank:
            return np.zeros(1)
        body, flight = self.free[number], self.flights[number]
        return body.told(flight)[place : place + 1]


def _same(x: Values, before: Values | None) -> bool:
    return before is not None and np.array_equal(x, before)


def _inverse(matrix: Values) -> Values:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _columns(body: FreeObstacle) -> list[str]:
    """Names of what `told` gives."""
    d = len(body.at)
    axes, turns = AXES[:d], AXES[2:] if d == 2 else AXES
    kinds = [("position", axes), ("velocity", axes), ("turn", turns), ("spin", turns)]
    return [*[f"{kind}_{body.name}_{axis}" for kind, over in kinds for axis in over], f"kinetic_{body.name}"]
