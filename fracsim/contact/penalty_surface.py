"""Penalty contact of a body's surface with itself, or with triangle-mesh obstacles, on the elements of a rank.

    PenaltyBodySurface    surface of the body on all ranks, and its contacts
    PenaltyState          contacts at the end of the last step, and whether steps are idle

The contact of a point, or of an edge with one that comes later in the order of the surface, belongs to the lowest rank
that has an element at the point or edge.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, cast

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..array_types import Ints, Values
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import allgather, gather, max_over_ranks
from .element_exchange import EXCHANGE, bounding_boxes, motion_diagonals, own_points
from .mesh_obstacles import MeshObstacle, SurfacePart
from .pair_search import max_length
from .partitioned_surface import PartitionedSurface
from .penalty_law import (
    PENALTY,
    ContactStiffness,
    ElementRanks,
    NodalMassShare,
    PenaltyContacts,
    penalty_stiffness,
)
from .penalty_pairs import PAIRS, PenaltyPairs
from .retractable_surface import RetractableSurface, SelfContactLaw
from .sample_points import vertex_areas

type PenaltyPart = SurfacePart[PenaltyPairs]  # contact of the body with itself, or with an obstacle


class PenaltyBodySurface(PartitionedSurface[SurfacePart[PenaltyPairs]]):
    """Contact surface of a body with a penalty."""

    closed_pressure: ClassVar[float] = 0.0  # a face that is pressed at all has no room

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        law: SelfContactLaw,
        mass: Values,
        max_added: float,
        meshes: Sequence[MeshObstacle] = (),
    ) -> None:
        """Build the surface (collective).

        Args:
            domain: mesh.
            u: displacement.
            law: contact law.
            mass: (owned dofs,) lumped, kg.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.
            meshes: obstacles; none: the body touches itself.

        Raises:
            InputError: if the surface at rest intersects itself, or an obstacle.
        """
        self._mass, self._max_added = mass, max_added
        reach, margin = PAIRS.clearance_gap * law.distance, EXCHANGE.margin * domain.mean_edge_length
        super().__init__(domain, u, law, meshes, reach, margin)

    def _build_parts(self, surface: RetractableSurface[PenaltyPart], elements: Ints) -> list[PenaltyPart]:
        """Contacts of elements (k,) of a surface, with the history of those that it has."""
        parts = super()._build_parts(surface, elements)
        for part, previous in zip(parts, surface.parts, strict=False):
            part.pairs.set_history(previous.pairs.history)
        return parts

    def _build_part(
        self, surface: RetractableSurface[PenaltyPart], elements: Ints, mesh: MeshObstacle | None
    ) -> PenaltyPart:
        corners, rank = surface.elements[elements], surface.element_set.elements.rank[elements]
        points, X, is_own = surface.element_set.points, surface.rest_positions, surface.own_points
        k, keys, this, size, patch = points.stiffness, points.keys, self._comm.rank, self._comm.size, None
        stiffness, friction, all_elements = ContactStiffness.of_one_body(k), self.law.friction, corners
        if mesh is not None:
            n, m, friction = len(X), len(mesh.points), mesh.friction
            rate = 0.5 * self.law.stiffness / self.law.distance
            reduction = np.divide(k, rate * points.area, out=np.ones(n), where=points.area > 0)
            of_mesh = rate * vertex_areas(mesh.points, mesh.triangles)
            rigid = ContactStiffness(of_mesh, np.full(m, np.inf), np.ones(m))
            stiffness = ContactStiffness(k, k, reduction).followed_by(rigid)
            ranks_of_mesh = mesh.triangle_ranks(size)
            is_own = np.append(is_own, own_points(ranks_of_mesh, mesh.triangles, m, this))
            rank, X = np.append(rank, ranks_of_mesh), np.concatenate([X, mesh.points])
            all_elements = np.concatenate([corners, mesh.triangles + n])
            patch, keys = np.repeat(np.array([0, 1], np.int32), [n, m]), np.append(keys, -1 - np.arange(m))
        pairs = PenaltyPairs(
            X, all_elements, stiffness, distance=self.law.distance, patch=patch, edge=self.mean_edge, keys=keys,
            ranks=ElementRanks(rank, this, is_own) if size > 1 else None,
        )  # fmt: skip
        return SurfacePart(pairs, corners, self.law.distance, friction, mesh)

    def _point_stiffness(self, weights: csr_matrix, area: Values, local_area: Values) -> Values:
        """(n,) stiffness of the points of this rank, N/m: constant while a surface lasts (collective).

        A side has one half of the pressure of an area, as the other one acts too.
        """
        d, nodes = self._domain.dim, self._own_nodes
        assert nodes is not None

        def nodal_sums(values: Values) -> Values:
            total = nodes.sum_at_nodes(np.repeat(values[:, None], d, axis=1))
            return nodes(total)[:, 0].copy()

        # before obstacles twice that of self-contact, where both sides yield
        limit = (2 if self._meshes else 1) * PENALTY.point_share * self._max_added
        mass_share = NodalMassShare(weights, nodes(self._mass)[:, 0].copy(), nodal_sums)
        return penalty_stiffness(mass_share, area, 0.5 * self.law.stiffness / self.law.distance, limit, local_area)

    def _moving_points(self, u: Values) -> list[Values]:
        return [*super()._moving_points(u), *(mesh.positions for mesh in self._meshes)]

    def _searched_boxes(self, boxes: Values) -> Values:
        if not self._meshes:
            return boxes
        sides = [mesh.triangles[mesh.triangle_ranks(self._comm.size) == self._comm.rank] for mesh in self._meshes]
        near = [bounding_boxes(mesh.positions[rows]) for mesh, rows in zip(self._meshes, sides, strict=True)]
        return np.concatenate([boxes[self.border_elements()], *near])

    # --- contacts ---

    def _keep_history(self, previous: RetractableSurface[PenaltyPart]) -> None:
        self.set_history([part.pairs.history for part in previous.parts])

    def set_history(self, histories: Sequence[PenaltyContacts]) -> None:
        """Set the contacts of each part at the end of the last step; each goes to the rank that it belongs to.

        Collective.
        """
        for part, history in zip(self.current.parts, histories, strict=True):
            of_all = history if self._comm.size == 1 else PenaltyContacts.join(allgather(self._comm, history))
            part.pairs.set_history(of_all)

    def max_added_frequency(self, x: Values) -> float:
        """Bound of what contact adds to the square of a frequency with points at x (n, d), m; 1/s^2 (collective)."""
        weights, d, largest = self.current.point_map.weights, self._domain.dim, np.zeros(len(self.current.parts))
        loads = [
            np.zeros(weights.shape[1])
            if part.is_far(x)
            else part.pairs.near_contacts(part.points(x)).added_load(weights)
            for part in self.current.parts
        ]
        if self._comm.allreduce(bool(np.any(loads)), op=MPI.LOR):
            for part, load in enumerate(loads):
                total = self.sum_at_nodes(np.repeat(load[:, None], d, axis=1))
                largest[part] = (total / self._mass).max(initial=0.0)
            self._comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        return float(largest.sum())


@dataclass(frozen=True)
class IdleState:
    """What lets steps be idle.

    Attributes:
        is_near: whether anything was near contact at the end of the last step.
        displacement: (owned dofs,) where nothing was near, m; None: not known.
        clearance: approach of any two nodes from there on before anything is near, m.
        motion: bound of the motion of nodes since crack faces were extended last, m.
    """

    is_near: bool = False
    displacement: Values | None = None
    clearance: float = 0.0
    motion: float = 0.0

    def without_clearance(self) -> IdleState:
        """The state of another surface."""
        return replace(self, displacement=None, clearance=0.0)


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
        self._restored: list[PenaltyContacts] | None = None
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
        pairs, clearance = self._surface.current.parts[0].pairs, 0.0
        # a search of wide gaps is worth it on all ranks or on none
        if not max_over_ranks(self._comm, int(self._surface.has_retracted or pairs.anything_is_near(x))):
            reach = max_over_ranks(self._comm, self._surface.reach_of_points())
            clearance = -max_over_ranks(self._comm, -pairs.clearance(x)) / reach
        displacement = self._u.x.array[: self._owned].copy() if clearance else None
        self._idle_state = replace(self._idle_state, displacement=displacement, clearance=clearance)

    def surface_changed(self) -> None:
        """Discard the clearance, as it is another surface."""
        self._idle_state = self._idle_state.without_clearance()
        self.discard()

    def extend_faces(self, level: TimeLevel) -> None:
        """Extend retracted crack faces at the start of a step, once nodes have moved far enough (collective)."""
        if not self._surface.has_retracted:
            return
        speed = max_over_ranks(self._comm, max_length(level.v_n.reshape(-1, self._dim)))
        motion = self._idle_state.motion + level.dt * speed
        is_due = motion >= PENALTY.extension_motion * self._surface.law.distance
        self._idle_state = replace(self._idle_state, motion=0.0 if is_due else motion)
        if is_due:
            self._surface.extend_faces(level.u_n)

    def end_step(self, *, is_near: bool) -> None:
        """Note whether anything is near contact at the end of a step, on any rank (collective)."""
        any_near = bool(max_over_ranks(self._comm, int(is_near)))
        self._idle_state = replace(self._idle_state, is_near=any_near)

    @property
    def _histories(self) -> list[PenaltyContacts]:
        return [part.pairs.history for part in self._surface.current.parts]

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
        histories, count, idle = cast("tuple[list[PenaltyContacts], int, IdleState]", memory)
        if count == self._surface.surface_count:
            self._restored, self._idle_state = None, idle
            for part, history in zip(self._surface.current.parts, histories, strict=True):
                if history is not part.pairs.history:
                    part.pairs.set_history(history)
        else:
            self._restored, self._idle_state = histories, idle.without_clearance()
        self.discard()

    def to_checkpoint(self) -> dict[str, Values]:
        """Contacts of each part, on rank 0 (collective)."""
        self.settle()
        arrays: dict[str, Values] = {"motion": np.array([self._idle_state.motion])}
        for index, history in enumerate(self._histories):
            if (of_ranks := gather(self._comm, history)) is not None:
                of_all = PenaltyContacts.join(of_ranks)
                arrays |= {f"points_{index}": cast("Values", of_all.points), f"contacts_{index}": of_all.to_array()}
        return arrays

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective)."""
        names = [(f"points_{index}", f"contacts_{index}") for index in range(len(self._histories))]
        histories = [PenaltyContacts.from_array(cast("Ints", saved[key]), saved[rows]) for key, rows in names]
        is_near = any(len(history.points) for history in histories)
        (motion,) = saved["motion"]
        self.restore((histories, self._surface.surface_count, IdleState(is_near, motion=float(motion))))
