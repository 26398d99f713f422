"""Terms of the balance for contact of surfaces in explicit steps: a body with itself, or with triangle-mesh obstacles.

Each rank has its own elements of the body's split surface and those of others near them (partitioned_surface), finds
its contacts (penalty_pairs), and maps forces to the nodes: x = W u, f = -W^T dE/dx. Nothing is exchanged while nothing
is near.

    k_p = kappa A_p / (2 D)    as both sides act, but at most what leaves the stable step as it is (penalty_stiffness)

What contacts near each other add to the square of the highest frequency limits the step.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..array_types import Values
from ..mechanics.term import Term, TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import max_over_ranks, sum_over_ranks
from .clearance import Clearance
from .mesh_obstacle_term import build_mesh_obstacles
from .mesh_obstacles import MeshObstacle
from .obstacle import VerletObstacle
from .penalty_law import PenaltyForces
from .penalty_pairs import PAIRS
from .penalty_surface import PenaltyBodySurface, PenaltyPart, PenaltyState
from .pose import Pose, PosedShape, resultant
from .retractable_surface import SelfContactLaw
from .rigid_obstacles import ObstacleGroup, PoseContact, RigidObstacles


class PenaltyContact(Term):
    """Contact of a body with itself in explicit steps.

    Attributes:
        law: contact law.
        surface: surface of the body.
        state: contacts at the end of the last step, and whether steps are idle.
    """

    name = "contact"

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        law: SelfContactLaw,
        mass: Values,
        max_added: float,
        meshes: Sequence[MeshObstacle] = (),
        is_far: Callable[[], bool] | None = None,
    ) -> None:
        """Build the term (collective); arguments and errors as of PenaltyBodySurface, `is_far` as of PenaltyState."""
        self.law, self._domain, self._u, self.comm = law, domain, u, domain.comm
        self._owned = domain.node_count * domain.dim
        self._friction_loss = 0.0
        self.surface = PenaltyBodySurface(domain, u, law, mass, max_added, meshes)
        self.state = PenaltyState(domain, u, self.surface, is_far)
        self.parts: tuple[object, ...] = (self.surface, self.state)
        self._start_u: Values | None = None  # at the start of a step that is not accepted yet, (owned dofs,), m
        self.update_displacement()

    # --- surface ---

    @property
    def _parts(self) -> Sequence[PenaltyPart]:
        return self.surface.current.parts

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self.surface.edges_broke(pattern)
        self.state.surface_changed()
        self._start_u = None
        self.update_displacement()

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        self.state.discard()
        self._positions: Values | None = None
        self._forces: list[PenaltyForces | None] | None = None
        self._nodal_forces: Values | None = None

    # --- forces and energy ---

    def _end_positions(self) -> Values:
        """(n, d) positions at the current u, m (collective)."""
        if self._positions is None:
            self._positions = self.surface.positions(self._u.x.array[: self._owned])
            self.state.settle()
            # those at the start of the step, with the elements of its end, for springs of friction
            surface, u = self.surface, self._start_u
            self._start: Values | None = None
            if u is not None and any(part.friction for part in self._parts):
                self._start = surface.current.point_map(surface.nodal_values(u))
        return self._positions

    def _start_poses(self) -> Sequence[Pose | None]:
        """Pose of the obstacle of each part at the start of the step."""
        return [None]

    def _part_forces(self, x: Values) -> list[PenaltyForces | None]:
        """Forces of each part with the body at x (n, d), m; None: it is far."""
        if self._forces is None:
            parts = zip(self._parts, self._start_poses(), strict=True)
            self._forces = [None if part.is_far(x) else self._evaluate(part, x, pose) for part, pose in parts]
        return self._forces

    def _evaluate(self, part: PenaltyPart, x: Values, start_pose: Pose | None) -> PenaltyForces:
        """Forces of a part with the body at x (n, d), m; friction begins at the start of the step, if one began."""
        points, start = part.points(x), None
        if self._start is not None and part.friction and len(part.pairs.contacts(points).gap):
            start = part.points(self._start, start_pose)
        return part.pairs.forces(points, start, part.friction)

    def min_gap(self) -> float:
        """Least gap within the penalty at the current u, m; infinite where none is (collective)."""
        all_forces = [forces for forces in self._part_forces(self._end_positions()) if forces is not None]
        gaps = [float(forces.contacts.gap.min(initial=np.inf)) for forces in all_forces]
        return -max_over_ranks(self.comm, -min(gaps, default=np.inf))

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the current u, N; None: nothing is near (collective)."""
        if self.state.is_idle():
            return None
        x = self._end_positions()
        if self._nodal_forces is None:
            of_parts = [forces.force[: len(x)] for forces in self._part_forces(x) if forces is not None]
            total = sum(of_parts, np.zeros_like(x))
            self._nodal_forces = self.surface.nodal_forces(total)
            self.state.measure_clearance(x)
        return self._nodal_forces

    def stored_energy(self) -> float:
        """Energy of the penalty and of the springs of friction at the current u, of this rank, J (collective)."""
        if self.state.is_idle():
            return 0.0
        return sum(forces.energy for forces in self._part_forces(self._end_positions()) if forces is not None)

    def step_work(self) -> tuple[float, float]:
        """Work from outside, 0, and dissipation by friction, of this rank, J."""
        return 0.0, self._friction_loss

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all near points were in contact, 1/s^2 (collective)."""
        if self.state.is_idle():
            return 0.0
        x = self._end_positions()
        return self.surface.max_added_frequency(x) + self._obstacle_frequency(x)

    def _obstacle_frequency(self, x: Values) -> float:
        """Square of the highest frequency of obstacles on contacts, the body at x (n, d), m; 1/s^2 (collective)."""
        return 0.0

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Begin a step with the springs of friction of the last one (collective)."""
        # of the end of the last step, before it is discarded
        is_idle = self.state.is_idle()
        self.update_displacement()
        self._start_u = None
        if not level.dt:
            return
        self._friction_loss = 0.0
        if is_idle:
            return
        self.surface.refresh(level.u_n)
        self.state.settle()
        self.state.extend_faces(level)
        self._start_u = level.u_n

    def accept_step(self) -> None:
        """Store contacts and dissipation of the step (collective)."""
        if self.state.is_idle():
            return
        self.state.end_step(is_near=self._store_contacts(self._end_positions()))
        self._start_u = self._start = None

    def _store_contacts(self, x: Values) -> bool:
        """Store contacts at the end of a step with the body at x (n, d), m; whether any are near on this rank."""
        is_near = False
        for part, forces in zip(self._parts, self._part_forces(x), strict=True):
            history = part.pairs.history
            if forces is None and not len(history.points):
                continue
            forces = forces or self._evaluate(part, x, None)
            self._friction_loss += forces.dissipated(history.spring_energy)
            part.pairs.end_step(part.points(x), forces.slips)
            is_near |= len(part.pairs.history.points) > 0
        return is_near

    def begin_solve(self) -> None:
        """Do nothing: no system is solved."""

    def clear_search(self) -> None:
        """Do nothing: candidates have no effect on results."""


class PenaltyMeshContact(PenaltyContact):
    """Contact of a body with triangle-mesh obstacles in explicit steps.

    Attributes:
        group: the obstacles, and what they did to the body in the last step.
    """

    name = "solids"

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        bodies: RigidObstacles,
        numbers: Sequence[int],
        law: SelfContactLaw,
        mass: Values,
        max_added: float,
    ) -> None:
        """`bodies`: motion of all obstacles; `numbers`: of the triangle meshes; the others as for PenaltyContact."""
        self.group = ObstacleGroup(bodies, numbers, law.distance, self._gap, self.rank_wrench)
        self._all_meshes = build_mesh_obstacles(self.group, domain.mean_edge_length)
        self._posed = [bodies.posed[number] for number in numbers]
        for mesh, posed in zip(self._all_meshes, self._posed, strict=True):
            mesh.move_to(posed.pose)
        super().__init__(domain, u, law, mass, max_added, self._all_meshes, self._is_far)
        reach = PAIRS.max_gap * law.distance
        self._clearance = Clearance(domain, self._all_meshes, reach, self.surface.following_points)
        self.parts, self.pose_contact = (*self.parts, self.group, self._clearance), PoseContact(cast("Any", self))

    # --- motion ---

    def _move_to(self, posed: Sequence[PosedShape]) -> None:
        """Move the meshes to the poses of all obstacles."""
        self._posed = [posed[number] for number in self.group.numbers]
        for mesh, shape in zip(self._all_meshes, self._posed, strict=True):
            mesh.move_to(shape.pose)
        self.update_displacement()

    def _start_poses(self) -> Sequence[Pose | None]:
        """Pose of each obstacle at the start of the step."""
        return self.group.start_poses

    def poses_moved(self) -> None:
        """Move the meshes to the poses of the obstacles."""
        self._move_to(self.group.bodies.posed)

    def _is_far(self) -> bool:
        """Whether the body is far from the obstacles at the current u and poses (collective)."""
        return self._clearance.is_far([self._u.x.array[: self._owned]], [(posed, posed) for posed in self._posed])

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        super().edges_broke(pattern)
        self._clearance.discard()

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of the step; springs of friction begin with those of the last one (collective)."""
        self.group.bodies.begin_step(level)
        self._start_velocity = level.v_n
        # springs of friction begin with both sides at the start
        self._move_to(self.group.bodies.start_posed)
        super().begin_step(level)
        self._move_to(self.group.bodies.posed)

    def accept_step(self) -> None:
        """Store contacts, forces, work and dissipation of the step (collective)."""
        # work by the trapezoidal rule, as of velocity Verlet; with the forces of the last step and of this one
        last, indices = self._last_wrenches, range(len(self.group.numbers))
        self.group.forces = [np.zeros(6) if self.is_far() else self.rank_wrench(index) for index in indices]
        super().accept_step()
        items = zip(last, self.group.forces, self.group.increments, strict=True)
        self.group.work = [-0.5 * float((start + end) @ q) for start, end, q in items]

    @property
    def _last_wrenches(self) -> list[Values]:
        """(6,) forces and moments on obstacles at the end of the last step, N and N m, of this rank's contacts."""
        return self.group.forces or [np.zeros(6) for _ in self.group.numbers]

    def _obstacle_frequency(self, x: Values) -> float:
        # the squares of a body and an obstacle on one spring add up
        squares = [0.0]
        for number, part in zip(self.group.numbers, self._parts, strict=True):
            if number not in self.group.bodies.free:
                continue
            obstacle, posed = cast("VerletObstacle", self.group.bodies.free[number]), self.group.bodies.posed[number]
            springs: tuple[Values, Values] = np.empty((0, 3)), np.empty(0)
            if not part.is_far(x):
                points = part.points(x)
                near = part.pairs.near_contacts(points)
                springs = near.positions(points, np.arange(len(points)) >= len(x)), near.stiffness
            stiffness = sum_over_ranks(self.comm, obstacle.spring_stiffness(*springs, posed))
            squares.append(obstacle.max_frequency(stiffness, posed))
        return max(squares)

    # --- contact as the obstacles see it (PoseContact) ---

    def is_far(self) -> bool:
        """Whether nothing can be in contact at the current u, nor was in the last step (collective)."""
        return self.state.is_idle()

    def rank_wrench(self, index: int) -> Values:
        """(6,) force and moment on an obstacle at the current u, of this rank's contacts, N and N m (collective)."""
        x, mesh = self._end_positions(), self._all_meshes[index]
        if (forces := self._part_forces(x)[index]) is None:
            return np.zeros(6)
        force = forces.force[len(x) :]
        pressed = force.any(axis=1)
        return resultant(force[pressed], mesh.positions[pressed] - mesh.pose.centre)

    # --- readings ---

    def _gap(self, index: int) -> float:
        """Least distance between an obstacle and the body, m, of this rank's points (collective)."""
        if self.state.is_idle():
            return self._clearance.least_gap(index, self._u.x.array[: self._owned], self._posed)
        return self._parts[index].gap(self._end_positions())

    def pushed_points(self) -> list[tuple[Values, Values, Values]]:
        """(n, 3) points near this rank before each obstacle, m, normal forces, N, start velocities, m/s."""
        x, velocity, result = self._end_positions(), self.surface.interpolate(self._start_velocity), []
        for forces in self._part_forces(x):
            force = np.zeros_like(x) if forces is None else forces.normal_force[: len(x)]
            result.append((x, self.surface.current.sum_at_points(force), velocity))
        return result

    # --- state: wrenches at the end of the last step (HistoryTerm) ---

    def snapshot(self) -> list[Values] | None:
        """Wrenches at the end of the last step; None: no step yet."""
        return self.group.forces

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self.group.forces = cast("list[Values] | None", memory)

    def to_checkpoint(self) -> dict[str, Values]:
        """Wrenches at the end of the last step, of all ranks (collective)."""
        return {"wrenches": sum_over_ranks(self.comm, np.array(self._last_wrenches))}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint: rank 0 has all of it."""
        self.group.forces = [wrench * (self.comm.rank == 0) for wrench in saved["wrenches"]]
