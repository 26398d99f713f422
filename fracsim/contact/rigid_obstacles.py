"""Rigid obstacles of a study: their motion in a step, and the groups of them that terms of contact are about.

    RigidObstacles         held and driven obstacles: motion prescribed, or restricted to a part of it
    ObstacleGroup          obstacles of one term of contact, and what they did to the body in a step
    PoseContact            contact of the body with them, as the obstacles see it

With free ones: rigid_pose in implicit steps, penalty_obstacle_pairs in explicit ones. Terms of contact have the
obstacles' poses from here.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ..array_types import Values
from ..mechanics.term import Term, TimeLevel
from ..mechanics.term_protocols import SurfaceData, TermColumns
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from ..meshes.data import AXES
from .node_contact import PoseDerivatives
from .obstacle import ObstacleTessellation, RigidObstacle, tessellate_obstacle
from .pose import Pose, PosedShape, closing_distance
from .rigid_body import FreeMotions, MovingObstacle
from .step_limit import PoseMotion

if TYPE_CHECKING:
    from .mesh_obstacle_term import MeshObstacleTerm
    from .obstacle_term import ObstacleTerm


type Increments = Mapping[int, Values]  # (p,) of poses, by the numbers of obstacles


class ObstacleTessellations:
    """Tessellations of obstacles for output, made in their own frames when they are first needed."""

    def __init__(self, obstacles: Sequence[RigidObstacle], lower: Values, upper: Values) -> None:
        """`lower`, `upper`: (d,) corners of the body's bounding box at the start, m."""
        self._obstacles, self._box = obstacles, (lower, upper)

    @cached_property
    def _tessellations(self) -> list[ObstacleTessellation]:
        return [tessellate_obstacle(obstacle.posed_at(0.0), *self._box) for obstacle in self._obstacles]

    def __call__(self, posed: Sequence[PosedShape]) -> dict[str, SurfaceData]:
        """Tessellations by the names of obstacles, at the poses of `posed`."""
        items = zip(self._obstacles, self._tessellations, [shape.pose for shape in posed], strict=True)
        return {it.name: SurfaceData(pose.points_to_space(X), *elements) for it, (X, *elements), pose in items}


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

    def work_on_body(self, number: int, by_forces: float) -> float:
        """Work of an obstacle on the body in the last step, J; `by_forces`: that of the forces of contact."""
        return by_forces

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

    def replace_work(self, work: Sequence[float]) -> None:
        """Replace the work of each obstacle in the last step, J, by that of an earlier equilibrium in it."""
        self.work = list(work)

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
        """Work of an obstacle on the body in the last step, J."""
        return self.bodies.work_on_body(self.numbers[index], self.work[index])


class PoseContact:
    """Contact of the body with some obstacles, as the obstacles see it.

    Attributes:
        group: these obstacles.
    """

    def __init__(self, term: ObstacleTerm | MeshObstacleTerm) -> None:
        """`term`: of the contact; one of explicit steps is asked for `wrenches` alone."""
        self._term, self.group = term, term.group
        self._free = [(number, self.group.numbers.index(number)) for number in self.group.free]

    def poses_moved(self) -> None:
        """Take over the poses of obstacles, and discard forces (not collective)."""
        self._term.poses_moved()

    def wrenches(self) -> dict[int, Values]:
        """(p,) force and moment of the body on free ones at the current u, N and N m, of all ranks (collective)."""
        if not self._free or self._term.is_far():
            return {number: np.zeros_like(self.group.bodies.increments[number]) for number, _ in self._free}
        return self._summed([self._term.rank_wrench(index) for _, index in self._free])

    def _summed(self, local: Sequence[Values]) -> dict[int, Values]:
        """Sums over the ranks of values of free obstacles, by their numbers (collective)."""
        sums = sum_over_ranks(self._term.comm, np.array(local))
        return {number: values for (number, _), values in zip(self._free, sums, strict=True)}

    def closing_distances(self) -> list[float]:
        """Distance by which each obstacle and the points it pushes would have approached in the step, m (collective).

        It is that of the velocities at the start, without any contact; of points of this rank.
        """
        group = self.group
        if self._term.is_far():
            return [0.0] * len(group.obstacles)
        dt, items = group.bodies.dt, zip(group.start_poses, group.poses, self._term.pushed_points(), strict=True)
        return [closing_distance(start, end, x, force, dt * v) for start, end, (x, force, v) in items]

    # --- in implicit steps ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of a correction of u (owned dofs,), m, and of free poses on which no gap closes (collective)."""
        term, moving = self._term, self.group.correction_motions()
        return term.safe_fraction(term.end_displacement, np.divide(change, term.level.fraction), moving)

    def rest_fraction(self, increments: Mapping[int, Values], u: Values | None) -> float:
        """Fraction of increments (p,) from the current poses on which no gap to the body closes (collective).

        `u`: (owned dofs,) displacement of the body at rest, m; None: the current one at the end of the step.
        """
        u, posed = self._term.end_displacement if u is None else u, self.group.posed
        moving = {i: (posed[i], increments[n]) for i, n in enumerate(self.group.numbers) if n in increments}
        return self._term.safe_fraction(u, None, moving) if moving else 1.0

    def start_fraction(self, number: int, q: Values, u: Values) -> float:
        """Fraction of an increment (p,) of an obstacle and the motion of the body that closes no gap (collective).

        Both from the start of the step; `u`: (owned dofs,) displacement of the level after the motion, m.
        """
        level, index = self._term.level, self.group.numbers.index(number)
        change = level.displacement_at_end(u) - level.u_n
        return self._term.safe_fraction(level.u_n, change, {index: (self.group.start_posed[index], q)})

    def pose_derivatives(self, *, exact: bool) -> dict[int, PoseDerivatives]:
        """Energy and derivatives by the poses of free ones, of all ranks (collective)."""
        if not self._free:
            return {}
        parts = [PoseDerivatives.none(len(self.group.bodies.increments[number])) for number, _ in self._free]
        if not self._term.is_far():
            parts = [self._term.rank_derivatives(index, exact=exact) for _, index in self._free]
            rows = [np.concatenate([[part.energy], part.gradient, part.hessian.reshape(-1)]) for part in parts]
            parts = [PoseDerivatives.from_array(row) for row in self._summed(rows).values()]
        return {number: part for (number, _), part in zip(self._free, parts, strict=True)}

    def mixed_hessians(self) -> dict[int, Values]:
        """(owned dofs, p) d2E/dx dq by the increments q of poses, of free ones in contact (collective)."""
        if not self._free or self._term.is_far():
            return {}
        parts = [self._term.rank_mixed_hessian(index) for _, index in self._free]
        touching = self._summed([np.array(part.any(), float) for part in parts])
        items = zip(self._free, parts, strict=True)
        return {
            number: self._term.assemble_mixed_hessian(index, part)
            for (number, index), part in items
            if touching[number]
        }

    def uses_exact_tangent(self) -> bool:
        """Whether the tangent at the current u has negative eigenvalues of contact (collective)."""
        return self._term.uses_exact_tangent()

    @property
    def allows_exact_tangent(self) -> bool:
        """Whether tangents are exact near the solution."""
        return self._term.allows_exact_tangent
