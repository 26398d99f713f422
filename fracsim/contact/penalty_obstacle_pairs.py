"""Free obstacles in explicit steps: penalty and Coulomb friction before other obstacles, and velocity Verlet.

    analytic obstacles        at inset points of each before the other (inset_points)
    two triangle meshes       points before facets, and sharp edges, of both (penalty_pairs)

Both obstacles have equal and opposite forces at the same points, so that momenta are constant to round-off. Friction
has a spring in each contact that slips at mu N (Cundall and Strack 1979).

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ..array_types import Flags, Ints, Values
from ..mesh.domain import Domain
from .inset_points import SAMPLES
from .laws import Penalty
from .obstacle import FreeObstacle, RigidObstacle, VerletObstacle, free_pairs
from .obstacle_pairs import Numbers, ObstaclePair
from .penalty_law import PENALTY, ContactStiffness, PenaltyContacts, PenaltyForces, Slips
from .pose import Pose, PosedShape, resultant
from .rigid_obstacles import RigidObstacles
from .triangle_mesh_shape import TriangleMeshShape

if TYPE_CHECKING:
    from .mesh_obstacles import SurfacePart  # with ipctk
    from .penalty_pairs import PenaltyPairs


type Poses = tuple[Pose, Pose]


@dataclass(frozen=True)
class PairForces:
    """Forces of a pair at the end of a step.

    Attributes:
        wrenches: (2, p) forces and moments on both, N and N m.
        friction: (2, p) those of friction alone.
        energies: (2,) of the penalty, and of the springs of friction, J.
    """

    wrenches: Values
    friction: Values
    energies: Values


@dataclass(frozen=True)
class NearContacts:
    """Contacts of two obstacles that may act a step later.

    Attributes:
        contacts: contacts, whose weights are positive or negative on all points of the first.
        x: (n, d) points that they refer to, m: those of the first, then those of the second.
        first_count: number of points of the first.
        keys: (k,) names of the contacts.
    """

    contacts: PenaltyContacts
    x: Values
    first_count: int
    keys: Ints

    @property
    def is_first(self) -> Flags:
        """(n,) flags of the points of the first."""
        return np.arange(len(self.x)) < self.first_count

    def positions(self) -> Values:
        """(k, d) positions of the contacts on the first, m."""
        return self.contacts.positions(self.x, self.is_first)

    def forces(self, starts: Poses, ends: Poses, friction: float, width: float) -> PenaltyForces:
        """Forces below the gap `width`, m, after a step with poses at its start and end."""
        contacts = self.contacts.select(self.contacts.gap < width)
        sides = zip(starts, ends, (self.x[: self.first_count], self.x[self.first_count :]), strict=True)
        start_x = np.concatenate([start.points_to_space(end.to_body(x)) for start, end, x in sides])
        return PenaltyForces(contacts, contacts.relative(self.x - start_x), friction, width, len(self.x))

    def wrenches(self, forces: PenaltyForces, poses: Poses) -> PairForces:
        """Forces and moments of contacts on both.

        Friction acts on both at one point, in the middle of the gap, so that it has no moment.
        """
        press, is_first, contacts = forces.normal_force, self.is_first, forces.contacts
        pressed = press.any(axis=1)
        normal = [
            resultant(press[side], self.x[side] - pose.centre)
            for side, pose in zip((pressed & is_first, pressed & ~is_first), poses, strict=True)
        ]
        middle = 0.5 * (contacts.positions(self.x, is_first) + contacts.positions(self.x, ~is_first))
        on_first = np.sum(contacts.weights * is_first[contacts.points], axis=1)[:, None] * forces.spring_force
        friction = [
            resultant(sign * on_first, middle - pose.centre) for sign, pose in zip((1.0, -1.0), poses, strict=True)
        ]
        energies = np.array([contacts.energy(forces.width), forces.spring_energy])
        return PairForces(np.add(normal, friction), np.array(friction), energies)


class InsetPointContacts:
    """Contacts at the inset points of two obstacles of which one at least is analytic.

    Both have the contact at the same place: on the surface of the point's obstacle, where it is nearest to the other.

    Attributes:
        width: gap below which the penalty acts, m.
        history: springs at the end of the last step.
    """

    def __init__(self, pair: ObstaclePair, penalty: Penalty) -> None:
        self._pair, self._rate, self.width = pair, penalty.rate, penalty.width
        self.history = Slips.none(pair.points[0].points.shape[1])

    def near_contacts(self, poses: Poses) -> NearContacts | None:
        """Contacts that may act a step later; None: they are too far apart."""
        reach = PENALTY.near_gap * self.width
        if self._pair.gap_bound(*poses) >= reach:
            return None
        parts, count = [], 0
        for sign, inset, (x, target) in zip((1.0, -1.0), self._pair.points, self._pair.sides(*poses), strict=True):
            gap = target.distance(x)
            near = np.flatnonzero(gap < reach)
            normal, k = target.normal(x[near]), self._rate * inset.areas[near]
            parts.append((count + near, gap[near], sign * normal, x[near] - inset.radius * normal, k))
            count += len(x)
        numbers, gap, normal, position, stiffness = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        slip, touched = self.history.at(numbers)
        rows = np.arange(2 * len(numbers)).reshape(2, -1).T
        weights = np.tile([1.0, -1.0], (len(numbers), 1))
        contacts = PenaltyContacts.of_points(rows, weights, gap, normal, stiffness, slip, stiffness * touched)
        return NearContacts(contacts, np.tile(position, (2, 1)), len(position), numbers)

    def end_step(self, near: NearContacts | None, slips: Values) -> None:
        """Store the springs of a step: stretch (k, d) of those of contacts below the width, m."""
        if near is None:
            self.history = Slips.none(self.history.slip.shape[1])
        else:
            self.history = Slips(near.keys[near.contacts.gap < self.width], slips)

    def set_history(self, history: Slips) -> None:
        """Set the springs at the end of the last step."""
        self.history = history


class MeshContacts:
    """Contacts between two triangle meshes, as InsetPointContacts.

    The width of the penalty is smaller for obstacles that start nearer.
    """

    def __init__(self, first: RigidObstacle, second: RigidObstacle, penalty: Penalty) -> None:
        from .mesh_obstacles import MeshObstacle

        friction = max(first.friction, second.friction)
        self._first, self._second = (MeshObstacle.of(obstacle, friction) for obstacle in (first, second))
        self._part = self._build_part(penalty.rate, penalty.width)
        start = self._part.points(self._first.positions_at(first.posed_at(0.0).pose), second.posed_at(0.0).pose)
        if (gap := self._part.pairs.min_gap(start)) < penalty.width:
            self._part = self._build_part(penalty.rate, PENALTY.pair_width * gap)
        self.width, self.set_history = self._part.pairs.width, self._part.pairs.set_history

    def _build_part(self, rate: float, width: float) -> SurfacePart[PenaltyPairs]:
        """Contact of the meshes; each side has one half of the penalty's `rate`, Pa/m."""
        from .mesh_obstacles import SurfacePart
        from .penalty_pairs import PenaltyPairs
        from .sample_points import vertex_areas

        first, second, n = self._first, self._second, len(self._first.points)
        points = np.concatenate([first.points, second.points])
        triangles = np.concatenate([first.triangles, second.triangles + n])
        stiffness = ContactStiffness.of_one_body(0.5 * rate * vertex_areas(points, triangles))
        patch = (np.arange(len(points)) >= n).astype(np.int32)
        pairs = PenaltyPairs(points, triangles, stiffness, distance=width, patch=patch)
        return SurfacePart(pairs, first.triangles, PENALTY.near_gap * width, second.friction, second)

    def near_contacts(self, poses: Poses) -> NearContacts | None:
        """Contacts that may act a step later; None: they are too far apart."""
        first, second = poses
        if self._first.spheres_are_far(first, self._second, second, self._part.reach):
            return None
        self._second.move_to(second)
        positions = self._first.positions_at(first)
        if self._part.is_far(positions):
            return None
        x = self._part.points(positions)
        contacts = self._part.pairs.near_contacts(x)
        return NearContacts(contacts, x, len(positions), contacts.points[:, 0])

    def end_step(self, near: NearContacts | None, slips: Values) -> None:
        """Store the contacts of a step, and stretch (k, d) of the springs of those below the width, m."""
        if near is not None:
            self._part.pairs.end_step(near.x, slips)

    @property
    def history(self) -> PenaltyContacts:
        """Contacts at the end of the last step."""
        return self._part.pairs.history


class PenaltyPair:
    """A free obstacle and another one, their contacts and forces at the end of the last step.

    Attributes:
        numbers: of both.
        forces: at the end of the last step.
        dissipated: by friction in that step, J.
        work: (2,) of the forces on each obstacle in that step, J.
    """

    def __init__(
        self, numbers: Numbers, obstacles: Mapping[int, RigidObstacle], penalty: Penalty, max_added: float, suffix: str
    ) -> None:
        """Build the contacts of a pair.

        Args:
            numbers: of both.
            obstacles: all by their numbers, apart at the start.
            penalty: of points in contact; less stiff where it would add more than a share of `max_added`.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.
            suffix: of the names of its arrays in checkpoints.
        """
        first, second = (obstacles[number] for number in numbers)
        are_meshes = [isinstance(obstacle.shape, TriangleMeshShape) for obstacle in (first, second)]
        if are_meshes[1] and not are_meshes[0]:  # a triangle mesh comes first: it is in contact at its own points
            numbers, first, second = (numbers[1], numbers[0]), second, first
        self.numbers, self._suffix = numbers, suffix
        pair = ObstaclePair.between(first, second)
        areas = [inset.areas for inset in pair.points if len(inset.points)]
        touching = min((max(SAMPLES.touching_share * area.sum(), area.max()) for area in areas), default=0.0)
        mass = min(obstacle.mass for obstacle in (first, second) if isinstance(obstacle, FreeObstacle))
        limit = PENALTY.pair_share * max_added * mass * penalty.width / max(touching, np.finfo(float).tiny)
        penalty = replace(penalty, stiffness=min(penalty.stiffness, limit))
        self.contacts: Any = (
            MeshContacts(first, second, penalty) if all(are_meshes) else InsetPointContacts(pair, penalty)
        )
        self._friction, none = pair.friction, np.zeros((2, 3 if len(first.start_point) == 2 else 6))
        self.forces = self._none = PairForces(none, none, np.zeros(2))
        self.dissipated, self.work = 0.0, (0.0, 0.0)

    def poses(self, posed: Sequence[PosedShape]) -> Poses:
        """Poses of both."""
        return posed[self.numbers[0]].pose, posed[self.numbers[1]].pose

    def end_step(self, starts: Sequence[PosedShape], ends: Sequence[PosedShape], increments: Sequence[Values]) -> None:
        """Take over the forces of the end of a step, with poses at its start and end, and increments (p,) between."""
        start, end_poses, slips = self.forces, self.poses(ends), np.empty(0)
        self.forces, self.dissipated = self._none, float(start.energies[1])
        if (near := self.contacts.near_contacts(end_poses)) is not None:
            forces = near.forces(self.poses(starts), end_poses, self._friction, self.contacts.width)
            self.forces, slips = near.wrenches(forces, end_poses), forces.slips
            self.dissipated = forces.dissipated(self.dissipated)
        self.contacts.end_step(near, slips)
        q = np.array([increments[number] for number in self.numbers])
        first, second = np.einsum("bp,bp->b", start.wrenches + self.forces.wrenches, q) / 2
        self.work = float(first), float(second)

    def snapshot(self) -> object:
        """Contacts and forces."""
        return self.contacts.history, self.forces

    def restore(self, memory: object) -> None:
        """Restore a snapshot."""
        history, self.forces = cast("tuple[object, PairForces]", memory)
        self.contacts.set_history(history)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint."""
        arrays = vars(self.forces) | {f"contact_{name}": values for name, values in vars(self.contacts.history).items()}
        return {f"{name}{self._suffix}": values for name, values in arrays.items()}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set contacts and forces from the arrays of a checkpoint."""
        arrays = {name: saved[f"{name}{self._suffix}"] for name in vars(self.forces)}
        self.forces, history = PairForces(**arrays), self.contacts.history
        names = {name: saved[f"contact_{name}{self._suffix}"] for name in vars(history)}
        self.contacts.set_history(type(history)(**names))


def penalty_pairs_of(obstacles: Mapping[int, RigidObstacle], penalty: Penalty, max_added: float) -> list[PenaltyPair]:
    """Pairs of free obstacles and others; as of PenaltyPair."""
    all_numbers = enumerate(free_pairs([obstacles[n].free for n in range(len(obstacles))]))
    return [PenaltyPair(numbers, obstacles, penalty, max_added, f"_{index}") for index, numbers in all_numbers]


class VerletRigidObstacles(RigidObstacles):
    """Obstacles of which some are free, in explicit steps; between these and others a penalty acts, with friction.

    Attributes:
        free: free obstacles by their numbers.
    """

    free: dict[int, VerletObstacle]

    def __init__(self, domain: Domain, obstacles: Sequence[RigidObstacle], pairs: Sequence[PenaltyPair]) -> None:
        """`obstacles`: by their numbers in the study; `pairs`: of free ones and others."""
        numbered = enumerate(obstacles)
        free = {n: VerletObstacle(obstacle) for n, obstacle in numbered if isinstance(obstacle, FreeObstacle)}
        self._contact_work = dict.fromkeys(free, 0.0)  # of the body on each in the last step, J
        self._pairs = pairs
        super().__init__(domain, obstacles, free)
        self.parts = (*self.parts, *pairs)

    def _place(self, start: float, end: float) -> None:
        super()._place(start, end)
        if end > start:
            for number, obstacle in self.free.items():
                self.posed[number] = obstacle.begin_step(end - start)
                self.increments[number] = obstacle.increment

    def accept_step(self) -> None:
        """Give free obstacles their momentum (collective)."""
        work_of_pairs = dict.fromkeys(range(len(self.obstacles)), 0.0)
        of_pairs = [np.zeros_like(q) for q in self.increments]
        for pair in self._pairs:
            pair.end_step(self.start_posed, self.posed, self.increments)
            for number, wrench, work in zip(pair.numbers, pair.forces.wrenches, pair.work, strict=True):
                of_pairs[number] += wrench
                work_of_pairs[number] += work
        of_body = {number: wrench for contact in self.contacts for number, wrench in contact.wrenches().items()}
        # each obstacle ends its step once, with all that acts on it
        for number, wrench_of_body in of_body.items():
            work = self.free[number].end_step(self.posed[number], wrench_of_body + of_pairs[number])
            self._contact_work[number] = work - work_of_pairs[number]

    def stored_energy(self) -> float:
        """Energy of penalty and springs between obstacles at the end of the last step, on rank 0, J."""
        return 0.0 if self.comm.rank else sum(float(pair.forces.energies.sum()) for pair in self._pairs)

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all near points were in contact, 1/s^2.

        With the largest eigenvalues l_i, l_j of M^-1 K of both obstacles of a pair it is at most the largest sum of
        l_i + sqrt(l_i l_j) over the pairs of an obstacle (Gershgorin's bound for blocks).
        """
        sums = dict.fromkeys(self.free, 0.0)
        for pair in self._pairs:
            if (near := pair.contacts.near_contacts(pair.poses(self.posed))) is None:
                continue
            springs = near.positions(), near.contacts.stiffness
            squares = {
                number: obstacle.max_frequency(obstacle.spring_stiffness(*springs, posed), posed)
                for number in pair.numbers
                if number in self.free
                for obstacle, posed in [(self.free[number], self.posed[number])]
            }
            coupling = float(np.sqrt(np.prod(list(squares.values())))) if len(squares) == 2 else 0.0
            for number, square in squares.items():
                sums[number] += square + coupling
        return max(sums.values())

    def work_on_body(self, number: int, by_forces: float) -> float:
        """Work of an obstacle on the body in the last step, J; of a free one that of its momentum, on rank 0."""
        if number not in self.free:
            return by_forces
        return 0.0 if self.comm.rank else -self._contact_work[number]

    def step_work(self) -> tuple[float, float]:
        """Work of gravity and prescribed obstacles on free ones, and dissipation between obstacles, on rank 0, J."""
        if self.comm.rank:
            return 0.0, 0.0
        items = [(number, work) for pair in self._pairs for number, work in zip(pair.numbers, pair.work, strict=True)]
        by_prescribed = -sum(work for number, work in items if number not in self.free)
        by_gravity = sum(obstacle.gravity_work for obstacle in self.free.values())
        return by_gravity + by_prescribed, sum(pair.dissipated for pair in self._pairs)
