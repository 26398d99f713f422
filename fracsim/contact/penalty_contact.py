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
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..mechanics.term import Term, TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import allgather, gather, max_over_ranks, sum_over_ranks
from .clearance import Clearance
from .mesh_obstacle_term import build_mesh_obstacles
from .mesh_obstacles import MeshObstacle
from .obstacle import VerletObstacle
from .partitioned_surface import motion_diagonals
from .penalty_law import ContactHistory, PenaltyForces
from .penalty_pairs import PAIRS
from .penalty_surface import PenaltyBodySurface, PenaltyPart
from .pose import Pose, PosedShape, resultant
from .retractable_surface import SelfContactLaw
from .rigid_obstacles import ObstacleGroup, PoseContact, RigidObstacles

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class IdleState:
    """What lets steps be idle.

    Attributes:
        is_near: whether anything was near contact at the end of the last step.
        displacement: (owned dofs,) where nothing was near, m; None: not known.
        clearance: approach of any two nodes from there on before anything is near, m.
    """

    is_near: bool = False
    displacement: Values | None = None
    clearance: float = 0.0


class PenaltyState:
    """Contacts at the end of the last step, and the test whether steps are idle (HistoryTerm).

    A step is idle where nothing can be in contact, nor was at the end of the last one: nothing is exchanged.
    """

    def __init__(
        self, domain: Domain, u: fem.Function, surface: PenaltyBodySurface, is_far: Callable[[], bool] | None
    ) -> None:
        """Begin with nothing in contact.

        Args:
            domain: mesh.
            u: displacement.
            surface: surface of the body.
            is_far: function that tells whether the body is far from all obstacles at the current u (collective); None:
                the body touches itself.
        """
        self._comm, self._dim, self._u, self._owned = domain.comm, domain.dim, u, domain.node_count * domain.dim
        self._surface, self._is_far, self._idle_state = surface, is_far, IdleState()
        # contacts of a snapshot of another surface, to be set when all ranks come together
        self._restored: list[ContactHistory] | None = None
        self.discard()

    def discard(self) -> None:
        """Discard whether the step is idle, as u or poses have changed."""
        self._idle: bool | None = None  # at the current u; None: not known yet

    def is_idle(self) -> bool:
        """Whether nothing can be in contact at the current u, nor was in the last step (collective)."""
        if self._idle is None:
            self._idle = not self._idle_state.is_near and self._nothing_is_near()
        return self._idle

    def _nothing_is_near(self) -> bool:
        """Whether nothing can be in contact at the current u (collective)."""
        if self._is_far is not None:
            return self._is_far()
        if (reference := self._idle_state.displacement) is None:
            return False
        motion = (self._u.x.array[: self._owned] - reference).reshape(-1, self._dim)
        return float(motion_diagonals(self._comm, [[[motion]]])[0, 0]) <= self._idle_state.clearance

    def measure_clearance(self, x: Values) -> None:
        """Store how far nodes may approach from points x (n, d), m, before anything is near (collective)."""
        if self._is_far is not None:
            return  # bounding boxes are compared in each step
        contact, clearance = self._surface.current.parts[0].contact, 0.0
        # a search of wide gaps is worth it on all ranks or on none
        if not max_over_ranks(self._comm, int(self._surface.has_retracted or contact.anything_is_near(x))):
            reach = max_over_ranks(self._comm, self._surface.reach_of_points())
            clearance = -max_over_ranks(self._comm, -contact.clearance(x)) / reach
        displacement = self._u.x.array[: self._owned].copy() if clearance else None
        self._idle_state = replace(self._idle_state, displacement=displacement, clearance=clearance)

    def surface_changed(self) -> None:
        """Discard the clearance, as it is another surface."""
        self._idle_state = IdleState(self._idle_state.is_near)
        self.discard()

    def end_step(self, *, is_near: bool) -> None:
        """Note whether anything is near contact at the end of a step, on any rank (collective)."""
        any_near = bool(max_over_ranks(self._comm, int(is_near)))
        self._idle_state = replace(self._idle_state, is_near=any_near)

    @property
    def _histories(self) -> list[ContactHistory]:
        return [part.contact.history for part in self._surface.current.parts]

    def settle(self) -> None:
        """Set contacts of a snapshot of another surface, of which points may belong to other ranks (collective)."""
        if self._restored is not None:
            histories, self._restored = self._restored, None
            self._surface.set_history(histories)

    def snapshot(self) -> object:
        """Contacts, number of the surface, and idle state."""
        count = -1 if self._restored else self._surface.surface_count
        return self._restored or self._histories, count, self._idle_state

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        histories, count, idle = cast("tuple[list[ContactHistory], int, IdleState]", memory)
        is_same = count == self._surface.surface_count
        self._restored, self._idle_state = (None, idle) if is_same else (histories, IdleState(idle.is_near))
        for part, history in zip(self._surface.current.parts, histories, strict=True):
            if history is not part.contact.history:
                part.contact.set_history(history)
        self.discard()

    def to_checkpoint(self) -> dict[str, Values]:
        """Contacts of each part, on rank 0 (collective)."""
        self.settle()
        arrays: dict[str, Values] = {}
        for index, history in enumerate(self._histories):
            if (rows := gather(self._comm, history)) is not None:
                of_all = ContactHistory.join(rows)
                arrays |= {f"points_{index}": cast("Values", of_all.points), f"values_{index}": of_all.values}
        return arrays

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective)."""
        names = [(f"points_{index}", f"values_{index}") for index in range(len(self._histories))]
        histories = [ContactHistory(cast("Ints", saved[points]), saved[values]) for points, values in names]
        self._idle_state = IdleState(is_near=any(len(history.points) for history in histories))
        for part, history in zip(self._surface.current.parts, histories, strict=True):
            part.contact.set_history(history)
        self.discard()


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
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            law: contact law.
            mass: (owned dofs,) lumped, kg.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.
            meshes: obstacles; none: the body touches itself.
            is_far: as for PenaltyState.

        Raises:
            InputError: if the surface at rest intersects itself, or an obstacle.
        """
        self.law, self._domain, self._u, self.comm = law, domain, u, domain.comm
        self._owned = domain.node_count * domain.dim
        self._friction_loss = 0.0
        self.surface = PenaltyBodySurface(domain, u, law, mass, max_added, meshes)
        self.state = PenaltyState(domain, u, self.surface, is_far)
        self.parts: tuple[object, ...] = (self.surface, self.state)
        self._set_start(None)
        self.update_displacement()

    # --- surface ---

    @property
    def _parts(self) -> Sequence[PenaltyPart]:
        return self.surface.current.parts

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self.surface.edges_broke(pattern)
        self.state.surface_changed()
        self._set_start(None)
        self.update_displacement()

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        self.state.discard()
        self._positions: Values | None = None
        self._nodal_forces: Values | None = None
        self._forces: list[PenaltyForces | None] | None = None
        self._gradients: list[Values] | None = None

    def clear_search(self) -> None:
        """Discard the candidates of collision detection (not collective)."""
        self.update_displacement()
        for part in self._parts:
            part.contact.clear_caches()

    # --- forces and energy ---

    def _end_positions(self) -> Values:
        """(n, d) positions at the current u, m (collective)."""
        if self._positions is None:
            self._positions = self.surface.positions(self._u.x.array[: self._owned])
            self.state.settle()
            if self._start_u is not None and self._start_count != self.surface.exchange_count:
                self._set_start(self._start_u)
        return self._positions

    def _set_start(self, u: Values | None) -> None:
        """Set the points at the start of the step at displacements u (owned dofs,), m; None: accepted (collective)."""
        self._start_u, self._start_count, self._starts = u, self.surface.exchange_count, None
        if u is not None:
            x = self.surface.current.point_map(self.surface.nodal_values(u))
            poses = self._start_poses()
            self._starts = [part.points(x, pose) for part, pose in zip(self._parts, poses, strict=True)]

    def _start_poses(self) -> Sequence[Pose | None]:
        """Pose of the obstacle of each part at the start of the step."""
        return [None]

    def min_gap(self) -> float:
        """Least gap within the penalty at the current u, m; infinite where none is (collective)."""
        x = self._end_positions()
        gaps = [part.contact.min_gap(part.points(x)) for part in self._parts if not part.is_far(x)]
        return -max_over_ranks(self.comm, -min(gaps, default=np.inf))

    def _part_forces(self, x: Values) -> list[PenaltyForces | None]:
        """Forces of each part with the body at x (n, d), m; None: it is far."""
        if self._forces is None:
            starts = [None] * len(self._parts) if self._starts is None else self._starts
            self._forces = [
                None if part.is_far(x) else part.contact.forces(part.points(x), start, part.friction)
                for part, start in zip(self._parts, starts, strict=True)
            ]
        return self._forces

    def _part_gradients(self, x: Values) -> list[Values]:
        """(n + m, d) minus the forces of each part on its points with the body at x (n, d), m; N."""
        if self._gradients is None:
            parts = zip(self._parts, self._part_forces(x), strict=True)
            zero = np.zeros_like(x)
            self._gradients = [
                zero if forces is None else forces.gradient(len(part.contact.keys)) for part, forces in parts
            ]
        return self._gradients

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the current u, N; None: nothing is near (collective)."""
        if self.state.is_idle():
            return None
        x = self._end_positions()
        if self._nodal_forces is None:
            total = np.sum([gradient[: len(x)] for gradient in self._part_gradients(x)], axis=0)
            self._nodal_forces = self.surface.sum_at_nodes(self.surface.current.point_map.nodal_forces(-total))
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
        self._set_start(None)
        if not level.dt:
            return
        self._friction_loss = 0.0
        if is_idle:
            return
        self.surface.refresh(level.u_n)
        self.state.settle()
        self.surface.extend_faces(level.u_n)
        self._set_start(level.u_n)

    def accept_step(self) -> None:
        """Store contacts and dissipation of the step (collective)."""
        if self.state.is_idle():
            return
        self.state.end_step(is_near=self._store_contacts(self._end_positions()))
        self._set_start(None)

    def _store_contacts(self, x: Values) -> bool:
        """Store contacts at the end of a step with the body at x (n, d), m; whether any are near on this rank."""
        is_near = False
        for part, forces in zip(self._parts, self._part_forces(x), strict=True):
            history = part.contact.history
            if forces is None and not len(history.points):
                continue
            forces = forces or part.contact.forces(part.points(x))
            self._friction_loss += forces.dissipated(history.spring_energy)
            part.contact.end_step(part.points(x), forces.slips)
            is_near |= len(part.contact.history.points) > 0
        return is_near

    def begin_solve(self) -> None:
        """Do nothing: no system is solved."""


class PenaltyMeshContact(PenaltyContact):
    """Contact of a body with triangle-mesh obstacles in explicit steps.

    Attributes:
        group: the obstacles, and what they did to the body in the last step.
    """

    name = "solids"
    _end_u: Values | None = None

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
        self.group = ObstacleGroup(bodies, numbers, law.distance, self._gap, self._wrench)
        self._all_meshes = build_mesh_obstacles(self.group, domain.mean_edge_length)
        # of the last step and of this rank's contacts: force and moment on each, N and N m
        self._wrenches: list[Values] = [np.zeros(6) for _ in numbers]
        self._posed = [bodies.posed[number] for number in numbers]
        for mesh, posed in zip(self._all_meshes, self._posed, strict=True):
            mesh.move_to(posed.pose)
        super().__init__(domain, u, law, mass, max_added, self._all_meshes, self._is_far)
        reach = PAIRS.max_gap * law.distance
        self._clearance = Clearance(domain, self._all_meshes, reach, self.surface.following_points)
        self.parts, self.pose_contact = (*self.parts, self.group, self._clearance), PoseContact(cast("Any", self))

    # --- motion ---

    def _move_to(self, posed: Sequence[PosedShape]) -> None:
        """Move the meshes to the poses of all obstacles; discard forces where they have moved."""
        last, self._posed = self._posed, [posed[number] for number in self.group.numbers]
        if all(new is old or new.pose.equals(old.pose) for new, old in zip(self._posed, last, strict=True)):
            return
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
        return self._clearance.is_far([self._end_displacement()], [(posed, posed) for posed in self._posed])

    def _end_displacement(self) -> Values:
        """(owned dofs,) displacement, m: one array as long as it is the same."""
        if self._end_u is None:
            self._end_u = self._u.x.array[: self._owned]
        return self._end_u

    def update_displacement(self) -> None:
        """Discard positions and forces, as u or poses have changed."""
        self._end_u = None
        super().update_displacement()

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
        # work by the trapezoidal rule, as of velocity Verlet
        last, self._wrenches = self._wrenches, [np.zeros(6) for _ in self.group.numbers]
        super().accept_step()
        self.group.work = [
            -0.5 * float((start + end) @ self.group.bodies.increments[number])
            for start, end, number in zip(last, self._wrenches, self.group.numbers, strict=True)
        ]

    def _store_contacts(self, x: Values) -> bool:
        self._wrenches = [self.rank_wrench(index) for index in range(len(self.group.numbers))]
        return super()._store_contacts(x)

    def _obstacle_frequency(self, x: Values) -> float:
        # the squares of a body and an obstacle on one spring add up
        squares = [0.0]
        for number, part in zip(self.group.numbers, self._parts, strict=True):
            if number not in self.group.bodies.free:
                continue
            obstacle, posed = cast("VerletObstacle", self.group.bodies.free[number]), self.group.bodies.posed[number]
            rows: tuple[Values, Values] = np.empty((0, 3)), np.empty(0)
            if not part.is_far(x):
                points = part.points(x)
                near = part.contact.near_contacts(points)
                rows = near.positions(points, np.arange(len(points)) >= len(x)), near.stiffness
            positions, stiffness = (np.concatenate(arrays) for arrays in zip(*allgather(self.comm, rows), strict=True))
            if len(stiffness):
                squares.append(obstacle.max_frequency(obstacle.spring_stiffness(positions, stiffness, posed), posed))
        return max(squares)

    # --- contact as the obstacles see it (PoseContact) ---

    def is_far(self) -> bool:
        """Whether nothing can be in contact at the current u, nor was in the last step (collective)."""
        return self.state.is_idle()

    def rank_wrench(self, index: int) -> Values:
        """(6,) force and moment on an obstacle at the current u, of this rank's contacts, N and N m (collective)."""
        x, mesh = self._end_positions(), self._all_meshes[index]
        force = -self._part_gradients(x)[index][len(x) :]
        if not len(force):
            return np.zeros(6)
        pressed = force.any(axis=1)
        return resultant(force[pressed], mesh.positions[pressed] - mesh.pose.centre)

    # --- readings ---

    def _wrench(self, index: int) -> Values:
        """(6,) force and moment on an obstacle at the end of the last step, of this rank's contacts, N and N m."""
        return self._wrenches[index]

    def _gap(self, index: int) -> float:
        """Least distance between an obstacle and the body, m, of this rank's points (collective)."""
        if self.state.is_idle():
            return self._clearance.least_gap(index, self._end_displacement(), self._posed)
        return self._parts[index].gap(self._end_positions())

    def pushed_points(self) -> list[tuple[Values, Values, Values]]:
        """(n, 3) points near this rank before each obstacle, m, normal forces, N, start velocities, m/s."""
        x, surface = self._end_positions(), self.surface.current
        velocity, result = surface.point_map.weights @ self.surface.nodal_values(self._start_velocity), []
        for part in self._parts:
            gradient = np.zeros_like(x) if part.is_far(x) else part.contact.gradient(part.points(x))[: len(x)]
            result.append((x, -surface.sum_at_points(gradient), velocity))
        return result

    # --- state: wrenches at the end of the last step (HistoryTerm) ---

    def snapshot(self) -> list[Values]:
        """Wrenches at the end of the last step."""
        return self._wrenches

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self._wrenches = cast("list[Values]", memory)

    def to_checkpoint(self) -> dict[str, Values]:
        """Wrenches at the end of the last step, of all ranks (collective)."""
        return {"wrenches": sum_over_ranks(self.comm, np.array(self._wrenches))}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint: rank 0 has all of it."""
        self._wrenches = [wrench * (self.comm.rank == 0) for wrench in saved["wrenches"]]
