"""Terms of the balance for contact of surfaces in explicit steps: a body with itself, or with triangle-mesh obstacles.

Rank 0 has the split surface of the body, finds pairs in contact (penalty_pairs), and maps forces to the nodes:
x = W u, f = -W^T dE/dx. Nothing is gathered while nothing is near.

    k_p = kappa A_p / (2 D)    as both sides act, but at most what leaves the stable step as it is (penalty_stiffness)

What contacts near each other add to the square of the highest frequency limits the step.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse import csr_matrix, vstack

from ..mechanics.term import Term, TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from ..mesh.split_surface.entity_numbering import EntityNumbering
from .ipc_pairs import vertex_areas
from .ipc_surface import SURFACE, SelfContactLaw, SelfContactSurface, SurfacePairs
from .mesh_obstacle_term import approach, build_mesh_obstacle
from .mesh_obstacles import AllMeshPairs, MeshObstacle, MeshObstaclePairs, Patches, ProximityTest, refuse_overlaps
from .obstacle import VerletObstacle
from .penalty_contacts import ContactStiffness
from .penalty_pairs import PairSprings, PenaltyHistory, PenaltyPairs
from .penalty_point_facet import penalty_stiffness
from .pose import Pose, PosedShape
from .pose_derivatives import resultant
from .rigid_obstacles import ObstacleGroup, RigidObstacles
from .self_contact import BreakingSurface, Pattern, node_gather

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class BodyMass:
    """Mass of a body, and what contact may add to its frequencies.

    Attributes:
        mass: (nodes,) kg.
        max_added: 1/s^2 (penalty_stiffness).
    """

    mass: Values
    max_added: float


@dataclass(frozen=True)
class PenaltyPart:
    """Contact of the surface of a body with itself, or with one obstacle.

    Its points are (n + m, d): those of the body, then those of the obstacle.

    Attributes:
        contact: penalty.
        friction: coefficient.
        obstacle: pairs with the obstacle; None: the body with itself.
    """

    contact: PenaltyPairs
    friction: float
    obstacle: MeshObstaclePairs[PenaltyPairs] | None = None

    def is_far(self, x: Values) -> bool:
        """Whether the obstacle is out of contact with the body at x (n, d), m."""
        return self.obstacle is not None and self.obstacle.is_far(x)

    def points(self, x: Values, pose: Pose | None = None) -> Values:
        """(n + m, d) points with the body at x (n, d), m, and the obstacle at a pose; None: the current one."""
        if self.obstacle is None:
            return x
        mesh = self.obstacle.mesh
        return np.concatenate([x, mesh.positions if pose is None else mesh.positions_at(pose)])


class PenaltySurface(SelfContactSurface):
    """Surface of a body with penalty contact, on rank 0.

    Before obstacles alone crack faces are not offset from one another.
    """

    pairs: PenaltyPairs | AllMeshPairs[PenaltyPairs]
    closed_pressure: ClassVar[float] = 0.0  # a face that is pressed at all has no room
    search_all_faces: ClassVar[bool] = True  # to read candidates takes longer than to have more of them

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        law: SelfContactLaw,
        u: Values,
        previous: PenaltySurface | None,
        cut: Values | None,
        body: BodyMass,
        meshes: Sequence[MeshObstacle],
    ) -> None:
        """Build the surface; `body`: its mass; `meshes`: obstacles, none: it touches itself; others as of the base."""
        self._law, self._body, self._meshes, self._previous = law, body, meshes, previous
        self._stiffness: ContactStiffness | None = None
        self.face_gap = 0.0 if meshes else SURFACE.face_gap
        super().__init__(skeleton, pattern, law, u, previous, cut)
        self._previous = None

    @property
    def parts(self) -> list[PenaltyPart]:
        """Contact with itself, or with each obstacle."""
        if isinstance(self.pairs, PenaltyPairs):
            return [PenaltyPart(self.pairs, self._law.friction)]
        return [PenaltyPart(pairs.contact, pairs.mesh.friction, pairs) for pairs in self.pairs.pairs]

    def _check_apart(self) -> None:
        if isinstance(self.pairs, PenaltyPairs):
            super()._check_apart()
        else:
            refuse_overlaps(self.split, self.pairs)

    def _build_pairs(self, elements: Ints) -> SurfacePairs:
        stiffness, distance = self._own_stiffness(), self._law.distance
        pairs: PenaltyPairs | AllMeshPairs[PenaltyPairs]
        if not self._meshes:
            pairs = PenaltyPairs(self._rest_positions, elements, stiffness, distance=distance)
            self._transfer_contacts([pairs])
            return pairs
        pairs = AllMeshPairs([self._pairs_with(mesh, elements, stiffness) for mesh in self._meshes])
        self._transfer_contacts([of_mesh.contact for of_mesh in pairs.pairs])
        return pairs

    def _own_stiffness(self) -> ContactStiffness:
        """Stiffness of the body's points, by all elements and full arms: constant while a surface lasts."""
        if self._stiffness is None:
            pressure, area = self._pressure, vertex_areas(self._rest_positions, self.split.elements)
            # before obstacles twice that of self-contact, where both sides yield
            limit = (2 if self._meshes else 1) * self._body.max_added
            k = penalty_stiffness(self.point_map.weights, area, self._body.mass, pressure, limit)
            reduction: Values = np.ones(len(k))
            if self._meshes:
                reduction = np.divide(k, 0.5 * pressure * area, out=reduction, where=area > 0)
            self._stiffness = ContactStiffness(k, k, reduction)
        return self._stiffness

    @property
    def _pressure(self) -> float:
        return self._law.stiffness / self._law.distance

    def _pairs_with(self, mesh: MeshObstacle, elements: Ints, own: ContactStiffness) -> MeshObstaclePairs[PenaltyPairs]:
        area = vertex_areas(mesh.points, mesh.triangles)
        of_mesh = ContactStiffness(0.5 * self._pressure * area, np.full(len(area), np.inf), np.ones(len(area)))
        stiffness = own.followed_by(of_mesh)

        def make_contact(points: Values, triangles: Ints, patches: Patches) -> PenaltyPairs:
            return PenaltyPairs(points, triangles, stiffness, distance=self._law.distance, patch=patches)

        return MeshObstaclePairs(self._rest_positions, elements, mesh, self._law.distance, make_contact)

    def _transfer_contacts(self, contacts: Sequence[PenaltyPairs]) -> None:
        """Give pairs the contacts of this surface until now, or of the previous one."""
        k = self._own_stiffness().point
        number: Ints = np.arange(len(k))
        if hasattr(self, "pairs"):
            last = self.parts
        elif self._previous is not None:
            last, number = self._previous.parts, self.new_numbers(self._previous, len(k))
        else:
            return
        for old, new in zip(last, contacts, strict=True):
            m = 0 if old.obstacle is None else len(old.obstacle.mesh.points)
            numbers, limit = np.r_[number, len(k) + np.arange(m)], np.r_[k, np.full(m, np.inf)]
            new.set_history(old.contact.history.renumbered(numbers, limit))

    def max_added_frequency(self, x: Values) -> float:
        """Bound of what contact adds to the square of a frequency of the body at x (n, d), m; 1/s^2."""
        weights, total = self.point_map.weights, 0.0
        for part in self.parts:
            if not part.is_far(x):
                points = part.points(x)
                no_nodes = csr_matrix((len(points) - len(x), weights.shape[1]))
                nodes = vstack([weights, no_nodes], format="csr")
                total += part.contact.max_added_frequency(points, nodes, self._body.mass)
        return total

    def reach_of_points(self) -> float:
        """Largest motion of a point where no node moves by more than 1; infinite with retracted faces."""
        share, excluded, _ = self.snapshot()
        if len(excluded) or np.any(share < 1):
            return np.inf
        return float(abs(self.point_map.weights).sum(axis=1).max())


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


class PenaltyContact(Term):
    """Contact of a body with itself in explicit steps.

    Attributes:
        law: contact law.
        surface: surface of the body, on rank 0.
    """

    name = "contact"

    def __init__(self, domain: Domain, u: fem.Function, law: SelfContactLaw, mass: Values, max_added: float) -> None:
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            law: contact law.
            mass: (owned dofs,) lumped, kg.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.

        Raises:
            InputError: if the surface at rest intersects itself, or an obstacle.
        """
        self.law, self._domain, self._u, self.comm = law, domain, u, domain.comm
        self._owned = domain.node_count * domain.dim
        nodal_mass = node_gather(domain, law)(mass.reshape(-1, domain.dim))
        self._body = None if nodal_mass is None else BodyMass(nodal_mass[:, 0].copy(), max_added)
        self._friction_loss = 0.0
        self._idle_state = IdleState()
        self.surface = BreakingSurface(domain, u, law, self._build_surface, everywhere=False)
        self.parts = (self.surface,)
        self._discard_surface()

    # --- surface, on rank 0 ---

    def _build_surface(
        self,
        skeleton: EntityNumbering,
        pattern: Pattern,
        law: SelfContactLaw,
        u: Values,
        previous: PenaltySurface | None,
        cut: Values | None,
    ) -> PenaltySurface:
        assert self._body is not None
        return PenaltySurface(skeleton, pattern, law, u, previous, cut, self._body, self._meshes)

    @property
    def _meshes(self) -> list[MeshObstacle]:
        """Obstacles; none: the body touches itself."""
        return []

    @property
    def _parts(self) -> list[PenaltyPart]:
        return self.surface.current.parts

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self.surface.edges_broke(pattern)
        self._discard_surface()

    def _discard_surface(self) -> None:
        """Discard all that belongs to the points of the surface until now."""
        self._idle_state = IdleState(self._idle_state.is_near, surface_count=self._idle_state.surface_count + 1)
        self._starts: list[Values] | None = None  # (n + m, d) points of each part at the start of the step, m
        self.update_displacement()

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        self._idle: bool | None = None  # at the current u; None: not known yet
        self._positions: Values | None = None
        self._has_positions = False  # the same on all ranks
        self._nodal_forces: Values | None = None
        self._gradients: list[Values] | None = None

    def clear_search(self) -> None:
        """Discard the candidates of collision detection (not collective)."""
        self.update_displacement()
        if self.surface.is_held:
            self.surface.current.pairs.clear_caches()

    # --- idle steps ---

    def _is_idle(self) -> bool:
        """Whether nothing can be in contact at the current u, nor was in the last step (collective)."""
        if self._idle is None:
            self._idle = not self._idle_state.is_near and self._nothing_is_near()
        return self._idle

    def _nothing_is_near(self) -> bool:
        """Whether nothing can be in contact at the current u (collective)."""
        reference = self._idle_state.displacement
        return reference is not None and self._max_approach(reference) <= self._idle_state.clearance

    def _max_approach(self, reference: Values) -> float:
        """Bound of the approach of any two nodes from a displacement (owned dofs,), m (collective).

        It is the diagonal of the bounding box of all motions.
        """
        motion, d = self._u.x.array[: self._owned] - reference, self._domain.dim
        # by columns: minima along the first axis take twenty times as long
        lowest = [motion[axis::d].min(initial=np.inf) for axis in range(d)]
        bounds = np.array([*lowest, *(-motion[axis::d].max(initial=-np.inf) for axis in range(d))])
        self.comm.Allreduce(MPI.IN_PLACE, bounds, MPI.MIN)
        return float(np.linalg.norm(bounds.reshape(2, -1).sum(axis=0)))

    def _measure_clearance(self, x: Values | None) -> None:
        """Store how far nodes may approach from the current u before anything is near (collective)."""

        def clearance() -> float:
            reach = self.surface.current.reach_of_points()
            return 0.0 if x is None or np.isinf(reach) else self._parts[0].contact.clearance(x) / reach

        clear = from_root(self.comm, clearance)
        displacement = self._u.x.array[: self._owned].copy() if clear else None
        self._idle_state = replace(self._idle_state, displacement=displacement, clearance=clear)

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
        if self._is_idle():
            return None
        x = self._end_positions()
        if self._nodal_forces is None:

            def forces() -> Values:
                total = np.sum([gradient[: len(x)] for gradient in self._part_gradients(x)], axis=0)
                return self.surface.current.nodal_forces(-total)

            self._nodal_forces = np.asarray(self.surface.gather.scatter(on_root(self.comm, forces))).reshape(-1)
            self._measure_clearance(x)
        return self._nodal_forces

    def stored_energy(self) -> float:
        """Energy of the penalty and of the springs of friction at the current u, on rank 0, J (collective)."""
        x, energy = None if self._is_idle() else self._end_positions(), 0.0
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
        if self._is_idle():
            return 0.0
        x = self._end_positions()
        return from_root(self.comm, lambda: self.surface.current.max_added_frequency(x) + self._obstacle_frequency(x))

    def _obstacle_frequency(self, x: Values) -> float:
        """Square of the highest frequency of obstacles on their contacts, the body at x (n, d), m; 1/s^2; rank 0."""
        return 0.0

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Begin a step with the springs of friction of the last one (collective)."""
        is_idle = self._is_idle()
        self.update_displacement()
        self._starts = None
        if not level.dt:
            return
        self._friction_loss = 0.0
        if is_idle:
            return
        self._idle_state = replace(self._idle_state)  # another object than that of the snapshot, as faces may move
        nodal = self.surface.nodal_values(level.u_n)
        if self.surface.is_held:
            self.surface.current.extend_faces(nodal)
            x = self.surface.current.point_map(nodal)
            self._starts = [part.points(x) for part in self._parts]

    def accept_step(self) -> None:
        """Store contacts and dissipation of the step (collective)."""
        if self._is_idle():
            return
        x = self._end_positions()
        is_near = from_root(self.comm, lambda: self._end_on_root(x))
        self._idle_state = replace(self._idle_state, is_near=is_near)
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

    # --- state (HistoryTerm) ---

    def snapshot(self) -> object:
        """Contacts, and idle state."""
        return [part.contact.history for part in self._parts] if self.surface.is_held else [], self._idle_state

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        contacts, idle = cast("tuple[list[PenaltyHistory], IdleState]", memory)
        self._starts = None
        if idle is self._idle_state:
            return
        self._set_contacts(contacts)
        # edges may have broken since: it is another surface
        count = self._idle_state.surface_count
        self._idle_state = idle if idle.surface_count == count else IdleState(idle.is_near, surface_count=count)

    def _set_contacts(self, contacts: Sequence[PenaltyHistory]) -> None:
        """Set contacts of each part at the end of the last step, on rank 0."""
        if self.surface.is_held:
            for part, history in zip(self._parts, contacts, strict=True):
                part.contact.set_history(history)
        self.update_displacement()

    def to_checkpoint(self) -> dict[str, Values]:
        """Contacts of each part, on rank 0."""
        if not self.surface.is_held:
            return {}
        histories = [part.contact.history.to_checkpoint() for part in self._parts]
        return {f"{name}_{index}": values for index, arrays in enumerate(histories) for name, values in arrays.items()}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        count = sum(name.startswith("by_") for name in saved)
        contacts = [PenaltyHistory.from_checkpoint(saved, f"_{index}") for index in range(count)]
        is_near = not all(history.is_empty for history in contacts)
        self._idle_state = IdleState(is_near, surface_count=self._idle_state.surface_count)
        self._set_contacts(contacts)


class PenaltyMeshContact(PenaltyContact):
    """Contact of a body with triangle-mesh obstacles in explicit steps (rigid_obstacles.ObstacleContactTerm).

    Attributes:
        group: the obstacles, and what they did to the body in the last step.
        obstacles: these.
        numbers: their numbers in the study.
        barrier_width: gap from which on contact acts, m.
    """

    name = "solids"
    allows_exact_tangent = False

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
        self._proximity = ProximityTest(domain, self.obstacles, law.distance)
        self._dt = 0.0  # s, of the current or last step
        # of the last step, on rank 0: force and moment on each, N and N m
        self._wrenches: list[Values] = [np.zeros(6) for _ in numbers]
        self._poses: list[Pose] = [bodies.posed[number].pose for number in numbers]
        for mesh, pose in zip(self._all_meshes, self._poses, strict=False):
            mesh.move_to(pose)
        super().__init__(domain, u, law, mass, max_added)
        self.parts = (self.surface, self.group)

    @property
    def _meshes(self) -> list[MeshObstacle]:
        return self._all_meshes

    # --- motion ---

    def _move_to(self, posed: Sequence[PosedShape]) -> None:
        """Move the meshes, on rank 0, to the poses of all obstacles; discard forces where they have moved."""
        poses = [posed[number].pose for number in self.numbers]
        if all(map(Pose.equals, poses, self._poses)):
            return
        self._poses = poses
        for mesh, pose in zip(self._all_meshes, poses, strict=False):
            mesh.move_to(pose)
        self.update_displacement()

    def poses_moved(self) -> None:
        """Move the meshes to the poses of the obstacles."""
        self._move_to(self.group.bodies.posed)

    def _nothing_is_near(self) -> bool:
        return self._proximity.is_far([self._u.x.array[: self._owned]], [(pose, pose) for pose in self._poses])

    def _measure_clearance(self, x: Values | None) -> None:
        """Do nothing: bounding boxes are compared in each step."""

    # --- steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Move obstacles to the end of the step; springs of friction begin with those of the last one (collective)."""
        self.group.bodies.begin_step(level)
        self._start_velocity, self._dt = level.v_n, level.dt or self._dt
        self._move_to(self.group.bodies.start_posed)
        super().begin_step(level)
        self._move_to(self.group.bodies.posed)

    def accept_step(self) -> None:
        """Store contacts, forces, work and dissipation of the step (collective)."""
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

    # --- contact of the body, as the obstacles see it (rigid_obstacles.ObstacleContactTerm) ---

    def wrenches(self) -> dict[int, Values]:
        """(6,) force and moment of the body on free obstacles, N and N m (collective)."""
        numbers = self.group.free
        if not numbers or self._is_idle():
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
        x = self._end_positions()
        pairs = None if x is None else self._parts[index].obstacle
        return np.inf if pairs is None else pairs.gap(x)

    def closing_distances(self) -> list[float]:
        """Distance by which each obstacle and the points it pushes would have approached in the step, m (collective).

        It is that of the velocities at the start, without any contact; on rank 0.
        """
        none = [0.0] * len(self.obstacles)
        if self._is_idle():
            return none
        x, v = self._end_positions(), self.surface.nodal_values(self._start_velocity)
        if x is None:
            return none
        motion = self._dt * (self.surface.current.point_map.weights @ v)
        pairs = [part.obstacle for part in self._parts if part.obstacle is not None]
        return [approach(*item, x, motion) for item in zip(pairs, self.group.start_poses, strict=True)]

    # --- state ---

    def snapshot(self) -> object:
        """Contacts, idle state, and wrenches at the end of the last step."""
        return super().snapshot(), self._wrenches

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        contacts, self._wrenches = cast("tuple[object, list[Values]]", memory)
        super().restore(contacts)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint, with wrenches."""
        return super().to_checkpoint() | {"wrenches": np.array(self._wrenches)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        self._wrenches = list(saved["wrenches"])
        super().from_checkpoint(saved)
