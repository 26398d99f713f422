"""Term of the balance for contact of a body with triangle-mesh obstacles in explicit steps: a penalty.

Points of the body act on facets of the obstacle, points of the obstacle on facets of the body, and sharp edges on each
other (penalty_pairs). Both sides act, so that each has half of kappa A_p / D. What the mass of the body leaves to its
points reduces the stiffness of points of the obstacle before them by the same factor. The obstacle itself moves as its
path says, or by velocity Verlet (rigid_obstacles.VerletRigidObstacles).

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from scipy.sparse import csr_matrix, vstack

from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from ..mesh.split_surface.entity_numbering import EntityNumbering
from .ipc_pairs import vertex_areas
from .ipc_surface import SelfContactLaw
from .mesh_obstacle_term import MeshObstacleTerm
from .mesh_obstacles import AllMeshPairs, MeshContactSurface, MeshObstacle, MeshObstaclePairs, Patches
from .obstacle import VerletObstacle
from .penalty_contacts import ContactStiffness
from .penalty_pairs import PairSprings, PenaltyHistory, PenaltyPairs
from .penalty_point_facet import PointHistory, penalty_stiffness
from .pose import Pose
from .pose_derivatives import resultant
from .rigid_obstacles import RigidObstacles, VerletRigidObstacles
from .self_contact import node_gather

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


class MeshPenaltySurface(MeshContactSurface):
    """Surface of a body, and its penalty pairs with triangle-mesh obstacles, on rank 0."""

    pairs: AllMeshPairs[PenaltyPairs]
    closed_pressure: ClassVar[float] = 0.0  # a face that is pressed at all has no room
    search_all_faces: ClassVar[bool] = True  # to read candidates takes longer than to have more of them

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        obstacles: Sequence[MeshObstacle],
        law: SelfContactLaw,
        u: Values,
        previous: MeshPenaltySurface | None,
        body: BodyMass,
    ) -> None:
        """`body`: its mass; the others as for MeshContactSurface."""
        self._law, self._body, self._previous = law, body, previous
        self._stiffness: Values | None = None
        super().__init__(skeleton, pattern, obstacles, law, u, previous)
        self._previous = None

    def _build_pairs(self, elements: Ints) -> AllMeshPairs[PenaltyPairs]:
        pressure = self._law.stiffness / self._law.distance
        area = vertex_areas(self._rest_positions, self.split.elements)
        # by all elements and full arms: constant while a surface lasts
        if self._stiffness is None:
            weights, body = self.point_map.weights, self._body
            # twice that of self-contact, where both sides yield
            self._stiffness = penalty_stiffness(weights, area, body.mass, pressure, 2 * body.max_added)
        by_area, k = 0.5 * pressure * area, self._stiffness
        reduction = np.divide(k, by_area, out=np.ones(len(k)), where=by_area > 0)

        def build(mesh: MeshObstacle) -> MeshObstaclePairs[PenaltyPairs]:
            count, mesh_area = len(mesh.points), vertex_areas(mesh.points, mesh.triangles)
            stiffness = ContactStiffness(
                np.concatenate([k, 0.5 * pressure * mesh_area]),
                np.concatenate([k, np.full(count, np.inf)]),
                np.concatenate([reduction, np.ones(count)]),
            )

            def make_contact(points: Values, triangles: Ints, patches: Patches) -> PenaltyPairs:
                return PenaltyPairs(points, triangles, stiffness, distance=self._law.distance, patch=patches)

            return MeshObstaclePairs(self._rest_positions, elements, mesh, self._law.distance, make_contact)

        pairs = AllMeshPairs([build(mesh) for mesh in self._obstacles])
        self._transfer_contacts(pairs, k)
        return pairs

    def _transfer_contacts(self, pairs: AllMeshPairs[PenaltyPairs], stiffness: Values) -> None:
        """Give pairs the contacts of this surface until now, or of the previous one; `stiffness`: (n,) N/m."""
        last: AllMeshPairs[PenaltyPairs] | None = getattr(self, "pairs", None)
        count = len(stiffness)
        number: Ints = np.arange(count)
        if last is None:
            if self._previous is None:
                return
            last, number = self._previous.pairs, self.new_numbers(self._previous, count)
        for old, new in zip(last.pairs, pairs.pairs, strict=True):
            m = len(new.mesh.points)
            numbers = np.concatenate([number, count + np.arange(m)])
            max_stiffness = np.concatenate([stiffness, np.full(m, np.inf)])
            new.contact.set_history(old.contact.history.renumbered(numbers, max_stiffness))

    @cached_property
    def _no_nodes(self) -> list[csr_matrix]:
        """Of each obstacle, (m, nodes) weights of nodes in its points: none."""
        return [csr_matrix((len(pairs.mesh.points), self._nodes)) for pairs in self.pairs.pairs]

    def max_added_frequencies(self, x: Values) -> list[float]:
        """Bounds of what each obstacle adds to the square of a frequency of the body at x (n, 3), m; 1/s^2."""
        result = []
        for pairs, no_nodes in zip(self.pairs.pairs, self._no_nodes, strict=True):
            if pairs.is_far(x):
                result.append(0.0)
                continue
            nodes = vstack([self.point_map.weights, no_nodes], format="csr")
            result.append(pairs.contact.max_added_frequency(pairs.with_mesh(x), nodes, self._body.mass))
        return result


@dataclass(frozen=True)
class MeshStepStart:
    """Positions at the start of a step.

    Attributes:
        x: (n, 3) points of the body, m.
        poses: of the obstacles.
    """

    x: Values
    poses: Sequence[Pose]


class PenaltyMeshObstacleTerm(MeshObstacleTerm):
    """Triangle-mesh obstacles in explicit steps (rigid_obstacles.ObstacleContactTerm)."""

    _surface: MeshPenaltySurface | None
    _gradients: list[Values] | None = None  # (n + m, 3) minus the forces with each obstacle, N, on rank 0
    _start: MeshStepStart | None = None  # on rank 0; None: the step is accepted, or nothing was near

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
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            bodies: motion of all obstacles.
            numbers: numbers of the triangle meshes.
            law: contact law.
            mass: (owned dofs,) lumped, kg.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.

        Raises:
            InputError: if an obstacle overlaps the body at rest.
        """
        gathered = node_gather(domain, law)(mass.reshape(-1, domain.dim))
        self._body = None if gathered is None else BodyMass(gathered[:, 0].copy(), max_added)
        self._end_wrenches: list[Values] = [
            np.zeros(6) for _ in numbers
        ]  # at the end of the last step, N and N m, on rank 0
        super().__init__(domain, u, bodies, numbers, law)

    def _build_mesh_surface(self, pattern: npt.NDArray[np.uint8], u: Values) -> MeshContactSurface:
        assert self._skeleton is not None and self._body is not None
        return MeshPenaltySurface(self._skeleton, pattern, self._meshes, self.law, u, self._surface, self._body)

    def _rebuild(self) -> None:
        super()._rebuild()
        self._gradients = self._start = None

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        super().update_displacement()
        self._gradients = None

    def poses_moved(self) -> None:
        """Move the meshes to the poses of the obstacles, and discard forces."""
        super().poses_moved()
        self._gradients = None

    def stiffen_contact(self) -> float:
        """Return 0: gaps of a penalty may close."""
        return 0.0

    # --- forces and energy ---

    def _springs(self, pairs: MeshObstaclePairs[PenaltyPairs]) -> PairSprings:
        """Springs of friction with an obstacle, on rank 0."""
        start = None
        if self._start is not None:
            assert self._surface is not None
            pose = self._start.poses[self._surface.pairs.pairs.index(pairs)]
            start = np.concatenate([self._start.x, pairs.mesh.positions_at(pose)])
        return PairSprings(pairs.contact, pairs.mesh.friction, start)

    def _all_gradients(self, x: Values) -> list[Values]:
        """(n + m, 3) minus the forces with each obstacle, friction included, with the body at x (n, 3), m; rank 0."""
        if self._gradients is None:
            assert self._surface is not None
            self._gradients = []
            for pairs in self._surface.pairs.pairs:
                gradient = pairs.full_gradient(x)
                if pairs.mesh.friction and not pairs.is_far(x):
                    gradient = gradient + self._springs(pairs).gradient(pairs.with_mesh(x))
                self._gradients.append(gradient)
        return self._gradients

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the end of the step, N; None: nothing is near (collective)."""
        if self._is_far():
            return None
        x = self._end_positions()
        if self._contact_force is None:

            def forces() -> Values:
                assert self._surface is not None and x is not None
                total = np.sum([gradient[: len(x)] for gradient in self._all_gradients(x)], axis=0)
                return self._surface.nodal_forces(-total)

            self._contact_force = np.asarray(self._gather.scatter(on_root(self.comm, forces))).reshape(-1)
        return self._contact_force

    def damping_forces(self) -> None:
        """Return None: dissipation is summed step by step (`step_work`)."""

    def stored_energy(self) -> float:
        """Energy of the penalty and of the springs of friction at the current u, on rank 0, J (collective)."""
        if self._is_far():
            return 0.0
        x = self._end_positions()
        if self._stored is None:
            self._stored = 0.0
            if x is not None and self._surface is not None:
                self._stored = self._surface.pairs.energy(x)
                for pairs in self._surface.pairs.pairs:
                    if pairs.mesh.friction and not pairs.is_far(x):
                        self._stored += self._springs(pairs).energy(pairs.with_mesh(x))
        return self._stored

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all near points were in contact, 1/s^2 (collective).

        With that of the lightest free obstacle: the squares of a body and an obstacle on one spring add up.
        """
        if self._is_far():
            return 0.0
        x = self._end_positions()

        def bound() -> float:
            assert self._surface is not None and x is not None
            of_free = [self._obstacle_frequency(index, x) for index in range(len(self.numbers))]
            return sum(self._surface.max_added_frequencies(x)) + max(of_free)

        return from_root(self.comm, bound)

    def _obstacle_frequency(self, index: int, x: Values) -> float:
        """Square of the highest frequency of a free obstacle on its contacts, the body at x (n, 3), m; 1/s^2."""
        assert self._surface is not None
        number, pairs = self.numbers[index], self._surface.pairs.pairs[index]
        if number not in self.bodies.free or pairs.is_far(x):
            return 0.0
        obstacle = cast("VerletObstacle", self.bodies.free[number])
        points, posed = pairs.with_mesh(x), self.bodies.posed[number]
        near = pairs.contact.near_contacts(points)
        positions = near.positions(points, np.arange(len(points)) >= len(x))
        return obstacle.max_frequency(obstacle.spring_stiffness(positions, near.stiffness, posed), posed)

    # --- steps ---

    def _begin_on_root(self, surface: MeshContactSurface, nodal: Values, slip: float) -> None:
        surface.extend_faces(nodal)
        self._start_positions = surface.point_map(nodal)
        self._start = MeshStepStart(self._start_positions, self._start_poses)
        self._gradients = None

    def accept_step(self) -> None:
        """Record forces and work of contact in the step, and store contacts for the next one (collective)."""
        self._friction_loss, self._obstacle_work = 0.0, [0.0] * len(self.obstacles)
        forces: list[Values] = [np.zeros(3) for _ in self.obstacles]
        wrenches: list[Values] = [np.zeros(6) for _ in self.obstacles]
        self._force_readings = forces
        if not self._is_far() and (x := self._end_positions()) is not None and self._surface is not None:
            wrenches = self._wrenches_on_root(x)
            for index, pairs in enumerate(self._surface.pairs.pairs):
                forces[index][:] = wrenches[index][:3]
                if not pairs.is_far(x):
                    self._end_contacts(pairs, pairs.with_mesh(x))
        for index, number in enumerate(self.numbers):
            mean = 0.5 * (self._end_wrenches[index] + wrenches[index])
            self._obstacle_work[index] = -float(mean @ self.bodies.increments[number])
        self._end_wrenches, self._start = wrenches, None

    def _end_contacts(self, pairs: MeshObstaclePairs[PenaltyPairs], points: Values) -> None:
        """Store contacts with an obstacle at the end of a step, at `points` (n + m, 3), m, and sum up dissipation."""
        slips = None
        if pairs.mesh.friction:
            springs = self._springs(pairs)
            slips = springs.slips(points)
            self._friction_loss += springs.dissipated(points)
        pairs.contact.end_step(points, slips)

    # --- contact of the body, as the obstacles see it (rigid_obstacles.ObstacleContactTerm) ---

    def wrenches(self, numbers: Sequence[int]) -> dict[int, Values]:
        """(6,) force and moment of the body on obstacles, N and N m (collective)."""
        if not numbers or self._is_far():
            return {number: np.zeros(6) for number in numbers}
        x = self._end_positions()

        def on_obstacles() -> list[Values]:
            assert x is not None
            return self._wrenches_on_root(x)

        all_wrenches = from_root(self.comm, on_obstacles)
        return {number: all_wrenches[self.numbers.index(number)] for number in numbers}

    def _wrenches_on_root(self, x: Values) -> list[Values]:
        """(6,) force and moment of the body at x (n, 3), m, on each obstacle about its reference point, N and N m."""
        assert self._surface is not None
        return [
            resultant(-gradient[len(x) :], pairs.mesh.positions - pairs.mesh.pose.centre)
            for pairs, gradient in zip(self._surface.pairs.pairs, self._all_gradients(x), strict=True)
        ]

    # --- columns of history.csv ---

    def work_columns(self) -> dict[str, Callable[[], float]]:
        """work_NAME: work of each obstacle on the body in the last step, J; of a free one that of its momentum."""
        columns, bodies = super().work_columns(), self.bodies
        if isinstance(bodies, VerletRigidObstacles):
            of_free = [number for number in bodies.free if number in self.numbers]
            columns |= {f"work_{bodies.obstacles[n].name}": partial(bodies.work_on_body, n) for n in of_free}
        return columns

    # --- state ---

    def snapshot(self) -> object:
        """State of the surface, and contacts and wrenches at the end of the last step."""
        contacts = None if self._surface is None else [pairs.contact.history for pairs in self._surface.pairs.pairs]
        return super().snapshot(), contacts, self._end_wrenches

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        surface, contacts, wrenches = cast("tuple[object, list[PenaltyHistory] | None, list[Values]]", memory)
        super().restore(surface)
        self._end_wrenches, self._gradients, self._start = wrenches, None, None
        if self._surface is not None and contacts is not None:
            for pairs, history in zip(self._surface.pairs.pairs, contacts, strict=True):
                pairs.contact.set_history(history)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint, with contacts with each obstacle, and wrenches."""
        arrays = super().to_checkpoint() | {"wrenches": np.array(self._end_wrenches)}
        for index in range(len(self.numbers)):
            history = PenaltyHistory(PointHistory.none(0, 3), None)
            if self._surface is not None:
                history = self._surface.pairs.pairs[index].contact.history
            arrays |= {f"{name}_{index}": values for name, values in history.to_checkpoint().items()}
        return arrays

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        super().from_checkpoint(saved)
        self._end_wrenches = list(saved["wrenches"])
        if self._surface is not None:
            for index, pairs in enumerate(self._surface.pairs.pairs):
                pairs.contact.set_history(PenaltyHistory.from_checkpoint(saved, f"_{index}"))
