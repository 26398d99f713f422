"""Terms of the balance for contact of surfaces in explicit steps: a body with itself, or with triangle-mesh obstacles.

Rank 0 has the split surface of the body, finds pairs in contact (penalty_pairs), and maps forces to the nodes:
x = W u, f = -W^T dE/dx. Nothing is gathered while nothing is near.

    k_p = kappa A_p / (2 D)    as both sides act, but at most what leaves the stable step as it is (penalty_stiffness)

What contacts near each other add to the square of the highest frequency limits the step.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..mechanics.term import Term, TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from .clearance import Clearance, NoDistance, ObstacleDistance
from .ipc_surface import SelfContactLaw
from .mesh_obstacle_term import approach, build_mesh_obstacle
from .mesh_obstacles import MeshObstacle
from .obstacle import VerletObstacle
from .penalty_pairs import BodyMass, PairSprings, PenaltyHistory, PenaltyPart, PenaltySurface
from .penalty_point_facet import POINT_FACET
from .pose import PosedShape
from .pose_derivatives import resultant
from .rigid_obstacles import ObstacleGroup, RigidObstacles
from .self_contact import BreakingSurface, Pattern, node_gather

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class IdleState:
    """What lets steps be idle.

    Attributes:
        is_near: whether anything was near contact at the end of the last step.
        displacement: (owned dofs,) where nothing was near, m; None: not known.
        clearance: approach of any two nodes from there on before anything is near, m.
        surface_count: number of surfaces so far.
    """

    is_near: bool = False
    displacement: Values | None = None
    clearance: float = 0.0
    surface_count: int = 0


class PenaltyState:
    """Contacts at the end of the last step, and the test whether steps are idle (HistoryTerm).

    A step is idle where nothing can be in contact, nor was at the end of the last one: nothing is gathered.
    """

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        surface: BreakingSurface[PenaltySurface],
        is_far: Callable[[], bool] | None,
    ) -> None:
        """Begin with nothing in contact.

        Args:
            domain: mesh.
            u: displacement.
            surface: surface of the body, on rank 0.
            is_far: function that tells whether the body is far from all obstacles at the current u (collective); None:
                the body touches itself.
        """
        self._comm, self._dim, self._u, self._owned = domain.comm, domain.dim, u, domain.node_count * domain.dim
        self._surface, self._is_far, self._idle_state = surface, is_far, IdleState()
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
        """Whether nothing can be in contact at the current u (collective).

        The approach of any two nodes is at most the diagonal of the bounding box of all motions.
        """
        if self._is_far is not None:
            return self._is_far()
        if (reference := self._idle_state.displacement) is None:
            return False
        motion, d = self._u.x.array[: self._owned] - reference, self._dim
        # by columns: minima along the first axis take twenty times as long
        lowest = [motion[axis::d].min(initial=np.inf) for axis in range(d)]
        bounds = np.array([*lowest, *(-motion[axis::d].max(initial=-np.inf) for axis in range(d))])
        self._comm.Allreduce(MPI.IN_PLACE, bounds, MPI.MIN)
        return float(np.linalg.norm(bounds.reshape(2, -1).sum(axis=0))) <= self._idle_state.clearance

    def measure_clearance(self, x: Values | None) -> None:
        """Store how far nodes may approach from x (n, d), m, on rank 0, before anything is near (collective)."""
        if self._is_far is not None:
            return  # bounding boxes are compared in each step

        def clearance() -> float:
            surface = self._surface.current
            reach = surface.reach_of_points()
            return 0.0 if x is None or np.isinf(reach) else surface.parts[0].contact.clearance(x) / reach

        clear = from_root(self._comm, clearance)
        displacement = self._u.x.array[: self._owned].copy() if clear else None
        self._idle_state = replace(self._idle_state, displacement=displacement, clearance=clear)

    def surface_changed(self) -> None:
        """Discard the clearance, as it is another surface."""
        self._idle_state = IdleState(self._idle_state.is_near, surface_count=self._idle_state.surface_count + 1)
        self.discard()

    def begin_step(self) -> None:
        """Begin a step that is not idle: the state is another one than that of the snapshot, as faces may move."""
        self._idle_state = replace(self._idle_state)

    def end_step(self, *, is_near: bool) -> None:
        """Note whether anything is near contact at the end of a step."""
        self._idle_state = replace(self._idle_state, is_near=is_near)

    def snapshot(self) -> object:
        """Contacts, and idle state."""
        surface = self._surface
        histories = [part.contact.history for part in surface.current.parts] if surface.is_held else []
        return histories, self._idle_state

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        histories, idle = cast("tuple[list[PenaltyHistory], IdleState]", memory)
        if idle is self._idle_state:
            return
        self._set_contacts(histories)
        # edges may have broken since: it is another surface
        count = self._idle_state.surface_count
        self._idle_state = idle if idle.surface_count == count else IdleState(idle.is_near, surface_count=count)

    def _set_contacts(self, histories: Sequence[PenaltyHistory]) -> None:
        """Set contacts of each part, on rank 0."""
        if self._surface.is_held:
            for part, history in zip(self._surface.current.parts, histories, strict=True):
                part.contact.set_history(history)
        self.discard()

    def to_checkpoint(self) -> dict[str, Values]:
        """Contacts of each part, on rank 0."""
        if not self._surface.is_held:
            return {}
        histories = [part.contact.history.to_checkpoint() for part in self._surface.current.parts]
        return {f"{name}_{index}": values for index, arrays in enumerate(histories) for name, values in arrays.items()}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        count = sum(name.startswith("by_") for name in saved)
        histories = [PenaltyHistory.from_checkpoint(saved, f"_{index}") for index in range(count)]
        is_near = not all(history.is_empty for history in histories)
        self._idle_state = IdleState(is_near, surface_count=self._idle_state.surface_count)
        self._set_contacts(histories)


class PenaltyContact(Term):
    """Contact of a body with itself in explicit steps.

    Attributes:
        law: contact law.
        surface: surface of the body, on rank 0.
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
            meshes: obstacles, on rank 0; none: the body touches itself.
            is_far: as for PenaltyState.

        Raises:
            InputError: if the surface at rest intersects itself, or an obstacle.
        """
        self.law, self._domain, self._u, self.comm = law, domain, u, domain.comm
        self._owned = domain.node_count * domain.dim
        nodal_mass = node_gather(domain, law)(mass.reshape(-1, domain.dim))
        # on other ranks than 0 no surface is built
        body = BodyMass(np.empty(0) if nodal_mass is None else nodal_mass[:, 0].copy(), max_added)
        self._friction_loss = 0.0
        build = partial(PenaltySurface, body=body, meshes=meshes)
        self.surface = BreakingSurface(domain, u, law, build, everywhere=False)
        self.state = PenaltyState(domain, u, self.surface, is_far)
        self.parts: tuple[object, ...] = (self.surface, self.state)
        self._starts: list[Values] | None = None  # (n + m, d) points of each part at the start of the step, m
        self.update_displacement()

    # --- surface, on rank 0 ---

    @property
    def _parts(self) -> list[PenaltyPart]:
        return self.surface.current.parts

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self.surface.edges_broke(pattern)
        self.state.surface_changed()
        self._starts = None
        self.update_displacement()

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        self.state.discard()
        self._positions: Values | None = None
        self._has_positions = False  # the same on all ranks
        self._nodal_forces: Values | None = None
        self._gradients: list[Values] | None = None

    def clear_search(self) -> None:
        """Discard the candidates of collision detection (not collective)."""
        self.update_displacement()
        if self.surface.is_held:
            self.surface.current.pairs.clear_caches()

    # --- forces and energy ---

    def _end_positions(self) -> Any:
        """(n, d) positions at the current u, m, on rank 0 (collective)."""
        if not self._has_positions:
            self._has_positions, self._positions = True, self.surface.positions(self._u.x.array[: self._owned])
        return self._positions

    def min_gap(self) -> float:
        """Least gap within the penalty at the current u, m; infinite where none is (collective)."""
        x = self._end_positions()
        return from_root(self.comm, lambda: self.surface.current.pairs.min_gap(x))

    def _springs(self, index: int, part: PenaltyPart) -> PairSprings:
        """Springs of friction of a part, on rank 0."""
        return PairSprings(part.contact, part.friction, None if self._starts is None else self._starts[index])

    def _part_gradients(self, x: Values) -> list[Values]:
        """(n + m, d) minus the forces of each part, friction included, with the body at x (n, d), m; on rank 0."""
        if self._gradients is None:
            self._gradients = []
            for index, part in enumerate(self._parts):
                points = part.points(x)
                gradient = np.zeros_like(points)
                if not part.is_far(x):
                    gradient = part.contact.gradient(points)
                    if part.friction:
                        gradient = gradient + self._springs(index, part).gradient(points)
                self._gradients.append(gradient)
        return self._gradients

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the current u, N; None: nothing is near (collective)."""
        if self.state.is_idle():
            return None
        x = self._end_positions()
        if self._nodal_forces is None:

            def forces() -> Values:
                total = np.sum([gradient[: len(x)] for gradient in self._part_gradients(x)], axis=0)
                return self.surface.current.point_map.nodal_forces(-total)

            self._nodal_forces = np.asarray(self.surface.gather.scatter(on_root(self.comm, forces))).reshape(-1)
            self.state.measure_clearance(x)
        return self._nodal_forces

    def stored_energy(self) -> float:
        """Energy of the penalty and of the springs of friction at the current u, on rank 0, J (collective)."""
        x, energy = None if self.state.is_idle() else self._end_positions(), 0.0
        if x is not None:
            for index, part in enumerate(self._parts):
                if not part.is_far(x):
                    points = part.points(x)
                    springs = self._springs(index, part).energy(points) if part.friction else 0.0
                    energy += part.contact.energy(points) + springs
        return energy

    def step_work(self) -> tuple[float, float]:
        """Work from outside, 0, and dissipation by friction, on rank 0, J."""
        return 0.0, self._friction_loss

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all near points were in contact, 1/s^2 (collective)."""
        if self.state.is_idle():
            return 0.0
        x = self._end_positions()
        return from_root(self.comm, lambda: self.surface.current.max_added_frequency(x) + self._obstacle_frequency(x))

    def _obstacle_frequency(self, x: Values) -> float:
        """Square of the highest frequency of obstacles on their contacts, the body at x (n, d), m; 1/s^2; rank 0."""
        return 0.0

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Begin a step with the springs of friction of the last one (collective)."""
        # of the end of the last step, before it is discarded
        is_idle = self.state.is_idle()
        self.update_displacement()
        self._starts = None
        if not level.dt:
            return
        self._friction_loss = 0.0
        if is_idle:
            return
        self.state.begin_step()
        nodal = self.surface.nodal_values(level.u_n)
        if self.surface.is_held:
            self.surface.current.extend_faces(nodal)
            x = self.surface.current.point_map(nodal)
            self._starts = [part.points(x) for part in self._parts]

    def accept_step(self) -> None:
        """Store contacts and dissipation of the step (collective)."""
        if self.state.is_idle():
            return
        x = self._end_positions()
        self.state.end_step(is_near=from_root(self.comm, lambda: self._end_on_root(x)))
        self._starts = None

    def _end_on_root(self, x: Values) -> bool:
        """Store contacts at the end of a step with the body at x (n, d), m, on rank 0; whether any are near."""
        is_near = False
        for index, part in enumerate(self._parts):
            if part.is_far(x) and part.contact.history.is_empty:
                continue
            points, slips = part.points(x), None
            if part.friction:
                springs = self._springs(index, part)
                slips = springs.slips(points)
                self._friction_loss += springs.dissipated(points)
            part.contact.end_step(points, slips)
            is_near |= not part.contact.history.is_empty
        return is_near

    # --- of implicit steps (ContactTerm): nothing to do ---

    def begin_solve(self) -> None:
        """Do nothing: no system is solved."""

    def max_step_fraction(self, change: Values) -> float:
        """Return 1: gaps may close."""
        return 1.0


class PenaltyMeshContact(PenaltyContact):
    """Contact of a body with triangle-mesh obstacles in explicit steps (rigid_obstacles.PoseContact).

    Attributes:
        group: the obstacles, and what they did to the body in the last step.
        obstacles: these.
        numbers: their numbers in the study.
        barrier_width: gap from which on contact acts, m.
    """

    name = "solids"
    allows_exact_tangent = False
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
        self.group, edge = ObstacleGroup(bodies, numbers, self._gap, self._wrench), domain.mean_edge_length
        self.numbers, self.obstacles = self.group.numbers, self.group.obstacles
        self.barrier_width = law.distance
        items = zip(self.numbers, self.obstacles, strict=True)
        self._all_meshes = on_root(domain.comm, lambda: [build_mesh_obstacle(*item, edge) for item in items]) or []
        self._dt = 0.0  # s, of the current or last step
        # of the last step, on rank 0: force and moment on each, N and N m
        self._wrenches: list[Values] = [np.zeros(6) for _ in numbers]
        self._posed = [bodies.posed[number] for number in numbers]
        for mesh, posed in zip(self._all_meshes, self._posed, strict=False):
            mesh.move_to(posed.pose)
        super().__init__(domain, u, law, mass, max_added, self._all_meshes, self._is_far)
        sizes = from_root(domain.comm, lambda: [(mesh.radius, mesh.rotates) for mesh in self._all_meshes])
        distances: list[ObstacleDistance] = [*self._all_meshes] or [NoDistance(*size) for size in sizes]
        reach = POINT_FACET.max_gap * law.distance
        self._clearance = Clearance(domain, distances, reach, self.surface.following_points)
        self.parts, self.pose_contact = (*self.parts, self.group, self._clearance), self

    # --- motion ---

    def _move_to(self, posed: Sequence[PosedShape]) -> None:
        """Move the meshes, on rank 0, to the poses of all obstacles; discard forces where they have moved."""
        last, self._posed = self._posed, [posed[number] for number in self.numbers]
        if all(new is old or new.pose.equals(old.pose) for new, old in zip(self._posed, last, strict=True)):
            return
        for mesh, shape in zip(self._all_meshes, self._posed, strict=False):
            mesh.move_to(shape.pose)
        self.update_displacement()

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

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        super().edges_broke(pattern)
        self._clearance.discard()

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of the step; springs of friction begin with those of the last one (collective)."""
        self.group.bodies.begin_step(level)
        self._start_velocity, self._dt = level.v_n, level.dt or self._dt
        # springs of friction begin with both sides at the start
        self._move_to(self.group.bodies.start_posed)
        super().begin_step(level)
        self._move_to(self.group.bodies.posed)

    def accept_step(self) -> None:
        """Store contacts, forces, work and dissipation of the step (collective)."""
        # work by the trapezoidal rule, as of velocity Verlet
        last, self._wrenches = self._wrenches, [np.zeros(6) for _ in self.numbers]
        super().accept_step()
        self.group.work = [
            -0.5 * float((start + end) @ self.group.bodies.increments[number])
            for start, end, number in zip(last, self._wrenches, self.numbers, strict=True)
        ]

    def _end_on_root(self, x: Values) -> bool:
        self._wrenches = self._wrenches_on_root(x)
        return super()._end_on_root(x)

    def _obstacle_frequency(self, x: Values) -> float:
        # the squares of a body and an obstacle on one spring add up
        squares = [0.0]
        for number, part in zip(self.numbers, self._parts, strict=True):
            if number in self.group.bodies.free and not part.is_far(x):
                obstacle, posed = (
                    cast("VerletObstacle", self.group.bodies.free[number]),
                    self.group.bodies.posed[number],
                )
                points = part.points(x)
                near = part.contact.contacts_ahead(points)
                positions = near.positions(points, np.arange(len(points)) >= len(x))
                stiffness = obstacle.spring_stiffness(positions, near.stiffness, posed)
                squares.append(obstacle.max_frequency(stiffness, posed))
        return max(squares)

    # --- contact of the body, as the obstacles see it (rigid_obstacles.PoseContact) ---

    def wrenches(self) -> dict[int, Values]:
        """(6,) force and moment of the body on free obstacles, N and N m (collective)."""
        numbers = self.group.free
        if not numbers or self.state.is_idle():
            return {number: np.zeros(6) for number in numbers}
        x = self._end_positions()
        all_wrenches = from_root(self.comm, lambda: self._wrenches_on_root(x))
        return {number: all_wrenches[self.numbers.index(number)] for number in numbers}

    def _wrenches_on_root(self, x: Values) -> list[Values]:
        """(6,) force and moment of the body at x (n, 3), m, on each obstacle about its reference point, N and N m."""
        result = []
        for mesh, gradient in zip(self._all_meshes, self._part_gradients(x), strict=True):
            force = -gradient[len(x) :]
            pressed = force.any(axis=1)
            result.append(resultant(force[pressed], mesh.positions[pressed] - mesh.pose.centre))
        return result

    # --- readings ---

    def _wrench(self, index: int) -> Values:
        """(6,) force and moment of the body on an obstacle at the end of the last step, on rank 0, N and N m."""
        return self._wrenches[index]

    def _gap(self, index: int) -> float:
        """Least distance between an obstacle and the body, m; on rank 0, infinite elsewhere (collective)."""
        if self.state.is_idle():
            return self._clearance.least_gap(index, self._end_displacement(), self._posed)
        x = self._end_positions()
        pairs = None if x is None else self._parts[index].obstacle
        return np.inf if pairs is None else pairs.gap(x)

    def closing_distances(self) -> list[float]:
        """Distance by which each obstacle and the points it pushes would have approached in the step, m (collective).

        It is that of the velocities at the start, without any contact; on rank 0.
        """
        none = [0.0] * len(self.obstacles)
        if self.state.is_idle():
            return none
        x, v = self._end_positions(), self.surface.nodal_values(self._start_velocity)
        if x is None:
            return none
        motion = self._dt * (self.surface.current.point_map.weights @ v)
        pairs = [part.obstacle for part in self._parts if part.obstacle is not None]
        return [approach(*item, x, motion) for item in zip(pairs, self.group.start_poses, strict=True)]

    # --- state: wrenches at the end of the last step (HistoryTerm) ---

    def snapshot(self) -> list[Values]:
        """Wrenches at the end of the last step."""
        return self._wrenches

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self._wrenches = cast("list[Values]", memory)

    def to_checkpoint(self) -> dict[str, Values]:
        """Wrenches at the end of the last step."""
        return {"wrenches": np.array(self._wrenches)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        self._wrenches = list(saved["wrenches"])
