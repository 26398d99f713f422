"""Rigid obstacles of a study: their motion in a step, and the groups of them that terms of contact are about.

    RigidObstacles         held and driven obstacles: motion prescribed, or restricted to a part of it
    VerletRigidObstacles   with free ones in explicit steps: velocity Verlet
    ObstacleGroup          obstacles of one term of contact, and what they did to the body in a step

With free ones in implicit steps: rigid_pose. Terms of contact have the obstacles' poses from here.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..mechanics.term import Term, TimeLevel
from ..mechanics.term_protocols import SurfaceData, TermColumns
from ..mesh.domain import Domain
from ..meshes.data import AXES
from .obstacle import FreeObstacle, RigidObstacle, VerletObstacle
from .obstacle_tessellation import ObstacleTessellations
from .pose import Pose, PosedShape
from .pose_derivatives import PoseContact
from .rigid_body import FreeMotions, MovingObstacle
from .step_limit import PoseMotion

if TYPE_CHECKING:
    from .penalty_obstacle_pairs import PenaltyPair

Values = npt.NDArray[np.float64]

type Increments = Mapping[int, Values]  # (p,) of poses, by the numbers of obstacles


class RigidObstacles(Term):
    """Held and driven obstacles.

    Attributes:
        obstacles: all obstacles of the study, by their numbers.
        free: free ones by their numbers.
        prescribed: numbers of those with a prescribed motion.
        posed: obstacles at their current poses.
        start_posed: obstacles at the start of the step.
        increments: (p,) increment of each pose in the step.
        motions: states of motion of free ones.
        contacts: terms of contact of the body with some of the obstacles each.
        dt: size of the current or last step, s; 0 before the first one.
        evaluates_result: whether the current level is the result of the last step, not a new step or state.
    """

    name = "rigid"
    obstacles: tuple[RigidObstacle, ...]
    free: Mapping[int, MovingObstacle]
    posed: list[PosedShape]
    start_posed: list[PosedShape]
    increments: list[Values]

    def __init__(
        self, domain: Domain, obstacles: Sequence[RigidObstacle], free: Mapping[int, MovingObstacle] | None = None
    ) -> None:
        """`obstacles`: by their numbers in the study; `free`: free ones, None: there are none."""
        self.comm, self.dim, self.obstacles, self.free = domain.comm, domain.dim, tuple(obstacles), free or {}
        self.prescribed = [number for number in range(len(obstacles)) if number not in self.free]
        self.contacts: list[PoseContact] = []
        self._tessellations = ObstacleTessellations(self.obstacles, domain.bounds.lower, domain.bounds.upper)
        self._level: TimeLevel | None = None
        self._end, self.dt, self.evaluates_result = -np.inf, 0.0, False
        self._travelled = 1.0  # fraction of the prescribed motion
        self.motions = FreeMotions(self.free, self.comm.rank == 0, self._motions_restored)
        self.parts = (self.motions,) if self.free else ()
        self._place(0.0, 0.0)

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of a step; contact terms call it first, and it acts once."""
        if level is self._level:
            return
        self._level = level
        end = level.t + (1 - level.fraction) * level.dt
        self.evaluates_result = not level.dt and abs(end - self._end) <= 1e-9 * self.dt
        if self.evaluates_result:
            return  # motions are still those of the step
        self._end, self.dt = end, level.dt
        self._place(end - level.dt, end)

    def _place(self, start: float, end: float) -> None:
        """Place obstacles at the times of the start and the end of a step, s."""
        self._travelled = 1.0
        self.posed = [obstacle.posed_at(end) for obstacle in self.obstacles]
        self.start_posed = [obstacle.posed_at(start) for obstacle in self.obstacles]
        self.increments = [obstacle.pose_increment(start, end) for obstacle in self.obstacles]
        # free ones start where their last step ended
        for number, obstacle in self.free.items():
            shape = self.obstacles[number].shape
            self.posed[number] = self.start_posed[number] = PosedShape(shape, obstacle.motion.pose)

    def posed_at(self, t: float) -> list[PosedShape]:
        """Each obstacle at the time t of the state, s (not collective)."""
        return self.motions.place([obstacle.posed_at(t) for obstacle in self.obstacles])

    def output_surfaces(self, t: float) -> dict[str, SurfaceData]:
        """Tessellation of each obstacle at the time t of the state, s, by its name."""
        return self._tessellations(self.posed_at(t))

    def potential(self) -> float:
        """Potential of their motion, J: prescribed obstacles have none."""
        return 0.0

    def _motions_restored(self) -> None:
        """Place free obstacles by their states of motion."""
        self.motions.place(self.posed)
        self._tell_moved()

    # --- motion of points of obstacles ---

    def point_motion(self, number: int, x: Values) -> Values:
        """(d,) motion of an obstacle in the step, or (n, d) of its points that were at x (n, d) at its start, m."""
        if number not in self.free:
            return np.asarray(self.increments[number][: self.dim])
        return self.posed[number].pose.points_to_space(self.start_posed[number].pose.to_body(x)) - x

    def velocity(self, number: int, x: Values) -> Values:
        """(d,) velocity of an obstacle at the start of the step, or (n, d) of its points at x (n, d), m/s."""
        return np.asarray(self.increments[number][: self.dim] / self.dt)

    def correction_increments(self) -> Increments:
        """Increments of free poses in a correction of Newton's method."""
        return {}

    def may_use_exact_tangent(self) -> bool:
        """Whether exact tangents of contact leave the equations of the poses positive definite (collective)."""
        return True

    # --- restriction of the prescribed motion ---

    def prescribed_motions(self) -> dict[int, PoseMotion]:
        """Full motion of each prescribed obstacle in the step, by its number."""
        return {number: (self.start_posed[number], self.increments[number]) for number in self.prescribed}

    def restrict_motion(self) -> None:
        """Hold obstacles where they would meet the body at the step's start (collective).

        A part that is jammed between an obstacle and something else cannot be moved along by a first guess.
        """
        assert self._level is not None
        self._move_prescribed(0.0)
        self._advance(self._level.u_n)

    def remaining_motion(self) -> float:
        """Fraction of the prescribed motion that remains in the step."""
        return 1.0 - self._travelled

    def continue_motion(self) -> None:
        """Advance restricted obstacles as far as the body at the current u allows (collective)."""
        if self._travelled < 1:
            self._advance(None)

    def _advance(self, u: Values | None) -> None:
        """Advance prescribed obstacles as far as the body and free obstacles at rest allow (collective)."""
        remaining = 1.0 - self._travelled
        increments = {number: remaining * self.increments[number] for number in self.prescribed}
        fraction = self.free_fraction(increments, u)
        # exactly 1, as Newton's method ends when nothing remains
        self._move_prescribed(1.0 if fraction == 1 else self._travelled + fraction * remaining)

    def free_fraction(self, increments: Increments, u: Values | None = None) -> float:
        """Fraction of increments from current poses on which no gap closes, with the body at rest (collective).

        `u`: (owned dofs,) displacement of the body, m; None: the current one at the end of the step.
        """
        fractions = [
            contact.rest_fraction({number: q for number, q in increments.items() if number in contact.group.numbers}, u)
            for contact in self.contacts
        ]
        return min([*fractions, self._fraction_between(increments)])

    def _fraction_between(self, increments: Increments) -> float:
        """Fraction of increments from current poses on which no gap between obstacles closes."""
        return 1.0

    def _move_prescribed(self, travelled: float) -> None:
        """Move prescribed obstacles to a fraction of their motion in the step."""
        self._travelled = travelled
        for number in self.prescribed:
            start = self.start_posed[number]
            pose = start.pose.incremented(travelled * self.increments[number])
            self.posed[number] = PosedShape(start.shape, pose)
        self._tell_moved()

    def _tell_moved(self) -> None:
        for contact in self.contacts:
            contact.poses_moved()


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

    def work_on_body(self, number: int) -> float:
        """Work of a free obstacle on the body in the last step, on rank 0, J."""
        return 0.0 if self.comm.rank else -self._contact_work[number]

    def step_work(self) -> tuple[float, float]:
        """Work of gravity and prescribed obstacles on free ones, and dissipation between obstacles, on rank 0, J."""
        if self.comm.rank:
            return 0.0, 0.0
        items = [(number, work) for pair in self._pairs for number, work in zip(pair.numbers, pair.work, strict=True)]
        by_prescribed = -sum(work for number, work in items if number not in self.free)
        by_gravity = sum(obstacle.gravity_work for obstacle in self.free.values())
        return by_gravity + by_prescribed, sum(pair.dissipated for pair in self._pairs)


class ObstacleGroup:
    """Obstacles that one term of contact is about, and what they did to the body in the last step.

    Work, dissipation and forces are parts of this rank.

    Attributes:
        bodies: motion of all obstacles of the study.
        numbers: numbers of those of the group.
        obstacles: these.
        free: numbers of the free ones among them.
        barrier_width: gap to the body below which contact acts, m.
        work: of each on the body in the last step, J.
        friction_loss: dissipation by friction in the last step, J.
        forces: (d,) of the body on each at the end of the last step, N; further numbers may follow. None: no step yet.
    """

    forces: list[Values] | None = None

    def __init__(
        self,
        bodies: RigidObstacles,
        numbers: Sequence[int],
        barrier_width: float,
        gap: Callable[[int], float],
        current_force: Callable[[int], Values],
    ) -> None:
        """Group obstacles.

        Args:
            bodies: motion of all obstacles of the study.
            numbers: numbers of those of the group.
            barrier_width: gap to the body below which contact acts, m.
            gap: index in the group -> least distance from the body at the current u, m; of this rank's surface.
            current_force: index -> force (d,) of the body at the current u, N, which counts before the first step.
        """
        self.bodies, self.numbers, self._gap, self._current_force = bodies, tuple(numbers), gap, current_force
        self.obstacles = tuple(bodies.obstacles[number] for number in numbers)
        self.free = [number for number in numbers if bodies.obstacles[number].free]
        self.barrier_width = barrier_width
        self.work, self.friction_loss = [0.0] * len(self.obstacles), 0.0

    # --- motion ---

    @property
    def posed(self) -> list[PosedShape]:
        """Obstacles at their current poses."""
        return [self.bodies.posed[number] for number in self.numbers]

    @property
    def start_posed(self) -> list[PosedShape]:
        """Obstacles at the start of the step."""
        return [self.bodies.start_posed[number] for number in self.numbers]

    @property
    def increments(self) -> list[Values]:
        """(p,) increment of each pose in the step."""
        return [self.bodies.increments[number] for number in self.numbers]

    @property
    def poses(self) -> list[Pose]:
        """Current poses."""
        return [posed.pose for posed in self.posed]

    @property
    def start_poses(self) -> list[Pose]:
        """Poses at the start of the step."""
        return [posed.pose for posed in self.start_posed]

    def motions(self, moving: Mapping[int, PoseMotion]) -> list[tuple[PosedShape, PosedShape]]:
        """Each at the start and the end of its motion, given by its index in the group; others at rest."""
        result = []
        for index, posed in enumerate(self.posed):
            start, q = moving.get(index, (posed, np.zeros(0)))
            result.append((start, PosedShape(start.shape, start.pose.incremented(q)) if q.any() else start))
        return result

    def correction_motions(self) -> dict[int, PoseMotion]:
        """Motions from current poses in a correction of Newton's method, by the indices in the group."""
        increments = self.bodies.correction_increments()
        items = enumerate(zip(self.numbers, self.posed, self.increments, strict=True))
        return {index: (posed, increments.get(number, 0 * q)) for index, (number, posed, q) in items}

    @property
    def step_motions(self) -> list[tuple[PosedShape, PosedShape]]:
        """Each at the start of the step, and now."""
        return list(zip(self.start_posed, self.posed, strict=True))

    # --- the last step ---

    def step_work(self) -> tuple[float, float]:
        """Work of prescribed obstacles in the last step, and dissipation by friction, J."""
        items = zip(self.work, self.obstacles, strict=True)
        return sum(work for work, obstacle in items if not obstacle.free), self.friction_loss

    def history_columns(self) -> TermColumns:
        """contact_NAME_AXIS: force of the body, N; work_NAME: work on the body, J; gap_NAME: least distance, m."""
        items = list(enumerate(self.obstacles))
        return TermColumns(
            sums={
                f"contact_{obstacle.name}_{axis_name}": partial(self._force_reading, index, axis)
                for index, obstacle in items
                for axis, axis_name in enumerate(AXES[: self.bodies.dim])
            },
            works={f"work_{obstacle.name}": partial(self._work_reading, index) for index, obstacle in items},
            minima={f"gap_{obstacle.name}": partial(self._gap, index) for index, obstacle in items},
        )

    def _force_reading(self, index: int, axis: int) -> Values:
        force = self._current_force(index) if self.forces is None else self.forces[index]
        return force[axis : axis + 1]

    def _work_reading(self, index: int) -> float:
        """Work of an obstacle in the last step, J; of a free one in explicit steps that of its momentum."""
        if isinstance(self.bodies, VerletRigidObstacles) and self.obstacles[index].free:
            return self.bodies.work_on_body(self.numbers[index])
        return self.work[index]
