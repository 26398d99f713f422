"""Free obstacles in explicit steps: penalty and Coulomb friction before other obstacles, and velocity Verlet.

    analytic obstacles        at inset points of each before the other (obstacle_pairs)
    two triangle meshes       points before facets, and sharp edges, of both (penalty_pairs)

Both obstacles have equal and opposite forces at the same points, so that momenta are constant to round-off. Friction
has a spring in each contact that slips at mu N (Cundall and Strack 1979).

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from ..mesh.domain import Domain
from .laws import Penalty, slipped, tangential
from .obstacle import FreeObstacle, RigidObstacle, VerletObstacle, free_pairs
from .obstacle_pairs import SAMPLES, Numbers, ObstaclePair
from .pose import Pose, PosedShape, resultant
from .rigid_obstacles import RigidObstacles
from .triangle_mesh_shape import StackedMeshes, TriangleMeshShape

if TYPE_CHECKING:
    from .penalty_law import ContactHistory
    from .penalty_pairs import PenaltyPairs  # with ipctk

Values = npt.NDArray[np.float64]

type Poses = tuple[Pose, Pose]


@dataclass(frozen=True)
class PairPenaltyPolicy:
    """Tuned numbers of the penalty between two obstacles.

    Attributes:
        share: of what contact may add to the square of a frequency.
        near_gap: gap, in widths of the penalty, up to which contacts are followed, since they may act a step later.
        gap_share: width of the penalty in the gap at the start, where that is smaller than the width.
    """

    share: float = 0.2
    near_gap: float = 3.0
    gap_share: float = 0.5


PAIR_PENALTY = PairPenaltyPolicy()


@dataclass(frozen=True)
class PairForces:
    """Forces of a pair at the end of a step.

    Attributes:
        wrenches: (2, p) forces and moments on both, N and N m.
        friction: (2, p) those of friction alone.
        penalty_energy: J.
        spring_energy: of the springs of friction, J.
    """

    wrenches: Values
    friction: Values
    penalty_energy: float = 0.0
    spring_energy: float = 0.0

    def __add__(self, other: PairForces) -> PairForces:
        """Sum of forces at other points of the same pair."""
        return PairForces(
            self.wrenches + other.wrenches,
            self.friction + other.friction,
            self.penalty_energy + other.penalty_energy,
            self.spring_energy + other.spring_energy,
        )

    @classmethod
    def none(cls, dim: int) -> PairForces:
        """No forces."""
        p = 3 if dim == 2 else 6
        return cls(np.zeros((2, p)), np.zeros((2, p)))

    def to_array(self) -> Values:
        """(4 p + 2,) numbers for a checkpoint."""
        return np.concatenate([self.wrenches.ravel(), self.friction.ravel(), [self.penalty_energy, self.spring_energy]])

    @classmethod
    def from_array(cls, numbers: Values) -> PairForces:
        """Forces from the numbers of `to_array`."""
        wrenches, friction = numbers[:-2].reshape(2, 2, -1)
        return cls(wrenches, friction, float(numbers[-2]), float(numbers[-1]))


class InsetPointContacts:
    """Contacts at the inset points of two obstacles of which one at least is analytic.

    Friction acts on the surface of the point's obstacle, where this is nearest to the other one.

    Attributes:
        touching_area: area that may touch at once, m^2.
    """

    def __init__(self, first: RigidObstacle, second: RigidObstacle) -> None:
        self._pair = ObstaclePair.between(first, second)
        areas = [inset.areas for inset in self._pair.points if len(inset.points)]
        touching = [max(SAMPLES.touching_share * area.sum(), area.max()) for area in areas]
        self.touching_area = float(min(touching, default=0.0))
        # (n, d) stretch of the springs at the points of both, m; 0 without contact
        self._slips = [np.zeros_like(inset.points) for inset in self._pair.points]

    def set_penalty(self, penalty: Penalty) -> None:
        """Set the penalty."""
        self._penalty = penalty

    def end_step(self, starts: Poses, ends: Poses) -> PairForces | None:
        """Forces at the end of a step, of which the springs are stored; None: out of contact."""
        old, self._slips = self._slips, [np.zeros_like(slip) for slip in self._slips]
        total: PairForces | None = None
        for contacts in self._near_contacts(ends, self._penalty.width):
            side, points, normal = contacts.side, contacts.points, contacts.normal
            closure = self._penalty.width - contacts.gap
            motions = [_motions(contacts.surface, *poses) for poses in zip(starts, ends, strict=True)]
            stretch = tangential(normal, old[side][points] + motions[side] - motions[1 - side])
            self._slips[side][points] = stretch = slipped(stretch, self._pair.friction * closure)
            sign = 1.0 - 2.0 * side  # forces are those on the first
            press, rub = (
                sign * (contacts.stiffness * closure)[:, None] * normal,
                -sign * contacts.stiffness[:, None] * stretch,
            )
            friction = _wrenches(rub, contacts.surface, ends)
            forces = PairForces(
                _wrenches(press, contacts.surface, ends) + friction,
                friction,
                0.5 * float(contacts.stiffness @ closure**2),
                0.5 * float(contacts.stiffness @ np.sum(stretch**2, axis=1)),
            )
            total = forces if total is None else total + forces
        return total

    def _near_contacts(self, poses: Poses, max_gap: float) -> Iterator[_InsetContacts]:
        """Contacts at gaps below `max_gap`, m, of the points of each obstacle."""
        if self._pair.gap_bound(*poses) >= max_gap:
            return
        for side, (x, target) in enumerate(self._pair.sides(*poses)):
            gap = target.distance(x)
            points = np.flatnonzero(gap < max_gap)
            if len(points):
                normal = target.normal(x[points])
                surface = x[points] - self._pair.points[side].radius * normal
                stiffness = self._penalty.rate * self._pair.points[side].areas[points]
                yield _InsetContacts(side, points, gap[points], normal, surface, stiffness)

    def near_springs(self, poses: Poses) -> tuple[Values, Values] | None:
        """Positions (k, d), m, and stiffness (k,), N/m, of contacts that may act a step later; None: none."""
        near = list(self._near_contacts(poses, PAIR_PENALTY.near_gap * self._penalty.width))
        if not near:
            return None
        return np.concatenate([part.surface for part in near]), np.concatenate([part.stiffness for part in near])

    def snapshot(self) -> list[Values]:
        """Stretch of springs."""
        return self._slips

    def restore(self, memory: list[Values]) -> None:
        """Restore a snapshot."""
        self._slips = memory

    def to_checkpoint(self) -> dict[str, Values]:
        """Stretch of springs."""
        return {"slips": np.concatenate(self._slips)}

    def from_checkpoint(self, saved: dict[str, Values], suffix: str) -> None:
        """Set the stretch of springs from the arrays of a checkpoint."""
        self._slips = np.split(saved[f"slips{suffix}"], [len(self._slips[0])])


@dataclass(frozen=True)
class _InsetContacts:
    """Inset points of one obstacle near the other.

    Attributes:
        side: number of the points' obstacle, 0 or 1.
        points: (k,).
        gap: (k,) m.
        normal: (k, d) of the other obstacle.
        surface: (k, d) points of the surface of the points' obstacle, m.
        stiffness: (k,) N/m.
    """

    side: int
    points: npt.NDArray[np.int64]
    gap: Values
    normal: Values
    surface: Values
    stiffness: Values


class MeshContacts:
    """Contacts between two triangle meshes, as InsetPointContacts."""

    def __init__(self, first: RigidObstacle, second: RigidObstacle) -> None:
        from .sample_points import vertex_areas

        meshes = self._meshes = StackedMeshes(first.shape, second.shape)
        self._area, self._friction = vertex_areas(meshes.points, meshes.triangles), max(first.friction, second.friction)
        areas = [self._area[rows].sum() for rows in meshes.rows]
        self.touching_area = SAMPLES.touching_share * float(min(areas))
        self._start = meshes.positions((first.posed_at(0.0).pose, second.posed_at(0.0).pose))

    def set_penalty(self, penalty: Penalty) -> None:
        """Set the penalty, of which each side has one half; its width is smaller for obstacles that start nearer."""
        self._pairs = self._build_pairs(penalty)
        if (gap := self._pairs.min_gap(self._start)) < penalty.width:
            width = PAIR_PENALTY.gap_share * gap
            self._pairs = self._build_pairs(Penalty(penalty.rate * width, width))

    def _build_pairs(self, penalty: Penalty) -> PenaltyPairs:
        from .penalty_law import ContactStiffness
        from .penalty_pairs import PenaltyPairs

        meshes, stiffness = self._meshes, ContactStiffness.of_one_body(0.5 * penalty.rate * self._area)
        return PenaltyPairs(meshes.points, meshes.triangles, stiffness, distance=penalty.width, patch=meshes.patches)

    def _near_positions(self, poses: Poses) -> Values | None:
        """(n, 3) points of both obstacles, m; None: they are too far apart."""
        return self._meshes.near_positions(poses, PAIR_PENALTY.near_gap * self._pairs.width)

    def end_step(self, starts: Poses, ends: Poses) -> PairForces | None:
        """Forces at the end of a step, of which the contacts are stored; None: out of contact."""
        if (x := self._near_positions(ends)) is None:
            return None
        forces, is_first = (
            self._pairs.forces(x, self._meshes.positions(starts), self._friction),
            self._meshes.patches == 0,
        )
        contacts, press = forces.contacts, -self._pairs.gradient(x)
        parts = zip(self._meshes.rows, ends, strict=True)
        of_press = [resultant(press[rows], x[rows] - pose.centre) for rows, pose in parts]
        # at one point, in the middle of the gap, so that friction has no moment
        middle = 0.5 * (contacts.positions(x, is_first) + contacts.positions(x, ~is_first))
        sign = np.sum(contacts.weights * is_first[contacts.points], axis=1)
        friction, spring_energy = _wrenches(sign[:, None] * forces.spring_force, middle, ends), forces.spring_energy
        self._pairs.end_step(x, forces.slips)
        return PairForces(np.array(of_press) + friction, friction, forces.energy - spring_energy, spring_energy)

    def near_springs(self, poses: Poses) -> tuple[Values, Values] | None:
        """Positions (k, 3), m, and stiffness (k,), N/m, of contacts that may act a step later; None: none."""
        if (x := self._near_positions(poses)) is None:
            return None
        near = self._pairs.near_contacts(x)
        return (near.positions(x, self._meshes.patches == 0), near.stiffness) if len(near.gap) else None

    def snapshot(self) -> ContactHistory:
        """Contacts at the end of the last step."""
        return self._pairs.history

    def restore(self, memory: ContactHistory) -> None:
        """Restore a snapshot."""
        self._pairs.set_history(memory)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays of contacts."""
        history = self._pairs.history
        return {"points": cast("Values", history.points), "values": history.values}

    def from_checkpoint(self, saved: dict[str, Values], suffix: str) -> None:
        """Set contacts from the arrays of a checkpoint."""
        from .penalty_law import ContactHistory

        points, values = cast("Any", saved[f"points{suffix}"]), saved[f"values{suffix}"]
        self._pairs.set_history(ContactHistory(points, values))


class PenaltyPair:
    """A pair of obstacles, its contacts and forces at the end of the last step.

    Attributes:
        numbers: of both.
        forces: at the end of the last step.
        dissipated: by friction in that step, J.
        work: (2,) of the forces on each obstacle in that step, J.
    """

    def __init__(self, numbers: Numbers, obstacles: Mapping[int, RigidObstacle], suffix: str) -> None:
        """`obstacles`: all by their numbers; `suffix`: of the names of its arrays in checkpoints."""
        self._suffix = suffix
        first, second = (obstacles[number] for number in numbers)
        meshes = [isinstance(obstacle.shape, TriangleMeshShape) for obstacle in (first, second)]
        if meshes[1] and not meshes[0]:  # a triangle mesh comes first, since it is in contact at its own points
            numbers, first, second = (numbers[1], numbers[0]), second, first
        self.numbers = numbers
        self.contacts: Any = MeshContacts(first, second) if all(meshes) else InsetPointContacts(first, second)
        self.forces = self._none = PairForces.none(len(first.start_point))
        self.dissipated, self.work = 0.0, (0.0, 0.0)

    def poses(self, posed: Sequence[PosedShape]) -> Poses:
        """Poses of both."""
        return posed[self.numbers[0]].pose, posed[self.numbers[1]].pose

    def end_step(self, starts: Sequence[PosedShape], ends: Sequence[PosedShape], increments: Sequence[Values]) -> None:
        """Take over the forces of the end of a step, with poses at its start and end, and increments (p,) between."""
        start, end = self.forces, self.contacts.end_step(self.poses(starts), self.poses(ends)) or self._none
        q = np.array([increments[number] for number in self.numbers])
        first, second = np.einsum("bp,bp->b", start.wrenches + end.wrenches, q) / 2
        self.work = float(first), float(second)
        by_friction = float(np.vdot(start.friction + end.friction, q)) / 2
        self.dissipated, self.forces = start.spring_energy - end.spring_energy - by_friction, end

    def snapshot(self) -> object:
        """Contacts and forces."""
        return self.contacts.snapshot(), self.forces

    def restore(self, memory: object) -> None:
        """Restore a snapshot."""
        contacts, self.forces = cast("tuple[object, PairForces]", memory)
        self.contacts.restore(contacts)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint."""
        arrays = {"forces": self.forces.to_array()} | self.contacts.to_checkpoint()
        return {f"{name}{self._suffix}": values for name, values in arrays.items()}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set contacts and forces from the arrays of a checkpoint."""
        self.forces = PairForces.from_array(saved[f"forces{self._suffix}"])
        self.contacts.from_checkpoint(saved, self._suffix)


def penalty_pairs_of(obstacles: Mapping[int, RigidObstacle], penalty: Penalty, max_added: float) -> list[PenaltyPair]:
    """Pairs of free obstacles and others.

    Args:
        obstacles: all by their numbers, apart at the start.
        penalty: of points in contact; less stiff where it would add more than a share of `max_added`.
        max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.
    """
    all_numbers = free_pairs([obstacles[n].free for n in range(len(obstacles))])
    pairs = [PenaltyPair(numbers, obstacles, f"_{index}") for index, numbers in enumerate(all_numbers)]
    for pair in pairs:
        members = (obstacles[number] for number in pair.numbers)
        mass = min(obstacle.mass for obstacle in members if isinstance(obstacle, FreeObstacle))
        area = max(pair.contacts.touching_area, np.finfo(float).tiny)
        limit = PAIR_PENALTY.share * max_added * mass * penalty.width / area
        pair.contacts.set_penalty(replace(penalty, stiffness=min(penalty.stiffness, limit)))
    return pairs


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
        energies = [pair.forces.penalty_energy + pair.forces.spring_energy for pair in self._pairs]
        return 0.0 if self.comm.rank else sum(energies)

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all near points were in contact, 1/s^2.

        With the largest eigenvalues l_i, l_j of M^-1 K of both obstacles of a pair it is at most the largest sum of
        l_i + sqrt(l_i l_j) over the pairs of an obstacle (Gershgorin's bound for blocks).
        """
        sums = dict.fromkeys(self.free, 0.0)
        for pair in self._pairs:
            springs: tuple[Values, Values] | None = pair.contacts.near_springs(pair.poses(self.posed))
            if springs is None:
                continue
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


def _motions(x: Values, start: Pose, end: Pose) -> Values:
    """(k, d) motion, between two poses, of the points that are at x (k, d) in the end, m."""
    return x - start.points_to_space(end.to_body(x))


def _wrenches(force: Values, x: Values, poses: Poses) -> Values:
    """(2, p) force and moment on both of forces (k, d) on the first at points x (k, d), N and N m."""
    return np.array([resultant(sign * force, x - pose.centre) for sign, pose in zip((1.0, -1.0), poses, strict=True)])
